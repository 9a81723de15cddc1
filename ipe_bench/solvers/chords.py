"""Iterates chords: Gauss-Newton steps with one Jacobian and Anderson's acceleration, renewed where
it has changed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ipe_bench.basics.batches import put, take
from ipe_bench.basics.linalg import Array, Mask, finite, from_root, multiply, repeated, squared
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.driver import (
    ConvergenceCheck,
    Limits,
    Method,
    SolveResult,
    continued,
    iterate,
)
from ipe_bench.estimators.least_squares import NormalEquations, Objective
from ipe_bench.estimators.minima import Minima, minima_of
from ipe_bench.solvers.anderson import accelerated, push

# Halved or doubled, each of these leaves 313 of 320 trials solved, and changes the cost by 2 % at
# most, or as in parentheses: `python tests/benchmarks/constants.py chords`.
_ITERATIONS = 25
"""Steps with the Jacobian H of the start; where more are needed, another way is cheaper."""
_TRIED = 6
"""Steps from the linear estimate after which it shows whether they wander, as far from the root
(+6 %, 0)."""
_PER_DECADE = 3
"""Steps at most, the first three aside, for each decade by which the remaining step has shrunk
(+11 %, -1 %)."""
_NEAR_ROOT = 1e-2
"""The distance from the root of eq. (11), in deviations, at which the Jacobian there takes over."""
_CHORDS = 8
"""Steps with one Jacobian from then on."""
_JACOBIANS = 16
"""Renewals at most, as long as each leaves the answer nearer to the minimum than the one before."""
_BENT = 200
"""Times the tolerance: how far from the minimum, in deviations, a Jacobian that has changed may
leave the answer."""
_CONTRACTING = 0.75
"""The rate up to which fixed-point iteration counts as contracting, so that no other minimum is
looked for (+30 %, -15 %: of problems with a prior, whose copies it then flags or does not)."""
_DEPTH = 5
"""Differences that accelerate a step."""


@dataclass(frozen=True)
class OnChord:
    """Holds the state of chord steps; every field has the trials in front."""

    x: Array
    r: Array
    """Whitened residuals."""
    slope: NormalEquations
    """The normal equations of the chord's Jacobian, towards r."""
    dx: Array
    dF: Array
    """The last differences (trials, n, depth) of x and of the steps, newest first."""
    start: Array
    turn: Array
    """The change of J (trials, m, n) on the way to the start, per unit of |J dx|."""
    moved: Array
    bend: Array
    """The part (trials,) of the first step that the next one had to take back; NaN before it."""
    begun: Array
    """The step still to go (trials,), in deviations, after the first one; NaN before it."""
    steps: Array
    """Steps (trials,) since the first one; -1 before it."""

    @classmethod
    def at(cls, x: Array, r: Array, slope: NormalEquations, turn: Array) -> OnChord:
        trials, n = x.shape
        nothing = np.zeros((trials, n, min(_DEPTH, n)))
        unknown = np.full(trials, np.nan)
        return cls(
            x,
            r,
            slope.towards(r),
            dx=nothing,
            dF=nothing,
            start=x,
            turn=turn,
            moved=np.full(trials, np.inf),
            bend=unknown,
            begun=unknown,
            steps=np.full(trials, -1),
        )

    @property
    def off(self) -> Array:
        """Bounds the distance (trials,), in deviations, from the end of the steps, at J' r = 0 for
        the J of the start, to the minimum.

        A change of J by the part e on the way makes that an error of about e deviations. e is seen
        twice: in the part of the first step that was taken back, and in the change of J on the way
        to the start, taken to go on at that rate.
        """
        inverse_U = self.slope.inverse_U
        gone = np.linalg.norm(multiply(self.slope.U, self.x - self.start), axis=1)
        # J' r is 0 for the J of the start: for the turned one it is dJ' r, a step of P dJ' r.
        J_turned = multiply(self.turn.swapaxes(1, 2), self.r) * gone[:, None]
        P = from_root(inverse_U)
        deviation = np.sqrt(np.sum(inverse_U**2, axis=2))
        by_turn = np.abs(multiply(P, J_turned) / deviation).max(axis=1)
        return np.fmax(self.bend, by_turn)


@dataclass(frozen=True)
class Chord(Method[Objective, OnChord]):
    """Takes Gauss-Newton steps with the Jacobian of the start, and Anderson's acceleration.

    With H, the Jacobian of the start, these are the fixed-point steps of eq. (17).
    """

    bent: float = np.inf
    """Largest useful `off`: beyond it, the Jacobian is renewed."""

    def begin(self, objective: Objective, x: Array) -> OnChord:
        J = objective.jacobian(x)
        r = objective.residual(x)
        slope = NormalEquations.of(J, r, keep_Q=True)
        return OnChord.at(x, r, slope, turn=np.zeros_like(J))

    def step(self, objective: Objective, state: OnChord) -> OnChord:
        F = -state.slope.newton
        x = accelerated(state.x, F, state.dx, state.dF)
        r = objective.residual(x)
        slope = state.slope.towards(r)
        # With the right Jacobian the second step is nothing beside the first.
        seen = np.where(state.slope.size > self.bent, slope.size / state.slope.size, 0.0)
        first = np.isnan(state.bend)
        step = x - state.x
        return replace(
            state,
            x=x,
            r=r,
            slope=slope,
            dx=push(state.dx, step),
            dF=push(state.dF, -slope.newton - F),
            moved=np.abs(step * slope.columns).max(axis=1),
            bend=np.where(first, seen, state.bend),
            begun=np.where(np.isnan(state.begun), slope.size, state.begun),
            steps=state.steps + 1,
        )

    def check(
        self, objective: Objective, before: OnChord | None, state: OnChord
    ) -> ConvergenceCheck:
        size = state.slope.size
        rankless = ~np.isfinite(size)
        decades = (state.steps - _TRIED / 2) / _PER_DECADE
        wanders = (state.steps >= _TRIED) & (size > state.begun * 10.0**-decades)
        useless = wanders if np.isinf(self.bent) else state.off > self.bent
        return ConvergenceCheck(
            np.where(useless, np.inf, size),
            np.sqrt(squared(state.r)),
            state.moved,
            rankless | useless,
            np.where(rankless, Status.SINGULAR, Status.MAX_ITERATIONS),
        )


def by_chords(
    objective: Objective, H: Array, tolerance: float, budget: float | None, *, history: bool
) -> tuple[Minima, Mask]:
    """Finds the least-squares minimum of each trial, H (m, n) being the Jacobian at the
    start, and where fixed-point iteration contracts well there, eq. (18). Trials that do not arrive
    have not converged."""
    trials = len(objective.rows)
    x0 = repeated(objective.x0, trials)
    minima = Minima.nowhere(x0, history)
    contracts = np.zeros(trials, dtype=bool)
    white = objective.R.whiten_jacobian(H[None])
    nominal = NormalEquations.of(white, np.zeros((1, len(H))), keep_Q=True)
    # H lacks rank, which says nothing of other points.
    if not np.isfinite(nominal.size).all():
        return minima, contracts
    frozen = take(nominal, np.zeros(trials, np.intp))
    start = OnChord.at(x0, objective.residual(x0), frozen, np.zeros((trials, *H.shape)))
    ended = iterate(objective, Chord(), start, Limits(_NEAR_ROOT, _ITERATIONS, budget, history))
    near = np.flatnonzero(ended.converged)
    if len(near):
        part = objective.subset(ended.converged)
        limits = Limits(tolerance, _CHORDS, budget, history)
        found = _renewed(part, take(ended, near), x0[near], limits)
        slope = found.state.slope
        minima = put(minima, near, minima_of(found, slope, objective.readings))
        contracts[near] = _radius(nominal, slope) <= _CONTRACTING
    return minima, contracts


def _renewed(
    objective: Objective, found: SolveResult[OnChord], origin: Array, limits: Limits
) -> SolveResult[OnChord]:
    """Takes chord steps for near trials, with a new Jacobian as long as that of the start is not
    that of the end."""
    bent = _BENT * limits.tolerance
    rows = np.arange(len(origin))
    off = np.full(len(origin), np.inf)
    for _ in range(_JACOBIANS):
        part = objective.subset(rows)
        latest = take(found, rows)
        x = latest.x
        r = latest.state.r
        slope = latest.state.slope
        assert slope.Q is not None
        J = part.jacobian(x)
        # How much J has changed since the chord's, over the length of the way here.
        gone = np.linalg.norm(multiply(slope.U, x - origin), axis=1)
        length = np.where(gone > 0, gone, np.inf)
        turn = (J - np.matmul(slope.Q, slope.U)) / length[:, None, None]
        start = OnChord.at(x, r, NormalEquations.of(J, r, keep_Q=True), turn)
        ended = iterate(part, Chord(bent), start, limits)
        found = put(found, rows, continued(latest, ended))
        now = ended.state.off
        unfinished = ended.status == Status.MAX_ITERATIONS
        again = (now > bent) & (now < off) & unfinished
        if not again.any():
            break
        rows = rows[again]
        off = now[again]
        origin = x[again]
    return found


def _radius(nominal: NormalEquations, slope: NormalEquations) -> Array:
    """Computes the spectral radius (trials,) of I - H+ J, the rate at which fixed-point iteration
    converges."""
    assert nominal.Q is not None
    assert slope.Q is not None
    # With H = Q0 U0 and J = Q U, H+ J = U0^-1 Q0' Q U.
    rotation = np.matmul(nominal.Q.swapaxes(1, 2), slope.Q)
    J_F = np.matmul(np.matmul(nominal.inverse_U, rotation), slope.U)
    usable = finite(J_F)
    contraction = np.eye(J_F.shape[1]) - J_F
    rates = np.linalg.eigvals(np.where(usable[:, None, None], contraction, 0.0))
    return np.where(usable, np.abs(rates).max(axis=1), np.inf)
