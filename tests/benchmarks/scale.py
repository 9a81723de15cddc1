"""A million trials of two estimators with their report, as a user runs them: time, memory of every
process, and disk.

`SCALE` in the environment is another number of trials. A tenth of it is run first: what is flat is
the same for both.
"""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

TRIALS = int(os.environ.get("SCALE", "1000000"))
WORKERS = 2
BENCH = [sys.executable, "-m", "ipe_bench"]
RUN = (
    "run",
    "solver=[fixed_point]",
    "baseline=[linear_lse]",
    "error_scale=10",
    "execution=processes",
)
_LOOK_S = 0.2
_MB = 1e6


@dataclass(frozen=True)
class Usage:
    """What a command and the processes that it started took."""

    wall_s: float
    cpu_s: float
    own_mb: float
    """Most resident memory of the command itself."""
    others_mb: float
    """Of the largest process that it started."""
    together_mb: float
    """Of all of them at one time."""


def used(command: list[str]) -> Usage:
    """Runs a command to its end. Memory is looked at five times a second, on Linux."""
    import resource

    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    own = others = together = 0.0
    environment = {
        k: v
        for k, v in os.environ.items()
        if k not in ("PYTHONDONTWRITEBYTECODE", "IPE_BENCH_THREADS")
    }
    with subprocess.Popen(
        command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as process:
        while process.poll() is None:
            first, *rest = [_resident_mb(pid) for pid in _family(process.pid)]
            own, others, together = (
                max(own, first),
                max([others, *rest]),
                max(together, first + sum(rest)),
            )
            time.sleep(_LOOK_S)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command)
    wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Usage(wall, cpu, own, others, together)


def _family(pid: int) -> Iterator[int]:
    yield pid
    for path in Path(f"/proc/{pid}/task").glob("*/children"):
        try:
            children = path.read_text().split()
        except OSError:
            continue
        for child in children:
            yield from _family(int(child))


def _resident_mb(pid: int) -> float:
    try:
        return (
            int(Path(f"/proc/{pid}/statm").read_text().split()[1])
            * os.sysconf("SC_PAGE_SIZE")
            / _MB
        )
    except OSError:
        return 0.0


@dataclass(frozen=True)
class Measured:
    trials: int
    run: Usage
    """The command `run`, with its report and all figures."""
    report: Usage
    """The command `report` on what it stored."""
    bytes_stored: int
    files: int


def measured(trials: int) -> Measured:
    with tempfile.TemporaryDirectory(prefix="ipe-bench-") as folder:
        output = Path(folder) / "out"
        run = used(
            [*BENCH, *RUN, f"execution.workers={WORKERS}", f"trials={trials}", f"output={output}"]
        )
        report = used([*BENCH, "report", str(output), f"output={folder}/again"])
        sizes = [path.stat().st_size for path in (output / "trials").iterdir()]
    return Measured(trials, run, report, sum(sizes), len(sizes))
