"""Defines iterative parameter estimation: the nonlinear system of eq. (11), and IPE, the base of
its solvers."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, Literal, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.errors import Unsuited
from ipe_bench.basics.linalg import (
    Array,
    Covariance,
    Mask,
    deviations,
    finite,
    from_root,
    inverse,
    multiply,
    pseudo_inverse,
    repeated,
    solve,
    squared,
)
from ipe_bench.basics.options import Count, Positive
from ipe_bench.estimators.base import Estimates, Estimator
from ipe_bench.estimators.driver import ConvergenceCheck, Limits, Method, iterate
from ipe_bench.measurements.counted import CountingModel, EvaluationCount

if TYPE_CHECKING:
    from ipe_bench.measurements.problem import Problem

Start = Literal["linear_lse", "nominal", "best"]
"""Where an iteration begins: at the linear LSE, eq. (16), at the model's start, or at the better
fit of the two."""
_COARSE_BEYOND = 0.03
"""Size of F, in standard deviations of the linear bound, above which a coarse Jacobian is as good
for a step."""


class System(Protocol):
    """Holds a square system F(x) = 0 for each trial of a batch: all that a solver sees of the
    problem.

    x and F are (trials, n) in multiples of the parameters' units.
    """

    def F(self, x: Array) -> Array:
        """Computes the residual at x; NaN where the model fails."""
        ...

    def J(self, x: Array, F: Array | None = None) -> Array:
        """Computes dF/dx (trials, n, n); if F is given, for a step from there: near enough for
        that, and exact near a root, so that an order of two is not lost."""
        ...

    def solve(self, A: Array, b: Array) -> Array:
        """Computes A^-1 b for each trial: A (trials, n, n), b (trials, n) or (trials, n, k). A
        singular A ends its trial."""
        ...

    def subset(self, kept: Mask) -> System:
        """Restricts the system to some of its trials: a line search goes on with the rows that need
        it."""
        ...


@dataclass(frozen=True)
class State:
    """Holds the state of a solver between steps. Every field is an array with the trials axis in
    front, so that the driver can drop the trials that have finished; a solver with a memory adds
    fields in a subclass."""

    x: Array
    F: Array


S = TypeVar("S", bound=State)


class Rankless(Unsuited, np.linalg.LinAlgError):
    """Signals that H has not full column rank."""


@dataclass(frozen=True)
class FrozenSystem:
    r"""Defines the nonlinear system of eqs. (11) and (19) for the trials `rows` of a batch.

    .. math:: F(x) = x - x_0 - H^+ \left( z - h(x_0) - N(x) \right) = H^+ \left( h(x) - z \right)

    H+ is frozen: one (1, n, m) for all trials, or one per trial (trials, n, m) where it was
    re-linearised.
    """

    model: CountingModel
    H_plus: Array
    deviation: Array
    """Standard deviations (1, n) or (trials, n) of H+ v, eq. (5): the linear bound."""
    R: Covariance
    z: Array
    rows: NDArray[np.intp]

    @classmethod
    def at_nominal(cls, problem: Problem, z: Array) -> FrozenSystem:
        """Builds the paper's system: H about the start, for readings z (trials, m).

        Raises:
            Rankless: H has not full column rank.
        """
        if problem.rankless:
            raise Rankless(
                f"measurement={problem.measurement.name}: H has not full column rank at the"
                " start: some parameters cannot be distinguished there, so there is no"
                " linear estimate to start from; give another start, start=nominal or best"
                " for least squares, or an estimator with a prior"
            )
        model = CountingModel(problem.measurement, EvaluationCount.zeros(len(z)))
        H_plus = problem.H_plus[None]
        deviation = deviations(frozen_covariance(H_plus, problem.R))
        return cls(model, H_plus, deviation, problem.R, z, np.arange(len(z)))

    def F(self, x: Array) -> Array:
        return multiply(self.H_plus, self.model.residual(x, self.rows, self.z))

    def J(self, x: Array, F: Array | None = None) -> Array:
        coarse: Mask | bool = False
        if F is not None:
            coarse = np.abs(F / self.deviation).max(axis=1) > _COARSE_BEYOND
        return np.matmul(self.H_plus, self.model.jacobian(x, self.rows, coarse=coarse))

    def solve(self, A: Array, b: Array) -> Array:
        x, singular = solve(A, b)
        # What is not finite is none of A's doing: the driver finds it in F.
        by_A = singular & finite(A) & finite(b)
        self.model.tally.singular[self.rows[by_A]] = True
        return x

    def subset(self, kept: Mask) -> FrozenSystem:
        slopes = {}
        if len(self.H_plus) != 1:
            slopes = {"H_plus": self.H_plus[kept], "deviation": self.deviation[kept]}
        return dataclasses.replace(self, z=self.z[kept], rows=self.rows[kept], **slopes)

    def relinearized(self, x: Array) -> FrozenSystem:
        """Returns the system with H+ of dh/dx at x (trials, n), for each trial its own; a deficient
        one is singular."""
        J = self.model.jacobian(x, self.rows)
        H_plus, deficient = pseudo_inverse(J, self.R)
        self.model.tally.singular[self.rows[deficient & finite(J)]] = True
        deviation = deviations(frozen_covariance(H_plus, self.R))
        return dataclasses.replace(self, H_plus=H_plus, deviation=deviation)

    def covariance(self) -> Array:
        """Computes the covariance (1, n, n) or (trials, n, n) of the linear LSE, eq. (5)."""
        return frozen_covariance(self.H_plus, self.R)

    def sandwich(self, x: Array) -> Array:
        """Computes (H+ J)^-1 H+ R H+' (H+ J)^-T at x: the first-order covariance (trials, n, n) of
        eq. (11)'s root."""
        n = x.shape[1]
        inverse_slope = np.full((len(x), n, n), np.nan)
        usable = finite(x)
        if usable.any():
            part = self.subset(usable)
            J = self.model.reporting().jacobian(x[usable], part.rows)
            inverse_slope[usable], _ = inverse(np.matmul(part.H_plus, J))
        return np.matmul(np.matmul(inverse_slope, self.covariance()), inverse_slope.swapaxes(1, 2))


def frozen_covariance(H_plus: Array, R: Covariance) -> Array:
    r"""Computes the covariance (trials, n, n) of the linear estimate, eq. (5) for any R, from H+
    (trials, n, m).

    .. math::
        H^+ R H^{+T} = (H^T R^{-1} H)^{-1},
        \quad \sigma^2 (H^T H)^{-1} \text{ if } R = \sigma^2 I
    """
    scaled = H_plus * R.factor if R.factor.ndim == 1 else np.matmul(H_plus, R.factor)
    return from_root(scaled)


def begin(problem: Problem, z: Array, start: Start) -> tuple[Array, FrozenSystem]:
    """Returns the start x (trials, n) of an iteration, and the paper's system, which has counted
    the cost of it.

    F(x0) = H+ (h(x0) - z), so the linear LSE of eq. (2) is one fixed-point step from the
    start: eq. (16).
    """
    system = FrozenSystem.at_nominal(problem, z)
    x0 = repeated(problem.x0, len(z))
    if start == "nominal":
        return x0, system
    r0 = system.model.residual(x0, system.rows, system.z)
    lse = x0 - multiply(system.H_plus, r0)
    if start == "linear_lse":
        return lse, system
    r = system.model.residual(lse, system.rows, system.z)
    better = squared(system.R.whiten(r)) < squared(system.R.whiten(r0))
    return np.where(better[:, None], lse, x0), system


def starting_points(problem: Problem, z: Array, start: Start, tally: EvaluationCount) -> Array:
    """Returns the points (trials, n) where least squares begins, the model's start if H has not
    full column rank, and adds their cost to the tally."""
    if start == "nominal" or problem.rankless:
        return repeated(problem.x0, len(z))
    x, system = begin(problem, z, start)
    tally.simulations += system.model.tally.simulations
    tally.messages.update(system.model.tally.messages)
    return x


@dataclass(frozen=True, kw_only=True)
class IPE(Method[FrozenSystem, S], Estimator, Generic[S]):
    r"""Solves eq. (11), H frozen at the start, by an iteration that a subclass writes: the
    paper's estimator.

    Required: `step`. Optional: `init`, of a solver with a memory, which names its state:
    `IPE[BroydenState]`. Promised, beside what an `Estimator` promises: the fields of a state have
    the trials in front, x and F among them; the driver does the loop, the tests of convergence and
    divergence, and the counting. The reported covariance is

    .. math:: (H^+ J)^{-1} H^+ R H^{+T} (H^+ J)^{-T}

    >>> import ipe_bench as ib
    >>> @dataclass(frozen=True)
    ... class Relaxed(ib.IPE):
    ...     gain: float = 0.5
    ...     def step(self, system, state):
    ...         x = state.x - self.gain * state.F
    ...         return ib.State(x, system.F(x))
    >>> scenario = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01))
    >>> found = Relaxed().estimate(scenario.problem, scenario.draw(0, 3).z)
    >>> print((found.status == ib.Status.CONVERGED).all())
    True
    """

    start: Start = "linear_lse"
    """Where the iteration begins: at the linear LSE, eq. (16), at the model's start (`nominal`),
    or at the one of the two where the readings fit better (`best`)."""
    max_iterations: Count = 100
    """Steps at most, then the trial ends as `max_iterations`."""
    tolerance: Positive = 1e-6
    """Largest abs(F_i) in standard deviations of the linear bound, eq. (5)."""
    budget: Positive | None = None
    """Simulations that a trial may cost, a Jacobian counting n; None: no limit."""

    equation = "frozen"

    def init(self, system: System, x: Array, F: Array) -> S:
        """Returns the state at the start x (trials, n), where the residual is F."""
        return State(x, F)  # type: ignore[return-value]

    def begin(self, system: FrozenSystem, x: Array) -> S:
        return self.init(system, x, system.F(x))

    def check(self, system: FrozenSystem, before: S | None, state: S) -> ConvergenceCheck:
        """Measures abs(F_i), and the step, in standard deviations of the linear bound."""
        return root_check(system.deviation, before, state)

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        x, system = begin(problem, z, self.start)
        limits = Limits(self.tolerance, self.max_iterations, self.budget, history)
        ended = iterate(system, self, x, limits)
        return Estimates.of(ended, system.model.tally, covariance=system.sandwich(ended.x))


def root_check(deviation: Array, before: State | None, state: State) -> ConvergenceCheck:
    """Measures F and the last step in standard deviations (1, n) or (trials, n)."""
    residual = np.abs(state.F / deviation).max(axis=1)
    moved = np.full(len(residual), np.inf)
    if before is not None:
        moved = np.abs((state.x - before.x) / deviation).max(axis=1)
    return ConvergenceCheck(residual, residual, moved)
