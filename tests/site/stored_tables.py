"""Writes tables of what is stored of the experiments into the pages that tell of them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from gallery_frames import SUFFIX, read

from ipe_bench.report.tables.certified import certified_tables
from ipe_bench.report.tables.settings import Wording
from ipe_bench.report.words import brief, share_text
from ipe_bench.statistics.analysis import Analysis
from ipe_bench.statistics.statistic import ALL

MARK = re.compile(r"^\(Table: `make docs`\.\) <!-- (\w+) -->\n", re.MULTILINE)
"""The line of a page that a table replaces."""
_WORDS = ("success", "error", "NEES")
_MANY = 100
"""Values above it are shown without fractions."""


def with_tables(page: str, stored: Path) -> str:
    """Returns the page with its tables, of the results in a folder."""

    def written(mark: re.Match[str]) -> str:
        experiment, rows = TABLES[mark[1]]
        head, *others = rows(read(stored / f"{experiment}{SUFFIX}").analysis)
        lines = [f"| {' | '.join(cells)} |\n" for cells in (head, *others)]
        return "".join([lines[0], f"|---|{'--:|' * (len(head) - 1)}\n", *lines[1:]])

    return MARK.sub(written, page)


def _totals(analysis: Analysis) -> pd.DataFrame:
    summary = analysis.summary
    return summary[summary["parameter"] == ALL]


def _far(analysis: Analysis) -> Iterator[Sequence[str]]:
    """Yields success far from the start, and cost, the best first."""
    scales = (300, 1000, 3000, 10_000)
    names = ("progressive", "auto", "iplf", "multistart", "enkf", "levenberg_marquardt")
    rows = _totals(analysis).set_index(["estimator", "error_scale"])
    yield ["", *(f"{scale:,}" for scale in scales), "cost at 1000"]
    for name in (*names, "least_squares", "iterated_ekf", "ckf"):
        shares = [share_text(rows["success"][name, scale]) for scale in scales]
        yield [f"`{name}`", *shares, f"{rows['simulations_median'][name, 1000]:.0f}"]


def _digits(analysis: Analysis) -> Iterator[Sequence[str]]:
    """Yields how many certified problems are solved from each start, and correct digits."""
    rows = certified_tables(analysis.collection)[0].data.set_index(["estimator", "start"])
    names = ("multiscale_lm", "progressive", "auto", "least_squares", "levenberg_marquardt")
    yield ["", "solved, start 1", "start 2", "digits, start 1", "start 2"]
    for name in (*names, "gauss_newton", "relinearized", "newton"):
        both = [rows.loc[(name, start)] for start in (1, 2)]
        solved = [f"{one['solved']:.0f}" for one in both]
        yield [f"`{name}`", *solved, *(f"{one['mean_lre_parameters']:.2f}" for one in both)]


def _wrong_model(analysis: Analysis) -> Iterator[Sequence[str]]:
    """Yields errors under each wrong model, and the share in which it is detected."""
    rows = _totals(analysis)
    rows = rows[rows["estimator"] == "gauss_newton"].sort_values("predicted_rmse")
    listed: Any = rows.to_dict("records")
    options = [one for one in analysis.collection.groups[0].columns if one != "error_scale"]
    settings = Wording.of(analysis.collection).settings(listed, options)
    yield ["the instrument", "error", "predicted", "NEES", "rejected"]
    for setting, row in zip(settings, listed, strict=True):
        errors = [brief(row[name]) for name in ("rmse_solved_over_linear_bound", "predicted_rmse")]
        nees = row["nees_solved"]
        shown = f"{nees:,.0f}" if nees > _MANY else brief(nees)
        yield [setting, *errors, shown, f"{share_text(row['misfit'])} %"]


def _filters(analysis: Analysis) -> Iterator[Sequence[str]]:
    """Yields success, error and NEES of two filters and of `auto`."""
    names = ("ekf", "ukf", "auto")
    rows = _totals(analysis).set_index(["estimator", "error_scale"])
    yield ["error scale", *(f"`{name}` {word}" for name in names for word in _WORDS)]
    for scale in (33, 100, 300, 1000):
        found = [rows.loc[(name, scale)] for name in names]
        cells = [
            (f"{share_text(row['success'])} %", brief(row["error_median"]), brief(row["nees_mean"]))
            for row in found
        ]
        yield [str(scale), *(cell for three in cells for cell in three)]


def _bearings(analysis: Analysis) -> Iterator[Sequence[str]]:
    """Yields success of trackers of a target by bearings only, and their cost."""
    names = ("auto", "lm_ieks", "ekf", "ukf", "ieks", "ipe_newton")
    rows = _totals(analysis)
    rows = rows[rows["measurement"] == "bearings_only"].set_index(["estimator", "error_scale"])
    yield ["error scale", *(f"`{name}`" for name in names)]
    for scale in (1, 10, 100):
        yield [str(scale), *(share_text(rows["success"][name, scale]) for name in names)]
    yield ["cost at 100", *(brief(rows["simulations_median"][name, 100]) for name in names)]


Rows = Callable[[Analysis], Iterator[Sequence[str]]]
TABLES: dict[str, tuple[str, Rows]] = {
    "far": ("beyond", _far),
    "digits": ("nist", _digits),
    "wrong_model": ("mismatch", _wrong_model),
    "filters": ("headline", _filters),
    "bearings": ("states", _bearings),
}
"""Tables by their marks: the experiment, and what returns the head and the rows."""
