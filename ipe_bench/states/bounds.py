"""Bounds on the errors of filters and smoothers of a state model, from true paths drawn from it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.states.affine_paths import Noise, Tangents
from ipe_bench.states.algebra import factor, half, lower_solve, triangular
from ipe_bench.states.base import Paths, StateModel, told_alike
from ipe_bench.states.linearisation import Taylor
from ipe_bench.states.trackers import Tracks, filtered, smoothed


def posterior_bounds(model: StateModel, paths: Paths) -> tuple[Array, Array]:
    """Computes the posterior Cramér-Rao bounds (K, n, n) on the error covariances of filters and of
    smoothers.

    Filtering: eq. (21) of Tichavský, Muravchik and Nehorai, IEEE TSP 46, 1998, its expectations
    over the drawn paths. Smoothing: the diagonal blocks of the inverse of the same information.
    Both are those of a linear model of the mean slopes, by roots: no covariance is inverted. They
    can lie far below what any estimator attains, where informations of single paths differ.
    Readings of Student's t count by their information.

    Raises:
        UserError: the process noise of a step is singular, and a path has no density; or noise
        depends on the states.
    """
    model = told_alike(model)
    root = triangular(model.prior.covariance[None])[0]
    n = model.n
    begun = root
    still = np.zeros((n, n))
    before = paths.start
    forward: list[Array] = []
    steps: list[_Step] = []
    for k in range(model.epochs):
        at = paths.x[:, k]
        R = model.R(k)
        F_mean = np.eye(n)
        G = still
        if model.moves(k):
            Q = _regular(model, k)
            F = model.transition_into(k).slope(before)[1]
            F_mean = _mean(F)
            G = half(Q).G
            # D11 = E F' Q^-1 F is that of the mean F, and what F adds that differs from it: it is
            # as if the states before were read.
            told = _mean_rows(F - F_mean, Q)
            root = _informed(root, told)
            if steps:
                steps[-1] = steps[-1]._replace(told=np.concatenate([steps[-1].told, told]))
            else:
                begun = root
            # By Woodbury, D22 - D21 (J + D11)^-1 D12 is the inverse of F P F' + Q.
            root = _lower(np.concatenate([F_mean @ root, G], axis=1))
        H, R = _seen(model.observation_at(k).slope(at)[1], R, paths.z[:, k])
        gained = _mean_rows(H, R)
        root = _informed(root, gained)
        steps.append(_Step(F_mean, G, gained))
        forward.append(root @ root.T)
        before = at
    return np.array(forward), _smoothed(begun, steps)


class _Step(NamedTuple):
    """Holds an epoch of the linear model whose information is that of the paths."""

    F: Array
    """Mean slopes (n, n) of the transition into it."""
    G: Array
    """A root (n, n) of Q."""
    told: Array
    """Rows (r, n) of its information."""


def _smoothed(start: Array, steps: list[_Step]) -> Array:
    """Computes the covariances (K, n, n) of the smoother of such a model, from a root of the states
    before the first transition."""
    A = np.stack([step.F for step in steps])
    B = np.zeros((len(steps), 2 * len(start), len(start)))
    for rows, step in zip(B, steps, strict=True):
        rows[: len(step.told)] = step.told
    noise = Noise(start, np.stack([step.G for step in steps]))
    return noise.spread(Tangents(A[None], B[None])).covariance[0, 1:]


def _informed(root: Array, rows: Array) -> Array:
    """Returns a root (n, n) of the covariance of states whose information has these rows (r, n)
    beside, by orthogonal rows of (I, rows F; 0, F)."""
    r, n = rows.shape
    before = np.zeros((r + n, r + n))
    before[:r, :r] = np.eye(r)
    before[:r, r:] = rows @ root
    before[r:, r:] = root
    return _lower(before)[r:, r:]


def _lower(W: Array) -> Array:
    """Computes a lower triangular F (n, n) with F F' = W W', by reflections of Householder."""
    n, columns = W.shape
    # Sizes of columns may differ by all digits; without the largest ones in front, reflections
    # would lose those of the smaller ones (Powell and Reid, IFIP Congress 68, 1969).
    order = np.argsort(-np.sum(W**2, axis=0), kind="stable")
    V = np.zeros((max(n, columns), n))
    V[:columns] = W[:, order].T
    return np.asarray(np.linalg.qr(V, mode="r")).T


def _regular(model: StateModel, k: int) -> Array:
    """Returns Q (n, n) of the step into epoch k, if it has an inverse."""
    Q = model.Q(k)
    rank = np.linalg.matrix_rank(Q)
    if rank < model.n:
        raise UserError(
            f"{model.name}: the process noise into epoch {k + 1} has rank {rank} of {model.n}, so "
            "that the posterior bound does not exist; use the bound linearised at the truth"
        )
    return Q


def _seen(H: Array, R: Array, z: Array) -> tuple[Array, Array]:
    """Returns the slopes (trials, m, n) and the noise (trials, m, m) of the readings z (trials, m)
    that a path has; those that it has not have no slope and unit variance."""
    seen = np.isfinite(z)
    both = seen[:, :, None] & seen[:, None, :]
    return np.where(seen[..., None], H, 0.0), np.where(both, R, np.eye(len(R)))


def _mean(a: Array) -> Array:
    return np.asarray(a.mean(axis=0))


def _mean_rows(J: Array, C: Array) -> Array:
    """Computes rows (n, n) of E J' C^-1 J over the paths, for slopes J (trials, m, n) and
    one C or one for each path."""
    whitened = lower_solve(factor(C), J)
    rows = whitened.reshape(-1, J.shape[-1]) / np.sqrt(len(J))
    return _lower(rows.T).T


def bound_at_truth(model: StateModel, paths: Paths, smooths: bool = False) -> Array:
    """Computes the error covariances (trials, K, n, n) of an extended Kalman filter that is
    linearised at the true path (Taylor, IEEE TAC 24, 1979), or of the smoother behind it, which at
    the last epoch are the same. They exist for every Q, zero included; their mean is what a good
    filter attains, but no bound of errors averaged over paths. Noise that depends on the states has
    its Q and R there, and tells no more of them by its size; noise of Student's t is as normal
    noise that tells as much."""
    model = told_alike(model)
    path = Tracks.empty(model, len(paths.x))
    path.start = path.start._replace(mean=paths.start)
    path.mean = paths.x
    # Points about the truth would need a covariance there; tangents need none.
    path.covariance[:] = model.prior.covariance
    # No covariance depends on the values of the readings, but for those that a path has not.
    z = np.zeros((*paths.x.shape[:2], model.readings_per_epoch))
    if paths.z.size:
        z[~np.isfinite(paths.z)] = np.nan
    if smooths:
        return smoothed(model, z, Taylor(), path=path)[0].covariance
    return filtered(model, z, Taylor(), path=path).covariance
