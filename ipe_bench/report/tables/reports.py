"""The tables of a report: which columns they have, and what their captions say."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pandas as pd

from ipe_bench.report.tables.settings import MOST_SETTINGS, Wording
from ipe_bench.report.tables.table import Column, Table, column, counts_of, texts_of, words
from ipe_bench.report.tables.terminal import (
    leading,
    overview_columns,
    overview_notes,
    shown_in,
    statistics,
)
from ipe_bench.report.words import enumerate_few, p_value, percent, short, value_text, varying
from ipe_bench.statistics.analysis import Analysis
from ipe_bench.statistics.records import SCORES
from ipe_bench.statistics.statistic import ALL, Where, frame_columns

_OPEN = (
    " > or <: one-sided interval, because errors in up to 3 of N trials may be unseen;"
    " rmse_solved_unseen in summary_all.csv is that share."
)
_RECORDED: dict[Where, tuple[str, str, Callable[[pd.DataFrame], Any]]] = {
    "tracks": (
        "States over all time steps",
        "Over all time steps; all: root mean square over the states, relative to the filter"
        " linearised at the true path, or for smoothers, which use later readings too, to the"
        f" smoother behind it; about 1 is good for either.{_OPEN}",
        lambda rows: rows["path_bound"].notna(),
    ),
    "costs": (
        "Costs",
        "Over all trials, medians where no mean is named; a Jacobian counts the simulations that"
        " its model states. The cost to 0.05 σ of the limit and the order are over the converged"
        " trials with a stored history.",
        lambda rows: rows["trials"] > 0,
    ),
    "parameters": (
        "Parameters",
        "In each parameter's own unit. Bias, std, rmse, bounds and NEES are over solved trials;"
        f" median and 95 % of the absolute error, and coverage, over all trials.{_OPEN}",
        lambda rows: rows["parameter"] != ALL,
    ),
    "calibration": (
        "Calibration of the reported covariance",
        "This table tests whether the truth is distributed as the Gaussian that an estimator"
        " reports, over converged trials with a covariance, for NEES and every parameter together,"
        " at 5 % for each row. The median NEES with its limits is over all trials.",
        lambda rows: rows["claims"] > 0,
    ),
    "all_trials": (
        "All trials",
        "Over all trials, the same for every estimator. One trial can dominate the RMSE and the"
        " uncapped efficiency.",
        lambda rows: rows["trials"] > 0,
    ),
    "solved_trials": (
        "Solved trials",
        "This table diagnoses estimators that solve an equation and does not compare them with"
        " others: each row is over the trials in which the estimator found the root that belongs"
        f" to the truth. In parentheses: their number, if not all.{_OPEN}",
        lambda rows: rows["equation"] != "-",
    ),
    "covariances": (
        "Covariance of the frozen root",
        "Standard deviations over the linear bound of eq. (5), root mean square over parameters,"
        " of the estimators that solve eq. (11), over solved trials. rmse comes from Monte Carlo."
        " reported is the sandwich at the estimate, which holds to first order. eq. (14) treats"
        " the compensation error as independent of the noise, which it is not.",
        lambda rows: rows["eq_14"].notna(),
    ),
    "theory": (
        "Theory beside experiment",
        "Estimators that minimise the sum of squares, over solved trials, in the parameters' own"
        " units; all: over the linear bound, root mean square over parameters. The theory uses the"
        " Jacobians of the models and no draw of noise; if readings come from another model than"
        " the assumed one, it uses the Jacobians of both. Linear theory holds if the relative"
        f" curvatures are below 0.3.{_OPEN}",
        lambda rows: rows["predicted_rmse"].notna(),
    ),
    "iterations": (
        "Bounds on the iterations",
        "Over the first trials, whose iterates are stored. Eq. (18) bounds fixed-point iteration"
        " if K of eq. (15) is below 1; eq. (23) bounds Newton's method by the curvature M of its"
        " g. Constants are taken at the truth, and the last iterate is taken for the root.",
        lambda rows: (rows["eq_18_trials"] > 0) | rows["eq_23_observed"].notna(),
    ),
}
"""Title, caption and rows of the tables that are made of recorded statistics alone."""
_OF_PARAMETERS = ("tracks", "parameters", "theory")
"""Names of the recorded tables that have a row per parameter."""
_MAIN = ("overview", "tracks", "costs", "comparisons", "parameters", "calibration", "endings")
_APPENDIX = ("all_trials", "solved_trials", "contraction", "covariances", "theory", "iterations")
_CERTIFIED = ("certified", "certified_averages", "published")
NAMES = (*_MAIN, *_APPENDIX, *_CERTIFIED)
"""The tables that a report may have, plugins aside."""


def all_tables(analysis: Analysis, whole: Analysis | None = None) -> list[Table]:
    """Returns every table that the data allow, in the order of the report, with the endings of the
    `whole` analysis."""
    found = {"endings": endings(whole or analysis)}
    if not analysis.summary.empty:
        rows = analysis.totals
        scores = analysis.scores[list(frame_columns(SCORES))]
        totals = pd.concat([rows, scores], axis=1)
        found |= {where: _recorded(analysis, where, totals) for where in _RECORDED}
        found |= {"overview": overview(analysis), "comparisons": comparisons(analysis)}
        found["contraction"] = contraction(analysis)
    main = [found.get(name) for name in _MAIN]
    appendix = [found.get(name) for name in _APPENDIX]
    late = [replace(table, appendix=True) for table in appendix if table is not None]
    return [*(table for table in main if table is not None), *late]


def head(analysis: Analysis, rows: pd.DataFrame) -> list[Column]:
    """Returns the columns that tell rows apart: those settings that differ, of many in one column,
    and the scale."""
    listed: list[Any] = rows.to_dict("records")
    apart = varying(analysis.setting_columns, listed)
    if len(apart) > MOST_SETTINGS:
        wording = Wording.of(analysis.collection)
        told = [words("setting", wording.settings(listed, analysis.setting_columns))]
    else:
        told = [words(name, map(value_text, rows[name])) for name in apart]
    return [*told, column("error scale", rows["error_scale"], value_text)]


def _recorded(analysis: Analysis, where: Where, totals: pd.DataFrame) -> Table | None:
    """Returns the table of the statistics whose records name it, behind the estimators and other
    columns of names."""
    title, caption, chosen = _RECORDED[where]
    of_parameters = where in _OF_PARAMETERS
    names = ["estimator", "parameter", "unit"] if of_parameters else ["estimator"]
    rows = analysis.summary if of_parameters else totals
    rows = rows[chosen(rows)]
    if rows.empty:
        return None
    told: Any = rows.to_dict("records")
    columns = [*head(analysis, rows), *texts_of(rows, *names), *statistics(where, told)]
    stored = frame_columns(shown_in(where))
    data = rows[[*analysis.setting_columns, "error_scale", *names, *stored]]
    return Table(where, title, caption, columns, data)


def overview(analysis: Analysis) -> Table:
    """Returns the overview: each estimator over all trials, a population that every one shares."""
    rows = analysis.totals
    told: Any = rows.to_dict("records")
    first = head(analysis, rows)
    best = leading(told, [*analysis.setting_columns, "error_scale"])
    columns = [*first, *overview_columns(told, best), *statistics("overview", told)]
    notes = overview_notes(rows["noise"].tolist())
    if first[0].title == "setting":
        notes = ("setting: only what was varied.", *notes)
    grouped = len(first)
    whole = "summary.csv"
    return Table(
        "overview", "Overview", "", columns, rows, notes=notes, grouped=grouped, whole=whole
    )


def contraction(analysis: Analysis) -> Table | None:
    """Says whether theory promises that the fixed-point iteration converges, eq. (15)."""
    rows = analysis.contraction
    if rows.empty:
        return None
    columns = head(analysis, rows)
    ends = (
        ("median", ", median", short),
        ("max", ", largest", short),
        ("below_1", " below 1", percent),
    )
    for name, title in (("K", "K"), ("norm", "infinity norm"), ("radius", "spectral radius")):
        for end, said, show in ends:
            columns.append(column(f"{title}{said}", rows[f"contraction_{name}_{end}"], show))
    caption = (
        "Of g' = I - H⁺J at the truth, over all trials. K of eq. (15), or the infinity norm, below"
        " 1 in a whole neighbourhood is sufficient for fixed-point iteration to converge there;"
        " the spectral radius, the rate at which the error shrinks, below 1 is necessary and"
        " sufficient close to the root."
    )
    return Table("contraction", "Contraction", caption, columns, rows)


def comparisons(analysis: Analysis) -> Table | None:
    """Compares every pair of estimators on the same trials."""
    rows = analysis.pairs
    if rows.empty:
        return None
    closer = [f"{label} is closer" if label else "no difference" for label in rows["closer"]]
    columns = head(analysis, rows)
    columns += texts_of(rows, "first", "second")
    columns += counts_of(rows, "trials", "wins", "ties", "losses")
    for title, name, show in (
        ("median difference", "median_difference", short),
        ("p of error", "p_error", p_value),
        ("first alone", "only_first", str),
        ("second alone", "only_second", str),
        ("p of success", "p_success", p_value),
    ):
        columns.append(column(title, rows[name], show))
    columns.append(words("finding", closer))
    caption = (
        "Over the trials that both have. First alone and second alone count trials in which only"
        " that one succeeds, by the gate of the Cramér-Rao bound. p: Wilcoxon's signed-rank and"
        " McNemar's exact test, Holm-corrected over all pairs of all scenarios."
    )
    return Table("comparisons", "Paired comparisons", caption, columns, rows)


def endings(analysis: Analysis) -> Table | None:
    """Lists the statuses of trials that did not converge, with their messages."""
    rows = analysis.endings
    if rows.empty:
        return None
    same = [name for name in rows.columns if name != "estimator"]
    # What happened to several estimators alike stands once.
    told = rows.groupby(same, sort=False, dropna=False)["estimator"].agg(list).reset_index()
    told["estimator"] = told["estimator"].map(enumerate_few)
    columns = head(analysis, told)
    columns += texts_of(told, "estimator", "status")
    columns += counts_of(told, "trials")
    columns.append(column("share", told["share"], percent))
    columns += texts_of(told, "first", "message")
    caption = "Trials that did not converge, by reason, with the first example of each."
    return Table("endings", "Trials that did not converge", caption, columns, rows)
