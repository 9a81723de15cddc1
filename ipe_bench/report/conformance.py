"""What statistics, figures, tables and sections promise, as checks on analyses of small runs.

Components are checked by `plugins.conformance`; whoever asks computes the small runs, of which the first is a sweep.
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
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.figures.views import views
from ipe_bench.report.style import house_style
from ipe_bench.report.tables import all_tables
from ipe_bench.statistics.analysis import Analysis
from ipe_bench.statistics.records import Statistic, columns_of_added, fault_of
from ipe_bench.statistics.sample import Sample, Shared


def check_record(option: Option, analyses: Sequence[Analysis]) -> Iterator[Finding]:
    """Runs the checks on the record that an option names; one that is not there is a finding."""
    name, title = f"{option.group}={option.name}", "Can be found from its config"
    try:
        record = find_record(option)
        for check in _CHECKS[option.group]:
            title = (check.__doc__ or "").strip().rstrip(".")
            check(option.name, record, analyses)
            yield Finding(name, title)
    except (UserError, AssertionError) as error:
        yield Finding(name, title, str(error) or "it does not")


def is_a_statistic(_: str, record: Any, __: Sequence[Analysis]) -> None:
    """Is a Statistic whose columns, kind and tables there can be."""
    if fault := fault_of(record):
        raise UserError(fault)


def has_values(_: str, record: Statistic, analyses: Sequence[Analysis]) -> None:
    """Has a value, or NaN, for every parameter and for all, however the trials ended; the same twice; in its limits."""
    for analysis in analyses:
        for groups in analysis.collection.scenarios.values():
            shared = Shared.among(analysis.collection, groups)
            for group in groups:
                _check_values(record, Sample.load(analysis.collection, group, shared))


def _check_values(record: Statistic, sample: Sample) -> None:
    first, second = (columns_of_added(record, sample) for _ in range(2))
    whose = f"of {sample.group.estimator}"
    for name, values in first.items():
        numbers = record.kind != "word"
        same = np.array_equal(values, second[name], equal_nan=numbers)
        assert same, f"{name} {whose} is another value each time"
    for value, low, high in zip(*first.values(), strict=True) if record.limits else ():
        inside = not np.isfinite([value, low, high]).all() or low <= value <= high
        assert inside, f"{value:g} {whose} is not within its interval, {low:g} to {high:g}"


def can_be_drawn(_: str, record: Any, analyses: Sequence[Analysis]) -> None:
    """Is drawn and written for any run, of one trial or with estimators that fail, or gives nothing."""
    extensions.checked_figure(record)
    with tempfile.TemporaryDirectory(prefix="ipe-bench-") as folder, house_style():
        for drawing in [drawing for analysis in analyses for drawing in _drawn(record, analysis)]:
            assert drawing.title.strip(), f"{drawing.name} has no title"
            assert drawing.caption.strip(), f"{drawing.name} has no caption"
            extensions.guarded(lambda drawing=drawing: drawing.save(Path(folder)))


def draws_a_sweep(_: str, record: Any, analyses: Sequence[Analysis]) -> None:
    """Draws something of an ordinary sweep, named for each of its settings."""
    with house_style():
        names = [drawing.name for drawing in _drawn(record, analyses[0])]
    assert names, "it draws nothing of polynomial at three error scales by four estimators"
    assert len(set(names)) == len(names), "two settings share a name; end each in view.suffix"


def _drawn(record: Any, analysis: Analysis) -> list[Drawing]:
    parts, whole = views(analysis)
    seen = [view.only(record.frames) for view in ([whole] if record.together else parts)]
    return [drawing for view in seen for drawing in extensions.drawings(record, view)]


def makes_a_table(_: str, record: Any, analyses: Sequence[Analysis]) -> None:
    """Makes a table of any run that can be written in every format, or None."""
    for analysis in analyses:
        extensions.made_table(record, analysis, [table.name for table in all_tables(analysis)])


def can_be_read(name: str, record: Any, analyses: Sequence[Analysis]) -> None:
    """Is a Section that writes texts and tables of any run."""
    for analysis in analyses:
        extensions.made_section(name, record, analysis, [table.name for table in all_tables(analysis)])


_CHECKS: dict[str, tuple[Callable[[str, Any, Sequence[Analysis]], None], ...]] = {
    "statistic": (is_a_statistic, has_values),
    "figure": (can_be_drawn, draws_a_sweep),
    "table": (makes_a_table,),
    "section": (can_be_read,),
}
