"""Describes the command `ipe-bench compare`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ipe_bench.basics.errors import UserError
from ipe_bench.questions.question import NAMES, Answered, Question

_MORE = """
Stored results are compared, so run both first. Trials are paired.

  ipe-bench compare outputs/before outputs/after     two versions or settings
  ipe-bench compare outputs/a outputs/b first=newton second=my_solver
  ipe-bench compare outputs/a first=newton second=ekf    in one folder

alpha=0.05          significance level: probability of any finding if there is
                    no difference
anytime=true        test by e-values, which remain valid at every look while
                    trials are added
fail_on=success,error  what must not be worse: success, error, cost, honesty
                    (NEES farther from 1), bias
margin.cost=0.1     the change that matters: success 0.01, error 0.02, cost
                    0.05, honesty 0.05, bias 0.1 deviations
complete=true       fail if the second lacks estimators, scenarios, trials or a
                    covariance
power=0.9           compute the number of trials that find a difference of
                    success, such as difference=0.05, with this power
output=DIR          write comparison.csv and comparison.html there
"""


def answer(folders: Sequence[str], **given: Any) -> Answered:
    """Returns the tables; exit code 1 where the second is worse, or lacks what was asked for."""
    from ipe_bench.questions.compare.answer import compared_folders

    if not 1 <= len(folders) <= 2:
        raise UserError(
            "compare: name one or two folders of results, such as outputs/before outputs/after"
        )
    named = [key for key in given if key.startswith("margin.")]
    margins = {key.removeprefix("margin."): given.pop(key) for key in named}
    first, *others = ([Path(folder)] for folder in folders)
    frame = compared_folders(first, *others, margins=margins, **given)
    told = frame.attrs
    lines = [f"worse: {line}" for line in told["worse"]]
    if "output" in given:
        output = given["output"]
        lines = [f"\nTable   {output}/comparison.csv", f"Page    {output}/comparison.html", *lines]
    problems = [*told["problems"], *told["stale"], *told["notes"]]
    return Answered(
        frame.parts(), 1 if told["worse"] or told["problems"] else 0, problems, lines=lines
    )


def options() -> Mapping[str, Any]:
    """Returns the types of its options."""
    from ipe_bench.questions.compare.maths import MARGINS

    return {
        "first": str,
        "second": str,
        "alpha": float,
        "anytime": bool,
        "fail_on": NAMES,
        "power": float,
        "difference": float,
        "output": str,
        "complete": bool,
        **{f"margin.{name}": float for name in MARGINS},
    }


QUESTION = Question(
    codes="0 not worse; 1 the second is worse, or something is missing",
    more=_MORE,
    argument=("DIR", "one or two folders of results"),
    run=answer,
    options=options,
)
