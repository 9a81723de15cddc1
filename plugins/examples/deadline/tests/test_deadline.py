"""The deadline is the quantile of what trials cost, its interval holds it as often as it says, and
both are shown."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import expon

sys.path.insert(0, str(Path(__file__).parents[1]))

from ipe_bench_deadline.deadline import limits

import ipe_bench as ib
from ipe_bench.plugins import discovery
from ipe_bench.report import figures

PLUGIN = Path(__file__).resolve().parents[1]


@pytest.mark.slow
def test_keeps_the_promises_of_statistics_and_figures():
    findings = ib.check(PLUGIN)
    assert {finding.component for finding in findings} == {"statistic=deadline", "figure=deadline"}
    assert not [finding for finding in findings if finding.complaint]
    # A report that the same process writes later does without the plugin.
    assert "ipe_bench_deadline" not in [source.name for source in discovery.sources()]


@pytest.mark.parametrize(("trials", "q"), [(1000, 0.99), (400, 0.99), (60, 0.9)])
def test_the_interval_holds_the_quantile_as_often_as_it_says(trials, q):
    rng, true = np.random.default_rng(1), expon.ppf(q)
    ends = np.array([limits(rng.exponential(size=trials), q) for _ in range(4000)])
    below, above = (ends[:, 0] > true).mean(), (ends[:, 1] < true).mean()
    # Each tail has at most 2.5 %, and 4000 samples tell that to within 0.8 %; ranks are whole, so
    # not much less.
    assert 0.003 < below < 0.033
    assert 0.003 < above < 0.033


def test_too_few_trials_do_not_bound_it_from_above():
    low, high = limits(np.arange(1.0, 101.0))
    assert low <= 99 < high == np.inf


def test_a_report_has_the_column_and_the_figure(tmp_path, monkeypatch):
    (tmp_path / "plugins").mkdir()
    (tmp_path / "plugins" / "deadline").symlink_to(PLUGIN)
    monkeypatch.chdir(tmp_path)
    # Of the bench's own figures one will do.
    monkeypatch.setattr(figures, "FIGURES", ("costs",))
    discovery.sources.cache_clear()
    try:
        bench = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01), error_scale=30.0)
        monkeypatch.setenv("COLUMNS", "80")
        screen = str(ib.run(bench, {"newton": ib.solvers.Newton()}, 40, output="out"))
        trials = ib.load("out")
        cost = trials["simulations"] + trials["jacobians"] * bench.measurement.n
        result = ib.report("out", figures="all", formats="md")
    finally:
        monkeypatch.undo()
        discovery.sources.cache_clear()
    (row,) = result.summary[result.summary["parameter"] == "all"].to_dict("records")
    assert row["deadline"] == np.quantile(cost, 0.99)
    assert row["deadline_low"] <= row["deadline"] <= row["deadline_high"]
    assert result.problems == ()
    assert re.search(r"^ estimator .* done by ", screen, re.MULTILINE)
    assert {path.name for path in result.figures} >= {"deadline.png"}
    assert "99 % done by" in (tmp_path / "out" / "tables" / "costs.md").read_text(encoding="utf-8")
