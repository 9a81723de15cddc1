"""Differential equations that are drawn, beside SciPy's solution of the same text."""

import numpy as np
import pytest
from drawn_equations import ANSWERS, COUNT, drawn
from shared.oracles import agreed

_WITHIN = 3.0
"""Tolerances: step doubling says what is left of an error as if all of it were of eighth order."""


def check(number, expected):
    """Readings at a truth are those of the solution, or the model is refused, or there is a word."""
    one = drawn(number)
    model, x = one.model, one.x[None]
    if not len(expected) or model.hindrance(model.nominal):  # SciPy has none, or the shortest steps are too long
        return
    z = model.simulate(x)
    off = np.abs(z[0] - expected).max() / model.engine.tolerance
    told = off > _WITHIN and any("times the tolerance" in said for said in model.remarks(one.x))
    if not told:
        agreed(off, _WITHIN)
    stop = (len(model.times) + 1) // 2
    np.testing.assert_array_equal(model.simulate_until(x, stop), z[:, model.rows(stop)])
    assert np.isfinite(model.jacobian(x)).all()


def answers():
    with np.load(ANSWERS) as stored:
        return np.split(stored["z"], np.cumsum(stored["count"])[:-1])


@pytest.mark.oracle(
    "library: SciPy's solve_ivp, on the text of the equations",
    "readings of 10 drawn models, in tolerances of the model",
    3.0,
)
@pytest.mark.parametrize("number", range(0, COUNT, 50))
def test_readings_of_drawn_equations_are_those_of_scipy(number):
    check(number, answers()[number])


def test_scipy_has_an_answer_for_nearly_all_drawn_equations():
    stored = answers()
    assert len(stored) == COUNT
    assert sum(map(len, stored)) > 0
    assert sum(len(z) == 0 for z in stored) < 0.05 * COUNT


@pytest.mark.oracle(
    "library: SciPy's solve_ivp, on the text of the equations",
    "readings of 500 drawn models, in tolerances of the model",
    3.0,
)
@pytest.mark.slow
@pytest.mark.parametrize("start", range(10))
def test_readings_of_all_drawn_equations_are_those_of_scipy(start):
    for number, expected in list(enumerate(answers()))[start::10]:
        check(number, expected)
