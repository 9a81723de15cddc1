"""What is signed of an answer: intervals that hold what they promise, and readings, directions and
minima by name."""

import numpy as np
import pytest
from scipy.optimize import brentq, minimize_scalar
from scipy.stats import norm
from scipy.stats import t as t_law
from shared.oracles import assert_agrees

import ipe_bench as ib
from ipe_bench.baselines import LevenbergMarquardt, MapLM
from ipe_bench.basics.linalg import Covariance
from ipe_bench.measurements import Formula, Polynomial, Sir
from ipe_bench.measurements.known import ParameterInfo, informed
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import Correlated, Gaussian, Unknown
from ipe_bench.real.examined import examine
from ipe_bench.real.fits import fit, scaled
from ipe_bench.real.levels import maximise_likelihood, objective_of
from ipe_bench.real.profiles import (
    CONFIDENCE,
    _ahead,
    _along,
    _Side,
    half_width,
    profiles,
    wald_interval,
)
from ipe_bench.real.within_bounds import answers
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
    assert np.array(found.profiles) == pytest.approx(np.array(found.wald), abs=1e-9)
    assert not found.bent.any()
    low, high = found.bootstrap.low, found.bootstrap.high
    assert (low + high) / 2 == pytest.approx(
        found.x, abs=4 * found.standard_errors.max() / np.sqrt(500)
    )
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


@pytest.mark.parametrize("place", range(3))
def test_a_profile_of_a_linear_model_is_followed_along_its_covariance(place):
    """The slopes of the readings lead to where the covariance does: both solve the normal
    equations."""
    model = Formula("a+b*t+c*t**2", {"a": 1.0, "b": 2.0, "c": 0.5}, {"t": TIMES})
    objective = objective_of(Scenario(model, Gaussian(0.3)).problem, np.zeros((1, len(TIMES))))
    J = objective.jacobian(np.ones((1, 3)))[0]
    near = np.array([0.3, -0.2, 0.9])
    exact = _along(near, np.linalg.inv(J.T @ J), place, 2.0)
    np.testing.assert_allclose(_ahead(objective, near, place, 2.0), exact, rtol=1e-8)


@pytest.mark.oracle(
    "closed form: chi-square over one parameter, the other eliminated",
    "rise of chi-square at the ends of profiles",
    2e-3,
)
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
    for end in np.transpose(found.profiles)[1]:
        assert_agrees(chi_square(end) - least, 1.959964**2, rtol=2e-3)
    assert found.bent.any()


def _counted_rises(monkeypatch):
    """Lists the distances at which the rise of a profile is computed."""
    rise = _Side.rise
    distances = []

    def counted(side, distance, **options):
        distances.append(distance)
        return rise(side, distance, **options)

    monkeypatch.setattr(_Side, "rise", counted)
    return distances


@pytest.mark.parametrize(("decades", "low"), [(8.6, 10**-8.6), (12.9, 0.0)])
def test_an_end_is_on_a_bound_if_it_is_as_near_as_round_off(decades, low, monkeypatch):
    """And no other: of a positive parameter that starts at 1, 10^-8.6 is a value, and 10^-12.9 is
    0, where chi-square is the same, but for round-off, on a long way."""
    model = informed(
        Formula("b*t", {"b": 1.0}, {"t": (1.0,)}), (ParameterInfo("b", positive=True),)
    )
    # Chi-square rises by q^2 at a distance of `decades` below the estimate.
    q, value = norm.isf(0.025), 10.0**-decades
    problem = Problem(model, Gaussian((1 - value) / q).covariance(1))
    P = np.array([[(decades * np.log(10) / q) ** 2]])
    rises = _counted_rises(monkeypatch)
    found, _ = profiles(problem, np.array([1.0]), np.zeros(1), P)
    assert found == pytest.approx([low], rel=1e-3)
    assert len(rises) < 200


def test_a_parameter_that_the_readings_do_not_bound_has_an_open_interval():
    model = Formula("a*(1-exp(-b*t))", {"a": 10.0, "b": 1.0}, {"t": (4.0, 5.0, 6.0, 7.0)})
    z = np.array([9.92, 9.97, 10.0, 10.0])
    found = examined(model, z, Gaussian(0.1))
    assert np.isfinite(found.profiles).tolist() == [[True, True], [True, False]]
    assert found.profiles[1][1] == np.inf


@pytest.mark.campaign
@pytest.mark.parametrize("unknown", [False, True])
def test_profile_intervals_cover_the_truth_as_often_as_they_say(unknown):
    """In 1,000 simulated sets of six readings, .95 ± .02 for every parameter, where standard errors
    give less."""
    noise, rng, truth, held = Gaussian(0.8), np.random.default_rng(11), SATURATION.sizes, []
    z = SATURATION.simulate(np.ones((1, 2))) + noise.deviation * rng.standard_normal((1000, 6))
    problem, freedom = Problem(SATURATION, noise.covariance(6)), 4 if unknown else None
    estimates = LM["lm"].estimate(problem, z)
    assert estimates.covariance is not None
    residuals = problem.R.whiten(z - SATURATION.simulate(estimates.x))
    levels = np.sqrt(np.sum(residuals**2, axis=1) / 4) if unknown else np.ones(1000)
    for row, x, P, level in zip(z, estimates.x, estimates.covariance, levels, strict=True):
        wald = wald_interval(
            SATURATION, x, level * np.sqrt(np.diag(P)), half_width(CONFIDENCE, freedom)
        )
        found = profiles(scaled(problem, level), row, x, P * level**2, freedom=freedom)
        held.append([(low <= truth) & (truth <= high) for low, high in (found, wald)])
    covered, short = np.mean(held, axis=0)
    assert np.abs(covered - 0.95).max() <= 0.02
    assert short.min() < 0.93


@pytest.mark.oracle(
    "own second implementation: weighted least squares without each reading",
    "shifts of the estimate, in standard errors",
    1e-6,
)
@pytest.mark.parametrize("noise", [Gaussian(0.5), Correlated(0.5, correlation=0.6)])
def test_the_reading_that_carries_the_answer_is_named(noise):
    """Without it the estimate moves by as much as leaving it out and fitting again moves it (a
    linear model)."""
    t = np.array([0.0, 1.0, 2.0, 3.0, 20.0])
    model = Formula("a+b*t", {"a": 1.0, "b": 1.0}, {"t": tuple(t)})
    z = 1 + t + np.array([0.3, -0.2, 0.1, -0.3, 2.0])
    found, X, R = (
        examined(model, z, noise),
        np.column_stack([np.ones(5), t]),
        noise.covariance(5).matrix(),
    )
    assert np.argmax(found.shift) == 4
    for i in range(5):
        rest = np.delete(np.arange(5), i)
        weights = np.linalg.inv(R[np.ix_(rest, rest)])
        without = np.linalg.solve(X[rest].T @ weights @ X[rest], X[rest].T @ weights @ z[rest])
        moves = np.abs((without - found.x) / found.standard_errors)
        assert_agrees(found.shift[i], moves.max(), rtol=1e-6)
        assert found.moved[i] == np.argmax(moves)


@pytest.mark.oracle(
    "closed form: errors of a straight line and of a further reading",
    "prediction and its errors",
    1e-5,
)
@pytest.mark.parametrize("unknown", [False, True])
def test_rows_without_a_reading_are_predicted_with_their_band(unknown):
    """A straight line beyond its readings: the textbook's error of the line and of a further
    reading there."""
    t = np.array([0.0, 1.0, 2.0, 3.0, 7.0, 20.0])
    z = np.array([0.8, 2.3, 2.9, 4.2, np.nan, np.nan])
    model = Formula("a+b*t", {"a": 1.0, "b": 1.0}, {"t": tuple(t)})
    found = examined(model, z, Unknown() if unknown else Gaussian(0.5))
    b, a = np.polyfit(t[:4], z[:4], 1)
    assert found.fitted == pytest.approx(a + b * t, rel=1e-7)
    sigma = np.sqrt(np.sum((z[:4] - a - b * t[:4]) ** 2) / 2) if unknown else 0.5
    of_line = sigma * np.sqrt(1 / 4 + (t - 1.5) ** 2 / np.sum((t[:4] - 1.5) ** 2))
    assert_agrees(found.fitted_errors, of_line, rtol=1e-5)
    assert_agrees(found.new_errors, np.hypot(of_line, sigma), rtol=1e-5)
    assert np.isnan(found.shift).tolist() == [False] * 4 + [True] * 2


def test_another_minimum_that_fits_as_well_is_told():
    """a and b of exp(-a t) + exp(-b t) can be exchanged; a phase has a lower minimum than the one
    near its start."""
    model = Formula(
        "exp(-a*t)+exp(-b*t)", {"a": 1.0, "b": 2.0}, {"t": tuple(np.linspace(0.1, 3, 20))}
    )
    z = model.simulate(np.array([[1.0, 1.0]]))[0] + 0.005 * np.random.default_rng(
        1
    ).standard_normal(20)
    found = examined(model, z, Gaussian(0.005))
    assert found.least
    assert any(one.x == pytest.approx(found.x[::-1], rel=1e-3) for one in found.ambiguous)


def test_a_lower_minimum_that_the_examination_finds_is_the_answer():
    t = tuple(np.linspace(0, 10, 40))
    model = Formula("sin(w*t)", {"w": 1.0}, {"t": t})
    truth = Formula("sin(w*t)", {"w": 2.0}, {"t": t})
    z = truth.simulate(np.ones((1, 1)))[0] + 0.1 * np.random.default_rng(3).standard_normal(40)
    answer = ib.estimate(model, z, LM, noise=Unknown())
    assert answer[0].x[0] != pytest.approx(2.0, rel=0.05)
    assert answer[0].beaten_by == "search"
    assert not answer[0].passes
    assert answer.examination.least
    assert answer["search"].x[0] == pytest.approx(2.0, rel=0.02)
    assert answer.examination.label == "search"
    assert answer.passes
    assert answer.finding().startswith("w = 1.9961 ± 0.0044 by search")


def test_a_profile_that_comes_upon_a_better_fit_is_no_interval():
    """Of (a^2 - 1) / 2 and (a - 1) / 10, both read as 0: the readings fit best at a = 1, and better
    at -.98 than around it."""
    model = Formula("s*(a**2-1)/2 + (1-s)*(a-1)/10", {"a": -1.0}, {"s": (1.0, 0.0)})
    found = examined(model, np.zeros(2), Gaussian(1.0))
    assert found.x == pytest.approx([-0.98], abs=0.005)
    assert np.isnan(found.profiles).all()
    assert found.minima[0].x == pytest.approx([1.0], abs=1e-3)


def test_readings_without_a_minimum_have_no_answer():
    """A search that begins where the model has no value is none of those that intervals count."""
    model = Formula("log(a)*t", {"a": 1.0}, {"t": (1.0, 2.0, 3.0)})
    z = np.tile([0.1, 0.2, 0.3], (2, 1))
    values, found = answers(Problem(model, Covariance(np.ones(3))), z, np.array([[0.5], [-1.5]]))
    assert found.tolist() == [True, False]
    assert values[0, 0] == pytest.approx(np.exp(0.1))


def test_a_prior_that_counts_in_no_estimate_is_told():
    known, z, said = (
        {"a": {"deviation": 0.1}},
        SATURATION.simulate(np.ones((1, 2)))[0],
        "prior of a counts in no",
    )
    assert said in str(ib.estimate(SATURATION, z, LM, noise=Gaussian(0.4), parameters=known))
    assert said not in str(ib.estimate(SATURATION, z, LM, noise=Gaussian(0.4), error_scale=1.0))
    assert said not in str(
        ib.estimate(SATURATION, z, {"map": MapLM()}, noise=Gaussian(0.4), parameters=known)
    )


def test_an_answer_is_a_frame_too():
    z = Scenario(Sir(), Gaussian(20.0)).draw(0, 1).z[0]
    table = ib.estimate(Sir(), z, LM).table()
    assert list(table["parameter"]) == ["ln_beta", "ln_gamma", "ln_odds"]
    assert (table["low95"] < table["estimate"]).all()
    assert (table["estimate"] < table["high95"]).all()
    assert table["passes"].all()


@pytest.mark.slow
def test_a_profile_follows_a_positive_parameter_over_decades():
    """Of Michaelis and Menten's curve, read where it is nearly straight: the limits by a scan of
    the sum of squares, in which V is linear."""
    x = np.linspace(0.1, 2, 20)
    z = 20 * x / (20 + x) + 0.08 * np.random.default_rng(0).standard_normal(20)
    model = Formula("V*x/(K+x)", {"V": 1.0, "K": 1.0}, {"x": tuple(x.tolist())})
    known = {name: {"positive": True} for name in ("V", "K")}
    found = ib.estimate(model, z, LM, parameters=known).examination

    def squares(K):
        f = x / (K + x)
        return np.sum((z - f * (f @ z) / (f @ f)) ** 2)

    limit = squares(found.x[1]) * (1 + t_law.ppf(0.975, 18) ** 2 / 18)
    low, high = found.profiles
    assert low[1] == pytest.approx(brentq(lambda K: squares(K) - limit, 1, found.x[1]), rel=1e-4)
    assert squares(1e8) < limit
    assert high.tolist() == [np.inf, np.inf]


def logistic(z, k, m):
    """Fits L / (1 + exp(-k (t - m))) to readings at t = 0, 1, ... 10 from near its minimum."""
    t = np.linspace(0.0, 10.0, 11)
    start = {"L": float(z.max()), "k": k, "m": m}
    return t, Formula("L/(1+exp(-k*(t-m)))", start, {"t": t.tolist()})


def test_ends_of_a_profile_are_found_where_the_standard_error_is_no_size():
    """Noisy readings of a logistic that may be a step: the standard error of its steepness is many
    times the steepness. The end is held against the linear model that is left where steepness and
    place are known."""
    z = np.array([0.0526, 0.0188, 0.0054, -0.0162, 0.0747, 0.0964, 0.1092, 0.0962, 0.1320, 0.1089])
    z = np.append(z, 0.1467)
    t, model = logistic(z, 10.0, 3.93)
    problem = Problem(model, Covariance(np.full(11, 0.0262)))
    x = np.array([0.1149 / z.max(), 25.4 / 10.0, 3.9755 / 3.93])
    x = maximise_likelihood(problem, z[None], x[None]).x[0]
    J = model.jacobian(x[None])[0] / 0.0262
    P = np.linalg.inv(J.T @ J + 1e-14 * np.eye(3))
    assert np.sqrt(P[1, 1]) > 1e6
    low, _ = profiles(problem, z, x, P, places=(1,), signs=(-1,))

    def squares(k, m):
        g = 1 / (1 + np.exp(-k * (t - m)))
        return np.sum((z - (g @ z) / (g @ g) * g) ** 2) / 0.0262**2

    least = np.sum((z - model.simulate(x[None])[0]) ** 2) / 0.0262**2
    risen = minimize_scalar(lambda m: squares(low[0], m), (5.0, 20.0)).fun
    assert risen - least == pytest.approx(norm.ppf(0.975) ** 2, rel=1e-4)


def test_a_profile_goes_on_where_the_slopes_of_an_exponential_overflow():
    """A logistic with one reading on its rise: its steepness has no upper end, since a step that is
    however steep meets that reading."""
    z = np.array(
        [-0.0056, 0.0055, -0.0013, 0.0052, 0.1683, 0.4226, 0.4329, 0.43, 0.435, 0.42, 0.43]
    )
    t, model = logistic(z, 4.4, 4.1)
    problem = Problem(model, Covariance(np.full(11, 0.007)))
    found = maximise_likelihood(problem, z[None], model.nominal[None])
    P = found.covariance[0]
    _, high = profiles(problem, z, found.x[0], P, places=(1,), signs=(1,))
    meets_it = np.where(t == 4, z, np.where(t > 4, z[t > 4].mean(), 0.0))
    step = np.sum((z - meets_it) ** 2) / 0.007**2
    assert step < found.chi_square[0] + norm.ppf(0.975) ** 2
    assert high[0] == np.inf


def test_without_draws_there_are_no_bootstrap_intervals():
    model = Polynomial(strength=0.0)
    z = Scenario(model, Gaussian(0.01)).draw(0, 1).z[0]
    problem = Problem(model, Gaussian(0.01).covariance(model.m))
    found = examine(problem, z, fit(problem, z, LM, Gaussian(0.01)), bootstraps=0)
    assert np.isnan(found.bootstrap.low).all()
    assert np.isnan(found.bootstrap.high).all()


def ends(formula, start, t, z):
    """The profile intervals by name, and the sum of squares at their ends."""
    model = Formula(formula, start, {"t": t.tolist()})
    found = ib.estimate(model, z, {"lm": LevenbergMarquardt()}).examination
    freedom = len(z) - model.n
    limit = found.chi_square * found.problem.R.deviations[0] ** 2
    limit *= 1 + t_law.ppf(0.975, freedom) ** 2 / freedom
    return dict(zip(start, np.transpose(found.profiles), strict=True)), limit


def test_an_end_is_that_of_the_lowest_valley_and_a_flat_profile_has_none():
    """Noisy readings of Hill's curve, which a step fits nearly as well: the end of the place is by
    a scan over all steepnesses, in which the height is linear."""
    t = np.linspace(0.2, 6.0, 18)
    z = np.array([-0.126, 0.164, 0.204, 0.166, 0.218, 0.089, 1.277, 1.048, 1.949, 1.606, 1.568])
    z = np.append(z, [1.399, 2.067, 1.591, 2.241, 1.725, 1.931, 1.475])
    found, limit = ends("V*t^n/(K^n+t^n)", {"V": 1.8, "K": 2.2, "n": 9.0}, t, z)

    def squares(K, n):
        f = 1 / (1 + (K / t) ** n)
        return np.sum((z - (f @ z) / (f @ f) * f) ** 2)

    # Steps have the same curve between two readings, and the end is close to the lower one.
    assert min(squares(1.93, n) for n in np.geomspace(1.0, 250.0, 4000)) < limit
    assert t[5] < found["K"][0] < 1.93
    assert found["n"][1] == np.inf
    assert min(squares(K, 250.0) for K in np.linspace(2.0, 2.6, 200)) < limit


def test_a_profile_that_jumps_beyond_zero_ends_there():
    """Of Gompertz's curve: as a goes to 0 an exponential growth makes up for it, and a curve that
    is negative cannot."""
    t = np.linspace(0.0, 8.0, 11)
    z = np.array([1.168, 0.422, 1.402, 2.491, 3.726, 1.156, 2.954, 2.794, 2.416, 3.665, 3.393])
    found, limit = ends("a*exp(-b*exp(-c*t))", {"a": 3.3, "b": 1.5, "c": 0.45}, t, z)
    assert found["a"].tolist() == [pytest.approx(0.0, abs=1e-6), np.inf]
    small = 1e-7 * np.exp(16.43 * np.exp(0.00722 * t))
    assert np.sum((z - small) ** 2) < limit < np.sum(z**2)


def test_a_profile_that_is_lost_on_the_way_to_where_the_other_end_comes_from_has_no_end():
    """Of a + b t^c the factor is 0 only if the curve is a constant, which the readings exclude; a
    negative factor, with a curve that goes on rising, they do not."""
    t = np.linspace(0.2, 8.0, 17)
    z = np.array([2.167, 1.867, 1.965, 4.159, 5.531, 4.142, 2.56, 3.134, 6.478, 4.995, 2.848])
    z = np.append(z, [5.059, 3.941, 4.782, 5.14, 5.048, 6.768])
    found, limit = ends("a+b*t^c", {"a": 0.9, "b": 2.0, "c": 0.4}, t, z)
    assert found["b"].tolist() == [-np.inf, np.inf]
    assert np.sum((z - np.mean(z)) ** 2) > limit
    curves = (-2.0 * t**c for c in np.linspace(-1.0, -0.1, 100))
    assert min(np.sum((z - h - np.mean(z - h)) ** 2) for h in curves) < limit
