"""What a noise is: it adds errors to simulated readings, and states the R that estimators assume."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np

from ipe_bench.basics.linalg import Array, Covariance
from ipe_bench.basics.options import Component
from ipe_bench.measurements.base import Measurement, UsualNoise
from ipe_bench.noise.levels import Levels


class Noise(Component, ABC):
    """Errors of readings. A new noise is a frozen dataclass that writes `corrupt` and `covariance`."""

    real: ClassVar[bool] = False
    """True where readings are not simulated at all, but are those that come with the model."""
    estimated: ClassVar[bool] = False
    """True where the level of the errors is estimated from the residuals, R being known up to a factor."""
    true_covariance: bool = True
    """Whether R is that of the errors; False where estimators are told another one on purpose."""

    def completed(self, usual: UsualNoise | None) -> Noise:
        """This noise, with what its options leave out taken from the usual noise of the model.

        Raises:
            UserError: the model names none.
        """
        del usual
        return self

    @abstractmethod
    def corrupt(self, h: Array, offset: Array, rng: np.random.Generator) -> Array:
        """The readings z (m,) of one trial, given the error-free h (m,) and what the instruments show besides it."""

    @abstractmethod
    def covariance(self, m: int) -> Covariance:
        """R of m readings, as the estimators assume it."""

    def nominal_covariance(self, model: Measurement) -> Covariance:
        """R of a model's readings, as estimators are told it."""
        return self.covariance(model.m)

    def true_levels(self, m: int) -> tuple[Levels, Array] | None:
        """Levels of m readings, and their logarithms (k,), if bounds are to count them among what is not known."""
        del m

    def levels_of(self, model: Measurement) -> Levels | None:
        """Levels of which standard deviations are formulas, if these are to be estimated with the parameters."""
        del model

    def whitened(self, shape: tuple[int, ...], rng: np.random.Generator) -> Array | None:
        """Draws of the errors of whitened readings, R^-1/2 v, if R is right: independent, of mean 0 and variance 1.

        None, unless a noise says otherwise: they are normal. The test of fit takes its law from here.
        """
        return None
