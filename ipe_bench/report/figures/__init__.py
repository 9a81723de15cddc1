"""The figures of a report: each module declares what it draws from; here they are drawn and written into one folder."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.files import make_folder, write_text
from ipe_bench.plugins.extensions import guarded, records, require_type
from ipe_bench.report.choice import FORMATS, PAGE, Which
from ipe_bench.report.figures.drawing import Drawing, Figure
from ipe_bench.report.figures.views import FRAMES, View, views
from ipe_bench.report.style import house_style
from ipe_bench.statistics.analysis import Analysis

FIGURES = ("errors", "costs", "parameters", "convergence", "tracks")
"""The modules in the order of the report; each holds its kinds of figures in FIGURES."""
INDEX = "index.json"


@dataclass(frozen=True)
class Drawn:
    """A figure in its folder."""

    name: str
    title: str
    caption: str
    files: tuple[Path, ...]
    """One file per format; the first is the page's."""


def draw_all(
    analysis: Analysis, folder: Path, *, which: Which = "main", formats: Sequence[str] = (PAGE,)
) -> list[Drawn]:
    """The figures that the data allow, in the order of the report, as files in the folder.

    `index.json` in the folder names each with its title and caption; figures of an earlier report are removed. One of a
    plugin that cannot be drawn is left out, with a line added to the problems of the analysis.
    """
    problems, drawn = analysis.collection.extra_problems, []
    old = json.loads((folder / INDEX).read_text(encoding="utf-8")) if (folder / INDEX).exists() else []
    with house_style():
        for drawing, plugin in drawings(analysis, which):
            make_folder(folder)
            try:
                with guarded() if plugin else nullcontext():
                    files = drawing.save(folder, formats)
            except UserError as error:
                problems.append(f"{plugin}: {error}; it is left out")
            else:
                drawn.append(Drawn(drawing.name, str(drawing.title), str(drawing.caption), files))
    written = {path.name for one in drawn for path in one.files}
    for name in {f"{entry['name']}.{kind}" for entry in old for kind in FORMATS} - written:
        (folder / name).unlink(missing_ok=True)
    index = [{"name": one.name, "title": one.title, "caption": one.caption} for one in drawn]
    if index or old:
        write_text(folder / INDEX, json.dumps(index, indent=1, ensure_ascii=False) + "\n")
    return drawn


def drawings(analysis: Analysis, which: Which = "all") -> Iterator[tuple[Drawing, str]]:
    """Figures of every setting, or of all of them together, ours first; with the plugin that draws one, if any."""
    problems = analysis.collection.extra_problems
    others = _of_plugins(problems)  # those that cannot be used are told of even if nothing is drawn
    if which == "none" or (not analysis.collection.groups and analysis.attained.empty):
        return
    ours = [(figure, "") for name in FIGURES for figure in import_module(f"{__name__}.{name}").FIGURES]
    parts, whole = views(analysis)
    taken: set[str] = set()
    for figure, plugin in [*ours, *others]:
        for view in ([whole] if figure.together else parts) if figure.main or which == "all" else ():
            shown = view.only(figure.frames)
            try:
                found = drawn_by(figure, shown) if plugin else figure.draw(shown)
            except UserError as error:
                problems.append(f"{plugin}: {error}; it is left out")
                continue
            for drawing in found:
                if drawing.name in taken:
                    problems.append(f"{plugin}: there is a figure {drawing.name} already; it is left out")
                else:
                    taken.add(drawing.name)
                    yield drawing, plugin


def _of_plugins(problems: list[str]) -> list[tuple[Figure, str]]:
    """The figures of plugins and what they are called; a line is added to the problems for every one that is none."""
    found = []
    for option, record in records("figure", problems):
        try:
            found.append((checked_figure(record), f"figure={option.name}"))
        except UserError as error:
            problems.append(f"figure={option.name}: {error}; it is left out")
    return found


def checked_figure(record: Any) -> Figure:
    """The record, or UserError if it is no figure of frames that exist."""
    require_type(record, Figure, "is")
    if isinstance(record.frames, str) or not set(record.frames) <= set(FRAMES):
        raise UserError(f"frames={record.frames}: name some of {', '.join(FRAMES)}, in a tuple")
    return record


def drawn_by(figure: Figure, view: View) -> list[Drawing]:
    """The drawings that a plugin's figure makes of a view, or UserError if it raises or gives something else."""
    with guarded():
        found = list(figure.draw(view))
    for drawing in found:
        require_type(drawing, Drawing)
    return found
