"""Which files of an output folder were read and found whole, so that they need not be read again to be counted.

It saves time and is no source of truth: an entry counts only for the very file that was read, unchanged since, and the
index only if it is whole itself. Rows are checked against their digest whenever they are used.
"""

from __future__ import annotations

import contextlib
import json
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ipe_bench.basics.errors import StorageError
from ipe_bench.basics.files import BLANK_SEAL, is_sealed, seal, write_bytes
from ipe_bench.runs.store import SCHEMA

NAME = ".verified.json"
_SETTLED_NS = 2_000_000_000
"""A file may be changed again within one tick of its clock: only what has been at rest so long is remembered."""

Signature = tuple[int, int, int, int]


def signature(path: Path) -> Signature | None:
    """What changes whenever a file does: size, times of modification and of the entry, and number."""
    try:
        found = os.lstat(path)
    except OSError:
        return None
    return found.st_size, found.st_mtime_ns, found.st_ctime_ns, found.st_ino


class Verified:
    """The index of one output folder."""

    def __init__(self, directory: Path) -> None:
        self.path = directory / NAME
        self.directory = directory
        self.changed = False
        self._files: dict[str, list[Any]] = {}
        self._footers: dict[str, Mapping[str, Any]] = {}
        with contextlib.suppress(OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
            content = self.path.read_bytes() if self.path.is_file() and not self.path.is_symlink() else b""
            known: dict[str, Any] = json.loads(content) if is_sealed(content) else {}
            if known.get("schema") == SCHEMA:
                self._files, self._footers = known["files"], known["footers"]

    def knows(self, path: Path) -> bool:
        """Whether the file was found whole and has not changed since."""
        entry = self._files.get(self._name(path))
        return entry is not None and tuple(entry[:4]) == signature(path)

    def footer(self, path: Path, key: str) -> Mapping[str, Any] | None:
        """The footer of a file that was found whole and has not changed since."""
        return self._footers.get(key) if self.knows(path) else None

    def note(self, path: Path, before: Signature | None, footer: Mapping[str, Any] | None = None) -> None:
        """The file was found whole; `before` is its signature from before it was read."""
        if before is None or before[1] > time.time_ns() - _SETTLED_NS or before[2] > time.time_ns() - _SETTLED_NS:
            return
        self._files[self._name(path)] = list(before)
        if footer is not None:
            self._footers[footer["key"]] = footer
        self.changed = True

    def save(self) -> None:
        """Writes what was noted, where that can be done: a folder that is read only is read without an index."""
        if not self.changed:
            return
        self._files = {name: entry for name, entry in self._files.items() if (self.directory / name).exists()}
        keys = {Path(name).name.partition("-")[0] for name in self._files}
        footers = {key: footer for key, footer in self._footers.items() if key in keys}
        known = {"schema": SCHEMA, "files": self._files, "footers": footers, "seal": BLANK_SEAL}
        content = seal(json.dumps(known, separators=(",", ":")).encode())
        with contextlib.suppress(StorageError):
            write_bytes(self.path, content)

    def _name(self, path: Path) -> str:
        return f"{path.parent.name}/{path.name}"
