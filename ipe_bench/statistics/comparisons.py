"""Comparisons of estimators on the same trials: differences of error, of success, and ranks over scenarios.

The error of a trial is its Mahalanobis distance sqrt(e' J' R^-1 J e) from the truth, in standard deviations of the
Cramér-Rao bound: about sqrt(n) for an efficient estimator. An estimate that is not finite is infinitely wrong.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import binomtest, friedmanchisquare, studentized_range, wilcoxon

from ipe_bench.basics.linalg import Array

TIE = 1e-3
"""Errors closer than this, in standard deviations, are equal: round-off is never a difference."""
ALPHA = 0.05


@dataclass(frozen=True)
class Outcomes:
    """What comparisons need of an estimator's trials on one scenario."""

    ids: Array
    """(trials,) ascending: one number per (seed, trial)."""
    distance: Array
    """(trials,) Mahalanobis errors, infinite where the estimate is not finite."""
    success: Array
    cost: Array
    """(trials,) simulations, a Jacobian counting n."""

    def at(self, ids: Array) -> Outcomes:
        """The trials with these numbers, all of which are there."""
        if len(ids) == len(self.ids):
            return self
        rows = np.searchsorted(self.ids, ids)
        return Outcomes(ids, self.distance[rows], self.success[rows], self.cost[rows])


def common(outcomes: Mapping[str, Outcomes]) -> dict[str, Outcomes]:
    """The outcomes on the trials that every estimator has, in the same order."""
    shared: Array | None = None
    for outcome in outcomes.values():
        if shared is None or not np.array_equal(shared, outcome.ids):
            shared = outcome.ids if shared is None else np.intersect1d(shared, outcome.ids, assume_unique=True)
    return {} if shared is None else {label: outcome.at(shared) for label, outcome in outcomes.items()}


@dataclass(frozen=True)
class Pair:
    """Two estimators on one scenario's common trials; a win is a smaller error by more than `TIE`."""

    first: str
    second: str
    trials: int
    wins: int
    ties: int
    losses: int
    median_difference: float
    """Median of first's error less second's, in standard deviations of the bound."""
    p_error: float
    """Wilcoxon's signed-rank test of the differences that are not ties, Holm-corrected over the pairs."""
    only_first: int
    """Trials in which the first alone succeeds."""
    only_second: int
    p_success: float
    """McNemar's exact test of those two numbers, Holm-corrected over the pairs."""


def compare_pairs(outcomes: Mapping[str, Outcomes]) -> list[Pair]:
    """Every pair of estimators of one scenario; corrections are over these pairs."""
    paired = common(outcomes)
    raw = [(a, b, *_compare(paired[a], paired[b])) for a, b in itertools.combinations(paired, 2)]
    p_error = holm([r[6] for r in raw])
    p_success = holm([r[9] for r in raw])
    return [
        Pair(a, b, len(paired[a].ids), wins, ties, losses, median, float(pe), only_a, only_b, float(ps))
        for (a, b, wins, ties, losses, median, _, only_a, only_b, _), pe, ps in zip(
            raw, p_error, p_success, strict=True
        )
    ]


def _compare(a: Outcomes, b: Outcomes) -> tuple[int, int, int, float, float, int, int, float]:
    d = differences(a.distance, b.distance)
    wins, losses = int((d < 0).sum()), int((d > 0).sum())
    only_a, only_b = int((a.success & ~b.success).sum()), int((b.success & ~a.success).sum())
    median = float(np.median(d)) if len(d) else float("nan")
    return wins, len(d) - wins - losses, losses, median, signed_rank(d), only_a, only_b, mcnemar(only_a, only_b)


def differences(first: Array, second: Array) -> Array:
    """First less second, ties exactly zero; two infinite errors are a tie."""
    with np.errstate(invalid="ignore"):
        d = first - second
    d[~np.isfinite(first) & ~np.isfinite(second)] = 0.0
    d[np.abs(d) < TIE] = 0.0
    return d


def signed_rank(d: Array) -> float:
    """Two-sided p of Wilcoxon's signed-rank test (Biometrics Bulletin 1, 1945), zeros left out; 1 where all are."""
    d = d[d != 0]
    if len(d) == 0:
        return 1.0
    # An infinite difference ranks above all finite ones; how far above does not matter to ranks.
    finite = np.abs(d[np.isfinite(d)])
    d = np.where(np.isfinite(d), d, np.sign(d) * (2 * finite.max(initial=1.0)))
    result: Any = wilcoxon(d)
    return float(result.pvalue)


def mcnemar(only_first: int, only_second: int) -> float:
    """Two-sided p of McNemar's exact test (Psychometrika 12, 1947): discordant trials are fair coin tosses."""
    if only_first + only_second == 0:
        return 1.0
    return float(binomtest(only_first, only_first + only_second, 0.5).pvalue)


def holm(p: Sequence[float]) -> Array:
    """P-values corrected so that any error among them has the stated probability (Holm, Scand. J. Statist. 6, 1979)."""
    values = np.asarray(p, dtype=float)
    order = np.argsort(values, kind="stable")
    steps = values[order] * np.arange(len(values), 0, -1)
    corrected = np.empty(len(values))
    corrected[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return corrected


def leaders(scores: Mapping[str, float], pairs: Sequence[Pair]) -> set[str]:
    """The best estimator of a scenario and those whose error does not differ significantly from its; empty where that
    is everyone, because then there is no best."""
    finite = {k: v for k, v in scores.items() if np.isfinite(v)}
    if len(finite) < 2:
        return set()
    best = min(finite, key=lambda k: finite[k])
    worse = set()
    for pair in pairs:
        if best in (pair.first, pair.second) and pair.p_error < ALPHA:
            other = pair.second if pair.first == best else pair.first
            if finite.get(other, np.inf) > finite[best]:
                worse.add(other)
    return set(scores) - worse if worse else set()


@dataclass(frozen=True)
class Ranking:
    """Mean ranks over scenarios, 1 being the best, with the difference that is needed to tell two apart."""

    mean_ranks: Mapping[str, float]
    scenarios: int
    friedman: float
    """P of Friedman's test (J. Amer. Statist. Assoc. 32, 1937) that all estimators rank alike."""
    critical_difference: float
    """Nemenyi's, q_0.05 sqrt(k (k + 1) / (6 N)) (Demsar, J. Mach. Learn. Res. 7, 2006, sec. 3.2.2)."""


def rank_over_scenarios(scores: Sequence[Mapping[str, float]]) -> Ranking | None:
    """Ranks of the estimators that every scenario has, by capped mean error; None with fewer than two of either.

    A scenario is one observation, however many trials it has: trials of one scenario share model, noise and prior, and
    would feign evidence.
    """
    everywhere = [label for label in (scores[0] if scores else ()) if all(label in s for s in scores)]
    k, count = len(everywhere), len(scores)
    if k < 2 or count < 2:
        return None
    ranks = np.array([tied_ranks(np.array([s[label] for label in everywhere])) for s in scores])
    if np.ptp(ranks, axis=1).max() == 0:
        friedman = 1.0
    elif k == 2:
        # Friedman's test of two is the sign test; the exact one is taken.
        friedman = mcnemar(int((ranks[:, 0] < ranks[:, 1]).sum()), int((ranks[:, 0] > ranks[:, 1]).sum()))
    else:
        friedman = float(friedmanchisquare(*ranks.T).pvalue)
    q = float(studentized_range.ppf(1 - ALPHA, k, np.inf)) / np.sqrt(2)
    difference = q * float(np.sqrt(k * (k + 1) / (6 * count)))
    return Ranking(dict(zip(everywhere, ranks.mean(axis=0).tolist(), strict=True)), count, friedman, difference)


def tied_ranks(scores: Array) -> Array:
    """Ranks from 1; scores closer than `TIE` to the next one share their mean rank."""
    scores = np.where(np.isfinite(scores), scores, np.inf)
    order = np.argsort(scores, kind="stable")
    ordered = scores[order]
    with np.errstate(invalid="ignore"):
        gap = np.diff(ordered)
    starts = np.concatenate([[True], gap >= TIE])
    group = np.cumsum(starts) - 1
    position = np.arange(1, len(scores) + 1, dtype=float)
    means = np.bincount(group, position) / np.bincount(group)
    ranks = np.empty(len(scores))
    ranks[order] = means[group]
    return ranks
