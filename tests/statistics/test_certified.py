"""Runs on certified readings: one trial, no prior, and digits against the certified answer."""

import numpy as np
import pytest

from ipe_bench.api import report as write_report
from ipe_bench.baselines import LinearLSE, MultiscaleLM
from ipe_bench.basics.errors import UserError
from ipe_bench.measurements import Nist, Polynomial
from ipe_bench.noise import Certified
from ipe_bench.priors import GaussianPrior
from ipe_bench.runs.run import compute, validate
from ipe_bench.solvers import FixedPoint
from ipe_bench.statistics.certified import certified_averages, certified_table
from ipe_bench.statistics.collect import collect
from ipe_bench.trials.scenario import Scenario

ESTIMATORS = {
    "linear_lse": LinearLSE(),
    "fixed_point": FixedPoint(),
    "multiscale_lm": MultiscaleLM(),
}


def scenario(dataset, start=1):
    return Scenario(Nist(dataset, start), Certified(), GaussianPrior(), 1.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("certified")
    scenarios = [
        scenario(name, start) for name in ("Misra1a", "Rat42", "BoxBOD") for start in (1, 2)
    ]
    assert compute(scenarios, ESTIMATORS, 1, folder) == ()
    return folder


def test_the_truth_is_the_certified_answer_and_the_readings_are_real():
    trials = scenario("Rat42").draw(0, 1)
    model = Nist("Rat42")
    assert (trials.z[0] == model.readings).all()
    np.testing.assert_allclose(trials.x[0] * model.sizes, model.certified.parameters, rtol=1e-15)
    assert scenario("Rat42").problem.prior_deviation is None


def test_digits_are_tabulated_by_dataset_start_and_estimator(folder):
    table = certified_table(collect([folder]))
    assert len(table) == 18
    ours = table[table["estimator"] == "multiscale_lm"]
    assert (ours[["lre_parameters", "lre_deviations", "lre_rss"]] > 9).all(axis=None)
    # A linear estimate is no least-squares answer, and its row says so.
    assert (table.loc[table["estimator"] == "linear_lse", "lre_parameters"] < 4).all()
    averages = certified_averages(table).set_index(["estimator", "start"])
    assert averages.loc[("multiscale_lm", 1), "solved"] == 3


def test_the_report_writes_the_table_and_draws_nothing_over_error_scales(folder):
    result = write_report([folder], folder)
    assert {p.name for p in result.tables} >= {"certified.csv", "certified_averages.csv"}
    assert {path.name for path in result.figures} == {"digits.png"}
    # One trial without noise has no error to compare with a bound, and no covariance to calibrate.
    shown = {path.stem for path in result.tables if path.parent.name == "tables"}
    assert not shown & {"overview", "calibration", "costs", "comparisons", "parameters"}
    page = result.report.read_text(encoding="utf-8")
    assert (
        page.index('id="certified_averages"')
        < page.index('<details class="part"')
        < page.index('id="certified"')
    )
    # The linear estimate has no digits, the fixed point not all of them.
    most = "multiscale_lm solves all to four digits or more"
    assert f"Of 6 certified problems, {most}" in page


def test_more_than_one_trial_is_refused_before_any_work():
    with pytest.raises(UserError, match=r"trials=10: certified readings are one trial"):
        validate([scenario("Misra1a")], ESTIMATORS, 10)


def test_a_model_without_real_readings_is_refused():
    with pytest.raises(UserError, match=r"^noise=certified: measurement=polynomial"):
        Scenario(Polynomial(), Certified(), GaussianPrior(), 1.0)
