"""Digits of an estimate that agree with NIST's certified answer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.measurements.nist.model import Nist

CERTIFIED_DIGITS = 11.0


@dataclass(frozen=True)
class Digits:
    """Correct digits, the fewest over the parameters: 11 is all that is certified, 0 is a wrong answer."""

    parameters: float
    deviations: float
    residual_sum_of_squares: float


def digits(value: Array | float, certified: Array | float) -> float:
    """The log relative error -log10(|value - certified| / |certified|), the smallest over the entries.

    Capped at 11 digits. Less than one digit, or a value that is not finite, counts as none (McCullough, Assessing the
    reliability of statistical software, The American Statistician 52, 1998).
    """
    value, certified = np.atleast_1d(value), np.atleast_1d(certified)
    if not np.isfinite(value).all():
        return 0.0
    with np.errstate(divide="ignore"):
        lre = float(np.min(-np.log10(np.abs(value - certified) / np.abs(certified))))
    return min(lre, CERTIFIED_DIGITS) if lre >= 1.0 else 0.0


def score(model: Nist, x: Array, deviation: Array | None) -> Digits:
    """Compares an estimate x (n,) and its standard deviations (n,), if any, both in multiples of sizes, with NIST's.

    An estimator is told R = sigma^2 I with NIST's residual deviation as sigma, and states its deviations for that R.
    NIST's rest on the residual variance of the fit, rss / (m - n), so that is put in the place of sigma^2.
    """
    certified = model.certified
    with np.errstate(all="ignore"):
        residuals = model.readings - model.simulate(x[None])[0]
        rss = float(residuals @ residuals)
        deviations = np.full(model.n, np.nan)
        if deviation is not None:
            scale = np.sqrt(rss / certified.degrees_of_freedom) / certified.residual_deviation
            deviations = deviation * model.sizes * scale
    return Digits(
        digits(x * model.sizes, certified.parameters),
        digits(deviations, certified.deviations),
        digits(rss, certified.residual_sum_of_squares),
    )
