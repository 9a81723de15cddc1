"""Jacobians that are near enough for steps: what they cost, and that answers do not depend on them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from small_models import Bent

from ipe_bench.basics.linalg import Array
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.ipe import FrozenSystem
from ipe_bench.measurements import Gins
from ipe_bench.measurements.counted import Counted, Tally
from ipe_bench.noise import Quantization
from ipe_bench.priors import GaussianPrior
from ipe_bench.solvers import Newton
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
    counted = Counted(model, Tally.zeros(3), share=0.5)
    J = counted.jacobian(x, rows, coarse=True)
    np.testing.assert_array_equal(counted.tally.jacobians, [0.125, 0.625, 0.125])
    np.testing.assert_array_equal(J[[0, 2]], model.coarse_jacobian(x[[0, 2]]))
    # Where it overflows, it is the exact one.
    np.testing.assert_array_equal(J[1], model.jacobian(x[1:2])[0])


def test_a_model_without_a_cheaper_one_computes_the_exact_one():
    model, x = Crude(0.01, cheap=1.0), np.ones((3, 3))
    counted = Counted(model, Tally.zeros(3))
    np.testing.assert_array_equal(counted.jacobian(x, np.arange(3), coarse=True), model.jacobian(x))
    assert (counted.tally.jacobians == 1).all()


def test_newtons_root_and_its_covariance_do_not_depend_on_coarse_jacobians():
    problem, trials = gins(33.0, 20)
    found = Newton().estimate(problem, trials.z)
    assert (found.status == Status.CONVERGED).all()
    system = FrozenSystem.at_nominal(problem, trials.z)
    assert (np.abs(system.F(found.x)) <= 1e-6 * system.deviation).all()
    slope = np.linalg.inv(system.H_plus @ problem.measurement.jacobian(found.x))
    np.testing.assert_allclose(found.covariance, slope @ system.covariance() @ slope.swapaxes(1, 2), rtol=1e-9)
    model = problem.measurement
    assert np.median(found.simulations + found.jacobians * model.jacobian_cost) < 15
