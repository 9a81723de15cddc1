"""What figures share: settings, panels, axes, legends and the words of captions."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from ipe_bench.report.style import BOUND_COLOR, Look
from ipe_bench.report.words import plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

MOST_SETTINGS = 6
"""Settings that have figures of their own; the tables have all."""
MOST_PANELS = 6


@dataclass(frozen=True)
class Setting:
    """The rows of one measurement, noise and whatever else differs, over all error scales."""

    suffix: str
    """What its figures' file names end in; empty where there is one setting."""
    label: str
    rows: pd.DataFrame

    @property
    def scales(self) -> list[float]:
        return sorted({float(s) for s in self.rows["error_scale"]})

    def scenario(self, scale: float) -> int:
        """The number of the scenario at that error scale, where the rows are those of `Analysis.scores`."""
        return int(self.rows.loc[self.rows["error_scale"] == scale, "scenario"].iloc[0])


def settings(frame: pd.DataFrame, columns: Sequence[str]) -> list[Setting]:
    """Splits a table by everything but the error scale; the first `MOST_SETTINGS` of them."""
    if frame.empty:
        return []
    groups = list(frame.groupby(list(columns), dropna=False, sort=False))
    varying = [c for c in columns if len(set(frame[c].astype(str))) > 1]
    result: list[Setting] = []
    for number, (values, rows) in enumerate(groups[:MOST_SETTINGS], 1):
        key: tuple[Any, ...] = values if isinstance(values, tuple) else (values,)
        # An option that this setting does not have is not spoken of.
        named = {c: v for c, v in zip(columns, key, strict=True) if not pd.isna(v)}
        shown = [str(named[c]) for c in ("measurement", "noise") if c in named]
        shown += [f"{c}={plain(named[c])}" for c in varying if c in named and c not in ("measurement", "noise")]
        suffix = "" if len(groups) == 1 else "_" + slug("_".join(plain(named[c]) for c in varying if c in named))
        if any(suffix == other.suffix for other in result):
            suffix += f"_{number}"
        label = ", ".join(shown)
        if number == MOST_SETTINGS < len(groups):
            label += f" ({len(groups) - number} further settings are in the tables)"
        result.append(Setting(suffix, label, rows))
    return result


def slug(words: str) -> str:
    """Letters, digits and dashes that are safe in a file name."""
    return re.sub(r"[^A-Za-z0-9.]+", "-", words).strip("-.")[:40]


def text(value: Any) -> str:
    """A name as it stands in a figure: never read as mathematics, never longer than a line."""
    words = str(value)
    words = words if len(words) <= 42 else words[:40] + "…"
    words = words.replace("\\", "\\\\").replace("$", r"\$")
    # A leading underscore would hide the name from legends.
    return "\u200b" + words if words.startswith("_") else words


def figure(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def panels(count: int, height: float = 2.7, extra: float = 0.5, *, most_across: int = 3) -> tuple[Figure, list[Axes]]:
    """A figure with that many panels, unused ones switched off; `extra` inches are for the legend."""
    across = min(most_across, count)
    down = -(-count // across)
    width = {1: 5.2, 2: 8.0}.get(across, 9.2)
    fig = figure(width, height * down + extra)
    axes: list[Axes] = list(fig.subplots(down, across, squeeze=False).flat)
    for ax in axes[count:]:
        ax.set_axis_off()
    return fig, axes[:count]


def spread(values: Sequence[Any], most: int = MOST_PANELS) -> list[Any]:
    """At most that many of the values, evenly spread and with both ends."""
    if len(values) <= most:
        return list(values)
    return [values[i] for i in np.unique(np.linspace(0, len(values) - 1, most).round().astype(int))]


def scale_axis(ax: Axes, scales: Sequence[float]) -> None:
    """A logarithmic axis of error scales that shows the scales themselves."""
    ax.set_xscale("log")
    positive = sorted({float(s) for s in scales if s > 0})
    if not positive:
        return
    span = np.log10(positive[-1] / positive[0])
    # Neighbouring labels such as 10 and 11 would overlap: crowded ones go.
    kept: list[float] = []
    for s in positive:
        if not kept or np.log10(s / kept[-1]) > 0.1 * span:
            kept.append(s)
    ax.set_xticks(kept, [plain(s) for s in kept])
    ax.set_xticks([], minor=True)
    margin = 10 ** max(0.06 * span, 0.15)
    ax.set_xlim(positive[0] / margin, positive[-1] * margin)
    ax.set_xlabel("error scale")


def decades(ax: Axes, values: Any, least: float = 10.0) -> None:
    """A logarithmic axis around the values that spans at least a decade, so that scatter of a per cent looks small."""
    values = np.asarray(values, dtype=float)
    values = values[np.isfinite(values) & (values > 0)]
    if len(values) == 0:
        # A logarithmic axis without anything to show makes matplotlib warn.
        return
    ax.set_yscale("log")
    low, high = float(values.min()) / 1.6, float(values.max()) * 1.6
    if high / low < least:
        middle = np.sqrt(low * high)
        low, high = middle / np.sqrt(least), middle * np.sqrt(least)
    ax.set_ylim(low, high)
    log_ticks(ax.yaxis, low, high)


def log_ticks(axis: Axis, low: float, high: float) -> None:
    """Labels that do not crowd: powers of ten, and 2 and 5 between where those are few."""
    from matplotlib.ticker import LogFormatterMathtext, LogLocator, NullLocator

    if high / low < 30:
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter("{x:g}")
    else:
        axis.set_major_locator(LogLocator(numticks=7))
        axis.set_major_formatter(LogFormatterMathtext())
    axis.set_minor_locator(NullLocator())


def dodge(look: Mapping[str, Look], label: str, scales: Sequence[float]) -> float:
    """A factor near one that sets estimators a little apart on a logarithmic axis: equal results stay visible."""
    if len(look) < 2:
        return 1.0
    positive = [s for s in scales if s > 0]
    span = max(np.log10(max(positive) / min(positive)), 1.0) if positive else 1.0
    place = list(look).index(label) / (len(look) - 1) - 0.5
    return float(10 ** (place * 0.05 * span))


def curve(ax: Axes, x: Any, y: Any, low: Any, high: Any, look: Look, label: str) -> None:
    """A line with markers, and its interval as bars."""
    x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    low, high = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    ax.plot(x, y, label=text(label), **look.line)
    good = np.isfinite(y) & np.isfinite(low) & np.isfinite(high)
    if good.any():
        ax.vlines(x[good], low[good], high[good], color=look.color, linewidth=1.1, alpha=0.8)


def bound_line(ax: Axes, at: float, label: str) -> None:
    ax.axhline(at, color=BOUND_COLOR, linestyle=(0, (2, 2)), linewidth=1.0, label=label, zorder=1)


def legend_below(fig: Figure, axes: Sequence[Axes]) -> None:
    """One legend for all panels, under them."""
    handles: dict[str, Any] = {}
    for ax in axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    if not handles:
        return
    longest = max(len(label) for label in handles)
    columns = max(1, min(len(handles), int(fig.get_figwidth() / (0.55 + 0.075 * longest))))
    fig.legend(list(handles.values()), list(handles), loc="outside lower center", ncols=columns)


def by_estimator(rows: pd.DataFrame, look: Mapping[str, Look]) -> Iterator[tuple[str, pd.DataFrame]]:
    """The rows of each estimator in the order of the looks, by ascending error scale."""
    for label in look:
        mine = rows[rows["estimator"] == label]
        if len(mine):
            yield label, mine.sort_values("error_scale")


def enumerate_few(items: Sequence[str], most: int = 6) -> str:
    """'a, b and 3 others'."""
    items = list(items)
    if len(items) > most:
        return ", ".join(items[:most]) + f" and {len(items) - most} others"
    return ", ".join(items)
