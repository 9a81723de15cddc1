"""Whatever is shown of random results: more failures never help, rows of different keys differ, the
verdict is read from the number beside it, and no axis hides where a curve falls.

More of them, by seed: `PYTHONPATH=tests python tests/report/test_every_trial_counts.py 1000 2000`;
with `drawn` behind it, of figures as well.
"""

from __future__ import annotations

import re
import sys
from collections import Counter
from collections.abc import Iterable, Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from unittest.mock import patch

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_hex
from report.test_paper import read
from shared.families import slow_if
from shared.random_results import results
from shared.synthetic_store import Synthetic

import ipe_bench as ib
from ipe_bench.measurements import Formula, Polynomial
from ipe_bench.questions.audit.figure import draw_audit
from ipe_bench.questions.compare.figure import draw_pairs
from ipe_bench.questions.design.answer import _draw_design
from ipe_bench.questions.posterior.answer import sampled
from ipe_bench.questions.posterior.figure import draw_marginals
from ipe_bench.report.figures import common, drawings, tracks
from ipe_bench.report.figures.headline import MOST_CURVES, chosen
from ipe_bench.report.figures.views import views
from ipe_bench.report.finding import Finding
from ipe_bench.report.paper import with_columns
from ipe_bench.report.style import BLACK, BOUND_COLOR, GREY, house_style
from ipe_bench.report.tables.matrix import MATRIX, Matrix, opening
from ipe_bench.report.tables.reports import all_tables
from ipe_bench.report.tables.table import Table, html, latex, markdown
from ipe_bench.report.tables.terminal import summary_tables
from ipe_bench.statistics.analysis import Analysis
from ipe_bench.statistics.intervals import EXCLUDED, VAGUE
from ipe_bench.statistics.verdicts import (
    CONSISTENT,
    NO_VERDICT,
    NOT_REFUTED,
    OVERCONFIDENT,
    UNDECIDED,
)
from ipe_bench.trials.thresholds import FEW

LESS_IS_BETTER = ("error", "rmse", "bias", "std", "q95", "q90", "median")
MORE_IS_BETTER = ("success", "efficiency", "coverage")
OTHER_MEANINGS = (
    *("_if_honest", "nees_median", "iterations_median", "simulations_median", "cost_median"),
    *("bound", "order_median", "cost_to_limit_median", "error_over_bound", "path_bound"),
)
"""Medians that are no errors."""
KEYS = ("error scale", "estimator", "parameter", "first", "second", "status", "message")
ALIKE = 0.1
"""Part by which errors differ at most where an axis may leave them out."""


def faults(seed: int, *, drawn: bool = False) -> Iterator[str]:
    """Yields what is wrong with what is shown of the results of a seed."""
    rng = np.random.default_rng([seed, 51])
    before = results(seed)
    after, group = before.failing(rng)
    was, now = before.analysis, after.analysis
    yield from helped_by_failing(was, now, group.estimator, group.columns["error_scale"])
    for analysis in (was, now):
        yield from alike_rows(analysis)
        yield from torn_verdicts(analysis)
    if drawn:
        yield from helped_in_figures(was, now, group.estimator, group.columns["error_scale"])


# More failures ------------------------------------------------------------------------------------


def of_result(frame: Any, label: str, scale: float) -> Any:
    if frame.empty:
        return frame
    return frame[(frame["estimator"] == label) & (frame["error_scale"] == scale)]


def standing(analysis: Analysis, label: str) -> tuple[int, int, int, int]:
    """Returns the place among the standings, how long it holds or may, and whether it is bold."""
    found = Finding.of(analysis.totals.to_dict("records"))
    (at,) = (i for i, one in enumerate(found.standings) if one.label == label)
    one = found.standings[at]
    better = sum(other.rank < one.rank for other in found.standings)
    return -better, one.sure, one.possible, one.seen


def helped_by_failing(was: Analysis, now: Analysis, label: str, scale: float) -> Iterator[str]:
    if any(b > a for a, b in zip(standing(was, label), standing(now, label), strict=True)):
        yield "a standing rises"
    for name in ("summary", "scores", "distributions", "tracks"):
        if getattr(was, name).empty:
            continue
        first, second = (of_result(getattr(one, name), label, scale) for one in (was, now))
        for column in first.select_dtypes("number").columns if len(first) else ():
            if "solved" in column or column in ("error_scale", "probability"):
                continue
            a, b = first[column].to_numpy(dtype=float), second[column].to_numpy(dtype=float)
            rises = (b > a + 1e-9).any()
            a, b = (np.nan_to_num(values, nan=1e300, posinf=1e300) for values in (a, b))
            falls = (b < a * (1 - 1e-9)).any()
            # Ends of an efficiency's interval rise where it widens, or unusual errors are known.
            is_end = column.startswith("efficiency_capped_")
            if column.startswith(MORE_IS_BETTER) and rises and not is_end:
                yield f"{name}: {column} rises"
            is_error = any(word in column for word in LESS_IS_BETTER) or column == "distance"
            if is_error and falls and not column.endswith(OTHER_MEANINGS):
                yield f"{name}: {column} falls"


# Rows alike ---------------------------------------------------------------------------------------


def shown_tables(analysis: Analysis) -> Iterator[Table]:
    rows: Any = analysis.summary.to_dict("records")
    yield from all_tables(analysis)
    parts = [opening(analysis.totals.to_dict("records"))]
    parts += [summary_tables(rows, None, width) for width in (80, 120)]
    yield from (part for some in parts for part in some if isinstance(part, Table))


def alike_rows(analysis: Analysis) -> Iterator[str]:
    for table in shown_tables(analysis):
        titles = [column.title for column in table.columns]
        if isinstance(table, Matrix):
            if len(set(titles)) < len(titles):
                yield f"{table.name}: columns look alike"
            keys = table.columns[:1]
        else:
            keys = [column for column in table.columns if column.title in KEYS]
        rows = zip(*(column.cells for column in keys), strict=True)
        if twice(tuple(cell.text for cell in row) for row in rows):
            yield f"{table.name}: rows look alike"
        if not readable(latex(table)):
            yield f"{table.name}: LaTeX or siunitx cannot read it"
            continue
        for kind, (head, *body) in written(table):
            places = [i for i, title in enumerate(head) if title in KEYS] or [0]
            if twice(tuple(row[i] for i in places) for row in body):
                yield f"{table.name}: rows look alike in {kind}"
        if isinstance(table, Matrix) or len(titles) < 4:
            continue
        # A choice of columns keeps what tells rows apart, in LaTeX and Markdown.
        chosen = with_columns(table, [re.sub(r"[^a-z0-9]+", "_", titles[-1].lower()).strip("_")])
        if twice(tuple(row[:-1]) for row in in_markdown(chosen)[1:]):
            yield f"{table.name}: rows of an export look alike"
        if "inf" in re.sub(r"\\num\{[^}]*\}", "", latex(chosen)).replace(r"\infty", ""):
            yield f"{table.name}: inf in LaTeX"


class _Rows(HTMLParser):
    """Collects the texts of the cells of a page, row by row."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[list[str]] = []

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_data(self, data: str) -> None:
        if self.rows and self.rows[-1]:
            self.rows[-1][-1] += data.strip()


def in_page(table: Table) -> list[list[str]]:
    parser = _Rows()
    parser.feed(html([table]))
    return parser.rows


def in_markdown(table: Table) -> list[list[str]]:
    lines = [line for line in markdown(table).splitlines() if re.match(r"\|(?!:?-)", line)]
    rows = [re.split(r"(?<!\\)\|", line)[1:-1] for line in lines]
    return [[cell.strip(" *") for cell in row] for row in rows]


def written(table: Table) -> Iterator[tuple[str, list[list[str]]]]:
    """Yields the rows of a table, the titles first, as they stand in each format."""
    yield "a page", in_page(table)
    yield "Markdown", in_markdown(table)
    yield "LaTeX", read(latex(table))


def readable(text: str) -> bool:
    try:
        read(text)
    except AssertionError:
        return False
    return True


# Verdicts -----------------------------------------------------------------------------------------


def torn_verdicts(analysis: Analysis) -> Iterator[str]:
    for row in analysis.totals.to_dict("records"):
        word, low, high = row["verdict"], row["nees_mean_low"], row["nees_mean_high"]
        if (word == OVERCONFIDENT) != (low > 1):
            yield "overconfident is not read from the interval"
        if (word == CONSISTENT) != (low <= 1 <= high <= EXCLUDED):
            yield "consistent is not read from the interval"
        if (word == NOT_REFUTED) != (low <= 1 and EXCLUDED < high <= VAGUE):
            yield "not refuted is not read from the interval"
        if high > VAGUE and word not in (OVERCONFIDENT, UNDECIDED):
            yield "undecided is not read from the interval"
        if (word == NO_VERDICT) != (row["claims"] < FEW):
            yield "a verdict of few"
        if not (np.isnan(low) or low <= row["nees_mean"] * (1 + 1e-9)):
            yield "the number lies below its interval"
        last = of_result(analysis.tracks, row["estimator"], row["error_scale"])[-1:]
        judged = len(last) and row["claims"] >= FEW
        if judged and not np.allclose(last["nees_solved"], row["nees_mean"]):
            yield "tracks: the last NEES is not the one that is judged"


# Figures ------------------------------------------------------------------------------------------


def helped_in_figures(was: Analysis, now: Analysis, label: str, scale: float) -> Iterator[str]:
    with house_style():
        first, second = ({d.name: d for d in drawings(one, "all")} for one in (was, now))
    for analysis, shown in ((was, first), (now, second)):
        for drawing in shown.values():
            yield from alike_in(drawing)
        if twice(drawing.title for drawing in shown.values()):
            yield "titles of figures look alike"
        yield from cut_where_it_falls(shown, analysis)
    for name in first.keys() & second.keys():
        axes = zip(first[name].figure.axes, second[name].figure.axes, strict=False)
        if name == "headline":
            yield from helped_curves(axes, label)
        if name == "distributions":
            yield from helped_distributions(axes, was, now, label)
    yield from helped_places(was, now, label)
    cost = [one.get("cost_against_accuracy") for one in (first, second)]
    if all(cost):
        told = [re.search(r"Cheapest .*: (.*), [^,]* simulations", d.caption) for d in cost]
        if told[1] and told[1][1] == label and not (told[0] and told[0][1] == label):
            yield "cost_against_accuracy: named the cheapest by failing"
        places = [costly_places(d, one, label) for d, one in zip(cost, (was, now), strict=True)]
        if any(b < a * (1 - 1e-9) for a, b in zip(*places, strict=False)):
            yield "cost_against_accuracy: a point falls"
    if "tracks" in first and "tracks" in second:
        panels = [panel_of(d["tracks"], label) for d in (first, second)]
        if panels[1] and (panels[0] is None or panels[1][0] < panels[0][0]):
            yield "tracks: a panel moves forward"
        if panels[0] and panels[1]:
            a, b = (panel.lines[0].get_ydata() for _, panel in panels)
            ends = [panel.get_ylim()[1] for _, panel in panels]
            seen = (a < min(ends)) & (b < min(ends))
            if (b[seen] < a[seen] * (1 - 1e-9)).any():
                yield "tracks: a curve falls"


def alike_in(drawing: Any) -> Iterator[str]:
    """Yields whether two panels, rows, names or curves of a drawing cannot be told apart."""
    for ax in drawing.figure.axes:
        rows = [tick.get_text() for tick in ax.get_yticklabels()]
        places = [tick.get_text() for tick in ax.get_xticklabels()]
        words = [one.get_text() for one in ax.texts if drawing.name != MATRIX]
        for what, texts in (("rows", rows), ("places", places), ("names at curves", words)):
            if twice(filter(None, texts)):
                yield f"{drawing.name}: {what} look alike"
        if twice(looks_of(line) for line in ax.lines if is_curve(line)):
            yield f"{drawing.name}: curves look alike"
    titles = [ax.get_title() for ax in drawing.figure.axes]
    if twice(filter(None, titles)):
        yield f"{drawing.name}: panels look alike"
    labels = [one.get_text() for legend in drawing.figure.legends for one in legend.get_texts()]
    if twice(labels):
        yield f"{drawing.name}: entries of the legend look alike"


def twice(things: Iterable[Any]) -> bool:
    return max(Counter(things).values(), default=1) > 1


def looks_of(line: Any) -> tuple[str, ...]:
    """Returns what tells a curve from others."""
    return str(line.get_color()), str(line.get_marker()), str(line._unscaled_dash_pattern)


def is_curve(line: Any) -> bool:
    """Whether a line is a curve of an estimator in colour, and no bound, truth or mark on it."""
    background = (BOUND_COLOR, BLACK, GREY)
    drawn = line.get_linestyle() != "None" and len(line.get_xdata()) > 1
    return drawn and line.get_color() not in background


def curve_of(ax: Any, label: str) -> np.ndarray | None:
    """Returns the points (2, scales) of the curve of that name; a row has its value first."""
    named = [line for line in ax.lines if str(line.get_gid()).startswith(f"name:{label}#")]
    if not named:
        return None
    line = max(named, key=lambda line: len(line.get_xdata()))
    return np.array([line.get_xdata(), line.get_ydata()], dtype=float)


def helped_curves(axes: Any, label: str) -> Iterator[str]:
    """Yields whether success rises or the error falls where both drawings have a scale."""
    for (before, after), sign in zip(axes, (1, -1), strict=False):
        curves = [curve_of(ax, label) for ax in (before, after)]
        if curves[0] is None or curves[1] is None:
            continue
        across = int(not before.yaxis_inverted())
        count = min(curve.shape[1] for curve in curves)
        a, b = (curve[across][-count:] for curve in curves)
        # A point that is not drawn is an error without end.
        a, b = (np.nan_to_num(values, nan=0.0 if sign > 0 else 1e300) for values in (a, b))
        if (sign * (b - a) > 1e-9 * np.abs(a)).any():
            yield f"headline: {before.get_title()} improves"


def helped_distributions(axes: Any, was: Analysis, now: Analysis, label: str) -> Iterator[str]:
    look = looks_in(was)[label]
    if GREY in (look.color, looks_in(now)[label].color):
        return
    for before, after in axes:
        found = [
            [
                line
                for line in ax.lines
                if line.get_color() == look.color and line.get_marker() == look.marker
            ]
            for ax in (before, after)
        ]
        if [len(some) for some in found] != [1, 1]:
            continue  # curves that look alike are a fault of their own
        (a,), (b,) = ([np.array(one.get_data(), dtype=float) for one in some] for some in found)
        grid = np.geomspace(*before.get_xlim(), 50)
        shares = [np.interp(grid, x, y, left=0.0) for x, y in (a, b)]
        if (shares[1] > shares[0] + 0.02).any():
            yield "distributions: a curve rises"


def looks_in(analysis: Analysis) -> Any:
    (view,), _ = views(analysis)
    return view.with_look(view.look)


def helped_places(was: Analysis, now: Analysis, label: str) -> Iterator[str]:
    """Yields whether an estimator moves forward in the matrix or among the curves of success."""
    for name, most in (("success", 2), ("success", MOST_CURVES)):
        orders = []
        for analysis in (was, now):
            (view,), _ = views(analysis)
            orders.append(chosen(view.totals, view.families, most))
        better = [set(order[: order.index(label)]) if label in order else None for order in orders]
        if better[1] is not None and better[0] is not None and len(better[1]) < len(better[0]):
            yield f"{name}: moves forward among {most} curves"


def costly_places(drawing: Any, analysis: Analysis, label: str) -> list[float]:
    """Returns the heights of an estimator's points, panel by panel; those beyond the axis stand at
    its edge."""
    one = looks_in(analysis)[label]
    if one.color == GREY:
        return []
    found = []
    for ax in drawing.figure.axes:
        heights = [
            float(offset[1])
            for part in ax.collections
            if to_hex(part.get_facecolor()[0]) == one.color
            for offset in part.get_offsets()
        ]
        beyond = [line for line in ax.lines if line.get_markeredgecolor() == one.color]
        found.append(heights[0] if len(heights) == 1 else 1e300 if beyond else np.nan)
    return found


def panel_of(drawing: Any, label: str) -> tuple[int, Any] | None:
    """Returns the place and the panel of a tracker."""
    for place, ax in enumerate(drawing.figure.axes):
        if str(ax.lines[0].get_gid() if ax.lines else "").startswith(f"name:{label}#"):
            return place, ax
    return None


def cut_where_it_falls(shown: Any, analysis: Analysis) -> Iterator[str]:
    totals = analysis.totals
    if len(set(totals["error_scale"])) < 2 or "headline" not in shown:
        return
    first = shown["headline"].figure.axes[0]
    # One scale alone has a row for each estimator, and no axis of scales.
    drawn = first.get_xscale() == "log"
    start = first.get_xlim()[0] if drawn else totals["error_scale"].max()
    cut = totals[totals["error_scale"] < start]
    for _, here in cut.groupby("error_scale"):
        for column in ("error_median", "error_q95"):
            apart = here[column].max() > (1 + ALIKE) * here[column].min() + 1e-9
            if here["success"].min() < 0.995 or apart:
                yield f"headline: the axis cuts where {column} falls"
    for name, drawing in shown.items():
        for ax in drawing.figure.axes:
            low, high = sorted(ax.get_ylim())
            arrows = [line for line in ax.lines if "arrow" in str(line.get_marker())]
            for line in ax.lines if name == "tracks" else ():
                is_named = str(line.get_gid()).startswith("name:")
                if is_named and (np.asarray(line.get_ydata()) > high).any() and not arrows:
                    yield "tracks: a curve leaves the panel without an arrow"
            for line in ax.lines:
                if not is_curve(line) or name == "tracks" or not line.get_clip_on():
                    continue
                values = np.asarray(line.get_ydata(), dtype=float)
                values = values[np.isfinite(values)]
                if len(values) and (values.min() < low or values.max() > high):
                    yield f"{name}: a curve leaves the panel"


# Questions ----------------------------------------------------------------------------------------

STEMS = ("", "velocity_of_the_platform_in_the_direction_of_")


def audited(rng: np.random.Generator, folder: Path) -> Iterable[Any]:
    """Draws an audit of many parameters of long names, with heavy tails and infinite errors."""
    stem = STEMS[rng.integers(2)]
    columns: dict[str, Any] = {}
    for i in range(rng.integers(1, 14)):
        errors = rng.standard_t(rng.choice([1.5, 3, 30]), 60) * 10 ** rng.uniform(-1.5, 2.5)
        errors[rng.random(60) < rng.choice([0, 0.1, 1.0])] = np.inf
        columns |= {f"{stem}p{i}_error": errors, f"{stem}p{i}_std": 1.0}
    return draw_audit(ib.audit(pd.DataFrame(columns)))


def compared(rng: np.random.Generator, folder: Path) -> Iterable[Any]:
    """Draws comparisons of estimators of long names at scales that are nearly the same."""
    labels = ["ekf", "ekf_2", *(f"{STEMS[1]}{who}" for who in ("mine", "yours"))]
    for name in "ab":
        store = Synthetic(folder / name)
        for scale in [1.0, 1.00001, 10.0][: rng.integers(1, 4)]:
            for label in labels[: rng.integers(1, 5)]:
                errors = 10 ** rng.uniform(-3, 0) * rng.standard_normal((60, 3))
                scenario = store.scenario(error_scale=scale)
                store.add(scenario, label, errors, simulations=float(rng.integers(1, 50)))
    return draw_pairs(ib.compare(folder / "a", folder / "b"))


def faults_of_comparison(seed: int, folder: Path) -> Iterator[str]:
    """Yields whether tables of a comparison look alike, and verdicts that their numbers deny."""
    with patch(f"{__name__}.draw_pairs", lambda frame: frame):
        frame: Any = compared(np.random.default_rng([seed, 3]), folder)
    tables = [part for part in frame.parts() if isinstance(part, Table)]
    if twice(table.title for table in tables):
        yield "comparisons look alike"
    if sum(map(len, tables)) != len(frame):
        yield "a comparison is missing"
    for table in tables:
        if any(twice(row[0] for row in rows[1:]) for _, rows in written(table)):
            yield "rows of a comparison look alike"
    for row in frame.to_dict("records"):
        more_is_better = row["quantity"] == "success"
        same = 0.0 if more_is_better or "bias" in row["quantity"] else 1.0
        rises, falls = row["low"] > same, row["high"] < same
        if row["low"] > row["change"] or row["change"] > row["high"]:
            yield "a change lies outside its interval"
        if row["finding"] and not row["different"]:
            yield "a finding without a difference"
        if row["quantity"] not in ("success", "error", "cost"):
            continue
        if row["finding"] == "better" and not (rises if more_is_better else falls):
            yield "better is not read from the interval"
        if row["finding"] == "worse" and not (falls if more_is_better else rises):
            yield "worse is not read from the interval"


@pytest.mark.parametrize("seed", slow_if(lambda seed: seed > 1, range(20)))
def test_tables_of_comparisons_tell_all_apart_and_verdicts_follow_their_numbers(seed, tmp_path):
    assert list(faults_of_comparison(seed, tmp_path)) == []


def designed(rng: np.random.Generator, folder: Path) -> Iterable[Any]:
    """Draws a design by readings of which some are nearly alike."""
    t = [0.0, *rng.choice([1.0, 1.00001, 2.0, 3.0, 4.0, 1e6], rng.integers(2, 8))]
    start = {"a": 1.0, "b": 0.3, "c": 0.1}
    model = Formula("a*exp(-b*t)+c", start, {"t": np.unique(t).tolist()})
    return _draw_design(ib.design(model, noise=ib.noise.Gaussian(0.1), error_scale=0.1))


def posteriors(rng: np.random.Generator, folder: Path) -> Iterable[Any]:
    """Draws a posterior and many estimators."""
    bench = ib.Scenario(Polynomial(), ib.noise.Gaussian(0.01))
    estimators = {f"lse{'_' * i}": ib.baselines.LinearLSE() for i in range(rng.integers(1, 7))}
    return draw_marginals(bench.measurement, sampled(bench, estimators, 1, 80))


def faults_of_question(kind: Any, seed: int, folder: Path) -> Iterator[str]:
    """Yields what cannot be told apart in the figures of a question, and what leaves its panel."""
    try:
        with house_style():
            drawn = list(kind(np.random.default_rng([seed, 3]), folder))
    except ib.UserError:
        return
    for drawing in drawn:
        found = set(alike_in(drawing))
        if kind is compared:
            # Its intervals are rows, whose colours and words are verdicts.
            found = {one for one in found if "curves" not in one}
        yield from found
        for ax in drawing.figure.axes:
            low, high = sorted(ax.get_ylim())
            for line in ax.lines:
                values = np.asarray(line.get_ydata(), dtype=float)
                if line.get_transform() != ax.transData or not np.isfinite(values).any():
                    continue
                if np.nanmin(values) < low or np.nanmax(values) > high:
                    yield f"{drawing.name}: a curve leaves the panel"
        plt.close(drawing.figure)


@pytest.mark.parametrize("kind", [audited, compared, designed])
def test_figures_of_questions_tell_all_apart(kind, tmp_path):
    assert list(faults_of_question(kind, 1, tmp_path)) == []


def some_of(seeds):
    """A quarter of the draws; the others wait for a campaign."""
    marks = [pytest.mark.slow if i % 4 == 0 else pytest.mark.campaign for i in range(len(seeds))]
    return [pytest.param(seed, marks=mark) for seed, mark in zip(seeds, marks, strict=True)]


@pytest.mark.parametrize("seed", some_of(range(20)))
@pytest.mark.parametrize("kind", [audited, compared, designed, posteriors])
def test_figures_of_many_questions_tell_all_apart(kind, seed, tmp_path):
    assert list(faults_of_question(kind, seed, tmp_path)) == []


@pytest.mark.parametrize("seed", slow_if(lambda seed: seed < 2, range(4)))
def test_what_is_shown_counts_every_trial(seed):
    assert list(faults(seed)) == []


@pytest.mark.parametrize("seed", some_of(range(100, 130)))
def test_what_is_drawn_counts_every_trial(seed):
    assert list(faults(seed, drawn=True)) == []


@pytest.mark.slow
def test_tracks_have_a_panel_each_with_how_many_are_kept_the_best_first():
    """Of states that move, whose errors are of all trials."""
    moving = next(found for found in map(results, range(20)) if "path_error" in rows_of(found))
    analysis = moving.analysis
    with house_style():
        (drawing,) = (d for d in drawings(analysis, "all") if d.name == "tracks")
    scale = analysis.tracks["error_scale"].max()
    totals = analysis.totals[analysis.totals["error_scale"] == scale].set_index("estimator")
    *panels, nees = drawing.figure.axes
    assert nees.get_title() == "NEES of solved trials"
    kept = [int(ax.get_title().partition(" of ")[0]) for ax in panels]
    assert kept == sorted(kept, reverse=True)
    assert sorted(kept) == sorted((totals["success"] * totals["trials"]).round().astype(int))
    assert "over all trials" in drawing.caption


def test_tracks_without_a_panel_are_named_as_the_worst():
    several = (found for found in map(results, range(40)) if "path_error" in rows_of(found))
    analysis = next(r.analysis for r in several if len({g.estimator for g in r.groups}) >= 4)
    (view,), _ = views(analysis)
    with house_style(), patch.object(common, "most_panels", return_value=3):
        (drawing,) = tracks.draw(view)
    here = view.totals[view.totals["error_scale"] == view["tracks"]["error_scale"].max()]
    success = here.set_index("estimator")["success"]
    told = drawing.caption.rpartition("Not shown, with larger errors: ")[2].rstrip(".")
    absent = [label for label in success.index if label in told]
    assert len(absent) == len(success) - 2
    others = success.drop(absent)
    assert others.min() >= success[absent].max()


def rows_of(found: Any) -> dict[str, Any]:
    return next(iter(found.rows.values()))


if __name__ == "__main__":
    found: Counter[str] = Counter()
    examples: dict[str, int] = {}
    first, last = (int(word) for word in sys.argv[1:3])
    for seed in range(first, last):
        here = set(faults(seed, drawn=len(sys.argv) > 3))
        examples |= {fault: seed for fault in here if fault not in examples}
        found.update(here)
        tried = seed + 1 - first
        if tried % 50 == 0 or seed + 1 == last:
            print(f"{tried} results, {found.total()} faults", flush=True)
    for fault, number in found.most_common():
        print(f"{number:5} {fault}, first of seed {examples[fault]}")
