"""Readings without noise: the first thing that a newcomer tries."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import t as t_law

import ipe_bench as ib
from ipe_bench.baselines import LevenbergMarquardt
from ipe_bench.basics.errors import UserError
from ipe_bench.measurements import Formula
from ipe_bench.real.unlimited import limits_of
from ipe_bench.report.page.answer import with_error

LM = {"lm": LevenbergMarquardt()}
X = tuple(float(k) for k in range(20))


def answered(expression, start, z):
    return ib.estimate(Formula(expression, start, {"x": X}), np.asarray(z), LM)


@pytest.mark.parametrize(
    ("expression", "z", "right"),
    [
        ("a*x+b", [2 * k + 1 for k in range(20)], [2, 1]),
        ("a*x+b", [round(0.3 + 0.1 * k, 1) for k in range(20)], [0.1, 0.3]),
        ("a*x+b", [3.0] * 20, [0, 3]),
        ("a*exp(-b*x/10)", 2 * np.exp(-0.07 * np.array(X)), [2, 0.7]),
        ("sin(a*x/10)+1000*b", np.sin(0.13 * np.array(X)) + 1e3, [1.3, 1]),
        ("a*log(b+x)", 2 * np.log(3 + np.array(X)), [2, 3]),
    ],
    ids=["integers", "tenths", "equal", "decay", "sine on a large offset", "logarithm"],
)
def test_exact_readings_have_an_exact_answer(expression, z, right):
    answer = answered(expression, {"a": 1.0, "b": 1.0}, z)
    (one,) = answer
    assert one.x == pytest.approx(right, rel=1e-9, abs=1e-12)
    assert np.isnan(one.standard_errors).all()
    assert not one.outliers.any()
    assert answer.examination is None
    assert answer.passes
    assert "which meets every reading exactly" in answer.finding()
    assert "The readings show no noise, so there are no standard errors" in str(answer)


def test_readings_that_are_exact_but_for_one_are_not():
    z = 2 * np.array(X) + 1
    z[7] += 1e-6
    (one,) = answered("a*x+b", {"a": 1.0, "b": 1.0}, z)
    assert not one.exact
    assert np.flatnonzero(one.outliers).tolist() == [7]


@pytest.mark.parametrize("z", [(1.0, 3.0), (1.0, 3.0, np.nan, np.nan), (np.nan, 2.0)])
def test_no_noise_is_estimated_from_as_many_readings_as_parameters(z):
    model = Formula("a*x+b", {"a": 1.0, "b": 1.0}, {"x": X[: len(z)]})
    said = f"{np.isfinite(z).sum()} for 2 parameters leave no degree of freedom"
    with pytest.raises(UserError, match=said):
        ib.estimate(model, np.array(z), LM)


def test_as_many_readings_as_parameters_have_an_answer_with_noise_that_is_stated():
    model = Formula("a*x+b", {"a": 1.0, "b": 1.0}, {"x": (0.0, 1.0)})
    (one,) = ib.estimate(model, np.array([1.0, 3.0]), LM, noise=ib.noise.Gaussian(0.1))
    assert one.x == pytest.approx([2, 1])
    assert one.standard_errors == pytest.approx([0.1 * 2**0.5, 0.1])


@pytest.mark.parametrize(
    ("value", "error", "said"),
    [
        (5400011.0362, 0.0634, "5400011.036 ± 0.063"),
        (3.0, 3.8e23, "3 ± 3.8e+23"),
        (-7.5e-10, 0.12, "0.00 ± 0.12"),
        (2.877e6, 26000.0, "(2.877 ± 0.026)e6"),
        (5000019966.0, 108.0, "5000019970 ± 110"),
        (0.3, 2.0, "0.3 ± 2.0"),
        (0.0, 3.8e23, "0 ± 3.8e+23"),
        (1.2e-5, 3e-7, "(1.200 ± 0.030)e-5"),
    ],
)
def test_an_estimate_is_never_hidden_by_its_error(value, error, said):
    assert with_error(value, error) == said


def test_a_model_that_cannot_be_computed_names_its_first_reading():
    model = Formula("a+b*log(x)", {"a": 1.0, "b": 1.0}, {"x": (2.0, -1.0, -2.0, 1.0)})
    with pytest.raises(UserError, match=r"the model's readings are .*first at row=2, x=-1\.0$"):
        ib.estimate(model, np.array([1.0, 2.0, 3.0, 4.0]), LM)


@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize(
    "expression", ["a*(1-exp(-b*(x+1)))", "a*tanh(b*(x+1))", "a-exp(-b*(x+1)^2)"]
)
def test_a_parameter_that_may_go_to_infinity_is_said_to(expression, noise):
    """Each is a, but for round-off, with every b above 40: equal readings do not tell it."""
    z = 5 + noise * np.cos(7 * np.array(X))
    answer = answered(expression, {"a": 4.0, "b": 1.0}, z)
    (one,) = answer
    assert one.x[0] == pytest.approx(5, abs=0.01)
    assert one.undetermined == ("b",)
    assert tuple(one.endless) == (("b",),)
    assert np.isnan(one.standard_errors[1])
    assert "The readings do not determine b (at lm)" in str(answer)
    assert "lm: b may go to infinity" in str(answer)
    assert answer.finding() == "the readings do not determine b"


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_parameter_that_readings_tell_may_not_go_to_infinity(noise):
    z = 1e6 * (1 - np.exp(-3 * (np.array(X) + 1))) + noise * np.cos(7 * np.array(X))
    (one,) = answered("a*(1-exp(-b*(x+1)))", {"a": 1e6, "b": 1.0}, z)
    assert one.x == pytest.approx([1e6, 3], rel=1e-6)
    assert one.undetermined == ()
    assert one.endless == {}


# Of https://github.com/scipy/scipy/issues/5980, where SciPy answers c = -358 with 1.5e8 for its
# standard error.
STEEP = [0.0] * 5 + [0.26899724779580747] + [0.0] * 10
STEEP += [0.7596293832300737, 1.2214165441700262, 1.044997340851686, 0.7705897033203687]
STEEP += [1.280988851538506, 1.4403870545862594, 1.439644250890874, 1.280013863325763]
STEEP += [0.9349706185969648, 0.7035165962457238, 0.914155421686925]


@pytest.mark.slow
@pytest.mark.parametrize("mirrored", [False, True])
def test_parameters_that_run_off_together_have_no_standard_error(mirrored):
    """A step between two readings: its height is the mean of those behind the one on it."""
    t = np.arange(27.0)
    t = -t if mirrored else t
    model = Formula("b/(1+exp(-(c+d*t)))", dict.fromkeys("bcd", 0.5), {"t": tuple(t.tolist())})
    answer = ib.estimate(model, np.array(STEEP))
    one = answer["auto"]
    assert one.x[0] == pytest.approx(np.mean(STEEP[17:]), abs=1e-4)
    assert one.standard_errors[0] == pytest.approx(0.0547, abs=1e-4)
    assert np.isnan(one.standard_errors[1:]).all()
    assert tuple(one.endless) == (("c", "d"),)
    assert "c and d may go to infinity, so there is no standard error" in str(answer)
    assert "e+1" not in str(answer)


@pytest.mark.parametrize("positive", [False, True])
def test_parameters_on_their_way_to_infinity_have_a_limit_of_one_side(positive):
    """Of Michaelis and Menten's curve where it is nearly straight: by a scan of the sum of squares,
    in which V is linear."""
    x = np.linspace(0.1, 2, 20)
    z = 20 * x / (20 + x) + 0.3 * np.random.default_rng(0).standard_normal(20)
    model = Formula("V*x/(K+x)", {"V": 1.0, "K": 1.0}, {"x": tuple(x.tolist())})
    known = {name: {"positive": positive} for name in ("V", "K")}
    (one,) = ib.estimate(model, z, LM, parameters=known)

    def squares(K):
        f = x / (K + x)
        return np.sum((z - f * (f @ z) / (f @ f)) ** 2)

    limit = squares(1e9) * (1 + t_law.ppf(0.975, 18) ** 2 / 18)
    K = brentq(lambda K: squares(K) - limit, 0.1, 100)
    f = x / (K + x)
    found = limits_of(one)
    assert one.x[0] > 1e6
    assert found["K"] == pytest.approx(K, rel=1e-3)
    assert found["V"] == pytest.approx(f @ z / (f @ f), rel=0.01)


def test_a_profile_that_goes_on_behind_infinity_has_no_end():
    """The same curve is as good with K of either sign, if that is large: the truth, 20, is not to
    be excluded by an estimate of -11."""
    x = np.linspace(0.1, 2, 20)
    z = 20 * x / (20 + x) + 0.3 * np.random.default_rng(0).standard_normal(20)
    model = Formula("V*x/(K+x)", {"V": -8.0, "K": -11.0}, {"x": tuple(x.tolist())})
    found = ib.estimate(model, z, LM).examination
    assert found.x == pytest.approx([-8, -11], rel=0.1)
    low, high = found.profiles
    assert low.tolist() == [-np.inf, -np.inf]
    assert high.tolist() == [np.inf, np.inf]


def test_a_model_that_may_vanish_is_open_where_all_readings_are_zero():
    model = Formula("a*exp(-b*x)+c", dict.fromkeys("abc", 1.0), {"x": X})
    answer = ib.estimate(model, np.zeros(len(X)))
    assert answer["auto"].undetermined
    assert "The readings do not determine" in str(answer)
