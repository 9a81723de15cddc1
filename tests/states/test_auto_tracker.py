"""The default tracker: which stage answers what."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from shared.state_models import SQUARE, ConstantVelocity, CoordinatedTurn, Growth

import ipe_bench as ib
from ipe_bench.states import (
    AutoTracker,
    Bootstrap,
    Formulas,
    Grid,
    LevenbergMarquardtSmoother,
    Smoother,
    ekf,
    ukf,
)
from ipe_bench.states.auto import AGAIN, DAMPED, EXACT, EXTENDED, MIRRORED, UNSCENTED
from ipe_bench.states.whole_paths import PathDensity
from ipe_bench.trials.paths import PathBlock, StateScenario

LOST = Formulas(
    next={"x": "x/2 + 25*x/(1 + x**2) + 8*cos(1.2*k) + w", "offset": "offset"},
    readings={"z": "x**2/20 + offset"},
    noise={"w": 3.2},
    deviation={"z": 1.0},
    spread={"x": 1.4, "offset": 0.1},
    count=30,
)
"""Growth with a second state: readings leave the sign of the first one open, so that paths are
lost."""
BY_STATE = Formulas(
    next={"x": "0.9*x + w", "offset": "offset"},
    readings={"z": "x + offset"},
    noise={"w": 0.3},
    deviation={"z": "0.1 + 0.5*abs(x)"},
    spread={"x": 1.0, "offset": 0.1},
    count=20,
)
NOISY = replace(SQUARE, readings={"z": "x"}, deviation={"z": "sqrt(0.01 + x**2/4)"})
VOLATILITY = replace(SQUARE, readings={"z": "0"}, deviation={"z": "exp(x/2)"})
"""Whose readings tell of the state by their size alone."""


def test_a_linear_model_is_answered_by_its_first_stage():
    model = ConstantVelocity(count=15)
    z = model.draw(0, 6).z
    z[2, 3:7] = np.nan
    z[4] += 50.0 * (np.arange(15) % 2)[:, None]  # improbable in every stage
    found, exact = AutoTracker().track(model, z), Smoother(ekf()).track(model, z)
    np.testing.assert_array_equal(found.stage, EXTENDED)
    np.testing.assert_allclose(found.mean, exact.mean, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.covariance, exact.covariance, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.cost, exact.cost, rtol=1e-9)


class Unrecorded(ConstantVelocity):
    """The same by a transition that looks at its numbers, of which a recording has none."""

    def transition(self, x, k):
        assert np.isfinite(x).all()
        return super().transition(x, k)


def test_a_linear_model_that_is_not_recorded_is_tracked_as_one_that_is():
    recorded = ConstantVelocity(count=5)
    model = Unrecorded(count=5)
    assert model.epoch_functions[0].why
    z = recorded.draw(0, 3).z
    found = AutoTracker().track(model, z)
    np.testing.assert_allclose(found.mean, AutoTracker().track(recorded, z).mean, rtol=1e-12)


def test_each_stage_answers_where_those_before_it_do_not():
    """More rounds keep or lower the cost, and only those trials change that the earlier stages
    leave improbable."""
    z = LOST.draw(0, 40).z
    with np.errstate(all="ignore"):
        tracks = [
            AutoTracker(LevenbergMarquardtSmoother(rounds=rounds)).track(LOST, z)
            for rounds in (0, 1, 2)
        ]
    assert set(tracks[0].stage) <= {DAMPED, MIRRORED}
    assert AGAIN + 1 in tracks[2].stage
    for number in (1, 2):
        before, after = tracks[number - 1 : number + 1]
        # The mirrored start has not answered.
        plain = (before.stage != MIRRORED) & (after.stage != MIRRORED)
        changed = plain & (after.stage == AGAIN + number - 1)
        assert (after.cost[changed] < before.cost[changed]).all()
        same = plain & ~changed
        np.testing.assert_array_equal(after.mean[same], before.mean[same])


@pytest.mark.parametrize(
    "model", [SQUARE, NOISY, VOLATILITY], ids=["square", "noise by state", "volatility"]
)
def test_a_folded_reading_of_a_scalar_state_has_the_exact_density(model):
    """As that of a grid of more points, a missing reading included; no other tracker looks."""
    z = model.draw(0, 3).z
    z[1, 4] = np.nan
    tracker = AutoTracker()
    assert tracker.hindrance(model) is None
    found = tracker.track(model, z)
    exact = Grid(700, smooths=True).track(model, z)
    np.testing.assert_array_equal(found.stage, EXACT)
    np.testing.assert_allclose(found.mean, exact.mean, atol=1e-4)
    np.testing.assert_allclose(found.covariance, exact.covariance, atol=1e-4)


@pytest.mark.parametrize("spread", [0.5, 2.0, 2 * np.pi / 3])
def test_a_reading_that_comes_round_among_scalar_states_has_the_exact_density(spread):
    """By sums over 3,001 states: with the last of these spreads, states a standard deviation apart
    have readings a whole turn apart, which look equal."""
    phase = Formulas(
        next={"x": "x + w"},
        readings={"phase": "3*x"},
        noise={"w": 0.2},
        deviation={"phase": 0.3},
        period={"phase": 2 * np.pi},
        spread={"x": spread},
        count=2,
    )
    z = phase.draw(0, 4).z
    found = AutoTracker().track(phase, z)
    np.testing.assert_array_equal(found.stage, EXACT)
    x = np.linspace(-15, 15, 3001)
    moved = np.exp(-0.5 * ((x[:, None] - x) / 0.2) ** 2)
    for trial in range(4):
        away = np.remainder(z[trial] - 3 * x + np.pi, 2 * np.pi) - np.pi
        first, last = np.exp(-0.5 * (away / 0.3) ** 2)
        p = last * (moved @ (first * (moved @ np.exp(-0.5 * (x / spread) ** 2))))
        mean = p @ x / p.sum()
        variance = p @ (x - mean) ** 2 / p.sum()
        assert found.mean[trial, -1, 0] == pytest.approx(mean, abs=1e-3)
        assert found.covariance[trial, -1, 0, 0] == pytest.approx(variance, rel=1e-3)


def test_what_is_predicted_of_a_reading_that_comes_round_does_not_depend_on_it():
    """A phase that is even on a turn beforehand has squared innovations that are one on average."""
    even = {"readings": {"z": "3*x"}, "period": {"z": 2 * np.pi}, "spread": {"x": 2.0}}
    phase = replace(SQUARE, **even, deviation={"z": 0.1}, count=1)
    z = np.linspace(-np.pi, np.pi, 41)[1:, None, None]
    found = Grid().track(phase, z)
    assert found.predicted is not None
    turned = np.remainder(found.predicted - found.predicted[0] + 1, 2 * np.pi)
    np.testing.assert_allclose(turned, 1.0)
    assert found.nis.mean() == pytest.approx(1.0, abs=0.02)


def test_a_scalar_state_whose_readings_come_round_far_away_needs_no_grid():
    phase = replace(SQUARE, readings={"z": "x"}, period={"z": 40.0}, spread={"x": 0.5})
    assert (AutoTracker().track(phase, phase.draw(0, 20).z).stage != EXACT).all()


def test_a_scalar_state_whose_readings_rise_evenly_needs_no_grid():
    for readings in ("x", "x + 0.1*x**2", "exp(x/3)", "(x + 20)**2/10"):
        model = replace(SQUARE, readings={"z": readings}, spread={"x": 0.5})
        assert (AutoTracker().track(model, model.draw(0, 20).z).stage != EXACT).all()


def test_a_trial_that_no_grid_suits_is_tracked_by_paths_and_disturbs_no_other():
    z = SQUARE.draw(0, 3).z
    plain = AutoTracker().track(SQUARE, z)
    z[1, 5] = 1e6  # a state of 1,000
    found = AutoTracker().track(SQUARE, z)
    np.testing.assert_array_equal(found.stage == EXACT, [True, False, True])
    np.testing.assert_array_equal(found.mean[::2], plain.mean[::2])
    assert np.isfinite(found.cost).all()


def test_the_exact_density_leaves_no_second_path_open():
    block = PathBlock.draw(StateScenario(SQUARE), 0, 4)
    columns = block.estimate(AutoTracker())[1]
    assert (columns["extra_stage"] == EXACT).all()
    assert (columns["status"] == "converged").all()
    assert "extra_ambiguous" not in columns


@pytest.mark.slow
def test_on_growth_the_answer_is_that_of_the_grid_at_less_than_the_price_of_particles():
    table = ib.run(
        Growth(), {"auto": AutoTracker(), "grid": Grid(), "bootstrap": Bootstrap()}, trials=20
    )
    rows = table[table["parameter"] == "all"].set_index("estimator")
    assert rows.loc["auto", "success"] == rows.loc["grid", "success"]
    assert rows.loc["auto", "rmse_solved"] == pytest.approx(rows.loc["grid", "rmse_solved"], 1e-3)
    cost = rows["simulations_median"]
    assert cost["auto"] <= 1.2 * cost["bootstrap"]


def test_a_round_has_draws_of_its_own():
    density = PathDensity.of(LOST, LOST.draw(0, 3).z)
    begun = LevenbergMarquardtSmoother(starts=1)
    first, second, again = (begun.drawn(density, number).at.x for number in (0, 1, 1))
    assert (np.abs(first - second).max(axis=(1, 2)) > 1e-3).all()
    np.testing.assert_array_equal(second, again)


def test_noise_that_depends_on_the_states_is_left_to_the_likelier_smoother():
    z = BY_STATE.draw(0, 200).z
    z[:4] *= 30.0
    found = AutoTracker().track(BY_STATE, z)
    for stage, first in ((EXTENDED, ekf()), (UNSCENTED, ukf())):
        rows = found.stage == stage
        assert rows.any()
        smooth = Smoother(first).track(BY_STATE, z)
        for mine, its in (
            (found.mean, smooth.mean),
            (found.covariance, smooth.covariance),
            (found.start.mean, smooth.start.mean),
            (found.start.covariance, smooth.start.covariance),
            (found.cost, smooth.cost),
        ):
            np.testing.assert_array_equal(mine[rows], its[rows])


@pytest.mark.parametrize(
    "model",
    [LOST, SQUARE, replace(CoordinatedTurn(), count=20)],
    ids=["lost", "square", "turn"],
)
def test_a_trial_has_the_same_bits_alone_and_in_a_batch(model):
    z = model.draw(0, 5).z
    z[3, 4:6] = np.nan
    tracker = AutoTracker(LevenbergMarquardtSmoother(starts=3, rounds=2))
    with np.errstate(all="ignore"):
        together = tracker.track(model, z)
        for trial in (0, 3, 4):
            alone = tracker.track(model, z[trial : trial + 1])
            for name in ("mean", "covariance", "cost", "status", "stage", "iterations", "calls"):
                of_batch = getattr(together, name)[trial]
                np.testing.assert_array_equal(of_batch, getattr(alone, name)[0])


def test_the_column_extra_stage_says_which_stage_answered():
    block = PathBlock.draw(StateScenario(ConstantVelocity(count=5)), 0, 4)
    assert (block.estimate(AutoTracker())[1]["extra_stage"] == EXTENDED).all()
    assert "extra_stage" not in block.estimate(ekf())[1]


WALKS = Formulas(
    next={"x": "x + w", "y": "y + v"},
    readings={"z": "x**2"},
    noise={"w": 0.1, "v": 0.1},
    deviation={"z": 0.1},
    spread={"x": 1.0, "y": 1.0},
    count=20,
)


@pytest.mark.parametrize("reading", ["x**2", "cos(x)", "x*y", "(x - y)**2"])
@pytest.mark.parametrize("tracker", [AutoTracker(), LevenbergMarquardtSmoother()], ids=repr)
def test_no_path_rests_at_a_saddle(reading, tracker):
    """Where such a reading turns back, its tangents say nothing, and the cost curves downwards."""
    model = replace(WALKS, readings={"z": reading})
    z = model.draw(1, 8).z
    found = tracker.track(model, z)
    density = PathDensity.of(model, z)
    x = np.concatenate([found.start.mean[:, None], found.mean], axis=1)
    cost = density.settled(x).cost
    for way in ([1.0, 0.0], [0.0, 1.0], [1.0, 1.0], [1.0, -1.0]):
        aside = density.settled(x + 0.1 * np.array(way)).cost
        back = density.settled(x - 0.1 * np.array(way)).cost
        assert (aside + back >= 2 * cost - 0.5).all()


def test_a_state_that_no_reading_tells_of_takes_no_further_start():
    model = replace(WALKS, readings={"z": "x"})
    z = model.draw(1, 4).z
    found = AutoTracker().track(model, z)
    np.testing.assert_array_equal(found.stage, EXTENDED)
    np.testing.assert_allclose(found.mean, Smoother(ekf()).track(model, z).mean, atol=1e-9)
