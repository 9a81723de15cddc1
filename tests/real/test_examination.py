"""What is signed of an answer: intervals that hold what they promise, and readings, directions and minima by name."""

from __future__ import annotations

import numpy as np
import pytest

import ipe_bench as ib
from ipe_bench.baselines import LevenbergMarquardt, LinearLSE
from ipe_bench.measurements import Formula, Mgh, Polynomial, Sir
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import Gaussian, Unknown
from ipe_bench.real.examination import examine
from ipe_bench.real.fits import fit
from ipe_bench.real.profiles import profiles
from ipe_bench.trials.scenario import Scenario

LM = {"lm": LevenbergMarquardt(tolerance=1e-9, max_iterations=500)}
TIMES = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0)
SATURATION = Formula("a*(1-exp(-b*t))", {"a": 10.0, "b": 0.4}, {"t": TIMES})


def examined(model, z, noise, level_unknown=False):
    problem = Problem(model, noise.covariance(model.m))
    return examine(problem, z, fit(problem, z, LM, level_unknown=level_unknown))


def test_profiles_of_a_linear_model_are_the_intervals_of_its_standard_errors():
    model = Polynomial(strength=0.0)
    z = Scenario(model, Gaussian(0.01)).draw(0, 1).z[0]
    found = examined(model, z, Gaussian(0.01))
    for profile, low, high in zip(found.profiles, *found.wald, strict=True):
        assert (profile.low, profile.high) == pytest.approx((low, high), abs=1e-9)
        assert not profile.bent
    low, high = found.bootstrap.low, found.bootstrap.high
    assert (low + high) / 2 == pytest.approx(found.x, abs=4 * found.standard_errors.max() / np.sqrt(500))
    assert high - low == pytest.approx(2 * 1.96 * found.standard_errors, rel=0.15)
    assert found.least
    assert not found.ambiguous


def test_ends_of_a_profile_are_where_chi_square_has_risen_by_the_quantile():
    """Against a brute-force minimisation over the other parameter, on a grid."""
    z = SATURATION.simulate(np.ones((1, 2)))[0] + 0.4 * np.random.default_rng(2).standard_normal(6)
    found = examined(SATURATION, z, Gaussian(0.4))
    t = np.array(TIMES)

    def chi_square(b):
        shape = 1 - np.exp(-b * t)
        a = (shape @ z) / (shape @ shape)
        return np.sum((z - a * shape) ** 2) / 0.16

    least = chi_square(found.x[1])
    for end in (found.profiles[1].low, found.profiles[1].high):
        assert chi_square(end) - least == pytest.approx(1.959964**2, rel=2e-3)
    assert found.profiles[1].bent or found.profiles[0].bent


def test_a_parameter_that_the_readings_do_not_bound_has_an_open_interval():
    model = Formula("a*(1-exp(-b*t))", {"a": 10.0, "b": 1.0}, {"t": (4.0, 5.0, 6.0, 7.0)})
    z = np.array([9.92, 9.97, 10.0, 10.0])
    found = examined(model, z, Gaussian(0.1))
    assert np.isfinite(found.profiles[1].low)
    assert found.profiles[1].high == np.inf
    assert np.isfinite([found.profiles[0].low, found.profiles[0].high]).all()


@pytest.mark.slow
@pytest.mark.parametrize("unknown", [False, True])
def test_profile_intervals_cover_the_truth_as_often_as_they_say(unknown):
    """In 1,000 simulated sets of six readings, .95 ± .02 for every parameter, where standard errors give less."""
    trials, noise = 1000, Gaussian(0.8)
    rng = np.random.default_rng(11)
    x, sizes = np.ones((1, 2)), SATURATION.sizes
    z = SATURATION.simulate(x) + noise.deviation * rng.standard_normal((trials, 6))
    problem = Problem(SATURATION, noise.covariance(6))
    estimates = LM["lm"].estimate(problem, z)
    freedom = 4 if unknown else None
    covered, short = np.zeros(2), np.zeros(2)
    for row, point, P in zip(z, estimates.x, estimates.covariance, strict=True):
        scaled = problem
        if unknown:
            chi_square = float(np.sum(problem.R.whiten(row - SATURATION.simulate(point[None])[0]) ** 2))
            level = np.sqrt(chi_square / 4)
            scaled, P = Problem(SATURATION, Gaussian(noise.deviation * level).covariance(6)), P * level**2
        for j, one in enumerate(profiles(scaled, row, point, P, freedom=freedom)):
            covered[j] += one.low <= sizes[j] <= one.high
            short[j] += one.wald[0] <= sizes[j] <= one.wald[1]
    assert np.abs(covered / trials - 0.95).max() <= 0.02
    assert short.min() / trials < 0.93


def test_the_reading_that_carries_the_answer_is_named():
    """Without it the estimate moves by as much as leaving it out and fitting again moves it (a linear model)."""
    t = np.array([0.0, 1.0, 2.0, 3.0, 20.0])
    model = Formula("a+b*t", {"a": 1.0, "b": 1.0}, {"t": tuple(t)})
    z = 1 + t + np.array([0.3, -0.2, 0.1, -0.3, 2.0])
    found = examined(model, z, Gaussian(0.5))
    assert np.argmax(found.influence.cook) == 4
    for i in range(5):
        rest = np.delete(np.arange(5), i)
        without = np.polyfit(t[rest], z[rest], 1)[::-1]
        moved = np.abs((without - found.x) / found.standard_errors).max()
        assert found.influence.shift[i] == pytest.approx(moved, rel=1e-6)
    assert found.influence.leverage.sum() == pytest.approx(2.0)


def test_parameters_that_the_readings_do_not_tell_apart_are_the_least_observable_direction():
    rng = np.random.default_rng(0)
    t = np.linspace(0, 1, 20)
    u = 1e-3 * rng.standard_normal(20)
    model = Formula("a*t+b*(t+u)+c", {"a": 1.0, "b": 1.0, "c": 1.0}, {"t": tuple(t), "u": tuple(u)})
    found = examined(model, model.simulate(np.ones((1, 3)))[0] + 0.01 * rng.standard_normal(20), Gaussian(0.01))
    weights = found.direction.weights
    assert weights[0] == pytest.approx(-weights[1], rel=0.05)
    assert abs(weights[2]) < 0.05 * abs(weights[0])
    assert found.direction.collinearity > 100


def test_another_minimum_that_fits_as_well_is_told():
    """a and b of exp(-a t) + exp(-b t) can be exchanged; a phase has a lower minimum than the one near its start."""
    model = Formula("exp(-a*t)+exp(-b*t)", {"a": 1.0, "b": 2.0}, {"t": tuple(np.linspace(0.1, 3, 20))})
    z = model.simulate(np.array([[1.0, 1.0]]))[0] + 0.005 * np.random.default_rng(1).standard_normal(20)
    found = examined(model, z, Gaussian(0.005))
    assert found.least
    assert any(one.x == pytest.approx(found.x[::-1], rel=1e-3) for one in found.ambiguous)


def test_an_estimate_that_is_not_the_least_minimum_does_not_pass():
    t = tuple(np.linspace(0, 10, 40))
    model = Formula("sin(w*t)", {"w": 1.0}, {"t": t})
    truth = Formula("sin(w*t)", {"w": 2.0}, {"t": t})
    z = truth.simulate(np.ones((1, 1)))[0] + 0.1 * np.random.default_rng(3).standard_normal(40)
    answer = ib.estimate(model, z, LM, noise=Unknown())
    assert answer[0].x[0] != pytest.approx(2.0, rel=0.05)
    assert not answer.examination.least
    assert answer.examination.minima[0].x[0] == pytest.approx(2.0, rel=0.02)
    assert not answer.passes
    assert "NOT THE LEAST MINIMUM" in str(answer)


def test_with_as_many_readings_as_parameters_nothing_is_tested_but_a_worse_answer_is_none():
    model = Mgh("rosenbrock")
    problem = Problem(model, model.recorded.R)
    good, bad = fit(problem, model.recorded.z, {**LM, "linear": LinearLSE()})
    assert (good.fits, bad.fits) == (None, False)
    assert np.isnan(good.p_value)
    assert np.isnan(good.whiteness.p_value)


def test_a_worse_minimum_is_a_misfit_where_the_level_is_estimated():
    z = np.array([2.0, 3.4, 4.8, 5.4, 6.9, 8.1])
    model = Formula("a*(1-exp(-b*t))", {"a": 30.0, "b": 2.0}, {"t": TIMES})
    answer = ib.estimate(model, z, {**LM, "linear": LinearLSE()})
    assert answer["linear"].fits is False
    assert answer["lm"].passes
    assert "MISFIT" in str(answer)
    assert "linear: MISFIT" in answer._repr_html_()


def test_an_answer_is_a_frame_too():
    z = Scenario(Sir(), Gaussian(20.0)).draw(0, 1).z[0]
    table = ib.estimate(Sir(), z, LM).table()
    assert list(table["parameter"]) == ["ln_beta", "ln_gamma", "ln_odds"]
    assert (table["low95"] < table["estimate"]).all()
    assert (table["estimate"] < table["high95"]).all()
    assert table["passes"].all()
