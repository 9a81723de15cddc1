"""The extended and the unscented Kalman filter of Stone Soup on the parameters as a random
constant.

Which readings arrive when, and all that is not a filter, is our own `Sequential`'s; so the two
differ in the equations of the filter alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Annotated, Any

import numpy as np
from annotated_types import Gt, Le
from stonesoup.functions import gauss2sigma
from stonesoup.models.measurement.nonlinear import NonLinearGaussianMeasurement
from stonesoup.types.array import StateVectors
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.prediction import GaussianStatePrediction
from stonesoup.updater.kalman import ExtendedKalmanUpdater, UnscentedKalmanUpdater

from ipe_bench import ConstantFilter, Sequential
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Finite, NonNegative

_NOW = datetime(2000, 1, 1)
"""Stone Soup wants a time; constants do not care which."""


class _Known(NonLinearGaussianMeasurement):
    """What the model reads at the points of an epoch, computed beforehand for all trials at
    once."""

    @property
    def ndim_meas(self) -> int:
        return len(self.noise_covar)

    def know(self, h: Array, H: Array | None) -> None:
        self.h, self.H = h, H

    def function(self, state: Any, noise: Any = False, **options: Any) -> Any:
        return StateVectors(self.h.T)

    def jacobian(self, state: Any, **options: Any) -> Any:
        return self.H


class _OfTrial(ConstantFilter):
    """One trial's filter."""

    def __init__(self, P0: Array, Q: Array, updater: Any) -> None:
        self.state = GaussianStatePrediction(np.zeros((len(P0), 1)), P0, timestamp=_NOW)
        self.Q, self.updater = Q, updater

    @property
    def x(self) -> Array:
        return np.asarray(self.state.state_vector, dtype=float).ravel()

    @property
    def P(self) -> Array:
        return np.asarray(self.state.covar, dtype=float)

    def predict(self) -> None:
        self.state = GaussianStatePrediction(
            self.state.state_vector, self.P + self.Q, timestamp=_NOW
        )

    def points(self) -> Array:
        return self.x[None]

    def update(self, z: Array, h: Array, H: Array | None) -> bool:
        n, m = len(self.P), len(z)
        model = _Known(ndim_state=n, mapping=tuple(range(n)), noise_covar=np.eye(m))
        model.know(h, H)
        seen = Detection(z[:, None], timestamp=_NOW, measurement_model=model)
        self.state = self.updater.update(SingleHypothesis(self.state, seen))
        expected = self.state.hypothesis.measurement_prediction
        y = z - np.asarray(expected.state_vector, dtype=float).ravel()
        self.nis += float(y @ np.linalg.solve(np.asarray(expected.covar, dtype=float), y))
        return True


@dataclass(frozen=True)
class StoneSoupEKF(Sequential):
    """Stone Soup's ExtendedKalmanUpdater, in Joseph's form."""

    slopes = True

    def track(self, P0: Array, Q: Array, z: Array) -> ConstantFilter:
        return _OfTrial(P0, Q, ExtendedKalmanUpdater(measurement_model=None, use_joseph_cov=True))


@dataclass(frozen=True)
class StoneSoupUKF(Sequential):
    """Stone Soup's UnscentedKalmanUpdater, with the points of our own unless told otherwise."""

    alpha: Annotated[float, Gt(0), Le(1)] = 0.1
    """The points lie at alpha sqrt(n + kappa) deviations."""
    beta: Finite = 2.0
    """2 is best for Gaussian parameters."""
    kappa: NonNegative = 0.0
    """Secondary spread of the points."""

    def track(self, P0: Array, Q: Array, z: Array) -> ConstantFilter:
        spread = {"alpha": self.alpha, "beta": self.beta, "kappa": self.kappa}
        updater = UnscentedKalmanUpdater(
            measurement_model=None, force_symmetric_covariance=True, **spread
        )
        return _Unscented(P0, Q, updater)


class _Unscented(_OfTrial):
    def points(self) -> Array:
        """Where the updater will want to be read, in its order."""
        updater = self.updater
        sigma, *_ = gauss2sigma(self.state, updater.alpha, updater.beta, updater.kappa)
        return np.asarray(sigma.state_vector, dtype=float).T
