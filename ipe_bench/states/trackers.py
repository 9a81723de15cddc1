"""Trackers of state models, readings (trials, K, m) in, means and covariances of the states out:
Gaussian filters.

All trials advance together. A reading that is NaN is missing; a trial whose covariance is no longer
positive definite is NaN from then on and disturbs no other.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from ipe_bench.basics.batches import join
from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array, Mask
from ipe_bench.basics.options import Component, Count, Quantile
from ipe_bench.states.algebra import factor, lower_solve, transposed
from ipe_bench.states.base import Normal, StateModel
from ipe_bench.states.layouts import Layout
from ipe_bench.states.linearisation import Cubature, Rule, Taylor, Unscented
from ipe_bench.states.passes import Kind, Passed, Passes, Route, passes_of
from ipe_bench.states.redone import believed
from ipe_bench.states.steps import BEYOND
from ipe_bench.states.student import Mixture, evidence, mixture, scores


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
    predicted: Array | None = None
    """What a filter predicted of the readings (trials, K, m)."""
    predicted_deviation: Array | None = None
    """The standard deviations (trials, K, m) of readings about it."""
    root: Array | None = None
    """Triangular roots (trials, 1 + K, n (n + 1) / 2) of the covariances, from before the first
    transition."""
    effective: Array | None = None
    """Effective sample sizes 1 / sum w^2 (trials, K) of weighted samples."""
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
    gated: Mask | None = None
    """Readings (trials, K, m) that lie beyond the gate, and count as missing."""
    weights: Array | None = None
    """By how much readings (trials, K, m) with tails count, in parts of those that lie where they
    are expected; NaN of missing ones."""
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

    def note_innovation(self, k: int, y: Array, L: Array, z: Array) -> None:
        """Keeps what an innovation y (trials, m) of covariance L L' says of the filter, by those
        readings z (trials, m) of epoch k that are there."""
        if self.predicted is None or self.predicted_deviation is None:
            self.predicted = np.full(self.innovations.shape, np.nan)
            self.predicted_deviation = self.predicted.copy()
        seen = np.isfinite(z)
        e = lower_solve(L, y[..., None])[..., 0]
        self.nis[:, k] = np.sum(e**2, axis=-1)
        self.innovations[:, k] = np.where(seen, e, np.nan)
        self.degrees[:, k] = seen.sum(axis=-1)
        self.predicted[:, k] = z - y
        self.predicted_deviation[:, k] = np.linalg.norm(L, axis=-1)

    def predicted_readings(self, z: Array) -> tuple[Array, Array]:
        """Returns the readings (trials, K, m) that a filter predicted of those of z (trials, K, m)
        that were there, and their standard deviations; NaN in trackers that have no innovations."""
        nothing = np.full(z.shape, np.nan)
        if self.predicted is None or self.predicted_deviation is None:
            return nothing, nothing
        there = np.isfinite(self.innovations)
        return (
            np.where(there, self.predicted, np.nan),
            np.where(there, self.predicted_deviation, np.nan),
        )

    def lose(self, lost: Mask) -> None:
        """Makes NaN what is said of the states of those trials (trials,) that have no digits."""
        for said in (self.mean, self.covariance, self.nis, self.log_likelihood):
            said[lost] = np.nan

    @classmethod
    def lost(cls, model: StateModel, trials: int) -> Tracks:
        """Returns tracks of which nothing is known."""
        tracks = cls.empty(model, trials)
        tracks.mean[:] = np.nan
        tracks.covariance[:] = np.nan
        return tracks

    @classmethod
    def join(cls, parts: Sequence[Tracks]) -> Tracks:
        """Joins the trials of several batches one after another; what trials lack that others have
        is NaN, or the status and the iterations of none."""
        joined = join(parts)
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
    gate: float | None = None
    """The quantile beyond which a reading counts as missing."""

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

    def gated(self, gate: float) -> Tracker:
        """Returns the tracker to which readings beyond a quantile are missing.

        Raises:
            UserError: it takes no gate, with words that follow its label.
        """
        if "gate" not in {one.name for one in fields(self)}:  # type: ignore[arg-type]
            raise UserError("takes no gate; choose a filter or a smoother")
        return replace(self, gate=gate)  # type: ignore[type-var]

    @abstractmethod
    def track(self, model: StateModel, z: Array) -> Tracks:
        """Estimates the states from readings z (trials, K, m)."""


def spread_prior(model: StateModel, trials: int) -> Normal:
    """Returns the prior of each trial."""
    m, P = model.prior
    return Normal(np.repeat(m[None], trials, axis=0), np.repeat(P[None], trials, axis=0))


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
    >>> trackers = {"iterated_ekf": ib.states.Filter(rule=ib.states.Taylor(), iterations=5)}
    >>> table = ib.run(model, trackers, trials=20)
    >>> float(table.iloc[-1]["success"])
    1.0
    """

    rule: Rule = field(default_factory=Taylor)
    """How transition and reading are linearised."""
    iterations: Count = 1
    """Linearisations of each reading."""
    gate: Quantile | None = None
    """A reading counts as missing if its squared innovation, divided by its variance, lies beyond
    this quantile of the chi-square with one degree, such as 0.999."""

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
        return filtered(model, z, self.rule, self.iterations, gate=self.gate)


def filtered(
    model: StateModel,
    z: Array,
    rule: Rule,
    iterations: int = 1,
    path: Tracks | None = None,
    start: Normal | None = None,
    gate: float | None = None,
) -> Tracks:
    """Runs the filter of the model that a rule linearises about the filter's own states, or about
    those of a path; `start` replaces the prior, and readings beyond the quantile `gate` are
    missing."""
    return _passed(model, z, _kind(model, rule, iterations, path, gate), path, start)[0]


def smoothed(
    model: StateModel,
    z: Array,
    rule: Rule,
    iterations: int = 1,
    path: Tracks | None = None,
    start: Normal | None = None,
    gate: float | None = None,
) -> tuple[Tracks, Tracks]:
    """Runs the same filter and its smoother (Rauch, Tung and Striebel, AIAA J. 3, 1965), and
    returns what each of them finds, that of the smoother in front."""
    smooth, tracks = passed(model, z, rule, iterations, path, start, gate)
    lost = np.isnan(tracks.log_likelihood)
    smooth.lose(lost)
    for said in smooth.start:
        said[lost] = np.nan
    return smooth, tracks


def passed(
    model: StateModel,
    z: Array,
    rule: Rule,
    iterations: int = 1,
    path: Tracks | None = None,
    start: Normal | None = None,
    gate: float | None = None,
) -> tuple[Tracks, Tracks]:
    """Does the same, for paths that are a beginning: those that have no digits are there, too."""
    kind = _kind(model, rule, iterations, path, gate)._replace(smooths=True)
    tracks, smooth = _passed(model, z, kind, path, start)
    return smooth, tracks


def _kind(
    model: StateModel,
    rule: Rule,
    iterations: int,
    path: Tracks | None,
    gate: float | None,
) -> Kind:
    """Says which filter is asked for."""
    tails = tuple(map(mixture, model.degrees_of_freedom))
    most = gate and most_within(gate)
    return Kind(rule, iterations, about_path=path is not None, gate=most, tails=tails)


def most_within(gate: float) -> float:
    """Returns the squared normalised innovation at a quantile."""
    return float(chdtri(1.0, 1.0 - gate))


def _passed(
    model: StateModel, z: Array, kind: Kind, path: Tracks | None, start: Normal | None
) -> tuple[Tracks, Tracks]:
    """Runs passes of as many trials at once as memory allows."""
    passes = passes_of(model, kind)
    begun = start or spread_prior(model, len(z))
    route = None if path is None else _route(path, passes)
    at_once = passes.at_once
    parts = []
    for i in range(0, max(len(z), 1), at_once):
        rows = slice(i, i + at_once)
        about = None if route is None else Route(route.mean[rows], route.root[rows])
        first = Normal(begun.mean[rows], begun.covariance[rows])
        found = passes.run(z[rows], about, None if start is None else first)
        parts.append(_found(passes, found, z[rows], first))
    tracks, smooth = parts[0] if len(parts) == 1 else map(Tracks.join, zip(*parts, strict=True))
    calls = _calls(model, kind)
    tracks.calls = np.full(len(z), calls)
    smooth.calls = np.full(len(z), calls)
    return tracks, smooth


def _calls(model: StateModel, kind: Kind) -> float:
    """Counts the evaluations of f and of h of a trial that is alone."""
    of_f = kind.rule.calls(model.n, bool(model.state_periods))
    of_h = kind.rule.calls(model.n, bool(model.periods))
    moves = model.evaluations - model.epochs
    return float(of_f * moves + of_h * kind.iterations * model.epochs)


def _route(path: Tracks, passes: Passes) -> Route:
    """Returns the states of a path."""
    mean = np.concatenate([path.start.mean[:, None], path.mean], axis=1)
    # Tangents take no covariance.
    n = passes.layouts.n
    size = n * (n + 1) // 2
    root = np.zeros((*mean.shape[:2], size)) if path.root is None else path.root
    return Route(mean, root)


def _found(passes: Passes, found: Passed, z: Array, start: Normal) -> tuple[Tracks, Tracks]:
    """Returns what passes say of some trials: a filter, and the smoother behind it. Where states or
    their covariances are so large that floats hold no digits of the readings, a filter says
    nothing."""
    layout = passes.layouts.filter_output
    n = passes.layouts.n
    after = found.filtered[:, 1:]
    # A reading beyond the gate is missing, and has no innovation.
    gated = passes.layouts.gated(z, after)
    seen = np.isfinite(z) & ~gated
    carry = passes.layouts.filter_carry
    log_likelihood = carry.part(found.carry, "log_likelihood")[:, 0].copy()
    # A doubt that is not a number is of states that are not, either.
    lost = carry.part(found.carry, "doubt")[:, 0] > BEYOND
    tracks = Tracks(
        mean=layout.part(after, "x"),
        covariance=layout.part(after, "covariance", n, n),
        nis=layout.part(after, "nis")[..., 0],
        innovations=np.where(seen, layout.part(after, "e"), np.nan),
        degrees=seen.sum(axis=2).astype(float),
        log_likelihood=log_likelihood,
        calls=np.zeros(len(z)),
        start=start,
        predicted=layout.part(after, "predicted"),
        predicted_deviation=layout.part(after, "deviation"),
        root=layout.part(found.filtered, "F"),
        gated=None if passes.kind.gate is None else gated,
    )
    if passes.kind.tails:
        _judge(tracks, layout, after, passes.kind.tails)
    tracks.lose(lost)
    if found.smoothed is None:
        return tracks, tracks
    of_states = passes.layouts.smoother_output
    mean = of_states.part(found.smoothed, "x")
    covariance = of_states.part(found.smoothed, "covariance", n, n)
    smooth = Tracks.empty(passes.model, len(z))
    smooth.start = Normal(mean[:, 0], covariance[:, 0])
    smooth.mean = mean[:, 1:]
    smooth.covariance = covariance[:, 1:]
    smooth.root = of_states.part(found.smoothed, "F")
    return tracks, smooth


def _judge(tracks: Tracks, layout: Layout, after: Array, tails: Sequence[Mixture]) -> None:
    """Judges innovations by mixtures: notes the normal numbers that are as probable, the likelihood
    of the readings, and their weights."""
    apart, others, own = (layout.part(after, name) for name in ("apart", "others", "own"))
    seen = np.isfinite(tracks.innovations)
    weights = np.full(seen.shape, np.nan)
    likelihood = 0.0 * tracks.log_likelihood
    for j, one in enumerate(tails):
        given = apart[..., j], others[..., j], own[..., j]
        here = seen[..., j]
        found = evidence(*given, one)
        likelihood += np.where(here, found.density, 0.0).sum(axis=1)
        tracks.innovations[..., j] = np.where(here, scores(*given, one), np.nan)
        # The noise of a normal reading that would count as much, and that where it is expected.
        states = others[..., j] - one.least * own[..., j]
        expected = evidence(0.0 * apart[..., j], *given[1:], one)
        share = (1 / expected.gain - states) / (1 / found.gain - states)
        weights[..., j] = np.where(here, share, np.nan)
    squares = np.nansum(tracks.innovations**2, axis=2)
    # A trial that has broken down has no innovations, which are 0 only of missing readings.
    tracks.nis = np.where(np.isnan(tracks.nis), np.nan, squares)
    tracks.log_likelihood = likelihood
    tracks.weights = weights


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
