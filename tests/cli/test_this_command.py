"""What a command answers is about what it asked for: its scenarios, a folder of its own, what it
would do."""

import re
import signal
from pathlib import Path

import pandas as pd
import pytest

from ipe_bench.cli.words import default_name, read

SMALL = (
    "measurement=polynomial",
    "noise=gaussian",
    "noise.deviation=0.01",
    "execution=serial",
    "baseline=[]",
)
SMALL += ("figures=none",)


def rows_of(text: str, name: str) -> int:
    """How many rows of tables are about the estimator of that name."""
    return sum(line.startswith(" ") and name in line.split() for line in text.splitlines())


def test_run_shows_what_it_asked_for_and_counts_the_rest(ipe_bench):
    for solver in ("newton", "fixed_point"):
        code, out, _ = ipe_bench("run", *SMALL, f"solver=[{solver}]", "trials=8", "output=both")
        assert code == 0
        assert rows_of(out, solver) == 1
    assert rows_of(out, "newton") == 0
    assert "1 result of other commands; `ipe-bench report both` shows all" in out
    # Another setting of one label gives the label no other name, and it is not shown with this one.
    _, out, _ = ipe_bench(
        "run",
        *SMALL,
        "solver=[newton]",
        "estimators.newton.max_iterations=50",
        "trials=8",
        "output=both",
    )
    assert rows_of(out, "newton") == 1
    assert "max_iterations" not in out
    _, out, _ = ipe_bench("report", "both", "figures=none")
    assert rows_of(out, "fixed_point") == 1
    assert "max_iterations" in out


@pytest.mark.slow
def test_a_folder_with_results_of_other_settings_is_said_to_hold_them(ipe_bench):
    words = (*SMALL, "solver=[newton]", "output=mixed")
    assert "mixed: holds" not in ipe_bench("run", *words, "trials=4")[1]
    # More trials, and a sweep that includes what is there, have nothing beside them.
    assert "mixed: holds" not in ipe_bench("run", *words, "trials=8")[1]
    assert "mixed: holds" not in ipe_bench("run", "-m", *words, "trials=8", "error_scale=1,3")[1]
    _, out, _ = ipe_bench("run", *words, "trials=8", "seed=5")
    assert "mixed: contains 2 results of other settings or older code; they are kept" in out


def test_the_name_of_an_experiment_is_for_the_experiment(ipe_bench):
    code, _, error = ipe_bench("run", *SMALL, "name=headline", "trials=8")
    assert code == 2
    assert "name=headline: is the name of an experiment" in error
    assert "write output=outputs/headline" in error
    assert not Path("outputs/headline").exists()
    for words in (
        ["+experiment=polynomial", "name=polynomial"],
        ["+experiment=polynomial", "name=mine"],
        ["name=b"],
    ):
        code, out, _ = ipe_bench("run", *words, "--dry-run")
        assert (code, "none was computed" in out) == (0, True)


NAMES = {
    "": "gins",
    "trials=50 seed=3 execution=serial block_size=10": "gins",
    "error_scale=300": "gins-error_scale=300",
    "error_scale=1,10,100": "gins-error_scale=1,10,100",
    **dict.fromkeys(
        (
            "measurement=ranging noise=gaussian noise.deviation=0.1",
            "noise.deviation=0.1 noise=gaussian measurement=ranging",
        ),
        "ranging-gaussian-noise.deviation=0.1",
    ),
    "solver=[newton,fixed_point] baseline=[ekf]": "gins-newton+fixed_point-ekf",
    "solver=[] baseline=[ekf]": "gins-no_solver-ekf",
    "measurement=nist/misra1a noise=certified": "nist-misra1a-certified",
    "truth_measurement=gins_platform_misaligned": "gins-truth=gins_platform_misaligned",
    "estimators.fixed_point.tolerance=1e-9": "gins-fixed_point.tolerance=1e-9",
    "+solver@estimators.n2=newton": "gins-n2=newton",
    "+experiment=paper": "paper",
    "+experiment=paper error_scale=3": "paper-error_scale=3",
}


@pytest.mark.parametrize("words", NAMES)
def test_a_folder_is_named_after_what_was_asked(words):
    assert default_name(read("run", words.split())) == NAMES[words]


def test_a_model_of_a_file_is_told_by_the_name_of_the_file(ipe_bench):
    assert ipe_bench("new", "ode", "decay")[0] == 0
    words = (
        "run",
        "measurement=ode",
        "measurement.file=decay.yaml",
        "baseline=[]",
        "trials=4",
        "figures=none",
    )
    code, _, error = ipe_bench(*words)
    assert code == 0
    assert "measurement.file=decay.yaml" in error
    assert "rates" not in error
    (folder,) = Path("outputs").iterdir()
    assert folder.name.startswith("ode-no_baseline-file=decay.yaml-")
    Path("decay.yaml").write_text(Path("decay.yaml").read_text().replace("0.4", "0.5"))
    assert ipe_bench(*words)[0] == 0
    assert len(list(Path("outputs").iterdir())) == 2


def test_a_long_name_is_cut_and_stays_one_of_a_kind():
    names = [
        default_name(read("run", [f"prior.deviations=[{'1,' * 60}{last}]"])) for last in (1, 2)
    ]
    assert names[0] != names[1]
    assert all(len(name) <= 80 for name in names)


def test_unnamed_commands_have_folders_of_their_own_and_the_same_one_goes_on(ipe_bench):
    for solver in ("newton", "fixed_point", "newton"):
        assert ipe_bench("run", *SMALL, f"solver=[{solver}]", "trials=8")[0] == 0
    folders = sorted(path.name for path in Path("outputs").iterdir())
    common = "polynomial-gaussian-{}-no_baseline-noise.deviation=0.01"
    assert folders == [common.format(solver) for solver in ("fixed_point", "newton")]
    assert all(len(list((Path("outputs") / f / "trials").iterdir())) == 2 for f in folders)


@pytest.mark.slow
def test_a_dry_run_says_what_is_missing_and_computes_nothing(ipe_bench):
    words = ("run", *SMALL, "solver=[newton]", "-m", "error_scale=1,3", "output=dry")
    code, out, _ = ipe_bench(*words, "trials=8", "--dry-run")
    assert code == 0
    assert "0 estimates are stored, 16 would be computed" in out
    assert not Path("dry").exists()
    assert ipe_bench(*words, "trials=8")[0] == 0
    stored = set(Path("dry").rglob("*"))
    _, out, _ = ipe_bench(*words, "trials=8", "--dry-run")
    assert "16 estimates are stored, 0 would be computed" in out
    _, out, _ = ipe_bench(*words, "trials=20", "--dry-run")
    assert "16 estimates are stored, 24 would be computed" in out
    assert set(Path("dry").rglob("*")) == stored
    # Each job is told from the others.
    _, out, _ = ipe_bench(
        "run", *SMALL, "solver=[newton]", "-m", "noise.deviation=0.01,0.02", "trials=8", "--dry-run"
    )
    lines = out.splitlines()[:-1]
    assert [line.split("noise.deviation=")[1].split(":")[0] for line in lines] == ["0.01", "0.02"]


def test_status_says_complete_in_a_line(ipe_bench):
    assert ipe_bench("run", *SMALL, "solver=[newton]", "trials=8", "output=whole")[0] == 0
    code, out, _ = ipe_bench("status", "whole")
    told = "whole: complete: results (an estimator in a scenario): 1; estimates: 8\n"
    assert (code, out) == (0, told)
    assert rows_of(ipe_bench("status", "whole", "-v")[1], "newton") == 1
    next(Path("whole/trials").glob("*-0-8.parquet")).unlink()
    code, out, _ = ipe_bench("status", "whole")
    assert code == 1
    assert "missing" in out


def test_a_report_on_two_folders_needs_a_third(ipe_bench):
    for scale in (1, 3):
        words = (*SMALL, "solver=[newton]", "trials=8", f"error_scale={scale}", f"output=s{scale}")
        assert ipe_bench("run", *words)[0] == 0
    before = Path("s1/summary.csv").read_bytes()
    code, _, error = ipe_bench("report", "s1", "s3", "figures=none")
    assert code == 2
    assert "need output=DIR" in error
    assert Path("s1/summary.csv").read_bytes() == before
    assert ipe_bench("report", "s1", "s3", "output=both", "figures=none")[0] == 0
    assert set(pd.read_csv("both/summary.csv")["error_scale"]) == {1.0, 3.0}


EXPERIMENT = """\
# @package _global_
# Mine.
defaults:
  - override /measurement: polynomial
  - override /noise: gaussian
  - override /solver: [newton]
  - override /baseline: []
noise: {deviation: 0.01}
trials: 4
hydra:
  sweeper: {params: {error_scale: "1,3,10"}}
"""


def test_an_experiment_of_ones_own_sweeps_as_ours_do(ipe_bench):
    folder = Path("conf/experiment")
    folder.mkdir(parents=True)
    (folder / "mine.yaml").write_text(EXPERIMENT)
    code, out, _ = ipe_bench(
        "run", "--config-dir", "conf", "+experiment=mine", "execution=serial", "figures=none"
    )
    assert code == 0
    # One in the matrix, where scales that say the same are one column, and one in the table of one
    # scale.
    assert rows_of(out, "newton") == 2
    assert re.search(r"error scale → +[\d.]+ to 10", out)
    assert [path.name for path in Path("outputs").iterdir()] == ["mine"]


CALLED = {
    "a callback": "callbacks: '${oc.decode:"
    """"{x:{_target_:shutil.copyfile,src:mine,dst:copy}}"}'""",
    "a handler of logs": "job_logging: {version: 1, root: {handlers: [x]},"
    " handlers: {x: {class: logging.FileHandler, filename: mine, mode: w}}}",
}


@pytest.mark.parametrize("below_hydra", CALLED.values(), ids=CALLED)
def test_an_experiment_has_no_function_called(ipe_bench, below_hydra):
    Path("mine").write_text("kept")
    package = Path("plugins/theirs/theirs_of_this_test")
    folder = package / "conf/experiment"
    folder.mkdir(parents=True)
    (package / "__init__.py").touch()
    (folder / "mine.yaml").write_text(
        f"# @package _global_\nhydra:\n  job: {{env_set: {{A: b}}}}\n  {below_hydra}\n"
    )
    words = ("+experiment=mine", *SMALL, "solver=[newton]", "trials=2")
    code, _, err = ipe_bench("run", *words)
    assert (code, err.count("\n")) == (2, 1)
    assert "hydra." in err
    assert Path("mine").read_text() == "kept"
    assert not Path("copy").exists()


@pytest.mark.parametrize(
    ("command", "said"), [("run", "the same command to resume"), ("estimate", "begins anew")]
)
def test_a_command_that_is_stopped_exits_as_a_shell_says_of_ctrl_c(
    ipe_bench, monkeypatch, command, said
):
    """128 and the number of SIGINT, 2; a failure is 1, a mistake 2."""

    def stop(words):
        raise KeyboardInterrupt

    monkeypatch.setattr("ipe_bench.cli.main._dispatch", stop)
    code, _, error = ipe_bench(command)
    assert code == 128 + signal.SIGINT
    assert "stopped" in error
    assert said in error
