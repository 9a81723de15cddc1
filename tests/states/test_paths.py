"""Estimates of whole paths: Levenberg-Marquardt smoothers, eq. (11), and the fit of a path, against
dense solutions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize._numdiff import approx_derivative
from scipy.stats import chi2, kstest
from shared.oracles import assert_agrees
from shared.state_models import (
    SQUARE,
    ConstantVelocity,
    CoordinatedTurn,
    Growth,
    Pendulum,
    path_cost,
)

from ipe_bench.basics.statuses import Status
from ipe_bench.plugins.construct import construct
from ipe_bench.plugins.discovery import options
from ipe_bench.states import (
    Cubature,
    Formulas,
    Grid,
    IteratedSmoother,
    LevenbergMarquardtSmoother,
    Normal,
    PathIPE,
    Smoother,
    Taylor,
    ekf,
    ukf,
)
from ipe_bench.states.damped import Descent
from ipe_bench.states.smoothers import path_p, whole
from ipe_bench.states.trackers import Tracks, filtered
from ipe_bench.states.whole_paths import PathDensity
from ipe_bench.trials.paths import PathBlock, StateScenario
from ipe_bench.trials.thresholds import gate

NEAR = Pendulum(count=25, start=(1.0, 0.0), spread=0.2)
LINEAR = ConstantVelocity(count=12, spread=2.0)
SIZES = np.array([1e3, 50.0])


class Scaled(Pendulum):
    """The same pendulum in other units of angle and rate."""

    @property
    def prior(self):
        m, P = super().prior
        return Normal(m * SIZES, P * SIZES * SIZES[:, None])

    def transition(self, x, k):
        return super().transition(x / SIZES, k) * SIZES

    def observe(self, x, k):
        return super().observe(x / SIZES, k)

    def gain(self, k):
        return SIZES[:, None] * super().gain(k)


SCALED = Scaled(**vars(NEAR))


def unknowns(model, start, x):
    """Start and process noises of paths (K, n) in their own deviations, for a diagonal prior and
    square gains."""
    before = np.vstack([start, x[:-1]])
    noise = [
        np.linalg.solve(model.gain(k), x[k] - model.transition(before[k], k))
        for k in range(model.epochs)
    ]
    return np.concatenate(
        [(start - model.prior.mean) / np.sqrt(np.diag(model.prior.covariance)), *noise]
    )


def run(model, u):
    """All states (K + 1, n) of unknowns u, and whitened readings (K,) of a model that is read once
    an epoch."""
    x = [model.prior.mean + np.sqrt(np.diag(model.prior.covariance)) * u[: model.n]]
    for k, w in enumerate(u[model.n :].reshape(model.epochs, -1)):
        x.append(model.transition(x[-1], k) + model.gain(k) @ w)
    read = [
        model.observe(x[k + 1], k)[..., 0] / np.sqrt(model.R(k)[0, 0]) for k in range(model.epochs)
    ]
    return np.array(x), np.array(read)


def test_levenberg_and_marquardt_find_the_minimum_that_halved_steps_find():
    z = NEAR.draw(0, 3).z
    z[1, 4:8] = np.nan
    found = LevenbergMarquardtSmoother(tolerance=1e-8).track(NEAR, z)
    other = IteratedSmoother(ukf(), Taylor(), 50, damped=True, tolerance=1e-10).track(NEAR, z)
    np.testing.assert_allclose(found.mean, other.mean, atol=1e-7)
    density = PathDensity.of(NEAR, z)
    at = density.settled(whole(found)[0])
    P = density.spread(density.tangents(at), at)[0][:, 1:]
    np.testing.assert_allclose(P, other.covariance, rtol=1e-5)
    np.testing.assert_allclose(
        found.cost, path_cost(NEAR, z, other.start.mean, other.mean), rtol=1e-9
    )
    assert (found.status == Status.CONVERGED).all()


@pytest.mark.oracle("closed form: one dense solve over all states", "states", 1e-9)
def test_a_damped_step_reads_every_state_once_more():
    """One dense solution over all states of the linear model, each drawn towards a path."""
    n, K = LINEAR.n, LINEAR.epochs
    z, rng = LINEAR.draw(0, 1).z, np.random.default_rng(1)
    about, variances = rng.normal(size=(1, K + 1, n)), rng.uniform(0.5, 2.0, (1, K + 1, n))
    F = LINEAR.transition(np.eye(n), 0).T
    D, H = np.zeros((n * K, n * (K + 1))), np.zeros((K, n * (K + 1)))
    for k in range(K):
        D[n * k : n * (k + 1), n * k : n * (k + 2)] = np.hstack([-F, np.eye(n)])
        H[k, n * (k + 1)] = 1.0
    prior = np.zeros((n * (K + 1),) * 2)
    prior[:n, :n] = np.linalg.inv(LINEAR.prior.covariance)
    free = (
        prior
        + D.T @ np.kron(np.eye(K), np.linalg.inv(LINEAR.Q(0))) @ D
        + H.T @ H / LINEAR.R(0)[0, 0]
    )
    exact = np.linalg.solve(
        free + np.diag(1 / variances.ravel()),
        H.T @ z.ravel() / LINEAR.R(0)[0, 0] + (about / variances).ravel(),
    )
    density = PathDensity.of(LINEAR, z)
    at = density.settled(about)
    step = density.step(density.tangents(at), at, 1 / variances)
    assert_agrees((about + step).ravel(), exact, atol=1e-9)


def bearings(scale):
    """`bearings_only`, its target unknown by so many multiples."""
    model = construct(
        next(o for o in options("state_model") if o.name == "bearings_only").config, "state_model"
    )
    return replace(
        model, spread={name: scale * float(value) for name, value in model.spread.items()}
    )


def test_a_damped_step_is_the_same_in_any_unit_of_the_states():
    """Damping is in variances of the states: with that of one unit the step depends on the
    units."""
    steps = []
    for model in (NEAR, SCALED):
        density = PathDensity.of(model, NEAR.draw(0, 4).z)
        track = filtered(model, density.z, Taylor())
        begun = replace(Descent.of(density, track), damping=np.ones(4))
        steps.append(LevenbergMarquardtSmoother(iterations=1).descended(density, begun).at)
    np.testing.assert_allclose(steps[1].x / SIZES, steps[0].x, atol=1e-9)
    np.testing.assert_allclose(steps[1].cost, steps[0].cost, rtol=1e-9)


@pytest.mark.parametrize("rule", [Taylor(), Cubature()], ids=["tangents", "points"])
def test_a_smoother_arrives_after_the_same_steps_in_any_unit_of_the_states(rule):
    tracker = IteratedSmoother(rule=rule, iterations=20, tolerance=1e-3)
    z = NEAR.draw(0, 4).z
    one, other = (tracker.track(model, z) for model in (NEAR, SCALED))
    np.testing.assert_array_equal(other.calls, one.calls)
    np.testing.assert_allclose(other.mean / SIZES, one.mean, atol=1e-9)


def test_levenberg_and_marquardt_begin_at_the_better_of_two_filters():
    """No step raises the cost, so that the path after one of them costs no more than that of either
    smoother."""
    model = Growth(count=15)
    z = model.draw(0, 40).z
    found = LevenbergMarquardtSmoother(iterations=1, starts=0).track(model, z)
    costs = []
    for one in (ekf(), ukf()):
        track = Smoother(one).track(model, z)
        costs.append(path_cost(model, z, track.start.mean, track.mean))
    assert min(np.min(costs[0] / costs[1]), np.min(costs[1] / costs[0])) < 0.9
    assert (found.cost <= np.minimum(*costs) * (1 + 1e-9)).all()


def test_further_starts_are_draws_of_the_prior_with_half_its_deviations():
    """Readings without a say leave the start where it was drawn; one as good as that start moves it
    half way."""
    spread = 2.0
    for deviation, size in ((1e6, spread), (spread / 2, spread / 2)):
        model = ConstantVelocity(count=1, step=1e-9, spread=spread, deviation=deviation)
        density = PathDensity.of(model, 1e-9 * np.arange(400.0)[:, None, None])
        start = LevenbergMarquardtSmoother(starts=1).drawn(density).at.x[:, 0, 0]
        np.testing.assert_allclose(start.std(), size, rtol=5 / np.sqrt(800))


def test_a_state_that_comes_round_is_followed_next_to_its_path():
    class Heading(ConstantVelocity):
        """A heading and its rate: whole turns of the first are one."""

        @property
        def state_periods(self):
            return 2 * np.pi, 0.0

    model = Heading(count=1)
    x = Normal(np.array([[3.0, 0.5], [3.0, -9.0]]), np.array([np.eye(2)] * 2))
    turns = np.array([[2 * np.pi, 0.0], [-6 * np.pi, 0.0]])
    path = Tracks.empty(model, 2)
    path.start = x
    path.mean[:, 0] = model.transition(x.mean, 0) + turns + [0.4, 30.0]
    path.root = np.tile([1.0, 0.0, 1.0], (2, 2, 1))
    blind = np.full((2, 1, 1), np.nan)
    for rule in (Taylor(), Cubature()):
        moved = filtered(model, blind, rule, path=path, start=x).mean[:, 0]
        np.testing.assert_allclose(moved, model.transition(x.mean, 0) + turns, atol=1e-12)


@pytest.mark.slow
def test_levenberg_and_marquardt_hold_targets_that_filters_lose():
    block = PathBlock.draw(StateScenario(bearings(30.0), seed=1), 0, 12)
    filtered, kept = (
        block.estimate(tracker)[1] for tracker in (ekf(), LevenbergMarquardtSmoother())
    )
    assert not filtered["success"].all()
    assert kept["success"].all()
    assert (kept["fit_p"] > 1e-3).all()


@pytest.mark.parametrize(
    "tracker",
    [
        pytest.param(LevenbergMarquardtSmoother(starts=2), marks=pytest.mark.slow),
        PathIPE(),
        pytest.param(PathIPE("newton"), marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_a_trial_has_the_same_bits_in_every_batch(tracker):
    """Lost trials, which begin again, and missing readings among them."""
    model = replace(bearings(100.0), count=12)
    z = model.draw(0, 4).z
    z[2] += 1.0 * (np.arange(12) % 2)[:, None]
    z[3, 3:5] = np.nan
    together = tracker.track(model, z)
    for trial in (2, 3):
        alone = tracker.track(model, z[trial : trial + 1])
        for name in ("mean", "covariance", "cost", "status", "iterations", "calls"):
            np.testing.assert_array_equal(getattr(together, name)[trial], getattr(alone, name)[0])


@pytest.mark.parametrize("method", ["fixed_point", "newton"])
@pytest.mark.parametrize("singular", [False, True])
def test_eq_11_of_a_linear_path_is_its_smoother(method, singular):
    model = LINEAR
    if singular:  # velocity alone is disturbed, and the position of the start is known

        class Singular(ConstantVelocity):
            def gain(self, k):
                return np.array([[0.0], [0.3]])

        model = Singular(count=12)
    z = model.draw(0, 3).z
    z[1, 2:5] = np.nan
    exact, found = Smoother(ekf()).track(model, z), PathIPE(method).track(model, z)
    np.testing.assert_allclose(found.mean, exact.mean, atol=1e-8)
    np.testing.assert_allclose(found.covariance, exact.covariance, atol=1e-8)
    np.testing.assert_allclose(found.start.covariance, exact.start.covariance, atol=1e-8)
    assert (found.iterations == 0).all()  # the linear estimate is the root


@pytest.mark.oracle(
    "own second implementation: eq. (11) by dense matrices", "what is left of the equation", 1e-6
)
def test_the_root_of_eq_11_and_its_covariance_are_those_of_a_dense_solution():
    z, n = NEAR.draw(0, 2).z, NEAR.n
    N = n * (NEAR.epochs + 1)
    A = approx_derivative(lambda u: run(NEAR, u)[1], np.zeros(N), method="3-point", rel_step=1e-5)
    H_plus = np.linalg.pinv(np.vstack([np.eye(N), A]))
    tracks = {
        method: PathIPE(method, tolerance=1e-9).track(NEAR, z)
        for method in ("fixed_point", "newton")
    }
    for found in tracks.values():
        assert (found.status == Status.CONVERGED).all()
        np.testing.assert_allclose(found.mean, tracks["newton"].mean, atol=1e-7)
    u = unknowns(NEAR, found.start.mean[0], found.mean[0])
    r = run(NEAR, u)[1] - z[0, :, 0] / np.sqrt(NEAR.variance)
    assert_agrees(H_plus @ np.concatenate([u, r]), 0.0, atol=1e-6)
    assert found.cost[0] == pytest.approx(u @ u + r @ r, rel=1e-9)
    B = approx_derivative(lambda u: run(NEAR, u)[1], u, method="3-point", rel_step=1e-5)
    X = approx_derivative(lambda u: run(NEAR, u)[0][-1], u, method="3-point", rel_step=1e-5)
    T = np.linalg.solve(H_plus @ np.vstack([np.eye(N), B]), H_plus)
    np.testing.assert_allclose(found.covariance[0, -1], X @ T @ T.T @ X.T, rtol=1e-5)


def test_eq_11_of_a_path_says_so_where_it_does_not_converge():
    model = CoordinatedTurn(count=60)
    block = PathBlock.draw(StateScenario(model), 0, 4)
    columns = block.estimate(PathIPE(max_iterations=20))[1]
    converged = columns["status"] == "converged"
    assert not converged.all()
    assert set(columns["status"][~converged]) <= {"diverged", "nonfinite", "max_iterations"}
    np.testing.assert_array_equal(columns["solved"], converged)


@pytest.mark.oracle("library: SciPy's chi2", "p of the cost of a path", 1e-9)
def test_the_fit_of_a_linear_path_is_that_of_the_innovations():
    """The cost of the smoothed path of a linear model is the sum of the filter's NIS:
    chi-square."""
    block = PathBlock.draw(StateScenario(LINEAR), 0, 400)
    trackers = ekf(), Smoother(ekf()), IteratedSmoother(ekf(), iterations=1)
    filtered, smooth, path = (block.estimate(tracker)[1]["fit_p"] for tracker in trackers)
    np.testing.assert_allclose(path, filtered, rtol=1e-7)
    np.testing.assert_array_equal(smooth, filtered)
    assert kstest(path, "uniform").pvalue > 1e-3
    cost = trackers[2].track(LINEAR, block.paths.z).cost
    assert_agrees(path_p(block.paths.z, cost), chi2.sf(cost, 12), rtol=1e-9)
    z = block.paths.z.copy()
    z[:, 3:8] = np.nan
    fewer = trackers[2].track(LINEAR, z)
    assert_agrees(path_p(z, fewer.cost), chi2.sf(fewer.cost, 7), rtol=1e-9)
    assert kstest(path_p(z, fewer.cost), "uniform").pvalue > 1e-3


@pytest.mark.parametrize("rule", [Taylor(), Cubature()], ids=["tangents", "points"])
def test_a_path_that_has_arrived_waits_for_the_others(rule):
    """An iterated smoother with a tolerance leaves a trial at the same bits alone and beside slower
    ones."""
    tracker = IteratedSmoother(rule=rule, iterations=20, tolerance=0.05)
    model = bearings(10.0)
    z = model.draw(0, 6).z
    together = tracker.track(model, z)
    assert len(set(together.calls)) > 1
    for trial in range(len(z)):
        alone = tracker.track(model, z[trial : trial + 1])
        np.testing.assert_array_equal(alone.mean[0], together.mean[trial])
        np.testing.assert_array_equal(alone.covariance[0], together.covariance[trial])
        assert alone.calls[0] == together.calls[trial]


EVEN = replace(SQUARE, readings={"z": "x"})


@pytest.mark.parametrize("smooths", [False, True])
def test_errors_of_a_folded_scalar_state_are_held_against_its_exact_posterior(smooths):
    block = PathBlock.draw(StateScenario(SQUARE), 0, 40)
    exact = Grid(500, smooths).track(SQUARE, block.paths.z)
    np.testing.assert_allclose(block.gates(smooths), exact.covariance[..., 0], rtol=1e-4)
    # By the linear bound the exact answer loses trials, where the state is next to the fold.
    assert (block.estimate(Grid(500, smooths))[1]["success"]).all()
    linear = (exact.mean - block.paths.x)[:, -1] ** 2 / block.variances[:, -1]
    assert (linear > gate(1)).any()
    columns = block.estimate(ekf())[1]
    error = columns["error_x"] ** 2 / exact.covariance[:, -1, 0, 0]
    np.testing.assert_allclose(columns["crlb_distance"], error, rtol=1e-3)
    np.testing.assert_array_equal(columns["success"], error <= gate(1))


@pytest.mark.parametrize("smooths", [False, True])
@pytest.mark.parametrize(
    ("moved", "reading", "part"),
    [("3*sin(x) + w", "x", 1.0), ("0.9*x + w", "exp(x/2)", 1.0), ("3*sin(x) + w", "x", 0.35)],
    ids=["moved", "read", "precise"],
)
def test_errors_of_any_curved_scalar_state_are_held_against_its_exact_posterior(
    moved, reading, part, smooths
):
    """Though its reading does not turn back among the states that a filter predicts. A precise
    model needs 500 points."""
    model = Formulas(
        next={"x": moved},
        readings={"z": reading},
        noise={"w": 0.3 * part},
        deviation={"z": part},
        spread={"x": 1.0},
        count=20,
    )
    block = PathBlock.draw(StateScenario(model, seed=1), 0, 60)
    exact = Grid(500 if part == 1 else 700, smooths).track(model, block.paths.z)
    np.testing.assert_allclose(block.gates(smooths), exact.covariance[..., 0], rtol=1e-4 / part)
    assert not np.allclose(block.gates(False), block.variances, rtol=0.1)
    assert block.estimate(Grid(500, smooths))[1]["success"].all()


def test_errors_of_an_even_scalar_state_are_held_against_the_bound():
    block = PathBlock.draw(StateScenario(EVEN), 0, 5)
    np.testing.assert_array_equal(block.gates(False), block.variances)
    np.testing.assert_array_equal(block.gates(True), block.smoothed_variances)


def test_the_frozen_system_of_many_trials_is_solved_a_few_at_a_time(monkeypatch):
    """Each has the same bits, whatever fits into memory at once."""
    z = NEAR.draw(0, 5).z
    together = PathIPE().track(NEAR, z)
    monkeypatch.setattr("ipe_bench.states.ipe._AT_ONCE", 1)
    one_by_one = PathIPE().track(NEAR, z)
    np.testing.assert_array_equal(one_by_one.mean, together.mean)
    np.testing.assert_array_equal(one_by_one.covariance, together.covariance)


def test_a_path_whose_frozen_system_takes_more_than_a_gigabyte_is_refused():
    assert PathIPE().hindrance(Pendulum(count=2000)) is None
    assert "more than a gigabyte for the 5002 unknowns" in PathIPE().hindrance(Pendulum(count=2500))
