"""Defines the commands on a single scenario, each with one folder of files: estimate, design and posterior."""

from __future__ import annotations

import dataclasses
import datetime
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import ipe_bench as ib
from ipe_bench.basics.errors import UserError
from ipe_bench.basics.machine import library_versions
from ipe_bench.cli import console, say, show
from ipe_bench.cli import words as w
from ipe_bench.cli.keys import OF_CONSTANTS, OF_FILES, OF_STATES, of
from ipe_bench.cli.session import composed, jobs_of, session
from ipe_bench.cli.spec import Spec
from ipe_bench.cli.words import Words
from ipe_bench.measurements import Nist
from ipe_bench.plugins.extensions import richer_models
from ipe_bench.report.table import Part
from ipe_bench.report.writer import reserve_output_folder
from ipe_bench.runs.provenance import describe, fingerprint
from ipe_bench.runs.run import validate
from ipe_bench.states.base import StateModel

if TYPE_CHECKING:
    from ipe_bench.questions.design.maths import Criterion

STANDARD_ESTIMATORS = ("solver=[auto]", "baseline=[linear_lse,levenberg_marquardt]")
"""Estimators of `estimate`: one that chooses its method itself, and two to compare it with."""
OF_CONSTANTS_ALONE = {
    "design": "the bounds of states are those of `ipe-bench run state_model=NAME`",
    "posterior": "use `ipe-bench run state_model=NAME`, with tracker=[grid] for one state, or tracker=[bootstrap]",
}
"""Commands on parameters that stand still, with what serves for states that move."""
_TRIALS, _MOST_TRIALS = 3, 100
"""Number of trials of `posterior`, by default and at most."""


@dataclass(frozen=True)
class Single:
    """Holds the request of a command."""

    command: str
    words: Words
    spec: Spec
    config: dict[str, Any]
    """Config as Hydra composed it."""

    @property
    def measurement(self) -> str:
        """Measurement model of the request."""
        spec, group = self.spec, "measurement" if self.spec.state_model is None else "state_model"
        model = spec.measurement if spec.state_model is None else spec.state_model
        if isinstance(model, Nist):
            return f"nist/{model.dataset.lower()}"
        return self.words.chosen(group) or model.name

    def folder(self, name: str, identity: Any, files: Sequence[str] = ()) -> Path:
        """Reserves the named folder, or one named after the command and the model, for a command that `identity` tells
        from others in NAME.json, and for its further `files`."""
        output, named = Path(self.spec.output), not {"name", "output"}.isdisjoint(self.words.keys)
        folder = output if named else output.with_name(f"{self.command}-{self.measurement.replace('/', '-')}")
        return reserve_output_folder(folder, name, identity, elsewhere=not named, files=files)


def single(command: str, arguments: Sequence[str], standard: Sequence[str] = (), **refused: Sequence[str]) -> Single:
    """Composes the one job that the arguments of a command ask for; `standard` are default words, and `refused` are
    keys without meaning for it, by whom they are for."""
    with session():
        words = w.read(command, arguments)
        for whose, keys in refused.items():
            words.refuse(keys, f"is for `ipe-bench {whose}`, and has no meaning in `ipe-bench {command}`")
        given = w.read(command, [one for one in standard if one.partition("=")[0] not in words.keys])
        jobs = jobs_of(Words(given.overrides + words.overrides), multirun=False)
        require_one_kind(words, jobs.specs[0])
        if command in OF_CONSTANTS_ALONE and (model := jobs.specs[0].state_model):
            raise UserError(
                f"state_model={model.name}: states move, and {command} is of constants; {OF_CONSTANTS_ALONE[command]}"
            )
        return Single(command, words, jobs.specs[0], composed(jobs.words))


def require_one_kind(words: Words, spec: Spec) -> None:
    """Refuses a tracker without a state model, and a state model together with a key of measurements, typed or from an
    experiment."""
    if spec.state_model is None:
        words.refuse((*OF_STATES[1:], "find"), "goes with state_model=NAME")
        return
    why = "is of a measurement, and state_model= chooses states that move"
    words.refuse(OF_CONSTANTS, why)
    for one in (one for one in words.overrides if one.key_or_group == "experiment"):
        config, without = composed(Words((one,))), composed(Words(()))
        if changed := [key for key in OF_CONSTANTS if config.get(key) != without.get(key)]:
            raise UserError(f"{w.said(one)}: sets {changed[0]}, which {why}; leave out one of them")


def _show(parts: Iterable[Part], files: Sequence[Path]) -> None:
    """Prints tables, and which files a command has written into its folder."""
    show(parts)
    say(f"\nIn {files[0].parent}:")
    console().print(", ".join(path.name for path in files))


def _described(estimators: Any) -> dict[str, Any]:
    return {label: describe(estimator) for label, estimator in estimators.items()}


def estimate_command(arguments: Sequence[str]) -> int:
    """Estimates with every chosen estimator, prints tables and writes files; returns 1 if no fit passes."""
    from ipe_bench.report.answer import FILES, NAME, Answer, write_answer
    from ipe_bench.report.progress import counting

    asked = single("estimate", arguments, STANDARD_ESTIMATORS, run=(*of("run", "trials"), w.TRUTH))
    if asked.spec.state_model is not None:
        return _track(asked, asked.spec.state_model)
    question = asked.spec.question(asked.words.keys).checked()
    files = question.readings
    command = {  # what was asked for, not what the file holds today
        "readings": [str(path.resolve()) for path in files] if isinstance(files, tuple) else None,
        "scenario": describe(question.scenario),
        "prior": question.has_prior,
        "estimators": _described(question.estimators),
        **({"left_out": list(question.ignored)} if question.ignored else {}),
    }
    folder = asked.folder(NAME, command, FILES)
    with counting("estimate", len(question.estimators), lines=True) as begin:
        answer = Answer.to(question, asked.measurement, begin)
    parts = [question.scenario, *question.estimators.values()]
    provenance = _provenance(asked, question.found.files, parts)
    files = write_answer(folder, answer, command, provenance, figures=asked.spec.figures != "none")
    _show(answer.parts(), files)
    return 0 if answer.passes else 1


def _track(asked: Single, model: StateModel) -> int:
    """Tracks the states by every chosen tracker, prints tables and writes files; exit code 1 where no track passes."""
    from ipe_bench.report.tracked import NAME, TABLE, write_tracks

    asked.words.refuse(("error_scale",), "is of simulated trials; give the state model another prior")
    given, trackers = asked.spec.readings, asked.spec.estimators
    find = asked.spec.find or ()
    answer = ib.estimate(model, given, trackers, ignore_columns=asked.spec.ignored, find=find, progress="lines")
    command = {"readings": given, "find": find, "model": describe(model), "trackers": _described(trackers)}
    files, parts = [answer.log.file] if answer.log.file else [], [answer.log.model, *trackers.values()]
    folder = asked.folder(NAME, command, [TABLE])
    _show(answer.parts(), write_tracks(folder, answer, command, _provenance(asked, files, parts)))
    return 0 if answer.passes else 1


def _provenance(asked: Single, files: Sequence[tuple[str, str]], parts: Sequence[Any]) -> dict[str, Any]:
    return {
        "measurement": asked.measurement,
        "config": asked.config,
        "written": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "readings": [{"file": file, "sha256": digest} for file, digest in files] or None,
        "libraries": library_versions(),
        **fingerprint(parts),
    }


def design_command(
    arguments: Sequence[str], by: Sequence[str] | None, readings: int | None, criterion: Criterion
) -> int:
    """Prints tables and writes files; exit code 1 where the readings do not determine every parameter."""
    from ipe_bench.questions.design.answer import READINGS, design_parts, write_design

    if any(word.lstrip("+").startswith("readings=") for word in arguments):
        raise UserError("readings: is for `ipe-bench estimate`; the number to choose is --readings NUMBER")
    asked = single("design", arguments, run=(*of("run", "figures", "estimators"), "trials"), estimate=OF_FILES)
    scenario = asked.spec.scenario
    if scenario.noise.real:
        raise UserError("noise=certified: a design is of readings that are still to be taken; choose another noise")
    errors = richer_models(scenario)
    found = ib.design(scenario, by=by, readings=readings, criterion=criterion, errors=errors)
    command = {
        "scenario": describe(dataclasses.replace(scenario, truth=None)),
        "errors": [describe(error) for error in errors],
        "by": None if by is None else list(by),
        "readings": readings,
        "criterion": criterion,
    }
    files = write_design(asked.folder("design", command, (READINGS,)), asked.measurement, found)
    _show(design_parts(asked.measurement, found), files)
    return 0 if found.observability.observable else 1


def posterior_command(arguments: Sequence[str], particles: int) -> int:
    """Samples, prints a table and writes files; returns 1 if the populations of a trial do not agree."""
    from ipe_bench.questions.posterior.answer import posterior_parts, write_posteriors

    asked = single("posterior", arguments, run=of("run", "figures"), estimate=OF_FILES)
    job, name, scenario = asked.spec, asked.measurement, asked.spec.scenario
    trials = job.count if "trials" in asked.words.keys else _TRIALS
    if trials > _MOST_TRIALS:
        raise UserError(f"trials={trials}: each takes up to a minute; give at most {_MOST_TRIALS}")
    if scenario.noise.real:
        raise UserError("noise=certified: has no prior to begin with; choose another noise and an error_scale")
    validate([scenario], job.estimators, trials)
    command = {
        "scenario": describe(scenario),
        "estimators": _described(job.estimators),
        "trials": trials,
        "particles": particles,
    }
    folder = asked.folder("posterior", command)

    def tell(trial: int) -> None:
        print(f"{name}: trial {trial + 1} of {trials}", file=sys.stderr, flush=True)

    found = ib.posterior(scenario, job.estimators, trials, particles=particles, watch=tell)
    title = f"{name}, {scenario.noise.name}, error scale {scenario.error_scale:g}"
    files = write_posteriors(folder, name, title, scenario.measurement, found)
    _show(posterior_parts(title, found), files)
    return 0 if all(one.posterior.settled for one in found) else 1
