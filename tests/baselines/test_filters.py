"""The filters against closed forms, textbook loops and the batch answer on GINS, and against themselves one trial at a
time."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
import pytest
from linear_models import Linear, LinearGins, linear_map
from scipy.optimize import least_squares
from scipy.stats import chi2
from small_models import Bent

from ipe_bench.baselines import CKF, EKF, IPLF, LMIEKF, UKF, EnKF, IteratedEKF, RecursiveUpdate
from ipe_bench.baselines.ekf import EKFTrack
from ipe_bench.baselines.epochs import arrivals
from ipe_bench.baselines.information import Belief, EpochReadings, InformationFilter
from ipe_bench.baselines.iplf import Affine
from ipe_bench.baselines.recursive_update import geometric_weights
from ipe_bench.baselines.sequential import Sequential
from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Covariance, information, inverse, multiply, quadratic_form
from ipe_bench.basics.statuses import Status
from ipe_bench.measurements.base import SubsetModel
from ipe_bench.measurements.counted import EvaluationCount
from ipe_bench.measurements.gins import Gins
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import Gaussian, Quantization
from ipe_bench.priors import GaussianPrior
from ipe_bench.statistics.consistency import mean_limits
from ipe_bench.trials.scenario import Scenario
from ipe_bench.trials.scoring import Block, nees

FILTERS: list[Sequential] = [EKF(), IteratedEKF(), UKF(), CKF(), EnKF(members=30)]
INFORMATION: list[InformationFilter] = [RecursiveUpdate(), LMIEKF(), IPLF()]
KALMAN = [f for f in FILTERS if not isinstance(f, EnKF)]
FOOT = 0.3048


def label(estimator: object) -> str:
    return type(estimator).__name__


def deviations(P):
    return np.sqrt(np.diagonal(P, axis1=-2, axis2=-1))


def gins(scale: float, trials: int, seed: int = 0):
    scenario = Scenario(Gins(), Quantization(0.075 * FOOT), GaussianPrior(), scale, seed)
    return scenario.problem, scenario.draw(0, trials)


def maximum_a_posteriori(problem: Problem, z, x):
    """The MAP of each trial and its covariance, by Gauss-Newton from x."""
    assert problem.prior_deviation is not None
    P0_inverse = np.diag(problem.prior_deviation**-2.0)
    for _ in range(8):
        J = problem.R.whiten_jacobian(problem.measurement.jacobian(x))
        r = problem.R.whiten(z - problem.measurement.simulate(x))
        P = inverse(np.matmul(J.swapaxes(1, 2), J) + P0_inverse)[0]
        gradient = multiply(J.swapaxes(1, 2), r) - multiply(P0_inverse, x - problem.x0)
        x = x + multiply(P, gradient)
    assert np.all(np.abs(multiply(P, gradient)) < 1e-6 * deviations(P))
    return x, P


# Against closed forms


EXACT = [(EKF(), 1e-8), (IteratedEKF(), 1e-8), (UKF(), 1e-6), (CKF(), 1e-6)]


@pytest.mark.parametrize(
    ("estimator", "apart", "scale"),
    [(one, apart, scale) for one, apart in EXACT for scale in (1.0, 10.0)]
    + [(one, 1e-6, scale) for one in INFORMATION for scale in (1.0, 100.0)],
    ids=str,
)
@pytest.mark.parametrize("model", [Linear(), LinearGins()], ids=label)
def test_on_a_linear_model_a_filter_is_the_batch_map(model, estimator, apart, scale):
    scenario = Scenario(model, Gaussian(0.0066), GaussianPrior(), scale)
    problem, trials = scenario.problem, scenario.draw(0, 5)
    x, P = linear_map(problem, model.matrix, trials.z)
    found = estimator.estimate(problem, trials.z)
    assert (found.status == Status.CONVERGED).all()
    assert np.abs((found.x - x) / deviations(P)).max() < apart
    assert np.abs((found.covariance - P) / np.outer(deviations(P), deviations(P))).max() < apart


@pytest.mark.parametrize("estimator", [*KALMAN, *INFORMATION], ids=label)
def test_inflation_widens_the_prior(estimator):
    scenario = Scenario(Linear(), Gaussian(1.0), GaussianPrior(), 0.5)
    problem, trials = scenario.problem, scenario.draw(0, 3)
    x, P = linear_map(problem, Linear().matrix, trials.z, inflation=3.0)
    found = replace(estimator, prior_inflation=3.0).estimate(problem, trials.z)
    assert found.x == pytest.approx(x, abs=1e-8)
    assert found.covariance[0] == pytest.approx(P, abs=1e-8)


@pytest.mark.parametrize("estimator", KALMAN, ids=label)
def test_process_noise_is_added_before_each_epoch(estimator):
    """Two readings of one constant that walks: the scalar Kalman filter by hand."""
    model = Linear(sizes=(1, 1, 1), unknowns=2)
    d, q, R = 2.0, 0.3, 0.5**2
    problem = Problem(model, Covariance(np.full(3, np.sqrt(R))), np.full(2, d))
    z = np.array([[1.0, -2.0, 4.0]])
    x, P = problem.x0, np.eye(2) * d**2
    for (row,) in model.epochs:
        P = P + np.eye(2) * (q * d) ** 2
        H = model.matrix[[row]]
        K = P @ H.T / (H @ P @ H.T + R)
        x, P = x + K @ (z[0, [row]] - H @ x), P - K @ H @ P
    found = replace(estimator, process_noise=q).estimate(problem, z)
    assert found.x[0] == pytest.approx(x, abs=1e-9)
    assert found.covariance[0] == pytest.approx(P, abs=1e-9)


def test_ensemble_tends_to_the_kalman_filter():
    scenario = Scenario(Linear(), Gaussian(1.0), GaussianPrior(), 1.0)
    problem, trials = scenario.problem, scenario.draw(0, 4)
    x, P = linear_map(problem, Linear().matrix, trials.z)
    apart = []
    for members in (100, 6400):
        found = EnKF(members=members).estimate(problem, trials.z)
        apart.append(np.sqrt(np.mean(((found.x - x) / deviations(P)) ** 2)))
    assert apart[1] < 5 / np.sqrt(6400)
    assert apart[1] < apart[0] / 2


@pytest.mark.parametrize("estimator", [*FILTERS, *INFORMATION], ids=label)
def test_readings_correlated_within_an_epoch(estimator):
    model = Linear(sizes=(3, 4), unknowns=2)
    R = np.eye(7)
    for rows in model.epochs:
        R[np.ix_(rows, rows)] += 0.8
    problem = Problem(model, Covariance(np.linalg.cholesky(R)), np.ones(2))
    z = np.linspace(-2.0, 3.0, 7)[None]
    x, P = linear_map(problem, model.matrix, z)
    found = (replace(estimator, members=4000) if isinstance(estimator, EnKF) else estimator).estimate(problem, z)
    apart = 0.1 if isinstance(estimator, EnKF) else 1e-9
    assert np.abs((found.x[0] - x[0]) / deviations(P)).max() < apart


@pytest.mark.parametrize("estimator", [EKF(), *INFORMATION], ids=label)
def test_readings_correlated_between_epochs_are_refused(estimator):
    model = Linear(sizes=(3, 4), unknowns=2)
    problem = Problem(model, Covariance(np.linalg.cholesky(np.eye(7) + 0.1)), np.ones(2))
    with pytest.raises(UserError, match="correlated between epochs"):
        estimator.estimate(problem, np.zeros((1, 7)))


@pytest.mark.parametrize("estimator", [*FILTERS, *INFORMATION], ids=label)
def test_nis_is_chi_square_on_a_linear_model(estimator):
    """The innovations of a Kalman filter are white, so their squares over m have the limits of chi-square."""
    model = Linear()
    scenario = Scenario(model, Gaussian(0.7), GaussianPrior(), 1.0)
    found = estimator.estimate(scenario.problem, scenario.draw(0, 200).z)
    low, high = mean_limits(model.m, 200, 0.999)
    if isinstance(estimator, EnKF):  # 30 members make a poor S
        low, high = 0.8 * low, 1.2 * high
    assert low < found.extras["nis"].mean() < high


# On GINS


@pytest.mark.parametrize("estimator", KALMAN, ids=label)
def test_gins_at_scale_10_is_near_the_map_and_consistent(estimator):
    problem, trials = gins(10.0, 50)
    x, P = maximum_a_posteriori(problem, trials.z, trials.x)
    found = estimator.estimate(problem, trials.z)
    assert np.sqrt(np.mean(((found.x - x) / deviations(P)) ** 2)) < 0.02
    low, high = mean_limits(11, 50, 0.999)
    assert low < nees(found.x - trials.x, found.covariance).mean() / 11 < high
    low, high = mean_limits(240, 50, 0.999)
    assert low < found.extras["nis"].mean() < high


def success(estimator, problem, trials):
    """The share of trials inside the gate of the Bayesian bound."""
    J = problem.measurement.jacobian(trials.x)
    bound = information(J, problem.R) + np.diag(problem.prior_deviation**-2.0)
    found = estimator.estimate(problem, trials.z)
    return np.mean(quadratic_form(bound, found.x - trials.x) <= chi2.isf(1e-6, 11))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scale", "extended", "iterated"),
    [(300.0, (0.32, 0.45), (0.99, 1.0)), (600.0, (0.02, 0.08), (0.93, 1.0)), (1000.0, (0.0, 0.03), (0.72, 0.9))],
)
def test_where_linearising_once_fails_and_iterating_holds(scale, extended, iterated):
    problem, trials = gins(scale, 400)
    assert extended[0] <= success(EKF(), problem, trials) <= extended[1]
    assert iterated[0] <= success(IteratedEKF(), problem, trials) <= iterated[1]


@pytest.mark.slow
@pytest.mark.parametrize(("estimator", "seconds"), [(EKF(), 20.0), (UKF(), 30.0)], ids=["ekf", "ukf"])
def test_a_thousand_gins_trials_in_time(estimator, seconds):
    """In CPU seconds of all threads together, which other work on the machine does not change by much."""
    problem, trials = gins(10.0, 1000)
    began = time.process_time()
    found = estimator.estimate(problem, trials.z)
    assert time.process_time() - began < seconds
    assert (found.status == Status.CONVERGED).all()


# The contract


@pytest.mark.parametrize("estimator", FILTERS, ids=label)
def test_a_batch_is_its_trials_one_by_one_bit_for_bit(estimator):
    model = Gins(readings_per_case=4)
    scenario = Scenario(model, Quantization(0.075 * FOOT), GaussianPrior(), 30.0)
    problem, z = scenario.problem, scenario.draw(0, 7).z
    together = estimator.estimate(problem, z, history=True)
    assert together.history is not None
    for i in range(len(z)):
        alone = estimator.estimate(problem, z[[i]], history=True)
        assert alone.history is not None
        for name in ("x", "status", "covariance", "iterations", "simulations", "jacobians"):
            assert np.array_equal(getattr(alone, name)[0], getattr(together, name)[i], equal_nan=True), name
        assert alone.extras["nis"][0] == together.extras["nis"][i]
        assert np.array_equal(alone.history[0], together.history[i])


@pytest.mark.parametrize("estimator", FILTERS, ids=label)
def test_history_holds_the_estimate_after_each_epoch(estimator):
    scenario = Scenario(Linear(), Gaussian(1.0), GaussianPrior(), 1.0)
    found = estimator.estimate(scenario.problem, scenario.draw(0, 3).z, history=True)
    assert (found.iterations == 4).all()
    for x, rows in zip(found.x, found.history, strict=True):
        assert rows.shape == (5, 4)
        assert np.array_equal(rows[0], Linear().nominal)
        assert np.array_equal(rows[-1], x)


@pytest.mark.parametrize(
    ("estimator", "simulations", "jacobians"),
    [(EKF(), 1, 1), (IteratedEKF(), 2, 2), (UKF(), 9, 0), (CKF(), 8, 0), (EnKF(members=30), 30, 0)],
    ids=label,
)
def test_a_prefix_costs_its_share(estimator, simulations, jacobians):
    """(1 + 2 + 3 + 4) / 4 evaluations per point. On a linear model the iterated EKF looks twice, to see it is done."""
    scenario = Scenario(Linear(), Gaussian(1.0), GaussianPrior(), 1.0)
    found = estimator.estimate(scenario.problem, scenario.draw(0, 3).z)
    assert found.simulations == pytest.approx(2.5 * simulations)
    assert found.jacobians == pytest.approx(2.5 * jacobians)


@pytest.mark.parametrize("kept", [tuple(range(11)), (0, 2, 3, 5, 6, 7, 9)], ids=["all readings", "some missing"])
def test_nothing_is_computed_beyond_the_epoch_at_hand(kept):
    whole = Linear()
    model = whole if len(kept) == whole.m else SubsetModel(whole, kept)
    problem = Problem(model, Covariance(np.ones(model.m)), np.ones(4))
    z = np.random.default_rng(1).standard_normal((2, model.m))
    found = UKF().estimate(problem, z)
    assert whole.stops == [k for k, rows in enumerate(whole.epochs, start=1) if set(rows) & set(kept)]
    x, _ = linear_map(problem, whole.matrix[list(kept)], z)
    assert found.x == pytest.approx(x, abs=1e-9)


@dataclass(frozen=True)
class Fragile(Linear):
    """Raises above 1e6 and overflows below -1e6."""

    def simulate_until(self, x, stop):
        if (x[:, 0] > 1e6).any():
            raise FloatingPointError("too far")
        h = super().simulate_until(x, stop)
        h[x[:, 0] < -1e6] = np.inf
        return h


@dataclass(frozen=True)
class Brittle(EKF):
    """Its matrices are singular where the first reading is 7."""

    def track(self, P0, Q, z):
        return BrittleTrack(P0, Q) if z[0] == 7.0 else super().track(P0, Q, z)


class BrittleTrack(EKFTrack):
    def update(self, z, h, H):
        raise np.linalg.LinAlgError("singular matrix")


@pytest.mark.parametrize("estimator", [*FILTERS, Brittle()], ids=label)
def test_a_trial_that_fails_has_a_status_and_disturbs_no_other(estimator):
    model = Fragile()
    problem = Problem(model, Covariance(np.ones(model.m)), np.ones(4))
    good = np.random.default_rng(1).standard_normal((2, model.m))
    raising = (model.matrix @ [1e8, 0, 0, 0])[None]
    missing = good[[0]].copy()
    missing[0, 4] = np.nan
    rows = [good[[0]], raising, -raising, missing, good[[1]]]
    expected = [Status.CONVERGED, Status.ERROR, Status.NONFINITE, Status.NONFINITE, Status.CONVERGED]
    if isinstance(estimator, Brittle):
        good[1, 0] = 7.0
        rows[-1], expected[-1] = good[[1]], Status.SINGULAR
    found = estimator.estimate(problem, np.concatenate(rows))
    assert [Status(s) for s in found.status] == expected
    assert found.messages[1] == "FloatingPointError: too far"
    assert found.messages[3] == "reading 5 is not a finite number"
    assert set(found.messages) == {i for i, s in enumerate(expected) if s != Status.CONVERGED}
    for i in np.flatnonzero(found.status == Status.CONVERGED):
        alone = estimator.estimate(problem, rows[i])
        assert np.array_equal(found.x[i], alone.x[0])
        assert np.array_equal(found.covariance[i], alone.covariance[0])


def test_a_huge_reading_overflows_into_a_status():
    model = Linear()
    problem = Problem(model, Covariance(np.ones(model.m)), np.ones(4))
    for estimator in FILTERS:
        found = estimator.estimate(problem, np.full((1, model.m), 1e308))
        assert found.status[0] != Status.CONVERGED


@pytest.mark.parametrize("estimator", [*FILTERS, *INFORMATION], ids=label)
def test_needs_epochs_and_a_prior(estimator):
    model = Linear()
    problem = Problem(model, Covariance(np.ones(model.m)))
    assert estimator.missing(problem) == ["prior"]
    with pytest.raises(UserError, match="has no prior"):
        estimator.estimate(problem, np.zeros((1, model.m)))


@pytest.mark.parametrize(
    ("kind", "option"),
    [
        (EKF, {"prior_inflation": 0.0}),
        (EKF, {"process_noise": -1.0}),
        (IteratedEKF, {"max_iterations": 0}),
        (IteratedEKF, {"tolerance": 0.0}),
        (UKF, {"alpha": 0.0}),
        (UKF, {"kappa": -3.0}),
        (EnKF, {"members": 1}),
        (EnKF, {"seed": -1}),
    ],
)
def test_a_wrong_option_is_named(kind, option):
    ((key, value),) = option.items()
    with pytest.raises(UserError, match=f"^{key}={value}: give"):
        kind(**option)


def test_the_ensemble_leaves_the_global_random_state_alone():
    scenario = Scenario(Linear(), Gaussian(1.0), GaussianPrior(), 1.0)
    problem, z = scenario.problem, scenario.draw(0, 2).z
    np.random.seed(1)  # noqa: NPY002
    expected = np.random.standard_normal(5)  # noqa: NPY002
    np.random.seed(1)  # noqa: NPY002
    first = np.random.standard_normal(1)  # noqa: NPY002  leaves the second number of a pair waiting
    once = EnKF(members=10).estimate(problem, z)
    assert np.array_equal(np.concatenate([first, np.random.standard_normal(4)]), expected)  # noqa: NPY002
    assert np.array_equal(once.x, EnKF(members=10).estimate(problem, z).x)
    assert not np.array_equal(once.x, EnKF(members=10, seed=1).estimate(problem, z).x)


# The square-root information form


def bent(bend: float, deviation: float, trials: int):
    """Epochs of three readings, mildly nonlinear."""
    scenario = Scenario(Bent(bend), Gaussian(deviation), GaussianPrior(), 1.0, seed=2)
    return scenario.problem, scenario.draw(0, trials)


def block_of_gins(scale: float, trials: int, seed: int = 91):
    return Block.draw(Scenario(Gins(), Quantization(0.02286), GaussianPrior(), scale, seed), 0, trials)


@pytest.mark.parametrize("estimator", INFORMATION, ids=label)
def test_missing_readings_are_as_if_they_had_never_been_taken(estimator):
    model, kept = Linear(), (0, 2, 3, 5, 6, 8, 9)
    problem = Problem(SubsetModel(model, kept), Covariance(np.full(7, 0.3)), np.ones(4))
    z = np.linspace(-2.0, 3.0, 7)[None]
    whole = Linear()
    A, b = whole.matrix[list(kept)] / 0.3, (z[0] - whole.matrix[list(kept)] @ whole.nominal) / 0.3
    x = whole.nominal + np.linalg.solve(A.T @ A + np.eye(4), A.T @ b)
    np.testing.assert_allclose(estimator.estimate(problem, z).x[0], x, atol=1e-9)


@pytest.mark.parametrize("estimator", INFORMATION, ids=label)
def test_a_trial_that_an_information_filter_loses_disturbs_no_other(estimator):
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


@pytest.mark.parametrize("estimator", INFORMATION, ids=label)
def test_a_batch_of_gins_is_its_trials(estimator):
    block = block_of_gins(300.0, 3)
    whole = estimator.estimate(block.problem, block.trials.z, history=True)
    for i, z in enumerate(block.trials.z):
        alone = estimator.estimate(block.problem, z[None])
        np.testing.assert_array_equal(whole.x[i], alone.x[0])
        np.testing.assert_array_equal(whole.covariance[i], alone.covariance[0])
        assert whole.history[i].shape == (31, 11)


def test_one_recursive_step_is_the_extended_kalman_filter():
    """filterpy's EKF in Joseph's form, an independent implementation of the algebra."""
    block = block_of_gins(30.0, 10)
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
    block = block_of_gins(100.0, 10)
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
    block = block_of_gins(300.0, 6)
    for estimator in INFORMATION:
        _, score = block.estimate(estimator)
        assert score["success"].all()
    block = block_of_gins(1000.0, 6)
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
def test_a_wrong_option_of_an_information_filter_is_named(estimator, options):
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
