"""The least-squares test functions of Moré, Garbow and Hillstrom as measurement models, and which
minimum is attained.

Functions and numbers are those printed in Moré, Garbow, Hillstrom, Testing unconstrained
optimization software, ACM Transactions on Mathematical Software 7(1), 1981. Minima agree with the
paper to its six digits; their further digits, and the minima that it does not list, come from
Newton's method on the gradient in double precision.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ipe_bench.basics.errors import UserError, unknown
from ipe_bench.basics.linalg import Array, Covariance
from ipe_bench.basics.options import Positive
from ipe_bench.measurements.base import Measurement, Parameter, Recorded

_INF = math.inf
_TEN = np.arange(1.0, 11.0)
_ALPHA = 0.9794303033498624
"""The root beside 1 of 10 a^10 - 11 a^9 + 1."""
_RELATIVE, _ABSOLUTE = 1e-6, 1e-12
"""A minimum f* is attained by f <= f* (1 + 1e-6) + 1e-12; the smallest minimum that is not zero is
1.1e-8."""
_ZERO_RESIDUAL_DEVIATION = 1e-3

Unknowns = Sequence[Any]
"""The parameters x, n arrays (trials, 1)."""


@dataclass(frozen=True)
class Minimum:
    """A minimum of the sum of squares, or its infimum along a direction in which parameters grow
    without limit."""

    sum_of_squares: float
    x: tuple[float, ...] | None = None
    """Where: one minimiser of those that symmetry makes equal. None: not at one place."""


@dataclass(frozen=True)
class Problem:
    """One function with its standard start (n,), and its known minima, the lowest first."""

    residuals: Callable[[Unknowns], Any]
    start: tuple[float, ...]
    minima: tuple[Minimum, ...]


def _problem(
    residuals: Callable[[Unknowns], Any], start: tuple[float, ...], *minima: tuple[Any, ...]
) -> Problem:
    """A problem by a function that returns the residuals (trials, m) and is analytic."""
    return Problem(residuals, start, tuple(Minimum(*one) for one in minima))


def _side_by_side(*f: Any) -> Any:
    """Residuals (trials, 1) as one array (trials, m)."""
    return np.concatenate(f, axis=1)


def _helical_valley(x: Unknowns) -> Any:
    turns = np.arctan(x[1] / x[0]) / (2.0 * np.pi) + 0.5 * (np.real(x[0]) < 0)
    return _side_by_side(
        10.0 * (x[2] - 10.0 * turns), 10.0 * (np.sqrt(x[0] ** 2 + x[1] ** 2) - 1.0), x[2]
    )


def _bard(x: Unknowns) -> Any:
    y = np.array(
        [0.14, 0.18, 0.22, 0.25, 0.29, 0.32, 0.35, 0.39, 0.37, 0.58, 0.73, 0.96, 1.34, 2.10, 4.39]
    )
    u = np.arange(1.0, 16.0)
    v = 16.0 - u
    return y - (x[0] + u / (v * x[1] + np.minimum(u, v) * x[2]))


def _gaussian(x: Unknowns) -> Any:
    rising = [0.0009, 0.0044, 0.0175, 0.0540, 0.1295, 0.2420, 0.3521]
    t = (8.0 - np.arange(1.0, 16.0)) / 2.0
    return x[0] * np.exp(-x[1] * (t - x[2]) ** 2 / 2.0) - np.array(
        [*rising, 0.3989, *reversed(rising)]
    )


def _meyer(x: Unknowns) -> Any:
    y = [
        34780,
        28610,
        23650,
        19630,
        16370,
        13720,
        11540,
        9744,
        8261,
        7030,
        6005,
        5147,
        4427,
        3820,
        3307,
        2872,
    ]
    t = 45.0 + 5.0 * np.arange(1.0, 17.0)
    return x[0] * np.exp(x[1] / (t + x[2])) - np.array(y, dtype=float)


def _gulf(x: Unknowns) -> Any:
    # The paper prints "y_i m i x_2" where the source of the problem has a minus sign. The absolute
    # value is written as the root of a square, which is analytic wherever it is not zero.
    t = np.arange(1.0, 100.0) / 100.0
    y = 25.0 + (-50.0 * np.log(t)) ** (2.0 / 3.0)
    return np.exp(-(((y - x[1]) ** 2) ** (x[2] / 2.0)) / x[0]) - t


def _box_3d(x: Unknowns) -> Any:
    t = np.arange(1.0, 11.0) / 10.0
    return np.exp(-t * x[0]) - np.exp(-t * x[1]) - x[2] * (np.exp(-t) - np.exp(-10.0 * t))


def _wood(x: Unknowns) -> Any:
    first = 10.0 * (x[1] - x[0] ** 2), 1.0 - x[0], np.sqrt(90.0) * (x[3] - x[2] ** 2), 1.0 - x[2]
    return _side_by_side(*first, np.sqrt(10.0) * (x[1] + x[3] - 2.0), (x[1] - x[3]) / np.sqrt(10.0))


def _kowalik_osborne(x: Unknowns) -> Any:
    y = np.array(
        [0.1957, 0.1947, 0.1735, 0.1600, 0.0844, 0.0627, 0.0456, 0.0342, 0.0323, 0.0235, 0.0246]
    )
    u = np.array([4.0, 2.0, 1.0, 0.5, 0.25, 0.167, 0.125, 0.1, 0.0833, 0.0714, 0.0625])
    return y - x[0] * (u**2 + u * x[1]) / (u**2 + u * x[2] + x[3])


def _brown_dennis(x: Unknowns) -> Any:
    t = np.arange(1.0, 21.0) / 5.0
    return (x[0] + t * x[1] - np.exp(t)) ** 2 + (x[2] + x[3] * np.sin(t) - np.cos(t)) ** 2


_OSBORNE_1 = np.array([
    0.844, 0.908, 0.932, 0.936, 0.925, 0.908, 0.881, 0.850, 0.818, 0.784, 0.751, 0.718, 0.685,
    0.658, 0.628, 0.603,
    0.580, 0.558, 0.538, 0.522, 0.506, 0.490, 0.478, 0.467, 0.457, 0.448, 0.438, 0.431, 0.424,
    0.420, 0.414, 0.411,
    0.406,
])  # fmt: skip


def _osborne_1(x: Unknowns) -> Any:
    t = 10.0 * np.arange(33.0)
    return _OSBORNE_1 - (x[0] + x[1] * np.exp(-t * x[3]) + x[2] * np.exp(-t * x[4]))


def _biggs_exp6(x: Unknowns) -> Any:
    t = np.arange(1.0, 14.0) / 10.0
    y = np.exp(-t) - 5.0 * np.exp(-10.0 * t) + 3.0 * np.exp(-4.0 * t)
    return x[2] * np.exp(-t * x[0]) - x[3] * np.exp(-t * x[1]) + x[5] * np.exp(-t * x[4]) - y


_OSBORNE_2 = np.array([
    1.366, 1.191, 1.112, 1.013, 0.991, 0.885, 0.831, 0.847, 0.786, 0.725, 0.746, 0.679, 0.608,
    0.655, 0.616, 0.606,
    0.602, 0.626, 0.651, 0.724, 0.649, 0.649, 0.694, 0.644, 0.624, 0.661, 0.612, 0.558, 0.533,
    0.495, 0.500, 0.423,
    0.395, 0.375, 0.372, 0.391, 0.396, 0.405, 0.428, 0.429, 0.523, 0.562, 0.607, 0.653, 0.672,
    0.708, 0.633, 0.668,
    0.645, 0.632, 0.591, 0.559, 0.597, 0.625, 0.739, 0.710, 0.729, 0.720, 0.636, 0.581, 0.428,
    0.292, 0.162, 0.098,
    0.054,
])  # fmt: skip


def _osborne_2(x: Unknowns) -> Any:
    t = np.arange(65.0) / 10.0
    peaks = sum(x[k] * np.exp(-((t - x[k + 7]) ** 2) * x[k + 4]) for k in (1, 2, 3))
    return _OSBORNE_2 - (x[0] * np.exp(-t * x[4]) + peaks)


def _watson(x: Unknowns) -> Any:
    t = np.arange(1.0, 30.0) / 29.0
    value, slope = 0.0, 0.0
    for coefficient in reversed(x):
        slope = slope * t + value
        value = value * t + coefficient
    return _side_by_side(slope - value**2 - 1.0, x[0], x[1] - x[0] ** 2 - 1.0)


def _trigonometric(x: Unknowns) -> Any:
    n, cosines = len(x), [np.cos(a) for a in x]
    total = sum(cosines)
    return _side_by_side(
        *(n - total + (i + 1.0) * (1.0 - cosines[i]) - np.sin(x[i]) for i in range(n))
    )


def _brown_almost_linear(x: Unknowns) -> Any:
    total = sum(x)
    return _side_by_side(
        *(a + total - (len(x) + 1.0) for a in x[:-1]), math.prod(x[1:], start=x[0]) - 1.0
    )


def _chebyquad(x: Unknowns) -> Any:
    n, f = len(x), []
    before, value = [1.0] * n, [2.0 * a - 1.0 for a in x]
    for i in range(1, n + 1):
        f.append(sum(value) / n - (0.0 if i % 2 else -1.0 / (i**2 - 1.0)))
        following = [
            2.0 * (2.0 * a - 1.0) * v - b for a, v, b in zip(x, value, before, strict=True)
        ]
        before, value = value, following
    return _side_by_side(*f)


# fmt: off
PROBLEMS: dict[str, Problem] = {
    "rosenbrock": _problem(
        lambda x: _side_by_side(10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]), (-1.2, 1.0),
        (0.0, (1.0, 1.0))),
    "freudenstein_roth": _problem(
        lambda x: _side_by_side(-13.0 + x[0] + ((5.0 - x[1]) * x[1] - 2.0) * x[1],
                                -29.0 + x[0] + ((x[1] + 1.0) * x[1] - 14.0) * x[1]),
        (0.5, -2.0), (0.0, (5.0, 4.0)),
        (48.98425367924, ((53.0 - 4.0 * math.sqrt(22.0)) / 3.0, (2.0 - math.sqrt(22.0)) / 3.0))),
    "powell_badly_scaled": _problem(
        lambda x: _side_by_side(1e4 * x[0] * x[1] - 1.0, np.exp(-x[0]) + np.exp(-x[1]) - 1.0001),
        (0.0, 1.0), (0.0, (1.0981593296997557e-05, 9.106146739867036))),
    "brown_badly_scaled": _problem(
        lambda x: _side_by_side(x[0] - 1e6, x[1] - 2e-6, x[0] * x[1] - 2.0), (1.0, 1.0),
        (0.0, (1e6, 2e-6))),
    "beale": _problem(
        lambda x: _side_by_side(*(y - x[0] * (1.0 - x[1] ** i) for i,
                                  y in enumerate((1.5, 2.25, 2.625), 1))),
        (1.0, 1.0), (0.0, (3.0, 0.5)),
        (0.4520089285714,)),  # x1 to minus infinity with x1 (1 - x2) = 111/112
    "jennrich_sampson": _problem(
        lambda x: 2.0 + 2.0 * _TEN - (np.exp(_TEN * x[0]) + np.exp(_TEN * x[1])),
        (0.3, 0.4), (124.362182355615, (0.2578252136703641, 0.2578252136703641)),
        (259.580190134253, (-_INF, 0.331485278480789))),
    "helical_valley": _problem(_helical_valley, (-1.0, 0.0, 0.0), (0.0, (1.0, 0.0, 0.0))),
    "bard": _problem(
        _bard, (1.0, 1.0, 1.0), (8.21487730657898e-3,
                                 (0.08241055974978898, 1.1330360920297224, 2.3436951786425366)),
        (17.4286933333333, (0.8406666666666667, -_INF, -_INF))),
    "gaussian": _problem(
        _gaussian, (0.4, 1.0, 0.0), (1.12793276962e-8,
                                     (0.3989561378387575, 1.0000190844878132, 0.0))),
    "meyer": _problem(
        _meyer, (0.02, 4000.0, 250.0), (87.9458551707,
            (0.005609636471028544, 6181.3463462863, 345.2236346241341))),
    "gulf": _problem(_gulf, (5.0, 2.5, 0.15), (0.0, (50.0, 25.0, 1.5))),
    "box_3d": _problem(
        _box_3d, (0.0, 10.0, 20.0),
        (0.0, (1.0, 10.0, 1.0)),  # as well at (10, 1, -1), and wherever x1 = x2 and x3 = 0
        (0.075588740755, (0.6136003545073, _INF, 1.3199552081726))),
    "powell_singular": _problem(
        lambda x: _side_by_side(x[0] + 10.0 * x[1], np.sqrt(5.0) * (x[2] - x[3]),
                                (x[1] - 2.0 * x[2]) ** 2,
                                np.sqrt(10.0) * (x[0] - x[3]) ** 2),
        (3.0, -1.0, 0.0, 1.0), (0.0, (0.0,) * 4)),
    "wood": _problem(_wood, (-3.0, -1.0, -3.0, -1.0), (0.0, (1.0,) * 4)),
    "kowalik_osborne": _problem(
        _kowalik_osborne, (0.25, 0.39, 0.415, 0.39),
        (3.07505603849238e-4, (0.19280693457903791, 0.1912823287343663, 0.12305650692632084,
                               0.1360623306837945)),
        (1.02734304869547e-3, (_INF, -14.0758819895, -_INF, -_INF))),
    "brown_dennis": _problem(
        _brown_dennis, (25.0, 5.0, -5.0, -1.0),
        (85822.2016263563, (-11.594439904762162, 13.203630051207202, -0.40343948817685954,
                            0.23677877445573628))),
    "osborne_1": _problem(
        _osborne_1, (0.5, 1.5, -1.0, 0.01, 0.02),
        (5.46489469748e-5, (0.3754100521076023, 1.935846912788271, -1.464687136689818,
                            0.012867534640211172,
                            0.022122699661365396))),
    "biggs_exp6": _problem(
        _biggs_exp6, (1.0, 2.0, 1.0, 1.0, 1.0, 1.0), (0.0, (1.0, 10.0, 1.0, 5.0, 4.0, 3.0)),
        # The paper lists it as a minimum; it is one among x with x1 = x5 and x3 = x6, and else a
        # saddle.
        (5.655649925499946e-3, (1.711415994719587, 17.68319818094906, 1.16314366091889,
                                5.18656155199345,
                                1.711415994719588, 1.163143660918888)),
        (0.306366611,)),  # x2 to infinity
    "osborne_2": _problem(
        _osborne_2, (1.3, 0.65, 0.65, 0.7, 0.6, 3.0, 5.0, 7.0, 2.0, 4.5, 5.5),
        (4.01377362935478e-2, (1.3099771546273005, 0.431553794602989, 0.6336616989607241,
                               0.5994305347859163,
                               0.7541832263280114, 0.9042885798596336, 1.365811835237028,
                               4.823698817227157,
                               2.3986848661317546, 4.568874597667672, 5.6753414705806415)),
        (1.78981358688109,)),  # the exponential alone, with every peak outside the record
    "watson": _problem(
        _watson, (0.0,) * 6,
        (2.28767005355241e-3, (-0.015725086401458498, 1.0124348693691099, -0.23299162595673725,
                               1.2604300877996073,
                               -1.5137289227222785, 0.992996432431134))),
    "trigonometric": _problem(
        _trigonometric, (0.1,) * 10, (0.0, (0.0,) * 10),
        (2.79505612188e-5, (0.0551509039806912, 0.0568406167947384, 0.0587640017626948,
                            0.0609906086567606,
                            0.063626213695854, 0.0668431794527583, 0.208161518569882,
                            0.164363095885648,
                            0.0850068956885065, 0.091431450714708))),
    "brown_almost_linear": _problem(
        _brown_almost_linear, (0.5,) * 10,
        (0.0, (*(_ALPHA,) * 9, 1.2056969665013764)),  # as well at (1, ..., 1)
        (1.0, (*(0.0,) * 9, 11.0))),
    "chebyquad": _problem(
        _chebyquad, tuple(j / 9.0 for j in range(1, 9)),
        (3.51687372567793e-3, (0.04315276015101663, 0.1930908403841861, 0.26632870689027294, 0.5,
                               0.5,
                               0.7336712931097271, 0.8069091596158139, 0.9568472398489833))),
}
# fmt: on
"""The problems by name, in the paper's order."""


@dataclass(frozen=True)
class Mgh(Measurement):
    """One test function of Moré, Garbow and Hillstrom, to be started at a multiple of its standard
    start.

    The readings are h(x) = f(x), the residuals of the problem, and what is observed are zeros: the
    least-squares estimate minimises the sum of f_i(x)^2. There is no order of arrival, no unit and
    no prior.

    23 of the paper's 35 functions are here: all of fixed dimension (1 to 19), and of variable
    dimension those of its list of nonlinear least-squares problems (Watson's with n = 6, Brown's
    almost linear with 10, Chebyquad with 8) and the trigonometric one (10), known for its local
    minimum. Dimensions are those for which the paper states minima. Eight functions have as many
    residuals as parameters (m = n): they can be solved, but there no fit can be tested. At the
    least minimum of jennrich_sampson, powell_singular and chebyquad J has not full rank.

    Each parameter's size is its magnitude at the start, and 1 where it starts at zero, so x0
    consists of ones, minus ones and zeros. Watson's standard start is zero throughout: other
    multiples of it start at (start, ..., start), as in the test drivers of MINPACK.
    """

    function: str = "kowalik_osborne"
    """A key of `PROBLEMS`, such as rosenbrock."""
    start: Positive = 1.0
    """The multiple of the standard start; the paper uses 1, 10 and 100."""

    analytic = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.function not in PROBLEMS:
            raise UserError(
                f"function={self.function}: {unknown(self.function, PROBLEMS, 'function')}"
            )

    @cached_property
    def start_values(self) -> Array:
        """The starting point (n,)."""
        standard = np.array(PROBLEMS[self.function].start)
        return (
            self.start * standard
            if standard.any() or self.start == 1.0
            else np.full_like(standard, self.start)
        )

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(
            Parameter(f"x{i + 1}", size=float(abs(a)) or 1.0)
            for i, a in enumerate(self.start_values)
        )

    nominal = property(lambda model: np.sign(model.start_values))  # type: ignore[assignment]
    m = cached_property(lambda model: model.simulate(model.nominal[None]).shape[1])  # type: ignore[assignment]
    index = property(lambda model: {"residual": list(range(1, model.m + 1))})  # type: ignore[assignment]
    minima = property(lambda model: PROBLEMS[model.function].minima)
    """The known minima of the sum of squares, the lowest first."""

    def simulate(self, x: Array) -> Array:
        with np.errstate(all="ignore"):
            return PROBLEMS[self.function].residuals(list((x * self.sizes).T[:, :, None]))

    @property
    def recorded(self) -> Recorded:
        """Zeros, with the place of the lowest minimum f*, and R for independent readings of
        standard deviation sqrt(f* / (m - n)), m - n counted as 1 where it is 0, and 1e-3 where f*
        is 0: it only says what a small gradient is."""
        least = self.minima[0]
        assert least.x is not None
        variance = least.sum_of_squares / max(self.m - self.n, 1)
        deviation = math.sqrt(variance) if variance > 0 else _ZERO_RESIDUAL_DEVIATION
        return Recorded(
            np.zeros(self.m), Covariance(np.full(self.m, deviation)), np.array(least.x) / self.sizes
        )


@dataclass(frozen=True)
class Attained:
    """How low an estimate's sum of squares is."""

    sum_of_squares: float
    """At the estimate; infinite where it is not a number."""
    minimum: int | None
    """Which of the model's `minima` has this sum of squares, or a lower one than the least: 0;
    None: it is none."""

    solved = property(lambda attained: attained.minimum == 0)
    """Whether that is the least there is."""


def score(model: Mgh, x: Array) -> Attained:
    """Compares the sum of squares at an estimate x (n,), in multiples of sizes, with the known
    minima.

    The value decides and not the place: several functions have more than one minimiser, or a
    minimum so flat that its place says nothing.
    """
    with np.errstate(all="ignore"):
        f = model.simulate(np.asarray(x, dtype=float)[None])[0]
        value = float(f @ f)
    if not np.isfinite(value):
        return Attained(np.inf, None)
    above = [
        (value - one.sum_of_squares, _RELATIVE * one.sum_of_squares + _ABSOLUTE)
        for one in model.minima
    ]
    attained = (
        k for k, (d, tolerance) in enumerate(above) if (d if k == 0 else abs(d)) <= tolerance
    )
    return Attained(value, next(attained, None))
