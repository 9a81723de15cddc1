"""The residuals of the test functions of Moré, Garbow and Hillstrom, in the paper's order.

Each takes the parameters x, a sequence of n arrays (trials, 1), and returns the residuals f_i(x), an array (trials, m).
All are analytic, so that a complex step through them gives the exact Jacobian. Numbers as printed in Moré, Garbow,
Hillstrom, Testing unconstrained optimization software, ACM Transactions on Mathematical Software 7(1), 1981.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

Unknowns = Sequence[Any]
Residuals = Callable[[Unknowns], Any]


def _side_by_side(*f: Any) -> Any:
    """Residuals (trials, 1) as one array (trials, m)."""
    return np.concatenate(f, axis=1)


def rosenbrock(x: Unknowns) -> Any:
    return _side_by_side(10.0 * (x[1] - x[0] ** 2), 1.0 - x[0])


def freudenstein_roth(x: Unknowns) -> Any:
    first = -13.0 + x[0] + ((5.0 - x[1]) * x[1] - 2.0) * x[1]
    return _side_by_side(first, -29.0 + x[0] + ((x[1] + 1.0) * x[1] - 14.0) * x[1])


def powell_badly_scaled(x: Unknowns) -> Any:
    return _side_by_side(1e4 * x[0] * x[1] - 1.0, np.exp(-x[0]) + np.exp(-x[1]) - 1.0001)


def brown_badly_scaled(x: Unknowns) -> Any:
    return _side_by_side(x[0] - 1e6, x[1] - 2e-6, x[0] * x[1] - 2.0)


def beale(x: Unknowns) -> Any:
    y = (1.5, 2.25, 2.625)
    return _side_by_side(*(y[i] - x[0] * (1.0 - x[1] ** (i + 1)) for i in range(3)))


def jennrich_sampson(x: Unknowns) -> Any:
    i = np.arange(1.0, 11.0)
    return 2.0 + 2.0 * i - (np.exp(i * x[0]) + np.exp(i * x[1]))


def helical_valley(x: Unknowns) -> Any:
    turns = np.arctan(x[1] / x[0]) / (2.0 * np.pi) + 0.5 * (np.real(x[0]) < 0)
    return _side_by_side(10.0 * (x[2] - 10.0 * turns), 10.0 * (np.sqrt(x[0] ** 2 + x[1] ** 2) - 1.0), x[2])


_BARD = np.array([0.14, 0.18, 0.22, 0.25, 0.29, 0.32, 0.35, 0.39, 0.37, 0.58, 0.73, 0.96, 1.34, 2.10, 4.39])


def bard(x: Unknowns) -> Any:
    u = np.arange(1.0, 16.0)
    v = 16.0 - u
    return _BARD - (x[0] + u / (v * x[1] + np.minimum(u, v) * x[2]))


_GAUSSIAN = np.array([
    0.0009, 0.0044, 0.0175, 0.0540, 0.1295, 0.2420, 0.3521, 0.3989, 0.3521, 0.2420, 0.1295, 0.0540, 0.0175, 0.0044,
    0.0009,
])  # fmt: skip


def gaussian(x: Unknowns) -> Any:
    t = (8.0 - np.arange(1.0, 16.0)) / 2.0
    return x[0] * np.exp(-x[1] * (t - x[2]) ** 2 / 2.0) - _GAUSSIAN


_MEYER = np.array([
    34780, 28610, 23650, 19630, 16370, 13720, 11540, 9744, 8261, 7030, 6005, 5147, 4427, 3820, 3307, 2872,
], dtype=float)  # fmt: skip


def meyer(x: Unknowns) -> Any:
    t = 45.0 + 5.0 * np.arange(1.0, 17.0)
    return x[0] * np.exp(x[1] / (t + x[2])) - _MEYER


def gulf(x: Unknowns) -> Any:
    # The paper prints "y_i m i x_2" where the source of the problem has a minus sign. The absolute value is written as
    # the root of a square, which is analytic wherever it is not zero.
    t = np.arange(1.0, 100.0) / 100.0
    y = 25.0 + (-50.0 * np.log(t)) ** (2.0 / 3.0)
    return np.exp(-(((y - x[1]) ** 2) ** (x[2] / 2.0)) / x[0]) - t


def box_3d(x: Unknowns) -> Any:
    t = np.arange(1.0, 11.0) / 10.0
    return np.exp(-t * x[0]) - np.exp(-t * x[1]) - x[2] * (np.exp(-t) - np.exp(-10.0 * t))


def powell_singular(x: Unknowns) -> Any:
    return _side_by_side(
        x[0] + 10.0 * x[1],
        np.sqrt(5.0) * (x[2] - x[3]),
        (x[1] - 2.0 * x[2]) ** 2,
        np.sqrt(10.0) * (x[0] - x[3]) ** 2,
    )


def wood(x: Unknowns) -> Any:
    return _side_by_side(
        10.0 * (x[1] - x[0] ** 2),
        1.0 - x[0],
        np.sqrt(90.0) * (x[3] - x[2] ** 2),
        1.0 - x[2],
        np.sqrt(10.0) * (x[1] + x[3] - 2.0),
        (x[1] - x[3]) / np.sqrt(10.0),
    )


_KOWALIK_Y = np.array([0.1957, 0.1947, 0.1735, 0.1600, 0.0844, 0.0627, 0.0456, 0.0342, 0.0323, 0.0235, 0.0246])
_KOWALIK_U = np.array([4.0, 2.0, 1.0, 0.5, 0.25, 0.167, 0.125, 0.1, 0.0833, 0.0714, 0.0625])


def kowalik_osborne(x: Unknowns) -> Any:
    u = _KOWALIK_U
    return _KOWALIK_Y - x[0] * (u**2 + u * x[1]) / (u**2 + u * x[2] + x[3])


def brown_dennis(x: Unknowns) -> Any:
    t = np.arange(1.0, 21.0) / 5.0
    return (x[0] + t * x[1] - np.exp(t)) ** 2 + (x[2] + x[3] * np.sin(t) - np.cos(t)) ** 2


_OSBORNE_1 = np.array([
    0.844, 0.908, 0.932, 0.936, 0.925, 0.908, 0.881, 0.850, 0.818, 0.784, 0.751, 0.718, 0.685, 0.658, 0.628, 0.603,
    0.580, 0.558, 0.538, 0.522, 0.506, 0.490, 0.478, 0.467, 0.457, 0.448, 0.438, 0.431, 0.424, 0.420, 0.414, 0.411,
    0.406,
])  # fmt: skip


def osborne_1(x: Unknowns) -> Any:
    t = 10.0 * np.arange(33.0)
    return _OSBORNE_1 - (x[0] + x[1] * np.exp(-t * x[3]) + x[2] * np.exp(-t * x[4]))


def biggs_exp6(x: Unknowns) -> Any:
    t = np.arange(1.0, 14.0) / 10.0
    y = np.exp(-t) - 5.0 * np.exp(-10.0 * t) + 3.0 * np.exp(-4.0 * t)
    return x[2] * np.exp(-t * x[0]) - x[3] * np.exp(-t * x[1]) + x[5] * np.exp(-t * x[4]) - y


_OSBORNE_2 = np.array([
    1.366, 1.191, 1.112, 1.013, 0.991, 0.885, 0.831, 0.847, 0.786, 0.725, 0.746, 0.679, 0.608, 0.655, 0.616, 0.606,
    0.602, 0.626, 0.651, 0.724, 0.649, 0.649, 0.694, 0.644, 0.624, 0.661, 0.612, 0.558, 0.533, 0.495, 0.500, 0.423,
    0.395, 0.375, 0.372, 0.391, 0.396, 0.405, 0.428, 0.429, 0.523, 0.562, 0.607, 0.653, 0.672, 0.708, 0.633, 0.668,
    0.645, 0.632, 0.591, 0.559, 0.597, 0.625, 0.739, 0.710, 0.729, 0.720, 0.636, 0.581, 0.428, 0.292, 0.162, 0.098,
    0.054,
])  # fmt: skip


def osborne_2(x: Unknowns) -> Any:
    t = np.arange(65.0) / 10.0
    peaks = sum(x[k] * np.exp(-((t - x[k + 7]) ** 2) * x[k + 4]) for k in (1, 2, 3))
    return _OSBORNE_2 - (x[0] * np.exp(-t * x[4]) + peaks)


def watson(x: Unknowns) -> Any:
    t = np.arange(1.0, 30.0) / 29.0
    value, slope = 0.0, 0.0
    for coefficient in reversed(x):
        slope = slope * t + value
        value = value * t + coefficient
    return _side_by_side(slope - value**2 - 1.0, x[0], x[1] - x[0] ** 2 - 1.0)


def trigonometric(x: Unknowns) -> Any:
    n = len(x)
    cosines = [np.cos(a) for a in x]
    total = sum(cosines)
    return _side_by_side(*(n - total + (i + 1.0) * (1.0 - cosines[i]) - np.sin(x[i]) for i in range(n)))


def brown_almost_linear(x: Unknowns) -> Any:
    n = len(x)
    total, product = sum(x), x[0]
    for a in x[1:]:
        product = product * a
    return _side_by_side(*(a + total - (n + 1.0) for a in x[:-1]), product - 1.0)


def chebyquad(x: Unknowns) -> Any:
    n = len(x)
    before, value = [1.0] * n, [2.0 * a - 1.0 for a in x]
    f = []
    for i in range(1, n + 1):
        integral = 0.0 if i % 2 else -1.0 / (i**2 - 1.0)
        f.append(sum(value) / n - integral)
        following = [2.0 * (2.0 * a - 1.0) * v - b for a, v, b in zip(x, value, before, strict=True)]
        before, value = value, following
    return _side_by_side(*f)
