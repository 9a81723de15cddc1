"""Writes recorded functions of rows of numbers: a loop over the rows, one row at a time.

The values of a row are computed as single numbers, vectors of one lane. Its slopes are computed
several columns at a time: a lane follows the tangent along one of the numbers x_j, whose direction
is row j of the unit matrix.
"""

from __future__ import annotations

from llvmlite import ir

from ipe_bench.engine.emit.vectors import (
    I64,
    PTR,
    Value,
    Vectors,
    integer,
    is_given,
    loop,
    opened,
    put,
    row_of,
    smaller,
)
from ipe_bench.engine.trace import Program, RowPrograms


def rates(program: Program, width: int) -> str:
    """Writes a program of n parameters and one result, the rate of a trial.

        void rates(double *x, double *si, double *out, int64 trials)

    computes out (trials,) of the rows x (trials, n), each number times its size in si (n,). The
    width is 1: a trial at a time.
    """
    module = ir.Module("rates")
    b = opened(module, "rates", [PTR, PTR, PTR, I64])
    x, si, out, trials = b.function.args
    v = Vectors(b, width)
    n = program.inputs
    with loop(b, 0, trials) as i:
        row = v.load(row_of(b, x, i, n), range(n))
        sizes = v.load(si, range(n))
        parameters = [b.fmul(number, size) for number, size in zip(row, sizes, strict=True)]
        (rate,) = v.run(program, parameters)
        put(b, rate, out, i)
    b.ret_void()
    return str(module)


def rows(source: RowPrograms, width: int) -> str:
    """Writes a function y(x, c) of rows, m values of n numbers x and p numbers c, with its slopes.

        void rows(double *x, double *c, int64 count, double *unit, double *y, double *J,
                  int64 total)

    computes, of each row i of x (total, n) and row i % count of c (count, p), the values y
    (total, m) and, unless J is null, the slopes dy/dx, J (total, m, n). `unit` is the unit matrix
    (n, n), and the width at most n.
    """
    module = ir.Module("rows")
    b = opened(module, "rows", [PTR, PTR, I64, PTR, PTR, PTR, I64])
    x, c, count, unit, y, J, total = b.function.args
    v = Vectors(b, 1)
    n = source.n
    m = source.m
    p = source.values.inputs - n
    slopes_wanted = is_given(b, J)
    with loop(b, 0, total) as i:
        numbers = v.load(row_of(b, x, i, n), range(n))
        repeated = b.urem(i, count)
        constants = v.load(row_of(b, c, repeated, p), range(p))
        results = v.run(source.values, [*numbers, *constants])
        values = results[:m]
        v.store(values, row_of(b, y, i, m), range(m))
        with b.if_then(slopes_wanted):
            # Behind the values stands what the tangents need of them.
            held = [v.lane(result, 0) for result in results[m:]]
            slopes = row_of(b, J, i, m * n)
            _write_slopes(Vectors(b, width), source, held, unit, slopes)
    b.ret_void()
    return str(module)


def _write_slopes(
    v: Vectors, source: RowPrograms, held: list[Value], unit: Value, J: Value
) -> None:
    """Writes the slopes J (m, n) of one row, `width` columns at a time, from the numbers of its
    values that are `held`."""
    b = v.builder
    n = source.n
    last = integer(n - v.width)
    with loop(b, 0, n, v.width) as column:
        # Where fewer columns than lanes are left, the vector begins earlier, to end with the last
        # column: some columns are computed twice, and none beyond the row.
        first = smaller(b, column, last)
        rows_of_unit = [b.add(first, integer(j * n)) for j in range(n)]
        directions = [v.load_at(unit, place) for place in rows_of_unit]
        spread = [v.spread(number) for number in held]
        slopes = v.run(source.tangents, [*directions, *spread])
        for i, slope in enumerate(slopes):
            v.store_at(slope, J, b.add(first, integer(i * n)))
