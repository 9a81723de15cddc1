"""Implements re-linearised IPE: H is evaluated again at the estimate, up to the least-squares
minimum."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array, finite, from_root
from ipe_bench.basics.options import Count, Positive
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.base import Estimates, Estimator
from ipe_bench.estimators.driver import ConvergenceCheck, Limits, Method, iterate
from ipe_bench.estimators.ipe import (
    IPE,
    FrozenSystem,
    Start,
    State,
    begin,
    frozen_covariance,
    root_check,
)
from ipe_bench.estimators.least_squares import inverse_factor
from ipe_bench.measurements.problem import Problem
from ipe_bench.solvers.fixed_point import FixedPoint

_ONLY_A_STEP = ("start", "max_iterations", "tolerance", "budget")
_NO_ROOT = 1e300
"""Stands for F where a round has failed."""
_ROUND_ENDS = (Status.RUNNING, Status.CONVERGED, Status.STALLED, Status.MAX_ITERATIONS)
"""Endings of a round after which the next one goes on."""


@dataclass(frozen=True)
class Round(State):
    """Holds the end of a round: F is that of the linearisation at x itself."""

    H_plus: Array
    deviation: Array
    """Standard deviations (trials, n) of the local bound."""
    inner: NDArray[np.int8]
    """The status of the round's inner iteration."""
    steps: NDArray[np.int64]
    """Inner steps so far."""
    path: list[Array]
    """The iterates (steps + 1, n) of each trial: a few inner steps of each round, kept whether or
    not a history is asked for."""


@dataclass(frozen=True)
class Relinearized(Method[FrozenSystem, Round], Estimator):
    """Iterates any solver on F(x) = H_k+ (h(x) - z), with H_k = dh/dx at the estimate x_k of the
    round before.

    Where F(x_k) = 0 at its own linearisation, the gradient J' R^-1 (h - z) of least squares
    vanishes: the estimate is no longer a root of the frozen equation but the least-squares minimum,
    and its covariance is the Cramer-Rao bound. With one inner step of fixed-point iteration a round
    is a Gauss-Newton step; more of them save Jacobians.

    Example:

    >>> import ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Ranging(), ib.noise.Gaussian(0.1), error_scale=30.0)
    >>> estimators = {"relinearized": ib.solvers.Relinearized(inner_iterations=2)}
    >>> table = ib.run(bench, estimators, trials=20)
    >>> float(table.iloc[-1]["success"])
    1.0
    """

    solver: IPE[Any] = field(default_factory=FixedPoint)
    """The solver that a round iterates. Its own start, limits and tolerance have no say here."""
    start: Start = "linear_lse"
    inner_iterations: Count = 5
    """Steps of the solver before H is evaluated again."""
    max_iterations: Count = 30
    """Rounds, each with a new H; the iterations of a result are inner steps, up to
    `inner_iterations` of each round."""
    tolerance: Positive = 1e-6
    """Largest abs(F_i(x_k)) at the linearisation there, in standard deviations of the local
    bound."""
    budget: Positive | None = None
    """Simulations that a trial may cost, a Jacobian counting n; None: no limit."""

    equation = "least_squares"
    family = "IPE"

    def __post_init__(self) -> None:
        super().__post_init__()
        for option in fields(self.solver):
            if option.name in _ONLY_A_STEP and getattr(self.solver, option.name) != option.default:
                raise UserError(
                    f"solver.{option.name}: has no effect in relinearized; set {option.name}"
                    " beside it"
                )

    def begin(self, system: FrozenSystem, x: Array) -> Round:
        none = np.zeros(len(x), np.int64)
        running = np.full(len(x), Status.RUNNING, np.int8)
        return self._relinearize(system, x, running, none, [row[None] for row in x])

    def step(self, system: FrozenSystem, state: Round) -> Round:
        """Runs one round: inner steps from the last linearisation, then a new one where they
        end."""
        linearized = replace(system, H_plus=state.H_plus, deviation=state.deviation)
        limits = Limits(self.tolerance, self.inner_iterations, self.budget, history=True)
        start = self.solver.init(linearized, state.x, state.F)
        ended = iterate(linearized, self.solver, start, limits)
        assert ended.history is not None
        # A round begins with the iterate that ended the last one.
        rounds = zip(state.path, ended.history, strict=True)
        path = [np.concatenate([old, new[1:]]) for old, new in rounds]
        steps = state.steps + ended.iterations
        return self._relinearize(system, ended.x, ended.status, steps, path)

    def check(self, system: FrozenSystem, before: Round | None, state: Round) -> ConvergenceCheck:
        """Measures F at its own linearisation; an inner root, stall or limit is only the end of a
        round."""
        check = root_check(state.deviation, None, state)
        stuck = ~np.isin(state.inner, _ROUND_ENDS)
        return ConvergenceCheck(check.size, check.growth, check.moved, stuck, state.inner)

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        x, system = begin(problem, z, self.start)
        ended = iterate(system, self, x, Limits(self.tolerance, self.max_iterations, self.budget))
        state = ended.state
        P = _bound(system, state)
        path = state.path if history else None
        return Estimates.of(
            ended, system.model.tally, iterations=state.steps, history=path, covariance=P
        )

    def _relinearize(
        self,
        system: FrozenSystem,
        x: Array,
        inner: NDArray[np.int8],
        steps: NDArray[np.int64],
        path: list[Array],
    ) -> Round:
        """Returns the state at x with a new H; a trial whose round failed keeps its x, and has no F
        any more."""
        trials, n = x.shape
        F = np.full(x.shape, _NO_ROOT)
        H_plus = np.zeros((trials, n, system.z.shape[1]))
        deviation = np.ones(x.shape)
        going = np.isin(inner, _ROUND_ENDS) & finite(x)
        if going.any():
            part = system.subset(going).relinearized(x[going])
            F[going] = part.F(x[going])
            H_plus[going] = part.H_plus
            deviation[going] = part.deviation
        return Round(x, F, H_plus, deviation, inner, steps, path)


def _bound(system: FrozenSystem, state: Round) -> Array:
    """Computes (J' R^-1 J)^-1 (trials, n, n) at the end: H+ R H+', where the last round has found
    H+ there; else anew. The model may raise at a bad end."""
    P = frozen_covariance(state.H_plus, system.R)
    failed = (state.H_plus == 0).all(axis=(1, 2))
    P[failed] = np.nan
    lost = np.flatnonzero(failed & finite(state.x))
    if len(lost):
        J = system.model.reporting().jacobian(state.x[lost], lost)
        inverse_U = inverse_factor(system.R.whiten_jacobian(J))
        P[lost] = from_root(inverse_U)
    return P
