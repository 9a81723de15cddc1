"""Finds the one limit of a parameter that may go to infinity, by its profile from there inwards."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ipe_bench.basics.linalg import divisors
from ipe_bench.measurements.base import Measurement, SubsetModel
from ipe_bench.measurements.known import ConstrainedModel, ParameterInfo
from ipe_bench.measurements.problem import Problem
from ipe_bench.real.fits import Fit
from ipe_bench.real.levels import objective_of
from ipe_bench.real.profiles import decades, profiles

_SPREAD = 8.0
"""Decades that stand for the standard error of a parameter of which readings tell nothing."""


def limits_of(fit: Fit) -> dict[str, float]:
    """Computes the finite ends of the 95 % profile intervals of parameters that may go to infinity,
    by their names."""
    running = {name for names in fit.endless for name in names}
    if not running or fit.estimated is not None or fit.exact:
        return {}
    model = _over_decades(fit.assumed.measurement, {name: fit.values[name] for name in running})
    problem = Problem(model, fit.assumed.R)
    names = [p.name for p in model.physical_parameters]
    values = np.array([fit.values[name] for name in names])
    x = model.inner(values)
    z = fit.given.z
    J = objective_of(problem, z[None]).jacobian(x[None])[0]
    spread = _SPREAD * decades(model, x)
    scale = np.where(np.isfinite(spread), spread, divisors(np.linalg.norm(J, axis=0)) ** -1)
    A = J * scale
    P = np.linalg.pinv(
        A.T @ A + np.diag([float(name in running) for name in names]), hermitian=True
    )
    P *= np.outer(scale, scale)
    freedom = None if fit.level is None else float(fit.degrees_of_freedom)
    found = {}
    for place in [k for k, name in enumerate(names) if name in running]:
        side = -1 if values[place] > 0 else 1
        ends = profiles(problem, z, x, P, freedom=freedom, places=(place,), signs=(side,))
        end = float(ends[int(side > 0)][0])
        if np.isfinite(end) and end != 0.0:
            found[names[place]] = end
    return found


def _over_decades(model: Measurement, values: Mapping[str, float]) -> Measurement:
    """Returns the model with logarithms of these parameters, which start at their values."""
    if isinstance(model, SubsetModel):
        return model.around(_over_decades(model.whole, values))
    known = {}
    if isinstance(model, ConstrainedModel):
        known = {one.name: one for one in model.known}
        model = model.whole
    for name, value in values.items():
        lower = 0.0 if value > 0 else None
        upper = 0.0 if value <= 0 else None
        known[name] = ParameterInfo(name, nominal=value, lower=lower, upper=upper)
    return ConstrainedModel(model, tuple(known.values()))
