"""Everything the report is made of, computed from directories one scenario at a time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from ipe_bench.basics.linalg import Array
from ipe_bench.basics.statuses import Status
from ipe_bench.statistics.collect import Collection, Group, collect
from ipe_bench.statistics.comparisons import Outcomes, Ranking, compare_pairs, leaders, rank_over_scenarios
from ipe_bench.statistics.histories import History, trial_label
from ipe_bench.statistics.intervals import bootstrap_rms, quantile, quantiles
from ipe_bench.statistics.profiles import Profiles
from ipe_bench.statistics.records import SCORES, rows_of
from ipe_bench.statistics.sample import Sample, Shared
from ipe_bench.statistics.summary import summary_rows, to_frame

PROBABILITIES = np.unique(np.concatenate([np.linspace(0, 1, 101), [0.001, 0.005, 0.025, 0.975, 0.995, 0.999]]))
"""Where the distribution of errors is tabulated."""


@dataclass(frozen=True)
class Analysis:
    """Tidy tables that figures, tables and the page are drawn from. Each starts with the scenario's columns; those of a
    scenario under an estimator add `scenario`, its number, and `estimator`."""

    collection: Collection
    summary: pd.DataFrame
    by_group: pd.DataFrame
    """Root mean square of error over linear bound per group of parameters, with its bootstrap interval."""
    endings: pd.DataFrame
    """How trials ended that did not converge: status, message, number, and the first such trial."""
    pairs: pd.DataFrame
    """Every pair of estimators on every scenario; see `comparisons.Pair`."""
    scores: pd.DataFrame
    """Per scenario and estimator: capped mean error, whether it leads significantly, and median costs."""
    ranking: Ranking | None
    profiles: pd.DataFrame
    """Estimator, profile (performance or data), `at` (cost ratio or budget) and share, over all scenarios."""
    distributions: pd.DataFrame
    """Quantiles of the Mahalanobis error: probability (of `PROBABILITIES`) and distance."""
    correlations: pd.DataFrame
    """Of the parameters' errors over solved trials: row, column (both parameters' names) and value."""
    convergence: pd.DataFrame
    """Of each converged trial with a stored history: trial, iteration, and the iterate's distance from the last one
    in deviations of the bound."""
    contraction: pd.DataFrame
    """Per scenario, how much the fixed-point iteration contracts at the truth; empty where no file says so."""

    @property
    def problems(self) -> tuple[str, ...]:
        return tuple(self.collection.problems)

    @property
    def stale(self) -> tuple[str, ...]:
        return tuple(self.collection.stale)

    @property
    def with_equation(self) -> set[str]:
        """The estimators that seek a root of something; filters and the linear LSE do not, and only finish."""
        return {g.estimator for g in self.collection.groups if g.footer.get("equation") is not None}

    @property
    def setting_columns(self) -> list[str]:
        """The columns that tell scenarios apart, but for the error scale."""
        first = self.collection.groups[0].columns if self.collection.groups else {}
        return [c for c in first if c != "error_scale"]


def analyse(directories: Sequence[Path | str]) -> Analysis:
    """Reads what is stored under the directories and computes all statistics.

    Raises:
        UserError: a directory does not exist.
    """
    collection = collect(directories)
    rows = _Rows()
    for number, groups in enumerate(collection.scenarios.values()):
        _add_scenario(rows, collection, number, groups)
    return Analysis(
        collection=collection,
        summary=to_frame(rows.summary),
        by_group=pd.DataFrame(rows.by_group),
        endings=pd.DataFrame(rows.endings),
        pairs=pd.DataFrame(rows.pairs),
        scores=pd.DataFrame(rows.scores),
        ranking=rank_over_scenarios(rows.ranked),
        profiles=rows.profiles.frame(),
        distributions=_joined(rows.distributions, ("probability", "distance")),
        correlations=_joined(rows.correlations, ("row", "column", "value")),
        convergence=_joined(rows.convergence, ("trial", "iteration", "distance")),
        contraction=pd.DataFrame(rows.contraction),
    )


@dataclass
class _Rows:
    """What one scenario after another adds to; see `Analysis`."""

    summary: list[dict[str, Any]] = field(default_factory=list)
    by_group: list[dict[str, Any]] = field(default_factory=list)
    endings: list[dict[str, Any]] = field(default_factory=list)
    pairs: list[dict[str, Any]] = field(default_factory=list)
    scores: list[dict[str, Any]] = field(default_factory=list)
    contraction: list[dict[str, Any]] = field(default_factory=list)
    distributions: list[pd.DataFrame] = field(default_factory=list)
    correlations: list[pd.DataFrame] = field(default_factory=list)
    convergence: list[pd.DataFrame] = field(default_factory=list)
    ranked: list[dict[str, float]] = field(default_factory=list)
    profiles: Profiles = field(default_factory=Profiles)


def _joined(parts: Sequence[pd.DataFrame], columns: Sequence[str]) -> pd.DataFrame:
    if not parts:
        return pd.DataFrame(columns=["scenario", "estimator", *columns])
    return pd.concat(parts, ignore_index=True)


def _add_scenario(rows: _Rows, collection: Collection, number: int, groups: Sequence[Group]) -> None:
    shared = Shared.among(collection, groups)
    outcomes: dict[str, Outcomes] = {}
    scores: list[dict[str, Any]] = []
    rows.contraction += _contraction_rows(collection, groups[0])
    for group in groups:
        sample = Sample.load(collection, group, shared)
        if len(sample) == 0:
            continue
        where = numbered(group, number)
        rows.summary += summary_rows(sample)
        rows.by_group += _group_rows(sample)
        rows.endings += _ending_rows(sample)
        scores.append(where | rows_of(SCORES, sample)[-1])
        outcomes[group.estimator] = outcome = outcomes_of(sample)
        rows.distributions.append(_distribution(where, outcome))
        rows.correlations.append(_correlation_rows(where, sample))
        rows.convergence += [_convergence_rows(where, history) for history in sample.histories]
    compared = compare_pairs(outcomes)
    capped = {row["estimator"]: row["capped_error"] for row in scores}
    ahead = leaders(capped, compared)
    rows.pairs += [dict(groups[0].columns) | asdict(pair) for pair in compared]
    rows.scores += [row | {"leads": row["estimator"] in ahead} for row in scores]
    rows.ranked.append(capped)
    rows.profiles.add(outcomes)


def head(group: Group) -> dict[str, Any]:
    return dict(group.columns) | {"estimator": group.estimator}


def numbered(group: Group, number: int) -> dict[str, Any]:
    """The columns that a frame of one scenario and estimator starts with."""
    return dict(group.columns) | {"scenario": number, "estimator": group.estimator}


def outcomes_of(sample: Sample) -> Outcomes:
    """What comparisons and profiles need of a sample, by ascending seed and trial."""
    order = np.argsort(sample.number, kind="stable")
    values = (sample.number, sample.distance, sample.scalars["success"], sample.cost)
    return Outcomes(*(v[order] for v in values))


def _group_rows(sample: Sample) -> list[dict[str, Any]]:
    """Per group of parameters, in the order of the parameters; the group's bound is one in these units."""
    members: dict[str, list[int]] = {}
    for i, parameter in enumerate(sample.parameters):
        members.setdefault(parameter.get("group") or parameter["name"], []).append(i)
    rows = []
    solved = sample.solved
    squares = np.where(solved[:, None], sample.normalised, 0.0) ** 2
    means = np.stack([squares[:, which].mean(axis=1) for which in members.values()], axis=1)
    lows, highs = bootstrap_rms(means, solved)
    for i, name in enumerate(members):
        rmse = float(np.sqrt(means[solved, i].mean())) if solved.any() else np.nan
        rows.append(head(sample.group) | {"group": name, "rmse": rmse, "low": lows[i], "high": highs[i]})
    return rows


_CONTRACTION = ("contraction_K", "contraction_norm", "contraction_radius")


def _contraction_rows(collection: Collection, group: Group) -> list[dict[str, Any]]:
    """Median and largest contraction constants over the scenario's trials, and how often they promise convergence."""
    parts = [collection.load(truth, (), _CONTRACTION) for _, truth in group.cells if truth is not None]
    if not parts or any(name not in part for part in parts for name in _CONTRACTION):
        return []
    row: dict[str, Any] = {k: v for k, v in head(group).items() if k != "estimator"}
    for name in _CONTRACTION:
        values = np.concatenate([part[name] for part in parts])
        row |= {f"{name}_median": quantile(values, 0.5), f"{name}_max": quantile(values, 1.0)}
        row[f"{name}_below_1"] = float((values < 1).mean())
    return [row]


def _ending_rows(sample: Sample) -> list[dict[str, Any]]:
    at = np.flatnonzero(~sample.converged)
    messages = sample.scalars.get("message")
    counts: Counter[tuple[str, str]] = Counter()
    first: dict[tuple[str, str], str] = {}
    for i in at:
        message = "" if messages is None or messages[i] is None else str(messages[i])
        ending = (str(sample.scalars["status"][i]), message)
        counts[ending] += 1
        first.setdefault(ending, trial_label(*sample.ids[i]))
    shown = counts.most_common(MESSAGES)
    rest = sum(counts.values()) - sum(count for _, count in shown)
    result = [
        {"status": status, "message": message or _reason(status), "trials": count, "first": first[status, message]}
        for (status, message), count in shown
    ]
    if rest:
        result.append({"status": "others", "message": "further messages, each rarer", "trials": rest, "first": ""})
    return [head(sample.group) | row | {"share": row["trials"] / len(sample)} for row in result]


MESSAGES = 20
"""Different messages of one estimator on one scenario that are listed one by one."""


def _reason(status: str) -> str:
    reasons = {s.label: s.reason for s in Status}
    return reasons.get(status, "")


def _distribution(where: dict[str, Any], outcome: Outcomes) -> pd.DataFrame:
    return pd.DataFrame(where | {"probability": PROBABILITIES, "distance": quantiles(outcome.distance, PROBABILITIES)})


def _correlation_rows(where: dict[str, Any], sample: Sample) -> pd.DataFrame:
    names = [str(p["name"]) for p in sample.parameters]
    n = len(names)
    values = _correlation(sample).ravel()
    return pd.DataFrame(where | {"row": np.repeat(names, n), "column": np.tile(names, n), "value": values})


def _correlation(sample: Sample) -> Array:
    """(n, n); NaN where an error does not vary or there are too few trials."""
    used = sample.error[sample.solved]
    n = sample.error.shape[1]
    if len(used) < 3:
        return np.full((n, n), np.nan)
    # Errors over their bounds first: parameters may differ by many orders of magnitude.
    centred = (used - used.mean(axis=0)) / sample.linear_bound
    covariance = centred.T @ centred
    deviation = np.sqrt(np.diag(covariance))
    with np.errstate(all="ignore"):
        return covariance / np.outer(deviation, deviation)


def _convergence_rows(where: dict[str, Any], history: History) -> pd.DataFrame:
    iteration = np.arange(len(history.distances))
    return pd.DataFrame(where | {"trial": history.trial, "iteration": iteration, "distance": history.distances})
