"""Simulates whole reports of estimators whose merits are known: trials are drawn from a population
and put straight into the frames that a page is written from, without estimators, models or
files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import ndtr
from scipy.stats import chi2, ncx2
from scipy.stats import f as fisher

from ipe_bench.report.page.headline import headline
from ipe_bench.report.tables.table import Part
from ipe_bench.statistics.analysis import Analysis
from ipe_bench.statistics.comparisons import Outcomes, compare_pairs, corrected, may_be_best
from ipe_bench.statistics.formulas import CAP
from ipe_bench.statistics.records import STATISTICS
from ipe_bench.statistics.sample import Sample
from ipe_bench.statistics.statistic import BEST, rows_of
from ipe_bench.trials.thresholds import GATE

FAR = 60.0
"""Error of a lost trial, in deviations of the bound."""
WILD, OFTEN = 10.0, 0.01
"""Size and share of the errors that contaminate a normal law."""
HOLDING = 0.9 - 1e-5
"""Success that an estimator holds: 0.9, less what a gate takes of efficient estimates."""
READINGS = 30
_READ = {
    *(
        "trials",
        "solved",
        "success",
        "failed_silent",
        "error_median",
        "error_q95",
        "efficiency_capped",
        *("nees_median", "nees_mean", "claims", "given"),
        "verdict",
    ),
    *("simulations_median", "simulations_mean", "time_mean_s", "path_verdict", "nis_verdict"),
}
"""Statistics that sentences, boxes and verdicts are made of; their other intervals take long and
are left out."""
_KEPT = [
    s if s.name in ("success", "nees_mean") else replace(s, limits=None)
    for s in STATISTICS
    if s.name in _READ
]


@dataclass(frozen=True)
class Population:
    """Describes an estimator at one error scale: the law of its errors, and what it says of
    them."""

    law: str = "normal"
    """Of the errors that are not lost: normal, t3 (Student's, 3 degrees) or contaminated."""
    spread: float = 1.0
    """Root mean square error over the bound, without bias and wild errors."""
    claim: float = 1.0
    """Mean square of these errors over the variance that is reported: 1 if honest, above 1 if too
    sure."""
    bias: float = 0.0
    """Of each parameter, in deviations of the bound."""
    lost: float = 0.0
    """Share of trials that end far from the truth."""
    silent: float = 0.0
    """Share of the lost that look right: converged, with residuals that fit."""
    innovations: float = 1.0
    """Mean NIS of a filter over the number of its readings."""
    correlated: float = 0.0
    """Share of trials whose innovations are so correlated that every test sees it."""

    @property
    def mean_square(self) -> float:
        """Of the errors that are not lost, without the bias."""
        wild = 1 - OFTEN + OFTEN * WILD**2 if self.law == "contaminated" else 1.0
        return self.spread**2 * wild

    def success(self, n: int) -> float:
        """Computes the share of trials inside the gate."""
        return (1 - self.lost) * _inside(self.law, self.spread, self.bias, n)

    @property
    def mean_nees(self) -> float:
        """The mean NEES / n of the trials that call themselves converged."""
        kept = 1 - self.lost
        wrong = self.lost * self.silent
        square = self.mean_square
        return (
            self.claim / square * (kept * (square + self.bias**2) + wrong * FAR**2) / (kept + wrong)
        )

    def efficiency(self, n: int) -> float:
        """Computes the efficiency of errors that count at most `CAP` (by 100,000 draws)."""
        squares = _capped_squares(self.law, self.spread, self.bias, n)
        return ((1 - self.lost) * squares + self.lost * CAP**2) ** -0.5


@lru_cache
def _inside(law: str, spread: float, bias: float, n: int) -> float:
    limit, off = chi2.isf(GATE, n), n * bias**2
    if law == "t3":
        return float(fisher.cdf(limit * 3 / (n * spread**2), n, 3))
    each = [
        float(ncx2.cdf(limit / (spread * k) ** 2, n, off / (spread * k) ** 2 + 1e-12))
        for k in (1.0, WILD)
    ]
    return (1 - OFTEN) * each[0] + OFTEN * each[1] if law == "contaminated" else each[0]


@lru_cache
def _capped_squares(law: str, spread: float, bias: float, n: int) -> float:
    rng = np.random.default_rng(1)
    z = rng.normal(size=(100_000, n)) * _sizes(law, rng.random(100_000))[:, None]
    return float(np.minimum(((spread * z + bias) ** 2).mean(axis=1), CAP**2).mean())


def _sizes(law: str, u: np.ndarray) -> np.ndarray:
    """Returns factors of a normal error from uniform numbers, one for all parameters of a trial."""
    if law == "t3":
        return chi2.isf(u, 3) ** -0.5
    return np.where((u < OFTEN) & (law == "contaminated"), WILD, 1.0)


# What is simulated --------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Board:
    """Holds a report to be drawn: its populations by estimator, one for each scale."""

    scales: tuple[float, ...]
    populations: Mapping[str, tuple[Population, ...]]
    family: Mapping[str, str]
    n: int
    trials: int
    alike: float
    """Correlation of the errors of different estimators, and of one at different scales, in the
    same trial."""
    moving: bool
    seed: int

    def success(self, label: str) -> list[float]:
        return [p.success(self.n) for p in self.populations[label]]


def board(seed: int, *, largest: bool = True) -> Board:
    """Draws what a report is of: honest estimators alone, or honest and dishonest ones together."""
    rng = np.random.default_rng([seed, 7])
    number = int(rng.integers(2, 11 if largest else 4))
    count = int(rng.integers(1, 8 if largest else 4))
    scales = (0.1, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0)[:count]
    labels = [f"e{i}" for i in range(number)]
    honest = rng.random() < 0.3
    populations = {label: tuple(_estimator(rng, count, honest=honest)) for label in labels}
    family = {label: str(rng.choice(["IPE", "filters", "least squares"])) for label in labels}
    trials = int(rng.choice([20, 40, 50, 100, 200, 400] if largest else [20, 40, 50]))
    n, alike = int(rng.choice([1, 2, 4, 11])), float(rng.choice([0.5, 0.9, 0.99, 0.999]))
    return Board(scales, populations, family, n, trials, alike, bool(rng.random() < 0.4), seed)


def _estimator(rng: np.random.Generator, count: int, *, honest: bool) -> Iterator[Population]:
    """Draws the populations of one estimator: it is right at small scales and begins to be wrong at
    one of them."""
    kinds = (
        ["honest"]
        if honest
        else ["honest", "sure", "cautious", "heavy", "biased", "losing", "silent", "inefficient"]
    )
    kind = str(
        rng.choice(kinds, p=None if honest else [0.3, 0.15, 0.05, 0.1, 0.1, 0.15, 0.1, 0.05])
    )
    law = str(rng.choice(["t3", "contaminated"])) if kind == "heavy" else "normal"
    # An estimator that reports the variance of the bulk is too sure where 1 % of its errors are
    # wild.
    of_bulk = 1 - OFTEN + OFTEN * WILD**2 if law == "contaminated" else 1.5
    heavy_claim = float(rng.choice([1.0, of_bulk]))
    claim = {
        "sure": rng.choice([1.2, 1.5, 2.0, 4.0]),
        "cautious": rng.choice([0.25, 0.5, 0.8]),
        "heavy": heavy_claim,
    }
    bias = float(rng.choice([0.3, 0.5, 1.0])) if kind == "biased" else 0.0
    losses = np.sort(
        rng.choice([0.0, 0.02, 0.05, 0.08, 0.1, 0.12, 0.15, 0.3, 0.6, 0.95], size=count)
    )
    silent = {"silent": float(rng.choice([0.2, 1.0])), "losing": 0.0}
    begins = int(rng.integers(0, count + 1))
    correlated = 0.0 if honest else float(rng.choice([0.0, 0.005, 0.05, 0.5]))
    for at in range(count):
        there = Population(law=law, claim=heavy_claim if kind == "heavy" else 1.0)
        if at < begins:
            yield there
            continue
        there = replace(there, claim=float(claim.get(kind, 1.0)), bias=bias)
        if kind in silent:
            there = replace(there, lost=float(losses[at]), silent=silent[kind])
        there = replace(there, correlated=correlated, innovations=1.2 if kind == "sure" else 1.0)
        yield replace(there, spread=1.2) if kind == "inefficient" else there


@dataclass(frozen=True, eq=False)
class _Group:
    """Stands for `collect.Group`."""

    columns: Mapping[str, Any]
    estimator: str
    footer: Mapping[str, Any]
    cells: tuple[Any, ...] = ()
    truths: tuple[Any, ...] = ()


@dataclass(frozen=True, eq=False)
class _Collection:
    """Stands for `collect.Collection`."""

    groups: tuple[_Group, ...]
    extra_problems: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Report:
    """Holds a simulated report: what it was drawn from, its trials, and what it says."""

    board: Board
    samples: Mapping[tuple[int, str], Sample]
    """By the place of the scale and the estimator."""
    analysis: Analysis
    parts: list[Part]

    def trials_of(self, scale: float, label: str) -> Sample:
        return self.samples[self.board.scales.index(scale), label]

    def population(self, scale: float, label: str) -> Population:
        return self.board.populations[label][self.board.scales.index(scale)]


def simulated(drawn: Board) -> Report:
    """Draws the trials of a report and writes its headline."""
    rng = np.random.default_rng([drawn.seed, 11])
    groups = {
        (at, label): _group(drawn, at, label)
        for at in range(len(drawn.scales))
        for label in drawn.populations
    }
    collection: Any = _Collection(tuple(groups.values()))
    common = (
        rng.normal(size=(drawn.trials, drawn.n)),
        rng.normal(size=drawn.trials),
        rng.random(drawn.trials),
    )
    samples = {
        key: _drawn(drawn, key, collection, group, common, rng) for key, group in groups.items()
    }
    analysis = _analysis(drawn, collection, samples)
    return Report(drawn, samples, analysis, headline(analysis))


def _group(drawn: Board, at: int, label: str) -> _Group:
    footer = {
        "family": drawn.family[label],
        "parameters": [{"name": f"x{i}", "unit": "m", "size": 1.0} for i in range(drawn.n)],
        "linear_bound": [1.0] * drawn.n,
        "readings": READINGS,
        "bound": "crlb",
        "identity": {"scenario": {}, "estimator": {}},
    }
    columns = {"measurement": "made up", "noise": "model" if drawn.moving else "gaussian"}
    return _Group({**columns, "error_scale": drawn.scales[at]}, label, footer)


def _drawn(
    drawn: Board, key: tuple[int, str], collection: Any, group: Any, common: Any, rng: Any
) -> Sample:
    at, label = key
    there, trials, n = drawn.populations[label][at], drawn.trials, drawn.n
    noise, luck, tails = common
    share_of_own = (1 - drawn.alike) ** 0.5
    z = drawn.alike**0.5 * noise + share_of_own * rng.normal(size=(trials, n))
    u = ndtr(drawn.alike**0.5 * luck + share_of_own * rng.normal(size=trials))
    error = there.spread * z * _sizes(there.law, tails)[:, None] + there.bias
    lost = u < there.lost
    # Of the lost, those with the least luck look right.
    silent = u < there.lost * there.silent
    error[lost] = FAR * np.sign(z[lost])
    deviation = np.full((trials, n), (there.mean_square / there.claim) ** 0.5)
    distance = (error**2).sum(axis=1)
    status = np.where(lost & ~silent, "diverged", "converged")
    scalars = {
        "status": status,
        "success": distance <= chi2.isf(GATE, n),
        "solved": status == "converged",
        "nees": distance / deviation[:, 0] ** 2,
        "crlb_distance": distance,
        "fit_p": np.full(trials, 0.5),
        "simulations": np.full(trials, float(sum(map(ord, label)))),
        "jacobians": np.zeros(trials),
        "time_s": np.full(trials, 1e-3),
        "iterations": np.full(trials, 3),
    }
    if drawn.moving:
        # The mean over ten epochs, dependent on the last.
        scalars["extra_nis"] = there.innovations * rng.chisquare(READINGS, trials) / READINGS
        scalars["white_p"] = np.where(
            rng.random(trials) < there.correlated, 1e-9, rng.random(trials)
        )
        scalars["path_error"] = np.sqrt(distance / n)
        scalars["path_nees"] = 0.5 * (
            scalars["nees"] + there.mean_nees * rng.chisquare(10 * n, trials) / 10
        )
    return Sample(
        collection,
        group,
        np.arange(trials),
        scalars,
        error,
        deviation,
        np.ones(trials, dtype=bool),
        np.empty(0, dtype=int),
    )


def _analysis(drawn: Board, collection: Any, samples: Mapping[tuple[int, str], Sample]) -> Analysis:
    """Summarises the trials by the formulas of the product."""
    summary, scores, pairs = [], [], []
    for at in range(len(drawn.scales)):
        here = {label: samples[at, label] for label in drawn.populations}
        outcomes = {label: Outcomes(s.distance, s.inside_gate) for label, s in here.items()}
        where = dict(next(iter(here.values())).group.columns) | {"scenario": at}
        best = may_be_best(np.column_stack([one.success for one in outcomes.values()]))
        for label, mark in zip(here, best.tolist(), strict=True):
            summary += _rows(here[label], mark)
            scores.append({**where, "estimator": label, "shared_trials": len(here[label])})
        pairs += [where | pair for pair in compare_pairs(outcomes)]
    none = pd.DataFrame()
    held = dict.fromkeys(
        (
            "endings",
            "distributions",
            "convergence",
            "calibration",
            "contraction",
            "tracks",
            "one_track",
        ),
        none,
    )
    frames = {
        "summary": pd.DataFrame(summary),
        "scores": pd.DataFrame(scores),
        "pairs": pd.DataFrame(corrected(pairs)),
    }
    return Analysis(collection=collection, **frames, **held)


def _rows(s: Sample, may_be_the_best: bool) -> list[dict[str, Any]]:
    """Returns rows of the summary: one per state, and one over all parameters."""
    head = dict(s.group.columns) | {"estimator": s.group.estimator, BEST: may_be_the_best}
    whole = head | {"parameter": "all"} | rows_of(_KEPT, s)[-1]
    whole["path_error_median"] = float(np.median(s.scalars.get("path_error", np.nan)))
    return [*({**whole, "parameter": name} for name in s.names), whole]
