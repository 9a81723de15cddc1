"""Defines the kinds of noise whose R is known."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import Annotated, Literal, Self

import numpy as np
from annotated_types import Ge, Gt, Lt

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array, Covariance
from ipe_bench.basics.options import Count, Positive, Share
from ipe_bench.measurements.base import Measurement, UsualNoise
from ipe_bench.noise.base import Noise

UNIFORM_DEVIATION = 1 / np.sqrt(12)
"""The standard deviation of a uniform number between 0 and 1."""


@dataclass(frozen=True)
class ScaledNoise(Noise):
    """Describes a noise whose size is one standard deviation; R is white unless a subclass says
    otherwise."""

    deviation: Positive | None = None
    """Standard deviation of a reading, in the unit of the readings; None: that of the model's usual
    noise."""

    def completed(self, usual: UsualNoise | None) -> Self:
        known = usual or UsualNoise()
        deviation = (
            self.deviation or known.deviation or (known.step and known.step * UNIFORM_DEVIATION)
        )
        found = replace(self, deviation=deviation)
        _ = found.stated
        return found

    @property
    def stated(self) -> float:
        """The standard deviation.

        Raises:
            UserError: none is given.
        """
        if self.deviation is None:
            raise UserError(
                f"noise.deviation: is not given for noise={self.name}, and the measurement model"
                " names no noise of its own; give the standard deviation of a reading in its"
                " unit, noise.deviation=X"
            )
        return self.deviation

    def covariance(self, m: int) -> Covariance:
        return Covariance(np.full(m, self.stated))


@dataclass(frozen=True)
class Gaussian(ScaledNoise):
    """Draws z = h + v with independent normal v.

    Example, in which noise twice as large doubles the bound:

    >>> import ipe_bench as ib
    >>> model = ib.measurements.Polynomial()
    >>> small, large = (ib.Scenario(model, ib.noise.Gaussian(sigma)) for sigma in (0.01, 0.02))
    >>> print(large.linear_bound / small.linear_bound)
    [2. 2. 2. 2.]
    """

    deviation: Positive | tuple[Positive, ...] | None = None
    """One standard deviation in the unit of the readings, or one for each; None: that of the
    model's usual noise."""

    def corrupt(self, h: Array, offset: Array, rng: np.random.Generator) -> Array:
        return h + self.covariance(len(h)).factor * rng.standard_normal(h.shape)

    def covariance(self, m: int) -> Covariance:
        if not isinstance(self.deviation, tuple):
            return super().covariance(m)
        if len(self.deviation) != m:
            raise UserError(
                f"noise.deviation: has {len(self.deviation)} numbers; give one for each of {m}"
                " readings"
            )
        return Covariance(np.asarray(self.deviation))


@dataclass(frozen=True)
class NoNoise(ScaledNoise):
    """Returns z = h exactly, while estimators assume readings of the nominal standard deviation.

    Example:

    >>> import numpy as np, ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Polynomial(), ib.noise.NoNoise(0.01))
    >>> drawn = bench.draw(0, 2)
    >>> print(np.ptp(drawn.z - bench.measurement.simulate(drawn.x)))
    0.0
    """

    name = "none"
    true_covariance = False

    def corrupt(self, h: Array, offset: Array, rng: np.random.Generator) -> Array:
        return h


@dataclass(frozen=True)
class StudentT(ScaledNoise):
    """Draws z = h + v with independent v of Student's t distribution, scaled to the given standard
    deviation.

    Estimators are given the true covariance R = deviation^2 I, and do not know the shape.

    Example, in which the largest of 4000 errors lies far beyond what normal ones reach:

    >>> import numpy as np, ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Polynomial(), ib.noise.StudentT(0.1))
    >>> drawn = bench.draw(0, 100)
    >>> errors = drawn.z - bench.measurement.simulate(drawn.x)
    >>> print(np.abs(errors).max() > 10 * 0.1)
    True
    """

    degrees_of_freedom: Annotated[float, Gt(2)] = 3.0
    """Above 2, for a finite variance; the smaller, the heavier the tails."""

    def corrupt(self, h: Array, offset: Array, rng: np.random.Generator) -> Array:
        return h + self.stated * self.whitened(h.shape, rng)

    def whitened(self, shape: tuple[int, ...], rng: np.random.Generator) -> Array:
        # The variance of Student's t is nu / (nu - 2).
        scale = np.sqrt((self.degrees_of_freedom - 2) / self.degrees_of_freedom)
        return scale * rng.standard_t(self.degrees_of_freedom, shape)


@dataclass(frozen=True)
class Outliers(ScaledNoise):
    """Draws from Tukey's contaminated normal: with probability `share` a reading is `factor` times
    as noisy.

    `deviation` is the standard deviation of a good reading. `assumed` is what estimators assume:
    `nominal`, the variance of the good readings, as if there were no outliers; or `total`, that of
    the mixture, deviation^2 (1 - share + share factor^2).

    Example, in which an R that knows of the outliers makes the covariance wide enough:

    >>> import ipe_bench as ib
    >>> lm = {"lm": ib.baselines.LevenbergMarquardt()}
    >>> for assumed in ("nominal", "total"):
    ...     noise = ib.noise.Outliers(0.1, assumed=assumed)
    ...     bench = ib.Scenario(ib.measurements.Polynomial(), noise, error_scale=0.1)
    ...     print(assumed, ib.run(bench, lm, trials=20).iloc[-1]["nees_solved"] < 1.5)
    nominal False
    total True
    """

    share: Share = 0.05
    factor: Positive = 10.0
    assumed: Literal["nominal", "total"] = "nominal"

    @property
    def true_covariance(self) -> bool:
        return self.assumed == "total"

    def corrupt(self, h: Array, offset: Array, rng: np.random.Generator) -> Array:
        return h + self.stated * self._mixture(h.shape, rng)

    def _mixture(self, shape: tuple[int, ...], rng: np.random.Generator) -> Array:
        """Draws errors over the deviation of a good reading."""
        gross = rng.random(shape) < self.share
        return np.where(gross, self.factor, 1.0) * rng.standard_normal(shape)

    def whitened(self, shape: tuple[int, ...], rng: np.random.Generator) -> Array | None:
        """Draws from the mixture if estimators know of it; otherwise R is that of good readings,
        which are normal."""
        if self.assumed == "nominal":
            return None
        return self._mixture(shape, rng) / self._excess

    @property
    def _excess(self) -> float:
        """The standard deviation that R states over that of a good reading."""
        if self.assumed == "nominal":
            return 1.0
        return float(np.sqrt(1 - self.share + self.share * self.factor**2))

    def covariance(self, m: int) -> Covariance:
        return Covariance(np.full(m, self.stated * self._excess))


@dataclass(frozen=True)
class Quantization(Noise):
    """Rounds z = step * round((offset + h) / step) - offset: the instruments' whole read-out, not
    its error.

    Rounding the difference instead would give equal errors in cases that differ in sign alone. The
    error is taken to be uniform, R = step^2 / 12, unless `deviation` states it. With `dither` a
    uniform error of one step is added before rounding and taken off again: then the error is
    uniform and independent of h, which at small h it otherwise is not.

    Example, whose readings are multiples of the step:

    >>> import numpy as np, ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Quantization(0.5))
    >>> z = bench.draw(0, 1).z
    >>> print(np.array_equal(z, 0.5 * np.round(z / 0.5)))
    True
    """

    step: Positive | None = None
    """The step in the unit of the readings; None: that of the model's usual noise."""
    deviation: Positive | None = None
    dither: bool = False

    def completed(self, usual: UsualNoise | None) -> Quantization:
        return self if self.step or usual is None else replace(self, step=usual.step)

    @property
    def _size(self) -> float:
        if self.step is None:
            raise UserError(
                "noise.step: is not given for noise=quantization, and the measurement model names"
                " no step of its own; give the step of the read-out in the unit of the readings,"
                " noise.step=X"
            )
        return self.step

    @property
    def true_covariance(self) -> bool:
        return self.deviation is None

    def corrupt(self, h: Array, offset: Array, rng: np.random.Generator) -> Array:
        shift = 0.0
        if self.dither:
            shift = self._size * (rng.random(h.shape) - 0.5)
        return self._size * np.rint((offset + h + shift) / self._size) - offset - shift

    def whitened(self, shape: tuple[int, ...], rng: np.random.Generator) -> Array:
        return (rng.random(shape) - 0.5) / UNIFORM_DEVIATION

    def covariance(self, m: int) -> Covariance:
        return Covariance(np.full(m, self.deviation or self._size * UNIFORM_DEVIATION))


@dataclass(frozen=True)
class Colored(ScaledNoise):
    """Draws stationary autoregressive noise: v_k = correlation v_(k-1) + sqrt(1 - correlation^2)
    deviation e_k.

    The readings are `channels` instruments in turn, each with a series of its own; after `length`
    readings of each the series start anew. GINS has 2 channels (the axes) and a length of 30 (the
    times of a case). `assumed` is what estimators assume: `white`, R = deviation^2 I, which is the
    mistake that the paper warns of; or `full`, the truth.

    Example, in which R decides whether the reported covariance is right:

    >>> import ipe_bench as ib
    >>> lm = {"lm": ib.baselines.LevenbergMarquardt()}
    >>> for assumed in ("white", "full"):
    ...     noise = ib.noise.Colored(0.1, 0.9, assumed=assumed)
    ...     bench = ib.Scenario(ib.measurements.Polynomial(), noise, error_scale=0.1)
    ...     print(assumed, ib.run(bench, lm, trials=100).iloc[-1]["verdict"])
    white overconfident
    full consistent
    """

    correlation: Annotated[float, Gt(-1), Lt(1)] = 0.5
    """The correlation of successive readings of one instrument."""
    channels: Count = 1
    length: Count | None = None
    """Readings per instrument in one series; None: all of them."""
    assumed: Literal["white", "full"] = "white"

    def _series(self, m: int) -> tuple[int, int, int]:
        """Divides m readings: (series after one another, length, channels)."""
        length = m // self.channels if self.length is None else self.length
        if length == 0 or m % (length * self.channels):
            raise UserError(
                f"channels={self.channels}, length={self.length}: {m} readings do not divide into"
                " these"
            )
        return m // (length * self.channels), length, self.channels

    @property
    def true_covariance(self) -> bool:
        return self.assumed == "full" or self.correlation == 0

    def corrupt(self, h: Array, offset: Array, rng: np.random.Generator) -> Array:
        e = rng.standard_normal(self._series(len(h)))
        v = np.empty_like(e)
        v[:, 0] = e[:, 0]
        # Fresh errors make up for what a share of the last one lacks, so that the variance stays.
        fresh = np.sqrt(1 - self.correlation**2)
        for k in range(1, e.shape[1]):
            v[:, k] = self.correlation * v[:, k - 1] + fresh * e[:, k]
        return h + self.stated * v.ravel()

    def covariance(self, m: int) -> Covariance:
        repeats, length, channels = self._series(m)
        if self.assumed == "white":
            return super().covariance(m)
        # Readings k apart of one instrument have the correlation to the power of k.
        apart = np.abs(np.subtract.outer(np.arange(length), np.arange(length)))
        series = np.kron(self.correlation**apart, np.eye(channels))
        R = self.stated**2 * np.kron(np.eye(repeats), series)
        return Covariance(np.linalg.cholesky(R))


@dataclass(frozen=True)
class Correlated(ScaledNoise):
    """Draws Gaussian errors of any covariance R.

    Either `matrix` is R, in squared units of the readings; or readings of one standard deviation
    come in blocks of `block` that follow one another and share an error, such that two of a block
    have the given correlation. `assumed` is what estimators assume: `full`, R itself; or `white`,
    its diagonal.

    Example:

    >>> import numpy as np, ipe_bench as ib
    >>> noise = ib.noise.Correlated(0.01, 0.5, block=2)
    >>> bench = ib.Scenario(ib.measurements.Polynomial(), noise)
    >>> drawn = bench.draw(0, 2000)
    >>> errors = drawn.z - bench.measurement.simulate(drawn.x)
    >>> print(np.corrcoef(errors[:, :3].T).round(1))
    [[1.  0.5 0. ]
     [0.5 1.  0. ]
     [0.  0.  1. ]]
    """

    correlation: Annotated[float, Ge(0), Lt(1)] = 0.5
    """The correlation of two readings of one block."""
    block: Count | None = None
    """Readings per block; None: all are one."""
    matrix: tuple[tuple[float, ...], ...] | None = None
    """R (m, m); where it is given, the three options above play no part."""
    assumed: Literal["white", "full"] = "full"

    def completed(self, usual: UsualNoise | None) -> Correlated:
        return self if self.matrix is not None else super().completed(usual)

    @property
    def true_covariance(self) -> bool:
        return self.assumed == "full"

    def corrupt(self, h: Array, offset: Array, rng: np.random.Generator) -> Array:
        return h + _factor(self, len(h)) @ rng.standard_normal(len(h))

    def covariance(self, m: int) -> Covariance:
        full = Covariance(_factor(self, m))
        return full if self.assumed == "full" else Covariance(full.deviations)


@functools.lru_cache(maxsize=8)
def _factor(noise: Correlated, m: int) -> Array:
    """Computes the lower Cholesky factor (m, m) of R."""
    if noise.matrix is None:
        block = m if noise.block is None else noise.block
        if m % block:
            raise UserError(f"block={block}: {m} readings do not divide into such blocks")
        within = (1 - noise.correlation) * np.eye(block) + noise.correlation
        R = noise.stated**2 * np.kron(np.eye(m // block), within)
    else:
        R = np.array(noise.matrix, dtype=float)
        if R.shape != (m, m) or not np.allclose(R, R.T):
            raise UserError(f"matrix: give a symmetric matrix of {m} x {m} numbers")
    try:
        return np.linalg.cholesky(R)
    except np.linalg.LinAlgError:
        raise UserError("matrix: is not a covariance: it is not positive definite") from None


class _StandIn(Noise):
    """Stands for a noise that draws no errors itself."""

    def corrupt(self, h: Array, offset: Array, rng: np.random.Generator) -> Array:
        raise UserError(f"noise={self.name}: cannot simulate readings; choose another noise")

    def covariance(self, m: int) -> Covariance:
        raise UserError(f"noise={self.name}: has no R; choose another noise")


@dataclass(frozen=True)
class Certified(_StandIn):
    """Takes the readings that come with the measurement model, with its certified answer for the
    truth, and no prior.

    A scenario with it has one trial. R is what the model states of its readings.

    Example:

    >>> import ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Nist("Misra1a"), ib.noise.Certified())
    >>> table = ib.run(bench, {"lm": ib.baselines.LevenbergMarquardt()}, trials=1)
    >>> bool(table.iloc[-1]["success"])
    True
    """

    real = True


@dataclass(frozen=True)
class ModelNoise(_StandIn):
    """Stands for the noise that the measurement model names, with its deviation or step replaced
    where given.

    A scenario never holds it: it holds what it stands for.

    Example:

    >>> import ipe_bench as ib
    >>> print(ib.Scenario(ib.measurements.Gins(), ib.noise.ModelNoise()).noise.name)
    quantization
    """

    name = "model"

    deviation: Positive | tuple[Positive, ...] | None = None
    """Standard deviation of the readings in their unit, or one for each."""
    step: Positive | None = None
    """The step of a read-out that is rounded."""

    def of(self, model: Measurement) -> Noise | None:
        """Returns the noise meant for this model; None where neither the model nor an option says
        what it is."""
        usual = model.usual_noise or UsualNoise()
        step = self.step or usual.step
        if step is not None and not isinstance(self.deviation, tuple):
            return Quantization(step, self.deviation)
        deviation = self.deviation or usual.deviation
        return None if deviation is None else Gaussian(deviation)


def resolved(noise: Noise, model: Measurement) -> Noise:
    """Returns the noise itself, or what it stands for with this model.

    Raises:
        UserError: the model names no noise and none is given.
    """
    if not isinstance(noise, ModelNoise):
        return noise.completed(model.usual_noise)
    own = noise.of(model)
    if own is None:
        raise UserError(
            f"noise: is not given, and measurement={model.name} names no noise of its own; set"
            " noise.deviation=X, the standard deviation of a reading, or choose a noise"
        )
    return own
