"""What every estimator promises: trials that do not know of each other, failures that have a name, options that are
checked. The conformance checks hold the same on mild problems; here problems are far from linear."""

import numpy as np
import pytest
from shared.small_models import Bent

from ipe_bench import baselines, solvers
from ipe_bench.baselines import (
    CKF,
    EKF,
    IPLF,
    LMIEKF,
    UKF,
    EnKF,
    EsMda,
    GaussNewton,
    IteratedEKF,
    LeastSquares,
    LevenbergMarquardt,
    MapLM,
    MultipleShooting,
    MultiscaleLM,
    Multistart,
    RecursiveUpdate,
)
from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array, Covariance
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.base import Estimator
from ipe_bench.measurements import Gins, LotkaVolterra, Polynomial
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import Gaussian, Quantization
from ipe_bench.solvers import IPE, Anderson, Auto, Broyden, DampedNewton, FixedPoint, Newton, Progressive, Relinearized
from ipe_bench.trials.scenario import Scenario

SOLVERS: list[Estimator] = [
    *(FixedPoint(), Newton(), Broyden(), Broyden("identity"), Anderson(2), DampedNewton(), solvers.SteepestDescent()),
    *(Relinearized(), Relinearized(Newton()), Progressive(), Progressive(use_prior=False), Auto()),
]
LEAST_SQUARES: list[Estimator] = [
    *(GaussNewton(), GaussNewton(damping=1e-3), LevenbergMarquardt(), LevenbergMarquardt(geodesic=True), MapLM()),
    *(LeastSquares(method=method) for method in ("trf", "lm", "dogbox")),
    *(Multistart(starts=4), MultiscaleLM(), EsMda(members=20)),
]
FILTERS: list[Estimator] = [
    *(kind(engine=e) for kind in (EKF, IteratedEKF, UKF, CKF) for e in ("filterpy", "batched")),
    EnKF(members=30),
    *(RecursiveUpdate(), LMIEKF(), IPLF()),
]
ALL = [*SOLVERS, *LEAST_SQUARES, *FILTERS]
SCENARIOS = {
    "gins": Scenario(Gins(readings_per_case=6), Quantization(0.02286), error_scale=100.0),
    "polynomial": Scenario(Polynomial(strength=0.05), Gaussian(0.1), error_scale=10.0),
}


def test_these_are_all_estimators():
    ours = {getattr(room, name) for room in (baselines, solvers) for name in room.__all__}
    ours = {kind for kind in ours if isinstance(kind, type) and issubclass(kind, Estimator) and kind is not IPE}
    assert ours == {*map(type, ALL), baselines.LinearLSE, MultipleShooting}


@pytest.mark.parametrize("name", SCENARIOS)
@pytest.mark.parametrize("estimator", [*ALL, baselines.LinearLSE()], ids=str)
def test_a_batch_is_its_trials_one_by_one_bit_for_bit(estimator, name):
    check_bits(estimator, SCENARIOS[name], 5)


def test_a_batch_of_trajectories_is_its_trials_one_by_one():
    check_bits(MultipleShooting(), Scenario(LotkaVolterra(), Gaussian(0.5)), 3)


def check_bits(estimator: Estimator, scenario: Scenario, trials: int) -> None:
    problem, z = scenario.problem, scenario.draw(0, trials).z
    with np.errstate(all="ignore"):
        together = estimator.estimate(problem, z[::-1], history=True)
        alone = [estimator.estimate(problem, row[None], history=True) for row in z[::-1]]
    for name in ("x", "status", "covariance", "iterations", "simulations", "jacobians"):
        np.testing.assert_array_equal(getattr(together, name), np.concatenate([getattr(a, name) for a in alone]), name)
    for name, values in together.extras.items():
        np.testing.assert_array_equal(values, np.concatenate([a.extras[name] for a in alone]), name)
    assert together.messages == {i: a.messages[0] for i, a in enumerate(alone) if a.messages}
    for i, one in enumerate(alone):
        np.testing.assert_array_equal(together.history[i], one.history[0])


class Raising(Bent):
    """Raises far from the nominal point."""

    def simulate(self, x: Array) -> Array:
        if (np.abs(np.real(x[:, 0])) > 200).any():
            raise ArithmeticError("too far\nsecond line")
        return super().simulate(x)


@pytest.mark.parametrize("estimator", ALL, ids=str)
def test_a_trial_that_fails_has_a_status_and_disturbs_no_other(estimator):
    problem = Problem(Raising(0.01), Covariance(np.full(12, 0.1)), np.array([10.0, 10.0, 10.0]))
    z = Bent(0.01).simulate(np.random.default_rng(2).normal(size=(6, 3)))
    bad = z.copy()
    bad[1, 4] = np.nan
    bad[3] = Bent().simulate(np.array([[1e7, 0.0, 0.0]]))[0]
    with np.errstate(all="ignore"):
        alone, mixed = (estimator.estimate(problem, readings) for readings in (z, bad))
    others = [0, 2, 4, 5]
    np.testing.assert_array_equal(mixed.x[others], alone.x[others])
    np.testing.assert_array_equal(mixed.status[others], alone.status[others])
    assert mixed.status[1] == Status.NONFINITE
    assert mixed.status[3] == Status.ERROR
    assert mixed.messages[3] == "ArithmeticError: too far"


@pytest.mark.parametrize("estimator", [*FILTERS, EsMda()], ids=str)
def test_what_an_estimator_needs_is_asked_for(estimator):
    problem = Problem(Bent(), Covariance(np.ones(12)))
    assert estimator.missing(problem) == ["prior"]
    with pytest.raises(UserError, match="has no prior"):
        estimator.estimate(problem, np.zeros((1, 12)))
