"""What a job returns to sweepers that optimise is the number that its report shows."""

import importlib.util
from types import SimpleNamespace

import pandas as pd
import pytest

from ipe_bench.basics.errors import UserError
from ipe_bench.cli.main import main
from ipe_bench.cli.run import Outcome, _launched

SMALL = (
    "measurement=polynomial",
    "noise=gaussian",
    "execution=serial",
    "solver=[newton]",
    "output=out",
)
SMALL += ("figures=none",)


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def said(out: str) -> float:
    (line,) = [line for line in out.splitlines() if line.startswith("Objective ")]
    return float(line.split()[1].rstrip(","))


def test_of_a_sweep_the_least_is_said(capsys):
    words = ["error_scale=1,100", "trials=10", "objective=newton.simulations_median"]
    assert main(["run", "-m", *SMALL, *words]) == 0
    out = capsys.readouterr().out
    assert "the least of 2 jobs: error_scale=1" in out
    summary = pd.read_csv("out/summary.csv").query("estimator == 'newton' and parameter == 'all'")
    assert said(out) == min(summary["simulations_median"]) < max(summary["simulations_median"])


def test_a_number_that_is_not_known_is_no_objective(capsys):
    assert main(["run", *SMALL, "trials=4", "objective=linear_lse.order_median"]) == 2
    assert "objective=linear_lse.order_median: is not known of" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("outcome", "optimises", "kind", "said"),
    [
        (Outcome("out", mistake="error_scale=-1: give more"), True, UserError, "error_scale=-1"),
        (Outcome("out"), True, UserError, "objective: is not given"),
        (Outcome("out", objective=1.0), True, ValueError, "No trials"),
        (Outcome("out"), False, ValueError, "No trials"),
    ],
)
def test_a_sweeper_that_got_no_number_ends_with_the_mistake(outcome, optimises, kind, said):
    def launch(task):
        raise ValueError("No trials are completed yet.")

    jobs = SimpleNamespace(launch=launch, optimises=optimises)
    with pytest.raises(kind, match=said):
        _launched(jobs, SimpleNamespace(outcomes=[outcome]))  # type: ignore[arg-type]


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("optuna") is None, reason="needs the extra optuna")
@pytest.mark.filterwarnings("default")  # what Optuna 2 uses of its libraries is no error of ours
def test_optuna_finds_cheaper_windows_for_progressive_than_the_default(capsys):
    common = [
        "measurement=bearings",
        "noise=gaussian",
        "error_scale=10",
        "baseline=[]",
        "solver=[progressive]",
    ]
    common += ["trials=100", "execution=serial", "objective=progressive.cost_median"]
    assert main(["run", *common, "output=default"]) == 0
    default = said(capsys.readouterr().out)
    sweep = ["hydra/sweeper=optuna", "hydra/sweeper/sampler=tpe", "hydra.sweeper.sampler.seed=1"]
    sweep += ["hydra.sweeper.n_trials=12", "hydra.sweeper.n_jobs=1", "output=tuned"]
    sweep += [
        "estimators.progressive.growth=interval(1.2,8)",
        "estimators.progressive.window_tolerance=interval(0.05,3)",
    ]
    assert main(["run", "-m", *common, *sweep]) == 0
    assert said(capsys.readouterr().out) < 0.95 * default
