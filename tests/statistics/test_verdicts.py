"""Words of verdict: one table has all that is said, reads the words of older files, and decides who
passes."""

from dataclasses import replace
from typing import Any, get_args

import numpy as np
import pytest
from shared.state_models import ConstantVelocity

import ipe_bench as ib
from ipe_bench.real.logs import far_below
from ipe_bench.report.tables.reports import all_tables
from ipe_bench.report.tables.table import plain_text
from ipe_bench.report.tables.terminal import overview_notes, summary_tables
from ipe_bench.states import Formulas, Smoother, ekf, ukf
from ipe_bench.statistics import analyse, summarize
from ipe_bench.statistics.sample import NIS
from ipe_bench.statistics.verdicts import VERDICTS, Verdict, shown

WHITE = Formulas(
    next={"x": "w"},
    readings={"z": "x"},
    noise={"w": 6.0},
    deviation={"z": 1.0},
    spread={"x": 6.0},
    count=60,
)
"""Successive states of this model are independent, with deviation 6."""
SINE = 3 * np.sin(np.arange(60.0) / 5)[:, None]


def test_the_table_has_every_word_once_and_keeps_others():
    assert [word.value for word in VERDICTS[:7]] == list(get_args(Verdict))
    names = [word.value for word in VERDICTS]
    assert len(names) == len(set(names))
    assert shown("lost from time step 31") == "lost from time step 31"


def test_every_row_says_its_verdict_on_any_screen(synthetic):
    """A row whose covariance is right has its word too."""
    synthetic.add(synthetic.scenario(), "newton", np.ones((20, 3)))
    rows: Any = analyse([synthetic.directory]).summary.to_dict("records")
    for verdict, word, sign in (
        ("consistent", "consistent", "="),
        ("overconfident", "overconfident", "+"),
        ("too cautious", "too cautious", "-"),
        ("not refuted", "not refuted", "~"),
        ("undecided", "undecided", "?"),
    ):
        told = [row | {"verdict": verdict} for row in rows]
        wide, narrow = (plain_text(summary_tables(told, None, width), width) for width in (120, 80))
        (row,) = (line for line in wide.splitlines() if line.lstrip().startswith("newton "))
        assert f" {word} " in row.replace(",", " ")
        (row,) = (line for line in narrow.splitlines() if line.lstrip().startswith("newton "))
        assert f" {sign} " in row
        assert f"{sign} {word}" in " ".join(overview_notes((), narrow=True))
    # Innovations have a column of their own.
    assert "not white" not in " ".join(overview_notes((), narrow=True))


def test_shares_of_parameters_are_in_percent_and_words_are_no_numbers(synthetic):
    """Errors of a tenth of a deviation or less: each interval of 95 % holds the truth."""
    synthetic.add(synthetic.scenario(), "newton", np.full((20, 3), 0.01))
    tables = {table.name: table for table in all_tables(analyse([synthetic.directory]))}
    columns = {column.title: column for column in tables["parameters"].columns}
    assert {cell.text for cell in columns["coverage"].cells} == {"100 %"}
    assert not columns["calibration"].numeric
    (words,) = (one for one in tables["calibration"].columns if one.title == "verdict")
    assert not words.numeric


def test_a_log_whose_innovations_are_not_white_is_wrong_however_small_they_are():
    """A sine of amplitude 3 is small for states of deviation 6, but neighbouring readings are
    alike."""
    trackers = {"ekf": ekf(), "ekf_rts": Smoother(ekf())}
    answer = ib.estimate(WHITE, SINE, trackers)
    for one in answer:
        assert one.mean_nis < one.limits[0]
        assert one.fit_p > 0.99
        assert one.white_p < 1e-7
        assert (one.verdict, one.passes) == ("wrong", False)
    assert not answer.passes
    assert "wrong (not white)" in str(answer)
    for right in ib.estimate(WHITE, WHITE.draw(0, 1, 3).z[0], trackers):
        assert (right.verdict, right.passes) == ("consistent", True)


@pytest.mark.parametrize(
    ("worse", "said"), [({}, True), ({"mean_nis": 3.0}, False), ({"white_p": 1e-9}, False)]
)
def test_only_a_track_whose_innovations_fit_is_a_standard_for_others(worse, said):
    """The likelihood of a filter that linearises is that of its own approximation."""
    model = ConstantVelocity(count=50)
    first, second = ib.estimate(model, model.draw(0, 1, 1).z[0], {"ekf": ekf(), "ukf": ukf()})
    assert far_below([first, second]) == []
    far = replace(second, log_likelihood=first.log_likelihood - 400)
    lines = ["ukf: ekf predicts each next reading far better, by 400 in log likelihood"]
    assert far_below([replace(first, **worse), far]) == (lines if said else [])


@pytest.mark.parametrize(("less", "said"), [(14.9, False), (15.1, True)])
def test_far_less_likely_is_ten_and_a_tenth_of_the_number_of_readings(less, said):
    model = ConstantVelocity(count=60)
    z = model.draw(0, 1, 1).z[0]
    z[7:17] = np.nan
    (first,) = ib.estimate(model, z, {"ekf": ekf()})
    other = replace(first, label="other", log_likelihood=first.log_likelihood - less)
    assert bool(far_below([first, other])) == said


def test_simulated_trackers_are_wrong_where_surely_more_than_one_trial_in_a_hundred_is_not_white(
    synthetic,
):
    """If the share is 1 %, 5 or more of 200 trials have a probability of .052, and 6 or more one of
    .016 < .025."""
    rng = np.random.default_rng(0)
    error, nis = 0.1 * rng.standard_normal((200, 1)), rng.chisquare(4, 200) / 4
    of_path = {"path_nees": 1.0, "path_a": 0.1, "path_bound_a": 0.1, NIS: nis}
    for wrong in (0, 5, 6):
        p = np.where(np.arange(200) < wrong, 1e-4, 0.5)
        synthetic.add(synthetic.scenario(names=("a",)), f"of {wrong}", error, white_p=p, **of_path)
    found = (
        summarize([synthetic.directory])
        .query("parameter == 'all'")
        .set_index("estimator")["nis_verdict"]
    )
    assert found.to_dict() == {"of 0": "consistent", "of 5": "consistent", "of 6": "wrong"}
