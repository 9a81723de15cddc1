# ruff: noqa
# pyright: basic, reportOptionalMemberAccess=false
"""Eighty functions (rows, 2) -> (rows, m) in many styles, each beside its reference in mpmath."""

import math
import numpy as np

try:
    import mpmath as mp  # of which truths.json was made: python tests/functions/truths.py
except ImportError:
    from types import SimpleNamespace

    mp = SimpleNamespace(mpf=())
S = lambda *a: np.stack(a, axis=-1)
CASES = {}


def case(ref, mean=(0.5, 0.1), sd=(1.0, 1.0), states=None):
    def add(f):
        CASES[f.__name__] = (f, ref, np.array(mean, float), np.array(sd, float), states)
        return f

    return add


sgn = lambda a: mp.sign(a)
clip = lambda a, lo, hi: min(max(a, lo), hi)
sinc = lambda a: mp.sin(a) / a if a != 0 else mp.mpf(1)
relu = lambda a: max(a, mp.mpf(0))


@case(lambda a, b: [a + b, b - 0.3 * b * abs(b)], (0, 0), (1, 0.005))
def ship(x):
    return S(x[..., 0] + x[..., 1], x[..., 1] - 0.3 * x[..., 1] * np.abs(x[..., 1]))


@case(lambda a, b: [sinc(a), b], (0, 0), (0.1, 1))
def asarray_eq(x):
    x = np.asarray(x)
    w = x[..., 0]
    return S(np.where(w == 0, 1.0, np.sin(w) / np.where(w == 0, 1, w)), x[..., 1])


@case(lambda a, b: [sinc(a), b], (0, 0), (0.1, 1))
def array_eq(x):
    x = np.array(x)
    w = x[..., 0]
    return S(np.where(w == 0, 1.0, np.sin(w) / np.where(w == 0, 1, w)), x[..., 1])


@case(lambda a, b: [sinc(a), b], (0, 0), (0.1, 1))
def where_eq(x):
    w = x[..., 0]
    return S(np.where(w == 0, 1.0, np.sin(w) / np.where(w == 0, 1, w)), x[..., 1])


@case(lambda a, b: [(1 - mp.cos(a)) / a if a else mp.mpf(0), b], (0, 0), (0.1, 1))
def removable(x):
    w = x[..., 0]
    d = np.where(w == 0, 1, w)
    return S(np.where(w == 0, 0.0, (1 - np.cos(d)) / d), x[..., 1])


@case(lambda a, b: [sinc(a), b], (0, 0), (0.1, 1))
def any_eq(x):
    x = np.asarray(x)
    w = x[..., 0]
    if np.any(w == 0):
        w = np.where(w == 0, 1e-9, w)
    return S(np.sin(w) / w, x[..., 1])


@case(lambda a, b: [sinc(a), b], (0, 0), (0.1, 1))
def scalar_eq(x):
    out = np.empty_like(x)
    for i in np.ndindex(x.shape[:-1]):
        a, b = x[i]
        out[i] = [1.0 if a == 0 else np.sin(a) / a, b]
    return out


@case(lambda a, b: [sinc(mp.pi * a), b])
def np_sinc(x):
    return S(np.sinc(x[..., 0]), x[..., 1])


@case(lambda a, b: [mp.mpf(5) if a in (0, 1) else mp.mpf(2), b], (0, 0))
def isin(x):
    return S(np.where(np.isin(np.asarray(x)[..., 0], [0.0, 1.0]), 5.0, 2.0), x[..., 1])


@case(lambda a, b: [3 * a if a in (0, 1) else a, b])
def member(x):
    return np.array([[3 * a if a in (0.0, 1.0) else a, b] for a, b in x.reshape(-1, 2)]).reshape(
        x.shape
    )


@case(lambda a, b: [a + 1, b])
def dict_get(x):
    return np.array([[a + {7.0: 3.0}.get(a, 1.0), b] for a, b in x.reshape(-1, 2)]).reshape(x.shape)


@case(lambda a, b: [relu(a), relu(b)])
def try_except(x):
    try:
        if np.any(x < 0):
            x = np.where(x < 0, 0.0, x)
    except TypeError:
        pass
    return x + 0.0


@case(lambda a, b: [relu(a), relu(b)])
def bare_except(x):
    try:
        if np.any(x < 0):
            x = np.where(x < 0, 0.0, x)
    except:
        pass
    return x + 0.0


@case(
    lambda a, b: [sum(c * a**i for i, c in enumerate((1.0, -2.0, 0.5, 0.3))), b], (0, 0), (0.5, 1)
)
def horner0(x):
    return S(sum(c * x[..., 0] ** i for i, c in enumerate((1.0, -2.0, 0.5, 0.3))), x[..., 1])


@case(lambda a, b: [mp.mpf(1), b**3])
def pow0(x):
    return S(x[..., 0] ** 0, np.power(x[..., 1], 3))


@case(lambda a, b: [a * (1 - int(a > 0.2 or b > 0.4)), b])
def bool_add(x):
    t = (x[..., 0] > 0.2) + (x[..., 1] > 0.4)
    return S(x[..., 0] * (1 - t), x[..., 1])


@case(lambda a, b: [a * (1 - int(a > 0.2 or b > 0.4)), b])
def bool_or(x):
    t = (x[..., 0] > 0.2) | (x[..., 1] > 0.4)
    return S(x[..., 0] * (1 - t), x[..., 1])


@case(lambda a, b: [a * (int(a > 0.2) + int(b > 0.4)), b])
def bool_sum(x):
    return S(x[..., 0] * np.sum([x[..., 0] > 0.2, x[..., 1] > 0.4], axis=0), x[..., 1])


@case(lambda a, b: [a * int(a > 0.2 and b > 0.4), b])
def bool_mul(x):
    return S(x[..., 0] * ((x[..., 0] > 0.2) * (x[..., 1] > 0.4)), x[..., 1])


@case(lambda a, b: [a if not a > 0.2 else 2 * a - 0.2, b])
def invert(x):
    return S(np.where(~(x[..., 0] > 0.2), x[..., 0], 2 * x[..., 0] - 0.2), x[..., 1])


@case(lambda a, b: [a - 0.12 * mp.sqrt(a) if a > 0 else a, b], (0.6, 0), (0.3, 1))
def nan_to_num(x):
    with np.errstate(all="ignore"):
        return S(x[..., 0] - 0.12 * np.nan_to_num(np.sqrt(x[..., 0])), x[..., 1])


@case(lambda a, b: [a - 0.12 * mp.sqrt(a) if a > 0 else a, b], (0.6, 0), (0.3, 1))
def nan_asarray(x):
    x = np.asarray(x)
    with np.errstate(all="ignore"):
        return S(x[..., 0] - 0.12 * np.nan_to_num(np.sqrt(x[..., 0])), x[..., 1])


@case(lambda a, b: [mp.sqrt(a) if a > 0 else mp.mpf(0), b], (0.6, 0))
def nan_neq(x):
    with np.errstate(all="ignore"):
        r = np.sqrt(x[..., 0])
    return S(np.where(r != r, 0.0, r), x[..., 1])


@case(lambda a, b: [a + 1, b + 1])
def is_float(x):
    return x + 1 if isinstance(x.flat[0], float) else x


@case(lambda a, b: [a + 1, b + 1])
def dtype_float(x):
    return x + 1 if x.dtype == float else x


@case(lambda a, b: [a - 0.1 * mp.floor(a / 0.1), b])
def mod_tenth(x):
    return S(x[..., 0] % 0.1, x[..., 1])


@case(lambda a, b: [(a + mp.pi) - 2 * mp.pi * mp.floor((a + mp.pi) / (2 * mp.pi)) - mp.pi, b])
def wrap(x):
    return S(np.mod(x[..., 0] + np.pi, 2 * np.pi) - np.pi, x[..., 1])


@case(lambda a, b: [a - (0.1 if a >= 0 else 0.3 * abs(a)) * a, b], (2, 0), (0.1, 1))
def branch_far(x):
    return np.array(
        [[a - (0.1 * a if a >= 0 else 0.3 * a * abs(a)), b] for a, b in x.reshape(-1, 2)]
    ).reshape(x.shape)


@case(lambda a, b: [a - 0.3 * a * abs(a) if a < 0 else a - 0.1 * a, b], (2, 0), (0.1, 1))
def branch_far_where(x):
    v = x[..., 0]
    return S(np.where(v >= 0, v - 0.1 * v, v - 0.3 * v * np.abs(v)), x[..., 1])


@case(lambda a, b: [clip(a, -1, 1), clip(b, -1, 1)])
def clip_(x):
    return np.clip(x, -1, 1)


@case(lambda a, b: [clip(a, 0, 1) ** 2, b])
def interp(x):
    return S(np.interp(x[..., 0], [0, 1], [0, 1]) ** 2, x[..., 1])


@case(lambda a, b: [relu(a), relu(b)])
def fmax(x):
    return np.fmax(x, 0)


@case(lambda a, b: [mp.floor(a), mp.floor(b)])
def floor_(x):
    return np.floor(x)


@case(lambda a, b: [mp.sqrt(a * a + b * b), mp.atan2(b, a)], (1.5, 0.3), (0.3, 0.3))
def norm_atan(x):
    return S(np.linalg.norm(x, axis=-1), np.arctan2(x[..., 1], x[..., 0]))


@case(lambda a, b: [mp.hypot(a, b), b], (1.5, 0.3), (0.3, 0.3))
def hypot(x):
    return S(np.hypot(x[..., 0], x[..., 1]), x[..., 1])


@case(lambda a, b: [relu(a), relu(b)])
def mask_write(x):
    out = x + 0.0
    out[out < 0] = 0
    return out


@case(lambda a, b: [relu(a), relu(b)])
def where_write(x):
    out = x + 0.0
    out[np.where(x < 0)] = 0
    return out


@case(lambda a, b: [relu(a), relu(b)])
def mask_mul(x):
    return x * (x > 0)


@case(lambda a, b: [a if a else mp.mpf(1), b])
def truth_of(x):
    return np.array([[a or 1.0, b] for a, b in x.reshape(-1, 2)]).reshape(x.shape)


@case(lambda a, b: [a, a + b])
def cumsum(x):
    return np.cumsum(x, axis=-1)


@case(lambda a, b: [a + 2 * b, 3 * a + 4 * b])
def einsum(x):
    return np.einsum("ij,...j->...i", np.array([[1, 2], [3, 4.0]]), x)


@case(lambda a, b: [a + 2 * b, 3 * a + 4 * b])
def matmul(x):
    return x @ np.array([[1, 2], [3, 4.0]]).T


@case(lambda a, b: [mp.mpf(1 if a < 0 else 2 if a < 1 else 3) * b, b])
def searchsorted(x):
    return S(
        np.array([1.0, 2.0, 3.0])[np.searchsorted([0, 1], x[..., 0], side="right")] * x[..., 1],
        x[..., 1],
    )


@case(lambda a, b: [max(a, b), min(a, b)])
def max_min(x):
    return S(np.max(x, axis=-1), np.min(x, axis=-1))


@case(lambda a, b: [min(a, b), max(a, b)])
def sort(x):
    return np.sort(x, axis=-1)


@case(lambda a, b: [(a - b) ** 2 / 4, abs(a - b) / 2])
def var_std(x):
    return S(np.var(x, axis=-1), np.std(x, axis=-1))


@case(lambda a, b: [mp.cbrt(a) if a >= 0 else -mp.cbrt(-a), b])
def cbrt(x):
    return S(np.cbrt(x[..., 0]), x[..., 1])


@case(lambda a, b: [relu(a), b])
def vectorize(x):
    return S(np.vectorize(lambda a: 0.0 if a < 0 else a)(x[..., 0]), x[..., 1])


@case(lambda a, b: [relu(a), b])
def python_max(x):
    return S(np.array([max(a, 0.0) for a in x[..., 0].ravel()]).reshape(x.shape[:-1]), x[..., 1])


@case(lambda a, b: [a * a + 2 * a + 3, b**3 - 3 * b])
def polyval(x):
    return S(np.polyval([1.0, 2, 3], x[..., 0]), np.polyval(np.array([1.0, 0, -3, 0]), x[..., 1]))


@case(lambda a, b: [b, 2 * a])
def out_write(x):
    out = np.zeros_like(x)
    out[..., 0] = x[..., 1]
    np.multiply(x[..., 0], 2, out=out[..., 1])
    return out


@case(lambda a, b: [a + 1, b * (a + 1)])
def in_place(x):
    x = x.copy()
    x[..., 0] += 1
    x[..., 1] *= x[..., 0]
    return x


@case(lambda a, b: [mp.log1p(mp.exp(a)), mp.log1p(mp.exp(b))])
def softplus(x):
    return np.log1p(np.exp(x))


@case(lambda a, b: [2 * a, 2 * b])
def lists(x):
    return [[float(a) * 2 for a in row] for row in x.reshape(-1, 2)]


@case(lambda a, b: [abs(a) ** b, mp.mpf(2) ** a])
def pow_x(x):
    return S(np.abs(x[..., 0]) ** x[..., 1], 2.0 ** x[..., 0])


@case(lambda a, b: [a + (1 if a == 0 and b == 0 else 0), b])
def allclose_row(x):
    return np.array(
        [[a + (1.0 if np.allclose([a, b], 0) else 0.0), b] for a, b in x.reshape(-1, 2)]
    ).reshape(x.shape)


@case(lambda a, b: [a / mp.sqrt(a * a + b * b), b / mp.sqrt(a * a + b * b)], (1, 0.2), (0.2, 0.2))
def normed(x):
    return x / np.sqrt(np.sum(x * x, axis=-1, keepdims=True))


@case(lambda a, b: [a - 0.3 * mp.floor(a / 0.3), b - 0.3 * mp.floor(b / 0.3)])
def divmod_(x):
    return divmod(x, 0.3)[1]


@case(lambda a, b: [mp.re(mp.exp(1j * a)), b])
def complex_re(x):
    return S(np.real(np.exp(1j * x[..., 0])), x[..., 1])


@case(lambda a, b: [mp.atan2(b, a), b], (1, 0.2), (0.2, 0.2))
def angle(x):
    return S(np.angle(x[..., 0] + 1j * x[..., 1]), x[..., 1])


@case(lambda a, b: [a * a, b])
def conj_sq(x):
    return S(np.abs(x[..., 0]) ** 2, x[..., 1])


@case(lambda a, b: [a * a + b * b, b])
def vdot(x):
    return S(np.array([np.vdot(r, r) for r in x.reshape(-1, 2)]).reshape(x.shape[:-1]), x[..., 1])


@case(lambda a, b: [mp.sin(a) if a > 0 else a, b])
def math_scalar(x):
    return np.array([[math.sin(a) if a > 0 else a, b] for a, b in x.reshape(-1, 2)]).reshape(
        x.shape
    )


@case(lambda a, b: [mp.sign(a) * mp.sqrt(abs(a)), b])
def sign_sqrt(x):
    return S(np.sign(x[..., 0]) * np.sqrt(np.abs(x[..., 0])), x[..., 1])


@case(lambda a, b: [a * mp.exp(-abs(a)), mp.tanh(20 * b)])
def stiff_tanh(x):
    return S(x[..., 0] * np.exp(-np.abs(x[..., 0])), np.tanh(20 * x[..., 1]))


@case(
    lambda a, b: [mp.sqrt((a - 500020) ** 2 + (b - 5400020) ** 2)],
    (500013, 5400011),
    (5, 5),
    [(500013, 5400011), (500019, 5400025), (500000.5, 5400001.0), (500040.0, 5399990)],
)
def utm(x):
    return np.sqrt((x[..., 0] - 500020.0) ** 2 + (x[..., 1] - 5400020.0) ** 2)[..., None]


@case(
    lambda a, b: [mp.sqrt((a - 500020) ** 2 + (b - 5400020) ** 2)],
    (500013, 5400011),
    (5, 5),
    [(500013, 5400011), (500019, 5400025), (500000.5, 5400001.0), (500040.0, 5399990)],
)
def utm_math(x):
    return np.array([[math.hypot(e - 500020.0, n - 5400020.0)] for e, n in x.reshape(-1, 2)])


def _km(a, b, la=37.41, lo=-121.96):
    r = mp.pi / 180
    la, lo = mp.mpf(la), mp.mpf(lo)
    h = (
        mp.sin((a - la) * r / 2) ** 2
        + mp.cos(a * r) * mp.cos(la * r) * mp.sin((b - lo) * r / 2) ** 2
    )
    return [2 * mp.mpf(6371) * mp.asin(mp.sqrt(h))]


@case(
    _km,
    (37.418, -121.961),
    (1e-3, 1e-3),
    [(37.418, -121.961), (37.4191, -121.9606), (37.42, -121.95)],
)
def lat_lon(x):
    la, lo = np.radians(x[..., 0]), np.radians(x[..., 1])
    h = (
        np.sin((la - np.radians(37.41)) / 2) ** 2
        + np.cos(la) * np.cos(np.radians(37.41)) * np.sin((lo + np.radians(121.96)) / 2) ** 2
    )
    return (2 * 6371.0 * np.arcsin(np.sqrt(h)))[..., None]


@case(
    lambda a, b: [1 - mp.mpf("0.01") * mp.exp(-mp.mpf(".5") * ((2455000.45 - a) / b) ** 2)],
    (2455000.43, 0.03),
    (0.01, 0.003),
    [(2455000.43, 0.03), (2455000.44, 0.028), (2455000.40, 0.04)],
)
def julian(x):
    return (1 - 0.01 * np.exp(-0.5 * ((2455000.45 - x[..., 0]) / x[..., 1]) ** 2))[..., None]


@case(lambda a, b: [a + mp.sin(b) * 10, b + mp.mpf(".1")], (0, 0), (1, 0.5))
def turn(x):
    out = np.empty_like(x)
    out[..., 0] = x[..., 0] + 10 * np.sin(x[..., 1])
    out[..., 1] = x[..., 1] + 0.1
    return out


@case(lambda a, b: [a - 0.5 * b * abs(b) if abs(b) > mp.mpf(".05") else a, b], (0, 0), (1, 0.5))
def dead_zone(x):
    return S(
        np.where(
            np.abs(x[..., 1]) > 0.05, x[..., 0] - 0.5 * x[..., 1] * np.abs(x[..., 1]), x[..., 0]
        ),
        x[..., 1],
    )


@case(lambda a, b: [mp.log(a * a + 1), b])
def while_loop(x):
    y = x[..., 0] * 0 + 1.0
    t = x[..., 0] ** 2 + 1
    for _ in range(60):
        y = y - 1 + t * np.exp(-y)
    return S(y, x[..., 1])


@case(lambda a, b: [a + mp.mpf(0.1) * mp.sin(a), b])
def float32(x):
    return S(
        np.asarray(x[..., 0] + 0.1 * np.sin(x[..., 0]), dtype=np.float32).astype(float), x[..., 1]
    )


_K = {"drag": 0.3}


@case(lambda a, b: [a - 0.3 * a, b])
def dict_const(x):
    return S(x[..., 0] - _K["drag"] * x[..., 0], x[..., 1])


@case(lambda a, b: [mp.heaviside(a - 0.1) if hasattr(mp, "heaviside") else mp.mpf(int(a > 0.1)), b])
def heaviside(x):
    return S(np.heaviside(x[..., 0] - 0.1, 0.5), x[..., 1])


@case(lambda a, b: [abs(a) ** 3, abs(b)])
def abs_builtin(x):
    return S(abs(x[..., 0]) ** 3, abs(x[..., 1]))


@case(lambda a, b: [3 * a if a <= 0 else a * a if a < 1 else mp.mpf(1) * a, b])
def select(x):
    a = x[..., 0]
    return S(np.select([a <= 0, a < 1], [3 * a, a * a], a), x[..., 1])


@case(lambda a, b: [mp.exp(-a * a / 2) / mp.sqrt(2 * mp.pi), mp.ncdf(b)])
def norm_cdf(x):
    from scipy.stats import norm

    return S(norm.pdf(x[..., 0]), norm.cdf(x[..., 1]))


@case(lambda a, b: [mp.cos(a) * b, mp.sin(a) * b])
def rotation(x):
    c, s = np.cos(x[..., 0]), np.sin(x[..., 0])
    return np.array([c * x[..., 1], s * x[..., 1]]).T.reshape(x.shape)


@case(lambda a, b: [a * a - b, b])
def lru(x):
    return S(_cached(x[..., 0]), x[..., 1]) - S(x[..., 1], 0 * x[..., 1])


_memo = {}


def _cached(v):
    out = np.empty_like(v)
    for i in np.ndindex(v.shape):
        key = v[i]
        if key not in _memo:
            _memo[key] = key * key
        out[i] = _memo[key]
    return out
