"""Writes the integrator of a plan.

    void integrate(double *x, double *si, double *cases, int64 n_cases, int64 *rows, int64 first,
    int64 last,
                   double *times, int64 *steps, int64 n_times, double *offset, int64 stride, double
                   *out, double *states, double *frame)

Lane l is the problem of trial rows[l / n_cases] in case l % n_cases, for first <= l < last; a group
that is not full repeats its last lane. Where constants are driven, `cases` holds those of every
interval, and those after the last time. `states` takes those of every lane at the start and at each
time, unless it is null; behind them, where steps are watched, whether one was in doubt.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from llvmlite import ir

from ipe_bench.engine.emit.vectors import (
    F64,
    I64,
    PTR,
    VOID,
    Value,
    Vectors,
    integer,
    loop,
    number_at,
    put,
    room,
)
from ipe_bench.engine.plan import LinearProgram, StepPlan, TangentPlan

_FILLED = 4
"""Numbers of a tangent from which on one alone keeps the processor busy; below, two advance side by
side."""


def integrate(plan: StepPlan, width: int) -> str:
    """Writes the integrator for groups of `width` lanes."""
    return str(_Writer(plan, width).module)


class _Writer:
    """Writes the module of one plan."""

    def __init__(self, plan: StepPlan, width: int) -> None:
        self.plan = plan
        self.width = width
        self.module = ir.Module("integrate")
        weights = [weight for row in plan.tableau.weights for _, weight in row]
        self.count = -(-len(weights) // width)
        padded = [*weights, *[0.0] * (self.count * width - len(weights))]
        self.table = self._constant("weights", F64, padded, 8 * width)
        self.begin = self._function("begin", [PTR], self._begin)
        self.weigh = self._function("weigh", [PTR, F64], self._weigh)
        self.step = self._function("step", [PTR, F64, F64], self._step)
        self.read = self._function("read", [PTR, F64], self._read)
        if plan.tangents is not None:
            self._write_tangents(plan.tangents)
        kinds = [PTR, PTR, PTR, I64, PTR, I64, I64, PTR, PTR, I64, PTR, I64, PTR, PTR, PTR]
        made: Any = ir.Function(self.module, ir.FunctionType(VOID, kinds), "integrate")
        _Loops(self, made).write()

    def _write_tangents(self, tangents: TangentPlan) -> None:
        kinds = [PTR, PTR, PTR]
        n = len(tangents.places)
        # Short tangents advance in pairs, and one alone where their number is odd.
        paired = n - n % 2 if len(tangents.places[0]) < _FILLED else 0
        groups = (0, paired, 2), (paired, n, 1)
        self.groups = [group for group in groups if group[0] < group[1]]
        self.move = {}
        for *_, by in self.groups:
            self.move[by] = self._function(f"move{by}", kinds, partial(self._move, tangents, by))
        self.show = self._function("show", kinds, partial(self._show, tangents))
        moving = [i for row in tangents.motion.sources for i in row]
        self.sources = self._constant("sources", I64, moving or [0], 8)
        shown = [i for row in tangents.reading.sources for i in row]
        self.show_sources = self._constant("show_sources", I64, shown or [0], 8)

    def _constant(self, name: str, kind: ir.Type, values: Sequence[Any], align: int) -> Value:
        made: Any = ir.GlobalVariable(self.module, ir.ArrayType(kind, len(values)), name)
        made.global_constant = True
        made.linkage = "internal"
        made.align = align
        made.initializer = ir.Constant(made.value_type, values)
        made.type = PTR
        return made

    def _function(
        self, name: str, kinds: Sequence[ir.Type], body: Callable[..., None]
    ) -> ir.Function:
        """Writes a function of its own, never inlined, whose stack is aligned: registers that spill
        would else lie across cache lines, which takes half as long again."""
        made: Any = ir.Function(self.module, ir.FunctionType(VOID, kinds), name)
        made.linkage = "internal"
        made.attributes.add("noinline")
        made.attributes.alignstack = 64
        builder = ir.IRBuilder(made.append_basic_block())
        body(Vectors(builder, self.width), *made.args)
        builder.ret_void()
        return made

    def _begin(self, v: Vectors, frame: Value) -> None:
        plan = self.plan
        given = v.load(frame, [*plan.x, *plan.constants])
        v.store(v.run(plan.begin, given), frame, plan.begun)

    def _weigh(self, v: Vectors, frame: Value, h: Value) -> None:
        """Writes h times the weights of the formula, behind the vectors of the frame, a vector at a
        time."""
        share = v.spread(h)
        weights = v.load(self.table, range(self.count))
        weighed = [v.builder.fmul(share, weight) for weight in weights]
        v.store(weighed, frame, range(self.plan.size, self.plan.size + self.count))

    def _weights(self, v: Vectors, frame: Value) -> list[list[Value]]:
        place = itertools.count(self.plan.size * self.width)
        weights = []
        for row in self.plan.tableau.weights:
            numbers = []
            for _ in row:
                number = number_at(v.builder, frame, integer(next(place)))
                numbers.append(v.spread(number))
            weights.append(numbers)
        return weights

    def _step(self, v: Vectors, frame: Value, t: Value, h: Value) -> None:
        plan = self.plan
        weights = self._weights(v, frame)
        y = v.load(frame, plan.y)
        fixed = v.load(frame, [*plan.driven, *plan.fixed])
        slopes: list[list[Value]] = []
        sides: list[Value] = []
        times: list[Value] = []
        for s, row in enumerate(plan.tableau.weights[:-1]):
            # Stage s: k_s = f(t + C_s h, y + h sum_j A_sj k_j).
            at = v.combine(y, weights[s], [slopes[j] for j, _ in row])
            time = v.call("fma", v.spread(h), v.constant(plan.tableau.C[s]), v.spread(t))
            times.append(time)
            result = v.run(plan.step, [time, *at, *fixed])
            slopes.append(result[: len(plan.y)])
            if plan.watch is not None:
                sides.append(result[-1])
            if plan.tangents is not None:
                v.store(result[len(plan.y) :], frame, plan.tangents.kept[s])
        # The end of the step, y + h sum_s B_s k_s.
        ended = v.combine(y, weights[-1], [slopes[j] for j, _ in plan.tableau.weights[-1]])
        v.store(ended, frame, plan.y)
        if plan.watch is not None:
            held = []
            if plan.watch.timed:
                # The rates of the stages' moments with the state held, where they depend on the
                # time itself.
                held = [v.run(plan.rates, [time, *y, *fixed]) for time in times]
            moved = itertools.chain(*slopes, *held)
            places = plan.watch.carried
            given = [v.spread(h), *ended, *moved, *sides, *v.load(frame, places)]
            v.store(v.run(plan.watch.program, given), frame, places)

    def _read(self, v: Vectors, frame: Value, t: Value) -> None:
        plan = self.plan
        given = [v.spread(t), *v.load(frame, [*plan.y, *plan.driven, *plan.fixed])]
        v.store(v.run(plan.read, given), frame, plan.read_at)

    def _move(
        self,
        tangents: TangentPlan,
        together: int,
        v: Vectors,
        frame: Value,
        first: Value,
        driving: Value,
    ) -> None:
        """Writes one step of some tangents; `driving` points to the places of their sources."""
        plan = self.plan
        move = tangents.motion
        weights = self._weights(v, frame)
        one = range(together)
        d = len(tangents.places[0])
        count = len(move.sources[0])
        own = [range(k * d, (k + 1) * d) for k in one]
        y = [v.load(first, place) for place in own]
        fixed = v.load(frame, plan.fixed)
        places = []
        for k in one:
            indices = range(k * count, (k + 1) * count)
            places.append([number_at(v.builder, driving, integer(i), I64) for i in indices])
        slopes: list[list[list[Value]]] = [[] for _ in one]
        for s, row in enumerate(plan.tableau.weights[:-1]):
            # The stages of the variational equations, by what the state's own stages have kept.
            at = [v.combine(y[k], weights[s], [slopes[k][j] for j, _ in row]) for k in one]
            stage = v.place(frame, s * tangents.stage_size)
            saved = v.load(stage, move.saved)
            for k in one:
                given = [*at[k], *v.load(stage, places[k]), *saved, *fixed]
                slopes[k].append(v.run(move.program, given))
        last = plan.tableau.weights[-1]
        for k in one:
            ended = v.combine(y[k], weights[-1], [slopes[k][j] for j, _ in last])
            v.store(ended, first, own[k])

    def _show(
        self, tangents: TangentPlan, v: Vectors, frame: Value, first: Value, driving: Value
    ) -> None:
        plan = self.plan
        show = tangents.reading
        indices = range(len(show.sources[0]))
        places = [number_at(v.builder, driving, integer(i), I64) for i in indices]
        moved = v.load(first, range(len(tangents.places[0])))
        given = [*moved, *v.load(frame, [*places, *show.saved, *plan.fixed])]
        v.store(v.run(show.program, given), frame, plan.shown)


class _Loops:
    """Writes the loops over groups of lanes, readings and steps."""

    def __init__(self, writer: _Writer, made: Any) -> None:
        self.writer = writer
        self.plan = writer.plan
        self.width = writer.width
        problems = made.args[:7]
        steps = made.args[7:10]
        results = made.args[10:]
        self.x, self.si, self.cases, self.n_cases, self.rows, self.first, self.last = problems
        self.times, self.steps, self.n_times = steps
        self.offset, self.stride, self.out, self.states, self.frame = results
        self.b: Any = ir.IRBuilder(made.append_basic_block())
        lanes = [room(self.b, I64, self.width) for _ in range(4)]
        self.target, self.shift, self.own, self.kept = lanes
        self.t = room(self.b, F64)
        self.taken = room(self.b, F64)
        self.columns = len(self.plan.x) if self.plan.tangents else 1

    def write(self) -> None:
        b = self.b
        with loop(b, self.first, self.last, self.width) as group:
            with self._lanes() as lane:
                self._gather(group, lane)
            # The state at time 0, and what is computed once for the lane.
            b.call(self.writer.begin, [self.frame])
            self._keep(integer(0))
            b.store(ir.Constant(F64, 0.0), self.t)
            # Unlike any step, so that the weights are always written.
            b.store(ir.Constant(F64, float("nan")), self.taken)
            with loop(b, integer(0), self.n_times) as k:
                to = number_at(b, self.times, k)
                self._advance(k, to)
                self._keep(b.add(k, integer(1)))
                if self.plan.driven:
                    self._drive(k)
                b.call(self.writer.read, [self.frame, to])
                self._give(k)
        b.ret_void()

    def _lanes(self) -> Any:
        return loop(self.b, integer(0), integer(self.width))

    def _at(self, place: int, lane: Value) -> Value:
        """Returns the pointer to one number in a vector of the frame."""
        return self.b.add(integer(place * self.width), lane)

    def _tangent(
        self, j: Value, table: Value, tangents: TangentPlan, linear: LinearProgram
    ) -> list[Value]:
        """Returns pointers to tangent j and to the list of its sources."""
        b = self.b
        first = tangents.places[0]
        lies = b.add(integer(first.start), b.mul(j, integer(len(first))))
        place = Vectors(b, self.width).place(self.frame, lies)
        sources = b.mul(j, integer(len(linear.sources[0])))
        return [place, b.gep(table, [sources], source_etype=I64)]

    def _gather(self, group: Value, lane: Value) -> None:
        """Writes the numbers of a lane into the frame, a vector for each."""
        b = self.b
        plan = self.plan
        n = integer(len(plan.x))
        # Lane l is trial rows[l / n_cases] in case l % n_cases; beyond the last, the last again.
        here = b.add(group, lane)
        end = b.sub(self.last, integer(1))
        problem = b.select(b.icmp_signed("<", here, end), here, end)
        trial = number_at(b, self.rows, b.udiv(problem, self.n_cases), I64)
        case = b.urem(problem, self.n_cases)
        row = b.mul(trial, n)
        constants = b.mul(case, integer(len(plan.constants)))
        for j, place in enumerate(plan.x):
            number = number_at(b, self.x, b.add(row, integer(j)))
            value = b.fmul(number, number_at(b, self.si, integer(j)))
            put(b, value, self.frame, self._at(place, lane))
        for j, place in enumerate(plan.constants):
            number = number_at(b, self.cases, b.add(constants, integer(j)))
            put(b, number, self.frame, self._at(place, lane))
        # Where the lane's readings go, what is subtracted of them, its constants, and its states.
        place = b.add(b.mul(trial, self.n_cases), case)
        size = integer(len(plan.shown) * self.columns)
        put(b, b.mul(b.mul(place, self.n_times), size), self.target, lane)
        put(b, b.mul(case, self.stride), self.shift, lane)
        put(b, constants, self.own, lane)
        moments = b.add(self.n_times, integer(1))
        size = integer(len(plan.told))
        put(b, b.mul(b.mul(place, moments), size), self.kept, lane)

    def _keep(self, k: Value) -> None:
        """Writes the state at the time k, the start being 0, if it is asked for."""
        b = self.b
        asked = b.icmp_signed("!=", b.ptrtoint(self.states, I64), integer(0))
        with b.if_then(asked), self._lanes() as lane:
            row = b.add(number_at(b, self.kept, lane, I64), k)
            for place in self.plan.told:
                put(b, number_at(b, self.frame, self._at(place, lane)), self.states, row)
                row = b.add(row, b.add(self.n_times, integer(1)))

    def _advance(self, k: Value, to: Value) -> None:
        """Writes the steps to a reading's time: h = (times[k] - t) / steps[k]."""
        b = self.b
        writer = self.writer
        tangents = self.plan.tangents
        since = b.load(self.t, typ=F64)
        # No step to a time that is reached already: at the start, or where two readings share one.
        there = b.fcmp_ordered("==", to, since)
        count = b.select(there, integer(0), number_at(b, self.steps, k, I64))
        h = b.fdiv(b.fsub(to, since), b.sitofp(count, F64))
        # The weights times h are written again where the step has changed.
        with b.if_then(b.fcmp_unordered("!=", h, b.load(self.taken, typ=F64))):
            b.call(writer.weigh, [self.frame, h])
        b.store(h, self.taken)
        # One step of the state, then of the tangents beside it.
        with loop(b, integer(0), count) as s:
            time = b.fadd(since, b.fmul(b.sitofp(s, F64), h))
            b.call(writer.step, [self.frame, time, h])
            if tangents is not None:
                for begin, end, by in writer.groups:
                    with loop(b, integer(begin), integer(end), by) as j:
                        moved = self._tangent(j, writer.sources, tangents, tangents.motion)
                        b.call(writer.move[by], [self.frame, *moved])
        b.store(to, self.t)

    def _drive(self, k: Value) -> None:
        """Writes the constants of the next interval, which hold from this reading on."""
        b = self.b
        plan = self.plan
        size = integer(len(plan.constants))
        later = b.mul(b.add(k, integer(1)), b.mul(self.n_cases, size))
        first = len(plan.constants) - len(plan.driven)
        with self._lanes() as lane:
            row = b.add(later, number_at(b, self.own, lane, I64))
            for j, place in enumerate(plan.driven, start=first):
                number = number_at(b, self.cases, b.add(row, integer(j)))
                put(b, number, self.frame, self._at(place, lane))

    def _give(self, k: Value) -> None:
        """Writes readings less their offset, or Jacobians in the parameters' sizes, to their rows
        of `out`."""
        b = self.b
        plan = self.plan
        tangents = plan.tangents
        columns = integer(self.columns)
        done = b.mul(k, integer(len(plan.shown)))
        with loop(b, integer(0), columns) as j:
            if tangents is not None:
                shown = self._tangent(j, self.writer.show_sources, tangents, tangents.reading)
                b.call(self.writer.show, [self.frame, *shown])
            with self._lanes() as lane:
                begin = number_at(b, self.target, lane, I64)
                less = b.add(number_at(b, self.shift, lane, I64), done)
                for i, place in enumerate(plan.shown):
                    value = number_at(b, self.frame, self._at(place, lane))
                    if tangents is not None:
                        value = b.fmul(value, number_at(b, self.si, j))
                    else:
                        offset = number_at(b, self.offset, b.add(less, integer(i)))
                        value = b.fsub(value, offset)
                    entry = b.add(b.mul(b.add(done, integer(i)), columns), j)
                    put(b, value, self.out, b.add(begin, entry))
