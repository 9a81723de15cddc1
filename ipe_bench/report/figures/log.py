"""Draws the tracks of a log: each state over time in its band, each reading beside its prediction, and NIS."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import chdtri

from ipe_bench.basics.linalg import Array, nearest
from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.style import BOUND_COLOR, Look, looks
from ipe_bench.report.words import enumerate_few, percent

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ipe_bench.real.logs import Log, LogTracks
    from ipe_bench.states.base import StateModel

MOST_TRACKS = 3
"""Tracks in a figure that are told apart; `track.csv` has all."""
MOST_STATES = 12
"""States that have panels."""
BAND = 2.0
"""Half the width of a band, in standard deviations."""
ABOVE = 0.05
"""Share of NIS that lies above the limit if the filter is right."""
_ALIKE = 0.25
"""Standard deviations by which tracks that are drawn once differ at most."""
_JUMP = 0.1
"""Part of their span by which predictions that jump from epoch to epoch do so, on average."""
_RED = "#c2273d"
_MANY = 5000
"""Points from which on they are pixels in the PDF, too."""


def draw_log(log: Log, tracks: Sequence[LogTracks]) -> Iterator[Drawing]:
    """Draws the states, with the readings where a state is read, each other reading beside its prediction, and NIS of
    the first filter."""
    groups = _groups(tracks)[:MOST_TRACKS]
    if not groups:
        return
    model = log.model
    states = model.states[:MOST_STATES]
    read = directly_read(model)
    filters = [group for group in groups if np.isfinite(group[0].nis).any()]
    foretold = [np.isfinite(group[0].predicted).any(axis=0) for group in filters[:1]]
    there = np.any(foretold, axis=0) if foretold else np.zeros(0)
    rest = [j for j in np.flatnonzero(there).tolist() if read.get(j, model.n) >= len(states)]
    colors = looks([group[0].label for group in groups])
    look = {_name(group): Look(colors[group[0].label].color, "") for group in groups}
    fig, axes = common.panels(len(states) + len(rest) + bool(filters), look, height=2.0, row=2)
    fig.set_figwidth(10.4)
    for i, (state, ax) in enumerate(zip(states, axes, strict=False)):
        bands = {_name(group): (group[0].mean[:, i], group[0].deviation[:, i]) for group in groups}
        own = [j for j, of in read.items() if of == i]
        to = groups[0][0].mean[:, [i]] / state.size
        periods = [model.periods[j] for j in own if model.periods]
        readings = state.size * nearest(log.z[:, own], to, periods)
        _draw_bands(ax, model.times, bands, look, readings)
        common.title(ax, f"{state.name} [{state.unit}]" if state.unit else state.name)
    for j, ax in zip(rest, axes[len(states) :], strict=False):
        _draw_predictions(ax, log, j, filters, look)
    words = [_draw_nis(axes[-1], log, group[0]) for group in filters[:1]]
    for ax in axes:
        ax.set_xlabel("time [s]")
        ax.margins(x=0.01)
    common.legend(fig, axes, look)
    shown = enumerate_few([_name(group) for group in groups])
    drawn = {one.label for group in groups for one in group}
    left = [one.label for one in tracks if one.label not in drawn]
    if left:
        words.append(f"Not drawn: {enumerate_few(left)}.")
    if model.n > len(states):
        words.append(f"{model.n - len(states)} further states are in track.csv.")
    yield Drawing(
        "track",
        f"{shown}: states ± {BAND:g} standard deviations",
        " ".join(words),
        fig,
    )


def directly_read(model: StateModel) -> dict[int, int]:
    """Returns which reading of an epoch is a state itself, as the places of readings and of their states."""
    spread = np.sqrt(np.diagonal(model.prior.covariance))
    x = model.prior.mean + spread * np.array([[0.3], [-1.1], [0.7]]) + np.arange(model.n) / 7
    with np.errstate(all="ignore"):  # far from the prior's mean a reading may have no value
        z = [model.observe(x, k) for k in {0, model.epochs // 2, model.epochs - 1}]
    return {
        j: i
        for j in range(len(model.reading_names))
        for i in range(model.n)
        if all((one[:, j] == x[:, i]).all() for one in z)
    }


def _name(group: Sequence[LogTracks]) -> str:
    """Names the tracks of a group, and says which are of smoothers."""
    labels = [f"{one.label} (smoother)" if one.smooths else one.label for one in group]
    return enumerate_few(labels, 2)


def _groups(tracks: Sequence[LogTracks]) -> list[list[LogTracks]]:
    """Returns the tracks that are known, those that pass first, and together those that cannot be told apart."""
    known = [
        one for one in tracks if (np.isfinite(one.mean) & np.isfinite(one.deviation)).all(1).any()
    ]
    groups: list[list[LogTracks]] = []
    for one in sorted(known, key=lambda one: not one.passes):
        same = next((group for group in groups if _are_alike(group[0], one)), None)
        if same is None:
            groups.append([one])
        else:
            same.append(one)
    return groups


def _are_alike(one: LogTracks, other: LogTracks) -> bool:
    apart = np.abs(one.mean - other.mean) + BAND * np.abs(one.deviation - other.deviation)
    return bool((apart <= _ALIKE * np.fmin(one.deviation, other.deviation)).all())


def _draw_bands(
    ax: Axes,
    times: Array,
    bands: dict[str, tuple[Array, Array]],
    look: dict[str, Look],
    readings: Array,
) -> None:
    """Draws means with their bands, and readings (K, kinds); marks at the panel's edge what is far from them. What has
    overflowed is left out."""
    style: Any = {"linestyle": "none", "marker": ".", "color": BOUND_COLOR, "zorder": 1}
    style |= {"markersize": 3.0, "alpha": 0.5, "rasterized": len(times) > _MANY}
    bands = {name: _finite(*band) for name, band in bands.items()}
    bands = {name: band for name, band in bands.items() if np.isfinite(band[0]).any()}
    middle = [mean for mean, _ in bands.values()]
    low, high = np.nanmin(middle), np.nanmax(middle)
    typical = max(float(np.nanmedian(deviation)) for _, deviation in bands.values())
    room = max(high - low, 3 * BAND * typical) or 1.0
    ends = [
        mean + sign * BAND * deviation for mean, deviation in bands.values() for sign in (-1, 1)
    ]
    lowest = max(low - room, np.nanmin([*ends, *readings.T]))
    highest = min(high + room, np.nanmax([*ends, *readings.T]))
    margin = 0.05 * (highest - lowest) or 1.0
    ax.set_ylim(lowest - margin, highest + margin)
    for values in readings.T:
        ax.plot(times, values, label="readings", **style)
        _mark_beyond(ax, times, values, BOUND_COLOR)
    for name, (mean, deviation) in bands.items():
        color = look[name].color
        low_end, high_end = mean - BAND * deviation, mean + BAND * deviation
        ax.fill_between(times, low_end, high_end, color=color, alpha=0.18, linewidth=0)
        ax.plot(times, mean, color=color, linewidth=1.2)
        _mark_beyond(ax, times, low_end, color)
        _mark_beyond(ax, times, high_end, color)


def _finite(mean: Array, deviation: Array) -> tuple[Array, Array]:
    """Returns both, NaN where either is not finite."""
    known = np.isfinite(mean) & np.isfinite(deviation)
    return np.where(known, mean, np.nan), np.where(known, deviation, np.nan)


def _draw_predictions(
    ax: Axes, log: Log, j: int, filters: Sequence[Sequence[LogTracks]], look: dict[str, Look]
) -> None:
    """Draws the readings of one kind with their predictions, or without them if those jump from epoch to epoch, such as
    ranges to one beacon after another."""
    name, z = log.model.reading_names[j], log.z[:, [j]]
    found = {
        _name(group): (group[0].predicted[:, j], group[0].predicted_deviation[:, j])
        for group in filters
    }
    first = next(iter(found.values()))[0]
    first = first[np.isfinite(first)]
    if np.sum(np.abs(np.diff(first))) <= _JUMP * len(first) * np.ptp(first):
        _draw_bands(ax, log.model.times, found, look, z)
        common.title(ax, f"{name}: reading and prediction")
        return
    label, (mean, deviation) = next(iter(found.items()))
    band = {label: (0.0 * mean, deviation)}
    _draw_bands(ax, log.model.times, band, look, z - mean[:, None])
    common.title(ax, f"{name}: reading less prediction of {label}")


def _mark_beyond(ax: Axes, times: Array, values: Array, color: str) -> None:
    """Marks the farthest of the values beyond each end of the axis by an arrow there."""
    low, high = ax.get_ylim()
    for edge, far, downwards in ((low, low - values, True), (high, values - high, False)):
        if (far > 0).any():
            k = [int(np.nanargmax(far))]
            common.mark_cut(ax, times[k], edge, color, downwards=downwards)


def _draw_nis(ax: Axes, log: Log, one: LogTracks) -> str:
    """Draws NIS of a filter with its limit, and says how many lie above."""
    degrees = np.isfinite(log.z).sum(axis=1)
    there = np.isfinite(one.nis)
    t, nis = log.model.times[there], one.nis[there]
    limit = chdtri(degrees[there], ABOVE)
    above = nis > limit
    dot: Any = {"linestyle": "none", "marker": ".", "rasterized": len(nis) > _MANY}
    ax.plot(t[~above], nis[~above], color=BOUND_COLOR, alpha=0.5, markersize=3.0, **dot)
    ax.plot(t[above], nis[above], color=_RED, markersize=5.0, label="NIS above its limit", **dot)
    most = f"limit of NIS, {100 * (1 - ABOVE):g} %"
    ax.step(t, limit, where="mid", color=BOUND_COLOR, linewidth=1.0, linestyle="--", label=most)
    if nis.max() > 4 * limit.max():
        ax.set_yscale("symlog", linthresh=float(limit.max()), linscale=1.0)
        ax.yaxis.set_major_formatter(lambda value, _: common.number(value))
    ax.set_ylim(0, 1.15 * max(nis.max(), limit.max()))
    share = percent(float(above.mean()))
    common.title(ax, f"NIS of {one.label}")
    right = f"{100 * ABOVE:g} % if right"
    return f"NIS of {one.label} is above its limit at {share} of {len(nis)} epochs ({right})."
