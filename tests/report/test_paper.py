"""What goes into a paper: figures as wide as a column, and tables that a strict reader of LaTeX
accepts."""

from __future__ import annotations

import re

import pandas as pd
import pytest
from shared.reports import HOSTILE, fill

from ipe_bench.basics.errors import UserError
from ipe_bench.report import figures
from ipe_bench.report.paper import export
from ipe_bench.report.tables.table import COLUMN, PAGE, Table, column, interval, latex, words
from ipe_bench.report.words import percent, short
from ipe_bench.statistics import analyse

COMMANDS = {
    *(
        "begin",
        "end",
        "centering",
        "caption",
        "label",
        "footnotesize",
        "setlength",
        "tabcolsep",
        "toprule",
        "midrule",
    ),
    *(
        "bottomrule",
        "endhead",
        "textbf",
        "num",
        "shortstack",
        "ensuremath",
        "mu",
        "sigma",
        "surd",
        "times",
    ),
    *(
        "textasciitilde",
        "textasciicircum",
        "textbackslash",
        "textless",
        "textgreater",
        "infty",
        "textbar",
        "textquotedbl",
    ),
    *("texttt", "textsuperscript", "to", "triangle"),
}
TOKENS = re.compile(r"\\([a-zA-Z]+)|\\([^a-zA-Z])|%[^\n]*\n|([{}])|([^\\{}%]+)")


def read(text: str) -> list[list[str]]:
    """The cells of a table, as they are typeset.

    Fails where a command is not known, a brace is not closed, a sign has a meaning in LaTeX that is
    not meant here, a number is not one of siunitx, or rows differ in their number of cells.
    """
    depth, at, environments = 0, 0, []
    for match in TOKENS.finditer(text):
        assert match.start() == at, text[at : at + 40]
        at = match.end()
        command, sign, brace, plain = match.groups()
        assert command is None or command in COMMANDS, command
        assert sign is None or sign in "&%$#_{},\\"
        depth += {"{": 1, "}": -1}.get(brace or "", 0)
        assert depth >= 0
        assert plain is None or not set(plain) & set("$#_^~"), plain
    assert at == len(text)
    assert depth == 0
    for kind, name in re.findall(r"\\(begin|end)\{([a-z*]+)\}", text):
        if kind == "begin":
            environments.append(name)
        else:
            assert environments.pop() == name
    assert environments == []
    for number in re.findall(r"\\num\{([^}]*)\}", text):
        assert re.fullmatch(r"-?\d+(\.\d+)?(e[+-]?\d+)?", number), number
    rules = re.split(r"\\(?:toprule|midrule|bottomrule)\n", text)
    shape = re.search(r"\{@\{\}([lr]+)@\{\}\}", text)[1]
    rows = [
        row for part in rules[1:3] for row in part.replace("\\endhead\n", "").strip().split("\n")
    ]
    cells = [re.split(r"(?<!\\)&", row.removesuffix(r"\\")) for row in rows]
    assert all(row.endswith(r"\\") for row in rows)
    assert {len(row) for row in cells} == {len(shape)}
    return [[typeset(cell) for cell in row] for row in cells]


def typeset(cell: str) -> str:
    """What a reader sees: a control word swallows the blanks behind it, a control sign does not."""
    cell = re.sub(r"\\(?:num|textbf)\{([^{}]*)\}", r"\1", re.sub(r"\\num\{([^{}]*)\}", r"\1", cell))
    cell = re.sub(r"\\shortstack\[[lr]\]\{(.*)\}", lambda m: m[1].replace(r"\\", " "), cell)
    return re.sub(r"\\([%&#_{}$])", r"\1", cell.replace(r"\,", " ")).strip()


def test_the_reader_refuses_what_latex_would():
    good = latex(Table("t", "T", "C", [words("a", ["b"])], pd.DataFrame()), COLUMN)
    assert read(good) == [["a"], ["b"]]
    for bad in (
        good + "}",
        good.replace("b \\\\", "b & c \\\\"),
        good.replace("b \\\\", "b_1 \\\\"),
        good + "\\foo",
    ):
        with pytest.raises(AssertionError):
            read(bad)


def test_intervals_and_signs_read_as_they_are_meant():
    shares = interval(
        "95 % of it", [0.996, 1.0, float("nan")], [1.0, float("nan"), float("nan")], percent
    )
    numbers = interval("twice", [1.5e-7, -1.25, 0.0], [14520.0, 2.0, 0.00004], short)
    names = words("a & b_c", ["a_b & 50 %", "$x$ {y} #1 ~ ^ \\", "< > µ 中"])
    text = latex(Table("t", "T", "C", [shares, numbers, numbers, names], pd.DataFrame()), COLUMN)
    rows = read(text)
    assert [row[:2] for row in rows] == [
        ["95 % of it", "twice"],
        ["99.6 % to 100 %", "1.5e-7 to 14520"],
        ["\\textgreater{} 100 %", "-1.250 to 2"],
        ["-", "0 to 4.0e-5"],
    ]
    assert [row[3] for row in rows[:2]] == ["a & b_c", "a_b & 50 %"]
    assert r"\texttt{U+4E2D}" in text


def test_tables_say_what_the_report_says_whatever_the_names(synthetic, tmp_path):
    fill(synthetic, labels=("linear_lse", HOSTILE, "$x_1$ & \\frac{a}{b} 50 % ~ ^ # 中 µ"))
    analysis = analyse([synthetic.directory])
    names = ["estimator", "converged", "error_scale", "95_of_efficiency"]
    done = export(analysis, tmp_path, ["all_trials"], names, PAGE)
    assert [path.name for path in done] == ["all_trials.tex"]
    rows = read(done[0].read_text(encoding="utf-8"))
    assert rows[0] == ["estimator", "converged", "error scale", "95 % of efficiency"]
    assert len(rows) == 1 + 9
    own = analysis.summary[analysis.summary["parameter"] == "all"].reset_index(drop=True)
    assert [row[1] for row in rows[1:]] == [percent(v) for v in own["converged"]]
    ends = zip(own["efficiency_capped_low"], own["efficiency_capped_high"], strict=True)
    assert [row[3] for row in rows[1:]] == [f"{short(low)} to {short(high)}" for low, high in ends]


@pytest.mark.slow
def test_a_figure_is_as_wide_as_the_column_and_the_report_stays_as_it_is(
    synthetic, tmp_path, monkeypatch
):
    fill(synthetic)
    analysis = analyse([synthetic.directory])
    monkeypatch.setattr(figures, "FIGURES", ("costs",))
    before, *_ = figures.draw_all(analysis, tmp_path / "a")
    for width in (COLUMN, PAGE):
        done = export(analysis, tmp_path / "p", ["cost_against_accuracy"], width=width)
        names = ["cost_against_accuracy.png", "cost_against_accuracy.pdf", "captions.md"]
        assert [path.name for path in done] == names
        box = re.search(rb"/MediaBox \[ *([\d. ]+) *\]", done[1].read_bytes())
        left, _, right, _ = map(float, box[1].split())
        assert (right - left) / 72 == pytest.approx(width, abs=0.01)
        assert "Cost against accuracy, all trials" in done[2].read_text(encoding="utf-8")
    after, *_ = figures.draw_all(analysis, tmp_path / "b")
    assert before.files[0].read_bytes() == after.files[0].read_bytes()


def test_mistakes_name_what_there_is(synthetic, tmp_path):
    fill(synthetic)
    analysis = analyse([synthetic.directory])
    for names, columns, width, said in (
        (["overveiw"], [], COLUMN, "did you mean overview"),
        (["overview"], ["sucess"], COLUMN, "did you mean success"),
        (["overview"], [], 90.0, "give inches"),
        (["figure_2"], ["success"], COLUMN, "goes with a table"),
    ):
        with pytest.raises(UserError, match=said):
            export(analysis, tmp_path, names, columns, width)


def test_chosen_columns_stand_behind_those_that_tell_rows_apart(synthetic, tmp_path):
    """Of two estimators at two error scales, and an infinite error among numbers."""
    fill(synthetic, labels=("one", "two"), scales=(1.0, 10.0))
    analysis = analyse([synthetic.directory])
    (file,) = export(analysis, tmp_path, ["overview"], ["estimator", "success"])
    header, *rows = read(file.read_text(encoding="utf-8"))
    assert header == ["error scale", "estimator", "success"]
    assert len({tuple(row[:2]) for row in rows}) == len(rows) == 4
    table = Table("t", "T", "", [words("estimator", ["a"]), column("error", [float("inf")], short)])
    assert r"\ensuremath{\infty}" in latex(table)
