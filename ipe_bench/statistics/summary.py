"""`summary.csv`: a row per scenario, estimator and parameter, plus the parameter `all`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import beta

from ipe_bench.linalg import Array
from ipe_bench.store import TRUTH, Store

ALL = "all"
"""The row over all parameters: root mean square of error over bound."""


def summarize(directories: Sequence[Path | str]) -> pd.DataFrame:
    """The tidy summary of everything stored under the directories; empty where there is nothing."""
    groups: dict[tuple[Any, ...], list[tuple[dict[str, Any], pd.DataFrame]]] = {}
    truths: dict[tuple[Any, ...], pd.DataFrame] = {}
    for directory in directories:
        for piece in Store(directory).pieces():
            footer = piece.footer()
            frame = piece.table().to_pandas()
            names = footer["names"]
            scenario = tuple(names[k] for k in ("measurement", "noise", "error_scale", "seed"))
            if names["estimator"] == TRUTH:
                truths[scenario] = pd.concat([truths[scenario], frame]) if scenario in truths else frame
            else:
                group = (names["measurement"], names["noise"], names["error_scale"], names["estimator"])
                groups.setdefault(group, []).append((footer, frame.assign(seed=names["seed"])))
    rows: list[dict[str, Any]] = []
    for (measurement, noise, error_scale, estimator), parts in groups.items():
        footer = parts[0][0]
        frame = pd.concat([f for _, f in parts])
        head = {"measurement": measurement, "noise": noise, "error_scale": error_scale, "estimator": estimator}
        rows += [head | row for row in _rows(footer, frame)]
    return pd.DataFrame(rows)


def _rows(footer: dict[str, Any], frame: pd.DataFrame) -> list[dict[str, Any]]:
    names = [p["name"] for p in footer["parameters"]]
    bound = np.array(footer["linear_bound"])
    error = frame[[f"error_{name}" for name in names]].to_numpy()
    solved = frame["solved"].to_numpy()
    success = int(frame["success"].sum())
    trials = len(frame)
    low, high = clopper_pearson(success, trials)
    shared = {
        "trials": trials,
        "converged": float((frame["status"] == "converged").mean()),
        "solved": float(solved.mean()),
        "success": success / trials,
        "success_low": low,
        "success_high": high,
        "iterations_median": float(frame["iterations"].median()),
        "simulations_median": float(frame["simulations"].median()),
        "time_median_s": float(frame["time_s"].median()),
    }
    rows = []
    for i, parameter in enumerate(footer["parameters"]):
        rows.append(
            {"parameter": parameter["name"], "unit": parameter["unit"], **shared}
            | _errors(error[solved][:, [i]], bound[[i]], parameter["size"])
        )
    rows.append(
        {"parameter": ALL, "unit": "bound", **shared} | _errors(error[solved] / bound, np.ones(len(bound)), 1.0)
    )
    return rows


def _errors(error: Array, bound: Array, size: float) -> dict[str, float]:
    if len(error) == 0:
        return {"rmse": np.nan, "linear_bound": float(bound[0] * size), "rmse_over_linear_bound": np.nan}
    rmse = float(np.sqrt(np.mean(error**2)))
    return {
        "bias": float(np.mean(error) * size),
        "rmse": rmse * size,
        "linear_bound": float(bound[0] * size),
        "rmse_over_linear_bound": rmse / float(bound[0]),
    }


def clopper_pearson(successes: int, trials: int, level: float = 0.95) -> tuple[float, float]:
    """The exact confidence interval of a share (Clopper and Pearson, Biometrika 26, 1934)."""
    tail = (1 - level) / 2
    low = beta.ppf(tail, successes, trials - successes + 1) if successes else 0.0
    high = beta.isf(tail, successes + 1, trials - successes) if successes < trials else 1.0
    return float(low), float(high)
