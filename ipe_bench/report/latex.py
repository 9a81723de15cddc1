"""Tables and texts as LaTeX has them, with booktabs and siunitx."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ipe_bench.report.tables import Cell, Column, Table

LONG = 45
"""Rows from which on a table runs over pages."""
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


def latex(table: Table) -> str:
    """To be read into a document with `\\input`; a longtable where rows are many."""
    shape = "".join("r" if column.numeric else "l" for column in table.columns)
    head = [r"\toprule", row(escaped(column.title) for column in table.columns), r"\midrule"]
    rows = table_rows(table)
    if len(table) > LONG:
        more = rf"\multicolumn{{{len(shape)}}}{{r}}{{continued on the next page}} \\"
        foot = [r"\midrule", more, r"\endfoot", r"\bottomrule", r"\endlastfoot"]
        kind, lines = "longtable", [*head, r"\endfirsthead", *head, r"\endhead", *foot, *rows]
    else:
        kind, lines = "tabular", [*head, *rows, r"\bottomrule"]
    needs = r"\usepackage{booktabs, longtable, siunitx, amsmath} and \usepackage[T1]{fontenc}"
    comment = f"% {' '.join(table.title.split())}. Needs {needs}."
    return "\n".join([comment, rf"\begin{{{kind}}}{{@{{}}{shape}@{{}}}}", *lines, rf"\end{{{kind}}}", ""])


def table_rows(table: Table) -> list[str]:
    """A line for each row of a table."""
    return [row(map(_cell, cells, table.columns)) for cells in table.rows]


def row(cells: Iterable[str]) -> str:
    return f"{' & '.join(cells)} \\\\"


def _cell(cell: Cell, column: Column) -> str:
    text = set_numbers(escaped(cell.text)) if column.numeric else escaped(cell.text)
    return rf"\textbf{{{text}}}" if cell.best else text


def escaped(text: str) -> str:
    """Plain text with its special signs escaped, those that pdflatex may lack by their number."""
    return "".join(
        _SIGNS.get(char) or (char if char.isascii() and char.isprintable() else f"\\texttt{{U+{ord(char):04X}}}")
        for char in " ".join(text.split())
    )


def set_numbers(escaped: str) -> str:
    """The numbers of a cell set by siunitx, which groups digits by its own rules."""
    text = _NUMBER.sub(lambda m: f"\\num{{{m.group().replace(',', '')}}}", escaped)
    return text.replace(r"} \%", r"}\,\%")
