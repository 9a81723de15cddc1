# ruff: noqa
"""Forty functions of two entries that users might write, each beside its reference in mpmath.

Written before the recorder was seen. ``CASES[name] = (function of (rows, 2), reference of two numbers,
mean, deviations)``; values and slopes hold at `STATES` (where a slope exists).
"""

import math
from functools import lru_cache

try:
    import mpmath as mp  # of which truths.json was made: python tests/functions/truths.py
except ImportError:
    from types import SimpleNamespace

    mp = SimpleNamespace(mpf=())
import numpy as np

CASES = {}
STATES = [
    (0.7, -0.2),
    (1.2, 2.3),
    (-0.4, -0.9),
    (0.55, 0.5),
    (-2, -3),
    (0.3, 0.6),
    (0, 0),
    (0, 1),
    (1, 0),
]


def case(ref, mean=(0.5, 0.1), sd=(1.0, 1.0)):
    def add(f):
        CASES[f.__name__] = (f, ref, np.array(mean, float), np.array(sd, float))
        return f

    return add


def both(*columns):
    return np.stack(columns, axis=-1)


def by_row(f):
    def g(x):
        return np.array([f(a, b) for a, b in np.asarray(x).reshape(-1, 2)]).reshape(x.shape)

    return g


@case(lambda a, b: [a + mp.mpf("0.1") * (b - 9 * mp.tanh(50 * a)), b - 2 * a])
def tanh_friction(x):
    p, v = x[..., 0], x[..., 1]
    return both(p + 0.1 * (v - 9 * np.tanh(50 * p)), v - 2 * p)


@case(lambda a, b: [a * mp.exp(-abs(b)), b], (0, 0), (1, 0.1))
def exp_of_abs(x):
    return both(x[..., 0] * np.exp(-np.abs(x[..., 1])), x[..., 1])


@case(lambda a, b: [mp.sign(a) * mp.sqrt(abs(a)), b], (1, 0), (0.2, 1))
def signed_root(x):
    level = x[:, 0]
    return both(np.sign(level) * np.sqrt(np.abs(level)), x[:, 1])


@case(lambda a, b: [a if a > b else b * b, a * b])
def piece_by_where(x):
    a, b = np.moveaxis(x, -1, 0)
    return both(np.where(a > b, a, b**2), a * b)


@case(lambda a, b: [a**2 if b > 0 else a**3, b])
def branch_on_rows(x):
    out = np.empty(x.shape)
    for row, (a, b) in enumerate(x):
        if b > 0:
            out[row] = a**2, b
        else:
            out[row] = a**3, b
    return out


@case(lambda a, b: [mp.sin(a) * mp.cos(b), mp.sin(a) * mp.sin(b)])
def sphere_by_math(x):
    f = lambda a, b: (math.sin(a) * math.cos(b), math.sin(a) * math.sin(b))
    return np.array([f(*row) for row in x.tolist()])


@case(lambda a, b: [mp.log(1 + mp.exp(a)), b / (1 + mp.exp(-a))])
def softplus(x):
    return both(np.logaddexp(0.0, x[..., 0]), x[..., 1] / (1 + np.exp(-x[..., 0])))


@case(lambda a, b: [mp.log(1 + a * a), mp.exp(b) - 1])
def log1p_expm1(x):
    return both(np.log1p(x[..., 0] ** 2), np.expm1(x[..., 1]))


@case(lambda a, b: [a * (1 - a) if 0 < a < 1 else mp.mpf(0), b])
def logistic_inside(x):
    a = x[..., 0]
    inside = (0 < a) & (a < 1)
    return both(inside * a * (1 - a), x[..., 1])


@case(lambda a, b: [mp.mpf(3) * a if a <= 0.5 else mp.mpf(1.5) + (a - mp.mpf(0.5)) * 2, b])
def table_of_two_slopes(x):
    return both(np.interp(x[..., 0], [-10.0, 0.5, 10.5], [-30.0, 1.5, 21.5]), x[..., 1])


@case(lambda a, b: [mp.atan2(mp.sin(a - b), mp.cos(a - b)), b])
def wrapped_by_atan2(x):
    d = x[..., 0] - x[..., 1]
    return both(np.arctan2(np.sin(d), np.cos(d)), x[..., 1])


@case(lambda a, b: [(a - b) - 2 * mp.pi * mp.nint((a - b) / (2 * mp.pi)), b])
def wrapped_by_round(x):
    d = x[..., 0] - x[..., 1]
    return both(d - 2 * np.pi * np.round(d / (2 * np.pi)), x[..., 1])


@case(lambda a, b: [max(a, b, mp.mpf(0)), a + b])
def maximum_reduce(x):
    return both(np.maximum.reduce([x[..., 0], x[..., 1], 0 * x[..., 0]]), x.sum(axis=-1))


@case(lambda a, b: [a * a + b * b, a * b - b])
def by_dot(x):
    M = np.array([[0.0, 1.0], [0.0, 0.0]])
    return both(
        np.sum(x * x, axis=-1), np.einsum("...i,ij,...j->...", x, M, x) - x @ np.array([0.0, 1.0])
    )


@case(lambda a, b: [mp.cos(b) * a - mp.sin(b), mp.sin(b) * a + mp.cos(b)])
def rotated(x):
    c, s = np.cos(x[..., 1]), np.sin(x[..., 1])
    turn = np.array([[c, -s], [s, c]])
    arm = np.array([x[..., 0], np.ones_like(x[..., 0])])
    return np.einsum("ij...,j...->...i", turn, arm)


@case(lambda a, b: [a**3 - 2 * a + 5, b])
def by_polyval(x):
    return both(np.polyval([1.0, 0.0, -2.0, 5.0], x[..., 0]), x[..., 1])


@case(lambda a, b: [a**3 - 2 * a + 5, b])
def by_polynomial_class(x):
    return both(np.polynomial.Polynomial([5.0, -2.0, 0.0, 1.0])(x[..., 0]), x[..., 1])


def _midpoint(a, b, h):
    ka, kb = b, -mp.sin(a) if isinstance(a, mp.mpf) else -np.sin(a)
    ma, mb = a + h / 2 * ka, b + h / 2 * kb
    return a + h * mb, b - h * (mp.sin(ma) if isinstance(ma, mp.mpf) else np.sin(ma))


def _swing(a, b):
    for _ in range(5):
        a, b = _midpoint(a, b, mp.mpf(0.05))
    return [a, b]


@case(_swing)
def pendulum_of_substeps(x):
    a, b = x[..., 0], x[..., 1]
    for _ in range(5):
        a, b = _midpoint(a, b, 0.05)
    return both(a, b)


@case(lambda a, b: [a + b if a + b < 1 else mp.mpf(1), b])
def clipped_in_place(x):
    y = np.array(x, dtype=float)
    y[..., 0] += y[..., 1]
    y[y[..., 0] > 1, 0] = 1.0
    return y


@case(lambda a, b: [abs(a) ** mp.mpf("1.852") * mp.sign(a), b], (0.5, 0.1), (0.3, 1))
def head_loss(x):
    q = x[..., 0]
    return both(q * np.abs(q) ** 0.852, x[..., 1])


@case(lambda a, b: [a / (mp.mpf("0.5") + abs(a)), b])
def saturating(x):
    return both(x[..., 0] / (0.5 + abs(x[..., 0])), x[..., 1])


@case(lambda a, b: [mp.erf(a), b])
def scipy_erf(x):
    from scipy.special import erf

    return both(erf(x[..., 0]), x[..., 1])


@case(lambda a, b: [mp.gamma(2 + a * a), b])
def scipy_gamma(x):
    from scipy.special import gamma

    return both(gamma(2 + x[..., 0] ** 2), x[..., 1])


@case(lambda a, b: [mp.mpf(2) * a if a != 1 else mp.mpf(2), b])
def equal_but_alike(x):
    a = x[..., 0]
    return both(np.where(a == 1, 2.0, 2 * a), x[..., 1])


@case(lambda a, b: [(mp.exp(a) - 1) / a if a != 0 else mp.mpf(1), b], (0, 0), (0.1, 1))
def removable_by_isclose(x):
    a = x[..., 0]
    near = np.isclose(a, 0.0, rtol=0.0, atol=1e-12)
    return both(np.where(near, 1 + a / 2, np.expm1(a) / np.where(near, 1.0, a)), x[..., 1])


@case(lambda a, b: [mp.sqrt(a * a + b * b + mp.mpf("1e-8")), a], (0, 0), (1, 1))
def softened_norm(x):
    return both(np.sqrt((x**2).sum(-1) + 1e-8), x[..., 0])


@case(lambda a, b: [mp.re((a + 1j * b) ** 3), mp.im((a + 1j * b) ** 3)])
def by_complex_numbers(x):
    w = (x[..., 0] + 1j * x[..., 1]) ** 3
    return both(w.real, w.imag)


@case(lambda a, b: [a * b, a - b])
def by_dictionary(x):
    state = dict(zip(("gain", "offset"), np.moveaxis(x, -1, 0), strict=True))
    return both(state["gain"] * state["offset"], state["gain"] - state["offset"])


@case(lambda a, b: [2 * a if a >= 0 else a, b])
def leaky_by_select(x):
    a = x[..., 0]
    return both(np.select([a >= 0, a < 0], [2 * a, a], default=np.nan), x[..., 1])


@case(lambda a, b: [2 * a if a >= 0 else a, b])
def leaky_by_piecewise(x):
    a = np.asarray(x)[..., 0]
    return both(np.piecewise(a, [a >= 0], [lambda t: 2 * t, lambda t: t]), np.asarray(x)[..., 1])


@case(lambda a, b: [a * (1 if b >= 0 else 0), b])
def by_heaviside(x):
    return both(x[..., 0] * np.heaviside(x[..., 1], 1.0), x[..., 1])


@lru_cache(maxsize=None)
def _costly(a):
    return math.exp(-a * a)


@case(lambda a, b: [mp.exp(-a * a), b])
def by_cache(x):
    return by_row(lambda a, b: (_costly(float(a)), b))(x)


@case(lambda a, b: [mp.asin(mp.tanh(a)), mp.acos(mp.tanh(b))])
def arc_functions(x):
    return both(np.arcsin(np.tanh(x[..., 0])), np.arccos(np.tanh(x[..., 1])))


@case(lambda a, b: [a + 3 - mp.mpf(0.25) * b, b - 1], (0.5, 0.1), (1e-3, 1e3))
def unlike_sizes(x):
    return x @ np.array([[1.0, 0.0], [-0.25, 1.0]]) + np.array([3.0, -1.0])


@case(lambda a, b: [a if abs(a) > mp.mpf(0.35) else mp.mpf(0), b])
def dead_zone(x):
    a = x[..., 0].copy()
    a[np.abs(a) <= 0.35] = 0
    return both(a, x[..., 1])


@case(lambda a, b: [a**2 * (1 + b), b])
def by_vectorize(x):
    f = np.vectorize(lambda a, b: a * a * (1 + b))
    return both(f(x[..., 0], x[..., 1]), x[..., 1])


@case(lambda a, b: [mp.besselj(0, a), b])
def scipy_bessel(x):
    from scipy.special import j0

    return both(j0(np.asarray(x[..., 0], float)), x[..., 1])


@case(lambda a, b: [a + b * mp.log(1 + a * a) if b != 0 else a, b])
def not_b(x):
    out = []
    for a, b in x:
        if not b:
            out.append((a, b))
        else:
            out.append((a + b * np.log(1 + a**2), b))
    return np.array(out)


@case(lambda a, b: [max(min(a, mp.mpf(1)), mp.mpf(0)) * b, b])
def python_min_max(x):
    return by_row(lambda a, b: (max(min(a, 1.0), 0.0) * b, b))(x)


@case(lambda a, b: [mp.sqrt((a - 3) ** 2 + (b + 4) ** 2), mp.atan2(b + 4, a - 3)])
def range_and_bearing(x):
    d = x - np.array([3.0, -4.0])
    return both(np.linalg.norm(d, axis=-1), np.angle(d[..., 0] + 1j * d[..., 1]))
