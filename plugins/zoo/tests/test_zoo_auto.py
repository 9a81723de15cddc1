"""Portfolio and progressive method on problems of the zoo: minima that fit alike, and minima
without full rank."""

import numpy as np
import pytest
from ipe_bench_zoo import Mgh, Triad
from ipe_bench_zoo.mgh import score

from ipe_bench.baselines import LeastSquares, LevenbergMarquardt
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.ipe import starting_points
from ipe_bench.measurements.counted import EvaluationCount
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import Certified, Gaussian
from ipe_bench.solvers import Auto, Newton, Progressive
from ipe_bench.trials.scenario import Scenario
from ipe_bench.trials.scoring import Block


def test_a_root_of_a_passed_jacobian_is_no_minimum():
    """Watson's function from zero, where the first stage is quick and its first Jacobian too
    old."""
    scenario = Scenario(Mgh("watson", 1.0), Certified())
    estimates = Auto().estimate(scenario.problem, scenario.draw(0, 1).z)
    assert score(scenario.measurement, estimates.x[0]).solved


@pytest.mark.slow
def test_minima_that_fit_alike_are_found_flagged_and_listed():
    """|M (r - b)|^2 is r'Ar - 2 r'Ab + b'Ab with A = M^2, which has eight symmetric square roots M;
    and since every r has the length 1, a multiple of I in A can stand for another b'Ab."""
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


@pytest.mark.slow
def test_most_failures_among_equal_minima_are_flagged():
    block = Block.draw(Scenario(Triad(), Gaussian(1e-5), error_scale=1000.0), 0, 60)
    estimates, scored = block.estimate(Auto())
    failed = ~scored["success"]
    assert failed.mean() > 0.5
    assert (estimates.extras["ambiguous"][failed] == 1).mean() > 0.5


def test_a_start_without_full_rank_does_not_hide_that_a_flat_minimum_is_reached():
    """Chebyquad with n = 8 from 100 times its start: J is singular at the minimum, and to double
    precision at the start as well, but not on the way."""
    scenario = Scenario(Mgh("chebyquad", 100.0), Certified())
    with np.errstate(all="ignore"):
        found = Progressive().estimate(scenario.problem, scenario.draw(0, 1).z)
    assert score(scenario.measurement, found.x[0]).solved
    assert found.status[0] == Status.CONVERGED


def test_a_singular_start_is_not_a_problem_without_an_answer():
    """Beale's function has a J of rank 1 at its standard start, and its minimum of zero at (3,
    1/2)."""
    model = Mgh("beale")
    problem = Problem(model, model.recorded.R)
    z = model.recorded.z[None]
    with pytest.raises(
        np.linalg.LinAlgError, match=r"cannot be distinguished there.*start=nominal or best"
    ):
        Newton().estimate(problem, z)
    for estimator in (LeastSquares(), LevenbergMarquardt(start="best")):
        found = estimator.estimate(problem, z)
        assert found.status[0] == Status.CONVERGED
        np.testing.assert_allclose(found.x * model.sizes, [[3.0, 0.5]], rtol=1e-5)
    tally = EvaluationCount.zeros(1)
    np.testing.assert_array_equal(starting_points(problem, z, "best", tally), model.nominal[None])
    assert tally.simulations[0] == 0


def test_geodesic_acceleration_finds_the_same_minimum_in_fewer_jacobians():
    """Rosenbrock's valley from its standard start, the example of Transtrum and Sethna's paper."""
    model = Mgh("rosenbrock")
    problem, z = Problem(model, model.recorded.R), model.recorded.z[None]
    plain, bent = (LevenbergMarquardt(geodesic=g).estimate(problem, z) for g in (False, True))
    for found in (plain, bent):
        np.testing.assert_allclose(found.x * model.sizes, [[1.0, 1.0]], atol=1e-6)
    assert bent.jacobians[0] < plain.jacobians[0]
