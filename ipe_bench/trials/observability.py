"""Analyses what readings say about each parameter before any are taken: singular values, the least observable
direction, bounds and correlations, and which errors that the model leaves out look like its parameters.

All of it follows from Jacobians at truths drawn from the prior. `design` chooses which readings to take.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.linalg import Array, Covariance, deviations, multiply
from ipe_bench.measurements.base import Measurement, Parameter
from ipe_bench.trials.thresholds import FIT_LEVEL

TRUTHS = 30
"""Truths from the prior over which bounds and designs are averaged."""
_STEP = 0.1
"""Step of central differences, as a share of a nuisance's deviation: far above round-off, far below where it bends."""
_SINGLE = 4
"""Largest group of nuisances that are reported one by one."""
_DRAWS = 200
_WORTH_SAYING = 0.1
"""Coefficients of a direction below this share of the largest are left out of its words."""


@dataclass(frozen=True)
class Observability:
    """Describes what a model's readings say about its parameters; lengths in multiples of the parameters' sizes."""

    parameters: tuple[Parameter, ...]
    singular_values: Array
    """Singular values of the whitened Jacobian R^-1/2 J (truths, n), descending."""
    right: Array
    """Its right singular vectors (truths, n, n), a row each."""

    @classmethod
    def at(cls, model: Measurement, R: Covariance, x: Array) -> Observability:
        """Computes the observability at the truths x (truths, n)."""
        _, s, right = np.linalg.svd(R.whiten_jacobian(model.jacobian(x)), full_matrices=False)
        return cls(model.parameters, s, right)

    @cached_property
    def observable(self) -> bool:
        """Whether the readings determine every parameter at every truth, to working precision."""
        return self.singular_values.shape[1] == len(self.parameters) and not self._lost.any()

    @property
    def _lost(self) -> NDArray[np.bool_]:
        """Directions (truths, n) that the readings do not determine."""
        s = self.singular_values
        return ~(s > np.finfo(float).eps * 1e3 * s[:, :1])

    @cached_property
    def covariance(self) -> Array:
        """The Cramér-Rao bound (truths, n, n); where the readings leave a direction open it is very large there."""
        s = np.maximum(self.singular_values, np.finfo(float).eps * self.singular_values[:, :1])
        scaled = self.right / s[:, :, None]
        return np.matmul(scaled.swapaxes(1, 2), scaled)

    @cached_property
    def bound(self) -> Array:
        """Root mean square over the truths (n,) of each parameter's bound; infinite where readings leave it open."""
        partly_lost = (np.abs(self.right) > 1e-6)[self._lost].any(axis=0)
        return np.where(partly_lost, np.inf, deviations(self.covariance.mean(axis=0)))

    @cached_property
    def correlation(self) -> Array:
        """Correlation of the errors of efficient estimates (n, n), over the truths."""
        P = self.covariance.mean(axis=0)
        return P / np.outer(deviations(P), deviations(P))

    @cached_property
    def multiple_correlation(self) -> Array:
        """Correlation of each parameter's error with those of all others (n,): sqrt(1 - 1 / (P_ii (P^-1)_ii)), the
        median over the truths. The bound is 1 / sqrt(1 - square) of what it were if all others were known."""
        information = np.sum((self.right * self.singular_values[:, :, None]) ** 2, axis=1)
        inflation = np.diagonal(self.covariance, axis1=1, axis2=2) * information
        return np.sqrt(np.maximum(1 - 1 / np.maximum(np.median(inflation, axis=0), 1.0), 0.0))

    @cached_property
    def least_observable(self) -> Array:
        """The unit vector (n,) along which an efficient estimate scatters most: the first axis of the mean bound."""
        axis = np.linalg.eigh(self.covariance.mean(axis=0))[1][:, -1]
        return axis * np.sign(axis[np.argmax(np.abs(axis))])

    @property
    def words(self) -> str:
        """Text of `least_observable`, such as 'ky - 0.85 kx'."""
        return in_words([p.name for p in self.parameters], self.least_observable)


def in_words(names: Sequence[str], direction: Array) -> str:
    """Writes a direction (n,) as a sum over its largest coefficient, without what is below a tenth of it."""
    # What is equal but for round-off stays in the order of the names.
    order = np.argsort(-np.round(np.abs(direction) / np.abs(direction).max(), 6), kind="stable")
    coefficients = direction / direction[order[0]]
    text = str(names[order[0]])
    for i in order[1:]:
        if abs(coefficients[i]) < _WORTH_SAYING:
            break
        size = f"{abs(coefficients[i]):.2f}"
        text += f" {'+' if coefficients[i] > 0 else '-'} {'' if size == '1.00' else size + ' '}{names[i]}"
    return text


@dataclass(frozen=True)
class Suspect:
    """Describes an error that the model leaves out, of its usual size, and its first-order effect on least squares."""

    name: str
    unit: str
    deviation: float
    """Its standard deviation, in `unit`."""
    shift: Array
    """Shift of each parameter's estimate (n,): root mean square, in multiples of the parameters' sizes; with its sign
    if the error is a single number."""
    bounds: float
    """The largest shift of a parameter, in standard deviations of its bound."""
    parameter: str
    """The parameter that it moves most."""
    visible: float
    """The share of its whitened squares that the residuals keep; the parameters imitate the rest."""
    noticed: float
    """The chance that the test of fit at its level notices it, by the noncentral chi-square law."""
    words: str
    """Direction, if it is a single number, in multiples of its deviation and of the parameters' sizes, in which
    parameters undo what it does to the readings."""

    @property
    def hidden(self) -> bool:
        """Whether it makes the answer wrong and the test of fit will mostly not say so."""
        return self.bounds > 1 and self.noticed < 0.5


def suspects(
    model: Measurement, R: Covariance, truth: Measurement, x: Array
) -> tuple[Suspect, ...]:
    """Finds the errors that `truth` has and `model` has not, at the truths x (truths, n), the largest shift first.

    Each is a nuisance of `truth`; those of a group of many are taken together.
    """
    J = R.whiten_jacobian(model.jacobian(x))
    Q, s, right = np.linalg.svd(J, full_matrices=False)
    bound = np.sqrt(np.sum((right / s[:, :, None]) ** 2, axis=1))
    G = R.whiten_jacobian(nuisance_slopes(truth, x))
    inside = np.matmul(Q.swapaxes(1, 2), G)
    # To first order least squares moves by J+ g, and leaves g - J J+ g in the residuals.
    shift = np.matmul(right.swapaxes(1, 2), inside / s[:, :, None])
    left = G - np.matmul(Q, inside)
    found, names = [], [p.name for p in model.parameters]
    for name, unit, deviation, columns in _told(truth):
        moved, kept, whole = shift[:, :, columns], left[:, :, columns], G[:, :, columns]
        rms = np.sqrt(np.mean(np.sum(moved**2, axis=2), axis=0))
        relative = np.sqrt(np.mean(np.sum((moved / bound[:, :, None]) ** 2, axis=2), axis=0))
        worst, words = int(np.argmax(relative)), ""
        if len(columns) == 1:
            rms = rms * np.sign(moved[:, :, 0].mean(axis=0))
            words = in_words([name, *names], np.concatenate([[1.0], -rms]))
        visible = float(np.sum(kept**2) / np.sum(whole**2)) if np.any(whole) else 0.0
        noticed = _noticed(kept, model.m - model.n)
        bounds = float(relative[worst])
        found.append(
            Suspect(name, unit, deviation, rms, bounds, names[worst], visible, noticed, words)
        )
    return tuple(sorted(found, key=lambda suspect: -suspect.bounds))


def nuisance_slopes(truth: Measurement, x: Array) -> Array:
    """Computes the readings' slopes (truths, m, k) along the k nuisances that have a deviation, per deviation, at 0."""
    deviation = truth.nuisance_deviation
    active = np.flatnonzero(deviation)
    steps = np.zeros((len(active), len(deviation)))
    steps[np.arange(len(active)), active] = _STEP * deviation[active]
    slopes = []
    for one in x:  # a truth at a time: there may be hundreds of nuisances
        fixed = np.broadcast_to(one, (len(active), len(one)))
        above, below = (
            truth.simulate(np.concatenate([fixed, sign * steps], axis=1)) for sign in (1.0, -1.0)
        )
        slopes.append((above - below).T / (2 * _STEP))
    return np.stack(slopes)


def _told(truth: Measurement) -> Iterator[tuple[str, str, float, list[int]]]:
    """Yields name, unit, deviation and columns, among the active nuisances, of each suspect."""
    deviation = truth.nuisance_deviation
    active = [(p, d) for p, d in zip(truth.nuisances, deviation, strict=True) if d != 0]
    groups: dict[str, list[int]] = {}
    for i, (parameter, _) in enumerate(active):
        groups.setdefault(parameter.group or parameter.name, []).append(i)
    for group, columns in groups.items():
        if len(columns) <= _SINGLE:
            for i in columns:
                yield (
                    active[i][0].name,
                    active[i][0].unit,
                    float(active[i][1] * active[i][0].size),
                    [i],
                )
        else:
            first, size = active[columns[0]]
            yield group, first.unit, float(size * first.size), columns


def _noticed(left: Array, degrees: int) -> float:
    """Computes the mean chance of a misfit, over truths and nuisances, for residual slopes (truths, m, k)."""
    from scipy.special import chdtri, chndtr

    rng = np.random.Generator(np.random.Philox(0))
    drawn = rng.standard_normal((_DRAWS, left.shape[2]))
    inner = np.matmul(left.swapaxes(1, 2), left)
    squares = np.stack([np.einsum("dk,dk->d", drawn, multiply(one, drawn)) for one in inner])
    return float(np.mean(1 - chndtr(chdtri(degrees, FIT_LEVEL), degrees, squares)))
