"""Writes the answers of `design`, `posterior`, `compare` and `audit`: sentences, tables, pictures, and files."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import chain, groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from ipe_bench.basics.statuses import Status
from ipe_bench.measurements.identifiability import structure
from ipe_bench.report.table import Cell, Column, Part, Shown, Strong, Table, texts, words
from ipe_bench.report.words import compact, duration, enumerate_few, p_value, percent, scientific, short, value_text
from ipe_bench.report.writer import write_files
from ipe_bench.statistics.audit import Audit
from ipe_bench.statistics.between import NOT_SETTINGS, comparison_title
from ipe_bench.trials.design import Design, Way, entry_in_words
from ipe_bench.trials.observability import TRUTHS, Observability
from ipe_bench.trials.posterior import Divergence, Posterior, Reference
from ipe_bench.trials.thresholds import FIT_LEVEL

if TYPE_CHECKING:
    from ipe_bench.measurements.base import Measurement
    from ipe_bench.report.figures.drawing import Drawing
    from ipe_bench.trials.scenario import Scenario

READINGS = "readings.csv"
"""Columns of a design's choices, one row per reading."""
HONEST = 0.1
"""Nats up to which a Gaussian may stand for another: a deviation is 40 % too large, or a mean half a deviation off."""
SAME_LAW = 0.05
"""Energy distance up to which draws may come from one law: of Gaussians in few dimensions, some tenths of a nat."""
_MOST_SUSPECTS = 12
_TITLES = {"error": "mean error", "honesty": "mean NEES", "cost": "mean cost", "time": "mean time"}
"""Names of a comparison's quantities, where the table of a run has other statistics of error and cost."""
_LEAST_P, _MOST_EVIDENCE = 1e-6, 1000
_WORTH = 0.005
"""Part of the mean bound below which a better choice is none."""
_UNSEEN = 0.05
"""Share of trials below which an error goes unnoticed by any test of residuals."""


# Design --------------------------------------------------------------------------------------------------------------


class DesignAnswer(Shown, Design):
    """Shows a design."""

    def parts(self) -> Iterator[Part]:
        return design_parts(self.scenario.measurement.name, self)


def _best(design: Design) -> Way | None:
    """Returns the way whose sharpest choice has the smallest mean bound; None without a choice."""
    return min(design.ways, key=lambda way: way.sharpest.mean_bound, default=None)


def _direction(seen: Observability) -> str:
    return f"{'Least observable direction' if seen.observable else 'The readings do not determine'}: {seen.words}"


def _no_others(design: Design) -> str:
    """Says that no way takes other readings than today's; empty if one does."""
    today = design.scenario.measurement.m
    fewer = any(way.saving or way.sharpest.readings != today for way in design.ways)
    if fewer or not design.ways or design.candidates.m != today:
        return ""
    return f"The candidates are today's {today} readings, so there is no other choice."


def _design_sentences(design: Design) -> Iterator[str]:
    yield f"{_direction(design.observability)}."
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


def _draw_design(design: Design) -> Iterator[Drawing]:
    from ipe_bench.report.figures.answers import draw_bounds

    best, scenario, after = None if _no_others(design) else _best(design), design.scenario, None
    if best is not None:
        model = design.measurement(best.sharpest)
        after = Observability.at(model, scenario.noise.covariance(model.m), scenario.truths(0, TRUTHS))
    yield from draw_bounds(design.observability, after, f"best choice {best.title}" if best else "")


def design_parts(name: str, design: Design) -> Iterator[Part]:
    """Yields the tables and sentences of a design, under the `name` of its model."""
    yield _parameters(name, design)
    yield Strong(_direction(design.observability))
    if told := structure(design.scenario.measurement):
        if not told.lost:
            yield f"Exact readings would tell all {len(told.unknowns)} parameters from their neighbours."
        yield from (Strong(f"No data can tell: {sentence}.") for sentence in told.sentences)
    yield from _suspects(design)
    yield from _ways(design)


def _parameters(name: str, design: Design) -> Table:
    seen, scenario = design.observability, design.scenario
    parameters, others = seen.parameters, seen.correlation - np.eye(len(seen.parameters))
    s = np.median(seen.singular_values, axis=0)
    columns = [
        words("parameter", [p.name for p in parameters]),
        words("unit", [p.unit for p in parameters]),
        texts("bound", [scientific(bound * p.size) for p, bound in zip(parameters, seen.bound, strict=True)]),
        texts("correlation with all others", [f"{r:.2f}" for r in seen.multiple_correlation]),
    ]
    if len(parameters) > 1:
        most = np.argmax(np.abs(others), axis=1)
        columns.append(words("strongest", [f"{parameters[j].name} {others[i, j]:+.2f}" for i, j in enumerate(most)]))
    notes = [
        "bound is that of the standard deviation, as a root mean square over the prior. The correlation with all others"
        " is the multiple correlation of its error; strongest is that with a single one.",
        f"Singular values of the whitened Jacobian, per parameter's size: {short(s[0])} to {short(s[-1])}.",
    ]
    title = f"{name}, {scenario.noise.name}, error scale {scenario.error_scale:g}: what {scenario.measurement.m}"
    return Table("parameters", f"{title} readings say", "", columns, notes=notes)


def _suspects(design: Design) -> Iterator[Part]:
    if not design.suspects:
        return
    shown = design.suspects[:_MOST_SUSPECTS]
    note = (
        f"noticed is the share of trials in which the test of fit at {FIT_LEVEL:g} will report the error. It is hidden"
        " if it makes a parameter wrong by more than its bound and is noticed in less than half. The readings"
        " hardly change along the unseen direction."
    )
    columns = [
        words("error", [s.name for s in shown]),
        texts("size", [f"{s.deviation:.3g} {s.unit}" for s in shown]),
        words("moves", [s.parameter for s in shown]),
        texts("bounds", [f"{s.bounds:.3g}" for s in shown]),
        texts("noticed", [percent(s.noticed) for s in shown]),
        words("hidden", ["yes" if s.hidden else "" for s in shown]),
        words("unseen direction", [s.words if s.words != s.name else "" for s in shown]),
    ]
    yield Table("suspects", "Errors that the model leaves out", "", columns, notes=[note])
    yield from map(Strong, _unseen(design))


def _unseen(design: Design) -> Iterator[str]:
    if unseen := [s for s in design.suspects if s.hidden and s.noticed < _UNSEEN]:
        yield (
            f"No test of residuals will detect {enumerate_few([s.name for s in unseen])}, which parameters imitate."
            f" {unseen[0].parameter} will be wrong by {unseen[0].bounds:.3g} bounds where {unseen[0].name} is"
            f" {unseen[0].deviation:.3g} {unseen[0].unit}."
        )


def _ways(design: Design) -> Iterator[Part]:
    if not design.ways:
        why = "they are too few" if design.observability.observable else "they do not determine all parameters"
        yield f"The candidates offer no choice: {why}."
        return
    same = _no_others(design)
    if same:
        yield f"{same} `--readings NUMBER` chooses fewer of them."
        return
    today = design.scenario.measurement.m
    columns = [
        words("chosen", [way.title for way in design.ways]),
        texts("fewest readings", [f"{way.saving.readings if way.saving else today}" for way in design.ways]),
        texts("bound", [f"{way.saving.mean_bound:.3f}" if way.saving else "1.000" for way in design.ways]),
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
            levels = ", ".join(entry_in_words(design.candidates, way.units.by[0], entry) for entry in entries)
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
    return write_files(folder, "design", (READINGS, table), f"{name}: design", answer, parts, _draw_design(design))


# Posterior -----------------------------------------------------------------------------------------------------------


class PosteriorAnswer(Shown, list[Reference]):
    """Shows the posteriors of a scenario's trials."""

    def __init__(self, scenario: Scenario, found: Sequence[Reference]) -> None:
        super().__init__(found)
        self.name = f"{scenario.measurement.name}, {scenario.noise.name}, error scale {scenario.error_scale:g}"

    def parts(self) -> list[Table]:
        return posterior_parts(self.name, self)


def posterior_parts(name: str, found: Sequence[Reference]) -> list[Table]:
    """Returns a row per trial and estimator, under the `name` of the scenario."""
    rows = [(one, label, d) for one in found for label, d in one.divergences.items()]
    columns = [
        texts("trial", [str(one.trial) for one, *_ in rows]),
        texts("modes", [str(len(one.posterior.modes)) for one, *_ in rows]),
        texts("noise", [compact(one.posterior.noise) for one, *_ in rows]),
        words("estimator", [label for _, label, _ in rows]),
        words("status", [Status(int(one.estimates[label].status[0])).label for one, label, _ in rows]),
        words("honest", [honest_word(d, one.posterior) for one, _, d in rows]),
    ]
    numbers = {"kl": "divergence", "shift": "shift", "width": "width", "energy": "energy"}
    columns += [texts(title, [compact(getattr(d, key)) for *_, d in rows]) for key, title in numbers.items()]
    title = f"{name}: estimators beside the posterior"
    return [Table("posterior", title, "", columns, notes=list(_notes(found)), grouped=3)]


def _notes(found: Sequence[Reference]) -> Iterator[str]:
    yield (
        "divergence is that of the estimator's Gaussian from the moments of the posterior, in nats; noise is"
        " the same between two populations of particles, so a divergence below it is chance. shift is that of the"
        " mean, in standard deviations of the posterior per root of the number of parameters. width is the geometric"
        " mean of the standard deviations over those of the posterior. energy is the distance between draws. An"
        f" estimate is honest if there is a single mode, the divergence is at most {HONEST:g} or twice the noise, and"
        f" the energy is at most {SAME_LAW:g}."
    )
    for one in found:
        if not one.posterior.settled:
            yield (
                f"Trial {one.trial}: the populations differ by {one.posterior.apart:.2g} deviations, so its posterior"
                " cannot be relied on; take more particles."
            )
        if len(one.posterior.modes) > 1:
            shares = ", ".join(percent(float(share)) for share in one.posterior.shares)
            yield f"Trial {one.trial}: {len(one.posterior.modes)} modes, with {shares} of the draws."


def honest_word(d: Divergence, sampled: Posterior) -> str:
    """Words whether a Gaussian can stand for the posterior; a wide one over two modes, with its moments, cannot."""
    if not np.isfinite(d.kl):
        return "-"
    near = d.kl <= max(HONEST, 2 * sampled.noise) and d.energy <= SAME_LAW
    return "yes" if near and len(sampled.modes) == 1 else "NO"


def write_posteriors(folder: Path, name: str, title: str, model: Measurement, found: Sequence[Reference]) -> list[Path]:
    """Writes a page, and posterior.csv with a row per trial and parameter; returns the files."""
    from ipe_bench.report.figures.answers import draw_marginals

    frames = []
    for one in found:
        names = {"parameter": [p.name for p in model.parameters], "unit": [p.unit for p in model.parameters]}
        values = {"truth": one.truth, "mean": one.posterior.mean, "deviation": one.posterior.deviation}
        sized = {key: model.sizes * value for key, value in values.items()}
        frames.append(pd.DataFrame({"trial": one.trial, **names, **sized}))
    shown = _honest_sentences(found), posterior_parts(title, found), draw_marginals(model, found)
    return write_files(folder, "posterior", ("posterior.csv", pd.concat(frames)), f"{name}: posteriors", *shown)


def _honest_sentences(found: Sequence[Reference]) -> list[str]:
    """Says in how many trials each estimator's Gaussian can stand for the posterior, and if that is settled."""
    counts = dict.fromkeys(found[0].divergences, 0)
    for one in found:
        for label, d in one.divergences.items():
            counts[label] += honest_word(d, one.posterior) == "yes"
    listed = enumerate_few([f"{label} in {count} of {len(found)}" for label, count in counts.items()], 12)
    unsettled = sum(not one.posterior.settled for one in found)
    more = [f"In {unsettled} the posterior itself cannot be relied on; take more particles."] if unsettled else []
    return [f"Trials in which an estimator's Gaussian can stand for the posterior: {listed}.", *more]


# Comparison ----------------------------------------------------------------------------------------------------------


class Comparison(Shown, pd.DataFrame):
    """Shows a comparison; what is selected of it is a plain frame."""

    def parts(self) -> Iterator[Part]:
        """Yields a table per comparison, within 80 columns, and what the columns mean."""
        titles = ("", "first", "second", "change", f"{100 * (1 - self.attrs['alpha']):g} %", "p", "e", "second is")
        for title, rows in _comparisons(self):
            cells = zip(titles, zip(*map(_cells, rows), strict=True), strict=True)
            columns = [(words if title in ("", "second is") else texts)(title, column) for title, column in cells]
            needed = [_needed(row) for row in rows if row.get("power", math.nan) > 0]
            yield Table("comparison", title, "", columns, notes=needed)
        yield (
            "error is its length in standard deviations of the bound (Mahalanobis), where a trial counts as at most"
            " the radius of the gate of success; cost counts simulations. Both are means over the common trials,"
            " where the table of a run has medians, and errors over the bound. p comes from McNemar's exact test for"
            " success and from random signs for the others, with Holm's correction over all tests. e is evidence that"
            " may be looked at repeatedly; e = 20 is as rare as p = 0.05. Each interval is that of its row alone."
            " Times are not tested."
        )
        margins = ", ".join(f"{name} {margin:g}" for name, margin in self.attrs["margins"].items())
        yield (
            f"better and worse are changes that p tells from none, by more than a margin: {margins}. different is a"
            " change that may be smaller than the margin."
        )
        if self["quantity"].str.match("honesty|bias").any():
            yield (
                "NEES (honesty) is the squared error over the claimed variance, by the number of parameters, where"
                " both converge: right is 1. bias is the mean error in deviations of the bound, where both succeed:"
                " right is 0."
            )
        if (self["matched_by"] == "order").any():
            yield "Without common trials pairing gains no precision: the intervals are wider."


def write_comparison(folder: Path, frame: Comparison, sources: Sequence[tuple[str, str]]) -> None:
    """Writes comparison.csv and its page."""
    from ipe_bench.report.figures.answers import draw_pairs

    parts = list(frame.parts())
    tables = [part for part in parts if isinstance(part, Table)]
    shown = list(_finding_sentences(frame)), [_joined(tables), *parts[len(tables) :]], draw_pairs(frame)
    write_files(folder, "comparison", ("comparison.csv", frame), "Comparison", *shown, sources=sources)


def _joined(tables: Sequence[Table]) -> Table:
    """Puts tables of the same columns below each other, their titles in a column."""
    titles = list(dict.fromkeys(column.title for table in tables for column in table.columns))
    columns = [words("comparison", [table.title for table in tables for _ in table.rows])]
    for title in titles:
        found = [next((c for c in table.columns if c.title == title), None) for table in tables]
        cells = [c.cells if c else [Cell("")] * len(t) for c, t in zip(found, tables, strict=True)]
        columns.append(Column(title or "quantity", list(chain.from_iterable(cells)), title not in ("", "second is")))
    notes = [note for table in tables for note in table.notes]
    return Table("comparison", "Trial by trial", "", columns, notes=notes, grouped=1)


def _finding_sentences(frame: pd.DataFrame) -> Iterator[str]:
    """Says in how many comparisons the second is better, and worse, by quantity."""
    judged, names = frame[frame["p"].notna()], [frame[which].unique() for which in ("first", "second")]
    who = [str(each[0]) if len(each) == 1 and len({*names[0], *names[1]}) == 2 else "" for each in names]
    number = judged.groupby("quantity").size().max()
    for word in ("better", "worse"):
        counts = judged[judged["finding"] == word].groupby("quantity", sort=False).size()
        listed = ", ".join(f"{quantity} ({count} of {number} comparisons)" for quantity, count in counts.items())
        than = f"{who[1]} is {word} than {who[0]}" if all(who) else f"The second is {word}"
        yield f"{than} in {listed or 'no tested quantity'}."


def _needed(row: dict[str, Any]) -> str:
    return (
        f"{row['trials_needed']:,} trials find a difference of {100 * row['difference']:g} % in success with a"
        f" probability of {100 * row['power']:g} %: one alone succeeds in {row['discordant']} of {row['trials']}"
        f" trials, so in at most {percent(row['discordant_high'])} of all (80 % limit)."
    )


def _comparisons(frame: pd.DataFrame) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """Yields each comparison with its title, in order."""
    settings = [c for c in frame.columns if c not in NOT_SETTINGS]
    listed: list[Any] = frame.to_dict("records")
    for _, part in groupby(listed, key=lambda row: tuple(value_text(row[c]) for c in (*settings, "first", "second"))):
        rows = list(part)
        first = rows[0]
        who = first["first"] if first["first"] == first["second"] else f"{first['first']}, then {first['second']}"
        how = "" if first["matched_by"] == "trial" else " of other seeds, matched in their order"
        yield f"{comparison_title(first)}: {who}; {first['trials']} trial{'s' * (first['trials'] != 1)}{how}", rows


def _cells(row: dict[str, Any]) -> tuple[str, ...]:
    quantity = row["quantity"]
    show = {"success": percent, "time": lambda v: duration(v, 2)}.get(quantity, compact)
    if quantity == "success":
        change, ends = f"{100 * row['change']:+.1f} %", f"{100 * row['low']:+.1f} to {100 * row['high']:+.1f}"
    elif quantity.startswith("bias "):
        change, ends = f"{row['change']:+.3f}", f"{row['low']:+.3f} to {row['high']:+.3f}"
    else:
        change, ends = _ratio(row["change"]), f"{_ratio(row['low'])} to {_ratio(row['high'])}"
    p, e = row["p"], row["e"]
    return (
        *(_TITLES.get(quantity, quantity), show(row["first_value"]), show(row["second_value"])),
        change if math.isfinite(row["change"]) else "-",
        ends if math.isfinite(row["low"]) else "-",
        (p_value(p) if p >= _LEAST_P else f"<{_LEAST_P:g}") if math.isfinite(p) else "",
        (compact(e) if e <= _MOST_EVIDENCE else f">{_MOST_EVIDENCE}") if math.isfinite(e) else "",
        row["finding"] or ("different" if row["different"] else "-" if quantity != "time" else ""),
    )


def _ratio(value: float) -> str:
    return f"{value:.3f}" if 0.1 <= value < 9.9995 else compact(value)


# Audit ---------------------------------------------------------------------------------------------------------------


class AuditAnswer(Shown, Audit):
    """Shows an audit."""

    def parts(self) -> list[Part]:
        """Returns the sentences of an audit, and a row per parameter."""
        names = self.claims.names
        columns = [
            words("parameter", names),
            texts("true over reported", [f"{f.value:.2f}" for f in self.each]),
            texts("97.5 % interval", [f"{f.low:.2f} to {f.high:.2f}" for f in self.each]),
            words("reported", [f.verdict for f in self.each]),
            texts("bias", [f"{value:+.2f}" for value in self.bias[:, 0]]),
            texts("95 % of bias", [f"{low:+.2f} to {high:+.2f}" for low, high in self.bias[:, 1:]]),
        ]
        runs, left_out = self.claims.runs, self.claims.left_out
        notes = [
            "true over reported is the root mean square of errors in reported standard deviations, 1 if the report is"
            " right; bias is their mean. Intervals hold for all parameters together, and for heavy tails."
        ]
        joint = "The first sentence is of all parameters together, by the whole covariance."
        notes.append(joint if self.claims.joint else "No covariances are reported, so directions are not judged.")
        title = f"Audit of {runs} runs" + (f", {left_out} rows without an estimate left out" if left_out else "")
        return [*self.sentences, Table("audit", title, "", columns, notes=notes)]


def write_audit(folder: Path, found: AuditAnswer, sources: Sequence[tuple[str, str]]) -> None:
    """Writes audit.csv and its page."""
    from ipe_bench.report.figures.answers import draw_audit

    parts = [part for part in found.parts() if isinstance(part, Table)]
    shown = found.sentences, parts, draw_audit(found)
    write_files(folder, "audit", ("audit.csv", found.table()), "Audit", *shown, sources=sources)
