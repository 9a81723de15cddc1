"""`ipe-bench estimate`: parameters from a file of real readings."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from typing import Any

from omegaconf import OmegaConf

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.machine import library_versions
from ipe_bench.cli import console, show
from ipe_bench.cli.single import compose_single
from ipe_bench.real.estimation import Opened
from ipe_bench.runs.provenance import describe, fingerprint

STANDARD_ESTIMATORS = ("solver=[auto]", "baseline=[linear_lse,levenberg_marquardt]")
"""Unless others are chosen: the one that chooses its way by itself, and two that it can be held against."""


def main(arguments: Sequence[str]) -> int:
    """Estimates with every chosen estimator, prints tables and writes files; exit code 1 where none is an answer."""
    single = compose_single("estimate", arguments, _refuse_keys_without_use, standard=STANDARD_ESTIMATORS)
    scaled = any(word.lstrip("+").startswith("error_scale=") for word in single.words)
    opened = single.job.question(scaled=scaled).opened()

    from ipe_bench.report.answer import FILES, RESULT, Answer, contents, write_fits
    from ipe_bench.report.folders import claim

    command = _command(opened)
    folder = claim(single.folder, command, elsewhere=not single.named, result=RESULT, files=FILES)
    answer = Answer.to(opened, single.measurement)
    config = OmegaConf.to_container(single.config, resolve=True)
    written = {"measurement": single.measurement, "config": config, **_provenance(opened)}
    files = write_fits(folder, answer, command, written, which=single.job.figures)
    show(contents(answer))
    out = console()
    out.print(f"\nIn {folder}:", markup=False, soft_wrap=True)
    out.print(", ".join(path.name for path in files), markup=False)
    return 0 if answer.passes else 1


_WITHOUT_USE = (
    "trials",
    "precision",
    "time_limit",
    "seed",
    "block_size",
    "formats",
    "execution",
    "truth_measurement",
    "write_readings",
)


def _refuse_keys_without_use(words: Sequence[str]) -> None:
    for word in words:
        key = word.lstrip("+~").partition("=")[0].replace("measurement@truth", "truth")
        if key.startswith(_WITHOUT_USE):
            raise UserError(f"{key}: is for `ipe-bench run`, and nothing in an estimate from readings; leave it out")


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
