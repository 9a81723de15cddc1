"""Noise that is not of its own options: that which a model names, that of real readings, and one of unknown level."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array, Covariance
from ipe_bench.basics.options import Positive
from ipe_bench.measurements.base import Measurement
from ipe_bench.noise.base import Noise
from ipe_bench.noise.levels import READING, Levels, read_sigma
from ipe_bench.noise.white import Gaussian, Quantization

NO_LEVEL = (
    "noise=unknown: has no level to simulate with; choose another noise, give noise.levels=[...], or use `estimate`"
)


@dataclass(frozen=True)
class Certified(Noise):
    """Readings are those that come with the measurement model, its certified answer stands for the truth, and no prior.

    A scenario with it has one trial. R is what the model states of its readings.
    """

    real = True

    def corrupt(self, h: Array, offset: Array, rng: np.random.Generator) -> Array:
        raise UserError("noise=certified: has real readings only; choose another noise to simulate some")

    def covariance(self, m: int) -> Covariance:
        raise UserError("noise=certified: knows no R of its own; choose another noise")


@dataclass(frozen=True)
class Unknown(Noise):
    """Independent normal errors whose level is estimated from the residuals.

    Estimates do not depend on a single level; standard errors are scaled by it, and tests of the level itself are not
    possible. Several levels, or a standard deviation that depends on the reading, are estimated with the parameters by
    restricted maximum likelihood.
    """

    weights: tuple[Positive, ...] | None = None
    """Standard deviations of the readings up to a common factor; None: they are equal."""
    by: str | None = None
    """Column of the readings whose entries have levels of their own: `output`, say, or `file`."""
    sigma: str = "sigma"
    """Formula of the standard deviation: h is the magnitude of the error-free reading, all other names are levels."""
    levels: tuple[Positive, ...] | None = None
    """True levels in the order of the formula, for `run`: estimators are told R with these, at the nominal readings."""

    estimated = True

    def __post_init__(self) -> None:
        super().__post_init__()
        names = [name for name in read_sigma(self.sigma).names if name != READING]
        if self.levels is not None and len(self.levels) != len(names):
            raise UserError(f"noise.levels: has {len(self.levels)} numbers; give one for each of {', '.join(names)}")
        if self.levels is not None and self.by is not None:
            raise UserError("noise.by: does not go with noise.levels; state what is known, as in noise=gaussian")

    def levels_of(self, model: Measurement) -> Levels | None:
        """The levels of a model's readings; None if a single one multiplies all standard deviations."""
        if self.by is None and self.sigma == "sigma":
            return None
        return Levels.of(read_sigma(self.sigma), self.covariance(model.m).factor, self.by, model)

    def true_levels(self, m: int) -> tuple[Levels, Array] | None:
        if self.levels is None:
            return None
        formula, weights = read_sigma(self.sigma), self.covariance(m).factor
        return Levels(formula, weights, ("",), np.zeros(m, dtype=np.intp)), np.log(self.levels)

    def nominal_covariance(self, model: Measurement) -> Covariance:
        if self.levels is None:
            return self.covariance(model.m)
        return Covariance(self._deviations(model.simulate(model.nominal[None])[0]))

    def _deviations(self, h: Array) -> Array:
        """Standard deviations (m,) of readings h (m,)."""
        known = self.true_levels(len(h))
        if known is None:
            raise UserError(NO_LEVEL)
        levels, theta = known
        return levels.covariance(h, theta).factor

    @property
    def true_covariance(self) -> bool:
        return READING not in read_sigma(self.sigma).names

    def corrupt(self, h: Array, offset: Array, rng: np.random.Generator) -> Array:
        return h + self._deviations(h) * rng.standard_normal(h.shape)

    def covariance(self, m: int) -> Covariance:
        if self.weights is None:
            return Covariance(np.ones(m))
        return Gaussian(self.weights).covariance(m)


@dataclass(frozen=True)
class ModelNoise(Noise):
    """Stands for the noise that the measurement model names, with its deviation or step replaced where given.

    A scenario never holds it: it holds what `of` makes of it.
    """

    name = "model"

    deviation: Positive | tuple[Positive, ...] | None = None
    """Standard deviation of the readings in their unit, or one for each."""
    step: Positive | None = None
    """The step of a read-out that is rounded."""

    def of(self, model: Measurement) -> Noise | None:
        """The noise meant for this model; None where neither the model nor an option says what it is."""
        usual = model.usual_noise
        step = self.step if self.step is not None else usual.step if usual is not None else None
        if isinstance(self.deviation, tuple):
            return Gaussian(self.deviation)
        if step is not None:
            return Quantization(step, self.deviation)
        deviation = self.deviation if self.deviation is not None else usual.deviation if usual is not None else None
        return None if deviation is None else Gaussian(deviation)

    def corrupt(self, h: Array, offset: Array, rng: np.random.Generator) -> Array:
        raise TypeError("ModelNoise stands for another noise: see `of`")

    def covariance(self, m: int) -> Covariance:
        raise TypeError("ModelNoise stands for another noise: see `of`")


def resolved(noise: Noise, model: Measurement) -> Noise:
    """The noise itself, or what it stands for with this model.

    Raises:
        UserError: the model names no noise and none is given.
    """
    if not isinstance(noise, ModelNoise):
        return noise.completed(model.usual_noise)
    own = noise.of(model)
    if own is None:
        raise UserError(
            f"noise: is not given, and measurement={model.name} names no noise of its own; set noise.deviation=X, the "
            "standard deviation of a reading, or choose a noise"
        )
    return own
