"""Writes the answer to real readings: tables and sentences for a reader, and files."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from itertools import compress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import numpy as np

from ipe_bench.basics.errors import unknown
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.statuses import Status
from ipe_bench.measurements.base import Measurement, with_unit
from ipe_bench.measurements.function import title_of
from ipe_bench.measurements.identifiability import structure
from ipe_bench.measurements.known import ConstrainedModel
from ipe_bench.real.estimation import Question, nearer_starts
from ipe_bench.real.examination import CONFIDENCE, Examination
from ipe_bench.real.fits import TOO_WELL, Fit
from ipe_bench.real.residuals import LEAST_P
from ipe_bench.real.search import LABEL as SEARCH
from ipe_bench.real.unlimited import limits_of
from ipe_bench.report.page.writer import write_files, write_result
from ipe_bench.report.tables.table import (
    Fact,
    Legend,
    Part,
    Shown,
    Strong,
    Table,
    naming,
    texts,
    words,
)
from ipe_bench.report.words import enumerate_few, p_value
from ipe_bench.trials.fit_test import DRAWS
from ipe_bench.trials.thresholds import FIT_LEVEL

if TYPE_CHECKING:
    import pandas as pd

    from ipe_bench.report.figures.drawing import Drawing
    from ipe_bench.report.progress import Shows

NAME = "estimate"
RESIDUALS = "residuals.csv"
SCHEMA = 3
FILES = (RESIDUALS, "fit.png", "residuals.png", "residuals.pdf")
LEAST_FIT_P = 1 / (DRAWS + 1)
"""Least p of the test of fit if the law of the noise is simulated."""
_MOST_OUTLIERS = 8
_FEW = 0.05
"""Share of outliers above which the model is wrong, and no list of readings helps."""
_FITS = {True: "yes", False: "NO", None: "not tested"}
_INFLUENTIAL = 1.0
"""Standard errors by which a parameter moves without a reading from which on that reading is
named."""
_DOES = {
    "auto": "searches for the best fit",
    "linear_lse": "takes one linear step from the start",
    "levenberg_marquardt": "is damped least squares",
}
"""What the usual estimators do."""
_HIDDEN = 1e-3
"""Share of its error below which a value is written with figures of its own."""
_MOST_OUTPUTS = 3
"""Outputs whose residuals' deviations have columns in a table."""
_DEVIATION = " deviation is the standard deviation of the residuals, in the unit of the readings."
_MOST_FIGURES = 12
"""Figures beyond which two numbers are not written to one place."""
_FEW_FIGURES = 4
"""Figures up to which a large number is written with an exponent."""
_MOST_READINGS = 5
_NONLINEAR = "The model is strongly nonlinear"
_MOST_MINIMA = 3


T = TypeVar("T")


class Labelled(Shown, Generic[T]):
    """Shows parts that are found by their labels, and in their order."""

    @property
    @abstractmethod
    def each(self) -> Sequence[Any]:
        """The parts, which have a `label`."""

    def __iter__(self) -> Iterator[T]:
        return iter(self.each)

    def __len__(self) -> int:
        return len(self.each)

    def __getitem__(self, which: str | int) -> T:
        """Returns the part at a place, or at its label.

        Raises:
            KeyError: there is no such label; those that there are follow, the nearest first.
        """
        if isinstance(which, int):
            return self.each[which]
        labels = [one.label for one in self.each]
        if which not in labels:
            raise KeyError(f"{which}: {unknown(which, labels, 'label')}")
        return self.each[labels.index(which)]


@dataclass(frozen=True)
class Answer(Labelled[Fit]):
    """Holds the fits of estimators to real readings, and the examination of the fit with the least
    minimum."""

    name: str
    """Name of the model in titles."""
    model: Measurement
    z: Array
    """Readings (m,); NaN if one is missing."""
    fits: list[Fit]
    """A fit of each estimator, in their order."""
    examination: Examination | None
    """Examination of the least minimum; None if no estimator without a prior found any."""
    left_out: str = ""
    """The columns of the files that were left out."""

    @classmethod
    def to(
        cls, question: Question, name: str = "", progress: Shows = True, *, examine: bool = True
    ) -> Answer:
        """Returns the answer to a question, under its model's name or another `name`; `progress`
        and `examine` are those of `ipe_bench.estimate`."""
        from ipe_bench.report.progress import counting

        model = question.found.model
        with counting("estimate", len(question.estimators), progress) as begin:
            fitted = question.fitted(begin, examine=examine)
        ignored = ", ".join(question.ignored)
        return cls(name or title_of(model), model, question.found.z, *fitted, ignored)

    @property
    def passes(self) -> bool:
        """Whether the answer of any estimator passes every test."""
        if self.examination is not None and not self.examination.least:
            return False
        return any(one.passes for one in self.fits)

    @property
    def each(self) -> Sequence[Fit]:
        return self.fits

    def table(self) -> pd.DataFrame:
        """Returns estimate, standard error, 95 % interval, and whether the fit passes, per
        estimator and parameter."""
        import pandas as pd

        frames = []
        for one in self.fits:
            parameters = one.model.physical_parameters
            low, high = one.interval()
            columns = {
                "estimator": one.label,
                "parameter": [p.name for p in parameters],
                "unit": [p.unit for p in parameters],
                "estimate": one.x,
                "standard_error": one.standard_errors,
                "low95": low,
                "high95": high,
                "passes": one.passes,
            }
            frames.append(pd.DataFrame(columns))
        return pd.concat(frames, ignore_index=True)

    def parts(self) -> Iterator[Part]:
        yield from self._identifiability()
        one = self.examination
        # Without the parameters that are held on bounds, and the levels.
        model = one.whole.measurement if one else self.model
        if not any(fit.between and fit.passes for fit in self.fits):
            for sentence in model.remarks(one.inner[: model.n] if one else model.nominal):
                yield f"Note: {sentence}."
        yield _estimates(self)
        yield _verdicts(self)
        yield from _outliers(self)
        if one is None:
            return
        passes = self[one.label].passes
        if passes and not one.overstated:
            yield _intervals(one)
        if passes or not one.least:
            for remark in remarks(one, _Labels(self.model)):
                yield Strong(remark) if remark.split(":")[0].isupper() else remark

    def _identifiability(self) -> Iterator[Strong]:
        """Says what the model, or these readings, cannot determine."""
        found = structure(self.model)
        for sentence in found.sentences if found else ():
            yield Strong(f"Not identifiable: {sentence}.")
        for one in self._lacking[:1]:
            what = "; ".join(one.undetermined)
            yield Strong(
                f"The readings do not determine {what} (at {one.label}); fix a parameter by"
                " parameters.NAME.fixed=VALUE, or take more readings."
            )
        if self._lacking or not self.passes:
            for name, value in nearer_starts(self.model, self.z).items():
                start = f"measurement.start.{name}={value:.3g}"
                yield Strong(f"The readings are far from the readings of the start; try {start}.")

    @property
    def best(self) -> Sequence[Fit]:
        """The fits that pass; all of them if none does."""
        return [one for one in self.fits if one.passes] or self.fits

    @property
    def _lacking(self) -> list[Fit]:
        """Those of the best at which the readings do not determine all."""
        return [one for one in self.best if one.undetermined]

    def finding(self) -> str:
        """States the answer in one line: its first values, by whom, and how it was tested."""
        if self._lacking:
            return f"the readings do not determine {'; '.join(self._lacking[0].undetermined)}"
        if not any(one.passes for one in self.fits):
            return "no estimate both converged and fits"
        if not self.passes:
            return "no estimate is at the lowest minimum of chi-square"
        one = self._stated
        found = [f"{enumerate_few(self._recommended, 2)} by {one.label}"]
        if one.exact:
            found.append("which meets every reading exactly")
        elif _resembling(one):
            found.append("in doubt, because successive residuals resemble each other")
        elif one.fits:
            found.append("which passes every test")
        told = self.examination
        if told and told.overstated:
            found.append("though the stated noise is too large")
        elif told and told.ambiguous:
            found.append("but other parameters fit equally well")
        return ", ".join(found)

    @property
    def _stated(self) -> Fit:
        """The fit that stands for the answer: the examined one, or else the first that passes."""
        passing = [one for one in self.fits if one.passes]
        told = self.examination
        examined = [one for one in passing if told and one.label == told.label]
        return [*examined, *passing][0]

    @property
    def by_profile(self) -> bool:
        """Whether profile intervals replace standard errors: the model is strongly nonlinear."""
        told = self.examination
        if not self.passes or told is None or told.overstated:
            return False
        return told.label == self._stated.label and bool(told.bent.any())

    @property
    def _recommended(self) -> list[str]:
        """Each parameter with its standard error, or with its profile interval in parentheses where
        that is to be used."""
        one = self._stated
        told = self.examination
        if told is None or not self.by_profile:
            return _with_errors(one)
        names = [p.name for p in told.model.physical_parameters]
        ends = dict(zip(names, np.transpose(told.profiles), strict=True))
        found = []
        for p, x, error in zip(
            one.model.physical_parameters, one.x, one.standard_errors, strict=True
        ):
            value = f"{_number(x, 6)} (on its bound)"
            if p.name in ends:
                value = f"{_beside(x, error)} ({between(*ends[p.name], x)})"
            found.append(f"{p.name} = {value} {p.unit}".rstrip())
        return found

    def lead(self) -> str:
        """Says what stands beside the values of the title."""
        if not self.passes or self._lacking:
            return ""
        if self.by_profile:
            return (
                f"In parentheses: {100 * CONFIDENCE:.0f} % profile intervals. Use them in place of"
                " standard errors, because the model is strongly nonlinear here."
            )
        return "" if self._stated.exact else "Estimates ± standard errors."

    def sentences(self) -> list[str]:
        """Says who has an answer, what it is, and what a reader should know first."""
        others = enumerate_few([one.label for one in self.fits if not one.passes])
        if not self.passes:
            return [f"No answer that passes: {others or 'a better minimum was found'}."]
        passing = [one for one in self.fits if one.passes]
        tested = [one.label for one in passing if not _resembling(one)]
        resembling = enumerate_few([one.label for one in passing if _resembling(one)])
        tests = "every test"
        if passing[0].exact:
            tests = "the only test that readings without noise allow: residuals are round-off"
        elif not passing[0].fits:
            tests = (
                "every available test: the noise is unknown, so the size of residuals is not tested"
            )
        said = []
        if tested:
            verb = "passes" if len(tested) == 1 else "pass"
            said.append(f"{enumerate_few(tested)} {verb} {tests}")
        if resembling:
            said.append(f"in doubt, because successive residuals resemble each other: {resembling}")
        if others:
            said.append(f"no answer: {others}")
        found: list[str] = [Fact("Tests", f"{'; '.join(said)}.")]
        recommended = self._recommended
        if len(recommended) > 2:
            found.append(Fact("Estimate", f"{enumerate_few(recommended, 6)}."))
        if self.examination:
            told = remarks(self.examination, _Labels(self.model))
            found += [_labelled(one) for one in told if not one.startswith(_NONLINEAR)]
        return found


def _labelled(remark: str) -> str:
    """Puts a label before a remark that has none of its own."""
    label, _, text = remark.partition(": ")
    if label.isupper():
        return Fact(label.capitalize(), text)
    return Fact(label, text) if text and " " not in label else Fact("Remark", remark)


def _resembling(one: Fit) -> bool:
    """Tells whether successive residuals resemble each other by more than chance explains."""
    return one.white_p < FIT_LEVEL


def _with_errors(one: Fit) -> list[str]:
    """Writes each parameter with its estimate, standard error and unit."""
    parameters = zip(one.model.physical_parameters, one.x, one.standard_errors, strict=True)
    return [f"{p.name} = {with_error(x, s)} {p.unit}".rstrip() for p, x, s in parameters]


def _estimates(answer: Answer) -> Table:
    """Returns estimates with their errors; an invalid one stands in brackets, without its
    meaningless errors."""
    parameters = answer.fits[0].model.physical_parameters
    columns = naming("parameter", parameters)
    for one in answer.fits:
        if one.passes:
            columns.append(texts(one.label, map(with_error, one.x, one.standard_errors)))
            continue
        failing = "NOT DETERMINED" if one.idle else "MISFIT"
        if one.status is not Status.CONVERGED:
            failing = one.status.label.replace("_", " ").upper()
        cells = [f"({value:.4g})" if math.isfinite(value) else "-" for value in one.x]
        columns.append(texts(f"{one.label}: {failing}", cells))
    meant = [f"{one.label} {_DOES[one.label]}" for one in answer.fits if one.label in _DOES]
    notes = [Legend(f"{'; '.join(meant)}.")] if meant else []
    return Table("estimates", f"{answer.name}: estimate ± standard error", "", columns, notes=notes)


def with_error(value: float, error: float) -> str:
    """Returns a value with its standard error: two figures of the error, the value to the same
    place, one exponent."""
    if not (math.isfinite(value) and math.isfinite(error) and error > 0):
        return _number(value, 6)
    if error < 1e-12 * abs(value):
        return f"{_number(value, 15)} ± {error:.2g}"
    # 0.0999 rounds to 0.10.
    rounded = float(f"{error:.1e}")
    place = math.floor(math.log10(rounded)) - 1
    if place > 0 and abs(value) < _HIDDEN * error:
        # An error in the hundreds or more must not hide the value.
        return f"{value:.3g} ± {error:.2g}"
    return _together((value, error), " ± ", place)


def _beside(value: float, error: float) -> str:
    """Returns a value to two figures of its error, and to three of its own at least."""
    figures = math.log10(abs(value) / error) if value and error > 0 else 0.0
    return _number(value, min(max(math.ceil(figures) + 2, 3), _MOST_FIGURES))


def _together(values: Sequence[float], between: str, place: int) -> str:
    """Writes numbers to one decimal place, with one exponent for all if they are very small, or so
    large that figures before the point are not known."""
    largest = max(map(abs, values))
    power = math.floor(math.log10(largest or 10.0**place))
    if power - place > _MOST_FIGURES:
        return between.join(f"{v:.4g}" for v in values)
    small = place < (-6 if power < 0 else -_MOST_FIGURES)
    large = largest >= 1e6 and place > 0 and power - place <= _FEW_FIGURES
    if largest >= 1e-4 and not small and not large:
        # Zero has no sign.
        rounded = (round(v, -place) + 0.0 for v in values)
        return between.join(f"{v:.{max(-place, 0)}f}" for v in rounded)
    figures = min(max(power - place, 0), 15)
    digits = [f"{Decimal(v).scaleb(-power):.{figures}f}" for v in values]
    return f"({between.join(digits)})e{power}"


def _number(value: float, figures: int = 4) -> str:
    return f"{value:.{figures}g}" if math.isfinite(value) else "-"


def _verdicts(answer: Answer) -> Table:
    """Returns whether each fit passes; chi-square is omitted if the noise level is estimated from
    the residuals."""
    fits = answer.fits
    columns = [
        words("estimator", [one.label for one in fits]),
        words("status", [one.status.label.replace("_", " ") for one in fits]),
        words("fits", [_FITS[one.fits] for one in fits]),
    ]
    if any(one.level is None for one in fits):
        squares = [_number(one.chi_square) if one.level is None else "-" for one in fits]
        columns += [texts("p", [_fit_p(one.p_value) for one in fits]), texts("chi2", squares)]
    columns += [
        texts("dof", [str(one.degrees_of_freedom) for one in fits]),
        texts("white p", [p_value(one.white_p, LEAST_P) for one in fits]),
        texts("outliers", [str(int(one.outliers.sum())) for one in fits]),
    ]
    for output in _outputs_shown(fits):
        shown = [_number(one.residual_deviations[output]) for one in fits]
        columns.append(texts(f"deviation {output}".strip(), shown))
    return Table("verdicts", "Does the model fit?", "", columns, notes=list(_notes(answer)))


def _outputs_shown(fits: Sequence[Fit]) -> list[str]:
    """Lists the outputs whose residuals' deviations are shown: none of many."""
    outputs = [*fits[0].residual_deviations]
    return outputs if len(outputs) <= _MOST_OUTPUTS else []


def _fit_p(p: float) -> str:
    # The least p that simulated fits resolve is an upper limit.
    return p_value(p, LEAST_FIT_P if p == LEAST_FIT_P else 0.0)


def _notes(answer: Answer) -> Iterator[str]:
    """Yields the notes on the fits: what tests mean, each estimator's own ones, noise and
    priors."""
    fits = answer.fits
    yield Legend(
        f"An estimate fits if p of chi-square is at least {FIT_LEVEL:g}. white p: p-value of the"
        " Ljung-Box test, which is small if successive residuals resemble each other."
        f"{_DEVIATION if _outputs_shown(fits) else ''}"
    )
    for one in fits:
        if one.message:
            yield f"{one.label}: {one.message}"
    for one in fits:
        yield from _notes_on_fit(answer, one)
        if answer.passes and one.undetermined and not one.passes:
            what = "; ".join(one.undetermined)
            yield f"({one.label}: where it ended, the readings do not determine {what}.)"
    told = [one for one in fits if math.isfinite(one.deviance)]
    if told:
        yield from _notes_on_limits(min(told, key=lambda one: one.deviance))
    yield from _notes_on_noise(answer)
    yield from _notes_on_priors(answer)
    if answer.model.fixed:
        yield f"Fixed: {_values(answer.model.fixed)}"
    if answer.left_out:
        yield f"Left out: columns {answer.left_out}."
    failing = _labels(one for one in fits if not one.passes)
    if failing:
        yield f"Values in parentheses were rejected and have no standard errors: {failing}."


def _labels(fits: Iterable[Fit]) -> str:
    return ", ".join(one.label for one in fits)


def _notes_on_fit(answer: Answer, one: Fit) -> Iterator[str]:
    if one.label == SEARCH:
        yield f"{SEARCH}: Levenberg-Marquardt steps from the best of further starts."
    better = one.beaten_by or one.lower_at
    if better and not answer[better].passes:
        yield f"{one.label}: {better} met a lower sum of squares, but is no answer either."
    elif one.beaten_by:
        yield f"{one.label}: {better} found a significantly better fit; rejected."
    elif better:
        yield f"{one.label}: {better} found a lower minimum; use that answer."
    for names, values in one.endless.items():
        at = _values(dict(zip(names, values, strict=True)), 4)
        yield (
            f"{one.label}: {' and '.join(names)} may go to infinity, so there is no standard error:"
            f" from {at} on the readings of the model stay the same."
        )
    for k, (low, high) in one.between.items():
        name = one.model.physical_parameters[k].name
        yield (
            f"{one.label}: readings step at {name}, and are the same with every value from"
            f" {low:.6g} to {high:.6g}. It has no standard error, and the errors of the others hold"
            " it there."
        )
    if one.held_at and not one.between:
        parameters = one.model.physical_parameters
        at = {parameters[k].name: value for k, value in one.held_at.items()}
        yield (
            f"{one.label}: on its bound: {_values(at)}; the readings favour a value beyond. It has"
            " no standard error; the others are computed with it fixed."
        )


def _notes_on_limits(one: Fit) -> Iterator[str]:
    """Says how far parameters that may go to infinity are from it at least."""
    for name, value in limits_of(one).items():
        side = "above" if value > 0 else "below"
        yield f"{one.label}: the 95 % profile limits {name} to {side} {value:.3g}."


def _notes_on_noise(answer: Answer) -> Iterator[str]:
    """Yields what is known of the noise's level, and what residuals say against it."""
    fits = answer.fits
    levelled = [one for one in fits if one.level is not None]
    if any(one.levels for one in fits):
        yield (
            "The noise levels are estimated with the parameters by restricted maximum likelihood."
            " They make chi-square equal to the degrees of freedom, so the size of the residuals"
            " cannot test the model. Check white p, outliers, and the levels against the"
            " instruments' specifications."
        )
        known = _labels(one for one in fits if one.estimated and not one.estimated.maximal)
        if known:
            yield f"{known}: treats its estimated noise levels as exact."
    exact = _labels(one for one in fits if one.exact)
    if exact:
        yield (
            f"{exact}: meets every reading but for round-off. The readings show no noise, so there"
            " are no standard errors, no outliers and no search for other answers; state the noise"
            " that instruments have, as in noise.deviation=0.1."
        )
    elif levelled and not any(one.levels for one in fits):
        yield (
            "The noise level is estimated from the residuals. Standard errors are scaled by it,"
            " intervals use Student's t, and the size of the residuals cannot test the model."
        )
    suspect = _labels(one for one in fits if one.fits is not False and _resembling(one))
    if suspect:
        yield (
            f"{suspect}: successive residuals resemble each other (white p below {FIT_LEVEL:g});"
            " the model is in doubt, and standard errors are too small."
        )
    small = [one for one in fits if one.overstated > 1]
    if small:
        times = max(one.overstated for one in small)
        yield (
            f"{_labels(small)}: the residuals are up to {times:.2g} times smaller than the stated"
            f" noise, by chance in less than {1 - TOO_WELL:.1g} of cases; if it is overstated, so"
            " are standard errors."
        )
    if answer.examination is not None and answer.examination.overstated:
        yield (
            "The stated noise is far too large, so no intervals are computed:"
            " state the noise of these readings, or choose noise=unknown, whose level is"
            " estimated."
        )


def _notes_on_priors(answer: Answer) -> Iterator[str]:
    told = _labels(one for one in answer.fits if one.with_prior)
    if told:
        yield (f"{told}: with a prior; standard errors include it.")
    elif isinstance(answer.model, ConstrainedModel):
        stated = [one.name for one in answer.model.known if one.deviation is not None]
        if stated:
            yield (
                f"The prior of {', '.join(stated)} counts in no estimate here; add one with a"
                " prior, such as map_lm."
            )


def _values(values: Mapping[str, float], figures: int = 6) -> str:
    return ", ".join(f"{name} = {value:.{figures}g}" for name, value in values.items())


def _outliers(answer: Answer) -> Iterator[Table]:
    """Yields the most outlying readings, each with its largest residual and the estimators that
    find it so."""
    told = [f for f in answer.best if 0 < f.outliers.sum() <= max(3, _FEW * len(f.outliers))]
    if not told:
        return
    beyond = np.flatnonzero(np.any([f.outliers for f in told], axis=0))
    worst = {i: max((float(f.normalised[i]) for f in told), key=abs) for i in beyond}
    listed = sorted(worst, key=lambda i: -abs(worst[i]))[:_MOST_OUTLIERS]
    labels = _Labels(answer.model)
    columns = [
        words("reading", [_where(labels[i]) for i in listed]),
        texts("residual", [f"{worst[i]:.1f}" for i in listed]),
        words("of", [_labels(f for f in told if f.outliers[i]) for i in listed]),
    ]
    further = len(worst) - len(listed)
    notes = [f"And {further} others: see {RESIDUALS}."] if further else []
    title = f"Outliers: normalised residual beyond ±{told[0].outlier_limit:.2f}"
    yield Table("outliers", title, "", columns, notes=notes)


def _where(label: Mapping[str, Any]) -> str:
    return ", ".join(f"{k}={v}" for k, v in label.items())


class _Labels(Sequence[dict[str, Any]]):
    """Describes each of the m readings by the columns of its model, when it is asked for."""

    def __init__(self, model: Measurement) -> None:
        # A model may make its columns anew whenever it is asked.
        self.columns = model.index
        self.m = model.m

    def __len__(self) -> int:
        return self.m

    def __getitem__(self, i: Any) -> Any:
        return {name: as_json(column[i]) for name, column in self.columns.items()}


def _intervals(found: Examination) -> Table:
    """Returns three intervals of each parameter; for a parameter on a bound, that of its
    profile."""
    on_bounds = found.on_bounds
    absent = ["-"] * len(on_bounds)
    parameters = [*found.model.physical_parameters, *(one.parameter for one in on_bounds)]
    profiles = [*map(between, *found.profiles, found.x)]
    for one in on_bounds:
        low, high = sorted((one.bound, one.other))
        profiles.append(between(low, high, math.nan))
    bootstrap = map(between, found.bootstrap.low, found.bootstrap.high, found.x)
    columns = [
        *naming("parameter", parameters),
        texts("standard error", [*map(between, *found.wald, found.x), *absent]),
        texts("profile", profiles),
        texts("bootstrap", [*bootstrap, *absent]),
    ]
    title = f"{100 * CONFIDENCE:.0f} % intervals of {found.label}, in three ways"
    return Table("intervals", title, "", columns)


def between(low: float, high: float, middle: float) -> str:
    """Rounds the ends to a hundredth of twice the lesser distance to the estimate `middle`, or of
    the width if outside."""
    if not math.isfinite(high - low) or high <= low:
        text = f"{low:.6g} … {high:.6g}".replace("-inf", "−∞")
        text = text.replace("inf", "∞").replace("nan", "-")
        return "-" if text == "- … -" else text
    reach = high - low
    if low < middle < high:
        reach = 2 * min(middle - low, high - middle)
    return _together((low, high), " … ", math.floor(math.log10(reach)) - 2)


def remarks(found: Examination, labels: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yields what a reader should know before relying on the answer, one sentence each."""
    names = [p.name for p in found.model.physical_parameters]
    yield from _other_minima(found, names)
    if found.overstated:
        return
    rivals = [one for one in found.ambiguous if not one.same_readings]
    for one in rivals[:_MOST_MINIMA]:
        at = _values(dict(zip(names, one.x, strict=True)), 5)
        yield f"AMBIGUOUS: the readings fit as well at {at} (chi-square {one.chi_square:.5g})."
    yield from _on_profiles(found, names)
    for one in found.on_bounds:
        yield (
            f"{one.parameter.name}: its estimate is on the bound {one.bound:g}, which is one end"
            " of its interval; the other is where the profile has risen as far as inside of"
            " bounds, so it holds the true value at least as often as it says. Profiles of the"
            " others let it move inwards; their standard errors do not."
        )
    shift = np.nan_to_num(found.shift, nan=0.0)
    for i in np.argsort(-shift)[:_MOST_READINGS]:
        if shift[i] >= _INFLUENTIAL:
            where = _where(labels[i])
            yield (
                f"Without the reading at {where}, {names[int(found.moved[i])]} would move by"
                f" {shift[i]:.1f} standard errors."
            )
    drawn = found.bootstrap.drawn
    lost = drawn - found.bootstrap.converged
    if not drawn:
        yield "Bootstrap: not computed, because there are too many readings."
    if lost > 0:
        yield f"Bootstrap: {lost} of {drawn} simulated data sets gave no estimate."


def _other_minima(found: Examination, names: Sequence[str]) -> Iterator[str]:
    """Says where chi-square is lower, and which parameters give the same readings."""

    def at(x: Array) -> str:
        # What is round-off beside its error is zero.
        known = np.where(np.abs(x) > _HIDDEN * found.standard_errors, x, 0.0)
        return _values(dict(zip(names, known, strict=True)), 5)

    if not found.least:
        best = found.minima[0]
        yield (
            f"NOT THE GLOBAL MINIMUM: chi-square is {best.chi_square:.5g} at {at(best.x)}; start"
            " there, or choose an estimator that searches, such as multiscale_lm."
        )
    equal = [one.x for one in found.ambiguous if one.same_readings]
    if equal:
        listed = "; or ".join([at(x) for x in equal[:_MOST_MINIMA]])
        yield f"The readings are exactly the same at {listed}."


def _on_profiles(found: Examination, names: Sequence[str]) -> Iterator[str]:
    """Says for which parameters the profile differs from the Wald interval, or lacks an end."""
    if found.bent.any():
        intervals = map(between, *found.profiles, found.x)
        each = [f"{name} {text}" for name, text in zip(names, intervals, strict=True)]
        ends = enumerate_few(list(compress(each, found.bent)), 3)
        level = f"{100 * CONFIDENCE:.0f} %"
        yield f"{_NONLINEAR} here: use the {level} profile intervals, {ends}."
    infinite = np.isinf(found.profiles).sum(axis=0)
    for sides, what in ((1, "one side of "), (2, "")):
        unlimited = list(compress(names, infinite == sides))
        if unlimited:
            yield f"The readings do not bound {what}{', '.join(unlimited)}."
    lost = list(compress(names, np.any(np.isnan(found.profiles), axis=0)))
    if lost:
        yield (
            f"An end of the profile is missing: {', '.join(lost)}; the search met a better fit, or"
            " no minimum."
        )


def store(
    folder: Path, answers: Sequence[Answer], command: Any, provenance: Mapping[str, Any]
) -> Path:
    """Writes estimate.json, which has every estimate of the only answer, and returns its path."""
    (answer,) = answers
    content = {**estimate_content(answer), **provenance}
    return write_result(folder, NAME, SCHEMA, command, content)


def write_page(
    folder: Path, answer: Answer, provenance: Mapping[str, Any], *, figures: bool = True
) -> list[Path]:
    """Writes residuals.csv, the page and its figures, in place of those of an earlier answer;
    returns the files."""
    files = write_files(
        folder,
        NAME,
        (RESIDUALS, _residuals(answer)),
        f"{answer.name}: {answer.finding()}",
        answer.sentences(),
        _first(answer.parts(), "intervals" if answer.by_profile else "estimates"),
        _drawings(answer) if figures else (),
        lead=answer.lead(),
        facts=[f"{np.isfinite(answer.z).sum()} readings"],
        sources=read_from(provenance),
    )
    for old in {folder / each for each in FILES} - set(files):
        old.unlink(missing_ok=True)
    return files


def _first(parts: Iterable[Part], name: str) -> list[Part]:
    """Puts the table of this name before the other parts."""
    return sorted(parts, key=lambda part: not (isinstance(part, Table) and part.name == name))


def _drawings(answer: Answer) -> Iterator[Drawing]:
    from ipe_bench.report.figures.answers import draw_fit, draw_residuals
    from ipe_bench.report.figures.views import looks_of

    found = answer.examination
    if found is not None and answer[found.label].passes:
        look = looks_of({one.label: one.estimator for one in answer.fits})
        yield from draw_fit(found, answer.z, answer[found.label], look[found.label])
    yield from draw_residuals(answer.model, answer.fits)


def read_from(provenance: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Returns the files that were read with their digests."""
    return [(one["file"], one["sha256"]) for one in provenance.get("readings") or ()]


def estimate_content(answer: Answer) -> dict[str, Any]:
    """Returns the content of estimate.json: readings, estimates, and the least minimum."""
    model = answer.model
    found = answer.examination
    labels = _Labels(model)
    return {
        "measurement": model.name,
        "reading_unit": model.reading_unit,
        "readings_present": int(np.isfinite(answer.z).sum()),
        "readings_missing": int(np.isnan(answer.z).sum()),
        "fixed": dict(model.fixed),
        "left_out": answer.left_out,
        "passes": answer.passes,
        "examination": found and _examined(found, labels),
        "estimators": {one.label: _fitted(one, labels) for one in answer.fits},
    }


_STORED = (
    *("message", "chi_square", "degrees_of_freedom", "fits", "passes", "with_prior", "beaten_by"),
    *("lower_at", "iterations", "simulations", "correlation"),
)


def _fitted(one: Fit, labels: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    names = [p.name for p in one.model.physical_parameters]
    outliers = [
        {**labels[i], "normalised_residual": as_json(one.normalised[i])}
        for i in np.flatnonzero(one.outliers).tolist()
    ]
    spread = {output: as_json(value) for output, value in one.residual_deviations.items()}
    return {
        "status": one.status.label,
        "estimates": _by_name(names, one.x),
        "standard_errors": _by_name(names, one.standard_errors),
        "intervals95": _by_name(names, np.transpose(one.interval())),
        "p": as_json(one.p_value),
        "white_p": as_json(one.white_p),
        "on_bounds": {names[k]: value for k, value in one.held_at.items()},
        "noise_level_estimated": one.levels or as_json(one.level),
        "outliers": outliers,
        "residual_deviation": spread.get("", spread),
        **{name: as_json(getattr(one, name)) for name in _STORED},
    }


def _examined(found: Examination, labels: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    names = [p.name for p in found.model.physical_parameters]
    told: dict[str, Any] = {"estimator": found.label, "estimates": _by_name(names, found.x)}
    if not found.overstated:
        bootstrap = found.bootstrap
        told["profile95"] = _by_name(names, np.transpose(found.profiles))
        told["bootstrap95"] = _by_name(names, np.column_stack([bootstrap.low, bootstrap.high]))
    return told | {"remarks": list(remarks(found, labels))}


def as_json(value: Any) -> Any:
    """Converts a value to JSON, which lacks arrays, NaN and infinity: null replaces them."""
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return [as_json(v) for v in value] if isinstance(value, list | tuple) else value


def _by_name(names: Sequence[str], values: Any) -> dict[str, Any]:
    return dict(zip(names, as_json(values), strict=True))


def _residuals(answer: Answer) -> pd.DataFrame:
    """Returns a row per estimator and reading, with influences and predictions where missing for
    the examined one."""
    import pandas as pd

    model = answer.model
    z = answer.z
    unit = model.reading_unit
    frames = []
    for one in answer.fits:
        found = answer.examination
        if found is not None and one.label != found.label:
            found = None
        fitted = z - one.residuals
        if found is not None:
            fitted = np.where(np.isnan(z), found.fitted, fitted)
        columns: dict[str, Any] = {"estimator": one.label, **model.index}
        columns[with_unit("reading", unit)] = z
        columns[with_unit("fitted", unit)] = fitted
        columns[with_unit("residual", unit)] = one.residuals
        columns["normalised_residual"] = one.normalised
        columns["outlier"] = np.where(one.outliers, "yes", "no")
        columns["shift"] = np.nan if found is None else found.shift
        columns[with_unit("fitted_error", unit)] = np.nan if found is None else found.fitted_errors
        columns[with_unit("prediction_error", unit)] = np.nan if found is None else found.new_errors
        frames.append(pd.DataFrame(columns))
    return pd.concat(frames)
