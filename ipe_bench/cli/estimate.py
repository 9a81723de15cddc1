"""Defines `ipe-bench estimate`, on readings from a file: of constants, or of states that move."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ipe_bench.basics.machine import library_versions
from ipe_bench.cli import say_files, show
from ipe_bench.cli import words as w
from ipe_bench.cli.keys import of
from ipe_bench.cli.single import Single, single
from ipe_bench.plugins import standard
from ipe_bench.runs.provenance import describe, fingerprint
from ipe_bench.states.base import StateModel


def estimate_command(arguments: Sequence[str]) -> int:
    """Estimates with every chosen estimator, prints tables and writes files; returns 1 unless every
    answer passes."""
    asked = single(
        "estimate", arguments, standard_words(arguments), run=(*of("run", "trials"), w.TRUTH)
    )
    if asked.spec.state_model is not None:
        return _track(asked, asked.spec.state_model)
    from ipe_bench.report.page import answer as page

    question = asked.spec.question(asked.words.keys).checked()
    command = {
        **_of_files(asked),
        "scenario": describe(question.scenario),
        "prior": question.has_prior,
        "estimators": asked.estimators,
    }
    parts = [question.scenario, *question.estimators.values()]
    provenance = _provenance(asked, question.found.files, parts)

    def answers() -> list[page.Answer]:
        return [page.Answer.to(question, asked.title, "lines")]

    return _answered(asked, page, command, provenance, answers)


def standard_words(arguments: Sequence[str]) -> list[str]:
    """Returns the words that choose estimators and trackers where no argument does."""
    of_filters = any(word.lstrip("+").startswith(("find=", "gate=")) for word in arguments)
    choice = standard.OF_ESTIMATE | (standard.OF_FILTERS if of_filters else {})
    return [f"{group}=[{','.join(names)}]" for group, names in choice.items()]


def _track(asked: Single, model: StateModel) -> int:
    """Tracks the states by every chosen tracker; exit code 1 unless every track passes."""
    from ipe_bench.report.page import log as page

    question = asked.log_question(asked.spec.readings, asked.spec.find or ())
    command = {
        **_of_files(asked),
        "find": list(question.find),
        "model": describe(model),
        "trackers": asked.estimators,
    }
    files = [log.file for log in question.logs if log.file]
    parts = [log.model for log in question.logs]
    provenance = _provenance(asked, files, [*parts, *question.trackers.values()])
    return _answered(asked, page, command, provenance, lambda: page.LogAnswer.to(question, "lines"))


def _of_files(asked: Single) -> dict[str, Any]:
    """Returns what a command asks of its files, by which it is told from others: not what the files
    hold today."""
    spec = asked.spec
    given = spec.readings
    names = [given] if isinstance(given, str) else given
    files = None if names is None else [str(Path(name).resolve()) for name in names]
    of_files: dict[str, Any] = {"readings": files}
    if spec.ignored:
        of_files["left_out"] = list(spec.ignored)
    if spec.gate is not None:
        of_files["gate"] = spec.gate
    return of_files


def _answered(
    asked: Single,
    page: Any,
    command: Mapping[str, Any],
    provenance: Mapping[str, Any],
    answers: Callable[[], Sequence[Any]],
) -> int:
    """Answers in the folder of a command, prints tables and writes the files of a `page`; returns
    the exit code."""
    with asked.folder(page.NAME, command, page.FILES) as folder:
        found = answers()
        stored = page.store(folder, found, command, provenance)
    files = [stored]
    for answer in found:  # before what takes longest, so that who stops there has the numbers
        show(answer.parts())
    for answer in found:
        drawn = asked.spec.figures != "none"
        files += page.write_page(folder, answer, provenance, figures=drawn)
    say_files(files)
    return 0 if all(answer.passes for answer in found) else 1


def _provenance(
    asked: Single, files: Sequence[tuple[str, str]], parts: Sequence[Any]
) -> dict[str, Any]:
    return {
        "measurement": asked.measurement,
        "config": asked.config,
        "written": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "readings": [{"file": file, "sha256": digest} for file, digest in files] or None,
        "libraries": library_versions(),
        **fingerprint(parts),
    }
