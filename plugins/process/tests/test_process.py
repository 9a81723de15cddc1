"""An estimator that is a program: its numbers are those of the same estimator in Python, and its
faults are its own."""

import functools
import os
import pickle
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))

from ipe_bench_process import Process, process, program
from shared.oracles import assert_agrees

import ipe_bench as ib
from ipe_bench.basics.errors import UserError
from ipe_bench.cli.main import main
from ipe_bench.estimators.base import estimate_safely
from ipe_bench.plugins import discovery
from ipe_bench.plugins.construct import construct
from ipe_bench.runs.provenance import describe

HOME = Path(__file__).parents[1]
SCENARIO = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01), seed=3)
FAULTY = Path(__file__).with_name("faulty.py")
NEEDED = {"cpp": ("g++", "make"), "octave": ("octave-cli", "make"), "r": ("Rscript", "make")}
RUN = ("run", "measurement=polynomial", "noise=gaussian", "noise.deviation=0.01", "figures=none")


def require(language: str) -> None:
    for tool in NEEDED[language]:
        if shutil.which(tool) is None:
            pytest.skip(f"{tool} is not installed")


@pytest.fixture(scope="module", autouse=True)
def _none_is_left_running():
    """Ends the programs that stay for a next block, before the interpreter finds them."""
    yield
    end_all()


def end_all() -> None:
    while process._running:
        process._running.popitem()[1].end()


@pytest.fixture(scope="module")
def programs(tmp_path_factory) -> Path:
    require("cpp")
    folder = tmp_path_factory.mktemp("programs")
    make = ["make", "-s", "-C", str(HOME / "ipe_bench_process/programs"), f"OUT={folder}"]
    subprocess.run(make, check=True)
    return folder


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    """An empty folder, in which the plugin is known."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(discovery, "_added", {})
    monkeypatch.setenv("PYTHONPATH", os.environ.get("PYTHONPATH", ""))
    monkeypatch.chdir(tmp_path)
    Path("plugins").mkdir()
    Path("plugins/process").symlink_to(HOME)
    discovery.sources.cache_clear()
    yield
    discovery.sources.cache_clear()


# Numbers


@pytest.mark.oracle(
    "own second implementation: Gauss-Newton and EKF as programs", "estimates", 1e-5
)
@pytest.mark.parametrize(
    ("scale", "within"), [(1.0, 1e-9), pytest.param(30.0, 1e-5, marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("name", ["gauss_newton", "ekf"])
def test_a_program_equals_the_same_estimator_in_python(name, scale, within, programs):
    """At scale 30 the prior's variance is 1e7 times that of a reading, and an EKF keeps ten digits
    of sixteen."""
    scenario = ib.Scenario(SCENARIO.measurement, SCENARIO.noise, error_scale=scale, seed=3)
    drawn = scenario.draw(0, 40)
    ours = ib.baselines.EKF() if name == "ekf" else ib.baselines.GaussNewton(start="nominal")
    theirs = Process((str(programs / name),), needs=("epochs", "prior") if name == "ekf" else ())
    found, expected = (estimate_safely(one, scenario.problem, drawn.z) for one in (theirs, ours))
    assert (found.status == 0).all()
    assert_agrees(found.x, expected.x, atol=within)
    np.testing.assert_allclose(
        found.covariance,
        expected.covariance,
        rtol=0,
        atol=within * np.abs(expected.covariance).max(),
    )
    assert list(found.extras) == (["nis"] if name == "ekf" else [])


@pytest.mark.slow
@pytest.mark.parametrize("language", NEEDED)
def test_what_new_makes_keeps_its_promises_and_equals_gauss_newton(language, workplace, capsys):
    """Its dialogue holds; readings that are angles come round; what it asks is counted."""
    require(language)
    name = f"my_{language}"
    assert main(["new", "process", name, "--language", language]) == 0
    subprocess.run(["make", "-s", "-C", f"plugins/{name}", "test"], check=True)
    assert main(["check", f"plugins/{name}"]) == 0, capsys.readouterr().out
    (option,) = [one for one in discovery.options("baseline") if one.name == name]
    theirs = construct(option.config, name)
    model = ib.measurements.Bearings()
    scenario = ib.Scenario(model, ib.noise.Gaussian(0.01), error_scale=0.1, seed=1)
    z = scenario.draw(0, 20).z
    found, expected = (
        estimate_safely(one, scenario.problem, z)
        for one in (theirs, ib.baselines.GaussNewton(start="nominal"))
    )
    np.testing.assert_allclose(found.x, expected.x, rtol=0, atol=1e-6)
    assert (found.simulations == found.iterations + 1).all()
    assert (found.jacobians == found.iterations + 1).all()


# Faults

TRIALS, BAD = 6, 3
STATUS = {
    "nan": ib.Status.NONFINITE,
    **dict.fromkeys(("fork", "flee", "blank"), ib.Status.CONVERGED),
}
# fmt: off
LINES = {
    "short": "wrote x with 2 numbers, and not 4", "word": "wrote x with what is no number",
    "huge": "wrote x with 99999999999 numbers; a block has at most 2500000",
    "nothing": "answered without x and status",
    "underscore": "wrote x with what is no number", "hexadecimal": "no number",
    "digits": "no number",
    "print": "wrote 'Warning: step rejected', where a line NAME COUNT or `end` belongs",
    "no_status": "answered without status", "status": "wrote status 42, and not one of 0 to 8",
    "half_status": "wrote status 0.5", "twice": "wrote x twice in one answer",
    "count": "wrote iterations -1, which is no count", "skew": "wrote a P that is not symmetric",
    **dict.fromkeys(("negative", "indefinite", "no_variance", "infinite"),
                    "wrote a P that is not positive definite"),
    "more": "wrote 'x  4' after `end`", "late": "wrote 'x  4' after `end`",
    "blank_and_late": "wrote 'x  4' after `end`",
    "crowd": "asked for 4000000 numbers at once; ask for 62500 points at most",
    "flood": "wrote simulate with 3000000 numbers; a block has at most 2500000",
    "question": "asked with 3 numbers, and not a multiple of 4", "signal": "was ended by signal 11",
    "exit": "ended with exit code 2: reading settings | matrix is singular",
    "blocks": "wrote a twice in one answer",
    "sleep": "gave no whole answer within the time limit; does it flush its output after `end`?",
    "stderr": "gave no whole answer within the time limit", "close": "closed its output",
    "line": "",
    "fork_and_exit": "ended with exit code 0", "flee_and_exit": "ended with exit code 0",
}
# fmt: on


WAITS = dict.fromkeys(("sleep", "stderr", "close"), pytest.mark.slow)
"""Faults that take their time limits."""


@functools.cache
def answers(fault: str):
    z = SCENARIO.draw(0, TRIALS).z.copy()
    z[BAD, 0] = 99.0
    one = Process((sys.executable, str(FAULTY), fault), trial_timeout_s=3.0)
    return estimate_safely(one, SCENARIO.problem, z)


def left(fault: str) -> list[str]:
    """The programs of a fault that run."""
    words = (
        path.read_bytes().split(b"\0")
        for path in Path("/proc").glob("[0-9]*/cmdline")
        if path.exists()
    )
    return [str(each) for each in words if str(FAULTY).encode() in each and fault.encode() in each]


def none_is_left(fault: str) -> bool:
    """Whether all of them end: one that is killed is still listed until the system has time for its
    end."""
    until = time.monotonic() + 20.0
    while left(fault) and time.monotonic() < until:
        time.sleep(0.01)
    return not left(fault)


@pytest.mark.parametrize(
    "fault",
    [
        pytest.param(each, marks=WAITS.get(each, pytest.mark.slow if i % 2 else ()))
        for i, each in enumerate((*LINES, *STATUS))
    ],
)
def test_a_fault_costs_its_own_trial_and_a_line(fault):
    found, right = answers(fault), answers("none")
    others = np.setdiff1d(np.arange(TRIALS), [BAD])
    assert all(
        np.array_equal(a[others], b[others])
        for a, b in ((found.x, right.x), (found.status, right.status))
    )
    assert found.status[BAD] == STATUS.get(fault, ib.Status.ERROR)
    if fault in LINES:
        assert LINES[fault] in found.messages[BAD]
        assert list(found.messages) == [BAD]
    end_all()
    assert none_is_left(fault)


def test_what_a_program_has_started_ends_with_the_bench(tmp_path):
    """Also in a session of its own, where the bench itself is killed."""
    if not Path("/proc").exists():
        pytest.skip("only Linux lists what is marked")
    says = "import os; from ipe_bench_process.program import Program; "
    says += "program = Program({!r}, '.', ''); input(); os.kill(os.getpid(), 9)"
    mark = tmp_path / "orphan"
    command = [
        "sh",
        "-c",
        f"setsid sh -c 'echo > {mark}; sleep 1000; :' {FAULTY} killed & sleep 1000",
    ]
    bench = subprocess.Popen(
        [sys.executable, "-c", says.format(command)], stdin=subprocess.PIPE, cwd=HOME
    )
    while not mark.exists():
        time.sleep(0.01)
    assert left("killed")
    bench.communicate(b"\n")
    assert none_is_left("killed")


def test_a_look_at_whether_a_program_has_read_on_does_not_wait_for_it(monkeypatch):
    """A program that is at work on its readings has nothing to say: a tenth of a second for each
    trial otherwise."""
    waits, select = [], program.select.select

    def recorded(ready, free, broken, seconds):
        waits.append(seconds)
        return select(ready, free, broken, 0.0)

    monkeypatch.setattr(program.select, "select", recorded)
    busy = program.Program(["sleep", "100"], ".", "")
    busy.deadline = time.monotonic() + 10.0
    for seconds in (0.0, 5e-5):
        busy.wait(seconds)
    busy.end()
    assert waits == [0.0, 5e-5]


REFUSED = {
    "LICENCE": "ended with exit code 3: reading settings | the licence has expired",
    "VERSION": "ended with exit code 3: reading settings | speaks version 2 alone",
    "BANNER": "wrote 'Solver 3.1, 2026', where a line NAME COUNT",
    "DOUBLE": "after `end`",
    "ONCE": "ended with exit code 0",
}


@pytest.mark.parametrize("fault", REFUSED)
def test_a_program_that_cannot_do_this_problem_is_refused_before_any_work(fault, workplace, capsys):
    words = f"estimators.process.command=[{sys.executable},{FAULTY},{fault}]"
    assert main([*RUN, "baseline=[process]", words, "output=out"]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("ipe-bench: estimators.process: ")
    assert REFUSED[fault] in line
    assert not Path("out/trials").exists()


def test_after_three_faults_in_a_row_the_rest_of_the_block_fails():
    z = SCENARIO.draw(0, 8).z.copy()
    z[1:3, 0] = z[4:7, 0] = 99.0
    found = estimate_safely(Process((sys.executable, str(FAULTY), "exit")), SCENARIO.problem, z)
    assert found.status.tolist() == [0, 7, 7, 0, 7, 7, 7, 7]
    assert found.messages[7].startswith("not tried, as 3 trials in a row failed: ")


@pytest.mark.parametrize("missing", ["no_such", "faulty.py", "."])
def test_a_program_that_is_not_there_is_refused(missing, monkeypatch):
    monkeypatch.chdir(FAULTY.parent)
    with pytest.raises(UserError, match="build it first"):
        Process((missing,))


# Identity, and the places where it runs


def test_contents_are_its_identity_and_places_are_not(tmp_path, monkeypatch):
    monkeypatch.chdir(FAULTY.parent)
    there = shutil.copy(FAULTY, tmp_path)
    one, other = (Process((sys.executable, file, "none")) for file in ("faulty.py", str(there)))
    assert describe(one) == describe(other)
    assert one == other
    assert str(tmp_path) not in str(describe(other))
    Path(there).write_text(FAULTY.read_text() + "# changed")
    assert describe(one) != describe(Process((sys.executable, str(there), "none")))
    with pytest.raises(UserError, match="is not what it was where the run began"):
        estimate_safely(pickle.loads(pickle.dumps(other)), SCENARIO.problem, SCENARIO.draw(0, 2).z)


def rows(folder: str) -> pd.DataFrame:
    return (
        ib.load(folder)
        .sort_values(["estimator", "trial"])
        .drop(columns="time_s")
        .reset_index(drop=True)
    )


@pytest.mark.slow
def test_two_processes_and_a_second_command_have_the_same_rows(workplace, programs, capsys):
    chosen = (
        *RUN,
        "solver=[]",
        "baseline=[process]",
        f"estimators.process.command=[{programs / 'ekf'}]",
    )
    chosen += ("estimators.process.needs=[epochs,prior]", "trials=40")
    assert main([*chosen, "output=one", "execution=serial"]) == 0
    assert (
        main(
            [
                *chosen,
                "output=two",
                "execution=processes",
                "execution.workers=2",
                "block_size=10",
                "trials=20",
            ]
        )
        == 0
    )
    assert (
        main([*chosen, "output=two", "execution=processes", "execution.workers=2", "block_size=10"])
        == 0
    )
    pd.testing.assert_frame_equal(rows("one"), rows("two"), check_exact=True)
    stored = {path: path.stat().st_mtime_ns for path in Path("two/trials").iterdir()}
    assert main([*chosen, "output=two"]) == 0
    assert stored == {path: path.stat().st_mtime_ns for path in Path("two/trials").iterdir()}
