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
from typing import TYPE_CHECKING, Any

from ipe_bench import __version__
from ipe_bench.basics.errors import UserError
from ipe_bench.basics.files import regular, write_text
from ipe_bench.report.formats import PAGE
from ipe_bench.report.style import house_style
from ipe_bench.report.tables.table import Part, Table, environment
from ipe_bench.report.words import CITATION, public

if TYPE_CHECKING:
    import pandas as pd

    from ipe_bench.report.figures.drawing import Drawing

COMMAND: ContextVar[str] = ContextVar("command", default="")
"""The command that is being run, for its page; empty in Python."""


def reserve_output_folder(
    folder: Path, name: str, command: Any, *, elsewhere: bool, files: Sequence[str] = ()
) -> Path:
    """Reserves the folder that a command writes to: a new one, or that of the same command, by `name`.json; with
    `elsewhere` folder-2, folder-3 and so on, if it has `files` of another one.

    Raises:
        UserError: the folder is taken.
        StorageError: it cannot be written to.
    """
    others = (folder.with_name(f"{folder.name}-{k}") for k in count(2)) if elsewhere else ()
    found = next(
        (one for one in chain([folder], others) if _is_free(one, f"{name}.json", command, files)),
        None,
    )
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
        return (
            json.loads(regular(folder / result).read_text(encoding="utf-8"))["command"] == command
        )
    except (OSError, ValueError, KeyError, TypeError):
        return False


@dataclass(frozen=True)
class Page:
    """Holds what a page shows: the answer, a figure and a table are seen at once, and the sections are folded."""

    kind: str
    title: str
    answer: Sequence[Part]
    shown: Sequence[Any]
    sections: Sequence[tuple[str, str, Sequence[Any]]]
    """Place, title and parts: sentences, tables, figures or pieces of HTML; one without parts is left out."""
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

    def html(self) -> str:
        """Renders it, with the style, the script and the citation of every page."""
        from markupsafe import Markup

        templates = resources.files("ipe_bench.report.page") / "templates"
        style, script = (
            Markup((templates / f"report.{kind}").read_text(encoding="utf-8"))
            for kind in ("css", "js")
        )
        constant = {
            "style": style,
            "script": script,
            "citation": CITATION,
            "version": __version__,
            "public": public,
        }
        return environment().get_template("page.html.j2").render(**vars(self), **constant)


def digests(places: Iterable[Path]) -> list[tuple[str, str]]:
    """Returns each file with its SHA-256, and each folder of results with that of the digests of its trials."""
    found = []
    for place in places:
        files = sorted((place / "trials").glob("*")) if place.is_dir() else [place]
        each = [hashlib.sha256(path.read_bytes()).hexdigest() for path in files if path.is_file()]
        found.append(
            (
                str(place),
                each[0] if files == [place] else hashlib.sha256("".join(each).encode()).hexdigest(),
            )
        )
    return found


def write_files(
    folder: Path,
    name: str,
    table: tuple[str, pd.DataFrame],
    title: str,
    answer: Sequence[str],
    parts: Iterable[Part],
    drawings: Iterable[Drawing] = (),
    *,
    facts: Sequence[str] = (),
    sources: Sequence[tuple[str, str]] = (),
) -> list[Path]:
    """Writes the files of a command and returns them: the `table` under its name, the page `name`.html with at most
    three sentences and the first of its tables seen at once, and its figures."""
    files = [folder / table[0], folder / f"{name}.html"]
    write_text(files[0], table[1].to_csv(index=False))
    with house_style() if drawings else nullcontext():
        figures = [drawing.drawn(folder, (PAGE,)) for drawing in drawings]
    rest = list(parts)
    first = [rest.pop(i) for i in [i for i, part in enumerate(rest) if isinstance(part, Table)][:1]]
    commands = [public(asked)] if (asked := COMMAND.get()) else []
    facts = [*facts, f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC"]
    sections = [("details", "Details", [*figures[1:], *rest])]
    page = Page(
        name, title, list(answer)[:3], [*figures[:1], *first], sections, commands, sources, facts
    )
    write_text(files[1], page.html())
    return [*files, *(file for figure in figures for file in figure.files)]
