"""`ipe-bench list [GROUP | GROUP/NAME] [-v]`: what there is to choose from, and where it comes from."""

from __future__ import annotations

from collections.abc import Sequence

from ipe_bench.basics.errors import UserError, unknown
from ipe_bench.cli import print_problems, say, show
from ipe_bench.measurements.base import Measurement
from ipe_bench.plugins import discovery as plugins
from ipe_bench.plugins.construct import construct
from ipe_bench.plugins.description import Described, described
from ipe_bench.report.table import Table, words


def main(names: Sequence[str], verbose: bool) -> int:
    """One line per option of each group; of an option itself, GROUP/NAME, what it may be told.

    Where verbose, groups come with all of that.
    """
    print_problems(plugins.take_problems())
    known = plugins.groups()
    for name in names or known:
        group, slash, option = name.partition("/")
        if name == "keys":
            from ipe_bench.cli.spec import keys_of_a_run

            _show_keys("keys", "", keys_of_a_run())
        elif group not in known:
            homes = " or ".join(f"{o.group}/{o.name}" for o in plugins.options() if o.name == name)
            raise UserError(f"{name}: {f'write {homes}' if homes else unknown(group, known, 'group')}")
        elif slash:
            options = {o.name: o for o in plugins.options(group)}
            if option not in options:
                raise UserError(f"{name}: {unknown(option, options, 'option')}")
            _describe(options[option])
        else:
            _show_group(group, verbose)
    return 0


def _show_group(group: str, verbose: bool) -> None:
    chosen = plugins.options(group)
    columns = {
        "option": [option.name for option in chosen],
        "what it is": [option.summary for option in chosen],
        "from": [option.source.origin for option in chosen],
    }
    _show(group, columns)
    print()
    for option in chosen:
        try:
            if option.fault is not None:
                raise UserError(option.fault)
            if verbose:
                _describe(option)
        except UserError as error:
            print_problems([f"{group}={option.name}: {error}"])


def _show(title: str, columns: dict[str, list[str]]) -> None:
    show([Table("list", title, "", [words(heading, cells) for heading, cells in columns.items()])])


def _show_keys(title: str, prefix: str, rows: Sequence[Described]) -> None:
    columns = {
        "key": [f"{prefix}{row.name}" for row in rows],
        "value": [row.value for row in rows],
        "takes": [row.kind for row in rows],
        "meaning": [row.meaning for row in rows],
    }
    _show(title, columns)


def _describe(option: plugins.Option) -> None:
    """Every option of a component with its value, what may be given, and what it means."""
    if option.fault is not None:
        raise UserError(f"{option.group}/{option.name}: {option.fault}")
    key = plugins.PACKAGES.get(option.group)
    prefix = f"{option.group}." if key is None else f"{key}.{option.label}."
    rows = described(option)
    title = f"{option.group}={option.name}  {option.summary}"
    if rows:
        _show_keys(title, "" if option.group == "experiment" else prefix, rows)
    else:
        say(title)
    print()
    if option.group == "measurement":
        _describe_measurement(option)


def _describe_measurement(option: plugins.Option) -> None:
    """The parameters of a measurement model, and the file of readings that it wants."""
    from ipe_bench.real.readings import header, labels

    config = option.config
    try:
        if "???" in config.values():
            raise UserError("an option is to be given")
        model = construct(config, "measurement")
        assert isinstance(model, Measurement)
        columns = ",".join(header(model))
    except UserError:
        say(f"measurement={option.name}: what it has depends on its options:", option.path.read_text(encoding="utf-8"))
        return
    parameters = model.parameters
    numbers = {"size": [f"{p.size:g}" for p in parameters], "unit": [p.unit for p in parameters]}
    _show(f"measurement={option.name}", {"parameter": [p.name for p in parameters], **numbers})
    first = ",".join(str(column[0]) for column in labels(model).values())
    say(f"readings={{FILE}}: {model.m} rows, header: {columns}", f"first row: {first},<reading>")
    if model.inputs:
        known = ", ".join(i.heading for i in model.inputs)
        say(f"A file's own {known} take the place of these; so it may have any number of rows.")
    say("A column sigma, if there is one, holds the standard deviation of each reading.\n")
