"""Just enough trials: the same trials as ever, no more than are needed, going on from what is
stored."""

import json

import pandas as pd
import pytest

import ipe_bench as ib
from ipe_bench.baselines import LinearLSE
from ipe_bench.cli.main import main

BENCH = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01), error_scale=3.0)
ESTIMATORS = {"newton": ib.solvers.Newton(), "linear": ib.baselines.LinearLSE()}


def stop_of(table: pd.DataFrame) -> dict:
    (stop,) = table.attrs["stops"]
    return stop


def test_there_are_as_many_trials_as_the_precision_takes_and_they_are_those_of_any_run(tmp_path):
    table = ib.run(BENCH, ESTIMATORS, precision=0.04, block_size=50, output=tmp_path / "a")
    stop = stop_of(table)
    assert stop["reason"] == "every interval is narrow enough"
    rows = table[table["parameter"] == "all"]
    assert set(rows["trials"]) == {stop["trials"]}
    widths = (
        rows[["success_anytime_high", "success"]].to_numpy()
        - rows[["success", "success_anytime_low"]].to_numpy()
    )
    assert widths.max() <= 0.04
    whole = ib.run(BENCH, ESTIMATORS, stop["trials"], block_size=50, output=tmp_path / "b")
    for name in (c for c in table.columns if not c.startswith("time")):
        pd.testing.assert_series_equal(table[name], whole[name], rtol=1e-12)
    trials, others = (ib.load(tmp_path / folder) for folder in ("a", "b"))
    same = [c for c in trials.columns if c != "time_s"]
    pd.testing.assert_frame_equal(trials[same], others[same], check_exact=True)
    # A block less would not have been enough, or is all that was looked at.
    fewer = ib.run(BENCH, ESTIMATORS, stop["trials"] // 2, output=tmp_path / "c")
    wide = fewer["success_anytime_high"] - fewer["success"]
    assert (
        max(wide.max(), (fewer["success"] - fewer["success_anytime_low"]).max()) > 0.04
        or stop["trials"] == 50
    )


@pytest.mark.slow
def test_no_precision_is_called_reached_where_an_interval_is_wider():
    for wanted in (0.05, 0.06, 0.07, 0.08, 0.09, 0.1):
        table = ib.run(BENCH, {"linear": LinearLSE()}, precision=wanted, block_size=10)
        rows = table[table["parameter"] == "all"]
        assert stop_of(table)["reason"] == "every interval is narrow enough"
        assert (rows["success_anytime_high"] - rows["success"]).max() <= wanted
        assert (rows["success"] - rows["success_anytime_low"]).max() <= wanted


def test_it_goes_on_from_what_is_stored_and_leaves_one_record_that_is_complete(tmp_path):
    first = stop_of(ib.run(BENCH, ESTIMATORS, precision=0.05, block_size=50, output=tmp_path))
    files = {p.name: p.stat().st_mtime_ns for p in (tmp_path / "trials").iterdir()}
    rows = ib.load(tmp_path)
    again = stop_of(ib.run(BENCH, ESTIMATORS, precision=0.05, block_size=50, output=tmp_path))
    assert again["trials"] == first["trials"]
    assert {p.name: p.stat().st_mtime_ns for p in (tmp_path / "trials").iterdir()} == files
    (record,) = (tmp_path / "runs").glob("*.json")
    assert json.loads(record.read_text())["trials"] == first["trials"]
    finer = stop_of(ib.run(BENCH, ESTIMATORS, precision=0.03, block_size=50, output=tmp_path))
    assert finer["trials"] > first["trials"]
    # A trial that is computed again takes another time.
    later = ib.load(tmp_path)
    pd.testing.assert_frame_equal(
        later[later["trial"] < first["trials"]].reset_index(drop=True), rows
    )
    assert ib.status(tmp_path).attrs["problems"] == []


def test_scenarios_stop_by_themselves():
    other = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01), error_scale=1.2)
    table = ib.run([BENCH, other], {"linear": LinearLSE()}, 2000, precision=0.06, block_size=50)
    stops = {stop["error_scale"]: stop["trials"] for stop in table.attrs["stops"]}
    rows = table[table["parameter"] == "all"].set_index("error_scale")
    assert stops == rows["trials"].to_dict()
    assert stops[3.0] < stops[1.2]


def test_it_ends_with_the_number_of_trials_or_the_time_and_says_which():
    table = ib.run(BENCH, ESTIMATORS, 120, precision=0.001, block_size=50)
    assert stop_of(table)["reason"] == "the largest number of trials is reached"
    assert set(table["trials"]) == {120}
    table = ib.run(BENCH, ESTIMATORS, precision=0.001, block_size=50, time_limit=1e-6)
    assert stop_of(table)["reason"] == "the time is over"
    assert set(table["trials"]) == {50}


@pytest.mark.parametrize(
    ("given", "remedy"),
    [
        ({"precision": 0}, "between 0 and 1"),
        ({"precision": {"success": 0.1}}, "between 0 and 1"),
        ({"precision": 0.1, "time_limit": 0}, "seconds above 0"),
        ({"time_limit": 5}, "goes with precision"),
        ({"precision": 0.1, "trials": 0}, "whole number above 0"),
    ],
)
def test_mistakes_are_told_before_anything_is_computed(tmp_path, given, remedy):
    with pytest.raises(ib.UserError, match=remedy):
        ib.run(BENCH, ESTIMATORS, output=tmp_path / "out", **given)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_the_command_says_how_many_trials_it_took_and_why(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = [
        "measurement=polynomial",
        "noise=gaussian",
        "noise.deviation=0.01",
        "error_scale=3",
        "solver=[newton]",
    ]
    words += ["baseline=[]", "execution=serial", "block_size=50", "output=out", "figures=none"]
    assert main(["run", *words, "precision=0.05"]) == 0
    out = capsys.readouterr().out
    assert " trials; every interval is narrow enough (newton: success ± " in out
    assert main(["run", *words, "precision=0.001", "trials=200"]) == 1
    said = (
        "200 trials; the precision is not reached: the largest number of trials is reached"
        " (newton: success ± "
    )
    assert said in capsys.readouterr().out
    assert main(["run", *words, "precision=0.01", "--dry-run"]) == 0
    assert "at most" in capsys.readouterr().out
    for wrong in ("precision=2", "precision={x:1}", "time_limit=5", "precision=[1]"):
        assert main(["run", *words, wrong]) == 2
        assert len(capsys.readouterr().err.strip().splitlines()) == 1
