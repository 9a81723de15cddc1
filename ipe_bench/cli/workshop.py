"""Defines the commands of plugin authors: check and new."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import ipe_bench as ib
from ipe_bench.basics.errors import UserError
from ipe_bench.cli import print_problems, say
from ipe_bench.cli.main import main
from ipe_bench.plugins import discovery as plugins
from ipe_bench.workshop.ci import write_ci
from ipe_bench.workshop.new import new
from ipe_bench.workshop.skill import write_skill

if TYPE_CHECKING:
    from ipe_bench.workshop.conformance import Finding


def check_command(words: Sequence[str]) -> int:
    """Checks every option of the plugins in the given folders, and what the keys choose; exit code
    1 if any fails."""
    keys = [word for word in words if "=" in word and not Path(word).is_dir()]
    folders = [word for word in words if word not in keys]
    if not words:
        raise UserError("check: name the folder of a plugin, such as plugins/my_plugin")
    for folder in folders:
        # A mistake in the second is said before the first is checked.
        plugins.options_in(Path(folder))
    print_problems(plugins.take_problems())
    failed = 0
    named = [*folders, " ".join(keys)] if keys else folders
    for folder in named:
        findings = (
            [*ib.check(folder), *_check_experiments(folder)]
            if folder in folders
            else _check_chosen(keys)
        )
        for one in findings:
            outcome = "FAILED" if one.complaint else "-" if one.note else "ok"
            reason = one.complaint or one.note
            said = f" -- {reason}" if reason else ""
            say(f"{outcome:7}{one.component}: {one.check}{said}")
        wrong = sum(bool(finding.complaint) for finding in findings)
        verdict = f"{wrong} of {len(findings)} checks failed" if wrong else "all checks passed"
        say(f"{folder}: {verdict}")
        failed += wrong
    return 1 if failed else 0


def _check_chosen(words: Sequence[str]) -> list[Finding]:
    from ipe_bench.cli.single import single
    from ipe_bench.cli.spec import PARTS
    from ipe_bench.workshop.conformance import check_component

    asked = single("check", words)
    parts = {key: getattr(asked.spec, key) for key in PARTS if key in asked.words.keys}
    if not set(plugins.PACKAGES).isdisjoint(asked.words.keys):
        parts |= asked.spec.estimators
    return [finding for name, part in parts.items() for finding in check_component(name, part)]


def _check_experiments(folder: str) -> Iterator[Finding]:
    """Checks that each experiment of the plugin asks for existing options."""
    from ipe_bench.cli import words as w
    from ipe_bench.cli.session import jobs_of, session
    from ipe_bench.runs.run import validate
    from ipe_bench.workshop.conformance import Finding

    for option in plugins.options_in(Path(folder)):
        if option.group == "experiment" and option.fault is None:
            complaint = ""
            try:
                with session():
                    jobs = jobs_of(
                        w.read("run", [f"+experiment={option.name}"]), multirun=False
                    ).specs
                for job in jobs:
                    validate([job.scenario], job.estimators, job.count, job.block_size)
            except UserError as error:
                complaint = str(error)
            yield Finding(f"experiment={option.name}", "Asks for what there is", complaint)


def new_command(kind: str, name: str | None, language: str | None = None) -> int:
    """Writes plugins/NAME in the working folder, or the files of a model, of a skill or of a guard
    in CI."""
    if kind == "ci" and name is None:
        print(write_ci())
        return 0
    if kind == "ci":
        raise UserError(f"new ci: takes no name; leave out {name}")
    if name is None:
        raise UserError("new: the following arguments are required: NAME")
    if language is not None and kind == "skill":
        raise UserError(f"--language={language}: {kind} has no languages; leave it out")
    if kind == "skill":
        written = write_skill(Path(name), main)
        print(f"{name} is ready: {', '.join(path.name for path in written)}")
        return 0
    print(new(kind, name, language))
    return 0
