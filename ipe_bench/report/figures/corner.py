"""The corner picture of a posterior: every pair of parameters, with the estimators' ellipses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.special import chdtri

from ipe_bench.basics.linalg import Array
from ipe_bench.measurements.base import Measurement
from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.style import Look, house_style, looks
from ipe_bench.trials.posterior import Reference

MOST_PARAMETERS = 12
"""Parameters in a picture: those in which estimators differ most from the posterior, where there are more."""
_VIEW = 5.0
"""Deviations of the posterior to either side of its mean."""
_DRAWS = 2000
_DRAW_COLOR = "#9a9a9a"


def draw_corners(model: Measurement, found: Sequence[Reference]) -> Iterator[Drawing]:
    """A picture for each trial."""
    with house_style():
        for one in found:
            yield _corner(model, one)


def _corner(model: Measurement, one: Reference) -> Drawing:
    sampled = one.posterior
    shown = _shown(one)
    look = looks(list(one.estimates))
    k = len(shown)
    fig = common.figure(1.6 + 0.85 * k, 1.8 + 0.85 * k)
    axes = fig.subplots(k, k, squeeze=False)
    draws = (sampled.x - sampled.mean) / sampled.deviation
    draws = draws[np.linspace(0, len(draws) - 1, min(_DRAWS, len(draws))).round().astype(int)]
    gaussians = {label: _scaled(one, label) for label in one.estimates}
    truth = (one.truth - sampled.mean) / sampled.deviation
    modes = (sampled.modes - sampled.mean) / sampled.deviation
    for row, i in enumerate(shown):
        for column, j in enumerate(shown):
            ax = axes[row, column]
            if column > row:
                ax.set_axis_off()
            elif column == row:
                _margin(ax, draws[:, i], truth[i], gaussians, look, i)
            else:
                _pair(ax, draws[:, [j, i]], truth[[j, i]], modes[:, [j, i]], gaussians, look, (j, i))
            _dress(ax, row, column, k, common.text(model.parameters[i].name), common.text(model.parameters[j].name))
    _legend(fig, axes[0, -1], look)
    return Drawing(f"corner_{one.trial}", f"Posterior of trial {one.trial}", _caption(model, one, k), fig)


def _shown(one: Reference) -> list[int]:
    n = one.posterior.x.shape[1]
    if n <= MOST_PARAMETERS:
        return list(range(n))
    off = [np.abs(e.x[0] - one.posterior.mean) / one.posterior.deviation for e in one.estimates.values()]
    worst = np.nan_to_num(np.max(off, axis=0), nan=np.inf)
    return sorted(np.argsort(-worst, kind="stable")[:MOST_PARAMETERS].tolist())


def _scaled(one: Reference, label: str) -> tuple[Array, Array | None]:
    """An estimator's mean and covariance in the posterior's deviations."""
    estimates, d = one.estimates[label], one.posterior.deviation
    P = None if estimates.covariance is None else estimates.covariance[0] / np.outer(d, d)
    return (estimates.x[0] - one.posterior.mean) / d, P


def _margin(
    ax: Any, draws: Array, truth: float, gaussians: Mapping[str, Any], look: Mapping[str, Look], i: int
) -> None:
    ax.hist(draws, bins=np.linspace(-_VIEW, _VIEW, 41), density=True, color=_DRAW_COLOR, linewidth=0)
    x = np.linspace(-_VIEW, _VIEW, 201)
    for label, (mean, P) in gaussians.items():
        if P is not None and np.isfinite(P[i, i]) and P[i, i] > 0 and np.isfinite(mean[i]):
            curve = np.exp(-0.5 * (x - mean[i]) ** 2 / P[i, i]) / np.sqrt(2 * np.pi * P[i, i])
            ax.plot(x, curve, color=look[label].color, linestyle=look[label].linestyle, linewidth=1.0)
    if abs(truth) < _VIEW:
        ax.axvline(truth, color="black", linewidth=0.7)
    ax.set_ylim(0, 0.75)


def _pair(
    ax: Any,
    draws: Array,
    truth: Array,
    modes: Array,
    gaussians: Mapping[str, Any],
    look: Mapping[str, Look],
    which: tuple[int, int],
) -> None:
    ax.scatter(*draws.T, s=1.2, color=_DRAW_COLOR, linewidth=0, alpha=0.6, rasterized=True)
    turn = np.linspace(0, 2 * np.pi, 81)
    circle = np.sqrt(chdtri(2, 0.05)) * np.stack([np.cos(turn), np.sin(turn)])
    for label, (mean, P) in gaussians.items():
        centre = mean[list(which)]
        block = None if P is None else P[np.ix_(which, which)]
        if block is not None and np.isfinite(block).all() and np.linalg.eigvalsh(block)[0] > 0:
            ellipse = centre[:, None] + np.linalg.cholesky(block) @ circle
            ax.plot(*ellipse, color=look[label].color, linestyle=look[label].linestyle, linewidth=1.0)
        elif np.isfinite(centre).all():
            ax.plot(*centre, color=look[label].color, marker=look[label].marker, markersize=3)
    if len(modes) > 1:
        ax.plot(*modes.T, linestyle="none", marker="x", color="#C00000", markersize=4)
    ax.plot(*truth, linestyle="none", marker="+", color="black", markersize=6)
    ax.set_ylim(-_VIEW, _VIEW)


def _dress(ax: Any, row: int, column: int, k: int, below: str, left: str) -> None:
    """Labels at the edges of the triangle alone."""
    ax.set_xlim(-_VIEW, _VIEW)
    ax.grid(False)
    ax.set_xticks([-4, 0, 4], ["-4", "0", "4"] if row == k - 1 else [])
    ax.tick_params(labelsize=6)
    if column == row:
        ax.set_yticks([])
        ax.set_title(below, fontsize=8, pad=4)
    else:
        ax.set_yticks([-4, 0, 4], ["-4", "0", "4"] if column == 0 else [])
    if row == k - 1:
        ax.set_xlabel(left, fontsize=8)
    if column == 0 and row > 0:
        ax.set_ylabel(below, fontsize=8)


def _legend(fig: Any, ax: Any, look: Mapping[str, Look]) -> None:
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], color=one.color, linestyle=one.linestyle, linewidth=1.4) for one in look.values()]
    names = [common.text(label) for label in look]
    handles.append(Line2D([], [], linestyle="none", marker="o", markersize=4, color=_DRAW_COLOR))
    handles.append(Line2D([], [], linestyle="none", marker="+", markersize=7, color="black"))
    fig.legend(
        handles,
        [*names, "posterior", "truth"],
        loc="outside lower center",
        ncols=min(6, len(handles)),
        title="axes: deviations of the posterior about its mean",
    )


def _caption(model: Measurement, one: Reference, k: int) -> str:
    told = [f"{label} {d.kl:.3g}" for label, d in one.divergences.items() if np.isfinite(d.kl)]
    modes = len(one.posterior.modes)
    return common.sentence(
        f"Draws of the posterior of trial {one.trial} of {model.name}, and the 95 % ellipses that estimators report, in"
        f" deviations of the posterior about its mean; what is more than {_VIEW:g} of them off is not in view.",
        f"Divergence in nats: {common.enumerate_few(told, 12)}." if told else "",
        f"{modes} modes, crossed." if modes > 1 else "",
        f"The {k} parameters in which estimators are farthest off." if k < len(model.parameters) else "",
        "" if one.posterior.settled else "The populations of particles do not agree: give more.",
    )
