"""Bearings-only motion analysis: what is published about its observability."""

import numpy as np
import pytest
from shared.oracles import assert_agrees

from ipe_bench.baselines import EKF, LevenbergMarquardt
from ipe_bench.basics.linalg import Covariance
from ipe_bench.estimators.base import estimate_safely
from ipe_bench.measurements import Bearings
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import Gaussian
from ipe_bench.solvers import Newton
from ipe_bench.trials.scenario import Scenario

STRAIGHT = ((1800.0, 90.0, 6.0),)


def problem(model):
    return Problem(model, Covariance(np.full(model.m, 0.5)))


@pytest.mark.oracle("own second implementation: angles by NumPy", "bearings, deg", 1e-11)
def test_bearings_are_clockwise_from_north():
    model = Bearings()
    x = model.nominal + np.random.default_rng(0).normal(size=(10, 4))
    east, north, v_east, v_north = (x * model.sizes).T[:, :, None]
    sight = (
        east + v_east * model.times - model.observer[:, 0],
        north + v_north * model.times - model.observer[:, 1],
    )
    expected = np.rad2deg(np.arctan2(*sight))
    apart = (model.simulate(x) - expected + 180.0) % 360.0 - 180.0
    assert_agrees(apart, 0.0, atol=1e-11)


def test_bearings_do_not_jump_where_the_target_crosses_north_or_south():
    for target in ((-600.0, 9000.0, 3.0, 0.0), (600.0, -9000.0, -3.0, 0.0)):
        model = Bearings(target=target)
        assert np.abs(np.diff(model.simulate(model.nominal[None])[0])).max() < 20.0


@pytest.mark.parametrize(
    "estimator", [Newton(), LevenbergMarquardt(), EKF()], ids=["newton", "lm", "ekf"]
)
def test_an_estimate_is_the_same_whichever_way_a_file_writes_an_angle(estimator):
    """North is crossed, so readings from 0 to 360 jump; the prior is one unit of each parameter."""
    model = Bearings(target=(-600.0, 9000.0, 3.0, 0.0))
    scenario = Scenario(model, Gaussian(0.05))
    z = scenario.draw(0, 5).z
    assert (np.ptp(z % 360.0, axis=1) > 300.0).all()
    expected = estimator.estimate(scenario.problem, z)
    for written in (z % 360.0, z - 720.0):
        found = estimator.estimate(scenario.problem, written)
        np.testing.assert_allclose(found.x, expected.x, rtol=0.0, atol=1e-6)
        residuals = written - model.near(model.simulate(found.x), written)
        assert np.abs(residuals).max() < 0.5


@pytest.mark.oracle(
    "closed form: motions that bearings from one leg do not tell apart (Nardone and Aidala 1981)",
    "bearings, deg",
    1e-9,
)
@pytest.mark.parametrize("factor", [0.5, 2.0, 10.0])
def test_on_one_leg_every_scaled_relative_motion_has_the_same_bearings(factor):
    model = Bearings(legs=STRAIGHT)
    own = np.array([0.0, 0.0, 6.0, 0.0])
    truth = np.array([*model.target])
    x = np.stack([truth, own + factor * (truth - own)]) / model.sizes
    z = model.simulate(x)
    assert_agrees(z[0], z[1], atol=1e-9)


ALONG_SIGHT = Bearings(
    legs=((900.0, 0.0, 3.0), (900.0, 0.0, 9.0)), target=(0.0, 20000.0, 0.0, -2.0)
)
"""The observer accelerates, but the bearing stays what it would have been (Nardone and Aidala
1981)."""


@pytest.mark.parametrize(
    "model", [Bearings(legs=STRAIGHT), ALONG_SIGHT], ids=["no manoeuvre", "along the sight"]
)
def test_a_problem_that_is_not_observable_is_refused(model):
    assert np.linalg.matrix_rank(model.linearization(), tol=1e-9) < 4
    with pytest.raises(np.linalg.LinAlgError, match=r"H has not full column rank"):
        Newton().estimate(problem(model), model.simulate(model.nominal[None]))
    (said,) = estimate_safely(
        Newton(), problem(model), model.simulate(model.nominal[None])
    ).messages.values()
    assert said.startswith("measurement=bearings: H has not full column rank")


def test_a_turn_makes_it_observable():
    model = Bearings()
    assert np.linalg.matrix_rank(model.linearization(), tol=1e-9) == 4
    x = model.nominal + np.random.default_rng(1).normal(size=(20, 4))
    estimates = Newton(tolerance=1e-9).estimate(problem(model), model.simulate(x))
    assert (estimates.status == 0).all()
    np.testing.assert_allclose(estimates.x, x, atol=1e-7)
