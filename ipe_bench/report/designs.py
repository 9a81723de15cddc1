"""What a design says: tables and sentences, and its files."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ipe_bench.measurements.identifiability import structure
from ipe_bench.report.table import Part, Strong, Table, texts, words
from ipe_bench.report.words import enumerate_few, percent
from ipe_bench.report.writer import picked, plain, write
from ipe_bench.runs.provenance import describe
from ipe_bench.trials.design import Choice, Design, Effect, Way, levels_of
from ipe_bench.trials.thresholds import FIT_LEVEL

if TYPE_CHECKING:
    import pandas as pd

NAME, READINGS, SCHEMA = "design", "readings.csv", 1
_MOST_SUSPECTS = 12
_MUST_BREAK = 1.02
"""Multiple of Van Trees's bound above which false roots are felt by any estimator."""
_UNSEEN = 0.05
"""Share of trials below which an error goes unnoticed by any test of residuals."""


def contents(name: str, design: Design) -> Iterator[Part]:
    """The tables and sentences of a design; `name` is what the model is called in the title."""
    yield _parameters(name, design)
    seen = design.observability
    direction = "Least observable direction" if seen.observable else "The readings do not determine"
    yield Strong(f"{direction}: {seen.words}")
    told = structure(design.scenario.measurement)
    if told is not None and not told.lost:
        yield f"Exact readings would tell all {len(told.unknowns)} parameters from their neighbours."
    yield from (Strong(f"No data can tell: {sentence}.") for sentence in (told.sentences if told else ()))
    if design.threshold:
        yield _threshold(design)
    yield from _suspects(design)
    yield from _ways(design)
    if design.effects:
        yield _effects(design)


def _parameters(name: str, design: Design) -> Table:
    seen, scenario = design.observability, design.scenario
    parameters, others = seen.parameters, seen.correlation - np.eye(len(seen.parameters))
    s = np.median(seen.singular_values, axis=0)
    columns = [
        words("parameter", [p.name for p in parameters]),
        words("unit", [p.unit for p in parameters]),
        texts("bound", [f"{bound * p.size:.3g}" for p, bound in zip(parameters, seen.bound, strict=True)]),
        texts("with the others", [f"{r:.2f}" for r in seen.multiple_correlation]),
    ]
    if len(parameters) > 1:
        most = np.argmax(np.abs(others), axis=1)
        columns.append(words("most", [f"{parameters[j].name} {others[i, j]:+.2f}" for i, j in enumerate(most)]))
    notes = [
        "bound is that of the standard deviation, as a root mean square over the prior. with the others is the"
        " multiple correlation of its error; most is the parameter with the largest correlation.",
        f"Singular values of the whitened Jacobian, per parameter's size: {s[0]:.3g} to {s[-1]:.3g}.",
    ]
    title = f"{name}, {scenario.noise.name}, error scale {scenario.error_scale:g}: what {scenario.measurement.m}"
    return Table("parameters", f"{title} readings say", "", columns, notes=notes)


def _threshold(design: Design) -> str:
    """Whether false roots are the estimator's own fault, or anyone's."""
    limit = design.threshold
    assert limit is not None
    if not limit.false_roots:
        return f"False roots: none in {limit.runs} runs of least squares from other truths."
    loss = float(np.max(limit.weiss_weinstein / limit.van_trees))
    if loss > _MUST_BREAK:
        blame = f"so no estimator can do better than {loss:.2f} times Van Trees's bound"
    elif limit.confusion < _UNSEEN:
        blame = "so ending there is the estimator's fault and not that of noise"
    else:
        blame = "which the Weiss-Weinstein bound, averaged over the prior, does not feel"
    return (
        f"False roots: {limit.false_roots} of {limit.runs} runs of least squares from other truths; readings of the"
        f" nearest are {limit.nearest:.3g} deviations off, and noise makes it fit better in {percent(limit.confusion)},"
        f" {blame}."
    )


def _suspects(design: Design) -> Iterator[Part]:
    if not design.suspects:
        return
    shown = design.suspects[:_MOST_SUSPECTS]
    note = (
        f"noticed is the share of trials in which the test of fit at {FIT_LEVEL:g} will report the error. It is hidden"
        " if it makes a parameter wrong by more than its bound and is noticed in less than half. looks like names the"
        " parameters that imitate it."
    )
    columns = [
        words("error", [s.name for s in shown]),
        texts("size", [f"{s.deviation:.3g} {s.unit}" for s in shown]),
        words("moves", [s.parameter for s in shown]),
        texts("bounds", [f"{s.bounds:.3g}" for s in shown]),
        texts("noticed", [percent(s.noticed) for s in shown]),
        words("hidden", ["yes" if s.hidden else "" for s in shown]),
        words("looks like", [s.words for s in shown]),
    ]
    yield Table("suspects", "Errors that the model leaves out", "", columns, notes=[note])
    unseen = [s for s in design.suspects if s.hidden and s.noticed < _UNSEEN]
    if unseen:
        yield Strong(
            f"No test of residuals will detect {enumerate_few([s.name for s in unseen])}: the parameters imitate it."
            f" {unseen[0].parameter} will be wrong by {unseen[0].bounds:.3g} bounds where {unseen[0].name} is"
            f" {unseen[0].deviation:.3g} {unseen[0].unit}."
        )


def _ways(design: Design) -> Iterator[Part]:
    if not design.ways:
        why = "they are too few" if design.observability.observable else "they do not determine all parameters"
        yield f"There is nothing to choose among the candidates: {why}."
        return
    today = design.scenario.measurement.m
    columns = [
        words("chosen", [way.title for way in design.ways]),
        texts("fewest readings", [f"{way.saving.readings if way.saving else today}" for way in design.ways]),
        texts("bound", [f"{way.saving.mean_bound:.3f}" if way.saving else "1" for way in design.ways]),
        texts("at most", [f"{way.sharpest.readings}" for way in design.ways]),
        texts("smallest bound", [f"{way.sharpest.mean_bound:.3f}" for way in design.ways]),
    ]
    title = f"What to take instead (bounds as shares of today's, criterion {design.criterion})"
    note = (
        f"fewest readings is the number whose bound is no larger than today's {today}. Among {design.candidates.m}"
        " candidates those that gain most are taken one after another; another choice may be slightly better."
    )
    yield Table("ways", title, "", columns, notes=[note])
    for way in design.ways:
        if way.saving and len(way.units.by) == 1:
            entries = [way.units.entries[u][0] for u in way.saving.taken]
            levels = ", ".join(levels_of(design.candidates, way.units.by[0], entry) for entry in entries)
            yield f"{way.saving.readings} readings {way.title}: {levels}"


def _effects(design: Design) -> Table:
    best: dict[tuple[str, str], Effect] = {}
    for e in sorted(design.effects, key=lambda e: e.mean_bound):
        if np.isfinite(e.mean_bound):
            best.setdefault((e.column, e.action), e)
    found = sorted(best.values(), key=lambda e: (list(design.candidates.index).index(e.column), e.action))
    cells = [
        words("what", [f"{e.action} {e.column} {levels_of(design.candidates, e.column, e.entry)}" for e in found]),
        texts("readings", [str(e.readings) for e in found]),
        texts("bound", [f"{e.mean_bound:.3f}" for e in found]),
    ]
    note = "The best to add, and the one that is missed least."
    return Table("effects", "One more, one less", "", cells, notes=[note])


def write_design(folder: Path, name: str, design: Design, command: Any) -> list[Path]:
    """Writes a design, of which readings.csv has what each choice takes, and returns the files.

    `command` tells one command from another.
    """
    content = {"schema": SCHEMA, "command": command, **described(design), "measurement": name}
    table = READINGS, _readings(design)
    return write(folder, NAME, f"{name}: design", contents(name, design), content=content, table=table)


def described(design: Design) -> dict[str, Any]:
    """All of it as plain data; bounds in the parameters' own units."""
    seen, limit, scenario = design.observability, design.threshold, design.scenario
    sizes = np.array([p.size for p in seen.parameters])
    each = zip(seen.parameters, plain(seen.bound * sizes), plain(seen.multiple_correlation), strict=True)
    names = ("name", "deviation", "unit", "parameter", "visible", "noticed")
    bounds = limit and {name: plain(getattr(limit, name) * sizes) for name in ("van_trees", "weiss_weinstein")}
    return {
        "measurement": scenario.measurement.name,
        "error_scale": scenario.error_scale,
        "criterion": design.criterion,
        "readings": scenario.measurement.m,
        "candidates": design.candidates.m,
        "observable": seen.observable,
        "least_observable_direction": seen.words,
        "singular_values": plain(np.median(seen.singular_values, axis=0)),
        "parameters": [{**picked(p, "name", "unit"), "bound": b, "multiple_correlation": r} for p, b, r in each],
        "correlation": plain(seen.correlation),
        "suspects": [
            picked(s, *names)
            | {"shift": plain(s.shift * sizes), "shift_in_bounds": plain(s.bounds), "direction": s.words}
            for s in design.suspects
        ],
        "threshold": bounds and bounds | picked(limit, "false_roots", "runs", "nearest"),
        "ways": [
            {
                "by": list(way.units.by),
                "units": len(way.units.rows),
                "curve": [picked(c, "readings", "mean_bound") for c in way.curve],
                "saving": way.saving and _chosen(design, way, way.saving),
                "sharpest": _chosen(design, way, way.sharpest),
            }
            for way in design.ways
        ],
        "effects": [picked(e, "column", "entry", "action", "readings", "mean_bound") for e in design.effects],
    }


def _chosen(design: Design, way: Way, choice: Choice) -> dict[str, Any]:
    """A choice as plain data, with the options of the model that takes these readings, or None if no options do."""
    model, today = design.measurement(choice), design.scenario.measurement
    before = describe(today)
    options = {name: value for name, value in describe(model).items() if value != before.get(name)}
    return {
        **picked(choice, "readings", "mean_bound"),
        "units": [plain(way.units.entries[u]) for u in choice.taken],
        "options": options if type(model) is type(today) else None,
    }


def _readings(design: Design) -> pd.DataFrame:
    """What each choice takes, a row per reading."""
    import pandas as pd

    index = pd.DataFrame(dict(design.candidates.index))
    chosen = [
        index.iloc[list(choice.rows)].assign(by=" and ".join(way.units.by), choice=name)
        for way in design.ways
        for name, choice in (("saving", way.saving), ("sharpest", way.sharpest))
        if choice
    ]
    columns = ["by", "choice", *index]
    return pd.concat(chosen)[columns] if chosen else pd.DataFrame(columns=columns)
