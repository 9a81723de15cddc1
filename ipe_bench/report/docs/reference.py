"""Reference pages of options, statuses, statistics, commands and Python names, from the program's own descriptions."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

import ipe_bench
from ipe_bench.basics.errors import UserError
from ipe_bench.basics.files import write_text
from ipe_bench.basics.statuses import Status
from ipe_bench.plugins import discovery
from ipe_bench.plugins.description import described
from ipe_bench.report.definitions import DEFINITIONS
from ipe_bench.statistics.records import STATISTICS

GROUPS = {
    "measurement": "Measurement models",
    "noise": "Noises",
    "prior": "Priors",
    "solver": "Solvers",
    "baseline": "Baseline estimators",
    "execution": "Executions",
}


def write_reference(folder: Path) -> None:
    """Adds the generated pages to a folder."""
    for group, title in GROUPS.items():
        write_text(folder / f"{group}.md", _group_page(group, title))
    write_text(folder / "commands.md", _commands_page())
    write_text(folder / "statuses.md", _status_page())
    write_text(folder / "statistics.md", _statistics_page())
    write_text(folder / "python.md", _python_page())


def _group_page(group: str, title: str) -> str:
    lines = [f"# {title}", "", f"Config group `{group}`. Keys are set as `{_key(group)}.KEY=VALUE`.", ""]
    for option in discovery.options(group):
        if option.source.name != "ipe-bench":
            continue
        rows = [(f"`{o.name}`", f"`{o.value}`" if o.value else "", o.kind, o.meaning) for o in described(option)]
        lines += [f"## {option.name}", "", option.summary, ""]
        lines += table(("option", "value", "takes", "meaning"), rows) if rows else []
        if option.target:
            lines += ["", f"Class `{option.target}`.", ""]
    return "\n".join(lines)


def _commands_page() -> str:
    """What each command says of itself when asked."""
    summary = _help()
    commands = re.findall(r"^    (\w+)(?:  |$)", summary, re.MULTILINE)
    lines = ["# Commands", "", "```text", summary, "```", ""]
    for command in commands:
        lines += [f"## {command}", "", "```text", _help(command), "```", ""]
    return "\n".join(lines)


def _help(*command: str) -> str:
    return printed_by([*command, "--help"], columns=100).rstrip()


def _key(group: str) -> str:
    return "estimators.NAME" if group in discovery.ESTIMATOR_GROUPS else group


def _status_page() -> str:
    rows = [(f"`{status.label}`", status.reason) for status in Status if status is not Status.RUNNING]
    words = "How a trial ended. Nothing is left out of the tables because it ended badly."
    return "\n".join(["# Statuses", "", words, "", *table(("status", "a trial ended so because"), rows)])


def _statistics_page() -> str:
    lines = ["# Statistics", "", "Columns of `summary.csv`; a scenario, an estimator and a parameter have a row.", ""]
    lines += table(("column", "meaning"), [(f"`{'`, `'.join(r.columns)}`", r.definition) for r in STATISTICS])
    lines += ["", "## Words of the report", "", *table(("word", "meaning"), DEFINITIONS)]
    return "\n".join(lines)


def _python_page() -> str:
    names = [name for name in ipe_bench.__all__ if not name.startswith("_")]
    lines = ["# Python", "", "`import ipe_bench as ib` loads nothing; each name is loaded when it is first used.", ""]
    for name in names:
        thing = getattr(ipe_bench, name)
        if isinstance(thing, type):
            lines += [f"```{{eval-rst}}\n.. autoclass:: {thing.__module__}.{thing.__qualname__}\n   :members:\n```", ""]
        elif callable(thing) and hasattr(thing, "__qualname__"):
            lines += [f"```{{eval-rst}}\n.. autofunction:: {thing.__module__}.{thing.__qualname__}\n```", ""]
    return "\n".join(lines)


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """The lines of a Markdown table."""
    lines = [f"| {' | '.join(heads)} |", f"|{' --- |' * len(heads)}"]
    return lines + [f"| {' | '.join(_cell(cell) for cell in row)} |" for row in rows]


def _cell(text: str) -> str:
    return " ".join(text.replace("|", "\\|").replace("<", "&lt;").split())


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
