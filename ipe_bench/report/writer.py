"""The folder of a command that answers one question: whose it is, and its page, JSON, CSV and figures."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.files import write_text
from ipe_bench.report.style import house_style
from ipe_bench.report.table import Part, environment

if TYPE_CHECKING:
    import pandas as pd

    from ipe_bench.report.figures.drawing import Drawing


def reserve_output_folder(folder: Path, name: str, command: Any, *, elsewhere: bool, files: Sequence[str] = ()) -> Path:
    """Reserves the folder that a command writes to: it is new, or holds what the same command wrote before.

    `name`.json says which command that was, `files` are further files of its kind. If the folder holds anything else of
    ours, `elsewhere` allows folder-2, folder-3 and so on in its place.

    Raises:
        UserError: the folder is taken, or cannot be written to.
    """
    number, candidate = 1, folder
    while not _is_free(candidate, f"{name}.json", command, files):
        if not elsewhere:
            raise UserError(
                f"output={candidate}: holds results of another command, which are not overwritten; choose another "
                "folder, or remove it"
            )
        number += 1
        candidate = folder.with_name(f"{folder.name}-{number}")
    try:
        candidate.mkdir(parents=True, exist_ok=True)
        probe = candidate / ".writable"
        probe.touch()
        probe.unlink()
    except OSError as error:
        reason = error.strerror or str(error)
        raise UserError(f"output={candidate}: cannot be written to ({reason}); choose another folder") from None
    return candidate


def _is_free(folder: Path, result: str, command: Any, files: Sequence[str]) -> bool:
    if not (folder / result).exists():
        return not any((folder / name).exists() for name in files)
    try:
        return json.loads((folder / result).read_text(encoding="utf-8"))["command"] == command
    except (OSError, ValueError, KeyError, TypeError):
        return False


def write(
    folder: Path,
    name: str,
    title: str,
    parts: Iterable[Part],
    *,
    lead: str = "",
    content: Mapping[str, Any] | None = None,
    table: tuple[str, pd.DataFrame] | None = None,
    drawings: Iterable[Drawing] = (),
    old: Sequence[str] = (),
) -> list[Path]:
    """Writes the files of a command, each of which appears whole or not at all, and returns them.

    They are `name`.json with the `content`, the `table` under its name, the `drawings`, which are drawn here in our
    style, and the page `name`.html of all the tables, sentences and figures below the sentence `lead`. Of the `old`
    files, which the same command may have written before, those go that it does not write now.
    """
    files = []
    if content is not None:  # first, since it says whose folder this is
        files.append(folder / f"{name}.json")
        write_text(files[0], json.dumps(content, indent=1) + "\n")
    if table is not None:
        files.append(folder / table[0])
        write_text(files[-1], table[1].to_csv(index=False))
    figures = []
    with house_style() if drawings else nullcontext():
        for drawing in drawings:
            files += drawing.save(folder)
            png = base64.b64encode((folder / f"{drawing.name}.png").read_bytes()).decode()
            figures.append({"title": drawing.title, "caption": drawing.caption, "png": png})
    page = environment().get_template("answer.html.j2")
    files.append(folder / f"{name}.html")
    write_text(files[-1], page.render(title=title, lead=lead, parts=list(parts), figures=figures))
    for other in {folder / each for each in old} - set(files):
        other.unlink(missing_ok=True)
    return files


def plain(value: Any) -> Any:
    """A value as JSON knows it, which has neither arrays nor NaN nor infinity: null in their place."""
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return [plain(v) for v in value] if isinstance(value, list | tuple) else value


def picked(thing: Any, *names: str) -> dict[str, Any]:
    """These attributes of a thing as JSON knows them, under their names."""
    return {name: plain(getattr(thing, name)) for name in names}


def named(names: Sequence[str], values: Any) -> dict[str, Any]:
    """Values as JSON knows them, each under the name of its parameter."""
    return dict(zip(names, plain(values), strict=True))
