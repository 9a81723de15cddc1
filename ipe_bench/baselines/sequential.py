"""Filters whose linear algebra is filterpy's own: the parameters as a random constant, the readings epoch by epoch.

All trials of a batch advance together: what the model would read at every trial's points of an epoch is one batched
call, and each trial's filterpy object is then given its share of the answer.
"""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np

from ipe_bench.baselines.epochs import Epoch, Rows, Walk, require_needs
from ipe_bench.basics.errors import UserError, describe_exception
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import NonNegative, Positive
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.base import Estimates, Estimator, Need
from ipe_bench.measurements.problem import Problem

LARGEST = 1e150
"""What a filter is given must have squares."""


class Track(ABC):
    """One trial's filter. The state x is the parameters' distance from the nominal point in prior deviations, and the
    readings are whitened (R = I)."""

    nis: float = 0.0
    """The squared innovations y' S^-1 y, summed over the epochs so far."""

    @property
    @abstractmethod
    def x(self) -> Array:
        """The estimate (n,)."""

    @property
    @abstractmethod
    def P(self) -> Array:
        """Its covariance (n, n)."""

    @abstractmethod
    def predict(self) -> None:
        """Brings the state from one epoch to the next: the parameters stay, the process noise comes on top."""

    @abstractmethod
    def points(self) -> Array:
        """The states (points, n) at which this epoch's readings are wanted."""

    @abstractmethod
    def update(self, z: Array, h: Array, H: Array | None) -> bool:
        """Takes in the readings z (m,), given h (points, m) and, for filters with slopes, dh/dx (m, n) at the points.

        Returns False where the filter wants to be read again at new points before it is done with this epoch.
        """


@dataclass(frozen=True)
class Sequential(Estimator):
    """What all filters have in common. A new filter is a frozen dataclass that says how a trial's `Track` begins.

    Reports filterpy's P, and as `extras["nis"]` the trial's squared innovations over their number: 1 on average where
    the filter is consistent (`ipe_bench.statistics.consistency.mean_limits` has the limits).
    """

    prior_inflation: Positive = 1.0
    """The filter's prior deviations over the scenario's: in life a prior is never exact."""
    process_noise: NonNegative = 0.0
    """Standard deviation of the parameters' random walk from one epoch to the next, in prior deviations (before
    inflation). The parameters are constants, so anything above 0 makes the filter forget."""
    engine: Literal["filterpy", "batched"] = "filterpy"
    """Who computes the filter's equations: filterpy, trial by trial, or this package, for all trials at once."""

    needs: ClassVar[frozenset[Need]] = frozenset({"epochs", "prior"})
    slopes: ClassVar[bool] = False
    """True where `Track.update` wants dh/dx; then there is one point per trial."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for engine, method in (("batched", "stack"), ("filterpy", "track")):
            if self.engine == engine and getattr(type(self), method) is getattr(Sequential, method):
                raise UserError(f"engine={engine}: this filter has no {method}; choose the other engine")

    def track(self, P0: Array, Q: Array, z: Array) -> Track:
        """The filter of one trial before its first reading, at x = 0 with covariance P0 (n, n) and process noise Q
        (n, n) per epoch. z (m,) are all readings of the trial: for a random stream that is the trial's own, and for
        nothing else. A filter that has none is computed for all trials at once."""
        raise NotImplementedError

    def stack(self, P0: Array, Q: Array, problem: Problem, z: Array) -> Walk:
        """The filters of all trials at once, for readings z (trials, m). A filter that has none is filterpy's."""
        raise NotImplementedError

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        require_needs(self, problem)
        P0 = self.prior_inflation**2 * problem.scaled_prior
        Q = self.process_noise**2 * np.eye(problem.measurement.n)
        with np.errstate(all="ignore"), warnings.catch_warnings():
            if self.engine == "batched":
                return self.stack(P0, Q, problem, z).estimates(history=history)
            from scipy.linalg import LinAlgWarning

            # SciPy warns of an ill-conditioned S, which R's smallness beside a wide prior explains.
            warnings.simplefilter("ignore", LinAlgWarning)
            return _Tracks(self, P0, Q, problem, z).estimates(history=history)


class _Tracks(Walk):
    """filterpy's filters of a batch; an exception ends the trial that raises it and no other."""

    def __init__(self, filter: Sequential, P0: Array, Q: Array, problem: Problem, z: Array) -> None:
        super().__init__(problem, z)
        self.slopes = filter.slopes
        self.tracks: dict[int, Track] = {}
        for trial in self.going.tolist():
            self.tracks[trial] = self.attempt(trial, lambda t=trial: filter.track(P0.copy(), Q.copy(), z[t]))

    def attempt(self, trial: int, action: Callable[[], Any]) -> Any:
        """`action()`, or None where it raises."""
        try:
            return action()
        except np.linalg.LinAlgError as error:
            self.end([trial], Status.SINGULAR, describe_exception(error))
        except OverflowError as error:
            self.end([trial], Status.NONFINITE, describe_exception(error))
        except Exception as error:
            self.end([trial], Status.ERROR, describe_exception(error))
        return None

    def take_in(self, epoch: Epoch, at: Rows) -> None:
        for trial in at.tolist():
            self.attempt(trial, self.tracks[trial].predict)
        waiting = self.going.tolist()
        while waiting:
            points = {t: self.attempt(t, self.tracks[t].points) for t in waiting}
            points = {t: s for t, s in points.items() if s is not None}
            waiting = []
            if points:
                s = np.stack(list(points.values()))
                kept, h, H = self.read(epoch, s, np.array(list(points), dtype=np.intp), slopes=self.slopes)
                for i, trial in enumerate(kept.tolist()):
                    z, slope = epoch.whitened(self.z[trial]), None if H is None else H[i]
                    update = self.tracks[trial].update
                    if self.attempt(trial, lambda u=update, z=z, h=h[i], H=slope: u(z, h, H)) is False:
                        waiting.append(trial)

    def state(self, at: Rows) -> tuple[Array, Array]:
        n = len(self.d)
        tracks = [self.tracks[trial] for trial in at.tolist()]
        self.nis[at] = [track.nis for track in tracks]
        x, P = np.array([track.x for track in tracks]), np.array([track.P for track in tracks])
        return x.reshape(-1, n), P.reshape(-1, n, n)


def squared_innovation(y: Array, S_inverse: Array) -> float:
    """y' S^-1 y, as a row or as a column as filterpy has it."""
    y = y.ravel()
    return float(y @ S_inverse @ y)


def turned(z: Array, h: Array) -> tuple[Array, Array]:
    """The readings z (m,) and h (points, m) less the points' mean, along the principal axes of the points' spread.

    White readings stay white when turned, and the filter is the same; but S is then close to diagonal, so its inverse
    and P - K S K' keep their digits where a wide prior makes S as ill-conditioned as 1e10.
    """
    centre = h.mean(axis=0)
    spread = h - centre
    refuse_overflow(spread)
    axes = np.linalg.svd(spread, full_matrices=len(h) < len(z))[2]
    return axes @ (z - centre), spread @ axes.T


def refuse_overflow(a: Array) -> None:
    """LAPACK need not come back from an infinite matrix, and a filter needs the squares of what it is given."""
    if not np.abs(a).max() < LARGEST:
        raise OverflowError("what the filter is to take in is beyond the range of numbers")


def in_turn(h: Array) -> Callable[[Any], Array]:
    """A stand-in for hx: the rows of h one after another, since filterpy asks for its points in their order."""
    rows = iter(h)
    return lambda _: next(rows)
