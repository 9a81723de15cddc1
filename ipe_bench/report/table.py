"""The one kind of table, and what it looks like in a terminal, as HTML, Markdown, LaTeX and CSV.

What tables contain is said elsewhere, in `tables`, `answer`, `designs` and their kin. Must not import pandas or rich
before a table is shown.
"""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
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
_WHOLE_NAME = 24
"""Letters of a row's name up to which a terminal shows it on one line."""
_WHOLE_WORD = 11
"""Letters of any other text up to which a terminal shows it on one line."""
_PADDING = 2


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
    repeated: int = 0
    """Number of leading columns that a terminal repeats when it shows the others in several tables, one below the
    other; 0: columns for which there is no room are left out, from the right."""
    whole: str = ""
    """The file that has the columns for which a terminal has no room."""

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
"""What an answer is made of: tables and sentences."""


def column(title: str, values: Iterable[Any], show: Callable[[Any], str], best: Sequence[bool] | None = None) -> Column:
    """A column of numbers, written by `show`."""
    values = list(values)
    marks = [False] * len(values) if best is None else list(best)
    return Column(title, [Cell(show(v), sort_key(v), m) for v, m in zip(values, marks, strict=True)])


def words(title: str, values: Iterable[Any], best: Sequence[bool] | None = None) -> Column:
    """A column of texts."""
    values = [str(v) for v in values]
    marks = [False] * len(values) if best is None else list(best)
    return Column(title, [Cell(v, None, m) for v, m in zip(values, marks, strict=True)], numeric=False)


def interval(title: str, low: Iterable[float], high: Iterable[float], show: Callable[[float], str]) -> Column:
    """A column of intervals, sorted by their lower ends."""
    pairs = zip(low, high, strict=True)
    return Column(title, [Cell(f"{show(a)} to {show(b)}" if math.isfinite(a) else "-", sort_key(a)) for a, b in pairs])


def texts(title: str, values: Iterable[str], *, numeric: bool = True) -> Column:
    """A column of cells that are written already and are not sorted by a number."""
    return Column(title, [Cell(value) for value in values], numeric)


def sort_key(value: Any) -> str:
    """The number by which a cell is sorted; NaN and infinity go last."""
    number = float(value)
    return "1e999" if math.isnan(number) or number == math.inf else repr(number)


# Terminal ------------------------------------------------------------------------------------------------------------


def terminal(parts: Iterable[Part], width: int) -> Group:
    """Tables and sentences for a terminal of that width; what has no room is named with the file that has it."""
    from rich.console import Group
    from rich.text import Text

    shown: list[Any] = []
    absent: dict[str, dict[str, None]] = {}

    def tell() -> None:
        for file, titles in absent.items():
            where = f"; {file} has them" if file else ""
            shown.append(Text(f"Too narrow for: {', '.join(titles)}{where}.", style="dim"))
        absent.clear()

    for part in parts:
        if not isinstance(part, Table):
            tell()
            shown.append(Text(part, style="bold" if isinstance(part, Strong) else "dim"))
            continue
        if part.whole not in absent:
            tell()
        for piece in _pieces(part, width):
            fitting, room = _fitting(piece, width)
            if piece.title:
                blank = [Text()] if shown and isinstance(shown[-1], Text) else []
                shown += [*blank, Text(piece.title, style="bold")]
            shown.append(_rich(replace(piece, columns=piece.columns[:fitting]), room))
            for left_out in piece.columns[fitting:]:
                absent.setdefault(part.whole, {})[left_out.title] = None
        notes = [text for text in (part.caption, *part.notes) if text]
        if notes:
            tell()
            shown += [Text(note, style="dim") for note in notes]
    tell()
    return Group(*shown)


def _pieces(table: Table, width: int) -> Iterator[Table]:
    """The table itself, or tables with the repeated columns and as many of the others as have room beside them."""
    if not table.repeated:
        yield table
        return
    head, rest = list(table.columns[: table.repeated]), list(table.columns[table.repeated :])
    title = table.title
    while rest:
        count = 1
        while count < len(rest) and _fits(replace(table, columns=[*head, *rest[: count + 1]]), width):
            count += 1
        yield replace(table, title=title, columns=[*head, *rest[:count]])
        rest, title = rest[count:], ""


def _fits(table: Table, width: int) -> bool:
    return _taken(_needed(table, folded=False)) <= width


def _needed(table: Table, *, folded: bool) -> list[int]:
    """Minimal width of each column in letters: numbers are never folded, words are, and titles if `folded`."""
    from rich.cells import cell_len

    found = []
    for i, each in enumerate(table.columns):
        title = cell_len(each.title)
        if folded:
            title = min(max(map(cell_len, _words_of(each.title))), _WHOLE_NAME)
        longest = max((cell_len(cell.text) for cell in each.cells), default=0)
        if not each.numeric:
            longest = min(longest, _WHOLE_NAME if i == table.naming else _WHOLE_WORD)
        found.append(max(title, longest))
    return found


def _fitting(table: Table, width: int) -> tuple[int, list[int]]:
    """The number of columns that fit, from the left, and their minimal widths; titles are folded if more columns fit
    then."""
    least = max(2, table.naming + 1, table.repeated + 1)

    def count(needed: Sequence[int]) -> int:
        fitting = len(needed)
        while fitting > least and _taken(needed[:fitting]) > width:
            fitting -= 1
        return fitting

    whole, folded = _needed(table, folded=False), _needed(table, folded=True)
    needed = folded if count(folded) > count(whole) else whole
    return count(needed), needed[: count(needed)]


def _words_of(title: str) -> list[str]:
    """The words of a title; a number and its per cent are one."""
    return title.replace(" %", "\u00a0%").split(" ")


def _taken(widths: Iterable[int]) -> int:
    """The width of a table of such columns, with the space between them."""
    return 2 + sum(width + _PADDING for width in widths)


def _rich(table: Table, room: Sequence[int]) -> Any:
    from rich import box
    from rich.table import Table as RichTable
    from rich.text import Text

    shown = RichTable(
        box=box.SIMPLE_HEAD,
        padding=(0, 1),
        pad_edge=False,
        collapse_padding=True,
    )
    for each, letters in zip(table.columns, room, strict=True):
        folded = textwrap.fill(" ".join(_words_of(each.title)), max(letters, 1))
        title = Text(folded.replace("\u00a0", " "))
        if each.numeric:
            shown.add_column(title, justify="right", no_wrap=True)
        else:
            shown.add_column(title, overflow="fold", min_width=letters)
    group: list[str] | None = None
    for row in table.rows:
        cells = [cell.text for cell in row]
        if table.grouped:
            if group == cells[: table.grouped]:
                cells[: table.grouped] = [""] * table.grouped
            else:
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


# Markdown and CSV ----------------------------------------------------------------------------------------------------


def markdown(table: Table) -> str:
    """A GitHub table; names cannot break it."""

    def cell(value: str) -> str:
        value = value.replace("\\", "\\\\").replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*")
        return " ".join(value.split())

    lines = [f"**{table.title}.** {cell(table.caption)}", ""]
    lines.append("| " + " | ".join(cell(c.title) for c in table.columns) + " |")
    lines.append("|" + "|".join("---:" if c.numeric else ":---" for c in table.columns) + "|")
    for row in table.rows:
        shown = [f"**{cell(c.text)}**" if c.best else cell(c.text) for c in row]
        lines += ["| " + " | ".join(shown) + " |"]
    return "\n".join([*lines, *(f"\n{cell(note)}" for note in table.notes)]) + "\n"


def comma_separated(table: Table) -> str:
    """The numbers behind the table in full precision, or else its cells."""
    if table.data is not None:
        return table.data.to_csv(index=False)
    import csv
    import io

    written = io.StringIO()
    lines = csv.writer(written, lineterminator="\n")
    lines.writerow([each.title for each in table.columns])
    lines.writerows([cell.text for cell in row] for row in table.rows)
    return written.getvalue()


def write_table(table: Table, folder: Path) -> list[Path]:
    """Writes one table as CSV, Markdown and LaTeX."""
    formats = {".csv": comma_separated(table), ".md": markdown(table), ".tex": latex(table)}
    for suffix, text in formats.items():
        write_text(folder / f"{table.name}{suffix}", text)
    return [folder / f"{table.name}{suffix}" for suffix in formats]


# LaTeX, with booktabs and siunitx ------------------------------------------------------------------------------------

_SIGNS = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    **{sign: f"\\{sign}" for sign in "&%$#_{}"},
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
    """To be read into a document with `\\input`: the bare table, or one that floats with its caption in a column of
    that many inches; a longtable if it has more than `LONG` rows."""
    shape = "".join("r" if each.numeric else "l" for each in table.columns)
    titles = _latex_row(map(_latex_title, table.columns))
    head, rows = (
        [r"\toprule", titles, r"\midrule"],
        [_latex_row(map(_latex_cell, r, table.columns)) for r in table.rows],
    )
    caption = (
        rf"\caption{{{escaped(table.title)}. {escaped(table.caption)}}}\label{{tab:{table.name.replace('_', '-')}}}"
    )
    size = rf"\footnotesize\setlength{{\tabcolsep}}{{{COLUMN_GAP:g}pt}}"
    needs = r"\usepackage{booktabs, longtable, siunitx, amsmath} and \usepackage[T1]{fontenc}"
    comment = f"% {' '.join(table.title.split())}. Needs {needs}."
    if len(table) > LONG:
        more = rf"\multicolumn{{{len(shape)}}}{{r}}{{continued on the next page}} \\"
        foot = [r"\midrule", more, r"\endfoot", r"\bottomrule", r"\endlastfoot"]
        named = [] if width is None else [rf"{caption} \\"]
        lines = [*named, *head, r"\endfirsthead", *head, r"\endhead", *foot, *rows, r"\end{longtable}"]
        lines = [rf"\begin{{longtable}}{{@{{}}{shape}@{{}}}}", *lines]
        comment += " A longtable stands where the text has one column."
        lines = lines if width is None else [f"{{{size}", *lines, "}"]
    else:
        lines = [rf"\begin{{tabular}}{{@{{}}{shape}@{{}}}}", *head, *rows, r"\bottomrule", r"\end{tabular}"]
        if width is not None:
            kind = "table" if width <= COLUMN else "table*"
            begin = [rf"\begin{{{kind}}}[tb]", r"\centering", caption, size]
            lines = [*begin, *lines, rf"\end{{{kind}}}"]
    return "\n".join([comment, *lines, ""])


def _latex_row(cells: Iterable[str]) -> str:
    return f"{' & '.join(cells)} \\\\"


def _latex_title(column: Column) -> str:
    """The title of a column, stacked if it is longer than its cells."""
    lines = [escaped(line) for line in textwrap.wrap(column.title, letters(column), break_on_hyphens=False)]
    stacked = r"\\".join(lines)
    return rf"\shortstack[{'r' if column.numeric else 'l'}]{{{stacked}}}" if len(lines) > 1 else stacked


def letters(column: Column) -> int:
    """The letters of the widest cell, or of the longest word of the title, which is no less."""
    return max([1, *(len(cell.text) for cell in column.cells), *map(len, column.title.split())])


def _latex_cell(cell: Cell, column: Column) -> str:
    text = _set_numbers(escaped(cell.text)) if column.numeric else escaped(cell.text)
    return rf"\textbf{{{text}}}" if cell.best else text


def escaped(text: str) -> str:
    """Plain text with its special signs escaped, those that pdflatex may lack by their number."""
    return "".join(
        _SIGNS.get(char) or (char if char.isascii() and char.isprintable() else f"\\texttt{{U+{ord(char):04X}}}")
        for char in " ".join(text.split())
    )


def _set_numbers(escaped: str) -> str:
    """The numbers of a cell set by siunitx, which groups digits by its own rules."""
    text = _NUMBER.sub(lambda m: f"\\num{{{m.group().replace(',', '')}}}", escaped)
    return text.replace(r"} \%", r"}\,\%")
