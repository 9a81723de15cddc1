"""Equations that change with time: inputs held or straight between rows, and rates in pieces, by
both integrators."""

from contextlib import nullcontext
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from shared.by_numpy import by_numpy
from shared.oracles import assert_agrees
from shared.slopes import differentiate

from ipe_bench.baselines import LevenbergMarquardt
from ipe_bench.basics.errors import UserError
from ipe_bench.measurements import Ode
from ipe_bench.measurements.ode.driven import course
from ipe_bench.noise import Gaussian
from ipe_bench.real.estimation import Question
from ipe_bench.real.fits import fit
from ipe_bench.real.readings import open_together, write_readings
from ipe_bench.workshop.conformance import check_component

T = np.arange(0.0, 600.0, 10.0)
CURRENT = np.repeat(np.random.default_rng(0).choice([0.0, 1.0, 2.5, -1.0], 12), 5)
BATTERY = Ode(
    {"soc": "-current/9000", "v": "current/c1 - v/(r1*c1)"},
    {"r0": 0.02, "r1": 0.015, "c1": 2000.0},
    {"soc": 1.0},
    {"voltage": "3.4 + 0.7*soc - v - r0*current"},
    tuple(T),
    driven_by={"current": "hold"},
    columns={"time": T.tolist(), "current": CURRENT.tolist()},
    tolerance=1e-11,
)

LM = {"lm": LevenbergMarquardt()}


def circuit(r0, r1, c1):
    """The exact steps of the linear circuit."""
    v, soc, z = 0.0, 1.0, []
    for current in CURRENT:
        z.append(3.4 + 0.7 * soc - v - r0 * current)
        v = current * r1 + (v - current * r1) * np.exp(-10 / (r1 * c1))
        soc -= current * 10 / 9000
    return np.array(z)


@pytest.mark.oracle("closed form: steps of a linear circuit", "voltages", 1e-10)
@pytest.mark.parametrize("method", ["explicit", pytest.param("implicit", marks=pytest.mark.slow)])
def test_a_battery_follows_its_current(method):
    model = replace(BATTERY, method=method)
    x = model.nominal * np.array([[1.0, 1.0, 1.0], [1.2, 0.8, 1.5]])
    z = model.simulate(x)
    for row, p in zip(z, x * model.sizes, strict=True):
        assert_agrees(row, circuit(*p), atol=1e-10)
    np.testing.assert_allclose(
        model.jacobian(x), differentiate(model.simulate, x, analytic=False), atol=1e-9
    )
    assert np.array_equal(model.simulate(x[1:])[0], z[1])
    assert np.array_equal(model.simulate_until(x, 30), z[:, :30])


def test_a_battery_has_the_same_readings_by_numpy():
    model = replace(BATTERY, method="explicit")
    x = BATTERY.nominal * np.array([[1.0, 1.0, 1.0], [1.2, 0.8, 1.5]])
    z = model.simulate(x)
    with by_numpy():
        np.testing.assert_allclose(model.simulate(x), z, atol=1e-12)


@pytest.mark.parametrize("method", ["explicit", "implicit"])
def test_a_rate_that_depends_on_time_has_its_exact_solution(method):
    """y' = cos t - k y from 0, with its slope by k; by NumPy, too."""
    times = np.array([0.3, 2.0, 5.5])
    model = Ode(
        {"y": "cos(t) - k*y"}, {"k": 0.7}, times=tuple(times), method=method, tolerance=1e-11
    )
    x = np.array([[1.0], [1.5]])

    def exact(k):
        return (k * np.cos(times) + np.sin(times) - k * np.exp(-k * times)) / (1 + k**2)

    for engine in (nullcontext, by_numpy):
        with engine():
            z, J = model.simulate(x), model.jacobian(x)
        for i, k in enumerate(0.7 * x[:, 0]):
            slope = 0.7 * np.imag(exact(k + 1e-30j)) / 1e-30
            np.testing.assert_allclose(z[i], exact(k), atol=1e-9)
            np.testing.assert_allclose(J[i, :, 0], slope, atol=1e-8)


@pytest.mark.parametrize("method", ["explicit", "implicit"])
def test_a_reading_at_a_jump_shows_the_input_from_then_on(method):
    columns = {"time": [0.0, 1.0, 2.0], "u": [3.0, -1.0, 0.5]}
    model = Ode(
        {"y": "u - k*y"}, {"k": 0.7}, outputs={"z": "y + 10*u"},
        times=(0.0, 0.5, 1.0, 1.5, 2.0, 3.0),
        driven_by={"u": "hold"}, columns=columns, method=method, tolerance=1e-11,
    )  # fmt: skip
    y, k, exact = 0.0, 0.7, []
    for step, u in ((0.0, 3.0), (0.5, 3.0), (0.5, 3.0), (0.5, -1.0), (0.5, -1.0), (1.0, 0.5)):
        y = u / k + (y - u / k) * np.exp(-k * step)
        exact.append(y)
    shown = np.array([3.0, 3.0, -1.0, -1.0, 0.5, 0.5])
    np.testing.assert_allclose(
        model.simulate(model.nominal[None])[0], exact + 10 * shown, atol=1e-9
    )


@pytest.mark.oracle("closed form: a state that follows a straight input", "readings", 1e-10)
@pytest.mark.parametrize("method", ["explicit", pytest.param("implicit", marks=pytest.mark.slow)])
def test_a_stiff_follower_of_a_straight_input_has_its_exact_solution(method):
    """y' = k (u - y), where u is straight between its rows."""
    t = np.linspace(0.0, 10.0, 21)
    u, k, y, exact = np.sin(t), 300.0, 0.0, [0.0]
    for a, b in pairwise(u):
        s = (b - a) / 0.5
        y = b - s / k + (y - a + s / k) * np.exp(-k * 0.5)
        exact.append(y)
    columns = {"time": t.tolist(), "u": u.tolist()}
    model = Ode({"y": "k*(u-y)"}, {"k": k}, times=tuple(t), driven_by={"u": "linear"},
                columns=columns, method=method,
                tolerance=1e-11)  # fmt: skip
    x = model.nominal[None]
    assert_agrees(model.simulate(x)[0], exact, atol=1e-10)
    np.testing.assert_allclose(
        model.jacobian(x), differentiate(model.simulate, x, analytic=False), atol=1e-8
    )
    early = replace(
        model, columns={"time": [2.0, 3.0], "u": [1.0, 1.0]}
    )  # level before the first row and after the last
    np.testing.assert_allclose(early.simulate(x)[0, 1:], 1.0, atol=1e-10)


def test_few_readings_of_many_changes_are_those_of_all():
    few = replace(BATTERY, times=tuple(T[5::7]))
    x = BATTERY.nominal[None] * 1.1
    np.testing.assert_allclose(few.simulate(x), BATTERY.simulate(x)[:, 5::7], atol=1e-12)
    assert (few.m, len(few.epochs or ())) == (8, 8)
    assert not [f for f in check_component("ode", BATTERY) if f.complaint]
    with pytest.raises(
        UserError, match=r"current changes at 0 without a reading; add it to measurement.times"
    ):
        _ = few.input_columns


def test_readings_are_written_with_their_inputs_and_read_again(tmp_path):
    ramp = replace(BATTERY, driven_by={"current": "linear"})
    x = BATTERY.nominal[None] * 1.1
    for k, model in enumerate((BATTERY, ramp)):
        write_readings(tmp_path / f"{k}.csv", model, model.simulate(x)[0])
        again = open_together([tmp_path / f"{k}.csv"], replace(model, times=(), columns={}))
        np.testing.assert_allclose(again.model.simulate(x), model.simulate(x), atol=1e-12)


@pytest.mark.oracle("closed form: doses and a ramp into one compartment", "readings", 1e-10)
@pytest.mark.parametrize("method", ["explicit", "implicit"])
@pytest.mark.parametrize(
    "dose",
    [
        "(dose if 1 <= t and not begin + 1.3 <= t else 0)",
        "dose*(sign(t - 1) - sign(t - begin - 1.3))/2",
    ],
)
def test_rates_in_pieces_of_time_have_their_exact_solution(method, dose):
    """y' = dose - k y within [1, 2.3) and -k y outside, then with a ramp q (t - 3)."""
    model = Ode(
        {"y": f"{dose} - k*y + q*max(0, t-3)"}, {"k": 0.7, "q": 0.2},
        times=(0.5, 1.5, 2.5, 6.0), constants={"dose": (2.0, 3.0), "begin": 1.0}, tolerance=1e-11,
        method=method,
    )  # fmt: skip
    k, q = 0.7, 0.2

    def exact(t, dose):
        y = (
            dose / k * (1 - np.exp(-k * (min(t, 2.3) - 1))) * np.exp(-k * max(t - 2.3, 0))
            if t > 1
            else 0.0
        )
        return y + (q / k * (t - 3) - q / k**2 * (1 - np.exp(-k * (t - 3))) if t > 3 else 0.0)

    x = model.nominal[None]
    expected = [exact(t, dose) for dose in (2.0, 3.0) for t in model.times]
    assert_agrees(model.simulate(x)[0], expected, atol=1e-10)
    np.testing.assert_allclose(
        model.jacobian(x), differentiate(model.simulate, x, analytic=False), atol=1e-8
    )


@pytest.mark.parametrize(
    ("rate", "message"),
    [
        (
            "(1 if y < 0.5 else 0) - k*y",
            "a rate jumps at a moment that a state or a parameter decides",
        ),
        ("-k*y if t < 10*k else 0", "a rate jumps at a moment"),
        ("-k*y if t < 2 and y > 0.5 else -k", "a rate jumps at a moment"),
        ("-k*y if sin(t) > 0 else 0", "sin.t. > 0: compare t itself with a constant"),
        ("-k*y if sin(2*pi*t) > 0.5 else 0", "compare t itself with a constant"),
        ("-k*y if (1 if t < 3 else 2) > 1.5 else 0", "compare t itself with a constant"),
        ("-k*y*sign(y - 0.5)", "a rate jumps at a moment"),
        ("k if y**3 < 1e15 else 3*k", "a rate jumps at a moment"),
        ("k*y if exp(y) < 1e10 else -k", "a rate jumps at a moment"),
        ("k if exp(y) > 1e100 else 2*k", "a rate jumps at a moment"),
        ("k if 1/y > 1e5 else 3*k", "a rate jumps at a moment"),
        ("k if log10(y) < -7 else 2*k", "a rate jumps at a moment"),
        ("1e-12*k*y if y < 1e-9 else 1e-12", "a rate jumps at a moment"),
        (
            "-k*y*floor(t)",
            "a rate jumps at a moment.*write comparisons of t where floor or mod is taken",
        ),
        ("-k*mod(y, 0.1)", "a rate jumps at a moment"),
        ("-k*y if mod(t, 2) < 1 else 0", "compare t itself with a constant"),
        ("-k*y*sign(sin(t))", "the sign of t: compare t itself with a constant"),
        (
            "-k*y*" + "abs(" * 40 + "t - 1" + ")" * 40,
            "the abs of t: compare t itself with a constant",
        ),
    ],
)
@pytest.mark.parametrize("method", ["auto", "implicit"])
def test_a_jump_at_an_unknown_moment_is_refused(rate, message, method):
    model = Ode({"y": rate}, {"k": 0.3}, {"y": 1.0}, times=(1.0, 2.0, 5.0), method=method)
    with pytest.raises(UserError, match=message):
        model.simulate(model.nominal[None])


@pytest.mark.parametrize(
    "rate",
    [
        "k*min(y**3, 1e15)",
        "k*min(exp(y), 1e100)",
        "k*max(exp(y) - 1e10, 0)",
        "k*sqrt(abs(y - 1e6))",
        "k*min(1/y, 1e5)",
        "k*abs(sin(y))",
        "1e-9*k*max(y - 1e-6, 0)",
        "k*((1-exp(-y))/y if abs(y) > 1e-8 else 1)",
    ],
)
def test_a_kink_is_no_jump_however_large_the_numbers_are_that_meet_in_it(rate):
    model = Ode({"y": rate}, {"k": 0.3}, {"y": 1.0}, times=(0.1, 0.2))
    assert np.isfinite(model.simulate(model.nominal[None])).all()


@pytest.mark.parametrize("method", ["explicit", "implicit"])
def test_angles_lengths_and_steps_are_read_of_a_solution_with_their_slopes(method):
    """A wheel of radius r that turns at a steady rate, more than once; readings on the whole plane
    and over its cut."""
    shown = {
        "bearing": "arctan2(r*sin(a), r*cos(a) - 0.5)",
        "range": "hypot(r*sin(a), r*cos(a) - 0.5)",
        "turn": "mod(a + pi, 2*pi) - pi",
        "side": "r*sign(sin(a))",
        "turns": "r*floor(a/(2*pi))",
    }
    times = tuple(np.arange(0.25, 9.0, 0.5))
    model = Ode(
        {"a": "w"}, {"w": 1.7, "r": 2.0}, {"a": 0.3}, shown, times, tolerance=1e-11, method=method
    )
    x = np.array([[1.0, 1.0], [0.83, 1.2], [-1.3, 0.7]])
    w, r = (x * model.sizes).T[:, :, None]
    a = 0.3 + w * np.array(times)
    east, north, level = r * np.cos(a) - 0.5, r * np.sin(a), np.zeros_like(a)
    exact = np.arctan2(north, east), np.hypot(north, east), (a + np.pi) % (2 * np.pi) - np.pi
    exact += r * np.sign(np.sin(a)), r * np.floor(a / (2 * np.pi))
    assert model.simulate(x).reshape(3, -1, 5) == pytest.approx(np.stack(exact, axis=2), abs=1e-9)
    turning = (r**2 - r * np.cos(a) / 2) / (east**2 + north**2) * np.array(times)
    slopes = model.jacobian(x).reshape(3, -1, 5, 2) / model.sizes
    assert slopes[:, :, 0, 0] == pytest.approx(turning, abs=1e-7)
    assert slopes[:, :, 1, 0] == pytest.approx(
        0.5 * north / np.hypot(north, east) * np.array(times), abs=1e-7
    )
    assert slopes[:, :, 2] == pytest.approx(
        np.stack([level + np.array(times), level], axis=2), abs=1e-7
    )
    assert slopes[:, :, 3] == pytest.approx(np.stack([level, np.sign(np.sin(a))], axis=2), abs=1e-7)
    assert slopes[:, :, 4] == pytest.approx(
        np.stack([level, np.floor(a / (2 * np.pi))], axis=2), abs=1e-7
    )


@pytest.mark.parametrize(
    "rate",
    [
        "-k*sqrt(y) if y > 0 else 0",
        "-k*min(y, 0.5) - 0*abs(y)",
        "-k*y if k > 0.1 else 0",
        "-k*y*(y - 0.5)*sign(y - 0.5)",
    ],
)
def test_a_kink_is_integrated(rate):
    model = Ode({"y": rate}, {"k": 0.3}, {"y": 1.0}, times=(1.0, 2.0, 5.0))
    x = model.nominal[None]
    by_differences = differentiate(model.simulate, x, analytic=False)
    np.testing.assert_allclose(model.jacobian(x), by_differences, rtol=2e-3, atol=1e-8)


def test_readings_that_a_kink_leaves_off_are_told_of():
    kinked = Ode({"y": "-a*max(0, y - 1) - 0.3*y"}, {"a": 1.0}, {"y": 2.0}, times=(2.0,))
    level = 1.0 / 1.3
    exact = np.exp(-0.3 * (2.0 - np.log((2.0 - level) / (1.0 - level)) / 1.3))
    off = np.abs(kinked.simulate(kinked.nominal[None])[0, 0] - exact) / kinked.engine.tolerance
    (said,) = [text for text in kinked.remarks(kinked.nominal) if "kinks" in text]
    assert float(said.partition("about ")[2].split()[0]) == pytest.approx(off, rel=0.2)
    assert "measurement.method=implicit" in said
    for other in (
        replace(kinked, method="implicit"),
        replace(kinked, rates={"y": "-a*y*y"}, times=(40.0,)),
    ):
        assert not [text for text in other.remarks(other.nominal) if "kinks" in text]


def test_a_switch_after_the_readings_is_named():
    model = Ode({"y": "(1 if t < 3*pi else 2) - k*y"}, {"k": 0.3}, times=(1.0, 2.0, 5.0))
    (said,) = model.remarks(model.nominal)
    assert said.startswith("measurement.rates.y: t < 3*pi holds at every reading")
    assert replace(model, times=(1.0, 10.0)).remarks(model.nominal) == ()


def file(path, rows, header="time,current,reading"):
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n")
    return path


def test_a_row_without_a_reading_only_changes_the_input(tmp_path):
    rng = np.random.default_rng(1)
    z = circuit(0.022, 0.013, 2100.0) + 1e-4 * rng.standard_normal(len(T))
    z = np.where(np.arange(len(T)) % 3 == 0, np.nan, z)
    path = file(
        tmp_path / "a.csv",
        [(t, c, "" if np.isnan(v) else v) for t, c, v in zip(T, CURRENT, z, strict=True)],
    )
    model = replace(BATTERY, times=(), columns={}, tolerance=None)
    question = Question(
        model=model, readings=(path,), estimators=LM, noise=Gaussian(1e-4)
    ).checked()
    (found,) = fit(question.problem, question.found.z, LM, Gaussian(1e-4))
    assert np.abs((found.x - [0.022, 0.013, 2100.0]) / found.standard_errors).max() < 3.5
    assert list(found.values) == ["r0", "r1", "c1"]


@pytest.mark.parametrize(
    ("rows", "header", "message"),
    [
        (
            [(0, 1)],
            "time,reading",
            "column current is missing; measurement.driven_by.current takes it from the file",
        ),
        ([(0, 1, 3), (10, "", 3)], "time,current,reading", "row 3, column current: is empty"),
        (
            [(0, 1, 3), (0, 2, 3)],
            "time,current,reading",
            "case=1, time=0: current is 1 in one row and 2 in another",
        ),
    ],
)
def test_an_input_that_is_missing_or_has_gaps_is_refused(tmp_path, rows, header, message):
    with pytest.raises(UserError, match=message):
        open_together(
            [file(tmp_path / "a.csv", rows, header)], replace(BATTERY, times=(), columns={})
        )


def test_two_readings_of_one_thing_at_one_time_both_count(tmp_path):
    model = Ode({"y": "-k*y"}, {"k": 0.5, "y0": 1.0}, {"y": "y0"})
    rows = [(1, 0.62), (1, 0.6), (2, 0.37), (3, 0.23), (2, 0.36)]
    found = open_together([file(tmp_path / "a.csv", rows, "time,reading")], model)
    x = found.model.nominal[None]
    np.testing.assert_allclose(
        found.model.simulate(x)[0], np.exp(-0.5 * np.array([1, 1, 2, 3, 2])), atol=1e-7
    )
    assert [rows.tolist() for rows in found.model.epochs or ()] == [[0, 1], [2, 4], [3]]


def test_an_input_is_that_of_its_last_row_and_level_before_the_first_and_after_the_last():
    """Rows at 1, 2 and 4 with 10, 30 and 20, asked for at rows, between and outside them."""
    times, values = np.array([1.0, 2.0, 4.0]), np.array([10.0, 30.0, 20.0])
    at = np.array([0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0])
    (held,) = course("hold", times, values, at)
    np.testing.assert_array_equal(held, [10, 10, 10, 30, 30, 20, 20])
    u, slope, since = course("linear", times, values, at)
    np.testing.assert_allclose(u + slope * (at - since), np.interp(at, times, values))
