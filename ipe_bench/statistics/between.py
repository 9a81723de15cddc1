"""Compares two folders of results, or two estimators, trial by trial.

This module finds the scenarios and trials that belong together; the tests are in `statistics.paired`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from ipe_bench.basics.errors import UserError, unknown
from ipe_bench.runs.provenance import canonical_json
from ipe_bench.statistics.collect import Collection, Group, config_leaves, differing, scenario_of, shown_leaf
from ipe_bench.statistics.comparisons import ALPHA, differences, holm
from ipe_bench.statistics.paired import PLANNED, Effect, PowerPlan, ratio_effect, success_effect
from ipe_bench.statistics.sample import Sample, samples
from ipe_bench.trials.thresholds import gate

JUDGED = ("success", "error", "cost")
"""Quantities that are tested. Time is not: the trials of a block share theirs evenly, and machines differ."""
NOT_SETTINGS = (
    *("first", "second", "trials", "matched_by", "quantity", "first_value", "second_value"),
    *("change", "low", "high", "p", "e", "finding", *PLANNED),
)
"""The columns of a row that do not say what is compared."""


def comparison_title(row: Mapping[str, Any]) -> str:
    """Titles a comparison in one line."""
    named = {k: _plain(v) for k, v in row.items() if k not in NOT_SETTINGS and v is not None and v == v}
    titles = {"measurement": "", "noise": "", "error_scale": "error scale "}
    return ", ".join(titles.get(key, f"{key} ") + value for key, value in named.items())


def _plain(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def compared(
    first: Collection,
    second: Collection,
    labels: tuple[str | None, str | None] = (None, None),
    *,
    alpha: float = ALPHA,
    anytime: bool = False,
    plan: PowerPlan | None = None,
) -> list[dict[str, Any]]:
    """Returns rows of every comparison that can be made: one per scenario, pair of estimators and quantity.

    Each p is corrected over all of them by Holm; with `anytime`, findings go by e-values, divided by their number. With
    a `plan`, rows on success say how many trials it takes, at the strictest level that Holm asks for.

    Raises:
        UserError: there is nothing to compare.
    """
    rows = [row for match in _matches(first, second, labels) for row in _rows(*match, alpha)]
    judged = [row for row in rows if row["quantity"] in JUDGED]
    for row, p in zip(judged, holm([row["p"] for row in judged]), strict=True):
        discordant = row.pop("discordant", None)
        if plan is not None and discordant is not None:
            row |= plan.row(discordant, row["trials"], alpha / len(judged))
        row["p"] = float(p)
        if row["e"] >= len(judged) / alpha if anytime else p < alpha:
            more = row["second_value"] > row["first_value"]
            row["finding"] = "better" if more == (row["quantity"] == "success") else "worse"
    return rows


def _rows(a: Sample, b: Sample, alpha: float) -> Iterator[dict[str, Any]]:
    """Yields a row per quantity of two estimators on one scenario."""
    if a.n != b.n:
        raise UserError(
            f"{a.group.label}: has {a.n} parameters in the first and {b.n} in the second; compare results on the"
            " same measurement"
        )
    _, one, other = np.intersect1d(a.number, b.number, assume_unique=True, return_indices=True)
    matched_by = "trial" if len(one) else "order"
    if not len(one):
        # With other seeds trials are matched in their order: right, since all are independent, but nothing is gained.
        one = other = np.arange(min(len(a), len(b)))
    head = _head(a.group, b.group) | {"first": a.group.estimator, "second": b.group.estimator}
    head |= {"trials": len(one), "matched_by": matched_by}
    success = a.inside_gate[one], b.inside_gate[other]
    radius = float(np.sqrt(gate(a.n)))
    error = np.minimum(a.distance[one], radius), np.minimum(b.distance[other], radius)
    seconds = float(np.median(a.scalars["time_s"][one])), float(np.median(b.scalars["time_s"][other]))
    effects = {
        "success": success_effect(*success, alpha),
        "error": ratio_effect(error[0], error[0] + differences(error[1], error[0]), alpha, radius),
        "cost": ratio_effect(a.cost[one], b.cost[other], alpha),
        "time": Effect(*seconds, seconds[1] / seconds[0] if seconds[0] > 0 else np.nan),
    }
    for quantity, effect in effects.items():
        discordant = {"discordant": int(np.sum(success[0] != success[1]))} if quantity == "success" else {}
        yield head | {"quantity": quantity} | asdict(effect) | {"finding": ""} | discordant


def _head(first: Group, second: Group) -> dict[str, Any]:
    """Returns what identifies a comparison: the scenario, and the differing options of one label, with both values."""
    columns = dict(first.columns)
    if first.label == second.label:
        configs = [{"estimator": group.footer["identity"]["estimator"]} for group in (first, second)]
        leaves = [config_leaves(config) for config in configs]
        for key in differing(configs):
            shown = [_plain(shown_leaf(own[key][1])) if key in own else "-" for own in leaves]
            columns[key] = " | ".join("-" if value == "None" else value for value in shown)
    return columns


# Which scenarios and estimators belong together ----------------------------------------------------------------------


def _matches(
    first: Collection, second: Collection, labels: tuple[str | None, str | None]
) -> Iterator[tuple[Sample, Sample]]:
    """Pairs samples of the same scenario but for its seed, under the labels or those that both have.

    Raises:
        UserError: there is none.
    """
    for collection in (first, second):
        if not collection.groups:
            raise UserError(
                f"{_where(collection)}: holds no trials to compare; `ipe-bench status` says what is missing"
            )
    a, b = _by_scenario(first), _by_scenario(second)
    if not a.keys() & b.keys():
        raise UserError(
            f"{_where(first)}, {_where(second)}: have no scenario in common; compare runs of the same measurement,"
            " noise and error scales, or show both side by side with `ipe-bench report A B output=DIR`"
        )
    wanted = labels[0] or labels[1], labels[1] or labels[0]

    def asked(one: Group, other: Group) -> bool:
        if wanted[0] is None:
            return one.estimator == other.estimator
        return wanted[0] in (one.estimator, one.label) and wanted[1] in (other.estimator, other.label)

    found = [(one, other) for key in a if key in b for one in a[key] for other in b[key] if asked(one, other)]
    if not found:
        raise _no_estimator(first, second, wanted)
    for one, other in found:
        mine, theirs = (next(samples(c, [g]), None) for c, g in ((first, one), (second, other)))
        if mine is None or theirs is None:
            raise UserError(f"{one.estimator}: has no trials to compare; run more of them")
        yield mine, theirs


def left_out(first: Collection, second: Collection) -> list[str]:
    """Reports scenarios that one side lacks, while both share some."""
    a, b = _by_scenario(first).keys(), _by_scenario(second).keys()
    alone = ((first, len(a - b)), (second, len(b - a))) if a & b else ()
    return [f"{_where(c)}: {count} scenarios that the other lacks are left out" for c, count in alone if count]


def _by_scenario(collection: Collection) -> dict[str, list[Group]]:
    found: dict[str, list[Group]] = {}
    for group in collection.groups:
        found.setdefault(canonical_json(scenario_of(group.cells[0])), []).append(group)
    return found


def _no_estimator(first: Collection, second: Collection, wanted: tuple[str | None, str | None]) -> UserError:
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
