"""No noise at all, because nothing is simulated: real readings with a certified answer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array, Covariance
from ipe_bench.noise.base import Noise


@dataclass(frozen=True)
class Certified(Noise):
    """Readings are those that come with the measurement model, its certified answer stands for the truth, and no prior.

    A scenario with it has one trial. R is what the model states of its readings.
    """

    real = True

    def corrupt(self, h: Array, offset: Array, rng: np.random.Generator) -> Array:
        raise UserError("noise=certified: has real readings only; choose another noise to simulate some")

    def covariance(self, m: int) -> Covariance:
        raise UserError("noise=certified: knows no R of its own; choose another noise")
