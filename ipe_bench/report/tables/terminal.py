"""Shows the summary as tables in a terminal; a narrow one omits columns from the right, never the
names."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from collections.abc import Collection as Keys
from dataclasses import replace
from itertools import repeat
from typing import TYPE_CHECKING, Any

from ipe_bench.report.finding import FAILS, Finding
from ipe_bench.report.tables.matrix import opening
from ipe_bench.report.tables.settings import Wording
from ipe_bench.report.tables.table import (
    Column,
    Legend,
    Part,
    Table,
    cells,
    column,
    interval,
    sort_key,
    words,
)
from ipe_bench.report.words import (
    brief,
    cost,
    counted,
    duration,
    ends_in_percent,
    p_value,
    percent,
    scientific,
    share_text,
    short,
    value_text,
)
from ipe_bench.statistics.formulas import CAP
from ipe_bench.statistics.records import SCORES
from ipe_bench.statistics.registry import all_statistics, summary_columns
from ipe_bench.statistics.statistic import ALL, BEST, Kind, Statistic, Where
from ipe_bench.statistics.verdicts import CONSISTENT, NOT_REFUTED, VERDICTS, shown, sign_of
from ipe_bench.trials.thresholds import FEW

if TYPE_CHECKING:
    from ipe_bench.statistics.collect import Collection

_MOST_LINES = 46
"""Lines that a terminal shows of several settings, most of them of matrices."""
_HEAD = 4
"""Lines of a table besides its rows."""
_WIDE_ENOUGH = 100
"""Letters of a screen with room for failures, and for verdicts spelt out."""
_LEGEND = (
    "success: % of all trials (95 % interval); bold: best, or tied for best{failed}; error: median"
    " / 95 % quantile over {reference}; efficiency, NEES"
    " (mean; in parentheses the converged trials): 1 is ideal{sign}; cost: simulations per trial,"
    " median (mean where it differs); time: mean of a trial. More: ipe-bench list statistic."
)
_FAILED = "; failed: known / undetected, %"
_WIDE = ("failed", "verdict")
"""Columns that a narrow screen leaves out."""
_SPELT_OUT = (
    "; verdict: is the reported covariance right? Within: the largest factor of the variance that"
    " is not excluded"
)
_SIGNS = f", {', '.join(f'{word.sign} {word.shown}' for word in VERDICTS[:5])}"
_TOLD = (
    "With noise=unknown every estimator here assumes R with the true levels at the nominal"
    " readings; bounds and success hold for parameters that are estimated together with the"
    " levels."
)
TRACKED = (
    "All columns are for the last time step, where filters and smoothers have the same readings."
    " Success: the error lies in the gate (all but one in a million) of a filter"
    " linearised at the true path, or of the exact density of a single state of a curved model."
    " For whole paths see the table of all time steps. Cost: evaluations of transition and reading."
)
"""References of a track's errors."""
_NAMED = ("measurement", "noise")
"""Columns that head every table."""


def overview_notes(noises: Keys[str], *, narrow: bool = False) -> tuple[str, ...]:
    """Explains the columns of the overview, and what estimators assume about these noises."""
    reference = "the linearised filter" if set(noises) == {"model"} else "the bound"
    failed = "" if narrow else _FAILED
    sign = _SIGNS if narrow else _SPELT_OUT
    notes: list[str] = [Legend(_LEGEND.format(failed=failed, reference=reference, sign=sign))]
    if "unknown" in noises:
        notes.append(_TOLD)
    if "model" in noises:
        notes.append(Legend(TRACKED))
    return tuple(notes)


def summary_tables(
    listed: Sequence[Mapping[str, Any]], collection: Collection | None, width: int
) -> list[Part]:
    """Returns a table per setting (measurement, noise, differing options), after the totals of
    certified runs; without a `collection` their words are made of the rows alone."""
    rows = [row for row in listed if row["parameter"] == ALL]
    wording = Wording.of(collection)
    totals = _totals(rows, collection)
    if totals:
        # Models whose own readings are certified, without being of a collection, have no totals.
        rows = [row for row in rows if row["noise"] != "certified"]
    columns = _columns_of_settings(rows)
    headed = [c for c in columns if c in _NAMED or not _told_by_model(c, rows)]
    settings: dict[str, list[Any]] = {}
    for row in rows:
        values = {column: value_text(row.get(column)) for column in columns}
        named = {column: values[column] for column in headed}
        title = wording.worded(named, is_right=wording.is_right(values))
        settings.setdefault(title, []).append(row)
    kept = {title: part for title, part in _shortened(settings).items() if part}
    tables = [_setting(title, part, width) for title, part in kept.items()]
    if tables:
        noises = {row["noise"] for row in rows}
        notes = overview_notes(noises, narrow=width < _WIDE_ENOUGH)
        tables[-1] = replace(tables[-1], notes=notes)
    parts: list[Part] = [*totals, *_opening(rows, columns, wording), *tables]
    further = len(rows) - sum(map(len, kept.values()))
    if further:
        hidden = len(settings) - len(kept)
        whole = f", {hidden} of {len(settings)} settings whole" if hidden else ""
        parts.append(
            f"{further} of {len(rows)} rows are not shown here{whole}; summary.csv and report.html"
            " have all."
        )
    return parts or ["no trials yet"]


def _totals(rows: Sequence[Mapping[str, Any]], collection: Collection | None) -> list[Table]:
    """Returns the tables of certified runs that a terminal shows."""
    if collection is None or all(row["noise"] != "certified" for row in rows):
        return []
    from ipe_bench.report.tables.certified import certified_tables  # which loads pandas

    return [table for table in certified_tables(collection) if table.whole]


def _columns_of_settings(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Returns the columns of the rows that are of their settings: neither statistics nor the
    estimator's options."""
    known = {*summary_columns(), "parameter", "unit", "estimator", "error_scale"}
    columns = dict.fromkeys(column for row in rows for column in row)
    return [c for c in columns if c not in known and not c.startswith("estimator.")]


def _told_by_model(column: str, rows: Sequence[Mapping[str, Any]]) -> bool:
    """Tells whether the name of a setting's model says what it has in a column."""
    models = {str(row["measurement"]) for row in rows}
    pairs = {(str(row["measurement"]), value_text(row.get(column))) for row in rows}
    return len(pairs) == len(models)


def _opening(
    rows: Sequence[Mapping[str, Any]], columns: Sequence[str], wording: Wording
) -> list[Part]:
    """Returns the finding and its matrices, of constants and then of states that move."""
    simulated = [row for row in rows if row["noise"] != "certified"]
    if not simulated:
        return []
    settings = wording.settings(simulated, columns)
    pairs = zip(simulated, settings, strict=True)
    told = [{**row, "setting": setting} for row, setting in pairs]
    constant = [row for row in told if row["noise"] != "model"]
    moving = [row for row in told if row["noise"] == "model"]
    parts: list[Part] = []
    for some in filter(None, (constant, moving)):
        parts += opening(some, 0.6 * _MOST_LINES)
    return parts


def _shortened(settings: Mapping[str, Sequence[Any]]) -> dict[str, list[Any]]:
    """Returns the rows of each setting at its telling scale, until the screen is full."""
    room = 0.4 * _MOST_LINES
    kept: dict[str, list[Any]] = {}
    for title, rows in settings.items():
        here = _telling(rows)
        if kept and len(here) + _HEAD > room:
            break
        kept[title] = here
        room -= len(here) + _HEAD
    return kept


def _telling(rows: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Returns the rows, the best first, of the largest scale at which half of the estimators may
    hold, or else of the last."""
    finding = Finding.of(rows)
    best_first = [one.label for one in finding.standings]
    scale = finding.places[-1][1]
    for at, (_, place) in enumerate(finding.places):
        possible = sum(one.judged[at] != FAILS for one in finding.standings)
        scale = place if 2 * possible >= len(best_first) else scale
    here = [row for row in rows if row["error_scale"] == scale]
    return sorted(here, key=lambda row: best_first.index(row["estimator"]))


def _setting(title: str, rows: Sequence[Mapping[str, Any]], width: int) -> Table:
    best = leading(rows, ["error_scale"])
    columns = overview_columns(rows, best, narrow=width < _WIDE_ENOUGH)
    # A narrow screen leaves out the last columns: cost and time before what a plugin was asked to
    # show.
    columns[-2:-2] = statistics("terminal", rows)
    # The number of trials stands in the title if it is the same for all.
    counts = sorted({row["trials"] for row in rows})
    if len(counts) > 1:
        columns.append(column("trials", [row["trials"] for row in rows], str))
    else:
        title = f"{title}: {counted(counts[0], 'trial')} per row"
    title += f" at error scale {value_text(rows[0]['error_scale'])}"
    return Table("summary", title, "", columns, whole="summary.csv")


def leading(rows: Sequence[Mapping[str, Any]], scenario: Sequence[str]) -> list[bool]:
    """Returns whether each row's estimator may be the best of its scenario, if another one is
    surely beaten."""

    def scenario_of(row: Mapping[str, Any]) -> tuple[str, ...]:
        return tuple(str(row[name]) for name in scenario)

    beaten = {scenario_of(row) for row in rows if not row[BEST]}
    return [bool(row[BEST]) and scenario_of(row) in beaten for row in rows]


def overview_columns(
    rows: Sequence[Mapping[str, Any]], best: Sequence[bool], *, narrow: bool = False
) -> list[Column]:
    """Returns the columns over all trials for every estimator; a narrow screen has no failures and
    short verdicts."""

    def numbers(
        title: str, key: str, show: Callable[[Mapping[str, Any]], str], best: Sequence[bool] = ()
    ) -> Column:
        keys = [sort_key(row[key]) for row in rows]
        return Column(title, cells(map(show, rows), keys, best))

    def error(row: Mapping[str, Any]) -> str:
        slash = "/" if narrow else " / "
        return f"{brief(row['error_median'])}{slash}{brief(row['error_q95'])}"

    def nees(row: Mapping[str, Any]) -> str:
        if row["claims"] < FEW:
            return "-"
        sign = sign_of(row["verdict"]) if narrow else _of_claims(row)
        return f"{brief(row['nees_mean'])} {sign}".strip()

    columns = [
        words("estimator", [row["estimator"] for row in rows], best),
        words("given", [row["given"] for row in rows]),
        numbers("success", "success", _success, best),
        numbers("failed", "failed_silent", _failed),
        numbers("error", "error_median", error),
        numbers("eff." if narrow else "efficiency", "efficiency_capped", _efficiency),
        numbers("NEES", "nees_mean", nees),
        words("verdict", map(_verdict, rows)),
        numbers("cost", "simulations_median", _cost),
        numbers("time", "time_mean_s", _time),
    ]
    return [one for one in columns if not narrow or one.title not in _WIDE]


def _success(row: Mapping[str, Any]) -> str:
    ends = ends_in_percent(row["success_low"], row["success_high"])
    return f"{share_text(row['success'])} ({'-'.join(ends)})"


def _verdict(row: Mapping[str, Any]) -> str:
    """Words a verdict, with the largest factor of the variance that is not excluded."""
    verdict = row["verdict"]
    high = row["nees_mean_high"]
    # Results of 0.3 do not have it.
    if verdict not in (CONSISTENT, NOT_REFUTED) or not math.isfinite(high):
        return shown(verdict)
    return f"{shown(verdict)}, within {factor(high)}"


def _of_claims(row: Mapping[str, Any]) -> str:
    """Says of how many trials a mean NEES is, unless of all."""
    return f"({row['claims']})" if row["claims"] < row["trials"] else ""


def factor(value: float) -> str:
    """Formats an upper end of a factor in two figures, rounded upwards."""
    size = 10 ** (math.floor(math.log10(value)) - 1)
    return f"{math.ceil(value / size - 1e-9) * size:.3g}"


def _failed(row: Mapping[str, Any]) -> str:
    return f"{share_text(row['failed_known'])} / {share_text(row['failed_silent'])}"


def _efficiency(row: Mapping[str, Any]) -> str:
    # Where half of the trials are capped, it is a limit and no value.
    sign = "<" if row["error_median"] > CAP else ""
    return f"{sign}{row['efficiency_capped']:.2f}"


def _cost(row: Mapping[str, Any]) -> str:
    return cost(row["simulations_median"], row["simulations_mean"])


def _time(row: Mapping[str, Any]) -> str:
    return duration(row["time_mean_s"], 2)


# Statistics ---------------------------------------------------------------------------------------


def statistics(where: Where, rows: Sequence[Mapping[str, Any]]) -> list[Column]:
    """Returns the columns of the statistics that are shown in that table."""
    columns: list[Column] = []
    for record in shown_in(where):
        if not reported(record, rows):
            continue
        title = record.titles.get(where, record.title)
        texts = [_shown(record, where, row) for row in rows]
        if record.kind == "word":
            columns.append(Column(title, cells(texts, repeat(None)), numeric=False))
        else:
            keys = [sort_key(row[record.name]) for row in rows]
            columns.append(Column(title, cells(texts, keys)))
        if where in record.limits_titles:
            nothing = dict.fromkeys(record.columns, math.nan)
            judged = [row if _applies(record, where, row) else nothing for row in rows]
            low, high = ([row[name] for row in judged] for name in record.columns[1:])
            show = _shower(record.kind, where)
            columns.append(interval(record.limits_titles[where], low, high, show))
    return columns


def shown_in(where: Where) -> list[Statistic]:
    """Returns the statistics that name a table."""
    return [record for record in (*all_statistics(), *SCORES) if where in record.where]


def reported(record: Statistic, rows: Sequence[Mapping[str, Any]]) -> bool:
    """Returns whether a table has a statistic's column; a rare one needs a finite value, a rare
    count one above 0."""
    if not record.rare:
        return True
    finite = [row[record.name] for row in rows if math.isfinite(row[record.name])]
    if record.kind == "count":
        return any(value > 0 for value in finite)
    return bool(finite)


def _shown(record: Statistic, where: Where, row: Mapping[str, Any]) -> str:
    """Formats a value in a table, with the number of trials behind it unless that is all."""
    if not _applies(record, where, row):
        return "-"
    text = _shower(record.kind, where)(row[record.name])
    if record.given and text != "-" and row[record.count] < row["trials"]:
        text += f" ({int(row[record.count])})"
    return text


def _applies(record: Statistic, where: Where, row: Mapping[str, Any]) -> bool:
    """Returns whether a row can have the statistic: an estimator that solves no equation has no
    solved trials. In the tables of parameters and of states its finished trials stand in for
    them."""
    if record.given != "solved" or where in ("parameters", "tracks"):
        return True
    return row["equation"] != "-"


def _shower(kind: Kind, where: Where) -> Callable[[Any], str]:
    """Returns the formatter of values of that kind in that table."""
    if kind == "physical" and where == "parameters":
        return _physical
    if kind == "seconds" and where == "terminal":
        return lambda value: duration(value, 2)
    return _SHOWERS[kind]


def _count(value: float) -> str:
    return f"{int(value):d}" if math.isfinite(value) else "-"


def _physical(value: float) -> str:
    # Physical units are of any size.
    return scientific(value) if math.isfinite(value) else short(value)


_SHOWERS: dict[Kind, Callable[[Any], str]] = {
    "count": _count,
    "share": percent,
    "number": short,
    "physical": short,
    "seconds": duration,
    "probability": p_value,
    "word": shown,
}
