"""Plugins with one fault each, and those who must not notice; a module, so that workers can import it."""

from __future__ import annotations

import ctypes
import os
import random
import signal
import threading
import time
import warnings
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from small_models import Bent

from ipe_bench.basics.linalg import Covariance
from ipe_bench.estimators.base import Estimator
from ipe_bench.noise import Gaussian
from ipe_bench.solvers import Newton

UPWARD = 0x800
"""FE_UPWARD of x86-64."""


@dataclass(frozen=True)
class Classy(Bent):
    """A model whose nominal point is an array of the class, shared by all instances."""

    nominal: ClassVar[np.ndarray] = np.zeros(3)


class Panic(BaseException):
    """As that of a Rust extension."""


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

    def readings_by_force(self, problem, z):
        z.flags.writeable = True
        z -= 1.0

    def linearization(self, problem, z):
        problem.H[...] = 1.0

    def R(self, problem, z):
        problem.R.factor[...] *= 3.0

    def R_by_force(self, problem, z):
        (problem.R.factor if problem.R.factor.base is None else problem.R.factor.base)[...] *= 3.0

    def model(self, problem, z):
        object.__setattr__(problem.measurement, "bend", 0.5)

    def nominal(self, problem, z):
        problem.x0[...] += 1.0

    def nominal_by_force(self, problem, z):
        problem.measurement.nominal[...] += 1.0

    def interrupt(self, problem, z):
        raise KeyboardInterrupt("of its own")

    def panic(self, problem, z):
        raise Panic("of its own")

    def generator_exit(self, problem, z):
        raise GeneratorExit

    def seed(self, problem, z):
        np.random.seed(0)  # noqa: NPY002  the fault
        random.seed(0)

    def folder(self, problem, z):
        os.chdir("/")

    def floating_point(self, problem, z):
        np.seterr(all="raise")
        warnings.simplefilter("error", UnicodeWarning)
        ctypes.CDLL(None).fesetround(UPWARD)

    def handler(self, problem, z):
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, signal.SIG_IGN)

    def thread(self, problem, z):
        threading.Thread(target=scribble, args=(problem, z), daemon=True).start()


def scribble(problem, z):
    """Writes to all that it was given for half a second, whatever it takes."""
    end = time.monotonic() + 0.5
    while time.monotonic() < end:
        for a in (z, problem.H, problem.R.factor, problem.x0, problem.prior_deviation, problem.measurement.nominal):
            while a is not None:
                try:
                    a.flags.writeable = True
                    a[...] = 7.0
                except ValueError:
                    pass
                a = a.base
        object.__setattr__(problem.measurement, "bend", 0.5)
        time.sleep(0.001)


@dataclass(frozen=True)
class Bystander(Estimator):
    """A plugin that is slow and does no wrong; it reports what it sees of the process."""

    def estimate(self, problem, z, *, history=False):
        time.sleep(0.05)
        estimates = Newton().estimate(problem, z, history=history)
        third = np.ones(len(z)) / np.float64(3.0)
        seen = {"third": third, "filters": np.full(len(z), sum(f[2] is UnicodeWarning for f in warnings.filters))}
        return replace(estimates, extras=seen)


@dataclass(frozen=True)
class Stopped(Bystander):
    """The user presses Ctrl-C while it estimates."""

    swallows: bool = False

    def estimate(self, problem, z, *, history=False):
        try:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.01)
        except BaseException:
            if not self.swallows:
                raise
        return super().estimate(problem, z, history=history)


@dataclass(frozen=True)
class WrongR(Gaussian):
    """Takes the deviation for the variance."""

    def covariance(self, m):
        return Covariance(np.full(m, np.sqrt(self.deviation)))
