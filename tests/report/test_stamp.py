"""What a command does not need it does not do: a report that is there stays, and heavy libraries wait for their use."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from ipe_bench.cli.main import main
from ipe_bench.runs.columns import as_array

HEAVY = ("numba", "pandas", "scipy.stats", "scipy.integrate", "matplotlib", "seaborn", "jinja2")
COMMAND = """
import json, sys
from ipe_bench.cli.main import main
names = json.loads(sys.argv[1])
code = main(sys.argv[2:])
print(json.dumps([code, [name for name in names if name in sys.modules]]))
"""


def run(folder: Path, *more: str) -> int:
    return main(["run", "measurement=polynomial", "noise=gaussian", "trials=4", f"output={folder}", *more])


def written(folder: Path) -> dict[str, int]:
    files = [folder / "report.html", folder / "summary.csv", *folder.glob("tables/*"), *folder.glob("figures/*.*")]
    return {str(path.relative_to(folder)): path.stat().st_mtime_ns for path in files}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stamp") / "out"
    assert run(folder) == 0
    return folder


def test_a_run_with_nothing_to_do_leaves_everything_as_it_is(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before, records = written(folder), sorted(folder.glob("runs/*.json"))
    assert run(folder) == 0
    assert written(folder) == before
    assert sorted(folder.glob("runs/*.json")) == records
    assert "polynomial, gaussian: 4 trials per row" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["summary.csv", "tables/summary.md", "report.html"])
def test_a_file_of_the_report_that_was_touched_is_made_again(folder: Path, name: str) -> None:
    path = next(folder.glob(name), None) or next(folder.glob("tables/*.md"))
    text = path.read_text(encoding="utf-8")
    path.write_text(text + " ", encoding="utf-8")
    assert run(folder) == 0
    assert path.read_text(encoding="utf-8") == text


def test_more_trials_make_another_report(folder: Path) -> None:
    before = (folder / "summary.csv").read_text(encoding="utf-8")
    assert run(folder, "trials=6") == 0
    assert (folder / "summary.csv").read_text(encoding="utf-8") != before
    assert run(folder, "trials=6") == 0


def test_a_damaged_file_is_named_however_often_the_report_was_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(tmp_path) == 0
    (tmp_path / "trials" / "0123456789abcdef-0-4.parquet").write_bytes(b"nothing")
    for _ in range(2):
        assert main(["report", str(tmp_path)]) == 1
        assert "0123456789abcdef-0-4.parquet" in capsys.readouterr().err


def test_nothing_heavy_is_loaded_where_nothing_is_to_be_done(tmp_path: Path) -> None:
    words = ["run", "trials=1", f"output={tmp_path}"]
    for loaded in (None, []):
        command = [sys.executable, "-c", COMMAND, json.dumps(HEAVY), *words]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        code, found = json.loads(done.stdout.splitlines()[-1])
        assert code == 0
        assert loaded is None or found == loaded


@pytest.mark.parametrize("cut", [slice(None), slice(3, 11), slice(0, 0)])
def test_columns_are_read_as_arrow_reads_them(tmp_path: Path, cut: slice) -> None:
    rng = np.random.default_rng(1)
    columns = {
        "number": pa.array(rng.normal(size=20)),
        "count": pa.array(np.arange(20)),
        "small": pa.array(np.arange(20, dtype=np.int8)),
        "flag": pa.array(rng.random(20) < 0.5),
        "text": pa.array([f"trial {i}" for i in range(20)]),
        "gaps": pa.array([None if i % 3 == 0 else float(i) for i in range(20)]),
        "rare": pa.array([None if i % 3 == 0 else str(i) for i in range(20)]),
    }
    table = pa.table(columns)
    path = tmp_path / "columns.parquet"
    pq.write_table(table, path)
    read = pq.read_table(path).slice(cut.start or 0, len(range(20)[cut]))
    joined = pa.concat_tables([read, read])
    for name in columns:
        for part in (read, joined):
            expected, found = part[name].to_numpy(), as_array(part[name])
            assert len(expected) == len(found)
            if len(expected):
                assert found.dtype == expected.dtype
                np.testing.assert_array_equal(found, expected)
