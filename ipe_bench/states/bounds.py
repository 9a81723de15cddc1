"""Bounds on the errors of filters and smoothers of a state model, from true paths drawn from it."""

from __future__ import annotations

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.states.algebra import symmetric, transposed
from ipe_bench.states.base import Normal, Paths, StateModel
from ipe_bench.states.linearisation import Taylor
from ipe_bench.states.smoothers import smoothed
from ipe_bench.states.trackers import Tracks, filtered


def posterior_bounds(model: StateModel, paths: Paths) -> tuple[Array, Array]:
    """The posterior Cramér-Rao bounds (K, n, n) on the error covariances of filters and of smoothers.

    Filtering: eq. (21) of Tichavský, Muravchik and Nehorai, IEEE TSP 46, 1998, its expectations over the drawn paths.
    Smoothing: the diagonal blocks of the inverse of the same information. They can lie far below what any estimator
    attains, where informations of single paths differ.

    Raises:
        UserError: the process noise of a step is singular, and a path has no density; or noise depends on the states.
    """
    P, before = model.prior.covariance, paths.start
    eye, forward, steps = np.eye(model.n), [], []
    for k in range(model.epochs):
        x = paths.x[:, k]
        H = model.observation_at(k).slope(x)[1]
        gained = _mean(np.matmul(np.matmul(transposed(H), np.linalg.inv(model.R(k))), H))
        if model.moves(k):
            Q = model.Q(k)
            if (rank := np.linalg.matrix_rank(Q)) < model.n:
                raise UserError(
                    f"{model.name}: the process noise into epoch {k + 1} has rank {rank} of {model.n}, so that the "
                    "posterior bound does not exist; use the bound linearised at the truth"
                )
            inverse = np.linalg.inv(Q)
            F = model.transition_into(k).slope(before)[1]
            D11, D12 = _mean(np.matmul(np.matmul(transposed(F), inverse), F)), -_mean(F).T @ inverse
            V = symmetric(P @ np.linalg.inv(eye + D11 @ P))  # (P^-1 + D11)^-1, of singular P too
            steps.append((V, D12))
            P = np.linalg.inv(symmetric(inverse + gained - D12.T @ V @ D12))
        else:
            P = symmetric(P @ np.linalg.inv(eye + gained @ P))
        forward.append(P)
        before = x
    backward = [forward[-1]]
    for V, D12 in reversed(steps[1:] if model.moved_first else steps):
        backward.append(symmetric(V + V @ D12 @ backward[-1] @ D12.T @ V))
    return np.array(forward), np.array(backward[::-1])


def _mean(a: Array) -> Array:
    return np.asarray(a.mean(axis=0))


def bound_at_truth(model: StateModel, paths: Paths, smooths: bool = False) -> Array:
    """The error covariances (trials, K, n, n) of an extended Kalman filter that is linearised at the true path (Taylor,
    IEEE TAC 24, 1979), or of the smoother behind it, which at the last epoch are the same. They exist for every Q, zero
    included; their mean is what a good filter attains, but no bound of errors averaged over paths. Noise that depends
    on the states has its Q and R there, and tells no more of them by its size."""
    path = Tracks.empty(model, len(paths.x))
    path.mean, path.covariance[:] = paths.x, model.prior.covariance
    path.start = Normal(paths.start, path.start.covariance)
    tracks = filtered(
        model, np.zeros((*paths.x.shape[:2], model.readings_per_epoch)), Taylor(), path=path
    )
    return (smoothed(model, tracks) if smooths else tracks).covariance
