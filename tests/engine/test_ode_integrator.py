"""The compiled integrator: coefficients, levels, and bits that depend on nothing but the trial."""

import doctest
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from scipy.integrate import DOP853
from shared.oracles import agreed, assert_agrees
from shared.slopes import differentiate

from ipe_bench.basics.errors import UserError
from ipe_bench.engine import tableaus
from ipe_bench.engine.coarseness import tangent_contraction
from ipe_bench.engine.integrator import threads
from ipe_bench.engine.trace import Graph
from ipe_bench.measurements import Ode, OdeMeasurement, Parameter


def test_a_number_of_threads_that_is_none_is_refused(monkeypatch):
    monkeypatch.setenv("IPE_BENCH_THREADS", "two")
    with pytest.raises(UserError, match="IPE_BENCH_THREADS=two: give a whole number"):
        threads()


@dataclass(frozen=True)
class Pulse(OdeMeasurement):
    """y' = a y cos t, y(0) = b, whose solution is b exp(a sin t)."""

    step: float | None = 1.0
    states, outputs = 1, ("y",)
    parameters = (Parameter("a", size=0.5), Parameter("b", size=2.0))

    @property
    def times(self):
        return np.array([0.5, 4.0, 6.0])

    def start(self, p, c):
        return (p[1],)

    def rhs(self, t, y, p, c):
        return (p[0] * y[0] * np.cos(t),)

    def read(self, t, y, p, c):
        return y


@dataclass(frozen=True)
class Cases(Pulse):
    """The same, with a factor to the rate and an amount to add, that differ between two cases; two
    outputs."""

    outputs = ("y", "rate")

    @property
    def cases(self):
        return np.array([[1.0, 0.0], [-2.0, 0.25]])

    def rhs(self, t, y, p, c):
        return (c[0] * p[0] * y[0] * np.cos(t) + c[1],)

    def read(self, t, y, p, c):
        return y[0], self.rhs(t, y, p, c)[0]


@pytest.mark.oracle("library: SciPy's DOP853", "coefficients of the Runge-Kutta method", 0.0)
def test_the_coefficients_are_those_of_scipy():
    for mine, theirs in ((tableaus.DOP853.B, DOP853.B[:12]), (tableaus.DOP853.C, DOP853.C[:12])):
        assert_agrees(mine, theirs)
    for s, row in enumerate(tableaus.DOP853.A):
        assert_agrees(row, DOP853.A[s, :s])


@pytest.mark.parametrize("cases", [1, 4, 5, 9])
def test_few_lanes_and_many_have_the_same_bits(cases):
    """Up to four lanes advance in half a vector."""

    class Several(Pulse):
        @property
        def cases(self):
            return np.zeros((cases, 0))

    x = np.random.default_rng(5).normal(size=(3, 2))
    for method in ("simulate", "jacobian"):
        whole = getattr(Several(0.7), method)(x)
        np.testing.assert_array_equal(
            np.split(whole, cases, axis=1), cases * [getattr(Pulse(0.7), method)(x)]
        )
        np.testing.assert_array_equal(whole[:1], getattr(Several(0.7), method)(x[:1]))


def test_a_trial_that_overflows_leaves_its_neighbours_alone():
    x = np.array([[1.0, 1.0], [1e4, 1.0], [1.0, 2.0]])
    z = Pulse(0.5).simulate(x)
    assert not np.isfinite(z[1]).all()
    assert (z[[0, 2]] == Pulse(0.5).simulate(x[[0, 2]])).all()


@dataclass(frozen=True)
class Chosen(Cases):
    """The same at a tolerance: the first output within 1e-9, the second within 1e-6."""

    step: float | None = None
    tolerance = (1e-9, 1e-6)


def test_steps_that_follow_the_parameters_hold_the_tolerance_of_each_output():
    x = np.random.default_rng(4).normal(size=(60, 2)) * [3.0, 1.0]
    model = Chosen()
    off = np.abs(model.simulate(x) - Cases(1 / 64).simulate(x)).reshape(60, -1, 2)
    assert off[..., 0].max() < 1e-9
    assert off[..., 1].max() < 1e-6
    assert len(set(model._rungs_of(x, np.zeros(12)).places.tolist())) >= 3


def test_a_coarse_jacobian_contracts_where_it_was_measured_and_beyond():
    model = Chosen()
    x = model.nominal + np.random.default_rng(7).normal(size=(30, 2))
    J, coarse = model.jacobian(x), model.coarse_jacobian(x)
    assert max(tangent_contraction(c, j) for c, j in zip(coarse, J, strict=True)) < 0.01
    fixed = Cases(0.5)
    assert (fixed.coarse_jacobian(x) == fixed.jacobian(x)).all()


@pytest.mark.oracle("closed form: a state that follows a cosine", "readings", 1e-8)
def test_a_stiff_start_read_unevenly_holds_the_tolerance():
    """y' = -a (y - cos t), y(0) = 0, read often at first and rarely later."""
    a, t = np.array([[0.5], [2.0], [30.0], [200.0]]), np.array([0.01, 0.02, 0.05, 0.1, 2.0, 10.0])
    model = Ode(
        {"y": "-a*(y-cos(t))"}, {"a": 2.0}, times=tuple(t), tolerance=1e-8, method="explicit"
    )
    exact = a / (1 + a * a) * (a * np.cos(t) + np.sin(t) - a * np.exp(-a * t))
    agreed(np.abs(model.simulate(a / 2.0) - exact), 1e-8)


def test_what_cannot_be_recorded_is_refused_with_the_remedy():
    a = Graph().input("a")
    with pytest.raises(TypeError, match=r"without if"):
        _ = 1.0 if a > 0 else 0.0
    with pytest.raises(TypeError, match=r"rint"):
        np.rint(a)


def test_without_a_tolerance_or_a_step_the_model_says_what_is_missing():
    class Silent(Pulse):
        tolerance = None

    with pytest.raises(
        UserError, match=r"^measurement.step=null: silent states neither .*; give one"
    ):
        Silent(step=None).simulate(np.ones((1, 2)))


def test_a_wrong_number_of_derivatives_is_refused():
    class Wrong(Pulse):
        def rhs(self, t, y, p, c):
            return y[0], y[0]

    with pytest.raises(ValueError, match=r"rhs returns 2 values where 1 are declared"):
        Wrong().simulate(np.ones((1, 2)))


def test_the_example_in_the_docs_of_ode_works():
    scope: dict[str, Any] = {"np": np, "OdeMeasurement": OdeMeasurement}
    for example in doctest.DocTestParser().get_examples(OdeMeasurement.__doc__ or ""):
        exec(example.source, scope)
    pendulum = scope["Pendulum"]()
    x = pendulum.nominal[None] + np.array([[0.0, 0.0], [1.0, 2.0]])
    z = pendulum.simulate(x)
    # A pendulum of 1 m that swings by half a radian takes 2.0382 s (series of the elliptic
    # integral): a turning point.
    assert z[0, 3] == pytest.approx(0.5 * np.cos(2 * np.pi / 2.0382 * 2.0), abs=2e-3)
    np.testing.assert_allclose(
        pendulum.jacobian(x), differentiate(pendulum.simulate, x, analytic=False), atol=1e-8
    )
