"""Draws one trial of states that move: truth, readings, and the tracks of the best and of a filter
with their 95 % bands; a position has a map with ellipses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from ipe_bench.basics.linalg import Array
from ipe_bench.measurements.base import with_unit
from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.figures.views import Figure, View
from ipe_bench.report.style import BLACK, SOFT, Look
from ipe_bench.report.words import value_text
from ipe_bench.statistics.one_track import READINGS
from ipe_bench.trials.one_track import position_of

NAME = "one_track"
MOST_PANELS = 4
_DEVIATIONS = 1.96
"""Standard deviations of a band of 95 %."""
_ELLIPSE = 2.448
"""Standard deviations of an ellipse that holds 95 % of a position's errors."""
_ROOM = 0.06
"""Part of the span that an axis has beyond what is never cut."""
_THIN = 0.02
"""Part of the truth's span below which a band, or an ellipse, is not seen."""
_ENLARGED = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
"""Factors by which ellipses may be drawn larger."""


def draw(view: View) -> Iterator[Drawing]:
    """Draws the trial of the largest error scale; a map or two states, then a reading."""
    rows = view["one_track"]
    if rows.empty:
        return
    rows = rows[rows["error_scale"] == rows["error_scale"].max()]
    readings = rows[rows["estimator"] == READINGS]
    tracks = rows[rows["estimator"] != READINGS]
    look = _looks(view, list(dict.fromkeys(tracks["estimator"])))
    states = list(dict.fromkeys(tracks["parameter"]))
    place = position_of(states)
    first = [states[i] for i in place] if place else states[:3]
    count = len(first) + 1 + (place is not None)
    fig, axes = common.panels(count, look, row=count)
    panels = iter(axes)
    if place:
        _draw_map(next(panels), tracks, first, look)
    for state in first:
        _draw_state(next(panels), tracks[tracks["parameter"] == state], look)
    _draw_reading(next(panels), readings)
    common.legend(fig, axes, look)
    best, *_ = look
    trial = int(rows["trial"].iloc[0])
    scale = value_text(float(rows["error_scale"].iloc[0]))
    yield view.drawing(
        fig,
        NAME,
        f"One track at error scale {scale}",
        f"Trial {trial}: of the stored tracks, the one with {best}'s median error. Bands and"
        " ellipses: 95 %. Where a band would be too thin to see, the error is drawn.",
    )


def _looks(view: View, trackers: Sequence[str]) -> dict[str, Look]:
    """Returns the looks of the best tracker and of the first other filter, or the next one:
    lines in the colour that each has in every figure."""
    best = next((label for label in view.focus if label in trackers), trackers[0])
    others = [label for label in trackers if label != best]
    filters = [label for label in others if view.families.get(label) == "filters"]
    shown = [best, *(filters or others)[:1]]
    return {label: Look(view.look[label].color, "") for label in shown}


def _draw_state(ax: Any, rows: pd.DataFrame, look: Mapping[str, Look]) -> None:
    """Draws a state, or its error where the best track's band would be too thin to see; the axis
    holds the truth and that band, and may cut the others."""
    best = rows[rows["estimator"] == next(iter(look))]
    is_thin = best["deviation"].median() < _THIN * np.ptp(best["truth"])
    kept: list[Array] = []
    for label, one in reversed(list(look.items())):
        own = rows[rows["estimator"] == label]
        at, name = common.times(own["at"])
        from_which = own["truth"] if is_thin else 0.0
        mean = (own["mean"] - from_which).to_numpy(float)
        truth = (own["truth"] - from_which).to_numpy(float)
        half = _DEVIATIONS * own["deviation"].to_numpy(float)
        ax.fill_between(at, mean - half, mean + half, color=one.color, alpha=0.2, linewidth=0)
        ax.plot(at, mean, color=one.color)
        label = "truth" if label == next(iter(look)) else None
        ax.plot(at, truth, color=BLACK, linestyle=(0, (4, 2)), label=label)
        ax.set_xlabel(name)
        kept = [mean - half, mean + half, truth]
    _limit(ax.set_ylim, kept)
    state = rows.iloc[0]
    words = f"error of {state['parameter']}" if is_thin else state["parameter"]
    common.title(ax, with_unit(words, state["unit"]))


def _limit(set_limits: Any, kept: Sequence[Array]) -> None:
    values = np.concatenate(kept)
    values = values[np.isfinite(values)]
    if len(values) and np.ptp(values) > 0:
        room = _ROOM * np.ptp(values)
        set_limits(values.min() - room, values.max() + room)


def _draw_reading(ax: Any, rows: pd.DataFrame) -> None:
    own = rows[rows["parameter"] == rows["parameter"].iloc[0]]
    at, name = common.times(own["at"])
    ax.plot(at, own["mean"], ".", color=SOFT, markersize=3)
    ax.set_xlabel(name)
    common.title(ax, str(own["parameter"].iloc[0]))


def _draw_map(ax: Any, rows: pd.DataFrame, names: Sequence[str], look: Mapping[str, Look]) -> None:
    """Draws the paths in the plane, with ellipses at the first, the middle and the last epoch,
    enlarged where they would not be seen; it holds the truth and the best path, and may cut
    ellipses."""
    best = [_states_of(rows, next(iter(look)), name) for name in names]
    times = _enlarged(*best)
    kept: list[list[Array]] = [[], []]
    for label, one in reversed(list(look.items())):
        x, y = (_states_of(rows, label, name) for name in names)
        ax.plot(x["mean"], y["mean"], color=one.color)
        ax.plot(x["truth"], y["truth"], color=BLACK, linestyle=(0, (4, 2)))
        for k in _shown_epochs(x):
            around = _ellipse(x.iloc[k], y.iloc[k], times)
            ax.plot(*around, color=one.color, linewidth=0.7)
            if label == next(iter(look)):
                kept[0].append(around[0])
                kept[1].append(around[1])
        for axis, state in zip(kept, (x, y), strict=True):
            axis.append(state["truth"].to_numpy(float))
    _limit(ax.set_xlim, kept[0])
    _limit(ax.set_ylim, kept[1])
    x, y = (state.iloc[0] for state in best)
    ax.set(xlabel=with_unit(names[0], x["unit"]), ylabel=with_unit(names[1], y["unit"]))
    common.title(ax, "map" if times == 1 else f"map, ellipses {times} times larger")


def _states_of(rows: pd.DataFrame, label: str, name: str) -> pd.DataFrame:
    return rows[(rows["estimator"] == label) & (rows["parameter"] == name)]


def _shown_epochs(x: pd.DataFrame) -> list[int]:
    return sorted({0, len(x) // 2, len(x) - 1})


def _enlarged(x: pd.DataFrame, y: pd.DataFrame) -> int:
    """Returns the least factor with which the largest ellipse of a path is seen in each
    direction."""
    at = _shown_epochs(x)
    largest = np.array([state["deviation"].iloc[at].max() for state in (x, y)])
    least = _THIN * np.array([np.ptp(state["truth"]) for state in (x, y)])
    return next((k for k in _ENLARGED if (k * largest >= least).all()), 1)


def _ellipse(x: pd.Series[Any], y: pd.Series[Any], times: int = 1) -> Array:
    """Returns points (2, 73) around a position that hold 95 % of its errors, so many times as far
    from it."""
    covariance = np.array([[x["deviation"] ** 2, x["across"]], [x["across"], y["deviation"] ** 2]])
    if not np.isfinite(covariance).all():
        return np.full((2, 1), np.nan)
    sizes, axes = np.linalg.eigh(covariance)
    turn = np.linspace(0, 2 * np.pi, 73)
    circle = np.array([np.cos(turn), np.sin(turn)])
    root = axes * np.sqrt(sizes.clip(min=0))
    return np.array([[x["mean"]], [y["mean"]]]) + times * _ELLIPSE * root @ circle


FIGURES = (Figure(draw, ("one_track",), main=True),)
