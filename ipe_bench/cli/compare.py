"""`ipe-bench compare A [B]`: whether the second is better or worse than the first, trial by trial."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from annotated_types import Gt, Lt

from ipe_bench.basics.errors import UserError
from ipe_bench.cli import NAMES, places_and_keys, print_problems, say, show

KEYS = {
    "first": str,
    "second": str,
    "alpha": Annotated[float, Gt(0), Lt(1)],
    "anytime": bool,
    "fail_on": NAMES,
    "power": float,
    "difference": float,
    "output": str,
}


def main(arguments: Sequence[str]) -> int:
    """Prints the table; exit code 1 where the second is worse, or lacks what was asked for."""
    folders, keys = places_and_keys("compare", arguments, KEYS)
    if not 1 <= len(folders) <= 2:
        raise UserError("compare: name one or two folders of results, such as outputs/before outputs/after")
    from ipe_bench.api import compare
    from ipe_bench.report.questions import comparison_parts

    frame = compare(*folders, **keys)
    show(comparison_parts(frame, keys.get("alpha", 0.05)))
    print_problems([*frame.attrs["problems"], *frame.attrs["stale"], *frame.attrs["notes"]])
    if "output" in keys:
        say(f"\nTable   {Path(keys['output']) / 'comparison.csv'}")
        say(f"Page    {Path(keys['output']) / 'comparison.html'}")
    say(*(f"worse: {line}" for line in frame.attrs["worse"]))
    return 1 if frame.attrs["worse"] or frame.attrs["problems"] else 0
