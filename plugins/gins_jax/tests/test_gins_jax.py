"""Two implementations of the gimballed INS agree to 1e-8 m/s, in readings and in slopes."""

import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("jax")
sys.path.insert(0, str(Path(__file__).parents[1]))

from ipe_bench_gins_jax import GinsJax
from shared.oracles import agreed

import ipe_bench as ib
from ipe_bench.workshop.conformance import check_component

pytestmark = pytest.mark.plugin


def test_keeps_its_promises():
    model = GinsJax(readings_per_case=8, steps_per_interval=10, chunk=8)
    assert [finding for finding in check_component("gins_jax", model) if finding.complaint] == []


@pytest.mark.oracle("own second implementation: JAX", "velocities, m/s", 1e-8)
@pytest.mark.parametrize("scale", [1.0, 33.0, 100.0])
def test_readings_agree_to_1e_8(scale):
    x = scale * np.random.default_rng(1).standard_normal((20, 11))
    ours, theirs = ib.measurements.Gins(step=180.0 / 64), GinsJax()
    agreed(np.abs(theirs.simulate(x) - ours.simulate(x)), 1e-8)
    assert np.abs(theirs.offset - ours.offset).max() < 1e-8


@pytest.mark.oracle("own second implementation: JAX", "slopes of velocities, m/s", 1e-8)
@pytest.mark.parametrize("scale", [1.0, 100.0])
def test_slopes_agree_to_1e_8(scale):
    x = scale * np.random.default_rng(2).standard_normal((4, 11))
    ours, theirs = ib.measurements.Gins(step=180.0 / 64), GinsJax(chunk=4)
    agreed(np.abs(theirs.jacobian(x) - ours.jacobian(x)), 1e-8)


def test_readings_are_ordered_and_named_alike():
    ours, theirs = (
        ib.measurements.Gins(interval_min=6.0, readings_per_case=7),
        GinsJax(interval_min=6.0, readings_per_case=7),
    )
    assert theirs.index == ours.index
    assert theirs.parameters == ours.parameters
    x = np.random.default_rng(3).standard_normal((3, 11))
    assert np.abs(theirs.simulate(x) - ours.simulate(x)).max() < 1e-6  # ours by its own steps
    np.testing.assert_allclose(theirs.linearization(), ours.linearization(), rtol=0, atol=1e-6)


def test_an_estimate_from_the_readings_of_one_is_that_of_the_other():
    bench = ib.Scenario(ib.measurements.Gins(), ib.noise.Quantization(0.02286), error_scale=33.0)
    other = ib.Scenario(GinsJax(chunk=8), ib.noise.Quantization(0.02286), error_scale=33.0)
    z = bench.draw(0, 8).z
    ours, theirs = (ib.solvers.FixedPoint().estimate(b.problem, z) for b in (bench, other))
    deviations = np.sqrt(np.diag(np.linalg.inv(bench.problem.H.T @ bench.problem.H))) * 0.0066
    assert (np.abs(ours.x - theirs.x) < 1e-3 * deviations).all()
