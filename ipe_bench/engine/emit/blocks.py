"""Operations on whole matrices, as loops over rows that lie in memory.

An entry of a matrix is a vector, a lane for each trial. Entries lie row by row in a block of memory
that the function takes when it is called and gives back at its end: a stack would not hold large
ones. Where a recorded program says `product` or `orthogonalised` (see `engine.scan`), a loop is
written in place of thousands of single operations; `part i` reads entry i of its result.
"""

from __future__ import annotations

from collections.abc import Sequence

from llvmlite import ir

from ipe_bench.engine.emit.vectors import I64, PTR, VOID, Value, Vectors, integer, loop


class Blocks(Vectors):
    """Writes operations on vectors, and on matrices of them."""

    def __init__(self, builder: ir.IRBuilder, width: int) -> None:
        super().__init__(builder, width)
        self.taken: list[Value] = []

    def release(self) -> None:
        """Gives back all memory that was taken: written once, at the end of the function."""
        for taken in self.taken:
            self.builder.call(self._declared("free", VOID, [PTR]), [taken])

    def apply(self, name: str, *args: Value) -> Value:
        match name.split():
            case ["part", place]:
                return self.load(args[0], [int(place)])[0]
            case ["product", *sizes]:
                return self._product(args, *map(int, sizes))
            case ["orthogonalised", *sizes, small]:
                return self._orthogonalised(args, float(small), *map(int, sizes))
        return super().apply(name, *args)

    def _product(self, args: Sequence[Value], n: int, inner: int, columns: int) -> Value:
        """Writes C = A B of A (n, inner) and B (inner, columns), the entries of which are the
        arguments."""
        b = self.builder
        A = self._filled(args[: n * inner])
        B = self._filled(args[n * inner :])
        C = self._room(n * columns)
        with loop(b, 0, n) as i:
            row = self.load(self._row(A, i, inner), range(inner))
            result = self._row(C, i, columns)
            with loop(b, 0, columns) as j:
                # Column j of B: every entry that lies `columns` further on.
                column = self.load(self.place(B, j), range(0, inner * columns, columns))
                self.store([self._dot(row, column)], result, [j])
        return C

    def _orthogonalised(
        self, args: Sequence[Value], small: float, n: int, columns: int, checked: int
    ) -> Value:
        """Writes the lower triangle F (n, n) with F F' = W W', of W (n, columns) whose entries are
        the arguments, by modified Gram and Schmidt; `engine.scan.orthogonalised` says what is
        `checked`, and is this in single operations."""
        b = self.builder
        W = self._filled(args)
        F = self._room(n * n)
        least = self._least_squares(W, n, columns, checked, small)
        with loop(b, 0, n) as i:
            begin = self._row(W, i, columns)
            (limit,) = self.load(least, [i])
            length = self._make_unit(begin, columns, limit)
            diagonal = b.mul(i, integer(n + 1))
            self.store([length], F, [diagonal])
            after = b.add(i, integer(1))
            with loop(b, after, n) as j:
                share = self._take_off(self._row(W, j, columns), begin, columns)
                self.store([share], self._row(F, j, n), [i])
        return F

    def _least_squares(self, W: Value, n: int, columns: int, checked: int, small: float) -> Value:
        """Writes the squared length (n,) up to which what is left of each row counts as 0."""
        b = self.builder
        part = self.constant(small**2)
        least = self._filled([self.constant(0.0)] * n)
        with loop(b, 0, checked) as i:
            row = self.load(self._row(W, i, columns), range(columns))
            square = self._dot(row, row)
            self.store([b.fmul(square, part)], least, [i])
        return least

    def _make_unit(self, begin: Value, columns: int, limit: Value) -> Value:
        """Divides a row by its length, and returns this; both are 0 if its square is within the
        limit."""
        b = self.builder
        zero = self.constant(0.0)
        one = self.constant(1.0)
        row = self.load(begin, range(columns))
        square = self._dot(row, row)
        square = b.select(b.fcmp_ordered("<=", square, limit), zero, square)
        none = b.fcmp_ordered("<=", square, zero)
        length = self.call("sqrt", square)
        # Without a length no lane divides by 0: it has 0 / 1.
        above = b.select(none, zero, one)
        inverse = b.fdiv(above, b.select(none, one, length))
        unit = [b.fmul(a, inverse) for a in row]
        self.store(unit, begin, range(columns))
        return length

    def _take_off(self, other: Value, begin: Value, columns: int) -> Value:
        """Takes off another row its part along a row of unit length, and returns how long that
        is."""
        b = self.builder
        direction = self.load(begin, range(columns))
        row = self.load(other, range(columns))
        share = self._dot(row, direction)
        negative = b.fneg(share)
        pairs = zip(direction, row, strict=True)
        rest = [self.call("fma", negative, a, c) for a, c in pairs]
        self.store(rest, other, range(columns))
        return share

    def _dot(self, one: Sequence[Value], other: Sequence[Value]) -> Value:
        """Computes a sum of products by four sums, of which none waits for another."""
        sums = [self.constant(0.0)] * 4
        for i, (a, c) in enumerate(zip(one, other, strict=True)):
            which = i % 4
            sums[which] = self.call("fma", a, c, sums[which])
        first = self.builder.fadd(sums[0], sums[1])
        second = self.builder.fadd(sums[2], sums[3])
        return self.builder.fadd(first, second)

    def _row(self, matrix: Value, i: Value, columns: int) -> Value:
        return self.place(matrix, self.builder.mul(i, integer(columns)))

    def _filled(self, values: Sequence[Value]) -> Value:
        """Takes memory, and writes these vectors into it."""
        matrix = self._room(len(values))
        self.store(values, matrix, range(len(values)))
        return matrix

    def _room(self, count: int) -> Value:
        """Takes memory for this many vectors, on the border of one; at the entry of the function,
        so that loops take it once."""
        b = self.builder
        align = 8 * self.width
        with b.goto_entry_block():
            # One vector more than is needed, of which the part before the border is left.
            size = integer(align * (count + 1))
            taken = b.call(self._declared("malloc", PTR, [I64]), [size])
            self.taken.append(taken)
            end = b.add(b.ptrtoint(taken, I64), integer(align - 1))
            return b.inttoptr(b.and_(end, integer(-align)), PTR)
