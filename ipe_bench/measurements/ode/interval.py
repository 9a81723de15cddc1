"""One interval between two readings of a differential model as a model of its own, from any state at its beginning."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.measurements.base import Parameter
from ipe_bench.measurements.ode.model import OdeMeasurement


@dataclass(frozen=True)
class Interval(OdeMeasurement):
    """x is the whole model's p in SI units, the state at the beginning, a case's constants, the time of the beginning
    and the length, so that all intervals of all trials and cases are one batch; read are the state and the whole
    model's outputs at the end. Time counts in lengths of the interval."""

    whole: OdeMeasurement
    step: float | None = 0.125
    """Share of the interval."""

    @property
    def states(self) -> int:  # type: ignore[override]
        return self.whole.states

    @property
    def outputs(self) -> tuple[str, ...]:  # type: ignore[override]
        return (*(f"y{i}" for i in range(self.states)), *self.whole.outputs)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(Parameter(f"x{i}") for i in range(self._begin.stop + self._constants + 2))

    @property
    def times(self) -> Array:
        return np.ones(1)

    def start(self, p: Sequence[Any], c: Sequence[Any]) -> Sequence[Any]:
        return list(p[self._begin])

    def rhs(self, t: Any, y: Sequence[Any], p: Sequence[Any], c: Sequence[Any]) -> Sequence[Any]:
        own, constants, t0, length = self._split(p)
        return [length * slope for slope in self.whole.rhs(t0 + length * t, y, own, constants)]

    def read(self, t: Any, y: Sequence[Any], p: Sequence[Any], c: Sequence[Any]) -> Sequence[Any]:
        own, constants, t0, length = self._split(p)
        return [*y, *self.whole.read(t0 + length * t, y, own, constants)]

    @property
    def _begin(self) -> slice:
        """Where the state at the beginning stands in x."""
        return slice(self.whole.n, self.whole.n + self.whole.states)

    @property
    def _constants(self) -> int:
        return self.whole.cases.shape[1]

    def _split(self, p: Sequence[Any]) -> tuple[Sequence[Any], Sequence[Any], Any, Any]:
        end = self._begin.stop + self._constants
        return p[: self.whole.n], p[self._begin.stop : end], p[end], p[end + 1]
