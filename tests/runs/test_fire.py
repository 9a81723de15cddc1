"""Trial by fire: writers that are killed, two at once on an older folder, and a reader
meanwhile."""

from __future__ import annotations

import multiprocessing
import random
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ipe_bench as ib
from ipe_bench.runs.results import Results
from ipe_bench.runs.run import compute

BLOCK, MORE = 20, 200
MERGING, ENDED = -1, -2
RESULTS = 6
"""Two scenarios under two estimators, and their truths."""

Rows = dict[str, dict[str, np.ndarray]]


def run(folder: str | Path, trials: int, **more: Any) -> None:
    model, noise = ib.measurements.Polynomial(), ib.noise.Gaussian(0.01)
    scenarios = [ib.Scenario(model, noise, error_scale=scale) for scale in (1.0, 3.0)]
    estimators = {"newton": ib.solvers.Newton(), "linear": ib.baselines.LinearLSE()}
    assert compute(scenarios, estimators, trials, folder, **more) == ()


def write(folder: Path, trials: int, told: Any) -> None:
    """A run that tells what it has stored: how many estimates; then that only merging is left, and
    that it ended."""

    def watch(progress: Any) -> None:
        told.send(progress.trials)
        if progress.done == progress.tasks:
            told.send(MERGING)

    run(folder, trials, block_size=BLOCK, watch=watch)
    told.send(ENDED)


def rows_and_faults(folder: Path, expected: Rows) -> tuple[Rows, list[str]]:
    """All rows by key; and everything that is not as in a run that nobody disturbed, but for what
    is not computed."""
    results = Results.read([folder])
    found = {key: results.load(cell, None) for key, cell in results.stored.items()}
    wrong = [
        line for line in results.problems if not line.startswith("missing: ") or "went away" in line
    ]
    wrong = [
        line for line in wrong if "older version" not in line and "holds no results" not in line
    ]
    for key, rows in found.items():
        wrong += (
            [f"{key}: a trial stands there twice"] if (np.diff(rows["trial"]) < 1).any() else []
        )
        for name in rows.keys() - {"time_s"}:
            right, real = expected[key][name][rows["trial"]], rows[name].dtype.kind == "f"
            wrong += (
                []
                if np.array_equal(rows[name], right, equal_nan=real)
                else [f"{key}: other numbers in {name}"]
            )
    return found, wrong


def read(folder: Path, expected: Rows, told: Any) -> None:
    """Reads all rows again and again, and tells what is wrong with them."""
    while True:
        told.send(rows_and_faults(folder, expected)[1])


def told_by(connection: Any) -> list[Any]:
    told = []
    try:
        while connection.poll():
            told.append(connection.recv())
    except EOFError:
        pass
    return told


@pytest.mark.skipif(sys.platform == "win32", reason="has no forkserver")
@pytest.mark.parametrize(
    "kills", [pytest.param(4, marks=pytest.mark.slow), pytest.param(40, marks=pytest.mark.campaign)]
)
def test_kills_of_two_writers_on_an_older_folder_change_nothing_and_lose_nothing(tmp_path, kills):
    """Two writers on more and more trials, of which one or both are killed at any moment, while
    somebody reads."""
    context, dice = multiprocessing.get_context("forkserver"), random.Random(0)
    context.set_forkserver_preload(
        ["ipe_bench.runs.run", "ipe_bench.solvers", "ipe_bench.baselines", "pyarrow.parquet"]
    )
    run(tmp_path / "undisturbed", MORE * (kills + 1))
    undisturbed = Results.read([tmp_path / "undisturbed"])
    expected = {key: undisturbed.load(cell, None) for key, cell in undisturbed.stored.items()}
    folder = tmp_path / "results"
    old = folder / "trials" / f"{'0' * 16}-0-250.parquet"
    old.parent.mkdir(parents=True)
    old.write_bytes(b'PAR1 {"schema":2,"key":"f"} ' + (28).to_bytes(4, "little") + b"PAR1")

    def start(function: Any, *arguments: Any) -> Any:
        here, there = context.Pipe(duplex=False)
        process = context.Process(target=function, args=(*arguments, there), daemon=True)
        process.start()
        there.close()
        return process, here

    reader, news = start(read, folder, expected)
    before: Rows = {}
    killed = in_mid_run = trials = reads = 0
    while killed < kills:
        trials += MORE
        writers = [start(write, folder, trials) for _ in range(2)]
        said = [[writers[0][1].recv()], []]
        if dice.random() < 0.4:
            while not {MERGING, ENDED} & set(said[0]):
                said[0].append(writers[0][1].recv())
            time.sleep(dice.uniform(0.0, 0.2))
        else:
            time.sleep(dice.uniform(0.0, dice.choice((0.3, 1.0, 4.0))))
        dying = writers[: dice.choice((1, 2))]
        for process, _ in dying:
            killed += 1
            in_mid_run += process.is_alive()
            process.kill()
        for (process, connection), lines in zip(writers, said, strict=True):
            process.join()
            lines += told_by(connection)
            assert (process, connection) in dying or ENDED in lines
        found, wrong = rows_and_faults(folder, expected)
        assert wrong == []
        # Nothing that was there before, or that a writer had said was stored, is gone.
        counts = [
            sum(len(rows["trial"]) for rows in of.values() if "status" in rows)
            for of in (before, found)
        ]
        assert counts[1] >= counts[0] + max(max(lines, default=0) for lines in said)
        assert all(len(found[key]["trial"]) >= len(rows["trial"]) for key, rows in before.items())
        before = found
        for wrong in told_by(news):
            reads += 1
            assert wrong == []
    run(folder, trials)
    reader.kill()
    found, wrong = rows_and_faults(folder, expected)
    assert (wrong, len(found)) == ([], RESULTS)
    assert all(len(rows["trial"]) == trials for rows in found.values())
    ours = sorted(
        path.name for path in (folder / "trials").glob("*.parquet") if path.name[:16] in found
    )
    assert ours == [f"{key}-0-{trials}.parquet" for key in sorted(found)]
    assert in_mid_run > kills / 4
    assert reads > kills
    assert old.exists()
