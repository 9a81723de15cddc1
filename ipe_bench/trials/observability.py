"""Analyses what readings say about each parameter before any are taken: singular values, the least
observable direction, bounds and correlations, and which errors that the model leaves out look like
its parameters.

All of it follows from Jacobians, at the point that is asked about and at truths drawn from the
prior. `design` chooses which readings to take.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array, Covariance, correlations, deviations, gram, multiply
from ipe_bench.basics.streams import generator
from ipe_bench.measurements.base import Measurement, Parameter
from ipe_bench.trials.thresholds import FIT_LEVEL

TRUTHS = 30
"""Truths from the prior over which bounds and designs are averaged."""
_STEP = 0.1
"""Step of central differences, as a share of a nuisance's deviation: far above round-off, far below
where it bends."""
_SINGLE = 4
"""Largest group of nuisances that are reported one by one."""
_DRAWS = 200
_WORTH_SAYING = 0.1
"""Coefficients of a direction below this share of the largest are left out of its words."""


def readable(model: Measurement, x: Array) -> Array:
    """Returns those truths (some, n) of x (truths, n) at which all readings have finite slopes.

    Raises:
        UserError: there are none.
    """
    with np.errstate(all="ignore"):
        slopes = model.jacobian(x)
    there = np.isfinite(slopes).all(axis=(1, 2))
    if not there.any():
        raise UserError(
            f"error_scale: at none of {len(x)} true parameters from the prior {model.name} has"
            " finite readings with finite slopes; give a smaller error_scale"
        )
    return x[there]


@dataclass(frozen=True)
class Observability:
    """Describes what a model's readings say about its parameters at a point, which is the first
    truth, and at the truths behind it; lengths in multiples of the parameters' sizes."""

    parameters: tuple[Parameter, ...]
    singular_values: Array
    """Singular values of the whitened Jacobian R^-1/2 J (truths, n), descending."""
    right: Array
    """Its right singular vectors (truths, n, n), a row each."""

    @classmethod
    def at(cls, model: Measurement, R: Covariance, x: Array) -> Observability:
        """Computes the observability at the truths x (truths, n)."""
        white = R.whiten_jacobian(model.jacobian(x))
        # Fewer readings than parameters leave directions open, which rows of 0 have, too.
        missing = max(model.n - model.m, 0)
        white = np.pad(white, [(0, 0), (0, missing), (0, 0)])
        _, s, right = np.linalg.svd(white, full_matrices=False)
        return cls(model.parameters, s, right)

    @cached_property
    def observable(self) -> bool:
        """Whether the readings determine every parameter at every truth, to working precision."""
        return not self._lost.any()

    @property
    def _lost(self) -> NDArray[np.bool_]:
        """Directions (truths, n) that the readings do not determine."""
        s = self.singular_values
        return ~(s > np.finfo(float).eps * 1e3 * s[:, :1])

    @cached_property
    def covariance(self) -> Array:
        """The Cramér-Rao bound (truths, n, n); where the readings leave a direction open it is very
        large there."""
        least = np.finfo(float).eps * self.singular_values[:, :1]
        s = np.maximum(self.singular_values, least)
        scaled = self.right / s[:, :, None]
        return gram(scaled)

    @cached_property
    def bounds(self) -> Array:
        """The bound of each parameter at each truth (truths, n); infinite where readings leave it
        open."""
        takes_part = np.abs(self.right) > 1e-6
        partly_lost = (takes_part & self._lost[:, :, None]).any(axis=1)
        return np.where(partly_lost, np.inf, deviations(self.covariance))

    @property
    def bound(self) -> Array:
        """The bound of each parameter at the point (n,)."""
        return self.bounds[0]

    @property
    def quartiles(self) -> Array:
        """Lower quartile, median and upper quartile (3, n) of the bounds at the truths behind the
        point; (0, n) where there are none."""
        behind = self.bounds[1:]
        if not len(behind):
            return behind
        # Means of bounds have no limit where a bound grows towards a truth that no readings show;
        # nor is one interpolated to infinity.
        return np.quantile(behind, (0.25, 0.5, 0.75), axis=0, method="inverted_cdf")

    @cached_property
    def correlation(self) -> Array:
        """Correlation of the errors of efficient estimates (n, n) at the point."""
        return correlations(self.covariance[0])

    @cached_property
    def multiple_correlation(self) -> Array:
        """Correlation of each parameter's error with those of all others (n,) at the point.

        It is sqrt(1 - 1 / (P_ii (P^-1)_ii)). The bound is 1 / sqrt(1 - square) of what it were if
        all others were known.
        """
        rows = self.right[0] * self.singular_values[0, :, None]
        information = np.sum(rows**2, axis=0)
        inflation = np.diagonal(self.covariance[0]) * information
        # Round-off may leave an inflation below 1.
        square = 1 - 1 / np.maximum(inflation, 1.0)
        return np.sqrt(np.maximum(square, 0.0))

    @cached_property
    def least_observable(self) -> Array:
        """The unit vector (n,) along which an efficient estimate scatters most at the point, or at
        the first truth where the readings leave a direction open."""
        open_at = self._lost.any(axis=1)
        axis = self.right[np.argmax(open_at), -1]
        largest = axis[np.argmax(np.abs(axis))]
        return axis * np.sign(largest)

    @property
    def words(self) -> str:
        """Text of `least_observable`, such as 'ky - 0.85 kx'."""
        return in_words([p.name for p in self.parameters], self.least_observable)


def in_words(names: Sequence[str], direction: Array) -> str:
    """Writes a direction (n,) as a sum over its largest coefficient, without what is below a tenth
    of it."""
    # What is equal but for round-off stays in the order of the names.
    size = np.abs(direction)
    order = np.argsort(-np.round(size / size.max(), 6), kind="stable")
    coefficients = direction / direction[order[0]]
    text = str(names[order[0]])
    for i in order[1:]:
        if abs(coefficients[i]) < _WORTH_SAYING:
            break
        sign = "+" if coefficients[i] > 0 else "-"
        factor = f"{abs(coefficients[i]):.2f} "
        if factor == "1.00 ":
            factor = ""
        text += f" {sign} {factor}{names[i]}"
    return text


@dataclass(frozen=True)
class Suspect:
    """Describes an error that the model leaves out, of its usual size, and its first-order effect
    on least squares."""

    name: str
    unit: str
    deviation: float
    """Its standard deviation, in `unit`."""
    shift: Array
    """Shift of each parameter's estimate (n,): root mean square, in multiples of the parameters'
    sizes; with its sign if the error is a single number."""
    bounds: float
    """The largest shift of a parameter, in standard deviations of its bound."""
    parameter: str
    """The parameter that it moves most."""
    noticed: float
    """The chance that the test of fit at its level notices it, by the noncentral chi-square law."""
    words: str
    """Direction, if it is a single number, in multiples of its deviation and of the parameters'
    sizes, in which parameters undo what it does to the readings."""

    @property
    def hidden(self) -> bool:
        """Whether it makes the answer wrong and the test of fit will mostly not say so."""
        return self.bounds > 1 and self.noticed < 0.5


def suspects(
    model: Measurement, R: Covariance, truth: Measurement, x: Array
) -> tuple[Suspect, ...]:
    """Finds the errors that `truth` has and `model` has not, at the truths x (truths, n), the
    largest shift first.

    Each is a nuisance of `truth`; those of a group of many are taken together.

    Raises:
        UserError: `truth` has no errors besides the parameters.
    """
    if not truth.nuisance_deviation.any():
        raise UserError(
            f"errors: {truth.name} has no errors besides the parameters; leave it out, or choose a"
            " richer one"
        )
    J = R.whiten_jacobian(model.jacobian(x))
    Q, s, right = np.linalg.svd(J, full_matrices=False)
    bound = np.sqrt(np.sum((right / s[:, :, None]) ** 2, axis=1))
    G = R.whiten_jacobian(nuisance_slopes(truth, x))
    inside = np.matmul(Q.swapaxes(1, 2), G)
    # To first order least squares moves by J+ g, and leaves g - J J+ g in the residuals.
    shift = np.matmul(right.swapaxes(1, 2), inside / s[:, :, None])
    left = G - np.matmul(Q, inside)
    names = [p.name for p in model.parameters]
    found = []
    for name, unit, deviation, columns in _told(truth):
        moved = shift[:, :, columns]
        rms = _rms(moved)
        relative = _rms(moved / bound[:, :, None])
        worst = int(np.argmax(relative))
        words = ""
        if len(columns) == 1:
            rms = rms * np.sign(moved[:, :, 0].mean(axis=0))
            words = in_words([name, *names], np.concatenate([[1.0], -rms]))
        one = Suspect(
            name,
            unit,
            deviation,
            shift=rms,
            bounds=float(relative[worst]),
            parameter=names[worst],
            noticed=_noticed(left[:, :, columns], model.m - model.n),
            words=words,
        )
        found.append(one)
    return tuple(sorted(found, key=lambda suspect: -suspect.bounds))


def _rms(shifts: Array) -> Array:
    """Computes the root mean square over truths (n,) of shifts (truths, n, k) that add up by their
    squares."""
    squares = np.sum(shifts**2, axis=2)
    return np.sqrt(np.mean(squares, axis=0))


def nuisance_slopes(truth: Measurement, x: Array) -> Array:
    """Computes the readings' slopes (truths, m, k) along the k nuisances that have a deviation, per
    deviation, at 0."""
    deviation = truth.nuisance_deviation
    active = np.flatnonzero(deviation)
    steps = np.zeros((len(active), len(deviation)))
    steps[np.arange(len(active)), active] = _STEP * deviation[active]
    slopes = []
    # A truth at a time: there may be hundreds of nuisances.
    for one in x:
        fixed = np.broadcast_to(one, (len(active), len(one)))
        above = truth.simulate(np.concatenate([fixed, steps], axis=1))
        below = truth.simulate(np.concatenate([fixed, -steps], axis=1))
        slopes.append((above - below).T / (2 * _STEP))
    return np.stack(slopes)


def _told(truth: Measurement) -> Iterator[tuple[str, str, float, list[int]]]:
    """Yields name, unit, deviation and columns, among the active nuisances, of each suspect."""
    deviation = truth.nuisance_deviation
    active = [(p, d) for p, d in zip(truth.nuisances, deviation, strict=True) if d != 0]
    groups: dict[str, list[int]] = {}
    for i, (nuisance, _) in enumerate(active):
        groups.setdefault(nuisance.group or nuisance.name, []).append(i)
    for group, columns in groups.items():
        if len(columns) > _SINGLE:
            nuisance, size = active[columns[0]]
            yield group, nuisance.unit, float(size * nuisance.size), columns
            continue
        for i in columns:
            nuisance, size = active[i]
            yield nuisance.name, nuisance.unit, float(size * nuisance.size), [i]


def _noticed(left: Array, degrees: int) -> float:
    """Computes the mean chance of a misfit, over truths and nuisances, for residual slopes (truths,
    m, k)."""
    from scipy.special import chdtri, chndtr

    rng = generator(0)
    drawn = rng.standard_normal((_DRAWS, left.shape[2]))
    inner = gram(left)
    squares = np.stack([np.einsum("dk,dk->d", drawn, multiply(one, drawn)) for one in inner])
    limit = chdtri(degrees, FIT_LEVEL)
    return float(np.mean(1 - chndtr(limit, degrees, squares)))
