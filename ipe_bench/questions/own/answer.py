"""Shows which estimator to take for data like a user's own: sentences, tables, files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np
import pandas as pd

from ipe_bench.questions.own.maths import Claim, Own, Point
from ipe_bench.real.profiles import CONFIDENCE
from ipe_bench.report.page.writer import write_files
from ipe_bench.report.tables.table import Part, Strong, Table, texts, words
from ipe_bench.report.words import agreeing, compact, duration

NAME = "own"
TABLE = "own.csv"
_MISSES = 0.95
"""Share of data sets up to which an estimator is said to miss the best fit, if its interval lies
below."""
_NONE = 0.9
"""Likewise, the share below which none is taken."""
_TOO_SMALL = 0.88
"""Share of 95 % intervals that contain the truth below which they are said to be too small, unless
chance explains it: of one estimate, this verdict is true of fresh data sets in nine of ten
cases."""
_TOO_LARGE = 0.75
"""Share of their width that would do, below which they are said to be too large."""
_DEARER = 1.05
"""Factor of the cost from which on an estimator is said to cost more."""
_FAR = 100.0
"""Factor from which on error bars are wrong by far."""


def ranked(own: Own, point: Point) -> list[Claim]:
    """Selects the estimators that are told no more than the user knows."""
    return [one for one in point.claims if not one.told or own.states_prior]


def taken(own: Own, point: Point) -> Claim | None:
    """Chooses among those that find the best fit as often as any: of those whose error bars are
    right, the cheapest. None: no estimator is ranked."""
    equal = _equal(own, point)
    right = [one for one in equal if _bars(one) == "about right"]
    return min(right or equal, key=lambda one: one.cost, default=None)


def _equal(own: Own, point: Point) -> list[Claim]:
    """Selects the estimators that find the best fit as often as any, to two standard deviations of
    the share."""
    claims = ranked(own, point)
    top = max((one.finds for one in claims), default=0.0)
    variance = max(top * (1.0 - top), 0.01)
    slack = 2.0 * np.sqrt(variance / own.trials)
    return [one for one in claims if one.finds >= top - slack]


def hardest(own: Own) -> Point:
    """Joins the answers that fit to one truth: of each estimator what it does at the answer where
    it does worst, so that no claim depends on which of them is right."""
    claims = []
    for same in zip(*(point.claims for point in own.points), strict=True):
        worst = min(same, key=lambda one: one.found)
        least = min(same, key=lambda one: one.held)
        inside = tuple(chain.from_iterable(one.inside for one in same))
        claims.append(replace(worst, inside=inside, worst=least.worst, factor=least.factor))
    where = min(own.points, key=lambda point: sum(one.found for one in ranked(own, point)))
    return replace(where, claims=claims)


def takes_one(own: Own) -> bool:
    """Tells if an estimator can be taken, whichever answer that fits is right."""
    best = taken(own, hardest(own))
    return best is not None and best.finds_between[1] >= _NONE


def _bars(one: Claim) -> str:
    if one.holds < _TOO_SMALL and one.holds_between[1] < CONFIDENCE:
        return "too small"
    return "too large" if one.factor < _TOO_LARGE else "about right"


def _bars_in_words(one: Claim) -> str:
    verdict = _bars(one)
    low, high = one.holds_between
    share = f"{100 * low:.0f} to {100 * high:.0f} % contain the truth"
    if verdict == "about right":
        return f"its error bars are about right ({share})"
    factor = one.factor if verdict == "too small" else 1.0 / one.factor
    by = f" by about {factor:.2g}" if factor < _FAR else " by far"
    return f"its error bars of {one.worst} are {verdict}{by} ({share})"


def _about(share: float) -> str:
    """Rounds a share to a percent, since what one data set says of it is off by some."""
    return f"about {100 * share:.0f} %"


def _missing(own: Own, claims: Sequence[Claim]) -> str:
    """Says which estimators miss the best fit, and how often; empty if none does."""
    lost = [one for one in claims if one.finds_between[1] < _MISSES]
    if not lost:
        return ""
    first, *others = lost
    said = [f"{first.label} {_verb(own)} in {_about(1 - first.finds)}"]
    said += [f"{one.label} in {_about(1 - one.finds)}" for one in others]
    return ", ".join(said)


def _verb(own: Own) -> str:
    return "loses the track" if own.moving else "misses the best fit"


def advice(own: Own, point: Point) -> str:
    """Says which estimator to take at a point, or none, without a full stop."""
    best = taken(own, point)
    if best is None:
        return "no estimator is ranked, because all use a prior; state it by error_scale=X"
    if best.finds_between[1] < _NONE:
        remedy = "mend the model's prior"
        if not own.moving:
            remedy = f"start elsewhere, such as at {point.words}"
        lost = f"{best.label} {_verb(own)} in {_about(1 - best.finds)}"
        return f"take none: from this start the best, {lost}; {remedy}"
    others = [one for one in ranked(own, point) if one is not best]
    lost = _missing(own, others)
    if not lost and others:
        what = "lose the track" if own.moving else "miss the best fit"
        lost = f"no other is seen to {what} in more than {100 * (1 - _MISSES):.0f} %"
    return "; ".join(filter(None, [f"take {best.label}", _bars_in_words(best), lost]))


def headline(own: Own) -> str:
    """Returns the first line."""
    noun = "logs" if own.moving else "data sets"
    several = ""
    if len(own.points) > 1:
        number = f"{len(own.points)}"
        if own.further:
            number = f"the best {number} of {len(own.points) + own.further}"
        several = f", whichever of {number} answers that fit is right"
    return f"On {own.trials} simulated {noun} like yours{several}: {advice(own, hardest(own))}"


def sentences(own: Own) -> Iterator[str]:
    """Yields what else is to be said, the gravest first."""
    if len(own.points) > 1:
        each = [f"were {point.words} right, {advice(own, point)}" for point in own.points]
        number = len(own.points) + own.further
        yield f"Your data have {number} answers that fit: {'. And '.join(each)}."
    worst = hardest(own)
    yield from _dearer(own, worst)
    told = list(_told_a_prior(own, worst))
    if told:
        yield f"Not ranked, because they need a prior, which you did not state: {'; '.join(told)}."
    for why in dict.fromkeys(own.left_out.values()):
        labels = [label for label, reason in own.left_out.items() if reason == why]
        yield f"Left out, because each {why}: {', '.join(labels)}."


def _told_a_prior(own: Own, point: Point) -> Iterator[str]:
    """Says for each prior that estimators are told in the user's place which of them miss the best
    fit."""
    unranked = [one for one in point.claims if one not in ranked(own, point)]
    for told in dict.fromkeys(one.told for one in unranked):
        claims = [one for one in unranked if one.told == told]
        labels = ", ".join(one.label for one in claims)
        found = f"{labels} {agreeing('find', claims)} the best fit"
        yield f"with the prior {told}, {_missing(own, claims) or found}"


def _dearer(own: Own, point: Point) -> Iterator[str]:
    """Says what others cost that do as well as the one that is taken."""
    best = taken(own, point)
    if best is None or not takes_one(own):
        return
    equal = [one for one in _equal(own, point) if _bars(one) == _bars(best) and one is not best]
    equal.sort(key=lambda one: one.cost)
    factors = [(one.label, one.cost / max(best.cost, 1.0)) for one in equal]
    costs = [f"{label} {factor:.2g} times" for label, factor in factors if factor >= _DEARER]
    if costs:
        yield (
            f"Those that do as well from this start cost more than {best.label}:"
            f" {', '.join(costs)} as much."
        )


def own_parts(name: str, own: Own) -> Iterator[Part]:
    """Yields the sentences and tables, under the `name` of the model."""
    yield Strong(f"{headline(own)}.")
    yield from sentences(own)
    for number, point in enumerate(own.points):
        yield _table(name, own, point, number)


def _table(name: str, own: Own, point: Point, number: int) -> Table:
    best_first = ranked(own, point)
    claims = [*best_first, *(one for one in point.claims if one not in best_first)]
    values = point.words
    where = f"logs that begin at {values}" if own.moving else f"truth {values}, noise {own.noise}"
    columns = [
        words("estimator", [one.label for one in claims]),
        words("prior", [one.told for one in claims]),
        texts("keeps track, %" if own.moving else "finds, %", _shares(claims, "finds")),
        texts("covered, %", [_holding(one) for one in claims]),
        words("worst", [one.worst for one in claims]),
        texts("factor", [f"{one.factor:.2g}" for one in claims]),
        texts("cost", [compact(one.cost) for one in claims]),
        texts("time", [duration(one.seconds, 2) for one in claims]),
    ]
    title = f"{name}: {where}"
    if number:
        return Table(f"{NAME}_{number + 1}", title, "", columns)
    return Table(NAME, title, "", columns, notes=[_meaning(own)])


def _shares(claims: Sequence[Claim], key: str) -> list[str]:
    return [f"{100 * getattr(one, key):.1f}" for one in claims]


def _holding(one: Claim) -> str:
    low, high = one.holds_between
    return f"{100 * one.holds:.1f} ({100 * low:.0f} to {100 * high:.0f})"


def _meaning(own: Own) -> str:
    if own.moving:
        return (
            "keeps track: the last states lie within the gate of the bound, in logs that begin"
            " where yours does; covered: the truth lies in the 95 % bars of the last states, in"
            " logs from the model's prior. factor: by which the bars would be right. All shares are"
            " approximate."
        )
    return (
        "finds: the answer's readings lie closer to the best fit's than noise puts the"
        " best fit to the truth. covered: the truth lies in the 95 % interval that estimate prints,"
        " of the worst parameter, with the range that chance leaves. factor: by which the interval"
        " would be right."
        " cost: median evaluations of the model."
        f" Shares are of all {own.trials} data sets, whether the best fit was found or not, and"
        " approximate: the truth is your estimate, which is uncertain too."
    )


def frame(own: Own) -> pd.DataFrame:
    """Returns a row per truth and estimator."""
    rows = []
    for number, point in enumerate(own.points, 1):
        for one in point.claims:
            low, high = one.finds_between
            rows.append(
                {
                    "truth": number,
                    "estimator": one.label,
                    "prior": one.told,
                    "ranked": one in ranked(own, point),
                    "trials": one.trials,
                    "finds": one.finds,
                    "finds_low": low,
                    "finds_high": high,
                    "holds": one.holds,
                    "holds_low": one.holds_between[0],
                    "holds_high": one.holds_between[1],
                    "worst": one.worst,
                    "too_small_by": one.factor,
                    "cost": one.cost,
                    "time_s": one.seconds,
                    **point.at,
                }
            )
    return pd.DataFrame(rows)


def write_own(folder: Path, name: str, own: Own) -> list[Path]:
    """Writes the page, and own.csv with a row per truth and estimator; returns the files."""
    tables = [_table(name, own, point, number) for number, point in enumerate(own.points)]
    title = headline(own)
    return write_files(folder, NAME, (TABLE, frame(own)), title, list(sentences(own)), tables)
