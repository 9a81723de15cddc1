"""report.html: one file with everything in it, readable on a phone, on paper and without a network."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from importlib import resources
from typing import Any

from ipe_bench import __version__
from ipe_bench.report.definitions import definitions
from ipe_bench.report.headline import headline
from ipe_bench.report.sections import Written
from ipe_bench.report.tables import Table
from ipe_bench.statistics.analysis import Analysis
from ipe_bench.statistics.collect import Run

Shown = tuple[str, str, str, bytes]
"""Name, title, caption and PNG of a figure."""
MOST_ROWS = 2000
"""Rows of one table on the page; its CSV file has all."""
MOST_RUNS = 20
_SECTIONS = (
    ("figures", "Figures"),
    ("tables", "Tables"),
    ("theory", "Theory beside what happened"),
    ("provenance", "Configuration and provenance"),
    ("definitions", "Definitions"),
)


def render_page(
    analysis: Analysis, tables: Sequence[Table], figures: Sequence[Shown], written: Sequence[Written] = ()
) -> str:
    """The page as text; what plugins have written stands behind our tables."""
    from jinja2 import Environment, StrictUndefined

    source = resources.files("ipe_bench.report").joinpath("templates/report.html.j2").read_text(encoding="utf-8")
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    collection = analysis.collection
    return environment.from_string(source).render(
        version=__version__,
        headline=headline(analysis),
        directories=[str(d) for d in collection.directories],
        expected=collection.expected,
        complete=collection.complete,
        problems=[*collection.problems, *collection.stale],
        title=", ".join(d.resolve().name or str(d) for d in collection.directories),
        computed=collection.runs[-1].started[:16].replace("T", " ") if collection.runs else "",
        sections=_contents(tables, written),
        tables=[_table(t) for t in tables if not t.appendix],
        written=[
            {"name": s.name, "title": s.title, "parts": [p if isinstance(p, str) else _table(p) for p in s.parts]}
            for s in written
        ],
        theory=[_table(t) for t in tables if t.appendix],
        figures=[
            {"name": name, "title": title, "caption": caption, "data": base64.b64encode(png).decode()}
            for name, title, caption, png in figures
        ],
        nothing_failed=analysis.endings.empty and not analysis.summary.empty,
        runs=[_run(run) for run in collection.runs[-MOST_RUNS:][::-1]],
        older_runs=max(0, len(collection.runs) - MOST_RUNS),
        definitions=definitions(),
    )


def _contents(tables: Sequence[Table], written: Sequence[Written]) -> list[tuple[str, str]]:
    """The sections that there are, in order."""
    own = [s for s in _SECTIONS if s[0] != "theory" or any(t.appendix for t in tables)]
    return [*own[:2], *((f"section-{s.name}", s.title) for s in written), *own[2:]]


def _table(table: Table) -> dict[str, Any]:
    rows = list(table.rows)
    return {
        "name": table.name,
        "title": table.title,
        "caption": table.caption,
        "columns": table.columns,
        "rows": rows[:MOST_ROWS],
        "cut": max(0, len(rows) - MOST_ROWS),
    }


def _run(run: Run) -> dict[str, Any]:
    record = run.record
    config = {key: record[key] for key in ("config", "scenarios", "estimators") if key in record}
    machine = record.get("machine") or {}
    facts = {
        "started": run.started,
        "trials": record.get("trials"),
        "cells": len(record.get("cells", ())),
        "git commit": record.get("git_commit") or "unknown",
        "source": record.get("source"),
        "machine": ", ".join(f"{k} {v}" for k, v in machine.items()) if isinstance(machine, dict) else machine,
        "versions": ", ".join(f"{k} {v}" for k, v in (record.get("libraries") or {}).items()),
    }
    return {"name": run.path.name, "facts": facts, "config": json.dumps(config, indent=1, ensure_ascii=False)}
