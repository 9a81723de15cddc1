"""`ipe-bench check PLUGIN`: whether a plugin keeps the promises that every component makes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ipe_bench.api import check
from ipe_bench.basics.errors import UserError
from ipe_bench.cli import console
from ipe_bench.plugins.conformance import Finding
from ipe_bench.plugins.discovery import components_in


def main(folders: Sequence[str]) -> int:
    """Checks every option of the plugins in the given folders; exit code 1 where a check fails."""
    if not folders:
        raise UserError("check: name the folder of a plugin, such as plugins/my_plugin")
    for folder in folders:
        components_in(Path(folder))  # a mistake in the second is said before the first is checked
    return 1 if sum(_check_plugin(folder) for folder in folders) else 0


def _check_plugin(folder: str) -> int:
    out = console()
    findings = check(folder)
    for finding in findings:
        out.print(_line(finding), markup=False, soft_wrap=True)
    failed = sum(bool(finding.complaint) for finding in findings)
    out.print(f"{folder}: {failed} checks failed" if failed else f"{folder}: all checks passed", markup=False)
    return failed


def _line(finding: Finding) -> str:
    verdict = "FAILED" if finding.complaint else "ok"
    return f"{verdict:7}{finding.component}: {finding.check}" + (
        f" -- {finding.complaint}" if finding.complaint else ""
    )
