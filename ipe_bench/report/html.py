"""report.html: one file with everything in it, readable on a phone, on paper and without a network."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from importlib import resources

from ipe_bench import __version__
from ipe_bench.report import tables
from ipe_bench.report.headline import headline
from ipe_bench.statistics.analysis import Analysis

Shown = tuple[str, str, str, bytes]
"""Name, title, caption and PNG of a figure."""


def render_page(analysis: Analysis, figures: Sequence[Shown]) -> str:
    """The page as text."""
    from jinja2 import Environment, StrictUndefined

    source = resources.files("ipe_bench.report").joinpath("templates/report.html.j2").read_text(encoding="utf-8")
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    collection = analysis.collection
    shown_tables = [] if analysis.summary.empty else [tables.overview(analysis)]
    return environment.from_string(source).render(
        version=__version__,
        headline=headline(analysis),
        directories=[str(d) for d in collection.directories],
        expected=collection.expected,
        complete=collection.complete,
        problems=collection.problems,
        tables=shown_tables,
        figures=[
            {"name": name, "title": title, "caption": caption, "data": base64.b64encode(png).decode()}
            for name, title, caption, png in figures
        ],
        endings=analysis.endings.to_dict("records"),
        runs=[
            {
                "started": run.started,
                "name": run.path.name,
                "commit": run.record.get("git_commit"),
                "versions": run.record.get("versions") or {},
                "machine": run.record.get("machine") or {},
                "text": json.dumps({k: v for k, v in run.record.items() if k != "cells"}, indent=1),
            }
            for run in collection.runs
        ],
    )
