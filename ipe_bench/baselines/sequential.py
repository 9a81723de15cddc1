"""Filters epoch by epoch, the parameters as a random constant: by a library's own filter for each
trial, or by a linearisation rule for all trials at once."""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, Literal

import numpy as np

from ipe_bench.baselines.epochs import Epoch, Rows, Walk
from ipe_bench.basics.errors import UserError, describe_exception
from ipe_bench.basics.linalg import Array, deviations, finite, gram, multiply
from ipe_bench.basics.options import NonNegative, Positive
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.base import Estimates, Estimator, Need
from ipe_bench.measurements.problem import Problem
from ipe_bench.states.algebra import factor, lower_solve, symmetric, transposed, upper_solve
from ipe_bench.states.linearisation import Affine, Rule

LARGEST = 1e150
"""The largest number that a filter takes in, so that its square exists."""


class ConstantFilter(ABC):
    """Filters one trial. The state x is the parameters' distance from the start in prior
    deviations, and the readings are whitened (R = I).

    Required: `x`, `P`, `predict`, `points` and `update`. Optional: `nis`, to which `update` adds.
    Promised: random numbers come from a stream that is seeded by the readings; an exception ends
    this trial alone.
    """

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
        """Brings the state from one epoch to the next: the parameters stay, the process noise comes
        on top."""

    @abstractmethod
    def points(self) -> Array:
        """Returns the states (points, n) at which this epoch's readings are wanted."""

    @abstractmethod
    def update(self, z: Array, h: Array, H: Array | None) -> bool:
        """Takes in the readings z (m,), given h (points, m) and, for filters with slopes, dh/dx (m,
        n) at the points.

        Returns False where the filter wants to be read again at new points before it is done with
        this epoch.
        """


@dataclass(frozen=True)
class Sequential(Estimator):
    """Filters readings epoch by epoch, the parameters as a random constant: a frozen dataclass of
    its options.

    Required: `rule`, with `engine` "batched", or `track`, which returns a `ConstantFilter`.
    Optional: `slopes`; `relinearisations`. Promised: what an `Estimator` promises. Reported are the
    filter's P, and as `extras["nis"]` the squared innovations over their number: 1 on average if
    the filter is consistent (`intervals.mean_limits`).

    >>> import ipe_bench as ib
    >>> from ipe_bench.states import Taylor
    >>> @dataclass(frozen=True)
    ... class Extended(ib.Sequential):
    ...     engine: Literal["batched"] = "batched"
    ...     def rule(self):
    ...         return Taylor()
    >>> scenario = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01))
    >>> z = scenario.draw(0, 3).z
    >>> filters = Extended(), ib.baselines.EKF()
    >>> x = [one.estimate(scenario.problem, z).x for one in filters]
    >>> print(np.ptp(x, axis=0).max() < 1e-9)
    True
    """

    prior_inflation: Positive = 1.0
    """The filter's prior deviations over the scenario's: in life a prior is never exact."""
    process_noise: NonNegative = 0.0
    """Standard deviation of the parameters' random walk from one epoch to the next, in prior
    deviations (before inflation). The parameters are constants, so anything above 0 makes the
    filter forget."""
    engine: Literal["filterpy", "batched"] = "filterpy"
    """Implementation of the filter's equations: filterpy, trial by trial, or this package, for all
    trials at once."""

    needs: ClassVar[frozenset[Need]] = frozenset({"epochs", "prior"})
    slopes: ClassVar[bool] = False
    """True where `ConstantFilter.update` wants dh/dx; then there is one point per trial."""

    def __post_init__(self) -> None:
        super().__post_init__()
        method = "rule" if self.engine == "batched" else "track"
        if getattr(type(self), method) is getattr(Sequential, method):
            raise UserError(
                f"engine={self.engine}: this filter has no {method}; choose the other engine"
            )

    def track(self, P0: Array, Q: Array, z: Array) -> ConstantFilter:
        """Makes the filter of one trial before its first reading, at x = 0 with covariance P0 (n,
        n) and process noise Q (n, n) per epoch. z (m,) are all readings of the trial, for the seed
        of a random stream."""
        raise NotImplementedError

    def rule(self) -> Rule:
        """Returns how readings are linearised if all trials are computed at once."""
        raise NotImplementedError

    @property
    def relinearisations(self) -> tuple[int, float]:
        """Returns the most linearisations of an epoch's readings, and the change of a parameter, in
        deviations of the updated P, that ends them."""
        return 1, 0.0

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        self.require_suited(problem)
        with np.errstate(all="ignore"), warnings.catch_warnings():
            from scipy.linalg import LinAlgWarning

            # SciPy warns of an ill-conditioned S, which R's smallness beside a wide prior explains.
            warnings.simplefilter("ignore", LinAlgWarning)
            engine = _OneByOne if self.engine == "filterpy" else _Stack
            return engine(self, problem, z).estimates(history=history)


class _Filters(Walk):
    """Holds the filters of a batch, at x = 0 with covariance P0 (n, n) and process noise Q (n, n)
    per epoch."""

    def __init__(self, filter: Sequential, problem: Problem, z: Array) -> None:
        super().__init__(problem, z)
        self.filter = filter
        self.P[:] = filter.prior_inflation**2 * problem.scaled_prior
        self.Q = filter.process_noise**2 * np.eye(problem.measurement.n)


class _OneByOne(_Filters):
    """Runs a `ConstantFilter` for each trial; an exception ends the trial that raises it and no
    other."""

    def __init__(self, filter: Sequential, problem: Problem, z: Array) -> None:
        super().__init__(filter, problem, z)
        self.tracks: dict[int, ConstantFilter] = {}
        for t in self.going.tolist():
            P0 = self.P[t].copy()
            Q = self.Q.copy()
            self.tracks[t] = self.attempt(t, partial(filter.track, P0, Q, z[t]))

    def attempt(self, trial: int, action: Callable[[], Any]) -> Any:
        """Returns `action()`, or None if it raises."""
        try:
            return action()
        except (MemoryError, UserError):
            raise
        except Exception as error:
            known = {np.linalg.LinAlgError: Status.SINGULAR, OverflowError: Status.NONFINITE}
            self.end([trial], known.get(type(error), Status.ERROR), describe_exception(error))

    def take_in(self, epoch: Epoch, at: Rows) -> None:
        for trial in at.tolist():
            self.attempt(trial, self.tracks[trial].predict)
        # A filter that linearises again wants to be read at new points.
        waiting = self.going.tolist()
        while waiting:
            waiting = self._updated(epoch, waiting)
        for trial in self.going.tolist():
            track = self.tracks[trial]
            self.x[trial] = track.x
            self.P[trial] = track.P
            self.nis[trial] = track.nis

    def _updated(self, epoch: Epoch, trials: Sequence[int]) -> list[int]:
        """Reads trials at the points that their filters want, and returns those that want more."""
        tried = {t: self.attempt(t, self.tracks[t].points) for t in trials}
        points = {t: s for t, s in tried.items() if s is not None}
        if not points:
            return []
        s = np.stack(list(points.values()))
        at = np.array(list(points), dtype=np.intp)
        kept, h, H = self.read(epoch, s, at, slopes=self.filter.slopes)
        waiting = []
        for i, trial in enumerate(kept.tolist()):
            z = epoch.whitened(self.z[trial])
            slope = None if H is None else H[i]
            done = self.attempt(trial, partial(self.tracks[trial].update, z, h[i], slope))
            if done is False:
                waiting.append(trial)
        return waiting


class _Stack(_Filters):
    """Filters all trials at once; a trial's bits do not depend on which others there are."""

    def take_in(self, epoch: Epoch, at: Rows) -> None:
        rule = self.filter.rule()
        iterations, tolerance = self.filter.relinearisations
        self.P[at] += self.Q
        x = self.x.copy()
        P = self.P.copy()
        for iteration in range(iterations):
            before = self.x[at]
            # Each linearisation updates the prediction anew, about the last estimate.
            readings = _TurnedReadings(self, epoch, at, P[at])
            read = rule.linearise(readings, before, self.P[at])
            self.x[at], self.P[at], nis = _updated(x[at], P[at], read, readings.z)
            if iteration == 0:
                # The innovation of the prediction; later ones have seen z.
                self.nis[at] += nis
            lost = ~finite(self.x[at])
            singular = lost & (self.status[at] == Status.RUNNING)
            self.end(at[singular], Status.SINGULAR, f"S is singular at epoch {epoch.number}")
            change = (np.abs(self.x[at] - before) / deviations(self.P[at])).max(axis=1)
            at = at[~(lost | (change <= tolerance))]
            if not len(at):
                return


def _updated(x: Array, P: Array, read: Affine, z: Array) -> tuple[Array, Array, Array]:
    """Takes in white readings z = H x + b + e + v (trials, m), e ~ N(0, W) of the rule, and returns
    mean, covariance and NIS:

        y = z - H x - b,   S = H P H' + W + I,   K = P H' S^-1
        x <- x + K y
        P <- (I - K H) P (I - K H)' + K (W + I) K'

    This form of P, Joseph's, stays positive definite.
    """
    H = read.A
    y = z - multiply(H, x) - read.b
    noise = read.W + np.eye(y.shape[1])
    PH = np.matmul(P, transposed(H))
    # S = L L', K' = L^-T L^-1 (P H')'
    L = factor(np.matmul(H, PH) + noise)
    K = transposed(upper_solve(L, lower_solve(L, transposed(PH))))
    rest = np.eye(x.shape[1]) - np.matmul(K, H)
    unread = np.matmul(np.matmul(rest, P), transposed(rest))
    added = np.matmul(np.matmul(K, noise), transposed(K))
    e = lower_solve(L, y[..., None])[..., 0]
    return x + multiply(K, y), symmetric(unread + added), np.sum(e**2, axis=1)


class _TurnedReadings:
    """Turns an epoch's whitened readings, functions of the states of the trials `at`, to axes that
    make S nearly diagonal: white readings stay white, and S keeps its digits where a wide prior
    makes it as ill-conditioned as 1e10.

    Trials that the model ends are NaN.
    """

    def __init__(self, walk: Walk, epoch: Epoch, at: Rows, P: Array) -> None:
        self.walk = walk
        self.epoch = epoch
        self.at = at
        self.P = P
        self.z = epoch.whitened(walk.z[at])

    def __call__(self, x: Array) -> Array:
        """Returns h (trials, points, m) less its mean over the points, and z alike."""
        h, _ = self._read(x, slopes=False)
        centre = h.mean(axis=1, keepdims=True)
        spread = h - centre
        axes = _principal_axes(gram(spread))
        self.z = multiply(axes.swapaxes(1, 2), self.z - centre[:, 0])
        return np.matmul(spread, axes)

    def slope(self, x: Array) -> tuple[Array, Array]:
        """Returns h (trials, m) and dh/dx (trials, m, n)."""
        h, H = self._read(x[:, None], slopes=True)
        # S is H P H' + I: axes of the first are those of the sum.
        spread = np.matmul(np.matmul(H, self.P), H.swapaxes(1, 2))
        axes = _principal_axes(spread).swapaxes(1, 2)
        self.z = multiply(axes, self.z)
        return multiply(axes, h[:, 0]), np.matmul(axes, H)

    def _read(self, x: Array, *, slopes: bool) -> tuple[Array, Array]:
        """Returns h (trials, points, m) as it is and, for one point, dh/dx (trials, m, n)."""
        known = finite(x)
        indefinite = f"the filter's P is not positive definite at epoch {self.epoch.number}"
        self.walk.end(self.at[~known], Status.SINGULAR, indefinite)
        kept, h, H = self.walk.read(self.epoch, x[known], self.at[known], slopes=slopes)
        beyond = ~(np.abs(h if H is None else H).max(axis=(1, 2), initial=0) < LARGEST)
        too_large = "what the filter is to take in is beyond the range of numbers"
        self.walk.end(kept[beyond], Status.NONFINITE, too_large)
        rows = np.isin(self.at, kept[~beyond])
        trials, points, n = x.shape
        m = self.z.shape[1]
        values = np.full((trials, points, m), np.nan)
        values[rows] = h[~beyond]
        tangents = np.full((trials, m, n), np.nan)
        if H is not None:
            tangents[rows] = H[~beyond]
        return values, tangents


def _principal_axes(G: Array) -> Array:
    """Computes orthonormal axes (trials, m, m), one per column, in which each symmetric G (trials,
    m, m) is diagonal."""
    return np.linalg.eigh(np.nan_to_num(G))[1]
