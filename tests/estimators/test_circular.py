"""Readings that are angles: whole turns of theirs say nothing, to any estimator, test, residual or
picture."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from shared.estimator_checks import ALL
from shared.families import slow_if
from shared.slopes import differentiate

import ipe_bench as ib
from ipe_bench.baselines import IPLF, EnKF, IteratedEKF, LevenbergMarquardt, LinearLSE
from ipe_bench.basics.errors import UserError
from ipe_bench.cli.main import main
from ipe_bench.measurements import Formula, Function, Ode
from ipe_bench.measurements.base import SubsetModel
from ipe_bench.measurements.joint import Joint
from ipe_bench.measurements.known import ParameterInfo, informed
from ipe_bench.noise import Gaussian, Quantization
from ipe_bench.questions.posterior.maths import sample_posterior
from ipe_bench.real.readings import Readings, open_together
from ipe_bench.solvers import SteepestDescent
from ipe_bench.trials.scenario import Scenario

TURN = 2 * np.pi
START = {"a": -40.0, "b": -6.0, "u": 2.0, "v": 1.2}
TIMES = tuple(np.arange(0.5, 10.5, 0.5))
RATES, INITIAL = {"x": "u", "y": "v"}, {"x": "a", "y": "b"}
SIZE = {"a": 2.0, "b": 2.0, "u": 0.2, "v": 0.2}
PASSING = Ode(
    RATES, START, INITIAL, {"bearing": "arctan2(y, x)", "range": "hypot(x, y)"}, TIMES,
    size=SIZE, circular=("bearing",), tolerance=1e-10,
)  # fmt: skip
"""A target that passes west of the observer, where arctan2 jumps by a whole turn."""
UNCUT = replace(
    PASSING, outputs={"bearing": "pi + arctan2(-y, -x)", "range": "hypot(x, y)"}, circular=()
)
"""The same, with the jump in the east, where nothing is seen."""
NOISE = Gaussian(0.01)
LAW = """
import numpy as np

def bearing(t, s, a=-40.0, b=-6.0, u=2.0, v=1.2):
    return np.rad2deg(np.arctan2(b + v * t, a + u * t - s))
"""


@pytest.fixture
def passing():
    """The problem with the cut, that without, and readings of six trials of the latter."""
    scenario = Scenario(UNCUT, NOISE)
    return replace(scenario, measurement=PASSING).problem, scenario.problem, scenario.draw(0, 6).z


def turned(z, model=PASSING):
    """The readings, angles within half a turn of 0, and with whole turns besides."""
    periods = np.array(model.periods)
    within = z - periods * np.round(z / np.where(periods > 0, periods, np.inf))
    return within, z + periods * np.random.default_rng(0).integers(-3, 4, z.shape)


DEAR = SteepestDescent, IPLF, EnKF, IteratedEKF
"""Kinds of which a quicker one of the same family is quick."""


@pytest.mark.parametrize(
    "estimator",
    slow_if(lambda one: isinstance(one, DEAR), [*ALL, LinearLSE()]),
    ids=str,
)
def test_an_estimate_is_that_of_a_model_without_the_jump_however_readings_are_turned(
    passing, estimator
):
    problem, uncut, z = passing
    within, besides = turned(z)
    assert (np.ptp(within[:, ::2], axis=1) > 6).sum() >= 5
    with np.errstate(all="ignore"):
        expected = estimator.estimate(uncut, z)
        scale = np.sqrt(np.diagonal(expected.covariance, axis1=1, axis2=2))
        for given in (z, within, besides):
            found = estimator.estimate(problem, given)
            drawn = isinstance(estimator, EnKF)  # whose draws depend on the bits of the readings
            assert (np.abs(found.x - expected.x) / scale).max() < (4.0 if drawn else 1e-5)
            assert found.covariance == pytest.approx(
                expected.covariance, rel=3.0 if drawn else 1e-5, abs=1e-3
            )
            assert found.status.tolist() == expected.status.tolist()
            for name in expected.extras:
                assert found.extras[name] == pytest.approx(
                    expected.extras[name], rel=1.0 if drawn else 1e-5, nan_ok=True
                )


def test_a_run_scores_the_trials_as_without_the_jump():
    estimators = {
        "lm": LevenbergMarquardt(),
        "ekf": ib.baselines.EKF(),
        "newton": ib.solvers.Newton(),
    }
    tables = [ib.run(Scenario(model, NOISE), estimators, 40) for model in (PASSING, UNCUT)]
    for column in (
        "success",
        "efficiency_solved",
        "rmse_solved",
        "crlb",
        "linear_bound",
        "nees_solved",
    ):
        one, other = (table[column].to_numpy(dtype=float) for table in tables)
        assert one == pytest.approx(other, rel=1e-5, nan_ok=True), column
    turning = ib.run(Scenario(PASSING, Quantization(0.02)), {"lm": LevenbergMarquardt()}, 20)
    assert turning["success"].min() == 1.0


@pytest.mark.slow
def test_what_is_not_near_a_jump_has_the_bits_of_a_model_that_knows_of_none():
    model = replace(PASSING, start={"a": 40.0, "b": 6.0, "u": 2.0, "v": 1.2})
    plain = replace(model, circular=())
    scenario = Scenario(plain, NOISE)
    z = scenario.draw(0, 5).z
    for estimator in ALL:
        with np.errstate(all="ignore"):
            one, other = (estimator.estimate(Scenario(m, NOISE).problem, z) for m in (model, plain))
        tolerance = 0.0 if not {"epochs"} & estimator.needs else 1e-9
        np.testing.assert_allclose(one.x, other.x, rtol=tolerance, atol=0.0, err_msg=str(estimator))


def test_subsets_files_together_and_bounded_parameters_keep_their_angles():
    x = PASSING.nominal[None]
    z = PASSING.simulate(x)[0]
    odd = SubsetModel(PASSING, tuple(range(1, PASSING.m - 4)))
    bounded = informed(PASSING, (ParameterInfo("u", lower=0.1),))
    for model, h in (
        (odd, z[1:-4]),
        (bounded, z),
        (Joint((PASSING, odd)), np.concatenate([z, z[1:-4]])),
    ):
        angles = np.array(model.periods) > 0
        assert angles.tolist() == [name == "bearing" for name in model.index["output"]]
        shifted = h + TURN * 2 * angles
        assert model.near(h, shifted) == pytest.approx(shifted, abs=1e-12)


def test_slopes_by_differences_do_not_see_the_jump(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("west.py").write_text(LAW)
    t = np.arange(0.0, 10.0)
    model = Function(
        "west:bearing", columns={"t": t, "s": 0 * t}, unit="deg", circular=("reading",)
    )
    at = replace(model, start={"b": 0.0, "v": 0.0}, size={"b": 1.0, "v": 1.0})
    exact = np.rad2deg(1.0 / (-40.0 + 2.0 * t))
    assert at.jacobian(at.nominal[None])[0, :, 1] == pytest.approx(exact, rel=1e-8)
    assert set(model.periods) == {360.0}
    formula = Formula(
        "arctan2(b, a - s)", {"a": -40.0, "b": 0.0}, {"s": t.tolist()}, circular=("y",)
    )
    by_differences = differentiate(
        formula.simulate, formula.nominal[None], analytic=False, near=formula.near
    )
    assert formula.jacobian(formula.nominal[None]) == pytest.approx(
        by_differences, rel=1e-6, abs=1e-9
    )


@pytest.mark.slow
def test_estimates_of_files_their_residuals_and_predictions_are_those_without_turns(
    tmp_path, monkeypatch
):
    """By a function in deg, whose readings are written with whole turns, or without; one is
    missing."""
    monkeypatch.chdir(tmp_path)
    Path("west.py").write_text(LAW)
    rng, t, s = np.random.default_rng(4), np.arange(0.0, 12.0, 0.5), np.repeat([0.0, 15.0], 12)
    exact = np.rad2deg(np.arctan2(-6.3 + 1.25 * t, -41.0 + 2.1 * t - s)) % 360
    z = exact + 0.2 * rng.standard_normal(len(t))
    residuals = []
    for k, turns in enumerate((0 * t, rng.integers(-2, 3, len(t)), np.where(z > 180, -1, 0))):
        shown = np.where(np.arange(len(t)) == 7, np.nan, z + 360 * turns)
        columns = pd.DataFrame({"t": t, "s": s, "reading [deg]": shown, "sigma": 0.2})
        columns.to_csv(f"{k}.csv", index=False)
        words = [
            "measurement=function",
            "measurement.of=west:bearing",
            "measurement.unit=deg",
            f"output=out{k}",
        ]
        words += [
            "measurement.circular=[reading]",
            "solver=[auto,newton]",
            "baseline=[levenberg_marquardt,least_squares]",
        ]
        assert main(["estimate", *words, f"readings={k}.csv", "figures=none"]) == 0
        residuals.append(pd.read_csv(f"out{k}/residuals.csv")["residual [deg]"].to_numpy())
    assert np.nanmax(np.abs(residuals[0])) < 1.0
    for other in residuals[1:]:
        assert other == pytest.approx(residuals[0], abs=1e-5, nan_ok=True)


@pytest.mark.slow
def test_levels_of_noise_and_the_posterior_are_those_without_turns(passing):
    problem, uncut, z = passing
    within, besides = turned(z)
    found = [
        ib.estimate(m, r[0], noise=None)
        for m, r in ((UNCUT, z), (PASSING, within), (PASSING, besides))
    ]
    for one in found[1:]:
        for fit, other in zip(one.fits, found[0].fits, strict=True):
            assert fit.x == pytest.approx(other.x, rel=1e-5)
            assert fit.residual == pytest.approx(other.residual, abs=1e-6)
    sampled = [
        sample_posterior(p, r[0], particles=400, seed=1)
        for p, r in ((uncut, z), (problem, besides))
    ]
    assert sampled[1].mean == pytest.approx(sampled[0].mean, rel=1e-4)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"circular": ("beering",)}, "circular=beering: .*did you mean bearing"),
        (
            {"circular": ("bearing",), "unit": "m"},
            "unit=m: circular=bearing is an angle, in rad or deg",
        ),
    ],
)
def test_what_is_no_angle_is_refused(options, message):
    with pytest.raises(UserError, match=message):
        replace(PASSING, **options)
    with pytest.raises(UserError, match="circular=z: there is no such reading"):
        Formula("a*t", {"a": 1.0}, {"t": (1.0,)}, circular=("z",))


@pytest.mark.parametrize(
    ("unit", "remedy"),
    [
        ("deg", "set measurement.unit=deg"),
        ("°", "set measurement.unit=°"),
        ("mrad", "convert the values to rad"),
    ],
)
def test_angles_of_a_file_in_another_unit_are_not_taken_for_radians(tmp_path, unit, remedy):
    """A straight line of 20 degrees a second is one of 190 where a turn is 2 pi of its unit."""
    t = np.arange(6.0)
    rows = [f"{time},{(10 + 20 * time) % 360}" for time in t]
    model = Formula("a + b*t", {"a": 9.0, "b": 19.0}, circular=("y",))

    def opened(model: Formula, unit: str) -> Readings:
        path = tmp_path / "angles.csv"
        path.write_text("\n".join([f"t,y [{unit}]", *rows]), encoding="utf-8")
        return open_together([path], model)

    with pytest.raises(UserError, match=rf"column y \[{unit}\]: angles .* are in rad; {remedy}"):
        opened(model, unit)
    assert opened(model, "rad").model.periods == pytest.approx(2 * np.pi)
    assert opened(replace(model, unit="deg"), "deg").model.periods == pytest.approx(360)
    # Without turns a unit that the model does not state is a name alone.
    assert len(opened(replace(model, circular=()), unit).z) == 6


def test_angles_and_conditionals_are_remarked_on_together():
    found = replace(PASSING, rates={"x": "u", "y": "v if t < 50 else 2*v"}).remarks(PASSING.nominal)
    assert any("t < 50 holds at every reading" in text for text in found)


def test_a_reading_at_the_very_jump_takes_no_finer_steps():
    """At half time the target is due west to the last digit, so levels of steps differ by a whole
    turn there."""
    apart = replace(PASSING, start=START | {"b": -6.1})
    assert PASSING.engine._nominal_place == apart.engine._nominal_place
    assert not PASSING.hindrance(PASSING.nominal)
    by_rodas = replace(PASSING, method="implicit")
    z = PASSING.simulate(PASSING.nominal[None])
    assert np.abs(z - PASSING.near(by_rodas.simulate(by_rodas.nominal[None]), z)).max() < 1e-7
