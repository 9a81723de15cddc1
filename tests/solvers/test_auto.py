"""The estimator that chooses for itself: the least-squares answer everywhere, as cheaply as the problem allows."""

import numpy as np
import pytest

from ipe_bench.baselines import GaussNewton, LevenbergMarquardt
from ipe_bench.basics.linalg import Covariance
from ipe_bench.measurements import Bearings, Gins, LotkaVolterra, Mgh, Polynomial, Ranging, Sir, Triad
from ipe_bench.measurements.mgh import score
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import Certified, Gaussian, Quantization
from ipe_bench.solvers import Auto, FixedPoint, Newton, Progressive
from ipe_bench.solvers.auto import CHORDS, PROGRESSIVE
from ipe_bench.trials.roots import least_squares_root
from ipe_bench.trials.scenario import Scenario
from ipe_bench.trials.scoring import Block


@pytest.mark.parametrize("scale", [1.0, 33.0, 100.0, 1000.0])
def test_it_finds_the_least_squares_minimum_next_to_the_truth(scale):
    scenario = Scenario(Gins(), Quantization(0.02286), error_scale=scale)
    problem, trials = scenario.problem, scenario.draw(0, 20)
    with np.errstate(all="ignore"):
        estimates = Auto().estimate(problem, trials.z)
        root = least_squares_root(problem, trials.z, trials.x, prior=None)
    deviation = np.sqrt(np.diagonal(estimates.covariance, axis1=1, axis2=2))
    assert (np.abs(estimates.x - root) / deviation).max() < 1e-3


def test_what_is_nearly_linear_costs_no_more_than_fixed_point_iteration_and_half_again():
    scenario = Scenario(Gins(), Quantization(0.02286), error_scale=10.0)
    z = scenario.draw(0, 30).z
    quick, plain = (e.estimate(scenario.problem, z) for e in (Auto(), FixedPoint()))
    assert (quick.extras["stage"] == CHORDS).all()
    cost = [np.median(e.simulations + 11 * e.jacobians) for e in (quick, plain)]
    assert cost[0] <= 1.5 * cost[1]


@pytest.mark.parametrize("scale", [1000.0, 2000.0])
def test_what_is_far_is_left_to_progressive(scale):
    """Fixed-point iteration finds no root there: less than the cost of one Jacobian goes into seeing that."""
    scenario = Scenario(Gins(), Quantization(0.02286), error_scale=scale)
    z = scenario.draw(0, 10).z
    with np.errstate(all="ignore"):
        chosen, thorough = (e.estimate(scenario.problem, z) for e in (Auto(), Progressive()))
    assert (chosen.extras["stage"] == PROGRESSIVE).all()
    np.testing.assert_array_equal(chosen.x, thorough.x)
    wasted = (chosen.simulations - thorough.simulations) + 11 * (chosen.jacobians - thorough.jacobians)
    assert (wasted > 0).all()
    assert np.median(wasted) < 11


def test_residuals_that_do_not_fit_are_no_answer_of_the_first_stage():
    scenario = Scenario(Polynomial(strength=0.02), Gaussian(0.1), error_scale=1.0)
    z = scenario.draw(0, 2).z
    strict = Problem(scenario.measurement, Covariance(np.full(scenario.measurement.m, 1e-4)))
    assert (Auto().estimate(scenario.problem, z).extras["stage"] == CHORDS).all()
    assert (Auto().estimate(strict, z).extras["stage"] == PROGRESSIVE).all()


@pytest.mark.parametrize(("model", "scale"), [(Bearings(), 1.0), (LotkaVolterra(), 1.0)], ids=["bearings", "lotka"])
def test_a_jacobian_that_changes_on_the_way_is_renewed(model, scale):
    """With that of the frozen root alone, two in five of these answers are a thousandth to a tenth of a deviation off,
    and chord steps cannot see it: they converge."""
    scenario = Scenario(model, Gaussian(0.5), error_scale=scale)
    problem, trials = scenario.problem, scenario.draw(0, 100)
    with np.errstate(all="ignore"):
        estimates = Auto().estimate(problem, trials.z)
        root = least_squares_root(problem, trials.z, trials.x, prior=None)
    first = estimates.extras["stage"] == CHORDS
    deviation = np.sqrt(np.diagonal(estimates.covariance, axis1=1, axis2=2))
    assert first.mean() > 0.9
    assert estimates.jacobians[first].max() >= 1
    assert (np.abs(estimates.x - root) / deviation)[first].max() < 1e-3


def test_a_root_of_a_passed_jacobian_is_no_minimum():
    """Watson's function from zero, where the first stage is quick and its first Jacobian too old."""
    scenario = Scenario(Mgh("watson", 1.0), Certified())
    estimates = Auto().estimate(scenario.problem, scenario.draw(0, 1).z)
    assert score(scenario.measurement, estimates.x[0]).solved


def test_minima_that_fit_alike_are_found_flagged_and_listed():
    """|M (r - b)|^2 is r'Ar - 2 r'Ab + b'Ab with A = M^2, which has eight symmetric square roots M; and since every r
    has the length 1, a multiple of I in A can stand for another b'Ab."""
    block = Block.draw(Scenario(Triad(), Gaussian(1e-5), error_scale=300.0), 0, 6)
    with np.errstate(all="ignore"):
        estimates, scored = block.estimate(Auto(confirmations=6))

    def squared(x):
        a, b, c, d, e, f = x[3:] * 0.002
        M = np.eye(3) + np.array([[a, d, e], [d, b, f], [e, f, c]])
        return M @ M

    assert estimates.extras["ambiguous"].mean() >= 0.8
    np.testing.assert_array_equal(scored["extra_ambiguous"], estimates.extras["minima"] > 1)
    for x, others in zip(estimates.x, estimates.alternatives, strict=True):
        A, bias = squared(x), 0.002 * x[:3]
        for other in others:
            A_other, bias_other = squared(other), 0.002 * other[:3]
            tolerance = 2e-3 * np.abs(A).max()
            np.testing.assert_allclose(A_other @ bias_other, A @ bias, atol=tolerance)
            shift = A_other - A
            np.testing.assert_allclose(shift, shift[0, 0] * np.eye(3), atol=tolerance)
            gained = bias_other @ A_other @ bias_other - bias @ A @ bias
            np.testing.assert_allclose(shift[0, 0], -gained, atol=tolerance)
            # The most probable one counts.
            assert np.linalg.norm(x) <= np.linalg.norm(other) + 0.1


CASES = {
    "polynomial": (Polynomial(), Gaussian(0.01), (0.1, 1.0, 10.0)),
    "ranging": (Ranging(), Gaussian(0.1), (0.1, 1.0, 10.0)),
    "bearings": (Bearings(), Gaussian(0.5), (0.1, 1.0, 3.0)),
    "lotka_volterra": (LotkaVolterra(), Gaussian(0.5), (0.1, 1.0, 3.0)),
    "sir": (Sir(), Gaussian(50.0), (1.0,)),
    "triad": (Triad(), Gaussian(1e-5), (0.1, 1.0, 10.0, 100.0)),
    "gins": (Gins(), Quantization(0.02286), (1.0, 33.0, 100.0, 300.0, 1000.0, 3000.0)),
}
OTHERS = (FixedPoint(), Newton(), GaussNewton(), LevenbergMarquardt(), Progressive())


@pytest.mark.slow
@pytest.mark.parametrize(("model", "scale"), [(m, s) for m, (_, _, scales) in CASES.items() for s in scales])
def test_it_succeeds_as_often_as_the_best_and_costs_little_more_than_the_cheapest_that_does(model, scale):
    measurement, noise, _ = CASES[model]
    block = Block.draw(Scenario(measurement, noise, error_scale=scale), 5000, 5100)

    def figures(estimator):
        with np.errstate(all="ignore"):
            estimates, scored = block.estimate(estimator)
        return scored["success"].mean(), np.median(estimates.simulations + measurement.n * estimates.jacobians)

    success, cost = figures(Auto())
    others = [figures(other) for other in OTHERS]
    assert success >= max(share for share, _ in others) - 0.01
    assert cost <= 1.5 * min((c for share, c in others if share >= success), default=np.inf)


@pytest.mark.slow
def test_most_failures_among_equal_minima_are_flagged():
    block = Block.draw(Scenario(Triad(), Gaussian(1e-5), error_scale=1000.0), 0, 60)
    estimates, scored = block.estimate(Auto())
    failed = ~scored["success"]
    assert failed.mean() > 0.5
    assert (estimates.extras["ambiguous"][failed] == 1).mean() > 0.5


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
