"""`ipe-bench design`: tables, files, and mistakes in one line."""

import csv

import pytest

import ipe_bench as ib

SMALL = ("measurement=polynomial", "noise=gaussian", "noise.deviation=0.01")


@pytest.fixture
def command(ipe_bench):
    return lambda *words: ipe_bench("design", *words)


def test_tables_and_files_say_the_same(command, tmp_path):
    code, out, _ = command(*SMALL, "--readings", "20")
    assert code == 0
    assert "what 40 readings say" in out
    folder = tmp_path / "outputs" / "design-polynomial"
    found = ib.design(ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01)), readings=20)
    best = found.ways[0].sharpest
    assert f"Least observable direction: {found.observability.words}" in out
    assert f"{best.mean_bound:.3f}" in out
    with (folder / "readings.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["choice"] == "sharpest"]
    times = found.candidates.index["time"]
    assert [float(row["time"]) for row in rows] == pytest.approx([times[k] for k in best.rows])
    assert len(rows) == best.readings == 20
    assert {path.name for path in folder.iterdir()} == {"design.json", "readings.csv", "design.html"}
    # The same command writes there again, another one elsewhere.
    assert command(*SMALL, "--readings", "20")[0] == 0
    assert not (tmp_path / "outputs" / "design-polynomial-2").exists()
    assert command(*SMALL, "--readings", "25")[0] == 0
    assert (tmp_path / "outputs" / "design-polynomial-2" / "design.json").exists()


def test_every_richer_version_of_the_model_is_suspected(command):
    code, out, _ = command("measurement=gins", "error_scale=33", "--by", "axis", "output=here")
    assert code == 0
    rows = {line.strip().split("  ")[0]: line for line in out.splitlines()}
    for name in ("tilt x", "tilt y", "gyro random walk", "misalignment xy", "quadratic x"):
        assert name in rows
    assert "yes" in rows["tilt y"]
    assert "tilt y + 0.97 bx" in rows["tilt y"]
    assert "No test of residuals will detect tilt y, tilt x, tilt z" in out


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["trials=5"], "trials: is for `ipe-bench run`"),
        (["solver=[newton]"], "solver: is for `ipe-bench run`"),
        (["readings=a.csv"], "--readings NUMBER"),
        (["--by", "colour"], "by=colour: there is no such column"),
        (["--criterion", "E"], "--criterion: invalid choice"),
        (["--readings", "3"], "readings=3: 4 parameters want"),
        (["--readings", "500"], "readings=500: polynomial has 40 readings to choose among"),
        (["precision=0.1"], "precision: is for `ipe-bench run`"),
        (["truth_measurement=polynomial"], "has no errors besides the parameters"),
    ],
)
def test_mistakes_are_one_line(command, words, expected):
    code, _, error = command(*SMALL, *words)
    assert code == 2
    assert expected in error
    assert len(error.strip().splitlines()) == 1
