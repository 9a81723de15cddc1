"""One interval between two readings of a differential model as a model of its own, from any state
at its beginning."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ipe_bench.measurements.base import Parameter
from ipe_bench.measurements.ode.model import OdeMeasurement


@dataclass(frozen=True)
class Interval(OdeMeasurement):
    """x is the whole model's p in SI units, the state at the beginning, a case's constants within
    and at the end (once where none are driven), the time of the beginning and the length, so that
    all intervals of all trials and cases are one batch; read are the state and the whole model's
    outputs at the end. Time counts in lengths of the interval."""

    whole: OdeMeasurement
    step: float | None = 0.125
    """Share of the interval."""

    states = property(lambda interval: interval.whole.states)  # type: ignore[assignment]
    times = np.ones(1)  # type: ignore[assignment]

    @property
    def outputs(self) -> tuple[str, ...]:  # type: ignore[override]
        return (*(f"y{i}" for i in range(self.states)), *self.whole.outputs)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        constants = self.whole.tables.shape[2] * (1 if self.whole.driven is None else 2)
        return tuple(Parameter(f"x{i}") for i in range(self.whole.n + self.states + constants + 2))

    def start(self, p: Sequence[Any], c: Sequence[Any]) -> Sequence[Any]:
        return self._split(p)[1]

    def rhs(self, t: Any, y: Sequence[Any], p: Sequence[Any], c: Sequence[Any]) -> Sequence[Any]:
        own, _, constants, t0, length = self._split(p)
        constants = constants[: self.whole.tables.shape[2]]
        return [length * slope for slope in self.whole.rhs(t0 + length * t, y, own, constants)]

    def read(self, t: Any, y: Sequence[Any], p: Sequence[Any], c: Sequence[Any]) -> Sequence[Any]:
        own, _, constants, t0, length = self._split(p)
        return [
            *y,
            *self.whole.read(t0 + length * t, y, own, constants[-self.whole.tables.shape[2] :]),
        ]

    def _split(self, p: Sequence[Any]) -> tuple[list[Any], list[Any], list[Any], Any, Any]:
        """The parameters, the state at the beginning, the constants, the time of the beginning, and
        the length."""
        n, end = self.whole.n, self.whole.n + self.states
        return list(p[:n]), list(p[n:end]), list(p[end:-2]), p[-2], p[-1]
