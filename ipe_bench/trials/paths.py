"""State models on trial: true paths that move with process noise, trackers on their readings, and
the scores of these.

A trial's parameters are its states at the last epoch, so that whatever is said of estimates of
constants is said of these; what is said of the whole path stands in columns of its own.
"""

from __future__ import annotations

import base64
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from ipe_bench.basics.batches import put, take
from ipe_bench.basics.errors import UserError, describe_exception
from ipe_bench.basics.linalg import Array, Mask, deviations, finite, plain_numbers, read_only
from ipe_bench.basics.options import in_lines
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.base import Estimates, plain_counts
from ipe_bench.noise.base import Noise
from ipe_bench.noise.kinds import Certified, ModelNoise
from ipe_bench.priors import GaussianPrior, Prior
from ipe_bench.states.algebra import half
from ipe_bench.states.base import Paths, StateModel, require_sound, widened
from ipe_bench.states.bounds import bound_at_truth, posterior_bounds
from ipe_bench.states.copies import SURE, copy_p
from ipe_bench.states.folds import exact_tracks, may_fold
from ipe_bench.states.formulas import RecordedFormulas
from ipe_bench.states.linearisation import Taylor
from ipe_bench.states.lost import why_lost
from ipe_bench.states.redone import unchanged
from ipe_bench.states.smoothers import path_p
from ipe_bench.states.trackers import Tracker, Tracks, filtered
from ipe_bench.trials.one_track import COLUMN, first_tracks, texts
from ipe_bench.trials.scenario import Scenario, check_seed
from ipe_bench.trials.scoring import Block, Columns, by_parameter, nees
from ipe_bench.trials.thresholds import EXPECTED, gate
from ipe_bench.trials.whiteness import white_p

_PARTS = 10
"""Groups of paths by whose scatter the standard error of the posterior bound is known."""
MOST_TRIALS = 10_000
"""Trials whose errors are stored for each epoch: the first ones."""
_INDEFINITE = 1e-10
"""A covariance of which an eigenvalue is below this, in its own deviations, has no inverse."""


@dataclass(frozen=True)
class StateScenario:
    """Everything that determines the trials of a state model. Paths and readings are drawn by the
    model's own prior, Q and R; trial t is the same in whatever block it is drawn."""

    model: StateModel
    seed: int = 0
    error_scale: float = 1.0
    """Multiplies the deviations of the prior, of the truth and of every tracker."""

    truth: ClassVar[None] = None
    prior: ClassVar[Prior] = GaussianPrior()

    __repr__ = in_lines

    def __post_init__(self) -> None:
        check_seed(self.seed)
        if not 0 < self.error_scale < np.inf:
            raise UserError(f"error_scale={self.error_scale}: give a finite number above 0")
        require_sound(self.assumed)

    @cached_property
    def assumed(self) -> StateModel:
        """The model with the prior that the truth is drawn from."""
        return widened(self.model, self.error_scale)

    @property
    def noise(self) -> Noise:
        return Certified() if isinstance(self.model, RecordedFormulas) else ModelNoise()

    @property
    def measurement(self) -> StateModel:
        """The model, as the other scenario calls it."""
        return self.model

    @cached_property
    def linear_bound(self) -> Array:
        """Standard deviations (n,) of the scored states at the last epoch in a filter that is
        linearised along the path without process noise from the mean of the prior."""
        model = self.assumed
        start = model.prior.mean[None]
        path = np.empty((1, model.epochs, model.n))
        x = start
        for k in range(model.epochs):
            if model.moves(k):
                x = model.transition(x, k)
            path[:, k] = x
        with np.errstate(all="ignore"):
            P = bound_at_truth(model, Paths(start, path, np.empty(0)))
            return deviations(P[0, -1])[self.scored]

    @cached_property
    def scored(self) -> Array:
        """The places (n,) among the states of those that are scored."""
        names = [p.name for p in self.model.parameters]
        return np.array([i for i, state in enumerate(self.model.states) if state.name in names])

    def draw(self, start: int, stop: int) -> Paths:
        """Paths of trials start to stop."""
        return self.assumed.draw(start, stop, self.seed)


AnyScenario = Scenario | StateScenario


@dataclass(frozen=True)
class PathBlock:
    """Trials of a state model with what the truth says of them."""

    scenario: StateScenario
    start: int
    paths: Paths
    _gates: dict[bool, Array] = field(default_factory=dict, repr=False, compare=False)

    @classmethod
    def draw(cls, scenario: StateScenario, start: int, stop: int) -> PathBlock:
        scenario.assumed.renew()
        with np.errstate(all="ignore"):
            return cls(scenario, start, scenario.draw(start, stop))

    def __len__(self) -> int:
        return len(self.paths.x)

    @property
    def names(self) -> list[str]:
        return [p.name for p in self.scenario.model.parameters]

    @cached_property
    def bound(self) -> Array:
        """Covariances (trials, K, n, n) of the scored states in the filter that is linearised at
        the truth."""
        return self._bound(smooths=False)

    def _bound(self, smooths: bool) -> Array:
        at = self.scenario.scored
        with np.errstate(all="ignore"):
            P = bound_at_truth(self.scenario.assumed, self.paths, smooths)
            return P[..., at[:, None], at]

    @cached_property
    def variances(self) -> Array:
        """Their diagonals (trials, K, n)."""
        return np.ascontiguousarray(np.diagonal(self.bound, axis1=2, axis2=3))

    @cached_property
    def smoothed_variances(self) -> Array:
        """Those (trials, K, n) of the smoother that is linearised at the truth."""
        P = self._bound(smooths=True)
        return np.ascontiguousarray(np.diagonal(P, axis1=2, axis2=3))

    def gates(self, smooths: bool) -> Array:
        """The variances (trials, K, n) against which errors are held: of a scalar state those of
        each trial's exact posterior, which no linear bound describes where the reading is folded,
        unless a grid would take longer than trackers do and the reading is not folded; else of the
        bound."""
        if smooths not in self._gates:
            self._gates[smooths] = self._gates_of(smooths)
        return self._gates[smooths]

    def _gates_of(self, smooths: bool) -> Array:
        bound = self.smoothed_variances if smooths else self.variances
        model = self.scenario.assumed
        if not may_fold(model):
            return bound
        z = self.paths.z
        with np.errstate(all="ignore"):
            first = filtered(model, z, Taylor())
            exact, rows = exact_tracks(model, z, first, smooths, of_all=True)
        return put(bound, rows, exact.covariance[..., 0])

    @cached_property
    def definite(self) -> Mask:
        """Whether the covariance at the last epoch has an inverse (trials,), so that NEES says
        something."""
        P = self.bound[:, -1]
        d = deviations(P)
        usable = finite(P) & (d > 0).all(axis=1)
        scale = d[:, :, None] * d[:, None, :]
        C = np.where(usable[:, None, None], P / scale, 0.0)
        return np.linalg.eigvalsh(C)[:, 0] > _INDEFINITE

    def warm_up(self, tracker: Tracker) -> None:
        """Runs the tracker once, so that imports are not timed."""
        track_safely(tracker, self.scenario.assumed, self.paths.z[:1])

    def share(self) -> None:
        """Computes what all trackers share."""
        _ = self.variances

    def truth_columns(self) -> Columns:
        """The scored states at the last epoch with their bounds."""
        model = self.scenario.assumed
        names = self.names
        at = self.scenario.scored
        posterior, error = np.full((2, len(self), len(at)), np.nan)
        if self.start == 0 and len(self) and not self.scenario.noise.real:
            drawn = self.scenario.draw(0, EXPECTED)
            # Without a density of paths there is no such bound.
            with np.errstate(all="ignore"), suppress(UserError, np.linalg.LinAlgError):
                filtered, _ = posterior_bounds(model, drawn)
                groups = [take(drawn, np.arange(i, EXPECTED, _PARTS)) for i in range(_PARTS)]
                parts = [posterior_bounds(model, group)[0][-1] for group in groups]
                posterior[0] = deviations(filtered[-1])[at]
                error[0] = deviations(np.array(parts)).std(axis=0, ddof=1)[at] / np.sqrt(_PARTS)
        path = np.concatenate([self.paths.x[..., at], self.paths.z], axis=2)
        return {
            "trial": np.arange(self.start, self.start + len(self)),
            **by_parameter("x", names, self.paths.x[:, -1, at]),
            **by_parameter("bayes", names, np.sqrt(self.variances[:, -1])),
            **by_parameter("van_trees", names, posterior),
            **by_parameter("van_trees_error", names, error),
            COLUMN: texts(self.start, path),
        }

    def estimate(self, tracker: Tracker) -> tuple[Estimates, Columns]:
        """What a tracker makes of the states at the last epoch, and its scores over the whole
        path."""
        variances = self.smoothed_variances if tracker.smooths else self.variances
        began = time.perf_counter()
        with unchanged():
            tracks, messages = track_safely(tracker, self.scenario.assumed, self.paths.z)
        elapsed = time.perf_counter() - began
        seconds = np.full(len(self), elapsed / max(1, len(self)))
        with np.errstate(all="ignore"):
            return self._scored(tracks, messages, seconds, variances, self.gates(tracker.smooths))

    def _scored(
        self,
        tracks: Tracks,
        messages: dict[int, str],
        seconds: Array,
        variances: Array,
        gates: Array,
    ) -> tuple[Estimates, Columns]:
        """The tracks as estimates of the last epoch, with what is stored of each trial; `variances`
        (trials, K, n) are those of the bound over the path, `gates` those that errors are held
        against."""
        at = self.scenario.scored
        x = self.paths.x
        e = self.scenario.assumed.nearest_state(tracks.mean, x) - x
        reported = np.isfinite(tracks.covariance).all(axis=(2, 3))
        known: Mask = np.asarray(np.isfinite(e).all(axis=2) & reported)
        e = e[..., at]
        P = tracks.covariance[..., at[:, None], at]
        trials, K, n = e.shape
        estimates = self._estimates(tracks, known, messages, seconds)
        status = estimates.status
        converged = status == Status.CONVERGED
        finished = known.all(axis=1) & (status != Status.NO_READINGS)
        each = nees(e.reshape(-1, n), P.reshape(-1, n, n)).reshape(trials, K)
        each[~self.definite] = np.nan
        # A track with a gap is no answer, in whatever counts by its distance.
        distance = np.where(finished, self._distance(e[:, -1], gates[:, -1]), np.nan)
        # Squared errors over the variances, where the model leaves any.
        normalised = np.sum(np.where(gates > 0, e**2 / gates, 0.0), axis=2)
        over_filter = _over(e**2, self.variances)
        columns = {
            "trial": np.arange(self.start, self.start + len(self)),
            **by_parameter("error", self.names, e[:, -1]),
            **by_parameter("deviation", self.names, deviations(P[:, -1])),
            **by_parameter("path", self.names, np.sqrt(np.mean(e**2, axis=1))),
            **by_parameter("path_bound", self.names, np.sqrt(variances.mean(axis=1))),
            "status": np.array([Status(s).label for s in status.tolist()], dtype=object),
            "message": np.array([messages.get(i, "") for i in range(trials)], dtype=object),
            "iterations": estimates.iterations,
            "simulations": estimates.simulations,
            "jacobians": estimates.jacobians,
            "time_s": seconds,
            "crlb_distance": distance,
            "nees": each[:, -1],
            "solved": converged,
            "success": distance <= gate(n),
            "fit_p": self._fit_p(tracks),
            "path_nees": each.mean(axis=1),
            "path_error": np.sqrt(over_filter.mean(axis=1)),
            "path_success": finished & (normalised.mean(axis=1) <= gate(n)),
            **_innovation_columns(tracks),
            "first_bad_epoch": _first_epoch(~(normalised <= gate(n))),
            "curves": packed(trials, self._sums(each[converged], variances)),
            "curves_errors": self._errors(e, over_filter),
        }
        if tracks.stage is not None:
            columns["extra_stage"] = np.asarray(tracks.stage, dtype=float)
        columns[COLUMN] = first_tracks(self.start, tracks.mean[..., at], P, self.names)
        return estimates, columns | self._copies(tracks)

    def _sums(self, claims: Array, variances: Array) -> list[Array]:
        """Sums (K, 1 or n) over trials, by epoch: NEES of the `claims` (converged, K) and their
        number, the variances of the bound, their ratio to those of the filter, and its number."""
        K = claims.shape[1]
        known = variances[np.isfinite(variances).all(axis=(1, 2))]
        of_filter = self.variances[np.isfinite(variances).all(axis=(1, 2))]
        ratio = _over(known, of_filter).sum(axis=0)
        counts = [np.full((K, 1), len(trials)) for trials in (claims, known)]
        nees_sum = claims.sum(axis=0)
        return [nees_sum[:, None], counts[0], known.sum(axis=0), ratio[:, None], counts[1]]

    def _errors(self, e: Array, over_filter: Array) -> Array:
        """Texts (trials,) with the errors (K, n + 1) of each trial by epoch: of each state, and of
        all over the filter's bound; empty without readings, and from `MOST_TRIALS` on."""
        errors = np.concatenate([np.abs(e), np.sqrt(over_filter)[:, :, None]], axis=2)
        texts = np.full(len(e), "", dtype=object)
        numbers = self.start + np.arange(len(e))
        for i in np.flatnonzero(finite(self.paths.x) & (numbers < MOST_TRIALS)).tolist():
            texts[i] = base64.b64encode(errors[i].astype("<f4").tobytes()).decode()
        return texts

    def _distance(self, e: Array, gates: Array) -> Array:
        """Squared errors (trials,) of the last epoch in the metric of the bound at the truth, or of
        the gate (trials, 1) of a scalar state."""
        if may_fold(self.scenario.assumed):
            return e[:, 0] ** 2 / gates[:, 0]
        white = half(self.bound[:, -1]).whitened(e[:, None])[:, 0]
        return np.sum(white**2, axis=1)

    def _estimates(
        self, tracks: Tracks, known: Mask, messages: dict[int, str], seconds: Array
    ) -> Estimates:
        """The tracks at the last epoch; adds to `messages` where a track is not finite, which
        `known` (trials, K) says."""
        at = self.scenario.scored
        trials, K = known.shape
        raised = list(messages)
        finished = known.all(axis=1)
        status = tracks.status
        if status is None:
            status = np.full(trials, Status.CONVERGED)
        status = np.where(finished | (status != Status.CONVERGED), status, Status.NONFINITE)
        status[raised] = Status.ERROR
        status[~finite(self.paths.x)] = Status.NO_READINGS
        iterations = np.full(trials, K) if tracks.iterations is None else tracks.iterations.copy()
        iterations[raised] = 0
        why = why_lost(self.scenario.assumed, tracks.mean, states=False)
        for i in np.flatnonzero(~finished).tolist():
            epoch = int(np.argmin(known[i])) + 1
            lost = f"the track is not finite from epoch {epoch} on"
            messages.setdefault(i, f"{lost}: {why[i]}" if i in why else lost)
        for i in np.flatnonzero(tracks.by_epoch).tolist() if tracks.by_epoch is not None else ():
            messages.setdefault(i, REDONE)
        return Estimates(
            x=tracks.mean[:, -1, at],
            status=status.astype(np.int8),
            covariance=tracks.covariance[:, -1, at[:, None], at],
            iterations=iterations,
            simulations=tracks.calls,
            messages=messages,
            seconds=seconds,
        )

    def _copies(self, tracks: Tracks) -> Columns:
        """How probable each path is among its copies by whole periods, and whether they or a second
        path leave it open."""
        columns: Columns = {}
        known = np.zeros(len(self), dtype=bool)
        is_open = np.zeros(len(self), dtype=bool)
        p = copy_p(self.scenario.assumed, self.paths.z, tracks)
        if p is not None:
            columns["copy_p"] = p
            known |= ~np.isnan(p)
            is_open |= p < SURE
        if tracks.other_p is not None:
            known |= np.isfinite(tracks.mean).all(axis=(1, 2)) & np.isfinite(tracks.other_p)
            is_open |= tracks.other_p > 1 - SURE
        if known.any():
            columns["extra_ambiguous"] = np.where(known, is_open, np.nan)
        return columns

    def _fit_p(self, tracks: Tracks) -> Array:
        """How probable a worse fit is (trials,): of the path of an iterated smoother by its cost,
        else by the filter's innovations; NaN of a tracker that has neither."""
        from scipy.special import chdtrc

        if tracks.cost is not None:
            return path_p(self.paths.z, tracks.cost)
        squares = tracks.nis.sum(axis=1)
        read = tracks.degrees.sum(axis=1)
        return np.where(read > 0, chdtrc(read, squares), np.nan)


def _over(squares: Array, variances: Array) -> Array:
    """Mean squares over states (trials, K) of squares (trials, K, n) over variances, of the states
    that the model leaves any variance."""
    ratios = np.where(variances > 0, squares / variances, 0.0)
    return ratios.sum(axis=2) / np.maximum((variances > 0).sum(axis=2), 1)


def _first_epoch(bad: Mask) -> Array:
    """The number (trials,) of the first epoch that is bad (trials, K); NaN if none is."""
    return np.where(bad.any(axis=1), bad.argmax(axis=1) + 1.0, np.nan)


def _innovation_columns(tracks: Tracks) -> Columns:
    """What is stored of a filter's innovations; NaN of a tracker that has none."""
    read = tracks.degrees.sum(axis=1)
    nis = tracks.nis.sum(axis=1) / np.maximum(read, 1)
    return {
        "extra_nis": np.where(read > 0, nis, np.nan),
        "log_likelihood": np.where(read > 0, tracks.log_likelihood, np.nan),
        "white_p": white_p(tracks.innovations.swapaxes(1, 2)),
    }


def block_of(scenario: AnyScenario, start: int, stop: int) -> Any:
    """Trials start to stop of a scenario: a `PathBlock` or a `Block`."""
    if isinstance(scenario, StateScenario):
        return PathBlock.draw(scenario, start, stop)
    return Block.draw(scenario, start, stop)


REDONE = "tracked by the functions in Python, from which the recorded ones differ at its states"


def track_safely(tracker: Tracker, model: StateModel, z: Array) -> tuple[Tracks, dict[int, str]]:
    """The tracks of readings z (trials, K, m), and why trials have none: a batch that raises is
    tracked trial by trial, and one that raises alone is NaN; a UserError or MemoryError is
    raised."""
    try:
        with np.errstate(all="ignore"):
            tracks = tracker.track(model, read_only(z))
    except (MemoryError, UserError):
        raise
    except Exception as error:
        if len(z) == 1:
            return Tracks.lost(model, 1), {0: describe_exception(error)}
    else:
        _make_plain(tracker, tracks, len(z), model)
        return tracks, {}
    parts = []
    messages = {}
    for i, row in enumerate(z):
        part, message = track_safely(tracker, model, row[None])
        parts.append(part)
        if message:
            messages[i] = message[0]
    return Tracks.join(parts), messages


def _make_plain(tracker: Tracker, tracks: Any, trials: int, model: StateModel) -> None:
    """Replaces what a tracker returned by ordinary arrays of floats, as of an estimator; ValueError
    if it cannot be."""
    name = f"{type(tracker).__name__}.track returns"
    if not isinstance(tracks, Tracks):
        raise ValueError(f"{name} {type(tracks).__name__}, where Tracks are asked for")
    K = model.epochs
    shapes = {
        "mean": (K, model.n),
        "covariance": (K, model.n, model.n),
        "nis": (K,),
        "degrees": (K,),
        "log_likelihood": (),
        "innovations": (K, model.readings_per_epoch),
    }
    for part, shape in shapes.items():
        values = getattr(tracks, part)
        setattr(tracks, part, plain_numbers(f"{name} {part}", values, (trials, *shape)))
    tracks.calls = plain_counts(name, "calls", tracks.calls, trials)
    if tracks.cost is not None:
        tracks.cost = plain_numbers(f"{name} cost", tracks.cost, (trials,))
    for part in ("status", "iterations"):
        values = getattr(tracks, part)
        if values is not None:
            setattr(tracks, part, plain_counts(name, part, values, trials))


def packed(trials: int, sums: Sequence[Array]) -> Array:
    """Texts (trials,) of which the first holds sums (K, columns) over the trials of a block."""
    numbers = np.concatenate(sums, axis=1).astype("<f8")
    text = base64.b64encode(numbers.tobytes()).decode()
    texts = [text, *[""] * (trials - 1)]
    return np.array(texts, dtype=object)[:trials]


def unpacked(texts: Array, epochs: int, columns: int) -> Array:
    """The sums (blocks, K, columns) that `packed` wrote, without those of versions that kept other
    columns."""
    found = [np.frombuffer(base64.b64decode(text), "<f8") for text in texts if text]
    kept = [numbers for numbers in found if len(numbers) == epochs * columns]
    return np.array(kept).reshape(len(kept), epochs, columns)


def errors_in(texts: Array, epochs: int, columns: int) -> Array:
    """The errors (trials, K, columns) that texts hold."""
    found = [np.frombuffer(base64.b64decode(text), "<f4") for text in texts if text]
    return np.array(found, dtype=float).reshape(len(found), epochs, columns)
