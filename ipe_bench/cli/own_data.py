"""Takes times, noise and the estimate from a user's own readings, for a question that simulates
readings like these."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.cli.spec import Spec
from ipe_bench.measurements.base import SubsetModel
from ipe_bench.measurements.known import ConstrainedModel
from ipe_bench.noise import Colored, Correlated, Gaussian
from ipe_bench.noise.base import Noise
from ipe_bench.plugins import standard
from ipe_bench.questions.own.maths import require_answer
from ipe_bench.real.estimation import Question
from ipe_bench.real.fits import Fit
from ipe_bench.report.words import from_to

NEAR = 0.1
"""Error scale about an estimate, unless another is given."""


def question_on(spec: Spec, files: Sequence[str], stated: Collection[str]) -> Question:
    """Returns the question on the readings in files that `auto` answers; `stated` are the keys that
    were typed."""
    estimators = standard.constructed({"solver": ("auto",)})
    asked = replace(spec, readings=tuple(files), estimators=estimators)
    return asked.question(stated).checked()


def noise_of(fit: Fit) -> Noise:
    """Returns the noise that was stated, or normal noise of the level that is estimated, of the
    readings that are present.

    Raises:
        UserError: readings are missing among correlated errors.
    """
    noise = fit.given.noise
    R = fit.assumed.R
    if not noise.estimated and not isinstance(noise, Gaussian):
        correlated = isinstance(noise, Colored | Correlated) or R.factor.ndim > 1
        if correlated and len(fit.given.rows) < fit.given.model.m:
            raise UserError(
                f"noise={noise.name}: is correlated, and readings are missing, which is not"
                " simulated; remove their rows, or choose another noise"
            )
        return noise
    deviations = R.deviations
    if np.ptp(deviations) == 0.0:
        return Gaussian(float(deviations[0]))
    return Gaussian(tuple(deviations.tolist()))


def like_these(
    spec: Spec, files: Sequence[str], stated: Collection[str], *, at_estimate: bool
) -> tuple[Spec, list[str]]:
    """Returns the job with the columns and noise of these readings, and lines that say what was
    taken; with its truths about the estimate, or about the start.

    Raises:
        UserError: nothing can be simulated like these readings.
    """
    fits, _ = question_on(spec, files, stated).fitted()
    fit = fits[0]
    require_answer(fit)
    model = fit.given.model
    if isinstance(model, ConstrainedModel):
        # What is known of parameters is a key of the job, which goes on.
        model = model.whole
    if len(fit.given.rows) < model.m:
        model = SubsetModel(model, tuple(fit.given.rows.tolist()))
    noise = noise_of(fit)
    law = "normal" if isinstance(noise, Gaussian) else noise.name
    lines = []
    if fit.given.noise.estimated:
        lines.append(f"Noise: {law}, {_level(fit)}, as estimated from the readings.")
    elif "noise" not in stated:
        lines.append(f"Noise: {law}, {_level(fit)}, as stated.")
    scale = spec.error_scale
    known = dict(spec.parameters or {})
    if not at_estimate:
        lines.append(
            f"Truths: simulated about the start (error_scale={scale:g}), not the readings of"
            f" {', '.join(files)}."
        )
        return replace(spec, measurement=model, noise=noise), lines
    if "error_scale" not in stated:
        scale = NEAR
    names = [p.name for p in fit.given.model.physical_parameters]
    # Several levels of the noise stand behind the parameters.
    found = dict(zip(names, fit.x[: len(names)].tolist(), strict=True))
    for name, value in found.items():
        known[name] = {**known.get(name, {}), "nominal": value}
    values = ", ".join(f"{name} = {value:.4g}" for name, value in found.items())
    lines.append(f"Truths: about the estimate, {values} (error_scale={scale:g}).")
    there = replace(spec, measurement=model, noise=noise, error_scale=scale, parameters=known)
    return there, lines


def _level(fit: Fit) -> str:
    deviations = fit.assumed.R.deviations
    noun = "standard deviation" if np.ptp(deviations) == 0.0 else "standard deviations"
    return f"{noun} {from_to(deviations.tolist(), '{:.3g}'.format)}"
