"""Compares two folders of results, or two estimators, trial by trial.

This module finds the scenarios and trials that belong together; the tests are in `statistics.paired`.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Mapping
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from ipe_bench.basics.errors import UserError, unknown
from ipe_bench.basics.linalg import Array
from ipe_bench.questions.compare.effects import (
    PLANNED,
    Effect,
    PowerPlan,
    mean_effect,
    ratio_effect,
    success_effect,
)
from ipe_bench.runs.provenance import canonical_json
from ipe_bench.statistics.collect import (
    Collection,
    Group,
    config_leaves,
    differing,
    scenario_of,
    shown_leaf,
)
from ipe_bench.statistics.comparisons import ALPHA, differences, holm
from ipe_bench.statistics.intervals import verdict
from ipe_bench.statistics.sample import Sample, samples
from ipe_bench.statistics.verdicts import CONSISTENT
from ipe_bench.trials.thresholds import gate

JUDGED = ("success", "error", "cost")
"""Quantities that are tested unless others are asked for."""
MARGINS = {"success": 0.01, "error": 0.02, "honesty": 0.05, "bias": 0.1, "cost": 0.05}
"""Quantities that can be tested, with the change that matters: a difference of success, and of bias in deviations of
the bound; of the others a ratio less 1. Time is not: trials of a block share theirs evenly, and machines differ."""
UNTESTED: Mapping[str, Any] = {"different": False, "finding": "", "loss": None, "discordant": 0}
"""The end of a row on a quantity that is not tested."""
NOT_SETTINGS = (
    *("first", "second", "trials", "matched_by", "quantity", "first_value", "second_value"),
    *("change", "low", "high", "p", "e", "different", "finding", *PLANNED),
)
"""The columns of a row that do not say what is compared."""


def comparison_title(row: Mapping[str, Any]) -> str:
    """Titles a comparison in one line."""
    named = {
        k: _plain(v) for k, v in row.items() if k not in NOT_SETTINGS and v is not None and v == v
    }
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
    tested: Container[str] = JUDGED,
    margins: Mapping[str, float] = MARGINS,
) -> list[dict[str, Any]]:
    """Returns rows of every comparison that can be made: one per scenario, pair of estimators and quantity.

    Each p is corrected by Holm over all that are `tested`; with `anytime`, findings go by e-values, divided by their
    number. Then the two are `different`; a finding's own interval lies beyond the margin, too. With a `plan`, rows on
    success say how many trials it takes, at the strictest level that Holm asks for.

    Raises:
        UserError: there is nothing to compare.
    """
    rows = [
        row for match in _matches(first, second, labels) for row in _rows(*match, alpha, tested)
    ]
    hidden = [(row.pop("loss"), row.pop("discordant")) for row in rows]
    judged = [one for one in zip(rows, hidden, strict=True) if np.isfinite(one[0]["p"])]
    for (row, ((low, high), discordant)), p in zip(
        judged, holm([row["p"] for row, _ in judged]), strict=True
    ):
        if plan is not None and row["quantity"] == "success":
            row |= plan.row(discordant, row["trials"], alpha / len(judged))
        row["p"], kind = float(p), row["quantity"].partition(" ")[0]
        row["different"] = bool(row["e"] >= len(judged) / alpha if anytime else p < alpha)
        if row["different"]:
            margin = margins[kind] if kind in ("success", "bias") else np.log1p(margins[kind])
            row["finding"] = "worse" if low > margin else "better" if high < -margin else ""
    return rows


def _rows(a: Sample, b: Sample, alpha: float, tested: Container[str]) -> Iterator[dict[str, Any]]:
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
    for quantity, first, second, largest in _columns(a, b, one, other, tested):
        kind, effect, loss = (
            quantity.partition(" ")[0],
            Effect(np.nan, np.nan, np.nan),
            (np.nan, np.nan),
        )
        if len(first):
            effect = {"success": success_effect, "bias": mean_effect}.get(kind, ratio_effect)(
                first, second, alpha, *largest
            )
            loss = _loss(kind, effect, first, a.n)
        effect = effect if kind in tested else replace(effect, p=np.nan, e=np.nan)
        more = {
            "different": False,
            "finding": "",
            "loss": loss,
            "discordant": int(np.sum(first != second)),
        }
        yield head | {"quantity": quantity} | asdict(effect) | more
    seconds = float(np.mean(a.scalars["time_s"][one])), float(np.mean(b.scalars["time_s"][other]))
    effect = Effect(*seconds, seconds[1] / seconds[0] if seconds[0] > 0 else np.nan)
    yield head | {"quantity": "time"} | asdict(effect) | dict(UNTESTED)


def _columns(
    a: Sample, b: Sample, one: Array, other: Array, tested: Container[str]
) -> Iterator[tuple[str, Array, Array, tuple[float, ...]]]:
    """Yields the numbers of both in the matched trials, with the largest difference there can be if it is known."""
    success, n, radius = (a.inside_gate[one], b.inside_gate[other]), a.n, float(np.sqrt(gate(a.n)))
    yield "success", *success, ()
    error = np.minimum(a.distance[one], radius), np.minimum(b.distance[other], radius)
    yield "error", error[0], error[0] + differences(error[1], error[0]), (radius,)
    if "honesty" in tested:
        # Trials that do not converge claim nothing. What the second claims no more, in some or in all, is on the gate.
        nees = [
            np.where(s.converged[at], s.scalars["nees"][at] / n, np.nan)
            for s, at in ((a, one), (b, other))
        ]
        claimed, common = ~np.isnan(nees[0]), ~np.isnan(nees[0]) & b.converged[other]
        first, second = (
            np.fmin(v[common if common.any() else claimed], radius**2 / n) for v in nees
        )
        yield "honesty", first, second, (radius**2 / n,)
    if "bias" in tested:
        bound, both = a.group.footer["bound"], success[0] & success[1]
        errors = [(s.error[at] / s.of_truth(bound)[at])[both].T for s, at in ((a, one), (b, other))]
        for name, first, second in zip(a.names, *errors, strict=True):
            known = np.isfinite(first) & np.isfinite(second)
            yield f"bias of {name}", first[known], second[known], (2 * radius,)
    yield "cost", a.cost[one], b.cost[other], ()


def _loss(kind: str, effect: Effect, first: Array, n: int) -> tuple[float, float]:
    """Returns the ends of how much worse the second is, as a difference of success and bias, else of logarithms.

    Honesty and bias are worse farther from 1 and from 0, which the first counts as if it may be right.
    """
    low, high, start = effect.low, effect.high, effect.first_value
    if kind == "success":
        return -high, -low
    if _may_be_right(kind, first, n):
        start = float(kind == "honesty")
    if kind != "bias":
        if np.isnan(low):  # a ratio to or from 0 has no ends
            low = high = 0.0 if effect.second_value < effect.first_value else np.inf
        with np.errstate(divide="ignore"):
            low, high, start = np.log([low, high, start]).tolist()
    if kind not in ("honesty", "bias"):
        return low, high
    ends = abs(start + low), abs(start + high)
    return (0.0 if (start + low) * (start + high) < 0 else min(ends)) - abs(start), max(ends) - abs(
        start
    )


def _may_be_right(kind: str, first: Array, n: int) -> bool:
    """Returns whether the mean of the first may be that of a right covariance of n parameters, or of no bias."""
    if kind == "honesty":
        return verdict(n * first, n) == CONSISTENT
    return abs(first.mean()) <= 2 * first.std() / np.sqrt(len(first))


def _head(first: Group, second: Group) -> dict[str, Any]:
    """Returns what identifies a comparison: the scenario, and the differing options of one label, with both values."""
    columns = dict(first.columns)
    if first.label == second.label:
        configs = [
            {"estimator": group.footer["identity"]["estimator"]} for group in (first, second)
        ]
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
                f"{_where(collection)}: holds no trials to compare; `ipe-bench status` lists what is missing"
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
        return wanted[0] in (one.estimator, one.label) and wanted[1] in (
            other.estimator,
            other.label,
        )

    found = [
        (one, other)
        for key in a
        if key in b
        for one in a[key]
        for other in b[key]
        if asked(one, other)
    ]
    if not found:
        raise _no_estimator(first, second, wanted)
    for one, other in found:
        mine, theirs = (next(samples(c, [g]), None) for c, g in ((first, one), (second, other)))
        if mine is None or theirs is None:
            raise UserError(f"{one.estimator}: has no trials to compare; run more of them")
        yield mine, theirs


def gone(
    first: Collection, second: Collection, labels: tuple[str | None, str | None]
) -> Iterator[str]:
    """Yields a line where the second lacks an estimator of the first on a scenario, some trials, or its covariance."""
    matched, wanted = list(_matches(first, second, labels)), labels[0] or labels[1]
    for group in (g for g in first.groups if wanted in (None, g.estimator, g.label)):
        title = f"gone: {group.estimator}, {comparison_title(group.columns)}: the second"
        pairs = [(a, b) for a, b in matched if a.group is group]
        if not pairs:
            yield f"{title} has no trials of it"
        for a, b in pairs:
            common = len(np.intersect1d(a.number, b.number)) or min(len(a), len(b))
            if common < len(a):
                yield f"{title} has {common} of its {len(a)} trials"
            if [bool(np.isnan(s.scalars["nees"]).all()) for s in (a, b)] == [False, True]:
                yield f"{title} reports no covariance"


def other_sources(first: Collection, second: Collection) -> Iterator[str]:
    """Yields a line if other versions of the bench, a plugin or a library drew the trials of a scenario of both."""
    a, b = _by_scenario(first), _by_scenario(second)
    truths = [
        (x, y)
        for key in a
        if key in b
        for x in a[key][0].truths
        for y in b[key][0].truths
        if x and y
    ]
    made = [
        [{**t.footer["versions"], **t.footer["libraries"], "source": t.footer["source"]} for t in p]
        for p in truths
    ]
    differ = dict.fromkeys(
        f"{k} {x[k]} | {y.get(k)}" for x, y in made for k in x if x[k] != y.get(k)
    )
    if differ:
        yield f"other sources: {', '.join(differ)}; differences may be theirs: run both sides with the same ones"


def too_few(rows: Iterable[Mapping[str, Any]], alpha: float) -> Iterator[str]:
    """Yields a line for each number of trials so small that, with all signs alike, Holm's test rejects no change."""
    tested = [row["trials"] for row in rows if np.isfinite(row["p"])]
    least = int(np.ceil(1 + np.log2(max(1, len(tested)) / alpha)))
    for trials in sorted({trials for trials in tested if trials < least}):
        yield f"common trials: {trials} are too few for any finding in {len(tested)} tests; run at least {least}"


def left_out(first: Collection, second: Collection) -> list[str]:
    """Reports scenarios that one side lacks, while both share some."""
    a, b = _by_scenario(first).keys(), _by_scenario(second).keys()
    alone = ((first, len(a - b)), (second, len(b - a))) if a & b else ()
    return [
        f"{_where(c)}: {count} scenarios that the other lacks are left out"
        for c, count in alone
        if count
    ]


def _by_scenario(collection: Collection) -> dict[str, list[Group]]:
    found: dict[str, list[Group]] = {}
    for group in collection.groups:
        found.setdefault(canonical_json(scenario_of(group.cells[0])), []).append(group)
    return found


def _no_estimator(
    first: Collection, second: Collection, wanted: tuple[str | None, str | None]
) -> UserError:
    for name, label, collection in zip(("first", "second"), wanted, (first, second), strict=True):
        known = {g.estimator for g in collection.groups} | {g.label for g in collection.groups}
        if label is not None and label not in known:
            return UserError(f"{name}={label}: {unknown(label, known, 'estimator')}")
    if wanted != (None, None):
        return UserError(
            f"first={wanted[0]} second={wanted[1]}: no scenario has both; run both on the same one"
        )
    names = [", ".join(dict.fromkeys(g.estimator for g in c.groups)) for c in (first, second)]
    return UserError(
        f"no estimator is in both ({names[0]}; {names[1]}); choose with first=LABEL second=LABEL"
    )


def _where(collection: Collection) -> str:
    return ", ".join(map(str, collection.directories))
