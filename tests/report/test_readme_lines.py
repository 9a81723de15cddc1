"""README: its links lead somewhere, its lines run in the order in which they stand, and its numbers
come out."""

from __future__ import annotations

import itertools
import os
import re
import shlex
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from gallery_frames import SUFFIX, read
from make_docs import STORED
from PIL import Image
from scipy.stats import chi2

import ipe_bench as ib
from ipe_bench.report.page.headline import headline
from ipe_bench.report.tables.matrix import Matrix
from ipe_bench.report.tables.table import markdown
from ipe_bench.statistics.analysis import Analysis, analyse

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
DRAWN = "outputs/headline/figures/headline.png"
LINES = [
    line.removeprefix("    ") for line in README.splitlines() if line.startswith("    ") or not line
]


def test_it_leads_somewhere():
    led_to = re.findall(r"\]\((?!https?:)([^)#]+)\)", README)
    assert len(led_to) >= 8
    kept = [
        path for path in led_to if (ROOT / "plugins").is_dir() or not path.startswith("plugins/")
    ]
    assert [path for path in kept if not (ROOT / path).exists()] == []


def test_the_solver_that_it_writes_costs_what_newton_costs():
    (code,) = re.findall(r"my_newton\.py <<'END'\n(.*?)\n    END", README, re.DOTALL)
    names: dict = {"__name__": "__main__"}
    exec(compile(textwrap.dedent(code), "my_newton", "exec", dont_inherit=True), names)
    bench = ib.Scenario(
        ib.measurements.Gins(), ib.noise.Quantization(step=0.02286), error_scale=100.0
    )
    estimators = {"newton": ib.solvers.Newton(), "my_newton": names["MyNewton"]()}
    costs = ib.run(bench, estimators, 20).trials.groupby("estimator")["simulations"].apply(list)
    assert costs["my_newton"] == costs["newton"]


def test_the_columns_that_the_advice_on_choosing_names_are_there(tmp_path):
    bench = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01))
    table = ib.run(bench, {"auto": ib.solvers.Auto()}, 5, output=tmp_path)
    page = (ROOT / "ipe_bench/report/docs/pages/choosing.md").read_text(encoding="utf-8")
    assert re.search(r"The column `(\w+)` of the trials", page)[1] in ib.load(tmp_path)  # type: ignore[index]
    assert re.search(r"`(\w+)` in `summary_all.csv`", page)[1] in table  # type: ignore[index]


def test_it_has_at_most_1100_words():
    assert len(README.split()) <= 1100


def opening(analysis: Analysis) -> tuple[str, list[list[str]]]:
    """What the page of these results opens with: its finding, and the cells of its matrix as they
    stand on paper."""
    parts = headline(analysis)
    (matrix,) = [part for part in parts if isinstance(part, Matrix)]
    lines = markdown(matrix.folded()).splitlines()
    rows = [cells(line) for line in lines if line.startswith("| ")]
    return str(parts[0]), rows


def assert_opening(analysis: Analysis) -> None:
    """README's finding and matrix are those of the page; three columns more stand behind."""
    finding, rows = opening(analysis)
    assert f"**{finding}:**" in README
    begins = README.index("| error scale →")
    lines = itertools.takewhile(lambda line: line.startswith("|"), README[begins:].splitlines())
    shown = [cells(line)[:-3] for line in lines if not line.startswith("|:")]
    assert shown == rows


def shown_shares() -> dict[str, tuple[dict[float, float], list[str]]]:
    """Success in per cent at each error scale, a folded column for both of its ends, and what
    stands behind."""
    begins = ("| error scale →", "| `", "| **`")
    header, *rows = [line for line in README.splitlines() if line.startswith(begins)]
    found = {}
    for row in rows:
        name, *values = cells(row)
        by_scale = {
            float(scale): float(value.rstrip("▲?"))
            for title, value in zip(cells(header)[1:-3], values, strict=False)
            for scale in title.split(" to ")
        }
        found[name.strip("*")] = (by_scale, values[-3:])
    return found


def test_it_opens_with_the_finding_and_the_matrix_of_the_stored_experiment():
    assert_opening(read(STORED / f"headline{SUFFIX}").analysis)


def test_nees_and_cost_at_100_are_those_of_the_stored_experiment():
    summary = read(STORED / f"headline{SUFFIX}").analysis.summary
    at_100 = summary[(summary["parameter"] == "all") & (summary["error_scale"] == 100.0)]
    totals = at_100.set_index("estimator")
    shares = shown_shares()
    assert len(shares) == 8
    for name, (_, (nees, cost, _time)) in shares.items():
        assert_rounded(nees, totals.loc[name, "nees_median"])
        assert_rounded(cost, totals.loc[name, "simulations_median"])


def assert_rounded(shown: str, value: float) -> None:
    """A number of three digits, such as 1.03 or 126M, is the value as far as it goes."""
    assert float(shown.replace("M", "e6")) == pytest.approx(value, rel=0.005)


def test_every_run_that_it_shows_is_accepted_as_it_stands(ipe_bench):
    """Which computes nothing; the slow test of all lines in their order does."""
    text = "\n".join(LINES)
    shown = [shlex.split(line) for line in re.findall(r"^ipe-bench (run .*)$", text, re.MULTILINE)]
    runs = [words for words in shown if not any("my_newton" in word for word in words)]
    assert len(runs) >= 3
    for words in [*runs, ["run", "+experiment=headline"]]:
        assert ipe_bench(*words, "--dry-run")[0] == 0, words


def test_what_make_is_asked_for_in_texts_and_in_ci_is_there():
    made = (ROOT / "Makefile").read_text(encoding="utf-8")
    (phony,) = re.findall(r"^\.PHONY: (.*)$", made, re.MULTILINE)
    contributing = (ROOT / ".github/CONTRIBUTING.md").read_text(encoding="utf-8")
    before_landing = (ROOT / ".ci/run").read_text(encoding="utf-8")
    named = re.findall(r"(?:`|^ *)make (\w+)", README + contributing, re.MULTILINE)
    landing = re.findall(r"^make (\w+)$", before_landing, re.MULTILINE)
    assert {"run", "test", "dist", "slow", "lint", "mutants", "cluster"} <= {*named}
    assert landing == ["lint", "test", "slow"]
    assert {*named, *landing} <= {*phony.split()}
    # What takes more than a second is said wherever the tests run as a whole.
    wholes = re.findall(r"^(?:test|slow):.*\n\t(.*)$", made, re.MULTILINE)
    assert len(wholes) == 2
    assert all("--durations-min=1" in command for command in wholes)


def cells(row: str) -> list[str]:
    return [cell.replace("`", "").strip() for cell in row.strip("|").split("|")]


def table_under(heading: str, text: str) -> dict[str, dict[str, str]]:
    """The first Markdown table below a heading: its cells by row and column."""
    below = text.partition(f"## {heading}\n")[2].splitlines()
    begins = next(i for i, line in enumerate(below) if line.startswith("|"))
    lines = list(itertools.takewhile(lambda line: line.startswith("|"), below[begins:]))
    names = cells(lines[0])[1:]
    rows = [cells(line) for line in lines[2:]]
    return {name: dict(zip(names, row, strict=True)) for name, *row in rows}


def test_its_rows_of_states_are_those_of_the_page_of_tables():
    page = ROOT / "ipe_bench/report/docs/pages/explanation/tables_of_states.md"
    tables = page.read_text(encoding="utf-8")
    shown = table_under("States that move", README)
    by_tracker = table_under("Bearings at scale 30", tables)
    bearings = {name: row["success"] for name, row in by_tracker.items()}
    walking = table_under("Walking drifts", tables)["success, % (95 % interval)"]
    found = [row for name, row in shown.items() if "error scale" in name]
    assert len(found) == 2
    for row, known in zip(found, (bearings, walking), strict=True):
        assert {name: known[name].partition(" (")[0] for name in row} == row


def recomputed(folder: Path) -> pd.DataFrame:
    """What a reader computes from the trials alone, with pandas: a row per error scale and
    estimator."""
    rows = ib.load(folder)
    n = sum(column.startswith("error_") for column in rows) - 1  # the error scale is no parameter
    rows["error"] = np.sqrt(rows["crlb_distance"] / n).fillna(np.inf)
    rows["nees"] = rows["nees"].fillna(np.inf) / chi2.median(n)
    noticed = (rows["status"] != "converged") | ~(rows["fit_p"] >= 1e-3)
    rows["silent"] = ~rows["success"] & ~noticed
    rows["known"] = ~rows["success"] & noticed
    rows["square"] = rows["error"].clip(upper=5) ** 2
    groups = rows.groupby(["error_scale", "estimator"])
    found = groups[["success", "silent", "known"]].mean()
    found["error"] = groups["error"].median()
    found["error_95"] = groups["error"].apply(
        lambda error: np.quantile(error[np.isfinite(error)], 0.95)
    )
    found["whole"] = groups["error"].apply(lambda error: np.isfinite(error).all())
    found["efficiency"] = groups["square"].mean() ** -0.5
    found["nees"] = groups["nees"].median()
    return found


def check(folder: Path) -> pd.DataFrame:
    """Holds the summary of a folder against what pandas makes of its trials, and returns the
    latter."""
    summary = pd.read_csv(folder / "summary_all.csv")
    summary = (
        summary[summary["parameter"] == "all"].set_index(["error_scale", "estimator"]).sort_index()
    )
    found = recomputed(folder).sort_index()
    for column, mine in (
        ("success", "success"),
        ("failed_silent", "silent"),
        ("failed_known", "known"),
        ("error_median", "error"),
        ("efficiency_capped", "efficiency"),
        ("nees_median", "nees"),
    ):
        np.testing.assert_allclose(summary[column], found[mine], rtol=1e-9, err_msg=column)
    whole = found["whole"]
    np.testing.assert_allclose(summary["error_q95"][whole], found["error_95"][whole], rtol=1e-9)
    return found


@pytest.mark.slow
def test_every_line_runs_in_order_and_the_table_comes_out(tmp_path):
    (command,) = re.findall(
        r"^run:.*\n\t\$\(BIN\)/(.*)$", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE
    )
    script = (
        "\n".join(LINES)
        .replace("make run\nmake test\n", f"{command}\n")
        .replace(". .venv/bin/activate\n", "")
    )
    assert script.count("ipe-bench ") >= 9
    assert ".assets/headline.png" in README
    environment = os.environ | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", script],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    found = check(tmp_path / "outputs/headline")
    assert_opening(analyse([tmp_path / "outputs/headline"]))
    shares = shown_shares()
    assert len(shares) == 8
    trials = ib.load(tmp_path / "outputs/headline")
    for name, (by_scale, further) in shares.items():
        own = found.xs(name, level="estimator")
        assert [*by_scale] == [*own.index]
        assert [*by_scale.values()] == pytest.approx([*(100 * own["success"])], abs=0.51)
        assert float(further[0].replace("M", "e6")) == pytest.approx(own["nees"][100.0], rel=0.005)
        cost = trials.query("error_scale == 100 and estimator == @name")
        paid = np.median(cost["simulations"] + cost["jacobians"] * 11.08695652173913)
        assert float(further[1]) == pytest.approx(paid, abs=0.5)
    with Image.open(ROOT / ".assets/headline.png") as shown, Image.open(tmp_path / DRAWN) as drawn:
        assert shown.size == drawn.size, f"{DRAWN} is not .assets/headline.png: copy it"
        off = (
            np.abs(np.asarray(shown.convert("L"), float) - np.asarray(drawn.convert("L"), float))
            > 64
        )
    # Another label of one tick changes twice as much.
    assert off.mean() < 2e-5, f"{DRAWN} is not .assets/headline.png: copy it"
