"""`ipe-bench audit FILE`: whether the covariance that another program reports describes its errors."""

from __future__ import annotations

from collections.abc import Sequence

from ipe_bench.basics.errors import UserError
from ipe_bench.cli import places_and_keys, say, show


def main(arguments: Sequence[str]) -> int:
    """Prints what was found; exit code 1 if the covariance is surely wrong."""
    files, given = places_and_keys("audit", arguments, {"output": str})
    if len(files) != 1:
        raise UserError("audit: name one table of truths, estimates and deviations, such as runs.csv")
    from ipe_bench.api import audit
    from ipe_bench.report.questions import audit_parts

    found = audit(files[0], output=given.get("output"))
    show(audit_parts(found))
    if "output" in given:
        say(f"\nTable   {given['output']}/audit.csv", f"Page    {given['output']}/audit.html")
    return 1 if found.scale.wrong else 0
