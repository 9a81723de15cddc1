"""Options of models and noises that cannot be, each refused by its name."""

import numpy as np
import pytest

from ipe_bench.basics.errors import UserError
from ipe_bench.measurements import Bearings, Formula, Gins, Ode, Polynomial, Ranging, Sir
from ipe_bench.measurements.known import ParameterInfo
from ipe_bench.noise import Colored, Correlated

FEW = ((1.0, 0.0, 0.0),) * 9


def _fed(**options):
    return Ode(
        **({"rates": {"y": "feed - k*y"}, "start": {"k": 0.5}, "initial": {"y": "begin"}} | options)
    )


def _line(**columns):
    return Formula("b*t", {"b": 1.0}, columns=columns)


MISTAKES = [
    (lambda: Bearings(legs=((1.0, 2.0),)), "legs"),
    (lambda: Bearings(target=(1.0, 2.0)), "target"),
    (lambda: Ranging(beacons=FEW[:1], rounds=4), "beacons:"),
    (lambda: Polynomial(4, 4), "count=4"),
    (lambda: Gins(injected=()), r"injected=\[\]: give a list of at least 1"),
    (lambda: ParameterInfo("k", fixed=1.0, lower=0.0), "fixed=1.0: a fixed parameter has no lower"),
    (
        lambda: ParameterInfo("k", positive=True, lower=-1.0),
        "lower=-1.0: is given with positive=true",
    ),
    (lambda: ParameterInfo("k", lower=2.0, upper=1.0), "upper=1.0: give a number above lower=2"),
    (lambda: ParameterInfo("k", deviation=0.0), "deviation=0.0: give a number above 0 or null"),
    (lambda: Sir(size={"beta": 1.0}), "size: beta is not a parameter"),
    (
        lambda: Sir(constants={"population": 763.0}).simulate(np.ones((1, 3))),
        "measurement: infection is not known",
    ),
    (lambda: _fed(tolerance="1e-13*cosh(nu*t)"), "tolerance: nu is neither a constant nor t"),
    (lambda: _fed(answer={"q": 3.0}), "answer: q is not a parameter"),
    (lambda: _fed(constants={"fed": 1.0}), "constants.fed: appears in no formula"),
    (lambda: _fed(constants={"y": 1.0}), "constants.y: is a state, a parameter or the time"),
    (
        lambda: _fed(constants={"feed": (1.0, 2.0), "begin": (1.0, 2.0, 3.0)}),
        "constants: have different lengths",
    ),
    (lambda: _fed(constants={"feed": "much"}), "constants.feed=much: give a finite number"),
    (lambda: _fed(outputs={"s": "k*time*y"}), "time: is a column .* the time is t"),
    (lambda: _fed(initial={"y": "y"}), "initial.y: y changes with time"),
    (
        lambda: _fed(start={"k": 1.0, "y": 1.0}),
        "start.y: the state, parameter, column or time has this name",
    ),
    (
        lambda: _fed(driven_by={"feed": "hold"}, columns={"fed": [1.0]}),
        "columns.fed: there is no such input",
    ),
    (lambda: _fed(start={"k": np.inf}), "start.k=inf: give a finite number"),
    (lambda: _fed(size={"k": 0.0}), "size.k=0.0: give a number above 0"),
    (lambda: _fed(driven_by={"u": "steps"}), "driven_by.u=steps: choose one of hold, linear"),
    (lambda: Colored(1.0, 0.5, channels=3).covariance(10), "channels=3"),
    (lambda: Correlated(1.0, 0.5, block=7).covariance(10), "block=7"),
    (lambda: Correlated(matrix=((1.0, 2.0), (2.0, 1.0))).covariance(2), "matrix"),
    (lambda: Correlated(matrix=((1.0,),)).covariance(2), "matrix"),
    (lambda: _line(t="0:8").m, r"columns\.t=0:8: give a list"),
    (lambda: _line(t=()).m, r"measurement\.columns\.t=\(\): give numbers"),
]


@pytest.mark.parametrize(("make", "said"), MISTAKES, ids=[said for _, said in MISTAKES])
def test_mistakes_are_named(make, said):
    with pytest.raises(UserError, match=f"^{said}"):
        make()
