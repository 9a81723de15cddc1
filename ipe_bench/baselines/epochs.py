"""The readings as a filter meets them: epoch by epoch, each a model of its own that computes nothing later."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipe_bench.baselines.ensemble import read_members
from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array, Covariance
from ipe_bench.measurements.base import Measurement, SubsetModel
from ipe_bench.measurements.counted import CountingModel, EvaluationCount
from ipe_bench.measurements.problem import Problem


@dataclass(frozen=True)
class Epoch:
    """The readings that arrive together, as a model of their own that computes nothing later."""

    number: int
    model: Measurement
    rows: NDArray[np.intp]
    R: Covariance
    share: float
    """The cost of this model's readings over that of all."""

    def counted(self, tally: EvaluationCount) -> CountingModel:
        """The model, with the cost of a prefix."""
        return CountingModel(self.model, tally, self.share)

    def whitened(self, z: Array) -> Array:
        return self.R.whiten(z[..., self.rows])

    def read(
        self, x: Array, trials: NDArray[np.intp], tally: EvaluationCount, *, slopes: bool
    ) -> tuple[Array, Array | None]:
        """Whitened h (trials, points, m) at x (trials, points, n), and dh/dx (trials, m, n) where it is asked for."""
        h = read_members(self.counted(tally), self.R, x, trials)
        if not slopes:
            return h, None
        H = self.R.whiten_jacobian(self.counted(tally).jacobian(x[:, 0], trials))
        return h, np.ascontiguousarray(H)


def arrivals(problem: Problem) -> Iterator[Epoch]:
    """The epochs in order of arrival."""
    model = problem.measurement
    assert model.epochs is not None
    # A model some of whose readings are missing is measured through the whole one, which can stop early.
    whole, kept = (model.whole, np.array(model.kept)) if isinstance(model, SubsetModel) else (model, np.arange(model.m))
    stop, arrived = 0, np.empty(0, dtype=np.intp)
    assert whole.epochs is not None
    for number, rows in enumerate(model.epochs, start=1):
        rows = np.sort(rows)
        while not np.isin(kept[rows], arrived).all():
            stop += 1
            arrived = whole.rows(stop)
        _refuse_correlation(problem.R, rows)
        part = SubsetModel(whole, tuple(kept[rows].tolist()), stop)
        yield Epoch(number, part, rows, problem.R.restricted(rows), stop / len(whole.epochs))


def _refuse_correlation(R: Covariance, rows: NDArray[np.intp]) -> None:
    if R.factor.ndim == 1:
        return
    across = R.matrix()[rows]
    across[:, rows] = 0.0
    if across.any():
        raise UserError(
            "noise: its errors are correlated between epochs, which a filter cannot use; choose a batch estimator"
        )
