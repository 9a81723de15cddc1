"""What the attempts at one batch share: the options, the readings, and the account of what they cost."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.linalg import Array
from ipe_bench.estimators.least_squares import Minima, Objective, minimize
from ipe_bench.estimators.levenberg_marquardt import LevenbergMarquardtMethod
from ipe_bench.measurements.counted import Counted, Tally
from ipe_bench.measurements.problem import Problem

if TYPE_CHECKING:
    from ipe_bench.solvers.progressive import Progressive


@dataclass(frozen=True)
class Search(ABC):
    """The attempts at one batch z (trials, m), which share its tally."""

    attempts: ClassVar[int]
    """How many there are unless the options say otherwise."""
    enough: ClassVar[int]
    """So many attempts that lead to the best minimum again end the search."""

    options: Progressive
    problem: Problem
    z: Array
    tally: Tally
    history: bool

    @property
    def last(self) -> int:
        """The number of the last attempt; the first is 0."""
        return self.attempts - 1 if self.options.restarts is None else self.options.restarts

    @property
    def prior(self) -> Array | None:
        """The deviations (n,) of the prior that counts; None where none does. A search does without its correlations:
        it ends in a fit without the prior."""
        return self.problem.prior_used(self.options.prior_inflation) if self.options.use_prior else None

    @abstractmethod
    def attempt(self, k: int, rows: NDArray[np.intp], before: Minima | None) -> Minima:
        """The k-th attempt for the trials `rows`; `before` is the best of those so far."""

    def whole(self, owner: NDArray[np.intp]) -> Objective:
        """The objective on all data for candidates of the trials `owner`."""
        model = Counted(self.problem.measurement, self.spent(owner))
        return Objective(model, self.problem.R, self.z[owner], np.arange(len(owner)), self.problem.x0)

    def spent(self, owner: NDArray[np.intp]) -> Tally:
        """A tally for candidates of the trials `owner`, which begins at what each trial has cost so far."""
        return Tally(self.tally.simulations[owner], self.tally.jacobians[owner], np.zeros(len(owner), dtype=bool))

    def charge(self, owner: NDArray[np.intp], tally: Tally) -> None:
        """Adds to each trial what its candidates have cost since `spent`."""
        for total, now in ((self.tally.simulations, tally.simulations), (self.tally.jacobians, tally.jacobians)):
            np.add.at(total, owner, now - total[owner])
        for candidate, message in tally.messages.items():
            self.tally.messages.setdefault(int(owner[candidate]), message)

    def minimize(
        self,
        objective: Objective,
        owner: NDArray[np.intp],
        method: LevenbergMarquardtMethod,
        x: Array,
        *,
        tolerance: float,
        limit: int,
    ) -> Minima:
        """One minimisation from x (candidates, n), charged to the trials `owner`."""
        minima = minimize(
            objective,
            method,
            x,
            tolerance=tolerance,
            max_iterations=limit,
            budget=self.options.budget,
            history=self.history,
        )
        self.charge(owner, objective.model.tally)
        return minima
