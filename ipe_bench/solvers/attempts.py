"""Attempts at least squares from far away, which differ in where they begin.

`progressive` makes one attempt after another at the trials whose fit fails its test, and keeps the
best. This is what all attempts share: what they minimise, and whom they charge for it. `Starts` are
attempts on all data, `Windows` those that follow growing stretches of it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.linalg import Array, repeated
from ipe_bench.estimators.driver import Limits
from ipe_bench.estimators.least_squares import Objective
from ipe_bench.estimators.levenberg_marquardt import LevenbergMarquardtMethod
from ipe_bench.estimators.minima import Minima, minimize
from ipe_bench.measurements.base import Measurement
from ipe_bench.measurements.counted import CountingModel, EvaluationCount
from ipe_bench.measurements.problem import Problem

Rows = NDArray[np.intp]

# Halved or doubled, it leaves 155 of 160 trials solved: `tests/benchmarks/constants.py`.
LONG = 600
"""Iterations of an attempt from the start, and of one from elsewhere that promises something."""


@dataclass(frozen=True)
class Attempts(ABC):
    """Makes the attempts at one batch z (trials, m), which share its tally."""

    problem: Problem
    prior: Array | None
    """The deviations (n,) of the prior that counts; None: there is none. Its correlations do not
    count: a search ends in a fit without the prior."""
    z: Array
    tally: EvaluationCount
    limits: Limits
    """The limits of a minimisation on all data."""
    growth: float
    window_tolerance: float
    restarts: int | None
    """See the options of `Progressive` of the same names."""

    planned: ClassVar[int]
    """The number of attempts."""
    repeats: ClassVar[int] = 1
    """The number of attempts that must lead to a minimum again for it to be believed, one at least
    from independent draws."""
    most: ClassVar[float] = np.inf
    """The most that a search which has tried draws may cost, in costs of a simulation and a
    Jacobian."""

    @property
    def last(self) -> int:
        """The number of the last attempt; the first is 0."""
        return self.planned - 1 if self.restarts is None else min(self.restarts, self.planned - 1)

    @abstractmethod
    def attempt(self, k: int, rows: Rows, before: Minima | None) -> Minima:
        """Makes the k-th attempt for the trials `rows`; `before` is the best of those so far."""

    @abstractmethod
    def draws(self, k: int) -> int:
        """Returns the number of independent draws that the k-th attempt begins from; 0 if it begins
        at the start or where the readings point."""

    def plain(self, k: int, rows: Rows) -> Minima:
        """Runs Levenberg-Marquardt on all data from the start: in the metric of the parameters'
        sizes if k is 0, and in Marquardt's if it is 1."""
        method = (LevenbergMarquardtMethod(1.0, sizes=1.0), LevenbergMarquardtMethod(1e-3))[k]
        x = repeated(self.problem.x0, len(rows))
        return self.minimize(rows, method, x, max(LONG, self.limits.max_iterations))

    def minimize(
        self,
        owner: Rows,
        method: LevenbergMarquardtMethod,
        x: Array,
        steps: int,
        objective: Objective | None = None,
        tolerance: float | None = None,
    ) -> Minima:
        """Minimises from x (candidates, n), on all data unless another objective is given, charged
        to the trials `owner` (candidates,)."""
        objective = self.whole(owner) if objective is None else objective
        limits = replace(self.limits, max_iterations=steps)
        if tolerance is not None:
            limits = replace(limits, tolerance=tolerance)
        minima = minimize(objective, method, x, limits)
        self.charge(owner, objective.model.tally)
        return minima

    def whole(self, owner: Rows) -> Objective:
        """Makes the objective on all data for candidates of the trials `owner`."""
        model = self.counted(self.problem.measurement, owner)
        candidates = np.arange(len(owner))
        return Objective(model, self.problem.R, self.z[owner], candidates, self.problem.x0)

    def counted(self, measurement: Measurement, owner: Rows, share: float = 1.0) -> CountingModel:
        """Makes a model for candidates of the trials `owner`, whose tally begins at what each trial
        has cost so far."""
        return CountingModel(measurement, self.tally.copied(owner), share)

    def charge(self, owner: Rows, tally: EvaluationCount) -> None:
        """Adds to each trial what its candidates have cost since they were `counted`; no other
        charge of these trials may lie in between, as what they cost by now is taken off."""
        for name in ("simulations", "jacobians", "reported"):
            total = getattr(self.tally, name)
            spent = getattr(tally, name) - total[owner]
            assert (spent >= 0).all()
            np.add.at(total, owner, spent)
        for candidate, message in tally.messages.items():
            self.tally.messages.setdefault(int(owner[candidate]), message)
