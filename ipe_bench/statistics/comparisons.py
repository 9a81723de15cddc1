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
    not ties, `favours` the one on whose side the sum of the signed ranks is. `only_first` counts
    the trials in which the first alone succeeds; `p_success` is McNemar's exact test of these
    numbers.
    """
    from scipy.stats import rankdata, wilcoxon  # late: takes longer to load than all else here

    rows = []
    for (first, a), (second, b) in itertools.combinations(outcomes.items(), 2):
        d = differences(a.distance, b.distance)
        differing = d[d != 0]
        side = float(np.sign(differing) @ rankdata(np.abs(differing)))
        alone = int((a.success & ~b.success).sum()), int((b.success & ~a.success).sum())
        row = {"first": first, "second": second, "trials": len(d)}
        row |= {
            "wins": int((d < 0).sum()),
            "ties": len(d) - len(differing),
            "losses": int((d > 0).sum()),
        }
        row["median_difference"] = float(np.median(d)) if len(d) else float("nan")
        row["p_error"] = float(np.asarray(wilcoxon(differing))[1]) if len(differing) else 1.0
        row["favours"] = first if side < 0 else second if side > 0 else ""
        rows.append(
            row | {"only_first": alone[0], "only_second": alone[1], "p_success": mcnemar(*alone)}
        )
    return rows


def corrected(pairs: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Corrects each kind of p by Holm over all rows, and adds `closer`: the estimator that is
    significantly closer to the truth, or empty."""
    p_error, p_success = (
        holm([pair[name] for pair in pairs]).tolist() for name in ("p_error", "p_success")
    )
    return [
        {
            **pair,
            "p_error": error,
            "p_success": success,
            "closer": pair["favours"] if error < ALPHA else "",
        }
        for pair, error, success in zip(pairs, p_error, p_success, strict=True)
    ]


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
    return min(1.0, 2 * float(bdtr(min(only_first, only_second), only_first + only_second, 0.5)))


def holm(p: Sequence[float], weights: Sequence[float] | None = None) -> Array:
    """Corrects p-values so that any error among them has the stated probability, which is shared by
    the weights, or evenly (Holm, Scand. J. Statist. 6, 1979, section 4)."""
    shares = np.ones(len(p)) if weights is None else np.asarray(weights, dtype=float)
    values = np.asarray(p, dtype=float) / shares
    order = np.argsort(values, kind="stable")
    steps = values[order] * np.cumsum(shares[order][::-1])[::-1]
    result = np.empty(len(values))
    result[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return result


def may_be_best(success: Array, level: float = ALPHA) -> Array:
    """Returns which of k estimators no rival surely beats in success (trials, k) in the same
    trials.

    McNemar's exact one-sided test against every rival at `level` / (k - 1): an estimator that is
    truly a best one is left out with a probability of at most `level` (multiple comparisons with
    the best: Hsu, Ann. Statist. 9, 1981).
    """
    k = success.shape[1]
    won = (success.astype(float).T @ (~success).astype(float)).astype(int)
    p = bdtr(won, won + won.T, 0.5)
    return p.min(axis=1, initial=1.0) > level / max(k - 1, 1)
