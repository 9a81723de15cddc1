"""Stores filled with trials whose statistics are known beforehand."""

import datetime
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from scipy.stats import chi2

from ipe_bench import priors as prior
from ipe_bench.estimators.base import Estimates, Estimator
from ipe_bench.measurements.base import Measurement, Parameter
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise import Gaussian
from ipe_bench.runs import parts
from ipe_bench.runs.store import ResultKey, Store
from ipe_bench.trials.scenario import Scenario
from ipe_bench.trials.thresholds import GATE


@dataclass(frozen=True)
class Repeated(Measurement):
    """Each parameter read `repeats` times directly: with noise of deviation s its bound is s /
    sqrt(repeats)."""

    names: tuple[str, ...] = ("a", "b", "c")
    sizes_given: tuple[float, ...] = (1.0, 10.0, 0.1)
    repeats: int = 4

    name = "repeated"
    analytic = True

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        sizes = [self.sizes_given[i % len(self.sizes_given)] for i in range(len(self.names))]
        return tuple(
            Parameter(n, "m", s, f"group {i // 2}")
            for i, (n, s) in enumerate(zip(self.names, sizes, strict=True))
        )

    @property
    def index(self) -> Mapping[str, Sequence[Any]]:
        return {"reading": list(range(self.repeats * self.n))}

    def simulate(self, x: np.ndarray) -> np.ndarray:
        return np.tile(x, (1, self.repeats))


@dataclass(frozen=True)
class Pretender(Estimator):
    """Stands for an estimator in a store whose rows were made up."""

    option: int = 0
    knows_prior: bool = False
    equation = None

    @cached_property
    def needs(self) -> frozenset[str]:  # type: ignore[override]
        return frozenset({"prior"} if self.knows_prior else ())

    def estimate(self, problem: Problem, z: np.ndarray, *, history: bool = False) -> Estimates:
        raise NotImplementedError


@dataclass(frozen=True)
class Seeker(Pretender):
    """The same for an estimator that seeks a root."""

    equation = "frozen"


@dataclass(frozen=True)
class Filter(Pretender):
    """The same for one that takes epoch after epoch."""

    @cached_property
    def needs(self) -> frozenset[str]:  # type: ignore[override]
        return frozenset({"prior", "epochs"})


class Synthetic:
    """Writes stores: `scenario(...)`, `add(...)` rows under an estimator, `record()` what a run
    expects."""

    Repeated = Repeated
    Pretender = Pretender

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.store = Store(directory)
        self.cells: dict[str, ResultKey] = {}

    @staticmethod
    def scenario(
        error_scale: float = 1.0, seed: int = 0, sigma: float = 0.2, **model: Any
    ) -> Scenario:
        return Scenario(
            Repeated(**model), Gaussian(sigma), prior.GaussianPrior(), error_scale, seed
        )

    @staticmethod
    def bound(scenario: Scenario) -> np.ndarray:
        model = scenario.measurement
        return np.full(model.n, scenario.noise.deviation / np.sqrt(model.repeats))

    def add(
        self,
        scenario: Scenario,
        label: str,
        error: np.ndarray,
        *,
        start: int = 0,
        block: int | None = None,
        estimator: Estimator | None = None,
        history: Mapping[str, np.ndarray] | None = None,
        **columns: Any,
    ) -> ResultKey:
        """Rows with these errors (trials, n), in multiples of sizes; further columns replace the
        defaults."""
        trials, n = error.shape
        names = [p.name for p in scenario.measurement.parameters]
        bound = self.bound(scenario)
        distance = ((error / bound) ** 2).sum(axis=1)
        status = columns.pop("status", "converged")
        rows: dict[str, Any] = {"trial": np.arange(start, start + trials)}
        rows |= {f"error_{name}": error[:, i] for i, name in enumerate(names)}
        deviation = np.broadcast_to(columns.pop("deviation", bound), error.shape)
        rows |= {f"deviation_{name}": deviation[:, i] for i, name in enumerate(names)}
        rows |= {
            "status": np.broadcast_to(np.array(status, dtype=object), trials),
            "message": np.full(trials, "", dtype=object),
            "iterations": np.full(trials, 3),
            "simulations": np.full(trials, 5.0),
            "jacobians": np.zeros(trials),
            "time_s": np.full(trials, 1e-3),
            "crlb_distance": distance,
            "nees": ((error / deviation) ** 2).sum(axis=1),
            "solved": rows_true(trials),
            "success": distance <= chi2.isf(GATE, n),
        }
        rows |= {key: np.broadcast_to(np.asarray(value), trials) for key, value in columns.items()}
        cell = ResultKey(scenario, label, estimator or Pretender())
        truth = ResultKey(scenario)
        facts: dict[str, Any] = {"trial": rows["trial"]}
        for kind in ("x", "crlb", "bayes"):
            facts |= {f"{kind}_{name}": np.full(trials, bound[i]) for i, name in enumerate(names)}
        step = block or trials
        for at in range(0, trials, step):
            part = slice(at, min(at + step, trials))
            first, last = start + part.start, start + part.stop
            self.store.write(
                cell, first, last, {k: v[part] for k, v in rows.items()}, None if at else history
            )
            if not (self.store.trials / f"{truth.key}-{first}-{last}.parquet").exists():
                self.store.write(truth, first, last, {k: v[part] for k, v in facts.items()})
        self.cells |= {cell.key: cell, truth.key: truth}
        return cell

    def record(
        self, trials: int, identifier: str = "run", started: str | None = None, **more: Any
    ) -> Path:
        cells = [
            {"key": c.key, "identity_key": c.footer["identity_key"], "names": c.footer["names"]}
            for c in self.cells.values()
        ]
        now = started or datetime.datetime.now(datetime.UTC).isoformat()
        record = {
            "started": now,
            "trials": trials,
            "cells": cells,
            "versions": {"numpy": np.__version__},
            **more,
        }
        return self.store.write_run(identifier, record)


def rows_true(trials: int) -> np.ndarray:
    return np.ones(trials, dtype=bool)


def forge(path: Path, change: Callable[[dict[str, Any], dict[str, Any]], Any]) -> None:
    """Writes the rows and the footer of a stored file anew after `change(rows, footer)`, with a
    digest that fits."""
    table = pq.read_table(path)
    rows = {name: table[name].to_numpy() for name in table.column_names}
    footer = json.loads(pq.ParquetFile(path).metadata.metadata[parts.FOOTER])
    change(rows, footer)
    parts.write(path, parts.table_of(rows), footer)
