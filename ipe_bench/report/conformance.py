"""What statistics, figures, tables and sections promise, as checks on analyses of small runs.

Components are checked by `plugins.conformance`; the small runs are computed by whoever asks.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.plugins.conformance import Finding
from ipe_bench.plugins.discovery import Option
from ipe_bench.plugins.extensions import find_record
from ipe_bench.report import extensions
from ipe_bench.report.figures.views import View, views
from ipe_bench.report.style import house_style
from ipe_bench.report.tables import all_tables
from ipe_bench.statistics.analysis import Analysis
from ipe_bench.statistics.records import Statistic, columns_of_added, fault_of
from ipe_bench.statistics.sample import Sample, Shared

Check = Callable[[str, Any, Sequence[Analysis]], None]


def check_record(option: Option, analyses: Sequence[Analysis]) -> Iterator[Finding]:
    """Runs the checks on the record that an option names; one that is not there is a finding."""
    name = f"{option.group}={option.name}"
    try:
        record = find_record(option)
    except UserError as error:
        yield Finding(name, "Can be found from its config", str(error))
        return
    for check in _CHECKS[option.group]:
        title = (check.__doc__ or "").strip().splitlines()[0].rstrip(".")
        try:
            check(option.name, record, analyses)
        except (UserError, AssertionError) as error:
            yield Finding(name, title, str(error) or "it does not")
            return  # what follows takes it for granted
        yield Finding(name, title)


# Statistics


def is_a_statistic(_: str, record: Any, __: Sequence[Analysis]) -> None:
    """Is a Statistic whose columns, kind and tables there can be."""
    if fault := fault_of(record):
        raise UserError(fault)


def has_values(_: str, record: Statistic, analyses: Sequence[Analysis]) -> None:
    """Has a value, or NaN, for every parameter and for all, however the trials ended; the same twice."""
    for sample in _samples(analyses):
        first, second = (columns_of_added(record, sample) for _ in range(2))
        for name, values in first.items():
            same = values == second[name] or np.array_equal(
                np.array(values, dtype=float), np.array(second[name], dtype=float), equal_nan=True
            )
            assert same, f"{name} of {sample.group.estimator} is another value each time"


def has_ordered_limits(_: str, record: Statistic, analyses: Sequence[Analysis]) -> None:
    """Lies in its interval, if it has one."""
    if record.limits is None:
        return
    for sample in _samples(analyses):
        columns = columns_of_added(record, sample)
        for value, low, high in zip(*(columns[name] for name in record.columns), strict=True):
            inside = not np.isfinite([value, low, high]).all() or low <= value <= high
            assert inside, f"{value:g} of {sample.group.estimator} is not within its interval, {low:g} to {high:g}"


def _samples(analyses: Sequence[Analysis]) -> Iterator[Sample]:
    for analysis in analyses:
        collection = analysis.collection
        for groups in collection.scenarios.values():
            shared = Shared.among(collection, groups)
            for group in groups:
                yield Sample.load(collection, group, shared)


# Figures


def is_a_figure(_: str, record: Any, __: Sequence[Analysis]) -> None:
    """Is a Figure that reads frames that there are."""
    extensions.checked_figure(record)


def can_be_drawn(_: str, record: Any, analyses: Sequence[Analysis]) -> None:
    """Is drawn and written for any run, of one trial or with estimators that fail, or gives nothing."""
    with tempfile.TemporaryDirectory(prefix="ipe-bench-") as folder, house_style():
        for analysis in analyses:
            for view in _views(record, analysis):
                for drawing in extensions.drawings(record, view):
                    assert drawing.title.strip(), f"{drawing.name} has no title"
                    assert drawing.caption.strip(), f"{drawing.name} has no caption"
                    extensions.guarded(lambda drawing=drawing: drawing.save(Path(folder)))


def draws_a_sweep(_: str, record: Any, analyses: Sequence[Analysis]) -> None:
    """Draws something of an ordinary sweep, named for each of its settings."""
    with house_style():
        found = [extensions.drawings(record, view) for view in _views(record, analyses[0])]
    assert any(found), "it draws nothing of polynomial at three error scales by four estimators"
    names = [drawing.name for drawings in found for drawing in drawings]
    assert len(set(names)) == len(names), "two settings share a name; end each in view.suffix"


def _views(record: Any, analysis: Analysis) -> list[View]:
    parts, whole = views(analysis)
    return [view.only(record.frames) for view in ([whole] if record.together else parts)]


# Tables and sections


def makes_a_table(_: str, record: Any, analyses: Sequence[Analysis]) -> None:
    """Makes a table of any run that can be written in every format, or None."""
    for analysis in analyses:
        extensions.made_table(record, analysis, [table.name for table in all_tables(analysis)])


def can_be_read(name: str, record: Any, analyses: Sequence[Analysis]) -> None:
    """Is a Section that writes texts and tables of any run."""
    for analysis in analyses:
        extensions.made_section(name, record, analysis, [table.name for table in all_tables(analysis)])


_CHECKS: dict[str, tuple[Check, ...]] = {
    "statistic": (is_a_statistic, has_values, has_ordered_limits),
    "figure": (is_a_figure, can_be_drawn, draws_a_sweep),
    "table": (makes_a_table,),
    "section": (can_be_read,),
}
