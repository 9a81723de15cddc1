"""The loop that a researcher lives in, timed as whole commands: change a line of a solver, run 200 trials at two error
scales, see the table.

    python tests/benchmarks/loop.py [FOLDER] [--beside CHECKOUT]

Each figure is the least of some rounds; CPU time, of all processes together, is beside it, since that says about the
same on a busy machine. Below stands what no bench can do without: a Python that loads the libraries. Checked on the
way: the changed line is what was computed, and what did not change was not computed again.

An older checkout is timed beside this one, with the same libraries and step by step in turns:
`git worktree add ../before v0.1.0`, then `--beside ../before`. FOLDER takes the figures as loop.json.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

ROUNDS = 3
HERE = Path(__file__).resolve().parents[2]
BENCH = [sys.executable, "-c", "import sys; from ipe_bench.cli.main import main; sys.exit(main())"]
RUN = ("run", "-m", "error_scale=10,100", "trials=200", "solver=[newton,mine]", "baseline=[linear_lse]", "output=loop")
LIBRARIES = [sys.executable, "-c", "import numpy, scipy.linalg, llvmlite.binding, pyarrow, hydra"]
Seconds = tuple[float, float]
"""By the clock, and of the processors."""


def timed(command: list[str], folder: Path, checkout: Path) -> tuple[Seconds, str]:
    """What a command took with the package of a checkout, and what it printed."""
    began, spent = time.perf_counter(), processor_time()
    done = subprocess.run(command, cwd=folder, env=environment(checkout), capture_output=True, text=True, check=True)
    return (time.perf_counter() - began, processor_time() - spent), done.stdout


def environment(checkout: Path) -> dict[str, str]:
    """In which its package is imported, in place of an installed one."""
    threads = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    return os.environ | threads | {"PYTHONPATH": str(checkout)}


def processor_time() -> float:
    """Of all processes that were started here and have ended."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def change(source: Path, number: int) -> None:
    """Another line in the solver's step: its relaxation."""
    text = re.sub(r"(x = state\.x - )[^\n]*", rf"\g<1>0.9{number} * state.F", source.read_text(encoding="utf-8"))
    source.write_text(text, encoding="utf-8")


def solver(folder: Path, checkout: Path) -> Path:
    """A plugin of one solver in the folder, as `new` makes it, with a line to change."""
    timed([*BENCH, "new", "solver", "mine"], folder, checkout)
    source = folder / "plugins" / "mine" / "ipe_bench_mine" / "mine.py"
    head, sep, _ = source.read_text(encoding="utf-8").partition("    def step(")
    assert sep, "the template has no step any more"
    step = "    def step(self, system, state):\n        x = state.x - state.F\n        return State(x, system.F(x))\n"
    source.write_text(
        f"from ipe_bench.solvers import State\n{head.replace('from __future__ import annotations', '')}{step}"
    )
    return source


def computed(folder: Path) -> set[str]:
    return {path.name for path in (folder / "loop" / "trials").glob("*.parquet")}


def steps(checkout: Path, folder: Path) -> Iterator[tuple[str, Seconds]]:
    """The steps of the loop with the package of a checkout, in an empty folder; most come several times."""
    source = solver(folder, checkout)
    yield "the first run", timed([*BENCH, *RUN], folder, checkout)[0]
    before = computed(folder)
    for number in range(ROUNDS):
        change(source, number)
        seconds, shown = timed([*BENCH, *RUN], folder, checkout)
        new, before = computed(folder) - before, computed(folder)
        assert len(new) == 2, f"a changed line computes its own two cells again, and not {len(new)}"
        assert sum("mine" in line.split() for line in shown.splitlines()) == 2
        yield "a changed line, run, table", seconds
    for step, command in (
        ("the same again", [*BENCH, *RUN]),
        ("the table alone (report)", [*BENCH, "report", "loop"]),
        ("loading the libraries", LIBRARIES),
    ):
        for _ in range(ROUNDS):
            yield step, timed(command, folder, checkout)[0]


def measure(checkouts: Mapping[str, Path]) -> dict[str, dict[str, Seconds]]:
    """By checkout and step, the least seconds: all checkouts take a step before any takes the next."""
    times: dict[str, dict[str, Seconds]] = {name: {} for name in checkouts}
    with contextlib.ExitStack() as stack:
        folders = [stack.enter_context(tempfile.TemporaryDirectory(prefix="ipe-bench-loop-")) for _ in checkouts]
        loops = [steps(c, Path(folder)) for c, folder in zip(checkouts.values(), folders, strict=True)]
        for taken in zip(*loops, strict=True):
            for least, (step, seconds) in zip(times.values(), taken, strict=True):
                least[step] = min(seconds, least.get(step, seconds))
    return times


def main(words: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="Times the loop of changing a solver, running it and seeing a table.")
    parser.add_argument("folder", nargs="?", type=Path, help="takes the figures as loop.json")
    parser.add_argument("--beside", metavar="CHECKOUT", type=Path, help="an older checkout, timed in turns with this")
    given = parser.parse_args(words)
    if given.beside is not None and not (given.beside / "ipe_bench").is_dir():
        parser.error(f"--beside {given.beside}: holds no package ipe_bench; name a checkout")
    found = measure({"now": HERE} | ({"before": given.beside.resolve()} if given.beside else {}))
    for step in found["now"]:
        print("  ".join(f"{name} {s[step][0]:6.2f} s, {s[step][1]:6.2f} s of CPU" for name, s in found.items()), step)
    if given.folder is not None:
        given.folder.mkdir(parents=True, exist_ok=True)
        (given.folder / "loop.json").write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
