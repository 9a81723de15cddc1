"""`compare` finds what is there, nothing where there is nothing, and says which trials it
compared."""

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from scipy.stats import binom, binomtest, chi2
from shared.families import slow_if
from shared.synthetic_store import Pretender, Synthetic, forge

import ipe_bench as ib
from ipe_bench.cli.main import main
from ipe_bench.plugins import discovery
from ipe_bench.questions.compare.answer import finding
from ipe_bench.trials.thresholds import FEW, GATE

ERROR = 0.1
"""The bound's deviation in the synthetic stores."""


def store(
    folder,
    *,
    seed=0,
    factor=1.0,
    trials=200,
    label="it",
    draws=0,
    estimator=None,
    fails=0,
    **scenario,
):
    """A folder in which one estimator errs by `factor` times the bound, and fails in the first
    `fails` trials."""
    filled = Synthetic(folder)
    error = factor * ERROR * np.random.default_rng(draws).standard_normal((trials, 3))
    error[:fails] = 1e3
    given = {"success": np.arange(trials) >= fails} if fails else {}
    filled.add(filled.scenario(seed=seed, **scenario), label, error, estimator=estimator, **given)
    filled.record(trials)
    return folder


def changed(tmp_path, first: dict, second: dict, trials=1000, n=3, **options):
    """The rows of a comparison of two stores of the same trials, by quantity, where `error` and
    other columns of each are functions of the same normal deviates (trials, n) in deviations of the
    bound."""
    for name, columns in (("a", first), ("b", second)):
        filled, columns = Synthetic(tmp_path / name), dict(columns)
        deviates = np.random.default_rng(0).standard_normal((trials, n))
        error = ERROR * columns.pop("error", np.array)(deviates)
        filled.add(filled.scenario(), "it", error, **columns)
    return ib.compare(tmp_path / "a", tmp_path / "b", **options).set_index("quantity")


def findings(frame: pd.DataFrame) -> dict[str, str]:
    return frame.set_index("quantity")["finding"].to_dict()


def test_the_same_trials_are_compared_one_by_one(tmp_path):
    """Errors half as large in every trial: a ratio of exactly 2, however much the trials differ
    among themselves. None of 200 trials has another one, so at most 1 - .025^(1/200) of all have
    (Clopper and Pearson)."""
    a, b = store(tmp_path / "a", factor=0.5), store(tmp_path / "b", factor=1.0)
    rows = ib.compare(a, b).set_index("quantity")
    assert rows.loc["error", "change"] == pytest.approx(2.0)
    reach = (1 - 0.025 ** (1 / 200)) * np.sqrt(chi2.isf(GATE, 3)) / rows.loc["error", "first_value"]
    assert rows.loc["error", "low"] == pytest.approx(2.0 - reach)
    assert rows.loc["error", "high"] == pytest.approx(2.0 + reach)
    assert (rows["matched_by"] == "trial").all()
    assert findings(ib.compare(a, b)) == {"success": "", "error": "worse", "cost": "", "time": ""}
    assert findings(ib.compare(b, a))["error"] == "better"


def test_trials_are_matched_by_their_numbers(tmp_path):
    """The second folder lacks the first hundred trials: the others are compared with their own."""
    a = store(tmp_path / "a", trials=300)
    filled = Synthetic(tmp_path / "b")
    error = ERROR * np.random.default_rng(0).standard_normal((300, 3))
    filled.add(filled.scenario(), "it", 1.2 * error[100:], start=100)
    row = ib.compare(a, tmp_path / "b").set_index("quantity").loc["error"]
    assert row["trials"] == 200
    assert row["change"] == pytest.approx(1.2)


def test_other_seeds_are_matched_in_their_order_and_it_is_said(tmp_path, capsys):
    a, b = store(tmp_path / "a"), store(tmp_path / "b", seed=1, draws=1, trials=150)
    frame = ib.compare(a, b)
    assert (frame["matched_by"] == "order").all()
    assert (frame["trials"] == 150).all()
    assert main(["compare", str(a), str(b)]) == 0
    assert "150 trials of other seeds, matched in their order" in " ".join(
        capsys.readouterr().out.split()
    )


def test_failures_are_found_worse_and_the_exit_code_says_so(tmp_path, capsys):
    a, b = store(tmp_path / "a"), store(tmp_path / "b", fails=15)
    assert main(["compare", str(a), str(b)]) == 1
    out = capsys.readouterr().out
    assert "worse: it in success" in out
    assert max(len(line) for line in out.splitlines() if "│" in line or "%" in line) <= 120
    assert main(["compare", str(b), str(a)]) == 0
    row = ib.compare(a, b).set_index("quantity").loc["success"]
    assert row["change"] == pytest.approx(-15 / 200)
    assert row["p"] == pytest.approx(3 * 2 * 0.5**15)  # McNemar's p, corrected for three questions


def test_what_may_be_worse_is_for_the_user_to_say(tmp_path):
    a = store(tmp_path / "a")
    filled = Synthetic(tmp_path / "b")
    error = ERROR * np.random.default_rng(0).standard_normal((200, 3))
    filled.add(filled.scenario(), "it", error, simulations=9.0)
    assert main(["compare", str(a), str(tmp_path / "b")]) == 0
    assert main(["compare", str(a), str(tmp_path / "b"), "fail_on=success,error,cost"]) == 1


def test_what_is_missing_in_the_second_is_not_passed_over(tmp_path, capsys):
    a, b = store(tmp_path / "a"), store(tmp_path / "b")
    Synthetic(b)
    filled = Synthetic(b)
    filled.add(filled.scenario(), "it", np.zeros((1, 3)), start=900)
    filled.record(1000, "later")
    assert main(["compare", str(a), str(b)]) == 1
    assert "missing" in capsys.readouterr().err


def test_two_estimators_of_one_folder(tmp_path):
    folder = store(tmp_path / "a", label="good", factor=0.5)
    store(folder, label="bad", factor=0.6)
    assert findings(ib.compare(folder, first="good", second="bad"))["error"] == "worse"
    assert findings(ib.compare(folder, first="bad", second="good"))["error"] == "better"


def test_options_that_differ_under_one_label_are_named_wherever_they_stand(tmp_path, capsys):
    """In the title of the table, and where it is said what is worse."""
    a = store(tmp_path / "a", estimator=Pretender(option=5))
    b = store(tmp_path / "b", estimator=Pretender(option=6), factor=2.0)
    assert main(["compare", str(a), str(b)]) == 1
    lines, title = capsys.readouterr().out.splitlines(), "estimator.option 5 | 6"
    assert sum(title in line for line in lines if line.endswith("200 trials")) == 1
    assert sum(title in line for line in lines if line.startswith("worse: it in error")) == 1


def test_scenarios_of_one_folder_alone_are_left_out_and_it_is_said(tmp_path):
    a, b = store(tmp_path / "a"), store(tmp_path / "b")
    store(a, error_scale=7.0)
    frame = ib.compare(a, b)
    assert frame["error_scale"].tolist() == [1.0] * 4
    assert "1 scenarios that the other lacks are left out" in frame.attrs["notes"][0]


def test_so_few_trials_that_none_can_be_worse_are_named(tmp_path):
    """Success, error and cost at 5 %: with seven trials the least p is 2/128 and, three times as
    large, .047."""
    for trials, word in ((6, ""), (7, "worse")):
        folders = [store(tmp_path / f"{trials} {name}", trials=trials) for name in "ab"]
        folders[1] = store(tmp_path / f"{trials} c", trials=trials, fails=trials)
        frame = ib.compare(*folders)
        assert findings(frame)["success"] == word
        line = "common trials: 6 are too few for any finding in 3 tests; run at least 7"
        assert frame.attrs["notes"] == ([] if word else [line])


def test_judging_by_evidence(tmp_path):
    """Three questions at 5 %: evidence of 60 is needed, which nine failures of one alone give.
    Eight give 50, which is enough for one question only."""
    a = store(tmp_path / "a")
    rows = [
        ib.compare(a, store(tmp_path / f"{k}", fails=k), anytime=True)
        .set_index("quantity")
        .loc["success"]
        for k in (8, 9, 20)
    ]
    assert 20 < rows[0]["e"] < 60 <= rows[1]["e"] < rows[2]["e"]
    assert [row["finding"] for row in rows] == ["", "worse", "worse"]


def test_costs_are_judged_by_their_means_alone(tmp_path):
    """Cheaper in 90 % of 400 trials and so much dearer in the others that the mean ratio is 1.01:
    neither the p nor evidence finds the second worse, as a test of signs would find it better."""
    folders = []
    for name, costs in (
        ("a", np.full(400, 100.0)),
        ("b", np.where(np.arange(400) % 10 > 0, 50.0, 560.0)),
    ):
        filled = Synthetic(tmp_path / name)
        error = ERROR * np.random.default_rng(0).standard_normal((400, 3))
        filled.add(filled.scenario(), "it", error, simulations=costs)
        filled.record(400)
        folders.append(tmp_path / name)
    row = ib.compare(*folders, anytime=True).set_index("quantity").loc["cost"]
    assert row["change"] == pytest.approx(1.01)
    assert row["p"] > 0.5
    assert row["e"] < 1
    assert row["finding"] == ""


ALL = ("success", "error", "honesty", "bias", "cost")


def shifted(by: float, every: int = 1):
    """Adds a bias to the second parameter, in every so many of the trials."""
    return lambda e: e + by * np.outer(np.arange(len(e)) % every == 0, [0.0, 1.0, 0.0])


def level(nees: float):
    """Scales the errors to this mean square."""
    return lambda e: e * np.sqrt(nees / (e**2).mean())


MATTERS = [
    ({}, {}, {}),
    ({}, {"deviation": ERROR * np.sqrt(0.9)}, {"honesty": "worse"}),
    (
        {"deviation": ERROR * np.sqrt(2)},
        {"deviation": ERROR / np.sqrt(1.02)},
        {"honesty": "better"},
    ),
    ({"deviation": ERROR * np.sqrt(2)}, {"deviation": ERROR / np.sqrt(2)}, {}),
    # 0.96 is 1 within chance: 1.08 is farther from 1, though hardly farther than 0.96.
    (
        {"error": level(0.96)},
        {"error": level(0.96), "deviation": ERROR / np.sqrt(1.12)},
        {"honesty": "worse"},
    ),
    ({}, {"deviation": np.nan}, {"honesty": "worse"}),
    ({}, {"status": "max_iterations"}, {"honesty": "worse"}),
    ({}, {"error": shifted(0.3)}, {"bias of b": "worse"}),
    ({}, {"error": shifted(0.15, 2)}, {}),
    ({}, {"error": lambda e: 1.05 * e, "deviation": 1.05 * ERROR}, {"error": "worse"}),
    ({}, {"simulations": 6.0}, {"cost": "worse"}),
    (
        {},
        {"error": shifted(1e3, 20)},
        {"success": "worse", "error": "worse", "honesty": "worse"},
    ),
    ({}, {"error": shifted(1e3, 125)}, {}),
]
MIRRORED = [
    ({}, {"deviation": ERROR * np.sqrt(0.97)}, {}),
    (
        {"deviation": ERROR / np.sqrt(1.02)},
        {"deviation": ERROR * np.sqrt(2)},
        {"honesty": "worse"},
    ),
    ({"deviation": np.nan}, {}, {}),
    ({}, {"error": shifted(-0.3)}, {"bias of b": "worse"}),
    ({"error": shifted(0.3)}, {"error": shifted(-0.3)}, {}),
    ({"error": shifted(0.3)}, {}, {"bias of b": "better"}),
    ({}, {"error": lambda e: 1.015 * e}, {}),
    ({}, {"simulations": 5.2}, {}),
]
"""Cases that one of the others mirrors, in sign, order or size."""


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    slow_if(lambda *case: case in MIRRORED, [*MATTERS, *MIRRORED]),
)
def test_what_matters_is_found_and_nothing_else(tmp_path, first, second, expected):
    """1,000 trials of the same errors: every change is one of all trials, or of the stated share of
    them. Eight lost trials in 1,000 are within the margin of success."""
    rows = changed(tmp_path, first, second, fail_on=ALL)
    found = {quantity: finding for quantity, finding in rows["finding"].items() if finding}
    assert found == expected
    assert [line.partition(" in ")[2].partition(",")[0] for line in rows.attrs["worse"]] == [
        quantity for quantity, finding in found.items() if finding == "worse"
    ]


def test_an_interval_that_holds_what_is_right_is_not_worse(tmp_path):
    """A bias of 0.4 that becomes -0.05 in all of 60 trials: for what may be unseen, the change is
    -1.1 to 0.2."""
    first, second = (lambda e, by=by: e - e.mean(axis=0) + [0.0, by, 0.0] for by in (0.4, -0.05))
    row = changed(tmp_path, {"error": first}, {"error": second}, trials=60, fail_on=("bias",)).loc[
        "bias of b"
    ]
    assert row["p"] < 0.001
    assert row["low"] < -0.9 < 0.1 < row["high"]
    assert row["finding"] == ""


def test_honesty_and_bias_are_those_of_the_definition(tmp_path):
    """Mean of the squared errors over the claimed variances, by n, of trials that converge in both;
    mean error."""
    e = np.random.default_rng(0).standard_normal((1000, 3))
    status = np.where(np.arange(1000) < 100, "diverged", "converged").astype(object)
    rows = changed(
        tmp_path, {}, {"error": shifted(0.2), "status": status}, fail_on=("honesty", "bias")
    )
    assert rows.loc["honesty", "first_value"] == pytest.approx((e[100:] ** 2).mean())
    assert rows.loc["bias of b", "first_value"] == pytest.approx(e[:, 1].mean())
    assert rows.loc["bias of b", "change"] == pytest.approx(0.2)
    assert rows.loc["bias of a", ["change", "p"]].tolist() == [0.0, 1.0]


def test_a_bias_is_of_the_trials_that_succeed_by_the_bound_that_divides_it(tmp_path):
    """A tenth errs by two deviations more, within the Cramér-Rao gate and outside the Bayesian
    one: an error without an estimator's success is no bias of it."""
    fails = np.arange(1000) < 100
    second = {"error": lambda e: e + 2.0 * np.outer(fails, [0.0, 1.0, 0.0]), "success": ~fails}
    for knows, bias in ((True, 0.0), (False, 0.2)):
        both = {"estimator": Pretender(knows_prior=knows)}
        rows = changed(tmp_path / str(knows), both, both | second, fail_on=("bias",))
        assert rows.loc["bias of b", "change"] == pytest.approx(bias)
        assert rows.loc["bias of b", "trials"] == (900 if knows else 1000)


@pytest.mark.parametrize(("claims", "judged"), [(FEW, FEW), (FEW - 1, 1000), (0, 1000)])
def test_honesty_is_of_common_claims_or_lost_where_a_verdict_is_left_without_any(
    tmp_path, claims, judged
):
    status = np.where(np.arange(1000) < claims, "converged", "diverged").astype(object)
    row = changed(tmp_path, {}, {"status": status}, fail_on=("honesty",)).loc["honesty"]
    assert row["trials"] == judged
    assert row["finding"] == ("" if claims == FEW else "worse")
    assert (row["second_value"] > 5) == (claims < FEW)


def test_what_no_common_trial_shows_is_a_dash(tmp_path, capsys):
    a, b = store(tmp_path / "a", trials=1), store(tmp_path / "b", trials=1, fails=1)
    main(["compare", str(a), str(b), "fail_on=bias"])
    said = capsys.readouterr().out
    assert "1 trial\n" in said
    assert "nan" not in said


@pytest.mark.slow
def test_only_what_is_asked_for_is_tested_and_changes_a_p(tmp_path):
    """Four failures of one alone: McNemar's p of 1/8, multiplied by the number of questions; three
    without fail_on."""
    a, b = store(tmp_path / "a"), store(tmp_path / "b", fails=4)
    asked = (
        None,
        ["success"],
        ["success", "honesty"],
        ["success", "bias"],
        ["cost", "success", "error"],
    )
    frames = [ib.compare(a, b, fail_on=fail_on).set_index("quantity") for fail_on in asked]
    assert [frame.loc["success", "p"] for frame in frames] == pytest.approx(
        [3 / 8, 1 / 8, 2 / 8, 4 / 8, 3 / 8]
    )
    assert [frame["p"].notna().sum() for frame in frames] == [3, 1, 2, 4, 3]
    assert frames[0].index.tolist() == ["success", "error", "cost", "time"]


def test_margins_are_for_the_user_to_say(tmp_path, capsys):
    a, b = store(tmp_path / "a", trials=1000), store(tmp_path / "b", trials=1000, factor=1.05)
    words = ["compare", str(a), str(b)]
    assert [main([*words, *more]) for more in ([], ["margin.error=0.05"], ["margin.error=0"])] == [
        1,
        0,
        1,
    ]
    assert "larger than a margin: success 0.01, error 0.05" in " ".join(
        capsys.readouterr().out.split()
    )


def test_what_is_gone_is_named_where_completeness_is_asked_for(tmp_path, capsys):
    """An estimator, half of the trials, a scenario and a covariance: a line each, and none without
    the word."""
    first, second = Synthetic(tmp_path / "a"), Synthetic(tmp_path / "b")
    error = ERROR * np.random.default_rng(0).standard_normal((200, 3))
    for label, scale in (("it", 1.0), ("it", 7.0), ("lost", 1.0), ("half", 1.0), ("mute", 1.0)):
        first.add(first.scenario(error_scale=scale), label, error)
    second.add(second.scenario(), "it", error)
    second.add(second.scenario(), "new", error)
    second.add(second.scenario(), "half", error[:100])
    second.add(second.scenario(), "mute", error, deviation=np.nan)
    words = ["compare", str(tmp_path / "a"), str(tmp_path / "b")]
    assert main(words) == 0
    assert "gone:" not in capsys.readouterr().err
    assert main([*words, "complete=true"]) == 1
    lines = [
        line.removeprefix("ipe-bench: gone: ")
        for line in capsys.readouterr().err.splitlines()
        if "gone:" in line
    ]
    at = [(line.split(",")[0], line.split(": ")[1]) for line in lines]
    assert sorted(at) == [
        ("half", "the second has 100 of its 200 trials"),
        ("it", "the second has no trials of it"),
        ("lost", "the second has no trials of it"),
        ("mute", "the second reports no covariance"),
    ]
    assert "error scale 7:" in next(line for line in lines if line.startswith("it"))
    assert main([*words, "complete=true", "first=it", "second=new"]) == 1  # at scale 7
    assert capsys.readouterr().err.count("gone:") == 1
    assert main(["compare", words[2], words[1], "first=it", "complete=true"]) == 0


def test_other_sources_of_the_bench_are_said(tmp_path, capsys):
    """A stored side grows old: an estimator's own version is what is compared, that of the truths
    is not."""
    a, b = store(tmp_path / "a"), store(tmp_path / "b")
    assert main(["compare", str(a), str(b)]) == 0
    assert "other sources" not in capsys.readouterr().err
    for path in (a / "trials").glob("*.parquet"):
        forge(path, lambda _, footer: footer["versions"].update(ipe_bench="0.2.0"))
    assert main(["compare", str(a), str(b)]) == 0
    assert f"other sources: ipe_bench 0.2.0 | {ib.__version__};" in capsys.readouterr().err


# fmt: off
MISTAKES = {
    "": "name one or two folders", "{a} {b} {a}": "name one or two folders", "{a}": "name another",
    "{a} {a}": "is compared with itself",
    "{a} first=it second=it": "it of one folder is compared with itself",
    "nowhere": "nowhere: there is no such folder",
    "{a} nowhere": "nowhere: there is no such folder",
    "{a} {b} alpha=2": "between 0 and 1", "{a} {b} alpha=x": "alpha=x: give a number",
    "{a} {b} alfa=0.1": "did you mean alpha", "{a} {b} alpha=": "give it a value",
    "{a} {b} first=it first=it": "is given twice", "{a} {b} anytime=1": "true or false",
    "{a} {b} fail_on=time": "there is no such quantity",
    "{a} {b} margin.time=1": "there is no such key",
    "{a} {b} margin.cost=-1": "margin.cost=-1.0: give a number from 0 on",
    "{a} {b} fail_on=cost power=0.9 difference=0.05": "power: concerns success",
    "{a} {b} first=nobody": "there is no such estimator", "{a} {other}": "no estimator is in both",
    "{a} {model}": "no scenario in common", "{a} {empty}": "contains no trials",
    "{a} {b} --force": "there is no such flag",
}
# fmt: on


@pytest.mark.parametrize("words", MISTAKES)
def test_mistakes_are_one_line_and_exit_code_2(tmp_path, capsys, words):
    places = {"a": store(tmp_path / "a"), "b": store(tmp_path / "b")}
    places["other"] = store(tmp_path / "other", label="them")
    places["model"] = store(tmp_path / "model", repeats=9, error_scale=3.0)
    store(places["model"], repeats=9, error_scale=4.0)
    store(places["a"], error_scale=2.0)
    places["empty"] = tmp_path / "empty"
    (places["empty"] / "trials").mkdir(parents=True)
    assert main(["compare", *(word.format(**places) for word in words.split())]) == 2
    error = capsys.readouterr().err
    assert MISTAKES[words] in error
    assert len(error.strip().splitlines()) == 1


def false_titles(tmp_path, pairs: int) -> tuple[int, int]:
    """The number of titles that claim a change of the error, and of those whose claim is false: of
    two stores of independent draws whose errors differ by a known factor."""
    claims = false = 0
    for number in range(pairs):
        factor = (1.0, 1.01, 1.0, 0.6, 1.6)[number % 5]
        a, b = tmp_path / f"{number}-a", tmp_path / f"{number}-b"
        store(a, draws=2 * number, trials=100)
        store(b, draws=2 * number + 1, factor=factor, trials=100)
        title = finding(ib.compare(a, b))
        better = re.search(r"(?<!perhaps )better in [^;]*mean error", title)
        worse = re.search(r"(?<!perhaps )worse in [^;]*mean error", title)
        claims += bool(better or worse)
        false += bool((better and factor > 0.98) or (worse and factor < 1.02))
    return claims, false


def test_the_title_says_what_is_decided(tmp_path):
    assert false_titles(tmp_path, 5) == (2, 0)


@pytest.mark.parametrize(
    "pairs",
    [pytest.param(100, marks=pytest.mark.slow), pytest.param(300, marks=pytest.mark.campaign)],
)
def test_the_title_is_false_in_few_comparisons(tmp_path, pairs):
    """Of all pairs 60 % differ by nothing, or by less than the margin."""
    claims, false = false_titles(tmp_path, pairs)
    assert claims >= 0.4 * pairs
    assert false <= 0.05 * claims


def test_the_title_has_the_change_or_the_number_of_comparisons(tmp_path):
    a, b = store(tmp_path / "a", factor=0.5), store(tmp_path / "b")
    frame = ib.compare(a, b)
    assert finding(frame).startswith("The second against the first: worse in mean error (×2.000)")
    assert "success" not in finding(frame)
    for folder in (a, b):
        store(folder, error_scale=2.0)
    assert "worse in mean error (1 of 2 comparisons)" in finding(ib.compare(a, b))
    same = finding(ib.compare(a, store(tmp_path / "c", factor=0.5, draws=1)))
    assert same.startswith(
        "The second against the first: not shown to differ by more than the margin in success, mean"
    )
    filled = store(a, label="new", factor=0.4)
    assert finding(ib.compare(filled, first="it", second="new")).startswith("new against it: ")


def test_the_table_fits_80_columns_and_files_are_written(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    a, b = store(tmp_path / "a"), store(tmp_path / "b", fails=15, factor=1.7)
    assert main(["compare", str(a), str(b), f"output={tmp_path / 'out'}"]) == 1
    lines = capsys.readouterr().out.splitlines()
    table = lines[next(i for i, line in enumerate(lines) if "second is" in line) :][:6]
    assert max(len(line.rstrip()) for line in table) <= 80
    assert {p.name for p in (tmp_path / "out").iterdir()} == {
        f"comparison.{kind}" for kind in ("csv", "html", "png")
    }
    written = pd.read_csv(tmp_path / "out" / "comparison.csv")
    assert written["quantity"].tolist() == ["success", "error", "cost", "time"]


@pytest.mark.slow
def test_newton_is_better_than_fixed_point_at_scale_100_and_costs_less(tmp_path):
    """Its coarse Jacobians cost less than the many iterations of the other's last few trials."""
    bench = ib.Scenario(ib.measurements.Gins(), ib.noise.Quantization(), error_scale=100.0)
    ib.run(
        bench,
        {"fixed_point": ib.solvers.FixedPoint(), "newton": ib.solvers.Newton()},
        600,
        output=tmp_path,
    )
    none = {
        "success": 0.0,
        "error": 0.0,
        "cost": 0.0,
    }  # the differences are sure, and some smaller than the margins
    frame = ib.compare(tmp_path, first="fixed_point", second="newton", margins=none)
    assert findings(frame) == {"success": "better", "error": "better", "cost": "better", "time": ""}
    assert not frame.attrs["worse"]
    assert ib.compare(tmp_path, first="newton", second="fixed_point", margins=none).attrs["worse"]


@pytest.mark.campaign
def test_equal_folders_of_other_seeds_are_found_different_as_rarely_as_stated(tmp_path):
    """500 pairs of folders with shares of failure of 1 in 10 and random costs: at most 5 %
    findings, up to 3 deviations, of any quantity; by evidence fewer."""
    rng = np.random.default_rng(0)
    alarms = {False: 0, True: 0}
    for number in range(500):
        folders = []
        for seed in (0, 1):
            filled = Synthetic(tmp_path / f"{number}-{seed}")
            error = ERROR * rng.standard_normal((100, 3))
            failed = rng.uniform(size=100) < 0.1
            error[failed] = 1e3
            filled.add(
                filled.scenario(seed=seed),
                "it",
                error,
                simulations=rng.integers(4, 9, 100).astype(float),
            )
            folders.append(filled.directory)
        for anytime in alarms:
            alarms[anytime] += any(findings(ib.compare(*folders, anytime=anytime)).values())
    print(f"false alarms in 500: {alarms[False]} by p, {alarms[True]} by e")
    assert alarms[False] / 500 < 0.05 + 3 * np.sqrt(0.05 * 0.95 / 500)
    assert alarms[False] / 500 > 0.01
    assert alarms[True] <= alarms[False]


@pytest.mark.slow
def test_a_pilot_says_how_many_trials_a_difference_takes(tmp_path, capsys):
    """In 15 of 200 trials one alone succeeds, and three questions are asked: McNemar's p is
    multiplied by 3."""
    a, b = store(tmp_path / "a"), store(tmp_path / "b", fails=15)
    rows = ib.compare(a, b, power=0.9, difference=0.05).set_index("quantity")
    high = binomtest(15, 200).proportion_ci(0.6).high
    needed = rows.loc["success", "trials_needed"]
    assert rows.loc["success", "discordant"] == 15
    assert rows.loc["success", "discordant_high"] == pytest.approx(high)
    assert rows["trials_needed"].isna().tolist() == [False, True, True, True]
    drawn = np.random.default_rng(0).multinomial(
        needed, [(high - 0.05) / 2, (high + 0.05) / 2, 1 - high], 5000
    )
    p = 2 * binom.cdf(drawn[:, :2].min(axis=1), drawn[:, :2].sum(axis=1), 0.5)
    assert np.mean(3 * p < 0.05) == pytest.approx(0.9, abs=0.02)
    assert (
        main(
            ["compare", str(a), str(b), "power=0.9", "difference=0.05", f"output={tmp_path / 'c'}"]
        )
        == 1
    )
    said = " ".join(capsys.readouterr().out.split())
    assert f"{needed} trials find a difference of 5 % in success with a probability of 90 %" in said
    assert pd.read_csv(tmp_path / "c" / "comparison.csv")["trials_needed"][0] == needed


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (["power=1.2", "difference=0.05"], "power=1.2: give a number between 0 and 1"),
        (["power=0.9", "difference=0"], "difference=0.0: give a number between 0 and 1"),
        (["power=0.9"], "difference: is not given; both go together"),
        (["power=0.9", "difference=0.05", "anytime=true"], "leave out anytime"),
        (["power=0.9", "difference=0.00001"], "needs more than 10,000,000 trials"),
        (
            ["power=0.9", "difference=0.05"],
            "19 common trials are too few to plan from; run at least 20",
        ),
    ],
)
def test_what_cannot_be_planned_is_refused_in_a_line(tmp_path, capsys, wrong, said):
    trials = 19 if "19" in said else 40
    a, b = store(tmp_path / "a", trials=trials), store(tmp_path / "b", trials=trials, fails=3)
    assert main(["compare", str(a), str(b), *wrong]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1


@pytest.mark.slow
def test_a_guard_runs_the_estimators_in_plugins_and_fails_where_the_workflow_says(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    discovery.sources.cache_clear()
    assert main(["new", "ci"]) == 2
    assert "plugins/ has no estimator to guard" in capsys.readouterr().err
    assert main(["new", "baseline", "guarded_fit"]) == 0
    discovery.sources.cache_clear()
    assert main(["new", "ci"]) == 0
    steps = yaml.safe_load(Path(".github/workflows/estimator.yml").read_text())["jobs"]["compare"][
        "steps"
    ]
    assert f"pip install ipe-bench=={ib.__version__}" in steps[3]["run"]
    assert "estimator-change" in steps[4]["continue-on-error"]
    run = ["run", "--config-dir", "ci", "+experiment=guard", "figures=none", "trials=20"]
    assert [main([*run, f"output={side}"]) for side in ("base", "head")] == [0, 0]
    (compared,) = re.findall("ipe-bench (compare .*?) 2>&1", steps[4]["run"])
    assert main(compared.replace("results/", "").split()) == 0
    assert capsys.readouterr().out.count("guarded_fit; 20 trials") == 3
    assert main(["new", "ci"]) == 2
    assert "is there already" in capsys.readouterr().err
    discovery.sources.cache_clear()
