"""The one kind of table, and how it is shown in a terminal, as HTML, Markdown, LaTeX and CSV."""

from __future__ import annotations

import io
import math
import re
import textwrap
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ipe_bench.basics.files import write_text
from ipe_bench.report.formats import TABLES
from ipe_bench.report.style import DARK_RAMP, RAMP, ink

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

    @property
    def style(self) -> str:
        """How a terminal shows it."""
        return "bold" if self.best else ""


@dataclass(frozen=True)
class Column:
    """Describes a column: numbers are aligned right, words left and possibly folded."""

    title: str
    cells: Sequence[Cell]
    numeric: bool = True


class Strong(str):
    """A sentence that stands out."""


class Shown:
    """Shows an answer in a terminal and in a notebook."""

    def parts(self) -> Iterable[Part]:
        """Returns its tables and sentences, in order."""
        raise NotImplementedError

    def __str__(self) -> str:
        return plain_text(self.parts())

    def _repr_html_(self) -> str:
        return html(self.parts())


@dataclass(frozen=True)
class Table(Shown):
    """Holds a table with its file name, its title, the caption above it and the notes below it.

    A plugin offers a function of the analysis that returns one, or None where it would be empty.
    Required: `name`, `title`, `caption` and `columns` (`head`, `words` and `column` of `ipe_bench.report.tables` make
    them). Optional: the other fields. Promised: the function does not write into the analysis, and `name` is new.

    >>> from ipe_bench.report.tables import words
    >>> table = Table("methods", "Methods", "Who takes part.", [words("estimator", ["ekf", "ukf"])])
    >>> [cell.text for (cell,) in table.rows]
    ['ekf', 'ukf']
    """

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
    """Number of leading columns whose texts identify a group of rows: a terminal shows them once a group."""
    whole: str = ""
    """File with the columns for which a terminal has no room: they are named and not shown below."""

    def __post_init__(self) -> None:
        """Leaves out columns without content."""
        kept = [c for c in self.columns if any(cell.text for cell in c.cells)]
        object.__setattr__(self, "columns", kept or self.columns)

    @property
    def rows(self) -> Iterator[tuple[Cell, ...]]:
        return zip(*(c.cells for c in self.columns), strict=True)

    @property
    def naming(self) -> int:
        """Index of the column that names a row."""
        return next((i for i, c in enumerate(self.columns) if c.title in _NAMES), 0)

    def __len__(self) -> int:
        return len(self.columns[0].cells)

    def parts(self) -> list[Part]:
        return [self]

    def folded(self) -> Table:
        """Returns the same as it stands on paper and in a terminal."""
        return self


Part = Table | str
"""Element of a report: a table or a sentence."""


def column(
    title: str, values: Iterable[Any], show: Callable[[Any], str], best: Iterable[bool] = ()
) -> Column:
    """Makes a column of numbers, written by `show`."""
    values = list(values)
    marks = list(best) or [False] * len(values)
    return Column(
        title, [Cell(show(v), sort_key(v), m) for v, m in zip(values, marks, strict=True)]
    )


def words(title: str, values: Iterable[Any], best: Iterable[bool] = ()) -> Column:
    """Makes a column of texts."""
    values = [str(v) for v in values]
    marks = list(best) or [False] * len(values)
    return Column(
        title, [Cell(v, None, m) for v, m in zip(values, marks, strict=True)], numeric=False
    )


def interval(
    title: str, low: Iterable[float], high: Iterable[float], show: Callable[[float], str]
) -> Column:
    """Makes a column of intervals, sorted by their lower ends; one end alone has a sign before it."""

    def cell(a: float, b: float) -> str:
        if math.isnan(b):
            return f"> {show(a)}" if math.isfinite(a) else "-"
        return (
            f"{show(a)} to {show(b)}"
            if math.isfinite(a)
            else f"< {show(b)}"
            if math.isnan(a)
            else "-"
        )

    return Column(title, [Cell(cell(a, b), sort_key(a)) for a, b in zip(low, high, strict=True)])


def texts(title: str, values: Iterable[str]) -> Column:
    """Makes a column of numbers that are written already and by which no row is sorted."""
    return Column(title, [Cell(value) for value in values])


def sort_key(value: Any) -> str:
    """Returns the number by which a cell is sorted; NaN and infinity go last."""
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
        part = part.folded()
        if part.title:
            shown += [Text()] if shown and isinstance(shown[-1], Text) else []
            shown.append(Text(part.title, style="bold"))
        kept, notes = part.naming + 1, [text for text in (part.caption, *part.notes) if text]
        head, rest = list(part.columns[:kept]), list(part.columns[kept:])
        while True:
            count = min(1, len(rest))
            while count < len(rest) and _taken([*head, *rest[: count + 1]], part)[1] <= width:
                count += 1
            shown.append(_rich([*head, *rest[:count]], part, width))
            rest = rest[count:]
            if rest and part.whole:
                notes.insert(
                    0, f"Too narrow for: {', '.join(c.title for c in rest)}; {part.whole} has them."
                )
            if not rest or part.whole:
                break
        shown += [Text(note, style="dim") for note in notes]
    return Group(*shown)


def plain_text(parts: Iterable[Part], width: int = 120) -> str:
    """Returns the text that a terminal of that width shows, without colours."""
    from ipe_bench.report.screen import Screen

    shown = io.StringIO()
    Screen(width=width, file=shown, force_jupyter=False).print(terminal(parts, width))
    return shown.getvalue()


def _needed(column: Column, table: Table) -> tuple[int, int]:
    """Returns a column's letters with its title in one line, and with its title folded; numbers never fold."""
    from rich.cells import cell_len

    longest = max([1, *(cell_len(cell.text) for cell in column.cells)])
    if not column.numeric:
        longest = min(
            longest, _WHOLE_NAME if column is table.columns[table.naming] else _WHOLE_WORD
        )
    title = column.title.replace(" %", "\u00a0%")  # a number and its per cent are one word
    word = max(map(cell_len, title.split(" ")))
    return max(longest, cell_len(title)), max(longest, min(word, _WHOLE_NAME))


def _taken(columns: Iterable[Column], table: Table) -> tuple[int, int]:
    """Returns the width of a table of such columns with their titles in one line, and with them folded."""
    whole, folded = zip(*(_needed(column, table) for column in columns), strict=True)
    space = 2 + _PADDING * len(whole)
    return sum(whole) + space, sum(folded) + space


def _rich(columns: Sequence[Column], table: Table, width: int) -> Any:
    """Renders some columns of a table, with titles that are folded if they have no room."""
    from rich import box
    from rich.table import Table as RichTable
    from rich.text import Text

    shown = RichTable(box=box.SIMPLE_HEAD, padding=(0, 1), pad_edge=False, collapse_padding=True)
    folded = _taken(columns, table)[0] > width
    for each in columns:
        letters = _needed(each, table)[folded]
        title = Text(
            textwrap.fill(each.title.replace(" %", "\u00a0%"), letters).replace("\u00a0", " ")
        )
        if each.numeric:
            shown.add_column(title, justify="right", no_wrap=True)
        else:
            shown.add_column(title, overflow="fold", min_width=letters)
    rows = zip(*(c.cells for c in columns), strict=True)
    for group, members in groupby(rows, key=lambda row: row[: table.grouped]):
        for k, row in enumerate(members):
            first = [Cell("")] * len(group) if k and group else group
            shown.add_row(*(Text(c.text, style=c.style) for c in (*first, *row[len(group) :])))
        if group:
            shown.add_section()
    return shown


# HTML ----------------------------------------------------------------------------------------------------------------


@cache
def environment() -> Environment:
    """Returns the templates of pages; every text in them is escaped."""
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from markupsafe import Markup, escape

    made = Environment(
        loader=PackageLoader("ipe_bench.report.page", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    # Names may be broken behind their underscores.
    made.filters["soft"] = lambda text: escape(text).replace("_", Markup("_<wbr>"))
    made.tests["strong"] = lambda part: isinstance(part, Strong)
    made.globals["MOST_ROWS"] = MOST_ROWS
    made.globals["ramps"] = [[(color, ink(color)) for color in one] for one in (RAMP, DARK_RAMP)]
    return made


def html(parts: Iterable[Part]) -> str:
    """Tables and sentences as a piece of a page that has no style for them, such as a notebook."""
    return environment().get_template("notebook.html.j2").render(parts=list(parts))


# Files ---------------------------------------------------------------------------------------------------------------


def write_table(table: Table, folder: Path, formats: Sequence[str]) -> list[Path]:
    """Writes one table in those of the formats that are of tables; as CSV unless another file has it whole."""
    writers: dict[str, Any] = dict(zip(TABLES, (comma_separated, markdown, latex), strict=True))
    own = table.whole in ("", f"{folder.name}/{table.name}.csv")
    files = {
        kind: folder / f"{table.name}.{kind}"
        for kind in writers
        if kind in formats and (own or kind != "csv")
    }
    for kind, path in files.items():
        write_text(path, writers[kind](table))
    return list(files.values())


def comma_separated(table: Table) -> str:
    """Renders the numbers behind the table in full precision, or else its cells."""
    import pandas as pd

    cells = pd.DataFrame(
        [[cell.text for cell in row] for row in table.rows],
        columns=[c.title for c in table.columns],
    )
    return (cells if table.data is None else table.data).to_csv(index=False)


def markdown(table: Table) -> str:
    """Renders a GitHub table; names cannot break it."""

    def cell(value: str) -> str:
        return re.sub(r"([\\|*])", r"\\\1", " ".join(value.split())).replace("<", "&lt;")

    table = table.folded()
    rows = [[f"**{cell(c.text)}**" if c.best else cell(c.text) for c in row] for row in table.rows]
    head, *lines = [
        f"| {' | '.join(row)} |" for row in ([cell(c.title) for c in table.columns], *rows)
    ]
    rule = "|" + "|".join("---:" if c.numeric else ":---" for c in table.columns) + "|"
    title = [f"**{table.title}.** {cell(table.caption)}", ""] if table.title else []
    lines = [*title, head, rule, *lines]
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
    "▲": r"\ensuremath{\triangle}",
    "→": r"\ensuremath{\to}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    "[": "{[}",  # which would be an option of the line's end before it
    '"': r"\textquotedbl{}",
}
_NUMBER = re.compile(r"-?\d[\d,]*(?:\.\d+)?(?:e[+-]?\d+)?")


def latex(table: Table, width: float | None = None) -> str:
    r"""Renders a table for `\input`, by booktabs and siunitx: bare, or floating with its caption in a column of `width`
    inches; a longtable if it has more than `LONG` rows."""
    table = table.folded()
    shape = "@{}" + "".join("r" if c.numeric else "l" for c in table.columns) + "@{}"
    titles, *rows = [
        f"{' & '.join(cells)} \\\\"
        for cells in (
            map(_latex_title, table.columns),
            *(map(_latex_cell, row, table.columns) for row in table.rows),
        )
    ]
    head = [r"\toprule", titles, r"\midrule"]
    kind, repeated = ("longtable", [r"\endhead"]) if len(table) > LONG else ("tabular", [])
    lines = [
        rf"\begin{{{kind}}}{{{shape}}}",
        *head,
        *repeated,
        *rows,
        r"\bottomrule",
        rf"\end{{{kind}}}",
    ]
    if width is not None:
        label = f"tab:{table.name.replace('_', '-')}"
        caption = rf"\caption{{{escaped(table.title)}. {escaped(table.caption)}}}\label{{{label}}}"
        size = rf"\footnotesize\setlength{{\tabcolsep}}{{{COLUMN_GAP:g}pt}}"
        if repeated:
            lines = [f"{{{size}", lines[0], rf"{caption} \\", *lines[1:], "}"]
        else:
            kind = "table" if width <= COLUMN else "table*"
            lines = [
                rf"\begin{{{kind}}}[tb]",
                r"\centering",
                caption,
                size,
                *lines,
                rf"\end{{{kind}}}",
            ]
    needed = r"\usepackage{booktabs, longtable, siunitx, amsmath} and \usepackage[T1]{fontenc}."
    return "\n".join([f"% {' '.join(table.title.split())}. Needs {needed}", *lines, ""])


def _latex_title(column: Column) -> str:
    """Returns the title of a column, stacked if it is longer than its cells and its longest word."""
    letters = max([1, *(len(cell.text) for cell in column.cells), *map(len, column.title.split())])
    lines = [escaped(line) for line in textwrap.wrap(column.title, letters, break_on_hyphens=False)]
    stacked = r"\\".join(lines)
    return (
        rf"\shortstack[{'r' if column.numeric else 'l'}]{{{stacked}}}"
        if len(lines) > 1
        else stacked
    )


def _latex_cell(cell: Cell, column: Column) -> str:
    """Returns a cell; siunitx sets numbers, whose digits it groups by its own rules."""
    text = escaped(cell.text)
    if column.numeric:
        text = _NUMBER.sub(lambda m: f"\\num{{{m.group().replace(',', '')}}}", text).replace(
            r"} \%", r"}\,\%"
        )
    return rf"\textbf{{{text}}}" if cell.best else text


def escaped(text: str) -> str:
    """Escapes the special signs of plain text, those that pdflatex may lack by their number."""
    return "".join(
        _SIGNS.get(char)
        or (char if char.isascii() and char.isprintable() else f"\\texttt{{U+{ord(char):04X}}}")
        for char in " ".join(text.split())
    )
