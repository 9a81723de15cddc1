"""Readings are those of the solution, or there are none: poles, wells, pulses, and outputs that
magnify states."""

from contextlib import nullcontext
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from shared.by_numpy import by_numpy
from shared.families import slow_if

from ipe_bench.measurements import Ode

FAR = (8.0, 16.0, 24.0)
"""Times so far apart that what is fast has settled long before each."""


def kinetics(start="0", loss="L*y/(K+y)", **options):
    """Saturating loss of y, fed by 2 a unit of time, and z behind it: they settle where L y/(K+y) =
    2 and z = 2/k1. Steps that are not stable jump beyond y = -K, where y runs off smoothly."""
    options = {"constants": {"L": 1000.0, "K": 0.05}, "times": FAR} | options
    rates = {"y": f"2-{loss}", "z": f"{loss}-k1*z"}
    return Ode(rates, {"k1": 1.0}, {"y": start}, {"z": "z/(0.3+z)"}, **options)


def settled(k1):
    return 2 / k1 / (0.3 + 2 / k1)


JUMPED = [("0", "L*y/(K+y)", 0.05), ("10", "L*y/(K+y)", 0.01), ("2", "L*y**2/(K**2+y**2)", 0.005)]
JUMPED += [("10", "L*y*(K+y)**-1", 0.05), ("10", "L*y*(K+y)**-1", 0.0003)]
SOME = slow_if(lambda start, loss, K: start == "10", JUMPED)


@pytest.mark.parametrize(("start", "loss", "K"), SOME)
def test_what_explicit_steps_jump_over_is_integrated_by_the_implicit_method(start, loss, K):
    x = np.array([[1.0], [2.0]])
    z = kinetics(start, loss, constants={"L": 1000.0, "K": K}).simulate(x)
    np.testing.assert_allclose(z[:, -1], settled(x[:, 0]), rtol=1e-7)


@pytest.mark.parametrize(("start", "loss", "K"), SOME)
def test_explicit_steps_that_jump_over_a_pole_or_a_well_tell_no_readings(start, loss, K):
    model = kinetics(start, loss, constants={"L": 1000.0, "K": K}, method="explicit")
    assert np.isnan(model.simulate(np.array([[1.0], [2.0]]))).all()


def test_a_pole_that_rough_implicit_steps_jump_over_holds_the_solution_too():
    """Beyond the pole exp(-z) is 0, which hides how large readings are."""
    given = {"constants": {"L": 90.0, "K": 0.0015}, "times": (4.0, 8.0, 12.0, 16.0)}
    model = replace(kinetics("10", "L*y*(K+y)**-1", **given), outputs={"z": "exp(-z)"})
    x = np.array([[1.0], [2.0]])
    np.testing.assert_allclose(model.simulate(x)[:, -1], np.exp(-2 / x[:, 0]), rtol=1e-6)


def test_a_truth_that_explicit_steps_do_not_follow_has_no_readings_though_the_nominal_point_has():
    rates = {"y": "2-L*y/(0.05+y)", "z": "L*y/(0.05+y)-z"}
    model = Ode(rates, {"L": 3.0}, outputs={"z": "z/(0.3+z)"}, times=FAR)
    x = np.array([[1.0], [4.0], [400.0], [1000.0]])
    z = model.simulate(x)
    np.testing.assert_allclose(z[:2, -1], settled(1.0), rtol=1e-7)
    assert np.isnan(z[2:]).all()
    assert [bool(model.hindrance(row)) for row in x] == [False, False, True, True]
    assert "measurement.method=implicit follows them" in model.hindrance(x[3])
    np.testing.assert_allclose(
        replace(model, method="implicit").simulate(x)[:, -1], settled(1.0), rtol=1e-7
    )


def test_a_truth_whose_well_is_narrower_than_any_step_has_no_readings():
    """The loss of y falls off on both sides of K: steps that miss it go on below 0, where y never
    is."""
    rates = {"y": "0.5-5*y**2/(K**2+y**2)", "z": "5*y**2/(K**2+y**2)-z"}
    model = Ode(rates, {"K": 1.0}, {"y": 2.0}, {"z": "z/(0.3+z)"}, FAR)
    z = model.simulate(np.array([[1.0], [0.03], [0.001]]))
    np.testing.assert_allclose(z[:2, -1], 0.5 / 0.8, rtol=1e-7)
    assert np.isnan(z[2]).all()


@pytest.mark.parametrize(("rate", "doubt"), [(0.5, 0.0), (500.0, 1.0)])
def test_numpy_notes_the_same_steps_in_doubt_as_machine_code(rate, doubt):
    engine = kinetics(times=(1.0, 2.0), constants={"L": rate, "K": 1.0}).engine
    for engine_of in (nullcontext, by_numpy):
        z, states = np.empty((1, engine.m)), np.empty((1, 1, 3, 3))
        with engine_of():
            engine._simulate(
                np.ones((1, 1)), np.arange(1), np.array([4, 4]), np.zeros(engine.m), z, states
            )
        assert states[0, 0, -1, -1] == doubt


def well(width="K", **options):
    """A body that moves at 4.5 a unit of time and is held near 0, where the rate is zero on the far
    side of a well."""
    rates = {"y": f"5*exp(-((y-c)/({width}))**2)-4.5"}
    return Ode(rates, {"K": 1.0, "c": 1.0}, {"y": 9.0}, **options)


def held(width, c):
    return c + width * np.sqrt(np.log(5 / 4.5))


@pytest.mark.parametrize("width", [0.3, 0.003])
def test_a_nominal_well_that_long_implicit_steps_agree_to_pass_over_is_met_or_told(width):
    times = tuple(np.arange(0.5, 4.1, 0.5))
    for method, met in (("auto", True), ("implicit", width > 0.1)):
        model = well(f"K*{width}", times=times, method=method)
        z = model.simulate(model.nominal[None])[0, -1]
        assert z == pytest.approx(held(width, 1.0), abs=1e-7) if met else np.isnan(z)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["auto", "implicit"])
def test_drawn_wells_are_met_that_are_a_twentieth_of_the_way_between_readings_or_wider(method):
    """What a trial alone has is met by chance where it is narrower, unless its steps are told to be
    short."""
    rng = np.random.default_rng(1)
    width = np.exp(rng.uniform(np.log(1e-3), 0.0, 300))
    x = np.stack([width, rng.uniform(0.2, 8.8, 300)], axis=1)
    model = well(times=tuple(np.arange(1.0, 41.0)), method=method)
    wrong = ~(np.abs(model.simulate(x)[:, -1] - held(width, x[:, 1])) < 1e-6)
    assert wrong.any()
    assert not wrong[width > 4.5 / 20].any()
    short = replace(model, method="explicit", step=1e-3 / 4.5)
    np.testing.assert_allclose(
        short.simulate(x[wrong][:20])[:, -1], held(*x[wrong][:20].T), atol=1e-6
    )


def test_a_solution_that_ends_at_a_pole_has_no_readings_behind_it():
    """y^2 = 1 - 2 k t, and with a rate that has a place to settle beyond the pole."""
    model = Ode({"y": "-k/y"}, {"k": 0.5}, {"y": 1.0}, times=(0.2, 0.6, 2.0))
    x = np.array([[1.0], [0.4]])
    z = model.simulate(x)
    assert np.isnan(z[0]).all()
    np.testing.assert_allclose(z[1], np.sqrt(1 - 0.4 * np.array(model.times)), atol=1e-8)
    assert model.hindrance(x[0]) == "the solution itself leaves all numbers near t = 1"
    beyond = Ode({"y": "-k/y-0.3*(y+1)"}, {"k": 0.5}, {"y": 1.0}, times=tuple(np.arange(0.5, 10.0)))
    assert np.isnan(beyond.simulate(x)).all()


@pytest.mark.parametrize("method", ["auto", "explicit", "implicit"])
def test_a_divisor_that_passes_zero_without_a_pole_is_passed(method):
    """(1 - e^-y) / y is 1 at y = 0, and y settles where it is 2."""
    model = Ode(
        {"y": "k*(1-exp(-y))/y-2"}, {"k": 1.0}, {"y": 2.0}, times=(1.0, 2.0, 40.0), method=method
    )
    z = model.simulate(model.nominal[None])[0]
    assert z[1] < 0 < z[0]
    assert (1 - np.exp(-z[2])) / z[2] == pytest.approx(2.0, rel=1e-7)


@pytest.mark.parametrize(
    ("width", "method"),
    slow_if(
        lambda width, method: method == "implicit" and width > 0.001,
        product([0.03, 0.003, 0.001], ["auto", "explicit", "implicit"]),
    ),
)
def test_a_pulse_is_met_by_both_methods(width, method):
    rates = {"y": f"k0*exp(-((t-0.77)/{width})**2)/{width}-k1*y"}
    model = Ode(rates, {"k0": 1.0, "k1": 0.1}, times=(1.0, 2.0), method=method)
    x = np.array([[1.0, 1.0], [1.3, 0.5]])
    k0, k1 = x[:, :1], 0.1 * x[:, 1:]
    left = np.exp(-k1 * (np.array(model.times) - 0.77) + (k1 * width / 2) ** 2)
    np.testing.assert_allclose(
        model.simulate(x), k0 * np.sqrt(np.pi) * left, rtol=1e-7, atol=1e-4 * width
    )
    assert not model.hindrance(model.nominal)


@pytest.mark.parametrize(
    "method", slow_if(lambda method: method != "explicit", ["auto", "explicit", "implicit"])
)
def test_an_output_that_magnifies_a_state_beyond_its_digits_has_no_reading(method):
    """cos(y) of y = e^(4 x): the last digit of y is 5e-6 at x = 6, and more than a turn at 11."""
    model = Ode({"y": "k*y"}, {"k": 0.1}, {"y": 1.0}, {"z": "cos(y)"}, (40.0,), method=method)
    x = np.array([[1.0], [6.0], [11.0]])
    z = model.simulate(x)[:, 0]
    assert z[0] == pytest.approx(np.cos(np.exp(4.0)), abs=1e-6)
    assert np.isnan(z[1:]).all()
    for row, value in zip(x, z, strict=True):
        assert bool(model.hindrance(row)) == np.isnan(value)
    assert model.hindrance(x[2]).startswith("neither steps of ")


@pytest.mark.parametrize(
    "model",
    [
        Ode({"y": "k*y-sin(t)"}, {"k": 1.0}, {"y": 0.5}, times=(40.0,)),
        pytest.param(
            Ode(
                {"x": "s*(y-x)", "y": "x*(28-z)-y", "z": "x*y-8/3*z"},
                {"s": 10.0},
                {"x": 1.0, "y": 1.0, "z": 1.0},
                times=(60.0,),
            ),
            marks=pytest.mark.slow,
        ),
    ],
    ids=["unstable", "lorenz"],
)
def test_equations_that_no_method_follows_are_not_handed_to_the_implicit_one(model):
    """Solutions that begin a rounding error apart end as far apart as they are large, as e^t or
    e^(0.9 t)."""
    assert np.isnan(model.simulate(model.nominal[None])).all()
