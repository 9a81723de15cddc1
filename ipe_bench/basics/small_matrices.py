"""Writes the machine code of normal equations and of their Cholesky factors, for many small problems of one size.

LAPACK takes longer to be called than to compute them. Sums run in a fixed order on every machine.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir

from ipe_bench.basics.vectors import F64, I64, PTR, VOID, Value, Vectors, function, integer, loop, number_at, put, room

_WIDTH = 8


def normal(n: int) -> str:
    """void normal(double *J, double *weights, double *r, double *G, double *gradient, int64 trials, int64 m)

    G = A' A (n, n) and A' r (n,) of each J (m, n) and r (m,), where A is J with its rows times the weights (m,).
    """
    made: Any = ir.Function(ir.Module("normal"), ir.FunctionType(VOID, [PTR] * 5 + [I64] * 2), "normal")
    made.attributes.alignstack = 64
    J, weights, r, G, gradient, trials, m = made.args
    b = ir.IRBuilder(made.append_basic_block())
    v, blocks = Vectors(b, _WIDTH), -(-n // _WIDTH)
    row = room(b, v.type, blocks, align=64)
    sums = [[room(b, v.type, align=64) for _ in range(blocks)] for _ in range(n + 1)]
    v.store([v.constant(0.0)] * blocks, row, range(blocks))
    with loop(b, integer(0), trials) as trial:
        for place in (p for line in sums for p in line):
            v.store([v.constant(0.0)], place, [0])
        first = b.mul(trial, m)
        with loop(b, integer(0), m) as i:
            weight, begin = number_at(b, weights, i), b.mul(b.add(first, i), integer(n))
            for j in range(n):
                put(b, b.fmul(weight, number_at(b, J, b.add(begin, integer(j)))), row, integer(j))
            along = v.load(row, range(blocks))
            for a, line in enumerate(sums):
                factor = number_at(b, row, integer(a)) if a < n else number_at(b, r, b.add(first, i))
                for place, value in zip(line, along, strict=True):
                    v.store([v.call("fma", v.spread(factor), value, *v.load(place, [0]))], place, [0])
        for a, line in enumerate(sums):
            target, begin = (G, integer(a * n)) if a < n else (gradient, integer(0))
            begin = b.add(b.mul(trial, integer(n * n if a < n else n)), begin)
            for j in range(n):
                lane = ir.Constant(ir.IntType(32), j % _WIDTH)
                value = b.extract_element(v.load(line[j // _WIDTH], [0])[0], lane)
                put(b, value, target, b.add(begin, integer(j)))
    b.ret_void()
    return str(made.module)


def factor(n: int) -> str:
    """void factor(double *G, double *U, double *inverse, double *norm, int64 trials)

    Of each G (n, n), scaled to a diagonal of ones: the upper Cholesky factor U, its inverse, and the Frobenius norm of
    that inverse, not a number where there is none. U and its inverse are scaled back, and written where they are not
    zero. A lane is a trial.
    """
    module, count = ir.Module("factor"), n * (n + 1) // 2
    places = [(i, j) for i in range(n) for j in range(i + 1)]
    work = function(module, "work", [PTR], lambda b, frame: _factor(Vectors(b, _WIDTH), n, frame))
    made: Any = ir.Function(module, ir.FunctionType(VOID, [PTR] * 4 + [I64]), "factor")
    G, U, inverse, norm, trials = made.args
    b = ir.IRBuilder(made.append_basic_block())
    frame = room(b, ir.VectorType(F64, _WIDTH), 2 * count + 1, align=64)
    last = b.sub(trials, integer(1))
    with loop(b, integer(0), trials, _WIDTH) as group:

        def of(lane: Value) -> Value:
            trial = b.add(group, lane)
            return b.select(b.icmp_signed("<", trial, last), trial, last)

        with loop(b, integer(0), integer(_WIDTH)) as lane:
            begin = b.mul(of(lane), integer(n * n))
            for k, (i, j) in enumerate(places):
                value = number_at(b, G, b.add(begin, integer(i * n + j)))
                put(b, value, frame, b.add(integer(k * _WIDTH), lane))
        b.call(work, [frame])
        with loop(b, integer(0), integer(_WIDTH)) as lane:
            trial = of(lane)
            begin = b.mul(trial, integer(n * n))
            for k, (i, j) in enumerate(places):
                for target, place in ((U, k), (inverse, count + k)):
                    value = number_at(b, frame, b.add(integer(place * _WIDTH), lane))
                    put(b, value, target, b.add(begin, integer(j * n + i)))
            put(b, number_at(b, frame, b.add(integer(2 * count * _WIDTH), lane)), norm, trial)
    b.ret_void()
    return str(module)


def _factor(v: Vectors, n: int, frame: Value) -> None:
    """From the lower half of G to the halves of U and of its inverse, and the norm."""
    places = [(i, j) for i in range(n) for j in range(i + 1)]
    g = dict(zip(places, v.load(frame, range(len(places))), strict=True))
    size = [v.apply("sqrt", g[i, i]) for i in range(n)]
    L: dict[tuple[int, int], Any] = {}
    V: dict[tuple[int, int], Any] = {}
    norm = v.constant(0.0)
    for i, j in places:
        rest = v.apply("div", g[i, j], v.apply("mul", size[i], size[j]))
        for k in range(j):
            rest = v.apply("fnma", L[i, k], L[j, k], rest)
        if i == j:
            L[i, i] = v.apply("sqrt", rest)
            V[i, i] = v.apply("div", v.constant(1.0), L[i, i])
        else:
            L[i, j] = v.apply("mul", rest, V[j, j])
    for j in range(n):
        for i in range(j + 1, n):
            rest = v.constant(0.0)
            for k in range(j, i):
                rest = v.apply("fnma", L[i, k], V[k, j], rest)
            V[i, j] = v.apply("mul", rest, V[i, i])
    for place in places:
        norm = v.apply("fma", V[place], V[place], norm)
    U = [v.apply("mul", L[i, j], size[i]) for i, j in places]
    inverse = [v.apply("div", V[i, j], size[j]) for i, j in places]
    v.store([*U, *inverse, v.apply("sqrt", norm)], frame, range(2 * len(places) + 1))
