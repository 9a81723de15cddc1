"""Draws the answers to single questions: fitted curves and residuals, bounds of designs, posteriors, pairs, audits."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ipe_bench.basics.linalg import Array
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
_BENT = 30.0
"""Normalised residuals beyond this are drawn on a logarithmic axis: a model that does not fit at all."""
_ALIKE = 0.01
"""Residuals, in their deviations, that differ by less are drawn once."""
_GRID = 200
"""Points of a curve, where the model can be evaluated between the readings."""


def draw_fit(found: Examination, z: Array, look: Look) -> Iterator[Drawing]:
    """Draws readings z (m,) with the fitted curve and its band, if one numeric column alone tells readings apart."""
    model = found.whole.measurement
    columns = {**model.index, **model.input_columns}
    varying = {name: column for name, column in columns.items() if len(set(column)) > 1}
    running = list(range(1, model.m + 1))  # beside an input the number of the row is no abscissa
    varying = {
        name: column for name, column in varying.items() if list(column) != running
    } or varying
    name, column = next(iter(varying.items()), ("", ()))
    x = np.asarray(column)
    if len(varying) != 1 or not np.issubdtype(x.dtype, np.number):
        return
    order = np.argsort(x, kind="stable")
    at, h, error = x[order], found.fitted[order], found.fitted_errors[order]
    headings = [one.heading for one in model.inputs]
    if name in headings and columns.keys() >= {*headings}:
        at = np.linspace(x.min(), x.max(), _GRID)
        inputs = {key: [columns[key][0]] * _GRID for key in headings} | {name: at.tolist()}
        dense = replace(
            found, whole=replace(found.whole, measurement=model.with_inputs(inputs, _GRID))
        )
        h, error = dense.fitted, dense.fitted_errors
    q = half_width(CONFIDENCE, None if found.freedom is None else float(np.min(found.freedom)))
    fig, (ax,) = common.panels(1, height=3.2)
    fig.set_figwidth(5.2)
    band = f"{100 * CONFIDENCE:.0f} % band of the curve"
    ax.fill_between(
        at, h - q * error, h + q * error, color=look.color, alpha=0.2, linewidth=0, label=band
    )
    ax.plot(at, h, color=look.color, label=common.text(found.label))
    ax.plot(
        x,
        z,
        "o",
        color=BOUND_COLOR,
        markersize=3.5,
        rasterized=len(x) > _MANY,
        label="readings",
        zorder=3,
    )
    unit = f" [{model.reading_unit}]" if model.reading_unit else ""
    ax.set(xlabel=common.text(name), ylabel=common.text(f"{model.reading_name}{unit}"))
    common.legend(fig, [ax])
    caption = "At any one point the band holds the curve, to first order in the parameters' errors."
    yield Drawing("fit", "Readings and fitted curve", caption, fig)


def draw_residuals(model: Measurement, fits: Sequence[Fit]) -> Iterator[Drawing]:
    """Draws normalised residuals, a panel for each passing estimator, or for all if none passes; equal ones once."""
    import seaborn as sns
    from matplotlib.ticker import MaxNLocator

    known = [one for one in fits if np.isfinite(one.normalised).any()]
    groups: list[list[Fit]] = []
    for one in [one for one in known if one.passes] or known:
        same = (g for g in groups if np.nanmax(np.abs(g[0].normalised - one.normalised)) < _ALIKE)
        if (group := next(same, None)) is None:
            groups.append([one])
        else:
            group.append(one)
    if not groups:
        return
    x, heading = _abscissa(model)
    shown = groups[:MOST_ESTIMATORS]
    look, limit = looks_of({one.label: one.estimator for one in fits}), shown[0][0].outlier_limit
    fig, axes = common.panels(len(shown), height=2.6)
    for group, ax in zip(shown, axes, strict=True):
        one = group[0]
        r, out = one.normalised, one.outliers
        ax.axhline(0.0, color=BOUND_COLOR, linewidth=0.6, zorder=1)
        common.bound_line(ax, limit, "limit for outliers")
        common.bound_line(ax, -limit, "")
        good, style = (
            np.isfinite(r) & ~out,
            {"color": look[one.label].color, "legend": False, "ax": ax},
        )
        size = 9 if len(x) > 100 else 20
        sns.scatterplot(
            x=x[good],
            y=r[good],
            s=size,
            alpha=0.75,
            linewidth=0,
            rasterized=len(x) > _MANY,
            **style,
        )
        if out.any():
            sns.scatterplot(
                x=x[out], y=r[out], s=25, marker="x", linewidth=1.2, label="outlier", **style
            )
        edge = 1.15 * max(float(np.nanmax(np.abs(r))), limit)
        ax.set_ylim(-edge, edge)
        if edge > _BENT:
            ax.set_yscale("symlog", linthresh=10.0, linscale=1.0)
        else:
            ax.yaxis.set_major_locator(MaxNLocator(7, integer=True))
        ax.xaxis.set_major_locator(MaxNLocator(6, integer=heading == "reading"))
        tests = {"fit": p_value(one.p_value), "white": p_value(one.white_p, LEAST_P)}
        p = ", ".join(f"{name} p {value}" for name, value in tests.items() if value != "-")
        common.title(ax, f"{enumerate_few([each.label for each in group], 1)}: {p}")
    common.axis_labels(fig, common.text(heading), "residual / its deviation")
    common.legend(fig, axes)
    parts = [f"{each.label} {int(each.outliers.sum())}" for group in shown for each in group]
    caption = (
        "Each is standard normal if the model and the noise are right. Beyond"
        f" ±{limit:.2f} a reading is an outlier: {enumerate_few(parts, 3)}."
    )
    if len(groups) > len(shown):
        caption += f" {len(groups) - len(shown)} further panels: see residuals.csv."
    yield Drawing("residuals", "Residuals in standard deviations", caption, fig)


def _abscissa(model: Measurement) -> tuple[Array, str]:
    """Returns the abscissa of each reading (m,): its time if there is such a column, else its row."""
    for name, column in model.index.items():
        values = np.asarray(column)
        several = 3 * len(set(column)) < model.m  # many readings at one number, such as a case's
        if np.issubdtype(values.dtype, np.number) and not several and (np.diff(values) >= 0).all():
            return values.astype(float), name
    return np.arange(1.0, model.m + 1), "reading"
