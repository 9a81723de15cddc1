"""Everything the report is made of, computed from directories one scenario at a time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ipe_bench.basics.statuses import Status
from ipe_bench.statistics.attained import attained_table
from ipe_bench.statistics.calibration import POINTS, shared_level
from ipe_bench.statistics.collect import Collection, Group, collect
from ipe_bench.statistics.comparisons import (
    Outcomes,
    Pair,
    Ranking,
    compare_pairs,
    corrected,
    rank_over_replicates,
)
from ipe_bench.statistics.histories import History, trial_label
from ipe_bench.statistics.intervals import quantile, quantiles
from ipe_bench.statistics.profiles import Profiles
from ipe_bench.statistics.records import SCORES, capped_error, rows_of
from ipe_bench.statistics.sample import Sample, Shared
from ipe_bench.statistics.summary import ALL, mark_best, outcomes_of, summary_rows, to_frame

if TYPE_CHECKING:
    import pandas as pd

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
    """Per scenario and estimator: capped mean error, and median costs."""
    ranking: Ranking | None
    profiles: pd.DataFrame
    """Estimator, profile (performance or data), `at` (cost ratio or budget) and share, over all scenarios."""
    distributions: pd.DataFrame
    """Quantiles of the Mahalanobis error: probability (of `PROBABILITIES`) and distance."""
    correlations: pd.DataFrame
    """Of the parameters' errors over solved trials: row, column (both parameters' names) and value."""
    convergence: pd.DataFrame
    """Of each converged trial with a stored history: trial, iteration, and the iterate's distance from the last one
    in deviations of the bound; none of filters, whose epochs are not iterations. The last
    distance is zero by definition, which says nothing of convergence."""
    calibration: pd.DataFrame
    """Of each parameter, and of NEES under the parameter `all`: `at`, the `difference` of the empirical distribution
    function from the uniform one there, the ends `low` and `high` of the band that all of an honest estimator's keep
    within in 95 % of cases, and whether this one is `outside` (by either of its curves)."""
    contraction: pd.DataFrame
    """Per scenario, how much the fixed-point iteration contracts at the truth; empty where no file says so."""
    attained: pd.DataFrame
    """Which estimator attains known minima, over all scenarios; see `attained.attained_table`."""

    @property
    def problems(self) -> tuple[str, ...]:
        return tuple(self.collection.problems)

    @property
    def stale(self) -> tuple[str, ...]:
        return tuple(self.collection.stale)

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
    return begin(directories).finish()


def begin(directories: Sequence[Path | str]) -> Begun:
    """Reads what is stored under the directories and computes the summary, which stands long before all the rest.

    Raises:
        UserError: a directory does not exist.
    """
    collection, rows = collect(directories), _Rows()
    scenarios = enumerate(collection.scenarios.values())
    return Begun(collection, rows, [_add_scenario(rows, collection, number, groups) for number, groups in scenarios])


@dataclass(frozen=True)
class Begun:
    """An analysis of which the summary stands; comparisons, and libraries that take long to load, are still to come."""

    collection: Collection
    _rows: _Rows
    _scenarios: list[_Compared]

    @property
    def summary(self) -> Sequence[dict[str, Any]]:
        """The rows of `Analysis.summary`."""
        return self._rows.summary

    def finish(self) -> Analysis:
        everywhere = _everywhere(self.collection)
        for where, outcomes in self._scenarios:
            self._rows.pairs += [(where, pair) for pair in compare_pairs(outcomes)]
            self._rows.profiles.add({label: outcome for label, outcome in outcomes.items() if label in everywhere})
        self._scenarios.clear()
        return _analysis(self.collection, self._rows, everywhere)


def _analysis(collection: Collection, rows: _Rows, everywhere: set[str]) -> Analysis:
    import pandas as pd

    return Analysis(
        collection=collection,
        summary=to_frame(rows.summary),
        by_group=pd.DataFrame(rows.by_group),
        endings=pd.DataFrame(rows.endings),
        pairs=_pair_frame(rows.pairs),
        scores=pd.DataFrame(rows.scores),
        ranking=_ranking(rows.replicates, everywhere),
        profiles=rows.profiles.frame(),
        distributions=_joined(rows.distributions, ("probability", "distance")),
        correlations=_joined(rows.correlations, ("row", "column", "value")),
        convergence=_joined(rows.convergence, ("trial", "iteration", "distance")),
        calibration=_joined(rows.calibration, ("parameter", "at", "difference", "low", "high", "outside")),
        contraction=pd.DataFrame(rows.contraction),
        attained=attained_table(collection),
    )


@dataclass
class _Rows:
    """What one scenario after another adds to; see `Analysis`."""

    summary: list[dict[str, Any]] = field(default_factory=list)
    by_group: list[dict[str, Any]] = field(default_factory=list)
    endings: list[dict[str, Any]] = field(default_factory=list)
    pairs: list[tuple[dict[str, Any], Pair]] = field(default_factory=list)
    scores: list[dict[str, Any]] = field(default_factory=list)
    contraction: list[dict[str, Any]] = field(default_factory=list)
    distributions: list[dict[str, Any]] = field(default_factory=list)
    correlations: list[dict[str, Any]] = field(default_factory=list)
    convergence: list[dict[str, Any]] = field(default_factory=list)
    calibration: list[dict[str, Any]] = field(default_factory=list)
    replicates: list[tuple[int, int, str, float]] = field(default_factory=list)
    """Scenario, seed, estimator and capped error."""
    profiles: Profiles = field(default_factory=Profiles)


def _joined(parts: Sequence[dict[str, Any]], columns: Sequence[str]) -> pd.DataFrame:
    """Frames one after another, each given by its columns; what is not an array is the same in all its rows."""
    import pandas as pd

    if not parts:
        return pd.DataFrame(columns=["scenario", "estimator", *columns])
    lengths = [next(len(value) for value in part.values() if isinstance(value, np.ndarray)) for part in parts]
    joined: dict[str, Any] = {}
    for name in dict.fromkeys(name for part in parts for name in part):
        values: list[Any] = [part.get(name) for part in parts]
        if any(isinstance(value, np.ndarray) for value in values):
            pieces = [np.broadcast_to(value, (n,)) for value, n in zip(values, lengths, strict=True)]
            joined[name] = np.concatenate(pieces)
        else:
            joined[name] = pd.Series(values).repeat(lengths).array
    return pd.DataFrame(joined)


_Compared = tuple[dict[str, Any], dict[str, Outcomes]]


def _add_scenario(rows: _Rows, collection: Collection, number: int, groups: Sequence[Group]) -> _Compared:
    """Adds what each estimator of a scenario came to; returns its columns, and what is to be compared."""
    shared = Shared.among(collection, groups)
    outcomes: dict[str, Outcomes] = {}
    scores: list[dict[str, Any]] = []
    rows.contraction += _contraction_rows(collection, groups[0])
    first = len(rows.summary)
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
        rows.replicates += [
            (number, int(seed), group.estimator, capped_error(sample, sample.seeds == seed))
            for seed in np.unique(sample.seeds)
        ]
        rows.distributions.append(_distribution(where, outcome))
        rows.correlations.append(_correlation_rows(where, sample))
        rows.calibration += _calibration_rows(where, sample)
        rows.convergence += [_convergence_rows(where, history) for history in sample.histories]
    rows.scores += scores
    mark_best(rows.summary[first:], outcomes)
    return dict(groups[0].columns) | {"scenario": number}, outcomes


def _everywhere(collection: Collection) -> set[str]:
    """The estimators that every scenario has: profiles compare on the same scenarios only."""
    labels = [{group.estimator for group in groups} for groups in collection.scenarios.values()]
    return set.intersection(*labels) if labels else set()


def _pair_frame(pairs: Sequence[tuple[dict[str, Any], Pair]]) -> pd.DataFrame:
    """Corrected over all scenarios: a sweep asks all its questions at once."""
    import pandas as pd

    final = corrected([pair for _, pair in pairs])
    rows = [where | asdict(p) | {"closer": p.closer} for (where, _), p in zip(pairs, final, strict=True)]
    return pd.DataFrame(rows)


def _ranking(replicates: Sequence[tuple[int, int, str, float]], everywhere: set[str]) -> Ranking | None:
    """Ranks of the estimators that every scenario has, over seeds: by the mean capped error over the scenarios that all
    seeds have."""
    import pandas as pd

    table = pd.DataFrame(replicates, columns=["scenario", "seed", "estimator", "error"])
    table = table[table["estimator"].isin(everywhere) & table["error"].notna()]
    seeds = table["seed"].nunique()
    whole = table.groupby("scenario")["error"].transform("size") == seeds * len(everywhere)
    means = table[whole].groupby(["seed", "estimator"], sort=False)["error"].mean()
    return rank_over_replicates(
        [{str(e): float(v) for e, v in part.droplevel("seed").items()} for _, part in means.groupby("seed")]
    )


def head(group: Group) -> dict[str, Any]:
    return dict(group.columns) | {"estimator": group.estimator}


def numbered(group: Group, number: int) -> dict[str, Any]:
    """The columns that a frame of one scenario and estimator starts with."""
    return dict(group.columns) | {"scenario": number, "estimator": group.estimator}


def _group_rows(sample: Sample) -> list[dict[str, Any]]:
    """Per group of parameters, in the order of the parameters; the group's bound is one in these units."""
    sums, first = sample.sums, sample.n + 1
    totals, count = sums.binned.sum(axis=0)[first:], sums.squares.count
    rmse = np.sqrt(totals / count) if count else np.full(len(totals), np.nan)
    low, high = (ends[first:] for ends in sample.rmse_limits)
    return [
        head(sample.group) | {"group": name, "rmse": float(rmse[i]), "low": low[i], "high": high[i]}
        for i, name in enumerate(sample.members)
    ]


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
        first.setdefault(ending, trial_label(*sample.id_of(int(i))))
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


def _distribution(where: dict[str, Any], outcome: Outcomes) -> dict[str, Any]:
    return where | {"probability": PROBABILITIES, "distance": quantiles(outcome.distance, PROBABILITIES)}


def _calibration_rows(where: dict[str, Any], sample: Sample) -> Iterator[dict[str, Any]]:
    parts = sample.calibrations
    if not parts:
        return
    level = shared_level(parts)
    for name, part in zip([*(str(p["name"]) for p in sample.parameters), ALL], parts, strict=True):
        low, high = part.band(level)
        curve = {"parameter": name, "at": POINTS, "difference": part.shown.difference, "low": low, "high": high}
        yield where | curve | {"outside": part.p < 1 - level}


def _correlation_rows(where: dict[str, Any], sample: Sample) -> dict[str, Any]:
    names = [str(p["name"]) for p in sample.parameters]
    n = len(names)
    values = sample.sums.correlation.ravel()
    return where | {"row": np.repeat(names, n), "column": np.tile(names, n), "value": values}


def _convergence_rows(where: dict[str, Any], history: History) -> dict[str, Any]:
    iteration = np.arange(len(history.distances))
    return where | {"trial": history.trial, "iteration": iteration, "distance": history.distances}
