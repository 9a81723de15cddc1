"""Estimates parameters from real readings: question -> readings -> model -> noise and prior ->
problem -> fits."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array, finite_or
from ipe_bench.estimators.base import Estimator
from ipe_bench.measurements.base import Measurement
from ipe_bench.measurements.known import ConstrainedModel, ParameterInfo, informed
from ipe_bench.measurements.problem import Problem, require_function
from ipe_bench.noise import Certified, Gaussian, ModelNoise, Noise, Unknown
from ipe_bench.priors import GaussianPrior, Prior
from ipe_bench.real.examination import Examination
from ipe_bench.real.fits import Fit, fit
from ipe_bench.real.readings import SIGMA, Readings, given_readings, open_together
from ipe_bench.real.search import examined
from ipe_bench.trials.scenario import Scenario

_FAR = 10.0
"""Times by which readings are farther from those of the start than any of both reaches, from which
on another start is suggested."""
_ALIKE = 1e-6
"""The share by which slopes differ that shift all readings alike."""


@dataclass(frozen=True, kw_only=True)
class Question:
    """Holds all that is stated about an estimate from real readings."""

    model: Measurement
    readings: tuple[Path, ...] | Array | None
    """Files, or an array z (m,); None: those that come with the model."""
    estimators: Mapping[str, Estimator]
    noise: Noise | None = None
    prior: Prior | None = None
    error_scale: float | None = None
    known: tuple[ParameterInfo, ...] = ()
    ignored: tuple[str, ...] = ()
    """Columns of the files that are left out on purpose."""

    @property
    def has_prior(self) -> bool:
        """Tells whether anything says how far the parameters may lie from the start."""
        deviating = any(one.deviation is not None for one in self.known)
        return deviating or self.prior is not None or self.error_scale is not None

    @cached_property
    def found(self) -> Readings:
        """The readings, of a model with the inputs of the files, and with what is known of
        parameters."""
        model = self.model
        given = self.readings
        if isinstance(given, tuple):
            names = [str(path) for path in given]
            if len(set(names)) < len(names):
                raise UserError(f"readings=[{','.join(names)}]: lists a file twice")
            return open_together(given, model, self.known, self.ignored)
        if self.ignored:
            raise UserError(
                "ignore_columns: are columns of a file; give readings=FILE, or leave them out"
            )
        if given is None:
            if model.recorded is None:
                raise UserError(
                    "readings: is not given; write readings=FILE, or as in"
                    " `ipe-bench estimate oxygen.py oxygen.csv`"
                )
            return Readings(informed(model, self.known), model.recorded.z)
        if given.shape != (model.m,):
            raise UserError(
                f"readings: has shape {given.shape}; give the {model.m} readings of {model.name},"
                " NaN where missing"
            )
        return Readings(informed(model, self.known), given_readings(given))

    @cached_property
    def scenario(self) -> Scenario:
        model = self.found.model
        prior = prior_stated(self.prior or GaussianPrior(), model)
        require_function(model)
        hindrance = model.hindrance(model.nominal)
        if hindrance:
            raise UserError(
                f"measurement={model.name}: cannot be computed where estimation starts: {hindrance}"
            )
        error_scale = 1.0 if self.error_scale is None else self.error_scale
        scenario = Scenario(model, self._noise(), prior, error_scale)
        noise = scenario.noise
        there = int(np.isfinite(self.found.z).sum())
        # Several levels say themselves which of them has too few readings.
        if noise.estimated and there <= model.n and noise.levels_of(model) is None:
            raise UserError(
                f"readings: {there} for {model.n} parameters leave no degree of freedom to estimate"
                " the noise; state noise=gaussian noise.deviation=X"
            )
        return scenario

    @cached_property
    def problem(self) -> Problem:
        """The problem that estimators are given, with a prior only if one is stated."""
        return self.scenario.problem if self.has_prior else self.scenario.problem.without_prior()

    def checked(self) -> Question:
        """Checks that this question can be answered, and returns it.

        Raises:
            UserError: a file does not hold the model's readings, or an estimator needs what is not
                stated.
        """
        scenario = self.scenario
        if not self.estimators:
            raise UserError("there is no estimator; choose with solver= and baseline=")
        lacking = []
        for label, estimator in self.estimators.items():
            why = estimator.hindrance(scenario.problem)
            if why:
                lacking.append(f"estimators.{label}: {why}; leave it out")
            elif estimator.hindrance(self.problem):
                lacking.append(
                    f"estimators.{label}: needs a prior, which is not stated; give error_scale=X,"
                    " the standard deviation of the parameters in multiples of their sizes"
                )
        if lacking:
            raise UserError("; ".join(lacking))
        return self

    def fitted(
        self, watch: Callable[[str], object] = str, *, examine: bool = True
    ) -> tuple[list[Fit], Examination | None]:
        """Fits every estimator, whose label `watch` is called with before, and examines the least
        minimum, unless told not to."""
        noise = self.scenario.noise
        fits = fit(self.problem, self.found.z, self.estimators, noise, watch)
        if not examine:
            return fits, None
        return examined(self.problem, self.found.z, fits, noise)

    def _noise(self) -> Noise:
        """Returns the stated noise, or that of a file's column, or the model's own; else its level
        is unknown."""
        found = self.found
        stated = self.noise.of(found.model) if isinstance(self.noise, ModelNoise) else self.noise
        if self.readings is None and stated is None:
            return Certified()
        if found.deviations is None:
            return stated or ModelNoise().of(found.model) or Unknown()
        deviations = tuple(finite_or(1.0, found.deviations).tolist())
        if isinstance(stated, Unknown):
            return replace(stated, weights=deviations)
        if stated is not None:
            raise UserError(
                f"noise: is given, and the readings have a column {SIGMA}, too; leave one of them"
                " out, or set noise=unknown to take the column for relative weights"
            )
        return Gaussian(deviations)


def nearer_starts(model: Measurement, z: Array) -> dict[str, float]:
    """Finds starts, each of one parameter that shifts all readings alike, from which the model's
    readings are of the size of z (m,); none unless those of the start are far from it."""
    if not hasattr(getattr(model, "whole", model), "start"):
        return {}
    there = z[np.isfinite(z)]
    x = model.nominal[None]
    with np.errstate(all="ignore"):
        h = model.simulate(x)[0]
        J = model.jacobian(x)[0]
    gap = float(np.median(there)) - float(np.median(h))
    if not abs(gap) > _FAR * max(np.abs(h).max(), np.ptp(there)):
        return {}
    found = {}
    for k, p in enumerate(model.physical_parameters):
        slopes = J[:, k]
        if slopes[0] and np.ptp(slopes) <= _ALIKE * abs(slopes[0]):
            nearer = x.copy()
            nearer[0, k] += gap / slopes[0]
            found[p.name] = float(model.physical(nearer)[0, k])
    return found


def prior_stated(prior: Prior, model: Measurement) -> Prior:
    """Returns the prior with the standard deviations that are known of single parameters.

    Raises:
        UserError: it cannot be told of single parameters, or has another number of them.
    """
    if not isinstance(model, ConstrainedModel):
        return prior
    if not isinstance(prior, GaussianPrior):
        raise UserError(
            f"parameters: needs prior=gaussian, which takes a deviation of each; prior={prior.name}"
            " does not"
        )
    if prior.deviations is None:
        return replace(prior, deviations=model.prior_deviations)
    names = [p.name for p in model.whole.parameters]
    if len(prior.deviations) != len(names):
        raise UserError(
            f"prior.deviations: has {len(prior.deviations)} numbers; give one for each of"
            f" {len(names)} parameters"
        )
    general = dict(zip(names, prior.deviations, strict=True))
    own = {one.name for one in model.known if one.deviation is not None}
    known = zip(model.physical_parameters, model.prior_deviations, strict=True)
    deviations = (d if p.name in own else general[p.name] for p, d in known)
    return replace(prior, deviations=tuple(deviations))
