"""Estimators and tasks that misbehave in every way that a plugin can; a module, so that workers can
import it."""

import os
import signal
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ipe_bench.estimators.base import Estimates, Estimator
from ipe_bench.runs.execution import PREPARED

_begun: set[int] = set()


@dataclass(frozen=True)
class Rogue(Estimator):
    """Estimates nothing but zeros, or does what it says; `until` names a file from whose existence
    on it behaves."""

    does: str
    until: str = ""

    def estimate(self, problem, z, *, history=False):
        n = problem.measurement.n
        if not (self.until and Path(self.until).exists()):
            if self.until and self.does == "kill":
                Path(self.until).touch()
            self.misbehave(problem, z)
            if self.does == "shape":
                n += 1
            if self.does == "row":
                return Estimates(np.zeros(n), np.zeros(len(z), dtype=np.int8))
        estimates = Estimates(np.zeros((len(z), n)), np.zeros(len(z), dtype=np.int8))
        if self.does == "boast":
            estimates.x[0] = np.nan
        if self.does.startswith(("simulations", "iterations", "status")):
            name, value = self.does.split()
            setattr(estimates, name, None if value == "None" else np.full(len(z), float(value)))
        if self.does.startswith("masked"):
            mask = np.zeros((len(z), n), dtype=bool)
            mask[0, :1] = mask[:, -1] = self.does == "masked"
            mask[0, 1] = True
            estimates.x = np.ma.masked_array(estimates.x, mask)
            estimates.covariance = np.ma.masked_array(
                np.broadcast_to(np.eye(n), (len(z), n, n)), mask=True
            )
        if self.does == "matrix":
            estimates.x = np.matrix(estimates.x)
        if self.does == "history":
            estimates.history = [np.zeros((2, n))]
        return estimates

    def misbehave(self, problem, z):
        match self.does:
            case "sleep" if len(z) > 1:  # not while it is prepared
                time.sleep(3600)
            case "compile" if len(z) == 1:
                time.sleep(3)
            case "exit":
                os._exit(7)
            case "sys_exit":
                raise SystemExit(3)
            case "kill":
                os.kill(os.getpid(), signal.SIGKILL)
            case "memory":
                hog = []
                while True:
                    hog.append(np.ones(1_000_000))
            case "once":
                if os.getpid() not in _begun:
                    _begun.add(os.getpid())
                    time.sleep(0.5)
            case "raise":
                raise ArithmeticError("rogue")
            case "surrogate":
                raise ArithmeticError("\ud800" + 10_000_000 * "x")
            case "stop":  # the user presses Ctrl-C
                os.kill(os.getpid(), signal.SIGINT)
                time.sleep(0.01)
            case "z" | "H" | "R" | "x0":
                {"z": z, "H": problem.H, "R": problem.R.factor, "x0": problem.x0}[self.does][
                    ...
                ] += 1.0


def surroundings(task):
    """What a worker sees: its process, its BLAS threads, and the threads that compiled models may
    use."""
    from threadpoolctl import threadpool_info

    from ipe_bench.engine.integrator import threads

    np.linalg.inv(np.eye(3))
    yield os.getpid(), [pool["num_threads"] for pool in threadpool_info()], threads()


def square(task):
    yield from (task * i for i in range(3))
    if task == 2:
        raise ValueError("two\nis refused")


def leave_a_child(task):
    yield subprocess.Popen(["sleep", "3600"]).pid
    yield PREPARED
    time.sleep(3600)


def doze(task):
    yield os.getpid()
    time.sleep(3600)
