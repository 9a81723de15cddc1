"""Relaxed fixed-point iteration."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from annotated_types import Gt, Lt

from ipe_bench.basics.options import Count
from ipe_bench.solvers import IPE, State, System


@dataclass(frozen=True)
class RelaxedFixedPoint(IPE):
    """x <- x - w F(x) with a relaxation factor w between 0 and 2.

    With w below 1 it converges where plain iteration oscillates: an eigenvalue g of the iteration
    becomes 1 - w + w g (Burden and Faires, Numerical Analysis, section 7.4, for the linear case).
    """

    relaxation: Annotated[float, Gt(0), Lt(2)] = 0.7
    max_iterations: Count = field(default=200, kw_only=True)

    def step(self, system: System, state: State) -> State:
        x = state.x - self.relaxation * state.F
        return State(x, system.F(x))
