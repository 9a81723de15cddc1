"""Models that cannot be computed with, told of in one line before anything is computed."""

import sys
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from ipe_bench.baselines import LevenbergMarquardt
from ipe_bench.basics.errors import UserError
from ipe_bench.measurements import Formula, Ode, Polynomial
from ipe_bench.noise import Gaussian
from ipe_bench.priors import GaussianPrior
from ipe_bench.real.estimation import Question
from ipe_bench.runs.run import validate
from ipe_bench.trials.scenario import Scenario

LM = {"lm": LevenbergMarquardt()}
TIMES = tuple(np.arange(0.0, 241.0, 20.0).tolist())


def stiff(rate):
    """y' = -rate (y - cos t): an explicit formula of eighth order is stable to steps of about 5 /
    rate."""
    start = {"k": rate, "y0": 2.0}
    return Ode(
        {"y": "-k*(y-cos(t))"}, start, {"y": "y0"}, times=TIMES, time_unit="s", method="explicit"
    )


@pytest.mark.slow
def test_stiff_equations_are_told_of_with_the_step_that_they_need():
    assert stiff(1.0).hindrance(stiff(1.0).nominal) == ""
    needed = r"measurement=ode: .*: the equations need steps of 0\.0005 s at t = .*"
    expected = needed + r", and the shortest is 0\.02; they look"
    with pytest.raises(UserError, match=expected):
        validate([Scenario(stiff(1e4), Gaussian(0.1), error_scale=1e-3)], LM, 10)
    with pytest.raises(UserError, match=expected):
        Question(
            model=stiff(1e4), readings=np.zeros(len(TIMES)), estimators=LM, noise=Gaussian(0.1)
        ).checked()
    followed = replace(stiff(1e4), method="auto")
    assert followed.hindrance(followed.nominal) == ""
    np.testing.assert_allclose(
        followed.simulate(followed.nominal[None])[0, 1:], np.cos(TIMES[1:]), atol=2e-4
    )


def test_a_solution_that_ends_is_told_of_by_its_time():
    """y' = k y^2 from 1 is 1 / (1 - k t)."""
    model = Ode({"y": "k*y^2"}, {"k": 0.5}, {"y": 1.0}, times=(0.5, 3.0))
    assert model.hindrance(model.nominal).startswith(
        "the solution itself leaves all numbers near t = 2"
    )


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
    ("model", "way"),
    [(Stale, "after another x"), (Crowded, "in another batch"), (Unseeded, "on a fresh object")],
)
def test_readings_that_hang_on_more_than_x_are_refused_by_name(model, way):
    with pytest.raises(
        UserError, match=rf"^measurement={model().name}: simulate\(x\) has other bits .*{way}"
    ):
        validate([Scenario(model(), Gaussian(0.1))], LM, 10)
    with pytest.raises(
        UserError, match=rf"^measurement={model().name}: simulate\(x\) has other bits .*{way}"
    ):
        Question(
            model=model(), readings=np.zeros(model().m), estimators=LM, noise=Gaussian(0.1)
        ).checked()


@dataclass(frozen=True)
class Wrong(Polynomial):
    """Does to x or to its readings what the test names."""

    does: str = ""

    def simulate(self, x):
        z = super().simulate(x)
        match self.does:
            case "none":
                return None
            case "short":
                return z[:, :-1]
            case "one":
                return z[:1]
            case "masked":
                return np.ma.masked_array(z, mask=z > 0)
            case "writes":
                x *= 2.0
            case "exits":
                sys.exit(3)
            case "constant":
                return 0.0 * z
        return z


@dataclass(frozen=True)
class WrongSlopes(Polynomial):
    """Has a Jacobian with the axes exchanged."""

    def jacobian(self, x):
        return super().jacobian(x).swapaxes(1, 2)


HERE = r"\S*test_foreign_models\.py, line \d+: "


@pytest.mark.parametrize(
    ("model", "complaint"),
    [
        (
            Wrong(does="none"),
            HERE + r"Wrong\.simulate returns NoneType; let it return numbers of shape \(4, 40\)",
        ),
        (
            Wrong(does="short"),
            HERE + r"Wrong\.simulate returns an array of shape \(4, 39\); .*\(4, 40\)",
        ),
        (
            Wrong(does="one"),
            HERE + r"Wrong\.simulate returns an array of shape \(1, 40\); .*\(4, 40\)",
        ),
        (
            Wrong(does="masked"),
            HERE + r"Wrong\.simulate returns a MaskedArray; return an ordinary array",
        ),
        (
            Wrong(does="writes"),
            HERE + r"ValueError: .*read-only \(it writes into what it is given: work on a copy\)",
        ),
        (
            Wrong(does="exits"),
            HERE + r"SystemExit: 3; raise an exception where there are no readings",
        ),
        (
            WrongSlopes(),
            HERE + r"WrongSlopes\.jacobian returns an array of shape \(4, 4, 40\); .*\(4, 40, 4\)",
        ),
    ],
)
def test_a_model_of_another_shape_is_refused_with_the_place_where_it_is_written(model, complaint):
    with pytest.raises(UserError, match=rf"^measurement={model.name}: {complaint}"):
        validate([Scenario(model, Gaussian(0.1))], LM, 10)
    with pytest.raises(UserError, match=rf"^measurement={model.name}: {complaint}"):
        Question(
            model=model, readings=np.zeros(model.m), estimators=LM, noise=Gaussian(0.1)
        ).checked()


def test_readings_that_do_not_change_are_told_of_the_model_and_not_of_the_noise():
    expected = "^measurement=wrong: readings do not change with c0, c1, c2, c3 at the start"
    with pytest.raises(UserError, match=expected):
        validate([Scenario(Wrong(does="constant"), Gaussian(0.1))], LM, 10)


@pytest.mark.parametrize(
    ("times", "complaint"),
    [
        ((1.0, 2.0), "2 readings are too few for 3 parameters; take more"),
        ((1.0, 2.0, 3.0), "readings at the start do not determine a, b; choose another"),
    ],
)
def test_readings_that_leave_parameters_open_are_told_of_with_their_names(times, complaint):
    start = {"a": 2.0, "b": 3.0, "c": 1.0}
    model = Formula("a*b*t + c*t**2", start, columns={"t": times})
    with pytest.raises(UserError, match=f"^measurement=formula: {complaint}"):
        validate([Scenario(model, Gaussian(0.1))], LM, 10)


@dataclass(frozen=True)
class WrongNoise(Gaussian):
    """Returns what the test names."""

    does: str = ""

    def corrupt(self, h, offset, rng):
        z = super().corrupt(h, offset, rng)
        if self.does == "writes":
            h += 1.0
        return {
            "none": None,
            "short": z[1:],
            "one": z[:1],
            "masked": np.ma.masked_array(z, z > 0),
        }.get(self.does, z)

    def covariance(self, m):
        R = super().covariance(m)
        return {"small": super().covariance(m - 1), "matrix": R.matrix()}.get(self.does, R)


@dataclass(frozen=True)
class WrongPrior(GaussianPrior):
    """Returns what the test names."""

    does: str = ""

    def draw(self, x0, error_scale, rng):
        x = super().draw(x0, error_scale, rng)
        return x[:1] if self.does == "one" else x

    def deviation(self, n, error_scale):
        d = super().deviation(n, error_scale)
        return d[:1] if self.does == "deviation" else d


@pytest.mark.parametrize(
    ("part", "complaint"),
    [
        (
            WrongNoise(1.0, does="none"),
            r"WrongNoise\.corrupt returns NoneType; let it return numbers of shape \(40,\)",
        ),
        (WrongNoise(1.0, does="short"), r"WrongNoise\.corrupt returns an array of shape \(39,\)"),
        (WrongNoise(1.0, does="one"), r"WrongNoise\.corrupt returns an array of shape \(1,\)"),
        (WrongNoise(1.0, does="masked"), r"WrongNoise\.corrupt returns a MaskedArray"),
        (
            WrongNoise(1.0, does="small"),
            r"WrongNoise\.covariance returns a Covariance of 39 readings; .* Covariance of 40",
        ),
        (
            WrongNoise(1.0, does="matrix"),
            r"WrongNoise\.covariance returns ndarray; .* Covariance of 40",
        ),
        (WrongPrior(does="one"), r"WrongPrior\.draw returns an array of shape \(1,\); .*\(4,\)"),
        (
            WrongPrior(does="deviation"),
            r"WrongPrior\.deviation returns an array of shape \(1,\); .*\(4,\)",
        ),
    ],
)
def test_a_noise_or_prior_of_another_shape_is_refused_with_the_place_where_it_is_written(
    part, complaint
):
    parts = (
        {"prior": part, "noise": Gaussian(0.1)}
        if isinstance(part, GaussianPrior)
        else {"noise": part}
    )
    with pytest.raises(UserError, match=rf"^(noise|prior)={part.name}: {HERE}{complaint}"):
        validate([Scenario(Polynomial(), **parts)], LM, 10)


def test_a_noise_cannot_write_into_the_error_free_readings():
    with pytest.raises(ValueError, match="read-only"):
        Scenario(Polynomial(), WrongNoise(1.0, does="writes")).draw(0, 2)
