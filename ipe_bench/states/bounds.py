"""Bounds on the errors of filters and smoothers of a state model, from true paths drawn from it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.states.algebra import symmetric, transposed
from ipe_bench.states.base import Paths, StateModel
from ipe_bench.states.linearisation import Taylor
from ipe_bench.states.smoothers import smoothed
from ipe_bench.states.trackers import Tracks, filtered


def posterior_bounds(model: StateModel, paths: Paths) -> tuple[Array, Array]:
    """Computes the posterior Cramér-Rao bounds (K, n, n) on the error covariances of filters and of
    smoothers.

    Filtering: eq. (21) of Tichavský, Muravchik and Nehorai, IEEE TSP 46, 1998, its expectations
    over the drawn paths. Smoothing: the diagonal blocks of the inverse of the same information.
    They can lie far below what any estimator attains, where informations of single paths differ.

    Raises:
        UserError: the process noise of a step is singular, and a path has no density; or noise
        depends on the states.
    """
    P = model.prior.covariance
    before = paths.start
    eye = np.eye(model.n)
    forward: list[Array] = []
    steps: list[_Step] = []
    for k in range(model.epochs):
        x = paths.x[:, k]
        # What the readings of an epoch add: E H' R^-1 H.
        H, R = _seen(model.observation_at(k).slope(x)[1], model.R(k), paths.z[:, k])
        gained = _mean_information(H, np.linalg.inv(R))
        if model.moves(k):
            Q_inverse = np.linalg.inv(_regular(model, k))
            F = model.transition_into(k).slope(before)[1]
            # D11 = E F' Q^-1 F,  D12 = -E F' Q^-1,  D22 = Q^-1 + E H' R^-1 H
            D11 = _mean_information(F, Q_inverse)
            D12 = -_mean(F).T @ Q_inverse
            D22 = Q_inverse + gained
            # (J + D11)^-1 = P (I + D11 P)^-1 of J^-1 = P, which may be singular.
            V = symmetric(P @ np.linalg.inv(eye + D11 @ P))
            steps.append(_Step(V, D12))
            # J <- D22 - D21 (J + D11)^-1 D12
            P = np.linalg.inv(symmetric(D22 - D12.T @ V @ D12))
        else:
            P = symmetric(P @ np.linalg.inv(eye + gained @ P))
        forward.append(P)
        before = x
    # Back to the first epoch: P_s <- V + V D12 P_s D21 V.
    if model.moved_first:
        steps = steps[1:]
    backward = [P]
    for V, D12 in reversed(steps):
        backward.append(symmetric(V + V @ D12 @ backward[-1] @ D12.T @ V))
    return np.array(forward), np.array(backward[::-1])


class _Step(NamedTuple):
    """Holds what a step of the filtering bound leaves for smoothing."""

    V: Array
    """(J + D11)^-1 (n, n)."""
    D12: Array
    """(n, n)"""


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


def _mean_information(J: Array, inverse: Array) -> Array:
    """Computes E J' C^-1 J (n, n) over the paths, for slopes J (trials, m, n) and one C^-1 or one
    for each path."""
    return _mean(np.matmul(np.matmul(transposed(J), inverse), J))


def bound_at_truth(model: StateModel, paths: Paths, smooths: bool = False) -> Array:
    """Computes the error covariances (trials, K, n, n) of an extended Kalman filter that is
    linearised at the true path (Taylor, IEEE TAC 24, 1979), or of the smoother behind it, which at
    the last epoch are the same. They exist for every Q, zero included; their mean is what a good
    filter attains, but no bound of errors averaged over paths. Noise that depends on the states has
    its Q and R there, and tells no more of them by its size."""
    path = Tracks.empty(model, len(paths.x))
    path.start = path.start._replace(mean=paths.start)
    path.mean = paths.x
    # Points about the truth would need a covariance there; tangents need none.
    path.covariance[:] = model.prior.covariance
    # No covariance depends on the values of the readings, but for those that a path has not.
    z = np.zeros((*paths.x.shape[:2], model.readings_per_epoch))
    if paths.z.size:
        z[~np.isfinite(paths.z)] = np.nan
    tracks = filtered(model, z, Taylor(), path=path, smooths=smooths)
    return (smoothed(model, tracks) if smooths else tracks).covariance
