"""Estimates from real readings: the tables and sentences of an answer, and its files.

What is known of an answer beyond its standard errors stands behind it: intervals in three ways, and remarks.
"""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ipe_bench.basics.files import write_text
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.statuses import Status
from ipe_bench.measurements.base import Measurement
from ipe_bench.real.estimation import Opened
from ipe_bench.real.examination import CONFIDENCE, Examination
from ipe_bench.real.fits import Fit
from ipe_bench.real.residuals import LEAST_P
from ipe_bench.report.choice import Which
from ipe_bench.report.folders import draw_into, named, picked, plain, write_json, write_rows
from ipe_bench.report.table import Part, Strong, Table, environment, html, terminal, texts, words
from ipe_bench.report.words import enumerate_few, p_value
from ipe_bench.trials.fit_test import DRAWS
from ipe_bench.trials.thresholds import FIT_LEVEL

if TYPE_CHECKING:
    import pandas as pd

    from ipe_bench.report.figures.drawing import Drawing

SCHEMA = 2
RESULT = "estimate.json"
RESIDUALS = "residuals.csv"
PAGE = "estimate.html"
_FIGURES = tuple(f"{name}{suffix}" for name in ("residuals", "ellipses", "likelihood") for suffix in (".png", ".pdf"))
FILES = (RESIDUALS, *_FIGURES)
LEAST_FIT_P = 1 / (DRAWS + 1)
"""Least p of the test of fit if the law of the noise is simulated."""
_MOST_OUTLIERS = 8
_FEW = 0.05
"""Share of outliers above which the model is wrong, and a list of readings says nothing."""
_ALIKE = 0.02
"""Relative difference of normalised residuals up to which estimators are shown together."""
_FITS = {True: "yes", False: "NO", None: "not tested"}
_COLLINEAR = 10.0
"""Collinearity index from which on the readings hardly tell parameters apart (Brun, Reichert and Künsch, Water
Resources Research 37)."""
_INFLUENTIAL = 1.0
"""Standard errors by which a parameter moves without a reading from which on that reading is named."""
_MOST_READINGS = 5
_MOST_MINIMA = 3
_SMALL_SHARE = 0.1
"""Share of the largest component below which a component of the least observable direction is left out."""


@dataclass(frozen=True)
class Answer:
    """What estimators make of real readings, and what can be signed of it."""

    name: str
    """Name of the model in titles."""
    model: Measurement
    z: Array
    """Readings (m,); NaN if one is missing."""
    fits: list[Fit]
    """One for each estimator, in the order in which they were given."""
    examinations: tuple[Examination, ...]
    """That of the least minimum that was found, and that of the minimum with the prior if estimators are told one;
    none if no estimator found any."""
    left_out: str = ""
    """What of the files was left out on purpose."""

    @classmethod
    def to(cls, opened: Opened, name: str = "") -> Answer:
        """The answer to a question; `name` is what the model is called if that is not its own name."""
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
            columns = zip(one.model.physical_parameters, one.x, one.standard_errors, *one.interval(), strict=True)
            for p, x, error, low, high in columns:
                values = {"estimate": x, "standard_error": error, "low95": low, "high95": high}
                found.append(
                    {"estimator": one.label, "parameter": p.name, "unit": p.unit, **values, "passes": one.passes}
                )
        return pd.DataFrame(found)

    def __str__(self) -> str:
        from rich.console import Console

        console = Console(width=120, file=io.StringIO())
        console.print(terminal(contents(self), 120))
        return console.file.getvalue()  # type: ignore[attr-defined]

    def _repr_html_(self) -> str:
        return html(contents(self))


# Tables and sentences ------------------------------------------------------------------------------------------------


def contents(answer: Answer) -> Iterator[Part]:
    """The tables and sentences of an answer, in order."""
    yield _estimates(answer)
    yield _verdicts(answer)
    yield from _outliers(answer)
    for found in answer.examinations:
        passes = answer[found.label].passes
        if passes:
            yield intervals(found)
        if passes or not found.least:
            for remark in remarks(found, _reading_labels(answer.model)):
                yield Strong(remark) if remark.split(":")[0].isupper() else remark


def _estimates(answer: Answer) -> Table:
    parameters = answer.model.physical_parameters
    columns = [words("parameter", [p.name for p in parameters]), words("unit", [p.unit for p in parameters])]
    columns += [texts(_heading(one), _cells(one)) for one in answer.fits]
    return Table("estimates", f"{answer.name}: estimate ± standard error", "", columns, repeated=2)


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


def with_error(value: float, error: float) -> str:
    """A value with its standard error: two figures of the error, and the value to the same place."""
    if not (math.isfinite(value) and math.isfinite(error) and error > 0):
        return _number(value, 6)
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


def _number(value: float, figures: int = 4) -> str:
    return f"{value:.{figures}g}" if math.isfinite(value) else "-"


def _verdicts(answer: Answer) -> Table:
    """Whether each fit passes; if the residuals make the level of the noise, chi-square is the degrees of freedom and
    is left out."""
    fits = answer.fits
    tested = [one for one in fits if one.level is None]
    columns = [
        words("estimator", [one.label for one in fits]),
        words("status", [one.status.label.replace("_", " ") for one in fits]),
        words("fits", [_FITS[one.fits] for one in fits]),
    ]
    if tested:
        columns += [
            texts("p", [_fit_p(one) for one in fits]),
            texts("chi2", [_number(one.chi_square) if one.level is None else "-" for one in fits]),
        ]
    columns += [
        texts("dof", [str(one.degrees_of_freedom) for one in fits]),
        texts("white p", [p_value(one.whiteness.p_value, LEAST_P) for one in fits]),
        texts("outliers", [str(int(one.outliers.sum())) for one in fits]),
        texts("deviation", [_number(one.residual_deviation) for one in fits]),
    ]
    return Table("verdicts", "Does the model fit?", "", columns, notes=list(_notes(answer)), repeated=1)


def _fit_p(one: Fit) -> str:
    """The p-value of the fit as text; an upper limit if it is the least that simulated fits resolve."""
    return p_value(one.p_value, LEAST_FIT_P if one.p_value == LEAST_FIT_P else 0.0)


def _notes(answer: Answer) -> Iterator[str]:
    fits = answer.fits
    yield (
        f"fits: p of chi-square is at least {FIT_LEVEL:g}. white p: Ljung-Box; small where successive residuals"
        " resemble each other. deviation: of the residuals, in the readings' unit."
    )
    yield from (f"{one.label}: {one.message}" for one in fits if one.message)
    for one in fits:
        if one.beaten_by:
            yield f"{one.label}: {one.beaten_by} found a better fit, by more than chance explains; this is no answer."
        if one.undetermined:
            yield (
                f"{one.label}: the readings do not determine {'; '.join(one.undetermined)}; fix parameters, or give"
                " prior, until they do."
            )
    unknown = [one for one in fits if one.level is not None]
    if unknown:
        yield (
            "The level of the noise is estimated from the residuals: standard errors are scaled by it, intervals are"
            " those of Student's t, and the size of the residuals cannot test the model."
        )
    suspect = [one.label for one in unknown if one.whiteness.p_value < FIT_LEVEL]
    if suspect:
        yield (
            f"{', '.join(suspect)}: successive residuals resemble each other (white p below {FIT_LEVEL:g}); the model"
            " is in doubt, and standard errors are too small."
        )
    told = [one.label for one in fits if one.with_prior]
    if told:
        yield f"{', '.join(told)}: with a prior, which counts in the standard errors as further readings would."
    for one in fits:
        if one.held is not None:
            names = [one.model.physical_parameters[k].name for k in one.held_at]
            bounds = ", ".join(f"{name} = {value:g}" for name, value in zip(names, one.held_at.values(), strict=True))
            yield (
                f"{one.label}: on its bound: {bounds}; the readings want it beyond. It has no error, and those of the"
                " others are with it held there."
            )
    if answer.model.fixed:
        yield "Fixed: " + ", ".join(f"{name} = {value:g}" for name, value in answer.model.fixed.items())
    if answer.left_out:
        yield f"Left out on purpose: {answer.left_out}."
    failing = [one.label for one in fits if not one.passes]
    if failing:
        yield f"In brackets: {', '.join(failing)}. Not an answer: errors are not given, for they would be wrong."


def _outliers(answer: Answer) -> Iterator[Table]:
    told = [f for f in answer.fits if 0 < f.outliers.sum() <= max(3, _FEW * len(f.outliers))]
    rows = {int(i) for f in told for i in np.flatnonzero(f.outliers)}
    if not rows:
        return
    largest = {i: max(abs(f.normalised[i]) for f in told if f.outliers[i]) for i in rows}
    listed = sorted(rows, key=lambda i: -largest[i])[:_MOST_OUTLIERS]
    labels, shown = _reading_labels(answer.model), []
    for i in listed:
        values = {f.label: float(f.normalised[i]) for f in told if f.outliers[i]}
        text = ", ".join(f"{label} {value:.1f}" for label, value in values.items())
        if max(values.values()) - min(values.values()) < _ALIKE * largest[i]:
            whose = f"{len(values)} estimators" if len(values) > 1 else next(iter(values))
            text = f"{next(iter(values.values())):.1f} ({whose})"
        shown.append(text)
    columns = [words("reading", [_where(labels[i]) for i in listed]), words("residual", shown)]
    more = [f"And {len(rows) - _MOST_OUTLIERS} others: see {RESIDUALS}."] if len(rows) > _MOST_OUTLIERS else []
    title = f"Outliers: normalised residual beyond ±{told[0].outlier_limit:.2f}"
    yield Table("outliers", title, "", columns, notes=more)


def _where(label: Mapping[str, Any]) -> str:
    return ", ".join(f"{k}={v}" for k, v in label.items())


def _reading_labels(model: Measurement) -> list[dict[str, Any]]:
    columns = model.index
    return [{k: plain(v) for k, v in zip(columns, row, strict=True)} for row in zip(*columns.values(), strict=True)]


def intervals(found: Examination) -> Table:
    """Three intervals of each parameter; of one on a bound, that of its profile."""
    inside, on_bounds = found.model.physical_parameters, found.on_bounds
    ends = [(one.low, one.high) for one in found.profiles] + [tuple(sorted((b.bound, b.other))) for b in on_bounds]
    absent = ["-"] * len(on_bounds)
    prior = " with its prior" if found.with_prior else ""
    return Table(
        "intervals",
        f"{CONFIDENCE:.0%} intervals of {found.label}{prior}, by three ways".replace("%", " %"),
        "",
        [
            words("parameter", [p.name for p in (*inside, *(b.parameter for b in on_bounds))]),
            words("unit", [p.unit for p in (*inside, *(b.parameter for b in on_bounds))]),
            texts("standard error", [*map(interval, *found.wald), *absent]),
            texts("profile", [interval(*pair) for pair in ends]),
            texts("bootstrap", [*map(interval, found.bootstrap.low, found.bootstrap.high), *absent]),
        ],
        repeated=2,
    )


def interval(low: float, high: float) -> str:
    """Both ends to a hundredth of the width; infinite ends as such."""
    width = high - low
    if not math.isfinite(width) or width <= 0:
        return f"{low:.6g} … {high:.6g}".replace("-inf", "−∞").replace("inf", "∞").replace("nan", "-")
    place = max(0, 2 - math.floor(math.log10(width)))
    largest = max(abs(low), abs(high))
    if place > 8 or largest >= 1e7 or largest < 1e-3:
        figures = min(15, max(1, math.floor(math.log10(largest)) - math.floor(math.log10(width)) + 2))
        return f"{low:.{figures}e} … {high:.{figures}e}"
    return f"{low:.{place}f} … {high:.{place}f}"


def remarks(found: Examination, labels: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """What a reader should know before signing, a sentence each."""
    names = [p.name for p in found.model.physical_parameters]

    def at(x: Array) -> str:
        return ", ".join(f"{n} = {v:.5g}" for n, v in zip(names, x, strict=True))

    if not found.least:
        best = found.minima[0]
        yield (
            f"NOT THE LEAST MINIMUM: chi-square is {best.chi_square:.5g} at {at(best.x)}; start there, or choose an"
            " estimator that searches, such as multiscale_lm."
        )
    for one in found.ambiguous[:_MOST_MINIMA]:
        yield f"AMBIGUOUS: the readings fit as well at {at(one.x)} (chi-square {one.chi_square:.5g})."
    bent = [n for n, p in zip(names, found.profiles, strict=True) if p.bent]
    if bent:
        yield f"Profiles that are no parabola: {', '.join(bent)}; trust their profile intervals, see likelihood.png."
    unlimited = [n for n, p in zip(names, found.profiles, strict=True) if not math.isfinite(p.high - p.low)]
    if unlimited:
        yield f"The readings set no limit to one side of {', '.join(unlimited)}."
    for one in found.on_bounds:
        yield (
            f"{one.parameter.name}: its estimate is on the bound {one.bound:g}, which is one end of its interval; the"
            " other is where the profile has risen as far as inside of bounds, so it holds the true value at least as"
            " often as it says. Profiles of the others let it move inwards; their standard errors do not."
        )
    if found.with_prior:
        yield (
            f"Intervals of {found.label} count the prior as further readings: profiles are of the penalised likelihood,"
            " and the bootstrap draws the prior's means, too."
        )
    if len(names) > 1:
        yield _direction(found, names)
    shift = np.nan_to_num(found.influence.shift, nan=0.0)
    for i in [i for i in np.argsort(-shift)[:_MOST_READINGS] if shift[i] >= _INFLUENTIAL]:
        where = _where(labels[i])
        yield f"Without the reading {where} a parameter would move by {shift[i]:.1f} standard errors."
    drawn, converged = found.bootstrap.drawn, found.bootstrap.converged
    if converged < drawn:
        yield f"Bootstrap: {drawn - converged} of {drawn} simulated sets of readings have no answer."


def _direction(found: Examination, names: Sequence[str]) -> str:
    weights = found.direction.weights / found.standard_errors
    told = np.abs(weights) >= _SMALL_SHARE * np.abs(weights).max()
    parts = [f"{n} {w:+.3g}" for w, n, shown in zip(found.direction.weights, names, told, strict=True) if shown]
    index = found.direction.collinearity
    verdict = ": the readings hardly tell these apart" if index >= _COLLINEAR else ""
    return (
        f"Least observable: {enumerate_few(parts, len(parts))} together, which changes all readings by {1 / index:.2g}"
        f" standard deviations; collinearity index {index:.3g}{verdict}."
    )


# Files ---------------------------------------------------------------------------------------------------------------


def write_fits(
    folder: Path, answer: Answer, command: Any, provenance: Mapping[str, Any], *, which: Which = "all"
) -> list[Path]:
    """Writes an answer; each file appears whole or not at all. Returns the files.

    All its figures are main ones: `which` is all, main or none.

    `command` tells one command from another (see `claim`); `provenance` is added to the JSON file and overrides what
    stands there of the same name.
    """
    from ipe_bench.report.figures.readings import draw_fits, draw_profiles

    found = answer.examination
    files = [
        write_json(folder / RESULT, SCHEMA, command, {**described(answer), **provenance}),
        write_rows(folder / RESIDUALS, _residual_rows(answer)),
    ]
    drawings = []
    if which != "none":
        drawings = [*draw_fits(answer.model, answer.fits), *(draw_profiles(found) if found is not None else ())]
    files += draw_into(folder, drawings, _FIGURES)
    write_text(folder / PAGE, whole_page(answer, folder, drawings, str(provenance.get("written", ""))))
    return [*files, folder / PAGE]


def whole_page(answer: Answer, folder: Path, drawings: Sequence[Drawing], written: str) -> str:
    """The page estimate.html as one file that includes the figures of the folder."""
    return (
        environment()
        .get_template("answer.html.j2")
        .render(
            title=f"{answer.name}: estimates",
            readings=int(np.isfinite(answer.z).sum()),
            verdict="an answer that passes" if answer.passes else "NO ANSWER THAT PASSES",
            written=written,
            parts=list(contents(answer)),
            figures=[(d, base64.b64encode((folder / f"{d.name}.png").read_bytes()).decode()) for d in drawings],
        )
    )


def described(answer: Answer) -> dict[str, Any]:
    """Everything, as plain data for JSON."""
    model, z = answer.model, answer.z
    labels = _reading_labels(model)
    with_prior = next((one for one in answer.examinations if one.with_prior), None)
    return {
        "measurement": model.name,
        "reading_unit": model.reading_unit,
        "readings_present": int(np.isfinite(z).sum()),
        "readings_missing": int(np.isnan(z).sum()),
        "fixed": dict(model.fixed),
        "left_out": answer.left_out,
        "passes": answer.passes,
        "examination": answer.examination and _examined(answer.examination, labels),
        "examination_with_prior": with_prior and _examined(with_prior, labels),
        "parameters": [picked(p, "name", "unit") for p in model.physical_parameters],
        "estimators": {one.label: _fitted(one, labels) for one in answer.fits},
    }


def _fitted(one: Fit, labels: list[dict[str, Any]]) -> dict[str, Any]:
    names, white = [p.name for p in one.model.physical_parameters], one.whiteness
    outliers = np.flatnonzero(one.outliers)
    return {
        "status": one.status.label,
        "estimates": named(names, one.x),
        "standard_errors": named(names, one.standard_errors),
        "intervals95": named(names, np.transpose(one.interval())),
        "p": plain(one.p_value),
        "on_bounds": {names[k]: value for k, value in one.held_at.items()},
        "undetermined": list(one.undetermined),
        "noise_level_estimated": plain(one.level),
        "whiteness": {
            "test": "Ljung-Box, p from simulated fits",
            "p": plain(white.p_value),
            **picked(white, "statistic", "lags"),
        },
        "outliers": [{**labels[i], "normalised_residual": plain(one.normalised[i])} for i in outliers],
        **picked(one, "message", "correlation", "chi_square", "degrees_of_freedom", "fits", "passes", "with_prior"),
        **picked(one, "beaten_by", "residual_deviation", "outlier_limit", "iterations", "simulations"),
    }


def _examined(found: Examination, labels: list[dict[str, Any]]) -> dict[str, Any]:
    names, bootstrap = [p.name for p in found.model.physical_parameters], found.bootstrap
    profiles = zip(names, found.profiles, strict=True)
    return {
        "estimator": found.label,
        "confidence": CONFIDENCE,
        "estimates": named(names, found.x),
        "standard_errors": named(names, found.standard_errors),
        "intervals": {
            "standard_error": named(names, np.transpose(found.wald)),
            "profile": named(names, [(p.low, p.high) for p in found.profiles]),
            "bootstrap": named(names, np.column_stack([bootstrap.low, bootstrap.high])),
        },
        "profiles": {name: picked(p, "values", "zeta", "bent") for name, p in profiles},
        "bootstrap": {**picked(bootstrap, "drawn", "converged"), "bias": named(names, bootstrap.bias)},
        "least_observable": {
            "direction": named(names, found.direction.weights),
            "collinearity_index": plain(found.direction.collinearity),
        },
        "minima": [
            {"estimates": named(names, one.x), "starts": one.found, **picked(one, "chi_square", "as_good")}
            for one in found.minima
        ],
        "is_least_minimum": found.least,
        "with_prior": found.with_prior,
        "on_bounds": {one.parameter.name: plain([one.bound, one.other]) for one in found.on_bounds},
        "remarks": list(remarks(found, labels)),
    }


def _residual_rows(answer: Answer) -> Iterator[list[Any]]:
    """A row per estimator and reading; of the estimator that is examined, with the influence of each reading, and with
    predictions of those that are missing."""
    model, z, found = answer.model, answer.z, answer.examination
    unit = f" [{model.reading_unit}]" if model.reading_unit else ""
    influence = ["leverage", "cook", "shift", f"fitted_error{unit}", f"prediction_error{unit}"]
    quantities = [f"{name}{unit}" for name in ("reading", "fitted", "residual")]
    yield ["estimator", *model.index, *quantities, "normalised_residual", "outlier", *influence]
    labels = list(zip(*model.index.values(), strict=True))
    for one in answer.fits:
        more: tuple[Array, ...] = (np.full(len(z), np.nan),) * len(influence)
        fitted = z - one.residuals
        if found is not None and one.label == found.label:
            parts = found.influence
            more = (parts.leverage, parts.cook, parts.shift, found.fitted_errors, found.new_errors)
            fitted = np.where(np.isnan(z), found.fitted, fitted)
        for i, label in enumerate(labels):
            values = (z[i], fitted[i], one.residuals[i], one.normalised[i])
            outlier = "yes" if one.outliers[i] else "no"
            yield [one.label, *label, *map(_cell, values), outlier, *(_cell(column[i]) for column in more)]


def _cell(value: float) -> str:
    return "" if math.isnan(value) else repr(float(value))
