"""One job outside of a run of Hydra's: for the commands that compute a single scenario and write one folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

from ipe_bench.cli.config import CONFIG_ERRORS, assemble, explain, prepare, rewrite
from ipe_bench.cli.overrides import read
from ipe_bench.cli.spec import KEYS, Spec
from ipe_bench.cli.typed import check_options
from ipe_bench.measurements import Nist
from ipe_bench.plugins import discovery as plugins

NOT_OF_ONE_SCENARIO = (
    "precision",
    "time_limit",
    "block_size",
    "figures",
    "formats",
    "execution",
    "readings",
    "write_readings",
    "write_readings_trial",
    "ignore_rows",
    "ignore_columns",
)
"""Keys of what other commands do: to run many trials, and to read files."""


def first_of(keys: Sequence[str], words: Sequence[str]) -> str | None:
    """The first key that the overrides name which is one of these, or below one; None where there is none."""
    named = (word.lstrip("+~").partition("=")[0] for word in words)
    return next((key for key in named if key.split(".")[0].split("@")[0] in keys), None)


def chosen_measurement(arguments: Sequence[str], job: Spec) -> str:
    """The option that was chosen, which says more than the class; of NIST's data sets nist/NAME."""
    if isinstance(job.measurement, Nist):
        return f"nist/{job.measurement.dataset.lower()}"
    chosen = [a.partition("=")[2] for a in arguments if a.startswith("measurement=")]
    return chosen[-1] if chosen else job.measurement.name


@dataclass(frozen=True)
class Single:
    """What a command was asked for."""

    words: Sequence[str]
    """The overrides in Hydra's own words."""
    config: DictConfig
    job: Spec
    measurement: str
    """The model, as it was asked for."""
    named: bool
    """Whether the folder was named; else it is named after the command and the model."""

    @property
    def folder(self) -> Path:
        """Where the files are to go."""
        return Path(self.config.output)


def compose_single(
    command: str,
    arguments: Sequence[str],
    refuse: Callable[[Sequence[str]], Any],
    *,
    standard: Sequence[str] = (),
) -> Single:
    """Composes and constructs what the arguments of a command ask for.

    `refuse` raises where the overrides name what is nothing in this command; `standard` are overrides that stand unless
    others are given; `measurement` says what the model is called; `opened`: see `assemble`.

    Raises:
        UserError: a mistake in the arguments, in one line.
    """
    prepare()
    words = rewrite(arguments)
    refuse(words)
    check_options([*standard, *words], read(words, KEYS))
    try:
        with initialize_config_dir(str(plugins.own_conf()), version_base="1.3"):
            config = compose("config", [*standard, *words])
    except Exception as error:  # what Hydra makes of overrides raises nearly anything
        raise explain(error) from error
    named = any(a.lstrip("+").startswith(("name=", "output=")) for a in arguments)
    try:
        job = assemble(config)
        name = chosen_measurement(arguments, job)
        if not named:
            config.name = f"{command}-{name.replace('/', '-')}"
    except CONFIG_ERRORS as error:
        raise explain(error) from error
    return Single(words, config, job, name, named)
