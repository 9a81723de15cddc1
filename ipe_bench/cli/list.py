"""`ipe-bench list [GROUP] [-v]`: what there is to choose from, and where it comes from."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from ipe_bench.basics.errors import UserError, unknown
from ipe_bench.cli import console
from ipe_bench.measurements.base import Measurement
from ipe_bench.plugins import discovery as plugins
from ipe_bench.plugins.construct import construct


def main(groups: Sequence[str], verbose: bool) -> int:
    """One line per option; where verbose, the parameters and the readings file of each measurement."""
    for problem in plugins.take_problems():
        print(f"ipe-bench: {problem}", file=sys.stderr)
    known = plugins.groups()
    for name in groups:
        if name not in known:
            raise UserError(f"{name}: {unknown(name, known, 'group')}")
    out = console()
    for group in groups or known:
        table = Table(title=group, title_justify="left", title_style="bold", box=None, pad_edge=False, expand=False)
        for heading in ("option", "what it is", "from"):
            table.add_column(heading, overflow="fold", no_wrap=heading == "option")
        chosen = plugins.options(group)
        for option in chosen:
            table.add_row(Text(option.name), Text(option.summary), Text(option.source.origin))
        out.print(table)
        out.print()
        if verbose and group == "measurement":
            for option in [o for o in chosen if o.fault is None]:
                _describe_measurement(out, option)
    for option in plugins.options():
        if option.fault is not None and option.group in (groups or known):
            print(f"ipe-bench: {option.group}={option.name}: {option.fault}", file=sys.stderr)
    return 0


def _describe_measurement(out: Console, option: plugins.Option) -> None:
    from omegaconf import OmegaConf

    model = construct(OmegaConf.to_container(OmegaConf.load(option.path)), "measurement")
    assert isinstance(model, Measurement)
    from ipe_bench.real.readings import header

    table = Table(title=f"measurement={option.name}", title_justify="left", box=None, pad_edge=False)
    for heading in ("parameter", "size", "unit"):
        table.add_column(heading, justify="right" if heading == "size" else "left")
    for parameter in model.parameters:
        table.add_row(parameter.name, f"{parameter.size:g}", parameter.unit)
    out.print(table)
    out.print(f"readings={{FILE}}: {model.m} rows, header: {','.join(header(model))}", markup=False)
    first = ",".join(str(column[0]) for column in model.index.values())
    out.print(f"first row: {first},<reading>\n", markup=False)
