"""Square systems with known roots, as models for the solvers' tests."""

from dataclasses import dataclass

import numpy as np

from ipe_bench.basics.linalg import Array, Covariance
from ipe_bench.estimators.ipe import FrozenSystem
from ipe_bench.measurements import Measurement, Parameter
from ipe_bench.measurements.counted import CountingModel, EvaluationCount


@dataclass(frozen=True)
class Square(Measurement):
    """h(x) of as many readings as parameters; the system is h(x) = z, with H+ = I."""

    unknowns: int = 2
    analytic = True

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(Parameter(f"x{i}") for i in range(self.unknowns))

    @property
    def index(self):
        return {"number": list(range(self.unknowns))}


class BurdenFaires(Square):
    """Burden and Faires, Numerical Analysis, section 10.2, example 2: root (1/2, 0, -pi/6)."""

    def __init__(self) -> None:
        super().__init__(3)

    def simulate(self, x: Array) -> Array:
        a, b, c = x.T
        return np.stack(
            [
                3 * a - np.cos(b * c) - 0.5,
                a**2 - 81 * (b + 0.1) ** 2 + np.sin(c) + 1.06,
                np.exp(-a * b) + 20 * c + (10 * np.pi - 3) / 3,
            ],
            axis=1,
        )


class Rosenbrock(Square):
    """10 (b - a^2), 1 - a: root (1, 1), from the customary start (-1.2, 1)."""

    def simulate(self, x: Array) -> Array:
        a, b = x.T
        return np.stack([10 * (b - a**2), 1 - a], axis=1)


class Cubic(Square):
    """x + (A x)^3 / 10, A a rotation: root 0, a contraction of the fixed-point iteration around it."""

    def simulate(self, x: Array) -> Array:
        a, b = x.T
        return np.stack([1.2 * a + 0.3 * b + (a + b) ** 3 / 20, -0.2 * a + 0.9 * b + (a - b) ** 3 / 20], axis=1)


class NoRoot(Square):
    """a^2 + 1, b: |F| has its minimum 1 at 0, where the Jacobian is singular."""

    def simulate(self, x: Array) -> Array:
        a, b = x.T
        return np.stack([a**2 + 1, b], axis=1)


def system_of(model: Measurement, trials: int) -> FrozenSystem:
    """h(x) = 0 for each trial."""
    unit = np.eye(model.n)[None]
    R = Covariance(np.ones(model.m))
    counted = CountingModel(model, EvaluationCount.zeros(trials))
    return FrozenSystem(counted, unit, np.ones((1, model.n)), R, np.zeros((trials, model.m)), np.arange(trials))
