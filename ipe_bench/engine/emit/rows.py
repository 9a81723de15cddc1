"""Writes recorded functions of rows of numbers, one row after another."""

from __future__ import annotations

from typing import Any

from llvmlite import ir

from ipe_bench.engine.emit.vectors import F64, I32, I64, PTR, VOID, Vectors, integer, loop, put
from ipe_bench.engine.trace import Program, RowPrograms


def rates(program: Program, width: int) -> str:
    """Writes void rates(double *x, double *si, double *out, int64 trials): one number from the
    parameters x[i] times si, for one trial at a time, a width of 1."""
    kinds = ir.FunctionType(VOID, [PTR, PTR, PTR, I64])
    made: Any = ir.Function(ir.Module("rates"), kinds, "rates")
    x, si, out, trials = made.args
    b: Any = ir.IRBuilder(made.append_basic_block())
    n = program.inputs
    # for i in range(trials): out[i] = rate(x[i] * si)
    with loop(b, integer(0), trials) as i:
        v = Vectors(b, width)
        row = v.load(v.place(x, b.mul(i, integer(n))), range(n))
        sizes = v.load(si, range(n))
        given = [b.fmul(value, size) for value, size in zip(row, sizes, strict=True)]
        (rate,) = v.run(program, given)
        put(b, rate, out, i)
    b.ret_void()
    return str(made.module)


def rows(source: RowPrograms, width: int) -> str:
    """Writes void rows(double *x, double *c, int64 count, double *unit, double *y, double *J, int64
    total): for each row i of x (total, n), with row i % count of the numbers c, the values y
    (total, m) and, unless J is null, their slopes J (total, m, n). A vector holds tangents in
    `width` directions, of the unit matrix (n, n)."""
    kinds = ir.FunctionType(VOID, [PTR, PTR, I64, PTR, PTR, PTR, I64])
    made: Any = ir.Function(ir.Module("rows"), kinds, "rows")
    x, c, count, unit, y, J, total = made.args
    b: Any = ir.IRBuilder(made.append_basic_block())
    v = Vectors(b, 1)
    w = Vectors(b, width)
    n = source.n
    m = source.m
    numbers = source.values.inputs - n
    asked = b.icmp_signed("!=", b.ptrtoint(J, I64), integer(0))
    last = integer(n - width)
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
            along = [w.load_at(here, integer(j * n)) for j in range(n)]
            for j, value in enumerate(w.run(source.tangents, [*along, *saved])):
                w.store_at(value, to, integer(j * n))
    b.ret_void()
    return str(made.module)
