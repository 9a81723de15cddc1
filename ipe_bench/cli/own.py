"""Defines `ipe-bench run MODEL FILE`, which answers which estimator to take for data like a user's
own."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from ipe_bench.basics.errors import UserError
from ipe_bench.cli import say_files, show
from ipe_bench.cli.keys import of
from ipe_bench.cli.own_data import question_on
from ipe_bench.cli.shorts import Short
from ipe_bench.cli.single import Single, single
from ipe_bench.cli.words import TRUTH
from ipe_bench.plugins import standard
from ipe_bench.questions.own.maths import Own
from ipe_bench.runs.provenance import describe

_TRIALS = 200
"""Data sets that are simulated unless trials= says otherwise."""
_LOGS = 100
"""Logs likewise."""
_MOST_READINGS = 4_000_000
"""Readings of all of them, which are held at once for each estimator: there are fewer of long data
sets."""
_MOST_EPOCHS = 200_000
"""Epochs of all logs, which take some ten seconds of a model with a few states: there are fewer of
long logs."""
_LONGEST = 50_000
"""Epochs of a log at most, of which the fewest logs take a minute."""
_FEWEST = 20
"""Fewest of either that say anything of shares."""
_REFUSED = "has no meaning with a model and readings of your own"
_WITHOUT_MEANING = (*of("run"), TRUTH, "find", "gate", "experiment")


def own_command(short: Short) -> int:
    """Simulates data like those in the files of a short form, prints which estimator to take, and
    writes files; returns 1 if none is to be taken."""
    flags = [word for word in short.words if word.startswith("-")]
    if flags:
        raise UserError(f"{flags[0]}: {_REFUSED}; leave it out")
    choice = [f"{group}=[{','.join(names)}]" for group, names in standard.OF_OWN.items()]
    asked = single("run", short.words, choice)
    asked.words.refuse(_WITHOUT_MEANING, _REFUSED)
    if asked.spec.figures != "none":
        # None are drawn: so only who wants some is told.
        asked.words.refuse(of("figures"), _REFUSED)
    trials = asked.spec.trials
    if trials is not None and trials < _FEWEST:
        raise UserError(f"trials={trials}: are too few to estimate shares; give at least {_FEWEST}")
    if asked.spec.state_model is None:
        found, folder = _of_constants(asked, short.readings)
    else:
        found, folder = _of_log(asked, short.readings)
    from ipe_bench.questions.own.answer import own_parts, takes_one, write_own

    with folder as place:
        files = write_own(place, asked.title, found)
    show(own_parts(asked.title, found))
    say_files(files)
    return 0 if takes_one(found) else 1


def _folder(
    asked: Single, trials: int, files: list[str], **identity: Any
) -> AbstractContextManager[Path]:
    from ipe_bench.questions.own.answer import NAME, TABLE

    readings = [str(Path(file).resolve()) for file in files]
    known = {"readings": readings, "trials": trials, "seed": asked.spec.seed, **identity}
    return asked.folder(NAME, known, (TABLE,))


def _of_constants(asked: Single, files: list[str]) -> tuple[Own, AbstractContextManager[Path]]:
    from ipe_bench.questions.own.maths import own

    spec = asked.spec
    question = question_on(spec, files, asked.words.keys)
    affordable = max(_FEWEST, _MOST_READINGS // question.found.model.m)
    trials = spec.trials or min(_TRIALS, affordable)
    folder = _folder(
        asked,
        trials,
        files,
        scenario=describe(question.scenario),
        prior=question.has_prior,
        estimators=asked.estimators,
    )
    return own(question, spec.estimators, trials, spec.seed, "lines"), folder


def _of_log(asked: Single, files: list[str]) -> tuple[Own, AbstractContextManager[Path]]:
    from ipe_bench.questions.own.tracks import own_log

    spec = asked.spec
    if len(files) > 1:
        raise UserError(f"readings=[{','.join(files)}]: are several logs; name one")
    (log,) = asked.log_question(files[0]).logs
    epochs = log.model.epochs
    if epochs > _LONGEST:
        raise UserError(
            f"{files[0]}: has {epochs} rows, and logs of at most {_LONGEST} are simulated; give a"
            " file with some of its rows"
        )
    trials = spec.trials or min(_LOGS, max(_FEWEST, _MOST_EPOCHS // epochs))
    folder = _folder(
        asked,
        trials,
        files,
        model=describe(log.model),
        trackers=asked.estimators,
    )
    return own_log(log, spec.estimators, trials, spec.seed, "lines"), folder
