"""Steps of filters and smoothers: on numbers, in machine code, and beside dense solutions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from shared.families import slow_if
from shared.state_models import Pendulum, straight_line

import ipe_bench as ib
from ipe_bench.engine import scan
from ipe_bench.measurements import Parameter
from ipe_bench.states import (
    Cubature,
    Filter,
    GaussHermite,
    Normal,
    SigmaPoints,
    Smoother,
    StateModel,
    Taylor,
    Unscented,
)
from ipe_bench.states import passes as recorded
from ipe_bench.states.passes import law_of
from ipe_bench.states.steps import State, lower, over, root
from ipe_bench.states.trackers import filtered

RULES = [
    Taylor(),
    Unscented(),
    Unscented(kappa=-1.0, alpha=0.5, beta=2.0),
    Cubature(),
    GaussHermite(),
]


@dataclass(frozen=True)
class Drawn(StateModel):
    """A linear model of drawn numbers: n states, m readings, a root of the prior and gains of any
    rank."""

    n_states: int = 3
    m: int = 2
    rank: int = 2
    seed: int = 0
    count: int = 6
    wide: float = 1.0

    def matrix(self, place, k, *shape):
        return np.random.default_rng((self.seed, place, k)).normal(size=shape)

    @property
    def times(self):
        return np.arange(1.0, 1.0 + self.count)

    @property
    def states(self):
        return tuple(Parameter(f"x{i}") for i in range(self.n_states))

    @property
    def prior(self):
        G = self.wide * self.matrix(0, 0, self.n_states, self.n_states)
        return Normal(self.matrix(1, 0, self.n_states), G @ G.T)

    def transition(self, x, k):
        return np.einsum("ij,...j->...i", self.matrix(2, k, self.n_states, self.n_states) / 2, x)

    def observe(self, x, k):
        return np.einsum("ij,...j->...i", self.matrix(3, k, self.m, self.n_states), x)

    def gain(self, k):
        return self.matrix(4, k, self.n_states, self.rank)

    def R(self, k):
        G = self.matrix(5, k, self.m, self.m) + 2 * np.eye(self.m)
        return G @ G.T

    def dense(self, z, upto):
        """Mean and covariance of the states of all epochs and of the start given the readings z
        (K, m) of the first `upto` epochs that are there, and their log likelihood."""
        n = self.n_states
        mean, P = self.prior
        moved = np.eye(n)
        means, factors = [mean], [[moved @ np.linalg.cholesky(P)]]
        for k in range(self.count):
            A = self.transition(np.eye(n), k).T
            means.append(A @ means[-1])
            factors.append([*(A @ F for F in factors[-1]), self.gain(k)])
        columns = sum(F.shape[1] for F in factors[-1])
        W = np.zeros((len(means), n, columns))
        for row, parts in zip(W, factors, strict=True):
            joined = np.concatenate(parts, axis=1)
            row[:, : joined.shape[1]] = joined
        W = W.reshape(-1, columns)
        H = np.zeros((self.count, self.m, len(means), n))
        R = np.zeros((self.count, self.m, self.count, self.m))
        for k in range(self.count):
            H[k, :, 1 + k] = self.observe(np.eye(n), k).T
            R[k, :, k] = self.R(k)
        seen = np.isfinite(z) & (np.arange(self.count) < upto)[:, None]
        H = H.reshape(self.count * self.m, -1)[seen.ravel()]
        R = R.reshape(self.count * self.m, -1)[np.ix_(seen.ravel(), seen.ravel())]
        joined = np.concatenate(means)
        P = W @ W.T
        S = H @ P @ H.T + R
        y = z[seen] - H @ joined
        gain = np.linalg.solve(S, H @ P).T
        size = len(y) * np.log(2 * np.pi) + np.linalg.slogdet(S)[1]
        log_likelihood = -0.5 * (y @ np.linalg.solve(S, y) + size)
        mean = (joined + gain @ y).reshape(-1, n)
        P = (P - gain @ H @ P).reshape(len(means), n, len(means), n)
        return mean, np.stack([P[k, :, k] for k in range(len(means))]), log_likelihood


@pytest.mark.parametrize("n_states", slow_if(lambda n: n > 2, [2, 3, 5]))
@pytest.mark.parametrize("rank", [0, 1, 3])
@pytest.mark.parametrize("rule", RULES, ids=lambda rule: type(rule).__name__)
def test_filters_and_smoothers_of_linear_models_have_dense_solutions(rule, rank, n_states):
    model = Drawn(n_states=n_states, m=1 + n_states % 2, rank=rank, seed=rank)
    z = np.random.default_rng(1).normal(size=(3, model.count, model.m))
    z[1, 2] = np.nan
    z[2, ::2, 0] = np.nan
    tracks = Filter(rule).track(model, z)
    smooth = Smoother(Filter(rule)).track(model, z)
    for i, one in enumerate(z):
        mean, P, log_likelihood = model.dense(one, model.count)
        np.testing.assert_allclose(smooth.mean[i], mean[1:], rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(smooth.covariance[i], P[1:], rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(smooth.start.mean[i], mean[0], rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(smooth.start.covariance[i], P[0], rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(tracks.log_likelihood[i], log_likelihood, rtol=1e-10)
        mean, P, _ = model.dense(one, 3)
        np.testing.assert_allclose(tracks.mean[i, 2], mean[3], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(tracks.covariance[i, 2], P[3], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("rule", slow_if(lambda rule: rule in RULES[3:], RULES))
def test_steps_by_epoch_and_large_matrices_give_the_same(rule, monkeypatch):
    model = Pendulum(count=12)
    z = model.draw(0, 3).z
    z[1, 4:6] = np.nan
    trackers = Filter(rule, 2), Smoother(Filter(rule))
    together = [tracker.track(model, z) for tracker in trackers]
    monkeypatch.setattr(recorded, "_MOST_OPERATIONS", 0)
    monkeypatch.setattr(scan, "_LARGE", 10)
    other = Pendulum(count=12)
    for tracker, right in zip(trackers, together, strict=True):
        found = tracker.track(other, z)
        size = np.sqrt(np.diagonal(right.covariance, axis1=2, axis2=3))
        np.testing.assert_allclose((found.mean - right.mean) / size, 0.0, atol=1e-8)
        outer = size[..., None] * size[..., None, :]
        np.testing.assert_allclose((found.covariance - right.covariance) / outer, 0, atol=1e-8)
        np.testing.assert_allclose(found.log_likelihood, right.log_likelihood, rtol=1e-10)
        alone = tracker.track(other, z[1:2])
        assert np.array_equal(alone.mean[0], found.mean[1])


def corners(reach):
    """A rule by the name of Corners whose points lie at some distance."""

    @dataclass(frozen=True)
    class Corners(SigmaPoints):
        def points(self, n):
            s = reach * np.concatenate([np.zeros((1, n)), np.eye(n), -np.eye(n)])
            w = np.full(len(s), 0.5 / reach**2)
            w[0] = 1 - n / reach**2
            return s, w

    return Corners()


def test_another_rule_of_the_same_name_has_its_own_points(monkeypatch):
    model = Pendulum(count=5)
    z = model.draw(0, 2).z
    found = [Filter(corners(reach)).track(model, z).mean for reach in (1.5, 2.5)]
    monkeypatch.setattr(recorded, "_MOST_OPERATIONS", 0)
    model = Pendulum(count=5)
    right = [Filter(corners(reach)).track(model, z).mean for reach in (1.5, 2.5)]
    np.testing.assert_allclose(found, right, atol=1e-9)
    assert np.abs(found[0] - found[1]).max() > 1e-6


class Curve:
    """A function of lists and of arrays."""

    periods = (0.0, 0.0, 0.0)

    def __call__(self, x) -> Any:
        if isinstance(x, list):
            return self(np.array(x)).tolist()
        return np.stack([np.sin(x[..., 0]), x[..., 0] * x[..., 1], x[..., 1] ** 2], axis=-1)

    def slopes(self, x):
        slope = [[np.cos(x[0]), 0.0], [x[1], x[0]], [0.0, 2 * x[1]]]
        return self(x), slope


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: type(rule).__name__)
def test_rules_in_lists_are_those_of_arrays(rule):
    F = np.array([[0.5, 0.0], [0.3, 0.2]])
    m = np.array([0.7, -0.4])
    state = State(m.tolist(), F.tolist())
    law = law_of(rule, 2)
    assert law is not None
    found = law(Curve(), state, state)
    A, b, W = rule.linearise(Curve(), m[None], (F @ F.T)[None])
    np.testing.assert_allclose(found.y, A[0] @ m + b[0], rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(found.AF, A[0] @ F, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(found.A, A[0], rtol=1e-12, atol=1e-14)
    N = np.array(law.noise((0.1 * np.eye(3)).tolist(), found))
    np.testing.assert_allclose(N @ N.T, W[0] + 0.01 * np.eye(3), rtol=1e-12, atol=1e-14)


def test_triangular_roots_are_those_of_their_covariances():
    rng = np.random.default_rng(0)
    W = rng.normal(size=(4, 6))
    W[2] = 2 * W[0] - W[1]
    F = np.array(lower([list(row) for row in W], 4))
    np.testing.assert_allclose(F @ F.T, W @ W.T, atol=1e-13)
    assert F[2, 2] == 0.0
    G = np.array(root((W @ W.T).tolist()))
    np.testing.assert_allclose(G @ G.T, W @ W.T, atol=1e-6)
    assert np.isnan(root([[1.0, 2.0], [2.0, 1.0]])).any()
    regular = np.linalg.cholesky(W[:2] @ W[:2].T)
    X = rng.normal(size=(3, 2))
    found = np.array(over(X.tolist(), regular.tolist()))
    np.testing.assert_allclose(found @ regular, X, atol=1e-13)


@pytest.mark.parametrize("first", [0, 1, 2])
@pytest.mark.parametrize("rule", RULES, ids=lambda rule: type(rule).__name__)
def test_slopes_beside_states_that_are_known_are_those_of_the_function(rule, first):
    """Such states stand first, between others or last, and two others are known together."""
    rng = np.random.default_rng(first)
    G = np.roll(np.diag([0.0, 2.0, 0.0, 3.0]) @ rng.normal(size=(4, 3)), first, axis=0)
    H = rng.normal(size=(3, 4))
    P = (G @ G.T)[None]
    A, b, W = rule.linearise(lambda x: x @ H.T, np.ones((1, 4)), P)
    np.testing.assert_allclose(A[0] @ G, H @ G, atol=1e-12)
    np.testing.assert_allclose(A.sum(axis=2) + b, H.sum(axis=1)[None], rtol=1e-12)
    np.testing.assert_allclose(W, 0.0, atol=1e-12)


def test_smoothers_about_paths_hold_beside_states_that_are_known_at_the_start():
    """Of a linear model they are the smoother itself: the first states were taken as all known."""
    model = ib.states.Formulas(
        next={"x": "x + v", "v": "v", "c": "c + w"},
        readings={"z": "x + c"},
        noise={"w": 0.3},
        deviation={"z": 0.1},
        spread={"x": 0.0, "v": 1.0, "c": 0.0},
        count=8,
    )
    z = model.draw(0, 4).z
    once = Smoother(Filter(Cubature())).track(model, z)
    again = ib.states.IteratedSmoother(Filter(Cubature()), Cubature(), 1).track(model, z)
    np.testing.assert_allclose(again.mean, once.mean, atol=1e-9)
    np.testing.assert_allclose(again.covariance, once.covariance, atol=1e-9)
    np.testing.assert_allclose(again.start.covariance, once.start.covariance, atol=1e-9)


def test_a_negative_weight_that_leaves_no_covariance_has_no_track():
    """Of a square, points of a negative central weight may leave a negative variance."""
    square = ib.states.Formulas(
        next={"p": "p"}, readings={"z": "p**2"}, deviation={"z": 0.1}, spread={"p": 1.0}, count=2
    )
    z = square.draw(0, 2).z
    with np.errstate(invalid="ignore"):
        tracks = filtered(square, z, Unscented(kappa=-0.5))
    assert not np.isfinite(tracks.covariance).all()


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: type(rule).__name__)
def test_smoothers_are_those_of_rauch_tung_and_striebel(rule):
    """By gains P A' (P-)^-1 behind the filter's own track."""
    model = Pendulum(count=12, spread=0.5)
    z = model.draw(0, 3).z
    z[1, 4:6] = np.nan
    tracks = Filter(rule).track(model, z)
    smooth = Smoother(Filter(rule)).track(model, z)
    x = tracks.mean[:, -1]
    P = tracks.covariance[:, -1]
    for k in range(model.epochs - 1, 0, -1):
        before = Normal(tracks.mean[:, k - 1], tracks.covariance[:, k - 1])
        A, b, W = rule.linearise(lambda x, k=k: model.transition(x, k), *before)
        moved = np.einsum("tij,tj->ti", A, before.mean) + b
        predicted = A @ before.covariance @ A.mT + W + model.Q(k)
        gain = before.covariance @ A.mT @ np.linalg.inv(predicted)
        x = before.mean + np.einsum("tij,tj->ti", gain, x - moved)
        P = before.covariance + gain @ (P - predicted) @ gain.mT
        np.testing.assert_allclose(smooth.mean[:, k - 1], x, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(smooth.covariance[:, k - 1], P, rtol=1e-7, atol=1e-11)


@pytest.mark.parametrize("most", [recorded._MOST_OPERATIONS, -1], ids=["recorded", "by epoch"])
@pytest.mark.parametrize("rule", [Unscented(alpha=0.3), Unscented(alpha=0.1, beta=2.0)], ids=str)
def test_points_of_negative_weight_leave_a_reading_its_noise_beside_a_wide_prior(
    rule, most, monkeypatch
):
    """A line through readings, of which rules by points know what tangents do: a reading of 1 m
    beside a prior of 1e8 m counted as exact."""
    monkeypatch.setattr(recorded, "_MOST_OPERATIONS", most)
    model = straight_line(1e8, 1.0)
    z = model.draw(0, 2).z
    exact, found = (filtered(model, z, one).covariance for one in (Taylor(), rule))
    np.testing.assert_allclose(found[:, 2:], exact[:, 2:], rtol=1e-6)
