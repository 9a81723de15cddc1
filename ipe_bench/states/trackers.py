"""Trackers of state models, readings (trials, K, m) in, means and covariances of the states out:
Gaussian filters.

All trials advance together. A reading that is NaN is missing; a trial whose covariance is no longer
positive definite is NaN from then on and disturbs no other.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.batches import join
from ipe_bench.basics.linalg import Array, Mask, multiply
from ipe_bench.basics.options import Component, Count
from ipe_bench.states.algebra import factor, lower_solve, symmetric, transposed, upper_solve
from ipe_bench.states.base import Normal, StateModel
from ipe_bench.states.linearisation import Affine, Cubature, Rule, Taylor, Unscented


@dataclass
class Tracks:
    """Holds what a tracker says of the states at K epochs, and what its smoother needs."""

    mean: Array
    """(trials, K, n)"""
    covariance: Array
    """(trials, K, n, n)"""
    nis: Array
    """Squared normalised innovations (trials, K), chi-square with `degrees` if the model holds; 0
    in smoothers, NaN where there are none."""
    innovations: Array
    """Normalised innovations (trials, K, m), independent and N(0, 1) if the model holds; NaN of
    missing readings and in trackers that have none."""
    degrees: Array
    """Readings that were there (trials, K)."""
    log_likelihood: Array
    """Of the readings by the innovations (trials,)."""
    calls: Array
    """Evaluations of f and of h (trials,): as many as if the trial were alone."""
    start: Normal
    """The states before the first transition."""
    moves: list[Affine] = field(default_factory=list)
    """The transitions as they were linearised."""
    predicted: list[Normal] = field(default_factory=list)
    """The states after each transition, before the reading."""
    effective: Array | None = None
    """Effective sample sizes 1 / sum w^2 (trials, K) of weighted samples."""
    reads: list[tuple[Array, Array]] = field(default_factory=list)
    """H (trials, m, n) of the readings of each epoch as they were linearised, 0 of missing ones and
    of particles, and L (trials, m, m) with L L' = S of their innovations."""
    cost: Array | None = None
    """-2 log p(path | readings) (trials,) of an iterated smoother up to a constant, or the NIS of
    the filter behind a smoother: chi-square with a degree per reading; see `path_p`."""
    status: NDArray[np.int8] | None = None
    """How the iterations of a trial ended (trials,), in trackers that iterate until they have
    converged."""
    iterations: NDArray[np.int64] | None = None
    """Steps of each trial (trials,), likewise."""
    stage: NDArray[Any] | None = None
    """Which stage of a tracker of several answered (trials,)."""
    other: Array | None = None
    """A second path (trials, K, n) where one was found, else the means, in trackers that look for
    one."""
    other_p: Array | None = None
    """The probability (trials,) of the second path beside the first, 0 where none was found."""

    @classmethod
    def empty(cls, model: StateModel, trials: int) -> Tracks:
        K = model.epochs
        n = model.n
        return cls(
            mean=np.empty((trials, K, n)),
            covariance=np.empty((trials, K, n, n)),
            nis=np.zeros((trials, K)),
            innovations=np.full((trials, K, model.readings_per_epoch), np.nan),
            degrees=np.zeros((trials, K)),
            log_likelihood=np.zeros(trials),
            calls=np.zeros(trials),
            start=spread_prior(model, trials),
        )

    def at(self, k: int) -> Normal:
        """Returns the states at epoch k; before the first transition if that is -1."""
        return self.start if k < 0 else Normal(self.mean[:, k], self.covariance[:, k])

    def note(self, k: int, found: Update) -> Normal:
        """Returns the states after the readings of epoch k, which the tracks keep with what the
        innovation says."""
        self.mean[:, k] = found.x.mean
        self.covariance[:, k] = found.x.covariance
        self.log_likelihood += found.log_likelihood
        self.note_innovation(k, found)
        return found.x

    def note_innovation(self, k: int, found: Update) -> None:
        """Keeps what the innovation of epoch k says of the filter."""
        self.nis[:, k] = found.nis
        self.innovations[:, k] = found.innovation
        self.degrees[:, k] = found.degrees
        if found.read is not None:
            self.reads.append(found.read)

    def predicted_readings(self, z: Array) -> tuple[Array, Array]:
        """Returns the readings (trials, K, m) that a filter predicted of those of z (trials, K, m)
        that were there, and their standard deviations; NaN in trackers that have no innovations."""
        mean = np.full(z.shape, np.nan)
        deviation = np.full(z.shape, np.nan)
        for k, (_, L) in enumerate(self.reads):
            # z - h = L e for normalised innovations e, and diag(S) = diag(L L').
            y = multiply(L, np.nan_to_num(self.innovations[:, k]))
            mean[:, k] = z[:, k] - y
            deviation[:, k] = np.linalg.norm(L, axis=-1)
        there = np.isfinite(self.innovations)
        return np.where(there, mean, np.nan), np.where(there, deviation, np.nan)

    @classmethod
    def lost(cls, model: StateModel, trials: int) -> Tracks:
        """Returns tracks of which nothing is known."""
        tracks = cls.empty(model, trials)
        tracks.mean[:] = np.nan
        tracks.covariance[:] = np.nan
        return tracks

    @classmethod
    def join(cls, parts: Sequence[Tracks]) -> Tracks:
        """Joins the trials of several batches one after another, without what smoothers need; what
        trials lack that others have is NaN, or the status and the iterations of none."""
        alone = [replace(part, moves=[], predicted=[], reads=[]) for part in parts]
        joined = join(alone)
        if joined.status is not None:
            joined.status = np.nan_to_num(joined.status).astype(np.int8)
        if joined.iterations is not None:
            joined.iterations = np.nan_to_num(joined.iterations).astype(np.int64)
        return joined


class Tracker(Component, ABC):
    """Estimates the states of every trial from its readings. A new tracker is a frozen dataclass
    whose fields are its options, and the identity of its results.

    Required: `track(model, z)`, which returns `Tracks`. `Tracks.empty(model, trials)` has the
    arrays to be filled. Optional: `look`; `hindrance(model)`, asked before any work; `smooths`, if
    later readings count, whose error over the path is then held against a smoother's bound. A
    filter of a new `Rule` needs no tracker of its own. Promised: readings that are NaN are missing;
    a trial has the same bits alone and in any batch, its random numbers included; a trial that
    breaks down is NaN, or raises if it is alone, and disturbs no other.

    >>> from ipe_bench.states import Formulas
    >>> @dataclass(frozen=True)
    ... class DeadReckoning(Tracker):
    ...     def track(self, model, z):
    ...         return filtered(model, np.full_like(z, np.nan), Taylor())
    >>> drift = {"next": {"p": "p + w"}, "readings": {"z": "p"}, "noise": {"w": 1}}
    >>> model = Formulas(**drift, deviation={"z": 2}, spread={"p": 1}, count=3)
    >>> print(DeadReckoning().track(model, model.draw(0, 5).z).covariance[4, :, 0, 0])
    [2. 3. 4.]
    """

    needs: ClassVar[frozenset[str]] = frozenset({"epochs", "prior"})
    equation: ClassVar[None] = None
    family: ClassVar[str] = "filters"
    look: ClassVar[tuple[str, str] | None] = None
    """As that of an estimator."""
    smooths: bool = False
    """Whether each epoch is estimated from all readings, those of later epochs included."""

    def hindrance(self, model: StateModel) -> str | None:
        """Says, in words that follow the tracker's label, why it does not suit the model; None if
        it does. A tracker that takes noise by `Q_at` and `R_at` says so by a method of its own."""
        if model.gain_by_state or model.R_by_state:
            return (
                f"takes noise that does not depend on the states; in {model.name} it does; "
                "leave it out"
            )
        return None

    @abstractmethod
    def track(self, model: StateModel, z: Array) -> Tracks:
        """Estimates the states from readings z (trials, K, m)."""


def spread_prior(model: StateModel, trials: int) -> Normal:
    """Returns the prior of each trial."""
    m, P = model.prior
    return Normal(np.repeat(m[None], trials, axis=0), np.repeat(P[None], trials, axis=0))


def predict(x: Normal, move: Affine, Q: Array) -> Normal:
    """Moves the states by A x + b + e + w, with e ~ N(0, W) of the rule and process noise w ~ N(0,
    Q (n, n)):

    m <- A m + b
    P <- A P A' + W + Q
    """
    m = multiply(move.A, x.mean) + move.b
    APA = np.matmul(np.matmul(move.A, x.covariance), transposed(move.A))
    return Normal(m, symmetric(APA + move.W + Q))


def linearised_move(
    model: StateModel, rule: Rule, k: int, x: Normal, to: Array | None = None
) -> Affine:
    """Linearises f about the states x; periodic states next to those of `to` (trials, n), if these
    are given."""
    periodic = bool(model.state_periods)
    nearest = model.nearest_state if periodic else None
    move = rule.linearise(model.transition_into(k), *x, nearest)
    if to is None or not periodic:
        return move
    # b takes the whole periods between f(x) and the path.
    value = multiply(move.A, x.mean) + move.b
    return move._replace(b=move.b + model.nearest_state(value, to) - value)


def linearised_reading(model: StateModel, rule: Rule, k: int, z: Array, x: Normal) -> Affine:
    """Linearises h about the states x, periodic readings next to the readings z (trials, m)."""
    nearest = model.nearest if model.periods else None
    read = rule.linearise(model.observation_at(k), *x, nearest)
    # b takes the whole periods between h(x) and the readings that are there.
    value = multiply(read.A, x.mean) + read.b
    to = np.where(np.isfinite(z), z, value)
    return read._replace(b=read.b + model.nearest(value, to) - value)


class Update(NamedTuple):
    """Holds the states after a reading, and what the innovation says of the filter."""

    x: Normal
    innovation: Array
    nis: Array
    degrees: Array
    log_likelihood: Array
    read: tuple[Array, Array] | None = None
    """H and L of `Tracks.reads`."""

    @classmethod
    def of(cls, x: Normal, y: Array, L: Array, seen: Mask, H: Array | None = None) -> Update:
        """Holds the states x after an innovation y (trials, m) of covariance L L', by a reading of
        slope H (trials, m, n); only readings that are `seen` count."""
        # The normalised innovation e = L^-1 y has the NIS y' S^-1 y = e' e.
        e = lower_solve(L, y[..., None])[..., 0]
        nis = np.sum(e**2, axis=-1)
        degrees = seen.sum(axis=-1)
        # log N(y; 0, S), S = L L', of which a missing reading has no part.
        log_determinant = 2 * np.log(np.diagonal(L, axis1=-2, axis2=-1)).sum(axis=-1)
        log_likelihood = -0.5 * (nis + log_determinant + degrees * np.log(2 * np.pi))
        read = None if H is None else (H, L)
        return cls(x, np.where(seen, e, np.nan), nis, degrees, log_likelihood, read)


def update(x: Normal, read: Affine, R: Array, z: Array) -> Update:
    """Takes in the readings z = H x + b + e + v (trials, m), e ~ N(0, W) of the rule and v ~ N(0, R
    (m, m)):

        y = z - H m - b,   S = H P H' + W + R,   K = P H' S^-1
        m <- m + K y
        P <- (I - K H) P (I - K H)' + K (W + R) K'

    This form of P, Joseph's, stays positive definite where the prior is much wider than R. A
    missing reading has no slope and unit variance.
    """
    m, P = x
    seen = np.isfinite(z)
    both = seen[..., :, None] & seen[..., None, :]
    H = np.where(seen[..., None], read.A, 0.0)
    y = np.where(seen, z - multiply(read.A, m) - read.b, 0.0)
    noise = np.where(both, read.W + R, np.eye(R.shape[-1]))
    # S = L L'
    PH = np.matmul(P, transposed(H))
    L = factor(np.matmul(H, PH) + noise)
    # K' = S^-1 H P = L^-T L^-1 (P H')'
    K = transposed(upper_solve(L, lower_solve(L, transposed(PH))))
    rest = np.eye(m.shape[-1]) - np.matmul(K, H)
    unread = np.matmul(np.matmul(rest, P), transposed(rest))
    added = np.matmul(np.matmul(K, noise), transposed(K))
    after = Normal(m + multiply(K, y), symmetric(unread + added))
    return Update.of(after, y, L, seen, H)


@dataclass(frozen=True)
class Filter(Tracker):
    """A Gaussian filter: predict by the linearised transition, update by the linearised reading.

    With `iterations` above 1 the reading is linearised again about its posterior: by Taylor's rule
    the iterated extended Kalman filter (Bell and Cathey, IEEE TAC 38, 1993), by sigma points the
    iterated posterior linearisation filter (García-Fernández, Svensson, Morelande, Särkkä, IEEE TSP
    63, 2015).

    Noise that depends on the states counts by its mean covariance over the states about which f or
    h is linearised: Taylor's rule takes Q and R at their mean, sigma points the weighted mean of Q
    and R at the points, which is exact to the degree of the rule (Tronarp, García-Fernández,
    Särkkä, IEEE SPL 25, 2018).

    Example:

    >>> import ipe_bench as ib
    >>> model = ib.component("state_model/pendulum", count=20, spread={"angle": 0.3, "rate": 0.3})
    >>> trackers = {"iekf": ib.states.Filter(rule=ib.states.Taylor(), iterations=5)}
    >>> table = ib.run(model, trackers, trials=20)
    >>> float(table.iloc[-1]["success"])
    1.0
    """

    rule: Rule = field(default_factory=Taylor)
    """How transition and reading are linearised."""
    iterations: Count = 1
    """Linearisations of each reading."""

    def hindrance(self, model: StateModel) -> str | None:
        if not model.R_by_state:
            return None
        m, P = model.prior
        x = m + np.sqrt(np.diagonal(P)) * np.array([[0.0], [1.0], [-0.7]])
        h = model.observe(x, 0)
        if (h == h[0]).all():
            return (
                f"takes in readings by their mean, which in {model.name} no state changes; "
                "choose bootstrap or grid"
            )
        return None

    def track(self, model: StateModel, z: Array) -> Tracks:
        return filtered(model, z, self.rule, self.iterations)


def filtered(
    model: StateModel,
    z: Array,
    rule: Rule,
    iterations: int = 1,
    path: Tracks | None = None,
    start: Normal | None = None,
) -> Tracks:
    """Runs the filter of the model that a rule linearises about the filter's own states, or about
    those of a path; `start` replaces the prior."""
    out = Tracks.empty(model, len(z))
    out.start = start or out.start
    x = out.start
    for k in range(model.epochs):
        if model.moves(k):
            # f is linearised about the filter's states, or about those of the path.
            at = x if path is None else path.at(k - 1)
            to = None if path is None else path.mean[:, k]
            move = linearised_move(model, rule, k, at, to)
            Q = rule.mean(partial(model.Q_at, k=k), *at) if model.gain_by_state else model.Q(k)
            x = predict(x, move, Q)
            out.moves.append(move)
            out.predicted.append(x)
        at = x if path is None else path.at(k)
        found = None
        for _ in range(iterations):
            # Each iteration takes the readings into the prediction x, h linearised about the
            # states that the last one found.
            R = rule.mean(partial(model.R_at, k=k), *at) if model.R_by_state else model.R(k)
            read = linearised_reading(model, rule, k, z[:, k], at)
            found = update(x, read, R, z[:, k])
            at = found.x
        assert found is not None
        x = out.note(k, found)
    calls_of_f = rule.calls(model.n, bool(model.state_periods))
    calls_of_h = rule.calls(model.n, bool(model.periods))
    out.calls += calls_of_f * len(out.moves) + calls_of_h * iterations * model.epochs
    return out


def misfit(model: StateModel, z: Array, x: Array, k: int) -> tuple[Array, Array]:
    """Computes (z - h)' R^-1 (z - h) (trials, N) of states x (trials, N, n) over the readings z
    (trials, m) of epoch k that are there, and log det 2 pi R (trials,) of these."""
    return squares(residuals(model, z, x, k), z, model.R(k))


def residuals(model: StateModel, z: Array, x: Array, k: int) -> Array:
    """Computes z - h (trials, N, m) of states x (trials, N, n) at epoch k; 0 of missing
    readings."""
    seen = np.isfinite(z)
    h = model.observe_near(x, k, np.where(seen, z, 0.0))
    return np.where(seen[:, None], z[:, None] - h, 0.0)


def squares(r: Array, z: Array, R: Array) -> tuple[Array, Array]:
    """Computes r' R^-1 r (trials, N) of residuals r (trials, N, m), and log det 2 pi R (trials,),
    over readings z (trials, m) that are there; of an R (trials, N, m, m) for each residual the sum
    of both, and 0."""
    seen = np.isfinite(z)
    if R.ndim > 3:
        # Each residual with its own R is a trial of its own.
        trials, N, m = r.shape
        each, size = squares(
            r.reshape(-1, 1, m),
            np.repeat(z, N, axis=0),
            R.reshape(-1, m, m),
        )
        return (each[:, 0] + size).reshape(trials, N), np.zeros(trials)
    # A missing reading has unit variance, whose logarithm is 0.
    both = seen[:, :, None] & seen[:, None, :]
    L = factor(np.where(both, R, np.eye(z.shape[1])))
    log_determinant = 2 * np.log(np.diagonal(L, axis1=1, axis2=2)).sum(axis=1)
    size = log_determinant + np.log(2 * np.pi) * seen.sum(axis=1)
    return np.sum(lower_solve(L, transposed(r)) ** 2, axis=1), size


def ekf(iterations: int = 1) -> Filter:
    """Returns the extended Kalman filter; iterated (IEKF) with more than one iteration."""
    return Filter(Taylor(), iterations)


def ukf(kappa: float | None = None) -> Filter:
    """Returns the unscented Kalman filter."""
    return Filter(Unscented(kappa))


def ckf() -> Filter:
    """Returns the cubature Kalman filter, which draws its points again after the prediction."""
    return Filter(Cubature())
