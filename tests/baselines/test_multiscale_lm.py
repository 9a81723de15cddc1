"""The careful least-squares estimator on NIST's certified problems, and against other minimisers."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from ipe_bench.baselines import MultiscaleLM
from ipe_bench.basics.errors import UserError
from ipe_bench.measurements import Bearings, Nist
from ipe_bench.measurements.nist import datasets, score
from ipe_bench.measurements.problem import recorded_problem
from ipe_bench.noise import Gaussian
from ipe_bench.priors import GaussianPrior
from ipe_bench.trials.scenario import Scenario

ESTIMATOR = MultiscaleLM()
HARD = ("BoxBOD", "MGH10", "MGH17", "Eckerle4", "Bennett5")


def certified_digits(dataset, start):
    model = Nist(dataset, start)
    with np.errstate(all="ignore"):
        estimates = ESTIMATOR.estimate(recorded_problem(model), model.readings[None])
    return score(model, estimates.x[0], np.sqrt(np.diag(estimates.covariance[0])))


@pytest.mark.parametrize("dataset", HARD)
def test_the_hardest_certified_problems_are_solved_from_the_far_start(dataset):
    reached = certified_digits(dataset, 1)
    assert reached.parameters >= 9
    assert reached.deviations >= 6
    assert reached.residual_sum_of_squares >= 9


@pytest.mark.slow
def test_all_27_certified_problems_are_solved_from_both_starts():
    reached = [[certified_digits(dataset, start) for dataset in datasets()] for start in (1, 2)]
    parameters = np.array([[d.parameters for d in row] for row in reached])
    deviations = np.array([[d.deviations for d in row] for row in reached])
    assert (parameters >= 4).all()
    assert (parameters.mean(axis=1) >= 10.5).all()
    # Lanczos1's certified deviations belong to residuals of 1e-13, which double precision does not resolve.
    assert ((deviations >= 6).sum(axis=1) == 26).all()


def test_a_batch_is_its_trials_one_by_one():
    scenario = Scenario(Bearings(), Gaussian(0.5), GaussianPrior(), 1.0)
    problem, z = scenario.problem, scenario.draw(0, 12).z
    batch = ESTIMATOR.estimate(problem, z)
    for i in range(12):
        alone = ESTIMATOR.estimate(problem, z[i : i + 1])
        assert (alone.x[0] == batch.x[i]).all()
        assert (alone.covariance[0] == batch.covariance[i]).all()
        assert alone.simulations[0] == batch.simulations[i]


def test_the_minimum_is_that_of_scipy():
    scenario = Scenario(Bearings(), Gaussian(0.5), GaussianPrior(), 1.0)
    problem, trials = scenario.problem, scenario.draw(0, 5)
    estimates = ESTIMATOR.estimate(problem, trials.z)
    for x, z in zip(estimates.x, trials.z, strict=True):

        def residual(x, z=z):
            return (problem.measurement.simulate(x[None])[0] - z) / 0.5

        def jacobian(x):
            return problem.measurement.jacobian(x[None])[0] / 0.5

        other = least_squares(residual, problem.x0, jac=jacobian, xtol=1e-15, ftol=1e-15, gtol=1e-15)
        np.testing.assert_allclose(x, other.x, atol=1e-6)


@pytest.mark.parametrize("option", ["max_iterations", "tolerance", "damping"])
def test_mistakes_are_named(option):
    with pytest.raises(UserError, match=rf"^{option}=0"):
        MultiscaleLM(**{option: 0})
