"""The 27 nonlinear regression problems of the NIST Statistical Reference Datasets as measurement models.

The readings are real or generated data with certified answers (National Institute of Standards and Technology,
https://www.itl.nist.gov/div898/strd/nls/nls_main.shtml, public domain), kept in `data.json`. How an estimate is
compared with the certified one is said by `score`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.resources import files
from typing import Any, Literal, get_args

import numpy as np

from ipe_bench.basics.linalg import Array, Covariance
from ipe_bench.measurements.base import Measurement, Parameter, Recorded
from ipe_bench.measurements.nist.formulas import FORMULAS

# fmt: off
Dataset = Literal[
    "Misra1a", "Chwirut2", "Chwirut1", "Lanczos3", "Gauss1", "Gauss2", "DanWood", "Misra1b", "Kirby2", "Hahn1",
    "Nelson", "MGH17", "Lanczos1", "Lanczos2", "Gauss3", "Misra1c", "Misra1d", "Roszman1", "ENSO", "MGH09",
    "Thurber", "BoxBOD", "Rat42", "MGH10", "Eckerle4", "Rat43", "Bennett5",
]
# fmt: on
"""The names in `datasets()`: as a type, for who reads types alone, such as a shell that completes a word."""
_PREDICTORS: dict[str, tuple[str, ...]] = {"Nelson": ("time", "temperature")}


@dataclass(frozen=True)
class CertifiedAnswer:
    """What NIST certifies of one data set, to eleven digits."""

    parameters: Array
    """(n,), in the physical units of the problem."""
    deviations: Array
    """(n,): standard deviations of the parameters, with the residual variance estimated from the fit."""
    residual_sum_of_squares: float
    residual_deviation: float
    degrees_of_freedom: int
    """m - n. The header of NIST's Rat43 states another number, which its own certified deviations contradict."""


@cache
def _tables() -> dict[str, dict[str, Any]]:
    return json.loads(files("ipe_bench.measurements.nist").joinpath("data.json").read_text(encoding="utf-8"))


def datasets() -> tuple[Dataset, ...]:
    """The names of the 27 problems in NIST's order: lower, average, higher difficulty."""
    return get_args(Dataset)


@dataclass(frozen=True)
class Nist(Measurement):
    """One regression problem of NIST, to be started at one of its two certified starting points.

    The nominal point is that start, and each parameter's size is its magnitude there, so x0 consists of ones and minus
    ones. There is no order of arrival and no prior: a start is where to begin, not what is believed. A reading is one
    observation y; for Nelson it is log(y), as NIST fits it.
    """

    dataset: Dataset = "Misra1a"
    """A name as NIST writes it; see `datasets()`."""
    start: Literal[1, 2] = 1
    """Which starting point: 1 is far from the solution, 2 is near."""

    analytic = True

    @property
    def _table(self) -> dict[str, Any]:
        return _tables()[self.dataset]

    @cached_property
    def start_values(self) -> Array:
        """The starting point (n,) in physical units."""
        return np.array(self._table[f"start_{self.start}"], dtype=float)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(Parameter(f"b{i + 1}", size=float(abs(b))) for i, b in enumerate(self.start_values))

    @property
    def nominal(self) -> Array:
        return np.sign(self.start_values)

    @cached_property
    def predictors(self) -> tuple[Array, ...]:
        """One array (m,) per predictor variable."""
        return tuple(np.array(column, dtype=float) for column in self._table["predictors"])

    @property
    def index(self) -> Mapping[str, Sequence[Any]]:
        names = _PREDICTORS.get(self.dataset, ("x",))
        observation = list(range(1, len(self.predictors[0]) + 1))
        return {"observation": observation} | dict(zip(names, (c.tolist() for c in self.predictors), strict=True))

    @cached_property
    def readings(self) -> Array:
        """The observed z (m,)."""
        y = np.array(self._table["readings"], dtype=float)
        return np.log(y) if self.dataset == "Nelson" else y

    @cached_property
    def certified(self) -> CertifiedAnswer:
        """The certified answer."""
        table = self._table
        return CertifiedAnswer(
            parameters=np.array(table["certified"], dtype=float),
            deviations=np.array(table["deviations"], dtype=float),
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
        """The readings with the certified answer, and R for independent readings of the certified residual deviation.

        That deviation moves no least-squares estimate: it only says what a small gradient is. Standard deviations are
        scored with the residual variance of the fit itself, see `score`.
        """
        certified = self.certified
        R = Covariance(np.full(self.m, certified.residual_deviation))
        return Recorded(self.readings, R, certified.parameters / self.sizes)
