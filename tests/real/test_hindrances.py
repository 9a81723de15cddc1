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
