"""Stored files that prove what they are: Parquet parts with the rows of trials, and JSON records.

Parquet's own CRC-32 covers the pages and nothing else; a SHA-256 digest covers the footer, which
says where the pages are, what they belong to and by what they were made. It stands between the
pages and the footer, where every reader of Parquet passes over it. `runs.results` finds out which
files there are.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import os
import re
from collections.abc import Collection as Keys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ipe_bench.basics.files import regular, write_atomically, write_text
from ipe_bench.basics.linalg import Array
from ipe_bench.runs.provenance import canonical_json

SCHEMA = 4
FOOTER = b"ipe_bench"
HISTORY = b"history"
TRUTH = "truth"
"""Label of the files that hold the truth and its bounds, in place of an estimator's."""
_TAIL = 8
"""Bytes at the end of a Parquet file: the length of the footer, and a mark."""
_DIGEST = 32
GROUP = 1 << 16
"""Rows, at most, that are written and read at once."""
_NAME = re.compile(r"([0-9a-f]+)-(\d+)-(\d+)\.parquet")
_OLDER = tuple(f'"schema":{number},'.encode() for number in range(1, SCHEMA))


_NUMBER = (int, float)
_NAMES = {
    "measurement": str,
    "noise": str,
    "prior": str,
    "error_scale": _NUMBER,
    "seed": int,
    "estimator": str,
}
RUN = {"started": str, "trials": int, "cells": [{"key": str, "identity_key": str, "names": _NAMES}]}
FAILED = {"key": str, "start": int, "stop": int, "status": str, "message": str}
_FOOTER = {
    "key": str,
    "identity_key": str,
    "names": _NAMES,
    "versions": dict,
    "source": str,
    "bound": str,
}
_FOOTER |= {"identity": {"scenario": dict, "estimator": (dict, type(None))}, "linear_bound": list}
_FOOTER |= {"parameters": [{"name": str, "unit": str, "size": _NUMBER}]}
"""What readers take for granted: keys, and the types of their values."""


class Unusable(Exception):
    """A file that does not hold what its name and place promise, with the reason in a line."""


class Outdated(Unusable):
    """Marks a file that an older version wrote."""


@dataclass(frozen=True)
class StoredPart:
    """Describes a stored file with the rows of trials start to stop of one result."""

    path: Path
    key: str
    start: int
    stop: int

    @classmethod
    def parse(cls, path: Path) -> StoredPart | None:
        """Parses the part that a file name states; None if it states none."""
        match = _NAME.fullmatch(path.name)
        if match is None:
            return None
        return cls(path, match[1], int(match[2]), int(match[3]))

    @property
    def order(self) -> tuple[int, int, str]:
        """The order of reading: of two that begin with the same trial, the longer one first."""
        return self.start, -self.stop, str(self.path)

    def read(self, columns: Keys[str] | None = None) -> tuple[Mapping[str, Any], pa.Table]:
        """Reads what the rows belong to, and the rows, without metadata: all columns, or those of
        `columns` that are there. Raises FileNotFoundError if there is no such file any more, and
        Unusable if it is damaged, or not one of ours.
        """
        footers, tables = zip(*self.groups(columns), strict=True)
        return footers[0], pa.concat_tables(tables)

    def groups(
        self, columns: Keys[str] | None = None
    ) -> Iterator[tuple[Mapping[str, Any], pa.Table]]:
        """Reads the same, at most `GROUP` rows at a time: those of a million trials take
        gigabytes."""
        with _opened(self.path) as file:
            footer = self._footer(file)
            names = file.schema_arrow.names
            if columns is not None:
                names = [name for name in names if name in {"trial", *columns}]
            reached = self.start
            for group in range(file.num_row_groups):
                table = file.read_row_group(group, names, use_threads=False)
                counted = np.arange(reached, reached + len(table))
                reached += len(table)
                if not np.array_equal(as_array(table["trial"]), counted):
                    raise self._miscounted
                yield footer, table.replace_schema_metadata(None)
            if reached != self.stop or not file.num_row_groups:
                raise self._miscounted

    def head(self) -> tuple[Mapping[str, Any], pa.Schema]:
        """Reads what the rows belong to, and the types of their columns; raises what `read`
        does."""
        with _opened(self.path) as file:
            return self._footer(file), file.schema_arrow.remove_metadata()

    @property
    def _miscounted(self) -> Unusable:
        return Unusable(
            f"damaged: its column trial does not count from {self.start} to {self.stop}"
        )

    def _footer(self, file: pq.ParquetFile) -> Mapping[str, Any]:
        footer = _parsed(file.metadata.metadata[FOOTER])
        if footer["key"] != self.key:
            raise Unusable(f"damaged: its content belongs to {footer['key']}")
        return footer

    def history(self) -> dict[str, Array] | None:
        """Reads the iterates of its first trials, by column; None if there are none. Raises what
        `read` does."""
        with _opened(self.path) as file:
            text = file.metadata.metadata.get(HISTORY)
        if text is None:
            return None
        return {name: np.array(x, dtype=float) for name, x in json.loads(text).items()}


def join_histories(several: Iterable[Mapping[str, Array] | None]) -> dict[str, Array] | None:
    """Joins the iterates that parts have in the order of reading, by column, each trial once; None
    if none has any."""
    found: dict[str, Array] = {}
    for one in several:
        if one is None:
            continue
        new = ~np.isin(one["trial"], found.get("trial", ()))
        found = {name: np.append(found.get(name, ()), x[new]) for name, x in one.items()}
    return found or None


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[pq.ParquetFile]:
    """Opens a file whose footer matches its digest; its pages will be checked against their
    checksums."""
    try:
        with pa.OSFile(str(regular(path))) as source:
            _require_footer(source)
            with pq.ParquetFile(source, page_checksum_verification=True) as file:
                yield file
    except FileNotFoundError:
        raise
    except (pa.ArrowException, OSError, KeyError, ValueError) as error:
        raise _unreadable(error) from None


def _unreadable(error: Exception) -> Unusable:
    reason = getattr(error, "strerror", None) or type(error).__name__
    return Unusable(f"damaged: cannot be read ({reason})")


def _require_footer(source: pa.NativeFile) -> None:
    """Raises Unusable unless the footer of a Parquet file is the one that was written."""
    size = source.size()
    source.seek(max(0, size - _TAIL))
    tail = source.read(_TAIL)
    length = int.from_bytes(tail[:4], "little") + _TAIL
    if tail[4:] != b"PAR1" or length > size:
        raise Unusable("damaged: is cut short, or no table")
    source.seek(max(0, size - length - _DIGEST))
    digest = source.read(min(_DIGEST, size - length))
    footer = source.read(length)
    if any(schema in footer for schema in _OLDER):
        raise Outdated
    if hashlib.sha256(footer).digest() != digest:
        raise Unusable("damaged: its footer does not match its digest")


@functools.lru_cache(maxsize=4096)
def _parsed(footer: bytes) -> Mapping[str, Any]:
    """Parses the footer that all files of one result share."""
    return _shaped(json.loads(footer), _FOOTER)


def write(
    path: Path,
    table: pa.Table,
    footer: Mapping[str, Any],
    history: Mapping[str, Array] | None = None,
    *,
    lasting: bool = False,
) -> None:
    """Writes the rows of one table as `write_groups` does."""
    write_groups(path, table.schema, [table], footer, history, lasting=lasting)


def write_groups(
    path: Path,
    schema: pa.Schema,
    tables: Iterable[pa.Table],
    footer: Mapping[str, Any],
    history: Mapping[str, Array] | None = None,
    *,
    lasting: bool = False,
) -> None:
    """Writes the rows of tables in succession to a file that appears complete or not at all (see
    `write_atomically`); if `lasting`, past the system's buffer."""
    # Texts are few different ones, numbers are all different and alike in their first bytes.
    texts = [field.name for field in schema if pa.types.is_string(field.type)]
    floats = [field.name for field in schema if pa.types.is_floating(field.type)]
    how: dict[str, Any] = {
        "compression": "lz4",
        "use_dictionary": texts,
        "use_byte_stream_split": floats,
    }
    how |= {"write_page_checksum": True, "write_statistics": False, "store_schema": False}
    metadata = {FOOTER: canonical_json(footer)}
    if history is not None:
        iterates = {name: values.tolist() for name, values in history.items()}
        metadata[HISTORY] = canonical_json(iterates)

    def written(temporary: Path) -> None:
        with temporary.open("w+b") as file:
            with pq.ParquetWriter(file, schema, **how) as writer:
                for table in _grouped(tables):
                    writer.write_table(table, GROUP)
                writer.add_key_value_metadata(metadata)
            file.seek(-_TAIL, os.SEEK_END)
            length = int.from_bytes(file.read(4), "little")
            start = file.seek(-length - _TAIL, os.SEEK_END)
            end = file.read()
            file.seek(start)
            file.write(hashlib.sha256(end).digest() + end)
            file.flush()
            if lasting:
                os.fsync(file.fileno())

    write_atomically(path, written)


def _grouped(tables: Iterable[pa.Table]) -> Iterator[pa.Table]:
    """Joins tables in succession, that have the columns of one schema, to larger ones of at most
    `GROUP` rows."""
    waiting: list[pa.Table] = []
    for table in tables:
        if waiting and sum(map(len, waiting)) + len(table) > GROUP:
            yield pa.concat_tables(waiting)
            waiting = []
        waiting.append(table)
    if waiting:
        yield pa.concat_tables(waiting)


def table_of(columns: Mapping[str, Array]) -> pa.Table:
    """Converts columns to Arrow's types: numbers, flags or texts."""
    arrays = [_arrow(np.ascontiguousarray(values)) for values in columns.values()]
    return pa.Table.from_arrays(arrays, list(columns))


def _arrow(values: Array) -> pa.Array:
    """Converts a column to Arrow. `pa.array` would import pandas, a second that a worker can do
    without."""
    if values.dtype == object:
        texts = [str(value).encode() for value in values]
        ends = np.cumsum([0, *(len(text) for text in texts)], dtype=np.int32)
        buffers = [None, pa.py_buffer(ends.tobytes()), pa.py_buffer(b"".join(texts))]
        return pa.Array.from_buffers(pa.string(), len(values), buffers)
    kind = pa.from_numpy_dtype(values.dtype)
    data = values
    if values.dtype == bool:
        data = np.packbits(values, bitorder="little")
    return pa.Array.from_buffers(kind, len(values), [None, pa.py_buffer(data.tobytes())])


def as_array(column: pa.ChunkedArray) -> Array:
    """Converts a column to an array. Arrow's own `to_numpy` would import pandas as well."""
    if pa.types.is_string(column.type):
        # A million words are few different ones, each kept once.
        coded = column.combine_chunks().dictionary_encode(null_encoding="encode")
        words = np.array(coded.dictionary.to_pylist(), dtype=object)
        return words[np.asarray(np.from_dlpack(coded.indices), int)]
    if column.null_count or pa.types.is_null(column.type):
        return column.to_numpy()
    if pa.types.is_boolean(column.type):
        return as_array(column.cast(pa.uint8())).astype(bool)
    nothing = np.empty(0, str(column.type))
    return np.concatenate([nothing, *map(np.from_dlpack, column.chunks)])


def write_record(path: Path, record: Mapping[str, Any]) -> None:
    """Writes a JSON record with a digest of all that it says; see `write`."""
    said = json.loads(json.dumps({"schema": SCHEMA, "file": path.stem, **record}, default=str))
    write_text(path, json.dumps({**said, "digest": _digest(said)}, indent=1))


def read_record(path: Path, shape: Any) -> dict[str, Any]:
    """Reads a JSON record of this shape that says what was written; raises Unusable if it is
    damaged or foreign."""
    try:
        record = json.loads(regular(path).read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise _unreadable(error) from None
    if not isinstance(record, dict):
        raise Unusable("damaged: is no record of ipe-bench")
    if record.get("schema") in range(1, SCHEMA):
        raise Outdated
    if record.pop("digest", None) != _digest(record) or record.get("file") != path.stem:
        raise Unusable("damaged: is not a whole record of ipe-bench, or belongs to another file")
    return _shaped(record, shape)


def _shaped(value: Any, shape: Any) -> Any:
    """Returns the value, if it has what a shape asks for; raises Unusable otherwise."""
    if not _fits(value, shape):
        raise Unusable("damaged: lacks what ipe-bench writes")
    return value


def _fits(value: Any, shape: Any) -> bool:
    """Tells whether a value is of a type, a list of such values, or a mapping with such values
    under the same keys."""
    if isinstance(shape, dict):
        there = isinstance(value, dict) and shape.keys() <= value.keys()
        return there and all(_fits(value[key], inner) for key, inner in shape.items())
    if isinstance(shape, list):
        return isinstance(value, list) and all(_fits(one, shape[0]) for one in value)
    return isinstance(value, shape)


def _digest(record: Mapping[str, Any]) -> str:
    return hashlib.sha256(canonical_json(record).encode()).hexdigest()
