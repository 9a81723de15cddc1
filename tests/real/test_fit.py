"""Fits of one file of readings: what they find, and what they say of the model."""

from importlib.resources import files
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.stats import binom, chi2, kstest
from shared.oracles import assert_agrees
from shared.state_models import ConstantVelocity

import ipe_bench as ib
from ipe_bench.baselines import EKF, UKF, GaussNewton, LevenbergMarquardt, LinearLSE
from ipe_bench.basics.statuses import Status
from ipe_bench.measurements import Gins, Polynomial
from ipe_bench.noise import Gaussian, Quantization, Unknown
from ipe_bench.priors import GaussianPrior
from ipe_bench.real.fits import fit
from ipe_bench.real.logs import Log
from ipe_bench.report.page.answer import between, with_error
from ipe_bench.solvers import Newton, Progressive
from ipe_bench.trials.scenario import Scenario

SAMPLES = Path(str(files("ipe_bench.real") / "samples"))


def test_missing_readings_are_no_obstacle_to_any_estimator():
    """Ten readings gone: every estimator still finds the truth, within 5 of the standard errors
    that it states."""
    scenario = Scenario(Gins(), Gaussian(0.0066), GaussianPrior(), 10.0)
    trial = scenario.draw(0, 1)
    z = trial.z[0].copy()
    z[np.random.default_rng(0).choice(len(z), 10, replace=False)] = np.nan
    estimators = {
        type(e).__name__: e for e in (Newton(), GaussNewton(), Progressive(), EKF(), UKF())
    }
    for one in fit(scenario.problem, z, estimators):
        assert one.status is Status.CONVERGED, one.label
        assert one.degrees_of_freedom == 230 - 11
        truth = trial.x[0] * scenario.measurement.sizes
        assert (np.abs(one.x - truth) < 5 * one.standard_errors).all(), one.label
        assert (np.isnan(one.residuals) == np.isnan(z)).all()
        assert not one.outliers.any()
        assert one.fits
        assert np.allclose(np.diagonal(one.correlation), 1.0)


def test_masked_readings_are_missing_whatever_lies_under_the_mask():
    scenario = Scenario(Polynomial(), Gaussian(0.01))
    z = scenario.draw(0, 1).z[0]
    masked, missing = np.ma.masked_array(z.copy(), mask=np.arange(len(z)) == 3), z.copy()
    masked.data[3], missing[3] = 1e3, np.nan
    (one,), (other,) = (
        ib.estimate(scenario.measurement, given, {"gn": GaussNewton()}, noise=Gaussian(0.01))
        for given in (masked, missing)
    )
    assert one.fits
    assert np.array_equal(one.x, other.x)
    model = ConstantVelocity(count=12)
    log = np.ma.masked_array(model.draw(0, 1).z[0], mask=np.arange(12)[:, None] == 3)
    assert np.array_equal(Log.of(model, log).z, log.filled(np.nan), equal_nan=True)


@pytest.mark.oracle(
    "published: R's nls of BOD, the data of Bates and Watts, Nonlinear Regression Analysis (1988)",
    "estimates, standard errors and residual standard deviation of the oxygen demand",
    5e-4,
)
def test_the_oxygen_demand_of_bates_and_watts_is_estimated_as_r_estimates_it():
    """R prints A = 19.1426 (2.4959), lrc = log b2 = -0.6328 (0.3824), and 2.549."""
    t, y = np.loadtxt(SAMPLES / "oxygen.csv", delimiter=",", skiprows=1).T
    model = ib.measurements.Formula("b1*(1-exp(-b2*t))", {"b1": 20.0, "b2": 0.5}, {"t": t.tolist()})
    (found,) = fit(
        Scenario(model, Unknown()).problem, y, {"lm": LevenbergMarquardt(tolerance=1e-9)}, Unknown()
    )
    (b1, b2), (e1, e2) = found.x, found.standard_errors
    assert_agrees(
        [b1, np.log(b2), e1, e2 / b2, found.level],
        [19.1426, -0.6328, 2.4959, 0.3824, 2.549],
        rtol=5e-4,
    )


def test_the_chi_square_test_rejects_a_true_model_as_often_as_it_says_and_a_wrong_one_always():
    scenario = Scenario(Polynomial(), Gaussian(0.01), GaussianPrior(), 0.1)
    optimist = Scenario(Polynomial(), Gaussian(0.005), GaussianPrior(), 0.1).problem
    z = scenario.draw(0, 200).z
    estimator = {"gauss_newton": GaussNewton()}
    p = np.array([fit(scenario.problem, row, estimator)[0].p_value for row in z])
    assert binom.ppf(0.0005, 200, 0.1) <= np.sum(p < 0.1) <= binom.ppf(0.9995, 200, 0.1)
    assert not any(fit(optimist, row, estimator)[0].fits for row in z[:10])


def test_rounded_readings_are_held_to_the_law_of_rounding():
    """Uniform errors have a chi-square of .4 of the variance: 20 % too large a sum is then
    improbable."""
    noise = Quantization(0.3, dither=True)
    scenario = Scenario(Polynomial(), noise, GaussianPrior(), 0.1)
    z = scenario.draw(0, 500).z
    estimator = {"gauss_newton": GaussNewton()}
    found = [fit(scenario.problem, row, estimator, noise)[0] for row in z]
    p = np.array([f.p_value for f in found])
    assert kstest(p, "uniform").pvalue > 0.01
    assert (
        kstest([chi2.sf(f.chi_square, f.degrees_of_freedom) for f in found], "uniform").pvalue
        < 0.01
    )


@pytest.mark.parametrize(
    ("value", "error", "expected"),
    [
        (870.0074, 1.62, "870.0 ± 1.6"),
        (-0.0653277, 2.3e-5, "-0.065328 ± 0.000023"),
        (1.292e-3, 1.1e-7, "(1.29200 ± 0.00011)e-3"),
        (12345.6, 678.0, "12350 ± 680"),
        (1.0, 0.0999, "1.00 ± 0.10"),
        (3.5, float("nan"), "3.5"),
        (float("nan"), 1.0, "-"),
        (2.5e198, 3.1e180, "2.5e+198 ± 3.1e+180"),
    ],
)
def test_a_value_is_shown_to_two_figures_of_its_error(value, error, expected):
    assert with_error(value, error) == expected


@pytest.mark.parametrize("half", [0.0123, 0.0201, 0.045, 0.099])
def test_ends_of_an_interval_have_the_figures_of_its_width(half):
    """About the middle of an interval they are those without an estimate, and the ends are off by
    at most half a hundredth of what lies between them."""
    low, high = 5.0 - half, 5.0 + half
    shown = between(low, high, 5.0)
    assert shown == between(low, high, float("nan"))
    ends = [float(end) for end in shown.split(" … ")]
    np.testing.assert_allclose(ends, [low, high], rtol=0, atol=0.005 * (high - low))


def test_of_two_fits_with_noise_of_their_own_size_the_worse_is_beaten():
    """Residuals that made their own R are as large as it says in both; the sums of squares tell
    them apart."""
    t = np.linspace(0, 10, 40)
    model = ib.measurements.Formula("a*sin(w*t)", {"a": 1.0, "w": 2.0}, {"t": t.tolist()})
    z = 1.5 * np.sin(2.2 * t) + 0.05 * np.random.default_rng(0).normal(size=40)
    near, far = ib.estimate(
        model, z, {"near": LevenbergMarquardt(start="nominal"), "far": LinearLSE()}, noise=Unknown()
    ).fits
    assert near.chi_square == pytest.approx(far.chi_square)
    for one in (near, far):
        assert one.deviance == pytest.approx(
            np.sum((z - model.simulate(one.x[None] / model.sizes)[0]) ** 2)
        )
    assert (near.beaten_by, far.beaten_by) == ("", "near")


def test_an_estimate_that_has_not_converged_does_not_pass_however_well_it_fits():
    t = np.linspace(0, 10, 40)
    model = ib.measurements.Formula("a*sin(w*t)", {"a": 1.0, "w": 2.0}, {"t": t.tolist()})
    z = 1.2 * np.sin(2.02 * t) + 0.05 * np.random.default_rng(0).normal(size=40)
    hasty = LevenbergMarquardt(start="nominal", max_iterations=4, tolerance=1e-14)
    (found,) = ib.estimate(model, z, {"hasty": hasty}, noise=Gaussian(0.05)).fits
    assert (found.fits, found.passes) == (True, False)


def test_a_fit_without_its_examination_is_the_same_fit():
    model = Polynomial()
    z = Scenario(model, Gaussian(0.01), error_scale=3.0).draw(0, 1).z[0]
    lm = {"lm": LevenbergMarquardt()}
    whole = ib.estimate(model, z, lm, noise=Gaussian(0.01))
    alone = ib.estimate(model, z, lm, noise=Gaussian(0.01), examine=False)
    assert whole.examination is not None
    assert alone.examination is None
    assert alone.passes
    assert np.array_equal(alone["lm"].x, whole["lm"].x)
    assert np.array_equal(alone["lm"].covariance, whole["lm"].covariance)


@pytest.mark.parametrize("model", [Polynomial(), ConstantVelocity()])
@pytest.mark.parametrize("table", [pd.DataFrame({"t": [1.0], "y": [2.0]}), {"t": [1.0], "y": [2]}])
def test_a_table_in_memory_is_refused_with_a_way_out(model, table):
    with pytest.raises(ib.UserError, match=r"is a table of t, y; write it to a file"):
        ib.estimate(model, table)
