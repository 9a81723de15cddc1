"""`ipe-bench design`: what readings will say before they are taken, and which to take instead."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from ipe_bench.api import design
from ipe_bench.basics.errors import UserError
from ipe_bench.cli import show
from ipe_bench.cli.single import OF_FILES, OF_MANY_TRIALS, say_files, single
from ipe_bench.plugins.extensions import richer_models
from ipe_bench.runs.provenance import describe
from ipe_bench.trials.design import Criterion

_OF_RUNS = (*OF_MANY_TRIALS, "figures", "trials", "solver", "baseline", "estimators")


def main(arguments: Sequence[str], by: Sequence[str] | None, readings: int | None, criterion: Criterion) -> int:
    """Prints tables and writes files; exit code 1 where the readings do not determine every parameter."""
    if any(word.lstrip("+").startswith("readings=") for word in arguments):
        raise UserError("readings: is for `ipe-bench estimate`; the number to choose is --readings NUMBER")
    asked = single("design", arguments, run=_OF_RUNS, estimate=OF_FILES)
    scenario = asked.spec.scenario
    if scenario.noise.real:
        raise UserError("noise=certified: a design is of readings that are still to be taken; choose another noise")
    errors = richer_models(scenario)
    found = design(scenario, by=by, readings=readings, criterion=criterion, errors=errors)

    from ipe_bench.report.questions import READINGS, design_parts, write_design

    command = {
        "scenario": describe(dataclasses.replace(scenario, truth=None)),
        "errors": [describe(error) for error in errors],
        "by": None if by is None else list(by),
        "readings": readings,
        "criterion": criterion,
    }
    folder = asked.folder("design", command, (READINGS,))
    files = write_design(folder, asked.measurement, found)
    show(design_parts(asked.measurement, found))
    say_files(files)
    return 0 if found.observability.observable else 1
