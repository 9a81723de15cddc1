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
from ipe_bench.cli.single import single
from ipe_bench.cli.spec import PARTS
from ipe_bench.plugins import discovery as plugins
from ipe_bench.plugins.conformance import Finding, check_component


def main(words: Sequence[str]) -> int:
    """Checks every option of the plugins in the given folders, and what the keys choose; exit code 1 if any fails."""
    keys = [word for word in words if "=" in word and not Path(word).is_dir()]
    folders = [word for word in words if word not in keys]
    if not words:
        raise UserError("check: name the folder of a plugin, such as plugins/my_plugin")
    for folder in folders:
        plugins.options_in(Path(folder))  # a mistake in the second is said before the first is checked
    print_problems(plugins.take_problems())
    failed = 0
    for folder in [*folders, *([" ".join(keys)] if keys else [])]:
        findings = _check_chosen(keys) if folder not in folders else [*check(folder), *_check_experiments(folder)]
        for one in findings:
            complaint = f" -- {one.complaint}" if one.complaint else ""
            say(f"{'FAILED' if complaint else 'ok':7}{one.component}: {one.check}{complaint}")
        wrong = sum(bool(finding.complaint) for finding in findings)
        say(f"{folder}: {f'{wrong} of {len(findings)} checks failed' if wrong else 'all checks passed'}")
        failed += wrong
    return 1 if failed else 0


def _check_chosen(words: Sequence[str]) -> list[Finding]:
    """The findings on what these keys choose."""
    asked = single("check", words)
    parts = {key: getattr(asked.spec, key) for key in PARTS if key in asked.words.keys}
    if not set(plugins.PACKAGES).isdisjoint(asked.words.keys):
        parts |= asked.spec.estimators
    return [finding for name, part in parts.items() for finding in check_component(name, part)]


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
