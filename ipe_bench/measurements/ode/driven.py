"""Handles known changes with time: inputs that are held or straight between rows, and comparisons
of t in rates.

A change is the end of a step, so that no step crosses it: within an interval between two such times
a comparison of t holds throughout or nowhere, a held input is a constant, and one that is straight
is a line.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.engine import trace
from ipe_bench.measurements.arithmetic import (
    COMPARISONS,
    CONSTANTS,
    Arithmetic,
    Tree,
    evaluate,
    parts,
)

PIECEWISE = ("min", "max", "abs", "sign", *COMPARISONS)
_REMEDY = "compare t itself with a constant, so that the moment of the switch is known"
_SAME = 1e-12
"""Largest difference of equal times, as a share of the whole span."""


def separated(
    formulas: Mapping[str, Arithmetic], constants: Collection[str]
) -> tuple[dict[str, Arithmetic], dict[str, Tree]]:
    """Replaces comparisons of t with constants by names; returns the formulas and the comparisons
    by these names."""
    switches: dict[Tree, str] = {}
    known = {"t", *constants, *CONSTANTS}

    def switching(tree: Tree) -> bool:
        if tree[0] not in PIECEWISE:
            return False
        names = {part[1] for part in parts(tree) if part[0] == "name"}
        return "t" in names and names <= known

    def rewritten(tree: Tree) -> Tree:
        if not switching(tree):
            return tuple(rewritten(part) if isinstance(part, tuple) else part for part in tree)
        if tree[0] in COMPARISONS:
            return ("name", switches.setdefault(tree, f"switch {len(switches)}"))
        operation, *operands = tree
        if any(switching(part) for operand in operands for part in parts(operand)):
            raise UserError(f"rates: the {operation} of t: {_REMEDY}")
        return rewritten(_as_comparisons(operation, *operands))

    found = dict(formulas)
    for key, formula in formulas.items():
        if any(part[0] in PIECEWISE for part in parts(formula.tree)):
            found[key] = replace(formula, tree=rewritten(formula.tree))
    return found, {name: tree for tree, name in switches.items()}


def _as_comparisons(operation: str, a: Tree, *other: Tree) -> Tree:
    """Writes min, max, abs or sign by comparisons: sign is (a > 0) - (a < 0), abs the larger of a
    and -a."""
    text = f"the {operation} of t"
    if operation == "sign":
        zero = ("number", 0.0)
        return ("-", (">", a, zero, text), ("<", a, zero, text))
    b = other[0] if other else ("negative", a)
    comparison = ("<" if operation == "min" else ">", a, b, text)
    return ("if", comparison, a, b)


def switching_times(comparison: Tree, cases: Sequence[Mapping[str, float]]) -> list[float]:
    """Finds when a comparison of t, by itself or times a constant, begins or ceases to hold in one
    of the cases."""
    _, left, right, text = comparison
    found = []
    for case in cases:
        t = trace.Graph().input("t")
        difference = evaluate(("-", left, right), {**case, "t": t})
        gap = t.graph.apply("add", difference, 0.0)
        slope = trace.tangent([gap], {t: t.graph.constant(1.0)})[0].value
        if slope is None or any(e.operation in trace.FLAT for e in trace.in_order([gap])):
            raise UserError(f"rates: {text}: {_REMEDY}")
        # A straight line crosses zero at -gap(0) / slope.
        if slope:
            at_zero = float(trace.Program.of([gap], [t])([0.0])[0])
            found.append(-at_zero / slope)
    return found


def grid(readings: Array, changes: Sequence[float]) -> Array:
    """Returns the times of the readings, and those of the changes between 0 and the last of
    them."""
    end = float(readings.max(initial=0.0))
    same = _SAME * end
    inside = np.unique([time for time in changes if same < time < end])
    nearest = np.abs(inside[:, None] - readings).min(axis=1, initial=np.inf)
    return np.union1d(readings, inside[nearest > same])


def middles(times: Array) -> Array:
    """Returns a time within each interval that ends at one of these times, and the last of them."""
    starts = np.append(0.0, times)
    ends = np.append(times, times[-1:])
    return (starts + ends) / 2


def course(kind: str, times: Array, values: Array, at: Array) -> list[Array]:
    """Returns the constants, of the intervals around `at`, of an input with these values: a held
    one, or the line u + slope (t - since) as u, slope and since. It is level before its first row
    and after its last."""
    k = np.searchsorted(times, at, side="right") - 1
    row = np.maximum(k, 0)
    if kind == "hold":
        return [values[row]]
    slopes = np.append(np.diff(values) / np.diff(times), 0.0)
    slope = np.where(k < 0, 0.0, slopes[row])
    return [values[row], slope, times[row]]


def numbered_cases(numbers: Sequence[int]) -> int:
    """Counts the cases that a column numbers."""
    known = sorted(set(numbers))
    if known != list(range(1, len(known) + 1)):
        there = ", ".join(map(str, known))
        raise UserError(f"case={known[-1]}: cases are numbered 1, 2 and so on; there are {there}")
    return len(known)


def agreed(
    name: str, column: Sequence[float], places: Sequence[tuple[float, ...]], remedy: str = ""
) -> dict[tuple[float, ...], float]:
    """Returns a column's value at each place in ascending order: a case, or a time of a case."""
    found: dict[tuple[float, ...], float] = {}
    for value, place in zip(column, places, strict=True):
        first = found.setdefault(place, value)
        if first != value:
            numbers = zip(("case", "time"), place, strict=False)
            where = ", ".join(f"{key}={number:g}" for key, number in numbers)
            raise UserError(
                f"{where}: {name} is {first:g} in one row and {value:g} in another{remedy}"
            )
    return dict(sorted(found.items()))


def courses(columns: Mapping[str, Sequence[Any]], names: Collection[str]) -> list[dict[str, Array]]:
    """Reads the columns `time` and those of the inputs, of each case."""
    wanted = ("time", *names)
    for name in wanted:
        if not len(columns.get(name, ())):
            here = " ".join(f"measurement.columns.{one}=[...]" for one in wanted)
            file = f"readings=FILE with columns time and {', '.join(names)}"
            raise UserError(f"measurement.columns: {name} is not known; give {file}, or {here}")
    arrays = {name: np.asarray(columns[name], dtype=float) for name in wanted}
    one_case = np.ones(len(arrays["time"]))
    case = np.asarray(columns.get("case", one_case), dtype=int)
    numbers = range(1, numbered_cases(case.tolist()) + 1)
    found = [{name: one[case == number] for name, one in arrays.items()} for number in numbers]
    for one in found:
        if one["time"][0] < 0 or (np.diff(one["time"]) <= 0).any():
            raise UserError("columns.time: give ascending numbers from 0 on in each case")
    return found
