"""The documentation: what its pages tell readers to type works, links lead somewhere, and nothing
is fetched."""

from __future__ import annotations

import json
import lzma
import os
import re
import shlex
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from html import unescape
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import unquote

import make_docs as pages
import notebooks
import numpy as np
import pandas as pd
import pytest
import state_tables
import stored_tables
import word_drawings
import yaml
from docs_types import show_type, type_of
from gallery_frames import KEPT, SUFFIX, Computed, read
from shared.synthetic_store import Pretender, Seeker, Synthetic

import ipe_bench
from ipe_bench.baselines import EKF
from ipe_bench.cli import shorts, words
from ipe_bench.cli.main import COMMANDS
from ipe_bench.cli.session import jobs_of, session
from ipe_bench.measurements import Polynomial
from ipe_bench.noise import Gaussian
from ipe_bench.plugins import discovery
from ipe_bench.plugins.construct import described
from ipe_bench.report.style import house_style
from ipe_bench.runs.parts import TRUTH
from ipe_bench.runs.provenance import canonical_json
from ipe_bench.runs.run import result_keys
from ipe_bench.statistics import analyse
from ipe_bench.statistics.statistic import ALL
from ipe_bench.statistics.verdicts import NO_VERDICT, VERDICTS

PAGES = pages.SOURCES / "pages"
WRITTEN = sorted(PAGES.rglob("*.md"))


def ids(path: Path) -> str:
    return (
        str(path.relative_to(PAGES)) if path.is_relative_to(PAGES) else path.name.partition(".")[0]
    )


@pytest.fixture(scope="module")
def generated(tmp_path_factory) -> Path:
    """The pages that nobody writes; of the gallery their names and words alone, as nothing is
    drawn."""
    folder = tmp_path_factory.mktemp("generated")
    blank = pages.Page("", [], SimpleNamespace(savefig=lambda *_, **__: None))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pages, "store", lambda option, *_: next(iter(STORED)))
        patch.setattr(pages.Page, "of", lambda *_: blank)
        pages.write_reference(folder / "reference")
        pages.write_gallery(folder / "gallery", folder, 1)
    return folder


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)


FILTERS = blocks(PAGES / "howto" / "write_filter.md", "python")


# The gallery --------------------------------------------------------------------------------------


STORED = sorted(pages.STORED.glob(f"*{SUFFIX}"))
SOON = ("headline", "pendulum_book")
"""Experiments, of constants and of states, whose page is held to what they ask for in the quick
tests."""
LONG = ("nist",)
"""Experiments of so many jobs that to compose them takes longer than a second."""
every_experiment = pytest.mark.parametrize(
    "path",
    [
        pytest.param(
            p, marks=[pytest.mark.slow] * p.name.startswith(LONG), id=p.name.partition(".")[0]
        )
        for p in STORED
    ],
)


def asked(experiment: str) -> tuple[Counter[str], int]:
    """The names of the results that an experiment asks for today, and its trials in each."""
    with session():
        jobs = jobs_of(words.read("run", [f"+experiment={experiment}"]), multirun=False)
    keys = [
        key
        for one in jobs.specs
        for key in result_keys(one.scenario, one.estimators)
        if key.label != TRUTH
    ]
    (trials,) = {one.count for one in jobs.specs}
    return Counter(canonical_json(key.names) for key in keys), trials


@pytest.mark.parametrize(
    "path",
    [pytest.param(p, marks=[pytest.mark.slow] * (ids(p) not in SOON)) for p in STORED],
    ids=ids,
)
def test_a_page_has_the_results_that_its_experiment_asks_for_today_or_says_how_many_it_lacks(path):
    name = path.name.removesuffix(SUFFIX)
    found, (wanted, trials) = read(path), asked(name)
    there = Counter(
        canonical_json(group.footer["names"]) for group in found.analysis.collection.groups
    )
    assert there <= wanted, "rows of another experiment"
    assert (found.asked_results, found.asked_trials) == (wanted.total(), trials)
    assert found.complete == (there == wanted and set(totals(found)["trials"]) == {trials})
    assert found.command.startswith(f"run +experiment={name}")
    assert re.fullmatch(r"\d+\.\d+\.\d+\S*", found.version)


@every_experiment
def test_what_is_stored_has_todays_words_and_is_small(path):
    text = lzma.decompress(path.read_bytes()).decode()
    assert not re.search(r"(/home|/root|/tmp|outputs)/", text)
    assert path.stat().st_size < 170_000
    assert set(totals(read(path))["verdict"]) <= {word.value for word in VERDICTS} | {NO_VERDICT}


@pytest.mark.parametrize(
    "path", [pytest.param(p, marks=[pytest.mark.slow] * (p != STORED[0])) for p in STORED], ids=ids
)
def test_todays_program_draws_every_page_from_what_is_stored(path):
    """If it wants another column, compute the experiment again: make gallery NAMES=it."""
    found = read(path)
    with house_style():
        page = pages.Page.of(path.name.removesuffix(SUFFIX), found.analysis)
    simulated = set(totals(found)["trials"]) != {1}
    assert page.figures or not simulated
    assert page.html.index("<p>") < page.html.index("<table")  # the answer, then the numbers
    # Certified problems are averaged over.
    assert page.html.count("<tr") > (len(totals(found)) if simulated else 1)


def test_the_report_that_the_repository_shows_is_what_todays_program_writes_of_what_is_stored():
    """If it is not, `make gallery` writes it again."""
    (option,) = (one for one in discovery.options("experiment") if one.name == pages.SHOWN.stem)
    text = pages.SHOWN.read_text(encoding="utf-8")
    assert text.splitlines() == pages.stored_as_markdown(option).splitlines()
    finding = text.splitlines()[0].removeprefix("# ")
    assert f"**{finding}**" in (PAGES / "index.md").read_text(encoding="utf-8")
    for link in re.findall(r"\]\(([^)]+)\)", text):
        assert (pages.SHOWN.parent / link).exists(), link


def rows_under(heading: str) -> dict[str, list[str]]:
    """The first table below a heading of the results, as the site has it: the cells of a row by its
    estimator, or by its first cell."""
    page = (PAGES / "results.md").read_text(encoding="utf-8")
    text = stored_tables.with_tables(page, pages.STORED)
    below = text.partition(f"## {heading}\n")[2]
    table = re.search(r"^\|-+\|.*\n((?:\|.*\n)+)", below, re.MULTILINE)
    assert table
    found = {}
    for line in table[1].splitlines():
        first, *cells = (cell.strip() for cell in line.strip("|").split("|"))
        label = re.search(r"`(\w+)`", first)
        found[label[1] if label else first] = cells
    return found


def test_the_results_far_from_the_start_are_the_stored_ones():
    known = totals(read(pages.STORED / f"beyond{SUFFIX}")).set_index(["estimator", "error_scale"])
    for label, (*shares, cost) in rows_under("Far from the start").items():
        found = [100 * known["success"][label, scale] for scale in (300, 1000, 3000, 10_000)]
        assert shares == [f"{share:.0f}" for share in found], label
        assert cost == f"{known['simulations_median'][label, 1000]:.0f}", label


def test_the_digits_of_certified_answers_are_the_stored_ones():
    stored = read(pages.STORED / f"nist{SUFFIX}").analysis.collection
    known = pages.certified_tables(stored)[0].data.set_index(["estimator", "start"])
    for label, cells in rows_under("Certified problems").items():
        both = [known.loc[(label, start)] for start in (1, 2)]
        solved = [f"{one['solved']:.0f}" for one in both]
        digits = [f"{one['mean_lre_parameters']:.2f}" for one in both]
        assert cells == [*solved, *digits], label


def test_the_errors_under_a_wrong_model_are_the_stored_ones():
    every = totals(read(pages.STORED / f"mismatch{SUFFIX}"))
    known = every[every["estimator"] == "gauss_newton"]
    columns = ["rmse_solved_over_linear_bound", "predicted_rmse", "nees_solved", "misfit"]
    stored = known.sort_values("predicted_rmse")[columns].to_numpy().tolist()
    shown = [
        [float(cell.removesuffix(" %").replace(",", "")) for cell in cells]
        for cells in rows_under("A wrong model").values()
    ]
    for row, (*others, misfit) in zip(sorted(shown), stored, strict=True):
        assert row == pytest.approx([*others, 100 * misfit], rel=0.02)


def test_the_tables_of_when_to_filter_are_the_stored_ones():
    page = (PAGES / "explanation" / "when_to_filter.md").read_text(encoding="utf-8")
    text = stored_tables.with_tables(page, pages.STORED)
    assert "<!-- stored" not in text
    known = totals(read(pages.STORED / f"headline{SUFFIX}")).set_index(["estimator", "error_scale"])
    row = re.search(r"^\| 300 \|(.*)\|$", text, re.MULTILINE)
    assert row
    ekf, error, _, ukf, *_ = (cell.strip(" %") for cell in row[1].split("|"))
    assert [float(ekf), float(ukf)] == [100 * known["success"][n, 300] for n in ("ekf", "ukf")]
    assert float(error) == pytest.approx(known["error_median"]["ekf", 300], rel=0.01)
    states = totals(read(pages.STORED / f"states{SUFFIX}"))
    states = states[states["measurement"] == "bearings_only"]
    success = states.set_index(["estimator", "error_scale"])["success"]
    row = re.search(r"^\| 100 \| (99.*)\|$", text, re.MULTILINE)
    assert row
    names = ("auto", "lm_ieks", "ekf", "ukf", "ieks", "ipe_newton")
    assert [float(cell) for cell in row[1].split("|")] == [100 * success[n, 100] for n in names]


def test_the_traps_of_reading_a_report_are_the_stored_ones():
    page = (PAGES / "explanation" / "how_to_read.md").read_text(encoding="utf-8")
    known = totals(read(pages.STORED / f"headline{SUFFIX}")).set_index(["estimator", "error_scale"])
    lost = known.loc[("fixed_point", 300)]
    assert f"median error of {lost['error_median']:.2f} bounds" in page
    assert f"fails in {100 * (1 - lost['success']):.1f} % of trials" in page
    narrow = known.loc[("ukf", 100)]
    assert f"`ukf` succeeds in all {narrow['trials']:.0f} trials" in page
    assert (narrow["success"], narrow["verdict"]) == (1, "overconfident")


def test_the_pairs_of_states_account_for_the_shares_beside_them():
    """Of 200 trials, `auto` holds more by those that it alone holds, less those that the other
    alone holds."""
    stored = read(pages.STORED / f"states{SUFFIX}").analysis
    page = (PAGES / pages.TABLES).read_text(encoding="utf-8")
    text = state_tables.with_tables(page, stored)
    compared = 0
    for table in re.findall(r"^\| auto \| [\d.]+ \|  \|  \| \d.*\n(?:\|.*\n)+", text, re.MULTILINE):
        own, *others = (line.split("|")[2:-1] for line in table.splitlines())
        for row in others:
            for share, other, pair in zip(own[::3], row[::3], row[1::3], strict=True):
                alone, lacking = pair.split(":")
                assert 2 * (float(share) - float(other)) == int(alone) - int(lacking), row
                compared += 1
    assert compared == 4 * 3 * 11


def totals(found: Computed) -> pd.DataFrame:
    summary = found.analysis.summary
    return summary[summary["parameter"] == ALL]


def two_scales(store: Synthetic, trials: int = 30) -> Computed:
    """Results of two estimators at two error scales."""
    for scale in (1.0, 10.0):
        error = 0.1 * np.random.default_rng(0).standard_normal((trials, 3))
        for label, estimator in (("linear_lse", Pretender()), ("mine", Seeker())):
            store.add(store.scenario(error_scale=scale), label, scale * error, estimator=estimator)
    return Computed("run +experiment=two", "1.2.3", 4, 30, analyse([store.directory]))


def test_a_page_drawn_from_what_is_kept_is_the_page_of_the_results(synthetic, tmp_path):
    """Its sentences, tables, captions, looks and curves."""
    computed = two_scales(synthetic)
    computed.write(tmp_path / f"two{SUFFIX}", parameters=False)
    again = read(tmp_path / f"two{SUFFIX}")
    assert (again.command, again.version, again.extent) == (
        computed.command,
        "1.2.3",
        computed.extent,
    )
    with house_style():
        first, second = (pages.Page.of("two", one.analysis) for one in (computed, again))
    assert second.words == first.words
    assert first.html.index("<p>") < first.html.index("<table")  # the answer, then the numbers
    assert first.html.count("<tr") >= 1 + 4
    curves = [
        [
            (line.get_color(), line.get_xydata().tolist())
            for ax in one.figures[0].figure.axes
            for line in ax.lines
        ]
        for one in (first, second)
    ]
    assert str(curves[0]) == str(curves[1])  # as NaN is no number


@pytest.mark.parametrize(
    ("results", "trials", "complete"), [(4, 30, True), (5, 30, False), (4, 31, False)]
)
def test_a_page_and_its_thumbnail_say_what_is_incomplete(
    synthetic, tmp_path, results, trials, complete
):
    computed = replace(two_scales(synthetic), asked_results=results, asked_trials=trials)
    extent = f"30 of {trials} trials; 4 of {results} results"
    option = SimpleNamespace(name="two", summary="", text="")
    shown = {"option": option, "computed": computed, "page": SimpleNamespace(html="", figures=[])}
    pages.write_page(tmp_path / "two.md", "experiment", **shown)
    pages.write_page(tmp_path / "index.md", "gallery", experiments=[(option, computed)])
    for name in ("two.md", "index.md"):
        page = (tmp_path / name).read_text(encoding="utf-8")
        assert extent in page
        assert ("ncomplete" in page) == (not complete)
    assert "Computed by ipe-bench 1.2.3" in (tmp_path / "two.md").read_text(encoding="utf-8")


def test_the_table_of_the_best_names_who_was_not_run_at_a_scale(synthetic):
    summary = two_scales(synthetic).analysis.summary
    lacking = summary[(summary["estimator"] != "mine") | (summary["error_scale"] < 10)]
    assert [row[2] for row in pages._best("two", summary)] == [
        "linear_lse, mine",
        "linear_lse, mine",
    ]
    assert [row[2] for row in pages._best("two", lacking)] == [
        "linear_lse, mine",
        "linear_lse (not run: mine)",
    ]


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "pendulum_book",
        "ranging",
        pytest.param("bearings", marks=pytest.mark.campaign),
        pytest.param("polynomial", marks=pytest.mark.campaign),
    ],
)
def test_what_is_stored_is_what_the_program_computes_today(name, tmp_path):
    """Trials, statistics and words; times are those of a machine."""
    (option,) = (option for option in discovery.options("experiment") if option.name == name)
    stored = read(pages.STORED / f"{name}{SUFFIX}")
    now = read(pages.store(option, tmp_path, tmp_path / "results", pages.ORDINARY))
    assert (now.command, now.extent) == (stored.command, stored.extent)
    for frame in KEPT:
        one, other = (getattr(each.analysis, frame) for each in (now, stored))
        timed = [column for column in one if "time" in column]
        pd.testing.assert_frame_equal(
            one.drop(columns=timed), other.drop(columns=timed), rtol=1e-5, atol=1e-9
        )


LINK = re.compile(r"""(?:\]\(|src(?:set)?=")(?!https?:|data:)([^)#"\s]*)#?([^)"\s]*)""")
"""A link or a picture of a page, with its anchor."""
ROOT = PAGES.parents[3]
SOURCES = [
    *WRITTEN,
    *(ROOT / name for name in ("README.md", "CHANGELOG.md")),
    *(path for name in (".github", ".assets", "plugins") for path in ROOT.glob(f"{name}/**/*.md")),
]
"""All that readers of the repository find, without a site."""


def headings(page: Path) -> list[str]:
    """Returns the anchors of a page."""
    text = page.read_text(encoding="utf-8")
    return [slug(one) for one in re.findall(r"^#+ (.*)$", text, re.MULTILINE)]


@pytest.mark.parametrize("page", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_somewhere_in_the_repository(page):
    """Rows of checked.md are built, and followed by test_oracles."""
    for link, anchor in LINK.findall(page.read_text(encoding="utf-8")):
        target = (page.parent / link).resolve() if link else page
        assert target.exists(), link
        if anchor and target.suffix == ".md" and target.name != "checked.md":
            assert anchor in headings(target), f"{link}#{anchor}"


def test_a_page_that_the_site_builds_replaces_one_that_says_where_to_look(generated):
    built = [path for path in WRITTEN if (generated / path.relative_to(PAGES)).exists()]
    assert len(built) == 9
    for path in built:
        assert len(path.read_text(encoding="utf-8").split()) < 15
        assert set(headings(path)) <= set(headings(generated / path.relative_to(PAGES)))


def slug(heading: str) -> str:
    """Returns the anchor of a heading."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


def test_a_page_that_was_merged_leads_to_the_page_that_has_its_content(tmp_path):
    pages.write_redirects(tmp_path)
    written = {path.relative_to(PAGES).with_suffix("").as_posix() for path in WRITTEN}
    assert pages.MERGED.keys().isdisjoint(written)
    for page in pages.MERGED:
        stub = tmp_path / f"{page}.html"
        (target,) = re.findall(r"url=([^\"]+)\.html", stub.read_text(encoding="utf-8"))
        target = os.path.normpath(stub.parent.relative_to(tmp_path) / target)
        assert target in written


def test_options_are_described_from_class_and_config_and_say_what_they_mean():
    rows = {row.name: row for option in discovery.options("solver") for row in described(option)}
    assert rows["growth"].value == "2"
    assert rows["tolerance"].kind == "a number above 0"
    assert rows["budget"].value == "null"
    assert rows["depth"].meaning == "past steps that each new one draws on"
    every = [
        option
        for group in ("solver", "baseline", "noise", "measurement")
        for option in discovery.options(group)
    ]
    ours = [option for option in every if option.source.name == "ipe-bench"]
    assert [
        f"{option.name}.{row.name}"
        for option in ours
        for row in described(option)
        if not row.meaning
    ] == []


def test_every_command_has_a_section(generated):
    page = (generated / "reference" / "commands.md").read_text(encoding="utf-8")
    found = set(re.findall(r"^## (\w+)$", page, re.MULTILINE))
    assert found == set(COMMANDS)


@pytest.mark.slow
def test_the_cells_of_the_notebook_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    for code in blocks(PAGES / "howto" / "notebook.md", "{code-cell} python"):
        exec(code, names)
    assert next(iter(names["table"].figures)) == "headline"
    assert (tmp_path / "outputs" / "notebook" / "report.html").exists()


@pytest.mark.parametrize("code", FILTERS, ids=range(len(FILTERS)))
@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_the_filters_of_the_page_are_the_kalman_filter_on_a_linear_model(code, noise):
    names: dict = {"__name__": __name__}
    exec(compile(code, "write_filter.md", "exec", dont_inherit=True), names)
    scenario = ipe_bench.Scenario(Polynomial(strength=0.0), Gaussian(0.01))
    z = scenario.draw(0, 5).z
    mine = names.get("MyFilter") or names["Julier"]
    ours, kalman = (one(process_noise=noise).estimate(scenario.problem, z) for one in (mine, EKF))
    assert ours.covariance is not None
    assert kalman.covariance is not None
    np.testing.assert_allclose(ours.x, kalman.x, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(ours.covariance, kalman.covariance, rtol=1e-6, atol=1e-12)
    with pytest.raises(ipe_bench.UserError, match="engine=filterpy: this filter has no track"):
        type("Neither", (ipe_bench.Sequential,), {})()


def test_attributes_of_public_classes_have_types_that_are_types():
    lines = [
        "no limit.",
        "",
        ":type: Simulations that a trial may cost; None",
    ]  # as napoleon leaves them
    show_type(None, "attribute", "ipe_bench.IPE.budget", None, None, lines)
    assert lines == [
        "Simulations that a trial may cost; None: no limit.",
        "",
        "",
        ":type: float | None",
    ]
    classes = [
        thing for name in ipe_bench.__all__ if isinstance(thing := getattr(ipe_bench, name), type)
    ]
    assert {ipe_bench.IPE, ipe_bench.State, ipe_bench.Sequential, ipe_bench.OdeMeasurement} <= set(
        classes
    )
    names = [(cls, name) for cls in classes for name in vars(cls).get("__annotations__", {})]
    assert len(names) > 50
    assert [
        one for one in names if not re.fullmatch(r"[\w.]+(\[.*\])?( \| .*)?", type_of(*one))
    ] == []


def write_files(page: Path, folder: Path) -> None:
    """Writes the files that a page tells its readers to write, or to have from the first hour."""
    said = r"Write a file `(\S+)`:\n\n```\w+\n(.*?)```"
    text = page.read_text("utf-8")
    if "first_hour.md#your-function-and-your-readings" in text:
        text += (PAGES / "first_hour.md").read_text("utf-8")
    for name, content in re.findall(said, text, re.DOTALL):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(content, encoding="utf-8")


def commands(page: Path) -> list[list[str]]:
    """Returns the arguments of each command of a page, one that goes on behind a backslash as a
    whole."""
    typed = "".join(blocks(page, "console")).replace("\\\n", "")
    return [shlex.split(line.removeprefix("$ ipe-bench ")) for line in typed.splitlines()]


def conditioned(page: str, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of the scored states at the end given all readings, from their joint
    normal density: without an added state, and without a recursion."""
    count = len(z)
    initial_x, initial_v, *noises = np.eye(2 + count)  # what everything else is a sum of
    x, v = initial_x, initial_v
    rows = []
    for w in noises:
        before = x
        x = 0.9 * x + w if page == "correlated" else x + v
        v = v + w
        rows.append({"coloured": x, "correlated": x + 0.5 * w, "delayed": before}[page])
    lag = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    white = {"coloured": 0.2, "correlated": 0.3, "delayed": 0.5}[page]
    R = white**2 * np.eye(count) + (page == "coloured") * 0.8**lag
    drawn = np.diag([25.0, 1.0] + [1.0 if page == "correlated" else 0.01] * count)
    H = np.array(rows)
    scored = np.array([x] if page == "correlated" else [x, v])
    gain = np.linalg.solve(H @ drawn @ H.T + R, H @ drawn @ scored.T).T
    return gain @ z, (scored - gain @ H) @ drawn @ scored.T


@pytest.mark.parametrize("name", ["coloured", "correlated", "delayed"])
def test_noise_as_an_added_state_is_exact(name, tmp_path):
    write_files(PAGES / "howto" / "added_states.md", tmp_path)
    model = ipe_bench.states.Formulas(
        **yaml.safe_load((tmp_path / f"{name}.yaml").read_text("utf-8")), count=20
    )
    z = np.cumsum(np.random.default_rng(1).standard_normal(20))
    mean, covariance = conditioned(name, z)
    for tracker in ("ekf", "auto"):
        estimators = {tracker: ipe_bench.component(f"tracker/{tracker}")}
        (track,) = ipe_bench.estimate(model, z[:, None], estimators)
        states = slice(len(mean))
        np.testing.assert_allclose(track.mean[-1][states], mean, rtol=1e-9)
        np.testing.assert_allclose(track.covariance[-1][states, states], covariance, rtol=1e-8)


def test_who_comes_from_another_tool_finds_the_same_estimates(tmp_path, monkeypatch):
    """SciPy's curve_fit, and filterpy's Kalman filter."""
    page = PAGES / "howto" / "from_others.md"
    write_files(page, tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "oxygen", raising=False)
    fit, track = {}, {}
    fitted, filtered = blocks(page, "python")
    exec(fitted, fit)
    np.testing.assert_allclose(fit["answer"].x, fit["values"], rtol=1e-5)
    np.testing.assert_allclose(fit["answer"].covariance, fit["covariance"], rtol=1e-3)
    exec(filtered, track)
    np.testing.assert_allclose(track["track"].mean[-1], track["kalman"].x.ravel(), rtol=1e-12)
    np.testing.assert_allclose(track["track"].covariance[-1], track["kalman"].P, rtol=1e-12)


@pytest.mark.parametrize(("deviation", "p"), [(2.5, "0.385"), (0.25, "1e-88")])
def test_a_stated_noise_is_tested_as_the_answers_to_questions_say(hour, deviation, p):
    assert f"p = {p}" in (PAGES / "howto" / "questions.md").read_text(encoding="utf-8")
    model = ipe_bench.measurements.Function(of="oxygen:demand")
    estimators = {"levenberg_marquardt": ipe_bench.baselines.LevenbergMarquardt()}
    (fit,) = ipe_bench.estimate(model, "oxygen.csv", estimators, noise=Gaussian(deviation))
    assert f"{fit.p_value:.3g}" == p or f"{fit.p_value:.0e}" == p
    assert fit.fits == (deviation == 2.5)


@pytest.fixture
def hour(tmp_path, monkeypatch) -> Path:
    """The folder of a reader of the first hour, with its files."""
    write_files(PAGES / "first_hour.md", tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "oxygen", raising=False)
    return PAGES / "first_hour.md"


def oxygen(days: list[float], noise: float) -> ipe_bench.Scenario:
    model = ipe_bench.measurements.Function(of="oxygen:demand", columns={"t": days})
    return ipe_bench.Scenario(model, Gaussian(noise))


def test_the_bounds_of_the_first_hour_are_those_of_its_commands(hour):
    """At its estimate, three late days are worth to b1 what half the noise is."""
    designs = [command for command in commands(hour) if command[0] == "design"]
    printed = re.findall(
        r"^\| .* days.* \| ([\d.]+) \| ([\d.]+) \|$", hour.read_text(), re.MULTILINE
    )
    assert len(designs) == len(printed) == 3
    model = ipe_bench.measurements.Function(of="oxygen:demand")
    estimators = {"levenberg_marquardt": ipe_bench.baselines.LevenbergMarquardt()}
    (fit,) = ipe_bench.estimate(model, "oxygen.csv", estimators)
    estimate = dict(fit.values)
    today = pd.read_csv("oxygen.csv")["t"].tolist()
    for command, bounds in zip(designs, printed, strict=True):
        given = dict(word.split("=", 1) for word in command[1:] if "=" in word)
        here = "oxygen.csv" in command  # the short form is at the estimate of these readings
        assert here != (given.get("at") == "outputs/estimate-demand")
        days = today if here else json.loads(given["measurement.columns.t"])
        found = ipe_bench.design(oxygen(days, float(given["noise.deviation"])), at=estimate)
        sizes = [one.size for one in found.observability.parameters]
        seen = found.observability.bound * sizes
        assert list(seen) == pytest.approx([*map(float, bounds)], rel=5e-3)


def test_the_estimates_of_the_first_hour_come_out_with_a_profile_that_allows_no_negative_rate(hour):
    model = ipe_bench.measurements.Function(of="oxygen:demand")
    estimators = {"levenberg_marquardt": ipe_bench.baselines.LevenbergMarquardt()}
    (fit,) = ipe_bench.estimate(model, "oxygen.csv", estimators)
    printed = re.findall(r"^ b\d .* ([\d.]+) ± ([\d.]+)$", hour.read_text(), re.MULTILINE)
    values = [float(value) for value, _ in printed]
    assert list(dict(fit.values).values()) == pytest.approx(values, rel=5e-3)
    assert fit.fits is None  # as the noise level is estimated from the residuals


@pytest.mark.parametrize(
    "command",
    [one for one in commands(PAGES / "first_hour.md") if "my_" not in " ".join(one)],
    ids=lambda one: one[0],
)
def test_the_commands_of_the_first_hour_are_composed(command, hour):
    """What they ask for is understood; the slow test of all pages runs them."""
    own = ("-m", "at=outputs/estimate-demand")
    short = shorts.read(command[0], [word for word in command[1:] if word not in own])
    given = words.read(command[0], short.in_full)
    with session():
        jobs = jobs_of(given, multirun="-m" in command)
    assert len(jobs.specs) == (3 if "-m" in command else 1)


@pytest.mark.parametrize("page", notebooks.NOTEBOOKS)
def test_a_notebook_has_the_files_and_commands_of_its_page(page, tmp_path):
    path = PAGES / f"{page}.md"
    write_files(path, tmp_path)
    made = notebooks.notebook(path.read_text(encoding="utf-8"))
    cells = [cell["source"] for cell in made["cells"] if cell["cell_type"] == "code"]
    written = [one.removeprefix("%%writefile ") for one in cells if one.startswith("%%writefile")]
    files = dict(one.split("\n", 1) for one in written)
    assert files == {
        one.name: one.read_text(encoding="utf-8").strip("\n") for one in tmp_path.iterdir()
    }
    typed = "\n".join(cell for cell in cells if cell.startswith("!")).replace("\\\n", "")
    lines = [shlex.split(line.removeprefix("!ipe-bench ")) for line in typed.splitlines()]
    assert lines == commands(path)
    text = "".join(cell["source"] for cell in made["cells"] if cell["cell_type"] == "markdown")
    assert ".md)" not in text
    assert "pictures/" not in text


def test_the_drawings_of_words_show_what_their_page_says():
    """Newton's errors are on the bound and its NEES is 1; a linear fit is far outside."""
    error, square = word_drawings.estimates(ipe_bench.solvers.Newton(), 1.0)
    linear, _ = word_drawings.estimates(ipe_bench.baselines.LinearLSE(), 1.0)
    assert error.std(axis=0) == pytest.approx(1.0, abs=0.1)
    assert square.mean() == pytest.approx(error.shape[1], rel=0.1)
    assert np.sqrt(np.mean(linear**2)) > 2


FEW = 20
"""Trials of a page's commands in their test: the least that a plan by `power` begins with. What
pages say of many trials is held by the stored experiments and by the tests of its subject."""


def shortened(command: list[str]) -> list[str]:
    """The same command with a few trials where it would simulate many, and with the first of the
    filters that search for the same constants."""
    if any(word.startswith("find=") for word in command):
        return [re.sub(r"^(tracker=\[\w+),.*", r"\1]", word) for word in command]
    as_it_is = ("--dry-run", "write_readings=", "block_size=")
    if command[0] != "run" or any(word.startswith(as_it_is) for word in command):
        return command
    kept = [word for word in command if not word.startswith(("trials=", "precision="))]
    asked = [word for word in command if word.startswith("precision=")]
    # A precision that any twenty trials reach: the command ends as if it were the page's.
    return [*kept, f"trials={FEW}", *["precision=0.7" for _ in asked]]


def typed_before(page: Path) -> list[list[str]]:
    """The commands on readings of the first hour that its page, which is tried too, has."""
    first = PAGES / "first_hour.md"
    return [line for line in commands(first) if "oxygen.csv" in line] if page != first else []


@pytest.mark.slow
@pytest.mark.parametrize(
    "page", [p for p in WRITTEN if blocks(p, "console") or blocks(p, "python")], ids=ids
)
def test_what_a_page_says_to_type_works(page, tmp_path):
    """Its commands in their order, then its blocks of Python, each for itself."""
    write_files(page, tmp_path)
    commanded = [line for line in commands(page) if line not in typed_before(page)]
    programs = [["-m", "ipe_bench", *shortened(line)] for line in commanded]
    programs += [["-c", code] for code in blocks(page, "python")]
    for program in programs:
        done = subprocess.run(
            [sys.executable, *program],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            env=os.environ | {"NO_COLOR": "1"},
            check=False,
        )
        assert done.returncode == 0, f"{program}\n{done.stdout}\n{done.stderr}"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "option"), [("solver", "gain: 1.0"), ("noise", "deviation: 0.01")]
)
def test_the_class_that_a_page_shows_passes_the_check_in_the_plugin_that_it_makes(
    kind, option, tmp_path
):
    name = f"my_{kind}"
    (code,) = blocks(PAGES / "howto" / f"write_{kind}.md", "python")
    program = [sys.executable, "-m", "ipe_bench"]
    subprocess.run([*program, "new", kind, name], cwd=tmp_path, check=True)
    folder = tmp_path / "plugins" / name
    (folder / f"ipe_bench_{name}" / f"{name}.py").write_text(code, encoding="utf-8")
    (config,) = folder.rglob(f"{name}.yaml")
    lines = config.read_text("utf-8")
    config.write_text(re.sub(r"(?m)^(gain|half_width): .*$", option, lines), encoding="utf-8")
    done = subprocess.run(
        [*program, "check", str(folder)], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> tuple[Path, str]:
    """The folder of the site and what its building printed."""
    pytest.importorskip("pydata_sphinx_theme")
    folder = tmp_path_factory.mktemp("site")
    # In a process of its own, as a user builds it: what its libraries will do away with is no error
    # of ours.
    command = [sys.executable, pages.__file__, str(folder), "--trials=1"]
    here = {**os.environ, "PYTHONPATH": str(Path(pages.__file__).parents[1])}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=here)
    assert done.returncode == 0, done.stderr
    return folder / "html", done.stdout


CUT = """[...document.querySelectorAll(
        ".bd-article :is(table, pre, .pst-scrollable-table-container)")]
    .filter(part => part.scrollWidth > part.clientWidth + 1)
    .map(part => part.innerText.slice(0, 60))"""
"""Tables and code of a page that are wider than their place."""


@pytest.mark.slow
@pytest.mark.browser
def test_no_table_and_no_code_is_cut_at_1280_pixels(site, browser):
    folder, _ = site
    for page in folder.rglob("*.html"):
        browser.go(page, width=1280)
        assert browser.run(CUT) == [], page.relative_to(folder)


def dead_links(html: Path) -> Iterator[str]:
    """Yields the links of a site that lead to no file, or to no place on its page."""
    texts = {path.resolve(): path.read_text(encoding="utf-8") for path in html.rglob("*.html")}
    places = {path: set(re.findall(r'\bid="([^"]+)"', text)) for path, text in texts.items()}
    for page, text in texts.items():
        for link in re.findall(r'\b(?:href|src)="(?!\w+:|\{)([^"]+)"', text):
            file, _, anchor = unquote(unescape(link)).partition("#")
            target = (page.parent / file.partition("?")[0]).resolve() if file else page
            if not target.exists() or (anchor and anchor not in places.get(target, {anchor})):
                yield f"{page.name}: {link}"


@pytest.mark.slow
def test_the_whole_site_builds_without_a_warning_and_fetches_nothing(site):
    """Every experiment, and a line about each that runs without a stored result."""
    html, printed = site
    ours = [
        option.name
        for option in discovery.options("experiment")
        if option.source.name == "ipe-bench"
    ]
    assert {"nist", "polynomial"} <= set(ours)
    assert 'href="gallery/ranging.html"' in (html / "choosing.html").read_text(encoding="utf-8")
    assert "100 trials per row" in (html / "howto" / "notebook.html").read_text(encoding="utf-8")
    for name in ours:
        ran = f"{name}: no result of it is stored; it runs now" in printed
        assert ran == (not (pages.STORED / f"{name}{SUFFIX}").exists())
        page = (html / "gallery" / f"{name}.html").read_text(encoding="utf-8")
        assert f"experiment={name}" in re.sub("<[^>]*>", "", page)  # without the marks of colours
        assert "<table" in page
        assert str(html.parent) not in page
    fetched = (
        r"""<(?:script|img|iframe|link(?=[^>]*stylesheet))[^>]*(?:src|href)=["']?(?:https?:)?//"""
    )
    assert list(dead_links(html)) == []
    assert [
        page
        for page in html.rglob("*.html")
        if re.search(fetched, page.read_text(encoding="utf-8"))
    ] == []
