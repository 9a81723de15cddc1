"""The pages and pictures of single questions: what was asked and read stands on them, and the
curve's band is right."""

from __future__ import annotations

import hashlib
import io
import re
from dataclasses import dataclass, replace
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from scipy.stats import chi2
from scipy.stats import t as student
from shared.oracles import assert_agrees
from shared.state_models import ConstantVelocity, CoordinatedTurn
from shared.synthetic_store import Pretender, Synthetic

import ipe_bench as ib
from ipe_bench.basics.statuses import Status
from ipe_bench.cli.main import main
from ipe_bench.estimators.base import Estimates
from ipe_bench.questions.compare.answer import _cells
from ipe_bench.questions.compare.figure import _measure, _names, _outcome, _signed, draw_pairs
from ipe_bench.questions.design.answer import _draw_design, _findings, _ways
from ipe_bench.questions.posterior.figure import draw_marginals
from ipe_bench.questions.posterior.maths import Posterior, Reference
from ipe_bench.real.logs import Constant
from ipe_bench.report.figures.answers import _abscissa, _drawn, _left_out, draw_fit
from ipe_bench.report.figures.common import full_ticks, text
from ipe_bench.report.figures.log import draw_log
from ipe_bench.report.figures.views import looks_of, views
from ipe_bench.report.page.answer import _drawings
from ipe_bench.report.page.log import LogAnswer, _facts, _finding
from ipe_bench.report.style import FACES, house_style
from ipe_bench.report.tables.table import csv_text
from ipe_bench.report.words import ends_in_percent, public, told_apart
from ipe_bench.states import Smoother, Tracker, ekf, ukf
from ipe_bench.states.base import widened
from ipe_bench.statistics import analyse


def test_a_page_states_command_version_and_file_and_no_path_of_this_machine(tmp_path, capsys):
    file = tmp_path / "runs.csv"
    error = np.random.default_rng(0).normal(0, 0.3, 200)
    pd.DataFrame({"x_error": error, "x_std": 0.1}).to_csv(file, index=False)
    assert main(["audit", str(file), f"output={tmp_path / 'out'}"]) == 1
    page = (tmp_path / "out" / "audit.html").read_text(encoding="utf-8")
    for words in (
        "ipe-bench audit …/runs.csv output=…/out",
        f"ipe-bench {ib.__version__}",
        "How to cite",
        "<figure",
    ):
        assert words in page
    assert hashlib.sha256(file.read_bytes()).hexdigest()[:16] in page
    assert str(tmp_path) not in page
    found = ib.audit(file)
    assert f"<title>{found.sentences[0].removesuffix('.')} ·" in page
    assert "table-audit" in found._repr_html_()


def test_a_page_of_estimates_states_the_file_that_was_read(tmp_path, capsys):
    file = tmp_path / "line.csv"
    t = np.arange(5.0)
    pd.DataFrame({"t": t, "y": 1 + 2 * t + 0.1 * (-1) ** t}).to_csv(file, index=False)
    words = [
        "measurement=formula",
        "measurement.expression=a+b*t",
        "measurement.start={a: 1, b: 1}",
    ]
    out = tmp_path / "out"
    assert main(["estimate", *words, f"readings={file}", f"output={out}", "figures=none"]) == 0
    page = (out / "estimate.html").read_text(encoding="utf-8")
    assert hashlib.sha256(file.read_bytes()).hexdigest()[:16] in page


@pytest.mark.oracle(
    "published: Draper and Smith, Applied Regression Analysis (1998), eq. (1.4.7)",
    "width of the drawn band",
    1e-4,
)
def test_the_band_of_a_straight_line_is_the_textbooks_and_equal_residuals_are_drawn_once():
    """Draper and Smith, Applied Regression Analysis, 3rd ed., 1998, eq. (1.4.7)."""
    x = np.array([1.0, 2.0, 3.0, 5.0, 8.0])
    z = 1 + 2 * x + np.array([0.1, -0.2, 0.15, 0.05, -0.1])
    found = ib.estimate(
        ib.measurements.Formula("a + b*x", {"a": 0.0, "b": 1.0}, {"x": x.tolist()}), z
    )
    with house_style():
        fit, residuals = _drawings(found)
    assert sum(bool(ax.get_title()) for ax in residuals.figure.axes) == 1
    # Beside the curve stand the residuals of the same fit.
    beside = fit.figure.axes[1].collections[0].get_offsets()
    np.testing.assert_allclose(beside, np.column_stack([x, found["auto"].normalised]))
    band = fit.figure.axes[0].collections[0].get_paths()[0].vertices
    s = np.sqrt(np.sum((z - np.polyval(np.polyfit(x, z, 1), x)) ** 2) / 3)
    for at in (1.0, 8.0):
        half = (
            student.ppf(0.975, 3)
            * s
            * np.sqrt(1 / 5 + (at - x.mean()) ** 2 / np.sum((x - x.mean()) ** 2))
        )
        ends = band[np.isclose(band[:, 0], at)][:, 1]
        assert_agrees(np.ptp(ends), 2 * half, rtol=1e-4)


def test_certified_readings_have_a_curve_over_their_input():
    found = ib.estimate(ib.measurements.Nist("Misra1a"))
    with house_style():
        (fit,) = draw_fit(found.examination, found.z, found["auto"], FACES["auto"])
    assert fit.figure.axes[0].get_xlabel() == "x"


@pytest.mark.parametrize(
    ("low", "high", "ends"),
    [
        (0.9963, 1, ("99.6", "100")),
        (0, 0.0037, ("0", "0.4")),
        (0.93, 1, ("93", "100")),
        (1, 1, ("100", "100")),
    ],
)
def test_ends_of_a_narrow_interval_have_decimals(low, high, ends):
    assert ends_in_percent(low, high) == ends


def test_ends_of_a_change_are_told_apart(tmp_path):
    """Intervals that are narrower than the usual figures have more; an end alone needs none."""
    assert told_apart(-82.31, -82.29, _signed) == ("-82.31", "-82.29")
    assert told_apart(99.6, 300.0, _signed) == ("+100", "+300")
    assert told_apart(0.3, 40.0, _signed) == ("+0.3", "+40")
    quantity = {"quantity": "error", "first_value": 1.0, "second_value": 0.18, "change": 0.18}
    row = {**quantity, "low": 0.18012, "high": 0.18031, "p": 1e-4, "e": 50.0, "finding": "better"}
    row["different"] = True
    assert _cells(row, "95 %")["95 %"] == "0.1801 to 0.1803"
    measure = _measure("error", 0.02)
    assert _outcome(row, row["low"], row["high"], measure) == "better: -81.99 to -81.97 %"
    assert _outcome(row, 10.021, 10.042, measure) == "better: 10.02 to 10.04 times"


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("run output=/home/me/a/b 'solver=[/x/y]'", "run output=…/b 'solver=[…/y]'"),
        ("estimate measurement.expression=a/b*c/d", "estimate measurement.expression=a/b*c/d"),
    ],
)
def test_absolute_paths_are_shortened_and_formulas_are_not(text, shown):
    assert public(text) == shown


# The axes of single questions ---------------------------------------------------------------------


@dataclass(frozen=True)
class Pink(Pretender):
    look = ("#ff1493", "s")


def ticks_of(ax) -> tuple[list[float], list[float]]:
    """Where the ticks of the horizontal axis stand, and what their labels say."""
    ax.figure.draw_without_rendering()
    labels = [label.get_text().replace("−", "-") for label in ax.get_xticklabels()]
    assert ax.xaxis.get_offset_text().get_text() == ""
    return list(ax.get_xticks()), [float(label) for label in labels]


def crowded(ax) -> bool:
    """Whether labels of the horizontal axis meet."""
    boxes = [label.get_window_extent() for label in ax.get_xticklabels() if label.get_text()]
    return any(left.x1 > right.x0 for left, right in pairwise(boxes))


@pytest.mark.parametrize("width", [1e-9, 2e-6, 0.5, 5e5])
@pytest.mark.parametrize("start", [-1.0, 0.0, 3.0])
def test_a_tick_says_its_whole_value(start, width):
    with house_style():
        ax = Figure(figsize=(3.0, 2.0)).subplots()
        ax.set_xlim(start, start + width)
        full_ticks(ax)
        places, said = ticks_of(ax)
        assert not crowded(ax)
    assert said == pytest.approx(places, rel=1e-12, abs=1e-3 * width)
    assert len(set(said)) == len(said) >= 2


@pytest.mark.slow
def test_the_axes_of_posteriors_set_no_part_aside_and_its_lines_are_those_of_a_run(synthetic):
    """Marginals a millionth as wide as they are far from zero."""
    scenario = synthetic.scenario()
    estimators = {
        "gauss_newton": ib.baselines.GaussNewton(),
        "enkf": ib.baselines.EnKF(),
        "mine": Pink(),
    }
    for label, estimator in estimators.items():
        synthetic.add(scenario, label, np.full((30, 3), 0.1), estimator=estimator)
    assert looks_of(estimators) == views(analyse([synthetic.directory]))[1].look
    model, far = scenario.measurement, np.array([0.03875, -1.9598, 26100.0])
    x = far * (1 + 1e-6 * np.random.default_rng(0).standard_normal((200, 3)))
    posterior = Posterior(x, x[:1], np.ones(1), 0.0, 0.0, np.zeros(2))
    status = np.array([Status.CONVERGED])
    estimates = {
        label: Estimates(x[:1], status, covariance=np.cov(x.T)[None]) for label in estimators
    }
    with house_style():
        (drawing,) = draw_marginals(
            model, [Reference(0, far, posterior, estimators, estimates, {})]
        )
    for ax, middle in zip(
        drawing.figure.axes, far * [p.size for p in model.parameters], strict=True
    ):
        places, said = ticks_of(ax)
        assert len(set(said)) == len(said) >= 2
        assert said == pytest.approx(places, rel=1e-9)
        assert said[0] == pytest.approx(middle, rel=1e-4)
        assert not crowded(ax)


def test_a_design_has_the_units_of_its_table_and_says_where_candidates_are_what_is_read_today():
    found = ib.design(ib.measurements.Ranging(), noise=ib.noise.Gaussian(0.1), error_scale=10.0)
    with house_style():
        (drawing,) = _draw_design(found)
    (ax,) = drawing.figure.axes
    drawing.figure.draw_without_rendering()
    drawn = next(line for line in ax.lines if line.get_label() == "today").get_xdata()
    table = next(part for part in found.parts() if getattr(part, "name", "") == "parameters")
    bounds = next(column for column in table.columns if column.title == "bound")
    assert drawn == pytest.approx([float(cell.text) for cell in bounds.cells], rel=1e-2)
    assert [label.get_text() for label in ax.get_yticklabels()] == [
        "east [m]",
        "north [m]",
        "up [m]",
        "clock [m]",
    ]
    assert not crowded(ax)
    assert "best choice" not in " ".join(ax.get_legend_handles_labels()[1])
    said = "The present 21 readings are the only candidates"
    assert said == _findings(found)[0]
    assert [part.startswith(said) for part in _ways(found)] == [True]
    fewer = ib.design(
        ib.measurements.Ranging(), noise=ib.noise.Gaussian(0.1), error_scale=10.0, readings=15
    )
    assert said not in _findings(fewer)
    assert "optimal" not in " ".join(_findings(fewer))


def test_the_only_change_is_named_by_the_second_estimator_and_numbers_are_never_cut():
    """Half of `error scale 100` would read as another scale."""
    only = {"scenario": "gins, error scale 100", "first": "a", "second": "b", "trials": 9}
    assert _names([only | {"quantity": kind} for kind in ("success", "cost")]) == ["b", "b"]
    assert text("newton, gins, quantization, error scale 1000") == (
        "newton, gins, quanti…ion, error scale 1000"
    )
    assert text(f"{'n' * 21}1234567890{'m' * 20}") == f"{'n' * 21}…{'m' * 20}"


def test_each_change_is_worded_beside_its_margin_and_filled_if_it_is_beyond(tmp_path):
    """All errors 1.5 % larger, where changes from 2 % on matter; costs 30 % larger; success
    alike."""
    error = 0.03 * np.random.default_rng(0).standard_normal((1000, 3))
    for name, factor, cost in (("a", 1.0, 5.0), ("b", 1.015, 6.5)):
        filled = Synthetic(tmp_path / name)
        filled.add(filled.scenario(), "it", factor * error, simulations=cost)
    frame = ib.compare(tmp_path / "a", tmp_path / "b")
    told = frame.set_index("quantity")[["different", "finding"]]
    assert told.loc["error"].tolist() == [True, ""]
    assert told.loc["cost"].tolist() == [True, "worse"]
    assert told.loc["success"].tolist() == [False, ""]
    with house_style():
        (drawing,) = draw_pairs(frame)
    axes = {ax.get_title().partition(",")[0]: ax for ax in drawing.figure.axes if ax.axison}
    marks = {kind: ax.lines[1] for kind, ax in axes.items()}
    assert {kind: line.get_markerfacecolor() == "white" for kind, line in marks.items()} == {
        "success": True,
        "error": True,
        "cost": False,
    }
    said = {kind: [t.get_text() for t in ax.texts] for kind, ax in axes.items()}
    assert said["success"] == ["the same within ± 1 points"]
    low, high = (
        100 * (frame.set_index("quantity").loc["error", end] - 1) for end in ("low", "high")
    )
    assert said["error"] == [f"significant, possibly negligible: {low:+.2g} to {high:+.2g} %"]
    assert said["cost"][0].startswith("worse: +")
    for ax, (low, high) in zip(
        axes.values(), ((-1.0, 1.0), (1 / 1.02, 1.02), (1 / 1.05, 1.05)), strict=True
    ):
        (band,) = ax.patches
        assert (band.get_x(), band.get_x() + band.get_width()) == pytest.approx((low, high))
        assert ax.get_xlim()[0] <= low < high <= ax.get_xlim()[1]
    assert "different is a significant change that may be smaller than the margin" in " ".join(
        str(frame).split()
    )
    assert re.search(r"mean error .* different", str(frame))


# Tracks of a log ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def walked():
    """A log of a position that is read directly, with a missing reading and one that is 200 m
    off."""
    model = ConstantVelocity(count=60)
    z = model.draw(3, 4).z[0]
    z[11] = np.nan
    z[40] += 200.0
    found = ib.estimate(model, z, {"kf": ekf(), "same": ekf(), "rts": Smoother(ekf())})
    with house_style():
        (drawing,) = draw_log(found.log, found.tracks)
    return found, drawing


def test_each_state_is_drawn_with_its_band_and_the_readings_where_it_is_read(walked):
    found, drawing = walked
    position, velocity, nis = drawing.figure.axes[:3]
    assert drawing.title == "kf, same, rts (smoother): states ± 2 standard deviations"
    track = found["kf"]
    drawn = {line.get_color(): line.get_ydata() for line in position.lines if len(line.get_ydata())}
    means = [line for line in velocity.lines if line.get_linestyle() == "-"]
    assert any(np.array_equal(line.get_ydata(), track.mean[:, 1]) for line in means)
    assert any(np.array_equal(ys, found.log.z[:, 0], equal_nan=True) for ys in drawn.values())
    ends = np.concatenate([band.get_paths()[0].vertices[:, 1] for band in velocity.collections])
    for sign in (-1, 1):
        assert np.isin(track.mean[:, 1] + sign * 2 * track.deviation[:, 1], ends).all()
    assert nis.get_title() == "NIS of kf"


def test_tracks_of_a_log_have_the_colours_of_a_run():
    trackers = {"ekf": ekf(), "ukf_rts": Smoother(ukf())}
    model = ConstantVelocity(count=4)
    log = ib.estimate(model, model.draw(0, 1).z[0], trackers)
    with house_style():
        (drawing,) = draw_log(log.log, log.tracks)
    drawn = {line.get_color() for line in drawing.figure.axes[0].lines}
    assert {one.color for one in looks_of(trackers).values()} <= drawn


def test_nis_above_its_limit_are_in_red_and_their_share_is_said(walked):
    found, drawing = walked
    nis, limit = found["kf"].nis, chi2.ppf(0.95, 1)
    (red,) = [line for line in drawing.figure.axes[2].lines if line.get_color() == "#c2273d"]
    np.testing.assert_array_equal(red.get_ydata(), nis[nis > limit])
    (line,) = [one for one in drawing.figure.axes[2].lines if one.get_linestyle() == "--"]
    assert line.get_ydata() == pytest.approx(limit)
    assert "(5 % if right)" in drawing.caption
    share = 100 * (nis > limit).sum() / 59
    assert f"at {share:.1f} % of 59 time steps" in drawing.caption
    assert len(drawing.caption.split()) <= 30


def test_a_page_says_what_was_tested_only_where_something_was(walked):
    found, _ = walked
    untested = [replace(one, mean_nis=np.nan, lost_from=None) for one in found.tracks]
    for tracks, tested in ((found.tracks, True), (untested, False)):
        answer = LogAnswer(found.log, tracks)
        *numbers, smoothers = _facts(answer)
        assert [one.partition(":")[0] for one in numbers] == [
            "Size of innovations",
            "Successive innovations",
        ][: 2 * tested]
        assert smoothers == "Smoothers: rts: later readings count in their paths."
        assert (_finding(answer) == "tracks") != tested


def test_the_interval_of_a_constant_shows_as_many_figures_as_its_width_has(walked):
    found, _ = walked
    large = Constant("large", 523.71, 0.01, 523.69, 523.73)
    held = Constant("held", 0.0, np.nan, 0.0, 0.3)
    one = replace(found["kf"], constants=(large, held))
    (table,) = LogAnswer(found.log, [one])._constants()
    assert [cell.text for cell in table.columns[-1].cells] == [
        "523.6900 … 523.7300",
        "0.000 … 0.300",
    ]


def test_the_title_of_a_log_says_whether_the_model_fits_it(walked):
    found, _ = walked
    kf = replace(found["kf"], lost_from=None)
    low, high = kf.limits
    right = replace(kf, mean_nis=(low + high) / 2, white_p=0.5)
    wrong = replace(kf, label="wide", mean_nis=2 * high, white_p=0.5)
    coloured = replace(right, label="coloured", white_p=1e-6)
    for tracks, title in (
        ([right], "the model fits the log: kf consistent"),
        ([right, wrong], "the model fits the log: kf consistent; wide overconfident"),
        ([wrong, coloured], "no tracker fits the log: wide overconfident; coloured wrong"),
    ):
        assert _finding(LogAnswer(found.log, tracks)).startswith(title)
    assert "by more than chance" in _facts(LogAnswer(found.log, [coloured]))[1]


def test_a_filter_predicts_readings_from_those_before_and_a_smoother_the_missing_one(walked):
    found, _ = walked
    model, table = found.log.model, found.table()
    kf = table[table["tracker"] == "kf"]
    moved = model.transition(found["kf"].mean[:-1], 1)
    there = kf["reading_reading"].notna().to_numpy()
    assert not there[11]
    assert there.sum() == 59
    predicted = kf["reading_predicted"].to_numpy()[1:]
    np.testing.assert_allclose(predicted, moved[:, 0], rtol=1e-12)
    off = (kf["reading_reading"] - kf["reading_predicted"]) / kf["reading_predicted_deviation"]
    np.testing.assert_allclose(off[there] ** 2, kf["nis"][there], rtol=1e-9)
    smoothed = table.loc[table["tracker"] == "rts", "reading_predicted"].to_numpy()
    assert np.flatnonzero(np.isfinite(smoothed)).tolist() == [11]
    assert smoothed[11] == pytest.approx(found["rts"].mean[11, 0], rel=1e-12)


def test_what_is_beyond_the_axis_of_a_track_is_marked_there():
    """The prior is a thousand times as wide as the path."""
    model = ConstantVelocity(count=30)
    wide = widened(model, 1000.0)
    z = model.draw(3, 4).z[0]
    z[0] = np.nan
    found = ib.estimate(wide, z, {"kf": ekf()})
    with house_style():
        (drawing,) = draw_log(found.log, found.tracks)
    position = drawing.figure.axes[0]
    low, high = position.get_ylim()
    assert found["kf"].deviation[0, 0] > high - low
    arrows = {
        y for line in position.lines if "arrow" in str(line.get_marker()) for y in line.get_ydata()
    }
    assert arrows == {low, high}


@dataclass(frozen=True)
class Overflowing(Tracker):
    """A filter of a plugin, which keeps nothing of its readings, and whose states are infinite from
    epoch 20 on."""

    def track(self, model, z):
        tracks = ekf().track(model, z)
        tracks.mean[:, 20:], tracks.covariance[:, 20:] = np.inf, np.inf
        tracks.predicted = tracks.predicted_deviation = None
        return tracks


@pytest.mark.parametrize("count", [1, 30])
def test_a_track_that_overflows_is_drawn_as_far_as_it_goes(count):
    model = CoordinatedTurn(count=count)
    z = model.draw(3, 4).z[0]
    found = ib.estimate(model, z, {"far": Overflowing()})
    with house_style():
        (drawing,) = draw_log(found.log, found.tracks)
    panels = [ax for ax in drawing.figure.axes if ax.axison]
    assert [ax.get_title() for ax in panels] == [
        *("x [m]", "vx [m/s]", "y [m]", "vy [m/s]", "rate [rad/s]"),
        "NIS of far",
    ]
    (line,) = [line for line in panels[0].lines if line.get_linestyle() == "-"]
    assert np.isfinite(line.get_ydata()).sum() == min(count, 20)
    assert found.table()["reading1_predicted"].isna().all()


def test_a_csv_of_many_rows_reads_as_one_of_few():
    rng = np.random.default_rng(0)
    rows = 100_001
    frame = pd.DataFrame(
        {
            "estimator": np.where(np.arange(rows) % 2, 'a,"b"', "=c"),
            "x": rng.standard_normal(rows) * 10.0 ** rng.integers(-30, 30, rows),
            "gap": np.where(np.arange(rows) % 3, np.nan, 2.0),
            "k": np.arange(rows),
            "good": np.arange(rows) % 5 == 0,
        }
    )
    many = pd.read_csv(io.StringIO(csv_text(frame)))
    expected = pd.read_csv(
        io.StringIO(csv_text(frame[:1000]) + csv_text(frame[1000:]).partition("\n")[2]),
    )
    assert many["x"].to_numpy() == pytest.approx(frame["x"].to_numpy(), rel=1e-15, abs=0)
    pd.testing.assert_frame_equal(many, expected, check_dtype=False)


def test_of_many_readings_some_are_drawn_and_the_caption_says_which():
    assert _drawn(20_000).all()
    assert _left_out(20_000) == ""
    assert _drawn(50_000).sum() == 16_667
    assert "Drawn: 1 of 3 of 50,000 readings" in _left_out(50_000)


@pytest.mark.parametrize(
    ("column", "name"),
    [([1.0, 2, 4, 7, 8], "t"), ([8.0, 7, 4, 2, 1], "reading"), ([1.0] * 5 + [2] * 5, "reading")],
    ids=["rises", "falls", "cases"],
)
def test_readings_stand_at_their_times_and_numbers_of_cases_are_no_times(column, name):
    model: Any = SimpleNamespace(m=len(column), index={"t": column})
    at, words = _abscissa(model)
    assert words == name
    assert list(at) == (column if name == "t" else list(range(1, len(column) + 1)))
