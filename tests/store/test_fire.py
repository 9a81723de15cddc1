"""Trial by fire: writers that are killed, two at once on an older folder, and a reader meanwhile.

python tests/store/test_fire.py [KILLS] [OLDER_FOLDER]     prints what came of it
"""

from __future__ import annotations

import multiprocessing
import random
import shutil
import sys
import tempfile
import time
from dataclasses import dataclass, field
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
    assert (
        compute(scenarios, {"newton": ib.solvers.Newton(), "linear": ib.baselines.LinearLSE()}, trials, folder, **more)
        == ()
    )


def write(folder: Path, trials: int, told: Any) -> None:
    """A run that tells what it has stored: how many estimates; then that only merging is left, and that it ended."""

    def watch(progress: Any) -> None:
        told.send(progress.trials)
        if progress.done == progress.tasks:
            told.send(MERGING)

    run(folder, trials, block_size=BLOCK, watch=watch)
    told.send(ENDED)


def rows_of(folder: Path) -> tuple[Rows, list[str]]:
    """All rows by key; and everything that is wrong, but for what is not computed yet."""
    results = Results.read([folder])
    found = {key: results.load(cell, None) for key, cell in results.stored.items()}
    wrong = [line for line in results.problems if not line.startswith("missing: ") or "went away" in line]
    return found, [line for line in wrong if "older version" not in line and "holds no results" not in line]


def faults(found: Rows, expected: Rows) -> list[str]:
    """What is not as in a run that nobody disturbed."""
    wrong = [f"{key}: a trial stands there twice" for key, rows in found.items() if (np.diff(rows["trial"]) < 1).any()]
    for key, rows in found.items():
        for name in rows.keys() - {"time_s"}:
            right, real = expected[key][name][rows["trial"]], rows[name].dtype.kind == "f"
            wrong += [] if np.array_equal(rows[name], right, equal_nan=real) else [f"{key}: other numbers in {name}"]
    return wrong


def read(folder: Path, expected: Rows, told: Any) -> None:
    """Reads all rows again and again, and tells what is wrong with them."""
    while True:
        found, wrong = rows_of(folder)
        told.send(wrong + faults(found, expected))


@dataclass
class Fire:
    """What was done, and what came of it."""

    kills: int = 0
    in_mid_run: int = 0
    while_merging: int = 0
    reads: int = 0
    lost: int = 0
    """Trials that were there before, or that a writer had said were stored, and that were gone."""
    wrong: list[str] = field(default_factory=list)


def burn(folder: Path, kills: int, seed: int = 0) -> Fire:
    """Starts two writers on more and more trials, and kills one or both of them at any moment."""
    context, fire, dice, trials = multiprocessing.get_context("forkserver"), Fire(), random.Random(seed), 0
    context.set_forkserver_preload(
        ["ipe_bench.runs.run", "ipe_bench.solvers", "ipe_bench.baselines", "pyarrow.parquet"]
    )
    with tempfile.TemporaryDirectory() as place:
        run(place, MORE * (kills + 1))
        expected, _ = rows_of(Path(place))

    def start(function: Any, *arguments: Any) -> Any:
        here, there = context.Pipe(duplex=False)
        process = context.Process(target=function, args=(*arguments, there), daemon=True)
        process.start()
        there.close()
        return process, here

    def told_by(connection: Any) -> list[Any]:
        told = []
        try:
            while connection.poll():
                told.append(connection.recv())
        except EOFError:
            pass
        return told

    reader, news = start(read, folder, expected)
    before: Rows = {}
    while fire.kills < kills:
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
            fire.kills += 1
            fire.in_mid_run += process.is_alive()
            process.kill()
        for (process, connection), lines in zip(writers, said, strict=True):
            process.join()
            lines += told_by(connection)
            if (process, connection) in dying:
                fire.while_merging += MERGING in lines and ENDED not in lines
            elif ENDED not in lines:
                fire.wrong.append("a writer that was not killed did not come to its end")
        found, wrong = rows_of(folder)
        fire.wrong += wrong + faults(found, expected)
        of_estimates = [sum(len(rows["trial"]) for rows in of.values() if "status" in rows) for of in (before, found)]
        fire.lost += max(0, of_estimates[0] + max(max(lines, default=0) for lines in said) - of_estimates[1])
        fire.lost += sum(max(0, len(rows["trial"]) - len(found[key]["trial"])) for key, rows in before.items())
        before = found
        for wrong in told_by(news):
            fire.reads += 1
            fire.wrong += wrong
    run(folder, trials)
    reader.kill()
    found, wrong = rows_of(folder)
    fire.wrong += wrong + faults(found, expected)
    fire.wrong += [f"{key}: not whole" for key, rows in found.items() if len(rows["trial"]) != trials]
    ours = sorted(path.name for path in (folder / "trials").glob("*.parquet") if path.name[:16] in found)
    fire.wrong += [] if ours == [f"{key}-0-{trials}.parquet" for key in sorted(found)] else [f"left: {ours}"]
    fire.wrong += [] if len(found) == RESULTS else [f"{len(found)} of {RESULTS} results"]
    return fire


@pytest.mark.skipif(sys.platform == "win32", reason="has no forkserver")
@pytest.mark.parametrize(
    "kills", [pytest.param(4, marks=pytest.mark.slow), pytest.param(40, marks=pytest.mark.campaign)]
)
def test_kills_of_two_writers_on_an_older_folder_change_nothing_and_lose_nothing(tmp_path, kills):
    old = tmp_path / "trials" / f"{'0' * 16}-0-250.parquet"
    old.parent.mkdir()
    old.write_bytes(b'PAR1 {"schema":2,"key":"f"} ' + (28).to_bytes(4, "little") + b"PAR1")
    fire = burn(tmp_path, kills)
    assert (fire.lost, fire.wrong) == (0, [])
    assert fire.in_mid_run > kills / 4
    assert fire.reads > kills
    assert old.exists()


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        if sys.argv[2:]:
            shutil.copytree(sys.argv[2], place, dirs_exist_ok=True)
        print(burn(Path(place), int(sys.argv[1]) if sys.argv[1:] else 40))
        print("stale:", Results.read([place]).stale)
