"""The filters in square-root information form against closed forms, filterpy's filters and textbook loops."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from linear_models import Linear, LinearGins, linear_map
from scipy.optimize import least_squares
from small_models import Bent

from ipe_bench.baselines import EKF, IPLF, LMIEKF, IteratedEKF, RecursiveUpdate
from ipe_bench.baselines.epochs import arrivals
from ipe_bench.baselines.information import Belief, EpochReadings, InformationFilter
from ipe_bench.baselines.iplf import Affine
from ipe_bench.baselines.recursive_update import geometric_weights
from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Covariance, multiply
from ipe_bench.basics.statuses import Status
from ipe_bench.measurements import Gins
from ipe_bench.measurements.base import SubsetModel
from ipe_bench.measurements.counted import EvaluationCount
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import Gaussian, Quantization
from ipe_bench.priors import GaussianPrior
from ipe_bench.statistics.consistency import mean_limits
from ipe_bench.trials.scenario import Scenario
from ipe_bench.trials.scoring import Block

FILTERS: list[InformationFilter] = [RecursiveUpdate(), LMIEKF(), IPLF()]


def label(estimator: object) -> str:
    return type(estimator).__name__


def deviations(P):
    return np.sqrt(np.diagonal(P, axis1=-2, axis2=-1))


def bent(bend: float, deviation: float, trials: int):
    """Epochs of three readings, mildly nonlinear."""
    scenario = Scenario(Bent(bend), Gaussian(deviation), GaussianPrior(), 1.0, seed=2)
    return scenario.problem, scenario.draw(0, trials)


def gins(scale: float, trials: int, seed: int = 91):
    return Block.draw(Scenario(Gins(), Quantization(0.02286), GaussianPrior(), scale, seed), 0, trials)


@pytest.mark.parametrize("scale", [1.0, 100.0])
@pytest.mark.parametrize("estimator", FILTERS, ids=label)
@pytest.mark.parametrize("model", [Linear(), LinearGins()], ids=label)
def test_on_a_linear_model_a_filter_is_the_batch_map(model, estimator, scale):
    scenario = Scenario(model, Gaussian(0.0066), GaussianPrior(), scale)
    problem, trials = scenario.problem, scenario.draw(0, 5)
    x, P = linear_map(problem, model.matrix, trials.z)
    found = estimator.estimate(problem, trials.z)
    assert (found.status == Status.CONVERGED).all()
    assert np.abs((found.x - x) / deviations(P)).max() < 1e-6
    assert np.abs((found.covariance - P) / np.outer(deviations(P), deviations(P))).max() < 1e-6


@pytest.mark.parametrize("estimator", FILTERS, ids=label)
def test_inflation_widens_the_prior(estimator):
    scenario = Scenario(Linear(), Gaussian(1.0), GaussianPrior(), 0.5)
    problem, trials = scenario.problem, scenario.draw(0, 3)
    x, P = linear_map(problem, Linear().matrix, trials.z, inflation=3.0)
    found = replace(estimator, prior_inflation=3.0).estimate(problem, trials.z)
    assert found.x == pytest.approx(x, abs=1e-8)
    assert found.covariance[0] == pytest.approx(P, abs=1e-8)


@pytest.mark.parametrize("estimator", FILTERS, ids=label)
def test_readings_correlated_within_an_epoch(estimator):
    model = Linear(sizes=(3, 4), unknowns=2)
    R = np.eye(7)
    for rows in model.epochs:
        R[np.ix_(rows, rows)] += 0.8
    problem = Problem(model, Covariance(np.linalg.cholesky(R)), np.ones(2))
    z = np.linspace(-2.0, 3.0, 7)[None]
    x, P = linear_map(problem, model.matrix, z)
    assert np.abs((estimator.estimate(problem, z).x[0] - x[0]) / deviations(P)).max() < 1e-9


@pytest.mark.parametrize("estimator", FILTERS, ids=label)
def test_missing_readings_are_as_if_they_had_never_been_taken(estimator):
    model, kept = Linear(), (0, 2, 3, 5, 6, 8, 9)
    problem = Problem(SubsetModel(model, kept), Covariance(np.full(7, 0.3)), np.ones(4))
    z = np.linspace(-2.0, 3.0, 7)[None]
    whole = Linear()
    A, b = whole.matrix[list(kept)] / 0.3, (z[0] - whole.matrix[list(kept)] @ whole.nominal) / 0.3
    x = whole.nominal + np.linalg.solve(A.T @ A + np.eye(4), A.T @ b)
    np.testing.assert_allclose(estimator.estimate(problem, z).x[0], x, atol=1e-9)


@pytest.mark.parametrize("estimator", FILTERS, ids=label)
def test_nis_is_chi_square_on_a_linear_model(estimator):
    model = Linear()
    scenario = Scenario(model, Gaussian(0.7), GaussianPrior(), 1.0)
    found = estimator.estimate(scenario.problem, scenario.draw(0, 200).z)
    low, high = mean_limits(model.m, 200, 0.999)
    assert low < found.extras["nis"].mean() < high


@pytest.mark.parametrize("estimator", FILTERS, ids=label)
def test_what_a_filter_needs_is_named(estimator):
    with pytest.raises(UserError, match="has no prior"):
        estimator.estimate(Problem(Linear(), Covariance(np.ones(11))), np.zeros((1, 11)))
    problem = Problem(Linear(sizes=(3, 4), unknowns=2), Covariance(np.linalg.cholesky(np.eye(7) + 0.1)), np.ones(2))
    with pytest.raises(UserError, match="correlated between epochs"):
        estimator.estimate(problem, np.zeros((1, 7)))


@pytest.mark.parametrize("estimator", FILTERS, ids=label)
def test_a_trial_that_fails_has_a_status_and_disturbs_no_other(estimator):
    problem, trials = bent(0.02, 0.1, 6)
    spoiled = trials.z.copy()
    spoiled[1, 4] = np.nan
    spoiled[3] = 1e300
    found, alone = estimator.estimate(problem, spoiled), estimator.estimate(problem, trials.z)
    assert found.status[1] == Status.NONFINITE
    assert found.messages[1] == "a reading is not a finite number"
    assert found.status[3] in (Status.NONFINITE, Status.SINGULAR)
    assert "epoch 1" in found.messages[3]
    assert np.isnan(found.covariance[[1, 3]]).all()
    others = [0, 2, 4, 5]
    np.testing.assert_array_equal(found.x[others], alone.x[others])


@pytest.mark.parametrize("estimator", FILTERS, ids=label)
def test_a_batch_of_gins_is_its_trials(estimator):
    block = gins(300.0, 3)
    whole = estimator.estimate(block.problem, block.trials.z, history=True)
    for i, z in enumerate(block.trials.z):
        alone = estimator.estimate(block.problem, z[None])
        np.testing.assert_array_equal(whole.x[i], alone.x[0])
        np.testing.assert_array_equal(whole.covariance[i], alone.covariance[0])
        assert whole.history[i].shape == (31, 11)


def test_one_recursive_step_is_the_extended_kalman_filter():
    """filterpy's EKF in Joseph's form, an independent implementation of the algebra."""
    block = gins(30.0, 10)
    problem, z = block.problem, block.trials.z
    ours, theirs = RecursiveUpdate(steps=1).estimate(problem, z), EKF().estimate(problem, z)
    assert np.abs((ours.x - theirs.x) / deviations(theirs.covariance)).max() < 1e-6
    np.testing.assert_allclose(ours.covariance, theirs.covariance, rtol=1e-4)
    np.testing.assert_allclose(ours.extras["nis"], theirs.extras["nis"], rtol=1e-4)
    np.testing.assert_array_equal(ours.simulations, theirs.simulations)


def test_recursive_steps_are_updates_with_inflated_noise():
    """The textbook loop in covariance form: at each step the gain for R / w_k, linearised at the last estimate."""
    problem, trials = bent(0.05, 0.3, 4)
    model, found = problem.measurement, RecursiveUpdate(steps=4, first=2.0).estimate(problem, trials.z)
    for z, x_found, P_found in zip(trials.z, found.x, found.covariance, strict=True):
        x, P = np.zeros(3), np.eye(3)
        for rows in model.epochs:
            H = model.jacobian(x[None])[0, rows]
            strength = np.linalg.eigvalsh(H @ P @ H.T / 0.09).max()
            ratio = 1 + strength / 2.0
            for w in np.array([ratio ** (k / 3) for k in range(4)]) / sum(ratio ** (k / 3) for k in range(4)):
                H = model.jacobian(x[None])[0, rows]
                K = P @ H.T @ np.linalg.inv(H @ P @ H.T + 0.09 / w * np.eye(len(rows)))
                x, P = x + K @ (z[rows] - model.simulate(x[None])[0, rows]), P - K @ H @ P
        np.testing.assert_allclose(x_found, x, atol=1e-9)
        np.testing.assert_allclose(P_found, P, atol=1e-9)


def test_geometric_weights_add_up_to_one():
    weights = geometric_weights(np.array([1.0, 1e6]), 4)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    np.testing.assert_allclose(weights[0], 0.25)
    np.testing.assert_allclose(weights[1, 1:] / weights[1, :-1], 100.0)


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
    z = curved.simulate_until(x, 1)[:, np.argsort(curved.rows(1))] + 0.2 * rng.standard_normal((20, 8))
    found = LMIEKF(tolerance=1e-9, max_iterations=300).estimate(problem, z)
    h = lambda x: curved.simulate_until(x[None], 1)[0]  # noqa: E731
    for x_found, reading in zip(found.x, z, strict=True):

        def residual(x, reading=reading):
            return np.concatenate([(h(x) - reading) / 0.2, (x - curved.nominal) / d])

        other = least_squares(residual, curved.nominal, xtol=1e-15, ftol=1e-15, gtol=1e-12)
        again = least_squares(residual, x_found, xtol=1e-15, ftol=1e-15, gtol=1e-12)
        np.testing.assert_allclose(x_found, again.x, atol=1e-6)
        # It never ends higher than where it began, and nearly always where SciPy does.
        assert np.sum(residual(x_found) ** 2) <= np.sum(residual(curved.nominal) ** 2)
        assert np.sum(residual(x_found) ** 2) <= 2 * other.cost + 1e-6 or again.cost > other.cost


def test_damping_changes_nothing_where_gauss_newton_converges():
    block = gins(100.0, 10)
    problem, z = block.problem, block.trials.z
    ours, theirs = (e.estimate(problem, z) for e in (LMIEKF(tolerance=1e-6), IteratedEKF(tolerance=1e-6)))
    assert np.abs((ours.x - theirs.x) / deviations(theirs.covariance)).max() < 1e-3
    np.testing.assert_allclose(ours.extras["nis"], theirs.extras["nis"], rtol=1e-3)


def test_regression_over_the_cubature_points_is_the_textbooks():
    """A = Psi' P^-1 and Omega = Phi - A P A' with the moments of the readings, all by sums over the points."""
    problem, trials = bent(0.5, 0.2, 4)
    epoch = next(arrivals(problem))
    rng = np.random.default_rng(5)
    U, x = rng.standard_normal((4, 3, 3)) + 2 * np.eye(3), rng.standard_normal((4, 3))
    z = epoch.whitened(trials.z)
    readings = EpochReadings(epoch, problem, np.ones(3), EvaluationCount.zeros(4), z, np.arange(4), Belief(x, U))
    found = Affine.over(readings, x, U)
    for k in range(4):
        S = np.linalg.inv(U[k])
        points = x[k] + np.sqrt(3) * np.concatenate([S.T, -S.T])
        h = problem.measurement.simulate(points)[:, epoch.rows] / 0.2
        P, centre = S @ S.T, h.mean(axis=0)
        A = ((h - centre).T @ (points - x[k]) / 6) @ np.linalg.inv(P)
        Omega = np.cov(h, rowvar=False, ddof=0) - A @ P @ A.T
        assert np.linalg.eigvalsh(Omega).max() > 0.1
        np.testing.assert_allclose(found.r[k], centre - z[k], rtol=1e-9)
        np.testing.assert_allclose(found.A[k], A, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(found.Omega[k], Omega, rtol=1e-8, atol=1e-8 * np.abs(h).max() ** 2)
    assert readings.tally.simulations == pytest.approx(6 / 4)  # six points of the first of four epochs


def textbook_iplf(model, z, variance, iterations):
    """García-Fernández et al.'s algorithm in covariance form, undamped, at the 2n points of the cubature rule."""
    n = 3
    x, P = np.zeros(n), np.eye(n)
    for rows in model.epochs:
        mean, cov = x, P
        for _ in range(iterations):
            points = mean + np.sqrt(n) * np.concatenate([np.linalg.cholesky(cov).T, -np.linalg.cholesky(cov).T])
            h = model.simulate(points)[:, rows]
            centre = h.mean(axis=0)
            Psi = (points - mean).T @ (h - centre) / (2 * n)
            A = Psi.T @ np.linalg.inv(cov)
            Omega = (h - centre).T @ (h - centre) / (2 * n) - A @ cov @ A.T
            S = A @ P @ A.T + Omega + variance * np.eye(len(rows))
            K = P @ A.T @ np.linalg.inv(S)
            mean, cov = x + K @ (z[rows] - (centre + A @ (x - mean))), P - K @ S @ K.T
        x, P = mean, (cov + cov.T) / 2
    return x, P


def test_posterior_linearization_has_the_fixed_point_of_the_textbook():
    """Damping and the order of the loops change the way, not the end. The bend is symmetric about the mean, so that
    Cholesky's square root and ours give the same regression to second order."""
    problem, trials = bent(0.05, 0.1, 6)
    found = IPLF(tolerance=1e-9, max_iterations=300).estimate(problem, trials.z)
    for z, x_found, P_found in zip(trials.z, found.x, found.covariance, strict=True):
        x, P = textbook_iplf(problem.measurement, z, 0.01, 60)
        np.testing.assert_allclose(x_found / np.sqrt(np.diag(P)), x / np.sqrt(np.diag(P)), atol=0.02)
        np.testing.assert_allclose(np.sqrt(np.diag(P_found)), np.sqrt(np.diag(P)), rtol=0.02)


def test_filters_reach_far_on_gins():
    """All of them find every trial at scale 300, and posterior linearisation at 1000 as well."""
    block = gins(300.0, 6)
    for estimator in FILTERS:
        _, score = block.estimate(estimator)
        assert score["success"].all()
    block = gins(1000.0, 6)
    _, score = block.estimate(IPLF())
    assert score["success"].mean() > 0.9


@pytest.mark.parametrize(
    ("estimator", "options"),
    [
        (RecursiveUpdate, ("steps", "first", "prior_inflation")),
        (LMIEKF, ("max_iterations", "tolerance", "damping")),
        (IPLF, ("max_iterations", "inner_iterations", "tolerance")),
    ],
)
def test_mistakes_are_named(estimator, options):
    for option in options:
        with pytest.raises(UserError, match=rf"^{option}=0"):
            estimator(**{option: 0})


def test_the_square_root_does_not_matter_to_the_belief():
    """P = U^-1 U^-T and its update, by the inverse of the sum of informations."""
    rng = np.random.default_rng(3)
    U, J = rng.standard_normal((5, 3, 3)), rng.standard_normal((5, 2, 3))
    mean, at, r = rng.standard_normal((5, 3)), rng.standard_normal((5, 3)), rng.standard_normal((5, 2))
    after, innovations = Belief(mean, U).given(J, r, at)
    for k in range(5):
        information = U[k].T @ U[k]
        P = np.linalg.inv(information)
        y = r[k] + J[k] @ (mean[k] - at[k])
        S = J[k] @ P @ J[k].T + np.eye(2)
        np.testing.assert_allclose(after.U[k].T @ after.U[k], information + J[k].T @ J[k], atol=1e-9)
        np.testing.assert_allclose(after.mean[k], mean[k] - P @ J[k].T @ np.linalg.solve(S, y), rtol=1e-6, atol=1e-8)
        assert innovations[k] == pytest.approx(y @ np.linalg.solve(S, y))
    assert multiply(after.U, after.mean).shape == (5, 3)
