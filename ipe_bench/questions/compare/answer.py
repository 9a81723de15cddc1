"""Shows a comparison: sentences, tables, picture, files."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

import pandas as pd

from ipe_bench.basics.errors import UserError, refuse_unknown
from ipe_bench.questions.compare.effects import PowerPlan
from ipe_bench.questions.compare.maths import (
    JUDGED,
    MARGINS,
    NOT_SETTINGS,
    compared,
    comparison_title,
    gone,
    kind_of,
    left_out,
    other_sources,
    too_few,
)
from ipe_bench.report.page.writer import digests, write_files
from ipe_bench.report.tables.table import (
    Cell,
    Column,
    Fact,
    Legend,
    Part,
    Shown,
    Table,
    texts,
    words,
)
from ipe_bench.report.words import (
    compact,
    counted,
    duration,
    enumerate_few,
    p_value,
    percent,
    told_apart,
    value_text,
)
from ipe_bench.runs.store import require_results
from ipe_bench.statistics.collect import collect
from ipe_bench.statistics.comparisons import ALPHA

_TITLES = {"error": "mean error", "honesty": "mean NEES", "cost": "mean cost", "time": "mean time"}
"""Names of a comparison's quantities, where the table of a run has other statistics of error and
cost."""
_WORDS = ("", "second is")
"""Titles of the columns that hold no numbers."""
_FOUND = ("better", "worse", "perhaps better", "perhaps worse")
"""Words of a title."""
_DECIDED = 0.01
"""The corrected p below which a title has no perhaps, so that it is false for one in a hundred
comparisons of equals."""
_AS = {"success": "", "bias": ""}
"""What stands before a change: nothing before a difference, a sign before a ratio."""
_FAILING = ("success", "error")
"""Quantities in which the second must not be worse, unless others are named."""
_BY_P = (
    "p comes from McNemar's exact test for success and sign-flip tests for the rest, with Holm's"
    " correction over all tests."
)
_BY_EVIDENCE = "e-values stay valid under repeated looks; e = 20 is as rare as p = 0.05."
_LEAST_P = 1e-6
_MOST_EVIDENCE = 1000
_INTERVAL = "interval"
_MOST_SHOWN = 3
"""Quantities whose values stand beside the picture."""


class Comparison(Shown, pd.DataFrame):
    """Shows a comparison; what is selected of it is a plain frame."""

    def parts(self) -> Iterator[Part]:
        """Yields a table per comparison, within 80 columns, and what the columns mean."""
        interval = f"{100 * (1 - self.attrs['alpha']):g} %"
        anytime = self.attrs["anytime"]
        unused = "p" if anytime else "e"
        tests = _BY_EVIDENCE if anytime else _BY_P
        for title, rows in _comparisons(self):
            cells = [_cells(row, interval) for row in rows]
            names = [name for name in cells[0] if name != unused]
            columns = [_column(name, [one[name] for one in cells]) for name in names]
            planned = [row for row in rows if row.get("power", math.nan) > 0]
            notes = [_needed(row) for row in planned]
            yield Table("comparison", title, "", columns, notes=notes)
        yield (
            "error is the length of the error of all parameters, in standard deviations of the"
            " bound (Mahalanobis), at most the radius of the gate of success; cost counts"
            " simulations. Both are means over the common trials; the table of a run has medians,"
            f" and errors over the bound. {tests} Each interval is"
            " for its row only. Times are not tested. Between an estimator with a prior and one"
            " without, success is by the gate of the Cramér-Rao bound; in the table of a run each"
            " has the gate of its own bound."
        )
        margins = ", ".join(f"{name} {margin:g}" for name, margin in self.attrs["margins"].items())
        yield (
            f"better and worse are significant changes larger than a margin: {margins}. different"
            " is a significant change that may be smaller than the margin."
        )
        if self["quantity"].str.match("honesty|bias").any():
            yield (
                "NEES (honesty) is the squared error over the reported variance, by the number of"
                " parameters, where both converge: right is 1. bias is the mean error in"
                " deviations of the bound, where both succeed: right is 0."
            )
        if (self["matched_by"] == "order").any():
            yield "Without common trials pairing gains no precision: the intervals are wider."


def write_comparison(folder: Path, frame: Comparison, sources: Sequence[tuple[str, str]]) -> None:
    """Writes comparison.csv and its page."""
    from ipe_bench.questions.compare.figure import draw_pairs

    parts = list(frame.parts())
    tables = [part for part in parts if isinstance(part, Table)]
    legends = [Legend(sentence) for sentence in parts[len(tables) :]]
    compared = list(_comparisons(frame))
    tested = frame[frame["p"].notna()]
    lead = ""
    if len(tested):
        lead = (
            "Better or worse: a significant change in the same trials, larger than a margin of"
            f" {_margins(frame, tested['quantity'])}."
        )
    write_files(
        folder,
        "comparison",
        ("comparison.csv", frame),
        finding(frame),
        list(_facts(compared)) if len(compared) == 1 else (),
        [_joined(tables, legends)],
        draw_pairs(frame),
        lead=lead,
        facts=[counted(len(compared), "comparison")],
        sources=sources,
    )


def _margins(frame: Comparison, quantities: Iterable[str]) -> str:
    """Words the margins of these quantities."""
    kinds = dict.fromkeys(map(kind_of, quantities))
    margins = frame.attrs["margins"]
    return ", ".join(f"{_margin(kind, margins[kind])} in {kind}" for kind in kinds)


def _margin(kind: str, margin: float) -> str:
    if kind == "bias":
        return f"{margin:g}"
    unit = "%"
    if kind == "success":
        unit = "point" if 100 * margin == 1 else "points"
    return f"{100 * margin:g} {unit}"


def _facts(compared: Sequence[tuple[str, list[dict[str, Any]]]]) -> Iterator[Fact]:
    """States what both have, of the only comparison that there is."""
    ((heading, rows),) = compared
    yield Fact("Compared", f"{heading}.")
    for row in rows[:_MOST_SHOWN]:
        cells = _cells(row, _INTERVAL)
        told = f"{row['second']} {cells['second']}, {row['first']} {cells['first']}."
        if row["second"] == row["first"]:
            told = f"{cells['second']} after {cells['first']}."
        yield Fact(cells[""].capitalize(), told)


def _column(title: str, cells: Sequence[str]) -> Column:
    return words(title, cells) if title in _WORDS else texts(title, cells)


def _joined(tables: Sequence[Table], legends: Sequence[str]) -> Table:
    """Puts tables of the same columns below each other, their titles in a column, and below them
    what the columns mean."""
    if len(tables) == 1:
        (table,) = tables
        first, *others = table.columns
        columns = [replace(first, title="quantity"), *others]
        return replace(table, columns=columns, notes=[*table.notes, *legends])
    titles = list(dict.fromkeys(column.title for table in tables for column in table.columns))
    names = [table.title for table in tables for _ in table.rows]
    columns = [words("comparison", names)]
    for title in titles:
        cells = [cell for table in tables for cell in _under(table, title)]
        columns.append(Column(title or "quantity", cells, title not in _WORDS))
    notes = [*(note for table in tables for note in table.notes), *legends]
    return Table("comparison", "Trial by trial", "", columns, notes=notes, grouped=1)


def _under(table: Table, title: str) -> Sequence[Cell]:
    """Returns the cells of a table under a title, which are empty if it has no such column."""
    for column in table.columns:
        if column.title == title:
            return column.cells
    return [Cell("")] * len(table)


def finding(frame: pd.DataFrame) -> str:
    """Says in what the second is better or worse by more than a margin: by how much in a single
    comparison, or else in how many."""
    rows: Any = frame[frame["p"].notna()].to_dict("records")
    by_quantity: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        by_quantity.setdefault(row["quantity"], []).append(row)
    clauses = []
    for word in _FOUND:
        extents = []
        for each in by_quantity.values():
            found = [row for row in each if _said(row) == word]
            extents += [_extent(found, len(each))] if found else []
        if extents:
            clauses.append(f"{word} in {', '.join(extents)}")
    tested = [_TITLES.get(quantity, quantity) for quantity in by_quantity]
    nothing = f"not shown to differ by more than the margin in {enumerate_few(tested)}"
    return f"{_who(frame)}: {'; '.join(clauses) or (nothing if tested else 'not tested')}"


def _said(row: dict[str, Any]) -> str:
    return f"{'' if row['p'] < _DECIDED else 'perhaps '}{_verdict(row)}"


def _who(frame: pd.DataFrame) -> str:
    firsts = frame["first"].unique()
    seconds = frame["second"].unique()
    if len(firsts) == len(seconds) == 1 and firsts[0] != seconds[0]:
        return f"{seconds[0]} against {firsts[0]}"
    return "The second against the first"


def _extent(found: Sequence[dict[str, Any]], number: int) -> str:
    """Says how large a change is, or in how many comparisons of its quantity it is found."""
    row = found[0]
    quantity = row["quantity"]
    title = _TITLES.get(quantity, quantity)
    if number > 1:
        return f"{title} ({len(found)} of {number} comparisons)"
    sign = _AS.get(kind_of(quantity), "×")
    return f"{title} ({sign}{_cells(row, _INTERVAL)['change']})"


def _needed(row: dict[str, Any]) -> str:
    return (
        f"{row['trials_needed']:,} trials find a difference of {100 * row['difference']:g} % in"
        f" success with a probability of {100 * row['power']:g} %: only one of the two succeeds in"
        f" {row['discordant']} of {row['trials']} trials, so in at most"
        f" {percent(row['discordant_high'])} of all (80 % limit)."
    )


def _comparisons(frame: pd.DataFrame) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """Yields each comparison with its title, in order."""
    settings = [c for c in frame.columns if c not in NOT_SETTINGS]
    naming = (*settings, "first", "second")

    def named(row: dict[str, Any]) -> tuple[str, ...]:
        return tuple(value_text(row[column]) for column in naming)

    listed: list[Any] = frame.to_dict("records")
    for _, part in groupby(listed, key=named):
        rows = list(part)
        yield _heading(rows[0]), rows


def _heading(row: dict[str, Any]) -> str:
    who = row["first"]
    if row["second"] != who:
        who = f"{who}, then {row['second']}"
    how = "" if row["matched_by"] == "trial" else " of other seeds, matched in their order"
    return f"{comparison_title(row)}: {who}; {counted(row['trials'], 'trial')}{how}"


def _cells(row: dict[str, Any], interval: str) -> dict[str, str]:
    """Returns what the columns of a table say of one quantity."""
    quantity = row["quantity"]
    show = {"success": percent, "time": lambda v: duration(v, 2)}.get(quantity, compact)
    unit = " points" if quantity == "success" else ""
    change = "-"
    if math.isfinite(row["change"]):
        change = _change(quantity, row["change"]) + unit
    ends = "-"
    if math.isfinite(row["low"]):
        ends = " to ".join(told_apart(row["low"], row["high"], partial(_change, quantity)))
    return {
        "": _TITLES.get(quantity, quantity),
        "first": show(row["first_value"]),
        "second": show(row["second_value"]),
        "change": change,
        interval: ends,
        "p": _p(row["p"]),
        "e": _evidence(row["e"]),
        "second is": _verdict(row),
    }


def _change(quantity: str, value: float, more: int = 0) -> str:
    """Formats a difference of success in points, one of bias in deviations, or else a ratio, with
    so many `more` figures than usual."""
    if quantity == "success":
        return f"{100 * value:+.{1 + more}f}"
    if kind_of(quantity) == "bias":
        return f"{value:+.{3 + more}f}"
    if 0.1 <= value < 9.9995:
        return f"{value:.{3 + more}f}"
    return compact(value, more)


def _p(value: float) -> str:
    if not math.isfinite(value):
        return ""
    return p_value(value) if value >= _LEAST_P else f"<{_LEAST_P:g}"


def _evidence(value: float) -> str:
    if not math.isfinite(value):
        return ""
    return compact(value) if value <= _MOST_EVIDENCE else f">{_MOST_EVIDENCE}"


def _verdict(row: dict[str, Any]) -> str:
    if row["different"]:
        return row["finding"] or "different"
    # Times are not tested.
    return "" if row["quantity"] == "time" else "-"


def compared_folders(
    first_folders: Sequence[Path],
    second_folders: Sequence[Path] | None = None,
    *,
    first: str | None = None,
    second: str | None = None,
    alpha: float = ALPHA,
    anytime: bool = False,
    fail_on: Sequence[str] | None = None,
    margins: Mapping[str, float] | None = None,
    complete: bool = False,
    power: float | None = None,
    difference: float | None = None,
    output: Path | str | None = None,
) -> Comparison:
    """Compares what is stored, as `ipe_bench.compare` says; folders without a second hold both
    versions."""
    plan = PowerPlan.of(power, difference, anytime=anytime)
    tested = tuple(fail_on or JUDGED)
    widened = MARGINS | dict(margins or {})
    _require_known(alpha, tested, widened)
    if plan is not None and "success" not in tested:
        raise UserError(
            "power: concerns success, which fail_on does not name; add it, or leave out power"
        )
    versions = (first, second)
    one = require_results(first_folders)
    other = require_results(second_folders or first_folders)
    _require_two(first_folders, second_folders, versions)
    ours = collect(one)
    theirs = collect(other)
    read = digests(dict.fromkeys([*one, *other]))
    found = compared(
        ours,
        theirs,
        versions,
        alpha=alpha,
        anytime=anytime,
        plan=plan,
        tested=tested,
        margins=widened,
    )
    few = [] if anytime else list(too_few(found, alpha))
    lacking = list(gone(ours, theirs, versions)) if complete else []
    frame = Comparison(found)
    if plan is not None:
        # Other rows have no such numbers, which would make floats of them.
        for column in ("discordant", "trials_needed"):
            frame[column] = frame[column].astype("Int64")
    frame.attrs |= {
        "problems": [*dict.fromkeys([*ours.problems, *theirs.problems]), *lacking],
        "stale": list(dict.fromkeys([*ours.stale, *theirs.stale])),
        "worse": _worse(frame, _FAILING if fail_on is None else fail_on),
        "notes": [*few, *left_out(ours, theirs), *other_sources(ours, theirs)],
        "margins": widened,
        "alpha": alpha,
        "anytime": anytime,
    }
    if output is not None:
        write_comparison(Path(output), frame, read)
    return frame


def _require_known(alpha: float, tested: Sequence[str], margins: Mapping[str, float]) -> None:
    if not 0 < alpha < 1:
        raise UserError(f"alpha={alpha}: give a number between 0 and 1")
    for name in (*tested, *margins):
        refuse_unknown(f"fail_on={name}", name, MARGINS, "quantity")
    for name, margin in margins.items():
        if not 0 <= margin < math.inf:
            raise UserError(f"margin.{name}={margin}: give a number from 0 on")


def _require_two(
    first: Sequence[Path], second: Sequence[Path] | None, versions: tuple[str | None, str | None]
) -> None:
    """Refuses to compare a version with itself."""
    if second is None and None in versions:
        raise UserError(
            "compare: one folder is given; name another, or first=LABEL and second=LABEL"
        )
    label, other = versions
    if label == other and _places(first) == _places(second or first):
        named = "one folder" if label is None else f"{label} of one folder"
        raise UserError(
            f"compare: {named} is compared with itself; name another, or first=LABEL and"
            " second=LABEL"
        )


def _places(folders: Sequence[Path]) -> set[Path]:
    return {folder.resolve() for folder in folders}


def _worse(frame: Comparison, failing: Sequence[str]) -> list[str]:
    """Returns a line for each finding that fails the comparison."""
    kinds = frame["quantity"].map(kind_of)
    worse = frame[(frame["finding"] == "worse") & kinds.isin(list(failing))]
    rows: list[Any] = worse.to_dict("records")
    return [f"{row['second']} in {row['quantity']}, {comparison_title(row)}" for row in rows]
