"""Writing modules of LLVM's intermediate representation: vectors, loops, functions.

Every operation is IEEE arithmetic in a fixed order, so the bits of a lane do not depend on the number of lanes.
`compiled` turns such modules into machine code, and imports this file only where something is compiled.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from llvmlite import ir

F64, I32, I64, PTR, VOID = ir.DoubleType(), ir.IntType(32), ir.IntType(64), ir.PointerType(), ir.VoidType()
_ARITHMETIC = {"add": "fadd", "sub": "fsub", "mul": "fmul", "div": "fdiv"}

Value = Any
"""A value of LLVM's intermediate representation."""


def integer(value: int) -> Value:
    return ir.Constant(I64, value)


class Vectors:
    """Instructions on vectors of `width` doubles. A frame is a pointer to an array of such vectors."""

    def __init__(self, builder: ir.IRBuilder, width: int) -> None:
        self.builder, self.width = builder, width
        self.type = ir.VectorType(F64, width) if width > 1 else F64

    def place(self, frame: Value, index: int | Value) -> Value:
        index = integer(index) if isinstance(index, int) else index
        return self.builder.gep(frame, [index], source_etype=self.type)

    def load(self, frame: Value, places: Iterable[int | Value]) -> list[Value]:
        return [self.builder.load(self.place(frame, i), typ=self.type, align=8 * self.width) for i in places]

    def store(self, values: Sequence[Value], frame: Value, places: Iterable[int]) -> None:
        for value, i in zip(values, places, strict=True):
            self.builder.store(value, self.place(frame, i), align=8 * self.width)

    def constant(self, value: float) -> Value:
        return ir.Constant(self.type, [value] * self.width if self.width > 1 else value)

    def spread(self, number: Value) -> Value:
        """A vector of equal numbers."""
        if self.width == 1:
            return number
        nothing = ir.Constant(self.type, ir.Undefined)
        single = self.builder.insert_element(nothing, number, ir.Constant(I32, 0))
        return self.builder.shuffle_vector(single, nothing, ir.Constant(ir.VectorType(I32, self.width), None))

    def apply(self, name: str, *args: Value) -> Value:
        """One operation of a recorded program."""
        builder = self.builder
        if name in _ARITHMETIC:
            return getattr(builder, _ARITHMETIC[name])(*args)
        match name, args:
            case "neg", [a]:
                return builder.fneg(a)
            case "fms", [a, b, c]:
                return self.call("fma", a, b, builder.fneg(c))
            case "fnma", [a, b, c]:
                return self.call("fma", builder.fneg(a), b, c)
            case (("fma" | "sqrt"), _):
                return self.call(name, *args)
            case (("less" | "less_equal"), [a, b]):
                holds = builder.fcmp_ordered("<" if name == "less" else "<=", a, b)
                return builder.select(holds, self.constant(1.0), self.constant(0.0))
            case "where", [condition, a, b]:
                return builder.select(builder.fcmp_unordered("!=", condition, self.constant(0.0)), a, b)
        return self._each("atan" if name == "arctan" else name, *args)

    def call(self, name: str, *args: Value) -> Value:
        """An instruction of the processor: fma (rounded once) or sqrt."""
        suffix = f"v{self.width}f64" if self.width > 1 else "f64"
        return self.builder.call(_declared(self.builder, f"llvm.{name}.{suffix}", [self.type] * len(args)), args)

    def _each(self, name: str, *args: Value) -> Value:
        """A function of the C library, lane by lane."""
        function = _declared(self.builder, name, [F64] * len(args))
        if self.width == 1:
            return self.builder.call(function, args)
        result = ir.Constant(self.type, ir.Undefined)
        for lane in (ir.Constant(I32, i) for i in range(self.width)):
            number = self.builder.call(function, [self.builder.extract_element(a, lane) for a in args])
            result = self.builder.insert_element(result, number, lane)
        return result


def _declared(builder: ir.IRBuilder, name: str, kinds: Sequence[ir.Type]) -> ir.Function:
    known = builder.module.globals.get(name)
    return known or ir.Function(builder.module, ir.FunctionType(kinds[0], kinds), name)


@contextmanager
def loop(b: ir.IRBuilder, first: Value, last: Value, by: int = 1) -> Iterator[Value]:
    """for i in range(first, last, by)"""
    test, body, after = (b.append_basic_block(name) for name in ("test", "body", "after"))
    before = b.block
    b.branch(test)
    b.position_at_end(test)
    i = b.phi(I64)
    i.add_incoming(first, before)
    b.cbranch(b.icmp_signed("<", i, last), body, after)
    b.position_at_end(body)
    yield i
    i.add_incoming(b.add(i, integer(by)), b.block)
    b.branch(test)
    b.position_at_end(after)


def function(module: ir.Module, name: str, kinds: Sequence[ir.Type], body: Callable[..., None]) -> ir.Function:
    """A function of its own, never inlined, whose stack is aligned: registers that spill would else lie across cache
    lines, which takes half as long again."""
    made: Any = ir.Function(module, ir.FunctionType(VOID, kinds), name)
    made.linkage = "internal"
    made.attributes.add("noinline")
    made.attributes.alignstack = 64
    builder = ir.IRBuilder(made.append_basic_block())
    body(builder, *made.args)
    builder.ret_void()
    return made


def number_at(b: ir.IRBuilder, array: Value, index: Value, kind: ir.Type = F64) -> Value:
    return b.load(b.gep(array, [index], source_etype=kind), typ=kind)


def put(b: ir.IRBuilder, value: Value, array: Value, index: Value) -> None:
    b.store(value, b.gep(array, [index], source_etype=value.type))


def room(b: ir.IRBuilder, kind: ir.Type, count: int = 1, align: int = 8) -> Value:
    """Memory of the function's own."""
    made: Any = b.alloca(kind, size=count)
    made.align, made.type = align, PTR  # llvmlite gives it a typed pointer, which stores refuse
    return made
