"""Results are written here: one Parquet file per scenario, estimator and block, found again by what was computed.

A file's name is a digest of the constructed objects and of the numerical source; how many trials there are
and how they were cut into blocks is not part of it, so the results of one key are a union of ranges. A file appears
under its name complete or not at all. Reading is left to `runs.results`, to make few files of many to
`runs.compaction`.
"""

from __future__ import annotations

import contextlib
import datetime
import hashlib
import json
import socket
import tempfile
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ipe_bench.basics.errors import StorageError, UserError
from ipe_bench.basics.files import BLANK_SEAL, seal, write_bytes
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.machine import library_versions
from ipe_bench.estimators.base import Estimator
from ipe_bench.runs.execution.base import Failure
from ipe_bench.runs.provenance import canonical_json, describe, fingerprint
from ipe_bench.runs.rows import Rule, cast, faults, history_rules, trial_rules
from ipe_bench.trials.bounds import linear_bound
from ipe_bench.trials.scenario import Scenario

SCHEMA = 2
FOOTER = b"ipe_bench"
TRUTH = "truth"
"""Stands in place of an estimator's label in the files that hold the truth and its bounds."""
_ABANDONED_S = 3600.0
"""A file that somebody began to write so long ago will not be finished."""


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
        return key_of(self.identity, self.made_by["source"])

    @cached_property
    def identity_key(self) -> str:
        """Sixteen hexadecimal digits that stand for the identity alone."""
        return digest(self.identity)

    @cached_property
    def made_by(self) -> dict[str, Any]:
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

    @property
    def parameters(self) -> list[str]:
        """The names of the parameters."""
        return [p.name for p in self.scenario.measurement.parameters]

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
        }


def first_sentence(component: Any) -> str:
    """The first sentence of the docstring of a component's class; empty where it has none of its own."""
    kind = type(component)
    words = " ".join((kind.__doc__ or "").split())
    return "" if words.startswith(f"{kind.__name__}(") else words.partition(". ")[0].rstrip(".")


def digest(value: Any) -> str:
    """Sixteen hexadecimal digits that stand for plain data."""
    return hashlib.sha256(canonical_json(value).encode()).hexdigest()[:16]


def key_of(identity: Mapping[str, Any], source: str) -> str:
    """The key of a cell; see `ResultKey.key`."""
    return digest({"schema": SCHEMA, "identity": identity, "source": source})


class Store:
    """The results under one output directory."""

    def __init__(self, directory: Path | str) -> None:
        self.directory = Path(directory)
        self.trials = self.directory / "trials"
        self.histories = self.directory / "histories"
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

    def write(self, cell: ResultKey, start: int, stop: int, columns: Mapping[str, Array]) -> Path:
        """Stores the rows of trials start to stop.

        Raises:
            ValueError: they are not what rows of trials are, and would be refused when they are read.
        """
        path = self.trials / f"{cell.key}-{start}-{stop}.parquet"
        self._write(path, cell, columns, trial_rules(cell.parameters, truth=cell.estimator is None), start)
        with contextlib.suppress(OSError):
            (self.failed / f"{cell.key}-{start}-{stop}.json").unlink()
        return path

    def has(self, cell: ResultKey, start: int, stop: int) -> bool:
        """Whether exactly this block of this cell is stored."""
        return (self.trials / f"{cell.key}-{start}-{stop}.parquet").is_file()

    def write_failure(self, cell: ResultKey, start: int, stop: int, failure: Failure) -> Path:
        """States that these trials could not be computed, and why; the next run tries them again."""
        record = {
            "key": cell.key,
            "identity_key": cell.identity_key,
            "names": cell.names,
            "start": start,
            "stop": stop,
            "status": failure.status,
            "message": failure.message,
            "detail": failure.detail,
            "when": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            "host": socket.gethostname(),
        }
        path = self.failed / f"{cell.key}-{start}-{stop}.json"
        return self._write_json(path, record)

    def write_history(self, cell: ResultKey, columns: Mapping[str, Array]) -> Path:
        """Stores the iterates of the first trials."""
        path = self.histories / f"{cell.key}.parquet"
        self._write(path, cell, columns, history_rules(cell.parameters))
        return path

    def _write(
        self,
        path: Path,
        cell: ResultKey,
        columns: Mapping[str, Array],
        rules: Mapping[str, Rule],
        start: int | None = None,
    ) -> None:
        rows = cast(columns, rules)
        for fault in faults(rows, rules, start):
            raise ValueError(f"{describe_names(cell.names)}: what is to be stored {fault}")
        content = encode(rows, cell.footer)
        write_bytes(path, content)

    def write_run(self, identifier: str, record: Mapping[str, Any]) -> Path:
        """States, before any work, what a run is going to compute."""
        path = self.runs / f"{identifier}.json"
        return self._write_json(path, {"run": identifier, **record})

    def same_run(self, record: Mapping[str, Any]) -> str | None:
        """The name of a stored record that says the same, and after which nothing else was asked of its cells; None
        where there is none. A run that has nothing to compute needs no further record then."""
        record = json.loads(json.dumps(record, default=str))
        keys = {cell["identity_key"]: cell["key"] for cell in record["cells"]}
        for path in sorted(self.runs.glob("*.json"), reverse=True):
            try:
                known = json.loads(path.read_text(encoding="utf-8"))
                if all(known.get(name) == value for name, value in record.items()):
                    return path.stem
                if any(keys.get(cell["identity_key"], cell["key"]) != cell["key"] for cell in known["cells"]):
                    return None
            except (OSError, ValueError, KeyError, TypeError, AttributeError):
                continue
        return None

    def _write_json(self, path: Path, record: Mapping[str, Any]) -> Path:
        text = json.dumps({"schema": SCHEMA, **record, "seal": BLANK_SEAL}, indent=1, default=str)
        content = seal(text.encode())
        write_bytes(path, content)
        return path


def encode(columns: Mapping[str, Array], footer: Mapping[str, Any]) -> bytes:
    """A Parquet file with these columns and this footer, and the digest of all of it."""
    metadata = {FOOTER: canonical_json(footer).encode(), b"seal": BLANK_SEAL.encode()}
    table = pa.Table.from_arrays([_arrow(v) for v in columns.values()], names=list(columns), metadata=metadata)
    # Texts are few different ones, numbers are all different and alike in their first bytes.
    texts = [field.name for field in table.schema if pa.types.is_string(field.type)]
    floats = [field.name for field in table.schema if pa.types.is_floating(field.type)]
    how: dict[str, Any] = {"compression": "lz4", "use_dictionary": texts, "use_byte_stream_split": floats}
    buffer = pa.BufferOutputStream()
    pq.write_table(table, buffer, write_statistics=False, **how)
    return seal(buffer.getvalue().to_pybytes())


def _arrow(values: Array) -> pa.Array:
    """A column as Arrow stores it. `pa.array` would import pandas, a second that a worker can do without."""
    values = np.ascontiguousarray(values)
    if values.dtype == object:
        texts = [str(value).encode() for value in values]
        ends = np.cumsum([0, *(len(text) for text in texts)], dtype=np.int32)
        return pa.Array.from_buffers(
            pa.string(), len(values), [None, pa.py_buffer(ends.tobytes()), pa.py_buffer(b"".join(texts))]
        )
    if values.dtype == bool:
        bits = np.packbits(values, bitorder="little")
        return pa.Array.from_buffers(pa.bool_(), len(values), [None, pa.py_buffer(bits.tobytes())])
    return pa.Array.from_buffers(pa.from_numpy_dtype(values.dtype), len(values), [None, pa.py_buffer(values.tobytes())])


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
    """The scenario of a cell in a line for people."""
    scale, truth = names.get("error_scale"), names.get("truth_measurement")
    parts = [
        names.get("measurement"),
        None if truth is None else f"truth {truth}",
        names.get("noise"),
        None if scale is None else f"error scale {scale:g}",
        f"seed {names.get('seed')}",
    ]
    return ", ".join(str(part) for part in parts if part is not None)


def describe_names(names: Mapping[str, Any]) -> str:
    """A cell in a line for people."""
    estimator = "the truth" if names.get("estimator") == TRUTH else str(names.get("estimator"))
    return f"{estimator} on {title(names)}"
