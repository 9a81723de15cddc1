"""What is signed of an answer: intervals that hold what they promise, and readings, directions and minima by name."""

import numpy as np
import pytest

import ipe_bench as ib
from ipe_bench.baselines import LevenbergMarquardt, LinearLSE
from ipe_bench.measurements import Formula, Mgh, Ode, Polynomial, Sir
from ipe_bench.measurements.known import ParameterInfo, informed
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import Gaussian, Unknown
from ipe_bench.real.examination import examine
from ipe_bench.real.fits import fit
from ipe_bench.real.profiles import profiles
from ipe_bench.report.answer import remarks
from ipe_bench.trials.scenario import Scenario

LM = {"lm": LevenbergMarquardt(tolerance=1e-9, max_iterations=500)}
TIMES = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0)
SATURATION = Formula("a*(1-exp(-b*t))", {"a": 10.0, "b": 0.4}, {"t": TIMES})


def examined(model, z, noise):
    problem = Problem(model, noise.covariance(model.m))
    return examine(problem, z, fit(problem, z, LM, noise))


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


@pytest.mark.parametrize("readings", [4, 6, 12])
def test_bootstrap_with_an_estimated_level_is_as_wide_as_students_t(readings):
    """Of a straight line, whose intervals are exact."""
    t = tuple(np.linspace(0.0, 1.0, readings))
    model = Formula("a+b*t", {"a": 0.0, "b": 0.0}, {"t": t})
    z = 1.0 + 2.0 * np.array(t) + 0.1 * np.random.default_rng(8).standard_normal(readings)
    problem = Problem(model, Gaussian(1.0).covariance(readings))
    found = examine(problem, z, fit(problem, z, LM, Unknown()), bootstraps=4000)
    low, high = found.wald
    assert found.bootstrap.high - found.bootstrap.low == pytest.approx(high - low, rel=0.1)
    assert found.bootstrap.bias == pytest.approx(0.0, abs=4 * found.standard_errors.max() / np.sqrt(4000))


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


def test_values_of_a_profile_are_on_a_bound_where_they_are_as_near_as_round_off():
    """And no others: of a positive parameter that starts at 1, 10^-8.6 is a value, and 10^-12.9 is 0."""
    model = informed(Formula("b*t", {"b": 1.0}, {"t": (1.0,)}), (ParameterInfo("b", positive=True),))
    deviation = 8.6 * np.log(10) / 1.959964
    problem = Problem(model, Gaussian(20.0).covariance(1))
    ((found,),) = profiles(problem, np.array([[1.0]]), np.zeros((1, 1)), np.array([[[deviation**2]]]))
    assert found.values[found.values < 1] == pytest.approx([0.0] * np.sum(found.values == 0) + [10**-8.6, 10**-4.3])
    assert pytest.approx(min(found.values[found.values > 0]), rel=1e-4) == 10**-8.6
    assert np.sum(found.values == 0) > 0
    assert found.low == 0.0


def test_a_parameter_that_the_readings_do_not_bound_has_an_open_interval():
    model = Formula("a*(1-exp(-b*t))", {"a": 10.0, "b": 1.0}, {"t": (4.0, 5.0, 6.0, 7.0)})
    z = np.array([9.92, 9.97, 10.0, 10.0])
    found = examined(model, z, Gaussian(0.1))
    assert np.isfinite(found.profiles[1].low)
    assert found.profiles[1].high == np.inf
    assert np.isfinite([found.profiles[0].low, found.profiles[0].high]).all()


def coverage(found, truth) -> tuple[np.ndarray, np.ndarray]:
    """The shares (n,) of sets whose intervals hold the truth: of profiles, and of standard errors."""
    profile = [[one.low <= x <= one.high for one, x in zip(row, truth, strict=True)] for row in found]
    wald = [[one.wald[0] <= x <= one.wald[1] for one, x in zip(row, truth, strict=True)] for row in found]
    return np.mean(profile, axis=0), np.mean(wald, axis=0)


@pytest.mark.slow
@pytest.mark.parametrize("unknown", [False, True])
def test_profile_intervals_cover_the_truth_as_often_as_they_say(unknown):
    """In 1,000 simulated sets of six readings, .95 ± .02 for every parameter, where standard errors give less."""
    noise, rng = Gaussian(0.8), np.random.default_rng(11)
    z = SATURATION.simulate(np.ones((1, 2))) + noise.deviation * rng.standard_normal((1000, 6))
    problem = Problem(SATURATION, noise.covariance(6))
    estimates = LM["lm"].estimate(problem, z)
    P, options = estimates.covariance, {}
    if unknown:
        residuals = z - SATURATION.simulate(estimates.x)
        levels = np.sqrt(np.sum(problem.R.whiten(residuals) ** 2, axis=1) / 4)
        P, options = P * levels[:, None, None] ** 2, {"levels": levels, "freedom": 4}
    covered, short = coverage(profiles(problem, z, estimates.x, P, **options), SATURATION.sizes)
    assert np.abs(covered - 0.95).max() <= 0.02
    assert short.min() < 0.93


@pytest.mark.slow
def test_profile_intervals_of_an_epidemic_counted_four_times_cover_the_truth():
    """In 1,000 simulated epidemics of the boarding school, counted on four days with errors of 20 boys: .95 ± .02 for
    every parameter, where standard errors give .89 for the first infected."""
    model = Ode(
        {"s": "-beta*s*i/763", "i": "beta*s*i/763-gamma*i"},
        {"beta": 1.66, "gamma": 0.44, "i0": 1.0},
        {"s": "763-i0", "i": "i0"},
        {"infected": "i"},
        (2.0, 4.0, 6.0, 8.0),
    )
    z = model.simulate(model.nominal[None]) + 20.0 * np.random.default_rng(11).standard_normal((1000, 4))
    problem = Problem(model, Gaussian(20.0).covariance(4))
    estimates = LM["lm"].estimate(problem, z)
    found = profiles(problem, z, estimates.x, estimates.covariance)
    covered, short = coverage(found, model.physical(model.nominal[None])[0])
    assert np.abs(covered - 0.95).max() <= 0.02
    assert short[2] < 0.91


def test_profiles_of_many_sets_are_those_of_each():
    z = SATURATION.simulate(np.ones((1, 2))) + 0.8 * np.random.default_rng(12).standard_normal((5, 6))
    problem = Problem(SATURATION, Gaussian(0.8).covariance(6))
    estimates, levels = LM["lm"].estimate(problem, z), np.linspace(0.5, 2.0, 5)
    P = estimates.covariance * levels[:, None, None] ** 2
    together = profiles(problem, z, estimates.x, P, levels=levels, freedom=4)
    for k in range(5):
        scaled = Problem(SATURATION, Gaussian(0.8 * levels[k]).covariance(6))
        (alone,) = profiles(scaled, z[[k]], estimates.x[[k]], P[[k]], freedom=4)
        for one, other in zip(together[k], alone, strict=True):
            assert (one.low, one.high) == pytest.approx((other.low, other.high), rel=1e-4)


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
        # Cook's distance: how far the answer moves in its own region, per parameter.
        change, A = without - found.x, np.column_stack([np.ones(5), t]) / 0.5
        assert found.influence.cook[i] == pytest.approx(np.sum((A @ change) ** 2) / 2, rel=1e-6)
    assert found.influence.leverage.sum() == pytest.approx(2.0)


@pytest.mark.parametrize("unknown", [False, True])
def test_rows_without_a_reading_are_predicted_with_their_band(unknown):
    """A straight line beyond its readings: the textbook's error of the line and of a further reading there."""
    t = np.array([0.0, 1.0, 2.0, 3.0, 7.0, 20.0])
    z = np.array([0.8, 2.3, 2.9, 4.2, np.nan, np.nan])
    model = Formula("a+b*t", {"a": 1.0, "b": 1.0}, {"t": tuple(t)})
    found = examined(model, z, Unknown() if unknown else Gaussian(0.5))
    b, a = np.polyfit(t[:4], z[:4], 1)
    assert found.fitted == pytest.approx(a + b * t, rel=1e-7)
    sigma = np.sqrt(np.sum((z[:4] - a - b * t[:4]) ** 2) / 2) if unknown else 0.5
    of_line = sigma * np.sqrt(1 / 4 + (t - 1.5) ** 2 / np.sum((t[:4] - 1.5) ** 2))
    assert found.fitted_errors == pytest.approx(of_line, rel=1e-5)
    assert found.new_errors == pytest.approx(np.hypot(of_line, sigma), rel=1e-5)
    assert np.isnan(found.influence.leverage).tolist() == [False] * 4 + [True] * 2


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
    (told,) = [line for line in remarks(found, [{}] * model.m) if line.startswith("Least observable")]
    change = np.linalg.norm(np.matmul(model.jacobian(found.x[None] / model.sizes)[0], weights / model.sizes)) / 0.01
    assert f"changes all readings by {change:.2g} standard deviations" in told


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
    assert "NOT THE GLOBAL MINIMUM" in str(answer)


def test_with_as_many_readings_as_parameters_nothing_is_tested_but_a_worse_answer_is_none():
    model = Mgh("rosenbrock")
    problem = Problem(model, model.recorded.R)
    good, bad = fit(problem, model.recorded.z, {**LM, "linear": LinearLSE()})
    assert (good.fits, bad.fits) == (None, False)
    assert np.isnan(good.p_value)
    assert np.isnan(good.whiteness.p_value)


def test_an_answer_is_a_frame_too():
    z = Scenario(Sir(), Gaussian(20.0)).draw(0, 1).z[0]
    table = ib.estimate(Sir(), z, LM).table()
    assert list(table["parameter"]) == ["ln_beta", "ln_gamma", "ln_odds"]
    assert (table["low95"] < table["estimate"]).all()
    assert (table["estimate"] < table["high95"]).all()
    assert table["passes"].all()
