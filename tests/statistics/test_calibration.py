"""Calibration: exact bands against simulation and closed forms, false alarms at their level, faults
found and named."""

import re

import numpy as np
import pytest
from scipy.stats import binom, kstest, norm, t
from shared.oracles import assert_agrees
from shared.synthetic_store import Seeker

import ipe_bench as ib
from ipe_bench.report.figures import errors as figure
from ipe_bench.report.figures.views import views
from ipe_bench.report.style import house_style
from ipe_bench.report.tables.reports import all_tables
from ipe_bench.statistics import analyse
from ipe_bench.statistics.calibration import (
    INSIDE,
    POINTS,
    band,
    calibrations,
    covered,
    curves,
    median_limits,
    overall_words,
)


def claims(trials: int, ratio: float = 1.0, shift: float = 0.0, n: int = 1, seed: int = 0):
    """Calibrations of n independent errors that are `ratio` times what is reported, shifted by
    `shift`."""
    rng = np.random.default_rng(seed)
    error = ratio * rng.standard_normal((trials, n)) + shift
    every = np.ones(trials, dtype=bool)
    return calibrations(error, np.ones((trials, n)), (error**2).sum(axis=1), every)


def curves_of(u: np.ndarray):
    """The curve of each row of u (curves, trials)."""
    return curves(
        [np.searchsorted(row, POINTS, side="right") for row in np.sort(u, axis=1)], u.shape[1]
    )


# The bands ----------------------------------------------------------------------------------------


@pytest.mark.oracle("closed form: one uniform draw", "coverage of the band of calibration", 1e-12)
def test_one_trial_in_closed_form():
    """One draw u leaves 'tails above t' where a point p <= 1/2 has u < p <= t, or symmetrically: 2
    floor(100 t) / 100 of the unit interval, for a tail that is no multiple of 0.01."""
    tails = np.array([0.005, 0.015, 0.034, 0.105])
    assert_agrees(covered(1, tails), 1 - 2 * np.floor(100 * tails) / 100, atol=1e-12)


@pytest.mark.parametrize(
    "trials", [7, *(pytest.param(trials, marks=pytest.mark.slow) for trials in (150, 2500))]
)
def test_the_coverage_is_that_of_simulated_draws(trials):
    """20,000 simulated sets of counts keep both tails as often as computed, within 4 deviations."""
    rng = np.random.default_rng(trials)
    counts = np.cumsum(rng.multinomial(trials, np.full(100, 0.01), size=20_000), axis=1)[:, :-1]
    low, high = binom.cdf(counts, trials, POINTS), binom.sf(counts - 1, trials, POINTS)
    least = np.minimum(low, high).min(axis=1)
    tails = np.array([0.02, 0.003, 0.0005])
    shares = (least[:, None] > tails).mean(axis=0)
    expected = covered(trials, tails)
    assert np.all(
        np.abs(shares - expected) < 4 * np.sqrt(expected * (1 - expected) / 20_000) + 1e-9
    )


@pytest.mark.parametrize("trials", [5, 200, 100_000])
def test_a_band_has_its_level_and_a_curve_its_p(trials):
    """The largest band of at least 95 %: coarse where few trials make few different bands."""
    low, high = band(trials)
    assert np.all(low < 0)
    assert np.all(high > 0)
    assert high == pytest.approx(-low[::-1])
    edge = np.where(np.arange(99) == 49, high, 0)
    (curve,) = curves_of(np.random.default_rng(0).random((1, trials)))
    assert 0 < curve.p <= 1
    assert abs(edge).max() < 1.0
    if trials == 100_000:
        # Kolmogorov's bands (1933) are 1.358 / sqrt(trials) wide everywhere; these are wider in the
        # middle only.
        assert 1.358 < high[49] * np.sqrt(trials) < 1.7
        assert high[4] * np.sqrt(trials) < 1.0


@pytest.mark.parametrize("trials", [1, 4, 6])
def test_the_p_of_draws_on_one_side_is_as_small_as_they_are_rare(trials):
    """All draws below the first point, or all above the last, have 2 / 100^trials; where no digits
    are left for that, the sum over both tails of 99 points bounds it."""
    least = 2 * 0.01**trials
    (curve,) = curves([np.full(99, trials)], trials)
    assert least * (1 - 1e-6) <= curve.p <= 99 * least * (1 + 1e-6)


@pytest.mark.slow
def test_p_values_are_uniform():
    """4 deviations of the binomial, over 3,000 honest curves."""
    u = np.random.default_rng(3).random((3000, 400))
    p = np.array([c.p for c in curves_of(u)])
    for level in (0.01, 0.05, 0.3):
        assert abs((p <= level).mean() - level) < 4 * np.sqrt(level / 3000)


# Verdicts -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_false_alarms_keep_to_their_level():
    """Of 400 honest estimators of five parameters at most 5 % are called anything, up to 3
    deviations; NEES alone exactly 5 %."""
    verdicts = [claims(200, n=5, seed=s) for s in range(400)]
    alarms = np.mean([overall_words(parts, list("abcde")) != INSIDE for parts in verdicts])
    assert alarms < 0.05 + 3 * np.sqrt(0.05 * 0.95 / 400)
    alone = np.mean([parts[-1].p < 0.05 for parts in verdicts])
    assert abs(alone - 0.05) < 4 * np.sqrt(0.05 * 0.95 / 400)
    each = np.mean([part.p < 0.05 for parts in verdicts for part in parts[:-1]])
    assert 0.03 < each < 0.05 + 3 * np.sqrt(0.05 * 0.95 / 2000)


@pytest.mark.slow
def test_a_deviation_ten_per_cent_too_small_is_found_with_2000_trials():
    """Of one parameter among eleven, judged together with all others."""
    found = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        error, deviation = rng.standard_normal((2000, 11)), np.ones(11)
        deviation[3] = 0.9
        nees = ((error / deviation) ** 2).sum(axis=1)
        parts = calibrations(
            error, np.broadcast_to(deviation, error.shape), nees, np.ones(2000, dtype=bool)
        )
        found.append(parts[3].words)
    assert sum("times larger" in words for words in found) >= 38
    assert all(words != INSIDE for words in found)


@pytest.mark.parametrize(
    ("ratio", "shift", "words"),
    [
        (1.8, 0.0, "most errors 1.8 times larger than claimed"),
        (0.5, 0.0, "most errors 2.0 times smaller than claimed"),
        (1.0, 3.0, "shifted by +3 deviations"),
        (1.0, -3.0, "shifted by \N{MINUS SIGN}3 deviations"),
        (3.0, 6.0, "shifted by +6 deviations; most errors 3.0 times larger than claimed"),
        (1.0, 0.0, INSIDE),
    ],
)
def test_faults_are_named(ratio, shift, words):
    assert claims(20_000, ratio, shift)[0].words == words


@pytest.mark.oracle(
    "library: SciPy's t", "share of 20,000 errors of Student's law far outside", 0.3
)
def test_heavy_tails_of_the_stated_variance_are_no_variance_that_is_too_large():
    """Student's law with 5 degrees has a median of squares 1.45 times smaller than the normal one
    of its variance."""
    rng = np.random.default_rng(0)
    error = rng.standard_t(5, (20_000, 1)) * np.sqrt(3 / 5)
    parts = calibrations(error, np.ones_like(error), error[:, 0] ** 2, np.ones(20_000, dtype=bool))
    most, outside = parts[0].words.split("; ")
    assert most == "most errors 1.2 times smaller than claimed"
    share = 100 * 2 * t.sf(norm.isf(0.5e-6) / np.sqrt(3 / 5), 5)
    assert_agrees(float(outside.removesuffix(" % far outside")), share, rtol=0.3)


def test_few_far_outside_an_honest_bulk_are_named_as_such():
    rng = np.random.default_rng(0)
    error = rng.standard_normal((2000, 1))
    error[:100] *= 1e6
    parts = calibrations(error, np.ones_like(error), error[:, 0] ** 2, np.ones(2000, dtype=bool))
    assert parts[0].words.endswith("5 % far outside")


def test_the_interval_of_a_median_is_between_the_order_statistics_of_the_binomial():
    """Of 24 numbers those in places 7 and 18: a fair coin falls on one side 6 times or fewer in
    .011 of cases, 7 or fewer in .032 > .025. Places 8 and 17, at .05 in one tail, hold the median
    in .936 only."""
    values = np.random.default_rng(0).permutation(np.arange(1.0, 25.0))
    assert median_limits(values) == (7.0, 18.0)
    assert 1 - 2 * binom.cdf(6, 24, 0.5) >= 0.95 > 1 - 2 * binom.cdf(7, 24, 0.5)
    assert median_limits(values[:19]) == (-np.inf, np.inf)


def test_errors_of_1e80_are_summed_up_without_a_warning():
    """Far from any model, as every number stays one: warnings are errors here."""
    bench = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01), error_scale=1e80)
    rows = ib.run(bench, {"linear": ib.baselines.LinearLSE(), "newton": ib.solvers.Newton()}, 25)
    overall = rows[rows["parameter"] == "all"].set_index("estimator")
    assert overall.loc["linear", "verdict"] == "overconfident"
    assert not re.search("[0-9,]{5}", overall.loc["linear", "calibration"])


def test_another_shape_is_neither_shift_nor_scale():
    """Errors of either sign, all about as large as the median of normal ones."""
    rng = np.random.default_rng(0)
    error = (
        rng.choice([-1.0, 1.0], size=(20_000, 1))
        * 0.674489750196
        * (1 + 1e-3 * rng.standard_normal((20_000, 1)))
    )
    parts = calibrations(error, np.ones_like(error), error[:, 0] ** 2, np.ones(20_000, dtype=bool))
    assert parts[0].words == "of another shape"


def test_what_makes_no_claim_and_what_is_no_covariance():
    error = np.random.default_rng(0).standard_normal((300, 2))
    deviation, nees = np.ones_like(error), (error**2).sum(axis=1)
    assert calibrations(error, deviation, nees, np.zeros(300, dtype=bool)) == []
    assert (
        calibrations(
            error, np.full_like(error, np.nan), np.full(300, np.nan), np.ones(300, dtype=bool)
        )
        == []
    )
    assert overall_words([], []) == "-"
    void = calibrations(
        error, np.full_like(error, np.nan), np.full(300, np.inf), np.ones(300, dtype=bool)
    )
    assert overall_words(void, ["a", "b"]).startswith("most reported covariances are void")


def test_the_parameter_that_is_off_is_named_among_honest_ones():
    rng = np.random.default_rng(0)
    error, deviation = rng.standard_normal((1000, 3)), np.array([1.0, 0.25, 1.0])
    nees = ((error / deviation) ** 2).sum(axis=1)
    parts = calibrations(
        error, np.broadcast_to(deviation, error.shape), nees, np.ones(1000, dtype=bool)
    )
    assert "; b: most errors 3." in overall_words(parts, ["a", "b", "c"])
    assert [part.words for part in (parts[0], parts[2])] == [INSIDE] * 2


# In the report ------------------------------------------------------------------------------------


def test_summary_table_and_figures_say_so(synthetic):
    rng = np.random.default_rng(1)
    for scale in (1.0, 10.0):
        scenario = synthetic.scenario(error_scale=scale)
        error = 0.1 * rng.standard_normal((400, 3))
        synthetic.add(scenario, "honest", error, estimator=Seeker())
        synthetic.add(scenario, "boaster", error, deviation=np.full(3, 0.05), estimator=Seeker())
        synthetic.add(
            scenario, "silent", error, deviation=np.full(3, np.nan), nees=np.nan, estimator=Seeker()
        )
    analysis = analyse([synthetic.directory])
    summary = analysis.summary[analysis.summary["error_scale"] == 10].set_index(
        ["estimator", "parameter"]
    )
    assert summary.loc[("honest", "all"), "calibration"] == INSIDE
    assert (
        "most errors 2.0 times larger than claimed"
        in summary.loc[("boaster", "all"), "calibration"]
    )
    assert "times larger" in summary.loc[("boaster", "b"), "calibration"]
    # Off the grid of points the distribution functions differ by hardly more.
    farthest = kstest((error[:, 1] / 0.05) ** 2, "chi2", (1,)).statistic
    assert summary.loc[("boaster", "b"), "calibration_excursion"] == pytest.approx(
        farthest, abs=0.02
    )
    assert (summary.loc["silent", "calibration"] == "-").all()
    assert (summary.loc["silent", "claims"] == 0).all()
    (shown,) = [table for table in all_tables(analysis) if table.name == "calibration"]
    assert [cell.text for cell in shown.columns[1].cells] == ["boaster", "honest"] * 2
    (view,), _ = views(analysis)
    with house_style():
        drawings = {d.name: d for kind in figure.FIGURES for d in kind.draw(view)}
    assert set(drawings) == {"headline", "calibration", "distributions"}
    said = [
        cell.text for column in shown.columns for cell in column.cells if "most errors" in cell.text
    ]
    assert len(said) == 2
    assert all("most errors 2.0 times larger than claimed" in text for text in said)


def _verdicts(scenario, estimators, trials):
    summary = ib.run(scenario, estimators, trials)
    return summary[summary["parameter"] == "all"].set_index("estimator")


@pytest.mark.slow
def test_an_ekf_at_scale_300_is_outside_and_gauss_newton_on_the_same_trials_is_not():
    bench = ib.Scenario(ib.measurements.Gins(), ib.noise.Quantization(), error_scale=300.0)
    rows = _verdicts(
        bench, {"ekf": ib.baselines.EKF(), "gauss_newton": ib.baselines.GaussNewton()}, 100
    )
    assert rows.loc["ekf", "calibration_p"] < 1e-6
    assert "times larger than claimed" in rows.loc["ekf", "calibration"]
    assert rows.loc["gauss_newton", "calibration"] == INSIDE
