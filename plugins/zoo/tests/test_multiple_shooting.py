"""Multiple shooting against single shooting, against the closed form of Bock's problem, and against
its own pieces."""

import numpy as np
import pytest
from ipe_bench_zoo import Bock, MultipleShooting
from shared.linear_models import Linear
from shared.oracles import assert_agrees
from shared.small_models import bock

from ipe_bench.baselines import LevenbergMarquardt
from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Covariance
from ipe_bench.basics.statuses import Status
from ipe_bench.measurements import Gins, LotkaVolterra, Sir
from ipe_bench.measurements.base import SubsetModel
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import Gaussian
from ipe_bench.priors import GaussianPrior
from ipe_bench.trials.scenario import Scenario

MODELS = {
    "gins": (Gins(), 100.0, 0.0066),
    "lotka_volterra": (LotkaVolterra(), 1.0, 0.5),
    "sir": (Sir(), 1.0, 5.0),
}


def scenario(name: str) -> Scenario:
    model, scale, deviation = MODELS[name]
    return Scenario(model, Gaussian(deviation), GaussianPrior(), scale, seed=2)


@pytest.mark.parametrize(
    "name", [pytest.param("gins", marks=pytest.mark.slow), "lotka_volterra", "sir"]
)
def test_its_minimum_is_that_of_single_shooting(name):
    drawn, problem = scenario(name).draw(0, 4), scenario(name).problem
    found = MultipleShooting(step=0.05).estimate(problem, drawn.z)
    single = LevenbergMarquardt().estimate(problem, drawn.z)
    deviation = np.sqrt(np.diagonal(single.covariance, axis1=1, axis2=2))
    assert (found.status == Status.CONVERGED).all()
    assert np.abs((found.x - single.x) / deviation).max() < 1e-3
    np.testing.assert_allclose(
        np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2)), deviation, rtol=1e-3
    )
    np.testing.assert_allclose(found.extras["fit_p"], single.extras["fit_p"], rtol=1e-3)


@pytest.mark.oracle("closed form: pi", "parameters of Bock's problem", 1e-6)
@pytest.mark.slow
@pytest.mark.parametrize("initial", [False, True])
def test_bocks_problem_is_solved_where_single_shooting_is_lost(initial):
    """Solutions grow by exp(60) = 1e26; p = pi in closed form."""
    model = bock(60.0) if initial else Bock(mu=60.0)
    problem, z = Problem(model, model.recorded.R), model.recorded.z[None]
    with np.errstate(all="ignore"):
        single = LevenbergMarquardt().estimate(problem, z)
    assert not abs(single.x[0, 0] * 0.1 - np.pi) < 1e-6 or single.status[0] != Status.CONVERGED
    found = MultipleShooting().estimate(problem, z)
    assert found.status[0] == Status.CONVERGED
    assert found.iterations[0] < 15
    assert_agrees(found.x[0] * model.sizes, [np.pi, 0.0, np.pi][: model.n], atol=1e-6)


def test_missing_readings_are_as_if_they_had_never_been_taken():
    whole = scenario("lotka_volterra")
    problem, drawn = whole.problem, whole.draw(0, 2)
    kept = tuple(i for i in range(problem.measurement.m) if i not in (2, 11, 12))
    part = Problem(SubsetModel(problem.measurement, kept), problem.R.restricted(np.array(kept)))
    found = MultipleShooting(step=0.05).estimate(part, drawn.z[:, list(kept)])
    single = LevenbergMarquardt().estimate(part, drawn.z[:, list(kept)])
    np.testing.assert_allclose(found.x, single.x, atol=1e-4)


def test_a_bad_trial_disturbs_no_other():
    whole = scenario("lotka_volterra")
    z = whole.draw(0, 4).z
    spoiled = z.copy()
    spoiled[1, 3] = np.nan
    found, alone = (MultipleShooting().estimate(whole.problem, a) for a in (spoiled, z))
    assert found.status[1] == Status.NONFINITE
    np.testing.assert_array_equal(found.x[[0, 2, 3]], alone.x[[0, 2, 3]])


def test_other_models_are_refused():
    with pytest.raises(UserError, match="multiple_shooting: needs differential equations, which"):
        MultipleShooting().estimate(Problem(Linear(), Covariance(np.ones(11))), np.zeros((1, 11)))
