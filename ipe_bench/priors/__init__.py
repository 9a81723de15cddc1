"""Priors: where true parameters are drawn from, and what estimators assume of that. Config group
`prior`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Component, Finite, NonNegative

__all__ = ["GaussianPrior", "Prior"]

_SYMMETRIC = 1e-6
"""Entries that should be equal may differ by this share of the deviations: files are printed with
few digits."""
_DEFINITE = 1e-12
"""The least eigenvalue of a correlation: below it P0 has no inverse to working precision."""


class Prior(Component, ABC):
    """Draws true parameters about the start: a frozen dataclass of its options.

    Required: `deviation` and `draw`. Optional: `correlation`, and `normal`. Promised: draws have
    the start as mean, and the covariance P0 of these deviations and correlations; they come
    from `rng` alone. Estimators that use a prior are given N(nominal, P0), and the Bayesian bound
    is the one under that; if draws are not normal, it is one for estimators that know no more than
    mean and covariance.

    >>> import ipe_bench as ib
    >>> @dataclass(frozen=True)
    ... class Uniform(Prior):
    ...     normal = False
    ...     def deviation(self, n, error_scale):
    ...         return np.full(n, error_scale)
    ...     def draw(self, x0, error_scale, rng):
    ...         return x0 + np.sqrt(3) * error_scale * rng.uniform(-1, 1, len(x0))
    >>> noise = ib.noise.Gaussian(0.01)
    >>> scenario = ib.Scenario(ib.measurements.Polynomial(), noise, Uniform(), error_scale=2.0)
    >>> print(np.abs(scenario.draw(0, 1000).x).max() < 2 * np.sqrt(3))
    True
    """

    normal: ClassVar[bool] = True
    """Whether draws are normal: the posterior is sampled for such priors alone."""

    @abstractmethod
    def deviation(self, n: int, error_scale: float) -> Array:
        """Returns the standard deviations (n,) of the parameters in multiples of their units."""

    def correlation(self, n: int) -> Array | None:
        """Returns the correlation (n, n) of the parameters, positive definite; None: they are
        independent."""
        del n

    @abstractmethod
    def draw(self, x0: Array, error_scale: float, rng: np.random.Generator) -> Array:
        """Returns one parameter vector (n,) about the start x0 (n,), in multiples of the
        units."""


@dataclass(frozen=True)
class GaussianPrior(Prior):
    """Draws from N(x0, P0), of deviations error_scale x unit and independent parameters;
    `deviations` widens or narrows some of them, and `correlations` makes them depend on each other.

    Example, in which the last of four parameters is known ten times better:

    >>> import ipe_bench as ib
    >>> prior = ib.priors.GaussianPrior(deviations=(1, 1, 1, 0.1))
    >>> noise = ib.noise.Gaussian(0.1)
    >>> bench = ib.Scenario(ib.measurements.Ranging(), noise, prior, error_scale=10.0)
    >>> print(bench.draw(0, 2000).x.std(axis=0).round(0))
    [10. 10. 10.  1.]
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
            _check_correlations(self.correlations)

    def deviation(self, n: int, error_scale: float) -> Array:
        if self.deviations is not None and len(self.deviations) != n:
            raise UserError(
                f"prior.deviations: has {len(self.deviations)} numbers; give one for each of {n}"
                " parameters"
            )
        of_each = np.ones(n) if self.deviations is None else np.array(self.deviations)
        return error_scale * of_each

    def correlation(self, n: int) -> Array | None:
        if self.correlations is None:
            return None
        if len(self.correlations) != n:
            raise UserError(
                f"prior.correlations: has {len(self.correlations)} rows; give one for each of {n}"
                " parameters"
            )
        C = np.array(self.correlations, dtype=float)
        return (C + C.T) / 2

    def draw(self, x0: Array, error_scale: float, rng: np.random.Generator) -> Array:
        n = len(x0)
        white = rng.standard_normal(n)
        C = self.correlation(n)
        drawn = white if C is None else np.linalg.cholesky(C) @ white
        return x0 + self.deviation(n, error_scale) * drawn


def _check_correlations(rows: Sequence[Sequence[float]]) -> None:
    """Refuses what is no correlation matrix: square, of diagonal 1, symmetric, positive
    definite."""
    if not rows:
        raise UserError("correlations: is empty; give a square matrix, a row for each parameter")
    for number, row in enumerate(rows, start=1):
        if len(row) != len(rows):
            raise UserError(
                f"correlations: row {number} has {len(row)} numbers; give a square matrix,"
                f" {len(rows)} in each row"
            )
    C = np.array(rows)
    if not np.allclose(np.diag(C), 1.0, atol=_SYMMETRIC):
        raise UserError(
            "correlations: has a diagonal that is not 1; give correlations, deviations aside"
        )
    gap = np.abs(C - C.T)
    if (gap > _SYMMETRIC).any():
        i, j = np.unravel_index(gap.argmax(), C.shape)
        raise UserError(
            f"correlations: is not symmetric; row {i + 1}, column {j + 1} is {C[i, j]:g},"
            f" and row {j + 1}, column {i + 1} is {C[j, i]:g}"
        )
    least = float(np.linalg.eigvalsh((C + C.T) / 2)[0])
    if least <= _DEFINITE:
        raise UserError(
            f"correlations: is not positive definite; the least eigenvalue is {least:.2g},"
            " so that some combination of the parameters would have no variance"
        )
