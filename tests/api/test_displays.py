"""What functions return shows itself, stays a frame under pandas, and answers wrong arguments in
one sentence."""

# pyright: reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false
# (what is wrong here is wrong on purpose)
import copy
import dataclasses
import gc
import pickle
import re

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

import ipe_bench as ib
from ipe_bench.basics.errors import StorageError
from ipe_bench.report import figures
from ipe_bench.report.summary import Summary
from ipe_bench.states import ekf, ukf

ESTIMATORS = {"newton": ib.solvers.Newton(), "linear": ib.baselines.LinearLSE()}
MODEL, NOISE = ib.measurements.Polynomial(), ib.noise.Gaussian(0.01)
BENCH = ib.Scenario(MODEL, NOISE, error_scale=3.0)


@pytest.fixture(scope="module")
def table() -> Summary:
    return ib.run(BENCH, ESTIMATORS, trials=20)


def test_a_summary_shows_the_table_of_the_terminal_and_is_a_frame(table):
    total = table[table["parameter"] == "all"].set_index("estimator", drop=False)
    for shown in (repr(table), re.sub("<[^>]*>", " ", table._repr_html_())):
        assert "polynomial, gaussian: 20 trials per row" in shown
        assert re.search(r"newton\s+readings\s+100 \(83-100\)", shown)
        assert f"{total['nees_mean']['newton']:.2f}" in shown
    # What has not all its columns is shown by pandas.
    part = table[["estimator", "rmse_solved"]]
    assert repr(part) == repr(pd.DataFrame(part))
    assert part._repr_html_() == pd.DataFrame(part)._repr_html_()
    assert "linear" not in repr(
        table.query("estimator == 'newton'").sort_values("rmse_solved").assign(mine=1.0)
    )
    for again in (
        table.copy(),
        copy.deepcopy(table),
        pickle.loads(pickle.dumps(table)),
        table.head(3),
    ):
        assert len(again.trials) == 40
    pd.testing.assert_frame_equal(
        pd.DataFrame(table), pd.DataFrame(pickle.loads(pickle.dumps(table)))
    )


@pytest.mark.slow
def test_trials_and_figures_are_those_of_the_folder_which_goes_with_the_last_frame(
    table, tmp_path, monkeypatch
):
    monkeypatch.setattr(figures, "FIGURES", ("errors", "costs"))
    kept = ib.run(BENCH, ESTIMATORS, trials=20, output=tmp_path / "kept")
    pd.testing.assert_frame_equal(kept.trials, ib.load(tmp_path / "kept"))
    result = kept.report(figures="all")
    assert list(kept.figures) == [path.stem for path in result.figures]
    headline = table.figures["headline"]
    assert isinstance(headline, Figure)
    assert headline._repr_png_().startswith(b"\x89PNG")
    with pytest.raises(ib.UserError, match="give output="):
        table.report()
    other = ib.run(BENCH, ESTIMATORS, trials=5)
    folder = other._folder
    part = other.head(2)
    del other
    gc.collect()
    assert len(part.trials) == 10
    del part
    gc.collect()
    assert not folder.exists()
    assert (tmp_path / "kept" / "report.html").exists()


def test_a_report_shows_its_link_and_headline(table, tmp_path):
    result = table.report(tmp_path, figures="none")
    assert str(tmp_path / "report.html") in repr(result)
    assert re.search(r"newton.* succeeds? in (all|100.%) of 20 trials", repr(result))
    assert len(repr(result).splitlines()) < 10
    assert re.search(r'<a href="[^"]*report.html"', result._repr_html_())


def test_a_model_with_its_noise_is_a_scenario(table):
    own = ib.run(MODEL, ESTIMATORS, 20, noise=NOISE, error_scale=3.0)
    numbers = [c for c in table if "time" not in str(c)]
    pd.testing.assert_frame_equal(pd.DataFrame(own[numbers]), pd.DataFrame(table[numbers]))
    z = BENCH.draw(0, 1).z[0]
    stated = ib.estimate(MODEL, z, ESTIMATORS, noise=NOISE, error_scale=3.0).table()
    pd.testing.assert_frame_equal(ib.estimate(BENCH, z, ESTIMATORS).table(), stated)
    assert (
        ib.design(MODEL, noise=NOISE, error_scale=3.0).ways[0].sharpest
        == ib.design(BENCH).ways[0].sharpest
    )


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (
            lambda: ib.run(BENCH, [ib.solvers.Newton()]),
            'give each a label, as in {"newton": ib.solvers.Newton()}',
        ),
        (
            lambda: ib.run(BENCH, {"n": ib.solvers.Newton}),
            "Newton is a class, whose objects are written Newton()",
        ),
        (
            lambda: ib.run(ib.measurements.Gins, ESTIMATORS),
            "Gins is a class, whose objects are written Gins()",
        ),
        (
            lambda: ib.run(BENCH, ESTIMATORS, error_scale=2.0),
            "error_scale=: is part of the scenario",
        ),
        (
            lambda: ib.solvers.Newton(max_iter=3),
            "Newton: max_iter=: there is no such option; did you mean max_iter",
        ),
        (
            lambda: ib.measurements.gins(),
            "ipe_bench.measurements.gins: there is no such name; did you mean Gins?",
        ),
        (lambda: ib.estimate(3, "my.csv"), "3 is a int; give a scenario"),
    ],
)
def test_a_wrong_argument_is_answered_in_one_sentence(call, said):
    with pytest.raises((ib.UserError, AttributeError)) as caught:
        call()
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_seed_draws_the_trials_of_a_scenario_with_that_seed(table):
    other = ib.run(BENCH, ESTIMATORS, 20, seed=3)
    own = ib.run(dataclasses.replace(BENCH, seed=3), ESTIMATORS, 20)
    numbers = [c for c in table if "time" not in str(c)]
    pd.testing.assert_frame_equal(pd.DataFrame(other[numbers]), pd.DataFrame(own[numbers]))
    assert not other["rmse_solved"].equals(table["rmse_solved"])
    with pytest.raises(ib.UserError, match="seed"):
        ib.run(BENCH, ESTIMATORS, 20, seed=-1)


def test_what_is_stated_holds_for_each_of_several_models():
    stated = ib.run(
        [MODEL, ib.measurements.Polynomial(count=30)], ESTIMATORS, 5, noise=NOISE, error_scale=3.0
    )
    assert set(stated.trials["noise"]) == {"gaussian"}
    assert set(stated.trials["error_scale"]) == {3.0}
    with pytest.raises(ib.UserError, match="noise=: is part of the scenario"):
        ib.run([BENCH], ESTIMATORS, 5, noise=NOISE)


def test_a_mistake_is_one_line_where_a_notebook_asks_how_to_show_it():
    for kind in (ib.UserError, StorageError):
        assert kind("trials=0:\n give 1")._render_traceback_() == [
            f"{kind.__name__}: trials=0: give 1"
        ]
    assert not hasattr(ValueError(), "_render_traceback_")


def test_an_answer_is_asked_by_label_or_place_and_names_its_labels():
    fits = ib.estimate(BENCH, BENCH.draw(0, 1).z[0], ESTIMATORS)
    level = ib.states.Formulas(
        next={"x": "x + w"},
        readings={"z": "x"},
        noise={"w": 1.0},
        deviation={"z": 1.0},
        spread={"x": 1.0},
        count=9,
    )
    tracks = ib.estimate(level, np.ones((9, 1)), {"newton": ekf(), "linear": ukf()})
    assert len(fits) == len(tracks) == 2
    for answer in (fits, tracks):
        assert answer[0] is answer["newton"] is answer[-2]
        assert answer[1].label == "linear"
        with pytest.raises(KeyError, match=r"newtn: .* did you mean newton\?"):
            answer["newtn"]
        with pytest.raises(KeyError, match=r"\(there are: linear, newton\)"):
            answer["something else"]
        with pytest.raises(IndexError):
            answer[2]


class Scaled(ib.noise.Gaussian):
    """A plain subclass whose constructor takes something else."""

    def __init__(self, *, hundredths: float) -> None:
        super().__init__(hundredths / 100)


def test_a_subclass_may_have_a_constructor_of_its_own():
    assert Scaled(hundredths=3.0).deviation == 0.03
    assert copy.deepcopy(Scaled(hundredths=3.0)).deviation == 0.03
    with pytest.raises(ib.UserError, match="deviation=: there is no such option"):
        Scaled(deviation=0.03)
