"""Runs plans: in machine code on every core, or step by step in NumPy where no machine code can be made.

One lane is one initial value problem, a trial in a case; the lanes of a vector register advance together. The bits of a
lane depend on its own numbers alone: neither on its neighbours, nor on how many threads. Which steps a trial takes is
left to `levels`.
"""

from __future__ import annotations

import functools
import itertools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics import compiled
from ipe_bench.basics.compiled import INTEGER, POINTER, WHOLE, aligned, at
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.machine import cores
from ipe_bench.measurements.ode.plan import Equations, Plan
from ipe_bench.measurements.ode.tableau import Tableau
from ipe_bench.measurements.ode.trace import Program

if TYPE_CHECKING:
    # Imported where something is compiled, and here so that results are known to depend on it.
    from ipe_bench.measurements.ode import emit as emit

_WORTH_THREADS = 40_000
"""Steps times lanes times states from which a second thread gains more than it costs, some 150 microseconds."""
_NARROW = 4
"""Lanes up to which half of the usual vectors do: one simulation of GINS in two thirds of the time."""
_EMIT = Path(__file__).with_name("emit.py")
_ARGUMENTS = tuple(INTEGER if i in (3, 5, 6, 9, 11) else POINTER for i in range(14))


def threads() -> int:
    """Threads that one integration may use: `IPE_BENCH_THREADS`, else every core of this process."""
    chosen = os.environ.get("IPE_BENCH_THREADS")
    return max(1, int(chosen)) if chosen else cores()


@functools.cache
def _pool(workers: int, process: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(workers, thread_name_prefix="ode")


def _compiled(name: str, source: Plan | Program, width: int, arguments: tuple[Any, ...]) -> Callable[..., None]:
    """The function of `emit` by that name."""

    def write() -> str:
        from ipe_bench.measurements.ode import emit

        return getattr(emit, name)(source, width)

    return compiled.load(f"{source} {width} {compiled.digest_of(_EMIT)}", write, name, arguments)


@dataclass(frozen=True)
class Kernel:
    """One kind of integration of some equations by one formula."""

    kind: Callable[[Equations, Tableau], Plan]
    equations: Equations
    tableau: Tableau

    @functools.cached_property
    def plan(self) -> Plan:
        return self.kind(self.equations, self.tableau)

    @functools.cached_property
    def _narrow(self) -> tuple[Callable[..., None], int]:
        return self._machine_code(_NARROW)

    @functools.cached_property
    def _wide(self) -> tuple[Callable[..., None], int]:
        return self._machine_code(compiled.width())

    def _machine_code(self, width: int) -> tuple[Callable[..., None], int]:
        """The function for groups of so many lanes, and the numbers that it needs room for."""
        weights = -(-sum(map(len, self.plan.tableau.weights)) // width)
        return _compiled("integrate", self.plan, width, _ARGUMENTS), (self.plan.size + weights) * width

    def run(
        self,
        x: Array,
        si: Array,
        cases: Array,
        rows: NDArray[np.int64],
        times: Array,
        steps: NDArray[np.int64],
        *more: Array,
    ) -> None:
        """Integrates the trials in these rows of x (trials, n) from time 0, in every case, `steps[k]` equal steps to
        `times[k]`. `cases` has the constants (cases, constants), or where some are driven those of every interval and
        those after the last time (times + 1, cases, constants). The last of `more` takes the results, C-contiguous, in
        the same rows; before it, for simulations, what is subtracted from the readings."""
        count = cases.shape[-2]
        lanes = len(rows) * count
        *offset, out = more
        if bool(offset) != (self.plan.moving is None):
            raise TypeError("simulations take an offset, Jacobians take none")
        if not lanes:
            return
        if not compiled.available():
            interpret(self.plan, x, si, cases, rows, times, steps, *more)
            return
        function, size = self._narrow if lanes <= _NARROW else self._wide
        given = (at(x), at(si), at(cases), count, at(rows, WHOLE))
        stride = len(offset[0]) // count if offset else 0
        taken = (at(times), at(steps, WHOLE), len(times), at(offset[0]) if offset else None, stride, at(out))

        def work_on(pieces: Sequence[tuple[int, int]] | Any) -> None:
            memory, frame = aligned(size)
            for first, last in pieces:
                function(*given, first, last, *taken, frame)
            del memory

        width = compiled.width()
        work = lanes * int(steps[: len(times)].sum()) * self.equations.states * (1 if offset else x.shape[1])
        workers = min(threads(), lanes // width) if work >= _WORTH_THREADS else 1
        if workers <= 1:
            work_on([(0, lanes)])
            return
        # More pieces than threads, so that a core slowed by other work does not hold up the rest.
        shares = min(lanes // width, workers * min(4, max(1, work // _WORTH_THREADS)))
        bounds = [width * (i * (lanes // width) // shares) for i in range(shares)] + [lanes]
        pieces = iter(list(itertools.pairwise(bounds)))
        others = [_pool(workers - 1, os.getpid()).submit(work_on, pieces) for _ in range(workers - 1)]
        work_on(pieces)
        for other in others:
            other.result()


def interpret(
    plan: Plan,
    x: Array,
    si: Array,
    cases: Array,
    rows: NDArray[np.int64],
    times: Array,
    steps: NDArray[np.int64],
    *more: Array,
) -> None:
    """`Kernel.run` operation by operation in NumPy, all lanes at once; products are rounded before they are added."""
    intervals = cases.reshape(-1, *cases.shape[-2:])
    count = intervals.shape[1]
    trial, case = np.repeat(rows, count), np.tile(np.arange(count), len(rows))
    lanes, no, move = len(trial), len(plan.shown), plan.moving
    frame: list[Any] = [np.zeros(lanes)] * plan.size
    out = more[-1].reshape(len(x), count, len(times), no, -1)

    def load(places: Any, beyond: int = 0) -> list[Any]:
        return [frame[i + beyond] for i in places]

    def store(values: Sequence[Any], places: Any) -> None:
        for value, i in zip(values, places, strict=True):
            frame[i] = value

    def advance(y: Sequence[Any], h: float, slope: Callable[[int, list[Any]], list[Any]]) -> list[Any]:
        slopes: list[list[Any]] = []
        end = list(y)
        for s, row in enumerate(plan.tableau.weights):
            end = list(y)
            for j, weight in row:
                end = [e + h * weight * k for e, k in zip(end, slopes[j], strict=True)]
            if s < plan.tableau.stages:
                slopes.append(slope(s, end))
        return end

    with np.errstate(all="ignore"):
        store([x[trial, j] * si[j] for j in range(len(plan.x))], plan.x)
        store(list(intervals[0, case].T), plan.constants)
        store(plan.begin(load([*plan.x, *plan.constants])), plan.begun)
        t = 0.0
        for k, to in enumerate(times.tolist()):
            for s in range(int(steps[k]) if to != t else 0):
                h = (to - t) / int(steps[k])
                since, ny = t + s * h, len(plan.y)

                def slope(stage: int, y: list[Any], since: float = since, h: float = h, ny: int = ny) -> list[Any]:
                    time = [since + plan.tableau.C[stage] * h] if plan.step_timed else []
                    result = plan.step([*time, *y, *load(plan.driven), *load(plan.fixed)])
                    store(result[ny:], plan.kept[stage])
                    return result[:ny]

                store(advance(load(plan.y), h, slope), plan.y)
                for lie, sources in zip(move.lie, move.sources, strict=True) if move else ():

                    def moving(stage: int, d: list[Any], sources: Any = sources, move: Any = move) -> list[Any]:
                        beyond = stage * move.stage_size
                        given = [*d, *load(sources, beyond), *load(move.saved, beyond), *load(plan.fixed)]
                        return move.slope(given)

                    store(advance(load(lie), h, moving), lie)
            t = to
            if plan.driven:
                store(list(intervals[k + 1, case, -len(plan.driven) :].T), plan.driven)
            store(
                plan.read([*([t] if plan.read_timed else []), *load([*plan.y, *plan.driven, *plan.fixed])]), plan.noted
            )
            if move is None:
                less = more[0].reshape(count, -1, no)[case, k]
                for i, value in enumerate(load(plan.shown)):
                    out[trial, case, k, i, 0] = value - less[:, i]
            for j, (lie, sources) in enumerate(zip(move.lie, move.show_sources, strict=True) if move else ()):
                given = [*load(lie), *load(sources), *load(move.show_saved), *load(plan.fixed)] if move else []
                for i, value in enumerate(move.show(given) if move else ()):
                    out[trial, case, k, i, j] = value * si[j]


@dataclass(frozen=True)
class Rates:
    """One number of each trial's parameters, as a recorded program computes it."""

    program: Program

    @functools.cached_property
    def _machine_code(self) -> Callable[..., None]:
        return _compiled("rates", self.program, 1, (POINTER, POINTER, POINTER, INTEGER))

    def __call__(self, x: Array, si: Array, out: Array) -> None:
        """Of the parameters x (trials, n) times si."""
        if compiled.available():
            self._machine_code(at(x), at(si), at(out), len(x))
        else:
            with np.errstate(all="ignore"):
                out[:] = self.program(list((x * si).T))[0]
