"""What every estimator promises: trials that do not know of each other, failures that have a name,
options that are checked. The conformance checks hold the same on mild problems; here problems are
far from linear."""

from dataclasses import dataclass

import numpy as np
import pytest
from shared.estimator_checks import ALL, FILTERS, check_bits, check_failures
from shared.families import slow_if
from shared.small_models import Bent

from ipe_bench import baselines, run, solvers
from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Covariance
from ipe_bench.estimators.base import Estimator, one_by_one
from ipe_bench.measurements import Gins, Polynomial
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import Gaussian, Quantization
from ipe_bench.solvers import IPE
from ipe_bench.trials.scenario import Scenario

SCENARIOS = {
    "gins": Scenario(Gins(readings_per_case=6), Quantization(0.02286), error_scale=100.0),
    "polynomial": Scenario(Polynomial(strength=0.05), Gaussian(0.1), error_scale=10.0),
}


def test_these_are_all_estimators():
    ours = {getattr(room, name) for room in (baselines, solvers) for name in room.__all__}
    ours = {
        kind
        for kind in ours
        if isinstance(kind, type) and issubclass(kind, Estimator) and kind is not IPE
    }
    assert ours == {*map(type, ALL), baselines.LinearLSE}


QUICK = baselines.EKF, baselines.LevenbergMarquardt, solvers.Newton, solvers.Relinearized
"""One of each family; the conformance checks hold the same of every option, on mild problems."""


@pytest.mark.parametrize("name", [pytest.param("gins", marks=pytest.mark.slow), "polynomial"])
@pytest.mark.parametrize(
    "estimator",
    slow_if(lambda one: not isinstance(one, QUICK), [*ALL, baselines.LinearLSE()]),
    ids=str,
)
def test_a_batch_is_its_trials_one_by_one_bit_for_bit(estimator, name):
    check_bits(estimator, SCENARIOS[name], 5)


@pytest.mark.parametrize("estimator", ALL, ids=str)
def test_a_trial_that_fails_has_a_status_and_disturbs_no_other(estimator):
    check_failures(estimator)


@pytest.mark.parametrize("estimator", FILTERS, ids=str)
def test_what_an_estimator_needs_is_asked_for(estimator):
    problem = Problem(Bent(), Covariance(np.ones(12)))
    assert estimator.hindrance(problem) == "needs prior, which measurement=bent does not have"
    with pytest.raises(
        UserError, match=f"^{estimator.name}: needs prior, which measurement=bent does not have"
    ):
        estimator.estimate(problem, np.zeros((1, 12)))


@dataclass(frozen=True)
class Unlicensed(Estimator):
    """Refuses what it is given: in a batch, or where it is looped over."""

    loops: bool

    def estimate(self, problem, z, *, history=False):
        def refuse(_):
            raise UserError("has no licence")

        return one_by_one(z, refuse, problem.measurement.n) if self.loops else refuse(z)


@pytest.mark.parametrize("loops", [False, True])
def test_an_estimator_that_refuses_ends_the_run(loops, tmp_path):
    """A thousand rows of errors would be exit code 0."""
    with pytest.raises(UserError, match="has no licence"):
        run(SCENARIOS["polynomial"], {"unlicensed": Unlicensed(loops)}, 3, output=tmp_path)
