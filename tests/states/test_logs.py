"""Tracks of readings from a file: the same numbers as in a run, the closed form with known inputs,
and refusals."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd
import pytest
from scipy.stats import chi2, multivariate_normal
from shared.oracles import assert_agrees
from shared.state_models import ConstantVelocity, CoordinatedTurn

import ipe_bench as ib
from ipe_bench.measurements import Parameter
from ipe_bench.plugins.construct import construct
from ipe_bench.plugins.discovery import options
from ipe_bench.real import logs
from ipe_bench.report.page.log import write_page
from ipe_bench.states import Bootstrap, Formulas, IteratedSmoother, Smoother, ckf, ekf, ukf
from ipe_bench.states.damped import LevenbergMarquardtSmoother
from ipe_bench.states.ipe import PathIPE

DRIVEN = Formulas(
    next={"x": "x + h*u + sqrt(h)*w"},
    readings={"z": "x"},
    noise={"w": 0.5},
    deviation={"z": 0.2},
    spread={"x": 1.0},
    inputs={"u": 0.0, "h": 1.0},
    units={"x": "m"},
)


@pytest.fixture
def estimate(ipe_bench):
    return partial(ipe_bench, "estimate")


def written(path, model, z, **columns):
    pd.DataFrame({**columns, **dict(zip(model.reading_names, z.T, strict=True))}).to_csv(
        path, index=False
    )


class Feet(ConstantVelocity):
    """A velocity in feet per second, of which the model computes in metres."""

    @property
    def states(self):
        return Parameter("position", "m"), Parameter("velocity", "ft/s", 1 / 0.3048)


@pytest.mark.oracle("closed form: one step of the Kalman filter", "mean and covariance", 1e-9)
def test_a_track_is_continued_from_its_covariance():
    long, short = Feet(count=6, step=2.0), Feet(count=5, step=2.0)
    z = np.arange(6.0)[:, None]
    (before,), (after,) = (
        ib.estimate(model, z[: model.epochs], {"kf": ekf()}) for model in (short, long)
    )
    D = np.diag([1.0, 1 / 0.3048])
    F = D @ [[1.0, 2.0], [0.0, 1.0]] @ np.linalg.inv(D)
    P = F @ before.covariance[-1] @ F.T + D @ [[8 / 3, 2.0], [2.0, 2.0]] @ D
    gain = P[:, 0] / (P[0, 0] + 1.0)
    predicted = F @ before.mean[-1]
    assert_agrees(after.mean[-1], predicted + gain * (z[5, 0] - predicted[0]), rtol=1e-12)
    assert_agrees(after.covariance[-1], P - np.outer(gain, P[0]), rtol=1e-9)
    np.testing.assert_allclose(
        after.deviation**2, np.einsum("kii->ki", after.covariance), rtol=1e-12
    )


@pytest.mark.slow
def test_a_log_is_tracked_with_the_bits_of_a_run(tmp_path):
    model = CoordinatedTurn(count=25)
    trackers = {"ekf": ekf(), "ukf": ukf(), "rts": Smoother(ckf()), "particles": Bootstrap(100)}
    ib.run(model, trackers, 9, output=tmp_path / "run")
    z = model.draw(0, 9).z
    written(tmp_path / "log.csv", model, z[4], time=model.times)
    stored = ib.load(tmp_path / "run").set_index(["estimator", "trial"])
    answer = ib.estimate(model, tmp_path / "log.csv", trackers)
    assert [one.label for one in answer] == list(trackers)
    for label, tracker in trackers.items():
        whole, one = tracker.track(model, z), answer[label]
        np.testing.assert_array_equal(one.mean, whole.mean[4])
        np.testing.assert_array_equal(
            one.deviation, np.sqrt(np.einsum("kii->ki", whole.covariance[4]))
        )
        assert one.log_likelihood == stored.loc[(label, 4), "log_likelihood"] or label == "rts"
        assert one.white_p == stored.loc[(label, 4), "white_p"] or label == "rts"
        assert (
            one.mean_nis == pytest.approx(stored.loc[(label, 4), "extra_nis"], rel=1e-12)
            or label == "rts"
        )
        assert one.fit_p == stored.loc[(label, 4), "fit_p"]
    one = answer["ekf"]
    assert one.limits == pytest.approx(chi2.ppf([0.025, 0.975], 50) / 50, rel=1e-9)


@pytest.mark.oracle("closed form: quadratic form of all readings", "mean NIS", 1e-6)
def test_smoothers_are_judged_by_the_cost_of_their_path():
    """Of a linear model: z' S^-1 z, with S the covariance of all readings, is the cost and the NIS
    of the filter."""
    model = replace(DRIVEN, next={"x": "x + w"}, inputs={}, count=20)
    k = np.arange(1.0, 21.0)
    S = 1.0 + 0.25 * np.minimum.outer(k, k) + 0.04 * np.eye(20)
    z = model.draw(0, 1, 3).z[0]
    trackers = {
        "rts": Smoother(ekf()),
        "ieks": IteratedSmoother(),
        "lm": LevenbergMarquardtSmoother(),
        "ipe": PathIPE(),
    }
    for factor, right in ((1.0, True), (2.0, False)):
        cost = factor**2 * z[:, 0] @ np.linalg.solve(S, z[:, 0])
        for one in ib.estimate(model, factor * z, trackers):
            assert_agrees(one.mean_nis, cost / 20, rtol=1e-6)
            assert one.fit_p == pytest.approx(chi2.sf(cost, 20), rel=1e-5)
            assert (one.verdict, one.passes) == (
                ("consistent", True) if right else ("overconfident", False)
            )


@pytest.mark.oracle("closed form: posterior of one normal state", "mean and deviation", 1e-9)
def test_a_model_without_process_noise_is_least_squares():
    """z = .9^k x with x ~ N(0, 1): the mean and the variance of all readings at once."""
    model = replace(DRIVEN, next={"x": "0.9*x"}, noise={}, inputs={}, count=8)
    z, h = model.draw(0, 1, 3).z[0], 0.9 ** np.arange(1, 9)
    variance = 1 / (1 + h @ h / 0.04)
    for one in ib.estimate(model, z, {"ukf": ukf(), "ieks": IteratedSmoother(), "ipe": PathIPE()}):
        assert_agrees(one.mean[-1, 0], h[-1] * variance * (h @ z[:, 0]) / 0.04, rtol=1e-9)
        assert_agrees(one.deviation[-1, 0], h[-1] * np.sqrt(variance), rtol=1e-9)


def test_an_iteration_that_has_not_converged_says_so():
    model = CoordinatedTurn(count=10)
    (one,) = ib.estimate(model, model.draw(0, 1).z[0], {"ipe": PathIPE(max_iterations=1)})
    assert not one.passes
    assert one.message == "max_iterations: the iteration limit was reached"


def test_particles_that_lose_a_log_are_named():
    sharp = ConstantVelocity(count=40, deviation=1e-3)
    answer = ib.estimate(sharp, sharp.draw(0, 1).z[0], {"kf": ekf(), "few": Bootstrap(200)})
    assert [one.passes for one in answer] == [True, False]
    assert answer["few"].verdict == "collapsed"
    assert "few: kf predicts each next reading far better, by 8.291e+04 in log likelihood" in str(
        answer
    )
    steered = replace(
        DRIVEN, noise={"w": 1e-3}, count=50
    )  # whose particles do not spread far enough to follow
    z = np.r_[np.zeros(30), np.linspace(1.0, 30.0, 20)][:, None]
    one = ib.estimate(steered, z, {"few": Bootstrap(200)})["few"]
    assert (one.verdict, one.passes, one.lost_from) == ("lost from time step 31", False, 31)


FOLLOWED = replace(DRIVEN, next={"x": "x + w"}, inputs={}, count=200)
TRUTHS = {
    "consistent": FOLLOWED,
    "overconfident": replace(FOLLOWED, deviation={"z": 0.6}, noise={"w": 1.5}),
    "wrong (not white)": replace(FOLLOWED, deviation={"z": 0.6}, noise={"w": 0.01}),
}
"""Models that draw logs, by the verdict on filters that assume the first: thrice the deviations, or
three times those of readings and a fiftieth of those of the walk, so that innovations correlate."""


@pytest.mark.parametrize("verdict", TRUTHS)
def test_the_title_of_a_page_has_the_verdict_on_a_log_of_known_truth(verdict, tmp_path):
    z = TRUTHS[verdict].draw(0, 1).z[0]
    answer = ib.estimate(FOLLOWED, z, {"kf": ekf(), "ukf": ukf(), "rts": Smoother(ekf())})
    write_page(tmp_path, answer, {}, figures=False)
    page = (tmp_path / "track.html").read_text(encoding="utf-8")
    how = "the model fits" if verdict == "consistent" else "no tracker fits"
    assert f"<title>{FOLLOWED.name}: {how} the log: kf, ukf, rts {verdict} ·" in page
    assert ">Smoothers</b> rts: later readings count in their paths." in page


def test_the_title_of_a_page_names_the_trackers_of_each_verdict(tmp_path):
    sharp = replace(FOLLOWED, deviation={"z": 1e-3})
    few = {"kf": ekf(), "few": Bootstrap(3), "other": ukf()}
    write_page(tmp_path, ib.estimate(sharp, FOLLOWED.draw(0, 1).z[0], few), {}, figures=False)
    page = (tmp_path / "track.html").read_text(encoding="utf-8")
    assert (
        f"<title>{FOLLOWED.name}: no tracker fits the log: kf, other overconfident; few collapsed ·"
        in page
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("verdict", "least", "most"), [("consistent", 88, 100), ("overconfident", 0, 0)]
)
def test_titles_are_false_on_as_few_logs_as_their_limits_say(verdict, least, most, tmp_path):
    """Of 100 logs at most 5 % and 3 deviations are called anything but consistent, if they are from
    the model; and none is called consistent, if its deviations are three times as large."""
    titles = []
    for z in TRUTHS[verdict].draw(0, 100).z:
        write_page(tmp_path, ib.estimate(FOLLOWED, z, {"kf": ekf()}), {}, figures=False)
        titles.append((tmp_path / "track.html").read_text(encoding="utf-8"))
    called = sum(
        f"<title>{FOLLOWED.name}: the model fits the log: kf consistent ·" in title
        for title in titles
    )
    assert least <= called <= most


@pytest.mark.oracle("closed form: Kalman filter of one state", "means and log likelihood", 1e-12)
def test_known_inputs_and_unequal_steps_of_a_log_give_the_closed_form(tmp_path):
    rng = np.random.default_rng(5)
    h, u = rng.uniform(0.1, 3.0, 40), rng.normal(size=40)
    x = rng.normal() + np.cumsum(h * u + 0.5 * np.sqrt(h) * rng.normal(size=40))
    z = x + 0.2 * rng.normal(size=40)
    z[[7, 8]] = np.nan
    written(
        tmp_path / "log.csv", DRIVEN, z[:, None], h=h, u=u, epoch=np.arange(1, 41), note=np.ones(40)
    )
    (one,) = ib.estimate(DRIVEN, tmp_path / "log.csv", {"ekf": ekf()}, ignore_columns=["note"])
    m, P, log_likelihood = 0.0, 1.0, 0.0
    for k in range(40):
        m, P = m + h[k] * u[k], P + 0.25 * h[k]
        if np.isfinite(z[k]):
            S = P + 0.04
            log_likelihood -= 0.5 * ((z[k] - m) ** 2 / S + np.log(2 * np.pi * S))
            m, P = m + P / S * (z[k] - m), P * 0.04 / S
        assert_agrees(one.mean[k, 0], m, atol=1e-12)
        assert one.deviation[k, 0] == pytest.approx(np.sqrt(P), rel=1e-12)
    assert_agrees(one.log_likelihood, log_likelihood, rtol=1e-12)
    assert np.flatnonzero(np.isnan(one.nis)).tolist() == [7, 8]
    assert one.mean_nis == pytest.approx(np.nansum(one.nis) / 38, rel=1e-12)


def test_the_times_of_a_log_are_those_of_its_epochs(tmp_path):
    """x grows by t at each step, and no reading but the last."""
    model = replace(DRIVEN, next={"x": "x + t + w"}, noise={"w": 0.0}, inputs={"time": 0.0})
    z, t = np.array([np.nan, np.nan, 4.0]), np.array([0.5, 2.0, 2.25])
    pd.DataFrame({"time [s]": t, "z": z}).to_csv(tmp_path / "log.csv", index=False)
    answer = ib.estimate(model, tmp_path / "log.csv", {"ekf": ekf()})
    np.testing.assert_array_equal(answer.log.model.times, t)
    assert answer["ekf"].mean[:2, 0] == pytest.approx([0.5, 2.5], rel=1e-12)
    assert answer["ekf"].mean[2, 0] == pytest.approx(4.75 + (4.0 - 4.75) / 1.04, rel=1e-12)
    pd.DataFrame({"time [s]": t[[0, 2, 1]], "z": z}).to_csv(tmp_path / "back.csv", index=False)
    with pytest.raises(
        ib.UserError, match=r"row 4, column time \[s\]: is before the time of the row above"
    ):
        ib.estimate(model, tmp_path / "back.csv", {"ekf": ekf()})
    pd.DataFrame({"time [ms]": t, "z": z}).to_csv(tmp_path / "ms.csv", index=False)
    with pytest.raises(ib.UserError, match=r"column time \[ms\]: the unit must be s, as in"):
        ib.estimate(model, tmp_path / "ms.csv", {"ekf": ekf()})


@pytest.mark.parametrize("stamps", [False, True])
def test_dt_is_the_step_and_missing_readings_are_predicted(stamps, tmp_path):
    """Two readings have one time, and two rows at the end ask for a forecast."""
    model = Formulas(
        next={"x": "x + dt*v", "v": "v + dt*w"},
        readings={"z": "x"},
        noise={"w": 0.1},
        deviation={"z": 0.2},
        spread={"x": 5.0, "v": 1.0},
        inputs={"time": 0.0},
    )
    t = np.array([0.0, 1.0, 1.0, 2.5, 4.0])
    z = np.array([1.0, 2.1, 2.2, np.nan, np.nan])
    time = t.tolist()
    if stamps:
        time = ["2024-02-28T23:59:59", *(f"2024-02-29T00:00:{one - 1:06.3f}" for one in t[1:])]
    log = tmp_path / "log.csv"
    pd.DataFrame({"time": time, "z": z}).to_csv(log, index=False)
    (one,) = ib.estimate(model, log, {"ekf": ekf()})
    x, P = np.zeros(2), np.diag([25.0, 1.0])
    for k, dt in enumerate(np.diff(t, prepend=0.0)):
        F = np.array([[1.0, dt], [0.0, 1.0]])
        x, P = F @ x, F @ P @ F.T + np.diag([0.0, (0.1 * dt) ** 2])
        assert one.predicted[k, 0] == pytest.approx(x[0], rel=1e-12, abs=1e-12)
        assert one.predicted_deviation[k, 0] == pytest.approx(np.sqrt(P[0, 0] + 0.04), rel=1e-12)
        if np.isfinite(z[k]):
            K = P[:, 0] / (P[0, 0] + 0.04)
            x, P = x + K * (z[k] - x[0]), P - np.outer(K, P[0])
    assert one.mean[-1] == pytest.approx(x, rel=1e-12)


def test_a_log_whose_times_are_uneven_is_told_of_dt(tmp_path):
    model = replace(DRIVEN, next={"x": "x + w"}, inputs={})
    pd.DataFrame({"time": [1.0, 2.0, 4.0], "z": np.ones(3)}).to_csv(
        tmp_path / "log.csv", index=False
    )
    with pytest.raises(ib.UserError, match=r"state_model\.inputs\.time=0, and dt for the steps"):
        ib.estimate(model, tmp_path / "log.csv", {"ekf": ekf()})


@pytest.mark.parametrize(("unit", "fits"), [("deg", False), ("°", False), ("rad", True)])
def test_bearings_in_degrees_are_refused_where_a_turn_is_two_pi(unit, fits, tmp_path):
    model = ib.component("state_model/bearings_only")
    z = model.draw(0, 1).z[0, :, 0]
    readings = z if fits else np.rad2deg(z)
    pd.DataFrame({f"bearing [{unit}]": readings}).to_csv(tmp_path / "log.csv", index=False)
    if fits:
        answer = ib.estimate(model, tmp_path / "log.csv", {"ekf": ekf()})
        np.testing.assert_allclose(answer.log.z[:, 0], z, rtol=1e-12)
        return
    said = f"column bearing \\[{unit}\\]: a whole turn is 6.28319 in bearings_only; convert"
    with pytest.raises(ib.UserError, match=said):
        ib.estimate(model, tmp_path / "log.csv", {"ekf": ekf()})


@pytest.mark.parametrize(
    ("z", "said"), [(np.inf, "inf is not a reading"), (np.nan, "there is no reading")]
)
def test_an_array_without_readings_is_refused(z, said):
    with pytest.raises(ib.UserError, match=f"readings: {said}"):
        ib.estimate(
            replace(DRIVEN, inputs={}, next={"x": "x + w"}, count=3),
            np.full((3, 1), z),
            {"ekf": ekf()},
        )


def test_a_first_reading_at_the_time_of_the_prior_gives_the_closed_form(tmp_path):
    """x grows by t and w at each step: the mean and covariance of all readings at once."""
    model = replace(
        DRIVEN, next={"x": "x + t + k*w"}, inputs={}, count=6, step=0.5, moved_first=False
    )
    z = np.array([0.3, -0.2, 1.4, 2.0, 5.0, 6.0])
    written(tmp_path / "log.csv", model, z[:, None], time=0.5 * np.arange(6))
    (one,) = ib.estimate(model, tmp_path / "log.csv", {"ekf": ekf()})
    moved = np.array([0, 0.5, 1, 1.5, 2, 2.5]).cumsum()
    C = (
        np.tril(np.ones((6, 6)))
        @ np.diag([1.0, *(0.25 * np.arange(2, 7) ** 2)])
        @ np.triu(np.ones((6, 6)))
    )
    S = C + 0.04 * np.eye(6)
    assert one.log_likelihood == pytest.approx(multivariate_normal(moved, S).logpdf(z), rel=1e-12)
    assert one.mean[-1, 0] == pytest.approx(
        moved[-1] + C[-1] @ np.linalg.solve(S, z - moved), rel=1e-12
    )
    with pytest.raises(ib.UserError, match=r"column time: 0\.5 belongs here"):
        ib.estimate(replace(model, moved_first=True), tmp_path / "log.csv", {"ekf": ekf()})


def test_the_command_leaves_the_track_and_says_whether_the_filter_is_right(tmp_path, estimate):
    model = construct(
        next(o for o in options("state_model") if o.name == "constant_velocity").config,
        "state_model",
    )
    z = model.draw(3, 4).z[0]
    z[11] = np.nan
    written(tmp_path / "log.csv", model, z, epoch=range(1, 101))
    code, out, err = estimate(
        "state_model=constant_velocity", "readings=log.csv", "tracker=[ekf,ekf_rts]"
    )
    assert (code, err) == (0, "")
    assert all(words in out for words in ("consistent", "NIS or cost / m", "white p", "position"))
    folder = tmp_path / "outputs" / "estimate-constant_velocity"
    # As text first: pandas 2 rounds the last digit of some numbers that it reads by itself.
    table = pd.read_csv(folder / "track.csv", dtype=str).query("tracker == 'ekf'")
    track = ekf().track(model, z[None])
    np.testing.assert_array_equal(table["velocity [m/s]"].astype(float), track.mean[0, :, 1])
    np.testing.assert_array_equal(table["nis"].dropna().astype(float), np.delete(track.nis[0], 11))
    assert (
        json.loads((folder / "track.json").read_text())["trackers"]["ekf"]["verdict"]
        == "consistent"
    )
    code, out, _ = estimate(
        "state_model=constant_velocity",
        "readings=log.csv",
        "state_model.deviation.seen=0.3",
        "output=two",
    )
    assert code == 1
    assert "wrong (not white)" in out
    assert estimate("state_model=pendulum_book", "tracker=[ukf]", "output=book")[0] == 0


def test_a_model_of_formulas_may_stand_in_a_file(tmp_path, estimate):
    keys = ("next", "readings", "noise", "deviation", "spread", "inputs", "units")
    (tmp_path / "mine.yaml").write_text(json.dumps({key: getattr(DRIVEN, key) for key in keys}))
    columns = {"h": [0.5, 2.0, 1.0], "u": [0.1, 0.0, -0.3]}
    z = np.array([[0.4], [0.1], [0.9]])
    written(tmp_path / "log.csv", DRIVEN, z, **columns)
    mine = ("state_model=formulas", "state_model.file=mine.yaml")
    code, _, err = estimate(*mine, "readings=log.csv", "tracker=[ekf]", "output=one")
    assert (code, err) == (0, "")
    model = replace(
        DRIVEN, count=3, inputs={name: tuple(values) for name, values in columns.items()}
    )
    np.testing.assert_array_equal(
        pd.read_csv(tmp_path / "one" / "track.csv", dtype=str)["x [m]"].astype(float),
        ekf().track(model, z[None]).mean[0, :, 0],
    )
    (tmp_path / "copied.yaml").write_text("_target_: ipe_bench.states.Formulas")
    code, _, err = estimate(
        "state_model=formulas", "state_model.file=copied.yaml", "readings=log.csv"
    )
    assert code == 2
    assert (
        "state_model.file=copied.yaml: has a _target_; the model is chosen by state_model=, so"
        " leave it out" in err
    )


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["readings=absent.csv"], "readings=absent.csv: there is no such file"),
        ([], "readings: is not given; write readings=FILE, with the columns u,h,z"),
        (
            ["readings=short.csv"],
            "readings=short.csv: column h is missing (the header must be u,h,z)",
        ),
        (
            ["readings=more.csv"],
            "readings=more.csv: column note is not understood; remove it, or set ignore_columns",
        ),
        (
            ["readings=order.csv"],
            "readings=order.csv: row 4, column epoch: 3 belongs here; give a row for each epoch",
        ),
        (
            ["readings=time.csv"],
            "readings=time.csv: row 3, column time [s]: 2 belongs here; give a row for",
        ),
        (
            ["readings=hole.csv"],
            "readings=hole.csv: row 3, column u: is empty; a known input has a value at each",
        ),
        (["readings=blank.csv"], "readings=blank.csv: has no reading"),
        (
            ["readings=gap.csv"],
            "readings=gap.csv: row 3: is empty; if a reading is missing there, number the rows in",
        ),
        (
            ["readings=[good.csv,good.csv]"],
            "readings: good.csv is given twice; name each file once",
        ),
        (["readings=good.csv", "tracker=[nothing]"], "tracker=nothing: there is no such option"),
        (
            ["readings=good.csv", "tracker=[newton]"],
            "tracker=newton: newton is a solver, not a tracker",
        ),
        (
            ["readings=good.csv", "baseline=[ekf]"],
            "baseline: is of a measurement, and state_model= chooses",
        ),
        (
            ["readings=good.csv", "measurement=gins"],
            "measurement: is of a measurement, and state_model= chooses",
        ),
        (
            ["readings=good.csv", "ignore_rows=[2]"],
            "ignore_rows=[2]: there is no such key; did you mean ignore_columns",
        ),
        (["readings=good.csv", "ignore_columns=[v]"], "ignore_columns=v: there is no such column"),
        (
            ["readings=good.csv", "state_model.inputs.u=[1,2]"],
            "state_model.inputs.u: has 2 numbers; give one",
        ),
    ],
)
def test_what_is_no_log_of_the_model_is_refused(words, complaint, tmp_path, estimate):
    good = {"u": [1.0, 2.0, 3.0], "h": [1.0] * 3, "z": [0.1, 0.2, 0.3]}
    changes = {
        "short": {"h": None},
        "more": {"note": [1, 2, 3]},
        "order": {"epoch": [1, 2, 4]},
        "good": {},
    }
    changes |= {
        "time": {"time [s]": [1, 1.5, 3]},
        "hole": {"u": [1.0, None, 3.0]},
        "blank": {"z": [None] * 3},
    }
    changes["gap"] = {name: [values[0], None, values[2]] for name, values in good.items()}
    for name, change in changes.items():
        columns = {key: value for key, value in {**good, **change}.items() if value is not None}
        pd.DataFrame(columns).to_csv(tmp_path / f"{name}.csv", index=False)
    options = (
        "next.x=x+h*u+w",
        "noise.w=1",
        "readings.z=x",
        "deviation.z=1",
        "spread.x=1",
        "inputs={u:0,h:1}",
    )
    code, _, err = estimate(
        "state_model=formulas", *(f"state_model.{one}" for one in options), *words
    )
    assert code == 2
    assert err.splitlines()[-1].startswith(f"ipe-bench: {complaint}")
    assert not list(tmp_path.rglob("track.csv"))


def test_a_model_in_python_has_the_epochs_that_it_says(tmp_path):
    model = ConstantVelocity(count=12)
    written(tmp_path / "log.csv", model, model.draw(0, 1).z[0, :11])
    with pytest.raises(ib.UserError, match="has 11 rows, and constant_velocity 12 epochs"):
        ib.estimate(model, tmp_path / "log.csv")
    with pytest.raises(
        ib.UserError, match=r"readings: has shape \(3, 1\), where \(12, 1\) belongs"
    ):
        ib.estimate(model, np.zeros((3, 1)))


def test_estimates_of_constants_and_of_states_are_told_apart():
    model, z = ConstantVelocity(count=12), np.zeros((12, 1))
    with pytest.raises(
        ib.UserError, match=r"estimators\.ekf: estimates constants; a state model takes trackers"
    ):
        ib.estimate(model, z, {"ekf": ib.baselines.EKF()})  # pyright: ignore
    with pytest.raises(ib.UserError, match="noise=: is of a measurement"):
        ib.estimate(model, z, noise=ib.noise.Gaussian(1.0))  # pyright: ignore
    constant = ib.measurements.Polynomial()
    with pytest.raises(ib.UserError, match=r"estimators: ekf: .* is a Filter; give an estimator"):
        ib.estimate(constant, np.zeros(constant.m), {"ekf": ekf()})  # pyright: ignore


def test_the_worst_epochs_of_a_log_are_named():
    """A spike of ten deviations at epoch 30, from which the filter comes back at epoch 31; none in
    the same log without it."""
    model = replace(DRIVEN, next={"x": "x + w"}, inputs={}, count=60)
    z = model.draw(0, 1, seed=3).z[0]
    trackers = {"ekf": ekf(), "ekf_rts": Smoother(ekf())}
    assert [one.notes for one in ib.estimate(model, z, trackers)] == [[], []]
    z[29] += 10 * 0.6
    filtered, _ = ib.estimate(model, z, trackers)
    (said,) = filtered.notes
    assert said.startswith("outliers, whose readings are further")
    assert f"time steps 31 (NIS {filtered.nis[30]:.3g}), 30 (NIS {filtered.nis[29]:.3g});" in said


def test_each_of_several_logs_has_its_track_and_page(ipe_bench, tmp_path):
    (tmp_path / "a.csv").write_text("z\n1\n2\n3\n")
    (tmp_path / "b.csv").write_text("z\n5\n4\n")
    model = "next.x=x+w readings.z=x noise.w=1 deviation.z=1 spread.x=5"
    given = [f"state_model.{word}" for word in model.split()]
    words = ["tracker=[ekf]", "readings=[a.csv,b.csv]", "figures=none", "output=out"]
    code, out, _ = ipe_bench("estimate", "state_model=formulas", *given, *words)
    assert code == 0
    assert out.index("Log a") < out.index("Log b")
    found = sorted(file.name for file in (tmp_path / "out").iterdir())
    assert found == ["track-a.csv", "track-a.html", "track-b.csv", "track-b.html", "track.json"]
    assert len((tmp_path / "out" / "track-b.csv").read_text().splitlines()) == 3
    stored = json.loads((tmp_path / "out" / "track.json").read_text())
    assert [*stored["logs"]] == ["a", "b"]
    (_, alone, _) = ipe_bench(
        "estimate", "state_model=formulas", *given, *words[:1], "readings=b.csv"
    )
    states = [part.split()[4:8] for part in out.split("last time step")]
    assert alone.split("last time step")[1].split()[4:8] == states[2]


def test_the_folder_of_an_estimate_is_kept_for_its_files_and_what_is_left_out(
    ipe_bench, tmp_path, monkeypatch
):
    (tmp_path / "a.csv").write_text("z,remark\n1,x\n2,y\n3,z\n")
    (tmp_path / "below").mkdir()
    (tmp_path / "below" / "a.csv").write_text("z\n7\n8\n9\n")
    model = "next.x=x+w readings.z=x noise.w=1 deviation.z=1 spread.x=5"
    given = [f"state_model.{word}" for word in model.split()]
    words = ["state_model=formulas", *given, "tracker=[ekf]", "readings=a.csv", "figures=none"]
    words.append(f"output={tmp_path / 'out'}")
    for _ in range(2):  # the same command has its folder again
        assert ipe_bench("estimate", *words, "ignore_columns=[remark]")[0] == 0
    (tmp_path / "a.csv").write_text("z\n1\n2\n3\n")
    for folder in (tmp_path, tmp_path / "below"):
        monkeypatch.chdir(folder)
        code, _, err = ipe_bench("estimate", *words)
        assert (code, "contains results of another command" in err) == (2, True)


def test_status_says_what_a_folder_of_an_estimate_has(ipe_bench, tmp_path):
    (tmp_path / "a.csv").write_text("z\n1\n2\n3\n")
    model = "next.x=x+w readings.z=x noise.w=1 deviation.z=1 spread.x=5"
    given = [f"state_model.{word}" for word in model.split()]
    words = ["tracker=[ekf]", "readings=a.csv", "figures=none", "output=out"]
    assert ipe_bench("estimate", "state_model=formulas", *given, *words)[0] == 0
    code, out, _ = ipe_bench("status", "out")
    assert (code, out) == (0, "out: complete: track.html\n")
    (tmp_path / "a.csv").write_text("z\n1\n2\n4\n")
    assert ipe_bench("status", "out")[1] == "out: complete: track.html; but a.csv changed since\n"
    (tmp_path / "out" / "track.json").write_text('{"command": {}, "readings": [3]}')
    code, _, err = ipe_bench("status", "out")
    assert (code, "contains no results of ipe-bench" in err) == (2, True)


@pytest.mark.parametrize(
    ("outliers", "lost"), [([39], None), ([38, 39], None), ([*range(30, 40)], 31)]
)
def test_outliers_at_the_end_of_a_log_are_no_lost_track(outliers, lost):
    nis = np.ones(40)
    nis[outliers] = 60.0
    assert logs._lost_from(nis, np.ones(40)) == lost
