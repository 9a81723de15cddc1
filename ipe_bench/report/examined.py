"""What is known of an answer beyond its standard errors: as a table for the terminal, as data, and in words."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ipe_bench.real.examination import CONFIDENCE, Examination
from ipe_bench.report.words import enumerate_few

if TYPE_CHECKING:
    from rich.console import RenderableType

_COLLINEAR = 10.0
"""From here on the readings hardly tell parameters apart (Brun, Reichert and Künsch, Water Resources Research 37)."""
_INFLUENTIAL = 1.0
"""A reading without which a parameter would move by more standard errors than this is named."""
_MOST_READINGS = 5
_MOST_MINIMA = 3
_SMALL_SHARE = 0.1
"""Of the largest component: what is less of the least observable direction is not told."""

Labels = Sequence[Mapping[str, Any]]


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


def rows(found: Examination) -> list[tuple[str, str, str, str, str]]:
    """Parameter, unit, and the three intervals of each."""
    return [
        (
            p.name,
            p.unit,
            interval(found.wald[0][i], found.wald[1][i]),
            interval(found.profiles[i].low, found.profiles[i].high),
            interval(float(found.bootstrap.low[i]), float(found.bootstrap.high[i])),
        )
        for i, p in enumerate(found.model.natural_parameters)
    ] + [
        (one.parameter.name, one.parameter.unit, "-", interval(*sorted((one.bound, one.other))), "-")
        for one in found.on_bounds
    ]


def title(found: Examination) -> str:
    """Of the intervals."""
    prior = " with its prior" if found.with_prior else ""
    return f"{CONFIDENCE:.0%} intervals of {found.label}{prior}, by three ways".replace("%", " %")


HEADINGS = ("parameter", "unit", "standard error", "profile", "bootstrap")


def remarks(found: Examination, labels: Labels) -> Iterator[str]:
    """What a reader should know before signing, a sentence each."""
    names = [p.name for p in found.model.natural_parameters]
    if not found.least:
        best = found.minima[0]
        where = ", ".join(f"{n} = {v:.5g}" for n, v in zip(names, best.x, strict=True))
        yield (
            f"NOT THE LEAST MINIMUM: chi-square is {best.chi_square:.5g} at {where}; start there, or choose an"
            " estimator that searches, such as multiscale_lm."
        )
    others = found.ambiguous
    if others:
        for one in others[:_MOST_MINIMA]:
            where = ", ".join(f"{n} = {v:.5g}" for n, v in zip(names, one.x, strict=True))
            yield f"AMBIGUOUS: the readings fit as well at {where} (chi-square {one.chi_square:.5g})."
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
    yield from _influence(found, labels)
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


def _influence(found: Examination, labels: Labels) -> Iterator[str]:
    shift = np.nan_to_num(found.influence.shift, nan=0.0)
    strong = [i for i in np.argsort(-shift)[:_MOST_READINGS] if shift[i] >= _INFLUENTIAL]
    for i in strong:
        where = ", ".join(f"{k}={v}" for k, v in labels[i].items())
        yield f"Without the reading {where} a parameter would move by {shift[i]:.1f} standard errors."


def table(found: Examination) -> RenderableType:
    """The intervals, for a terminal."""
    from rich.markup import escape
    from rich.table import Table

    shown = Table(
        title=title(found), title_justify="left", title_style="bold", box=None, pad_edge=False, padding=(0, 1)
    )
    for k, heading in enumerate(HEADINGS):
        shown.add_column(heading, justify="left" if k < 2 else "right", no_wrap=k == 0)
    for row in rows(found):
        shown.add_row(*map(escape, row))
    return shown


def described(found: Examination, labels: Labels) -> dict[str, Any]:
    """Everything, as plain data for JSON."""
    names = [p.name for p in found.model.natural_parameters]

    def each(values: Any) -> dict[str, Any]:
        return dict(zip(names, numbers(values), strict=True))

    ends = [(p.low, p.high) for p in found.profiles]
    return {
        "estimator": found.label,
        "confidence": CONFIDENCE,
        "estimates": each(found.x),
        "standard_errors": each(found.standard_errors),
        "intervals": {
            "standard_error": each(np.transpose(found.wald)),
            "profile": each(ends),
            "bootstrap": each(np.column_stack([found.bootstrap.low, found.bootstrap.high])),
        },
        "profiles": {
            n: {"values": numbers(p.values), "zeta": numbers(p.zeta), "bent": p.bent}
            for n, p in zip(names, found.profiles, strict=True)
        },
        "bootstrap": {
            "drawn": found.bootstrap.drawn,
            "converged": found.bootstrap.converged,
            "bias": each(found.bootstrap.bias),
        },
        "least_observable": {
            "direction": each(found.direction.weights),
            "collinearity_index": numbers(found.direction.collinearity),
        },
        "minima": [
            {
                "estimates": each(one.x),
                "chi_square": numbers(one.chi_square),
                "starts": one.found,
                "as_good": one.as_good,
            }
            for one in found.minima
        ],
        "is_least_minimum": found.least,
        "with_prior": found.with_prior,
        "on_bounds": {one.parameter.name: numbers([one.bound, one.other]) for one in found.on_bounds},
        "remarks": list(remarks(found, labels)),
    }


def numbers(value: Any) -> Any:
    """Plain numbers for JSON, which knows neither NaN nor infinity: null in their place."""
    if np.ndim(value):
        return [numbers(v) for v in value]
    number = float(value)
    return number if math.isfinite(number) else None
