"""The report is complete, says what the data say, and shows hostile names without obeying them."""

from __future__ import annotations

import csv
import io
import json
import re
from dataclasses import replace
from html import unescape

import numpy as np
import pandas as pd
import pytest
from markupsafe import escape
from rich.console import Console
from shared.reports import HOSTILE, fill
from shared.synthetic_store import Seeker, Synthetic

from ipe_bench.api import report as write_report
from ipe_bench.noise import Quantization
from ipe_bench.report import figures
from ipe_bench.report.page.headline import about, headline
from ipe_bench.report.page.html import DEFINITIONS, render_page
from ipe_bench.report.tables.reports import all_tables
from ipe_bench.report.tables.settings import Wording
from ipe_bench.report.tables.table import (
    Strong,
    Table,
    column,
    comma_separated,
    html,
    latex,
    markdown,
    sort_key,
    terminal,
    texts,
    words,
)
from ipe_bench.report.tables.terminal import _physical, reported, summary_tables
from ipe_bench.report.words import brief, compact, cost, duration, percent, short
from ipe_bench.statistics import analyse
from ipe_bench.statistics.records import SCORES, STATISTICS
from ipe_bench.statistics.statistic import frame_columns


def shown_at(width: int, *parts) -> list[str]:
    """The lines of tables and sentences in a terminal."""
    out = io.StringIO()
    Console(file=out, width=width).print(terminal(parts, width))
    return [line.rstrip() for line in out.getvalue().splitlines()]


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    store = Synthetic(tmp_path_factory.mktemp("report") / "store")
    fill(store, scales=(1.0, 10.0), seeds=5)
    return write_report([store.directory], store.directory, figures="main", formats="pdf,md,tex")


def test_what_is_written_is_whole_and_the_page_stands_alone(result):
    assert result.problems == ()
    stored = pd.read_csv(result.summary_path.with_name("summary_all.csv"))
    pd.testing.assert_frame_equal(stored, result.summary, check_exact=False, rtol=1e-12)
    main = pd.read_csv(result.summary_path)
    parameters = pd.read_csv(result.summary_path.with_name("parameters.csv"))
    assert set(main["parameter"]) == {"all"}
    assert "all" not in set(parameters["parameter"])
    # The line of the changelog that gives all rows of earlier versions.
    keys = ["error_scale", "estimator", "parameter"]
    both = pd.concat([main, parameters]).sort_values(keys, ignore_index=True)
    earlier = stored[list(main)].sort_values(keys, ignore_index=True)
    pd.testing.assert_frame_equal(both, earlier, rtol=5e-4)
    assert {len(f"{abs(v):.12g}".replace(".", "").strip("0")) for v in main["rmse_solved"]} <= {
        1,
        2,
        3,
        4,
    }
    assert {
        "success_low",
        "rmse_solved_low",
        "nees_mean",
        "simulations_mean",
        "verdict",
        "may_be_best",
    } < set(main)
    assert "rmse_solved_high" in set(stored) - set(main)
    assert len(list(main)) < 35
    assert {p.name for p in result.figures} >= {f"headline.{kind}" for kind in ("png", "pdf")}
    assert {p.name for p in result.tables} >= {
        "parameters.csv",
        "overview.md",
        "overview.tex",
        "comparisons.tex",
    }
    for path in (*result.figures, *result.tables, result.report):
        assert path.stat().st_size > 100
    assert not list(result.report.parent.rglob("*.tmp"))
    page = result.report.read_text(encoding="utf-8")
    # It shows nothing but what is in it; it leads to the figures' files beside it, as far as there
    # are any.
    assert not re.search(r"""src\s*=\s*["'](?!data:)""", page)
    led_to = set(re.findall(r"""href\s*=\s*["'](?!data:|#)([^"']*)""", page))
    assert led_to == {f"figures/{path.name}" for path in result.figures}
    assert "http" not in re.sub(r"base64,[^\"]*|http-equiv", "", page)
    analysis, shown = (
        analyse([result.report.parent]),
        page.replace("&#39;", "'").replace("\u00a0", " "),
    )
    shown = shown.replace("<wbr>", "")
    finding, matrix, *sentences = headline(analysis)
    told = [getattr(sentence, "text", sentence) for sentence in sentences]
    assert all(sentence in shown for sentence in (finding, *told, *about(analysis)))
    assert f'id="table-{matrix.name}"' in shown


def test_survivors_are_shown_as_survivors(synthetic):
    """One trial of 200 is solved, and by luck well: its errors have no interval, their number
    beside them, and all trials' errors in the next column; who solves nothing has those alone."""
    rng = np.random.default_rng(3)
    e = 0.1 * rng.normal(size=(200, 3))
    solved = np.arange(200) == 7
    scenario = synthetic.scenario(error_scale=1000.0)
    synthetic.add(
        scenario, "lucky", np.where(solved[:, None], e, 1e6), solved=solved, estimator=Seeker()
    )
    synthetic.add(scenario, "steady", 3 * e, estimator=Seeker(option=1))
    synthetic.add(scenario, "filter", 3 * e)
    analysis = analyse([synthetic.directory])
    total = analysis.summary[analysis.summary["parameter"] == "all"].set_index("estimator")
    assert np.isnan(
        total.loc["lucky", ["rmse_solved_low", "rmse_solved_high", "efficiency_solved_low"]].astype(
            float
        )
    ).all()
    assert total.loc["lucky", "efficiency_capped"] == pytest.approx(0.2, rel=0.01)
    assert total["efficiency_capped"]["steady"] == total["efficiency_capped"]["filter"]
    tables = {
        t.name: {c.title: [cell.text for cell in c.cells] for c in t.columns}
        for t in all_tables(analysis)
    }
    solved, overview = tables["solved_trials"], tables["overview"]
    at = solved["estimator"].index
    assert solved["efficiency"][at("lucky")].endswith(" (1)")
    assert "(" not in solved["efficiency"][at("steady")]
    assert "filter" not in solved["estimator"]
    # Where everybody stands in one column, it is over the same trials for everybody.
    at = overview["estimator"].index
    assert overview["efficiency"][at("filter")] == overview["efficiency"][at("steady")]
    # One over the cap, where nearly all are capped: a limit.
    assert overview["efficiency"][at("lucky")] == "<0.20"
    assert not any(
        "-" in text for title in ("efficiency", "NEES", "error") for text in overview[title]
    )


def test_nothing_stored_gives_a_page_that_says_so(tmp_path):
    (tmp_path / "runs").mkdir()
    result = write_report([tmp_path], tmp_path / "out")
    assert "No trials yet" in result.report.read_text(encoding="utf-8")
    assert result.figures == ()
    assert len(result.problems) == 1


@pytest.mark.parametrize("figures", ["main", pytest.param("all", marks=pytest.mark.slow)])
def test_hostile_names_are_shown_and_not_run(synthetic, figures):
    labels = ("linear_lse", HOSTILE, "$x_1$ & \\frac{a}{b} | *b*")
    fill(synthetic, labels=labels, names=(HOSTILE, "_b%", "c#~^\u03b1"), scales=(1.0, 10.0))
    result = write_report([synthetic.directory], synthetic.directory / "out", figures=figures)
    drawn = {path.stem for path in result.figures}
    assert figures == "main" or {"headline", "calibration"} <= drawn
    page = result.report.read_text(encoding="utf-8")
    assert HOSTILE not in page
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in page
    assert page.count("<script") == 1
    for path in (path for path in result.tables if path.suffix == ".md"):
        text = path.read_text(encoding="utf-8")
        assert "<script>" not in text
        assert (
            len(
                {
                    len(re.findall(r"(?<!\\)\|", line))
                    for line in text.splitlines()
                    if line.startswith("|")
                }
            )
            == 1
        )


def test_a_record_is_all_that_a_statistic_needs(result):
    """Its column, its definition, and its heading in every table that it names, the terminal's
    among them."""
    page = result.report.read_text(encoding="utf-8")
    tables = {t.name: t for t in all_tables(analyse([result.report.parent]))}
    rows = result.summary.to_dict("records")
    shown = "\n".join(shown_at(300, *summary_tables(rows, None, 300)))
    for record in (*STATISTICS, *SCORES):
        assert DEFINITIONS[record.title] == record.definition
        assert str(escape(record.definition)) in page
        for where in record.where if record in SCORES or reported(record, rows) else ():
            headings = [record.titles.get(where, record.title), record.limits_titles.get(where, "")]
            if where == "terminal":
                assert all(h in shown for h in headings)
            elif where in tables:
                assert {*headings, ""} <= {*(c.title for c in tables[where].columns), ""}
    assert set(frame_columns(STATISTICS)) <= set(result.summary.columns)


def test_numbers_are_written_for_readers():
    shares = [percent(v) for v in (1.0, 0.9999, 0.974, 0.0, 0.0001, float("nan"))]
    assert shares == ["100 %", ">99.9 %", "97.4 %", "0 %", "<0.1 %", "-"]
    assert [short(v) for v in (1.00234, 14520.3, 3.0, float("inf"))] == [
        "1.002",
        "14,520",
        "3",
        "inf",
    ]
    # A median difference is below every number where the second alone is infinitely wrong.
    for shown in (short, brief, compact):
        assert [shown(v) for v in (float("-inf"), float("nan"))] == ["-inf", "-"]
    assert [float(sort_key(v)) for v in (float("-inf"), -2.5, float("nan"))] == [
        -np.inf,
        -2.5,
        np.inf,
    ]
    assert sort_key(-np.inf) == "-1e999"
    assert [duration(v) for v in (2.0, 0.0123, 9.4e-6)] == ["2.00 s", "12.3 ms", "9.40 µs"]
    assert [duration(v, 2) for v in (0.00096, 0.123, 0.9996, 0.0)] == [
        "960 µs",
        "120 ms",
        "1.0 s",
        "0 s",
    ]
    # The mean stands behind a median from which it differs by more than a twentieth, to either
    # side.
    assert [cost(100.0, v) for v in (60.0, 96.0, 104.0, 250.0)] == [
        "100/60",
        "100",
        "100",
        "100/250",
    ]
    assert [compact(v) for v in (0.945, 12195, 999.7, 1.6e6, 3e-5)] == [
        "0.945",
        "12.2k",
        "1.00k",
        "1.60M",
        "3.0e-5",
    ]


@pytest.mark.slow
def test_settings_that_differ_have_figures_of_their_own(synthetic, tmp_path, monkeypatch):
    rng = np.random.default_rng(1)
    gaussian = [synthetic.scenario(sigma=s, error_scale=e) for s in (0.2, 0.4) for e in (1.0, 10.0)]
    synthetic.bound = lambda scenario: np.full(3, 0.1)
    for scenario in (*gaussian, *(replace(s, noise=Quantization(0.7)) for s in gaussian[:2])):
        synthetic.add(scenario, "one", 0.1 * rng.normal(size=(40, 3)))
    monkeypatch.setattr(figures, "FIGURES", ("costs",))
    result = write_report([synthetic.directory], tmp_path / "out", figures="all")
    kind = "cost_against_accuracy_"
    settings = {
        path.stem.removeprefix(kind) for path in result.figures if path.stem.startswith(kind)
    }
    assert settings == {"gaussian-0.2", "gaussian-0.4", "quantization"}
    page = re.sub(r'base64,[^"]*', "", result.report.read_text(encoding="utf-8"))
    assert not re.search(r"\bnan\b", page)


def test_rows_of_equal_settings_each_have_a_dash():
    differing = Wording.of(None).settings
    small = {"size": 1.0, "shape": "round"}
    large = {"size": 2.0, "shape": "round"}
    columns = ["size", "shape"]
    assert differing([small, small], columns) == differing([small, small], []) == ["-", "-"]
    assert differing([small, large], columns) == ["size=1", "size=2"]


def test_of_many_settings_the_most_frequent_values_are_not_told():
    options = {"size": 1.0, "shape": "round", "colour": "red"}
    others = [{"size": 2.0}, {"shape": "square"}, {"colour": "blue"}, {}, {"size": None}]
    rows = [options | other for other in others]
    told = ["size=2", "shape=square", "colour=blue", "-", "-"]
    assert Wording.of(None).settings(rows, list(options)) == told


def test_every_renderer_has_every_cell():
    """Cells that the CSV file has stand in the same order in every other form of a table."""
    columns = [
        words("name", ["a_b", "c & d", HOSTILE]),
        column("value", [1.5, 2.0, 3.25], short, [False, True, False]),
    ]
    table = Table("t", "Title", "Caption.", columns, notes=["Note."])
    rows = [["a_b", "1.500"], ["c & d", "2"], [HOSTILE, "3.250"]]
    assert list(csv.reader(io.StringIO(comma_separated(table)))) == [["name", "value"], *rows]
    lines = shown_at(80, table)
    places = [
        next(i for i, line in enumerate(lines) if line.split() == " ".join(row).split())
        for row in rows
    ]
    assert places == sorted(places)
    page = html([table, Strong("Stands out"), "does not"])
    cells = re.findall(r"<td[^>]*>(?:<b>)?(.*?)(?:</b>)?</td>", page)
    assert [unescape(text.replace("<wbr>", "")) for text in cells] == [
        cell for row in rows for cell in row
    ]
    assert HOSTILE not in page
    assert "<b>2</b>" in page
    assert "<b>Stands out</b>" in page
    assert re.findall(r"^\| (\S.*?) \| (\S*?) \|$", markdown(table), re.MULTILINE)[2] == (
        "c & d",
        "**2**",
    )
    assert r"c \& d & \textbf{\num{2}} \\" in latex(table)
    # An interval has a dash, and no negative end.
    texts = {1.0: "100 (93-100)", 2.0: "-3-4"}
    ends = Table("ends", "Ends", "", [column("95 %", texts, texts.__getitem__)])
    assert r"\num{100} (\num{93}--\num{100}) \\" in latex(ends)
    assert r"\num{-3}--\num{4} \\" in latex(ends)
    assert r"\caption{Ends.}" in latex(ends, width=3.5)
    for text in (page, markdown(table), "\n".join(lines)):
        assert "Note." in text


def test_what_a_terminal_has_no_room_for_is_named_with_its_file_or_goes_below():
    columns = [
        words("estimator", ["one", "one", "two"]),
        *(texts(f"value {i}", ["1234567890"] * 3) for i in range(9)),
    ]
    left = shown_at(60, replace(Table("t", "T", "", columns), grouped=1, whole="all.csv"))
    named = re.search(r"Not shown for lack of width: (.*); see all.csv.", " ".join(left))[1].split(
        ", "
    )
    head = next(line for line in left if "estimator" in line)
    assert re.findall(r"value \d", head) + named == [f"value {i}" for i in range(9)]
    assert sum(line.split()[:1] == ["one"] for line in left) == 1  # once a group
    below = shown_at(60, replace(Table("t", "T", "", columns)))
    assert sum("estimator" in line for line in below) > 1
    assert re.findall(r"value \d", " ".join(below)) == [f"value {i}" for i in range(9)]
    assert max(map(len, left + below)) <= 60


def _luminance(color: str) -> float:
    """Relative luminance (WCAG 2.1)."""
    rgb = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def test_words_show_on_the_dark_ground(synthetic):
    """A contrast of 4.5 at least, as WCAG 2.1 asks of text; the ground is the one that the page
    has."""
    fill(synthetic)
    analysis = analyse([synthetic.directory])
    style = render_page(analysis, all_tables(analysis), []).partition("</style>")[0]
    dark = style[style.index("prefers-color-scheme: dark") :]
    ground, *words = (
        _luminance(re.search(rf"--{name}: (#\w+)", dark)[1]) for name in ("ground", "ink", "soft")
    )
    assert (min(words) + 0.05) / (ground + 0.05) > 4.5


def test_the_page_says_which_commands_computed_what_it_shows(synthetic):
    """One entry for the jobs of a sweep; none for a run that found everything stored."""
    fill(synthetic)
    record = json.loads(
        next((synthetic.directory / "runs").glob("*.json")).read_text(encoding="utf-8")
    )
    record = {k: v for k, v in record.items() if k not in ("schema", "file", "run", "digest")}
    for name, command, blocks in (
        ("b", "ipe-bench run -m error_scale=1,10", 2),
        ("c", "ipe-bench run -m error_scale=1,10", 1),
        ("d", "ipe-bench run that finds it all", 0),
        ("e", None, 3),
    ):
        synthetic.store.write_run(name, record | {"command": command, "blocks": blocks})
    analysis = analyse([synthetic.directory])
    page = render_page(analysis, all_tables(analysis), [])
    assert page.count('<details class="run">') == 3
    assert page.count("<code>ipe-bench run -m error_scale=1,10</code>") == 2
    assert "finds it all" not in page
    assert page.count("from Python") == 1


def test_a_command_that_is_run_again_is_the_last(synthetic):
    fill(synthetic)
    record = json.loads(
        next((synthetic.directory / "runs").glob("*.json")).read_text(encoding="utf-8")
    )
    record = {k: v for k, v in record.items() if k not in ("schema", "file", "run", "digest")}
    for k, name in enumerate("abcda"):
        again = {"command": f"ipe-bench run name={name}", "started": f"2030-01-0{k + 1}T00:00:00"}
        synthetic.store.write_run(f"z{k}", record | again)
    analysis = analyse([synthetic.directory])
    page = render_page(analysis, all_tables(analysis), [])
    told = re.findall(r'<details class="run"><summary>(.{10}).*name=(\w)', page)
    assert told[:4] == [(f"2030-01-0{day}", name) for day, name in zip("5432", "adcb", strict=True)]


def test_a_figure_of_a_plugin_is_shown_whatever_its_name_begins_with(synthetic):
    fill(synthetic)
    analysis = analyse([synthetic.directory])
    ours = figures.Drawn("success_gins", "Ours", "", (), "<svg/>", False, "success")
    names = ("success_map", "matrix_x", "tracks_lost")
    theirs = [figures.Drawn(name, name, "", (), "<svg/>", False, name) for name in names]
    page = render_page(analysis, all_tables(analysis), [ours, *theirs])
    assert all(name in page for name in names)
    assert "Ours" not in page


def test_physical_numbers_of_any_size_have_three_figures_and_what_is_not_finite_a_word():
    shown = [_physical(value) for value in (1.5e-7, 2.0e6, 12.345, np.inf, np.nan)]
    assert shown == ["1.50e-7", "2e6", "12.3", "inf", "-"]


def test_a_single_trial_has_rows_of_costs_and_of_all_trials(synthetic):
    synthetic.add(synthetic.scenario(), "one", np.full((1, 3), 0.1), estimator=Seeker())
    synthetic.record(1)
    tables = {table.name: table for table in all_tables(analyse([synthetic.directory]))}
    assert len(tables["costs"]) == len(tables["all_trials"]) == 1
