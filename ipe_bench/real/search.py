"""Takes the lower minimum that the examination of an estimate finds as a further estimate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from ipe_bench.basics.linalg import Array, repeated
from ipe_bench.estimators.base import Equation, Estimates, Estimator
from ipe_bench.estimators.driver import Limits
from ipe_bench.estimators.least_squares import Objective
from ipe_bench.estimators.levenberg_marquardt import LevenbergMarquardtMethod
from ipe_bench.estimators.minima import minimize
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise.base import Noise
from ipe_bench.real.examination import Examination, examine
from ipe_bench.real.fits import Fit, compared, fit

LABEL = "search"
_MOST = 3
"""Lower minima that are taken one after another at most."""


@dataclass(frozen=True)
class From(Estimator):
    """Minimises least squares from a point by Levenberg-Marquardt steps."""

    point: Mapping[str, float]
    """Parameters in the coordinates of the model, by their names there."""

    equation: ClassVar[Equation | None] = "least_squares"

    def __post_init__(self) -> None:
        """Skips the checks of options: the point was found."""

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        names = [p.name for p in problem.measurement.parameters]
        start = np.array([self.point[name] for name in names])
        objective = Objective.of(problem, z)
        limits = Limits(1e-6, 100, None, history)
        x = repeated(start, len(z))
        minima = minimize(objective, LevenbergMarquardtMethod(1e-3), x, limits)
        return minima.estimates(objective.model.tally, z.shape[1])


def examined(
    problem: Problem, z: Array, fits: list[Fit], noise: Noise
) -> tuple[list[Fit], Examination | None]:
    """Examines the least minimum of the fits to readings z (m,); if that finds a lower one, by more
    than chance explains, the fit there is one of the fits, and is examined."""
    found = examine(problem, z, fits)
    for _ in range(_MOST):
        # What is held on a bound has no start inside.
        if found is None or found.least or found.on_bounds:
            break
        names = [p.name for p in found.model.parameters]
        point = dict(zip(names, found.minima[0].inner.tolist(), strict=True))
        (further,) = fit(problem, z, {LABEL: From(point)}, noise)
        before = [replace(one, beaten_by="", lower_at="") for one in fits if one.label != LABEL]
        fits = compared([*before, further])
        found = examine(problem, z, fits)
    return fits, found
