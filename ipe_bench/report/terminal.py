"""The summary as a table in the terminal: where it is narrow, columns go from the right, never the names."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from typing import TYPE_CHECKING, Any

from ipe_bench.report.words import compact, limits, plain, reported, shown
from ipe_bench.statistics.records import Statistic, all_statistics
from ipe_bench.statistics.summary import ALL
from ipe_bench.statistics.summary import columns as summary_columns

if TYPE_CHECKING:
    import pandas as pd
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

WIDE = 120
_WHOLE_NAME = 24
"""Letters of a name up to which it stands in one line; longer ones are folded where there is no room."""
_PADDING = 2


def render(
    summary: pd.DataFrame | Sequence[Mapping[str, Any]],
    certified: pd.DataFrame | None = None,
    width: int = WIDE,
    attained: pd.DataFrame | None = None,
) -> Group:
    """One table per setting (measurement, noise, and every option that differs), a section per error scale.

    `summary` is the frame or its rows. Columns that do not fit the width are left out, and named below. Runs on
    certified readings, whose mean digits are in `certified`, share one table instead, and so do those on problems of
    known minimum, whose totals are in `attained`.
    """
    from rich.console import Group
    from rich.text import Text

    digits = [] if certified is None or certified.empty else _digits(certified, width)
    digits += [] if attained is None or attained.empty else _attained(attained, width)
    listed: Sequence[Any] = summary if isinstance(summary, Sequence) else summary.to_dict("records")
    rows: list[Any] = [row for row in listed if row["parameter"] == ALL and row["noise"] != "certified"]
    if not rows:
        return Group(*digits or [Text("nothing is stored yet")])
    known = {*summary_columns(), "parameter", "unit", "estimator", "error_scale"}
    columns = dict.fromkeys(c for row in rows for c in row if c not in known and not c.startswith("estimator."))
    settings: dict[str, list[Any]] = {}
    for row in rows:
        named = {k: row.get(k) for k in columns}
        title = ", ".join(
            str(v) if k in ("measurement", "noise") else f"{k}={plain(v)}" for k, v in named.items() if _says(v)
        )
        settings.setdefault(title, []).append(row)
    parts: list[Any] = []
    absent: dict[str, None] = {}
    for title, part in settings.items():
        table, left_out = _setting(title, part, width)
        parts.append(table)
        absent |= dict.fromkeys(left_out)
    if absent:
        parts.append(Text(f"Too narrow for: {', '.join(absent)}; summary.csv has them.", style="dim"))
    note = (
        "efficiency: the bound that applies over the root mean square error, 1 at best, with its 95 % bootstrap"
        " interval: of the solved trials (their number in brackets where it is not all), and of all. Filters and the"
        " linear estimate solve no equation. NEES: 1 where the reported covariance is right. misfit: trials whose"
        " residuals fail the test of fit at 0.1 %. "
        + ("ambiguous: several minima fit. " if any(math.isfinite(row["ambiguous"]) for row in rows) else "")
        + "sims, time: medians per trial, a Jacobian counting what it costs."
    )
    return Group(*digits, *parts, Text(note, style="dim"))


def _setting(title: str, part: Sequence[Mapping[str, Any]], width: int) -> tuple[Table, list[str]]:
    """The table of one setting, and the headings of what does not fit."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    # The number of trials stands in the title where it is the same for all.
    counts = list({row["trials"] for row in part})
    alike = len(counts) == 1
    records = [record for record in all_statistics() if "terminal" in record.where]
    shown = [r for r in records if not (alike and r.name == "trials") and reported(r, part)]
    headings = ["scale", "estimator", *_headings(shown)]
    sections = [
        [[f"{scale:g}" if i == 0 else "", str(row["estimator"]), *_cells(shown, row)] for i, row in enumerate(block)]
        for scale, block in groupby(part, key=lambda row: row["error_scale"])
    ]
    fitting = _fitting(headings, [row for section in sections for row in section], width)
    table = Table(
        title=Text(f"{title}: {counts[0]} trial{'s' * (counts[0] != 1)} per row" if alike else title),
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        padding=(0, 1),
        pad_edge=False,
        collapse_padding=True,
    )
    for heading in headings[:fitting]:
        if heading == "estimator":
            longest = max(len(str(row["estimator"])) for row in part)
            table.add_column(heading, overflow="fold", min_width=min(longest, _WHOLE_NAME))
        else:
            table.add_column(heading, justify="right", no_wrap=True)
    for section in sections:
        for row in section:
            table.add_row(*map(Text, row[:fitting]))
        table.add_section()
    return table, headings[fitting:]


def _fitting(headings: Sequence[str], rows: Sequence[Sequence[str]], width: int) -> int:
    """How many columns fit, counted from the left: the scale and the names always; long names are folded."""
    from rich.cells import cell_len

    needed = 2  # at both edges
    for i, heading in enumerate(headings):
        longest = max(cell_len(text) for text in (heading, *(row[i] for row in rows)))
        needed += (min(longest, _WHOLE_NAME) if heading == "estimator" else longest) + _PADDING
        if needed > width and i > 1:
            return i
    return len(headings)


def _says(value: Any) -> bool:
    """Whether a setting is spoken of in a title: not where it is absent, as an option of another class is."""
    return value is not None and not (isinstance(value, float) and math.isnan(value))


def _digits(averages: pd.DataFrame, width: int) -> list[Any]:
    """Mean correct digits on certified readings."""
    from rich.text import Text

    headings = ("start", "data sets", "solved", "digits", "of deviations", "of residuals", "deviations to 6 digits")
    rows = [
        [
            str(row.estimator),
            *map(str, (row.start, row.datasets, row.solved)),
            *(f"{v:.2f}" for v in (row.mean_lre_parameters, row.mean_lre_deviations, row.mean_lre_rss)),
            str(row.deviations_to_6_digits),
        ]
        for row in averages.sort_values(["mean_lre_parameters", "start"], ascending=False).itertuples()
    ]
    note = (
        "digits: log relative error against the certified answer, the fewest over a data set's parameters, at most 11,"
        " averaged over the data sets. solved: four digits or more."
    )
    table = _totals("Certified readings", ("estimator", *headings), rows, width, "tables/certified_averages.csv")
    return [*table, Text(note, style="dim"), Text()]


def _attained(totals: pd.DataFrame, width: int) -> list[Any]:
    """Problems of known minimum that are solved."""
    from rich.text import Text

    from ipe_bench.report.certified_tables import attained_columns

    columns = attained_columns(totals.sort_values("solved", ascending=False, kind="stable", ignore_index=True))
    rows = [[cell.text for cell in row] for row in zip(*(each.cells for each in columns), strict=True)]
    note = (
        "solved: the estimate's sum of squares is the least known one, to 1e-6; converged: of these, where the status"
        " says so; elsewhere: converged and not solved. median cost: simulations, infinite where unsolved. in 10:"
        " solved within 10 (n + 1) simulations."
    )
    table = _totals("Known minima", [each.title for each in columns], rows, width, "tables/attained.csv")
    return [*table, Text(note, style="dim"), Text()]


def _totals(
    title: str, headings: Sequence[str], rows: Sequence[Sequence[str]], width: int, file: str
) -> Iterator[Table | Text]:
    """A row per estimator, with as many columns as fit; `file` has those that do not."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    # Where all headings fit as they are, none is folded; names and numbers never are.
    whole, folded = (
        [max(map(len, (*heads, *cells))) for heads, cells in zip(parts, zip(*rows, strict=True), strict=True)]
        for parts in ([[heading] for heading in headings], [heading.split() for heading in headings])
    )
    widths = whole if _taken(whole) <= width else folded
    fitting = len(widths)
    while fitting > 1 and _taken(widths[:fitting]) > width:
        fitting -= 1
    table = Table(
        title=title,
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        pad_edge=False,
        collapse_padding=True,
    )
    for k, (heading, room) in enumerate(zip(headings[:fitting], widths, strict=False)):
        table.add_column(textwrap.fill(heading, room), justify="right" if k else "left", no_wrap=True)
    for row in rows:
        table.add_row(*map(Text, row[:fitting]))
    yield table
    if fitting < len(headings):
        yield Text(f"Too narrow for: {', '.join(headings[fitting:])}; {file} has them.", style="dim")


def _taken(widths: Sequence[int]) -> int:
    """By a table of such columns, with the space between them."""
    return 2 + sum(widths) + _PADDING * len(widths)


def _headings(records: Sequence[Statistic]) -> Iterator[str]:
    for record in records:
        yield record.titles.get("terminal", record.title)
        if "terminal" in record.limits_titles:
            yield record.limits_titles["terminal"]


def _cells(records: Sequence[Statistic], row: Any) -> Iterator[str]:
    for record in records:
        yield shown(record, "terminal", row)
        if "terminal" in record.limits_titles:
            low, high = limits(record, "terminal", row)
            yield f"{compact(low)}-{compact(high)}" if math.isfinite(low) else "-"
