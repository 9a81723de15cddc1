"""`auto` and `progressive`: the least-squares answer everywhere, when a better fit is looked for,
and its cost."""

import numpy as np
import pytest
from numpy.typing import NDArray
from shared.small_models import Written

from ipe_bench.baselines import GaussNewton, LevenbergMarquardt
from ipe_bench.basics.linalg import Covariance, deviations
from ipe_bench.basics.statuses import Status
from ipe_bench.measurements import Bearings, Formula, Gins, LotkaVolterra, Polynomial, Ranging, Sir
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import Gaussian, Quantization, Unknown
from ipe_bench.real.fits import Fit, fit
from ipe_bench.solvers import Auto, FixedPoint, Newton, Progressive
from ipe_bench.solvers.auto import CHORDS, PROGRESSIVE
from ipe_bench.solvers.starts import _stream
from ipe_bench.trials.roots import least_squares_root
from ipe_bench.trials.scenario import Scenario
from ipe_bench.trials.scoring import Block


def off_the_minimum(scenario: Scenario, trials: int):
    """What `auto` finds, and how far it is from the minimum next to the truth, in deviations."""
    problem, drawn = scenario.problem, scenario.draw(0, trials)
    with np.errstate(all="ignore"):
        found = Auto().estimate(problem, drawn.z)
        root = least_squares_root(problem, drawn.z, drawn.x, prior=None)
    return found, np.abs((found.x - root) / deviations(found.covariance))


@pytest.mark.parametrize("scale", [1.0, 33.0, 100.0, 1000.0])
def test_it_finds_the_least_squares_minimum_next_to_the_truth(scale):
    _, off = off_the_minimum(Scenario(Gins(), Quantization(0.02286), error_scale=scale), 20)
    assert off.max() < 1e-3


def test_of_minima_that_fit_alike_the_most_probable_one_counts():
    """A cubic has three roots; the answer is the one of them, of those found, whose posterior
    density is largest."""
    model = Written(lambda a: (a**3 - 3 * a, 2 * (a**3 - 3 * a)), first=0.9)
    problem = Problem(model, Covariance(np.full(2, 0.01)), np.array([1.0]))
    level = np.linspace(-1.8, 1.8, 25)
    found = Auto(confirmations=8).estimate(problem, level[:, None] * [1.0, 2.0])
    several = 0
    for x, others in zip(found.x, found.alternatives or (), strict=True):
        several += len(others) > 0
        assert (np.abs(x - 0.9) <= np.abs(others - 0.9) + 1e-6).all()
    assert several > 5


def test_looks_end_where_two_led_to_the_answer_again_and_they_cost_much_more_than_the_fit():
    scenario = Scenario(Ranging(), Gaussian(0.1), error_scale=100.0)
    problem, z = scenario.problem, scenario.draw(0, 40).z
    few, all_four = (one.estimate(problem, z) for one in (Auto(), Auto(confirmations=4)))
    cost, most = (e.simulations + problem.measurement.n * e.jacobians for e in (few, all_four))
    looked = np.isfinite(few.extras["ambiguous"])
    assert looked.sum() > 15
    assert (cost <= most).all()
    assert np.median(cost[looked]) < 0.7 * np.median(most[looked])
    off = np.abs(few.x - all_four.x) / deviations(all_four.covariance)
    assert off.max() < 1e-5
    first = Auto(confirmations=0).estimate(problem, z)
    fit = first.simulations + problem.measurement.n * first.jacobians
    saved = cost < most
    assert (cost[saved] >= 4 * fit[saved]).all()


def test_looks_that_find_another_minimum_do_not_end_early():
    """Half of a sine's copies, by a turn of its phase, fit alike: none is flagged less."""
    t = np.linspace(0.5, 8.0, 16).tolist()
    model = Formula("a*sin(w*t + p)", {"a": 2.0, "w": 1.0, "p": 0.5}, {"t": t})
    scenario = Scenario(model, Gaussian(0.1), error_scale=1.0)
    problem, z = scenario.problem, scenario.draw(0, 12).z
    few, all_four = (one.estimate(problem, z) for one in (Auto(), Auto(confirmations=4)))
    flagged, most = (np.nansum(e.extras["ambiguous"]) for e in (few, all_four))
    assert most > 5
    assert flagged >= most - 1


@pytest.mark.slow
def test_starts_of_any_size_go_beyond_a_prior_that_is_too_narrow():
    """Truths ten times as far as the prior says: draws of it alone found 13 of these 25 sines."""
    t = np.linspace(0.5, 8.0, 24).tolist()
    model = Formula("a*sin(w*t + p)", {"a": 2.0, "w": 1.0, "p": 0.5}, {"t": t})
    narrow, wide = (Scenario(model, Gaussian(0.02), error_scale=scale) for scale in (0.5, 5.0))
    found = Progressive().estimate(narrow.problem, wide.draw(0, 25).z)
    assert (found.extras["fit_p"] > 1e-6).sum() >= 17


def test_starts_of_any_size_are_the_same_whatever_the_prior_says():
    model = Formula("a*sin(w*t + p)", {"a": 2.0, "w": 1.0, "p": 0.5}, {"t": [1.0, 2.0, 3.0]})
    starts = []
    for scale in (0.1, 10.0):
        problem = Scenario(model, Gaussian(0.02), error_scale=scale).problem
        attempts = Progressive()._attempts(problem, np.zeros((1, 3)), False)
        starts.append(attempts._wide(12))
    np.testing.assert_array_equal(*starts)
    assert np.abs(starts[0]).max() > 5.0


def test_the_draws_of_no_attempt_tell_those_of_another():
    """From one stream the sizes of one attempt told all signs of another."""
    model = Formula("a*exp(-b*t)", {"a": 2.0, "b": 0.5}, {"t": [1.0, 2.0, 3.0]})
    problem = Scenario(model, Gaussian(0.02), error_scale=1.0).problem.without_prior()
    attempts = Progressive()._attempts(problem, np.zeros((1, 3)), False)
    streams = [_stream(k) for k in range(4, attempts.planned)]
    assert sorted(streams) == [*range(4, attempts.planned)]
    sizes, signs = np.abs(attempts._looked_at(7)), np.sign(attempts._wide(_stream(6)))
    assert abs(np.corrcoef(sizes.ravel(), signs.ravel())[0, 1]) < 0.4


def test_what_is_nearly_linear_costs_no_more_than_fixed_point_iteration_and_half_again():
    scenario = Scenario(Gins(), Quantization(0.02286), error_scale=10.0)
    z = scenario.draw(0, 30).z
    quick, plain = (e.estimate(scenario.problem, z) for e in (Auto(), FixedPoint()))
    assert (quick.extras["stage"] == CHORDS).all()
    cost = [np.median(e.simulations + 11 * e.jacobians) for e in (quick, plain)]
    assert cost[0] <= 1.5 * cost[1]


@pytest.mark.parametrize("scale", [1000.0, 2000.0])
def test_what_is_far_is_left_to_progressive(scale):
    """Fixed-point iteration finds no root there: less than the cost of one Jacobian goes into
    seeing that."""
    scenario = Scenario(Gins(), Quantization(0.02286), error_scale=scale)
    z = scenario.draw(0, 10).z
    with np.errstate(all="ignore"):
        chosen, thorough = (e.estimate(scenario.problem, z) for e in (Auto(), Progressive()))
    assert (chosen.extras["stage"] == PROGRESSIVE).all()
    np.testing.assert_array_equal(chosen.x, thorough.x)
    wasted = (chosen.simulations - thorough.simulations) + 11 * (
        chosen.jacobians - thorough.jacobians
    )
    assert (wasted > 0).all()
    assert np.median(wasted) < 11


def test_residuals_that_do_not_fit_are_no_answer_of_the_first_stage():
    scenario = Scenario(Polynomial(strength=0.02), Gaussian(0.1), error_scale=1.0)
    z = scenario.draw(0, 2).z
    strict = Problem(scenario.measurement, Covariance(np.full(scenario.measurement.m, 1e-4)))
    assert (Auto().estimate(scenario.problem, z).extras["stage"] == CHORDS).all()
    assert (Auto().estimate(strict, z).extras["stage"] == PROGRESSIVE).all()


@pytest.mark.parametrize(
    ("model", "scale"), [(Bearings(), 1.0), (LotkaVolterra(), 1.0)], ids=["bearings", "lotka"]
)
def test_a_jacobian_that_changes_on_the_way_is_renewed(model, scale):
    """With that of the frozen root alone, two in five of these answers are a thousandth to a tenth
    of a deviation off, and chord steps cannot see it: they converge."""
    estimates, off = off_the_minimum(Scenario(model, Gaussian(0.5), error_scale=scale), 100)
    first = estimates.extras["stage"] == CHORDS
    assert first.mean() > 0.9
    assert estimates.jacobians[first].max() >= 1
    assert off[first].max() < 1e-3


CASES = {
    "polynomial": (Polynomial(), Gaussian(0.01), (0.1, 1.0, 10.0)),
    "ranging": (Ranging(), Gaussian(0.1), (0.1, 1.0, 10.0)),
    "bearings": (Bearings(), Gaussian(0.5), (0.1, 1.0, 3.0)),
    "lotka_volterra": (LotkaVolterra(), Gaussian(0.5), (0.1, 1.0, 3.0)),
    "sir": (Sir(), Gaussian(50.0), (1.0,)),
    "gins": (Gins(), Quantization(0.02286), (1.0, 33.0, 100.0, 300.0, 1000.0, 3000.0)),
}


def test_an_attempt_counts_all_iterations_that_led_to_its_end():
    """One from several draws keeps the best of them again and again; its path shows each step."""
    model = Formula("a*exp(-b*t)+c", {"a": 5.0, "b": 0.3, "c": 1.0}, {"t": tuple(range(8))})
    scenario = Scenario(model, Gaussian(0.1))
    z = scenario.draw(0, 3).z
    attempts = Progressive()._attempts(scenario.problem.without_prior(), z, True)
    rows = np.arange(3)
    with np.errstate(all="ignore"):
        found = attempts.attempt(6, rows, attempts.attempt(0, rows, None))
    assert found.iterations.min() > 5
    assert [len(path) - 1 for path in found.history] == found.iterations.tolist()


OTHERS = (FixedPoint(), Newton(), GaussNewton(), LevenbergMarquardt(), Progressive())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "scale"), [(m, s) for m, (_, _, scales) in CASES.items() for s in scales]
)
def test_it_succeeds_as_often_as_the_best_and_costs_little_more_than_the_cheapest_that_does(
    model, scale
):
    measurement, noise, _ = CASES[model]
    block = Block.draw(Scenario(measurement, noise, error_scale=scale), 5000, 5100)

    def figures(estimator):
        with np.errstate(all="ignore"):
            estimates, scored = block.estimate(estimator)
        return scored["success"].mean(), np.median(
            estimates.simulations + measurement.n * estimates.jacobians
        )

    success, cost = figures(Auto())
    others = [figures(other) for other in OTHERS]
    assert success >= max(share for share, _ in others) - 0.01
    assert cost <= 1.5 * min((c for share, c in others if share >= success), default=np.inf)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "scale", "trial"),
    [(Gins(interval_min=30.0, readings_per_case=3), 2000.0, 1012), (Gins(), 5000.0, 22461)],
    ids=["a bad minimum is found twice", "a bad minimum of the third window draws all candidates"],
)
def test_a_search_goes_on_where_the_minimum_found_is_beyond_use(model, scale, trial):
    block = Block.draw(Scenario(model, Quantization(0.02286), error_scale=scale), trial, trial + 1)
    with np.errstate(all="ignore"):
        _, scored = block.estimate(Progressive())
    assert (scored["success"] & scored["solved"]).all()


# Better fits

PEAK = "c + A*exp(-(t-mu)**2/(2*w**2))"
T = np.linspace(0, 10, 60)


def fits(model: Formula, z: NDArray[np.float64], noise, estimator) -> Fit:
    problem = Scenario(model, noise).problem.without_prior()
    return fit(problem, z, {"it": estimator}, noise)[0]


@pytest.mark.parametrize("starts", [2, pytest.param(16, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "noise",
    [Gaussian(0.3), pytest.param(Unknown(), marks=pytest.mark.slow)],
    ids=["known level", "unknown level"],
)
def test_a_noisy_peak_is_found_from_anywhere(noise, starts):
    """From random starts, among flat lines and dips that are minima, too; an unknown level has no
    test of the fit to tell them."""
    rng = np.random.default_rng(7)
    truth = {"c": 1.0, "A": 3.0, "mu": 6.2, "w": 0.5}
    for i in range(starts):
        uniform = ((-2, 3), (0.5, 6), (0, 10), (0.1, 3))
        start = {name: float(rng.uniform(*ends)) for name, ends in zip(truth, uniform, strict=True)}
        there = Formula(PEAK, truth, {"t": T.tolist()})
        z = there.simulate(there.nominal[None])[0] + 0.3 * np.random.default_rng(
            100 + i
        ).standard_normal(60)
        best = fits(there, z, noise, LevenbergMarquardt(max_iterations=500))
        found = fits(Formula(PEAK, start, {"t": T.tolist()}), z, noise, Auto())
        assert np.sum(found.residuals**2) <= np.sum(best.residuals**2) * (1 + 1e-6), start


@pytest.mark.parametrize("noise", [Gaussian(0.05), Unknown()], ids=["known level", "unknown level"])
@pytest.mark.parametrize(
    "start",
    [
        pytest.param((0.01, 500.0), marks=pytest.mark.slow),
        (-1.0, 1.0),
        (2.0, -5.0),
        pytest.param((0.1, 1e3), marks=pytest.mark.slow),
    ],
)
def test_a_saturating_law_is_found_from_a_bad_start(start, noise):
    t = [0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 12.8, 25.6]
    truth = Formula("V*t/(K+t)", {"V": 2.0, "K": 3.0}, {"t": t})
    z = truth.simulate(truth.nominal[None])[0] + 0.05 * np.random.default_rng(3).standard_normal(9)
    best = fits(truth, z, noise, LevenbergMarquardt())
    found = fits(
        Formula("V*t/(K+t)", dict(zip("VK", start, strict=True)), {"t": t}), z, noise, Auto()
    )
    assert found.x == pytest.approx(best.x, rel=1e-4)


ANGLES = np.arange(6) * np.pi / 3
RING = [(1000 * np.cos(a), 1000 * np.sin(a), 16.0 + 14.0 * np.cos(3 * a)) for a in ANGLES]
NEAR_THE_GROUND = Ranging(beacons=(*RING, (0.0, 0.0, 10.0)))
"""Beacons of about one height: a receiver above them has an image below, where the ranges are
nearly the same."""


@pytest.mark.parametrize("estimator", [Auto(), Progressive()], ids=["auto", "progressive"])
def test_an_image_below_the_ground_is_not_believed(estimator):
    block = Block.draw(Scenario(NEAR_THE_GROUND, Gaussian(0.1), error_scale=60.0), 0, 150)
    assert block.estimate(estimator)[1]["success"].mean() >= 0.99
    assert block.estimate(LevenbergMarquardt())[1]["success"].mean() < 0.7


@pytest.mark.parametrize(
    ("model", "true", "told", "scale"),
    [(Ranging(), 3.0, 0.1, 10.0), (LotkaVolterra(), 1.0, 0.01, 1.0)],
    ids=["ranging", "lotka_volterra"],
)
@pytest.mark.parametrize("estimator", [Auto(), Progressive()], ids=["auto", "progressive"])
def test_noise_that_is_understated_is_no_reason_for_a_long_search(
    model, true, told, scale, estimator
):
    """Nothing ever fits, and draws lead to the same minimum: some ten to thirty times the first
    fit."""
    z = Scenario(model, Gaussian(true), error_scale=scale).draw(0, 4).z
    problem = Problem(model, Scenario(model, Gaussian(told)).problem.R)
    with np.errstate(all="ignore"):
        found, first = (e.estimate(problem, z) for e in (estimator, LevenbergMarquardt()))
    cost, least = (e.simulations + model.n * e.jacobians for e in (found, first))
    assert (cost <= 40 * least).all()
    assert (np.abs(found.x - first.x) < 1e-3).all()
    for i in range(4):
        assert "independent draws" in found.messages[i]
        assert "this minimum again" in found.messages[i]


UNDERSTATED = {
    "decay": ("a*exp(-b*t)+c", (5.0, 0.1, 1.0), (8.0, 0.5, 2.0), 0.1),
    "two decays": ("a*exp(-b*t)+c*exp(-d*t)", (5.0, 1.0, 1.0, 0.2), (8.0, 1.5, 2.0, 0.15), 0.05),
    "saturation": ("a*(1-exp(-b*t))", (20.0, 0.02), (9.0, 0.2), 0.1),
    "growth": ("a*exp(-b*exp(-c*t))", (10.0, 2.0, 0.1), (20.0, 5.0, 0.4), 0.4),
    "weibull": ("a-b*exp(-c*t**d)", (9.0, 8.0, 0.1, 1.5), (7.0, 6.0, 0.02, 2.4), 0.1),
}


@pytest.mark.parametrize("noise", [Gaussian(1.0), Unknown()], ids=["understated", "unknown"])
@pytest.mark.parametrize("name", UNDERSTATED)
def test_a_search_ends_where_restarts_land_on_one_point(name, noise):
    """Of noise stated ten times too small, nothing ever fits."""
    expression, start, true, deviation = UNDERSTATED[name]
    t = np.linspace(0.2, 10, 25)
    there = Formula(expression, dict(zip("abcd", true, strict=False)), {"t": t.tolist()})
    z = there.simulate(there.nominal[None])[0] + deviation * np.random.default_rng(
        3
    ).standard_normal(25)
    noise = noise if noise.estimated else Gaussian(deviation / 10)
    best = fits(there, z, noise, LevenbergMarquardt(max_iterations=500))
    found = fits(
        Formula(expression, dict(zip("abcd", start, strict=False)), {"t": t.tolist()}),
        z,
        noise,
        Auto(),
    )
    assert found.x == pytest.approx(best.x, rel=1e-3)
    assert found.simulations < 2000
    assert "this minimum again" in found.message


def test_a_search_without_an_answer_ends():
    """A sigmoid has no best fit to a growth without end: its ceiling and its middle leave for
    infinity."""
    t = np.linspace(0.2, 8, 20)
    z = np.exp(0.4 * t) + 0.05 * np.random.default_rng(5).standard_normal(20)
    model = Formula("a/(1+exp(b-c*t))", {"a": 10.0, "b": 2.0, "c": 0.5}, {"t": t.tolist()})
    found = fits(model, z, Gaussian(0.005), Auto())
    assert found.status != Status.CONVERGED
    assert found.simulations < 10_000


def test_what_fits_is_not_looked_for_again():
    scenario = Scenario(Ranging(), Gaussian(0.1), error_scale=10.0)
    found = Progressive().estimate(scenario.problem, scenario.draw(0, 30).z)
    assert not found.messages
    assert (found.simulations + 4 * found.jacobians).max() < 60
