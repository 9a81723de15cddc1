"""Defines what a statistic is: its name and meaning, its trials, its formula and its format in one
record."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from ipe_bench.statistics.sample import Sample

Kind = Literal["count", "share", "number", "physical", "seconds", "probability", "word"]
"""Format of a value; `report.words` knows each."""
Where = Literal[
    "overview",
    "terminal",
    "all_trials",
    "solved_trials",
    "costs",
    "parameters",
    "covariances",
    "iterations",
    "theory",
    "calibration",
    "tracks",
]
"""A table; its columns are in the order of the records. The overview and the terminal's table show
those of plugins behind their own."""
Condition = Literal["", "solved"]
ALL = "all"
"""The row of the summary over all parameters."""
BEST = "may_be_best"
"""Whether no rival surely succeeds more often in the same trials; see `comparisons.may_be_best`."""
Ends = tuple[Any, Any]


@dataclass(frozen=True)
class Statistic:
    """Defines a statistic of a scenario under an estimator, which becomes a column of
    `summary_all.csv` and of tables.

    Required: `name`, `title`, `over`, `meaning` and `values`. Optional: `limits` (an interval);
    `given`, `kind`, `where`, `titles`, `limits_titles` and `rare` (how it is shown). Promised:
    `values` takes a `Sample`, which it does not write into, and returns one number, or one for each
    parameter in its own unit and last that of all parameters together (n + 1,), NaN where it is
    undefined. `limits` returns both ends of the interval in the same form. Names of columns are
    new, in ASCII letters, digits and underscores.

    A plugin offers a record by `conf/statistic/NAME.yaml`; a record that breaks a promise is left
    out with a line.

    >>> import tempfile
    >>> import ipe_bench as ib
    >>> from ipe_bench.statistics.collect import collect
    >>> from ipe_bench.statistics.sample import samples
    >>> meaning = "Share of trials with an error above three times the bound."
    >>> def beyond(s):
    ...     return float((s.distance > 3 * s.n**0.5).mean())
    >>> far = Statistic("far", "far off", "all trials", meaning, beyond)
    >>> bench = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01), error_scale=3.0)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = ib.run(bench, {"newton": ib.solvers.Newton()}, trials=20, output=folder)
    ...     found = collect([folder])
    ...     (sample,) = samples(found, found.groups)
    >>> far.columns_of(sample)
    {'far': [0.0, 0.0, 0.0, 0.0, 0.0]}
    >>> far.definition
    'Share of trials with an error above three times the bound. Over all trials.'
    """

    name: str
    """Names its column; the ends of its interval are `name_low` and `name_high`, with
    `limits_given` behind."""
    title: str
    """Heads its column in tables."""
    over: str
    """Says which trials count."""
    meaning: str
    """Says in a sentence what is computed of them."""
    values: Callable[[Sample], Any]
    limits: Callable[[Sample], Ends] | None = None
    given: Condition = ""
    """Names the trials that it is conditional on; their number is the column `count`."""
    kind: Kind = "number"
    where: tuple[Where, ...] = ()
    """Lists the tables that show it."""
    titles: Mapping[Where, str] = field(default_factory=dict)
    """Replaces `title` in some tables."""
    limits_titles: Mapping[Where, str] = field(default_factory=dict)
    """Heads the interval in the tables that show it."""
    rare: bool = False
    """Leaves it out of tables in which no estimator reports it."""
    limits_given: Literal["", "_if_honest"] = ""
    """Ends the names of `limits` that are not of the value: values of a right covariance lie within
    them."""

    @property
    def columns(self) -> tuple[str, ...]:
        if self.limits is None:
            return (self.name,)
        ends = [f"{self.name}_{end}{self.limits_given}" for end in ("low", "high")]
        return (self.name, *ends)

    @property
    def count(self) -> str:
        return f"{self.given}_trials"

    @property
    def definition(self) -> str:
        return f"{self.meaning} Over {self.over}."

    def columns_of(self, sample: Sample) -> dict[str, list[Any]]:
        """Returns its columns, a value for each parameter and one for all together."""
        with np.errstate(all="ignore"):
            found = [self.values(sample)]
            if self.limits is not None:
                found = [*found, *self.limits(sample)]
        # One number stands for each parameter, and for all.
        rows = sample.n + 1
        columns = [np.asarray(one).tolist() if np.ndim(one) else [one] * rows for one in found]
        return dict(zip(self.columns, columns, strict=True))


def frame_columns(statistics: Sequence[Statistic]) -> tuple[str, ...]:
    return tuple(column for s in statistics for column in s.columns)


def rows_of(statistics: Sequence[Statistic], sample: Sample) -> list[dict[str, Any]]:
    """Returns a row per parameter and one over all: the columns of all the statistics."""
    columns: dict[str, list[Any]] = {}
    for statistic in statistics:
        columns |= statistic.columns_of(sample)
    return [{name: values[i] for name, values in columns.items()} for i in range(sample.n + 1)]
