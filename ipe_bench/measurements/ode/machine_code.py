"""Turns recorded programs into vector instructions, as functions that compiled code may call.

A value is a vector with one number for each of `width` initial value problems, or a single number where width is 0.
Every operation is exact IEEE arithmetic in a fixed order, so a problem's bits do not depend on the width, on its
neighbours, or on what a compiler finds faster. What the functions are called on is left to `source`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numba.np.arrayobj import make_array

from ipe_bench.measurements.ode.tableau import Tableau
from ipe_bench.measurements.ode.trace import Program

_DOUBLE = ir.DoubleType()
_INDEX = ir.IntType(64)
_ARITHMETIC = {"add": "fadd", "sub": "fsub", "mul": "fmul", "div": "fdiv"}
_OF_C = {"arctan": "atan"}

Value = Any
"""A value of LLVM's intermediate representation."""


@dataclass(frozen=True)
class Emitter:
    """Writes instructions on vectors of `width` numbers that lie one after another in a buffer of doubles."""

    builder: ir.IRBuilder
    buffer: Value
    width: int

    @property
    def type(self) -> ir.Type:
        return ir.VectorType(_DOUBLE, self.width) if self.width else _DOUBLE

    def constant(self, value: float) -> Value:
        return ir.Constant(self.type, [value] * self.width if self.width else value)

    def pointer(self, place: int | Value) -> Value:
        place = ir.Constant(_INDEX, place) if isinstance(place, int) else place
        return self.builder.gep(self.buffer, [place])

    def load(self, place: int | Value) -> Value:
        """The vector at this place of the buffer; places are multiples of the width."""
        where = self.builder.bitcast(self.pointer(place), ir.PointerType(self.type))
        return self.builder.load(where, align=8 * max(1, self.width))

    def after(self, place: int | Value, distance: int) -> int | Value:
        if isinstance(place, int):
            return place + distance
        return self.builder.add(place, ir.Constant(_INDEX, distance))

    def loads(self, place: int | Value, count: int, apart: int = 0) -> list[Value]:
        return [self.load(self.after(place, i * (apart or self.width))) for i in range(count)]

    def stores(self, values: Sequence[Value], place: int | Value) -> None:
        for i, value in enumerate(values):
            self.store(value, self.after(place, i * self.width))

    def store(self, value: Value, place: int | Value) -> None:
        where = self.builder.bitcast(self.pointer(place), ir.PointerType(self.type))
        self.builder.store(value, where, align=8 * max(1, self.width))

    def spread(self, number: Value) -> Value:
        """A vector of equal numbers."""
        if not self.width:
            return number
        single = self.builder.insert_element(ir.Constant(self.type, ir.Undefined), number, _lane(0))
        everywhere = ir.Constant(ir.VectorType(ir.IntType(32), self.width), [0] * self.width)
        return self.builder.shuffle_vector(single, ir.Constant(self.type, ir.Undefined), everywhere)

    def run(self, program: Program, inputs: Sequence[Value]) -> list[Value]:
        values = list(inputs)
        assert len(values) == program.inputs
        for name, *numbers in program.operations:
            values.append(
                self.constant(numbers[0]) if name == "constant" else self._apply(name, [values[i] for i in numbers])
            )
        return [values[i] for i in program.outputs]

    def combine(
        self, start: Sequence[Value], weights: Sequence[Value], slopes: Sequence[Sequence[Value]]
    ) -> list[Value]:
        """start + sum of weight times slope."""
        result = list(start)
        for weight, slope in zip(weights, slopes, strict=True):
            result = [self.fma(weight, k, y) for k, y in zip(slope, result, strict=True)]
        return result

    def fma(self, a: Value, b: Value, c: Value) -> Value:
        """a b + c, rounded once."""
        return self._intrinsic("fma", [a, b, c])

    def _intrinsic(self, name: str, args: Sequence[Value]) -> Value:
        kind = ir.FunctionType(self.type, [self.type] * len(args))
        suffix = f"v{self.width}f64" if self.width else "f64"
        function = cgutils.get_or_insert_function(self.builder.module, kind, f"llvm.{name}.{suffix}")
        return self.builder.call(function, args)

    def _apply(self, name: str, args: list[Value]) -> Value:
        builder = self.builder
        if name in _ARITHMETIC:
            return getattr(builder, _ARITHMETIC[name])(*args)
        match name, args:
            case "neg", [a]:
                return builder.fneg(a)
            case "fma", [a, b, c]:
                return self.fma(a, b, c)
            case "fms", [a, b, c]:
                return self.fma(a, b, builder.fneg(c))
            case "fnma", [a, b, c]:
                return self.fma(builder.fneg(a), b, c)
            case "sqrt", [a]:
                return self._intrinsic("sqrt", [a])
        return self._each(name, args)

    def _each(self, name: str, args: list[Value]) -> Value:
        """A function of the C library, number by number."""
        kind = ir.FunctionType(_DOUBLE, [_DOUBLE] * len(args))
        function = cgutils.get_or_insert_function(self.builder.module, kind, _OF_C.get(name, name))
        if not self.width:
            return self.builder.call(function, args)
        result = ir.Constant(self.type, ir.Undefined)
        for i in range(self.width):
            number = self.builder.call(function, [self.builder.extract_element(a, _lane(i)) for a in args])
            result = self.builder.insert_element(result, number, _lane(i))
        return result


def _lane(i: int) -> ir.Constant:
    return ir.Constant(ir.IntType(32), i)


@dataclass(frozen=True, kw_only=True)
class Places:
    """Where things lie in the buffer of one group of problems, in doubles, and how many vectors there are of each."""

    states: int
    """The state lies first."""
    fixed: int
    """Values that depend on the parameters and the constants of the case alone follow it."""
    weights: int
    """Weights of the formula times h: single numbers."""
    out: int
    """Where what is read is put."""
    size: int
    tangents: int = 0
    """Numbers that make up one tangent."""
    stage: int = 0
    """What tangents need of each stage: `stage_size` numbers for each, `stage_values` vectors first, then sources."""
    stage_size: int = 0
    stage_values: int = 0
    reading: int = 0
    """What tangents need of a reading."""
    reading_values: int = 0


def stepper(width: int, tableau: Tableau, program: Program, places: Places, timed: bool) -> Any:
    """step(buffer, t, h): one step of every problem. The program computes the slopes from (t,) y and what is fixed, and
    behind them what tangents need of the stage."""

    def emit(out: Emitter, t: Value, h: Value) -> None:
        y, fixed = out.loads(0, places.states), _fixed(out, places)
        weights = _weights(out, tableau, places.weights)
        slopes: list[list[Value]] = []
        for s, row in enumerate(tableau.weights[:-1]):
            at = out.combine(y, weights[s], [slopes[j] for j, _ in row])
            time = [_time(out, t, h, tableau.C[s])] if timed else []
            result = out.run(program, [*time, *at, *fixed])
            slopes.append(result[: places.states])
            out.stores(result[places.states :], places.stage + s * places.stage_size)
        out.stores(out.combine(y, weights[-1], [slopes[j] for j, _ in tableau.weights[-1]]), 0)

    return _on_state(width, emit)


def reader(width: int, program: Program, places: Places, place: int, timed: bool) -> Any:
    """read(buffer, t, h): what the program computes from (t,) y and what is fixed, put at `place`."""

    def emit(out: Emitter, t: Value, h: Value) -> None:
        del h
        time = [out.spread(t)] if timed else []
        out.stores(out.run(program, [*time, *out.loads(0, places.states), *_fixed(out, places)]), place)

    return _on_state(width, emit)


def tangent_stepper(width: int, tableau: Tableau, program: Program, places: Places, sources: int, together: int) -> Any:
    """step(buffer, place, sources, k): one step of the tangents k, k + 1, ... (as many as go together) that lie from
    `place` on, through the stages of the state's own step.

    The program computes the slopes from a tangent, its sources, what is saved of the stage and what is fixed.
    `sources[k]` are the places of the sources in the first stage. Two that go together share what they load, and one
    computes while the other waits for its own results.
    """
    one = range(together)

    def emit(out: Emitter, place: Value, driving: Sequence[Value]) -> None:
        begins = [out.after(place, k * places.tangents * width) for k in one]
        y, fixed = [out.loads(begin, places.tangents) for begin in begins], _fixed(out, places)
        weights = _weights(out, tableau, places.weights)
        slopes: list[list[list[Value]]] = [[] for _ in one]
        for s, row in enumerate(tableau.weights[:-1]):
            at = [out.combine(y[k], weights[s], [slopes[k][j] for j, _ in row]) for k in one]
            saved = out.loads(places.stage + s * places.stage_size, places.stage_values)
            for k in one:
                own = driving[k * sources : (k + 1) * sources]
                driven = [out.load(out.after(source, s * places.stage_size)) for source in own]
                slopes[k].append(out.run(program, [*at[k], *driven, *saved, *fixed]))
        for k in one:
            out.stores(out.combine(y[k], weights[-1], [slopes[k][j] for j, _ in tableau.weights[-1]]), begins[k])

    return _on_tangent(width, sources, together, emit)


def tangent_reader(width: int, program: Program, places: Places, sources: int) -> Any:
    """read(buffer, place, sources, k): the outputs' tangent, from tangent k at `place` and what `reader` has saved."""

    def emit(out: Emitter, place: Value, driving: Sequence[Value]) -> None:
        y, saved = out.loads(place, places.tangents), out.loads(places.reading, places.reading_values)
        driven = [out.load(source) for source in driving]
        out.stores(out.run(program, [*y, *driven, *saved, *_fixed(out, places)]), places.out)

    return _on_tangent(width, sources, 1, emit)


def beginner(program: Program, stores: Sequence[int], n: int, constants: int) -> Any:
    """begin(buffer, lane, x, i, si, cases, k): what is fixed for trial i in case k and where it starts, put in place
    for its lane. Parameters are x[i] times si."""

    @intrinsic
    def begin(typingctx: Any, buffer: Any, lane: Any, x: Any, i: Any, si: Any, cases: Any, k: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            base, trials, sizes, table = (_data(context, builder, signature, args, a) for a in (0, 2, 4, 5))
            at = builder.gep(trials, [builder.mul(args[3], ir.Constant(_INDEX, n))])
            row, size = Emitter(builder, at, 0), Emitter(builder, sizes, 0)
            case = Emitter(builder, builder.gep(table, [builder.mul(args[6], ir.Constant(_INDEX, constants))]), 0)
            values = [builder.fmul(row.load(j), size.load(j)) for j in range(n)]
            out = Emitter(builder, builder.gep(base, [args[1]]), 0)
            for value, place in zip(out.run(program, values + case.loads(0, constants, 1)), stores, strict=True):
                out.store(value, place)
            return context.get_dummy_value()

        return types.void(buffer, lane, x, i, si, cases, k), generate

    return begin


def scalar(program: Program, n: int) -> Any:
    """value(x, i, si): the one number that the program computes from the parameters x[i] times si."""

    @intrinsic
    def value(typingctx: Any, x: Any, i: Any, si: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            trials, sizes = (_data(context, builder, signature, args, a) for a in (0, 2))
            row = Emitter(builder, builder.gep(trials, [builder.mul(args[1], ir.Constant(_INDEX, n))]), 0)
            values = zip(row.loads(0, n, 1), Emitter(builder, sizes, 0).loads(0, n, 1), strict=True)
            return row.run(program, [builder.fmul(v, size) for v, size in values])[0]

        return types.float64(x, i, si), generate

    return value


def _on_state(width: int, emit: Callable[[Emitter, Value, Value], None]) -> Any:
    @intrinsic
    def function(typingctx: Any, buffer: Any, t: Any, h: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            def body(inner: Any, given: Sequence[Value]) -> None:
                emit(Emitter(inner, given[0], width), given[1], given[2])

            _apart(builder, [_data(context, builder, signature, args, 0), *args[1:]], body)
            return context.get_dummy_value()

        return types.void(buffer, t, h), generate

    return function


def _on_tangent(
    width: int, sources: int, together: int, emit: Callable[[Emitter, Value, Sequence[Value]], None]
) -> Any:
    @intrinsic
    def function(typingctx: Any, buffer: Any, place: Any, table: Any, k: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            def body(inner: Any, given: Sequence[Value]) -> None:
                count = sources * together
                where = [inner.load(inner.gep(given[2], [ir.Constant(_INDEX, i)])) for i in range(count)]
                emit(Emitter(inner, given[0], width), given[1], where)

            row = builder.mul(args[3], ir.Constant(_INDEX, sources))
            places = builder.gep(_data(context, builder, signature, args, 2), [row])
            _apart(builder, [_data(context, builder, signature, args, 0), args[1], places], body)
            return context.get_dummy_value()

        return types.void(buffer, place, table, k), generate

    return function


def _apart(builder: Any, args: Sequence[Value], body: Callable[[Any, Sequence[Value]], None]) -> None:
    """Calls a function of its own with this body: registers that spill then lie aligned on a stack of their own."""
    module = builder.module
    kind = ir.FunctionType(ir.VoidType(), [a.type for a in args])
    function = ir.Function(module, kind, module.get_unique_name(f"{builder.function.name}.apart"))
    function.linkage = "internal"
    function.attributes.add("noinline")
    function.attributes.alignstack = 64
    inner = ir.IRBuilder(function.append_basic_block())
    body(inner, function.args)
    inner.ret_void()
    builder.call(function, args)


def _data(context: Any, builder: Any, signature: Any, args: Any, i: int) -> Value:
    return make_array(signature.args[i])(context, builder, args[i]).data


def _fixed(out: Emitter, places: Places) -> list[Value]:
    return out.loads(places.states * out.width, places.fixed)


def _time(out: Emitter, t: Value, h: Value, share: float) -> Value:
    return out.spread(Emitter(out.builder, out.buffer, 0).fma(h, ir.Constant(_DOUBLE, share), t))


def _weights(out: Emitter, tableau: Tableau, place: int) -> list[list[Value]]:
    """The weights of every stage and of the end, which lie in the buffer already multiplied by h."""
    result, single = [], Emitter(out.builder, out.buffer, 0)
    for row in tableau.weights:
        result.append([out.spread(single.load(place + i)) for i in range(len(row))])
        place += len(row)
    return result
