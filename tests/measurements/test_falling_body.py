"""The falling body against its closed form and another integrator."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.special import expi

from ipe_bench.basics.errors import UserError
from ipe_bench.measurements import FallingBody
from ipe_bench.plugins.conformance import check_component

FOOT = 0.3048
PAPER = np.array([0.0, 0.0, 1.0])
"""The true body of both papers, in units of error from the presumed one."""


def draw(model, trials=20):
    return model.nominal + np.random.default_rng(0).normal(size=(trials, model.n))


def altitude(t, h0, v0, b, gamma):
    """With u = exp(-gamma h): gamma v0 t = exp(-a u0) (Ei(a u) - Ei(a u0)), a = b / gamma, by separation."""
    a, u0 = b / gamma, np.exp(-gamma * h0)
    time = lambda u: np.exp(-a * u0) * (expi(a * u) - expi(a * u0)) / (gamma * v0) - t  # noqa: E731
    return -np.log(brentq(time, u0, 700.0 / a, xtol=1e-18, rtol=1e-14)) / gamma


def test_ranges_are_those_of_the_closed_form():
    model = FallingBody(readings=20)
    x = np.vstack([model.nominal + PAPER, draw(model, 4)])
    for row, z in zip(x, model.simulate(x), strict=True):
        h0, v0, log_b = row * model.sizes
        b = 3e-5 / FOOT * np.exp(log_b)
        h = np.array([altitude(t, h0, v0, b, 5e-5 / FOOT) for t in range(1, 21)])
        np.testing.assert_allclose(z, np.hypot(1e5 * FOOT, h - 1e5 * FOOT), rtol=1e-9)


def test_ranges_agree_with_an_adaptive_integrator_in_the_papers_own_units():
    model = FallingBody()
    solution = solve_ivp(
        lambda t, y: [-y[1], -np.exp(-5e-5 * y[0]) * y[1] ** 2 * 1e-3],
        (0.0, 60.0),
        [3e5, 2e4],
        "DOP853",
        t_eval=np.arange(1.0, 61.0),
        rtol=1e-12,
        atol=1e-9,
    )
    ranges = np.sqrt(1e10 + (solution.y[0] - 1e5) ** 2) * FOOT
    np.testing.assert_allclose(model.simulate((model.nominal + PAPER)[None])[0], ranges, atol=1e-5)


def test_the_papers_true_coefficient_is_one_unit_from_the_presumed_one():
    model = FallingBody()
    b = model.ballistic * np.exp(((model.nominal + PAPER) * model.sizes)[2])
    assert b * FOOT == pytest.approx(1e-3, rel=1e-14)


def test_the_step_is_short_enough_to_be_seen_in_no_reading():
    model = FallingBody()
    x = draw(model)
    assert np.abs(model.simulate(x) - replace(model, step=1 / 16).simulate(x)).max() < 1e-5


@pytest.mark.parametrize("ln_ballistic", [10.0, 14.0, 17.0, 17.4, 18.0])
def test_a_body_that_is_stopped_at_once_is_followed_as_well(ln_ballistic):
    """With steps of half a second the ranges are off by 13.5 m at 17, by 297 m at 17.4, and no numbers at 18."""
    model = FallingBody()
    x = model.nominal + np.array([0.0, 0.0, ln_ballistic]) / model.sizes
    b, gamma = 3e-5 / FOOT * np.exp(ln_ballistic), 5e-5 / FOOT
    solution = solve_ivp(
        lambda t, y: [-y[1], -b * np.exp(-gamma * y[0]) * y[1] ** 2],
        (0.0, 60.0),
        [3e5 * FOOT, 2e4 * FOOT],
        "Radau",
        t_eval=model.times,
        rtol=1e-11,
        atol=1e-9,
    )
    ranges = np.hypot(1e5 * FOOT, solution.y[0] - 1e5 * FOOT)
    np.testing.assert_allclose(model.simulate(x[None])[0], ranges, atol=1e-3)


def test_it_keeps_the_promises_of_models():
    assert not [f.complaint for f in check_component("falling_body", FallingBody()) if f.complaint]


@pytest.mark.parametrize(("field", "value"), [("ballistic", 0.0), ("readings", 3)])
def test_mistakes_are_named(field, value):
    with pytest.raises(UserError, match=rf"^{field}="):
        FallingBody(**{field: value})
