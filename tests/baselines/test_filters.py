"""The filters against closed forms, textbook loops and the batch answer on GINS, and against
themselves one trial at a time."""

from dataclasses import dataclass, replace

import filterpy.stats
import numpy as np
import pytest
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter
from shared.families import slow_if
from shared.linear_models import Linear, LinearGins, block_of_gins, linear_map
from shared.oracles import agreed, assert_agrees
from shared.small_models import Bent

from ipe_bench.baselines import CKF, EKF, IPLF, UKF, EnKF, IteratedEKF
from ipe_bench.baselines.information import InformationFilter
from ipe_bench.baselines.sequential import Sequential
from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Covariance, deviations, inverse, multiply
from ipe_bench.basics.statuses import Status
from ipe_bench.measurements.gins import Gins
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import Gaussian, Quantization
from ipe_bench.priors import GaussianPrior
from ipe_bench.statistics.intervals import mean_limits
from ipe_bench.trials.scenario import Scenario
from ipe_bench.trials.scoring import nees

KALMAN: list[Sequential] = [EKF(), IteratedEKF(), UKF(), CKF()]
BATCHED = [replace(f, engine="batched") for f in KALMAN]
FILTERS = [*KALMAN, EnKF(members=30)]
INFORMATION: list[InformationFilter] = [IPLF()]


def label(estimator: object) -> str:
    return type(estimator).__name__


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

MAPS = [
    (one, 1e-8 if one in (EKF(), IteratedEKF()) else 1e-6, scale)
    for one in (*KALMAN, *BATCHED)
    for scale in (1.0, 10.0)
]
MAPS += [(one, 1e-6, scale) for one in INFORMATION for scale in (1.0, 100.0)]


@pytest.mark.oracle(
    "closed form: posterior of a linear model",
    "estimates and covariances, in standard deviations",
    1e-6,
)
@pytest.mark.parametrize(
    ("model", "estimator", "apart", "scale"),
    slow_if(
        lambda model, one, *_: isinstance(model, LinearGins) and one == CKF(),
        ((model, *case) for model in (Linear(), LinearGins()) for case in MAPS),
    ),
    ids=lambda given: label(given) if isinstance(given, (Linear, Gins)) else str(given),
)
def test_on_a_linear_model_a_filter_is_the_batch_map(model, estimator, apart, scale):
    scenario = Scenario(model, Gaussian(0.0066), GaussianPrior(), scale)
    problem, trials = scenario.problem, scenario.draw(0, 5)
    x, P = linear_map(problem, model.matrix, trials.z)
    found = estimator.estimate(problem, trials.z)
    assert (found.status == Status.CONVERGED).all()
    agreed(np.abs((found.x - x) / deviations(P)), apart)
    agreed(np.abs((found.covariance - P) / np.outer(deviations(P), deviations(P))), apart)


def test_ensemble_tends_to_the_kalman_filter():
    scenario = Scenario(Linear(), Gaussian(0.5), GaussianPrior(), 1.0)
    problem, trials = scenario.problem, scenario.draw(0, 6)
    x, P = linear_map(problem, Linear().matrix, trials.z)
    few, many = (EnKF(members=members).estimate(problem, trials.z) for members in (100, 6400))
    apart = [np.sqrt(np.mean(((found.x - x) / deviations(P)) ** 2)) for found in (few, many)]
    assert apart[1] < 5 / np.sqrt(6400)
    assert apart[1] < apart[0] / 2
    assert np.abs(deviations(many.covariance) / deviations(P) - 1).max() < 0.1


@pytest.mark.parametrize("estimator", [*FILTERS, *INFORMATION], ids=label)
def test_readings_correlated_within_an_epoch(estimator):
    model = Linear(sizes=(3, 4), unknowns=2)
    R = np.eye(7)
    for rows in model.epochs:
        R[np.ix_(rows, rows)] += 0.8
    problem = Problem(model, Covariance(np.linalg.cholesky(R)), np.ones(2))
    z = np.linspace(-2.0, 3.0, 7)[None]
    x, P = linear_map(problem, model.matrix, z)
    found = (
        replace(estimator, members=4000) if isinstance(estimator, EnKF) else estimator
    ).estimate(problem, z)
    apart = 0.1 if isinstance(estimator, EnKF) else 1e-9
    assert np.abs((found.x[0] - x[0]) / deviations(P)).max() < apart


@pytest.mark.parametrize("estimator", [EKF(), *INFORMATION], ids=label)
def test_readings_correlated_between_epochs_are_refused(estimator):
    model = Linear(sizes=(3, 4), unknowns=2)
    problem = Problem(model, Covariance(np.linalg.cholesky(np.eye(7) + 0.1)), np.ones(2))
    with pytest.raises(UserError, match="correlated between epochs"):
        estimator.estimate(problem, np.zeros((1, 7)))


@pytest.mark.parametrize(
    "estimator",
    slow_if(lambda one: isinstance(one, (CKF, IPLF)), [*FILTERS, *INFORMATION]),
    ids=label,
)
def test_nis_is_chi_square_on_a_linear_model(estimator):
    """The innovations of a Kalman filter are white, so their squares over m have the limits of
    chi-square."""
    model = Linear()
    scenario = Scenario(model, Gaussian(0.7), GaussianPrior(), 1.0)
    found = estimator.estimate(scenario.problem, scenario.draw(0, 200).z)
    low, high = mean_limits(model.m, 200, 0.999)
    if isinstance(estimator, EnKF):  # 30 members make a poor S
        low, high = 0.8 * low, 1.2 * high
    assert low < found.extras["nis"].mean() < high


# On GINS


@pytest.mark.slow
@pytest.mark.parametrize("estimator", KALMAN, ids=label)
def test_gins_at_scale_10_is_near_the_map_and_consistent(estimator):
    block = block_of_gins(10.0, 50)
    problem, trials = block.problem, block.trials
    x, P = maximum_a_posteriori(problem, trials.z, trials.x)
    found = estimator.estimate(problem, trials.z)
    assert np.sqrt(np.mean(((found.x - x) / deviations(P)) ** 2)) < 0.02
    low, high = mean_limits(11, 50, 0.999)
    assert low < nees(found.x - trials.x, found.covariance).mean() / 11 < high
    low, high = mean_limits(240, 50, 0.999)
    assert low < found.extras["nis"].mean() < high


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scale", "extended", "iterated"),
    [
        (300.0, (0.32, 0.45), (0.99, 1.0)),
        (600.0, (0.02, 0.08), (0.93, 1.0)),
        (1000.0, (0.0, 0.03), (0.72, 0.9)),
    ],
)
def test_where_linearising_once_fails_and_iterating_holds(scale, extended, iterated):
    block = block_of_gins(scale, 400)
    once, again = (
        block.estimate(estimator)[1]["success"].mean() for estimator in (EKF(), IteratedEKF())
    )
    assert extended[0] <= once <= extended[1]
    assert iterated[0] <= again <= iterated[1]


LINEAR = Scenario(Linear(), Gaussian(0.1), GaussianPrior(), 3.0)
ALIKE = [(LINEAR, {}), (LINEAR, {"process_noise": 0.1}), (LINEAR, {"prior_inflation": 2.0})]
DEAR = CKF, IteratedEKF
"""Filters that filterpy computes slowly on many readings."""
ALIKE += [
    (Scenario(Gins(), Quantization(0.02286), GaussianPrior(), scale), {}) for scale in (10.0, 300.0)
]


@pytest.mark.oracle(
    "library: filterpy's EKF, UKF and CKF",
    "estimates and covariances, in the prior's standard deviations",
    1e-9,
)
@pytest.mark.parametrize(
    ("estimator", "scenario", "changes"),
    slow_if(
        lambda one, scenario, changes: isinstance(one, DEAR) and scenario is not LINEAR,
        ((one, *case) for one in KALMAN for case in ALIKE),
    ),
    ids=lambda given: getattr(given, "error_scale", getattr(given, "name", given)),
)
def test_the_batched_engine_is_filterpy_within_a_billionth_of_the_prior(
    estimator, scenario, changes
):
    d, z = scenario.problem.prior_deviation, scenario.draw(0, 5).z
    engines = (replace(estimator, engine=engine, **changes) for engine in ("filterpy", "batched"))
    one, other = (engine.estimate(scenario.problem, z, history=True) for engine in engines)
    for name in ("status", "simulations", "jacobians", "iterations"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert_agrees(other.x / d, one.x / d, atol=1e-9)
    assert_agrees(other.covariance / np.outer(d, d), one.covariance / np.outer(d, d), atol=1e-9)
    np.testing.assert_allclose(other.extras["nis"], one.extras["nis"], rtol=1e-7)
    for mine, theirs in zip(one.history, other.history, strict=True):
        # After the first epochs S is as ill-conditioned as the prior is wide, and both round.
        np.testing.assert_allclose(theirs / d, mine / d, rtol=0, atol=1e-7)


# The contract


@pytest.mark.oracle(
    "own second implementation: Kalman filter of one state", "estimates and covariance", 1e-9
)
@pytest.mark.parametrize("estimator", KALMAN, ids=label)
def test_process_noise_is_added_before_each_epoch(estimator):
    """Readings of one constant that walks: the scalar Kalman filter by hand."""
    model = Linear(sizes=(1, 1, 1), unknowns=2)
    d, q, R = 2.0, 0.3, 0.5**2
    problem = Problem(model, Covariance(np.full(3, np.sqrt(R))), np.full(2, d))
    z = np.array([[1.0, -2.0, 4.0]])
    x, P, path = problem.x0, np.eye(2) * d**2, [problem.x0]
    for (row,) in model.epochs:
        P = P + np.eye(2) * (q * d) ** 2
        H = model.matrix[[row]]
        K = P @ H.T / (H @ P @ H.T + R)
        x, P = x + K @ (z[0, [row]] - H @ x), P - K @ H @ P
        path.append(x)
    found = replace(estimator, process_noise=q).estimate(problem, z, history=True)
    assert_agrees(found.history[0], path, atol=1e-9)
    assert_agrees(found.x[0], x, atol=1e-9)
    assert_agrees(found.covariance[0], P, atol=1e-9)


@dataclass(frozen=True)
class Fragile(Linear):
    """Overflows beyond 1e6."""

    def simulate_until(self, x, stop):
        return np.where(np.abs(x[:, :1]) > 1e6, np.inf, super().simulate_until(x, stop))


@pytest.mark.parametrize("estimator", [*FILTERS, *BATCHED, IPLF()], ids=str)
def test_what_overflows_ends_its_own_trial(estimator):
    model = Fragile()
    problem = Problem(model, Covariance(np.ones(model.m)), np.ones(4))
    z = np.random.default_rng(1).standard_normal((3, model.m))
    z[1] = model.matrix @ [1e8, 0, 0, 0]
    found = estimator.estimate(problem, z)
    assert [Status(s) for s in found.status] == [
        Status.CONVERGED,
        Status.NONFINITE,
        Status.CONVERGED,
    ]
    assert set(found.messages) == {1}
    assert np.isnan(found.covariance[1]).all()
    z[1] = 1e308
    assert estimator.estimate(problem, z).status[1] != Status.CONVERGED


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


def textbook_iplf(model, z, variance, iterations):
    """García-Fernández et al.'s algorithm in covariance form, undamped, at the 2n points of the
    cubature rule."""
    n = 3
    x, P = np.zeros(n), np.eye(n)
    for rows in model.epochs:
        mean, cov = x, P
        for _ in range(iterations):
            points = mean + np.sqrt(n) * np.concatenate(
                [np.linalg.cholesky(cov).T, -np.linalg.cholesky(cov).T]
            )
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


@pytest.mark.oracle(
    "own second implementation: García-Fernández et al. (2015), in covariance form",
    "estimates and standard deviations, in standard deviations",
    0.02,
)
def test_posterior_linearization_has_the_fixed_point_of_the_textbook():
    """Damping and the order of the loops change the way, not the end. The bend is symmetric about
    the mean, so that Cholesky's square root and ours give the same regression to second order."""
    problem, trials = bent(0.05, 0.1, 6)
    found = IPLF(tolerance=1e-9, max_iterations=300).estimate(problem, trials.z)
    for z, x_found, P_found in zip(trials.z, found.x, found.covariance, strict=True):
        x, P = textbook_iplf(problem.measurement, z, 0.01, 60)
        assert_agrees(x_found / np.sqrt(np.diag(P)), x / np.sqrt(np.diag(P)), atol=0.02)
        assert_agrees(np.sqrt(np.diag(P_found)), np.sqrt(np.diag(P)), rtol=0.02)


@pytest.mark.slow
def test_filters_reach_far_on_gins():
    """All of them find every trial at scale 300, and posterior linearisation at 1000 as well."""
    block = block_of_gins(300.0, 6, 91)
    assert all(block.estimate(estimator)[1]["success"].all() for estimator in INFORMATION)
    block = block_of_gins(1000.0, 6, 91)
    assert block.estimate(IPLF())[1]["success"].mean() > 0.9


# What filterpy does when it is used as it stands, and that ours are not caught by it


def test_ukf_wants_the_hx_of_each_epoch():
    """One hx for all epochs, as the constructor takes it, gives another answer than the batch."""
    model = Linear(sizes=(3, 3), unknowns=4)
    problem = Problem(model, Covariance(np.ones(6)), np.ones(4))
    z = Scenario(Linear(), Gaussian(1.0), GaussianPrior(), 1.0).draw(0, 1).z[:, :6]
    x, P = linear_map(problem, model.matrix, z)
    first, second = model.epochs
    points = MerweScaledSigmaPoints(4, 0.1, 2.0, 0.0)
    naive = UnscentedKalmanFilter(
        4, 3, 1.0, lambda x: model.matrix[first] @ x, lambda x, dt: x, points
    )
    naive.x, naive.Q = model.nominal, np.zeros((4, 4))
    for rows in (first, second):
        naive.predict()
        naive.update(z[0, rows])
    deviation = np.sqrt(np.diag(P))
    assert np.abs((naive.x - x[0]) / deviation).max() > 0.1
    assert np.abs((UKF().estimate(problem, z).x - x) / deviation).max() < 1e-9


def test_ukf_with_a_small_alpha_loses_digits():
    model = LinearGins()
    scenario = Scenario(model, Gaussian(0.0066), GaussianPrior(), 10.0)
    problem, z = scenario.problem, scenario.draw(0, 5).z
    x, P = linear_map(problem, model.matrix, z)
    near, far = (UKF(alpha=a).estimate(problem, z) for a in (0.1, 1e-3))
    deviation = np.sqrt(np.diag(P))
    apart = np.abs((near.x - x) / deviation).max()
    assert apart < 1e-8
    lost = (far.status != Status.CONVERGED).any() or np.abs(
        (far.x - x) / deviation
    ).max() > 100 * apart
    assert lost


@pytest.mark.parametrize("estimator", [UKF(), CKF()], ids=["ukf", "ckf"])
def test_p_minus_ksk_cancels_where_the_prior_is_wide(estimator):
    """Prior deviations 1e5 times those of the posterior: filterpy as it stands, on the same sigma
    points, loses P."""
    model = Linear(sizes=(8, 8), unknowns=4)
    scenario = Scenario(model, Gaussian(1e-5), GaussianPrior(), 1.0)
    problem, z = scenario.problem, scenario.draw(0, 1).z
    x, P = linear_map(problem, model.matrix, z)
    deviation = np.sqrt(np.diag(P))
    assert deviation.max() < 1e-5

    points = MerweScaledSigmaPoints(4, 0.1, 2.0, 0.0)
    naive = UnscentedKalmanFilter(4, 8, 1.0, None, lambda x, dt: x, points)
    naive.x, naive.Q = model.nominal, np.zeros((4, 4))
    naive.compute_process_sigmas(1.0)
    rows = model.epochs[0]
    naive.update(z[0, rows], R=np.eye(8) * 1e-10, hx=lambda x: model.matrix[rows] @ x)
    H = model.matrix[rows]
    after_one = np.linalg.inv(H.T @ H * 1e10 + np.eye(4))
    scale = np.sqrt(np.outer(np.diag(after_one), np.diag(after_one)))
    assert np.abs((naive.P - after_one) / scale).max() > 1e-3

    found = estimator.estimate(problem, z)
    assert np.abs((found.x - x) / deviation).max() < 1e-4
    assert np.abs((found.covariance[0] - P) / np.outer(deviation, deviation)).max() < 1e-4


def test_nees_of_filterpy_has_no_limits():
    """Its numbers are ours; what they must lie between is ours alone."""
    rng = np.random.default_rng(2)
    A = rng.standard_normal((3, 3))
    P = A @ A.T
    error = rng.standard_normal((400, 3)) @ A.T
    theirs = filterpy.stats.NEES(error, np.zeros_like(error), [P] * 400)
    assert isinstance(theirs, list)
    ours = nees(error, np.repeat(P[None], 400, axis=0))
    assert ours == pytest.approx(theirs)
    low, high = mean_limits(3, 400)
    assert low < ours.mean() / 3 < high
