"""`python -m ipe_bench.report.docs [OUTPUT] [--trials N]`: builds the site by Sphinx, of written pages, of what the
program says of itself, and of what its experiments print and draw."""

from __future__ import annotations

import argparse
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from importlib.metadata import version
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

import pandas as pd

import ipe_bench
from ipe_bench.basics.errors import UserError
from ipe_bench.basics.files import make_folder, write_text
from ipe_bench.basics.statuses import Status
from ipe_bench.plugins.construct import described
from ipe_bench.plugins.discovery import CONTRACTS, PACKAGES, Option, options
from ipe_bench.report.figures import INDEX
from ipe_bench.report.table import environment
from ipe_bench.report.words import brief, duration, enumerate_few, percent
from ipe_bench.statistics.records import ALL, MAIN, STATISTICS

SETTINGS = {
    "project": "ipe-bench",
    "version": version("ipe-bench"),
    "release": version("ipe-bench"),
    "copyright": "the authors of ipe-bench",
    "extensions": ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "ipe_bench.report.docs"],
    "myst_enable_extensions": ["attrs_inline", "dollarmath", "deflist", "colon_fence"],
    "myst_heading_anchors": 3,
    "nb_execution_mode": "force",
    "nb_execution_in_temp": True,
    "nb_execution_raise_on_error": True,
    "nb_execution_timeout": 120,
    "html_theme": "pydata_sphinx_theme",
    "html_title": "ipe-bench",
    "html_show_sourcelink": False,
    "html_math_renderer": "mathml",
    "html_theme_options": {
        "show_prev_next": False,
        "navigation_with_keys": False,
        "secondary_sidebar_items": ["page-toc"],
    },
    "autodoc_typehints": "none",
    "autodoc_member_order": "bysource",
}
"""Settings of Sphinx; an opened page fetches no further resource."""
GROUPS = {
    "measurement": "Measurement models",
    "noise": "Noises",
    "prior": "Priors",
    "solver": "Solvers",
    "baseline": "Baseline estimators",
    "state_model": "State models",
    "tracker": "Filters and smoothers of states",
    "execution": "Executions",
}
CLASSES = {place for places in CONTRACTS.values() for place in places}
FIGURES = 8
"""Largest number of an experiment's pictures on its page."""
ORDINARY, LEAST = 1000, 3
"""Trials of an ordinary experiment, and the least number that a costly one is cut to."""
_PARTS = {
    "beyond": ["error_scale=300,1000,3000"],
    "headline": ["trials=40"],
    "nist": ["measurement.start=2"],
}
"""Reduced settings of experiments that take minutes, and the trials of the picture on the first page."""


def build(output: Path, trials: int) -> int:
    """Writes the site to OUTPUT/html and what it is made of beside it; returns Sphinx's exit code."""
    from sphinx.application import Sphinx  # pyright: ignore[reportMissingImports]

    source = output / "source"
    shutil.rmtree(source, ignore_errors=True)
    with as_file(files("ipe_bench.report.docs") / "pages") as pages:
        shutil.copytree(pages, source)
    print("reference pages ...", flush=True)
    write_reference(source / "reference")
    write_gallery(source / "gallery", output / "results", trials)
    places = (output / "html", output / "doctrees")
    site = Sphinx(source, None, *places, "html", SETTINGS, warningiserror=True, freshenv=True)
    site.build()
    return site.statuscode


def printed_by(command: Sequence[str], columns: int = 80) -> str:
    """Returns the output of `ipe-bench COMMAND`, without blanks at the ends of lines; a UserError if it fails."""
    program = [sys.executable, "-m", "ipe_bench", *command]
    environment = os.environ | {"COLUMNS": str(columns), "NO_COLOR": "1"}
    done = subprocess.run(program, capture_output=True, text=True, env=environment, check=False)
    if done.returncode != 0:
        raise UserError(f"{shlex.join(command)}: ended with exit code {done.returncode}: {done.stderr[-2000:]}")
    return "\n".join(line.rstrip() for line in done.stdout.splitlines())


def write_page(path: Path, template: str, **content: Any) -> None:
    """Writes a page from its template, in which the filter `cell` makes any text a cell of a Markdown table."""
    made = environment().overlay(autoescape=False)
    made.filters["cell"] = lambda text: " ".join(str(text).replace("|", "\\|").replace("<", "&lt;").split())
    write_text(path, made.get_template(f"docs/{template}.md.j2").render(content))


def _ours(group: str) -> list[Option]:
    return [option for option in options(group) if option.source.name == "ipe-bench"]


def write_reference(folder: Path) -> None:
    """Adds pages of options, commands, statuses, statistics and Python names to a folder."""
    from ipe_bench.report.html import DEFINITIONS

    for group, title in GROUPS.items():
        rows = [(option, described(option)) for option in _ours(group)]
        key = f"{PACKAGES[group]}.NAME" if group in PACKAGES else group
        write_page(folder / f"{group}.md", "options", group=group, title=title, key=key, options=rows)
    statuses = [status for status in Status if status is not Status.RUNNING]
    write_page(folder / "statuses.md", "statuses", statuses=statuses)
    write_page(folder / "statistics.md", "statistics", records=STATISTICS, definitions=DEFINITIONS.items(), main=MAIN)
    summary = printed_by(["--help"], columns=100).rstrip()
    names = re.findall(r"^    (\w+)(?:  |$)", summary, re.MULTILINE)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        said = pool.map(lambda name: printed_by([name, "--help"], columns=100).rstrip(), names)
        write_page(folder / "commands.md", "commands", commands={"": summary, **dict(zip(names, said, strict=True))})
    write_page(folder / "contracts.md", "contracts", kinds=CONTRACTS)
    things = [(name, getattr(ipe_bench, name)) for name in ipe_bench.__all__ if f"ipe_bench.{name}" not in CLASSES]
    shown = [(name, thing) for name, thing in things if hasattr(thing, "__qualname__")]
    kinds = [("autoclass" if isinstance(t, type) else "autofunction", f"ipe_bench.{name}") for name, t in shown]
    write_page(folder / "python.md", "python", names=kinds)


def write_gallery(folder: Path, results: Path, trials: int) -> None:
    """Writes a page per experiment, their list, and a table of the best estimators by model; `trials` replaces the
    default of 1000."""
    chosen, found, began = _ours("experiment"), {}, time.perf_counter()
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        running = {pool.submit(_executed, option, folder, results / option.name, trials): option for option in chosen}
        for number, done in enumerate(as_completed(running), 1):
            name, at = running[done].name, duration(time.perf_counter() - began, 2)
            found[name] = done.result()
            print(f"experiment {number} of {len(chosen)}: {name}, at {at}", flush=True)
    write_page(folder / "index.md", "gallery", experiments=[(option, found[option.name]) for option in chosen])
    summaries = {option.name: results / option.name / "summary.csv" for option in chosen}
    rows = [row for name, path in summaries.items() if path.exists() for row in _best(name, pd.read_csv(path))]
    write_page(folder / "best.inc", "best", rows=rows)


def _executed(option: Option, folder: Path, results: Path, trials: int) -> list[dict[str, str]]:
    """Runs one experiment, writes its page, and returns the figures that the page shows."""
    command = ["run", f"+experiment={option.name}", *_PARTS.get(option.name, ())]
    own = (option.config or {}).get("trials", ORDINARY)
    number = min(own, max(round(own * trials / ORDINARY), min(trials, LEAST)))
    if number != own and not any(word.startswith("trials=") for word in command):
        command.append(f"trials={number}")
    whole = printed_by([*command, "execution=serial", f"output={results.resolve()}"])
    printed = whole.partition("\nSummary ")[0].strip()  # the paths at its end are of no use to a reader
    index = results / "figures" / INDEX  # there is none without figures
    figures = json.loads(index.read_text(encoding="utf-8"))[:FIGURES] if index.exists() else []
    make_folder(folder / "pictures")
    for figure in figures:
        picture = results / "figures" / f"{figure['name']}.png"
        shutil.copyfile(picture, folder / "pictures" / f"{option.name}_{figure['name']}.png")
    text = {"command": shlex.join(command), "printed": printed, "figures": figures}
    write_page(folder / f"{option.name}.md", "experiment", option=option, **text)
    return figures


def _best(experiment: str, summary: pd.DataFrame) -> Iterator[tuple[str, ...]]:
    """Yields who succeeds most often, and at what cost, at the least and the largest error scale of a simulated
    experiment."""
    if "truth" in summary or not {"measurement", "noise", "success"} <= set(summary):
        return
    totals = summary[(summary["parameter"] == ALL) & (summary["noise"] != "certified")]
    for scale in sorted({totals["error_scale"].min(), totals["error_scale"].max()} if len(totals) else ()):
        here = totals[totals["error_scale"] == scale].sort_values("simulations_median", kind="stable")
        best = here[here["success"] == here["success"].max()]
        names = dict.fromkeys((str(best["measurement"].iloc[0]), experiment))
        link = f"[{', '.join(names)}](gallery/{experiment}.md)"
        share = f"{percent(best['success'].iloc[0])} of {best['trials'].iloc[0]}"
        cost = brief(best["simulations_median"].iloc[0])
        yield link, f"{scale:g}", enumerate_few(list(best["estimator"]), 5), share, cost


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", nargs="?", default="outputs/docs", type=Path)
    parser.add_argument("--trials", type=int, default=10, help="of an experiment that has 1000 by itself")
    arguments = parser.parse_args()
    sys.exit(build(arguments.output, arguments.trials))
