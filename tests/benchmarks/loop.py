"""The loop that a researcher lives in, timed as whole commands: change a line of a solver, run 200 trials at two error
scales, see the table.

    python tests/benchmarks/loop.py [FOLDER]

Each figure is the least of some rounds; CPU time, of all processes together, is beside it, since that says about the
same on a busy machine. Below stands what no bench can do without: a Python that loads the libraries. Checked on the
way: the changed line is what was computed, and what did not change was not computed again.
"""

from __future__ import annotations

import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROUNDS = 3
BENCH = [sys.executable, "-c", "import sys; from ipe_bench.cli.main import main; sys.exit(main())"]
RUN = ("run", "-m", "error_scale=10,100", "trials=200", "solver=[newton,mine]", "baseline=[linear_lse]", "output=loop")
LIBRARIES = [sys.executable, "-c", "import numpy, scipy.linalg, numba, pyarrow, hydra"]


Seconds = tuple[float, float]
"""By the clock, and of the processors."""


def timed(command: list[str], folder: Path) -> tuple[Seconds, str]:
    """What a command took, and what it printed."""
    began, spent = time.perf_counter(), processor_time()
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    return (time.perf_counter() - began, processor_time() - spent), done.stdout


def processor_time() -> float:
    """Of all processes that were started here and have ended."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def change(source: Path, number: int) -> None:
    """Another line in the solver's step: its relaxation."""
    text = re.sub(r"(x = state\.x - )[^\n]*", rf"\g<1>0.9{number} * state.F", source.read_text(encoding="utf-8"))
    source.write_text(text, encoding="utf-8")


def solver(folder: Path) -> Path:
    """A plugin of one solver in the folder, as `new` makes it, with a line to change."""
    subprocess.run([*BENCH, "new", "solver", "mine"], cwd=folder, capture_output=True, check=True)
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


def main(folder: Path) -> dict[str, Seconds]:
    """The seconds of each step of the loop."""
    source = solver(folder)
    times: dict[str, Seconds] = {}
    times["the first run"], _ = timed([*BENCH, *RUN], folder)
    after, before = [], computed(folder)
    for number in range(ROUNDS):
        change(source, number)
        seconds, shown = timed([*BENCH, *RUN], folder)
        after.append(seconds)
        new, before = computed(folder) - before, computed(folder)
        assert len(new) == 2, f"a changed line computes its own two cells again, and not {len(new)}"
        assert sum("mine" in line.split() for line in shown.splitlines()) == 2
    times["a changed line, run, table"] = min(after)
    for step, command in (
        ("the same again", [*BENCH, *RUN]),
        ("the table alone (report)", [*BENCH, "report", "loop"]),
        ("loading the libraries", LIBRARIES),
    ):
        times[step] = min(timed(command, folder)[0] for _ in range(ROUNDS))
    return times


if __name__ == "__main__":
    os.environ |= {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory(prefix="ipe-bench-loop-") as place:
        found = main(Path(place))
    for step, seconds in found.items():
        print(f"{seconds[0]:6.2f} s, {seconds[1]:6.2f} s of processors  {step}")
    if len(sys.argv) > 1:
        Path(sys.argv[1], "loop.json").write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
