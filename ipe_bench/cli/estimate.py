"""`ipe-bench estimate`: parameters from a file of real readings."""

from __future__ import annotations

import datetime
import hashlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.machine import library_versions
from ipe_bench.cli import console
from ipe_bench.cli.config import Job
from ipe_bench.cli.single import chosen_measurement, compose_single
from ipe_bench.measurements import Measurement, Nist
from ipe_bench.noise import Certified, ModelNoise, Noise
from ipe_bench.real.examination import examinations
from ipe_bench.real.fits import fit
from ipe_bench.real.sources import LeftOut, Readings, noise_of, open_together, require_enough
from ipe_bench.runs.provenance import describe, fingerprint
from ipe_bench.runs.run import validate

STANDARD_ESTIMATORS = ("solver=[auto]", "baseline=[linear_lse,levenberg_marquardt]")
"""Unless others are chosen: the one that chooses its way by itself, and two that it can be held against."""


def main(arguments: Sequence[str]) -> int:
    """Estimates with every chosen estimator, prints tables and writes files; exit code 1 where none is an answer."""
    single = compose_single(
        "estimate",
        arguments,
        _refuse_keys_without_use,
        standard=STANDARD_ESTIMATORS,
        measurement=_measurement_name,
        opened=_opened,
    )
    config = single.config
    job, z = _readings(config, single.job)
    problem = job.scenario.problem
    validate([job.scenario], job.estimators, trials=1, estimating=True)

    from ipe_bench.report.answer import Answer, claim, render, write_fits

    command = _command(config, job)
    folder = claim(single.folder, command, elsewhere=not single.named)
    fits = fit(problem, z, job.estimators, job.scenario.noise)
    left_out = _left_out(config).said
    answer = Answer(single.measurement, job.scenario.measurement, z, fits, examinations(problem, z, fits), left_out)
    written = {"measurement": single.measurement, **_provenance(config, job)}
    files = write_fits(folder, answer, command, written, which=job.figures)
    out = console()
    out.print(render(answer, out.width))
    out.print(f"\nIn {folder}:", markup=False, soft_wrap=True)
    out.print(", ".join(path.name for path in files), markup=False)
    return 0 if answer.passes else 1


_WITHOUT_USE = (
    "trials",
    "precision",
    "time_limit",
    "seed",
    "block_size",
    "formats",
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
    """As it was chosen, or NIST's data set (nist/misra1a)."""
    model = job.scenario.measurement
    if isinstance(model, Nist):
        return f"nist/{model.dataset.lower()}"
    return chosen_measurement(arguments, job)


def _readings(config: DictConfig, job: Job) -> tuple[Job, Array]:
    """The readings (m,) of the file, or those that come with the model; with the latter, their own noise."""
    found = job.readings
    if found is not None:
        require_enough(_files(config), found)
        noise = noise_of(found, _stated(config, job)) or job.scenario.noise
        return replace(job, scenario=replace(job.scenario, noise=noise)), found.z
    recorded = job.scenario.measurement.recorded
    if recorded is None:
        raise UserError("readings: is not given; write readings=FILE (see `ipe-bench list measurement -v`)")
    return replace(job, scenario=replace(job.scenario, noise=Certified())), recorded.z


def _opened(config: DictConfig, model: Measurement) -> Readings | None:
    """The readings of the files, where there are any; what is known of parameters is still to be taken in."""
    left_out = _left_out(config)
    if config.readings is None:
        if left_out:
            raise UserError("ignore_rows, ignore_columns: are of a file; give readings=FILE, or leave them out")
        return None
    return open_together(_files(config), model, left_out, enough=False)


def _left_out(config: DictConfig) -> LeftOut:
    """What a user leaves out of the files."""
    listed = {}
    for key in ("ignore_rows", "ignore_columns"):
        given = config[key]
        names = list(given) if OmegaConf.is_list(given) else [] if given is None else [given]
        kinds = (int, str) if key == "ignore_rows" else (str,)
        for name in names:
            if not isinstance(name, kinds) or isinstance(name, bool):
                raise UserError(f"{key}={name}: give names of columns, or numbers of rows, as in {key}=[3,4]")
        listed[key.removeprefix("ignore_")] = tuple(names)
    return LeftOut(**listed)


def _files(config: DictConfig) -> list[Path]:
    """The files that `readings` names, one or several."""
    given = config.readings
    names = list(given) if OmegaConf.is_list(given) else [given]
    if not names or any(not isinstance(name, str) for name in names):
        raise UserError(f"readings={given}: name a file, or several as readings=[a.csv,b.csv]")
    if len(set(names)) < len(names):
        raise UserError(f"readings={given}: names a file twice, which would count its readings twice")
    return [Path(name) for name in names]


def _stated(config: DictConfig, job: Job) -> Noise | None:
    """The noise that a user has chosen, not that which stands in for it."""
    standard = config.noise["_target_"].endswith(ModelNoise.__name__)
    told = not standard or config.noise.get("deviation") is not None or config.noise.get("step") is not None
    return job.scenario.noise if told else None


def _command(config: DictConfig, job: Job) -> dict[str, Any]:
    """What tells this command from others: what was asked for, whatever the file holds today."""
    return {
        "readings": None if config.readings is None else [str(path.resolve()) for path in _files(config)],
        "scenario": describe(job.scenario),
        "estimators": {label: describe(estimator) for label, estimator in job.estimators.items()},
        **({"left_out": describe(left_out)} if (left_out := _left_out(config)) else {}),
    }


def _provenance(config: DictConfig, job: Job) -> dict[str, Any]:
    readings = None
    if config.readings is not None:
        readings = [
            {"file": str(path), "sha256": hashlib.sha256(path.read_bytes()).hexdigest()} for path in _files(config)
        ]
    return {
        "written": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "readings": readings,
        "config": OmegaConf.to_container(config, resolve=True),
        "libraries": library_versions(),
        **fingerprint([job.scenario, *job.estimators.values()]),
    }
