"""Plugins with one fault each, and those who must not notice; a module, so that workers can import it."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from small_models import Bent

from ipe_bench.basics.linalg import Covariance
from ipe_bench.estimators.base import Estimator
from ipe_bench.noise import Gaussian
from ipe_bench.solvers import Newton


@dataclass(frozen=True)
class Classy(Bent):
    """A model whose nominal point is an array of the class, shared by all instances."""

    nominal: ClassVar[np.ndarray] = np.zeros(3)


@dataclass(frozen=True)
class Vandal(Estimator):
    """Newton's estimate, and a fault."""

    fault: str

    def estimate(self, problem, z, *, history=False):
        estimates = Newton().estimate(problem, z, history=history)
        if self.fault == "covariance":
            return replace(estimates, covariance=100 * estimates.covariance)
        getattr(self, self.fault)(problem, z)
        return estimates

    def readings(self, problem, z):
        z -= 1.0

    def linearization(self, problem, z):
        problem.H[...] = 1.0

    def R(self, problem, z):
        problem.R.factor[...] *= 3.0

    def nominal(self, problem, z):
        problem.x0[...] += 1.0


@dataclass(frozen=True)
class Stopped(Estimator):
    """The user presses Ctrl-C while it estimates."""

    def estimate(self, problem, z, *, history=False):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.01)
        return Newton().estimate(problem, z, history=history)


@dataclass(frozen=True)
class WrongR(Gaussian):
    """Takes the deviation for the variance."""

    def covariance(self, m):
        return Covariance(np.full(m, np.sqrt(self.deviation)))
