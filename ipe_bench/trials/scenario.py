"""A scenario: what is measured, how noisily, and what the truth is drawn from. It draws trials, and never estimates."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array, read_only
from ipe_bench.measurements.base import Measurement
from ipe_bench.measurements.problem import Problem, recorded_problem
from ipe_bench.noise.base import Noise
from ipe_bench.noise.own import ModelNoise, resolved
from ipe_bench.priors import GaussianPrior, Prior

_SEEDS = 1 << 23
"""Seeds there are: seed and trial share one 64-bit number where trials are matched."""


@dataclass(frozen=True)
class Trials:
    """Consecutive trials of a scenario: truth x (trials, n) and readings z (trials, m)."""

    start: int
    x: Array
    z: Array

    @property
    def stop(self) -> int:
        return self.start + len(self.x)


@dataclass(frozen=True)
class Scenario:
    """Everything that determines the trials. `truth` simulates the readings where it differs from what estimators
    assume (a finer step, a richer model); its parameters and readings are those of `measurement`, and whatever else
    acts on the readings is drawn by its `nuisance_deviation`.

    With a noise that is `real` nothing is drawn: the one trial is the readings that come with the measurement, and its
    truth is their certified answer.
    """

    measurement: Measurement
    noise: Noise = field(default_factory=ModelNoise)
    """The model's own unless another is given."""
    prior: Prior = field(default_factory=GaussianPrior)
    error_scale: float = 1.0
    """Times the prior's deviations."""
    seed: int = 0
    truth: Measurement | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "noise", resolved(self.noise, self.measurement))
        if not (np.isfinite(self.error_scale) and self.error_scale > 0):
            raise UserError(f"error_scale={self.error_scale}: give a finite number above 0")
        if not 0 <= self.seed < _SEEDS:
            raise UserError(f"seed={self.seed}: give a whole number from 0 to {_SEEDS - 1}")
        if self.noise.real and self.measurement.recorded is None:
            raise UserError(
                f"noise=certified: measurement={self.measurement.name} comes with no readings of its own; choose "
                "another noise, or measurement=nist"
            )
        if self.truth is not None and (self.truth.n, self.truth.m) != (self.measurement.n, self.measurement.m):
            raise UserError(
                f"truth_measurement={self.truth.name}: has {self.truth.n} parameters and {self.truth.m} readings, "
                f"measurement={self.measurement.name} has {self.measurement.n} and {self.measurement.m}; choose a "
                "truth with the same parameters and readings"
            )

    @cached_property
    def problem(self) -> Problem:
        """What the estimators are told."""
        if self.noise.real:
            return recorded_problem(self.measurement)
        model = self.measurement
        deviation, correlation = self.prior.deviation(model.n, self.error_scale), self.prior.correlation(model.n)
        return Problem(model, self.noise.covariance(model.m), deviation, correlation)

    @cached_property
    def simulator(self) -> Measurement:
        """The model that the readings come from."""
        return self.measurement if self.truth is None else self.truth

    def truths(self, start: int, stop: int) -> Array:
        """The true parameters (trials, n) of trials start to stop, as `draw` draws them."""
        nominal = self.simulator.nominal
        draws = (_streams(self.seed, trial)[0] for trial in range(start, stop))
        return np.stack([self.prior.draw(nominal, self.error_scale, rng) for rng in draws])

    def draw(self, start: int, stop: int) -> Trials:
        """Trials start to stop. Trial t has random streams of its own, so it is the same in whatever block it is drawn.

        One seed gives the same draws, in units of the error scale, at every error scale.
        """
        if self.noise.real:
            return _recorded_trial(self.measurement, start, stop)
        model = self.simulator
        streams = [_streams(self.seed, trial) for trial in range(start, stop)]
        x, h = self._without_noise([rng for rng, _ in streams])
        z = np.stack([self.noise.corrupt(h[i], model.offset, rng) for i, (_, rng) in enumerate(streams)])
        return Trials(start, x, z)

    def error_free(self, start: int, stop: int) -> Array:
        """The readings (trials, m) of trials start to stop before noise is added; those of a richer truth with what
        else acts on them."""
        return self._without_noise([_streams(self.seed, trial)[0] for trial in range(start, stop)])[1]

    def _without_noise(self, streams: list[np.random.Generator]) -> tuple[Array, Array]:
        """x (trials, n) and h (trials, m), drawn from each trial's stream of parameters."""
        model = self.simulator
        x = np.stack([self.prior.draw(read_only(model.nominal), self.error_scale, rng) for rng in streams])
        deviation = model.nuisance_deviation
        if not len(deviation):
            return x, model.simulate(read_only(x))
        # After the parameters, from the same stream: a richer truth keeps the parameters of the trial.
        drawn = [deviation * rng.standard_normal(len(deviation)) for rng in streams]
        return x, model.simulate(np.column_stack([x, drawn]))


def _recorded_trial(measurement: Measurement, start: int, stop: int) -> Trials:
    if (start, stop) != (0, 1):
        raise UserError("noise=certified: has one trial; set trials=1")
    assert measurement.recorded is not None
    return Trials(0, measurement.recorded.x[None], measurement.recorded.z[None])


def _streams(seed: int, trial: int) -> tuple[np.random.Generator, np.random.Generator]:
    """Independent random streams for a trial's parameters and for its noise."""
    # The children that SeedSequence(seed, spawn_key=(trial,)).spawn(2) has, without making their parent.
    children = (np.random.SeedSequence(seed, spawn_key=(trial, child)) for child in range(2))
    parameters, noise = (np.random.Generator(np.random.Philox(child)) for child in children)
    return parameters, noise
