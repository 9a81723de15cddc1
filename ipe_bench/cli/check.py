"""`ipe-bench check PLUGIN`: whether a plugin keeps the promises that every component makes."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import redirect_stdout
from pathlib import Path

from ipe_bench.api import check
from ipe_bench.basics.errors import UserError
from ipe_bench.cli import print_problems, say
from ipe_bench.plugins import discovery as plugins
from ipe_bench.plugins.conformance import Finding


def main(folders: Sequence[str]) -> int:
    """Checks every option of the plugins in the given folders; exit code 1 where a check fails."""
    if not folders:
        raise UserError("check: name the folder of a plugin, such as plugins/my_plugin")
    for folder in folders:
        plugins.options_in(Path(folder))  # a mistake in the second is said before the first is checked
    print_problems(plugins.take_problems())
    failed = 0
    for folder in folders:
        findings = [*check(folder), *_check_experiments(folder)]
        for one in findings:
            complaint = f" -- {one.complaint}" if one.complaint else ""
            say(f"{'FAILED' if complaint else 'ok':7}{one.component}: {one.check}{complaint}")
        wrong = sum(bool(finding.complaint) for finding in findings)
        say(f"{folder}: {f'{wrong} of {len(findings)} checks failed' if wrong else 'all checks passed'}")
        failed += wrong
    return 1 if failed else 0


def _check_experiments(folder: str) -> Iterator[Finding]:
    """Whether each experiment of the plugin asks for what there is."""
    from ipe_bench.cli.run import main as run

    for option in plugins.options_in(Path(folder)):
        if option.group == "experiment" and option.fault is None:
            complaint = ""
            with tempfile.TemporaryDirectory(prefix="ipe-bench-") as output, redirect_stdout(io.StringIO()):
                try:
                    run([f"+experiment={option.name}", f"output={output}/out", "--dry-run"])
                except UserError as error:
                    complaint = str(error)
            yield Finding(f"experiment={option.name}", "Asks for what there is", complaint)
