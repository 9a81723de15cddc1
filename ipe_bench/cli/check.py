"""`ipe-bench check PLUGIN`: whether a plugin keeps the promises that every component makes."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import redirect_stdout
from pathlib import Path

from ipe_bench.api import check
from ipe_bench.basics.errors import UserError
from ipe_bench.cli import console, print_problems
from ipe_bench.plugins import discovery as plugins
from ipe_bench.plugins.conformance import Finding


def main(folders: Sequence[str]) -> int:
    """Checks every option of the plugins in the given folders; exit code 1 where a check fails."""
    if not folders:
        raise UserError("check: name the folder of a plugin, such as plugins/my_plugin")
    for folder in folders:
        plugins.options_in(Path(folder))  # a mistake in the second is said before the first is checked
    print_problems(plugins.take_problems())
    return 1 if sum(_check_plugin(folder) for folder in folders) else 0


def _check_plugin(folder: str) -> int:
    out = console()
    findings = [*check(folder), *_check_experiments(folder)]
    for finding in findings:
        out.print(_line(finding), markup=False, soft_wrap=True)
    failed = sum(bool(finding.complaint) for finding in findings)
    verdict = f"{failed} of {len(findings)} checks failed" if failed else "all checks passed"
    out.print(f"{folder}: {verdict}", markup=False)
    return failed


def _check_experiments(folder: str) -> Iterator[Finding]:
    """Whether each experiment of the plugin asks for what there is."""
    from ipe_bench.cli.run import main as run

    for option in plugins.options_in(Path(folder)):
        if option.group == "experiment" and option.fault is None:
            name, what = f"experiment={option.name}", "Asks for what there is"
            with tempfile.TemporaryDirectory(prefix="ipe-bench-") as output, redirect_stdout(io.StringIO()):
                try:
                    run([f"+experiment={option.name}", f"output={output}/out", "--dry-run"])
                except UserError as error:
                    yield Finding(name, what, str(error))
                else:
                    yield Finding(name, what)


def _line(finding: Finding) -> str:
    verdict = "FAILED" if finding.complaint else "ok"
    return f"{verdict:7}{finding.component}: {finding.check}" + (
        f" -- {finding.complaint}" if finding.complaint else ""
    )
