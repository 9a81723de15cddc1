"""Our own components pass the checks that plugins are given, and the checks catch what they are for."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from state_models import CoordinatedTurn

from ipe_bench.basics.linalg import Covariance
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.base import Estimates, Estimator
from ipe_bench.measurements import Formula, Gnss, Nist, Ode, Polynomial, Ranging
from ipe_bench.measurements.joint import Joint
from ipe_bench.measurements.known import ConstrainedModel, ParameterInfo
from ipe_bench.measurements.nist import datasets
from ipe_bench.noise import Colored, Gaussian, Noise, Quantization
from ipe_bench.plugins import discovery as plugins
from ipe_bench.plugins.conformance import check_component
from ipe_bench.plugins.construct import construct
from ipe_bench.solvers import IPE, Newton, State
from ipe_bench.states import Filter

GROUPS = ("measurement", "noise", "prior", "solver", "baseline", "model", "tracker")
OURS = [
    o
    for o in plugins.options()
    if o.group in GROUPS and o.source.name == "ipe-bench" and "???" not in o.path.read_text(encoding="utf-8")
]
"""Those that are something as they stand: a formula or equations of a user's are checked below."""


def component(option: plugins.Option):
    return construct(plugins.composed(option), option.package or option.group)


def complaints(component) -> str:
    return "; ".join(f.complaint for f in check_component("mine", component) if f.complaint)


DEAR = ("enkf", "ukf_wide", "iplf", "recursive_update", "lm_iekf")
"""Ensembles and iterations for every reading take seconds; ukf_wide is of the same class as another option."""


@pytest.mark.parametrize(
    "option",
    [pytest.param(o, marks=pytest.mark.slow if o.name in DEAR else ()) for o in OURS],
    ids=lambda o: f"{o.group}={o.name}",
)
def test_every_option_of_ours_keeps_its_promises(option):
    assert not complaints(component(option))


@pytest.mark.parametrize("dataset", datasets())
def test_every_certified_problem_keeps_its_promises(dataset):
    assert not complaints(Nist(dataset))


FAULTS: dict[str, Callable[[Estimates, np.ndarray], dict[str, Any]]] = {
    "leaning": lambda e, z: {"x": e.x + 1e-9 * len(z)},
    "rounding": lambda e, z: {"x": e.x * (1 + 1e-15 * len(z))},  # as a matrix product over the whole batch
    "averaging": lambda e, z: {"x": e.x + 1e-3 * np.nanmean(z), "history": None},
    "dicing": lambda e, _: {"x": e.x + 1e-6 * np.random.default_rng().standard_normal(e.x.shape), "history": None},
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


@dataclass(frozen=True)
class Linearizing(Newton):
    def estimate(self, problem, z, *, history=False):
        problem.H[0] = 0.0
        return super().estimate(problem, z, history=history)


@dataclass(frozen=True)
class Bare(IPE):
    def step(self, system, state):
        return state.x - state.F


@dataclass(frozen=True)
class Misshapen(IPE):
    def step(self, system, state):
        return State(state.x - state.F, state.F[:, :1])


@dataclass
class Thawed(Estimator):
    def estimate(self, problem, z, *, history=False):
        return Newton().estimate(problem, z, history=history)


@dataclass(frozen=True)
class Mislabelled(Polynomial):
    @property
    def index(self):
        return {"time": [0.0] * self.count}


@dataclass(frozen=True)
class Short(Polynomial):
    nominal = np.array([5.0])  # type: ignore[assignment]


@dataclass(frozen=True)
class Slanted(Polynomial):
    def jacobian(self, x):
        return super().jacobian(x) * 1.01


@dataclass(frozen=True)
class Tilted(Polynomial):
    """Wrong in one entry."""

    def jacobian(self, x):
        J = super().jacobian(x)
        J[:, 6, 2] += 0.5
        return J


@dataclass(frozen=True)
class Broken(Polynomial):
    """As analytic as np.abs is."""

    def simulate(self, x):
        return super().simulate(x) + np.abs(x[:, :1])


@dataclass(frozen=True)
class Shifting(Polynomial):
    def simulate(self, x):
        x += 1.0
        return super().simulate(x)


@dataclass(frozen=True)
class Confused(Gaussian):
    """Takes the variance for the deviation."""

    def corrupt(self, h, offset, rng):
        return h + self.deviation * rng.standard_normal(h.shape)

    def covariance(self, m):
        return Covariance(np.full(m, self.deviation**2))


@dataclass(frozen=True)
class Biased(Gaussian):
    def corrupt(self, h, offset, rng):
        return super().corrupt(h, offset, rng) + 0.1 * self.deviation


@dataclass(frozen=True)
class Whitened(Colored):
    """Says that it states the whole truth, and does not."""

    true_covariance = True


@dataclass(frozen=True)
class Silent(Quantization):
    """Does not say that its errors are uniform."""

    def whitened(self, shape, rng):
        return None


@dataclass(frozen=True)
class Kinked(CoordinatedTurn):
    """As analytic as np.abs is."""

    def observe(self, x, k):
        return super().observe(x, k) + np.abs(x[..., :1])


@dataclass(frozen=True)
class Unwrapped(CoordinatedTurn):
    """Its bearing jumps."""

    periods = ()


@dataclass(frozen=True)
class Crowded(CoordinatedTurn):
    """A state depends on the others of the stack."""

    def transition(self, x, k):
        return super().transition(x, k) + 1e-9 * len(x)


@dataclass(frozen=True)
class Shapeless(CoordinatedTurn):
    def R(self, k):
        return np.eye(3)


@dataclass(frozen=True)
class Proud(Filter):
    """Claims a quarter of its covariance, or looks at the other trials."""

    share: float = 0.25
    leaning: float = 0.0

    def track(self, model, z):
        tracks = super().track(model, z)
        tracks.covariance *= self.share
        tracks.mean += self.leaning * len(z)
        return tracks


@dataclass(frozen=True)
class Forgetful(Noise):
    def corrupt(self, h, offset, rng):
        return h + np.random.default_rng().standard_normal(h.shape)

    def covariance(self, m):
        return Covariance(np.ones(m))


@pytest.mark.parametrize(
    ("faulty", "complaint"),
    [
        (Silent(1.0), "is not distributed as normal, since there is no `whitened`"),
        (Faulty("leaning"), "trial 0 differs"),
        (Faulty("rounding"), "trial 0 differs, by rounding alone: use stacked matmul"),
        (Faulty("averaging"), "trial 0 differs, by more than rounding"),
        (Faulty("dicing"), "draws random numbers"),
        (Linearizing(), "test_conformance.py, line"),
        (Faulty("timid"), "variances are 1"),
        (Faulty("bold"), "times too small"),
        (Faulty("diagonal"), "covariance has shape (60, 4), and not (trials, n, n), which is (60, 4, 4) here"),
        (Bare(), "step returns ndarray, and not a State: return State(x, system.F(x))"),
        (Misshapen(), "step returns a State whose F has shape (8, 1), and not (8, 4)"),
        (Tilted(), "most for parameter c2 in reading time=-0.6"),
        (Broken(), "write np.where(u.real < 0, -u, u) for np.abs(u)"),
        (Shifting(), "test_conformance.py, line"),
        (Confused(0.01), "times the stated deviation"),
        (Biased(0.01), "mean of the draws is off by up to 0.1"),
        (Whitened(0.01, 0.5), "have the correlation 0.50, and 0.00 is stated"),
        (Faulty("boasting"), "NaN readings counts as converged"),
        (Faulty("wrong"), "standard deviations of the bound"),
        (Faulty("free"), "not counted"),
        (Faulty("scribbling"), "it writes into what it is given"),
        (Thawed(), "frozen=True"),
        (Mislabelled(), "two readings have one label"),
        (Short(), "nominal has shape (1,), and not one number for each parameter, which is (4,) here"),
        (Slanted(), "off by"),
        (Forgetful(), "besides the stream"),
        (Kinked(), "observe is not analytic"),
        (Crowded(), "transition gives a state alone other bits"),
        (Unwrapped(), "reading 2 jumps by 6.28: it is an angle; state its period"),
        (Shapeless(), "h has shape (1, 2), where (1, 3) belongs"),
        (Proud(), "the reported variances of the last epoch are"),
        (Proud(share=1.0, leaning=1e-9), "trial 0 alone has other bits"),
        (42, "neither"),
    ],
    ids=lambda value: getattr(value, "fault", type(value).__name__) if not isinstance(value, str) else "",
)
def test_a_fault_is_found(faulty, complaint):
    assert complaint in complaints(faulty)


@pytest.mark.parametrize(
    "model",
    [
        Formula("a*exp(-b*t)+c*t**2", {"a": 2.0, "b": 0.5, "c": -0.1}, {"t": (0.5, 1.0, 2.0, 3.0, 5.0)}),
        Ode(
            {"x": "-k*x*y", "y": "k*x*y-0.1*y"},
            {"k": 0.3, "y0": 0.2},
            {"x": 1.0, "y": "y0"},
            {"all": "x+y"},
            (0.5, 2.0, 3.0),
        ),
        ConstrainedModel(Ranging(), (ParameterInfo("clock", fixed=3.0), ParameterInfo("up", lower=-50.0, upper=90.0))),
        Joint((Gnss(), Gnss(rounds=2))),
    ],
    ids=["formula", "ode", "informed", "joint"],
)
def test_models_that_users_put_together_keep_the_promises_of_models(model):
    assert not complaints(model)
