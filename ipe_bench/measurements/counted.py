"""Counts what a batch costs, by a model in which no trial spoils another."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.errors import describe_exception
from ipe_bench.basics.linalg import Array, Mask, finite, read_only

if TYPE_CHECKING:
    from ipe_bench.measurements.base import Measurement


def cost(simulations: Array, jacobians: Array, jacobian_cost: float) -> Array:
    """Computes the cost of trials (trials,), in simulations: a Jacobian counts as `jacobian_cost`
    of them."""
    return simulations + jacobian_cost * jacobians


@dataclass
class EvaluationCount:
    """Counts evaluations and failures of a batch, by trial; all views of one batch share it."""

    simulations: Array
    jacobians: Array
    reported: Array
    """Jacobians (trials,) that only a reported covariance needs."""
    singular: Mask
    messages: dict[int, str] = field(default_factory=dict)

    @classmethod
    def zeros(cls, trials: int) -> EvaluationCount:
        simulations, jacobians, reported = np.zeros((3, trials))
        return cls(simulations, jacobians, reported, np.zeros(trials, dtype=bool))

    def of_search(self, n: int) -> Array:
        """Computes the cost of a search (trials,), for its limits: simulations, a Jacobian counting
        n, without reported ones."""
        return cost(self.simulations, self.jacobians - self.reported, n)

    def copied(self, rows: NDArray[np.intp]) -> EvaluationCount:
        """Copies the counts of the trials `rows`, without failures."""
        counts = (self.simulations[rows], self.jacobians[rows], self.reported[rows])
        return EvaluationCount(*counts, np.zeros(len(rows), dtype=bool))

    def failed(self, rows: NDArray[np.intp]) -> Mask:
        """Tells which of the trials `rows` an exception has ended."""
        if not self.messages:
            return np.zeros(len(rows), dtype=bool)
        return np.isin(rows, list(self.messages))


@dataclass(frozen=True)
class CountingModel:
    """Counts the evaluations of a model per trial; a trial that raises spoils only itself."""

    measurement: Measurement
    tally: EvaluationCount
    share: float = 1.0
    """The cost of one evaluation: below 1 for a model restricted to the first epochs."""
    for_report: bool = False
    """Whether its Jacobians are evaluated for a reported covariance alone."""

    @classmethod
    def uncounted(cls, measurement: Measurement, trials: int) -> CountingModel:
        """Makes a model outside of any estimate: its tally is not read."""
        return cls(measurement, EvaluationCount.zeros(trials))

    def reporting(self) -> CountingModel:
        """Returns the same model for reports on an answer: counted, but no exception there ends a
        trial."""
        return replace(self, tally=replace(self.tally, messages={}), for_report=True)

    def simulate(self, x: Array, rows: NDArray[np.intp]) -> Array:
        """Computes h(x) (trials, m) for the trials `rows` of the tally."""
        self.tally.simulations[rows] += self.share
        return self._each_if_raising(self.measurement.simulate, x, rows, (self.measurement.m,))

    def residual(self, x: Array, rows: NDArray[np.intp], z: Array) -> Array:
        """Computes h(x) - z (trials, m) for readings z of the trials `rows`, angles within half a
        turn."""
        return self.measurement.near(self.simulate(x, rows), z) - z

    def jacobian(self, x: Array, rows: NDArray[np.intp], *, coarse: Mask | bool = False) -> Array:
        """Computes dh/dx (trials, m, n) for the trials `rows` of the tally; of the trials `coarse`
        by `coarse_jacobian`, counted as what it costs beside an exact one."""
        if self.coarse_share == 1.0 or not np.any(coarse):
            return self._jacobian(self.measurement.jacobian, 1.0, x, rows)
        exact: Mask = ~np.broadcast_to(coarse, len(x))
        J = np.empty((len(x), self.measurement.m, self.measurement.n))
        J[~exact] = self._jacobian(
            self.measurement.coarse_jacobian, self.coarse_share, x[~exact], rows[~exact]
        )
        # Far away the longer steps of a coarse one may overflow where those of the readings do not.
        exact[~exact] = ~finite(J[~exact])
        if exact.any():
            J[exact] = self._jacobian(self.measurement.jacobian, 1.0, x[exact], rows[exact])
        return J

    def _jacobian(
        self, method: Callable[[Array], Array], cost: float, x: Array, rows: NDArray[np.intp]
    ) -> Array:
        self.tally.jacobians[rows] += self.share * cost
        if self.for_report:
            self.tally.reported[rows] += self.share * cost
        return self._each_if_raising(method, x, rows, (self.measurement.m, self.measurement.n))

    @cached_property
    def coarse_share(self) -> float:
        """Cost of a coarse Jacobian over that of an exact one; 1 where the model has none that is
        cheaper."""
        coarse = self.measurement.coarse_jacobian_cost
        exact = self.measurement.jacobian_cost
        return coarse / exact if coarse < exact else 1.0

    def _each_if_raising(
        self,
        function: Callable[[Array], Array],
        x: Array,
        rows: NDArray[np.intp],
        shape: tuple[int, ...],
    ) -> Array:
        x = read_only(x)
        try:
            return function(x)
        except MemoryError:
            raise
        except Exception:
            result = np.full((len(x), *shape), np.nan)
            for i, row in enumerate(rows):
                try:
                    result[i] = function(x[i : i + 1])[0]
                except Exception as error:
                    self.tally.messages[int(row)] = describe_exception(error)
            return result
