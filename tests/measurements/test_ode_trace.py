"""Recording of arithmetic: its program computes what was written, and its tangent is the derivative."""

import numpy as np
import pytest

from ipe_bench.measurements.ode.trace import Graph, Program, tangent

FUNCTIONS = {
    "add": lambda a, b: a + b + 2.0,
    "subtract": lambda a, b: 3.0 - a - b,
    "multiply": lambda a, b: 2.0 * a * b * a,
    "divide": lambda a, b: a / b + 1.5 / a,
    "negative": lambda a, b: -a + b,
    "square": lambda a, b: a**2 + b,
    "power": lambda a, b: a**3.7 + b**-2,
    "to a variable power": lambda a, b: a**b,
    "of a number to a variable power": lambda a, b: 2.0 ** (a * b),
    "root": lambda a, b: np.sqrt(a) * b**0.5,
    "sin": lambda a, b: np.sin(a * b),
    "cos": lambda a, b: np.cos(a - b),
    "tan": lambda a, b: np.tan(a / b / 2),
    "arctan": lambda a, b: np.arctan(a * b),
    "exp": lambda a, b: np.exp(-a) * b,
    "log": lambda a, b: np.log(a + b * b),
    "sinh": lambda a, b: np.sinh(a) + b,
    "cosh": lambda a, b: np.cosh(a * b),
    "tanh": lambda a, b: np.tanh(a - b),
    "shared terms": lambda a, b: (a + b) * (a + b) / (1.0 + (a + b) ** 2),
}


@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.parametrize("point", [(0.7, 1.3), (2.2, 0.4), (1.0, 1.0)])
def test_values_and_derivatives_agree_with_a_complex_step(name, point):
    function = FUNCTIONS[name]
    graph = Graph()
    a, b, da, db = (graph.input(n) for n in ("a", "b", "da", "db"))
    value = function(a, b)
    derivative = tangent([value], {a: da, b: db})
    direction = (0.3, -1.1)
    results = Program.of([value, *derivative], [a, b, da, db])([*point, *direction])
    stepped = function(*(p + 1e-100j * d for p, d in zip(point, direction, strict=True)))
    assert results[0] == pytest.approx(np.real(stepped), rel=1e-14)
    assert results[1] == pytest.approx(np.imag(stepped) / 1e-100, rel=1e-13, abs=1e-15)


def test_a_branch_on_an_unknown_value_is_refused_with_the_remedy():
    a = Graph().input("a")
    with pytest.raises(TypeError, match=r"without if"):
        _ = 1.0 if a > 0 else 0.0


def test_an_unsupported_function_is_refused_by_name():
    a = Graph().input("a")
    with pytest.raises(TypeError, match=r"floor"):
        np.floor(a)
