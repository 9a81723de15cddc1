"""Watches the steps of a solution for two signs that their agreement proves nothing.

Two step lengths that lead to the same readings show that both are right, unless both jump over the
same thing. Two things are jumped over unseen: a pole, where something that the rates divide by
changes its sign, and a narrow well or pulse that the state leads into. So a lane that is watched
carries three things beside its state: the largest magnitude of each state so far, the signs of the
divisors at the start, and a doubt, which is 0 until a divisor changes its sign, or a step is rough
by the formula's own error estimate. The program here is run at the end of each step.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ipe_bench.engine import trace
from ipe_bench.engine.equations import Recording
from ipe_bench.engine.tableaus import Tableau
from ipe_bench.engine.trace import Expression, Program

ROUGH = 0.005
"""Error of a single step, by the embedded formula of fifth order, that puts a trial in doubt, as a
share of the state's largest magnitude so far and of its next change. Right steps to 1e-8 leave
1e-6, one that jumps 0.007. What changes with t alone, as a pulse does, is no doubt."""
_DIGITS = 50
"""Binary digits of the number that tells the signs of the divisors: a float holds it exactly."""


def divisors(tape: Recording) -> list[Expression]:
    """Selects what the rates divide by, if it changes along a solution."""
    varying = trace.dependent(tape.slope, tape.moving)
    found = list[Expression]()
    # a / b divides by b, and a^b by a where b is a negative number.
    for e in trace.in_order(tape.slope):
        base, *others = trace.operands(e) or [e]
        if e.operation == "div":
            found += others
        elif e.operation == "pow" and (others[0].value or 0.0) < 0.0:
            found.append(base)
    return [e for e in dict.fromkeys(found) if e in varying]


def divided_by(tape: Recording) -> list[bool]:
    """Tells of each state whether it is part of what the rates divide by."""
    dividing = divisors(tape)
    parts = [trace.dependent(dividing, [y]) for y in tape.y]
    return [not part.isdisjoint(dividing) for part in parts]


def side_of_poles(tape: Recording) -> Expression:
    """Computes a number that tells the signs of all that the rates divide by: where it changes, a
    pole has been crossed."""
    side = tape.graph.constant(0.0)
    for i, divisor in enumerate(divisors(tape)):
        # Each divisor has a binary digit: 1 where it is negative. Beyond 50 divisors share digits,
        # which add.
        negative = tape.graph.apply("less", divisor, 0.0)
        side = side + 2.0 ** (i % _DIGITS) * negative
    return side


def begun(tape: Recording, side: Expression) -> list[Expression]:
    """Computes what a watch begins with: the magnitudes of the states, the side of the poles, and
    no doubt."""
    nothing = tape.graph.constant(0.0)
    at_start = dict(zip(tape.y, tape.start, strict=True))
    sizes = [tape.graph.apply("add", np.abs(y), 0.0) for y in tape.start]
    sides = trace.substitute([side], {tape.t: nothing} | at_start)
    return [*sizes, *sides, nothing]


def step_watched(tape: Recording, formula: Tableau) -> Program:
    """Makes the program that watches a step.

    Its inputs are the step's length, the states at its end, the slopes of its stages, where the
    rates depend on t those with the states held, the sides of its stages, and what the last step
    left: magnitudes, side, doubt. It computes these three anew."""
    graph = tape.graph
    n = tape.equations.states
    stages = formula.stages
    h = graph.input("h")
    ended = graph.inputs("ended", n)
    slopes = graph.inputs("k", n * stages)
    held = graph.inputs("held", n * stages) if tape.timed else ()
    sides = graph.inputs("side", stages)
    reach = graph.inputs("reach", n)
    side_at_start = graph.input("began")
    doubt = graph.input("doubt")
    inputs = [h, *ended, *slopes, *held, *sides, *reach, side_at_start, doubt]

    largest = [_larger(graph, before, now) for before, now in zip(reach, ended, strict=True)]
    # What the time alone does to the rates is no doubt.
    moved = slopes
    if held:
        moved = [k - alone for k, alone in zip(slopes, held, strict=True)]
    # A divisor that changed its sign in any stage: a pole was crossed.
    for side in sides:
        changed = (side < side_at_start) + (side_at_start < side)
        doubt = graph.apply("where", changed, 1.0, doubt)
    # The slopes lie stage after stage: those of state i are every n-th from i on.
    for i, size in enumerate(largest):
        rough = _rough(formula, h, moved[i::n], size)
        doubt = graph.apply("where", rough, 1.0, doubt)
    return Program.of([*largest, side_at_start, doubt], inputs)


def _larger(graph: trace.Graph, before: Expression, now: Expression) -> Expression:
    """Returns the largest magnitude of a state so far, this step's end included."""
    size: Any = np.abs
    return graph.apply("where", before < size(now), size(now), before)


def _rough(formula: Tableau, h: Any, slopes: Sequence[Any], largest: Any) -> Any:
    """Tells whether the embedded formula doubts a step of one state, from its slopes."""
    size: Any = np.abs
    # h sum_s E_s k_s is the difference from the embedded formula.
    error = sum(weight * k for weight, k in zip(formula.E, slopes, strict=True) if weight)
    return ROUGH * (largest + size(h * slopes[-1])) < size(h * error)
