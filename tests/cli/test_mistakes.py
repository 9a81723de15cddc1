"""Hundreds of wrong command lines and broken plugins: each answered in one line, and none taken
without a word."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

from ipe_bench.cli.main import main
from ipe_bench.plugins import discovery as plugins

LONG = "x" * 300
GROUPS = ("measurement", "noise", "prior", "execution", "truth_measurement")
ESTIMATORS = ("solver", "baseline")
KEYS = {
    "trials": (
        "null",
        "many",
        "1.5",
        "[1]",
        "{a: 1}",
        "true",
        "0",
        "-1",
        "99999999999",
        "1e400",
        "nan",
        "''",
    ),
    "block_size": ("null", "many", "1.5", "[1]", "0", "-5", "inf"),
    "seed": ("null", "first", "1.5", "[]", "-1", "99999999999999999999"),
    "error_scale": (
        "null",
        "big",
        "[1,2]",
        "0",
        "-1",
        "nan",
        "inf",
        "-inf",
        "1e101",
        "1e308",
        "true",
    ),
    "figures": ("null", "some", "1", "[all]", "true"),
    "formats": ("null", "tiff", "1", "[]", "''", "{a: 1}", "[png,eps]", "true"),
    "write_readings_trial": ("null", "1.5", "-1", "3", "last"),
    "name": ("", ".", "..", "null", "[a]", "{a: 1}"),
    "output": (
        "",
        ".",
        "null",
        "[a]",
        LONG,
        "/proc/x",
        "/dev/null/x",
        "${nothing}",
        "'${nothing}'",
        "loop/x",
    ),
    "estimators": ("null", "5", "[newton]", "newton", "{}"),
    "readings": ("absent.csv", "/", LONG),
}
OPTIONS = {
    "estimators.fixed_point": ("3", "null", "[1]", "newton"),
    "estimators.fixed_point.max_iterations": ("0", "-1", "1.5", "many", "[1]", "true", "null"),
    "estimators.fixed_point.tolerance": ("0", "-1", "nan", "inf", "small", "[1]", "null"),
    "estimators.fixed_point.start": ("here", "1", "null", "[nominal]"),
    "estimators.fixed_point._target_": (
        "ipe_bench.solvers.Newton",
        "os.system",
        "5",
        "ipe_bench.solvers.Newtn",
    ),
    "estimators.newton.tolerance": ("1e-3",),
    "noise.step": ("0", "-1", "nan", "inf", "wide", "[1]"),
    "noise._target_": (
        "os.system",
        "null",
        "5",
        "ipe_bench.measurements.Gins",
        "ipe_bench.noise.Nothing",
    ),
    "noise.nothing": ("1",),
    "measurement.nothing": ("1",),
    "prior.deviations": ("abc", "[1,2]", "[-1]", "[a]", "5"),
    "execution.workers": ("0", "-1", "1.5", "many", "[1]"),
    "execution.memory_limit_gb": ("0", "-1", "nan", "1e400", "much", "1e12"),
    "execution.block_timeout_s": ("0", "-1", "inf", "long"),
    "hydra.mode": ("NOPE", "5"),
    "hydra.nothing": ("1",),
    "trails": ("3",),
    "a.b": ("3",),
}
# fmt: off
CHOICES = (
    "null", "5", "1.5", "true", "[]", "[null]", "[1]", "{a: 1}", "../noise/none", "nothing", "''",
    LONG, "a/b", "*",
)
FLAGS = {
    "run": (
        "--trials=5", "-x", "--verbose", "-make", "--cfg", "--cfg nope", "-i nope", "--resolve",
        "-m --cfg job",
        "--config-dir=/nope", "-cd /nope", "-cp /nope", "-cn nope", "--experimental-rerun nope",
        "-sc",
        "-sc install=nope", "-sc install=bash uninstall=bash", "-sc query=bash", "--dry", "-r -m",
        "--multirun=5",
        "-c job -p",
    ),
    "estimate": (
        "-m", "--cfg job", "-x", "--dry-run", "trials=5", "seed=1", "block_size=5", "formats=pdf",
        "execution=serial",
        "truth_measurement=gins", "write_readings=x.csv", "readings=absent.csv", f"readings={LONG}",
        "readings=/",
        "",
    ),
    "report": (
        "", "-x", "nowhere", ".", LONG, "--output=x", "loop",
    ),
    "status": (
        "", "-x", "nowhere", ".", LONG, "loop", "-v",
    ),
    "list": (
        "-x", "solvers", "solver nothing", "--verbos", "-v=3", "solver/newton/x", "../conf",
    ),
    "new": (
        "", "solver", "solver a b", "nothing x", "solver Abc", "solver 1a", "solver ../x",
        f"solver {LONG}",
        "solver class", "solver newton", "noise gaussian", "solver -x", "solver ü", "solver a/b",
        "solver a-b",
    ),
    "check": (
        "", "nowhere", ".", "-x", "loop", LONG,
    ),
}
SYNTAX = (
    "trials", "+", "~", "=5", "+=5", "~=", "solver=[newton", "solver=newton]", "a=b=c",
    "output=out/ünï", "trials=5,",
    "trials=,5", "error_scale=1,,2", "error_scale=(1,2)", "x@y@z=3", "output=a{b", "name='a",
    'name="a', "++",
    "~~trials", "error_scale=range(1", "solver=[newton,,ekf]", "name=a(b)", "trials:5", "@x=3",
    "solver=[[newton]]",
)
SWEEPS = ("error_scale=1,2", "seed=range(0,3)", "measurement=gins,ranging",
          "solver=[newton],[fixed_point]")
BAD_SWEEPS = (
    "error_scale=range(1,nan)", "error_scale=range(1,inf)", "seed=range(0,1000000000)",
    "seed=range(3,0)",
    "error_scale=range(1,2,0)", "error_scale=interval(1,2)", "measurement=glob(nothing*)",
    "noise=nothing,none",
    "measurement=gins,gims", "solver=[newton],[newtn]", "solver=[newton,newton],[newton]",
    "+experiment=paper,nist",
    "error_scale=1,-1 trials=1 output=/proc/x", "error_scale=choice()", "hydra/launcher=joblib",
    "hydra/sweeper=optuna",
)
PLACES = (
    "+noise@estimators.x=gaussian", "+measurement@estimators.x=polynomial", "+solver@x=newton",
    "solver@estimators.x=newton", "+solver@estimators=newton", "+solver@estimators.a.b=newton",
    "+solver@estimators.fixed_point=newton", "+baseline@estimators.fixed_point=ekf",
    "+solver@estimators.truth=newton",
    "noise@prior=gaussian", "+nothing@x=y", "+measurement=gins", "+noise=gaussian",
    "+execution=serial",
    "+truth_measurement=gins", "experiment=paper", "+experiment=nothing", "+experiment=null",
    "+experiment=[paper]",
    "+experiment=paper +experiment=nist", "solver=[newton,newton]", "solver=['newton',newton]",
    "solver=[newton] +baseline@estimators.newton=ekf", "solver=[] baseline=[]",
    "execution=serial execution.workers=2",
    "noise=certified",
)
DELETED = (
    "trials", "seed", "name", "output", "noise", "measurement", "prior", "execution", "estimators",
    "truth_measurement",
    "noise.step", "solver.x", "experiment", "nothing", "noise=quantization",
)
# fmt: on


def command_lines() -> dict[str, list[str]]:
    """Each wrong command line as its words, by the line."""
    lines: list[list[str]] = []
    for key, values in {**KEYS, **OPTIONS}.items():
        lines += [["run", f"{key}={value}"] for value in values]
    for group in (*GROUPS, *ESTIMATORS):
        choices = [c for c in CHOICES if (group, c) not in HARMLESS]
        lines += [["run", f"{group}={choice}"] for choice in choices]
        lines += [
            ["run", f"{group}=[{choice},newton]"]
            for choice in ("null", "5", "nothing", "../x", "[]")
        ]
    lines += [[command, *words.split()] for command, several in FLAGS.items() for words in several]
    lines += [["run", word] for word in SYNTAX]
    lines += [["estimate", "measurement=nist/misra1a", word] for word in SYNTAX]
    lines += [["run", word] for word in SWEEPS]
    lines += [["run", "-m", *words.split()] for words in BAD_SWEEPS]
    lines += [["run", *words.split()] for words in PLACES]
    lines += [["run", f"~{key}"] for key in DELETED]
    lines += [
        [word]
        for word in (
            "rum",
            "--nope",
            "-x",
            "runs",
            "Run",
            "",
            " ",
            LONG,
            "-sc",
            "--shell-completion=x",
        )
    ]
    return {
        " ".join(line)[:90] + (f" ({len(line[-1])})" if len(" ".join(line)) > 90 else ""): line
        for line in lines
    }


HARMLESS = {("truth_measurement", "null"), ("solver", "[]"), ("baseline", "[]")}
"""Choices that are none: another group still has an estimator, or nothing simulates apart."""
LINES = command_lines()


@pytest.fixture
def answer(monkeypatch, capsys, tmp_path):
    """The exit code and the lines on stderr of a command that runs in this process."""
    for variable in (
        "HYDRA_FULL_ERROR",
        "OPENBLAS_NUM_THREADS",
        "OMP_NUM_THREADS",
        "MKL_NUM_THREADS",
        "PYTHONPATH",
    ):
        monkeypatch.setenv(variable, "1" if variable != "PYTHONPATH" else "")
    monkeypatch.delenv("COMP_LINE", raising=False)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(plugins, "_added", {})
    monkeypatch.chdir(tmp_path)
    (tmp_path / "loop").symlink_to("loop")

    def run(*words: str) -> tuple[int, list[str]]:
        monkeypatch.setattr(sys, "argv", ["ipe-bench"])
        plugins.sources.cache_clear()
        capsys.readouterr()
        code = main(list(words))
        written = capsys.readouterr()
        print(written.out)  # shown where a test fails
        return code, [line for line in written.err.splitlines() if line.strip()]

    return run


def stored(folder: Path) -> list[Path]:
    return list(folder.rglob("*.parquet"))


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (
            "error_scale=100,1000",
            "error_scale=100,1000: is a sweep; add -m for a job of each error_scale",
        ),
        ("solver=newton,auto", "solver=newton,auto: is a sweep; add -m, or put a list in brackets"),
        ("-m hydra.sweeper.params={error_scale:1}", "give each key by itself, as in hydra.sweep"),
        ("solver=[newton, auto]", "solver=[newton,: the brackets do not match; close each, and"),
        ("solver.x={a:1", "the brackets do not match; close each, and quote the whole word"),
        (
            "solver=newton&auto",
            "needs quotes that reach ipe-bench, such as \"solver='newton&auto'\"",
        ),
    ],
)
def test_a_word_that_cannot_be_read_is_told_a_right_one(answer, words, line):
    code, (said,) = answer("run", *words.split())
    assert code == 2
    assert line in said


def test_there_are_four_hundred_wrong_command_lines():
    assert len(LINES) >= 400


def one_in(count: int, cases: Iterable[str], rest: pytest.MarkDecorator) -> list[Any]:
    """The cases, of which the quick tests try one of so many."""
    return [
        pytest.param(case, marks=() if i % count == 0 else rest) for i, case in enumerate(cases)
    ]


@pytest.mark.parametrize("line", one_in(16, LINES, pytest.mark.campaign))
def test_a_wrong_command_line_is_answered_in_one_line(answer, tmp_path, line):
    code, error = answer(*LINES[line])
    assert code == 2
    assert len(error) == 1
    assert error[0].startswith("ipe-bench: ")
    assert not any(
        word in error[0]
        for word in ("Traceback", "Lexer", "Hydra", "omegaconf", "in struct", "NoneType")
    )
    assert len(error[0]) < 1500
    assert stored(tmp_path) == []


YAML = "# @package estimators.bad\n# A broken solver.\n_target_: {package}.Bad\n"
CODE = """
from dataclasses import dataclass, field
from ipe_bench import IPE
from ipe_bench.solvers import State

@dataclass(frozen=True)
class Bad(IPE):
    {fields}

    def step(self, system, state):
        {step}
        x = state.x - state.F
        return State(x, system.F(x))
"""


def config(text: str) -> dict[str, str | bytes]:
    return {"yaml": text}


def imports(first: str) -> dict[str, str | bytes]:
    return {"code": first + CODE.format(fields="", step="")}


def fields(text: str) -> dict[str, str | bytes]:
    return {"code": CODE.format(fields=text, step="")}


BROKEN_WHEN_READ: dict[str, dict[str, str | bytes]] = {
    "empty": config(""),
    "comment only": config("# @package estimators.bad\n"),
    "no header": config("_target_: {package}.Bad\n"),
    "header of another": config(YAML.replace("estimators.bad", "estimators.good")),
    "header elsewhere": config(YAML.replace("estimators.bad", "_global_")),
    "list": config("# @package estimators.bad\n- a\n- b\n"),
    "text": config("# @package estimators.bad\njust words\n"),
    "number": config("# @package estimators.bad\n5\n"),
    "null": config("# @package estimators.bad\nnull\n"),
    "open bracket": config(YAML + "start: [linear\n"),
    "open brace": config(YAML + "start: {a: 1\n"),
    "open quote": config(YAML + "start: 'linear\n"),
    "tab": config(YAML + "start:\n\t- a\n"),
    "indentation": config(YAML + "  start: a\n b: 3\n"),
    "colon": config(YAML + "start: a: b\n"),
    "unknown alias": config(YAML + "start: *nothing\n"),
    "percent": config(YAML + "%start: 1\n"),
    "control character": config(YAML + "start: a\x01b\n"),
    "two documents": config(YAML + "---\nstart: nominal\n"),
    "duplicate key": config(YAML + "start: nominal\nstart: nominal\n"),
    "python tag": config(YAML + "start: !!python/object:os.system 5\n"),
    "own tag": config(YAML + "start: !thing 5\n"),
    "Latin-1": config(
        YAML.encode().replace(b"broken", b"kaputte \xfcble") if isinstance(YAML, str) else b""
    ),  # type: ignore[arg-type]
    "UTF-16": config(("\ufeff" + YAML).encode("utf-16")),  # type: ignore[arg-type]
    "zeros": config(b"\0" * 40),  # type: ignore[arg-type]
    "bomb": config(
        YAML
        + "a: &a [1,1,1,1,1,1,1,1,1,1]\n"
        + "".join(
            f"{n}: &{n} [{', '.join(['*' + p] * 10)}]\n"
            for p, n in zip("abcdefgh", "bcdefghi", strict=True)
        )
    ),
    "a loop of aliases": config(YAML + "start: &a [*a]\n"),
    "deep": config(YAML + "start: " + "[" * 3000 + "]" * 3000 + "\n"),
    "no target": config("# @package estimators.bad\ntolerance: 1e-6\n"),
    "null target": config(YAML.replace("{package}.Bad", "null")),
    "list target": config(YAML.replace("{package}.Bad", "[a]")),
    "target without module": config(YAML.replace("{package}.Bad", "Bad")),
    "target of another package": config(YAML.replace("{package}.Bad", "os.system")),
    "absent module": config(YAML.replace("{package}.Bad", "{package}.nothing.Bad")),
    "absent class": config(YAML.replace("{package}.Bad", "{package}.Good")),
    "function": config(YAML.replace("{package}.Bad", "{package}.dataclass")),
    "unknown option": config(YAML + "nothing: 3\n"),
    "wrong type": config(YAML + "max_iterations: many\n"),
    "interpolation": config(YAML + "start: ${nothing}\n"),
    "missing value": config(YAML + "start: ???\n"),
    "a group of defaults": config(YAML.replace("_target_", "defaults: [nothing]\n_target_")),
}
RAISED = (
    *(
        "RuntimeError('a\\nb')",
        "ValueError(3)",
        "KeyError('k')",
        "OSError(2, 'no', 'file')",
        "TypeError()",
    ),
    *(
        "ImportError('a\\nb')",
        "ModuleNotFoundError('x')",
        "AttributeError('x')",
        "NameError('x')",
        "Warning('x')",
    ),
    *(
        "RecursionError()",
        "MemoryError()",
        "AssertionError()",
        "StopIteration()",
        "GeneratorExit()",
        "SystemExit(5)",
    ),
    *(
        "BaseException('x')",
        "UnicodeDecodeError('utf-8', b'', 0, 1, 'x')",
        "ExceptionGroup('g', [ValueError()])",
    ),
)
BROKEN_WHEN_IMPORTED: dict[str, dict[str, str | bytes]] = {
    **{f"raises {what.partition('(')[0]}": imports(f"raise {what}\n") for what in RAISED},
    "sys.exit": imports("import sys; sys.exit(0)\n"),
    "syntax": imports("def (:\n"),
    "indentation of code": imports("  x = 1\n y = 2\n"),
    "null byte": imports("x = 1\0\n"),
    "Latin-1 code": {
        "code": "NAME = '\xfcbel'\n".encode("latin-1") + CODE.format(fields="", step="").encode()
    },
    "absent library": imports("import a_library_that_is_nowhere\n"),
    "circle": imports("from ipe_bench_no import thing\n"),
    "not a dataclass": {"code": "class Bad:\n    pass\n"},
    "not a component": {
        "code": (
            "from dataclasses import dataclass\n@dataclass(frozen=True)\nclass Bad:\n    x: int ="
            " 3\n"
        )
    },
    "abstract": {"code": CODE.format(fields="", step="").replace("def step", "def stepp")},
    "type that is nowhere": fields("x: Nothing = 3"),
    "required option": fields("x: int = field(kw_only=True)"),
    "post_init": fields("def __post_init__(self): raise ValueError('three\\nlines\\nhere')"),
    "post_init exits": fields("def __post_init__(self): raise SystemExit(3)"),
    "lock": fields("x: object = field(default_factory=__import__('threading').Lock)"),
    "set": fields("x: object = frozenset({1})"),
    "object": fields("x: object = field(default_factory=object)"),
    "lambda": fields("x: object = lambda: 3"),
    "mutable default": fields("x: list = []"),
}
BROKEN = {**BROKEN_WHEN_READ, **BROKEN_WHEN_IMPORTED}


@pytest.fixture
def plugin(tmp_path, request):
    """Writes a plugin with the solver `bad` and returns its folder."""
    package = f"broken_{abs(hash(request.node.name)) % 10**9}"

    def write(
        yaml: str | bytes = YAML, code: str | bytes = CODE.format(fields="", step="")
    ) -> Path:
        folder = tmp_path / "plugins/mine"
        conf = folder / package / "conf/solver"
        conf.mkdir(parents=True)
        raw = yaml if isinstance(yaml, bytes) else yaml.replace("{package}", package).encode()
        (conf / "bad.yaml").write_bytes(raw.replace(b"{package}", package.encode()))
        (folder / package / "__init__.py").write_bytes(
            code if isinstance(code, bytes) else code.encode()
        )
        return folder

    yield write
    sys.modules.pop(package, None)


SMALL = (
    "measurement=polynomial",
    "noise=gaussian",
    "noise.deviation=0.01",
    "trials=2",
    "execution=serial",
)
SMALL += ("figures=none",)


def test_there_are_sixty_broken_plugins():
    assert len(BROKEN) >= 60


@pytest.mark.parametrize("kind", one_in(12, BROKEN, pytest.mark.slow))
def test_a_broken_plugin_is_named_where_it_is_chosen(answer, plugin, tmp_path, kind):
    plugin(**BROKEN[kind])
    code, error = answer("run", "solver=[bad]", *SMALL)
    assert code == 2
    assert len(error) == 1
    assert "bad" in error[0]
    assert stored(tmp_path) == []


@pytest.mark.parametrize("kind", one_in(24, BROKEN, pytest.mark.slow))
def test_a_broken_plugin_stops_nobody_who_does_not_use_it(answer, plugin, capsys, kind):
    plugin(**BROKEN[kind])
    assert answer("run", "solver=[newton]", *SMALL, "--cfg", "job")[0] == 0
    assert answer("list", "solver")[0] == 0


@pytest.mark.parametrize("kind", one_in(12, BROKEN, pytest.mark.slow))
def test_check_fails_a_broken_plugin(answer, plugin, kind):
    folder = plugin(**BROKEN[kind])
    code, error = answer("check", str(folder))
    assert code == (1 if not error else 2)
    assert not any("Traceback" in line for line in error)


def test_the_plugin_that_the_broken_ones_are_made_of_works(answer, plugin, tmp_path):
    folder = plugin()
    assert answer("check", str(folder))[0] == 0
    assert answer("run", "solver=[bad]", *SMALL, "output=good")[0] == 0
    assert stored(tmp_path / "good")
    assert os.environ["PYTHONPATH"].endswith(str(folder.resolve()))
