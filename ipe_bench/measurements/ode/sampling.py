"""When the readings of a differential equation were taken: the times, outputs and cases of a file, row by row."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from ipe_bench.basics.errors import UserError, unknown
from ipe_bench.measurements.base import Input, Measurement, SubsetModel


def time_heading(unit: str) -> str:
    return f"time [{unit}]" if unit else "time"


def inputs(time_unit: str, outputs: Sequence[str], cases: int) -> tuple[Input, ...]:
    """The columns that say when and what a reading is; that of the output or the case may be absent where there is one
    only."""
    return (
        Input("case", int, label=True, default=1 if cases == 1 else None),
        Input(time_heading(time_unit)),
        Input("output", str, label=True, default=outputs[0] if len(outputs) == 1 else None),
    )


def cases(numbers: Sequence[int]) -> int:
    """How many cases a file has, by the column that numbers them."""
    known = sorted(set(numbers))
    if known != list(range(1, len(known) + 1)):
        raise UserError(f"case={known[-1]}: cases are numbered 1, 2 and so on; there are {', '.join(map(str, known))}")
    return len(known)


def of_cases(name: str, values: Sequence[float], numbers: Sequence[int], count: int) -> tuple[float, ...]:
    """What a constant is in each of the cases, by the columns of a file: one number in all rows of a case."""
    found: dict[int, float] = {}
    for value, case in zip(values, numbers, strict=True):
        if found.setdefault(case, value) != value:
            remedy = "" if count > 1 else "; number the cases in a column case"
            raise UserError(f"case={case}: {name} is {found[case]:g} in one row and {value:g} in another{remedy}")
    return tuple(found[case] for case in range(1, count + 1))


def sampled(
    columns: Mapping[str, Sequence[Any]],
    outputs: Sequence[str],
    cases: int,
    at: Callable[[tuple[float, ...]], Measurement],
) -> Measurement:
    """The model read as in a file, in the order of its rows; `at` is the model with given ascending times."""
    heading = next(name for name in columns if name.split(" [")[0] == "time")
    rows = list(zip(columns["case"], columns[heading], columns["output"], strict=True))
    for case, time, output in rows:
        if output not in outputs:
            raise UserError(f"output={output}: {unknown(str(output), outputs, 'output')}")
        if not 1 <= case <= cases:
            raise UserError(f"case={case}: there are {cases} cases")
        if time < 0:
            raise UserError(f"{heading}={time}: comes before the start, which is at 0")
    if len(set(rows)) < len(rows):
        case, time, output = next(row for row in rows if rows.count(row) > 1)
        raise UserError(f"case={case}, {heading}={time}, output={output} stands there twice; keep one of them")
    times = tuple(sorted({float(time) for _, time, _ in rows}))
    whole, place = at(times), {time: k for k, time in enumerate(times)}
    kept = tuple(
        ((case - 1) * len(times) + place[float(time)]) * len(outputs) + list(outputs).index(output)
        for case, time, output in rows
    )
    return whole if kept == tuple(range(whole.m)) else SubsetModel(whole, kept)
