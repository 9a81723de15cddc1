"""Defines `ipe-bench list`, which shows the options of each group."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from ipe_bench.basics.errors import UserError, unknown
from ipe_bench.cli import print_problems, say, show
from ipe_bench.measurements.base import Measurement, labels
from ipe_bench.plugins import discovery as plugins
from ipe_bench.plugins.construct import construct, described
from ipe_bench.report.tables.table import Table, words
from ipe_bench.states.base import StateModel

_START = (
    "measurement/function",
    "solver/auto",
    "baseline/levenberg_marquardt",
    "baseline/iterated_ekf",
    "tracker/auto",
)
"""What a newcomer needs of all groups: a model, estimators of three kinds, and a tracker."""


def list_command(names: Sequence[str], verbose: bool) -> int:
    """Prints one line per option of each group, with its own options if `verbose`; for GROUP/NAME
    only that option."""
    print_problems(plugins.take_problems())
    groups = plugins.groups()
    known = {*groups, "statistic", "figure"}
    if not names:
        every = {f"{one.group}/{one.name}": one.summary for one in plugins.options()}
        _show("start here", {"option": _START, "what it is": [every[name] for name in _START]})
        print()
    for name in names or groups:
        group, slash, option = name.partition("/")
        if group not in known:
            homes = " or ".join(f"{o.group}/{o.name}" for o in plugins.options() if o.name == name)
            remedy = f"write {homes}" if homes else unknown(group, known, "group")
            raise UserError(f"{name}: {remedy}")
        options = {one.name: one for one in plugins.options(group)}
        ours = _ours(group)
        if not slash:
            _list(group, options, ours, verbose)
        elif option in ours:
            say(f"{name}  {ours[option]}")
        elif option in options:
            _describe(options[option])
        else:
            raise UserError(f"{name}: {unknown(option, [*options, *ours], 'option')}")
    return 0


class _Row(NamedTuple):
    option: str
    meaning: str
    origin: str


def _list(
    group: str, options: Mapping[str, plugins.Option], ours: Mapping[str, str], verbose: bool
) -> None:
    rows = [_Row(name, text.partition(". ")[0], "built in") for name, text in ours.items()]
    rows += [_Row(one.name, one.summary, one.source.origin) for one in options.values()]
    for origin, several in itertools.groupby(rows, lambda row: row.origin):
        part = list(several)
        title = group if origin == "built in" else f"{group}, from {origin}"
        meanings = [row.meaning for row in part]
        _show(title, {"option": [row.option for row in part], "what it is": meanings})
    print()
    for one in options.values():
        if not verbose and one.fault is None:
            continue
        try:
            _describe(one)
        except UserError as error:
            print_problems([str(error)])


def _ours(group: str) -> dict[str, str]:
    """Returns the statistics and figures that come with the bench, which are no options, with
    descriptions."""
    if group == "statistic":
        from ipe_bench.statistics.records import SCORES, STATISTICS

        return {one.name: one.definition for one in (*STATISTICS, *SCORES)}
    if group == "figure":
        from ipe_bench.report.figures import NAMES

        return NAMES
    return {}


def _show(title: str, columns: Mapping[str, Sequence[str]]) -> None:
    shown = [words(heading, list(cells)) for heading, cells in columns.items()]
    show([Table("list", title, "", shown)])


def _describe(option: plugins.Option) -> None:
    """Describes every option of a component with its value, its type, and its meaning."""
    if option.fault is not None:
        raise UserError(f"{option.group}={option.name}: {option.fault}")
    prefix = "" if option.group == "experiment" else f"{option.group}."
    if option.group in plugins.PACKAGES:
        prefix = f"{plugins.PACKAGES[option.group]}.{option.label}."
    title = f"{option.group}={option.name}  {option.summary}"
    rows = described(option)
    if rows:
        columns = {
            "key": [f"{prefix}{row.name}" for row in rows],
            "value": [row.value for row in rows],
            "takes": [row.kind for row in rows],
            "meaning": [row.meaning for row in rows],
        }
        _show(title, columns)
    else:
        say(title)
    print()
    if option.group == "measurement":
        _describe_measurement(option)
    if option.group == "state_model":
        _describe_state_model(option)


def _describe_state_model(option: plugins.Option) -> None:
    """Says how trackers run the functions of a state model."""
    try:
        model = construct(option.config, "state_model")
        assert isinstance(model, StateModel)
        ways = model.remarks()
    except UserError:  # one that is to be given options first
        return
    say(*ways or ["Trackers run transition and observe as machine code, with exact slopes."], "")


def _describe_measurement(option: plugins.Option) -> None:
    """Describes the parameters of a measurement model, and the file of readings that it takes."""
    from ipe_bench.real.readings import header

    try:
        if "???" in option.config.values():
            raise UserError("choose an option")
        model = construct(option.config, "measurement")
        assert isinstance(model, Measurement)
        columns = ",".join(header(model))
    except UserError:
        say(f"measurement={option.name}: what it has depends on its options:", option.text)
        return
    parameters = {
        "parameter": [p.name for p in model.parameters],
        "size": [f"{p.size:g}" for p in model.parameters],
        "unit": [p.unit for p in model.parameters],
    }
    _show(f"measurement={option.name}", parameters)
    first = ",".join(str(column[0]) for column in labels(model).values())
    say(f"readings={{FILE}}: {model.m} rows, header: {columns}", f"first row: {first},<reading>")
    if model.inputs:
        known = ", ".join(i.heading for i in model.inputs)
        say(f"A file's own {known} take the place of these; so it may have any number of rows.")
    say("An optional column sigma has the standard deviation of each reading.\n")
