"""The second process that draws: it answers, ends with the first however that ends, and leaves nothing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from ipe_bench.report import helper as helper_module
from ipe_bench.report.helper import Helper, drawing_help

FIRST = """
import sys, time
from ipe_bench.report.helper import drawing_help
with drawing_help() as helper:
    helper.start()
    if sys.argv[1] == "drawing":
        helper.ask(eval, "1")
        import threading
        threading.Thread(target=helper.ask, args=(eval, "__import__('time').sleep(60)"), daemon=True).start()
        time.sleep(0.1)
    print(helper._process.pid, flush=True)
    time.sleep(60)
"""


def gone(pid: int) -> bool:
    """Whether there is no such process, nor what is left of one that nobody has waited for."""
    for _ in range(100):
        try:
            os.kill(pid, 0)
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        except (OSError, IndexError):
            return True
        # An orphan waits for init, which in some containers waits for nobody.
        if state == "Z":
            return True
        time.sleep(0.05)
    return False


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks at processes as Linux shows them")
@pytest.mark.parametrize("ends_by", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
@pytest.mark.parametrize("while_it_is", ["loading", "drawing"])
def test_it_ends_with_the_first_and_leaves_nothing(tmp_path: Path, ends_by: signal.Signals, while_it_is: str) -> None:
    command = [sys.executable, "-c", FIRST, while_it_is]
    quiet = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "text": True, "start_new_session": True}
    environment = os.environ | {"TMPDIR": str(tmp_path)}
    with subprocess.Popen(command, env=environment, **quiet) as first:
        helper = int(first.stdout.readline())  # type: ignore[union-attr]
        # Ctrl-C reaches all processes of the terminal.
        os.killpg(first.pid, ends_by) if ends_by == signal.SIGINT else first.send_signal(ends_by)
        first.wait(10)
        assert gone(helper)
    assert not list(tmp_path.iterdir())


def test_it_answers_and_neither_prints_nor_failures_disturb_it(capfd: pytest.CaptureFixture[str]) -> None:
    with drawing_help() as helper:
        helper.start()
        assert helper.ask(eval, "print('in between') or 6 * 7") == 42
        with pytest.raises(ConnectionError, match="ZeroDivisionError"):
            helper.ask(eval, "1 / 0")
        assert helper.ask(os.system, "echo from below; echo and beside >&2") == 0
        # A folder that came to be searched after the start is searched there too.
        sys.path.append("/nowhere/at/all")
        try:
            assert helper.ask(eval, "__import__('sys').path[-1]") == "/nowhere/at/all"
        finally:
            sys.path.remove("/nowhere/at/all")
        with drawing_help() as inner:
            assert inner is helper
        assert helper.started
        process = helper._process
    assert process is not None
    assert process.returncode is not None
    assert not helper.started
    assert capfd.readouterr() == ("", "")


def test_one_that_is_gone_is_told_from_an_answer() -> None:
    with drawing_help() as helper:
        with pytest.raises(ConnectionError):
            helper.ask(eval, "1")
        helper.start()
        with pytest.raises(ConnectionError):
            helper.ask(os._exit, 0)
        with pytest.raises(ConnectionError):
            helper.ask(eval, "1")


def test_it_is_started_once_and_only_where_there_is_another_core_and_work(monkeypatch: pytest.MonkeyPatch) -> None:
    started = []
    monkeypatch.setattr(helper_module.subprocess, "Popen", lambda *_, **__: started.append(1) or object())
    monkeypatch.setattr(helper_module, "cores", lambda: 1)
    Helper().start()
    assert not started
    monkeypatch.setattr(helper_module, "cores", lambda: 2)
    heard: list[int] = []
    helper = Helper()
    watch = helper.start_when_there_is_work(lambda progress: heard.append(progress.tasks))
    watch(type("Progress", (), {"tasks": 0}))
    assert not started
    watch(type("Progress", (), {"tasks": 3}))
    watch(type("Progress", (), {"tasks": 3}))
    assert started == [1]
    assert heard == [0, 3, 3]
