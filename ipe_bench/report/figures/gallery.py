"""A folder of figures: draws those whose contents have changed, keeps the others, and removes its own that are stale.

`index.json` in the folder says what each file was drawn from. A digest covers the frames that a figure reads, the code
that draws it and the libraries' versions; a file whose bytes are no longer those that were written is drawn again.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from functools import cache
from importlib import import_module, metadata, resources
from pathlib import Path
from typing import Any

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.files import make_folder, write_text
from ipe_bench.plugins.extensions import code_digest
from ipe_bench.report.choice import Which
from ipe_bench.report.figures.drawing import FORMATS, Drawing, Figure
from ipe_bench.report.figures.views import View, views
from ipe_bench.report.style import house_style
from ipe_bench.statistics.analysis import Analysis

INDEX = "index.json"
SCHEMA = 1
WORTH_HELP = 3
"""So many figures to draw are worth a second process, which needs a second or more to start."""


@dataclass(frozen=True)
class Drawn:
    """A figure in its folder."""

    name: str
    title: str
    caption: str
    files: tuple[Path, ...]
    """One per format, in the order asked for."""


@dataclass(frozen=True)
class Entry:
    """What the index says of one figure."""

    name: str
    title: str
    caption: str
    digests: dict[str, str] = field(default_factory=dict)
    """By format, the digest of the file's bytes."""

    def intact(self, folder: Path, kind: str) -> bool:
        return kind in self.digests and _digest_of(folder / f"{self.name}.{kind}") == self.digests[kind]


@dataclass(frozen=True)
class Task:
    """One kind of figure of one view: what is drawn, or kept, as a whole."""

    figure: str
    """The module's name; of a plugin's figure, its dotted name."""
    view: View
    digest: str
    plugin: str = ""
    """The option that a plugin's figure is, such as figure=NAME."""


def draw_all(
    analysis: Analysis,
    folder: Path,
    *,
    which: Which = "all",
    formats: Sequence[str] = FORMATS,
    processes: int | None = None,
    problems: list[str] | None = None,
) -> list[Drawn]:
    """The figures that the data allow, in the order of the report, as files in the folder.

    `which` is all, main (the few that answer the question) or none. A figure is drawn only where the folder does not
    hold it already in these formats; with `processes` (by default 2 where there are so many CPUs) two draw at once.
    What an earlier report left in the folder and is still right stays, whatever is asked for; what is not is removed.
    A figure of a plugin that cannot be drawn is left out, with a line added to the `problems`.
    """
    problems = [] if problems is None else problems
    old = _read_index(folder)
    if which == "none" and not old:
        from ipe_bench.report import extensions

        list(extensions.figures(problems))  # what cannot be used is told all the same
        return []
    tasks = {task.digest: task for task in _tasks(analysis, problems)}
    wanted = [d for d, task in tasks.items() if which == "all" or (which == "main" and _figure(task.figure).main)]
    missing = [d for d in wanted if not _is_there(old.get(d), folder, formats)]
    entries = {d: _intact(old[d], folder) for d in tasks if d in old}
    if missing:
        make_folder(folder)
        known = {d: {kind for entry in entries.get(d, ()) for kind in entry.digests} for d in missing}
        # What was drawn in another format before is drawn in that one too, so that all formats show the same.
        lists = {d: [kind for kind in FORMATS if kind in formats or kind in known[d]] for d in missing}
        jobs = [(tasks[d], lists[d]) for d in missing]
        drawn = dict(zip(missing, _draw(jobs, folder, processes or min(2, os.cpu_count() or 1)), strict=True))
        problems += [f"{tasks[d].plugin}: {made}; it is left out" for d, made in drawn.items() if isinstance(made, str)]
        entries |= {d: made for d, made in drawn.items() if not isinstance(made, str)}
    _settle_names(tasks, entries, folder, problems)
    _tidy(folder, old, entries)
    return [
        Drawn(e.name, e.title, e.caption, tuple(folder / f"{e.name}.{kind}" for kind in formats))
        for d in wanted
        for e in entries.get(d, ())
    ]


def drawings(analysis: Analysis, problems: list[str]) -> Iterator[Drawing]:
    """Every figure that the data allow, drawn and not saved; one of a plugin that cannot be drawn is left out, with a
    line added to the `problems`."""
    from ipe_bench.report import extensions

    for task in _tasks(analysis, problems):
        if not task.plugin:
            yield from _figure(task.figure).draw(task.view)
            continue
        try:
            yield from extensions.drawings(_figure(task.figure), task.view)
        except UserError as error:
            problems.append(f"{task.plugin}: {error}; it is left out")


def _settle_names(tasks: dict[str, Task], entries: dict[str, list[Entry]], folder: Path, problems: list[str]) -> None:
    """Leaves out figures of plugins that have the file names of others, whose files are drawn again."""
    taken: set[str] = set()
    spoiled: set[str] = set()
    for digest in [d for d in tasks if d in entries]:
        names = {entry.name for entry in entries[digest]}
        if tasks[digest].plugin and names & taken:
            name = min(names & taken)
            problems.append(f"{tasks[digest].plugin}: there is a figure {name} already; it is left out")
            spoiled |= names
            del entries[digest]
        taken |= names
    for digest in [d for d in entries if any(entry.name in spoiled for entry in entries[d])]:
        kinds = {kind for entry in entries[digest] for kind in entry.digests}
        made = draw_task(tasks[digest], folder, [kind for kind in FORMATS if kind in kinds])
        if not isinstance(made, str):
            entries[digest] = made


def _tasks(analysis: Analysis, problems: list[str]) -> Iterator[Task]:
    """Every kind of figure of every setting, or of all of them together; ours first."""
    from ipe_bench.report import extensions
    from ipe_bench.report.figures import FIGURES

    if not analysis.collection.groups and analysis.attained.empty:
        return
    parts, whole = views(analysis)
    kinds = [(name, _figure(name), "", "") for name in FIGURES]
    for option, figure in extensions.figures(problems):
        kinds.append((str(option.target), figure, f"figure={option.name}", code_digest(option)))
    for name, figure, plugin, code in kinds:
        for view in [whole] if figure.together else parts:
            seen = view.only(figure.frames)
            digest = hashlib.sha256(f"{name} {plugin}{code} {_drawn_with()} {seen.digest()}".encode())
            yield Task(name, seen, digest.hexdigest(), plugin)


def _figure(name: str) -> Figure:
    """The figure of one of our modules, or that of a plugin, whose folder is importable in this process."""
    module, _, attribute = name.rpartition(".")
    return getattr(import_module(module or f"ipe_bench.report.figures.{name}"), attribute if module else "FIGURE")


@cache
def _drawn_with() -> str:
    """A digest of the code that figures come from, and of the libraries."""
    digest = hashlib.sha256()
    for package in ("ipe_bench.report", "ipe_bench.report.figures", "ipe_bench.statistics", "ipe_bench.trials"):
        for source in sorted(resources.files(package).iterdir(), key=lambda item: item.name):
            if source.name.endswith(".py"):
                digest.update(source.read_bytes())
    for library in ("matplotlib", "seaborn", "pandas", "numpy"):
        digest.update(f"{library} {metadata.version(library)}".encode())
    return digest.hexdigest()


def draw_task(task: Task, folder: Path, formats: Sequence[str]) -> list[Entry] | str:
    """Draws a task's figures into the folder; returns why it could not, where they are a plugin's."""
    from ipe_bench.report import extensions

    with house_style():
        if not task.plugin:
            return [_saved(drawing, folder, formats) for drawing in _figure(task.figure).draw(task.view)]
        try:
            drawings = extensions.drawings(_figure(task.figure), task.view)
            return extensions.guarded(lambda: [_saved(drawing, folder, formats) for drawing in drawings])
        except UserError as error:
            return str(error)


def _saved(drawing: Drawing, folder: Path, formats: Sequence[str]) -> Entry:
    files = drawing.save(folder, formats)
    digests = {kind: _digest_of(path) for kind, path in zip(formats, files, strict=True)}
    return Entry(drawing.name, str(drawing.title), str(drawing.caption), digests)


Job = tuple[Task, list[str]]


def _draw(jobs: Sequence[Job], folder: Path, processes: int) -> list[list[Entry] | str]:
    """The jobs' entries; a second process takes jobs from the end while this one takes them from the beginning."""
    with tempfile.TemporaryDirectory(prefix="ipe-bench-figures-") as place:
        desk = Path(place)
        helper = _start_helper(jobs, folder, desk) if processes > 1 and len(jobs) >= WORTH_HELP else None
        try:
            done = {i: draw_task(jobs[i][0], folder, jobs[i][1]) for i in range(len(jobs)) if claim(desk, i)}
            if helper is not None:
                helper.wait()
                done |= _reported(desk)
        finally:
            if helper is not None:
                helper.kill()
                helper.wait()
        # What a helper took and did not bring back is drawn here, and raises here what stopped it there.
        return [done[i] if i in done else draw_task(task, folder, formats) for i, (task, formats) in enumerate(jobs)]


def _start_helper(jobs: Sequence[Job], folder: Path, desk: Path) -> subprocess.Popen[bytes] | None:
    """A second Python that draws; not forked, since this process may have threads, and not by multiprocessing, which
    would run the user's script again."""
    (desk / "jobs").write_bytes(pickle.dumps((list(jobs), folder.absolute())))
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    command = [sys.executable, "-m", "ipe_bench.report.figures.helper", str(desk)]
    with contextlib.suppress(OSError):
        quiet = subprocess.DEVNULL
        return subprocess.Popen(command, env=environment, stdin=quiet, stdout=quiet, stderr=quiet)
    return None


def claim(desk: Path, job: int) -> bool:
    """Whether the job is this process's to do: the first to ask has it."""
    try:
        (desk / f"claimed-{job}").touch(exist_ok=False)
    except FileExistsError:
        return False
    return True


def _reported(desk: Path) -> dict[int, list[Entry] | str]:
    return {int(path.name.removeprefix("done-")): pickle.loads(path.read_bytes()) for path in desk.glob("done-*")}


def _is_there(entries: Sequence[Entry] | None, folder: Path, formats: Sequence[str]) -> bool:
    return entries is not None and all(entry.intact(folder, kind) for entry in entries for kind in formats)


def _intact(entries: Sequence[Entry], folder: Path) -> list[Entry]:
    """The entries with those formats only whose files are as they were written."""
    return [
        Entry(e.name, e.title, e.caption, {kind: d for kind, d in e.digests.items() if e.intact(folder, kind)})
        for e in entries
    ]


def _tidy(folder: Path, old: dict[str, list[Entry]], entries: dict[str, list[Entry]]) -> None:
    """Writes the index, and removes the files of the old one that are in the new one no more."""

    def files(index: dict[str, list[Entry]]) -> set[str]:
        return {f"{entry.name}.{kind}" for known in index.values() for entry in known for kind in entry.digests}

    for name in files(old) - files(entries):
        (folder / name).unlink(missing_ok=True)
    if entries == old:
        return
    drawn = {digest: [asdict(entry) for entry in known] for digest, known in entries.items()}
    write_text(folder / INDEX, json.dumps({"schema": SCHEMA, "drawn": drawn}, indent=1, ensure_ascii=False) + "\n")


def _read_index(folder: Path) -> dict[str, list[Entry]]:
    """What the folder holds by digest; nothing where the index is missing, damaged or of another version."""
    try:
        index: Any = json.loads((folder / INDEX).read_text(encoding="utf-8"))
        if index["schema"] != SCHEMA:
            return {}
        found = {digest: [Entry(**entry) for entry in entries] for digest, entries in index["drawn"].items()}
        safe = all(Path(e.name).name == e.name and set(e.digests) <= set(FORMATS) for v in found.values() for e in v)
        return found if safe else {}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}


def _digest_of(path: Path) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return ""
