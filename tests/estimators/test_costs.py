"""What is booked is what is evaluated: calls of the model, counted from outside, of every estimator
and tracker."""

from collections import Counter
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import pytest
from shared.families import slow_if
from shared.oracles import assert_agrees
from shared.small_models import Bent
from shared.state_models import ConstantVelocity, CoordinatedTurn, Growth
from shared.watched import check_cost

from ipe_bench.engine import rows
from ipe_bench.engine.rows import RowFunction
from ipe_bench.functions.judged import Judged
from ipe_bench.measurements import Gins
from ipe_bench.noise import Gaussian, Quantization
from ipe_bench.plugins.construct import construct
from ipe_bench.plugins.discovery import composed, options
from ipe_bench.states import Filter, Grid, IteratedSmoother, StateModel, Unscented, passes
from ipe_bench.trials.scenario import Scenario


def registered(*groups):
    found = [o for group in groups for o in options(group) if o.source.name == "ipe-bench"]
    return {o.name: construct(composed(o), o.package or o.group) for o in found}


ESTIMATORS = registered("solver", "baseline")
NOISE = Quantization(0.02286)
SMALL = Scenario(Bent(0.05), Gaussian(0.1))
SCENARIOS = {
    "gins-1": (Scenario(Gins(readings_per_case=6), NOISE), 2),
    "gins-100": (Scenario(Gins(readings_per_case=6), NOISE, error_scale=100.0), 2),
    "small-100": (replace(SMALL, error_scale=100.0), 4),
}

DEAR = [(name, "small-100") for name in ("steepest_descent", "auto", "progressive")]
DEAR += [(name, "gins-100") for name in ESTIMATORS]
"""Of these the same estimator is counted in a scenario that takes less."""


@pytest.mark.oracle(
    "own second implementation: calls counted from outside",
    "simulations and Jacobians of every estimator",
    1e-9,
)
@pytest.mark.parametrize(
    ("name", "scenario"),
    slow_if(lambda *pair: pair in DEAR, product(ESTIMATORS, SCENARIOS)),
)
def test_the_cost_of_an_estimator_is_what_it_evaluates(name, scenario):
    check_cost(ESTIMATORS[name], *SCENARIOS[scenario])


@pytest.mark.parametrize(
    "name",
    [
        "auto",
        "progressive",
        "relinearized",
        "levenberg_marquardt",
        pytest.param("multistart", marks=pytest.mark.slow),
    ],
)
def test_failures_cost_what_they_evaluate(name):
    """Where a search ends far from a minimum, the Jacobian for the covariance there is an
    evaluation of its own."""
    check_cost(ESTIMATORS[name], Scenario(Gins(readings_per_case=6), NOISE, error_scale=1e4), 1)


def test_a_budget_ends_a_search_and_not_the_report_of_it():
    scenario = Scenario(Gins(readings_per_case=6), NOISE, error_scale=100.0)
    problem, z = scenario.problem, scenario.draw(0, 3).z
    for solver in (ESTIMATORS["fixed_point"], ESTIMATORS["newton"]):
        free = solver.estimate(problem, z)
        least = free.simulations + problem.measurement.n * (free.jacobians - 1)
        found = replace(solver, budget=float(least.max())).estimate(problem, z)
        np.testing.assert_array_equal(found.x, free.x)
        np.testing.assert_array_equal(found.status, free.status)


TRACKERS = registered("tracker") | {
    "ieks, damped": IteratedSmoother(Filter(Unscented()), damped=True),
    "ieks, till it stays": IteratedSmoother(Filter(Unscented()), tolerance=1e-3),
    "grid, smoothing": Grid(points=800, smooths=True),
}


@dataclass(frozen=True)
class Exact(ConstantVelocity):
    """Its noise reaches one direction of two."""

    def gain(self, k):
        return super().gain(k)[:, :1]


MODELS = {"exact": Exact()} | {
    model.name: model for model in (Growth(), CoordinatedTurn(), ConstantVelocity())
}

TRACKED = [(name, model, True) for name in TRACKERS for model in MODELS]
TRACKED += [(name, "growth", False) for name in TRACKERS]


def dear(name: str, model: str, moved_first: bool) -> bool:
    """Whether the same tracker is counted on a model that takes less, or in the other order: each
    is counted at once on growth, and on one of the others by turns, which is never the dearest for
    trackers of many points."""
    if model == "growth":
        return name.startswith("grid") and not moved_first
    others = ["exact", "constant_velocity"]
    if name not in ("ghkf", "iplf", "ipls"):
        others.append("coordinated_turn")
    return model != others[[*TRACKERS].index(name) % len(others)]


def watched(model: StateModel, seen: Counter[str], first: bool) -> StateModel:
    """The model, counting the states of which it evaluates f and h; `first`: read before they move
    or after, and recorded or not."""

    class Watching(type(model)):
        moved_first = first

        def transition(self, x, k):
            return super().transition(self.watched(x), k)

        def observe(self, x, k):
            return super().observe(self.watched(x), k)

        def watched(self, x):
            assert first or type(x) is np.ndarray, "is not recorded"
            seen["calls"] += int(np.prod(np.shape(x)[:-1]))
            return x

    copy = object.__new__(Watching)
    vars(copy).update(vars(model))
    return copy


@pytest.fixture
def seen(monkeypatch):
    """Counts rows of recorded functions of a model, a slope as one for each direction. Products of
    matrices are arithmetic of a tracker, and run as functions of rows, too. What is asked beside to
    see whether functions and slopes are right is no cost of a tracker. Steps run by epoch, since
    functions within a recorded step cannot be counted from outside."""
    monkeypatch.setattr(passes, "_MOST_OPERATIONS", 0)
    monkeypatch.setattr(StateModel, "astray", lambda self, x: np.zeros(len(x), dtype=bool))
    monkeypatch.setattr(StateModel, "renew", lambda self: None)
    monkeypatch.setattr(Judged, "_doubted", lambda self, x, *_: np.zeros(len(x), dtype=bool))
    counted, values, slopes = Counter(), RowFunction.__call__, RowFunction.slopes
    arithmetic, product = set(), rows._product

    def noted(*sizes):
        function = product(*sizes)
        arithmetic.add(id(function))
        return function

    def count(function, times):
        def counting(self, x, c):
            if id(self) not in arithmetic:
                counted["calls"] += len(x) * times(x)
            return function(self, x, c)

        return counting

    monkeypatch.setattr(rows, "_product", noted)
    monkeypatch.setattr(RowFunction, "__call__", count(values, lambda x: 1))
    monkeypatch.setattr(RowFunction, "slopes", count(slopes, lambda x: 1 + x.shape[1]))
    return counted


@pytest.mark.oracle(
    "own second implementation: calls counted from outside", "evaluations of every tracker", 0.0
)
@pytest.mark.parametrize(("name", "model", "moved_first"), slow_if(dear, TRACKED))
def test_the_cost_of_a_tracker_is_what_it_evaluates(name, model, moved_first, seen):
    tracker = TRACKERS[name]
    model = watched(replace(MODELS[model], count=6), seen, moved_first)
    if tracker.hindrance(model):
        pytest.skip("is for other models")
    z, alone = model.draw(0, 2).z, []
    with np.errstate(all="ignore"):
        together = tracker.track(model, z).calls
        for trial in z:
            seen.clear()
            # A system that the model keeps from earlier trials would cost this one nothing.
            passes.kept_of(model).pop("frozen", None)
            alone.append(tracker.track(model, trial[None]).calls[0])
            assert_agrees(alone[-1], seen["calls"])
    np.testing.assert_array_equal(together, alone)
