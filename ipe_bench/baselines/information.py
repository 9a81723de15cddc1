"""Filters by linearising an epoch's readings repeatedly: all trials at once, in square-root
information form.

The covariance is kept as a square root U of P^-1 = U'U, which a QR decomposition updates (Bierman,
Factorization Methods for Discrete Sequential Estimation, 1977, ch. V): no S to invert and no P - K
S K' to cancel, however wide the prior is beside the noise.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from ipe_bench.baselines.epochs import Epoch, Rows, Walk, read_members
from ipe_bench.basics.batches import put, take
from ipe_bench.basics.linalg import (
    Array,
    Mask,
    finite,
    from_root,
    gram,
    inverse,
    multiply,
    repeated,
    squared,
)
from ipe_bench.basics.options import Count, Positive
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.base import Estimates, Estimator, Need
from ipe_bench.estimators.driver import ConvergenceCheck, Limits, Method, iterate
from ipe_bench.measurements.counted import CountingModel
from ipe_bench.measurements.problem import Problem

_SHORTEST = 2.0**-10
"""A share of a step below which no shorter one is tried: the covariance is brought up to date
instead."""


@dataclass(frozen=True)
class Belief:
    """Holds N(mean, (U'U)^-1) for each trial, in prior deviations from the start."""

    mean: Array
    """(trials, n)."""
    U: Array
    """(trials, n, n): any square root of the information."""

    @property
    def usable(self) -> Mask:
        """Tells where the numbers are finite (trials,)."""
        return finite(self.mean) & finite(self.U)

    def root(self) -> Array:
        """Computes U^-1 (trials, n, n), so that P is it times its transpose; NaN where U is
        singular."""
        return inverse(self.U)[0]

    def given(self, J: Array, r: Array, at: Array) -> tuple[Belief, Array]:
        """Takes in readings of unit variance, linear in x, with h(at) - z = r (trials, m) and dh/dx
        = J; returns the belief and the squared innovations y' S^-1 y (trials,) of these
        readings."""
        # The step s = x - at that minimises |U (s + at - mean)|^2 + |J s + r|^2.
        rows = np.concatenate([self.U, J], axis=1)
        before = multiply(self.U, at - self.mean)
        wanted = -np.concatenate([before, r], axis=1)
        Q, U = np.linalg.qr(rows)
        fitted = multiply(Q.swapaxes(1, 2), wanted)
        step = multiply(inverse(U)[0], fitted)
        # What the step does not take away of the sum of squares are the squared innovations.
        return Belief(at + step, U), squared(wanted) - squared(fitted)


@dataclass(frozen=True)
class EpochReadings:
    """Holds the readings z (trials, m) of an epoch, for the trials `rows`, and the belief before
    them.

    x is in prior deviations from the start.
    """

    epoch: Epoch
    model: CountingModel
    x0: Array
    deviation: Array
    """The deviations of the scenario's prior (n,), in multiples of the parameters' units."""
    z: Array
    rows: Rows
    belief: Belief

    def misfit(self, x: Array) -> Array:
        """Computes h(x) - z (trials, m), whitened."""
        R = self.epoch.R
        h = self.model.simulate(self.physical(x), self.rows)
        return R.whiten(self.epoch.model.near(h, self.z)) - R.whiten(self.z)

    def slope(self, x: Array) -> Array:
        """Computes dh/dx (trials, m, n), whitened."""
        J = self.model.jacobian(self.physical(x), self.rows)
        return self.epoch.R.whiten_jacobian(J) * self.deviation

    def misfits(self, points: Array) -> Array:
        """Computes h - z (trials, points, m) at points (trials, points, n), whitened."""
        h = read_members(self.model, self.epoch.R, self.physical(points), self.rows, self.z)
        return h - self.epoch.R.whiten(self.z)[:, None]

    def physical(self, x: Array) -> Array:
        """Returns x in multiples of the parameters' units."""
        return self.x0 + x * self.deviation

    def subset(self, kept: Mask) -> EpochReadings:
        return replace(self, z=self.z[kept], rows=self.rows[kept], belief=take(self.belief, kept))


@dataclass(frozen=True)
class InformationFilter(Estimator):
    """Holds what the filters of this room share: the prior, the epochs, failures and the report.

    Reports its P, and as `extras["nis"]` the trial's squared innovations over their number: 1 on
    average where the filter is consistent.
    """

    prior_inflation: Positive = 1.0
    """The filter's prior deviations over the scenario's: in life a prior is never exact."""

    needs: ClassVar[frozenset[Need]] = frozenset({"epochs", "prior"})

    @abstractmethod
    def update(self, readings: EpochReadings) -> tuple[Belief, Array]:
        """Takes in an epoch's readings; returns the belief and the squared innovations (trials,) of
        the prediction."""

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        self.require_suited(problem)
        with np.errstate(all="ignore"):
            return _Beliefs(self, problem, z).estimates(history=history)


class _Beliefs(Walk):
    """Holds the beliefs of a batch of trials; those that fail keep their belief from before the
    epoch."""

    def __init__(self, filter: InformationFilter, problem: Problem, z: Array) -> None:
        super().__init__(problem, z)
        self.filter = filter
        self.d = np.array(problem.prior_used())
        # U0' U0 = P0^-1, in deviations of the prior.
        information = np.linalg.inv(problem.scaled_prior)
        U0 = np.linalg.cholesky(information).T / filter.prior_inflation
        mean = np.zeros((len(z), len(U0)))
        self.belief = Belief(mean, repeated(U0, len(z)))

    def take_in(self, epoch: Epoch, at: Rows) -> None:
        z = self.z[at][:, epoch.rows]
        model = epoch.counted(self.tally)
        before = take(self.belief, at)
        readings = EpochReadings(epoch, model, self.problem.x0, self.d, z, at, before)
        after, nis = self.filter.update(readings)
        raised = self.tally.failed(at)
        singular = ~finite(after.root()) & after.usable & ~raised
        good = after.usable & np.isfinite(nis) & ~raised & ~singular
        self.belief = put(self.belief, at[good], take(after, good))
        self.nis[at[good]] += nis[good]
        lost = ~good & ~raised & ~singular
        overflowed = f"the model or the filter overflowed at epoch {epoch.number}"
        self.end(at[lost], Status.NONFINITE, overflowed)
        became_singular = f"the information became singular at epoch {epoch.number}"
        self.end(at[singular], Status.SINGULAR, became_singular)
        self.status[at[raised]] = Status.ERROR
        S = self.belief.root()
        self.x = self.belief.mean
        self.P = from_root(S)

    def covariance(self, at: Rows) -> Array:
        S = take(self.belief, at).root() * self.d[:, None]
        return from_root(S)


def regressed(readings: EpochReadings, x: Array, U: Array) -> tuple[Array, Array, Array]:
    """Regresses h - z over 2n cubature points of N(x, (U'U)^-1): it is about r + A (. - x) with an
    error of covariance Omega; returns r (trials, m), A (trials, m, n) and Omega (trials, m, m)."""
    n = x.shape[1]
    S = np.sqrt(n) * inverse(U)[0].swapaxes(1, 2)
    points = np.concatenate([x[:, None] + S, x[:, None] - S], axis=1)
    d = readings.misfits(points)
    r = d.mean(axis=1)
    spread = d - r[:, None]
    # A U^-1, since the points are U^-1 times sqrt(n) unit vectors.
    B = (d[:, :n] - d[:, n:]).swapaxes(1, 2) / (2.0 * np.sqrt(n))
    # Of the covariance of h - z what its slope does not explain.
    covariance = gram(spread) / (2 * n)
    return r, np.matmul(B, U), covariance - from_root(B)


@dataclass(frozen=True)
class Linearized:
    """Holds the state of an epoch; every field has the trials in front."""

    x: Array
    U: Array
    """A root of the information over which the readings are linearised."""
    r: Array
    A: Array
    W: Array
    """(R + Omega)^-1/2 (trials, m, m)."""
    cost: Array
    """|W r|^2 + |U0 (x - x0)|^2 (trials,)."""
    proposal: Belief
    """The posterior by the present linearisation."""
    innovations: Array
    share: Array
    """The share of the step to the proposal's mean that is tried next."""
    inner: Array
    """Regressions since the covariance was brought up to date."""
    change: Array
    """The change that this made, in deviations and in share of them; infinite before."""

    @classmethod
    def over(cls, readings: EpochReadings, x: Array, U: Array, change: Array) -> Linearized:
        """Returns the state at x once the readings are linearised over N(x, (U'U)^-1)."""
        r, A, Omega = regressed(readings, x, U)
        W = _whitener(Omega)
        proposal, innovations = readings.belief.given(np.matmul(W, A), multiply(W, r), x)
        return cls(
            x=x,
            U=U,
            r=r,
            A=A,
            W=W,
            cost=_cost(readings, W, r, x),
            proposal=proposal,
            innovations=innovations,
            share=np.ones(len(x)),
            inner=np.zeros(len(x)),
            change=change,
        )


@dataclass(frozen=True)
class IPLF(InformationFilter, Method[EpochReadings, Linearized]):
    """Linearises readings by regression over the posterior itself, repeatedly (García-Fernández,
    Svensson, Morelande, Särkkä, IEEE TSP 63(20), 2015), the mean damped as in Raitoharju, Svensson,
    García-Fernández and Piché (IEEE SPL 25(4), 2018; arXiv 1704.01113).

    At 2n cubature points of the posterior so far, h is about A x + b with an error of covariance
    Omega; that affine model, of noise R + Omega, updates the prior. The inner loop moves the mean
    at a fixed posterior covariance and Omega, by Gauss-Newton steps halved until the misfit
    decreases; the outer loop brings both up to date.

    Example:

    >>> import ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Ranging(), ib.noise.Gaussian(0.1), error_scale=30.0)
    >>> table = ib.run(bench, {"iplf": ib.baselines.IPLF()}, trials=20)
    >>> float(table.iloc[-1]["success"])
    1.0
    """

    max_iterations: Count = 30
    """Regressions per epoch; an epoch that has not settled by then goes on from where it is."""
    inner_iterations: Count = 3
    """Regressions between two covariances."""
    tolerance: Positive = 1e-2
    """Largest change, in deviations of the updated P and in share of them, at which an epoch is
    done."""

    def update(self, readings: EpochReadings) -> tuple[Belief, Array]:
        start = self.begin(readings, readings.belief.mean)
        ended = iterate(readings, self, start, Limits(self.tolerance, self.max_iterations))
        lost = (ended.status == Status.NONFINITE)[:, None]
        belief = ended.state.proposal
        return replace(belief, mean=np.where(lost, np.nan, belief.mean)), start.innovations

    def begin(self, system: EpochReadings, x: Array) -> Linearized:
        return Linearized.over(system, x, system.belief.U, np.full(len(x), np.inf))

    def step(self, system: EpochReadings, state: Linearized) -> Linearized:
        """Regresses at the point that the last step proposes, and again where the covariance is
        renewed."""
        x = state.x + state.share[:, None] * (state.proposal.mean - state.x)
        r, A, _ = regressed(system, x, state.U)
        cost = _cost(system, state.W, r, x)
        # A step counts if the misfit decreases; otherwise half of it is tried next.
        taken = cost < state.cost
        x = np.where(taken[:, None], x, state.x)
        r = np.where(taken[:, None], r, state.r)
        A = np.where(taken[:, None, None], A, state.A)
        proposal, _ = system.belief.given(np.matmul(state.W, A), multiply(state.W, r), x)
        state = replace(
            state,
            x=x,
            r=r,
            A=A,
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
            renewed = self._renewed(system.subset(settled), take(state, settled), to_go[settled])
            state = put(state, settled, renewed)
        return state

    def _renewed(self, system: EpochReadings, state: Linearized, to_go: Array) -> Linearized:
        """Brings the covariance up to date: linearises over the posterior that the mean has settled
        in."""
        U = state.proposal.U
        narrowed = np.abs(_deviations(U) / _deviations(state.U) - 1.0).max(axis=1)
        renewed = Linearized.over(system, state.x, U, np.fmax(to_go, narrowed))
        # The innovations stay those of the prediction.
        return replace(renewed, innovations=state.innovations)

    def check(
        self, system: EpochReadings, before: Linearized | None, state: Linearized
    ) -> ConvergenceCheck:
        """Ends a trial if bringing the covariance up to date has changed neither it nor the
        mean."""
        usable = np.isfinite(state.cost) & state.proposal.usable
        growth = np.where(usable, 1.0, np.nan)
        return ConvergenceCheck(state.change, growth, np.full(len(state.x), np.inf))


def _cost(readings: EpochReadings, W: Array, r: Array, x: Array) -> Array:
    """Computes |W r|^2 + |U0 (x - x0)|^2 (trials,)."""
    belief = readings.belief
    return squared(multiply(W, r)) + squared(multiply(belief.U, x - belief.mean))


def _deviations(U: Array) -> Array:
    """Returns the standard deviations (trials, n) where the information is U'U."""
    return np.linalg.norm(inverse(U)[0], axis=2)


def _whitener(Omega: Array) -> Array:
    """Computes (I + Omega)^-1/2 (trials, m, m); an eigenvalue of Omega that rounding left below
    zero counts as zero."""
    usable: Mask = finite(Omega)
    Omega = np.where(usable[:, None, None], Omega, 0.0)
    values, vectors = np.linalg.eigh((Omega + Omega.swapaxes(1, 2)) / 2)
    scale = 1.0 / np.sqrt(1.0 + np.maximum(values, 0.0))
    scale = np.where(usable[:, None], scale, np.nan)
    return scale[:, :, None] * vectors.swapaxes(1, 2)
