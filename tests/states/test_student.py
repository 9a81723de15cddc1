"""Readings with Student's t noise: exact densities on own grids, the mode of the joint density, and
what a log's answer says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import minimize
from scipy.stats import kstest, norm, t

import ipe_bench as ib
from ipe_bench.states import (
    AutoTracker,
    Bootstrap,
    Filter,
    Formulas,
    Grid,
    IteratedSmoother,
    LevenbergMarquardtSmoother,
    PathIPE,
    Smoother,
    Unscented,
    bound_at_truth,
    ekf,
    ukf,
)
from ipe_bench.states.student import evidence, mixture, scores

NU = 4.0
SCALE = np.sqrt((NU - 2) / NU)
LEVEL = Formulas(
    next={"x": "x + w"},
    readings={"z": "x"},
    noise={"w": 0.5},
    deviation={"z": 1.0},
    student={"z": NU},
    spread={"x": 3.0},
    count=30,
)
NORMAL = replace(LEVEL, student={})
TURNED = Formulas(
    next={"x": "x + 0.1*v", "v": "0.99*v + w"},
    readings={"angle": "atan2(x, 2 + v**2)", "range": "sqrt(x**2 + 4)"},
    noise={"w": 0.2},
    deviation={"angle": 0.05, "range": 0.1},
    student={"range": 3.0},
    period={"angle": 2 * np.pi},
    start={"x": 1.0},
    spread={"x": 0.3, "v": 0.3},
    count=20,
)


@pytest.mark.parametrize("nu", [2.5, 4.0, 30.0])
def test_a_mixture_is_the_density_that_scipy_has(nu):
    y = np.array([0.0, 0.3, 1.0, -2.0, 5.0, 30.0, -300.0])
    one = mixture(nu)
    known = t(nu, scale=np.sqrt((nu - 2) / nu))
    found = evidence(y, np.full(y.shape, one.least), 1.0, one)
    np.testing.assert_allclose(found.density, known.logpdf(y), atol=1e-4)
    # The slope of the log density is that of the posterior mean (Masreliez).
    score = (nu + 1) * y / (nu - 2 + y**2)
    np.testing.assert_allclose(found.gain * y, score, rtol=1e-3)
    normal = -np.sign(y) * norm.ppf(known.sf(np.abs(y)))
    np.testing.assert_allclose(
        scores(y, np.full(y.shape, one.least), np.ones(y.shape), one), normal, atol=1e-3
    )


def test_logs_are_drawn_with_t_of_the_given_deviation():
    paths = LEVEL.draw(0, 100, 1)
    errors = (paths.z - paths.x).ravel()
    assert kstest(errors / SCALE, t(NU).cdf).pvalue > 0.01
    np.testing.assert_array_equal(LEVEL.draw(7, 8, 1).z, paths.z[7:8])
    # The path is that of normal readings.
    np.testing.assert_array_equal(NORMAL.draw(0, 100, 1).x, paths.x)
    both = TURNED.draw(0, 3, 1).z
    plain = replace(TURNED, student={}).draw(0, 3, 1).z
    assert (both[..., 0] == plain[..., 0]).all()
    assert (both[..., 1] != plain[..., 1]).all()


def moments(m, P, readings):
    """The mean and variance of a normal state after readings (value, scale, degrees), each replaced
    by its own two moments, and the log likelihood, by sums over 20,001 points."""
    total = 0.0
    for z, scale, degrees in readings:
        x = m + np.sqrt(P) * np.linspace(-12, 12, 20_001)
        of_reading = t.pdf((z - x) / scale, degrees) / scale
        p = norm.pdf(x, m, np.sqrt(P)) * of_reading
        total += np.log(p.sum() * (x[1] - x[0]))
        p /= p.sum()
        m = p @ x
        P = p @ (x - m) ** 2
    return m, P, total


@pytest.mark.parametrize("tracker", [ekf(), ukf(), Filter(iterations=2)])
@pytest.mark.parametrize("z", [[0.4, -0.2], [6.0, 0.5], [-2.5, 40.0]])
def test_a_filter_has_the_exact_moments_after_each_reading(tracker, z):
    """Two readings of one epoch count one after the other; an epoch without readings is between."""
    model = replace(
        LEVEL,
        readings={"z": "x", "y": "x"},
        deviation={"z": 1.0, "y": 0.5},
        student={"z": NU, "y": 3.0},
        count=3,
    )
    log = np.array([[z, [np.nan, np.nan], [np.nan, 0.3]]])
    tracks = tracker.track(model, log)
    second = 0.5 * np.sqrt(1 / 3)
    m, P, total = moments(0.0, 9.25, [(z[0], SCALE, NU), (z[1], second, 3.0)])
    assert tracks.mean[0, 0, 0] == pytest.approx(m, abs=1e-4)
    assert tracks.covariance[0, 0, 0, 0] == pytest.approx(P, rel=2e-4)
    m, P, further = moments(m, P + 0.5, [(0.3, second, 3.0)])
    assert tracks.mean[0, 2, 0] == pytest.approx(m, abs=1e-4)
    assert tracks.covariance[0, 2, 0, 0] == pytest.approx(P, rel=2e-4)
    assert tracks.log_likelihood[0] == pytest.approx(total + further, abs=1e-3)


def own_densities(z):
    """The filter and the smoother of the local level on 1,201 points, by convolution."""
    x = np.linspace(-24, 24, 1201)
    step = np.exp(-0.5 * (np.arange(-120, 121) * (x[1] - x[0]) / 0.5) ** 2)
    p = np.exp(-0.5 * (x / 3) ** 2)
    filtered = []
    for one in z:
        p = np.convolve(p / p.sum(), step, "same") * t.pdf((one - x) / SCALE, NU)
        filtered.append(p / p.sum())
    after = np.ones(len(x))
    smoothed = []
    for one, p in zip(z[::-1], filtered[::-1], strict=True):
        both = p * after
        smoothed.append(both / both.sum())
        after = np.convolve(after * t.pdf((one - x) / SCALE, NU), step, "same")
        after /= after.max()

    def described(densities):
        means = np.array([p @ x for p in densities])
        return means, np.array([p @ x**2 for p in densities]) - means**2

    return described(filtered), described(smoothed[::-1])


@pytest.mark.slow
def test_trackers_have_nearly_the_moments_of_the_exact_density():
    """Those of a grid are exact; a filter takes what is predicted as normal, a path its mode."""
    z = LEVEL.draw(0, 4, 1).z
    own = [own_densities(one[:, 0]) for one in z]
    filtered, smoothed = (np.array([one[i] for one in own]).swapaxes(0, 1) for i in (0, 1))

    def errors(tracker, exact, model=LEVEL):
        tracks = tracker.track(model, z)
        off = (tracks.mean[..., 0] - exact[0]) / np.sqrt(exact[1])
        return np.sqrt(np.mean(off**2)), tracks.covariance[..., 0, 0] / exact[1]

    for tracker, exact, most, wide in (
        (Grid(200), filtered, 1e-3, 2e-3),
        (Grid(200, smooths=True), smoothed, 1e-3, 2e-3),
        (Bootstrap(3000), filtered, 0.05, 0.05),
        (ekf(), filtered, 0.1, 0.05),
        (Smoother(), smoothed, 0.15, 0.05),
        (LevenbergMarquardtSmoother(), smoothed, 0.15, 0.12),
        (AutoTracker(), smoothed, 0.15, 0.12),
    ):
        off, ratio = errors(tracker, exact)
        assert off < most, tracker
        assert np.median(ratio) == pytest.approx(1.0, abs=wide), tracker
    # The same readings as if they were normal.
    assert errors(ekf(), filtered, NORMAL)[0] > 0.15
    assert errors(Smoother(), smoothed, NORMAL)[0] > 0.15


def test_a_smoother_is_the_textbook_s_behind_the_filter():
    """m + G (m' - m), P + G (P' - P-) G' with G = P / P- (Rauch, Tung and Striebel)."""
    z = LEVEL.draw(0, 4, 2).z
    z[0, 3] = np.nan
    before = ekf().track(LEVEL, z)
    after = Smoother().track(LEVEL, z)
    m = before.mean[:, -1, 0]
    P = before.covariance[:, -1, 0, 0]
    for k in range(LEVEL.epochs - 2, -1, -1):
        own = before.covariance[:, k, 0, 0]
        G = own / (own + 0.25)
        m = before.mean[:, k, 0] + G * (m - before.mean[:, k, 0])
        P = own + G**2 * (P - own - 0.25)
        np.testing.assert_allclose(after.mean[:, k, 0], m, atol=1e-10)
        np.testing.assert_allclose(after.covariance[:, k, 0, 0], P, rtol=1e-9)


@pytest.mark.parametrize("trial", range(3))
def test_a_path_is_the_mode_of_the_joint_density(trial):
    z = LEVEL.draw(0, 3, 5).z[trial, :, 0]

    def cost(x):
        steps = np.diff(x) / 0.5
        return (x[0] / 3) ** 2 + steps @ steps - 2 * t.logpdf((z - x[1:]) / SCALE, NU).sum()

    def slope(x):
        steps = 2 * np.diff(x) / 0.25
        r = z - x[1:]
        g = np.append(2 * x[0] / 9, -2 * (NU + 1) * r / (NU * SCALE**2 + r**2))
        g[1:] += steps
        g[:-1] -= steps
        return g

    known = np.zeros(len(z) + 1)
    for _ in range(3):
        known = minimize(cost, known, jac=slope, options={"gtol": 1e-11}).x
    tracker = LevenbergMarquardtSmoother(tolerance=1e-10, iterations=500)
    tracks = tracker.track(LEVEL, z[None, :, None])
    np.testing.assert_allclose(tracks.mean[0, :, 0], known[1:], atol=1e-8)
    np.testing.assert_allclose(tracks.start.mean[0, 0], known[0], atol=1e-8)
    bare = IteratedSmoother(iterations=200).track(LEVEL, z[None, :, None])
    np.testing.assert_allclose(bare.mean[0, :, 0], known[1:], atol=1e-8)


def test_claims_hold_on_average():
    paths = LEVEL.draw(0, 300, 1)
    tracks = ekf().track(LEVEL, paths.z)
    assert kstest(tracks.innovations.ravel(), "norm").pvalue > 0.01
    for tracker, most in ((ekf(), 1.1), (Smoother(), 1.1), (AutoTracker(), 1.15)):
        tracks = tracker.track(LEVEL, paths.z)
        e = (tracks.mean - paths.x)[..., 0]
        assert 0.9 < np.mean(e**2 / tracks.covariance[..., 0, 0]) < most
        if tracks.cost is not None:
            assert np.mean(tracks.cost) == pytest.approx(LEVEL.epochs, rel=0.1)
    # Beside them those that take the readings for normal are farther away.
    plain = Smoother().track(NORMAL, paths.z).mean - paths.x
    aware = Smoother().track(LEVEL, paths.z).mean - paths.x
    assert np.mean(aware**2) < 0.92 * np.mean(plain**2)


@pytest.mark.parametrize("tracker", [Filter(), Filter(Unscented(), 2), Smoother()])
def test_functions_that_are_called_epoch_by_epoch_have_the_same_tracks(tracker):
    z = TURNED.draw(0, 3, 1).z.copy()
    z[0, 5, 1] += 3
    z[1, 4] = np.nan
    one = tracker.track(TURNED, z)
    other = tracker.track(TURNED.by_epoch(), z)
    for part in ("mean", "covariance", "nis", "log_likelihood", "weights"):
        np.testing.assert_allclose(getattr(one, part), getattr(other, part), rtol=1e-7, atol=1e-10)
    np.testing.assert_array_equal(one.mean[1:2], tracker.track(TURNED, z[1:2]).mean)
    assert one.weights[0, 5, 1] < 0.1
    np.testing.assert_allclose(one.weights[0, :, 0], 1.0)


def test_a_trial_that_breaks_down_fits_no_better_than_one_of_normal_readings():
    """The logarithm has no value at the prior's mean of -0.1."""
    for model in (LEVEL, NORMAL):
        lost = replace(model, readings={"z": "log(x)"}, start={"x": -0.1}, count=3)
        assert np.isnan(ekf().track(lost, np.zeros((1, 3, 1))).nis).all()


def test_a_bound_counts_readings_by_their_information():
    """That of t by quadrature of its squared score: it is 1.43 times that of a normal reading."""
    information = quad(
        lambda y: ((NU + 1) * y / (NU - 2 + y**2)) ** 2 * t.pdf(y, NU, scale=SCALE), -np.inf, np.inf
    )[0]
    paths = LEVEL.draw(0, 2, 1)
    same = replace(NORMAL, deviation={"z": information**-0.5})
    known = bound_at_truth(same, paths)
    np.testing.assert_allclose(bound_at_truth(LEVEL, paths), known, rtol=1e-6)
    assert information == pytest.approx(10 / 7, rel=1e-6)


def test_what_does_not_know_t_takes_readings_for_normal():
    z = LEVEL.draw(0, 2, 1).z
    known = PathIPE().track(NORMAL, z).mean
    np.testing.assert_array_equal(PathIPE().track(LEVEL, z).mean, known)


def test_a_folded_state_has_its_exact_density():
    square = replace(LEVEL, next={"x": "0.9*x + w"}, readings={"z": "x**2"}, spread={"x": 1.0})
    z = square.draw(0, 3, 1).z
    z[0, 10] += 20
    auto = AutoTracker().track(square, z)
    exact = Grid(400, smooths=True).track(square, z)
    assert (auto.stage == 0).all()
    np.testing.assert_allclose(auto.covariance, exact.covariance, rtol=1e-3)


def test_a_log_says_what_hardly_counts():
    z = LEVEL.draw(0, 1, 1).z[0].copy()
    z[10] += 12
    trackers = {"ekf": ekf(), "ekf_rts": Smoother(), "auto": AutoTracker()}
    answer = ib.estimate(LEVEL, z, trackers)
    for one in answer:
        assert one.weights[10, 0] < 0.05 < np.median(one.weights)
        assert one.notes[0] == "counted by less than a tenth: 1 of 30 readings, at time steps 11"
    table = answer.table()
    assert table["z_weight"].min() < 0.05
    (plain,) = ib.estimate(NORMAL, z, {"ekf": ekf()})
    assert (plain.passes, answer[0].passes) == (False, True)


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["student={z: 2}"], "student.z=2.0: give a number above 2 and up to 30"),
        (["student={y: 4}"], "student.y: "),
        (
            ["student={z: 4}", "gate=0.99"],
            "trackers.ekf: has a gate, which readings of Student's t",
        ),
    ],
)
def test_what_makes_no_sense_is_refused(ipe_bench, tmp_path, words, complaint):
    (tmp_path / "log.csv").write_text("z\n1\n2\n3\n")
    model = "next.x=x+w readings.z=x noise.w=1 deviation.z=1 spread.x=1"
    given = [f"state_model.{word}" for word in [*model.split(), words[0]]]
    rest = ["readings=log.csv", "tracker=[ekf]", *words[1:]]
    told = ipe_bench("estimate", "state_model=formulas", *given, *rest)
    assert told[0] == 2
    assert complaint in told[2]
