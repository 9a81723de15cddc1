"""`ipe-bench posterior`: a table, files, and mistakes in one line."""

import pandas as pd
import pytest

SMALL = ("measurement=polynomial", "noise=gaussian", "noise.deviation=0.01", "error_scale=3", "solver=[newton]")


@pytest.fixture
def command(ipe_bench):
    return lambda *words: ipe_bench("posterior", *words)


def test_a_table_and_files_for_each_trial(command, tmp_path):
    code, out, error = command(*SMALL, "baseline=[linear_lse]", "trials=2", "--particles", "400")
    assert code == 0
    assert error.splitlines() == ["polynomial: trial 1 of 2", "polynomial: trial 2 of 2"]
    folder = tmp_path / "outputs" / "posterior-polynomial"
    assert {path.name for path in folder.iterdir()} == {"posterior.json", "posterior.csv", "posterior.html"}
    found = pd.read_csv(folder / "posterior.csv")
    assert list(found["trial"]) == [0] * 4 + [1] * 4
    assert (abs(found["mean"] - found["truth"]) < 5 * found["deviation"]).all()
    assert "cannot be relied on" not in out
    rows = [line.split() for line in out.splitlines()]
    diverging = {
        name: [float(row[-4].replace("k", "e3")) for row in rows if name in row] for name in ("newton", "linear_lse")
    }
    assert max(diverging["newton"]) < 0.3 < min(diverging["linear_lse"])
    assert [row[-5] for row in rows if "newton" in row] == ["yes", "yes"]
    assert [row[-5] for row in rows if "linear_lse" in row] == ["NO", "NO"]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["readings=a.csv"], "readings: is for `ipe-bench estimate`, and nothing in `ipe-bench posterior`"),
        (["precision=0.1"], "precision: is for `ipe-bench run`, and nothing in `ipe-bench posterior`"),
        (["trials=1000"], "trials=1000: each takes up to a minute"),
        (["--particles", "20"], "particles=20: give at least 80"),
        (["--particles", "many"], "--particles: invalid int value"),
        (["trials=0"], "trials=0: give a whole number above 0"),
    ],
)
def test_mistakes_are_one_line(command, words, expected):
    code, _, error = command(*SMALL, "baseline=[]", *words)
    assert code == 2
    assert expected in error
    assert len(error.strip().splitlines()) == 1
