"""The compiled kernels a second time in NumPy, step by step: oracles for machine code.

`by_numpy` runs them in place of machine code; products are rounded before they are added.
"""

from __future__ import annotations

import functools
import itertools
from contextlib import contextmanager
from unittest.mock import patch

import numpy as np

from ipe_bench.engine import watch
from ipe_bench.engine.equations import Recording
from ipe_bench.engine.integrator import Kernel
from ipe_bench.engine.rows import RowFunction
from ipe_bench.engine.scan import Step
from ipe_bench.engine.trace import Program


@contextmanager
def by_numpy():
    """Runs every compiled kernel of the package by NumPy."""
    with (
        patch.object(Kernel, "run", integrate),
        patch.object(RowFunction, "__call__", row_values),
        patch.object(RowFunction, "slopes", row_slopes),
        patch.object(Step, "run", scanned),
    ):
        yield


def row_values(self, x, c):
    """y (rows, m) of a recorded function."""
    return _joined(_recorded(self, x, c)[: self.programs.m], (len(x),))


def row_slopes(self, x, c):
    """y (rows, m) and dy/dx (rows, m, n) of a recorded function."""
    rows, n = x.shape
    m = self.programs.m
    found = _recorded(self, x, c)
    # The directions are a further axis in front.
    moved = self.programs.tangents([*np.eye(n)[:, :, None], *found[m:]])
    J = _joined(moved, (n, rows)).transpose(1, 2, 0)
    return _joined(found[:m], (rows,)), np.ascontiguousarray(J)


def scanned(self, carry, each, shared, out, first, by, count):
    """Runs a recorded step along epochs, all trials at once."""
    longest = max((one.shape[1] for one in each), default=0)
    for k in range(first, first + by * count, by):
        given = list(carry.T.copy())
        for one, size in zip(each, self.each, strict=True):
            here = one[:, k - (longest - one.shape[1])].reshape(len(carry), -1)
            given += list(here[:, :size].T.copy())
        numbers = shared[k] if self.shared else ()
        found = _recorded_step(self)([*given, *numbers])
        joined = _joined(found, (len(carry),)) if found else np.empty((len(carry), 0))
        carry[:] = joined[:, : self.carried]
        out[:, k] = joined[:, self.carried :]


@functools.cache
def _recorded_step(step):
    return step.record()


def _recorded(self, x, c):
    """Runs the program on columns, each in one piece of memory, where a number has the same bits in
    any place."""
    self._require_width(x)
    known = c[np.arange(len(x)) % len(c)]
    return self.programs.values([*np.ascontiguousarray(x.T), *np.ascontiguousarray(known.T)])


def _joined(outputs, shape):
    """Joins outputs, of which some may be single numbers, along a last axis."""
    return np.stack([np.broadcast_to(one, shape) for one in outputs], axis=-1)


@functools.cache
def _programs(kernel):
    """Evaluates from the time, the state with its tangents, and constants: their starts, their
    slopes, and readings."""
    tape = Recording(kernel.equations)
    d, dp, slopes, shown, starts = [], [], [], tape.shown, []
    if kernel.sensitive:
        # Each number is a tangent in all directions at once, an array (n, lanes).
        along = tape.deviations
        d, dp, slopes, shown, starts = along.d, along.dp, along.slope, along.shown, along.start
    stays = [*tape.p, *tape.c, *dp]
    at = [tape.t, *tape.y, *d, *stays]
    sides, watch_begun = [], []
    if kernel.equations.watched and not kernel.sensitive:
        sides = [watch.side_of_poles(tape)]
        watch_begun = watch.begun(tape, *sides)
    moving = Program.of([*tape.slope, *slopes, *sides], at)
    return Program.of([*tape.start, *starts, *watch_begun], stays), moving, Program.of(shown, at)


def integrate(
    self,
    x,
    si,
    cases,
    rows,
    times,
    steps,
    *more,
    states=None,
):
    """Integrates as `Kernel.run` does, all lanes at once."""
    begin, slope, read = _programs(self)
    intervals = cases if cases.ndim == 3 else cases[None]
    count, n = intervals.shape[1], x.shape[1]
    trial, case = np.repeat(rows, count), np.tile(np.arange(count), len(rows))
    out = more[-1].reshape(len(x), count, len(times), self.equations.outputs, -1)
    directions = list(np.eye(n)[:, :, None]) if self.sensitive else []
    p = list((x[trial] * si).T)

    # What stays over a step: parameters, the constants of interval k, and directions.
    def stays(k: int):
        return [*p, *intervals[min(k, len(intervals) - 1), case].T, *directions]

    with np.errstate(all="ignore"):
        begun, t, watching = begin(stays(0)), np.float64(0.0), self.plan.watch
        size = len(slope.outputs) - (watching is not None)
        y, watched = begun[:size], begun[size:]
        kept = [y]
        for k, to in enumerate(times):
            # Equal steps to the next reading; none to a time that is reached already.
            h = (to - t) / max(int(steps[k]), 1)
            for s in range(int(steps[k]) if to != t else 0):
                slopes, held, sides = [], [], []
                at = y
                # Stage s: k_s = f(t + C_s h, y + h sum_j A_sj k_j); the last row, B, is the end
                # of the step.
                for node, row in zip((*self.tableau.C, 1.0), self.tableau.weights, strict=True):
                    at = y
                    for j, weight in row:
                        at = [a + h * weight * k for a, k in zip(at, slopes[j], strict=True)]
                    if len(slopes) < self.tableau.stages:
                        moment = t + s * h + node * h
                        found = slope([moment, *at, *stays(k)])
                        slopes.append(found[:size])
                        sides += found[size:]
                        if watching is not None and watching.timed:
                            # What the rates do with the states held is the time's doing, and no
                            # doubt.
                            held += slope([moment, *y, *stays(k)])[:size]
                y = at
                if watching is not None:
                    rates = itertools.chain(*slopes, held)
                    watched = watching.program([h, *y, *rates, *sides, *watched])
            # The readings are taken with the constants that hold from this time on.
            t = to
            kept.append(y)
            for i, value in enumerate(read([t, *y, *stays(k + 1)])):
                if self.sensitive:
                    out[trial, case, k, i] = np.broadcast_to(value, (n, len(trial))).T * si
                else:
                    out[trial, case, k, i, 0] = (
                        value - more[0].reshape(count, -1, out.shape[3])[case, k, i]
                    )
        if states is not None:
            for k, i in np.ndindex(len(kept), len(kept[0])):
                states[trial, case, i, k] = kept[k][i]
            if watching is not None:
                states[trial, case, -1] = np.broadcast_to(watched[-1], len(trial))[:, None]
