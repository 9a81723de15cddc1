"""`summary.csv`: a row per scenario, estimator and parameter, plus the parameter `all`.

Shares are of all trials; bias, std, rmse, crlb, efficiency and NEES are over solved trials, the same set for each;
medians, quantiles and coverage are over all trials, what is not finite counting as infinite.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import chi2, norm

from ipe_bench.basics.linalg import Array
from ipe_bench.basics.statuses import Status
from ipe_bench.statistics.collect import ALWAYS_COLUMNS, Collection, Group, collect
from ipe_bench.statistics.consistency import clopper_pearson, mean_limits
from ipe_bench.statistics.intervals import bootstrap_rms, quantile, quantiles

ALL = "all"
"""The row over all parameters: root mean square of error over bound."""
STATISTICS = (
    "trials",
    "converged",
    "solved",
    "success",
    "success_low",
    "success_high",
    "false_root",
    "bias",
    "std",
    "rmse",
    "rmse_low",
    "rmse_high",
    "rmse_common",
    "linear_bound",
    "crlb",
    "bayes_bound",
    "rmse_over_linear_bound",
    "efficiency",
    "median_abs_error",
    "q95_abs_error",
    "nees",
    "nees_low",
    "nees_high",
    "coverage95",
    "misfit",
    "iterations_median",
    "iterations_p95",
    "simulations_median",
    "time_median_s",
)
MISFIT_LEVEL = 1e-3
"""Residuals less probable than this are noticed: the model does not fit."""
FIT = "fit_p"
SCALARS = ("status", "solved", "success", "iterations", "simulations", "jacobians", "time_s", "nees", "crlb_distance")


@dataclass(frozen=True)
class Sample:
    """All trials of one group, seeds one after another; errors and deviations in multiples of the parameters' sizes."""

    group: Group
    ids: Array
    """(trials, 2): seed and trial."""
    error: Array
    deviation: Array
    crlb: Array
    bayes: Array
    scalars: Mapping[str, Array]
    """Per trial, by the names in `SCALARS`, with message and extras where they were asked for."""

    @classmethod
    def load(cls, collection: Collection, group: Group, *, optional: Sequence[str] = ()) -> Sample:
        names = [p["name"] for p in group.footer["parameters"]]
        vectors = [f"{kind}_{name}" for kind in ("error", "deviation") for name in names]
        bounds = [f"{kind}_{name}" for kind in ("crlb", "bayes") for name in names]
        parts: list[dict[str, Array]] = []
        for cell, truth in group.cells:
            rows = collection.load(cell, [*vectors, *SCALARS], (*optional, FIT))
            rows["seed"] = np.full(len(rows["trial"]), cell.seed)
            known = None if truth is None else collection.load(truth, bounds)
            for name in bounds:
                rows[name] = _aligned(rows["trial"], known, name)
            parts.append(rows)
        joined = {key: np.concatenate([p[key] for p in parts]) for key in parts[0] if all(key in p for p in parts)}

        def matrix(kind: str) -> Array:
            return np.stack([joined.pop(f"{kind}_{name}") for name in names], axis=1).astype(float, copy=False)

        ids = np.stack([joined.pop("seed"), joined.pop("trial")], axis=1).astype(np.int64)
        for name in ("solved", "success"):
            joined[name] = joined[name].astype(bool)
        return cls(group, ids, matrix("error"), matrix("deviation"), matrix("crlb"), matrix("bayes"), joined)

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def cost(self) -> Array:
        """Simulations per trial (trials,), a Jacobian counting as many as there are parameters."""
        return self.scalars["simulations"] + self.error.shape[1] * self.scalars["jacobians"]

    @property
    def parameters(self) -> Sequence[Mapping[str, Any]]:
        return self.group.footer["parameters"]

    @cached_property
    def linear_bound(self) -> Array:
        return np.array(self.group.footer["linear_bound"], dtype=float)

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

    @property
    def reports_covariance(self) -> bool:
        return bool(np.isfinite(self.deviation).any())


def _aligned(trial: Array, known: Mapping[str, Array] | None, name: str) -> Array:
    """A column of the truth in the order of the estimates' trials; NaN where the truth is missing."""
    if known is None or len(known["trial"]) == 0:
        return np.full(len(trial), np.nan)
    at = np.minimum(np.searchsorted(known["trial"], trial), len(known["trial"]) - 1)
    return np.where(known["trial"][at] == trial, known[name][at], np.nan)


def summarize(directories: Sequence[Path | str]) -> pd.DataFrame:
    """The tidy summary of everything stored under the directories; empty where there is nothing."""
    collection = collect(directories)
    rows: list[dict[str, Any]] = []
    for groups in collection.scenarios.values():
        common = common_trials(collection, groups)
        for group in groups:
            rows += summary_rows(Sample.load(collection, group), common)
    return to_frame(rows)


def to_frame(rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Rows as a table, columns in the order that readers know."""
    frame = pd.DataFrame(list(rows))
    if frame.empty:
        return pd.DataFrame(columns=[*ALWAYS_COLUMNS, "parameter", "unit", *STATISTICS])
    keys = [c for c in frame.columns if c not in (*STATISTICS, "parameter", "unit")]
    first = [c for c in ("measurement", "noise") if c in keys]
    last = ["error_scale", "estimator"]
    middle = [c for c in keys if c not in (*first, *last) and not c.startswith("estimator.")]
    options = [c for c in keys if c.startswith("estimator.")]
    return frame[[*first, *middle, *last, *options, "parameter", "unit", *STATISTICS]]


def common_trials(collection: Collection, groups: Sequence[Group]) -> Array:
    """The (seed, trial) pairs, sorted, that every estimator of a scenario solved, as one number each."""
    common: Array | None = None
    for group in groups:
        parts = []
        for cell, _ in group.cells:
            rows = collection.load(cell, ["solved"])
            trial = rows["trial"][rows["solved"].astype(bool)].astype(np.int64)
            parts.append(identifier(np.stack([np.full(len(trial), cell.seed, dtype=np.int64), trial], axis=1)))
        mine = np.unique(np.concatenate(parts))
        common = mine if common is None else np.intersect1d(common, mine, assume_unique=True)
    return np.empty(0, dtype=np.int64) if common is None else common


def identifier(ids: Array) -> Array:
    """One number per (seed, trial)."""
    return ids[:, 0] * (1 << 40) + ids[:, 1]


def summary_rows(sample: Sample, common: Array) -> list[dict[str, Any]]:
    """The rows of one scenario under one estimator; `common` are the trials that all its rivals solved as well."""
    group, solved = sample.group, sample.solved
    trials, n = sample.error.shape
    if trials == 0:
        return []
    head = dict(group.columns) | {"estimator": group.estimator} | dict(group.options)
    success = int(sample.scalars["success"].sum())
    low, high = clopper_pearson(success, trials)
    shares = {
        "trials": trials,
        "converged": float(sample.converged.mean()),
        "solved": float(solved.mean()),
        "success": success / trials,
        "success_low": low,
        "success_high": high,
        "false_root": float((sample.converged & ~solved).mean()),
        # Residuals that are not finite are no fit.
        "misfit": float((~(sample.scalars[FIT] >= MISFIT_LEVEL)).mean()) if FIT in sample.scalars else np.nan,
        "iterations_median": quantile(sample.scalars["iterations"], 0.5),
        "iterations_p95": quantile(sample.scalars["iterations"], 0.95),
        "simulations_median": quantile(sample.cost, 0.5),
        "time_median_s": quantile(sample.scalars["time_s"], 0.5),
    }
    shared_by_all = np.isin(identifier(sample.ids), common)
    one = _per_parameter(sample, shared_by_all)
    bayesian = group.footer["bound"] == "bayes"
    rows = []
    for i, parameter in enumerate(sample.parameters):
        size = float(parameter["size"])
        physical = {key: float(values[i]) * size for key, values in one.items() if key not in _PURE}
        pure = {key: float(one[key][i]) for key in _PURE}
        row = {"parameter": parameter["name"], "unit": parameter["unit"], **shares, **physical, **pure}
        row["rmse_over_linear_bound"] = row["rmse"] / row["linear_bound"]
        row["efficiency"] = _ratio(row["bayes_bound" if bayesian else "crlb"], row["rmse"])
        rows.append(head | row)
    over_bound = {
        key: _rms(one[key] / sample.linear_bound)
        for key in ("bias", "std", "rmse", "rmse_common", "crlb", "bayes_bound")
    }
    squares = np.mean(np.where(solved[:, None], sample.normalised, 0.0) ** 2, axis=1, keepdims=True)
    rms_low, rms_high = bootstrap_rms(squares, solved)
    size_of_trial = np.sqrt(np.mean(sample.normalised**2, axis=1))
    nees_low, nees_high = mean_limits(n, int(solved.sum()))
    nees = sample.scalars["nees"]
    reports = sample.reports_covariance
    rows.append(
        head
        | {"parameter": ALL, "unit": "linear bound", **shares, **over_bound}
        | {
            "rmse_low": float(rms_low[0]),
            "rmse_high": float(rms_high[0]),
            "linear_bound": 1.0,
            "rmse_over_linear_bound": over_bound["rmse"],
            "efficiency": _ratio(over_bound["bayes_bound" if bayesian else "crlb"], over_bound["rmse"]),
            "median_abs_error": quantile(size_of_trial, 0.5),
            "q95_abs_error": quantile(size_of_trial, 0.95),
            "nees": float(np.mean(nees[solved]) / n) if reports and solved.any() else np.nan,
            "nees_low": nees_low if reports else np.nan,
            "nees_high": nees_high if reports else np.nan,
            "coverage95": float((nees <= chi2.ppf(0.95, n)).mean()) if reports else np.nan,
        }
    )
    return rows


_PURE = ("nees", "nees_low", "nees_high", "coverage95")
"""Statistics without a unit."""


def _per_parameter(sample: Sample, shared_by_all: Array) -> dict[str, Array]:
    """Every statistic of each parameter (n,), in multiples of its size."""
    solved, error = sample.solved, sample.error
    trials, n = error.shape
    count = int(solved.sum())
    nothing = np.full(n, np.nan)
    used = error if count == trials else error[solved]
    squares = np.where(solved[:, None], error, 0.0) ** 2
    low, high = bootstrap_rms(squares, solved)
    middle, tail = np.array([quantiles(np.abs(column), np.array([0.5, 0.95])) for column in error.T]).T
    reports = sample.reports_covariance
    if reports:
        with np.errstate(all="ignore"):
            ratio = np.abs(error) / sample.deviation
        nees = np.mean(ratio[solved] ** 2, axis=0) if count else nothing
        coverage = (ratio <= norm.isf(0.025)).mean(axis=0)
        limits = mean_limits(1, count)
    else:
        nees = coverage = nothing
        limits = (np.nan, np.nan)
    return {
        "bias": used.mean(axis=0) if count else nothing,
        "std": used.std(axis=0, ddof=1) if count > 1 else nothing,
        "rmse": _root_mean(error, solved),
        "rmse_low": low,
        "rmse_high": high,
        "rmse_common": _root_mean(error, solved & shared_by_all),
        "linear_bound": sample.linear_bound,
        "crlb": _root_mean(sample.crlb, solved),
        "bayes_bound": _root_mean(sample.bayes, solved),
        "median_abs_error": middle,
        "q95_abs_error": tail,
        "nees": nees,
        "nees_low": np.full(n, limits[0]),
        "nees_high": np.full(n, limits[1]),
        "coverage95": coverage,
    }


def _root_mean(values: Array, used: Array) -> Array:
    """Root mean square (n,) over the trials used; NaN where there are none."""
    if not used.any():
        return np.full(values.shape[1], np.nan)
    chosen = values if used.all() else values[used]
    return np.sqrt(np.mean(chosen**2, axis=0))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _ratio(a: float, b: float) -> float:
    return a / b if b > 0 else float("nan")
