"""The ensemble smoother with multiple data assimilation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Gt, Le

from ipe_bench.baselines.epochs import read_members
from ipe_bench.basics.linalg import Array, Mask, finite, solve
from ipe_bench.basics.options import Count, Positive, Whole
from ipe_bench.basics.statuses import Status
from ipe_bench.basics.streams import normals, own_generators
from ipe_bench.estimators.base import Equation, Estimates, Estimator, Need
from ipe_bench.estimators.driver import Limits, continued
from ipe_bench.estimators.least_squares import Objective
from ipe_bench.estimators.levenberg_marquardt import GaussNewtonMethod
from ipe_bench.estimators.minima import minimize
from ipe_bench.measurements.problem import Problem
from ipe_bench_zoo.iterated_filters import geometric_weights


@dataclass(frozen=True)
class EsMda(Estimator):
    """All readings at once, assimilated `steps` times by an ensemble with inflated noise (Emerick
    and Reynolds, Computers & Geosciences 55, 2013).

    Step k takes the noise for alpha_k R, with 1 / alpha_k adding up to 1 and growing geometrically
    from `first` up, perturbs the readings by it for each member, and moves the members by the gain
    of their own covariances. A member whose simulation overflows is drawn anew from the others. The
    members' mean and covariance are the estimate; then `polish` Gauss-Newton steps on the maximum a
    posteriori, whose covariance is reported instead.
    """

    members: Annotated[int, Gt(1)] = 100
    steps: Count = 16
    first: Annotated[float, Gt(0), Le(1)] = 1e-12
    """1 / alpha_1: about the square of the noise over what the prior lets the readings be."""
    polish: Whole = 5
    """Gauss-Newton steps at most; 0: none."""
    tolerance: Positive = 1e-6
    """Of the polish: largest Gauss-Newton step in deviations of the posterior."""
    prior_inflation: Positive = 1.0
    """Times the prior's standard deviations."""
    seed: Whole = 0
    """A trial's random stream depends on this and on its readings: on nothing else in the batch."""

    name = "es_mda"
    needs: ClassVar[frozenset[Need]] = frozenset({"prior"})
    family = "ensembles"

    @property
    def equation(self) -> Equation | None:  # type: ignore[override]
        """Without a polish the mean of an ensemble is the root of nothing."""
        return "map" if self.polish else None

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        self.require_suited(problem)
        objective = Objective.of(problem, z, self.prior_inflation)
        with np.errstate(all="ignore"):
            smoothed = self._smooth(objective)
            if not self.polish:
                return smoothed
            limits = Limits(self.tolerance, self.polish, history=True)
            minima = continued(
                smoothed, minimize(objective, GaussNewtonMethod(), smoothed.x, limits)
            )
            return minima.estimates(objective.model.tally, objective.readings)

    def _smooth(self, objective: Objective) -> Estimates:
        """The ensemble's mean and covariance after all steps, with the means on the way."""
        assert objective.prior is not None
        d = objective.prior.deviations
        z, n, tally = objective.R.whiten(objective.z), len(objective.x0), objective.model.tally
        generators = own_generators(self.seed, objective.z)
        # Members are distances from the start in deviations of the prior.
        s = objective.prior.coloured(normals(generators, self.members, n)) / d
        path = [s.mean(axis=1)]
        for weight in geometric_weights(np.array([1.0 / self.first]), self.steps)[0]:
            going = np.flatnonzero(finite(z) & finite(s) & ~tally.failed(objective.rows))
            if len(going):
                x, rows = objective.x0 + s[going] * d, objective.rows[going]
                h = read_members(objective.model, objective.R, x, rows, objective.z[going])
                noise = normals([generators[i] for i in going], *h.shape[1:]) / np.sqrt(weight)
                lost: Mask = ~np.asarray(np.isfinite(h).all(axis=2))
                s[going] = assimilated(s[going], h, z[going, None] + noise, 1.0 / weight)
                for k in np.flatnonzero(np.any(lost, axis=1) & ~np.all(lost, axis=1)):
                    i, j = going[k], lost[k]
                    s[i, j] = _redrawn(s[i, ~j], generators[i], int(j.sum()))
            path.append(s.mean(axis=1))
        s, history = s * d, objective.x0 + np.stack(path, axis=1) * d
        anomalies, x = s - s.mean(axis=1, keepdims=True), history[:, -1]
        status = np.where(finite(z) & finite(x), Status.CONVERGED, Status.NONFINITE)
        return Estimates(
            x=x,
            status=np.where(tally.failed(objective.rows), Status.ERROR, status).astype(np.int8),
            covariance=np.matmul(anomalies.swapaxes(1, 2), anomalies) / (self.members - 1),
            iterations=np.full(len(x), self.steps),
            simulations=tally.simulations,
            messages=dict(tally.messages),
            history=list(history),
        )


def assimilated(s: Array, h: Array, z: Array, inflation: float) -> Array:
    """Members s (trials, members, n) moved by the Kalman gain of their own covariances, for white
    readings h and z (trials, members, m), z perturbed, whose noise has the variance `inflation`.

    The system is as large as the readings or the ensemble, whichever is smaller, since with
    anomalies S and D S' D (D' D + c I)^-1 = S' (D D' + c I)^-1 D, c = (members - 1) alpha.
    """
    usable: Mask = np.asarray(np.isfinite(h).all(axis=2))
    count = np.maximum(usable.sum(axis=1), 2)[:, None, None]
    S, D = (_anomalies(a, usable) for a in (s, h))
    c = (count - 1) * inflation
    innovation = np.where(usable[:, :, None], z - h, 0.0)
    if s.shape[1] > h.shape[2]:
        weights, _ = solve(
            np.matmul(D.swapaxes(1, 2), D) + c * np.eye(h.shape[2]), innovation.swapaxes(1, 2)
        )
        return s + np.matmul(weights.swapaxes(1, 2), np.matmul(D.swapaxes(1, 2), S))
    G = np.matmul(D, D.swapaxes(1, 2)) + c * np.eye(s.shape[1])
    weights, _ = solve(G, np.matmul(D, innovation.swapaxes(1, 2)))
    return s + np.matmul(weights.swapaxes(1, 2), S)


def _anomalies(a: Array, usable: Mask) -> Array:
    """Distances (trials, members, k) of the usable members from their mean; zero for the others."""
    a = np.where(usable[:, :, None], a, 0.0)
    mean = a.sum(axis=1, keepdims=True) / np.maximum(usable.sum(axis=1), 1)[:, None, None]
    return np.where(usable[:, :, None], a - mean, 0.0)


def _redrawn(s: Array, generator: np.random.Generator, count: int) -> Array:
    """`count` members from the mean and covariance of the members s (members, n) of one trial."""
    mean = s.mean(axis=0)
    return mean + generator.standard_normal((count, len(s))) @ (s - mean) / np.sqrt(
        max(len(s) - 1, 1)
    )
