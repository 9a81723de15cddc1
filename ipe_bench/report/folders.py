"""The folder of a command that answers one question: whose it is, and its files as JSON, CSV and figures."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.files import write_text

if TYPE_CHECKING:
    from ipe_bench.report.figures.drawing import Drawing


def claim(folder: Path, command: Any, *, elsewhere: bool, result: str, files: Sequence[str]) -> Path:
    """Reserves the folder that a command writes to: it is new, or holds what the same command wrote before.

    `result` is the JSON file that says which command it was, `files` are the others. If the folder holds anything else
    of ours, `elsewhere` allows folder-2, folder-3 and so on in its place.

    Raises:
        UserError: the folder is taken, or cannot be written to.
    """
    number, candidate = 1, folder
    while not _is_free(candidate, command, result, files):
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


def _is_free(folder: Path, command: Any, result: str, files: Sequence[str]) -> bool:
    if not (folder / result).exists():
        return not any((folder / name).exists() for name in files)
    try:
        return json.loads((folder / result).read_text(encoding="utf-8"))["command"] == command
    except (OSError, ValueError, KeyError, TypeError):
        return False


def write_json(path: Path, schema: int, command: Any, content: Mapping[str, Any]) -> Path:
    """Writes the result of a command; it comes first, since it says whose folder this is."""
    write_text(path, json.dumps({"schema": schema, "command": command, **content}, indent=1) + "\n")
    return path


def write_rows(path: Path, rows: Iterable[Sequence[Any]]) -> Path:
    """Writes rows as CSV."""
    written = io.StringIO()
    csv.writer(written).writerows(rows)
    write_text(path, written.getvalue())
    return path


def draw_into(folder: Path, drawings: Iterable[Drawing], names: Iterable[str]) -> list[Path]:
    """Writes figures, and removes those of these names that the same command drew before and does not draw now."""
    files = [path for drawing in drawings for path in drawing.save(folder)]
    for name in names:
        if folder / name not in files:
            (folder / name).unlink(missing_ok=True)
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
