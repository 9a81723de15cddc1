"""Readings beyond a gate: own filters, smoothers of logs without these readings, and what a log's
answer says of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

import ipe_bench as ib
from ipe_bench.report.page.log import _facts
from ipe_bench.states import (
    AutoTracker,
    Bootstrap,
    Filter,
    Formulas,
    Grid,
    IteratedSmoother,
    LevenbergMarquardtSmoother,
    Smoother,
    Unscented,
    ekf,
)

GATE = 0.999
LEVEL = Formulas(
    next={"x": "x + w"},
    readings={"z": "x"},
    noise={"w": 0.5},
    deviation={"z": 1.0},
    spread={"x": 10.0},
    count=40,
)
TURNED = Formulas(
    next={"x": "x + 0.1*v", "v": "0.99*v + w"},
    readings={"angle": "atan2(x, 2 + v**2)", "range": "sqrt(x**2 + 4)"},
    noise={"w": 0.2},
    deviation={"angle": 0.05, "range": 0.1},
    period={"angle": 2 * np.pi},
    start={"x": 1.0},
    spread={"x": 0.3, "v": 0.3},
    count=30,
)
BY_STATE = replace(TURNED, next={"x": "x + 0.1*v", "v": "0.99*v + w*(1 + x**2/10)"})
FILTERS = {
    "ekf": Filter(),
    "iekf": Filter(iterations=3),
    "ukf": Filter(Unscented()),
}


def spiked(model, trials=3):
    """Readings with two spikes in one of them at a time, and one that is missing."""
    z = model.draw(0, trials, 1).z.copy()
    z[0, 10, 0] += 30.3
    z[1, 20, -1] -= 50.0
    z[2, 5] = np.nan
    return z


def own_ekf(model, z, most):
    """The textbook filter of one trial, which leaves out each reading that is too far from its
    prediction; returns means, covariances and which were left out."""
    x, P = model.prior
    means = []
    covariances = []
    left_out = np.zeros(z.shape, dtype=bool)

    def slopes(function, x, k):
        columns = [function(x + 1e-20j * e, k).imag / 1e-20 for e in np.eye(len(x))]
        return np.stack(columns, axis=1)

    for k in range(model.epochs):
        G = model.gain_at(x[None], k)
        G = G[0] if G.ndim == 3 else G
        F = slopes(model.transition, x, k)
        x = model.transition(x, k)
        P = F @ P @ F.T + G @ G.T
        H = slopes(model.observe, x, k)
        R = model.R(k)
        y = z[k] - model.observe(x, k)
        for j, period in enumerate(model.periods):
            if period:
                y[j] -= period * np.round(y[j] / period)
        S = H @ P @ H.T + R
        left_out[k] = y**2 > most * np.diag(S)
        rows = np.flatnonzero(np.isfinite(y) & ~left_out[k])
        K = P @ H[rows].T @ np.linalg.inv(S[np.ix_(rows, rows)])
        x = x + K @ y[rows]
        P = P - K @ S[np.ix_(rows, rows)] @ K.T
        means.append(x)
        covariances.append(P)
    return np.array(means), np.array(covariances), left_out


@pytest.mark.parametrize("model", [LEVEL, TURNED, BY_STATE], ids=["level", "turned", "by_state"])
def test_a_gate_leaves_out_what_the_textbook_filter_leaves_out(model):
    z = spiked(model)
    tracks = Filter(gate=GATE).track(model, z)
    for trial in range(len(z)):
        x, P, left_out = own_ekf(model, z[trial], chi2.ppf(GATE, 1))
        np.testing.assert_array_equal(tracks.gated[trial], left_out)
        np.testing.assert_allclose(tracks.mean[trial], x, rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(tracks.covariance[trial], P, rtol=1e-8, atol=1e-12)
    assert tracks.gated[0, 10].tolist() == [True, *[False] * (z.shape[2] - 1)]
    assert tracks.gated[1, 20, -1]
    assert not tracks.gated[2, 5].any()


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("model", [LEVEL, TURNED, BY_STATE], ids=["level", "turned", "by_state"])
def test_what_lies_beyond_the_gate_is_missing(model, name):
    """Bit for bit the track of a log without it, alone and among others, and that of its
    smoother."""
    z = spiked(model)
    one = FILTERS[name]
    for plain in (one, Smoother(one)):
        gated = plain.gated(GATE)
        tracks = gated.track(model, z)
        assert tracks.gated.sum() >= 2
        without = plain.track(model, np.where(tracks.gated, np.nan, z))
        alone = gated.track(model, z[1:2])
        for part in ("mean", "covariance", "nis", "log_likelihood", "degrees"):
            np.testing.assert_array_equal(getattr(tracks, part), getattr(without, part))
            np.testing.assert_array_equal(getattr(tracks, part)[1:2], getattr(alone, part))


@pytest.mark.parametrize("name", FILTERS)
def test_a_reading_without_a_value_loses_the_trial_and_lies_beyond_no_gate(name):
    """The logarithm has no value at the prior's mean of -0.1, whatever was read."""
    model = replace(LEVEL, readings={"z": "log(x)"}, start={"x": -0.1}, spread={"x": 0.01}, count=3)
    for form in (model, model.by_epoch()):
        tracks = FILTERS[name].gated(GATE).track(form, np.zeros((1, 3, 1)))
        assert np.isnan(tracks.mean).all()
        assert not tracks.gated.any()


def test_a_path_is_that_of_the_readings_that_its_first_filter_takes():
    z = spiked(LEVEL)
    tracks = IteratedSmoother().gated(GATE).track(LEVEL, z)
    behind = Smoother().gated(GATE).track(LEVEL, z)
    assert tracks.gated.sum() == 2
    np.testing.assert_allclose(tracks.mean, behind.mean, atol=1e-10)


def test_a_whole_turn_is_not_beyond_the_gate():
    z = TURNED.draw(0, 1, 3).z
    turned = z + np.array([2 * np.pi, 0.0])
    one, other = (Filter(gate=GATE).track(TURNED, each) for each in (z, turned))
    np.testing.assert_array_equal(one.gated, other.gated)
    np.testing.assert_allclose(one.mean, other.mean, rtol=1e-9, atol=1e-12)


def test_a_log_names_what_is_left_out_and_fits():
    z = LEVEL.draw(0, 1, 1).z[0].copy()
    z[10] += 30
    z[25] -= 20
    (plain,) = ib.estimate(LEVEL, z, {"ekf": ekf()})
    (one,) = ib.estimate(LEVEL, z, {"ekf": Filter(gate=GATE)})
    assert not plain.passes
    assert (one.passes, one.verdict) == (True, "consistent")
    (note,) = one.notes
    assert note == "left out, as beyond the gate: 2 of 40 readings, at time steps 11, 26"
    answer = ib.estimate(LEVEL, z, {"ekf": Filter(gate=GATE)})
    assert "5 % of the readings, beyond the gate of ekf" in str(_facts(answer)[-1])
    table = answer.table()
    assert np.flatnonzero(table["z_left_out"]).tolist() == [10, 25]
    # A reading that is left out is predicted all the same.
    assert np.isfinite(table["z_predicted"]).all()


def test_the_mean_of_nis_is_one_though_a_gate_leaves_out_its_largest():
    """Of a chi-square with one degree that is cut at its 99 % quantile the mean is 0.925."""
    long = replace(LEVEL, count=4000)
    (one,) = ib.estimate(long, long.draw(0, 1, 2).z[0], {"ekf": Filter(gate=0.99)})
    assert one.mean_nis == pytest.approx(1.0, abs=0.05)
    assert one.mean_nis * 0.9247 == pytest.approx(np.nanmean(one.nis), rel=1e-3)
    assert one.share_gated == pytest.approx(0.01, abs=0.005)
    assert one.passes


def test_a_model_whose_readings_lie_beyond_the_gate_is_a_misfit():
    """Readings three times as noisy as stated lie beyond the 95 % quantile in half of all cases."""
    z = replace(LEVEL, deviation={"z": 3.0}).draw(0, 1, 1).z[0]
    (one,) = ib.estimate(LEVEL, z, {"ekf": Filter(gate=0.95)})
    assert one.share_gated > 0.2
    assert (one.passes, one.verdict) == (False, "wrong")
    assert "of the readings lie beyond the gate" in one.message


def test_a_filter_that_takes_no_reading_any_more_is_lost():
    z = LEVEL.draw(0, 1, 1).z[0].copy()
    z[34:] += 500
    (one,) = ib.estimate(LEVEL, z, {"ekf": Filter(gate=GATE)})
    assert (one.verdict, one.passes) == ("lost from time step 35", False)


def test_a_filter_is_lost_though_most_epochs_have_no_reading():
    sparse = replace(LEVEL, count=200)
    z = sparse.draw(0, 1, 1).z[0].copy()
    z[np.arange(200) % 5 != 4] = np.nan
    z[180:] += 500
    (one,) = ib.estimate(sparse, z, {"ekf": Filter(gate=GATE)})
    assert one.share_gated == 4 / 40
    assert (one.verdict, one.passes) == ("lost from time step 185", False)


def test_an_outlier_at_the_end_of_a_log_is_no_lost_track():
    z = LEVEL.draw(0, 1, 1).z[0].copy()
    z[-1] += 30
    (one,) = ib.estimate(LEVEL, z, {"ekf": Filter(gate=GATE)})
    assert one.gated is not None
    assert np.flatnonzero(one.gated).tolist() == [39]
    assert (one.verdict, one.passes) == ("consistent", True)


def test_chance_at_the_end_of_a_log_is_no_lost_track():
    """A 95 % gate leaves out the last reading of one log in twenty; lost tracks leave out more."""
    z = LEVEL.draw(0, 60, 7).z
    tracks = [ib.estimate(LEVEL, one, {"ekf": Filter(gate=0.95)})[0] for one in z]
    lost = [one for one in tracks if one.lost_from is not None]
    assert all(one.share_gated > 0.2 for one in lost)


def own_solution(model, z):
    """The most probable states of a local level by dense algebra, and their covariance."""
    K = model.epochs
    # Each state is the start and all steps up to it.
    sums = np.tril(np.ones((K, K)))
    steps = np.full(K, model.noise["w"] ** 2)
    steps[0] += model.spread["x"] ** 2
    P = sums @ np.diag(steps) @ sums.T
    at = np.flatnonzero(np.isfinite(z))
    S = P[np.ix_(at, at)] + model.deviation["z"] ** 2 * np.eye(len(at))
    gain = P[:, at] @ np.linalg.inv(S)
    return gain @ z[at], P - gain @ P[at]


@pytest.mark.parametrize("tracker", [LevenbergMarquardtSmoother(), AutoTracker()])
def test_a_path_leaves_out_what_is_too_far_from_all_other_readings(tracker):
    """Each reading is judged by the path of all others that are taken, with it left out by hand."""
    z = LEVEL.draw(0, 20, 4).z.copy()
    rng = np.random.default_rng(1)
    z += np.where(rng.random(z.shape) < 0.08, rng.choice([-8.0, 8.0], z.shape), 0.0)
    tracks = tracker.gated(0.99).track(LEVEL, z)
    most = chi2.ppf(0.99, 1)
    near = 0
    for trial, out in enumerate(tracks.gated[..., 0]):
        taken = np.where(out, np.nan, z[trial, :, 0])
        x, P = own_solution(LEVEL, taken)
        np.testing.assert_allclose(tracks.mean[trial, :, 0], x, atol=1e-9)
        np.testing.assert_allclose(tracks.covariance[trial, :, 0, 0], np.diag(P), rtol=1e-9)
        for k in range(LEVEL.epochs):
            others = taken.copy()
            others[k] = np.nan
            x, P = own_solution(LEVEL, others)
            beyond = (z[trial, k, 0] - x[k]) ** 2 > most * (P[k, k] + 1.0)
            assert out[k] or not beyond
            near += out[k] and not beyond
    # Two readings may each be beyond without the other; then both stay out.
    assert near <= 2
    assert tracks.gated.any(axis=(1, 2)).sum() > 10


def test_a_grid_leaves_out_what_the_filter_of_a_linear_model_leaves_out():
    z = spiked(LEVEL)
    exact = Grid(300).gated(GATE).track(LEVEL, z)
    tracks = Filter(gate=GATE).track(LEVEL, z)
    np.testing.assert_array_equal(exact.gated, tracks.gated)
    np.testing.assert_allclose(exact.mean, tracks.mean, atol=1e-4)
    np.testing.assert_array_equal(Bootstrap().gated(GATE).track(LEVEL, z).gated, tracks.gated)


def test_two_probable_states_are_no_reason_to_leave_a_reading_out():
    """The mean of both roots of a square is 0, from which every reading is far away."""
    square = replace(LEVEL, next={"x": "0.9*x + w"}, readings={"z": "x**2"}, deviation={"z": 0.3})
    square = replace(square, spread={"x": 1.0})
    z = square.draw(0, 3, 1).z.copy()
    z[0, 10] += 20
    for tracker in (AutoTracker(), Grid(200), Bootstrap()):
        gated = tracker.gated(GATE).track(square, z).gated
        assert np.argwhere(gated).tolist() == [[0, 10, 0]]


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (
            ["tracker=[ipe_newton]", "gate=0.99"],
            "gate=0.99: trackers.ipe_newton takes no gate; choose a filter or a smoother",
        ),
        (["tracker=[ekf]", "gate=0.99", "find=[w]"], "find: the likelihood of trackers.ekf jumps"),
        (["tracker=[ekf]", "gate=0"], "gate=0.0: give a number above 0 and up to 1"),
        (["tracker=[ekf]", "gate=99.9"], "at most 1; write gate=0.999 for 99.9 %"),
    ],
)
def test_what_takes_no_gate_says_so(ipe_bench, tmp_path, words, complaint):
    (tmp_path / "log.csv").write_text("z\n1\n2\n3\n")
    model = "next.x=x+w readings.z=x noise.w=1 deviation.z=1 spread.x=1"
    given = [f"state_model.{word}" for word in model.split()]
    told = ipe_bench("estimate", "state_model=formulas", *given, "readings=log.csv", *words)
    assert told[0] == 2
    assert complaint in told[2]
