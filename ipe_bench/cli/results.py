"""Defines the commands on stored results: report and status."""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ipe_bench.basics.errors import UserError
from ipe_bench.cli import console, places_and_keys, print_problems, say, show
from ipe_bench.questions.question import NAMES
from ipe_bench.report.formats import PAGE
from ipe_bench.report.style import Which, drawn_settings
from ipe_bench.report.tables.table import Table, texts, words
from ipe_bench.report.words import counted, enumerate_few
from ipe_bench.runs.parts import TRUTH
from ipe_bench.runs.results import CellState, Results
from ipe_bench.runs.store import Store, require_results

_REPORT = {"output": str, "figures": str, "formats": str}
_PAPER = {"output": str, "paper": NAMES, "columns": NAMES, "width": float}
"""Keys of tables and figures for a paper."""


def status_command(arguments: Sequence[str], verbose: bool = False) -> int:
    """Prints a line per complete directory, else a table; returns 1 if any trial is missing or
    damaged."""
    if not arguments:
        raise UserError("status: name at least one directory of results, such as outputs/paper")
    answers = {folder: _answer(Path(folder)) for folder in arguments}
    for folder, answer in answers.items():
        if answer:
            say(f"{folder}: {answer}")
    folders = require_results([folder for folder, answer in answers.items() if not answer])
    found = [Results.read([folder]) for folder in folders]
    for folder, results in zip(folders, found, strict=True):
        name = str(folder)
        cells = [cell for cell in results.cells if verbose or not cell.complete or cell.stale]
        if cells:
            show([_states(name, cells)])
        verdict = (
            "not complete; the same command as before computes what is missing, failed or damaged"
        )
        if not results.problems:
            estimates = [cell for cell in results.cells if cell.names["estimator"] != TRUTH]
            trials = sum(cell.done for cell in estimates)
            counted = f"results (an estimator in a scenario): {len(estimates)}"
            verdict = f"complete: {counted}; estimates: {trials}"
        say(*(results.problems or results.stale), f"{name}: {verdict}")
    return 1 if any(results.problems for results in found) else 0


def _answer(folder: Path) -> str:
    """Says what a command that answers one question, such as `estimate`, left in a folder; empty if
    none did."""
    if Store(folder).runs.is_dir():
        return ""
    for file in sorted(folder.glob("*.json")):
        try:
            content = json.loads(file.read_text(encoding="utf-8"))
            read = (content.get("readings") or []) if "command" in content else None
            changed = [one["file"] for one in read or () if _has_changed(one)]
        except (OSError, ValueError, AttributeError, KeyError, TypeError):
            continue
        if read is None:
            continue
        pages = ", ".join(sorted(page.name for page in folder.glob("*.html")))
        if not pages:
            return f"{file.name} without a page; the same command writes it again"
        if changed:
            return f"complete: {pages}; but {enumerate_few(changed)} changed since"
        return f"complete: {pages}"
    return ""


def _has_changed(reading: Mapping[str, str]) -> bool:
    """Tells whether a file of readings is there, and not as it was."""
    file = Path(reading["file"])
    return file.is_file() and hashlib.sha256(file.read_bytes()).hexdigest() != reading["sha256"]


def _states(directory: str, cells: Sequence[CellState]) -> Table:
    names = [cell.names["estimator"] for cell in cells]
    columns = [
        words("scenario", [cell.title for cell in cells]),
        words("estimator", ["(truth)" if name == TRUTH else name for name in names]),
        texts("done", [f"{cell.done} of {cell.expected or cell.done}" for cell in cells]),
    ]
    for count in ("missing", "failed", "stale"):
        numbers = [getattr(cell, count) for cell in cells]
        columns.append(texts(count, [str(number or "") for number in numbers]))
    return Table("status", directory, "", columns, grouped=1)


def report_command(arguments: Sequence[str]) -> int:
    """Writes the report on these folders; exit code 1 where something that was asked for is
    missing."""
    for_paper = any(word.startswith(("paper=", "columns=", "width=")) for word in arguments)
    named, keys = places_and_keys("report", arguments, _PAPER if for_paper else _REPORT)
    output = Path(keys["output"]) if "output" in keys else None
    if not named:
        raise UserError("report: name at least one directory of results, such as outputs/paper")
    if output is None and len(named) > 1 and not for_paper:
        raise UserError(
            "report: several directories need output=DIR, for the report on all of them"
        )
    folders = require_results(named)
    if for_paper:
        return _paper(folders, keys)
    return show_report(
        folders, output or folders[0], keys.get("figures", "main"), keys.get("formats", PAGE)
    )


def show_report(
    folders: Sequence[Path],
    output: Path,
    figures: Which,
    formats: Any,
    cells: Mapping[str, str] | None = None,
) -> int:
    """Writes the report on all that folders hold, and prints it, or its rows of the `cells`, whose
    keys have a line for people each; returns the exit code."""
    from ipe_bench.report.page.run import begin_report
    from ipe_bench.statistics.analysis import Begun
    from ipe_bench.statistics.collect import collect

    pending = begin_report(folders, output, figures=figures, formats=formats)
    begun = pending.begun
    collection = shown = begun.collection
    others = 0
    if cells:
        others = sum(cell.key not in cells and cell.label != TRUTH for cell in collection.current)
    if cells and others:
        shown = collect(folders, cells.keys())
        begun = Begun(shown)
    _print_table(begun.summary, shown)
    say(*begun.raised)
    pending.write_unless_current()
    told = [*collection.problems, *([] if cells else collection.stale)]
    if cells:
        # What is wrong with a file or a folder may concern anybody; what other commands lack does
        # not.
        of_cells = [line for line in told if line.startswith(("missing: ", "failed: "))]
        elsewhere = [line for line in of_cells if not any(cell in line for cell in cells.values())]
        told = [line for line in told if line not in elsewhere]
        if elsewhere:
            number = counted(len(elsewhere), "problem")
            told.append(
                f"{output}: {number} of other commands; `ipe-bench status {output}` lists them"
            )
    print_problems(told)
    drawn = ""
    if any(output.glob("figures/*.png")):
        drawn = f"\nFigures  {output / 'figures'}"
        left_out = drawn_settings(collection.settings, figures)[1]
        if left_out:
            drawn += f" ({left_out})"
    say(
        f"\nSummary  {output / 'summary.csv'}\nTables   {output / 'tables'}{drawn}\nReport  "
        f" {output / 'report.html'}"
    )
    if others:
        print(
            f"Here too  {counted(others, 'result')} of other commands; `ipe-bench report {output}`"
            " shows all"
        )
    return 1 if collection.problems or begun.useless else 0


def _print_table(rows: Sequence[Mapping[str, Any]], collection: Any) -> None:
    from ipe_bench.report.tables.terminal import summary_tables

    show(summary_tables(rows, collection, console().width))
    sys.stdout.flush()


def _paper(folders: Sequence[Path], keys: Mapping[str, Any]) -> int:
    """Writes tables and figures as a paper wants them; exit code 1 where data are missing."""
    from ipe_bench.plugins.extensions import use_statistics
    from ipe_bench.report.paper import export
    from ipe_bench.statistics import analyse

    if not keys.get("paper"):
        raise UserError("paper=: name tables and figures, such as paper=overview,headline")
    chosen = {key: keys[key] for key in ("columns", "width") if key in keys}
    faults = use_statistics()
    analysis = analyse(folders)
    analysis.collection.extra_problems += faults
    output = Path(keys.get("output", folders[0] / "paper"))
    say(*map(str, export(analysis, output, keys["paper"], **chosen)))
    print_problems([*analysis.collection.problems, *analysis.collection.stale])
    return 1 if analysis.collection.problems else 0
