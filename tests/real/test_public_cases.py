"""Problems from public threads: the right values beside what `estimate` finds.

The data are those of the threads, or drawn anew where these have none; the right values are closed
forms, SciPy's, or the thread's confirmed answer.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

import ipe_bench as ib
from ipe_bench.measurements import Formula
from ipe_bench.noise import Gaussian


@dataclass(frozen=True)
class Case:
    """Holds a thread's formula, data and right answer."""

    source: str
    formula: str
    columns: Mapping[str, Any]
    z: Any
    right: Mapping[str, tuple[float, float]]
    """Right value and its standard error by parameter, NaN where there is none; both to 2 % of the
    error, or a relative 1e-8 of exact data."""
    start: Mapping[str, float] = field(default_factory=dict)
    deviation: float | None = None


def _drawn(seed: int, m: int) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(m)


_KLO_UO = np.array(
    [
        *(0.94597685600279, 0.95856916599601, 0.96009142950541, 0.96454515552826),
        *(0.97938932735214, 0.98252400815195, 0.98500175787242, 0.98621192462708),
        *(0.98816995007392, 0.98964101933472, 0.99247255046129, 0.99308203517541),
        *(0.99406737810867, 0.99480702681278, 0.99538268958706, 0.99622916581118),
        0.99653501465135,
    ]
)
_KLO_UO_X = [0.8, 11, 12, 16, 32, 37.8, 44, 48, 56, 64, 88, 96, 112, 128, 144, 176, 192]
_RAMP = np.array(
    [
        *(-21.639566568770565, -20.94641938821062, -20.253272207650674, -19.38827477016407),
        *(-18.36242183577839, -16.9903794973657, -15.820968419685784, -14.642427728653743),
        *(-13.505538977967726, -12.363719394592264, -11.212875317902018, -10.063929250004174),
        *(-8.918406394308075, -7.771265762413678, -6.627157520537498, -5.490093527486446),
        *(-4.364435330423279, -3.2594066511524806, -2.192471775057012, -1.1998405778202992),
    ]
)
_RAMP_X = np.linspace(-10.096508792237987, 0.8378497351705881, 20)
_CUBE = np.linspace(-1, 1, 20)
_LONG = np.linspace(60, 3060, 200)
_WAVE = np.linspace(0, 50, 200)
_TURN = 2 * np.pi * np.arange(20) / 20
_DOSE = np.linspace(0.05, 6, 25)
_ANCHORS = np.array([[0.0, 0.0], [10.0, 0.0], [-7.0, -4.2]])
_UTM = np.array(
    [[5e5, 5.4e6], [500040, 5.4e6], [500040, 5400030], [5e5, 5400030], [500020, 5400045]]
)
_UTM_Z = np.hypot(*(_UTM - [500013, 5400011]).T) + 0.1 * _drawn(11, 5)
_LINE = 5e9 + np.linspace(-2e5, 2e5, 120)
_WELL = 6e7 / ((_LINE - 5e9 - 2e4) ** 2 + 7.5e3**2) + 0.02 * _drawn(28, 120)
_NONE = np.nan

CASES = [
    Case(
        "scipy-user, Trouble using curve_fit, January 2012",
        "a*exp(-b*x)+c",
        {"x": _KLO_UO_X},
        _KLO_UO,
        {"a": (-0.05251, 0.00078), "b": (0.0344, 0.0011), "c": (0.99581, 0.00039)},
    ),
    Case(
        "an offset exponential from 1, 1, 1, at which curve_fit ends in a straight line",
        "(a-c)*exp(-x/b)+c",
        {"x": _LONG},
        80 * np.exp(-_LONG / 400) + 20 + 0.2 * _drawn(3, 200),
        {"a": (100.0, 0.11), "b": (399.55, 0.81), "c": (20.024, 0.021)},
    ),
    Case(
        "https://github.com/scipy/scipy/issues/21995",
        "a+b*x^2",
        {"x": _CUBE},
        1 + 0.01 * _CUBE**3,
        {"a": (1.0, 0.0015), "b": (0.0, 0.0031)},
    ),
    Case(
        "https://github.com/JuliaNLSolvers/LsqFit.jl/issues/176",
        "p+q*x",
        {"x": _RAMP_X},
        _RAMP,
        {"p": (-2.747, 0.097), "q": (1.945, 0.017)},
    ),
    Case(
        "https://github.com/astropy/astropy/issues/2400",
        "a*x+b",
        {"x": np.arange(100.0)},
        1.5 * np.arange(100.0) - 3,
        {"a": (1.5, _NONE), "b": (-3.0, _NONE)},
    ),
    Case(
        "https://github.com/lmfit/lmfit-py/issues/720",
        "a+b*x",
        {"x": [0.0, 1.0, 2.0]},
        np.array([0.0, 1.0, 2.0]),
        {"a": (0.0, np.sqrt(5 / 6)), "b": (1.0, np.sqrt(1 / 2))},
        deviation=1.0,
    ),
    Case(
        "Stack Overflow, curve_fit failing on even a sine wave",
        "sin(a*x)",
        {"x": np.linspace(0, 100, 300)},
        np.sin(1.759 * np.linspace(0, 100, 300)),
        {"a": (1.759, _NONE)},
    ),
    Case(
        "https://github.com/Jmeyer1292/robot_cal_tools/issues/46",
        "sqrt((x-a)^2+(y-b)^2)-r",
        {"x": np.cos(_TURN), "y": np.sin(_TURN)},
        np.zeros(20),
        {"a": (0.0, np.sqrt(0.1)), "b": (0.0, np.sqrt(0.1)), "r": (1.0, np.sqrt(0.05))},
        start={"a": 0.1, "b": 0.1},
        deviation=1.0,
    ),
    Case(
        "https://github.com/lemmingapex/trilateration/issues/34",
        "sqrt((x-a)^2+(y-b)^2)",
        {"x": _ANCHORS[:, 0], "y": _ANCHORS[:, 1]},
        np.hypot(*(_ANCHORS - 5).T),
        {"a": (5.0, _NONE), "b": (5.0, _NONE)},
        start={"a": 2.0, "b": -4.0},
    ),
    Case(
        "ranges in UTM coordinates",
        "sqrt((e-x)^2+(n-y)^2)",
        {"e": _UTM[:, 0], "n": _UTM[:, 1]},
        _UTM_Z,
        {"x": (500012.895, 0.064), "y": (5400011.036, 0.063)},
        start={"x": 500020.0, "y": 5400020.0},
        deviation=0.1,
    ),
    Case(
        "a line of 15 kHz at 5 GHz, of the shape of https://github.com/scipy/scipy/issues/19459",
        "A/((f-f0)^2+w^2)",
        {"f": _LINE},
        _WELL,
        {"A": (6.16e7, 0.2e7), "f0": (5000019966.0, 108.0), "w": (7600.0, 153.0)},
        start={"A": 1e8, "f0": 5e9, "w": 2e4},
    ),
    Case(
        "https://fncbook.github.io/fnc, nonlinear least squares of Michaelis and Menten's curve",
        "V*s/(K+s)",
        {"s": _DOSE},
        2 * _DOSE / (0.5 + _DOSE) + 0.15 * np.cos(2 * np.exp(_DOSE / 16) * _DOSE),
        {"V": (1.96865, 0.050), "K": (0.46930, 0.068)},
    ),
]


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(one, id=one.source, marks=[pytest.mark.slow] * ("15 kHz" in one.source))
        for one in CASES
    ],
)
def test_the_answer_to_a_public_problem_is_the_right_one(case: Case) -> None:
    start = {**dict.fromkeys(case.right, 1.0), **case.start}
    columns = {name: np.asarray(column, float).tolist() for name, column in case.columns.items()}
    model = Formula(case.formula, start, columns, reading="measured")
    noise = None if case.deviation is None else Gaussian(case.deviation)
    one = ib.estimate(model, case.z, noise=noise)["auto"]
    assert one.passes
    errors = dict(zip(one.values, one.standard_errors.tolist(), strict=True))
    for name, (value, error) in case.right.items():
        if np.isnan(error):
            assert one.values[name] == pytest.approx(value, rel=1e-8)
            assert np.isnan(errors[name])
        else:
            assert abs(one.values[name] - value) < 0.15 * error
            assert errors[name] == pytest.approx(error, rel=0.06)
