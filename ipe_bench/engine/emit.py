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
from dataclasses import dataclass
from functools import partial
from typing import Any

from llvmlite import ir

from ipe_bench.engine.chains import ChainSize, Epoch
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
    arguments = ir.FunctionType(VOID, [PTR] * 4 + [I64] * 5)
    made: Any = ir.Function(ir.Module("scan"), arguments, "scan")
    carry, each, shared, out, trials, first, by, count, length = made.args
    b: Any = ir.IRBuilder(made.append_basic_block())
    v = _Blocks(b, width)
    lanes = [ir.Constant(I32, i) for i in range(width)]
    sizes = (step.carried, step.each, step.shown)
    kept, given, shown = (room(b, v.type, max(size, 1), 8 * width) for size in sizes)

    def row(array: Value, index: Value, size: int) -> Value:
        return b.gep(array, [b.mul(index, integer(size))], source_etype=F64)

    def gather(rows: list[Value], frame: Value, size: int) -> None:
        with loop(b, integer(0), integer(size)) as j:
            vector = ir.Constant(v.type, ir.Undefined)
            for lane, begin in zip(lanes, rows, strict=True):
                vector = b.insert_element(vector, number_at(b, begin, j), lane)
            v.store([vector], v.place(frame, j), [0])

    def scatter(frame: Value, rows: list[Value], size: int) -> None:
        with loop(b, integer(0), integer(size)) as j:
            (vector,) = v.load(frame, [j])
            for lane, begin in zip(lanes, rows, strict=True):
                put(b, b.extract_element(vector, lane), begin, j)

    with loop(b, integer(0), trials, width) as group:
        last = b.sub(trials, integer(1))
        own = [b.add(group, integer(i)) for i in range(width)]
        # A group that is not full repeats the last trial.
        own = [b.select(b.icmp_signed("<", one, last), one, last) for one in own]
        begins = [row(carry, one, step.carried) for one in own]
        gather(begins, kept, step.carried)
        with loop(b, integer(0), count) as i:
            k = b.add(first, b.mul(by, i))
            places = [b.add(b.mul(one, length), k) for one in own]
            gather([row(each, place, step.stride) for place in places], given, step.each)
            epoch = row(shared, k, step.shared)
            numbers = [v.spread(number_at(b, epoch, integer(j))) for j in range(step.shared)]
            inputs = [*v.load(kept, range(step.carried)), *v.load(given, range(step.each))]
            found = v.run(program, [*inputs, *numbers])
            v.store(found[: step.carried], kept, range(step.carried))
            v.store(found[step.carried :], shown, range(step.shown))
            scatter(shown, [row(out, place, step.shown) for place in places], step.shown)
        scatter(kept, begins, step.carried)
    b.ret_void()
    return str(made.module)


def chains(size: ChainSize, width: int) -> str:
    """Writes void chains(double *A, double *B, double *D, double *G, double *a, double *v, double
    *x, double *P, double *crossed, int64 trials, int64 epochs, double *frame), which
    `engine.chains` describes; null is what is not asked for. A lane is a trial; a group that is not
    full repeats its last one."""
    return str(_ChainWriter(size, width).module)


@dataclass(frozen=True)
class _Lanes:
    """Numbers in the frame, a vector for each, or a matrix of them in rows of n."""

    v: _Vectors
    begin: Value
    n: int

    def __getitem__(self, i: Value) -> Value:
        return self.v.load(self.begin, [i])[0]

    def __setitem__(self, i: Value, value: Value) -> None:
        self.v.store([value], self.v.place(self.begin, i), [0])

    def row(self, i: Value) -> _Lanes:
        place = self.v.builder.mul(i, integer(self.n))
        return _Lanes(self.v, self.v.place(self.begin, place), self.n)

    def all(self) -> list[Value]:
        return self.v.load(self.begin, range(self.n))

    def column(self, j: Value) -> list[Value]:
        return self.v.load(self.v.place(self.begin, j), range(0, self.n**2, self.n))

    def keep(self, values: list[Value]) -> None:
        self.v.store(values, self.begin, range(self.n))


class _LaneWriter:
    """Writes a function of many trials, of which a lane holds one, a group of them at a time: it
    takes pointers, the number of trials, further whole numbers and a frame."""

    def __init__(self, name: str, n: int, pointers: int, numbers: int, width: int) -> None:
        self.n = n
        self.module = ir.Module(name)
        kinds = [*[PTR] * pointers, I64, *[I64] * numbers, PTR]
        made: Any = ir.Function(self.module, ir.FunctionType(VOID, kinds), name)
        self.arrays = made.args[:pointers]
        self.trials, *self.numbers, self.frame = made.args[pointers:]
        self.b: Any = ir.IRBuilder(made.append_basic_block())
        self.v = _Vectors(self.b, width)
        self.zero = self.v.constant(0.0)
        self.one = self.v.constant(1.0)

    def _write(self, solve: Callable[[], None]) -> None:
        """Writes what is done with each group."""
        with loop(self.b, integer(0), self.trials, self.v.width) as self.group:
            solve()
        self.b.ret_void()

    def _take(self, array: Value, lanes: _Lanes, count: int, k: Value, length: Value) -> None:
        """Copies `count` numbers of epoch k of an array (trials, length, count) into lanes."""
        rows = self._rows(array, count, k, length)
        with self._each(count) as j:
            vector = ir.Constant(self.v.type, ir.Undefined)
            for lane, row in enumerate(rows):
                number = number_at(self.b, row, j)
                vector = self.b.insert_element(vector, number, ir.Constant(I32, lane))
            lanes[j] = vector

    def _give(self, lanes: _Lanes, array: Value, count: int, k: Value, length: Value) -> None:
        """Copies lanes into `count` numbers of epoch k of an array (trials, length, count)."""
        rows = self._rows(array, count, k, length)
        with self._each(count) as j:
            vector = lanes[j]
            for lane, row in enumerate(rows):
                put(self.b, self.b.extract_element(vector, ir.Constant(I32, lane)), row, j)

    def _rows(self, array: Value, count: int, k: Value, length: Value) -> list[Value]:
        """Begins of epoch k of each lane's trial in an array (trials, length, count)."""
        b = self.b
        last = b.sub(self.trials, integer(1))
        rows = []
        for lane in range(self.v.width):
            trial = b.add(self.group, integer(lane))
            # A group that is not full repeats the last trial.
            trial = b.select(b.icmp_signed("<", trial, last), trial, last)
            epoch = b.add(b.mul(trial, length), k)
            begin = b.mul(epoch, integer(count))
            rows.append(b.gep(array, [begin], source_etype=F64))
        return rows

    def _parts(self, array: Value, sizes: Sequence[int]) -> list[Value]:
        """Begins of parts of so many vectors each, and of what follows them."""
        return [self.v.place(array, begin) for begin in itertools.accumulate(sizes, initial=0)]

    def _lanes(self, begin: Value) -> _Lanes:
        return _Lanes(self.v, begin, self.n)

    def _each(self, count: int | Value) -> Any:
        count = integer(count) if isinstance(count, int) else count
        return loop(self.b, integer(0), count)

    @contextmanager
    def _down(self, count: Value) -> Iterator[Value]:
        """Writes a loop from count - 1 down to 0."""
        with self._each(count) as i:
            last = self.b.sub(count, integer(1))
            yield self.b.sub(last, i)

    def _dot(
        self, one: Sequence[Value], other: Sequence[Value], start: Value | None = None
    ) -> Value:
        slopes = [[value] for value in other]
        return self.v.combine([start or self.zero], list(one), slopes)[0]


class _ChainWriter(_LaneWriter):
    """Writes the solver of chains of one size: a square-root filter, and a pass back by
    multipliers. What is given of all trials has a name of `self`, as `self.A`; what lies in the
    frame has one of its epoch, as `here.A`."""

    def __init__(self, size: ChainSize, width: int) -> None:
        super().__init__("chains", size.n, pointers=9, numbers=1, width=width)
        self.size = size
        self.rows = size.m + size.n
        (self.epochs,) = self.numbers
        self.A, self.B, self.D, self.G, self.a, self.values, *results = self.arrays
        self.x, self.P, self.crossed = results
        W, t, y, told, ahead, product, self.first = self._parts(self.frame, size.working)
        self.W = _Lanes(self.v, W, size.n + size.q)
        self.seen = _Lanes(self.v, W, size.n + size.m)
        parts = map(self._lanes, (t, y, told, ahead, product))
        self.t, self.y, self.told, self.ahead, self.product = parts
        self._write(self._solve)

    def _solve(self) -> None:
        """Writes the solution of a group of trials."""
        with self._each(self.epochs) as k:
            self._begin(k)
            self._spread(k)
        with self._asked(self.x):
            # The second pass solves for what the first leaves of the right sides.
            with self._each(2):
                self._pass()
            with self._each(self.epochs) as k:
                self._give(self._at(k).x, self.x, self.n, k, self.epochs)
        with self._asked(self.P):
            self._covariances()

    def _pass(self) -> None:
        """Writes one pass along a path, there and back."""
        with self._each(self.epochs) as k:
            self._forward(k)
        # Nothing follows the last epoch: A' l = 0.
        with self._each(self.n) as i:
            self.y[i] = self.zero
        with self._down(self.epochs) as k:
            self._backward(k)
        with self._each(self.epochs) as k:
            self._refine(k)

    def _begin(self, k: Value) -> None:
        """Writes what is given of an epoch into its place."""
        b = self.b
        n = self.n
        m = self.size.m
        here = self._at(k)
        moved = b.sub(self.epochs, integer(1))
        before = b.sub(k, integer(1))
        # Nothing moves into the first epoch, and nothing is read there; nor is anything left there
        # of the trials before, which may not be finite.
        with self._each(n * n) as i:
            here.A[i] = self.zero
        with self._each(m) as r:
            here.v[r] = self.zero
        with b.if_then(b.icmp_signed(">", k, integer(0))):
            self._take(self.A, here.A, n * n, before, moved)
            self._take(self.B, here.B, m * n, before, moved)
            self._take(self.values, here.v, m, before, moved)
        # D waits where u will be.
        self._take(self.D, here.u, n, k, self.epochs)
        self._take(self.a, here.a, n, k, self.epochs)
        with self._each(n) as i:
            self._damp(here, i)

    def _damp(self, here: Epoch, i: Value) -> None:
        """Writes the row of a root of D for state i, which is a reading of 0, as one that is not
        taken in yet."""
        b = self.b
        m = integer(self.size.m)
        # The roots stand on a diagonal below the rows of the m readings.
        diagonal = b.add(integer(self.size.m * self.n), b.mul(i, integer(self.n + 1)))
        here.B[diagonal] = self.v.call("sqrt", here.u[i])
        here.x[i] = self.zero
        here.v[b.add(i, m)] = self.zero

    def _spread(self, k: Value) -> None:
        """Writes F of an epoch: predicted, and then updated by one row after another."""
        here = self._at(k)
        before = self._at(k, back=1)
        self._predict(k, here.A, before.F)
        self._triangle(self.W, here.F)
        with self._each(self.rows) as r, self._counts(here, r):
            self._take_in(here, here.F, here.B.row(r).all(), r)

    def _predict(self, k: Value, A: _Lanes, F: _Lanes) -> None:
        """Writes W = (A F, G), with W W' = A F F' A' + G G'."""
        with self._each(self.n) as i:
            along = A.row(i).all()
            row = self.W.row(i)
            moved = [self.zero] * self.n
            # F is triangular: row j of it has j + 1 numbers.
            for j, share in enumerate(along):
                begun = j * self.n
                kept = self.v.load(F.begin, range(begun, begun + j + 1))
                moved[: j + 1] = self.v.combine(moved[: j + 1], [share], [kept])
            self.v.store(moved, row.begin, range(self.n))
            with self._each(self.size.q) as j:
                gain = self._gain(k, i, j)
                row[self.b.add(j, integer(self.n))] = gain

    def _triangle(self, W: _Lanes, F: _Lanes) -> None:
        """Writes the triangular F with F F' = W W', by orthogonal rows of W (modified
        Gram-Schmidt)."""
        b = self.b
        with self._each(self.n) as i:
            row = W.row(i).all()
            square = self._dot(row, row)
            # Singular noise leaves rows of zeros, which have no share in others.
            some = b.fcmp_ordered(">", square, self.zero)
            inverse = b.select(some, b.fdiv(self.one, square), self.zero)
            root = self.v.call("sqrt", square)
            F.row(i)[i] = root
            # The rows below lose their part along row i.
            with loop(b, b.add(i, integer(1)), integer(self.n)) as j:
                below = W.row(j)
                numbers = below.all()
                share = b.fmul(self._dot(numbers, row), inverse)
                F.row(j)[i] = b.fmul(share, root)
                rest = self.v.combine(numbers, [b.fneg(share)], [row])
                below.keep(rest)

    def _counts(self, here: Epoch, r: Value) -> Any:
        """Begins what is done with row r if it counts: a reading always, and damping if some lane
        has any; w and s of another row are 0."""
        b = self.b
        m = integer(self.size.m)
        read = b.icmp_signed("<", r, m)
        damping = b.icmp_signed(">=", r, m)
        i = b.select(damping, b.sub(r, m), integer(0))
        damped = b.fcmp_unordered("!=", here.B.row(r)[i], self.zero)
        lanes = b.bitcast(damped, ir.IntType(self.v.width))
        some = b.icmp_unsigned("!=", lanes, ir.Constant(lanes.type, 0))
        return b.if_then(b.or_(read, some))

    def _take_in(self, here: Epoch, F: _Lanes, row: list[Value], r: Value) -> None:
        """Writes F F' <- ((F F')^-1 + b b')^-1 for a row b, with s = F F' b and 1 + b' s (Carlson,
        1973) in the places of row r of an epoch."""
        b = self.b
        s = here.S.row(r)
        # t = F' b, of which s and 1 + b' s are sums over columns.
        with self._each(self.n) as j:
            self.t[j] = self._dot(F.column(j), row)
            s[j] = self.zero
        here.size[r] = self.one
        # From the last column to the first, size is 1 plus the squares of t so far.
        with self._down(integer(self.n)) as j:
            t = self.t[j]
            size = here.size[r]
            larger = self.v.call("fma", t, t, size)
            root = self.v.call("sqrt", b.fmul(size, larger))
            kept = b.fdiv(size, root)
            share = b.fneg(b.fdiv(t, root))
            # F <- F size / root - s t / root in this column, then s <- s + F t by the old one.
            with loop(b, j, integer(self.n)) as i:
                old = F.row(i)[j]
                so_far = s[i]
                new = self.v.call("fma", share, so_far, b.fmul(old, kept))
                F.row(i)[j] = new
                s[i] = self.v.call("fma", old, t, so_far)
            here.size[r] = larger

    def _forward(self, k: Value) -> None:
        """Writes the state u of an epoch by its readings and those before."""
        here = self._at(k)
        before = self._at(k, back=1).u.all()
        # Prediction: u <- A u + a.
        with self._each(self.n) as i:
            along = here.A.row(i).all()
            here.u[i] = self._dot(along, before, here.a[i])
        # Update by a reading: w = (v - b' u) / (1 + b' s), then u <- u + s w.
        with self._each(self.rows) as r, self._counts(here, r):
            w = self.b.fdiv(self._left(here, r), here.size[r])
            here.w[r] = w
            self._add(w, here.S.row(r), here.u)

    def _backward(self, k: Value) -> None:
        """Writes the multipliers of an epoch, and its state by all readings."""
        here = self._at(k)
        later = self.y.all()
        # Smoothing (Bryson and Frazier, 1963): x = u + F t with t = F' A' l[k+1].
        with self._each(self.n) as j:
            self.t[j] = self._dot(here.F.column(j), later)
        with self._each(self.n) as i:
            t = self.t.all()
            along = here.F.row(i).all()
            here.u[i] = self._dot(along, t, here.u[i])
            here.x[i] = self.b.fadd(here.x[i], here.u[i])
        # Readings from the last to the first: w <- w - s' l / (1 + b' s), then l <- l + b w.
        with self._down(integer(self.rows)) as r, self._counts(here, r):
            known = self._along(here.S, r, self.y)
            share = self.b.fdiv(known, here.size[r])
            w = self.b.fsub(here.w[r], share)
            here.w[r] = w
            self._add(w, here.B.row(r), self.y)
        multipliers = self.y.all()
        here.multipliers.keep(multipliers)
        # A' l is what the epoch before takes.
        with self._each(self.n) as i:
            self.y[i] = self._dot(here.A.column(i), multipliers)

    def _refine(self, k: Value) -> None:
        """Writes what u and the multipliers leave of the right sides."""
        q = self.size.q
        here = self._at(k)
        before = self._at(k, back=1).u.all()
        # t = G' l.
        with self._each(q) as j:
            column = [self._gain(k, integer(i), j) for i in range(self.n)]
            self.t[j] = self._dot(column, here.multipliers.all())
        # a <- a - u + G t + A u[k-1].
        with self._each(self.n) as i:
            left = self.b.fsub(here.a[i], here.u[i])
            gains = [self._gain(k, i, integer(j)) for j in range(q)]
            left = self._dot(gains, self.v.load(self.t.begin, range(q)), left)
            along = here.A.row(i).all()
            here.a[i] = self._dot(along, before, left)
        # v <- v - B u - w.
        with self._each(self.rows) as r, self._counts(here, r):
            left = self._left(here, r)
            here.v[r] = self.b.fsub(left, here.w[r])

    def _covariances(self) -> None:
        """Writes covariances from the last epoch to the first: by the readings up to an epoch or,
        where those with the last states are asked for, by all."""
        n = self.n
        with self._each(n * n) as i:
            self.told[i] = self.zero
            self.ahead[i] = self.zero
        with self._each(n) as i:
            self.ahead.row(i)[i] = self.one
        with self._down(self.epochs) as k:
            F = self._at(k).F
            with self._asked(self.crossed):
                self._smooth(k)
            with self._each(n) as i:
                row = F.row(i).all()
                with loop(self.b, integer(0), self.b.add(i, integer(1))) as j:
                    along = self._dot(row, F.row(j).all())
                    self.product.row(i)[j] = along
                    self.product.row(j)[i] = along
            self._give(self.product, self.P, n * n, k, self.epochs)
            with self._asked(self.crossed):
                self._tell(k)

    def _smooth(self, k: Value) -> None:
        """Writes F of an epoch by all readings: what later ones tell, U U', is as if its columns
        were read."""
        here = self._at(k)
        with self._each(self.n) as j:
            self._take_in(here, here.F, self.told.column(j), integer(0))

    def _tell(self, k: Value) -> None:
        """Writes the covariance with the last states, and what the epoch before takes of the later
        readings."""
        b = self.b
        n = self.n
        m = self.size.m
        here = self._at(k)
        # W waits for what is seen.
        crossed = _Lanes(self.v, self.W.begin, n)
        with self._each(n) as i:
            row = self.product.row(i).all()
            with self._each(n) as j:
                crossed.row(i)[j] = self._dot(row, self.ahead.column(j))
        self._give(crossed, self.crossed, n * n, k, self.epochs)
        # C C' = B' B + U U' takes the place of F F', of which nothing is asked any more.
        with self._each(n) as i:
            row = self.seen.row(i)
            with self._each(m) as r:
                row[r] = here.B.row(r)[i]
            with self._each(n) as j:
                row[b.add(j, integer(m))] = self.told.row(i)[j]
        self._triangle(self.seen, here.F)
        with self._each(self.size.q) as j:
            self._blur(k, j)
        # U <- A' C, and what leads to the last states likewise.
        self._lead(here, here.F, self.told)
        self._lead(here, self.ahead, self.product)
        with self._each(n * n) as i:
            self.ahead[i] = self.product[i]

    def _blur(self, k: Value, j: Value) -> None:
        """Writes C C' <- ((C C')^-1 + g g')^-1 for a column g of G, s = C C' g, and ahead <- (I - s
        g' / (1 + g' s)) ahead."""
        here = self._at(k)
        g = [self._gain(k, integer(i), j) for i in range(self.n)]
        self._take_in(here, here.F, g, integer(0))
        with self._each(self.n) as c:
            along = self._dot(g, self.ahead.column(c))
            share = self.b.fneg(self.b.fdiv(along, here.size[integer(0)]))
            with self._each(self.n) as i:
                row = self.ahead.row(i)
                row[c] = self.v.call("fma", share, here.S[i], row[c])

    def _lead(self, here: Epoch, given: _Lanes, to: _Lanes) -> None:
        """Writes A' times a matrix."""
        with self._each(self.n) as i:
            along = here.A.column(i)
            with self._each(self.n) as j:
                to.row(i)[j] = self._dot(along, given.column(j))

    def _asked(self, array: Value) -> Any:
        return self.b.if_then(self.b.icmp_signed("!=", self.b.ptrtoint(array, I64), integer(0)))

    def _at(self, k: Value, back: int = 0) -> Epoch:
        """What is kept of epoch k - back. Before the first epoch lies one of zeros."""
        number = self.b.add(k, integer(1 - back))
        begin = self.b.mul(number, integer(sum(self.size.parts)))
        *places, _ = self._parts(self.v.place(self.first, begin), self.size.parts)
        return Epoch(*map(self._lanes, places))

    def _gain(self, k: Value, i: Value, j: Value) -> Value:
        """G[k, i, j], the same in all lanes."""
        b = self.b
        row = b.add(b.mul(k, integer(self.n)), i)
        place = b.add(b.mul(row, integer(self.size.q)), j)
        return self.v.spread(number_at(b, self.G, place))

    def _left(self, here: Epoch, r: Value) -> Value:
        """What u leaves of reading r, v - b' u."""
        return self.b.fsub(here.v[r], self._along(here.B, r, here.u))

    def _along(self, array: _Lanes, r: Value, x: _Lanes) -> Value:
        """Row r of an array times x."""
        return self._dot(array.row(r).all(), x.all())

    def _add(self, share: Value, row: _Lanes, to: _Lanes) -> None:
        """Writes to <- to + share row."""
        with self._each(self.n) as i:
            to[i] = self.v.call("fma", share, row[i], to[i])


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
