"""Whatever is shown of random results: more failures never help, rows of different keys differ, the
verdict is read from the number beside it, and no axis hides where a curve falls.

More of them: `PYTHONPATH=tests:tests/report python tests/report/test_every_trial_counts.py 1000`
"""

from __future__ import annotations

import re
import sys
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from shared.random_results import results

from ipe_bench.report.figures import drawings
from ipe_bench.report.finding import Finding
from ipe_bench.report.paper import with_columns
from ipe_bench.report.style import GREY, house_style
from ipe_bench.report.tables.matrix import Matrix, opening
from ipe_bench.report.tables.reports import all_tables
from ipe_bench.report.tables.table import Table, latex, markdown
from ipe_bench.report.tables.terminal import summary_tables
from ipe_bench.statistics.analysis import Analysis
from ipe_bench.statistics.intervals import EXCLUDED
from ipe_bench.statistics.verdicts import CONSISTENT, NO_VERDICT, NOT_REFUTED, OVERCONFIDENT
from ipe_bench.trials.thresholds import FEW

LESS_IS_BETTER = ("error", "rmse", "bias", "std", "q95", "q90", "median")
MORE_IS_BETTER = ("success", "efficiency", "coverage")
OTHER_MEANINGS = (
    *("_if_honest", "nees_median", "iterations_median", "simulations_median", "cost_median"),
    *("bound", "order_median", "cost_to_limit_median", "error_over_bound", "path_bound"),
)
"""Medians that are no errors."""
OF_SOME = ("solved", "common")
"""What stands in the names of columns over some of the trials."""
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
            if any(word in column for word in OF_SOME) or column in ("error_scale", "probability"):
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
    parts += [summary_tables(rows, [], width) for width in (80, 120)]
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
        texts = [tuple(cell.text for cell in row) for row in rows]
        if len(set(texts)) < len(texts):
            yield f"{table.name}: rows look alike"
        if isinstance(table, Matrix) or len(titles) < 4:
            continue
        # A choice of columns keeps what tells rows apart, in LaTeX and Markdown.
        chosen = with_columns(table, [re.sub(r"[^a-z0-9]+", "_", titles[-1].lower()).strip("_")])
        lines = [line for line in markdown(chosen).splitlines() if line.startswith("|")][2:]
        names = [line.rsplit("|", 2)[0] for line in lines]
        if len(set(names)) < len(names):
            yield f"{table.name}: rows of an export look alike"
        if "inf" in re.sub(r"\\num\{[^}]*\}", "", latex(chosen)).replace(r"\infty", ""):
            yield f"{table.name}: inf in LaTeX"


# Verdicts -----------------------------------------------------------------------------------------


def torn_verdicts(analysis: Analysis) -> Iterator[str]:
    for row in analysis.totals.to_dict("records"):
        word, low, high = row["verdict"], row["nees_mean_low"], row["nees_mean_high"]
        if (word == OVERCONFIDENT) != (low > 1):
            yield "overconfident is not read from the interval"
        if (word == CONSISTENT) != (low <= 1 <= high <= EXCLUDED):
            yield "consistent is not read from the interval"
        if word == NOT_REFUTED and not (low <= 1 and high > EXCLUDED):
            yield "not refuted is not read from the interval"
        if (word == NO_VERDICT) != (row["claims"] < FEW):
            yield "a verdict of few"
        if not (np.isnan(low) or low <= row["nees_mean"] * (1 + 1e-9)):
            yield "the number lies below its interval"


# Figures ------------------------------------------------------------------------------------------


def curves_of(ax: Any) -> dict[str, np.ndarray]:
    """Returns the points of the curves of a panel that are named, by name."""
    found: dict[str, list[Any]] = {}
    for line in ax.lines:
        name = str(line.get_gid() or "").partition("#")[0].removeprefix("name:")
        if name and len(line.get_xdata()):
            found.setdefault(name, []).append(np.array([line.get_xdata(), line.get_ydata()], float))
    return {name: np.concatenate(parts, axis=1) for name, parts in found.items()}


def helped_in_figures(was: Analysis, now: Analysis, label: str, scale: float) -> Iterator[str]:
    with house_style():
        first, second = ({d.name: d for d in drawings(one, "all")} for one in (was, now))
    for drawing in (*first.values(), *second.values()):
        for ax in drawing.figure.axes:
            named = [text.get_text() for text in ax.get_yticklabels() if text.get_text()]
            if len(set(named)) < len(named) and drawing.name == "headline":
                yield f"{drawing.name}: names look alike"
            looks = Counter(
                (line.get_color(), line.get_marker(), line.get_linestyle(), line.get_label())
                for line in ax.lines
                if line.get_gid() and line.get_color() != GREY and len(line.get_xdata()) > 1
            )
            if looks and max(looks.values()) > 1 and drawing.name == "headline":
                yield f"{drawing.name}: curves look alike"
    cost = [one.get("cost_against_accuracy") for one in (first, second)]
    if all(cost):
        told = [re.search(r"Cheapest .*: (.*), [^,]* simulations", d.caption) for d in cost]
        if told[1] and told[1][1] == label and not (told[0] and told[0][1] == label):
            yield "cost_against_accuracy: named the cheapest by failing"
    if "tracks" in first and "tracks" in second:
        titles = [[ax.get_title() for ax in d["tracks"].figure.axes] for d in (first, second)]
        order = [[title.partition(": ")[2] for title in some] for some in titles]
        short = next((t for t in order[0] if label.startswith(t.rstrip("…")[:30])), None)
        if short in order[1] and order[1].index(short) < order[0].index(short):
            yield "tracks: a panel moves forward"
    for analysis, shown in ((was, first), (now, second)):
        totals = analysis.totals
        every = sorted(set(totals["error_scale"]))
        if len(every) < 2 or "headline" not in shown:
            continue
        start = shown["headline"].figure.axes[0].get_xlim()[0]
        cut = totals[totals["error_scale"] < start]
        for _, here in cut.groupby("error_scale"):
            apart = here["error_median"].max() > (1 + ALIKE) * here["error_median"].min() + 1e-9
            if here["success"].min() < 0.995 or apart:
                yield "headline: the axis cuts where a curve falls"


@pytest.mark.parametrize("seed", range(4))
def test_what_is_shown_counts_every_trial(seed):
    assert list(faults(seed)) == []


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(100, 130))
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


def rows_of(found: Any) -> dict[str, Any]:
    return next(iter(found.rows.values()))


if __name__ == "__main__":
    found: Counter[str] = Counter()
    first, last = (int(word) for word in sys.argv[1:3])
    for seed in range(first, last):
        found.update(set(faults(seed, drawn=len(sys.argv) > 3)))
    print(f"{last - first} results")
    print(*(f"{number:5} {fault}" for fault, number in found.most_common()), sep="\n")
