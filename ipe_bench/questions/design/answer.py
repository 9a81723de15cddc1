"""Shows a design: sentences, tables, picture, files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from ipe_bench.measurements.function import title_of
from ipe_bench.measurements.identifiability import structure
from ipe_bench.plugins.extensions import richer_models
from ipe_bench.questions.design.maths import (
    Design,
    Further,
    Way,
    covariance_of,
    design,
    entry_in_words,
)
from ipe_bench.report.page.writer import write_files
from ipe_bench.report.tables.table import (
    Column,
    Fact,
    Legend,
    Part,
    Shown,
    Strong,
    Table,
    naming,
    texts,
    words,
)
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
        return design_parts(title_of(self.scenario.measurement), self)


def _best(design: Design) -> Way | None:
    """Returns the way whose sharpest choice has the smallest mean bound; None without a choice."""
    return min(design.ways, key=lambda way: way.sharpest.mean_bound, default=None)


def _direction(seen: Observability) -> str:
    start = "Worst-determined combination" if seen.observable else "The readings do not determine"
    return Fact(start, seen.words)


def _no_others(design: Design) -> str:
    """Says that no way takes other readings than today's; empty if one does. Those that may be read
    beside them are candidates as well."""
    today = design.scenario.measurement.m
    fewer = any(way.saving or way.sharpest.readings != today for way in design.ways)
    if fewer or not design.ways or design.candidates.m != today:
        return ""
    if design.further is not None:
        return f"Every choice without further readings is among the present {today}"
    return f"The present {today} readings are the only candidates"


def _findings(design: Design) -> list[str]:
    """Returns what was found without a point at the end, the most useful first: what readings
    leave open, or else which to take."""
    same = _no_others(design)
    best = _best(design)
    found = list(_further_findings(design))
    if same and not found:
        found.append(same)
    elif best and not same:
        found.append(_best_finding(best, design.scenario.measurement.m))
    direction = _direction(design.observability)
    found.insert(len(found) if design.observability.observable else 0, direction)
    return found


def _best_finding(way: Way, today: int) -> str:
    """Says what a way's sharpest choice is worth beside today's number of readings."""
    choice = way.sharpest
    if choice.readings == today and choice.mean_bound >= 1 - _WORTH:
        return "The present readings are already optimal for their number"
    share = percent(choice.mean_bound)
    return f"{choice.readings} readings chosen {way.title} have {share} of today's mean bound"


def _further_findings(design: Design) -> Iterator[str]:
    """Says what to read next, then two more, each time with the bound that falls most by it."""
    further = design.further
    if further is None:
        return
    where = [further.words[i] for i in further.taken]
    yield f"Read next at {where[0]}; {_fall(design, further, 0, 1)}"
    two = f"at {where[1]} and {where[2]}"
    if where[1] == where[2]:
        two = f"twice at {where[1]}"
    yield Fact("Two more after it", f"{two}; {_fall(design, further, 1, 3)}")


def _fall(design: Design, further: Further, before: int, after: int) -> str:
    """Says which bound falls most between these numbers of further readings."""
    most = int(np.argmin(further.bounds[after] / further.bounds[before]))
    parameter = design.observability.parameters[most]
    high, low = (scientific(parameter.size * further.bounds[k, most]) for k in (before, after))
    unit = f" {parameter.unit}" if parameter.unit else ""
    return f"the bound of {parameter.name} then falls from {high} to {low}{unit}"


def _further(design: Design) -> Iterator[Table]:
    further = design.further
    if further is None:
        return
    shares = further.bounds[1:] / further.bounds[0]
    names = [p.name for p in design.observability.parameters]
    columns = [
        texts("further readings", [str(1 + k) for k in range(len(shares))]),
        words("next at", [further.words[i] for i in further.taken]),
        texts("mean bound", [f"{np.sqrt(np.mean(share**2)):.3f}" for share in shares]),
        texts("smallest", [f"{share.min():.3f}" for share in shares]),
        words("of", [names[int(np.argmin(share))] for share in shares]),
    ]
    note = Legend(
        f"Bounds are shares of today's at {_where(design)}. Each further reading is the one of the"
        " candidates that cuts the mean square of these shares most; an input's candidates reach to"
        " four times its range."
    )
    title = "What to read next, in addition to today's readings"
    yield Table("further", title, "", columns, notes=[note])


def _draw_design(design: Design) -> Iterator[Drawing]:
    from ipe_bench.questions.design.figure import draw_bounds, draw_further

    if design.further is not None:
        yield draw_further(design.scenario.measurement, design.further)
    best = None if _no_others(design) else _best(design)
    after = None
    title = ""
    if best is not None:
        model = design.measurement(best.sharpest)
        R = covariance_of(design.scenario, model)
        after = Observability.at(model, R, design.x)
        title = f"best choice {best.title}"
    yield from draw_bounds(design.observability, after, title, _where(design))


def design_parts(name: str, design: Design) -> Iterator[Part]:
    """Yields the tables and sentences of a design, under the `name` of its model."""
    yield _parameters(name, design)
    yield Strong(_direction(design.observability))
    told = structure(design.scenario.measurement)
    if told:
        if not told.lost:
            yield f"Exact readings would determine all {len(told.unknowns)} parameters locally."
        yield from (Strong(f"Not identifiable: {sentence}.") for sentence in told.sentences)
    yield from _further(design)
    yield from _suspects(design)
    yield from _ways(design)


def _parameters(name: str, design: Design) -> Table:
    seen = design.observability
    scenario = design.scenario
    parameters = seen.parameters
    bounds = [p.size * bound for p, bound in zip(parameters, seen.bound, strict=True)]
    columns = [
        *naming("parameter", parameters),
        texts("bound", [scientific(bound) for bound in bounds]),
        *_over_the_prior(design),
        texts("correlation with all others", [f"{r:.2f}" for r in seen.multiple_correlation]),
    ]
    if len(parameters) > 1:
        others = seen.correlation - np.eye(len(parameters))
        most = np.argmax(np.abs(others), axis=1)
        strongest = [f"{parameters[j].name} {others[i, j]:+.2f}" for i, j in enumerate(most)]
        columns.append(words("strongest", strongest))
    s = seen.singular_values[0]
    notes: list[str] = [
        Legend(
            "bound: smallest standard deviation of an unbiased estimator at the true values of"
            f" {_where(design)}. Correlations of the errors there: multiple correlation with all"
            " others, and the strongest with one other."
        ),
        f"Singular values of the whitened Jacobian, per parameter's size: {short(s[0])} to"
        f" {short(s[-1])}.",
    ]
    if design.lost:
        notes.append(
            f"{design.lost} of {TRUTHS} true parameters from the prior have no finite readings and"
            " are left out."
        )
    about = "at the estimate"
    if design.at is None:
        about = f"error scale {scenario.error_scale:g}"
        notes.append(
            Legend(
                f"over the prior: median and quartiles of the bound at {len(design.x) - 1} true"
                " parameters of this error scale."
            )
        )
    setting = f"{name}, {scenario.noise.name}, {about}"
    title = f"{setting}: what {scenario.measurement.m} readings determine"
    return Table("parameters", title, "", columns, notes=notes)


def _where(design: Design) -> str:
    at_start = design.at is None and not design.about_estimate
    return "the start" if at_start else "the estimate"


def _over_the_prior(design: Design) -> Iterator[Column]:
    """Yields a column with the bounds at truths from the prior, where there are any."""
    if design.at is not None:
        return
    sizes = [p.size for p in design.observability.parameters]
    quartiles = np.transpose(design.observability.quartiles * sizes)
    told = [[scientific(one) for one in row] for row in quartiles]
    cells = [f"{median} ({low} to {high})" for low, median, high in told]
    yield texts("over the prior", cells)


def _suspects(design: Design) -> Iterator[Part]:
    if not design.suspects:
        return
    shown = design.suspects[:_MOST_SUSPECTS]
    note = Legend(
        f"detected: share of trials in which the test of fit at {FIT_LEVEL:g} reports the error."
        " An error is hidden if it makes a parameter wrong by more than its bound and is detected"
        " in less than half of the trials. The unseen direction barely changes the readings."
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
    unseen = [s for s in design.suspects if s.hidden and s.noticed < _UNSEEN]
    if not unseen:
        return
    worst = unseen[0]
    yield (
        f"Tests of residuals will not detect {enumerate_few([s.name for s in unseen])}, which look"
        f" like parameter changes. {worst.parameter} will be wrong by {worst.bounds:.3g} bounds"
        " where"
        f" {worst.name} is {worst.deviation:.3g} {worst.unit}."
    )


def _ways(design: Design) -> Iterator[Part]:
    if not design.ways:
        why = "they do not determine all parameters"
        if design.observability.observable:
            why = "they are too few"
        yield f"The candidates offer no choice: {why}."
        return
    same = _no_others(design)
    if same:
        yield f"{same}. `readings=NUMBER` chooses fewer of them."
        return
    today = design.scenario.measurement.m
    # A way without a saving takes what is taken today.
    savings = [
        (way.saving.readings, way.saving.mean_bound) if way.saving else (today, 1.0)
        for way in design.ways
    ]
    sharpest = [way.sharpest for way in design.ways]
    columns = [
        words("chosen", [way.title for way in design.ways]),
        texts("fewest readings", [f"{readings}" for readings, _ in savings]),
        texts("bound", [f"{bound:.3f}" for _, bound in savings]),
        texts("at most", [f"{choice.readings}" for choice in sharpest]),
        texts("smallest bound", [f"{choice.mean_bound:.3f}" for choice in sharpest]),
    ]
    title = (
        "Which readings to take instead (bounds as shares of today's, criterion"
        f" {design.criterion})"
    )
    note = Legend(
        f"fewest readings is the number whose bound is no larger than today's {today}. Chosen"
        " greedily from the candidates; a slightly better set may exist."
    )
    yield Table("ways", title, "", columns, notes=[note])
    for way in design.ways:
        if way.saving and len(way.units.by) == 1:
            (column,) = way.units.by
            taken = [way.units.entries[u][0] for u in way.saving.taken]
            levels = [entry_in_words(design.candidates, column, entry) for entry in taken]
            yield f"{way.saving.readings} readings {way.title}: {', '.join(levels)}"


def write_design(folder: Path, name: str, design: Design) -> list[Path]:
    """Writes the page of a design, and readings.csv with what each choice takes; returns the
    files."""
    index = pd.DataFrame(dict(design.candidates.index))
    chosen = []
    for way in design.ways:
        by = " and ".join(way.units.by)
        for word, choice in (("saving", way.saving), ("sharpest", way.sharpest)):
            if choice:
                rows = index.iloc[list(choice.rows)]
                chosen.append(rows.assign(by=by, choice=word))
    columns = ["by", "choice", *index]
    table = pd.concat(chosen)[columns] if chosen else pd.DataFrame(columns=columns)
    title, *findings = _findings(design)
    facts = [Fact("Hidden errors", sentence) for sentence in _unseen(design)]
    for one in findings:
        label, text = (one.label, one.text) if isinstance(one, Fact) else ("Choice", one)
        facts.append(Fact(label, f"{text}."))
    return write_files(
        folder,
        "design",
        (READINGS, table),
        f"{name}: {title[0].lower()}{title[1:]}",
        facts,
        design_parts(name, design),
        _draw_design(design),
        lead=(
            "Bound: the smallest standard deviation that an unbiased estimator can have"
            f" (Cramér-Rao), at {_where(design)}."
        ),
        facts=[f"{design.scenario.measurement.m} readings today"],
    )


def designed(
    scenario: Scenario, errors: Sequence[Measurement] | None = None, **options: Any
) -> DesignAnswer:
    """Designs readings of a scenario; `errors` are richer models, by default those that the options
    offer."""
    known = richer_models(scenario) if errors is None else errors
    found = design(replace(scenario, truth=None), errors=known, **options)
    return DesignAnswer(**vars(found))
