"""Reserves the folder of a command that answers one question, and writes its page, CSV and figures."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from contextlib import nullcontext
from contextvars import ContextVar
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import resources
from itertools import chain, count
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from ipe_bench import __version__
from ipe_bench.basics.errors import UserError
from ipe_bench.basics.files import write_text
from ipe_bench.report.style import PAGE, house_style
from ipe_bench.report.table import Part, Table, environment
from ipe_bench.report.words import CITATION, public

if TYPE_CHECKING:
    import pandas as pd

    from ipe_bench.report.figures.drawing import Drawing

COMMAND: ContextVar[str] = ContextVar("command", default="")
"""The command that is being run, for its page; empty in Python."""


def reserve_output_folder(folder: Path, name: str, command: Any, *, elsewhere: bool, files: Sequence[str] = ()) -> Path:
    """Reserves the folder that a command writes to: a new one, or that of the same command, by `name`.json; with
    `elsewhere` folder-2, folder-3 and so on, if it has `files` of another one.

    Raises:
        UserError: the folder is taken.
        StorageError: it cannot be written to.
    """
    others = (folder.with_name(f"{folder.name}-{k}") for k in count(2)) if elsewhere else ()
    found = next((one for one in chain([folder], others) if _is_free(one, f"{name}.json", command, files)), None)
    if found is None:
        raise UserError(
            f"output={folder}: holds results of another command, which are not overwritten; choose another folder, or"
            " remove it"
        )
    if not (found / f"{name}.json").exists():
        write_text(found / f"{name}.json", json.dumps({"command": command}, indent=1) + "\n")
    return found


def _is_free(folder: Path, result: str, command: Any, files: Sequence[str]) -> bool:
    if not (folder / result).exists():
        return not any((folder / name).exists() for name in files)
    try:
        return json.loads((folder / result).read_text(encoding="utf-8"))["command"] == command
    except (OSError, ValueError, KeyError, TypeError):
        return False


@dataclass(frozen=True)
class Page:
    """Describes the answer to one question, as its page shows it: the first table is open, the rest is folded."""

    title: str
    answer: Sequence[str]
    """At most three sentences."""
    parts: Sequence[Part]
    drawings: Iterable[Drawing] = ()
    """Drawn in the style of the house when they are written."""
    facts: Sequence[str] = ()
    sources: Sequence[tuple[str, str]] = ()
    """Files that were read, each with its SHA-256."""


def rendered(template: str, figures: Iterable[Any], **content: Any) -> str:
    """Renders a page with what every page has: style, script, pictures (name, title, caption, files), citation."""
    from markupsafe import Markup

    templates = resources.files("ipe_bench.report") / "templates"
    files = {name: Markup((templates / f"report.{name}").read_text(encoding="utf-8")) for name in ("css", "js")}
    return (
        environment()
        .get_template(template)
        .render(style=files["css"], script=files["js"], figures=list(figures), citation=CITATION, **content)
    )


def digests(places: Iterable[Path]) -> list[tuple[str, str]]:
    """Returns each file with its SHA-256, and each folder of results with that of the digests of its trials."""
    found = []
    for place in places:
        files = sorted((place / "trials").glob("*")) if place.is_dir() else [place]
        each = [hashlib.sha256(path.read_bytes()).hexdigest() for path in files if path.is_file()]
        found.append((str(place), each[0] if files == [place] else hashlib.sha256("".join(each).encode()).hexdigest()))
    return found


def write_files(folder: Path, name: str, page: Page, table: tuple[str, pd.DataFrame]) -> list[Path]:
    """Writes the files of a command and returns them: the `table` under its name, the page `name`.html and its
    figures."""
    files, figures = [folder / table[0], folder / f"{name}.html"], []
    write_text(files[0], table[1].to_csv(index=False))
    with house_style() if page.drawings else nullcontext():
        for drawing in page.drawings:
            figures.append(SimpleNamespace(**vars(drawing), files=drawing.save(folder, (PAGE,)), html=drawing.html()))
            files += figures[-1].files
    tables = [part for part in page.parts if isinstance(part, Table)][:1]
    rest = [part for part in page.parts if all(part is not one for one in tables)]
    content = {
        "kind": name,
        "title": page.title,
        "facts": [*page.facts, f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC", f"ipe-bench {__version__}"],
        "commands": [public(asked)] if (asked := COMMAND.get()) else [],
        "sources": [(public(file), digest) for file, digest in page.sources],
        "headline": page.answer,
        "box": None,
        "tables": tables,
        "rest": rest,
        "sections": [("details", "Details")] * bool(rest or figures[1:]) + [("cite", "How to cite")],
        "about": (),
        "problems": (),
        "folder": "",
    }
    write_text(files[1], rendered("page.html.j2", figures, **content))
    return files
