"""Differential equations that are drawn, beside SciPy's solution of the same text."""

import numpy as np
import pytest
from drawn_equations import ANSWERS, COUNT, HARD, drawn
from shared.families import slow_if
from shared.oracles import agreed

from ipe_bench.engine.ladder import NOT_FOLLOWED

_WITHIN = 3.0
"""Tolerances: step doubling says what is left of an error as if all of it were of eighth order."""
QUICK = (100, 140, 150, 180, 200, 260, 300, 340, 380, 460)
"""Draws that take less than a second."""


def check(number, expected):
    """Readings at a truth are those of the solution, or the model is refused, or there is a
    word."""
    one = drawn(number)
    model, x = one.model, one.x[None]
    if not len(expected) or model.hindrance(
        model.nominal
    ):  # SciPy has none, or the shortest steps are too long
        return
    z = model.simulate(x)
    off = np.abs(z[0] - expected).max() / model.engine.tolerance
    told = off > _WITHIN and any("times the tolerance" in said for said in model.remarks(one.x))
    if not told:
        agreed(off, _WITHIN)
    stop = (len(model.times) + 1) // 2
    np.testing.assert_array_equal(model.simulate_until(x, stop), z[:, model.rows(stop)])
    assert np.isfinite(model.jacobian(x)).all()


def check_hard(number, expected):
    """Readings are those of the solution, or there are none, and the reason is told; returns
    whether there are."""
    one = drawn(number)
    model, z = one.model, one.model.simulate(one.x[None])[0]
    has_readings = bool(np.isfinite(z).all())
    assert has_readings == (not model.hindrance(one.x)), number
    if has_readings and len(expected):
        off = np.abs(z - expected).max() / model.engine.tolerance
        assert off <= NOT_FOLLOWED, (number, off)
    return has_readings


def answers():
    with np.load(ANSWERS) as stored:
        return np.split(stored["z"], np.cumsum(stored["count"])[:-1])


@pytest.mark.oracle(
    "library: SciPy's solve_ivp, on the text of the equations",
    "readings of 10 drawn models, in tolerances of the model",
    3.0,
)
@pytest.mark.parametrize("number", slow_if(lambda number: number % 50 or number > 200, QUICK))
def test_readings_of_drawn_equations_are_those_of_scipy(number):
    check(number, answers()[number])


@pytest.mark.parametrize(
    "number", slow_if(lambda number: number > HARD + 100, range(HARD, COUNT, 100))
)
def test_readings_beside_poles_and_pulses_or_magnified_are_right_or_absent(number):
    check_hard(number, answers()[number])


def test_scipy_has_an_answer_for_nearly_all_drawn_equations():
    stored = answers()
    assert len(stored) == COUNT
    assert sum(map(len, stored)) > 0
    assert sum(len(z) == 0 for z in stored) < 0.05 * COUNT


TENTHS = [
    pytest.param(start, marks=pytest.mark.slow if start == 1 else pytest.mark.campaign)
    for start in range(10)
]
"""Tenths of the drawn equations, of which every one has all kinds: one stands for all, and the
others wait for a campaign."""


@pytest.mark.oracle(
    "library: SciPy's solve_ivp, on the text of the equations",
    "readings of 500 drawn models, in tolerances of the model",
    3.0,
)
@pytest.mark.parametrize("start", TENTHS)
def test_readings_of_all_drawn_equations_are_those_of_scipy(start):
    for number, expected in list(enumerate(answers()))[start:HARD:10]:
        check(number, expected)


@pytest.mark.parametrize("start", TENTHS)
def test_all_readings_beside_poles_and_pulses_or_magnified_are_right_or_absent(start):
    stored = answers()
    numbers = range(HARD + start, COUNT, 10)
    told = {number: check_hard(number, stored[number]) for number in numbers}
    without_magnification = [told[number] for number in numbers if number % 3 < 2]
    assert np.mean(without_magnification) > 0.8
