"""Jacobians that are near enough for steps: what they cost, and that answers do not depend on them."""

import itertools
from dataclasses import dataclass

import numpy as np
import pytest
from small_models import Bent

from ipe_bench.baselines import GaussNewton, LevenbergMarquardt
from ipe_bench.basics.linalg import Array, Covariance
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.ipe import FrozenSystem
from ipe_bench.measurements import Gins
from ipe_bench.measurements.counted import CountingModel, EvaluationCount
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import Quantization
from ipe_bench.priors import GaussianPrior
from ipe_bench.solvers import Auto, DampedNewton, Newton, Progressive
from ipe_bench.trials.scenario import Scenario


@dataclass(frozen=True)
class Crude(Bent):
    """A model whose cheap Jacobian is off by one part in a hundred, and overflows beyond 10."""

    error: float = 0.01
    cheap: float = 0.25

    def coarse_jacobian(self, x: Array) -> Array:
        J = self.jacobian(x) * (1 + self.error * np.cos(np.arange(self.m))[:, None])
        return np.where(np.abs(x).max(axis=1)[:, None, None] > 10, np.nan, J)

    @property
    def coarse_jacobian_cost(self) -> float:
        return self.cheap * self.jacobian_cost


def gins(scale: float, trials: int):
    scenario = Scenario(Gins(), Quantization(0.02286), GaussianPrior(), scale)
    return scenario.problem, scenario.draw(0, trials)


def test_a_coarse_jacobian_counts_as_what_it_costs():
    model, rows, x = Crude(0.01), np.arange(3), np.ones((3, 3))
    x[1] = 11.0
    counted = CountingModel(model, EvaluationCount.zeros(3), share=0.5)
    J = counted.jacobian(x, rows, coarse=True)
    np.testing.assert_array_equal(counted.tally.jacobians, [0.125, 0.625, 0.125])
    np.testing.assert_array_equal(J[[0, 2]], model.coarse_jacobian(x[[0, 2]]))
    # Where it overflows, it is the exact one.
    np.testing.assert_array_equal(J[1], model.jacobian(x[1:2])[0])


@pytest.mark.parametrize("solver", [Newton(tolerance=1e-12), DampedNewton(tolerance=1e-12)], ids=repr)
def test_newtons_method_is_coarse_far_away_and_of_order_two_near_a_root(solver):
    """A Jacobian that is off by one part in a hundred would gain a factor of a hundred in a step."""
    problem = Problem(Crude(0.01), Covariance(np.full(12, 0.03)), None)
    z = problem.measurement.simulate(np.random.default_rng(3).normal(size=(20, 3)))
    found = solver.estimate(problem, z, history=True)
    assert (found.status == Status.CONVERGED).all()
    system = FrozenSystem.at_nominal(problem, z)
    assert found.history is not None
    sizes = [
        [np.abs(system.subset(np.arange(20) == i).F(x[None]) / system.deviation).max() for x in iterates]
        for i, iterates in enumerate(found.history)
    ]
    near = [(a, b) for trial in sizes for a, b in itertools.pairwise(trial) if 1e-6 < a <= 0.03]
    assert len(near) >= 5
    assert all(b < 1e-4 * a for a, b in near)
    far = np.array([np.sum(np.array(trial[:-1]) > 0.03) for trial in sizes])
    np.testing.assert_allclose(found.jacobians, found.iterations - 0.75 * far, rtol=1e-12)


def test_newtons_root_and_its_covariance_are_those_of_exact_jacobians():
    problem, trials = gins(33.0, 20)
    found = Newton().estimate(problem, trials.z)
    assert (found.status == Status.CONVERGED).all()
    system = FrozenSystem.at_nominal(problem, trials.z)
    assert (np.abs(system.F(found.x)) <= 1e-6 * system.deviation).all()
    slope = np.linalg.inv(system.H_plus @ problem.measurement.jacobian(found.x))
    np.testing.assert_allclose(found.covariance, slope @ system.covariance() @ slope.swapaxes(1, 2), rtol=1e-9)
    assert (found.jacobians < 0.7 * found.iterations).all()


LEAST_SQUARES = [GaussNewton(), LevenbergMarquardt(), Progressive(), Auto()]


@pytest.mark.parametrize("estimator", LEAST_SQUARES, ids=repr)
def test_a_minimum_and_its_covariance_are_those_of_exact_jacobians(estimator):
    problem, trials = gins(33.0, 20)
    found = estimator.estimate(problem, trials.z)
    assert (found.status == Status.CONVERGED).all()
    step, P = gauss_newton_step(problem, trials.z, found.x)
    within = 1e-4 if isinstance(estimator, Auto) else 1e-6
    assert (np.abs(step) <= within * np.sqrt(np.diagonal(P, axis1=1, axis2=2))).all()
    np.testing.assert_allclose(
        found.covariance, P, rtol=1e-4 if isinstance(estimator, Auto) else 1e-9, atol=1e-4 * within
    )
    assert np.median(found.simulations + found.jacobians * problem.measurement.jacobian_cost) < 45


def gauss_newton_step(problem: Problem, z: Array, x: Array) -> tuple[Array, Array]:
    J = problem.R.whiten_jacobian(problem.measurement.jacobian(x))
    r = problem.R.whiten(problem.measurement.simulate(x) - z)
    P = np.linalg.inv(J.swapaxes(1, 2) @ J)
    return -(P @ J.swapaxes(1, 2) @ r[..., None])[..., 0], P


@pytest.mark.parametrize("estimator", LEAST_SQUARES[:2], ids=repr)
@pytest.mark.parametrize("error", [0.01, 0.1])
def test_residuals_that_stay_large_do_not_move_the_minimum(estimator, error):
    """There a coarse gradient is zero some deviations away."""
    z = np.random.default_rng(3).normal(size=(8, 12))
    problem = Problem(Crude(0.01, error=error), Covariance(np.full(12, 0.03)), None)
    found = estimator.estimate(problem, z)
    assert (found.status == Status.CONVERGED).all()
    step, P = gauss_newton_step(problem, z, found.x)
    deviation = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    assert (np.abs(step) <= 1e-6 * deviation).all()
    np.testing.assert_allclose(found.covariance, P, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("estimator", [GaussNewton("nominal", tolerance=1e-5), LevenbergMarquardt(tolerance=1e-5)])
def test_a_step_that_lands_where_the_coarse_gradient_is_zero_is_not_the_last(estimator):
    problem = Problem(Crude(0.0, error=1e-5), Covariance(np.full(12, 3e-5)), None)
    z = np.random.default_rng(3).normal(size=(8, 12))
    A = problem.measurement.A
    found = estimator.estimate(problem, z - z @ A @ np.linalg.pinv(A))
    step, P = gauss_newton_step(problem, z - z @ A @ np.linalg.pinv(A), found.x)
    assert (found.status == Status.CONVERGED).all()
    assert (np.abs(step) <= 1.1e-5 * np.sqrt(np.diagonal(P, axis1=1, axis2=2))).all()


def test_levenberg_marquardt_does_not_trust_a_coarse_jacobian_that_leads_nowhere():
    problem = Problem(Crude(0.01, error=-2.0), Covariance(np.full(12, 0.03)), None)
    z = Bent(0.01).simulate(np.random.default_rng(4).normal(size=(5, 3)))
    found = LevenbergMarquardt().estimate(problem, z)
    assert (found.status == Status.CONVERGED).all()


@pytest.mark.parametrize("estimator", [*LEAST_SQUARES, Newton()], ids=repr)
def test_without_a_cheaper_jacobian_nothing_changes(estimator):
    z = Bent(0.01).simulate(np.random.default_rng(4).normal(size=(5, 3)))
    R = Covariance(np.full(12, 0.03))
    plain, same = (estimator.estimate(Problem(m, R), z) for m in (Bent(0.01), Crude(0.01, cheap=1.0)))
    for name in ("x", "status", "covariance", "iterations", "simulations", "jacobians"):
        np.testing.assert_array_equal(getattr(plain, name), getattr(same, name), name)
