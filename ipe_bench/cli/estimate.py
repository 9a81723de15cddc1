"""`ipe-bench estimate`: parameters from a file of real readings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from hydra import compose, initialize_config_dir
from rich.console import Console
from rich.table import Table

from ipe_bench import plugins
from ipe_bench.api import check
from ipe_bench.cli import console
from ipe_bench.cli.config import CONFIG_ERRORS, Job, assemble, explain, prepare, refuse_silent_traps, rewrite
from ipe_bench.errors import UserError
from ipe_bench.fit import Fit, fit
from ipe_bench.noise import Certified
from ipe_bench.readings import read_readings
from ipe_bench.statuses import Status


def main(arguments: Sequence[str]) -> int:
    """Estimates with every chosen estimator and prints a table; exit code 1 where none converged."""
    flags = [a for a in arguments if a.startswith("-")]
    if flags:
        raise UserError(f"{flags[0]}: estimate takes overrides such as measurement=gins readings=FILE, and no flags")
    refuse_silent_traps(arguments)
    prepare()
    try:
        with initialize_config_dir(str(plugins.own_conf()), version_base="1.3"):
            config = compose("config", rewrite(arguments))
        job = assemble(config)
    except CONFIG_ERRORS as error:
        raise explain(error) from error
    recorded = job.scenario.measurement.recorded
    if config.readings is not None:
        problem = job.scenario.problem
        z = read_readings(Path(config.readings), problem.measurement)
    elif recorded is not None:
        job = replace(job, scenario=replace(job.scenario, noise=Certified()))
        problem, z = job.scenario.problem, recorded.z
    else:
        raise UserError("readings: is not given; write readings=FILE (see `ipe-bench list measurement -v`)")
    check([job.scenario], job.estimators, trials=1)
    fits = fit(problem, z, job.estimators)
    _show(console(), job, fits)
    return 0 if any(f.status is Status.CONVERGED for f in fits) else 1


def _show(console: Console, job: Job, fits: Sequence[Fit]) -> None:
    model = job.scenario.measurement
    table = Table(title=f"{model.name}: estimate ± standard error", title_justify="left", box=None, pad_edge=False)
    table.add_column("parameter")
    table.add_column("unit")
    for one in fits:
        table.add_column(one.label, justify="right", no_wrap=True)
    for i, parameter in enumerate(model.parameters):
        values = (f"{one.x[i]:.6g} ± {one.standard_errors[i]:.2g}" for one in fits)
        table.add_row(parameter.name, parameter.unit, *values)
    console.print(table)
    console.print()
    verdicts = Table(title="Does the model fit?", title_justify="left", box=None, pad_edge=False)
    for heading in ("estimator", "status", "residual deviation", "chi-square", "degrees of freedom", "p", "verdict"):
        verdicts.add_column(heading, justify="left" if heading in ("estimator", "status", "verdict") else "right")
    for one in fits:
        residual = f"{one.residual_deviation:.4g} {model.reading_unit}"
        status = f"{one.status.label}: {one.message}" if one.message else one.status.label
        numbers = (f"{one.chi_square:.4g}", str(one.degrees_of_freedom), f"{one.p_value:.3g}")
        verdicts.add_row(one.label, status, residual, *numbers, "fits" if one.p_value >= 1e-3 else "does not fit")
    console.print(verdicts)
