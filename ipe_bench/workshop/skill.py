"""Writes the pages by which a coding agent writes plugins; `run` is the command line, which tries
what the pages say."""

from __future__ import annotations

import contextlib
import inspect
import io
import shlex
import tempfile
from collections.abc import Callable
from pathlib import Path
from pkgutil import resolve_name

import ipe_bench as ib
from ipe_bench.plugins import discovery as plugins
from ipe_bench.workshop.kinds import RECORDS
from ipe_bench.workshop.new import fill, require_absent

SMALL = "noise=gaussian noise.deviation=0.01 trials=50 figures=none"
BENT = f"measurement=polynomial error_scale=10 {SMALL}"
PAGES = {
    "solver": f'run {BENT} "solver=[fixed_point,newton,my_solver]"',
    "filter": f'run {BENT} "baseline=[linear_lse,ekf,ukf,my_filter]"',
    "baseline": f'run {BENT} "baseline=[linear_lse,gauss_newton,my_baseline]"',
    "measurement": (
        f'run measurement=my_measurement {SMALL} "solver=[newton,auto]"'
        ' "baseline=[gauss_newton,ekf,ukf]"'
    ),
    "function": "run measurement=function measurement.of=my_function:my_function "
    f"measurement.columns.t=[0,1,2,3,4,5,6,7] error_scale=0.1 {SMALL}",
    "ode": "run measurement=ode measurement.file=my_ode.yaml error_scale=0.1 trials=50"
    " figures=none",
    "state_model": "run state_model=my_state_model trials=50 figures=none",
    "tracker": 'run state_model=pendulum "tracker=[ekf,ukf,my_tracker]" trials=50 figures=none',
    "noise": "run measurement=polynomial noise=my_noise trials=50 figures=none",
    "prior": f"run measurement=polynomial prior=my_prior {SMALL}",
    "execution": f"run {BENT} execution=my_execution",
    **{kind: f"run {BENT} name=my_{kind}" for kind in RECORDS},
}
PAGES["figure"] = PAGES["figure"].replace("figures=none", "figures=all")
"""The kinds that have a page for coding agents, and a run of each beside its rivals."""


def write_skill(folder: Path, run: Callable[[list[str]], int]) -> list[Path]:
    """Writes SKILL.md and a page for each kind into a new folder, by which a coding agent writes
    plugins; `run` is the command line, which tries what the pages say."""
    require_absent(folder)
    folder = folder.resolve()
    with tempfile.TemporaryDirectory(prefix="ipe-bench-") as place, contextlib.chdir(place):
        # No plugins are known there but those that are installed or made.
        plugins.sources.cache_clear()
        known = [f"- {group}: {_options(group)}" for group in plugins.groups()]
        texts = {f"new-{kind}": _page(kind, run) for kind in PAGES}
    plugins.sources.cache_clear()
    pages = [f"- a new {kind}: `new-{kind}.md`" for kind in PAGES]
    words = {
        "version": ib.__version__,
        "bent": BENT,
        "small": SMALL,
        "pages": "\n".join(pages),
        "options": "\n".join(known),
    }
    fill(folder / "SKILL.md", "skill.md", words)
    for name, text in texts.items():
        (folder / f"{name}.md").write_text(text, encoding="utf-8")
    return sorted(folder.iterdir())


def _options(group: str) -> str:
    return ", ".join(option.name for option in plugins.options(group))


def _page(kind: str, run: Callable[[list[str]], int]) -> str:
    """Returns instructions for a component of a kind: its contract, the skeleton, and what `check`
    tests."""
    name = f"my_{kind}"
    made = f"new {kind} {name}"
    tried = [line.strip() for line in _said(made, run) if "ipe-bench check" in line]
    check = tried[0].removeprefix("ipe-bench ")
    kept = [line for line in _said(check, run) if line.startswith("ok")]
    promises = [f"- {line.partition(': ')[2]}" for line in kept]
    lines = [f"# A new {kind}", ""]
    lines += [f"    ipe-bench {command}" for command in (made, check, PAGES[kind])]
    for place in plugins.CONTRACTS.get(kind, ()):
        contract = inspect.getdoc(resolve_name(place)) or ""
        lines += ["", f"The contract of `{place}`:", *_fenced("text", contract)]
    files = [path for path in sorted(Path().rglob(f"{name}.*")) if path.suffix in (".py", ".yaml")]
    for path in files:
        content = path.read_text(encoding="utf-8").strip()
        lines += ["", f"`{path}`", *_fenced(path.suffix[1:], content)]
    lines += ["", "`check` asks of it:", "", *promises, ""]
    return "\n".join(lines)


def _fenced(language: str, text: str) -> list[str]:
    return ["", f"```{language}", text, "```"]


def _said(command: str, run: Callable[[list[str]], int]) -> list[str]:
    """Returns the lines that a command prints."""
    with contextlib.redirect_stdout(io.StringIO()) as out:
        code = run(shlex.split(command))
    assert code == 0, f"{command}: {out.getvalue()}"
    return out.getvalue().splitlines()
