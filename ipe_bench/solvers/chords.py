"""Iterates chords: Gauss-Newton steps with one Jacobian and Anderson's acceleration, renewed where it has changed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ipe_bench.basics.batches import put, take
from ipe_bench.basics.linalg import Array, Mask, finite, multiply, squared
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

_ITERATIONS = 25
"""Steps with the Jacobian H of the nominal point; where more are needed, another way is cheaper."""
_TRIED, _PER_DECADE = 6, 3
"""After `_TRIED` steps from the linear estimate, each decade by which the remaining step has shrunk may have taken at
most `_PER_DECADE` steps, the first three aside: far from the root the steps wander."""
_NEAR_ROOT = 1e-2
"""The distance from the root of eq. (11), in deviations, at which the Jacobian there takes over."""
_CHORDS = 8
"""Steps with one Jacobian from then on."""
_JACOBIANS = 16
"""Renewals at most, as long as each leaves the answer nearer to the minimum than the one before."""
_BENT = 200
"""Times the tolerance: how far from the minimum, in deviations, a Jacobian that has changed may leave the answer."""
_CONTRACTING = 0.75
"""The rate up to which fixed-point iteration counts as contracting, so that no other minimum is looked for."""
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
        nothing = np.zeros((*x.shape, min(_DEPTH, x.shape[1])))
        unknown, far = np.full(len(x), np.nan), np.full(len(x), np.inf)
        return cls(
            x,
            r,
            slope.towards(r),
            nothing,
            nothing,
            x,
            turn,
            far,
            unknown,
            unknown,
            np.full(len(x), -1),
        )

    @property
    def off(self) -> Array:
        """Bounds the distance (trials,), in deviations, from the end of the steps, at J' r = 0 for the J of the start,
        to the minimum.

        A change of J by the part e on the way makes that an error of about e deviations. e is seen twice: in the part
        of the first step that was taken back, and in the change of J on the way to the start, taken to go on at that
        rate.
        """
        inverse_U = self.slope.inverse_U
        gone = np.linalg.norm(multiply(self.slope.U, self.x - self.start), axis=1)
        J_turned = multiply(self.turn.swapaxes(1, 2), self.r) * gone[:, None]
        error = multiply(np.matmul(inverse_U, inverse_U.swapaxes(1, 2)), J_turned)
        by_turn = np.abs(error / np.sqrt(np.sum(inverse_U**2, axis=2))).max(axis=1)
        return np.fmax(self.bend, by_turn)


@dataclass(frozen=True)
class Chord(Method[Objective, OnChord]):
    """Takes Gauss-Newton steps with the Jacobian of the start, and Anderson's acceleration.

    With H, the Jacobian of the nominal point, these are the fixed-point steps of eq. (17).
    """

    bent: float = np.inf
    """Largest useful `off`: beyond it, the Jacobian is renewed."""

    def begin(self, objective: Objective, x: Array) -> OnChord:
        J = objective.jacobian(x)
        r = objective.residual(x)
        return OnChord.at(x, r, NormalEquations.of(J, r, keep_Q=True), np.zeros_like(J))

    def step(self, objective: Objective, state: OnChord) -> OnChord:
        F = -state.slope.newton
        x = accelerated(state.x, F, state.dx, state.dF)
        r = objective.residual(x)
        slope = state.slope.towards(r)
        seen = np.where(state.slope.size > self.bent, slope.size / state.slope.size, 0.0)
        return replace(
            state,
            x=x,
            r=r,
            slope=slope,
            dx=push(state.dx, x - state.x),
            dF=push(state.dF, -slope.newton - F),
            moved=np.abs((x - state.x) * slope.columns).max(axis=1),
            bend=np.where(np.isnan(state.bend), seen, state.bend),
            begun=np.where(np.isnan(state.begun), slope.size, state.begun),
            steps=state.steps + 1,
        )

    def check(
        self, objective: Objective, before: OnChord | None, state: OnChord
    ) -> ConvergenceCheck:
        rankless, decades = ~np.isfinite(state.slope.size), (state.steps - _TRIED / 2) / _PER_DECADE
        wanders = (state.steps >= _TRIED) & (state.slope.size > state.begun * 10.0**-decades)
        useless = wanders if np.isinf(self.bent) else state.off > self.bent
        size = np.where(useless, np.inf, state.slope.size)
        ending = np.where(rankless, Status.SINGULAR, Status.MAX_ITERATIONS)
        return ConvergenceCheck(
            size, np.sqrt(squared(state.r)), state.moved, rankless | useless, ending
        )


def by_chords(
    objective: Objective, H: Array, tolerance: float, budget: float | None, *, history: bool
) -> tuple[Minima, Mask]:
    """Finds the least-squares minimum of each trial, H (m, n) being the Jacobian at the nominal point, and where
    fixed-point iteration contracts well there, eq. (18). Trials that do not arrive have not converged."""
    x0 = np.repeat(objective.x0[None], len(objective.rows), axis=0)
    minima, contracts = Minima.nowhere(x0, history), np.zeros(len(x0), dtype=bool)
    nominal = NormalEquations.of(
        objective.R.whiten_jacobian(H[None]), np.zeros((1, len(H))), keep_Q=True
    )
    if not np.isfinite(nominal.size).all():  # H lacks rank, which says nothing of other points
        return minima, contracts
    frozen = take(nominal, np.zeros(len(x0), np.intp))
    start = OnChord.at(x0, objective.residual(x0), frozen, np.zeros((len(x0), *H.shape)))
    ended = iterate(objective, Chord(), start, Limits(_NEAR_ROOT, _ITERATIONS, budget, history))
    near = np.flatnonzero(ended.converged)
    if len(near):
        limits = Limits(tolerance, _CHORDS, budget, history)
        found = _renewed(objective.subset(ended.converged), take(ended, near), x0[near], limits)
        minima = put(minima, near, minima_of(found, found.state.slope, objective.readings))
        contracts[near] = _radius(nominal, found.state.slope) <= _CONTRACTING
    return minima, contracts


def _renewed(
    objective: Objective, found: SolveResult[OnChord], origin: Array, limits: Limits
) -> SolveResult[OnChord]:
    """Takes chord steps for near trials, with a new Jacobian as long as that of the start is not that of the end."""
    bent, rows, off = _BENT * limits.tolerance, np.arange(len(origin)), np.full(len(origin), np.inf)
    for _ in range(_JACOBIANS):
        part, latest = objective.subset(rows), take(found, rows)
        x, r, slope = latest.x, latest.state.r, latest.state.slope
        J = part.jacobian(x)
        assert slope.Q is not None
        gone = np.linalg.norm(multiply(slope.U, x - origin), axis=1)
        turn = (J - np.matmul(slope.Q, slope.U)) / np.where(gone > 0, gone, np.inf)[:, None, None]
        start = OnChord.at(x, r, NormalEquations.of(J, r, keep_Q=True), turn)
        ended = iterate(part, Chord(bent), start, limits)
        found = put(found, rows, continued(latest, ended))
        now = ended.state.off
        again = (now > bent) & (now < off) & (ended.status == Status.MAX_ITERATIONS)
        if not again.any():
            break
        rows, off, origin = rows[again], now[again], x[again]
    return found


def _radius(nominal: NormalEquations, slope: NormalEquations) -> Array:
    """Computes the spectral radius (trials,) of I - H+ J, the rate at which fixed-point iteration converges."""
    assert nominal.Q is not None
    assert slope.Q is not None
    J_F = np.matmul(
        np.matmul(nominal.inverse_U, np.matmul(nominal.Q.swapaxes(1, 2), slope.Q)), slope.U
    )
    usable = finite(J_F)
    rates = np.linalg.eigvals(np.where(usable[:, None, None], np.eye(J_F.shape[1]) - J_F, 0.0))
    return np.where(usable, np.abs(rates).max(axis=1), np.inf)
