"""Charts of the page: the numbers that its script draws, under names that a reader may choose as axes.

They need no picture: where a static figure of the same name is there, the page shows it beside. How they look is left
to `templates/report.js`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import pandas as pd

from ipe_bench.report.figures.views import View
from ipe_bench.report.style import ON_DARK, Look
from ipe_bench.trials.thresholds import FEW

FIGURES = 5
"""Significant figures of a number on the page: more than a point on it can show."""


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
    """The columns of its interval, where it has one."""
    count: str = "trials"
    """The column that says how many trials a value is over."""
    reference: float | None = None
    """Where a line says what is best, or honest."""
    reference_title: str = ""


@dataclass(frozen=True)
class Chart:
    """One chart of one setting, named as the static figure that shows the same."""

    name: str
    title: str
    caption: str
    data: str
    """What the script draws, as JSON."""


_SCALE = Axis("error_scale", "error scale", log=True)
_COST = Axis("cost_median", "simulations per trial (median)", log=True)
_BOUND = {"log": True, "reference": 1.0, "reference_title": "linear bound"}
_KINDS: tuple[tuple[str, str, tuple[Axis, ...]], ...] = (
    (
        "error_against_scale",
        "Error",
        (
            Axis(
                "rmse", "rms error / linear bound, solved", low="rmse_low", high="rmse_high", count="solved", **_BOUND
            ),
            Axis("rmse_all", "rms error / linear bound, all trials", **_BOUND),
            Axis(
                *("efficiency", "efficiency, solved"),
                low="efficiency_low",
                high="efficiency_high",
                count="solved",
                reference=1.0,
                reference_title="the bound",
            ),
        ),
    ),
    (
        "success_against_scale",
        "Success",
        (
            Axis("success", "success: inside the gate", share=True, low="success_low", high="success_high"),
            Axis("solved_share", "solved: the right root", share=True),
        ),
    ),
    (
        "consistency",
        "Consistency",
        (
            Axis(
                *("nees", "mean NEES / n, solved"),
                log=True,
                low="nees_from",
                high="nees_to",
                count="solved",
                reference=1.0,
                reference_title="honest covariance",
            ),
            Axis(
                "coverage95",
                "truth inside the 95 % ellipsoid",
                share=True,
                reference=0.95,
                reference_title="honest covariance",
            ),
        ),
    ),
)


def charts(views: Sequence[View]) -> Iterator[Chart]:
    """The charts of each setting: error, success, and consistency where covariances are reported."""
    for name, title, axes in _KINDS:
        for view in views:
            if not view.totals.empty:
                yield from _chart(name, title, axes, view)


def _chart(name: str, title: str, axes: Sequence[Axis], view: View) -> Iterator[Chart]:
    rows = _rows(view)
    shown = [axis for axis in axes if rows[axis.column].map(math.isfinite).any()]
    if not shown:
        return
    # With one scale alone there is nothing to see against it.
    across = (_SCALE, _COST) if len(view.scales) > 1 else (_COST, _SCALE)
    against = "error scale" if len(view.scales) > 1 else "cost"
    data = {
        "x": [asdict(axis) for axis in across],
        "y": [asdict(axis) for axis in shown],
        "few": FEW,
        "series": [_series(label, look, rows[rows["estimator"] == label], shown) for label, look in view.look.items()],
    }
    words = f"{title} against {against}"
    caption = (
        f"{view.label}. Bars: 95 % intervals, where they are known. Hollow: fewer than {FEW} trials. Where points"
        " coincide, each marker lies smaller upon the one before it."
    )
    yield Chart(f"{name}{view.suffix}", words, caption, json.dumps(data, ensure_ascii=False, separators=(",", ":")))


def _rows(view: View) -> pd.DataFrame:
    """The rows over all parameters, ascending by scale, with the cost; the mean NEES with the interval that holds 1
    where it lies within its limits."""
    totals = view.totals.drop(columns="cost_median", errors="ignore")
    cost = view["scores"][["error_scale", "estimator", "cost_median"]]
    rows = totals.merge(cost, on=["error_scale", "estimator"], how="left")
    return rows.assign(
        solved_share=rows["solved"],
        solved=rows["solved_trials"],
        nees_from=rows["nees"] / rows["nees_high"],
        nees_to=rows["nees"] / rows["nees_low"],
    )


def _series(label: str, look: Look, rows: pd.DataFrame, axes: Sequence[Axis]) -> dict[str, Any]:
    columns = {"error_scale", "cost_median", "trials"}
    columns |= {name for axis in axes for name in (axis.column, axis.low, axis.high, axis.count) if name}
    return {
        "name": label,
        "color": look.color,
        "on_dark": ON_DARK.get(look.color, look.color),
        "marker": look.marker,
        "dash": list(look.dash or ()),
        "values": {name: [_short(v) for v in rows[name]] for name in sorted(columns)},
    }


def _short(value: Any) -> float | int | None:
    """A number as it stands on the page; None for what is not there, and for what JSON cannot say."""
    number = float(value)
    if not math.isfinite(number):
        return None
    return int(number) if number == int(number) and abs(number) < 1e15 else float(f"{number:.{FIGURES}g}")
