"""Whether a model's readings are a function of x alone: what was computed before must not matter."""

from __future__ import annotations

import copy
import dataclasses
import functools
import time

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.options import component_classes
from ipe_bench.measurements.base import Measurement

_PATIENCE_S = 1.0
"""A model that takes longer for one call is not tried."""


def require_repeatable(model: Measurement) -> None:
    """Refuses a model from outside of this package that gives one x other readings after another x, in another batch,
    or on a fresh object; its slopes likewise.

    Raises:
        UserError: what differs, by the name of the model.
    """
    if all(cls.__module__.startswith("ipe_bench.") for cls in component_classes(model)):
        return
    try:
        hash(model)
    except TypeError:
        complaint = _irregularity.__wrapped__(model)
    else:
        complaint = _irregularity(model)
    if complaint:
        raise UserError(f"measurement={model.name}: {complaint}; let h(x) depend on x and the options alone")


@functools.lru_cache(maxsize=256)
def _irregularity(model: Measurement) -> str:
    """What differs; empty where nothing does, and where a call raises, which is told of by the trials that it ends."""
    rng = np.random.default_rng(11)
    x, other = (model.nominal + 0.1 * rng.standard_normal((trials, model.n)) for trials in (4, 7))
    fresh = dataclasses.replace(model) if dataclasses.is_dataclass(model) else copy.copy(model)  # type: ignore[type-var]
    for method in ("simulate", "jacobian"):
        call = getattr(model, method)
        try:
            call(x)  # the first call may compile
            began = time.perf_counter()
            first = call(x)
            if time.perf_counter() - began > _PATIENCE_S:
                continue
            call(other)
            ways = {
                "after another x": call(x),
                "in another batch": np.concatenate([call(x[:1]), call(x[1:])]),
                "on a fresh object": getattr(fresh, method)(x),
            }
        except Exception:
            return ""
        differing = [way for way, z in ways.items() if not np.array_equal(z, first, equal_nan=True)]
        if differing:
            return f"{method}(x) has other bits {' and '.join(differing)}"
    return ""
