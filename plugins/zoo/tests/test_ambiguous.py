"""Trials in which several minima fit: flagged in what is stored, counted in the summary, shown
where somebody looks."""

import numpy as np
import pytest
from ipe_bench_zoo import Triad

import ipe_bench as ib
from ipe_bench.baselines import LevenbergMarquardt, Multistart
from ipe_bench.noise import Gaussian
from ipe_bench.report.tables.reports import all_tables
from ipe_bench.runs.run import compute
from ipe_bench.solvers import Auto
from ipe_bench.statistics import analyse
from ipe_bench.trials.scenario import Scenario

LOOKING = {"auto": Auto(), "multistart": Multistart()}


PLAIN = {"levenberg_marquardt": LevenbergMarquardt()}


def stored(folder, estimators, trials):
    scenario = Scenario(Triad(), Gaussian(1e-5), error_scale=300.0)
    assert compute([scenario], estimators, trials, folder) == ()
    return folder


@pytest.mark.slow
def test_the_summary_counts_the_flags_that_are_stored(tmp_path):
    stored(tmp_path, LOOKING | PLAIN, 8)
    trials = ib.load(tmp_path).set_index("estimator")
    summary = analyse([tmp_path]).summary
    summary = summary[summary["parameter"] == "all"].set_index("estimator")
    for label in LOOKING:
        own = trials.loc[label]
        flagged, failed = own["extra_ambiguous"].astype(bool), ~own["success"].astype(bool)
        assert flagged.any()
        assert failed.any()
        np.testing.assert_array_equal(flagged, own["extra_minima"] > 1)
        assert summary.loc[label, "ambiguous"] == flagged.mean()
        assert summary.loc[label, "failures_flagged"] == flagged[failed].mean()
        assert summary.loc[label, "failed_known"] >= (flagged & failed).mean()
    assert np.isnan(summary.loc["levenberg_marquardt", "ambiguous"])


def test_tables_have_the_columns_only_where_somebody_looks(tmp_path):
    looking = {"multistart": LOOKING["multistart"]} | PLAIN
    blind = {"undamped": LevenbergMarquardt(damping=1e-6)} | PLAIN
    for name, estimators, there in (("looking", looking, True), ("blind", blind, False)):
        folder = stored(tmp_path / name, estimators, 2)
        table = next(t for t in all_tables(analyse([folder])) if t.name == "all_trials")
        titles = {c.title for c in table.columns}
        assert ({"ambiguous", "failures flagged"} <= titles) == there
        assert "misfit" in titles
