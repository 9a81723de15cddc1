"""Reserves the folder of a command that answers one question, and writes its page, CSV and figures."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable, Sequence
from contextlib import nullcontext
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.files import write_text
from ipe_bench.report.style import house_style
from ipe_bench.report.table import Part, environment

if TYPE_CHECKING:
    import pandas as pd

    from ipe_bench.report.figures.drawing import Drawing


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


def write_files(
    folder: Path,
    name: str,
    title: str,
    parts: Iterable[Part],
    table: tuple[str, pd.DataFrame],
    *,
    lead: str = "",
    drawings: Iterable[Drawing] = (),
) -> list[Path]:
    """Writes the files of a command and returns them: the `table` under its name, the `drawings`, and the page
    `name`.html of all tables, sentences and figures below the sentence `lead`."""
    files, figures = [folder / table[0], folder / f"{name}.html"], []
    write_text(files[0], table[1].to_csv(index=False))
    with house_style() if drawings else nullcontext():
        for drawing in drawings:
            files += drawing.save(folder)
            png = base64.b64encode((folder / f"{drawing.name}.png").read_bytes()).decode()
            figures.append({"title": drawing.title, "caption": drawing.caption, "png": png})
    page = environment().get_template("answer.html.j2")
    write_text(files[1], page.render(title=title, lead=lead, parts=list(parts), figures=figures))
    return files
