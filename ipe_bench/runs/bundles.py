"""Bundles: results of one or several folders in one archive, with a manifest that has a digest of every file.

A bundle holds what was computed and what was asked for, not what a report makes of it. The same results give the same
bytes, so that the digest of the manifest stands for all of them and can be printed in a paper. A reader gets nothing
unless everything is as the manifest says.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
import tempfile
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ipe_bench import __version__
from ipe_bench.basics.errors import UserError
from ipe_bench.basics.files import BLANK_SEAL, is_sealed, seal, write_atomically, write_bytes
from ipe_bench.runs.results import Results, require_results
from ipe_bench.runs.store import Store

SCHEMA = 1
MANIFEST = "manifest.json"
SUFFIX = ".zip"
BUNDLES = "bundles"
"""Where bundles are unpacked below a report on them."""
_EPOCH = (1980, 1, 1, 0, 0, 0)
"""The time of every entry, since times are no part of what is bundled."""
_NAME = re.compile(r"[^/\\\x00-\x1f]{1,200}/(trials|histories|runs|failed)/[A-Za-z0-9][A-Za-z0-9._-]*")
_BROKEN = (zipfile.BadZipFile, zlib.error, OSError, EOFError, RuntimeError, NotImplementedError, KeyError, ValueError)
"""What reading an archive may raise that is cut short, changed, encrypted or none at all."""


@dataclass(frozen=True)
class Bundle:
    """An archive whose files are as its manifest says."""

    path: Path
    digest: str
    """Of the manifest, and so of everything in the bundle."""
    folders: tuple[str, ...]
    files: Mapping[str, str]
    """SHA-256 by name."""

    @property
    def size(self) -> int:
        return self.path.stat().st_size


def is_bundle(path: Path | str) -> bool:
    """Whether a path is to be read as a bundle and not as a folder of results."""
    return Path(path).is_file()


def write_bundle(directories: Sequence[Path | str], path: Path, further: Mapping[str, Any] | None = None) -> Bundle:
    """Puts the results of the directories into one archive, with `further` facts in its manifest.

    Raises:
        UserError: a directory holds no results, two have one name, nothing is whole, or the archive is there and
            holds something else.
    """
    folders = _folders(directories)
    contents = {f"{name}/{file.parent.name}/{file.name}": file for name, d in folders.items() for file in _files(d)}
    if not contents:
        raise UserError(f"{', '.join(map(str, directories))}: holds no whole results to bundle; run something first")
    digests = {name: _digest(contents[name].read_bytes()) for name in sorted(contents)}
    facts = {"bundle": "ipe-bench", "schema": SCHEMA, "version": __version__, "folders": list(folders)}
    record = {**facts, **(further or {}), "files": digests, "seal": BLANK_SEAL}
    manifest = seal(json.dumps(record, indent=1, ensure_ascii=False).encode())
    if path.exists():
        found = read_bundle(path)
        if found.digest != _digest(manifest):
            raise UserError(f"{path}: is there and holds other results; choose another name with output=, or remove it")
        return found

    def write(temporary: Path) -> None:
        with zipfile.ZipFile(temporary, "w") as archive:
            _add(archive, MANIFEST, manifest)
            for name in digests:
                _add(archive, name, contents[name].read_bytes())

    write_atomically(path, write)
    return read_bundle(path)


def _folders(directories: Sequence[Path | str]) -> dict[str, Path]:
    """The directories by the names that they have in the bundle."""
    require_results(directories)
    found: dict[str, Path] = {}
    for directory in map(Path, directories):
        name = directory.resolve().name
        if name in found:
            raise UserError(f"{directory}: another folder has the name {name} too; bundle them apart, or rename one")
        found[name] = directory
    return found


def _files(directory: Path) -> Iterator[Path]:
    """What is whole, in order."""
    results, store = Results.read([directory]), Store(directory)
    for folder in (store.trials, store.histories, store.runs, store.failed):
        for file in sorted(folder.glob("*")):
            if file.suffix in (".parquet", ".json") and not file.name.startswith(".") and file not in results.damaged:
                yield file


def _add(archive: zipfile.ZipFile, name: str, content: bytes) -> None:
    entry = zipfile.ZipInfo(name, _EPOCH)
    entry.external_attr = 0o644 << 16
    entry.create_system = 3
    # Tables are compressed already.
    entry.compress_type = zipfile.ZIP_STORED if name.endswith(".parquet") else zipfile.ZIP_DEFLATED
    archive.writestr(entry, content)


def read_bundle(path: Path) -> Bundle:
    """The bundle, all of whose files were read and are as its manifest says.

    Raises:
        UserError: it is none, or was damaged or changed.
    """
    return _read(path, None)


def _read(path: Path, into: Path | None) -> Bundle:
    """Checks every file of a bundle, and writes it below `into`. What lies there already and is the same stays."""
    try:
        with zipfile.ZipFile(path) as archive:
            manifest = archive.read(MANIFEST)
            record = _checked(path, manifest, archive.namelist())
            for name, digest in record["files"].items():
                content = archive.read(name)
                if _digest(content) != digest:
                    raise UserError(
                        f"{path}: was damaged or changed: {name} is not what the manifest says; get it anew"
                    )
                if into is not None:
                    _write(into / name, content)
    except _BROKEN as error:
        raise UserError(f"{path}: is not a whole bundle of ipe-bench ({error or type(error).__name__})") from None
    return Bundle(path, _digest(manifest), tuple(record["folders"]), record["files"])


def _checked(path: Path, manifest: bytes, names: Sequence[str]) -> dict[str, Any]:
    """The manifest, where it is whole and lists exactly what is in the archive."""
    if not is_sealed(manifest):
        raise UserError(f"{path}: was damaged or changed: the manifest does not match its own digest; get it anew")
    record: Any = json.loads(manifest)
    if not isinstance(record, dict) or record.get("bundle") != "ipe-bench" or record.get("schema") != SCHEMA:
        raise UserError(f"{path}: is a bundle of another version of ipe-bench; read it with that one")
    if sorted(names) != sorted([MANIFEST, *record["files"]]):
        odd = sorted({*names} ^ {MANIFEST, *record["files"]}) or ["a name that stands there twice"]
        raise UserError(f"{path}: was damaged or changed: {odd[0]} is not in both manifest and archive; get it anew")
    for name in record["files"]:
        folder = name.partition("/")[0]
        if not _NAME.fullmatch(name) or folder not in record["folders"] or folder in (".", ".."):
            raise UserError(f"{path}: {name!r} is no name of a result; nothing of it is read")
    return record


def _write(path: Path, content: bytes) -> None:
    if not path.is_file() or path.read_bytes() != content:
        write_bytes(path, content)


@contextlib.contextmanager
def opened(paths: Sequence[Path | str], into: Path | None = None) -> Iterator[list[Path]]:
    """The paths, with the folders of every bundle among them in its place: below `into`, or for as long as this lasts.

    Raises:
        UserError: one is a file and not a whole bundle.
    """
    with contextlib.ExitStack() as stack:
        found: list[Path] = []
        for path in map(Path, paths):
            if not is_bundle(path):
                found.append(path)
                continue
            bundle = read_bundle(path)  # nothing is written of one that is not whole
            place = into or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="ipe-bench-")))
            place = place / f"{path.name.removesuffix(SUFFIX)}-{bundle.digest[:8]}"
            _read(path, place)
            found += [place / folder for folder in bundle.folders]
        yield found


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
