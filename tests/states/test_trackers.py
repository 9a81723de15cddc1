"""Filters and smoothers of states that move: published figures, filterpy, dense solvers and closed
forms."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from filterpy.kalman import CubatureKalmanFilter, spherical_radial_sigmas
from scipy.optimize import least_squares
from scipy.optimize._numdiff import approx_derivative
from shared.families import slow_if
from shared.filterpy_tracks import Filterpy
from shared.oracles import assert_agrees
from shared.state_models import ConstantVelocity, CoordinatedTurn, Growth, Pendulum, path_cost

import ipe_bench as ib
import ipe_bench.states
from ipe_bench.measurements import Parameter
from ipe_bench.states import (
    Bootstrap,
    Cubature,
    Filter,
    Formulas,
    GaussHermite,
    Grid,
    IteratedSmoother,
    Normal,
    Smoother,
    StateModel,
    Taylor,
    Unscented,
    bound_at_truth,
    ckf,
    ekf,
    posterior_bounds,
    ukf,
)
from ipe_bench.states.particles import _resampled

BOOK = {
    "EKF": (Taylor(), 1, 0.16830859061153763, 0.057446202494837),
    "IEKF": (Taylor(), 10, 0.16547516472119136, 0.03463604419042699),
    "UKF": (Unscented(), 1, 0.09524392125923083, 0.036617555415464256),
    "CKF": (Cubature(), 1, 0.1141966031380275, 0.04064624229594188),
    "GHKF": (GaussHermite(5), 1, 0.0998062421916222, 0.03710181978632009),
    "IPLF": (GaussHermite(3), 10, 0.14055766458714145, 0.034733224044175594),
}
"""RMSE of the angle over 500 epochs, filter and smoother, as stored in the notebooks of the book
(see the NOTICE.md of the data)."""
NEAR = Pendulum(count=60, start=(1.0, 0.0), spread=0.1)


@pytest.fixture(scope="module")
def stored():
    """The book's path (1, 500, 2) and readings (1, 500, 1)."""
    rows = np.loadtxt(
        Path(ipe_bench.states.__file__).with_name("pendulum.csv"), delimiter=",", skiprows=1
    )
    return rows[None, :, 1:3], rows[None, :, 3:]


DEAR = ("IEKF", "IPLF", "CKF", "GHKF")


@pytest.mark.oracle(
    "published: Särkkä and Svensson, Bayesian Filtering and Smoothing (2023), notebooks",
    "RMSE of the pendulum's angle by six filters and their smoothers, rad",
    1e-12,
)
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow if n in DEAR else ()) for n in BOOK]
)
def test_errors_of_filters_and_smoothers_are_the_twelve_figures_of_the_book(name, stored):
    (rule, iterations, filtered, smoothed), (x, z) = BOOK[name], stored
    first = Filter(rule, iterations)
    smoother = IteratedSmoother(first, rule) if iterations > 1 else Smoother(first)
    for tracker, figure in ((first, filtered), (smoother, smoothed)):
        error = tracker.track(Pendulum(), z).mean - x
        assert_agrees(np.sqrt(np.mean(error[..., 0] ** 2)), figure, atol=1e-12)


@pytest.mark.oracle(
    "library: filterpy's CubatureKalmanFilter, with its points drawn again", "means", 1e-10
)
def test_filterpy_s_cubature_filter_passes_points_on_that_do_not_carry_the_process_noise(stored):
    model, (_, z) = Pendulum(), stored
    means = {}
    for redrawn in (False, True):
        theirs = CubatureKalmanFilter(
            2, 1, model.step, lambda x: model.observe(x, 0), _moved(model)
        )
        theirs.x, theirs.P, theirs.Q, theirs.R = np.zeros((2, 1)), np.eye(2), model.Q(0), model.R(0)
        path = []
        for reading in z[0]:
            theirs.predict()
            if redrawn:
                theirs.sigmas_f = spherical_radial_sigmas(theirs.x, theirs.P)
            theirs.update(reading[:, None])
            path.append(theirs.x[:, 0].copy())
        means[redrawn] = np.array(path)
    ours = ckf().track(model, z).mean[0]
    assert_agrees(ours, means[True], atol=1e-10)
    assert np.abs(ours - means[False]).max() > 1e-3


def _moved(model):
    return lambda x, dt: model.transition(x, 0)


def dense(model, z):
    """Means (K, n) and covariances (K, n, n) of a linear model's states given all readings, by one
    dense solve over the start and the disturbances."""
    n, q, K = model.n, model.gain(0).shape[1], model.epochs
    prior = np.zeros((n + q * K, n + q * K))
    prior[:n, :n], prior[n:, n:] = model.prior.covariance, np.eye(q * K)
    X, S = [], np.hstack([np.eye(n), np.zeros((n, q * K))])
    F = model.transition(np.eye(n), 0).T - model.transition(np.zeros((1, n)), 0).T
    for k in range(K):
        S = F @ S
        S[:, n + q * k : n + q * (k + 1)] += model.gain(k)
        X.append(S.copy())
    H = model.observe(np.eye(n), 0).T
    A = np.concatenate([H @ part for part in X])
    R = np.kron(np.eye(K), model.R(0))
    gain = prior @ A.T @ np.linalg.inv(A @ prior @ A.T + R)
    u, C = gain @ z.ravel(), prior - gain @ A @ prior
    return np.array([part @ u for part in X]), np.array([part @ C @ part.T for part in X])


@dataclass(frozen=True)
class Walk(ConstantVelocity):
    """A position whose velocity alone is disturbed: Q has rank 1 of 2."""

    count: int = 20
    spread: float = 1.0

    def gain(self, k):
        return np.array([[0.0], [0.3]])


@pytest.mark.oracle(
    "closed form: conditional means by one dense solve", "means and covariances of states", 1e-8
)
@pytest.mark.parametrize(
    "model", [ConstantVelocity(count=20, spread=2.0), Walk()], ids=lambda m: m.name
)
@pytest.mark.parametrize(
    "rule", [Taylor(), Cubature(), Unscented(), GaussHermite(2)], ids=lambda r: type(r).__name__
)
def test_linear_models_have_their_closed_form_by_every_rule(model, rule):
    z = model.draw(0, 3).z
    filtered, smoothed = Filter(rule).track(model, z), Smoother(Filter(rule)).track(model, z)
    for trial in range(3):
        mean, covariance = dense(model, z[trial])
        assert_agrees(smoothed.mean[trial], mean, rtol=1e-8, atol=2e-10)
        assert_agrees(smoothed.covariance[trial], covariance, rtol=1e-8, atol=2e-10)
        assert_agrees(filtered.mean[trial, -1], mean[-1], rtol=1e-8, atol=2e-10)
        assert_agrees(filtered.covariance[trial, -1], covariance[-1], rtol=1e-8, atol=2e-10)


@pytest.mark.oracle("library: SciPy's least_squares over the whole path", "states", 1e-7)
def test_the_damped_gauss_newton_smoother_finds_the_path_of_a_dense_solver():
    z = NEAR.draw(0, 1).z
    smoother = IteratedSmoother(ukf(), Taylor(), 50, damped=True, tolerance=1e-10)
    track = smoother.track(NEAR, z)
    P, G = np.linalg.cholesky(NEAR.prior.covariance), np.linalg.inv(NEAR.gain(0))

    def residual(u):
        x = u.reshape(-1, 2)
        steps = [G @ (x[k + 1] - NEAR.transition(x[k], k)) for k in range(NEAR.epochs)]
        read = (z[0] - np.sin(x[1:, :1])).ravel() / np.sqrt(NEAR.variance)
        return np.concatenate([np.linalg.solve(P, x[0] - NEAR.prior.mean), *steps, read])

    start = np.concatenate([NEAR.prior.mean, Smoother(ukf()).track(NEAR, z).mean.ravel()])
    found = least_squares(residual, start, method="lm", xtol=1e-14, ftol=1e-14, gtol=1e-14)
    assert_agrees(track.mean[0], found.x.reshape(-1, 2)[1:], atol=1e-7)
    assert path_cost(NEAR, z, track.start.mean, track.mean)[0] == pytest.approx(
        2 * found.cost, rel=1e-12
    )


@pytest.mark.oracle(
    "closed form: mean slope of a sine over a normal law", "slopes of ghkf and ukf at 2 rad", 1e-9
)
def test_an_unscented_slope_has_the_wrong_sign_where_the_prior_spans_the_sine():
    """exp(-P / 2) is .14 for a deviation of 2 rad; two points at the root of 3 deviations have
    sin(a) / a, -.09."""
    m, P = np.zeros((1, 2)), np.diag([4.0, 1.0])[None]
    slopes = [
        rule.linearise(lambda x: np.sin(x[..., :1]), m, P).A[0, 0, 0]
        for rule in (GaussHermite(30), ukf().rule)
    ]
    assert_agrees(slopes, [np.exp(-2.0), np.sin(np.sqrt(12.0)) / np.sqrt(12.0)], atol=1e-9)


@pytest.mark.parametrize("rule", [Taylor(), Unscented()])
def test_missing_readings_are_as_if_they_had_never_been_taken(rule):
    z = NEAR.draw(0, 2).z
    z[0, 10:30] = np.nan
    tracks = Filter(rule).track(NEAR, z)
    blind = replace(NEAR, count=30, variance=1e12)
    before = Filter(rule).track(replace(NEAR, count=10), z[:1, :10])
    ahead = replace(blind, count=20, start=tuple(before.mean[0, -1].tolist()))
    assert tracks.degrees[0].sum() == 40
    assert tracks.nis[0, 10:30].max() == 0.0
    x = Normal(before.mean[0, -1], before.covariance[0, -1])
    for k in range(10, 30):  # the prediction alone
        move = rule.linearise(
            lambda at, k=k: ahead.transition(at, k), x.mean[None], x.covariance[None]
        )
        x = Normal(
            (move.A @ x.mean + move.b)[0],
            (move.A @ x.covariance @ move.A.swapaxes(1, 2) + move.W)[0] + NEAR.Q(k),
        )
    np.testing.assert_allclose(tracks.mean[0, 29], x.mean, atol=1e-12)
    np.testing.assert_allclose(tracks.covariance[0, 29], x.covariance, atol=1e-12)


@pytest.mark.parametrize(
    "rule", [Cubature(), Unscented(kappa=0.0), GaussHermite(2)], ids=lambda r: type(r).__name__
)
@pytest.mark.parametrize("m", [0.0, 1.0, 3.0, -3.1])
def test_points_of_an_angle_lie_about_that_of_their_centre(rule, m):
    """Two points .6 of half a turn to either side: next to each other they would be .8 of half a
    turn apart."""

    def wrapped(x):
        return (x + np.pi) % (2 * np.pi) - np.pi

    P = np.array([[[(0.6 * np.pi) ** 2]]])
    found = rule.linearise(wrapped, np.array([[m]]), P, lambda y, to: to + wrapped(y - to))
    np.testing.assert_allclose(
        [found.A[0, 0, 0], found.b[0, 0], found.W[0, 0, 0]], [1.0, 0.0, 0.0], atol=1e-9
    )


def test_a_track_is_kept_where_its_bearing_comes_round():
    """A turn whose track crosses the negative x axis: without wrapping the filters lose it at
    once."""
    model = CoordinatedTurn(count=60)
    paths = model.draw(0, 40)
    angle = np.arctan2(paths.x[..., 2], paths.x[..., 0])
    assert (np.abs(np.diff(angle, axis=1)) > np.pi).any()
    bound = np.sqrt(
        np.median(np.einsum("tkii->tki", bound_at_truth(model, paths))[..., [0, 2]].sum(axis=-1))
    )
    for tracker in (ukf(), ckf()):
        error = tracker.track(model, paths.z).mean - paths.x
        assert np.median(np.hypot(error[..., 0], error[..., 2])) < 2 * bound


@dataclass(frozen=True)
class Scalar(StateModel):
    """A scalar state that forgets, with some readings missing: linear, so that the Kalman filter is
    exact."""

    moved_first: bool = True

    @property
    def states(self):
        return (Parameter("x"),)

    @property
    def times(self):
        return np.arange(1.0, 31.0)

    @property
    def prior(self):
        return Normal(np.array([2.0]), np.array([[9.0]]))

    def transition(self, x, k):
        return 0.9 * x + 0.5 * np.cos(k)

    def observe(self, x, k):
        return np.concatenate([x, -0.5 * x], axis=-1)

    def gain(self, k):
        return np.array([[0.6, 0.3]])

    def R(self, k):
        return np.array([[0.5, 0.1], [0.1, 0.3]])


@dataclass(frozen=True)
class Sharp(Scalar):
    """The same with readings whose errors are far smaller than a step of the grid."""

    def R(self, k):
        return 1e-8 * np.eye(2)


RULES = Taylor(), Unscented(), Unscented(0.0, 0.5, 2.0)
FOLLOWED = NEAR, ConstantVelocity(count=40), CoordinatedTurn(count=50), Scalar(False)


@pytest.mark.oracle(
    "library: filterpy's EKF, UKF and smoothers",
    "means and covariances, in standard deviations",
    1e-10,
)
@pytest.mark.parametrize(
    ("model", "rule"),
    slow_if(
        lambda model, rule: isinstance(model, CoordinatedTurn) and rule != Unscented(),
        product(FOLLOWED, RULES),
    ),
    ids=lambda given: getattr(given, "name", type(given).__name__),
)
def test_filterpy_has_the_same_tracks(model, rule):
    z = model.draw(0, 4).z
    z[1, 3:6], z[2, 20, 0] = np.nan, np.nan
    batched, filterpy = Filter(rule), Filterpy(rule)
    for ours, theirs in ((batched, filterpy), (Smoother(batched), Smoother(filterpy))):
        one, other = ours.track(model, z), theirs.track(model, z)
        size = np.sqrt(np.einsum("tkii->tki", one.covariance))
        assert_agrees((other.mean - one.mean) / size, 0.0, atol=1e-10)
        scaled = (other.covariance - one.covariance) / (size[..., None] * size[..., None, :])
        assert_agrees(scaled, 0.0, atol=1e-10)
        for name in ("nis", "innovations", "degrees", "log_likelihood"):
            np.testing.assert_allclose(
                getattr(other, name), getattr(one, name), rtol=1e-10, atol=1e-10
            )


@pytest.mark.parametrize("moved_first", [True, False])
def test_a_grid_gives_the_kalman_filter_and_its_smoother_of_a_linear_model(moved_first):
    model = Scalar(moved_first)
    z = model.draw(0, 27).z
    z[0, 4:7], z[1, 3, 1] = np.nan, np.nan
    filtered, smoothed = ekf().track(model, z), Smoother(ekf()).track(model, z)
    for grid, exact in ((Grid(400), filtered), (Grid(400, smooths=True), smoothed)):
        found = grid.track(model, z)
        np.testing.assert_allclose(found.mean, exact.mean, atol=1e-6)
        np.testing.assert_allclose(found.covariance, exact.covariance, atol=1e-6)
        np.testing.assert_allclose(found.log_likelihood, filtered.log_likelihood, atol=1e-6)
        np.testing.assert_allclose(found.innovations, filtered.innovations, atol=1e-5)
        np.testing.assert_array_equal(found.mean[26:], grid.track(model, z[26:]).mean)


def test_a_grid_takes_a_single_reading_without_a_transition():
    """A reading of variance 1 of a state of variance 4: both are four fifths of the reading's."""
    model = Formulas(
        next={"x": "x"},
        readings={"z": "x"},
        deviation={"z": 1.0},
        spread={"x": 2.0},
        count=1,
        moved_first=False,
    )
    assert Grid(400).hindrance(model) is None
    z = model.draw(0, 5).z
    track = Grid(400).track(model, z)
    np.testing.assert_allclose(track.mean, 0.8 * z, atol=1e-6)
    np.testing.assert_allclose(track.covariance, 0.8, atol=1e-6)


def test_unscented_points_have_unit_covariance_or_a_kappa_that_is_refused():
    s, w = Unscented(kappa=-1.9).points(2)
    np.testing.assert_allclose(s.T @ (w[:, None] * s), np.eye(2), atol=1e-12)
    for kappa in (-2.0, -3.0):
        with pytest.raises(ib.UserError, match=rf"kappa={kappa:g}: .* need a kappa above -2;"):
            Unscented(kappa=kappa).points(2)


def test_an_iterated_update_is_the_most_probable_state_after_a_reading():
    """Of one prediction and one reading: the minimum of both misfits (Bell and Cathey 1993), by
    SciPy."""
    model = Pendulum(count=1, start=(1.2, 0.0), spread=0.5, variance=1e-3)
    z = np.array([[[0.6]], [[0.85]], [[0.99]]])
    tracks = Filter(Taylor(), 60).track(model, z)
    predicted, first = (Filter(Taylor()).track(model, each) for each in (z * np.nan, z))
    m, P = predicted.mean[:, 0], predicted.covariance[:, 0]
    for trial in range(3):
        root = np.linalg.inv(np.linalg.cholesky(P[trial]))

        def misfits(x, trial=trial, root=root):
            return [
                *(root @ (x - m[trial])),
                (z[trial, 0, 0] - np.sin(x[0])) / np.sqrt(model.variance),
            ]

        found = least_squares(misfits, m[trial], xtol=1e-14, ftol=1e-14, gtol=1e-14).x
        np.testing.assert_allclose(tracks.mean[trial, 0], found, atol=1e-5)
    assert np.abs(first.mean - tracks.mean).max() > 0.01


def test_particles_are_copied_as_often_as_their_weights_say():
    """The whole part of N w or one more, and on average over all offsets N w (Kitagawa 1996)."""
    w, offset = np.array([0.05, 0.31, 0.0, 0.14, 0.5]), (np.arange(2000) + 0.5) / 2000
    x = np.broadcast_to(np.arange(5.0)[None, :, None], (2000, 5, 1)).copy()
    copied = _resampled(x, np.broadcast_to(w, (2000, 5)), offset)[..., 0]
    counts = (copied[:, :, None] == np.arange(5.0)).sum(axis=1)
    assert (np.abs(counts - 5 * w) < 1).all()
    np.testing.assert_allclose(counts.mean(axis=0), 5 * w, atol=2e-3)


def test_particles_have_the_likelihood_of_the_kalman_filter_of_a_linear_model():
    """Within what 2000 of them scatter; the logarithm of their number, once an epoch, is 7.6."""
    model = Scalar(True)
    z = model.draw(0, 5).z
    exact = ekf().track(model, z).log_likelihood
    particles, filtered = Bootstrap(2000).track(model, z), ekf().track(model, z)
    np.testing.assert_allclose(particles.log_likelihood, exact, atol=1.5)
    assert np.corrcoef(particles.nis.ravel(), filtered.nis.ravel())[0, 1] > 0.99
    assert 1 < particles.effective.min() < particles.effective.max() < 2000


def test_a_grid_refuses_what_it_cannot_be_exact_for(monkeypatch):
    growth = Growth(count=8)
    assert "is exact for one state, and pendulum has 2" in Grid().hindrance(NEAR)
    for points in (1, 2):
        assert "needs three points at least" in Grid(points).hindrance(growth)
    with pytest.raises(
        ib.UserError,
        match=r"trackers\.grid: its points are farther apart than the noise of states or readings",
    ) as refused:
        ib.run(growth, {"grid": Grid(300)}, 3)
    needed = int(str(refused.value).rpartition("=")[2])
    assert Grid(needed).hindrance(growth) is None
    z = growth.draw(0, 3).z
    table = ib.run(growth, {"grid": Grid(needed)}, 3)
    assert (table["converged"] == 1).all()
    sharp = Sharp()
    assert "points for the noise of sharp, above 5000; leave it out" in Grid(400).hindrance(sharp)
    monkeypatch.setattr("ipe_bench.states.grid._MOST_POINTS", 1000)
    z[1, 7] = 400.0  # a state of 90, as none is
    with pytest.raises(ArithmeticError, match="of epoch 8 runs over an end of the grid"):
        Grid(900).track(growth, z[1:2])
    with pytest.raises(ArithmeticError, match="falls between the points of the grid"):
        Grid(900).track(sharp, sharp.draw(0, 1).z)


def test_a_trial_has_as_many_points_of_a_grid_as_its_density_asks_for():
    """A state of 90 lies beyond what is drawn: its grid is wider, and costs more."""
    growth = Growth(count=12)
    z = growth.draw(0, 2).z
    plain = Grid(900).track(growth, z)
    z[1, 7] = 400.0
    found = Grid(900).track(growth, z)
    np.testing.assert_array_equal(found.mean[0], plain.mean[0])
    # (x / 10) dx = 1 at x = sqrt(20 z)
    assert abs(found.mean[1, 7, 0]) == pytest.approx(np.sqrt(8000), abs=0.5)
    assert found.covariance[1, 7, 0, 0] == pytest.approx(100 / 8000, rel=0.1)
    assert found.calls[0] == plain.calls[0] < found.calls[1]


def test_a_grid_is_refused_where_no_number_of_points_would_do():
    # Asked for by the moves of a coarse grid, the points of the finer one took all memory there
    # was.
    of_pole = Formulas(
        next={"x": "1/x + w"},
        readings={"z": "x"},
        noise={"w": 1.0},
        deviation={"z": 1.0},
        spread={"x": 1.0},
        count=6,
    )
    assert re.fullmatch(
        r"would need \S+ points for the noise of \S+, above 5000; leave it out",
        Grid(50).hindrance(of_pole),
    )


@pytest.mark.slow
def test_the_growth_model_separates_the_filters_from_the_exact_answer():
    model = Growth()
    paths = model.draw(0, 60)

    def rmse(tracker):
        return np.sqrt(np.mean((tracker.track(model, paths.z).mean - paths.x) ** 2))

    exact, particles, extended = rmse(Grid()), rmse(Bootstrap(1000)), rmse(ekf())
    assert exact == pytest.approx(4.66, abs=0.25)
    assert exact < particles < 1.05 * exact
    assert extended == pytest.approx(22.0, abs=2.5)
    bound = np.sqrt(posterior_bounds(model, paths)[0][:, 0, 0].mean())
    assert bound < 0.4 * exact  # far from attainable


def test_the_bounds_of_a_linear_model_are_its_covariances():
    model = ConstantVelocity(count=20)
    paths = model.draw(0, 5)
    filtered, smoothed = posterior_bounds(model, paths)
    np.testing.assert_allclose(filtered, ekf().track(model, paths.z).covariance[0], rtol=1e-9)
    np.testing.assert_allclose(
        smoothed, Smoother(ekf()).track(model, paths.z).covariance[0], rtol=1e-9
    )
    np.testing.assert_allclose(bound_at_truth(model, paths)[2], filtered, rtol=1e-9)


def test_readings_that_a_path_has_not_are_no_part_of_its_bounds():
    """Those of a logarithm of a state below 0 counted, and filters seemed worse than they could."""
    model = ConstantVelocity(count=20)
    paths = model.draw(0, 5)
    paths.z[:, 3:9] = np.nan
    paths.z[:, 12, 0] = np.nan
    filtered, smoothed = posterior_bounds(model, paths)
    np.testing.assert_allclose(filtered, ekf().track(model, paths.z).covariance[0], rtol=1e-9)
    np.testing.assert_allclose(
        smoothed, Smoother(ekf()).track(model, paths.z).covariance[0], rtol=1e-9
    )
    np.testing.assert_allclose(bound_at_truth(model, paths)[2], filtered, rtol=1e-9)


WRONG_KINDS = {
    "its states are not all parameters": {"states": ("position", "speed")},
    "two of its states have the name p": {"states": (Parameter("p"), Parameter("p"))},
    "two of its readings have the name z": {"reading_names": ("z", "z")},
    "its times are no array": {"times": [1.0, 2.0]},
    "its prior is no Normal of arrays": {"prior": (np.zeros(2), np.eye(2))},
    "the mean of its prior is not finite": {"prior": Normal(np.full(2, np.nan), np.eye(2))},
    "its R is no function": {"R": np.eye(1)},
    "its gain(0) is no array": {"gain": lambda self, k: 1.0},
}


@pytest.mark.parametrize("complaint", WRONG_KINDS)
def test_a_part_of_another_kind_is_refused(complaint):
    model = type("Odd", (Walk,), WRONG_KINDS[complaint])()
    for ask in (
        lambda: ib.run(model, {"ekf": ekf()}, trials=2),
        lambda: ib.estimate(model, np.ones((2, 1)), {"ekf": ekf()}),
    ):
        with pytest.raises(ib.UserError, match=re.escape(complaint)):
            ask()


@pytest.mark.parametrize(
    ("part", "formula", "what"),
    [("next", "sqrt(x - 100)", "states"), ("readings", "sqrt(x - 100)", "reading")],
)
def test_a_model_without_finite_paths_is_refused(part, formula, what):
    formulas = {"next": {"x": "x"}, "readings": {"z": "x"}}
    formulas[part] = dict.fromkeys(formulas[part], formula)
    model = Formulas(**formulas, deviation={"z": 1.0}, spread={"x": 1.0}, count=3)
    with pytest.raises(ib.UserError, match=f"none of the first 4 paths has .*finite {what}"):
        ib.run(model, {"ekf": ekf()}, trials=5)


@pytest.mark.oracle(
    "own second implementation: information matrix of whole paths",
    "posterior Cramér-Rao bounds",
    1e-6,
)
@pytest.mark.parametrize(
    "model", [Pendulum(count=12), Growth(count=12)], ids=lambda model: model.name
)
def test_the_posterior_bound_is_the_inverse_of_the_information_of_whole_paths(model):
    """The second derivatives of the log density, one matrix for all epochs up to each, by
    differences of slopes."""
    paths, n = model.draw(0, 40), model.n
    filtered, smoothed = posterior_bounds(model, paths)
    path = np.concatenate([paths.start[:, None], paths.x], axis=1)
    for upto in (1, 5, 12):
        total = np.zeros((n * (upto + 1), n * (upto + 1)))
        total[:n, :n] = np.linalg.inv(model.prior.covariance)
        for k in range(upto):
            here, there = slice(n * k, n * (k + 1)), slice(n * (k + 1), n * (k + 2))
            Q, R = np.linalg.inv(model.Q(k)), np.linalg.inv(model.R(k))
            for before, after in zip(path[:, k], path[:, k + 1], strict=True):
                F = approx_derivative(
                    lambda x, k=k: model.transition(x, k), before, method="cs"
                ).reshape(n, n)
                H = approx_derivative(
                    lambda x, k=k: model.observe(x, k), after, method="cs"
                ).reshape(-1, n)
                D = np.hstack([-F, np.eye(n)])
                rows = np.r_[here, there]
                total[np.ix_(rows, rows)] += D.T @ Q @ D / len(path)
                total[there, there] += H.T @ R @ H / len(path)
        P = np.linalg.inv(total)
        assert_agrees(filtered[upto - 1], P[-n:, -n:], rtol=1e-6)
    for k in range(12):
        block = slice(n * (k + 1), n * (k + 2))
        assert_agrees(smoothed[k], P[block, block], rtol=1e-6)


def test_a_path_without_a_density_has_no_posterior_bound():
    with pytest.raises(ib.UserError, match="process noise into epoch 1 has rank 1 of 2"):
        posterior_bounds(Walk(), Walk().draw(0, 2))
