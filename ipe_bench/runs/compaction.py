"""Many small files of a cell become few larger ones with the same rows, so that a million trials are read quickly.

Nothing can be lost on the way. A larger file is on the disk, read back and equal before those go whose rows it holds;
until they do, readers have every trial once (`runs.results`), and who finds a file gone looks for the one that it went
into. So it may be stopped, or done twice, at any moment, while others read and write in the folder.
"""

from __future__ import annotations

import contextlib
import itertools
import os
from collections.abc import Collection as Keys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from ipe_bench.basics.errors import StorageError
from ipe_bench.basics.files import write_atomically
from ipe_bench.basics.linalg import Array
from ipe_bench.runs.columns import as_array
from ipe_bench.runs.execution.base import Execution
from ipe_bench.runs.pieces import Part, Unusable
from ipe_bench.runs.store import Store, encode

MANY = 64
"""Small files of a cell from which on they are merged."""
TRIALS = 50_000
"""What a merged file holds at most: the trials between two multiples of it, and the rest of a block across the second.
"""


@dataclass(frozen=True)
class Merge:
    """A task: files of one cell without a gap between them, the longer of two that begin alike first."""

    pieces: tuple[Part, ...]

    @property
    def trusted(self) -> bool:
        """It runs no code of others."""
        return True


def merges(store: Store, keys: Keys[str], *, many: int = MANY, trials: int = TRIALS) -> list[Merge]:
    """What can be merged of those of the cells with these keys that have `many` small files."""
    crowded = [
        pieces
        for pieces in _by_key(store, keys).values()
        if sum(piece.stop - piece.start < trials for piece in pieces) >= many
    ]
    return [Merge(tuple(run)) for pieces in crowded for run in _runs(pieces, trials) if len(run) > 1]


def perform(task: Merge) -> Iterator[int]:
    """Merges the files of one task, and yields how many are gone. Runs wherever the execution has it run.

    Files that are damaged, or of which another version of the libraries wrote some, are not merged.

    Raises:
        StorageError: the folder cannot be written to any more; everything that was there is there.
    """
    for group in _alike(task.pieces):
        yield _replace(group)
    pa.default_memory_pool().release_unused()


def compact(
    store: Store, keys: Keys[str], execution: Execution, *, many: int = MANY, trials: int = TRIALS
) -> tuple[int, list[str]]:
    """Merges the small files of these cells; how many are gone, and what stood in the way: then they stay as they are,
    and nothing is lost."""
    tasks, gone, hindrances = merges(store, keys, many=many, trials=trials), 0, []
    try:
        for event in execution.run(perform, tasks) if tasks else ():
            gone += 0 if event.ended else int(event.step)
            if event.failure is not None:
                hindrances.append(event.failure.message)
    except StorageError as error:
        hindrances.append(str(error))
    return gone, hindrances


def _by_key(store: Store, keys: Keys[str]) -> dict[str, list[Part]]:
    found: dict[str, list[Part]] = {}
    for path in sorted(store.trials.glob("[!.]*.parquet")):
        with contextlib.suppress(Unusable):
            piece = Part.parse(path)
            if piece.key in keys:
                found.setdefault(piece.key, []).append(piece)
    return found


def _runs(pieces: Iterable[Part], trials: int) -> Iterator[list[Part]]:
    """Two or more pieces without a gap between them, which begin between the same multiples of `trials`."""
    run: list[Part] = []
    reached = 0
    for piece in sorted(pieces, key=lambda p: (p.start, -p.stop)):
        within = run and piece.stop <= reached
        if run and not within and (piece.start > reached or piece.start // trials != run[0].start // trials):
            yield run
            run, reached = [], 0
        run.append(piece)
        reached = max(reached, piece.stop)
    yield run


@dataclass(frozen=True)
class _Part:
    """What is merged of one piece."""

    piece: Part
    footer: Mapping[str, Any]
    table: pa.Table

    @property
    def kind(self) -> tuple[Any, ...]:
        return self.footer, self.table.schema


def _alike(run: Sequence[Part]) -> Iterator[list[_Part]]:
    """The parts of a run that can be one file: whole ones in succession with the same footer and the same columns."""
    parts: list[_Part | None] = []
    for piece in run:
        try:
            parts.append(_Part(piece, *piece.read()))
        except Unusable:
            parts.append(None)
    for kind, group in itertools.groupby(parts, lambda part: None if part is None else part.kind):
        if kind is not None:
            yield from _without_gaps([part for part in group if part is not None])


def _without_gaps(parts: Sequence[_Part]) -> Iterator[list[_Part]]:
    group: list[_Part] = []
    reached = 0
    for part in parts:
        if group and part.piece.start > reached:
            yield group
            group = []
        group.append(part)
        reached = max(reached, part.piece.stop) if len(group) > 1 else part.piece.stop
    yield group


def _replace(group: Sequence[_Part]) -> int:
    """Writes one file with all rows of the group, unless there is one, and removes the others; returns their number."""
    if len(group) < 2:
        return 0
    first, tables, reached = group[0], [], group[0].piece.start
    for part in group:
        if part.piece.stop > reached:
            tables.append(part.table.slice(reached - part.piece.start))
            reached = part.piece.stop
    merged = Part(_named(first.piece, reached), first.piece.key, first.piece.start, reached)
    columns = _columns(pa.concat_tables(tables))
    if all(part.piece != merged for part in group):
        content = encode(columns, first.footer)
        write_atomically(merged.path, lambda temporary: _write_to_disk(temporary, content))
        _keep_name(merged.path.parent)
    _require_same(merged, first.footer, columns)
    others = [part.piece.path for part in group if part.piece != merged]
    for path in others:
        with contextlib.suppress(OSError):  # another run may have done so; what stays is read once all the same
            path.unlink()
    return len(others)


def _named(piece: Part, stop: int) -> Path:
    return piece.path.with_name(f"{piece.key}-{piece.start}-{stop}.parquet")


def _columns(table: pa.Table) -> dict[str, Array]:
    return {name: as_array(table[name]) for name in table.column_names}


def _require_same(piece: Part, footer: Mapping[str, Any], columns: Mapping[str, Array]) -> None:
    """Raises StorageError unless the disk gives back exactly these rows."""
    try:
        kept, table = piece.read()
    except Unusable as error:
        raise StorageError(f"{piece.path}: {error} just after it was written; nothing was removed for it") from None
    again = _columns(table)
    same = kept == footer and again.keys() == columns.keys()
    if not same or not all(_equal(again[name], values) for name, values in columns.items()):
        raise StorageError(f"{piece.path}: is not what was written; nothing was removed for it")


def _equal(a: Array, b: Array) -> bool:
    return a.dtype == b.dtype and np.array_equal(a, b, equal_nan=a.dtype.kind == "f")


def _write_to_disk(path: Path, content: bytes) -> None:
    """As `write_bytes`, and not in a buffer of the system only: what it stands for is removed afterwards."""
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _keep_name(folder: Path) -> None:
    """Has the disk know the names in a folder, where a system can be asked for it."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
