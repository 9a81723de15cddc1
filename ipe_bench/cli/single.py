"""The one job of a command that looks at a single scenario and writes one folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ipe_bench.basics.errors import UserError
from ipe_bench.cli import console, say
from ipe_bench.cli import words as w
from ipe_bench.cli.session import changed_by_experiment, composed, jobs_of, session
from ipe_bench.cli.spec import Spec
from ipe_bench.cli.words import Words
from ipe_bench.measurements import Nist
from ipe_bench.report.writer import reserve_output_folder

OF_MANY_TRIALS = ("precision", "time_limit", "block_size", "formats", "execution", "write_readings")
OF_MANY_TRIALS += ("write_readings_trial", "objective", "model", "tracker", "trackers")
"""Keys of runs."""
OF_CONSTANTS = ("measurement", "truth_measurement", "noise", "prior", "error_scale", "solver", "baseline")
OF_CONSTANTS += ("estimators", "parameters", "prior_covariance", "write_readings")
"""Keys of parameters that stand still."""
OF_FILES = ("readings", "ignore_rows", "ignore_columns")
"""Keys of estimates from real readings."""


@dataclass(frozen=True)
class Single:
    """What a command was asked for."""

    command: str
    words: Words
    spec: Spec
    config: dict[str, Any]
    """As it was composed."""

    @property
    def measurement(self) -> str:
        """The model, as it was asked for."""
        model = self.spec.measurement
        if isinstance(model, Nist):
            return f"nist/{model.dataset.lower()}"
        return self.words.chosen("measurement") or model.name

    def folder(self, name: str, identity: Any, files: Sequence[str] = ()) -> Path:
        """Reserves the folder that was named, or one that is named after the command and the model.

        `identity` tells this command from others, as NAME.json says it; `files` are further files of the command.
        """
        output, named = Path(self.spec.output), not {"name", "output"}.isdisjoint(self.words.keys)
        folder = output if named else output.with_name(f"{self.command}-{self.measurement.replace('/', '-')}")
        return reserve_output_folder(folder, name, identity, elsewhere=not named, files=files)


def single(command: str, arguments: Sequence[str], standard: Sequence[str] = (), **refused: Sequence[str]) -> Single:
    """The one job that the arguments of a command ask for; `standard` are words that stand unless others are given, and
    `refused` are keys that mean nothing to it, by whom they are for."""
    with session():
        words = w.read(command, arguments)
        for whose, keys in refused.items():
            words.refuse(keys, f"is for `ipe-bench {whose}`, and nothing in `ipe-bench {command}`")
        given = w.read(command, [one for one in standard if one.partition("=")[0] not in words.keys])
        jobs = jobs_of(Words(given.overrides + words.overrides), multirun=False)
        return Single(command, words, jobs.specs[0], composed(jobs.words))


def require_one_kind(words: Words, spec: Spec) -> None:
    """Refuses a tracker without a state model, and a state model together with a key of measurements, typed or from an
    experiment."""
    if spec.model is None:
        words.refuse(("tracker", "trackers"), "goes with model=NAME")
        return
    words.refuse(OF_CONSTANTS, "is of a measurement, and model= chooses states that move")
    for experiment, changed in changed_by_experiment(words).items():
        if key := next((key for key in OF_CONSTANTS if key in changed), None):
            raise UserError(
                f"{experiment}: sets {key}, which is of a measurement, and model= chooses states that move; leave out"
                " one of them"
            )


def say_files(files: Sequence[Path]) -> None:
    """Says which files a command has written into its folder."""
    say(f"\nIn {files[0].parent}:")
    console().print(", ".join(path.name for path in files), markup=False)
