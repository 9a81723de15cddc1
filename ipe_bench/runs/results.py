"""What is stored under output folders: what is there, done, missing, failed, stale and damaged.

`run` asks it what to compute, `status` and `report` what to show, `load` for the rows, so they cannot disagree. A file
is used, or named with what is wrong with it; nothing is guessed, mixed or deleted. What the numbers mean is left to
`statistics`.
"""

from __future__ import annotations

import itertools
import os
from collections import Counter, deque
from collections.abc import Collection as Keys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
import pyarrow as pa

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.runs.columns import as_array
from ipe_bench.runs.pieces import Failed, Foreign, Gone, Outdated, Part, Run, Unusable, read_history
from ipe_bench.runs.provenance import canonical_json
from ipe_bench.runs.store import TRUTH, Store, describe_names, gaps, title
from ipe_bench.runs.verified import Verified, signature

CHUNK = 1 << 14
"""Rows that are looked at together: few enough to stay in a processor's cache."""
_KEPT_BYTES = 1 << 26
"""Rows that are kept in memory after they were read, so that no file is read twice where memory allows."""
_FEW_TRIALS = 50_000
"""A cell of so many is read whole and kept; of a larger one, only the columns that are asked for are read."""


@dataclass(frozen=True)
class StoredCell:
    """One scenario (one seed) under one estimator, or its truth, with all its pieces from all directories."""

    footer: Mapping[str, Any]
    pieces: tuple[Part, ...]

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
    def written(self) -> int:
        """When the youngest of its files was; 0 where they went away meanwhile."""
        return max((found[1] for p in self.pieces if (found := signature(p.path)) is not None), default=0)


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
    tag: str = ""
    """The beginning of its key, where other cells have the same names."""

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
    foreign: set[Path] = field(default_factory=set)
    """Those of them whose names are not ours."""
    outdated: list[Path] = field(default_factory=list)
    """Files in the format of an older version."""
    further: list[str] = field(default_factory=list)
    """Problems that are not one file's: a line for each."""
    _kept: dict[Path, pa.Table] = field(default_factory=dict, repr=False)
    _kept_bytes: int = 0

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
        for key, cell in results.stored.items():
            results.stored[key] = replace(cell, pieces=tuple(sorted(cell.pieces, key=_reading_order)))
        return results

    def _read_directory(self, store: Store, keys: Keys[str] | None) -> None:
        verified = Verified(store.directory)
        trials, runs = self._files(store.trials, ".parquet", keys), self._files(store.runs, ".json")
        found: dict[str, list[Part]] = {}
        footers: dict[str, Mapping[str, Any]] = {}
        listed: set[Path] = set()
        while trials:
            listed.update(trials)
            gone = [path for path in trials if not self._read_piece(path, verified, found, footers)]
            # What went away meanwhile was merged into larger files, which were not there yet when these were listed.
            trials = [p for p in self._files(store.trials, ".parquet", keys) if p not in listed] if gone else []
        for path in self._files(store.histories, ".parquet", keys):
            if not verified.knows(path):
                with self.naming(path):
                    before = signature(path)
                    self._keep(path, read_history(path)[1])
                    verified.note(path, before)
        for path in runs:
            # A run that only asks what it lacks need not know what others were to compute.
            if keys is None or not verified.knows(path):
                with self.naming(path):
                    before = signature(path)
                    self.runs += (Run.read(path),)
                    verified.note(path, before)
        for path in self._files(store.failed, ".json"):
            with self.naming(path):
                self.attempts += (Failed.read(path),)
        for key, pieces in found.items():
            before_these = self.stored[key].pieces if key in self.stored else ()
            self.stored[key] = StoredCell(footers[key], (*before_these, *pieces))
        if keys is None and not listed and not runs:
            self.problem(f"{store.directory}: holds no results of ipe-bench")
        verified.save()

    def _read_piece(
        self, path: Path, verified: Verified, found: dict[str, list[Part]], footers: dict[str, Mapping[str, Any]]
    ) -> bool:
        """Adds the piece to what is found, if it is whole; False where it is not there any more."""
        with self.naming(path):
            piece = Part.parse(path)
            footer = verified.footer(path, piece.key)
            if footer is None:
                before = signature(path)
                try:
                    footer, table = piece.read()
                except Gone:
                    return False
                self._keep(path, table)
                verified.note(path, before, footer)
            found.setdefault(piece.key, []).append(piece)
            footers[piece.key] = footer
        return True

    def _files(self, folder: Path, suffix: str, keys: Keys[str] | None = None) -> list[Path]:
        """What lies in a folder under a name with that suffix; with `keys`, what belongs to their cells alone."""
        try:
            names = sorted(os.listdir(folder)) if os.path.lexists(folder) else []
        except OSError as error:
            self.problem(f"{folder}: cannot be listed ({error.strerror or error}); what is in it is left out")
            names = []
        ours = [n for n in names if n.endswith(suffix) and not n.startswith(".")]
        return [folder / n for n in ours if keys is None or n.removesuffix(suffix).partition("-")[0] in keys]

    @contextmanager
    def naming(self, path: Path) -> Iterator[None]:
        """Where an `Unusable` becomes a line that names the file."""
        try:
            yield
        except Outdated:
            self.outdated.append(path)
        except Unusable as error:
            self.damaged[path] = str(error)
            if isinstance(error, Foreign):
                self.foreign.add(path)

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
        ] + [
            f"stale: {folder}: {sum(path.parent == folder for path in self.outdated)} files were written by an older"
            " version of ipe-bench; left out"
            for folder in dict.fromkeys(path.parent for path in self.outdated)
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
        names = [*(n for _, _, n in self._asked_for.values())]
        names += [c.names for i, (c, _) in self._rivals.items() if i not in self._asked_for and c is not None]
        alike = Counter(map(describe_names, names))

        def tag(key: str, names: Mapping[str, Any]) -> str:
            return key[:6] if alike[describe_names(names)] > 1 else ""

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
            counts = trials, done, trials - done - missing, missing, stale
            states.append(CellState(names, *counts, messages, tag(key, names)))
        for identity, (cell, old) in self._rivals.items():
            if identity not in self._asked_for and cell is not None:
                counts = 0, cell.trials, 0, 0, sum(c.trials for c in old)
                states.append(CellState(cell.names, *counts, (), tag(cell.key, cell.names)))
        return tuple(states)

    def set_aside(self) -> list[str]:
        """Renames what is damaged, so that it is computed again under its own name; returns a line for each file.

        Nothing is deleted, and what has a foreign name stays. Where the iterates of a cell are damaged, the block that
        they belong to counts as missing from now on.
        """
        lines = []
        for path, reason in self.damaged.items():
            if path in self.foreign:
                continue
            aside = next(p for p in _names_aside(path) if not os.path.lexists(p))
            with suppress(FileNotFoundError):  # another run may have done so at this moment
                try:
                    path.rename(aside)
                except OSError as error:
                    lines.append(f"{path}: {reason}; cannot be set aside ({error.strerror or error})")
                    continue
                lines.append(f"{path}: {reason}; set aside as {aside.name} and computed again")
            if path.parent.name == "histories" and path.stem in self.stored:
                cell = self.stored[path.stem]
                self.stored[path.stem] = replace(cell, pieces=tuple(p for p in cell.pieces if p.start > 0))
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
        parts = list(self._parts(cell, columns, optional))
        if not parts:
            return {name: np.empty(0) for name in ("trial", *(columns or ()), *optional)}
        return _joined(parts)

    def chunks(
        self, cell: StoredCell, columns: Sequence[str], optional: Sequence[str] = (), rows: int = CHUNK
    ) -> Iterator[dict[str, Array]]:
        """The same some rows at a time, however they are cut into files: each chunk but the last has that many."""
        held: list[dict[str, Array]] = []
        count = 0
        for part in self._parts(cell, columns, optional):
            held.append(part)
            count += len(part["trial"])
            if count >= rows:
                whole, cut = _joined(held), count - count % rows
                for at in range(0, cut, rows):
                    yield {name: values[at : at + rows] for name, values in whole.items()}
                held = [{name: values[cut:] for name, values in whole.items()}]
                count -= cut
        if count:
            yield _joined(held)

    def _parts(
        self, cell: StoredCell, columns: Sequence[str] | None, optional: Sequence[str] = ()
    ) -> Iterator[dict[str, Array]]:
        """The rows of one piece after another, without the trials that an earlier one had."""
        names = None if columns is None else dict.fromkeys(["trial", *columns, *optional])
        whole = names is None or cell.trials <= _FEW_TRIALS
        waiting, known, reached = deque(cell.pieces), {piece.path for piece in cell.pieces}, 0
        while waiting:
            piece = waiting.popleft()
            if piece.stop <= reached:
                continue
            with self.naming(piece.path):
                try:
                    table = self._rows(piece, columns, None if whole else names)
                except Gone:
                    merged = [p for p in _pieces_beside(piece) if p.path not in known]
                    if not merged:
                        raise
                    known.update(p.path for p in merged)
                    waiting = deque(sorted([*waiting, *merged], key=_reading_order))
                    continue
                skipped = max(0, reached - piece.start)
                reached = piece.stop
                shown = table.column_names if names is None else [n for n in names if n in table.column_names]
                yield {name: as_array(table[name])[skipped:] for name in shown}

    def _rows(self, piece: Part, columns: Sequence[str] | None, names: Keys[str] | None) -> pa.Table:
        """The columns `names` of a piece that are there, all where it is None; it must have the `columns`."""
        table = self._kept.get(piece.path)
        if table is None:
            table = piece.read(names)[1]
            if names is None:
                self._keep(piece.path, table)
        if lacking := [name for name in columns or () if name not in table.column_names]:
            raise Unusable(f"damaged: has no column {lacking[0]}")
        return table

    def _keep(self, path: Path, table: pa.Table) -> None:
        self._kept[path] = table
        self._kept_bytes += table.nbytes
        while self._kept_bytes > _KEPT_BYTES:
            self._kept_bytes -= self._kept.pop(next(iter(self._kept))).nbytes

    def load_history(self, cell: StoredCell, columns: Sequence[str]) -> dict[str, Array] | None:
        """The iterates of a cell's first trials in order; None where none are stored."""
        for directory in self.directories:
            path = Store(directory).histories / f"{cell.key}.parquet"
            if path in self.damaged or not path.is_file():
                continue
            with self.naming(path):
                table = self._kept[path] if path in self._kept else read_history(path)[1]
                return {name: as_array(table[name]) for name in ("trial", *columns)}
        return None


def _reading_order(piece: Part) -> tuple[int, int, str]:
    """Of two that begin with the same trial, the longer one first: what lies within it need not be read."""
    return piece.start, -piece.stop, str(piece.path)


def _pieces_beside(gone: Part) -> list[Part]:
    """The pieces of the same cell in its folder that hold some of its trials."""
    found = [Part.parse(path) for path in gone.path.parent.glob(f"{gone.key}-*-*.parquet")]
    return [piece for piece in found if piece.start < gone.stop and piece.stop > gone.start]


def _joined(parts: list[dict[str, Array]]) -> dict[str, Array]:
    """Rows one after another; where some lack a column, it is NaN or None there. The parts are used up."""
    if len(parts) == 1:
        return parts[0]
    lengths = [len(part["trial"]) for part in parts]
    names = list(dict.fromkeys(name for part in parts for name in part))
    return {
        # Each column is copied: the first copy need not outlive the second.
        name: _concatenated([part.pop(name, None) for part in parts], lengths)
        for name in names
    }


def _concatenated(columns: Sequence[Array | None], lengths: Sequence[int]) -> Array:
    kinds = {column.dtype.kind for column in columns if column is not None}
    nothing = np.nan if kinds <= set("fiu") else None
    return np.concatenate(
        [np.full(n, nothing) if column is None else column for column, n in zip(columns, lengths, strict=True)]
    )


def _names_aside(path: Path) -> Iterator[Path]:
    yield path.with_suffix(".damaged")
    for number in itertools.count(2):
        yield path.with_suffix(f".damaged-{number}")


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
