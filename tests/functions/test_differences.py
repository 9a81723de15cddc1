"""Slopes by differences beside closed forms, with the errors that they say."""

import numpy as np

from ipe_bench.functions.differences import (
    WRONG,
    along_units,
    judge,
    measured,
    unmoved,
)
from ipe_bench.functions.judged import Judged, same_values
from ipe_bench.functions.rough import by_steps, steps_of_a_rough_function


def test_a_coordinate_blurs_the_slopes_along_itself_alone():
    """Of sin(1000 b) at b = 0.001 beside a coordinate of 1e8, whose round-off is 1.5e-8."""
    x = np.array([[1e8, 1e-3]])
    units = along_units(np.array([1e6, 1e-4]), 1)
    slope, error = measured(lambda x: np.sin(1e3 * x[:, 1:]), x, units).central
    assert np.abs(slope[0, 0] - [0.0, 0.1 * np.cos(1.0)]).max() < 1e-12
    assert error.max() < 1e-10


def test_a_constant_has_the_slope_0_whatever_its_digits():
    """Also 1.0, whose digits are those of a function in single precision."""
    x = np.array([[0.3], [2.0]])
    slope, error = measured(lambda x: np.ones((len(x), 1)), x, along_units(np.ones(1), 2)).central
    assert (slope == 0.0).all()
    assert error.max() < 1e-10


def test_steps_of_a_rough_function_step_over_its_ripples():
    """3 x, with ripples of 1e-6 that no slope should see."""
    x = np.linspace(0.1, 1.0, 9)[:, None]

    def rough(x):
        return 3 * x + 1e-6 * np.sin(1e7 * x)

    steps = steps_of_a_rough_function(rough, x, np.array([0.04]), unmoved)
    assert steps is not None
    assert steps.apart.max() < 0.1
    assert np.abs(by_steps(rough, x, steps, unmoved) - 3.0).max() < 1e-3


def test_an_output_that_stays_0_is_not_doubted():
    called = []

    def still(x):
        called.append(len(x))
        return 0 * x

    _, J = Judged(still, np.ones(1)).slopes(np.linspace(0.0, 1.0, 5)[:, None])
    assert (J == 0.0).all()
    assert sum(called) <= 5 * 4


def test_values_are_the_same_if_both_are_missing():
    assert same_values(np.array([[np.nan, 1.0]]), np.array([[np.nan, 1.0 + 1e-16]]))
    assert not same_values(np.array([[np.nan, 1.0]]), np.array([[2.0, 1.0]]))
    assert not same_values(np.array([[2.0, 1.0]]), np.array([[np.nan, 1.0]]))


def test_an_infinite_slope_hides_no_wrong_one_beside_it():
    x = np.zeros((1, 2))
    found = measured(lambda x: 1e-15 * x.sum(axis=1)[:, None], x, along_units(np.ones(2), 1))
    verdicts = judge(np.array([[[np.inf, 1.01e-15]]]), found)
    assert verdicts.ravel().tolist() == [WRONG, WRONG]
