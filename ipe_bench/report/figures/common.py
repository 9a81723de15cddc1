"""What figures share: settings, panels, axes, legends and the words of captions."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from ipe_bench.report.style import Look

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def settings(frame: pd.DataFrame, columns: Sequence[str]) -> Iterator[tuple[str, str, pd.DataFrame]]:
    """Splits a table by everything but the error scale: (file name suffix, label, rows). One setting has no suffix."""
    if frame.empty:
        return
    groups = list(frame.groupby(list(columns), dropna=False, sort=False))
    varying = [c for c in columns if len(set(frame[c].astype(str))) > 1]
    for number, (values, rows) in enumerate(groups, 1):
        named = dict(zip(columns, values if isinstance(values, tuple) else (values,), strict=True))
        shown = [str(named[c]) for c in columns if c in ("measurement", "noise")]
        shown += [f"{c}={plain(named[c])}" for c in varying if c not in ("measurement", "noise")]
        suffix = "" if len(groups) == 1 else f"_{number}"
        if len(groups) > 1:
            suffix += "_" + slug("_".join(str(named[c]) for c in varying))
        yield suffix, ", ".join(shown), rows


def slug(text: str) -> str:
    """Letters, digits and dashes that are safe in a file name."""
    return re.sub(r"[^A-Za-z0-9.]+", "-", text).strip("-")[:40]


def plain(value: Any) -> str:
    """A number as a reader writes it."""
    return f"{value:g}" if isinstance(value, float) else str(value)


def text(value: Any) -> str:
    """A name as it stands in a figure: never read as mathematics."""
    return str(value).replace("\\", "\\\\").replace("$", r"\$")


def figure(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def scale_axis(ax: Axes, scales: Sequence[float]) -> None:
    """A logarithmic axis of error scales that shows the scales themselves."""
    ax.set_xscale("log")
    positive = sorted({float(s) for s in scales})
    ax.set_xticks(positive, [plain(s) for s in positive])
    ax.set_xticks([], minor=True)
    if len(positive) == 1:
        ax.set_xlim(positive[0] / 2, positive[0] * 2)
    else:
        # Neighbouring labels such as 10 and 11 would overlap: the ends stay, crowded ones go.
        span = np.log10(positive[-1] / positive[0])
        kept: list[float] = []
        for s in positive:
            if not kept or np.log10(s / kept[-1]) > 0.09 * span:
                kept.append(s)
        ax.set_xticks(kept, [plain(s) for s in kept])


def decades(ax: Axes, low: float, high: float) -> None:
    """A logarithmic axis that spans at least a decade, so that scatter of a per cent does not fill the panel."""
    ax.set_yscale("log")
    if not (np.isfinite(low) and np.isfinite(high) and low > 0):
        return
    low, high = low / 1.6, high * 1.6
    if high / low < 10:
        middle = np.sqrt(low * high)
        low, high = middle / np.sqrt(10), middle * np.sqrt(10)
    ax.set_ylim(low, high)


def curve(ax: Axes, x: Any, y: Any, low: Any, high: Any, look: Look, label: str) -> None:
    """A line with markers, and its interval as bars."""
    x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    low, high = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    ax.plot(x, y, label=text(label), **look.line)
    good = np.isfinite(y) & np.isfinite(low) & np.isfinite(high)
    if good.any():
        ax.vlines(x[good], low[good], high[good], color=look.color, linewidth=1.1, alpha=0.8)


def legend_below(fig: Figure, axes: Sequence[Axes], columns: int = 6) -> None:
    """One legend for all panels, under them."""
    handles: dict[str, Any] = {}
    for ax in axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    if handles:
        fig.legend(list(handles.values()), list(handles), loc="outside lower center", ncols=min(columns, len(handles)))


def by_estimator(rows: pd.DataFrame, look: Mapping[str, Look]) -> Iterator[tuple[str, pd.DataFrame]]:
    """The rows of each estimator in the order of the looks, by ascending error scale."""
    for label in look:
        mine = rows[rows["estimator"] == label]
        if len(mine):
            yield label, mine.sort_values("error_scale")
