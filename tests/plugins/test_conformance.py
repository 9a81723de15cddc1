"""Our own components pass the checks that plugins are given, and the checks catch what they are for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from omegaconf import OmegaConf

from ipe_bench.basics.linalg import Covariance
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.base import Estimates, Estimator
from ipe_bench.measurements import Formula, Gnss, Nist, Ode, Polynomial, Ranging
from ipe_bench.measurements.joint import Joint
from ipe_bench.measurements.known import Informed, Known
from ipe_bench.measurements.nist import datasets
from ipe_bench.noise import Gaussian, Noise
from ipe_bench.plugins import discovery as plugins
from ipe_bench.plugins.conformance import check_component
from ipe_bench.plugins.construct import construct
from ipe_bench.solvers import Newton

GROUPS = ("measurement", "noise", "prior", "solver", "baseline")
OURS = [
    o
    for o in plugins.options()
    if o.group in GROUPS and o.source.name == "ipe-bench" and "???" not in o.path.read_text(encoding="utf-8")
]
"""Those that are something as they stand: a formula or equations of a user's are checked below."""


def component(option: plugins.Option):
    config = OmegaConf.to_container(OmegaConf.load(option.path), resolve=True)
    return construct(config, option.package or option.group)


def complaints(component) -> str:
    return "; ".join(f.complaint for f in check_component("mine", component) if f.complaint)


@pytest.mark.parametrize("option", OURS, ids=lambda o: f"{o.group}={o.name}")
def test_every_option_of_ours_keeps_its_promises(option):
    assert not complaints(component(option))


@pytest.mark.parametrize("dataset", datasets())
def test_every_certified_problem_keeps_its_promises(dataset):
    assert not complaints(Nist(dataset))


class Faulty(Estimator):
    """Newton's estimate with one fault."""

    def estimate(self, problem, z, *, history=False):
        return self.spoil(Newton().estimate(problem, z, history=history), z)

    def spoil(self, estimates: Estimates, z) -> Estimates:
        return estimates


@dataclass(frozen=True)
class Leaning(Faulty):
    def spoil(self, estimates, z):
        estimates.x = estimates.x + 1e-9 * len(z)
        return estimates


@dataclass(frozen=True)
class Boasting(Faulty):
    def spoil(self, estimates, z):
        estimates.status[:] = Status.CONVERGED
        return estimates


@dataclass(frozen=True)
class Wrong(Faulty):
    def spoil(self, estimates, z):
        estimates.x = estimates.x + 1.0
        return estimates


@dataclass(frozen=True)
class Free(Faulty):
    def spoil(self, estimates, z):
        estimates.simulations[:] = 0
        estimates.jacobians[:] = 0
        return estimates


@dataclass(frozen=True)
class Scribbling(Faulty):
    def spoil(self, estimates, z):
        z += 1.0
        return estimates


@dataclass
class Thawed(Faulty):
    pass


@dataclass(frozen=True)
class Mislabelled(Polynomial):
    @property
    def index(self):
        return {"time": [0.0] * self.count}


@dataclass(frozen=True)
class Slanted(Polynomial):
    def jacobian(self, x):
        return super().jacobian(x) * 1.01


@dataclass(frozen=True)
class Forgetful(Noise):
    def corrupt(self, h, offset, rng):
        return h + np.random.default_rng().standard_normal(h.shape)

    def covariance(self, m):
        return Covariance(np.ones(m))


@pytest.mark.parametrize(
    ("faulty", "complaint"),
    [
        (Leaning(), "trial 0 differs"),
        (Boasting(), "NaN readings counts as converged"),
        (Wrong(), "standard deviations of the bound"),
        (Free(), "not counted"),
        (Scribbling(), "the readings have changed"),
        (Thawed(), "frozen=True"),
        (Mislabelled(), "two readings have one label"),
        (Slanted(), "off by"),
        (Forgetful(), "besides the stream"),
        (42, "neither"),
    ],
    ids=lambda value: type(value).__name__ if not isinstance(value, str) else "",
)
def test_a_fault_is_found(faulty, complaint):
    assert complaint in complaints(faulty)


def test_a_fault_in_one_check_leaves_the_others_ok():
    findings = list(check_component("mine", Free()))
    assert sum(bool(f.complaint) for f in findings) == 1
    assert not complaints(Newton())
    assert not complaints(Gaussian(1.0))


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
        Informed(Ranging(), (Known("clock", fixed=3.0), Known("up", lower=-50.0, upper=90.0))),
        Joint((Gnss(), Gnss(rounds=2))),
    ],
    ids=["formula", "ode", "informed", "joint"],
)
def test_models_that_users_put_together_keep_the_promises_of_models(model):
    assert not complaints(model)
