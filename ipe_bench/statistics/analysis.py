"""Everything the report is made of, computed from directories one scenario at a time."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ipe_bench.basics.statuses import Status
from ipe_bench.statistics.calibration import POINTS, shared_level
from ipe_bench.statistics.certified import attained_table
from ipe_bench.statistics.collect import Collection, Group, collect
from ipe_bench.statistics.comparisons import Outcomes, Ranking, compare_pairs, corrected, profiles, rank_over_replicates
from ipe_bench.statistics.formulas import capped_error
from ipe_bench.statistics.intervals import quantile, quantiles
from ipe_bench.statistics.records import SCORES, rows_of
from ipe_bench.statistics.sample import CONTRACTION, Sample, label_of
from ipe_bench.statistics.summary import ALL, scenario_rows, to_frame
from ipe_bench.statistics.tracks import curves

if TYPE_CHECKING:
    import pandas as pd

PROBABILITIES = np.unique(np.concatenate([np.linspace(0, 1, 101), [0.001, 0.005, 0.025, 0.975, 0.995, 0.999]]))
"""Where the distribution of errors is tabulated."""
MESSAGES = 20
"""Different messages of one estimator on one scenario that are listed one by one."""


@dataclass(frozen=True)
class Analysis:
    """Tables that figures, tables and the page are drawn from. Each starts with the scenario's columns; those of a
    scenario under an estimator add `scenario`, its number, and `estimator`."""

    collection: Collection
    summary: pd.DataFrame
    endings: pd.DataFrame
    """How trials ended that did not converge: status, message, number, and the first such trial."""
    pairs: pd.DataFrame
    """Every pair of estimators on every scenario; see `comparisons.compare_pairs`."""
    scores: pd.DataFrame
    """Per scenario and estimator: capped mean error, and median costs."""
    ranking: Ranking | None
    profiles: pd.DataFrame
    """Estimator, profile (performance or data), `at` (cost ratio or budget) and share, over all scenarios."""
    distributions: pd.DataFrame
    """Quantiles of the Mahalanobis error: probability (of `PROBABILITIES`) and distance."""
    convergence: pd.DataFrame
    """Of each converged trial with a stored history: trial, iteration, and the iterate's distance from the last one in
    deviations of the bound; none of filters, whose epochs are not iterations. The last distance is zero by definition,
    which says nothing of convergence."""
    calibration: pd.DataFrame
    """Of each parameter, and of NEES under the parameter `all`: `at`, the `difference` of the empirical distribution
    function from the uniform one there, the ends `low` and `high` of the band that all of an honest estimator's keep
    within in 95 % of cases, and whether this one is `outside` (by either of its curves)."""
    contraction: pd.DataFrame
    """Per scenario, how much the fixed-point iteration contracts at the truth; empty if no file says so."""
    tracks: pd.DataFrame
    """Of each state of a tracker: time `at` of each epoch, `rmse`, `bound` at the truth, `posterior` and
    `posterior_smoothed` Cramér-Rao bounds, and `nees` over n with the ends of its limits."""
    attained: pd.DataFrame
    """Which estimator attains known minima, over all scenarios; see `certified.attained_table`."""

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
    """Reads what is stored under the directories and computes all statistics; raises what `begin` does."""
    return begin(directories).finish()


def begin(directories: Sequence[Path | str]) -> Begun:
    """Reads what is stored under the directories and computes the summary, which stands long before all the rest.

    Raises:
        UserError: a directory does not exist.
    """
    begun = Begun(collect(directories), [], defaultdict(list), [])
    for number, groups in enumerate(begun.collection.scenarios.values()):
        begun.add(number, groups)
    return begun


@dataclass(frozen=True)
class Begun:
    """An analysis of which the summary stands; comparisons, and libraries that take long to load, are still to come."""

    collection: Collection
    summary: list[dict[str, Any]]
    """The rows of `Analysis.summary`."""
    rows: dict[str, list[dict[str, Any]]]
    """What the other tables are made of, by their names; `replicates` are scenario, seed, estimator and error."""
    compared: list[tuple[dict[str, Any], dict[str, Outcomes]]]
    """The columns of each scenario, and the outcomes of its estimators."""

    def add(self, number: int, groups: Sequence[Group]) -> None:
        """Adds what each estimator of a scenario came to."""
        self.rows["contraction"] += _contraction_rows(self.collection, groups[0])
        where = dict(groups[0].columns) | {"scenario": number}

        def also(sample: Sample, outcome: Outcomes) -> None:
            head = dict(sample.group.columns) | {"estimator": sample.group.estimator}
            numbered = where | {"estimator": sample.group.estimator}
            self.rows["endings"] += [head | row for row in _ending_rows(sample)]
            self.rows["scores"].append(numbered | rows_of(SCORES, sample)[-1])
            self.rows["replicates"] += [
                numbered | {"seed": int(seed), "error": capped_error(sample, sample.seeds == seed)}
                for seed in np.unique(sample.seeds)
            ]
            distances = quantiles(outcome.distance, PROBABILITIES)
            self.rows["distributions"].append(numbered | {"probability": PROBABILITIES, "distance": distances})
            self.rows["calibration"] += [numbered | row for row in _calibration_rows(sample)]
            self.rows["tracks"] += [numbered | row for row in curves(sample)]
            self.rows["convergence"] += [
                numbered | {"trial": h.trial, "iteration": np.arange(len(h.distances)), "distance": h.distances}
                for h in sample.histories
            ]

        rows, outcomes = scenario_rows(self.collection, groups, also)
        self.summary.extend(rows)
        self.compared.append((where, outcomes))

    def finish(self) -> Analysis:
        import pandas as pd

        labels = [{group.estimator for group in groups} for groups in self.collection.scenarios.values()]
        # Profiles and ranks compare on the same scenarios only.
        everywhere = set.intersection(*labels) if labels else set()
        # Corrected over all scenarios: a sweep asks all its questions at once.
        pairs = [where | pair for where, outcomes in self.compared for pair in compare_pairs(outcomes)]
        rows = self.rows
        return Analysis(
            collection=self.collection,
            summary=to_frame(self.summary),
            endings=pd.DataFrame(rows["endings"]),
            pairs=pd.DataFrame(corrected(pairs)),
            scores=pd.DataFrame(rows["scores"]),
            ranking=ranking(pd.DataFrame(rows["replicates"]), everywhere),
            profiles=profiles([{k: o for k, o in several.items() if k in everywhere} for _, several in self.compared]),
            distributions=_joined(rows["distributions"], ("probability", "distance")),
            convergence=_joined(rows["convergence"], ("trial", "iteration", "distance")),
            calibration=_joined(rows["calibration"], ("parameter", "at", "difference", "low", "high", "outside")),
            contraction=pd.DataFrame(rows["contraction"]),
            tracks=_joined(rows["tracks"], ("parameter", "at", "rmse")),
            attained=attained_table(self.collection),
        )


def _joined(parts: Sequence[Mapping[str, Any]], columns: Sequence[str]) -> pd.DataFrame:
    """Frames one after another, each given by its columns; what is not an array is the same in all its rows."""
    import pandas as pd

    if not parts:
        return pd.DataFrame(columns=["scenario", "estimator", *columns])
    arrays = [name for name, value in parts[0].items() if isinstance(value, np.ndarray)]
    return pd.DataFrame(list(parts)).explode(arrays, ignore_index=True).infer_objects()


def ranking(table: pd.DataFrame, everywhere: set[str]) -> Ranking | None:
    """Ranks over seeds of the estimators that every scenario has, by the mean capped error over the scenarios that all
    seeds have. The table has the columns scenario, seed, estimator and error."""
    if table.empty:
        return None
    table = table[table["estimator"].isin(everywhere) & table["error"].notna()]
    seeds = table["seed"].nunique()
    whole = table.groupby("scenario")["error"].transform("size") == seeds * len(everywhere)
    means = table[whole].groupby(["seed", "estimator"], sort=False)["error"].mean()
    return rank_over_replicates(
        [{str(e): float(v) for e, v in part.droplevel("seed").items()} for _, part in means.groupby("seed")]
    )


def _contraction_rows(collection: Collection, group: Group) -> list[dict[str, Any]]:
    """Median and largest contraction constants over the scenario's trials, and how often they promise convergence."""
    parts = [collection.load(truth, (), CONTRACTION) for _, truth in group.cells if truth is not None]
    if not parts or any(name not in part for part in parts for name in CONTRACTION):
        return []
    row = dict(group.columns)
    for name in CONTRACTION:
        values = np.concatenate([part[name] for part in parts])
        row |= {f"{name}_median": quantile(values, 0.5), f"{name}_max": quantile(values, 1.0)}
        row[f"{name}_below_1"] = float((values < 1).mean())
    return [row]


def _ending_rows(sample: Sample) -> list[dict[str, Any]]:
    """How trials ended that did not converge, the commonest ending first; trials without readings are last."""
    messages = sample.scalars.get("message", np.full(len(sample), ""))
    found: defaultdict[tuple[str, str], list[int]] = defaultdict(list)
    for i in np.flatnonzero(~sample.converged):
        found[str(sample.scalars["status"][i]), str(messages[i] or "")].append(sample.number[i])
    endings = sorted(found.items(), key=lambda ending: -len(ending[1]))
    reasons = {s.label: s.reason for s in Status}
    rows = [
        (status, message or reasons.get(status, ""), len(numbers), label_of(numbers[0]))
        for (status, message), numbers in endings[:MESSAGES]
    ]
    if rest := sum(len(numbers) for _, numbers in endings[MESSAGES:]):
        rows.append(("others", "further messages, each rarer", rest, ""))
    if count := len(sample.unread):
        rows.append((Status.NO_READINGS.label, Status.NO_READINGS.reason, count, label_of(sample.unread[0])))
    columns, trials = ("status", "message", "trials", "first", "share"), len(sample) + len(sample.unread)
    return [dict(zip(columns, (*row, row[2] / trials), strict=True)) for row in rows]


def _calibration_rows(sample: Sample) -> Iterator[dict[str, Any]]:
    parts = sample.calibrations
    level = shared_level(parts)
    for name, part in zip([*sample.names, ALL] if parts else [], parts, strict=True):
        low, high = part.band(level)
        curve = {"parameter": name, "at": POINTS, "difference": part.shown.difference, "low": low, "high": high}
        yield curve | {"outside": part.p < 1 - level}
