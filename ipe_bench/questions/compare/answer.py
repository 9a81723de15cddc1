"""Shows a comparison: sentences, tables, picture, files."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain, groupby
from pathlib import Path
from typing import Any

import pandas as pd

from ipe_bench.basics.errors import UserError, unknown
from ipe_bench.questions.compare.effects import PowerPlan
from ipe_bench.questions.compare.maths import (
    JUDGED,
    MARGINS,
    NOT_SETTINGS,
    compared,
    comparison_title,
    gone,
    left_out,
    other_sources,
    too_few,
)
from ipe_bench.report.page.writer import digests, write_files
from ipe_bench.report.tables.table import Cell, Column, Part, Shown, Table, texts, words
from ipe_bench.report.words import compact, duration, p_value, percent, value_text
from ipe_bench.runs.bundles import opened
from ipe_bench.statistics.collect import collect
from ipe_bench.statistics.comparisons import ALPHA

_TITLES = {"error": "mean error", "honesty": "mean NEES", "cost": "mean cost", "time": "mean time"}
"""Names of a comparison's quantities, where the table of a run has other statistics of error and cost."""
_LEAST_P, _MOST_EVIDENCE = 1e-6, 1000


class Comparison(Shown, pd.DataFrame):
    """Shows a comparison; what is selected of it is a plain frame."""

    def parts(self) -> Iterator[Part]:
        """Yields a table per comparison, within 80 columns, and what the columns mean."""
        titles = (
            "",
            "first",
            "second",
            "change",
            f"{100 * (1 - self.attrs['alpha']):g} %",
            "p",
            "e",
            "second is",
        )
        for title, rows in _comparisons(self):
            cells = zip(titles, zip(*map(_cells, rows), strict=True), strict=True)
            columns = [
                (words if title in ("", "second is") else texts)(title, column)
                for title, column in cells
            ]
            needed = [_needed(row) for row in rows if row.get("power", math.nan) > 0]
            yield Table("comparison", title, "", columns, notes=needed)
        yield (
            "error is its length in standard deviations of the bound (Mahalanobis), where a trial counts as at most"
            " the radius of the gate of success; cost counts simulations. Both are means over the common trials,"
            " where the table of a run has medians, and errors over the bound. p comes from McNemar's exact test for"
            " success and from random signs for the others, with Holm's correction over all tests. e is evidence that"
            " may be looked at repeatedly; e = 20 is as rare as p = 0.05. Each interval holds for its row alone."
            " Times are not tested."
        )
        margins = ", ".join(f"{name} {margin:g}" for name, margin in self.attrs["margins"].items())
        yield (
            f"better and worse are significant changes larger than a margin: {margins}. different is a significant"
            " change that may be smaller than the margin."
        )
        if self["quantity"].str.match("honesty|bias").any():
            yield (
                "NEES (honesty) is the squared error over the reported variance, by the number of parameters, where"
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
    shown = (
        list(_finding_sentences(frame)),
        [_joined(tables), *parts[len(tables) :]],
        draw_pairs(frame),
    )
    write_files(
        folder, "comparison", ("comparison.csv", frame), "Comparison", *shown, sources=sources
    )


def _joined(tables: Sequence[Table]) -> Table:
    """Puts tables of the same columns below each other, their titles in a column."""
    titles = list(dict.fromkeys(column.title for table in tables for column in table.columns))
    columns = [words("comparison", [table.title for table in tables for _ in table.rows])]
    for title in titles:
        found = [next((c for c in table.columns if c.title == title), None) for table in tables]
        cells = [c.cells if c else [Cell("")] * len(t) for c, t in zip(found, tables, strict=True)]
        columns.append(
            Column(
                title or "quantity",
                list(chain.from_iterable(cells)),
                title not in ("", "second is"),
            )
        )
    notes = [note for table in tables for note in table.notes]
    return Table("comparison", "Trial by trial", "", columns, notes=notes, grouped=1)


def _finding_sentences(frame: pd.DataFrame) -> Iterator[str]:
    """Says in how many comparisons the second is better, and worse, by quantity."""
    judged, names = (
        frame[frame["p"].notna()],
        [frame[which].unique() for which in ("first", "second")],
    )
    who = [
        str(each[0]) if len(each) == 1 and len({*names[0], *names[1]}) == 2 else ""
        for each in names
    ]
    number = judged.groupby("quantity").size().max()
    for word in ("better", "worse"):
        counts = judged[judged["finding"] == word].groupby("quantity", sort=False).size()
        listed = ", ".join(
            f"{quantity} ({count} of {number} comparisons)" for quantity, count in counts.items()
        )
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
    for _, part in groupby(
        listed, key=lambda row: tuple(value_text(row[c]) for c in (*settings, "first", "second"))
    ):
        rows = list(part)
        first = rows[0]
        who = (
            first["first"]
            if first["first"] == first["second"]
            else f"{first['first']}, then {first['second']}"
        )
        how = "" if first["matched_by"] == "trial" else " of other seeds, matched in their order"
        yield (
            f"{comparison_title(first)}: {who}; {first['trials']} trial{'s' * (first['trials'] != 1)}{how}",
            rows,
        )


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    quantity = row["quantity"]
    show = {"success": percent, "time": lambda v: duration(v, 2)}.get(quantity, compact)
    if quantity == "success":
        change, ends = (
            f"{100 * row['change']:+.1f} %",
            f"{100 * row['low']:+.1f} to {100 * row['high']:+.1f}",
        )
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
    """Compares what is stored, as `ipe_bench.compare` says; folders without a second hold both versions."""
    plan = PowerPlan.of(power, difference, anytime=anytime)
    tested = tuple(fail_on or JUDGED)
    widened = MARGINS | dict(margins or {})
    _require_known(alpha, tested, widened)
    if plan is not None and "success" not in tested:
        raise UserError(
            "power: concerns success, which fail_on does not name; add it, or leave out power"
        )
    versions = (first, second)
    with opened(first_folders) as one, opened(second_folders or first_folders) as other:
        _require_two(first_folders, second_folders, versions)
        asked = collect(one), collect(other)
        read = digests(dict.fromkeys([*one, *other]))
        found = compared(
            *asked,
            versions,
            alpha=alpha,
            anytime=anytime,
            plan=plan,
            tested=tested,
            margins=widened,
        )
        few = [] if anytime else list(too_few(found, alpha))
        lacking = list(gone(*asked, versions)) if complete else []
    frame = Comparison(found)
    if plan is not None:
        whole = ["discordant", "trials_needed"]
        frame[whole] = frame[whole].astype("Int64")
    for name in ("problems", "stale"):
        frame.attrs[name] = list(
            dict.fromkeys(line for one in asked for line in getattr(one, name))
        )
    frame.attrs["problems"] += lacking
    frame.attrs["worse"] = _worse(frame, ("success", "error") if fail_on is None else fail_on)
    frame.attrs["notes"] = [*few, *left_out(*asked), *other_sources(*asked)]
    frame.attrs["margins"] = widened
    frame.attrs["alpha"] = alpha
    if output is not None:
        write_comparison(Path(output), frame, read)
    return frame


def _require_known(alpha: float, tested: Sequence[str], margins: Mapping[str, float]) -> None:
    if not 0 < alpha < 1:
        raise UserError(f"alpha={alpha}: give a number between 0 and 1")
    for name in (*tested, *margins):
        if name not in MARGINS:
            raise UserError(f"fail_on={name}: {unknown(name, MARGINS, 'quantity')}")
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
    same = {path.resolve() for path in first} == {path.resolve() for path in second or first}
    label = versions[0]
    if same and label == versions[1]:
        named = "one folder" if label is None else f"{label} of one folder"
        raise UserError(
            f"compare: {named} is compared with itself; name another, or first=LABEL and second=LABEL"
        )


def _worse(frame: Comparison, failing: Sequence[str]) -> list[str]:
    """Returns a line for each finding that fails the comparison."""
    quantity = frame["quantity"].str.split(" ").str[0]
    worse = frame[(frame["finding"] == "worse") & quantity.isin(list(failing))]
    rows = [{str(name): value for name, value in row.items()} for row in worse.to_dict("records")]
    return [f"{row['second']} in {row['quantity']}, {comparison_title(row)}" for row in rows]
