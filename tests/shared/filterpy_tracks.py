"""An oracle: filterpy's extended and unscented filters as a tracker, a filter for each trial."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter

from ipe_bench.states import Filter, Normal, Taylor, Tracks, Unscented
from ipe_bench.states.algebra import factor
from ipe_bench.states.linearisation import slope


@dataclass(frozen=True)
class Filterpy(Filter):
    """The filter of Taylor's rule or of the unscented one, with one iteration, by filterpy."""

    def track(self, model, z):
        rule, out = self.rule, Tracks.empty(model, len(z))
        x, filters = out.start, [_of_filterpy(rule, model.n, z.shape[2]) for _ in z]
        for f, mean, covariance in zip(filters, *x, strict=True):
            f.x, f.P = mean, covariance
        for k in range(model.epochs):
            if model.moves(k):
                A, Q = rule.linearise(lambda at, k=k: model.transition(at, k), *x).A, model.Q(k)
                for f, F, moved in zip(filters, A, model.transition(x.mean, k), strict=True):
                    f.Q, f.F = Q, F
                    if isinstance(rule, Taylor):
                        f.predict()
                        f.x = moved
                    else:
                        f.predict(fx=lambda at, _, k=k: model.transition(at, k))
                x = Normal(np.array([f.x for f in filters]), np.array([f.P for f in filters]))
            (h, H), R = slope(lambda at, k=k: model.observe(at, k), x.mean), model.R(k)
            for f, *read in zip(filters, z[:, k], h, H, strict=True):
                _take_in(f, model, k, R, *read)
            mean, P, y, S = (
                np.array([getattr(f, name) for f in filters]) for name in ("x", "P", "y", "S")
            )
            x = Normal(mean, P)
            out.mean[:, k], out.covariance[:, k] = x
            L, seen = factor(S), np.isfinite(z[:, k])
            out.note_innovation(k, y, L, z[:, k])
            size = np.log(2 * np.pi) + 2 * np.log(np.diagonal(L, axis1=1, axis2=2))
            out.log_likelihood -= 0.5 * (out.nis[:, k] + np.sum(size * seen, axis=1))
        return out


def _of_filterpy(rule, n: int, m: int) -> Any:
    if not isinstance(rule, Unscented):
        return ExtendedKalmanFilter(n, m)
    points = MerweScaledSigmaPoints(n, rule.alpha, rule.beta, rule.kappa_of(n))
    return UnscentedKalmanFilter(n, m, dt=1.0, hx=None, fx=None, points=points)


def _take_in(f: Any, model, k: int, R, z, h, H) -> None:
    """Updates a filter by readings z (m,) near h (m,); a missing one reads 0, with no slope and
    unit variance."""
    seen = np.isfinite(z)
    z, R = (
        np.where(seen, model.nearest(z, h), 0.0),
        np.where(seen[:, None] & seen, R, np.eye(len(z))),
    )
    if hasattr(f, "points_fn"):
        f.sigmas_f = f.points_fn.sigma_points(f.x, f.P)
        f.update(z, R, hx=lambda x: np.where(seen, model.nearest(model.observe(x, k), h), 0.0))
    else:
        f.update(z, lambda _: np.where(seen[:, None], H, 0.0), lambda _: np.where(seen, h, 0.0), R)
