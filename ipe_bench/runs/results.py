"""Finds what is stored under output folders: what is there, done, missing, failed, refused, stale
and damaged.

`run` asks it what to compute, `status` and `report` what to show, `load` for the rows, so they
cannot disagree. A file is used, or named with its fault; no file is guessed, mixed or deleted.
"""

from __future__ import annotations

import contextlib
import os
import re
import uuid
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from collections.abc import Collection as Keys
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Self, TypeVar

import numpy as np
import pyarrow as pa

from ipe_bench.basics.errors import ZOO, UserError, moved
from ipe_bench.basics.linalg import Array
from ipe_bench.runs.parts import (
    FAILED,
    RUN,
    TRUTH,
    Outdated,
    StoredPart,
    Unusable,
    as_array,
    join_histories,
    read_record,
)
from ipe_bench.runs.provenance import canonical_json, digest, identified
from ipe_bench.runs.store import ResultKey, Store, describe_names, gaps, title
from ipe_bench.trials.thresholds import HISTORIES

T = TypeVar("T")
_AGAIN = "run the same command again, which computes it anew"
_MOST_KEPT = 1 << 25
"""Bytes of rows that stay in memory from the first reading."""
_OF_ZOO = re.compile(rf"ipe_bench\.(measurements|baselines)\.[\w.]*\.({'|'.join(ZOO.values())})")


@dataclass(frozen=True)
class StoredCell:
    """Describes one scenario (one seed) under one estimator, or its truth, with all its parts from
    all directories."""

    footer: Mapping[str, Any]
    parts: tuple[StoredPart, ...]

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
        """The trials that are there, as ranges that may overlap."""
        return tuple((part.start, part.stop) for part in self.parts)

    @property
    def trials(self) -> int:
        """Number of trials that are there, each counted once."""
        last = max(part.stop for part in self.parts)
        return last - _count(gaps(self.covered, 0, last))

    @property
    def written(self) -> float:
        """Time at which the youngest of its files was written; 0 if they went away meanwhile."""
        times = [0.0]
        for part in self.parts:
            with contextlib.suppress(OSError):
                times.append(part.path.stat().st_mtime)
        return max(times)


@dataclass(frozen=True)
class CellState:
    """Counts the trials of one scenario under one estimator. `done`, `failed` and `missing` add up
    to `expected`."""

    names: Mapping[str, Any]
    """measurement, noise, prior, error_scale, seed, estimator (`truth` for the truth and its
    bounds)."""
    expected: int
    """Trials that were asked for; 0 if no run in the directories asks for this cell."""
    done: int
    failed: int
    missing: int
    stale: int
    """Trials that another version of the source computed; they do not count as done."""
    messages: tuple[str, ...]
    """Why trials failed."""
    key: str
    refused: str = ""
    """Why the run that asked for it was refused, if it was."""
    tag: str = ""
    """The beginning of its key, if other cells have the same names."""

    @property
    def title(self) -> str:
        """Its scenario in a line for people."""
        return title(self.names) + self.tag

    @property
    def complete(self) -> bool:
        return self.failed == 0 and self.missing == 0

    @property
    def problems(self) -> Iterator[str]:
        """A line for what is wrong with it, if anything."""
        who = describe_names(self.names) + self.tag
        for line in self.messages if self.failed else ():
            yield f"failed: {who}: {self.failed} of {self.expected} expected trials: {line}"
        if self.missing:
            why = f" (refused: {self.refused})" if self.refused else ""
            yield f"missing: {who}: {self.done} of {self.expected} expected trials are there{why}"


class _Asked(NamedTuple):
    """Records what the newest run that asked for a cell said of it."""

    key: str
    trials: int
    names: Mapping[str, Any]
    refused: str


class _Rivals(NamedTuple):
    """Holds the cells of one identity."""

    current: StoredCell | None
    """The one that the newest run expects, or else the one that was written last, if it is
    stored."""
    stale: list[StoredCell]


@dataclass
class Results:
    """Holds everything stored under some directories; `Results.read` finds it."""

    directories: tuple[Path, ...]
    runs: tuple[Mapping[str, Any], ...] = ()
    """The records of what was going to be computed, or was `refused`, by ascending start."""
    stored: dict[str, StoredCell] = field(default_factory=dict)
    """The usable cells by key, stale ones included."""
    attempts: list[Mapping[str, Any]] = field(default_factory=list)
    """Records of what could not be computed, whether or not it was since."""
    damaged: dict[Path, str] = field(default_factory=dict)
    """Damage of each file that is left out."""
    outdated: list[Path] = field(default_factory=list)
    """Files in the format of an older version."""
    moved: dict[str, str] = field(default_factory=dict)
    """The class that is called otherwise now, by the identity of each result that is of one."""
    extra_problems: list[str] = field(default_factory=list)
    """Problems that are not one file's: a line for each."""
    _kept: dict[Path, pa.Table] = field(default_factory=dict, repr=False)
    """Rows of the first files, which hundreds of small runs would otherwise read a dozen times
    each."""
    _arrays: dict[Path, dict[str, Array]] = field(
        default_factory=lambda: defaultdict(dict), repr=False
    )
    """Those of their columns that were loaded, which cannot be written into."""
    _kept_bytes: int = 0

    @classmethod
    def read(cls, directories: Sequence[Path | str], keys: Keys[str] | None = None) -> Self:
        """Reads what is stored under the directories, or the trials of the cells with these keys
        alone."""
        results = cls(tuple(map(Path, directories)))
        for path in results.directories:
            if not path.is_dir():
                raise UserError(f"{path}: there is no such directory; give one that a run wrote to")
            results._read_directory(Store(path), keys)
        results.runs = tuple(sorted(results.runs, key=lambda run: (run["started"], run["file"])))
        return results

    def _read_directory(self, store: Store, keys: Keys[str] | None) -> None:
        for folder in (store.trials, store.runs, store.failed):
            listable = folder.is_dir() and os.access(folder, os.R_OK | os.X_OK)
            if os.path.lexists(folder) and not listable:
                self.extra_problems.append(f"{folder}: cannot be listed; what is in it is left out")
        listed: set[Path] = set()
        # What is gone before it is read is in a larger file, which may not have been there when
        # these were listed.
        fresh = store.parts(keys)
        while fresh:
            for part in fresh:
                listed.add(part.path)
                with self._naming(part.path), contextlib.suppress(FileNotFoundError):
                    self._add(part)
            fresh = [part for part in store.parts(keys) if part.path not in listed]
        self.runs += tuple(self._records(store.runs, RUN))
        self.attempts += self._records(store.failed, FAILED)
        if keys is None and not listed and not self.runs:
            self.extra_problems.append(f"{store.directory}: contains no results of ipe-bench")
        if (self.outdated or self.moved) and not self.stored and keys is None:
            self.extra_problems.append(
                f"{store.directory}: was written by an older version of ipe-bench; {_AGAIN}"
            )

    def _add(self, part: StoredPart) -> None:
        """Adds a file to its cell, unless its class is called otherwise now."""
        ((footer, table),) = deque(part.groups(), maxlen=1)
        known = self.stored[part.key].parts if part.key in self.stored else ()
        found = None if known else _OF_ZOO.search(canonical_json(footer["identity"]))
        if found is not None:
            self.moved[footer["identity_key"]] = found[0]
            return
        identity = identified(footer["identity"])
        footer = {**footer, "identity": identity, "identity_key": digest(identity)}
        parts = sorted([*known, part], key=lambda one: one.order)
        self.stored[part.key] = StoredCell(footer, tuple(parts))
        whole = len(table) == part.stop - part.start
        if whole and self._kept_bytes + table.nbytes <= _MOST_KEPT:
            self._kept_bytes += table.nbytes
            self._kept[part.path] = table

    def _records(self, folder: Path, shape: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
        for path in sorted(folder.glob("[!.]*.json")):
            with self._naming(path):
                yield read_record(path, shape)

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
        refused = self._refused
        lines += [f"refused: {run.get('job', run['file'])}: {run['refused']}" for run in refused]
        lines += [line for cell in self.cells for line in cell.problems if not cell.refused]
        truths = {cell.scenario_id for cell in self.current if cell.label == TRUTH}
        for cell in self.current:
            if cell.label != TRUTH and cell.scenario_id not in truths:
                lines.append(
                    f"missing: the truth of {describe_names(cell.names)}: no bound is shown"
                )
        return list(dict.fromkeys([*lines, *self.extra_problems]))

    @property
    def stale(self) -> list[str]:
        """A line for what older code computed: left out, and no problem if the present code has
        computed it."""
        lines = []
        for name, count in Counter(self.moved.values()).items():
            place = moved(name.rpartition(".")[2])
            lines.append(f"stale: {name} {place}; left out: its results ({count})")
        for rivals in self._rivals.values():
            lines += map(_made_by_other_code, rivals.stale)
        for folder, count in Counter(path.parents[1] for path in self.outdated).items():
            lines.append(
                f"stale: {folder}: {count} files were written by an older version of ipe-bench;"
                f" left out: {_AGAIN}"
            )
        return lines

    @property
    def _refused(self) -> list[Any]:
        """The records of runs that were refused."""
        return [run for run in self.runs if run.get("refused")]

    @property
    def expected(self) -> int:
        """Cells that the records of runs announce, and refused jobs that came to none."""
        return len(self._asked_for) + sum(not run["cells"] for run in self._refused)

    @property
    def complete(self) -> int:
        """Expected cells with every trial."""
        return sum(cell.complete for cell in self.cells[: len(self._asked_for)])

    def announces(self, cells: Iterable[ResultKey], trials: int) -> bool:
        """Tells whether the records of runs ask for all this already, and a further one would
        change none."""
        for cell in cells:
            asked = self._asked_for.get(cell.identity_key)
            if asked is None or asked.key != cell.key:
                return False
            if asked.refused != "" or asked.trials < trials:
                return False
        return True

    @cached_property
    def _asked_for(self) -> dict[str, _Asked]:
        """Requests of runs, by identity: the newest decides on the key, the largest number of
        trials counts."""
        asked: dict[str, _Asked] = {}
        for run in self.runs:
            for cell in run["cells"]:
                if cell["identity_key"] in self.moved:
                    continue
                new = _Asked(cell["key"], run["trials"], cell["names"], run.get("refused", ""))
                # Earlier versions made it of the files of classes, too.
                told = self.stored[new.key].footer if new.key in self.stored else cell
                identity = told["identity_key"]
                known = asked.get(identity, new)
                trials = max(new.trials, known.trials) if known.key == new.key else new.trials
                asked[identity] = new._replace(trials=trials)
        return asked

    @cached_property
    def _rivals(self) -> dict[str, _Rivals]:
        """Current and stale cells by identity."""
        alike: dict[str, list[StoredCell]] = {}
        for cell in self.stored.values():
            alike.setdefault(cell.footer["identity_key"], []).append(cell)
        rivals: dict[str, _Rivals] = {}
        for identity, cells in alike.items():
            asked = self._asked_for.get(identity) or max(cells, key=lambda cell: cell.written)
            stale = [cell for cell in cells if cell.key != asked.key]
            rivals[identity] = _Rivals(self.stored.get(asked.key), stale)
        return rivals

    @property
    def current(self) -> list[StoredCell]:
        """The stored cells that are not stale."""
        found = [rivals.current for rivals in self._rivals.values()]
        return [cell for cell in found if cell is not None]

    @cached_property
    def cells(self) -> tuple[CellState, ...]:
        """States of all cells: those that runs asked for in their order, then others that are
        there."""
        all_asked = dict(self._asked_for)
        for cell in self.current:
            asked = _Asked(cell.key, 0, cell.names, "")
            all_asked.setdefault(cell.footer["identity_key"], asked)
        states = [self._state(identity, asked) for identity, asked in all_asked.items()]
        alike = Counter(describe_names(state.names) for state in states)
        for i, state in enumerate(states):
            if alike[describe_names(state.names)] > 1:
                states[i] = replace(state, tag=f" (#{state.key[:6]})")
        return tuple(states)

    def _state(self, identity: str, asked: _Asked) -> CellState:
        covered = self._covered(asked.key)
        tried = [one for one in self.attempts if one["key"] == asked.key]
        lost = [one for one in tried if gaps(covered, one["start"], one["stop"])]
        told_of = [*covered, *((one["start"], one["stop"]) for one in lost)]
        missing = _count(gaps(told_of, 0, asked.trials))
        lacking = _count(gaps(covered, 0, asked.trials))
        rivals = self._rivals.get(identity)
        messages = dict.fromkeys(f"{one['status']}: {one['message']}" for one in lost)
        return CellState(
            names=asked.names,
            expected=asked.trials,
            done=asked.trials - lacking if asked.trials else self.stored[asked.key].trials,
            failed=lacking - missing,
            missing=missing,
            stale=0 if rivals is None else sum(cell.trials for cell in rivals.stale),
            messages=tuple(messages),
            key=asked.key,
            refused=asked.refused if missing else "",
        )

    def set_aside(self) -> list[str]:
        """Renames what is damaged, so that it is computed again under its own name; returns a line
        for each file."""
        lines = []
        damaged = list(self.damaged.items())
        self.damaged.clear()  # what is computed anew has the same name
        for path, reason in damaged:
            aside = path.with_name(f"{path.stem}.damaged-{uuid.uuid4().hex[:8]}")
            # Another run may have done so at this moment.
            with contextlib.suppress(FileNotFoundError):
                path.rename(aside)
                lines.append(f"{path}: {reason}; set aside as {aside.name} and computed again")
        return lines

    def _covered(self, key: str) -> Sequence[tuple[int, int]]:
        return self.stored[key].covered if key in self.stored else ()

    def missing(self, key: str, trials: int) -> list[tuple[int, int]]:
        """Returns the ranges of trials 0 to `trials` that no usable file of the cell with this key
        covers."""
        return gaps(self._covered(key), 0, trials)

    def load(
        self, cell: StoredCell, columns: Sequence[str] | None, optional: Sequence[str] = ()
    ) -> dict[str, Array]:
        """Loads the rows of a cell as arrays, by ascending trial, each trial once; all columns if
        `columns` is None. A part that cannot be used any more, or lacks one of the `columns`, is
        named in `problems`, and left out. What some parts lack of the `optional` columns is NaN or
        None there."""
        names = None if columns is None else list(dict.fromkeys(["trial", *columns, *optional]))
        if len(cell.parts) == 1:
            path = cell.parts[0].path
            kept = self._kept.get(path)
            if kept is not None and set(kept.column_names).issuperset(columns or ()):
                return self._load_kept(path, names)
        tables = self._of_parts(cell, lambda parts: list(self._tables(parts, names, columns or ())))
        lost = sum(map(len, tables)) < cell.trials
        if lost and self.damaged.keys().isdisjoint(part.path for part in cell.parts):
            self.extra_problems.append(
                f"missing: {describe_names(cell.names)}: trials went away while they were read"
            )
        if not tables:
            return {name: np.empty(0) for name in names or ("trial",)}
        table = pa.concat_tables(tables, promote_options="default")
        tables.clear()
        there = table.column_names
        loaded = {}
        for name in [name for name in names or there if name in there]:
            loaded[name] = as_array(table[name])
            # So that no two copies of all columns are there at once.
            table = table.drop_columns(name)
            pa.default_memory_pool().release_unused()
        return loaded

    def _load_kept(self, path: Path, names: Sequence[str] | None) -> dict[str, Array]:
        """Loads rows that are in memory, and converts a column only once."""
        kept = self._kept[path]
        known = self._arrays[path]
        loaded = [name for name in names or kept.column_names if name in kept.column_names]
        for name in loaded:
            if name not in known:
                known[name] = as_array(kept[name])
                known[name].flags.writeable = False
        return {name: known[name] for name in loaded}

    def load_history(self, cell: StoredCell) -> dict[str, Array] | None:
        """Loads the iterates of a cell's first trials, by column; None if none are stored."""
        return self._of_parts(cell, lambda parts: join_histories(self._histories(parts)))

    def _histories(self, parts: Sequence[StoredPart]) -> Iterator[dict[str, Array] | None]:
        for part in (part for part in parts if part.start < HISTORIES):
            with self._naming(part.path):
                yield part.history()

    def _of_parts(self, cell: StoredCell, read: Callable[[Sequence[StoredPart]], T]) -> T:
        """Applies `read` to the parts of a cell; to those that are there now, if some were merged
        meanwhile."""
        parts: Sequence[StoredPart] = cell.parts
        while True:
            try:
                return read(parts)
            except FileNotFoundError:
                found: list[StoredPart] = []
                for directory in self.directories:
                    found += Store(directory).parts({cell.key})
                usable = [part for part in found if part.path not in self.damaged]
                parts = sorted(usable, key=lambda part: part.order)

    def _tables(
        self, parts: Sequence[StoredPart], names: Sequence[str] | None, needed: Sequence[str]
    ) -> Iterator[pa.Table]:
        """Yields the rows of one part after another, without the trials that an earlier one had."""
        reached = 0
        for part in parts:
            if part.stop <= reached:
                continue
            with self._naming(part.path):
                table = self._kept[part.path] if part.path in self._kept else part.read(names)[1]
                there = [name for name in table.column_names if names is None or name in names]
                for name in needed:
                    if name not in there:
                        raise Unusable(f"damaged: has no column {name}")
                yield table.select(there).slice(max(0, reached - part.start))
                reached = part.stop


def _made_by_other_code(cell: StoredCell) -> str:
    versions = [f"{package} {version}" for package, version in cell.footer["versions"].items()]
    made_by = f"({', '.join(versions)}, source {cell.footer['source']}, key {cell.key})"
    what = f"{describe_names(cell.names)}: {cell.trials} trials were computed by other code"
    return f"stale: {what} {made_by}; left out"


def _count(ranges: Iterable[tuple[int, int]]) -> int:
    return sum(stop - start for start, stop in ranges)
