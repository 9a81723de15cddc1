"""One job outside of a run: for the commands that look at a single scenario and write one folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ipe_bench.cli import words as w
from ipe_bench.cli.session import composed, jobs_of, session
from ipe_bench.cli.spec import Spec
from ipe_bench.cli.words import Words
from ipe_bench.measurements import Nist

OF_MANY_TRIALS = ("precision", "time_limit", "block_size", "formats", "execution", "write_readings")
OF_MANY_TRIALS += ("write_readings_trial", "objective")
"""Keys of runs."""
OF_FILES = ("readings", "ignore_rows", "ignore_columns")
"""Keys of estimates from real readings."""


@dataclass(frozen=True)
class Single:
    """What a command was asked for."""

    words: Words
    spec: Spec
    measurement: str
    """The model, as it was asked for."""
    named: bool
    """Whether the folder was named; else it is named after the command and the model."""
    folder: Path
    """Where the files are to go."""
    config: dict[str, Any] = field(default_factory=dict)
    """As it was composed."""


def single(command: str, arguments: Sequence[str], standard: Sequence[str] = (), **refused: Sequence[str]) -> Single:
    """The one job that the arguments of a command ask for; `standard` are words that stand unless others are given, and
    `refused` are keys that mean nothing to it, by whom they are for.

    Raises:
        UserError: a mistake in the arguments, in one line.
    """
    with session():
        words = w.read(command, arguments)
        for whose, keys in refused.items():
            words.refuse(keys, f"is for `ipe-bench {whose}`, and nothing in `ipe-bench {command}`")
        given = w.read(command, [one for one in standard if one.partition("=")[0] not in words.keys])
        jobs = jobs_of(Words(given.overrides + words.overrides), multirun=False)
        spec, model = jobs.specs[0], jobs.specs[0].measurement
        config = composed(jobs.words)
    name = f"nist/{model.dataset.lower()}" if isinstance(model, Nist) else words.chosen("measurement") or model.name
    named = not {"name", "output"}.isdisjoint(words.keys)
    folder = Path(spec.output) if named else Path(spec.output).with_name(f"{command}-{name.replace('/', '-')}")
    return Single(words, spec, name, named, folder, config)
