"""Particle filters of state models: the density of a trial's states is a weighted sample of
them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ipe_bench.basics.linalg import Array, multiply
from ipe_bench.basics.options import Count, Quantile
from ipe_bench.basics.streams import own_generators
from ipe_bench.states.algebra import factor, root, transposed
from ipe_bench.states.base import StateModel
from ipe_bench.states.student import as_normal, evidence, mixture, tail
from ipe_bench.states.trackers import Tracker, Tracks, residuals, squares


@dataclass(frozen=True)
class Bootstrap(Tracker):
    """The bootstrap particle filter (Gordon, Salmond, Smith, IEE Proc. F 140, 1993), with
    systematic resampling at every epoch. Each trial's random numbers are those of its readings, in
    whatever batch.

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
    gate: Quantile | None = None
    """A reading counts as missing if a farther one has less than 1 less this probability, such as
    0.999, by the particles that are predicted."""

    def hindrance(self, model: StateModel) -> str | None:
        return None

    def track(self, model: StateModel, z: Array) -> Tracks:
        trials = len(z)
        N = self.particles
        generators = own_generators(self.seed, z.reshape(trials, -1))

        def normals(columns: int) -> Array:
            return np.stack([g.standard_normal((N, columns)) for g in generators])

        out = Tracks.empty(model, trials)
        out.effective = np.empty((trials, model.epochs))
        spread = root(model.prior.covariance)
        x = model.prior.mean + np.matmul(normals(spread.shape[1]), spread.T)
        for k in range(model.epochs):
            # Importance density p(x_k | x_k-1): each particle moves by the model.
            if model.moves(k):
                G = model.gain_at(x, k)
                w = normals(G.shape[-1])
                noise = multiply(G, w) if model.gain_by_state else np.matmul(w, G.T)
                x = model.transition_into(k)(x) + noise
            # By it the weights are the likelihoods, w_i ~ p(z_k | x_i).
            weights = weighed(model, x, k, z[:, k], 1.0, out, self.gate)
            out.effective[:, k] = 1 / np.sum(weights**2, axis=1)
            # Means and covariances of a periodic state are taken about the heaviest particle.
            heaviest = x[np.arange(trials), weights.argmax(axis=1)]
            x = model.nearest_state(x, heaviest[:, None])
            mean = np.sum(weights[..., None] * x, axis=1)
            d = x - mean[:, None]
            out.mean[:, k] = mean
            out.covariance[:, k] = np.matmul(transposed(d * weights[..., None]), d)
            offset = np.array([g.random() for g in generators])
            x = _resampled(x, weights, offset)
        # p(z_k | z_1..k-1) is the mean of the likelihoods, and `weighed` notes their sum.
        out.log_likelihood -= model.epochs * np.log(N)
        out.calls += N * model.evaluations
        return out


def weighed(
    model: StateModel,
    x: Array,
    k: int,
    z: Array,
    before: Array | float,
    out: Tracks,
    gate: float | None = None,
) -> Array:
    """Multiplies the weights `before` (trials, N) of states x (trials, N, n) by the likelihood of
    readings z (trials, m), and divides them by their sum. The track notes the logarithm of their
    sum, and the innovation by the mean and covariance of h(x) before; readings beyond the quantile
    `gate` are missing."""
    r = residuals(model, z, x, k)
    R = model.R_at(x, k)
    if gate is not None:
        beyond = np.isfinite(z) & (_tails(r, R, before) < 1 - gate)
        if out.gated is None:
            out.gated = np.zeros(out.innovations.shape, dtype=bool)
        out.gated[:, k] = beyond
        z = np.where(beyond, np.nan, z)
        r = np.where(beyond[:, None], 0.0, r)
    y, L = _innovation(model, z, r, R, before)
    out.note_innovation(k, y, L, z)
    if model.degrees_of_freedom:
        density, e = _by_tails(model, z, r, R, before)
        square, size = -2 * density, np.zeros(len(z))
        out.nis[:, k] = np.nansum(e**2, axis=1)
        out.innovations[:, k] = e
    else:
        square, size = squares(r, z, R)
    # A likelihood of exp(-800) is 0 in floating point: all are divided by the largest.
    least = square.min(axis=1, keepdims=True)
    w = before * np.exp(-0.5 * (square - least))
    total = w.sum(axis=1, keepdims=True)
    if not (total > 0).all():
        raise ArithmeticError(
            f"the readings of epoch {k + 1} have no density at some states: f, h or a standard "
            "deviation has no value there, or is 0 or infinite"
        )
    out.log_likelihood += np.log(total[:, 0]) - 0.5 * (least[:, 0] + size)
    return w / total


def _tails(r: Array, R: Array, before: Array | float) -> Array:
    """Computes how probable readings (trials, m) farther out than these are, by the weights before,
    for residuals r (trials, N, m)."""
    from scipy.special import ndtr

    below = ndtr(r / np.sqrt(_variances(R)))
    p = _shares(before, r)
    low = np.sum(p * below, axis=1)
    return 2 * np.minimum(low, np.sum(p * (1 - below), axis=1))


def _by_tails(
    model: StateModel, z: Array, r: Array, R: Array, before: Array | float
) -> tuple[Array, Array]:
    """Computes the logarithms (trials, N) of the density of readings z (trials, m), by residuals r
    (trials, N, m), and normal numbers (trials, m) that are as probable as each given those in front
    of it, by the weights before; NaN of missing ones."""
    density = np.zeros(r.shape[:2])
    e = np.full(z.shape, np.nan)
    for j, degrees in enumerate(model.degrees_of_freedom):
        one = mixture(degrees)
        own = np.broadcast_to(_variances(R), r.shape)[..., j]
        given = one.least * own, own, one
        p = before * np.exp(density - density.max(axis=1, keepdims=True))
        p = p / p.sum(axis=1, keepdims=True)
        below, above = (np.sum(p * tail(y, *given), axis=1) for y in (r[..., j], -r[..., j]))
        seen = np.isfinite(z[:, j])
        score = as_normal(np.minimum(below, above), below - above)
        e[:, j] = np.where(seen, score, np.nan)
        density += np.where(seen[:, None], evidence(r[..., j], *given).density, 0.0)
    return density, e


def _variances(R: Array) -> Array:
    return np.diagonal(R, axis1=-2, axis2=-1)


def _shares(before: Array | float, r: Array) -> Array:
    """Returns weights (trials, N, 1) of sum 1 for residuals r (trials, N, m)."""
    p = np.broadcast_to(before, r.shape[:2])
    return (p / p.sum(axis=1, keepdims=True))[..., None]


def _innovation(
    model: StateModel, z: Array, r: Array, R: Array, before: Array | float
) -> tuple[Array, Array]:
    """Computes the innovation y = mean of r and a root of S = covariance of r + R, by the weights
    before the readings z (trials, m), for residuals r (trials, N, m)."""
    seen = np.isfinite(z)
    both = seen[:, :, None] & seen[:, None, :]
    p = _shares(before, r)
    if model.R_by_state:
        R = np.sum(p[..., None] * R, axis=1)
    if model.periods:
        # The mean of what comes round must not lie next to the reading by itself.
        likeliest = p.argmax(axis=1, keepdims=True)
        r = model.nearest(r, np.take_along_axis(r, likeliest, axis=1))
    mean = np.sum(p * r, axis=1)
    y = model.nearest(mean, np.zeros(mean.shape))
    d = r - mean[:, None]
    # A missing reading has unit variance.
    S = np.matmul(transposed(d * p), d) + np.where(both, R, np.eye(R.shape[-1]))
    return y, factor(S)


def _resampled(x: Array, w: Array, offset: Array) -> Array:
    """Particles x (trials, N, n) copied in proportion to their weights w (trials, N),
    systematically from an offset (trials,) in [0, 1)."""
    trials, N, n = x.shape
    # Of the N points (i + offset) / N, i = 0 ... N-1, as many fall to a particle as lie in its
    # part of the cumulated weights.
    upto = np.ceil(N * np.cumsum(w, axis=1) - offset[:, None]).clip(0, N)
    # Round-off may leave the sum of the weights below 1.
    upto[:, -1] = N
    counts = np.diff(upto, axis=1, prepend=0.0).astype(int)
    rows = np.repeat(np.arange(trials * N), counts.ravel())
    return x.reshape(trials * N, n)[rows].reshape(trials, N, n)
