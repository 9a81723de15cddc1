"""Compiles a recorded right-hand side into a batched fixed-step integrator, and runs it on every core.

The method is the eighth-order Runge-Kutta formula of Dormand and Prince (the coefficients of DOP853; Hairer, Norsett,
Wanner, Solving Ordinary Differential Equations I, II.5) at a fixed step. One lane is one initial value problem; `WIDTH`
lanes advance together, so that the compiler turns each operation into SIMD instructions. A lane's bits depend on
nothing but its own numbers: neither on its neighbours nor on the number of threads.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import itertools
import os
import sys
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import DOP853

from ipe_bench.basics.machine import cores
from ipe_bench.measurements.ode.trace import Expression, Graph, emit, tangent

WIDTH = 16
"""Lanes that advance together: two registers of eight doubles."""

_STAGES = 12
_A: list[list[float]] = DOP853.A[:_STAGES, :_STAGES].tolist()
_B: list[float] = DOP853.B[:_STAGES].tolist()
_C: list[float] = DOP853.C[:_STAGES].tolist()

Arithmetic = Callable[..., Sequence[Any]]


@dataclass(frozen=True)
class Recording:
    """The source of one right-hand side and of what is read from its state, ready to be compiled."""

    states: int
    inputs: int
    outputs: int
    source: str


def record(rhs: Arithmetic, read: Arithmetic, states: int, inputs: int, outputs: int, *, varying: int = 0) -> Recording:
    """Records `rhs(t, y, p)` and `read(t, y, p)`, or their derivative along a direction of the first `varying` inputs.

    y has `states` entries, p has `inputs` and what is read has `outputs`. For a derivative the tangents of the state
    follow y, the direction follows p, and the tangents of the outputs are read in place of the outputs. The variational
    equations are integrated as part of the system itself, so the derivative is that of the numerical solution, exact to
    round-off.
    """
    graph = Graph()
    t = graph.input("t")
    y = graph.inputs("y", states * 2 if varying else states)
    p = graph.inputs("p", inputs + varying)
    direction = dict(zip(y[:states] + p[:varying], y[states:] + p[inputs:], strict=True)) if varying else {}

    def values(function: Arithmetic, count: int, name: str) -> list[Expression]:
        result = [graph.apply("add", v, 0.0) for v in function(t, y[:states], p[:inputs])]
        if len(result) != count:
            raise ValueError(f"{name} returns {len(result)} values where {count} are declared")
        return result

    slope, shown = values(rhs, states, "rhs"), values(read, outputs, "read")
    if varying:
        slope, shown = slope + tangent(slope, direction), tangent(shown, direction)
    return Recording(len(y), len(p), outputs, _source(len(y), len(p), emit(slope), emit(shown)))


def _source(states: int, inputs: int, rhs: tuple[str, list[str]], read: tuple[str, list[str]]) -> str:
    y = [f"y{i}" for i in range(states)]
    p = [f"p{i}" for i in range(inputs)]
    nonzero = [(s, j) for s in range(_STAGES) for j in range(s) if _A[s][j] != 0.0]
    used = [s for s in range(_STAGES) if _B[s] != 0.0]

    def combine(i: int, terms: list[tuple[str, int]]) -> str:
        return " + ".join([f"y{i}", *(f"{factor} * k{s}_{i}" for factor, s in terms)])

    stages = []
    for s in range(_STAGES):
        at = [combine(i, [(f"a{s}_{j}", j) for z, j in nonzero if z == s]) for i in range(states)]
        slopes = ", ".join(f"k{s}_{i}" for i in range(states))
        stages.append(f"        {slopes}, = rhs(t + {_C[s]!r} * h, {', '.join(at + p)})\n")
    ends = [f"        y[{i * WIDTH} + lane] = {combine(i, [(f'b{s}', s) for s in used])}\n" for i in range(states)]
    load = "".join(f"        {name} = y[{i * WIDTH} + lane]\n" for i, name in enumerate(y + p))
    store = "".join(f"        out[place[lane] + {i} * stride] = {term}\n" for i, term in enumerate(read[1]))
    constants = "".join(f"    a{s}_{j} = h * {_A[s][j]!r}\n" for s, j in nonzero)
    constants += "".join(f"    b{s} = h * {_B[s]!r}\n" for s in used)
    fast = "nogil=True, cache=True, error_model='numpy', fastmath={'contract', 'nsz'}"
    return f'''"""Written by ipe_bench.measurements.ode.kernel; its name is a digest of its text."""

import math

import numpy as np
from numba import njit


@njit({fast}, forceinline=True)
def rhs(t, {", ".join(y + p)}):
{rhs[0]}    return ({", ".join(rhs[1])},)


@njit({fast})
def step(t, h, y):
{constants}    for lane in range({WIDTH}):
{load}{"".join(stages)}{"".join(ends)}

@njit({fast})
def read(t, y, place, stride, out):
    for lane in range({WIDTH}):
{load}{read[0].replace("    ", "        ")}{store}

@njit({fast})
def integrate(y, start, times, substeps, first, stride, out):
    place = np.empty({WIDTH}, np.int64)
    for group in range(y.shape[0]):
        t = start
        place[:] = first[group]
        for k in range(times.shape[0]):
            h = (times[k] - t) / substeps[k]
            for s in range(substeps[k]):
                step(t + s * h, h, y[group])
            t = times[k]
            read(t, y[group], place, stride, out)
            place += {len(read[1])} * stride
'''


def _cache_folder() -> Path:
    """Where generated modules and their machine code are kept between processes."""
    chosen = os.environ.get("IPE_BENCH_CACHE")
    base = Path(chosen) if chosen else Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "ipe-bench"
    try:
        base.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=base):
            return base
    except OSError:
        return Path(tempfile.mkdtemp(prefix="ipe-bench-"))


@functools.cache
def _load(source: str) -> ModuleType:
    """The module of a generated source, compiled at most once per machine."""
    name = f"ipe_bench_kernel_{hashlib.sha256(source.encode()).hexdigest()[:16]}"
    path = _cache_folder() / f"{name}.py"
    if not path.exists():
        with tempfile.NamedTemporaryFile("w", dir=path.parent, suffix=".tmp", delete=False) as file:
            file.write(source)
        os.replace(file.name, path)
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def threads() -> int:
    """Threads that one integration may use: `IPE_BENCH_THREADS`, else every core of this process."""
    chosen = os.environ.get("IPE_BENCH_THREADS")
    return max(1, int(chosen)) if chosen else cores()


@functools.cache
def _pool(workers: int, process: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(workers, thread_name_prefix="ode")


def integrate(
    recording: Recording,
    y0: NDArray[np.float64],
    p: NDArray[np.float64],
    times: NDArray[np.float64],
    substeps: NDArray[np.int64],
    out: NDArray[np.float64],
    first: NDArray[np.int64],
    stride: int = 1,
) -> None:
    """Integrates every lane from time 0 and reads it at every time.

    y0 (lanes, states), p (lanes, inputs); `substeps[k]` equal steps lead to `times[k]`. What is read of lane i goes to
    `out.flat` at `first[i]`, `first[i] + stride` and so on, in order of time and output: where it is wanted, because
    moving it later costs as much as a third of the integration.
    """
    groups = -(-len(y0) // WIDTH)
    run = _load(recording.source).integrate
    y = _in_groups(np.concatenate([y0, p], axis=1), groups)
    # The lanes that fill up the last group repeat its last lane, to the same place.
    place = first[np.minimum(np.arange(groups * WIDTH), len(first) - 1)].reshape(groups, WIDTH)
    flat = out.reshape(-1)
    workers = min(threads(), groups)
    if workers == 1:
        run(y, 0.0, times, substeps, place, stride, flat)
        return
    # More pieces than threads, so that a core slowed by other work does not hold up the rest.
    bounds = np.linspace(0, groups, min(groups, 4 * workers) + 1).astype(int)
    pieces = [slice(a, b) for a, b in itertools.pairwise(bounds)]
    pool = _pool(workers, os.getpid())
    list(pool.map(lambda piece: run(y[piece], 0.0, times, substeps, place[piece], stride, flat), pieces))


def _in_groups(values: NDArray[np.float64], groups: int) -> NDArray[np.float64]:
    """(lanes, k) as (groups, k * WIDTH); the last group is filled up with copies of the last lane."""
    missing = groups * WIDTH - len(values)
    filled = np.concatenate([values, np.repeat(values[-1:], missing, axis=0)]) if missing else values
    return np.ascontiguousarray(filled.reshape(groups, WIDTH, -1).transpose(0, 2, 1)).reshape(groups, -1)
