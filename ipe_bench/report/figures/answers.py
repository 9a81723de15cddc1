"""Draws the answers to single questions: fitted curves and residuals, bounds of designs, posteriors, pairs, audits."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.real.profiles import CONFIDENCE, half_width
from ipe_bench.real.residuals import LEAST_P
from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.figures.views import looks_of
from ipe_bench.report.style import BOUND_COLOR, FAMILIES
from ipe_bench.report.words import enumerate_few, p_value
from ipe_bench.statistics.between import comparison_title

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ipe_bench.measurements.base import Measurement
    from ipe_bench.real.examination import Examination
    from ipe_bench.real.fits import Fit
    from ipe_bench.report.style import Look
    from ipe_bench.statistics.audit import Audit
    from ipe_bench.trials.observability import Observability
    from ipe_bench.trials.posterior import Reference

MOST_ESTIMATORS = 12
"""Estimators with a panel of residuals; `residuals.csv` has all."""
MOST_ROWS = 30
"""Comparisons in a figure; its table has all."""
_MANY = 5000
"""Points from which on they are pixels in the PDF, too."""
_BENT = 30.0
"""Normalised residuals beyond this are drawn on a logarithmic axis: a model that does not fit at all."""
_ALIKE = 0.01
"""Residuals, in their deviations, that differ by less are drawn once."""
_GRID = 200
"""Points of a curve, where the model can be evaluated between the readings."""
_FARTHEST = 4.5
"""Standard deviations about the middle that a distribution is drawn to."""
_GOOD, _BAD = FAMILIES["least squares"][0], FAMILIES["filters"][0]
_FINDINGS: dict[str, tuple[str, dict[str, Any]]] = {
    "better": ("better", {"marker": "o", "color": _GOOD}),
    "worse": ("worse", {"marker": "o", "color": _BAD}),
    "different": ("different, perhaps by less than the margin", {"marker": "D", "color": BOUND_COLOR}),
    "": ("no difference found", {"marker": "o", "color": BOUND_COLOR, "markerfacecolor": "white"}),
}
"""The words and the mark of each outcome of a test."""


def draw_fit(found: Examination, z: Array, look: Look) -> Iterator[Drawing]:
    """Draws readings z (m,) with the fitted curve and its band, if one numeric column alone tells readings apart."""
    model = found.whole.measurement
    columns = {**model.index, **model.input_columns}
    varying = {name: column for name, column in columns.items() if len(set(column)) > 1}
    running = list(range(1, model.m + 1))  # beside an input the number of the row is no abscissa
    varying = {name: column for name, column in varying.items() if list(column) != running} or varying
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
        dense = replace(found, whole=replace(found.whole, measurement=model.with_inputs(inputs, _GRID)))
        h, error = dense.fitted, dense.fitted_errors
    q = half_width(CONFIDENCE, None if found.freedom is None else float(np.min(found.freedom)))
    fig, (ax,) = common.panels(1, height=3.2)
    fig.set_figwidth(5.2)
    band = f"{100 * CONFIDENCE:.0f} % band of the curve"
    ax.fill_between(at, h - q * error, h + q * error, color=look.color, alpha=0.2, linewidth=0, label=band)
    ax.plot(at, h, color=look.color, label=common.text(found.label))
    ax.plot(x, z, "o", color=BOUND_COLOR, markersize=3.5, rasterized=len(x) > _MANY, label="readings", zorder=3)
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
        good, style = np.isfinite(r) & ~out, {"color": look[one.label].color, "legend": False, "ax": ax}
        size = 9 if len(x) > 100 else 20
        sns.scatterplot(x=x[good], y=r[good], s=size, alpha=0.75, linewidth=0, rasterized=len(x) > _MANY, **style)
        if out.any():
            sns.scatterplot(x=x[out], y=r[out], s=25, marker="x", linewidth=1.2, label="outlier", **style)
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


def draw_bounds(now: Observability, after: Observability | None, choice: str) -> Iterator[Drawing]:
    """Draws the bound of each parameter in its unit, today and after a `choice` of readings."""
    sizes = np.array([p.size for p in now.parameters])
    fig, (ax,) = _rows([f"{p.name} [{p.unit}]" if p.unit else p.name for p in now.parameters], 1)
    y = np.arange(len(now.parameters))
    known, today = np.isfinite(now.bound), sizes * now.bound
    chosen = today if after is None else sizes * after.bound
    common.decades(ax, np.append(today, chosen))
    if after is not None:
        ax.hlines(y[known], today[known], chosen[known], color=BOUND_COLOR, linewidth=1.0, zorder=1)
    hollow: Any = {"markerfacecolor": "white", "markersize": 8, "markeredgewidth": 1.0}
    ax.plot(today[known], y[known], "o", color=BOUND_COLOR, label="today", **hollow)
    if after is not None:
        ax.plot(chosen, y, "o", color=FAMILIES["IPE"][0], label=choice)
    ax.set_xlabel("bound, in the unit of each row")
    common.legend(fig, [ax])
    caption = "Cramér-Rao bound of each parameter's standard deviation, root mean square over truths from the prior."
    if not known.all():
        caption += " Without a hollow mark: today's readings leave the parameter open."
    title = "Bounds today" if after is None else "Bounds today and after the best choice"
    yield Drawing("design", title, caption, fig)


def draw_marginals(model: Measurement, found: Sequence[Reference]) -> Iterator[Drawing]:
    """Draws marginals of the first trial's posterior beside the Gaussians of estimators, the worst parameters."""
    one = found[0]
    mean, deviation, look = one.posterior.mean, one.posterior.deviation, looks_of(one.estimators)
    claims = {}
    for label, each in one.estimates.items():
        P = np.full((model.n, model.n), np.nan) if each.covariance is None else each.covariance[0]
        claims[label] = each.x[0], np.sqrt(np.diag(P))
    with np.errstate(all="ignore"):
        apart = [np.abs(x - mean) / deviation + np.abs(np.log(s / deviation)) for x, s in claims.values()]
    worst = np.nan_to_num(np.max(apart, axis=0), nan=np.inf) if apart else np.zeros(model.n)
    chosen = np.sort(np.argsort(-worst, kind="stable")[: common.most_panels()])
    fig, axes = common.panels(len(chosen), look, height=2.4)
    for i, ax in zip(chosen, axes, strict=True):
        p = model.parameters[i]
        low, high = (p.size * (mean[i] + side * _FARTHEST * deviation[i]) for side in (-1, 1))
        at, filled = np.linspace(low, high, 300), {"color": BOUND_COLOR, "alpha": 0.25, "label": "posterior"}
        ax.hist(p.size * one.posterior.x[:, i], bins=40, range=(low, high), density=True, **filled)
        for label, (x, s) in claims.items():
            value, width = p.size * x[i], p.size * s[i]
            line = {"color": look[label].color, "linestyle": look[label].line["linestyle"]}
            if width > 0 and np.isfinite(value):
                density = np.exp(-0.5 * ((at - value) / width) ** 2) / (width * np.sqrt(2 * np.pi))
                ax.plot(at, density, **line)
        ax.axvline(p.size * one.truth[i], color=BOUND_COLOR, linestyle=":", label="truth")
        ax.set_xlim(low, high)
        ax.set_yticks([])
        common.title(ax, f"{p.name} [{p.unit}]" if p.unit else p.name)
        common.full_ticks(ax)
    common.legend(fig, axes, {label: replace(each, marker="") for label, each in look.items()})
    more = f", the {len(chosen)} parameters in which they differ most" if len(chosen) < model.n else ""
    caption = f"Trial {one.trial}: draws of the posterior beside the Gaussians that estimators report{more}."
    yield Drawing("posterior", "Marginals", caption, fig)


def draw_pairs(frame: pd.DataFrame) -> Iterator[Drawing]:
    """Draws the change of each tested quantity with its interval, a row per comparison."""
    listed: list[Any] = frame.to_dict("records")
    rows = [row for row in listed if np.isfinite(row["low"]) and np.isfinite(row["high"])]
    if not rows:
        return
    parts = [[row["second"], *comparison_title(row).split(", ")] for row in rows]
    shared = set.intersection(*map(set, parts)) if len(set(map(tuple, parts))) > 1 else set()
    names = {id(row): ", ".join(w for w in words if w not in shared) for row, words in zip(rows, parts, strict=True)}
    labels = list(dict.fromkeys(names.values()))
    kinds = list(dict.fromkeys(row["quantity"] for row in rows))[: common.most_panels()]
    fig, axes = _rows(labels[:MOST_ROWS], len(kinds))
    for kind, ax in zip(kinds, axes, strict=True):
        shown = [row for row in rows if row["quantity"] == kind and names[id(row)] in labels[:MOST_ROWS]]
        places = [labels.index(names[id(row)]) for row in shown]
        _draw_changes(ax, kind, shown, places, frame.attrs["margins"][kind.partition(" ")[0]])
    for words, mark in _FINDINGS.values():
        axes[0].plot([], [], linestyle="none", label=words, **mark)
    common.legend(fig, axes)
    caption = "Second against first in the same trials, each with its own interval; grey: changes below the margin."
    if len(labels) > MOST_ROWS:
        caption += f" {len(labels) - MOST_ROWS} further comparisons are in the table."
    yield Drawing("comparison", "Changes trial by trial", caption, fig)


def _draw_changes(ax: Axes, kind: str, rows: Sequence[Any], places: Sequence[int], margin: float) -> None:
    """Draws the changes of one quantity at their places down the axis, beside the band of those below the margin."""
    factor = 100 if kind == "success" else 1
    for row, y in zip(rows, places, strict=True):
        _, mark = _FINDINGS[row["finding"] or "different" * row["different"]]
        ax.plot([factor * row["low"], factor * row["high"]], [y, y], color=mark["color"], linewidth=1.4)
        ax.plot(factor * row["change"], y, **mark)
    ratio = kind != "success" and not kind.startswith("bias")
    same, least, most = (1.0, 1 / (1 + margin), 1 + margin) if ratio else (0.0, -factor * margin, factor * margin)
    low, high = ax.get_xlim()
    if ratio and high > 3 * max(low, 0.0):
        ax.set_xscale("log")
        low, high = ax.get_xlim()
        low, high = min(low, 0.8), max(high, 1.25)
        common.log_ticks(ax.xaxis, low, high)
    elif ratio:
        low, high = min(low, 0.9), max(high, 1.1)
    ax.set_xlim(min(low, least), max(high, most))
    common.band(ax, least, most, "smaller than the margin")
    ax.axvline(same, color=BOUND_COLOR, linewidth=0.8, linestyle=":")
    common.title(ax, f"{kind}, {'ratio' if ratio else 'points' if kind == 'success' else 'difference'}")


def draw_audit(found: Audit) -> Iterator[Drawing]:
    """Draws the errors in reported standard deviations beside the law that the report claims, the worst parameters."""
    claims, n = found.claims, found.claims.n
    worst = np.argsort([-abs(np.log(max(f.value, 1e-300))) for f in found.each], kind="stable")
    chosen = np.sort(worst[: common.most_panels()])
    fig, axes = common.panels(len(chosen), height=2.4)
    at = np.linspace(-_FARTHEST, _FARTHEST, 300)
    for i, ax in zip(chosen, axes, strict=True):
        values = np.clip(claims.z[:, i], -_FARTHEST, _FARTHEST)
        style = {"color": FAMILIES["IPE"][0], "alpha": 0.45, "label": "errors"}
        ax.hist(values, bins=30, range=(-_FARTHEST, _FARTHEST), density=True, **style)
        claimed = np.exp(-0.5 * at**2) / np.sqrt(2 * np.pi)
        ax.plot(at, claimed, color=BOUND_COLOR, linestyle="--", linewidth=1.0, label="as claimed")
        ax.set_yticks([])
        common.title(ax, f"{claims.names[i]}: {found.each[i].value:.2f} times")
    common.axis_labels(fig, "error / reported deviation", "")
    common.legend(fig, axes)
    more = f" The {len(chosen)} of {n} parameters farthest from 1." if len(chosen) < n else ""
    caption = f"Errors beyond ±{_FARTHEST:g} reported deviations stand at the edge.{more}"
    yield Drawing("audit", "Errors beside what is claimed", caption, fig)


def _rows(labels: Sequence[str], panels: int) -> tuple[Figure, list[Axes]]:
    """Makes a figure of panels that share labelled rows."""
    from matplotlib.figure import Figure

    words = [common.text(label) for label in labels]
    width = 0.07 * max(map(len, words)) + max(2.2 * panels, 4.5)
    fig = Figure(figsize=(min(width, 11.0), 1.1 + 0.26 * len(words)), layout="constrained")
    axes = list(fig.subplots(1, panels, sharey=True, squeeze=False).flat)
    axes[0].set_yticks(range(len(words)), words)
    axes[0].set_ylim(len(words) - 0.5, -0.5)
    return fig, axes
