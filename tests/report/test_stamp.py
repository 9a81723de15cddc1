"""A report that is there and right stays as it is, and any other is made again."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from shared.reports import fill
from shared.synthetic_store import Synthetic

from ipe_bench.api import report
from ipe_bench.cli.main import main
from ipe_bench.report import figures


def run(folder: Path, *more: str) -> int:
    words = ["run", "measurement=polynomial", "noise=gaussian", "trials=4", "figures=none"]
    return main([*words, f"output={folder}", *more])


def written(folder: Path) -> dict[str, int]:
    files = [
        folder / "report.html",
        folder / "summary.csv",
        *folder.glob("tables/*"),
        *folder.glob("figures/*.*"),
    ]
    return {
        str(path.relative_to(folder)): path.stat().st_mtime_ns
        for path in (*files, *folder.glob("runs/*"))
    }


@pytest.mark.parametrize("stamped", [True, False])
def test_tables_of_earlier_results_do_not_stay_and_files_of_others_do(
    tmp_path: Path, stamped: bool
) -> None:
    store = Synthetic(tmp_path / "store")
    fill(store, scales=(1.0,))
    report([store.directory], store.directory, figures="none", formats="tex")
    tables = store.directory / "tables"
    (tables / "mine.tex").write_text("of somebody else")
    (tables / "iterations.csv").write_text("of an estimator that is gone")
    if not stamped:
        (store.directory / ".report.json").unlink()
    report([store.directory], store.directory, figures="none")
    left = {path.name for path in tables.iterdir()}
    assert "mine.tex" in left
    assert {name for name in left if name.endswith(".tex")} == {"mine.tex"}
    # A table that no stamp names is somebody else's, unless there is none and the name is ours.
    assert ("iterations.csv" in left) == stamped


@pytest.mark.slow
def test_a_report_is_made_again_where_anything_has_changed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(tmp_path) == 0
    before = written(tmp_path)
    capsys.readouterr()
    assert run(tmp_path) == 0
    assert written(tmp_path) == before
    assert "polynomial, gaussian: 4 trials per row" in capsys.readouterr().out
    for name in ("summary.csv", "report.html"):
        path = tmp_path / name
        text = path.read_text(encoding="utf-8")
        path.write_text(text + " ", encoding="utf-8")
        assert main(["report", str(tmp_path), "figures=none"]) == 0
        assert path.read_text(encoding="utf-8") == text
    text = (tmp_path / "summary.csv").read_text(encoding="utf-8")
    assert run(tmp_path, "trials=6") == 0
    assert (tmp_path / "summary.csv").read_text(encoding="utf-8") != text
    # A damaged file is named however often the report was made.
    (tmp_path / "trials" / "0123456789abcdef-0-4.parquet").write_bytes(b"nothing")
    for _ in range(2):
        assert main(["report", str(tmp_path), "figures=none"]) == 1
        assert "0123456789abcdef-0-4.parquet" in capsys.readouterr().err


@pytest.mark.slow
def test_the_report_has_the_figures_and_formats_that_were_asked_for_last(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(figures, "FIGURES", ("costs", "parameters"))

    def drawn() -> set[str]:
        page = (tmp_path / "report.html").read_text(encoding="utf-8")
        links = set(re.findall(r'href="figures/([^"]+)"', page))
        assert links == {path.name for path in tmp_path.glob("figures/*.*")} - {"index.json"}
        assert page.count("<figure") == len({name.partition(".")[0] for name in links})
        return links

    def kinds() -> set[str]:
        return {path.suffix[1:] for path in tmp_path.glob("tables/*")}

    # Two formats are no sweep.
    assert run(tmp_path, "figures=main", "formats=pdf,svg,tex") == 0
    assert "multirun" not in "".join(path.name for path in tmp_path.iterdir())
    assert drawn() == {f"cost_against_accuracy.{kind}" for kind in ("png", "pdf", "svg")}
    mine = tmp_path / "tables" / "mine.tex"
    mine.write_text("not of the report")
    assert kinds() == {"csv", "tex"}
    report = ["report", str(tmp_path)]
    assert main([*report, "figures=all", "formats=[pdf,md]"]) == 0
    assert kinds() == {"csv", "md", "tex"}
    mine.unlink()
    assert kinds() == {"csv", "md"}
    assert {"cost_against_accuracy.pdf", "convergence.png"} <= drawn()
    assert {name.rpartition(".")[2] for name in drawn()} == {"png", "pdf"}
    assert main([*report, "figures=none"]) == 0
    assert drawn() == set()
    for word, said in (
        ("figures=some", "choose all, main or none"),
        ("formats=pdf,tiff", "choose among png, pdf, svg, csv"),
    ):
        capsys.readouterr()
        assert main([*report, word]) == 2
        assert f"{word}: {said}" in capsys.readouterr().err
