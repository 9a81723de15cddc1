"""Draws marginals of a posterior beside the Gaussians of estimators."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ipe_bench.basics.linalg import deviations
from ipe_bench.measurements.base import with_unit
from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.figures.views import looks_of
from ipe_bench.report.style import BOUND_COLOR

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ipe_bench.basics.linalg import Array
    from ipe_bench.estimators.base import Estimates
    from ipe_bench.measurements.base import Measurement
    from ipe_bench.questions.posterior.maths import Posterior, Reference
    from ipe_bench.report.style import Look


FARTHEST = 4.5
"""Standard deviations about the middle that a distribution is drawn to."""


MARKED_EVERY = 50
"""Points of a curve from one of its markers to the next."""


class _Gaussian(NamedTuple):
    x: Array
    """(n,)"""
    deviation: Array
    """(n,), NaN where none is reported."""


def draw_marginals(model: Measurement, found: Sequence[Reference]) -> Iterator[Drawing]:
    """Draws marginals of the first trial's posterior beside the Gaussians of estimators, the worst
    parameters."""
    one = found[0]
    look = looks_of(one.estimators)
    claims = {label: _claimed(each) for label, each in one.estimates.items()}
    chosen = _worst(one.posterior, claims.values())
    fig, axes = common.panels(len(chosen), look, height=2.4)
    for i, ax in zip(chosen, axes, strict=True):
        p = model.parameters[i]
        low, high = _ends(one.posterior, i, p.size)
        draws = p.size * one.posterior.x[:, i]
        style = {"color": BOUND_COLOR, "alpha": 0.25, "label": "posterior"}
        ax.hist(draws, bins=40, range=(low, high), density=True, **style)
        at = np.linspace(low, high, 300)
        for first, (label, claim) in enumerate(claims.items()):
            gaussian = p.size * claim.x[i], p.size * claim.deviation[i]
            _draw_density(ax, at, *gaussian, look[label], MARKED_EVERY * first // len(claims))
        ax.axvline(p.size * one.truth[i], color=BOUND_COLOR, linestyle=":", label="truth")
        ax.set_xlim(low, high)
        ax.set_yticks([])
        common.full_ticks(ax)
    named = [model.parameters[i] for i in chosen]
    common.titles(axes, [with_unit(p.name, p.unit) for p in named])
    common.legend(fig, axes, look)
    caption = f"Trial {one.trial}: draws of the posterior, and the Gaussians that estimators report"
    if len(chosen) < model.n:
        caption += f", the {len(chosen)} parameters in which they differ most"
    yield Drawing("posterior", "Marginals", f"{caption}.", fig)


def _claimed(estimates: Estimates) -> _Gaussian:
    x = estimates.x[0]
    if estimates.covariance is None:
        return _Gaussian(x, np.full(len(x), np.nan))
    return _Gaussian(x, deviations(estimates.covariance[0]))


def _worst(posterior: Posterior, claims: Iterable[_Gaussian]) -> Array:
    """Finds the parameters in which an estimator's Gaussian is farthest from the posterior, as many
    as there are panels: by the difference of means, and of logarithms of the deviations."""
    apart = [np.zeros(len(posterior.mean))]
    with np.errstate(all="ignore"):
        for claim in claims:
            shift = np.abs(claim.x - posterior.mean) / posterior.deviation
            width = np.abs(np.log(claim.deviation / posterior.deviation))
            apart.append(shift + width)
    farthest = np.nan_to_num(np.max(apart, axis=0), nan=np.inf)
    order = np.argsort(-farthest, kind="stable")
    return np.sort(order[: common.most_panels()])


def _ends(posterior: Posterior, i: int, size: float) -> tuple[float, float]:
    """Returns the ends of the axis of a parameter, in its unit."""
    reach = FARTHEST * posterior.deviation[i]
    return size * (posterior.mean[i] - reach), size * (posterior.mean[i] + reach)


def _draw_density(ax: Axes, at: Array, x: float, deviation: float, look: Look, first: int) -> None:
    """Draws the density of a Gaussian, if it has one, with markers from place `first` on."""
    if deviation > 0 and np.isfinite(x):
        area = deviation * np.sqrt(2 * np.pi)
        density = np.exp(-0.5 * ((at - x) / deviation) ** 2)
        ax.plot(at, density / area, markevery=(first, MARKED_EVERY), **look.line)
