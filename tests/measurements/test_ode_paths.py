"""Every path that computes readings or slopes of differential equations, against closed forms and
SciPy."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.special import erf, erfc
from shared.by_numpy import by_numpy

from ipe_bench.engine.coarseness import tangent_contraction
from ipe_bench.engine.tableaus import DOP853
from ipe_bench.measurements import LotkaVolterra, Ode, OdeMeasurement, Parameter, SubsetModel
from ipe_bench.measurements.arithmetic import FUNCTIONS, PAIRS, SEVERAL
from ipe_bench.measurements.joint import Joint
from ipe_bench.measurements.known import ConstrainedModel, ParameterInfo

BATCHES = (1, 7, 8, 9, 64, 250)
TOLERANCE = 1e-8


@dataclass(frozen=True)
class Law:
    """Equations as functions and as formulas, with parameters p about 1 and one constant c; and
    their solution, where it has a closed form that takes complex p."""

    start: Callable[..., Sequence[Any]]
    rhs: Callable[..., Sequence[Any]]
    formulas: tuple[str, ...]
    initial: tuple[str, ...]
    solution: Callable[..., Sequence[Any]] | None = None
    parameters: int = 2
    spread: float = 0.3

    @property
    def takes_constant(self) -> bool:
        return "c" in "".join((*self.formulas, *self.initial)).replace("cos", "")


def scalar(rate: Any, formula: str, solution: Any, **more: Any) -> Law:
    """One state that starts at the second parameter."""
    return Law(lambda p, c: (p[1],), lambda t, y, p, c: (rate(t, y[0], p, c[0]),), (formula,),
               ("p1",),
               lambda t, p, c: (solution(t, *p, c[0]),), **more)  # fmt: skip


# fmt: off
LAWS = {
    "decay": scalar(lambda t, y, p, c: -p[0] * y, "-p0*a", lambda t, k, b, c: b * np.exp(-k * t)),
    "relaxation": scalar(lambda t, y, p, c: p[0] * (c - y), "p0*(c-a)",
                         lambda t, k, b, c: c + (b - c) * np.exp(-k * t)),
    "pulse": scalar(lambda t, y, p, c: p[0] * y * np.cos(t), "p0*a*cos(t)",
                    lambda t, k, b, c: b * np.exp(k * np.sin(t))),
    "logistic": scalar(lambda t, y, p, c: p[0] * y * (1.0 - y / 3.0), "p0*a*(1-a/3)",
                       lambda t, r, b, c: 3.0 / (1.0 + (3.0 / b - 1.0) * np.exp(-r * t))),
    "riccati": scalar(lambda t, y, p, c: -p[0] * y * y, "-p0*a**2", lambda t, k, b,
                      c: b / (1.0 + k * b * t)),
    "power": scalar(lambda t, y, p, c: -p[0] * y**1.5, "-p0*a**1.5",
                    lambda t, k, b, c: (b**-0.5 + 0.5 * k * t) ** -2.0),
    "quadrature": scalar(lambda t, y, p, c: p[0] / (1.0 + t) + c, "p0/(1+t)+c",
                         lambda t, k, b, c: b + k * np.log(1.0 + t) + c * t),
    "oscillator": Law(lambda p, c: (p[1], 0.0), lambda t, y, p, c: (y[1], -p[0] * p[0] * y[0]),
                      ("b", "-p0^2*a"), ("p1", "0"),
                      lambda t, p, c: (p[1] * np.cos(p[0] * t), -p[1] * p[0] * np.sin(p[0] * t))),
    "chain": Law(lambda p, c: (p[2], c[0]), lambda t, y, p,
                 c: (-p[0] * y[0], p[0] * y[0] - (2.0 + p[1]) * y[1]),
                 ("-p0*a", "p0*a-(2+p1)*b"), ("p2", "c"),
                 lambda t, p, c: (p[2] * np.exp(-p[0] * t),
                                  p[0] * p[2] / (2.0 + p[1] - p[0])
                                  * (np.exp(-p[0] * t) - np.exp(-(2.0 + p[1]) * t))
                                  + c[0] * np.exp(-(2.0 + p[1]) * t)),
                 parameters=3, spread=0.2),
    "predators": Law(lambda p, c: (2.0, p[2]),
                     lambda t, y, p, c: (p[0] * y[0] - y[0] * y[1],
                                         p[1] * y[0] * y[1] - c[0] * y[1]),
                     ("p0*a-a*b", "p1*a*b-c*b"), ("2", "p2"), parameters=3),
    "pendulum": Law(lambda p, c: (p[1], 0.0), lambda t, y, p,
                    c: (y[1], -4.0 * p[0] * np.sin(y[0]) - c[0] * y[1]),
                    ("b", "-4*p0*sin(a)-c*b"), ("p1", "0")),
    "driven": Law(lambda p, c: (1.0, p[1]),
                  lambda t, y, p,
                  c: (y[1], p[0] * (1.0 - y[0] * y[0]) * y[1] - y[0] + c[0] * np.tanh(t)),
                  ("b", "p0*(1-a^2)*b-a+c*tanh(t)"), ("1", "p1")),
}
# fmt: on


@dataclass(frozen=True)
class Written(OdeMeasurement):
    """One of the laws as a class."""

    law: str
    at: tuple[float, ...]
    given: tuple[float, ...]
    step: float | None = None
    tolerance = TOLERANCE
    time_unit = ""

    @property
    def _law(self) -> Law:
        return LAWS[self.law]

    @property
    def states(self):  # type: ignore[override]
        return len(self._law.formulas)

    @property
    def outputs(self):  # type: ignore[override]
        return ("a", "b")[: self.states]

    @property
    def parameters(self):
        return tuple(Parameter(f"p{i}") for i in range(self._law.parameters))

    @property
    def nominal(self):
        return np.ones(self.n)

    @cached_property
    def times(self):
        return np.array(self.at)

    @cached_property
    def cases(self):
        return np.array(self.given)[:, None]

    def start(self, p, c):
        return self._law.start(p, c)

    def rhs(self, t, y, p, c):
        return self._law.rhs(t, y, p, c)

    def read(self, t, y, p, c):
        return y

    def exact(self, p):
        """Readings (m,) in the order case, time, output; complex where p is."""
        if self._law.solution is not None:
            z = [self._law.solution(t, p, (c,)) for c in self.given for t in self.at]
            return np.array(z).ravel()
        return np.concatenate([self._by_scipy(p, c) for c in self.given])

    def _by_scipy(self, p, c):
        start, later = self._law.start(p, (c,)), np.unique([t for t in self.at if t > 0.0])
        found = dict.fromkeys([0.0], np.array(start, dtype=float))
        if len(later):
            span, exactly = (0.0, later[-1]), {"rtol": 1e-12, "atol": 1e-13}
            y = solve_ivp(
                lambda t, y: self._law.rhs(t, y, p, (c,)), span, start, "DOP853", later, **exactly
            ).y
            found |= dict(zip(later.tolist(), y.T, strict=True))
        return np.concatenate([found[t] for t in self.at])

    def exact_slope(self, p):
        """dh/dp (m, n) by complex steps of a closed form, else by differences of fourth order."""
        if self._law.solution is not None:
            return np.stack(
                [self.exact(p + 1e-100j * e).imag / 1e-100 for e in np.eye(self.n)], axis=1
            )
        weights, h = {1: 8.0, -1: -8.0, 2: -1.0, -2: 1.0}, 2e-3
        slopes = [
            sum(w * self.exact(p + k * h * e) for k, w in weights.items()) / (12 * h)
            for e in np.eye(self.n)
        ]
        return np.stack(slopes, axis=1)


gaps = st.sampled_from([0.0, 0.0, 1e-12, 1e-6, 1e-3, 0.1, 0.25, 0.5, 1.0, 4.0]) | st.floats(
    0.01, 2.0
)
draws = st.fixed_dictionaries(
    {
        "law": st.sampled_from(sorted(LAWS)),
        "gaps": st.lists(gaps, min_size=1, max_size=6),
        "given": st.lists(st.sampled_from([0.5, 1.0, 1.5]), min_size=1, max_size=3),
        "batch": st.sampled_from(BATCHES),
        "seed": st.integers(0, 2**31),
    }
)


def same(a, b):
    np.testing.assert_array_equal(a, b)


def check(law, gaps, given, batch, seed):
    """All that is said of one model at one set of times."""
    model = Written(law, tuple(np.cumsum(gaps).tolist()), tuple(given))
    x = 1.0 + LAWS[law].spread * np.random.default_rng(seed).uniform(-1.0, 1.0, (batch, model.n))
    z, J = model.simulate(x), model.jacobian(x)

    # The equations are solved.
    exact, slope = model.exact(x[-1]), model.exact_slope(x[-1])
    assert np.abs(z[-1] - exact).max() < TOLERANCE * max(1.0, np.abs(exact).max())
    assert np.abs(J[-1] - slope).max() < 1e-6 * max(1.0, np.abs(slope).max())

    # Nothing hangs on what was computed before, or beside it.
    model.simulate(0.9 * x[: batch // 2 + 1]), model.jacobian(1.1 * x[: batch // 3 + 1])
    fresh = Written(law, model.at, model.given)
    same(fresh.jacobian(x), J), same(fresh.simulate(x), z)
    same(model.simulate(x), z), same(model.jacobian(x), J)
    for i in {0, batch // 2, batch - 1}:
        same(model.simulate(x[i : i + 1])[0], z[i]), same(fresh.jacobian(x[i : i + 1])[0], J[i])
    same(model.simulate(x[::-1]), z[::-1])

    # A window has the readings of the whole, and so have some of its readings, and several files
    # together.
    for stop in {1, (len(gaps) + 1) // 2, len(gaps)}:
        rows = model.rows(stop)
        (
            same(model.simulate_until(x, stop), z[:, rows]),
            same(model.jacobian_until(x, stop), J[:, rows]),
        )
        same(SubsetModel.until(model, stop).simulate(x), z[:, rows])
        near = SubsetModel.until(model, stop, coarse=True)
        assert np.abs(near.simulate(x) - z[:, rows]).max() < 10 * TOLERANCE * max(
            1.0, np.abs(z).max()
        )
    kept = tuple(range(seed % 2, model.m, 2)) or (0,)
    (
        same(SubsetModel(model, kept).simulate(x), z[:, kept]),
        same(SubsetModel(model, kept).jacobian(x), J[:, kept]),
    )
    other = Written(law, (0.0, 0.5), model.given)
    both = Joint((model, other))
    same(both.simulate(x), np.concatenate([z, other.simulate(x)], axis=1))
    same(both.jacobian(x), np.concatenate([J, other.jacobian(x)], axis=1))

    # Tangents with longer steps are tangents too, where there is enough to be told apart.
    coarse = model.coarse_jacobian(x)[-1]
    if model.m >= model.n and np.linalg.cond(slope) < 1e3:
        assert tangent_contraction(coarse, J[-1]) < 0.05

    # A fixed step, the same equations as formulas, other coordinates: the same readings.
    longest = max([*gaps, 1e-3])
    fixed = Written(law, model.at, model.given, step=longest / 64)
    assert np.abs(fixed.simulate(x)[-1] - exact).max() < 10 * TOLERANCE * max(
        1.0, np.abs(exact).max()
    )
    positive = ConstrainedModel(model, (ParameterInfo("p0", positive=True),))
    inner = positive.inner(x)
    np.testing.assert_allclose(
        positive.simulate(inner), z, rtol=0, atol=TOLERANCE * max(1.0, np.abs(z).max())
    )
    ascending = all(gap > 0.0 for gap in gaps[1:])
    if ascending:
        states = ("a", "b")[: model.states]
        described = Ode(
            dict(zip(states, LAWS[law].formulas, strict=True)),
            {f"p{i}": 1.0 for i in range(model.n)},
            dict(zip(states, LAWS[law].initial, strict=True)),
            times=model.at,
            tolerance=TOLERANCE,
            constants={"c": model.given} if LAWS[law].takes_constant else {},
        )
        found = described.simulate(x)[-1]
        whole = exact[: len(found)]  # one case alone where there is nothing that tells cases apart
        assert np.abs(found - whole).max() < TOLERANCE * max(1.0, np.abs(exact).max())


@pytest.mark.slow
@settings(max_examples=30, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(draws)
def test_every_path_solves_the_equations_with_the_same_bits(draw):
    check(**draw)


@pytest.mark.campaign
@settings(max_examples=2000, deadline=None, suppress_health_check=list(HealthCheck))
@given(draws)
def test_every_path_solves_the_equations_with_the_same_bits_in_many_draws(draw):
    check(**draw)


# fmt: off
OPERATIONS = {
    "+": lambda a, b: a + b, "-": lambda a, b: a - b, "*": lambda a, b: a * b, "over": lambda a,
    b: a / (2.0 + b * b),
    "power": lambda a, b: (1.0 + a * a) ** 1.5 - b, "root": lambda a,
    b: np.sqrt(1.0 + a * a) - b**2,
    "sin": lambda a, b: np.sin(a) - b, "cos": lambda a, b: np.cos(a + b), "exp": lambda a,
    b: np.exp(np.tanh(a)) * b,
    "log": lambda a, b: np.log(3.0 + np.sin(a)) + b, "arctan": lambda a, b: np.arctan(a) * b,
    "hyperbolic": lambda a, b: np.sinh(np.sin(a)) - np.cosh(np.cos(b)),
    "tan": lambda a, b: np.tan(np.sin(a) / 2.0) - b, "hypot": lambda a,
    b: SEVERAL["hypot"](a, 2.0 + np.sin(b)),
    "arctan2": lambda a, b: PAIRS["arctan2"](a, np.sin(b) + 1.5),
}
# fmt: on
PIECES = {
    "least": lambda a, b: np.minimum(a, b),
    "most": lambda a, b: np.maximum(a, b),
    "size": lambda a, b: np.where(np.less(a, 0.0), -a, a) - b,
    "root of what is positive": lambda a, b: (
        np.where(np.less_equal(a, 0.0), 0.0 * b, a * np.sqrt(a)) + b
    ),
    "sign": lambda a, b: FUNCTIONS["sign"](a) * (a - b) * a,
    "erf": lambda a, b: erf(a) * b,
    "erfc": lambda a, b: erfc(b) - a,
}
"""Continuous, in pieces; NumPy orders complex numbers by their real parts."""


def built(operations):
    """Expressions of these operations on the arguments of a right-hand side."""
    return st.recursive(
        st.sampled_from(["t", "y0", "y1", "p0", "p1", "p2", "c0"])
        | st.sampled_from([0.0, 1.0, -1.0, 0.5, 3.0]),
        lambda inner: st.tuples(st.sampled_from(operations), inner, inner),
        max_leaves=8,
    )


def value(expression, t, y, p, c):
    if isinstance(expression, tuple):
        name, a, b = expression
        return (OPERATIONS | PIECES)[name](value(a, t, y, p, c), value(b, t, y, p, c))
    if isinstance(expression, float):
        return expression
    return t if expression == "t" else {"y": y, "p": p, "c": c}[expression[0]][int(expression[1])]


@dataclass(frozen=True)
class Drawn(OdeMeasurement):
    """Two states whose rates are bounded, and two outputs, all drawn."""

    rates: tuple[Any, Any]
    shown: tuple[Any, Any]
    at: tuple[float, ...]
    step: float | None = 0.25
    tolerance = TOLERANCE
    states, outputs = 2, ("u", "v")
    parameters = tuple(Parameter(f"p{i}", size=0.5) for i in range(3))  # type: ignore[assignment]
    cases = np.array([[0.5], [-1.0]])  # type: ignore[assignment]

    @cached_property
    def times(self):
        return np.array(self.at)

    def start(self, p, c):
        return p[2], c[0]

    def rhs(self, t, y, p, c):
        return [np.tanh(value(rate, t, y, p, c)) + 0.0 * y[0] for rate in self.rates]

    def read(self, t, y, p, c):
        return [np.arctan(value(shown, t, y, p, c)) + y[0] for shown in self.shown]

    def slowly(self, x):
        """Readings (m,) for one x that may be complex: a plain loop over intervals, steps and
        stages."""
        p, z = list(x * self.sizes), []
        for c in self.cases:
            t, y = 0.0, np.array(self.start(p, c)) + 0.0 * p[0]
            for to in self.at:
                count = int(np.ceil((to - t) / self.step - 1e-9)) or 1
                h = (to - t) / count
                for s in range(count if to > t else 0):
                    k = []
                    for row, time in zip((*DOP853.A, DOP853.B), (*DOP853.C, 1.0), strict=True):
                        at = y + h * sum(
                            (a * kj for a, kj in zip(row, k, strict=False)), np.zeros(2)
                        )
                        k.append(np.array(self.rhs(t + s * h + time * h, at, p, c)))
                    y = at
                t = to
                z.extend(self.read(t, y, p, c))
        return np.array(z)


written = st.fixed_dictionaries(
    {
        "rates": st.tuples(*[built(sorted(OPERATIONS))] * 2),
        "shown": st.tuples(*[built(sorted(OPERATIONS) + 3 * sorted(PIECES))] * 2),
        "gaps": st.lists(st.sampled_from([0.0, 1e-9, 0.1, 0.25, 0.5]), min_size=2, max_size=3),
        "batch": st.sampled_from((1, 7, 8, 9)),
        "seed": st.integers(0, 2**31),
    }
)


@np.errstate(invalid="ignore")  # of branches that are not taken
def check_drawn(rates, shown, gaps, batch, seed):
    model = Drawn(rates, shown, tuple(np.cumsum(gaps).tolist()))
    x = np.random.default_rng(seed).uniform(-1.0, 1.0, (batch, 3))
    z, J = model.simulate(x), model.jacobian(x)
    size = max(1.0, np.abs(J[-1]).max())
    slopes = [model.slowly(x[-1] + 1e-100j * e).imag / 1e-100 for e in np.eye(3)]
    np.testing.assert_allclose(z[-1], model.slowly(x[-1]), rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(J[-1], np.stack(slopes, axis=1), rtol=1e-9, atol=1e-10 * size)
    with by_numpy():
        np.testing.assert_allclose(model.simulate(x), z, rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(model.jacobian(x), J, rtol=1e-9, atol=1e-10 * size)
    free = Drawn(rates, shown, model.at, step=None)
    assert (
        np.abs(free.simulate(x) - Drawn(rates, shown, model.at, step=1 / 64).simulate(x)).max()
        < 2 * TOLERANCE
    )
    (
        same(free.jacobian(x[:1])[0], free.jacobian(x)[0]),
        same(Drawn(rates, shown, model.at).simulate(x[::-1]), z[::-1]),
    )


@pytest.mark.slow
@settings(max_examples=4, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(written)
def test_equations_that_are_drawn_are_solved_as_a_plain_loop_solves_them(draw):
    check_drawn(**draw)


@pytest.mark.campaign
@settings(max_examples=150, deadline=None, suppress_health_check=list(HealthCheck))
@given(written)
def test_equations_that_are_drawn_are_solved_as_a_plain_loop_solves_them_in_many_draws(draw):
    check_drawn(**draw)


def test_a_reading_at_the_start_is_the_state_at_the_start():
    model = Ode({"y": "-k*y"}, {"k": 0.25, "y0": 2.0}, {"y": "y0"}, times=(0.0, 1.0, 2.0, 3.0))
    hares = LotkaVolterra(times=(0.0, 1.0, 2.0))
    for scale in (1.0, 3.0, 0.5, 1.0):
        x = np.array([[scale, 1.0], [1.0, scale]])
        t, k, y0 = np.arange(4.0), 0.25 * x[:, :1], 2.0 * x[:, 1:]
        np.testing.assert_allclose(model.simulate(x), y0 * np.exp(-k * t), atol=1e-7)
        slopes = np.stack([-0.25 * t * y0 * np.exp(-k * t), 2.0 * np.exp(-k * t)], axis=2)
        np.testing.assert_allclose(model.jacobian(x), slopes, atol=1e-6)
        start = hares.simulate(scale * hares.nominal[None])[0, :2]
        assert start == pytest.approx([34.0 * scale, 5.9 * scale], rel=1e-14)


@dataclass(frozen=True)
class Decay(OdeMeasurement):
    """Decay from 1 whose steps may be half of the interval between readings, and no shorter."""

    states, outputs = 1, ("amount",)
    tolerance, shortest_step = 1e-6, 0.2
    parameters = (Parameter("k", "1/s", 1.0),)
    nominal = np.array([1.0])
    times = np.arange(0.5, 3.0, 0.5)

    def start(self, p, c):
        return (1.0,)

    def rhs(self, t, y, p, c):
        return (-p[0] * y[0],)

    def read(self, t, y, p, c):
        return (y[0],)


def test_where_two_step_lengths_are_allowed_they_are_held_against_each_other():
    model = Decay()
    z = model.simulate(np.array([[1.0], [3.0], [60.0]]))
    np.testing.assert_allclose(z[0], np.exp(-model.times), rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(z[1], np.exp(-3.0 * model.times), rtol=0.0, atol=1e-6)
    # Steps of 0.25 s are unstable where k h = 15.
    assert np.isnan(z[2]).all()


@dataclass(frozen=True)
class Turning(OdeMeasurement):
    """A point on a circle, which turns at a stated rate."""

    states, outputs, reading_unit, tolerance = 2, ("x",), "", 1e-6
    parameters = (Parameter("omega", "1/s", 1.0),)
    nominal = np.array([1.0])
    times = np.arange(1.0, 6.0)

    def start(self, p: Sequence[Any], c: Sequence[Any]) -> Sequence[Any]:
        return 1.0, 0.0

    def rhs(self, t: Any, y: Sequence[Any], p: Sequence[Any], c: Sequence[Any]) -> Sequence[Any]:
        return p[0] * y[1], -p[0] * y[0]

    def read(self, t: Any, y: Sequence[Any], p: Sequence[Any], c: Sequence[Any]) -> Sequence[Any]:
        return (y[0],)

    def fastest_rate(self, p: Sequence[Any]) -> Any:
        return p[0]


def test_no_rate_is_too_fast_to_be_checked() -> None:
    """The shortest steps are 1/1024 s: they follow 600 rad/s, but not 2000."""
    z = Turning().simulate(np.array([[600.0], [1500.0], [2000.0], [3000.0]]))
    np.testing.assert_allclose(z[0], np.cos(600.0 * Turning.times), atol=2e-6)
    assert np.isnan(z[1:]).all()
