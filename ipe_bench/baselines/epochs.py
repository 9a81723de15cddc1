"""Presents the readings to filters epoch by epoch, and keeps the state of a batch on its way
through them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.batches import put
from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array, Covariance, finite
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.base import Estimates
from ipe_bench.measurements.base import Measurement, SubsetModel
from ipe_bench.measurements.counted import CountingModel, EvaluationCount
from ipe_bench.measurements.problem import Problem
from ipe_bench.states.algebra import symmetric

Rows = NDArray[np.intp]

POINTS_AT_ONCE = 8192
"""Points of one call of the model: bounds the memory that a large ensemble takes."""


def read_members(model: CountingModel, R: Covariance, x: Array, rows: Rows, z: Array) -> Array:
    """Reads whitened h (trials, members, m) at x (trials, members, n), for the trials `rows` of the
    model's tally, with readings z (trials, m); angles of a trial are next to one another, and their
    mean is next to that of z."""
    trials, members, n = x.shape
    counted = CountingModel(model.measurement, model.tally, model.share * members)
    pieces = min(trials, -(-trials * members // POINTS_AT_ONCE))
    found = []
    for piece in np.array_split(np.arange(trials), pieces):
        h = counted.simulate(x[piece].reshape(-1, n), np.repeat(rows[piece], members))
        if len(model.measurement.periods):
            h = h.reshape(len(piece), members, -1)
            h = _together(model.measurement, h, z[piece, None])
            h = h.reshape(len(piece) * members, -1)
        found.append(R.whiten(h))
    # In C order, for any order of the model's: BLAS rounds otherwise where the strides are other.
    return np.ascontiguousarray(np.concatenate(found)).reshape(trials, members, -1)


def _together(model: Measurement, h: Array, z: Array) -> Array:
    """Shifts angles h (trials, members, m) by whole turns: next to one another, and their mean next
    to z."""
    first = np.where(np.isfinite(h[:, :1]), h[:, :1], z)
    h = model.near(h, first)
    centre = np.where(np.isfinite(h), h, first).mean(axis=1, keepdims=True)
    return h - (centre - model.near(centre, z))


@dataclass(frozen=True)
class Epoch:
    """Restricts a model to the readings that arrive together; later ones are not computed."""

    number: int
    model: Measurement
    rows: Rows
    R: Covariance
    share: float
    """The cost of this model's readings over that of all."""

    def counted(self, tally: EvaluationCount) -> CountingModel:
        """Returns the counting model, with the cost of a prefix."""
        return CountingModel(self.model, tally, self.share)

    def whitened(self, z: Array) -> Array:
        """Returns the epoch's part of all readings z (..., m), whitened."""
        return self.R.whiten(z[..., self.rows])


def arrivals(problem: Problem) -> Iterator[Epoch]:
    """Yields the epochs in order of arrival."""
    model = problem.measurement
    assert model.epochs is not None
    whole = model
    kept = np.arange(model.m)
    if isinstance(model, SubsetModel):
        # A model some of whose readings are missing is measured through the whole one, which can
        # stop early.
        whole = model.whole
        kept = np.array(model.kept)
    assert whole.epochs is not None
    stop = 0
    arrived = np.empty(0, dtype=np.intp)
    for number, rows in enumerate(model.epochs, start=1):
        rows = np.sort(rows)
        while not np.isin(kept[rows], arrived).all():
            stop += 1
            arrived = whole.rows(stop)
        _require_uncorrelated(problem.R, rows)
        part = SubsetModel(whole, tuple(kept[rows].tolist()), stop)
        yield Epoch(number, part, rows, problem.R.restricted(rows), stop / len(whole.epochs))


def _require_uncorrelated(R: Covariance, rows: Rows) -> None:
    """Refuses noise of an epoch's rows that is correlated with that of other epochs."""
    if R.factor.ndim != 2:
        return
    across = R.matrix()[rows]
    across[:, rows] = 0.0
    if across.any():
        raise UserError(
            "noise: its errors are correlated between epochs, which a filter cannot use; choose a"
            " batch estimator"
        )


class Walk(ABC):
    """Leads a batch of filters through the epochs: a subclass says how they take one in.

    States are distances from the start in prior deviations, and readings are whitened (R =
    I), so that P starts near the unit matrix for any units of the parameters.
    """

    def __init__(self, problem: Problem, z: Array) -> None:
        self.problem = problem
        self.z = z
        self.d = np.array(problem.prior_deviation, dtype=float)
        trials = len(z)
        n = len(self.d)
        self.tally = EvaluationCount.zeros(trials)
        self.epochs = list(arrivals(problem))
        self.x = np.zeros((trials, n))
        """The means after the last epoch."""
        self.P = np.empty((trials, n, n))
        """Their covariances."""
        self.status = np.full(trials, Status.RUNNING, dtype=np.int8)
        self.messages: dict[int, str] = {}
        self.nis = np.zeros(trials)
        """The squared innovations y' S^-1 y, summed over the epochs so far: chi-square where the
        filter is consistent (Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking
        and Navigation, 5.4)."""
        for trial in np.flatnonzero(~finite(z)).tolist():
            first = int(np.argmin(np.isfinite(z[trial])))
            self.end([trial], Status.NONFINITE, f"reading {first + 1} is not a finite number")

    @abstractmethod
    def take_in(self, epoch: Epoch, at: Rows) -> None:
        """Takes in the readings of an epoch for the trials `at`: sets their `x`, `P`, `nis`, or
        ends them."""

    def covariance(self, at: Rows) -> Array:
        """Returns P (trials, n, n) of the trials `at`, in multiples of the parameters' units."""
        return symmetric(self.P[at] * self.d * self.d[:, None])

    @property
    def going(self) -> Rows:
        """The trials that no failure has ended."""
        return np.flatnonzero(self.status == Status.RUNNING)

    def end(self, trials: Iterable[int], status: Status, message: str) -> None:
        """Ends some trials, with what went wrong."""
        for trial in trials:
            self.status[trial] = status
            self.messages[int(trial)] = message

    def read(
        self, epoch: Epoch, s: Array, at: Rows, *, slopes: bool
    ) -> tuple[Rows, Array, Array | None]:
        """Reads whitened h (trials, points, m) at the states s (trials, points, n) of the trials
        `at`, and dh/dx (trials, m, n), for those that the model does not end."""
        model = epoch.counted(self.tally)
        x = self.problem.x0 + s * self.d
        h = read_members(model, epoch.R, x, at, self.z[at][:, epoch.rows])
        kept = finite(h)
        H = None
        if slopes:
            J = epoch.R.whiten_jacobian(model.jacobian(x[:, 0], at))
            # Slopes by x in prior deviations.
            H = np.ascontiguousarray(J) * self.d
            kept &= finite(H)
        raised = self.tally.failed(at)
        self.status[at[raised]] = Status.ERROR
        overflowed = at[~kept & ~raised]
        self.end(overflowed, Status.NONFINITE, f"the model overflowed at epoch {epoch.number}")
        kept &= ~raised
        return at[kept], h[kept], None if H is None else H[kept]

    def estimates(self, *, history: bool) -> Estimates:
        """Returns the estimates after all epochs, with the squared innovations over their number as
        extra `nis`."""
        x = np.zeros((len(self.z), len(self.d)))
        taken = np.zeros(len(x), dtype=np.int64)
        path = [x]
        for epoch in self.epochs:
            if len(self.going):
                self.take_in(epoch, self.going)
            at = self.going
            x = put(x, at, self.x[at])
            taken[at] += 1
            path.append(x)
            lost = at[~(finite(self.x[at]) & finite(self.P[at]))]
            overflowed = f"the filter's state overflowed at epoch {epoch.number}"
            self.end(lost, Status.NONFINITE, overflowed)
        self.status[self.going] = Status.CONVERGED
        finished = np.flatnonzero(self.status == Status.CONVERGED)
        P = np.full((*x.shape, len(self.d)), np.nan)
        P[finished] = self.covariance(finished)
        nis = np.full(len(x), np.nan)
        nis[finished] = self.nis[finished] / self.z.shape[1]
        physical = self.problem.x0 + np.stack(path, axis=1) * self.d
        # A trial's iterates end with the last epoch that it took in.
        iterates = [rows[: count + 1] for rows, count in zip(physical, taken, strict=True)]
        return Estimates(
            x=self.problem.x0 + x * self.d,
            status=self.status,
            covariance=P,
            iterations=taken,
            simulations=self.tally.simulations,
            jacobians=self.tally.jacobians,
            messages=self.messages | self.tally.messages,
            history=iterates if history else None,
            extras={"nis": nis},
        )
