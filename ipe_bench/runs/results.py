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
            if os.path.lexists(folder) and not (
                folder.is_dir() and os.access(folder, os.R_OK | os.X_OK)
            ):
                self.extra_problems.append(f"{folder}: cannot be listed; what is in it is left out")
        listed: set[Path] = set()
        # What is gone before it is read is in a larger file, which may not have been there when
        # these were listed.
        while fresh := [part for part in store.parts(keys) if part.path not in listed]:
            for part in fresh:
                listed.add(part.path)
                with self._naming(part.path), contextlib.suppress(FileNotFoundError):
                    ((footer, table),) = deque(part.groups(), maxlen=1)
                    known = self.stored[part.key].parts if part.key in self.stored else ()
                    if not known and (found := _OF_ZOO.search(canonical_json(footer["identity"]))):
                        self.moved[footer["identity_key"]] = found[0]
                        continue
                    identity = identified(footer["identity"])
                    footer = {**footer, "identity": identity, "identity_key": digest(identity)}
                    self.stored[part.key] = StoredCell(
                        footer, tuple(sorted([*known, part], key=lambda p: p.order))
                    )
                    if (
                        len(table) == part.stop - part.start
                        and self._kept_bytes + table.nbytes <= _MOST_KEPT
                    ):
                        self._kept_bytes += table.nbytes
                        self._kept[part.path] = table
        self.runs += tuple(self._records(store.runs, RUN))
        self.attempts += self._records(store.failed, FAILED)
        if keys is None and not listed and not self.runs:
            self.extra_problems.append(f"{store.directory}: holds no results of ipe-bench")
        if (self.outdated or self.moved) and not self.stored and keys is None:
            self.extra_problems.append(
                f"{store.directory}: was written by an older version of ipe-bench; {_AGAIN}"
            )

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
        lines += [
            f"refused: {run.get('job', run['file'])}: {why}"
            for run in self.runs
            if (why := run.get("refused"))
        ]
        lines += [line for cell in self.cells for line in cell.problems if not cell.refused]
        truths = {cell.scenario_id for cell in self.current if cell.label == TRUTH}
        lines += [
            f"missing: the truth of {describe_names(cell.names)}: no bound is shown"
            for cell in self.current
            if cell.label != TRUTH and cell.scenario_id not in truths
        ]
        return list(dict.fromkeys([*lines, *self.extra_problems]))

    @property
    def stale(self) -> list[str]:
        """A line for what older code computed: left out, and no problem if the present code has
        computed it."""
        lines = [
            f"stale: {name} {moved(name.rpartition('.')[2])}; left out: its results ({count})"
            for name, count in Counter(self.moved.values()).items()
        ]
        for cell in (cell for _, stale in self._rivals.values() for cell in stale):
            versions = ", ".join(
                f"{package} {version}" for package, version in cell.footer["versions"].items()
            )
            made_by = f"({versions}, source {cell.footer['source']}, key {cell.key})"
            what = f"{describe_names(cell.names)}: {cell.trials} trials were computed by other code"
            lines.append(f"stale: {what} {made_by}; left out")
        for folder, count in Counter(path.parents[1] for path in self.outdated).items():
            lines.append(
                f"stale: {folder}: {count} files were written by an older version of ipe-bench;"
                f" left out: {_AGAIN}"
            )
        return lines

    @property
    def expected(self) -> int:
        """Cells that the records of runs announce, and refused jobs that came to none."""
        return len(self._asked_for) + sum(
            not run["cells"] for run in self.runs if run.get("refused")
        )

    @property
    def complete(self) -> int:
        """Expected cells with every trial."""
        return sum(cell.complete for cell in self.cells[: len(self._asked_for)])

    def announces(self, cells: Iterable[ResultKey], trials: int) -> bool:
        """Tells whether the records of runs ask for all this already, and a further one would
        change none."""
        asked = [(cell, self._asked_for.get(cell.identity_key)) for cell in cells]
        return all(
            a and (a.key, a.refused) == (cell.key, "") and a.trials >= trials for cell, a in asked
        )

    @cached_property
    def _asked_for(self) -> dict[str, _Asked]:
        """Requests of runs, by identity: the newest decides on the key, the largest number of
        trials counts."""
        asked: dict[str, _Asked] = {}
        for run in self.runs:
            for cell in (one for one in run["cells"] if one["identity_key"] not in self.moved):
                new = _Asked(cell["key"], run["trials"], cell["names"], run.get("refused", ""))
                # Earlier versions made it of the files of classes, too.
                identity = (self.stored[new.key].footer if new.key in self.stored else cell)[
                    "identity_key"
                ]
                known = asked.get(identity, new)
                trials = max(new.trials, known.trials) if known.key == new.key else new.trials
                asked[identity] = new._replace(trials=trials)
        return asked

    @cached_property
    def _rivals(self) -> dict[str, tuple[StoredCell | None, list[StoredCell]]]:
        """Current and stale cells by identity: the one that the newest run expects, or else the one
        that was written last, if it is stored; and the stale ones."""
        rivals: dict[str, list[StoredCell]] = {}
        for cell in self.stored.values():
            rivals.setdefault(cell.footer["identity_key"], []).append(cell)
        result: dict[str, tuple[StoredCell | None, list[StoredCell]]] = {}
        for identity, cells in rivals.items():
            asked = self._asked_for.get(identity) or max(cells, key=lambda cell: cell.written)
            result[identity] = (
                self.stored.get(asked.key),
                [cell for cell in cells if cell.key != asked.key],
            )
        return result

    @property
    def current(self) -> list[StoredCell]:
        """The stored cells that are not stale."""
        return [cell for cell, _ in self._rivals.values() if cell is not None]

    @cached_property
    def cells(self) -> tuple[CellState, ...]:
        """States of all cells: those that runs asked for in their order, then others that are
        there."""
        others, states = (
            [cell for cell in self.current if cell.footer["identity_key"] not in self._asked_for],
            [],
        )
        unasked = {
            cell.footer["identity_key"]: _Asked(cell.key, 0, cell.names, "") for cell in others
        }
        for identity, (key, trials, names, refused) in (self._asked_for | unasked).items():
            covered, tried = self._covered(key), [f for f in self.attempts if f["key"] == key]
            lost = [f for f in tried if gaps(covered, f["start"], f["stop"])]
            missing = _count(gaps([*covered, *((f["start"], f["stop"]) for f in lost)], 0, trials))
            lacking = _count(gaps(covered, 0, trials))
            done = trials - lacking if trials else self.stored[key].trials
            stale = sum(cell.trials for cell in self._rivals.get(identity, (None, []))[1])
            messages = tuple(dict.fromkeys(f"{f['status']}: {f['message']}" for f in lost))
            counts = trials, done, lacking - missing, missing, stale
            states.append(CellState(names, *counts, messages, key, refused if missing else ""))
        alike = Counter(describe_names(state.names) for state in states)
        return tuple(
            replace(s, tag=f" (#{s.key[:6]})") if alike[describe_names(s.names)] > 1 else s
            for s in states
        )

    def set_aside(self) -> list[str]:
        """Renames what is damaged, so that it is computed again under its own name; returns a line
        for each file."""
        lines = []
        for path, reason in self.damaged.items():
            aside = path.with_name(f"{path.stem}.damaged-{uuid.uuid4().hex[:8]}")
            with contextlib.suppress(
                FileNotFoundError
            ):  # another run may have done so at this moment
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
        if (
            len(cell.parts) == 1
            and (kept := self._kept.get(path := cell.parts[0].path)) is not None
        ):
            there, known = set(kept.column_names), self._arrays[path]
            if there.issuperset(columns or ()):
                for name in (
                    there.difference(known)
                    if names is None
                    else there.intersection(names).difference(known)
                ):
                    known[name] = as_array(kept[name])
                    known[name].flags.writeable = False
                return {name: known[name] for name in names or kept.column_names if name in there}
        tables = self._of_parts(cell, lambda parts: list(self._tables(parts, names, columns or ())))
        if sum(map(len, tables)) < cell.trials and self.damaged.keys().isdisjoint(
            p.path for p in cell.parts
        ):
            self.extra_problems.append(
                f"missing: {describe_names(cell.names)}: trials went away while they were read"
            )
        if not tables:
            return {name: np.empty(0) for name in names or ("trial",)}
        table, loaded = pa.concat_tables(tables, promote_options="default"), {}
        tables.clear()
        for name in [one for one in names or table.column_names if one in table.column_names]:
            loaded[name] = as_array(table[name])
            table = table.drop_columns(
                name
            )  # so that no two copies of all columns are there at once
            pa.default_memory_pool().release_unused()
        return loaded

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
                found = [
                    part
                    for directory in self.directories
                    for part in Store(directory).parts({cell.key})
                ]
                parts = sorted(
                    (part for part in found if part.path not in self.damaged), key=lambda p: p.order
                )

    def _tables(
        self, parts: Sequence[StoredPart], names: Sequence[str] | None, needed: Sequence[str]
    ) -> Iterator[pa.Table]:
        """Yields the rows of one part after another, without the trials that an earlier one had."""
        reached = 0
        for part in parts:
            if part.stop > reached:
                with self._naming(part.path):
                    table = (
                        self._kept[part.path] if part.path in self._kept else part.read(names)[1]
                    )
                    table = table.select(
                        [n for n in table.column_names if names is None or n in names]
                    )
                    there = table.column_names
                    if lacking := [name for name in needed if name not in there]:
                        raise Unusable(f"damaged: has no column {lacking[0]}")
                    yield table.slice(max(0, reached - part.start))
                    reached = part.stop


def _count(ranges: Iterable[tuple[int, int]]) -> int:
    return sum(stop - start for start, stop in ranges)
