"""Tables for papers and mails: the same cells as Markdown, LaTeX and HTML, the whole numbers as CSV."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from ipe_bench.basics.files import write_atomically
from ipe_bench.report.words import duration, p_value, percent, plain, precise, short
from ipe_bench.statistics.analysis import Analysis
from ipe_bench.statistics.comparisons import ALPHA
from ipe_bench.statistics.summary import ALL


@dataclass(frozen=True)
class Cell:
    """One cell as a reader sees it, and what it is sorted by."""

    text: str
    key: Any = None
    best: bool = False


@dataclass(frozen=True)
class Column:
    title: str
    cells: Sequence[Cell]
    numeric: bool = True


@dataclass(frozen=True)
class Table:
    """A table with its file name, title and caption; `data` are the numbers behind it."""

    name: str
    title: str
    caption: str
    columns: Sequence[Column]
    data: pd.DataFrame

    @property
    def rows(self) -> Iterator[tuple[Cell, ...]]:
        return zip(*(c.cells for c in self.columns), strict=True)

    def __len__(self) -> int:
        return len(self.columns[0].cells)


def column(title: str, values: Iterable[Any], show: Callable[[Any], str], best: Sequence[bool] | None = None) -> Column:
    values = list(values)
    marks = [False] * len(values) if best is None else list(best)
    return Column(title, [Cell(show(v), _key(v), m) for v, m in zip(values, marks, strict=True)])


def words(title: str, values: Iterable[Any], best: Sequence[bool] | None = None) -> Column:
    values = [str(v) for v in values]
    marks = [False] * len(values) if best is None else list(best)
    return Column(title, [Cell(v, None, m) for v, m in zip(values, marks, strict=True)], numeric=False)


def interval(title: str, low: Iterable[float], high: Iterable[float], show: Callable[[float], str]) -> Column:
    pairs = zip(low, high, strict=True)
    return Column(title, [Cell(f"{show(a)} to {show(b)}" if math.isfinite(a) else "-", _key(a)) for a, b in pairs])


def _key(value: Any) -> Any:
    """A number to sort by: what is not a number goes last."""
    number = float(value)
    return "1e999" if math.isnan(number) or number == math.inf else repr(number)


def all_tables(analysis: Analysis) -> list[Table]:
    """Every table that the data allow, in the order of the report."""
    if analysis.summary.empty:
        return []
    tables = [overview(analysis), costs(analysis), contraction(analysis), comparisons(analysis), ranks(analysis)]
    tables += [parameters(analysis), endings(analysis)]
    return [t for t in tables if t is not None]


def _head(analysis: Analysis, rows: pd.DataFrame) -> list[Column]:
    """The columns that tell rows apart: those settings that differ, and the error scale."""
    varying = [c for c in analysis.setting_columns if len(set(rows[c].astype(str))) > 1]
    head = [words(c, [plain(v) for v in rows[c]]) for c in varying]
    return [*head, column("error scale", rows["error_scale"], lambda v: f"{v:g}")]


def overview(analysis: Analysis) -> Table:
    """Who solves how much, how well, and how honestly."""
    rows = analysis.summary[analysis.summary["parameter"] == ALL].reset_index(drop=True)
    scores = analysis.scores
    best = list(scores["leads"])
    columns = [
        *_head(analysis, rows),
        words("estimator", rows["estimator"], best),
        column("trials", rows["trials"], lambda v: f"{v:d}"),
        column("converged", rows["converged"], percent),
        column("solved", rows["solved"], percent),
        column("success", rows["success"], percent),
        interval("95 % of success", rows["success_low"], rows["success_high"], percent),
        column("false root", rows["false_root"], percent),
        column("rmse / bound", rows["rmse_over_linear_bound"], short),
        interval("95 % of rmse", rows["rmse_low"], rows["rmse_high"], short),
        column("rmse, common", rows["rmse_common"], short),
        column("efficiency", rows["efficiency"], short),
        column("capped error", scores["capped_error"], short, best),
        column("NEES / n", rows["nees"], short),
        interval("NEES limits", rows["nees_low"], rows["nees_high"], short),
        column("coverage", rows["coverage95"], percent),
        column("misfit", rows["misfit"], lambda v: percent(v) if math.isfinite(v) else "-"),
    ]
    caption = (
        "Shares are of all trials. rmse / bound: root mean square over parameters of error over linear bound, on the"
        " trials that the estimator solved; common: on those that every estimator solved. misfit: trials whose"
        " residuals fail the chi-square test at 0.1 %. Bold: the smallest capped mean error and those that do not"
        " differ significantly from it (Wilcoxon, Holm, 5 %), where any other does."
    )
    return Table("overview", "Overview", caption, columns, rows)


def costs(analysis: Analysis) -> Table:
    """What a trial costs, and what is needed to come close to the estimator's own limit."""
    rows = analysis.summary[analysis.summary["parameter"] == ALL].reset_index(drop=True)
    scores = analysis.scores
    columns = [
        *_head(analysis, rows),
        words("estimator", rows["estimator"]),
        column("iterations", rows["iterations_median"], short),
        column("iterations, 95 %", rows["iterations_p95"], short),
        column("simulations", rows["simulations_median"], short),
        column("to 0.05 σ of limit", scores["cost_to_limit_median"], short),
        column("order", scores["order_median"], short),
        column("histories", scores["histories"], lambda v: f"{v:d}"),
        column("time", rows["time_median_s"], duration),
    ]
    names = [*analysis.setting_columns, "error_scale", "estimator"]
    names += ["cost_median", "cost_to_limit_median", "order_median", "histories"]
    data = rows[["iterations_median", "iterations_p95", "simulations_median", "time_median_s"]]
    caption = (
        "Medians per trial over all trials. A Jacobian counts as many simulations as there are"
        " parameters. To 0.05 σ of limit: cost until all further iterates are within 0.05 standard deviations of the"
        " last one, over the converged trials with a stored history. Order: the last observed order of convergence of"
        " these trials, 1 linear and 2 quadratic."
    )
    return Table("costs", "Costs", caption, columns, pd.concat([scores[names], data], axis=1))


def contraction(analysis: Analysis) -> Table | None:
    """Whether theory promises that the fixed-point iteration converges, eq. (15)."""
    rows = analysis.contraction
    if rows.empty:
        return None
    columns = _head(analysis, rows)
    for name, title in (("K", "K"), ("norm", "infinity norm"), ("radius", "spectral radius")):
        columns += [
            column(f"{title}, median", rows[f"contraction_{name}_median"], short),
            column("largest", rows[f"contraction_{name}_max"], short),
            column("below 1", rows[f"contraction_{name}_below_1"], percent),
        ]
    caption = (
        "Of g' = I - H⁺J at the truth, over all trials. K of eq. (15) below 1, or the infinity norm below 1, in a whole"
        " neighbourhood is sufficient for fixed-point iteration to converge there; the spectral radius below 1 is"
        " necessary and sufficient close to the root, and is the rate at which the error shrinks."
    )
    return Table("contraction", "Contraction", caption, columns, rows)


def comparisons(analysis: Analysis) -> Table | None:
    """Every pair of estimators on the same trials."""
    rows = analysis.pairs
    if rows.empty:
        return None

    def verdict(row: Any) -> str:
        if row.p_error >= ALPHA:
            return "no difference"
        return f"{row.first if row.wins > row.losses else row.second} is closer"

    columns = [
        *_head(analysis, rows),
        words("first", rows["first"]),
        words("second", rows["second"]),
        column("trials", rows["trials"], lambda v: f"{v:d}"),
        column("wins", rows["wins"], lambda v: f"{v:d}"),
        column("ties", rows["ties"], lambda v: f"{v:d}"),
        column("losses", rows["losses"], lambda v: f"{v:d}"),
        column("median difference", rows["median_difference"], short),
        column("p of error", rows["p_error"], p_value),
        column("first alone", rows["only_first"], lambda v: f"{v:d}"),
        column("second alone", rows["only_second"], lambda v: f"{v:d}"),
        column("p of success", rows["p_success"], p_value),
        words("finding", [verdict(row) for row in rows.itertuples()]),
    ]
    caption = (
        "On the trials that both have. A win is a Mahalanobis error of the first smaller by more than 0.001 standard"
        " deviations; p of error: Wilcoxon's signed-rank test without the ties. First, second alone: trials in which"
        " only that one succeeds; p of success: McNemar's exact test. Both Holm-corrected over the pairs of a scenario."
    )
    return Table("comparisons", "Paired comparisons", caption, columns, rows)


def ranks(analysis: Analysis) -> Table | None:
    """Mean ranks over scenarios."""
    ranking = analysis.ranking
    if ranking is None:
        return None
    ordered = sorted(ranking.mean_ranks, key=lambda label: ranking.mean_ranks[label])
    values = [ranking.mean_ranks[label] for label in ordered]
    # Nemenyi's test is a follow-up: without a rejection by Friedman's it says nothing.
    rejects = ranking.friedman < ALPHA
    apart = ["yes" if rejects and v - values[0] >= ranking.critical_difference else "no" for v in values]
    columns = [words("estimator", ordered), column("mean rank", values, short), words("apart from the first", apart)]
    caption = (
        f"Over {ranking.scenarios} scenarios, by capped mean error; Friedman's test that all rank alike:"
        f" p = {p_value(ranking.friedman)}; Nemenyi's critical difference at 5 %: {ranking.critical_difference:.2f}."
    )
    data = pd.DataFrame({"estimator": ordered, "mean_rank": values, "apart_from_first": apart})
    return Table("ranks", "Ranks over scenarios", caption, columns, data)


def parameters(analysis: Analysis) -> Table:
    """Every parameter in its own unit."""
    rows = analysis.summary[analysis.summary["parameter"] != ALL]
    columns = [
        *_head(analysis, rows),
        words("estimator", rows["estimator"]),
        words("parameter", rows["parameter"]),
        words("unit", rows["unit"]),
        column("bias", rows["bias"], precise),
        column("std", rows["std"], precise),
        column("rmse", rows["rmse"], precise),
        interval("95 % of rmse", rows["rmse_low"], rows["rmse_high"], precise),
        column("linear bound", rows["linear_bound"], precise),
        column("CRLB", rows["crlb"], precise),
        column("rmse / bound", rows["rmse_over_linear_bound"], short),
        column("efficiency", rows["efficiency"], short),
        column("median abs error", rows["median_abs_error"], precise),
        column("95 % abs error", rows["q95_abs_error"], precise),
        column("NEES", rows["nees"], short),
        column("coverage", rows["coverage95"], percent),
    ]
    caption = (
        "In each parameter's own unit. Bias, std, rmse, bounds and NEES are over solved trials; median and 95 % of the"
        " absolute error, and coverage, over all trials."
    )
    return Table("parameters", "Parameters", caption, columns, rows)


def endings(analysis: Analysis) -> Table | None:
    """Trials that did not converge, with their messages."""
    rows = analysis.endings
    if rows.empty:
        return None
    columns = [
        *_head(analysis, rows),
        words("estimator", rows["estimator"]),
        words("status", rows["status"]),
        column("trials", rows["trials"], lambda v: f"{v:d}"),
        column("share", rows["share"], percent),
        words("first", rows["first"]),
        words("message", rows["message"]),
    ]
    caption = "How trials ended that did not converge, and the first of each kind."
    return Table("endings", "Trials that did not converge", caption, columns, rows)


# Formats -------------------------------------------------------------------------------------------------------------


def markdown(table: Table) -> str:
    """A GitHub table; names cannot break it."""

    def cell(value: str) -> str:
        value = value.replace("\\", "\\\\").replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*")
        return " ".join(value.split())

    lines = [f"**{table.title}.** {cell(table.caption)}", ""]
    lines.append("| " + " | ".join(cell(c.title) for c in table.columns) + " |")
    lines.append("|" + "|".join("---:" if c.numeric else ":---" for c in table.columns) + "|")
    for row in table.rows:
        texts = [f"**{cell(c.text)}**" if c.best else cell(c.text) for c in row]
        lines += ["| " + " | ".join(texts) + " |"]
    return "\n".join(lines) + "\n"


LONG = 45
"""Rows from which on a LaTeX table runs over pages."""
_LATEX = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "$": r"\$",
    "&": r"\&",
    "#": r"\#",
    "%": r"\%",
    "_": r"\_\allowbreak{}",
    "^": r"\textasciicircum{}",
    "~": r"\textasciitilde{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': r"\textquotedbl{}",
    "µ": r"\ensuremath{\mu}",
    "σ": r"\ensuremath{\sigma}",
    "√": r"\ensuremath{\surd}",
    "×": r"\ensuremath{\times}",
    "²": r"\textsuperscript{2}",
    "–": "--",
}
_NUMBER = re.compile(r"-?\d[\d,]*(?:\.\d+)?(?:e[+-]?\d+)?")


def latex(table: Table) -> str:
    """Booktabs and siunitx; to be read into a document with `\\input`."""
    kind = "longtable" if len(table) > LONG else "tabular"
    shape = "".join("r" if c.numeric else "l" for c in table.columns)
    title = " & ".join(f"\\multicolumn{{1}}{{{'r' if c.numeric else 'l'}}}{{{escape(c.title)}}}" for c in table.columns)
    lines = [
        f"% {' '.join(table.title.split())}. Needs \\usepackage{{booktabs, longtable, siunitx, amsmath}} and",
        "% \\usepackage[T1]{fontenc}.",
        f"\\begin{{{kind}}}{{@{{}}{shape}@{{}}}}",
        "\\toprule",
        title + r" \\",
        "\\midrule",
    ]
    if kind == "longtable":
        lines.append("\\endhead")
    for row in table.rows:
        cells = [_number(c.text) if col.numeric else escape(c.text) for c, col in zip(row, table.columns, strict=True)]
        cells = [f"\\textbf{{{t}}}" if c.best else t for t, c in zip(cells, row, strict=True)]
        lines.append(" & ".join(cells) + r" \\")
    lines += ["\\bottomrule", f"\\end{{{kind}}}"]
    return "\n".join(lines) + "\n"


def escape(text: str) -> str:
    """Any text as LaTeX that shows it; characters that pdflatex may lack by their number."""
    result = []
    for char in " ".join(text.split()):
        if char in _LATEX:
            result.append(_LATEX[char])
        elif char.isascii() and char.isprintable():
            result.append(char)
        else:
            result.append(f"\\texttt{{U+{ord(char):04X}}}")
    return "".join(result)


def _number(text: str) -> str:
    """Numbers in a numeric cell set by siunitx, what stands around them escaped."""
    result, reached = [], 0
    for match in _NUMBER.finditer(text):
        result.append(escape(text[reached : match.start()]) if text[reached : match.start()].strip() else "")
        if text[reached : match.start()].strip() == "to":
            result[-1] = "--"
        result.append(f"\\num{{{match.group().replace(',', '')}}}")
        reached = match.end()
    rest = text[reached:].strip()
    result.append(("\\," if reached and rest else "") + escape(rest))
    return "".join(result)


def write_tables(analysis: Analysis, tables: Sequence[Table], folder: Path) -> tuple[Path, ...]:
    """Writes each table as CSV (all columns, full precision), Markdown and LaTeX, and the profiles as CSV."""
    paths = []

    def write(name: str, content: str) -> None:
        path = folder / name
        write_atomically(path, lambda temporary: temporary.write_text(content, encoding="utf-8"))
        paths.append(path)

    for table in tables:
        write(f"{table.name}.csv", table.data.to_csv(index=False))
        write(f"{table.name}.md", markdown(table))
        write(f"{table.name}.tex", latex(table))
    if len(analysis.profiles):
        write("profiles.csv", analysis.profiles.to_csv(index=False))
    return tuple(paths)
