"""Relaxed fixed-point iteration."""

from __future__ import annotations

from dataclasses import dataclass

from ipe_bench.basics.errors import UserError
from ipe_bench.solvers import IPE, State, System


@dataclass(frozen=True)
class RelaxedFixedPoint(IPE):
    """x <- x - w F(x) with a relaxation factor w between 0 and 2.

    With w below 1 it converges where plain iteration oscillates: an eigenvalue g of the iteration becomes
    1 - w + w g (Burden and Faires, Numerical Analysis, section 7.4, for the linear case).
    """

    relaxation: float = 0.7

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.relaxation < 2:
            raise UserError(f"relaxation={self.relaxation}: give a number between 0 and 2")

    def step(self, system: System, state: State) -> State:
        x = state.x - self.relaxation * state.F
        return State(x, system.F(x))
