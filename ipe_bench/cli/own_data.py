"""Takes times, noise and the estimate from a user's own readings, for a question that simulates
readings like these."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.cli.spec import Spec
from ipe_bench.measurements.known import ParameterInfo, informed
from ipe_bench.noise import Gaussian
from ipe_bench.noise.base import Noise
from ipe_bench.plugins import standard
from ipe_bench.real.fits import Fit

NEAR = 0.1
"""Error scale about an estimate, unless another is given."""


def fitted(spec: Spec, files: Sequence[str], stated: Collection[str]) -> Fit:
    """Fits the model of a job to the readings in files; `stated` are the keys that were typed.

    Raises:
        UserError: no estimate is found, or the model does not fit.
    """
    estimators = standard.constructed({"solver": ("auto",)})
    asked = replace(spec, readings=tuple(files), estimators=estimators)
    fits, _ = asked.question(stated).checked().fitted()
    fit = fits[0]
    if not fit.passes:
        why = "the model does not fit them"
        if not np.isfinite(fit.x).all() or fit.fits is not False:
            why = f"the estimate ended {fit.status.label}"
        raise UserError(
            f"{', '.join(files)}: {why}, so nothing can be simulated like these readings; see"
            " `ipe-bench estimate` with the same words"
        )
    return fit


def noise_of(fit: Fit) -> Gaussian:
    """Returns normal noise of the level that was stated or is estimated."""
    deviations = fit.assumed.R.deviations
    if np.ptp(deviations) == 0.0:
        return Gaussian(float(deviations[0]))
    return Gaussian(tuple(deviations.tolist()))


def like_these(
    spec: Spec, files: Sequence[str], stated: Collection[str], *, at_estimate: bool
) -> tuple[Spec, list[str]]:
    """Returns the job with the columns and noise of these readings, and lines that say what was
    taken; with its truths about the estimate, or about the start."""
    fit = fitted(spec, files, stated)
    model = fit.given.problem.measurement
    noise: Noise = noise_of(fit)
    lines = [f"Noise: normal, {_level(fit)}, as estimated from the readings."]
    if "noise" in stated:
        noise = spec.noise
        lines = []
    scale = spec.error_scale
    if at_estimate:
        names = [p.name for p in model.physical_parameters]
        nominal = [
            ParameterInfo(name, nominal=value)
            for name, value in zip(names, fit.x.tolist(), strict=True)
        ]
        model = informed(model, nominal)
        if "error_scale" not in stated:
            scale = NEAR
        values = ", ".join(f"{name} = {value:.4g}" for name, value in fit.values.items())
        lines.append(f"Truths: about the estimate, {values} (error_scale={scale:g}).")
    else:
        lines.append(
            f"Truths: simulated about the start (error_scale={scale:g}), not the readings of"
            f" {', '.join(files)}."
        )
    return replace(spec, measurement=model, noise=noise, error_scale=scale), lines


def _level(fit: Fit) -> str:
    deviations = fit.assumed.R.deviations
    low = float(deviations.min())
    high = float(deviations.max())
    if low == high:
        return f"standard deviation {low:.3g}"
    return f"standard deviations {low:.3g} to {high:.3g}"
