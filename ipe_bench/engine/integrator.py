"""Runs plans in machine code on every core.

One lane is one initial value problem, a trial in a case; the lanes of a vector register advance
together. The bits of a lane depend on its own numbers alone: neither on its neighbours, nor on how
many threads.
"""

from __future__ import annotations

import functools
import importlib
import itertools
import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.machine import cores
from ipe_bench.engine import compiled
from ipe_bench.engine.compiled import INTEGER, POINTER, WHOLE, aligned, at
from ipe_bench.engine.equations import Equations
from ipe_bench.engine.plan import StepPlan, planned
from ipe_bench.engine.tableaus import Tableau
from ipe_bench.engine.trace import Program, RowPrograms

if TYPE_CHECKING:
    # Imported where something is compiled, and here so that results are known to depend on it.
    from ipe_bench.engine import emit as emit

_WORTH_THREADS = 40_000
"""Steps times lanes times states from which a second thread gains more than it costs, some 150
microseconds."""
_NARROW = 4
"""Lanes up to which half of the usual vectors do: one simulation of GINS in two thirds of the
time."""
Integers = NDArray[np.integer[Any]]
_ARGUMENTS = (
    *(POINTER, POINTER, POINTER, INTEGER, POINTER),  # x, si, cases, n_cases, rows
    *(INTEGER, INTEGER),  # first, last
    *(POINTER, POINTER, INTEGER),  # times, steps, n_times
    *(POINTER, INTEGER, POINTER),  # offset, stride, out
    *(POINTER, POINTER),  # states, frame
)
"""Those of the function that `emit.integrator` describes."""


def threads() -> int:
    """Returns the number of threads that one integration may use: `IPE_BENCH_THREADS`, else every
    core of this process."""
    chosen = os.environ.get("IPE_BENCH_THREADS")
    if not chosen:
        return cores()
    try:
        return max(1, int(chosen))
    except ValueError:
        raise UserError(f"IPE_BENCH_THREADS={chosen}: give a whole number above 0") from None


@functools.cache
def _pool(workers: int, process: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(workers, thread_name_prefix="ode")


def emitted(
    name: str,
    source: StepPlan | Program | RowPrograms,
    width: int,
    arguments: tuple[Any, ...],
) -> Callable[..., None]:
    """Returns the compiled function of `emit` by that name."""

    def write() -> str:
        return getattr(importlib.import_module("ipe_bench.engine.emit"), name)(source, width)

    return compiled.load(
        f"{source} {width} {compiled.digest_of(*compiled.EMITTING)}", write, name, arguments
    )


@dataclass(frozen=True)
class Kernel:
    """Integrates some equations by one formula, for readings or, if `sensitive`, for Jacobians."""

    equations: Equations
    tableau: Tableau
    sensitive: bool = False

    @functools.cached_property
    def plan(self) -> StepPlan:
        return planned(self.equations, self.tableau, sensitive=self.sensitive)

    @functools.cached_property
    def _narrow(self) -> tuple[Callable[..., None], int]:
        return self._machine_code(_NARROW)

    @functools.cached_property
    def _wide(self) -> tuple[Callable[..., None], int]:
        return self._machine_code(compiled.width())

    def _machine_code(self, width: int) -> tuple[Callable[..., None], int]:
        """Returns the function for groups of so many lanes, and the numbers that it needs room
        for."""
        # Behind the plan's vectors lie h times the weights of the formula, in whole vectors.
        weights = sum(map(len, self.plan.tableau.weights))
        vectors = self.plan.size + -(-weights // width)
        return emitted("integrate", self.plan, width, _ARGUMENTS), vectors * width

    def run(
        self,
        x: Array,
        si: Array,
        cases: Array,
        rows: Integers,
        times: Array,
        steps: Integers,
        *more: Array,
        states: Array | None = None,
    ) -> None:
        """Integrates the trials in these rows of x (trials, n) from time 0, in every case,
        `steps[k]` equal steps to `times[k]`. `cases` has the constants (cases, constants), or where
        some are driven those of every interval and those after the last time (times + 1, cases,
        constants). The last of `more` takes the results, C-contiguous, in the same rows; before it,
        for simulations, what is subtracted from the readings. `states` (trials, cases, states,
        times + 1) takes those at the start and at each time; where steps are watched, behind the
        states, 1 once one was rough or crossed a pole."""
        count = cases.shape[-2]
        lanes = len(rows) * count
        if not lanes:
            return
        *offset, out = more
        stride = 0
        subtracted = None
        if offset:
            stride = len(offset[0]) // count
            subtracted = at(offset[0])
        problems = (at(x), at(si), at(cases), count, at(rows, WHOLE))
        results = (at(times), at(steps, WHOLE), len(times), subtracted, stride, at(out))
        kept = None if states is None else at(states)
        # The frame is as wide as the lanes need.
        function, size = self._narrow if lanes <= _NARROW else self._wide

        def work_on(pieces: Iterable[tuple[int, int]]) -> None:
            memory, frame = aligned(size)
            for first, last in pieces:
                function(*problems, first, last, *results, kept, frame)
            # Until here the frame lies in this memory.
            del memory

        work = self._work(x, lanes, steps[: len(times)])
        full = lanes // compiled.width()
        workers = min(threads(), full) if work >= _WORTH_THREADS else 1
        if workers <= 1:
            work_on([(0, lanes)])
            return
        # Threads take one piece after another from one iterator.
        pieces = iter(_pieces(lanes, work, workers))
        pool = _pool(workers - 1, os.getpid())
        others = [pool.submit(work_on, pieces) for _ in range(workers - 1)]
        work_on(pieces)
        for other in others:
            other.result()

    def _work(self, x: Array, lanes: int, steps: Integers) -> int:
        """Returns steps times lanes times states; a Jacobian costs a tangent for each parameter."""
        work = lanes * int(steps.sum()) * self.equations.states
        return work * x.shape[1] if self.sensitive else work


def _pieces(lanes: int, work: int, workers: int) -> list[tuple[int, int]]:
    """Cuts lanes into whole vectors: more pieces than threads, so that a core slowed by other work
    does not hold up the rest."""
    width = compiled.width()
    full = lanes // width
    each = min(4, max(1, work // _WORTH_THREADS))
    shares = min(full, workers * each)
    bounds = [width * (i * full // shares) for i in range(shares)]
    return list(itertools.pairwise([*bounds, lanes]))


def compiled_rates(program: Program) -> Callable[[Array, Array, Array], None]:
    """Compiles a function that fills its third argument (trials,) with the number that a recorded
    program computes of the parameters x (trials, n), times their sizes (n,)."""
    function = emitted("rates", program, 1, (POINTER, POINTER, POINTER, INTEGER))
    return lambda x, si, out: function(at(x), at(si), at(out), len(x))
