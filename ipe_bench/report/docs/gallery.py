"""The gallery: every experiment as it was executed for this page: command, table, pictures, config."""

from __future__ import annotations

import json
import shlex
import shutil
import time
from collections.abc import Sequence
from pathlib import Path

from ipe_bench.basics.files import make_folder, write_text
from ipe_bench.plugins import discovery
from ipe_bench.report.docs.reference import printed_by
from ipe_bench.report.figures.gallery import INDEX
from ipe_bench.report.words import duration

FIGURES = 3
"""Pictures of an experiment that its page shows."""
ORDINARY, LEAST = 1000, 3
"""Trials of an ordinary experiment, and the least number that a costly one is cut to."""

_PARTS = {
    "beyond": ("error_scale=300,1000,3000",),
    "mgh": ("measurement.start=1",),
    "nist": ("measurement.start=2",),
}
"""What is asked for of experiments that take minutes even with few trials."""


def write_gallery(folder: Path, results: Path, trials: int, names: Sequence[str] | None) -> None:
    """A page for each experiment, and one that lists them; `trials` is for an experiment that has 1000 by itself, and
    others have as large a part of theirs."""
    options = [o for o in discovery.options("experiment") if o.source.name == "ipe-bench"]
    chosen = [o for o in options if names is None or o.name in names]
    for k, option in enumerate(chosen, 1):
        number = _trials(option, trials)
        print(
            f"experiment {k} of {len(chosen)}: {option.name}, {number} trial{'s' * (number != 1)} ...",
            end=" ",
            flush=True,
        )
        began = time.perf_counter()
        write_text(folder / f"{option.name}.md", _page(option, folder, results / option.name, number))
        print(duration(time.perf_counter() - began, 2), flush=True)
    lines = ["# Gallery", "", "Every experiment, or a part of it, with few of the trials that it has by itself.", ""]
    for option in chosen:
        lines += [f"- [{option.name}]({option.name}.md): {option.summary}"]
    lines += ["", "```{toctree}", ":hidden:", *(option.name for option in chosen), "```"]
    write_text(folder / "index.md", "\n".join(lines))


def _trials(option: discovery.Option, trials: int) -> int:
    own = (option.config or {}).get("trials", ORDINARY)
    return min(own, max(round(own * trials / ORDINARY), min(trials, LEAST)))


def _page(option: discovery.Option, folder: Path, results: Path, trials: int) -> str:
    number = [] if (option.config or {}).get("trials") == trials else [f"trials={trials}"]
    command = ["run", f"+experiment={option.name}", *_PARTS.get(option.name, ()), *number]
    # The paths at its end are of no use to a reader.
    printed = printed_by([*command, f"output={results.resolve()}"]).partition("\nSummary ")[0].strip()
    lines = [f"# {option.name}", "", option.summary, "", "```console", f"$ ipe-bench {shlex.join(command)}", "```", ""]
    lines += ["```text", printed, "```", ""]
    make_folder(folder / "pictures")
    for picture, caption in _pictures(results / "figures"):
        shutil.copyfile(picture, folder / "pictures" / f"{option.name}_{picture.name}")
        lines += [f"![{picture.stem.replace('_', ' ')}](pictures/{option.name}_{picture.name})", "", f"*{caption}*", ""]
    return "\n".join([*lines, "## Its config", "", "```yaml", option.text.rstrip(), "```", ""])


def _pictures(folder: Path) -> list[tuple[Path, str]]:
    """The first pictures of a report, each with what it shows; a report on certified readings alone may have none."""
    if not (folder / INDEX).exists():
        return []
    drawn = json.loads((folder / INDEX).read_text(encoding="utf-8"))
    return [(folder / f"{entry['name']}.png", entry["caption"]) for entry in drawn[:FIGURES]]
