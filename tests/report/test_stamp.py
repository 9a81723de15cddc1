"""What a command does not need it does not do: a report that is there stays, and heavy libraries wait for their use."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from ipe_bench.cli.main import main
from ipe_bench.report import figures
from ipe_bench.report.helper import Helper
from ipe_bench.report.stamp import NAME
from ipe_bench.runs.columns import as_array

HEAVY = ("numba", "pandas", "scipy", "matplotlib", "seaborn", "jinja2", "asyncio", "ipe_bench.statistics.records")
COMMAND = """
import json, sys
from ipe_bench.cli.main import main
names = json.loads(sys.argv[1])
code = main(sys.argv[2:])
print(json.dumps([code, [name for name in names if name in sys.modules]]))
"""


def run(folder: Path, *more: str) -> int:
    words = ["run", "measurement=polynomial", "noise=gaussian", "trials=4", "figures=none"]
    return main([*words, f"output={folder}", *more])


def written(folder: Path) -> dict[str, int]:
    files = [folder / "report.html", folder / "summary.csv", *folder.glob("tables/*"), *folder.glob("figures/*.*")]
    return {str(path.relative_to(folder)): path.stat().st_mtime_ns for path in files}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stamp") / "out"
    assert run(folder, "figures=main") == 0
    return folder


def test_a_run_with_nothing_to_do_leaves_everything_as_it_is(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before, records = written(folder), sorted(folder.glob("runs/*.json"))
    assert run(folder, "figures=main") == 0
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


def test_what_is_shown_again_is_what_was_shown(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    printed = []
    for _ in range(3):
        assert run(folder, "estimators.fixed_point.max_iterations=7") == 0
        printed.append(capsys.readouterr().out)
    assert printed[0] == printed[1] == printed[2]
    assert "Here too" in printed[0]
    # Of the same folder, another command and another width show something else.
    for words in (["solver=[newton]"], ["solver=[newton]"]):
        assert run(folder, *words) == 0
        assert "newton" in (shown := capsys.readouterr().out)
        assert shown not in printed
    assert main(["report", str(folder), "figures=none"]) == 0
    assert "max_iterations" in capsys.readouterr().out


def test_what_was_shown_is_not_shown_of_a_report_that_has_changed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path
    assert run(folder) == 0
    shown = capsys.readouterr().out
    stamp = json.loads((folder / NAME).read_text())
    stamp["shown"] = {view: ["a table that nobody printed\n", more] for view, (_, more) in stamp["shown"].items()}
    (folder / NAME).write_text(json.dumps(stamp))
    assert run(folder) == 0
    assert "a table that nobody printed" in capsys.readouterr().out  # it is the stamp that is read
    next(folder.glob("trials/*.parquet")).unlink()
    assert run(folder) == 0
    again = capsys.readouterr().out
    assert "a table that nobody printed" not in again
    assert [line.split()[:6] for line in again.splitlines()] == [line.split()[:6] for line in shown.splitlines()]


def test_figures_are_all_the_main_ones_or_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(figures, "FIGURES", ("success", "cost"))
    drawn = {}
    for which in ("none", "main"):
        assert run(tmp_path, f"figures={which}") == 0
        drawn[which] = {path.stem for path in tmp_path.glob("figures/*.png")}
        page = (tmp_path / "report.html").read_text(encoding="utf-8")
        assert page.count("<img") == len(drawn[which])
    assert drawn["none"] == set()
    assert drawn["main"] == {"success_against_scale"}
    assert main(["report", str(tmp_path), "figures=none"]) == 0
    assert "<img" not in (tmp_path / "report.html").read_text(encoding="utf-8")
    capsys.readouterr()
    assert main(["report", str(tmp_path), "figures=some"]) == 2
    assert "figures=some: choose all, main or none" in capsys.readouterr().err


def test_files_in_other_formats_come_when_they_are_asked_for_and_are_named_while_they_are_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(figures, "FIGURES", ("success", "cost"))

    def links() -> set[str]:
        return set(re.findall(r'href="figures/([^"]+)"', (tmp_path / "report.html").read_text(encoding="utf-8")))

    def kinds() -> set[str]:
        return {path.suffix for path in tmp_path.glob("figures/*.*")} - {".json"}

    assert run(tmp_path, "figures=all") == 0
    assert kinds() == {".png"}
    first = written(tmp_path)
    # Two formats are no sweep, and the pictures that are there stay as they are.
    assert run(tmp_path, "figures=all", "formats=pdf,svg") == 0
    assert kinds() == {".png", ".pdf", ".svg"}
    assert "multirun" not in "".join(path.name for path in tmp_path.iterdir())
    after = written(tmp_path)
    assert all(after[name] == time for name, time in first.items() if name.endswith(".png"))
    assert links() == {path.name for path in tmp_path.glob("figures/*.*")} - {"index.json"}
    # What has more formats than are asked for is what is asked for.
    for formats in ("formats=pdf", "formats=[svg,png]", "formats=png"):
        assert run(tmp_path, "figures=all", formats) == 0
        assert written(tmp_path) == after
    # A file that is gone is drawn where it is asked for, and not spoken of where it is not.
    (tmp_path / "figures" / "cost_against_accuracy.pdf").unlink()
    assert run(tmp_path, "figures=all") == 0
    assert "cost_against_accuracy.pdf" not in links()
    assert "success_against_scale.pdf" in links()
    assert main(["report", str(tmp_path), "figures=all", "formats=png,pdf"]) == 0
    assert "cost_against_accuracy.pdf" in links()
    assert (tmp_path / "figures" / "cost_against_accuracy.pdf").exists()
    # Other data: what nobody asks for any more is not there any more.
    assert run(tmp_path, "figures=all", "trials=5") == 0
    assert kinds() == {".png"}
    assert {name.rpartition(".")[2] for name in links()} == {"png"}
    capsys.readouterr()
    assert main(["report", str(tmp_path), "formats=pdf,tiff"]) == 2
    assert "formats=pdf,tiff: choose among png, pdf and svg" in capsys.readouterr().err


def test_a_second_process_is_there_early_and_only_where_something_is_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[bool] = []

    def noted(helper: Helper) -> None:
        started.append(any(tmp_path.glob("trials/*")))

    monkeypatch.setattr(Helper, "start", noted)
    monkeypatch.setattr(figures, "FIGURES", ("success",))
    assert run(tmp_path, "figures=all") == 0
    # Before anything is stored where nothing is, and at any rate before it is drawn.
    assert started[0] is False
    started.clear()
    assert run(tmp_path, "figures=all") == 0
    assert run(tmp_path, "trials=6") == 0
    assert run(tmp_path, "trials=6") == 0
    assert main(["report", str(tmp_path), "figures=none"]) == 0
    assert main(["run", "measurement=polynomial", "--dry-run", f"output={tmp_path / 'other'}"]) == 0
    assert started == []
    assert run(tmp_path, "trials=8", "figures=all") == 0
    assert started


def test_a_damaged_file_is_named_however_often_the_report_was_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(tmp_path, "figures=none") == 0
    (tmp_path / "trials" / "0123456789abcdef-0-4.parquet").write_bytes(b"nothing")
    for _ in range(2):
        assert main(["report", str(tmp_path), "figures=none"]) == 1
        assert "0123456789abcdef-0-4.parquet" in capsys.readouterr().err


def test_nothing_heavy_is_loaded_where_nothing_is_to_be_done(tmp_path: Path) -> None:
    words = ["run", "trials=1", "figures=none", f"output={tmp_path}"]
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
