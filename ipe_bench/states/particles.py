"""Particle filters of state models: the density of a trial's states is a weighted sample of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ipe_bench.basics.linalg import Array, multiply
from ipe_bench.basics.options import Count
from ipe_bench.basics.streams import own_generators
from ipe_bench.states.algebra import factor, root, transposed
from ipe_bench.states.base import Normal, StateModel
from ipe_bench.states.trackers import Tracker, Tracks, Update, residuals, squares


@dataclass(frozen=True)
class Bootstrap(Tracker):
    """The bootstrap particle filter (Gordon, Salmond, Smith, IEE Proc. F 140, 1993), with systematic resampling at
    every epoch. Each trial's random numbers are those of its readings, in whatever batch.

    Example:

    >>> import ipe_bench as ib
    >>> model = ib.component("state_model/pendulum", count=20, spread={"angle": 0.3, "rate": 0.3})
    >>> table = ib.run(model, {"bootstrap": ib.states.Bootstrap(particles=500)}, trials=20)
    >>> float(table.iloc[-1]["success"])
    1.0
    """

    particles: Count = 1000
    """States that stand for the density of a trial."""
    seed: int = 0
    """A trial's random numbers depend on this and on its readings: on nothing else in the batch."""

    def hindrance(self, model: StateModel) -> str | None:
        return None

    def track(self, model: StateModel, z: Array) -> Tracks:
        trials, N = len(z), self.particles
        generators = own_generators(self.seed, z.reshape(trials, -1))

        def normals(columns: int) -> Array:
            return np.stack([g.standard_normal((N, columns)) for g in generators])

        out = Tracks.empty(model, trials)
        out.effective = np.empty((trials, model.epochs))
        spread = root(model.prior.covariance)
        x = model.prior.mean + np.matmul(normals(spread.shape[1]), spread.T)
        for k in range(model.epochs):
            if model.moves(k):
                G = model.gain_at(x, k)
                w = normals(G.shape[-1])
                x = model.transition_into(k)(x) + (
                    multiply(G, w) if model.gain_by_state else np.matmul(w, G.T)
                )
            w = weighed(model, x, k, z[:, k], 1.0, out)
            out.effective[:, k] = 1 / np.sum(w**2, axis=1)
            x = model.nearest_state(x, x[np.arange(trials), w.argmax(axis=1)][:, None])
            mean = np.sum(w[..., None] * x, axis=1)
            d = x - mean[:, None]
            out.mean[:, k], out.covariance[:, k] = mean, np.matmul(transposed(d * w[..., None]), d)
            x = _resampled(x, w, np.array([g.random() for g in generators]))
        out.log_likelihood -= model.epochs * np.log(N)
        out.calls += N * model.evaluations
        return out


def weighed(
    model: StateModel, x: Array, k: int, z: Array, before: Array | float, out: Tracks
) -> Array:
    """The weights `before` (trials, N) of states x (trials, N, n) times the likelihood of readings z (trials, m), with
    sum 1. The track notes the logarithm of their sum, and the innovation by the mean and covariance of h(x) before."""
    r, R, seen = residuals(model, z, x, k), model.R_at(x, k), np.isfinite(z)
    square, size = squares(r, z, R)
    p = np.broadcast_to(before, square.shape)
    p = (p / p.sum(axis=1, keepdims=True))[..., None]
    if model.R_by_state:
        R = np.sum(p[..., None] * R, axis=1)
    y = np.sum(p * r, axis=1)
    d = r - y[:, None]
    S = np.matmul(transposed(d * p), d) + np.where(
        seen[:, :, None] & seen[:, None, :], R, np.eye(R.shape[-1])
    )
    L = factor(S)
    found = Update.of(Normal(y, S), y, L, seen)
    out.nis[:, k], out.innovations[:, k], out.degrees[:, k] = (
        found.nis,
        found.innovation,
        found.degrees,
    )
    # Particles have no slope; that of 0 keeps the place of the innovation's L.
    out.reads.append((np.zeros((*y.shape, model.n)), L))
    least = square.min(axis=1, keepdims=True)
    w = before * np.exp(-0.5 * (square - least))
    total = w.sum(axis=1, keepdims=True)
    if not (total > 0).all():
        raise ArithmeticError(
            f"the readings of epoch {k + 1} have no density at some states: f, h or a standard deviation has no value"
            " there, or is 0 or infinite"
        )
    out.log_likelihood += np.log(total[:, 0]) - 0.5 * (least[:, 0] + size)
    return w / total


def _resampled(x: Array, w: Array, offset: Array) -> Array:
    """Particles x (trials, N, n) copied in proportion to their weights w (trials, N), systematically from an offset
    (trials,) in [0, 1)."""
    trials, N, n = x.shape
    upto = np.ceil(N * np.cumsum(w, axis=1) - offset[:, None]).clip(0, N)
    upto[:, -1] = N
    counts = np.diff(upto, axis=1, prepend=0.0).astype(int)
    return x.reshape(trials * N, n)[np.repeat(np.arange(trials * N), counts.ravel())].reshape(
        trials, N, n
    )
