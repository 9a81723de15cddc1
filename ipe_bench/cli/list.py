"""`ipe-bench list [GROUP | GROUP/NAME] [-v]`: what there is to choose from, and where it comes from."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from ipe_bench.basics.errors import UserError, unknown
from ipe_bench.cli import console, print_problems
from ipe_bench.measurements.base import Measurement
from ipe_bench.plugins import discovery as plugins
from ipe_bench.plugins.construct import construct
from ipe_bench.plugins.description import Described, described


def main(names: Sequence[str], verbose: bool) -> int:
    """One line per option of each group; of an option itself, GROUP/NAME, what it may be told.

    Where verbose, groups come with all of that.
    """
    print_problems(plugins.take_problems())
    known = plugins.groups()
    out = console()
    for name in names or known:
        if name == "keys":
            from ipe_bench.cli.spec import keys_of_a_run

            _list_options(out, "keys", "", keys_of_a_run())
            continue
        group, slash, _ = name.partition("/")
        if group not in known:
            homes = [f"{o.group}/{o.name}" for o in plugins.options() if o.name == name]
            remedy = f"write {' or '.join(homes)}" if homes else unknown(group, known, "group")
            raise UserError(f"{name}: {remedy}")
        if slash:
            _describe(out, _find(name))
        else:
            _list_group(out, group, verbose)
    listed = {name.partition("/")[0] for name in names or known}
    for option in plugins.options():
        if option.fault is not None and option.group in listed:
            print(f"ipe-bench: {option.group}={option.name}: {option.fault}", file=sys.stderr)
    return 0


def _list_options(out: Console, title: str, prefix: str, rows: Sequence[Described]) -> None:
    table = _table(title, "key", "value", "takes", "meaning")
    for row in rows:
        table.add_row(*map(Text, (f"{prefix}{row.name}", row.value, row.kind, row.meaning)))
    out.print(table)


def _find(name: str) -> plugins.Option:
    group, _, option = name.partition("/")
    options = {o.name: o for o in plugins.options(group)}
    if option not in options:
        raise UserError(f"{name}: {unknown(option, options, 'option')}")
    if (fault := options[option].fault) is not None:
        raise UserError(f"{name}: {fault}")
    return options[option]


def _list_group(out: Console, group: str, verbose: bool) -> None:
    table = _table(group, "option", "what it is", "from")
    chosen = plugins.options(group)
    for option in chosen:
        table.add_row(Text(option.name), Text(option.summary), Text(option.source.origin))
    out.print(table)
    out.print()
    for option in chosen:
        if verbose and option.fault is None:
            _describe(out, option)


def _table(title: str, *headings: str) -> Table:
    """The names of its first column are the last thing to be broken."""
    table = Table(title=title, title_justify="left", title_style="bold", box=None, pad_edge=False, expand=False)
    for heading in headings:
        table.add_column(heading, overflow="fold", no_wrap=heading == headings[0])
    return table


def _describe(out: Console, option: plugins.Option) -> None:
    """Every option of a component with its value, what may be given, and what it means."""
    key = f"estimators.{option.label}." if option.group in plugins.ESTIMATOR_GROUPS else f"{option.group}."
    rows = described(option)
    out.print(Text(f"{option.group}={option.name}  {option.summary}"))
    if rows:
        _list_options(out, "", "" if option.group == "experiment" else key, rows)
    out.print()
    if option.group == "measurement":
        _describe_measurement(out, option)


def _describe_measurement(out: Console, option: plugins.Option) -> None:
    from omegaconf import OmegaConf
    from omegaconf.errors import MissingMandatoryValue

    from ipe_bench.real.readings import header, labels

    try:
        model = construct(OmegaConf.to_container(OmegaConf.load(option.path), throw_on_missing=True), "measurement")
        assert isinstance(model, Measurement)
        columns = ",".join(header(model))
    except (MissingMandatoryValue, UserError):
        out.print(f"measurement={option.name}: what it has depends on its options:", markup=False)
        out.print(option.path.read_text(encoding="utf-8"), markup=False)
        return

    # A title of the table would be broken where it is wider than the table.
    out.print(Text(f"measurement={option.name}", style="italic"), soft_wrap=True)
    table = Table(box=None, pad_edge=False)
    for heading in ("parameter", "size", "unit"):
        table.add_column(heading, justify="right" if heading == "size" else "left")
    for parameter in model.parameters:
        table.add_row(parameter.name, f"{parameter.size:g}", parameter.unit)
    out.print(table)
    out.print(f"readings={{FILE}}: {model.m} rows, header: {columns}", markup=False, soft_wrap=True)
    first = ",".join(str(column[0]) for column in labels(model).values())
    out.print(f"first row: {first},<reading>", markup=False, soft_wrap=True)
    if model.inputs:
        known = ", ".join(i.heading for i in model.inputs)
        out.print(f"A file's own {known} take the place of these; so it may have any number of rows.", markup=False)
    out.print("A column sigma, if there is one, holds the standard deviation of each reading.\n", markup=False)
