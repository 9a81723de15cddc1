"""Pages that nobody writes: a reference from the program's own descriptions, and a gallery of executed experiments."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

import ipe_bench
from ipe_bench.basics.errors import UserError
from ipe_bench.basics.files import make_folder, write_text
from ipe_bench.basics.statuses import Status
from ipe_bench.plugins.description import described
from ipe_bench.plugins.discovery import ESTIMATOR_GROUPS, Option, options
from ipe_bench.report.definitions import DEFINITIONS
from ipe_bench.report.figures import INDEX
from ipe_bench.report.words import duration
from ipe_bench.statistics.records import STATISTICS

GROUPS = {
    "measurement": "Measurement models",
    "noise": "Noises",
    "prior": "Priors",
    "solver": "Solvers",
    "baseline": "Baseline estimators",
    "execution": "Executions",
}
FIGURES = 3
"""Pictures of an experiment that its page shows."""
ORDINARY, LEAST = 1000, 3
"""Trials of an ordinary experiment, and the least number that a costly one is cut to."""
_PARTS = {"beyond": "error_scale=300,1000,3000", "mgh": "measurement.start=1", "nist": "measurement.start=2"}
"""What is asked for of experiments that take minutes even with few trials."""
_STYLE = re.compile(r"\x1b\[[0-9;]*m")


def printed_by(command: Sequence[str], columns: int = 80) -> str:
    """What `ipe-bench COMMAND` prints, without colours and blanks at the ends of lines.

    Raises:
        UserError: it failed.
    """
    program = [sys.executable, "-m", "ipe_bench", *command]
    environment = os.environ | {"COLUMNS": str(columns), "NO_COLOR": "1"}
    done = subprocess.run(program, capture_output=True, text=True, env=environment, check=False)
    if done.returncode != 0:
        raise UserError(f"{shlex.join(command)}: ended with exit code {done.returncode}: {done.stderr[-2000:]}")
    return "\n".join(line.rstrip() for line in _STYLE.sub("", done.stdout).splitlines())


def _ours(group: str) -> list[Option]:
    return [option for option in options(group) if option.source.name == "ipe-bench"]


# Reference -----------------------------------------------------------------------------------------------------------


def write_reference(folder: Path) -> None:
    """Adds pages of options, commands, statuses, statistics and Python names to a folder."""
    pages = {group: _group_page(group, title) for group, title in GROUPS.items()}
    statuses = [(f"`{status.label}`", status.reason) for status in Status if status is not Status.RUNNING]
    pages["statuses"] = [
        *("# Statuses", "", "How a trial ended. Nothing is left out of the tables because it ended badly.", ""),
        *_table(("status", "a trial ended so because"), statuses),
    ]
    columns = [(f"`{'`, `'.join(r.columns)}`", r.definition) for r in STATISTICS]
    pages["statistics"] = [
        *("# Statistics", "", "Columns of `summary.csv`; a scenario, an estimator and a parameter have a row.", ""),
        *(*_table(("column", "meaning"), columns), "", "## Words of the report", ""),
        *_table(("word", "meaning"), DEFINITIONS),
    ]
    # What each command says of itself when asked.
    summary = printed_by(["--help"], columns=100).rstrip()
    pages["commands"] = ["# Commands", "", "```text", summary, "```", ""]
    for command in re.findall(r"^    (\w+)(?:  |$)", summary, re.MULTILINE):
        said = printed_by([command, "--help"], columns=100).rstrip()
        pages["commands"] += [f"## {command}", "", "```text", said, "```", ""]
    pages["python"] = _python_page()
    for name, lines in pages.items():
        write_text(folder / f"{name}.md", "\n".join(lines))


def _group_page(group: str, title: str) -> list[str]:
    key = "estimators.NAME" if group in ESTIMATOR_GROUPS else group
    lines = [f"# {title}", "", f"Config group `{group}`. Keys are set as `{key}.KEY=VALUE`.", ""]
    for option in _ours(group):
        rows = [(f"`{o.name}`", f"`{o.value}`" if o.value else "", o.kind, o.meaning) for o in described(option)]
        lines += [f"## {option.name}", "", option.summary, ""]
        lines += _table(("option", "value", "takes", "meaning"), rows) if rows else []
        lines += ["", f"Class `{option.target}`.", ""] if option.target else []
    return lines


def _python_page() -> list[str]:
    lines = ["# Python", "", "`import ipe_bench as ib` loads nothing; each name is loaded when it is first used.", ""]
    for name in ipe_bench.__all__:
        thing = getattr(ipe_bench, name)
        if hasattr(thing, "__qualname__"):
            kind, members = ("autoclass", "\n   :members:") if isinstance(thing, type) else ("autofunction", "")
            place = f"{thing.__module__}.{thing.__qualname__}"
            lines += [f"```{{eval-rst}}\n.. {kind}:: {place}{members}\n```", ""]
    return lines


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """The lines of a Markdown table."""
    cells = [[" ".join(c.replace("|", "\\|").replace("<", "&lt;").split()) for c in row] for row in rows]
    return [f"| {' | '.join(row)} |" for row in (heads, ["---"] * len(heads), *cells)]


# Gallery -------------------------------------------------------------------------------------------------------------


def write_gallery(folder: Path, results: Path, trials: int) -> None:
    """A page for each experiment, and one that lists them; `trials` is for an experiment that has 1000 by itself, and
    others have as large a part of theirs."""
    chosen = _ours("experiment")
    for k, option in enumerate(chosen, 1):
        own = (option.config or {}).get("trials", ORDINARY)
        number = min(own, max(round(own * trials / ORDINARY), min(trials, LEAST)))
        counted = f"{number} trial{'s' * (number != 1)}"
        print(f"experiment {k} of {len(chosen)}: {option.name}, {counted} ...", end=" ", flush=True)
        began = time.perf_counter()
        write_text(folder / f"{option.name}.md", _page(option, folder, results / option.name, number))
        print(duration(time.perf_counter() - began, 2), flush=True)
    lines = ["# Gallery", "", "Every experiment, or a part of it, with few of the trials that it has by itself.", ""]
    lines += [f"- [{option.name}]({option.name}.md): {option.summary}" for option in chosen]
    lines += ["", "```{toctree}", ":hidden:", *(option.name for option in chosen), "```"]
    write_text(folder / "index.md", "\n".join(lines))


def _page(option: Option, folder: Path, results: Path, trials: int) -> str:
    """What one experiment printed and drew, with its config."""
    command = ["run", f"+experiment={option.name}"]
    command += [_PARTS[option.name]] if option.name in _PARTS else []
    command += [f"trials={trials}"] if (option.config or {}).get("trials") != trials else []
    # The paths at its end are of no use to a reader.
    printed = printed_by([*command, f"output={results.resolve()}"]).partition("\nSummary ")[0].strip()
    lines = [f"# {option.name}", "", option.summary, "", "```console", f"$ ipe-bench {shlex.join(command)}", "```", ""]
    lines += ["```text", printed, "```", ""]
    make_folder(folder / "pictures")
    # A report on certified readings alone may have no figures.
    index = results / "figures" / INDEX
    for entry in json.loads(index.read_text(encoding="utf-8"))[:FIGURES] if index.exists() else ():
        name = entry["name"]
        shutil.copyfile(results / "figures" / f"{name}.png", folder / "pictures" / f"{option.name}_{name}.png")
        title = name.replace("_", " ")
        lines += [f"![{title}](pictures/{option.name}_{name}.png)", "", f"*{entry['caption']}*", ""]
    return "\n".join([*lines, "## Its config", "", "```yaml", option.text.rstrip(), "```", ""])
