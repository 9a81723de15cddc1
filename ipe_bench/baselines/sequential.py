"""Filters: the parameters as a random constant, the readings epoch by epoch, the linear algebra filterpy's own.

All trials of a batch advance together: what the model would read at every trial's points of an epoch is one batched
call, and each trial's filterpy object is then given its share of the answer. A filter says where it wants to be read
(`Track`); the loop over epochs, the counting and the failures are here.
"""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np

from ipe_bench.baselines.batched import Stack, run
from ipe_bench.baselines.epochs import Epoch, arrivals
from ipe_bench.basics.errors import UserError, describe_exception
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import NonNegative, Positive
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.base import Estimates, Estimator, Need
from ipe_bench.measurements.counted import EvaluationCount
from ipe_bench.measurements.problem import Problem

_LARGEST = 1e150


class Track(ABC):
    """One trial's filter. The state x is the parameters' distance from the nominal point in prior deviations, and the
    readings are whitened (R = I), so that P starts near the unit matrix whatever the parameters' units."""

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
        if self.engine == "batched" and type(self).stack is Sequential.stack:
            raise UserError("engine=batched: this filter has none; choose engine=filterpy")

    @abstractmethod
    def track(self, P0: Array, Q: Array, z: Array) -> Track:
        """The filter of one trial before its first reading, at x = 0 with covariance P0 (n, n) and process noise Q
        (n, n) per epoch. z (m,) are all readings of the trial: for a random stream that is the trial's own, and for
        nothing else."""

    def stack(self, P0: Array, Q: Array, z: Array) -> Stack:
        """The filters of all trials, as `track`, for readings z (trials, m). A filter that has none is filterpy's."""
        raise NotImplementedError

    def begin(self, problem: Problem) -> tuple[Array, Array]:
        """P0 and Q (n, n) in deviations of the prior."""
        return self.prior_inflation**2 * problem.scaled_prior, self.process_noise**2 * np.eye(problem.measurement.n)

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        for need in self.missing(problem):
            raise UserError(f"measurement={problem.measurement.name}: has no {need}, which a filter needs")
        if self.engine == "batched":
            stack = self.stack(*self.begin(problem), z)
            epochs = list(arrivals(problem))
            with np.errstate(all="ignore"):
                return run(stack, problem, z, epochs, slopes=self.slopes, history=history)
        from scipy.linalg import LinAlgWarning

        with np.errstate(all="ignore"), warnings.catch_warnings():
            # SciPy warns of an ill-conditioned S, which R's smallness beside a wide prior explains.
            warnings.simplefilter("ignore", LinAlgWarning)
            return _Run(self, problem, z).estimates(history=history)


class _Run:
    """One batch on its way through the epochs."""

    def __init__(self, filter: Sequential, problem: Problem, z: Array) -> None:
        self.filter, self.problem, self.z = filter, problem, z
        trials, n = len(z), problem.measurement.n
        self.d = np.asarray(problem.prior_deviation, dtype=float)
        self.tally = EvaluationCount.zeros(trials)
        self.epochs = list(arrivals(problem))
        self.status = np.full(trials, Status.RUNNING, dtype=np.int8)
        self.messages: dict[int, str] = {}
        self.iterates = [[np.zeros(n)] for _ in range(trials)]
        self.tracks: dict[int, Track] = {}
        for i in range(trials):
            if np.isfinite(z[i]).all():
                self.attempt(i, self.begin)
            else:
                # filterpy would go on with x = NaN and no error.
                row = int(np.flatnonzero(~np.isfinite(z[i]))[0])
                self.end(i, Status.NONFINITE, f"reading {row + 1} is not a finite number")

    @property
    def going(self) -> list[int]:
        return [int(i) for i in np.flatnonzero(self.status == Status.RUNNING)]

    def begin(self, trial: int) -> None:
        self.tracks[trial] = self.filter.track(*self.filter.begin(self.problem), self.z[trial])

    def end(self, trial: int, status: Status, message: str | None = None) -> None:
        self.status[trial] = status
        if message:
            self.messages[trial] = message

    def attempt(self, trial: int, action: Callable[[int], Any]) -> Any:
        """`action(trial)`; an exception ends this trial and no other, and the result is None."""
        try:
            return action(trial)
        except np.linalg.LinAlgError as error:
            self.end(trial, Status.SINGULAR, describe_exception(error))
        except OverflowError as error:
            self.end(trial, Status.NONFINITE, describe_exception(error))
        except Exception as error:
            self.end(trial, Status.ERROR, describe_exception(error))
        return None

    def estimates(self, *, history: bool) -> Estimates:
        for epoch in self.epochs:
            for trial in self.going:
                self.attempt(trial, lambda t: self.tracks[t].predict())
            waiting = self.going
            while waiting:
                waiting = self.advance(epoch, waiting)
            for trial in self.going:
                track = self.tracks[trial]
                self.iterates[trial].append(track.x.copy())
                if not (np.isfinite(track.x).all() and np.isfinite(track.P).all()):
                    self.end(trial, Status.NONFINITE, f"the filter's state overflowed at epoch {epoch.number}")
        for trial in self.going:
            self.end(trial, Status.CONVERGED)
        return self.collect(history=history)

    def advance(self, epoch: Epoch, waiting: list[int]) -> list[int]:
        """Reads the model at the points of the waiting trials and hands each its share; returns who waits still."""
        wanted = {t: self.attempt(t, lambda t: self.tracks[t].points()) for t in waiting}
        wanted = {t: points for t, points in wanted.items() if points is not None}
        if not wanted:
            return []
        trials = np.array(list(wanted), dtype=np.intp)
        s = np.stack(list(wanted.values()))
        x = self.problem.x0 + s * self.d
        h, H = epoch.read(x, trials, self.tally, slopes=self.filter.slopes)
        if H is not None:
            H = H * self.d
        again = []
        for i, trial in enumerate(trials.tolist()):
            if trial in self.tally.messages:
                self.end(trial, Status.ERROR, self.tally.messages[trial])
            elif not (np.isfinite(h[i]).all() and (H is None or np.isfinite(H[i]).all())):
                self.end(trial, Status.NONFINITE, f"the model overflowed at epoch {epoch.number}")
            else:
                z = epoch.whitened(self.z[trial])
                slope = None if H is None else H[i]
                done = self.attempt(trial, lambda t, z=z, i=i, H=slope: self.tracks[t].update(z, h[i], H))
                if done is False:
                    again.append(trial)
        return again

    def collect(self, *, history: bool) -> Estimates:
        trials, n = len(self.z), self.problem.measurement.n
        finished = self.status == Status.CONVERGED
        covariance = np.full((trials, n, n), np.nan)
        nis = np.full(trials, np.nan)
        for trial in np.flatnonzero(finished):
            track = self.tracks[int(trial)]
            P = track.P * self.d * self.d[:, None]
            covariance[trial] = (P + P.T) / 2
            nis[trial] = track.nis / self.z.shape[1]
        iterates = [self.problem.x0 + np.array(rows) * self.d for rows in self.iterates]
        return Estimates(
            x=np.array([rows[-1] for rows in iterates]).reshape(trials, n),
            status=self.status,
            covariance=covariance,
            iterations=np.array([len(rows) - 1 for rows in iterates], dtype=np.int64),
            simulations=self.tally.simulations,
            jacobians=self.tally.jacobians,
            messages=self.messages,
            history=iterates if history else None,
            extras={"nis": nis},
        )


def squared_innovation(y: Array, S_inverse: Array) -> float:
    """y' S^-1 y, as a row or as a column as filterpy has it: chi-square with m degrees where the filter is consistent
    (Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 5.4)."""
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
    if not np.abs(a).max() < _LARGEST:
        raise OverflowError("what the filter is to take in is beyond the range of numbers")


def symmetric(P: Array) -> Array:
    """(P + P') / 2: what rounding took from P - K S K'."""
    return (P + P.T) / 2


def in_turn(h: Array) -> Callable[[Any], Array]:
    """A stand-in for hx: the rows of h one after another, since filterpy asks for its points in their order."""
    rows = iter(h)
    return lambda _: next(rows)
