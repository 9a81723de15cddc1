"""Defines a scenario: what is measured, how noisily, and what the truth is drawn from. It draws
trials."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ipe_bench.basics.definitions import as_defined
from ipe_bench.basics.errors import UserError, definition
from ipe_bench.basics.linalg import Array, Covariance, read_only
from ipe_bench.basics.options import in_lines
from ipe_bench.basics.streams import numbered
from ipe_bench.measurements.base import Measurement
from ipe_bench.measurements.problem import Problem, require_nominal, require_numbers
from ipe_bench.noise.base import Noise
from ipe_bench.noise.kinds import ModelNoise, resolved
from ipe_bench.priors import GaussianPrior, Prior
from ipe_bench.trials.theory import linear_bound

TRIALS = 1000
"""Number of trials if neither a number nor a precision is given."""
MOST_TRIALS = 100_000
"""Largest number of trials with a precision, if no number is given."""
_PARAMETERS = 0
_NOISE = 1
"""The two random streams of a trial."""
_SEEDS = 1 << 23
"""Seeds there are: seed and trial share one 64-bit number where trials are matched."""


@dataclass(frozen=True)
class Trials:
    """Holds consecutive trials of a scenario: truth x (trials, n) and readings z (trials, m)."""

    start: int
    x: Array
    z: Array
    h: Array | None = None
    """The readings (trials, m) before noise, where they are those of the model that estimators
    assume."""

    @property
    def stop(self) -> int:
        return self.start + len(self.x)


@dataclass(frozen=True)
class Scenario:
    """Determines the trials. `truth` simulates the readings where it differs from what estimators
    assume (a finer step, a richer model); its parameters and readings are those of `measurement`,
    and whatever else acts on the readings is drawn by its `nuisance_deviation`.

    With a noise that is `real` nothing is drawn: the one trial is the readings that come with the
    measurement, and its truth is their certified answer.

    Example:

    >>> import ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Ranging(), ib.noise.Gaussian(0.1), error_scale=10.0)
    >>> drawn = bench.draw(0, 3)
    >>> print(drawn.x.shape, drawn.z.shape)
    (3, 4) (3, 21)
    >>> print(bench.linear_bound.round(4))
    [0.0034 0.0034 0.0068 0.0029]
    """

    measurement: Measurement
    noise: Noise = field(default_factory=ModelNoise)
    """The model's own unless another is given."""
    prior: Prior = field(default_factory=GaussianPrior)
    error_scale: float = 1.0
    """Times the prior's deviations."""
    seed: int = 0
    truth: Measurement | None = None

    __repr__ = in_lines

    def __post_init__(self) -> None:
        for name, kind, example in (
            ("measurement", Measurement, "ib.measurements.Ranging()"),
            ("noise", Noise, "ib.noise.Gaussian(0.1)"),
            ("prior", Prior, "ib.priors.GaussianPrior()"),
        ):
            if not isinstance(getattr(self, name), kind):
                raise UserError(
                    f"{name}: {getattr(self, name)!r:.60} is none; give one such as {example}"
                )
        object.__setattr__(self, "noise", resolved(self.noise, self.measurement))
        if not (np.isfinite(self.error_scale) and self.error_scale > 0):
            raise UserError(f"error_scale={self.error_scale}: give a finite number above 0")
        check_seed(self.seed)
        require_nominal(self.measurement)
        if self.noise.real and self.measurement.recorded is None:
            raise UserError(
                f"noise=certified: measurement={self.measurement.name} comes with no readings of"
                " its own; choose another noise, or measurement=nist"
            )
        if self.truth is not None:
            _check_alike(self.truth, self.measurement)

    @cached_property
    def problem(self) -> Problem:
        """Problem of the estimators."""
        model = self.measurement
        # Where readings are real, nothing was drawn from a prior.
        if self.noise.real and model.recorded is not None:
            return Problem(model, model.recorded.R)
        deviation = self.prior.deviation(model.n, self.error_scale)
        correlation = self.prior.correlation(model.n)
        require_numbers(f"prior={self.prior.name}", self.prior.deviation, deviation, (model.n,))
        R = self.noise.nominal_covariance(model)
        if not isinstance(R, Covariance) or R.m != model.m:
            found = (
                f"a Covariance of {R.m} readings" if isinstance(R, Covariance) else type(R).__name__
            )
            complaint = f"{definition(self.noise.covariance)} returns {found}"
            remedy = f"let it return a Covariance of {model.m} readings"
            raise UserError(f"noise={self.noise.name}: {complaint}; {remedy}")
        return Problem(model, R, deviation, correlation)

    @cached_property
    def linear_bound(self) -> Array:
        """Standard deviations (n,) of eq. (5)."""
        return linear_bound(self.problem)

    @cached_property
    def simulator(self) -> Measurement:
        """The model that the readings come from."""
        return self.measurement if self.truth is None else self.truth

    def truths(self, start: int, stop: int) -> Array:
        """Draws the true parameters (trials, n) of trials start to stop, as `draw` does."""
        return self._drawn(start, stop)[:, : self.simulator.n]

    def draw(self, start: int, stop: int) -> Trials:
        """Draws trials start to stop. Trial t has random streams of its own, so it is the same in
        every block.

        One seed gives the same draws, in units of the error scale, at every error scale.
        """
        return as_defined(self, self._renewed)._draw(start, stop)

    @cached_property
    def _renewed(self) -> dict[str, Scenario]:
        """The scenario without what its models worked out before a cell changed a function of
        theirs."""
        return {}

    def _draw(self, start: int, stop: int) -> Trials:
        recorded = self.measurement.recorded
        if recorded is not None and self.noise.real:
            if (start, stop) != (0, 1):
                raise UserError("noise=certified: has one trial; set trials=1")
            return Trials(0, recorded.x[None], recorded.z[None])
        drawn = self._drawn(start, stop)
        offset = read_only(self.simulator.offset)
        h = self._simulated(drawn)
        z = np.empty((len(drawn), self.simulator.m))
        for row, given, rng in zip(z, h, numbered(self.seed, start, stop, _NOISE), strict=True):
            noisy = self.noise.corrupt(given, offset, rng)
            if type(noisy) is not np.ndarray or noisy.shape != row.shape or noisy.dtype != float:
                require_numbers(f"noise={self.noise.name}", self.noise.corrupt, noisy, row.shape)
            row[:] = noisy
        x = np.ascontiguousarray(drawn[:, : self.simulator.n])
        return Trials(start, x, z, h if self.truth is None else None)

    def error_free(self, start: int, stop: int) -> Array:
        """Computes the readings (trials, m) of trials start to stop before noise is added; those of
        a richer truth with what else acts on them."""
        return self._simulated(self._drawn(start, stop))

    def _simulated(self, drawn: Array) -> Array:
        """Computes the readings (trials, m) at x and nuisances (trials, n + k)."""
        model = self.simulator
        h = model.simulate(read_only(drawn))
        require_numbers(f"measurement={model.name}", model.simulate, h, (len(drawn), model.m))
        return read_only(h)

    def _drawn(self, start: int, stop: int) -> Array:
        """Draws x (trials, n), and behind it the nuisances (trials, k), from each trial's stream of
        parameters."""
        n = self.simulator.n
        deviation = self.simulator.nuisance_deviation
        nominal = read_only(self.simulator.nominal)
        drawn = np.empty((stop - start, n + len(deviation)))
        for row, rng in zip(drawn, numbered(self.seed, start, stop, _PARAMETERS), strict=True):
            x = self.prior.draw(nominal, self.error_scale, rng)
            if type(x) is not np.ndarray or x.shape != (n,):
                require_numbers(f"prior={self.prior.name}", self.prior.draw, x, (n,))
            row[:n] = x
            # After the parameters, from the same stream: a richer truth keeps the parameters of the
            # trial.
            row[n:] = deviation * rng.standard_normal(len(deviation))
        return drawn


def _check_alike(truth: Measurement, model: Measurement) -> None:
    if (truth.n, truth.m) != (model.n, model.m):
        raise UserError(
            f"truth_measurement={truth.name}: has {truth.n} parameters and {truth.m} readings,"
            f" measurement={model.name} has {model.n} and {model.m}; choose a truth with the same"
            " parameters and readings"
        )


def check_seed(seed: int) -> None:
    """Raises UserError unless the seed can be one."""
    if not isinstance(seed, int | np.integer) or not 0 <= seed < _SEEDS:
        raise UserError(f"seed={seed}: give a whole number from 0 to {_SEEDS - 1}")
