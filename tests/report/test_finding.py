"""The finding says who holds, by intervals, with the numbers that were seen; what is undecided is
called so."""

from __future__ import annotations

from typing import Any

import pytest

from ipe_bench.report.finding import Finding
from ipe_bench.statistics.intervals import clopper_pearson

SCALES = (1.0, 10.0, 100.0)


def row(label: str, scale: float, good: int, trials: int = 200, **more: Any) -> dict[str, Any]:
    low, _ = clopper_pearson(good, trials)
    seen = {"success": good / trials, "success_low": low, "trials": trials}
    named = {"estimator": label, "error_scale": scale, "verdict": "consistent", "setting": ""}
    return {**named, **seen, **more}


def sweep(*, trials: Any = 200, **counts: tuple[int | None, ...]) -> list[dict[str, Any]]:
    """Rows of a sweep from the numbers of successes at each scale; None where there is no row."""
    families = {"ekf": "filters", "ukf": "filters", "newton": "IPE"}
    return [
        row(label, scale, good, trials, family=families.get(label, "least squares"))
        for label, each in counts.items()
        for scale, good in zip(SCALES, each, strict=False)
        if good is not None
    ]


def found(rows: list[dict[str, Any]]) -> str:
    return Finding.of(rows).sentence()


def test_only_the_one_that_holds_is_named_and_where_the_best_filter_fails():
    rows = sweep(newton=(200, 200, 200), ekf=(200, 90, 0), ukf=(200, 20, 0), lse=(0, 0, 0))
    assert found(rows) == (
        "Of these 4, only newton succeeds up to error scale 100 (100 % of 200 trials);"
        " ekf and ukf fail from 10 on"
    )
    assert [one.label for one in Finding.of(rows).standings] == ["newton", "ekf", "ukf", "lse"]


def test_only_needs_every_rival_surely_below():
    """Of 200 trials 172 are as likely as not those of an estimator that holds 90 %, given three
    scales."""
    assert found(sweep(newton=(200, 200, 200), ekf=(200, 200, 172))) == (
        "newton succeeds up to error scale 100 (100 % of 200 trials); ekf: undecided"
    )


def test_a_share_seen_above_the_level_is_no_proof():
    """Of 40 trials 38 prove no 90 %, and 33 do not refute it."""
    assert found(sweep(trials=40, a=(40, 40, 38), b=(40, 33, 33))) == (
        "a succeeds up to error scale 10 (100 % of 40 trials); b: undecided"
    )


def test_who_holds_longest_is_named_with_the_scale_up_to_which():
    assert found(sweep(a=(200, 198, 0), b=(200, 100, 0))) == (
        "Of these 2, only a succeeds up to error scale 10 (99 % of 200 trials)"
    )


def test_scales_ascend_in_whichever_order_a_folder_has_them():
    rows = sweep(a=(200, 198, 0), b=(200, 100, 0))
    assert found(rows[::-1]) == found(rows)


def test_all_hold_and_more_than_three_are_counted():
    assert found(sweep(a=(200,) * 3, b=(196,) * 3)) == (
        "a and b succeed up to error scale 100 (98 to 100 % of 200 trials)"
    )
    four = dict.fromkeys("abcd", (200, 200, 200))
    assert (
        found(sweep(**four))
        == "All 4 estimators succeed up to error scale 100 (100 % of 200 trials)"
    )
    assert found(sweep(**four, e=(0, 0, 0))).startswith("Only 4 of 5 estimators succeed up to")


def test_one_scale_and_one_estimator():
    assert found(sweep(a=(200,))) == "a succeeds at error scale 1 (100 % of 200 trials)"
    assert found(sweep(a=(200,), ekf=(3,), newton=(5,))) == (
        "Of these 3, only a succeeds at error scale 1 (100 % of 200 trials); ekf and newton fail"
    )


def test_nobody_holds_or_the_trials_are_too_few_to_tell():
    assert found(sweep(a=(100, 0, 0), b=(20, 0, 0))) == (
        "No estimator succeeds, even at error scale 1; a and b succeed in 10 to 50 % of 200"
        " trials at error scale 1"
    )
    assert found(sweep(trials=20, a=(20, 19, 2), b=(20, 20, 3))) == (
        "Too few trials to rank; b and a succeed in 95 to 100 % of 20 trials at error scale 10"
    )


def test_a_missing_cell_is_undecided_and_forbids_only():
    rows = sweep(a=(200, 200, 200), b=(200, 200, None))
    assert found(rows) == "a succeeds up to error scale 100 (100 % of 200 trials); b: undecided"


@pytest.mark.parametrize(
    ("verdicts", "clause"),
    [
        (
            ("consistent", "overconfident", "overconfident"),
            "its covariance is too small from 10 on",
        ),
        (("consistent", "overconfident", "consistent"), "its covariance is too small at 10"),
        (("-", "undecided", "too cautious"), ""),
    ],
)
def test_only_a_sure_verdict_calls_a_covariance_too_small(verdicts, clause):
    rows = sweep(a=(200, 200, 200))
    for one, verdict in zip(rows, verdicts, strict=True):
        one["verdict"] = verdict
    told = "a succeeds up to error scale 100 (100 % of 200 trials)"
    assert found(rows) == "; ".join(filter(None, [told, clause]))


def test_the_covariance_of_one_winner_among_several_is_named():
    rows = sweep(a=(200, 200), b=(200, 200))
    rows[-1]["verdict"] = "overconfident"
    assert found(rows).endswith("trials); the covariance of b is too small at 10")
    rows[1]["verdict"] = "overconfident"
    assert found(rows).endswith("trials); their covariance is too small at 10")


def settings(**counts: tuple[int, ...]) -> list[dict[str, Any]]:
    return [
        row(label, 33.0, good, setting=f"truth={k}")
        for label, each in counts.items()
        for k, good in enumerate(each)
    ]


def test_settings_are_counted_and_have_no_order():
    assert found(settings(a=(0, 200, 200), b=(200, 0, 0))) == (
        "Of these 2, only a succeeds in 2 of 3 settings, all but truth=0 (100 % of 200 trials)"
    )
    assert found(settings(a=(200, 200), b=(200, 196))) == (
        "a and b succeed in both settings (98 to 100 % of 200 trials)"
    )
    assert found(settings(a=(178, 200), b=(0, 0))) == (
        "Of these 2, only a succeeds in at least 1 of 2 settings (100 % of 200 trials)"
    )
    assert found(settings(a=(0, 0))) == (
        "No estimator succeeds in any setting; a succeeds in 0 % of 200 trials in 2 settings"
    )


def test_settings_whose_texts_are_equal_are_both_counted():
    rows = settings(a=(200, 0))
    for one in rows:
        one["setting"] = "truth=0.1"
    assert found(rows) == "a succeeds in 1 of 2 settings, truth=0.1 (100 % of 200 trials)"


def test_few_scenarios_that_are_lost_are_named_and_their_number_is_told_once():
    rows = [
        row(label, scale, good, setting=setting, family=family)
        for label, family, each in (("auto", "IPE", (200, 100)), ("ekf", "filters", (0, 0)))
        for setting, last in zip(("-", "pendulum"), (200, each[1]), strict=True)
        for scale, good in ((1.0, each[0]), (10.0, last if label == "auto" else 0))
    ]
    for one in rows[:4]:
        one["verdict"] = "overconfident"
    assert found(rows) == (
        "Of these 2, only auto succeeds in 3 of 4 scenarios, all but pendulum at 10 (100 % of 200"
        " trials); its covariance is too small in 4 scenarios"
    )


def test_settings_where_winners_differ_or_are_undecided_are_not_named():
    assert found(settings(a=(200, 0), b=(0, 200))) == (
        "a and b succeed in 1 of 2 settings (100 % of 200 trials)"
    )
    assert "truth" not in found(settings(a=(200, 178)))


@pytest.mark.parametrize(
    ("verdicts", "clause"),
    [
        (("consistent", "overconfident", "overconfident"), " from 10 on"),
        (("consistent", "overconfident", "-"), " at 10"),
        (("consistent", "consistent", "overconfident"), None),
    ],
)
def test_a_filter_that_is_overconfident_before_it_fails_is_said_to_be(verdicts, clause):
    rows = sweep(newton=(200, 200, 200), ekf=(200, 200, 0), ukf=(200, 200, 0))
    for one, verdict in zip(rows[3:], 2 * verdicts, strict=True):
        one["verdict"] = verdict
    told = found(rows).partition("; ")[2]
    assert told == (
        f"ekf and ukf fail at 100, with covariances that are too small{clause}"
        if clause
        else "ekf and ukf fail at 100"
    )
