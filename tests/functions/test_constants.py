"""Slopes of functions of constants with large offsets: coordinates in a grid, latitude and
longitude, a Julian date."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from shared.slopes import differentiate

import ipe_bench as ib
from ipe_bench.basics.errors import UserError
from ipe_bench.measurements import Measurement, OdeMeasurement, Parameter, function

CORNER = np.array([500000.0, 5400000.0])
STATIONS = np.array([(0, 0), (40, 0), (40, 30), (0, 30), (20, 45)]) + CORNER
TOWERS = [(37.41, -121.96), (37.42, -121.95), (37.43, -121.97)]
DAYS = 2455000 + np.linspace(0.2, 0.7, 40)


def by_hypot(e, n):
    return np.hypot(e - STATIONS[:, 0], n - STATIONS[:, 1])


def by_root(e, n):
    return np.sqrt((e - STATIONS[:, 0]) ** 2 + (n - STATIONS[:, 1]) ** 2)


def by_math(e, n):
    return np.array([math.sqrt((e - a) ** 2 + (n - b) ** 2) for a, b in STATIONS])


def on_a_sphere(la, lo):
    r = np.pi / 180
    found = []
    for a, b in TOWERS:
        north = np.sin((la - a) * r / 2) ** 2
        east = np.sin((lo - b) * r / 2) ** 2
        chord = np.sqrt(north + np.cos(la * r) * np.cos(a * r) * east)
        found.append(2 * 6371 * np.arcsin(chord))
    return np.array(found)


def dip(b, d, t, s):
    return b - d * np.exp(-0.5 * ((DAYS - t) / s) ** 2)


def pointed_dip(b, d, t, s):
    return b - d * np.exp(-np.abs(DAYS - t) / s)


def slopes_of_ranges(e, n):
    away = np.array([e, n]) - STATIONS
    return away / np.linalg.norm(away, axis=1)[:, None]


def slopes_of_dip(b, d, t, s):
    u = (DAYS - t) / s
    g = np.exp(-0.5 * u**2)
    return np.stack([1 + 0 * u, -g, -d * g * u / s, -d * g * u**2 / s], axis=1)


def slopes_of_pointed_dip(b, d, t, s):
    u = (DAYS - t) / s
    g = np.exp(-np.abs(u))
    return np.stack([1 + 0 * u, -g, -d * g * np.sign(u) / s, -d * g * np.abs(u) / s], axis=1)


def slopes_on_a_sphere(la, lo):
    x = np.array([[la, lo]])
    return differentiate(lambda x: on_a_sphere(*x.T[..., None]).T, x, analytic=True)[0]


MODULE: Any = ModuleType("constants_of_tests")
CASES = {
    by_hypot: (slopes_of_ranges, (500013.0, 5400011.0), 1e-7),
    by_root: (slopes_of_ranges, (500013.0, 5400011.0), 1e-14),
    by_math: (slopes_of_ranges, (500013.0, 5400011.0), 1e-7),
    on_a_sphere: (slopes_on_a_sphere, (37.4191, -121.9606), 1e-13),
    dip: (slopes_of_dip, (1.0, 0.01, 2455000.43, 0.03), 1e-13),
    pointed_dip: (slopes_of_pointed_dip, (1.0, 0.01, 2455000.43, 0.03), 1e-6),
}


@pytest.fixture(autouse=True)
def _module(monkeypatch):
    monkeypatch.setitem(sys.modules, "constants_of_tests", MODULE)
    for law in CASES:
        monkeypatch.setattr(law, "__module__", "constants_of_tests")
        monkeypatch.setattr(MODULE, law.__name__, law, raising=False)


def model_of(law, at):
    names = law.__code__.co_varnames[: law.__code__.co_argcount]
    return function(law, dict(zip(names, at, strict=True)))


@pytest.mark.parametrize("law", CASES, ids=lambda law: law.__name__)
def test_slopes_of_functions_of_large_numbers(law):
    slopes, at, within = CASES[law]
    model = model_of(law, at)
    found = model.jacobian((np.array(at) / model.sizes)[None])[0] / model.sizes
    right = slopes(*at)
    assert (np.abs(found - right) <= within * np.abs(right).max(axis=0)).all()


@pytest.mark.parametrize("law", [by_hypot, by_root, by_math])
def test_standard_errors_of_a_place_are_those_of_its_offsets(law):
    _, at, _ = CASES[law]
    model = model_of(law, at)
    z = law(*at) + 0.1 * np.random.default_rng(11).standard_normal(5)
    answer = ib.estimate(
        model, z, {"lm": ib.baselines.LevenbergMarquardt()}, noise=ib.noise.Gaussian(0.1)
    )[0]
    J = slopes_of_ranges(answer.values["e"], answer.values["n"])
    wanted = 0.1 * np.sqrt(np.diag(np.linalg.inv(J.T @ J)))
    np.testing.assert_allclose(answer.standard_errors, wanted, rtol=1e-6)


@dataclass(frozen=True)
class Ranges(Measurement):
    """An own class that gives no slopes."""

    parameters: Any = (Parameter("e", "m"), Parameter("n", "m"))
    nominal: Any = (500013.0, 5400011.0)

    @property
    def index(self):
        return {"station": list(range(5))}

    def simulate(self, x):
        return np.array([by_math(*row) for row in x])


def test_an_own_class_without_slopes_has_those_of_its_readings():
    found = Ranges().jacobian(np.array([[500013.0, 5400011.0]]))[0]
    np.testing.assert_allclose(found, slopes_of_ranges(500013.0, 5400011.0), rtol=1e-6)


@dataclass(frozen=True)
class Folded(Ranges):
    """One that takes absolute values for analytic."""

    analytic = True
    nominal: Any = (2.0, 3.0)

    def simulate(self, x):
        return np.abs(x[:, :1]) * x[:, 1:] ** np.arange(1, 6)


def test_an_own_class_that_is_not_analytic_is_refused_where_it_says_so():
    with pytest.raises(UserError, match="leave `analytic` out"):
        Folded().jacobian(np.array([[2.0, 3.0]]))


@dataclass(frozen=True)
class Braking(OdeMeasurement):
    """Differential equations in Python that compare what np.asarray returned."""

    states = 1
    outputs = ("speed",)
    parameters: Any = (Parameter("k"),)
    tolerance = 1e-6
    power: float = 0.0

    @property
    def nominal(self):
        return np.ones(1)

    @property
    def times(self):
        return np.array([1.0, 2.0])

    def start(self, p, c):
        return (2.0,)

    def rhs(self, t, y, p, c):
        if self.power:
            return (-p[0] * np.where(np.asarray(y[0]) == 0, 0.0, 1.0) * y[0],)
        return (-p[0] * y[0] * (y[0] - y[0]) ** 0,)

    def read(self, t, y, p, c):
        return (y[0],)


def test_equations_in_python_do_not_compare_unknowns_as_if_they_were_known():
    with pytest.raises((TypeError, UserError), match="truth value"):
        Braking(power=1.0).simulate(np.array([[1.0]]))
    model = Braking()
    np.testing.assert_allclose(
        model.simulate(np.array([[0.5]]))[0], 2 * np.exp([-0.5, -1.0]), rtol=1e-5
    )
    slopes = -2 * np.array([1.0, 2.0]) * np.exp([-0.5, -1.0])
    np.testing.assert_allclose(model.jacobian(np.array([[0.5]]))[0, :, 0], slopes, rtol=1e-4)
