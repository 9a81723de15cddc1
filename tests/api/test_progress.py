"""A run and an estimate show how far they are in a terminal and in a notebook, and nowhere else."""

import os
import subprocess
import sys
from types import SimpleNamespace

import pytest

import ipe_bench as ib
from ipe_bench.report import progress

BENCH = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01), error_scale=3.0)
NEWTON = {"newton": ib.solvers.Newton()}
SCRIPT = """
import ipe_bench as ib
bench = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01), error_scale=3.0)
ib.run(bench, {"newton": ib.solvers.Newton()}, 20, progress=PROGRESS)
ib.estimate(bench, bench.draw(0, 1).z[0], progress=PROGRESS)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="has no pseudo-terminals")
@pytest.mark.slow
@pytest.mark.parametrize(("terminal", "shown"), [(True, True), (False, True)])
def test_a_bar_is_shown_on_a_stderr_that_is_a_terminal(terminal, shown):
    import pty

    ours, theirs = pty.openpty() if terminal else os.pipe()
    os.set_blocking(ours, False)
    environment = {
        name: text for name, text in os.environ.items() if name not in ("NO_COLOR", "FORCE_COLOR")
    }
    command = [sys.executable, "-c", SCRIPT.replace("PROGRESS", str(shown))]
    environment |= {"TERM": "xterm", "COLUMNS": "100"}
    done = subprocess.run(
        command, stdout=subprocess.PIPE, stderr=theirs, env=environment, check=False
    )
    try:
        said = os.read(ours, 100_000).decode()
    except BlockingIOError:
        said = ""
    assert (done.returncode, done.stdout) == (0, b"")
    told = [text in said for text in ("run", "estimate")]
    assert all(told) if terminal and shown else said == ""


def test_a_notebook_shows_a_line_that_is_empty_in_the_end(monkeypatch):
    lines = []

    def show(data, **_):
        lines.append(data["text/plain"])
        return SimpleNamespace(update=show)

    shell = SimpleNamespace(kernel=object())
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell))
    monkeypatch.setitem(sys.modules, "IPython.display", SimpleNamespace(display=show))
    monkeypatch.setattr(progress, "_NOTEBOOK_EVERY_S", 0.0)
    ib.run(BENCH, NEWTON, 2, progress=False)
    assert lines == []
    ib.run(BENCH, NEWTON, 4, block_size=2)
    assert any(line.startswith("run: block 1/2") for line in lines)
    assert lines[-1] == ""


def test_a_scenario_is_shown_in_lines_that_make_it_again():
    bench = ib.Scenario(ib.measurements.Gins(), ib.noise.Quantization(0.0066), seed=3)
    assert max(map(len, repr(bench).splitlines())) < 120
    names = {**vars(ib.measurements), **vars(ib.noise), **vars(ib.priors), "Scenario": ib.Scenario}
    assert eval(repr(bench), names) == bench
