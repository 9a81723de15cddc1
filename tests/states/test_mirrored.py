"""Second paths beside the best one: what beacons on one line and a fast pendulum leave open."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm
from shared.state_models import ConstantVelocity

import ipe_bench as ib
from ipe_bench.real.logs import Log, LogTracks
from ipe_bench.states import AutoTracker, Formulas
from ipe_bench.states.copies import SURE
from ipe_bench.states.damped import Descent
from ipe_bench.states.linearisation import Taylor
from ipe_bench.states.mirrored import _two, _ways_round, in_first_turn
from ipe_bench.states.trackers import filtered
from ipe_bench.states.whole_paths import PathDensity
from ipe_bench.trials.paths import PathBlock, StateScenario

BEACONS = Formulas(
    next={"x": "x + vx + wx/2", "vx": "vx + wx", "y": "y + vy + wy/2", "vy": "vy + wy"},
    readings={"a": "hypot(x, y)", "b": "hypot(x - 10, y)"},
    noise={"wx": 0.01, "wy": 0.01},
    deviation={"a": 0.1, "b": 0.1},
    start={"x": 5.0},
    spread={"x": 1.0, "vx": 0.05, "y": 3.0, "vy": 0.05},
    units={"x": "m", "vx": "m/s", "y": "m", "vy": "m/s"},
    count=15,
)
"""Ranges to two beacons on the line y = 0, which leave the side of the line open, as the prior
does."""
MIRROR = np.array([1.0, 1.0, -1.0, -1.0])
Y = 2


def test_the_second_path_is_the_mirror_image_and_as_probable():
    paths = BEACONS.draw(0, 20)
    found = AutoTracker().track(BEACONS, paths.z)
    away = np.abs(paths.x[:, :, Y]).min(axis=1) > 1.0  # from the line, from beginning to end
    assert away.sum() > 8
    assert found.other is not None
    assert found.other_p is not None
    np.testing.assert_allclose(found.other_p[away], 0.5, atol=2e-3)
    np.testing.assert_allclose(found.other[away], MIRROR * found.mean[away], atol=0.02)


@pytest.mark.slow
def test_the_mirror_image_of_a_heading_is_its_negative():
    """A robot drives with unit speed past two beacons on the line y = 0: its image drives on the
    other side of it, with the heading of opposite sign."""
    robot = replace(
        BEACONS,
        next={"x": "x + cos(a) + wx", "y": "y + sin(a) + wy", "a": "a + wa"},
        noise={"wx": 0.02, "wy": 0.02, "wa": 0.01},
        spread={"x": 0.5, "y": 5.0, "a": 0.3},
        units={"x": "m", "y": "m", "a": "rad"},
        state_period={"a": 2 * np.pi},
    )
    paths = robot.draw(0, 20)
    found = AutoTracker().track(robot, paths.z)
    away = np.abs(paths.x[:, :, 1]).min(axis=1) > 1.0
    assert away.sum() >= 8
    assert found.other is not None
    assert found.other_p is not None
    np.testing.assert_allclose(found.other_p[away], 0.5, atol=2e-3)
    image = np.array([1.0, -1.0, -1.0]) * found.mean[away]
    np.testing.assert_allclose(found.other[away], image, atol=0.02)


def test_the_covariance_counts_the_second_path():
    """The truth lies on either side: errors are as large as is said, of the two paths together."""
    paths = BEACONS.draw(0, 150)
    found = AutoTracker().track(BEACONS, paths.z)
    away = np.abs(paths.x[:, :, Y]).min(axis=1) > 1.0
    error = (found.mean - paths.x)[away, -1, Y]
    variance = found.covariance[away, -1, Y, Y]
    wrong = np.abs(error) > 1.0
    assert 0.3 < wrong.mean() < 0.7
    ratio = error**2 / variance
    # Of two sides of equal probability it is 0 or 2, of the normal errors beside them hardly more.
    assert abs(ratio.mean() - 1.0) < 4 / np.sqrt(len(ratio))


ASYMMETRIC = Formulas(
    next={"x": "x + w"},
    readings={"z": "x**2 - 0.3*x**3"},
    noise={"w": 1e-3},
    deviation={"z": 0.05},
    spread={"x": 1.0},
    count=4,
)
"""A nearly constant state, read four times by a function with a wide slope and a steep one."""


@pytest.mark.slow
def test_the_probability_of_a_second_path_of_another_width_is_that_of_the_exact_posterior():
    paths = ASYMMETRIC.draw(0, 400)
    found = AutoTracker().track(ASYMMETRIC, paths.z)
    assert found.other is not None
    assert found.other_p is not None
    here, there, p = found.mean[:, -1], found.other[:, -1], found.other_p
    x = np.linspace(-8.0, 8.0, 20_001)
    misfit = ((paths.z - (x**2 - 0.3 * x**3)) ** 2).sum(axis=1) / 0.05**2
    logarithm = -0.5 * (x**2 + misfit)
    w = np.exp(logarithm - logarithm.max(axis=1, keepdims=True))
    w /= w.sum(axis=1, keepdims=True)
    exact = np.sum(w * (np.abs(x - there) < np.abs(x - here)), axis=1)
    two = p > 0
    assert two.sum() > 200
    assert np.median(np.abs(p - exact)[two]) < 0.005
    assert np.abs(p - exact)[two].max() < 0.1
    truth = np.abs(paths.x[:, -1] - there) < np.abs(paths.x[:, -1] - here)
    assert abs(p[two].mean() - truth[two].mean()) < 0.06
    assert (p > 0.5).sum() > 100
    moment = np.sum(w * (x - here) ** 2, axis=1)
    ratio = (moment / found.covariance[:, -1, 0, 0])[two]
    assert 0.98 < ratio.min() < np.median(ratio) < 1.03
    assert ratio.max() < 1.25


def test_the_covariance_of_a_state_is_that_of_either_path_by_its_probability():
    """What x y says of y, which both paths have near 0, depends on how large x is in each."""
    model = replace(
        ASYMMETRIC,
        next={"x": "x + w", "y": "y"},
        readings={"z": "x**2 - 0.3*x**3", "b": "x*y"},
        deviation={"z": 0.05, "b": 2.0},
        spread={"x": 1.0, "y": 1.0},
    )
    z = model.draw(0, 100).z
    z[:, :, 1] = 0.0  # so that y is 0 in either path
    found = AutoTracker().track(model, z)
    assert found.other_p is not None
    x = np.linspace(-8.0, 8.0, 20_001)
    misfit = ((z[:, :, :1] - (x**2 - 0.3 * x**3)) ** 2).sum(axis=1) / 0.05**2
    # Of y given x: variance 1 / (1 + K x^2 / 4), and readings of density (1 + K x^2 / 4)^-1/2.
    variance = 1 / (1 + model.count * x**2 / 4)
    logarithm = -0.5 * (x**2 + misfit) + 0.5 * np.log(variance)
    w = np.exp(logarithm - logarithm.max(axis=1, keepdims=True))
    exact = np.sum(w * variance, axis=1) / w.sum(axis=1)
    two = (found.other_p > 0.1) & (found.other_p < 0.9)
    assert two.sum() > 40
    ratio = exact / found.covariance[:, -1, 1, 1]
    np.testing.assert_allclose(np.median(ratio[two]), 1.0, atol=0.01)
    assert np.abs(ratio[two] - 1).max() < 0.1


def test_a_log_says_that_a_second_path_is_the_likelier_one():
    z = np.array([[1.670313], [1.705320], [1.530839], [1.590580]])
    (note,) = LogTracks.of(Log(ASYMMETRIC, z), "auto", AutoTracker()).notes
    said = (
        "AMBIGUOUS: a second path is right with a probability of 0.78, likelier than this one; in"
    )
    assert note.startswith(said)


@pytest.mark.slow
def test_a_trial_that_a_mirror_image_leaves_open_is_ambiguous():
    block = PathBlock.draw(StateScenario(BEACONS), 0, 20)
    columns = block.estimate(AutoTracker())[1]
    away = np.abs(block.paths.x[:, :, Y]).min(axis=1) > 1.0
    assert (columns["extra_ambiguous"][away] == 1).all()
    assert "copy_p" not in columns  # no state has a period


def test_a_prior_that_knows_the_side_leaves_nothing_open():
    model = replace(BEACONS, start={"x": 5.0, "y": 12.0})
    block = PathBlock.draw(StateScenario(model), 0, 20)
    columns = block.estimate(AutoTracker())[1]
    assert columns["success"].all()
    assert (columns["extra_ambiguous"] == 0).all()


def test_a_linear_model_has_no_second_path_and_pays_for_none():
    model = ConstantVelocity(count=8)
    z = model.draw(0, 3).z
    found = AutoTracker().track(model, z)
    np.testing.assert_array_equal(found.other_p, 0.0)
    np.testing.assert_array_equal(found.other, found.mean)


def test_a_log_says_that_a_second_path_fits():
    paths = BEACONS.draw(0, 6)
    trial = int(np.argmax(np.abs(paths.x[:, :, Y]).min(axis=1)))
    (note,) = LogTracks.of(Log(BEACONS, paths.z[trial]), "auto", AutoTracker()).notes
    assert note.startswith("AMBIGUOUS: a second path is right with a probability of 0.5; in it y")
    assert 1 - SURE < 0.5


@pytest.mark.slow
def test_a_fast_pendulum_is_found_from_the_mirrored_start():
    """A pendulum that turns either way has nearly the same sine: the cheaper path is taken, and
    what is lost is known to be open and counted in the covariances."""
    model = ib.component("state_model/pendulum")
    block = PathBlock.draw(StateScenario(model, seed=5, error_scale=10.0), 0, 100)
    columns = block.estimate(AutoTracker())[1]
    assert columns["success"].mean() > 0.9
    assert 0.6 < np.mean(columns["nees"]) / model.n < 1.4


def test_half_a_period_away_a_second_path_lies_either_way_round():
    """Of a truth on the far side of a circle half lies one way round, half the other: its second
    moment with a state that is not periodic vanishes."""
    model = ib.component("state_model/pendulum", count=3)
    density = PathDensity.of(model, model.draw(0, 1).z)
    P = np.tile(0.01 * np.eye(2), (1, 3, 1, 1))
    d = np.tile([np.pi, 5.0], (1, 3, 1))
    ways = _ways_round(density, P, d)
    moment = sum(share[..., None] * way[..., :1] * way[..., 1:] for share, way in ways)
    np.testing.assert_allclose(moment, 0.0, atol=1e-9)
    assert sum(share.sum() for share, _ in ways) == pytest.approx(3.0)
    # A deviation short of half a period, a sixth lies the other way round.
    (near, _), (beyond, _) = _ways_round(density, P, d - [0.1, 0.0])
    np.testing.assert_allclose(beyond, norm.sf(1.0))
    np.testing.assert_allclose(near, norm.cdf(1.0))


def test_a_path_is_moved_to_the_turn_that_the_prior_prefers():
    model = ib.component("state_model/pendulum", count=50)
    drawn = model.draw(0, 4)
    density = PathDensity.of(model, drawn.z)
    x = np.concatenate([drawn.start[:, None], drawn.x], axis=1)
    away = x + np.array([4 * np.pi, 0.0])
    tracks = AutoTracker().track(model, drawn.z)
    begun = Descent.of(density, filtered(model, drawn.z, Taylor()))
    moved = in_first_turn(density, replace(begun, at=density.settled(away)))
    np.testing.assert_allclose(moved.at.x, x, atol=1e-9)
    # Paths that are in this turn already cost nothing.
    away[2:] = x[2:]
    some = replace(begun, at=density.settled(away))
    spent = in_first_turn(density, some).calls - some.calls
    assert (spent[:2] > 0).all()
    assert (spent[2:] == 0).all()
    assert (tracks.cost <= moved.at.cost).all()


def test_paths_are_two_where_a_state_lies_beyond_three_deviations_at_some_time_step():
    tracks: Any = SimpleNamespace(covariance=np.tile(np.diag([4.0, 0.25]), (3, 5, 1, 1)))
    d = np.zeros((3, 5, 2))
    d[0, 2, 0], d[1, 2, 0], d[2, 4, 1] = 5.9, -6.1, 1.6
    assert _two(tracks, d).tolist() == [False, True, True]
