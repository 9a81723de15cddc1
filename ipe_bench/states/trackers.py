"""Filters and smoothers of state models: readings (trials, K, m) in, means and covariances of the states out.

All trials advance together. A reading that is NaN is missing; a trial whose covariance is no longer positive definite
is NaN from then on and disturbs no other.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array, Mask, multiply
from ipe_bench.basics.options import Component, Count, NonNegative
from ipe_bench.basics.streams import own_generators
from ipe_bench.states.algebra import divide, factor, lower_solve, mahalanobis, root, symmetric, transposed, upper_solve
from ipe_bench.states.base import Normal, StateModel
from ipe_bench.states.linearisation import Affine, Cubature, Rule, Taylor, Unscented, slope

_HALVINGS = 12
"""Halvings of a damped step."""


@dataclass
class Tracks:
    """What a tracker says of the states at K epochs, and what its smoother needs."""

    mean: Array
    """(trials, K, n)"""
    covariance: Array
    """(trials, K, n, n)"""
    nis: Array
    """Squared normalised innovations (trials, K), chi-square with `degrees` if the model holds; 0 in smoothers,
    NaN where there are none."""
    innovations: Array
    """Normalised innovations (trials, K, m), independent and N(0, 1) if the model holds; NaN of missing readings and
    in trackers that have none."""
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

    @classmethod
    def empty(cls, model: StateModel, trials: int) -> Tracks:
        K, n = model.epochs, model.n
        nis, degrees = np.zeros((trials, K)), np.zeros((trials, K))
        innovations = np.full((trials, K, len(model.R(0))), np.nan)
        means, covariances = np.empty((trials, K, n)), np.empty((trials, K, n, n))
        likelihood, calls = np.zeros((2, trials))
        start = spread_prior(model, trials)
        return cls(means, covariances, nis, innovations, degrees, likelihood, calls, start)

    def at(self, k: int) -> Normal:
        """The states at epoch k; before the first transition if that is -1."""
        return self.start if k < 0 else Normal(self.mean[:, k], self.covariance[:, k])

    def note(self, k: int, found: Update) -> Normal:
        """The states after the readings of epoch k, which the tracks keep with what the innovation says."""
        self.mean[:, k], self.covariance[:, k] = found.x
        self.nis[:, k], self.innovations[:, k], self.degrees[:, k] = found.nis, found.innovation, found.degrees
        self.log_likelihood += found.log_likelihood
        return found.x

    @classmethod
    def lost(cls, model: StateModel, trials: int) -> Tracks:
        """Tracks of which nothing is known."""
        tracks = cls.empty(model, trials)
        tracks.mean[:], tracks.covariance[:] = np.nan, np.nan
        return tracks

    @classmethod
    def join(cls, parts: Sequence[Tracks]) -> Tracks:
        """The trials of several batches one after another, without what smoothers need."""
        names = ("mean", "covariance", "nis", "innovations", "degrees", "log_likelihood", "calls")
        arrays: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
        start = Normal(*[np.concatenate(several) for several in zip(*(part.start for part in parts), strict=True)])
        return cls(**arrays, start=start)


class Tracker(Component, ABC):
    """Estimates the states of every trial from its readings."""

    needs: ClassVar[frozenset[str]] = frozenset({"epochs", "prior"})
    equation: ClassVar[None] = None
    family: ClassVar[str] = "filters"

    def hindrance(self, model: StateModel) -> str:
        """Why the tracker does not suit the model; empty if it does."""
        return ""

    @abstractmethod
    def track(self, model: StateModel, z: Array) -> Tracks:
        """The states that readings z (trials, K, m) tell of."""


def spread_prior(model: StateModel, trials: int) -> Normal:
    m, P = model.prior
    return Normal(np.repeat(m[None], trials, 0), np.repeat(P[None], trials, 0))


def predict(x: Normal, move: Affine, Q: Array) -> Normal:
    """The states after a linearised transition with process noise of covariance Q (n, n)."""
    P = np.matmul(np.matmul(move.A, x.covariance), transposed(move.A)) + move.W + Q
    return Normal(multiply(move.A, x.mean) + move.b, symmetric(P))


def linearised_reading(model: StateModel, rule: Rule, k: int, z: Array, x: Normal) -> Affine:
    """h linearised about the states x, periodic readings next to the readings z (trials, m)."""
    A, b, W = rule.linearise(lambda at: model.observe(at, k), *x, model.nearest if model.periods else None)
    value = multiply(A, x.mean) + b
    return Affine(A, b + model.nearest(value, np.where(np.isfinite(z), z, value)) - value, W)


class Update(NamedTuple):
    """The states after a reading, and what the innovation says of the filter."""

    x: Normal
    innovation: Array
    nis: Array
    degrees: Array
    log_likelihood: Array

    @classmethod
    def of(cls, x: Normal, y: Array, L: Array, seen: Mask) -> Update:
        """The states x after an innovation y (trials, m) of covariance L L'; only readings that are `seen` count."""
        e = lower_solve(L, y[..., None])[..., 0]
        nis, degrees = np.sum(e**2, axis=-1), seen.sum(axis=-1)
        log_determinant = 2 * np.log(np.diagonal(L, axis1=-2, axis2=-1)).sum(axis=-1)
        log_likelihood = -0.5 * (nis + log_determinant + degrees * np.log(2 * np.pi))
        return cls(x, np.where(seen, e, np.nan), nis, degrees, log_likelihood)


def update(x: Normal, read: Affine, R: Array, z: Array) -> Update:
    """Takes in the readings z (trials, m) of covariance R (m, m). A missing reading has no slope and unit variance.

    P is updated in Joseph's form, (I - K H) P (I - K H)' + K R K', which stays positive definite where the prior is
    much wider than R.
    """
    m, P = x
    seen = np.isfinite(z)
    both = seen[..., :, None] & seen[..., None, :]
    H = np.where(seen[..., None], read.A, 0.0)
    y = np.where(seen, z - multiply(read.A, m) - read.b, 0.0)
    PH = np.matmul(P, transposed(H))
    noise = np.where(both, read.W + R, np.eye(R.shape[-1]))
    L = factor(np.matmul(H, PH) + noise)
    K = transposed(upper_solve(L, lower_solve(L, transposed(PH))))
    rest = np.eye(m.shape[-1]) - np.matmul(K, H)
    covariance = np.matmul(np.matmul(rest, P), transposed(rest)) + np.matmul(np.matmul(K, noise), transposed(K))
    return Update.of(Normal(m + multiply(K, y), symmetric(covariance)), y, L, seen)


@dataclass(frozen=True)
class Filter(Tracker):
    """A Gaussian filter: predict by the linearised transition, update by the linearised reading.

    With `iterations` above 1 the reading is linearised again about its posterior: by Taylor's rule the iterated
    extended Kalman filter (Bell and Cathey, IEEE TAC 38, 1993), by sigma points the iterated posterior linearisation
    filter (García-Fernández, Svensson, Morelande, Särkkä, IEEE TSP 63, 2015).
    """

    rule: Rule = field(default_factory=Taylor)
    """How transition and reading are linearised."""
    iterations: Count = 1
    """Linearisations of each reading."""
    engine: Literal["filterpy", "batched"] = "batched"
    """Who computes the filter's equations: filterpy, trial by trial, in some 100 times the time, or this package, for
    all trials at once."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.engine == "filterpy" and (self.iterations > 1 or type(self.rule) not in (Taylor, Unscented)):
            raise UserError("engine=filterpy: is for ekf and ukf, with one iteration; choose engine=batched")

    def track(self, model: StateModel, z: Array) -> Tracks:
        if self.engine == "filterpy":
            return _stepped(model, z, self.rule)
        return filtered(model, z, self.rule, self.iterations)


def filtered(model: StateModel, z: Array, rule: Rule, iterations: int = 1, path: Tracks | None = None) -> Tracks:
    """The filter of the model that a rule linearises about the filter's own states, or about those of a path."""
    out = Tracks.empty(model, len(z))
    x, found = out.start, None
    for k in range(model.epochs):
        if model.moves(k):
            move = rule.linearise(lambda at, k=k: model.transition(at, k), *(x if path is None else path.at(k - 1)))
            x = predict(x, move, model.Q(k))
            out.moves.append(move)
            out.predicted.append(x)
        at, R = x if path is None else path.at(k), model.R(k)
        for _ in range(iterations):
            found = update(x, linearised_reading(model, rule, k, z[:, k], at), R, z[:, k])
            at = found.x
        assert found is not None
        x = out.note(k, found)
    read = rule.calls(model.n, bool(model.periods))
    out.calls += rule.calls(model.n) * len(out.moves) + read * iterations * model.epochs
    return out


def _stepped(model: StateModel, z: Array, rule: Rule) -> Tracks:
    """The tracks by filterpy's filter of Taylor's rule or of the unscented one, a filter for each trial."""
    out = Tracks.empty(model, len(z))
    x, filters = out.start, [_of_filterpy(rule, model.n, z.shape[2]) for _ in z]
    for f, mean, covariance in zip(filters, *x, strict=True):
        f.x, f.P = mean, covariance
    for k in range(model.epochs):
        if model.moves(k):
            move, Q = rule.linearise(lambda at, k=k: model.transition(at, k), *x), model.Q(k)
            if isinstance(rule, Taylor):
                for f, F, moved in zip(filters, move.A, model.transition(x.mean, k), strict=True):
                    f.Q, f.F = Q, F
                    f.predict()
                    f.x = moved
            else:
                for f in filters:
                    f.Q = Q
                    f.predict(fx=lambda at, _, k=k: model.transition(at, k))
            x = Normal(np.array([f.x for f in filters]), np.array([f.P for f in filters]))
            out.moves.append(move)
            out.predicted.append(x)
        (h, H), R = slope(lambda at, k=k: model.observe(at, k), x.mean), model.R(k)
        for f, *read in zip(filters, z[:, k], h, H, strict=True):
            _take_in(f, model, k, R, *read)
        mean, P, y, S = (np.array([getattr(f, name) for f in filters]) for name in ("x", "P", "y", "S"))
        x = out.note(k, Update.of(Normal(mean, P), y, factor(S), np.isfinite(z[:, k])))
    # What the smoother needs, and filterpy's own; unscented readings besides the slope, by which they are told apart.
    points = rule.calls(model.n)
    moved, read = (1, 0) if isinstance(rule, Taylor) else (points, points)
    out.calls += (points + moved) * len(out.moves) + (1 + model.n + read) * model.epochs
    return out


def _of_filterpy(rule: Rule, n: int, m: int) -> Any:
    from filterpy.kalman import ExtendedKalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter

    if not isinstance(rule, Unscented):
        return ExtendedKalmanFilter(n, m)
    points = MerweScaledSigmaPoints(n, rule.alpha, rule.beta, rule.kappa_of(n))
    return UnscentedKalmanFilter(n, m, dt=1.0, hx=None, fx=None, points=points)


def _take_in(f: Any, model: StateModel, k: int, R: Array, z: Array, h: Array, H: Array) -> None:
    """Updates a filter of filterpy by readings z (m,) near h (m,); a missing one reads 0, with no slope and unit
    variance."""
    seen = np.isfinite(z)
    z, R = np.where(seen, model.nearest(z, h), 0.0), np.where(seen[:, None] & seen, R, np.eye(len(z)))
    if hasattr(f, "points_fn"):
        f.sigmas_f = f.points_fn.sigma_points(f.x, f.P)
        f.update(z, R, hx=lambda x: np.where(seen, model.nearest(model.observe(x, k), h), 0.0))
    else:
        f.update(z, lambda _: np.where(seen[:, None], H, 0.0), lambda _: np.where(seen, h, 0.0), R)


@dataclass(frozen=True)
class Smoother(Tracker):
    """The smoother of Rauch, Tung and Striebel (AIAA J. 3, 1965) behind a filter."""

    filter: Filter = field(default_factory=Filter)
    """The filter whose tracks are smoothed."""

    def track(self, model: StateModel, z: Array) -> Tracks:
        return smoothed(model, self.filter.track(model, z))


@dataclass(frozen=True)
class IteratedSmoother(Tracker):
    """Linearises everything about the last smoothed path and solves that affine problem exactly, again and again.

    By Taylor's rule these are Gauss-Newton steps to the path of largest posterior density (Bell, SIAM J. Optim. 4,
    1994), with `damped` halved while they raise its cost; by sigma points it is the iterated posterior linearisation
    smoother (García-Fernández, Svensson, Särkkä, IEEE TSP 65, 2017). The first path is that of `first`, smoothed.
    """

    first: Filter = field(default_factory=Filter)
    """The filter whose smoothed tracks are the first path."""
    rule: Rule = field(default_factory=Taylor)
    """How transition and reading are linearised about a path."""
    iterations: Count = 10
    """Paths at most, after the first."""
    damped: bool = False
    """Whether steps that raise the cost of the path are halved; for Taylor's rule."""
    tolerance: NonNegative = 0.0
    """Ends where no trial's path moves by more than so many of its own standard deviations."""

    def track(self, model: StateModel, z: Array) -> Tracks:
        path = self.first.track(model, z)
        calls, going = path.calls, np.ones(len(z), dtype=bool)
        for _ in range(self.iterations):
            new = smoothed(model, filtered(model, z, self.rule, path=path))
            if self.damped:
                new = _shortened(model, z, path, new)
            calls = calls + np.where(going, new.calls, 0.0)
            moved = np.abs(new.mean - path.mean) / np.sqrt(np.diagonal(new.covariance, axis1=-2, axis2=-1))
            path, on = new, (moved > self.tolerance).any(axis=(1, 2))
            going &= on
            if not on.any():
                break
        path.calls = calls
        return path


def smoothed(model: StateModel, tracks: Tracks) -> Tracks:
    """The backward pass of Rauch, Tung and Striebel through a filter's tracks, to before the first transition."""
    out = Tracks.empty(model, len(tracks.mean))
    out.mean[:, -1], out.covariance[:, -1] = x = tracks.at(model.epochs - 1)
    first = 0 if model.moved_first else 1
    for k in range(model.epochs - 1, first - 1, -1):
        before = tracks.at(k - 1)
        move, predicted = tracks.moves[k - first], tracks.predicted[k - first]
        G = divide(np.matmul(before.covariance, transposed(move.A)), predicted.covariance)
        P = np.matmul(np.matmul(G, x.covariance - predicted.covariance), transposed(G))
        x = Normal(before.mean + multiply(G, x.mean - predicted.mean), symmetric(before.covariance + P))
        if k:
            out.mean[:, k - 1], out.covariance[:, k - 1] = x
    out.start = x
    out.moves, out.predicted, out.calls = tracks.moves, tracks.predicted, tracks.calls
    return out


def path_cost(model: StateModel, z: Array, start: Array, mean: Array) -> Array:
    """-2 log p(path | readings) (trials,) up to a constant; disturbances count by the pseudo-inverse of the gain."""
    total, before = mahalanobis(start - model.prior.mean, model.prior.covariance), start
    for k in range(model.epochs):
        if model.moves(k):
            w = multiply(np.linalg.pinv(model.gain(k)), mean[:, k] - model.transition(before, k))
            total = total + np.sum(w**2, axis=-1)
        total, before = total + misfit(model, z[:, k], mean[:, k, None], k)[0][:, 0], mean[:, k]
    return total


def misfit(model: StateModel, z: Array, x: Array, k: int) -> tuple[Array, Array]:
    """(z - h)' R^-1 (z - h) (trials, N) of states x (trials, N, n) over the readings z (trials, m) of epoch k that are
    there, and log det 2 pi R (trials,) of these."""
    seen = np.isfinite(z)
    r = np.where(seen[:, None], z[:, None] - model.observe_near(x, k, np.where(seen, z, 0.0)), 0.0)
    L = factor(np.where(seen[:, :, None] & seen[:, None, :], model.R(k), np.eye(z.shape[1])))
    size = 2 * np.log(np.diagonal(L, axis1=1, axis2=2)).sum(axis=1) + np.log(2 * np.pi) * seen.sum(axis=1)
    return np.sum(lower_solve(L, transposed(r)) ** 2, axis=1), size


def _halved(old: Array, new: Array, cost: Callable[[Array], Array]) -> tuple[Array, Array]:
    """The step from `old` to `new` (trials, ...), halved in each trial until the cost (trials,) is not above that of
    `old`; and how many costs (trials,) that took."""
    best, share = cost(old), np.ones((len(old),) + (1,) * (old.ndim - 1))
    worse, taken = np.ones(len(old), dtype=bool), np.ones(len(old))
    for _ in range(_HALVINGS):
        taken += worse
        worse = ~(cost(old + share * (new - old)) <= best * (1 + 1e-12))
        if not worse.any():
            break
        share[worse] /= 2
    return old + share * (new - old), taken


def _shortened(model: StateModel, z: Array, old: Tracks, new: Tracks) -> Tracks:
    """The step from one path to the next, halved where it raises the path's cost."""
    first, last = (np.concatenate([path.start.mean[:, None], path.mean], axis=1) for path in (old, new))
    path, costs = _halved(first, last, lambda x: path_cost(model, z, x[:, 0], x[:, 1:]))
    new.calls = new.calls + costs * model.evaluations
    new.mean, new.start = path[:, 1:], Normal(path[:, 0], new.start.covariance)
    return new


@dataclass(frozen=True)
class Bootstrap(Tracker):
    """The bootstrap particle filter (Gordon, Salmond, Smith, IEE Proc. F 140, 1993), with systematic resampling at
    every epoch. Each trial's random numbers are those of its readings, in whatever batch."""

    particles: Count = 1000
    """States that stand for the density of a trial."""
    seed: int = 0
    """A trial's random numbers depend on this and on its readings: on nothing else in the batch."""

    def track(self, model: StateModel, z: Array) -> Tracks:
        trials, N = len(z), self.particles
        generators = own_generators(self.seed, z.reshape(trials, -1))

        def normals(columns: int) -> Array:
            return np.stack([g.standard_normal((N, columns)) for g in generators])

        out = Tracks.empty(model, trials)
        out.nis[:] = np.nan  # a weighted sample has no innovation
        spread = root(model.prior.covariance)
        x = model.prior.mean + np.matmul(normals(spread.shape[1]), spread.T)
        for k in range(model.epochs):
            if model.moves(k):
                G = model.gain(k)
                x = model.transition(x, k) + np.matmul(normals(G.shape[1]), G.T)
            w = weighed(model, x, k, z[:, k], 1.0, out)
            mean = np.sum(w[..., None] * x, axis=1)
            d = x - mean[:, None]
            out.mean[:, k], out.covariance[:, k] = mean, np.matmul(transposed(d * w[..., None]), d)
            x = _resampled(x, w, np.array([g.random() for g in generators]))
        out.log_likelihood -= model.epochs * np.log(N)
        out.calls += N * model.evaluations
        return out


def weighed(model: StateModel, x: Array, k: int, z: Array, before: Array | float, out: Tracks) -> Array:
    """The weights `before` (trials, N) of states x (trials, N, n) times the likelihood of readings z (trials, m), with
    sum 1; the logarithm of their sum is added to the log likelihood of the track."""
    square, size = misfit(model, z, x, k)
    least = square.min(axis=1, keepdims=True)
    w = before * np.exp(-0.5 * (square - least))
    total = w.sum(axis=1, keepdims=True)
    out.log_likelihood += np.log(total[:, 0]) - 0.5 * (least[:, 0] + size)
    out.degrees[:, k] = np.isfinite(z).sum(axis=1)
    return w / total


def _resampled(x: Array, w: Array, offset: Array) -> Array:
    """Particles x (trials, N, n) copied in proportion to their weights w (trials, N), systematically from an offset
    (trials,) in [0, 1)."""
    trials, N, n = x.shape
    upto = np.ceil(N * np.cumsum(w, axis=1) - offset[:, None]).clip(0, N)
    upto[:, -1] = N
    counts = np.diff(upto, axis=1, prepend=0.0).astype(int)
    return x.reshape(trials * N, n)[np.repeat(np.arange(trials * N), counts.ravel())].reshape(trials, N, n)


def ekf(iterations: int = 1) -> Filter:
    """The extended Kalman filter; iterated (IEKF) with more than one iteration."""
    return Filter(Taylor(), iterations)


def ukf(kappa: float | None = None) -> Filter:
    """The unscented Kalman filter."""
    return Filter(Unscented(kappa))


def ckf() -> Filter:
    """The cubature Kalman filter, which draws its points again after the prediction."""
    return Filter(Cubature())
