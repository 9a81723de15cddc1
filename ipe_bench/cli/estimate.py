"""`ipe-bench estimate`: parameters from a file of real readings."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from typing import Any

from ipe_bench.basics.machine import library_versions
from ipe_bench.cli import show
from ipe_bench.cli.single import OF_MANY_TRIALS, say_files, single
from ipe_bench.real.estimation import Opened
from ipe_bench.runs.provenance import describe, fingerprint

STANDARD_ESTIMATORS = ("solver=[auto]", "baseline=[linear_lse,levenberg_marquardt]")
"""Unless others are chosen: the one that chooses its way by itself, and two that it can be held against."""
_OF_RUNS = (*OF_MANY_TRIALS, "trials", "seed", "truth_measurement")


def main(arguments: Sequence[str]) -> int:
    """Estimates with every chosen estimator, prints tables and writes files; exit code 1 where none is an answer."""
    asked = single("estimate", arguments, STANDARD_ESTIMATORS, run=_OF_RUNS)
    opened = asked.spec.question(asked.words.keys).opened()

    from ipe_bench.report.answer import FILES, NAME, Answer, contents, write_answer

    command = _command(opened)
    folder = asked.folder(NAME, command, FILES)
    answer = Answer.to(opened, asked.measurement)
    written = {"measurement": asked.measurement, "config": asked.config, **_provenance(opened)}
    files = write_answer(folder, answer, command, written, figures=asked.spec.figures != "none")
    show(contents(answer))
    say_files(files)
    return 0 if answer.passes else 1


def _command(opened: Opened) -> dict[str, Any]:
    """What tells this command from others: what was asked for, whatever the file holds today."""
    question = opened.question
    files = question.readings
    return {
        "readings": [str(path.resolve()) for path in files] if isinstance(files, tuple) else None,
        "scenario": describe(opened.scenario),
        "prior": question.has_prior,
        "estimators": {label: describe(estimator) for label, estimator in question.estimators.items()},
        **({"left_out": describe(question.left_out)} if question.left_out else {}),
    }


def _provenance(opened: Opened) -> dict[str, Any]:
    return {
        "written": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "readings": [{"file": file, "sha256": digest} for file, digest in opened.readings.files] or None,
        "libraries": library_versions(),
        **fingerprint([opened.scenario, *opened.question.estimators.values()]),
    }
