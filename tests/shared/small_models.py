"""Small models with known answers, shared by the tests."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.measurements import Measurement, Ode, Parameter


@dataclass(frozen=True)
class Bent(Measurement):
    """h(x) = A x + bend * (A x)^2: linear where bend is 0, with a Jacobian in closed form."""

    bend: float = 0.0
    seed: int = 7
    count: int = 12

    analytic = True
    reading_unit = "m"

    @property
    def A(self) -> Array:
        return np.random.default_rng(self.seed).normal(size=(self.count, 3))

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return Parameter("a", "m", 1.0), Parameter("b", "m", 2.0), Parameter("c", "m", 0.5)

    @property
    def index(self):
        return {"number": list(range(1, self.count + 1))}

    @property
    def epochs(self):
        return tuple(np.arange(i, i + 3) for i in range(0, self.count, 3))

    def simulate(self, x: Array) -> Array:
        y = np.matmul(self.A, x[..., None])[..., 0]
        return y + self.bend * y**2


@dataclass(frozen=True)
class Written(Measurement):
    """Readings (trials, count) by a function of the parameters, each (trials,)."""

    function: Callable[..., tuple[Any, ...]]
    unknowns: int = 1
    count: int = 2
    first: float = 0.0
    """The first parameter at the start; the others are 0 there."""
    analytic = True

    def __post_init__(self) -> None:
        """No options."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(Parameter(f"p{i}") for i in range(self.unknowns))

    @property
    def index(self):
        return {"number": list(range(self.count))}

    @property
    def nominal(self) -> Array:
        return self.first * np.eye(self.unknowns)[0]

    def simulate(self, x: Array) -> Array:
        return np.stack(self.function(*x.T), axis=1)


def bock(mu: float) -> Ode:
    """Bock's notorious problem with unknown initial values, presumed to be (0, pi): x grows like
    exp(mu t)."""
    return Ode(
        title="bock",
        rates={"x1": "x2", "x2": "mu**2*x1 - (mu**2 + p**2)*sin(p*t)"},
        constants={"mu": mu},
        outputs={"x1": "x1", "x2": "x2"},
        readings=10,
        interval=0.1,
        tolerance="1e-13*cosh(mu*t)",
        deviation=0.05,
        exact={"x1": "sin(p*t)", "x2": "p*cos(p*t)"},
        start={"p": 1.0, "a": 0.0, "b": np.pi},
        size={"p": 0.1, "a": 0.1, "b": 0.1},
        initial={"x1": "a", "x2": "b"},
        answer={"p": np.pi, "a": 0.0, "b": np.pi},
    )
