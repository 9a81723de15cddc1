"""`ipe-bench estimate`: parameters from a file of real readings."""

from __future__ import annotations

import datetime
import hashlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf

from ipe_bench.api import validate
from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.machine import library_versions
from ipe_bench.basics.statuses import Status
from ipe_bench.cli import console
from ipe_bench.cli.config import CONFIG_ERRORS, KEYS, Job, assemble, explain, prepare, rewrite
from ipe_bench.cli.overrides import read
from ipe_bench.measurements import Nist
from ipe_bench.noise import Certified
from ipe_bench.plugins import discovery as plugins
from ipe_bench.real.fits import fit
from ipe_bench.real.readings import read_readings
from ipe_bench.runs.provenance import describe, fingerprint


def main(arguments: Sequence[str]) -> int:
    """Estimates with every chosen estimator, prints tables and writes files; exit code 1 where none converged."""
    prepare()
    words = rewrite(arguments)
    _refuse_keys_without_use(words)
    read(words, KEYS)
    try:
        with initialize_config_dir(str(plugins.own_conf()), version_base="1.3"):
            config = compose("config", words)
    except Exception as error:  # what Hydra makes of overrides raises nearly anything
        raise explain(error) from error
    try:
        job = assemble(config)
    except CONFIG_ERRORS as error:
        raise explain(error) from error
    named = any(a.lstrip("+").startswith(("name=", "output=")) for a in arguments)
    name = _measurement_name(arguments, job)
    if not named:
        config.name = f"estimate-{name.replace('/', '-')}"
        job = replace(job, output=config.output)
    job, z = _readings(config, job)
    problem = job.scenario.problem
    validate([job.scenario], job.estimators, trials=1)

    from ipe_bench.report.answer import claim, render, write_fits

    command = _command(config, job)
    folder = claim(Path(job.output), command, elsewhere=not named)
    fits = fit(problem, z, job.estimators, job.scenario.noise)
    files = write_fits(
        folder, job.scenario.measurement, z, fits, command, {"measurement": name, **_provenance(config, job)}
    )
    out = console()
    out.print(render(name, job.scenario.measurement, fits, out.width))
    out.print(f"\nIn {folder}: {', '.join(path.name for path in files)}", markup=False, soft_wrap=True)
    return 0 if any(f.status is Status.CONVERGED for f in fits) else 1


_WITHOUT_USE = (
    "trials",
    "precision",
    "time_limit",
    "seed",
    "block_size",
    "execution",
    "truth_measurement",
    "write_readings",
)


def _refuse_keys_without_use(words: Sequence[str]) -> None:
    for word in words:
        key = word.lstrip("+~").partition("=")[0].replace("measurement@truth", "truth")
        if key.startswith(_WITHOUT_USE):
            raise UserError(f"{key}: is for `ipe-bench run`, and nothing in an estimate from readings; leave it out")


def _measurement_name(arguments: Sequence[str], job: Job) -> str:
    """The option that was chosen, which says more than the class, or NIST's data set (nist/misra1a)."""
    model = job.scenario.measurement
    if isinstance(model, Nist):
        return f"nist/{model.dataset.lower()}"
    chosen = [a.partition("=")[2] for a in arguments if a.startswith("measurement=")]
    return chosen[-1] if chosen else model.name


def _readings(config: DictConfig, job: Job) -> tuple[Job, Array]:
    """The readings (m,) of the file, or those that come with the model; with the latter, their own noise."""
    if config.readings is not None:
        return job, read_readings(Path(config.readings), job.scenario.measurement)
    recorded = job.scenario.measurement.recorded
    if recorded is None:
        raise UserError("readings: is not given; write readings=FILE (see `ipe-bench list measurement -v`)")
    return replace(job, scenario=replace(job.scenario, noise=Certified())), recorded.z


def _command(config: DictConfig, job: Job) -> dict[str, Any]:
    """What tells this command from others: what was asked for, whatever the file holds today."""
    return {
        "readings": None if config.readings is None else str(Path(config.readings).resolve()),
        "scenario": describe(job.scenario),
        "estimators": {label: describe(estimator) for label, estimator in job.estimators.items()},
    }


def _provenance(config: DictConfig, job: Job) -> dict[str, Any]:
    readings = None
    if config.readings is not None:
        path = Path(config.readings)
        readings = {"file": str(config.readings), "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    return {
        "written": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "readings": readings,
        "config": OmegaConf.to_container(config, resolve=True),
        "libraries": library_versions(),
        **fingerprint([job.scenario, *job.estimators.values()]),
    }
