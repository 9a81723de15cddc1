"""A problem of one's own: what an estimator of somebody else does to it, no other estimator sees.

Our own estimators share one problem, whose arrays are read-only; what it took to compile a model is not paid twice.
"""

from __future__ import annotations

import copy
import dataclasses
import pickle
from functools import cached_property
from typing import Any, TypeVar

import numpy as np

from ipe_bench.basics.linalg import Array, Covariance
from ipe_bench.basics.options import component_classes
from ipe_bench.measurements.problem import Problem

_LINEAR = ("H", "H_plus")
T = TypeVar("T")


def is_ours(component: Any) -> bool:
    """Whether a component, and those inside it, are of this package."""
    return all(cls.__module__.startswith("ipe_bench.") for cls in component_classes(component))


class Private:
    """Readings z (trials, m) and what an estimator is told besides, as copies that are read-only."""

    def __init__(self, problem: Problem, z: Array) -> None:
        self._shared, self._z = problem, z
        prior, correlation = problem.prior_deviation, problem.prior_correlation
        self.problem = Problem(
            afresh(problem.measurement),
            Covariance(problem.R.factor.copy()),
            None if prior is None else prior.copy(),
            None if correlation is None else correlation.copy(),
            problem.doubted,
        )
        self.z = z.copy()
        self.z.flags.writeable = False
        self._before = _digest(self.problem.measurement)

    def complaint(self) -> str:
        """What has been changed in spite of that; empty where nothing has."""
        problem, shared = self.problem, self._shared
        if not _same(self.z, self._z):
            return "it writes into its readings"
        if not _same(problem.R.factor, shared.R.factor):
            return "it writes into R"
        if not _same(problem.prior_deviation, shared.prior_deviation):
            return "it writes into the prior"
        if not _same(problem.prior_correlation, shared.prior_correlation):
            return "it writes into the prior"
        model = problem.measurement
        if _digest(model) != self._before or not _same(model.nominal, shared.measurement.nominal):
            return "it changes the model"
        if any(name in vars(problem) and not _same(getattr(problem, name), getattr(shared, name)) for name in _LINEAR):
            return "it writes into H"
        return ""


def afresh(component: T) -> T:
    """A component that equals this one and shares nothing with it that could be written to: its options are copied, and
    what it has cached is computed again."""
    cls = type(component)
    cached = {name for base in cls.__mro__ for name, value in vars(base).items() if isinstance(value, cached_property)}
    new = object.__new__(cls)
    for base in reversed(cls.__mro__):
        # An array that a class states, such as a nominal point, is shared by all of its instances.
        arrays = {name: value for name, value in vars(base).items() if isinstance(value, np.ndarray)}
        for name, value in {**arrays, **(vars(component) if base is cls else {})}.items():
            if name not in cached:
                object.__setattr__(new, name, _copied(value))
    return new


def _copied(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return afresh(value)
    try:
        return copy.deepcopy(value)
    except Exception:  # a lock, a module: what cannot be copied is shared
        return value


def _digest(component: Any) -> bytes | None:
    """What tells the options of a component from others; None where that cannot be said."""
    try:
        return pickle.dumps([getattr(component, f.name) for f in dataclasses.fields(component)])
    except Exception:
        return None


def _same(a: Array | None, b: Array | None) -> bool:
    return (a is None and b is None) or np.array_equal(np.asarray(a), np.asarray(b), equal_nan=True)
