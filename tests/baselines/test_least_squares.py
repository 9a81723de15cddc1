"""Least squares of readings: SciPy's, from where an iteration begins, and on the certified problems
of NIST."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.optimize import curve_fit
from shared.families import slow_if
from shared.oracles import agreed
from shared.small_models import Bent, Written

from ipe_bench.baselines import (
    GaussNewton,
    LeastSquares,
    LevenbergMarquardt,
    MultiscaleLM,
    Multistart,
)
from ipe_bench.basics.linalg import Array, Covariance, deviations
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.ipe import begin
from ipe_bench.measurements import Formula, Gins, Measurement, Nist, Parameter
from ipe_bench.measurements.nist import FORMULAS
from ipe_bench.measurements.nist import score as nist_score
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import Gaussian, Quantization
from ipe_bench.priors import GaussianPrior
from ipe_bench.solvers import Auto, Newton, Progressive, Relinearized
from ipe_bench.statistics.intervals import mean_limits
from ipe_bench.trials.scenario import Scenario
from ipe_bench.trials.scoring import nees

T = np.linspace(0.0, 3.0, 25)


@dataclass(frozen=True)
class Decay(Measurement):
    """z = a exp(-b t). Raises where b exceeds 30, overflows where it falls below -300."""

    analytic = True

    parameters = (Parameter("a"), Parameter("b"))
    index = {"t": T.tolist()}  # noqa: RUF012  as a model states it
    nominal = np.array([2.0, 1.0])

    def simulate(self, x):
        if (np.real(x[:, 1]) > 30.0).any():
            raise ValueError("decays too fast")
        return x[:, :1] * np.exp(-x[:, 1:] * T)


def decay(deviation: float = 0.02, trials: int = 6):
    scenario = Scenario(Decay(), Gaussian(deviation), GaussianPrior(), 0.2)
    return scenario.problem, scenario.draw(0, trials)


METHODS = ["trf", "lm", "dogbox"]


@pytest.mark.oracle(
    "library: MINPACK, by SciPy's curve_fit", "estimates, in standard deviations", 1e-4
)
@pytest.mark.parametrize("start", ["linear_lse", "nominal"])
@pytest.mark.parametrize("method", METHODS)
def test_agrees_with_minpack_through_curve_fit(method, start):
    problem, trials = decay()
    found = LeastSquares(method=method, start=start).estimate(problem, trials.z)
    assert (found.status == Status.CONVERGED).all()
    for i, z in enumerate(trials.z):
        x, P = curve_fit(
            lambda t, a, b: a * np.exp(-b * t),
            T,
            z,
            trials.x[i],
            np.full(25, 0.02),
            True,
            ftol=1e-14,
            xtol=1e-14,
        )
        agreed(np.abs(found.x[i] - x) / np.sqrt(np.diag(P).min()), 1e-4)
        assert found.covariance[i] == pytest.approx(P, rel=1e-3)


@pytest.mark.oracle(
    "library: NumPy's lstsq, in Gauss-Newton steps from the truth",
    "estimates, in standard deviations",
    1e-3,
)
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
    assert (found.status == Status.CONVERGED).all()
    agreed(np.abs((found.x - x) / deviations(found.covariance)), 1e-3)
    low, high = mean_limits(11, 12, 0.999)
    assert low < nees(found.x - trials.x, found.covariance).mean() / 11 < high


def test_a_robust_loss_shrugs_off_a_bad_reading():
    problem, trials = decay(trials=4)
    z = trials.z.copy()
    z[:, 10] += 100 * 0.02
    plain, robust = (LeastSquares(loss=loss).estimate(problem, z) for loss in ("linear", "soft_l1"))
    assert (robust.status == Status.CONVERGED).all()
    assert (
        np.abs(robust.x - trials.x).max(axis=1) < np.abs(plain.x - trials.x).max(axis=1) / 5
    ).all()


def test_the_root_of_a_robust_loss_is_not_that_of_least_squares():
    assert LeastSquares().equation == "least_squares"
    assert LeastSquares(loss="huber").equation is None


def test_runs_out_of_evaluations():
    problem, trials = decay()
    for method in METHODS:
        found = LeastSquares(method=method, start="nominal", max_nfev=2).estimate(problem, trials.z)
        assert (found.status == Status.MAX_ITERATIONS).all()


def test_parameters_that_cannot_be_told_apart_are_singular():
    model = Written(lambda a, b: tuple((a + b) * (1.0 + t) for t in T), 2, 25)
    found = LeastSquares(start="nominal").estimate(
        Problem(model, Covariance(np.ones(25))), 1.0 + T[None] ** 2
    )
    assert found.status[0] == Status.SINGULAR


# Where an iteration begins


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
            replace(estimator, start=start).estimate(problem, z)
            for start in ("best", "linear_lse", "nominal")
        )
        alone = replace(estimator, start="best").estimate(problem, z[5:6])
    same = [np.all(best.x == other.x, axis=1) | (np.arange(12) == 3) for other in (lse, nominal)]
    assert (same[0] | same[1]).all()
    assert best.status[3] != Status.CONVERGED
    np.testing.assert_array_equal(best.x[5], alone.x[0])
    np.testing.assert_array_equal(best.simulations[5], alone.simulations[0])


def test_gauss_newton_leaves_a_start_at_which_a_column_of_j_is_zero():
    """A peak of height 0 has neither a place nor a width: the shortest step gives it a height, and
    then they count."""
    t = np.linspace(0, 10, 40)
    model = Formula("c+A*exp(-(t-mu)**2/2)", {"c": 1.0, "A": 0.0, "mu": 5.0}, {"t": t.tolist()})
    problem = Scenario(model, Gaussian(0.01)).problem
    z = (1.5 + 2.0 * np.exp(-((t - 5.3) ** 2) / 2))[None]
    assert problem.rankless
    for start in ("linear_lse", "nominal"):
        found = GaussNewton(start=start).estimate(problem, z)
        assert found.status[0] == Status.CONVERGED
        np.testing.assert_allclose(model.physical(found.x), [[1.5, 2.0, 5.3]], rtol=1e-6)


# Certified problems

HARD = ("BoxBOD", "MGH10", "MGH17", "Eckerle4", "Bennett5")


def certified_digits(dataset, start, estimator):
    model = Nist(dataset, start)
    with np.errstate(all="ignore"):
        estimates = estimator.estimate(Problem(model, model.recorded.R), model.readings[None])
    return nist_score(model, estimates.x[0], np.sqrt(np.diag(estimates.covariance[0])))


@pytest.mark.oracle(
    "certified: NIST Statistical Reference Datasets (BoxBOD, MGH10, MGH17, Eckerle4, Bennett5)",
    "parameters from the far start",
    1e-9,
)
@pytest.mark.parametrize("dataset", slow_if(lambda dataset: dataset.startswith("MGH"), HARD))
def test_the_hardest_certified_problems_are_solved_from_the_far_start(dataset):
    reached = certified_digits(dataset, 1, MultiscaleLM())
    agreed(10.0**-reached.parameters, 1e-9)
    assert reached.deviations >= 6
    assert reached.residual_sum_of_squares >= 9


@pytest.mark.oracle(
    "certified: NIST Statistical Reference Datasets, 27 problems from two starts",
    "parameters by multiscale_lm, auto and progressive",
    1e-4,
)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("estimator", "mean"),
    [
        (MultiscaleLM(), 10.5),
        (Auto(tolerance=1e-10), 10.3),
        (Progressive(max_iterations=1000, tolerance=1e-10), 10.5),
    ],
    ids=lambda one: getattr(one, "name", str(one)),
)
def test_all_27_certified_problems_are_solved_from_both_starts(estimator, mean):
    reached = [
        [certified_digits(dataset, start, estimator) for dataset in FORMULAS] for start in (1, 2)
    ]
    parameters = np.array([[d.parameters for d in row] for row in reached])
    deviations = np.array([[d.deviations for d in row] for row in reached])
    agreed(10.0**-parameters, 1e-4)
    assert (parameters.mean(axis=1) >= mean).all()
    # Lanczos1's certified deviations belong to residuals of 1e-13, which double precision does not
    # resolve.
    assert ((deviations >= 6).sum(axis=1) == 26).all()


# Many starts: minima that are known, several of one depth, and one behind others


MIRRORED = Written(lambda a, b: (a**2,) * 3 + (b,) * 3, 2, 6, first=1.0)
"""a^2 and b, each read three times: a and -a fit alike, and nothing else does."""
WAVE = Written(lambda w: tuple(np.sin(w * t) for t in np.linspace(0.0, 20.0, 40)), 1, 40, first=2.0)
"""sin(w t) over forty times: least squares in w has a minimum every 0.3 or so, one of them at the
truth."""


def draw(model: Measurement, deviation: float, scale: float, trials: int):
    scenario = Scenario(model, Gaussian(deviation), GaussianPrior(), scale, seed=3)
    return scenario.problem, scenario.draw(0, trials)


def test_minima_that_fit_alike_are_counted_and_listed():
    problem, trials = draw(MIRRORED, 0.01, 0.3, 12)
    found = Multistart(starts=30, confirmations=29, seed=4).estimate(
        Problem(problem.measurement, problem.R), trials.z
    )
    assert (found.status == Status.CONVERGED).all()
    np.testing.assert_array_equal(found.extras["minima"], 2)
    np.testing.assert_array_equal(found.extras["ambiguous"], 1)
    for x, others in zip(found.x, found.alternatives, strict=True):
        np.testing.assert_allclose(others, [[-x[0], x[1]]], atol=1e-6)


def test_a_single_minimum_is_no_ambiguity():
    problem, trials = draw(MIRRORED, 0.01, 0.01, 12)  # no draw of this prior has a below zero
    found = Multistart(confirmations=7).estimate(problem, trials.z)
    np.testing.assert_array_equal(found.extras["minima"], 1)
    np.testing.assert_array_equal(found.extras["ambiguous"], 0)
    assert all(others.shape == (0, 2) for others in found.alternatives)


def lowest_of_a_grid(z: Array) -> float:
    w = np.linspace(-6.0, 10.0, 16001)
    return float(w[np.argmin(np.sum((WAVE.simulate(w[:, None]) - z) ** 2, axis=1))])


@pytest.mark.slow
def test_the_lowest_of_many_minima_is_found_where_one_start_is_lost():
    problem, trials = draw(WAVE, 0.1, 1.0, 20)
    wanted = np.array([lowest_of_a_grid(z) for z in trials.z])
    single = LevenbergMarquardt().estimate(problem, trials.z).x[:, 0]
    found = Multistart(starts=40).estimate(problem, trials.z)
    hits = np.abs(found.x[:, 0] - wanted) < 2e-3
    assert (np.abs(single - wanted) < 2e-3).mean() < 0.5
    assert hits.mean() > 0.9
    # Where it was not found, the test of the fit says so.
    np.testing.assert_array_equal(hits, found.extras["fit_p"] > 1e-6)


def test_it_stops_at_the_first_fit_if_nothing_is_to_be_confirmed():
    problem, trials = draw(WAVE, 0.1, 0.05, 10)
    found = Multistart(confirmations=0).estimate(problem, trials.z)
    assert (found.extras["fit_p"] > 1e-6).all()
    more = Multistart(confirmations=3).estimate(problem, trials.z)
    np.testing.assert_allclose(more.x, found.x, atol=1e-6)
    assert (more.simulations > found.simulations).all()


@pytest.mark.slow
def test_a_budget_ends_the_search():
    problem, trials = draw(WAVE, 0.1, 3.0, 20)
    free, bounded = (
        Multistart(starts=20, budget=b).estimate(problem, trials.z) for b in (None, 40.0)
    )
    assert (free.simulations + free.jacobians).max() > 100
    assert (bounded.simulations + bounded.jacobians).max() <= 42


def test_without_readings_that_fit_every_start_is_tried():
    problem, trials = draw(MIRRORED, 0.01, 0.01, 3)
    alien = trials.z + np.array([5.0, -5.0, 0.0, 3.0, -3.0, 0.0])
    narrow = Problem(problem.measurement, Covariance(np.full(6, 0.01)), problem.prior_deviation)
    found = Multistart(starts=5).estimate(narrow, alien)
    np.testing.assert_array_equal(found.extras["minima"], 0)
    assert (found.jacobians >= 5).all()


@pytest.mark.slow
def test_no_fit_is_believed_where_the_level_of_the_noise_is_unknown():
    """Under an assumed deviation far too wide any minimum fits; the lowest of all starts counts."""
    problem, trials = draw(WAVE, 0.1, 1.0, 12)
    wide = Problem(problem.measurement, Covariance(np.full(40, 10.0)), problem.prior_deviation)
    believed, doubted = (
        Multistart(starts=40).estimate(replace(wide, doubted=d), trials.z) for d in (0.0, 1.0)
    )
    wanted = np.array([lowest_of_a_grid(z) for z in trials.z])
    hits = [(np.abs(found.x[:, 0] - wanted) < 2e-3).mean() for found in (believed, doubted)]
    assert hits[0] < 0.8 < hits[1]
