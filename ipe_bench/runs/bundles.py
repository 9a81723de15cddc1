"""Bundles: results of one or several folders in a plain zip, whose manifest is what `sha256sum
--check` reads.

The same results give the same bytes, so that the digest of the manifest stands for all of them and
can be printed in a paper. A reader gets nothing unless everything is as the manifest says.
"""

from __future__ import annotations

import contextlib
import hashlib
import re
import tempfile
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.files import write_atomically
from ipe_bench.runs.results import Results
from ipe_bench.runs.store import Store

MANIFEST = "SHA256SUMS"
SUFFIX = ".zip"
BUNDLES = "bundles"
"""Folder of unpacked bundles, below a report on them."""
_FILE = re.compile(r"(trials|runs|failed)/[A-Za-z0-9][A-Za-z0-9._-]{0,150}\.(parquet|json)")
_FOLDER = re.compile(
    r"(?!(?i:con|prn|aux|nul|com\d|lpt\d)(\.|$))[A-Za-z0-9]([A-Za-z0-9._=,+-]{0,98}[A-Za-z0-9])?"
)
"""Names that mean the same on every system."""
_PIECE = 1 << 20
"""Bytes that are read at once."""
_MOST_COMPRESSED = 100
"""Bytes that a byte of a bundle may stand for; those of records stand for 10."""


@dataclass(frozen=True)
class Bundle:
    """Names an archive whose files are as its manifest says."""

    path: Path
    digest: str
    """SHA-256 of the manifest, and so of everything in the bundle."""
    files: Mapping[str, str]
    """SHA-256 by name."""

    @property
    def folders(self) -> tuple[str, ...]:
        """The folders that results came from."""
        return tuple(dict.fromkeys(name.partition("/")[0] for name in self.files))


def is_bundle(path: Path | str) -> bool:
    """Returns whether a path is to be read as a bundle and not as a folder of results."""
    return Path(path).is_file()


def write_bundle(directories: Sequence[Path | str], path: Path) -> Bundle:
    """Puts the results of the directories into one archive."""
    contents: dict[str, bytes] = {}
    for directory in map(Path, directories):
        _require_results(directory)
        plain = re.sub(r"[^A-Za-z0-9._=,+-]+", "_", directory.resolve().name)
        name = plain[:100].strip("._=,+-") or "results"
        if any(known.startswith(f"{name}/") for known in contents):
            raise UserError(
                f"{directory}: another folder has the name {name} too; bundle them apart, or"
                " rename one"
            )
        for file, content in _contents(directory).items():
            contents[f"{name}/{file}"] = content
    if not contents:
        raise UserError(
            f"{', '.join(map(str, directories))}: holds no whole results to bundle; run something"
            " first"
        )
    digests = {name: _digest(content) for name, content in sorted(contents.items())}
    manifest = "".join(f"{digest}  {name}\n" for name, digest in digests.items())
    contents[MANIFEST] = manifest.encode()
    if path.exists():
        found = read_bundle(path)
        if found.files != digests:
            raise UserError(
                f"{path}: is there and holds other results; choose another name with output=, or"
                " remove it"
            )
        return found

    def write(temporary: Path) -> None:
        with zipfile.ZipFile(temporary, "w") as archive:
            for name in (MANIFEST, *digests):
                entry = zipfile.ZipInfo(name)  # of 1980: times are no part of what is bundled
                entry.external_attr = 0o644 << 16
                entry.create_system = 3
                archive.writestr(entry, contents[name])

    write_atomically(path, write)
    return read_bundle(path)


def _contents(directory: Path) -> dict[str, bytes]:
    """Reads what is whole below a directory, by name; lists it again if a file was merged into
    another meanwhile."""
    store = Store(directory)
    while True:
        damaged = Results.read([directory]).damaged
        names: dict[str, Path] = {}
        for folder in (store.trials, store.runs, store.failed):
            for file in folder.glob("[!.]*.*"):
                name = f"{folder.name}/{file.name}"
                if _FILE.fullmatch(name) and file not in damaged and file.is_file():
                    names[name] = file
        with contextlib.suppress(FileNotFoundError):
            return {name: file.read_bytes() for name, file in names.items()}


def read_bundle(path: Path) -> Bundle:
    """Reads all files of a bundle; raises UserError unless they are as its manifest says."""
    try:
        with zipfile.ZipFile(path) as archive:
            unpacked = sum(one.file_size for one in archive.infolist())
            if unpacked > _MOST_COMPRESSED * path.stat().st_size:
                raise UserError(
                    f"{path}: would unpack to over {_MOST_COMPRESSED} times its size; the bundle"
                    " is not read"
                )
            there = set(archive.namelist())
            manifest = archive.read(MANIFEST)
            lines = [line.partition("  ") for line in manifest.decode().splitlines()]
            digests = {name: digest for digest, _, name in lines}
            for name in sorted({*digests, *there} - {MANIFEST}):
                folder, _, file = name.partition("/")
                if not (_FOLDER.fullmatch(folder) and _FILE.fullmatch(file)):
                    raise UserError(
                        f"{path}: {name!r} is no name of a result; the bundle is not read"
                    )
                if name not in there or digests.get(name) != _digest_of(archive, name):
                    raise UserError(
                        f"{path}: was damaged or changed: {name} differs from its manifest; get it"
                        " anew"
                    )
    except UserError:
        raise
    except (
        Exception
    ) as error:  # an archive that is cut short, changed, encrypted or none at all raises many kinds
        raise UserError(
            f"{path}: is not a whole bundle of ipe-bench ({error or type(error).__name__})"
        ) from None
    return Bundle(path, _digest(manifest), digests)


@contextlib.contextmanager
def opened(paths: Sequence[Path | str], into: Path | None = None) -> Iterator[list[Path]]:
    """Yields folders of results, with those of every bundle in its place: unpacked below `into`, or
    for as long as this lasts. Refuses a file that is not a whole bundle, and a folder that no run
    ever wrote to."""
    with contextlib.ExitStack() as stack:
        found: list[Path] = []
        for path in map(Path, paths):
            if not is_bundle(path):
                found.append(path)
                continue
            bundle = read_bundle(path)  # nothing is written of one that is not whole
            place = into or Path(
                stack.enter_context(tempfile.TemporaryDirectory(prefix="ipe-bench-"))
            )
            place = place / f"{path.name.removesuffix(SUFFIX)}-{bundle.digest[:8]}"
            with zipfile.ZipFile(path) as archive:
                archive.extractall(place, bundle.files)
            found += [place / folder for folder in bundle.folders]
        for folder in found:
            _require_results(folder)
        yield found


def _require_results(folder: Path) -> None:
    store = Store(folder)
    if not (store.runs.is_dir() or store.trials.is_dir()):
        what = "holds no results of ipe-bench" if folder.exists() else "there is no such folder"
        raise UserError(f"{folder}: {what}; give the output folder of a run")


def _digest_of(archive: zipfile.ZipFile, name: str) -> str:
    """Computes the digest of a file in an archive, in pieces, of no more bytes than the archive's
    list states."""
    digest = hashlib.sha256()
    with archive.open(name) as file:
        piece = file.read(_PIECE)
        while piece:
            digest.update(piece)
            piece = file.read(_PIECE)
    return digest.hexdigest()


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
