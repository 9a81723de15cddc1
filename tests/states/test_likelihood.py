"""Constants of state models by maximum likelihood: a published estimate, dense likelihoods, and
their coverage."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.optimize import brentq, minimize, minimize_scalar, rosen
from scipy.stats import multivariate_normal, norm
from shared.oracles import assert_agrees
from shared.state_models import ConstantVelocity

import ipe_bench as ib
from ipe_bench.basics.options import Finite
from ipe_bench.real import logs as tracks
from ipe_bench.report import progress
from ipe_bench.states import Bootstrap, Filter, Formulas, Grid, Smoother, base, ekf, ukf
from ipe_bench.states.along import functions_of

NILE = """
1120 1160 963 1210 1160 1160 813 1230 1370 1140 995 935 1110 994 1020 960 1180 799 958 1140
1100 1210 1150 1250 1260 1220 1030 1100 774 840 874 694 940 833 701 916 692 1020 1050 969
831 726 456 824 702 1120 1100 832 764 821 768 845 864 862 698 845 744 796 1040 759
781 865 845 944 984 897 822 1010 771 676 649 846 812 742 801 1040 860 874 848 890
744 749 838 1050 918 986 797 923 975 815 1020 906 901 1170 912 746 919 718 714 740
"""
"""Annual flow of the Nile at Aswan, 1871 to 1970, in 1e8 m^3 (Cobb, Biometrika 65, 1978)."""
LEVEL = Formulas(
    next={"level": "level + w"},
    readings={"flow": "level"},
    noise={"w": 100.0},
    deviation={"flow": 100.0},
    spread={"level": 1e5},
)
DAMPED = Formulas(
    next={"x": "a*x + w"},
    readings={"z": "x"},
    constants={"a": 0.8},
    noise={"w": 1.0},
    deviation={"z": 1.0},
    spread={"x": 2.0},
    count=60,
)


BOTH = ["w", "flow"]


@pytest.mark.oracle(
    "published: Durbin and Koopman, Time Series Analysis by State Space Methods (2012), section"
    " 2.10.3",
    "two variances of the Nile's flow",
    5e-4,
)
@pytest.mark.slow
def test_the_variances_of_the_nile_are_those_of_durbin_and_koopman():
    """Time Series Analysis by State Space Methods, 2012, section 2.10.3: 15099 and 1469.1, from a
    diffuse prior."""
    z = np.array(NILE.split(), dtype=float)[:, None]
    assert z.sum() == 91935
    (one,) = ib.estimate(LEVEL, z, {"kf": ekf()}, find=["flow", "w"])
    assert_agrees([c.value**2 for c in one.constants], [15099, 1469.1], rtol=5e-4)
    assert one.passes


def dense_log_likelihood(a, w, s, z):
    """Of readings z (K,) of the damped state, by their covariance."""
    k = np.arange(1, len(z) + 1)
    variance = 4.0 * a ** (2 * k) + w**2 * (1 - a ** (2 * k)) / (1 - a**2)
    C = a ** np.abs(k[:, None] - k) * variance[np.minimum.outer(k, k) - 1] + s**2 * np.eye(len(z))
    return multivariate_normal(np.zeros(len(z)), C).logpdf(z)


@pytest.mark.oracle(
    "library: SciPy's multivariate_normal of all readings at once",
    "log likelihood at its maximum",
    1e-6,
)
@pytest.mark.slow
def test_constants_and_errors_are_those_of_the_dense_likelihood():
    z = DAMPED.draw(0, 1, 4).z[0]
    for one in ib.estimate(DAMPED, z, {"ekf": ekf()}, find=["a", "w", "deviation.z"]):
        (a, w, s), errors = ([getattr(c, key) for c in one.constants] for key in ("value", "error"))

        def cost(u, a=a, w=w, s=s):
            """By the constant and the logarithms of the standard deviations, from where the maximum
            is said to be."""
            return -dense_log_likelihood(a + u[0], w * np.exp(u[1]), s * np.exp(u[2]), z[:, 0])

        assert_agrees(one.log_likelihood, -cost(np.zeros(3)), atol=1e-6)
        scale = np.array([errors[0], errors[1] / w, errors[2] / s])
        E = 0.01 * np.diag(scale)
        slopes = [(cost(e) - cost(-e)) / 0.02 for e in E]
        np.testing.assert_allclose(slopes, 0.0, atol=2e-3)  # by so many standard errors off
        H = [
            [(cost(e + f) - cost(e - f) - cost(f - e) + cost(-e - f)) / 4e-4 for e in E] for f in E
        ]
        np.testing.assert_allclose(np.sqrt(np.diag(np.linalg.inv(H))), 1.0, rtol=2e-3)
        for found, deviation in zip(one.constants[1:], scale[1:], strict=True):
            if deviation < 0.25:
                assert found.low * found.high == pytest.approx(found.value**2, rel=1e-9)
                reach = 2 * norm.ppf(0.975) * deviation
                assert np.log(found.high / found.low) == pytest.approx(reach, rel=1e-9)
        # An uncertain one has the ends of its profile: the least cost by the others is 1.92 more.
        assert scale[1] > 0.25
        for end in (one.constants[1].low, one.constants[1].high):
            logarithm = np.log(end / w)

            def profile(others, logarithm=logarithm, cost=cost):
                return cost(np.array([others[0], logarithm, others[1]]))

            least = minimize(profile, [0.0, 0.0], method="Nelder-Mead").fun
            assert least - cost(np.zeros(3)) == pytest.approx(norm.ppf(0.975) ** 2 / 2, abs=0.01)


@pytest.mark.slow
def test_intervals_hold_the_constants_as_often_as_they_say(monkeypatch):
    monkeypatch.setattr(tracks, "SEARCHES", 1)  # all end at one maximum here
    model = replace(
        DAMPED,
        readings={"z": "x + b"},
        constants={"a": 0.5, "b": 1.0},
        deviation={"z": 0.5},
        count=40,
    )
    z, held = model.draw(0, 100, 1).z, np.zeros((100, 2), dtype=bool)
    for trial in range(100):
        (one,) = ib.estimate(model, z[trial], {"kf": ekf()}, find=["b", "w"])
        held[trial] = [c.low < 1.0 < c.high for c in one.constants]
    assert (np.abs(held.mean(axis=0) - 0.95) < 3 * np.sqrt(0.95 * 0.05 / 100)).all(), held.mean(
        axis=0
    )


@pytest.mark.parametrize(
    "cost",
    [lambda u: np.exp(-u).sum(), lambda u: np.log1p(rosen(4 * u)), lambda u: u[0] ** 2],
    ids=["down", "bent", "flat"],
)
def test_a_search_ends_after_five_hundred_evaluations(cost):
    told = []
    for one in tracks._minima(cost, np.zeros(5, dtype=bool), told.append):
        assert one.evaluations <= 500
    counted = Counter(line.partition(", ")[0] for line in told)
    assert set(told) == {
        f"{name}, evaluation {k + 1} of at most 500"
        for name in counted
        for k in range(counted[name])
    }
    assert list(counted) == [f"search {k} of 4" for k in (1, 2, 3, 4)]
    assert max(counted.values()) <= 500


@pytest.fixture
def log(tmp_path):
    """The words of a command on a log, in which two noises have but one variance."""
    (tmp_path / "log.csv").write_text("z\n1\n-2\n0.5\n3\n")
    words = "readings.z=x next.x=0.5*x+v+w noise.v=1 noise.w=1 deviation.z=1 spread.x=1"
    return [
        *(f"state_model.{word}" for word in words.split()),
        "tracker=[ekf]",
        "readings=log.csv",
        "output=out",
    ]


def test_a_search_tells_how_far_it_is_and_where_it_ended(ipe_bench, log, monkeypatch):
    monkeypatch.setattr(tracks, "SEARCHES", 1)
    monkeypatch.setattr(tracks, "EVALUATIONS", 40)
    monkeypatch.setattr(tracks, "_OF_SIMPLEX", 20)
    monkeypatch.setattr(progress, "_LINE_EVERY_S", 0.0)
    code, out, err = ipe_bench("estimate", "state_model=formulas", *log, "find=[v,w,z]")
    assert code == 1
    lines = err.splitlines()
    assert lines[0] == "estimate: ekf"
    assert re.fullmatch(r"estimate: ekf: search 1 of 1, evaluation \d+ of at most 40", lines[-1])
    last = lines[-1].split()[-5]
    assert f"the search ended after {last} evaluations at v=" in " ".join(out.split())


def test_a_search_that_is_interrupted_is_one_line_and_no_file(
    ipe_bench, log, monkeypatch, tmp_path
):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(tracks, "_descended", interrupted)
    code, _, err = ipe_bench("estimate", "state_model=formulas", *log, "find=[v,w,z]")
    assert (code, err) == (130, "ipe-bench: stopped; the same command begins anew\n")
    assert not (tmp_path / "out").exists()


def level_cost(w, s, z, spread):
    """Minus the log likelihood of a local level, by its textbook recursion."""
    x = 0.0
    P = spread**2
    total = 0.0
    for reading in z:
        P += w**2
        S = P + s**2
        e = reading - x
        total += 0.5 * (np.log(2 * np.pi * S) + e**2 / S)
        x += P / S * e
        P *= 1 - P / S
    return total


def least_level_cost(z, spread, starts):
    """The least of it, inside and on both bounds."""

    def inside(u):
        return level_cost(*np.exp(u), z, spread)

    options = {"method": "bounded", "bounds": (-6, 4), "options": {"xatol": 1e-6}}
    at_bounds = [
        minimize_scalar(lambda v: level_cost(0.0, np.exp(v), z, spread), **options).fun,
        minimize_scalar(lambda v: level_cost(np.exp(v), 1e-9, z, spread), **options).fun,
    ]
    return min(*at_bounds, *(minimize(inside, u, method="Nelder-Mead").fun for u in starts))


@pytest.mark.oracle("closed form: the recursion of a local level", "log likelihood", 1e-3)
@pytest.mark.parametrize(
    "logs",
    [4, pytest.param(30, marks=pytest.mark.slow), pytest.param(400, marks=pytest.mark.campaign)],
)
def test_every_simulated_local_level_has_an_answer_of_largest_likelihood(logs, monkeypatch):
    """Levels that hardly move up to such that readings hardly blur; the largest likelihood is that
    of the own search to 2e-3 (the worst of 400 is 1.1e-3 off), and intervals hold the truth."""
    if logs < 100:
        monkeypatch.setattr(tracks, "SEARCHES", 1)
    model = replace(LEVEL, count=40, spread={"level": 100.0}, noise={"w": 1.0})
    model = replace(model, deviation={"flow": 1.0})
    g = np.random.default_rng(1)
    held = np.zeros((logs, 2), dtype=bool)
    zeros = np.zeros((logs, 2), dtype=bool)
    for i in range(logs):
        w = (0.05, 0.2, 0.6, 3.0)[i % 4]
        z = np.cumsum(w * g.standard_normal(40)) + g.standard_normal(40) + 3 * g.standard_normal()
        (one,) = ib.estimate(model, z[:, None], {"kf": ekf()}, find=BOTH)
        found = one.constants
        assert found, one.message
        values = np.array([each.value for each in found])
        zeros[i] = values == 0
        held[i] = [
            each.low <= true <= each.high for each, true in zip(found, (w, 1.0), strict=True)
        ]
        own = level_cost(*np.maximum(values, [0.0, 1e-9]), z, 100.0)
        assert_agrees(one.log_likelihood, -own, atol=1e-3)
        starts = [(0.0, 0.0), (-3.0, 0.0), (0.0, -2.0)] if logs > 100 else [(np.log(w), 0.0)]
        assert own < least_level_cost(z, 100.0, starts) + 2e-3
    if logs < 10:
        return
    # A level that moves by 0.05 is mostly found not to move at all.
    assert 0.1 < zeros[:, 0].mean() < 0.3
    assert (np.abs(held.mean(axis=0) - 0.95) < 4 * np.sqrt(0.95 * 0.05 / logs)).all()


def test_several_logs_share_the_constants_that_are_likeliest_for_all():
    """Those of the least sum of textbook costs; each log has its own length and track."""
    g = np.random.default_rng(3)
    logs = [np.cumsum(g.standard_normal(K)) + g.standard_normal(K) for K in (40, 25, 12)]
    model = replace(LEVEL, spread={"level": 100.0}, noise={"w": 2.0}, deviation={"flow": 2.0})

    def cost(u):
        return sum(level_cost(*np.exp(u), z, 100.0) for z in logs)

    own = minimize(cost, [0.0, 0.0], method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-9})
    question = tracks.LogQuestion(
        [tracks.Log(replace(model, count=len(z)), z[:, None]) for z in logs], {"kf": ekf()}, BOTH
    )
    each = question.track("kf")
    for one, z in zip(each, logs, strict=True):
        assert_agrees([c.value for c in one.constants], np.exp(own.x), rtol=1e-3)
        values = [c.value for c in one.constants]
        assert one.log_likelihood == pytest.approx(-level_cost(*values, z, 100.0), abs=1e-8)
        assert one.mean.shape == (len(z), 1)
    assert sum(one.log_likelihood for one in each) == pytest.approx(-own.fun, abs=1e-5)


@pytest.mark.slow
def test_a_log_without_noise_has_none():
    x = 0.8 ** np.arange(1, 61)
    (one,) = ib.estimate(DAMPED, x[:, None], {"kf": ekf()}, find="w")
    assert one.passes
    (w,) = one.constants
    assert w.value == 0.0
    assert w.high == pytest.approx(
        brentq(
            lambda u: (
                dense_log_likelihood(0.8, 0.0, 1.0, x)
                - dense_log_likelihood(0.8, u, 1.0, x)
                - norm.ppf(0.975) ** 2 / 2
            ),
            0.01,
            2.0,
        ),
        rel=2e-3,
    )


@pytest.mark.slow
def test_readings_that_all_are_equal_determine_no_noise():
    """The likelihood grows without limit as both noises vanish."""
    (one,) = ib.estimate(replace(LEVEL, count=20), np.full((20, 1), 3.0), {"kf": ekf()}, find=BOTH)
    assert (one.verdict, one.passes, one.constants) == ("no maximum", False, ())
    assert re.match(r"no maximum of the likelihood was found in w, flow: ", one.message)


@pytest.mark.slow
def test_a_variance_whose_likelihood_is_largest_at_zero_is_zero():
    """Of a level that begins at 0, readings of alternating signs make each step of the level less
    likely; held at 0, they are white noise of mean square 1, with the error 1 / sqrt(2 K)."""
    known = replace(LEVEL, count=12, spread={"level": 0.0}, noise={"w": 1.0})
    z = np.array([1.0, -1.0] * 6)[:, None]
    (one,) = ib.estimate(replace(known, deviation={"flow": 2.0}), z, {"kf": ekf()}, find=BOTH)
    w, flow = one.constants
    assert (w.value, one.found) == (0.0, "")
    assert flow.value == pytest.approx(1.0, abs=1e-4)
    assert flow.error == pytest.approx(1 / np.sqrt(24), rel=1e-3)
    k = np.arange(1, 13)

    def profile(level):
        def cost(noise):
            C = level**2 * np.minimum.outer(k, k) + noise**2 * np.eye(12)
            return -multivariate_normal(np.zeros(12), C).logpdf(z[:, 0])

        return minimize_scalar(cost, bounds=(0.1, 5.0), method="bounded").fun

    limit = brentq(lambda level: profile(level) - profile(0.0) - 3.8414588207 / 2, 0.001, 5.0)
    assert (w.low, w.high) == (0.0, pytest.approx(limit, rel=2e-3))
    (note,) = one.notes
    assert f"w=0, where it is held; its 95 % interval is 0 to {limit:.3g} (" in note


@pytest.mark.slow
def test_an_uncertain_deviation_has_the_interval_of_its_profile():
    """Its ends cost 1.92 of the dense log likelihood, or it begins at 0."""
    z = DAMPED.draw(0, 1, 2).z[0, :12]
    (one,) = ib.estimate(replace(DAMPED, count=12), z, {"kf": ekf()}, find=["w"])
    (w,) = one.constants

    def lost(value):
        return one.log_likelihood - dense_log_likelihood(0.8, value, 1.0, z[:, 0])

    assert w.error / w.value > 0.25
    for end in (w.low, w.high):
        assert end == 0 or lost(end) == pytest.approx(norm.ppf(0.975) ** 2 / 2, abs=5e-3)


@pytest.mark.slow
def test_readings_without_noise_have_none_though_no_filter_takes_a_zero():
    """Steps that resemble each other leave nothing to the readings. The only noise is then the
    root mean square of the steps, but for the prior."""
    e = np.random.default_rng(4).standard_normal(42)
    z = np.cumsum(e[1:] + 0.3 * e[:-1])
    level = replace(LEVEL, count=41, noise={"w": 1.0}, deviation={"flow": 1.0})
    (one,) = ib.estimate(level, z[:, None], {"kf": ekf()}, find=BOTH)
    w, flow = one.constants
    assert flow.value == 0.0
    assert w.value == pytest.approx(np.sqrt(np.mean(np.diff(z) ** 2)), rel=1e-4)


def test_a_maximum_whose_innovations_do_not_fit_is_no_answer():
    """White states for a log that is a sine: noise of its size is most likely, and successive
    innovations are alike."""
    white = replace(DAMPED, next={"x": "w"}, constants={})
    (one,) = ib.estimate(white, 3 * np.sin(np.arange(60.0) / 5)[:, None], {"kf": ekf()}, find="w")
    assert one.constants[0].value == pytest.approx(np.sqrt(9 / 2 - 1), rel=0.05)
    assert (one.verdict, one.passes) == ("wrong", False)
    assert one.fit_p > 0.1
    assert "find= ended at a maximum whose innovations do not fit" in one.message


@dataclass(frozen=True)
class Gained(ConstantVelocity):
    """A model in Python whose transition has an option among its numbers."""

    drag: Finite = 0.1

    def transition(self, x, k):
        return super().transition(x, k) - self.drag * np.abs(x) * x


GAINED = Formulas(
    next={"x": "a*abs(x) + u*dt + b*w"},
    readings={"z": "b*x", "angle": "x + a"},
    constants={"a": 0.8, "b": 2.0},
    noise={"w": 1.0},
    deviation={"z": "1 + b**2", "angle": 0.3},
    inputs={"u": 0.7},
    period={"angle": 6.283185307},
    spread={"x": 2.0},
    count=7,
)


@pytest.mark.parametrize("filter", [ekf(), ukf(), Filter(iterations=3)], ids=["ekf", "ukf", "iekf"])
@pytest.mark.parametrize(
    ("model", "numbers"),
    [
        (DAMPED, {"constants": {"a": 1.1}, "deviation": {"z": 0.2}}),
        (DAMPED, {"noise": {"w": 0.0}}),
        (GAINED, {"constants": {"a": -0.3, "b": 0.5}, "noise": {"w": 3.0}}),
        (replace(GAINED, next={"x": "a*x + b*x*w"}), {"constants": {"a": 0.5, "b": 0.5}}),
        (ConstantVelocity(count=9), {"deviation": 0.7}),
        (Gained(count=9), {"drag": 0.01, "deviation": 0.7}),
        (Gained(count=9), {"drag": 0.0}),
    ],
)
def test_a_model_with_other_numbers_is_the_model_that_has_them(model, numbers, filter):
    """Bit for bit: likelihood, means and covariances; and the model that it came from stays."""
    z = model.draw(0, 3, 2).z
    before = filter.track(model, z)
    changed = {}
    for name, value in numbers.items():
        known = getattr(model, name)
        changed[name] = {**known, **value} if isinstance(value, dict) else value
    fast = filter.track(model.with_numbers(changed), z)
    sure = filter.track(replace(model, **changed), z)
    again = filter.track(model, z)
    for part in ("log_likelihood", "mean", "covariance", "nis"):
        np.testing.assert_array_equal(getattr(fast, part), getattr(sure, part))
        np.testing.assert_array_equal(getattr(again, part), getattr(before, part))
    assert not np.array_equal(fast.log_likelihood, before.log_likelihood)


@pytest.mark.parametrize(
    ("model", "find"), [(DAMPED, ["a", "w"]), (Gained(count=9), ["drag", "deviation"])]
)
def test_a_search_tries_the_functions_of_a_model_at_its_ends_alone(monkeypatch, model, find):
    monkeypatch.setattr(tracks, "SEARCHES", 1)
    tried = []
    monkeypatch.setattr(base, "functions_of", lambda one: tried.append(one) or functions_of(one))
    told = []
    question = tracks.LogQuestion.of(model, model.draw(0, 1, 4).z[0], {"kf": ekf()}, find=find)
    tried.clear()
    question.track("kf", told.append)
    assert len(told) > 20
    # At the end, and where one number more is 0.
    assert len(tried) <= 2


@pytest.mark.parametrize(
    ("deviation", "verdict"),
    [(30.0, "several maxima"), pytest.param(3.0, "consistent", marks=pytest.mark.slow)],
)
def test_maxima_that_differ_are_named(deviation, verdict):
    """(b - .2)^2 = 1 at b = 1.2 and -.8, between which one coarse reading has to tell; no state is
    unknown, and the difference of the log likelihoods is that of sums of squares."""
    model = Formulas(
        next={"x": "x"},
        readings={"square": "x + (b - 0.2)**2", "coarse": "x + b"},
        constants={"b": 0.0},
        deviation={"square": 0.1, "coarse": deviation},
        spread={"x": 0.0},
        count=20,
    )
    z = replace(model, constants={"b": 1.2}).draw(0, 1, 2).z[0]
    (one,) = ib.estimate(model, z, {"kf": ekf()}, find="b")
    near, far = (one.constants[0].value, float(one.notes[0].partition("b=")[2]))
    assert sorted((near, far)) == pytest.approx([-0.8, 1.2], abs=0.05)

    def cost(b):
        return 0.5 * np.sum((z - [(b - 0.2) ** 2, b]) ** 2 / np.square([0.1, deviation]))

    ends = [minimize_scalar(cost, (at - 0.01, at + 0.01)).fun for at in (near, far)]
    assert f"of a log likelihood {ends[1] - ends[0]:.3g} lower" in one.notes[0]
    assert (one.verdict, one.passes) == (verdict, verdict == "consistent")


@pytest.mark.slow
def test_an_option_of_a_model_in_python_is_found_as_that_of_its_formulas():
    written = ConstantVelocity(count=30, deviation=2.0)
    formulas = Formulas(
        next={"p": "p + v + sqrt(1/3)*a", "v": "v + sqrt(3)/2*a + b/2"},
        readings={"z": "p"},
        noise={"a": 1.0, "b": 1.0},
        deviation={"z": 2.0},
        spread={"p": 10.0, "v": 10.0},
        count=30,
    )
    z = replace(written, deviation=0.7).draw(0, 1).z[0]
    (one,), (other,) = (
        ib.estimate(model, z, {"kf": ekf()}, find=name).tracks[0].constants
        for model, name in ((written, "deviation"), (formulas, "z"))
    )
    assert (one.value, one.error) == pytest.approx((other.value, other.error), rel=1e-6)


@pytest.mark.parametrize(
    ("trackers", "find", "complaint"),
    [
        ({"kf": ekf()}, "b", "find=b: there is no such constant"),
        ({"kf": ekf()}, ["w", "noise.w"], "find=w: is named twice"),
        ({"kf": ekf()}, "noise.z", r"find=noise\.z: there is no such constant"),
        (
            {"rts": Smoother(ekf())},
            "a",
            "find: trackers.rts has no likelihood that can be maximised",
        ),
        (
            {"particles": Bootstrap(20)},
            "a",
            "find: trackers.particles has no likelihood that can be maximised",
        ),
    ],
)
def test_what_cannot_be_found_is_refused(trackers, find, complaint):
    with pytest.raises(ib.UserError, match=complaint):
        ib.estimate(DAMPED, np.zeros((60, 1)), trackers, find=find)


def test_a_tracker_without_a_likelihood_is_refused_before_another_is_searched(monkeypatch):
    monkeypatch.delattr(tracks, "_minima")
    trackers = {"kf": ekf(), "rts": Smoother(ekf())}
    with pytest.raises(ib.UserError, match=r"trackers\.rts has no likelihood"):
        ib.estimate(DAMPED, np.zeros((60, 1)), trackers, find="a")


def test_parameters_of_a_measurement_are_not_named():
    with pytest.raises(ib.UserError, match="find=: is for models of states that move"):
        ib.estimate(ib.measurements.Polynomial(), np.zeros(8), find="c0")  # pyright: ignore


@pytest.mark.slow
def test_the_exact_likelihood_of_a_grid_has_the_same_maximum():
    model = replace(DAMPED, count=15)
    z = model.draw(0, 1, 6).z[0]
    exact, filtered = ib.estimate(model, z, {"grid": Grid(300), "kf": ekf()}, find="deviation.z")
    for one, other in zip(exact.constants, filtered.constants, strict=True):
        assert one.value == pytest.approx(other.value, rel=1e-4)
        assert one.error == pytest.approx(other.error, rel=1e-3)
