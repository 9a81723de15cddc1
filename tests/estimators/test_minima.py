"""Minima that are found again, replaced, counted and reported: by definition, and by the model's
own calls."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from shared.small_models import Bent, Written

from ipe_bench.baselines import LevenbergMarquardt, Multistart
from ipe_bench.basics.linalg import Covariance
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.minima import Fitting, Minima
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import Gaussian
from ipe_bench.priors import GaussianPrior
from ipe_bench.trials.scenario import Scenario

LINEAR = Scenario(Bent(0.0), Gaussian(0.1), GaussianPrior(), 1.0)


def minima(chi_square, converged=True, x=0.0):
    """Minima of trials of one parameter with a deviation of 2."""
    chi_square = np.atleast_1d(np.asarray(chi_square, dtype=float))
    trials = len(chi_square)
    status = np.where(np.broadcast_to(converged, trials), Status.CONVERGED, Status.STALLED).astype(
        np.int8
    )
    found = Minima.nowhere(np.full((trials, 1), float(x)), history=False)
    return replace(
        found, status=status, covariance=np.full((trials, 1, 1), 4.0), chi_square=chi_square
    )


@pytest.mark.parametrize(
    ("new", "old", "better"),
    [
        ((1.0, True), (2.0, True), True),
        ((2.0, True), (1.0, True), False),
        ((1.0, True), (1.0, True), False),
        ((1.0, False), (2.0, True), False),
        ((2.0, True), (1.0, False), True),
        ((1.0, False), (2.0, False), False),
        ((1.0, True), (np.nan, True), True),
    ],
)
def test_a_minimum_replaces_one_that_is_higher_or_is_none(new, old, better):
    assert minima(*new).better_than(minima(*old)).tolist() == [better]


def test_iterations_add_up_whether_a_search_was_of_use_or_not():
    first = replace(minima([3.0, 3.0, 3.0]), iterations=np.array([10, 20, 30]))
    again = replace(minima([1.0, 5.0], x=7.0), iterations=np.array([1, 2]))
    both = first.replaced(np.array([0, 2]), again, np.array([True, False]))
    assert both.iterations.tolist() == [11, 20, 32]
    assert both.x[:, 0].tolist() == [7.0, 0.0, 0.0]
    assert both.chi_square.tolist() == [1.0, 3.0, 3.0]


def test_every_start_of_a_linear_model_finds_the_one_minimum_and_costs_iterations():
    problem, z = LINEAR.problem, LINEAR.draw(0, 6).z
    found = [
        Multistart(starts=starts, confirmations=starts).estimate(problem, z) for starts in (1, 3, 5)
    ]
    for one in found:
        assert (one.extras["minima"] == 1).all()
        assert (one.extras["ambiguous"] == 0).all()
        assert [len(others) for others in one.alternatives] == [0] * 6
    assert (np.diff([one.iterations for one in found], axis=0) >= 2).all()


def test_a_square_has_two_minima_however_often_they_are_found():
    model = Written(lambda a: (a**2, 2 * a**2), first=1.0)
    problem = Problem(model, Covariance(np.full(2, 0.1)), np.array([1.0]))
    found = Multistart(starts=12, confirmations=12).estimate(problem, np.array([[4.0, 8.0]]))
    assert found.extras["minima"].tolist() == [2.0]
    assert np.abs(found.x[0]) == pytest.approx([2.0])
    assert found.alternatives[0] == pytest.approx(-found.x)


@pytest.mark.parametrize(("by", "known"), [(0.19, 1), (0.21, 2)])
def test_minima_a_tenth_of_a_deviation_apart_are_two(by, known):
    fitting = Fitting.none(1, 5)
    for x in (1.0, 1.0 + by, 1.0, 1.0 + by):
        assert fitting.note(minima(4.0, x=x), np.array([0])).all()
    assert len(fitting.known[0]) == known


@dataclass(frozen=True)
class Coarse(Bent):
    """Has Jacobians for a fifth of the cost, and no others but at the start."""

    coarse_jacobian_cost = 0.6  # type: ignore[assignment]

    def coarse_jacobian(self, x):
        return super().jacobian(x)

    def jacobian(self, x):
        if np.any(x):
            raise ArithmeticError("no slope here")
        return super().jacobian(x)


def test_a_slope_for_the_report_ends_no_trial():
    """The search ends far away, by coarse slopes; the covariance there would take an exact one,
    which raises."""
    z = Bent(0.3).simulate(np.array([[1.0, 0.5, -0.5]]))
    found = LevenbergMarquardt(max_iterations=1).estimate(
        replace(LINEAR, measurement=Coarse(0.3)).problem, z
    )
    assert found.status.tolist() == [Status.MAX_ITERATIONS]
    assert found.messages == {}
    assert np.isnan(found.covariance).all()
    assert (found.x != 0).all()
    assert found.jacobians[0] == pytest.approx(2 * 0.2 + 1)


def test_no_start_begins_beyond_a_budget():
    """A step on three parameters costs 1 + 3: whatever was begun within 6 ends before two more of
    them."""
    z = LINEAR.draw(0, 6).z
    found = Multistart(starts=8, confirmations=8, budget=6.0).estimate(LINEAR.problem, z)
    assert (found.simulations + 3 * found.jacobians <= 6 + 2 * (1 + 3)).all()
