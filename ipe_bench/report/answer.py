"""Estimates from real readings, as files and as tables in the terminal."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.files import write_atomically, write_text
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.statuses import Status
from ipe_bench.measurements.base import Measurement
from ipe_bench.real.estimation import Opened
from ipe_bench.real.examination import Examination
from ipe_bench.real.fits import Fit
from ipe_bench.real.residuals import LEAST_P
from ipe_bench.report import examined
from ipe_bench.report.choice import Which
from ipe_bench.report.words import p_value
from ipe_bench.trials.fit_test import DRAWS
from ipe_bench.trials.thresholds import FIT_LEVEL

if TYPE_CHECKING:
    import pandas as pd
    from rich.console import Group

SCHEMA = 2
RESULT = "estimate.json"
RESIDUALS = "residuals.csv"
PAGE = "estimate.html"
_FIGURES = tuple(f"{name}{suffix}" for name in ("residuals", "ellipses", "likelihood") for suffix in (".png", ".pdf"))
_MOST_OUTLIERS = 8
_FEW = 0.05
"""Above this share of outliers it is the model that is wrong, and a list of readings says nothing."""
_ALIKE = 0.02
LEAST_FIT_P = 1 / (DRAWS + 1)
"""Of the test of fit, where the law of the noise is simulated."""
_FITS = {True: "yes", False: "NO", None: "not tested"}
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


@dataclass(frozen=True)
class Answer:
    """What estimators make of real readings, and what can be signed of it."""

    name: str
    """What the model is called in titles."""
    model: Measurement
    z: Array
    """The readings (m,); NaN where one is missing."""
    fits: list[Fit]
    """One for each estimator, in the order in which they were given."""
    examinations: tuple[Examination, ...]
    """Of the least minimum that was found, and of that with the prior where estimators are told one; none where no
    estimator found any."""
    left_out: str = ""
    """What of the files was left out on purpose."""

    @classmethod
    def to(cls, opened: Opened, name: str = "") -> Answer:
        """The answer to a question; `name` is what the model is called, where that is not its own name."""
        model, fits_and_examinations = opened.scenario.measurement, opened.fitted()
        return cls(name or model.name, model, opened.readings.z, *fits_and_examinations, opened.question.left_out.said)

    @property
    def examination(self) -> Examination | None:
        """The first: that of least squares, unless all estimators were told a prior."""
        return self.examinations[0] if self.examinations else None

    @property
    def passes(self) -> bool:
        """Whether any estimator has an answer that nothing speaks against."""
        least = self.examination is None or self.examination.least
        return least and any(one.passes for one in self.fits)

    def __iter__(self) -> Iterator[Fit]:
        return iter(self.fits)

    def __len__(self) -> int:
        return len(self.fits)

    def __getitem__(self, which: str | int) -> Fit:
        """By label or place."""
        return self.fits[which] if isinstance(which, int) else next(f for f in self.fits if f.label == which)

    def table(self) -> pd.DataFrame:
        """A row per estimator and parameter: estimate, standard error, 95 % interval, and whether the fit passes."""
        import pandas as pd

        found = []
        for one in self.fits:
            columns = zip(one.model.natural_parameters, one.x, one.standard_errors, *one.interval(), strict=True)
            for p, x, error, low, high in columns:
                values = {"estimate": x, "standard_error": error, "low95": low, "high95": high}
                found.append(
                    {"estimator": one.label, "parameter": p.name, "unit": p.unit, **values, "passes": one.passes}
                )
        return pd.DataFrame(found)

    def __str__(self) -> str:
        from rich.console import Console

        console = Console(width=120, file=io.StringIO())
        console.print(render(self, 120))
        return console.file.getvalue()  # type: ignore[attr-defined]

    def _repr_html_(self) -> str:
        return fragment(self)


def write_fits(
    folder: Path, answer: Answer, command: Any, provenance: Mapping[str, Any], *, which: Which = "all"
) -> list[Path]:
    """Writes an answer; each file appears whole or not at all. Returns the files.

    All its figures are main ones: `which` is all, main or none.

    `command` tells one command from another (see `claim`); `provenance` is added to the JSON file and overrides what
    stands there of the same name.
    """
    from ipe_bench.report.figures import likelihood
    from ipe_bench.report.figures.residual_plots import draw_fits

    model, fits, found = answer.model, answer.fits, answer.examination
    result = folder / RESULT
    # First, since it says whose folder this is.
    text = json.dumps({"schema": SCHEMA, "command": command, **_described(answer), **provenance}, indent=1)
    write_atomically(result, lambda path: path.write_text(text + "\n", encoding="utf-8"))
    table = folder / RESIDUALS

    def write_table(path: Path) -> None:
        with path.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows(_residual_rows(answer))

    write_atomically(table, write_table)
    files, figures = [result, table], []
    if which != "none":
        drawings = [*draw_fits(model, fits), *(likelihood.draw(found) if found is not None else ())]
    else:
        drawings = []
    for drawing in drawings:
        written = drawing.save(folder)
        files += written
        figures.append((drawing.title, drawing.caption, written[0].read_bytes()))
    page = folder / PAGE
    write_text(page, whole_page(answer, figures, str(provenance.get("written", ""))))
    files.append(page)
    for name in _FIGURES:
        # The same command may draw less than before: with other readings nothing may converge any more.
        if folder / name not in files:
            (folder / name).unlink(missing_ok=True)
    return files


def _described(answer: Answer) -> dict[str, Any]:
    model, z, fits = answer.model, answer.z, answer.fits
    names = [p.name for p in model.natural_parameters]
    labels = _reading_labels(model)
    return {
        "measurement": model.name,
        "reading_unit": model.reading_unit,
        "readings_present": int(np.isfinite(z).sum()),
        "readings_missing": int(np.isnan(z).sum()),
        "fixed": dict(model.fixed),
        "left_out": answer.left_out,
        "passes": answer.passes,
        "examination": None if answer.examination is None else examined.described(answer.examination, labels),
        "examination_with_prior": next(
            (examined.described(one, labels) for one in answer.examinations if one.with_prior), None
        ),
        "parameters": [{"name": p.name, "unit": p.unit} for p in model.natural_parameters],
        "estimators": {
            one.label: {
                "status": one.status.label,
                "message": one.message,
                "estimates": dict(zip(names, examined.numbers(one.x), strict=True)),
                "standard_errors": dict(zip(names, examined.numbers(one.standard_errors), strict=True)),
                "intervals95": dict(zip(names, examined.numbers(np.transpose(one.interval())), strict=True)),
                "correlation": examined.numbers(one.correlation),
                "chi_square": examined.numbers(one.chi_square),
                "degrees_of_freedom": one.degrees_of_freedom,
                "p": examined.numbers(one.p_value),
                "fits": one.fits,
                "passes": one.passes,
                "with_prior": one.with_prior,
                "on_bounds": {names[k]: value for k, value in one.held_at.items()},
                "noise_level_estimated": None if one.level is None else examined.numbers(one.level),
                "residual_deviation": examined.numbers(one.residual_deviation),
                "whiteness": {
                    "test": "Ljung-Box, p from simulated fits",
                    "statistic": examined.numbers(one.whiteness.statistic),
                    "lags": one.whiteness.lags,
                    "p": examined.numbers(one.whiteness.p_value),
                },
                "outlier_limit": one.outlier_limit,
                "outliers": [
                    {**labels[i], "normalised_residual": examined.numbers(one.normalised[i])}
                    for i in np.flatnonzero(one.outliers)
                ],
                "iterations": one.iterations,
                "simulations": examined.numbers(one.simulations),
            }
            for one in fits
        },
    }


def _reading_labels(model: Measurement) -> list[dict[str, Any]]:
    columns = model.index
    return [
        {k: v.item() if isinstance(v, np.generic) else v for k, v in zip(columns, row, strict=True)}
        for row in zip(*columns.values(), strict=True)
    ]


def _residual_rows(answer: Answer) -> Iterator[list[Any]]:
    model, z, found = answer.model, answer.z, answer.examination
    unit = f" [{model.reading_unit}]" if model.reading_unit else ""
    quantities = [f"{name}{unit}" for name in ("reading", "fitted", "residual")]
    influence = ["leverage", "cook", "shift", f"fitted_error{unit}", f"prediction_error{unit}"]
    yield ["estimator", *model.index, *quantities, "normalised_residual", "outlier", *influence]
    labels = list(zip(*model.index.values(), strict=True))
    for one in answer.fits:
        more: tuple[Array, ...] = ()
        if found is not None and one.label == found.label:
            more = (*_influences(found), found.fitted_errors, found.new_errors)
        # Of the estimator that is examined, the readings that are missing are predicted, too.
        fitted = z - one.residuals
        if found is not None and more:
            fitted = np.where(np.isnan(z), found.fitted, fitted)
        for i, label in enumerate(labels):
            values = (z[i], fitted[i], one.residuals[i], one.normalised[i])
            further = [_cell(column[i]) for column in more] or [""] * len(influence)
            outlier = "yes" if one.outliers[i] else "no"
            yield [one.label, *label, *map(_cell, values), outlier, *further]


def _influences(found: Examination) -> tuple[Array, Array, Array]:
    return found.influence.leverage, found.influence.cook, found.influence.shift


def _cell(value: float) -> str:
    return "" if math.isnan(value) else repr(float(value))


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


def render(answer: Answer, width: int) -> Group:
    """The tables for a terminal of that width: as many estimators side by side as there is room for."""
    from rich.console import Group

    model, fits = answer.model, answer.fits
    parts = [*_estimates(answer.name, model, fits, width), _verdicts(fits, width), _notes(answer, width)]
    parts += _outliers(model, fits)
    for found in answer.examinations:
        if answer[found.label].passes:
            parts += ["", examined.table(found), *_remarks(answer, found)]
        elif not found.least:
            parts += ["", *_remarks(answer, found)]
    return Group(*parts)


def _remarks(answer: Answer, found: Examination) -> Iterator[Any]:
    from rich.text import Text

    for remark in examined.remarks(found, _reading_labels(answer.model)):
        yield Text(remark, style="bold" if remark.isupper() or remark.split(":")[0].isupper() else "dim")


def _estimates(name: str, model: Measurement, fits: Sequence[Fit], width: int) -> Iterator[Any]:
    from rich.markup import escape
    from rich.table import Table

    columns = [(_heading(f), _cells(f)) for f in fits]
    widths = [max(map(len, (label, *cells))) + 2 for label, cells in columns]
    fixed = max(len("parameter"), *(len(p.name) for p in model.natural_parameters))
    fixed += 2 + max(len("unit"), *(len(p.unit) for p in model.natural_parameters))
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
        for i, parameter in enumerate(model.natural_parameters):
            cells = [cells[i] for _, cells in columns[start:stop]]
            table.add_row(escape(parameter.name), escape(parameter.unit), *cells)
        yield table
        yield ""
        start = stop


def _heading(one: Fit) -> str:
    return one.label if one.passes else f"{one.label}: {_failing(one)}"


def _failing(one: Fit) -> str:
    """Why a fit is not an answer."""
    return "MISFIT" if one.status is Status.CONVERGED else one.status.label.replace("_", " ").upper()


def _cells(one: Fit) -> list[str]:
    """Estimates with their errors; what is not an answer stands in brackets, without errors that would be wrong."""
    if one.passes:
        return [with_error(*pair) for pair in zip(one.x, one.standard_errors, strict=True)]
    return [f"({value:.4g})" if math.isfinite(value) else "-" for value in one.x]


def _verdicts(fits: Sequence[Fit], width: int) -> Any:
    from rich.markup import escape
    from rich.table import Table

    title = "Does the model fit?"
    table = Table(title=title, title_justify="left", title_style="bold", box=None, pad_edge=False, padding=(0, 1))
    table.add_column("estimator", overflow="fold", min_width=11)
    table.add_column("status", overflow="fold", min_width=9)
    shown = _sizes_shown(fits, width)
    for heading in (*shown, "white p", "outliers"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("fits", no_wrap=True)
    for one in fits:
        sizes = {
            "deviation": _number(one.residual_deviation),
            "chi2": _number(one.chi_square),
            "dof": str(one.degrees_of_freedom),
            "p": _fit_p(one),
        }
        numbers = [sizes[name] for name in shown]
        numbers += [p_value(one.whiteness.p_value, LEAST_P), str(int(one.outliers.sum()))]
        status = one.status.label.replace("_", " ")
        table.add_row(escape(one.label), status, *numbers, _FITS[one.fits])
    return table


def _sizes_shown(fits: Sequence[Fit], width: int) -> tuple[str, ...]:
    """What is told of the size of the residuals: where it makes the level, chi-square is the degrees of freedom."""
    if all(one.level is not None for one in fits):
        return ("deviation", "dof")
    return ("deviation", "chi2", "dof", "p")[width < _NARROW :]


def _number(value: float) -> str:
    return f"{value:.4g}" if math.isfinite(value) else "-"


def _fit_p(one: Fit) -> str:
    """p of the fit; a limit where it is the least that simulated fits can tell."""
    return p_value(one.p_value, LEAST_FIT_P if one.p_value == LEAST_FIT_P else 0.0)


def _notes(answer: Answer, width: int) -> Any:
    from rich.text import Text

    fits = answer.fits
    lines = [
        f"fits: p of chi-square is at least {FIT_LEVEL:g}. white p: Ljung-Box; small where successive residuals"
        " resemble each other."
        + (" deviation: of the residuals, in the readings' unit." if "deviation" in _sizes_shown(fits, width) else ""),
        *(f"{one.label}: {one.message}" for one in fits if one.message),
        *_on_levels(fits),
        *_on_priors(fits),
        *_on_bounds(fits),
    ]
    failing = [one.label for one in fits if not one.passes]
    if fits[0].model.fixed:
        lines.append("Fixed: " + ", ".join(f"{name} = {value:g}" for name, value in fits[0].model.fixed.items()))
    if answer.left_out:
        lines.append(f"Left out on purpose: {answer.left_out}.")
    if failing:
        lines.append(
            f"In brackets: {', '.join(failing)}. Not an answer: errors are not given, for they would be wrong."
        )
    return Text("\n".join(lines), style="dim")


def _on_levels(fits: Sequence[Fit]) -> Iterator[str]:
    """What is to be said where the level of the noise is estimated."""
    unknown = [one for one in fits if one.level is not None]
    if not unknown:
        return
    yield (
        "The level of the noise is estimated from the residuals: standard errors are scaled by it, intervals are those"
        " of Student's t, and the size of the residuals cannot test the model."
    )
    suspect = [one.label for one in unknown if one.whiteness.p_value < FIT_LEVEL]
    if suspect:
        yield (
            f"{', '.join(suspect)}: successive residuals resemble each other (white p below {FIT_LEVEL:g}); the model"
            " is in doubt, and standard errors are too small."
        )


def _on_priors(fits: Sequence[Fit]) -> Iterator[str]:
    told = [one.label for one in fits if one.with_prior]
    if told:
        yield f"{', '.join(told)}: with a prior, which counts in the standard errors as further readings would."


def _on_bounds(fits: Sequence[Fit]) -> Iterator[str]:
    for one in fits:
        if one.held is not None:
            names = [one.model.natural_parameters[k].name for k in one.held_at]
            bounds = ", ".join(f"{name} = {value:g}" for name, value in zip(names, one.held_at.values(), strict=True))
            yield (
                f"{one.label}: on its bound: {bounds}; the readings want it beyond. It has no error, and those of the"
                " others are with it held there."
            )


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


def fragment(answer: Answer) -> str:
    """The tables as a piece of HTML, for a notebook."""
    from html import escape

    failing = [f"{one.label}: {_failing(one)}" for one in answer.fits if not one.passes]
    header = "".join(f"<th>{escape(_heading(one))}</th>" for one in answer.fits)
    cells = [_cells(one) for one in answer.fits]
    body = "".join(
        f"<tr><td>{escape(p.name)}</td><td>{escape(p.unit)}</td>{''.join(f'<td>{c[i]}</td>' for c in cells)}</tr>"
        for i, p in enumerate(answer.model.natural_parameters)
    )
    parts = [f"<h3>{escape(answer.name)}: estimate ± standard error</h3>"]
    parts.append(f"<table><thead><tr><th>parameter</th><th>unit</th>{header}</tr></thead><tbody>{body}</tbody></table>")
    verdicts = "".join(
        f"<tr><td>{escape(one.label)}</td><td>{one.status.label}</td><td>{_number(one.residual_deviation)}</td>"
        f"<td>{_number(one.chi_square) if one.level is None else '-'}</td>"
        f"<td>{one.degrees_of_freedom}</td><td>{_fit_p(one)}</td><td>{p_value(one.whiteness.p_value, LEAST_P)}</td>"
        f"<td>{int(one.outliers.sum())}</td><td>{_FITS[one.fits]}</td></tr>"
        for one in answer.fits
    )
    names = ("estimator", "status", "deviation", "chi-square", "degrees of freedom", "p", "white p", "outliers", "fits")
    head = "".join(f"<th>{name}</th>" for name in names)
    parts.append(f"<h3>Does the model fit?</h3><table><thead><tr>{head}</tr></thead><tbody>{verdicts}</tbody></table>")
    notes = [*_on_levels(answer.fits), *_on_priors(answer.fits), *_on_bounds(answer.fits)]
    if failing:
        notes.append(f"In brackets, and not an answer: {', '.join(failing)}.")
    if answer.left_out:
        notes.append(f"Left out on purpose: {answer.left_out}.")
    for found in answer.examinations:
        notes += examined.remarks(found, _reading_labels(answer.model))
        if not answer[found.label].passes:
            continue
        head = "".join(f"<th>{name}</th>" for name in examined.HEADINGS)
        lines = "".join(
            f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in examined.rows(found)
        )
        parts.append(
            f"<h3>{escape(examined.title(found))}</h3><table><thead><tr>{head}</tr></thead>"
            f"<tbody>{lines}</tbody></table>"
        )
    return "".join([*parts, *(f"<p>{escape(note)}</p>" for note in notes)])


_STYLE = """
:root { color-scheme: light dark; font: 16px/1.5 system-ui, sans-serif; }
body { max-width: 60rem; margin: 2rem auto; padding: 0 1rem; }
table { border-collapse: collapse; display: block; overflow-x: auto; font-variant-numeric: tabular-nums; }
th, td { padding: .2rem .7rem; text-align: right; border-bottom: 1px solid #8884; }
th:first-child, td:first-child { text-align: left; }
img { max-width: 100%; background: white; }
figcaption { font-size: .9rem; opacity: .8; }
"""


def whole_page(answer: Answer, figures: Sequence[tuple[str, str, bytes]], written: str) -> str:
    """estimate.html: one file with everything in it; `figures` are titles, captions and PNGs."""
    import base64
    from html import escape

    verdict = "an answer that passes" if answer.passes else "NO ANSWER THAT PASSES"
    shown = "".join(
        f'<figure><img alt="{escape(title)}" src="data:image/png;base64,{base64.b64encode(png).decode()}">'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
        for title, caption, png in figures
    )
    title = f"{answer.name}: estimates"
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{_STYLE}</style></head><body>'
        f"<h1>{escape(title)}</h1><p>{int(np.isfinite(answer.z).sum())} readings; {verdict}. {escape(written)}</p>"
        f"{fragment(answer)}{shown}</body></html>\n"
    )
