"""What counts as solved, and as a covariance, in the score of a block."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from small_models import Bent

from ipe_bench import Scenario, run
from ipe_bench.baselines import LinearLSE, MapLM
from ipe_bench.basics.errors import UserError
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.base import Estimates, Estimator
from ipe_bench.noise import Gaussian
from ipe_bench.priors import GaussianPrior
from ipe_bench.trials.scoring import Block

SCENARIO = Scenario(Bent(0.02), Gaussian(0.1), GaussianPrior(), 1.0)


@pytest.mark.parametrize("inflation", [0.3, 1.0, 3.0])
def test_map_is_held_to_the_root_of_its_own_prior(inflation):
    _, columns = Block.draw(SCENARIO, 0, 40).estimate(MapLM(prior_inflation=inflation))
    assert columns["solved"].all()


def test_a_prior_that_fixes_a_parameter_leaves_finite_bounds():
    scenario = Scenario(Bent(0.02), Gaussian(0.1), GaussianPrior((1.0, 0.0, 1.0)), 1.0)
    block = Block.draw(scenario, 0, 20)
    _, columns = block.estimate(MapLM())
    assert np.isfinite(block.bayes_information).all()
    assert columns["success"].all()


@dataclass(frozen=True)
class Indefinite(Estimator):
    """Some estimate with a covariance that is none."""

    def estimate(self, problem, z, *, history=False):
        trials = len(z)
        P = np.repeat(np.diag([1.0, -1.0, 1.0])[None], trials, axis=0)
        return Estimates(np.zeros((trials, 3)), np.full(trials, Status.CONVERGED, np.int8), P)


def test_a_matrix_that_is_no_covariance_covers_nothing():
    _, columns = Block.draw(SCENARIO, 0, 5).estimate(Indefinite())
    assert np.isinf(columns["nees"]).all()


def test_the_test_of_the_fit_is_uniform_where_the_model_is_right():
    _, columns = Block.draw(SCENARIO, 0, 400).estimate(MapLM(prior_inflation=1e3))
    below = np.mean(columns["fit_p"] < 0.5)
    assert abs(below - 0.5) < 4 * np.sqrt(0.25 / 400)


@dataclass(frozen=True)
class Loud(GaussianPrior):
    """A prior that cannot be drawn from."""

    def draw(self, x0, error_scale, rng):
        raise RuntimeError("no such distribution")


def test_what_fails_is_warned_of_and_not_dropped_silently():
    scenario = Scenario(Bent(0.02), Gaussian(0.1), Loud(), 1.0)
    with pytest.warns(UserWarning, match="no such distribution"):
        run(scenario, {"linear_lse": LinearLSE()}, 4)


def test_no_estimator_may_be_called_truth():
    with pytest.raises(UserError, match="truth"):
        run(SCENARIO, {"truth": LinearLSE()}, 4)
