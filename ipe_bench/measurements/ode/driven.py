"""Handles known changes with time: inputs that are held or straight between rows, and comparisons of t in rates.

A change is the end of a step, so that no step crosses it: within an interval between two such times a comparison of t
holds throughout or nowhere, a held input is a constant, and one that is straight is a line.
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
    """Replaces comparisons of t with constants by names; returns the formulas and the comparisons by these names."""
    switches: dict[Tree, str] = {}

    def switching(tree: Tree) -> bool:
        names = (
            {part[1] for part in parts(tree) if part[0] == "name"}
            if tree[0] in PIECEWISE
            else set()
        )
        return "t" in names and names <= {"t", *constants, *CONSTANTS}

    def rewritten(tree: Tree) -> Tree:
        if not switching(tree):
            return tuple(rewritten(part) if isinstance(part, tuple) else part for part in tree)
        if tree[0] in COMPARISONS:
            return ("name", switches.setdefault(tree, f"switch {len(switches)}"))
        operation, a, *other = tree
        if any(switching(part) for operand in (a, *other) for part in parts(operand)):
            raise UserError(f"rates: the {operation} of t: {_REMEDY}")
        if operation == "sign":
            text, zero = "the sign of t", ("number", 0.0)
            return rewritten(("-", (">", a, zero, text), ("<", a, zero, text)))
        b = other[0] if other else ("negative", a)
        return rewritten(
            ("if", ("<" if operation == "min" else ">", a, b, f"the {operation} of t"), a, b)
        )

    found = dict(formulas)
    for key, formula in formulas.items():
        if any(part[0] in PIECEWISE for part in parts(formula.tree)):
            found[key] = replace(formula, tree=rewritten(formula.tree))
    return found, {name: tree for tree, name in switches.items()}


def switching_times(comparison: Tree, cases: Sequence[Mapping[str, float]]) -> list[float]:
    """Finds when a comparison of t, by itself or times a constant, begins or ceases to hold in one of the cases."""
    _, left, right, text = comparison
    found = []
    for case in cases:
        t = trace.Graph().input("t")
        gap = t.graph.apply("add", evaluate(("-", left, right), {**case, "t": t}), 0.0)
        slope = trace.tangent([gap], {t: t.graph.constant(1.0)})[0].value
        if slope is None or any(e.operation in trace.FLAT for e in trace.in_order([gap])):
            raise UserError(f"rates: {text}: {_REMEDY}")
        if slope:
            found.append(-float(trace.Program.of([gap], [t])([0.0])[0]) / slope)
    return found


def grid(readings: Array, changes: Sequence[float]) -> Array:
    """Returns the times of the readings, and those of the changes between 0 and the last of them."""
    end = float(readings.max(initial=0.0))
    inside = np.unique([time for time in changes if _SAME * end < time < end])
    nearest = np.abs(inside[:, None] - readings).min(axis=1, initial=np.inf)
    return np.union1d(readings, inside[nearest > _SAME * end])


def middles(times: Array) -> Array:
    """Returns a time within each interval that ends at one of these times, and the last of them."""
    return (np.append(0.0, times) + np.append(times, times[-1:])) / 2


def course(kind: str, times: Array, values: Array, at: Array) -> list[Array]:
    """Returns the constants, of the intervals around `at`, of an input with these values: a held one, or the line u +
    slope (t - since) as u, slope and since. It is level before its first row and after its last."""
    k = np.searchsorted(times, at, side="right") - 1
    place = np.maximum(k, 0)
    if kind == "hold":
        return [values[place]]
    slopes = np.append(np.diff(values) / np.diff(times), 0.0)
    return [values[place], np.where(k < 0, 0.0, slopes[place]), times[place]]


def numbered_cases(numbers: Sequence[int]) -> int:
    """Counts the cases that a column numbers."""
    known = sorted(set(numbers))
    if known != list(range(1, len(known) + 1)):
        raise UserError(
            f"case={known[-1]}: cases are numbered 1, 2 and so on; there are {', '.join(map(str, known))}"
        )
    return len(known)


def agreed(
    name: str, column: Sequence[float], places: Sequence[tuple[float, ...]], remedy: str = ""
) -> dict[tuple[float, ...], float]:
    """Returns a column's value at each place in ascending order: a case, or a time of a case."""
    found: dict[tuple[float, ...], float] = {}
    for value, place in zip(column, places, strict=True):
        if found.setdefault(place, value) != value:
            where = ", ".join(
                f"{key}={number:g}" for key, number in zip(("case", "time"), place, strict=False)
            )
            raise UserError(
                f"{where}: {name} is {found[place]:g} in one row and {value:g} in another{remedy}"
            )
    return dict(sorted(found.items()))


def courses(columns: Mapping[str, Sequence[Any]], names: Collection[str]) -> list[dict[str, Array]]:
    """Reads the columns `time` and those of the inputs, of each case."""
    for name in ("time", *names):
        if not len(columns.get(name, ())):
            here = " ".join(f"measurement.columns.{one}=[...]" for one in ("time", *names))
            file = f"readings=FILE with columns time and {', '.join(names)}"
            raise UserError(f"measurement.columns: {name} is not known; give {file}, or {here}")
    arrays = {name: np.asarray(columns[name], dtype=float) for name in ("time", *names)}
    case = np.asarray(columns.get("case", np.ones(len(arrays["time"]))), dtype=int)
    numbers = range(1, numbered_cases(case.tolist()) + 1)
    found = [
        {name: column[case == number] for name, column in arrays.items()} for number in numbers
    ]
    for one in found:
        if one["time"][0] < 0 or (np.diff(one["time"]) <= 0).any():
            raise UserError("columns.time: give ascending numbers from 0 on in each case")
    return found
