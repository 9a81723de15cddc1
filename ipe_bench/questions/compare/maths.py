"""Compares two folders of results, or two estimators, trial by trial.

This module finds the scenarios and trials that belong together; the tests are in `effects`.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Mapping
from dataclasses import asdict, replace
from itertools import product
from typing import TYPE_CHECKING, Any, NamedTuple

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
from ipe_bench.statistics.verdicts import CONSISTENT, NOT_REFUTED
from ipe_bench.trials.thresholds import FEW, gate

if TYPE_CHECKING:
    from ipe_bench.runs.results import StoredCell

JUDGED = ("success", "error", "cost")
"""Quantities that are tested unless others are asked for."""
MARGINS = {"success": 0.01, "error": 0.02, "honesty": 0.05, "bias": 0.1, "cost": 0.05}
"""Quantities that can be tested, with the change that matters: a difference of success, and of bias
in deviations of the bound; of the others a ratio less 1. Time is not: trials of a block share
theirs evenly, and machines differ."""
NOT_SETTINGS = (
    *("first", "second", "trials", "matched_by", "quantity", "first_value", "second_value"),
    *("change", "low", "high", "p", "e", "different", "finding", *PLANNED),
)
"""The columns of a row that do not say what is compared."""
_TITLES = {"measurement": "", "noise": "", "error_scale": "error scale "}
"""What stands before the values of a title, where it is not the column's name."""
_NOTHING = Effect(np.nan, np.nan, np.nan)
"""The effect without a trial to compare."""


class _Compared(NamedTuple):
    row: dict[str, Any]
    loss: tuple[float, float]
    """How much worse the second is: the ends of `_loss`."""
    discordant: int
    """Number of trials in which the two differ."""


class _Column(NamedTuple):
    """Holds the numbers (trials,) of both sides on one quantity."""

    quantity: str
    first: Array
    second: Array
    largest: float | None = None
    """The largest difference there can be; None if it is unknown."""

    @property
    def kind(self) -> str:
        return kind_of(self.quantity)


def kind_of(quantity: str) -> str:
    """Returns a quantity without the name of its parameter."""
    return quantity.partition(" ")[0]


def comparison_title(row: Mapping[str, Any]) -> str:
    """Titles a comparison in one line."""
    words = []
    for key, value in row.items():
        # NaN, which is not equal to itself, is the value of a setting that the scenario lacks.
        if key not in NOT_SETTINGS and value is not None and value == value:
            words.append(_TITLES.get(key, f"{key} ") + _plain(value))
    return ", ".join(words)


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
    """Returns rows of every comparison that can be made: one per scenario, pair of estimators and
    quantity.

    Each p is corrected by Holm over all that are `tested`; with `anytime`, findings go by e-values,
    divided by their number. Then the two are `different`; a finding's own interval lies beyond the
    margin, too. With a `plan`, rows on success say how many trials it takes, at the strictest level
    that Holm asks for.

    Raises:
        UserError: there is nothing to compare.
    """
    pairs = _matches(first, second, labels)
    found = [one for a, b in pairs for one in _rows(a, b, alpha, tested)]
    judged = [one for one in found if np.isfinite(one.row["p"])]
    corrected = holm([one.row["p"] for one in judged]).tolist()
    tests = len(judged)
    for one, p in zip(judged, corrected, strict=True):
        row = one.row
        if plan is not None and row["quantity"] == "success":
            row |= plan.row(one.discordant, row["trials"], alpha / tests)
        row["p"] = p
        # Evidence of several tests at once is divided by their number, as Bonferroni's p is
        # multiplied by it.
        different = row["e"] >= tests / alpha if anytime else p < alpha
        row["different"] = bool(different)
        if different:
            row["finding"] = _finding(row["quantity"], one.loss, margins)
    return [one.row for one in found]


def _finding(quantity: str, loss: tuple[float, float], margins: Mapping[str, float]) -> str:
    """Words a change whose whole interval lies beyond the margin, else returns nothing."""
    kind = kind_of(quantity)
    margin = margins[kind]
    if kind not in ("success", "bias"):
        # The loss is one of logarithms.
        margin = np.log1p(margin)
    low, high = loss
    if low > margin:
        return "worse"
    return "better" if high < -margin else ""


def _rows(a: Sample, b: Sample, alpha: float, tested: Container[str]) -> Iterator[_Compared]:
    """Yields a row per quantity of two estimators on one scenario."""
    if a.n != b.n:
        raise UserError(
            f"{a.group.label}: has {a.n} parameters in the first and {b.n} in the second; compare"
            " results on the same measurement"
        )
    _, one, other = np.intersect1d(a.number, b.number, assume_unique=True, return_indices=True)
    matched_by = "trial"
    if not len(one):
        # With other seeds trials are matched in their order: right, since all are independent, but
        # nothing is gained.
        matched_by = "order"
        one = other = np.arange(min(len(a), len(b)))
    head = _head(a.group, b.group)
    head |= {"trials": len(one), "matched_by": matched_by}
    unsaid = {"different": False, "finding": ""}
    for column in _columns(a, b, one, other, tested):
        effect = _effect(column, alpha)
        loss = _loss(column.kind, effect, column.first, a.n)
        if column.kind not in tested:
            effect = replace(effect, p=np.nan, e=np.nan)
        # Honesty and bias are of fewer trials than were matched.
        of_column = {"quantity": column.quantity, "trials": len(column.first)}
        row = head | of_column | asdict(effect) | unsaid
        yield _Compared(row, loss, int(np.sum(column.first != column.second)))
    row = head | {"quantity": "time"} | asdict(_times(a, b, one, other)) | unsaid
    yield _Compared(row, (np.nan, np.nan), 0)


def _effect(column: _Column, alpha: float) -> Effect:
    """Compares the two sides by the test that belongs to the quantity."""
    _, first, second, largest = column
    if not len(first):
        return _NOTHING
    if column.kind == "success":
        return success_effect(first, second, alpha)
    if column.kind == "bias":
        assert largest is not None
        return mean_effect(first, second, alpha, largest)
    return ratio_effect(first, second, alpha, largest)


def _times(a: Sample, b: Sample, one: Array, other: Array) -> Effect:
    """Returns the mean times of a trial, which are not tested, and their ratio."""
    first = float(np.mean(a.scalars["time_s"][one]))
    second = float(np.mean(b.scalars["time_s"][other]))
    return Effect(first, second, second / first if first > 0 else np.nan)


def _columns(
    a: Sample, b: Sample, one: Array, other: Array, tested: Container[str]
) -> Iterator[_Column]:
    """Yields the numbers of both in the matched trials."""
    radius = float(np.sqrt(gate(a.n)))
    yield _Column("success", *_successes(a, b, one, other))
    # An error beyond the gate counts as one on it, so that few failures do not decide the mean.
    first = np.minimum(a.distance[one], radius)
    second = np.minimum(b.distance[other], radius)
    yield _Column("error", first, first + differences(second, first), radius)
    if "honesty" in tested:
        yield _honesty(a, b, one, other, radius**2 / a.n)
    if "bias" in tested:
        yield from _biases(a, b, one, other, 2 * radius)
    yield _Column("cost", a.cost[one], b.cost[other])


def _successes(a: Sample, b: Sample, one: Array, other: Array) -> tuple[Array, Array]:
    """Returns the successes of both by the one bound for both, as the table of a run counts them if
    that is the bound of each."""
    if _bound(a, b) == "crlb":
        return a.inside_gate[one], b.inside_gate[other]
    return a.scalars["success"][one], b.scalars["success"][other]


def _bound(a: Sample, b: Sample) -> str:
    """Names the bound that both are held against: the Cramér-Rao bound, unless both are held
    against the Bayesian one."""
    bounds = {a.group.footer["bound"], b.group.footer["bound"]}
    return "bayes" if bounds == {"bayes"} else "crlb"


def _honesty(a: Sample, b: Sample, one: Array, other: Array, most: float) -> _Column:
    """Returns the NEES by the number of parameters, at most that of an error on the gate.

    Trials that do not converge claim nothing: those of both count. If they are fewer than a verdict
    takes, but for trials that the first lacks too, the second claims no more: it is on the gate in
    all trials that the first claims and it does not.
    """
    first = _claims(a, one)
    second = _claims(b, other)
    claimed = ~np.isnan(first)
    common = claimed & b.converged[other]
    enough = common.sum() >= min(FEW, claimed.sum())
    kept = common if enough and common.any() else claimed
    # The lesser of NaN, where nothing is claimed, and the most is the most.
    return _Column("honesty", np.fmin(first[kept], most), np.fmin(second[kept], most), most)


def _claims(sample: Sample, at: Array) -> Array:
    """Returns NEES / n of these trials; NaN where they do not converge."""
    nees = sample.scalars["nees"][at] / sample.n
    return np.where(sample.converged[at], nees, np.nan)


def _biases(a: Sample, b: Sample, one: Array, other: Array, largest: float) -> Iterator[_Column]:
    """Yields the errors of each parameter, in deviations of the bound, where both succeed."""
    bound = _bound(a, b)
    both = np.logical_and(*_successes(a, b, one, other))
    errors_a = (a.error[one] / a.of_truth(bound)[one])[both]
    errors_b = (b.error[other] / b.of_truth(bound)[other])[both]
    for name, first, second in zip(a.names, errors_a.T, errors_b.T, strict=True):
        known = np.isfinite(first) & np.isfinite(second)
        yield _Column(f"bias of {name}", first[known], second[known], largest)


def _loss(kind: str, effect: Effect, first: Array, n: int) -> tuple[float, float]:
    """Returns the ends of how much worse the second is, as a difference of success and bias, else
    of logarithms; NaN without a trial.

    Honesty and bias are worse farther from 1 and from 0, which the first counts as if it may be
    right.
    """
    if not len(first):
        return np.nan, np.nan
    low = effect.low
    high = effect.high
    if kind == "success":
        return -high, -low
    start = effect.first_value
    if _may_be_right(kind, first, n):
        start = float(kind == "honesty")
    if kind != "bias":
        if np.isnan(low):  # a ratio to or from 0 has no ends
            fell = effect.second_value < effect.first_value
            low = high = 0.0 if fell else np.inf
        with np.errstate(divide="ignore"):
            low, high, start = np.log([low, high, start]).tolist()
    if kind not in ("honesty", "bias"):
        return low, high
    return _farther(start, low, high)


def _farther(start: float, low: float, high: float) -> tuple[float, float]:
    """Returns the least and the most by which a change in an interval leads farther from 0, which
    is right."""
    ends = abs(start + low), abs(start + high)
    crosses = (start + low) * (start + high) < 0
    nearest = 0.0 if crosses else min(ends)
    return nearest - abs(start), max(ends) - abs(start)


def _may_be_right(kind: str, first: Array, n: int) -> bool:
    """Returns whether the mean of the first may be that of a right covariance of n parameters, or
    of no bias."""
    if kind == "honesty":
        return verdict(n * first, n) in (CONSISTENT, NOT_REFUTED)
    # Within two standard errors of the mean.
    return abs(first.mean()) <= 2 * first.std() / np.sqrt(len(first))


def _head(first: Group, second: Group) -> dict[str, Any]:
    """Returns what identifies a comparison: the scenario, the differing options of one label with
    both values, and the estimators."""
    head = dict(first.columns)
    if first.label == second.label:
        configs = [_config(first), _config(second)]
        leaves = [config_leaves(config) for config in configs]
        for key in differing(configs):
            head[key] = " | ".join(_option(own, key) for own in leaves)
    return head | {"first": first.estimator, "second": second.estimator}


def _config(group: Group) -> dict[str, Any]:
    return {"estimator": group.footer["identity"]["estimator"]}


def _option(leaves: Mapping[str, tuple[str, Any]], key: str) -> str:
    """Words an option that only one side may have."""
    if key not in leaves:
        return "-"
    _, value = leaves[key]
    shown = _plain(shown_leaf(value))
    return "-" if shown == "None" else shown


# Which scenarios and estimators belong together --------------------------------------------------


def _matches(
    first: Collection, second: Collection, labels: tuple[str | None, str | None]
) -> Iterator[tuple[Sample, Sample]]:
    """Pairs samples of the same scenario but for its seed, under the labels or those that both
    have.

    Raises:
        UserError: there is none.
    """
    for collection in (first, second):
        if not collection.groups:
            raise UserError(
                f"{_where(collection)}: contains no trials to compare; `ipe-bench status` lists"
                " what"
                " is missing"
            )
    scenarios = list(_in_both(first, second))
    if not scenarios:
        raise UserError(
            f"{_where(first)}, {_where(second)}: have no scenario in common; compare runs of the"
            " same measurement, noise and error scales, or show both side by side with"
            " `ipe-bench report A B output=DIR`"
        )
    wanted = labels[0] or labels[1], labels[1] or labels[0]
    pairs = [pair for groups in scenarios for pair in product(*groups) if _asked(*pair, wanted)]
    if not pairs:
        raise _no_estimator(first, second, wanted)
    for one, other in pairs:
        mine = next(samples(first, [one]), None)
        theirs = next(samples(second, [other]), None)
        if mine is None or theirs is None:
            raise UserError(f"{one.estimator}: has no trials to compare; run more of them")
        yield mine, theirs


def _in_both(first: Collection, second: Collection) -> Iterator[tuple[list[Group], list[Group]]]:
    """Yields the groups of each scenario of both, in the order of the first."""
    others = _by_scenario(second)
    for scenario, groups in _by_scenario(first).items():
        if scenario in others:
            yield groups, others[scenario]


def _asked(one: Group, other: Group, wanted: tuple[str | None, str | None]) -> bool:
    """Returns whether two groups bear the labels that are wanted, or one label without any."""
    first, second = wanted
    if first is None:
        return one.estimator == other.estimator
    return first in (one.estimator, one.label) and second in (other.estimator, other.label)


def gone(
    first: Collection, second: Collection, labels: tuple[str | None, str | None]
) -> Iterator[str]:
    """Yields a line where the second lacks an estimator of the first on a scenario, some trials, or
    its covariance."""
    matched = list(_matches(first, second, labels))
    wanted = labels[0] or labels[1]
    for group in first.groups:
        if wanted not in (None, group.estimator, group.label):
            continue
        title = f"gone: {group.estimator}, {comparison_title(group.columns)}: the second"
        pairs = [(a, b) for a, b in matched if a.group is group]
        if not pairs:
            yield f"{title} has no trials of it"
        for a, b in pairs:
            common = len(np.intersect1d(a.number, b.number)) or min(len(a), len(b))
            if common < len(a):
                yield f"{title} has {common} of its {len(a)} trials"
            if _has_covariance(a) and not _has_covariance(b):
                yield f"{title} reports no covariance"


def _has_covariance(sample: Sample) -> bool:
    return not np.isnan(sample.scalars["nees"]).all()


def other_sources(first: Collection, second: Collection) -> Iterator[str]:
    """Yields a line if other versions of the bench, a plugin or a library drew the trials of a
    scenario of both."""
    differ: dict[str, None] = {}
    for groups, others in _in_both(first, second):
        for x, y in product(groups[0].truths, others[0].truths):
            if x and y:
                differ |= dict.fromkeys(_other_versions(x, y))
    if differ:
        yield (
            f"other sources: {', '.join(differ)}; differences may be theirs: run both sides with"
            " the same ones"
        )


def _other_versions(first: StoredCell, second: StoredCell) -> Iterator[str]:
    """Yields what drew the first but in another version the second."""
    theirs = _made_by(second)
    for name, version in _made_by(first).items():
        if version != theirs.get(name):
            yield f"{name} {version} | {theirs.get(name)}"


def _made_by(truth: StoredCell) -> dict[str, Any]:
    footer = truth.footer
    return {**footer["versions"], **footer["libraries"], "source": footer["source"]}


def too_few(rows: Iterable[Mapping[str, Any]], alpha: float) -> Iterator[str]:
    """Yields a line for each number of trials so small that, with all signs alike, Holm's test
    rejects no change."""
    tested = [row["trials"] for row in rows if np.isfinite(row["p"])]
    tests = len(tested)
    # The least p of k trials whose signs are all alike is 2 * 2^-k; Holm asks for alpha / tests.
    least = int(np.ceil(1 + np.log2(max(1, tests) / alpha)))
    for trials in sorted({trials for trials in tested if trials < least}):
        yield (
            f"common trials: {trials} are too few for any finding in {tests} tests; run at least"
            f" {least}"
        )


def left_out(first: Collection, second: Collection) -> list[str]:
    """Reports scenarios that one side lacks, while both share some."""
    a = _by_scenario(first).keys()
    b = _by_scenario(second).keys()
    if not a & b:
        return []
    alone = ((first, len(a - b)), (second, len(b - a)))
    return [
        f"{_where(side)}: {count} scenarios that the other lacks are left out"
        for side, count in alone
        if count
    ]


def _by_scenario(collection: Collection) -> dict[str, list[Group]]:
    found: dict[str, list[Group]] = {}
    for group in collection.groups:
        scenario = canonical_json(scenario_of(group.cells[0]))
        found.setdefault(scenario, []).append(group)
    return found


def _no_estimator(
    first: Collection, second: Collection, wanted: tuple[str | None, str | None]
) -> UserError:
    sides = (("first", wanted[0], first), ("second", wanted[1], second))
    for name, label, collection in sides:
        known = {known for g in collection.groups for known in (g.estimator, g.label)}
        if label is not None and label not in known:
            return UserError(f"{name}={label}: {unknown(label, known, 'estimator')}")
    if wanted != (None, None):
        return UserError(
            f"first={wanted[0]} second={wanted[1]}: no scenario has both; run both on the same one"
        )
    return UserError(
        f"no estimator is in both ({_estimators(first)}; {_estimators(second)}); choose with"
        " first=LABEL second=LABEL"
    )


def _estimators(collection: Collection) -> str:
    return ", ".join(dict.fromkeys(group.estimator for group in collection.groups))


def _where(collection: Collection) -> str:
    return ", ".join(map(str, collection.directories))
