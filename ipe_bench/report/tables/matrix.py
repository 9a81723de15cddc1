"""Makes the matrix of a comparison: estimators, the best first, by error scales or settings, with
success as number and colour, and a sign where the reported covariance is too small or not
judged."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import Any, ClassVar, NamedTuple

from ipe_bench.report.finding import MEANING, SUCCEEDS, Finding, Row, Standing, setting_words
from ipe_bench.report.style import RAMP, ink, step
from ipe_bench.report.tables.table import (
    NOT_JUDGED,
    SIGNS,
    TOO_SMALL,
    Cell,
    Column,
    Part,
    Strong,
    Table,
    words,
)
from ipe_bench.report.words import (
    brief,
    cost,
    duration,
    ends_in_percent,
    percent,
    share_text,
    value_text,
)
from ipe_bench.statistics.verdicts import (
    CONSISTENT,
    NO_VERDICT,
    NOT_REFUTED,
    OVERCONFIDENT,
    TOO_CAUTIOUS,
    UNDECIDED,
)
from ipe_bench.trials.thresholds import FEW

MATRIX = "matrix"
"""Begins the names of files of a matrix."""
SUCCESS = "success"
"""The name of the picture of its success."""
VIEWS = {
    "success": ("success", "Successful trials, %"),
    "error": ("error", "Median error, relative to"),
    "nees": ("covariance", "NEES, mean: 1 is right"),
    "cost": ("cost", "Simulations of a trial, median"),
}
"""What the cells of a page show, one view at a time: its name, and what number and colour are."""
_FAR = 10.0
"""Factor by which an error or NEES is off that has the colour of no success."""
MOST_MATRICES = 6
"""Settings that have a matrix each; the table has the others."""
_SEVERAL = 3
"""Rows from which equal ones are one."""
_BESIDE = 5
"""Lines of a matrix in a terminal besides its rows."""
LONG = 12
"""Letters of a setting from which a column has a letter for it, which a note explains."""
_SIGNS = {OVERCONFIDENT: TOO_SMALL, UNDECIDED: NOT_JUDGED, NO_VERDICT: NOT_JUDGED}
_COVARIANCE = {
    OVERCONFIDENT: "covariance too small",
    TOO_CAUTIOUS: "covariance too large",
    CONSISTENT: "no evidence against the covariance",
    NOT_REFUTED: "covariance not refuted",
}


class Shown(NamedTuple):
    """A number of a tile, and the place of its colour in `RAMP`."""

    text: str
    step: int


@dataclass(frozen=True)
class Tile(Cell):
    """One cell of a matrix."""

    number: str = ""
    """Success in per cent."""
    sign: str = ""
    step: int | None = None
    """Place of its colour in `RAMP`; None where there is no result."""
    fails: bool = False
    """Whether it is not shown that the estimator succeeds here."""
    views: dict[str, Shown] = field(default_factory=dict)
    says: str = ""
    """All that is known of it, for those who point at it."""

    @property
    def style(self) -> str:
        if self.step is None:
            return ""
        line = "underline " if self.fails else ""
        return f"{line}{ink(RAMP[self.step])} on {RAMP[self.step]}"


@dataclass(frozen=True)
class Matrix(Table):
    """Holds a table of tiles behind a column of names."""

    over: str = ""
    """What the columns are."""
    captions: Sequence[str] = ()
    """What its figure says of letters, numbers and signs."""
    letters: Sequence[str] = ()
    """What letters in place of long titles stand for, and who had the prior."""
    ends: Mapping[str, tuple[str, str, str]] = field(default_factory=dict)
    """The worst, a middle and the best number of each view."""
    moving: bool = False

    views: ClassVar = VIEWS

    @property
    def reference(self) -> str:
        return "the linearised filter" if self.moving else "the Cramér-Rao bound"

    @property
    def signs(self) -> set[str]:
        """The signs of its tiles."""
        return {tile.sign for tile in self.tiles}

    @property
    def tiles(self) -> list[Tile]:
        cells = [cell for column in self.columns for cell in column.cells]
        return [cell for cell in cells if isinstance(cell, Tile)]

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

    def joined(self) -> Matrix:
        """Returns one row in place of all, if there are several and their success is the same."""
        names, *others = self.columns
        rows = len(names.cells)
        alike = all(
            len({(cell.text, cell.style) for cell in column.cells}) == 1 for column in others
        )
        if rows < _SEVERAL or not alike:
            return self
        first = replace(names, cells=[Cell(f"all {rows}")])
        return replace(
            self, columns=[first, *(replace(one, cells=one.cells[:1]) for one in others)]
        )

    def folded(self) -> Matrix:
        """Returns the same as it stands on paper."""
        pairs = zip(self.joined().columns, self.on_paper, strict=True)
        columns = [replace(column, title=title) for column, title in pairs if title]
        return replace(self, columns=columns)


def opening(rows: Sequence[Row], lines: float = math.inf) -> list[Part]:
    """Returns the finding and its matrices, of several as many as those lines have room for."""
    finding = Finding.of(rows)
    shown = matrices(rows, lines)
    if shown and finding.across:
        last = shown[-1]
        notes = [*last.notes, finding.across]
        shown[-1] = replace(last, notes=notes, letters=[*last.letters, finding.across])
    return [Strong(finding.sentence()), *(shown or [MEANING])]


def matrices(rows: Iterable[Row], lines: float = math.inf) -> list[Matrix]:
    """Returns the matrix of a sweep, of several settings at one scale, or of each of several
    settings that are swept; none of a single scale, whose table says it all."""
    listed = list(rows)
    finding = Finding.of(listed)
    settings = list(dict.fromkeys(setting for setting, _ in finding.places))
    if len(finding.places) == 1:
        return []
    costs = _costs(listed)
    if len(settings) in (1, len(finding.places)):
        return [_matrix(finding, MATRIX, "", costs)]
    found = []
    fitting = lines / (len(finding.standings) + _BESIDE)
    most = min(MOST_MATRICES, max(1, fitting))
    for number, setting in enumerate(settings[: int(most)], 1):
        own = Finding.of(list(_rows_of(finding, setting)))
        found.append(_matrix(own, f"{MATRIX}_{number}", setting_words(setting), costs))
    # One legend below the last, of the signs of all.
    columns = [column for matrix in found for column in matrix.columns]
    legend = _legend(columns)
    further = len(settings) - len(found)
    left_out = []
    if further:
        left_out = [f"Of {len(settings)} settings {further} are only in the table."]
    found = [replace(matrix, notes=[]) for matrix in found]
    found[-1] = replace(found[-1], notes=[legend, *left_out], letters=left_out)
    return found


def _rows_of(finding: Finding, setting: str) -> Iterator[Row]:
    for one in finding.standings:
        for row, (named, _) in zip(one.rows, finding.places, strict=True):
            if row and named == setting:
                yield row


def _costs(rows: Sequence[Row]) -> tuple[float, float]:
    """Returns the least and the largest cost."""
    costs = [max(float(row["simulations_median"]), 1.0) for row in rows]
    known = [cost for cost in costs if math.isfinite(cost)]
    return min(known, default=1.0), max(known, default=1.0)


def _matrix(finding: Finding, name: str, title: str, costs: tuple[float, float]) -> Matrix:
    rows = [row for one in finding.standings for row in one.rows if row]
    moving = {row["noise"] for row in rows} == {"model"}
    names = [one.label for one in finding.standings]
    over = _over(finding)
    columns = [words(f"{over} →", names, finding.leading)]
    heads, keys = _heads(finding, over)
    for at, head in enumerate(heads):
        cells = [_tile(one, at, finding, moving, costs) for one in finding.standings]
        columns.append(Column(head, cells))
    low, high = costs
    off = (f"{_FAR:g} or more", f"{math.sqrt(_FAR):.0f}", "1")
    ends = {
        "success": ("0", "50", "100 %"),
        "error": off,
        "nees": off,
        "cost": (brief(high), brief(float(f"{math.sqrt(low * high):.2g}")), brief(low)),
    }
    return Matrix(
        name,
        title,
        "",
        columns,
        notes=[*keys, _legend(columns)],
        whole="summary.csv",
        over=over,
        captions=(*keys, _signs(columns)),
        letters=keys,
        ends=ends,
        moving=moving,
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
    cells = [cell for column in columns for cell in column.cells]
    told = _signs(columns)
    if any(isinstance(cell, Tile) and cell.fails for cell in cells):
        told += " Underlined: not shown to succeed."
    if any(cell.best for cell in cells):
        told += " Bold: best, or tied for best."
    return f"{told} {MEANING}"


def _signs(columns: Sequence[Column]) -> str:
    """Explains numbers, colours and the signs that are there."""
    signs = {cell.sign for column in columns for cell in column.cells if isinstance(cell, Tile)}
    told = [f"{VIEWS['success'][1]} (darker is better)."]
    told += [f"{sign} {words}." for sign, words in SIGNS.items() if sign in signs]
    return " ".join(told)


def _tile(
    one: Standing, at: int, finding: Finding, moving: bool, costs: tuple[float, float]
) -> Tile:
    row = one.rows[at]
    if row is None:
        return Tile("–", says=f"{one.label}: no result")
    verdict = row["verdict"]
    sign = _SIGNS.get(verdict, "")
    number = share_text(row["success"])
    fails = one.judged[at] != SUCCEEDS
    # A blank in place of a sign keeps numbers below each other.
    text = f"{number}{sign or ' '}"
    paid = row["simulations_median"]
    nees = row["nees_mean"] if row["claims"] >= FEW else math.nan
    views = {
        "success": Shown(number, step(row["success"])),
        "error": Shown(_brief(row["error_median"]), step(_nearness(row["error_median"]))),
        "nees": Shown(_brief(nees), step(_nearness(nees))),
        "cost": Shown(_brief(paid), step(_cheapness(paid, *costs))),
    }
    setting, scale = finding.places[at]
    where = f"error scale {value_text(scale)}"
    if not finding.ascending:
        where += f", {setting}"
    says = f"{one.label}, {where}: {_says(row, verdict, moving)}"
    return Tile(text, None, False, number, sign, views["success"].step, fails, views, says)


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
        f"NEES {_brief(row['nees_mean'])} of {row['claims']} converged: {covariance}",
        f"cost {simulations}, {duration(row['time_mean_s'], 2)}",
    )
    return "; ".join(told)


def _nearness(ratio: float) -> float:
    """Returns how near a ratio is to 1: 1 there, and 0 from ten times or a tenth on."""
    if not 0 < ratio < math.inf:
        return 0.0
    return max(0.0, 1 - abs(math.log(ratio, _FAR)))


def _cheapness(cost: float, low: float, high: float) -> float:
    """Returns where a cost lies between the largest, 0, and the least, 1, by its order."""
    if not cost < math.inf:
        return 0.0
    return 1.0 if high == low else math.log(high / max(cost, low)) / math.log(high / low)


def _brief(value: Any) -> str:
    return "–" if math.isnan(value) else brief(value)
