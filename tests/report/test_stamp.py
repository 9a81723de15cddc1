"""A report that is there and right stays as it is, and any other is made again."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from ipe_bench.cli.main import main
from ipe_bench.report import figures


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


def test_figures_are_all_the_main_ones_or_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(figures, "FIGURES", ("costs", "parameters"))
    drawn = {}
    for which in ("none", "main"):
        assert run(tmp_path, f"figures={which}") == 0
        drawn[which] = {path.stem for path in tmp_path.glob("figures/*.png")}
        page = (tmp_path / "report.html").read_text(encoding="utf-8")
        assert page.count("<img") == len(drawn[which])
    assert drawn["none"] == set()
    assert drawn["main"] == {"cost_against_accuracy"}
    assert main(["report", str(tmp_path), "figures=none"]) == 0
    assert "<img" not in (tmp_path / "report.html").read_text(encoding="utf-8")
    capsys.readouterr()
    assert main(["report", str(tmp_path), "figures=some"]) == 2
    assert "figures=some: choose all, main or none" in capsys.readouterr().err


def test_the_report_has_the_formats_that_were_asked_for_last(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(figures, "FIGURES", ("costs", "parameters"))

    def drawn() -> set[str]:
        links = set(re.findall(r'href="figures/([^"]+)"', (tmp_path / "report.html").read_text(encoding="utf-8")))
        assert links == {path.name for path in tmp_path.glob("figures/*.*")} - {"index.json"}
        return links

    # Two formats are no sweep.
    assert run(tmp_path, "figures=main", "formats=pdf,svg") == 0
    assert "multirun" not in "".join(path.name for path in tmp_path.iterdir())
    assert drawn() == {f"cost_against_accuracy.{kind}" for kind in ("png", "pdf", "svg")}
    assert run(tmp_path, "figures=all", "formats=[pdf]") == 0
    assert {"cost_against_accuracy.pdf", "error_by_parameter.png"} <= drawn()
    assert {name.rpartition(".")[2] for name in drawn()} == {"png", "pdf"}
    assert run(tmp_path, "figures=main") == 0
    assert drawn() == {"cost_against_accuracy.png"}
    capsys.readouterr()
    assert main(["report", str(tmp_path), "formats=pdf,tiff"]) == 2
    assert "formats=pdf,tiff: choose among png, pdf and svg" in capsys.readouterr().err


def test_a_damaged_file_is_named_however_often_the_report_was_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(tmp_path, "figures=none") == 0
    (tmp_path / "trials" / "0123456789abcdef-0-4.parquet").write_bytes(b"nothing")
    for _ in range(2):
        assert main(["report", str(tmp_path), "figures=none"]) == 1
        assert "0123456789abcdef-0-4.parquet" in capsys.readouterr().err
