"""States that are known exactly and other singular covariances: against exact arithmetic."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import pytest
from shared.families import slow_if
from shared.oracles import assert_agrees
from shared.state_models import CoordinatedTurn, path_cost, straight_line

import ipe_bench as ib
from ipe_bench.basics.linalg import multiply
from ipe_bench.measurements import Parameter
from ipe_bench.states import (
    Bootstrap,
    Cubature,
    Filter,
    GaussHermite,
    IteratedSmoother,
    LevenbergMarquardtSmoother,
    Normal,
    Smoother,
    StateModel,
    Taylor,
    ckf,
    ekf,
    posterior_bounds,
    ukf,
)
from ipe_bench.states.algebra import mahalanobis
from ipe_bench.states.whole_paths import PathDensity
from ipe_bench.trials.paths import StateScenario


@dataclass(frozen=True)
class Linear(StateModel):
    """x[k] = F x[k-1] + G w, z = H x + v, of numbers that are exact in binary; the prior is G0
    G0'."""

    F: tuple = ((1.0, 1.0), (0.0, 1.0))
    G0: tuple = ((1.0, 0.0), (0.0, 1.0))
    G: tuple = ((0.5, 0.0), (0.25, 0.5))
    H: tuple = ((1.0, 0.0),)
    V: tuple = ((1.0,),)
    mean: tuple = (1.0, -2.0)
    moved_first: bool = True

    @property
    def times(self):
        return np.arange(1.0, 8.0)

    @property
    def states(self):
        return tuple(Parameter(f"x{i}") for i in range(len(self.F)))

    @property
    def prior(self):
        return Normal(np.array(self.mean), np.array(self.G0) @ np.array(self.G0).T)

    def transition(self, x, k):
        return np.einsum("ij,...j->...i", np.array(self.F), x)

    def observe(self, x, k):
        return np.einsum("ij,...j->...i", np.array(self.H), x)

    def gain(self, k):
        return np.array(self.G)

    def R(self, k):
        return np.array(self.V)


NONE = ((0.0, 0.0), (0.0, 0.0))
CASES = {
    "one state known and constant": Linear(G0=((1.0, 0.0), (0.0, 0.0)), G=((0.5, 0.0), (0.0, 0.0))),
    "one state known at first": Linear(G0=((1.0, 0.0), (0.0, 0.0))),
    "everything known": Linear(G0=NONE, G=NONE),
    "everything known at first": Linear(G0=NONE),
    "one error of two states": Linear(G0=((1.0, 0.0), (2.0, 0.0)), G=NONE),
    "no process noise": Linear(G=NONE),
    "process noise of rank 1": Linear(G=((0.0,), (0.25,))),
    "a state that is forgotten": Linear(F=((0.0, 1.0), (0.0, 1.0)), G=((0.0,), (0.25,))),
    "states that become one": Linear(F=((1.0, 1.0), (1.0, 1.0)), G=NONE, V=((4.0,),)),
    "readings of what is known": Linear(F=((1.0, 0.0), (0.0, 1.0)), G0=((0.0, 0.0), (0.0, 1.0)),
                                        G=NONE),
    "the same reading twice": Linear(G0=NONE, H=((1.0, 0.0),) * 2, V=((1.0, 0.5), (0.5, 1.0)),
                                     G=((1.0,), (1.0,))),
    "nearly exact readings": Linear(G0=((2.0, 0.0), (0.0, 0.0)), V=((2.0**-30,),)),
    "a vague and a known state": Linear(G0=((2.0**12, 0.0), (0.0, 0.0)), G=((0.0,), (0.25,))),
    "no first transition": Linear(G0=((1.0, 0.0), (2.0, 0.0)), G=((0.0,), (0.25,)),
                                  moved_first=False),
    "constants, read before any transition": Linear(F=((1.0, 0.0), (0.0, 1.0)), G=NONE,
                                                    moved_first=False),
    "three states of rank 1": Linear(
        F=((1.0, 0.5, 0.25), (0.0, 1.0, 0.5), (0.0, 0.0, 1.0)),
        G0=((1.0,), (0.5,), (0.25,)), G=((0.0,), (0.0,), (0.5,)), H=((1.0, 0.0, 0.0),),
        mean=(0.0, 1.0, 2.0),
    ),
}  # fmt: skip
FILTERS = {
    "ekf": ekf(),
    "ukf": ukf(),
    "ckf": ckf(),
    "ghkf": Filter(GaussHermite(2)),
    "iplf": Filter(Cubature(), 3),
}
SMOOTHERS = {name: Smoother(tracker) for name, tracker in FILTERS.items()} | {
    "ieks": IteratedSmoother(ekf(), Taylor(), 4),
    "damped": IteratedSmoother(ukf(), Taylor(), 4, damped=True),
    "ipls": IteratedSmoother(ukf(), Cubature(), 4),
    "lm": LevenbergMarquardtSmoother(tolerance=1e-9, starts=0),
}


def exact(model, z):
    """Means (K, n) and covariances (K, n, n) of the states given all readings, and given those up
    to each epoch, in fractions: conditional expectations of one joint normal distribution."""

    def rational(a):
        return np.vectorize(Fraction)(np.array(a, dtype=float))

    F, H, V, Q, z = (rational(a) for a in (model.F, model.H, model.V, model.Q(0), z))
    (m, P), K, n = map(rational, model.prior), len(z), model.n
    X, means = np.zeros((0, 0), dtype=object) + Fraction(0), []
    for k in range(K):  # the covariance of the states of all epochs so far
        if k:
            cross = F.dot(X[-n:])
            P = F.dot(X[-n:, -n:]).dot(F.T) + Q
            X = np.block([[X, cross.T], [cross, P]])
            m = F.dot(m)
        else:
            m, P = (F.dot(m), F.dot(P).dot(F.T) + Q) if model.moved_first else (m, P)
            X = P
        means.append(m)
    mean = np.concatenate(means)
    A, R = (np.kron(np.eye(K, dtype=int), part) for part in (H, V))

    def given(epochs):
        rows = slice(0, epochs * len(H))
        C = X.dot(A[rows].T)
        gain = C.dot(inverse(A[rows].dot(C) + R[rows, rows]))
        return mean + gain.dot(z.ravel()[rows] - A[rows].dot(mean)), X - gain.dot(C.T)

    def each(distributions):
        parts = [
            (m[i : i + n], P[i : i + n, i : i + n])
            for i, (m, P) in zip(range(0, K * n, n), distributions, strict=True)
        ]
        return [np.array(part, dtype=float) for part in zip(*parts, strict=True)]

    return each([given(K)] * K), each([given(k + 1) for k in range(K)])


def inverse(A):
    """Of a regular matrix of fractions, by Gauss and Jordan."""
    n = len(A)
    M = np.hstack([A, np.eye(n, dtype=int) * Fraction(1)])
    for i in range(n):
        M[i] = M[i] / M[i, i]  # positive definite: no pivot is 0
        for j in set(range(n)) - {i}:
            M[j] = M[j] - M[i] * M[j, i]
    return M[:, n:]


@pytest.mark.oracle(
    "closed form: conditional means of normal states, in fractions",
    "means and covariances of 16 singular cases by 14 trackers",
    1e-8,
)
@pytest.mark.parametrize("case", slow_if(lambda case: [*CASES].index(case) % 8, CASES))
def test_singular_cases_have_their_exact_conditional_means(case):
    model = CASES[case]
    z = np.round(model.draw(0, 1).z * 64) / 64
    (mean, P), (filtered, P_filtered) = exact(model, z[0])
    for trackers, m, C in ((FILTERS, filtered, P_filtered), (SMOOTHERS, mean, P)):
        for tracker in trackers.values():
            track = tracker.track(model, z)
            assert_agrees(track.mean[0], m, rtol=1e-9, atol=1e-9)
            assert_agrees(track.covariance[0], C, rtol=1e-8, atol=1e-9)


@dataclass(frozen=True)
class Known(CoordinatedTurn):
    """The turn whose rate at the start is known exactly, and never walks."""

    known: float = 0.0

    @property
    def prior(self):
        m, P = super().prior
        return Normal(m, np.diag([*np.diagonal(P)[:4], self.known]))


TRACKERS = {"ukf": ukf(), **SMOOTHERS}


@pytest.mark.parametrize(
    "walk", [pytest.param(1.75e-4, marks=pytest.mark.slow), 0.0], ids=["walks", "constant"]
)
@pytest.mark.parametrize(
    "label", slow_if(lambda label: label in ("ipls", "iplf", "lm", "damped"), TRACKERS)
)
def test_a_rate_known_exactly_is_the_limit_of_a_rate_known_well(label, walk):
    tracker = TRACKERS[label]
    known, nearly = (Known(count=25, walk=walk, known=variance) for variance in (0.0, 1e-20))
    paths = known.draw(0, 6)
    whole, limit = tracker.track(known, paths.z), tracker.track(nearly, paths.z)
    size = np.sqrt(np.diagonal(limit.covariance, axis1=2, axis2=3))
    far = (
        1e-3 if tracker is not SMOOTHERS["damped"] else 0.05
    )  # whose steps are halved at discrete points
    assert np.abs((whole.mean - limit.mean) / np.where(size > 1e-9, size, 1.0)).max() < far
    assert np.array_equal(tracker.track(known, paths.z[2:3]).mean, whole.mean[2:3])


def test_damped_steps_keep_to_paths_that_the_process_noise_reaches():
    model = Known(count=25, walk=0.0, known=1e-2)
    paths = model.draw(0, 8)
    found = {
        damped: IteratedSmoother(ekf(), Taylor(), 15, damped).track(model, paths.z)
        for damped in (False, True)
    }
    cost = {damped: path_cost(model, paths.z, t.start.mean, t.mean) for damped, t in found.items()}
    assert np.isfinite(cost[True]).all()
    assert (cost[True] <= cost[False] * (1 + 1e-9)).all()
    assert np.ptp(found[True].mean[..., 4], axis=1).max() == 0.0
    np.testing.assert_allclose(found[True].cost, cost[True], rtol=1e-9)


def test_a_distance_outside_of_the_range_is_infinite():
    P = np.array([[1.0, 2.0, 0.0], [2.0, 4.0, 0.0], [0.0, 0.0, 0.0]])
    e = np.array([[1.0, 2.0, 0.0], [1.0, 2.1, 0.0], [0.0, 0.0, 1e-9], [-3.0, -6.0, 0.0]])
    np.testing.assert_allclose(mahalanobis(e, P), [1.0, np.inf, np.inf, 9.0], rtol=1e-12)


def test_a_singular_prior_a_thousand_times_as_wide_as_a_reading_is_smoothed_exactly():
    model = Linear(
        F=((-0.75, -0.25, 0.75), (1.5, -1.25, 1.5), (1.25, 0.75, 0.25)),
        G0=((-256.0, 1536.0), (2048.0, 1792.0), (1280.0, 256.0)),
        G=((0.0,), (0.0,), (0.0,)),
        H=((-1.25, 0.0, 0.75),),
        mean=(1.0, 2.0, 3.0),
        moved_first=False,
    )
    z = model.draw(0, 1).z
    (mean, P), _ = exact(model, z[0])
    for first in (ekf(), ckf()):
        found = Smoother(first).track(model, z)
        np.testing.assert_allclose(found.mean[0], mean, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(found.covariance[0], P, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(("n", "rank"), [(5, 3), (12, 12)], ids=["singular", "regular"])
def test_a_distance_has_the_same_bits_alone_and_in_a_batch(n, rank):
    rng = np.random.default_rng(0)
    G = rng.normal(size=(n, rank))
    e = multiply(G, rng.normal(size=(40, rank)))
    together = mahalanobis(e, G @ G.T)
    assert np.isfinite(together).all()
    alone = [mahalanobis(one[None], G @ G.T)[0] for one in e]
    np.testing.assert_array_equal(together, alone)


def test_a_path_of_a_singular_start_settles_with_the_same_bits_alone_and_in_a_batch():
    F = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    G0 = ((0.3, 1.7), (-1.1, 0.4), (0.7, 0.9))
    model = Linear(F=F, G0=G0, G=F, H=F[:1], mean=(1.0, 2.0, 3.0))
    paths = model.draw(0, 40)
    x = np.concatenate([paths.start[:, None], paths.x], axis=1) + 1e-12
    density = PathDensity.of(model, paths.z)
    together = density.settled(x)
    for i in range(40):
        alone = density.subset(np.array([i])).settled(x[[i]])
        np.testing.assert_array_equal(alone.x[0], together.x[i])
        np.testing.assert_array_equal(alone.cost[0], together.cost[i])


def test_bounds_exist_where_the_start_is_known():
    model = Linear(G0=((1.0, 0.0), (2.0, 0.0)))
    paths = model.draw(0, 3)
    filtered, smoothed = posterior_bounds(model, paths)
    np.testing.assert_allclose(filtered, ekf().track(model, paths.z).covariance[0], rtol=1e-10)
    np.testing.assert_allclose(
        smoothed, Smoother(ekf()).track(model, paths.z).covariance[0], rtol=1e-10
    )


@pytest.mark.parametrize("wide", [2.0**4, 2.0**24])
def test_bounds_keep_their_digits_beside_a_wide_start_and_little_noise(wide):
    """Of two constants that hardly walk their sum is read: informations of noise, start and
    readings differ by up to 26 digits."""
    still = ((1.0, 0.0), (0.0, 1.0))
    little = ((2.0**-20, 0.0), (0.0, 2.0**-20))
    model = Linear(F=still, G0=((wide, 0.0), (0.0, wide)), G=little, H=((1.0, 0.5),))
    paths = model.draw(0, 3)
    (_, smoothed), (_, filtered) = exact(model, paths.z[0])
    found = posterior_bounds(model, paths)
    np.testing.assert_allclose(found[0], filtered, rtol=1e-9)
    np.testing.assert_allclose(found[1], smoothed, rtol=1e-9)


def test_particles_of_known_states_stand_on_them():
    model = CASES["everything known"]
    paths = model.draw(0, 2)
    np.testing.assert_allclose(Bootstrap(20).track(model, paths.z).mean, paths.x, rtol=1e-12)


@dataclass(frozen=True)
class ExactLater(Linear):
    """A model whose third reading has no error."""

    def R(self, k):
        return (k != 2) * super().R(k)


def test_a_product_rule_of_too_many_points_is_refused():
    with pytest.raises(
        ib.UserError, match=r"order=3: 3\^22 points for 22 states; choose the rule Cubature"
    ):
        GaussHermite(3).points(22)


def test_exact_readings_are_refused():
    with pytest.raises(
        ib.UserError,
        match="R of epoch 3 is singular; give every reading a standard deviation above 0",
    ):
        StateScenario(ExactLater())


def least_squares(X, z):
    """The coefficients of X (K, n) that fit z best, in fractions."""
    X, z = np.vectorize(Fraction)(X), np.vectorize(Fraction)(z)
    return inverse(X.T.dot(X)).dot(X.T.dot(z))


WIDE = {
    "ekf": ekf(),
    "ukf": ukf(),
    "iplf": Filter(Cubature(), 3),
    "ekf_rts": Smoother(ekf()),
    "ckf_rts": Smoother(ckf()),
    "ieks": IteratedSmoother(ekf(), Taylor(), 4),
    "ipls": IteratedSmoother(ukf(), Cubature(), 4),
    "lm": LevenbergMarquardtSmoother(starts=0),
    "auto": ib.states.AutoTracker(),
    "ipe": ib.component("tracker/ipe_newton"),
}


@pytest.mark.parametrize(("spread", "deviation"), [(1e6, 1e-2), (1e6, 1e-6)])
@pytest.mark.parametrize("label", WIDE)
def test_a_wide_prior_costs_no_digits_of_what_precise_readings_leave(label, spread, deviation):
    """A line through ten readings, of which the prior says nothing: its last state is as uncertain
    as that of least squares, and a smoother's path is their line."""
    model = straight_line(spread, deviation)
    z = model.draw(0, 2).z
    # Its value at the last reading, and its slope.
    X = np.stack([np.ones(10), np.arange(-9.0, 1.0)], axis=1)
    P = deviation**2 * np.linalg.inv(X.T @ X)
    size = np.sqrt(np.diagonal(P))
    line = np.array([[float(c) for c in least_squares(X, one)] for one in z[:, :, 0]])
    # Readings of ten million to a millionth hold three digits of their deviation.
    digits = 5e-2 if deviation < 1e-3 else 1e-5
    tracks = WIDE[label].track(model, z)
    far = digits + WIDE[label].smooths * 1e-2 * (label in ("lm", "auto"))
    np.testing.assert_allclose((tracks.mean[:, -1] - line) / size, 0.0, atol=far)
    scaled = tracks.covariance[:, -1] / np.outer(size, size)
    np.testing.assert_allclose(scaled, [P / np.outer(size, size)] * 2, atol=digits)
    if WIDE[label].smooths:
        back = np.array([[1.0, -10.0], [0.0, 1.0]])
        begun = back @ P @ back.T
        scaled = tracks.start.covariance / np.sqrt(np.outer(np.diag(begun), np.diag(begun)))
        exact = begun / np.sqrt(np.outer(np.diag(begun), np.diag(begun)))
        np.testing.assert_allclose(scaled, [exact] * 2, atol=digits)
    alone = WIDE[label].track(model, z[1:])
    assert np.array_equal(alone.mean[0], tracks.mean[1])
    assert np.array_equal(alone.covariance[0], tracks.covariance[1])


@pytest.mark.parametrize(
    "G0",
    [((2.0**-2, 0.0), (0.0, 2.0**27)), ((2.0**27,), (2.0**28,))],
    ids=["one wide state of two", "one error of both"],
)
@pytest.mark.parametrize("label", ["ekf_rts", "ckf_rts", "ieks", "lm", "auto"])
def test_a_path_keeps_its_digits_where_its_start_is_wide_in_one_direction(label, G0):
    """The mean lay a deviation beside the exact one, and up to millions of them."""
    model = Linear(G0=G0, G=NONE)
    z = np.round(model.draw(0, 1).z)
    (mean, P), _ = exact(model, z[0])
    tracks = WIDE[label].track(model, z)
    size = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    np.testing.assert_allclose((tracks.mean[0] - mean) / size, 0.0, atol=1e-5)
    found = np.sqrt(np.diagonal(tracks.covariance[0], axis1=1, axis2=2))
    np.testing.assert_allclose(found, size, rtol=1e-6)


@pytest.mark.parametrize("label", WIDE)
def test_what_digits_do_not_hold_is_not_reported(label):
    """A prior of 1e8 m, of which a reading leaves 1e-7 m: round-off of the one is that of the
    other, and a prior of 1 m beside it loses nothing."""
    z = straight_line(1.0, 1e-7).draw(0, 2).z
    lost = WIDE[label].track(straight_line(1e8, 1e-7), z)
    assert not np.isfinite(lost.covariance).any()
    found = WIDE[label].track(straight_line(1.0, 1e-7), z)
    assert np.isfinite(found.covariance).all()


def test_points_about_a_path_that_is_singular_but_for_round_off_find_its_digits():
    """Of two wide constants their sum is read: posterior linearisation was a deviation off."""
    wide = ((2.0**14, 0.0), (0.0, 2.0**14))
    still = ((1.0, 0.0), (0.0, 1.0))
    model = Linear(F=still, G0=wide, G=NONE, H=((1.0, 0.5),), V=((2.0**-26,),))
    z = np.round(model.draw(0, 1).z)
    (mean, P), _ = exact(model, z[0])
    read = np.array(model.H[0])
    # Seven readings of a sum of which nothing was known.
    deviation = 2.0**-13 / np.sqrt(7)
    tracks = WIDE["ipls"].track(model, z)
    np.testing.assert_allclose((tracks.mean[0] - mean) @ read / deviation, 0.0, atol=1e-3)
    np.testing.assert_allclose(tracks.covariance[0], P, rtol=1e-9)
    assert np.isfinite(WIDE["ukf"].track(model, z).covariance).all()


def test_states_too_large_for_the_digits_of_their_readings_are_not_reported():
    """A float of 1e9 m holds 1e-7 m, a hundred times the deviation of a reading; of one trial
    alone the other has its digits."""
    model = straight_line(1e2, 1e-9)
    z = model.draw(0, 2).z
    z[1] += 1e9
    tracks = ekf().track(model, z)
    assert np.isfinite(tracks.covariance[0]).all()
    assert not np.isfinite(tracks.mean[1]).any()


@pytest.mark.parametrize("label", ["ieks", "auto"])
def test_what_is_known_without_any_noise_stays_what_it_is(label):
    """Of a model of no error at all no start and no step has a column of noise."""
    model = Linear(G0=((0.0,), (0.0,)), G=((), ()))
    paths = model.draw(0, 2)
    tracks = WIDE[label].track(model, paths.z)
    np.testing.assert_allclose(tracks.mean, paths.x, rtol=1e-12)
    np.testing.assert_array_equal(tracks.covariance, 0.0)
