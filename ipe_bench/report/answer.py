"""Estimates from real readings, as files and as tables in the terminal."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.files import write_atomically
from ipe_bench.basics.linalg import Array
from ipe_bench.measurements.base import Measurement
from ipe_bench.real.fits import Fit
from ipe_bench.real.residuals import LEAST_P
from ipe_bench.report.words import p_value
from ipe_bench.trials.thresholds import FIT_LEVEL

if TYPE_CHECKING:
    from rich.console import Group

SCHEMA = 1
RESULT = "estimate.json"
RESIDUALS = "residuals.csv"
_FIGURES = tuple(f"{name}{suffix}" for name in ("residuals", "ellipses") for suffix in (".png", ".pdf"))
_MOST_OUTLIERS = 8
_FEW = 0.05
"""Above this share of outliers it is the model that is wrong, and a list of readings says nothing."""
_ALIKE = 0.02
_NARROW = 90
"""Columns of a terminal below which the table of verdicts goes without the residual deviation."""


def claim(
    folder: Path,
    command: Any,
    *,
    elsewhere: bool,
    result: str = RESULT,
    files: Sequence[str] = (RESIDUALS, *_FIGURES),
) -> Path:
    """The folder that this command's results go to: it is new, or holds what the same command wrote before.

    `result` is the JSON file that says which command it was, `files` are the others. Where the folder holds anything
    else of ours, `elsewhere` allows folder-2, folder-3 and so on in its place.

    Raises:
        UserError: the folder is taken, or cannot be written to.
    """
    number, candidate = 1, folder
    while not _is_free(candidate, command, result, files):
        if not elsewhere:
            raise UserError(
                f"output={candidate}: holds results of another command, which are not overwritten; choose another "
                "folder, or remove it"
            )
        number += 1
        candidate = folder.with_name(f"{folder.name}-{number}")
    try:
        candidate.mkdir(parents=True, exist_ok=True)
        probe = candidate / ".writable"
        probe.touch()
        probe.unlink()
    except OSError as error:
        reason = error.strerror or str(error)
        raise UserError(f"output={candidate}: cannot be written to ({reason}); choose another folder") from None
    return candidate


def _is_free(folder: Path, command: Any, result: str, files: Sequence[str]) -> bool:
    if not (folder / result).exists():
        return not any((folder / name).exists() for name in files)
    try:
        return json.loads((folder / result).read_text(encoding="utf-8"))["command"] == command
    except (OSError, ValueError, KeyError, TypeError):
        return False


def write_fits(
    folder: Path, model: Measurement, z: Array, fits: Sequence[Fit], command: Any, provenance: Mapping[str, Any]
) -> list[Path]:
    """Writes the results of fits of the readings z (m,); each file appears whole or not at all. Returns the files.

    `command` tells one command from another (see `claim`); `provenance` is added to the JSON file and overrides what
    stands there of the same name.
    """
    from ipe_bench.report.figures.residual_plots import draw_fits

    result = folder / RESULT
    # First, since it says whose folder this is.
    text = json.dumps({"schema": SCHEMA, "command": command, **_described(model, z, fits), **provenance}, indent=1)
    write_atomically(result, lambda path: path.write_text(text + "\n", encoding="utf-8"))
    table = folder / RESIDUALS

    def write_table(path: Path) -> None:
        with path.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows(_residual_rows(model, z, fits))

    write_atomically(table, write_table)
    files = [result, table]
    for drawing in draw_fits(model, fits):
        files += drawing.save(folder)
    for name in _FIGURES:
        # The same command may draw less than before: with other readings nothing may converge any more.
        if folder / name not in files:
            (folder / name).unlink(missing_ok=True)
    return files


def _described(model: Measurement, z: Array, fits: Sequence[Fit]) -> dict[str, Any]:
    names = [p.name for p in model.parameters]
    labels = _reading_labels(model)
    return {
        "measurement": model.name,
        "reading_unit": model.reading_unit,
        "readings_present": int(np.isfinite(z).sum()),
        "readings_missing": int(np.isnan(z).sum()),
        "parameters": [{"name": p.name, "unit": p.unit} for p in model.parameters],
        "estimators": {
            one.label: {
                "status": one.status.label,
                "message": one.message,
                "estimates": dict(zip(names, plain_numbers(one.x), strict=True)),
                "standard_errors": dict(zip(names, plain_numbers(one.standard_errors), strict=True)),
                "correlation": plain_numbers(one.correlation),
                "chi_square": plain_numbers(one.chi_square),
                "degrees_of_freedom": one.degrees_of_freedom,
                "p": plain_numbers(one.p_value),
                "fits": one.fits,
                "residual_deviation": plain_numbers(one.residual_deviation),
                "whiteness": {
                    "test": "Ljung-Box, p from simulated fits",
                    "statistic": plain_numbers(one.whiteness.statistic),
                    "lags": one.whiteness.lags,
                    "p": plain_numbers(one.whiteness.p_value),
                },
                "outlier_limit": one.outlier_limit,
                "outliers": [
                    {**labels[i], "normalised_residual": plain_numbers(one.normalised[i])}
                    for i in np.flatnonzero(one.outliers)
                ],
                "iterations": one.iterations,
                "simulations": plain_numbers(one.simulations),
            }
            for one in fits
        },
    }


def plain_numbers(value: Any) -> Any:
    """Plain numbers for JSON, which knows no NaN: null in its place."""
    if np.ndim(value):
        return [plain_numbers(v) for v in value]
    number = float(value)
    return number if math.isfinite(number) else None


def _reading_labels(model: Measurement) -> list[dict[str, Any]]:
    columns = model.index
    return [
        {k: v.item() if isinstance(v, np.generic) else v for k, v in zip(columns, row, strict=True)}
        for row in zip(*columns.values(), strict=True)
    ]


def _residual_rows(model: Measurement, z: Array, fits: Sequence[Fit]) -> Iterator[list[Any]]:
    unit = f" [{model.reading_unit}]" if model.reading_unit else ""
    quantities = [f"{name}{unit}" for name in ("reading", "fitted", "residual")]
    yield ["estimator", *model.index, *quantities, "normalised_residual", "outlier"]
    labels = list(zip(*model.index.values(), strict=True))
    for one in fits:
        for i, label in enumerate(labels):
            values = (z[i], z[i] - one.residuals[i], one.residuals[i], one.normalised[i])
            cells = ["" if math.isnan(v) else repr(float(v)) for v in values]
            yield [one.label, *label, *cells, "yes" if one.outliers[i] else "no"]


def with_error(value: float, error: float) -> str:
    """A value with its standard error: two figures of the error, and the value to the same place."""
    if not (math.isfinite(value) and math.isfinite(error) and error > 0):
        return f"{value:.6g}" if math.isfinite(value) else "-"
    place = math.floor(math.log10(error)) - 1
    if float(f"{error:.1e}") >= 10 ** (place + 2):
        place += 1  # 0.0999 rounds to 0.10
    top = max(abs(value), error)
    if 1e-4 <= top < 1e6 and -6 <= place <= 0:
        return f"{value:.{-place}f} ± {error:.{-place}f}"
    if place > 0 and top < 1e6:
        return f"{round(value, -place):.0f} ± {round(error, -place):.0f}"
    figures = min(max(math.floor(math.log10(top)) - place, 0), 15)
    return f"{value:.{figures}e} ± {error:.1e}"


def render(name: str, model: Measurement, fits: Sequence[Fit], width: int) -> Group:
    """The tables for a terminal of that width: as many estimators side by side as there is room for.

    `name` is what the model is called in the title.
    """
    from rich.console import Group

    parts = [*_estimates(name, model, fits, width), _verdicts(fits, width), _notes(fits, width)]
    parts += _outliers(model, fits)
    return Group(*parts)


def _estimates(name: str, model: Measurement, fits: Sequence[Fit], width: int) -> Iterator[Any]:
    from rich.markup import escape
    from rich.table import Table

    columns = [(f.label, [with_error(*pair) for pair in zip(f.x, f.standard_errors, strict=True)]) for f in fits]
    widths = [max(map(len, (label, *cells))) + 2 for label, cells in columns]
    fixed = max(len("parameter"), *(len(p.name) for p in model.parameters))
    fixed += 2 + max(len("unit"), *(len(p.unit) for p in model.parameters))
    start = 0
    while start < len(columns):
        stop, room = start + 1, width - fixed - widths[start]
        while stop < len(columns) and widths[stop] <= room:
            room -= widths[stop]
            stop += 1
        title = f"{escape(name)}: estimate ± standard error" if start == 0 else None
        table = Table(title=title, title_justify="left", title_style="bold", box=None, pad_edge=False, padding=(0, 1))
        table.add_column("parameter", no_wrap=True)
        table.add_column("unit", no_wrap=True)
        for label, _ in columns[start:stop]:
            table.add_column(escape(label), justify="right", overflow="fold")
        for i, parameter in enumerate(model.parameters):
            cells = [cells[i] for _, cells in columns[start:stop]]
            table.add_row(escape(parameter.name), escape(parameter.unit), *cells)
        yield table
        yield ""
        start = stop


def _verdicts(fits: Sequence[Fit], width: int) -> Any:
    from rich.markup import escape
    from rich.table import Table

    title = "Does the model fit?"
    table = Table(title=title, title_justify="left", title_style="bold", box=None, pad_edge=False, padding=(0, 1))
    table.add_column("estimator", overflow="fold", min_width=11)
    table.add_column("status", overflow="fold", min_width=9)
    headings = ("deviation", "chi2", "dof", "p", "white p", "outliers")
    for heading in headings[width < _NARROW :]:
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("fits", no_wrap=True)
    for one in fits:
        numbers = [f"{one.residual_deviation:.4g}", f"{one.chi_square:.4g}", str(one.degrees_of_freedom)]
        numbers += [p_value(one.p_value), p_value(one.whiteness.p_value, LEAST_P), str(int(one.outliers.sum()))]
        status = one.status.label.replace("_", " ")
        table.add_row(escape(one.label), status, *numbers[width < _NARROW :], "yes" if one.fits else "NO")
    return table


def _notes(fits: Sequence[Fit], width: int) -> Any:
    from rich.text import Text

    lines = [
        f"fits: p of chi-square is at least {FIT_LEVEL:g}. white p: Ljung-Box; small where successive residuals"
        " resemble each other." + (" deviation: of the residuals, in the readings' unit." if width >= _NARROW else ""),
        *(f"{one.label}: {one.message}" for one in fits if one.message),
    ]
    return Text("\n".join(lines), style="dim")


def _outliers(model: Measurement, fits: Sequence[Fit]) -> Iterator[Any]:
    from rich.text import Text

    told = [f for f in fits if 0 < f.outliers.sum() <= max(3, _FEW * len(f.outliers))]
    rows = {int(i) for f in told for i in np.flatnonzero(f.outliers)}
    if not rows:
        return
    largest = {i: max(abs(f.normalised[i]) for f in told if f.outliers[i]) for i in rows}
    labels = _reading_labels(model)
    yield ""
    yield Text(f"Outliers: normalised residual beyond ±{told[0].outlier_limit:.2f}", style="bold")
    for i in sorted(rows, key=lambda i: -largest[i])[:_MOST_OUTLIERS]:
        where = ", ".join(f"{k}={v}" for k, v in labels[i].items())
        values = {f.label: float(f.normalised[i]) for f in told if f.outliers[i]}
        if max(values.values()) - min(values.values()) < _ALIKE * largest[i]:
            others = f" ({len(values)} estimators)" if len(values) > 1 else f" ({next(iter(values))})"
            yield Text(f"  {where}: {next(iter(values.values())):.1f}{others}")
        else:
            yield Text(f"  {where}: {', '.join(f'{label} {value:.1f}' for label, value in values.items())}")
    if len(rows) > _MOST_OUTLIERS:
        yield Text(f"  and {len(rows) - _MOST_OUTLIERS} others: see {RESIDUALS}")
