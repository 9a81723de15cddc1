"""Implements Newton's method, eqs. (20) to (22)."""

from __future__ import annotations

from dataclasses import dataclass

from ipe_bench.estimators.ipe import IPE, State, System


@dataclass(frozen=True)
class Newton(IPE):
    r"""Iterates eq. (20), and converges quadratically near a root with regular J, eq. (23).

    .. math::
        x_{k+1} = x_k - J(x_k)^{-1} F(x_k),
        \quad J = \partial F / \partial x = H^+ \, \partial h / \partial x

    Example:

    >>> import ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Ranging(), ib.noise.Gaussian(0.1), error_scale=30.0)
    >>> table = ib.run(bench, {"newton": ib.solvers.Newton(start="nominal")}, trials=20)
    >>> float(table.iloc[-1]["success"])
    1.0
    """

    def step(self, system: System, state: State) -> State:
        x = state.x - system.solve(system.J(state.x, state.F), state.F)
        return State(x, system.F(x))
