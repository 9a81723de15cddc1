"""A model and files of readings without keys are the long form of them, and every mistake is one
line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from ipe_bench.basics.errors import UserError
from ipe_bench.cli import places_and_keys, shorts
from ipe_bench.cli.single import single

T = np.array([0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0])
FILES = {
    "falling.py": "def height(t, h=10.0, v=-1.0):\n    return h + v * t\n",
    "none.py": "x = 3\n",
    "two.py": "def f(t, a=1.0):\n    return a * t\n\n\ndef g(t, a=1.0):\n    return a + t\n",
    "helped.py": "def _half(t):\n    return t / 2\n\n\ndef f(t, a=1.0):\n    return a * _half(t)\n",
    "timed.py": "def f(t=0.0, a=1.0):\n    return a * t\n",
    "kept_back.py": "def f(t, a=1.0, *, temp=20.0):\n    return a * t + temp\n",
    "broken.py": "def f(t, a=1.0:\n    return a\n",
    "car.yaml": "next: {x: x + w}\nnoise: {w: 0.1}\nreadings: {z: x}\ndeviation: {z: 0.5}\n"
    "spread: {x: 2}\n",
    "cart.yaml": "next: {x: x + dt*v, v: v + w}\nnoise: {w: 0.1}\nreadings: {z: x}\n"
    "deviation: {z: 0.5}\nspread: {x: 2, v: 1}\n",
    "clocked.yaml": "next: {x: x + u*t + w}\nnoise: {w: 0.1}\nreadings: {z: x}\ninputs: {u: 1}\n"
    "deviation: {z: 0.5}\nspread: {x: 2}\n",
    "stepped.yaml": "next: {x: x + dt*w}\nnoise: {w: 0.1}\nreadings: {z: x}\nstep: 2\n"
    "deviation: {z: 0.5}\nspread: {x: 2}\n",
    "own.yaml": "next: {x: x + dt*w}\nnoise: {w: 0.1}\nreadings: {z: x}\nconstants: {dt: 2}\n"
    "deviation: {z: 0.5}\nspread: {x: 2}\n",
    "uneven.csv": "time,u,z\n0,1,1\n1,1,2\n4,1,3\n",
    "free.py": "def fall(t, h, v):\n    return h + v * t\n",
    "bare.yaml": "next: {x: x + w}\nreadings: {z: x}\n",
    "wrong.yaml": "next: {x: x + w}\nnoises: {w: 0.1}\nreadings: {z: x}\ndeviation: {z: 0.5}\n"
    "spread: {x: 2}\n",
    "ode.yaml": "rates: {x: -k*x}\nparameters: {k: 1}\n",
    "many.py": "def law(t, k=1.0):\n    y = k * t\n    return k + t, y\n",
    "crossed.py": "def law(t, k=1.0):\n    y, left = k * t, k + t\n    return y, left\n",
    "named.py": "def law(t, k=1.0):\n    x, y = k + t, k * t\n    return y, x\n",
    "long.csv": "t,output,reading\n1,y,1.6\n1,x,1.1\n2,y,1.3\n2,x,1.2\n",
    "longer.csv": "t,output,reading\n1,y,1.6\n1,far,1.1\n2,y,1.3\n2,far,1.2\n",
    "branched.py": "def law(t, k=1.0):\n    def half(t):\n        return t, t, t\n\n"
    "    x, y = k + t, k * t\n    if k > 9:\n        return t, t\n    else:\n        return y, x\n",
    "swapped.py": "def law(t, k=1.0):\n    x, y = k + t, k * t\n"
    "    if k > 9:\n        return y, x\n    return x, y\n",
    "kept.py": "def law(t, k=1.0):\n    both = k * t, k + t\n    return both\n",
    "pairs.csv": "t,x,y\n1,1.1,1.6\n2,1.2,1.3\n3,1.3,1.1\n",
    "three.csv": "t,x,y,z\n1,1.1,1.6,1\n2,1.2,1.3,1\n3,1.3,1.1,1\n",
    "pair.yaml": "rates: {x: a*x, y: -b*y}\nstart: {a: 0.1, b: 0.2}\ninitial: {x: 1, y: 2}\n",
    "pair.csv": "time,x,y\n1,1.1,1.6\n2,1.2,1.3\n3,1.3,1.1\n",
    "weighed.csv": "time,x,y,sigma\n1,1.1,1.6,1\n2,1.2,1.3,1\n3,1.3,1.1,1\n",
    "alone.csv": "time,y\n1,1.6\n2,1.3\n3,1.1\n",
    "warm.csv": "t,volt,temp\n0,1,20\n1,2,21\n2,3.5,22\n",
    "red.yaml": "colour: red\n",
    "listed.yaml": "next: {x: x + u + w}\nreadings: {z: x}\nnoise: {w: 0.1}\ndeviation: {z: 1}\n"
    "spread: {x: 2}\ninputs: [u]\n",
    "lone.yaml": "next: {x: x + w}\nreadings: {z: x}\nnoise: {w: 0.1}\ndeviation: 0.5\n",
    "flat.yaml": "next: x + w\nreadings: {z: x}\n",
    "empty.yaml": "rates: {x: -k*x}\nstart:\n",
    "bare.csv": "1,2\n3,4\n",
    "day.csv": "day,reading\n1,2\n2,3\n3,4\n",
    "volt.csv": "t [s],volt [V]\n0,1\n1,2\n2,3.5\n",
    "circle.csv": "x,y,reading\n1,2,0\n3,4,0\n",
    "log.csv": "z\n1\n2\n3\n",
    "marked.py": "\ufeffdef law(time, k=1.0):\n    return k * time\n",
    "my-data.CSV": "t,reading\n1,2\n2,3\n3,4\n",
    "half.csv": "time,x,y,sigma_y\n1,1.1,1.6,1\n2,1.2,1.3,1\n3,1.3,1.1,1\n",
}


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with models and readings."""
    monkeypatch.chdir(tmp_path)
    rows = [f"{t},{9 - 2 * t + (-1) ** k * 0.1}" for k, t in enumerate(T)]
    FILES["line.csv"] = "\n".join(["t,y", *rows]) + "\n"
    FILES["falling.csv"] = "\n".join(["t,reading", *rows]) + "\n"
    for name, text in FILES.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    (tmp_path / "folder.csv").mkdir()
    (tmp_path / "folder.yaml").mkdir()
    return tmp_path


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["a*t+b", "line.csv"], "start 1 for a, b; measurement.start.a=X"),
        (["a*t+b", "line.csv", "measurement.start.b=-5"], "start 1 for a; start b = -5; meas"),
        (["t*a+b", "line.csv", "measurement.start={a: 2, b: 3}"], "; measurement.start.a=X"),
        (["a*t+b", "line.csv", "measurement.start={a: 2, b: 3}"], "; start a = 2, b = 3; meas"),
        (["falling.py", "falling.csv", "measurement.start.v=-2"], "; start h = 10.0, v = -2."),
    ],
)
def test_the_starts_are_told_with_those_that_are_typed(words: list[str], said: str) -> None:
    assert said in shorts.read("estimate", words).assumed[0]


def test_outputs_below_each_other_are_named_by_the_function() -> None:
    read = shorts.read("estimate", ["named.py", "long.csv"])
    assert "measurement.outputs=['y','x']" in read.words
    assert "column output distinguishes y, x" in read.assumed[1]


@pytest.mark.parametrize(
    ("words", "full"),
    [
        (
            ["falling.py", "falling.csv"],
            "measurement=function measurement.of=falling:height readings='falling.csv'",
        ),
        (
            ["falling.csv", "two.py:g", "seed=3"],
            "measurement=function measurement.of=two:g seed=3 readings='falling.csv'",
        ),
        (
            ["helped.py", "volt.csv"],
            "measurement=function measurement.of=helped:f measurement.reading='volt'"
            " readings='volt.csv'",
        ),
        (
            ["-a*t+b", "line.csv", "measurement.start.b=5"],
            "measurement=formula measurement.expression='-a*t+b' measurement.start.a=1"
            " measurement.start.b=5 readings='line.csv'",
        ),
        (
            ["volt=a*t", "volt.csv"],
            "measurement=formula measurement.expression='a*t' measurement.start.a=1"
            " measurement.reading='volt' readings='volt.csv'",
        ),
        (
            ["(x-a)^2+y^2", "circle.csv"],
            "measurement=formula measurement.expression='(x-a)^2+y^2' measurement.start.a=1"
            " measurement.reading='reading' readings='circle.csv'",
        ),
        (
            ["car.yaml", "readings=log.csv"],
            "state_model=formulas state_model.file=car.yaml state_model.title=car"
            " readings='log.csv'",
        ),
        *(
            (
                [file, "uneven.csv"],
                f"state_model=formulas state_model.file={file} state_model.title={Path(file).stem}"
                f"{times} readings='uneven.csv'",
            )
            for file, times in {
                "cart.yaml": " state_model.inputs.time=0",
                "clocked.yaml": " state_model.inputs.time=0",
                "stepped.yaml": "",
                "own.yaml": "",
                "car.yaml": "",
            }.items()
        ),
        *(
            (
                ["pair.yaml", file, *more],
                "measurement=ode measurement.file=pair.yaml measurement.title=pair"
                f"{noise} readings='{file}'",
            )
            for file, more, noise in [
                ("pair.csv", [], " noise=unknown noise.by=output"),
                ("pair.csv", ["noise.deviation=1"], " noise.deviation=1"),
                ("weighed.csv", [], ""),
                ("half.csv", [], ""),
                ("alone.csv", [], ""),
            ]
        ),
        *(
            (
                [file, "pairs.csv"],
                f"measurement=function measurement.of={file[:-3]}:law measurement.outputs={read}"
                " noise=unknown noise.by=output readings='pairs.csv'",
            )
            for file, read in {"many.py": "['x','y']", "named.py": "['y','x']"}.items()
        ),
        (["measurement=ranging", "my.csv"], "measurement=ranging readings='my.csv'"),
        (
            ["volt*t", "warm.csv", "measurement.start.volt=2", "ignore_columns=[volt]"],
            "measurement=formula measurement.expression='volt*t' measurement.reading='temp'"
            " measurement.start.volt=2 ignore_columns=[volt] readings='warm.csv'",
        ),
        (
            ["marked.py", "weighed.csv", "ignore_columns=[x]"],
            "measurement=function measurement.of=marked:law measurement.reading='y'"
            " ignore_columns=[x] readings='weighed.csv'",
        ),
        (
            ["falling.py", "my-data.CSV"],
            "measurement=function measurement.of=falling:height readings='my-data.CSV'",
        ),
        (
            ["y ~ a*t", "line.csv"],
            "measurement=formula measurement.expression='a*t' measurement.start.a=1"
            " readings='line.csv'",
        ),
    ],
)
def test_a_short_form_is_that_long_form(words: list[str], full: str, folder: Path) -> None:
    (folder / "my.csv").write_text("t\n")
    assert " ".join(shorts.read("estimate", words).in_full) == full


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["falling.py"], "is a model without readings; add their file"),
        (["falling.py", "falling.csv", "v=3"], "v=3: measurement.start.v=3 sets the start, and"),
        (["a*t+b", "line.csv", "b=3"], "b=3: measurement.start.b=3 sets the start, and"),
        (["a*t+b", "line.csv", "measurement.columns.t=[1,2]"], "columns.t: line.csv has the col"),
        (["readings=line.csv", "measurement.columns={t: [1]}"], "columns: line.csv has the col"),
        (["falling.csv"], "no model is given"),
        (["faling.py", "falling.csv"], "faling.py: there is no such file here; did you mean"),
        (["falling.py", "faling.csv"], "faling.csv: there is no such file here; did you mean"),
        (["none.py", "falling.csv"], "has no function; define"),
        (["two.py", "falling.csv"], "or name the model: ipe-bench estimate two.py:f falling.csv"),
        (["two.py:h", "falling.csv"], "there is no such function (there are: f, g)"),
        (["broken.py", "falling.csv"], "broken.py, line 1: SyntaxError"),
        (["falling.py", "bare.csv"], "the first row has only numbers and is no header"),
        (["falling.py", "day.csv"], "day.csv: has no column t, which height(t, h, v) takes"),
        (["falling.py", "two.py", "falling.csv"], "are 2 models; give one"),
        (["a*t", "+", "b", "line.csv"], "put a formula in quotes"),
        (["falling.py", "falling.csv", "measurement=gins"], "and measurement=gins is another"),
        (["a*t+b)", "line.csv"], "is not a formula at ')'"),
        (["a*interp(t, [0, 9], [1, 2])", "line.csv"], "a table is interp(x, x1, y1, x2, y2, ...)"),
        (["a*exq(t)", "line.csv"], "exq(...): there is no such function; did you mean exp?"),
        (
            ["a*tt+b", "line.csv"],
            "no name in the formula is a column (there are t, y); if tt is t: ipe-bench"
            " estimate 'a*t+b' line.csv",
        ),
        (
            ["a*tt+b", "volt.csv"],
            "no name in the formula is a column (there are t, volt); if tt is t: ipe-bench"
            " estimate 'a*t+b' volt.csv measurement.reading=volt",
        ),
        (
            ["a*tt+b", "warm.csv", "measurement.reading=temp"],
            "estimate 'a*t+b' warm.csv measurement.reading=temp 'ignore_columns=[volt]'",
        ),
        (
            ["volt = a*x+b", "warm.csv"],
            "write the column that the readings depend on in the formula of a, x, b",
        ),
        (
            ["a*t+b", "warm.csv"],
            "if that is volt: ipe-bench estimate 'a*t+b' warm.csv measurement.reading=volt"
            " 'ignore_columns=[temp]'",
        ),
        (
            ["volt = a*t", "warm.csv"],
            "ipe-bench estimate 'volt = a*t' warm.csv 'ignore_columns=[tem",
        ),
        (
            ["free.py", "line.csv"],
            "line.csv: has no columns h, v, which fall(t, h, v) takes (there are t, y); rename the"
            " column, or give a parameter its start: as a default in free.py, or by ipe-bench"
            " estimate free.py line.csv"
            " measurement.start.h=1 measurement.start.v=1",
        ),
        (
            ["bare.yaml", "log.csv"],
            "deviation is missing; spread is missing; w is not defined; add each to the file, or:"
            " ipe-bench estimate bare.yaml log.csv 'state_model.deviation={z: 1}'"
            " 'state_model.spread={x: 1}' state_model.noise.w=1",
        ),
        (
            ["wrong.yaml", "log.csv"],
            "noises means nothing (did you mean noise?); its keys are next",
        ),
        (["ode.yaml", "line.csv"], "ode.yaml: parameters means nothing; its keys are rates, start"),
        (["falling", "falling.csv"], "falling: is no model; did you mean falling.py?"),
        (
            ["a*t+b", "line.cvs"],
            "line.cvs: is no file of readings (.csv, .tsv, .txt, .dat, .parquet",
        ),
        (["falling.py", "./my-data.xlsx"], "./my-data.xlsx: cannot be read; save the sheet as CSV"),
        (["falling.py", "my-data.csv.gz"], "my-data.csv.gz: is no file of readings (.csv"),
        (["./my-data.xlsx", "line.csv"], "./my-data.xlsx: is no model; write a function's file"),
        (["free.py", "line.csv", "ignore_columns=[t]"], "leaves out t, which fall(t, h, v) takes;"),
        (["bare.yaml", "log.csv", "output=noise"], "w is not defined; add each"),
        (["bare.yaml", "log.csv", "noise.deviation=1"], "deviation is missing; spread is missing"),
        (["f(t) = a*t+b", "line.csv"], 'write the formula alone, "a*t+b", or behind the name'),
        (["timed.py", "falling.csv"], "the argument t of f(t, a) has a default, which makes it"),
        (
            ["kept_back.py", "warm.csv"],
            "stands behind *, which makes it a constant, and warm.csv has",
        ),
        (
            ["a*t+b", "line.csv", "measurement.start.t=3"],
            "measurement.start.t: makes t a parameter",
        ),
        (["falling.py", "falling.csv", "measurement.start.t=3"], "and falling.csv has a column t"),
        (
            ["named.py", "longer.csv"],
            "names y, far; name them in the order of the arrays: ipe-bench",
        ),
        (
            ["a*t+b", "log.csv"],
            "no name in the formula is a column (there are z); write the",
        ),
        (["gins", "line.csv"], "gins: is not KEY=VALUE; write measurement=gins"),
        (["t+y", "line.csv"], "no column is left for the readings"),
        (["many.py", "three.csv"], "returns 2 arrays, and columns x, y, z are left for them; name"),
        (["crossed.py", "three.csv", "ignore_columns=[z]"], "'measurement.outputs=[y,x]'"),
        (["named.py", "three.csv"], "column z is not in law(t, k), which takes t, y, x; correct"),
        (["red.yaml", "log.csv"], "is no model: it has neither next:"),
        (["listed.yaml", "log.csv"], "inputs has no names with values; write inputs: {u: 0}"),
        (["lone.yaml", "log.csv"], "deviation has no names with values; write deviation: {z: 0.5}"),
        (["flat.yaml", "log.csv"], "next has no names with values; write next: {NAME: x + w}"),
        (["empty.yaml", "log.csv"], "start has no names with values; write start: {NAME: 1}"),
        (["/usr/falling.py", "falling.csv"], "there is no such file"),
        (["a+b*t", "folder.csv"], "folder.csv: is a folder; name a file"),
        (["folder.yaml", "line.csv"], "folder.yaml: is a folder; name a file"),
        (["a+b*t", "older.csv"], "older.csv: there is no such file here"),
        ([".", "line.csv"], ".: is a folder; write a function's file"),
        (["line", "line.csv"], "line: is no model; write a function's file"),
        (["q = a + b*t", "line.csv"], "line.csv has no column q; its columns are t, y"),
        (["q=a+b*t", "volt.csv"], "volt.csv has no column q; its columns are t, volt"),
    ],
)
def test_a_mistake_is_one_line(words: list[str], said: str) -> None:
    with pytest.raises(UserError) as error:
        shorts.read("estimate", words)
    assert said in str(error.value)
    assert "did you mean folder" not in str(error.value)
    assert "\n" not in str(error.value)


def test_a_file_outside_or_under_a_loaded_name_is_refused(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A loaded module of that name would be the model, silently."""
    (folder / "json.py").write_text(FILES["falling.py"])
    with pytest.raises(UserError, match="has the name of a module that Python has loaded"):
        shorts.read("estimate", ["json.py", "falling.csv"])
    (folder / "below").mkdir()
    monkeypatch.chdir(folder / "below")
    with pytest.raises(UserError, match="lies outside of the working folder"):
        shorts.read("estimate", ["../falling.py", "../falling.csv"])


def test_words_without_a_file_stay_what_they_are() -> None:
    words = ["measurement=gins", "newton", "readings=my.csv"]
    assert shorts.read("estimate", words).in_full == words
    assert shorts.read("design", ["readings=10", "by=time"]).in_full == ["readings=10", "by=time"]


@pytest.mark.slow
def test_a_formula_estimates_the_line_of_least_squares(ipe_bench, folder: Path) -> None:
    """Beside NumPy's polynomial fit."""
    code, out, err = ipe_bench("estimate", "a*t + b", "line.csv", "figures=none")
    assert code == 0, err
    assert out.startswith("Model: a*t + b; start 1 for a, b;")
    answer = json.loads((folder / "outputs/estimate-formula/estimate.json").read_text())
    y = 9 - 2 * T + (-1.0) ** np.arange(len(T)) * 0.1
    found = answer["estimators"]["auto"]["estimates"]
    np.testing.assert_allclose([found["a"], found["b"]], np.polyfit(T, y, 1))


@pytest.mark.slow
def test_the_bounds_of_a_design_are_the_standard_errors_of_the_estimate(ipe_bench) -> None:
    """Of a linear model they do not depend on the truth."""
    code, out, err = ipe_bench("design", "a*t + b", "line.csv")
    assert code == 0, err
    y = 9 - 2 * T + (-1.0) ** np.arange(len(T)) * 0.1
    (_, _), C = np.polyfit(T, y, 1, cov=True)
    rows = [line.split() for line in out.splitlines() if line.split()[:1] in (["a"], ["b"])]
    bounds = [float(row[1]) for row in rows]
    np.testing.assert_allclose(bounds, np.sqrt(np.diag(C)), rtol=0.01)
    assert "at the true values of the estimate" in out
    assert "today's at the estimate" in out
    assert "the start" not in out


@pytest.mark.slow
def test_the_posterior_of_ones_own_model_is_compared_with_auto(ipe_bench) -> None:
    """The paper's iteration may end nowhere; a solver that is chosen stands in its place."""
    words = ("posterior", "a*t + b", "line.csv", "trials=1", "particles=100", "baseline=[]")
    _, out, _ = ipe_bench(*words)
    assert "  auto  " in out
    assert "fixed_point" not in out
    _, out, _ = ipe_bench(*words, "solver=[newton]")
    assert "  newton  " in out
    assert "  auto  " not in out


@pytest.mark.slow
@pytest.mark.parametrize("command", ["run", "design", "posterior"])
def test_exact_readings_have_no_noise_to_simulate(ipe_bench, folder: Path, command: str) -> None:
    rows = [f"{t},{2 * t + 1}" for t in range(8)]
    (folder / "exact.csv").write_text("\n".join(["t,y", *rows]) + "\n")
    code, _, err = ipe_bench(command, "a*t + b", "exact.csv")
    assert code == 2
    assert "the residuals are zero" in err


@pytest.mark.parametrize(
    ("text", "reading", "told"),
    [
        ("t (s);h (m);who\n0,5;98,8;A\n1;95,1;\n", "h", "; who, without numbers, left out."),
        ("name,t,remark,h\na,0.5,,98.8\nb,1,windy,95.1\n", "h", "; name, remark, without numbers"),
        ("t [s],h [m]\n0.5,98.8\n1,95.1\n", "h", "; columns t."),
    ],
)
def test_texts_beside_the_readings_are_left_out_and_said(
    text: str, reading: str, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.csv").write_text(text, encoding="utf-8-sig")
    short = shorts.read("estimate", ["a - 4.9*t*t", "own.csv"])
    assert f"measurement.reading='{reading}'" in short.words
    assert told in short.assumed[1]
    question = single("estimate", short.in_full).spec.question(())
    assert question.found.z.tolist() == [98.8, 95.1]


@pytest.mark.parametrize("cells", [("20 °C", "21 °C"), ("<2", "<3"), ("$20", "$21")])
def test_a_column_whose_texts_begin_with_numbers_is_not_left_out(
    cells: tuple[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It may be the readings, with a unit or a sign in each cell, or their dates."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.csv").write_text("t,temperature,volt\n1,{},3.4\n2,{},5.2\n".format(*cells))
    with pytest.raises(UserError, match="columns temperature, volt are not in the formula"):
        shorts.read("estimate", ["a*t", "own.csv"])


def test_repeated_readings_and_scalar_functions_are_refused_with_what_to_write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mm.py").write_text("def rate(S, V=10, K=2):\n    return V * S / (K + S)\n")
    (tmp_path / "enzyme.csv").write_text("S,rep1,rep2\n1,3.4,3.1\n2,5.2,4.8\n")
    with pytest.raises(UserError, match="write them below each other in one column reading, and"):
        shorts.read("estimate", ["mm.py", "enzyme.csv"])
    (tmp_path / "scalar.py").write_text(
        "import math\n\ndef f(t, a=1.0):\n    return a * math.exp(t)\n"
    )
    (tmp_path / "scalar.csv").write_text("t,reading\n1,3.4\n2,5.2\n")
    short = shorts.read("estimate", ["scalar.py", "scalar.csv"])
    with pytest.raises(UserError, match=r"columns \(t\) are arrays .* np.exp in place of math.exp"):
        single("estimate", short.in_full).spec.question(()).checked()


SAID = {
    "return a": "returns one number for all readings; let it return one number per reading",
    "return a if t > 2 else a * t": "write np.where(CONDITION, THEN, ELSE) in place of if",
    "import absent_library": "No module named 'absent_library'; install absent_library, or correct",
}


@pytest.mark.parametrize("number", range(len(SAID)))
def test_what_a_function_of_single_numbers_has_to_be_is_said(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    body, said = [*SAID.items()][number]
    monkeypatch.chdir(tmp_path)
    top = body if body.startswith("import") else ""
    (tmp_path / f"single_{number}.py").write_text(f"{top}\ndef f(t, a=1.0):\n    {body}\n")
    (tmp_path / "own.csv").write_text("t,reading\n1,3.4\n2,5.2\n")
    short = shorts.read("estimate", [f"single_{number}.py", "own.csv"])
    with pytest.raises(UserError) as refused:
        single("estimate", short.in_full).spec.question(()).checked()
    assert said in str(refused.value)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["a*t", "book.xlsx"], "book.xlsx: cannot be read; save the sheet as CSV"),
        (["a*t", "days.csv"], "write dates as numbers, such as days since the first"),
        (["a*t", "line.csv", "start.a=2"], "did you mean measurement.start.a=2?"),
        (["a*t", "line.csv", "--noise", "2"], "write noise=NAME or noise.KEY=2"),
    ],
)
def test_a_mistake_is_told_with_what_to_write(
    ipe_bench, words: list[str], said: str, tmp_path: Path
) -> None:
    (tmp_path / "days.csv").write_text("t,reading\n2024-01-01,1\n2024-01-02,2\n2024-01-05,3\n")
    (tmp_path / "line.csv").write_text("t,reading\n1,1\n2,2\n3,4\n")
    code, _, error = ipe_bench("estimate", *words)
    assert code == 2
    assert said in error


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["y ~ a*t+b", "warm.csv"], "name one of them before the ~"),
        (["y=a*t+b", "warm.csv"], "name one of them before the ="),
        (["y ~ a*t+b", "volt.csv"], "has no column y; its columns are t, volt"),
        (["y=a*t+b", "volt.csv"], "has no column y; its columns are t, volt"),
        (["t ~ a*t+b", "volt.csv"], "the column t is part of the formula"),
        (["t=a*t+b", "volt.csv"], "the column t is part of the formula"),
        (["volt ~ a*t+b", "volt.csv", "measurement.reading=t"], "measurement.reading=t"),
        (["volt ~ a*t+b", "volt.csv", "ignore_columns=volt"], "is left out by ignore_columns"),
        (["sigma ~ a*time+b", "weighed.csv"], "has the standard deviations"),
    ],
)
def test_no_other_column_is_read_than_the_one_that_a_formula_names(
    words: list[str], said: str
) -> None:
    with pytest.raises(UserError) as caught:
        shorts.read("estimate", words)
    assert said in str(caught.value)


@pytest.mark.parametrize(
    ("words", "outputs"),
    [
        (["branched.py", "pairs.csv"], "['y','x']"),
        (["kept.py", "pairs.csv", "measurement.outputs=[y,x]"], "['y','x']"),
    ],
)
def test_arrays_that_a_function_returns_somewhere_have_their_columns(
    words: list[str], outputs: str
) -> None:
    assert f"measurement.outputs={outputs}" in shorts.read("estimate", words).words


def test_arrays_in_two_orders_are_refused() -> None:
    with pytest.raises(UserError, match="name theirs in order"):
        shorts.read("estimate", ["swapped.py", "pairs.csv"])


def test_a_folder_does_not_hide_a_key(folder: Path) -> None:
    for name in ("level=0.9", "error_scale=10"):
        (folder / name).mkdir()
    words = ["error_scale=10", "level=0.9"]
    found = places_and_keys("compare", words, {"level": float})
    assert found == (["error_scale=10"], {"level": 0.9})
    assert places_and_keys("compare", ["./level=0.9"], {"level": float})[0] == ["./level=0.9"]
