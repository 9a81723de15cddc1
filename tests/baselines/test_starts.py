"""Where least squares and IPE begin: at the linear estimate, at the nominal point, or at the better of the two."""

from dataclasses import replace

import numpy as np
import pytest
from small_models import Bent

from ipe_bench.baselines import GaussNewton, LeastSquares, LevenbergMarquardt
from ipe_bench.basics.errors import UserError
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.ipe import begin, starting_points
from ipe_bench.measurements import Formula, Mgh
from ipe_bench.measurements.counted import EvaluationCount
from ipe_bench.measurements.problem import recorded_problem
from ipe_bench.noise import Gaussian
from ipe_bench.priors import GaussianPrior
from ipe_bench.solvers import Newton, Relinearized
from ipe_bench.trials.scenario import Scenario


def bent(scale: float = 3.0, trials: int = 40):
    scenario = Scenario(Bent(0.3), Gaussian(0.1), GaussianPrior(), scale, seed=1)
    return scenario.problem, scenario.draw(0, trials).z


def test_best_is_for_each_trial_the_point_where_the_readings_fit_better():
    problem, z = bent()
    x, system = begin(problem, z, "best")
    h = problem.measurement.simulate
    H = problem.R.whiten_jacobian(problem.H)
    lse = np.array([np.linalg.lstsq(H, problem.R.whiten(row), rcond=None)[0] for row in z])
    misfit = [np.sum(problem.R.whiten(h(p) - z) ** 2, axis=1) for p in (lse, np.zeros_like(lse))]
    wanted = np.where((misfit[0] < misfit[1])[:, None], lse, 0.0)
    assert 0 < np.mean(misfit[0] < misfit[1]) < 1
    np.testing.assert_allclose(x, wanted, atol=1e-9)
    np.testing.assert_array_equal(system.model.tally.simulations, 2)


@pytest.mark.parametrize(
    "estimator",
    [GaussNewton(), LevenbergMarquardt(), LeastSquares(), Newton(), Relinearized()],
    ids=lambda e: type(e).__name__,
)
def test_an_estimator_that_starts_at_the_best_is_one_of_its_two_selves(estimator):
    problem, z = bent(0.3, 12)
    z[3] = np.nan
    with np.errstate(all="ignore"):
        best, lse, nominal = (
            replace(estimator, start=start).estimate(problem, z) for start in ("best", "linear_lse", "nominal")
        )
        alone = replace(estimator, start="best").estimate(problem, z[5:6])
    same = [np.all(best.x == other.x, axis=1) | (np.arange(12) == 3) for other in (lse, nominal)]
    assert (same[0] | same[1]).all()
    assert best.status[3] != Status.CONVERGED
    np.testing.assert_array_equal(best.x[5], alone.x[0])
    np.testing.assert_array_equal(best.simulations[5], alone.simulations[0])


def test_a_singular_start_is_not_a_problem_without_an_answer():
    """Beale's function has a J of rank 1 at its standard start, and its minimum of zero at (3, 1/2)."""
    model = Mgh("beale")
    problem = recorded_problem(model)
    z = model.recorded.z[None]
    with pytest.raises(UserError, match=r"cannot be told apart there.*start=nominal or best"):
        Newton().estimate(problem, z)
    for estimator in (LeastSquares(), LevenbergMarquardt(start="best")):
        found = estimator.estimate(problem, z)
        assert found.status[0] == Status.CONVERGED
        np.testing.assert_allclose(found.x * model.sizes, [[3.0, 0.5]], rtol=1e-5)
    tally = EvaluationCount.zeros(1)
    np.testing.assert_array_equal(starting_points(problem, z, "best", tally), model.nominal[None])
    assert tally.simulations[0] == 0


def test_gauss_newton_leaves_a_start_at_which_a_column_of_j_is_zero():
    """A peak of height 0 has neither a place nor a width: the shortest step gives it a height, and then they count."""
    t = np.linspace(0, 10, 40)
    model = Formula("c+A*exp(-(t-mu)**2/2)", {"c": 1.0, "A": 0.0, "mu": 5.0}, {"t": t.tolist()})
    problem = Scenario(model, Gaussian(0.01)).problem
    z = (1.5 + 2.0 * np.exp(-((t - 5.3) ** 2) / 2))[None]
    assert problem.rankless
    for start in ("linear_lse", "nominal"):
        found = GaussNewton(start=start).estimate(problem, z)
        assert found.status[0] == Status.CONVERGED
        np.testing.assert_allclose(model.physical(found.x), [[1.5, 2.0, 5.3]], rtol=1e-6)


def test_geodesic_acceleration_finds_the_same_minimum_in_fewer_jacobians():
    """Rosenbrock's valley from its standard start, the example of Transtrum and Sethna's paper."""
    model = Mgh("rosenbrock")
    problem, z = recorded_problem(model), model.recorded.z[None]
    plain, bent = (LevenbergMarquardt(geodesic=g).estimate(problem, z) for g in (False, True))
    for found in (plain, bent):
        np.testing.assert_allclose(found.x * model.sizes, [[1.0, 1.0]], atol=1e-6)
    assert bent.jacobians[0] < plain.jacobians[0]
