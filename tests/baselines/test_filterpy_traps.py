"""What filterpy does when it is used as it stands, and that ours are not caught by it."""

import filterpy.stats
import numpy as np
import pytest
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter
from linear_models import Linear, LinearGins, linear_map

from ipe_bench.baselines import CKF, UKF
from ipe_bench.basics.linalg import Covariance
from ipe_bench.basics.statuses import Status
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import Gaussian
from ipe_bench.priors import GaussianPrior
from ipe_bench.statistics.intervals import mean_limits
from ipe_bench.trials.scenario import Scenario
from ipe_bench.trials.scoring import nees


def linear_problem():
    scenario = Scenario(Linear(), Gaussian(1.0), GaussianPrior(), 1.0)
    return scenario.problem, scenario.draw(0, 3).z


def test_ukf_wants_the_hx_of_each_epoch():
    """One hx for all epochs, as the constructor takes it, gives another answer than the batch."""
    problem, z = linear_problem()
    model = Linear(sizes=(3, 3), unknowns=4)
    problem = Problem(model, Covariance(np.ones(6)), np.ones(4))
    z = z[:1, :6]
    x, P = linear_map(problem, model.matrix, z)
    first, second = model.epochs
    points = MerweScaledSigmaPoints(4, 0.1, 2.0, 0.0)
    naive = UnscentedKalmanFilter(4, 3, 1.0, lambda x: model.matrix[first] @ x, lambda x, dt: x, points)
    naive.x, naive.Q = model.nominal, np.zeros((4, 4))
    for rows in (first, second):
        naive.predict()
        naive.update(z[0, rows])
    deviation = np.sqrt(np.diag(P))
    assert np.abs((naive.x - x[0]) / deviation).max() > 0.1
    assert np.abs((UKF().estimate(problem, z).x - x) / deviation).max() < 1e-9


def test_ukf_with_a_small_alpha_loses_digits():
    model = LinearGins()
    scenario = Scenario(model, Gaussian(0.0066), GaussianPrior(), 10.0)
    problem, z = scenario.problem, scenario.draw(0, 5).z
    x, P = linear_map(problem, model.matrix, z)
    near, far = (UKF(alpha=a).estimate(problem, z) for a in (0.1, 1e-3))
    deviation = np.sqrt(np.diag(P))
    apart = np.abs((near.x - x) / deviation).max()
    assert apart < 1e-8
    lost = (far.status != Status.CONVERGED).any() or np.abs((far.x - x) / deviation).max() > 100 * apart
    assert lost


@pytest.mark.parametrize("estimator", [UKF(), CKF()], ids=["ukf", "ckf"])
def test_p_minus_ksk_cancels_where_the_prior_is_wide(estimator):
    """Prior deviations 1e5 times those of the posterior: filterpy as it stands, on the same sigma points, loses P."""
    model = Linear(sizes=(8, 8), unknowns=4)
    scenario = Scenario(model, Gaussian(1e-5), GaussianPrior(), 1.0)
    problem, z = scenario.problem, scenario.draw(0, 1).z
    x, P = linear_map(problem, model.matrix, z)
    deviation = np.sqrt(np.diag(P))
    assert deviation.max() < 1e-5

    points = MerweScaledSigmaPoints(4, 0.1, 2.0, 0.0)
    naive = UnscentedKalmanFilter(4, 8, 1.0, None, lambda x, dt: x, points)
    naive.x, naive.Q = model.nominal, np.zeros((4, 4))
    naive.compute_process_sigmas(1.0)
    rows = model.epochs[0]
    naive.update(z[0, rows], R=np.eye(8) * 1e-10, hx=lambda x: model.matrix[rows] @ x)
    H = model.matrix[rows]
    after_one = np.linalg.inv(H.T @ H * 1e10 + np.eye(4))
    scale = np.sqrt(np.outer(np.diag(after_one), np.diag(after_one)))
    assert np.abs((naive.P - after_one) / scale).max() > 1e-3

    found = estimator.estimate(problem, z)
    assert np.abs((found.x - x) / deviation).max() < 1e-4
    assert np.abs((found.covariance[0] - P) / np.outer(deviation, deviation)).max() < 1e-4


def test_nees_of_filterpy_has_no_limits():
    """Its numbers are ours; what they must lie between is ours alone."""
    rng = np.random.default_rng(2)
    A = rng.standard_normal((3, 3))
    P = A @ A.T
    error = rng.standard_normal((400, 3)) @ A.T
    theirs = filterpy.stats.NEES(error, np.zeros_like(error), [P] * 400)
    assert isinstance(theirs, list)
    ours = nees(error, np.repeat(P[None], 400, axis=0))
    assert ours == pytest.approx(theirs)
    low, high = mean_limits(3, 400)
    assert low < ours.mean() / 3 < high
