"""Copies of a path by whole periods of a state: their probabilities against closed forms, slow sums
and frequencies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from shared.state_models import Pendulum, path_cost

import ipe_bench as ib
from ipe_bench.plugins.construct import construct
from ipe_bench.plugins.discovery import composed, options
from ipe_bench.real.logs import Log, LogTracks
from ipe_bench.states import Formulas, LevenbergMarquardtSmoother, Smoother, ekf
from ipe_bench.states.copies import SURE, copy_p
from ipe_bench.states.smoothers import whole
from ipe_bench.trials.paths import PathBlock, StateScenario

TURN = 2 * np.pi
COMPASS = Formulas(
    next={"angle": "angle"},
    readings={"z": "angle"},
    deviation={"z": 1e-3},
    spread={"angle": 4.0},
    period={"z": TURN},
    state_period={"angle": TURN},
    count=1,
)
"""A needle of which the turn is known by the prior alone, and the rest by a reading without
error."""


class Swinging(Pendulum):
    @property
    def state_periods(self):
        return TURN, 0.0


SWINGING = Swinging(count=60, step=0.05, spread=3.0, start=(0.5, 0.0))


def test_of_a_needle_read_without_error_it_is_the_ratio_of_prior_densities():
    z = np.array([0.3, 1.4, 3.1, -2.0])[:, None, None]
    p = copy_p(COMPASS, z, Smoother(ekf()).track(COMPASS, z))
    turns = z[:, 0] + TURN * np.arange(-30, 31)
    density = np.exp(-(turns**2) / 32.0)
    np.testing.assert_allclose(p, density[:, 30] / density.sum(axis=1), rtol=1e-5)


def test_so_many_paths_are_right_as_are_said_to_be():
    """The reading cannot tell the turn: of 2,000 needles the share at the turn of the track is the
    mean of p."""
    paths = COMPASS.draw(0, 2000)
    tracks = Smoother(ekf()).track(COMPASS, paths.z)
    p = copy_p(COMPASS, paths.z, tracks)
    right = np.abs(tracks.mean - paths.x)[:, 0, 0] < 1.0
    assert 0.3 < p.mean() < 0.9
    scatter = np.sqrt(np.sum(p * (1 - p))) / len(p)
    assert abs(right.mean() - p.mean()) < 4 * scatter


def test_it_is_the_sum_over_costs_of_all_copies():
    z = SWINGING.draw(0, 3).z
    tracks = LevenbergMarquardtSmoother().track(SWINGING, z)
    costs = []
    for turns in range(-12, 13):
        shift = np.array([TURN * turns, 0.0])
        costs.append(path_cost(SWINGING, z, tracks.start.mean + shift, tracks.mean + shift))
    weights = np.exp(-(np.array(costs) - costs[12]) / 2)
    np.testing.assert_allclose(copy_p(SWINGING, z, tracks), 1 / weights.sum(axis=0), rtol=1e-6)


def test_a_track_a_turn_away_is_as_good_and_less_probable():
    z = SWINGING.draw(0, 3).z
    tracks = LevenbergMarquardtSmoother().track(SWINGING, z)
    before = copy_p(SWINGING, z, tracks)
    away = np.array([3 * TURN, 0.0])
    far = replace(tracks, mean=tracks.mean + away)
    far.start = tracks.start._replace(mean=tracks.start.mean + away)
    after = copy_p(SWINGING, z, far)
    assert (after < 1e-3 * before).all()
    block = PathBlock.draw(StateScenario(SWINGING), 0, 3)
    none = np.zeros(3)
    near, there = (
        block._scored(one, {}, none, block.smoothed_variances, block.gates(True))[1]
        for one in (tracks, far)
    )
    np.testing.assert_array_equal(near["success"], there["success"])
    np.testing.assert_allclose(near["crlb_distance"], there["crlb_distance"], rtol=1e-6)
    np.testing.assert_array_equal(near["copy_p"], before)
    np.testing.assert_array_equal(near["extra_ambiguous"], before < SURE)
    assert (there["extra_ambiguous"] == 1).all()


def test_what_has_no_copies_has_no_probability_of_them():
    plain = Pendulum(count=5)
    z = plain.draw(0, 2).z
    assert copy_p(plain, z, Smoother(ekf()).track(plain, z)) is None  # no period
    assert copy_p(SWINGING, z, ekf().track(plain, z)) is None  # no path
    tracks = LevenbergMarquardtSmoother().track(replace(SWINGING, count=5), z)
    tracks.mean[1, 3] = np.nan
    p = copy_p(replace(SWINGING, count=5), z, tracks)
    assert np.isfinite(p).tolist() == [True, False]


def test_a_log_whose_copies_are_turns_of_one_angle_is_not_ambiguous():
    """A copy is the same angle at every epoch, whatever the prior says of its turns."""
    smoother, z = Smoother(ekf()), np.array([[0.2]])
    assert copy_p(COMPASS, z[None], smoother.track(COMPASS, z[None]))[0] < SURE
    assert not LogTracks.of(Log(COMPASS, z), "ekf_rts", smoother).notes


def test_states_in_rad_have_a_period_in_every_model_of_ours():
    for option in options("state_model"):
        if option.name == "formulas" or option.fault:
            continue
        model = construct(composed(option), option.package or option.group)
        periods = model.state_periods or np.zeros(model.n)
        for state, period in zip(model.states, periods, strict=True):
            assert period == (pytest.approx(TURN) if state.unit == "rad" else 0.0), option.name


@pytest.mark.slow
def test_the_turns_of_a_pendulum_are_as_probable_as_is_said():
    """At error scale 4 the prior knows the turn with a probability of .57."""
    option = next(one for one in options("state_model") if one.name == "pendulum")
    model = construct(composed(option), option.package or option.group)
    block = PathBlock.draw(StateScenario(model, seed=3, error_scale=4.0), 0, 100)
    tracker = LevenbergMarquardtSmoother()
    columns = block.estimate(tracker)[1]
    tracks = tracker.track(block.scenario.assumed, block.paths.z)
    held = columns["path_success"]
    off = (tracks.mean - block.paths.x)[held, -1, 0]
    p = columns["copy_p"][held]
    right = np.abs(off) < 1.0
    assert abs(right.mean() - p.mean()) < 4 * np.sqrt(np.sum(p * (1 - p))) / len(p)
    wrong = ~columns["success"] & (columns["fit_p"] >= 1e-3)
    assert wrong.any()
    assert (columns["extra_ambiguous"][wrong] == 1).all()


def test_a_path_goes_on_in_the_turn_of_its_start():
    """Steps are told from each other but for whole turns, so that a jump by one of them costs
    nothing."""
    wide = {"angle": 4.0, "rate": 4.0}
    model = ib.component("state_model/pendulum", count=150, spread=wide)
    tracks = LevenbergMarquardtSmoother().track(model, model.draw(0, 40).z)
    x, _ = whole(tracks)
    f, _ = model.values_along(x)
    jumps = np.round((x[:, 1:, 0] - f[..., 0]) / TURN)
    assert not jumps.any()


def test_turns_are_taken_from_a_path_only_where_that_costs_nothing():
    """A reading without a period tells the turns of a state with one: the cost is that of the path
    that is returned."""
    model = Formulas(
        next={"angle": "angle+w"},
        readings={"z": "angle"},
        noise={"w": 4.0},
        deviation={"z": 0.1},
        spread={"angle": 1.0},
        state_period={"angle": TURN},
        count=8,
    )
    z = model.draw(0, 8).z
    tracks = LevenbergMarquardtSmoother().track(model, z)
    angle = np.concatenate([tracks.start.mean, tracks.mean[..., 0]], axis=1)
    step = np.diff(angle, axis=1)
    step -= TURN * np.round(step / TURN)
    missed = z[..., 0] - angle[:, 1:]
    cost = angle[:, 0] ** 2 + np.sum((step / 4.0) ** 2 + (missed / 0.1) ** 2, axis=1)
    np.testing.assert_allclose(tracks.cost, cost, rtol=1e-9)
