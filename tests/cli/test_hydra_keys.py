"""A config of a foreign hand has no function called, no file emptied and no environment changed by
Hydra."""

from pathlib import Path

import pytest
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf
from shared.families import slow_if

from ipe_bench.basics.errors import UserError
from ipe_bench.cli import words as w
from ipe_bench.cli.session import Jobs, jobs_of, session

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
    "a handler that empties a file": (f"job_logging: {EMPTIES}", "hydra.job_logging.root"),
    "that of Hydra's log": (f"hydra_logging: {EMPTIES}", "hydra.hydra_logging.root"),
    "a stream that is imported": (f"job_logging: {READ}", "hydra.job_logging.root"),
    "a factory of formatters": (
        "job_logging: {formatters: {x: {(): os.getcwd}}}",
        "hydra.job_logging.formatters.x",
    ),
    "an environment": ("job: {env_set: {LD_PRELOAD: x.so}}", "hydra.job.env_set.LD_PRELOAD=x.so"),
    "a secret in the log": ("job: {env_copy: [HOME]}", "hydra.job.env_set.HOME="),
    "another folder to work in": ("job: {chdir: true}", "hydra.job.chdir=True"),
    "files beside the log": ("output_subdir: ../..", r"hydra.output_subdir=\.\./\.\."),
    "another place of configs": ("searchpath: ['pkg://this']", "hydra.searchpath"),
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
)
TYPED += (
    "verbose=true",
    "run.dir='${oc.env:HOME}/x'",
    "+launcher.setup=[module load x]",
    "searchpath=[file:///tmp]",
)
FREE = "defaults: [override /hydra/launcher: free, override /hydra/sweeper: free]"


def planned(below_hydra: str, *words: str, head: str = "") -> Jobs:
    """What a command would run by the experiment of a folder, which says this below hydra."""
    folder = Path("conf")
    (folder / "experiment").mkdir(parents=True, exist_ok=True)
    for part in ("launcher", "sweeper"):  # whose options have no types, unlike Hydra's
        (folder / f"hydra/{part}").mkdir(parents=True, exist_ok=True)
        target = f"hydra._internal.core_plugins.basic_{part}.Basic{part.title()}"
        (folder / f"hydra/{part}/free.yaml").write_text(f"_target_: {target}\n")
    content = f"# @package _global_\n{head}\nhydra:\n  {below_hydra}\n"
    (folder / "experiment/mine.yaml").write_text(content)
    with session(folder):
        return jobs_of(w.read("run", ["+experiment=mine", *words], folder), multirun=False)


@pytest.fixture(autouse=True)
def at_home(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("attack", slow_if(lambda one: [*ATTACKS].index(one) % 3 > 0, ATTACKS))
def test_an_experiment_says_to_hydra_what_is_on_the_list(attack):
    below_hydra, said = ATTACKS[attack]
    with pytest.raises(UserError, match=said):
        planned(below_hydra, head=f"parameters: {{x: {COPY}}}\n{FREE}")


@pytest.mark.parametrize(
    ("name", "word"),
    [("noise/mine", "noise=mine"), ("hydra/job_logging/none", "seed=1")],
)
def test_options_of_a_folder_are_held_to_the_list(name, word):
    """Also where the option is chosen for a job of a sweep alone, as a launcher's process does."""
    file = Path(f"conf/{name}.yaml")
    file.parent.mkdir(parents=True)
    file.write_text(f"# @package _global_\nhydra: {{callbacks: {{x: {COPY}}}}}\n")
    with session(Path("conf")):
        loader = GlobalHydra.instance().config_loader()
        plain = OmegaConf.create(
            {"hydra": {"overrides": {"hydra": []}, "job": {"config_name": "config"}}}
        )
        with pytest.raises(UserError, match=r"hydra\.callbacks\.x"):
            loader.load_sweep_config(plain, [word])


@pytest.mark.parametrize("name", ["config", "schema", "hydra/config"])
def test_a_folder_does_not_replace_the_config(name):
    Path(f"conf/{name}.yaml").parent.mkdir(parents=True)
    Path(f"conf/{name}.yaml").touch()
    with pytest.raises(UserError, match="would replace"):
        planned("verbose: false")


def test_what_is_on_the_list_is_taken():
    sweep = "{dir: '${output}/${now:%Y}', subdir: '${hydra.job.num}'}"
    jobs = planned(
        f"{{mode: MULTIRUN, verbose: [a], run: {{dir: '${{output}}'}}, sweep: {sweep}, "
        "sweeper: {max_batch_size: 2, params: {error_scale: '1,3', seed: '${trials}'}}}",
        "trials=4",
    )
    assert [(one.error_scale, one.seed) for one in jobs.specs] == [(1, 4), (3, 4)]


@pytest.mark.parametrize("word", TYPED)
def test_the_command_line_says_more(word):
    plus = "+" * word.startswith("+")
    assert len(planned("verbose: false", f"{plus}hydra.{word.lstrip('+')}").specs) == 1


def test_what_the_command_line_says_brings_nothing_else_in():
    with pytest.raises(
        UserError, match=r"hydra\.job\.env_set\.B=c: .* or write it on the command line"
    ):
        planned("job: {env_set: {B: c}}", "+hydra.job.env_set.A=b")
    with pytest.raises(UserError, match=r"hydra\.callbacks"):
        planned("verbose: false", "+hydra.callbacks.x._target_=shutil.copyfile")
