"""Whether the report in a folder is already the one on what is stored, so that it need not be made again.

The stamp is a digest of everything that the report is made from (the bytes of the stored files, the records of runs,
the code and the libraries' versions) and of everything that was written. It is no source of truth: without it, or with
any byte that differs, the report is made again.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Iterable, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from ipe_bench.basics.errors import StorageError
from ipe_bench.basics.files import write_text
from ipe_bench.plugins.extensions import digest_of_all
from ipe_bench.runs.store import Store

NAME = ".report.json"
_CODE = (
    "",
    "report",
    "report/figures",
    "report/templates",
    "statistics",
    "runs",
    "trials",
    "plugins",
    "measurements/nist",
)
"""Folders of the package that a report comes from; read as files, since to import them would take longer."""
_LIBRARIES = ("matplotlib", "seaborn", "pandas", "numpy", "scipy", "jinja2", "pyarrow")


def made_from(directories: Sequence[Path], output: Path) -> str:
    """A digest of what a report on these directories is made from.

    Taken before anything is read: what is written meanwhile then makes the next report another one.
    """
    digest = hashlib.sha256(f"{output.absolute()};".encode())
    package = Path(__file__).parents[1]
    for folder in _CODE:
        for known in _digests(sorted((package / folder).glob("*.*"))).values():
            digest.update(known.encode())
    digest.update(digest_of_all().encode())
    for library in _LIBRARIES:
        digest.update(f"{library} {metadata.version(library)};".encode())
    for directory in directories:
        store = Store(directory)
        digest.update(f"{directory} {directory.absolute()};".encode())
        for folder in (store.trials, store.histories, store.runs, store.failed):
            for path, known in _digests(sorted(folder.glob("*"))).items():
                digest.update(f"{path} {known};".encode())
    return digest.hexdigest()


def is_current(output: Path, made: str, problems: Sequence[str]) -> bool:
    """Whether the report under `output` was made from this with these problems, and its files are as written."""
    try:
        known: Any = json.loads((output / NAME).read_text(encoding="utf-8"))
        files = {output / name: digest for name, digest in known["files"].items()}
        same = known["from"] == made and known["problems"] == list(problems)
        return same and bool(files) and _digests(files) == {str(p): d for p, d in files.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return False


def leave(output: Path, made: str, problems: Sequence[str], files: Iterable[Path]) -> None:
    """States what the report under `output` was made from, and which files belong to it."""
    digests = {str(Path(path).relative_to(output)): digest for path, digest in _digests(files).items()}
    with contextlib.suppress(StorageError):
        write_text(
            output / NAME, json.dumps({"from": made, "problems": list(problems), "files": digests}, indent=1) + "\n"
        )


def _digests(paths: Iterable[Path]) -> dict[str, str]:
    return {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in paths if path.is_file()}
