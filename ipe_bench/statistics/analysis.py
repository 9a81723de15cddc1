"""Everything the report is made of, computed from directories one scenario at a time."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ipe_bench.basics.statuses import Status
from ipe_bench.statistics.calibration import POINTS, band
from ipe_bench.statistics.collect import Collection, Group, collect
from ipe_bench.statistics.comparisons import Outcomes, compare_pairs, corrected, may_be_best
from ipe_bench.statistics.intervals import quantile, quantiles
from ipe_bench.statistics.one_track import best_tracker, one_track
from ipe_bench.statistics.path_columns import epoch_curves
from ipe_bench.statistics.records import SCORES
from ipe_bench.statistics.registry import summary_rows, to_frame
from ipe_bench.statistics.sample import CONTRACTION, Sample, label_of, median_distances, samples
from ipe_bench.statistics.statistic import ALL, BEST, rows_of

if TYPE_CHECKING:
    import pandas as pd

PROBABILITIES = np.unique(
    np.concatenate([np.linspace(0, 1, 101), [0.001, 0.005, 0.025, 0.975, 0.995, 0.999]])
)
"""Probabilities at which the distribution of errors is tabulated."""
_OF_ROWS = (
    *("endings", "scores", "distributions", "convergence", "calibration", "contraction"),
    *("tracks", "one_track"),
)
"""Frames of an analysis that are made of rows."""
MESSAGES = 20
"""Different messages of one estimator on one scenario that are listed one by one."""


@dataclass(frozen=True)
class Analysis:
    """Tables that figures, tables and the page are drawn from. Each starts with the scenario's
    columns; those of a scenario under an estimator add `scenario`, its number, and `estimator`."""

    collection: Collection
    summary: pd.DataFrame
    endings: pd.DataFrame
    """Endings of trials that did not converge: status, message, number, and the first such
    trial."""
    pairs: pd.DataFrame
    """Every pair of estimators on every scenario; see `comparisons.compare_pairs`."""
    scores: pd.DataFrame
    """Per scenario and estimator: capped mean error, median costs, and `shared_trials`, the
    number of trials that every estimator of the scenario has."""
    distributions: pd.DataFrame
    """Quantiles of the Mahalanobis error over all trials: `probability` (of `PROBABILITIES`) and
    `distance`."""
    convergence: pd.DataFrame
    """Median `distance` of each `iteration` of an iterative estimator from its last iterate, the
    largest over the parameters in deviations of the bound, over the first converged trials; 0 once
    half of them have ended."""
    calibration: pd.DataFrame
    """Calibration of NEES: the probability `at`, the `difference` of the empirical distribution
    function from the uniform one there, and the ends `low` and `high` of the band; NEES and all
    parameters of an honest estimator keep within theirs in 95 % of cases."""
    contraction: pd.DataFrame
    """Per scenario, how much the fixed-point iteration contracts at the truth; empty if no file
    says so."""
    tracks: pd.DataFrame
    """Errors of each state of a tracker, and of all: time `at` of each epoch, `median` and worst
    tenth `q90` over all `trials`, `bound` at the truth, and `nees_solved` over n of the `claims`
    with the ends of its limits."""

    one_track: pd.DataFrame
    """One trial of each scenario: `truth`, `mean` and `deviation` of each tracker's states at each
    epoch `at`, `across`, the covariance of a position's x with its y, and the readings."""

    @property
    def setting_columns(self) -> list[str]:
        """The columns that tell scenarios apart, but for the error scale."""
        first = self.collection.groups[0].columns if self.collection.groups else {}
        return [c for c in first if c != "error_scale"]

    @property
    def totals(self) -> pd.DataFrame:
        """The rows of the summary over all parameters."""
        return self.summary[self.summary["parameter"] == ALL].reset_index(drop=True)

    @cached_property
    def simulated(self) -> Analysis:
        """The analysis of the simulated trials alone, without those of certified readings."""
        groups = tuple(g for g in self.collection.groups if g.columns["noise"] != "certified")
        if len(groups) == len(self.collection.groups):
            return self
        kept: dict[str, Any] = {"collection": replace(self.collection, groups=groups)}
        for field in fields(self):
            table = getattr(self, field.name)
            if hasattr(table, "columns") and "noise" in table:
                simulated = table["noise"] != "certified"
                kept[field.name] = table[simulated].reset_index(drop=True)
        return replace(self, **kept)


def analyse(directories: Sequence[Path | str]) -> Analysis:
    """Reads what is stored under the directories and computes all statistics.

    Raises:
        UserError: a directory does not exist.
    """
    return Begun(collect(directories)).finish()


def summarize(directories: Sequence[Path | str]) -> pd.DataFrame:
    """Computes the summary of everything stored under the directories; empty if no trial is."""
    return to_frame(Begun(collect(directories)).summary)


class Begun:
    """Holds an analysis with its summary; comparisons, and libraries that take long to load, are
    still to come."""

    def __init__(self, collection: Collection) -> None:
        self.collection = collection
        self.summary: list[dict[str, Any]] = []
        """The rows of `Analysis.summary`."""
        self._rows: defaultdict[str, list[dict[str, Any]]] = defaultdict(list)
        """Rows of the other tables, by their names."""
        self._compared: list[tuple[dict[str, Any], dict[str, Outcomes]]] = []
        """The columns of each scenario, and the outcomes of its estimators."""
        for number, groups in enumerate(collection.scenarios.values()):
            self._add(number, groups)

    def _add(self, number: int, groups: Sequence[Group]) -> None:
        """Adds the results of each estimator of a scenario."""
        self._rows["contraction"] += _contraction_rows(self.collection, groups[0])
        where = dict(groups[0].columns) | {"scenario": number}
        summary = []
        outcomes = {}
        for sample in samples(self.collection, groups):
            present = sample.present
            inside = sample.inside_gate[present]
            outcomes[sample.group.estimator] = Outcomes(sample.distance[present], inside)
            summary += summary_rows(sample)
            self._add_sample(where | {"estimator": sample.group.estimator}, sample)
            del sample  # before the next one takes as much memory
        if outcomes and "times" in groups[0].footer:
            rows = one_track(self.collection, groups, best_tracker(summary))
            self._rows["one_track"] += [where | row for row in rows]
        if outcomes:
            successes = [outcome.success for outcome in outcomes.values()]
            best = may_be_best(np.column_stack(successes))
            marks = dict(zip(outcomes, best.tolist(), strict=True))
            self.summary += [row | {BEST: marks[row["estimator"]]} for row in summary]
            self._compared.append((where, outcomes))

    def _add_sample(self, where: dict[str, Any], sample: Sample) -> None:
        """Adds the rows of one estimator on one scenario; `where` says which they are."""
        found = self._rows
        of_group = dict(sample.group.columns) | {"estimator": sample.group.estimator}
        found["endings"] += [of_group | row for row in _ending_rows(sample)]
        scores = rows_of(SCORES, sample)[-1]
        found["scores"].append(where | scores | {"shared_trials": int(sample.present.sum())})
        distances = quantiles(sample.distance, PROBABILITIES)
        curve = {"probability": PROBABILITIES, "distance": distances}
        found["distributions"].append(where | curve)
        if sample.histories and sample.group.footer.get("equation") is not None:
            medians = median_distances(sample.histories)
            curve = {"iteration": np.arange(len(medians)), "distance": medians}
            found["convergence"].append(where | curve)
        # NEES of all parameters stands last.
        for whole in sample.calibrations[-1:]:
            low, high = band(len(whole.z), whole.level)
            curve = {"at": POINTS, "difference": whole.size.difference, "low": low, "high": high}
            found["calibration"].append(where | curve)
        found["tracks"] += [where | row for row in epoch_curves(sample)]

    @property
    def raised(self) -> list[str]:
        """A line for each estimator whose trials raised exceptions, with the commonest of them, and
        for each that has no finite trial in a setting."""
        lines = []
        for label, rows in self._errors().items():
            trials = sum(row["trials"] for row in rows)
            commonest = max(rows, key=lambda row: row["trials"])
            times = "1 trial" if trials == 1 else f"{trials} trials"
            lines.append(f"{label}: {times} ended by an exception: {commonest['message']}")
        lines += [
            f"{row['estimator']}: no trial is finite: {row['message']}"
            for row in self._rows["endings"]
            if row["status"] == Status.NONFINITE.label and row["share"] == 1 and row["message"]
        ]
        return list(dict.fromkeys(lines))

    @property
    def useless(self) -> list[str]:
        """The estimators all of whose trials raised exceptions."""
        asked = Counter[str]()
        for row in self.summary:
            if row["parameter"] == ALL:
                asked[row["estimator"]] += row["trials"]
        errors = self._errors()
        return [
            label
            for label, rows in errors.items()
            if sum(row["trials"] for row in rows) == asked[label]
        ]

    def _errors(self) -> dict[str, list[dict[str, Any]]]:
        """Returns the endings by exceptions, by estimator."""
        found = defaultdict[str, list[dict[str, Any]]](list)
        for row in self._rows["endings"]:
            if row["status"] == Status.ERROR.label:
                found[row["estimator"]].append(row)
        return found

    def finish(self) -> Analysis:
        """Completes the analysis."""
        import pandas as pd

        pairs = []
        for where, outcomes in self._compared:
            pairs += [where | pair for pair in compare_pairs(outcomes)]
        return Analysis(
            collection=self.collection,
            summary=to_frame(self.summary),
            # Corrected over all scenarios: a sweep asks all its questions at once.
            pairs=pd.DataFrame(corrected(pairs)),
            **{name: _joined(self._rows[name]) for name in _OF_ROWS},
        )


def _joined(parts: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Joins frames, each given by its columns; a scalar is repeated in all its rows."""
    import pandas as pd

    if not parts:
        return pd.DataFrame()
    frame = pd.DataFrame(list(parts))
    arrays = [name for name, value in parts[0].items() if isinstance(value, np.ndarray)]
    if not arrays:
        return frame
    return frame.explode(arrays, ignore_index=True).infer_objects()


def _contraction_rows(collection: Collection, group: Group) -> list[dict[str, Any]]:
    """Computes median and largest contraction constants of a scenario's trials, and how often they
    are below 1."""
    parts = [collection.load(truth, (), CONTRACTION) for truth in group.truths if truth is not None]
    if not parts or any(name not in part for part in parts for name in CONTRACTION):
        return []
    row = dict(group.columns)
    for name in CONTRACTION:
        values = np.concatenate([part[name] for part in parts])
        row[f"{name}_median"] = quantile(values, 0.5)
        row[f"{name}_max"] = quantile(values, 1.0)
        row[f"{name}_below_1"] = float((values < 1).mean())
    return [row]


def _ending_rows(sample: Sample) -> list[dict[str, Any]]:
    """Counts the endings of trials that did not converge, the commonest first; trials without
    readings are last."""
    lost = np.flatnonzero(~sample.converged)
    reasons = {status.label: status.reason for status in Status}
    statuses = sample.scalars["status"][lost]
    messages = sample.scalars.get("message", np.full(len(sample), ""))[lost]
    ended = [
        (str(status), str(message or reasons.get(status, "")))
        for status, message in zip(statuses, messages, strict=True)
    ]
    # Backwards, so that the first trial of each ending is kept.
    first = dict(zip(reversed(ended), reversed(sample.number[lost]), strict=True))
    counts = Counter(ended).most_common()
    rows = [(*ending, count, label_of(first[ending])) for ending, count in counts[:MESSAGES]]
    rest = sum(count for _, count in counts[MESSAGES:])
    if rest:
        rows.append(("others", "further messages, each rarer", rest, ""))
    unread = len(sample.unread)
    if unread:
        ending = (Status.NO_READINGS.label, Status.NO_READINGS.reason)
        rows.append((*ending, unread, label_of(sample.unread[0])))
    trials = len(sample) + unread
    return [
        {"status": status, "message": message, "trials": n, "first": trial, "share": n / trials}
        for status, message, n, trial in rows
    ]
