"""README: its links lead somewhere, its lines run in the order in which they stand, and its numbers
come out."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from gallery_frames import SUFFIX, read
from make_docs import STORED
from PIL import Image
from readme import BEGINS, ENDS, PICTURES, block, save, view_of
from scipy.stats import chi2

import ipe_bench as ib
from ipe_bench.report.style import house_style
from ipe_bench.statistics.analysis import analyse

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
DRAWN = "outputs/headline/figures/success.png"
TYPED = re.sub(r"(?ms)^```.*?^```$", "", README)
LINES = [
    line.removeprefix("    ") for line in TYPED.splitlines() if line.startswith("    ") or not line
]
"""What a reader types in a shell, and not in Python."""


def test_it_leads_somewhere():
    led_to = re.findall(r"\]\((?!https?:)([^)#]+)\)", README)
    assert len(led_to) >= 8
    kept = [
        path for path in led_to if (ROOT / "plugins").is_dir() or not path.startswith("plugins/")
    ]
    assert [path for path in kept if not (ROOT / path).exists()] == []


def test_the_columns_that_the_advice_on_choosing_names_are_there(tmp_path):
    bench = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01))
    table = ib.run(bench, {"auto": ib.solvers.Auto()}, 5, output=tmp_path)
    page = (ROOT / "ipe_bench/report/docs/pages/choosing.md").read_text(encoding="utf-8")
    assert re.search(r"The column `(\w+)` of the trials", page)[1] in ib.load(tmp_path)  # type: ignore[index]
    assert re.search(r"`(\w+)` in `summary_all.csv`", page)[1] in table  # type: ignore[index]


def test_the_default_loses_significantly_in_no_stored_experiment():
    """README and the page on choosing say so."""
    held = 0
    for path in sorted(STORED.glob(f"*{SUFFIX}")):
        pairs = read(path).analysis.pairs
        for pair in pairs.to_dict("records"):
            only = {pair["first"]: pair["only_first"], pair["second"]: pair["only_second"]}
            if "auto" not in only:
                continue
            (rival,) = only.keys() - {"auto"}
            worse = only[rival] > only["auto"] and pair["p_success"] < 0.05
            assert not worse, (path.name, pair)
            held += 1
    assert held > 1000
    assert "in no stored experiment does it lose significantly" in README
    page = (ROOT / "ipe_bench/report/docs/pages/choosing.md").read_text(encoding="utf-8")
    assert "succeed in significantly more of the same trials than\n`auto`" in page


def test_it_has_at_most_650_words():
    assert len(README.split()) <= 650


def test_the_first_own_answer_comes_within_150_words_of_its_heading():
    """Of the heading that says how to start, to the command that estimates."""
    start = README.partition("## Start\n")[2]
    assert len(start.partition("    ipe-bench estimate")[0].split()) <= 150


def test_its_table_and_what_it_says_are_of_the_stored_experiment():
    """If they are not, `make gallery` writes them again."""
    found = block(read(STORED / f"headline{SUFFIX}").analysis)
    assert f"{BEGINS}{found}{ENDS}" in README
    heads = [line.count("|") - 1 for line in README.splitlines() if line.startswith("|")]
    assert max(heads) <= 4


def shown_shares() -> dict[str, tuple[dict[float, float], str]]:
    """Success in per cent at each error scale of the table, and the cost at the last."""
    header, _, *rows = [cells(line) for line in README.splitlines() if line.startswith("|")]
    scales = [float(scale) for scale in header[1:-1]]
    return {
        name: (dict(zip(scales, [float(v.rstrip(" ▲")) for v in shares], strict=True)), cost)
        for name, *shares, cost in rows
    }


def test_every_run_that_it_shows_is_accepted_as_it_stands(ipe_bench):
    """Which computes nothing; the slow test of all lines in their order does."""
    text = "\n".join(LINES)
    shown = [shlex.split(line) for line in re.findall(r"^ipe-bench (run .*)$", text, re.MULTILINE)]
    runs = [words for words in shown if not any(re.search("my_|oxygen", word) for word in words)]
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


def typed(folder: Path, script: str) -> None:
    """Runs lines as a reader types them."""
    environment = os.environ | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", script],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]


def made_by_run() -> str:
    """The command of `make run`."""
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    (command,) = re.findall(r"^run:.*\n\t\$\(BIN\)/(.*)$", makefile, re.MULTILINE)
    return command


FEW = 20
"""Trials of each command where all lines run in their order."""


@pytest.mark.slow
def test_every_line_runs_in_order(tmp_path):
    """The figure's run has the first of the trials that are stored of it."""
    lines = "\n".join(LINES)
    script = lines.replace("make run\nmake test\n. .venv/bin/activate\n", f"{made_by_run()}\n")
    assert script.count("ipe-bench ") >= 9
    without = re.sub(r" trials=\d+", "", script)
    typed(tmp_path, re.sub(r"(?m)^ipe-bench run .*$", rf"\g<0> trials={FEW}", without))
    found = check(tmp_path / "outputs/headline")["success"]
    stored = read(STORED / f"headline{SUFFIX}").analysis.summary
    whole = stored[stored["parameter"] == "all"].set_index(["error_scale", "estimator"])
    assert len(found) == len(whole) == 7 * 12
    for cell, share in found.items():
        kept = round(whole["success"][cell] * whole["trials"][cell])
        others = whole["trials"][cell] - FEW
        assert kept - others <= round(share * FEW) <= kept, cell


@pytest.mark.slow
def test_its_picture_is_drawn_from_the_stored_experiment(tmp_path):
    """If it is not, `make gallery` draws it again."""
    assert ".assets/headline.png" in README
    drawn = tmp_path / "drawn.png"
    analysis = read(STORED / f"headline{SUFFIX}").analysis
    with house_style():
        save(view_of(analysis), drawn)
    assert off_by(PICTURES[0], drawn) < 2e-5


@pytest.mark.campaign
def test_the_table_and_the_figure_come_out_of_the_whole_run(tmp_path):
    typed(tmp_path, made_by_run())
    found = check(tmp_path / "outputs/headline")
    analysis = analyse([tmp_path / "outputs/headline"])
    assert block(analysis) in README
    shares = shown_shares()
    assert len(shares) == 6
    trials = ib.load(tmp_path / "outputs/headline")
    for name, (by_scale, cost) in shares.items():
        own = found.xs(name, level="estimator")["success"]
        assert [*by_scale.values()] == [round(100 * own[scale], 1) for scale in by_scale]
        at_last = trials["error_scale"] == max(by_scale)
        rows = trials[at_last & (trials["estimator"] == name)]
        paid = np.median(rows["simulations"] + rows["jacobians"] * 11.08695652173913)
        assert float(cost.replace("k", "e3")) == pytest.approx(paid, rel=0.01)
    drawn = tmp_path / DRAWN
    assert off_by(PICTURES[0], drawn) < 2e-5, f"{DRAWN} is not {PICTURES[0]}: `make gallery`"


def off_by(first: Path, second: Path) -> float:
    """The share of pixels that differ; another label of one tick changes more than 2e-5 of them."""
    with Image.open(first) as one, Image.open(second) as other:
        shown = np.asarray(one.convert("L"), float)
        drawn = np.asarray(other.convert("L"), float)
    assert shown.shape == drawn.shape
    return float((np.abs(shown - drawn) > 64).mean())
