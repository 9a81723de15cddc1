"""All stored trials of one scenario under one estimator: what statistics are computed from.

What is one number per trial is in memory; what is a number per trial and parameter is summed up in one pass over the
files (`statistics.sums`), or read a few parameters at a time where it has to be ordered.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.statuses import Status
from ipe_bench.measurements.counted import cost
from ipe_bench.runs.results import StoredCell
from ipe_bench.statistics.calibration import Calibration, Claims
from ipe_bench.statistics.collect import Collection, Group
from ipe_bench.statistics.histories import History, distances_to_limit, trial_label
from ipe_bench.statistics.intervals import few_carry, quantiles, rms_interval_of
from ipe_bench.statistics.sequences import rms_sequence_of
from ipe_bench.statistics.sums import Beside, Rows, Sums

FIT = "fit_p"
NIS = "extra_nis"
"""Where filters report their normalised innovations squared."""
AMBIGUOUS = "extra_ambiguous"
"""Where estimators that look for several minima report 1 if they found some, else 0."""
SCALARS = ("status", "solved", "success", "iterations", "simulations", "jacobians", "time_s", "nees", "crlb_distance")
CURVATURES = ("curvature_intrinsic", "curvature_parameter")
TRUTH = ("contraction_K", "contraction_norm", "contraction_radius", "curvature_M", *CURVATURES)
"""Scalars of the truth, read where they are stored."""
THEORY = ("box_bias", "pseudo_bias", "misspecified")
"""What theory says of least squares for each parameter, read where it is stored."""
OPTIONAL = ("message", FIT, NIS, AMBIGUOUS, "root_distance")
"""Read where they are stored."""
OF_TRUTH = ("crlb", "bayes", "linear_error", "van_trees", "van_trees_error", *THEORY)
"""Vectors of the truth; the others are of the estimates."""
QUANTILES = (0.5, 0.95)
"""Of the size of each parameter's error."""
_SEED = 1 << 40
_BYTES = 1 << 27
"""Columns of parameters that are in memory together, where they have to be ordered."""


@dataclass(frozen=True)
class Shared:
    """Which trials the estimators of one scenario have in common, each as an `identifier`, ascending."""

    present: Array
    """Those that every estimator has."""
    solved: Array
    """Those that every estimator solved."""

    @classmethod
    def among(cls, collection: Collection, groups: Sequence[Group]) -> Shared:
        present: Array | None = None
        solved: Array | None = None
        for group in groups:
            ids, right = _solved_trials(collection, group)
            if len(ids):
                present = _in_both(present, ids)
            solved = _in_both(solved, ids[right])
        nothing = np.empty(0, dtype=np.int64)
        return cls(nothing if present is None else present, nothing if solved is None else solved)


def _in_both(first: Array | None, second: Array) -> Array:
    if first is None or np.array_equal(first, second):
        return second
    return np.intersect1d(first, second, assume_unique=True)


def _is_in(values: Array, wanted: Array) -> Array:
    return np.ones(len(values), dtype=bool) if np.array_equal(values, wanted) else np.isin(values, wanted)


def _solved_trials(collection: Collection, group: Group) -> tuple[Array, Array]:
    """Every trial of a group by ascending identifier, and whether it is solved."""
    parts = []
    for cell, _ in group.cells:
        rows = collection.load(cell, ["solved"])
        parts.append((_numbers(cell, rows["trial"]), rows["solved"].astype(bool)))
    ids, solved = (np.concatenate(column) for column in zip(*parts, strict=True))
    if np.all(ids[1:] > ids[:-1]):
        return ids, solved
    ids, first = np.unique(ids, return_index=True)
    return ids, solved[first]


def _numbers(cell: StoredCell, trial: Array) -> Array:
    return cell.seed * _SEED + trial.astype(np.int64)


@dataclass(frozen=True)
class Sample:
    """All trials of one group, seeds one after another; errors and deviations in multiples of the parameters' sizes.

    Arrays cannot be written into. Those of shape (trials, n) are read when they are first asked for, and kept; `sums`
    and what is made of it are had without them.
    """

    collection: Collection
    group: Group
    number: Array
    """(trials,): one number per (seed, trial)."""
    scalars: Mapping[str, Array]
    """Per trial, by the names in `SCALARS`, and those of `OPTIONAL` that are stored."""
    shared: Shared
    _kept: dict[str, Array] = field(default_factory=dict, repr=False)

    @classmethod
    def load(cls, collection: Collection, group: Group, shared: Shared) -> Sample:
        parts = [collection.load(cell, SCALARS, OPTIONAL) for cell, _ in group.cells]
        number = np.concatenate([_numbers(cell, p["trial"]) for (cell, _), p in zip(group.cells, parts, strict=True)])
        known = [name for name in (*SCALARS, *OPTIONAL) if all(name in part for part in parts)]
        # The parts are told to forget what is joined.
        scalars = {name: np.concatenate([part.pop(name) for part in parts]) for name in known}
        for name in ("solved", "success"):
            scalars[name] = scalars[name].astype(bool)
        return cls(
            collection, group, _read_only(number), {k: _read_only(v) for k, v in scalars.items()}, shared
        ).protected()

    def protected(self) -> Sample:
        """The same, for code that is not ours: what that changes is its own."""
        return replace(self, scalars=dict(self.scalars))

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
        return np.array(self.group.footer["linear_bound"], dtype=float)

    @cached_property
    def members(self) -> dict[str, list[int]]:
        """The groups of parameters, by name, in the order of the parameters."""
        found: dict[str, list[int]] = {}
        for i, parameter in enumerate(self.parameters):
            found.setdefault(parameter.get("group") or parameter["name"], []).append(i)
        return found

    # What is one number per trial -------------------------------------------------------------------------------------

    @property
    def ids(self) -> Array:
        """(trials, 2): seed and trial."""
        return np.stack(np.divmod(self.number, _SEED), axis=1)

    @property
    def seeds(self) -> Array:
        """(trials,)"""
        return self.number // _SEED

    def id_of(self, row: int) -> tuple[int, int]:
        """Seed and trial."""
        return divmod(int(self.number[row]), _SEED)

    @cached_property
    def cost(self) -> Array:
        """(trials,)"""
        jacobian_cost = self.group.footer.get("jacobian_cost", self.n)
        return cost(self.scalars["simulations"], self.scalars["jacobians"], jacobian_cost)

    @property
    def iterates(self) -> bool:
        """Whether the estimator approaches a limit step by step; the epochs of a filter are not such steps."""
        return not self.group.footer.get("sequential", False)

    @property
    def solves(self) -> bool:
        """Whether the estimator seeks a root of something; filters and the linear LSE do not, and only finish."""
        return self.group.footer.get("equation") is not None

    @cached_property
    def present(self) -> Array:
        """Whether every estimator of the scenario has the trial."""
        return _is_in(self.number, self.shared.present)

    @cached_property
    def solved_by_all(self) -> Array:
        return _is_in(self.number, self.shared.solved)

    @property
    def solved(self) -> Array:
        return self.scalars["solved"]

    @cached_property
    def converged(self) -> Array:
        return self.scalars["status"] == Status.CONVERGED.label

    @cached_property
    def distance(self) -> Array:
        """Mahalanobis errors (trials,) in deviations of the Cramér-Rao bound, infinite where not finite."""
        distance = np.sqrt(self.scalars["crlb_distance"])
        distance[~np.isfinite(distance)] = np.inf
        return distance

    @property
    def reports_covariance(self) -> bool:
        return self.sums.reports_covariance

    # What is a number per trial and parameter -------------------------------------------------------------------------

    @property
    def error(self) -> Array:
        """(trials, n)"""
        return self._matrix("error")

    @property
    def deviation(self) -> Array:
        """(trials, n), as the estimator reports it; NaN where it reports none."""
        return self._matrix("deviation")

    @property
    def crlb(self) -> Array:
        """(trials, n), deviations of the Cramér-Rao bound at the truth; NaN where the truth is missing."""
        return self._matrix("crlb")

    @property
    def bayes(self) -> Array:
        """(trials, n), those of the Bayesian bound."""
        return self._matrix("bayes")

    @property
    def bound(self) -> Array:
        """The deviations (trials, n) that the estimator is held against: the Bayesian bound where it uses a prior."""
        return self._matrix(self.bound_kind)

    @property
    def bound_kind(self) -> str:
        return "bayes" if self.group.footer["bound"] == "bayes" else "crlb"

    @property
    def linear_error(self) -> Array:
        """(trials, n), H+ v: what the linear estimate would be off by if h were linear."""
        return self._matrix("linear_error")

    @property
    def van_trees(self) -> Array:
        """(trials, n), deviations of Van Trees's bound, in the first trial of each seed and NaN in the others."""
        return self._matrix("van_trees")

    @property
    def theory(self) -> Mapping[str, Array]:
        """(trials, n) by the names in `THEORY`; NaN where it is not stored."""
        return {kind: self._matrix(kind) for kind in THEORY}

    @property
    def truth(self) -> Mapping[str, Array]:
        """(trials,) by the names in `TRUTH`; NaN where it is not stored."""
        return {name: self._matrix(name)[:, 0] for name in TRUTH}

    @property
    def normalised(self) -> Array:
        """Errors over the linear bound (trials, n)."""
        return self.error / self.linear_bound

    def _matrix(self, kind: str) -> Array:
        if kind not in self._kept:
            names = [kind] if kind in TRUTH else [f"{kind}_{name}" for name in self.names]
            self._kept[kind] = _read_only(self._columns(names, of_truth=kind in (*TRUTH, *OF_TRUTH)))
        return self._kept[kind]

    def _columns(self, names: Sequence[str], *, of_truth: bool = False) -> Array:
        """These columns (trials, columns), each in one piece of memory."""
        values, at = np.empty((len(names), len(self))), 0
        for rows in self._portions((), names) if of_truth else self._portions(names, ()):
            for i, name in enumerate(names):
                values[i, at : at + len(rows["trial"])] = rows[name]
            at += len(rows["trial"])
        return values.T

    def _portions(self, estimates: Sequence[str], truth: Sequence[str]) -> Iterator[dict[str, Array]]:
        """Columns of the estimates, and of the truth where it is stored, for some trials after another.

        Raises:
            UserError: they are others than those that the sample was loaded from.
        """
        at = 0
        for cell, known in self.group.cells:
            beside = Beside(iter(()) if known is None or not truth else self.collection.chunks(known, (), truth))
            for rows in self.collection.chunks(cell, estimates):
                number = _numbers(cell, rows["trial"])
                if not np.array_equal(self.number[at : at + len(number)], number):
                    break
                at += len(number)
                yield rows | (beside.at(rows["trial"], truth) if truth else {})
        if at != len(self):
            raise UserError(
                f"{', '.join(map(str, self.collection.directories))}: changed while it was read; the same command reads"
                " it anew"
            )

    @cached_property
    def sums(self) -> Sums:
        """Everything that is a sum over trials."""
        sums = Sums(len(self), self.linear_bound, list(self.members.values()))
        return sums.over(self._rows())

    def _rows(self) -> Iterator[Rows]:
        def matrix(rows: Mapping[str, Array], kind: str) -> Array:
            return np.stack([rows[f"{kind}_{name}"] for name in self.names])

        estimates = [f"{kind}_{name}" for kind in ("error", "deviation") for name in self.names]
        truth = [*(f"{kind}_{name}" for kind in OF_TRUTH for name in self.names), *CURVATURES]
        common, at = self.solved & self.solved_by_all, 0
        for rows in self._portions(estimates, truth):
            part = slice(at, at + len(rows["trial"]))
            at = part.stop
            yield Rows(
                **{kind: matrix(rows, kind) for kind in ("error", "deviation", *OF_TRUTH) if kind not in THEORY},
                theory={kind: matrix(rows, kind) for kind in THEORY},
                curvature={name: rows[name] for name in CURVATURES},
                solved=self.solved[part],
                common=common[part],
            )

    # What has to be ordered -------------------------------------------------------------------------------------------

    @cached_property
    def _ordered(self) -> tuple[Array, list[Calibration]]:
        """Quantiles (`QUANTILES`, n) of the size of the errors, and how honest the reported covariance is."""
        found = np.empty((len(QUANTILES), self.n))
        claims = Claims(self.scalars["nees"], self.converged, self.n)
        each = max(1, _BYTES // (2 * 8 * max(len(self), 1)))
        for first in range(0, self.n, each):
            names = self.names[first : first + each]
            columns = self._columns([f"{kind}_{name}" for kind in ("error", "deviation") for name in names])
            for i in range(len(names)):
                error, deviation = columns[:, i], columns[:, len(names) + i]
                found[:, first + i] = quantiles(np.abs(error), np.array(QUANTILES))
                claims.add(error, deviation)
        return found, claims.calibrations

    @property
    def error_quantiles(self) -> Array:
        """(`QUANTILES`, n) of the size of the errors, what is not finite counting as infinite."""
        return self._ordered[0]

    @property
    def calibrations(self) -> list[Calibration]:
        """How honest the reported covariance is for each parameter, and for all last; empty where none is reported."""
        return self._ordered[1]

    @property
    def rmse(self) -> Array:
        """(n,), over solved trials."""
        return self.sums.mse.root

    @cached_property
    def rmse_limits(self) -> tuple[Array, Array]:
        """Ends of the intervals of rmse: per parameter (n), of all over the linear bound, and so of each group of
        parameters; NaN where few trials carry it, see `intervals.few_carry`."""
        low, high = rms_interval_of(self.sums.binned.sums, self.sums.counts.sums)
        few = few_carry(self.sums.squares, self.degrees)
        return np.where(few, np.nan, low), np.where(few, np.nan, high)

    @property
    def effective_trials(self) -> Array:
        """Of the same squares, (sum of squares)² over the sum of their squares."""
        squares = self.sums.squares
        with np.errstate(all="ignore"):
            total = squares.count * squares.mean
            return total**2 / (squares.deviations + total * squares.mean)

    @cached_property
    def rmse_sequence(self) -> tuple[Array, Array]:
        """Such ends that are valid at all numbers of trials."""
        return rms_sequence_of(self.sums.squares, self.degrees)

    @cached_property
    def degrees(self) -> Array:
        """Degrees of freedom of the squares that `rmse_limits` are of, if errors are normal: 1 of each parameter and
        group, the least there can be; of all parameters what matches the variance (Satterthwaite, Biometrics 2, 1946).
        """
        products = self.sums.errors.products * np.outer(self.sums.unit, self.sums.unit)
        with np.errstate(all="ignore"):
            normalised = products / np.outer(self.linear_bound, self.linear_bound)
            together = np.trace(normalised) ** 2 / np.sum(normalised**2)
        found = np.ones(self.n + 1 + len(self.members))
        found[self.n] = np.floor(together + 1e-9) if 1 <= together <= self.n + 1e-6 else 1.0
        return found

    # How iterations went ----------------------------------------------------------------------------------------------

    @cached_property
    def histories(self) -> list[History]:
        """Those of the converged trials whose iterates are stored; none of a filter, which has epochs instead."""
        if not self.iterates:
            return []
        columns = [f"x_{name}" for name in self.names]
        result: list[History] = []
        for cell, known in self.group.cells:
            stored = self.collection.load_history(cell, [*columns, "iteration"])
            if stored is None:
                continue
            x = np.stack([stored[c] for c in columns], axis=1)
            trials = np.unique(stored["trial"])
            truth = self._truth_of(known, trials)
            for i, trial in enumerate(trials):
                row = np.flatnonzero(self.number == cell.seed * _SEED + trial)
                iterates = x[stored["trial"] == trial]
                if len(row) and self.converged[row[0]] and len(iterates) > 1:
                    result.append(self._history(int(row[0]), iterates, {k: v[i] for k, v in truth.items()}))
        return result

    def _truth_of(self, known: StoredCell | None, trials: Array) -> dict[str, Array]:
        """What is stored of the truth of these trials, which are the first ones: what comes after is not read."""
        names = [*(f"crlb_{name}" for name in self.names), *TRUTH]
        return Beside(iter(()) if known is None else self.collection.chunks(known, (), names)).at(trials, names)

    def _history(self, row: int, iterates: Array, truth: Mapping[str, Array]) -> History:
        crlb = np.array([truth[f"crlb_{name}"] for name in self.names])
        label = trial_label(*self.id_of(row))
        theory = {name: float(truth[name]) for name in TRUTH}
        return History(row, label, iterates, distances_to_limit(iterates, crlb), float(self.cost[row]), theory)


def _read_only(array: Array) -> Array:
    array.flags.writeable = False
    return array.view()
