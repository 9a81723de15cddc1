"""Newton's method, eqs. (20) to (22)."""

from __future__ import annotations

from dataclasses import dataclass

from ipe_bench.estimators.ipe import IPE, State, System


@dataclass(frozen=True)
class Newton(IPE):
    """x <- x - J(x)^-1 F(x). Converges quadratically near a root with regular J, eq. (23)."""

    def step(self, system: System, state: State) -> State:
        x = state.x - system.solve(system.J(state.x, state.F), state.F)
        return State(x, system.F(x))
