"""The page report.html: one file that is readable on a phone, on paper and without a network."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Sequence
from importlib import resources
from typing import Any

from ipe_bench import __version__
from ipe_bench.report.charts import Chart
from ipe_bench.report.definitions import CITATION, definitions
from ipe_bench.report.figures import Drawn
from ipe_bench.report.headline import about, headline
from ipe_bench.report.sections import Written
from ipe_bench.report.table import Table, environment
from ipe_bench.statistics.analysis import Analysis
from ipe_bench.statistics.collect import Run

MOST_RUNS = 20
MOST_COMMANDS = 3
"""At the head of the page; all stand with the provenance."""
_PYTHON, _UNKNOWN = "from Python", "a command that was not recorded"


def render_page(
    analysis: Analysis,
    tables: Sequence[Table],
    figures: Sequence[Drawn],
    written: Sequence[Written] = (),
    charts: Sequence[Chart] = (),
) -> str:
    """The page as text; what plugins have written stands behind our tables."""
    from markupsafe import Markup

    collection, runs = analysis.collection, _runs(analysis.collection.runs)
    commands = dict.fromkeys(run["command"] for run in runs if run["command"] not in (_PYTHON, _UNKNOWN))
    templates = resources.files("ipe_bench.report") / "templates"
    script, style = ((templates / name).read_text(encoding="utf-8") for name in ("report.js", "report.css"))
    page = environment().get_template("report.html.j2")
    return page.render(
        version=__version__,
        script=Markup(script),
        style=Markup(style),
        policy=_policy(script, style),
        about=about(analysis),
        headline=headline(analysis),
        collection=collection,
        title=", ".join(d.resolve().name or str(d) for d in collection.directories),
        computed=_minute(collection.runs[-1].started) if collection.runs else "",
        commands=list(commands)[:MOST_COMMANDS],
        tables=[table for table in tables if not table.appendix],
        written=written,
        appendix=[table for table in tables if table.appendix],
        figures=[_picture(figure) for figure in figures],
        charts=charts,
        nothing_failed=analysis.endings.empty and not analysis.summary.empty,
        runs=runs[:MOST_RUNS],
        older_runs=max(0, len(runs) - MOST_RUNS),
        citation=CITATION,
        definitions=definitions(),
    )


def _policy(script: str, style: str) -> str:
    """Nothing may be fetched or sent, and no other script or style than ours has a say."""
    digests = [base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in (script, style)]
    return (
        f"default-src 'none'; script-src 'sha256-{digests[0]}'; style-src 'sha256-{digests[1]}'; img-src data:;"
        " base-uri 'none'; form-action 'none'"
    )


def _picture(figure: Drawn) -> dict[str, Any]:
    png, names = base64.b64encode(figure.files[0].read_bytes()).decode(), [path.name for path in figure.files]
    return {"name": figure.name, "title": figure.title, "caption": figure.caption, "data": png, "files": names}


def _runs(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """What was computed, by command, the last first: all that its jobs have in common, and the configuration of each;
    a run that found everything stored computed nothing."""
    commands: dict[tuple[str, str], list[Run]] = {}
    for run in (run for run in runs if run.record.get("blocks", 1)):
        command = run.record.get("command", _UNKNOWN)
        commands.setdefault((_PYTHON, run.path.name) if command is None else (str(command), ""), []).append(run)
    found = []
    for (command, _), own in reversed(commands.items()):
        records, last = [run.record for run in own], own[-1].record
        facts = {
            "runs": ", ".join(run.path.stem for run in own),
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
        found.append({"command": command, "started": _minute(own[0].started), "facts": facts, "config": text})
    return found


def _minute(started: str) -> str:
    return started[:16].replace("T", " ")
