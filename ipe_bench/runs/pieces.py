"""One stored file, read as a whole: its bytes against its digest, its content against its name, its values against
what they can be.

Whatever is not so is `Unusable`, with the reason in a line. Which files there are, and what that means, is left to
`runs.results`.
"""

from __future__ import annotations

import functools
import json
import os
import stat
from collections.abc import Collection as Keys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ipe_bench.basics.files import is_sealed
from ipe_bench.basics.linalg import Array
from ipe_bench.runs.columns import as_array
from ipe_bench.runs.rows import Rule, faults, history_rules, trial_rules
from ipe_bench.runs.store import FOOTER, SCHEMA, TRUTH, digest, key_of

_FOOTER_KEYS = frozenset(
    {"key", "identity", "identity_key", "source", "names", "parameters", "linear_bound", "bound", "equation"}
)
_NAMES = frozenset({"measurement", "noise", "prior", "error_scale", "seed", "estimator"})


class Unusable(Exception):
    """A file that does not hold what its name and place promise."""


class Foreign(Unusable):
    """Its name is not one of ours: it is nobody's to set aside."""


class Outdated(Unusable):
    """It is whole, as far as can be told, and in the format of an older version."""


class Gone(Unusable):
    """It is not there any more: what it held may have been merged into a larger file."""


def read_sealed(path: Path) -> bytes:
    """The content of a plain file, of which not one bit has changed since it was written.

    Raises:
        Gone: there is no such file.
        Unusable: it is a link, a folder or a pipe, cannot be read, or has changed.
    """
    try:
        # A pipe would be waited for, and a link may lead anywhere.
        if not stat.S_ISREG(os.lstat(path).st_mode):
            raise Unusable("damaged: is not a plain file")
        content = path.read_bytes()
    except FileNotFoundError:
        raise Gone("damaged: went away while it was read") from None
    except OSError as error:
        raise Unusable(f"damaged: cannot be read ({error.strerror or error})") from None
    sealed = is_sealed(content)
    if sealed is None and _is_old(content):
        raise Outdated("was written by an older version of ipe-bench")
    if sealed is None:
        raise Unusable("damaged or foreign: has no digest of ipe-bench")
    if not sealed:
        raise Unusable("damaged: its content does not match its digest")
    return content


def _is_old(content: bytes) -> bool:
    """Whether it says of itself that it is of the format before digests: what is cut short or changed cannot."""
    record = content.startswith(b"{") and b'"schema"' not in content and b'"identity_key"' in content
    return b'"schema":1,' in content or record


def _read_table(path: Path, columns: Keys[str] | None = None) -> tuple[Mapping[str, Any], pa.Table]:
    """The footer and the rows, which are without metadata, so that tables join; those of the `columns` that are there,
    all where it is None."""
    try:
        with pq.ParquetFile(pa.BufferReader(read_sealed(path))) as file:
            names = None if columns is None else [n for n in file.schema_arrow.names if n in columns]
            table = file.read(columns=names, use_threads=False)
            footer = _checked_footer((file.schema_arrow.metadata or {})[FOOTER])
    except (pa.ArrowException, OSError, KeyError) as error:
        raise Unusable(f"foreign: is not a table of ipe-bench ({type(error).__name__})") from None
    for name, column in zip(table.column_names, table.columns, strict=True):
        if column.null_count:
            raise Unusable(f"damaged: its column {name} has gaps")
    return footer, table.replace_schema_metadata(None)


@functools.lru_cache(maxsize=4096)
def _checked_footer(text: bytes) -> Mapping[str, Any]:
    """The footer of files of one cell, as it stands in each of them."""
    try:
        footer = json.loads(text)
        if footer["schema"] != SCHEMA or not footer.keys() >= _FOOTER_KEYS:
            raise Unusable("foreign: was written by another version of the format")
        _check_names(footer["names"])
        of_parameters = [(str(p["name"]), str(p["unit"]), float(p["size"])) for p in footer["parameters"]]
        whole = len(of_parameters) == len(np.array(footer["linear_bound"], dtype=float))
        whole &= footer["identity_key"] == digest(footer["identity"])
        whole &= footer["key"] == key_of(footer["identity"], footer["source"])
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        whole, footer = False, {}
    if not whole:
        raise Unusable("foreign: its footer contradicts itself")
    return footer


def _check_names(names: Mapping[str, Any]) -> None:
    """Raises one of the errors of reading foreign data where they are not the names of a cell."""
    if not names.keys() >= _NAMES or not isinstance(names["seed"], int) or not isinstance(names["estimator"], str):
        raise TypeError
    if names["error_scale"] is not None:
        float(names["error_scale"])


def _check_rows(
    table: pa.Table, rules: Mapping[str, Rule], start: int | None = None, columns: Keys[str] | None = None
) -> None:
    """Raises Unusable where the rows are not as they must be; of the `columns` alone where only those were read."""
    rows: dict[str, Array] = {name: as_array(table[name]) for name in table.column_names}
    if columns is not None:
        rules = {name: rule for name, rule in rules.items() if name in columns}
    for fault in faults(rows, rules, start):
        raise Unusable(f"damaged: {fault}")


def _parameters(footer: Mapping[str, Any]) -> Sequence[str]:
    return [p["name"] for p in footer["parameters"]]


@dataclass(frozen=True)
class Part:
    """One stored file: trials start to stop of the cell with that key."""

    path: Path
    key: str
    start: int
    stop: int

    @classmethod
    def parse(cls, path: Path) -> Part:
        """The piece that a file name states.

        Raises:
            Foreign: the name is not one of ours.
        """
        parts = path.stem.split("-")
        if len(parts) != 3 or not (parts[1].isdecimal() and parts[2].isdecimal() and int(parts[1]) < int(parts[2])):
            raise Foreign("foreign: its name is not one of ipe-bench")
        return cls(path, parts[0], int(parts[1]), int(parts[2]))

    def read(self, columns: Keys[str] | None = None) -> tuple[Mapping[str, Any], pa.Table]:
        """Its footer and its rows: all bytes are held against the digest, and what is read against its rules.

        Of the `columns`, those that are there are read; all of them where it is None.

        Raises:
            Gone: there is no such file any more.
            Unusable: it is damaged, or not one of ours.
        """
        footer, table = _read_table(self.path, columns)
        if footer["key"] != self.key:
            raise Unusable(f"foreign: its content belongs to {footer['key']}")
        if table.num_rows != self.stop - self.start:
            raise Unusable(f"damaged: has {table.num_rows} of {self.stop - self.start} rows")
        truth = footer["names"]["estimator"] == TRUTH
        _check_rows(table, trial_rules(_parameters(footer), truth=truth), self.start, columns)
        return footer, table


def read_history(path: Path) -> tuple[str, pa.Table]:
    """The key of the cell whose iterates these are, and the iterates.

    Raises:
        Unusable: they are damaged, or not ours.
    """
    footer, table = _read_table(path)
    if footer["key"] != path.stem:
        raise Unusable(f"foreign: its content belongs to {footer['key']}")
    _check_rows(table, history_rules(_parameters(footer)))
    return path.stem, table


def _read_record(path: Path, keys: Sequence[str], numbers: Sequence[str]) -> dict[str, Any]:
    """A JSON record that has these keys, those in `numbers` being whole."""
    try:
        record = json.loads(read_sealed(path))
        whole = record["schema"] == SCHEMA and record.keys() >= {*keys, *numbers}
        whole &= all(int(record[name]) >= 0 for name in numbers)
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        whole, record = False, {}
    if not whole:
        raise Unusable("foreign: is not a record of ipe-bench")
    return record


@dataclass(frozen=True)
class Run:
    """One record of runs/: what was going to be computed."""

    path: Path
    record: Mapping[str, Any]

    @classmethod
    def read(cls, path: Path) -> Run:
        """Raises: Unusable, where it is not such a record."""
        record = _read_record(path, ("run", "cells", "started"), ("trials",))
        try:
            for cell in record["cells"]:
                _ = str(cell["key"]), str(cell["identity_key"]), int(cell.get("trials", 0))
                _check_names(cell["names"])
        except (ValueError, TypeError, KeyError, AttributeError):
            raise Unusable("foreign: is not a record of a run") from None
        if record["run"] != path.stem:
            raise Unusable(f"foreign: is the record of the run {record['run']}")
        return cls(path, record)

    @property
    def started(self) -> str:
        return str(self.record["started"])


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
        record = _read_record(path, ("key", "status", "message"), ("start", "stop"))
        if path.stem != f"{record['key']}-{record['start']}-{record['stop']}":
            raise Unusable("foreign: is the record of other trials")
        return cls(record["key"], record["start"], record["stop"], f"{record['status']}: {record['message']}")
