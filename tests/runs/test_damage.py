"""Whatever is done to stored files, no number changes: what is damaged is named, left out, and
computed again."""

import json
import os
import random
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pandas as pd
import pyarrow.parquet as pq
import pytest
from shared.families import slow_if
from shared.small_models import Bent

import ipe_bench as ib
from ipe_bench import Scenario
from ipe_bench.baselines import LinearLSE
from ipe_bench.basics.errors import StorageError
from ipe_bench.cli.main import main
from ipe_bench.cli.results import report_command as report
from ipe_bench.cli.results import status_command as status
from ipe_bench.estimators.base import Estimator
from ipe_bench.noise import Gaussian
from ipe_bench.runs import parts
from ipe_bench.runs.results import Results
from ipe_bench.runs.run import compute
from ipe_bench.runs.store import Store
from ipe_bench.solvers import Newton
from ipe_bench.statistics import summarize
from ipe_bench.statistics.registry import add_statistics

SCENARIOS = [Scenario(Bent(0.02), Gaussian(0.1), seed=seed) for seed in (0, 1)]
KINDS = ("trials", "runs", "failed")


@dataclass(frozen=True)
class Fails(Estimator):
    """Loses every block, so that there are records of failures."""

    def estimate(self, problem, z, *, history=False):
        raise MemoryError("too large")


def run(folder: Path) -> None:
    compute(
        SCENARIOS,
        {"newton": Newton(), "linear_lse": LinearLSE(), "fails": Fails()},
        20,
        folder,
        block_size=10,
    )


def summary(folder: Path) -> pd.DataFrame:
    add_statistics([])  # those of plugins in the working folder, which a report takes up
    return summarize([folder]).drop(columns="time_mean_s")


def said(folder: Path) -> list[str]:
    """What is said of a folder, wherever it lies."""
    return [line.replace(str(folder), "DIR") for line in Results.read([folder]).problems]


@pytest.fixture(scope="module")
def clean(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("clean") / "results"
    run(folder)
    run(folder)  # two records of runs, so that they can be swapped
    return folder


@pytest.fixture(scope="module")
def expected(clean) -> tuple[pd.DataFrame, list[str]]:
    return summary(clean), said(clean)


@pytest.fixture
def folder(clean, tmp_path) -> Path:
    return Path(shutil.copytree(clean, tmp_path / "results"))


def truncate(path: Path, rng: random.Random) -> None:
    os.truncate(path, rng.randrange(path.stat().st_size))


def swap(path: Path, rng: random.Random) -> None:
    other = rng.choice([p for p in path.parent.iterdir() if p != path and p.suffix == path.suffix])
    first, second = path.read_bytes(), other.read_bytes()
    path.write_bytes(second)
    other.write_bytes(first)


def zeros(path: Path, rng: random.Random) -> None:
    content = bytearray(path.read_bytes())
    at = rng.randrange(8, len(content) - 400)
    content[at : at + 400] = bytes(400)
    path.write_bytes(content)


def other_text(path: Path, rng: random.Random) -> None:
    texts = ["", "null", "{}", "[]", '{"cells": 3}', "[" * 100_000, "PAR1PAR1", "\x00", "\ufeff{}"]
    path.write_text(rng.choice(texts), encoding="utf-8")


def directory(path: Path, rng: random.Random) -> None:
    path.unlink()
    path.mkdir()
    (path / "x").touch()


def pipe(path: Path, rng: random.Random) -> None:
    path.unlink()
    os.mkfifo(path)


def without_a_key(path: Path, rng: random.Random) -> None:
    """As a whole record that says less."""
    if path.suffix != ".json":
        return truncate(path, rng)
    record = json.loads(path.read_text())
    del record[
        rng.choice(
            sorted({"key", "start", "message", "cells", "started", "trials"} & record.keys())
        )
    ]
    parts.write_record(
        path, {name: value for name, value in record.items() if name not in ("digest", "schema")}
    )


Harm = Callable[[Path, random.Random], None]
HARMS: tuple[Harm, ...] = (truncate, swap, zeros, other_text, directory, pipe, without_a_key)
SEEDS = [0, *(pytest.param(seed, marks=pytest.mark.campaign) for seed in range(1, 8))]


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", slow_if(lambda kind: kind != KINDS[0], KINDS))
@pytest.mark.parametrize("harm", HARMS, ids=lambda harm: harm.__name__)
def test_whatever_is_done_to_a_file_is_named_and_healed(folder, expected, kind, harm, seed):
    """Or changed nothing that is read; the next run makes the folder whole."""
    rng = random.Random(seed)
    path = rng.choice(sorted((folder / kind).iterdir()))
    harm(path, rng)
    table, problems = expected
    named = [line for line in Results.read([folder]).problems if str(path) in line]
    assert all("\n" not in line for line in named)
    if not named:
        pd.testing.assert_frame_equal(summary(folder), table)
    run(folder)
    assert said(folder) == problems
    pd.testing.assert_frame_equal(summary(folder), table)


def test_a_run_says_what_it_sets_aside_and_computes_again(folder, caplog):
    path = sorted((folder / "trials").iterdir())[0]
    os.truncate(path, 10)
    run(folder)
    (line,) = [line for line in caplog.messages if str(path) in line]
    (aside,) = (folder / "trials").glob(f"{path.stem}.damaged-*")
    assert line.endswith(f"set aside as {aside.name} and computed again")


@pytest.mark.parametrize(
    "name", ["trials/0123456789abcdef-0-8.parquet", "trials/x.parquet", "failed/x.json"]
)
def test_a_pipe_among_the_results_stops_no_command(folder, expected, capsys, name):
    """Whoever opens one waits until something is written into it."""
    os.mkfifo(folder / name)
    (folder / "runs" / "x.json").symlink_to("/dev/zero")
    pd.testing.assert_frame_equal(summary(folder), expected[0])
    for words in (["status"], ["report", "figures=none"]):
        assert main([words[0], str(folder), *words[1:]]) == 1
        assert "is no regular file" in "".join(capsys.readouterr()).replace("\n", "")


def test_trials_are_read_although_their_failures_cannot_be(folder, expected):
    shutil.rmtree(folder / "failed")
    (folder / "failed").touch()
    pd.testing.assert_frame_equal(summary(folder), expected[0])
    assert any("failed: cannot be listed" in line for line in said(folder))


def between_columns(path: Path) -> set[int]:
    """The bytes that belong to no column: pyarrow 17 repeats there what the footer says, for no
    reader."""
    group = pq.read_metadata(path).row_group(0)
    columns = [group.column(i) for i in range(group.num_columns)]
    starts = [
        c.dictionary_page_offset if c.has_dictionary_page else c.data_page_offset for c in columns
    ]
    ends = [start + c.total_compressed_size for start, c in zip(starts, columns, strict=True)]
    return {
        byte for end, start in zip(ends, starts[1:], strict=False) for byte in range(end, start)
    }


def test_one_bit_in_127_of_a_part_and_in_11_of_a_record_is_told_or_without_effect(tmp_path):
    """Page checksums cover pages and neither their headers nor the footer, which has a digest."""
    compute(SCENARIOS[:1], {"newton": Newton()}, 30, tmp_path)
    (record,) = (tmp_path / "runs").iterdir()

    def whole(part: parts.StoredPart) -> str:
        """As text, in which what is not a number equals itself."""
        footer, table = part.read()
        history = {name: values.tolist() for name, values in (part.history() or {}).items()}
        return repr((footer, table.to_pydict(), history))

    stored = [(part.path, partial(whole, part), 127) for part in Store(tmp_path).parts()]
    assert len(stored) == 2  # the truth and an estimator
    for path, read, step in (*stored, (record, partial(parts.read_record, record, parts.RUN), 11)):
        content, right = path.read_bytes(), read()
        places, told = range(0, 8 * len(content), step), 0
        unread = between_columns(path) if path.suffix == ".parquet" else set()
        for bit in places:
            changed = bytearray(content)
            changed[bit // 8] ^= 1 << bit % 8
            path.write_bytes(changed)
            try:
                assert read() == right
            except parts.Unusable:
                told += 1
        assert told > 0.95 * sum(bit // 8 not in unread for bit in places)


PLACES = ["trials", "runs", "failed", "figures", "tables"]


@pytest.mark.parametrize(
    ("command", "name"),
    [
        ("report", "trials"),
        *(pytest.param("report", name, marks=pytest.mark.slow) for name in PLACES[1:]),
        ("run", "tables"),
        pytest.param("run", "trials", marks=pytest.mark.slow),
        ("status", "runs"),
    ],
)
def test_a_file_where_a_folder_should_be_is_a_line(folder, capfd, name, command):
    path = folder / name
    shutil.rmtree(path, ignore_errors=True)
    path.write_text("a file")
    words = {
        "run": ["run", "measurement=polynomial", "trials=5", f"output={folder}", "execution=serial"]
    }
    drawn = [] if name == "figures" or command == "status" else ["figures=none"]
    code = main([*words.get(command, [command, str(folder)]), *drawn])
    out, err = capfd.readouterr()
    assert "Traceback" not in out + err
    assert code in (1, 2)
    assert str(path) in (out + err).replace("\n", "") or f"output={folder}" in err


def test_report_and_status_say_the_same(folder, capsys):
    for kind in ("trials", "runs"):
        truncate(sorted((folder / kind).iterdir())[0], random.Random(0))
    problems = Results.read([folder]).problems
    assert report([str(folder), "figures=none"]) == 1
    said_by_report = capsys.readouterr().err
    assert status([str(folder)]) == 1
    said_by_status = capsys.readouterr().out
    for line in problems:
        assert line in said_by_report
        assert line in said_by_status


def test_a_folder_that_goes_away_in_mid_run_is_not_filled_anew(tmp_path):
    folder = tmp_path / "results"

    def remove(progress) -> None:
        if progress.done == 2 and folder.exists():
            shutil.rmtree(folder)

    with pytest.raises(StorageError, match="went away"):
        compute(SCENARIOS, {"newton": Newton()}, 20, folder, block_size=2, watch=remove)
    assert not (folder / "trials").exists()


def test_abandoned_temporary_files_go_wherever_they_lie(folder):
    old, young = [], []
    for place in (".", "trials", "runs", "failed", "figures", "tables", "log"):
        (folder / place).mkdir(exist_ok=True)
        for found, age in ((old, 7200), (young, 60)):
            path = folder / place / f".summary.csv.host-1-{age}.tmp"
            path.touch()
            os.utime(path, (time.time() - age,) * 2)
            found.append(path)
    Store(folder).prepare()
    assert not any(path.exists() for path in old)
    assert all(path.exists() for path in young)


def as_of_an_older_version(folder: Path) -> None:
    """With the schema of their time, as files of earlier versions are."""
    for path in (folder / "trials").iterdir():
        path.write_bytes(b'PAR1 {"schema":2,"key":"f"} ' + (28).to_bytes(4, "little") + b"PAR1")
    for path in (folder / "runs").iterdir():
        path.write_text('{"schema": 2, "run": "x"}')


def test_of_an_older_folder_everybody_says_in_a_sentence_what_to_do(folder, capsys):
    as_of_an_older_version(folder)
    sentence = "written by an older version of ipe-bench; run the same command again"
    with pytest.warns(UserWarning, match=sentence):
        assert len(ib.load(folder)) == 0
    assert any(sentence in line for line in ib.status(folder).attrs["problems"])
    for command, said_in in (
        (["status", str(folder)], "out"),
        (["report", str(folder), "figures=none"], "err"),
    ):
        assert main(command) == 1
        assert sentence in getattr(capsys.readouterr(), said_in)


def test_a_run_in_an_older_folder_computes_everything_anew_and_leaves_the_old_files(
    folder, expected
):
    as_of_an_older_version(folder)
    older = {path: path.read_bytes() for path in (folder / "trials").iterdir()}
    for path in list(older):
        path.rename(path.with_name(f"{'0' * 16}{path.name[16:]}"))  # keys changed with the schema
    run(folder)
    assert said(folder) == expected[1]
    pd.testing.assert_frame_equal(summary(folder), expected[0])
    assert any("older version" in line for line in Results.read([folder]).stale)
