"""What is stored under output folders: what is there, done, missing, failed, refused, stale and damaged.

`run` asks it what to compute, `status` and `report` what to show, `load` for the rows, so they cannot disagree. A file
is used, or named with what is wrong with it; nothing is guessed, mixed or deleted. What the numbers mean is left to
`statistics`.
"""

from __future__ import annotations

import contextlib
import json
import os
import uuid
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from collections.abc import Collection as Keys
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np
import pyarrow as pa

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.files import is_sealed
from ipe_bench.basics.linalg import Array
from ipe_bench.runs.parts import SCHEMA, TRUTH, Outdated, Part, Unusable, as_array, decoded_history
from ipe_bench.runs.provenance import canonical_json
from ipe_bench.runs.store import Store, describe_names, gaps, title

T = TypeVar("T")
AGAIN = "run the same command again, which computes it anew"


@dataclass(frozen=True)
class StoredCell:
    """One scenario (one seed) under one estimator, or its truth, with all its parts from all directories."""

    footer: Mapping[str, Any]
    parts: tuple[Part, ...]

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
        return merge_ranges((p.start, p.stop) for p in self.parts)

    @property
    def trials(self) -> int:
        return _count(self.covered)


@dataclass(frozen=True)
class CellState:
    """How far one scenario is under one estimator. `done`, `failed` and `missing` add up to `expected`."""

    names: Mapping[str, Any]
    """measurement, noise, prior, error_scale, seed, estimator (`truth` for the truth and its bounds)."""
    expected: int
    """Trials that were asked for; 0 if no run in the directories asks for this cell."""
    done: int
    failed: int
    missing: int
    stale: int
    """Trials that another version of the source computed; they do not count as done."""
    messages: tuple[str, ...]
    """Why trials failed."""
    tag: str = ""
    """The beginning of its key, if other cells have the same names."""
    refused: str = ""
    """Why the run that asked for it was refused, if it was."""

    @property
    def title(self) -> str:
        """Its scenario in a line for people."""
        return title(self.names) + (f" (#{self.tag})" if self.tag else "")

    @property
    def complete(self) -> bool:
        return self.failed == 0 and self.missing == 0

    @property
    def problems(self) -> Iterator[str]:
        """A line for what is wrong with it, if anything."""
        who = describe_names(self.names) + (f" (#{self.tag})" if self.tag else "")
        for line in self.messages if self.failed else ():
            yield f"failed: {who}: {self.failed} of {self.expected} expected trials: {line}"
        if self.missing:
            why = f" (refused: {self.refused})" if self.refused else ""
            yield f"missing: {who}: {self.done} of {self.expected} expected trials are there{why}"


@dataclass(frozen=True)
class Run:
    """One record of runs/: what was going to be computed, or was refused."""

    path: Path
    record: Mapping[str, Any]

    @property
    def started(self) -> str:
        return str(self.record["started"])

    @property
    def refused(self) -> str:
        """Why it was, or empty."""
        return str(self.record.get("refused", ""))


@dataclass(frozen=True)
class Failed:
    """One record of failed/: trials that could not be computed, and why."""

    key: str
    start: int
    stop: int
    reason: str


def _read_record(path: Path) -> dict[str, Any]:
    """A JSON record of which not one bit has changed.

    Raises:
        Unusable: it is damaged, or not one of ours.
    """
    try:
        if not path.is_file() or path.is_symlink():
            raise Unusable("damaged: is not a plain file")
        content = path.read_bytes()
        record = json.loads(content) if is_sealed(content) else {}
    except (OSError, ValueError) as error:
        raise Unusable(f"damaged: cannot be read ({error})") from None
    if record.get("schema") in (1, 2):
        raise Outdated("was written by an older version of ipe-bench")
    if record.get("schema") != SCHEMA or record["file"] != path.stem:
        raise Unusable("damaged: is not a whole record of ipe-bench, or that of another file")
    return record


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
    outdated: list[Path] = field(default_factory=list)
    """Files in the format of an older version."""
    further: list[str] = field(default_factory=list)
    """Problems that are not one file's: a line for each."""

    @classmethod
    def read(cls, directories: Sequence[Path | str], keys: Keys[str] | None = None) -> Self:
        """What is stored under the directories, or the trials of the cells with these keys alone.

        Raises:
            UserError: a directory does not exist.
        """
        paths = tuple(Path(d) for d in directories)
        for path in paths:
            if not path.is_dir():
                raise UserError(f"{path}: there is no such directory; give one that a run wrote to")
        results = cls(paths)
        for path in paths:
            results._read_directory(Store(path), keys)
        results.runs = tuple(sorted(results.runs, key=lambda r: (r.started, r.path.name)))
        return results

    def _read_directory(self, store: Store, keys: Keys[str] | None) -> None:
        for folder in (store.trials, store.runs, store.failed):
            if os.path.lexists(folder) and not (folder.is_dir() and os.access(folder, os.R_OK | os.X_OK)):
                self.further.append(f"{folder}: cannot be listed; what is in it is left out")
                return
        listed: set[Path] = set()
        gone = True
        while gone:  # what went away meanwhile is in a larger file, which was not there yet when these were listed
            gone = False
            for key, several in store.parts(keys).items():
                for part in [part for part in several if part.path not in listed]:
                    listed.add(part.path)
                    gone |= not self._add(key, part)
        for path in self._records(store.runs):
            with self._naming(path):
                self.runs += (Run(path, _read_record(path)),)
        for path in self._records(store.failed):
            with self._naming(path):
                r = _read_record(path)
                reason = f"{r['status']}: {r['message']}"
                self.attempts += (Failed(r["key"], r["start"], r["stop"], reason),)
        if keys is None and not listed and not self.runs:
            self.further.append(f"{store.directory}: holds no results of ipe-bench")
        if self.outdated and not self.stored and keys is None:
            self.further.append(f"{store.directory}: was written by an older version of ipe-bench; {AGAIN}")

    def _add(self, key: str, part: Part) -> bool:
        """Adds a part to what is stored, if every byte of it is whole; False if it is not there any more."""
        with self._naming(part.path):
            try:
                footer, _ = part.read()
            except FileNotFoundError:
                return False
            before = self.stored[key].parts if key in self.stored else ()
            self.stored[key] = StoredCell(footer, tuple(sorted([*before, part], key=lambda p: p.order)))
        return True

    def _records(self, folder: Path) -> list[Path]:
        return sorted(path for path in folder.glob("*.json") if not path.name.startswith("."))

    @contextlib.contextmanager
    def _naming(self, path: Path) -> Iterator[None]:
        """Notes what is wrong with a file."""
        try:
            yield
        except Outdated:
            self.outdated.append(path)
        except Unusable as error:
            self.damaged[path] = str(error)

    @property
    def problems(self) -> list[str]:
        """A line for everything that is missing, failed, refused or damaged."""
        lines = [f"{path}: {reason}; left out" for path, reason in self.damaged.items()]
        lines += [f"refused: {run.record.get('job', run.path.stem)}: {run.refused}" for run in self.runs if run.refused]
        lines += [line for cell in self.cells for line in cell.problems if not cell.refused]
        truths = {cell.scenario_id for cell in self.current if cell.label == TRUTH}
        lines += [
            f"missing: the truth of {describe_names(cell.names)}: no bound is shown"
            for cell in self.current
            if cell.label != TRUTH and cell.scenario_id not in truths
        ]
        return list(dict.fromkeys([*lines, *self.further]))

    @property
    def stale(self) -> list[str]:
        """A line for what older code computed: left out, and no problem if the present code has computed it."""
        return [
            f"stale: {describe_names(cell.names)}: {cell.trials} trials were computed by other code"
            f" ({', '.join(f'{p} {v}' for p, v in cell.footer.get('versions', {}).items())},"
            f" source {cell.footer.get('source')}, key {cell.key}); left out"
            for _, stale in self._rivals.values()
            for cell in stale
        ] + [
            f"stale: {folder}: {sum(path.is_relative_to(folder) for path in self.outdated)} files were written by an"
            f" older version of ipe-bench; left out: {AGAIN}"
            for folder in dict.fromkeys(path.parents[1] for path in self.outdated)
        ]

    @property
    def expected(self) -> int:
        """Cells that the records of runs announce, and refused jobs that came to none."""
        return len(self._asked_for) + sum(not run.record["cells"] for run in self.runs if run.refused)

    @property
    def complete(self) -> int:
        """Those of them with every trial."""
        return sum(cell.complete for cell in self.cells[: len(self._asked_for)])

    @cached_property
    def _asked_for(self) -> dict[str, tuple[str, int, Mapping[str, Any], str]]:
        """By identity: the key that the newest run has for it, the number of trials, the names, why it was refused."""
        asked: dict[str, tuple[str, int, Mapping[str, Any], str]] = {}
        for run in self.runs:
            for cell in run.record["cells"]:
                trials = int(cell.get("trials", run.record["trials"]))
                key, before, *_ = asked.get(cell["identity_key"], (cell["key"], 0))
                trials = max(trials, before) if key == cell["key"] else trials
                asked[cell["identity_key"]] = (cell["key"], trials, cell["names"], run.refused)
        return asked

    @cached_property
    def _rivals(self) -> dict[str, tuple[StoredCell | None, list[StoredCell]]]:
        """By identity: the stored cell that counts, if it is stored, and the stale ones.

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
                key = max(cells, key=_written).key
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
        others = [(i, c, old) for i, (c, old) in self._rivals.items() if i not in self._asked_for and c is not None]
        names = [n for _, _, n, _ in self._asked_for.values()] + [c.names for _, c, _ in others]
        alike = Counter(map(describe_names, names))

        def tag(key: str, names: Mapping[str, Any]) -> str:
            return key[:6] if alike[describe_names(names)] > 1 else ""

        failures: dict[str, list[Failed]] = {}
        for failure in self.failures:
            failures.setdefault(failure.key, []).append(failure)
        states = []
        for identity, (key, trials, names, refused) in self._asked_for.items():
            lacking, lost = self.missing(key, trials), failures.get(key, [])
            untried = [gap for start, stop in lacking for gap in gaps([(f.start, f.stop) for f in lost], start, stop)]
            done, missing = trials - _count(lacking), _count(untried)
            stale = sum(cell.trials for cell in self._rivals.get(identity, (None, []))[1])
            messages = tuple(dict.fromkeys(f.reason for f in lost))
            counts = trials, done, trials - done - missing, missing, stale
            states.append(CellState(names, *counts, messages, tag(key, names), refused if missing else ""))
        for _, cell, old in others:
            counts = 0, cell.trials, 0, 0, sum(c.trials for c in old)
            states.append(CellState(cell.names, *counts, (), tag(cell.key, cell.names)))
        return tuple(states)

    def set_aside(self) -> list[str]:
        """Renames what is damaged, so that it is computed again under its own name; returns a line for each file."""
        lines = []
        for path, reason in self.damaged.items():
            aside = path.with_name(f"{path.stem}.damaged-{uuid.uuid4().hex[:8]}")
            with contextlib.suppress(FileNotFoundError):  # another run may have done so at this moment
                try:
                    path.rename(aside)
                    lines.append(f"{path}: {reason}; set aside as {aside.name} and computed again")
                except OSError as error:
                    lines.append(f"{path}: {reason}; cannot be set aside ({error.strerror or error})")
        return lines

    def _covered(self, key: str) -> Sequence[tuple[int, int]]:
        return self.stored[key].covered if key in self.stored else ()

    def missing(self, key: str, trials: int) -> list[tuple[int, int]]:
        """The ranges of trials 0 to `trials` that no usable file of the cell with this key covers."""
        return gaps(self._covered(key), 0, trials)

    def load(self, cell: StoredCell, columns: Sequence[str] | None, optional: Sequence[str] = ()) -> dict[str, Array]:
        """The rows of a cell as arrays, by ascending trial, each trial once; all columns if `columns` is None.

        A part that cannot be used any more, or lacks one of the `columns`, is named in `problems`, and left out. What
        some parts lack of the `optional` columns is NaN or None there.
        """
        names = None if columns is None else list(dict.fromkeys(["trial", *columns, *optional]))
        tables = self._trying(cell, lambda parts: list(self._tables(parts, names, columns or ())))
        if sum(map(len, tables)) < cell.trials and self.damaged.keys().isdisjoint(p.path for p in cell.parts):
            self.further.append(f"missing: {describe_names(cell.names)}: trials went away while they were read")
        if not tables:
            return {name: np.empty(0) for name in ("trial", *(columns or ()), *optional)}
        table = pa.concat_tables(tables, promote_options="default")
        return {name: as_array(table[name]) for name in names or table.column_names if name in table.column_names}

    def _trying(self, cell: StoredCell, read: Callable[[Sequence[Part]], T]) -> T:
        """What `read` makes of the parts of a cell; of those that are there now, if some were merged meanwhile."""
        parts: Sequence[Part] = cell.parts
        while True:
            try:
                return read(parts)
            except FileNotFoundError:
                found = [part for d in self.directories for part in Store(d).parts({cell.key}).get(cell.key, ())]
                parts = sorted((part for part in found if part.path not in self.damaged), key=lambda p: p.order)

    def _tables(self, parts: Sequence[Part], names: Sequence[str] | None, needed: Sequence[str]) -> Iterator[pa.Table]:
        """The rows of one part after another, without the trials that an earlier one had."""
        reached = 0
        for part in parts:
            if part.stop > reached:
                with self._naming(part.path):
                    _, table = part.read(names)
                    if lacking := [name for name in needed if name not in table.column_names]:
                        raise Unusable(f"damaged: has no column {lacking[0]}")
                    yield table.slice(max(0, reached - part.start))
                    reached = part.stop

    def load_history(self, cell: StoredCell, columns: Sequence[str]) -> dict[str, Array] | None:
        """The iterates of a cell's first trials in order; None if none are stored."""

        def first(parts: Sequence[Part]) -> bytes | None:
            for part in parts[:1]:
                with self._naming(part.path):
                    return part.history() if part.start == 0 else None
            return None

        history = self._trying(cell, first)
        if history is None:
            return None
        found = decoded_history(history)
        return {name: found[name] for name in ("trial", *columns)}


def _written(cell: StoredCell) -> float:
    """When the youngest of its files was written; 0 if they went away meanwhile."""
    times = [0.0]
    for part in cell.parts:
        with contextlib.suppress(OSError):
            times.append(part.path.stat().st_mtime)
    return max(times)


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
