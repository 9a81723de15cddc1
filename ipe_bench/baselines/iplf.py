"""The damped iterated posterior linearisation filter."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ipe_bench.baselines.information import Belief, EpochReadings, InformationFilter
from ipe_bench.basics.batches import put, take
from ipe_bench.basics.linalg import Array, Mask, finite, inverse, multiply, squared
from ipe_bench.basics.options import Count, Positive
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.driver import ConvergenceCheck, Limits, Solver, iterate

_SHORTEST = 2.0**-10
"""A share of a step below which no shorter one is tried: the covariance is brought up to date instead."""


@dataclass(frozen=True)
class Affine:
    """h(x) - z is about r + A (x - x0) with an error of covariance Omega, over N(x0, (U'U)^-1)."""

    r: Array
    """(trials, m)."""
    A: Array
    """(trials, m, n)."""
    Omega: Array
    """(trials, m, m)."""

    @classmethod
    def over(cls, readings: EpochReadings, x: Array, U: Array) -> Affine:
        """By regression over 2n cubature points."""
        n = x.shape[1]
        S = np.sqrt(n) * inverse(U)[0].swapaxes(1, 2)
        d = readings.misfits(np.concatenate([x[:, None] + S, x[:, None] - S], axis=1))
        r = d.mean(axis=1)
        spread = d - r[:, None]
        # A U^-1, since the points are U^-1 times sqrt(n) unit vectors.
        B = (d[:, :n] - d[:, n:]).swapaxes(1, 2) / (2.0 * np.sqrt(n))
        Omega = np.matmul(spread.swapaxes(1, 2), spread) / (2 * n) - np.matmul(B, B.swapaxes(1, 2))
        return cls(r, np.matmul(B, U), Omega)


@dataclass(frozen=True)
class Linearized:
    """Where an epoch stands; every field has the trials in front."""

    x: Array
    U: Array
    """Of the covariance over which the readings are linearised."""
    affine: Affine
    W: Array
    """(R + Omega)^-1/2 (trials, m, m)."""
    cost: Array
    """|W r|^2 + |U0 (x - x0)|^2 (trials,)."""
    proposal: Belief
    """The posterior by the present linearisation."""
    innovations: Array
    share: Array
    """Of the step to the proposal's mean that is tried next."""
    inner: Array
    """Regressions since the covariance was brought up to date."""
    change: Array
    """What that changed, in deviations and in share of them; infinite before."""

    @classmethod
    def over(cls, readings: EpochReadings, x: Array, U: Array, change: Array) -> Linearized:
        """The state at x once the readings are linearised over N(x, (U'U)^-1)."""
        affine = Affine.over(readings, x, U)
        W = _whitener(affine.Omega)
        proposal, innovations = _posterior(readings, W, affine, x)
        cost = _cost(readings, W, affine, x)
        return cls(x, U, affine, W, cost, proposal, innovations, np.ones(len(x)), np.zeros(len(x)), change)


@dataclass(frozen=True)
class IPLF(InformationFilter, Solver[Linearized]):
    """Readings linearised by regression over the posterior itself, again and again (García-Fernández, Svensson,
    Morelande, Särkkä, IEEE TSP 63(20), 2015), the mean damped as in Raitoharju, Svensson, García-Fernández and Piché
    (IEEE SPL 25(4), 2018; arXiv 1704.01113).

    At 2n cubature points of the posterior so far, h is about A x + b with an error of covariance Omega; that affine
    model, of noise R + Omega, updates the prior. The inner loop moves the mean at a fixed posterior covariance and
    Omega, by Gauss-Newton steps halved until the misfit decreases; the outer loop brings both up to date.
    """

    max_iterations: Count = 30
    """Regressions per epoch; an epoch that has not settled by then goes on from where it is."""
    inner_iterations: Count = 3
    """Regressions between two covariances."""
    tolerance: Positive = 1e-2
    """Largest change, in deviations of the updated P and in share of them, at which an epoch is done."""

    def update(self, readings: EpochReadings) -> tuple[Belief, Array]:
        start = self.begin(readings, readings.belief.mean)
        ended = iterate(readings, self, start, Limits(self.tolerance, self.max_iterations))
        lost = (ended.status == Status.NONFINITE)[:, None]
        belief = ended.state.proposal
        return replace(belief, mean=np.where(lost, np.nan, belief.mean)), start.innovations

    def begin(self, system: EpochReadings, x: Array) -> Linearized:
        return Linearized.over(system, x, system.belief.U, np.full(len(x), np.inf))

    def step(self, system: EpochReadings, state: Linearized) -> Linearized:
        """One regression at the point that the last step proposes, and another where the covariance is renewed."""
        x = state.x + state.share[:, None] * (state.proposal.mean - state.x)
        affine = Affine.over(system, x, state.U)
        cost = _cost(system, state.W, affine, x)
        taken = cost < state.cost
        x, affine = np.where(taken[:, None], x, state.x), put(state.affine, taken, take(affine, taken))
        proposal, _ = _posterior(system, state.W, affine, x)
        state = replace(
            state,
            x=x,
            affine=affine,
            cost=np.where(taken, cost, state.cost),
            share=np.where(taken, 1.0, state.share / 2),
            inner=state.inner + 1,
            proposal=proposal,
        )
        # The largest distance to the proposed mean, in deviations.
        to_go = np.abs((proposal.mean - x) / _deviations(proposal.U)).max(axis=1)
        settled = (state.inner >= self.inner_iterations) & taken
        settled |= (to_go <= self.tolerance) | (state.share < _SHORTEST)
        if settled.any():
            part = take(state, settled)
            narrowed = np.abs(_deviations(part.proposal.U) / _deviations(part.U) - 1.0).max(axis=1)
            change = np.fmax(to_go[settled], narrowed)
            renewed = Linearized.over(system.subset(settled), part.x, part.proposal.U, change)
            state = put(state, settled, replace(renewed, innovations=part.innovations))
        return state

    def check(self, system: EpochReadings, before: Linearized | None, state: Linearized) -> ConvergenceCheck:
        """Done where bringing the covariance up to date has changed neither it nor the mean."""
        level = np.where(np.isfinite(state.cost) & state.proposal.usable, 1.0, np.nan)
        return ConvergenceCheck(state.change, level, np.full(len(state.x), np.inf))


def _posterior(readings: EpochReadings, W: Array, affine: Affine, x: Array) -> tuple[Belief, Array]:
    return readings.belief.given(np.matmul(W, affine.A), multiply(W, affine.r), x)


def _cost(readings: EpochReadings, W: Array, affine: Affine, x: Array) -> Array:
    prior = readings.belief
    return squared(multiply(W, affine.r)) + squared(multiply(prior.U, x - prior.mean))


def _deviations(U: Array) -> Array:
    """Standard deviations (trials, n) where the information is U'U."""
    return np.linalg.norm(inverse(U)[0], axis=2)


def _whitener(Omega: Array) -> Array:
    """(I + Omega)^-1/2 (trials, m, m), where rounding has left Omega an eigenvalue below zero as if it were zero."""
    usable: Mask = finite(Omega)
    Omega = np.where(usable[:, None, None], Omega, 0.0)
    values, vectors = np.linalg.eigh((Omega + Omega.swapaxes(1, 2)) / 2)
    scale = np.where(usable[:, None], 1.0 / np.sqrt(1.0 + np.maximum(values, 0.0)), np.nan)
    return scale[:, :, None] * vectors.swapaxes(1, 2)
