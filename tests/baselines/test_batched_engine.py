"""The engine that computes the filters of all trials at once, against filterpy trial by trial."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from linear_models import Linear, linear_map

from ipe_bench.baselines import CKF, EKF, UKF, EnKF, IteratedEKF
from ipe_bench.baselines.sequential import Sequential
from ipe_bench.basics.linalg import finite
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.base import Estimates
from ipe_bench.measurements.gins import Gins
from ipe_bench.noise import Gaussian, Quantization
from ipe_bench.priors import GaussianPrior
from ipe_bench.trials.scenario import Scenario

FILTERS: list[Sequential] = [EKF(), IteratedEKF(), UKF(), CKF(), EnKF(members=30)]


def gins(scale: float) -> Scenario:
    return Scenario(Gins(), Quantization(0.02286), GaussianPrior(), scale)


def both(estimator: Sequential, scenario: Scenario, z) -> tuple[Estimates, Estimates]:
    return tuple(  # type: ignore[return-value]
        replace(estimator, engine=engine).estimate(scenario.problem, z, history=True)
        for engine in ("filterpy", "batched")
    )


def assert_alike(scenario: Scenario, one: Estimates, other: Estimates, apart: float) -> None:
    d = scenario.problem.prior_deviation
    assert d is not None
    assert one.covariance is not None
    assert other.covariance is not None
    np.testing.assert_array_equal(one.status, other.status)
    for name in ("simulations", "jacobians", "iterations"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    np.testing.assert_allclose(other.x / d, one.x / d, rtol=0, atol=apart)
    np.testing.assert_allclose(other.covariance / np.outer(d, d), one.covariance / np.outer(d, d), rtol=0, atol=apart)
    np.testing.assert_allclose(other.extras["nis"], one.extras["nis"], rtol=1e-7)
    assert one.history is not None
    assert other.history is not None
    for mine, theirs in zip(one.history, other.history, strict=True):
        # After the first epochs S is as ill-conditioned as the prior is wide, and both round.
        np.testing.assert_allclose(theirs / d, mine / d, rtol=0, atol=100 * apart)


@pytest.mark.parametrize("scale", [10.0, 100.0, 300.0])
@pytest.mark.parametrize("estimator", FILTERS, ids=lambda f: type(f).__name__)
def test_it_is_filterpy_within_a_billionth_of_the_prior_on_gins(estimator: Sequential, scale: float) -> None:
    scenario = gins(scale)
    assert_alike(scenario, *both(estimator, scenario, scenario.draw(0, 5).z), 1e-9)


@pytest.mark.parametrize("changes", [{}, {"process_noise": 0.1}, {"prior_inflation": 2.0}], ids=str)
@pytest.mark.parametrize("estimator", FILTERS, ids=lambda f: type(f).__name__)
def test_it_is_filterpy_on_a_linear_model(estimator: Sequential, changes) -> None:
    scenario = Scenario(Linear(), Gaussian(0.1), GaussianPrior(), 3.0)
    assert_alike(scenario, *both(replace(estimator, **changes), scenario, scenario.draw(0, 6).z), 1e-9)


@pytest.mark.parametrize("estimator", [EKF(), IteratedEKF(), UKF(), CKF()], ids=lambda f: type(f).__name__)
def test_on_a_linear_model_it_is_the_maximum_a_posteriori(estimator: Sequential) -> None:
    scenario = Scenario(Linear(), Gaussian(0.1), GaussianPrior(), 3.0)
    z = scenario.draw(0, 6).z
    x, P = linear_map(scenario.problem, Linear().matrix, z)
    found = replace(estimator, engine="batched").estimate(scenario.problem, z)
    deviation = np.sqrt(np.diag(P))
    np.testing.assert_allclose(found.x / deviation, x / deviation, rtol=0, atol=1e-7)
    assert found.covariance is not None
    np.testing.assert_allclose(
        found.covariance / np.outer(deviation, deviation),
        P[None] / np.outer(deviation, deviation) + 0 * x[:, None],
        0,
        1e-7,
    )


@pytest.mark.parametrize("estimator", FILTERS, ids=lambda f: type(f).__name__)
def test_bits_do_not_depend_on_the_batch_nor_on_those_that_fail(estimator: Sequential) -> None:
    scenario, estimator = gins(100.0), replace(estimator, engine="batched")
    z = scenario.draw(0, 6).z
    alone = [estimator.estimate(scenario.problem, row[None]) for row in z]
    spoiled = z.copy()
    spoiled[2, 7], spoiled[4] = np.nan, 1e200
    for batch in (z, spoiled):
        found = estimator.estimate(scenario.problem, batch)
        for i in (0, 1, 3, 5):
            np.testing.assert_array_equal(found.x[i], alone[i].x[0])
            np.testing.assert_array_equal(found.covariance[i], alone[i].covariance[0])  # type: ignore[index]
    assert found.status[2] == Status.NONFINITE
    assert found.messages[2] == "reading 8 is not a finite number"
    assert found.status[4] != Status.CONVERGED
    assert not finite(found.covariance)[[2, 4]].any()  # type: ignore[arg-type]


def test_a_model_that_raises_ends_its_own_trial_with_what_it_said() -> None:
    class Raises(Linear):
        def simulate_until(self, x, stop):
            if (x[:, 0] > 1e3).any():
                raise ValueError("out of range")
            return super().simulate_until(x, stop)

    scenario = Scenario(Raises(), Gaussian(0.1), GaussianPrior(), 3.0)
    z = scenario.draw(0, 4).z
    z[1] *= 1e6
    for estimator in (UKF(), CKF(), EKF()):
        one, other = both(estimator, scenario, z)
        np.testing.assert_array_equal(one.status, other.status)
        assert one.messages.keys() == other.messages.keys()
