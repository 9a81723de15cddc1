"""Defines a noise: it adds errors to simulated readings, and states the R that estimators
assume."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np

from ipe_bench.basics.linalg import Array, Covariance
from ipe_bench.basics.options import Component
from ipe_bench.measurements.base import Measurement, UsualNoise
from ipe_bench.noise.levels import Levels


class Noise(Component, ABC):
    """Adds errors to readings, and states the R that estimators assume: a frozen dataclass of its
    options.

    Required: `corrupt` and `covariance`. Optional: `whitened`, if errors are not normal;
    `true_covariance`, if R is not theirs; `completed`, if options may be left to the model. The
    others are for noise whose level is estimated. Promised: errors have mean zero, covariance R
    unless `true_covariance` is False, and come from `rng` alone.

    >>> import ipe_bench as ib
    >>> from dataclasses import dataclass
    >>> @dataclass(frozen=True)
    ... class Laplace(ib.Noise):
    ...     scale: float = 0.1
    ...     def corrupt(self, h, offset, rng):
    ...         return h + rng.laplace(0.0, self.scale, len(h))
    ...     def covariance(self, m):
    ...         return Covariance(np.full(m, np.sqrt(2) * self.scale))
    ...     def whitened(self, shape, rng):
    ...         return rng.laplace(0.0, np.sqrt(0.5), shape)
    >>> print(ib.Scenario(ib.measurements.Polynomial(), Laplace()).draw(0, 4).z.shape)
    (4, 40)
    """

    real: ClassVar[bool] = False
    """True if readings are not simulated at all, but are those that come with the model."""
    estimated: ClassVar[bool] = False
    """True if the level of the errors is estimated from the residuals, R being known up to a
    factor."""
    true_covariance: bool = True
    """Whether R is that of the errors; False if estimators are given another one on purpose."""

    def completed(self, usual: UsualNoise | None) -> Noise:
        """Returns this noise, with what its options leave out taken from the usual noise of the
        model.

        Raises:
            UserError: the model names none.
        """
        del usual
        return self

    @abstractmethod
    def corrupt(self, h: Array, offset: Array, rng: np.random.Generator) -> Array:
        """Returns the readings z (m,) of one trial, from the error-free h (m,) and what instruments
        show besides it."""

    @abstractmethod
    def covariance(self, m: int) -> Covariance:
        """Returns R of m readings, as estimators assume it."""

    def nominal_covariance(self, model: Measurement) -> Covariance:
        """Returns R of a model's readings, as estimators are given it."""
        return self.covariance(model.m)

    def true_levels(self, m: int) -> tuple[Levels, Array] | None:
        """Returns levels of m readings, and their logarithms (k,), if bounds are to count them as
        unknown."""
        del m

    def levels_of(self, model: Measurement) -> Levels | None:
        """Returns levels of which standard deviations are formulas, if they are to be estimated
        with the parameters."""
        del model

    def whitened(self, shape: tuple[int, ...], rng: np.random.Generator) -> Array | None:
        """Draws errors of whitened readings, R^-1/2 v, if R is right: independent, of mean 0 and
        variance 1; None if they are normal. The test of fit takes its law from here."""
        del shape, rng
