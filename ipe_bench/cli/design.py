"""`ipe-bench design`: what readings will say before they are taken, and which to take instead."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

from ipe_bench.api import design
from ipe_bench.basics.errors import UserError
from ipe_bench.cli import console, show
from ipe_bench.cli.single import OF_FILES, OF_MANY_TRIALS, single
from ipe_bench.cli.spec import Spec
from ipe_bench.measurements.base import Measurement
from ipe_bench.plugins import discovery as plugins
from ipe_bench.plugins.construct import construct
from ipe_bench.runs.provenance import describe
from ipe_bench.trials.design import Criterion

_OF_RUNS = (*OF_MANY_TRIALS, "figures", "trials", "solver", "baseline", "estimators")


def main(
    arguments: Sequence[str],
    by: Sequence[str] | None = None,
    readings: int | None = None,
    criterion: Criterion = "A",
) -> int:
    """Prints tables and writes files; exit code 1 where the readings do not determine every parameter."""
    if any(word.lstrip("+").startswith("readings=") for word in arguments):
        raise UserError("readings: is for `ipe-bench estimate`; the number to choose is --readings NUMBER")
    asked = single("design", arguments, run=_OF_RUNS, estimate=OF_FILES)
    scenario = dataclasses.replace(asked.spec.scenario, truth=None)
    if scenario.noise.real:
        raise UserError("noise=certified: a design is of readings that are still to be taken; choose another noise")
    errors = _errors(asked.spec)
    found = design(scenario, by=by, readings=readings, criterion=criterion, errors=errors)

    from ipe_bench.report.designs import FILES, RESULT, contents, write_design
    from ipe_bench.report.folders import claim

    command = {
        "scenario": describe(scenario),
        "errors": [describe(error) for error in errors],
        "by": None if by is None else list(by),
        "readings": readings,
        "criterion": criterion,
    }
    folder = claim(asked.folder, command, elsewhere=not asked.named, result=RESULT, files=FILES)
    files = write_design(folder, found, command, {"measurement": asked.measurement})
    show(contents(asked.measurement, found))
    console().print(f"In {folder}: {', '.join(path.name for path in files)}", markup=False, soft_wrap=True)
    return 0 if found.observability.observable else 1


def _errors(job: Spec) -> list[Measurement]:
    """The truth that was asked for; else every richer version of the model that there is an option of."""
    if job.scenario.truth is not None:
        if not job.scenario.truth.nuisance_deviation.any():
            raise UserError(
                f"truth_measurement={job.scenario.truth.name}: has no errors besides the parameters; leave it out, or "
                "choose a richer one"
            )
        return [job.scenario.truth]
    return list(_richer(job.scenario.measurement))


def _richer(model: Measurement) -> Iterator[Measurement]:
    """Options whose class derives from the model's and which have more errors, with the model's own options."""
    options: dict[str, Any] = {f.name: getattr(model, f.name) for f in dataclasses.fields(model) if f.init}  # type: ignore[arg-type]
    for option in plugins.options("measurement"):
        if option.fault is not None:
            continue
        try:
            other = construct(option.config, f"measurement={option.name}")
        except UserError:
            continue  # `ipe-bench list` tells of options that cannot be made
        if isinstance(other, type(model)) and type(other) is not type(model) and other.nuisance_deviation.any():
            yield dataclasses.replace(other, **options)  # type: ignore[type-var]
