"""Slopes by differences beside closed forms, with the errors that they say."""

import numpy as np

from ipe_bench.functions.differences import along_units, measured


def test_a_coordinate_blurs_the_slopes_along_itself_alone():
    """Of sin(1000 b) at b = 0.001 beside a coordinate of 1e8, whose round-off is 1.5e-8."""
    x = np.array([[1e8, 1e-3]])
    units = along_units(np.array([1e6, 1e-4]), 1)
    slope, error = measured(lambda x: np.sin(1e3 * x[:, 1:]), x, units).central
    assert np.abs(slope[0, 0] - [0.0, 0.1 * np.cos(1.0)]).max() < 1e-12
    assert error.max() < 1e-10
