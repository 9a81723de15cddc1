"""Smoothers of state models: every epoch is estimated from all readings, by passes back through a
filter's tracks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from ipe_bench.basics.batches import put
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Count, NonNegative
from ipe_bench.states.base import Normal, StateModel
from ipe_bench.states.linearisation import Rule, Taylor
from ipe_bench.states.trackers import Filter, Tracker, Tracks, smoothed
from ipe_bench.states.whole_paths import PathDensity, Settled, Tangents

_HALVINGS = 11
"""Halvings of a damped step at most."""
_ROUND_OFF = 1e-12
"""Part of a cost by which it may rise."""


@dataclass(frozen=True)
class Smoother(Tracker):
    """The smoother of Rauch, Tung and Striebel (AIAA J. 3, 1965) behind a filter.

    Example:

    >>> import ipe_bench as ib
    >>> model = ib.component("state_model/pendulum", count=20, spread={"angle": 0.3, "rate": 0.3})
    >>> table = ib.run(model, {"ekf_rts": ib.states.Smoother(filter=ib.states.ekf())}, trials=20)
    >>> float(table.iloc[-1]["success"])
    1.0
    """

    smooths: ClassVar[bool] = True
    filter: Filter = field(default_factory=Filter)
    """The filter whose tracks are smoothed."""

    @property
    def gate(self) -> float | None:
        return self.filter.gate

    def hindrance(self, model: StateModel) -> str | None:
        return self.filter.hindrance(model)

    def gated(self, gate: float) -> Smoother:
        return replace(self, filter=self.filter.gated(gate))

    def track(self, model: StateModel, z: Array) -> Tracks:
        behind = self.filter
        out, tracks = smoothed(model, z, behind.rule, behind.iterations, gate=behind.gate)
        out.cost = tracks.nis.sum(axis=1)  # that of its path is chi-square at the minimum alone
        out.gated = tracks.gated
        out.weights = tracks.weights
        return out


@dataclass(frozen=True)
class IteratedSmoother(Tracker):
    """Linearises everything about the last smoothed path and solves that affine problem exactly,
    again and again.

    By Taylor's rule these are Gauss-Newton steps to the path of largest posterior density (Bell,
    SIAM J. Optim. 4, 1994), with `damped` halved while they raise its cost; by sigma points it is
    the iterated posterior linearisation smoother (García-Fernández, Svensson, Särkkä, IEEE TSP 65,
    2017). The first path is the track of `first`.

    Example:

    >>> import ipe_bench as ib
    >>> model = ib.component("state_model/pendulum", count=20, spread={"angle": 0.3, "rate": 0.3})
    >>> trackers = {"ieks": ib.states.IteratedSmoother(first=ib.states.ukf())}
    >>> table = ib.run(model, trackers, trials=20)
    >>> float(table.iloc[-1]["success"])
    1.0
    """

    family: ClassVar[str] = "least squares"
    smooths: ClassVar[bool] = True
    first: Filter = field(default_factory=Filter)
    """The filter whose tracks are the first path."""
    rule: Rule = field(default_factory=Taylor)
    """How transition and reading are linearised about a path."""
    iterations: Count = 10
    """Paths at most, after the first."""
    damped: bool = False
    """Whether steps that raise the cost of the path are halved."""
    tolerance: NonNegative = 0.0
    """A trial ends where its path moves by at most so many of its own standard deviations: by
    tangents over all states and epochs together, by points those of each state."""

    def hindrance(self, model: StateModel) -> str | None:
        # Steps on a cost know Q and R alone.
        if self.damped or isinstance(self.rule, Taylor):
            return super().hindrance(model)
        return self.first.hindrance(model)

    @property
    def gate(self) -> float | None:
        return self.first.gate

    def gated(self, gate: float) -> IteratedSmoother:
        return replace(self, first=self.first.gated(gate))

    def track(self, model: StateModel, z: Array) -> Tracks:
        path = self.first.track(model, z)
        if path.gated is not None:
            # What the first filter takes for missing is missing to all.
            z = np.where(path.gated, np.nan, z)
        if isinstance(self.rule, Taylor):
            out = self._by_tangents(PathDensity.of(model, z), path)
        else:
            out = self._by_points(model, z, path)
        out.gated = path.gated
        return out

    def _by_tangents(self, density: PathDensity, path: Tracks) -> Tracks:
        model = density.model
        x = whole(path).mean
        calls = path.calls.copy()
        if not model.moved_first:
            x[:, 0] = x[:, 1]
        going = np.arange(len(x))
        tangents = None
        for _ in range(self.iterations):
            # Gauss-Newton: dx solves the affine problem about the path exactly.
            some = density.subset(going)
            at, about = some.about(x[going])
            new = at.x + some.step(about, at)
            calls[going] += at.calls
            if self.damped:
                shorter = _shortened(some, at.x, new)
                new = shorter.x
                calls[going] += shorter.calls
            x[going] = new
            tangents = about if tangents is None else put(tangents, going, about)
            moved = some.size(about, new - at.x)
            going = going[moved > self.tolerance**2]
            if not going.size:
                break
        assert tangents is not None
        end = density.settled(x)
        calls += end.calls
        if self.damped:
            end = density.settled_exactly(end)
            x = end.x
            calls += end.calls
        P = density.spread(tangents, end).covariance
        out = tracks_of(density, end, x, tangents, P)
        out.calls = calls
        return out

    def _by_points(self, model: StateModel, z: Array, path: Tracks) -> Tracks:
        calls = path.calls
        going = np.ones(len(z), dtype=bool)
        for _ in range(self.iterations):
            # Posterior linearisation: points about the last smoothed path, then its smoother.
            new, _ = smoothed(model, z, self.rule, path=path)
            calls = calls + np.where(going, new.calls, 0.0)
            if self.damped:
                density = PathDensity.of(model, z)
                shorter = _shortened(density, whole(path).mean, whole(new).mean)
                new.start = new.start._replace(mean=shorter.x[:, 0])
                new.mean = shorter.x[:, 1:]
                calls = calls + np.where(going, shorter.calls, 0.0)
            variances = np.diagonal(new.covariance, axis1=-2, axis2=-1)
            deviation = np.sqrt(np.maximum(variances, 0.0))
            moved = np.abs(new.mean - path.mean) > self.tolerance * deviation
            on = (moved & (deviation > 0)).any(axis=(1, 2))
            # A trial that has ended stays where it is, as if it were alone.
            for mine, its in zip(_arrays(new), _arrays(path), strict=True):
                mine[~going] = its[~going]
            path = new
            going &= on
            if not going.any():
                break
        path.calls = calls
        if not (model.gain_by_state or model.R_by_state):
            end = PathDensity.of(model, z).settled(whole(path).mean)
            path.cost = end.misfit
            path.calls = calls + end.calls
        return path


def tracks_of(density: PathDensity, at: Settled, x: Array, tangents: Tangents, P: Array) -> Tracks:
    """Returns the tracks of paths x (trials, 1 + K, n), which are settled `at`, with covariances P
    (trials, 1 + K, n, n), NaN where tangents say that no digits are left of them."""
    P[density.beyond_digits(tangents, x)] = np.nan
    out = Tracks.empty(density.model, len(x))
    out.start = Normal(x[:, 0], P[:, 0])
    out.mean = x[:, 1:]
    out.covariance = P[:, 1:]
    out.cost = at.misfit
    out.weights = density.weights(at)
    return out


def _arrays(tracks: Tracks) -> Iterator[Array]:
    """Yields what smoothed tracks say of states, the trials in front."""
    yield tracks.mean
    yield tracks.covariance
    yield from tracks.start
    if tracks.root is not None:
        yield tracks.root


def whole(tracks: Tracks) -> Normal:
    """Returns the states (trials, 1 + K, n) and their covariances (trials, 1 + K, n, n) from before
    the first transition."""
    mean = np.concatenate([tracks.start.mean[:, None], tracks.mean], axis=1)
    covariance = np.concatenate([tracks.start.covariance[:, None], tracks.covariance], axis=1)
    return Normal(mean, covariance)


def path_p(z: Array, cost: Array) -> Array:
    """Computes the probability (trials,) of a cost above that of a path of largest density, if the
    model holds: it is chi-square with as many degrees as the readings z (trials, K, m) that are
    there."""
    from scipy.special import chdtrc

    return chdtrc(np.isfinite(z).sum(axis=(1, 2)), cost)


def _shortened(density: PathDensity, old: Array, new: Array) -> Settled:
    """Halves the steps between paths (trials, 1 + K, n) in each trial until they do not raise its
    cost; the calls are those of all costs."""
    before = density.settled(old)
    found = density.settled(new)
    calls = before.calls + found.calls
    share = 1.0
    for _ in range(_HALVINGS):
        # A cost that is not finite counts as a rise.
        lowered = found.cost <= before.cost * (1 + _ROUND_OFF)
        rows = np.flatnonzero(~lowered)
        if not rows.size:
            break
        share /= 2
        shorter = old[rows] + share * (new[rows] - old[rows])
        part = density.subset(rows).settled(shorter)
        found = put(found, rows, part)
        calls[rows] += part.calls
    return replace(found, calls=calls)
