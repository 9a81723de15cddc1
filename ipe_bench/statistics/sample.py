"""All stored trials of one scenario under one estimator, as arrays that statistics are computed from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.basics.statuses import Status
from ipe_bench.measurements.counted import cost
from ipe_bench.statistics.calibration import Calibration, calibrations
from ipe_bench.statistics.collect import Collection, Group
from ipe_bench.statistics.histories import History, distances_to_limit, trial_label
from ipe_bench.statistics.intervals import rms_interval

FIT = "fit_p"
NIS = "extra_nis"
"""Where filters report their normalised innovations squared."""
AMBIGUOUS = "extra_ambiguous"
"""Where estimators that look for several minima report 1 if they found some, else 0."""
SCALARS = ("status", "solved", "success", "iterations", "simulations", "jacobians", "time_s", "nees", "crlb_distance")
TRUTH = (
    *("contraction_K", "contraction_norm", "contraction_radius"),
    *("curvature_M", "curvature_intrinsic", "curvature_parameter"),
)
"""Scalars of the truth, read where they are stored."""
THEORY = ("box_bias", "pseudo_bias", "misspecified")
"""What theory says of least squares for each parameter, read where it is stored."""
OPTIONAL = ("message", FIT, NIS, AMBIGUOUS, "root_distance")
"""Read where they are stored."""


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
                present = ids if present is None else np.intersect1d(present, ids, assume_unique=True)
            solved = ids[right] if solved is None else np.intersect1d(solved, ids[right], assume_unique=True)
        nothing = np.empty(0, dtype=np.int64)
        return cls(nothing if present is None else present, nothing if solved is None else solved)


def _solved_trials(collection: Collection, group: Group) -> tuple[Array, Array]:
    """Every trial of a group by ascending identifier, and whether it is solved."""
    parts = []
    for cell, _ in group.cells:
        rows = collection.load(cell, ["solved"])
        trial = rows["trial"].astype(np.int64)
        ids = identifier(np.stack([np.full(len(trial), cell.seed, dtype=np.int64), trial], axis=1))
        parts.append((ids, rows["solved"].astype(bool)))
    ids, first = np.unique(np.concatenate([ids for ids, _ in parts]), return_index=True)
    return ids, np.concatenate([solved for _, solved in parts])[first]


def identifier(ids: Array) -> Array:
    """One number per (seed, trial)."""
    return ids[:, 0] * (1 << 40) + ids[:, 1]


@dataclass(frozen=True)
class Sample:
    """All trials of one group, seeds one after another; errors and deviations in multiples of the parameters' sizes."""

    collection: Collection
    group: Group
    ids: Array
    """(trials, 2): seed and trial."""
    error: Array
    """(trials, n)"""
    deviation: Array
    """(trials, n), as the estimator reports it; NaN where it reports none."""
    crlb: Array
    bayes: Array
    """(trials, n), deviations of the bounds at the truth; NaN where the truth is missing."""
    linear_error: Array
    """(trials, n), H+ v: what the linear estimate would be off by if h were linear."""
    van_trees: Array
    """(trials, n), deviations of Van Trees's bound, in the first trial of each seed and NaN in the others."""
    theory: Mapping[str, Array]
    """(trials, n) by the names in `THEORY`; NaN where it is not stored."""
    truth: Mapping[str, Array]
    """Per trial, by the names in `TRUTH`; NaN where it is not stored."""
    scalars: Mapping[str, Array]
    """Per trial, by the names in `SCALARS`, and those of `OPTIONAL` that are stored."""
    shared: Shared

    @classmethod
    def load(cls, collection: Collection, group: Group, shared: Shared) -> Sample:
        names = [p["name"] for p in group.footer["parameters"]]
        vectors = [f"{kind}_{name}" for kind in ("error", "deviation") for name in names]
        bounds = [f"{kind}_{name}" for kind in ("crlb", "bayes") for name in names]
        linear = [f"{kind}_{name}" for kind in ("linear_error", "van_trees", *THEORY) for name in names]
        parts: list[dict[str, Array]] = []
        for cell, truth in group.cells:
            rows = collection.load(cell, [*vectors, *SCALARS], OPTIONAL)
            rows["seed"] = np.full(len(rows["trial"]), cell.seed)
            known = None if truth is None else collection.load(truth, bounds, (*linear, *TRUTH))
            for name in (*bounds, *linear, *TRUTH):
                rows[name] = _aligned(rows["trial"], known, name)
            parts.append(rows)

        def column(name: str) -> Array:
            """Of all parts, which are told to forget it: what is read of a million trials fits into memory once."""
            pieces = [part.pop(name) for part in parts]
            return pieces[0] if len(pieces) == 1 else np.concatenate(pieces)

        def matrix(kind: str) -> Array:
            columns = [column(f"{kind}_{name}") for name in names]
            if all(c.strides == (0,) for c in columns):  # nothing of it is stored
                return np.broadcast_to(np.nan, (len(ids), len(names)))
            values = np.empty((len(ids), len(names)))
            for i in range(len(names)):
                values[:, i] = columns[i]
                columns[i] = values[:0, 0]
            return values

        ids = np.stack([column("seed"), column("trial")], axis=1).astype(np.int64)
        truth = {name: column(name) for name in TRUTH}
        scalars = {name: column(name) for name in (*SCALARS, *OPTIONAL) if all(name in part for part in parts)}
        for name in ("solved", "success"):
            scalars[name] = scalars[name].astype(bool)
        return cls(
            collection,
            group,
            ids,
            error=matrix("error"),
            deviation=matrix("deviation"),
            crlb=matrix("crlb"),
            bayes=matrix("bayes"),
            linear_error=matrix("linear_error"),
            van_trees=matrix("van_trees"),
            theory={kind: matrix(kind) for kind in THEORY},
            truth=truth,
            scalars=scalars,
            shared=shared,
        )

    def protected(self) -> Sample:
        """The same in arrays that cannot be written into, for code that is not ours."""

        def views(arrays: Mapping[str, Array]) -> dict[str, Array]:
            return {name: _read_only(array) for name, array in arrays.items()}

        arrays = ("ids", "error", "deviation", "crlb", "bayes", "linear_error", "van_trees")
        return replace(
            self,
            **views({name: getattr(self, name) for name in arrays}),
            theory=views(self.theory),
            truth=views(self.truth),
            scalars=views(self.scalars),
            shared=Shared(_read_only(self.shared.present), _read_only(self.shared.solved)),
        )

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def n(self) -> int:
        return self.error.shape[1]

    @property
    def parameters(self) -> Sequence[Mapping[str, Any]]:
        return self.group.footer["parameters"]

    @cached_property
    def sizes(self) -> Array:
        """(n,): the parameters' units, by which what is in multiples of them is multiplied."""
        return np.array([float(p["size"]) for p in self.parameters])

    @cached_property
    def linear_bound(self) -> Array:
        return np.array(self.group.footer["linear_bound"], dtype=float)

    @property
    def bound(self) -> Array:
        """The deviations (trials, n) that the estimator is held against: the Bayesian bound where it uses a prior."""
        return self.bayes if self.group.footer["bound"] == "bayes" else self.crlb

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
    def number(self) -> Array:
        """(trials,): the identifier of each trial."""
        return identifier(self.ids)

    @cached_property
    def present(self) -> Array:
        """Whether every estimator of the scenario has the trial."""
        return np.isin(self.number, self.shared.present)

    @cached_property
    def solved_by_all(self) -> Array:
        return np.isin(self.number, self.shared.solved)

    @cached_property
    def solved(self) -> Array:
        return self.scalars["solved"]

    @cached_property
    def converged(self) -> Array:
        return self.scalars["status"] == Status.CONVERGED.label

    @cached_property
    def normalised(self) -> Array:
        """Errors over the linear bound (trials, n)."""
        return self.error / self.linear_bound

    @cached_property
    def distance(self) -> Array:
        """Mahalanobis errors (trials,) in deviations of the Cramér-Rao bound, infinite where not finite."""
        distance = np.sqrt(self.scalars["crlb_distance"])
        distance[~np.isfinite(distance)] = np.inf
        return distance

    @property
    def reports_covariance(self) -> bool:
        return bool(np.isfinite(self.deviation).any())

    @cached_property
    def histories(self) -> list[History]:
        """Those of the converged trials whose iterates are stored; none of a filter, which has epochs instead."""
        if not self.iterates:
            return []
        names = [p["name"] for p in self.parameters]
        columns = [f"x_{name}" for name in names]
        result: list[History] = []
        for cell, _ in self.group.cells:
            stored = self.collection.load_history(cell, [*columns, "iteration"])
            if stored is None:
                continue
            x = np.stack([stored[c] for c in columns], axis=1)
            for trial in np.unique(stored["trial"]):
                row = np.flatnonzero((self.ids[:, 0] == cell.seed) & (self.ids[:, 1] == trial))
                iterates = x[stored["trial"] == trial]
                if len(row) and self.converged[row[0]] and len(iterates) > 1:
                    result.append(self._history(int(row[0]), iterates))
        return result

    def _history(self, row: int, iterates: Array) -> History:
        distances = distances_to_limit(iterates, self.crlb[row])
        return History(row, trial_label(*self.ids[row]), iterates, distances, float(self.cost[row]))

    @cached_property
    def calibrations(self) -> list[Calibration]:
        """How honest the reported covariance is for each parameter, and for all last; empty where none is reported."""
        return calibrations(self.error, self.deviation, self.scalars["nees"], self.converged)

    @cached_property
    def rmse(self) -> Array:
        """(n,), over solved trials."""
        return root_mean(self.error, self.solved)

    @cached_property
    def rmse_limits(self) -> tuple[Array, Array]:
        """Ends (n + 1,) of the intervals of rmse, per parameter; the last of all, over the linear bound."""
        together = np.mean(np.where(self.solved[:, None], self.normalised, 0.0) ** 2, axis=1)
        each = np.where(self.solved[:, None], self.error, 0.0) ** 2
        return rms_interval(np.column_stack([each, together]), self.solved)


def _read_only(array: Array) -> Array:
    view = array.view()
    view.flags.writeable = False
    return view


def root_mean(values: Array, used: Array) -> Array:
    """Root mean square (n,) over the trials used; NaN where there are none."""
    if not used.any():
        return np.full(values.shape[1], np.nan)
    chosen = values if used.all() else values[used]
    return np.sqrt(np.mean(chosen**2, axis=0))


def _aligned(trial: Array, known: Mapping[str, Array] | None, name: str) -> Array:
    """A column of the truth in the order of the estimates' trials; NaN where it is missing."""
    if known is None or name not in known or len(known["trial"]) == 0:
        return np.broadcast_to(np.nan, len(trial))
    at = np.minimum(np.searchsorted(known["trial"], trial), len(known["trial"]) - 1)
    return np.where(known["trial"][at] == trial, known[name][at], np.nan)
