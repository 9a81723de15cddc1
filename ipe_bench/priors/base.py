"""What a prior is: it draws true parameters, and states what estimators are told of them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.basics.naming import Named
from ipe_bench.basics.options import Component


class Prior(Component, Named, ABC):
    """A prior. A new one is a frozen dataclass that writes `deviation` and `draw`.

    Estimators that use a prior are told N(nominal, P0), P0 being of these deviations and of `correlation`, and the
    Bayesian bound is the one under that. A prior of another form has draws of the same mean and covariance, and sets
    `normal` to False: then that bound is one for estimators that know no more than mean and covariance.
    """

    normal: ClassVar[bool] = True
    """Whether its draws are normal: the posterior is sampled for such priors alone."""

    @abstractmethod
    def deviation(self, n: int, error_scale: float) -> Array:
        """Standard deviations (n,) of the parameters in multiples of their units."""

    def correlation(self, n: int) -> Array | None:
        """Correlation (n, n) of the parameters, positive definite; None: they are independent."""
        del n
        return None

    @abstractmethod
    def draw(self, x0: Array, error_scale: float, rng: np.random.Generator) -> Array:
        """One parameter vector (n,) about the nominal point x0 (n,), in multiples of the units."""
