"""Is the second better than the first? Two folders of results, or two estimators, trial by trial.

Which scenarios and trials belong together is found here; tests of the numbers are in `statistics.paired`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ipe_bench.basics.errors import UserError, unknown
from ipe_bench.basics.linalg import Array
from ipe_bench.runs.provenance import canonical_json
from ipe_bench.statistics.collect import Collection, Group, config_leaves, differing, shown_leaf
from ipe_bench.statistics.comparisons import ALPHA, Outcomes, differences, holm
from ipe_bench.statistics.formulas import gate_radius
from ipe_bench.statistics.paired import Effect, no_drift, no_lean, ratio_effect, success_effect
from ipe_bench.statistics.sample import Sample, Shared
from ipe_bench.statistics.summary import outcomes_of

JUDGED = ("success", "error", "cost")
"""Those that are tested. Time is not: the trials of a block share theirs evenly, and machines differ."""
BOTH = " | "
"""Stands between the values of what differs."""
_SAYS_NOTHING = {"null": "-", "None": "-", "false": "-"}
NOT_SETTINGS = (
    *("first", "second", "trials", "matched_by", "quantity", "first_value", "second_value"),
    *("change", "low", "high", "p", "e", "finding"),
)
"""The columns of a row that do not say what is compared."""
_HEADINGS = {"error_scale": "error scale"}


def described(row: Mapping[str, Any]) -> str:
    """What a row compares, in a line for people."""
    named = {k: v for k, v in row.items() if k not in NOT_SETTINGS and v is not None and v == v}
    return ", ".join(
        str(value) if key in ("measurement", "noise") else f"{_HEADINGS.get(key, key)} {_plain(value)}"
        for key, value in named.items()
    )


def _plain(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


@dataclass(frozen=True)
class Match:
    """Two groups of trials that are compared."""

    first: Group
    second: Group
    setting: Mapping[str, tuple[Any, Any]]
    """The keys of the config in which their scenarios differ, with both values."""

    @property
    def columns(self) -> dict[str, Any]:
        """What tells this comparison from the others: what both have, then what differs, with both values."""
        columns = {k: v for k, v in self.first.columns.items() if k not in self.setting}
        for key, values in self.setting.items():
            # A component is called by its name, not by its class.
            named = [group.columns.get(key, value) for group, value in zip(self._both, values, strict=True)]
            shown = [_SAYS_NOTHING.get(_plain(v), _plain(v)) for v in named]
            if shown != ["-", "-"]:
                columns[key] = BOTH.join(shown)
        return columns | self.options

    @property
    def options(self) -> dict[str, str]:
        """The options in which estimators of one label differ."""
        if self.first.label != self.second.label:
            return {}
        configs = [{"estimator": group.footer["identity"]["estimator"]} for group in self._both]
        leaves = [config_leaves(config) for config in configs]
        found = {}
        for key in differing(configs):
            values = [_plain(shown_leaf(own[key][1])) if key in own else "-" for own in leaves]
            found[key] = BOTH.join(_SAYS_NOTHING.get(v, v) for v in values)
        return found

    @property
    def _both(self) -> tuple[Group, Group]:
        return self.first, self.second


def compared(
    first: Collection,
    second: Collection,
    labels: tuple[str | None, str | None] = (None, None),
    *,
    alpha: float = ALPHA,
    anytime: bool = False,
) -> list[dict[str, Any]]:
    """Rows of every comparison that can be made: one per scenario, pair of estimators and quantity.

    Each p is corrected over all of them by Holm; with `anytime`, findings go by e-values, divided by their number.

    Raises:
        UserError: there is nothing to compare.
    """
    rows = [row for match in matches(first, second, labels) for row in _rows(match, first, second, alpha)]
    judged = [row for row in rows if row["quantity"] in JUDGED]
    for row, p in zip(judged, holm([row["p"] for row in judged]), strict=True):
        row["p"] = float(p)
        sure = row["e"] >= len(judged) / alpha if anytime else p < alpha
        row["finding"] = _direction(row) if sure else ""
    return rows


def _direction(row: Mapping[str, Any]) -> str:
    if row["quantity"] == "success":
        return "better" if row["change"] > 0 else "worse"
    return "better" if row["second_value"] < row["first_value"] else "worse"


def _rows(match: Match, first: Collection, second: Collection, alpha: float) -> Iterator[dict[str, Any]]:
    a, b = _loaded(first, match.first), _loaded(second, match.second)
    if a.n != b.n:
        raise UserError(
            f"{match.first.label}: has {a.n} parameters in the first and {b.n} in the second; compare results on the"
            " same measurement"
        )
    one, other, by_trial = a.beside(b)
    trials = len(one[1])
    if not trials:
        raise UserError(f"{match.first.estimator}: has no trials to compare; run more of them")
    head = match.columns | {
        "first": match.first.estimator,
        "second": match.second.estimator,
        "trials": trials,
        "matched_by": "trial" if by_trial else "order",
    }
    for quantity, effect in _effects(one, other, a.n, alpha).items():
        yield head | {
            "quantity": quantity,
            "first_value": effect.first,
            "second_value": effect.second,
            "change": effect.change,
            "low": effect.low,
            "high": effect.high,
            "p": effect.p,
            "e": effect.e,
            "finding": "",
        }


@dataclass(frozen=True)
class _Loaded:
    n: int
    trials: Outcomes
    seconds: Array

    def at(self, rows: Array) -> tuple[Outcomes, Array]:
        return self.trials.at(self.trials.ids[rows]), self.seconds[rows]

    def beside(self, other: _Loaded) -> tuple[tuple[Outcomes, Array], tuple[Outcomes, Array], bool]:
        """Both on the same trials, and whether they are the same: where they share none, as with other seeds, they are
        matched in their order, which is right, since all are independent, but gains nothing."""
        ids = self.trials.ids, other.trials.ids
        _, mine, theirs = np.intersect1d(*ids, assume_unique=True, return_indices=True)
        if by_trial := len(mine) > 0:
            return self.at(mine), other.at(theirs), by_trial
        order = np.arange(min(map(len, ids)))
        return self.at(order), other.at(order), by_trial


def _loaded(collection: Collection, group: Group) -> _Loaded:
    sample = Sample.load(collection, group, Shared.among(collection, [group]))
    return _Loaded(sample.n, outcomes_of(sample), sample.scalars["time_s"][np.argsort(sample.number, kind="stable")])


def _effects(one: tuple[Outcomes, Array], other: tuple[Outcomes, Array], n: int, alpha: float) -> dict[str, Effect]:
    (first, seconds), (second, other_seconds) = one, other
    radius = gate_radius(n)
    a, b = np.minimum(first.distance, radius), np.minimum(second.distance, radius)
    d = differences(b, a)
    # The first trial's cost is the unit: whoever looks later divides by the same.
    unit = float(first.cost[0] + second.cost[0]) or 1.0
    medians = float(np.median(seconds)), float(np.median(other_seconds))
    time = medians[1] / medians[0] if medians[0] > 0 else np.nan
    return {
        "success": success_effect(first.success, second.success, alpha),
        "error": ratio_effect(a, a + d, alpha, no_drift(d, radius), radius),
        "cost": ratio_effect(first.cost, second.cost, alpha, no_lean(second.cost - first.cost, unit)),
        "time": Effect(*medians, time, np.nan, np.nan, np.nan, np.nan),
    }


# Which scenarios and estimators belong together ----------------------------------------------------------------------


def matches(first: Collection, second: Collection, labels: tuple[str | None, str | None] = (None, None)) -> list[Match]:
    """The groups that are compared: of the same scenario but for its seed, under the labels, or those that both have.

    Where no scenario is in both, those are the same that differ only in what is one value throughout the first and
    another throughout the second, such as a scale of the noise.

    Raises:
        UserError: there is none.
    """
    for collection in (first, second):
        if not collection.groups:
            raise UserError(
                f"{_where(collection)}: holds no trials to compare; `ipe-bench status` says what is missing"
            )
    a, b = _by_scenario(first), _by_scenario(second)
    setting: dict[str, tuple[Any, Any]] = {}
    if not a.keys() & b.keys():
        setting = _setting(a, b)
        a, b = _without(a, setting), _without(b, setting)
    shared = [key for key in a if key in b]
    if not shared:
        raise UserError(
            f"{_where(first)}, {_where(second)}: have no scenario in common, nor differ in one setting; compare runs of"
            " the same measurement, noise and error scales"
        )
    found = [Match(*pair, setting) for key in shared for pair in _by_label(a[key], b[key], labels)]
    if not found:
        raise _no_estimator(first, second, labels)
    return found


def left_out(first: Collection, second: Collection) -> list[str]:
    """A line where one has scenarios that the other lacks, while both share some."""
    a, b = _by_scenario(first), _by_scenario(second)
    lines = []
    if a.keys() & b.keys():
        for collection, alone in ((first, a.keys() - b.keys()), (second, b.keys() - a.keys())):
            if alone:
                lines.append(f"{_where(collection)}: {len(alone)} scenarios that the other lacks are left out")
    return lines


_Leaves = tuple[tuple[str, str], ...]


def _by_scenario(collection: Collection) -> dict[_Leaves, list[Group]]:
    found: dict[_Leaves, list[Group]] = {}
    for group in collection.groups:
        scenario = {k: v for k, v in group.cells[0][0].footer["identity"]["scenario"].items() if k != "seed"}
        leaves = tuple(sorted((k, canonical_json(v)) for k, (_, v) in config_leaves(scenario).items()))
        found.setdefault(leaves, []).append(group)
    return found


def _setting(a: Mapping[_Leaves, Any], b: Mapping[_Leaves, Any]) -> dict[str, tuple[Any, Any]]:
    """The keys that have one value throughout the first and another throughout the second."""

    def values(scenarios: Mapping[_Leaves, Any], key: str) -> set[str]:
        return {dict(leaves).get(key, "-") for leaves in scenarios}

    found = {}
    for key in dict.fromkeys(k for leaves in (*a, *b) for k, _ in leaves):
        here, there = values(a, key), values(b, key)
        if len(here) == len(there) == 1 and here != there:
            found[key] = (here.pop().strip('"'), there.pop().strip('"'))
    return found


def _without(scenarios: Mapping[_Leaves, list[Group]], setting: Mapping[str, Any]) -> dict[_Leaves, list[Group]]:
    return {tuple(leaf for leaf in leaves if leaf[0] not in setting): groups for leaves, groups in scenarios.items()}


def _by_label(
    a: Sequence[Group], b: Sequence[Group], labels: tuple[str | None, str | None]
) -> Iterator[tuple[Group, Group]]:
    first, second = labels[0] or labels[1], labels[1] or labels[0]
    if first is None:
        yield from ((one, other) for one in a for other in b if one.estimator == other.estimator)
        return
    yield from (
        (one, other)
        for one in a
        for other in b
        if first in (one.estimator, one.label) and second in (other.estimator, other.label)
    )


def _no_estimator(first: Collection, second: Collection, labels: tuple[str | None, str | None]) -> UserError:
    wanted = labels[0] or labels[1], labels[1] or labels[0]
    for name, label, collection in zip(("first", "second"), wanted, (first, second), strict=True):
        known = {g.estimator for g in collection.groups} | {g.label for g in collection.groups}
        if label is not None and label not in known:
            return UserError(f"{name}={label}: {unknown(label, known, 'estimator')}")
    if wanted != (None, None):
        return UserError(f"first={wanted[0]} second={wanted[1]}: no scenario has both; run both on the same one")
    names = [", ".join(dict.fromkeys(g.estimator for g in c.groups)) for c in (first, second)]
    return UserError(f"no estimator is in both ({names[0]}; {names[1]}); choose with first=LABEL second=LABEL")


def _where(collection: Collection) -> str:
    return ", ".join(map(str, collection.directories))
