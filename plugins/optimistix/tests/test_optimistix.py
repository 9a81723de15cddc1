"""Optimistix finds the minima that our own solvers find, at the cost that it counts."""

import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("optimistix")
sys.path.insert(0, str(Path(__file__).parents[1]))

from ipe_bench_optimistix import Optimistix
from shared.oracles import agreed, assert_agrees

import ipe_bench as ib
from ipe_bench.basics.statuses import Status
from ipe_bench.workshop.conformance import check_component

pytestmark = pytest.mark.plugin
METHODS = ("levenberg_marquardt", "dogleg", "gauss_newton")


@pytest.mark.parametrize("method", METHODS)
def test_keeps_its_promises(method):
    findings = list(check_component("optimistix", Optimistix(method=method)))
    assert [finding for finding in findings if finding.complaint] == []


@pytest.mark.oracle("library: Optimistix", "estimates, in standard deviations", 1e-6)
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    "model", [ib.measurements.Ranging(), ib.measurements.Sir()], ids=lambda model: model.name
)
def test_ends_where_ours_end(model, method):
    bench = ib.Scenario(model, error_scale=1.0)
    drawn = bench.draw(0, 5)
    theirs = Optimistix(method=method).estimate(bench.problem, drawn.z)
    ours = ib.baselines.LevenbergMarquardt(tolerance=1e-9).estimate(bench.problem, drawn.z)
    assert (theirs.status == Status.CONVERGED).all()
    deviations = np.sqrt(np.diagonal(ours.covariance, axis1=1, axis2=2))
    agreed(np.abs(theirs.x - ours.x) / deviations, 1e-6)
    np.testing.assert_allclose(theirs.covariance, ours.covariance, rtol=1e-5)


@pytest.mark.oracle(
    "certified: NIST Statistical Reference Datasets (Misra1a)", "parameters by Optimistix", 1e-8
)
def test_finds_what_nist_certifies():
    bench = ib.Scenario(ib.measurements.Nist("Misra1a", start=2), ib.noise.Certified())
    drawn = bench.draw(0, 1)
    found = Optimistix(rtol=1e-13, atol=1e-13).estimate(bench.problem, drawn.z)
    assert_agrees(found.x, drawn.x, rtol=1e-8)


def test_counts_what_it_computes():
    calls = []

    class Counting(ib.measurements.Ranging):
        def simulate(self, x):
            calls.append(len(x))
            return super().simulate(x)

    bench = ib.Scenario(Counting(), ib.noise.Gaussian(0.1))
    drawn, _ = bench.draw(0, 1), bench.problem.H
    calls.clear()
    found = Optimistix().estimate(bench.problem, drawn.z)
    # A Jacobian by complex step is one call of as many trials as there are parameters.
    assert sum(calls) == found.simulations[0] + found.jacobians[0] * bench.measurement.jacobian_cost


def test_too_few_steps_are_a_status():
    bench = ib.Scenario(ib.measurements.Ranging(), error_scale=10.0)
    found = Optimistix(max_steps=2).estimate(bench.problem, bench.draw(0, 1).z)
    assert found.status[0] == Status.MAX_ITERATIONS
