"""Batch least squares, re-linearised and progressive IPE against SciPy, closed forms and the truth."""

from fractions import Fraction

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2
from small_models import Bent

from ipe_bench.baselines import GaussNewton, LevenbergMarquardt, MapLM
from ipe_bench.basics.linalg import Array, Covariance, information, inverse, quadratic_form
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.least_squares import NormalEquations
from ipe_bench.measurements import Gins, Mgh, Polynomial
from ipe_bench.measurements.mgh import score
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import Certified, Gaussian, Quantization
from ipe_bench.priors import GaussianPrior
from ipe_bench.solvers import FixedPoint, Newton, Progressive, Relinearized
from ipe_bench.trials.roots import least_squares_root
from ipe_bench.trials.scenario import Scenario

LEAST_SQUARES = [
    GaussNewton(),
    GaussNewton(damping=1e-3),
    LevenbergMarquardt(),
    Relinearized(),
    Relinearized(Newton()),
    Progressive(),
    Progressive(use_prior=False),
]
ALL = [*LEAST_SQUARES, MapLM()]


def gins(scale: float, trials: int = 20, model: Gins | None = None):
    scenario = Scenario(model or Gins(), Quantization(0.02286), GaussianPrior(), scale)
    return scenario.problem, scenario.draw(0, trials)


def crlb(problem: Problem, x: Array) -> Array:
    return inverse(information(problem.measurement.jacobian(x), problem.R))[0]


def deviations(P: Array) -> Array:
    return np.sqrt(np.diagonal(P, axis1=1, axis2=2))


@pytest.mark.parametrize("estimator", LEAST_SQUARES, ids=repr)
def test_the_minimum_is_that_of_scipy(estimator):
    scenario = Scenario(Polynomial(strength=0.02), Gaussian(0.1), GaussianPrior(), 3.0)
    problem, trials = scenario.problem, scenario.draw(0, 6)
    estimates = estimator.estimate(problem, trials.z)
    assert (estimates.status == Status.CONVERGED).all()
    for x, P, z in zip(estimates.x, estimates.covariance, trials.z, strict=True):

        def residual(x, z=z):
            return problem.R.whiten(problem.measurement.simulate(x[None])[0] - z)

        found = least_squares(residual, problem.x0, jac="3-point", xtol=1e-15, ftol=1e-15, gtol=1e-12)
        assert np.abs(x - found.x).max() < 1e-6
        np.testing.assert_allclose(P, np.linalg.inv(found.jac.T @ found.jac), rtol=1e-4)


def exact_inverse_of_normal_matrix(J: Array) -> Array:
    """(J' J)^-1 (n, n) in rational numbers, by elimination."""
    exact, n = np.vectorize(Fraction)(J), J.shape[1]
    table = np.concatenate([exact.T @ exact, np.vectorize(Fraction)(np.eye(n))], axis=1)
    for i in range(n):
        table[i] /= table[i, i]
        for j in set(range(n)) - {i}:
            table[j] -= table[j, i] * table[i]
    return table[:, n:]


def test_a_step_is_exact_however_badly_conditioned_the_jacobian_is():
    """Beside rational numbers, for conditions of 10 to 1e7 and columns of sizes 1e-100 to 1e100."""
    rng = np.random.default_rng(1)
    for condition in 10.0 ** np.arange(1, 8):
        left, right = (np.linalg.qr(rng.standard_normal((k, 5)))[0] for k in (40, 5))
        J, r = left * np.geomspace(1, 1 / condition, 5) @ right, rng.standard_normal(40)
        sizes = 10.0 ** np.linspace(-100, 100, 5)
        slope = NormalEquations.of((J * sizes)[None], r[None], keep_Q=True)
        P = exact_inverse_of_normal_matrix(J)
        step = -P @ (np.vectorize(Fraction)(J).T @ np.vectorize(Fraction)(r))
        step, deviation = step.astype(float), np.sqrt(np.diag(P).astype(float))
        np.testing.assert_allclose(slope.newton[0] * sizes / deviation, step / deviation, atol=1e-8)
        assert slope.size[0] == pytest.approx(np.abs(step / deviation).max(), rel=1e-8)
        np.testing.assert_allclose(slope.Q[0] @ slope.U[0] / sizes, J, atol=1e-12)


def test_trials_without_full_rank_do_not_disturb_others():
    J, r = np.random.default_rng(2).standard_normal((2, 5, 9, 3))[0], np.ones((5, 9))
    alone = NormalEquations.of(J[:1], r[:1])
    J[1, :, 2] = J[1, :, 1]
    J[2, 4, 1] = np.nan
    J[3] = 0.0
    J[4] *= 1e150
    slope = NormalEquations.of(J, r)
    np.testing.assert_array_equal(slope.newton[0], alone.newton[0])
    np.testing.assert_array_equal(np.isfinite(slope.size), [True, False, False, False, True])


def test_one_inner_fixed_point_step_is_gauss_newton():
    problem, trials = gins(100.0, 5, Gins(step=60.0))  # with a fixed step all Jacobians are exact
    rounds = Relinearized(FixedPoint(), inner_iterations=1).estimate(problem, trials.z, history=True)
    steps = GaussNewton().estimate(problem, trials.z, history=True)
    for a, b, P in zip(rounds.history, steps.history, steps.covariance, strict=True):
        k = min(len(a), len(b))
        assert k >= 3
        assert (np.abs(a[:k] - b[:k]) / np.sqrt(np.diag(P))).max() < 1e-5


def test_relinearized_ipe_is_least_squares_at_scale_200():
    problem, trials = gins(200.0, 100)
    estimates = Relinearized().estimate(problem, trials.z)
    root = least_squares_root(problem, trials.z, trials.x, prior=None)
    deviation = deviations(crlb(problem, trials.x))
    apart = np.abs(estimates.x - root) / deviation
    solved = (estimates.status == Status.CONVERGED) & (apart.max(axis=1) < 1e-3)
    assert solved.mean() > 0.95
    assert np.sqrt(np.mean(apart[solved] ** 2)) < 0.01


@pytest.mark.parametrize(
    "estimator", [Progressive(), Progressive(prior_inflation=10.0), Progressive(use_prior=False)], ids=repr
)
def test_progressive_ipe_succeeds_at_scale_600_within_250_simulations(estimator):
    problem, trials = gins(600.0, 40)
    estimates = estimator.estimate(problem, trials.z)
    distance = quadratic_form(information(problem.measurement.jacobian(trials.x), problem.R), estimates.x - trials.x)
    assert (distance < chi2.isf(1e-6, 11)).all()
    assert (estimates.extras["fit_p"] > 1e-6).all()
    assert np.median(estimates.simulations + 11 * estimates.jacobians) <= 250


@pytest.mark.slow
@pytest.mark.parametrize(("scale", "share"), [(1000.0, 1.0), (3000.0, 0.98)])
def test_progressive_ipe_from_far_away(scale, share):
    problem, trials = gins(scale, 250)
    estimates = Progressive().estimate(problem, trials.z)
    distance = quadratic_form(information(problem.measurement.jacobian(trials.x), problem.R), estimates.x - trials.x)
    success = distance < chi2.isf(1e-6, 11)
    assert success.mean() >= share
    # Its own verdict is right.
    np.testing.assert_array_equal(estimates.extras["fit_p"] > 1e-6, success)
    assert np.median(estimates.simulations + 11 * estimates.jacobians) <= 250


@pytest.mark.slow
def test_candidates_that_differ_find_what_a_common_prior_hides():
    """Trials whose first windows have a second minimum of the same depth, to which the prior draws every candidate."""
    scenario = Scenario(Gins(), Quantization(0.02286), GaussianPrior(), 5000.0)
    z = np.concatenate([scenario.draw(t, t + 1).z for t in (32, 392, 538, 959, 3042)])
    with np.errstate(all="ignore"):
        careful, all_attempts = (Progressive(restarts=k).estimate(scenario.problem, z) for k in (1, None))
    assert (careful.extras["fit_p"] < 1e-6).all()
    assert (all_attempts.extras["fit_p"] > 1e-3).all()


def test_a_start_without_full_rank_does_not_hide_that_a_flat_minimum_is_reached():
    """Chebyquad with n = 8 from 100 times its start: J is singular at the minimum, and to double precision at the
    start as well, but not on the way."""
    scenario = Scenario(Mgh("chebyquad", 100.0), Certified())
    with np.errstate(all="ignore"):
        found = Progressive().estimate(scenario.problem, scenario.draw(0, 1).z)
    assert score(scenario.measurement, found.x[0]).solved
    assert found.status[0] == Status.CONVERGED


def test_a_flat_direction_is_singular_for_gauss_newton():
    class Flat(Bent):
        def simulate(self, x: Array) -> Array:
            return super().simulate(x * np.array([1.0, 1.0, 0.0]))

    problem = Problem(Flat(), Covariance(np.full(12, 0.1)), None)
    for estimator in (GaussNewton(), GaussNewton(start="nominal"), LevenbergMarquardt()):
        estimates = estimator.estimate(problem, np.ones((2, 12)))
        assert (estimates.status == Status.SINGULAR).all()
