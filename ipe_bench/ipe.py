"""Iterative parameter estimation: the nonlinear system of eq. (11), and the driver that iterates a solver on it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from ipe_bench.errors import UserError, require_counts, require_positive
from ipe_bench.estimation import Estimates, Estimator, describe_exception
from ipe_bench.linalg import Array, Covariance, Mask, finite, inverse, multiply, pseudo_inverse, solve
from ipe_bench.measurements.base import Measurement
from ipe_bench.scenario import Problem
from ipe_bench.solvers.base import Solver, State
from ipe_bench.statuses import Status

S = TypeVar("S", bound=State)

_FAR = 1e8
"""Where the residual is this many times larger than at the start, the iteration has diverged."""
_TINY_STEP = 1e-3
"""Steps below this share of the tolerance, while F is above it, mean a stall."""


@dataclass
class Tally:
    """What a batch has cost and what went wrong in it, by trial; shared by all views of one system."""

    simulations: Array
    jacobians: Array
    singular: Mask
    messages: dict[int, str] = field(default_factory=dict)

    @classmethod
    def zeros(cls, trials: int) -> Tally:
        return cls(np.zeros(trials), np.zeros(trials), np.zeros(trials, dtype=bool))


@dataclass(frozen=True)
class Counted:
    """A model that counts its evaluations per trial, and in which a trial that raises spoils only itself.

    `share` is the cost of one evaluation: below 1 for a model restricted to the first epochs.
    """

    measurement: Measurement
    tally: Tally
    share: float = 1.0

    def simulate(self, x: Array, rows: NDArray[np.intp]) -> Array:
        """h(x) (trials, m) for the trials `rows` of the tally."""
        self.tally.simulations[rows] += self.share
        return self._each_if_raising(self.measurement.simulate, x, rows, (self.measurement.m,))

    def jacobian(self, x: Array, rows: NDArray[np.intp]) -> Array:
        """dh/dx (trials, m, n) for the trials `rows` of the tally."""
        self.tally.jacobians[rows] += self.share
        return self._each_if_raising(self.measurement.jacobian, x, rows, (self.measurement.m, self.measurement.n))

    def _each_if_raising(
        self, function: Callable[[Array], Array], x: Array, rows: NDArray[np.intp], shape: tuple[int, ...]
    ) -> Array:
        try:
            return function(x)
        except MemoryError:
            raise
        except Exception:
            result = np.full((len(x), *shape), np.nan)
            for i, row in enumerate(rows):
                try:
                    result[i] = function(x[i : i + 1])[0]
                except Exception as error:
                    self.tally.messages[int(row)] = describe_exception(error)
            return result


@dataclass(frozen=True)
class FrozenSystem:
    """F(x) = x - x0 - H+ (z - h(x0) - N(x)) = H+ (h(x) - z), eqs. (11) and (19), for the trials `rows` of a batch.

    H+ is frozen: one (1, n, m) for all trials, or one per trial (trials, n, m) where it was re-linearised.
    """

    model: Counted
    H_plus: Array
    z: Array
    rows: NDArray[np.intp]

    @classmethod
    def at_nominal(cls, problem: Problem, z: Array) -> FrozenSystem:
        """The paper's system: H about the nominal point, for readings z (trials, m)."""
        H_plus, deficient = pseudo_inverse(problem.H[None], problem.R)
        if deficient.any():
            raise UserError(
                f"measurement={problem.measurement.name}: H has not full column rank at the nominal point, so some "
                "parameters cannot be told apart; drop or combine parameters, or choose an estimator with a prior"
            )
        trials = len(z)
        return cls(Counted(problem.measurement, Tally.zeros(trials)), H_plus, z, np.arange(trials))

    def F(self, x: Array) -> Array:
        return multiply(self.H_plus, self.model.simulate(x, self.rows) - self.z)

    def J(self, x: Array) -> Array:
        return np.matmul(self.H_plus, self.model.jacobian(x, self.rows))

    def solve(self, A: Array, b: Array) -> Array:
        x, singular = solve(A, b)
        # What is not finite is none of A's doing: the driver finds it in F.
        self.model.tally.singular[self.rows[singular & finite(A) & finite(b)]] = True
        return x

    def subset(self, kept: Mask) -> FrozenSystem:
        H_plus = self.H_plus if len(self.H_plus) == 1 else self.H_plus[kept]
        return FrozenSystem(self.model, H_plus, self.z[kept], self.rows[kept])

    def relinearized(self, x: Array, R: Covariance) -> FrozenSystem:
        """The same readings with H+ of dh/dx at x (trials, n), for each trial its own; a deficient one is singular."""
        J = self.model.jacobian(x, self.rows)
        H_plus, deficient = pseudo_inverse(J, R)
        self.model.tally.singular[self.rows[deficient & finite(J)]] = True
        return FrozenSystem(self.model, H_plus, self.z, self.rows)


@dataclass
class Roots:
    """Where the iteration of each trial ended."""

    x: Array
    status: NDArray[np.int8]
    iterations: NDArray[np.int64]
    history: list[Array] | None


def find_roots(
    system: FrozenSystem,
    solver: Solver,
    x: Array,
    deviation: Array,
    *,
    tolerance: float,
    max_iterations: int,
    budget: float = np.inf,
    history: bool = False,
) -> Roots:
    """Iterates the solver from x (trials, n) until each trial has a root, or has failed in a way that has a name.

    A root is where every abs(F_i) is at most `tolerance` standard deviations `deviation` (n,) or (trials, n). `budget`
    bounds the simulations of a trial, a Jacobian counting n. Finished trials leave the batch.
    """
    trials, n = x.shape
    tally = system.model.tally
    roots = Roots(x.copy(), np.full(trials, Status.RUNNING, np.int8), np.zeros(trials, np.int64), None)
    iterates = [[row] for row in x] if history else None
    deviation = np.broadcast_to(deviation, x.shape)
    active = np.arange(trials)
    state = solver.init(system, x, system.F(x))
    begun = np.maximum(_norm(state.F / deviation), 1.0)
    step_size = np.full(trials, np.inf)

    for iteration in range(max_iterations + 1):
        if iteration:
            before = state.x
            state = solver.step(system, state)
            step_size = _norm((state.x - before) / deviation)
            roots.x[active] = state.x
            roots.iterations[active] = iteration
            if iterates is not None:
                for row, value in zip(active, state.x, strict=True):
                    iterates[row].append(value)
        residual = _norm(state.F / deviation)
        spent = tally.simulations[system.rows] + n * tally.jacobians[system.rows]
        status = np.select(
            [
                np.isin(system.rows, list(tally.messages)),
                tally.singular[system.rows],
                ~np.isfinite(residual),
                residual <= tolerance,
                residual > _FAR * begun,
                step_size < _TINY_STEP * tolerance,
                spent >= budget,
            ],
            [
                Status.ERROR,
                Status.SINGULAR,
                Status.NONFINITE,
                Status.CONVERGED,
                Status.DIVERGED,
                Status.STALLED,
                Status.BUDGET,
            ],
            Status.MAX_ITERATIONS if iteration == max_iterations else Status.RUNNING,
        )
        roots.status[active] = status
        going = status == Status.RUNNING
        if not going.any():
            break
        if not going.all():
            active, begun, deviation = active[going], begun[going], deviation[going]
            system, state = system.subset(going), _rows_of(state, going)
    if iterates is not None:
        roots.history = [np.array(rows) for rows in iterates]
    return roots


def _norm(a: Array) -> Array:
    """The largest magnitude of each trial."""
    return np.abs(a).max(axis=1)


def _rows_of(state: S, kept: Mask) -> S:
    fields = {f.name: getattr(state, f.name)[kept] for f in dataclasses.fields(state)}
    return dataclasses.replace(state, **fields)


@dataclass(frozen=True)
class IPE(Estimator):
    """The paper's estimator: a solver iterated on the system of eq. (11), H frozen at the nominal point.

    Reports the sandwich covariance (H+ J)^-1 H+ R H+' (H+ J)^-T at the estimate.
    """

    solver: Solver
    start: Literal["linear_lse", "nominal"] = "linear_lse"
    """Where the iteration begins: at the linear LSE, eq. (16), or at the nominal point."""
    max_iterations: int = 100
    tolerance: float = 1e-6
    """Largest abs(F_i) in standard deviations of the linear bound, eq. (5)."""
    budget: float | None = None
    """Simulations that a trial may cost, a Jacobian counting n; None: no limit."""

    equation = "frozen"

    def __post_init__(self) -> None:
        if self.start not in ("linear_lse", "nominal"):
            raise UserError(f"start={self.start}: choose linear_lse or nominal")
        require_positive(self, "tolerance", "budget")
        require_counts(self, "max_iterations")

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        system = FrozenSystem.at_nominal(problem, z)
        x0 = np.broadcast_to(problem.x0, (len(z), problem.measurement.n))
        # F(x0) = H+ (h(x0) - z), so the linear LSE of eq. (16) is one fixed-point step from the nominal point.
        x = x0 - system.F(x0) if self.start == "linear_lse" else x0.copy()
        roots = find_roots(
            system,
            self.solver,
            x,
            linear_deviation(system, problem),
            tolerance=self.tolerance,
            max_iterations=self.max_iterations,
            budget=np.inf if self.budget is None else self.budget,
            history=history,
        )
        tally = system.model.tally
        simulations, jacobians = tally.simulations.copy(), tally.jacobians.copy()
        return Estimates(
            x=roots.x,
            status=roots.status,
            covariance=sandwich(system, problem, roots.x),
            iterations=roots.iterations,
            simulations=simulations,
            jacobians=jacobians,
            messages=dict(tally.messages),
            history=roots.history,
        )


def linear_deviation(system: FrozenSystem, problem: Problem) -> Array:
    """Standard deviations (1, n) or (trials, n) of H+ v, eq. (5): the linear bound."""
    return np.sqrt(np.diagonal(frozen_covariance(system.H_plus, problem), axis1=1, axis2=2))


def frozen_covariance(H_plus: Array, problem: Problem) -> Array:
    """H+ R H+' (trials, n, n), which is eq. (5) where R = sigma^2 I."""
    R = problem.R
    if R.factor.ndim == 1:
        scaled = H_plus * R.factor
    else:
        scaled = np.matmul(H_plus, R.factor)
    return np.matmul(scaled, scaled.swapaxes(1, 2))


def sandwich(system: FrozenSystem, problem: Problem, x: Array) -> Array:
    """(H+ J)^-1 H+ R H+' (H+ J)^-T at x: the first-order covariance (trials, n, n) of the root of eq. (11).

    Not counted as cost: it is part of the report, not of the search.
    """
    uncounted = dataclasses.replace(system, model=Counted(problem.measurement, Tally.zeros(len(system.rows))))
    usable = finite(x)
    inverse_slope = np.full((len(x), x.shape[1], x.shape[1]), np.nan)
    if usable.any():
        inverse_slope[usable], _ = inverse(uncounted.subset(usable).J(x[usable]))
    P = np.matmul(np.matmul(inverse_slope, frozen_covariance(system.H_plus, problem)), inverse_slope.swapaxes(1, 2))
    return P
