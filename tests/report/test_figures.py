"""Figures show what the frames hold: at its place, with what is missing, and none that is out of date."""

# pyright: reportAttributeAccessIssue=false, reportIndexIssue=false, reportCallIssue=false, reportArgumentType=false
# (matplotlib's collections are not typed)
from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from synthetic_store import Pretender, Synthetic

from ipe_bench.report import figures
from ipe_bench.report.figures import (
    FIGURES,
    common,
    convergence,
    correlation,
    cost,
    draw_all,
    error_scale,
    gallery,
    nees,
    success,
)
from ipe_bench.report.figures import settings as settings_figure
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.figures.views import View, views
from ipe_bench.report.style import COLORS, REFERENCE, house_style, looks
from ipe_bench.statistics import analyse

SCALES = (1.0, 10.0, 100.0)


class Frozen(Pretender):
    """Stands for an estimator that solves an equation."""

    equation = "frozen"


def fill(store: Synthetic, *, labels=(REFERENCE, "fixed_point", "two"), scales=SCALES, trials=60, solved=None, **given):
    rng = np.random.default_rng(0)
    for scale in scales:
        scenario = store.scenario(error_scale=scale, **given)
        error = 0.1 * rng.normal(size=(trials, scenario.measurement.n))
        for label in labels:
            count = (solved or {}).get((label, scale), trials)
            estimator = Pretender() if label == REFERENCE else Frozen()
            factor = scale if label == REFERENCE else 1.0
            store.add(scenario, label, factor * error, solved=np.arange(trials) < count, estimator=estimator)


def drawn(module, view: View) -> dict[str, Drawing]:
    with house_style():
        return {drawing.name: drawing for drawing in module.draw(view)}


def only_view(store: Synthetic) -> View:
    (view,), _ = views(analyse([store.directory]))
    return view


def points(ax) -> list[tuple[float, float, bool]]:
    """x, y and whether it is hollow, of every marker of the scatter plots of a panel."""
    from matplotlib.collections import PathCollection

    found = []
    for marks in ax.collections:
        if isinstance(marks, PathCollection):
            hollow = [bool(np.allclose(color[:3], 1.0)) for color in marks.get_facecolor()]
            hollow *= len(marks.get_offsets()) // len(hollow)
            # seaborn takes a logarithm and back.
            found += [(round(float(x), 9), float(y), h) for (x, y), h in zip(marks.get_offsets(), hollow, strict=True)]
    return found


def bars(ax) -> list[float]:
    """The abscissas of the intervals."""
    from matplotlib.collections import LineCollection

    return [
        float(segment[0][0])
        for lines in ax.collections
        if isinstance(lines, LineCollection)
        for segment in lines.get_segments()
    ]


@pytest.mark.parametrize("module", [error_scale, success, nees])
def test_every_point_stands_at_its_error_scale(synthetic, module):
    fill(synthetic)
    for drawing in drawn(module, only_view(synthetic)).values():
        found = [x for ax in drawing.figure.axes for x, *_ in points(ax)]
        assert len(found) >= 3
        assert set(found) == set(SCALES)


def test_points_of_few_trials_are_hollow_without_an_interval_and_say_how_many(synthetic):
    fill(synthetic, solved={("fixed_point", 100.0): 19, ("fixed_point", 10.0): 20})
    drawings = drawn(error_scale, only_view(synthetic))
    panel = next(ax for ax in drawings["figure_3"].figure.axes if ax.get_title() == "over the linear bounds")
    assert {x for x, _, hollow in points(panel) if hollow} == {100.0}
    assert sorted(bars(panel)) == [1.0, 10.0]
    assert {note.get_text() for note in panel.texts} == {"19 of 60", "20 of 60"}
    assert "(20 of 60 at scale 10, 19 of 60 at scale 100)" in drawings["figure_3"].caption
    everyone = drawings["error_against_scale"].figure.axes
    assert sum(hollow for _, _, hollow in points(everyone[0])) == 1
    behind = next(ax for ax in everyone if ax.get_title() == "trials behind the points")
    assert min(y for _, y, _ in points(behind)) == pytest.approx(19 / 60)
    # Where nothing is missing there is no such panel.
    fill(synthetic)
    titles = [ax.get_title() for ax in drawn(error_scale, only_view(synthetic))["error_against_scale"].figure.axes]
    assert "trials behind the points" not in titles


def test_points_without_an_interval_are_in_view(synthetic):
    """Fewer than 20 trials have none, and errors that grow with the error scale are far from the bound."""
    fill(synthetic, trials=5)
    for drawing in drawn(error_scale, only_view(synthetic)).values():
        for ax in drawing.figure.axes:
            if "up to" not in ax.get_title():
                low, high = ax.get_ylim()
                assert all(low < y < high for _, y, _ in points(ax) if np.isfinite(y))


def test_heavy_tails_leave_the_points_their_room(synthetic):
    """One trial in sixty errs a million times: its interval goes to where it ends, the axis does not."""
    fill(synthetic, labels=(REFERENCE, "two"))
    scenario = synthetic.scenario(error_scale=100.0)
    error = 0.1 * np.random.default_rng(0).standard_normal((60, 3))
    error[0] *= 1e6
    synthetic.add(scenario, "wild", error)
    view = only_view(synthetic)
    panels = drawn(error_scale, view)["error_against_scale"].figure.axes
    low, high = panels[0].get_ylim()
    # All panels of groups share one axis.
    values = np.array([y for ax in panels if ax.get_ylim() == (low, high) for _, y, _ in points(ax)])
    ends = view["by_group"]["high"]
    assert ends[np.isfinite(ends)].max() > 10 * high
    assert low < values.min() < values.max() < high
    assert high / values.max() < max(10.0, (values.max() / values.min()) ** 0.3) * 2


def test_scales_are_labelled_as_far_as_there_is_room_with_both_ends():
    scales = [300.0, 600.0, 1000.0, 2000.0, 3000.0, 5000.0, 10000.0]
    span = np.log10(scales[-1] / scales[0])
    for inches in (0.8, 1.3, 2.0, 4.0, 9.0):
        kept = common._labelled(scales, span / inches)
        assert kept[0] == 300.0
        assert kept[-1] == 10000.0
        for a, b in pairwise(kept):
            apart = np.log10(b / a) / span * inches
            assert apart > 0.06 * (len(f"{a:g}") + len(f"{b:g}")) / 2
    assert kept == scales
    assert common._labelled([33.0], 1.0) == [33.0]


def test_points_of_no_error_at_all_are_in_the_panel_of_costs(synthetic):
    fill(synthetic, labels=(REFERENCE, "two", "three", "exact"))
    scenario = synthetic.scenario(error_scale=100.0)
    synthetic.add(scenario, "none", np.full((60, 3), 1e-12))
    for ax in drawn(cost, only_view(synthetic))["cost_against_accuracy"].figure.axes:
        if ax.get_title():
            low, high = ax.get_ylim()
            assert low < 0 < 2 < high


def test_the_efficient_line_is_in_the_panel_of_costs_where_all_are_better_by_luck(synthetic):
    scenario = synthetic.scenario(error_scale=1.0)
    for label in (REFERENCE, "two"):
        synthetic.add(scenario, label, np.full((60, 3), 1e-3))
    (ax,) = drawn(cost, only_view(synthetic))["cost_against_accuracy"].figure.axes
    low, high = ax.get_ylim()
    assert low < 0.1 < 1.0 < high


def test_a_value_that_is_missing_breaks_the_line(synthetic):
    fill(synthetic, solved={("two", 10.0): 0})
    panel = drawn(error_scale, only_view(synthetic))["error_against_scale"].figure.axes[0]
    color = looks([REFERENCE, "fixed_point", "two"])["two"].color
    spans = [list(line.get_xdata()) for line in panel.lines if line.get_color() == color]
    assert not any({1.0, 100.0} <= set(span) for span in spans)


def test_markers_that_coincide_differ_in_size(synthetic):
    fill(synthetic, labels=("fixed_point", "two", "three"))
    panel = drawn(success, only_view(synthetic))["success_against_scale"].figure.axes[0]
    (marks,) = panel.collections[-1:]
    at_ten = marks.get_sizes()[np.isclose(marks.get_offsets()[:, 0], 10.0)]
    assert len(set(np.round(at_ten, 3))) == 3


def test_one_error_scale_sets_estimators_side_by_side(synthetic):
    fill(synthetic, scales=(33.0,))
    for module in (error_scale, success, nees):
        for drawing in drawn(module, only_view(synthetic)).values():
            for ax in drawing.figure.axes:
                places = [x for x, *_ in points(ax)]
                assert len(places) == len(set(places))
    view = only_view(synthetic)
    axes = drawn(success, view)["success_against_scale"].figure.axes
    assert [t.get_text() for t in axes[0].get_xticklabels()] == list(view.look)


def test_nees_bars_reach_one_exactly_inside_the_limits(synthetic):
    fill(synthetic)
    view = only_view(synthetic)
    rows = view.totals.set_index(["estimator", "error_scale"])
    axes = drawn(nees, view)["consistency"].figure.axes
    from matplotlib.collections import LineCollection

    reach = [
        bool(segment[:, 1].min() <= 1 <= segment[:, 1].max())
        for lines in axes[0].collections
        if isinstance(lines, LineCollection)
        for segment in lines.get_segments()
    ]
    inside = (rows["nees"] >= rows["nees_low"]) & (rows["nees"] <= rows["nees_high"])
    assert sum(reach) == inside.sum()
    assert 0 < sum(reach) < len(reach)


def test_every_color_can_be_told_from_the_others():
    """Distances in OKLab (B. Ottosson, 2020), where .02 is just noticed."""
    first = np.array([[0.4122214708, 0.5363325363, 0.0514459929], [0.2119034982, 0.6806995451, 0.1073969566],
                      [0.0883024619, 0.2817188376, 0.6299787005]])  # fmt: skip
    second = np.array([[0.2104542553, 0.7936177850, -0.0040720468], [1.9779984951, -2.4285922050, 0.4505937099],
                       [0.0259040371, 0.7827717662, -0.8086757660]])  # fmt: skip
    rgb = np.array([[int(c[i : i + 2], 16) for i in (1, 3, 5)] for c in (*COLORS, "#000000")]) / 255
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    lab = np.cbrt(linear @ first.T) @ second.T
    assert min(np.linalg.norm(a - b) for a, b in combinations(lab, 2)) > 0.1
    look = looks([REFERENCE, *(f"e{i}" for i in range(60))])
    assert len({one.color for one in list(look.values())[: len(COLORS) + 1]}) == len(COLORS) + 1
    assert len({(one.color, one.marker) for one in look.values()}) == 61


def histories(**trials: list[list[float]]) -> pd.DataFrame:
    return pd.DataFrame(
        [
            {"error_scale": 1.0, "estimator": label, "trial": str(t), "iteration": k, "distance": d}
            for label, several in trials.items()
            for t, distances in enumerate(several)
            for k, d in enumerate(distances)
        ]
    )


def test_the_last_iterate_is_not_drawn_as_convergence():
    """Its distance from itself is zero; trials that have come to it count as nearer than those under way."""
    frame = histories(a=[[8.0, 4.0, 0.0], [6.0, 3.0, 2.0, 1.0, 0.0], [9.0, 0.0]])
    found = convergence.median_distances(frame)
    assert list(found["iteration"]) == [0, 1]
    assert list(found["distance"]) == [8.0, 3.0]
    assert convergence.median_distances(histories(a=[[3.0, 0.0]]))["distance"].tolist() == [3.0]


def test_epochs_of_filters_are_no_iterations():
    frame = histories(ekf=[[9.0, 5.0, 2.0, 0.0]], newton=[[9.0, 0.1, 0.001, 0.0]])
    look = looks(["ekf", "newton"])
    view = View("", "model", {"convergence": frame}, look, {"ekf": None, "newton": "frozen"})
    (drawing,) = drawn(convergence, view).values()
    (legend,) = drawing.figure.legends
    words = [entry.get_text() for entry in legend.get_texts()]
    assert "newton" in words
    assert "ekf" not in words
    assert "newton 2" in drawing.caption
    alone = replace(view, frames={"convergence": histories(ekf=[[9.0, 5.0, 2.0, 0.0]])})
    assert not drawn(convergence, alone)


def test_the_correlation_names_its_scale_and_knows_no_negative_zero(synthetic):
    fill(synthetic, trials=400)
    (drawing,) = drawn(correlation, only_view(synthetic)).values()
    panels = [ax for ax in drawing.figure.axes if ax.get_title()]
    assert all("error scale 100" in ax.get_title() for ax in panels)
    words = {t.get_text() for ax in panels for t in ax.texts}
    # Independent errors: all correlations are zero to a digit, either sign.
    assert "0.0" in words
    assert not any(word in ("-0.0", "−0.0") for word in words)
    assert correlation._two_figures(-0.26) == "−0.3"


def test_efficient_is_the_mean_of_chi():
    rng = np.random.default_rng(0)
    for n in (1, 3, 11):
        simulated = np.sqrt((rng.normal(size=(200_000, n)) ** 2).sum(axis=1)).mean() / np.sqrt(n)
        assert cost.efficient(n) == pytest.approx(simulated, abs=4e-3)


def test_settings_are_compared_in_one_panel_per_estimator(synthetic):
    for sigma in (0.2, 0.4):
        fill(synthetic, sigma=sigma)
    _, whole = views(analyse([synthetic.directory]))
    drawings = drawn(settings_figure, whole)
    assert set(drawings) == {"settings_success", "settings_error"}
    for drawing in drawings.values():
        assert [ax.get_title() for ax in drawing.figure.axes if ax.axison] == list(whole.look)
        words = [t.get_text() for t in drawing.figure.legends[0].get_texts()]
        assert sum("0.2" in w for w in words) == sum("0.4" in w for w in words) == 1
    (view, _), _ = views(analyse([synthetic.directory]))
    assert not drawn(settings_figure, view)


def test_long_settings_have_file_names_of_their_own(synthetic):
    long = "x" * 120
    for last in ("a", "b"):
        fill(synthetic, names=(long + last, "c"), scales=(1.0,))
    parts, _ = views(analyse([synthetic.directory]))
    suffixes = [part.suffix for part in parts]
    assert len(set(suffixes)) == 2
    assert all(len(suffix) < 100 for suffix in suffixes)
    # The name hangs on the setting alone, not on what else there is.
    again = Synthetic(synthetic.directory.parent / "again")
    for last in ("b", "c", "a"):
        fill(again, names=(long + last, "c"), scales=(1.0,))
    parts, _ = views(analyse([again.directory]))
    assert set(suffixes) <= {part.suffix for part in parts}


def test_every_module_with_a_figure_is_in_the_list():
    folder = Path(gallery.__file__).parent
    assert {p.stem for p in folder.glob("*.py") if "\nFIGURE = " in p.read_text(encoding="utf-8")} == set(FIGURES)


@pytest.fixture(scope="module")
def once_drawn(tmp_path_factory):
    """An analysis, and a folder with all that can be drawn of it."""
    place = tmp_path_factory.mktemp("once")
    store = Synthetic(place / "store")
    fill(store, labels=(REFERENCE, "fixed_point"), scales=(1.0, 10.0), names=("a", "b"))
    analysis = analyse([store.directory])
    return analysis, draw_all(analysis, place / "figures", formats=("png",), which="all"), place / "figures"


@pytest.fixture
def few(monkeypatch):
    """Two kinds of figures, of which the first is a main one, where it does not matter what is drawn."""
    monkeypatch.setattr(figures, "FIGURES", ("success", "cost"))


def test_stale_figures_go_and_foreign_files_stay(synthetic, few, tmp_path):
    folder = tmp_path / "figures"
    small = {"labels": (REFERENCE, "fixed_point"), "scales": (1.0, 10.0), "names": ("a",)}
    fill(synthetic, **small)
    draw_all(analyse([synthetic.directory]), folder, which="main")
    (folder / "mine.png").write_bytes(b"of the user")
    assert (folder / "success_against_scale.png").exists()
    fill(synthetic, sigma=0.4, **small)
    draw_all(analyse([synthetic.directory]), folder, which="main")
    assert not (folder / "success_against_scale.png").exists()
    assert len(list(folder.glob("success_against_scale_*.png"))) == 2
    assert (folder / "mine.png").read_bytes() == b"of the user"


def test_the_main_figures_are_four(once_drawn):
    names = {drawn.name for drawn in once_drawn[1]}
    assert {"headline", "figure_2", "figure_3", "error_against_scale"} < names
    modules = {name: import_module(f"{figures.__name__}.{name}") for name in FIGURES}
    assert {name for name, module in modules.items() if module.FIGURE.main} == {"headline", "error_scale"}


def test_labels_run_into_nothing(synthetic):
    """Nothing of a panel leaves the figure or enters another panel; long names of groups and settings included."""
    fill(synthetic, names=("a" * 30, "b"))
    view = only_view(synthetic)
    for module in (error_scale, success, nees, cost):
        for drawing in drawn(module, view).values():
            fig = drawing.figure
            FigureCanvasAgg(fig)
            fig.draw_without_rendering()
            renderer = fig.canvas.get_renderer()
            panels = [ax for ax in fig.axes if ax.axison]
            legend = fig.legends[0].get_window_extent(renderer)
            boxes = [ax.get_tightbbox(renderer, for_layout_only=True) for ax in panels]
            assert legend.y0 >= 0
            for ax, box in zip(panels, boxes, strict=True):
                assert 0 <= box.x0 < box.x1 <= fig.bbox.x1
                assert legend.y1 <= box.y0 < box.y1 <= fig.bbox.y1
                assert ax.bbox.width > 100
                assert not any(box.overlaps(other.bbox) for other in panels if other is not ax)


def test_powers_of_ten_are_written_plainly():
    assert [common.power_of_ten(v) for v in (1e-12, 0.1, 1.0, 1e3, 1e25)] == ["10⁻¹²", "10⁻¹", "10⁰", "10³", "10²⁵"]


def test_the_house_style_is_seaborns_white_grid_but_for_what_it_says_itself():
    import matplotlib as mpl
    import seaborn as sns

    expected = {**sns.axes_style("whitegrid"), **sns.plotting_context("paper", font_scale=1.05)}
    ours = {name for name in expected if name.endswith("labelsize") or name.startswith(("grid.", "font.", "image."))}
    ours |= {"axes.titlesize", "legend.fontsize", "axes.edgecolor"}
    with house_style():
        for name in expected.keys() - ours:
            value = expected[name]
            assert mpl.rcParams[name] == (pytest.approx(value) if isinstance(value, float) else value), name
