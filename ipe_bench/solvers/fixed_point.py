"""Implements fixed-point iteration, eqs. (16) and (17)."""

from __future__ import annotations

from dataclasses import dataclass

from ipe_bench.estimators.ipe import IPE, State, System


@dataclass(frozen=True)
class FixedPoint(IPE):
    r"""Iterates eq. (17).

    .. math:: x_{k+1} = x_k - F(x_k) = x_0 + H^+ \left( z - h(x_0) - N(x_k) \right)

    Converges linearly where g(x) = x - F(x) contracts, eqs. (15) and (18).

    Example:

    >>> import ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Ranging(), ib.noise.Gaussian(0.1), error_scale=30.0)
    >>> table = ib.run(bench, {"fixed_point": ib.solvers.FixedPoint(max_iterations=50)}, trials=20)
    >>> float(table.iloc[-1]["success"])
    1.0
    """

    def step(self, system: System, state: State) -> State:
        x = state.x - state.F
        return State(x, system.F(x))
