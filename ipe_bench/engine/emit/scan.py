"""Writes steps that `engine.scan` runs along epochs; a lane is a trial."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir

from ipe_bench.engine.emit.blocks import Blocks
from ipe_bench.engine.emit.vectors import (
    F64,
    I32,
    I64,
    PTR,
    VOID,
    Value,
    integer,
    loop,
    number_at,
    put,
    room,
)
from ipe_bench.engine.scan import Step
from ipe_bench.engine.trace import Program


def scan(step: Step, program: Program, width: int) -> str:
    """Writes what `engine.scan` describes."""
    return str(_Scan(step, width).written(program))


class _Scan:
    """Writes one step for groups of `width` lanes."""

    def __init__(self, step: Step, width: int) -> None:
        self.step = step
        self.width = width
        self.module = ir.Module("scan")
        kinds = [*[PTR] * 3, *[I64] * 5, *[PTR, I64, I64] * len(step.each)]
        made: Any = ir.Function(self.module, ir.FunctionType(VOID, kinds), "scan")
        self.carry, self.shared, self.out, self.trials, *numbers = made.args
        self.first, self.by, self.count, self.length, *self.each = numbers
        self.b: Any = ir.IRBuilder(made.append_basic_block())
        self.v = Blocks(self.b, width)
        sizes = step.carried, sum(step.each), step.shown
        frames = [room(self.b, self.v.type, max(size, 1), 8 * width) for size in sizes]
        self.kept, self.given, self.shown = frames

    def written(self, program: Program) -> ir.Module:
        b = self.b
        step = self.step
        with loop(b, integer(0), self.trials, self.width) as group:
            own = self._trials(group)
            begins = [self._row(self.carry, one, integer(step.carried)) for one in own]
            self._gather(begins, self.kept, step.carried)
            with loop(b, integer(0), self.count) as i:
                k = b.add(self.first, b.mul(self.by, i))
                found = self.v.run(program, self._inputs(own, k))
                self.v.store(found[: step.carried], self.kept, range(step.carried))
                self.v.store(found[step.carried :], self.shown, range(step.shown))
                places = [b.add(b.mul(one, self.length), k) for one in own]
                to = [self._row(self.out, place, integer(step.shown)) for place in places]
                self._scatter(self.shown, to, step.shown)
            self._scatter(self.kept, begins, step.carried)
        self.v.release()
        b.ret_void()
        return self.module

    def _trials(self, group: Value) -> list[Value]:
        """Returns the trial of each lane; a group that is not full repeats the last one."""
        b = self.b
        last = b.sub(self.trials, integer(1))
        own = [b.add(group, integer(i)) for i in range(self.width)]
        return [b.select(b.icmp_signed("<", one, last), one, last) for one in own]

    def _inputs(self, own: list[Value], k: Value) -> list[Value]:
        """Returns what the step takes at epoch k: of what is carried, of each array, and of what
        all trials share."""
        b = self.b
        step = self.step
        begun = 0
        for j, size in enumerate(step.each):
            array, its_length, stride = self.each[3 * j : 3 * j + 3]
            places = [b.add(b.mul(one, its_length), k) for one in own]
            rows = [self._row(array, place, stride) for place in places]
            self._gather(rows, self.v.place(self.given, begun), size)
            begun += size
        epoch = self._row(self.shared, k, integer(step.shared))
        shared = [self.v.spread(number_at(b, epoch, integer(j))) for j in range(step.shared)]
        kept = self.v.load(self.kept, range(step.carried))
        return [*kept, *self.v.load(self.given, range(begun)), *shared]

    def _row(self, array: Value, index: Value, size: Value) -> Value:
        return self.b.gep(array, [self.b.mul(index, size)], source_etype=F64)

    def _gather(self, rows: list[Value], frame: Value, size: int) -> None:
        """Copies rows of numbers, one of each lane, into the frame, a vector for each number."""
        b = self.b
        v = self.v

        def whole(j: Value) -> None:
            square = v.turned([v.load_at(begin, j) for begin in rows])
            v.store(square, frame, [b.add(j, integer(i)) for i in range(self.width)])

        def one(j: Value) -> None:
            vector = ir.Constant(v.type, ir.Undefined)
            for lane, begin in enumerate(rows):
                number = number_at(b, begin, j)
                vector = b.insert_element(vector, number, ir.Constant(I32, lane))
            v.store([vector], frame, [j])

        self._in_squares(size, whole, one)

    def _scatter(self, frame: Value, rows: list[Value], size: int) -> None:
        """Copies vectors of the frame into rows of numbers."""
        b = self.b
        v = self.v

        def whole(j: Value) -> None:
            square = v.load(frame, [b.add(j, integer(i)) for i in range(self.width)])
            for begin, vector in zip(rows, v.turned(square), strict=True):
                v.store_at(vector, begin, j)

        def one(j: Value) -> None:
            (vector,) = v.load(frame, [j])
            for lane, begin in enumerate(rows):
                put(b, b.extract_element(vector, ir.Constant(I32, lane)), begin, j)

        self._in_squares(size, whole, one)

    def _in_squares(
        self, size: int, whole: Callable[[Value], None], one: Callable[[Value], None]
    ) -> None:
        """Copies `width` numbers of each lane at a time, the last of them with some again."""
        b = self.b
        rest = size % self.width
        if size < self.width:
            with loop(b, integer(0), integer(size)) as j:
                one(j)
            return
        with loop(b, integer(0), integer(size - rest), self.width) as j:
            whole(j)
        if rest:
            whole(integer(size - self.width))
