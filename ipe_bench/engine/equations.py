"""Records differential equations, and the equations of small deviations from their solution.

`Equations` holds the functions of a model: the start y(0), the rates f of y' = f(t, y, p, c), and
what is read of the state. A `Recording` calls each of them once, with symbols in place of numbers,
and holds their results as formulas, of which others make programs. Differentiated along a direction
dp of the parameters, they give the variational equations d' = df/dy d + df/dp dp, whose solution d
is how the state deviates (Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, 2nd
ed. 1993, I.14).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from ipe_bench.engine import trace
from ipe_bench.engine.trace import Expression, Graph

Recordable = Callable[..., Sequence[Any]]


@dataclass(frozen=True)
class Variation:
    """Holds equations of small deviations, where fewer numbers than the state has describe them."""

    freedoms: int
    slope: Recordable
    """(t, y, p, c, d, dp): the time derivative of a deviation d (freedoms,) along the direction dp
    (n,)."""
    moved: Recordable
    """(y, d): by how much the state (states,) deviates, linear in d."""


@dataclass(frozen=True)
class Equations:
    """Holds functions that can be recorded, and the numbers of their arguments and results."""

    states: int
    parameters: int
    constants: int
    outputs: int
    start: Recordable
    rhs: Recordable
    read: Recordable
    variation: Variation | None = None
    driven: int = 0
    """Number of constants, the last ones, that change from one interval between readings to the
    next."""
    watched: bool = False
    """Whether simulations note a step that is rough, or that crosses a pole."""


@dataclass(frozen=True)
class Deviations:
    """Holds the variational equations along one direction of the parameters."""

    d: Sequence[Expression]
    """Inputs: the deviation."""
    dp: Sequence[Expression]
    """Inputs: the direction (parameters,)."""
    start: list[Expression]
    """The deviation at time 0."""
    slope: list[Expression]
    """Its time derivative."""
    shown: list[Expression]
    """How the readings move with it."""


class Recording:
    """Holds equations as expressions of the time t, states y, parameters p and constants c;
    `moving` change."""

    def __init__(self, equations: Equations) -> None:
        self.equations = equations
        graph = self.graph = Graph()
        self.t = graph.input("t")
        self.y = graph.inputs("y", equations.states)
        self.p = graph.inputs("p", equations.parameters)
        self.c = graph.inputs("c", equations.constants)
        driven = self.c[equations.constants - equations.driven :]
        self.moving = (self.t, *self.y, *driven)
        point = (self.t, self.y, self.p, self.c)
        self.start = self._values(equations.start(self.p, self.c), equations.states, "start")
        self.slope = self._values(equations.rhs(*point), equations.states, "rhs")
        self.shown = self._values(equations.read(*point), equations.outputs, "read")

    def _values(self, result: Iterable[Any], count: int, name: str) -> list[Expression]:
        # Adding 0 makes an expression of a plain number, and leaves others as they are.
        values = [self.graph.apply("add", v, 0.0) for v in result]
        if len(values) != count:
            raise ValueError(f"{name} returns {len(values)} values where {count} are declared")
        return values

    @property
    def timed(self) -> bool:
        """Whether the rates depend on t itself."""
        return not trace.dependent(self.slope, [self.t]).isdisjoint(self.slope)

    def fixed(self, *outputs: Expression) -> list[Expression]:
        """Returns what is computed once for each lane: it depends on the parameters and the case
        alone."""
        return trace.border(outputs, trace.dependent(outputs, self.moving))

    @cached_property
    def deviations(self) -> Deviations:
        """The variational equations, those of the model if it states its own."""
        dp = self.graph.inputs("dp", self.equations.parameters)
        start = trace.tangent(self.start, dict(zip(self.p, dp, strict=True)))
        variation = self.equations.variation
        if variation is None:
            return self._differentiated(dp, start)
        if any(e.value != 0.0 for e in start):
            raise ValueError(
                "equations of small deviations need a start that does not depend on the parameters"
            )
        return self._stated(variation, dp)

    def _differentiated(self, dp: Sequence[Expression], start: list[Expression]) -> Deviations:
        d = self.graph.inputs("d", self.equations.states)
        slope = trace.tangent(self.slope, self._along(d, dp))
        return Deviations(d, dp, start, slope, self._shown_along(d, dp))

    def _stated(self, variation: Variation, dp: Sequence[Expression]) -> Deviations:
        d = self.graph.inputs("d", variation.freedoms)
        dy = variation.moved(self.y, d)
        stated = variation.slope(self.t, self.y, self.p, self.c, d, dp)
        slope = self._values(stated, variation.freedoms, "slope")
        start = [self.graph.constant(0.0)] * variation.freedoms
        return Deviations(d, dp, start, slope, self._shown_along(dy, dp))

    def _shown_along(self, dy: Sequence[Any], dp: Sequence[Expression]) -> list[Expression]:
        dy = [self.graph.apply("add", v, 0.0) for v in dy]
        return trace.tangent(self.shown, self._along(dy, dp))

    def _along(self, dy: Sequence[Expression], dp: Sequence[Expression]) -> dict[Any, Any]:
        """Maps states and parameters to their directions."""
        return dict(zip([*self.y, *self.p], [*dy, *dp], strict=True))

    def along_each(
        self, directions: Sequence[Expression], tangents: Sequence[Expression]
    ) -> list[list[Expression]]:
        """Returns the tangents along each direction alone."""
        # A unit vector in place of the direction leaves one column of the derivative.
        one = self.graph.constant(1.0)
        zero = self.graph.constant(0.0)
        columns = []
        for along in directions:
            unit = {other: one if other is along else zero for other in directions}
            columns.append(trace.substitute(tangents, unit))
        return columns
