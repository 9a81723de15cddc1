"""The relaxed iteration converges where theory says so, at the rate that theory says."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))

from ipe_bench_relaxed import RelaxedFixedPoint

from ipe_bench.basics.errors import UserError
from ipe_bench.solvers import FixedPoint, State


class Linear:
    """F(x) = (1 - g) x: plain iteration multiplies the error by g."""

    def __init__(self, g: float) -> None:
        self.g = g

    def F(self, x):
        return (1 - self.g) * x


def error_after(solver, g, steps):
    system = Linear(g)
    x = np.ones((1, 1))
    state = State(x, system.F(x))
    for _ in range(steps):
        state = solver.step(system, state)
    return abs(state.x[0, 0])


@pytest.mark.parametrize("g", [0.5, -0.9, -1.5])
def test_multiplies_the_error_by_one_minus_w_plus_w_g(g):
    w = 0.7
    assert error_after(RelaxedFixedPoint(w), g, 5) == pytest.approx(abs(1 - w + w * g) ** 5)


def test_converges_where_plain_iteration_diverges():
    assert error_after(FixedPoint(), -1.5, 20) > 1e3
    assert error_after(RelaxedFixedPoint(0.7), -1.5, 20) < 1e-2


def test_refuses_a_factor_outside_zero_to_two():
    with pytest.raises(UserError, match="relaxation=2"):
        RelaxedFixedPoint(2.0)
