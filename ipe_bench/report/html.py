"""Renders the page report.html: one file that is readable on a phone, on paper and without a network."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ipe_bench import __version__
from ipe_bench.report.headline import about, box
from ipe_bench.report.table import Table
from ipe_bench.report.words import public
from ipe_bench.report.writer import digests, rendered
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
    analysis: Analysis, tables: Sequence[Table], figures: Sequence[Drawn], written: Sequence[Written] = ()
) -> str:
    """Renders the page as text; what plugins have written stands behind our tables."""
    collection, runs = analysis.collection, _runs(analysis.collection.runs)
    commands = dict.fromkeys(run["command"] for run in runs if run["command"] not in (_PYTHON, _UNKNOWN))
    appendix = [table for table in tables if table.appendix]
    tables = [table for table in tables if not table.appendix]
    nothing_failed = analysis.endings.empty and not analysis.summary.empty
    complete = f"{collection.complete} of {collection.expected} expected cells (a scenario under an estimator) complete"
    sentences, table = box(analysis)
    sections = [
        *([("figures", "Figures")] if len(figures) > 1 else ()),
        *([("tables", "Tables")] if len(tables) > 1 or nothing_failed else ()),
        *((f"section-{section.name}", section.title) for section in written),
        *([("appendix", "Further tables")] if appendix else ()),
        ("provenance", "Configuration and provenance"),
        ("definitions", "Definitions"),
        ("cite", "How to cite"),
    ]
    return rendered(
        "report.html.j2",
        figures,
        kind="report",
        folder="figures/",
        facts=[
            *([_minute(collection.runs[-1]["started"])] if collection.runs else ()),
            complete,
            f"ipe-bench {__version__}",
        ],
        sources=[(public(folder), digest) for folder, digest in digests(collection.directories)],
        about=about(analysis),
        headline=sentences,
        box=table,
        problems=[*collection.problems, *collection.stale],
        title=", ".join(d.resolve().name or str(d) for d in collection.directories),
        commands=list(commands)[:MOST_COMMANDS],
        sections=sections,
        tables=tables,
        written=written,
        appendix=appendix,
        nothing_failed=nothing_failed,
        runs=runs[:MOST_RUNS],
        older_runs=max(0, len(runs) - MOST_RUNS),
        definitions=[
            *DEFINITIONS.items(),
            *((one.title, one.definition) for one in all_statistics()[len(STATISTICS) :]),
        ],
    )


def _runs(runs: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Returns what was computed, by command, the last first; a run that found everything stored computed no trial."""
    commands: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for run in (run for run in runs if run.get("blocks", 1)):
        command = run.get("command", _UNKNOWN)
        commands.setdefault((_PYTHON, run["file"]) if command is None else (public(str(command)), ""), []).append(run)
    found = []
    for (command, _), records in reversed(commands.items()):
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
        found.append({"command": command, "started": _minute(records[0]["started"]), "facts": facts, "config": text})
    return found


def _minute(started: str) -> str:
    return started[:16].replace("T", " ")


# Definitions ---------------------------------------------------------------------------------------------------------

DEFINITIONS: dict[str, str] = {
    "trial": "One draw of true parameters and of noise. Trial t is the same for every estimator.",
    "error scale": "Standard deviation of the true parameters about the nominal point, in multiples of the parameters'"
    " unit inputs.",
    **{record.title: record.definition for record in STATISTICS},
    "parameter 'all'": "Root mean square over parameters of the statistic over the linear bound, unless the statistic"
    " says otherwise.",
    **{record.title: record.definition for record in SCORES},
    "win, tie, loss": f"Errors are paired by trial. Mahalanobis errors that differ by less than {TIE:g} are a tie,"
    " because estimators that share a root differ by round-off alone.",
    "p of error": "Wilcoxon's two-sided signed-rank test without ties (Biometrics Bulletin 1, 1945), with Holm's"
    " correction over the pairs of a scenario (Scandinavian Journal of Statistics 6, 1979).",
    "p of success": "McNemar's exact test on the trials in which only one of the two succeeds (Psychometrika 12,"
    " 1947), with Holm's correction.",
    "may be the best (bold)": "No rival succeeds significantly more often in the same trials, by the gate of the"
    " Cramér-Rao bound for all: McNemar's exact one-sided test against every rival at 5 % over their number, which"
    " leaves a true best out in at most 5 % of scenarios (Hsu, Annals of Statistics 9, 1981). Nothing is bold if no"
    " estimator is beaten.",
}
