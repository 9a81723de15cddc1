"""Results are written here: blocks of trials as they come, and one file per result made of them at the end of a run.

    OUTPUT/trials/KEY-START-STOP.parquet   rows of trials START to STOP of a scenario under an estimator, or its truth
    OUTPUT/runs/RUN.json                   what a run was asked for
    OUTPUT/failed/KEY-START-STOP.json      trials that could not be computed, and why

KEY is a digest of the constructed objects and of the numerical source, so how many trials there are and how they were
cut into blocks changes nothing: the rows of one key are a union of ranges. Every file appears complete or not at all,
and no locks are needed. What is there is said by `runs.results`.
"""

from __future__ import annotations

import contextlib
import datetime
import json
import os
import socket
import tempfile
import time
from collections.abc import Collection as Keys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from ipe_bench.basics.errors import StorageError, UserError
from ipe_bench.basics.files import BLANK_SEAL, seal, write_bytes
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.machine import library_versions
from ipe_bench.estimators.base import Estimator
from ipe_bench.runs import parts
from ipe_bench.runs.execution.base import Execution, Failure
from ipe_bench.runs.parts import SCHEMA, TRUTH, Part, encoded_history, table_of
from ipe_bench.runs.provenance import describe, digest, fingerprint
from ipe_bench.trials.bounds import linear_bound, linear_correlation
from ipe_bench.trials.scenario import Scenario

_ABANDONED_S = 3600.0
"""Age of a temporary file that nobody will finish."""


@dataclass(frozen=True)
class ResultKey:
    """One scenario under one estimator, or its truth: what a stored file belongs to."""

    scenario: Scenario
    label: str = TRUTH
    estimator: Estimator | None = None

    @cached_property
    def identity(self) -> dict[str, Any]:
        """What was computed, whatever the version of the program that did."""
        return {"scenario": describe(self.scenario), "label": self.label, "estimator": describe(self.estimator)}

    @cached_property
    def key(self) -> str:
        """Sixteen hexadecimal digits that stand for the identity, the schema and the numerical source.

        Not for the version: a release that changes no number leaves what is stored valid.
        """
        return digest({"schema": SCHEMA, "identity": self.identity, "source": self.made_by["source"]})

    @cached_property
    def identity_key(self) -> str:
        """Sixteen hexadecimal digits that stand for the identity alone."""
        return digest(self.identity)

    @cached_property
    def made_by(self) -> dict[str, Any]:
        """The versions of the packages and the digest of the numerical source."""
        return fingerprint([self.scenario] if self.estimator is None else [self.scenario, self.estimator])

    @property
    def names(self) -> dict[str, Any]:
        """What people call it by."""
        scenario, truth = self.scenario, self.scenario.truth
        return {
            "measurement": scenario.measurement.name,
            **({} if truth is None else {"truth_measurement": truth.name}),
            "noise": scenario.noise.name,
            "prior": scenario.prior.name,
            "error_scale": scenario.error_scale,
            "seed": scenario.seed,
            "estimator": self.label,
        }

    @cached_property
    def footer(self) -> dict[str, Any]:
        """All that a reader of the file needs to know."""
        scenario, model = self.scenario, self.scenario.measurement
        return {
            "schema": SCHEMA,
            "key": self.key,
            "identity": self.identity,
            "identity_key": self.identity_key,
            **self.made_by,
            "libraries": library_versions(),
            "names": self.names,
            "bound": "bayes" if self.estimator is not None and "prior" in self.estimator.needs else "crlb",
            "equation": None if self.estimator is None else self.estimator.equation,
            "sequential": self.estimator is not None and "epochs" in self.estimator.needs,
            "jacobian_cost": float(getattr(model, "jacobian_cost", model.n)),
            "parameters": [describe(p) for p in model.parameters],
            "readings": model.m,
            "about": first_sentence(model),
            "linear_bound": linear_bound(scenario.problem).tolist(),
            "linear_correlation": linear_correlation(scenario.problem).round(4).tolist(),
        }


def first_sentence(component: Any) -> str:
    """The first sentence of the docstring of a component's class; empty where it has none of its own."""
    kind = type(component)
    words = " ".join((kind.__doc__ or "").split())
    return "" if words.startswith(f"{kind.__name__}(") else words.partition(". ")[0].rstrip(".")


class Store:
    """The results under one output directory."""

    def __init__(self, directory: Path | str) -> None:
        self.directory = Path(directory)
        self.trials = self.directory / "trials"
        self.runs = self.directory / "runs"
        self.failed = self.directory / "failed"

    def prepare(self) -> None:
        """Makes sure that results can be written, and clears away what writers that were killed left half done.

        Raises:
            UserError: they cannot.
        """
        try:
            self.trials.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=self.trials):
                pass
        except OSError as error:
            reason = error.strerror or str(error)
            raise UserError(
                f"output={self.directory}: cannot be written to ({reason}); choose another folder"
            ) from None
        for folder in (self.directory, *(f for f in self.directory.iterdir() if f.is_dir() and not f.is_symlink())):
            for path in folder.glob(".*.tmp"):
                with contextlib.suppress(OSError):
                    if time.time() - path.stat().st_mtime > _ABANDONED_S:
                        path.unlink()

    def require(self) -> None:
        """Refuses to go on in a folder that went away: what it held is missing, and would not be missed.

        Raises:
            StorageError: it did.
        """
        if not self.trials.is_dir():
            raise StorageError(f"{self.directory}: went away while it was being filled; the same command starts anew")

    def parts(self, keys: Keys[str] | None = None) -> dict[str, list[Part]]:
        """The parts that lie here, or those of these keys, by key in the order of reading."""
        found: dict[str, list[Part]] = {}
        for name in os.listdir(self.trials) if self.trials.is_dir() else ():
            part = Part.parse(self.trials / name)
            if part is not None and (keys is None or part.key in keys):
                found.setdefault(part.key, []).append(part)
        return {key: sorted(several, key=lambda part: part.order) for key, several in sorted(found.items())}

    def write(
        self,
        result: ResultKey,
        start: int,
        stop: int,
        columns: Mapping[str, Array],
        history: Mapping[str, Array] | None = None,
    ) -> Path:
        """Stores the rows of trials start to stop, with the iterates of the first trials of all if there are any.

        Raises:
            ValueError: the rows are not those of these trials.
        """
        if not np.array_equal(columns["trial"], np.arange(start, stop)):
            raise ValueError(f"{describe_names(result.names)}: its trials do not count from {start} to {stop}")
        path = self._path(result, start, stop)
        table = table_of({name: _typed(name, np.asarray(values)) for name, values in columns.items()})
        parts.write(path, table, result.footer, None if history is None else encoded_history(history))
        with contextlib.suppress(OSError):
            self._failure(result, start, stop).unlink()
        return path

    def _path(self, result: ResultKey, start: int, stop: int) -> Path:
        return self.trials / f"{result.key}-{start}-{stop}.parquet"

    def has(self, result: ResultKey, start: int, stop: int) -> bool:
        """Whether exactly this block is stored."""
        return self._path(result, start, stop).is_file()

    def write_failure(self, result: ResultKey, start: int, stop: int, failure: Failure) -> Path:
        """States that these trials could not be computed, and why; the next run tries them again."""
        record = {
            "key": result.key,
            "identity_key": result.identity_key,
            "names": result.names,
            "start": start,
            "stop": stop,
            "status": failure.status,
            "message": failure.message,
            "detail": failure.detail,
            "when": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            "host": socket.gethostname(),
        }
        return _write_json(self._failure(result, start, stop), record)

    def _failure(self, result: ResultKey, start: int, stop: int) -> Path:
        return self.failed / f"{result.key}-{start}-{stop}.json"

    def write_run(self, identifier: str, record: Mapping[str, Any]) -> Path:
        """States, before any work, what a run is going to compute."""
        return _write_json(self.runs / f"{identifier}.json", {"run": identifier, **record})

    def same_run(self, record: Mapping[str, Any]) -> str | None:
        """The name of a stored record that says the same, and after which nothing else was asked of its results; None
        if there is none. A run that has nothing to compute needs no other record then."""
        record = json.loads(json.dumps(record, default=str))
        keys = {cell["identity_key"]: cell["key"] for cell in record["cells"]}
        for path in sorted(self.runs.glob("*.json"), reverse=True):
            with contextlib.suppress(OSError, ValueError, KeyError, TypeError, AttributeError):
                known = json.loads(path.read_text(encoding="utf-8"))
                if all(known.get(name) == value for name, value in record.items()):
                    return path.stem
                if any(keys.get(cell["identity_key"], cell["key"]) != cell["key"] for cell in known["cells"]):
                    return None
        return None


def _typed(name: str, values: Array) -> Array:
    """A column in one type for all blocks: numbers that are no counts of trials and iterations are floats."""
    if values.dtype.kind in "fiu" and name not in ("trial", "iterations"):
        return values.astype(np.float64)
    return values.astype(np.int64) if values.dtype.kind in "iu" else values


def _write_json(path: Path, record: Mapping[str, Any]) -> Path:
    text = json.dumps({"schema": SCHEMA, "file": path.stem, **record, "seal": BLANK_SEAL}, indent=1, default=str)
    write_bytes(path, seal(text.encode()))
    return path


@dataclass(frozen=True)
class Merge:
    """A task: the parts of one result, which become one part for each range without gaps."""

    directory: Path
    key: str

    @property
    def trusted(self) -> bool:
        """Whether it runs code of this package alone: it does."""
        return True


def compact(directory: Path, keys: Keys[str], execution: Execution) -> tuple[int, list[str]]:
    """Makes one part of the parts of each result; returns how many files are gone, and what stood in the way.

    It may be stopped, or done twice, at any moment, while others read and write in the folder.
    """
    tasks = [Merge(directory, key) for key, several in Store(directory).parts(keys).items() if len(several) > 1]
    gone, hindrances = 0, []
    try:
        for event in execution.run(merge, tasks) if tasks else ():
            gone += 0 if event.ended else int(event.step)
            if event.failure is not None:
                hindrances.append(event.failure.message)
    except StorageError as error:
        hindrances.append(str(error))
    return gone, hindrances


def merge(task: Merge) -> Iterator[int]:
    """Does one merge, and yields how many files are gone.

    A part is on the disk and was read back before those go whose rows it holds, so that nothing is lost on the way;
    until they do, a reader takes each trial once.

    Raises:
        Unusable: a part is damaged; all stay as they are.
        StorageError: the folder cannot be written to any more; everything that was there is there.
    """
    gone = 0
    group: list[Part] = []
    tables: list[pa.Table] = []
    reached, footer = 0, None
    with contextlib.suppress(FileNotFoundError):  # another run merges the same
        for part in Store(task.directory).parts({task.key}).get(task.key, []):
            found, table = part.read()
            if group and (part.start > reached or found != footer):
                gone += _join(group, tables)
                group, tables = [], []
            fresh = table.slice(max(0, reached - part.start) if group else 0)
            group.append(part)
            tables.append(fresh)
            reached, footer = max(reached, part.stop) if len(group) > 1 else part.stop, found
        gone += _join(group, tables)
    yield gone


def _join(group: Sequence[Part], tables: Sequence[pa.Table]) -> int:
    """Writes one part with the rows of a group, unless there is one, and removes the others; returns their number."""
    if len(group) < 2:
        return 0
    first, stop = group[0], max(part.stop for part in group)
    whole = replace(first, path=first.path.with_name(f"{first.key}-{first.start}-{stop}.parquet"), stop=stop)
    if whole not in group:
        table = pa.concat_tables(tables, promote_options="default")
        parts.write(whole.path, table, first.read(())[0], first.history(), lasting=True)
    whole.read()
    others = [part.path for part in group if part != whole]
    for path in others:
        with contextlib.suppress(OSError):  # another run may have done so; what stays is read once all the same
            path.unlink()
    return len(others)


def gaps(covered: Iterable[tuple[int, int]], start: int, stop: int) -> list[tuple[int, int]]:
    """The parts of the range start to stop that no covered range holds."""
    found, reached = [], start
    for first, last in sorted(covered):
        if first >= stop or reached >= stop:
            break
        if first > reached:
            found.append((reached, first))
        reached = max(reached, last)
    return [*found, (reached, stop)] if reached < stop else found


def title(names: Mapping[str, Any]) -> str:
    """The scenario of a result in a line for people."""
    scale, truth = names.get("error_scale"), names.get("truth_measurement")
    words = [
        names.get("measurement"),
        None if truth is None else f"truth {truth}",
        names.get("noise"),
        None if scale is None else f"error scale {scale:g}",
        f"seed {names.get('seed')}",
    ]
    return ", ".join(str(word) for word in words if word is not None)


def describe_names(names: Mapping[str, Any]) -> str:
    """A result in a line for people."""
    estimator = "the truth" if names.get("estimator") == TRUTH else str(names.get("estimator"))
    return f"{estimator} on {title(names)}"
