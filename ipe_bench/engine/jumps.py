"""Tells whether rates jump at a moment that the solution decides.

A step that has a jump inside loses its order, and slopes by the parameters lack what they owe to
the moment of the jump: such equations are refused. A kink is no jump, as both sides of a comparison
agree where it changes. That is asked of numbers: where the operands of the comparison are equal,
the rates are evaluated as if it held, and as if it failed. Their difference vanishes there at a
kink, and is what it is nearby at a jump.

A sample may miss a jump: one that is seen in a small part of the inputs alone, as between t = 5 and
5.01, or where operands are equal in a whole region, as of sqrt(y*y) + y <= 0.
"""

from __future__ import annotations

import numpy as np

from ipe_bench.basics.linalg import Array, Mask
from ipe_bench.engine import trace
from ipe_bench.engine.equations import Equations, Recording
from ipe_bench.engine.trace import Expression, Program

_NEAR = 64
"""Random points about 0 at which a comparison is examined."""
_FAR = 192
"""Random points of any size."""
_POWERS = (-3.0, 6.0)
"""Powers of ten of the smallest and the largest of these."""
_SIZES = np.geomspace(1e-30, 1e30, 241)
"""Sizes between which a number is looked for, too: Newton's method is long on its way to
exp(y) = 1e100, and passes 1/y = 1e5."""
_DRAWS = 4
"""Points of each kind of which a number takes these sizes."""
_NEWTON = 60
"""Steps of Newton's method that move points to where the comparison changes."""
_HALVINGS = 80
"""Halvings of an interval in which it does, down to neighbouring numbers."""
_BESIDE = 1e-6
"""Part of a number by which another lies beside it."""
_STAYS = 0.1
"""Part of a difference nearby that a jump keeps; a kink keeps 1e-10 of it, a root 1e-5."""
_ALIKE = 1e-6
"""Part of the rates that their difference may be by round-off, as where a limit takes over."""


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
    rates = Program.of([gap, *held, *failed], inputs)
    for place, along in enumerate((tape.t, *tape.y)):
        if gap not in trace.dependent([gap], [along]):
            continue
        slope = trace.tangent([gap], {along: graph.constant(1.0)})
        search = Program.of([gap, *slope], inputs)
        with np.errstate(all="ignore"):
            points, below, above = _changes(search, len(inputs), place)
            away = _away(above)
            # The values just below and just above the change, and one further away of each.
            for near, beside in ((below, below - away), (above, above + away)):
                here = _computed(rates, points, place, near)
                there = _computed(rates, points, place, beside)
                if _stays(here, there).any():
                    return True
    return False


def _changes(search: Program, inputs: int, place: int) -> tuple[Array, Array, Array]:
    """Finds points (inputs, points), and values of the input at this place just below and above
    that at which a gap changes its sign; `search` computes the gap and its slope."""
    rng = np.random.default_rng(1)
    near = rng.uniform(-2.0, 2.0, (inputs, _NEAR))
    powers = 10.0 ** rng.uniform(*_POWERS, (inputs, _FAR))
    far = powers * rng.choice([-1.0, 1.0], (inputs, _FAR))
    drawn = np.concatenate([near, far], axis=1)
    # Many numbers of any sign hardly ever have all their roots and logarithms: in every second
    # point they are positive, as most equations mean them.
    drawn[:, ::2] = np.abs(drawn[:, ::2])
    root = drawn[place]
    # Newton's method, in one coordinate: x <- x - gap / (dgap/dx).
    for _ in range(_NEWTON):
        gap, slope = _computed(search, drawn, place, root)
        root = root - gap / slope
    # Beside what it finds, and between neighbouring sizes of either sign.
    few = np.concatenate([near[:, :_DRAWS], far[:, :_DRAWS]], axis=1)
    sizes = np.concatenate([-_SIZES[::-1], _SIZES])
    points = np.concatenate([drawn, np.repeat(few, len(sizes) - 1, axis=1)], axis=1)
    below = np.concatenate([root - _away(root), np.tile(sizes[:-1], few.shape[1])])
    above = np.concatenate([root + _away(root), np.tile(sizes[1:], few.shape[1])])
    return _halved(search, points, place, below, above)


def _halved(
    search: Program, points: Array, place: int, below: Array, above: Array
) -> tuple[Array, Array, Array]:
    """Selects the intervals in which a gap changes its sign, and halves them down to neighbouring
    numbers."""
    rises = _computed(search, points, place, below)[0] < 0.0
    at_end = _computed(search, points, place, above)[0]
    changed = np.where(rises, at_end >= 0.0, at_end < 0.0)
    points = points[:, changed]
    below = below[changed]
    above = above[changed]
    for _ in range(_HALVINGS):
        middle = below + (above - below) / 2
        before = (_computed(search, points, place, middle)[0] < 0.0) == rises[changed]
        below = np.where(before, middle, below)
        above = np.where(before, above, middle)
    return points, below, above


def _computed(program: Program, points: Array, place: int, values: Array) -> Array:
    """Computes a program (outputs, points) with these values in place of one input."""
    inputs = [*points]
    inputs[place] = values
    return np.stack([np.broadcast_to(one, values.shape) for one in program(inputs)])


def _away(values: Array) -> Array:
    return np.maximum(_BESIDE * np.abs(values), _SIZES[0])


def _stays(here: Array, there: Array) -> Mask:
    """Tells where the rates with a comparison that holds, and with one that fails, differ as much
    where it changes as beside: given the gap and both rates here, and there."""
    closes = np.abs(here[0]) <= _STAYS * np.abs(there[0])
    held, failed = np.split(here[1:], 2)
    differ = np.abs(held - failed)
    nearby = np.abs(np.subtract(*np.split(there[1:], 2)))
    told = differ > _ALIKE * (np.abs(held) + np.abs(failed))
    return closes & np.any(told & (differ > _STAYS * nearby), axis=0)
