"""Names are shown where texts leave, on a page and in a terminal: neither obeys what they say."""

import contextlib
import csv
import io
import re
import sys

import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure

from ipe_bench.basics.visible import VisibleStream
from ipe_bench.cli.main import main
from ipe_bench.report.figures.svg import page_figure
from ipe_bench.report.progress import counting
from ipe_bench.report.screen import Screen
from ipe_bench.report.tables.table import Strong, Table, plain_text, terminal, words

STYLE = 'x style="fill:red}body{display:none}.q{color:red" transform="rotate(-0 1)" d="1.2345"'
ESCAPES = "\x1b[31mred\x1b[2J\x1b]0;title \x9b1m \u202eback :bug: [bold]"
SHOWN = "\\x1b[31mred\\x1b[2J\\x1b]0;title \\x9b1m \\u202eback :bug: [bold]"


def test_a_name_is_no_style_of_the_page():
    with matplotlib.rc_context({"svg.fonttype": "none"}):
        figure = Figure()
        axes = figure.subplots()
        axes.plot([0, 1], [0, 1], color="#123456", label=STYLE)
        axes.set_xlabel(STYLE)
        axes.legend()
        svg = io.StringIO()
        figure.savefig(svg, format="svg")
    html = page_figure(figure, svg.getvalue())
    (style,) = re.findall("<style>(.*?)</style>", html)
    assert "#123456" in style
    assert "body" not in style
    assert html.count(f">{STYLE}<") == 2


def test_a_terminal_shows_names_and_obeys_only_the_console():
    table = Table("t", "Title", "Caption.", [words("name", [ESCAPES]), words("other", ["b"])])
    written = io.StringIO()
    Screen(file=written, force_terminal=True, width=200, color_system="standard").print(
        terminal([table, Strong(ESCAPES)], 200)
    )
    text = written.getvalue()
    assert "\x1b[1m" in text
    assert set(re.findall(r"\x1b\[[\d;]*.", text)) <= {"\x1b[0m", "\x1b[1m", "\x1b[2m"}
    assert re.findall("[\x9b\u202e]|\x1b[^[]", text) == []
    assert SHOWN in text
    assert SHOWN in plain_text([Strong(ESCAPES)], 200)


@pytest.mark.parametrize("stream", ["out", "err"])
def test_a_command_prints_names_and_obeys_none(stream, monkeypatch, capsys):
    def printing(words: list[str]) -> int:
        print(*words, file=getattr(sys, f"std{stream}"))
        return 0

    monkeypatch.setattr("ipe_bench.cli.main._dispatch", printing)
    assert main([ESCAPES]) == 0
    assert getattr(capsys.readouterr(), stream) == f"{SHOWN}\n"


def test_a_mistake_and_progress_name_what_they_are_about(capsys):
    assert main(["audit", ESCAPES.replace("/", "")]) == 2
    with counting("Title", 0, "lines") as begin:
        begin(ESCAPES)("done")
    written = capsys.readouterr().err
    assert written.count(SHOWN) == 3
    assert "\x1b" not in written


class Glass(io.StringIO):
    """A terminal that keeps what it is sent."""

    def isatty(self) -> bool:
        return True


def test_a_bar_is_drawn_and_what_is_printed_above_it_is_shown(monkeypatch):
    glass = Glass()
    monkeypatch.setenv("TERM", "xterm")
    with contextlib.redirect_stderr(VisibleStream(glass)), counting(ESCAPES, 2) as begin:
        begin("one")(ESCAPES)
        print(f"printed above {ESCAPES}", file=sys.stderr)
        begin("two")("done")
    written = glass.getvalue()
    assert "\x1b[?25l" in written  # the bar hides the cursor
    assert "\u2501" in written
    assert [
        bit for bit in ("\\x1b[0m", "\x9b", "\u202e", "\x1b]", "\x1b[2J") if bit in written
    ] == []
    assert "\\x1b[31mr" in written
    assert "printed above" in written


@pytest.mark.slow
@pytest.mark.filterwarnings("default:Glyph")
def test_the_header_of_a_foreign_table_is_shown(ipe_bench):
    """From the file to the page and the terminal; matplotlib warns of what no font has."""
    for name in (STYLE, ESCAPES):
        with open("table.csv", "w", newline="") as file:
            written = csv.writer(file)
            written.writerow([name, f"{name}_true", f"{name}_std"])
            written.writerows([x, 0, 1] for x in np.random.default_rng(0).normal(size=40))
        code, out, err = ipe_bench("audit", "table.csv", "output=o")
        assert code == 0
        assert "\x1b" not in out + err
        with open("o/audit.html", encoding="utf-8") as page:
            assert all(
                "body{display" not in style
                for style in re.findall("<style>(.*?)</style>", page.read())
            )
