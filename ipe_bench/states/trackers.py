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
from ipe_bench.basics.linalg import Array, Mask, finite, multiply
from ipe_bench.basics.options import Component, Count
from ipe_bench.states.algebra import (
    factor,
    half,
    lower_solve,
    symmetric,
    transposed,
    upper_solve,
)
from ipe_bench.states.base import Normal, StateModel
from ipe_bench.states.linearisation import (
    Affine,
    Cubature,
    Function,
    Nearest,
    Rule,
    Taylor,
    Unscented,
)
from ipe_bench.states.redone import believed
from ipe_bench.states.roots import Chain, Rooted, Smooth, Step, beyond_digits, precise

_STEEPEST = 1e6
"""Largest slope about a path that is taken for one, and not for round-off."""
_PRECISE_BY_SCORES = 1e4
"""Variance of what is read, in parts of that of its reading, above which smoothing by scores loses
half of its digits."""
_LOST = 1e11
"""The same, above which a covariance that is not kept by a root has lost its digits."""


class Read(NamedTuple):
    """Holds the readings of an epoch as they were linearised."""

    H: Array
    """(trials, m, n); 0 of missing readings and of particles."""
    L: Array
    """(trials, m, m) with L L' = S of their innovations."""
    noise: Array
    """Their covariance (trials, m, m) for given states; 1 of missing ones."""


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
    reads: list[Read] = field(default_factory=list)
    """The readings of each epoch as they were linearised."""
    chain: Chain | None = None
    """The affine models of the trials, if their covariances were kept by roots."""
    smooth: Smooth | None = None
    """What a smoother finds of those trials whose covariances had to be kept by roots."""
    precise: Mask | None = None
    """The trials (trials,) in which a covariance that no root keeps has lost its digits."""
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
    by_epoch: Mask | None = None
    """Trials (trials,) that were tracked again by the model's own functions, from which recorded
    ones differ there."""

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

    def note(self, k: int, found: Update) -> Normal | Rooted:
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
        for k, (_, L, _) in enumerate(self.reads):
            # z - h = L e for normalised innovations e, and diag(S) = diag(L L').
            y = multiply(L, np.nan_to_num(self.innovations[:, k]))
            mean[:, k] = z[:, k] - y
            deviation[:, k] = np.linalg.norm(L, axis=-1)
        there = np.isfinite(self.innovations)
        return np.where(there, mean, np.nan), np.where(there, deviation, np.nan)

    def about(self, rows: NDArray[np.intp]) -> Tracks:
        """Returns the states of the trials `rows` alone."""
        start = Normal(*(part[rows] for part in self.start))
        part = replace(self, mean=self.mean[rows], covariance=self.covariance[rows])
        part.start = start
        return part

    def keep(self, rows: NDArray[np.intp], other: Tracks, found: Mask) -> None:
        """Takes what another filter of the trials `rows` found, where it did."""
        kept = rows[found]
        if not kept.size:
            return
        names = ("mean", "covariance", "nis", "innovations", "degrees", "log_likelihood")
        for name in names:
            getattr(self, name)[kept] = getattr(other, name)[found]
        for name in ("moves", "predicted", "reads"):
            for mine, its in zip(getattr(self, name), getattr(other, name), strict=True):
                for part, new in zip(mine, its, strict=True):
                    part[kept] = new[found]

    def lose(self, lost: Mask) -> None:
        """Makes NaN what is said of the states of those trials (trials,) that have no digits."""
        for said in (self.mean, self.covariance, self.nis, self.log_likelihood):
            said[lost] = np.nan
        if self.smooth is not None:
            rows, states = self.smooth
            for said in states:
                said[lost[rows]] = np.nan

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
        alone = [
            replace(part, moves=[], predicted=[], reads=[], chain=None, smooth=None, precise=None)
            for part in parts
        ]
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

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "track" in vars(cls):
            cls.track = believed(cls.track)

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


def _linearised(rule: Rule, g: Function, x: Normal | Rooted, nearest: Nearest | None) -> Affine:
    if isinstance(x, Rooted):
        return rule.linearise_by_root(g, x.mean, x.root, nearest)
    return rule.linearise(g, *x, nearest)


def linearised_move(
    model: StateModel, rule: Rule, k: int, x: Normal | Rooted, to: Array | None = None
) -> Affine:
    """Linearises f about the states x; periodic states next to those of `to` (trials, n), if these
    are given."""
    periodic = bool(model.state_periods)
    nearest = model.nearest_state if periodic else None
    move = _linearised(rule, model.transition_into(k), x, nearest)
    if to is None or not periodic:
        return move
    # b takes the whole periods between f(x) and the path.
    value = multiply(move.A, x.mean) + move.b
    return move._replace(b=move.b + model.nearest_state(value, to) - value)


def linearised_reading(
    model: StateModel, rule: Rule, k: int, z: Array, x: Normal | Rooted
) -> Affine:
    """Linearises h about the states x, periodic readings next to the readings z (trials, m)."""
    nearest = model.nearest if model.periods else None
    read = _linearised(rule, model.observation_at(k), x, nearest)
    # b takes the whole periods between h(x) and the readings that are there.
    value = multiply(read.A, x.mean) + read.b
    to = np.where(np.isfinite(z), z, value)
    return read._replace(b=read.b + model.nearest(value, to) - value)


class Update(NamedTuple):
    """Holds the states after a reading, and what the innovation says of the filter."""

    x: Normal | Rooted
    innovation: Array
    nis: Array
    degrees: Array
    log_likelihood: Array
    read: Read | None = None

    @classmethod
    def of(
        cls, x: Normal | Rooted, y: Array, L: Array, seen: Mask, read: Read | None = None
    ) -> Update:
        """Holds the states x after an innovation y (trials, m) of covariance L L', by a reading as
        it was linearised; only readings that are `seen` count."""
        # The normalised innovation e = L^-1 y has the NIS y' S^-1 y = e' e.
        e = lower_solve(L, y[..., None])[..., 0]
        nis = np.sum(e**2, axis=-1)
        degrees = seen.sum(axis=-1)
        # log N(y; 0, S), S = L L', of which a missing reading has no part.
        log_determinant = 2 * np.log(np.diagonal(L, axis1=-2, axis2=-1)).sum(axis=-1)
        log_likelihood = -0.5 * (nis + log_determinant + degrees * np.log(2 * np.pi))
        return cls(x, np.where(seen, e, np.nan), nis, degrees, log_likelihood, read)


def update(x: Normal | Rooted, read: Affine, R: Array, z: Array) -> Update:
    """Takes in the readings z = H x + b + e + v (trials, m), e ~ N(0, W) of the rule and v ~ N(0, R
    (m, m)):

        y = z - H m - b,   S = H P H' + W + R,   K = P H' S^-1
        m <- m + K y
        P <- (I - K H) P (I - K H)' + K (W + R) K'

    This form of P, Joseph's, stays positive definite; where the prior is so much wider than R that
    it loses digits, x is given by a root of P. A missing reading has no slope and unit variance.
    """
    m = x.mean
    P = x.covariance
    seen = np.isfinite(z)
    both = seen[..., :, None] & seen[..., None, :]
    H = np.where(seen[..., None], read.A, 0.0)
    y = np.where(seen, z - multiply(read.A, m) - read.b, 0.0)
    noise = np.where(both, read.W + R, np.eye(R.shape[-1]))
    if isinstance(x, Rooted):
        after, L = x.told(H, y, half(noise).G)
        return Update.of(after, y, L, seen, Read(H, L, noise))
    # S = L L'
    PH = np.matmul(P, transposed(H))
    L = factor(np.matmul(H, PH) + noise)
    # K' = S^-1 H P = L^-T L^-1 (P H')'
    K = transposed(upper_solve(L, lower_solve(L, transposed(PH))))
    rest = np.eye(m.shape[-1]) - np.matmul(K, H)
    unread = np.matmul(np.matmul(rest, P), transposed(rest))
    added = np.matmul(np.matmul(K, noise), transposed(K))
    after = Normal(m + multiply(K, y), symmetric(unread + added))
    return Update.of(after, y, L, seen, Read(H, L, noise))


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
    smooths: bool = False,
) -> Tracks:
    """Runs the filter of the model that a rule linearises about the filter's own states, or about
    those of a path; `start` replaces the prior, and `smooths` tells whether a smoother follows."""
    start = start or spread_prior(model, len(z))
    tracks = _filtered(model, z, rule, iterations, path, start)
    before = _Before.of(tracks)
    losing = before.loses_digits(smooths)
    lost = precise(before.H, before.variances, before.R, _LOST)
    tracks.precise = lost.copy()
    if iterations > 1 or path is not None:
        # About states whose covariance has lost its digits nothing is found at all.
        losing |= ~finite(tracks.mean)
    rows = np.flatnonzero(losing)
    if rows.size:
        about = None if path is None else path.about(rows)
        begun = Rooted.of_normal(Normal(start.mean[rows], start.covariance[rows]))
        other = _filtered(model, z[rows], rule, iterations, about, begun, smooths)
        tracks.calls[rows] += other.calls
        found = finite(other.mean) & finite(other.covariance)
        smooth = other.chain.smoothed() if smooths and other.chain else None
        if smooth is not None:
            found &= finite(smooth.mean) & finite(smooth.covariance)
        if path is not None:
            # About a path that is nearly known, slopes by points may be round-off.
            for move in other.moves:
                found &= (np.abs(move.A) < _STEEPEST).all(axis=(1, 2))
        tracks.keep(rows, other, found)
        lost[rows[found]] = False
        if smooth is not None:
            states = Normal(smooth.mean[found], smooth.covariance[found])
            tracks.smooth = Smooth(rows[found], states)
        before = _Before.of(tracks)
    # Slopes by points about a path that is nearly known may be round-off themselves, and tell
    # nothing of digits; the filter whose path it is has told.
    if path is None or isinstance(rule, Taylor):
        tracks.lose(lost | beyond_digits(before.H, before.mean, before.variances, before.R))
    return tracks


class _Before(NamedTuple):
    """Holds what a filter knew before the readings of each epoch."""

    mean: Array
    """(trials, K, n)"""
    covariance: Array
    """(trials, K, n, n)"""
    H: Array
    """Slopes (trials, K, m, n) of the readings."""
    R: Array
    """Their variances (trials, K, m)."""

    @classmethod
    def of(cls, tracks: Tracks) -> _Before:
        each = list(tracks.predicted)
        if len(each) < len(tracks.reads):
            each.insert(0, tracks.start)
        mean = np.stack([x.mean for x in each], axis=1)
        covariance = np.stack([x.covariance for x in each], axis=1)
        H = np.stack([read.H for read in tracks.reads], axis=1)
        R = np.stack([_variances(read.noise) for read in tracks.reads], axis=1)
        return cls(mean, covariance, H, R)

    @property
    def variances(self) -> Array:
        """(trials, K, n)"""
        return _variances(self.covariance)

    def loses_digits(self, smooths: bool) -> Mask:
        """Tells in which trials readings leave less of a covariance than its digits (trials,)."""
        P = self.variances
        losing = precise(self.H, P, self.R)
        if not smooths:
            return losing
        # Smoothers of singular covariances go by scores, which lose digits twice as fast.
        rows = np.flatnonzero(precise(self.H, P, self.R, _PRECISE_BY_SCORES) & ~losing)
        if rows.size:
            losing[rows] = half(self.covariance[rows]).singular.any(axis=1)
        return losing


def _variances(P: Array) -> Array:
    return np.diagonal(P, axis1=-2, axis2=-1)


def _alike(at: Normal, x: Normal | Rooted) -> Normal | Rooted:
    """Returns the states `at` in the form of the states x."""
    return Rooted.of_normal(at) if isinstance(x, Rooted) else at


def _noise_root(G: Array, move: Affine) -> Array:
    """Returns a root (trials, n, q) of the covariance of a transition's noise."""
    each = np.broadcast_to(G, (len(move.W), *G.shape[-2:]))
    own = half(move.W).G if move.W.any() else np.zeros(move.W.shape)
    return np.concatenate([each, own], axis=2)


def _step(x: Rooted, move: Affine | None, G: Array | None, found: Update) -> Step:
    """Returns the affine model of an epoch, of states x after the transition."""
    read = found.read
    assert read is not None
    y = multiply(read.L, np.nan_to_num(found.innovation))
    N = half(read.noise)
    B = transposed(N.whitened(transposed(read.H)))
    v = N.whitened((y + multiply(read.H, x.mean))[:, None])[:, 0]
    if move is None or G is None:
        still = np.broadcast_to(np.eye(x.mean.shape[1]), x.root.shape)
        return Step(still, np.zeros_like(x.mean), still[:, :, :0], B, v)
    return Step(move.A, move.b, G, B, v)


def _filtered(
    model: StateModel,
    z: Array,
    rule: Rule,
    iterations: int,
    path: Tracks | None,
    start: Normal | Rooted,
    smooths: bool = False,
) -> Tracks:
    out = Tracks.empty(model, len(z))
    out.start = Normal(start.mean, start.covariance)
    x = start
    steps: list[Step] = []
    for k in range(model.epochs):
        move = G = None
        if model.moves(k):
            # f is linearised about the filter's states, or about those of the path.
            at = x if path is None else _alike(path.at(k - 1), x)
            to = None if path is None else path.mean[:, k]
            move = linearised_move(model, rule, k, at, to)
            Q = None
            if model.gain_by_state:
                Q = rule.mean(partial(model.Q_at, k=k), at.mean, at.covariance)
            if isinstance(x, Rooted):
                G = _noise_root(model.gain(k) if Q is None else half(Q).G, move)
                x = x.moved(move, G)
            else:
                x = predict(x, move, model.Q(k) if Q is None else Q)
            out.moves.append(move)
            out.predicted.append(Normal(x.mean, x.covariance))
        at = x if path is None else _alike(path.at(k), x)
        found = None
        for _ in range(iterations):
            # Each iteration takes the readings into the prediction x, h linearised about the
            # states that the last one found.
            if model.R_by_state:
                R = rule.mean(partial(model.R_at, k=k), at.mean, at.covariance)
            else:
                R = model.R(k)
            read = linearised_reading(model, rule, k, z[:, k], at)
            found = update(x, read, R, z[:, k])
            at = found.x
        assert found is not None
        if isinstance(x, Rooted) and smooths:
            steps.append(_step(x, move, G, found))
        x = out.note(k, found)
    if isinstance(start, Rooted) and smooths:
        out.chain = Chain(start, steps)
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
