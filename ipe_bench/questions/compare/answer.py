"""Shows a comparison: sentences, tables, picture, files."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import chain, groupby
from pathlib import Path
from typing import Any

import pandas as pd

from ipe_bench.questions.compare.maths import NOT_SETTINGS, comparison_title
from ipe_bench.report.table import Cell, Column, Part, Shown, Table, texts, words
from ipe_bench.report.words import compact, duration, p_value, percent, value_text
from ipe_bench.report.writer import write_files

_TITLES = {"error": "mean error", "honesty": "mean NEES", "cost": "mean cost", "time": "mean time"}
"""Names of a comparison's quantities, where the table of a run has other statistics of error and cost."""
_LEAST_P, _MOST_EVIDENCE = 1e-6, 1000


class Comparison(Shown, pd.DataFrame):
    """Shows a comparison; what is selected of it is a plain frame."""

    def parts(self) -> Iterator[Part]:
        """Yields a table per comparison, within 80 columns, and what the columns mean."""
        titles = ("", "first", "second", "change", f"{100 * (1 - self.attrs['alpha']):g} %", "p", "e", "second is")
        for title, rows in _comparisons(self):
            cells = zip(titles, zip(*map(_cells, rows), strict=True), strict=True)
            columns = [(words if title in ("", "second is") else texts)(title, column) for title, column in cells]
            needed = [_needed(row) for row in rows if row.get("power", math.nan) > 0]
            yield Table("comparison", title, "", columns, notes=needed)
        yield (
            "error is its length in standard deviations of the bound (Mahalanobis), where a trial counts as at most"
            " the radius of the gate of success; cost counts simulations. Both are means over the common trials,"
            " where the table of a run has medians, and errors over the bound. p comes from McNemar's exact test for"
            " success and from random signs for the others, with Holm's correction over all tests. e is evidence that"
            " may be looked at repeatedly; e = 20 is as rare as p = 0.05. Each interval is that of its row alone."
            " Times are not tested."
        )
        margins = ", ".join(f"{name} {margin:g}" for name, margin in self.attrs["margins"].items())
        yield (
            f"better and worse are changes that p tells from none, by more than a margin: {margins}. different is a"
            " change that may be smaller than the margin."
        )
        if self["quantity"].str.match("honesty|bias").any():
            yield (
                "NEES (honesty) is the squared error over the claimed variance, by the number of parameters, where"
                " both converge: right is 1. bias is the mean error in deviations of the bound, where both succeed:"
                " right is 0."
            )
        if (self["matched_by"] == "order").any():
            yield "Without common trials pairing gains no precision: the intervals are wider."


def write_comparison(folder: Path, frame: Comparison, sources: Sequence[tuple[str, str]]) -> None:
    """Writes comparison.csv and its page."""
    from ipe_bench.questions.compare.figure import draw_pairs

    parts = list(frame.parts())
    tables = [part for part in parts if isinstance(part, Table)]
    shown = list(_finding_sentences(frame)), [_joined(tables), *parts[len(tables) :]], draw_pairs(frame)
    write_files(folder, "comparison", ("comparison.csv", frame), "Comparison", *shown, sources=sources)


def _joined(tables: Sequence[Table]) -> Table:
    """Puts tables of the same columns below each other, their titles in a column."""
    titles = list(dict.fromkeys(column.title for table in tables for column in table.columns))
    columns = [words("comparison", [table.title for table in tables for _ in table.rows])]
    for title in titles:
        found = [next((c for c in table.columns if c.title == title), None) for table in tables]
        cells = [c.cells if c else [Cell("")] * len(t) for c, t in zip(found, tables, strict=True)]
        columns.append(Column(title or "quantity", list(chain.from_iterable(cells)), title not in ("", "second is")))
    notes = [note for table in tables for note in table.notes]
    return Table("comparison", "Trial by trial", "", columns, notes=notes, grouped=1)


def _finding_sentences(frame: pd.DataFrame) -> Iterator[str]:
    """Says in how many comparisons the second is better, and worse, by quantity."""
    judged, names = frame[frame["p"].notna()], [frame[which].unique() for which in ("first", "second")]
    who = [str(each[0]) if len(each) == 1 and len({*names[0], *names[1]}) == 2 else "" for each in names]
    number = judged.groupby("quantity").size().max()
    for word in ("better", "worse"):
        counts = judged[judged["finding"] == word].groupby("quantity", sort=False).size()
        listed = ", ".join(f"{quantity} ({count} of {number} comparisons)" for quantity, count in counts.items())
        than = f"{who[1]} is {word} than {who[0]}" if all(who) else f"The second is {word}"
        yield f"{than} in {listed or 'no tested quantity'}."


def _needed(row: dict[str, Any]) -> str:
    return (
        f"{row['trials_needed']:,} trials find a difference of {100 * row['difference']:g} % in success with a"
        f" probability of {100 * row['power']:g} %: one alone succeeds in {row['discordant']} of {row['trials']}"
        f" trials, so in at most {percent(row['discordant_high'])} of all (80 % limit)."
    )


def _comparisons(frame: pd.DataFrame) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """Yields each comparison with its title, in order."""
    settings = [c for c in frame.columns if c not in NOT_SETTINGS]
    listed: list[Any] = frame.to_dict("records")
    for _, part in groupby(listed, key=lambda row: tuple(value_text(row[c]) for c in (*settings, "first", "second"))):
        rows = list(part)
        first = rows[0]
        who = first["first"] if first["first"] == first["second"] else f"{first['first']}, then {first['second']}"
        how = "" if first["matched_by"] == "trial" else " of other seeds, matched in their order"
        yield f"{comparison_title(first)}: {who}; {first['trials']} trial{'s' * (first['trials'] != 1)}{how}", rows


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    quantity = row["quantity"]
    show = {"success": percent, "time": lambda v: duration(v, 2)}.get(quantity, compact)
    if quantity == "success":
        change, ends = f"{100 * row['change']:+.1f} %", f"{100 * row['low']:+.1f} to {100 * row['high']:+.1f}"
    elif quantity.startswith("bias "):
        change, ends = f"{row['change']:+.3f}", f"{row['low']:+.3f} to {row['high']:+.3f}"
    else:
        change, ends = _ratio(row["change"]), f"{_ratio(row['low'])} to {_ratio(row['high'])}"
    p, e = row["p"], row["e"]
    return (
        *(_TITLES.get(quantity, quantity), show(row["first_value"]), show(row["second_value"])),
        change if math.isfinite(row["change"]) else "-",
        ends if math.isfinite(row["low"]) else "-",
        (p_value(p) if p >= _LEAST_P else f"<{_LEAST_P:g}") if math.isfinite(p) else "",
        (compact(e) if e <= _MOST_EVIDENCE else f">{_MOST_EVIDENCE}") if math.isfinite(e) else "",
        row["finding"] or ("different" if row["different"] else "-" if quantity != "time" else ""),
    )


def _ratio(value: float) -> str:
    return f"{value:.3f}" if 0.1 <= value < 9.9995 else compact(value)
