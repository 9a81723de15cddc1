"""What an error advises to type is typed, and taken."""

from __future__ import annotations

import ast
import re
import shlex
from pathlib import Path

import pytest

import ipe_bench
from ipe_bench.real import logs as tracks
from ipe_bench.real.estimation import Question

FORMULA = "run measurement=formula measurement.expression=b1*t measurement.columns.t=[1,2,3]"
FITTED = "estimate measurement=formula measurement.expression=b1*t+c"
STARTED = f"{FITTED} measurement.start.b1=1 measurement.start.c=1"
FEW = (
    "run measurement=formula measurement.expression=b1*t+c measurement.columns.t=[1]"
    " measurement.start.b1=1 measurement.start.c=1 noise.deviation=1"
)
ODE = (
    "run measurement=ode measurement.start.k=1 measurement.initial.y=1 noise.deviation=1"
    " measurement.times=[1,2]"
)
ROBUST = (
    "estimate measurement=nist/misra1a baseline=[least_squares] estimators.least_squares.loss=huber"
    " estimators.least_squares"
)
SWUNG = (
    "run measurement=function measurement.of=swing:{} measurement.columns.t=[1,2,3]"
    " noise.deviation=1"
)
DECAY = "run measurement=ode measurement.rates.y=-k*y+c measurement.times=[1,2,3] noise.deviation=1"
READ = "run state_model=formulas state_model.readings.z=x"
STATES = "run state_model=formulas state_model.next.x=x+w state_model.noise.w=1"
KNOWN = "run measurement=polynomial parameters.c0."
WORD = r"(?:write|such as|as in|give|set|start:|choose) ([^\s=]+=\S*?)[,;]?(?: |$)"
"""The word KEY=VALUE that follows an advice."""
MEANT = r"did you mean (\S+)\?"
NISTS = "run measurement=nist/misra1a"
ADVICE = [
    ("run paper", WORD, "run {}"),
    ("run newton", WORD, "run {}"),
    ("run gins", WORD, "run {}"),
    ("run r.csv", r'ipe-bench (run ".*?" \S+),', "{}"),
    ("estimate r.csv", r'ipe-bench (estimate ".*?" \S+),', "{}"),
    (
        "estimate r.csv",
        r"choose (measurement=)",
        f"{STARTED.replace('measurement=', '{}')} readings=r.csv",
    ),
    ("estimate b*t uv.csv", r"if that is u: ipe-bench (.*)$", "{}"),
    ("estimate 'a*s+b' s.csv", r"in the formula of (a), s, b$", "estimate '{}*t+b' s.csv"),
    ("estimate 'f(t) = a*t' r.csv", r'write the formula alone, "(.*?)"', "estimate '{}' r.csv"),
    (
        "estimate swing.py:good r.csv length=3",
        r"(measurement.start.length=3) sets",
        "estimate swing.py:good r.csv {}",
    ),
    ("estimate 'a*tt+b' uv.csv", r"if tt is t: ipe-bench (.*)$", "{}"),
    ("run experiment=paper", WORD, "run {}"),
    ("run +experiment=[paper]", r"choose one: (\S+)", "run {}", {"NAME": "paper"}),
    ("run measurement=[gins]", r"choose one: (\S+)", "run {}", {"NAME": "gins"}),
    ("run solver=[ekf]", WORD, "run {}"),
    ("run baseline=[newton]", WORD, "run {}"),
    ("run measurement=newton", WORD, "run {}"),
    ("run solver=[newtn]", MEANT, "run solver=[{}]"),
    ("run noise=gausian", MEANT, "run noise={}"),
    ("run measurement=nist/misra1", MEANT, "run trials=1 noise.deviation=1 measurement={}"),
    (
        "run measurement=nist measurement.dataset=misra1a",
        MEANT,
        "run noise.deviation=1 measurement=nist measurement.dataset={}",
    ),
    ("run error_scal=3", MEANT, "run {}=3"),
    (
        "run measurement=polynomial measurement.counts=9",
        MEANT,
        "run measurement=polynomial measurement.{}=9",
    ),
    (
        "run solver=[newton] estimators.newton.max_iter=5",
        MEANT,
        "run solver=[newton] estimators.newton.{}=5",
    ),
    ("run solver=[newton] solver.newton.max_iter=5", WORD, "run solver=[newton] {}"),
    ("run baseline.ekf.process_noise=1", WORD, "run {}"),
    (
        "run solver=[newton] solver.max_iterations=5",
        WORD,
        "run solver=[newton] {}",
        {"LABEL": "newton"},
    ),
    ("run estimators.newton.max_iterations=5", WORD, "run estimators.newton.max_iterations=5 {}"),
    (
        "run estimators.newtn.max_iterations=5",
        MEANT,
        "run solver=[newton] estimators.{}.max_iterations=5",
    ),
    (
        "run solver=[newton] estimators.newton=5",
        r"such as (\S+)",
        "run solver=[newton] {}",
        {"KEY": "max_iterations", "VALUE": "5"},
    ),
    (
        "run estimators=[newton]",
        r"options by (\S+)",
        "run solver=[newton] {}",
        {"LABEL": "newton", "KEY": "max_iterations", "VALUE": "5"},
    ),
    (
        "run solver=[relinearized] estimators.relinearized.solver.max_iterations=5",
        r"set (\S+) beside",
        "run solver=[relinearized] estimators.relinearized.{}=5",
    ),
    ("run trials=1e3", WORD, "run {}"),
    ("run trials = 5", WORD, "run {}"),
    ("run =5", WORD, "run {}", {"KEY": "trials", "VALUE": "5"}),
    ("run --trials=5", WORD, "run {}"),
    ("run --trials 5", WORD, "run {}"),
    ("run --multirn error_scale=1,2", MEANT, "run {} error_scale=1,2"),
    ("run --resolve", r"such as (.*)", "run {}"),
    ("run name=a(b", r'such as (".*?")', "run {}"),
    ("run model=growth", MEANT, "run {}=growth"),
    ("run name=paper", r"or write (\S+)", "run {}"),
    ("run name=../x", r"folder as (output=)", "run {}../x"),
    ("run +noise@estimators.x=gaussian", WORD, "run {}"),
    ("run +solver@x=newton", WORD, "run {}", {"LABEL": "x"}),
    ("run solver@estimators.x=newton", WORD, "run {}"),
    ("run solver=[newton,newton]", r"; (\S+) runs it again", "run solver=[newton] {}"),
    ("run error_scale=1,2", r"add (-m)", "run {} error_scale=1,2"),
    ("run -m error_scale=interval(1,2)", r"such as (\S+)", "run -m error_scale={}"),
    ("run hydra.sweeper.params=3", r"as in (\S+)", "run {}"),
    ("run hydra.job.env_set.A=1", WORD, "run {}"),
    ("run hydra/launcher=foo", r"(choose basic)", "run hydra/launcher=basic"),
    ("run hydra/launcher=ray", r"or (choose basic)", "run hydra/launcher=basic"),
    ("run ~solver", r"; (\S+) chooses none", "run {}"),
    ("run time_limit=5", r"goes with (precision=);", "run time_limit=5 {}0.1"),
    (
        "run write_readings_trial=3",
        r"goes with (\S+)",
        "run write_readings_trial=3 {}",
        {"FILE": "new.csv"},
    ),
    ("run objective=newton", r"such as (\S+)", "run objective={}"),
    (
        "run solver=[newton] objective=newtn.cost_median",
        MEANT,
        "run solver=[newton] objective={}.cost_median",
    ),
    (
        "run solver=[newton] objective=newton.cost_medium",
        MEANT,
        "run solver=[newton] objective=newton.{}",
    ),
    ("run solver=[] baseline=[]", r"choose with (solver=)", "run baseline=[] {}[newton]"),
    ("run figures=some", r"choose \w+, (\w+)", "run figures={}"),
    ("run formats=tiff", r"among .* and (\w+)", "run formats={}"),
    ("run tracker=[ekf]", r"goes with (\S+);", "run tracker=[ekf] {}", {"NAME": "growth"}),
    (
        "run state_model=pendulum trackers.bootstrap.particles=50",
        WORD,
        "run state_model=pendulum trackers.bootstrap.particles=50 {}",
    ),
    (
        "run state_model=growth tracker=[grid] trackers.grid.points=5",
        WORD,
        "run state_model=growth tracker=[grid] {}",
        {"LABEL": "grid"},
    ),
    ("run state_model=pendulum_book", WORD, "run state_model=pendulum_book {}"),
    ("estimate state_model=pendulum_book gate=99.9", WORD, "estimate state_model=pendulum_book {}"),
    (f"{NISTS} noise=certified", WORD, f"{NISTS} noise=certified {{}}"),
    ("run measurement=polynomial noise=certified", r"or (\S+)", "run noise=certified trials=1 {}"),
    (NISTS, WORD, f"{NISTS} {{}}"),
    (
        "estimate measurement=nist/misra1a noise=gaussian",
        r"unit, (\S+)",
        "estimate measurement=nist/misra1a noise=gaussian {}",
    ),
    (
        f"{FORMULA} measurement.start.b1=1 noise=quantization",
        r"readings, (\S+)",
        f"{FORMULA} measurement.start.b1=1 noise=quantization {{}}",
    ),
    (
        "run measurement=polynomial noise=unknown",
        r"give (noise.levels=\[)",
        "run measurement=polynomial noise=unknown {}0.1]",
    ),
    (
        "run measurement=formula",
        WORD,
        "run measurement=formula measurement.start.b=1 measurement.columns.t=[1,2]"
        " noise.deviation=1 {}",
        {"FORMULA": "b*t"},
    ),
    (
        "run measurement=function",
        WORD,
        SWUNG.replace("measurement.of=swing:{}", "{}"),
        {"MODULE": "swing", "FUNCTION": "good"},
    ),
    ("run measurement=ode", WORD, f"{ODE} {{}}", {"STATE": "y", "FORMULA": "-k*y"}),
    (
        "run state_model=formulas",
        WORD,
        "run state_model=formulas {} state_model.readings.z=x state_model.deviation.z=1"
        " state_model.spread.x=1",
        {"STATE": "x", "FORMULA": "x"},
    ),
    (
        STATES,
        WORD,
        f"{STATES} {{}} state_model.deviation.z=1 state_model.spread.x=1",
        {"READING": "z", "FORMULA": "x"},
    ),
    (
        f"{STATES} state_model.readings.z=x",
        WORD,
        f"{STATES} state_model.readings.z=x {{}} state_model.spread.x=1",
        {"READING": "z"},
    ),
    (
        f"{STATES} state_model.readings.z=x state_model.deviation.z=1",
        WORD,
        f"{STATES} state_model.readings.z=x state_model.deviation.z=1 {{}}",
        {"STATE": "x"},
    ),
    (f"{FORMULA} noise.deviation=1", WORD, f"{FORMULA} noise.deviation=1 {{}}"),
    (
        f"{STARTED} measurement.circular=[y] readings=deg.csv",
        WORD,
        f"{STARTED} measurement.circular=[y] readings=deg.csv {{}}",
    ),
    (
        f"{FITTED} measurement.start.b1=1 readings=r.csv",
        WORD,
        f"{FITTED} measurement.start.b1=1 readings=r.csv {{}}",
    ),
    (
        FORMULA.partition(" measurement.col")[0] + " measurement.start.b1=1 noise.deviation=1",
        r"column, (measurement.columns.t=)",
        FORMULA.partition(" measurement.col")[0]
        + " measurement.start.b1=1 noise.deviation=1 {}[1,2]",
    ),
    (FEW, r"parameter by (\S+)", f"{FEW} {{}}", {"NAME": "c"}),
    (SWUNG.format("goode"), MEANT, SWUNG),
    (SWUNG.format("bare"), r"or (\S+)", SWUNG.format("bare") + " {}", {"NAME": "length"}),
    (SWUNG.format("need"), WORD, SWUNG.format("need") + " {}"),
    (SWUNG.format("two"), r"or (\S+)", SWUNG.format("two") + " {}"),
    (SWUNG.format("two"), r"give (\S+)\.\.\.\]", SWUNG.format("two") + " {}1,2,4]"),
    (DECAY, r"a start: (\S+)", f"{DECAY} measurement.constants.c=[1] {{}}", {"NAME": "k"}),
    (f"{DECAY} measurement.start.k=1", r"a start, (\S+),", f"{DECAY} measurement.start.k=1 {{}}"),
    (f"{KNOWN}lower=5", WORD, f"{KNOWN}lower=5 {{}}", {"VALUE": "6"}),
    ("run measurement=polynomial parameters.c0=3", WORD, "run measurement=polynomial {}"),
    (
        "run measurement=polynomial parameters=l.yaml",
        r"such as (.*)",
        "run measurement=polynomial parameters=written.yaml",
        {"NAME": "c0"},
    ),
    (
        "estimate measurement=nist/misra1a readings=[]",
        r"or several as readings=\[(\w).csv",
        f"{STARTED} readings=[r.csv,s.csv]",
    ),
    (f"{STARTED}", WORD, f"{STARTED} {{}}"),
    (
        f"{STARTED} readings=r.csv baseline=[map_lm]",
        WORD,
        f"{STARTED} readings=r.csv baseline=[map_lm] {{}}",
    ),
    (
        f"{ROBUST}.method=lm",
        WORD,
        f"{ROBUST}.{{}}",
    ),
    (
        "estimate state_model=pendulum_book find=[gravty]",
        MEANT,
        "estimate state_model=pendulum_book find=[{}]",
    ),
    ("estimate state_model=growth", WORD, "estimate state_model=growth {}", {"FILE": "z.csv"}),
    (
        "estimate state_model=growth readings=z.csv gate=95",
        r"write (\S+) for",
        "estimate state_model=growth readings=z.csv {}",
    ),
    (
        "design measurement=polynomial --by",
        r"write (\S+)",
        "design measurement=polynomial {}",
        {"VALUE": "time"},
    ),
    (
        "design measurement=polynomial at=.",
        r"`ipe-bench (.*?)`",
        f"{{}} {STARTED.partition(' ')[2]} readings=r.csv",
    ),
    ("design measurement=polynomial by=tim", MEANT, "design measurement=polynomial by={}"),
    (
        "design measurement=polynomial noise=unknown",
        r"as in (.*)",
        "design measurement=polynomial {}",
    ),
    ("design state_model=growth", r"`ipe-bench (.*?)`", "{}", {"NAME": "growth"}),
    (
        "posterior state_model=growth",
        r"`ipe-bench (.*?)`, with (?:\S+)",
        "{} tracker=[grid]",
        {"NAME": "growth"},
    ),
    ("-sc install=nope", r"write (\S+ \S+)", "{}", {"SHELL": "bash"}),
    ("rum", MEANT, "{} --dry-run"),
    ("run foo", r"`ipe-bench (.*?)`", "{}"),
    ("run measurement=ode measurement.rates={}", WORD, f"{ODE} {{}}"),
    (
        ODE.replace(" measurement.times=[1,2]", " measurement.rates.y=-k*y"),
        r"(measurement.times): is empty",
        f"{ODE} measurement.rates.y=-k*y {{}}=[1,2]",
    ),
    (
        f"{READ} state_model.spread.x=1 state_model.deviation.z=1 state_model.next={{}}",
        WORD,
        f"{STATES} {{}} state_model.deviation.z=1 state_model.readings.z=x state_model.spread.x=1",
        {"NAME": "x", "FORMULA": "x+w"},
    ),
    (
        "estimate measurement=nist/misra1a ignore_columns=[x]",
        r"give (\S+),",
        f"{STARTED} ignore_columns=[x] {{}}",
        {"FILE": "x.csv"},
    ),
    (
        "estimate measurement=nist/misra1a solver=[] baseline=[]",
        r"with (solver=) and",
        "estimate measurement=nist/misra1a baseline=[] {}[auto]",
    ),
    (f"{STARTED} readings=x.csv", r"set (\S+)", f"{STARTED} readings=x.csv {{}}"),
    (f"{STARTED} readings=q.csv", r"set (\S+)", f"{STARTED} readings=q.csv {{}}"),
    (
        f"{STARTED} readings=sigma.csv noise=gaussian noise.deviation=1",
        r"set (\S+) to",
        f"{STARTED} readings=sigma.csv {{}}",
    ),
    ("design measurement=polynomial readings=50", r"`ipe-bench (.*?)`", "{}"),
    (f"design {STARTED.partition(' ')[2]} readings=r.csv", r"`ipe-bench (.*?)`", "{}"),
    ("design measurement=polynomial readings=r.csv", WORD, "design measurement=polynomial {}"),
    ("list solvr", MEANT, "list {}"),
    ("list solver/newtn", MEANT, "list solver/{}"),
    ("list --verbos", MEANT, "list {}"),
    ("new solvr x", MEANT, "new {} x"),
    ("new ci", r"such as `ipe-bench (.*?)`", "{}"),
]

SOME = [
    pytest.param(one, id=one[0], marks=[] if i % 8 == 0 else pytest.mark.slow)
    for i, one in enumerate(ADVICE)
]
_TYPED = re.compile(
    r"(?:write|such as|as in|give|set|start[:,]|choose|use|see|add) [^;]*(?:=|`ipe-bench).*"
)
"""What advises a word with an equals sign, or a command."""
ELSEWHERE = {
    "no advice": ("upper={}: give a number",),
    "of readings that are fitted": (
        "The stated noise is far too large",
        "{}: meets every reading but for round-off",
        "{}: data sets simulated from it",
        "noise=unknown: the level",
        "noise=unknown: the {} readings",
        "noise=unknown: {} readings are too few",
        "measurement={}: H has not",
        "measurement={}: {}; choose another start",
    ),
    "of stored results": (
        "at={}: no estimate there passes",
        "give another start, or the estimate of readings",
        "no estimator is in both",
        "paper=: name tables",
        "power: needs a fixed number",
        "report: the run has",
        "{}: cannot be used",
        "{}: is not given; both go together",
    ),
    "of a log that is tracked": ("the model does not fit the log",),
    "of the text of a function": (
        "{}: gives a row other values",
        "{}: has no function; define",
    ),
    "of a plugin or a class": (
        "the entries of an option are not changed in place",
        "measurement.step=null",
        "write the model in Python",
        "{}: contains no package",
        "{}: look={}",
        "{}: {} is not a {}",
        "{}={}: is not a part",
    ),
    "of readings in memory": ("readings=: is a table of {}",),
    "what a key does": ("write the simulated readings",),
    "of Hydra's own keys": ("{}: there is no such key; see",),
}
"""How texts begin that no mistake above leads to, by what they are about."""


class Accepted(Exception):
    """Ends a command where its computation would begin."""


@pytest.fixture
def command(ipe_bench, monkeypatch, tmp_path):
    """Runs a command up to its computation: the exit code, and what it says on stderr."""

    def begun(*_, **__):
        raise Accepted

    for owner, name in ((Question, "fitted"), (tracks.LogTracks, "of"), (tracks, "_minima")):
        monkeypatch.setattr(owner, name, begun)
    Path("r.csv").write_text("t,reading\n1,2\n2,3\n3,5\n4,8\n")
    Path("x.csv").write_text("t,reading,x\n1,2,0\n2,3,0\n3,5,0\n4,9,0\n")
    Path("q.csv").write_text("t,q\n1,2\n2,3\n3,5\n4,9\n")
    Path("sigma.csv").write_text("t,reading,sigma\n1,2,1\n2,3,1\n3,5,1\n4,9,1\n")
    Path("s.csv").write_text("t,reading\n1,2\n2,3\n3,5\n4,9\n")
    Path("deg.csv").write_text("t,y [deg]\n1,2\n2,3\n3,5\n4,9\n")
    Path("uv.csv").write_text("t,u,v\n1,2,2\n2,3,3\n3,5,5\n4,9,9\n")
    Path("z.csv").write_text("square\n" + "1\n" * 100)
    Path("l.yaml").write_text("[1]\n")
    Path("written.yaml").write_text("c0: {nominal: 1}\n")
    Path("swing.py").write_text(
        "def good(t, length=1.0):\n    return length*t\n\ndef bare(t, length):\n    return"
        " length*t\n\ndef need(t, length=1.0, *, g):\n    return g*length*t\n\ndef two(t, u,"
        " length=1.0):\n    return length*t + u\n"
    )

    def run(line: str) -> tuple[int, str]:
        words = shlex.split(line)
        # A dry run takes name=paper, and readings of one's own have none.
        if words[0] == "run" and words[1:] != ["name=paper"] and "r.csv" not in words:
            words.append("--dry-run")
        try:
            code, _, err = ipe_bench(*words)
        except Accepted:
            return 0, ""
        return code, " ".join(err.split())

    return run


@pytest.mark.parametrize("case", SOME)
def test_what_an_error_advises_is_taken(command, case):
    mistake, pattern, follow, *more = case
    _, said = command(mistake)
    found = re.search(pattern, said)
    assert found, said
    advised = found[1]
    fill = {"VALUE": "0.1", "X": "0.1", "FILE": "r.csv", **(more[0] if more else {})}
    for name, value in fill.items():
        advised = re.sub(rf"\b{name}\b", value, advised)
    code, answer = command(follow.format(advised))
    assert code == 0, f"{said}\n{follow.format(advised)}\n{answer}"


def templates():
    """The texts of the package that advise a word to type: each with a pattern of what it says."""
    for path in sorted(Path(ipe_bench.__file__).parent.rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        inner = {
            id(part)
            for node in ast.walk(tree)
            if isinstance(node, ast.JoinedStr)
            for part in node.values
        }
        for node in ast.walk(tree):
            parts = (
                node.values
                if isinstance(node, ast.JoinedStr)
                else []
                if id(node) in inner
                else [node]
            )
            texts = [one.value if isinstance(one, ast.Constant) else "{}" for one in parts]
            text = "".join(one for one in texts if isinstance(one, str))
            if "\n" not in text and (found := _TYPED.search(text)):
                yield text, ".*".join(map(re.escape, found[0].split("{}")))


def test_what_python_shows_too_names_no_flag():
    rooms = [
        path
        for path in Path(ipe_bench.__file__).parent.rglob("*.py")
        if path.parent.name not in ("cli", "docs")
    ]
    assert len(rooms) > 100
    assert [
        path
        for path in rooms
        if re.search(r"(?:give|write|use|set|more) [^\"\n]*--[a-z]", path.read_text())
    ] == []


@pytest.mark.slow
def test_every_word_that_an_error_of_the_package_advises_is_tried(command):
    said = " ".join(command(mistake)[1] for mistake, *_ in ADVICE)
    texts = dict(templates())
    untried = {text for text, pattern in texts.items() if not re.search(pattern, said)}
    assert len(texts) > 60
    known = {start for several in ELSEWHERE.values() for start in several}
    assert {text for text in untried if not text.startswith(tuple(known))} == set()
    assert {
        start for start in known if not any(text.startswith(start) for text in untried)
    } == set()
