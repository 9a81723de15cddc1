"""A formula without a plugin: its language, its derivatives, and NIST's problems as a user types
them."""

import contextlib
import csv
import math
import pickle
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import expit
from shared.oracles import agreed, assert_agrees
from shared.slopes import differentiate

import ipe_bench as ib
from ipe_bench.baselines import LeastSquares, LevenbergMarquardt
from ipe_bench.basics.errors import UserError
from ipe_bench.measurements import Formula, Nist
from ipe_bench.measurements.arithmetic import parse
from ipe_bench.measurements.nist import digits
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import Gaussian, Unknown
from ipe_bench.real.fits import fit
from ipe_bench.real.readings import open_together

# fmt: off
NIST = {
    "Misra1a": "b1*(1-exp(-b2*x))", "Chwirut2": "exp(-b1*x)/(b2+b3*x)", "DanWood": "b1*x**b2",
    "Gauss1": "b1*exp(-b2*x) + b3*exp(-(x-b4)**2/b5**2) + b6*exp(-(x-b7)**2/b8**2)",
    "Misra1b": "b1*(1-(1+b2*x/2)**(-2))", "Kirby2": "(b1 + b2*x + b3*x**2)/(1 + b4*x + b5*x**2)",
    "Hahn1": "(b1+b2*x+b3*x**2+b4*x**3)/(1+b5*x+b6*x**2+b7*x**3)",
    "Nelson": "b1 - b2*time*exp(-b3*temperature)",
    "Lanczos1": "b1*exp(-b2*x) + b3*exp(-b4*x) + b5*exp(-b6*x)",
    "Roszman1": "b1 - b2*x - arctan(b3/(x-b4))/pi",
    "ENSO": (
        "b1 + b2*cos(2*pi*x/12) + b3*sin(2*pi*x/12) + b5*cos(2*pi*x/b4) + b6*sin(2*pi*x/b4) +"
        " b8*cos(2*pi*x/b7) + b9*sin(2*pi*x/b7)"
    ),
    "MGH09": "b1*(x**2+x*b2)/(x**2+x*b3+b4)", "Rat43": "b1/((1+exp(b2-b3*x))**(1/b4))",
    "Bennett5": "b1*(b2+x)**(-1/b3)",
}
# fmt: on
"""Some of NIST's functions, as its files print them but for the names of functions."""


@pytest.mark.oracle(
    "certified: NIST Statistical Reference Datasets, as formulas",
    "parameters, standard deviations and residual standard deviation",
    1e-6,
)
@pytest.mark.parametrize("dataset", NIST)
def test_nist_answers_come_from_the_formula_with_an_unknown_noise(dataset, tmp_path):
    """Certified parameters and standard deviations to 6 digits, from a file with columns and the
    text of the formula, from NIST's second start."""
    nist = Nist(dataset, start=2)
    names = ("time", "temperature") if dataset == "Nelson" else ("x",)
    path = tmp_path / "readings.csv"
    with path.open("w", newline="") as file:
        rows = zip(*(c.tolist() for c in nist.predictors), nist.readings.tolist(), strict=True)
        csv.writer(file).writerows([[*names, "y"], *rows])
    start = {f"b{i + 1}": float(b) for i, b in enumerate(nist.start_values)}
    found = open_together([path], Formula(NIST[dataset], start))
    order = [[p.name for p in found.model.parameters].index(name) for name in start]
    estimators = {
        "lm": LeastSquares(
            method="lm", start="nominal", ftol=1e-15, xtol=1e-15, gtol=1e-15, max_nfev=5000
        )
    }
    result = fit(
        Problem(found.model, Unknown().covariance(len(found.z))), found.z, estimators, Unknown()
    )[0]
    agreed(10.0 ** -digits(result.x[order], nist.certified.parameters), 1e-6)
    if dataset == "Lanczos1":
        # Generated without noise to 14 digits: the certified sum of squares, 1.4e-25, is of their
        # rounding.
        assert digits(result.standard_errors[order], nist.certified.deviations) >= 2
        return
    agreed(10.0 ** -digits(result.standard_errors[order], nist.certified.deviations), 1e-6)
    assert_agrees(result.level, nist.certified.residual_deviation, rtol=1e-6)


# fmt: off
ALGEBRA = {
    "-2**2": -4, "2**-1": 0.5, "2**3**2": 512, "2^3": 8, "-a/b*c": -3, "a-b-c": -3, "--a": 2,
    "1.5e-3*2": 0.003,
    ".5+5.": 5.5, "log10(1000)+ln(1)": 3, "4*atan(1)-pi": 0, "sqrt(a*b*4)-tanh(0)": 4,
    "min(a, 5, c) + max(1, b)": 4,
    "abs(a-c) + abs(1)": 2, "erf(0.5) + erfc(0.5)": 1,
    "arctan2(-1, -c)": -math.pi + math.atan(1 / 3),
    "atan2(a, 0) - pi/2 + hypot(3, 4) + hypot(1, a, 2)": 8,
    "mod(-1, c) + 10*mod(7.5, 2) + 100*floor(-0.5)": -83,
    "sign(a - 5) + 10*sign(a - b) + 100*sign(c)": 99, "(1 < a <= 2) + (c != 3) + (a == b)": 2,
    "1 if a > 2 else 2 if c > 2 else 3": 2, "not a > 1 or c > 2 and b < 3": 1,
    "1/(a-2) if a != b else c": 3,
    "min(lambda, c)\n  + 1.e0*(is - 1)": 2,
}
# fmt: on


@pytest.mark.parametrize("text", ALGEBRA)
def test_the_language_is_that_of_algebra(text):
    values = {"a": 2.0, "b": 2.0, "c": 3.0, "lambda": 2.0, "is": 1.0}
    assert float(parse(text, "expression")(values)) == pytest.approx(ALGEBRA[text], abs=1e-12)


REFUSED = [
    "__import__('os')", "b1.real", "b1[0]", "b1 if t", "b1 else t", "lambda: 1", "b1; b2", "b1=2",
    "open(b1)",
    "eval(b1)", "b1*(t",
    "b1*t)", "2t", "b1 b2", "", "()", "b1**", "*b1", "1,5*t", "b1 and", "not", "b1 < ", "min(b1)",
    "abs(b1,t)",
    "arctan2(b1)", "arctan2(b1,t,2)", "mod(b1)", "hypot(b1)", "sign(b1,t)", "b1*mod(1,0)",
    "'b1'", "b1@t", "b1//t*", "exp", "exp()",
    "exp(b1,t)",
    "b1%t", "{b1}", "b1\\n", "0x10", "1e", "1_000*b1", "1j*b1", "b1!", "é*t", "sin t", "None*b1",
    "exp(a=b1)",
    "(" * 300 + "b1" + ")" * 300, "-" * 500 + "b1", "not " * 500 + "b1",
    "1 if t else " * 500 + "b1",
    "b1*" * 4000 + "t", "9**9**9*b1", "b1*log(0)", "b1/(1-1)", "b1*sqrt(-1)", "...*b1",
]  # fmt: skip


@pytest.mark.parametrize("text", REFUSED)
def test_what_is_not_arithmetic_is_refused(text):
    with pytest.raises(UserError):
        Formula(text, {"b1": 1.0}, {"t": (1.0, 2.0)}).simulate(np.ones((1, 1)))


def test_nothing_that_looks_like_a_formula_reaches_the_interpreter():
    """Text of any kind is a formula or a user's mistake, and never any other exception."""

    @settings(max_examples=400, deadline=None)
    @given(st.text(alphabet="abt12.e+-*/^() ,_'\"[]{}:=<>!%\\\nsincoexplgifmn", max_size=40))
    def check(text):
        with contextlib.suppress(UserError):
            parse(text, "expression")

    check()


_EVERYTHING = (
    "b1*sin(t*b2)+b2*cos(t)-tan(b1*t/9)+arctan(b2*t)+exp(-b1*t)/b2+log(b1+t)*sqrt(b2*t)"
    "+sinh(b1/t)-cosh(b2)*tanh(t*b1)+t**b1+b2**t-(b1-5)**2+(-t)**3*b1+2**(b1*b2)+1.5/b2+b1**-2"
    "+(b1+b2)*(b1+b2)/(1+(b1+b2)**2)"
)


def test_derivatives_are_exact_and_those_of_a_power_of_zero_are_zero():
    model = Formula(_EVERYTHING, {"b1": 0.7, "b2": 1.3}, {"t": (0.3, 1.1, 2.4)})
    x = np.array([[1.0, 1.0], [1.2, 0.7]])
    stepped = differentiate(model.simulate, x, analytic=True)
    assert model.jacobian(x) == pytest.approx(stepped, rel=1e-12, abs=1e-13)
    assert model.jacobian_cost == 2.0  # a simulation for each direction
    power = Formula("a*t**b", {"a": 2.0, "b": 1.5}, {"t": (0.0, 4.0)})
    assert power.jacobian(np.ones((1, 2)))[0, 0].tolist() == [0.0, 0.0]
    assert power.jacobian(np.ones((1, 2)))[0, 1, 1] == pytest.approx(
        2.0 * 8.0 * math.log(4.0) * 1.5
    )


_PLANE = (
    "hypot(b1*t - 1, b2, t) + arctan2(b1 - t, b2 - t) + b1*floor(3*b2*t) + b2*sign(b1 - t) +"
    " mod(b1*t, b2 - 0.4)"
)


def test_slopes_of_angles_lengths_and_steps_are_exact_on_the_whole_plane():
    """By a complex step, which NumPy's own arctan2, hypot and floor refuse, and by differences."""
    model = Formula(_PLANE, {"b1": 0.7, "b2": 1.3}, {"t": (0.31, 1.13, 2.4, -0.83)})
    x = np.array([[1.0, 1.0], [1.2, 0.7], [-1.1, -0.53]])
    z = [
        _PLANE.replace("mod", "np.mod")
        .replace("hypot", "math.hypot")
        .replace("arctan2", "math.atan2")
    ]
    names = {"math": math, "np": np, "floor": math.floor, "sign": np.sign}
    expected = [
        [eval(z[0], names, {"b1": 0.7 * a, "b2": 1.3 * b, "t": t}) for t in model.columns["t"]]
        for a, b in x
    ]
    assert model.simulate(x) == pytest.approx(np.array(expected), rel=1e-14)
    formula = parse(_PLANE, "expression")

    def h(x):
        return formula(
            {"b1": 0.7 * x[:, :1], "b2": 1.3 * x[:, 1:], "t": np.array(model.columns["t"])}
        )

    assert model.jacobian(x) == pytest.approx(
        differentiate(h, x, analytic=True), rel=1e-13, abs=1e-14
    )
    assert model.jacobian(x) == pytest.approx(
        differentiate(h, x, analytic=False), rel=1e-7, abs=1e-8
    )


def test_a_formula_is_evaluated_or_refused_however_long():
    formula = parse("+".join(["b1*t"] * 399), "expression")
    assert formula({"b1": 2.0, "t": 0.5}) == 399.0
    assert pickle.loads(pickle.dumps(formula)).names == ("b1", "t")
    for text in ("+".join(["b1*t"] * 900), "b1" + "*t" * 2000, "b1" + "**b1" * 2000):
        with pytest.raises(UserError, match=r"^expression: .* one after another; group"):
            parse(text, "expression")


@pytest.mark.slow
def test_a_formula_of_thousands_of_names_has_its_slopes_in_seconds():
    texts = names = [f"b{i}" for i in range(3000)]
    while len(texts) > 1:
        texts = [f"({'+'.join(texts[i : i + 15])})" for i in range(0, len(texts), 15)]
    begun = time.process_time()
    model = Formula(texts[0], dict.fromkeys(names, 1.0), readings=1)
    assert (model.jacobian(model.nominal[None]) == 1.0).all()
    assert time.process_time() - begun < 4


def test_comparisons_within_comparisons_are_evaluated_or_refused_however_deep():
    """The middle of a < b < c counts twice, so the size doubles with each level; at 100 it would
    exceed 1e30."""
    text, value = "t*b1", 0.25
    for level in range(100):
        text, value = f"0.5<1-({text})<2", float(0.5 < 1 - value < 2)
        if level < 6:
            assert parse(text, "expression")({"t": 0.5, "b1": 0.5}) == value
    with pytest.raises(
        UserError, match=r"^expression: has more than 10000 numbers, names and operations; write"
    ):
        parse(text, "expression")
    with pytest.raises(
        UserError, match=r"^expression: has more than 400 operations one after another"
    ):
        parse("<".join(["b1"] * 5000), "expression")


numbers = st.sampled_from(["t", "p", "q", "0.5", "-1.5", "2"])
drawn = st.recursive(
    numbers,
    lambda inner: st.one_of(
        st.tuples(
            st.sampled_from(["({} + {})", "({} - {})", "({}*{})", "min({}, {})", "max({}, {})"]),
            inner,
            inner,
        ),
        st.tuples(
            st.sampled_from(
                ["abs({})", "erf({})", "erfc({})", "sin({})", "sqrt({} + t)", "log({} + t)"]
            ),
            inner,
        ),
        st.tuples(
            st.sampled_from(["({} if {} < {} else {})", "({} if {} >= {} else {})"]), *[inner] * 4
        ),
        st.tuples(st.sampled_from(["({} if {} < {} and {} <= {} else {})"]), *[inner] * 6),
    ).map(lambda parts: parts[0].format(*parts[1:])),
    max_leaves=8,
)
PYTHON = {"abs": abs, "min": min, "max": max, "sin": math.sin, "erf": math.erf, "erfc": math.erfc}


@settings(max_examples=50, deadline=None, derandomize=True)
@given(drawn)
def test_a_drawn_formula_is_what_python_makes_of_it_and_its_slopes_are_differences(text):
    """A branch that is not taken has no effect, even where it is not a number."""
    t = np.array([-1.7, -0.2, 0.3, 0.9, 2.4])
    model = Formula(f"{text} + 0*p*q*t", {"p": 0.8, "q": -1.3}, {"t": t.tolist()})
    x = np.array([[1.0, -1.0], [1.37, 0.61]])

    def python(x, k):
        p, q = x * model.sizes
        names = PYTHON | {
            "log": math.log,
            "sqrt": math.sqrt,
            "t": float(t[k]),
            "p": float(p),
            "q": float(q),
        }
        return eval(text, {}, names)

    z, J = model.simulate(x), model.jacobian(x)
    for i, row in enumerate(x):
        for k in range(len(t)):
            try:
                expected = python(row, k)
            except ValueError:  # of a root or a logarithm on the way to the value
                continue
            assert z[i, k] == pytest.approx(expected, rel=1e-12, abs=1e-13)
            for j, step in enumerate(1e-6 * np.eye(2)):
                with contextlib.suppress(ValueError):
                    sides = [(python(row + s * step, k) - expected) / (s * 1e-6) for s in (1, -1)]
                    if abs(sides[0] - sides[1]) < 1e-3 * (
                        1 + abs(sides[0])
                    ):  # neither a kink nor a jump
                        assert J[i, k, j] == pytest.approx(sum(sides) / 2, rel=1e-5, abs=1e-6)


def test_a_conditional_that_never_switches_is_named():
    model = Formula(
        "a + (b*(t-c) if t > c else 0)", {"a": 1.0, "b": 1.0, "c": 2.5}, {"t": (1.0, 2.0, 3.0, 4.0)}
    )
    assert model.remarks(np.array([1.0, 1.0, 1.0])) == ()
    (said,) = model.remarks(np.array([1.0, 1.0, 2.0]))
    assert said.startswith("measurement.expression: t > c holds at no reading")


@pytest.mark.parametrize(
    ("expression", "linear"),
    [
        ("a+b*t", True),
        ("(a-b*exp(t))/t-a*sqrt(t)", True),
        ("-(a if t > 1 else b*t)", True),
        ("a*b*t", False),
        ("a/(b+t)", False),
        ("a*exp(b*t)", False),
        ("a+abs(b)*t", False),
        ("floor(a)+b*t", False),
        ("a*t if a > t else b", False),
    ],
)
def test_a_formula_is_linear_if_its_second_differences_are_zero_everywhere(expression, linear):
    model = Formula(expression, {"a": 1.0, "b": 1.0}, {"t": (0.5, 1.5, 2.0, 7.0)})
    assert model.linear is linear
    x = np.random.default_rng(3).uniform(-5.0, 5.0, (30, 2))
    middle = model.simulate((x[:15] + x[15:]) / 2)
    ends = (model.simulate(x[:15]) + model.simulate(x[15:])) / 2
    assert np.allclose(middle, ends) == linear


def test_parameters_stand_as_they_are_written():
    model = Formula("exp(-k*t)*y0", {"y0": 2.0, "k": 1.0}, {"t": (0.0, 1.0)})
    assert [p.name for p in model.parameters] == ["y0", "k"]
    np.testing.assert_allclose(
        model.jacobian(np.ones((1, 2)))[0], [[2.0, 0.0], [2 * math.exp(-1), -2 * math.exp(-1)]]
    )


def test_python_takes_what_is_known_of_parameters_and_has_estimates_by_name():
    model = Formula("a*exp(-k*t)", {"k": 1.0, "a": 1.0}, {"t": (0.0, 1.0, 2.0, 3.0)})
    z, lm = 2.0 * np.exp(-0.5 * np.arange(4.0)), {"lm": LevenbergMarquardt()}
    (found,) = ib.estimate(model, z, lm, noise=Gaussian(0.01), parameters={"k": {"fixed": 0.5}})
    assert found.values == {"a": pytest.approx(2.0, rel=1e-6)}
    with pytest.raises(UserError, match=r"parameters.k.fixd"):
        ib.estimate(model, z, lm, parameters={"k": {"fixd": 0.5}})


def test_parameters_of_which_readings_are_constant_in_pieces_are_named():
    columns = {"t": tuple(np.linspace(0.0, 4.0, 9))}
    for expression, named in {
        "floor(a*t)+b*t": "a",
        "sign(a-t)+b": "a",
        "b*t+floor(a)*floor(b)": "a",
        "floor(a*b*t)": "a, b",
        "b*t if t < a else 0": "a",
        "floor(a*t)+a*t+b": None,
        "b*abs(a)+a*t": None,
        "b*exp(-a*t)": None,
    }.items():
        model = Formula(expression, {"a": 2.3, "b": 1.5}, columns)
        said = model.remarks(model.nominal)
        assert [text.partition(", but")[0] for text in said] == (
            [f"readings do not change with small changes of {named}"] if named else []
        )


@pytest.mark.parametrize(
    ("expression", "slope"),
    [
        ("1/(1+exp(-k*(t-2)))", lambda k, t: expit(k * (t - 2)) * expit(-k * (t - 2)) * (t - 2)),
        ("exp(-exp(-k*(t-2)))", lambda k, t: (t - 2) * np.exp(-k * (t - 2) - np.exp(k * (2 - t)))),
    ],
)
def test_slopes_are_known_where_an_exponential_overflows(expression, slope):
    """Rules of differentiation meet infinity over infinity there, and the curve is flat."""
    t = np.arange(5.0)
    model = Formula(expression, {"k": 1.0}, {"t": t.tolist()})
    k = np.array([[0.5], [200.0], [360.0]])
    J = model.jacobian(k)
    with np.errstate(over="ignore"):
        known = slope(k, t)
    np.testing.assert_allclose(J[:, :, 0], known, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(J[2:], model.jacobian(k[2:]))
