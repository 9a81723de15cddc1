"""Models that cannot be computed with, told of in one line before anything is computed."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from ipe_bench.baselines import LevenbergMarquardt
from ipe_bench.basics.errors import UserError
from ipe_bench.measurements import Ode, Polynomial
from ipe_bench.noise import Gaussian
from ipe_bench.real.estimation import Question
from ipe_bench.runs.run import validate
from ipe_bench.trials.scenario import Scenario

LM = {"lm": LevenbergMarquardt()}
TIMES = tuple(np.arange(0.0, 241.0, 20.0).tolist())


def stiff(rate):
    """y' = -rate (y - cos t): an explicit formula of eighth order is stable to steps of about 5 / rate."""
    start = {"k": rate, "y0": 2.0}
    return Ode({"y": "-k*(y-cos(t))"}, start, {"y": "y0"}, times=TIMES, time_unit="s", method="explicit")


def test_stiff_equations_are_told_of_with_the_step_that_they_need():
    assert stiff(1.0).hindrance(stiff(1.0).nominal) == ""
    expected = (
        r"measurement=ode: .*: the equations need steps of 0\.0005 s at t = .*, and the shortest is 0\.02; they look"
    )
    with pytest.raises(UserError, match=expected):
        validate([Scenario(stiff(1e4), Gaussian(0.1), error_scale=1e-3)], LM, 10)
    with pytest.raises(UserError, match=expected):
        Question(model=stiff(1e4), readings=np.zeros(len(TIMES)), estimators=LM, noise=Gaussian(0.1)).checked()
    followed = replace(stiff(1e4), method="auto")
    assert followed.hindrance(followed.nominal) == ""
    np.testing.assert_allclose(followed.simulate(followed.nominal[None])[0, 1:], np.cos(TIMES[1:]), atol=2e-4)


def test_a_solution_that_ends_is_told_of_by_its_time():
    """y' = k y^2 from 1 is 1 / (1 - k t)."""
    model = Ode({"y": "k*y^2"}, {"k": 0.5}, {"y": 1.0}, times=(0.5, 3.0))
    assert model.hindrance(model.nominal).startswith("the solution itself leaves all numbers near t = 2")


@dataclass(frozen=True)
class Stale(Polynomial):
    """Reads what its last call has left."""

    kept: list = field(default_factory=lambda: [0.0], compare=False)

    def simulate(self, x):
        z = super().simulate(x) + self.kept[0]
        self.kept[0] = 1e-9 * float(x[-1, 0].real)
        return z


@dataclass(frozen=True)
class Crowded(Polynomial):
    """A trial's readings hang on the others of its batch."""

    def simulate(self, x):
        return super().simulate(x) + 1e-12 * x.mean()


@dataclass(frozen=True)
class Unseeded(Polynomial):
    """Each object has numbers of its own."""

    def __post_init__(self):
        super().__post_init__()
        object.__setattr__(self, "noise", np.random.default_rng().normal())

    def simulate(self, x):
        return super().simulate(x) + self.noise


@pytest.mark.parametrize(
    ("model", "way"), [(Stale, "after another x"), (Crowded, "in another batch"), (Unseeded, "on a fresh object")]
)
def test_readings_that_hang_on_more_than_x_are_refused_by_name(model, way):
    with pytest.raises(UserError, match=rf"^measurement={model().name}: simulate\(x\) has other bits .*{way}"):
        validate([Scenario(model(), Gaussian(0.1))], LM, 10)
    with pytest.raises(UserError, match=rf"^measurement={model().name}: simulate\(x\) has other bits .*{way}"):
        Question(model=model(), readings=np.zeros(model().m), estimators=LM, noise=Gaussian(0.1)).checked()
