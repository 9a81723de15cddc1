"""Runs the commands of `ipe_bench.questions`: the table of their names, composed scenarios, and
what they show."""

from __future__ import annotations

import importlib
import re
import shlex
from collections.abc import Sequence
from typing import NamedTuple

from ipe_bench.basics.errors import UserError
from ipe_bench.cli import places_and_keys, print_problems, say, say_files, show
from ipe_bench.cli.keys import OF_FILES, of
from ipe_bench.questions.question import Answered, Asked, Question


class Row(NamedTuple):
    """Says what the command line knows of a question before its folder is loaded."""

    line: str
    """Its line in `ipe-bench --help`."""
    without: tuple[str, ...] | None = None
    """Keys of a scenario that have no meaning for it; None if it takes folders or files in place of
    a scenario."""
    moving: str = ""
    """What serves in its place for states that move."""
    at_estimate: bool = False
    """Whether its truths lie about the estimate, where a user's own readings are given."""


QUESTIONS = {
    "design": Row(
        "predict how well each parameter will be determined, and choose readings",
        (*of("run", "figures", "estimators"), "trials"),
        "use `ipe-bench run state_model=NAME`, which computes the bounds of states",
        at_estimate=True,
    ),
    "posterior": Row(
        "sample the posterior of a few trials, and compare estimators with it",
        of("run", "figures"),
        "use `ipe-bench run state_model=NAME`, with tracker=[grid] for one state, or"
        " tracker=[bootstrap]",
    ),
    "compare": Row("compare two versions, settings or estimators on paired trials"),
    "audit": Row("test whether the covariance of another program describes its errors"),
}
"""A question is a folder of `ipe_bench.questions` and its row here."""


def question(name: str) -> Question:
    """Loads the record of a question's command."""
    return importlib.import_module(f"ipe_bench.questions.{name}.command").QUESTION


def question_command(name: str, arguments: Sequence[str], files: Sequence[str] = ()) -> int:
    """Answers a question, shows the answer, and returns the exit code; `files` are readings whose
    like is simulated."""
    row = QUESTIONS[name]
    record = question(name)
    known = record.options()
    if row.without is None:
        places, options = places_and_keys(name, arguments, known)
        return _shown(record.run(places, **options))
    own = [word for word in arguments if word.partition("=")[0] in known]
    others = [word for word in arguments if word not in own]
    for word in own:
        _refuse_file(name, word, others)
    options = places_and_keys(name, own, known)[1]
    return _shown(record.run(_asked(name, others, row, files), **options))


def _refuse_file(name: str, word: str, others: Sequence[str]) -> None:
    """Refuses a file where its key is a number in this command."""
    key, _, value = word.partition("=")
    if key in OF_FILES and re.search("[A-Za-z]", value):
        raise UserError(
            f"{word}: {key}= is the largest number of {key} in {name}, as in {key}=10; a file is"
            f" read by `ipe-bench {shlex.join(['estimate', *others, word])}`"
        )


def _asked(name: str, arguments: Sequence[str], row: Row, files: Sequence[str]) -> Asked:
    from ipe_bench.cli.own_data import like_these
    from ipe_bench.cli.single import single

    # The paper's iteration may end nowhere on a model that it was not made for.
    standard = ["solver=[auto]"] if files else []
    refused = {"run": row.without or (), "estimate": OF_FILES}
    found = single(name, arguments, standard, row.moving, **refused)
    trials = found.spec.count if "trials" in found.words.keys else None
    spec = found.spec
    if files:
        spec, lines = like_these(spec, files, found.words.keys, at_estimate=row.at_estimate)
        say(*lines)
        if found.words.standard_baselines:
            spec = spec.suited()
    about_estimate = bool(files) and row.at_estimate
    return Asked(found.title, spec.scenario, spec.estimators, trials, found.folder, about_estimate)


def _shown(found: Answered) -> int:
    show(found.parts)
    print_problems(found.problems)
    if found.files:
        say_files(found.files)
    say(*found.lines)
    return found.code
