"""What is stored under output folders: what is there, done, missing, failed, stale and damaged.

`run` asks it what to compute, `status` and `report` what to show, `load` for the rows, so they cannot disagree. A file
is used, or named with what is wrong with it; nothing is guessed, mixed or deleted. What the numbers mean is left to
`statistics`.
"""

from __future__ import annotations

import json
from collections.abc import Collection as Keys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.runs.provenance import canonical_json
from ipe_bench.runs.store import FOOTER, SCHEMA, TRUTH, Store, describe_names, gaps

FOOTER_KEYS = frozenset({"key", "identity", "identity_key", "names", "parameters", "linear_bound", "bound", "equation"})
_KEPT_BYTES = 1 << 28
"""Rows that are kept in memory after they were read, so that no file is read twice where memory allows."""


class Unusable(Exception):
    """A file that does not hold what its name and place promise."""


@dataclass(frozen=True)
class Piece:
    """One stored file: trials start to stop of the cell with that key."""

    path: Path
    key: str
    start: int
    stop: int

    @classmethod
    def parse(cls, path: Path) -> Piece:
        """The piece that a file name states.

        Raises:
            Unusable: the name is not one of ours.
        """
        parts = path.stem.split("-")
        if len(parts) != 3 or not (parts[1].isdigit() and parts[2].isdigit()):
            raise Unusable("foreign: its name is not one of ipe-bench")
        return cls(path, parts[0], int(parts[1]), int(parts[2]))

    def read(self) -> tuple[dict[str, Any], pa.Table]:
        """Its footer and its rows.

        Raises:
            Unusable: it is damaged, or not one of ours.
        """
        footer, table = read_table(self.path)
        if not footer.keys() >= FOOTER_KEYS or footer.get("schema") != SCHEMA:
            raise Unusable("foreign: was written by another version of the format")
        if footer["key"] != self.key:
            raise Unusable(f"foreign: its footer belongs to {footer['key']}")
        if table.num_rows != self.stop - self.start:
            raise Unusable(f"damaged: has {table.num_rows} of {self.stop - self.start} rows")
        return footer, table


def read_table(path: Path) -> tuple[dict[str, Any], pa.Table]:
    """The footer and the rows of a Parquet file of ours, the rows without metadata, so that tables join.

    Raises:
        Unusable: it cannot be read, or has no footer of ours.
    """
    try:
        with pq.ParquetFile(path) as file:
            table = file.read(use_threads=False)
    except (pa.ArrowException, OSError) as error:
        raise Unusable(f"damaged or cut short: cannot be read ({type(error).__name__})") from error
    text = (table.schema.metadata or {}).get(FOOTER)
    if text is None:
        raise Unusable("foreign: has no footer of ipe-bench")
    try:
        footer = json.loads(text)
    except ValueError:
        raise Unusable("damaged: its footer cannot be read") from None
    if not isinstance(footer, dict):
        raise Unusable("foreign: its footer is not one of ipe-bench")
    return footer, table.replace_schema_metadata(None)


def _read_record(path: Path, keys: Iterable[str], numbers: Sequence[str], kind: str) -> dict[str, Any]:
    """A JSON record that has these keys, those in `numbers` being whole."""
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        whole = record.keys() >= {*keys, *numbers} and all(int(record[name]) >= 0 for name in numbers)
    except (OSError, ValueError, TypeError, AttributeError):
        whole, record = False, {}
    if not whole:
        raise Unusable(f"foreign: is not a record of a {kind}")
    return record


@dataclass(frozen=True)
class Run:
    """One record of runs/: what was going to be computed."""

    path: Path
    record: Mapping[str, Any]

    @classmethod
    def read(cls, path: Path) -> Run:
        """Raises: Unusable, where it is not such a record."""
        record = _read_record(path, ("cells",), ("trials",), "run")
        if not (
            isinstance(record["cells"], list)
            and all(isinstance(c, dict) and c.keys() >= {"key", "identity_key", "names"} for c in record["cells"])
        ):
            raise Unusable("foreign: is not a record of a run")
        return cls(path, record)

    @property
    def started(self) -> str:
        return str(self.record.get("started", ""))


@dataclass(frozen=True)
class Failed:
    """One record of failed/: trials that could not be computed, and why."""

    key: str
    start: int
    stop: int
    reason: str

    @classmethod
    def read(cls, path: Path) -> Failed:
        """Raises: Unusable, where it is not such a record."""
        record = _read_record(path, ("key", "status", "message"), ("start", "stop"), "failure")
        reason = f"{record['status']}: {record['message']}"
        return cls(record["key"], int(record["start"]), int(record["stop"]), reason)


@dataclass(frozen=True)
class StoredCell:
    """One scenario (one seed) under one estimator, or its truth, with all its pieces from all directories."""

    footer: Mapping[str, Any]
    pieces: tuple[Piece, ...]

    @property
    def key(self) -> str:
        return self.footer["key"]

    @property
    def names(self) -> Mapping[str, Any]:
        return self.footer["names"]

    @property
    def label(self) -> str:
        """The label that the run gave to the estimator."""
        return self.names["estimator"]

    @property
    def seed(self) -> int:
        return self.names["seed"]

    @cached_property
    def scenario_id(self) -> str:
        """One text per scenario, seed included."""
        return canonical_json(self.footer["identity"]["scenario"])

    @cached_property
    def covered(self) -> tuple[tuple[int, int], ...]:
        """The union of the trials that are there, as disjoint ranges in ascending order."""
        return merge_ranges((p.start, p.stop) for p in self.pieces)

    @property
    def trials(self) -> int:
        return _count(self.covered)

    @property
    def written(self) -> float:
        return max(p.path.stat().st_mtime for p in self.pieces)


@dataclass(frozen=True)
class CellState:
    """How far one scenario is under one estimator. `done`, `failed` and `missing` add up to `expected`."""

    names: Mapping[str, Any]
    """measurement, noise, prior, error_scale, seed, estimator (`truth` for the truth and its bounds)."""
    expected: int
    """Trials that were asked for; 0 where no run in the directories asks for this cell."""
    done: int
    failed: int
    missing: int
    stale: int
    """Trials that another version of the source computed; they do not count as done."""
    messages: tuple[str, ...]
    """Why trials failed."""

    @property
    def complete(self) -> bool:
        return self.failed == 0 and self.missing == 0

    @property
    def problems(self) -> Iterator[str]:
        """A line for what is wrong with it, if anything."""
        who = describe_names(self.names)
        for line in self.messages if self.failed else ():
            yield f"failed: {who}: {self.failed} of {self.expected} expected trials: {line}"
        if self.missing:
            yield f"missing: {who}: {self.done} of {self.expected} expected trials are there"


@dataclass
class Results:
    """Everything stored under some directories; `Results.read` finds it."""

    directories: tuple[Path, ...]
    runs: tuple[Run, ...] = ()
    stored: dict[str, StoredCell] = field(default_factory=dict)
    """The usable cells by key, stale ones included."""
    attempts: tuple[Failed, ...] = ()
    """What could not be computed, whether or not it was since."""
    damaged: dict[Path, str] = field(default_factory=dict)
    """What is wrong with each file that is left out."""
    further: list[str] = field(default_factory=list)
    """Problems that showed later: a line for each."""
    _kept: dict[Path, pa.Table] = field(default_factory=dict, repr=False)
    _kept_bytes: int = 0

    @classmethod
    def read(cls, directories: Sequence[Path | str], keys: Keys[str] | None = None) -> Self:
        """What is stored under the directories, or the files of the cells with these keys alone.

        Raises:
            UserError: a directory does not exist.
        """
        paths = tuple(Path(d) for d in directories)
        for path in paths:
            if not path.is_dir():
                raise UserError(f"{path}: there is no such directory; give one that a run wrote to")
        results = cls(paths)
        runs: list[Run] = []
        attempts: list[Failed] = []
        found: dict[str, tuple[dict[str, Any], list[Piece]]] = {}
        for path in paths:
            store = Store(path)
            files = [f for f in sorted(store.trials.glob("*.parquet")) if keys is None or _key_in(f.name) in keys]
            for file in files:
                with results.naming(file):
                    piece = Piece.parse(file)
                    footer, table = piece.read()
                    results._keep(file, table)
                    found.setdefault(piece.key, (footer, []))[1].append(piece)
            if keys is not None:
                continue
            records = sorted(store.runs.glob("*.json"))
            for file in records:
                with results.naming(file):
                    runs.append(Run.read(file))
            for file in sorted(store.failed.glob("*.json")):
                with results.naming(file):
                    attempts.append(Failed.read(file))
            if not files and not records:
                results.problem(f"{path}: holds no results of ipe-bench")
        results.runs = tuple(sorted(runs, key=lambda r: (r.started, r.path.name)))
        results.attempts = tuple(attempts)
        for key, (footer, pieces) in found.items():
            ordered = sorted(pieces, key=lambda p: (p.start, p.stop, str(p.path)))
            results.stored[key] = StoredCell(footer, tuple(ordered))
        return results

    @contextmanager
    def naming(self, path: Path) -> Iterator[None]:
        """Where an `Unusable` becomes a line that names the file."""
        try:
            yield
        except Unusable as error:
            self.damaged[path] = str(error)

    @property
    def problems(self) -> list[str]:
        """A line for everything that is missing, failed, foreign or damaged."""
        lines = [f"{path}: {reason}; left out" for path, reason in self.damaged.items()]
        lines += [line for cell in self.cells for line in cell.problems]
        truths = {cell.scenario_id for cell in self.current if cell.label == TRUTH}
        lines += [
            f"missing: the truth of {describe_names(cell.names)}: no bound is shown"
            for cell in self.current
            if cell.label != TRUTH and cell.scenario_id not in truths
        ]
        return list(dict.fromkeys([*lines, *self.further]))

    @property
    def stale(self) -> list[str]:
        """A line for what older code computed: left out, and no problem where the present code has computed it."""
        return [
            f"stale: {describe_names(cell.names)}: {cell.trials} trials were computed by other code"
            f" ({', '.join(f'{p} {v}' for p, v in cell.footer.get('versions', {}).items())},"
            f" source {cell.footer.get('source')}, key {cell.key}); left out"
            for _, stale in self._rivals.values()
            for cell in stale
        ]

    @property
    def expected(self) -> int:
        """Cells that the records of runs announce."""
        return len(self._asked_for)

    @property
    def complete(self) -> int:
        """Those of them with every trial."""
        return sum(cell.complete for cell in self.cells[: self.expected])

    @cached_property
    def _asked_for(self) -> dict[str, tuple[str, int, Mapping[str, Any]]]:
        """By identity: the key that the newest run has for it, the number of trials, and the names."""
        asked: dict[str, tuple[str, int, Mapping[str, Any]]] = {}
        for run in self.runs:
            for cell in run.record["cells"]:
                trials = int(cell.get("trials", run.record["trials"]))
                key, before, _ = asked.get(cell["identity_key"], (cell["key"], 0, {}))
                trials = max(trials, before) if key == cell["key"] else trials
                asked[cell["identity_key"]] = (cell["key"], trials, cell["names"])
        return asked

    @cached_property
    def _rivals(self) -> dict[str, tuple[StoredCell | None, list[StoredCell]]]:
        """By identity: the stored cell that counts, where it is stored, and the stale ones.

        The one that counts is the one that the newest run expects, else the one that was written last.
        """
        rivals: dict[str, list[StoredCell]] = {}
        for cell in self.stored.values():
            rivals.setdefault(cell.footer["identity_key"], []).append(cell)
        result: dict[str, tuple[StoredCell | None, list[StoredCell]]] = {}
        for identity, cells in rivals.items():
            if identity in self._asked_for:
                key = self._asked_for[identity][0]
            else:
                key = max(cells, key=lambda c: c.written).key
            result[identity] = self.stored.get(key), [c for c in cells if c.key != key]
        return result

    @property
    def current(self) -> list[StoredCell]:
        """The stored cells that are not stale."""
        return [cell for cell, _ in self._rivals.values() if cell is not None]

    @cached_property
    def failures(self) -> tuple[Failed, ...]:
        """What could not be computed and has not been computed since."""
        return tuple(f for f in self.attempts if gaps(self._covered(f.key), f.start, f.stop))

    @cached_property
    def cells(self) -> tuple[CellState, ...]:
        """How far every cell is: those that runs asked for in their order, then others that are there."""
        failures: dict[str, list[Failed]] = {}
        for failure in self.failures:
            failures.setdefault(failure.key, []).append(failure)
        states = []
        for identity, (key, trials, names) in self._asked_for.items():
            lacking, lost = self.missing(key, trials), failures.get(key, [])
            untried = [gap for start, stop in lacking for gap in gaps([(f.start, f.stop) for f in lost], start, stop)]
            done, missing = trials - _count(lacking), _count(untried)
            stale = sum(cell.trials for cell in self._rivals.get(identity, (None, []))[1])
            messages = tuple(dict.fromkeys(f.reason for f in lost))
            states.append(CellState(names, trials, done, trials - done - missing, missing, stale, messages))
        for identity, (cell, old) in self._rivals.items():
            if identity not in self._asked_for and cell is not None:
                states.append(CellState(cell.names, 0, cell.trials, 0, 0, sum(c.trials for c in old), ()))
        return tuple(states)

    def set_aside(self) -> list[str]:
        """Renames what is damaged, so that it is computed again under its own name; returns a line for each file."""
        lines = []
        for path, reason in self.damaged.items():
            # Never deleted. Another run may have done so at this moment.
            aside = path.with_suffix(".damaged")
            with suppress(FileNotFoundError):
                path.rename(aside)
                lines.append(f"{path}: {reason}; set aside as {aside.name} and computed again")
        return lines

    def _covered(self, key: str) -> Sequence[tuple[int, int]]:
        return self.stored[key].covered if key in self.stored else ()

    def missing(self, key: str, trials: int) -> list[tuple[int, int]]:
        """The ranges of trials 0 to `trials` that no usable file of the cell with this key covers."""
        return gaps(self._covered(key), 0, trials)

    def problem(self, line: str) -> None:
        """Adds what a reader of the rows found wrong."""
        self.further.append(line)

    def load(self, cell: StoredCell, columns: Sequence[str] | None, optional: Sequence[str] = ()) -> dict[str, Array]:
        """The rows of a cell as arrays, by ascending trial, each trial once; all columns where `columns` is None.

        A piece that cannot be used any more, or lacks one of the `columns`, is named in `problems`, and left out.
        """
        names = None if columns is None else list(dict.fromkeys(["trial", *columns, *optional]))
        tables = [table for table in (self._rows(piece, columns) for piece in cell.pieces) if table is not None]
        if not tables:
            return {name: np.empty(0) for name in names or ["trial"]}
        table = pa.concat_tables(tables, promote_options="default")
        trial, order = np.unique(table["trial"].to_numpy(), return_index=True)
        whole = len(order) == table.num_rows and np.array_equal(order, np.arange(len(order)))
        result = {}
        for name in table.column_names if names is None else [n for n in names if n in table.column_names]:
            values = table[name].to_numpy()
            result[name] = values if whole else values[order]
        return result | {"trial": trial}

    def _rows(self, piece: Piece, columns: Sequence[str] | None) -> pa.Table | None:
        with self.naming(piece.path):
            table = self._kept.get(piece.path)
            if table is None:
                table = piece.read()[1]
                self._keep(piece.path, table)
            if lacking := [name for name in columns or () if name not in table.column_names]:
                raise Unusable(f"damaged: has no column {lacking[0]}")
            return table
        return None

    def _keep(self, path: Path, table: pa.Table) -> None:
        self._kept[path] = table
        self._kept_bytes += table.nbytes
        while self._kept_bytes > _KEPT_BYTES:
            self._kept_bytes -= self._kept.pop(next(iter(self._kept))).nbytes

    def load_history(self, cell: StoredCell, columns: Sequence[str]) -> dict[str, Array] | None:
        """The iterates of a cell's first trials in order; None where none are stored."""
        for directory in self.directories:
            path = Store(directory).histories / f"{cell.key}.parquet"
            if not path.is_file():
                continue
            with self.naming(path):
                _, table = read_table(path)
                if any(name not in table.column_names for name in ("trial", *columns)):
                    raise Unusable("damaged: a column is missing")
                return {name: table[name].to_numpy() for name in ("trial", *columns)}
        return None


def _key_in(name: str) -> str:
    return name.partition("-")[0]


def require_results(directories: Iterable[Path | str]) -> None:
    """Refuses directories that no run ever wrote to.

    Raises:
        UserError: naming the first of them.
    """
    for directory in directories:
        store = Store(directory)
        if not (store.runs.is_dir() or store.trials.is_dir()):
            raise UserError(f"{directory}: holds no results of ipe-bench; give the output folder of a run")


def merge_ranges(ranges: Iterable[tuple[int, int]]) -> tuple[tuple[int, int], ...]:
    """The union of half-open ranges, as disjoint ranges in ascending order."""
    merged: list[tuple[int, int]] = []
    for start, stop in sorted(ranges):
        if merged and start <= merged[-1][1]:
            merged[-1] = (merged[-1][0], max(stop, merged[-1][1]))
        else:
            merged.append((start, stop))
    return tuple(merged)


def _count(ranges: Iterable[tuple[int, int]]) -> int:
    return sum(stop - start for start, stop in ranges)
