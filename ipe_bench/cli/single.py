"""Composes the one scenario that a command is about, with one folder of files."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ipe_bench.basics.errors import UserError
from ipe_bench.cli import words as w
from ipe_bench.cli.keys import OF_CONSTANTS, OF_STATES
from ipe_bench.cli.session import composed, jobs_of, session
from ipe_bench.cli.spec import Spec
from ipe_bench.cli.words import Words
from ipe_bench.measurements import Nist
from ipe_bench.measurements.function import title_of
from ipe_bench.report.page.writer import reserved_folder
from ipe_bench.runs.provenance import describe

if TYPE_CHECKING:
    from ipe_bench.real.logs import LogQuestion

_OWN = ("function", "formula", "formulas", "ode")
"""Options that are models of the user's own."""
_FOLDER = re.compile(r"[\w-]+")
"""A title that can be part of the name of a folder."""


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
        model = self.spec.measurement
        group = "measurement"
        if self.spec.state_model is not None:
            model = self.spec.state_model
            group = "state_model"
        if isinstance(model, Nist):
            return f"nist/{model.dataset.lower()}"
        return self.words.chosen(group) or model.name

    @property
    def title(self) -> str:
        """Measurement model of the request, or the name that the user gave to an own one."""
        if self.spec.state_model is not None:
            return self.spec.state_model.name if self.measurement in _OWN else self.measurement
        return title_of(self.spec.measurement) if self.measurement in _OWN else self.measurement

    @property
    def estimators(self) -> dict[str, Any]:
        """Estimators or trackers of the request, described."""
        return {label: describe(one) for label, one in self.spec.estimators.items()}

    def log_question(
        self, readings: str | Sequence[str] | None, find: str | Sequence[str] = ()
    ) -> LogQuestion:
        """Returns the question on the states of a log."""
        from ipe_bench.real.logs import LogQuestion

        spec = self.spec
        assert spec.state_model is not None
        self.words.refuse(
            ("error_scale",), "is of simulated trials; give the state model another prior"
        )
        asked = (spec.estimators, spec.ignored, find, spec.gate)
        return LogQuestion.of(spec.state_model, readings, *asked)

    def folder(
        self, name: str, identity: Any, files: Sequence[str] = ()
    ) -> AbstractContextManager[Path]:
        """Reserves the named folder, or one named after the command and the model, for a command
        that `identity` tells from others in NAME.json, and for its further `files`."""
        folder = Path(self.spec.output)
        named = not {"name", "output"}.isdisjoint(self.words.keys)
        if not named:
            model = self.title if _FOLDER.fullmatch(self.title) else self.measurement
            folder = folder.with_name(f"{self.command}-{model.replace('/', '-')}")
        return reserved_folder(folder, name, identity, elsewhere=not named, files=files)


def _refuse_sweeps(words: Words) -> None:
    """Refuses a word of a sweep: these commands have one job, and no -m."""
    for one in words.overrides:
        word = w.said(one)
        if one.is_sweep_override() or w.swept(word) != word:
            raise UserError(
                f"{word}: is a sweep, which only runs of simulated trials take; give one value, or"
                " put a list in brackets"
            )


def single(
    command: str,
    arguments: Sequence[str],
    standard: Sequence[str] = (),
    moving: str = "",
    **refused: Sequence[str],
) -> Single:
    """Composes the one job that the arguments of a command ask for; `standard` are default words,
    and `refused` are keys without meaning for it, by whom they are for; `moving` says what else
    serves for states that move."""
    with session():
        words = w.read(command, arguments)
        for whose, keys in refused.items():
            words.refuse(
                keys, f"is for `ipe-bench {whose}`, and has no meaning in `ipe-bench {command}`"
            )
        _refuse_sweeps(words)
        unsaid = [one for one in standard if one.partition("=")[0] not in words.keys]
        given = w.read(command, unsaid)
        jobs = jobs_of(Words(given.overrides + words.overrides), multirun=False)
        if len(jobs.specs) > 1:
            raise UserError(
                f"experiment={words.chosen('experiment')}: sweeps over {len(jobs.specs)} settings,"
                f" and `ipe-bench {command}` takes one; give a value of each key that it sweeps"
            )
        require_one_kind(words, jobs.specs[0])
        model = jobs.specs[0].state_model
        if moving and model is not None:
            raise UserError(
                f"state_model={model.name}: states move, and {command} is of constants; {moving}"
            )
        return Single(command, words, jobs.specs[0], composed(jobs.words))


def require_one_kind(words: Words, spec: Spec) -> None:
    """Refuses a tracker without a state model, and a state model together with a key of
    measurements, typed or from an experiment."""
    if spec.state_model is None:
        words.refuse((*OF_STATES[1:], "find", "gate"), "goes with state_model=NAME")
        return
    why = "is of a measurement, and state_model= chooses states that move"
    words.refuse(OF_CONSTANTS, why)
    for one in words.overrides:
        if one.key_or_group != "experiment":
            continue
        config = composed(Words((one,)))
        without = composed(Words(()))
        for key in OF_CONSTANTS:
            if config.get(key) != without.get(key):
                raise UserError(f"{w.said(one)}: sets {key}, which {why}; leave out one of them")
