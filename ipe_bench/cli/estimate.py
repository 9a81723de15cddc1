"""Defines `ipe-bench estimate`, on readings from a file: of constants, or of states that move."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
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
    """Estimates with every chosen estimator, prints tables and writes files; returns 1 if no fit
    passes."""
    from ipe_bench.report.page.answer import FILES, NAME, Answer, store, write_page

    asked = single(
        "estimate", arguments, standard_words(arguments), run=(*of("run", "trials"), w.TRUTH)
    )
    if asked.spec.state_model is not None:
        return _track(asked, asked.spec.state_model)
    question = asked.spec.question(asked.words.keys).checked()
    files = question.readings
    readings = [str(path.resolve()) for path in files] if isinstance(files, tuple) else None
    command: dict[str, Any] = {  # what was asked for, not what the file holds today
        "readings": readings,
        "scenario": describe(question.scenario),
        "prior": question.has_prior,
        "estimators": asked.estimators,
    }
    if question.ignored:
        command["left_out"] = list(question.ignored)
    parts = [question.scenario, *question.estimators.values()]
    provenance = _provenance(asked, question.found.files, parts)
    drawn = asked.spec.figures != "none"
    with asked.folder(NAME, command, FILES) as folder:
        answer = Answer.to(question, asked.title, "lines")
        stored = store(folder, answer, command, provenance)
    show(answer.parts())  # before what takes longest, so that who stops there has the numbers
    say_files([stored, *write_page(folder, answer, provenance, figures=drawn)])
    return 0 if answer.passes else 1


def standard_words(arguments: Sequence[str]) -> list[str]:
    """Returns the words that choose estimators and trackers where no argument does."""
    of_filters = any(word.startswith(("find=", "gate=")) for word in arguments)
    choice = standard.OF_ESTIMATE | (standard.OF_FILTERS if of_filters else {})
    return [f"{group}=[{','.join(names)}]" for group, names in choice.items()]


def _track(asked: Single, model: StateModel) -> int:
    """Tracks the states by every chosen tracker, prints tables and writes files; exit code 1 where
    no track passes."""
    from ipe_bench.report.page.log import NAME, TABLE, LogAnswer, store, write_page

    spec = asked.spec
    find = spec.find or ()
    question = asked.log_question(spec.readings, find)
    command: dict[str, Any] = {
        "readings": spec.readings,
        "find": find,
        "model": describe(model),
        "trackers": asked.estimators,
    }
    if spec.gate is not None:
        command["gate"] = spec.gate
    files = [log.file for log in question.logs if log.file]
    parts = [log.model for log in question.logs]
    provenance = _provenance(asked, files, [*parts, *question.trackers.values()])
    drawn = spec.figures != "none"
    with asked.folder(NAME, command, [TABLE]) as folder:
        answers = LogAnswer.to(question, "lines")
        stored = store(folder, answers, command, provenance)
    for answer in answers:
        show(answer.parts())
    pages = [write_page(folder, answer, provenance, figures=drawn) for answer in answers]
    say_files([stored, *(file for files in pages for file in files)])
    return 0 if all(answer.passes for answer in answers) else 1


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
