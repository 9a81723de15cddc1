"""A folder of figures: draws those whose contents have changed, keeps the others, and removes its own that are stale.

`index.json` in the folder says what each file was drawn from. A digest covers the frames that a figure reads, the code
that draws it and the libraries' versions; a file whose bytes are no longer those that were written is drawn again.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from importlib import import_module, metadata, resources
from pathlib import Path
from threading import Thread
from typing import Any

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.files import make_folder, write_bytes, write_text
from ipe_bench.plugins.extensions import code_digest
from ipe_bench.report.choice import FORMATS, PAGE, Which
from ipe_bench.report.figures.drawing import Drawing, Figure
from ipe_bench.report.figures.views import View, views
from ipe_bench.report.helper import Helper, drawing_help
from ipe_bench.report.style import house_style, report_style
from ipe_bench.statistics.analysis import Analysis

INDEX = "index.json"
SCHEMA = 1
WORTH_HELP = 5
"""So many kinds of figures are worth a second process that is not there yet and needs a second to start."""


@dataclass(frozen=True)
class Drawn:
    """A figure in its folder."""

    name: str
    title: str
    caption: str
    files: tuple[Path, ...]
    """One per format that is there, as the data are now: the page's, then those that were asked for now or before."""


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
    formats: Sequence[str] = (PAGE,),
    processes: int | None = None,
    problems: list[str] | None = None,
) -> list[Drawn]:
    """The figures that the data allow, in the order of the report, as files in the folder; see `Gallery`."""
    with Gallery.open(analysis, folder, which, formats, problems, processes) as gallery:
        return gallery.drawn()


class Gallery:
    """A folder that is to hold the figures that the data allow.

    `which` is all, main (the few that answer the question) or none. A figure is drawn only where the folder does not
    hold it already in these formats; with `processes` (by default as many as there are cores, two at most) a second
    one draws from the beginning on, and this one what is left as soon as it is asked for what is `drawn`.
    What an earlier report left in the folder and is still right stays, whatever is asked for; what is not is removed.
    A figure of a plugin that cannot be drawn is left out, with a line added to the `problems`.
    """

    def __init__(self, analysis: Analysis, folder: Path, which: Which, formats: Sequence[str], problems: list[str]):
        self.folder = folder
        self.problems = problems
        self.parts, whole = views(analysis)
        """The settings one by one."""
        self.old = _read_index(folder)
        tasks = _tasks(analysis, self.parts, whole, problems)
        if which == "none" and not self.old:
            tasks = _nothing(problems)
        self.tasks = {task.digest: task for task in tasks}
        self.wanted = [
            d for d, t in self.tasks.items() if which == "all" or (which == "main" and _figure(t.figure).main)
        ]
        self.entries = {d: _intact(self.old[d], folder) for d in self.tasks if d in self.old}
        self.missing: dict[str, Job] = {}
        for digest in self.wanted:
            known = self.entries.get(digest)
            lacking = [kind for kind in formats if known is None or any(kind not in e.digests for e in known)]
            if lacking:
                self.missing[digest] = (self.tasks[digest], tuple(lacking))
        self.work = _Work(self.missing)

    @classmethod
    @contextlib.contextmanager
    def open(
        cls,
        analysis: Analysis,
        folder: Path,
        which: Which = "all",
        formats: Sequence[str] = (PAGE,),
        problems: list[str] | None = None,
        processes: int | None = None,
    ) -> Iterator[Gallery]:
        """A gallery whose second process draws what is missing while this one does something else."""
        gallery = cls(analysis, folder, which, formats, [] if problems is None else problems)
        with drawing_help() as helper:
            if processes != 1 and gallery.missing:
                if len(gallery.missing) >= WORTH_HELP:
                    helper.start()
                gallery.work.share(helper)
            try:
                yield gallery
            finally:
                gallery.work.give_up()

    def drawn(self) -> list[Drawn]:
        """The figures in the order of the report, all of them in the folder."""
        made = self.work.finished()
        if made:
            make_folder(self.folder)
        for digest in self.missing:
            pictures = made[digest]
            if isinstance(pictures, str):
                self.problems.append(f"{self.tasks[digest].plugin}: {pictures}; it is left out")
            else:
                known = {entry.name: entry.digests for entry in self.entries.get(digest, ())}
                saved = [picture.saved(self.folder) for picture in pictures]
                self.entries[digest] = [replace(e, digests=known.get(e.name, {}) | e.digests) for e in saved]
        entries = {d: self.entries[d] for d in self.tasks if d in self.entries}
        _settle_names(self.tasks, entries, self.folder, self.problems)
        _tidy(self.folder, self.old, entries)
        return [
            Drawn(e.name, e.title, e.caption, tuple(self.folder / f"{e.name}.{kind}" for kind in _in_order(e.digests)))
            for d in self.wanted
            for e in entries.get(d, ())
        ]


def _nothing(problems: list[str]) -> Iterator[Task]:
    """Where nothing is drawn and nothing was: plugins that cannot be used are told of all the same."""
    from ipe_bench.report import extensions

    deque(extensions.figures(problems), maxlen=0)
    return iter(())


def _in_order(kinds: Iterable[str]) -> list[str]:
    return [kind for kind in FORMATS if kind in set(kinds)]


def drawings(analysis: Analysis, problems: list[str]) -> Iterator[Drawing]:
    """Every figure that the data allow, drawn and not saved; one of a plugin that cannot be drawn is left out, with a
    line added to the `problems`."""
    from ipe_bench.report import extensions

    for task in _tasks(analysis, *views(analysis), problems):
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
        made = draw_task(tasks[digest], _in_order(kinds))
        if not isinstance(made, str):
            entries[digest] = [picture.saved(folder) for picture in made]


def _tasks(analysis: Analysis, parts: Sequence[View], whole: View, problems: list[str]) -> Iterator[Task]:
    """Every kind of figure of every setting, or of all of them together; ours first."""
    from ipe_bench.report import extensions
    from ipe_bench.report.figures import FIGURES

    if not analysis.collection.groups and analysis.attained.empty:
        return
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


@dataclass(frozen=True)
class Picture:
    """A drawn figure, its files in memory."""

    name: str
    title: str
    caption: str
    files: dict[str, bytes]
    """By format."""

    @classmethod
    def of(cls, drawing: Drawing, formats: Sequence[str]) -> Picture:
        return cls(drawing.name, str(drawing.title), str(drawing.caption), drawing.rendered(formats))

    def saved(self, folder: Path) -> Entry:
        for kind, content in self.files.items():
            write_bytes(folder / f"{self.name}.{kind}", content)
        digests = {kind: hashlib.sha256(content).hexdigest() for kind, content in self.files.items()}
        return Entry(self.name, self.title, self.caption, digests)


def draw_task(task: Task, formats: Sequence[str]) -> list[Picture] | str:
    """Draws a task's figures; returns why it could not, where they are a plugin's."""
    from ipe_bench.report import extensions

    if not task.plugin:
        with report_style():
            return [Picture.of(drawing, formats) for drawing in _figure(task.figure).draw(task.view)]
    with house_style():
        try:
            drawings = extensions.drawings(_figure(task.figure), task.view)
            return extensions.guarded(lambda: [Picture.of(drawing, formats) for drawing in drawings])
        except UserError as error:
            return str(error)


Job = tuple[Task, tuple[str, ...]]


class _Work:
    """Jobs that two processes do: the helper those that take longest, from the beginning on, and this one the others,
    when it is asked for all of them."""

    def __init__(self, jobs: Mapping[str, Job]) -> None:
        self.jobs = jobs
        self.done: dict[str, list[Picture] | str] = {}
        self.waiting = deque(sorted(jobs, key=lambda digest: -_figure(jobs[digest][0].figure).weight))
        self.helper: Helper | None = None
        self.thread: Thread | None = None

    def share(self, helper: Helper) -> None:
        """Hands jobs to the helper from here on, where it is started."""
        if helper.started:
            self.helper, self.thread = helper, Thread(target=self._hand_over, args=(helper,), daemon=True)
            self.thread.start()

    def _hand_over(self, helper: Helper) -> None:
        with contextlib.suppress(IndexError, ConnectionError):
            while True:
                digest = self.waiting.popleft()
                self.done[digest] = helper.ask(draw_task, *self.jobs[digest])

    def finished(self) -> dict[str, list[Picture] | str]:
        """What all jobs came to."""
        with contextlib.suppress(IndexError):
            while True:
                digest = self.waiting.pop()
                self.done[digest] = draw_task(*self.jobs[digest])
        if self.thread is not None:
            self.thread.join()
        # What the helper took and did not bring back is drawn here, and raises here what stopped it there.
        return {d: self.done[d] if d in self.done else draw_task(*job) for d, job in self.jobs.items()}

    def give_up(self) -> None:
        """Leaves undone what is not done."""
        self.waiting.clear()
        if self.helper is not None and self.thread is not None and self.thread.is_alive():
            self.helper.stop()
            self.thread.join()


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
