"""Computes values and slopes of `eighty` and `forty` with mpmath, to 40 digits, and stores them:
python tests/functions/truths.py."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import eighty
import forty
import mpmath as mp  # pyright: ignore[reportMissingImports]

STEP = mp.mpf(10) ** -15


def moved(ref: Any, state: list[Any], i: int, j: int, by: Any) -> Any:
    there = list(state)
    there[j] += by
    return ref(*there)[i]


def slope(ref: Any, state: list[Any], i: int, j: int) -> float | None:
    """The slope, or None where there is none."""
    try:
        up = (moved(ref, state, i, j, STEP) - moved(ref, state, i, j, 0)) / STEP
        down = (moved(ref, state, i, j, 0) - moved(ref, state, i, j, -STEP)) / STEP
    except (ZeroDivisionError, ValueError, TypeError):
        return None
    if abs(up - down) > 1e-9 * (1 + abs(up)) or abs(up) > 1e6:
        return None
    return float(f"{float((up + down) / 2):.12g}")


def truth(ref: Any, state: Any) -> Any:
    """Values and slopes at a state, or None where it has no values."""
    state = [mp.mpf(float(v)) for v in state]
    try:
        value = [float(v) for v in ref(*state)]
    except (ZeroDivisionError, ValueError, TypeError):
        return None
    return value, [[slope(ref, state, i, j) for j in range(2)] for i in range(len(value))]


if __name__ == "__main__":
    mp.mp.dps = 40
    found = {}
    for cases in (eighty, forty):
        for name, case in cases.CASES.items():
            states = case[4] if len(case) > 4 and case[4] else forty.STATES
            found[f"{cases.__name__}.{name}"] = [truth(case[1], state) for state in states]
    path = Path(__file__).with_name("truths.json")
    path.write_text(json.dumps(found, separators=(",", ":")).replace('],"', '],\n"') + "\n")
