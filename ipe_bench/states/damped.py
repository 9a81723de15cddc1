"""The iterated smoother of Levenberg and Marquardt, which finds the path of largest posterior density from far away."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.batches import put, take
from ipe_bench.basics.linalg import Array, finite, multiply
from ipe_bench.basics.options import Count, Positive, Share, Whole
from ipe_bench.basics.statuses import Status
from ipe_bench.basics.streams import normals, own_generators
from ipe_bench.states.algebra import root
from ipe_bench.states.base import Normal, StateModel
from ipe_bench.states.linearisation import Affine, Taylor, Unscented
from ipe_bench.states.smoothers import path_p, settled, smoothed, whole
from ipe_bench.states.trackers import (
    Tracker,
    Tracks,
    filtered,
    linearised_move,
    linearised_reading,
    predict,
    update,
)

_TRIES, _FACTOR = 15, 10.0
"""Dampings that are tried about one path, and the factor between them."""
_ROUND_OFF = 1e-12
"""Part of a cost by which it may rise."""
_SHARE = 0.5
"""Standard deviations of the prior about a further start, in those of the prior."""


@dataclass(frozen=True)
class _Paths:
    """Holds the paths of a batch on their way down."""

    x: Array
    """(trials, 1 + K, n), from before the first transition."""
    P: Array
    """(trials, 1 + K, n, n)"""
    cost: Array
    """(trials,)"""
    damping: Array
    """(trials,)"""
    status: NDArray[np.int8]
    iterations: NDArray[np.int64]
    calls: Array

    @classmethod
    def of(cls, model: StateModel, z: Array, tracks: Tracks) -> _Paths:
        """Those of a smoother's tracks; a path that is not finite costs infinitely much."""
        x, P = whole(tracks)
        x, cost = settled(model, z, x)
        cost = np.nan_to_num(cost, nan=np.inf)
        trials = len(z)
        running, none = np.full(trials, Status.RUNNING, np.int8), np.zeros(trials, np.int64)
        return cls(x, P, cost, np.zeros(trials), running, none, tracks.calls + model.evaluations)

    def improved(self, other: _Paths, rows: NDArray[np.intp]) -> _Paths:
        """These paths with those of `other`, of the trials `rows`, that cost less; both have been paid for."""
        better = other.cost < self.cost[rows]
        calls = self.calls.copy()
        calls[rows] += other.calls
        return replace(put(self, rows[better], take(other, better)), calls=calls)


@dataclass(frozen=True)
class LevenbergMarquardtSmoother(Tracker):
    r"""Damped Gauss-Newton steps to the path of largest posterior density (Särkkä and Svensson, ICASSP 2020: LM-IEKS).

    Each step is a filter and a smoother of the model linearised about the last path, in which every state is read once
    more, where it was, with a variance of `scale / damping`. The scale of a state is its variance before anything is
    read. The damping is 0 as long as steps lower the cost of the path, and grows tenfold where one does not,

    .. math:: J(x) = |x_0 - m_0|^2_{P_0^{-1}} + \sum_k |w_k|^2 + \sum_k |z_k - h(x_k)|^2_{R_k^{-1}}.

    The first path is the smoothed track of the EKF or of the UKF, whichever costs less. At its minimum J is chi-square
    with as many degrees as there are readings. Where it is too large for that, the trial begins again at draws of the
    prior, each smoothed by a UKF of half the prior's deviations, from the one that costs least.
    """

    family: ClassVar[str] = "least squares"
    smooths: ClassVar[bool] = True
    iterations: Count = 30
    """Steps at most from one start."""
    tolerance: Positive = 1e-2
    """A path has converged if no undamped step moves it by more than this many of its own standard deviations."""
    damping: Positive = 1e-2
    """The first damping of a step that raises the cost."""
    level: Share = 1e-3
    """A trial is lost if so large a cost is less probable than this."""
    starts: Whole = 10
    """Draws of the prior among which a trial that is lost looks for another start."""
    seed: int = 0
    """A trial's draws depend on this and on its readings: on nothing else in the batch."""

    def track(self, model: StateModel, z: Array) -> Tracks:
        first, other = (
            _Paths.of(model, z, smoothed(model, filtered(model, z, rule)))
            for rule in (Taylor(), Unscented())
        )
        paths = self._descended(model, z, first.improved(other, np.arange(len(z))))
        rows = np.flatnonzero(~(path_p(z, paths.cost) >= self.level))
        if self.starts and len(rows):
            paths = paths.improved(
                self._descended(model, z[rows], self._drawn(model, z[rows])), rows
            )
        out = Tracks.empty(model, len(z))
        out.start, out.mean, out.covariance = (
            Normal(paths.x[:, 0], paths.P[:, 0]),
            paths.x[:, 1:],
            paths.P[:, 1:],
        )
        out.calls, out.cost, out.status, out.iterations = (
            paths.calls,
            paths.cost,
            paths.status,
            paths.iterations,
        )
        return out

    def _drawn(self, model: StateModel, z: Array) -> _Paths:
        """For each trial, the smoothed UKF of least cost among those that begin at draws of the prior."""
        m, P = model.prior
        spread, generators = root(P), own_generators(self.seed, z.reshape(len(z), -1))
        draws = normals(generators, self.starts, spread.shape[1])
        best = None
        for i in range(self.starts):
            start = Normal(
                m + multiply(spread, draws[:, i]), np.repeat(_SHARE**2 * P[None], len(z), 0)
            )
            found = _Paths.of(
                model, z, smoothed(model, filtered(model, z, Unscented(), start=start))
            )
            best = found if best is None else best.improved(found, np.arange(len(z)))
        assert best is not None
        return best

    def _descended(self, model: StateModel, z: Array, paths: _Paths) -> _Paths:
        """The paths after steps down, until each has converged or gets no further."""
        active = np.arange(len(z))
        for _ in range(self.iterations):
            paths = put(paths, active, self._stepped(model, z[active], take(paths, active)))
            active = active[paths.status[active] == Status.RUNNING]
            if not len(active):
                break
        return replace(
            paths,
            status=np.where(paths.status == Status.RUNNING, Status.MAX_ITERATIONS, paths.status),
        )

    def _stepped(self, model: StateModel, z: Array, paths: _Paths) -> _Paths:
        """The paths after one step, at the least damping that does not raise the cost."""
        moves, reads = _linearised(model, z, paths.x)
        calls = paths.calls + Taylor().calls(model.n) * model.evaluations
        free, P = whole(smoothed(model, _passed(model, z, moves, reads)))
        deviation = np.sqrt(np.maximum(np.diagonal(P, axis1=2, axis2=3), 0.0))
        far = (np.abs(free - paths.x) > self.tolerance * deviation) & (deviation > 0)
        there = ~far.any(axis=(1, 2)) & finite(free)
        x, cost, damping = paths.x.copy(), paths.cost.copy(), paths.damping.copy()
        todo, scale = np.arange(len(z)), np.empty(0)
        for _ in range(_TRIES):
            new, damped = free[todo], damping[todo] > 0
            if (rows := todo[damped]).size:
                if not scale.size:  # the variances of states that nothing is read of
                    blind = whole(_passed(model, np.full_like(z, np.nan), moves, reads))[1]
                    scale = np.diagonal(blind, axis1=2, axis2=3)
                about = paths.x[rows], scale[rows] / damping[rows, None, None]
                some = (
                    [Affine(*[part[rows] for part in law]) for law in laws]
                    for laws in (moves, reads)
                )
                new[damped] = whole(smoothed(model, _passed(model, z[rows], *some, about=about)))[0]
            new, found = settled(model, z[todo], new)
            calls[todo] += model.evaluations
            lower = found <= cost[todo] * (1 + _ROUND_OFF)
            x[todo[lower]], cost[todo[lower]] = new[lower], found[lower]
            todo = todo[~lower & ~there[todo]]
            if not todo.size:
                break
            damping[todo] = np.maximum(_FACTOR * damping[todo], self.damping)
        eased = np.where(damping > self.damping, damping / _FACTOR, 0.0)
        damping = np.where(damping == paths.damping, eased, damping)
        status = np.where(there, Status.CONVERGED, Status.RUNNING)
        status[todo] = Status.STALLED
        return _Paths(x, P, cost, damping, status, paths.iterations + 1, calls)


def _linearised(model: StateModel, z: Array, x: Array) -> tuple[list[Affine], list[Affine]]:
    """The tangents of transitions and readings along paths x (trials, 1 + K, n)."""
    rule, P = Taylor(), np.empty(0)
    moves = [
        linearised_move(model, rule, k, Normal(x[:, k], P), x[:, k + 1])
        for k in range(model.epochs)
        if model.moves(k)
    ]
    reads = [
        linearised_reading(model, rule, k, z[:, k], Normal(x[:, k + 1], P))
        for k in range(model.epochs)
    ]
    return moves, reads


def _passed(
    model: StateModel,
    z: Array,
    moves: list[Affine],
    reads: list[Affine],
    about: tuple[Array, Array] | None = None,
) -> Tracks:
    """The filter of an affine model. Where `about` gives x (trials, 1 + K, n) and variances of that shape, each state
    is read once more, as x with these variances."""
    out, n, m = Tracks.empty(model, len(z)), model.n, z.shape[-1]
    if about is not None:
        out.innovations = np.full((len(z), model.epochs, m + n), np.nan)
        out.start = update(out.start, *_read_again(about, 0)).x
    x, moved = out.start, iter(moves)
    for k in range(model.epochs):
        if model.moves(k):
            out.moves.append(move := next(moved))
            x = predict(x, move, model.Q(k))
            out.predicted.append(x)
        read, R, y = reads[k], model.R(k), z[:, k]
        if about is not None:
            again, _, there = _read_again(about, k + 1)
            W = np.zeros((len(z), m + n, m + n))
            W[:, :m, :m], W[:, m:, m:] = R, again.W
            H, b = (
                np.concatenate(parts, axis=1) for parts in ((read.A, again.A), (read.b, again.b))
            )
            read = Affine(H, b, W)
            R, y = np.zeros((m + n, m + n)), np.concatenate([y, there], axis=1)
        x = out.note(k, update(x, read, R, y))
    return out


def _read_again(about: tuple[Array, Array], k: int) -> tuple[Affine, Array, Array]:
    """The reading of all states of which path and variances are given, with no further noise, and its values."""
    x, variances = (part[:, k] for part in about)
    n, known = x.shape[1], variances == 0
    one = np.broadcast_to(np.eye(n), (len(x), n, n))
    W = np.where(known, 1.0, variances)[:, :, None] * one
    return Affine(one, np.zeros(x.shape), W), np.zeros((n, n)), np.where(known, np.nan, x)
