"""Only seeds are pooled; whatever else two experiments differ in is named wherever they are
shown."""

import io
import re
from dataclasses import dataclass, replace

import numpy as np
import pytest
from rich.console import Console
from shared.synthetic_store import Pretender, Repeated

import ipe_bench as ib
from ipe_bench.cli.main import main
from ipe_bench.noise import Correlated, Gaussian
from ipe_bench.report.tables.reports import overview
from ipe_bench.report.tables.table import terminal
from ipe_bench.report.tables.terminal import summary_tables
from ipe_bench.runs.store import ResultKey
from ipe_bench.statistics import analyse
from ipe_bench.statistics.collect import collect

BEACONS = (
    (1000.0, 0.0, 300.0),
    (500.0, 866.0, 20.0),
    (-500.0, 866.0, 300.0),
    (-1000.0, 0.0, 20.0),
    (0.0, -900.0, 50.0),
)


def errors(trials: int = 25, n: int = 3) -> np.ndarray:
    return 0.1 * np.random.default_rng(0).normal(size=(trials, n))


def titles_in(text: str) -> list[str]:
    """The titles of tables, which may be broken into lines."""
    return re.findall(
        r"[a-z_.]*(?:repeated|Repeated|Twice|polynomial|ranging),.*?trialsperrow",
        "".join(text.split()),
    )


def headings(directory) -> tuple[list[str], list[tuple[str, ...]]]:
    """The titles in the terminal, and what tells the rows of the overview apart."""
    analysis = analyse([directory])
    out = io.StringIO()
    Console(file=out, width=250).print(
        terminal(summary_tables(analysis.summary.to_dict("records"), None, 250), 250)
    )
    titles = titles_in(out.getvalue())
    table = overview(analysis)
    named = [column.title for column in table.columns].index("estimator") + 1
    rows = [tuple(cell.text for cell in row[:named]) for row in table.rows]
    return titles, rows


def test_a_matrix_and_none_are_two_experiments(tmp_path):
    model = ib.measurements.Polynomial(count=6)
    noises = [Correlated(0.01), Correlated(0.01, matrix=tuple(map(tuple, 1e-4 * np.eye(6))))]
    table = ib.run(
        [ib.Scenario(model, noise) for noise in noises],
        {"lse": ib.baselines.LinearLSE()},
        20,
        output=tmp_path,
    )
    rows = table[table["parameter"] == "all"]
    assert rows["trials"].tolist() == [20, 20]
    for shown in headings(tmp_path):
        assert len(set(shown)) == 2, shown


@dataclass(frozen=True)
class Twice(Repeated):
    """Another model under the name of the first."""

    name = "repeated"


def another_module() -> type:
    """A class of the same name from another module."""
    other = dataclass(frozen=True)(type("Repeated", (Repeated,), {"name": "repeated"}))
    other.__qualname__, other.__module__ = "Repeated", "elsewhere.models"
    return other


@pytest.mark.parametrize("kind", [Twice, another_module()], ids=["class", "module"])
def test_models_that_share_a_name_are_two_experiments(synthetic, kind):
    scenario = synthetic.scenario()
    synthetic.add(scenario, "one", errors())
    synthetic.add(replace(scenario, measurement=kind()), "one", errors())
    groups = collect([synthetic.directory]).groups
    assert len(groups) == 2
    assert groups[0].columns != groups[1].columns
    for shown in headings(synthetic.directory):
        assert len(set(shown)) == 2, shown


def test_a_setting_of_zero_is_in_every_heading(tmp_path):
    scenarios = [
        ib.Scenario(ib.measurements.Polynomial(strength=strength), Gaussian(0.01))
        for strength in (0.0, 0.005)
    ]
    ib.run(scenarios, {"lse": ib.baselines.LinearLSE()}, 20, output=tmp_path)
    titles, rows = headings(tmp_path)
    assert sum("measurement.strength=0:" in title for title in titles) == 1
    assert {row[0] for row in rows} == {"0", "0.005"}


def test_equal_numbers_of_another_type_are_one_experiment():
    scenario = ib.Scenario(Repeated(), Gaussian(1.0), error_scale=2.0)
    same = ib.Scenario(
        Repeated(sizes_given=(1, 10, 0.1)), Gaussian(1), error_scale=2, seed=np.int64(0)
    )
    assert ResultKey(scenario, "one", Pretender()).key == ResultKey(same, "one", Pretender()).key
    assert ResultKey(scenario).key != ResultKey(replace(scenario, error_scale=2.5)).key


def test_a_sweep_over_lists_names_what_differs_in_tables_status_and_files(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    one, other = (
        "[" + ",".join(str(list(b)).replace(" ", "") for b in part) + "]"
        for part in (BEACONS, BEACONS[:4])
    )
    arguments = [
        "noise=gaussian",
        "noise.deviation=0.1",
        "trials=20",
        "solver=[]",
        "baseline=[linear_lse]",
    ]
    arguments += ["execution=serial", "output=out", "figures=none"]
    assert (
        main(["run", "-m", "measurement=ranging", f"measurement.beacons={one},{other}", *arguments])
        == 0
    )
    titles = titles_in(capsys.readouterr().out)
    assert len(titles) == len(set(titles)) == 2
    table = ib.load("out")
    assert table.groupby("measurement.beacons")["trial"].count().tolist() == [20, 20]
    assert main(["status", "-v", "out"]) == 0
    rows = [line for line in capsys.readouterr().out.splitlines() if "20 of 20" in line]
    assert len(rows) == len(set(rows)) == 4
