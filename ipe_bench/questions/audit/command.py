"""Describes the command `ipe-bench audit`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ipe_bench.basics.errors import UserError
from ipe_bench.questions.question import Answered, Question

_MORE = """
  ipe-bench audit runs.csv
  ipe-bench audit runs.parquet output=outputs/audit   audit.csv and audit.html

A row per run, with columns NAME_true and NAME (or NAME_error), NAME_std (or
NAME_var), and cov_A_B where there are any; or long: run, parameter, true,
estimate, std. The column run groups rows of one run.
"""


def answer(files: Sequence[str], output: str | None = None) -> Answered:
    """Returns whether reported covariances describe the errors; exit code 1 if there is evidence
    that they do not."""
    from ipe_bench.questions.audit.answer import audited

    if len(files) != 1:
        raise UserError(
            "audit: name one table of truths, estimates and deviations, such as runs.csv"
        )
    found = audited(files[0], output)
    lines = []
    if output is not None:
        lines = [f"\nTable   {output}/audit.csv", f"Page    {output}/audit.html"]
    return Answered(found.parts(), 1 if found.scale.wrong else 0, lines=lines)


def options() -> Mapping[str, Any]:
    """Returns the types of its options."""
    return {"output": str}


QUESTION = Question(
    codes="0 no evidence that the covariance is wrong; 1 it is too small or too large",
    more=_MORE,
    argument=("FILE", "a table of truths, estimates and reported covariances"),
    run=answer,
    options=options,
)
