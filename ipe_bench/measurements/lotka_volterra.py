"""Predators and prey, the worked example of a model that is defined by differential equations (see `ode`)."""

from dataclasses import dataclass

import numpy as np

from ipe_bench.basics.options import Count, Positive
from ipe_bench.measurements.base import Parameter, UsualNoise
from ipe_bench.measurements.ode.model import OdeMeasurement

_VALUES = {"birth": 0.55, "hunting": 0.028, "death": 0.8, "growth": 0.024, "prey": 34.0, "predators": 5.9}


@dataclass(frozen=True)
class LotkaVolterra(OdeMeasurement):
    """Hares and lynxes in thousands, read once a year or at times `sampled` in years; one unit of error is 2 % of each
    rate and of each start (values of the Hudson's Bay pelts: Carpenter, Predator-Prey Population Dynamics, Stan, 2018).
    """

    years: Count = 20
    step: Positive | None = None
    sampled: tuple[float, ...] | None = None
    tolerance = 1e-6
    states, outputs, time_unit, reading_unit = 2, ("prey", "predators"), "year", "thousand"
    usual_noise = UsualNoise(0.5)
    parameters = tuple(Parameter(name, size=0.02 * value) for name, value in _VALUES.items())  # type: ignore[assignment]
    nominal = np.full(6, 50.0)  # type: ignore[assignment]

    @property
    def times(self):
        return np.arange(1.0, self.years + 1) if self.sampled is None else np.array(self.sampled)

    def start(self, p, c):
        return p[4], p[5]

    def rhs(self, t, y, p, c):
        meetings = y[0] * y[1]
        return p[0] * y[0] - p[1] * meetings, p[3] * meetings - p[2] * y[1]

    def read(self, t, y, p, c):
        return y
