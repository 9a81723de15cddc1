"""Structural identifiability beside answers that are published or follow by hand."""

import pytest

from ipe_bench.measurements import Formula, Gins, Ode
from ipe_bench.measurements.arithmetic import parse
from ipe_bench.measurements.identifiability import structure
from ipe_bench.measurements.known import ConstrainedModel, ParameterInfo

# fmt: off
CASES = {
    # Lotka-Volterra with the prey alone: b and the predators only as a product.
    "prey": ({"u": "a*u-b*u*v", "v": "-c*v+d*u*v"}, {"u": "u0", "v": "v0"}, {"y": "u"}, {}, {"b", "v0"}),
    # SIR in fractions, y = K I (Tuncer and Le, Math. Biosci. 299, 2018).
    "sir": ({"S": "-beta*S*I", "I": "beta*S*I-gamma*I"}, {"S": "S0", "I": "I0"}, {"y": "K*I"}, {},
            {"beta", "K", "S0", "I0"}),
    # SIWR with y1 = k I, y2 = S + I + R: all (Lee et al. 2017).
    "siwr": ({"S": "mu-bi*S*I-bw*S*W-mu*S+a*R", "I": "bw*S*W+bi*S*I-(gam+mu)*I", "W": "xi*(I-W)",
              "R": "gam*I-(mu+a)*R"},
             {"S": "S0", "I": "I0", "W": "W0", "R": "R0"}, {"y1": "k*I", "y2": "S+I+R"}, {}, set()),
    # Goodwin's oscillator (STRIKE-GOLDD).
    "goodwin": ({"x1": "-b*x1+1/(c+x4)", "x2": "alpha*x1-beta*x2", "x3": "gamma*x2-delta*x3",
                 "x4": "sigma*x4*(gamma*x2-delta*x3)/x3"},
                {"x1": "p1", "x2": "p2", "x3": "p3", "x4": "p4"}, {"y": "x1"}, {}, {"alpha", "gamma", "p2", "p3"}),
    # Two compartments, a known dose into the first, losses from both (Bellman and Astrom, Math. Biosci. 7, 1970).
    "compartments": ({"x1": "-(k01+k21)*x1+k12*x2", "x2": "k21*x1-(k12+k02)*x2"}, {"x1": "dose"}, {"y": "x1/V"},
                     {"dose": 5.0}, {"k01", "k21", "k12", "k02"}),
    # The same without a loss from the second: all.
    "one loss": ({"x1": "-(k01+k21)*x1+k12*x2", "x2": "k21*x1-k12*x2"}, {"x1": "dose"}, {"y": "x1/V"}, {"dose": 5.0},
                 set()),
    # Viral dynamics, the virus read (Xia and Moog, IEEE TAC 48, 2003).
    "virus": ({"T": "lam-d*T-k*T*V", "I": "k*T*V-delta*I", "V": "p*I-c*V"}, {"T": "T0", "I": "I0", "V": "V0"},
              {"y": "V"}, {}, {"lam", "p", "T0", "I0"}),
    "one temperature": ({"y": "-A*exp(-E/T)*y"}, {"y": "y0"}, {"r": "y"}, {"T": 300.0}, {"A", "E"}),
    "two temperatures": ({"y": "-A*exp(-E/T)*y"}, {"y": "y0"}, {"r": "y"}, {"T": (300.0, 350.0)}, set()),
    "exponent": ({"y": "-k*y**n"}, {"y": "y0"}, {"r": "y"}, {}, set()),
    "scaled exponent": ({"y": "-k*y**n"}, {"y": "y0"}, {"r": "s*y"}, {}, {"k", "s", "y0"}),
    "weir": ({"h": "-c*h**1.5"}, {"h": "h0"}, {"r": "g*h"}, {}, {"c", "g", "h0"}),
    "torricelli": ({"h": "-c*sqrt(h)"}, {"h": "h0"}, {"r": "g*h"}, {}, {"c", "g", "h0"}),
}
"""Rates, initial states, outputs and constants; and the parameters that the outputs do not determine."""
FORMULAS = {
    "a*b*t+c": "ab", "a*exp(b*t+c)": "ac", "a*exp(-b*t)+c": "", "a*t**n": "", "sqrt(a*b)*t": "ab",
    "a*sqrt(b*t)+c": "ab", "a*(b*t)**0.5+c": "ab", "a*sqrt(b+t)+c": "", "a/sqrt(b*t)+c": "ab", "a+b*t**0": "ab",
    "a+b*t**0+c*t": "ab", "c*a**2.5*t + c*a*a**1.5*t**2": "ac",
}
# fmt: on


def model(rates, initial, outputs, constants):
    formulas = [*rates.values(), *initial.values(), *outputs.values()]
    names = sorted({name for text in formulas for name in parse(text, "formula").names} - {*rates, *constants, "t"})
    start = dict.fromkeys(names, 1.0)
    return Ode(rates=rates, start=start, initial=initial, outputs=outputs, times=(1.0, 2.0), constants=constants)


@pytest.mark.parametrize("name", CASES)
def test_published_answers(name):
    *described, lost = CASES[name]
    found = structure(model(*described))
    assert found is not None
    assert set(found.lost) == lost
    assert set().union(*found.groups) == lost
    assert len(found.sentences) == len(found.groups)


def test_what_is_fixed_is_known():
    *described, _ = CASES["prey"]
    found = structure(ConstrainedModel(model(*described), (ParameterInfo("v0", fixed=0.9),)))
    assert found is not None
    assert found.lost == ()


@pytest.mark.parametrize("expression", FORMULAS)
def test_formulas(expression):
    start = {name: 1.0 for name in "abcn" if name in expression.replace("exp", "").replace("sqrt", "")}
    found = structure(Formula(expression, start))
    assert found is not None
    assert set(found.lost) == {*FORMULAS[expression]}


def test_what_cannot_be_examined_has_no_answer():
    assert structure(Gins()) is None
    assert structure(Formula("a*sin(b*t)", {"a": 1.0, "b": 1.0})) is None
    assert structure(Formula("a*max(b, t) + erf(t)", {"a": 1.0, "b": 1.0})) is None
    driven = {"driven_by": {"u": "hold"}, "columns": {"time": [0.0], "u": [1.0]}, "times": (1.0, 2.0)}
    assert structure(Ode({"y": "u - k*y"}, {"k": 1.0}, **driven)) is None
    assert structure(Ode({"y": "(1 if t < 1 else 0) - k*y"}, {"k": 1.0}, times=(1.0, 2.0))) is None
