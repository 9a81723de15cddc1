"""Draws the tracks of a log: each state over time in its band, each reading beside its prediction,
and NIS."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.special import chdtri

from ipe_bench.basics.linalg import Array, deviations, nearest
from ipe_bench.measurements.base import with_unit
from ipe_bench.real.logs import distrusted
from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.figures.views import looks_of
from ipe_bench.report.style import BOUND_COLOR, Look
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


def draw_log(log: Log, tracks: Sequence[LogTracks], name: str = "track") -> Iterator[Drawing]:
    """Draws the states, with the readings where a state is read, each other reading beside its
    prediction, and NIS of the first filter."""
    groups = _groups(tracks)[:MOST_TRACKS]
    if not groups:
        return
    model = log.model
    states = model.states[:MOST_STATES]
    read = directly_read(model)
    filters = [group for group in groups if np.isfinite(group[0].nis).any()]
    # A state that is read directly has its readings in its own panel.
    rest = [j for j in _predicted(filters) if read.get(j, model.n) >= len(states)]
    colors = looks_of({group[0].label: group[0].tracker for group in groups})
    look = {_name(group): Look(colors[group[0].label].color, "") for group in groups}
    fig, axes = common.panels(len(states) + len(rest) + bool(filters), look, height=2.0, row=2)
    panels = iter(axes)
    for i in range(len(states)):
        own = [j for j, state in read.items() if state == i]
        _draw_state(next(panels), log, i, own, groups, look)
    for j in rest:
        _draw_predictions(next(panels), log, j, filters, look)
    words = [_draw_nis(next(panels), log, group[0]) for group in filters[:1]]
    for ax in axes:
        ax.set_xlabel("time [s]")
        ax.margins(x=0.01)
    common.legend(fig, axes, look)
    names = enumerate_few(list(look))
    title = f"{names}: states ± {BAND:g} standard deviations"
    caption = " ".join([*words, *_not_drawn(model, groups, tracks)])
    yield Drawing(name, title, caption, fig)


def _draw_state(
    ax: Axes,
    log: Log,
    i: int,
    own: Sequence[int],
    groups: Sequence[Sequence[LogTracks]],
    look: dict[str, Look],
) -> None:
    """Draws a state by every tracker, with its `own` readings if it is read directly."""
    state = log.model.states[i]
    first = groups[0][0]
    bands = {}
    for group in groups:
        bands[_name(group)] = _Band(group[0].mean[:, i], group[0].deviation[:, i])
    # Angles are drawn by the turn that is nearest to the track.
    periods = [log.model.periods[j] for j in own if log.model.periods]
    to = first.mean[:, [i]] / state.size
    readings = state.size * nearest(log.z[:, own], to, periods)
    _draw_bands(ax, log.model.times, bands, look, readings)
    _mark_left_out(ax, log, own, first, readings)
    common.title(ax, with_unit(state.name, state.unit))


def _not_drawn(
    model: StateModel, groups: Sequence[Sequence[LogTracks]], tracks: Sequence[LogTracks]
) -> Iterator[str]:
    """Says which tracks are not drawn, and how many states."""
    drawn = {one.label for group in groups for one in group}
    left = [one.label for one in tracks if one.label not in drawn]
    if left:
        yield f"Not drawn: {enumerate_few(left)}."
    further = model.n - MOST_STATES
    if further > 0:
        yield f"{further} further states are in track.csv."


def _predicted(filters: Sequence[Sequence[LogTracks]]) -> list[int]:
    """Returns the readings that the first filter predicts at any epoch."""
    if not filters:
        return []
    there = np.isfinite(filters[0][0].predicted).any(axis=0)
    return np.flatnonzero(there).tolist()


def directly_read(model: StateModel) -> dict[int, int]:
    """Returns which reading of an epoch is a state itself, as the places of readings and of their
    states."""
    spread = deviations(model.prior.covariance)
    factors = np.array([[0.3], [-1.1], [0.7]])
    # Different numbers in every state, so that none is read by chance.
    x = model.prior.mean + spread * factors + np.arange(model.n) / 7
    epochs = {0, model.epochs // 2, model.epochs - 1}
    with np.errstate(all="ignore"):  # far from the prior's mean a reading may have no value
        z = [model.observe(x, k) for k in epochs]
    found = {}
    for j in range(len(model.reading_names)):
        for i in range(model.n):
            if all((one[:, j] == x[:, i]).all() for one in z):
                found[j] = i
    return found


def _name(group: Sequence[LogTracks]) -> str:
    """Names the tracks of a group, and says which are of smoothers."""
    labels = [f"{one.label} (smoother)" if one.smooths else one.label for one in group]
    return enumerate_few(labels, 2)


def _groups(tracks: Sequence[LogTracks]) -> list[list[LogTracks]]:
    """Returns the tracks that are known, those that pass first, and together those that cannot be
    told apart."""
    known = [one for one in tracks if _is_known(one)]
    best_first = sorted(known, key=lambda one: not one.passes)
    return common.together(best_first, _are_alike)


def _is_known(one: LogTracks) -> bool:
    """Tells whether a track is finite at any epoch."""
    finite = np.isfinite(one.mean) & np.isfinite(one.deviation)
    return bool(finite.all(axis=1).any())


def _are_alike(one: LogTracks, other: LogTracks) -> bool:
    means = np.abs(one.mean - other.mean)
    deviations = np.abs(one.deviation - other.deviation)
    most = _ALIKE * np.fmin(one.deviation, other.deviation)
    return bool((means + BAND * deviations <= most).all())


class _Band(NamedTuple):
    """Means and standard deviations over the epochs (K,)."""

    mean: Array
    deviation: Array

    @property
    def low(self) -> Array:
        return self.mean - BAND * self.deviation

    @property
    def high(self) -> Array:
        return self.mean + BAND * self.deviation

    @property
    def finite(self) -> _Band:
        """The same, NaN where either is not finite."""
        known = np.isfinite(self.mean) & np.isfinite(self.deviation)
        return _Band(np.where(known, self.mean, np.nan), np.where(known, self.deviation, np.nan))


def _draw_bands(
    ax: Axes, times: Array, bands: dict[str, _Band], look: dict[str, Look], readings: Array
) -> None:
    """Draws means with their bands, and readings (K, kinds); marks at the panel's edge what is far
    from them. What has overflowed is left out."""
    bands = {name: band.finite for name, band in bands.items()}
    bands = {name: band for name, band in bands.items() if np.isfinite(band.mean).any()}
    _set_limits(ax, list(bands.values()), readings)
    style: Any = {"linestyle": "none", "marker": ".", "color": BOUND_COLOR, "zorder": 1}
    style |= {"markersize": 3.0, "alpha": 0.5, "rasterized": len(times) > _MANY}
    for values in readings.T:
        ax.plot(times, values, label="readings", **style)
        _mark_beyond(ax, times, values, BOUND_COLOR)
    for name, band in bands.items():
        color = look[name].color
        ax.fill_between(times, band.low, band.high, color=color, alpha=0.18, linewidth=0)
        ax.plot(times, band.mean, color=color, linewidth=1.2)
        _mark_beyond(ax, times, band.low, color)
        _mark_beyond(ax, times, band.high, color)


def _mark_left_out(
    ax: Axes, log: Log, places: Sequence[int], one: LogTracks, readings: Array
) -> None:
    """Marks the readings (K, kinds) of these places beyond a tracker's gate, or that hardly count,
    at the panel's edge where they lie outside."""
    label = f"left out by {one.label}"
    marked = one.gated
    if marked is None:
        label = f"hardly counted by {one.label}"
        marked = distrusted(one.weights)
    if marked is None:
        return
    low, high = ax.get_ylim()
    margin = 0.04 * (high - low)
    style: Any = {"linestyle": "none", "marker": "x", "color": _RED, "markersize": 5.0}
    for j, values in zip(places, readings.T, strict=True):
        out = marked[:, j]
        if out.any():
            shown = np.clip(values[out], low + margin, high - margin)
            ax.plot(log.model.times[out], shown, label=label, **style)


def _set_limits(ax: Axes, bands: Sequence[_Band], readings: Array) -> None:
    """Sets an axis that holds the means, and the bands and readings that are near to them."""
    middle = [band.mean for band in bands]
    low = np.nanmin(middle)
    high = np.nanmax(middle)
    typical = max(float(np.nanmedian(band.deviation)) for band in bands)
    room = max(high - low, 3 * BAND * typical) or 1.0
    shown = [*(band.low for band in bands), *(band.high for band in bands), *readings.T]
    lowest = max(low - room, np.nanmin(shown))
    highest = min(high + room, np.nanmax(shown))
    margin = 0.05 * (highest - lowest) or 1.0
    ax.set_ylim(lowest - margin, highest + margin)


def _draw_predictions(
    ax: Axes, log: Log, j: int, filters: Sequence[Sequence[LogTracks]], look: dict[str, Look]
) -> None:
    """Draws the readings of one kind with their predictions, or without them if those jump from
    epoch to epoch, such as ranges to one beacon after another."""
    name = log.model.reading_names[j]
    z = log.z[:, [j]]
    bands: dict[str, _Band] = {}
    for group in filters:
        one = group[0]
        bands[_name(group)] = _Band(one.predicted[:, j], one.predicted_deviation[:, j])
    label, first = next(iter(bands.items()))
    predicted = first.mean[np.isfinite(first.mean)]
    steps = np.sum(np.abs(np.diff(predicted)))
    if steps <= _JUMP * len(predicted) * np.ptp(predicted):
        _draw_bands(ax, log.model.times, bands, look, z)
        _mark_left_out(ax, log, [j], filters[0][0], z)
        common.title(ax, f"{name}: reading and prediction")
        return
    centred = _Band(0.0 * first.mean, first.deviation)
    z = z - first.mean[:, None]
    _draw_bands(ax, log.model.times, {label: centred}, look, z)
    _mark_left_out(ax, log, [j], filters[0][0], z)
    common.title(ax, f"{name}: reading less prediction of {label}")


def _mark_beyond(ax: Axes, times: Array, values: Array, color: str) -> None:
    """Marks the farthest of the values beyond each end of the axis by an arrow there."""
    low, high = ax.get_ylim()
    for edge, beyond, downwards in ((low, low - values, True), (high, values - high, False)):
        if (beyond > 0).any():
            farthest = [int(np.nanargmax(beyond))]
            common.mark_cut(ax, times[farthest], edge, color, downwards=downwards)


def _draw_nis(ax: Axes, log: Log, one: LogTracks) -> str:
    """Draws NIS of a filter with its limit, and says how many lie above."""
    there = np.isfinite(one.nis)
    t = log.model.times[there]
    nis = one.nis[there]
    # NIS of right innovations is chi-square with a degree per reading of the epoch.
    seen = np.isfinite(log.z) if one.gated is None else np.isfinite(log.z) & ~one.gated
    degrees = seen.sum(axis=1)
    limit = chdtri(degrees[there], ABOVE)
    above = nis > limit
    dot: Any = {"linestyle": "none", "marker": ".", "rasterized": len(nis) > _MANY}
    ax.plot(t[~above], nis[~above], color=BOUND_COLOR, alpha=0.5, markersize=3.0, **dot)
    ax.plot(t[above], nis[above], color=_RED, markersize=5.0, label="NIS above its limit", **dot)
    dashed: Any = {"color": BOUND_COLOR, "linewidth": 1.0, "linestyle": "--"}
    ax.step(t, limit, where="mid", label=f"limit of NIS, {100 * (1 - ABOVE):g} %", **dashed)
    if nis.max() > 4 * limit.max():
        ax.set_yscale("symlog", linthresh=float(limit.max()), linscale=1.0)
        ax.yaxis.set_major_formatter(lambda value, _: common.number(value))
    ax.set_ylim(0, 1.15 * max(nis.max(), limit.max()))
    share = percent(float(above.mean()))
    common.title(ax, f"NIS of {one.label}")
    right = f"{100 * ABOVE:g} % if right"
    return f"NIS of {one.label} is above its limit at {share} of {len(nis)} time steps ({right})."
