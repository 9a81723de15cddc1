"""Filters that linearise an epoch again, against textbook loops and SciPy; and what every estimator
promises."""

import numpy as np
import pytest
from ipe_bench_zoo import LMIEKF, EsMda, MultipleShooting, RecursiveUpdate
from scipy.optimize import least_squares
from shared.estimator_checks import check_bits, check_failures
from shared.linear_models import Linear, linear_map
from shared.oracles import assert_agrees
from shared.small_models import Bent

from ipe_bench.basics.linalg import Covariance, deviations
from ipe_bench.basics.statuses import Status
from ipe_bench.measurements import Gins, LotkaVolterra
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import Gaussian, Quantization
from ipe_bench.priors import GaussianPrior
from ipe_bench.trials.scenario import Scenario


@pytest.mark.oracle(
    "own second implementation: recursive update filter in covariance form",
    "estimates and covariances",
    1e-9,
)
def test_recursive_steps_are_updates_with_inflated_noise():
    """The textbook loop in covariance form: at each step the gain for R / w_k, linearised at the
    last estimate."""
    scenario = Scenario(Bent(0.05), Gaussian(0.3), GaussianPrior(), 1.0, seed=2)
    problem, trials = scenario.problem, scenario.draw(0, 4)
    model, found = (
        problem.measurement,
        RecursiveUpdate(steps=4, first=2.0).estimate(problem, trials.z),
    )
    for z, x_found, P_found in zip(trials.z, found.x, found.covariance, strict=True):
        x, P = np.zeros(3), np.eye(3)
        for rows in model.epochs:
            H = model.jacobian(x[None])[0, rows]
            strength = np.linalg.eigvalsh(H @ P @ H.T / 0.09).max()
            ratio = 1 + strength / 2.0
            for w in np.array([ratio ** (k / 3) for k in range(4)]) / sum(
                ratio ** (k / 3) for k in range(4)
            ):
                H = model.jacobian(x[None])[0, rows]
                K = P @ H.T @ np.linalg.inv(H @ P @ H.T + 0.09 / w * np.eye(len(rows)))
                x, P = x + K @ (z[rows] - model.simulate(x[None])[0, rows]), P - K @ H @ P
        assert_agrees(x_found, x, atol=1e-9)
        assert_agrees(P_found, P, atol=1e-9)


@pytest.mark.oracle("library: SciPy's least_squares", "estimates", 1e-6)
def test_damped_iterations_end_at_the_maximum_a_posteriori_of_the_epoch():
    """One epoch: SciPy minimises the same sum of squares."""
    model = Linear(sizes=(8,), unknowns=3)

    class Curved(Linear):
        def simulate_until(self, x, stop):
            y = super().simulate_until(x, stop)
            return y + 0.2 * y**2

        def jacobian_until(self, x, stop):
            y = super().simulate_until(x, stop)
            return (1 + 0.4 * y)[:, :, None] * self.matrix[self.rows(stop)]

    curved, d = Curved(sizes=(8,), unknowns=3), np.array([0.5, 1.0, 2.0])
    problem = Problem(curved, Covariance(np.full(8, 0.2)), d)
    rng = np.random.default_rng(0)
    x = model.nominal + rng.standard_normal((20, 3)) * d
    z = curved.simulate_until(x, 1)[:, np.argsort(curved.rows(1))] + 0.2 * rng.standard_normal(
        (20, 8)
    )
    found = LMIEKF(tolerance=1e-9, max_iterations=300).estimate(problem, z)
    h = lambda x: curved.simulate_until(x[None], 1)[0]  # noqa: E731
    for x_found, reading in zip(found.x, z, strict=True):

        def residual(x, reading=reading):
            return np.concatenate([(h(x) - reading) / 0.2, (x - curved.nominal) / d])

        other = least_squares(residual, curved.nominal, xtol=1e-15, ftol=1e-15, gtol=1e-12)
        again = least_squares(residual, x_found, xtol=1e-15, ftol=1e-15, gtol=1e-12)
        assert_agrees(x_found, again.x, atol=1e-6)
        # It never ends higher than where it began, and nearly always where SciPy does.
        assert np.sum(residual(x_found) ** 2) <= np.sum(residual(curved.nominal) ** 2)
        assert np.sum(residual(x_found) ** 2) <= 2 * other.cost + 1e-6 or again.cost > other.cost


RIVALS = [RecursiveUpdate(), LMIEKF(), EsMda(members=20), MultipleShooting()]


@pytest.mark.parametrize("estimator", RIVALS[:2], ids=str)
@pytest.mark.parametrize("scale", [1.0, 100.0])
def test_on_a_linear_model_a_filter_is_the_batch_map(estimator, scale):
    scenario = Scenario(Linear(), Gaussian(0.0066), GaussianPrior(), scale)
    problem, trials = scenario.problem, scenario.draw(0, 5)
    x, P = linear_map(problem, Linear().matrix, trials.z)
    found = estimator.estimate(problem, trials.z)
    assert (found.status == Status.CONVERGED).all()
    assert np.abs((found.x - x) / deviations(P)).max() < 1e-6
    assert np.abs((found.covariance - P) / np.outer(deviations(P), deviations(P))).max() < 1e-6


@pytest.mark.parametrize("estimator", RIVALS, ids=str)
def test_a_batch_is_its_trials_one_by_one_bit_for_bit(estimator):
    if isinstance(estimator, MultipleShooting):
        check_bits(estimator, Scenario(LotkaVolterra(), Gaussian(0.5)), 3)
    else:
        check_bits(
            estimator,
            Scenario(Gins(readings_per_case=6), Quantization(0.02286), error_scale=100.0),
            5,
        )


@pytest.mark.parametrize("estimator", RIVALS[:3], ids=str)
def test_a_trial_that_fails_has_a_status_and_disturbs_no_other(estimator):
    check_failures(estimator)
