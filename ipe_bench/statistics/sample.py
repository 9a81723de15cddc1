"""All stored trials of one scenario under one estimator: the numbers that statistics are computed
from."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, reduce
from typing import TYPE_CHECKING, Any

import numpy as np

from ipe_bench.basics.linalg import Array, Mask
from ipe_bench.basics.statuses import Status
from ipe_bench.measurements.counted import cost
from ipe_bench.statistics.calibration import Calibration, calibrations
from ipe_bench.trials.thresholds import gate

if TYPE_CHECKING:
    from ipe_bench.runs.results import StoredCell
    from ipe_bench.statistics.collect import Collection, Group

FIT = "fit_p"
NIS = "extra_nis"
"""The column of the normalised innovations squared that filters report."""
AMBIGUOUS = "extra_ambiguous"
"""The column in which estimators that look for several minima report 1 if they found some, else
0."""
SCALARS = (
    "status",
    "solved",
    "success",
    "iterations",
    "simulations",
    "jacobians",
    "time_s",
    "nees",
    "crlb_distance",
)
PATH = (
    *("path_nees", "path_error", "path_success"),
    *("white_p", "log_likelihood", "first_bad_epoch", "copy_p"),
)
"""Scores of a tracker over the whole path."""
OPTIONAL_COLUMNS = ("message", FIT, NIS, AMBIGUOUS, "root_distance", *PATH)
"""Columns that not every version or estimator stores."""
CONTRACTION = ("contraction_K", "contraction_norm", "contraction_radius")
TRUTH_COLUMNS = (*CONTRACTION, "curvature_M", "curvature_intrinsic", "curvature_parameter")
"""Numbers of the truth."""
CLOSE = 0.05
"""An iterate within this many standard deviations of the last one is as good as the last one."""
FLOOR = 1e-9
"""Distances between iterates below this are round-off."""
_SEED = 1 << 40


@dataclass(frozen=True)
class History:
    """Records how a converged trial came to its limit."""

    iterates: Array
    """(iterates, n)"""
    distances: Array
    """(iterates,) from the last iterate, in deviations of the bound."""
    cost: float
    """The cost of the whole trial, in simulations."""
    K: float
    """K of eq. (15) at the truth."""
    M: float
    """M of eq. (23) at the truth; NaN where it is not stored."""


@dataclass(frozen=True, eq=False)
class Sample:
    """Holds all trials of one group by seeds; errors and deviations in multiples of the parameters'
    sizes.

    Trials without readings are left out of all arrays. Arrays cannot be written into.
    """

    collection: Collection
    group: Group
    number: Array
    """(trials,): one number per (seed, trial)."""
    scalars: Mapping[str, Array]
    """Per trial, by the names in `SCALARS`, and those of `OPTIONAL_COLUMNS` that are stored."""
    error: Array
    """(trials, n)"""
    deviation: Array
    """(trials, n), as the estimator reports it; NaN where it reports none."""
    present: Array
    """Whether every estimator of the scenario has the trial (trials,)."""
    unread: Array
    """The numbers of the trials that have no readings, since the model gives none at their true
    parameters."""
    kept: dict[Any, Any] = field(default_factory=dict, repr=False)
    """Cache of derived quantities; see `formulas.once`."""

    @classmethod
    def load(cls, collection: Collection, group: Group, present: Array) -> Sample:
        """Loads the stored trials of a group; `present` are the numbers of those that all rivals
        have."""
        names = [p["name"] for p in group.footer["parameters"]]
        errors = [f"error_{name}" for name in names]
        deviations = [f"deviation_{name}" for name in names]
        required = [*errors, *deviations, *SCALARS]
        parts = [collection.load(cell, required, OPTIONAL_COLUMNS) for cell in group.cells]
        cells_with_parts = zip(group.cells, parts, strict=True)
        every = np.concatenate([_numbers(cell, part["trial"]) for cell, part in cells_with_parts])
        status = np.concatenate([part["status"] for part in parts])
        used: Array = np.asarray(status != Status.NO_READINGS.label)
        number = every[used]

        def joined(name: str) -> Array:
            """Concatenates the column, which is removed from its parts: it is in memory once."""
            return np.concatenate([part.pop(name) for part in parts])[used]

        def table(columns: Sequence[str]) -> Array:
            """Joins columns (trials, k), each of them contiguous."""
            values = np.empty((len(columns), len(number)))
            for row, name in zip(values, columns, strict=True):
                row[:] = joined(name)
            return values.T

        known = (*SCALARS, *OPTIONAL_COLUMNS)
        there = [name for name in known if all(name in part for part in parts)]
        scalars = {name: joined(name) for name in there}
        for name in ("solved", "success"):
            scalars[name] = scalars[name].astype(bool)
        error = table(errors)
        deviation = table(deviations)
        for array in (number, error, deviation, *scalars.values()):
            array.flags.writeable = False
        return cls(
            collection,
            group,
            number,
            scalars,
            error,
            deviation,
            present=np.isin(number, present),
            unread=every[~used],
        )

    def __len__(self) -> int:
        return len(self.number)

    @property
    def n(self) -> int:
        return len(self.parameters)

    @property
    def parameters(self) -> Sequence[Mapping[str, Any]]:
        return self.group.footer["parameters"]

    @cached_property
    def names(self) -> list[str]:
        return [str(p["name"]) for p in self.parameters]

    @cached_property
    def sizes(self) -> Array:
        """(n,): the parameters' units, by which what is in multiples of them is multiplied."""
        return np.array([float(p["size"]) for p in self.parameters])

    @cached_property
    def linear_bound(self) -> Array:
        """(n,)"""
        return np.array(self.group.footer["linear_bound"], dtype=float)

    @cached_property
    def cost(self) -> Array:
        """(trials,), in simulations."""
        jacobian_cost = self.group.footer.get("jacobian_cost", self.n)
        return cost(self.scalars["simulations"], self.scalars["jacobians"], jacobian_cost)

    @property
    def iterates(self) -> bool:
        """Whether the estimator approaches a limit step by step; the epochs of a filter are not
        such steps."""
        return not self.group.footer.get("sequential", False)

    @property
    def solved(self) -> Array:
        """(trials,)"""
        return self.scalars["solved"]

    @cached_property
    def verdicts(self) -> int:
        """The number of verdicts in the tables of its setting: of each estimator and error scale
        one, and of states that move one each on the last epoch, on the path and on innovations."""
        own = _without_scale(self.group)
        rows = sum(_without_scale(group) == own for group in self.collection.groups)
        return rows * 3 if "path_nees" in self.scalars else rows

    @cached_property
    def converged(self) -> Array:
        """(trials,)"""
        return self.scalars["status"] == Status.CONVERGED.label

    @cached_property
    def distance(self) -> Array:
        """Mahalanobis errors (trials,) in deviations of the Cramér-Rao bound, infinite where not
        finite."""
        distance = np.sqrt(self.scalars["crlb_distance"])
        distance[~np.isfinite(distance)] = np.inf
        return distance

    @property
    def inside_gate(self) -> Mask:
        """Success (trials,) by the Cramér-Rao bound, one gate for all; the column `success` is by
        the bound that the estimator is held against."""
        return self.scalars["crlb_distance"] <= gate(self.n)

    @property
    def normalised(self) -> Array:
        """Errors over the linear bound (trials, n)."""
        return self.error / self.linear_bound

    def of_truth(self, kind: str) -> Array:
        """Reads what is stored of the truth for each parameter (trials, n), or (trials,) by a name
        in `TRUTH_COLUMNS`; NaN where it is not stored."""
        return self._stored(kind, self.group.truths)

    def of_estimate(self, kind: str) -> Array:
        """Reads what is stored of the estimates for each parameter (trials, n) besides errors and
        deviations."""
        return self._stored(kind, self.group.cells)

    def _stored(self, kind: str, cells: Sequence[StoredCell | None]) -> Array:
        names = [kind] if kind in TRUTH_COLUMNS else [f"{kind}_{name}" for name in self.names]
        values = np.full((len(names), len(self)), np.nan)
        for cell in filter(None, cells):
            stored = self.collection.load(cell, (), names)
            numbers = _numbers(cell, stored["trial"])
            _, mine, theirs = np.intersect1d(
                self.number, numbers, assume_unique=True, return_indices=True
            )
            for row, name in zip(values, names, strict=True):
                if name in stored:
                    row[mine] = stored[name][theirs]
        return values[0] if kind in TRUTH_COLUMNS else values.T

    @cached_property
    def calibrations(self) -> list[Calibration]:
        """Honesty of the reported covariance for each parameter, and for all last; empty where none
        is reported."""
        return calibrations(self.error, self.deviation, self.scalars["nees"], self.converged)

    @cached_property
    def histories(self) -> list[History]:
        """Histories of the converged trials whose iterates are stored; none for a filter, which has
        epochs instead."""
        if not self.iterates:
            return []
        found = []
        for cell in self.group.cells:
            history = self.collection.load_history(cell)
            if history is None:
                continue
            every = np.stack([history[f"x_{name}"] for name in self.names], axis=1)
            numbers = _numbers(cell, history["trial"])
            for number in np.unique(numbers):
                iterates = every[numbers == number]
                # A trial that ended at its start has come no way.
                if len(iterates) > 1:
                    rows = np.flatnonzero(self.converged & (self.number == number))
                    found += [(row, iterates) for row in rows.tolist()]
        if not found:
            return []
        crlb = self.of_truth("crlb")
        cost = self.cost.tolist()
        K = self.of_truth("contraction_K").tolist()
        M = self.of_truth("curvature_M").tolist()
        return [
            History(iterates, distances_to_limit(iterates, crlb[row]), cost[row], K[row], M[row])
            for row, iterates in found
        ]


def _without_scale(group: Group) -> dict[str, Any]:
    return {name: value for name, value in group.columns.items() if name != "error_scale"}


def label_of(number: Any) -> str:
    """Names a trial for readers."""
    seed, trial = divmod(int(number), _SEED)
    return f"seed {seed}, trial {trial}"


def samples(collection: Collection, groups: Sequence[Group]) -> Iterator[Sample]:
    """Yields the samples of one scenario that have trials."""
    present = []
    for group in groups:
        parts = [_numbers(cell, collection.load(cell, ["status"])["trial"]) for cell in group.cells]
        numbers = np.concatenate(parts)
        # An estimator without any trials takes none from the others.
        if len(numbers):
            present.append(numbers)
    present_in_all = _in_all(present)
    for group in groups:
        sample = Sample.load(collection, group, present_in_all)
        if len(sample):
            yield sample
        del sample  # before the next one takes as much memory


def _in_all(several: Sequence[Array]) -> Array:
    """Returns the numbers that all have, ascending."""
    if not several:
        return np.empty(0, dtype=np.int64)
    return reduce(np.intersect1d, several[1:], np.unique(several[0]))


def _numbers(cell: StoredCell, trial: Array) -> Array:
    return cell.seed * _SEED + trial.astype(np.int64)


# Iterations ---------------------------------------------------------------------------------------


def distances_to_limit(iterates: Array, deviation: Array) -> Array:
    """Computes the largest component of each iterate's distance from the last one, in standard
    deviations (n,)."""
    with np.errstate(invalid="ignore"):
        return np.abs((iterates - iterates[-1]) / deviation).max(axis=1)


def median_distances(histories: Sequence[History]) -> Array:
    """Computes medians (iterates,) over trials of the distances from their limits; an ended trial
    counts as nearest: 0 once half have."""
    longest = max(len(h.distances) for h in histories)
    table = np.zeros((longest, len(histories)))
    for i, h in enumerate(histories):
        finite = np.isfinite(h.distances)
        table[: len(h.distances), i] = np.where(finite, h.distances, np.inf)
    return np.sort(table)[:, (len(histories) - 1) // 2]


def iterations_to_limit(distances: Array) -> int:
    """Finds the first iterate from which on all are within `CLOSE` of the last."""
    far = np.flatnonzero(~(distances <= CLOSE))
    return int(far[-1]) + 1 if len(far) else 0


def orders_of(errors: Array, floor: float = FLOOR) -> Array:
    """Computes log(e_(k+1) / e_k) / log(e_k / e_(k-1)) of successive errors (iterates,), where they
    decrease above the floor: 1 where convergence is linear, 2 where it is quadratic."""
    # Up to the first error that is round-off; beyond the last where none is.
    e = errors[: np.argmax(np.append(errors <= floor, True))]
    before = e[:-2]
    here = e[1:-1]
    after = e[2:]
    with np.errstate(divide="ignore", invalid="ignore"):
        orders = np.log(after / here) / np.log(here / before)
    decreasing = (after < here) & (here < before)
    return orders[decreasing]
