"""The ensemble smoother against the closed form of linear models, and against the formula of its
paper."""

import numpy as np
import pytest
from ipe_bench_zoo import EsMda
from ipe_bench_zoo.es_mda import assimilated
from shared.linear_models import Linear, block_of_gins, linear_map
from shared.oracles import assert_agrees

from ipe_bench.baselines import MapLM
from ipe_bench.basics.linalg import deviations
from ipe_bench.basics.statuses import Status
from ipe_bench.noise import Gaussian
from ipe_bench.priors import GaussianPrior
from ipe_bench.trials.scenario import Scenario


def linear(trials: int):
    model = Linear()
    scenario = Scenario(model, Gaussian(0.5), GaussianPrior(), 1.0)
    problem, z = scenario.problem, scenario.draw(0, trials).z
    return (problem, z, *linear_map(problem, model.matrix, z))


@pytest.mark.oracle(
    "published: Emerick and Reynolds (2013), eq. (12)", "members after an assimilation", 1e-12
)
@pytest.mark.parametrize("members", [20, 5])
def test_gain_is_that_of_the_paper(members):
    """C_sh (C_hh + alpha R)^-1 (z - h), Emerick and Reynolds (2013), eq. (12), by inverting a
    matrix of readings."""
    rng = np.random.default_rng(1)
    s, h, z = (rng.standard_normal((3, members, k)) for k in (4, 7, 7))
    found = assimilated(s, h, z, 3.0)
    for k in range(3):
        C = np.cov(s[k], h[k], rowvar=False)
        gain = C[:4, 4:] @ np.linalg.inv(C[4:, 4:] + 3.0 * np.eye(7))
        assert_agrees(found[k], s[k] + (z[k] - h[k]) @ gain.T, atol=1e-12)


def test_a_member_that_overflows_is_left_out():
    rng = np.random.default_rng(1)
    s, h, z = (
        rng.standard_normal((1, 20, 4)),
        rng.standard_normal((1, 20, 7)),
        rng.standard_normal((1, 20, 7)),
    )
    others = assimilated(s[:, 1:], h[:, 1:], z[:, 1:], 3.0)
    h[0, 0] = np.inf
    np.testing.assert_allclose(assimilated(s, h, z, 3.0)[:, 1:], others, atol=1e-12)


@pytest.mark.oracle("closed form: posterior of a linear model", "estimates and covariance", 1e-9)
def test_polish_ends_at_the_maximum_a_posteriori():
    problem, z, x, P = linear(6)
    found = EsMda(members=20).estimate(problem, z, history=True)
    assert (found.status == Status.CONVERGED).all()
    assert_agrees(found.x, x, atol=1e-9)
    assert_agrees(found.covariance[0], P, atol=1e-9)
    # 16 assimilations and one or two Gauss-Newton steps after the first mean.
    assert all(
        len(path) - 1 == count for path, count in zip(found.history, found.iterations, strict=True)
    )
    assert (found.simulations - 16 * 20 <= 3).all()


def test_inflation_widens_the_prior():
    problem, z, _, _ = linear(3)
    x, P = linear_map(problem, Linear().matrix, z, inflation=3.0)
    found = EsMda(members=40, prior_inflation=3.0).estimate(problem, z)
    np.testing.assert_allclose(found.x, x, atol=1e-8)
    wide = EsMda(members=6400, steps=2, first=0.1, polish=0, prior_inflation=3.0).estimate(
        problem, z
    )
    assert np.abs(deviations(wide.covariance) / deviations(P) - 1).max() < 0.1


@pytest.mark.slow
def test_gins_at_scale_300_is_solved_from_the_seed_given():
    block = block_of_gins(300.0, 6, 91)
    found, score = block.estimate(EsMda())
    assert score["success"].all()
    assert score["solved"].all()
    assert found.simulations.mean() == pytest.approx(1600, abs=8)
    other = EsMda(polish=0, seed=1).estimate(block.problem, block.trials.z[:1])
    assert (other.x[0] != EsMda(polish=0).estimate(block.problem, block.trials.z[:1]).x[0]).all()
    by_descent = MapLM().estimate(block.problem, block.trials.z)
    near = by_descent.status == Status.CONVERGED
    assert np.abs((found.x - by_descent.x) / deviations(found.covariance))[near].max() < 1e-3


@pytest.mark.slow
def test_equal_steps_fail_where_the_noise_is_far_below_the_prior():
    """Why the information grows geometrically."""
    block = block_of_gins(1000.0, 12, 91)
    even, geometric = (
        block.estimate(EsMda(polish=0, first=first))[1]["success"].mean() for first in (1.0, 1e-12)
    )
    assert even < 0.3
    assert geometric > 0.7
