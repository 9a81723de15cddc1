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
from ipe_bench.statistics.comparisons import (
    Outcomes,
    Ranking,
    capped_error,
    common,
    compare_pairs,
    leaders,
    rank_over_scenarios,
)
from ipe_bench.statistics.intervals import bootstrap_rms, quantile, quantiles
from ipe_bench.statistics.profiles import Profiles, distances_to_limit, iterations_to_limit
from ipe_bench.statistics.summary import Sample, common_trials, identifier, summary_rows, to_frame
from ipe_bench.statistics.theory import orders_of

PROBABILITIES = np.unique(np.concatenate([np.linspace(0, 1, 101), [0.001, 0.005, 0.025, 0.975, 0.995, 0.999]]))
"""Where the distribution of errors is tabulated."""
NIS = "extra_nis"
"""Where filters report their normalised innovations squared."""


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
    solved_by_all = common_trials(collection, groups)
    outcomes: dict[str, Outcomes] = {}
    scores: dict[str, dict[str, Any]] = {}
    n = 1
    rows.contraction += _contraction_rows(collection, groups[0])
    for group in groups:
        sample = Sample.load(collection, group, optional=["message", NIS])
        if len(sample) == 0:
            continue
        n = sample.error.shape[1]
        where = numbered(group, number)
        rows.summary += summary_rows(sample, solved_by_all)
        rows.by_group += _group_rows(sample)
        rows.endings += _ending_rows(sample)
        outcomes[group.estimator] = outcome = outcomes_of(sample)
        rows.distributions.append(_distribution(where, outcome))
        rows.correlations.append(_correlation_rows(where, sample))
        histories = _histories(collection, group, sample)
        rows.convergence += [
            pd.DataFrame(where | {"trial": h.trial, "iteration": np.arange(len(h.distances)), "distance": h.distances})
            for h in histories
        ]
        scores[group.estimator] = where | _score(sample, outcome, histories)
    for label, outcome in common(outcomes).items():
        scores[label]["capped_error"] = capped_error(outcome, n)
    compared = compare_pairs(outcomes)
    capped = {label: row["capped_error"] for label, row in scores.items()}
    ahead = leaders(capped, compared)
    scenario = dict(groups[0].columns)
    rows.pairs += [scenario | asdict(pair) for pair in compared]
    rows.scores += [row | {"leads": label in ahead} for label, row in scores.items()]
    rows.ranked.append(capped)
    rows.profiles.add(outcomes)


def _score(sample: Sample, outcome: Outcomes, histories: Sequence[History]) -> dict[str, Any]:
    """Medians of the costs; the capped error is added when all estimators of the scenario are known."""
    orders = [observed[-1] for h in histories if len(observed := orders_of(h.distances))]
    row = {
        "capped_error": np.nan,
        "cost_median": quantile(outcome.cost, 0.5),
        "cost_to_limit_median": quantile(np.array([h.cost_to_limit for h in histories]), 0.5),
        "histories": len(histories),
        "order_median": quantile(np.array(orders), 0.5),
    }
    if NIS in sample.scalars:
        values = sample.scalars[NIS]
        row[NIS] = float(np.mean(values[np.isfinite(values)])) if len(values) else np.nan
    return row


def head(group: Group) -> dict[str, Any]:
    return dict(group.columns) | {"estimator": group.estimator}


def numbered(group: Group, number: int) -> dict[str, Any]:
    """The columns that a frame of one scenario and estimator starts with."""
    return dict(group.columns) | {"scenario": number, "estimator": group.estimator}


def outcomes_of(sample: Sample) -> Outcomes:
    """What comparisons and profiles need of a sample, by ascending seed and trial."""
    ids = identifier(sample.ids)
    distance = np.sqrt(sample.scalars["crlb_distance"])
    distance[~np.isfinite(distance)] = np.inf
    cost = sample.cost
    success = sample.scalars["success"]
    if np.all(ids[1:] > ids[:-1]):
        return Outcomes(ids, distance, success, cost)
    order = np.argsort(ids, kind="stable")
    return Outcomes(ids[order], distance[order], success[order], cost[order])


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
        first.setdefault(ending, _trial_label(*sample.ids[i]))
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


@dataclass(frozen=True)
class History:
    """How a converged trial came to its limit."""

    trial: str
    distances: Array
    """(iterates,) from the last iterate, in deviations of the bound."""
    cost_to_limit: float
    """The cost of coming close; that of iterate k is its share (k + 1) / (iterates) of the trial's whole cost."""


def _histories(collection: Collection, group: Group, sample: Sample) -> list[History]:
    names = [p["name"] for p in sample.parameters]
    columns = [f"x_{name}" for name in names]
    result: list[History] = []
    for cell, _ in group.cells:
        stored = collection.load_history(cell, [*columns, "iteration"])
        if stored is None:
            continue
        x = np.stack([stored[c] for c in columns], axis=1)
        for trial in np.unique(stored["trial"]):
            at = np.flatnonzero((sample.ids[:, 0] == cell.seed) & (sample.ids[:, 1] == trial))
            history = x[stored["trial"] == trial]
            if len(at) == 0 or not sample.converged[at[0]] or len(history) < 2:
                continue
            distances = distances_to_limit(history, sample.crlb[at[0]])
            cost = float(sample.cost[at[0]]) * (iterations_to_limit(distances) + 1) / len(history)
            result.append(History(_trial_label(cell.seed, trial), distances, cost))
    return result


def _trial_label(seed: int, trial: int) -> str:
    return f"seed {seed}, trial {trial}"
