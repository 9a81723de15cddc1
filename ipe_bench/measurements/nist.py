"""Holds the certified regression problems of the NIST Statistical Reference Datasets, and counts
digits of an estimate.

The readings are real or generated data with certified answers (National Institute of Standards and
Technology, https://www.itl.nist.gov/div898/strd/nls/nls_main.shtml, public domain), kept in
`nist.json`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.resources import files
from typing import Any, Literal

import numpy as np

from ipe_bench.basics.errors import refuse_unknown
from ipe_bench.basics.linalg import Array, Covariance
from ipe_bench.measurements.base import Measurement, Parameter, Recorded


def _gauss(b: Sequence[Any], x: Any) -> Any:
    first = b[2] * np.exp(-(((x - b[3]) / b[4]) ** 2))
    second = b[5] * np.exp(-(((x - b[6]) / b[7]) ** 2))
    return b[0] * np.exp(-b[1] * x) + (first + second)


def _lanczos(b: Sequence[Any], x: Any) -> Any:
    return b[0] * np.exp(-b[1] * x) + b[2] * np.exp(-b[3] * x) + b[4] * np.exp(-b[5] * x)


def _chwirut(b: Sequence[Any], x: Any) -> Any:
    return np.exp(-b[0] * x) / (b[1] + b[2] * x)


def _cubics(b: Sequence[Any], x: Any) -> Any:
    above = b[0] + x * (b[1] + x * (b[2] + x * b[3]))
    return above / (1.0 + x * (b[4] + x * (b[5] + x * b[6])))


def _enso(b: Sequence[Any], x: Any) -> Any:
    def wave(cos: Any, sin: Any, period: Any) -> Any:
        angle = 2 * np.pi * x / period
        return cos * np.cos(angle) + sin * np.sin(angle)

    annual_angle = 2 * np.pi * x / 12
    annual = b[0] + b[1] * np.cos(annual_angle) + b[2] * np.sin(annual_angle)
    return annual + wave(b[4], b[5], b[3]) + wave(b[7], b[8], b[6])


def _saturation(b: Sequence[Any], x: Any) -> Any:
    return b[0] * -np.expm1(-b[1] * x)


FORMULAS: dict[str, Callable[..., Any]] = {
    "Misra1a": _saturation,
    "Chwirut2": _chwirut,
    "Chwirut1": _chwirut,
    "Lanczos3": _lanczos,
    "Gauss1": _gauss,
    "Gauss2": _gauss,
    "DanWood": lambda b, x: b[0] * x ** b[1],
    "Misra1b": lambda b, x: b[0] * (1.0 - (1.0 + b[1] * x / 2.0) ** -2),
    "Kirby2": lambda b, x: (b[0] + x * (b[1] + x * b[2])) / (1.0 + x * (b[3] + x * b[4])),
    "Hahn1": _cubics,
    # NIST fits the logarithm of the breakdown strength: the readings of this model are logarithms.
    "Nelson": lambda b, time, temperature: b[0] - b[1] * time * np.exp(-b[2] * temperature),
    "MGH17": lambda b, x: b[0] + b[1] * np.exp(-x * b[3]) + b[2] * np.exp(-x * b[4]),
    "Lanczos1": _lanczos,
    "Lanczos2": _lanczos,
    "Gauss3": _gauss,
    "Misra1c": lambda b, x: b[0] * (1.0 - 1.0 / np.sqrt(1.0 + 2.0 * b[1] * x)),
    "Misra1d": lambda b, x: b[0] * b[1] * x / (1.0 + b[1] * x),
    "Roszman1": lambda b, x: b[0] - b[1] * x - np.arctan(b[2] / (x - b[3])) / np.pi,
    "ENSO": _enso,
    "MGH09": lambda b, x: b[0] * (x**2 + x * b[1]) / (x**2 + x * b[2] + b[3]),
    "Thurber": _cubics,
    "BoxBOD": _saturation,
    "Rat42": lambda b, x: b[0] / (1.0 + np.exp(b[1] - b[2] * x)),
    "MGH10": lambda b, x: b[0] * np.exp(b[1] / (x + b[2])),
    "Eckerle4": lambda b, x: b[0] / b[1] * np.exp(-0.5 * ((x - b[2]) / b[1]) ** 2),
    "Rat43": lambda b, x: b[0] / (1.0 + np.exp(b[1] - b[2] * x)) ** (1.0 / b[3]),
    "Bennett5": lambda b, x: b[0] * (b[1] + x) ** (-1.0 / b[2]),
}
"""The 27 regression functions in NIST's order (lower, average, higher difficulty), by data set:
from the parameters b, arrays (trials, 1), and the predictors x, arrays (m,), to (trials, m). All
are analytic."""


@cache
def _tables() -> dict[str, dict[str, Any]]:
    file = files("ipe_bench.measurements").joinpath("nist.json")
    return json.loads(file.read_text(encoding="utf-8"))


@dataclass(frozen=True)
class CertifiedAnswer:
    """Holds NIST's certified answer to one data set, to eleven digits."""

    parameters: Array
    """(n,), in physical units."""
    deviations: Array
    """(n,): standard deviations of the parameters, with the residual variance estimated from the
    fit."""
    residual_sum_of_squares: float
    residual_deviation: float
    degrees_of_freedom: int
    """m - n. The header of NIST's Rat43 states another number, which its own certified deviations
    contradict."""


@dataclass(frozen=True)
class Nist(Measurement):
    """Holds one regression problem of NIST, to be started at one of its two certified starting
    points.

    The start is that point, and each parameter's size is its magnitude there, so x0
    consists of ones and minus ones. There is no order of arrival and no prior. A reading is one
    observation y; for Nelson it is log(y), as NIST fits it.

    Example:

    >>> import ipe_bench as ib
    >>> model = ib.measurements.Nist("Misra1a")
    >>> print([parameter.name for parameter in model.parameters], model.m)
    ['b1', 'b2'] 14
    """

    dataset: str = "Misra1a"
    """A name as NIST writes it, a key of `FORMULAS`."""
    start: Literal[1, 2] = 1
    """Number of the starting point: 1 is far from the solution, 2 is near."""

    analytic = True

    def __post_init__(self) -> None:
        super().__post_init__()
        refuse_unknown(f"dataset={self.dataset}", self.dataset, FORMULAS, "data set")

    def _numbers(self, key: str) -> Array:
        return np.array(_tables()[self.dataset][key], dtype=float)

    @cached_property
    def start_values(self) -> Array:
        """The starting point (n,) in physical units."""
        return self._numbers(f"start_{self.start}")

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        numbered = enumerate(self.start_values, 1)
        return tuple(Parameter(f"b{i}", size=float(abs(b))) for i, b in numbered)

    @property
    def nominal(self) -> Array:
        return np.sign(self.start_values)

    @cached_property
    def predictors(self) -> Array:
        """The predictor variables (k, m)."""
        return self._numbers("predictors")

    @property
    def index(self) -> Mapping[str, Sequence[Any]]:
        names = ("time", "temperature") if self.dataset == "Nelson" else ("x",)
        observations = list(range(1, self.predictors.shape[1] + 1))
        columns = dict(zip(names, self.predictors.tolist(), strict=True))
        return {"observation": observations, **columns}

    @cached_property
    def readings(self) -> Array:
        """The observed z (m,)."""
        y = self._numbers("readings")
        return np.log(y) if self.dataset == "Nelson" else y

    @cached_property
    def certified(self) -> CertifiedAnswer:
        table = _tables()[self.dataset]
        return CertifiedAnswer(
            parameters=self._numbers("certified"),
            deviations=self._numbers("deviations"),
            residual_sum_of_squares=table["residual_sum_of_squares"],
            residual_deviation=table["residual_deviation"],
            degrees_of_freedom=self.m - self.n,
        )

    def simulate(self, x: Array) -> Array:
        b = (x * self.sizes).T[:, :, None]
        with np.errstate(all="ignore"):
            return FORMULAS[self.dataset](b, *self.predictors)

    @property
    def recorded(self) -> Recorded:
        """The readings with the certified answer, and R for independent readings of the certified
        residual deviation, which moves no least-squares estimate: it only says what a small
        gradient is."""
        certified = self.certified
        R = Covariance(np.full(self.m, certified.residual_deviation))
        return Recorded(self.readings, R, certified.parameters / self.sizes)


@dataclass(frozen=True)
class Digits:
    """Holds correct digits, the fewest over the parameters: 11 is all that is certified, 0 is a
    wrong answer."""

    parameters: float
    deviations: float
    residual_sum_of_squares: float


def digits(value: Array | float, certified: Array | float) -> float:
    """Computes the log relative error -log10(|value - certified| / |certified|), the least of all,
    at most 11.

    Less than one digit, or a value that is not finite, counts as none (McCullough, Assessing the
    reliability of statistical software, The American Statistician 52, 1998).
    """
    values = np.atleast_1d(value)
    known = np.atleast_1d(certified)
    if not np.isfinite(values).all():
        return 0.0
    with np.errstate(divide="ignore"):
        errors = np.abs(values - known) / np.abs(known)
        least = float(np.min(-np.log10(errors)))
    return min(least, 11.0) if least >= 1.0 else 0.0


def score(model: Nist, x: Array, deviation: Array) -> Digits:
    """Compares an estimate x (n,) and its standard deviations (n,), both in multiples of sizes,
    with NIST's.

    An estimator assumes R = sigma^2 I with NIST's residual deviation as sigma, and states its
    deviations for that R. NIST's rest on the residual variance of the fit, rss / (m - n), so that
    is put in the place of sigma^2.
    """
    certified = model.certified
    residuals = model.readings - model.simulate(x[None])[0]
    with np.errstate(all="ignore"):
        rss = float(residuals @ residuals)
        scale = np.sqrt(rss / certified.degrees_of_freedom) / certified.residual_deviation
        deviations = deviation * model.sizes * scale
    return Digits(
        digits(x * model.sizes, certified.parameters),
        digits(deviations, certified.deviations),
        digits(rss, certified.residual_sum_of_squares),
    )
