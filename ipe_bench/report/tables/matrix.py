"""Makes the matrix of a comparison: estimators, the best first, by error scales or settings, with
success as number and colour, and a sign where the reported covariance is too small or not
judged."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import Any, ClassVar

from ipe_bench.report.finding import HELD, MEANING, Finding, Row, Standing, setting_words
from ipe_bench.report.style import RAMP, ink
from ipe_bench.report.tables.table import Cell, Column, Part, Strong, Table, words
from ipe_bench.report.words import (
    brief,
    cost,
    duration,
    ends_in_percent,
    percent,
    value_text,
)
from ipe_bench.statistics.verdicts import (
    CONSISTENT,
    NO_VERDICT,
    OVERCONFIDENT,
    TOO_CAUTIOUS,
    UNDECIDED,
)

MATRIX = "matrix"
"""Begins the names of files of a matrix."""
VIEWS = {
    "success": "success, %",
    "error": "error, median",
    "nees": "NEES, median",
    "cost": "cost, simulations",
    "time": "time",
}
"""What the cells of a page show, one view at a time; the colour is of success in each."""
TOO_SMALL = "▲"
NOT_JUDGED = "?"
MOST_MATRICES = 6
"""Settings that have a matrix each; the table has the others."""
_BESIDE = 5
"""Lines of a matrix in a terminal besides its rows."""
LONG = 12
"""Letters of a setting from which a column has a letter for it, which a note explains."""
_COVARIANCE = {
    OVERCONFIDENT: "covariance too small",
    TOO_CAUTIOUS: "covariance too large",
    CONSISTENT: "no evidence against the covariance",
}
_WELL = 0.995
"""Share of success that is well: the lightest colour."""


@dataclass(frozen=True)
class Tile(Cell):
    """One cell of a matrix."""

    number: str = ""
    """Success in per cent."""
    sign: str = ""
    step: int | None = None
    """Place of its colour in `RAMP`; None where there is no result."""
    views: dict[str, str] = field(default_factory=dict)
    says: str = ""
    """All that is known of it, for those who point at it."""

    @property
    def style(self) -> str:
        if self.step is None:
            return ""
        return f"{ink(RAMP[self.step])} on {RAMP[self.step]}"


@dataclass(frozen=True)
class Matrix(Table):
    """Holds a table of tiles behind a column of names."""

    over: str = ""
    """What the columns are."""
    captions: Sequence[str] = ()
    """What its figure says of letters, numbers and signs."""

    views: ClassVar = VIEWS

    @property
    def on_paper(self) -> list[str]:
        """Titles of the columns on paper: neighbouring scales whose cells say the same are one, and
        the further ones have no title."""

        def texts(column: Column) -> list[str]:
            return [cell.text for cell in column.cells]

        titles = [self.columns[0].title]
        for _, alike in groupby(self.columns[1:], texts):
            same = [column.title for column in alike]
            if self.over != "error scale":
                titles += same
                continue
            ends = dict.fromkeys((same[0], same[-1]))
            titles.append(" to ".join(ends))
            titles += [""] * (len(same) - 1)
        return titles

    def folded(self) -> Matrix:
        """Returns the same as it stands on paper."""
        pairs = zip(self.columns, self.on_paper, strict=True)
        columns = [replace(column, title=title) for column, title in pairs if title]
        return replace(self, columns=columns)


def opening(rows: Sequence[Row], lines: float = math.inf) -> list[Part]:
    """Returns the finding and its matrices, of several as many as those lines have room for."""
    shown = matrices(rows, lines) or [MEANING]
    return [Strong(Finding.of(rows).sentence()), *shown]


def matrices(rows: Iterable[Row], lines: float = math.inf) -> list[Matrix]:
    """Returns the matrix of a sweep, of several settings at one scale, or of each of several
    settings that are swept; none of a single scale, whose table says it all."""
    listed = list(rows)
    finding = Finding.of(listed)
    settings = list(dict.fromkeys(setting for setting, _ in finding.places))
    if len(finding.places) == 1:
        return []
    if len(settings) in (1, len(finding.places)):
        return [_matrix(finding, MATRIX, "")]
    found = []
    fitting = lines / (len(finding.standings) + _BESIDE)
    most = min(MOST_MATRICES, max(1, fitting))
    for number, setting in enumerate(settings[: int(most)], 1):
        own = Finding.of(list(_rows_of(finding, setting)))
        found.append(_matrix(own, f"{MATRIX}_{number}", setting_words(setting)))
    # One legend below the last, of the signs of all.
    columns = [column for matrix in found for column in matrix.columns]
    legend = _legend(columns)
    further = len(settings) - len(found)
    if further:
        legend += f" Of {len(settings)} settings {further} are in the table alone."
    found = [replace(matrix, notes=[]) for matrix in found]
    found[-1] = replace(found[-1], notes=[legend])
    return found


def _rows_of(finding: Finding, setting: str) -> Iterator[Row]:
    for one in finding.standings:
        for row, (named, _) in zip(one.rows, finding.places, strict=True):
            if row and named == setting:
                yield row


def _matrix(finding: Finding, name: str, title: str) -> Matrix:
    rows = [row for one in finding.standings for row in one.rows if row]
    moving = {row["noise"] for row in rows} == {"model"}
    names = [one.label for one in finding.standings]
    over = _over(finding)
    columns = [words(f"{over} →", names, finding.leading)]
    heads, keys = _heads(finding, over)
    for at, head in enumerate(heads):
        cells = [_tile(one, at, finding, moving) for one in finding.standings]
        columns.append(Column(head, cells))
    notes = [*keys, _legend(columns)]
    captions = (*keys, _signs(columns))
    return Matrix(
        name, title, "", columns, notes=notes, whole="summary.csv", over=over, captions=captions
    )


def _over(finding: Finding) -> str:
    """Names what the columns are: error scales, values of the one option that is swept, or
    settings."""
    if finding.ascending:
        return "error scale"
    options = {setting.rpartition("=")[0] for setting, _ in finding.places}
    (option, *others) = options
    return "setting" if others or "=" in option else option or "setting"


def _heads(finding: Finding, over: str) -> tuple[list[str], list[str]]:
    """Returns the titles of the columns, and a note that explains letters in place of long ones."""
    if finding.ascending:
        return [value_text(scale) for _, scale in finding.places], []
    settings = [setting.removeprefix(f"{over}=") for setting, _ in finding.places]
    texts = [setting_words(setting) for setting in settings]
    if max(map(len, texts)) <= LONG:
        return texts, []
    letters = [_letter(at) for at in range(len(texts))]
    told = map(": ".join, zip(letters, texts, strict=True))
    return letters, ["; ".join(told) + "."]


def _letter(at: int) -> str:
    """Returns the letter of a column, or its number behind the alphabet."""
    return chr(ord("A") + at) if at < 26 else f"#{at + 1}"


def _legend(columns: Sequence[Column]) -> str:
    is_bold = any(cell.best for column in columns for cell in column.cells)
    bold = " Bold: no other significantly holds longer, or in more settings." if is_bold else ""
    return f"{_signs(columns)}{bold} {MEANING}"


def _signs(columns: Sequence[Column]) -> str:
    """Explains numbers, colours and the signs that are there."""
    signs = {cell.sign for column in columns for cell in column.cells if isinstance(cell, Tile)}
    told = f"Number and colour: success in % of all trials, blue from {100 * HELD:.0f} % on."
    if TOO_SMALL in signs:
        told += f" {TOO_SMALL} The reported covariance is too small."
    if NOT_JUDGED in signs:
        told += f" {NOT_JUDGED} Not judged: too few trials, or none reported."
    return told


def _tile(one: Standing, at: int, finding: Finding, moving: bool) -> Tile:
    row = one.rows[at]
    if row is None:
        return Tile("–", says=f"{one.label}: no result")
    verdict = row["verdict"]
    sign = TOO_SMALL if verdict == OVERCONFIDENT else ""
    sign = NOT_JUDGED if verdict in (UNDECIDED, NO_VERDICT) else sign
    number = points(row["success"])
    # A blank in place of a sign keeps numbers below each other.
    text = f"{number}{sign or ' '}"
    views = {
        "success": number,
        "error": _brief(row["error_median"]),
        "nees": _brief(row["nees_median"]),
        "cost": _brief(row["simulations_median"]),
        "time": duration(row["time_mean_s"], 2),
    }
    setting, scale = finding.places[at]
    where = f"error scale {value_text(scale)}"
    where = where if finding.ascending else f"{where}, {setting}"
    says = f"{one.label}, {where}: {_says(row, verdict, moving)}"
    return Tile(text, None, False, number, sign, step(row["success"]), views, says)


def _says(row: Row, verdict: str, moving: bool) -> str:
    low, high = ends_in_percent(row["success_low"], row["success_high"])
    trials = int(row["trials"])
    reference = "the linearised filter" if moving else "the bound"
    error = f"error {_brief(row['error_median'])} × {reference}"
    covariance = _COVARIANCE.get(verdict, "covariance not judged")
    simulations = cost(row["simulations_median"], row["simulations_mean"])
    told = (
        f"success {percent(row['success'])} of {trials:,} trials (95 %: {low} to {high})",
        f"{error}, 95 % of trials below {_brief(row['error_q95'])}",
        f"NEES {_brief(row['nees_median'])}: {covariance}",
        f"cost {simulations}, {duration(row['time_mean_s'], 2)}",
    )
    return "; ".join(told)


def points(share: float) -> str:
    """Formats a share in per cent in at most five letters; it is never rounded to all, none or the
    level that holds."""
    value = 100 * share
    if value in (0, 100):
        return f"{value:.0f}"
    if value > 99.95 or value < 0.05:
        return ">99.9" if value > 50 else "<0.1"
    if 9.95 <= value < 89.5 or 100 * HELD <= value < 99:
        return f"{value:.0f}"
    if value < 100 * HELD:
        value = min(value, 100 * HELD - 0.1)
    return f"{value:.1f}"


def step(share: float) -> int:
    """Returns the place of a share of success in the colours: two from the level that holds on, the
    others below."""
    if share >= _WELL:
        return 0
    if share >= HELD:
        return 1
    above = int(share / HELD * (len(RAMP) - 2))
    return len(RAMP) - 1 - above


def _brief(value: Any) -> str:
    return "–" if math.isnan(value) else brief(value)
