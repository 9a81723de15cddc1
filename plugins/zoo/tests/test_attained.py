"""Runs on problems of known minimum: who attains it, what the status says, and at what cost."""

import pytest
from ipe_bench_zoo import Mgh
from ipe_bench_zoo.attained import (
    SECTION,
    attained_table,
    attained_totals,
    attained_totals_table,
    data_profile,
)
from ipe_bench_zoo.mgh import PROBLEMS as FUNCTIONS
from rich.console import Console

from ipe_bench.api import report as write_report
from ipe_bench.baselines import LeastSquares, LevenbergMarquardt
from ipe_bench.noise import Certified
from ipe_bench.report.tables.table import terminal
from ipe_bench.runs.run import compute
from ipe_bench.solvers import Auto, Progressive
from ipe_bench.statistics import analyse
from ipe_bench.statistics.collect import collect
from ipe_bench.trials.scenario import Scenario

ESTIMATORS = {
    "progressive": Progressive(),
    "levenberg_marquardt": LevenbergMarquardt(max_iterations=1000),
    "minpack": LeastSquares(method="lm", start="nominal"),
}
PROBLEMS = [("rosenbrock", 1.0), ("rosenbrock", 10.0), ("freudenstein_roth", 1.0), ("gulf", 100.0)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("attained")
    scenarios = [Scenario(Mgh(*problem), Certified()) for problem in PROBLEMS]
    assert compute(scenarios, ESTIMATORS, 1, folder) == ()
    return folder


@pytest.fixture(scope="module")
def table(folder):
    return attained_table(collect([folder])).set_index(["function", "start", "estimator"])


@pytest.mark.slow
def test_the_other_minimum_of_freudenstein_and_roth_is_named(table):
    """Powell, Levenberg and Marquardt end there from the standard start; it is in every
    textbook."""
    for local in ("levenberg_marquardt", "minpack"):
        row = table.loc[("freudenstein_roth", 1.0, local)]
        assert (row["solved"], row["minimum"]) == (False, 1)
        assert row["sum_of_squares"] == pytest.approx(48.98425367924, rel=1e-6)
    best = table.loc[("freudenstein_roth", 1.0, "progressive")]
    assert (best["solved"], best["minimum"], best["status"]) == (True, 0, "converged")


def test_totals_count_what_the_table_says(table):
    totals = attained_totals(table.reset_index()).set_index("estimator")
    assert (totals["problems"] == 4).all()
    for label in ESTIMATORS:
        own = table.xs(label, level="estimator")
        assert totals.loc[label, "solved"] == own["solved"].sum()
        assert (
            totals.loc[label, ["solved_1", "solved_10", "solved_100"]].sum() == own["solved"].sum()
        )
    assert totals.loc["progressive", ["solved", "converged", "elsewhere"]].tolist() == [4, 4, 0]
    # A minimum that is not the least one is no solution, however well it has converged.
    local = table.reset_index().assign(status="converged")
    own = attained_totals(local).set_index("estimator").loc["levenberg_marquardt"]
    assert (own["solved"], own["converged"], own["elsewhere"]) == (2, 2, 2)


def test_a_data_profile_rises_to_the_share_that_is_solved(table):
    rows = table.reset_index()
    for label, part in data_profile(rows).groupby("estimator"):
        own = rows[rows["estimator"] == label]
        assert part["share"].is_monotonic_increasing
        assert part["share"].iloc[-1] == own["solved"].mean()
        for at, share in zip(part["at"], part["share"], strict=True):
            assert share == (own["solved"] & (own["gradients"] <= at)).mean()


def test_the_terminal_and_the_report_show_them(folder):
    console = Console(width=140, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    with console.file:
        console.print(terminal(list(SECTION.write(analyse([folder]))), 140))
        shown = console.export_text()
    assert "Known minima" in shown
    assert "no trials yet" not in shown
    result = write_report([folder], folder, figures="all")
    assert {p.name for p in result.tables} >= {"attained.csv", "attained_problems.csv"}
    assert [p.name for p in result.figures] == ["data_profile.png"]
    # All that solve the most are named.
    totals = attained_totals(attained_table(collect([folder])))
    most = list(totals.loc[totals["solved"] == totals["solved"].max(), "estimator"])
    told = f"Most, {totals['solved'].max()}, are solved by {', '.join(most)}."
    page = result.report.read_text(encoding="utf-8")
    assert told in page
    assert not {p.stem for p in result.tables} & {"overview", "calibration"}


@pytest.mark.campaign
@pytest.mark.parametrize("estimator", [Progressive(), Auto()], ids=lambda e: type(e).__name__)
def test_the_general_estimators_attain_all_minima_and_say_so(estimator, tmp_path):
    scenarios = [
        Scenario(Mgh(f, start), Certified()) for f in FUNCTIONS for start in (1.0, 10.0, 100.0)
    ]
    assert compute(scenarios, {"it": estimator}, 1, tmp_path) == ()
    totals = attained_totals(attained_table(collect([tmp_path]))).iloc[0]
    assert totals["solved"] >= 67
    assert totals["solved_1"] == 23
    assert totals["converged"] == totals["solved"]


def test_those_that_solve_most_are_marked_and_stand_first(folder):
    totals = attained_totals(attained_table(collect([folder])))
    solved = next(c for c in attained_totals_table(totals).columns if c.title == "solved")
    numbers = [int(cell.text) for cell in solved.cells]
    assert numbers == sorted(numbers, reverse=True)
    assert [cell.best for cell in solved.cells] == [number == numbers[0] for number in numbers]
    assert len(set(numbers)) > 1
