"""What a design says, as tables in the terminal and as files."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ipe_bench.basics.files import write_atomically
from ipe_bench.report.examined import numbers
from ipe_bench.report.words import enumerate_few, percent
from ipe_bench.runs.provenance import describe
from ipe_bench.trials.design import Choice, Design, Effect, Way, levels_of
from ipe_bench.trials.thresholds import FIT_LEVEL

if TYPE_CHECKING:
    from rich.console import Group

SCHEMA = 1
RESULT = "design.json"
READINGS = "readings.csv"
FILES = (READINGS, "design.png", "design.pdf")
_MOST_SUSPECTS = 12
_MUST_BREAK = 1.02
"""Above this multiple of Van Trees's bound, false roots are felt by any estimator."""
_UNSEEN = 0.05
"""Noticed in fewer trials than this, an error is one that no test of residuals will see."""


def write_design(folder: Path, design: Design, command: Any, provenance: Mapping[str, Any]) -> list[Path]:
    """Writes design.json, readings.csv (what each choice takes) and the figure; returns the files.

    `command` tells one command from another; `provenance` is added to the JSON file.
    """
    from ipe_bench.report.figures.designs import draw_design

    result, table = folder / RESULT, folder / READINGS
    text = json.dumps({"schema": SCHEMA, "command": command, **described(design), **provenance}, indent=1)
    write_atomically(result, lambda path: path.write_text(text + "\n", encoding="utf-8"))

    def write_table(path: Path) -> None:
        with path.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows(_reading_rows(design))

    write_atomically(table, write_table)
    files = [result, table]
    for drawing in draw_design(design):
        files += drawing.save(folder)
    for name in FILES:
        if folder / name not in files:
            (folder / name).unlink(missing_ok=True)
    return files


def described(design: Design) -> dict[str, Any]:
    """All of it as plain data; bounds in the parameters' own units."""
    seen, sizes = design.observability, np.array([p.size for p in design.observability.parameters])
    return {
        "measurement": design.scenario.measurement.name,
        "error_scale": design.scenario.error_scale,
        "criterion": design.criterion,
        "readings": design.scenario.measurement.m,
        "candidates": design.candidates.m,
        "observable": seen.observable,
        "least_observable_direction": seen.words,
        "singular_values": numbers(np.median(seen.singular_values, axis=0)),
        "parameters": [
            {"name": p.name, "unit": p.unit, "bound": numbers(b), "multiple_correlation": numbers(r)}
            for p, b, r in zip(seen.parameters, seen.bound * sizes, seen.multiple_correlation, strict=True)
        ],
        "correlation": numbers(seen.correlation),
        "suspects": [
            {
                "name": s.name,
                "deviation": s.deviation,
                "unit": s.unit,
                "shift": numbers(s.shift * sizes),
                "shift_in_bounds": numbers(s.bounds),
                "parameter": s.parameter,
                "visible": numbers(s.visible),
                "noticed": numbers(s.noticed),
                "direction": s.words,
            }
            for s in design.suspects
        ],
        "threshold": design.threshold
        and {
            "van_trees": numbers(design.threshold.van_trees * sizes),
            "weiss_weinstein": numbers(design.threshold.weiss_weinstein * sizes),
            "false_roots": design.threshold.false_roots,
            "runs": design.threshold.runs,
            "nearest": numbers(design.threshold.nearest),
        },
        "ways": [
            {
                "by": list(way.units.by),
                "units": len(way.units.rows),
                "curve": [{"readings": c.readings, "mean_bound": c.mean_bound} for c in way.curve],
                **{name: _choice(design, way, c) for name, c in (("saving", way.saving), ("sharpest", way.sharpest))},
            }
            for way in design.ways
        ],
        "effects": [
            {
                "column": e.column,
                "entry": _plain(e.entry),
                "action": e.action,
                "readings": e.readings,
                "mean_bound": numbers(e.mean_bound),
            }
            for e in design.effects
        ],
    }


def _choice(design: Design, way: Way, choice: Choice | None) -> dict[str, Any] | None:
    if choice is None:
        return None
    return {
        "readings": choice.readings,
        "mean_bound": choice.mean_bound,
        "no_design_below": choice.least,
        "units": [[_plain(value) for value in way.units.entries[u]] for u in choice.taken],
        "options": _options(design, choice),
    }


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value


def _options(design: Design, choice: Choice) -> dict[str, Any] | None:
    """The options of the model that takes these readings, where they differ from today's; None where no options say
    it."""
    model, today = design.measurement(choice), design.scenario.measurement
    if type(model) is not type(today):
        return None
    found, before = describe(model), describe(today)
    return {name: value for name, value in found.items() if value != before.get(name)}


def _reading_rows(design: Design) -> Iterator[list[Any]]:
    index = design.candidates.index
    yield ["by", "choice", *index]
    for way in design.ways:
        for name, choice in (("saving", way.saving), ("sharpest", way.sharpest)):
            for row in choice.rows if choice else ():
                yield [" and ".join(way.units.by), name, *(column[row] for column in index.values())]


def render(name: str, design: Design) -> Group:
    """The tables for a terminal; `name` is what the model is called in the title."""
    from rich.console import Group

    parts = [*_parameters(name, design), *_suspects(design), *_ways(design), *_effects(design)]
    return Group(*parts)


def _title(text: str) -> Any:
    from rich.text import Text

    return Text(text, style="bold")


def _table(headings: Sequence[tuple[str, str]]) -> Any:
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for heading, justify in headings:
        table.add_column(heading, justify=justify, overflow="fold")  # type: ignore[arg-type]
    return table


def _note(*lines: str) -> Any:
    from rich.text import Text

    return Text("\n".join(lines), style="dim")


def _parameters(name: str, design: Design) -> Iterator[Any]:
    from rich.text import Text

    seen, scenario = design.observability, design.scenario
    readings = f"what {scenario.measurement.m} readings say"
    yield _title(f"{name}, {scenario.noise.name}, error scale {scenario.error_scale:g}: {readings}")
    table = _table(
        [("parameter", "left"), ("unit", "left"), ("bound", "right"), ("with the others", "right"), ("most", "left")],
    )
    C = seen.correlation - np.eye(len(seen.parameters))
    for i, p in enumerate(seen.parameters):
        j = int(np.argmax(np.abs(C[i])))
        most = f"{seen.parameters[j].name} {C[i, j]:+.2f}" if len(C) > 1 else ""
        cells = (f"{seen.bound[i] * p.size:.3g}", f"{seen.multiple_correlation[i]:.2f}", most)
        table.add_row(Text(p.name), Text(p.unit), *(Text(cell) for cell in cells))
    yield table
    s = np.median(seen.singular_values, axis=0)
    yield _note(
        "bound: of the standard deviation, root mean square over the prior. with the others: multiple correlation of"
        " its error; most: the one it goes with most.",
        f"Singular values of the whitened Jacobian, per parameter's size: {s[0]:.3g} to {s[-1]:.3g}.",
    )
    verdict = "Least observable direction" if seen.observable else "The readings do not determine"
    yield Text(f"{verdict}: {seen.words}", style="bold")
    yield Text(f"{_threshold(design)}\n" if design.threshold else "")


def _threshold(design: Design) -> str:
    """Whether false roots are the estimator's own fault, or anyone's."""
    limit = design.threshold
    assert limit is not None
    if not limit.false_roots:
        return f"False roots: none in {limit.runs} runs of least squares from other truths."
    loss = float(np.max(limit.weiss_weinstein / limit.van_trees))
    blame = (
        f"so no estimator can do better than {loss:.2f} times Van Trees's bound"
        if loss > _MUST_BREAK
        else "so ending there is the estimator's fault and not that of noise"
        if limit.confusion < _UNSEEN
        else "which the Weiss-Weinstein bound, averaged over the prior, does not feel"
    )
    return (
        f"False roots: {limit.false_roots} of {limit.runs} runs of least squares from other truths; readings of the"
        f" nearest are {limit.nearest:.3g} deviations off, and noise makes it fit better in {percent(limit.confusion)},"
        f" {blame}."
    )


def _suspects(design: Design) -> Iterator[Any]:
    from rich.text import Text

    if not design.suspects:
        return
    yield _title("Errors that the model leaves out")
    headings = [("error", "left"), ("size", "right"), ("moves", "left"), ("bounds", "right"), ("noticed", "right")]
    table = _table([*headings, ("hidden", "left"), ("looks like", "left")])
    for s in design.suspects[:_MOST_SUSPECTS]:
        size, noticed = f"{s.deviation:.3g} {s.unit}", percent(s.noticed)
        row = (s.name, size, s.parameter, f"{s.bounds:.3g}", noticed, "yes" if s.hidden else "", s.words)
        table.add_row(*(Text(cell) for cell in row))
    yield table
    unseen = [s for s in design.suspects if s.hidden and s.noticed < _UNSEEN]
    if unseen:
        yield _title(
            f"No test of residuals will see {enumerate_few([s.name for s in unseen])}: the parameters imitate it."
            f" {unseen[0].parameter} will be wrong by {unseen[0].bounds:.3g} bounds where {unseen[0].name} is"
            f" {unseen[0].deviation:.3g} {unseen[0].unit}."
        )
    yield _note(
        f"noticed: trials in which the test of fit at {FIT_LEVEL:g} will say so. hidden: wrong by more than a bound,"
        " and noticed in less than half. looks like: what cancels in the readings.",
        "",
    )


def _ways(design: Design) -> Iterator[Any]:
    from rich.text import Text

    today = design.scenario.measurement.m
    if not design.ways:
        why = "they are too few" if design.observability.observable else "they do not determine all parameters"
        yield _note(f"There is nothing to choose among the candidates: {why}.")
        return
    yield _title(f"What to take instead (bounds as shares of today's, criterion {design.criterion})")
    table = _table(
        [
            ("chosen", "left"),
            ("fewest readings", "right"),
            ("bound", "right"),
            ("none below", "right"),
            ("at most", "right"),
            ("smallest bound", "right"),
            ("none below", "right"),
        ]
    )
    for way in design.ways:
        few, best = way.saving, way.sharpest
        cells = [f"{few.readings}", f"{few.mean_bound:.3f}", f"{few.least:.3f}"] if few else [f"{today}", "1", ""]
        cells += [f"{best.readings}", f"{best.mean_bound:.3f}", f"{best.least:.3f}"]
        table.add_row(Text(way.title), *cells)
    yield table
    yield _note(
        f"fewest readings: with no larger bound than today's {today}. none below: no choice of so many readings among"
        f" the {design.candidates.m} candidates, in this way, has a smaller one.",
    )
    for way in design.ways:
        if way.saving and len(way.units.by) == 1:
            yield Text(f"{way.saving.readings} readings {way.title}: {taken(design, way, way.saving)}")
    yield Text("")


def taken(design: Design, way: Way, choice: Choice) -> str:
    """The entries of a choice by one column, in words."""
    (column,) = way.units.by
    return ", ".join(levels_of(design.candidates, column, way.units.entries[u][0]) for u in choice.taken)


def _effects(design: Design) -> Iterator[Any]:
    from rich.text import Text

    if not design.effects:
        return
    yield _title("One more, one less")
    table = _table([("what", "left"), ("readings", "right"), ("bound", "right")])
    for column in dict.fromkeys(e.column for e in design.effects):
        for action in ("add", "drop"):
            best = _best([e for e in design.effects if (e.column, e.action) == (column, action)])
            if best:
                what = f"{action} {column} {levels_of(design.candidates, column, best.entry)}"
                table.add_row(Text(what), str(best.readings), f"{best.mean_bound:.3f}")
    yield table
    yield _note("The best to add, and the one that is missed least.")


def _best(effects: Sequence[Effect]) -> Effect | None:
    finite = [e for e in effects if np.isfinite(e.mean_bound)]
    return min(finite, key=lambda e: e.mean_bound) if finite else None
