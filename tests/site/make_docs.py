"""`python tests/site/make_docs.py [OUTPUT] [--trials N]`: builds the site by Sphinx, of written
pages, of what the program says of itself, and of what is stored of its experiments, which `--store
NAME` computes."""

from __future__ import annotations

import argparse
import inspect
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from importlib.metadata import version
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pandas as pd
import stored_tables
from gallery_frames import SUFFIX, Computed, read
from notebooks import write_notebooks
from readme import PICTURES, store_picture, write_readme
from shared import oracles
from state_tables import with_tables
from word_drawings import write_drawings

import ipe_bench
from ipe_bench.basics.errors import UserError
from ipe_bench.basics.files import make_folder, write_text
from ipe_bench.basics.statuses import Status
from ipe_bench.plugins.construct import described, find_class
from ipe_bench.plugins.discovery import CONTRACTS, PACKAGES, RECORD_GROUPS, Option, options
from ipe_bench.report.figures import common, drawings
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.figures.headline import picture
from ipe_bench.report.figures.views import views
from ipe_bench.report.page.headline import headline
from ipe_bench.report.sections import report_tables
from ipe_bench.report.style import house_style
from ipe_bench.report.tables.certified import certified_tables
from ipe_bench.report.tables.matrix import SUCCESS
from ipe_bench.report.tables.table import environment, html, markdown
from ipe_bench.report.words import brief, enumerate_few, percent
from ipe_bench.statistics.analysis import Analysis, analyse
from ipe_bench.statistics.records import MAIN, NOT_MAIN, STATISTICS
from ipe_bench.statistics.statistic import ALL
from ipe_bench.statistics.verdicts import VERDICTS

SETTINGS = {
    "project": "ipe-bench",
    "version": version("ipe-bench"),
    "release": version("ipe-bench"),
    "copyright": "the authors of ipe-bench",
    "extensions": ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "docs_types"],
    "myst_enable_extensions": ["attrs_inline", "dollarmath", "deflist", "colon_fence"],
    "myst_heading_anchors": 3,
    "suppress_warnings": [
        "myst.xref_missing"
    ],  # of links to rows of checked.md, which tests/test_oracles.py follows
    "exclude_patterns": ["notebooks"],  # to download, and no pages
    "nb_execution_mode": "force",
    "nb_execution_in_temp": True,
    "nb_execution_raise_on_error": True,
    "nb_execution_timeout": 120,
    "html_theme": "pydata_sphinx_theme",
    "html_title": "ipe-bench",
    "html_show_sourcelink": False,
    "html_static_path": [str(Path(__file__).parent / "static")],
    "html_css_files": ["site.css"],
    "html_sidebars": {page: [] for page in ("first_hour", "choosing", "results")},
    "html_math_renderer": "mathml",
    "html_theme_options": {
        "show_prev_next": False,
        "navigation_with_keys": False,
        "secondary_sidebar_items": ["page-toc"],
    },
    "autodoc_typehints": "none",
    "autodoc_member_order": "bysource",
}
"""Settings of Sphinx; an opened page fetches no further resource."""
GROUPS = {
    "measurement": "Measurement models",
    "noise": "Noises",
    "prior": "Priors",
    "solver": "Solvers",
    "baseline": "Baseline estimators",
    "state_model": "State models",
    "tracker": "Filters and smoothers of states",
    "execution": "Executions",
}
IN_USE = (
    "Scenario",
    "run",
    "load",
    "report",
    "estimate",
    "compare",
    "design",
    "posterior",
    "component",
    "audit",
    "check",
    "status",
    "StateScenario",
)
"""Names of the reference of Python in the order in which they are used; the others follow by the
alphabet."""
CLASSES = {place for places in CONTRACTS.values() for place in places}
ORDINARY, LEAST = 1000, 3
"""Trials of an ordinary experiment, and the least number that a costly one is cut to."""
_PARTS = {
    "beyond": ["error_scale=300,1000,3000"],
    "nist": ["measurement.start=2"],
    "states": ["state_model=bearings_only", "error_scale=1,10"],
}
"""Reduced settings of experiments that take minutes, of which no result is stored."""
_FIGURES = {"paper": ("figure_2", "figure_3")}
"""The figures of an experiment's page, where they are not the first."""
_LETTERS = 13
"""Size of the letters of bars, which are read at a third of the page's width."""
_OF_PARAMETERS = ("paper", "pendulum_book", "states")
"""Experiments whose pages show single parameters."""
SOURCES = Path(ipe_bench.__file__).parent / "report" / "docs"
"""The folder of what the site is made of."""
SHOWN = SOURCES.parents[2] / ".assets" / "headline.md"
"""The stored report that the repository shows without a site."""
STORED = SOURCES / "gallery"
"""The folder of what pages of the gallery are drawn from."""
PICTURE = re.compile(r"!\[[^]]*\]\(([^)]+\.png)\)")
"""A picture that a page shows, by its path."""
TABLES = "explanation/tables_of_states.md"
"""The page of what is stored of the experiment `states`."""
CHECKED = "reference/checked.md"
"""The page of what is recorded of the tests that compare with a source."""
MERGED = {
    "explanation/calibration": "explanation/success",
    "explanation/filters": "explanation/when_to_filter",
    "howto/agents": "howto/plugins",
    "howto/applications": "howto/hydra",
    "howto/completion": "howto/hydra",
    "howto/estimator_ci": "howto/compare",
    "howto/python": "howto/notebook",
    "howto/sweeps": "howto/hydra",
    "howto/trials": "howto/hydra",
    "howto/write_statistic": "howto/write_noise",
    "tutorial": "explanation/method",
}
"""Pages of earlier versions, with the page that has their content now."""


def build(output: Path, trials: int) -> int:
    """Writes the site to OUTPUT/html and what it is made of beside it; returns Sphinx's exit
    code."""
    from sphinx.application import Sphinx  # pyright: ignore[reportMissingImports]

    source = output / "source"
    shutil.rmtree(source, ignore_errors=True)
    shutil.copytree(SOURCES / "pages", source)
    print("reference pages ...", flush=True)
    write_reference(source / "reference")
    write_drawings(source)
    write_notebooks(source)
    write_tables(source)
    write_gallery(source / "gallery", output / "results", trials)
    add_readme_picture(source)
    places = (output / "html", output / "doctrees")
    site = Sphinx(source, None, *places, "html", SETTINGS, warningiserror=True, freshenv=True)
    site.build()
    write_redirects(output / "html")
    return site.statuscode


def add_readme_picture(source: Path) -> None:
    """Adds README's picture to the gallery's."""
    shutil.copyfile(PICTURES[0], source / "gallery" / "pictures" / "success.png")


def write_redirects(html: Path) -> None:
    """Leads readers of a page that was merged to the page that has its content now."""
    for page, target in MERGED.items():
        here = f"{os.path.relpath(target, Path(page).parent)}.html"
        write_text(
            html / f"{page}.html",
            f'<!doctype html><meta charset="utf-8"><title>Moved</title>'
            f'<meta http-equiv="refresh" content="0; url={here}"><a href="{here}">Moved</a>\n',
        )


def write_tables(source: Path) -> None:
    """Writes the tables that are built and not stored into their pages."""
    for page in source.rglob("*.md"):
        text = page.read_text(encoding="utf-8")
        if stored_tables.MARK.search(text):
            write_text(page, stored_tables.with_tables(text, STORED))
    states = read(STORED / f"states{SUFFIX}").analysis
    page = source / TABLES
    write_text(page, with_tables(page.read_text(encoding="utf-8"), states))
    page = source / CHECKED
    write_text(page, oracles.with_tables(page.read_text(encoding="utf-8")))


def printed_by(command: Sequence[str], columns: int = 80) -> str:
    """Returns the output of `ipe-bench COMMAND`, without blanks at the ends of lines; a UserError
    if it fails."""
    program = [sys.executable, "-m", "ipe_bench", *command]
    environment = os.environ | {"COLUMNS": str(columns), "NO_COLOR": "1"}
    done = subprocess.run(program, capture_output=True, text=True, env=environment, check=False)
    if done.returncode != 0:
        raise UserError(
            f"{shlex.join(command)}: ended with exit code {done.returncode}: {done.stderr[-2000:]}"
        )
    return "\n".join(line.rstrip() for line in done.stdout.splitlines())


def write_page(path: Path, template: str, **content: Any) -> None:
    """Writes a page from its template, in which the filter `cell` makes any text a cell of a
    Markdown table."""
    made = environment().overlay(autoescape=False)
    made.filters["cell"] = lambda text: " ".join(
        str(text).replace("|", "\\|").replace("<", "&lt;").split()
    )
    write_text(path, made.get_template(f"docs/{template}.md.j2").render(content))


def _ours(group: str) -> list[Option]:
    return [option for option in options(group) if option.source.name == "ipe-bench"]


def example(option: Option) -> str:
    """Returns the example in the docstring of an option's class; empty if there is none."""
    if option.group in RECORD_GROUPS or option.target is None:
        return ""
    text = inspect.getdoc(find_class(option.target, option.name)) or ""
    _, begins, code = text.partition(">>> ")
    return begins + code


def write_reference(folder: Path) -> None:
    """Adds pages of options, commands, statuses, statistics and Python names to a folder."""
    from ipe_bench.report.page.html import DEFINITIONS

    for group, title in GROUPS.items():
        rows = [(option, described(option), example(option)) for option in _ours(group)]
        key = f"{PACKAGES[group]}.NAME" if group in PACKAGES else group
        write_page(
            folder / f"{group}.md", "options", group=group, title=title, key=key, options=rows
        )
    statuses = [status for status in Status if status is not Status.RUNNING]
    write_page(folder / "statuses.md", "statuses", statuses=statuses)
    words = {"records": STATISTICS, "verdicts": VERDICTS, "definitions": DEFINITIONS.items()}
    write_page(folder / "statistics.md", "statistics", main=MAIN, not_main=NOT_MAIN, **words)
    summary = printed_by(["--help"], columns=100).rstrip()
    names = re.findall(r"^    (\w+)(?:  |$)", summary, re.MULTILINE)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        said = pool.map(lambda name: printed_by([name, "--help"], columns=100).rstrip(), names)
        write_page(
            folder / "commands.md",
            "commands",
            commands={"": summary, **dict(zip(names, said, strict=True))},
        )
    write_page(folder / "contracts.md", "contracts", kinds=CONTRACTS)
    names = sorted(ipe_bench.__all__, key=lambda name: ((*IN_USE, name)).index(name))
    things = [
        (name, getattr(ipe_bench, name)) for name in names if f"ipe_bench.{name}" not in CLASSES
    ]
    shown = [(name, thing) for name, thing in things if hasattr(thing, "__qualname__")]
    kinds = [
        ("autoclass" if isinstance(t, type) else "autofunction", f"ipe_bench.{name}")
        for name, t in shown
    ]
    write_page(folder / "python.md", "python", names=kinds)


@dataclass(frozen=True)
class Page:
    """Shows an experiment in the gallery."""

    html: str
    figures: list[Drawing]
    small: Any
    """The figure of its thumbnail."""

    @classmethod
    def of(cls, name: str, analysis: Analysis) -> Page:
        """Draws the page of an experiment, in the house style."""
        chosen = _FIGURES.get(name)
        drawn = drawings(analysis, "all" if chosen else "main")
        figures = [one for one in drawn if one.name in chosen] if chosen else list(islice(drawn, 1))
        parts = [*headline(analysis), *report_tables(analysis)[:1]]
        return cls(html(parts).strip(), figures, _small(analysis, figures))

    @property
    def words(self) -> list[str]:
        """All that is read on it, besides what stands in figures."""
        return [
            self.html,
            *(word for one in self.figures for word in (one.name, one.title, one.caption)),
        ]


def write_gallery(folder: Path, results: Path, trials: int) -> None:
    """Draws a page per experiment, their list, and a table of the best estimators by model, of what
    is stored; of an experiment without a stored result, `trials` replaces the default of 1000."""
    chosen, found = _ours("experiment"), {}
    make_folder(pictures := folder / "pictures")
    for option in chosen:
        path = STORED / f"{option.name}{SUFFIX}"
        if not path.exists():
            print(
                f"{option.name}: no result of it is stored; it runs now, with few trials ...",
                flush=True,
            )
            path = store(
                option, results, results / option.name, trials, _PARTS.get(option.name, ())
            )
        found[option.name] = computed = read(path)
        with house_style():
            page = Page.of(option.name, computed.analysis)
            for file, figure in (
                ("", page.small),
                *((f"_{one.name}", one.figure) for one in page.figures),
            ):
                figure.savefig(pictures / f"{option.name}{file}.png", dpi=150)
        write_page(
            folder / f"{option.name}.md", "experiment", option=option, computed=computed, page=page
        )
    write_page(
        folder / "index.md",
        "gallery",
        experiments=[(option, found[option.name]) for option in chosen],
    )
    best = [
        row for name, computed in found.items() for row in _best(name, computed.analysis.summary)
    ]
    write_page(folder / "best.inc", "best", rows=best)


def stored_as_markdown(option: Option) -> str:
    """Returns the finding, figure, matrix and full table of an experiment's stored results, for
    readers of the repository."""
    computed = read(STORED / f"{option.name}{SUFFIX}")
    finding, *parts = headline(computed.analysis)
    with house_style():
        figures = drawings(computed.analysis, "main")
        figure = next(one for one in figures if one.name == SUCCESS)
    table, *_ = report_tables(computed.analysis)
    made = environment().overlay(autoescape=False)
    return made.get_template("docs/stored.md.j2").render(
        option=option,
        computed=computed,
        finding=finding,
        parts=[part if isinstance(part, str) else markdown(part) for part in parts],
        figure=figure,
        table=markdown(replace(table, title="")),
    )


def store(
    option: Option, folder: Path, results: Path, trials: int, part: Sequence[str] = ()
) -> Path:
    """Runs an experiment, or a part of it, and keeps what its page is drawn from; returns the
    file."""
    name, command = option.name, ["run", f"+experiment={option.name}", *part]
    own = (option.config or {}).get("trials", ORDINARY)
    number = min(own, max(round(own * trials / ORDINARY), min(trials, LEAST)))
    if number != own and not any(word.startswith("trials=") for word in part):
        command.append(f"trials={number}")
    try:
        printed_by([*command, "execution=serial", "figures=none", f"output={results}"])
    except (
        UserError
    ) as error:  # such as a data set of many that one of the estimators cannot begin with
        if "(refused: " not in str(error):
            raise
        print(f"{name}: {str(error).strip().splitlines()[-1]}", flush=True)
    analysis = analyse([results])
    computed = Computed(
        shlex.join(command), version("ipe-bench"), _asked(name) // own, own, analysis
    )
    computed.write(path := folder / f"{name}{SUFFIX}", parameters=name in _OF_PARAMETERS)
    with house_style():
        if Page.of(name, read(path).analysis).words != Page.of(name, analysis).words:
            raise AssertionError(
                f"{path}: what is kept is not all that the page of {name} is drawn from"
            )
    print(f"{name}: {computed.extent}", flush=True)
    return path


def _asked(experiment: str) -> int:
    """Counts the estimates that an experiment asks for, over all its trials."""
    with TemporaryDirectory() as empty:
        told = printed_by(["run", f"+experiment={experiment}", f"output={empty}/none", "--dry-run"])
    return int(re.findall(r"(\d+) would be computed", told)[-1])


def _small(analysis: Analysis, drawn: Sequence[Drawing]) -> Any:
    """Draws one legible panel: README's picture of the first of several settings by the alphabet,
    what is drawn of all settings, or a bar for each estimator."""
    parts, _ = views(analysis)
    if parts and len(parts[0].scales) > 1:
        return picture(min(parts, key=lambda part: part.label))
    of_settings = [one.figure for one in drawn if one.name == "settings"]
    if of_settings:
        return of_settings[0]
    rows: Any = analysis.summary[analysis.summary["parameter"] == ALL]
    column = "success"
    for table in certified_tables(analysis.collection)[:1]:
        rows, column = (
            table.data,
            "mean_lre_parameters" if table.name == "certified_averages" else "found",
        )
    means = rows.groupby("estimator")[column].mean().sort_values()
    fig, (ax,) = common.panels(1, height=0.8 + 0.24 * len(means))
    ax.barh(list(means.index), means)
    ax.tick_params(labelsize=_LETTERS)
    ax.xaxis.label.set_size(_LETTERS)
    ax.set_xlabel(
        {"success": "success, mean over settings", "found": "root mean square error"}.get(
            column, "correct digits, mean"
        )
    )
    return fig


def _best(experiment: str, summary: pd.DataFrame) -> Iterator[tuple[str, ...]]:
    """Yields who succeeds most often, and at what cost, at the least and the largest error scale of
    a simulated experiment, and who is not there."""
    if "truth" in summary or not {"measurement", "noise", "success"} <= set(summary):
        return
    totals = summary[(summary["parameter"] == ALL) & (summary["noise"] != "certified")]
    every = list(dict.fromkeys(totals["estimator"]))
    for scale in sorted(
        {totals["error_scale"].min(), totals["error_scale"].max()} if len(totals) else ()
    ):
        here = totals[totals["error_scale"] == scale].sort_values(
            "simulations_median", kind="stable"
        )
        best = here[here["success"] == here["success"].max()]
        names = dict.fromkeys((str(best["measurement"].iloc[0]), experiment))
        link = f"[{', '.join(names)}](gallery/{experiment}.md)"
        lacking = [label for label in every if label not in set(here["estimator"])]
        told = enumerate_few(list(best["estimator"]), 5)
        if lacking:
            told += f" (not run: {enumerate_few(lacking)})"
        share = f"{percent(best['success'].iloc[0])} of {best['trials'].iloc[0]}"
        cost = brief(best["simulations_median"].iloc[0])
        yield link, f"{scale:g}", told, share, cost


def store_pictures(source: Path) -> None:
    """Stores the pictures that written pages show, for readers of the repository."""
    for page in (SOURCES / "pages").rglob("*.md"):
        folder = source / page.parent.relative_to(SOURCES / "pages")
        for link in PICTURE.findall(page.read_text(encoding="utf-8")):
            store_picture(folder / link, page.parent / link)


def store_all(output: Path, trials: int, names: Sequence[str]) -> int:
    """Computes the experiments that are named and keeps what their pages are drawn from; draws all
    pages again, and writes those of the repository."""
    for option in _ours("experiment"):
        if option.name in names:
            print(f"{option.name} ...", flush=True)
            store(option, STORED, output / "results" / option.name, trials)
    write_gallery(output / "source" / "gallery", output / "results", trials)
    for option in _ours("experiment"):
        computed = read(STORED / f"{option.name}{SUFFIX}")
        print(f"{option.name}: {computed.extent}, by ipe-bench {computed.version}")
        if option.name == SHOWN.stem:
            write_text(SHOWN, stored_as_markdown(option))
            write_readme(computed.analysis)
    write_drawings(output / "source")
    add_readme_picture(output / "source")
    store_pictures(output / "source")
    return 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", nargs="?", default="outputs/docs", type=Path)
    parser.add_argument("--trials", type=int, help="of an experiment that has 1000 by itself")
    words = "compute these experiments for the gallery, and draw its pages alone"
    parser.add_argument("--store", nargs="*", metavar="NAME", help=words)
    given = parser.parse_args()
    if given.store is not None:
        sys.exit(store_all(given.output, given.trials or ORDINARY, given.store))
    sys.exit(build(given.output, given.trials or 10))
