"""The figures of a report: each module declares what it draws from; here they are drawn and written
into one folder."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from importlib import import_module
from pathlib import Path
from typing import Any

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.files import make_folder, regular, write_text
from ipe_bench.plugins.extensions import added, require_type
from ipe_bench.report.figures.drawing import Drawing, Drawn
from ipe_bench.report.figures.views import Figure, View, views
from ipe_bench.report.formats import FORMATS, PAGE
from ipe_bench.report.style import Which, house_style
from ipe_bench.statistics.analysis import Analysis

FIGURES = (
    "certified",
    "settings",
    "errors",
    "one_track",
    "costs",
    "parameters",
    "tracks",
    "matrix",
    *("setup", "headline"),
)
"""The modules in the order of the report; each holds its kinds of figures in FIGURES."""
NAMES = {
    "digits": "digits of certified parameters that agree, by problem and estimator",
    "published": "errors found, and errors published",
    "settings": (
        "error by setting, and how often a misfit is detected; of a number that is swept, an axis"
        " of it"
    ),
    "headline": "success, error and reported covariance of all trials",
    "success": "success at every error scale with names at the curves, for a talk or a README",
    "matrix": "success of every estimator at every error scale, best first",
    "distributions": "distribution functions of the error, a panel per error scale",
    "calibration": "distribution of NEES, and the one for a right covariance",
    "cost_against_accuracy": "median cost against the error that 95 % of trials stay below",
    "convergence": "how iterates approach their limit, a panel per estimator",
    "parameter_errors": (
        "root mean square error of each parameter and its bound; figure_2 and 3 of the paper's"
        " setting"
    ),
    "figure_1": "the paper's set-up, and the 240 velocities of one trial with their errors",
    "one_track": "one trial: truth, readings, and two tracks with their 95 % bands",
    "tracks": "errors of all trials at each time step, a panel for each tracker, and NEES",
}
"""Names and subjects of our figures; the names of files go on with the setting."""
INDEX = "index.json"


def draw_all(
    analysis: Analysis, folder: Path, *, which: Which = "main", formats: Sequence[str] = (PAGE,)
) -> list[Drawn]:
    """Draws the figures that the data allow, in the order of the report, as files in the folder.

    `index.json` in the folder names each with its title and caption; figures of an earlier report
    are removed.
    """
    drawn: list[Drawn] = []
    old = _names_in(folder / INDEX)
    with nullcontext() if which == "none" else house_style():  # which takes a second to load
        for drawing in drawings(analysis, which):
            make_folder(folder)
            drawn.append(drawing.drawn(folder, formats))
    written = {path.name for one in drawn for path in one.files}
    earlier = {f"{name}.{kind}" for name in old for kind in FORMATS}
    for name in earlier - written:
        (folder / name).unlink(missing_ok=True)
    index = [{"name": one.name, "title": one.title, "caption": one.caption} for one in drawn]
    if index or old:
        text = json.dumps(index, indent=1, ensure_ascii=False)
        write_text(folder / INDEX, f"{text}\n")
    return drawn


def _names_in(index: Path) -> list[str]:
    """Returns the names of the figures of an earlier report.

    Raises:
        UserError: the file is none of ours, such as a pipe or one that names files elsewhere.
    """
    try:
        entries = json.loads(regular(index).read_text(encoding="utf-8"))
        names = [entry["name"] for entry in entries]
        if all(name == Path(name).name for name in names):
            return names
    except FileNotFoundError:
        return []
    except (OSError, ValueError, TypeError, KeyError):
        pass
    raise UserError(f"{index}: is no list of the figures beside it; remove it")


def drawings(analysis: Analysis, which: Which = "all") -> Iterator[Drawing]:
    """Yields the figures of every setting, or of all of them together, ours first."""
    if which == "none" or not analysis.collection.groups:
        return
    parts, whole = views(analysis, which)
    taken: set[str] = set()
    for name in FIGURES:
        for figure in import_module(f"{__name__}.{name}").FIGURES:
            for drawing in _drawn_by(figure, parts, whole, which):
                taken.add(drawing.name)
                yield drawing
    yield from added_drawings(analysis, (parts, whole), which, taken)


def added_drawings(
    analysis: Analysis,
    shown: tuple[list[View], View],
    which: Which = "all",
    taken: set[str] | None = None,
) -> Iterator[Drawing]:
    """Yields the figures of plugins; a failed drawing or a duplicate name adds a line to the
    problems of the analysis."""
    names = set() if taken is None else taken

    def make(record: Any) -> list[Drawing]:
        require_type(record, Figure, "is")
        found = list(_drawn_by(record, *shown, which))
        for drawing in found:
            require_type(drawing, Drawing)
            if drawing.name in names:
                raise UserError(f"there is a figure {drawing.name} already")
            names.add(drawing.name)
        return found

    for _, found in added("figure", analysis.collection.extra_problems, make):
        yield from found


def _drawn_by(figure: Figure, parts: list[View], whole: View, which: Which) -> Iterator[Drawing]:
    if which != "all" and not figure.main:
        return
    for view in [whole] if figure.together else parts:
        yield from figure.draw(view.only(figure.frames))
