"""Multistart against minima that are known: several of one depth, and one behind others."""

from dataclasses import dataclass, replace

import numpy as np

from ipe_bench.baselines import LevenbergMarquardt, Multistart
from ipe_bench.basics.linalg import Array, Covariance
from ipe_bench.basics.statuses import Status
from ipe_bench.measurements import Measurement, Parameter
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import Gaussian
from ipe_bench.priors import GaussianPrior
from ipe_bench.trials.scenario import Scenario


@dataclass(frozen=True)
class Mirrored(Measurement):
    """a^2 and b, each read three times: a and -a fit alike, and nothing else does."""

    parameters = (Parameter("a"), Parameter("b"))
    index = {"number": list(range(6))}  # noqa: RUF012  as a model states it
    nominal = np.array([1.0, 0.0])

    def simulate(self, x):
        return np.repeat(np.stack([x[:, 0] ** 2, x[:, 1]], axis=1), 3, axis=1)


@dataclass(frozen=True)
class Wave(Measurement):
    """sin(w t) over forty times: least squares in w has a minimum every 0.3 or so, one of them at the truth."""

    parameters = (Parameter("w"),)
    index = {"time": list(range(40))}  # noqa: RUF012
    nominal = np.array([2.0])
    analytic = True

    def simulate(self, x):
        return np.sin(x * np.linspace(0.0, 20.0, 40))


def draw(model: Measurement, deviation: float, scale: float, trials: int):
    scenario = Scenario(model, Gaussian(deviation), GaussianPrior(), scale, seed=3)
    return scenario.problem, scenario.draw(0, trials)


def test_minima_that_fit_alike_are_counted_and_listed():
    problem, trials = draw(Mirrored(), 0.01, 0.3, 12)
    found = Multistart(starts=30, confirmations=29, seed=4).estimate(Problem(problem.measurement, problem.R), trials.z)
    assert (found.status == Status.CONVERGED).all()
    np.testing.assert_array_equal(found.extras["minima"], 2)
    np.testing.assert_array_equal(found.extras["ambiguous"], 1)
    for x, others in zip(found.x, found.alternatives, strict=True):
        np.testing.assert_allclose(others, [[-x[0], x[1]]], atol=1e-6)


def test_a_single_minimum_is_no_ambiguity():
    problem, trials = draw(Mirrored(), 0.01, 0.01, 12)  # no draw of this prior has a below zero
    found = Multistart(confirmations=7).estimate(problem, trials.z)
    np.testing.assert_array_equal(found.extras["minima"], 1)
    np.testing.assert_array_equal(found.extras["ambiguous"], 0)
    assert all(others.shape == (0, 2) for others in found.alternatives)


def lowest_of_a_grid(z: Array) -> float:
    w = np.linspace(-6.0, 10.0, 16001)
    return float(w[np.argmin(np.sum((Wave().simulate(w[:, None]) - z) ** 2, axis=1))])


def test_the_lowest_of_many_minima_is_found_where_one_start_is_lost():
    problem, trials = draw(Wave(), 0.1, 1.0, 20)
    wanted = np.array([lowest_of_a_grid(z) for z in trials.z])
    single = LevenbergMarquardt().estimate(problem, trials.z).x[:, 0]
    found = Multistart(starts=40).estimate(problem, trials.z)
    hits = np.abs(found.x[:, 0] - wanted) < 2e-3
    assert (np.abs(single - wanted) < 2e-3).mean() < 0.5
    assert hits.mean() > 0.9
    # Where it was not found, the test of the fit says so.
    np.testing.assert_array_equal(hits, found.extras["fit_p"] > 1e-6)


def test_it_stops_at_the_first_fit_if_nothing_is_to_be_confirmed():
    problem, trials = draw(Wave(), 0.1, 0.05, 10)
    found = Multistart(confirmations=0).estimate(problem, trials.z)
    assert (found.extras["fit_p"] > 1e-6).all()
    more = Multistart(confirmations=3).estimate(problem, trials.z)
    np.testing.assert_allclose(more.x, found.x, atol=1e-6)
    assert (more.simulations > found.simulations).all()


def test_a_budget_ends_the_search():
    problem, trials = draw(Wave(), 0.1, 3.0, 20)
    free, bounded = (Multistart(starts=20, budget=b).estimate(problem, trials.z) for b in (None, 40.0))
    assert (free.simulations + free.jacobians).max() > 100
    assert (bounded.simulations + bounded.jacobians).max() <= 42


def test_without_readings_that_fit_every_start_is_tried():
    problem, trials = draw(Mirrored(), 0.01, 0.01, 3)
    alien = trials.z + np.array([5.0, -5.0, 0.0, 3.0, -3.0, 0.0])
    narrow = Problem(problem.measurement, Covariance(np.full(6, 0.01)), problem.prior_deviation)
    found = Multistart(starts=5).estimate(narrow, alien)
    np.testing.assert_array_equal(found.extras["minima"], 0)
    assert (found.jacobians >= 5).all()


def test_no_fit_is_believed_where_the_level_of_the_noise_is_unknown():
    """Under an assumed deviation far too wide any minimum fits; the lowest of all starts counts."""
    problem, trials = draw(Wave(), 0.1, 1.0, 12)
    wide = Problem(problem.measurement, Covariance(np.full(40, 10.0)), problem.prior_deviation)
    believed, doubted = (Multistart(starts=40).estimate(replace(wide, doubted=d), trials.z) for d in (0.0, 1.0))
    wanted = np.array([lowest_of_a_grid(z) for z in trials.z])
    hits = [(np.abs(found.x[:, 0] - wanted) < 2e-3).mean() for found in (believed, doubted)]
    assert hits[0] < 0.8 < hits[1]
