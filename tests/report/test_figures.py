"""Figures show what the frames hold: at its place, with what is missing, on the page and in a
column of print."""

# pyright: reportAttributeAccessIssue=false, reportIndexIssue=false, reportCallIssue=false,
# reportArgumentType=false (matplotlib's collections are not typed)
from __future__ import annotations

import os
import re
from colorsys import rgb_to_hls
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np
import pandas as pd
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.offsetbox import AnnotationBbox
from shared.synthetic_store import Filter, Pretender, Seeker, Synthetic

from ipe_bench.baselines import EnKF
from ipe_bench.basics.errors import UserError
from ipe_bench.report import figures
from ipe_bench.report.figures import (
    certified,
    common,
    costs,
    draw_all,
    errors,
    parameters,
    settings,
)
from ipe_bench.report.figures.common import text, texts
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.figures.headline import chosen
from ipe_bench.report.figures.views import View, focus_of, views
from ipe_bench.report.style import (
    COLORS,
    DARK,
    FACES,
    FAMILIES,
    GREY,
    POOL,
    RAMP,
    REFERENCE,
    WHITE,
    dark,
    house_style,
    ink,
    looks,
    print_style,
    strong,
)
from ipe_bench.solvers import Auto
from ipe_bench.statistics import analyse
from ipe_bench.statistics.sample import History, median_distances
from ipe_bench.statistics.statistic import ALL

SCALES = (1.0, 10.0, 100.0)
MODULES = (errors, costs, parameters)


def fill(
    store: Synthetic,
    *,
    labels=(REFERENCE, "fixed_point", "two"),
    scales=SCALES,
    trials=60,
    solved=None,
    **given,
):
    rng = np.random.default_rng(0)
    for scale in scales:
        scenario = store.scenario(error_scale=scale, **given)
        error = 0.1 * rng.normal(size=(trials, scenario.measurement.n))
        for label in labels:
            count = (solved or {}).get((label, scale), trials)
            estimator = Pretender() if label == REFERENCE else Seeker()
            factor = scale if label == REFERENCE else 1.0
            store.add(
                scenario,
                label,
                factor * error,
                solved=np.arange(trials) < count,
                estimator=estimator,
            )


def drawn(module, view: View) -> dict[str, Drawing]:
    figures = [one for one in module.FIGURES if set(one.frames) <= view.frames.keys()]
    with house_style():
        return {drawing.name: drawing for figure in figures for drawing in figure.draw(view)}


def only_view(store: Synthetic) -> View:
    (view,), _ = views(analyse([store.directory]))
    return view


def points(ax, color: str) -> dict[float, tuple[float, bool]]:
    """The points in a colour by the nearest error scale: the ordinate, and whether the marker is
    hollow."""
    found = {}
    for line in ax.lines:
        if str(line.get_markeredgecolor()) == color or line.get_color() == color:
            for x, y in np.column_stack([line.get_xdata(), line.get_ydata()]):
                if not np.isfinite(y):
                    continue
                scale = min(SCALES, key=lambda s: abs(np.log(s / x)))
                hollow = line.get_markerfacecolor() == "white"
                found[scale] = (float(y), hollow or found.get(scale, (0, False))[1])
    return found


def bars(ax) -> list[np.ndarray]:
    segments = [
        s
        for lines in ax.collections
        if isinstance(lines, LineCollection)
        for s in lines.get_segments()
    ]
    return [segment for segment in segments if len(segment) == 2 and np.isfinite(segment).all()]


# Errors and costs ---------------------------------------------------------------------------------


def test_costs_and_errors_stand_at_quantiles_of_all_trials(synthetic):
    """A quarter of the trials fail: the 95 % error is among theirs, the median is not."""
    error = 0.1 * np.random.default_rng(3).standard_normal((200, 3))
    error[150:] *= 1e3
    # The bound of the synthetic model is a tenth of a deviation in each parameter.
    distance = np.sort(np.sqrt(((error / 0.1) ** 2).mean(axis=1)))
    for scale in SCALES:
        scenario = synthetic.scenario(error_scale=scale)
        synthetic.add(
            scenario, "one", error, solved=np.arange(200) < 150, estimator=Seeker(), simulations=7.0
        )
    view = only_view(synthetic)
    (panel, *_) = drawn(costs, view)["cost_against_accuracy"].figure.axes
    ((cost, at),) = [point for marks in panel.collections for point in marks.get_offsets()]
    simulated = np.sqrt((np.random.default_rng(0).normal(size=(200_000, 3)) ** 2).mean(axis=1))
    assert (cost, at) == pytest.approx(
        (7.0, distance[189] / np.quantile(simulated, 0.95)), rel=0.05
    )
    assert panel.lines[0].get_ydata()[0] == 1.0
    synthetic.add(
        synthetic.scenario(error_scale=SCALES[0]),
        "same",
        error,
        estimator=Seeker(),
        simulations=7.0,
    )
    (panel, *_) = drawn(costs, only_view(synthetic))["cost_against_accuracy"].figure.axes
    beside = sorted(float(cost) for marks in panel.collections for cost, _ in marks.get_offsets())
    assert beside == pytest.approx([7.0, 7.0 * 10**0.04])
    median = drawn(errors, view)["headline"].figure.axes[1]
    shown = points(median, view.look["one"].color)
    assert [shown[s][0] for s in SCALES] == pytest.approx([distance[99:101].mean()] * 3, rel=0.05)


def test_points_are_in_view_however_heavy_the_tails(synthetic):
    """A few trials err a million times: their interval goes to where it ends, the axis does not; so
    with costs."""
    fill(synthetic, labels=(REFERENCE, "two"))
    error = 0.1 * np.random.default_rng(0).standard_normal((60, 3))
    error[:3] *= 1e6
    synthetic.add(synthetic.scenario(error_scale=100.0), "wild", error)
    view = only_view(synthetic)
    panel = drawn(parameters, view)["parameter_errors_linear_lse"].figure.axes[-1]
    low, high = panel.get_ylim()
    values = view.totals.query("estimator == 'linear_lse'")["rmse_solved"].to_numpy()
    assert low < values.min() < values.max() < high
    synthetic.add(synthetic.scenario(error_scale=100.0), "exact", np.full((60, 3), 1e-12))
    synthetic.add(synthetic.scenario(error_scale=100.0), "lost", np.full((60, 3), 1e12))
    for ax in drawn(costs, only_view(synthetic))["cost_against_accuracy"].figure.axes:
        low, high = ax.get_ylim()
        places = [
            y
            for marks in ax.collections
            if isinstance(marks, PathCollection)
            for _, y in marks.get_offsets()
        ]
        assert low < 1.0 < high
        assert all(low <= y <= high for y in places)


# Curves over the error scale ----------------------------------------------------------------------


def test_points_of_few_trials_are_hollow_without_an_interval_and_missing_ones_break_the_line(
    synthetic,
):
    fill(
        synthetic,
        labels=("fixed_point",),
        solved={("fixed_point", 100.0): 19, ("fixed_point", 10.0): 20},
    )
    drawing = drawn(parameters, only_view(synthetic))["parameter_errors_fixed_point"]
    panel = drawing.figure.axes[-1]
    assert {x: hollow for x, (_, hollow) in points(panel, "#000000").items()} == {
        1.0: False,
        10.0: True,
        100.0: True,
    }
    assert len(bars(panel)) == 2
    assert "(19 of 60 at scale 100)" in drawing.caption
    assert "solved trials" in drawing.title
    again = Synthetic(synthetic.directory.parent / "again")
    fill(again, solved={("fixed_point", 10.0): 0})
    drawing = drawn(parameters, only_view(again))["parameter_errors_fixed_point"]
    curves = [
        line.get_ydata() for line in drawing.figure.axes[-1].lines if line.get_color() == "#000000"
    ]
    assert [np.isnan(np.array(y, dtype=float)).tolist() for y in curves if len(y) == 3] == [
        [False, True, False]
    ]


def test_the_background_tells_of_no_hollow_points():
    """Estimators in grey have none, however few of their trials are solved."""
    rows = pd.DataFrame({"estimator": "far", "error_scale": [1.0, 10.0], "trials": [60, 30]})
    rows = rows.assign(error=[1.0, 2.0])
    for color, entries in ((GREY, 0), ("#000000", 1)):
        look = {"far": replace(looks(["far"])["far"], color=color)}
        with house_style():
            _, (ax,) = common.panels(1)
            common.curves(ax, rows, "error", look, [1.0, 10.0])
        told = [line.get_label() for line in ax.lines]
        assert sum(str(words).startswith("hollow") for words in told) == entries


def test_parameters_have_their_bounds_beside_them(synthetic):
    fill(synthetic, labels=("fixed_point",))
    panel = drawn(parameters, only_view(synthetic))["parameter_errors_fixed_point"].figure.axes[0]
    dotted = [line for line in panel.lines if line.get_linestyle() != "-"]
    assert any(list(line.get_xdata()) == list(SCALES) for line in dotted)


def test_of_parameters_at_a_single_scale_the_table_says_it_all(synthetic):
    fill(synthetic, labels=("fixed_point",), scales=(1.0,))
    assert not drawn(parameters, only_view(synthetic))


@pytest.mark.parametrize(("inches", "across"), [(3.4, 2), (7.0, 4)])
def test_a_column_of_print_has_panels_that_are_read_side_by_side(inches, across):
    with print_style(inches):
        figure, axes = common.panels(4)
    assert figure.get_figwidth() == inches
    assert axes[0].get_subplotspec().get_gridspec().ncols == across


def test_estimators_that_coincide_are_seen_side_by_side(synthetic):
    fill(synthetic, labels=("fixed_point", "two", "three"))
    panel = drawn(errors, only_view(synthetic))["headline"].figure.axes[1]
    at_ten = [
        x
        for line in panel.lines
        for x in line.get_xdata()
        if 5 < x < 20 and len(line.get_xdata()) == 3
    ]
    assert len(set(at_ten)) == 3
    assert max(at_ten) / min(at_ten) < 2
    # In the order of the legend, about the scale itself.
    assert np.exp(np.mean(np.log(at_ten))) == pytest.approx(10, rel=0.1)
    alone = Synthetic(synthetic.directory.parent / "alone")
    fill(alone, scales=(33.0,))
    view = only_view(alone)
    ax = drawn(errors, view)["headline"].figure.axes[0]
    assert [t.get_text() for t in ax.get_yticklabels()] == list(view.look)
    assert {t.get_rotation() for t in ax.get_yticklabels()} == {0.0}
    assert sorted(
        y for line in ax.lines for y in line.get_ydata() if len(line.get_ydata()) == 1
    ) == [0, 1, 2]


def test_scales_are_labelled_as_far_as_there_is_room_with_both_ends():
    scales = [300.0, 600.0, 1000.0, 2000.0, 3000.0, 5000.0, 10000.0]
    for letter in (0.2, 0.1, 0.05, 0.02, 0.001):
        kept = common.labelled(scales, letter)
        assert (kept[0], kept[-1]) == (300.0, 10000.0)
        assert all(
            np.log10(b / a) > letter * (len(f"{a:g}") + len(f"{b:g}") + 2) / 2
            for a, b in pairwise(kept)
        )
    assert kept == scales
    assert common.labelled([33.0], 1.0) == [33.0]
    with house_style():
        _, (ax,) = common.panels(1, {})
        common.scale_axis(ax, scales)
    low, high = ax.get_xlim()
    # As far from one end as from the other, on a logarithmic axis.
    assert low * high == pytest.approx(scales[0] * scales[-1])
    shown = {
        0.0: "0",
        1e-3: "0.001",
        -0.05: "−0.05",
        200.0: "200",
        1e3: "1000",
        1e4: "10⁴",
        5e-7: "5·10⁻⁷",
    }
    shown[1e-12] = "10⁻¹²"
    assert [common.number(v) for v in shown] == list(shown.values())


def test_values_that_hardly_differ_stand_between_labels_on_an_axis_of_their_own():
    ax = Figure().subplots()
    common.decades(ax, [0.86, 1.0], least=1.25)
    low, high = ax.get_ylim()
    assert high / low < 2
    assert sum(low <= tick <= high for tick in ax.get_yticks()) >= 3


# Colours ------------------------------------------------------------------------------------------


# Deuteranopia and protanopia on linear RGB: Machado, Oliveira, Fernandes, IEEE Trans. Vis. Comput.
# Graph. 15, 2009.
SIGHT = {
    "normal": np.eye(3),
    "deuteranopia": np.array(
        [
            [0.367322, 0.860646, -0.227968],
            [0.280085, 0.672501, 0.047413],
            [-0.011820, 0.042940, 0.968881],
        ]
    ),
    "protanopia": np.array(
        [
            [0.152286, 1.052583, -0.204868],
            [0.114503, 0.786281, 0.099216],
            [-0.003882, -0.048116, 1.051998],
        ]
    ),
}
XYZ = np.array(
    [
        [0.4124564, 0.3575761, 0.1804375],
        [0.2126729, 0.7151522, 0.0721750],
        [0.0193339, 0.1191920, 0.9503041],
    ]
)


def lab(color: str, sight: str = "normal") -> np.ndarray:
    """CIE L*, a*, b* under D65."""
    c = np.array(to_rgb(color))
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    t = XYZ @ np.clip(SIGHT[sight] @ linear, 0, 1) / XYZ.sum(axis=1)
    x, y, z = np.where(t > 216 / 24389, np.cbrt(t), (24389 / 27 * t + 16) / 116)
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("paper", ["white", "dark"])
def test_the_faces_differ_in_hue_marker_and_lightness_for_the_colour_blind_and_in_grey_too(paper):
    shown = {e: FACES[e] for e in ("fixed_point", "newton", REFERENCE, "ekf", "ukf", "auto")}
    color = {e: dark(one.color) if paper == "dark" else one.color for e, one in shown.items()}
    for a, b in combinations(shown, 2):
        assert shown[a].marker != shown[b].marker
        assert abs(lab(color[a])[0] - lab(color[b])[0]) > (8 if paper == "white" else 4), (a, b)
        for sight in SIGHT:
            assert np.linalg.norm(lab(color[a], sight) - lab(color[b], sight)) > (
                14 if paper == "white" else 10
            )
        hues = [
            rgb_to_hls(*to_rgb(color[e]))[0] for e in (a, b) if e != REFERENCE
        ]  # black has none
        assert (
            len(hues) < 2 or min(abs(hues[0] - hues[1]), 1 - abs(hues[0] - hues[1])) > 18 / 360
        ), (a, b)
    assert all(
        abs(lab(c)[0] - lab(DARK if paper == "dark" else WHITE)[0]) > 25 for c in color.values()
    )
    # The two filters, each beside the other on every page, are no two tints of orange.
    assert min(np.linalg.norm(lab(color["ekf"], s) - lab(color["ukf"], s)) for s in SIGHT) > 40


def test_a_name_has_one_look_whichever_others_are_there_and_its_family_the_hue():
    kinds = {
        "ekf": "filters",
        "mine": "IPE",
        "newton": "IPE",
        "other (gain=2)": "filters",
        "newton (gain=2)": "IPE",
    }
    kinds |= dict.fromkeys(POOL, "filters")
    alone = {label: looks([label], kinds)[label] for label in kinds}
    together = looks(list(kinds), kinds)
    assert together == alone == looks(list(kinds)[::-1], kinds)
    assert len(
        {(together[e].marker, str(together[e].dash)) for e in (*POOL, *FACES, "ekf") if e in kinds}
    ) == len({*POOL, "ekf", "newton"})
    assert together["mine"].color in FAMILIES["IPE"]
    assert together["newton (gain=2)"].color == FACES["newton"].color
    assert together["newton (gain=2)"] != FACES["newton"]
    moving = {"ipe_newton": "whole"}
    assert looks(list(moving), moving)["ipe_newton"] == together["newton"]
    assert looks(["mine"], kinds, own={"mine": ("#c51b7d", "s")})["mine"].line["color"] == "#c51b7d"


def test_a_class_names_its_own_look_or_is_told_that_it_cannot(synthetic):
    @dataclass(frozen=True)
    class Pink(Seeker):
        look = ("deeppink", "s")

    synthetic.add(synthetic.scenario(), "pink", np.full((30, 3), 0.1), estimator=Pink())
    (look,) = only_view(synthetic).look.values()
    assert (look.color, look.marker) == ("#ff1493", "s")
    with patch.object(Pink, "look", "no colour"):
        synthetic.add(synthetic.scenario(), "wrong", np.full((30, 3), 0.1), estimator=Pink())
    with pytest.raises(UserError, match=r"wrong: look=no colour .* write look = "):
        only_view(synthetic)


def test_an_estimator_is_in_the_colours_of_its_family_and_of_many_the_best_are_in_color(synthetic):
    """The family that it declares, else by what it takes and solves."""
    kinds = {"a": (EnKF(), "ensembles"), "c": (Auto(), "IPE"), "d": (Seeker(), "IPE")}
    kinds |= {"e": (Filter(), "filters"), "f": (Pretender(), "least squares")}
    scenario = synthetic.scenario()
    for label, (estimator, _) in kinds.items():
        synthetic.add(scenario, label, np.full((30, 3), 0.1), estimator=estimator)
    look = only_view(synthetic).look
    assert all(
        look[label].color in FAMILIES[family]
        for label, (_, family) in kinds.items()
        if label != "c"
    )
    many = Synthetic(synthetic.directory.parent / "many")
    error = 0.1 * np.random.default_rng(0).normal(size=(60, 3))
    for i in range(6):
        for label, estimator in ((f"filter{i}", Filter()), (f"iterated{i}", Seeker())):
            for scale in (1.0, 10.0):
                many.add(
                    many.scenario(error_scale=scale),
                    label,
                    (1 + 2 * i) * error,
                    estimator=estimator,
                )
    view = only_view(many)
    shown = view.with_look(view.look)
    colored = {label for label, one in shown.items() if one.color != GREY}
    assert colored == {"filter0", "iterated0", "filter1", "iterated1"}


# Names at the ends --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def parted():
    """Seven estimators that are alike up to scale 10; then five lose all trials, one none, and one
    some."""
    rows = []
    for scale in (1.0, 10.0, 30.0, 100.0, 300.0):
        for label in ("ekf", "newton", "wins", "some", *"abc"):
            lost = scale > 10 and label != "wins"
            share = (0.7 if label == "some" else 0.0) if lost else 1.0
            row = {"estimator": label, "parameter": ALL, "error_scale": scale, "success": share}
            row |= {"success_low": 0.9 * share, "success_high": 0.1 + 0.9 * share}
            row |= {"error_median": 1e6 if lost else 1.0, "error_q95": 1e6 if lost else 1.4}
            row |= {"nees_mean": 20.0 if lost else 1.0, "trials": 60, "claims": 60, "solved": 1.0}
            rows.append({**row, "nees_mean_low": 0.9, "nees_mean_high": 1.1})
    summary = pd.DataFrame(rows)
    look = looks(list(summary["estimator"].unique()))
    focus, winner = focus_of(summary)
    view = View("", "", {"summary": summary}, look, {}, {}, focus=focus, winner=winner)
    return view, drawn(errors, view.only(["summary"]))["headline"]


def names_at_ends(drawing):
    """Each label: its names with their colours, and its box in pixels."""
    fig = drawing.figure
    fig.draw_without_rendering()
    boxes = [box for box in fig.axes[0].artists if isinstance(box, AnnotationBbox)]
    found = []
    for box in boxes:
        words = [area.get_children()[0] for area in box.offsetbox.get_children()]
        names = {word.get_text().rstrip(","): word for word in words}
        found.append((names, box.offsetbox.get_window_extent(), box.xy))
    return found


def test_curves_have_names_at_their_ends_and_those_that_end_together_share_a_label(parted):
    view, drawing = parted
    labels = names_at_ends(drawing)
    ends = view.totals[view.totals["error_scale"] == 300].set_index("estimator")["success"]
    assert {name for names, _, _ in labels for name in names} == set(ends.index)
    for names, _, (scale, share) in labels:
        assert scale == 300.0
        assert all(ends[name] == share for name in names)
    boxes = [box for _, box, _ in labels]
    assert not any(one.overlaps(other) for one, other in combinations(boxes, 2))
    assert all(box.x1 <= drawing.figure.bbox.x1 for box in boxes)
    assert len(labels) < len(ends)


def test_beside_long_names_labels_of_scales_stand_apart_and_no_leader_crosses_a_name():
    scales = (300.0, 600.0, 1000.0, 2000.0, 3000.0, 5000.0, 10000.0)
    shares = {"levenberg_marquardt": 0.06, "recursive_update": 0.04, "geodesic_lm": 0.02}
    rows = pd.DataFrame(
        [
            {"estimator": name, "error_scale": scale, "success": share, "trials": 60}
            for name, share in shares.items()
            for scale in scales
        ]
    )
    look = looks(list(shares))
    with house_style():
        fig, axes = common.panels(3, look, scales=scales)
        for ax in axes:
            common.shares(ax)
            common.curves(ax, rows, "success", look, scales)
        common.end_names(axes[0], rows, "success", look)
        fig.draw_without_rendering()
    for ax in axes:
        labels = [label for label in ax.get_xticklabels() if label.get_text()]
        boxes = [label.get_window_extent() for label in labels]
        gaps = [right.x0 - left.x1 for left, right in pairwise(boxes)]
        assert min(gaps) > 0.3 * boxes[0].height
    for box in (one for one in axes[0].artists if isinstance(one, AnnotationBbox)):
        assert (
            box.arrow_patch.get_path().vertices[:, 0].max() <= box.offsetbox.get_window_extent().x0
        )


@pytest.mark.parametrize(("letters", "labels"), [(14, 1), (15, 2)])
def test_curves_that_end_at_one_place_share_a_label_of_thirty_letters_at_most(letters, labels):
    """Two names, a comma and a blank."""
    names = ["e" * 14, "f" * letters]
    rows = pd.DataFrame({"estimator": names, "error_scale": 1.0, "success": 0.5})
    with house_style():
        _, (ax,) = common.panels(1)
        common.shares(ax)
        common.end_names(ax, rows, "success", looks(names))
    assert sum(isinstance(one, AnnotationBbox) for one in ax.artists) == labels


def test_of_many_curves_those_of_the_success_picture_are_drawn_and_the_others_named(synthetic):
    labels = [f"e{i}" for i in range(12)]
    e = 0.1 * np.random.default_rng(0).standard_normal((30, 3))
    for scale in (1.0, 10.0):
        for i, label in enumerate(labels):
            lost = np.arange(30)[:, None] < 2 * i
            synthetic.add(synthetic.scenario(error_scale=scale), label, np.where(lost, 50.0, e))
    view = only_view(synthetic)
    drawing = drawn(errors, view)["headline"]
    kept = {*view.focus, *chosen(view.totals, view.families)}
    assert len(kept) < 12
    named = drawing.caption.partition("Not drawn: ")[2]
    assert {label for label in labels if re.search(rf"\b{label}\b", named)} == {*labels} - kept
    drawn_names = {artist.get_gid() for ax in drawing.figure.axes for artist in ax.lines}
    told = {str(gid).partition(":")[2].partition("#")[0] for gid in drawn_names if gid}
    assert told == kept


def test_at_most_four_are_in_colour_and_the_winner_in_a_strong_one(parted):
    view, drawing = parted
    lines = [line for ax in drawing.figure.axes for line in ax.lines if len(line.get_xdata()) == 4]
    assert view.winner == "wins"
    assert view.focus[:3] == ["wins", "newton", "ekf"]
    assert {line.get_color() for line in lines} - {GREY} == {
        strong(view.look["wins"].color),
        *(view.look[name].color for name in view.focus[1:]),
    }
    bold = {
        name: word
        for names, _, _ in names_at_ends(drawing)
        for name, word in names.items()
        if word.get_fontweight() == "bold"
    }
    assert bold.keys() == {"wins"}
    widths = {line.get_color(): line.get_linewidth() for line in lines}
    assert max(widths, key=lambda color: widths[color]) == bold["wins"].get_color()


@pytest.mark.parametrize("color", sorted({*FAMILIES["IPE"], *FAMILIES["filters"], "#ffe0f0"}))
def test_letters_of_any_colour_are_read_on_white(color):
    c = np.array(to_rgb(strong(color)))
    luminance = XYZ[1] @ np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    assert 1.05 / (luminance + 0.05) >= 4.5


def contrast(first: str, second: str) -> float:
    """By WCAG 2, from the luminance of CIE."""
    each = sorted(((lab(color)[0] + 16) / 116) ** 3 for color in (first, second))
    return (each[1] + 0.05) / (each[0] + 0.05)


@pytest.mark.parametrize("color", [one.color for one in FACES.values()] + [*COLORS])
def test_letters_of_any_colour_are_read_on_a_dark_page(color):
    assert contrast(dark(strong(color), letters=True), DARK) >= 4.5


@pytest.mark.parametrize("ground", certified._STEPS.values())
def test_digits_are_read_in_their_cells_on_white_and_on_a_dark_page(ground):
    assert contrast(ground, ink(ground)) >= 4.5
    assert contrast(dark(ground), dark(ink(ground), letters=True)) >= 4.5


def test_the_axis_starts_at_the_last_scale_where_all_are_alike_and_the_caption_says_so(parted):
    _, drawing = parted
    for ax in drawing.figure.axes:
        low, high = ax.get_xlim()
        ticks = [t.get_text() for t in ax.get_xticklabels() if t.get_text()]
        assert ticks == ["10", "30", "100", "300"]
        assert 5 < low < 10
        assert 300 < high < 600
    assert drawing.caption.startswith("Up to error scale 10 all are alike: the axis starts there.")


def test_a_page_names_the_estimator_of_each_curve_and_label(parted):
    view, drawing = parted
    page = drawing.html()
    for name in view.look:
        assert page.count(f'<g data-name="{name}">') >= len(drawing.figure.axes) + 1
    assert "name:" not in page


def test_the_axis_starts_before_the_linear_estimate_falls(parted):
    """Which is the question of the paper: at scale 10 all others are still alike."""
    view, _ = parted
    summary = view["summary"].replace({"estimator": {"some": REFERENCE}})
    falls = (summary["estimator"] == REFERENCE) & (summary["error_scale"] == 10)
    summary.loc[falls, ["success", "error_median"]] = [0.2, 8.0]
    look = looks(list(summary["estimator"].unique()))
    whole = replace(view, frames={"summary": summary}, look=look)
    drawing = drawn(errors, whole)["headline"]
    assert drawing.figure.axes[0].get_xlim()[0] < 1.0
    assert "the axis starts there" not in drawing.caption


def test_places_of_labels_are_the_nearest_that_keep_their_distance():
    wanted = [0.5, 0.5, 0.5, 0.0, 0.98]
    found = common.spread(wanted, 0.1, 0.0, 1.0)
    assert np.diff(np.sort(found)).min() >= 0.1 - 1e-12
    np.testing.assert_allclose(found, [0.4, 0.5, 0.6, 0.0, 0.98])
    np.testing.assert_allclose(common.spread([1.0, 1.0], 0.1, 0.0, 1.0), [0.9, 1.0])


def test_errors_of_tracks_are_over_all_epochs_and_all_trials():
    """At the last epoch the smoother is its filter; over all epochs it has half the error."""
    rows = []
    for label, error in (("ukf", 2.0), ("ukf_rts", 1.0)):
        for scale in (1.0, 10.0):
            row = {"estimator": label, "error_scale": scale, "trials": 60, "solved": 0.5}
            row |= {"success": 1.0, "success_low": 0.9, "success_high": 1.0, "claims": 30}
            row |= {"error_median": 7.0, "error_q95": 8.0, "nees_mean": 1.5, "parameter": ALL}
            row |= {"path_error_median": error, "path_error_q95": 3 * error}
            rows.append({**row, "nees_mean_low": 0.9, "nees_mean_high": 1.6})
    frames = {"summary": pd.DataFrame(rows)}
    look = looks(["ukf", "ukf_rts"])
    view = View("", "", frames, look, {}, {}, focus=list(look), moving=True)
    drawing = drawn(errors, view)["headline"]
    _, error, nees = drawing.figure.axes
    shown = {
        line.get_color(): line.get_ydata() for line in error.lines if len(line.get_xdata()) == 2
    }
    assert shown[look["ukf"].color] == pytest.approx([2.0] * 2)
    assert shown[look["ukf_rts"].color] == pytest.approx([1.0] * 2)
    assert 1.5 in {float(y) for line in nees.lines for y in line.get_ydata()}
    assert "NEES is of converged trials, at the fewest ukf 30 of 60, ukf_rts 30 of 60." in (
        drawing.caption
    )


# Certified and published answers ------------------------------------------------------------------


def with_collection() -> View:
    return View(
        "", "", {"summary": pd.DataFrame()}, {}, {}, {}, collection=SimpleNamespace(groups=[])
    )


def test_digits_of_each_problem_are_in_its_cell_dark_from_four_on_the_hardest_first():
    digits = {
        ("easy", "good"): 8.2,
        ("easy", "bad"): 4.2,
        ("hard", "good"): 4.0,
        ("hard", "bad"): np.nan,
    }
    rows = [
        {"dataset": problem, "estimator": who, "start": 1, "lre_parameters": value}
        for (problem, who), value in digits.items()
    ]
    with patch.object(certified, "certified_table", return_value=pd.DataFrame(rows)):
        drawing = drawn(certified, with_collection())["digits"]
    (ax,) = drawing.figure.axes
    assert [t.get_text() for t in ax.get_yticklabels()] == ["hard", "easy"]
    assert [t.get_text() for t in ax.get_xticklabels()] == ["good", "bad"]
    assert [t.get_text() for t in ax.texts] == ["4", "0", "8", "4"]
    fills = [to_hex(color) for color in ax.collections[0].get_facecolors()]
    assert [fill in RAMP[18:] for fill in fills] == [True, False, True, True]
    # From eight digits on it is darkest.
    assert fills.count(RAMP[20]) == 1
    assert "good solves 100 %" in drawing.caption
    # A page that chooses no figures has it.
    (shown,) = (one for one in certified.FIGURES if one.draw is certified.draw_digits)
    assert shown.main


def test_published_errors_are_rings_about_those_that_are_found():
    rows = pd.DataFrame({"model": "book", "state": "angle", "estimator": ["ekf", "ukf"]})
    rows = rows.assign(published=[0.2, 0.1], found=[0.2, 0.125], difference=[0.0, 0.025])
    group = SimpleNamespace(footer={"parameters": [{"name": "angle", "unit": "rad"}]})
    view = replace(with_collection(), collection=SimpleNamespace(groups=[group]))
    with (
        patch.object(certified, "published_table", return_value=rows),
        patch.object(certified, "certified_table", return_value=pd.DataFrame()),
    ):
        drawing = drawn(certified, view)["published"]
    (ax,) = drawing.figure.axes
    assert ax.get_title() == "book, angle [rad]"
    assert [t.get_text() for t in ax.get_yticklabels()] == ["ukf", "ekf"]
    at = {line.get_label(): list(line.get_xdata()) for line in ax.lines}
    assert at == {"published": [0.1, 0.2], "found": [0.125, 0.2]}
    assert "2.5e-02" in drawing.caption
    # A page that chooses no figures has it.
    with patch.object(certified, "published_table", return_value=rows), house_style():
        (shown,) = (one for one in certified.FIGURES if one.draw is certified.draw_published)
        assert shown.main


# Settings -----------------------------------------------------------------------------------------


def swept_view(name: str, values, errors_of, **more) -> View:
    """Three estimators at one scale for each value of a setting, of which two err alike."""
    rows = []
    for value in values:
        for label, factor in (("ekf", 1.0), ("newton", 1.01), ("far", 3.0)):
            error = factor * errors_of[value]
            row = {name: value, "error_scale": 10.0, "estimator": label, "parameter": ALL}
            row |= {"success": 1.0, "success_low": 0.9, "success_high": 1.0, "trials": 60}
            row |= {"error_median": error, "error_q95": 2 * error, "solved": 1.0}
            row |= {"nees_mean": 1.0, "claims": 60, "misfit": float(error > 50)}
            rows.append({**row, "nees_mean_low": 0.9, "nees_mean_high": 1.1})
    summary = pd.DataFrame(rows).assign(**more)
    look = looks(["ekf", "newton", "far"])
    return View("", "", {"summary": summary}, look, {}, {}, focus=list(look))


def test_a_row_per_setting_has_its_error_and_the_share_of_misfits_detected():
    errors_of = {np.nan: 1.0, 5.0: 20.0, 20.0: 300.0}
    view = swept_view("truth.platform_misalignment", errors_of, errors_of)
    assumed = {"_target_": "ipe_bench.measurements.Gins"}
    option = view["summary"]["truth.platform_misalignment"]
    view["summary"].insert(0, "truth", np.where(option.isna(), "Gins", "RicherGins"))
    groups = []
    for name in ("Gins", "RicherGins"):
        truth = {"_target_": f"ipe_bench.measurements.{name}"}
        scenario = {"truth": truth, "measurement": assumed}
        footer = {"identity": {"scenario": scenario}}
        groups.append(SimpleNamespace(footer=footer, columns={"truth": name}))
    view = replace(view, collection=SimpleNamespace(groups=groups))
    drawing = drawn(settings, view)["settings"]
    (ax,) = drawing.figure.axes
    assert ax.get_title() == "ekf"
    bars = {float(line.get_xdata()[1]) for line in ax.lines if line.get_linewidth() == 7}
    assert bars == {300.0, 20.0, 1.0}
    # A model error that is never detected stands above a larger one that is.
    names = (
        "platform misalignment 5 arc seconds",
        "platform misalignment 20 arc seconds",
        "right model",
    )
    texts = [text.get_text().replace("\n", " ") for text in ax.texts]
    assert [text for text in texts if text in names] == list(names)
    told = [text for text in ax.texts if "detected" in text.get_text()]
    assert [text.get_text() for text in told] == [f"detected\n{share} %" for share in (0, 100, 0)]
    assert [text.get_fontweight() for text in told] == ["bold", "normal", "normal"]
    assert "red: under half" in drawing.caption
    assert len(drawing.caption.split()) <= 30
    drawing.figure.draw_without_rendering()
    assert all(text.get_bbox_patch() for text in ax.texts)  # no line crosses a letter
    boxes = [text.get_window_extent() for text in ax.texts]
    assert min(box.x0 for box in boxes) >= 0
    assert not any(one.overlaps(other) for one, other in combinations(boxes, 2))
    # Letters of 10 points are still 8 on a phone, which is 366 points wide between its margins.
    assert drawing.figure.get_figwidth() * 72 <= 366 / 0.8
    summary = view["summary"]
    near = replace(view, frames={"summary": summary[summary["estimator"] != "far"]})
    assert drawn(settings, near)["settings"].figure.axes[0].get_title() == "all 2 estimators"


def test_a_number_that_is_swept_has_an_axis_and_kinds_have_the_matrix_alone():
    values = {0.1: 1.0, 0.2: 2.0, 0.5: 4.0}
    drawing = drawn(settings, swept_view("noise.deviation", values, values))["settings"]
    assert [ax.get_xlabel() for ax in drawing.figure.axes] == ["noise.deviation"] * 3
    curve = drawing.figure.axes[1].lines[1]
    assert curve.get_ydata() == pytest.approx([1.0, 2.0, 4.0])
    assert [t.get_text() for t in drawing.figure.axes[0].get_xticklabels()] == ["0.1", "0.2", "0.5"]
    kinds = {"gaussian": 1.0, "quantization": 2.0}
    assert not drawn(settings, swept_view("noise", kinds, kinds))


def test_settings_whose_words_are_alike_have_rows_of_their_own():
    alike = {0.0: 1.0, np.nan: 2.0}
    view = swept_view("truth.platform_misalignment", alike, alike)
    truth = {"_target_": "ipe_bench.measurements.RicherGins"}
    group = SimpleNamespace(footer={"identity": {"scenario": {"truth": truth}}}, columns={})
    drawing = drawn(settings, replace(view, collection=SimpleNamespace(groups=[group])))["settings"]
    told = [text.get_text() for text in drawing.figure.axes[0].texts if "=" in text.get_text()]
    assert told == [
        "truth.platform_misalignment=-",
        "truth.platform_misalignment=0",
    ]


# Distributions and convergence --------------------------------------------------------------------


def test_distributions_of_all_trials_leave_the_panel_where_trials_diverge(synthetic):
    """A fifth of the trials are lost: the curve goes through the quantiles of the others, and ends
    below 80 %."""
    error = 0.1 * np.random.default_rng(3).standard_normal((200, 3))
    error[160:] *= 1e6
    error[199] = np.inf
    synthetic.add(synthetic.scenario(), "one", error, estimator=Seeker())
    analysis = analyse([synthetic.directory])
    known = np.sqrt(((error / 0.1) ** 2).sum(axis=1))
    rows = analysis.distributions.set_index("probability")["distance"]
    assert rows[0.5] == pytest.approx(np.median(known), rel=1e-9)
    assert rows[1.0] == np.inf
    (drawing,) = (
        d for name, d in drawn(errors, only_view(synthetic)).items() if name == "distributions"
    )
    (panel,) = drawing.figure.axes
    efficient, curve = (line.get_xydata() for line in panel.lines[:2])
    inside = curve[curve[:, 0] < panel.get_xlim()[1]]
    assert np.interp(0.5, inside[:, 1], inside[:, 0]) == pytest.approx(
        np.median(known) / np.sqrt(3), rel=1e-9
    )
    assert inside[:, 1].max() == pytest.approx(0.8, abs=0.011)
    simulated = np.sqrt((np.random.default_rng(0).normal(size=(200_000, 3)) ** 2).mean(axis=1))
    assert np.interp(1.0, *efficient.T) == pytest.approx((simulated <= 1).mean(), abs=0.01)


def test_neither_the_last_iterate_nor_the_epochs_of_filters_are_drawn_as_convergence(synthetic):
    """An iterate's distance from itself is zero; trials that have come to it count as nearer than
    those under way."""
    paths = [[8.0, 4.0, 0.0], [6.0, 3.0, 2.0, 1.0, 0.0], [9.0, 0.0]]
    histories = [History(np.zeros((len(d), 1)), np.array(d), 1.0, np.nan, np.nan) for d in paths]
    assert median_distances(histories).tolist() == [8.0, 3.0, 0.0, 0.0, 0.0]
    assert median_distances([*histories, histories[2]]).tolist() == [8.0, 0.0, 0.0, 0.0, 0.0]
    iterates = {f"x_{name}": np.array([0.8, 0.4, 0.001, 0.0]) for name in "abc"}
    history = {"trial": np.zeros(4, dtype=int), "iteration": np.arange(4)} | iterates
    for label, estimator in (("ekf", Filter()), ("direct", Pretender()), ("newton", Seeker())):
        synthetic.add(
            synthetic.scenario(), label, np.full((30, 3), 0.1), estimator=estimator, history=history
        )
    (drawing,) = (
        d for name, d in drawn(costs, only_view(synthetic)).items() if name == "convergence"
    )
    (panel,) = (ax for ax in drawing.figure.axes if ax.axison)
    assert panel.get_title() == "newton"
    assert panel.lines[0].get_xydata() == pytest.approx(np.array([[0, 8.0], [1, 4.0], [2, 0.01]]))


# Parameters ---------------------------------------------------------------------------------------


def test_only_the_papers_setting_has_the_papers_figures(synthetic):
    fill(synthetic, labels=(REFERENCE, "fixed_point"), trials=20)
    view = only_view(synthetic)
    assert not view.paper
    named = drawn(parameters, view)
    assert set(named) == {"parameter_errors_linear_lse", "parameter_errors_fixed_point"}
    assert not any("paper" in f"{d.title} {d.caption}" for d in named.values())
    assert {"figure_2", "figure_3"} == set(drawn(parameters, replace(view, paper=True)))
    # Errors stand in the unit of the parameter.
    labels = [
        ax.get_ylabel() for ax in named["parameter_errors_linear_lse"].figure.axes if ax.axison
    ]
    assert "rms error [m]" in labels
    shown = [
        y
        for line in named["parameter_errors_linear_lse"].figure.axes[0].lines
        for y in line.get_ydata()
    ]
    rows = view["summary"].query("estimator == 'linear_lse' and parameter in ['a', 'b']")
    assert set(rows["rmse_solved"]) <= set(shown)


# Folders and pages --------------------------------------------------------------------------------


def test_long_settings_have_file_names_of_their_own(synthetic):
    long = "x" * 120
    for last in ("a", "b"):
        fill(synthetic, names=(long + last, "c"), scales=(1.0,))
    parts, _ = views(analyse([synthetic.directory]))
    suffixes = [part.suffix for part in parts]
    assert len(set(suffixes)) == 2
    assert all(len(suffix) < 100 for suffix in suffixes)


@pytest.mark.slow
def test_stale_figures_go_foreign_files_stay_and_the_same_figure_is_the_same_file(
    synthetic, monkeypatch, tmp_path
):
    monkeypatch.setattr(figures, "FIGURES", ("costs",))
    folder, small = (
        tmp_path / "figures",
        {"labels": (REFERENCE, "two"), "scales": (1.0, 10.0), "names": ("a",)},
    )
    fill(synthetic, **small)
    analysis = analyse([synthetic.directory])
    (found,) = draw_all(analysis, folder, formats=("png", "pdf"))
    same = {path: path.read_bytes() for path in found.files}
    (folder / "mine.png").write_bytes(b"of the user")
    draw_all(analysis, folder, formats=("png", "pdf"))
    assert [path.name for path in same] == [
        "cost_against_accuracy.png",
        "cost_against_accuracy.pdf",
    ]
    assert all(path.read_bytes() == content for path, content in same.items())
    fill(synthetic, sigma=0.4, **small)
    names = {one.name for one in draw_all(analyse([synthetic.directory]), folder)}
    assert {path.name for path in folder.iterdir()} == {
        "index.json",
        "mine.png",
        *(f"{name}.png" for name in names),
    }
    assert len([name for name in names if name.startswith("cost_against_accuracy_")]) == 2


def overlaps(fig) -> list[str]:
    """What leaves the figure, or enters another panel or the legend."""
    FigureCanvasAgg(fig)
    fig.draw_without_rendering()
    renderer = fig.canvas.get_renderer()
    boxes = [(ax, ax.get_tightbbox(renderer)) for ax in fig.axes if ax.axison]
    boxes += [(legend, legend.get_window_extent(renderer)) for legend in fig.legends]
    whole, found = fig.bbox, []
    for artist, box in boxes:
        if box.x0 < -1 or box.y0 < -1 or box.x1 > whole.x1 + 1 or box.y1 > whole.y1 + 1:
            found.append(f"{artist} leaves the figure")
    for (first, a), (second, b) in combinations(boxes, 2):
        if min(a.x1, b.x1) - max(a.x0, b.x0) > 1 and min(a.y1, b.y1) - max(a.y0, b.y0) > 1:
            found.append(f"{first} enters {second}")
    return found


@pytest.mark.parametrize(
    "content", [None, "", "3", "[3]", '[{"name": "../mine"}]', '[{"name": 5}]']
)
def test_a_list_of_figures_of_a_foreign_hand_removes_nothing(synthetic, tmp_path, content):
    """Nor is one waited for that is a pipe."""
    (tmp_path / "mine.png").touch()
    (tmp_path / "drawn").mkdir()
    index = tmp_path / "drawn" / "index.json"
    os.mkfifo(index) if content is None else index.write_text(content)
    fill(synthetic, scales=(1.0,))
    with pytest.raises(
        UserError, match=r"index\.json: is no list of the figures beside it; remove it"
    ):
        draw_all(analyse([synthetic.directory]), tmp_path / "drawn", which="none")
    assert (tmp_path / "mine.png").exists()


def test_the_setting_with_most_failures_is_drawn_first_and_those_alike_keep_their_order(synthetic):
    error = 0.1 * np.random.default_rng(0).normal(size=(60, 3))
    for sigma, factor in ((0.1, 1.0), (0.2, 1e3), (0.4, 1.0)):
        synthetic.add(synthetic.scenario(sigma=sigma), "one", factor * error, estimator=Seeker())
    parts, _ = views(analyse([synthetic.directory]))
    assert [float(part.suffix[-3:]) for part in parts] == [0.2, 0.1, 0.4]


@pytest.mark.slow
@pytest.mark.parametrize("width", [3.5, None, 7.16])
def test_nothing_is_clipped_on_the_page_or_in_print(synthetic, width):
    """Long names of groups and many estimators included, in a column of print too."""
    labels, names = (
        (REFERENCE, *(f"an_estimator_{i}" for i in range(11))),
        ("a" * 30, "b", "c", "d", "e"),
    )
    fill(synthetic, names=names, labels=labels, scales=(0.1, 1.0, 10.0, 33.0, 1000.0), trials=20)
    (view,), whole = views(analyse([synthetic.directory]))
    with print_style(width) if width else house_style():
        for figure in (figure for module in MODULES for figure in module.FIGURES):
            for drawing in figure.draw(whole if figure.together else view):
                fig = drawing.figure
                assert width is None or fig.get_figwidth() == width
                assert not overlaps(fig), drawing.name


def test_every_figure_has_a_name_that_the_list_gives(synthetic):
    """Those of the paper's setting have the paper's numbers, of which the list speaks."""
    fill(synthetic)
    with house_style():
        drawn = {drawing.name for drawing in figures.drawings(analyse([synthetic.directory]))}
    assert len(drawn) >= 4
    assert all(name.startswith(tuple(figures.NAMES)) for name in drawn)


@pytest.mark.slow
def test_captions_are_short_and_titles_and_labels_stand_at_their_own_panels(synthetic):
    """From random results at more scales than there are panels."""
    rng, names = np.random.default_rng(7), [f"an_estimator_{i}" for i in range(3)]
    for scale in (0.1, 1.0, 3.0, 10.0, 33.0, 100.0, 300.0, 1000.0, 3000.0):
        for label in (REFERENCE, "fixed_point", *names):
            error = (
                0.1 * rng.normal(size=(40, 3)) * 10 ** rng.uniform(-1, 9 * rng.random(), (40, 1))
            )
            solved = rng.random(40) < rng.random()
            synthetic.add(
                synthetic.scenario(error_scale=scale),
                label,
                error,
                solved=solved,
                estimator=Seeker(),
            )
    with house_style():
        for drawing in figures.drawings(analyse([synthetic.directory])):
            assert len(drawing.caption.split()) <= 30, drawing.caption
            fig, page = drawing.figure, drawing.html()
            assert len(page) < 300_000, drawing.name
            assert page.count("<svg") >= page.count("</span>") + sum(ax.axison for ax in fig.axes)
            assert "id=" not in re.sub(r'id="[mpCi]\w*"', "", page)
            boxes = [
                (ax, ax.get_window_extent(), ax.get_tightbbox()) for ax in fig.axes if ax.axison
            ]
            for (_, _, left), (ax, own, _) in pairwise(boxes):
                assert "\n" not in ax.get_title()
                label = ax.yaxis.label.get_window_extent()
                if ax.get_ylabel() and left.x1 < label.x0:
                    assert own.x0 - label.x1 < 0.6 * fig.dpi
                    assert label.x0 - left.x1 > 4 * fig.dpi / 72, drawing.name


@pytest.mark.slow
def test_a_point_at_a_cap_is_hollow_with_an_arrow_and_what_is_dense_is_a_bitmap(synthetic):
    error = np.full((60, 3), 0.1)
    for scale, factor in zip(SCALES, (1.0, 2.0, 1e9), strict=True):
        synthetic.add(
            synthetic.scenario(error_scale=scale), "one", factor * error, estimator=Seeker()
        )
    view = only_view(synthetic)
    drawing = drawn(errors, view)["headline"]
    found = points(drawing.figure.axes[1], view.look["one"].color)
    assert {scale: hollow for scale, (_, hollow) in found.items()} == {
        1.0: False,
        10.0: False,
        100.0: True,
    }
    assert found[100.0][0] == errors.CEILING["error_median"]
    arrows = [
        line
        for line in drawing.figure.axes[1].lines
        if "arrow" in str(line.get_marker()) and len(line.get_xdata())
    ]
    assert len(arrows) == 1
    assert "<image" not in drawing.html()
    fig = Figure()
    fig.subplots().plot(*np.random.default_rng(0).random((2, 40_000)))
    page = Drawing("dense", "", "", fig).html()
    assert "<image" in page
    assert len(page) < 300_000


def cut_ends(ax) -> list[tuple[float, float]]:
    """Where the arrows of intervals stand that go on."""
    arrows = [line for line in ax.lines if "arrow" in str(line.get_marker())]
    return [
        (float(x), float(y))
        for line in arrows
        for x, y in np.column_stack([line.get_xdata(), line.get_ydata()])
    ]


@pytest.mark.parametrize("scales", [(10.0,), SCALES])
def test_an_interval_that_ends_beyond_the_axis_has_an_arrow_there_and_one_within_has_none(
    synthetic, scales
):
    """A tenth of the trials are lost, by 90 or by 132 bounds; the median is that of the others."""
    most = errors.CEILING["error_q95"]
    for label, lost in (("near", 90.0), ("far", 132.0), ("away", np.inf)):
        error = np.full((60, 3), 0.1)
        error[:6] *= lost
        for scale in scales:
            synthetic.add(synthetic.scenario(error_scale=scale), label, error, estimator=Seeker())
    axes = drawn(errors, only_view(synthetic))["headline"].figure.axes
    over = len(scales) == 1
    found = [at if over else at[::-1] for at in cut_ends(axes[1])]
    assert [value for value, _ in found] == [most] * 2 * len(scales)
    assert common.BEYOND in axes[1].get_legend_handles_labels()[1]
    assert cut_ends(axes[0]) == []
    reached = [max(segment[:, 0 if over else 1]) for segment in bars(axes[1])]
    assert sorted({round(float(end)) for end in reached}) == [90, 100]


@pytest.mark.parametrize(
    ("ends", "arrows"), [((0.5, 2.0), []), ((0.0, 2.0), [0.1]), ((1e-3, np.inf), [0.1, 10.0])]
)
def test_an_interval_that_leaves_the_panel_has_an_arrow_at_its_edge(ends, arrows):
    rows = pd.DataFrame({"estimator": "one", "error_scale": SCALES, "trials": 60, "y": 1.0})
    rows["low"], rows["high"] = ends
    with house_style():
        ax = Figure().subplots()
        ax.set(yscale="log", ylim=(0.1, 10.0))
        common.curves(ax, rows, "y", looks(["one"]), SCALES, interval=("low", "high"))
    assert sorted({y for _, y in cut_ends(ax)}) == arrows
    assert len(cut_ends(ax)) == len(SCALES) * len(arrows)
    assert all(0.0999 < y < 10.001 for segment in bars(ax) for y in segment[:, 1])


def test_long_names_of_one_figure_are_told_apart_wherever_they_differ():
    differ = [f"damped (metric=marquardt, alpha={a}, max_iterations=100, tol=1e-6)" for a in "12"]
    for most in (16, 24, 42):
        short = texts([*differ, "newton"], most)
        assert len(set(short.values())) == 3
        assert max(map(len, short.values())) <= most
        assert short["newton"] == "newton"
        assert text(differ[0]).startswith("damped")
    assert texts(differ)[differ[0]] == "damped (me…alpha=1, max_iterations=100, t…"
