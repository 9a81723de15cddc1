"""Where true parameters are drawn from."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Finite, NonNegative
from ipe_bench.measurements.base import Measurement
from ipe_bench.priors.base import Prior

_SYMMETRIC = 1e-6
"""Entries that should be equal may differ by this share of the deviations: files are printed with few digits."""
_DEFINITE = 1e-12
"""The least eigenvalue of a correlation: below it P0 has no inverse to working precision."""


@dataclass(frozen=True)
class GaussianPrior(Prior):
    """N(x0, P0), of deviations error_scale x unit and independent parameters; `deviations` widens or narrows some of
    them, and `correlations` makes them depend on each other.

    Estimators that use a prior are told this distribution.
    """

    deviations: tuple[NonNegative, ...] | None = None
    """Per parameter, in multiples of its unit, at error scale 1; None: 1 for each."""
    correlations: tuple[tuple[Finite, ...], ...] | None = None
    """The correlation matrix, a row per parameter; None: they are independent."""
    name: ClassVar[str] = "gaussian"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.deviations is not None and not any(self.deviations):
            raise UserError("deviations: give at least one that is above 0")
        if self.correlations is not None:
            _require_square("correlations", self.correlations)
            C = np.array(self.correlations)
            if not np.allclose(np.diag(C), 1.0, atol=_SYMMETRIC):
                raise UserError("correlations: has a diagonal that is not 1; give correlations, deviations aside")
            require_covariance("correlations", C)

    @cached_property
    def _correlation(self) -> Array:
        C = np.array(self.correlations, dtype=float)
        return (C + C.T) / 2

    def deviation(self, n: int, error_scale: float) -> Array:
        """Standard deviations (n,) of the parameters in multiples of their units."""
        if self.deviations is not None and len(self.deviations) != n:
            raise UserError(
                f"prior.deviations: has {len(self.deviations)} numbers; give one for each of {n} parameters"
            )
        return error_scale * (np.ones(n) if self.deviations is None else np.asarray(self.deviations, dtype=float))

    def correlation(self, n: int) -> Array | None:
        if self.correlations is None:
            return None
        if len(self.correlations) != n:
            raise UserError(
                f"prior.correlations: has {len(self.correlations)} rows; give one for each of {n} parameters"
            )
        return self._correlation

    def draw(self, x0: Array, error_scale: float, rng: np.random.Generator) -> Array:
        """One parameter vector (n,)."""
        n = len(x0)
        white, C = rng.standard_normal(n), self.correlation(n)
        deviation = error_scale if self.deviations is None else self.deviation(n, error_scale)
        return x0 + deviation * (white if C is None else np.linalg.cholesky(C) @ white)


def prior_of(model: Measurement, P: Array) -> GaussianPrior:
    """The prior of a covariance P (n, n) in the parameters' own units, at error scale 1.

    Of parameters with bounds it is that of their logarithms or logits, which has this P where it is narrow.

    Raises:
        UserError: P is not a covariance of n parameters.
    """
    P = np.asarray(P, dtype=float)
    if P.shape != (model.n, model.n):
        size = " x ".join(map(str, P.shape))
        names = ", ".join(p.name for p in model.physical_parameters)
        raise UserError(f"prior_covariance: is {size}; give a row and a column for each of {model.n} ({names})")
    require_covariance("prior_covariance", P)
    deviation = np.sqrt(np.diag(P))
    slope = model.physical_slope(model.nominal[None])[0]
    C = P / np.outer(deviation, deviation) * np.outer(np.sign(slope), np.sign(slope))
    C = (C + C.T) / 2
    np.fill_diagonal(C, 1.0)
    return GaussianPrior(tuple((deviation / np.abs(slope)).tolist()), tuple(map(tuple, C.tolist())))


def require_covariance(key: str, P: Array) -> None:
    """Refuses a square matrix that is not the covariance of anything.

    Raises:
        UserError: by `key`, and by row and column where one is to blame.
    """
    if not np.isfinite(P).all():
        i, j = (int(k) + 1 for k in np.argwhere(~np.isfinite(P))[0])
        raise UserError(f"{key}: row {i}, column {j} is not a finite number")
    variances = np.diag(P)
    if (variances <= 0).any():
        i = int(np.flatnonzero(variances <= 0)[0])
        raise UserError(f"{key}: row {i + 1}, column {i + 1} is {variances[i]:g}; a variance is above 0")
    deviation = np.sqrt(variances)
    C = P / np.outer(deviation, deviation)
    if (np.abs(C - C.T) > _SYMMETRIC).any():
        i, j = (int(k) for k in np.unravel_index(int(np.abs(C - C.T).argmax()), C.shape))
        raise UserError(
            f"{key}: is not symmetric; row {i + 1}, column {j + 1} is {P[i, j]:g}, and row {j + 1}, column {i + 1} is "
            f"{P[j, i]:g}"
        )
    least = float(np.linalg.eigvalsh((C + C.T) / 2)[0])
    if least <= _DEFINITE:
        raise UserError(
            f"{key}: is not positive definite; the least eigenvalue of its correlations is {least:.2g}, so that some "
            "combination of the parameters would have no variance"
        )


def _require_square(key: str, rows: tuple[tuple[float, ...], ...]) -> None:
    for i, row in enumerate(rows):
        if len(row) != len(rows):
            raise UserError(f"{key}: row {i + 1} has {len(row)} numbers; give a square matrix, {len(rows)} in each row")
