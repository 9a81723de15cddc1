"""Slopes by differences and what they say of others, beside closed forms; and filters of users'
functions beside plain ones whose slopes stand in closed form."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ipe_bench.functions.differences import RIGHT, WRONG, by_differences, judge, measured
from ipe_bench.functions.judged import Judged, judged
from ipe_bench.functions.recording import NotRecorded, compiled_rows, written
from ipe_bench.measurements import Parameter
from ipe_bench.states import (
    Grid,
    Normal,
    PathIPE,
    StateModel,
    ekf,
    ukf,
)

SMOOTH = {
    "sin": (np.sin, np.cos),
    "x|x|": (lambda x: x * np.abs(x), lambda x: 2 * np.abs(x)),
    "a kink": (lambda x: np.maximum(x, 0), lambda x: (x > 0) * 1.0),
    "tanh 20x": (lambda x: np.tanh(20 * x), lambda x: 20 / np.cosh(20 * x) ** 2),
    "a dip": (
        lambda x: 1 - 0.01 * np.exp(-0.5 * ((x - 0.4) / 0.03) ** 2),
        lambda x: 0.01 * (x - 0.4) / 0.03**2 * np.exp(-0.5 * ((x - 0.4) / 0.03) ** 2),
    ),
    "a curvature that jumps": (
        lambda x: x * np.exp(-np.abs(x)),
        lambda x: (1 - np.abs(x)) * np.exp(-np.abs(x)),
    ),
    "jumps": (lambda x: np.floor(5 * x) + x, lambda x: 1 + 0 * x),
    "a large constant": (lambda x: 1e6 + np.sin(x), np.cos),
}


def points() -> Any:
    return np.random.default_rng(3).uniform(-2, 2, (60, 1))


@pytest.mark.parametrize("name", SMOOTH)
def test_a_right_slope_is_never_called_wrong_and_one_percent_off_never_right(name):
    function, slope = SMOOTH[name]
    x = points()
    found = measured(function, x, np.ones((60, 1, 1)))
    J = slope(x)[:, None]
    beyond = np.abs(found.central.slope - J) > 3 * found.central.error + 1e-13 * np.abs(J)
    assert beyond.sum() <= 1
    assert not (judge(J, found) == WRONG).any()
    telling = np.abs(J) > 1e-8
    assert not (judge(1.01 * J, found) == RIGHT)[telling].any()
    assert (judge(1.01 * J, found) == WRONG)[telling].mean() > 0.9


@pytest.mark.parametrize("name", SMOOTH)
def test_differences_find_the_slope_to_a_millionth(name):
    function, slope = SMOOTH[name]
    x = points()
    x = x[np.abs(x[:, 0] * 5 - np.round(x[:, 0] * 5)) > 0.01]  # off the jumps and kinks
    found = by_differences(function, x, np.ones(1))[:, 0]
    np.testing.assert_allclose(found, slope(x), rtol=1e-6, atol=1e-7)


def test_any_slope_between_those_of_the_sides_of_a_kink_is_right():
    found = measured(np.abs, np.zeros((3, 1)), np.ones((3, 1, 1)))
    verdicts = judge(np.array([-1.0, 0.3, 1.5])[:, None, None], found)
    assert verdicts.ravel().tolist() == [RIGHT, RIGHT, WRONG]


def test_verdicts_are_the_same_alone_and_in_any_batch():
    def friction(x):
        return np.stack([x[:, 0] * np.abs(x[:, 0]), x[:, 0] - np.sin(x[:, 1])], axis=-1)

    x = np.random.default_rng(0).normal(size=(300, 2)) * [1.0, 1e3]
    own = Judged(friction, np.array([0.5, 100.0]))
    value = friction(x)
    J = own.differences(x)
    J[::3, 0, 0] /= 2
    verdicts = own.wrong(x, value, J)
    assert verdicts[::3].all()
    assert not verdicts[1::3].any()
    for rows in (slice(0, 1), slice(7, 8), slice(5, 40)):
        assert (own.wrong(x[rows], value[rows], J[rows]) == verdicts[rows]).all()
        np.testing.assert_array_equal(own.differences(x[rows]), own.differences(x)[rows])


def _rough(x):
    """Is rough by 1e-6 of itself, and above 101 rises twice as steeply, by a branch that complex
    steps do not see."""
    digits = np.modf(np.abs(np.sin(12989.8 * x.real)) * 4.37585453e7)[0]
    return x + 1e-4 * (2 * digits - 1) + np.where(x.real > 101, np.abs(x) - 101, 0)


def test_roughness_does_not_hide_slopes_off_by_a_factor_of_numbers_that_vary_little():
    near_100 = 100 + np.linspace(-0.1, 0.1, 9)[:, None]
    own = judged(_rough, near_100, np.array([0.1]))
    assert own.noise > 1e-7
    x = np.linspace(101.15, 101.3, 15)[:, None]
    slope = own.slopes(x)[1].ravel()
    assert np.median(slope) == pytest.approx(2.0, rel=0.01)
    assert (np.abs(slope - 2) < 0.02).mean() > 0.8


def _root(x):
    """Takes no complex numbers above 1."""
    if np.iscomplexobj(x) and (x.real > 1).any():
        raise TypeError("complex")
    return np.sin(x)


def test_a_row_that_takes_no_complex_numbers_leaves_the_slopes_of_others_as_they_are():
    own = judged(_root, np.linspace(-0.5, 0.5, 5)[:, None], np.array([0.1]))
    x = np.array([0.3, 0.7, 2.0, -0.4, 0.9])[:, None]
    slope = own.slopes(x)[1].ravel()
    alone = [own.slopes(row[None])[1].item() for row in x]
    assert slope.tolist() == alone
    np.testing.assert_allclose(slope, np.cos(x[:, 0]), rtol=1e-7)


def _swallowed(x):
    try:
        if x[0, 0] > 0:
            return x
    except:  # noqa: E722
        pass
    return -x


@pytest.mark.parametrize(
    ("function", "why"),
    [
        (_swallowed, "branches"),
        (lambda x: np.stack([np.asarray(x)[:, 0] == 0], axis=-1), "branches"),
        (lambda x: np.sort(x, axis=-1), "np.sort is not recorded"),
        (lambda x: x[x > 0], "selects"),
        (lambda x: -(x > 0), "truth values"),
        (lambda x: x * 1j, "complex"),
        (lambda x: {}.get(x[0, 0], x), "key"),
        (lambda x: (x > 0) & x, "of numbers"),
        (lambda x: np.logical_xor(x, 1.0) * x, "of numbers"),
        (lambda x: np.sqrt(x > 0) * x, "of truth values"),
        (lambda x: np.linalg.norm(x, 1, axis=-1, keepdims=True), "order 1"),
        (lambda x: x.astype(int), "astype"),
        (lambda x: np.nextafter(x, 0.0), "np.nextafter is not recorded"),
    ],
)
def test_what_would_be_recorded_as_another_function_is_refused(function, why):
    with pytest.raises(NotRecorded, match=why):
        written(function, 2)


TRUTHS = {
    "a choice of truths": lambda a, b: np.where(a > 0, b > 0, a > 1) + (b > 1),
    "a choice of a truth and a number": lambda a, b: np.where(a > 0, b > 0, b) + (b > 1),
    "or": lambda a, b: 1 - ((a > 0) | (b > 0)) * 1.0,
    "exclusive or": lambda a, b: ((a > 0) ^ (b > 0)) * a,
    "a number for a truth": lambda a, b: np.logical_and(a, b > 0) + np.logical_or(a, b) * 2.0,
    "fmin": lambda a, b: np.fmin(a, b) + np.fmax(a, np.log(b)),
    "a limit": lambda a, b: np.clip(a, b, 1.0) + np.isinf(1 / a) * 3.0,
    "a mean": lambda a, b: np.mean([a, b, a * b], axis=0),
    "how many": lambda a, b: np.sum(np.stack([a > 0, b > 0, a > b]), axis=0) * b,
    "a truth as a number": lambda a, b: (a > 0).astype(float) + (b > 0).astype(float),
    "a length": lambda a, b: np.linalg.norm(np.stack([a, b], axis=-1), axis=-1),
    "between places": lambda a, b: np.interp(a, [-1.5, 0.0, 2.0], [3.0, 1.0, 5.0]) * b,
    "without NaN": lambda a, b: np.nan_to_num(a) + b,
    "a product of truths": lambda a, b: (a > 0) * (b > 0) + np.minimum(a > 1, b > 1),
    "whole numbers and truths": lambda a, b: (a + np.int64(2)) * np.True_ - b * True,
    "the larger of truths": lambda a, b: np.maximum(a > 0, b > 0) + (a > b),
}


@pytest.mark.parametrize("name", TRUTHS)
def test_a_recording_has_the_values_of_numpy(name):
    numbers = [-2.0, -1.0, -0.0, 0.0, 0.5, 1.0, 3.0, np.nan]
    x = np.array([[a, b] for a in numbers for b in numbers])
    one = written(lambda x: np.stack([TRUTHS[name](x[..., 0], x[..., 1])], axis=-1), 2)
    with np.errstate(all="ignore"):
        found = compiled_rows(one)[0](x, np.array([one.numbers]))[:, 0]
        wanted = TRUTHS[name](x[:, 0], x[:, 1])
    np.testing.assert_allclose(found, wanted, rtol=1e-15)


def test_a_remainder_is_numpys_to_the_sign_of_its_zero():
    numbers = [-4.0, -2.5, -0.0, 0.0, 0.3, 2.0, 5.0, np.inf, np.nan]
    x = np.array([[a, b] for a in numbers for b in numbers])
    one = written(lambda x: np.remainder(x[..., :1], x[..., 1:]), 2)
    with np.errstate(all="ignore"):
        found = compiled_rows(one)[0](x, np.array([one.numbers]))[:, 0]
        wanted = np.remainder(x[:, 0], x[:, 1])
    np.testing.assert_array_equal(found, wanted)
    known = np.isfinite(wanted)
    np.testing.assert_array_equal(np.signbit(found[known]), np.signbit(wanted[known]))


K = 60


class Ship(StateModel):
    """A ship at rest, with a drag by the square of its speed."""

    name = "ship"
    states: Any = (Parameter("p"), Parameter("v"))
    times: Any = np.arange(1.0, K + 1)
    prior: Any = Normal(np.zeros(2), np.diag([1, 0.005**2]))

    def transition(self, x, k):
        p, v = x[..., 0], x[..., 1]
        return np.stack([p + v, v - 0.3 * v * np.abs(v)], axis=-1)

    def observe(self, x, k):
        return x[..., :1]

    def gain(self, k):
        return np.array([[0.25], [0.5]])

    def R(self, k):
        return np.array([[0.04]])

    def F(self, x, k):
        return np.array([[1, 1], [0, 1 - 0.6 * abs(x[1])]])

    def H(self, x):
        return np.array([[1.0, 0]])


class Trolley(Ship):
    """A trolley that reverses, by a branch of Python that its start does not show."""

    name = "trolley"
    prior = Normal(np.array([0.0, 2]), np.diag([1, 0.3**2]))
    times = 0.5 * np.arange(1.0, K + 1)

    def transition(self, x, k):
        u = 0.5 if k < 20 else -0.5
        out = np.empty_like(x)
        for i in np.ndindex(x.shape[:-1]):
            p, v = x[i]
            if v >= 0:
                a = u - 0.1 * v
            else:
                a = u - 0.3 * v * abs(v)
            out[i] = [p + 0.5 * v, v + 0.5 * a]
        return out

    def gain(self, k):
        return np.array([[0.0], [0.05]])

    def R(self, k):
        return np.array([[0.25]])

    def F(self, x, k):
        return np.array([[1, 0.5], [0, 0.95 if x[1] >= 0 else 1 - 0.3 * abs(x[1])]])


class Turn(StateModel):
    """A coordinated turn that begins straight on, where its formula is 0 / 0."""

    name = "turn"
    states: Any = tuple(map(Parameter, ("px", "py", "vx", "vy", "w")))
    times: Any = np.arange(1.0, K + 1)
    prior: Any = Normal(np.array([100.0, 50, 10, 0, 0]), np.diag([25, 25, 1, 1, 0.01]))
    periods: Any = (0.0, 2 * np.pi)
    plain = False

    def transition(self, x, k):
        x = np.asarray(x) if self.plain else x
        px, py, vx, vy, w = (x[..., i] for i in range(5))
        d = np.where(w == 0, 1, w)
        s = np.where(w == 0, 1.0, np.sin(w) / d)
        c = np.where(w == 0, 0.0, (1 - np.cos(w)) / d)
        ahead = np.cos(w) * vx - np.sin(w) * vy
        aside = np.sin(w) * vx + np.cos(w) * vy
        return np.stack([px + s * vx - c * vy, py + c * vx + s * vy, ahead, aside, w], axis=-1)

    def observe(self, x, k):
        px, py = x[..., 0], x[..., 1]
        return np.stack([np.sqrt(px**2 + py**2), np.arctan2(py, px)], axis=-1)

    def gain(self, k):
        return np.diag([0.1, 0.1, 0.3, 0.3, 0.01])

    def R(self, k):
        return np.diag([1.0, 1e-4])

    def F(self, x, k):
        _, _, vx, vy, w = x
        C, N = np.cos(w), np.sin(w)
        if abs(w) > 1e-3:
            s, c = N / w, (1 - C) / w
            ds, dc = (w * C - N) / w**2, (w * N - 1 + C) / w**2
        else:
            s, c = 1 - w * w / 6, w / 2 - w**3 / 24
            ds, dc = -w / 3 + w**3 / 30, 0.5 - w * w / 8
        return np.array(
            [
                [1, 0, s, -c, ds * vx - dc * vy],
                [0, 1, c, s, dc * vx + ds * vy],
                [0, 0, C, -N, -N * vx - C * vy],
                [0, 0, N, C, C * vx - N * vy],
                [0, 0, 0, 0, 1],
            ]
        )

    def H(self, x):
        r = np.hypot(*x[:2])
        return np.array([[x[0] / r, x[1] / r, 0, 0, 0], [-x[1] / r**2, x[0] / r**2, 0, 0, 0]])


class PlainTurn(Turn):
    """The same in other words."""

    plain = True


def plain_ekf(model, z):
    """An extended Kalman filter in NumPy, trial by trial."""
    means = np.empty((*z.shape[:2], model.n))
    covariances = np.empty((*means.shape, model.n))
    for i, one in enumerate(z):
        x, P = model.prior
        for k in range(K):
            F = model.F(x, k)
            x = model.transition(x[None].copy(), k)[0]
            P = F @ P @ F.T + model.Q(k)
            H = model.H(x)
            W = H @ P @ H.T + model.R(k)
            G = P @ H.T @ np.linalg.inv(W)
            h = model.observe(x[None], k)[0]
            x = x + G @ (model.nearest(one[k], h) - h)
            P = (np.eye(model.n) - G @ H) @ P
            P = (P + P.T) / 2
            means[i, k], covariances[i, k] = x, P
    return means, covariances


@pytest.mark.parametrize(
    ("kind", "way", "within"),
    [
        (Ship, "", 1e-10),
        (Trolley, "branches on its argument", 1e-9),
        (Turn, "", 1e-6),
        (PlainTurn, "branches on its argument", 1e-6),
    ],
)
def test_filters_of_functions_in_python_are_those_of_slopes_in_closed_form(kind, way, within):
    model = kind()
    assert way in model.epoch_functions[0].why
    assert bool(way) == bool(model.epoch_functions[0].why)
    z = model.draw(0, 12).z
    mean, covariance = plain_ekf(model, z)
    deviation = np.sqrt(np.diagonal(covariance, axis1=2, axis2=3))
    found = ekf().track(model, z)
    assert np.abs((found.mean - mean) / deviation).max() < within
    ratio = np.sqrt(np.diagonal(found.covariance, axis1=2, axis2=3)) / deviation
    np.testing.assert_allclose(ratio, 1.0, rtol=within)
    alone = ekf().track(model, z[3:4])
    np.testing.assert_array_equal(alone.mean[0], found.mean[3])


class Scheduled(Ship):
    """Steps by a table of gains, a dictionary and an attribute."""

    name = "scheduled"

    def __init__(self):
        self.table = np.linspace(0.1, 0.3, K)
        self.options = {"drag": 0.3}
        self.bias = 0.0

    def transition(self, x, k):
        p, v = x[..., 0], x[..., 1]
        push = self.table[k] - self.options["drag"] * v * np.abs(v)
        return np.stack([p + v, v + push], axis=-1)

    def observe(self, x, k):
        return x[..., :1] + self.bias


def _table(model):
    model.table[37] += 1.0


def _dictionary(model):
    model.options["drag"] = 0.1


def _attribute(model):
    model.bias = 2.0


def _method(model):
    Scheduled.observe = lambda self, x, k: x[..., :1] ** 3  # type: ignore[method-assign]


@pytest.mark.parametrize("change", [_table, _dictionary, _attribute, _method])
@pytest.mark.parametrize("tracker", [ekf(), ukf()])
def test_a_model_that_has_changed_is_tracked_as_it_stands(change, tracker, monkeypatch):
    monkeypatch.setattr(Scheduled, "observe", Scheduled.observe)
    model = Scheduled()
    z = model.draw(0, 3).z
    before = tracker.track(model, z)
    change(model)
    fresh = Scheduled()
    change(fresh)
    after = tracker.track(model, z)
    wanted = tracker.track(fresh, z)
    assert not np.array_equal(before.mean, after.mean)
    np.testing.assert_array_equal(after.mean, wanted.mean)
    np.testing.assert_array_equal(after.log_likelihood, wanted.log_likelihood)


class Dictionary(StateModel):
    """Takes its prior, its noise and its periods from a dictionary."""

    name = "dictionary"
    states: Any = (Parameter("p", "m"),)
    times: Any = np.arange(1.0, 5.0)

    def __init__(self):
        self.numbers = {"mean": 0.0, "spread": 1.0, "process": 1.0, "reading": 2.0, "period": 0.0}

    @property
    def prior(self):
        return Normal(np.array([self.numbers["mean"]]), self.numbers["spread"] ** 2 * np.eye(1))

    @property
    def periods(self):
        return (self.numbers["period"],)

    def transition(self, x, k):
        return x + 0.1 * np.sin(x)

    def observe(self, x, k):
        return x + 0.05 * x**2

    def gain(self, k):
        return self.numbers["process"] * np.eye(1)

    def R(self, k):
        return self.numbers["reading"] ** 2 * np.eye(1)


class DictionaryByState(Dictionary):
    """Reads with noise that depends on the states."""

    def R_at(self, x, k):
        return self.numbers["reading"] ** 2 * (1 + 0.1 * x[..., None] ** 2)


CHANGES = {"mean": 3.0, "spread": 4.0, "process": 0.2, "reading": 0.5, "period": 1.5}
CASES = [(ekf(), Dictionary), (Grid(points=200), Dictionary), (PathIPE(), Dictionary)]
CASES.append((ekf(), DictionaryByState))


@pytest.mark.parametrize("name", CHANGES)
@pytest.mark.parametrize(("tracker", "model_of"), CASES)
def test_prior_and_noise_that_have_changed_are_taken_as_they_stand(tracker, model_of, name):
    model = model_of()
    z = model.draw(0, 2).z
    tracker.track(model, z)
    fresh = model_of()
    for one in (model, fresh):
        one.numbers[name] = CHANGES[name]
    after = tracker.track(model, z)
    wanted = tracker.track(fresh, z)
    np.testing.assert_array_equal(after.mean, wanted.mean)
    np.testing.assert_array_equal(after.covariance, wanted.covariance)


class Folded(Ship):
    """Reads a distance by a root that has no slope of its own at the mean of the prior: 0 / 0."""

    name = "folded"

    def observe(self, x, k):
        return np.sqrt(x[..., :1] ** 2)


def test_a_recording_without_a_slope_at_the_mean_is_not_taken():
    model = Folded()
    h = model.epoch_functions[1]
    assert "other slopes" in h.why
    assert "runs in Python" in model.remarks()[0]
    slope = h.at[0].slope(np.array([[0.0, 1.0], [2.0, 1.0], [-1.0, 0.0]]))[1]
    np.testing.assert_allclose(slope[1:, 0], [[1, 0], [-1, 0]], atol=1e-8)
    assert np.isfinite(ekf().track(model, model.draw(0, 3).z).mean).all()


class Stripped(Ship):
    """Takes a root, where np.asarray hides from the recorder that 0 replaces NaN: at states that
    the prior does not show."""

    name = "stripped"
    prior = Normal(np.array([0.0, 8.0]), np.diag([1, 0.01]))

    def transition(self, x, k):
        p, v = np.asarray(x[..., 0]), np.asarray(x[..., 1])
        with np.errstate(invalid="ignore"):
            slow = np.nan_to_num(np.sqrt(np.asarray(v * 1.0)))
        return np.stack([p + v, v - 0.5 * slow], axis=-1)


def test_trials_in_which_a_recording_errs_are_tracked_again():
    model = Stripped()
    z = model.draw(0, 6).z
    found = ekf().track(model, z)
    by_epoch = ekf().track(model.by_epoch(), z)
    np.testing.assert_allclose(found.mean, by_epoch.mean, rtol=1e-9, equal_nan=True)
