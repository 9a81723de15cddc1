"""What statistics, figures, tables and sections promise, as checks on analyses of small runs.

Components are checked by `plugins.conformance`; whoever asks computes the small runs, of which the first is a sweep.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.plugins.conformance import Finding
from ipe_bench.plugins.discovery import Option
from ipe_bench.plugins.extensions import find_record, guarded
from ipe_bench.report.figures import checked_figure, drawn_by
from ipe_bench.report.figures.views import views
from ipe_bench.report.sections import made
from ipe_bench.report.style import house_style
from ipe_bench.report.tables import all_tables
from ipe_bench.statistics.analysis import Analysis
from ipe_bench.statistics.records import columns_of_added, fault_of
from ipe_bench.statistics.sample import samples


def check_record(option: Option, analyses: Sequence[Analysis]) -> Finding:
    """Checks the record that an option names; one that is not there is a finding as well."""
    name, check = f"{option.group}={option.name}", _CHECKS[option.group]
    try:
        check(option, find_record(option), analyses)
    except (UserError, AssertionError) as error:
        return Finding(name, (check.__doc__ or "").rstrip("."), str(error))
    return Finding(name, (check.__doc__ or "").rstrip("."))


def has_values(_: Option, record: Any, analyses: Sequence[Analysis]) -> None:
    """Has a value, or NaN, for every parameter and for all, however the trials ended; the same twice; in its limits."""
    if fault := fault_of(record):
        raise UserError(fault)
    for collection in [analysis.collection for analysis in analyses]:
        for groups in collection.scenarios.values():
            for sample in samples(collection, groups):
                first, second = (columns_of_added(record, sample) for _ in range(2))
                for name, values in first.items():
                    same = np.array_equal(values, second[name], equal_nan=record.kind != "word")
                    assert same, f"{name} of {sample.group.estimator} is another value each time"
                for value, low, high in zip(*first.values(), strict=True) if record.limits else ():
                    inside = not np.isfinite([value, low, high]).all() or low <= value <= high
                    where = f"of {sample.group.estimator} is not within its interval, {low:g} to {high:g}"
                    assert inside, f"{value:g} {where}"


def can_be_drawn(_: Option, record: Any, analyses: Sequence[Analysis]) -> None:
    """Is drawn and written for any run, of one trial or with estimators that fail, and shows something of a sweep."""
    checked_figure(record)
    with tempfile.TemporaryDirectory(prefix="ipe-bench-") as folder, house_style():
        for number, analysis in enumerate(analyses):
            parts, whole = views(analysis)
            seen = [view.only(record.frames) for view in ([whole] if record.together else parts)]
            drawn = [drawing for view in seen for drawing in drawn_by(record, view)]
            for drawing in drawn:
                assert drawing.title.strip(), f"{drawing.name} has no title"
                assert drawing.caption.strip(), f"{drawing.name} has no caption"
                with guarded():
                    drawing.save(Path(folder))
            assert drawn or number, "it draws nothing of polynomial at three error scales by four estimators"
            assert len({drawing.name for drawing in drawn}) == len(drawn), "two drawings share a name"


def can_be_read(option: Option, record: Any, analyses: Sequence[Analysis]) -> None:
    """Makes texts and tables of any run, which can be written in every format, or nothing."""
    for analysis in analyses:
        made(option, record, analysis, [table.name for table in all_tables(analysis)])


_CHECKS = {"statistic": has_values, "figure": can_be_drawn, "table": can_be_read, "section": can_be_read}
