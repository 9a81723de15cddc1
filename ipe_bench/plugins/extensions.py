"""Collects what plugins add: richer models of an instrument, and statistics, figures, tables and
sections of a report.

Each of those is a record: `conf/figure/NAME.yaml` has one key, `_target_`, its dotted name in the
plugin's package.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from ipe_bench.basics.errors import UserError, place_of
from ipe_bench.measurements.base import Measurement
from ipe_bench.plugins.construct import construct, find_object
from ipe_bench.plugins.discovery import RECORD_GROUPS, Option, blame, options
from ipe_bench.runs.provenance import TARGET
from ipe_bench.trials.scenario import Scenario


def richer_models(scenario: Scenario) -> list[Measurement]:
    """Returns the richer models of a scenario: the truth that simulates its readings, or every
    option of `measurement` that is the same model with more errors, with the model's own
    options."""
    model = scenario.measurement
    truth = scenario.truth
    if truth is not None:
        if not truth.nuisance_deviation.any():
            remedy = "leave it out, or choose a richer one"
            raise UserError(
                f"truth_measurement={truth.name}: has no errors besides the parameters; {remedy}"
            )
        return [truth]
    own = {f.name: getattr(model, f.name) for f in dataclasses.fields(model) if f.init}  # type: ignore[arg-type]
    found: list[Any] = []
    for option in options("measurement"):
        if option.fault is not None:
            continue
        try:
            other = construct(option.config, f"measurement={option.name}")
        except UserError:
            continue  # `ipe-bench list` tells of options that cannot be made
        if not isinstance(other, type(model)) or type(other) is type(model):
            continue
        other = dataclasses.replace(other, **own)  # type: ignore[type-var]
        if other.nuisance_deviation.any():
            found.append(other)
    return found


def find_record(option: Option) -> Any:
    """Returns the record that an option names."""
    where = f"{option.group}={option.name}"
    if option.fault is not None:
        raise UserError(f"{where}: {option.fault}")
    config = option.config
    if not isinstance(config, Mapping) or set(config) != {TARGET}:
        raise UserError(
            f"{where}: {option.path}: has other keys than {TARGET}, which names a {option.group}"
        )
    record = find_object(config[TARGET], where)
    if option.group == "statistic" and getattr(record, "name", option.name) != option.name:
        raise UserError(
            f"{where}: {config[TARGET]} is called {record.name}; give file and record one name"
        )
    return record


def added(group: str, problems: list[str], make: Callable[[Any], Any]) -> Iterator[tuple[str, Any]]:
    """Yields what `make` makes of each record of a group, with its name; a line is added to the
    problems for every one that cannot be found or raises."""
    for option in options(group):
        name = f"{group}={option.name}: "
        try:
            made = make(find_record(option))
        except UserError as error:
            problems.append(f"{name}{str(error).removeprefix(name)}; it is left out")
        except Exception as error:
            problems.append(f"{name}{blame(error) or place_of(error)}; it is left out")
        else:
            yield option.name, made


def require_type(thing: Any, kind: type, says: str = "gives") -> Any:
    """Returns what a plugin gives, or raises UserError if it is of another type."""
    if not isinstance(thing, kind):
        raise UserError(f"{says} a {type(thing).__name__} and not a {kind.__name__}")
    return thing


def use_statistics() -> list[str]:
    """Registers the statistics of all plugins beside ours; returns a line for each that cannot
    be."""
    from ipe_bench.statistics.registry import add_statistics
    from ipe_bench.statistics.statistic import Statistic

    problems: list[str] = []
    records = added("statistic", problems, lambda record: require_type(record, Statistic, "is"))
    found = [record for _, record in records]
    return problems + add_statistics(found)


def files_of_records() -> list[Path]:
    """Lists the files of every plugin that adds to reports."""
    homes = {option.source.conf.parent for group in RECORD_GROUPS for option in options(group)}
    found = itertools.chain.from_iterable(home.rglob("*") for home in homes)
    return [path for path in found if path.is_file() and path.suffix != ".pyc"]
