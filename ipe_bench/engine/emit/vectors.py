"""Instructions on vectors of doubles, a lane for each trial or direction, and loops."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from llvmlite import ir

from ipe_bench.engine.trace import Program

F64 = ir.DoubleType()
I32 = ir.IntType(32)
I64 = ir.IntType(64)
PTR = ir.PointerType()
VOID = ir.VoidType()
_ARITHMETIC = {"add": "fadd", "sub": "fsub", "mul": "fmul", "div": "fdiv"}

Value = Any
"""A value of LLVM's intermediate representation."""


class Vectors:
    """Writes instructions on vectors of `width` doubles. A frame is a pointer to an array of such
    vectors."""

    def __init__(self, builder: ir.IRBuilder, width: int) -> None:
        self.builder = builder
        self.width = width
        self.type = ir.VectorType(F64, width)

    def place(self, frame: Value, index: int | Value) -> Value:
        """Returns the pointer to one vector of a frame."""
        return self.builder.gep(frame, [integer(index)], source_etype=self.type)

    def load(self, frame: Value, places: Iterable[int | Value]) -> list[Value]:
        return [
            self.builder.load(self.place(frame, i), typ=self.type, align=8 * self.width)
            for i in places
        ]

    def store(self, values: Sequence[Value], frame: Value, places: Iterable[int | Value]) -> None:
        for value, i in zip(values, places, strict=True):
            self.builder.store(value, self.place(frame, i), align=8 * self.width)

    def load_at(self, array: Value, index: int | Value) -> Value:
        """Loads numbers that lie side by side anywhere."""
        return self.builder.load(_entry(self.builder, array, index), typ=self.type, align=8)

    def store_at(self, value: Value, array: Value, index: int | Value) -> None:
        """Stores numbers side by side anywhere."""
        self.builder.store(value, _entry(self.builder, array, index), align=8)

    def lane(self, vector: Value, place: int) -> Value:
        """Returns the number in one lane."""
        return self.builder.extract_element(vector, ir.Constant(I32, place))

    def gathered(self, numbers: Iterable[Value]) -> Value:
        """Makes a vector of a number for each lane."""
        vector = ir.Constant(self.type, ir.Undefined)
        for place, number in enumerate(numbers):
            vector = self.builder.insert_element(vector, number, ir.Constant(I32, place))
        return vector

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
        """Writes a recorded program, and returns its outputs."""
        values = list(inputs)
        assert len(values) == program.inputs
        # Values are numbered as in the program: inputs, then the result of each operation.
        for name, *numbers in program.operations:
            if name == "constant":
                made = self.constant(*numbers)
            else:
                made = self.apply(name, *[values[i] for i in numbers])
            values.append(made)
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
        kinds = [self.type] * len(args)
        function = self._declared(f"llvm.{name}.v{self.width}f64", self.type, kinds)
        return self.builder.call(function, args)

    def _each(self, name: str, *args: Value) -> Value:
        """Calls a function of the C library, lane by lane."""
        function = self._declared(name, F64, [F64] * len(args))
        lanes = ([self.lane(a, i) for a in args] for i in range(self.width))
        return self.gathered(self.builder.call(function, numbers) for numbers in lanes)

    def _declared(self, name: str, kind: ir.Type, given: Sequence[ir.Type]) -> ir.Function:
        """Returns a function that is compiled elsewhere, declared once a module."""
        module = self.builder.module
        known = module.globals.get(name)
        return known or ir.Function(module, ir.FunctionType(kind, given), name)


@contextmanager
def loop(b: ir.IRBuilder, first: int | Value, last: int | Value, by: int = 1) -> Iterator[Value]:
    """Writes a loop for i in range(first, last, by)."""
    test = b.append_basic_block("test")
    body = b.append_basic_block("body")
    after = b.append_basic_block("after")
    before = b.block
    b.branch(test)
    b.position_at_end(test)
    # i is `first` on the way in, and i + by on the way round.
    i = b.phi(I64)
    i.add_incoming(integer(first), before)
    b.cbranch(b.icmp_signed("<", i, integer(last)), body, after)
    b.position_at_end(body)
    yield i
    i.add_incoming(b.add(i, integer(by)), b.block)
    b.branch(test)
    b.position_at_end(after)


def opened(module: ir.Module, name: str, kinds: Sequence[ir.Type]) -> Any:
    """Begins a function without a result; returns its builder, whose `function` has the `args`."""
    function = ir.Function(module, ir.FunctionType(VOID, kinds), name)
    return ir.IRBuilder(function.append_basic_block())


def integer(value: int | Value) -> Value:
    """Returns a whole number as a value, which it may be already."""
    return ir.Constant(I64, value) if isinstance(value, int) else value


def smaller(b: ir.IRBuilder, one: Value, other: Value) -> Value:
    """Writes the smaller of two whole numbers."""
    return b.select(b.icmp_signed("<", one, other), one, other)


def is_given(b: ir.IRBuilder, pointer: Value) -> Value:
    """Writes whether a pointer is not null."""
    return b.icmp_signed("!=", b.ptrtoint(pointer, I64), integer(0))


def row_of(b: ir.IRBuilder, array: Value, index: Value, size: int | Value) -> Value:
    """Returns the pointer to a row of an array of numbers, each row `size` numbers long."""
    return _entry(b, array, b.mul(index, integer(size)))


def number_at(b: ir.IRBuilder, array: Value, index: int | Value, kind: ir.Type = F64) -> Value:
    return b.load(_entry(b, array, index, kind), typ=kind)


def put(b: ir.IRBuilder, value: Value, array: Value, index: Value) -> None:
    b.store(value, _entry(b, array, index, value.type))


def _entry(b: ir.IRBuilder, array: Value, index: int | Value, kind: ir.Type = F64) -> Value:
    """Returns the pointer to one entry of an array."""
    return b.gep(array, [integer(index)], source_etype=kind)


def room(b: ir.IRBuilder, kind: ir.Type, count: int = 1, align: int = 8) -> Value:
    """Reserves memory of the function's own."""
    made: Any = b.alloca(kind, size=count)
    made.align = align
    # llvmlite gives it a typed pointer, which stores refuse.
    made.type = PTR
    return made
