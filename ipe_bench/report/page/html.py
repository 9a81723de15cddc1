"""Renders the page report.html: one file that is readable on a phone, on paper and without a
network."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ipe_bench.report.finding import MEANING
from ipe_bench.report.page.headline import about, headline, success, task
from ipe_bench.report.page.writer import Page, digests
from ipe_bench.report.tables.matrix import MATRIX, SUCCESS, Matrix
from ipe_bench.report.tables.table import Part, Strong, Table, environment, words
from ipe_bench.report.words import counted, from_to, public
from ipe_bench.runs.parts import TRUTH
from ipe_bench.statistics.comparisons import EXACT, TIE
from ipe_bench.statistics.records import SCORES, STATISTICS
from ipe_bench.statistics.registry import all_statistics

if TYPE_CHECKING:
    from ipe_bench.report.figures import Drawn
    from ipe_bench.report.sections import Written
    from ipe_bench.statistics.analysis import Analysis
    from ipe_bench.statistics.collect import Collection

MOST_RUNS = 20
MOST_COMMANDS = 3
"""Largest number of commands at the head of the page; all stand with the provenance."""
_OF_TRACKS = ("one_track", "tracks")
"""Kinds of figures that a page of states shows at once."""
_PYTHON = "from Python"
_UNKNOWN = "a command that was not recorded"


def render_page(
    analysis: Analysis,
    tables: Sequence[Table],
    figures: Sequence[Drawn],
    written: Sequence[Written] = (),
) -> str:
    """Renders the page as text; what plugins have written stands behind our tables."""
    collection = analysis.collection
    runs, older = _runs(collection.runs)
    called = dict.fromkeys(run["command"] for run in runs)
    commands = [command for command in called if command not in (_PYTHON, _UNKNOWN)]
    lead = success(analysis)
    # What the line below the title says is not said again.
    answer = [part for part in headline(analysis) if not lead or part != MEANING]
    # What the matrix shows is not drawn a second time, and the whole table is folded below it.
    tiled = any(isinstance(part, Matrix) for part in answer)
    pictures = [figure for figure in figures if figure.kind not in (MATRIX, SUCCESS)]
    # One track says what the numbers are of: it stands before the errors of all.
    of_tracks = [one for one in pictures if one.kind in _OF_TRACKS]
    seen = of_tracks[:2] or pictures[:1]
    main: list[Part] = [table for table in tables if not table.appendix]
    opened = [] if tiled else main[:1]
    folded = main[len(opened) :]
    if analysis.endings.empty and not analysis.summary.empty:
        folded.append("Every trial of every estimator converged.")
    sections: list[tuple[str, str, Sequence[Any]]] = [
        ("figures", "Figures", [one for one in pictures if one not in seen]),
        ("tables", "Tables", folded),
    ]
    sections += [(f"section-{one.name}", one.title, one.parts) for one in written]
    sections += [
        ("appendix", "Further tables", [table for table in tables if table.appendix]),
        ("provenance", "Configuration and provenance", _provenance(runs, older)),
        ("definitions", "Definitions", [_definitions()]),
    ]
    names = ", ".join(folder.resolve().name or str(folder) for folder in collection.directories)
    title = str(answer.pop(0)).removesuffix(".") if isinstance(answer[0], Strong) else names
    named = [names] if names != title else []
    page = Page(
        "report",
        title,
        answer,
        [*seen, *opened],
        sections,
        folder="figures/",
        facts=list(filter(None, [*named, *_asked(analysis)])),
        made=_facts(collection),
        lead=lead,
        commands=commands[:MOST_COMMANDS],
        sources=digests(collection.directories),
        about=about(analysis),
        drawn=[path for figure in figures if figure not in pictures for path in figure.files],
        problems=[*collection.problems, *collection.stale],
    )
    return page.html()


def _asked(analysis: Analysis) -> list[str]:
    """States how many estimators, error scales and trials there are, and what is estimated from
    what."""
    totals = analysis.totals
    if len(totals) and set(totals["noise"]) == {"certified"}:
        problems = len(totals[analysis.setting_columns].drop_duplicates())
        who = counted(totals["estimator"].nunique(), "estimator")
        return [who, counted(problems, "problem")]
    numbers = []
    if len(totals):
        noun = "trial" if totals["trials"].max() == 1 else "trials"
        numbers = [
            counted(totals["estimator"].nunique(), "estimator"),
            counted(totals["error_scale"].nunique(), "error scale"),
            f"{from_to(totals['trials'])} {noun} each",
        ]
    return [*numbers, task(analysis.collection.groups)]


def _facts(collection: Collection) -> list[str]:
    """Returns the start of the last run, and how much is complete."""
    facts = []
    if collection.runs:
        facts.append(_minute(collection.runs[-1]["started"]))
    expected = [cell for cell in collection.cells if cell.expected]
    asked = [cell for cell in expected if cell.names["estimator"] != TRUTH]
    complete = sum(cell.complete for cell in asked)
    if asked:
        facts.append(f"{complete} of {len(asked)} results complete")
    return facts


def _definitions() -> Table:
    added = all_statistics()[len(STATISTICS) :]
    defined = DEFINITIONS | {one.title: one.definition for one in added}
    columns = [words("word", defined), words("meaning", defined.values())]
    return Table("words", "", "", columns)


def _provenance(runs: Sequence[Mapping[str, Any]], older: int) -> list[str]:
    """Returns an entry for each command, as HTML, and how many older ones are left out."""
    entry: Any = environment().get_template("parts.html.j2").module
    shown = [entry.run(run) for run in runs] or ["No record of a run is stored here."]
    if older:
        shown.append(f"{older} older commands: see runs/.")
    return shown


def _runs(runs: Sequence[Mapping[str, Any]]) -> tuple[list[dict[str, Any]], int]:
    """Returns what was computed, by command, that of the last run first, and the number of older
    commands; a run that found everything stored computed no trial."""
    commands: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for run in runs:
        if run.get("blocks", 1):
            command = _command(run)
            # A command that is run again moves to the end.
            commands[command] = [*commands.pop(command, []), run]
    last_first = list(reversed(commands.items()))[:MOST_RUNS]
    found = [_entry(command, records) for (command, _), records in last_first]
    return found, len(commands) - len(found)


def _command(run: Mapping[str, Any]) -> tuple[str, str]:
    """Returns the command of a run; those from Python are told apart by their records."""
    command = run.get("command", _UNKNOWN)
    return (_PYTHON, run["file"]) if command is None else (public(str(command)), "")


def _entry(command: str, records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Returns what the page shows of a command, from the records of its runs."""
    last = records[-1]
    facts = {
        "runs": ", ".join(record["file"] for record in records),
        "trials": ", ".join(dict.fromkeys(str(record.get("trials")) for record in records)),
        "cells": sum(len(record.get("cells", ())) for record in records),
        "git commit": last.get("git_commit") or "unknown",
        "source": last.get("source"),
        "machine": _pairs(last.get("machine")),
        "versions": _pairs(last.get("libraries")),
    }
    scenarios = [scenario for record in records for scenario in record.get("scenarios", ())]
    config = {"scenarios": scenarios, "estimators": last.get("estimators", {})}
    return {
        "command": command,
        "started": _minute(last["started"]),
        "facts": facts,
        "config": json.dumps(config, indent=1, ensure_ascii=False),
    }


def _pairs(named: Mapping[str, Any] | None) -> str:
    return ", ".join(f"{name} {value}" for name, value in (named or {}).items())


def _minute(started: str) -> str:
    return started[:16].replace("T", " ")


# Definitions --------------------------------------------------------------------------------------

DEFINITIONS: dict[str, str] = {
    "trial": "One draw of true parameters and of noise. Trial t is the same for every estimator.",
    "error scale": (
        "Standard deviation of the true parameters about the start, in multiples of their"
        " sizes (the magnitude of the start of a function's or a formula's parameter)."
    ),
    **{record.title: record.definition for record in STATISTICS},
    "parameter 'all'": (
        "Root mean square over parameters of the statistic over the linear bound, unless its"
        " definition states another."
    ),
    **{record.title: record.definition for record in SCORES},
    "win, tie, loss": (
        f"Errors are paired by trial. Mahalanobis errors that differ by less than {TIE:g} are a"
        " tie, because estimators that share a root differ by round-off alone."
    ),
    "p of error": (
        "Wilcoxon's two-sided signed-rank test without ties (Biometrics Bulletin 1, 1945), exact up"
        f" to {EXACT} trials, with Holm's correction over the pairs of a scenario (Scandinavian"
        " Journal of Statistics 6, 1979)."
    ),
    "p of success": (
        "McNemar's exact test on the trials in which only one of the two succeeds (Psychometrika"
        " 12, 1947), with Holm's correction."
    ),
    "may be the best (bold)": (
        "Other estimators do not succeed significantly more often in the same trials, by the gate"
        " of the Cramér-Rao bound for all: McNemar's exact one-sided test against every rival at 5"
        " % over their number, which leaves a true best out in at most 5 % of scenarios (Hsu,"
        " Annals of Statistics 9, 1981). No name is bold if no estimator is beaten."
    ),
}
