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
    Value,
    Vectors,
    integer,
    is_given,
    loop,
    number_at,
    opened,
    put,
    room,
    smaller,
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
        missing = self.count * width - len(weights)
        self.table = self._constant("weights", F64, weights + [0.0] * missing, 8 * width)
        self.begin = self._function("begin", [PTR], self._begin)
        self.weigh = self._function("weigh", [PTR, F64], self._weigh)
        self.step = self._function("step", [PTR, F64, F64], self._step)
        self.read = self._function("read", [PTR, F64], self._read)
        if plan.tangents is not None:
            self._write_tangents(plan.tangents)
        _Loops(self).write()

    def _write_tangents(self, tangents: TangentPlan) -> None:
        kinds = [PTR, PTR, PTR]
        n = len(tangents.places)
        # Short tangents advance in pairs, and one alone where their number is odd.
        short = len(tangents.places[0]) < _FILLED
        paired = n - n % 2 if short else 0
        groups = (0, paired, 2), (paired, n, 1)
        self.groups = [group for group in groups if group[0] < group[1]]
        self.move = {}
        for *_, by in self.groups:
            body = partial(self._move, tangents, by)
            self.move[by] = self._function(f"move{by}", kinds, body)
        self.show = self._function("show", kinds, partial(self._show, tangents))
        moving = [i for row in tangents.motion.sources for i in row]
        self.sources = self._constant("sources", I64, moving or [0], 8)
        shown = [i for row in tangents.reading.sources for i in row]
        self.show_sources = self._constant("show_sources", I64, shown or [0], 8)

    def _constant(self, name: str, kind: ir.Type, values: Sequence[Any], align: int) -> Value:
        kinds = ir.ArrayType(kind, len(values))
        made: Any = ir.GlobalVariable(self.module, kinds, name)
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
        builder = opened(self.module, name, kinds)
        made = builder.function
        made.linkage = "internal"
        made.attributes.add("noinline")
        made.attributes.alignstack = 64
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
        behind = self.plan.size
        v.store(weighed, frame, range(behind, behind + self.count))

    def _weights(self, v: Vectors, frame: Value) -> list[list[Value]]:
        """Loads the weights of every stage and of the end, each as a vector of equal numbers."""
        place = itertools.count(self.plan.size * self.width)
        weights = []
        for row in self.plan.tableau.weights:
            numbers = []
            for _ in row:
                number = number_at(v.builder, frame, next(place))
                numbers.append(v.spread(number))
            weights.append(numbers)
        return weights

    def _step(self, v: Vectors, frame: Value, t: Value, h: Value) -> None:
        """Writes one step of the state from t to t + h."""
        plan = self.plan
        tableau = plan.tableau
        weights = self._weights(v, frame)
        y = v.load(frame, plan.y)
        fixed = v.load(frame, [*plan.driven, *plan.fixed])
        slopes: list[list[Value]] = []
        sides: list[Value] = []
        times: list[Value] = []
        for s in range(tableau.stages):
            # Stage s: k_s = f(t + C_s h, y + h sum_j A_sj k_j).
            at = self._combined(v, y, weights[s], slopes, s)
            length = v.spread(h)
            time = v.call("fma", length, v.constant(plan.tableau.C[s]), v.spread(t))
            times.append(time)
            result = v.run(plan.step, [time, *at, *fixed])
            slopes.append(result[: len(plan.y)])
            if plan.watch is not None:
                sides.append(result[-1])
            if plan.tangents is not None:
                kept = result[len(plan.y) :]
                v.store(kept, frame, plan.tangents.kept[s])
        # The end of the step, y + h sum_s B_s k_s.
        ended = self._combined(v, y, weights[-1], slopes, -1)
        v.store(ended, frame, plan.y)
        if plan.watch is None:
            return
        moved = [*slopes]
        if plan.watch.timed:
            # The rates of the stages' moments with the state held, where they depend on the time
            # itself.
            moved += [v.run(plan.rates, [time, *y, *fixed]) for time in times]
        places = plan.watch.carried
        length = v.spread(h)
        carried = v.load(frame, places)
        given = [length, *ended, *itertools.chain(*moved), *sides, *carried]
        v.store(v.run(plan.watch.program, given), frame, places)

    def _combined(
        self,
        v: Vectors,
        y: list[Value],
        weights: list[Value],
        slopes: list[list[Value]],
        stage: int,
    ) -> list[Value]:
        """Computes y + h times the weighted slopes that a stage takes, or of -1 the end."""
        row = self.plan.tableau.weights[stage]
        return v.combine(y, weights, [slopes[j] for j, _ in row])

    def _read(self, v: Vectors, frame: Value, t: Value) -> None:
        plan = self.plan
        places = [*plan.y, *plan.driven, *plan.fixed]
        given = [v.spread(t), *v.load(frame, places)]
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
        """Writes one step of some tangents that lie one behind another from `first` on; `driving`
        points to the places of their sources."""
        plan = self.plan
        motion = tangents.motion
        weights = self._weights(v, frame)
        size = len(tangents.places[0])
        count = len(motion.sources[0])
        own = [range(k * size, (k + 1) * size) for k in range(together)]
        d = [v.load(first, place) for place in own]
        fixed = v.load(frame, plan.fixed)
        sources = [_places_at(v, driving, k * count, count) for k in range(together)]
        slopes: list[list[list[Value]]] = [[] for _ in own]
        for s in range(plan.tableau.stages):
            # The stages of the variational equations, by what the state's own stages have kept.
            at = [
                self._combined(v, one, weights[s], slope, s)
                for one, slope in zip(d, slopes, strict=True)
            ]
            stage = v.place(frame, s * tangents.stage_size)
            saved = v.load(stage, motion.saved)
            for k in range(together):
                source = v.load(stage, sources[k])
                given = [*at[k], *source, *saved, *fixed]
                slopes[k].append(v.run(motion.program, given))
        for k in range(together):
            ended = self._combined(v, d[k], weights[-1], slopes[k], -1)
            v.store(ended, first, own[k])

    def _show(
        self, tangents: TangentPlan, v: Vectors, frame: Value, first: Value, driving: Value
    ) -> None:
        """Writes how readings move with one tangent."""
        plan = self.plan
        reading = tangents.reading
        sources = _places_at(v, driving, 0, len(reading.sources[0]))
        moved = v.load(first, range(len(tangents.places[0])))
        others = v.load(frame, [*sources, *reading.saved, *plan.fixed])
        v.store(v.run(reading.program, [*moved, *others]), frame, plan.shown)


def _places_at(v: Vectors, table: Value, first: int, count: int) -> list[Value]:
    """Loads places of a table, which are whole numbers."""
    return [number_at(v.builder, table, i, I64) for i in range(first, first + count)]


class _Loops:
    """Writes the loops over groups of lanes, readings and steps."""

    def __init__(self, writer: _Writer) -> None:
        self.writer = writer
        self.plan = writer.plan
        self.width = writer.width
        problems = [PTR, PTR, PTR, I64, PTR, I64, I64]
        steps = [PTR, PTR, I64]
        results = [PTR, I64, PTR, PTR, PTR]
        self.b = opened(writer.module, "integrate", [*problems, *steps, *results])
        self.x, self.si, self.cases, self.n_cases, *others = self.b.function.args
        self.rows, self.first, self.last, *others = others
        self.times, self.steps, self.n_times, *others = others
        self.offset, self.stride, self.out, self.states, self.frame = others
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
            with loop(b, 0, self.n_times) as k:
                to = number_at(b, self.times, k)
                self._advance(k, to)
                self._keep(b.add(k, integer(1)))
                if self.plan.driven:
                    self._drive(k)
                b.call(self.writer.read, [self.frame, to])
                self._give(k)
        b.ret_void()

    def _lanes(self) -> Any:
        return loop(self.b, 0, self.width)

    def _at(self, place: int, lane: Value) -> Value:
        """Returns the pointer to one number in a vector of the frame."""
        return self.b.add(integer(place * self.width), lane)

    def _tangent(
        self, j: Value, table: Value, tangents: TangentPlan, linear: LinearProgram
    ) -> list[Value]:
        """Returns pointers to tangent j and to the list of its sources."""
        b = self.b
        first = tangents.places[0]
        behind = b.mul(j, integer(len(first)))
        lies = b.add(integer(first.start), behind)
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
        problem = smaller(b, here, end)
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
        times = b.mul(place, self.n_times)
        size = integer(len(plan.shown) * self.columns)
        put(b, b.mul(times, size), self.target, lane)
        put(b, b.mul(case, self.stride), self.shift, lane)
        put(b, constants, self.own, lane)
        moments = b.mul(place, b.add(self.n_times, integer(1)))
        size = integer(len(plan.told))
        put(b, b.mul(moments, size), self.kept, lane)

    def _keep(self, k: Value) -> None:
        """Writes the state at the time k, the start being 0, if it is asked for."""
        b = self.b
        with b.if_then(is_given(b, self.states)), self._lanes() as lane:
            row = b.add(number_at(b, self.kept, lane, I64), k)
            for place in self.plan.told:
                number = number_at(b, self.frame, self._at(place, lane))
                put(b, number, self.states, row)
                row = b.add(row, b.add(self.n_times, integer(1)))

    def _advance(self, k: Value, to: Value) -> None:
        """Writes the steps to a reading's time: h = (times[k] - t) / steps[k]."""
        b = self.b
        writer = self.writer
        tangents = self.plan.tangents
        since = b.load(self.t, typ=F64)
        # No step to a time that is reached already: at the start, or where two readings share one.
        there = b.fcmp_ordered("==", to, since)
        wanted = number_at(b, self.steps, k, I64)
        count = b.select(there, integer(0), wanted)
        h = b.fdiv(b.fsub(to, since), b.sitofp(count, F64))
        # The weights times h are written again where the step has changed.
        changed = b.fcmp_unordered("!=", h, b.load(self.taken, typ=F64))
        with b.if_then(changed):
            b.call(writer.weigh, [self.frame, h])
        b.store(h, self.taken)
        # One step of the state, then of the tangents beside it.
        with loop(b, 0, count) as s:
            time = b.fadd(since, b.fmul(b.sitofp(s, F64), h))
            b.call(writer.step, [self.frame, time, h])
            if tangents is not None:
                for begin, end, by in writer.groups:
                    with loop(b, begin, end, by) as j:
                        moved = self._tangent(j, writer.sources, tangents, tangents.motion)
                        b.call(writer.move[by], [self.frame, *moved])
        b.store(to, self.t)

    def _drive(self, k: Value) -> None:
        """Writes the constants of the next interval, which hold from this reading on."""
        b = self.b
        plan = self.plan
        size = integer(len(plan.constants))
        interval = b.add(k, integer(1))
        later = b.mul(interval, b.mul(self.n_cases, size))
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
        with loop(b, 0, columns) as j:
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
                    row = b.mul(b.add(done, integer(i)), columns)
                    put(b, value, self.out, b.add(begin, b.add(row, j)))
