"""`ipe-bench compare A [B]`: whether the second is better or worse than the first, trial by trial."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ipe_bench.basics.errors import UserError
from ipe_bench.cli import given_keys, print_problems, say, show

KEYS = ("first", "second", "alpha", "anytime", "fail_on", "output")


def main(arguments: Sequence[str]) -> int:
    """Prints the table; exit code 1 where the second is worse, or lacks what was asked for."""
    folders = [a for a in arguments if "=" not in a or Path(a).is_dir()]
    given = given_keys("compare", [a for a in arguments if a not in folders], KEYS)
    keys = {key: _value(key, value) for key, value in given.items()}
    if not 1 <= len(folders) <= 2:
        raise UserError("compare: name one or two folders of results, such as outputs/before outputs/after")
    from ipe_bench.api import compare
    from ipe_bench.report.comparison import contents

    frame = compare(*folders, **keys)
    show(contents(frame, keys.get("alpha", 0.05)))
    print_problems([*frame.attrs["problems"], *frame.attrs["stale"], *frame.attrs["notes"]])
    if "output" in keys:
        say(f"\nTable   {Path(keys['output']) / 'comparison.csv'}")
        say(f"Page    {Path(keys['output']) / 'comparison.html'}")
    say(*(f"worse: {line}" for line in frame.attrs["worse"]))
    return 1 if frame.attrs["worse"] or frame.attrs["problems"] else 0


def _value(key: str, value: str) -> Any:
    if key == "alpha":
        try:
            return float(value)
        except ValueError:
            raise UserError(f"alpha={value}: give a number between 0 and 1") from None
    if key == "anytime":
        if value not in ("true", "false"):
            raise UserError(f"anytime={value}: give true or false")
        return value == "true"
    return tuple(value.strip("[]").split(",")) if key == "fail_on" else value
