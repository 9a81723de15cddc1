"""Nonlinear least-squares problems with known minima as measurement models: Moré, Garbow and Hillstrom's functions.

`score` judges estimates, `formulas` holds the functions, `problems` their starts and minima.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np

from ipe_bench.basics.linalg import Array, Covariance
from ipe_bench.basics.options import Positive
from ipe_bench.measurements.base import Measurement, Parameter, Recorded
from ipe_bench.measurements.mgh.problems import PROBLEMS, Minimum, Problem

# fmt: off
Function = Literal[
    "rosenbrock", "freudenstein_roth", "powell_badly_scaled", "brown_badly_scaled", "beale", "jennrich_sampson",
    "helical_valley", "bard", "gaussian", "meyer", "gulf", "box_3d", "powell_singular", "wood",
    "kowalik_osborne", "brown_dennis", "osborne_1", "biggs_exp6", "osborne_2", "watson", "trigonometric",
    "brown_almost_linear", "chebyquad",
]
# fmt: on
"""The names in `functions()`: as a type, for who reads types alone, such as a shell that completes a word."""
_ZERO_RESIDUAL_DEVIATION = 1e-3


def functions() -> tuple[Function, ...]:
    """The names of the 23 functions in the paper's order."""
    return get_args(Function)


@dataclass(frozen=True)
class Mgh(Measurement):
    """One test function of Moré, Garbow and Hillstrom, to be started at a multiple of its standard start.

    The readings are h(x) = f(x), the residuals of the problem, and what is observed are zeros: the least-squares
    estimate minimises the sum of f_i(x)^2. There is no order of arrival, no unit and no prior. Source: Moré, Garbow,
    Hillstrom, Testing unconstrained optimization software, ACM Transactions on Mathematical Software 7(1), 1981.

    23 of its 35 functions are here: all of fixed dimension (1 to 19), and of variable dimension those of the paper's
    list of nonlinear least-squares problems (Watson's with n = 6, Brown's almost linear with 10, Chebyquad with 8) and
    the trigonometric one (10), known for its local minimum. Left out: the linear ones (32 to 34), repetitions of
    Rosenbrock's and Powell's (21, 22), penalty functions, which are sums of squares by construction only (23 to 25),
    and discretised or banded square systems (28 to 31). Dimensions are those for which the paper states minima.

    Eight functions have as many residuals as parameters (m = n): they can be solved, but there no fit can be tested.
    At the least minimum of jennrich_sampson, powell_singular and chebyquad J has not full rank.

    Each parameter's size is its magnitude at the start, and 1 where it starts at zero, so x0 consists of ones, minus
    ones and zeros. Watson's standard start is zero throughout: other multiples of it start at (start, ..., start), as
    in the test drivers of MINPACK.
    """

    function: Function = "kowalik_osborne"
    """A name as in `functions()`, such as rosenbrock."""
    start: Positive = 1.0
    """The multiple of the standard start; the paper uses 1, 10 and 100."""

    analytic = True

    @property
    def _problem(self) -> Problem:
        return PROBLEMS[self.function]

    @cached_property
    def start_values(self) -> Array:
        """The starting point (n,)."""
        standard = np.array(self._problem.start)
        if not standard.any() and self.start != 1.0:
            return np.full_like(standard, self.start)
        return self.start * standard

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(Parameter(f"x{i + 1}", size=float(abs(a)) or 1.0) for i, a in enumerate(self.start_values))

    @property
    def nominal(self) -> Array:
        return np.sign(self.start_values)

    @property
    def index(self) -> Mapping[str, Sequence[Any]]:
        return {"residual": list(range(1, self._problem.m + 1))}

    @property
    def minima(self) -> tuple[Minimum, ...]:
        """The known minima of the sum of squares, the lowest first."""
        return self._problem.minima

    def simulate(self, x: Array) -> Array:
        with np.errstate(all="ignore"):
            return self._problem.residuals(list((x * self.sizes).T[:, :, None]))

    @property
    def recorded(self) -> Recorded:
        """Zeros, with the lowest minimum's place, and R for independent readings.

        Their standard deviation is sqrt(f* / (m - n)) with f* the least sum of squares (m - n counted as 1 where it is
        0), and 1e-3 where f* is 0. It moves no least-squares estimate: it only says what a small gradient is.
        """
        least = self.minima[0]
        assert least.x is not None
        variance = least.sum_of_squares / max(self.m - self.n, 1)
        deviation = math.sqrt(variance) if variance > 0 else _ZERO_RESIDUAL_DEVIATION
        return Recorded(np.zeros(self.m), Covariance(np.full(self.m, deviation)), np.array(least.x) / self.sizes)
