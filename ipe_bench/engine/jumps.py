"""Tells whether rates jump at a moment that the solution decides.

A step that has a jump inside loses its order, and slopes by the parameters lack what they owe to
the moment of the jump. So such equations are refused. A kink is no jump: both sides of a comparison
agree where it changes. That is asked of numbers: random points are moved by Newton's method to
where the operands of the comparison are equal, and the rates are evaluated as if it held there, and
as if it failed.
"""

from __future__ import annotations

import numpy as np

from ipe_bench.engine import trace
from ipe_bench.engine.equations import Equations, Recording
from ipe_bench.engine.trace import Expression, Program

_POINTS = 64
"""Random points at which a comparison is examined."""
_NEWTON = 30
"""Steps of Newton's method that move them to where the comparison changes."""


def jumps(equations: Equations) -> bool:
    """Tells whether the rates jump at a moment that the solution decides: it is no end of a step,
    and slopes would lack what they owe to it. Both sides of a comparison are evaluated at points
    that are moved to where its operands are equal; if they agree there, it is a kink and no jump.
    `floor`, and `mod` by it, jumps whatever it is taken of."""
    tape = Recording(equations)
    moving = trace.dependent(tape.slope, (tape.t, *tape.y))
    if any(e.operation == "floor" for e in moving):
        return True
    comparisons = [e for e in trace.in_order(tape.slope) if e.operation in trace.COMPARING]
    return any(_jumps_at(tape, e) for e in comparisons if e in moving)


def _jumps_at(tape: Recording, comparison: Expression) -> bool:
    """Tells whether the rates jump where this comparison changes."""
    graph = tape.graph
    # A number that is compared with itself is asked whether it is one.
    left, right = comparison.operands
    if left is right:
        return False
    # A comparison changes where its operands are equal: gap = 0.
    gap = graph.apply("sub", left, right)
    inputs = [tape.t, *tape.y, *tape.p, *tape.c]
    held = trace.substitute(tape.slope, {comparison: graph.constant(1.0)})
    failed = trace.substitute(tape.slope, {comparison: graph.constant(0.0)})
    for place, along in enumerate((tape.t, *tape.y)):
        tangents = trace.tangent([gap], {along: graph.constant(1.0)})
        program = Program.of([gap, *tangents, *held, *failed], inputs)
        if _differ_at_the_root(program, place, len(inputs)):
            return True
    return False


def _differ_at_the_root(program: Program, place: int, inputs: int) -> bool:
    """Tells whether both halves of what a program shows behind a gap and its slope differ where the
    gap is 0, which is searched along one input."""
    point = list(np.random.default_rng(1).uniform(-2.0, 2.0, (inputs, _POINTS)))
    with np.errstate(all="ignore"):
        # Newton's method, in one coordinate: x <- x - gap / (dgap/dx).
        for _ in range(_NEWTON):
            value, slope, *_ = program(point)
            point[place] = point[place] - value / slope
        value, _, *shown = program(point)
        # The rates as if the comparison held there, and as if it did not.
        half = len(shown) // 2
        a = np.stack(np.broadcast_arrays(value, *shown[:half]))
        b = np.stack(np.broadcast_arrays(value, *shown[half:]))
        apart = np.abs(a - b) > 1e-6 * (1.0 + np.abs(a) + np.abs(b))
        return bool((apart & (np.abs(value) < 1e-9)).any())
