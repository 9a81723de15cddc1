"""Defines the Kalman filters: extended, unscented, cubature and ensemble, each trial's a filter of
filterpy's."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from threading import Lock
from typing import Annotated, Any

import numpy as np
from annotated_types import Gt, Le

from ipe_bench.baselines.sequential import LARGEST, ConstantFilter, Sequential
from ipe_bench.basics.linalg import Array, deviations
from ipe_bench.basics.options import Count, Finite, NonNegative, Positive, Whole
from ipe_bench.basics.streams import own_generators
from ipe_bench.states.algebra import symmetric
from ipe_bench.states.linearisation import Cubature, Rule, Taylor, Unscented


class FilterpyFilter(ConstantFilter):
    """Runs one of filterpy's sigma-point filters on one trial: `UnscentedKalmanFilter` as it is.

    Required: `filter`, filterpy's object, with `x` at 0 (n,), `P` at P0 and `Q` at Q. Optional:
    `predict`, `points` and `take_in`, for other objects of filterpy's. Promised: `take_in` hands
    out the readings at all `points`, in order.

    >>> import numpy as np, ipe_bench as ib
    >>> from filterpy.kalman import JulierSigmaPoints, UnscentedKalmanFilter
    >>> class Julier(ib.Sequential):
    ...     def track(self, P0, Q, z):
    ...         n = len(P0)
    ...         points = JulierSigmaPoints(n, kappa=0.0)
    ...         functions = {"hx": None, "fx": lambda x, dt: x}
    ...         f = UnscentedKalmanFilter(dim_x=n, dim_z=1, dt=1.0, points=points, **functions)
    ...         f.x, f.P, f.Q = np.zeros(n), P0, Q
    ...         return FilterpyFilter(f)
    >>> scenario = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01))
    >>> z = scenario.draw(0, 3).z
    >>> filters = Julier(), ib.baselines.CKF()
    >>> x = [one.estimate(scenario.problem, z).x for one in filters]
    >>> print(np.ptp(x, axis=0).max() < 1e-6)
    True
    """

    def __init__(self, filter: Any) -> None:
        self.filter = filter

    @property
    def x(self) -> Array:
        return self.filter.x

    @property
    def P(self) -> Array:
        return self.filter.P

    def predict(self) -> None:
        if self.filter.Q.any():
            self.filter.predict()
        else:
            # Constants without process noise: the moments of their sigma points are x and P
            # themselves.
            self.filter.compute_process_sigmas(dt=1.0)

    def points(self) -> Array:
        return self.filter.sigmas_f

    def take_in(self, z: Array, hx: Callable[[Any], Array]) -> Array:
        """Takes in the readings z (m,), whose covariance is I, and returns the innovation. Call
        `hx` once for each point, in order: each call returns the readings (m,) at the next one."""
        self.filter.update(z, R=np.eye(len(z)), hx=hx)
        return self.filter.y

    def update(self, z: Array, h: Array, H: Array | None) -> bool:
        z, h = _turned(z, h)
        rows = iter(h)
        y = self.take_in(z, lambda _: next(rows))
        self.filter.P = symmetric(self.filter.P)
        self.nis += _squared_innovation(y, self.filter.SI)
        return True


@dataclass(frozen=True)
class EKF(Sequential):
    """Linearises each epoch's readings at the estimate so far (Bar-Shalom et al., 10.3). filterpy
    updates P in Joseph's form, (I - K H) P (I - K H)' + K R K', which stays positive definite where
    the prior is much wider than R.

    Example:

    >>> import ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Ranging(), ib.noise.Gaussian(0.1), error_scale=0.1)
    >>> table = ib.run(bench, {"ekf": ib.baselines.EKF(engine="batched")}, trials=20)
    >>> float(table.iloc[-1]["success"])
    1.0
    """

    slopes = True

    def track(self, P0: Array, Q: Array, z: Array) -> ConstantFilter:
        return _EKFTrack(P0, Q, *self.relinearisations)

    def rule(self) -> Rule:
        return Taylor()


@dataclass(frozen=True)
class IteratedEKF(EKF):
    """Linearises each epoch's readings again at its updated estimate until that stays: Gauss-Newton
    on the epoch's readings and the prior that the earlier epochs left (Bell and Cathey, IEEE TAC
    38, 1993).

    Example:

    >>> import ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Ranging(), ib.noise.Gaussian(0.1), error_scale=30.0)
    >>> table = ib.run(bench, {"iterated_ekf": ib.baselines.IteratedEKF()}, trials=20)
    >>> float(table.iloc[-1]["success"])
    1.0
    """

    max_iterations: Count = 20
    """Linearisations per epoch; one that has not settled by then goes on from where it is."""
    tolerance: Positive = 1e-3
    """Largest change of a parameter, in deviations of the updated P, at which an epoch is done."""

    @property
    def relinearisations(self) -> tuple[int, float]:
        return self.max_iterations, self.tolerance


class _EKFTrack(FilterpyFilter):
    """Begins each iteration's update again from the epoch's prior, with the readings linearised at
    the last estimate."""

    def __init__(self, P0: Array, Q: Array, iterations: int, tolerance: float) -> None:
        from filterpy.kalman import ExtendedKalmanFilter

        n = len(P0)
        self.filter = ExtendedKalmanFilter(dim_x=n, dim_z=1)
        # The default x is a column, with which a vector of readings broadcasts to a matrix and no
        # error.
        self.filter.x = np.zeros(n)
        self.filter.P = P0
        self.filter.Q = Q
        self.iterations = iterations
        self.tolerance = tolerance
        self.iteration = 0

    def predict(self) -> None:
        self.filter.predict()
        self.iteration = 0

    def points(self) -> Array:
        return self.filter.x[None]

    def update(self, z: Array, h: Array, H: Array | None) -> bool:
        assert H is not None
        f = self.filter
        at = f.x
        f.x = f.x_prior
        f.P = f.P_prior
        # What the readings linearised at the last estimate say at the prior mean.
        h = h[0] + H @ (f.x - at)
        # White readings stay white along the principal axes of H P H' (see `_turned`).
        S = H @ f.P @ H.T
        _refuse_overflow(S)
        axes = np.linalg.eigh(S)[1][:, ::-1].T
        z = axes @ z
        h = axes @ h
        H = axes @ H
        f.update(z, HJacobian=lambda _: H, Hx=lambda _: h, R=np.eye(len(z)))
        self.iteration += 1
        if self.iteration == 1:
            # The innovation of the prediction; later ones have seen z.
            self.nis += _squared_innovation(f.y, f.SI)
        change = np.abs(f.x - at) / deviations(f.P)
        return self.iteration >= self.iterations or bool(change.max() <= self.tolerance)


@dataclass(frozen=True)
class UKF(Sequential):
    """Replaces slopes by readings at 2n + 1 sigma points (van der Merwe, dissertation, 2004).

    The points lie at alpha sqrt(n + kappa) deviations. An alpha of 1e-3, as often advised, gives
    the centre a weight of -1e6 and costs as many digits; 0.1 does not.

    Example:

    >>> import ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Ranging(), ib.noise.Gaussian(0.1), error_scale=0.1)
    >>> table = ib.run(bench, {"ukf": ib.baselines.UKF(alpha=1.0)}, trials=20)
    >>> float(table.iloc[-1]["success"])
    1.0
    """

    alpha: Annotated[float, Gt(0), Le(1)] = 0.1
    beta: Finite = 2.0
    """2 is best for Gaussian parameters."""
    kappa: NonNegative = 0.0

    def track(self, P0: Array, Q: Array, z: Array) -> ConstantFilter:
        from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

        n = len(P0)
        points = MerweScaledSigmaPoints(n, self.alpha, self.beta, self.kappa)
        # hx differs from epoch to epoch, so update is given it.
        filter = UnscentedKalmanFilter(
            dim_x=n, dim_z=1, dt=1.0, hx=None, fx=lambda x, dt: x, points=points
        )
        filter.x = np.zeros(n)
        filter.P = P0
        filter.Q = Q
        return FilterpyFilter(filter)

    def rule(self) -> Rule:
        return Unscented(self.kappa, self.alpha, self.beta)


@dataclass(frozen=True)
class CKF(Sequential):
    """Reads 2n cubature points, sqrt(n) deviations out, in place of slopes (Arasaratnam and Haykin,
    IEEE TAC 54, 2009).

    Example:

    >>> import ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Ranging(), ib.noise.Gaussian(0.1), error_scale=0.1)
    >>> table = ib.run(bench, {"ckf": ib.baselines.CKF()}, trials=20)
    >>> float(table.iloc[-1]["success"])
    1.0
    """

    def track(self, P0: Array, Q: Array, z: Array) -> ConstantFilter:
        return _CKFTrack(P0, Q)

    def rule(self) -> Rule:
        return Cubature()


class _CKFTrack(FilterpyFilter):
    """Avoids filterpy's moments mean(X X') - x x', which lose digits if x is much larger than its
    deviation. So the filter's state is the distance from a reference that moves to the estimate
    after each epoch, and its readings are distances from the points' mean: the same filter, with
    nothing to cancel."""

    def __init__(self, P0: Array, Q: Array) -> None:
        from filterpy.kalman import CubatureKalmanFilter

        n = len(P0)
        self.reference = np.zeros(n)
        self.filter: Any = CubatureKalmanFilter(
            dim_x=n, dim_z=1, dt=1.0, hx=None, fx=lambda x, dt: x
        )
        self.filter.x = np.zeros((n, 1))
        self.filter.P = P0
        self.filter.Q = Q

    @property
    def x(self) -> Array:
        return self.reference

    def predict(self) -> None:
        from filterpy.kalman import spherical_radial_sigmas

        if self.filter.Q.any():
            self.filter.predict()
        # filterpy leaves the points of before the process noise; the filter's authors draw them
        # anew.
        self.filter.sigmas_f = spherical_radial_sigmas(self.filter.x, self.filter.P)

    def points(self) -> Array:
        return self.reference + self.filter.sigmas_f

    def take_in(self, z: Array, hx: Callable[[Any], Array]) -> Array:
        f = self.filter
        f.hx = hx
        f.sigmas_h = np.empty((len(f.sigmas_f), len(z)))
        # A flat z would make x a matrix: filterpy's x is a column here.
        f.update(z[:, None], R=np.eye(len(z)))
        self.reference = self.reference + f.x[:, 0]
        f.x = np.zeros_like(f.x)
        return f.y


@dataclass(frozen=True)
class EnKF(Sequential):
    """Samples the state by an ensemble with perturbed readings (Evensen 1994; Crassidis and
    Junkins, 2nd ed., 4.5).

    Without process noise the ensemble keeps within the span of its first draw, and P carries a
    sampling error of about sqrt(2 / members): more members than parameters are needed, and many
    more for a P to be believed.

    Example:

    >>> import ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Ranging(), ib.noise.Gaussian(0.1), error_scale=10.0)
    >>> table = ib.run(bench, {"enkf": ib.baselines.EnKF(members=200)}, trials=20)
    >>> float(table.iloc[-1]["success"])
    1.0
    """

    members: Annotated[int, Gt(1)] = 100
    seed: Whole = 0
    """Seed of a trial's random stream, which depends on this and on the trial's readings alone."""

    family = "ensembles"

    def track(self, P0: Array, Q: Array, z: Array) -> ConstantFilter:
        (generator,) = own_generators(self.seed, z[None])
        return _EnKFTrack(P0, Q, self.members, generator.bit_generator)


class _EnKFTrack(FilterpyFilter):
    def __init__(self, P0: Array, Q: Array, members: int, stream: np.random.BitGenerator) -> None:
        from filterpy.kalman import EnsembleKalmanFilter

        self.stream = stream
        with _drawing_from(stream):
            x = np.zeros(len(P0))
            self.filter: Any = EnsembleKalmanFilter(
                x=x, P=P0, dim_z=1, dt=1.0, N=members, hx=None, fx=lambda x, dt: x
            )
        self.filter.Q = Q

    def predict(self) -> None:
        with _drawing_from(self.stream):
            self.filter.predict()

    def points(self) -> Array:
        return self.filter.sigmas

    def take_in(self, z: Array, hx: Callable[[Any], Array]) -> Array:
        # filterpy draws the perturbations about the second; epochs differ in length.
        self.filter.hx = hx
        self.filter._mean_z = np.zeros(len(z))
        with _drawing_from(self.stream):
            self.filter.update(z, R=np.eye(len(z)))
        return z  # the mean of the turned readings at the points is 0


_GLOBAL_STATE = Lock()


@contextmanager
def _drawing_from(stream: np.random.BitGenerator) -> Iterator[None]:
    """Lends NumPy's global generator, which filterpy draws from, another stream, and puts back what
    was there."""
    shared: Any = np.random  # NumPy's stubs do not know the two functions below
    with _GLOBAL_STATE:
        generator = shared.get_bit_generator()
        state = shared.get_state(legacy=False)
        shared.set_bit_generator(stream)
        try:
            yield
        finally:
            shared.set_bit_generator(generator)
            shared.set_state(state)


def _squared_innovation(y: Array, S_inverse: Array) -> float:
    """Computes y' S^-1 y, as a row or as a column as filterpy has it."""
    y = y.ravel()
    return float(y @ S_inverse @ y)


def _turned(z: Array, h: Array) -> tuple[Array, Array]:
    """Turns the readings z (m,) and h (points, m), less the points' mean, to the principal axes of
    the points' spread.

    White readings stay white when turned, and the filter is the same; but S is then close to
    diagonal, so its inverse and P - K S K' keep their digits where a wide prior makes S as
    ill-conditioned as 1e10.
    """
    centre = h.mean(axis=0)
    spread = h - centre
    _refuse_overflow(spread)
    axes = np.linalg.svd(spread, full_matrices=len(h) < len(z))[2]
    return axes @ (z - centre), spread @ axes.T


def _refuse_overflow(a: Array) -> None:
    """Refuses infinite matrices, on which LAPACK may hang, and numbers whose squares overflow."""
    if not np.abs(a).max() < LARGEST:
        raise OverflowError("what the filter is to take in is beyond the range of numbers")
