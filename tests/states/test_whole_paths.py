"""Steps of whole paths: against filters and smoothers of the same affine model, where covariances
are singular."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from shared.oracles import assert_agrees
from shared.state_models import ConstantVelocity, Pendulum, straight_line

from ipe_bench.basics.statuses import Status
from ipe_bench.measurements import Parameter
from ipe_bench.states import (
    Formulas,
    IteratedSmoother,
    LevenbergMarquardtSmoother,
    Normal,
    Smoother,
    StateModel,
    ekf,
)
from ipe_bench.states.base import widened
from ipe_bench.states.smoothers import whole
from ipe_bench.states.whole_paths import PathDensity


@dataclass(frozen=True)
class Drawn(StateModel):
    """A linear model of numbers that are drawn, from epoch to epoch, its prior and its noise of any
    rank."""

    number: int
    moved_first: bool = True

    def _drawn(self, k: int, *shape: int):
        return np.random.default_rng([self.number, k]).normal(size=shape)

    @property
    def sizes(self):
        """States, readings and ranks of the prior and of the noise."""
        rng = np.random.default_rng(self.number)
        n = rng.integers(1, 5)
        return n, rng.integers(1, 4), rng.integers(0, n + 1), rng.integers(0, n + 1)

    @property
    def states(self):
        return tuple(Parameter(f"x{i}") for i in range(self.sizes[0]))

    @property
    def times(self):
        return np.arange(1.0, 9.0)

    @property
    def prior(self):
        n, _, rank, _ = self.sizes
        G = self._drawn(100, n, rank)
        return Normal(self._drawn(101, n), G @ G.T)

    def transition(self, x, k):
        n = self.sizes[0]
        return np.einsum("ij,...j->...i", self._drawn(200 + k, n, n) / np.sqrt(n), x) + 0.1 * k

    def observe(self, x, k):
        return np.einsum("ij,...j->...i", self._drawn(300 + k, *self.sizes[1::-1]), x)

    def gain(self, k):
        return self._drawn(400 + k % 3, self.sizes[0], self.sizes[3])

    def R(self, k):
        L = self._drawn(500 + k, self.sizes[1], self.sizes[1])
        return L @ L.T + 0.1 * np.eye(self.sizes[1])


@pytest.mark.oracle("own second implementation: Kalman filter and smoother", "steps of paths", 1e-9)
@pytest.mark.parametrize("number", range(8))
def test_a_step_from_anywhere_ends_at_the_smoothed_path_of_a_linear_model(number):
    model = Drawn(number, moved_first=number % 2 == 0)
    z = model.draw(0, 3).z
    z[1, 2:4] = np.nan
    z[2, :, :1] = np.nan
    tracks = Smoother(ekf()).track(model, z)
    mean, P = whole(tracks)
    density = PathDensity.of(model, z)
    at = density.settled(mean + np.random.default_rng(1).normal(size=mean.shape))
    # A start outside of the range of its prior has no density, but a step from there all the same.
    tangents = density.tangents(at)
    found = density.settled(at.x + density.step(tangents, at))
    assert_agrees(found.x, mean, rtol=1e-9, atol=1e-9)
    assert_agrees(found.cost, tracks.cost, rtol=1e-9, atol=1e-12)
    assert_agrees(density.spread(tangents, at)[0], P, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(("spread", "deviation"), [(1e3, 1e-3), (1e6, 1e-2), (1e7, 1.0)])
def test_a_wide_prior_costs_a_path_no_digits_of_its_covariance(spread, deviation):
    """A line through ten readings, of which the prior says nothing: (X' X)^-1 deviation^2 at its
    start."""
    model = straight_line(spread, deviation)
    z = model.draw(0, 2).z
    X = np.stack([np.ones(10), np.arange(1.0, 11.0)], axis=1)
    exact = deviation**2 * np.linalg.inv(X.T @ X)
    found = IteratedSmoother().track(model, z)
    np.testing.assert_allclose(found.start.covariance, np.stack([exact, exact]), rtol=1e-9)
    F = np.array([[1.0, 1.0], [0.0, 1.0]])
    np.testing.assert_allclose(found.covariance[:, 0], np.stack([F @ exact @ F.T] * 2), rtol=1e-9)
    # A cost may rise by a twentieth less than that of a normal density before it counts as bent.
    bent = LevenbergMarquardtSmoother().track(model, z)
    np.testing.assert_allclose(bent.start.covariance, found.start.covariance, rtol=5e-2)


@pytest.mark.parametrize("number", [0, 2, 3, 4])
def test_covariances_with_the_last_states_keep_their_digits_beside_a_wide_prior(number):
    """Against x = T u, u ~ N(0, I), by orthogonal rows: cov(x | readings) = T (I + T' B' B T)^-1
    T'."""
    model = widened(Drawn(number, moved_first=number % 2 == 0), 1e5)
    z = model.draw(0, 1).z
    density = PathDensity.of(model, z)
    at = density.settled(np.zeros((1, 9, model.n)))
    tangents = density.tangents(at)
    P, crossed, _ = density.spread(tangents, at)
    q = model.n
    roots = np.zeros((9, model.n, q))
    roots[0] = density.noise.start
    roots[1:, :, : density.gains.shape[2]] = density.gains
    T = np.zeros((9, model.n, 9 * q))
    T[0, :, :q] = roots[0]
    rows = [np.eye(9 * q)]
    for k in range(1, 9):
        T[k] = tangents.A[0, k - 1] @ T[k - 1]
        T[k, :, k * q : (k + 1) * q] = roots[k]
        rows.append(tangents.B[0, k - 1] @ T[k])
    R = np.linalg.qr(np.concatenate(rows))[1]
    Z = np.linalg.solve(R.T, T.reshape(-1, 9 * q).T).T.reshape(T.shape)
    size = np.sqrt(np.sum(Z**2, axis=2))
    exact = Z @ Z.swapaxes(1, 2)
    np.testing.assert_array_less(
        np.abs(P[0] - exact), 1e-6 * size[:, :, None] * size[:, None] + 1e-12
    )
    exact = Z @ Z[-1].T
    np.testing.assert_array_less(
        np.abs(crossed[0] - exact), 1e-6 * size[:, :, None] * size[-1] + 1e-12
    )


def test_the_length_of_a_step_is_in_deviations_of_the_path():
    """By a dense Hessian of the cost, from differences of what is quadratic."""
    model = ConstantVelocity(count=3, spread=2.0)
    density = PathDensity.of(model, model.draw(0, 1).z)
    x, step = np.random.default_rng(2).normal(size=(2, 1, 4, 2))
    at, up, down = (density.settled(x + sign * step) for sign in (0.0, 1.0, -1.0))
    curvature = (up.cost + down.cost - 2 * at.cost) / 2
    np.testing.assert_allclose(density.size(density.tangents(at), step), curvature, rtol=1e-9)


def test_readings_beyond_numbers_lose_their_own_trial_alone():
    model = Pendulum(count=25, start=(1.0, 0.0), spread=0.2)
    z = model.draw(0, 3).z
    spoiled = z.copy()
    spoiled[1, 5:9] = 1e308
    tracker = LevenbergMarquardtSmoother(starts=2)
    with np.errstate(all="ignore"):
        kept, lost = tracker.track(model, z), tracker.track(model, spoiled)
    assert not np.isfinite(lost.cost[1])
    assert lost.status[1] == Status.NONFINITE
    np.testing.assert_array_equal(lost.mean[::2], kept.mean[::2])
    np.testing.assert_array_equal(lost.covariance[::2], kept.covariance[::2])


def test_a_covariance_holds_where_the_valley_of_the_cost_bends():
    """Against quadrature: y = -x^2/16 along the valley, where tangents see a variance of y that is
    half the exact."""
    model = Formulas(
        next={"x": "x", "y": "y"},
        spread={"x": 1.0, "y": 1.0},
        readings={"z": "y + x**2/16"},
        deviation={"z": 0.1},
        count=1,
    )
    z = np.zeros((1, 1, 1))
    found = LevenbergMarquardtSmoother(tolerance=1e-6).track(model, z)
    x, y = np.meshgrid(np.linspace(-6, 6, 601), np.linspace(-6, 6, 1201), indexing="ij")
    w = np.exp(-(x**2 + y**2 + ((y + x**2 / 16) / 0.1) ** 2) / 2)
    exact = np.sum(w * y**2) / np.sum(w)
    density = PathDensity.of(model, z)
    at = density.settled(whole(found)[0])
    narrow = density.spread(density.tangents(at), at).covariance
    assert narrow[0, 0, 1, 1] < 0.6 * exact
    assert exact < found.covariance[0, 0, 1, 1] < 1.3 * exact


def test_a_covariance_holds_on_the_side_where_the_cost_rises_slowly():
    """Against quadrature: 2/(2 + x) tells little of large x, and tangents at the path see half of
    the variance."""
    model = Formulas(
        next={"x": "x"},
        spread={"x": 4.0},
        readings={"z": "2/(2 + x)"},
        deviation={"z": 0.1},
        count=1,
    )
    found = LevenbergMarquardtSmoother(tolerance=1e-6).track(model, np.full((1, 1, 1), 0.4))
    x = np.linspace(-1.9, 30, 4001)
    w = np.exp(-((x / 4) ** 2 + ((0.4 - 2 / (2 + x)) / 0.1) ** 2) / 2)
    exact = np.sum(w * (x - found.mean[0, 0, 0]) ** 2) / np.sum(w)
    assert 0.7 * exact < found.covariance[0, 0, 0, 0] < 1.3 * exact


def test_readings_of_the_other_sign_have_the_same_covariance():
    """A pendulum at rest and its mirror image: an axis along which the density is followed has no
    sign, so that neither side of it is the first."""
    model = Formulas(
        next={"angle": "angle + 0.1*rate", "rate": "rate - sin(angle) + w"},
        noise={"w": 0.3},
        spread={"angle": 1.0, "rate": 1.0},
        readings={"z": "sin(angle)"},
        deviation={"z": 0.3},
        count=6,
    )
    z = model.draw(0, 40).z
    tracker = LevenbergMarquardtSmoother(tolerance=1e-6)
    one, other = (tracker.track(model, sign * z) for sign in (1.0, -1.0))
    alike = np.abs(one.cost - other.cost) < 1e-6
    assert alike.mean() > 0.9
    assert (np.abs(one.mean + other.mean)[alike] < 1e-4).all()
    assert_agrees(other.covariance[alike], one.covariance[alike], rtol=1e-4, atol=1e-6)
