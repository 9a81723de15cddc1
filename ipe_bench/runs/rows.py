"""What stored rows must look like: the columns of a file, their types, and the values that they can have.

The writer is held to it as the reader is, so that nothing is stored that would be refused when it is read.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.basics.statuses import Status

Check = Callable[[Array], Any]
Rule = tuple[type, str, Check]
"""Type of a column, what its values are, and the test of that (trials,) -> (trials,)."""

LABELS = [status.label for status in Status if status is not Status.RUNNING]
_ANY: Rule = (np.float64, "numbers", lambda v: True)
_FINITE: Rule = (np.float64, "finite numbers", np.isfinite)
_COST: Rule = (np.float64, "finite numbers from 0 up", lambda v: np.isfinite(v) & (v >= 0))
_BOUND: Rule = (np.float64, "numbers above 0, or NaN where there is none", lambda v: ~(v <= 0))
_FROM_ZERO: Rule = (np.float64, "numbers from 0 up, or NaN where there is none", lambda v: ~(v < 0))
_SHARE: Rule = (np.float64, "numbers from 0 to 1, or NaN where there is none", lambda v: ~((v < 0) | (v > 1)))
_COUNT: Rule = (np.int64, "whole numbers from 0 up", lambda v: v >= 0)
_TEXT: Rule = (np.object_, "texts", lambda v: True)
_STATUS: Rule = (np.object_, "statuses", lambda v: np.isin(v.astype(str), LABELS))
_FLAG: Rule = (np.bool_, "true or false", lambda v: True)

_OF_ESTIMATES: dict[str, Rule] = {
    "status": _STATUS,
    "message": _TEXT,
    "iterations": _COUNT,
    "simulations": _COST,
    "jacobians": _COST,
    "time_s": _COST,
    "crlb_distance": _ANY,
    "nees": _ANY,
    "solved": _FLAG,
    "success": _FLAG,
}
_WHERE_THERE: dict[str, Rule] = {"fit_p": _SHARE}


def trial_rules(names: Sequence[str], *, truth: bool) -> dict[str, Rule]:
    """The columns that trials of a model with these parameters must have, under an estimator or of the truth."""
    vectors = {"x": _FINITE, "crlb": _BOUND, "bayes": _BOUND} if truth else {"error": _ANY, "deviation": _FROM_ZERO}
    found = {f"{kind}_{name}": rule for kind, rule in vectors.items() for name in names}
    return {"trial": _COUNT, **found, **({} if truth else _OF_ESTIMATES)}


def history_rules(names: Sequence[str]) -> dict[str, Rule]:
    """The columns of iterates."""
    return {"trial": _COUNT, "iteration": _COUNT, **{f"x_{name}": _ANY for name in names}}


def faults(rows: Mapping[str, Array], rules: Mapping[str, Rule], start: int | None = None) -> Iterator[str]:
    """What is wrong with the rows, column by column; `start` is the first trial where each trial has one row."""
    for name, (kind, words, check) in rules.items():
        if name not in rows:
            yield f"has no column {name}"
        elif rows[name].dtype != kind:
            yield f"its column {name} holds {rows[name].dtype}, and not {words}"
        elif not np.all(check(rows[name])):
            yield f"its column {name} does not hold {words} throughout"
    for name, (kind, words, check) in _WHERE_THERE.items():
        if name in rows and name not in rules and not (rows[name].dtype == kind and np.all(check(rows[name]))):
            yield f"its column {name} does not hold {words} throughout"
    if start is not None and "trial" in rows:
        expected = np.arange(start, start + len(rows["trial"]))
        if not np.array_equal(rows["trial"], expected):
            yield f"its column trial does not count from {start} up"
    if "status" in rows and rows["status"].dtype == np.object_:
        converged = rows["status"] == Status.CONVERGED.label
        errors = [values for name, values in rows.items() if name.startswith("error_") and values.dtype == np.float64]
        if errors and not np.isfinite(np.stack(errors)[:, converged]).all():
            yield "an error is not finite where the status is converged"
        if "solved" in rows and np.any(np.asarray(rows["solved"], dtype=bool) & ~converged):
            yield "a trial is solved whose status is not converged"


def cast(rows: Mapping[str, Array], rules: Mapping[str, Rule]) -> dict[str, Array]:
    """The rows with each column in its own type, where that changes no value: 3.0 for 3, say."""
    return {name: _as(np.asarray(values), rules[name][0] if name in rules else None) for name, values in rows.items()}


def _as(values: Array, kind: type | None) -> Array:
    if kind is None:
        kind = np.float64 if values.dtype.kind in "fiu" else values.dtype.type
    if kind is np.object_ or values.dtype == kind:
        return values
    with np.errstate(invalid="ignore"):
        changed = values.astype(kind)
    return changed if np.array_equal(changed, values, equal_nan=values.dtype.kind == "f") else values
