"""The one kind of table, and how it is shown in a terminal, as HTML, Markdown, LaTeX and CSV."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ipe_bench.basics.files import write_text

if TYPE_CHECKING:
    import pandas as pd
    from jinja2 import Environment
    from rich.console import Group

LONG = 45
"""Number of rows from which a LaTeX table runs over pages."""
MOST_ROWS = 2000
"""Largest number of rows of a table on an HTML page."""
COLUMN, PAGE = 3.5, 7.16
"""Inches of IEEE's one and two columns."""
COLUMN_GAP = 3.0
"""Points between the edge of a column of a LaTeX table and its text."""
_NAMES = ("estimator", "first", "data set", "function", "parameter", "error")
"""Titles of the column that names a row."""
_WHOLE_NAME, _WHOLE_WORD = 24, 11
"""Letters of a row's name, and of any other text, up to which a terminal shows it on one line."""
_PADDING = 2
"""Blanks between two columns of a terminal."""


@dataclass(frozen=True)
class Cell:
    """One cell: its text, the key by which a column is sorted, and whether it is set in bold."""

    text: str
    key: Any = None
    best: bool = False


@dataclass(frozen=True)
class Column:
    """A column: numbers stand to the right, words to the left and may be folded."""

    title: str
    cells: Sequence[Cell]
    numeric: bool = True


@dataclass(frozen=True)
class Table:
    """A table with its file name, its title, the caption above it and the notes below it."""

    name: str
    title: str
    caption: str
    columns: Sequence[Column]
    data: pd.DataFrame | None = None
    """The numbers behind the cells, for the CSV file; without them the file has the cells."""
    appendix: bool = False
    """Whether the page shows it behind the figures."""
    notes: Sequence[str] = ()
    grouped: int = 0
    """Number of leading columns whose texts make a group of rows: a terminal shows them once a group."""
    repeated: int = 1
    """Number of leading columns that a terminal repeats when it shows the others in several tables, one below the
    other."""
    whole: str = ""
    """The file that has the columns for which a terminal has no room: they are named and not shown below."""

    @property
    def rows(self) -> Iterator[tuple[Cell, ...]]:
        return zip(*(c.cells for c in self.columns), strict=True)

    @property
    def naming(self) -> int:
        """Index of the column that names a row."""
        return next((i for i, c in enumerate(self.columns) if c.title in _NAMES), 0)

    def __len__(self) -> int:
        return len(self.columns[0].cells)


class Strong(str):
    """A sentence that stands out."""


Part = Table | str
"""What reports are made of: tables and sentences."""


def column(title: str, values: Iterable[Any], show: Callable[[Any], str], best: Iterable[bool] = ()) -> Column:
    """A column of numbers, written by `show`."""
    values = list(values)
    marks = list(best) or [False] * len(values)
    return Column(title, [Cell(show(v), sort_key(v), m) for v, m in zip(values, marks, strict=True)])


def words(title: str, values: Iterable[Any], best: Iterable[bool] = ()) -> Column:
    """A column of texts."""
    values = [str(v) for v in values]
    marks = list(best) or [False] * len(values)
    return Column(title, [Cell(v, None, m) for v, m in zip(values, marks, strict=True)], numeric=False)


def interval(title: str, low: Iterable[float], high: Iterable[float], show: Callable[[float], str]) -> Column:
    """A column of intervals, sorted by their lower ends."""
    pairs = zip(low, high, strict=True)
    return Column(title, [Cell(f"{show(a)} to {show(b)}" if math.isfinite(a) else "-", sort_key(a)) for a, b in pairs])


def texts(title: str, values: Iterable[str]) -> Column:
    """A column of numbers that are written already and by which no row is sorted."""
    return Column(title, [Cell(value) for value in values])


def sort_key(value: Any) -> str:
    """The number by which a cell is sorted; NaN and infinity go last."""
    number = float(value)
    return "1e999" if math.isnan(number) or number == math.inf else repr(number)


# Terminal ------------------------------------------------------------------------------------------------------------


def terminal(parts: Iterable[Part], width: int) -> Group:
    """Tables and sentences for a terminal; columns without room go below, or are named with the file that has them."""
    from rich.console import Group
    from rich.text import Text

    shown: list[Any] = []
    for part in parts:
        if not isinstance(part, Table):
            shown.append(Text(part, style="bold" if isinstance(part, Strong) else "dim"))
            continue
        if part.title:
            shown += [Text()] if shown and isinstance(shown[-1], Text) else []
            shown.append(Text(part.title, style="bold"))
        kept = max(part.repeated, part.naming + 1)
        head, rest = list(part.columns[:kept]), list(part.columns[kept:])
        notes = [text for text in (part.caption, *part.notes) if text]
        while True:
            count = min(1, len(rest))
            while count < len(rest) and _taken([*head, *rest[: count + 1]], part, folded=True) <= width:
                count += 1
            shown.append(_rich([*head, *rest[:count]], part, width))
            rest = rest[count:]
            if rest and part.whole:
                notes.insert(0, f"Too narrow for: {', '.join(c.title for c in rest)}; {part.whole} has them.")
            if not rest or part.whole:
                break
        shown += [Text(note, style="dim") for note in notes]
    return Group(*shown)


def _needed(column: Column, table: Table, *, folded: bool) -> int:
    """Minimal width of a column in letters: numbers are never folded, words are, and titles if `folded`."""
    from rich.cells import cell_len

    title = cell_len(column.title)
    if folded:
        title = min(max(map(cell_len, _words_of(column.title))), _WHOLE_NAME)
    longest = max((cell_len(cell.text) for cell in column.cells), default=0)
    if not column.numeric:
        longest = min(longest, _WHOLE_NAME if column is table.columns[table.naming] else _WHOLE_WORD)
    return max(title, longest, 1)


def _taken(columns: Iterable[Column], table: Table, *, folded: bool) -> int:
    """The width of a table of such columns, with the space between them."""
    return 2 + sum(_needed(column, table, folded=folded) + _PADDING for column in columns)


def _words_of(title: str) -> list[str]:
    """The words of a title; a number and its per cent are one."""
    return title.replace(" %", "\u00a0%").split(" ")


def _rich(columns: Sequence[Column], table: Table, width: int) -> Any:
    """Some columns of a table; titles are folded where they have no room otherwise."""
    from rich import box
    from rich.table import Table as RichTable
    from rich.text import Text

    shown = RichTable(box=box.SIMPLE_HEAD, padding=(0, 1), pad_edge=False, collapse_padding=True)
    folded = _taken(columns, table, folded=False) > width
    for each in columns:
        letters = _needed(each, table, folded=folded)
        title = Text(textwrap.fill(" ".join(_words_of(each.title)), letters).replace("\u00a0", " "))
        if each.numeric:
            shown.add_column(title, justify="right", no_wrap=True)
        else:
            shown.add_column(title, overflow="fold", min_width=letters)
    group: list[str] | None = None
    for row in zip(*(c.cells for c in columns), strict=True):
        cells = [cell.text for cell in row]
        if table.grouped and group == cells[: table.grouped]:
            cells[: table.grouped] = [""] * table.grouped
        elif table.grouped:
            if group is not None:
                shown.add_section()
            group = cells[: table.grouped]
        shown.add_row(*(Text(text, style="bold" if cell.best else "") for text, cell in zip(cells, row, strict=True)))
    return shown


# HTML ----------------------------------------------------------------------------------------------------------------


@cache
def environment() -> Environment:
    """The templates of pages; every text in them is escaped."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    made = Environment(
        loader=PackageLoader("ipe_bench.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.tests["strong"] = lambda part: isinstance(part, Strong)
    made.globals["MOST_ROWS"] = MOST_ROWS
    return made


def html(parts: Iterable[Part]) -> str:
    """Tables and sentences as a piece of a page."""
    return environment().get_template("parts.html.j2").module.fragment(list(parts))  # type: ignore[attr-defined]


# Files ---------------------------------------------------------------------------------------------------------------


def write_table(table: Table, folder: Path) -> list[Path]:
    """Writes one table as CSV, Markdown and LaTeX."""
    formats = {".csv": comma_separated(table), ".md": markdown(table), ".tex": latex(table)}
    for suffix, text in formats.items():
        write_text(folder / f"{table.name}{suffix}", text)
    return [folder / f"{table.name}{suffix}" for suffix in formats]


def comma_separated(table: Table) -> str:
    """The numbers behind the table in full precision, or else its cells."""
    import pandas as pd

    data = table.data
    if data is None:
        rows = [[cell.text for cell in row] for row in table.rows]
        data = pd.DataFrame(rows, columns=[c.title for c in table.columns])
    return data.to_csv(index=False)


def markdown(table: Table) -> str:
    """A GitHub table; names cannot break it."""

    def cell(value: str) -> str:
        for sign, escaped in (("\\", "\\\\"), ("|", "\\|"), ("<", "&lt;"), ("*", "\\*")):
            value = value.replace(sign, escaped)
        return " ".join(value.split())

    lines = [f"**{table.title}.** {cell(table.caption)}", ""]
    lines.append("| " + " | ".join(cell(c.title) for c in table.columns) + " |")
    lines.append("|" + "|".join("---:" if c.numeric else ":---" for c in table.columns) + "|")
    rows = [[f"**{cell(c.text)}**" if c.best else cell(c.text) for c in row] for row in table.rows]
    lines += [f"| {' | '.join(row)} |" for row in rows]
    return "\n".join([*lines, *(f"\n{cell(note)}" for note in table.notes)]) + "\n"


_SIGNS = {sign: f"\\{sign}" for sign in "&%$#_{}"} | {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "µ": r"\ensuremath{\mu}",
    "σ": r"\ensuremath{\sigma}",
    "√": r"\ensuremath{\surd}",
    "×": r"\ensuremath{\times}",
    "²": r"\textsuperscript{2}",
    "–": "--",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    "[": "{[}",  # which would be an option of the line's end before it
    '"': r"\textquotedbl{}",
}
_NUMBER = re.compile(r"-?\d[\d,]*(?:\.\d+)?(?:e[+-]?\d+)?")


def latex(table: Table, width: float | None = None) -> str:
    """To be read into a document with `\\input`, with booktabs and siunitx: the bare table, or one that floats with its
    caption in a column of that many inches; a longtable if it has more than `LONG` rows."""
    shape = "@{}" + "".join("r" if c.numeric else "l" for c in table.columns) + "@{}"
    head = [r"\toprule", _latex_row(map(_latex_title, table.columns)), r"\midrule"]
    rows = [_latex_row(map(_latex_cell, row, table.columns)) for row in table.rows]
    label = f"tab:{table.name.replace('_', '-')}"
    caption = rf"\caption{{{escaped(table.title)}. {escaped(table.caption)}}}\label{{{label}}}"
    size = rf"\footnotesize\setlength{{\tabcolsep}}{{{COLUMN_GAP:g}pt}}"
    comment = (
        rf"% {' '.join(table.title.split())}. Needs \usepackage{{booktabs, longtable, siunitx, amsmath}} and"
        r" \usepackage[T1]{fontenc}."
    )
    if len(table) > LONG:
        comment += " A longtable stands where the text has one column."
        more = rf"\multicolumn{{{len(table.columns)}}}{{r}}{{continued on the next page}} \\"
        foot = [r"\midrule", more, r"\endfoot", r"\bottomrule", r"\endlastfoot"]
        named = [] if width is None else [rf"{caption} \\"]
        lines = [*named, *head, r"\endfirsthead", *head, r"\endhead", *foot, *rows]
        lines = [rf"\begin{{longtable}}{{{shape}}}", *lines, r"\end{longtable}"]
        lines = lines if width is None else [f"{{{size}", *lines, "}"]
    else:
        lines = [rf"\begin{{tabular}}{{{shape}}}", *head, *rows, r"\bottomrule", r"\end{tabular}"]
        if width is not None:
            kind = "table" if width <= COLUMN else "table*"
            lines = [rf"\begin{{{kind}}}[tb]", r"\centering", caption, size, *lines, rf"\end{{{kind}}}"]
    return "\n".join([comment, *lines, ""])


def _latex_row(cells: Iterable[str]) -> str:
    return f"{' & '.join(cells)} \\\\"


def _latex_title(column: Column) -> str:
    """The title of a column, stacked if it is longer than its cells and its longest word."""
    letters = max([1, *(len(cell.text) for cell in column.cells), *map(len, column.title.split())])
    lines = [escaped(line) for line in textwrap.wrap(column.title, letters, break_on_hyphens=False)]
    stacked = r"\\".join(lines)
    return rf"\shortstack[{'r' if column.numeric else 'l'}]{{{stacked}}}" if len(lines) > 1 else stacked


def _latex_cell(cell: Cell, column: Column) -> str:
    """A cell; siunitx sets numbers, whose digits it groups by its own rules."""
    text = escaped(cell.text)
    if column.numeric:
        text = _NUMBER.sub(lambda m: f"\\num{{{m.group().replace(',', '')}}}", text).replace(r"} \%", r"}\,\%")
    return rf"\textbf{{{text}}}" if cell.best else text


def escaped(text: str) -> str:
    """Plain text with its special signs escaped, those that pdflatex may lack by their number."""
    return "".join(
        _SIGNS.get(char) or (char if char.isascii() and char.isprintable() else f"\\texttt{{U+{ord(char):04X}}}")
        for char in " ".join(text.split())
    )
