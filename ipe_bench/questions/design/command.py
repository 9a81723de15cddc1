"""Describes the command `ipe-bench design`."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from ipe_bench.basics.errors import UserError
from ipe_bench.questions.question import NAMES, Answered, Asked, Question

_MORE = """
  ipe-bench design oxygen.py oxygen.csv          with your readings' noise,
                                                 about your estimate
  ipe-bench design measurement=ranging error_scale=10
  ipe-bench design measurement=gins by=time          other times, equal cases
  ipe-bench design measurement=gins truth_measurement=gins_platform_misaligned

The analysis uses the model's Jacobians at its start, and at true parameters
drawn from the prior, without noise. Unmodelled errors come from
truth_measurement=, or from every option of measurement= that adds errors to the
model.

at=FOLDER           all at the estimate that `ipe-bench estimate` wrote there
by=COLUMN           choose by this column of the readings; by=[A,B] by several
readings=NUMBER     largest number of readings (today's)
criterion=D         minimise the mean squared bound (A, the default) or the
                    volume of the ellipsoid (D)
output=DIR          folder of the files
"""


def answer(asked: Asked, at: str | None = None, **given: Any) -> Answered:
    """Returns the tables of a design, whose files are written; exit code 1 where a parameter is not
    determined."""
    from ipe_bench.plugins.extensions import richer_models
    from ipe_bench.questions.design.answer import READINGS, design_parts, designed, write_design
    from ipe_bench.runs.provenance import describe

    scenario = asked.scenario
    if scenario.noise.real:
        raise UserError("noise=certified: design plans future readings; choose another noise")
    errors = richer_models(scenario)
    point = None if at is None else _estimates(at)
    chosen = {"by": None, "readings": None, "criterion": "A", **given}
    identity = {
        "scenario": describe(dataclasses.replace(scenario, truth=None)),
        "errors": [describe(error) for error in errors],
        "at": point,
        **chosen,
    }
    with asked.folder("design", identity, (READINGS,)) as folder:
        found = designed(scenario, errors=errors, at=point, **chosen)
        found = dataclasses.replace(found, about_estimate=asked.about_estimate)
        files = write_design(folder, asked.title, found)
    code = 0 if found.observability.observable else 1
    return Answered(design_parts(asked.title, found), code, files=files)


def _estimates(folder: str) -> dict[str, float]:
    """Returns the estimates, by name, of the estimator that an answer examined, and what it held
    fixed."""
    from ipe_bench.report.page.answer import NAME

    path = Path(folder, f"{NAME}.json")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        examined = content["examination"]
        estimates = None if examined is None else {**content["fixed"], **examined["estimates"]}
    except (OSError, ValueError, KeyError, TypeError):
        raise UserError(
            f"at={folder}: has no {NAME}.json of an answer; give a folder that `ipe-bench estimate`"
            " wrote to"
        ) from None
    if estimates is None:
        raise UserError(f"at={folder}: no estimate there passes; design at the start, without at=")
    return estimates


def options() -> Mapping[str, Any]:
    """Returns the types of its options."""
    from ipe_bench.basics.options import Count

    return {"at": str, "by": NAMES, "readings": Count, "criterion": Literal["A", "D"]}


QUESTION = Question(
    codes="0 the readings determine every parameter; 1 they do not",
    more=_MORE,
    argument=("KEY=VALUE", "the scenario, as for `ipe-bench run`"),
    run=answer,
    options=options,
)
