"""Whether the report in a folder is already the one on what is stored, by digests of its sources and its files."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Iterable, Sequence
from importlib.metadata import version
from pathlib import Path

from ipe_bench.basics.errors import StorageError
from ipe_bench.basics.files import write_text
from ipe_bench.plugins.extensions import digest_of_all
from ipe_bench.runs.store import Store

NAME = ".report.json"


def made_from(directories: Sequence[Path], output: Path, *choices: object) -> str:
    """A digest of what a report on these directories with these choices is made from.

    It is taken before anything is read, so that results written meanwhile make the next report another one.
    """
    sources = [p for p in Path(__file__).parents[1].rglob("*") if p.suffix in {".py", ".j2", ".css", ".js"}]
    stores = [Store(directory) for directory in directories]
    stored = [p for s in stores for folder in (s.trials, s.runs, s.failed) for p in folder.glob("*")]
    libraries = [version(name) for name in ("jinja2", "matplotlib", "numpy", "pandas", "scipy", "seaborn")]
    names = [str(path.absolute()) for path in (output, *directories)]
    known = [names, choices, libraries, digest_of_all(), _digests(sources), _digests(stored)]
    return hashlib.sha256(repr(known).encode()).hexdigest()


def is_current(output: Path, made: str) -> bool:
    """Whether the report under `output` was made from this, and its files are as written."""
    with contextlib.suppress(OSError, ValueError):
        known = json.loads((output / NAME).read_text(encoding="utf-8"))
        return known == {"from": made, "files": _digests(map(Path, known["files"]))}
    return False


def leave(output: Path, made: str, files: Iterable[Path]) -> None:
    """States what the report under `output` was made from, and which files belong to it."""
    with contextlib.suppress(StorageError):
        write_text(output / NAME, json.dumps({"from": made, "files": _digests(files)}, indent=1) + "\n")


def _digests(paths: Iterable[Path]) -> dict[str, str]:
    """By absolute path; a file that another command removes at this moment is left out."""
    found = {}
    for path in sorted(paths):
        with contextlib.suppress(FileNotFoundError):
            found[str(path.absolute())] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found
