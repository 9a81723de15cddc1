"""The estimator that chooses for itself: the least-squares answer everywhere, as cheaply as the problem allows."""

from __future__ import annotations

import numpy as np
import pytest

from ipe_bench.basics.linalg import Covariance
from ipe_bench.measurements import Gins, Polynomial
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import Gaussian, Quantization
from ipe_bench.solvers import Auto, FixedPoint, Progressive
from ipe_bench.solvers.auto import FIXED_POINT, PROGRESSIVE
from ipe_bench.trials.roots import least_squares_root
from ipe_bench.trials.scenario import Scenario


@pytest.mark.parametrize("scale", [1.0, 33.0, 100.0, 1000.0])
def test_it_finds_the_least_squares_minimum_next_to_the_truth(scale):
    scenario = Scenario(Gins(), Quantization(0.02286), error_scale=scale)
    problem, trials = scenario.problem, scenario.draw(0, 20)
    with np.errstate(all="ignore"):
        estimates = Auto().estimate(problem, trials.z)
        root = least_squares_root(problem, trials.z, trials.x, prior=None)
    deviation = np.sqrt(np.diagonal(estimates.covariance, axis1=1, axis2=2))
    assert (np.abs(estimates.x - root) / deviation).max() < 1e-3


def test_what_is_nearly_linear_costs_no_more_than_fixed_point_iteration_and_half_again():
    scenario = Scenario(Gins(), Quantization(0.02286), error_scale=10.0)
    z = scenario.draw(0, 30).z
    quick, plain = (e.estimate(scenario.problem, z) for e in (Auto(), FixedPoint()))
    assert (quick.extras["stage"] == FIXED_POINT).all()
    cost = [np.median(e.simulations + 11 * e.jacobians) for e in (quick, plain)]
    assert cost[0] <= 1.5 * cost[1]


def test_what_is_far_is_left_to_progressive():
    scenario = Scenario(Gins(), Quantization(0.02286), error_scale=1000.0)
    z = scenario.draw(0, 10).z
    with np.errstate(all="ignore"):
        chosen, thorough = (e.estimate(scenario.problem, z) for e in (Auto(), Progressive()))
    assert (chosen.extras["stage"] == PROGRESSIVE).all()
    np.testing.assert_array_equal(chosen.x, thorough.x)
    assert (chosen.simulations > thorough.simulations).all()


def test_residuals_that_do_not_fit_are_no_answer_of_the_first_stage():
    scenario = Scenario(Polynomial(strength=0.02), Gaussian(0.1), error_scale=1.0)
    z = scenario.draw(0, 4).z
    strict = Problem(scenario.measurement, Covariance(np.full(scenario.measurement.m, 1e-4)))
    assert (Auto().estimate(scenario.problem, z).extras["stage"] == FIXED_POINT).all()
    assert (Auto().estimate(strict, z).extras["stage"] == PROGRESSIVE).all()
