"""The one kind of table, and how it is shown in a terminal, as HTML, Markdown, LaTeX and CSV."""

from __future__ import annotations

import io
import math
import re
import textwrap
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import groupby, repeat
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
_MANY_ROWS = 100_000
"""Rows beyond which a CSV is written by Arrow."""
_FORMULA = re.compile(r"[=@]|[+-](?!inf\b)[^\d\s.]|[+-].*([|!]|\w\()")
"""Texts that a spreadsheet computes, unlike signed numbers."""
MOST_ROWS = 400
"""Largest number of rows of a table on an HTML page."""
COLUMN = 3.5
"""Inches of IEEE's column."""
PAGE = 7.16
"""Inches of IEEE's two columns with the gap between them."""
COLUMN_GAP = 3.0
"""Points between the edge of a column of a LaTeX table and its text."""
_NAMES = ("estimator", "first", "data set", "function", "parameter", "error")
"""Titles of the column that names a row."""
_WHOLE_NAME = 24
"""Letters of a row's name up to which a terminal shows it on one line."""
_WHOLE_WORD = 11
"""Letters of any other text up to which a terminal shows it on one line."""
_PADDING = 2
"""Blanks between two columns of a terminal."""


TOO_SMALL = "▲"
NOT_JUDGED = "?"
SIGNS = {TOO_SMALL: "covariance too small", NOT_JUDGED: "covariance not judged"}
"""Signs of a reported covariance."""


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

    @property
    def has_content(self) -> bool:
        return any(cell.text for cell in self.cells)


class Fact(str):
    """A sentence behind a label, which a page shows apart."""

    def __new__(cls, label: str, text: str) -> Fact:
        one = super().__new__(cls, f"{label}: {text}")
        one.label = label
        one.text = text
        return one

    def __getnewargs__(self) -> tuple[str, str]:
        """Lets it be copied and sent to other processes."""
        return self.label, self.text

    label: str
    text: str


class Strong(str):
    """A sentence that stands out."""


class Legend(str):
    """A note that says what columns mean, which a page folds."""


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
    Required: `name`, `title`, `caption` and `columns` (`head`, `words` and `column` of
    `ipe_bench.report.tables` make them). Optional: the other fields. Promised: the function does
    not write into the analysis, and `name` is new.

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
    """Number of leading columns whose texts identify a group of rows: a terminal shows them once a
    group."""
    whole: str = ""
    """File with the columns for which a terminal has no room: they are named and not shown
    below."""

    def __post_init__(self) -> None:
        """Leaves out columns without content."""
        kept = [column for column in self.columns if column.has_content]
        object.__setattr__(self, "columns", kept or self.columns)

    @property
    def rows(self) -> Iterator[tuple[Cell, ...]]:
        return zip(*(c.cells for c in self.columns), strict=True)

    @property
    def naming(self) -> int:
        """Index of the column that names a row."""
        for index, column in enumerate(self.columns):
            if column.title in _NAMES:
                return index
        return 0

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
    return Column(title, cells(map(show, values), map(sort_key, values), best))


def words(title: str, values: Iterable[Any], best: Iterable[bool] = ()) -> Column:
    """Makes a column of texts."""
    return Column(title, cells(map(str, values), repeat(None), best), numeric=False)


def texts_of(rows: pd.DataFrame, *names: str) -> list[Column]:
    """Makes columns of the texts in a frame, under their own names."""
    return [words(name, rows[name]) for name in names]


def counts_of(rows: pd.DataFrame, *names: str) -> list[Column]:
    """Makes columns of the whole numbers in a frame, under their own names."""
    return [column(name, rows[name], str) for name in names]


def naming(title: str, things: Iterable[Any]) -> list[Column]:
    """Makes the columns of the names of parameters or states, and of their units."""
    named = [(one.name, one.unit) for one in things]
    names, units = zip(*named, strict=True)
    return [words(title, names), words("unit", units)]


def cells(texts: Iterable[str], keys: Iterable[Any], best: Iterable[bool] = ()) -> list[Cell]:
    """Makes a cell of each text, with its key, and in bold if it is among the `best`."""
    texts = list(texts)
    marks = list(best) or [False] * len(texts)
    marked = zip(texts, marks, strict=True)
    return [Cell(text, key, mark) for (text, mark), key in zip(marked, keys, strict=False)]


def interval(
    title: str, low: Iterable[float], high: Iterable[float], show: Callable[[float], str]
) -> Column:
    """Makes a column of intervals, sorted by their lower ends; one end alone has a sign before
    it."""

    def shown(low: float, high: float) -> str:
        if math.isnan(high):
            return f"> {show(low)}" if math.isfinite(low) else "-"
        if math.isfinite(low):
            return f"{show(low)} to {show(high)}"
        return f"< {show(high)}" if math.isnan(low) else "-"

    ends = list(zip(low, high, strict=True))
    return Column(title, [Cell(shown(*pair), sort_key(pair[0])) for pair in ends])


def texts(title: str, values: Iterable[str]) -> Column:
    """Makes a column of numbers that are written already and by which no row is sorted."""
    return Column(title, [Cell(value) for value in values])


def sort_key(value: Any) -> str:
    """Returns the number by which a cell is sorted; NaN goes last, as infinity does."""
    number = float(value)
    # As a page's script reads infinity.
    return "1e999" if math.isnan(number) else repr(number).replace("inf", "1e999")


# Terminal -----------------------------------------------------------------------------------------


def terminal(parts: Iterable[Part], width: int) -> Group:
    """Tables and sentences for a terminal; columns without room go below, or are named with the
    file that has them."""
    from rich.console import Group
    from rich.text import Text

    shown: list[Any] = []
    for part in parts:
        if not isinstance(part, Table):
            style = "bold" if isinstance(part, Strong) else "dim"
            shown.append(Text(part, style=style))
            continue
        if part.title and shown and isinstance(shown[-1], Text):
            shown.append(Text())
        shown += _pieces(part.folded(), width)
    return Group(*shown)


def _pieces(table: Table, width: int) -> Iterator[Any]:
    """Yields the title, tables below each other with the columns that have room in each, and the
    notes."""
    from rich.text import Text

    if table.title:
        yield Text(table.title, style="bold")
    kept = table.naming + 1
    head = table.columns[:kept]
    rest = table.columns[kept:]
    notes = [table.caption, *table.notes]
    while True:
        count = _fitting(head, rest, table, width)
        yield _rich([*head, *rest[:count]], table, width)
        rest = rest[count:]
        if not rest:
            break
        if table.whole:
            hidden = ", ".join(column.title for column in rest)
            notes.insert(0, f"Not shown for lack of width: {hidden}; see {table.whole}.")
            break
    for note in filter(None, notes):
        yield Text(note, style="dim")


def _fitting(head: Sequence[Column], rest: Sequence[Column], table: Table, width: int) -> int:
    """Counts the columns that have room beside the head; one of them is shown in any case."""
    count = min(1, len(rest))
    while count < len(rest):
        wider = [*head, *rest[: count + 1]]
        if _taken(wider, table, folded=True) > width:
            break
        count += 1
    return count


def plain_text(parts: Iterable[Part], width: int = 120) -> str:
    """Returns the text that a terminal of that width shows, without colours."""
    from ipe_bench.report.screen import Screen

    shown = io.StringIO()
    Screen(width=width, file=shown, force_jupyter=False).print(terminal(parts, width))
    return shown.getvalue()


def _needed(column: Column, table: Table, *, folded: bool) -> int:
    """Returns a column's letters with its title in one line or folded; numbers never fold."""
    from rich.cells import cell_len

    lengths = [cell_len(cell.text) for cell in column.cells]
    longest = max([1, *lengths])
    if not column.numeric:
        is_name = column is table.columns[table.naming]
        longest = min(longest, _WHOLE_NAME if is_name else _WHOLE_WORD)
    title = _joined(column.title)
    if not folded:
        return max(longest, cell_len(title))
    word = max(map(cell_len, title.split(" ")))
    return max(longest, min(word, _WHOLE_NAME))


def _joined(title: str) -> str:
    """Joins a number and its per cent to one word."""
    return title.replace(" %", "\u00a0%")


def _taken(columns: Iterable[Column], table: Table, *, folded: bool) -> int:
    """Returns the width of a table of such columns with their titles in one line or folded."""
    letters = [_needed(column, table, folded=folded) for column in columns]
    return sum(letters) + 2 + _PADDING * len(letters)


def _rich(columns: Sequence[Column], table: Table, width: int) -> Any:
    """Renders some columns of a table, with titles that are folded if they have no room."""
    from rich import box
    from rich.table import Table as RichTable
    from rich.text import Text

    shown = RichTable(box=box.SIMPLE_HEAD, padding=(0, 1), pad_edge=False, collapse_padding=True)
    folded = _taken(columns, table, folded=False) > width
    for each in columns:
        letters = _needed(each, table, folded=folded)
        lines = textwrap.fill(_joined(each.title), letters)
        title = Text(lines.replace("\u00a0", " "))
        if each.numeric:
            shown.add_column(title, justify="right", no_wrap=True)
        else:
            shown.add_column(title, overflow="fold", min_width=letters)
    rows = zip(*(c.cells for c in columns), strict=True)
    for group, members in groupby(rows, key=lambda row: row[: table.grouped]):
        first: Sequence[Cell] = group
        for row in members:
            line = (*first, *row[len(group) :])
            shown.add_row(*(Text(c.text, style=c.style) for c in line))
            # What the rows of a group share stands in the first of them alone.
            first = [Cell("")] * len(group)
        if group:
            shown.add_section()
    return shown


# HTML ---------------------------------------------------------------------------------------------


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

    def soft(text: Any) -> Markup:
        """Lets a name be broken behind its underscores."""
        return escape(text).replace("_", Markup("_<wbr>"))

    def inked(ramp: Iterable[str]) -> list[tuple[str, str]]:
        return [(color, ink(color)) for color in ramp]

    made.filters["soft"] = soft
    made.tests["strong"] = lambda part: isinstance(part, Strong)
    made.tests["legend"] = lambda part: isinstance(part, Legend)
    made.globals["MOST_ROWS"] = MOST_ROWS
    made.globals["SIGNS"] = SIGNS
    made.globals["ramps"] = [inked(RAMP), inked(DARK_RAMP)]
    return made


def html(parts: Iterable[Part]) -> str:
    """Tables and sentences as a piece of a page that has no style for them, such as a notebook."""
    return environment().get_template("notebook.html.j2").render(parts=list(parts))


# Files --------------------------------------------------------------------------------------------


def write_table(table: Table, folder: Path, formats: Sequence[str]) -> list[Path]:
    """Writes one table in those of the formats that are of tables; as CSV unless another file has
    it whole."""
    writers: dict[str, Any] = dict(zip(TABLES, (comma_separated, markdown, latex), strict=True))
    elsewhere = table.whole not in ("", f"{folder.name}/{table.name}.csv")
    files = []
    for kind, written in writers.items():
        if kind not in formats or (kind == "csv" and elsewhere):
            continue
        files.append(folder / f"{table.name}.{kind}")
        write_text(files[-1], written(table))
    return files


def comma_separated(table: Table) -> str:
    """Renders the numbers behind the table in full precision, or else its cells."""
    import pandas as pd

    data = table.data
    if data is None:
        titles = [column.title for column in table.columns]
        data = pd.DataFrame([[cell.text for cell in row] for row in table.rows], columns=titles)
    return csv_text(data)


def csv_text(data: pd.DataFrame) -> str:
    """Writes a frame as CSV; a text that a spreadsheet would compute begins with an apostrophe."""
    from pandas.api.types import is_numeric_dtype

    safe = data.rename(columns=_no_formula)
    for place, kind in enumerate(data.dtypes):
        if not is_numeric_dtype(kind):
            column = data.iloc[:, place]
            # Of many rows each different text is looked at once.
            shown = {cell: _no_formula(cell) for cell in column.unique()}
            if any(written is not cell for cell, written in shown.items()):
                safe.isetitem(place, [shown.get(cell, cell) for cell in column])
    return _many_rows(safe) if len(safe) > _MANY_ROWS else safe.to_csv(index=False)


def _many_rows(data: pd.DataFrame) -> str:
    """Writes a frame as CSV by Arrow, in a tenth of the time; 2.0 is 2 there."""
    import pyarrow as pa
    from pyarrow import csv

    written = pa.BufferOutputStream()
    truths = dict.fromkeys(data.select_dtypes("bool").columns, str)
    table = pa.Table.from_pandas(data.astype(truths), preserve_index=False)
    csv.write_csv(table, written, csv.WriteOptions(quoting_style="needed"))
    return written.getvalue().to_pybytes().decode()


def _no_formula(cell: Any) -> Any:
    return f"'{cell}" if isinstance(cell, str) and _FORMULA.match(cell) else cell


def markdown(table: Table) -> str:
    """Renders a GitHub table; names cannot break it."""

    def plain(text: str) -> str:
        line = " ".join(text.split())
        return re.sub(r"([\\|*])", r"\\\1", line).replace("<", "&lt;")

    def shown(cell: Cell) -> str:
        text = plain(cell.text)
        return f"**{text}**" if cell.best else text

    def line(texts: Iterable[str]) -> str:
        return f"| {' | '.join(texts)} |"

    table = table.folded()
    rules = ["---:" if column.numeric else ":---" for column in table.columns]
    lines = [f"**{table.title}.** {plain(table.caption)}", ""] if table.title else []
    lines.append(line(plain(column.title) for column in table.columns))
    lines.append(f"|{'|'.join(rules)}|")
    lines += [line(map(shown, row)) for row in table.rows]
    lines += [f"\n{plain(note)}" for note in table.notes]
    return "\n".join(lines) + "\n"


_SIGNS = {
    **{sign: f"\\{sign}" for sign in "&%$#_{}"},
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
_NUMBER = re.compile(r"(?:(?<!\d)-)?\d[\d,]*(?:\.\d+)?(?:e[+-]?\d+)?")


def latex(table: Table, width: float | None = None) -> str:
    r"""Renders a table for `\input`, by booktabs and siunitx: bare, or floating with its caption in
    a column of `width` inches; a longtable if it has more than `LONG` rows."""
    table = table.folded()
    shape = "".join("r" if c.numeric else "l" for c in table.columns)
    rows = [map(_latex_title, table.columns)]
    rows += [map(_latex_cell, row, table.columns) for row in table.rows]
    titles, *body = [f"{' & '.join(texts)} \\\\" for texts in rows]
    is_long = len(table) > LONG
    kind = "longtable" if is_long else "tabular"
    repeated = [r"\endhead"] if is_long else []
    lines = [
        rf"\begin{{{kind}}}{{@{{}}{shape}@{{}}}}",
        *(r"\toprule", titles, r"\midrule"),
        *repeated,
        *body,
        r"\bottomrule",
        rf"\end{{{kind}}}",
    ]
    if width is not None:
        lines = _captioned(lines, table, width)
    needed = r"\usepackage{booktabs, longtable, siunitx, amsmath} and \usepackage[T1]{fontenc}."
    title = " ".join(table.title.split())
    return "\n".join([f"% {title}. Needs {needed}", *lines, ""])


def _captioned(lines: list[str], table: Table, width: float) -> list[str]:
    """Returns the lines of a table with its caption: floating, or over pages."""
    label = f"tab:{table.name.replace('_', '-')}"
    words = escaped(f"{table.title}. {table.caption}")
    caption = rf"\caption{{{words}}}\label{{{label}}}"
    size = rf"\footnotesize\setlength{{\tabcolsep}}{{{COLUMN_GAP:g}pt}}"
    if len(table) > LONG:
        begin, *rest = lines
        return [f"{{{size}", begin, rf"{caption} \\", *rest, "}"]
    kind = "table" if width <= COLUMN else "table*"
    begin = rf"\begin{{{kind}}}[tb]"
    return [begin, r"\centering", caption, size, *lines, rf"\end{{{kind}}}"]


def _latex_title(column: Column) -> str:
    """Returns the title of a column, stacked if it is longer than its cells and its longest
    word."""
    texts = [cell.text for cell in column.cells]
    letters = max(map(len, ["-", *texts, *column.title.split()]))
    lines = textwrap.wrap(column.title, letters, break_on_hyphens=False)
    stacked = r"\\".join(map(escaped, lines))
    if len(lines) <= 1:
        return stacked
    side = "r" if column.numeric else "l"
    return rf"\shortstack[{side}]{{{stacked}}}"


def _latex_cell(cell: Cell, column: Column) -> str:
    """Returns a cell; siunitx sets numbers, whose digits it groups by its own rules."""
    text = escaped(cell.text)
    if column.numeric:
        text = re.sub(r"\binf\b", r"\\ensuremath{\\infty}", text)
        text = _NUMBER.sub(_latex_number, text).replace(r"} \%", r"}\,\%")
        text = text.replace(r"}-\num", r"}--\num")
    return rf"\textbf{{{text}}}" if cell.best else text


def _latex_number(found: re.Match[str]) -> str:
    digits = found.group().replace(",", "")
    return f"\\num{{{digits}}}"


def escaped(text: str) -> str:
    """Escapes the special signs of plain text, those that pdflatex may lack by their number."""
    return "".join(map(_escaped_sign, " ".join(text.split())))


def _escaped_sign(sign: str) -> str:
    if sign in _SIGNS:
        return _SIGNS[sign]
    if sign.isascii() and sign.isprintable():
        return sign
    return f"\\texttt{{U+{ord(sign):04X}}}"
