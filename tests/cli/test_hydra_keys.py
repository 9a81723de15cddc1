"""A plugin's config has no function called, no file emptied and no environment changed by Hydra;
what a person types, or keeps in a folder that they name, does all that Hydra can."""

import sys
from pathlib import Path

import pytest
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf
from shared.families import slow_if

from ipe_bench.basics.errors import UserError
from ipe_bench.cli import words as w
from ipe_bench.cli.main import main
from ipe_bench.cli.session import Jobs, jobs_of, session
from ipe_bench.plugins import discovery

COPY = "{_target_: shutil.copyfile, src: a, dst: b}"
DECODED = "'${oc.decode:\"{x:{_target_:shutil.copyfile,src:a,dst:b}}\"}'"
EMPTIES = (
    "{version: 1, handlers: {x: {class: logging.FileHandler, filename: a, mode: w}}, root:"
    " {handlers: [x]}}"
)
READ = (
    "{version: 1, handlers: {x: {class: logging.StreamHandler, stream: 'ext://mine.x'}}, root:"
    " {handlers: [x]}}"
)
ATTACKS = {
    # What an experiment says below hydra, and the key that is named.
    "a callback": (f"callbacks: {{mine: {COPY}}}", "hydra.callbacks.mine._target_=shutil.copyfile"),
    "a callback that is decoded": (f"callbacks: {DECODED}", "hydra.callbacks"),
    "a callback that is made": ("callbacks: '${oc.create:${parameters}}'", "hydra.callbacks"),
    "a callback from another key": ("callbacks: ${parameters}", "hydra.callbacks"),
    "Hydra's own callback": (
        "callbacks: {x: {_target_: hydra.experimental.callbacks.PickleJobInfoCallback}}",
        "hydra.callbacks.x._target_",
    ),
    "a handler that empties a file": (f"job_logging: {EMPTIES}", "hydra.job_logging.version=1"),
    "that of Hydra's log": (f"hydra_logging: {EMPTIES}", "hydra.hydra_logging.version=1"),
    "a stream that is imported": (f"job_logging: {READ}", "hydra.job_logging.version=1"),
    "a factory of formatters": (
        "job_logging: {formatters: {x: {(): os.getcwd}}}",
        "hydra.job_logging.formatters.x",
    ),
    "an environment": ("job: {env_set: {LD_PRELOAD: x.so}}", "hydra.job.env_set.LD_PRELOAD=x.so"),
    "a secret in the log": ("job: {env_copy: [HOME]}", "hydra.job.env_copy.0=HOME"),
    "another folder to work in": ("job: {chdir: true}", "hydra.job.chdir=True"),
    "files beside the log": ("output_subdir: ../..", r"hydra.output_subdir=\.\./\.\."),
    "words of a command": ("overrides: {task: ['hydra.job.chdir=true']}", "hydra.overrides"),
    "a launcher": (f"launcher: {COPY}", "hydra.launcher._target_=shutil.copyfile"),
    "a launcher from another key": ("launcher: ${parameters}", "hydra.launcher"),
    "a part of a launcher": (f"launcher: {{x: {COPY}}}", r"hydra.launcher.x._target_"),
    "a part that is decoded": (f"launcher: {{x: {DECODED}}}", r"hydra.launcher.x"),
    "a part from another key": ("launcher: {x: '${parameters}'}", r"hydra.launcher.x"),
    "lines of a shell": (
        "launcher: {setup: ['rm -rf x']}",
        r"hydra.launcher.setup.0=rm -rf x: runs",
    ),
    "a sweeper": (f"sweeper: {COPY}", "hydra.sweeper._target_=shutil.copyfile"),
    "a function of a sweeper": (
        "sweeper: {custom_search_space: os.abort}",
        "custom_search_space=os.abort: runs",
    ),
    "a sweep of Hydra's keys": (
        "sweeper: {params: {+hydra.job.chdir: 'true'}}",
        r"hydra.sweeper.params.\+hydra",
    ),
    "a sweep into them": (
        "sweeper: {params: {noise@hydra.env: none}}",
        "hydra.sweeper.params.noise@hydra",
    ),
    "a folder by a resolver": ("sweep: {dir: '${oc.env:HOME}/x'}", "hydra.sweep.dir="),
    "loggers by a resolver": ("verbose: ['${oc.env:HOME}']", "hydra.verbose.0="),
}
TYPED = (
    "job.chdir=true",
    "+job.env_set.A=b",
    "+job.env_set={A:b}",
    "job.name=a",
    "output_subdir=null",
    "verbose=true",
    "run.dir='${oc.env:HOME}/x'",
    "+launcher.setup=[module load x]",
    "searchpath=[file:///tmp]",
    "+callbacks.x._target_=mine.Told",
)
FREE = "defaults: [override /hydra/launcher: free, override /hydra/sweeper: free]"
PLUGIN = Path("plugins/other/other/conf")
OWN = Path("conf")
TOLD = """
from hydra.experimental.callback import Callback


class Told(Callback):
    def on_job_end(self, config, job_return, **_):
        print("told", config.error_scale, job_return.return_value.failures)
"""
SMALL = ("measurement=polynomial", "noise=gaussian", "trials=4", "solver=[newton]", "baseline=[]")
SMALL += ("figures=none", "name=a")


@pytest.fixture(autouse=True)
def at_home(tmp_path, monkeypatch):
    """A working folder with a plugin that has no config yet."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / PLUGIN).mkdir(parents=True)
    (tmp_path / PLUGIN).with_name("__init__.py").touch()
    packages = {*discovery.packages}
    path = [*sys.path]
    discovery.sources.cache_clear()
    yield
    discovery.sources.cache_clear()
    discovery.packages.clear()
    discovery.packages.update(packages)
    sys.path[:] = path


def write(home: Path, below_hydra: str, head: str = "") -> None:
    """Writes an experiment `mine` that says this below hydra."""
    (home / "experiment").mkdir(parents=True, exist_ok=True)
    for part in ("launcher", "sweeper"):  # whose options have no types, unlike Hydra's
        (home / f"hydra/{part}").mkdir(parents=True, exist_ok=True)
        target = f"hydra._internal.core_plugins.basic_{part}.Basic{part.title()}"
        (home / f"hydra/{part}/free.yaml").write_text(f"_target_: {target}\n")
    content = f"# @package _global_\n{head}\nhydra:\n  {below_hydra}\n"
    (home / "experiment/mine.yaml").write_text(content)


def planned(*words: str, folder: Path | None = None) -> Jobs:
    """What a command would run by that experiment."""
    with session(folder):
        return jobs_of(w.read("run", ["+experiment=mine", *words], folder), multirun=False)


@pytest.mark.parametrize("attack", slow_if(lambda one: [*ATTACKS].index(one) % 3 > 0, ATTACKS))
def test_a_plugin_says_to_hydra_what_is_on_the_list(attack):
    below_hydra, said = ATTACKS[attack]
    write(PLUGIN, below_hydra, head=f"parameters: {{x: {COPY}}}\n{FREE}")
    with pytest.raises(UserError, match=f"{said}.*; copy experiment/mine.yaml into a folder"):
        planned()


@pytest.mark.parametrize("home", [PLUGIN, OWN])
def test_an_experiment_adds_no_place_of_configs(home):
    write(home, "searchpath: ['pkg://this']")
    with pytest.raises(UserError, match="only supported from the primary config"):
        planned(folder=OWN)


@pytest.mark.parametrize(
    ("name", "word"),
    [("noise/mine", "noise=mine"), ("hydra/job_logging/mine", "hydra/job_logging=mine")],
)
def test_options_of_a_plugin_are_held_to_the_list(name, word):
    """Also where the option is chosen for a job of a sweep alone, as a launcher's process does."""
    file = PLUGIN / f"{name}.yaml"
    file.parent.mkdir(parents=True)
    file.write_text(f"# @package _global_\nhydra: {{callbacks: {{x: {COPY}}}}}\n")
    with session(OWN):
        loader = GlobalHydra.instance().config_loader()
        plain = OmegaConf.create(
            {"hydra": {"overrides": {"hydra": []}, "job": {"config_name": "config"}}}
        )
        with pytest.raises(UserError, match=r"hydra\.callbacks\.x"):
            loader.load_sweep_config(plain, [word])


@pytest.mark.parametrize("name", ["config", "schema", "hydra/config"])
def test_a_folder_does_not_replace_the_config(name):
    write(OWN, "verbose: false")
    Path(f"conf/{name}.yaml").parent.mkdir(parents=True, exist_ok=True)
    Path(f"conf/{name}.yaml").touch()
    with pytest.raises(UserError, match="would replace"):
        planned(folder=OWN)


def test_what_is_on_the_list_is_taken():
    sweep = "{dir: '${output}/${now:%Y}', subdir: '${hydra.job.num}'}"
    write(
        PLUGIN,
        f"{{mode: MULTIRUN, verbose: [a], run: {{dir: '${{output}}'}}, sweep: {sweep}, "
        "job: {env_set: {}}, output_subdir: .hydra, "
        "sweeper: {max_batch_size: 2, params: {error_scale: '1,3', seed: '${trials}'}}}",
    )
    jobs = planned("trials=4")
    assert [(one.error_scale, one.seed) for one in jobs.specs] == [(1, 4), (3, 4)]


@pytest.mark.parametrize("word", TYPED)
def test_the_command_line_says_all(word):
    write(PLUGIN, "verbose: false")
    plus = "+" * word.startswith("+")
    assert len(planned(f"{plus}hydra.{word.lstrip('+')}").specs) == 1


def test_what_the_command_line_says_brings_nothing_else_in():
    write(PLUGIN, "job: {env_set: {B: c}}")
    with pytest.raises(
        UserError, match=r"hydra\.job\.env_set\.B=c: .* or write this on the command line"
    ):
        planned("+hydra.job.env_set.A=b")


@pytest.fixture
def mine(tmp_path, monkeypatch):
    (tmp_path / "mine.py").write_text(TOLD)
    monkeypatch.syspath_prepend(tmp_path)
    yield
    sys.modules.pop("mine", None)


def test_a_callback_that_is_typed_is_called(mine, capsys):
    assert main(["run", *SMALL, "+hydra.callbacks.x._target_=mine.Told"]) == 0
    assert "told 1.0 ()" in capsys.readouterr().out


def test_a_callback_of_a_folder_that_is_named_is_called_after_each_job(mine, capsys):
    write(OWN, "callbacks: {x: {_target_: mine.Told}}")
    words = ["-cd", "conf", "+experiment=mine", *SMALL, "+hydra.sweeper.params.error_scale='1,3'"]
    assert main(["run", *words]) == 0
    out = capsys.readouterr().out
    assert [f"told {scale} ()" in out for scale in (1, 3)] == [True, True]


def test_a_folder_within_a_folder_is_no_formula(capsys):
    Path("my/conf").mkdir(parents=True)
    assert main(["run", "-cd", "my/conf", *SMALL, "--dry-run"]) == 0


def test_a_primary_config_of_ones_own(capsys):
    OWN.mkdir()
    (OWN / "study.yaml").write_text("defaults: [config, _self_]\ntrials: 7\n")
    assert (
        main(["run", "-cd", "conf", "--config-name", "study", "--cfg", "job", "-p", "trials"]) == 0
    )
    assert capsys.readouterr().out.strip() == "7"


def test_a_job_runs_again_by_the_words_that_hydra_left(capsys):
    assert main(["run", *SMALL, "hydra.verbose=false", "seed=3"]) == 0
    assert main(["run", "--experimental-rerun", "outputs/a/log", "trials=6", "--dry-run"]) == 0
    assert "4 of 6 estimates are stored, 2 are missing" in capsys.readouterr().out
    assert main(["run", "--experimental-rerun", "outputs"]) == 2
    assert "there is no overrides.yaml" in capsys.readouterr().err


def test_hydras_help_is_its_own(capsys):
    assert main(["run", "--hydra-help"]) == 0
    assert "== Configuration groups ==" in capsys.readouterr().out


BOMB = "a: &a [1,1,1,1,1,1,1,1,1,1]\n" + "".join(
    f"{new}: &{new} [{','.join([f'*{old}'] * 10)}]\n"
    for old, new in zip("abcdefghi", "bcdefghij", strict=True)
)
FILES = {
    "a bomb": (BOMB.encode(), "expands to more than 100000 values; use fewer aliases"),
    "one within itself": (b"a: &a [*a]\n", "expands to more than 100000 values"),
    "a byte order mark": (b"\xef\xbb\xbf# @package _global_\r\n", "begins with a byte order mark"),
    "Latin-1": (b"# \xe9\ntrials: 3\n", "is not UTF-8; save it as UTF-8"),
    "brackets": (b"trials: " + 5000 * b"[" + 5000 * b"]", "is nested too deeply"),
    "no YAML": (b"trials: [3\n", "is not YAML that can be read"),
}


@pytest.mark.parametrize(("content", "said"), FILES.values(), ids=FILES)
def test_a_file_that_hydra_would_misread_is_named(content, said):
    (OWN / "experiment").mkdir(parents=True)
    (OWN / "experiment/mine.yaml").write_bytes(content)
    with pytest.raises(UserError, match=f"conf/experiment/mine.yaml.*{said}"):
        planned(folder=OWN)


def test_an_experiment_that_includes_itself_is_named():
    write(OWN, "verbose: false", "defaults: [mine]")
    with pytest.raises(UserError, match=r"\+experiment=mine: its defaults lead back to itself"):
        planned(folder=OWN)
