"""Predators and prey: the worked example of a model defined by ordinary differential equations."""

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from ipe_bench.measurements.base import Parameter
from ipe_bench.measurements.ode.model import OdeMeasurement


@dataclass(frozen=True)
class LotkaVolterra(OdeMeasurement):
    """Hares and lynxes in thousands, read once a year; values after Carpenter's case study of the Hudson Bay pelts (2018)."""

    years: int = 20
    step: float | None = 0.125
    states, outputs, time_unit, reading_unit = 2, ("prey", "predator"), "year", "thousand"
    values: ClassVar = {"birth": 0.55, "hunting": 0.028, "death": 0.8, "growth": 0.024, "prey": 34.0, "predator": 5.9}
    parameters: ClassVar = tuple(Parameter(name, size=0.02 * value) for name, value in values.items())
    nominal: ClassVar = np.full(6, 50.0)

    @cached_property
    def times(self):
        return np.arange(1.0, self.years + 1)

    def start(self, p, c):
        return p[4], p[5]

    def rhs(self, t, y, p, c):
        prey, predator = y
        return p[0] * prey - p[1] * prey * predator, p[3] * prey * predator - p[2] * predator

    def read(self, t, y, p, c):
        return y
