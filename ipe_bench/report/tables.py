"""The tables of a report: which columns they have, and what their captions say."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from ipe_bench.basics.files import write_text
from ipe_bench.report.table import Cell, Column, Table, column, interval, sort_key, words, write_table
from ipe_bench.report.terminal import LEGEND, leading, overview_columns
from ipe_bench.report.words import limits, p_value, percent, plain, reported, short, shower, shown
from ipe_bench.statistics.analysis import Analysis
from ipe_bench.statistics.comparisons import ALPHA
from ipe_bench.statistics.records import SCORES, Statistic, Where, all_statistics
from ipe_bench.statistics.summary import ALL


def all_tables(analysis: Analysis, whole: Analysis | None = None) -> list[Table]:
    """Every table that the data allow, in the order of the report; `whole` is the analysis whose endings are listed
    if this one leaves some trials out."""
    if analysis.summary.empty:
        return [table for table in [endings(whole or analysis)] if table is not None]
    tables = [overview(analysis), costs(analysis), comparisons(analysis), ranks(analysis)]
    tables += [parameters(analysis), calibration(analysis), endings(whole or analysis)]
    tables += [
        all_trials(analysis),
        solved_trials(analysis),
        contraction(analysis),
        covariances(analysis),
        theory(analysis),
        iterations(analysis),
    ]
    return [t for t in tables if t is not None]


def head(analysis: Analysis, rows: pd.DataFrame) -> list[Column]:
    """The columns that tell rows apart: those settings that differ, and the error scale."""
    varying = [c for c in analysis.setting_columns if len(set(rows[c].astype(str))) > 1]
    head = [words(c, [plain(v) for v in rows[c]]) for c in varying]
    return [*head, column("error scale", rows["error_scale"], lambda v: f"{v:g}")]


def overview(analysis: Analysis) -> Table:
    """How each estimator does over all trials: one population for everybody."""
    rows = _all_rows(analysis)
    told = [{str(name): value for name, value in row.items()} for row in rows.to_dict("records")]
    columns = [
        *head(analysis, rows),
        *overview_columns(told, leading(told, [*analysis.setting_columns, "error_scale"])),
    ]
    columns += statistics("overview", all_statistics(), rows)
    return Table("overview", "Overview", "", columns, rows, notes=LEGEND, grouped=len(columns) - 8)


def all_trials(analysis: Analysis) -> Table:
    """What else is known of all trials."""
    rows, scores = _all_rows(analysis), analysis.scores
    columns = [*head(analysis, rows), words("estimator", rows["estimator"])]
    columns += [*statistics("all_trials", all_statistics(), rows), *statistics("all_trials", SCORES, scores)]
    caption = (
        "Over all trials. misfit: residuals fail the test of fit at 0.1 %. ambiguous: several minima fit, as far as the"
        " estimator has looked. Root mean squares and efficiency here are not capped: one trial may decide them."
    )
    names = [*analysis.setting_columns, "error_scale", "estimator"]
    data = [rows[_stored("all_trials", all_statistics())], scores[_stored("all_trials", SCORES)]]
    data = pd.concat([rows[names], *data], axis=1)
    return Table("all_trials", "All trials", caption, columns, data, appendix=True)


def solved_trials(analysis: Analysis) -> Table | None:
    """A diagnostic of iterations: what the trials that found their root came to."""
    rows = _all_rows(analysis)
    rows = rows[rows["equation"] != "-"]
    if rows.empty:
        return None
    columns = [*head(analysis, rows), words("estimator", rows["estimator"])]
    columns += statistics("solved_trials", all_statistics(), rows)
    caption = (
        "A diagnostic of estimators that solve an equation, and no comparison with others: each over the trials in"
        " which it found the root that belongs to the truth, which nobody knows who has readings alone. Their number"
        " stands in brackets where it is not all. rmse, common: on the trials that every estimator solved. False root:"
        " it converged to another one."
    )
    data = rows[[*analysis.setting_columns, "error_scale", "estimator", *_stored("solved_trials", all_statistics())]]
    return Table("solved_trials", "Solved trials", caption, columns, data, appendix=True)


def _all_rows(analysis: Analysis) -> pd.DataFrame:
    return analysis.summary[analysis.summary["parameter"] == ALL].reset_index(drop=True)


def statistics(where: Where, records: Sequence[Statistic], rows: pd.DataFrame) -> list[Column]:
    """The columns of the statistics that are shown in that table."""
    columns: list[Column] = []
    told = [{str(name): value for name, value in row.items()} for row in rows.to_dict("records")]
    for record in records:
        if where not in record.where or not reported(record, told):
            continue
        title = record.titles.get(where, record.title)
        cells = [
            Cell(shown(record, where, row), None if record.kind == "word" else sort_key(row[record.name]))
            for row in told
        ]
        columns.append(Column(title, cells, numeric=record.kind != "word"))
        if where in record.limits_titles:
            ends = [limits(record, where, row) for row in told]
            lows, highs = zip(*ends, strict=True) if ends else ((), ())
            columns.append(interval(record.limits_titles[where], lows, highs, shower(record.kind, where)))
    return columns


def costs(analysis: Analysis) -> Table:
    """What a trial costs, and what is needed to come close to the estimator's own limit."""
    rows = analysis.summary[analysis.summary["parameter"] == ALL].reset_index(drop=True)
    scores = analysis.scores
    columns = [*head(analysis, rows), words("estimator", rows["estimator"])]
    columns += statistics("costs", all_statistics(), rows)
    columns += statistics("costs", SCORES, scores)
    names = [*analysis.setting_columns, "error_scale", "estimator"]
    data = [rows[_stored("costs", all_statistics())], scores[_stored("costs", SCORES)]]
    caption = (
        "Medians per trial over all trials. A Jacobian counts as many simulations as there are"
        " parameters. To 0.05 σ of limit: cost until all further iterates are within 0.05 standard deviations of the"
        " last one, over the converged trials with a stored history. Order: the last observed order of convergence of"
        " these trials, 1 linear and 2 quadratic."
    )
    return Table("costs", "Costs", caption, columns, pd.concat([scores[names], *data], axis=1))


def _stored(where: Where, records: Sequence[Statistic]) -> list[str]:
    return [name for record in records if where in record.where for name in record.columns]


def covariances(analysis: Analysis) -> Table | None:
    """What theory says of the scatter of the frozen root, beside the scatter."""
    rows = analysis.summary[(analysis.summary["parameter"] == ALL) & analysis.summary["eq_14"].notna()]
    if rows.empty:
        return None
    columns = [*head(analysis, rows), words("estimator", rows["estimator"])]
    columns += statistics("covariances", all_statistics(), rows)
    caption = (
        "Standard deviations over the linear bound of eq. (5), root mean square over parameters, of the estimators that"
        " solve eq. (11), over solved trials. rmse is what happened (Monte Carlo); reported is the sandwich at the"
        " estimate, which holds to first order; eq. (14) takes the compensation error for independent of the noise,"
        " which it is not. A false root is a converged trial at another root than the truth leads to."
    )
    data = rows[[*analysis.setting_columns, "error_scale", "estimator", *_stored("covariances", all_statistics())]]
    return Table("covariances", "Covariance of the frozen root", caption, columns, data, appendix=True)


def theory(analysis: Analysis) -> Table | None:
    """What theory expects of least squares, parameter by parameter, beside what happened."""
    rows = analysis.summary[analysis.summary["predicted_rmse"].notna()]
    if rows.empty:
        return None
    columns = [*head(analysis, rows), words("estimator", rows["estimator"]), words("parameter", rows["parameter"])]
    columns += statistics("theory", all_statistics(), rows)
    caption = (
        "Estimators that minimise the sum of squares, over solved trials, in the parameters' own units; all: over the"
        " linear bound, root mean square over parameters. By theory: without any noise drawn, from the slopes of the"
        " models alone; where readings come from another model than is assumed, from those of both. Relative curvatures"
        " say how far linear theory reaches: they are small below 0.3."
    )
    names = ["error_scale", "estimator", "parameter", "unit"]
    data = rows[[*analysis.setting_columns, *names, *_stored("theory", all_statistics())]]
    return Table("theory", "Theory beside experiment", caption, columns, data, appendix=True)


def iterations(analysis: Analysis) -> Table | None:
    """The paper's bounds on the iterations beside the iterates."""
    scores = analysis.scores
    rows = scores[(scores["eq_18_trials"] > 0) | scores["eq_23_observed"].notna()]
    if rows.empty:
        return None
    columns = [*head(analysis, rows), words("estimator", rows["estimator"])]
    columns += statistics("iterations", SCORES, rows)
    caption = (
        "Over the first trials, whose iterates are stored. Eq. (18) bounds fixed-point iteration where K of eq. (15) is"
        " below 1; eq. (23) bounds Newton's method by the curvature M of its g. Constants are taken at the truth, the"
        " last iterate stands for the root."
    )
    data = rows[[*analysis.setting_columns, "error_scale", "estimator", *_stored("iterations", SCORES)]]
    return Table("iterations", "Bounds on the iterations", caption, columns, data, appendix=True)


def contraction(analysis: Analysis) -> Table | None:
    """Whether theory promises that the fixed-point iteration converges, eq. (15)."""
    rows = analysis.contraction
    if rows.empty:
        return None
    columns = head(analysis, rows)
    for name, title in (("K", "K"), ("norm", "infinity norm"), ("radius", "spectral radius")):
        columns += [
            column(f"{title}, median", rows[f"contraction_{name}_median"], short),
            column(f"{title}, largest", rows[f"contraction_{name}_max"], short),
            column(f"{title} below 1", rows[f"contraction_{name}_below_1"], percent),
        ]
    caption = (
        "Of g' = I - H⁺J at the truth, over all trials. K of eq. (15) below 1, or the infinity norm below 1, in a whole"
        " neighbourhood is sufficient for fixed-point iteration to converge there; the spectral radius below 1 is"
        " necessary and sufficient close to the root, and is the rate at which the error shrinks."
    )
    return Table("contraction", "Contraction", caption, columns, rows, appendix=True)


def comparisons(analysis: Analysis) -> Table | None:
    """Every pair of estimators on the same trials."""
    rows = analysis.pairs
    if rows.empty:
        return None

    columns = [
        *head(analysis, rows),
        words("first", rows["first"]),
        words("second", rows["second"]),
        column("trials", rows["trials"], lambda v: f"{v:d}"),
        column("wins", rows["wins"], lambda v: f"{v:d}"),
        column("ties", rows["ties"], lambda v: f"{v:d}"),
        column("losses", rows["losses"], lambda v: f"{v:d}"),
        column("median difference", rows["median_difference"], short),
        column("p of error", rows["p_error"], p_value),
        column("first alone", rows["only_first"], lambda v: f"{v:d}"),
        column("second alone", rows["only_second"], lambda v: f"{v:d}"),
        column("p of success", rows["p_success"], p_value),
        words("finding", [f"{label} is closer" if label else "no difference" for label in rows["closer"]]),
    ]
    caption = (
        "On the trials that both have. A win is a Mahalanobis error of the first smaller by more than 0.001 standard"
        " deviations; p of error: Wilcoxon's signed-rank test without the ties. First, second alone: trials in which"
        " only that one succeeds; p of success: McNemar's exact test. Both Holm-corrected over all pairs of all"
        " scenarios. Success is the gate of the Cramér-Rao bound here, prior or not."
    )
    return Table("comparisons", "Paired comparisons", caption, columns, rows)


def ranks(analysis: Analysis) -> Table | None:
    """Mean ranks over independent replicates."""
    ranking = analysis.ranking
    if ranking is None:
        return None
    ordered = sorted(ranking.mean_ranks, key=lambda label: ranking.mean_ranks[label])
    values = [ranking.mean_ranks[label] for label in ordered]
    # Nemenyi's test is a follow-up: without a rejection by Friedman's it says nothing.
    rejects = ranking.friedman < ALPHA
    apart = ["yes" if rejects and v - values[0] >= ranking.critical_difference else "no" for v in values]
    columns = [words("estimator", ordered), column("mean rank", values, short), words("apart from the first", apart)]
    caption = (
        f"Over {ranking.replicates} seeds, by capped mean error over all scenarios. Friedman's test that all rank"
        f" alike: p = {p_value(ranking.friedman)}. Nemenyi's critical difference at 5 %:"
        f" {ranking.critical_difference:.2f}."
    )
    data = pd.DataFrame({"estimator": ordered, "mean_rank": values, "apart_from_first": apart}).assign(
        replicates=ranking.replicates, friedman_p=ranking.friedman, critical_difference=ranking.critical_difference
    )
    return Table("ranks", "Ranks over seeds", caption, columns, data)


def parameters(analysis: Analysis) -> Table:
    """Every parameter in its own unit."""
    rows = analysis.summary[analysis.summary["parameter"] != ALL]
    columns = [*head(analysis, rows)]
    columns += [words(name, rows[name]) for name in ("estimator", "parameter", "unit")]
    columns += statistics("parameters", all_statistics(), rows)
    caption = (
        "In each parameter's own unit. Bias, std, rmse, bounds and NEES are over solved trials; median and 95 % of the"
        " absolute error, and coverage, over all trials."
    )
    return Table("parameters", "Parameters", caption, columns, rows)


def calibration(analysis: Analysis) -> Table | None:
    """How each reported covariance lies, in words."""
    summary = analysis.summary[analysis.summary["claims"] > 0]
    rows = summary[summary["parameter"] == ALL]
    if rows.empty:
        return None
    columns = [*head(analysis, rows), words("estimator", rows["estimator"])]
    columns += statistics("calibration", all_statistics(), rows)
    caption = (
        "Whether the truth lies under the Gaussian that an estimator reports as that Gaussian says: over converged"
        " trials with a covariance, for NEES and every parameter together, at 5 % for each row. p: that chance alone"
        " takes any of these distributions so far. Excursion: how far the one of NEES is from its own at most. What"
        " each parameter came to is in the table of parameters."
    )
    names = [*analysis.setting_columns, "error_scale", "estimator", "parameter"]
    data = summary[[*names, *_stored("calibration", all_statistics())]]
    return Table("calibration", "Calibration of the reported covariance", caption, columns, data)


def endings(analysis: Analysis) -> Table | None:
    """Trials that did not converge, with their messages."""
    rows = analysis.endings
    if rows.empty:
        return None
    columns = [
        *head(analysis, rows),
        words("estimator", rows["estimator"]),
        words("status", rows["status"]),
        column("trials", rows["trials"], lambda v: f"{v:d}"),
        column("share", rows["share"], percent),
        words("first", rows["first"]),
        words("message", rows["message"]),
    ]
    caption = "How trials ended that did not converge, and the first of each kind."
    return Table("endings", "Trials that did not converge", caption, columns, rows)


def write_tables(analysis: Analysis, tables: Sequence[Table], folder: Path) -> tuple[Path, ...]:
    """Writes each table as CSV (all columns, full precision), Markdown and LaTeX, and the profiles as CSV."""
    paths = [path for table in tables for path in write_table(table, folder)]
    if len(analysis.profiles):
        path = folder / "profiles.csv"
        write_text(path, analysis.profiles.to_csv(index=False))
        paths.append(path)
    return tuple(paths)
