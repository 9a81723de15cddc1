"""Writes the modules that integrate recorded equations: of readings, of Jacobians, and of how fast a trial turns.

What is recorded is said by `Equations`. The modules call what `machine_code` makes of the recorded programs; compiling
and running them is left to `kernel`.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ipe_bench.measurements.ode.tableau import Tableau
from ipe_bench.measurements.ode.trace import (
    Expression,
    Graph,
    Program,
    border,
    dependent,
    in_order,
    separate,
    substitute,
    tangent,
)

if TYPE_CHECKING:
    # The modules that are written here import it: where results depend on this source, they depend on that.
    from ipe_bench.measurements.ode import machine_code as machine_code

_TOGETHER = 2
"""Tangents that are integrated side by side: one alone would wait for its own results."""

Arithmetic = Callable[..., Sequence[Any]]


@dataclass(frozen=True)
class Variation:
    """The equations of small deviations, where fewer numbers than the state has describe them."""

    freedoms: int
    slope: Arithmetic
    """(t, y, p, c, d, dp): the time derivative of a deviation d (freedoms,) along the direction dp (n,)."""
    moved: Arithmetic
    """(y, d): by how much the state (states,) deviates, linear in d."""


@dataclass(frozen=True)
class Equations:
    """What is integrated: functions that can be recorded, and the numbers of their arguments and results."""

    states: int
    parameters: int
    constants: int
    outputs: int
    start: Arithmetic
    rhs: Arithmetic
    read: Arithmetic
    variation: Variation | None = None
    rate: Callable[..., Any] | None = None


class _Tape:
    """The equations as expressions."""

    def __init__(self, equations: Equations) -> None:
        self.equations = equations
        graph = self.graph = Graph()
        self.t = graph.input("t")
        self.y, self.p = graph.inputs("y", equations.states), graph.inputs("p", equations.parameters)
        self.c = graph.inputs("c", equations.constants)
        self.start = self._values(equations.start(self.p, self.c), equations.states, "start")
        self.slope = self._values(equations.rhs(self.t, self.y, self.p, self.c), equations.states, "rhs")
        self.shown = self._values(equations.read(self.t, self.y, self.p, self.c), equations.outputs, "read")

    def _values(self, result: Iterable[Any], count: int, name: str) -> list[Expression]:
        values = [self.graph.apply("add", v, 0.0) for v in result]
        if len(values) != count:
            raise ValueError(f"{name} returns {len(values)} values where {count} are declared")
        return values

    def fixed(self, *outputs: Expression) -> list[Expression]:
        """What is computed once for each lane: it depends on the parameters and the case alone."""
        return border(outputs, dependent(outputs, (self.t, *self.y)))

    def along_the_way(self, outputs: Sequence[Expression], fixed: Sequence[Expression]) -> tuple[Program, bool]:
        """The program that computes the outputs from the state, and whether it needs the time."""
        timed = self.t in in_order(outputs, fixed)
        return Program.of(outputs, [*([self.t] if timed else []), *self.y, *fixed]), timed

    def beginning(self, outputs: Sequence[Expression]) -> Program:
        return Program.of(outputs, [*self.p, *self.c])


class _Linear:
    """Tangents of some outputs: their program, what it needs of the state, and the sources of each direction."""

    def __init__(self, tape: _Tape, tangents: Sequence[Expression], d: Sequence[Expression], dp: Sequence[Expression]):
        outputs, sources = separate(tangents, d, dp)
        names = [tape.graph.input(f"source{i}") for i in range(len(sources))]
        one, zero = tape.graph.constant(1.0), tape.graph.constant(0.0)
        self.sources = [
            [substitute(s, {e: one if i == k else zero for i, e in enumerate(dp)}) for s in sources]
            for k in range(len(dp))
        ]
        """The value (n, sources) of each source along each parameter."""
        needed = border(outputs, dependent(outputs, (*d, *names)))
        values = [e for row in self.sources for e in row]
        varying = dependent([*needed, *values], (tape.t, *tape.y))
        self.fixed = [e for e in needed if e not in varying]
        self.saved = [e for e in needed if e in varying]
        self.driving = _distinct(e for e in values if e in varying and e not in self.saved)
        self.constant = _distinct(e for e in values if e not in varying)
        self.inputs, self.outputs = [*d, *names, *self.saved], outputs

    def program(self, fixed: Sequence[Expression]) -> Program:
        return Program.of(self.outputs, [*self.inputs, *fixed])

    def places(self, begin: int, width: int) -> list[list[int]]:
        """Where each direction finds its sources in what is saved from `begin` on."""
        order = {e: i for i, e in enumerate([*self.saved, *self.driving, *self.constant])}
        return [[begin + order[e] * width for e in row] for row in self.sources]


def _distinct(expressions: Iterable[Expression]) -> list[Expression]:
    return list(dict.fromkeys(expressions))


@dataclass(frozen=True)
class Source:
    """A module to be compiled, and the arithmetic operations of one step of one lane."""

    text: str
    operations: int
    work: int
    """Numbers that it needs room for, which its caller gives it; and two whole numbers for each lane."""


def _operations(program: Program, tableau: Tableau, states: int) -> int:
    """Operations of a step: of the program in every stage, and of the weighted sums between them."""
    counted = sum(name not in ("constant", "neg") for name, *_ in program.operations)
    return tableau.stages * counted + states * sum(map(len, tableau.weights))


def simulation_source(equations: Equations, tableau: Tableau, width: int) -> Source:
    """The module whose `integrate` computes readings."""
    tape = _Tape(equations)
    fixed = tape.fixed(*tape.slope, *tape.shown)
    step, step_timed = tape.along_the_way(tape.slope, fixed)
    read, read_timed = tape.along_the_way(tape.shown, fixed)
    ns, no = equations.states, equations.outputs
    out = (ns + len(fixed)) * width
    weights = out + no * width
    size = weights + sum(map(len, tableau.weights))
    places = f"Places(states={ns}, fixed={len(fixed)}, weights={weights}, out={out}, size={size})"
    stores = [i * width for i in range(ns + len(fixed))]
    begin = tape.beginning([*tape.start, *fixed])
    operations = _operations(step, tableau, ns)
    text = f'''{_header(tableau)}
places = {places}
begin = machine_code.beginner({begin!r}, {stores}, {equations.parameters}, {equations.constants})
step = machine_code.stepper({width}, formula, {step!r}, places, {step_timed})
read = machine_code.reader({width}, {read!r}, places, places.out, {read_timed})


@njit("{_SIMULATE}", error_model="numpy")
def integrate(x, si, cases, rows, first, last, times, steps, offset, out, work, lanes):
    b = work[(-work.ctypes.data // 8) % 8:]
    place = lanes[:{width}]
    shift = lanes[{width}:]
    per_case = times.shape[0] * {no}
    for group in range(first, last, {width}):
        for lane in range({width}):
            problem = min(group + lane, last - 1)
            trial = rows[problem // cases.shape[0]]
            case = problem % cases.shape[0]
            begin(b, lane, x, trial, si, cases, case)
            place[lane] = (trial * cases.shape[0] + case) * per_case
            shift[lane] = case * (offset.shape[0] // cases.shape[0])
        t = 0.0
        h = np.nan
        for k in range(times.shape[0]):
            before = h
            h = (times[k] - t) / steps[k]
            if h != before:
                for i in range(weights.shape[0]):
                    b[{weights} + i] = h * weights[i]
            for s in range(steps[k]):
                step(b, t + s * h, h)
            t = times[k]
            read(b, t, h)
            for lane in range({width}):
                for i in range({no}):
                    out[place[lane] + i] = b[{out} + i * {width} + lane] - offset[shift[lane] + i]
                place[lane] += {no}
                shift[lane] += {no}
'''
    return Source(text, operations, size + 8)


def jacobian_source(equations: Equations, tableau: Tableau, width: int) -> Source:
    """The module whose `integrate` computes Jacobians: the state once, and beside it one tangent for each parameter.

    The variational equations go through the stages of the state's own steps, so the derivative is that of the
    numerical solution, exact to round-off; or of the model's own equations of small deviations, to the tolerance.
    """
    tape = _Tape(equations)
    n, ns, no = equations.parameters, equations.states, equations.outputs
    stages, (d, dp, slopes, shown, starts) = tableau.stages, _tangents(tape)
    nd = len(d)
    motion, reading = _Linear(tape, slopes, d, dp), _Linear(tape, shown, d, dp)
    saved = [*motion.saved, *motion.driving]
    noted = [*reading.saved, *reading.driving]
    fixed = _distinct([*tape.fixed(*tape.slope, *saved, *noted), *motion.fixed, *reading.fixed])
    step, step_timed = tape.along_the_way([*tape.slope, *saved], fixed)
    note, note_timed = tape.along_the_way(noted, fixed)
    tangents = (ns + len(fixed)) * width
    stage, stage_size = tangents + n * nd * width, (len(saved) + len(motion.constant)) * width
    at_reading = stage + stages * stage_size
    out = at_reading + (len(noted) + len(reading.constant)) * width
    weights = out + no * width
    size = weights + sum(map(len, tableau.weights))
    places = (
        f"Places(states={ns}, fixed={len(fixed)}, weights={weights}, tangents={nd}, stage={stage}, "
        f"stage_size={stage_size}, stage_values={len(motion.saved)}, reading={at_reading}, "
        f"reading_values={len(reading.saved)}, out={out}, size={size})"
    )
    started = [*tape.start, *fixed, *(e for row in starts for e in row)]
    stores = [i * width for i in range(len(started))]
    for s in range(stages):
        started += motion.constant
        stores += [stage + s * stage_size + (len(saved) + i) * width for i in range(len(motion.constant))]
    started += reading.constant
    stores += [at_reading + (len(noted) + i) * width for i in range(len(reading.constant))]
    begin = tape.beginning(started)
    paired = n - n % _TOGETHER
    operations = _operations(step, tableau, ns) + n * _operations(motion.program(fixed), tableau, nd)
    text = f'''{_header(tableau)}
places = {places}
sources = np.array({motion.places(stage, width)!r}, dtype=np.int64).reshape({n}, -1)
reading_sources = np.array({reading.places(at_reading, width)!r}, dtype=np.int64).reshape({n}, -1)
begin = machine_code.beginner({begin!r}, {stores}, {n}, {equations.constants})
step = machine_code.stepper({width}, formula, {step!r}, places, {step_timed})
note = machine_code.reader({width}, {note!r}, places, places.reading, {note_timed})
motion = {motion.program(fixed)!r}
step_tangents = machine_code.tangent_stepper({width}, formula, motion, places, sources.shape[1], {_TOGETHER})
step_tangent = machine_code.tangent_stepper({width}, formula, motion, places, sources.shape[1], 1)
read_tangent = machine_code.tangent_reader({width}, {reading.program(fixed)!r}, places, reading_sources.shape[1])


@njit("{_DIFFERENTIATE}", error_model="numpy")
def integrate(x, si, cases, rows, first, last, times, steps, out, work, lanes):
    b = work[(-work.ctypes.data // 8) % 8:]
    place = lanes[:{width}]
    per_case = times.shape[0] * {no * n}
    for group in range(first, last, {width}):
        for lane in range({width}):
            problem = min(group + lane, last - 1)
            trial = rows[problem // cases.shape[0]]
            case = problem % cases.shape[0]
            begin(b, lane, x, trial, si, cases, case)
            place[lane] = (trial * cases.shape[0] + case) * per_case
        t = 0.0
        h = np.nan
        for k in range(times.shape[0]):
            before = h
            h = (times[k] - t) / steps[k]
            if h != before:
                for i in range(weights.shape[0]):
                    b[{weights} + i] = h * weights[i]
            for s in range(steps[k]):
                step(b, t + s * h, h)
                for j in range(0, {paired}, {_TOGETHER}):
                    step_tangents(b, {tangents} + j * {nd * width}, sources, j)
                for j in range({paired}, {n}):
                    step_tangent(b, {tangents} + j * {nd * width}, sources, j)
            t = times[k]
            note(b, t, h)
            for j in range({n}):
                read_tangent(b, {tangents} + j * {nd * width}, reading_sources, j)
                for lane in range({width}):
                    for i in range({no}):
                        out[place[lane] + i * {n} + j] = b[{out} + i * {width} + lane] * si[j]
            for lane in range({width}):
                place[lane] += {no * n}
'''
    return Source(text, operations, size + 8)


def rate_source(equations: Equations) -> str:
    """The module whose `rates` computes how fast each trial turns, and returns the fastest of all."""
    assert equations.rate is not None
    p = Graph().inputs("p", equations.parameters)
    program = Program.of([equations.rate(p)], p)
    return f"""{_header(None)}
value = machine_code.scalar({program!r}, {equations.parameters})


@njit("float64(float64[:, ::1], float64[::1], float64[::1])", error_model="numpy")
def rates(x, si, out):
    fastest = 0.0
    for i in range(x.shape[0]):
        rate = value(x, i, si)
        out[i] = rate
        if not rate <= fastest:
            fastest = rate if rate == rate else np.inf
    return fastest
"""


_ROWS = "float64[:, ::1], float64[::1], float64[:, ::1], int64[::1], int64, int64, float64[::1], int64[::1]"
_WORK = "float64[::1], int64[::1]"
_SIMULATE = f"void({_ROWS}, float64[::1], float64[::1], {_WORK})"
_DIFFERENTIATE = f"void({_ROWS}, float64[::1], {_WORK})"


def _tangents(tape: _Tape) -> tuple[Any, Any, list[Expression], list[Expression], list[list[Expression]]]:
    """Deviations, direction, the tangents of slope and readings in them, and where those of each parameter start."""
    graph, variation = tape.graph, tape.equations.variation
    dp = graph.inputs("dp", tape.equations.parameters)
    begins = tangent(tape.start, dict(zip(tape.p, dp, strict=True)))
    one, zero = graph.constant(1.0), graph.constant(0.0)
    starts = [[substitute(e, {b: one if b is a else zero for b in dp}) for e in begins] for a in dp]
    if variation is None:
        dy = d = graph.inputs("d", tape.equations.states)
        slopes = tangent(tape.slope, dict(zip(tape.y + tape.p, (*dy, *dp), strict=True)))
    else:
        d = graph.inputs("d", variation.freedoms)
        if any(e is not zero for row in starts for e in row):
            raise ValueError("equations of small deviations need a start that does not depend on the parameters")
        dy = variation.moved(tape.y, d)
        slopes = [graph.apply("add", v, 0.0) for v in variation.slope(tape.t, tape.y, tape.p, tape.c, d, dp)]
        starts = [[zero] * variation.freedoms for _ in dp]
    along = dict(zip(tape.y + tape.p, (*(graph.apply("add", v, 0.0) for v in dy), *dp), strict=True))
    return d, dp, slopes, tangent(tape.shown, along), starts


def _header(tableau: Tableau | None) -> str:
    weights = "np.array([weight for row in formula.weights for _, weight in row])"
    formula = f"formula = {tableau!r}\nweights = {weights}\n" if tableau else ""
    return f'''"""Written by ipe_bench.measurements.ode.source; its name is a digest of its text.

For machine_code {_compiler_digest()}.
"""

import numpy as np
from numba import njit

from ipe_bench.measurements.ode import machine_code
from ipe_bench.measurements.ode.machine_code import Places
from ipe_bench.measurements.ode.tableau import Tableau
from ipe_bench.measurements.ode.trace import Program

{formula}'''


@functools.cache
def _compiler_digest() -> str:
    """Stands for the code that turns programs into machine code: what it has compiled is not used after it changes."""
    return hashlib.sha256(Path(__file__).with_name("machine_code.py").read_bytes()).hexdigest()[:16]
