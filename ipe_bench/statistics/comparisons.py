"""Comparisons of estimators on the same trials: differences of error and of success.

The error of a trial is its Mahalanobis distance sqrt(e' J' R^-1 J e) from the truth, in standard
deviations of the Cramér-Rao bound: about sqrt(n) for an efficient estimator. An estimate that is
not finite is infinitely wrong.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import bdtr

from ipe_bench.basics.linalg import Array

TIE = 1e-3
"""Errors closer than this, in standard deviations, are equal: round-off is never a difference."""
ALPHA = 0.05
EXACT = 50
"""Differing trials up to which every choice of signs is counted, as SciPy does without ties."""


@dataclass(frozen=True)
class Outcomes:
    """Holds what comparisons need of an estimator on one scenario, in the trials that every
    estimator has."""

    distance: Array
    """(trials,) Mahalanobis errors, infinite where the estimate is not finite."""
    success: Array
    """(trials,) whether the error lies inside the gate of the Cramér-Rao bound: one gate for all,
    prior or not."""


def compare_pairs(outcomes: Mapping[str, Outcomes]) -> list[dict[str, Any]]:
    """Returns a row for every pair of estimators of one scenario; see `corrected`.

    A win is an error of the first smaller by more than `TIE`; `median_difference` is the median of
    first's error less second's, `p_error` Wilcoxon's signed-rank test of the differences that are
    not ties, exact up to `EXACT` of them, `favours` the one on whose side the sum of the signed
    ranks is. `only_first` counts the trials in which the first alone succeeds; `p_success` is
    McNemar's exact test of these numbers.
    """
    return [
        {"first": first, "second": second, **_compared(first, a, second, b)}
        for (first, a), (second, b) in itertools.combinations(outcomes.items(), 2)
    ]


def _compared(first: str, a: Outcomes, second: str, b: Outcomes) -> dict[str, Any]:
    """Returns the numbers of `compare_pairs` on one pair."""
    from scipy.stats import rankdata, wilcoxon  # late: takes longer to load than all else here

    d = differences(a.distance, b.distance)
    differing = d[d != 0]
    median = float(np.median(d)) if len(d) else float("nan")
    # The sum of signed ranks: below 0 where the larger differences are in favour of the first.
    ranks = rankdata(np.abs(differing))
    side = float(np.sign(differing) @ ranks)
    if len(differing) > EXACT:
        p_error = float(np.asarray(wilcoxon(differing, method="asymptotic"))[1])
    else:
        p_error = signed_rank(ranks, side)
    favours = ""
    if side:
        favours = first if side < 0 else second
    only_first = int((a.success & ~b.success).sum())
    only_second = int((b.success & ~a.success).sum())
    return {
        "trials": len(d),
        "wins": int((d < 0).sum()),
        "ties": len(d) - len(differing),
        "losses": int((d > 0).sum()),
        "median_difference": median,
        "p_error": p_error,
        "favours": favours,
        "only_first": only_first,
        "only_second": only_second,
        "p_success": mcnemar(only_first, only_second),
    }


def signed_rank(ranks: Array, side: float) -> float:
    """Computes the two-sided p of a sum of signed ranks, tied or not, among all choices of signs.

    The law of the sum of positive ranks is that of one rank less and its copy shifted by the rank
    (Wilcoxon, Biometrics Bulletin 1, 1945).
    """
    # Tied ranks are halves: twice of each is whole.
    doubled = np.rint(2 * ranks).astype(int)
    total = int(doubled.sum())
    law = np.zeros(total + 1)
    law[0] = 1.0
    for rank in doubled:
        shifted = np.zeros(total + 1)
        shifted[rank:] = law[: total + 1 - rank]
        law = (law + shifted) / 2
    positive = round(total / 2 + side)
    # The law is symmetric: the tail beyond the sum is that of the smaller sum of either sign.
    smaller = min(positive, total - positive)
    return min(1.0, 2 * float(law[: smaller + 1].sum()))


def corrected(pairs: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Corrects each kind of p by Holm over all rows, and adds `closer`: the estimator that is
    significantly closer to the truth, or empty."""
    p_error = holm([pair["p_error"] for pair in pairs]).tolist()
    p_success = holm([pair["p_success"] for pair in pairs]).tolist()
    rows = []
    for pair, error, success in zip(pairs, p_error, p_success, strict=True):
        closer = pair["favours"] if error < ALPHA else ""
        rows.append({**pair, "p_error": error, "p_success": success, "closer": closer})
    return rows


def differences(first: Array, second: Array) -> Array:
    """Subtracts second from first, ties exactly zero; two infinite errors are a tie."""
    with np.errstate(invalid="ignore"):
        d = first - second
    d[~np.isfinite(first) & ~np.isfinite(second)] = 0.0
    d[np.abs(d) < TIE] = 0.0
    return d


def mcnemar(only_first: int, only_second: int) -> float:
    """Computes the two-sided p of McNemar's exact test (Psychometrika 12, 1947), by tosses of a
    fair coin."""
    fewer = min(only_first, only_second)
    one_sided = float(bdtr(fewer, only_first + only_second, 0.5))
    return min(1.0, 2 * one_sided)


def holm(p: Sequence[float], weights: Sequence[float] | None = None) -> Array:
    """Corrects p-values so that any error among them has the stated probability, which is shared by
    the weights, or evenly (Holm, Scand. J. Statist. 6, 1979, section 4)."""
    shares = np.ones(len(p))
    if weights is not None:
        shares = np.asarray(weights, dtype=float)
    values = np.asarray(p, dtype=float) / shares
    order = np.argsort(values, kind="stable")
    # The k-th smallest is multiplied by the weight of all that are not smaller.
    remaining = np.cumsum(shares[order][::-1])[::-1]
    steps = np.maximum.accumulate(values[order] * remaining)
    result = np.empty(len(values))
    result[order] = np.minimum(steps, 1.0)
    return result


def may_be_best(success: Array, level: float = ALPHA) -> Array:
    """Returns which of k estimators no rival surely beats in success (trials, k) in the same
    trials.

    McNemar's exact one-sided test against every rival at `level` / (k - 1): an estimator that is
    truly a best one is left out with a probability of at most `level` (multiple comparisons with
    the best: Hsu, Ann. Statist. 9, 1981).
    """
    k = success.shape[1]
    # won[i, j]: trials in which i succeeds and j fails.
    succeeded = success.astype(float)
    won = (succeeded.T @ (1 - succeeded)).astype(int)
    p = bdtr(won, won + won.T, 0.5)
    against_all = p.min(axis=1, initial=1.0)
    return against_all > level / max(k - 1, 1)
