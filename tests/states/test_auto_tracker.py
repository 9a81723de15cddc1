"""The default tracker: which stage answers what."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from shared.state_models import ConstantVelocity, CoordinatedTurn, Growth

from ipe_bench.states import (
    AutoTracker,
    Formulas,
    LevenbergMarquardtSmoother,
    Smoother,
    ekf,
    ukf,
)
from ipe_bench.states.auto import AGAIN, DAMPED, EXTENDED, MIRRORED, UNSCENTED
from ipe_bench.states.whole_paths import PathDensity
from ipe_bench.trials.paths import PathBlock, StateScenario

LOST = Growth(count=30)
"""Whose readings leave the sign of the state open, so that paths are lost."""
BY_STATE = Formulas(
    next={"x": "0.9*x + w"},
    readings={"z": "x"},
    noise={"w": 0.3},
    deviation={"z": "0.1 + 0.5*abs(x)"},
    spread={"x": 1.0},
    count=20,
)


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
    "model", [LOST, replace(CoordinatedTurn(), count=20)], ids=["lost", "turn"]
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
