"""Stone Soup's filters and ours are the same filters: they agree to round-off on the same
readings."""

import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("stonesoup")
sys.path.insert(0, str(Path(__file__).parents[1]))

from ipe_bench_stonesoup import StoneSoupEKF, StoneSoupUKF
from shared.oracles import agreed, assert_agrees

import ipe_bench as ib
from ipe_bench.workshop.conformance import check_component

pytestmark = pytest.mark.plugin
PAIRS = {"EKF": (StoneSoupEKF(), ib.baselines.EKF()), "UKF": (StoneSoupUKF(), ib.baselines.UKF())}


@pytest.mark.parametrize("theirs", [StoneSoupEKF(), StoneSoupUKF()], ids=lambda e: type(e).__name__)
def test_keeps_its_promises(theirs):
    assert [finding for finding in check_component("stonesoup", theirs) if finding.complaint] == []


@pytest.mark.oracle("library: Stone Soup's EKF and UKF", "estimates, in standard deviations", 3e-6)
@pytest.mark.parametrize("pair", PAIRS)
@pytest.mark.parametrize("engine", ["filterpy", "batched"])
@pytest.mark.parametrize(
    ("model", "noise", "error_scale"),
    [
        (ib.measurements.Bearings(), ib.noise.Gaussian(0.5), 1.0),
        (ib.measurements.Sir(), ib.noise.Gaussian(20.0), 1.0),
        (ib.measurements.Gins(), ib.noise.Quantization(0.02286), 10.0),
    ],
    ids=lambda part: getattr(part, "name", str(part)),
)
def test_agrees_with_ours(pair, engine, model, noise, error_scale):
    theirs, ours = PAIRS[pair]
    ours = type(ours)(engine=engine)
    bench = ib.Scenario(model, noise, error_scale=error_scale)
    drawn = bench.draw(0, 4)
    a, b = theirs.estimate(bench.problem, drawn.z), ours.estimate(bench.problem, drawn.z)
    assert (a.status == b.status).all()
    deviations = np.sqrt(np.diagonal(b.covariance, axis1=1, axis2=2))
    # Sigma points lose digits where a prior is 1e4 times as wide as what is left of it.
    close = 1e-8 if pair == "EKF" else 3e-6
    agreed(np.abs(a.x - b.x) / deviations, close)
    np.testing.assert_allclose(
        np.diagonal(a.covariance, axis1=1, axis2=2), deviations**2, rtol=close
    )
    np.testing.assert_allclose(a.extras["nis"], b.extras["nis"], rtol=close)


@pytest.mark.oracle("library: Stone Soup's EKF and UKF", "estimates with process noise", 1e-7)
@pytest.mark.parametrize("pair", PAIRS)
def test_agrees_with_ours_with_process_noise(pair):
    theirs, ours = (type(filter)(process_noise=0.05, prior_inflation=2.0) for filter in PAIRS[pair])
    bench = ib.Scenario(ib.measurements.Sir(), ib.noise.Gaussian(20.0), error_scale=1.0)
    drawn = bench.draw(0, 4)
    a, b = theirs.estimate(bench.problem, drawn.z), ours.estimate(bench.problem, drawn.z)
    assert_agrees(a.x, b.x, atol=1e-7)
    np.testing.assert_allclose(a.covariance, b.covariance, rtol=1e-6, atol=1e-12)
