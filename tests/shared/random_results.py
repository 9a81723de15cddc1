"""Random results in memory, of constants and of states that move, whose estimators fail in any
share of their trials: what the product's own analysis makes of them is what is shown."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.stats import chi2

from ipe_bench.runs.results import StoredCell
from ipe_bench.statistics.analysis import Analysis, Begun
from ipe_bench.statistics.collect import Collection, Group
from ipe_bench.trials.thresholds import GATE

EPOCHS = 4
LABELS = (
    "linear_lse",
    "auto",
    "a_solver_with_a_long_name_and_options (max_iterations=10)",
    "a_solver_with_a_long_name_and_options (max_iterations=100)",
    "ekf",
    "damped (metric=marquardt, alpha=0.1, max_iterations=100, tolerance=1e-6)",
    "damped (metric=marquardt, alpha=0.2, max_iterations=100, tolerance=1e-6)",
    "ukf",
    "newton",
    "fixed_point",
    "mine",
)
FAMILIES = (
    *("least squares", "IPE", "IPE", "IPE", "filters", "IPE", "IPE", "filters", "IPE", "IPE"),
    "least squares",
)
Rows = dict[str, np.ndarray]


@dataclass
class Held(Collection):
    """Holds the rows of each result, by its key, in place of files."""

    rows: Mapping[str, Rows] = field(default_factory=dict)

    def load(self, cell: StoredCell, columns: Any, optional: Any = ()) -> Rows:
        known = self.rows[cell.key]
        asked = known if columns is None else {"trial", *columns, *optional}
        return {name: values for name, values in known.items() if name in asked}

    def load_history(self, cell: StoredCell) -> None:
        return None


@dataclass(frozen=True)
class Results:
    """Random results: their groups, and the rows of each."""

    groups: tuple[Group, ...]
    rows: Mapping[str, Rows]

    @property
    def analysis(self) -> Analysis:
        return Begun(Held((), groups=self.groups, rows=self.rows)).finish()

    def failing(self, rng: np.random.Generator) -> tuple[Results, Group]:
        """Returns the same in which some converged trials of one group are failures, and the
        group."""
        group = self.groups[int(rng.integers(len(self.groups)))]
        key = group.cells[0].key
        rows = dict(self.rows[key])
        lost = (rows["status"] == "converged") & (rng.random(len(rows["trial"])) < rng.random())
        rows["status"] = np.where(lost, "diverged", rows["status"]).astype(object)
        for name, values in rows.items():
            if name.startswith(("error_", "deviation_", "path_")) or name in ("nees", "fit_p"):
                rows[name] = np.where(lost, np.nan, values)
        rows["crlb_distance"] = np.where(lost, np.nan, rows["crlb_distance"])
        for name in ("solved", "success"):
            rows[name] = rows[name] & ~lost
        if "path_success" in rows:
            rows["path_success"] = self.rows[key]["path_success"].astype(bool) & ~lost
            rows["curves_errors"] = _texts(np.where(lost[:, None, None], np.nan, _errors(rows)))
            rows["curves"] = _curves(rows, len(group.footer["parameters"]))
        return replace(self, rows={**self.rows, key: rows}), group


def results(seed: int) -> Results:
    """Draws two to eleven estimators, mostly few, at one to four error scales."""
    rng = np.random.default_rng([seed, 50])
    moving = bool(rng.random() < 0.5)
    n = int(rng.integers(1, 4))
    trials = int(rng.choice([15, 30, 60]))
    scales = sorted(rng.choice([0.1, 1.0, 1.0000001, 10.0, 100.0], int(rng.integers(1, 5)), False))
    labels = rng.permutation(len(LABELS))[: int(rng.choice([2, 3, 4, 5, 6, 11]))]
    kinds = rng.choice(["good", "falling", "random", "bad"], len(LABELS), p=[0.3, 0.4, 0.2, 0.1])
    groups = []
    rows = {}
    for at, scale in enumerate(scales):
        noise = rng.standard_normal((trials, n))
        for i in sorted(labels):
            fails = {"good": 0.0, "falling": (at + 1) / len(scales), "bad": 1.0}
            share = fails.get(kinds[i], rng.random()) * rng.choice([0.5, 1.0])
            group = _group(i, float(scale), n, moving, bool(rng.random() < 0.5))
            groups.append(group)
            rows[group.cells[0].key] = _rows(rng, noise, share, moving)
    return Results(tuple(groups), rows)


def _group(i: int, scale: float, n: int, moving: bool, smooths: bool) -> Group:
    label = LABELS[i]
    parameters = [{"name": f"x{k}", "unit": "m", "size": 1.0} for k in range(n)]
    noise = "model" if moving else "gaussian"
    names = {"measurement": "made up", "noise": noise, "estimator": label, "seed": 0}
    footer = {
        "key": f"{label}-{scale!r}",
        "names": names,
        "family": FAMILIES[i],
        "parameters": parameters,
        "linear_bound": [1.0] * n,
        "readings": 30,
        "bound": "bayes" if moving or label == "ekf" else "crlb",
        "equation": None if moving or label == "ekf" else "frozen",
        "identity": {"scenario": {}, "estimator": {}},
    }
    if moving:
        footer |= {"times": list(range(EPOCHS)), "smooths": smooths, "sequential": True}
    columns = {"measurement": "made up", "noise": noise, "error_scale": scale}
    return Group(columns, label, {}, (StoredCell(footer, ()),), (None,))


def _rows(rng: np.random.Generator, noise: np.ndarray, share: float, moving: bool) -> Rows:
    trials, n = noise.shape
    error = noise * rng.choice([1.0, 1.0, 1.05, 1.5]) + rng.choice([0.0, 0.5])
    far = rng.random(trials) < share
    error[far] *= 10 ** rng.uniform(1, 6)
    silent = rng.random(trials) < rng.choice([0.0, 0.5, 1.0])
    finite = rng.random(trials) < 0.7
    status = np.where(far & ~silent, "diverged", "converged").astype(object)
    error[far & ~silent & ~finite] = np.nan
    distance = (error**2).sum(axis=1)
    deviation = np.full((trials, n), rng.choice([0.7, 1.0, 1.0, 1.5]))
    rows: Rows = {"trial": np.arange(trials), "status": status}
    rows |= {f"error_x{k}": error[:, k] for k in range(n)}
    rows |= {f"deviation_x{k}": deviation[:, k] for k in range(n)}
    rows |= {
        "solved": (status == "converged") & ~(far & ~moving),
        "success": distance <= chi2.isf(GATE, n),
        "crlb_distance": distance,
        "nees": distance / deviation[:, 0] ** 2,
        "iterations": np.full(trials, 3),
        "simulations": np.full(trials, float(rng.integers(1, 50))),
        "jacobians": np.zeros(trials),
        "time_s": np.full(trials, 1e-3),
        "fit_p": np.full(trials, 0.5),
    }
    if moving:
        along = np.abs(error[:, None]) * rng.uniform(0.5, 1.5, (trials, EPOCHS, n))
        whole = np.sqrt((along**2).mean(axis=2))
        rows |= {f"path_x{k}": np.sqrt((along[..., k] ** 2).mean(axis=1)) for k in range(n)}
        rows |= {f"path_bound_x{k}": np.ones(trials) for k in range(n)}
        rows |= {
            "path_error": np.sqrt((whole**2).mean(axis=1)),
            "path_nees": rows["nees"],
            "path_success": rows["success"].astype(bool),
            "curves_errors": _texts(np.concatenate([along, whole[..., None]], axis=2)),
        }
        rows["curves"] = _curves(rows, n)
    return rows


def _texts(errors: np.ndarray) -> np.ndarray:
    texts = [base64.b64encode(one.astype("<f4").tobytes()).decode() for one in errors]
    return np.array(texts, dtype=object)


def _errors(rows: Rows) -> np.ndarray:
    found = [np.frombuffer(base64.b64decode(text), "<f4") for text in rows["curves_errors"]]
    return np.array(found, dtype=float).reshape(len(found), EPOCHS, -1)


def _curves(rows: Rows, n: int) -> np.ndarray:
    """Returns the sums over trials as a block stores them."""
    from ipe_bench.trials.paths import packed

    claims = rows["nees"][rows["status"] == "converged"]
    trials = len(rows["trial"])
    sums = [np.nansum(claims), (~np.isnan(claims)).sum(), *[trials] * n, trials, trials]
    return packed(trials, [np.tile(np.array(sums, dtype=float), (EPOCHS, 1))])
