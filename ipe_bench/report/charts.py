"""The chart of the page: the numbers that its script draws, over columns that a reader chooses as axes."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass

from ipe_bench.report.figures.views import View
from ipe_bench.report.style import ON_DARK
from ipe_bench.trials.thresholds import FEW

FIGURES = 5
"""Number of significant figures of a number on the page."""


@dataclass(frozen=True)
class Axis:
    """A column that an axis may show."""

    column: str
    title: str
    log: bool = False
    """Whether it is logarithmic at first."""
    share: bool = False
    """Whether it runs from none to all, shown in per cent."""
    low: str = ""
    high: str = ""
    """Columns of the ends of its interval; empty without one."""
    reference: float | None = None
    """Where a line says what is best, or honest."""
    reference_title: str = ""


@dataclass(frozen=True)
class Chart:
    """The chart of one setting."""

    name: str
    title: str
    caption: str
    data: str
    """What the script draws, as JSON."""


_SCALE = Axis("error_scale", "error scale", log=True)
_COST = Axis("simulations_median", "simulations per trial (median)", log=True)
_BOUND = {"log": True, "reference": 1.0, "reference_title": "the bound"}
_AXES = (
    Axis("success", "success", share=True, low="success_low", high="success_high"),
    Axis("error_median", "median error / bound", **_BOUND),
    Axis("error_q95", "95 % error / bound", **_BOUND),
    Axis("efficiency_capped", "efficiency", low="efficiency_capped_low", high="efficiency_capped_high"),
    Axis("nees_median", "NEES, median", log=True, reference=1.0, reference_title="honest covariance"),
    Axis("coverage95", "truth in the 95 % ellipsoid", share=True, reference=0.95, reference_title="honest covariance"),
    Axis("failed_silent", "failed silently", share=True),
)


def charts(views: Sequence[View]) -> Iterator[Chart]:
    """The chart of each setting, over all trials."""
    for view in views:
        rows = view.totals
        shown = [axis for axis in _AXES if len(rows) and rows[axis.column].map(math.isfinite).any()]
        if not shown:
            continue
        # With one scale alone there is nothing to see against it.
        across = (_SCALE, _COST) if len(view.scales) > 1 else (_COST, _SCALE)
        columns = {name for axis in (*across, *shown) for name in (axis.column, axis.low, axis.high) if name}
        series = [
            {
                "name": label,
                "color": look.color,
                "on_dark": ON_DARK.get(look.color, look.color),
                "marker": look.marker,
                "dash": list(look.dash or ()),
                "values": {c: [_short(v) for v in part[c]] for c in sorted(columns | {"trials"})},
            }
            for label, look in view.look.items()
            for part in (rows[rows["estimator"] == label],)
        ]
        data = {"x": [asdict(a) for a in across], "y": [asdict(a) for a in shown], "few": FEW, "series": series}
        caption = f"{view.label}. Bars: 95 % intervals, where they are known. Hollow: fewer than {FEW} trials."
        text = json.dumps(data, ensure_ascii=False, separators=(",", ":"))
        yield Chart(f"explore{view.suffix}", "All trials, by any two columns", caption, text)


def _short(value: float) -> float | int | None:
    """A number as it stands on the page; None for what is not there, and for what JSON cannot say."""
    if not math.isfinite(value):
        return None
    return int(value) if value == int(value) and abs(value) < 1e15 else float(f"{value:.{FIGURES}g}")
