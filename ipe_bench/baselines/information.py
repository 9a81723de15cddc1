"""Filters whose algebra is ours: all trials at once, in square-root information form, epoch by epoch.

The covariance is kept as a square root U of P^-1 = U'U, which a QR decomposition updates (Bierman, Factorization
Methods for Discrete Sequential Estimation, 1977, ch. V): no S to invert and no P - K S K' to cancel, however wide the
prior is beside the noise.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from ipe_bench.baselines.epochs import Epoch, Rows, Walk, read_members, require_needs
from ipe_bench.basics.batches import put, take
from ipe_bench.basics.linalg import Array, Mask, finite, inverse, multiply, squared
from ipe_bench.basics.options import Positive
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.base import Estimates, Estimator, Need
from ipe_bench.measurements.counted import CountingModel, EvaluationCount
from ipe_bench.measurements.problem import Problem


@dataclass(frozen=True)
class Belief:
    """N(mean, (U'U)^-1) for each trial, in prior deviations from the nominal point."""

    mean: Array
    """(trials, n)."""
    U: Array
    """(trials, n, n): any square root of the information."""

    @property
    def usable(self) -> Mask:
        """Where the numbers are finite (trials,)."""
        return finite(self.mean) & finite(self.U)

    def root(self) -> Array:
        """U^-1 (trials, n, n), so that P is it times its transpose; NaN where U is singular."""
        return inverse(self.U)[0]

    def given(self, J: Array, r: Array, at: Array) -> tuple[Belief, Array]:
        """What is believed after readings of unit variance, linear in x: h(at) - z is r (trials, m), dh/dx is J.

        Returns it with the squared innovations y' S^-1 y (trials,): chi-square with m degrees where the belief was
        right (Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 5.4).
        """
        # The step s = x - at that minimises |U (s + at - mean)|^2 + |J s + r|^2.
        rows = np.concatenate([self.U, J], axis=1)
        wanted = -np.concatenate([multiply(self.U, at - self.mean), r], axis=1)
        Q, U = np.linalg.qr(rows)
        fitted = multiply(Q.swapaxes(1, 2), wanted)
        step = multiply(inverse(U)[0], fitted)
        return Belief(at + step, U), squared(wanted) - squared(fitted)


@dataclass(frozen=True)
class EpochReadings:
    """The whitened readings z (trials, m) of an epoch, for the trials `rows`, and what was believed before them.

    x is in prior deviations from the nominal point.
    """

    epoch: Epoch
    problem: Problem
    deviation: Array
    """Of the scenario's prior (n,), in multiples of the parameters' units."""
    tally: EvaluationCount
    z: Array
    rows: Rows
    belief: Belief

    @property
    def model(self) -> CountingModel:
        return self.epoch.counted(self.tally)

    def misfit(self, x: Array) -> Array:
        """h(x) - z (trials, m), whitened."""
        return self.epoch.R.whiten(self.model.simulate(self.physical(x), self.rows)) - self.z

    def slope(self, x: Array) -> Array:
        """dh/dx (trials, m, n), whitened."""
        return self.epoch.R.whiten_jacobian(self.model.jacobian(self.physical(x), self.rows)) * self.deviation

    def misfits(self, points: Array) -> Array:
        """h - z (trials, points, m) at points (trials, points, n), whitened."""
        return read_members(self.model, self.epoch.R, self.physical(points), self.rows) - self.z[:, None]

    def subset(self, kept: Mask) -> EpochReadings:
        return replace(self, z=self.z[kept], rows=self.rows[kept], belief=take(self.belief, kept))

    def physical(self, x: Array) -> Array:
        """In multiples of the parameters' units."""
        return self.problem.x0 + x * self.deviation


@dataclass(frozen=True)
class InformationFilter(Estimator):
    """What the filters of this room have in common: the prior, the epochs, failures and the report.

    Reports its P, and as `extras["nis"]` the trial's squared innovations over their number: 1 on average where the
    filter is consistent.
    """

    prior_inflation: Positive = 1.0
    """The filter's prior deviations over the scenario's: in life a prior is never exact."""

    needs: ClassVar[frozenset[Need]] = frozenset({"epochs", "prior"})

    @abstractmethod
    def update(self, readings: EpochReadings) -> tuple[Belief, Array]:
        """What is believed after an epoch's readings, and the squared innovations (trials,) of the prediction."""

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        require_needs(self, problem)
        with np.errstate(all="ignore"):
            return _Beliefs(self, problem, z).estimates(history=history)


class _Beliefs(Walk):
    """What is believed of the trials of a batch; those that fail keep what they believed before the epoch."""

    def __init__(self, filter: InformationFilter, problem: Problem, z: Array) -> None:
        super().__init__(problem, z)
        self.filter, self.d = filter, np.array(problem.prior_used())
        # U0' U0 = P0^-1, in deviations of the prior.
        U0 = np.linalg.cholesky(np.linalg.inv(problem.scaled_prior)).T / filter.prior_inflation
        self.belief = Belief(np.zeros((len(z), len(U0))), np.repeat(U0[None], len(z), axis=0))

    def take_in(self, epoch: Epoch, at: Rows) -> None:
        z = epoch.whitened(self.z[at])
        readings = EpochReadings(epoch, self.problem, self.d, self.tally, z, at, take(self.belief, at))
        after, nis = self.filter.update(readings)
        raised, singular = self.tally.failed(at), ~finite(after.root()) & after.usable
        good = after.usable & np.isfinite(nis) & ~raised & ~singular
        self.belief = put(self.belief, at[good], take(after, good))
        self.nis[at[good]] += nis[good]
        lost = f"the model or the filter overflowed at epoch {epoch.number}"
        self.end(at[~good & ~raised & ~singular], Status.NONFINITE, lost)
        self.end(at[singular & ~raised], Status.SINGULAR, f"the information became singular at epoch {epoch.number}")
        self.status[at[raised]] = Status.ERROR

    def state(self, at: Rows) -> tuple[Array, Array]:
        belief = take(self.belief, at)
        S = belief.root()
        return belief.mean, np.matmul(S, S.swapaxes(1, 2))

    def covariance(self, at: Rows) -> Array:
        S = take(self.belief, at).root() * self.d[:, None]
        return np.matmul(S, S.swapaxes(1, 2))
