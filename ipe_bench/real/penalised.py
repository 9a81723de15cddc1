"""A prior as further readings: what an estimate with a prior minimises is then a sum of squares like any other.

So profiles of it are those of the penalised likelihood, and a bootstrap simulates the prior's means along with the
readings, as the randomised maximum likelihood of Oliver, He and Reynolds does (5th European Conference on the
Mathematics of Oil Recovery, 1996): where the model is linear both are the posterior's intervals.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from ipe_bench.basics.linalg import Array, Covariance
from ipe_bench.measurements.base import Measurement, WrappedModel
from ipe_bench.measurements.problem import Problem


@dataclass(frozen=True)
class Penalised(WrappedModel):
    """The readings of a model, and behind them x itself, which its prior has measured."""

    whole: Measurement

    epochs = recorded = None
    linearization = Measurement.linearization

    def __post_init__(self) -> None:
        """Made of a model that has been checked."""

    @cached_property
    def m(self) -> int:
        return self.whole.m + self.whole.n

    @property
    def index(self) -> Mapping[str, Sequence[Any]]:
        return {"number": list(range(self.m))}

    @property
    def offset(self) -> Array:
        return np.concatenate([self.whole.offset, np.zeros(self.whole.n)])

    def near_bounds(self, x: Array) -> Mapping[int, float]:
        """None: an estimate with a prior is not held on a bound."""
        return {}

    def own_readings(self, x: Array, z: Array) -> Array:
        return np.concatenate([z, x], axis=1)

    def own_jacobian(self, x: Array, J: Array) -> Array:
        n = x.shape[1]
        return np.concatenate([J, np.broadcast_to(np.eye(n), (len(x), n, n))], axis=1)


def penalised(problem: Problem, z: Array, inflation: float) -> tuple[Problem, Array]:
    """The problem and the readings z (m,) with the prior, its deviations times `inflation`, as n readings more."""
    prior = problem.prior_covariance(inflation)
    assert prior is not None
    factors = problem.R.factor, prior.factor
    if all(factor.ndim == 1 for factor in factors):
        R = Covariance(np.concatenate(factors))
    else:
        L: Array = np.asarray(block_diag(*(np.diag(f) if f.ndim == 1 else f for f in factors)))
        R = Covariance(L)
    model = Penalised(problem.measurement)
    whole = Problem(model, R, problem.prior_deviation, problem.prior_correlation)
    return whole, np.concatenate([z, problem.x0])
