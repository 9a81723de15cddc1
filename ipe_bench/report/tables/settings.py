"""Words the settings of rows: options that differ, with their units, and the right model."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ipe_bench.basics.errors import UserError
from ipe_bench.plugins.construct import find_object
from ipe_bench.report.words import assignments, value_text, varying
from ipe_bench.runs.provenance import TARGET

if TYPE_CHECKING:
    from ipe_bench.statistics.collect import Collection, Group

RIGHT = "right model"
"""Ends the words of a setting whose readings come from the model that estimators assume."""
MOST_SETTINGS = 2
"""Differing settings that have a column each."""
_TRUTH = "truth"

Options = frozenset[tuple[str, str]]
"""Texts of a setting's options, by columns."""


@dataclass(frozen=True)
class Wording:
    """Holds what the options of settings mean."""

    units: Mapping[str, str]
    """Units of options, by their columns."""
    right: frozenset[Options]
    """Settings whose readings come from the model that estimators assume."""

    @classmethod
    def of(cls, collection: Collection | None) -> Wording:
        """Reads units and models from results."""
        units: dict[str, str] = {}
        right = set()
        for group in collection.groups if collection else ():
            units |= _units(group)
            scenario = group.footer["identity"]["scenario"]
            if scenario.get(_TRUTH) in (None, scenario.get("measurement")):
                right.add(_options(group.columns))
        return cls(units, frozenset(right))

    def settings(self, rows: Sequence[Mapping[str, Any]], columns: Sequence[str]) -> list[str]:
        """Returns for each row those of its settings that differ among the rows, of many those
        other than the most frequent ones; a dash if there are none."""
        apart = varying(columns, rows)
        if not apart:
            return ["-"] * len(rows)
        each = [{column: value_text(row.get(column)) for column in columns} for row in rows]
        usual: dict[str, str] = {}
        if len(apart) > MOST_SETTINGS:
            # The model of the truth is always told.
            counted = [column for column in apart if column != _TRUTH]
            usual = {column: _most_frequent(row[column] for row in each) for column in counted}
        settings = []
        for row in each:
            unusual = {column: row[column] for column in apart if row[column] != usual.get(column)}
            settings.append(self.worded(unusual, is_right=self.is_right(row)) or "-")
        return settings

    def is_right(self, row: Mapping[str, Any]) -> bool:
        """Whether the readings of a setting come from the model that estimators assume."""
        return _options(row) in self.right

    def worded(self, values: Mapping[str, str], *, is_right: bool = False) -> str:
        """Words the options of one setting, without those that its classes lack and errors of the
        truth that are 0."""
        there = {column: value for column, value in values.items() if value != "-"}
        errors = [column for column in there if is_of_truth(column) and column in self.units]
        # Errors in words say all that is to be said of the truth; of the right model there is none.
        names_truth = not (is_right or errors)
        told = []
        for column, value in there.items():
            is_told = names_truth or not is_of_truth(column)
            if column in errors:
                is_told = value != "0"
            if is_told:
                told.append(self._one(column, value))
        if is_right and any(map(is_of_truth, values)):
            told.append(RIGHT)
        return ", ".join(told)

    def _one(self, column: str, value: str) -> str:
        unit = self.units.get(column, "")
        if unit and is_of_truth(column):
            return f"{last_words(column)} {value} {unit}"
        return f"{assignments({column: value})} {unit}".rstrip()


def _most_frequent(texts: Iterable[str]) -> str:
    """Returns the first, in alphabetical order, of those that occur most often."""
    counts = Counter(sorted(texts))
    return counts.most_common(1)[0][0]


def last_words(column: str) -> str:
    """Words an option by its own name, without those of its component."""
    return column.rpartition(".")[2].replace("_", " ")


def is_of_truth(column: str) -> bool:
    """Whether an option is one of the model that readings come from."""
    return column.partition(".")[0] == _TRUTH


def _options(row: Mapping[str, Any]) -> Options:
    texts = {column: value_text(value) for column, value in row.items() if column != "error_scale"}
    return frozenset((column, text) for column, text in texts.items() if text != "-")


def _units(group: Group) -> dict[str, str]:
    """Returns the units that the classes of a scenario's components state."""
    found = {}
    for component, config in group.footer["identity"]["scenario"].items():
        if not isinstance(config, Mapping) or TARGET not in config:
            continue
        try:
            stated = getattr(find_object(config[TARGET], component), "option_units", {})
        except UserError:  # the plugin of a stored result is gone
            stated = {}
        found |= {f"{component}.{name}": unit for name, unit in stated.items()}
    return found
