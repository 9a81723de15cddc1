"""Renders the page report.html: one file that is readable on a phone, on paper and without a network."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ipe_bench.report.page.headline import about, headline, success
from ipe_bench.report.page.writer import Page, digests
from ipe_bench.report.tables.matrix import MATRIX, Matrix
from ipe_bench.report.tables.table import Part, Strong, Table, environment, words
from ipe_bench.report.words import public
from ipe_bench.runs.parts import TRUTH
from ipe_bench.statistics.comparisons import TIE
from ipe_bench.statistics.records import SCORES, STATISTICS
from ipe_bench.statistics.registry import all_statistics

if TYPE_CHECKING:
    from ipe_bench.report.figures import Drawn
    from ipe_bench.report.sections import Written
    from ipe_bench.statistics.analysis import Analysis

MOST_RUNS = 20
MOST_COMMANDS = 3
"""Largest number of commands at the head of the page; all stand with the provenance."""
_PYTHON, _UNKNOWN = "from Python", "a command that was not recorded"


def render_page(
    analysis: Analysis,
    tables: Sequence[Table],
    figures: Sequence[Drawn],
    written: Sequence[Written] = (),
) -> str:
    """Renders the page as text; what plugins have written stands behind our tables."""
    collection = analysis.collection
    runs, older = _runs(collection.runs)
    commands = dict.fromkeys(
        run["command"] for run in runs if run["command"] not in (_PYTHON, _UNKNOWN)
    )
    answer = headline(analysis)
    # What the matrix shows is not drawn a second time, and the whole table is folded below it.
    tiled = any(isinstance(part, Matrix) for part in answer)
    pictures = [figure for figure in figures if not figure.name.startswith(MATRIX)]
    main: list[Part] = [table for table in tables if not table.appendix]
    asked = [
        cell for cell in collection.cells if cell.expected and cell.names["estimator"] != TRUTH
    ]
    complete = sum(cell.complete for cell in asked)
    converged = analysis.endings.empty and not analysis.summary.empty
    sections = [
        ("figures", "Figures", pictures[1:]),
        (
            "tables",
            "Tables",
            [
                *main[0 if tiled else 1 :],
                *(["Every trial of every estimator converged."] if converged else []),
            ],
        ),
        *((f"section-{section.name}", section.title, section.parts) for section in written),
        ("appendix", "Further tables", [table for table in tables if table.appendix]),
        ("provenance", "Configuration and provenance", _provenance(runs, older)),
        ("definitions", "Definitions", [_definitions()]),
    ]
    names = ", ".join(d.resolve().name or str(d) for d in collection.directories)
    title = str(answer.pop(0)).removesuffix(".") if isinstance(answer[0], Strong) else names
    page = Page(
        "report",
        title,
        answer,
        [*pictures[:1], *([] if tiled else main[:1])],
        sections,
        folder="figures/",
        facts=[
            *([names] if names and title != names else ()),
            *([_minute(collection.runs[-1]["started"])] if collection.runs else ()),
            *(
                [f"{complete} of {len(asked)} results (an estimator in a scenario) complete"]
                if asked
                else ()
            ),
        ],
        lead=success(analysis),
        commands=list(commands)[:MOST_COMMANDS],
        sources=digests(collection.directories),
        about=about(analysis),
        drawn=[path for figure in figures if figure not in pictures for path in figure.files],
        problems=[*collection.problems, *collection.stale],
    )
    return page.html()


def _definitions() -> Table:
    added = all_statistics()[len(STATISTICS) :]
    defined = DEFINITIONS | {one.title: one.definition for one in added}
    return Table("words", "", "", [words("word", defined), words("meaning", defined.values())])


def _provenance(runs: Sequence[Mapping[str, Any]], older: int) -> list[str]:
    """Returns an entry for each command, as HTML, and how many older ones are left out."""
    entry: Any = environment().get_template("parts.html.j2").module
    shown = [entry.run(run) for run in runs] or ["No record of a run is stored here."]
    return [*shown, *([f"{older} older commands have their records in runs/."] if older else [])]


def _runs(runs: Sequence[Mapping[str, Any]]) -> tuple[list[dict[str, Any]], int]:
    """Returns what was computed, by command, the last first, and the number of older commands; a run that found
    everything stored computed no trial."""
    commands: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for run in (run for run in runs if run.get("blocks", 1)):
        command = run.get("command", _UNKNOWN)
        commands.setdefault(
            (_PYTHON, run["file"]) if command is None else (public(str(command)), ""), []
        ).append(run)
    found = []
    for (command, _), records in list(reversed(commands.items()))[:MOST_RUNS]:
        last = records[-1]
        facts = {
            "runs": ", ".join(record["file"] for record in records),
            "trials": ", ".join(dict.fromkeys(str(record.get("trials")) for record in records)),
            "cells": sum(len(record.get("cells", ())) for record in records),
            "git commit": last.get("git_commit") or "unknown",
            "source": last.get("source"),
            "machine": ", ".join(f"{k} {v}" for k, v in (last.get("machine") or {}).items()),
            "versions": ", ".join(f"{k} {v}" for k, v in (last.get("libraries") or {}).items()),
        }
        scenarios = [scenario for record in records for scenario in record.get("scenarios", ())]
        config = {"scenarios": scenarios, "estimators": last.get("estimators", {})}
        text = json.dumps(config, indent=1, ensure_ascii=False)
        found.append(
            {
                "command": command,
                "started": _minute(records[0]["started"]),
                "facts": facts,
                "config": text,
            }
        )
    return found, len(commands) - len(found)


def _minute(started: str) -> str:
    return started[:16].replace("T", " ")


# Definitions ---------------------------------------------------------------------------------------------------------

DEFINITIONS: dict[str, str] = {
    "trial": "One draw of true parameters and of noise. Trial t is the same for every estimator.",
    "error scale": "Standard deviation of the true parameters about the nominal point, in multiples of their sizes"
    " (the magnitude of the start of a function's or a formula's parameter).",
    **{record.title: record.definition for record in STATISTICS},
    "parameter 'all'": "Root mean square over parameters of the statistic over the linear bound, unless its definition"
    " states another.",
    **{record.title: record.definition for record in SCORES},
    "win, tie, loss": f"Errors are paired by trial. Mahalanobis errors that differ by less than {TIE:g} are a tie,"
    " because estimators that share a root differ by round-off alone.",
    "p of error": "Wilcoxon's two-sided signed-rank test without ties (Biometrics Bulletin 1, 1945), with Holm's"
    " correction over the pairs of a scenario (Scandinavian Journal of Statistics 6, 1979).",
    "p of success": "McNemar's exact test on the trials in which only one of the two succeeds (Psychometrika 12,"
    " 1947), with Holm's correction.",
    "may be the best (bold)": "Other estimators do not succeed significantly more often in the same trials, by the"
    " gate of the Cramér-Rao bound for all: McNemar's exact one-sided test against every rival at 5 % over their"
    " number, which leaves a true best out in at most 5 % of scenarios (Hsu, Annals of Statistics 9, 1981). No name"
    " is bold if no estimator is beaten.",
}
