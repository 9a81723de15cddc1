"""Shows a design: sentences, tables, picture, files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from ipe_bench.measurements.identifiability import structure
from ipe_bench.plugins.extensions import richer_models
from ipe_bench.questions.design.maths import Design, Way, design, entry_in_words
from ipe_bench.report.page.writer import write_files
from ipe_bench.report.tables.table import Part, Shown, Strong, Table, texts, words
from ipe_bench.report.words import enumerate_few, percent, scientific, short
from ipe_bench.trials.observability import TRUTHS, Observability
from ipe_bench.trials.thresholds import FIT_LEVEL

if TYPE_CHECKING:
    from ipe_bench.measurements.base import Measurement
    from ipe_bench.report.figures.drawing import Drawing
    from ipe_bench.trials.scenario import Scenario


READINGS = "readings.csv"
"""Columns of a design's choices, one row per reading."""
_MOST_SUSPECTS = 12
_WORTH = 0.005
"""Part of the mean bound below which a better choice is none."""
_UNSEEN = 0.05
"""Share of trials below which an error goes unnoticed by any test of residuals."""


class DesignAnswer(Shown, Design):
    """Shows a design."""

    def parts(self) -> Iterator[Part]:
        return design_parts(self.scenario.measurement.name, self)


def _best(design: Design) -> Way | None:
    """Returns the way whose sharpest choice has the smallest mean bound; None without a choice."""
    return min(design.ways, key=lambda way: way.sharpest.mean_bound, default=None)


def _direction(seen: Observability) -> str:
    return f"{'Worst-determined combination' if seen.observable else 'The readings do not determine'}: {seen.words}"


def _no_others(design: Design) -> str:
    """Says that no way takes other readings than today's; empty if one does."""
    today = design.scenario.measurement.m
    fewer = any(way.saving or way.sharpest.readings != today for way in design.ways)
    if fewer or not design.ways or design.candidates.m != today:
        return ""
    return f"The present {today} readings are the only candidates."


def _design_sentences(design: Design) -> Iterator[str]:
    yield f"{_direction(design.observability)}."
    yield from _further_sentence(design)
    same, best = _no_others(design), _best(design)
    if same:
        yield same
    elif best:
        choice, today = best.sharpest, design.scenario.measurement.m
        if choice.readings == today and choice.mean_bound >= 1 - _WORTH:
            yield "The present readings are already optimal for their number."
        else:
            share = percent(choice.mean_bound)
            yield f"{choice.readings} readings chosen {best.title} have {share} of today's mean bound."
    yield from _unseen(design)


def _further_sentence(design: Design) -> Iterator[str]:
    """Says what to read next, and the bound that falls most by it."""
    further = design.further
    if further is None:
        return
    where = [further.words[i] for i in further.taken]
    most = int(np.argmin(further.bounds[1] / further.bounds[0]))
    parameter = design.observability.parameters[most]
    today, one, three = (f"{parameter.size * further.bounds[k, most]:.3g}" for k in (0, 1, 3))
    unit = f" {parameter.unit}" if parameter.unit else ""
    yield (
        f"Read next at {where[0]}: the bound of {parameter.name} falls from {today} to {one}{unit}; with two more, at"
        f" {where[1]} and {where[2]}, to {three}{unit}."
    )


def _further(design: Design) -> Iterator[Table]:
    further = design.further
    if further is None:
        return
    shares = further.bounds / further.bounds[0]
    columns = [
        texts("further readings", [str(k) for k in range(1, len(shares))]),
        words("next at", [further.words[i] for i in further.taken]),
        texts("mean bound", [f"{np.sqrt(np.mean(share**2)):.3f}" for share in shares[1:]]),
        texts("smallest", [f"{share.min():.3f}" for share in shares[1:]]),
    ]
    names = [p.name for p in design.observability.parameters]
    columns.append(words("of", [names[int(np.argmin(share))] for share in shares[1:]]))
    note = (
        "Bounds are shares of today's. Each further reading is the one of the candidates that cuts the mean square of"
        " these shares most; an input's candidates reach to four times its range."
    )
    title = "What to read next, beside today's readings"
    yield Table("further", title, "", columns, notes=[note])


def _draw_design(design: Design) -> Iterator[Drawing]:
    from ipe_bench.questions.design.figure import draw_bounds, draw_further

    if design.further is not None:
        yield draw_further(design.scenario.measurement, design.further)
    best, scenario, after = None if _no_others(design) else _best(design), design.scenario, None
    if best is not None:
        model = design.measurement(best.sharpest)
        after = Observability.at(
            model, scenario.noise.covariance(model.m), scenario.truths(0, TRUTHS)
        )
    yield from draw_bounds(design.observability, after, f"best choice {best.title}" if best else "")


def design_parts(name: str, design: Design) -> Iterator[Part]:
    """Yields the tables and sentences of a design, under the `name` of its model."""
    yield _parameters(name, design)
    yield Strong(_direction(design.observability))
    if told := structure(design.scenario.measurement):
        if not told.lost:
            yield f"Exact readings would determine all {len(told.unknowns)} parameters locally."
        yield from (Strong(f"Not identifiable: {sentence}.") for sentence in told.sentences)
    yield from _further(design)
    yield from _suspects(design)
    yield from _ways(design)


def _parameters(name: str, design: Design) -> Table:
    seen, scenario = design.observability, design.scenario
    parameters, others = seen.parameters, seen.correlation - np.eye(len(seen.parameters))
    s = np.median(seen.singular_values, axis=0)
    columns = [
        words("parameter", [p.name for p in parameters]),
        words("unit", [p.unit for p in parameters]),
        texts(
            "bound",
            [scientific(bound * p.size) for p, bound in zip(parameters, seen.bound, strict=True)],
        ),
        texts("correlation with all others", [f"{r:.2f}" for r in seen.multiple_correlation]),
    ]
    if len(parameters) > 1:
        most = np.argmax(np.abs(others), axis=1)
        columns.append(
            words(
                "strongest",
                [f"{parameters[j].name} {others[i, j]:+.2f}" for i, j in enumerate(most)],
            )
        )
    notes = [
        "bound: smallest standard deviation of an unbiased estimator, root mean square over the prior. Correlations of"
        " the errors: multiple correlation with all others, and the strongest with one other.",
        f"Singular values of the whitened Jacobian, per parameter's size: {short(s[0])} to {short(s[-1])}.",
    ]
    title = f"{name}, {scenario.noise.name}, error scale {scenario.error_scale:g}: what {scenario.measurement.m}"
    return Table("parameters", f"{title} readings determine", "", columns, notes=notes)


def _suspects(design: Design) -> Iterator[Part]:
    if not design.suspects:
        return
    shown = design.suspects[:_MOST_SUSPECTS]
    note = (
        f"detected: share of trials in which the test of fit at {FIT_LEVEL:g} reports the error. An error is hidden"
        " if it makes a parameter wrong by more than its bound and is detected in less than half of the trials. The"
        " readings hardly change along the unseen direction."
    )
    columns = [
        words("error", [s.name for s in shown]),
        texts("size", [f"{s.deviation:.3g} {s.unit}" for s in shown]),
        words("moves", [s.parameter for s in shown]),
        texts("bounds", [f"{s.bounds:.3g}" for s in shown]),
        texts("detected", [percent(s.noticed) for s in shown]),
        words("hidden", ["yes" if s.hidden else "" for s in shown]),
        words("unseen direction", [s.words if s.words != s.name else "" for s in shown]),
    ]
    yield Table("suspects", "Errors that the model leaves out", "", columns, notes=[note])
    yield from map(Strong, _unseen(design))


def _unseen(design: Design) -> Iterator[str]:
    if unseen := [s for s in design.suspects if s.hidden and s.noticed < _UNSEEN]:
        yield (
            f"Tests of residuals will not detect {enumerate_few([s.name for s in unseen])}, which parameters imitate."
            f" {unseen[0].parameter} will be wrong by {unseen[0].bounds:.3g} bounds where {unseen[0].name} is"
            f" {unseen[0].deviation:.3g} {unseen[0].unit}."
        )


def _ways(design: Design) -> Iterator[Part]:
    if not design.ways:
        why = (
            "they are too few"
            if design.observability.observable
            else "they do not determine all parameters"
        )
        yield f"The candidates offer no choice: {why}."
        return
    same = _no_others(design)
    if same:
        yield f"{same} `readings=NUMBER` chooses fewer of them."
        return
    today = design.scenario.measurement.m
    columns = [
        words("chosen", [way.title for way in design.ways]),
        texts(
            "fewest readings",
            [f"{way.saving.readings if way.saving else today}" for way in design.ways],
        ),
        texts(
            "bound",
            [f"{way.saving.mean_bound:.3f}" if way.saving else "1.000" for way in design.ways],
        ),
        texts("at most", [f"{way.sharpest.readings}" for way in design.ways]),
        texts("smallest bound", [f"{way.sharpest.mean_bound:.3f}" for way in design.ways]),
    ]
    title = f"Which readings to take instead (bounds as shares of today's, criterion {design.criterion})"
    note = (
        f"fewest readings is the number whose bound is no larger than today's {today}. Among {design.candidates.m}"
        " candidates those that gain most are taken one after another; another choice may be slightly better."
    )
    yield Table("ways", title, "", columns, notes=[note])
    for way in design.ways:
        if way.saving and len(way.units.by) == 1:
            entries = [way.units.entries[u][0] for u in way.saving.taken]
            levels = ", ".join(
                entry_in_words(design.candidates, way.units.by[0], entry) for entry in entries
            )
            yield f"{way.saving.readings} readings {way.title}: {levels}"


def write_design(folder: Path, name: str, design: Design) -> list[Path]:
    """Writes the page of a design, and readings.csv with what each choice takes; returns the files."""
    index = pd.DataFrame(dict(design.candidates.index))
    chosen = [
        index.iloc[list(choice.rows)].assign(by=" and ".join(way.units.by), choice=name)
        for way in design.ways
        for name, choice in (("saving", way.saving), ("sharpest", way.sharpest))
        if choice
    ]
    columns = ["by", "choice", *index]
    table = pd.concat(chosen)[columns] if chosen else pd.DataFrame(columns=columns)
    answer, parts = list(_design_sentences(design)), design_parts(name, design)
    return write_files(
        folder, "design", (READINGS, table), f"{name}: design", answer, parts, _draw_design(design)
    )


def designed(
    scenario: Scenario, errors: Sequence[Measurement] | None = None, **options: Any
) -> DesignAnswer:
    """Designs readings of a scenario; `errors` are richer models, by default those that the options offer."""
    known = richer_models(scenario) if errors is None else errors
    return DesignAnswer(**vars(design(replace(scenario, truth=None), errors=known, **options)))
