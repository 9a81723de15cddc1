"""The corner picture of a posterior: every pair of parameters, with the estimators' ellipses."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from ipe_bench.measurements.base import Measurement
from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.figures.readings import ellipse
from ipe_bench.report.style import Look, house_style, looks
from ipe_bench.trials.posterior import Reference

MOST_PARAMETERS = 12
"""Parameters in a picture: if there are more, those in which estimators differ most from the posterior."""
_VIEW = 5.0
"""Standard deviations of the posterior to either side of its mean."""
_DRAWS = 2000
_DRAW_COLOR = "#9a9a9a"


def draw_corners(model: Measurement, found: Sequence[Reference]) -> Iterator[Drawing]:
    """A picture for each trial."""
    with house_style():
        for one in found:
            yield _corner(model, one)


def _corner(model: Measurement, one: Reference) -> Drawing:
    """Everything in standard deviations of the posterior about its mean."""
    mean, d = one.posterior.mean, one.posterior.deviation
    off = [np.abs(e.x[0] - mean) / d for e in one.estimates.values()]
    worst = np.nan_to_num(np.max([np.zeros(len(d)), *off], axis=0), nan=np.inf)
    shown = sorted(np.argsort(-worst, kind="stable")[:MOST_PARAMETERS].tolist())
    look, k = looks(list(one.estimates)), len(shown)
    names = [common.text(p.name) for p in model.parameters]
    draws = (one.posterior.x - mean) / d
    draws = draws[np.linspace(0, len(draws) - 1, min(_DRAWS, len(draws))).round().astype(int)]
    truth, modes = (one.truth - mean) / d, (one.posterior.modes - mean) / d
    fig = common.figure(1.6 + 0.85 * k, 1.8 + 0.85 * k)
    axes = fig.subplots(k, k, squeeze=False, sharex=True)
    for row, i in enumerate(shown):
        for column, j in enumerate(shown):
            ax = axes[row, column]
            ax.grid(False)
            ax.tick_params(labelsize=6)
            if column > row:
                ax.set_axis_off()
                continue
            if column == row:
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
            for label in one.estimates:
                _estimate(ax, one, label, look[label], [i] if row == column else [j, i])
        axes[-1, row].set_xlabel(names[i], fontsize=8)
        if row > 0:
            axes[row, 0].set_ylabel(names[i], fontsize=8)
    fig.supxlabel("deviations of the posterior about its mean", fontsize=8)
    axes[0, 0].plot([], [], linestyle="none", marker="o", markersize=4, color=_DRAW_COLOR, label="posterior")
    axes[0, 0].plot([], [], linestyle="none", marker="+", markersize=7, color="black", label="truth")
    common.legend(fig, [axes[0, 0]], {label: Look(look[label].color, "", look[label].dash) for label in look})
    told = [f"{label} {d.kl:.3g}" for label, d in one.divergences.items() if np.isfinite(d.kl)]
    caption = common.sentence(
        f"Draws of the posterior of trial {one.trial} of {model.name}, and the 95 % ellipses that estimators report, in"
        f" deviations of the posterior about its mean; what is more than {_VIEW:g} of them off is not in view.",
        f"Divergence in nats: {common.enumerate_few(told, 12)}." if told else "",
        f"{len(modes)} modes, crossed." if len(modes) > 1 else "",
        f"The {k} parameters in which estimators are farthest off." if k < model.n else "",
        "" if one.posterior.settled else "The populations of particles do not agree: give more.",
    )
    return Drawing(f"corner_{one.trial}", f"Posterior of trial {one.trial}", caption, fig)


def _estimate(ax: Any, one: Reference, label: str, look: Look, which: list[int]) -> None:
    """An estimator's Gaussian: its density of one parameter, its 95 % ellipse of two, or its estimate alone."""
    d, estimates = one.posterior.deviation[which], one.estimates[label]
    centre = (estimates.x[0][which] - one.posterior.mean[which]) / d
    P = np.full((len(d), len(d)), np.nan)
    if estimates.covariance is not None:
        P = estimates.covariance[0][np.ix_(which, which)] / np.outer(d, d)
    style = {"color": look.color, "linestyle": look.line["linestyle"], "linewidth": 1.0}
    if np.isfinite(P).all() and np.isfinite(centre).all() and np.linalg.eigvalsh(P)[0] > 0:
        if len(which) == 1:
            x = np.linspace(-_VIEW, _VIEW, 201)
            ax.plot(x, np.exp(-0.5 * (x - centre[0]) ** 2 / P[0, 0]) / np.sqrt(2 * np.pi * P[0, 0]), **style)
        else:
            ax.plot(*(centre + ellipse(P)).T, **style)
    elif len(which) == 2 and np.isfinite(centre).all():
        ax.plot(*centre, color=look.color, marker=look.marker, markersize=3)
