"""`ipe-bench design` and `ipe-bench posterior`: tables and files."""

import csv
from types import SimpleNamespace

import pandas as pd
import pytest

import ipe_bench as ib
from ipe_bench.questions.posterior import answer

SMALL = ("measurement=polynomial", "noise=gaussian", "noise.deviation=0.01")


def test_tables_and_files_say_the_same(ipe_bench, tmp_path):
    code, out, err = ipe_bench("design", *SMALL, "readings=20")
    assert (code, err) == (0, "")
    assert "what 40 readings determine" in out
    folder = tmp_path / "outputs" / "design-polynomial"
    found = ib.design(
        ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01)), readings=20
    )
    best = found.ways[0].sharpest
    assert f"Worst-determined combination: {found.observability.words}" in out
    assert f"{best.mean_bound:.3f}" in out
    with (folder / "readings.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["choice"] == "sharpest"]
    times = found.candidates.index["time"]
    assert [float(row["time"]) for row in rows] == pytest.approx([times[k] for k in best.rows])
    assert len(rows) == best.readings == 20
    assert {path.name for path in folder.iterdir()} == {
        "design.json",
        "design.png",
        "readings.csv",
        "design.html",
    }
    # The same command writes there again, another one elsewhere.
    assert ipe_bench("design", *SMALL, "readings=20")[0] == 0
    assert not (tmp_path / "outputs" / "design-polynomial-2").exists()
    assert ipe_bench("design", *SMALL, "readings=25")[0] == 0
    assert (tmp_path / "outputs" / "design-polynomial-2" / "design.json").exists()


@pytest.mark.slow
def test_every_richer_version_of_the_model_is_suspected(ipe_bench):
    code, out, _ = ipe_bench(
        "design", "measurement=gins", "error_scale=33", "by=axis", "output=here"
    )
    assert code == 0
    rows = {line.strip().split("  ")[0]: line for line in out.splitlines()}
    for name in ("platform x", "platform y", "gyro random walk", "misalignment xy", "quadratic x"):
        assert name in rows
    assert "yes" in rows["platform y"]
    assert "platform y + 0.97 bx" in rows["platform y"]
    assert "Tests of residuals will not detect platform y, platform x, platform z" in out


def test_a_table_and_files_for_each_trial(ipe_bench, tmp_path):
    words = (
        "error_scale=3",
        "solver=[newton]",
        "baseline=[linear_lse]",
        "trials=2",
        "particles=400",
    )
    code, out, error = ipe_bench("posterior", *SMALL, *words)
    assert code == 0
    assert error.splitlines() == ["polynomial: trial 1 of 2", "polynomial: trial 2 of 2"]
    folder = tmp_path / "outputs" / "posterior-polynomial"
    assert {path.name for path in folder.iterdir()} == {
        f"posterior.{kind}" for kind in ("json", "csv", "html", "png")
    }
    found = pd.read_csv(folder / "posterior.csv")
    assert list(found["trial"]) == [0] * 4 + [1] * 4
    assert (abs(found["mean"] - found["truth"]) < 5 * found["deviation"]).all()
    assert "cannot be relied on" not in out
    rows = [line.split() for line in out.splitlines()]
    diverging = {
        name: [float(row[-4].replace("k", "e3")) for row in rows if name in row]
        for name in ("newton", "linear_lse")
    }
    assert max(diverging["newton"]) < 0.3 < min(diverging["linear_lse"])
    assert [row[-5] for row in rows if "newton" in row] == ["yes", "yes"]
    assert [row[-5] for row in rows if "linear_lse" in row] == ["NO", "NO"]


@pytest.mark.parametrize("settled", [(True, True), (True, False), (False, True), (False, False)])
def test_posteriors_exit_with_1_unless_the_populations_of_every_trial_agree(
    ipe_bench, monkeypatch, settled
):
    """Of two trials: what they agree on is made up here."""
    found = [SimpleNamespace(posterior=SimpleNamespace(settled=one)) for one in settled]
    monkeypatch.setattr(answer, "sampled", lambda *args: found)
    monkeypatch.setattr(
        answer, "write_posteriors", lambda folder, *args: [folder / "posterior.json"]
    )
    monkeypatch.setattr(answer, "posterior_parts", lambda *args: [])
    assert ipe_bench("posterior", *SMALL, "trials=2")[0] == (0 if all(settled) else 1)


def test_an_experiment_that_sweeps_needs_a_value_of_its_key(ipe_bench):
    code, _, err = ipe_bench("design", "+experiment=polynomial")
    assert code == 2
    assert "sweeps over 3 settings" in err
    assert ipe_bench("design", "+experiment=polynomial", "error_scale=10")[0] == 0
