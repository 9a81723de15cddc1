"""What simulated data sets say of estimators is what is known of them: of linear models by theory,
and of two answers that fit by construction."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import ipe_bench as ib
from ipe_bench.basics.errors import UserError
from ipe_bench.cli.questions import question
from ipe_bench.plugins import standard
from ipe_bench.questions.own.answer import (
    advice,
    frame,
    hardest,
    headline,
    sentences,
    taken,
    takes_one,
)
from ipe_bench.questions.own.levels import by_levels
from ipe_bench.questions.own.maths import Claim, Own, Point, _claims, _Truth, own
from ipe_bench.questions.own.tracks import own_log
from ipe_bench.questions.question import Asked
from ipe_bench.real.estimation import Question
from ipe_bench.real.logs import Log
from ipe_bench.statistics.intervals import clopper_pearson

T = np.arange(12.0)
LEAST_SQUARES = {"newton": ib.solvers.Newton(), "lm": ib.baselines.LevenbergMarquardt()}


def asked(formula: str, start: dict[str, float], z: Any, **stated: Any) -> Question:
    t = np.arange(float(len(z)))
    model = ib.measurements.Formula(formula, start, columns={"t": t.tolist()})
    answers = {"lm": ib.baselines.LevenbergMarquardt()}
    return Question(model=model, readings=np.asarray(z), estimators=answers, **stated).checked()


def line(noise: Any = None, **stated: Any) -> Question:
    """Six readings: with four degrees of freedom the law of the level counts."""
    z = 3.0 + 0.5 * T[:6] + 0.2 * np.random.default_rng(3).standard_normal(6)
    return asked("a*t + b", {"a": 1.0, "b": 1.0}, z, noise=noise, **stated)


@pytest.mark.parametrize("name", ["design", "posterior"])
def test_every_option_of_a_question_tells_its_commands_apart(name: str) -> None:
    """Else two answers would share a folder."""
    told = {}

    def folder(name: str, identity: dict[str, Any], files: Any) -> Any:
        told.update(identity)
        raise UserError("enough")

    scenario = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(1.0))
    asked = Asked("line", scenario, LEAST_SQUARES, None, folder)
    with pytest.raises(UserError, match="enough"):
        question(name).run(asked)
    assert told.keys() >= question(name).options().keys()


@pytest.mark.parametrize("noise", [None, ib.noise.Gaussian(0.2)])
def test_intervals_of_a_line_hold_the_truth_in_95_percent(noise: Any) -> None:
    """By Student's t if the level is estimated, and by the normal law if it is stated."""
    found = own(line(noise), LEAST_SQUARES, 1000)
    (point,) = found.points
    for one in point.claims:
        assert one.found == 1000
        # The worse of two shares with a standard deviation of .7 %.
        assert 0.925 < one.holds < 0.965
        assert one.factor == pytest.approx(1.0, abs=0.12)
    slope = np.polyfit(T[:6], line().found.z, 1)
    np.testing.assert_allclose([point.at["a"], point.at["b"]], slope, rtol=1e-6)


def test_intervals_with_a_level_by_group_are_those_that_an_estimate_reports() -> None:
    """Of each simulated data set, estimated anew by itself."""
    t = np.arange(20.0)
    model = ib.measurements.Formula(
        "a*t + b + 0*g", {"a": 1.0, "b": 1.0}, columns={"t": t.tolist(), "g": [1, 2] * 10}
    )
    rng = np.random.default_rng(3)
    sigma = np.array([5.0, 0.1] * 10)
    z = 3.0 + 0.5 * t + sigma * rng.standard_normal(20)
    noise = ib.noise.Unknown(by="g")
    lm = {"lm": ib.baselines.LevenbergMarquardt()}
    (found,) = ib.estimate(model, z, lm, noise=noise, examine=False)
    problem = replace(found.given.problem, R=found.assumed.R)
    x = found.inner[:2]
    draws = model.simulate(x[None]) + sigma * rng.standard_normal((5, 20))
    known = lm["lm"].estimate(problem, draws)
    reported = by_levels(found.estimated, problem, x, draws - model.simulate(known.x))
    for k, one in enumerate(draws):
        (alone,) = ib.estimate(model, one, lm, noise=noise, examine=False)
        low, high = np.array(alone.interval())[:, :2]
        half = np.sqrt(np.diag(known.covariance[k])) * reported.width[k]
        np.testing.assert_allclose(known.x[k] + reported.shift[k], (low + high) / 2, rtol=1e-4)
        np.testing.assert_allclose(half, (high - low) / 2, rtol=1e-3)


def test_a_prior_is_told_to_filters_and_is_no_part_of_the_truth() -> None:
    """With ten sizes MAP is least squares; without a stated prior it is not ranked."""
    both = {**LEAST_SQUARES, "map_lm": ib.baselines.MapLM()}
    found = own(line(), both, 100)
    alone = own(line(), LEAST_SQUARES, 100)
    assert next(one for one in found.points[0].claims if not one.told).held == (
        alone.points[0].claims[0].held
    )
    rows = frame(found)
    told = rows[rows["estimator"] == "map_lm"]
    assert told["prior"].tolist() == ["start ± 100 %", "start ± 1000 %"]
    assert not told["ranked"].any()
    assert told["finds"].iloc[1] == 1.0
    stated = own(line(error_scale=5.0), both, 50)
    assert frame(stated).query("estimator == 'map_lm'")["ranked"].all()


def test_two_answers_that_fit_are_both_truths() -> None:
    """(a - 1)^2 t - a has the same sum of squares on both sides of nearly 1; starts decide."""
    z = 4.0 * T + 0.3 * np.random.default_rng(1).standard_normal(len(T))
    question = asked("(a - 1)**2 * t + 0.001*a", {"a": 3.5}, z)
    found = own(question, LEAST_SQUARES, 60)
    assert sorted(round(point.at["a"]) for point in found.points) == [-1, 3]
    shares = {round(point.at["a"]): point.claims[1].finds for point in found.points}
    assert shares[3] == 1.0
    assert any(one.startswith("Your data have 2 answers that fit: ") for one in sentences(found))
    # The curve is found wherever the truth is, and the intervals are about one of the two.
    assert "whichever of 2 answers that fit is right: take" in headline(found)
    assert "its error bars of a are too small by far (0 to " in headline(found)
    assert hardest(found).claims[0].held == 0


def test_answers_beyond_three_are_said_to_be_left_out() -> None:
    """The slope is 4 at a = 1, 2, ..., 5."""
    z = 4.0 * T + 0.3 * np.random.default_rng(1).standard_normal(len(T))
    slope = "4 + (a - 1)*(a - 2)*(a - 3)*(a - 4)*(a - 5)"
    found = own(asked(f"({slope})*t + 0.001*a", {"a": 3.2}, z, error_scale=1.0), LEAST_SQUARES, 5)
    assert len(found.points) == 3
    number = 3 + found.further
    assert found.further >= 1
    assert f"whichever of the best 3 of {number} answers that fit is right" in headline(found)
    assert any(f"have {number} answers that fit: " in one for one in sentences(found))


@dataclass(frozen=True)
class Turned(ib.Estimator):
    """Gives the answer of least squares with the other sign in every second trial."""

    def estimate(self, problem: Any, z: Any, *, history: bool = False) -> ib.Estimates:
        found = ib.baselines.LevenbergMarquardt().estimate(problem, z)
        found.x[::2] *= -1
        return found


def test_a_minimum_that_does_not_fit_is_no_truth() -> None:
    """A cosine has a minimum for each of many frequencies, and one of them fits."""
    z = np.cos(0.5 * np.arange(30.0)) + 0.1 * np.random.default_rng(1).standard_normal(30)
    found = own(asked("cos(w*t)", {"w": 0.52}, z), LEAST_SQUARES, 20)
    assert [point.at["w"] for point in found.points] == [pytest.approx(0.5, abs=0.01)]


def test_copies_of_the_same_curve_count_as_found() -> None:
    """The sign of a is open in a^2 t; every answer has the right curve and the right bars."""
    z = 4.0 * T + 0.3 * np.random.default_rng(1).standard_normal(len(T))
    found = own(asked("a**2 * t", {"a": -3.0}, z), {"turned": Turned()}, 300)
    (point,) = found.points
    assert point.at["a"] == pytest.approx(-2.0, abs=0.05)
    assert point.claims[0].found == 300
    assert 0.91 < point.claims[0].holds < 0.98


@pytest.mark.parametrize(
    ("z", "stated", "said"),
    [
        (3.0 + T**2, {"noise": ib.noise.Gaussian(0.1)}, "does not fit the readings"),
        (np.sin(np.arange(60.0) / 6), {}, "successive residuals resemble each other"),
    ],
)
def test_a_rejected_fit_is_refused(z: Any, stated: Any, said: str) -> None:
    with pytest.raises(UserError, match=said):
        own(asked("a*t + b", {"a": 1.0, "b": 1.0}, z, **stated), LEAST_SQUARES, 10)


def claim(label: str, found: int, held: int = 190, **changed: Any) -> Claim:
    one = Claim(label, "", 200, found, (held,), "a", 1.0, 10.0, 0.001)
    return replace(one, **changed)


def test_the_cheapest_of_those_that_do_as_well_is_taken_and_the_others_costs_are_named() -> None:
    claims = [
        claim("auto", 200, cost=24.0),
        claim("newton", 200, cost=5.0),
        claim("as dear", 200, cost=5.0),
        claim("lm", 199, cost=10.0),
        claim("ekf", 100, cost=1.0),
    ]
    found = Own(200, [Point({"a": 1.0}, claims)], "1", True, {})
    # By Clopper and Pearson, 190 of 200 are 91.0 to 97.6 %.
    assert headline(found).startswith(
        "On 200 simulated data sets like yours: take newton; its error bars are about right (91 to"
        " 98 % contain the truth); ekf misses the best fit in about 50 %"
    )
    assert list(sentences(found)) == [
        "Those that do as well from this start cost more than newton: lm 2 times, auto 4.8 times as"
        " much."
    ]


def test_right_error_bars_come_before_cost_and_finding_before_both() -> None:
    claims = [
        claim("auto", 200, 150, factor=1.9, cost=1.0),
        claim("newton", 199, cost=9.0),
        claim("lm", 170, cost=2.0),
    ]
    found = Own(200, [Point({"a": 1.0}, claims)], "1", True, {})
    assert getattr(taken(found, found.points[0]), "label", "") == "newton"
    alone = Own(200, [Point({"a": 1.0}, claims[:1])], "1", True, {})
    assert "its error bars of a are too small by about 1.9 (68 to 81 %" in headline(alone)


def test_the_range_of_the_worst_of_several_shares_holds_it() -> None:
    """The least of eight shares is below each, so that the range of one would miss it in one of
    seven; and 17 of 20 do not make bars too small."""
    draws = np.random.default_rng(2).binomial(200, 0.95, (1000, 8)).tolist()
    held = 0
    for counts in draws:
        low, high = claim("lm", 200, inside=tuple(counts)).holds_between
        held += low <= 0.95 <= high
    assert held >= 950
    alone = [clopper_pearson(min(counts), 200) for counts in draws]
    assert sum(low <= 0.95 <= high for low, high in alone) < 900
    few = Own(20, [Point({"a": 1.0}, [claim("lm", 20, 17, trials=20)])], "1", True, {})
    assert "its error bars are about right (62 to 97 % contain the truth)" in headline(few)


def test_none_is_taken_where_the_best_misses() -> None:
    found = Own(200, [Point({"a": 1.5}, [claim("auto", 20), claim("lm", 10)])], "1", True, {})
    assert advice(found, found.points[0]) == (
        "take none: from this start the best, auto misses the best fit in about 90 %; start"
        " elsewhere, such as at a = 1.5"
    )


def test_logs_of_a_linear_model_hold_their_intervals() -> None:
    """Of a random walk the Kalman filter is exact, and begins where the log does."""
    model = ib.states.Formulas(
        next={"x": "x + w"},
        readings={"z": "x"},
        noise={"w": 0.3},
        deviation={"z": 0.5},
        spread={"x": 2.0},
        count=25,
    )
    z = model.draw(0, 1, 5).z[0]
    trackers = standard.constructed({"tracker": ("auto", "ekf")})
    found = own_log(Log(model, z), trackers, 200)
    for one in found.points[0].claims:
        assert one.found == 200
        assert 0.90 < one.holds < 0.99
    with pytest.raises(UserError, match="does not fit the log"):
        own_log(Log(model, z + np.linspace(0, 80, 25)[:, None] ** 2), trackers, 5)


def test_long_logs_have_fewer_simulated_ones_and_none_beyond_a_limit(
    ipe_bench: Any, tmp_path: Path, monkeypatch: Any
) -> None:
    told: list[int] = []

    def simulated(log: Log, trackers: Any, trials: int, *others: Any) -> Own:
        told.append(trials)
        raise UserError("enough")

    monkeypatch.setattr("ipe_bench.questions.own.tracks.own_log", simulated)
    monkeypatch.setattr("ipe_bench.cli.own._MOST_EPOCHS", 1000)
    monkeypatch.setattr("ipe_bench.cli.own._LONGEST", 60)
    (tmp_path / "walk.yaml").write_text(
        "next: {x: x + w}\nreadings: {z: x}\nnoise: {w: 1}\ndeviation: {z: 1}\nspread: {x: 1}\n"
    )
    for rows in (5, 20, 60, 61):
        (tmp_path / "log.csv").write_text("z\n" + "1\n" * rows)
        code, _, err = ipe_bench("run", "walk.yaml", "log.csv")
        assert code == 2
    assert told == [100, 50, 20]
    assert "log.csv: has 61 rows, and logs of at most 60 are simulated" in err


@pytest.mark.slow
def test_the_command_writes_what_it_says(ipe_bench: Any, tmp_path: Path) -> None:
    rows = [f"{t},{3 + 0.5 * t + 0.1 * (-1) ** (t // 2)}" for t in range(12)]
    (tmp_path / "line.csv").write_text("\n".join(["t,y", *rows]) + "\n")
    code, out, err = ipe_bench("run", "a*t + b", "line.csv", "trials=20", "solver=[newton]")
    assert code == 0, err
    said = out.split("Readings:")[1]
    assert "On 20 simulated data sets like yours: take" in said
    folder = tmp_path / "outputs/run-formula"
    assert (folder / "own.csv").read_text().startswith("truth,estimator,prior,ranked,trials,finds")
    assert "On 20 simulated data sets like yours: take" in (folder / "own.html").read_text()


def ranges() -> tuple[ib.Measurement, Any, float]:
    """Ranges from three points that nearly lie on a line, with a start on the wrong side of it."""
    ax = np.tile([0.0, 10.0, 20.0], 4)
    columns = {"ax": ax.tolist(), "ay": np.where(ax == 10, 1.0, 0.0).tolist()}
    start = {"x": 10.0, "y": -2.0}
    return (
        ib.measurements.Formula("sqrt((x-ax)^2+(y-ay)^2)", start, columns, reading="range"),
        [8.0, 6.0],
        0.8,
    )


def oxygen() -> tuple[ib.Measurement, Any, float]:
    columns = {"t": [1.0, 2.0, 3.0, 4.0, 5.0, 7.0]}
    start = {"b1": 20.0, "b2": 0.5}
    return ib.measurements.Formula("b1*(1-exp(-b2*t))", start, columns), [19.14, 0.531], 2.55


def true_shares(model: ib.Measurement, x: Any, s: float, number: int) -> dict[str, Claim]:
    """What the estimators do on fresh data sets of the truth itself."""
    truth = np.array(x) / model.sizes
    h = model.simulate(truth[None])[0]
    problem = ib.Scenario(model, ib.noise.Gaussian(s)).problem.without_prior()
    given = SimpleNamespace(noise=ib.noise.Unknown())
    free = len(h) - model.n
    fit: Any = SimpleNamespace(given=given, degrees_of_freedom=free, estimated=None)
    z = h + s * np.random.default_rng(1).standard_normal((number, len(h)))
    claims = _claims(fit, problem, LEAST_SQUARES, _Truth(truth, (truth,)), z, lambda _: str)
    return {one.label: one for one in claims}


@pytest.mark.campaign
@pytest.mark.parametrize(("case", "off"), [(oxygen, 0.12), (ranges, 0.15)])
def test_what_is_said_from_one_data_set_is_true_of_a_thousand_others(case: Any, off: float) -> None:
    """Of the worse of the answers that fit: a mirror that fits better by chance is not believed."""
    model, x, s = case()
    true = true_shares(model, x, s, 1000)
    h = model.simulate(np.array([x]) / model.sizes)[0]
    errors = []
    within = []
    for number in range(24):
        z = h + s * np.random.default_rng(100 + number).standard_normal(len(h))
        asked = Question(model=model, readings=z, estimators={"auto": ib.solvers.Auto()}).checked()
        try:
            found = own(asked, LEAST_SQUARES, 60, number)
        except UserError:
            continue
        claims = hardest(found).claims
        errors += [[one.finds - true[one.label].finds for one in claims]]
        errors[-1] += [one.holds - true[one.label].holds for one in claims]
        best = taken(found, hardest(found))
        if takes_one(found) and best is not None:
            low, high = best.holds_between
            within.append(low <= true[best.label].holds <= high)
    assert len(errors) >= 20
    success, coverage = np.split(np.array(errors), 2, axis=1)
    assert np.sqrt(np.mean(success**2)) < off
    assert np.sqrt(np.mean(coverage**2)) < off
    assert success.max() < 0.35
    assert np.mean(within or [True]) > 0.8
