"""Figures of estimates from readings: residuals, covariance ellipses, and posteriors."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations, product
from typing import Any

import numpy as np
from scipy.special import chdtri

from ipe_bench.basics.linalg import Array
from ipe_bench.basics.statuses import Status
from ipe_bench.measurements.base import Measurement
from ipe_bench.real.fits import Fit
from ipe_bench.real.residuals import LEAST_P
from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.style import BOUND_COLOR, Look, looks
from ipe_bench.report.words import p_value
from ipe_bench.trials.posterior import Reference

MOST_ESTIMATORS = 12
"""Estimators with a panel of residuals; `residuals.csv` has all."""
MOST_PAIRS = 9
LEVEL = 0.95
_MANY = 5000
"""Points from which on they are pixels in the PDF, too."""
_BENT = 30.0
"""Normalised residuals beyond this are drawn on a logarithmic axis: a model that does not fit at all."""
_NEAR = 10.0
"""Ellipses whose centres lie within so many deviations of the best fit's are in view."""
MOST_CORNERS = 12
"""Parameters in the picture of a posterior: if there are more, those in which estimators differ most from it."""
_VIEW = 5.0
"""Standard deviations of the posterior to either side of its mean."""
_DRAWS = 2000
_DRAW_COLOR = "#9a9a9a"


def draw_residuals(model: Measurement, fits: Sequence[Fit]) -> Iterator[Drawing]:
    """A panel of normalised residuals for each estimator."""
    import seaborn as sns
    from matplotlib.ticker import MaxNLocator

    shown = [one for one in fits if np.isfinite(one.normalised).any()][:MOST_ESTIMATORS]
    if not shown:
        return
    x, heading = _abscissa(model)
    look, limit = looks([one.label for one in fits]), shown[0].outlier_limit
    fig, axes = common.panels(len(shown), height=2.6)
    for one, ax in zip(shown, axes, strict=True):
        r, out = one.normalised, one.outliers
        ax.axhline(0.0, color=BOUND_COLOR, linewidth=0.6, zorder=1)
        common.bound_line(ax, limit, "limit for outliers")
        common.bound_line(ax, -limit, "")
        good, style = np.isfinite(r) & ~out, {"color": look[one.label].color, "legend": False, "ax": ax}
        sns.scatterplot(x=x[good], y=r[good], s=9, alpha=0.75, linewidth=0, rasterized=len(x) > _MANY, **style)
        if out.any():
            sns.scatterplot(x=x[out], y=r[out], s=25, marker="x", linewidth=1.2, label="outlier", **style)
        edge = 1.15 * max(float(np.nanmax(np.abs(r))), limit)
        ax.set_ylim(-edge, edge)
        if edge > _BENT:
            ax.set_yscale("symlog", linthresh=10.0, linscale=1.0)
        else:
            ax.yaxis.set_major_locator(MaxNLocator(7, integer=True))
        ax.xaxis.set_major_locator(MaxNLocator(6, integer=heading == "reading"))
        tests = f"fit p {p_value(one.p_value)}, white p {p_value(one.whiteness.p_value, LEAST_P)}"
        ax.set_title(f"{common.text(one.label)}\n{tests}")
    common.axis_labels(fig, common.text(heading), "residual / its deviation")
    common.legend(fig, axes)
    parts = [f"{one.label} {int(one.outliers.sum())}" for one in shown]
    caption = common.sentence(
        "Normalised residuals of the readings; each is standard normal if the model and the noise are right."
        f" Beyond ±{limit:.2f} a reading is an outlier: {common.enumerate_few(parts, 12)}."
        " p is that of chi-square, white that of the Ljung-Box test.",
        f"{len(fits) - len(shown)} further estimators: see residuals.csv." * (len(fits) > len(shown)),
    )
    yield Drawing("residuals", "Residuals", caption, fig)


def _abscissa(model: Measurement) -> tuple[Array, str]:
    """Where each reading (m,) stands along the axis: at its time if there is such a column, else in its row."""
    for name, column in model.index.items():
        values = np.asarray(column)
        several = 3 * len(set(column)) < model.m  # many readings at one number, such as a case's
        if np.issubdtype(values.dtype, np.number) and not several and (np.diff(values) >= 0).all():
            return values.astype(float), name
    return np.arange(1.0, model.m + 1), "reading"


def ellipse(P: Array, edge: float = float(chdtri(2, 1 - LEVEL))) -> Array:
    """The boundary (181, 2) at the squared distance `edge` in deviations of covariance P (2, 2): of the region about
    zero in which an error lies with 95 % probability, unless P is itself estimated."""
    # Scaled first: the parameters' units must not decide what is singular.
    d = np.sqrt(np.diagonal(P))
    values, vectors = np.linalg.eigh(P / np.outer(d, d))
    turn = np.linspace(0.0, 2 * np.pi, 181)
    circle = np.sqrt(edge) * np.column_stack([np.cos(turn), np.sin(turn)])
    return (circle * np.sqrt(np.maximum(values, 0.0))) @ vectors.T * d


def draw_ellipses(model: Measurement, fits: Sequence[Fit]) -> Iterator[Drawing]:
    """A panel with the estimators' covariance ellipses for each of the most correlated pairs of parameters."""
    from matplotlib.ticker import MaxNLocator

    # Where an estimator did not converge, its covariance says nothing of the true values.
    converged = [f for f in fits if f.status is Status.CONVERGED and (f.standard_errors > 0).all()]
    if not converged or model.n < 2:
        return
    best = min(converged, key=lambda f: f.chi_square)
    # The pairs by falling magnitude of correlation.
    every = sorted(combinations(range(model.n), 2), key=lambda pair: -np.nan_to_num(abs(best.correlation[pair])))
    pairs, look = every[:MOST_PAIRS], looks([one.label for one in fits])
    fig, axes = common.panels(len(pairs), look)
    for (i, j), ax in zip(pairs, axes, strict=True):
        pair = [i, j]
        near = [f for f in converged if (np.abs(f.x - best.x) <= _NEAR * best.standard_errors)[pair].all()]
        for one, linewidth in zip(near, np.linspace(4.0 if len(near) > 1 else 1.6, 1.0, len(near)), strict=True):
            centre, line = one.x[pair] - best.x[pair], look[one.label].line
            outline = centre + ellipse(one.covariance[np.ix_(pair, pair)], edge=one.region(2, LEVEL))
            ax.plot(*outline.T, **line | {"marker": "", "linewidth": linewidth})
            ax.plot(*centre, label=common.text(one.label), **line)
        ax.xaxis.set_major_locator(MaxNLocator(4))
        ax.yaxis.set_major_locator(MaxNLocator(5))
        ax.ticklabel_format(style="sci", scilimits=(-3, 4), useMathText=True)
        about = [f" {'+' if best.x[k] < 0 else '−'} {abs(best.x[k]):.5g}" for k in pair]
        ax.set(xlabel=_axis_words(model, i, about[0]), ylabel=_axis_words(model, j, about[1]))
        ax.set_title(f"correlation {best.correlation[i, j]:.3f}".replace("-", "−"))
    common.legend(fig, axes)
    which = "each pair of parameters"
    if len(every) > len(pairs):
        which = f"the {len(pairs)} most correlated of {len(every)} pairs"
    caption = (
        f"Regions that hold the true values with {LEVEL:.0%} probability if the model and the noise are right, for"
        f" {which}, about the estimates of {best.label}. Equal regions are drawn with narrower lines on top of each"
        f" other; a region more than {_NEAR:g} standard deviations away is not drawn."
    )
    yield Drawing("ellipses", "Covariance ellipses", caption, fig)


def _axis_words(model: Measurement, k: int, more: str = "") -> str:
    parameter = model.physical_parameters[k]
    return common.text(f"{parameter.name}{more}{f' [{parameter.unit}]' if parameter.unit else ''}")


def draw_corner(model: Measurement, one: Reference) -> Drawing:
    """Draws of a trial's posterior and the estimators' Gaussians, in standard deviations about its mean."""
    from matplotlib.figure import Figure

    mean, d = one.posterior.mean, one.posterior.deviation
    off = [np.abs(e.x[0] - mean) / d for e in one.estimates.values()]
    worst = np.nan_to_num(np.max([np.zeros(len(d)), *off], axis=0), nan=np.inf)
    shown = sorted(np.argsort(-worst, kind="stable")[:MOST_CORNERS].tolist())
    look, k = looks(list(one.estimates)), len(shown)
    names = [common.text(p.name) for p in model.parameters]
    draws = (one.posterior.x[:: -(-len(one.posterior.x) // _DRAWS)] - mean) / d
    truth, modes = (one.truth - mean) / d, (one.posterior.modes - mean) / d
    fig = Figure(figsize=(1.6 + 0.85 * k, 1.8 + 0.85 * k), layout="constrained")
    axes = fig.subplots(k, k, squeeze=False, sharex=True)
    for (row, i), (column, j) in product(enumerate(shown), repeat=2):
        ax = axes[row, column]
        ax.grid(False)
        ax.tick_params(labelsize=6)
        if column > row:
            ax.set_axis_off()
        elif column == row:
            ax.hist(draws[:, i], bins=np.linspace(-_VIEW, _VIEW, 41), density=True, color=_DRAW_COLOR, linewidth=0)
            ax.axvline(truth[i], color="black", linewidth=0.7)
            ax.set(xlim=(-_VIEW, _VIEW), ylim=(0, 0.75), yticks=[])
            ax.set_title(names[i], fontsize=8, pad=4)
        else:
            ax.scatter(*draws[:, [j, i]].T, s=1.2, color=_DRAW_COLOR, linewidth=0, alpha=0.6, rasterized=True)
            if len(modes) > 1:
                ax.plot(*modes[:, [j, i]].T, linestyle="none", marker="x", color="#C00000", markersize=4)
            ax.plot(truth[j], truth[i], linestyle="none", marker="+", color="black", markersize=6)
            ax.set(ylim=(-_VIEW, _VIEW), yticks=[-4, 0, 4] if column == 0 else [])
        for label in one.estimates if column <= row else ():
            _estimate(ax, one, label, look[label], [i] if row == column else [j, i])
        axes[-1, column].set_xlabel(names[j], fontsize=8)
        if row > 0:
            axes[row, 0].set_ylabel(names[i], fontsize=8)
    fig.supxlabel("deviations of the posterior about its mean", fontsize=8)
    axes[0, 0].plot([], [], linestyle="none", marker="o", markersize=4, color=_DRAW_COLOR, label="posterior")
    axes[0, 0].plot([], [], linestyle="none", marker="+", markersize=7, color="black", label="truth")
    common.legend(fig, [axes[0, 0]], {label: Look(look[label].color, "", look[label].dash) for label in look})
    told = [f"{label} {d.kl:.3g}" for label, d in one.divergences.items() if np.isfinite(d.kl)]
    caption = common.sentence(
        f"Draws of the posterior of trial {one.trial} of {model.name}, and the 95 % ellipses that estimators report, in"
        f" standard deviations of the posterior about its mean; the view ends at {_VIEW:g} of them.",
        f"Divergence in nats: {common.enumerate_few(told, 12)}." if told else "",
        f"{len(modes)} modes, crossed." if len(modes) > 1 else "",
        f"The {k} parameters in which estimators are farthest off." if k < model.n else "",
    )
    return Drawing(f"corner_{one.trial}", f"Posterior of trial {one.trial}", caption, fig)


def _estimate(ax: Any, one: Reference, label: str, look: Look, which: list[int]) -> None:
    """An estimator's Gaussian: its density of one parameter or its 95 % ellipse of two, if it reports a covariance."""
    d, estimates = one.posterior.deviation[which], one.estimates[label]
    centre = (estimates.x[0][which] - one.posterior.mean[which]) / d
    style = {"color": look.color, "linestyle": look.line["linestyle"], "linewidth": 1.0}
    P = None if estimates.covariance is None else estimates.covariance[0][np.ix_(which, which)] / np.outer(d, d)
    if P is None or not np.isfinite(P).all() or not np.isfinite(centre).all():
        if len(which) == 2:
            ax.plot(*centre, color=look.color, marker=look.marker, markersize=3)
    elif len(which) == 2:
        ax.plot(*(centre + ellipse(P)).T, **style)
    else:
        x = np.linspace(-_VIEW, _VIEW, 201)
        ax.plot(x, np.exp(-0.5 * (x - centre[0]) ** 2 / P[0, 0]) / np.sqrt(2 * np.pi * P[0, 0]), **style)
