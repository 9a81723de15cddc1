"""Makes notebooks to download of written pages: their files, commands and code become cells."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ipe_bench.basics.files import make_folder, write_text

NOTEBOOKS = ("first_hour", "explanation/method")
"""Pages that offer a notebook."""
_FILE = re.compile(r"Write a file `(\S+)`:\n$")
_BLOCK = re.compile(r"^```(\w+)\n(.*?)^```\n", re.MULTILINE | re.DOTALL)


def write_notebooks(source: Path) -> None:
    """Writes the notebook of each page into the folder `notebooks` of a site's source."""
    make_folder(source / "notebooks")
    for page in NOTEBOOKS:
        made = notebook((source / f"{page}.md").read_text(encoding="utf-8"))
        write_text(source / "notebooks" / f"{Path(page).name}.ipynb", json.dumps(made, indent=1))


def notebook(page: str) -> dict[str, Any]:
    """Returns the notebook of a page, in nbformat 4.5."""
    cells = [
        {"id": f"cell-{number}", "metadata": {}, "source": text.strip("\n"), **kind}
        for number, (kind, text) in enumerate(_cells(page))
    ]
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    return {
        "nbformat": 4,
        "nbformat_minor": 5,
        "metadata": {"kernelspec": kernel},
        "cells": cells,
    }


def _cells(page: str) -> Iterator[tuple[dict[str, Any], str]]:
    """Yields the kind and the text of each cell."""
    words = {"cell_type": "markdown"}
    code = {"cell_type": "code", "execution_count": None, "outputs": []}
    waiting = ""
    end = 0
    for block in _BLOCK.finditer(page):
        waiting += page[end : block.start()]
        end = block.end()
        language, content = block.groups()
        file = _FILE.search(waiting.rstrip("\n") + "\n")
        if file:
            content = f"%%writefile {file[1]}\n{content}"
        elif language == "console":
            content = re.sub(r"^\$ ", "!", content, flags=re.MULTILINE)
        elif language != "python":
            waiting += block[0]
            continue
        yield words, _plain(waiting)
        yield code, content
        waiting = ""
    if waiting + page[end:]:
        yield words, _plain(waiting + page[end:])


def _plain(text: str) -> str:
    """Returns a text without pictures, downloads and links to other pages."""
    text = re.sub(r"^(!\[|\{download\}).*\n", "", text, flags=re.MULTILINE)
    return re.sub(r"\[([^]]+)\]\((?!https?:)[^)]*\)", r"\1", text)
