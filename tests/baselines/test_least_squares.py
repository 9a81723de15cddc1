"""SciPy's least squares: the root, the counts, the statuses, and robust losses."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.optimize import curve_fit

from ipe_bench.baselines import LeastSquares
from ipe_bench.basics.linalg import Covariance
from ipe_bench.basics.statuses import Status
from ipe_bench.measurements.base import Measurement, Parameter
from ipe_bench.measurements.gins import Gins
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import Gaussian, Quantization
from ipe_bench.priors import GaussianPrior
from ipe_bench.statistics.intervals import mean_limits
from ipe_bench.trials.scenario import Scenario
from ipe_bench.trials.scoring import nees

T = np.linspace(0.0, 3.0, 25)


@dataclass(frozen=True)
class Decay(Measurement):
    """z = a exp(-b t). Raises where b exceeds 30, overflows where it falls below -300."""

    analytic = True

    @property
    def parameters(self):
        return Parameter("a"), Parameter("b")

    @property
    def index(self):
        return {"t": T.tolist()}

    @property
    def nominal(self):
        return np.array([2.0, 1.0])

    def simulate(self, x):
        if (np.real(x[:, 1]) > 30.0).any():
            raise ValueError("decays too fast")
        return x[:, :1] * np.exp(-x[:, 1:] * T)


def decay(deviation: float = 0.02, trials: int = 6):
    scenario = Scenario(Decay(), Gaussian(deviation), GaussianPrior(), 0.2)
    return scenario.problem, scenario.draw(0, trials)


METHODS = ["trf", "lm", "dogbox"]


@pytest.mark.parametrize("start", ["linear_lse", "nominal"])
@pytest.mark.parametrize("method", METHODS)
def test_agrees_with_minpack_through_curve_fit(method, start):
    problem, trials = decay()
    found = LeastSquares(method=method, start=start).estimate(problem, trials.z)
    assert (found.status == Status.CONVERGED).all()
    for i, z in enumerate(trials.z):
        x, P = curve_fit(
            lambda t, a, b: a * np.exp(-b * t), T, z, trials.x[i], np.full(25, 0.02), True, ftol=1e-14, xtol=1e-14
        )
        assert np.abs(found.x[i] - x).max() < 1e-4 * np.sqrt(np.diag(P).min())
        assert found.covariance[i] == pytest.approx(P, rel=1e-3)


@pytest.mark.parametrize("method", METHODS)
def test_gins_reaches_the_minimum_that_gauss_newton_has_from_the_truth(method):
    scenario = Scenario(Gins(), Quantization(0.075 * 0.3048), GaussianPrior(), 33.0)
    problem, trials = scenario.problem, scenario.draw(0, 12)
    found = LeastSquares(method=method).estimate(problem, trials.z)
    x = trials.x
    for _ in range(8):
        J = problem.R.whiten_jacobian(problem.measurement.jacobian(x))
        r = problem.R.whiten(trials.z - problem.measurement.simulate(x))
        x = x + np.stack([np.linalg.lstsq(A, b, rcond=None)[0] for A, b in zip(J, r, strict=True)])
    deviation = np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))
    assert (found.status == Status.CONVERGED).all()
    assert np.abs((found.x - x) / deviation).max() < 1e-3
    low, high = mean_limits(11, 12, 0.999)
    assert low < nees(found.x - trials.x, found.covariance).mean() / 11 < high


def test_a_robust_loss_shrugs_off_a_bad_reading():
    problem, trials = decay(trials=4)
    z = trials.z.copy()
    z[:, 10] += 100 * 0.02
    plain, robust = (LeastSquares(loss=loss).estimate(problem, z) for loss in ("linear", "soft_l1"))
    assert (robust.status == Status.CONVERGED).all()
    assert (np.abs(robust.x - trials.x).max(axis=1) < np.abs(plain.x - trials.x).max(axis=1) / 5).all()


def test_the_root_of_a_robust_loss_is_not_that_of_least_squares():
    assert LeastSquares().equation == "least_squares"
    assert LeastSquares(loss="huber").equation is None


def test_runs_out_of_evaluations():
    problem, trials = decay()
    for method in METHODS:
        found = LeastSquares(method=method, start="nominal", max_nfev=2).estimate(problem, trials.z)
        assert (found.status == Status.MAX_ITERATIONS).all()


def test_parameters_that_cannot_be_told_apart_are_singular():
    @dataclass(frozen=True)
    class Sum(Decay):
        def simulate(self, x):
            return (x[:, :1] + x[:, 1:]) * (1.0 + T)

    found = LeastSquares(start="nominal").estimate(Problem(Sum(), Covariance(np.ones(25))), 1.0 + T[None] ** 2)
    assert found.status[0] == Status.SINGULAR
