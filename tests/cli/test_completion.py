"""A shell completes commands, groups, options, keys and values; what it shows is what it would accept."""

from __future__ import annotations

import os
import re
import select
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from ipe_bench.basics.options import option_types
from ipe_bench.cli.candidates import candidates
from ipe_bench.cli.completion import Line
from ipe_bench.cli.main import COMMANDS, main
from ipe_bench.plugins import discovery
from ipe_bench.plugins.annotations import choices, stated
from ipe_bench.plugins.construct import find_class

pty = pytest.importorskip("pty")  # Windows has no such terminals, and none of these shells
OURS = [o for o in discovery.options() if o.source.name == "ipe-bench" and o.group in discovery.COMPONENT_GROUPS]
BS = ("boxbod", "bennett5")
NAMED = "measurement.dataset="
FORMULA = "'measurement.expression=a*exp(b*t)' measurement.start.a=1 measurement.start.b=-1e-1"


def texts(line: str) -> list[str]:
    read = Line.of(line)
    return [found.text for found in candidates(read.before, read.current)]


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("ipe-bench comp", ["compare", "completion"]),
        ("ipe-bench --v", ["--version"]),
        ("ipe-bench new sol", ["solver"]),
        ("ipe-bench list solver/n", ["solver/newton"]),
        ("ipe-bench list solver", ["solver", "solver/"]),
        ("ipe-bench run meas", ["measurement="]),
        ("ipe-bench run measurement", ["measurement=", "measurement."]),
        ("ipe-bench run measurement=gin", [f"measurement=gins{v}" for v in ("", *("_misaligned", "_nonlinear"))]),
        ("ipe-bench run measurement.la", ["measurement.latitude_deg="]),
        ("ipe-bench run measurement=ranging measurement.la", []),
        ("ipe-bench run measurement=ranging measurement.ro", ["measurement.rounds="]),
        ("ipe-bench run +experiment=triad measurement.fi", ["measurement.field="]),
        ("ipe-bench run truth_measurement=gins_tilted truth_measurement.la", ["truth_measurement.latitude_deg="]),
        ("ipe-bench run measurement=nist/mgh", [f"measurement=nist/mgh{v}" for v in ("17", "09", "10")]),
        ("ipe-bench run -m measurement=nist/misra1a,nist/b", [f"measurement=nist/misra1a,nist/{v}" for v in BS]),
        ("ipe-bench run measurement=nist measurement.dataset=Gauss1,Ra", [f"{NAMED}Gauss1,Rat4{v}" for v in "23"]),
        ("ipe-bench run measurement=mgh measurement.function=wo", ["measurement.function=wood"]),
        ("ipe-bench run noise=gaussian noise.", ["noise.deviation="]),
        ("ipe-bench run solver=", ["solver=[anderson", "solver=[auto"]),
        ("ipe-bench run solver=ne", ["solver=newton"]),
        ("ipe-bench run solver=[fixed_point,ne", ["solver=[fixed_point,newton]", "solver=[fixed_point,newton,"]),
        ('ipe-bench run "solver=[ne', ["solver=[newton]", "solver=[newton,"]),
        ("ipe-bench run +solver@estimators.anderson", ["+solver@estimators.anderson_2=anderson"]),
        ("ipe-bench run +solver@estimators.a=ne", ["+solver@estimators.a=newton"]),
        ("ipe-bench run +solver@estimators.a=newton estimators.a.st", ["estimators.a.start="]),
        ("ipe-bench run estimators.fi", ["estimators.fixed_point."]),
        ("ipe-bench run 'solver=[newton]' estimators.newton.start=n", ["estimators.newton.start=nominal"]),
        ("ipe-bench run estimators.linear_lse.", []),
        ("ipe-bench run baseline=[ukf] estimators.ukf.engine=b", ["estimators.ukf.engine=batched"]),
        ("ipe-bench run solver=[auto] estimators.auto.confirmations=", ["estimators.auto.confirmations=null"]),
        ("ipe-bench run +baseline@estimators.a=geodesic_lm estimators.a.geo", ["estimators.a.geodesic="]),
        ("ipe-bench run +baseline@estimators.a=geodesic_lm estimators.a.geodesic=t", ["estimators.a.geodesic=true"]),
        ("ipe-bench run -m noise=gaussian,quant", ["noise=gaussian,quantization"]),
        ("ipe-bench run ~", [f"~estimators.{name}" for name in ("fixed_point", "linear_lse", "ekf", "ukf")]),
        ("ipe-bench run --cfg ", ["job", "hydra", "all"]),
        ("ipe-bench run error", ["error_scale="]),
        ("ipe-bench run hydra/sweeper=o", ["hydra/sweeper=optuna"]),
        ("ipe-bench estimate parameters.bx.fi", ["parameters.bx.fixed="]),
        ("ipe-bench estimate parameters.b", ["parameters.bx.", "parameters.by."]),
        ("ipe-bench run measurement=nist/gauss1 parameters.", [f"parameters.b{i}." for i in range(1, 9)]),
        ("ipe-bench run measurement=polynomial measurement.degree=many parameters.", []),
        (f"ipe-bench estimate measurement=formula {FORMULA} parameters.", ["parameters.a.", "parameters.b."]),
        ("ipe-bench design --crit", ["--criterion"]),
        ("ipe-bench design --criterion ", ["A", "D"]),
        ("cd x && ipe-bench completion ", ["bash", "zsh", "fish"]),
        ("ipe-bench nothing ", []),
    ],
)  # fmt: skip
def test_a_line_is_completed(line, expected, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = texts(line)
    assert found[: len(expected)] == expected
    assert expected or not found


def test_all_commands_are_offered():
    assert {word for word in texts("ipe-bench ") if not word.startswith("-")} == set(COMMANDS)


def test_an_answer_waits_for_no_library_of_numbers(tmp_path):
    code = "import sys; from ipe_bench.cli.main import main; main(['completion', 'bash', '--query']); "
    code += "print([name for name in ('numpy', 'scipy', 'pandas', 'hydra', 'llvmlite') if name in sys.modules])"
    variables = os.environ | {"COMP_LINE": "ipe-bench run solver=[newton] estimators.newton.start=n"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=variables, cwd=tmp_path)
    assert done.stdout.splitlines() == ["nominal ", "[]"]


def test_files_are_offered_where_a_file_is_wanted(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "outputs" / "paper").mkdir(parents=True)
    (tmp_path / "my.csv").touch()
    (tmp_path / ".hidden").touch()
    assert texts("ipe-bench estimate readings=") == ["readings=my.csv", "readings=outputs/"]
    assert texts("ipe-bench report outputs/p") == ["outputs/paper/"]
    assert texts("ipe-bench status m") == []
    (tmp_path / "both.zip").touch()
    assert texts("ipe-bench compare b") == ["both.zip"]
    assert texts("ipe-bench bundle output=b") == ["output=both.zip"]
    assert texts("ipe-bench report c") == ["columns="]
    assert texts("ipe-bench run prior_covariance=m") == ["prior_covariance=my.csv"]


def test_parameters_of_a_model_in_a_file_are_offered(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    model = "rates: {v: -k*v}\noutputs: {v: v}\ninitial: {v: v0}\nstart: {v0: 1, k: 0.1}\n"
    (tmp_path / "decay.yaml").write_text(model)
    line = "ipe-bench estimate measurement=ode measurement.file={} parameters."
    assert texts(line.format("decay.yaml")) == ["parameters.v0.", "parameters.k."]
    assert texts(line.format("absent.yaml")) == []


def test_options_of_plugins_are_offered_and_broken_ones_are_not(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    discovery.sources.cache_clear()
    try:
        assert main(["new", "solver", "zigzag"]) == 0
        discovery.sources.cache_clear()
        assert texts("ipe-bench run solver=[zig") == ["solver=[zigzag]", "solver=[zigzag,"]
        (config,) = tmp_path.rglob("zigzag.yaml")
        config.write_text("{")
        assert texts("ipe-bench run solver=[zig") == []
    finally:
        discovery._added.clear()
        monkeypatch.undo()
        discovery.sources.cache_clear()


@pytest.mark.parametrize("option", OURS, ids=lambda o: f"{o.group}/{o.name}")
def test_what_the_source_states_is_what_the_class_has(option):
    types = option_types(find_class(option.target, option.group))
    fields = stated(option.target)
    assert set(types) <= set(fields)
    literal = re.compile(r"Literal\[([^\]]*)\]")
    for name, hint in types.items():
        words = [word.strip(" '\"") for group in literal.findall(str(hint)) for word in group.split(",")]
        if not str(hint).startswith("tuple"):
            assert set(words) <= set(choices(fields[name])), name


@pytest.mark.parametrize("option", OURS, ids=lambda o: f"{o.group}/{o.name}")
def test_every_key_that_is_offered_is_one_that_a_run_takes(option):
    place = f"estimators.{option.label}" if option.group in discovery.ESTIMATOR_GROUPS else option.group
    chosen = f"{option.group}=[{option.name}]" if place.startswith("estimators") else f"{option.group}={option.name}"
    types = option_types(find_class(option.target, option.group))
    offered = texts(f"ipe-bench run {chosen} {place}.")
    assert {word.removeprefix(f"{place}.").rstrip("=") for word in offered} == set(types)


# As shells ask


PROGRAM = """#!/bin/sh
if [ "$1" = completion ]; then exec "{python}" -m ipe_bench "$@"; fi
for word; do echo "<$word>"; done
echo fini''shed
"""
"""Completes as ours does; else says which words it was given."""


def environment(home: Path) -> dict[str, str]:
    program = home / "bin" / "ipe-bench"
    program.parent.mkdir()
    program.write_text(PROGRAM.format(python=sys.executable))
    program.chmod(0o755)
    kept = {key: value for key, value in os.environ.items() if key in ("PYTHONPATH", "LANG")}
    return kept | {"PATH": f"{program.parent}:{os.environ['PATH']}", "HOME": str(home), "TERM": "dumb"}


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_bash_is_told_what_to_put_in_place_of_its_word(tmp_path):
    (tmp_path / "my results").mkdir()
    lines = {
        "ipe-bench run meas": ["measurement="],
        "ipe-bench run measurement=gins_t": ["gins_tilted "],  # bash begins a word behind the equals sign
        "ipe-bench run +solver@estimators.newton": ["estimators.newton_2=newton "],
        'ipe-bench run "solver=[fixed_point,ne': ["solver=[fixed_point,newton]", "solver=[fixed_point,newton,"],
        "ipe-bench status my": ["my\\ results/"],
    }
    script = 'eval "$(ipe-bench completion bash)"; for COMP_LINE; do COMP_POINT=${#COMP_LINE}; _ipe_bench ipe-bench; '
    script += 'printf "%s|" "${COMPREPLY[@]}"; echo; done'
    command = ["bash", "--norc", "-c", script, "bash", *lines]
    done = subprocess.run(command, capture_output=True, text=True, env=environment(tmp_path), cwd=tmp_path, check=True)
    assert [reply.split("|")[:-1] for reply in done.stdout.splitlines()] == list(lines.values())


SHELLS = {
    "bash": (["bash", "--norc", "--noprofile", "-i"], 'eval "$(ipe-bench completion bash)"'),
    "zsh": (["zsh", "-f", "-i"], 'autoload -Uz compinit; compinit -u; eval "$(ipe-bench completion zsh)"'),
    "fish": (["fish", "--no-config", "-i"], "ipe-bench completion fish | source"),
}


class Terminal:
    """An interactive shell, into which is typed."""

    def __init__(self, shell: str, home: Path) -> None:
        command, script = SHELLS[shell]
        variables = environment(home)
        self.pid, self.end = pty.fork()
        if not self.pid:
            os.chdir(home)
            os.execvpe(command[0], command, variables)
        self.type(f"{script}; echo rea''dy\r")
        self.read_until("ready")

    def type(self, text: str) -> None:
        os.write(self.end, text.encode())

    def read_until(self, text: str) -> str:
        seen = ""
        while text not in seen:
            ready, _, _ = select.select([self.end], [], [], 60.0)
            assert ready, f"{text} does not come: {seen!r}"
            seen += os.read(self.end, 4096).decode(errors="replace")
        return seen

    def words_of(self, line: str, awaited: str) -> list[str]:
        """The words that the program is given, where TAB is pressed behind the line."""
        self.type(f"{line}\t")
        self.read_until(awaited)
        self.type("\r")
        return re.findall(r"^<(.*)>\r?$", self.read_until("finished"), re.MULTILINE)

    def close(self) -> None:
        os.kill(self.pid, signal.SIGKILL)
        os.waitpid(self.pid, 0)
        os.close(self.end)


@pytest.mark.slow
@pytest.mark.parametrize("shell", SHELLS)
def test_a_press_of_tab_on_a_terminal_completes_the_word(shell, tmp_path):
    if shutil.which(shell) is None:
        pytest.skip(f"needs {shell}")
    terminal = Terminal(shell, tmp_path)
    try:
        assert terminal.words_of("ipe-bench run measurement=gins_t", "ilted") == ["run", "measurement=gins_tilted"]
        words = terminal.words_of("ipe-bench list solver/new", "ton")
        assert words == ["list", "solver/newton"]
        words = terminal.words_of("ipe-bench run measurement.lat", "deg")
        assert words == ["run", "measurement.latitude_deg="]
    finally:
        terminal.close()
