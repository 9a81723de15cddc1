"""Writes the integrator of a plan as a module of LLVM's intermediate representation.

    void integrate(double *x, double *si, double *cases, int64 n_cases, int64 *rows, int64 first,
    int64 last,
                   double *times, int64 *steps, int64 n_times, double *offset, int64 stride, double
                   *out, double *states, double *frame)

Lane l is the problem of trial rows[l / n_cases] in case l % n_cases, for first <= l < last; a group
that is not full repeats its last lane. Where constants are driven, `cases` holds those of every
interval, and those after the last time. `states` takes those of every lane at the start and at each
time, unless it is null; behind them, where steps are watched, whether one was in doubt. Every
operation is IEEE arithmetic in a fixed order, so the bits of a lane do not depend on the number of
lanes. `basics.compiled` makes machine code of such modules; this file is imported only where
something is compiled.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

from llvmlite import ir

from ipe_bench.engine.plan import StepPlan
from ipe_bench.engine.scan import Step
from ipe_bench.engine.trace import Program, RowPrograms

F64, I32, I64, PTR, VOID = (
    ir.DoubleType(),
    ir.IntType(32),
    ir.IntType(64),
    ir.PointerType(),
    ir.VoidType(),
)
_ARITHMETIC = {"add": "fadd", "sub": "fsub", "mul": "fmul", "div": "fdiv"}
_FILLED = 4
"""Numbers of a tangent from which on one alone keeps the processor busy; below, two advance side by
side."""

Value = Any
"""A value of LLVM's intermediate representation."""


def integrate(plan: StepPlan, width: int) -> str:
    """Writes the integrator for groups of `width` lanes."""
    return str(_Writer(plan, width).module)


def rates(program: Program, width: int) -> str:
    """Writes void rates(double *x, double *si, double *out, int64 trials): one number from the
    parameters x[i] times si, for one trial at a time, a width of 1."""
    made: Any = ir.Function(
        ir.Module("rates"), ir.FunctionType(VOID, [PTR, PTR, PTR, I64]), "rates"
    )
    x, si, out, trials = made.args
    b: Any = ir.IRBuilder(made.append_basic_block())
    n = program.inputs
    # for i in range(trials): out[i] = rate(x[i] * si)
    with loop(b, integer(0), trials) as i:
        v = _Vectors(b, width)
        row, size = v.load(v.place(x, b.mul(i, integer(n))), range(n)), v.load(si, range(n))
        (rate,) = v.run(
            program, [b.fmul(value, unit) for value, unit in zip(row, size, strict=True)]
        )
        put(b, rate, out, i)
    b.ret_void()
    return str(made.module)


def rows(source: RowPrograms, width: int) -> str:
    """Writes void rows(double *x, double *c, int64 count, double *unit, double *y, double *J, int64
    total): for each row i of x (total, n), with row i % count of the numbers c, the values y
    (total, m) and, unless J is null, their slopes J (total, m, n). A vector holds tangents in
    `width` directions, of the unit matrix (n, n)."""
    made: Any = ir.Function(
        ir.Module("rows"), ir.FunctionType(VOID, [PTR, PTR, I64, PTR, PTR, PTR, I64]), "rows"
    )
    x, c, count, unit, y, J, total = made.args
    b: Any = ir.IRBuilder(made.append_basic_block())
    v, w = _Vectors(b, 1), _Vectors(b, width)
    n, m, numbers = source.n, source.m, source.values.inputs - source.n
    asked, last = b.icmp_signed("!=", b.ptrtoint(J, I64), integer(0)), integer(n - width)
    with loop(b, integer(0), total) as i:
        known = v.place(c, b.mul(b.urem(i, count), integer(numbers)))
        # y[i] = y(x[i], c[i % count]), and what its tangents need of it.
        given = v.load(v.place(x, b.mul(i, integer(n))), range(n))
        found = v.run(source.values, [*given, *v.load(known, range(numbers))])
        v.store(found[:m], v.place(y, b.mul(i, integer(m))), range(m))
        # J[i] = dy/dx, `width` columns at a time: a vector holds a tangent in that many directions.
        with b.if_then(asked), loop(b, integer(0), integer(n), width) as begun:
            saved = [w.spread(b.extract_element(a, ir.Constant(I32, 0))) for a in found[m:]]
            # The last vector begins early enough to end with the last direction.
            first = b.select(b.icmp_signed("<", begun, last), begun, last)
            here = b.gep(unit, [first], source_etype=F64)
            to = b.gep(J, [b.add(b.mul(i, integer(m * n)), first)], source_etype=F64)
            along = [
                b.load(b.gep(here, [integer(j * n)], source_etype=F64), typ=w.type, align=8)
                for j in range(n)
            ]
            for j, value in enumerate(w.run(source.tangents, [*along, *saved])):
                b.store(value, b.gep(to, [integer(j * n)], source_etype=F64), align=8)
    b.ret_void()
    return str(made.module)


def scan(step: Step, program: Program, width: int) -> str:
    """Writes what `engine.scan` describes; a lane is a trial."""
    kinds = [*[PTR] * 3, *[I64] * 5, *[PTR, I64, I64] * len(step.each)]
    made: Any = ir.Function(ir.Module("scan"), ir.FunctionType(VOID, kinds), "scan")
    carry, shared, out, trials, first, by, count, length, *each = made.args
    b: Any = ir.IRBuilder(made.append_basic_block())
    v = _Blocks(b, width)
    lanes = [ir.Constant(I32, i) for i in range(width)]
    sizes = (step.carried, sum(step.each), step.shown)
    kept, given, shown = (room(b, v.type, max(size, 1), 8 * width) for size in sizes)

    def row(array: Value, index: Value, size: Value) -> Value:
        return b.gep(array, [b.mul(index, size)], source_etype=F64)

    def gather(rows: list[Value], frame: Value, size: int) -> None:
        def whole(j: Value) -> None:
            squares = [v.load_at(begin, j) for begin in rows]
            places = [b.add(j, integer(i)) for i in range(width)]
            v.store(v.turned(squares), frame, places)

        def one(j: Value) -> None:
            vector = ir.Constant(v.type, ir.Undefined)
            for lane, begin in zip(lanes, rows, strict=True):
                vector = b.insert_element(vector, number_at(b, begin, j), lane)
            v.store([vector], frame, [j])

        in_squares(size, whole, one)

    def scatter(frame: Value, rows: list[Value], size: int) -> None:
        def whole(j: Value) -> None:
            places = [b.add(j, integer(i)) for i in range(width)]
            for begin, vector in zip(rows, v.turned(v.load(frame, places)), strict=True):
                v.store_at(vector, begin, j)

        def one(j: Value) -> None:
            (vector,) = v.load(frame, [j])
            for lane, begin in zip(lanes, rows, strict=True):
                put(b, b.extract_element(vector, lane), begin, j)

        in_squares(size, whole, one)

    def in_squares(size: int, whole: Callable[[Value], None], one: Callable[[Value], None]) -> None:
        """Copies `width` numbers of each lane at a time, the last of them with some again."""
        if size < width:
            with loop(b, integer(0), integer(size)) as j:
                one(j)
            return
        with loop(b, integer(0), integer(size - size % width), width) as j:
            whole(j)
        if size % width:
            whole(integer(size - width))

    with loop(b, integer(0), trials, width) as group:
        last = b.sub(trials, integer(1))
        own = [b.add(group, integer(i)) for i in range(width)]
        # A group that is not full repeats the last trial.
        own = [b.select(b.icmp_signed("<", one, last), one, last) for one in own]
        begins = [row(carry, one, integer(step.carried)) for one in own]
        gather(begins, kept, step.carried)
        with loop(b, integer(0), count) as i:
            k = b.add(first, b.mul(by, i))
            place = 0
            for j, size in enumerate(step.each):
                array, its_length, stride = each[3 * j : 3 * j + 3]
                rows = [row(array, b.add(b.mul(one, its_length), k), stride) for one in own]
                gather(rows, v.place(given, place), size)
                place += size
            epoch = row(shared, k, integer(step.shared))
            numbers = [v.spread(number_at(b, epoch, integer(j))) for j in range(step.shared)]
            inputs = [*v.load(kept, range(step.carried)), *v.load(given, range(sum(step.each)))]
            found = v.run(program, [*inputs, *numbers])
            v.store(found[: step.carried], kept, range(step.carried))
            v.store(found[step.carried :], shown, range(step.shown))
            to = [row(out, b.add(b.mul(one, length), k), integer(step.shown)) for one in own]
            scatter(shown, to, step.shown)
        scatter(kept, begins, step.carried)
    b.ret_void()
    return str(made.module)


class _Writer:
    """Writes the module of one plan."""

    def __init__(self, plan: StepPlan, width: int) -> None:
        self.plan, self.width, self.module = plan, width, ir.Module("integrate")
        weights = [weight for row in plan.tableau.weights for _, weight in row]
        self.count = -(-len(weights) // width)
        padded = [*weights, *[0.0] * (self.count * width - len(weights))]
        self.table = self._constant("weights", F64, padded, 8 * width)
        self.begin = self._function("begin", [PTR], self._begin)
        self.weigh = self._function("weigh", [PTR, F64], self._weigh)
        self.step = self._function("step", [PTR, F64, F64], self._step)
        self.read = self._function("read", [PTR, F64], self._read)
        if plan.tangents:
            kinds, n = [PTR, PTR, PTR], len(plan.tangents)
            # Short tangents advance in pairs, and one alone where their number is odd.
            paired = n - n % 2 if len(plan.tangents[0]) < _FILLED else 0
            self.groups = [
                group for group in ((0, paired, 2), (paired, n, 1)) if group[0] < group[1]
            ]
            self.move = {
                by: self._function(f"move{by}", kinds, partial(self._move, by))
                for *_, by in self.groups
            }
            self.show = self._function("show", kinds, self._show)
            self.sources = self._constant(
                "sources", I64, [i for row in plan.motion.sources for i in row] or [0], 8
            )
            shown = [i for row in plan.reading.sources for i in row] or [0]
            self.show_sources = self._constant("show_sources", I64, shown, 8)
        kinds = [PTR, PTR, PTR, I64, PTR, I64, I64, PTR, PTR, I64, PTR, I64, PTR, PTR, PTR]
        self._integrate(ir.Function(self.module, ir.FunctionType(VOID, kinds), "integrate"))

    def _constant(self, name: str, kind: ir.Type, values: Sequence[Any], align: int) -> Value:
        made: Any = ir.GlobalVariable(self.module, ir.ArrayType(kind, len(values)), name)
        made.global_constant, made.linkage, made.align = True, "internal", align
        made.initializer, made.type = ir.Constant(made.value_type, values), PTR
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
        body(_Vectors(builder, self.width), *made.args)
        builder.ret_void()
        return made

    def _begin(self, v: _Vectors, frame: Value) -> None:
        plan = self.plan
        v.store(v.run(plan.begin, v.load(frame, [*plan.x, *plan.constants])), frame, plan.begun)

    def _weigh(self, v: _Vectors, frame: Value, h: Value) -> None:
        """Writes h times the weights of the formula, behind the vectors of the frame, a vector at a
        time."""
        share = v.spread(h)
        weighed = [
            v.builder.fmul(share, weight) for weight in v.load(self.table, range(self.count))
        ]
        v.store(weighed, frame, range(self.plan.size, self.plan.size + self.count))

    def _weights(self, v: _Vectors, frame: Value) -> list[list[Value]]:
        rows, place = self.plan.tableau.weights, itertools.count(self.plan.size * self.width)
        return [
            [v.spread(number_at(v.builder, frame, integer(next(place)))) for _ in row]
            for row in rows
        ]

    def _step(self, v: _Vectors, frame: Value, t: Value, h: Value) -> None:
        plan, weights = self.plan, self._weights(v, frame)
        y, fixed = v.load(frame, plan.y), v.load(frame, [*plan.driven, *plan.fixed])
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
            if plan.doubt:
                sides.append(result[-1])
            else:
                v.store(result[len(plan.y) :], frame, plan.kept[s])
        # The end of the step, y + h sum_s B_s k_s.
        ended = v.combine(y, weights[-1], [slopes[j] for j, _ in plan.tableau.weights[-1]])
        v.store(ended, frame, plan.y)
        if plan.doubt:
            # The rates of the stages' moments with the state held, where they depend on the time
            # itself.
            held = [v.run(plan.rates, [time, *y, *fixed]) for time in times] if plan.timed else []
            places = [*plan.reach, *plan.side, *plan.doubt]
            given = [
                v.spread(h),
                *ended,
                *itertools.chain(*slopes, *held),
                *sides,
                *v.load(frame, places),
            ]
            v.store(v.run(plan.watch, given), frame, places)

    def _read(self, v: _Vectors, frame: Value, t: Value) -> None:
        plan = self.plan
        given = [v.spread(t), *v.load(frame, [*plan.y, *plan.driven, *plan.fixed])]
        v.store(v.run(plan.read, given), frame, plan.noted)

    def _move(self, together: int, v: _Vectors, frame: Value, first: Value, driving: Value) -> None:
        """Writes one step of some tangents; `driving` points to the places of their sources."""
        plan, move, weights = self.plan, self.plan.motion, self._weights(v, frame)
        one, d, count = range(together), len(plan.tangents[0]), len(move.sources[0])
        own = [range(k * d, (k + 1) * d) for k in one]
        y, fixed = [v.load(first, place) for place in own], v.load(frame, plan.fixed)
        places = [
            [number_at(v.builder, driving, integer(k * count + i), I64) for i in range(count)]
            for k in one
        ]
        slopes: list[list[list[Value]]] = [[] for _ in one]
        for s, row in enumerate(plan.tableau.weights[:-1]):
            # The stages of the variational equations, by what the state's own stages have kept.
            at = [v.combine(y[k], weights[s], [slopes[k][j] for j, _ in row]) for k in one]
            stage = v.place(frame, s * plan.stage_size)
            saved = v.load(stage, move.saved)
            for k in one:
                slopes[k].append(
                    v.run(move.program, [*at[k], *v.load(stage, places[k]), *saved, *fixed])
                )
        for k in one:
            ended = v.combine(
                y[k], weights[-1], [slopes[k][j] for j, _ in plan.tableau.weights[-1]]
            )
            v.store(ended, first, own[k])

    def _show(self, v: _Vectors, frame: Value, first: Value, driving: Value) -> None:
        plan, show = self.plan, self.plan.reading
        places = [
            number_at(v.builder, driving, integer(i), I64) for i in range(len(show.sources[0]))
        ]
        given = [
            *v.load(first, range(len(plan.tangents[0]))),
            *v.load(frame, [*places, *show.saved, *plan.fixed]),
        ]
        v.store(v.run(show.program, given), frame, plan.shown)

    def _integrate(self, made: Any) -> None:
        (
            x,
            si,
            cases,
            n_cases,
            rows,
            first,
            last,
            times,
            steps,
            n_times,
            offset,
            stride,
            out,
            states,
            frame,
        ) = made.args
        b, plan, width = ir.IRBuilder(made.append_basic_block()), self.plan, self.width
        n, nc, no = len(plan.x), len(plan.constants), len(plan.shown)
        columns, rows_kept = n if plan.tangents else 1, len(plan.y) + len(plan.doubt)
        target, shift, own, kept = (room(b, I64, width) for _ in range(4))
        t, taken = room(b, F64), room(b, F64)

        def at(place: int, lane: Value) -> Value:
            """Returns the pointer to one number in a vector of the frame."""
            return b.add(integer(place * width), lane)

        def tangent(
            j: Value, table: Value, sources: Sequence[Sequence[int]]
        ) -> tuple[Value, Value]:
            """Returns pointers to tangent j and to the list of its sources."""
            lies = b.add(integer(plan.tangents[0].start), b.mul(j, integer(len(plan.tangents[0]))))
            place = _Vectors(b, width).place(frame, lies)
            return place, b.gep(table, [b.mul(j, integer(len(sources[0])))], source_etype=I64)

        def keep(k: Value) -> None:
            """Stores the state at the time k, the start being 0, if it is asked for."""
            asked = b.icmp_signed("!=", b.ptrtoint(states, I64), integer(0))
            with b.if_then(asked), loop(b, integer(0), integer(width)) as lane:
                row = b.add(number_at(b, kept, lane, I64), k)
                for place in (*plan.y, *plan.doubt):
                    put(b, number_at(b, frame, at(place, lane)), states, row)
                    row = b.add(row, b.add(n_times, integer(1)))

        # A group of lanes: their numbers are gathered into the frame, a vector for each.
        with loop(b, first, last, width) as group:
            with loop(b, integer(0), integer(width)) as lane:
                # Lane l is trial rows[l / n_cases] in case l % n_cases; beyond the last, the last
                # again.
                here, end = b.add(group, lane), b.sub(last, integer(1))
                problem = b.select(b.icmp_signed("<", here, end), here, end)
                trial, case = (
                    number_at(b, rows, b.udiv(problem, n_cases), I64),
                    b.urem(problem, n_cases),
                )
                row, constants = b.mul(trial, integer(n)), b.mul(case, integer(nc))
                for j, place in enumerate(plan.x):
                    value = b.fmul(
                        number_at(b, x, b.add(row, integer(j))), number_at(b, si, integer(j))
                    )
                    put(b, value, frame, at(place, lane))
                for j, place in enumerate(plan.constants):
                    put(
                        b, number_at(b, cases, b.add(constants, integer(j))), frame, at(place, lane)
                    )
                # Where the lane's readings go, what is subtracted of them, its constants, and its
                # states.
                place = b.add(b.mul(trial, n_cases), case)
                put(b, b.mul(b.mul(place, n_times), integer(no * columns)), target, lane)
                put(b, b.mul(case, stride), shift, lane)
                put(b, constants, own, lane)
                put(
                    b,
                    b.mul(b.mul(place, b.add(n_times, integer(1))), integer(rows_kept)),
                    kept,
                    lane,
                )
            # The state at time 0, and what is computed once for the lane.
            b.call(self.begin, [frame])
            keep(integer(0))
            b.store(ir.Constant(F64, 0.0), t)
            b.store(
                ir.Constant(F64, float("nan")), taken
            )  # unlike any step, so that the weights are always written
            with loop(b, integer(0), n_times) as k:
                # From reading to reading: h = (times[k] - t) / steps[k].
                to, since = number_at(b, times, k), b.load(t, typ=F64)
                # No step to a time that is reached already: at the start, or where two readings
                # share a time.
                count = b.select(
                    b.fcmp_ordered("==", to, since), integer(0), number_at(b, steps, k, I64)
                )
                h = b.fdiv(b.fsub(to, since), b.sitofp(count, F64))
                # The weights times h are written again where the step has changed.
                with b.if_then(b.fcmp_unordered("!=", h, b.load(taken, typ=F64))):
                    b.call(self.weigh, [frame, h])
                b.store(h, taken)
                # One step of the state, then of the tangents beside it.
                with loop(b, integer(0), count) as s:
                    b.call(self.step, [frame, b.fadd(since, b.fmul(b.sitofp(s, F64), h)), h])
                    for begin, end, by in self.groups if plan.tangents else ():
                        with loop(b, integer(begin), integer(end), by) as j:
                            b.call(
                                self.move[by],
                                [frame, *tangent(j, self.sources, plan.motion.sources)],
                            )
                b.store(to, t)
                keep(b.add(k, integer(1)))
                # The constants of the next interval hold from this reading on.
                if plan.driven:
                    later = b.mul(b.add(k, integer(1)), b.mul(n_cases, integer(nc)))
                    with loop(b, integer(0), integer(width)) as lane:
                        row = b.add(later, number_at(b, own, lane, I64))
                        for j, place in enumerate(plan.driven, start=nc - len(plan.driven)):
                            put(
                                b,
                                number_at(b, cases, b.add(row, integer(j))),
                                frame,
                                at(place, lane),
                            )
                b.call(self.read, [frame, to])
                # Readings less their offset, or Jacobians in the parameters' sizes, to their rows
                # of `out`.
                done = b.mul(k, integer(no))
                with loop(b, integer(0), integer(columns)) as j:
                    if plan.tangents:
                        b.call(
                            self.show, [frame, *tangent(j, self.show_sources, plan.reading.sources)]
                        )
                    with loop(b, integer(0), integer(width)) as lane:
                        begin, less = (
                            number_at(b, target, lane, I64),
                            b.add(number_at(b, shift, lane, I64), done),
                        )
                        for i, place in enumerate(plan.shown):
                            value = number_at(b, frame, at(place, lane))
                            if plan.tangents:
                                value = b.fmul(value, number_at(b, si, j))
                            else:
                                value = b.fsub(value, number_at(b, offset, b.add(less, integer(i))))
                            entry = b.add(b.mul(b.add(done, integer(i)), integer(columns)), j)
                            put(b, value, out, b.add(begin, entry))
        b.ret_void()


class _Vectors:
    """Writes instructions on vectors of `width` doubles. A frame is a pointer to an array of such
    vectors."""

    def __init__(self, builder: ir.IRBuilder, width: int) -> None:
        self.builder, self.width = builder, width
        self.type = ir.VectorType(F64, width)

    def place(self, frame: Value, index: int | Value) -> Value:
        index = integer(index) if isinstance(index, int) else index
        return self.builder.gep(frame, [index], source_etype=self.type)

    def load(self, frame: Value, places: Iterable[int | Value]) -> list[Value]:
        return [
            self.builder.load(self.place(frame, i), typ=self.type, align=8 * self.width)
            for i in places
        ]

    def store(self, values: Sequence[Value], frame: Value, places: Iterable[int]) -> None:
        for value, i in zip(values, places, strict=True):
            self.builder.store(value, self.place(frame, i), align=8 * self.width)

    def load_at(self, array: Value, index: Value) -> Value:
        """Loads numbers that lie side by side anywhere."""
        place = self.builder.gep(array, [index], source_etype=F64)
        return self.builder.load(place, typ=self.type, align=8)

    def store_at(self, value: Value, array: Value, index: Value) -> None:
        self.builder.store(value, self.builder.gep(array, [index], source_etype=F64), align=8)

    def turned(self, square: list[Value]) -> list[Value]:
        """Makes columns of the rows of a square matrix, by blocks of 1, 2, 4 numbers."""
        lanes = range(self.width)
        by = 1
        while by < self.width:
            upper = [i if not i & by else self.width + i - by for i in lanes]
            lower = [i + by if not i & by else self.width + i for i in lanes]
            for i in lanes:
                if not i & by:
                    one = square[i]
                    other = square[i + by]
                    square[i] = self._shuffled(one, other, upper)
                    square[i + by] = self._shuffled(one, other, lower)
            by *= 2
        return square

    def _shuffled(self, one: Value, other: Value, places: list[int]) -> Value:
        mask = ir.Constant(ir.VectorType(I32, self.width), places)
        return self.builder.shuffle_vector(one, other, mask)

    def constant(self, value: float) -> Value:
        return ir.Constant(self.type, [value] * self.width)

    def spread(self, number: Value) -> Value:
        """Makes a vector of equal numbers."""
        nothing = ir.Constant(self.type, ir.Undefined)
        single = self.builder.insert_element(nothing, number, ir.Constant(I32, 0))
        return self.builder.shuffle_vector(
            single, nothing, ir.Constant(ir.VectorType(I32, self.width), None)
        )

    def run(self, program: Program, inputs: Sequence[Value]) -> list[Value]:
        values = list(inputs)
        assert len(values) == program.inputs
        # Values are numbered as in the program: inputs, then the result of each operation.
        for name, *numbers in program.operations:
            constant = name == "constant"
            values.append(
                self.constant(*numbers)
                if constant
                else self.apply(name, *[values[i] for i in numbers])
            )
        return [values[i] for i in program.outputs]

    def combine(
        self, start: list[Value], weights: list[Value], slopes: list[list[Value]]
    ) -> list[Value]:
        """Computes start + sum of weight times slope."""
        for weight, slope in zip(weights, slopes, strict=True):
            start = [self.call("fma", weight, k, y) for k, y in zip(slope, start, strict=True)]
        return start

    def apply(self, name: str, *args: Value) -> Value:
        """Writes one operation of a recorded program."""
        builder = self.builder
        if name in _ARITHMETIC:
            return getattr(builder, _ARITHMETIC[name])(*args)
        match name, args:
            case "neg", [a]:
                return builder.fneg(a)
            # a b - c and c - a b round once, as a b + c does.
            case "fms", [a, b, c]:
                return self.call("fma", a, b, builder.fneg(c))
            case "fnma", [a, b, c]:
                return self.call("fma", builder.fneg(a), b, c)
            case (("fma" | "sqrt" | "floor"), _):
                return self.call(name, *args)
            case (("less" | "less_equal"), [a, b]):
                holds = builder.fcmp_ordered("<" if name == "less" else "<=", a, b)
                return builder.select(holds, self.constant(1.0), self.constant(0.0))
            case "where", [condition, a, b]:
                return builder.select(
                    builder.fcmp_unordered("!=", condition, self.constant(0.0)), a, b
                )
            case "remainder", [a, b]:
                return self._remainder(a, b)
        return self._each(name.replace("arc", "a"), *args)

    def _remainder(self, a: Value, b: Value) -> Value:
        """Writes NumPy's remainder, which has the sign of what divides, to the last bit."""
        builder = self.builder
        zero = self.constant(0.0)
        rest = self._each("fmod", a, b)
        some = builder.fcmp_ordered("!=", rest, zero)
        other = builder.xor(
            builder.fcmp_ordered("<", rest, zero), builder.fcmp_ordered("<", b, zero)
        )
        moved = builder.fadd(rest, b)
        # A rest of 0 has the sign of what divides, too, which arctan2 tells.
        below = builder.fcmp_ordered("<", b, zero)
        nothing = builder.select(below, self.constant(-0.0), zero)
        rest = builder.select(builder.fcmp_ordered("==", rest, zero), nothing, rest)
        return builder.select(builder.and_(some, other), moved, rest)

    def call(self, name: str, *args: Value) -> Value:
        """Writes an instruction of the processor: fma (rounded once), sqrt or floor."""
        return self.builder.call(
            self._declared(f"llvm.{name}.v{self.width}f64", self.type, len(args)), args
        )

    def _each(self, name: str, *args: Value) -> Value:
        """Calls a function of the C library, lane by lane."""
        function = self._declared(name, F64, len(args))
        result = ir.Constant(self.type, ir.Undefined)
        for lane in (ir.Constant(I32, i) for i in range(self.width)):
            number = self.builder.call(
                function, [self.builder.extract_element(a, lane) for a in args]
            )
            result = self.builder.insert_element(result, number, lane)
        return result

    def _declared(self, name: str, kind: ir.Type, count: int) -> ir.Function:
        module = self.builder.module
        return module.globals.get(name) or ir.Function(
            module, ir.FunctionType(kind, [kind] * count), name
        )


class _Blocks(_Vectors):
    """Writes operations on matrices, too, which lie in memory in rows."""

    def apply(self, name: str, *args: Value) -> Value:
        match name.split():
            case ["part", place]:
                return self.load(args[0], [int(place)])[0]
            case ["product", *sizes]:
                return self._product(args, *map(int, sizes))
            case ["orthogonalised", n, columns, checked, small]:
                return self._orthogonalised(args, int(n), int(columns), int(checked), float(small))
        return super().apply(name, *args)

    def _room(self, count: int) -> Value:
        with self.builder.goto_entry_block():
            return room(self.builder, self.type, count, 8 * self.width)

    def _filled(self, values: Sequence[Value]) -> Value:
        frame = self._room(len(values))
        self.store(values, frame, range(len(values)))
        return frame

    def _row(self, frame: Value, i: Value, columns: int) -> Value:
        return self.place(frame, self.builder.mul(i, integer(columns)))

    def _dot(self, one: Sequence[Value], other: Sequence[Value]) -> Value:
        """Computes a sum of products by four sums, of which none waits for another."""
        sums = [self.constant(0.0)] * 4
        for i, (a, c) in enumerate(zip(one, other, strict=True)):
            sums[i % 4] = self.call("fma", a, c, sums[i % 4])
        add = self.builder.fadd
        return add(add(sums[0], sums[1]), add(sums[2], sums[3]))

    def _product(self, args: Sequence[Value], n: int, inner: int, columns: int) -> Value:
        b = self.builder
        A = self._filled(args[: n * inner])
        B = self._filled(args[n * inner :])
        C = self._room(n * columns)
        with loop(b, integer(0), integer(n)) as i:
            row = self.load(self._row(A, i, inner), range(inner))
            to = self._row(C, i, columns)
            with loop(b, integer(0), integer(columns)) as j:
                column = self.load(self.place(B, j), range(0, inner * columns, columns))
                self.store([self._dot(row, column)], self.place(to, j), [0])
        return C

    def _orthogonalised(
        self, args: Sequence[Value], n: int, columns: int, checked: int, small: float
    ) -> Value:
        b = self.builder
        zero = self.constant(0.0)
        one = self.constant(1.0)
        W = self._filled(args)
        F = self._room(n * n)
        least = self._filled([zero] * n)
        with loop(b, integer(0), integer(checked)) as i:
            row = self.load(self._row(W, i, columns), range(columns))
            part = b.fmul(self._dot(row, row), self.constant(small**2))
            self.store([part], self.place(least, i), [0])
        with loop(b, integer(0), integer(n)) as i:
            begin = self._row(W, i, columns)
            row = self.load(begin, range(columns))
            square = self._dot(row, row)
            limit = self.load(least, [i])[0]
            square = b.select(b.fcmp_ordered("<=", square, limit), zero, square)
            none = b.fcmp_ordered("<=", square, zero)
            length = self.call("sqrt", square)
            inverse = b.fdiv(b.select(none, zero, one), b.select(none, one, length))
            direction = [b.fmul(a, inverse) for a in row]
            self.store(direction, begin, range(columns))
            self.store([length], self.place(F, b.mul(i, integer(n + 1))), [0])
            with loop(b, b.add(i, integer(1)), integer(n)) as j:
                at = self._row(W, j, columns)
                direction = self.load(begin, range(columns))
                other = self.load(at, range(columns))
                share = self._dot(other, direction)
                negative = b.fneg(share)
                pairs = zip(direction, other, strict=True)
                self.store([self.call("fma", negative, a, c) for a, c in pairs], at, range(columns))
                self.store([share], self.place(self._row(F, j, n), i), [0])
        return F


@contextmanager
def loop(b: ir.IRBuilder, first: Value, last: Value, by: int = 1) -> Iterator[Value]:
    """Writes a loop for i in range(first, last, by)."""
    test, body, after = (b.append_basic_block(name) for name in ("test", "body", "after"))
    before = b.block
    b.branch(test)
    b.position_at_end(test)
    # i is `first` on the way in, and i + by on the way round.
    i = b.phi(I64)
    i.add_incoming(first, before)
    b.cbranch(b.icmp_signed("<", i, last), body, after)
    b.position_at_end(body)
    yield i
    i.add_incoming(b.add(i, integer(by)), b.block)
    b.branch(test)
    b.position_at_end(after)


def integer(value: int) -> Value:
    return ir.Constant(I64, value)


def number_at(b: ir.IRBuilder, array: Value, index: Value, kind: ir.Type = F64) -> Value:
    return b.load(b.gep(array, [index], source_etype=kind), typ=kind)


def put(b: ir.IRBuilder, value: Value, array: Value, index: Value) -> None:
    b.store(value, b.gep(array, [index], source_etype=value.type))


def room(b: ir.IRBuilder, kind: ir.Type, count: int = 1, align: int = 8) -> Value:
    """Reserves memory of the function's own."""
    made: Any = b.alloca(kind, size=count)
    made.align, made.type = align, PTR  # llvmlite gives it a typed pointer, which stores refuse
    return made
