"""Readings of GINS in a file, estimated by a command that is not told how far the parameters lie."""

import csv
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from ipe_bench.measurements import Gins
from ipe_bench.noise import Quantization
from ipe_bench.solvers import Progressive
from ipe_bench.trials.scenario import Scenario

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


@pytest.mark.slow
@pytest.mark.parametrize("scale", [300.0, 1000.0, 3000.0, 10_000.0])
def test_without_a_prior_estimates_succeed_as_often_as_with_one(scale):
    """Who has a file alone cannot say how far the parameters may lie: windows then take it from the linear estimate."""
    scenario = Scenario(Gins(), Quantization(0.02286), error_scale=scale)
    trials = scenario.draw(0, 60)
    problem = replace(scenario.problem, prior_deviation=None)
    found = Progressive().estimate(problem, trials.z)
    J = scenario.problem.R.whiten_jacobian(scenario.measurement.jacobian(trials.x))
    distance = np.sum(np.einsum("tij,tj->ti", J, found.x - trials.x) ** 2, axis=1)
    success = distance <= chi2.isf(1e-6, problem.measurement.n)
    assert success.sum() >= 59
    assert (found.extras["fit_p"][~success] < 1e-6).all()
