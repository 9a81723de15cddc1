"""Fixed-point iteration, eqs. (16) and (17)."""

from __future__ import annotations

from dataclasses import dataclass

from ipe_bench.estimators.ipe import IPE, State, System


@dataclass(frozen=True)
class FixedPoint(IPE):
    """x <- x - F(x), which is x0 + H+ (z - h(x0) - N(x)), eq. (17).

    Converges linearly where g(x) = x - F(x) contracts, eqs. (15) and (18).
    """

    def step(self, system: System, state: State) -> State:
        x = state.x - state.F
        return State(x, system.F(x))
