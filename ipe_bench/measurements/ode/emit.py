"""Writes the integrator of a plan as a module of LLVM's intermediate representation.

    void integrate(double *x, double *si, double *cases, int64 n_cases, int64 *rows, int64 first, int64 last,
                   double *times, int64 *steps, int64 n_times, double *offset, int64 stride, double *out, double *frame)

Lane l is the problem of trial rows[l / n_cases] in case l % n_cases, for first <= l < last; a group that is not full
repeats its last lane. Where constants are driven, `cases` holds those of every interval, and those after the last time.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

from llvmlite import ir

from ipe_bench.basics.vectors import F64, I64, PTR, VOID, Value, Vectors, function, integer, loop, number_at, put, room
from ipe_bench.measurements.ode.plan import Moving, Plan
from ipe_bench.measurements.ode.trace import Program

_FILLED = 4
"""Numbers of a tangent from which on one alone keeps the processor busy; below, two advance side by side."""


def integrate(plan: Plan, width: int) -> str:
    """For groups of `width` lanes."""
    return str(_Writer(plan, width).module)


def rates(program: Program, width: int) -> str:
    """void rates(double *x, double *si, double *out, int64 trials): one number from the parameters x[i] times si."""
    made: Any = ir.Function(ir.Module("rates"), ir.FunctionType(VOID, [PTR, PTR, PTR, I64]), "rates")
    x, si, out, trials = made.args
    b: Any = ir.IRBuilder(made.append_basic_block())
    n = program.inputs
    with loop(b, integer(0), trials) as i:
        v = Vectors(b, width)
        row, size = v.load(v.place(x, b.mul(i, integer(n))), range(n)), v.load(si, range(n))
        (rate,) = _run(v, program, [b.fmul(value, unit) for value, unit in zip(row, size, strict=True)])
        put(b, rate, out, i)
    b.ret_void()
    return str(made.module)


def _run(v: Vectors, program: Program, inputs: Sequence[Value]) -> list[Value]:
    values = list(inputs)
    assert len(values) == program.inputs
    for name, *numbers in program.operations:
        constant = name == "constant"
        values.append(v.constant(*numbers) if constant else v.apply(name, *[values[i] for i in numbers]))
    return [values[i] for i in program.outputs]


def _combine(
    v: Vectors, start: Sequence[Value], weights: Sequence[Value], slopes: Sequence[Sequence[Value]]
) -> list[Value]:
    """start + sum of weight times slope."""
    result = list(start)
    for weight, slope in zip(weights, slopes, strict=True):
        result = [v.call("fma", weight, k, y) for k, y in zip(slope, result, strict=True)]
    return result


class _Writer:
    """Writes the module of one plan."""

    def __init__(self, plan: Plan, width: int) -> None:
        self.plan, self.width, self.module = plan, width, ir.Module("integrate")
        weights = [weight for row in plan.tableau.weights for _, weight in row]
        self.count = -(-len(weights) // width)
        padded = [*weights, *[0.0] * (self.count * width - len(weights))]
        self.table = self._constant("weights", ir.ArrayType(F64, len(padded)), padded, 8 * width)
        self.begin = function(self.module, "begin", [PTR], self._begin)
        self.weigh = function(self.module, "weigh", [PTR, F64], self._weigh)
        self.step = function(self.module, "step", [PTR, F64, F64], self._step)
        self.read = function(self.module, "read", [PTR, F64], self._read)
        if plan.moving is not None:
            kinds = [PTR, PTR, PTR]
            self.groups = _side_by_side(plan.moving)
            self.move = {
                by: function(self.module, f"move{by}", kinds, partial(self._move, plan.moving, by))
                for _, _, by in self.groups
            }
            self.show = function(self.module, "show", kinds, partial(self._show, plan.moving))
            self.sources = self._places("sources", plan.moving.sources)
            self.show_sources = self._places("show_sources", plan.moving.show_sources)
        kinds = [PTR, PTR, PTR, I64, PTR, I64, I64, PTR, PTR, I64, PTR, I64, PTR, PTR]
        self._integrate(ir.Function(self.module, ir.FunctionType(VOID, kinds), "integrate"))

    def _constant(self, name: str, kind: ir.Type, values: Any, align: int) -> Value:
        made: Any = ir.GlobalVariable(self.module, kind, name)
        made.global_constant, made.linkage, made.align = True, "internal", align
        made.initializer, made.type = ir.Constant(kind, values), PTR
        return made

    def _places(self, name: str, rows: tuple[tuple[int, ...], ...]) -> Value:
        flat = [i for row in rows for i in row] or [0]
        return self._constant(name, ir.ArrayType(I64, len(flat)), flat, 8)

    def _begin(self, b: ir.IRBuilder, frame: Value) -> None:
        v, plan = Vectors(b, self.width), self.plan
        v.store(_run(v, plan.begin, v.load(frame, [*plan.x, *plan.constants])), frame, plan.begun)

    def _weigh(self, b: ir.IRBuilder, frame: Value, h: Value) -> None:
        """h times the weights of the formula, behind the vectors of the frame, a vector at a time."""
        v = Vectors(b, self.width)
        share = v.spread(h)
        weighed = [b.fmul(share, weight) for weight in v.load(self.table, range(self.count))]
        v.store(weighed, frame, range(self.plan.size, self.plan.size + self.count))

    def _weights(self, b: ir.IRBuilder, frame: Value) -> list[list[Value]]:
        result: list[list[Value]] = []
        place, v = self.plan.size * self.width, Vectors(b, self.width)
        for row in self.plan.tableau.weights:
            result.append([v.spread(number_at(b, frame, integer(place + i))) for i in range(len(row))])
            place += len(row)
        return result

    def _step(self, b: ir.IRBuilder, frame: Value, t: Value, h: Value) -> None:
        v, plan, weights = Vectors(b, self.width), self.plan, self._weights(b, frame)
        y, fixed = v.load(frame, plan.y), v.load(frame, [*plan.driven, *plan.fixed])
        slopes: list[list[Value]] = []
        for s, row in enumerate(plan.tableau.weights[:-1]):
            at = _combine(v, y, weights[s], [slopes[j] for j, _ in row])
            share = ir.Constant(F64, plan.tableau.C[s])
            time = [v.spread(Vectors(b, 1).call("fma", h, share, t))] if plan.step_timed else []
            result = _run(v, plan.step, [*time, *at, *fixed])
            slopes.append(result[: len(plan.y)])
            v.store(result[len(plan.y) :], frame, plan.kept[s])
        v.store(_combine(v, y, weights[-1], [slopes[j] for j, _ in plan.tableau.weights[-1]]), frame, plan.y)

    def _read(self, b: ir.IRBuilder, frame: Value, t: Value) -> None:
        v, plan = Vectors(b, self.width), self.plan
        time = [v.spread(t)] if plan.read_timed else []
        v.store(_run(v, plan.read, [*time, *v.load(frame, [*plan.y, *plan.driven, *plan.fixed])]), frame, plan.noted)

    def _move(self, move: Moving, together: int, b: ir.IRBuilder, frame: Value, first: Value, driving: Value) -> None:
        """One step of some tangents; `driving` points to the places of their sources."""
        v, plan, weights = Vectors(b, self.width), self.plan, self._weights(b, frame)
        one, d, count = range(together), len(move.lie[0]), len(move.sources[0])
        own = [range(k * d, (k + 1) * d) for k in one]
        y, fixed = [v.load(first, place) for place in own], v.load(frame, plan.fixed)
        places = [[number_at(b, driving, integer(k * count + i), I64) for i in range(count)] for k in one]
        slopes: list[list[list[Value]]] = [[] for _ in one]
        for s, row in enumerate(plan.tableau.weights[:-1]):
            at = [_combine(v, y[k], weights[s], [slopes[k][j] for j, _ in row]) for k in one]
            stage = v.place(frame, s * move.stage_size)
            saved = v.load(stage, move.saved)
            for k in one:
                slopes[k].append(_run(v, move.slope, [*at[k], *v.load(stage, places[k]), *saved, *fixed]))
        for k in one:
            ended = _combine(v, y[k], weights[-1], [slopes[k][j] for j, _ in plan.tableau.weights[-1]])
            v.store(ended, first, own[k])

    def _show(self, move: Moving, b: ir.IRBuilder, frame: Value, first: Value, driving: Value) -> None:
        v, plan = Vectors(b, self.width), self.plan
        places = [number_at(b, driving, integer(i), I64) for i in range(len(move.show_sources[0]))]
        given = [*v.load(first, range(len(move.lie[0]))), *v.load(frame, places), *v.load(frame, move.show_saved)]
        v.store(_run(v, move.show, [*given, *v.load(frame, plan.fixed)]), frame, plan.shown)

    def _integrate(self, made: Any) -> None:
        x, si, cases, n_cases, rows, first, last, times, steps, n_times, offset, stride, out, frame = made.args
        b, plan, width = ir.IRBuilder(made.append_basic_block()), self.plan, self.width
        n, nc, no = len(plan.x), len(plan.constants), len(plan.shown)
        columns = n if plan.moving else 1
        target, shift, own = (room(b, I64, width) for _ in range(3))
        t, taken = room(b, F64), room(b, F64)

        def at(place: int, lane: Value) -> Value:
            """Of one number in a vector of the frame."""
            return b.add(integer(place * width), lane)

        with loop(b, first, last, width) as group:
            with loop(b, integer(0), integer(width)) as lane:
                here, end = b.add(group, lane), b.sub(last, integer(1))
                problem = b.select(b.icmp_signed("<", here, end), here, end)
                trial, case = number_at(b, rows, b.udiv(problem, n_cases), I64), b.urem(problem, n_cases)
                row, constants = b.mul(trial, integer(n)), b.mul(case, integer(nc))
                for j, place in enumerate(plan.x):
                    value = b.fmul(number_at(b, x, b.add(row, integer(j))), number_at(b, si, integer(j)))
                    put(b, value, frame, at(place, lane))
                for j, place in enumerate(plan.constants):
                    put(b, number_at(b, cases, b.add(constants, integer(j))), frame, at(place, lane))
                place = b.add(b.mul(trial, n_cases), case)
                put(b, b.mul(b.mul(place, n_times), integer(no * columns)), target, lane)
                put(b, b.mul(case, stride), shift, lane)
                put(b, constants, own, lane)
            b.call(self.begin, [frame])
            b.store(ir.Constant(F64, 0.0), t)
            b.store(ir.Constant(F64, float("nan")), taken)  # unlike any step, so that the weights are always written
            with loop(b, integer(0), n_times) as k:
                to, since = number_at(b, times, k), b.load(t, typ=F64)
                # No step to a time that is reached already: at the start, or where two readings share a time.
                count = b.select(b.fcmp_ordered("==", to, since), integer(0), number_at(b, steps, k, I64))
                h = b.fdiv(b.fsub(to, since), b.sitofp(count, F64))
                with b.if_then(b.fcmp_unordered("!=", h, b.load(taken, typ=F64))):
                    b.call(self.weigh, [frame, h])
                b.store(h, taken)
                with loop(b, integer(0), count) as s:
                    b.call(self.step, [frame, b.fadd(since, b.fmul(b.sitofp(s, F64), h)), h])
                    self._tangents(b, frame)
                b.store(to, t)
                if plan.driven:
                    later = b.mul(b.add(k, integer(1)), b.mul(n_cases, integer(nc)))
                    with loop(b, integer(0), integer(width)) as lane:
                        row = b.add(later, number_at(b, own, lane, I64))
                        for j, place in enumerate(plan.driven, start=nc - len(plan.driven)):
                            put(b, number_at(b, cases, b.add(row, integer(j))), frame, at(place, lane))
                b.call(self.read, [frame, to])
                done = b.mul(k, integer(no))
                with loop(b, integer(0), integer(columns)) as j:
                    if plan.moving:
                        b.call(self.show, [frame, *self._tangent(b, plan.moving, frame, j, self.show_sources)])
                    with loop(b, integer(0), integer(width)) as lane:
                        begin, less = number_at(b, target, lane, I64), b.add(number_at(b, shift, lane, I64), done)
                        for i, place in enumerate(plan.shown):
                            value = number_at(b, frame, at(place, lane))
                            if plan.moving:
                                value = b.fmul(value, number_at(b, si, j))
                            else:
                                value = b.fsub(value, number_at(b, offset, b.add(less, integer(i))))
                            entry = b.add(b.mul(b.add(done, integer(i)), integer(columns)), j)
                            put(b, value, out, b.add(begin, entry))
        b.ret_void()

    def _tangents(self, b: ir.IRBuilder, frame: Value) -> None:
        if self.plan.moving is None:
            return
        for begin, end, by in self.groups:
            with loop(b, integer(begin), integer(end), by) as j:
                b.call(self.move[by], [frame, *self._tangent(b, self.plan.moving, frame, j, self.sources)])

    def _tangent(self, b: ir.IRBuilder, move: Moving, frame: Value, j: Value, table: Value) -> tuple[Value, Value]:
        """Where tangent j lies, and where the places of its sources are listed."""
        count = len((move.sources if table is self.sources else move.show_sources)[0])
        lies = b.add(integer(move.lie[0].start), b.mul(j, integer(len(move.lie[0]))))
        return Vectors(b, self.width).place(frame, lies), b.gep(table, [b.mul(j, integer(count))], source_etype=I64)


def _side_by_side(move: Moving) -> list[tuple[int, int, int]]:
    """Tangents from, to, and how many advance side by side."""
    n = len(move.lie)
    paired = n - n % 2 if len(move.lie[0]) < _FILLED else 0
    return [(begin, end, by) for begin, end, by in ((0, paired, 2), (paired, n, 1)) if begin < end]
