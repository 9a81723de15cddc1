"""Operations on matrices of vectors, as loops over rows that lie in memory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from llvmlite import ir

from ipe_bench.engine.emit.vectors import I64, PTR, VOID, Value, Vectors, integer, loop


class Blocks(Vectors):
    """Writes operations on matrices, too, which lie in rows in memory that is taken for a call: a
    stack would not hold large ones."""

    def __init__(self, builder: ir.IRBuilder, width: int) -> None:
        super().__init__(builder, width)
        self.taken: list[Value] = []

    def release(self) -> None:
        """Writes the end of a call."""
        for taken in self.taken:
            self.builder.call(self._of_library("free", VOID, PTR), [taken])

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
        b = self.builder
        align = 8 * self.width
        with b.goto_entry_block():
            size = integer(align * (count + 1))
            taken = b.call(self._of_library("malloc", PTR, I64), [size])
            self.taken.append(taken)
            end = b.add(b.ptrtoint(taken, I64), integer(align - 1))
            return b.inttoptr(b.and_(end, integer(-align)), PTR)

    def _of_library(self, name: str, kind: ir.Type, given: ir.Type) -> Any:
        module = self.builder.module
        known = module.globals.get(name)
        return known or ir.Function(module, ir.FunctionType(kind, [given]), name)

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
