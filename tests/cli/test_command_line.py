"""The command line end to end: what it computes, and one clear line for every mistake."""

import errno
import json
import os
import re
import subprocess
import sys
from importlib.metadata import distributions
from pathlib import Path
from typing import get_args, get_type_hints

import pandas as pd
import pytest
import yaml

import ipe_bench as ib
from ipe_bench.basics.options import Count, Whole
from ipe_bench.cli.keys import ROWS, WHOLE
from ipe_bench.cli.main import COMMANDS, _explain, main
from ipe_bench.cli.run import Outcome
from ipe_bench.cli.spec import KEYS, PARTS, Spec
from ipe_bench.real.logs import LogTracks
from ipe_bench.report import figures
from ipe_bench.statistics.records import SCORES, STATISTICS

ROOT = Path(__file__).parents[2]


def alone(*arguments: str, folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Runs a command as users do, in a process of its own."""
    command = [sys.executable, "-m", "ipe_bench", *arguments]
    variables = {**os.environ, "PYTHONPATH": str(ROOT), **environment}
    return subprocess.run(
        command, cwd=folder, env=variables, capture_output=True, text=True, timeout=300, check=False
    )


@pytest.fixture(scope="module")
def readings(tmp_path_factory) -> Path:
    """Readings of one simulated trial."""
    folder = tmp_path_factory.mktemp("readings")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(sys, "argv", ["ipe-bench"])
        assert main(["run", "error_scale=10", "write_readings=trial.csv"]) == 0
    return folder / "trial.csv"


@pytest.mark.slow
def test_a_sweep_leaves_tables_figures_and_a_report(tmp_path, ipe_bench, monkeypatch):
    monkeypatch.setattr(figures, "FIGURES", ("costs", "parameters"))
    words = ("run", "-m", "error_scale=1,10", "trials=5", "baseline=[linear_lse]", "figures=main")
    code, out, error = ipe_bench(*words)
    assert code == 0, error
    (folder,) = (tmp_path / "outputs").iterdir()
    assert {path.name for path in folder.iterdir()} >= {"summary.csv", "report.html", "tables"}
    drawn = {path.name for path in (folder / "figures").iterdir()}
    assert drawn == {"index.json", "cost_against_accuracy.png"}
    assert "fixed_point" in out
    assert ipe_bench(*words)[2].count("all trials are stored") == 2


DEVIATION = ("noise=gaussian", "noise.deviation=0.01")
SMALL = ("measurement=polynomial", *DEVIATION)
MISTAKES = {
    "unknown estimator": (
        ["run", "solver=[newtn]"],
        "solver=newtn: there is no such option; did you mean newton?",
    ),
    "unknown key": (["run", "eror_scale=1"], "did you mean error_scale?"),
    "noise that is not a number": (
        ["run", "noise=gaussian", "noise.deviation=nan"],
        "noise.deviation=nan",
    ),
    "taken name": (["new", "solver", "newton"], "newton: solver=newton is there already"),
    "two experiments": (["run", "-m", "+experiment=paper,paper"], "run them one by one"),
    "added key": (["run", "+trails=3"], "did you mean trials?"),
    "unknown command": (["rum"], "did you mean run?"),
    "unknown flag": (
        ["list", "--verbos"],
        "list: --verbos: there is no such flag; did you mean --verbose?",
    ),
    "flag of another command": (["estimate", "-m"], "estimate: -m: there is no such flag"),
    "name of a library": (
        ["new", "solver", "numpy"],
        "numpy: is a package that ipe-bench imports; choose",
    ),
    "our own name": (
        ["new", "solver", "ipe_bench"],
        "ipe_bench: is a package that ipe-bench imports",
    ),
    "name of a device": (
        ["new", "solver", "con"],
        "con: is no name of a folder on Windows; choose another name",
    ),
    "a guard with a name": (["new", "ci", "mine"], "new ci: takes no name; leave out mine"),
    "word too few": (["new", "solver"], "new: the following arguments are required: NAME"),
    "no data set": (
        ["run", "measurement=nist/boxbot"],
        "measurement=nist/boxbot: there is no such data set; did you",
    ),
    "a solver among baselines": (
        ["run", "baseline=[newton]"],
        "newton is a solver, not a baseline; write solver",
    ),
    "a baseline among solvers": (
        ["run", "solver=[gauss_newton]"],
        "is a baseline, not a solver; write baseline",
    ),
    "a group for a place": (
        ["run", "baseline.ekf.process_noise=1"],
        "write estimators.ekf.process_noise=1",
    ),
    "not chosen": (
        ["run", "estimators.newton.max_iterations=9"],
        "newton is not chosen; add it, as in solver=[newton]",
    ),
    "a name that leaves": (["run", "name=../../x"], "name=../../x: leaves the folder outputs"),
    "an address": (
        ["run", "output=s3://bucket/x"],
        "output=s3://bucket/x: is an address; name a folder",
    ),
    "a label that is misspelt": (
        ["run", "estimators.newtn.max_iterations=9"],
        "did you mean newton?",
    ),
    "a sweep of a command that has one job": (
        ["estimate", "measurement=nist/misra1a", "error_scale=1,2"],
        "error_scale=1,2: is a sweep, which only runs of simulated trials take; give one value",
    ),
    "a file without a model": (
        ["estimate", "my.csv"],
        "no model is given; write a function's file, a formula in quotes or a YAML file before it:"
        ' ipe-bench estimate "a*exp(-b*t)+c" my.csv, or choose measurement=NAME',
    ),
    "a file without a model for run": (
        ["run", "my.csv"],
        "my.csv: contains readings, but no model is given; write a function's file, a formula in"
        ' quotes or a YAML file before it: ipe-bench run "a*exp(-b*t)+c" my.csv',
    ),
    "an option without its group": (
        ["run", "newton"],
        "newton: is not KEY=VALUE; write solver=[newton]",
    ),
    "a flag for a key": (["run", "--trials", "10"], "keys have no dashes: write trials=10"),
    "a flag with a value for a key": (
        ["run", "--trials=10"],
        "keys have no dashes: write trials=10",
    ),
    "a blank behind": (
        ["run", "error_scale=", "33"],
        "has a blank next to the equals sign; write error_scale=33",
    ),
    "a blank before": (
        ["run", "error_scale", "=33"],
        "has a blank next to the equals sign; write error_scale=33",
    ),
    "blanks about": (
        ["report", ".", "figures", "=", "none"],
        "figures = none: has a blank next to the equals sign",
    ),
    "an exponent": (
        ["run", "trials=1e3"],
        "trials=1e3: is not written as a whole number; write trials=1000",
    ),
    "a flag that is gone": (["run", "--config-path", "x"], "name the folder with --config-dir"),
    "no function": (
        ["run", "measurement=function"],
        "measurement.of: is not given; write measurement.of=MODULE:FUNC",
    ),
    "no readings": (["estimate"], "readings: is not given"),
    "design of trials": (["design", *SMALL, "trials=5"], "trials: is for `ipe-bench run`"),
    "design of a solver": (["design", *SMALL, "solver=[newton]"], "solver: is for `ipe-bench run`"),
    "design of a file": (
        ["design", *SMALL, "readings=a.csv"],
        "readings=a.csv: readings= is the largest number of readings in design",
    ),
    "no such column": (["design", *SMALL, "by=colour"], "by=colour: there is no such column"),
    "no such criterion": (["design", *SMALL, "criterion=E"], "criterion=E: choose one of A, D"),
    "too few readings": (
        ["design", *SMALL, "readings=3"],
        "readings=3: 4 parameters need at least 4 readings",
    ),
    "too many readings": (
        ["design", *SMALL, "readings=500"],
        "readings=500: polynomial has 40 readings",
    ),
    "design to a precision": (
        ["design", *SMALL, "precision=0.1"],
        "precision: is for `ipe-bench run`",
    ),
    "no richer truth": (
        ["design", *SMALL, "truth_measurement=polynomial"],
        "has no errors besides the parameters",
    ),
    "posterior of a file": (
        ["posterior", *SMALL, "readings=a.csv"],
        "readings: is for `ipe-bench estimate`, and has no",
    ),
    "posterior to a precision": (
        ["posterior", *SMALL, "precision=0.1"],
        "precision: is for `ipe-bench run`, and has",
    ),
    "a thousand posteriors": (
        ["posterior", *SMALL, "trials=1000"],
        "trials=1000: each takes up to a minute",
    ),
    "few particles": (
        ["posterior", *SMALL, "baseline=[]", "particles=20"],
        "particles=20: give at least 80",
    ),
    "particles in words": (
        ["posterior", *SMALL, "particles=many"],
        "particles=many: give a whole number above 0",
    ),
    "no posterior": (["posterior", *SMALL, "trials=0"], "trials=0: give a whole number above 0"),
}


IN_A_SWEEP = [
    (["noise.deviation=0.1,abc"], "noise.deviation=abc: give a number above 0 or a list"),
    (["noise.deviation=0.1,0"], "noise.deviation=0: give a number above 0 or a list"),
    (["seed=1,first"], "seed=first: give a whole number from 0 up"),
    (["error_scale=1,-1"], "error_scale=-1.0: give a number above 0"),
    (["measurement.strength=0.1,[1]"], "measurement.strength=[1]: give a finite number"),
    (
        ["measurement=ranging,polynomial", "measurement.rounds=5"],
        "measurement.rounds: there is no such option",
    ),
    (
        ["estimators.fixed_point.start=nominal,here"],
        "estimators.fixed_point.start=here: choose one of",
    ),
    (
        ["+baseline@estimators.a=ekf,ukf", "estimators.a.engine=x,y"],
        "estimators.a.engine=x: choose one of",
    ),
    (["execution.threads=1,2"], "execution.threads: there is no such option"),
    (["+prior.width=1,2"], "prior.width: there is no such option"),
]
"""No job begins where one would be refused."""
OF_STATES = [
    (
        ["state_model=pendulum", "baseline=[ekf]"],
        "baseline: is of a measurement, and state_model= chooses",
    ),
    (
        ["state_model=pendulum", "write_readings=a.csv"],
        "write_readings: is of a measurement, and state_model=",
    ),
    (
        ["state_model=pendulum_book", "error_scale=3", "trials=1"],
        "error_scale=3: state_model=pendulum_book has stored paths",
    ),
    (["measurement=polynomial", "tracker=[ekf]"], "tracker: goes with state_model=NAME"),
    (
        ["state_model=pendulum", "tracker=[newton]"],
        "tracker=newton: newton is a solver, not a tracker",
    ),
    (
        ["state_model=pendulum", "trackers.ukf.iterations=0"],
        "trackers.ukf.iterations=0: give a whole number above 0",
    ),
    (
        ["state_model=pendulum", "trackers.bootstrap.particles=5"],
        "trackers.bootstrap.particles: is set, but bootstrap",
    ),
    (
        ["state_model=pendulum", "tracker=[grid]"],
        "trackers.grid: is exact for one state, and pendulum has 2",
    ),
    (
        ["state_model=growth", "state_model.next.state=x"],
        "state_model.next.state: x: there is no such name",
    ),
    (
        ["+experiment=polynomial", "state_model=growth"],
        "+experiment=polynomial: sets measurement, which is of",
    ),
    (
        ["+experiment=headline", "state_model=growth"],
        "+experiment=headline: sets noise, which is of a measurement",
    ),
    (["state_model=pendulum_book", "trials=2"], "trials=2: certified readings are one trial"),
]
MISTAKES |= {
    f"{command} of states, {word}": (
        [command, word],
        f"ipe-bench: state_model={word.rpartition('=')[2]}: states move, and {why}",
    )
    for command, why in (
        ("design", "design is of constants; use `ipe-bench run"),
        ("posterior", "posterior is of constants; use"),
    )
    for word in ("state_model=growth", "+experiment=pendulum_book")
}
COMMON = ("measurement=polynomial", "noise=gaussian", "execution=serial", "output=out", "trials=5")
MISTAKES |= {
    " ".join(words): (["run", "-m", *COMMON, *words], f"ipe-bench: {said}")
    for words, said in IN_A_SWEEP
}
MISTAKES |= {
    " ".join(words): (["run", *words, "output=out"], f"ipe-bench: {said}")
    for words, said in OF_STATES
}
OBJECTIVES = [
    (
        "newton.cost_medium",
        "objective=newton.cost_medium: there is no such column; did you mean cost_median?",
    ),
    (
        "newtn.cost_median",
        "objective=newtn.cost_median: there is no such estimator; did you mean newton?",
    ),
    ("cost_median", "objective=cost_median: write LABEL.COLUMN, such as newton.capped_error"),
    ("newton.equation", "objective=newton.equation: there is no such column"),
]
MISTAKES |= {
    name: (["run", *COMMON, f"objective={name}", "solver=[newton]"], said)
    for name, said in OBJECTIVES
}
MANY = ["measurement=ranging", "measurement.rounds=many"]
MISTAKES |= {
    f"many rounds in {command}": (
        [command, *MANY],
        "measurement.rounds=many: give a whole number above 0",
    )
    for command in ("estimate", "design", "posterior")
}
QUICK = (*SMALL, "trials=4", "execution=serial")


SOME = [
    pytest.param(case, marks=() if i % 6 == 0 else pytest.mark.slow)
    for i, case in enumerate(MISTAKES)
]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("run a*t my.csv --dry-run", "--dry-run: has no meaning with a model and readings of your"),
        ("run a*t my.csv -m seed=1,2", "-m: has no meaning with a model and readings of your own"),
        ("run a*t my.csv seed=1,2", "seed=1,2: is a sweep, which only runs of simulated trials"),
        ("estimate a*t my.csv error_scale=1,2", "error_scale=1,2: is a sweep, which only runs of"),
        (
            "design measurement=polynomial hydra.sweeper.params.error_scale='1,2'",
            "hydra.sweeper.params.error_scale='1,2': is a sweep, which only runs of simulated",
        ),
    ],
)
def test_a_command_of_one_job_takes_no_sweep_and_advises_none(tmp_path, ipe_bench, words, expected):
    (tmp_path / "my.csv").write_text("t,reading\n1,2\n2,3\n3,5\n4,8\n")
    code, _, error = ipe_bench(*words.split())
    assert (code, error.count("\n")) == (2, 1)
    assert expected in error


def test_the_help_of_list_names_groups_that_are_listed(ipe_bench):
    _, helped, _ = ipe_bench("list", "--help")
    named = re.search(r"^ +GROUP +(.*?);", helped, re.MULTILINE)[1]
    groups = [word for word in re.findall(r"\w+", named) if word != "or"]
    assert len(groups) > 1
    assert ipe_bench("list", *groups)[0] == 0


@pytest.mark.parametrize("case", SOME)
def test_a_mistake_is_one_line_with_exit_code_2(tmp_path, ipe_bench, case):
    arguments, expected = MISTAKES[case]
    code, _, error = ipe_bench(*arguments)
    assert code == 2
    assert expected in error
    assert len(error.strip().splitlines()) == 1
    assert not list(tmp_path.rglob("*.parquet"))


@pytest.mark.parametrize(
    "words",
    [
        ["noise.deviation=${error_scale}"],
        ["noise.deviation='${error_scale}'"],
        [*DEVIATION, "noise._target_=ipe_bench.noise.StudentT", "+noise.degrees_of_freedom=5"],
        ["+experiment=ranging", "measurement.rounds=5"],
        ["solver=[newton]", "+solver@estimators.b=broyden", "estimators.b.tolerance=1e-3"],
        ["measurement=nist/misra1a", "measurement.start=2"],
        ["estimators.fixed_point.budget=null"],
    ],
)
def test_a_right_command_line_is_taken(words, ipe_bench):
    code, _, err = ipe_bench("run", *words, "--cfg", "job")
    assert (code, err) == (0, "")


def test_no_file_is_overwritten(readings, ipe_bench):
    before = readings.read_text()
    code, _, error = ipe_bench("run", f"write_readings={readings}")
    assert code == 2
    assert "is not overwritten" in error
    assert readings.read_text() == before


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["measurement=nist/boxbod"], ["=nist/boxbod"]),
        (["-m", "measurement=nist/danwood, nist/enso"], ["=nist/danwood", "=nist/enso"]),
        (["-m", "measurement=glob(nist/mgh1*)"], ["=nist/mgh17", "=nist/mgh10"]),
        (["measurement=nist", "measurement.dataset=ENSO"], ["=nist, measurement.dataset=ENSO"]),
        (
            ["-m", "measurement=polynomial,nist/enso", "noise.deviation=1"],
            ["=polynomial", "=nist/enso"],
        ),
    ],
)
def test_a_data_set_may_be_written_as_an_option_of_its_own(words, expected, tmp_path, capsys):
    noise = [] if "noise.deviation=1" in words else ["noise=certified"]
    assert main(["run", *words, *noise, "trials=1", f"output={tmp_path}", "--dry-run"]) == 0
    *lines, _ = capsys.readouterr().out.splitlines()
    assert len(lines) == len(expected)
    assert all(
        line.startswith(f"measurement{name}, noise")
        for line, name in zip(lines, expected, strict=True)
    )


def test_hydras_own_flags_work_after_run(tmp_path, ipe_bench, monkeypatch):
    assert "error_scale: 5\n" in ipe_bench("run", "error_scale=5", "--cfg", "job")[1]
    monkeypatch.setenv("COMP_LINE", "ipe-bench run measurement=gi")
    monkeypatch.setenv("COMP_POINT", "28")
    assert "measurement=gins" in ipe_bench("-sc", "query=bash")[1]


@pytest.mark.parametrize(
    ("line", "meant"),
    [
        ("ipe-bench re", "report"),
        ("ipe-bench ", " ".join(COMMANDS)),
        ("ipe-bench estimate measurement=ran", "measurement=ranging"),
    ],
)
def test_a_shell_completes_commands_and_the_keys_behind_each(ipe_bench, monkeypatch, line, meant):
    monkeypatch.setenv("COMP_LINE", line)
    monkeypatch.setenv("COMP_POINT", str(len(line)))
    assert ipe_bench("-sc", "query=bash")[1].strip() == meant


@pytest.mark.slow
def test_hydra_says_where_it_looks(tmp_path):
    # Which sets up logging for the whole of its process.
    assert alone("run", "--info", "searchpath", folder=tmp_path).returncode == 0


LOADED = """
import sys
from ipe_bench.cli.main import COMMANDS, main
main(["--help"])
main(["list", "--help"])
known = ("pandas", "seaborn", "filterpy", "llvmlite", "hydra", "numpy", "rich")
print(sorted(m for m in known if m in sys.modules))
"""


def test_help_is_quick_to_load_and_names_the_commands():
    result = subprocess.run(
        [sys.executable, "-c", LOADED], capture_output=True, text=True, check=True
    )
    assert "ipe-bench estimate" in result.stdout
    assert result.stdout.strip().endswith("[]")


AGAIN = """
import sys
from ipe_bench.cli.main import main
main(sys.argv[1:])
print("pandas" in sys.modules)
"""


def test_a_finished_run_shows_its_table_without_pandas(ipe_bench, tmp_path):
    words = ("run", "measurement=polynomial", "solver=newton", "baseline=[]", "trials=2")
    words += ("figures=none",)
    assert ipe_bench(*words)[0] == 0
    result = subprocess.run(
        [sys.executable, "-c", AGAIN, *words],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    assert result.stdout.strip().endswith("False")


ESTIMATED = """
import sys
from ipe_bench.cli.main import main
main(["estimate", "measurement=nist/misra1a", "figures=none"])
print([m for m in ("matplotlib.pyplot", "scipy.optimize") if m in sys.modules])
"""


@pytest.mark.slow
def test_the_numbers_of_an_estimate_are_shown_without_what_takes_long_to_load(tmp_path):
    result = subprocess.run(
        [sys.executable, "-c", ESTIMATED], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert result.stdout.strip().endswith("[]")


@pytest.mark.slow
def test_a_plugin_without_its_header_or_with_a_taken_name_is_refused(tmp_path):
    conf = tmp_path / "plugins/mine/mine/conf/solver"
    conf.mkdir(parents=True)
    (tmp_path / "plugins/mine/mine/__init__.py").touch()
    (conf / "lost.yaml").write_text("_target_: mine.Lost\n")
    assert "first line must be" in alone("list", folder=tmp_path).stderr
    (conf / "lost.yaml").unlink()
    (conf / "newton.yaml").write_text("# @package estimators.newton\n_target_: mine.Newton\n")
    assert "rename one of the two" in alone("list", folder=tmp_path).stderr


@pytest.mark.slow
def test_estimate_leaves_numbers_residuals_and_figures_from_csv_and_parquet_alike(
    readings, tmp_path, ipe_bench
):
    # By themselves, both engines of pandas 2 round the last digit of some numbers.
    exact = dict.fromkeys(("time [min]", "reading [m/s]"), float)
    pd.read_csv(readings, converters=exact).to_parquet(tmp_path / "trial.parquet")
    results = []
    for file, drawn in (
        (readings, "none"),
        (tmp_path / "trial.parquet", "none"),
        (readings, "all"),
    ):
        code, out, error = ipe_bench(
            "estimate", f"readings={file}", "error_scale=10", f"figures={drawn}"
        )
        assert code == 0, error
        assert all(len(line) <= 120 for line in out.splitlines())
    # The second file is another command, and the third run is the first command again.
    folders = sorted(path.name for path in (tmp_path / "outputs").iterdir())
    assert folders == ["estimate-gins", "estimate-gins-2"]
    files = {path.name for path in (tmp_path / "outputs" / folders[0]).iterdir()}
    assert "residuals.png" in files
    for folder in folders:
        results.append(json.loads((tmp_path / "outputs" / folder / "estimate.json").read_text()))
        table = pd.read_csv(tmp_path / "outputs" / folder / "residuals.csv")
        assert len(table) == 3 * 240
    assert results[0]["estimators"] == results[1]["estimators"]
    found = results[0]["estimators"]["auto"]
    assert found["fits"]
    assert found["outliers"] == []
    assert len(found["correlation"]) == 11
    assert not results[0]["estimators"]["linear_lse"]["fits"]
    assert {"numpy", "scipy"} <= set(results[0]["libraries"])


def test_an_estimate_draws_nothing_where_no_figures_are_asked_for_and_overwrites_no_other_command(
    tmp_path, ipe_bench
):
    words = ("estimate", "measurement=nist/misra1a", "solver=[]", "output=out")
    assert ipe_bench(*words, "baseline=[levenberg_marquardt]")[0] == 0
    drawn = {path.name for path in (tmp_path / "out").iterdir() if path.suffix in (".png", ".pdf")}
    assert "residuals.png" in drawn
    assert ipe_bench(*words, "baseline=[levenberg_marquardt]", "figures=none")[0] == 0
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "estimate.json",
        "residuals.csv",
        "estimate.html",
    }
    assert "<img" not in (tmp_path / "out" / "estimate.html").read_text(encoding="utf-8")
    (tmp_path / "out" / "residuals.csv").write_text("mine")
    code, _, error = ipe_bench(*words, "baseline=[gauss_newton]")
    assert code == 2
    assert "output=out: contains results of another command" in error
    assert (tmp_path / "out" / "residuals.csv").read_text() == "mine"


@pytest.mark.parametrize("words", ["design by=tim", "posterior particles=5"])
def test_a_refused_command_leaves_its_folder_to_the_mended_one(words, tmp_path, ipe_bench):
    command, wrong = words.split()
    assert ipe_bench(command, "measurement=polynomial", wrong, "output=out")[0] == 2
    assert not (tmp_path / "out").exists()


def test_a_taken_folder_is_refused_before_a_log_is_tracked(tmp_path, ipe_bench, monkeypatch):
    monkeypatch.setattr(LogTracks, "of", lambda *_: pytest.fail("a tracker has begun"))
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "track.csv").write_text("mine")
    code, _, error = ipe_bench(
        "estimate", "state_model=pendulum_book", "tracker=[ekf]", "output=out"
    )
    assert code == 2
    assert "output=out: contains results of another command" in error


def test_the_bare_program_and_every_command_have_help(capsys):
    for words in ([], ["help"], ["-h"]):
        assert main(words) == 0
        text = capsys.readouterr().out
        assert all(re.search(rf"\n    {command}\s", text) for command in COMMANDS)
    for command in COMMANDS:
        texts = []
        for words in ([command, "--help"], ["help", command]):
            assert main(words) == 0
            texts.append(capsys.readouterr().out)
        assert texts[0] == texts[1]
        assert f"ipe-bench {command}" in texts[0]


def test_the_table_of_keys_names_every_field_of_a_job_and_every_group_that_jobs_choose_from():
    names = [key.name for key in ROWS]
    several = {"solver", "baseline", "tracker"}
    differing = {*names} ^ {*KEYS, *several, "experiment", "GROUP"}
    assert not differing, (
        f"{differing}: a field of Spec without a row in cli/keys.py, or a row without a field"
    )
    assert len({*names}) == len(names)
    defaults = yaml.safe_load((ROOT / "conf/config.yaml").read_text(encoding="utf-8"))["defaults"]
    groups = {key.rpartition("@")[2] for one in defaults if isinstance(one, dict) for key in one}
    assert {group for group in groups if not group.startswith("override ")} == {*PARTS, *several}
    kinds = get_type_hints(Spec, include_extras=True)
    assert {*WHOLE} == {
        name for name, kind in kinds.items() if {kind, *get_args(kind)} & {Count, Whole}
    }
    assert all(key.kind for key in ROWS if key.name in KEYS)


def test_the_help_of_run_explains_every_key_of_the_config_in_a_line(capsys):
    assert main(["run", "--help"]) == 0
    text = capsys.readouterr().out
    config = yaml.safe_load((ROOT / "conf/config.yaml").read_text(encoding="utf-8"))
    keys = {*KEYS, "solver", "baseline", "experiment", *config} - {"defaults", "hydra"}
    assert {key for key in keys if not re.search(rf"\b{key}\b", text)} == set()


@pytest.mark.slow
@pytest.mark.parametrize("word", ["parameters=pipe", "measurement.file=pipe", "readings=pipe"])
def test_a_pipe_in_place_of_a_file_is_not_waited_for(ipe_bench, word):
    os.mkfifo("pipe")
    code, _, error = ipe_bench("estimate", "measurement=polynomial", word)
    assert (code, error.count("\n")) == (2, 1)
    assert "pipe: " in error


@pytest.mark.slow
def test_a_reader_that_closes_the_pipe_is_no_mistake(tmp_path):
    for words in (
        ["list", "measurement", "-v"],
        ["run", *QUICK, "figures=none", f"output={tmp_path / 'out'}"],
    ):
        command = [sys.executable, "-m", "ipe_bench", *words]
        with subprocess.Popen(
            command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        ) as process:
            assert process.stdout is not None
            assert process.stderr is not None
            process.stdout.close()
            assert not [
                line for line in process.stderr.read().decode().splitlines() if "block" not in line
            ]
        assert process.returncode == 0
    assert (tmp_path / "out/summary.csv").is_file()


@pytest.mark.slow
def test_a_stream_that_knows_no_greek_letters_shows_question_marks(tmp_path):
    result = alone(
        "run", *QUICK, "figures=none", "output=out", folder=tmp_path, PYTHONIOENCODING="ascii"
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.isascii()


def test_filters_that_nobody_chose_are_left_out_where_the_model_has_no_use_for_them(ipe_bench):
    words = [
        "run",
        "measurement=nist/boxbod",
        "noise=certified",
        "trials=1",
        "figures=none",
        "output=out",
    ]
    code, out, _ = ipe_bench(*words)
    assert code in (0, 1)
    assert "ekf and ukf are left out for nist" in " ".join(out.split())
    assert set(ib.load("out")["estimator"]) == {"fixed_point", "linear_lse"}
    code, _, error = ipe_bench(*words, "baseline=[ekf]")
    assert code == 2
    assert "estimators.ekf: needs an order of the readings in time" in error


CASES = {
    "one case": (
        "measurement=gins",
        "measurement.injected=[[1500,0]]",
        "measurement.readings_per_case=6",
    ),
    "one reading": (
        *(
            "measurement=formula",
            "measurement.expression=a*t",
            "measurement.start.a=1",
            "measurement.columns.t=[1]",
        ),
        "noise.deviation=0.1",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_a_model_of_one_case_or_one_reading_warns_of_nothing(ipe_bench, case):
    """Tables and figures included: warnings are errors."""
    code, out, error = ipe_bench("run", *CASES[case], "trials=3", "execution=serial")
    assert code == 0, error
    assert "Warning" not in out + error


def test_a_model_that_brings_its_own_certified_readings_has_a_table(ipe_bench):
    words = (
        "measurement=nist",
        "noise=certified",
        "trials=1",
        "figures=none",
        "output=out",
        "solver=[]",
    )
    code, out, _ = ipe_bench("run", *words, "baseline=[gauss_newton]")
    assert code == 0
    assert "gauss_newton" in out
    assert "no trials yet" not in out


def test_the_list_names_our_statistics_and_figures_too(capsys):
    """Also where no plugin adds any; without a name they are left out, since they are no
    options."""
    for group, names in (
        ("statistic", [one.name for one in (*STATISTICS, *SCORES)]),
        ("figure", list(figures.NAMES)),
    ):
        assert main(["list", group]) == 0
        assert set(names) <= set(capsys.readouterr().out.split())
    assert main(["list", "statistic/success"]) == 0
    assert "Clopper and Pearson" in capsys.readouterr().out
    assert main(["list"]) == 0
    assert "error_median" not in capsys.readouterr().out.split()


@pytest.mark.parametrize(
    ("launcher", "package"),
    [("submitit_local", '"ipe-bench[submitit]"'), ("rq", "hydra-rq-launcher")],
)
def test_a_launcher_that_is_missing_is_installed_under_the_name_that_it_has(
    launcher, package, capsys
):
    package_of_plugin = f"hydra-{launcher.partition('_')[0]}-launcher"
    if package_of_plugin in {found.name for found in distributions()}:
        pytest.skip(f"{launcher} is installed")
    assert main(["run", "-m", f"hydra/launcher={launcher}", "error_scale=1,2"]) == 2
    assert f"is not installed; pip install {package}, or choose basic" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("command", "label"),
    [
        ("ipe-bench run -m measurement=gins noise.deviation=2 error_scale=1,3", "error_scale=3"),
        ("ipe-bench run noise.deviation=2 error_scale=3", "noise.deviation=2, error_scale=3"),
    ],
)
def test_progress_names_what_the_sweep_gives_to_a_job(command, label):
    typed = ("measurement=gins",) if " -m " in command else ()
    job = Outcome("outputs/mine", (*typed, "+noise.deviation=2", "error_scale=3"))
    assert job.label(command) == label


def test_a_run_says_which_entry_of_a_model_is_not_finite(ipe_bench):
    """A reading of 0/0 at the mean of the prior, where its slope is taken; sigma points miss it."""
    model = ["next.x=x+w", "readings.z=sin(x)/x", "noise.w=0.1", "deviation.z=1", "spread.x=1"]
    words = [f"state_model.{word}" for word in model]
    asked = ["run", "state_model=formulas", *words, "tracker=[ekf,ukf]", "trials=4", "figures=none"]
    code, out, _ = ipe_bench(*asked, "output=bad")
    told = [line for line in out.splitlines() if "no trial is finite" in line]
    assert code == 0
    assert len(told) == 1
    assert told[0].startswith("ekf: ")
    assert "readings.z is nan at the mean of the prior" in " ".join(out.split())


def test_a_program_without_a_terminal_has_an_answer(monkeypatch):
    """As of pythonw, whose streams are None."""
    monkeypatch.setattr(sys, "stdout", None)
    monkeypatch.setattr(sys, "stderr", None)
    assert main(["--version"]) == 0
    assert main(["list", "solver"]) == 0
    assert main(["list", "nothing"]) == 2


@pytest.mark.parametrize("command", ["run", "report"])
def test_a_full_disk_is_told_alike_of_commands_that_resume_and_begin_anew(command):
    assert _explain(OSError(errno.ENOSPC, "No space left", "a.csv"), [command]) == (
        1,
        "a.csv: No space left; earlier results are intact; free some space and run the same"
        " command again",
    )
