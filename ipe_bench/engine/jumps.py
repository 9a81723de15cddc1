"""Tells whether rates jump at a moment that the solution decides.

A step that has a jump inside loses its order, and slopes by the parameters lack what they owe to
the moment of the jump: such equations are refused. A kink is no jump, as both sides of a comparison
agree where it changes. That is asked of numbers: points are moved by Newton's method to where the
operands of the comparison are equal, and there the rates are evaluated as if it held, and as if it
failed.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.engine import trace
from ipe_bench.engine.equations import Equations, Recording
from ipe_bench.engine.trace import Expression, Program

_NEAR = 64
"""Random points about 0 at which a comparison is examined."""
_FAR = 192
"""Random points of any size: from 0 Newton's method is long on its way to exp(y) = 1e10."""
_SIZES = (-3.0, 6.0)
"""Powers of ten of the smallest and the largest of these."""
_NEWTON = 60
"""Steps of Newton's method that move points to where the comparison changes."""
_STEEPEST = 1e3
"""Slope of a rate by what is compared, up to which a difference at a gap is that of a kink."""
_ROUNDING = 1e-15
"""Share of two numbers that are equal by which round-off may keep them apart."""


def jumps(equations: Equations) -> bool:
    """Tells whether the rates jump where a comparison of something that changes with the time or
    the states does; `floor`, and `mod` by it, jumps whatever it is taken of."""
    tape = Recording(equations)
    moving = trace.dependent(tape.slope, (tape.t, *tape.y))
    if any(e.operation == "floor" for e in moving):
        return True
    comparisons = [e for e in trace.in_order(tape.slope) if e.operation in trace.COMPARING]
    return any(_jumps_at(tape, e) for e in comparisons if e in moving)


def _jumps_at(tape: Recording, comparison: Expression) -> bool:
    """Tells whether the rates jump where this comparison changes."""
    graph = tape.graph
    left, right = comparison.operands
    # A number that is compared with itself is asked whether it is one.
    if left is right:
        return False
    # A comparison changes where its operands are equal: gap = 0.
    gap = graph.apply("sub", left, right)
    inputs = [tape.t, *tape.y, *tape.p, *tape.c]
    held = trace.substitute(tape.slope, {comparison: graph.constant(1.0)})
    failed = trace.substitute(tape.slope, {comparison: graph.constant(0.0)})
    points = _points(len(inputs))
    for place, along in enumerate((tape.t, *tape.y)):
        slope = trace.tangent([gap], {along: graph.constant(1.0)})
        search = Program.of([gap, *slope], inputs)
        rates = Program.of([left, right, *held, *failed], inputs)
        if _differ_at(_moved_to_root(search, points, place), rates):
            return True
    return False


def _points(inputs: int) -> Array:
    """Draws points (inputs, points): about 0, and of any size and sign."""
    rng = np.random.default_rng(1)
    near = rng.uniform(-2.0, 2.0, (inputs, _NEAR))
    sizes = 10.0 ** rng.uniform(*_SIZES, (inputs, _FAR))
    far = sizes * rng.choice([-1.0, 1.0], (inputs, _FAR))
    return np.concatenate([near, far], axis=1)


def _moved_to_root(search: Program, points: Array, place: int) -> list[Array]:
    """Moves points along the input at this place to where a gap is 0; `search` computes it and its
    slope."""
    moved = list(points)
    with np.errstate(all="ignore"):
        # Newton's method, in one coordinate: x <- x - gap / (dgap/dx).
        for _ in range(_NEWTON):
            gap, slope = search(moved)
            moved[place] = moved[place] - gap / slope
    return moved


def _differ_at(points: Sequence[Array], rates: Program) -> bool:
    """Tells whether the rates with a comparison that holds, and with one that fails, differ at some
    point where its operands are equal; `rates` computes the operands, and these."""
    with np.errstate(all="ignore"):
        left, right, *both = rates(points)
        gap = np.abs(left - right)
        equal = gap <= 1e-9 + _ROUNDING * np.abs(right)
        shape = np.shape(points[0])
        held, failed = np.split(np.stack([np.broadcast_to(rate, shape) for rate in both]), 2)
        # What a kink owes to the gap that round-off leaves is no jump.
        alike = 1e-6 * (1.0 + np.abs(held) + np.abs(failed)) + _STEEPEST * gap
        jumped = equal & (np.abs(held - failed) > alike)
    return bool(jumped.any())
