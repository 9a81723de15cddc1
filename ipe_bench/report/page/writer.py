"""Reserves the folder of a command that answers one question, and writes its page, CSV and
figures."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ipe_bench import __version__
from ipe_bench.basics.errors import UserError
from ipe_bench.basics.files import regular, write_json, write_text
from ipe_bench.report.formats import PAGE
from ipe_bench.report.style import house_style
from ipe_bench.report.tables.table import Part, Table, csv_text, environment
from ipe_bench.report.words import CITATION, public

if TYPE_CHECKING:
    import pandas as pd

    from ipe_bench.report.figures.drawing import Drawing

MOST_FACTS = 4
"""Facts that a page shows at once."""
COMMAND: ContextVar[str] = ContextVar("command", default="")
"""The command that is being run, for its page; empty in Python."""


@contextmanager
def reserved_folder(
    folder: Path, name: str, command: Any, *, elsewhere: bool, files: Sequence[str] = ()
) -> Iterator[Path]:
    """Reserves the folder that a command writes to, by `name`.json: a new one, or one of the same
    command; a command that fails gives a new one back.

    With `elsewhere` it is folder-2, folder-3 and so on, if the folder has `files` of another one.

    Raises:
        UserError: the folder is taken.
        StorageError: it cannot be written to.
    """
    result = f"{name}.json"
    place = folder
    number = 1
    while not _is_free(place, result, command, files):
        if not elsewhere:
            raise UserError(
                f"output={folder}: contains results of another command; it is not overwritten;"
                " choose another folder, or remove it"
            )
        number += 1
        place = folder.with_name(f"{folder.name}-{number}")
    is_new = not (place / result).exists()
    if is_new:
        write_json(place / result, {"command": command})
    try:
        yield place
    except BaseException:
        if is_new:
            (place / result).unlink(missing_ok=True)
            # Other files may be there.
            with suppress(OSError):
                place.rmdir()
        raise


def _is_free(folder: Path, result: str, command: Any, files: Sequence[str]) -> bool:
    if not (folder / result).exists():
        return not any((folder / name).exists() for name in files)
    try:
        stored = json.loads(regular(folder / result).read_text(encoding="utf-8"))
        return stored["command"] == command
    except (OSError, ValueError, KeyError, TypeError):
        return False


def write_result(
    folder: Path, name: str, schema: int, command: Any, content: Mapping[str, Any]
) -> Path:
    """Writes `name`.json with its schema and the command, and returns its path."""
    path = folder / f"{name}.json"
    write_json(path, {"schema": schema, "command": command, **content})
    return path


@dataclass(frozen=True)
class Page:
    """Holds what a page shows: the answer, a figure and a table are seen at once, and the sections
    are folded."""

    kind: str
    title: str
    answer: Sequence[Part]
    shown: Sequence[Any]
    sections: Sequence[tuple[str, str, Sequence[Any]]]
    """Place, title and parts: sentences, tables, figures or pieces of HTML; one without parts is
    left out."""
    commands: Sequence[str]
    sources: Sequence[tuple[str, str]]
    """What was read, each with its SHA-256."""
    facts: Sequence[str]
    lead: str = ""
    """What a number of the answer is, in a line below the title."""
    about: Sequence[str] = ()
    problems: Sequence[str] = ()
    folder: str = ""
    """Where the figures' files are, seen from the page."""
    drawn: Sequence[Path] = ()
    """Files of the matrix, which the page itself shows as a table."""
    made: Sequence[str] = ()
    """When it was made, and from how much."""

    def html(self) -> str:
        """Renders it, with the style, the script and the citation of every page."""
        from markupsafe import Markup

        templates = resources.files("ipe_bench.report.page") / "templates"

        def read(name: str) -> Markup:
            return Markup((templates / name).read_text(encoding="utf-8"))

        constant = {
            "style": read("report.css"),
            "script": read("report.js"),
            "citation": CITATION,
            "version": __version__,
            "public": public,
        }
        return environment().get_template("page.html.j2").render(**vars(self), **constant)


def digests(places: Iterable[Path]) -> list[tuple[str, str]]:
    """Returns each file with its SHA-256, and each folder of results with that of the digests of
    its trials."""
    found = []
    for place in places:
        if place.is_dir():
            files = [path for path in sorted((place / "trials").glob("*")) if path.is_file()]
            content = "".join(_digest(path.read_bytes()) for path in files).encode()
        else:
            content = place.read_bytes()
        found.append((str(place), _digest(content)))
    return found


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def write_files(
    folder: Path,
    name: str,
    table: tuple[str, pd.DataFrame],
    title: str,
    answer: Sequence[str],
    parts: Iterable[Part],
    drawings: Iterable[Drawing] = (),
    *,
    lead: str = "",
    facts: Sequence[str] = (),
    sources: Sequence[tuple[str, str]] = (),
) -> list[Path]:
    """Writes the files of a command and returns them: the `table` under its name, the page
    `name`.html with a few sentences, the first figure and the first of its tables seen at
    once, and its figures."""
    files = [folder / table[0], folder / f"{name}.html"]
    write_text(files[0], csv_text(table[1]))
    with house_style() if drawings else nullcontext():
        figures = [drawing.drawn(folder, (PAGE,)) for drawing in drawings]
    rest = list(parts)
    tables = [i for i, part in enumerate(rest) if isinstance(part, Table)]
    first = [rest.pop(i) for i in tables[:1]]
    command = COMMAND.get()
    commands = [public(command)] if command else []
    facts = [*facts, f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC"]
    sections = [("details", "Details", [*figures[1:], *rest])]
    seen = [*figures[:1], *first]
    told = list(answer)[:MOST_FACTS]
    page = Page(name, title, told, seen, sections, commands, sources, facts, lead)
    write_text(files[1], page.html())
    return [*files, *(file for figure in figures for file in figure.files)]
