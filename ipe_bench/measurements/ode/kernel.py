"""Compiles integrators of readings and of Jacobians, and runs them on every core.

One lane is one initial value problem, a trial in a case; `WIDTH` lanes advance together in vector instructions. The
bits of a lane depend on its own numbers alone: neither on its neighbours, nor on the width, nor on how many threads.
What is compiled is written by `source`; which steps a trial takes is left to `levels`.
"""

from __future__ import annotations

import functools
import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.compiled import load
from ipe_bench.basics.machine import cores
from ipe_bench.measurements.ode.source import Equations, Source
from ipe_bench.measurements.ode.tableau import Tableau

WIDTH = 8
"""Lanes that advance together: one register of AVX-512."""
NARROW = 4
"""The same for what is left over, and for small batches."""
_WORTH_THREADS = 40_000
"""Steps times lanes times states from which a second thread gains more than it costs, some 150 microseconds."""


def threads() -> int:
    """Threads that one integration may use: `IPE_BENCH_THREADS`, else every core of this process."""
    chosen = os.environ.get("IPE_BENCH_THREADS")
    return max(1, int(chosen)) if chosen else cores()


@functools.cache
def _pool(workers: int, process: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(workers, thread_name_prefix="ode")


@dataclass(frozen=True)
class Kernel:
    """One kind of integration, compiled for full groups of lanes and for what is left over."""

    source: Callable[[Equations, Tableau, int], Source]
    equations: Equations
    tableau: Tableau

    @functools.cached_property
    def _source(self) -> Source:
        return self.source(self.equations, self.tableau, WIDTH)

    @property
    def operations(self) -> int:
        """Of one step of one lane: what a step costs, whatever the machine."""
        return self._source.operations

    @functools.cached_property
    def _wide(self) -> Callable[..., None]:
        return _with_room(self._source, WIDTH)

    @functools.cached_property
    def _narrow(self) -> Callable[..., None]:
        return _with_room(self.source(self.equations, self.tableau, NARROW), NARROW)

    def run(
        self,
        x: NDArray[np.float64],
        si: NDArray[np.float64],
        cases: NDArray[np.float64],
        rows: NDArray[np.int64],
        times: NDArray[np.float64],
        steps: NDArray[np.int64],
        *more: NDArray[np.float64],
    ) -> None:
        """Integrates the trials in these rows of x (trials, n) from time 0, in every case, `steps[k]` equal steps to
        `times[k]`. The last of `more` takes the results, C-contiguous, in the same rows; before it, for simulations,
        what is subtracted from the readings."""
        lanes = len(rows) * len(cases)
        if not lanes:
            return
        left = lanes % WIDTH
        full = lanes - left if 0 < left <= NARROW else lanes
        arguments = (x, si, cases, rows)
        if full < lanes:
            self._narrow(*arguments, full, lanes, times, steps, *more)
        if not full:
            return
        work = full * int(steps[: len(times)].sum()) * self.equations.states * (1 if len(more) > 1 else x.shape[1])
        workers = min(threads(), full // WIDTH) if work >= _WORTH_THREADS else 1
        if workers <= 1:
            self._wide(*arguments, 0, full, times, steps, *more)
            return
        # More pieces than threads, so that a core slowed by other work does not hold up the rest.
        count = min(full // WIDTH, workers * min(4, max(1, work // _WORTH_THREADS)))
        bounds = [WIDTH * (i * (full // WIDTH) // count) for i in range(count)] + [full]
        pieces = iter(list(itertools.pairwise(bounds)))

        def work_on() -> None:
            for first, last in pieces:
                self._wide(*arguments, first, last, times, steps, *more)

        others = [_pool(workers - 1, os.getpid()).submit(work_on) for _ in range(workers - 1)]
        work_on()
        for other in others:
            other.result()


def _with_room(source: Source, width: int) -> Callable[..., None]:
    """What a source integrates, given the room that it needs."""
    integrate = load(source.text)

    def function(*arguments: Any) -> None:
        integrate(*arguments, np.empty(source.work), np.empty(2 * width, np.int64))

    return function
