"""Batch least squares, re-linearised and progressive IPE against SciPy, closed forms and the
truth."""

import itertools
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2
from shared.oracles import agreed, assert_agrees
from shared.small_models import Bent, Written

from ipe_bench.baselines import GaussNewton, LevenbergMarquardt
from ipe_bench.basics.linalg import Array, Covariance, deviations, information, quadratic_form
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.ipe import FrozenSystem
from ipe_bench.estimators.least_squares import NormalEquations
from ipe_bench.measurements import Gins, Polynomial
from ipe_bench.measurements.counted import CountingModel, EvaluationCount
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import Gaussian, Quantization
from ipe_bench.priors import GaussianPrior
from ipe_bench.solvers import Auto, DampedNewton, FixedPoint, Newton, Progressive, Relinearized
from ipe_bench.trials.scenario import Scenario

LEAST_SQUARES = [
    *(
        GaussNewton(),
        GaussNewton(damping=1e-3),
        LevenbergMarquardt(),
        Relinearized(),
        Relinearized(Newton()),
    ),
    *(Progressive(), Progressive(use_prior=False)),
]


def gins(scale: float, trials: int = 20, model: Gins | None = None):
    scenario = Scenario(model or Gins(), Quantization(0.02286), GaussianPrior(), scale)
    return scenario.problem, scenario.draw(0, trials)


@pytest.mark.oracle("library: SciPy's least_squares", "estimates", 1e-6)
@pytest.mark.parametrize("estimator", LEAST_SQUARES, ids=repr)
def test_the_minimum_is_that_of_scipy(estimator):
    scenario = Scenario(Polynomial(strength=0.02), Gaussian(0.1), GaussianPrior(), 3.0)
    problem, trials = scenario.problem, scenario.draw(0, 6)
    estimates = estimator.estimate(problem, trials.z)
    assert (estimates.status == Status.CONVERGED).all()
    for x, P, z in zip(estimates.x, estimates.covariance, trials.z, strict=True):

        def residual(x, z=z):
            return problem.R.whiten(problem.measurement.simulate(x[None])[0] - z)

        found = least_squares(
            residual, problem.x0, jac="3-point", xtol=1e-15, ftol=1e-15, gtol=1e-12
        )
        agreed(np.abs(x - found.x), 1e-6)
        np.testing.assert_allclose(P, np.linalg.inv(found.jac.T @ found.jac), rtol=1e-4)


@pytest.mark.parametrize("bend", [0.05, -0.05])
def test_geodesic_acceleration_makes_the_second_order_of_a_step_right(bend):
    """Along a parabola z = x + b x^2 the plain step from 0 is z, and the bent one z - b z^2; the
    root is z - b z^2 + 2 b^2 z^3 - ..."""
    model = Written(lambda a: (a + bend * a**2, 2 * (a + bend * a**2)))
    problem = Problem(model, Covariance(np.ones(2)), np.array([1.0]))
    z = np.array([[1.0, 2.0], [-0.5, -1.0]])
    for geodesic, expected in ((False, z[:, 0]), (True, z[:, 0] - bend * z[:, 0] ** 2)):
        method = LevenbergMarquardt("nominal", damping=1e-12, geodesic=geodesic, max_iterations=1)
        np.testing.assert_allclose(method.estimate(problem, z).x[:, 0], expected, rtol=1e-9)


def exact_inverse_of_normal_matrix(J: Array) -> Array:
    """(J' J)^-1 (n, n) in rational numbers, by elimination."""
    exact, n = np.vectorize(Fraction)(J), J.shape[1]
    table = np.concatenate([exact.T @ exact, np.vectorize(Fraction)(np.eye(n))], axis=1)
    for i in range(n):
        table[i] /= table[i, i]
        for j in set(range(n)) - {i}:
            table[j] -= table[j, i] * table[i]
    return table[:, n:]


@pytest.mark.oracle(
    "closed form: normal equations in rational numbers", "steps, in standard deviations", 1e-8
)
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
        assert_agrees(slope.newton[0] * sizes / deviation, step / deviation, atol=1e-8)
        assert slope.size[0] == pytest.approx(np.abs(step / deviation).max(), rel=1e-8)
        np.testing.assert_allclose(slope.Q[0] @ slope.U[0] / sizes, J, atol=1e-12)


def test_one_inner_fixed_point_step_is_gauss_newton():
    problem, trials = gins(100.0, 5, Gins(step=60.0))  # with a fixed step all Jacobians are exact
    rounds = Relinearized(FixedPoint(), inner_iterations=1).estimate(
        problem, trials.z, history=True
    )
    steps = GaussNewton().estimate(problem, trials.z, history=True)
    for a, b, P in zip(rounds.history, steps.history, steps.covariance, strict=True):
        k = min(len(a), len(b))
        assert k >= 3
        assert (np.abs(a[:k] - b[:k]) / np.sqrt(np.diag(P))).max() < 1e-5


PRIORS = (Progressive(), Progressive(prior_inflation=10.0), Progressive(use_prior=False))
FAR = [pytest.param(estimator, 600.0, 40, 1.0) for estimator in PRIORS]
FAR += [
    pytest.param(Progressive(), *far, marks=pytest.mark.slow)
    for far in ((1000.0, 250, 1.0), (3000.0, 250, 0.98))
]


@pytest.mark.parametrize(("estimator", "scale", "trials", "share"), FAR, ids=str)
def test_progressive_ipe_from_far_away(estimator, scale, trials, share):
    problem, drawn = gins(scale, trials)
    found = estimator.estimate(problem, drawn.z)
    distance = quadratic_form(
        information(problem.measurement.jacobian(drawn.x), problem.R), found.x - drawn.x
    )
    success = distance < chi2.isf(1e-6, 11)
    assert success.mean() >= share
    # Its own verdict is right.
    np.testing.assert_array_equal(found.extras["fit_p"] > 1e-6, success)
    assert np.median(found.simulations + 11 * found.jacobians) <= 250


@pytest.mark.slow
def test_candidates_that_differ_find_what_a_common_prior_hides():
    """Trials whose first windows have a second minimum of the same depth, to which the prior draws
    every candidate."""
    scenario = Scenario(Gins(), Quantization(0.02286), GaussianPrior(), 5000.0)
    z = np.concatenate([scenario.draw(t, t + 1).z for t in (32, 392, 538, 959, 3042)])
    with np.errstate(all="ignore"):
        careful, all_attempts = (
            Progressive(restarts=k).estimate(scenario.problem, z) for k in (1, None)
        )
    assert (careful.extras["fit_p"] < 1e-6).all()
    assert (all_attempts.extras["fit_p"] > 1e-3).all()


def test_a_flat_direction_is_singular_for_gauss_newton():
    class Flat(Bent):
        def simulate(self, x: Array) -> Array:
            return super().simulate(x * np.array([1.0, 1.0, 0.0]))

    problem = Problem(Flat(), Covariance(np.full(12, 0.1)), None)
    for estimator in (GaussNewton(), GaussNewton(start="nominal"), LevenbergMarquardt()):
        estimates = estimator.estimate(problem, np.ones((2, 12)))
        assert (estimates.status == Status.SINGULAR).all()


# Jacobians that are near enough for steps


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


def test_a_coarse_jacobian_counts_as_what_it_costs():
    model, rows, x = Crude(0.01), np.arange(3), np.ones((3, 3))
    x[1] = 11.0
    counted = CountingModel(model, EvaluationCount.zeros(3), share=0.5)
    J = counted.jacobian(x, rows, coarse=True)
    np.testing.assert_array_equal(counted.tally.jacobians, [0.125, 0.625, 0.125])
    np.testing.assert_array_equal(J[[0, 2]], model.coarse_jacobian(x[[0, 2]]))
    # Where it overflows, it is the exact one.
    np.testing.assert_array_equal(J[1], model.jacobian(x[1:2])[0])


@pytest.mark.parametrize(
    "solver", [Newton(tolerance=1e-12), DampedNewton(tolerance=1e-12)], ids=repr
)
def test_newtons_method_is_coarse_far_away_and_of_order_two_near_a_root(solver):
    """A Jacobian that is off by one part in a hundred would gain a factor of a hundred in a
    step."""
    problem = Problem(Crude(0.01), Covariance(np.full(12, 0.03)), None)
    z = problem.measurement.simulate(np.random.default_rng(3).normal(size=(20, 3)))
    found = solver.estimate(problem, z, history=True)
    assert (found.status == Status.CONVERGED).all()
    system = FrozenSystem.at_nominal(problem, z)
    assert found.history is not None
    sizes = [
        [
            np.abs(system.subset(np.arange(20) == i).F(x[None]) / system.deviation).max()
            for x in iterates
        ]
        for i, iterates in enumerate(found.history)
    ]
    near = [(a, b) for trial in sizes for a, b in itertools.pairwise(trial) if 1e-6 < a <= 0.03]
    assert len(near) >= 5
    assert all(b < 1e-4 * a for a, b in near)
    far = np.array([np.sum(np.array(trial[:-1]) > 0.03) for trial in sizes])
    np.testing.assert_allclose(
        found.jacobians, found.iterations - 0.75 * far + 1, rtol=1e-12
    )  # and the covariance's


COARSE = [GaussNewton(), LevenbergMarquardt(), Progressive(), Auto()]


@pytest.mark.parametrize("estimator", COARSE, ids=repr)
def test_a_minimum_and_its_covariance_are_those_of_exact_jacobians(estimator):
    problem, trials = gins(33.0, 20)
    found = estimator.estimate(problem, trials.z)
    assert (found.status == Status.CONVERGED).all()
    step, P = gauss_newton_step(problem, trials.z, found.x)
    within = 1e-4 if isinstance(estimator, Auto) else 1e-6
    assert (np.abs(step) <= within * deviations(P)).all()
    np.testing.assert_allclose(
        found.covariance, P, rtol=within if within > 1e-6 else 1e-9, atol=1e-4 * within
    )
    assert np.median(found.simulations + found.jacobians * problem.measurement.jacobian_cost) < 45


def gauss_newton_step(problem: Problem, z: Array, x: Array) -> tuple[Array, Array]:
    J = problem.R.whiten_jacobian(problem.measurement.jacobian(x))
    r = problem.R.whiten(problem.measurement.simulate(x) - z)
    P = np.linalg.inv(J.swapaxes(1, 2) @ J)
    return -(P @ J.swapaxes(1, 2) @ r[..., None])[..., 0], P


@pytest.mark.parametrize("estimator", COARSE[:2], ids=repr)
@pytest.mark.parametrize("error", [0.01, 0.1])
def test_residuals_that_stay_large_do_not_move_the_minimum(estimator, error):
    """There a coarse gradient is zero some deviations away."""
    z = np.random.default_rng(3).normal(size=(8, 12))
    problem = Problem(Crude(0.01, error=error), Covariance(np.full(12, 0.03)), None)
    found = estimator.estimate(problem, z)
    assert (found.status == Status.CONVERGED).all()
    step, P = gauss_newton_step(problem, z, found.x)
    assert (np.abs(step) <= 1e-6 * deviations(P)).all()
    np.testing.assert_allclose(found.covariance, P, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize(
    "estimator", [GaussNewton("nominal", tolerance=1e-5), LevenbergMarquardt(tolerance=1e-5)]
)
def test_a_step_that_lands_where_the_coarse_gradient_is_zero_is_not_the_last(estimator):
    problem = Problem(Crude(0.0, error=1e-5), Covariance(np.full(12, 3e-5)), None)
    A = problem.measurement.A
    z = np.random.default_rng(3).normal(size=(8, 12)) @ (np.eye(12) - A @ np.linalg.pinv(A))
    found = estimator.estimate(problem, z)
    step, P = gauss_newton_step(problem, z, found.x)
    assert (found.status == Status.CONVERGED).all()
    assert (np.abs(step) <= 1.1e-5 * deviations(P)).all()


def test_levenberg_marquardt_does_not_trust_a_coarse_jacobian_that_leads_nowhere():
    problem = Problem(Crude(0.01, error=-2.0), Covariance(np.full(12, 0.03)), None)
    z = Bent(0.01).simulate(np.random.default_rng(4).normal(size=(5, 3)))
    found = LevenbergMarquardt().estimate(problem, z)
    assert (found.status == Status.CONVERGED).all()


@pytest.mark.parametrize("estimator", [*COARSE, Newton()], ids=repr)
def test_without_a_cheaper_jacobian_nothing_changes(estimator):
    z = Bent(0.01).simulate(np.random.default_rng(4).normal(size=(5, 3)))
    R = Covariance(np.full(12, 0.03))
    plain, same = (
        estimator.estimate(Problem(m, R), z) for m in (Bent(0.01), Crude(0.01, cheap=1.0))
    )
    for name in ("x", "status", "covariance", "iterations", "simulations", "jacobians"):
        np.testing.assert_array_equal(getattr(plain, name), getattr(same, name), name)
