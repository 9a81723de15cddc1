"""Linear measurement models with epochs, whose maximum a posteriori has a closed form."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ipe_bench.basics.linalg import Array, multiply
from ipe_bench.measurements.base import Measurement, Parameter
from ipe_bench.measurements.gins import Gins
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import Quantization
from ipe_bench.priors import GaussianPrior
from ipe_bench.trials.scenario import Scenario
from ipe_bench.trials.scoring import Block


@dataclass(frozen=True)
class Linear(Measurement):
    """z = H x with a random H; `sizes` readings arrive at each epoch."""

    sizes: tuple[int, ...] = (1, 3, 2, 5)
    unknowns: int = 4

    @property
    def parameters(self):
        return tuple(Parameter(f"p{i}") for i in range(self.unknowns))

    @property
    def index(self):
        return {"reading": list(range(sum(self.sizes)))}

    @property
    def epochs(self):
        # Scattered over z, so that an epoch is no range of rows.
        order = np.random.default_rng(3).permutation(sum(self.sizes))
        return tuple(np.split(order, np.cumsum(self.sizes)[:-1]))

    @property
    def nominal(self):
        return np.arange(1.0, self.unknowns + 1)

    @cached_property
    def matrix(self) -> Array:
        return np.random.default_rng(5).standard_normal((self.m, self.unknowns))

    def simulate(self, x):
        return multiply(self.matrix, x)

    def simulate_until(self, x, stop):
        return multiply(self.matrix[self.rows(stop)], x)

    def jacobian(self, x):
        return np.repeat(self.matrix[None], len(x), axis=0)


class LinearGins(Gins):
    """The GINS model's slopes at the start in place of the model."""

    name = "linear_gins"

    @cached_property
    def matrix(self) -> Array:
        return Gins(step=180.0).jacobian(np.zeros((1, self.n)))[0]

    def simulate_until(self, x, stop):
        return multiply(self.matrix[self.rows(stop)], x)

    def jacobian_until(self, x, stop):
        return np.repeat(self.matrix[None, self.rows(stop)], len(x), axis=0)


def block_of_gins(scale: float, trials: int, seed: int = 0) -> Block:
    return Block.draw(
        Scenario(Gins(), Quantization(0.02286), GaussianPrior(), scale, seed), 0, trials
    )


def linear_map(
    problem: Problem, matrix: Array, z: Array, inflation: float = 1.0
) -> tuple[Array, Array]:
    """The maximum a posteriori (trials, n) of a linear model and its covariance (n, n), by one
    orthogonal solution."""
    assert problem.prior_deviation is not None
    d, x0 = problem.prior_deviation, problem.x0
    A = np.vstack([problem.R.whiten_jacobian(matrix) * d, np.eye(len(d)) / inflation])
    r = problem.R.whiten(z - matrix @ x0)
    s = np.array(
        [np.linalg.lstsq(A, np.concatenate([row, np.zeros(len(d))]), rcond=None)[0] for row in r]
    )
    P = np.linalg.inv(A.T @ A)
    return x0 + s * d, P * d * d[:, None]
