"""An epidemic: susceptible, infected, removed, the smallest model of one (see `ode`)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Count, Positive
from ipe_bench.measurements.base import Parameter, UsualNoise
from ipe_bench.measurements.ode.model import OdeMeasurement

State = Literal["susceptible", "infected", "removed"]
_STATES: tuple[State, ...] = get_args(State)


@dataclass(frozen=True)
class Sir(OdeMeasurement):
    """Rates of infection and recovery, and the first infected, from how many are infected each day.

        S' = -beta S I / N,   I' = beta S I / N - gamma I,   R = N - S - I;   S(0) = N - I(0), R(0) = 0

    Parameters: the logarithms of beta, gamma and the odds I(0) / S(0), each over its presumed value, because rates and
    people are positive: whatever is drawn is an epidemic. An estimate of 0.1 stands for 10 % more than presumed; for
    few infected the odds are their share. Readings: people in each of the states in `observed`, at the end of each day;
    a day is an epoch.

    Source: Kermack and McKendrick, Proceedings of the Royal Society A 115, 1927. The defaults are the influenza in an
    English boarding school of 763 boys (British Medical Journal, 4 March 1978) as Murray fits it, Mathematical
    Biology I, 3rd ed., section 10.2: beta / N = 2.18e-3 per day, gamma N / beta = 202, one boy at the start. A fit
    leaves residuals of about 20 boys there.
    """

    population: Positive = 763.0
    """N."""
    infection: Positive = 1.66
    """Presumed beta per day; with the two that follow, the nominal point."""
    recovery: Positive = 0.44
    """Presumed gamma per day."""
    infected: Positive = 1.0
    """Presumed I(0)."""
    days: Count = 14
    observed: tuple[State, ...] = ("infected",)
    """What is counted each day."""
    rate_size: Positive = 0.1
    """What one unit of error of the logarithm of a rate is."""
    infected_size: Positive = 0.3
    """What one unit of error of the logarithm of the odds I(0) / S(0) is."""
    step: Positive | None = None
    """A longest step in days for all trials; None: each trial's follows its parameters."""
    sampled: tuple[float, ...] | None = None
    """Times of the readings in days, in place of one at the end of each day."""

    states, time_unit, reading_unit, tolerance = 2, "day", "people", 1e-6
    usual_noise = UsualNoise(20.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.infected >= self.population:
            raise UserError(f"infected={self.infected}: give fewer than the population of {self.population:g}")
        if not self.observed or len(set(self.observed)) < len(self.observed):
            raise UserError(f"observed={list(self.observed)}: choose some of {', '.join(_STATES)}, each once")
        if self.days * len(self.observed) < 4:
            raise UserError(f"days={self.days}: give at least 4 readings for 3 parameters")

    @property
    def outputs(self) -> tuple[str, ...]:
        return self.observed

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        rates = (Parameter(f"ln_{name}", size=self.rate_size, group="rates") for name in ("beta", "gamma"))
        return (*rates, Parameter("ln_odds", size=self.infected_size))

    @cached_property
    def times(self) -> Array:
        return np.arange(1.0, self.days + 1) if self.sampled is None else np.array(self.sampled)

    def start(self, p, c):
        odds = self.infected / (self.population - self.infected) * np.exp(p[2])
        susceptible = self.population / (1.0 + odds)
        return susceptible, odds * susceptible

    def rhs(self, t, y, p, c):
        susceptible, infected = y
        beta, gamma = self.infection * np.exp(p[0]), self.recovery * np.exp(p[1])
        infections = beta / self.population * susceptible * infected
        return -infections, infections - gamma * infected

    def read(self, t, y, p, c):
        counted = {"susceptible": y[0], "infected": y[1], "removed": self.population - y[0] - y[1]}
        return [counted[name] for name in self.observed]
