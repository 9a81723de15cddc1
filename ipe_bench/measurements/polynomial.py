"""Defines a polynomial model with knobs for size and nonlinearity, for teaching and for tests."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial.chebyshev import chebvander

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Count, Finite
from ipe_bench.measurements.base import Epochs, Measurement, Parameter, UsualNoise, single_epochs


@dataclass(frozen=True)
class Polynomial(Measurement):
    """Computes h_k(x) = u_k + s u_k^2 / 2 + s^2 u_k^3 / 6 with u = H x: a linear model that a cubic
    bends.

    H holds Chebyshev polynomials T_0 ... T_(n-1) at m equally spaced times from -1 to 1, so it is
    well conditioned. At s = 0 the model is linear. The cubic is the Taylor polynomial of (exp(s u)
    - 1) / s; it grows monotonically, so one reading fixes one u, and N(x) = s u^2 / 2 + s^2 u^3 / 6
    in the words of eq. (24). Each reading is an epoch.

    Example, which `strength` 0 makes linear:

    >>> import numpy as np, ipe_bench as ib
    >>> J = ib.measurements.Polynomial(strength=0.0).jacobian(np.array([[0.0] * 4, [9.0] * 4]))
    >>> print(np.ptp(J, axis=0).max())
    0.0
    """

    unknowns: Count = 4
    """n, the number of parameters."""
    count: Count = 40
    """m, the number of readings."""
    strength: Finite = 0.005
    """s, by how much the readings bend per unit of x."""

    analytic = True
    usual_noise = UsualNoise(0.01)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.count <= self.unknowns:
            raise UserError(f"count={self.count}: give more readings than unknowns")

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(Parameter(f"c{i}", group="coefficients") for i in range(self.unknowns))

    @cached_property
    def times(self) -> Array:
        """Times of the readings (m,), at which the polynomials are evaluated."""
        return np.linspace(-1.0, 1.0, self.count)

    @cached_property
    def matrix(self) -> Array:
        """H (m, n)."""
        return chebvander(self.times, self.unknowns - 1)

    @property
    def index(self) -> dict[str, list[float]]:
        return {"time": self.times.tolist()}

    @cached_property
    def epochs(self) -> Epochs:
        return single_epochs(self)

    def simulate(self, x: Array) -> Array:
        u = np.einsum("kj,tj->tk", self.matrix, x)
        su = self.strength * u
        return u * (1.0 + su / 2.0 * (1.0 + su / 3.0))
