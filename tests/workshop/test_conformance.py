"""Our own components pass the checks that plugins are given, and the checks catch what they are
for."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import pytest
from shared.state_models import CoordinatedTurn

from ipe_bench.baselines import EKF, LinearLSE
from ipe_bench.basics.linalg import Covariance, multiply
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.base import Estimates, Estimator
from ipe_bench.measurements import Formula, Nist, Ode, Polynomial, Ranging
from ipe_bench.measurements.joint import Joint
from ipe_bench.measurements.known import ConstrainedModel, ParameterInfo
from ipe_bench.measurements.nist import FORMULAS
from ipe_bench.noise import Colored, Gaussian, Quantization
from ipe_bench.plugins import discovery as plugins
from ipe_bench.plugins.construct import construct
from ipe_bench.solvers import Newton, State
from ipe_bench.states import Filter
from ipe_bench.workshop.conformance import check_component

GROUPS = ("measurement", "noise", "prior", "solver", "baseline", "state_model", "tracker")
OURS = [
    o
    for o in plugins.options()
    if o.group in GROUPS
    and o.source.name == "ipe-bench"
    and "???" not in o.path.read_text(encoding="utf-8")
]
"""Those that are something as they stand: a formula or equations of a user's are checked below."""


def component(option: plugins.Option):
    return construct(plugins.composed(option), option.package or option.group)


def complaints(component) -> str:
    return "; ".join(f.complaint for f in check_component("mine", component) if f.complaint)


DEAR = ("enkf", "ukf_wide", "iplf", "ekf", "ukf", "ckf", "iterated_ekf", "grid", "walking_gins")
"""Ensembles, points and iterations for every reading, one trial at a time, and long paths take
seconds."""


@pytest.mark.parametrize(
    "option",
    [pytest.param(o, marks=pytest.mark.slow if o.name in DEAR else ()) for o in OURS],
    ids=lambda o: f"{o.group}={o.name}",
)
def test_every_option_of_ours_keeps_its_promises(option):
    assert not complaints(component(option))


@pytest.mark.parametrize("dataset", FORMULAS)
def test_every_certified_problem_keeps_its_promises(dataset):
    assert not complaints(Nist(dataset))


FAULTS: dict[str, Callable[[Estimates, np.ndarray], dict[str, Any]]] = {
    "leaning": lambda e, z: {"x": e.x + 1e-9 * len(z)},
    "rounding": lambda e, z: {
        "x": e.x * (1 + 1e-15 * len(z))
    },  # as a matrix product over the whole batch
    "averaging": lambda e, z: {"x": e.x + 1e-3 * np.nanmean(z), "history": None},
    "dicing": lambda e, _: {
        "x": e.x + 1e-6 * np.random.default_rng().standard_normal(e.x.shape),
        "history": None,
    },
    "wrong": lambda e, _: {"x": e.x + 1.0},
    "boasting": lambda e, _: {"status": np.full_like(e.status, Status.CONVERGED)},
    "free": lambda e, _: {"simulations": 0 * e.simulations, "jacobians": 0 * e.jacobians},
    "scribbling": lambda e, z: {"history": np.add(z, 1.0, out=z)[:0]},
    "timid": lambda e, _: {"covariance": 100 * e.covariance},
    "bold": lambda e, _: {"covariance": e.covariance / 4},
    "diagonal": lambda e, _: {"covariance": np.diagonal(e.covariance, axis1=1, axis2=2).copy()},
}


@dataclass(frozen=True)
class Faulty(Estimator):
    """Newton's estimate with one fault."""

    fault: str

    def estimate(self, problem, z, *, history=False):
        estimates = Newton().estimate(problem, z, history=history)
        for name, value in FAULTS[self.fault](estimates, z).items():
            setattr(estimates, name, value)
        return estimates


@dataclass
class Thawed(Estimator):
    def estimate(self, problem, z, *, history=False):
        return Newton().estimate(problem, z, history=history)


def altered(made, **attributes):
    """A component as that one, of a class with other attributes."""
    cls = dataclass(frozen=True)(
        type("Altered", (type(made),), {**attributes, "__module__": __name__})
    )
    return cls(
        **{
            f.name: getattr(made, f.name)
            for f in fields(made)
            if f.init and f.name not in attributes
        }
    )


def into_H(self, problem, z, *, history=False):
    problem.H[0] = 0.0
    return Newton.estimate(self, problem, z, history=history)


def blind_to_turns(self, problem, z, *, history=False):
    h = problem.measurement.simulate(problem.x0[None])
    found = LinearLSE.estimate(self, problem, z, history=history)
    return replace(found, x=problem.x0 + multiply(problem.H_plus, z - h))


def into_x(self, x):
    x += 1.0
    return Polynomial.simulate(self, x)


def one_entry(self, x):
    J = Polynomial.jacobian(self, x)
    J[:, 6, 2] += 0.5
    return J


def with_predict(predict):
    """An EKF whose filter of a trial predicts otherwise."""

    def track(self, P0, Q, z):
        made = EKF.track(self, P0, Q, z)
        made.__class__ = type("Mine", (type(made),), {"predict": predict})
        return made

    return altered(EKF(), track=track)


def raises_if_it_walks(track):
    if track.filter.Q.any():
        raise RuntimeError("no such thing")
    type(track).__mro__[1].predict(track)


def forgets_Q(track):
    track.filter.Q = 0 * track.filter.Q
    type(track).__mro__[1].predict(track)


def changed_tracks(share: float, leaning: float):
    def track(self, model, z):
        tracks = Filter.track(self, model, z)
        tracks.covariance *= share
        tracks.mean += leaning * len(z)
        return tracks

    return track


def errors_of_a_hundredth(self, h, offset, rng):
    return h + 0.01 * rng.standard_normal(h.shape)


TURN = CoordinatedTurn()
P = Polynomial()
# fmt: off
FOUND = [
    (Faulty("leaning"), "trial 0 differs"),
    (Faulty("rounding"), "trial 0 differs, by rounding alone: use stacked matmul"),
    (Faulty("averaging"), "trial 0 differs, by more than rounding"),
    (Faulty("dicing"), "draws random numbers"),
    (Faulty("timid"), "variances are 1"),
    (Faulty("bold"), "times too small"),
    (Faulty("diagonal"),
     "covariance has shape (60, 4), and not (trials, n, n), which is (60, 4, 4) here"),
    (Faulty("boasting"), "NaN readings counts as converged"),
    (Faulty("wrong"), "standard deviations of the bound"),
    (Faulty("free"), "not counted"),
    (altered(EKF(), track=lambda self, P0, Q, z: P0.absent),
     "it raises AttributeError: 'numpy.ndarray'"),
    (Faulty("scribbling"), "it writes into what it is given"),
    (Thawed(), "frozen=True"),
    (altered(Newton(), estimate=into_H), "test_conformance.py, line"),
    (with_predict(raises_if_it_walks),
     "with process_noise=0.3 trials end: RuntimeError: no such thing"),
    (with_predict(forgets_Q), "a variance is not larger: add Q to P in predict"),
    (altered(LinearLSE(), estimate=blind_to_turns),
     "take residuals from z - model.near(model.simulate(x), z)"),
    (altered(Newton(), step=lambda self, system, state: state.x - state.F),
     "step returns ndarray, and not a State: return State(x, system.F(x))"),
    (altered(Newton(), step=lambda self, system, state: State(state.x - state.F, state.F[:, :1])),
     "step returns a State whose F has shape (8, 1), and not (8, 4)"),
    (altered(P, jacobian=one_entry), "most for parameter c2 in reading time=-0.6"),
    (altered(P, jacobian=lambda self, x: 1.01 * Polynomial.jacobian(self, x)), "off by"),
    (altered(P, simulate=lambda self, x: Polynomial.simulate(self, x) + np.abs(x[:, :1])),
     # as analytic as np.abs is
     "write np.where(u.real < 0, -u, u) for np.abs(u)"),
    (altered(P, simulate=into_x), "test_conformance.py, line"),
    (altered(P, index=property(lambda self: {"time": [0.0] * self.count})),
     "two readings have one label"),
    (altered(P, nominal=np.array([5.0])),
     "nominal has shape (1,), and not one number for each parameter, which is (4,) here"),
    (altered(P, periods=np.full(4, 360.0)),
     "periods has shape (4,), and not one number for each reading"),
    (altered(Quantization(1.0), whitened=lambda *_: None),
     "is not distributed as normal, since there is no `whitened`"),
    (altered(Gaussian(0.01), corrupt=errors_of_a_hundredth, covariance=lambda _,
             m: Covariance(np.full(m, 1e-4))),
     "times the stated deviation"),  # the variance for the deviation
    (altered(Gaussian(0.01), corrupt=lambda self, h, o,
             rng: Gaussian.corrupt(self, h, o, rng) + 0.001),
     "mean of the draws is off by up to 0.1"),
    (altered(Colored(0.01, 0.5), true_covariance=True),
     "have the correlation 0.50, and 0.00 is stated"),
    (altered(Gaussian(1.0), corrupt=lambda self, h,
             *_: h + np.random.default_rng().standard_normal(h.shape)),
     "besides the stream"),
    (altered(TURN, transition=lambda self, x, k: TURN.transition(x, k) + 1e-9 * len(x)),
     "transition gives a state alone other bits"),
    (altered(TURN, periods=()), "reading 2 jumps by 6.28: it is an angle; state its period"),
    (altered(TURN, R=lambda self, k: np.eye(3)), "h has shape (1, 2), where (1, 3) belongs"),
    (altered(Filter(), track=changed_tracks(0.25, 0.0)),
     "the reported variances of the last epoch are"),
    (altered(Filter(), track=changed_tracks(1.0, 1e-9)), "trial 0 alone has other bits"),
    (42, "neither"),
]
# fmt: on


@pytest.mark.parametrize(("faulty", "complaint"), FOUND, ids=[complaint for _, complaint in FOUND])
def test_a_fault_is_found(faulty, complaint):
    assert complaint in complaints(faulty)


@pytest.mark.parametrize(
    ("made", "idle"),
    [(EKF(), {"Returns from step()"}), (Newton(), {"Reports larger variances"}), (Filter(), set())],
)
def test_a_check_that_tests_nothing_says_so(made, idle):
    found = {f.check: f.note for f in check_component("mine", made) if f.note}
    assert all(note.startswith("does not apply, it ") for note in found.values())
    assert {name for name in idle if any(check.startswith(name) for check in found)} == idle
    assert bool(found) == bool(idle)


@pytest.mark.parametrize(
    "model",
    [
        Formula(
            "a*exp(-b*t)+c*t**2", {"a": 2.0, "b": 0.5, "c": -0.1}, {"t": (0.5, 1.0, 2.0, 3.0, 5.0)}
        ),
        Ode(
            {"x": "-k*x*y", "y": "k*x*y-0.1*y"},
            {"k": 0.3, "y0": 0.2},
            {"x": 1.0, "y": "y0"},
            {"all": "x+y"},
            (0.5, 2.0, 3.0),
        ),
        ConstrainedModel(
            Ranging(),
            (ParameterInfo("clock", fixed=3.0), ParameterInfo("up", lower=-50.0, upper=90.0)),
        ),
        Joint((Ranging(), Ranging(rounds=2))),
    ],
    ids=["formula", "ode", "informed", "joint"],
)
def test_models_that_users_put_together_keep_the_promises_of_models(model):
    assert not complaints(model)
