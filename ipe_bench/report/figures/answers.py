"""Draws the answers to single questions: fitted curves and residuals, bounds of designs,
posteriors, pairs, audits."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ipe_bench.basics.linalg import Array, Mask
from ipe_bench.measurements.base import labels, with_unit
from ipe_bench.real.profiles import CONFIDENCE, half_width
from ipe_bench.real.residuals import LEAST_P
from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.figures.views import looks_of
from ipe_bench.report.style import BOUND_COLOR
from ipe_bench.report.words import enumerate_few, p_value

if TYPE_CHECKING:
    from ipe_bench.measurements.base import Measurement
    from ipe_bench.real.examination import Examination
    from ipe_bench.real.fits import Fit
    from ipe_bench.report.style import Look

MOST_ESTIMATORS = 12
"""Estimators with a panel of residuals; `residuals.csv` has all."""
_MANY = 5000
"""Points from which on they are pixels in the PDF, too."""
_MOST_POINTS = 20_000
"""Readings beyond which not all are drawn."""
_BENT = 30.0
"""Normalised residuals beyond this are drawn on a logarithmic axis: a model that does not fit at
all."""
_ALIKE = 0.01
"""Residuals, in their deviations, that differ by less are drawn once."""
_GRID = 200
"""Points of a curve, where the model can be evaluated between the readings."""


def draw_fit(found: Examination, z: Array, fit: Fit, look: Look) -> Iterator[Drawing]:
    """Draws readings z (m,) with the fitted curve and its band, and residuals beside them, if one
    numeric column alone tells readings apart."""
    model = found.whole.measurement
    columns = labels(model)
    varying = {name: column for name, column in columns.items() if len(set(column)) > 1}
    running = list(range(1, model.m + 1))
    # Beside an input the number of the row is no abscissa.
    inputs = {name: column for name, column in varying.items() if list(column) != running}
    varying = inputs or varying
    if len(varying) != 1:
        return
    ((name, column),) = varying.items()
    x = np.asarray(column)
    if not np.issubdtype(x.dtype, np.number):
        return
    at, fitted, error = _curve(found, name, x)
    freedom = None if found.freedom is None else float(np.min(found.freedom))
    half = half_width(CONFIDENCE, freedom) * error
    fig, (ax, beside) = common.panels(2, height=3.2)
    band: Any = {
        "alpha": 0.2,
        "linewidth": 0,
        "label": f"{100 * CONFIDENCE:.0f} % band of the curve",
    }
    ax.fill_between(at, fitted - half, fitted + half, color=look.color, **band)
    ax.plot(at, fitted, color=look.color, label=common.text(found.label))
    style: Any = {"color": BOUND_COLOR, "markersize": 3.5, "rasterized": len(x) > _MANY}
    kept = _drawn(len(x))
    ax.plot(x[kept], z[kept], "o", label="readings", zorder=3, **style)
    ax.set_xlabel(common.text(name))
    ax.set_ylabel(common.text(with_unit(model.reading_name, model.reading_unit)))
    _residual_panel(beside, x.astype(float), fit, fit.outlier_limit, look.color)
    beside.set(xlabel=common.text(name), ylabel="residual / its deviation")
    common.title(ax, "readings and fit")
    common.title(beside, f"residuals: {_tests(fit)}" if _tests(fit) else "residuals")
    common.legend(fig, [ax, beside])
    caption = (
        "Pointwise 95 % band, first order in the errors. Residuals are standard normal if model and"
        f" noise are right.{_left_out(len(x))}"
    )
    yield Drawing("fit", "Readings and fitted curve", caption, fig)


def _curve(found: Examination, name: str, x: Array) -> tuple[Array, Array, Array]:
    """Returns abscissas, the fitted curve there and its standard deviations: between the readings,
    too, if the model takes the abscissa as an input."""
    model = found.whole.measurement
    columns = labels(model)
    headings = [one.heading for one in model.inputs]
    if name not in headings or not columns.keys() >= {*headings}:
        order = np.argsort(x, kind="stable")
        return x[order], found.fitted[order], found.fitted_errors[order]
    at = np.linspace(x.min(), x.max(), _GRID)
    dense = replace(found.whole, measurement=model.along(name, at.tolist()))
    found = replace(found, whole=dense)
    return at, found.fitted, found.fitted_errors


def draw_residuals(model: Measurement, fits: Sequence[Fit]) -> Iterator[Drawing]:
    """Draws normalised residuals, a panel for each passing estimator, or for all if none passes;
    equal ones once."""
    from matplotlib.ticker import MaxNLocator

    groups = _alike(fits)
    if not groups:
        return
    x, heading = _abscissa(model)
    shown = groups[:MOST_ESTIMATORS]
    look = looks_of({one.label: one.estimator for one in fits})
    limit = shown[0][0].outlier_limit
    fig, axes = common.panels(len(shown), height=2.6)
    for group, ax in zip(shown, axes, strict=True):
        first = group[0]
        _residual_panel(ax, x, first, limit, look[first.label].color)
        ax.xaxis.set_major_locator(MaxNLocator(6, integer=heading == "reading"))
        names = enumerate_few([one.label for one in group], 1)
        common.title(ax, f"{names}: {_tests(first)}")
    common.axis_labels(fig, common.text(heading), "residual / its deviation")
    common.legend(fig, axes)
    caption = (
        "Each is standard normal if the model and the noise are right. Beyond"
        f" ±{limit:.2f} a reading is an outlier."
    )
    further = len(groups) - len(shown)
    if further:
        caption += f" {further} further panels: see residuals.csv."
    caption += _left_out(len(x))
    yield Drawing("residuals", "Residuals in standard deviations", caption, fig)


def _alike(fits: Sequence[Fit]) -> list[list[Fit]]:
    """Returns the fits that have residuals, those with equal ones together; of those that pass, if
    any do."""
    known = [one for one in fits if np.isfinite(one.normalised).any()]
    passing = [one for one in known if one.passes]
    return common.together(passing or known, _are_alike)


def _are_alike(one: Fit, other: Fit) -> bool:
    return bool(np.nanmax(np.abs(one.normalised - other.normalised)) < _ALIKE)


def _step(m: int) -> int:
    """Returns k, of m readings of which every k-th is drawn."""
    return -(-m // _MOST_POINTS)


def _drawn(m: int) -> Mask:
    """Tells which of m readings (m,) are drawn: more are one surface of colour."""
    return np.arange(m) % _step(m) == 0


def _left_out(m: int) -> str:
    if _step(m) == 1:
        return ""
    return f" Drawn: 1 of {_step(m)} of {m:,} readings, and every outlier of the residuals."


def _residual_panel(ax: Any, x: Array, fit: Fit, limit: float, color: str) -> None:
    """Draws the residuals of a fit over x (m,), outliers as crosses."""
    from matplotlib.ticker import MaxNLocator

    r = fit.normalised
    ax.axhline(0.0, color=BOUND_COLOR, linewidth=0.6, zorder=1)
    common.bound_line(ax, limit, "limit for outliers")
    common.bound_line(ax, -limit, "")
    good = np.isfinite(r) & ~fit.outliers & _drawn(len(x))
    size = 9 if len(x) > 100 else 20
    points: Any = {"s": size, "alpha": 0.75, "linewidth": 0, "rasterized": len(x) > _MANY}
    ax.scatter(x[good], r[good], color=color, **points)
    if fit.outliers.any():
        crosses: Any = {"s": 25, "marker": "x", "linewidth": 1.2, "label": "outlier"}
        ax.scatter(x[fit.outliers], r[fit.outliers], color=color, **crosses)
    largest = float(np.nanmax(np.abs(r)))
    edge = 1.15 * max(largest, limit)
    ax.set_ylim(-edge, edge)
    if edge > _BENT:
        ax.set_yscale("symlog", linthresh=10.0, linscale=1.0)
    else:
        ax.yaxis.set_major_locator(MaxNLocator(7, integer=True))


def _tests(fit: Fit) -> str:
    """Says the p values of a fit's tests, as far as there are any."""
    values = {"fit": p_value(fit.p_value), "white": p_value(fit.white_p, LEAST_P)}
    return ", ".join(f"{name} p {value}" for name, value in values.items() if value != "-")


def _abscissa(model: Measurement) -> tuple[Array, str]:
    """Returns the abscissa of each reading (m,): its time if there is such a column, else its
    row."""
    for name, column in model.index.items():
        values = np.asarray(column)
        if not np.issubdtype(values.dtype, np.number):
            continue
        # Many readings may stand at one number, such as a case's.
        several = 3 * len(set(column)) < model.m
        if not several and (np.diff(values) >= 0).all():
            return values.astype(float), name
    return np.arange(1.0, model.m + 1), "reading"
