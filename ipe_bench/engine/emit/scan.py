"""Writes the loop that runs a step along the epochs of all trials (see `engine.scan`).

Trials are taken in groups of `width`, a lane for each. In arrays the numbers of one trial lie side
by side; the step computes with vectors that hold the same number of every trial of the group. So
numbers are turned, like a matrix that is transposed, where they are read and where they are
written. In between they lie in frames, arrays of vectors in the function's own memory:

    carried   what the step passes from epoch to epoch
    taken     what it takes of each trial and epoch
    shown     what it gives of each trial and epoch
"""

from __future__ import annotations

from collections.abc import Callable

from llvmlite import ir

from ipe_bench.engine.emit.blocks import Blocks
from ipe_bench.engine.emit.vectors import (
    I64,
    PTR,
    Value,
    integer,
    loop,
    number_at,
    opened,
    put,
    room,
    row_of,
    smaller,
)
from ipe_bench.engine.scan import Step
from ipe_bench.engine.trace import Program


def scan(step: Step, program: Program, width: int) -> str:
    """Writes the function that `engine.scan` describes, of a step that computes this program."""
    writer = _Scan(step, width)
    writer.write(program)
    return str(writer.module)


class _Scan:
    """Writes one step for groups of `width` lanes."""

    def __init__(self, step: Step, width: int) -> None:
        self.step = step
        self.width = width
        self.module = ir.Module("scan")
        arrays = [PTR, PTR, PTR]
        counts = [I64, I64, I64, I64, I64]
        of_each = [PTR, I64, I64] * len(step.each)
        self.b = opened(self.module, "scan", [*arrays, *counts, *of_each])
        self.carry, self.shared, self.out, *numbers = self.b.function.args
        self.trials, self.first, self.by, *numbers = numbers
        self.count, self.length, *self.each = numbers
        self.v = Blocks(self.b, width)
        self.carried_frame = self._frame(step.carried)
        self.taken_frame = self._frame(sum(step.each))
        self.shown_frame = self._frame(step.shown)

    def _frame(self, size: int) -> Value:
        """Reserves a frame of this many vectors; of one where there are none."""
        count = max(size, 1)
        return room(self.b, self.v.type, count, 8 * self.width)

    def write(self, program: Program) -> None:
        b = self.b
        step = self.step
        with loop(b, 0, self.trials, self.width) as group:
            trials = self._trials(group)
            carries = [row_of(b, self.carry, one, step.carried) for one in trials]
            self._gather(carries, self.carried_frame, step.carried)
            with loop(b, 0, self.count) as i:
                epoch = b.add(self.first, b.mul(self.by, i))
                results = self.v.run(program, self._inputs(trials, epoch))
                carried = results[: step.carried]
                shown = results[step.carried :]
                self.v.store(carried, self.carried_frame, range(step.carried))
                self.v.store(shown, self.shown_frame, range(step.shown))
                places = [b.add(b.mul(one, self.length), epoch) for one in trials]
                outs = [row_of(b, self.out, place, step.shown) for place in places]
                self._scatter(self.shown_frame, outs, step.shown)
            self._scatter(self.carried_frame, carries, step.carried)
        self.v.release()
        b.ret_void()

    def _trials(self, group: Value) -> list[Value]:
        """Returns the trial of each lane; a group that is not full repeats the last one."""
        last = self.b.sub(self.trials, integer(1))
        wanted = self._following(group)
        return [smaller(self.b, trial, last) for trial in wanted]

    def _inputs(self, trials: list[Value], epoch: Value) -> list[Value]:
        """Returns what the step takes at an epoch: what is carried, the numbers of each array, and
        those that all trials share."""
        b = self.b
        step = self.step
        taken = 0
        for j, size in enumerate(step.each):
            array, its_length, stride = self.each[3 * j : 3 * j + 3]
            places = [b.add(b.mul(one, its_length), epoch) for one in trials]
            rows = [row_of(b, array, place, stride) for place in places]
            self._gather(rows, self.v.place(self.taken_frame, taken), size)
            taken += size
        shared = row_of(b, self.shared, epoch, step.shared)
        numbers = [number_at(b, shared, j) for j in range(step.shared)]
        for_all = [self.v.spread(number) for number in numbers]
        carried = self.v.load(self.carried_frame, range(step.carried))
        own = self.v.load(self.taken_frame, range(taken))
        return [*carried, *own, *for_all]

    def _gather(self, rows: list[Value], frame: Value, size: int) -> None:
        """Turns rows of `size` numbers, one of each lane, into as many vectors of the frame."""
        b = self.b
        v = self.v

        def square(first: Value) -> None:
            columns = v.turned([v.load_at(row, first) for row in rows])
            v.store(columns, frame, self._following(first))

        def single(j: Value) -> None:
            vector = v.gathered(number_at(b, row, j) for row in rows)
            v.store([vector], frame, [j])

        self._in_squares(size, square, single)

    def _scatter(self, frame: Value, rows: list[Value], size: int) -> None:
        """Turns `size` vectors of the frame into rows of numbers, one of each lane."""
        b = self.b
        v = self.v

        def square(first: Value) -> None:
            columns = v.load(frame, self._following(first))
            for row, numbers in zip(rows, v.turned(columns), strict=True):
                v.store_at(numbers, row, first)

        def single(j: Value) -> None:
            (vector,) = v.load(frame, [j])
            for lane, row in enumerate(rows):
                put(b, v.lane(vector, lane), row, j)

        self._in_squares(size, square, single)

    def _following(self, first: Value) -> list[Value]:
        """Returns `width` whole numbers, from the first on."""
        return [self.b.add(first, integer(i)) for i in range(self.width)]

    def _in_squares(
        self, size: int, square: Callable[[Value], None], single: Callable[[Value], None]
    ) -> None:
        """Copies `size` numbers of each lane: by `square` so many numbers at a time as there are
        lanes, or where there are fewer, by `single` each."""
        b = self.b
        if size < self.width:
            with loop(b, 0, size) as j:
                single(j)
            return
        rest = size % self.width
        with loop(b, 0, size - rest, self.width) as first:
            square(first)
        if rest:
            # The last square ends with the last number, and copies some a second time.
            square(integer(size - self.width))
