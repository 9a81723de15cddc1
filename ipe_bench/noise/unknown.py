"""Defines noise whose levels are estimated from the residuals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ipe_bench.basics.errors import UserError, refuse_unknown
from ipe_bench.basics.linalg import Array, Covariance
from ipe_bench.basics.options import Positive
from ipe_bench.measurements.base import Measurement
from ipe_bench.noise.base import Noise
from ipe_bench.noise.kinds import Gaussian
from ipe_bench.noise.levels import READING, Levels, level_names, read_sigma

NO_LEVEL = (
    "noise=unknown: has no level to simulate with; choose another noise, give noise.levels=[...],"
    " or use `estimate`"
)


@dataclass(frozen=True)
class Unknown(Noise):
    """Draws independent normal errors whose level is estimated from the residuals.

    Estimates do not depend on a single level; standard errors are scaled by it, and tests of the
    level itself are not possible. Several levels, or a standard deviation that depends on the
    reading, are estimated with the parameters by restricted maximum likelihood.

    Example:

    >>> import ipe_bench as ib
    >>> noise = ib.noise.Unknown(levels=(0.1,))
    >>> bench = ib.Scenario(ib.measurements.Polynomial(), noise, error_scale=0.1)
    >>> lm = {"lm": ib.baselines.LevenbergMarquardt()}
    >>> float(ib.run(bench, lm, trials=20).iloc[-1]["success"])
    1.0
    """

    weights: tuple[Positive, ...] | None = None
    """Standard deviations of the readings up to a common factor; None: they are equal."""
    by: str | None = None
    """Column of the readings whose entries have levels of their own: `output`, say, or `file`."""
    sigma: str = "sigma"
    """Formula of the standard deviation: h is the magnitude of the error-free reading, all other
    names are levels."""
    levels: tuple[Positive, ...] | None = None
    """True levels in the order of the formula, for `run`: estimators take R with these, at the
    nominal readings."""

    estimated = True

    def __post_init__(self) -> None:
        super().__post_init__()
        names = level_names(read_sigma(self.sigma))
        if self.levels is None:
            return
        if len(self.levels) != len(names):
            raise UserError(
                f"noise.levels: has {len(self.levels)} numbers; give one for each of"
                f" {', '.join(names)}"
            )
        if self.by is not None:
            raise UserError(
                "noise.by: does not go with noise.levels; state what is known, as in noise=gaussian"
            )

    def levels_of(self, model: Measurement) -> Levels | None:
        """Returns the levels of a model's readings; None if a single one multiplies all standard
        deviations.

        Raises:
            UserError: there is no such column, or a level has the name of a parameter.
        """
        if self.by is None and self.sigma == "sigma":
            return None
        if self.by is not None:
            refuse_unknown(f"noise.by={self.by}", self.by, model.index, "column of the readings")
        column = [""] * model.m if self.by is None else model.index[self.by]
        entries = [f"{entry:g}" if isinstance(entry, float) else str(entry) for entry in column]
        groups = tuple(dict.fromkeys(entries))
        group = np.array([groups.index(entry) for entry in entries], dtype=np.intp)
        weights = self.covariance(model.m).factor
        units = tuple(map(model.unit_of, groups))
        found = Levels(read_sigma(self.sigma), weights, groups, group, units)
        levels = {p.name for p in found.parameters}
        both = levels & {p.name for p in model.physical_parameters}
        if both:
            raise UserError(
                f"noise.sigma: {min(both)} is a parameter of the model; give the level another name"
            )
        return found

    def true_levels(self, m: int) -> tuple[Levels, Array] | None:
        if self.levels is None:
            return None
        weights = self.covariance(m).factor
        of_one_group = np.zeros(m, dtype=np.intp)
        levels = Levels(read_sigma(self.sigma), weights, ("",), of_one_group)
        return levels, np.log(self.levels)

    def nominal_covariance(self, model: Measurement) -> Covariance:
        if self.levels is None:
            return self.covariance(model.m)
        return self._true_covariance(model.simulate(model.nominal[None])[0])

    def _true_covariance(self, h: Array) -> Covariance:
        """Computes R of the errors of readings h (m,)."""
        known = self.true_levels(len(h))
        if known is None:
            raise UserError(NO_LEVEL)
        levels, theta = known
        return levels.covariance(h, theta)

    @property
    def true_covariance(self) -> bool:
        return READING not in read_sigma(self.sigma).names

    def corrupt(self, h: Array, offset: Array, rng: np.random.Generator) -> Array:
        return h + self._true_covariance(h).factor * rng.standard_normal(h.shape)

    def covariance(self, m: int) -> Covariance:
        if self.weights is None:
            return Covariance(np.ones(m))
        return Gaussian(self.weights).covariance(m)
