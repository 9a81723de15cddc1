"""Results on disk: one Parquet file per scenario, estimator and block, found again by what was computed.

A file's name is a digest of the constructed objects, the versions and the numerical source; how many trials there are
and how they were cut into blocks is not part of it, so the results of one key are a union of ranges. A file appears
under its name complete or not at all.
"""

from __future__ import annotations

import hashlib
import json
import os
import socket
import uuid
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from ipe_bench.components import canonical_json, describe, fingerprint
from ipe_bench.estimation import Estimator
from ipe_bench.linalg import Array
from ipe_bench.montecarlo import linear_bound
from ipe_bench.scenario import Scenario

SCHEMA = 1
FOOTER = b"ipe_bench"
TRUTH = "truth"
"""Stands in place of an estimator's label in the files that hold the truth and its bounds."""


@dataclass(frozen=True)
class Cell:
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
        """Sixteen hexadecimal digits that stand for the identity, the schema, the versions and the source."""
        return _digest({"schema": SCHEMA, "identity": self.identity, **self.made_by})

    @cached_property
    def made_by(self) -> dict[str, Any]:
        return fingerprint([self.scenario] if self.estimator is None else [self.scenario, self.estimator])

    @cached_property
    def footer(self) -> dict[str, Any]:
        """All that a reader of the file needs to know; see `Footer`."""
        scenario, model = self.scenario, self.scenario.measurement
        return {
            "schema": SCHEMA,
            "key": self.key,
            "identity": self.identity,
            "identity_key": _digest(self.identity),
            **self.made_by,
            "names": {
                "measurement": model.name,
                "noise": scenario.noise.name,
                "prior": scenario.prior.name,
                "error_scale": scenario.error_scale,
                "seed": scenario.seed,
                "estimator": self.label,
            },
            "bound": "bayes" if self.estimator is not None and "prior" in self.estimator.needs else "crlb",
            "equation": None if self.estimator is None else self.estimator.equation,
            "parameters": [describe(p) for p in model.parameters],
            "linear_bound": linear_bound(scenario.problem).tolist(),
        }


def _digest(value: Any) -> str:
    return hashlib.sha256(canonical_json(value).encode()).hexdigest()[:16]


@dataclass(frozen=True)
class Piece:
    """One stored file: trials start to stop of the cell with that key."""

    path: Path
    key: str
    start: int
    stop: int

    @classmethod
    def parse(cls, path: Path) -> Piece | None:
        """The piece that a file name states; None where the name is not one of ours."""
        parts = path.stem.split("-")
        if len(parts) != 3 or not (parts[1].isdigit() and parts[2].isdigit()):
            return None
        return cls(path, parts[0], int(parts[1]), int(parts[2]))

    def footer(self) -> dict[str, Any]:
        """The stored footer.

        Raises:
            DamagedFile: the file is truncated, or not one of ours.
        """
        try:
            metadata = pq.read_metadata(self.path).metadata or {}
            return json.loads(metadata[FOOTER])
        except (pa.ArrowException, OSError, KeyError, ValueError) as error:
            raise DamagedFile(self.path, error) from error

    def table(self, columns: Sequence[str] | None = None) -> pa.Table:
        try:
            return pq.read_table(self.path, columns=columns)
        except (pa.ArrowException, OSError) as error:
            raise DamagedFile(self.path, error) from error


class DamagedFile(Exception):
    """A stored file that cannot be read."""

    def __init__(self, path: Path, reason: Exception) -> None:
        super().__init__(f"{path}: cannot be read as a result of ipe-bench ({type(reason).__name__})")
        self.path = path


class Store:
    """The results under one output directory."""

    def __init__(self, directory: Path | str) -> None:
        self.directory = Path(directory)
        self.trials = self.directory / "trials"
        self.histories = self.directory / "histories"
        self.runs = self.directory / "runs"

    def pieces(self) -> Iterator[Piece]:
        """All stored files with a name of ours, in order of name."""
        for path in sorted(self.trials.glob("*.parquet")):
            piece = Piece.parse(path)
            if piece is not None:
                yield piece

    def missing(self, cell: Cell, trials: int) -> list[tuple[int, int]]:
        """The ranges of trials 0 to `trials` that no stored file of this cell covers."""
        covered = sorted((p.start, p.stop) for p in self._pieces_of(cell))
        gaps, reached = [], 0
        for start, stop in covered:
            if start > reached:
                gaps.append((reached, min(start, trials)))
            reached = max(reached, stop)
            if reached >= trials:
                return gaps
        return [*gaps, (reached, trials)]

    def _pieces_of(self, cell: Cell) -> Iterator[Piece]:
        for path in self.trials.glob(f"{cell.key}-*.parquet"):
            piece = Piece.parse(path)
            if piece is None:
                continue
            try:
                piece.footer()
            except DamagedFile:
                # Set aside, never deleted: it is computed again under its own name.
                path.rename(path.with_suffix(".damaged"))
                continue
            yield piece

    def write(self, cell: Cell, start: int, stop: int, columns: Mapping[str, Array]) -> Path:
        """Stores the rows of trials start to stop."""
        return self._write(self.trials / f"{cell.key}-{start}-{stop}.parquet", cell, columns)

    def write_history(self, cell: Cell, columns: Mapping[str, Array]) -> Path:
        """Stores the iterates of the first trials."""
        return self._write(self.histories / f"{cell.key}.parquet", cell, columns)

    def _write(self, path: Path, cell: Cell, columns: Mapping[str, Array]) -> Path:
        table = pa.table(dict(columns)).replace_schema_metadata({FOOTER: canonical_json(cell.footer)})
        write_atomically(path, lambda temporary: pq.write_table(table, temporary, compression="zstd"))
        return path

    def write_run(self, identifier: str, record: Mapping[str, Any]) -> Path:
        """States, before any work, what a run is going to compute."""
        path = self.runs / f"{identifier}.json"
        text = json.dumps(record, indent=1, default=str)
        write_atomically(path, lambda temporary: temporary.write_text(text + "\n", encoding="utf-8"))
        return path


def write_atomically(path: Path, write: Any) -> None:
    """Calls `write(temporary path)` in the same folder and renames the result: readers see all of it or nothing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{socket.gethostname()}-{os.getpid()}-{uuid.uuid4().hex[:8]}.tmp")
    try:
        write(temporary)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
