"""Tables and the rarer functions in formulas, beside NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from ipe_bench.basics.errors import UserError
from ipe_bench.measurements.arithmetic import parse
from ipe_bench.states import Formulas

X = np.linspace(-0.5, 1.4, 39)


def test_a_table_is_that_of_numpy():
    table = parse("interp(2*x, 0, 3, 0.5, 3.6, 1, 4.2, 2.5, a)", "k")
    found = table({"x": X, "a": 1.0})
    np.testing.assert_allclose(
        found, np.interp(2 * X, [0, 0.5, 1, 2.5], [3, 3.6, 4.2, 1]), rtol=1e-15
    )
    assert table.names == ("x", "a")


@pytest.mark.parametrize("text", ["interp(x, 1, 2)", "interp(x, 1, 2, 3)", "interp(x, 1, 2, 0, 3)"])
def test_what_is_no_table_is_refused(text):
    with pytest.raises(UserError, match="interp takes x and a table"):
        parse(text, "k")


def test_a_battery_reads_its_table_in_machine_code():
    model = Formulas(
        next={"s": "s - 0.01 + w"},
        readings={"u": "interp(s, 0, 3, 0.1, 3.5, 0.9, 3.9, 1, 4.2) + log1p(s) + arcsin(s/3)"},
        noise={"w": 0.01},
        deviation={"u": 0.01},
        spread={"s": 0.1},
        start={"s": 0.8},
        count=5,
    )
    x = np.linspace(0.05, 1.2, 24)[:, None]
    value, slope = model.observation_at(2).slope(x)
    s = x[:, 0]
    wanted = np.interp(s, [0, 0.1, 0.9, 1], [3, 3.5, 3.9, 4.2]) + np.log1p(s) + np.arcsin(s / 3)
    np.testing.assert_allclose(value[:, 0], wanted, rtol=1e-14)
    lines = np.select([s < 0.1, s < 0.9, s < 1], [5.0, 0.5, 3.0])
    right = lines + 1 / (1 + s) + 1 / np.sqrt(9 - s**2)
    np.testing.assert_allclose(slope[:, 0, 0], right, rtol=1e-13)
