"""What once stood between a file of readings and an answer, tried by the command that a user types.

Weights, levels, single parameters, formulas, units and several files are tried in `tests/cli/test_estimate.py`.
Warnings are errors here, as everywhere in the tests.
"""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from ipe_bench.cli.main import main
from ipe_bench.measurements import Gnss

LM = ("solver=[]", "baseline=[levenberg_marquardt]")


@pytest.fixture
def ipe_bench(tmp_path, monkeypatch, capsys):
    """Runs a command in an empty folder: its exit code and what it printed."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["ipe-bench"])

    def run(*words: str) -> tuple[int, str]:
        drawn = ["figures=none"] if words[0] == "estimate" else []
        code = main([*words, *drawn])
        printed = capsys.readouterr()
        return code, printed.out + printed.err

    return run


def answer(label: str = "levenberg_marquardt") -> dict:
    """What the last estimate left."""
    files = sorted(Path("outputs").rglob("estimate.json"), key=lambda path: path.stat().st_mtime_ns)
    return json.loads(files[-1].read_text())["estimators"][label]


def truth(path: str) -> dict[str, float]:
    rows = csv.DictReader(Path(path).read_text().splitlines())
    return {row["parameter"]: float(row["value"]) for row in rows}


def test_run_does_not_ignore_a_file_of_readings(ipe_bench):
    code, printed = ipe_bench("run", "readings=/nonexistent.csv")
    assert code == 2
    assert "readings: is for `ipe-bench estimate`: run simulates its readings" in printed


def test_a_model_is_simulated_with_its_own_noise(ipe_bench):
    """Ranges of a beacon had the quantisation of an inertial platform."""
    code, printed = ipe_bench("run", "measurement=ranging", "trials=2", "--dry-run")
    assert code == 0
    assert "ranging, gaussian" in printed


@pytest.mark.slow
def test_an_example_of_the_help_gives_the_certified_answer(ipe_bench):
    """b1 was -3.3e11 by default, with exit code 0."""
    code, printed = ipe_bench("estimate", "measurement=nist/misra1a")
    assert code == 0, printed
    assert answer("auto")["estimates"]["b1"] == pytest.approx(2.3894212918e02, rel=1e-6)
    assert "linear_lse: MISFIT" in printed


@pytest.mark.slow
def test_an_answer_to_a_trial_of_any_scale_needs_no_scale(ipe_bench):
    """Integrated with a step for error scale 1, the readings of scale 3000 were fitted by parameters that were nine
    standard errors off, and the fit was said to be good."""
    assert ipe_bench("run", "error_scale=3000", "seed=3", "write_readings=t.csv")[0] == 0
    code, printed = ipe_bench("estimate", "readings=t.csv", "solver=[progressive]", "baseline=[]")
    assert code == 0, printed
    found, known = answer("progressive"), truth("t.truth.csv")
    off = [abs(found["estimates"][name] - known[name]) / found["standard_errors"][name] for name in known]
    assert max(off) < 4


def test_decimal_commas_are_not_cut_off(ipe_bench, tmp_path):
    """A range of 1017.12 m between commas was 1017 m."""
    assert ipe_bench("run", "measurement=ranging", "error_scale=10", "write_readings=r.csv")[0] == 0
    with_commas = (tmp_path / "r.csv").read_text().replace(".", ",")
    (tmp_path / "c.csv").write_text(with_commas)
    code, printed = ipe_bench("estimate", "measurement=ranging", "readings=c.csv", *LM)
    assert code == 2
    assert "row 2: has 4 cells and the header 3; with decimal commas, separate the cells by semicolons" in printed
    semicolons = (tmp_path / "r.csv").read_text().replace(",", ";").replace(".", ",")
    (tmp_path / "s.csv").write_text(semicolons)
    code, printed = ipe_bench("estimate", "measurement=ranging", "readings=s.csv", *LM)
    assert code == 0, printed
    found, known = answer(), truth("r.truth.csv")
    assert all(abs(found["estimates"][name] - known[name]) < 5 * found["standard_errors"][name] for name in known)


@pytest.mark.parametrize(
    ("cell", "said"),
    [
        ("1_0", "'1_0' is not a number"),
        ("\uff11\uff10", "is not a number"),
        ("1e400", "1e400 is not a reading"),
        ("nan", "nan is not"),
    ],
)
def test_what_is_not_plainly_a_number_is_refused_with_its_row(ipe_bench, tmp_path, cell, said):
    (tmp_path / "a.csv").write_text(f"t,y\n1,2\n2,{cell}\n3,4\n")
    line = ("measurement=formula", "measurement.expression=a*t", "measurement.start.a=1")
    code, printed = ipe_bench("estimate", *line, "readings=a.csv", *LM)
    assert code == 2
    assert "row 3, column y" in printed
    assert said in printed
    assert len(printed.strip().splitlines()) == 1


def test_satellites_come_with_the_readings(ipe_bench):
    """They stood in the config alone: a matrix of 30 numbers on the command line."""
    code, printed = ipe_bench("list", "measurement/gnss")
    assert code == 0
    assert "header: epoch,constellation,satellite,x [m],y [m],z [m],reading [m]" in printed
    assert ipe_bench("run", "measurement=gnss", "write_readings=g.csv")[0] == 0
    code, printed = ipe_bench("estimate", "measurement=gnss", "readings=g.csv", *LM)
    assert code == 0, printed
    found, known = answer(), truth("g.truth.csv")
    assert set(found["estimates"]) == {p.name for p in Gnss().parameters}
    assert all(abs(found["estimates"][name] - known[name]) < 5 * found["standard_errors"][name] for name in known)


def test_readings_are_taken_when_the_file_says(ipe_bench, tmp_path):
    """Days 3, 4.5 and so on of an epidemic were no days of the model."""
    rows = ["time [day],reading [people]", "3,26", "4.5,140", "6,293", "7.25,285", "9,190", "11,65"]
    (tmp_path / "s.csv").write_text("\n".join(rows))
    code, printed = ipe_bench("estimate", "measurement=sir", "readings=s.csv", *LM)
    assert code == 0, printed
    assert 0.02 < answer()["standard_errors"]["ln_beta"] < 0.3


@pytest.mark.slow
def test_draws_respect_what_is_known_of_parameters(ipe_bench, tmp_path):
    """A predator that is born at a negative rate is no trial: at a prior of twice the rate a third of them were."""
    words = ("measurement=lotka_volterra", "parameters.birth.positive=true", "parameters.birth.deviation=1.1")
    births = []
    for trial in range(4):
        name = f"w{trial}.csv"
        code, printed = ipe_bench("run", *words, f"write_readings={name}", f"write_readings_trial={trial}")
        assert code == 0, printed
        births.append(truth(f"w{trial}.truth.csv")["birth"])
    assert min(births) > 0
    assert max(births) / min(births) > 2


def test_a_start_that_is_far_off_may_be_given(ipe_bench, tmp_path):
    t = np.arange(1.0, 9.0)
    rows = [f"{a},{b:.6f}" for a, b in zip(t, 3 * np.sin(2.0 * t) + 0.01 * np.cos(9 * t), strict=True)]
    (tmp_path / "w.csv").write_text("\n".join(["t,y", *rows]))
    words = ("measurement=formula", "measurement.expression=a*sin(w*t)", "measurement.start.a=1")
    far = ipe_bench("estimate", *words, "measurement.start.w=1", "readings=w.csv", "noise.deviation=0.02", *LM)
    assert far[0] == 1, far[1]
    near = (*words, "measurement.start.w=1", "parameters.w.nominal=1.9")
    code, printed = ipe_bench("estimate", *near, "readings=w.csv", "noise.deviation=0.02", *LM)
    assert code == 0, printed
    assert answer()["estimates"]["w"] == pytest.approx(2.0, abs=0.01)


def test_names_are_not_broken_over_lines(ipe_bench, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    code, printed = ipe_bench("list", "measurement/gins_misaligned")
    assert code == 0
    assert "measurement=gins_misaligned\n" in printed
    assert "measurement=gins_misaligne\n" not in printed


def test_an_option_is_found_by_its_name_alone(ipe_bench):
    code, printed = ipe_bench("list", "newton")
    assert code == 2
    assert "newton: write solver/newton" in printed


CASES = {
    "one case": ("measurement=gins", "measurement.injected=[[1500,0]]", "measurement.readings_per_case=6"),
    "one reading": (
        "measurement=formula", "measurement.expression=a*t", "measurement.start.a=1", "measurement.columns.t=[1]",
        "noise.deviation=0.1",
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_a_model_of_one_case_or_one_reading_warns_of_nothing(ipe_bench, case):
    """Tables and figures included: warnings are errors."""
    code, printed = ipe_bench("run", *CASES[case], "trials=3", "execution=serial")
    assert code == 0, printed
    assert "Warning" not in printed


def test_a_model_of_ones_own_brings_its_readings(ipe_bench, tmp_path):
    """`Recorded` is public: a plugin's model needs no file."""
    package = tmp_path / "plugins" / "own" / "own_recorded"
    (package / "conf" / "measurement").mkdir(parents=True)
    (package / "conf" / "measurement" / "own_line.yaml").write_text("_target_: own_recorded.Line\n")
    (package / "__init__.py").write_text(
        "from dataclasses import dataclass\n"
        "import numpy as np\n"
        "from ipe_bench.basics.linalg import Covariance\n"
        "from ipe_bench.measurements import Measurement, Parameter, Recorded\n\n\n"
        "@dataclass(frozen=True)\n"
        "class Line(Measurement):\n"
        "    @property\n"
        "    def parameters(self):\n"
        "        return (Parameter('a'), Parameter('b'))\n\n"
        "    @property\n"
        "    def index(self):\n"
        "        return {'t': [0, 1, 2, 3]}\n\n"
        "    def simulate(self, x):\n"
        "        return x[:, :1] + x[:, 1:] * np.arange(4.0)\n\n"
        "    @property\n"
        "    def recorded(self):\n"
        "        return Recorded(np.array([1.0, 3.1, 4.9, 7.0]), Covariance(np.full(4, 0.1)), np.array([1.03, 1.98]))\n"
    )
    from ipe_bench.plugins import discovery

    discovery.sources.cache_clear()
    try:
        code, printed = ipe_bench("estimate", "measurement=own_line", *LM)
        assert code == 0, printed
        expected = dict(zip("ba", np.polyfit([0, 1, 2, 3], [1.0, 3.1, 4.9, 7.0], 1), strict=True))
        assert answer()["estimates"] == pytest.approx(expected, rel=1e-6)
        assert answer()["standard_errors"]["b"] == pytest.approx(0.1 / np.sqrt(5.0), rel=1e-6)
    finally:
        discovery.sources.cache_clear()
