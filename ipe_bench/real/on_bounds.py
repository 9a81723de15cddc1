"""Describes parameters that are held on their bounds: how far inwards the readings let them be."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ipe_bench.estimators.least_squares import inverse_factor
from ipe_bench.measurements.base import Parameter
from ipe_bench.measurements.problem import Problem
from ipe_bench.real.fits import holding
from ipe_bench.real.levels import objective_of
from ipe_bench.real.profiles import (
    Released,
    natural_limits,
    profiles,
)

if TYPE_CHECKING:
    from ipe_bench.real.examination import Examination


@dataclass(frozen=True)
class OnBound:
    """Describes a parameter whose estimate is on a bound, because the readings want it beyond."""

    parameter: Parameter
    bound: float
    other: float
    """The other end of its profile interval; infinite if the readings set no limit, NaN if it was
    not found."""


def released_at(
    problem: Problem, found: Examination, held_at: Mapping[int, float]
) -> Released | None:
    """Returns the problem in which parameters held on bounds may leave them; None if it has no
    covariance there."""
    model = problem.measurement
    places = np.array(list(held_at))
    bounds = np.array(list(held_at.values()))
    given = replace(problem, measurement=model.stating("nominal", held_at))
    x = np.array(given.measurement.nominal, dtype=float)
    x[np.setdiff1d(np.arange(len(x)), places)] = found.inner
    with np.errstate(all="ignore"):
        J = objective_of(given, found.z[None]).jacobian(x[None])
        inverse_U = inverse_factor(J)[0]
    if not np.isfinite(inverse_U).all():
        return None
    start = model.physical(model.nominal[None])[0]
    return Released(given, x, inverse_U @ inverse_U.T, places, np.sign(start[places] - bounds))


def on_bounds(
    problem: Problem, found: Examination, held_at: Mapping[int, float]
) -> Iterator[OnBound]:
    """Computes the interval of each parameter on its bound, the others being held on theirs."""
    lower, upper = natural_limits(problem.measurement)
    for place, bound in held_at.items():
        others = {k: value for k, value in held_at.items() if k != place}
        k = place - sum(one < place for one in others)
        part = released_at(holding(problem, others) if others else problem, found, {k: bound})
        end = np.nan
        if part is not None:
            end = float(np.clip(_end_inwards(part, found, k), lower[place], upper[place]))
        yield OnBound(problem.measurement.physical_parameters[place], bound, end)


def _end_inwards(part: Released, found: Examination, k: int) -> float:
    """Finds the end of the profile of parameter k that lies inwards of its bound."""
    freedom = found.freedom
    if isinstance(freedom, np.ndarray):
        freedom = np.insert(freedom, k, freedom.min())
    sign = int(part.inwards[0])
    ends = profiles(
        part.problem, found.z, part.x, part.P, freedom=freedom, places=(k,), signs=(sign,)
    )
    return ends[int(sign > 0)][0]
