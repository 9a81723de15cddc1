"""Readings of GINS in a file, estimated by a command that is not told how far the parameters lie."""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def ipe_bench(*arguments, folder):
    return subprocess.run(
        [sys.executable, "-m", "ipe_bench", *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=300,
        check=True,
    )


@pytest.mark.slow
def test_an_estimate_that_fits_is_right_at_large_errors(tmp_path):
    """A step chosen by `error_scale`, which is 1 here, gave p = .5 and errors of ten standard errors."""
    ipe_bench("run", "error_scale=3000", "seed=3", "write_readings=t.csv", folder=tmp_path)
    ipe_bench("estimate", "readings=t.csv", "solver=[progressive]", "baseline=[]", folder=tmp_path)
    truth = {
        row["parameter"]: float(row["value"])
        for row in csv.DictReader((tmp_path / "t.truth.csv").read_text().splitlines())
    }
    found = json.loads(next(tmp_path.glob("outputs/*/estimate.json")).read_text())["estimators"]["progressive"]
    assert found["status"] == "converged"
    assert found["fits"]
    for name, value in truth.items():
        assert abs(found["estimates"][name] - value) < 4 * found["standard_errors"][name]
