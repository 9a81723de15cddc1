"""Computes least-squares estimates within the bounds of the parameters, for many sets of readings
at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.linalg import Array, Mask
from ipe_bench.measurements.base import Measurement
from ipe_bench.measurements.problem import Problem
from ipe_bench.real.fits import falls_beyond, holding
from ipe_bench.real.levels import maximise_likelihood
from ipe_bench.real.profiles import (
    Released,
)


def answers(
    problem: Problem, z: Array, x: Array, released: Released | None = None
) -> tuple[Array, Mask]:
    """Computes the least-squares estimates (sets, n) within the bounds, in the parameters' own
    units, for readings z (sets, m) from x (sets, n), and the sets that have one; `released`
    parameters keep their bounds."""
    model = problem.measurement
    minima = maximise_likelihood(problem, z, x)
    values = model.physical(minima.x)
    found = minima.converged.copy()
    outside = np.zeros((len(x), 0), dtype=bool)
    if released is not None:
        outside = ~released.inside(minima.x)
    beyond = np.flatnonzero(~found | outside.any(axis=1))
    found[beyond] = False
    for bounds, sets in _by_bounds(model, minima.x, beyond, outside, released).items():
        near = dict(bounds)
        values[sets], found[sets] = _held(problem, near, minima.x[sets], z[sets], released)
    return values, found


Bounds = tuple[tuple[int, float], ...]
"""Places of parameters, and the bounds that they are on."""


def _by_bounds(
    model: Measurement,
    x: Array,
    beyond: NDArray[np.intp],
    outside: Mask,
    released: Released | None,
) -> dict[Bounds, list[int]]:
    """Groups the sets that end on, or beyond, the same bounds: they are minimised again
    together."""
    groups: dict[Bounds, list[int]] = {}
    for i in beyond.tolist():
        near = dict(model.near_bounds(x[i]))
        if released is not None:
            near |= _left(model, released, outside[i])
        # Of none on a bound there is nothing to hold, and of all nothing to find.
        if 0 < len(near) < model.n:
            groups.setdefault(tuple(sorted(near.items())), []).append(i)
    return groups


def _held(
    problem: Problem, near: dict[int, float], x: Array, z: Array, released: Released | None
) -> tuple[Array, Mask]:
    """Computes estimates with parameters held on their bounds, and tells which of them the readings
    want beyond these."""
    n = problem.measurement.n
    free = [k for k in range(n) if k not in near]
    held = holding(problem, near)
    there = maximise_likelihood(held, z, np.ascontiguousarray(x[:, free]))
    values = np.empty((len(z), n))
    values[:, list(near)] = list(near.values())
    values[:, free] = held.measurement.physical(there.x)
    return values, there.converged & falls_beyond(problem, there.x, near, z, released)


def _left(model: Measurement, released: Released, outside: Mask) -> dict[int, float]:
    """Returns the bounds, by place, that a minimum is outside of (bounds,)."""
    places = released.places[outside]
    bounds = model.physical(released.x[None])[0, places]
    return dict(zip(places.tolist(), bounds.tolist(), strict=True))
