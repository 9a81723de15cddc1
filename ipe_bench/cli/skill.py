"""`ipe-bench new skill DIR`: pages by which a coding agent writes plugins, made from what the commands say themselves.

Options come from `list`, skeletons from `new`, and what a component must pass from `check`, so that no page can differ
from the program that wrote it.
"""

from __future__ import annotations

import contextlib
import io
import shlex
import tempfile
from collections.abc import Iterator
from pathlib import Path

from ipe_bench import __version__
from ipe_bench.basics.errors import UserError
from ipe_bench.basics.files import write_text
from ipe_bench.cli.main import main
from ipe_bench.plugins import discovery

SMALL = "noise=gaussian noise.deviation=0.01 trials=50 figures=none"
BENT = f"measurement=polynomial error_scale=10 {SMALL}"
KINDS = {
    "solver": f'run {BENT} "solver=[fixed_point,newton,my_solver]"',
    "filter": f'run {BENT} "baseline=[linear_lse,ekf,ukf,my_filter]"',
    "baseline": f'run {BENT} "baseline=[linear_lse,gauss_newton,my_baseline]"',
    "measurement": f'run measurement=my_measurement {SMALL} "solver=[newton,auto]" "baseline=[gauss_newton,ekf,ukf]"',
    "function": "run measurement=function measurement.of=my_function:my_function "
    f"measurement.columns.t=[0,1,2,3,4,5,6,7] error_scale=0.1 {SMALL}",
    "ode": "run measurement=ode measurement.file=my_ode.yaml error_scale=0.1 trials=50 figures=none",
    "model": "run model=my_model trials=50 figures=none",
    "noise": "run measurement=polynomial noise=my_noise trials=50 figures=none",
    "statistic": f"run {BENT}",
}
"""The kinds that have a page, and a run of each beside its rivals."""
ROUTER = """\
---
name: ipe-bench
description: Write, check and compare estimators, filters, measurement models, noises and statistics with ipe-bench
---
# ipe-bench {version}

Read the page of the kind that is asked for, run its first command, replace the skeleton, and repeat `check` until it
exits with 0.

{pages}

## Rules

1. Edit only `plugins/NAME`, or the one file of a function or of differential equations. `plugins/NAME` holds
   `ipe_bench_NAME/NAME.py`, its config, a `pyproject.toml` and a test. It is known in the folder above `plugins`, and
   everywhere after `pip install plugins/NAME`.
2. A component is a frozen dataclass. Its fields are its options, and its config file sets them.
3. Arrays are batched: x is (trials, n), readings are (trials, m). A trial has the same bits alone and in any batch: use
   stacked `matmul`, `einsum` or `solve`, and draw random numbers only from the generator that is handed in.
4. x counts in multiples of the parameters' sizes. SI units everywhere else. At error scale 1 a true parameter scatters
   about its start by a standard deviation of one size, at 5 by five: choose sizes by how little is known beforehand.
5. Exit codes: 0 done; 1 done, but checks or trials failed; 2 a mistake in the command, which one line explains.
6. Claim a difference only if `compare` finds one.

## Compare, and estimate from readings

    ipe-bench run {bent} "solver=[fixed_point,newton]" output=out
    ipe-bench compare out first=newton second=fixed_point
    ipe-bench run -m error_scale=1,5 measurement=polynomial {small}
    ipe-bench run {bent} write_readings=trial.csv
    ipe-bench estimate measurement=polynomial readings=trial.csv noise=gaussian noise.deviation=0.01 figures=none

## Options

`ipe-bench list GROUP/NAME` shows the options of one with types and defaults, `ipe-bench run --help` every key.

{options}
"""


def write_skill(folder: Path) -> list[Path]:
    """Writes SKILL.md and a page for each kind into a new folder, and returns the files."""
    if folder.exists():
        raise UserError(f"{folder}: is there already and is not overwritten; choose another folder")
    folder = folder.resolve()
    with _elsewhere():
        options: dict[str, list[str]] = {}
        for option in discovery.options():
            options.setdefault(option.group, []).append(option.name)
        texts = {f"new-{kind}": _page(kind) for kind in KINDS}
    pages = "\n".join(f"- a new {kind}: `new-{kind}.md`" for kind in KINDS)
    known = "\n".join(f"- {group}: {', '.join(names)}" for group, names in options.items())
    texts["SKILL"] = ROUTER.format(version=__version__, bent=BENT, small=SMALL, pages=pages, options=known)
    files = [folder / f"{name}.md" for name in sorted(texts)]
    for path in files:
        write_text(path, texts[path.stem])
    return files


@contextlib.contextmanager
def _elsewhere() -> Iterator[None]:
    """An empty working folder, in which no plugins are known but those that are installed or made there."""
    with tempfile.TemporaryDirectory(prefix="ipe-bench-") as place, contextlib.chdir(place):
        discovery.sources.cache_clear()
        yield
    discovery.sources.cache_clear()


def _page(kind: str) -> str:
    """How to make a component of a kind, with the skeleton, and with the promises that `check` tries."""
    name = f"my_{kind}"
    tried = [line.strip() for line in _said(f"new {kind} {name}").splitlines() if "ipe-bench check" in line]
    check = tried[0].removeprefix("ipe-bench ")
    promises = [line.partition(": ")[2] for line in _said(check).splitlines() if line.startswith("ok")]
    sources = [p for p in sorted(Path().rglob(f"{name}.*")) if p.suffix in (".py", ".yaml")]
    lines = [
        f"# A new {kind}",
        "",
        f"    ipe-bench new {kind} {name}",
        f"    ipe-bench {check}",
        f"    ipe-bench {KINDS[kind]}",
    ]
    for path in sources:
        lines += ["", f"`{path}`", "", f"```{path.suffix[1:]}", path.read_text(encoding="utf-8").strip(), "```"]
    return "\n".join([*lines, "", "`check` asks of it:", "", *(f"- {promise}" for promise in promises), ""])


def _said(command: str) -> str:
    """What a command prints."""
    with contextlib.redirect_stdout(io.StringIO()) as out:
        code = main(shlex.split(command))
    assert code == 0, f"{command}: {out.getvalue()}"
    return out.getvalue()
