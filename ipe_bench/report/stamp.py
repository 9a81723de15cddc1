"""Whether the report in a folder is already the one on what is stored, so that it need not be made again.

The stamp is a digest of everything that the report is made from (the bytes of the stored files, the records of runs,
the code and what is installed) and of everything that was written. It is no source of truth: without it, or with
any byte that differs, the report is made again.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ipe_bench.basics.errors import StorageError
from ipe_bench.basics.files import write_text
from ipe_bench.plugins.extensions import digest_of_all
from ipe_bench.report.choice import PAGE, Which
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
_VIEWS = 8
"""Widths of terminals and commands whose tables are kept."""


@dataclass(frozen=True)
class Made:
    """What a report is made from, and the formats of figures that are asked for: one that has more is the same."""

    digest: str
    formats: tuple[str, ...] = (PAGE,)


def made_from(
    directories: Sequence[Path], output: Path, figures: Which = "all", formats: tuple[str, ...] = (PAGE,)
) -> Made:
    """What a report on these directories, with these figures in these formats, is made from.

    Taken before anything is read: what is written meanwhile then makes the next report another one.
    """
    digest = hashlib.sha256(f"{output.absolute()} {figures};".encode())
    package = Path(__file__).parents[1]
    for folder in _CODE:
        for known in _digests(sorted((package / folder).glob("*.*"))).values():
            digest.update(known.encode())
    digest.update(digest_of_all().encode())
    digest.update(f"{sys.version} {_installed()};".encode())
    for directory in directories:
        store = Store(directory)
        digest.update(f"{directory} {directory.absolute()};".encode())
        for folder in (store.trials, store.histories, store.runs, store.failed):
            for path, known in _digests(sorted(folder.glob("*"))).items():
                digest.update(f"{path} {known};".encode())
    return Made(digest.hexdigest(), formats)


def is_current(output: Path, made: Made, problems: Sequence[str]) -> bool:
    """Whether the report under `output` was made from this with these problems, and its files are as written."""
    return _current(output, made, list(problems)) is not None


def is_out_of_date(output: Path, made: Made) -> bool:
    """Whether the report under `output` has to be made, for all that can be known before anything is read."""
    return _current(output, made, None) is None


def shown(output: Path, made: Made, view: str) -> list[str] | None:
    """What was last printed of this report, of which nothing is missing or damaged, in this view of it; None where it
    was not, or where anything of the report has changed."""
    known = _current(output, made, [])
    return None if known is None else known.get("shown", {}).get(view)


def note(output: Path, made: Made, view: str, texts: list[str]) -> None:
    """Keeps what is printed of the report under `output` for `shown`."""
    known = _current(output, made, [])
    if known is not None and known.get("shown", {}).get(view) != texts:
        _write(output, known | {"shown": dict([*known.get("shown", {}).items(), (view, texts)][-_VIEWS:])})


def _current(output: Path, made: Made, problems: list[str] | None) -> dict[str, Any] | None:
    """The stamp, where the report under `output` was made from this with these problems, or whatever problems where
    none are given, and its files are as written."""
    try:
        known: Any = json.loads((output / NAME).read_text(encoding="utf-8"))
        files = {output / name: digest for name, digest in known["files"].items()}
        same = known["from"] == made.digest and set(made.formats) <= set(known["formats"])
        same = same and (problems is None or known["problems"] == problems)
        return known if same and files and _digests(files) == {str(p): d for p, d in files.items()} else None
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def leave(output: Path, made: Made, problems: Sequence[str], files: Iterable[Path]) -> None:
    """States what the report under `output` was made from, and which files belong to it."""
    digests = {str(Path(path).relative_to(output)): digest for path, digest in _digests(files).items()}
    stamp = {"from": made.digest, "formats": list(made.formats), "problems": list(problems), "files": digests}
    _write(output, stamp)


def _write(output: Path, stamp: dict[str, Any]) -> None:
    with contextlib.suppress(StorageError):
        write_text(output / NAME, json.dumps(stamp, indent=1) + "\n")


def _installed() -> list[str]:
    """Every distribution that can be imported, with its version, as its folder is named: also those that plugins
    need."""
    found = set()
    for place in sys.path:
        with contextlib.suppress(OSError):
            found.update(name for name in os.listdir(place or ".") if name.endswith((".dist-info", ".egg-info")))
    return sorted(found)


def _digests(paths: Iterable[Path]) -> dict[str, str]:
    found = {}
    for path in paths:
        # Another command may be merging small files at this moment.
        with contextlib.suppress(FileNotFoundError):
            if path.is_file():
                found[str(path)] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found
