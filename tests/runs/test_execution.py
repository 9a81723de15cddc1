"""Whatever happens to the parts of a run, the other parts are complete, and have the same bits
everywhere."""

import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from shared import rogues
from shared.rogues import Rogue
from shared.small_models import Bent

from ipe_bench import Scenario
from ipe_bench.baselines import LinearLSE
from ipe_bench.basics.errors import UserError
from ipe_bench.noise import Gaussian
from ipe_bench.runs.execution import Auto, Event, Failure, Processes, Serial
from ipe_bench.runs.results import Results
from ipe_bench.runs.run import compute
from ipe_bench.solvers import Newton

GOOD = {"linear_lse": LinearLSE(), "newton": Newton()}


def scenario(**changes) -> Scenario:
    return Scenario(Bent(0.02), Gaussian(0.1), **changes)


def stored(directory: Path) -> dict[str, np.ndarray]:
    """Every number that a run stored, timings aside, by file and column."""
    parts = (part for cell in Results.read([directory]).stored.values() for part in cell.parts)
    tables = {part.path.name: part.read()[1] for part in parts}
    names = (
        (file, name)
        for file, table in tables.items()
        for name in table.column_names
        if name != "time_s"
    )
    return {f"{file}:{name}": tables[file][name].to_numpy() for file, name in names}


def assert_same(first: dict, second: dict) -> None:
    assert first.keys() == second.keys()
    for name in first:
        np.testing.assert_array_equal(first[name], second[name], name)


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    # One that has ended and that nobody has waited for is no longer running.
    status = Path(f"/proc/{pid}/stat")
    return not (status.exists() and status.read_text().rpartition(")")[2].split()[0] == "Z")


def gone_within(seconds: float, pid: int) -> bool:
    end = time.monotonic() + seconds
    while alive(pid) and time.monotonic() < end:
        time.sleep(0.02)
    return not alive(pid)


@pytest.fixture(scope="module")
def reference(tmp_path_factory) -> dict[str, np.ndarray]:
    folder = tmp_path_factory.mktemp("serial")
    assert compute([scenario()], GOOD, 40, folder, execution=Serial(), block_size=10) == ()
    return stored(folder)


class Dying(Serial):
    """An execution in which the process of every task with an estimator of this name ends before it
    is computed."""

    def run(self, work, tasks):
        for index, task in enumerate(tasks):
            labels = [cell.label for cell in task.cells]
            if "newton" in labels:
                asked.append(labels)
                yield Event(
                    index,
                    ended=True,
                    failure=Failure("died", "the worker process was ended by SIGKILL"),
                )
            else:
                yield from (replace(event, index=index) for event in super().run(work, [task]))


asked: list[list[str]] = []


def test_what_takes_its_process_with_it_is_tried_twice_alone_and_the_rest_goes_on(tmp_path):
    asked.clear()
    (said,) = compute([scenario()], GOOD, 10, tmp_path, execution=Dying())
    assert said.startswith("newton on bent")
    assert said.endswith("trials 0 to 10: the worker process was ended by SIGKILL")
    assert asked.count(["newton"]) == 2
    (lacking,) = [cell for cell in Results.read([tmp_path]).cells if not cell.complete]
    assert lacking.names["estimator"] == "newton"


def test_a_run_completes_when_a_worker_is_killed(tmp_path, reference):
    rogue = {"killer": Rogue("kill", until=str(tmp_path / "killed"))}
    assert (
        compute(
            [scenario()], {**rogue, **GOOD}, 40, tmp_path, execution=Processes(2), block_size=10
        )
        == ()
    )
    assert (tmp_path / "killed").exists()
    there = stored(tmp_path)
    assert_same({name: there[name] for name in reference}, reference)
    assert Results.read([tmp_path]).problems == []


@pytest.mark.parametrize(
    ("does", "limits", "message"),
    [
        ("exit", {}, "exit code 7"),
        ("sys_exit", {}, "SystemExit: 3"),
        pytest.param("kill", {}, "SIGKILL", marks=pytest.mark.slow),
        ("shape", {}, "x of shape (10, 4)"),
        ("row", {}, "x of shape (3,)"),
        *(
            (f"simulations {value}", {}, "simulations that are not finite numbers from 0 up")
            for value in (-1, "nan", "inf")
        ),
        *(
            (f"iterations {value}", {}, "iterations that are not whole numbers")
            for value in (1.5, 1e300)
        ),
        *((f"status {value}", {}, "a status that is not one of") for value in (-1, 0.5, 99)),
        ("status None", {}, "status of type object"),
        ("history", {}, "history of 1 trials, where 10 belong"),
        pytest.param(
            "sleep", {"block_timeout_s": 3.0}, "block_timeout_s=3", marks=pytest.mark.slow
        ),
        pytest.param(
            *("memory", {"memory_limit_gb": 1.0}, "MemoryError"),
            marks=[
                pytest.mark.slow,
                pytest.mark.skipif(sys.platform != "linux", reason="limits memory on Linux only"),
            ],
        ),
    ],
)
def test_one_estimator_that_fails_loses_nothing_but_itself(
    tmp_path, reference, does, limits, message
):
    estimators = {"rogue": Rogue(does), **GOOD}
    (failure,) = compute([scenario()], estimators, 10, tmp_path, execution=Processes(1, **limits))
    assert message in failure
    assert "rogue" in failure
    assert_same(
        stored(tmp_path),
        {name.replace("-0-40.", "-0-10."): rows[:10] for name, rows in reference.items()},
    )
    rogue = next(
        cell for cell in Results.read([tmp_path]).cells if cell.names["estimator"] == "rogue"
    )
    assert (rogue.done, rogue.failed, rogue.missing) == (0, 10, 0)


@pytest.mark.slow
def test_the_time_limit_does_not_count_what_any_estimator_compiles(tmp_path):
    estimators = {**GOOD, "rogue": Rogue("compile")}
    assert (
        compute([scenario()], estimators, 10, tmp_path, execution=Processes(1, block_timeout_s=2.5))
        == ()
    )


def rows_of(directory: Path, label: str) -> dict[str, np.ndarray]:
    results = Results.read([directory])
    return results.load(next(cell for cell in results.stored.values() if cell.label == label), None)


@pytest.mark.parametrize(
    ("does", "statuses", "message"),
    [
        ("raise", ["error"] * 5, "ArithmeticError: rogue"),
        ("surrogate", ["error"] * 5, "ArithmeticError: ?" + 999 * "x"),
        ("boast", ["nonfinite", *["converged"] * 4], ""),
        ("masked", ["nonfinite"] * 5, ""),
        ("masked in one", ["nonfinite", *["converged"] * 4], ""),
        pytest.param(
            "matrix",
            ["converged"] * 5,
            "",
            marks=pytest.mark.filterwarnings("ignore:the matrix subclass"),
        ),
    ],
)
def test_an_exception_or_an_infinite_estimate_is_a_status_and_no_failure(
    tmp_path, does, statuses, message
):
    assert compute([scenario()], {"rogue": Rogue(does)}, 5, tmp_path, execution=Processes(1)) == ()
    rows = rows_of(tmp_path, "rogue")
    assert rows["status"].tolist() == statuses
    assert set(rows["message"]) == {message}
    if does.startswith("masked"):  # what lies under a mask is no answer
        assert not rows["success"][0]
        assert np.isnan(
            [
                rows["crlb_distance"][0],
                rows["nees"][0],
                *(v[0] for k, v in rows.items() if k.startswith("deviation_")),
            ]
        ).all()


def test_an_estimator_cannot_change_the_readings_and_the_problem_of_the_others(tmp_path, reference):
    estimators = {name: Rogue(name) for name in ("z", "H", "R", "x0")}
    assert compute([scenario()], {**estimators, **GOOD}, 40, tmp_path, block_size=10) == ()
    there = stored(tmp_path)
    assert_same({name: there[name] for name in reference}, reference)
    for label in estimators:
        rows = rows_of(tmp_path, label)
        assert set(rows["status"]) == {"error"}
        assert all("read-only" in message for message in rows["message"])


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="sends POSIX signals")
def test_ctrl_c_stops_a_serial_run(tmp_path):
    code = f"""
import signal, sys
# What runs in the background ignores it.
signal.signal(signal.SIGINT, signal.default_int_handler)
from test_execution import *
from ipe_bench.basics.errors import StorageError
try:
    compute([scenario()], {{"rogue": Rogue("stop")}}, 20, {str(tmp_path)!r})
except KeyboardInterrupt:
    sys.exit(130)
"""
    assert (
        subprocess.run([sys.executable, "-c", code], env=environment(), check=False).returncode
        == 130
    )


@pytest.mark.parametrize("execution", [Serial(), Processes(1)], ids=repr)
def test_what_a_process_does_first_is_not_booked_as_time_of_estimation(tmp_path, execution):
    """As an import or a compilation, of half a second here: in 10 trials, 0.05 s for each of
    them."""
    rogues._begun.clear()
    compute([scenario()], {"once": Rogue("once")}, 20, tmp_path, execution=execution, block_size=10)
    assert rows_of(tmp_path, "once")["time_s"].max() < 0.03


@pytest.mark.slow
def test_what_failed_is_tried_again_by_the_next_run(tmp_path):
    estimators = {"rogue": Rogue("exit", until=str(tmp_path / "repaired"))}
    assert len(compute([scenario()], estimators, 10, tmp_path, execution=Processes(1))) == 1
    assert [cell.failed for cell in Results.read([tmp_path]).cells] == [0, 10]
    (tmp_path / "repaired").touch()
    assert compute([scenario()], estimators, 10, tmp_path, execution=Processes(1)) == ()
    assert [cell.done for cell in Results.read([tmp_path]).cells] == [10, 10]
    assert list((tmp_path / "failed").iterdir()) == []


def test_a_worker_has_one_thread_in_blas_and_one_in_compiled_models():
    events = list(Processes(2).run(rogues.surroundings, range(4)))
    seen = [event.step for event in events if not event.ended]
    assert len(seen) == 4
    assert os.getpid() not in {pid for pid, _, _ in seen}
    assert all(set(pools) == {1} and threads == 1 for _, pools, threads in seen)


@pytest.mark.parametrize("execution", [Serial(), Processes(2)], ids=repr)
def test_steps_come_in_order_and_an_exception_fails_its_task_alone(execution):
    events = list(execution.run(rogues.square, [1, 2, 3]))
    for index, task in enumerate([1, 2, 3]):
        mine = [event for event in events if event.index == index]
        assert [event.step for event in mine[:-1]] == [0, task, 2 * task]
        assert mine[-1].ended
        failure = mine[-1].failure
        assert (None if failure is None else failure.message) == (
            "ValueError: two" if task == 2 else None
        )
        assert failure is None or "in square" in failure.detail  # the traceback


@pytest.mark.parametrize(
    ("tasks", "options", "here"),
    [([0], {}, True), ([0, 0], {}, False), ([0], {"block_timeout_s": 60.0}, False)],
)
def test_auto_starts_workers_only_where_they_are_of_use(tasks, options, here):
    seen = [
        event.step
        for event in Auto(2, **options).run(rogues.surroundings, tasks)
        if not event.ended
    ]
    assert len(seen) == len(tasks)
    assert ({pid for pid, _, _ in seen} == {os.getpid()}) == here


def test_stopping_a_run_ends_its_workers():
    events = Processes(1).run(rogues.doze, [0])
    pid = next(events).step
    assert alive(pid)
    events.close()  # type: ignore[attr-defined]
    assert gone_within(5, pid)


@pytest.mark.skipif(sys.platform == "win32", reason="ends sessions with POSIX means")
def test_what_an_estimator_started_ends_with_its_worker():
    events = list(Processes(1, block_timeout_s=0.3).run(rogues.leave_a_child, [0]))
    assert events[-1].failure is not None
    assert events[-1].failure.status == "timeout"
    assert gone_within(5, events[0].step)


def test_a_worker_that_dies_between_two_runs_is_replaced():
    pids = []
    for _ in range(2):
        events = list(Processes(1).run(rogues.surroundings, [0]))
        assert events[-1].failure is None
        pids.append(events[0].step[0])
        os.kill(pids[-1], signal.SIGTERM)
        assert gone_within(60, pids[-1])
    assert pids[0] != pids[1]


@pytest.mark.skipif(sys.platform == "win32", reason="stops processes with POSIX means")
def test_a_task_handed_to_a_worker_that_is_ending_is_handed_to_another():
    (seen,) = [
        event.step for event in Processes(1).run(rogues.surroundings, [0]) if not event.ended
    ]
    os.kill(seen[0], signal.SIGSTOP)  # it takes a message, and never reads it
    killer = threading.Timer(1.0, os.kill, (seen[0], signal.SIGKILL))
    killer.start()
    events = list(Processes(1).run(rogues.surroundings, [0]))
    killer.join()
    assert [event.failure for event in events] == [None, None]
    assert events[0].step[0] != seen[0]


def test_a_script_needs_no_guard_against_being_imported_by_its_workers(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "from shared import rogues\nfrom ipe_bench.runs.execution import"
        " Processes\nprint('begins')\nprint([event.step for event in"
        " Processes(2).run(rogues.square, [1]) if not event.ended])\n"
    )
    ran = subprocess.run(
        [sys.executable, script], env=environment(), capture_output=True, text=True, check=True
    )
    assert ran.stdout.splitlines() == ["begins", "[0, 1, 2]"]


def test_workers_end_when_their_parent_is_killed(tmp_path):
    code = "from shared import rogues; from ipe_bench.runs.execution import Processes\n"
    code += "for event in Processes(1).run(rogues.doze, [0]): print(event.step, flush=True)"
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, env=environment(), text=True
    ) as parent:
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        assert alive(pid)
        parent.kill()
    assert gone_within(5, pid)


def environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}


def test_a_folder_that_cannot_be_written_to_is_refused_before_any_work(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=r"output=.*choose another folder"):
        compute([scenario()], GOOD, 10, tmp_path / "file" / "results")


@pytest.mark.skipif(sys.platform == "win32", reason="limits the size of files with POSIX means")
@pytest.mark.parametrize(
    "execution", ["Serial()", pytest.param("Processes(1)", marks=pytest.mark.slow)]
)
def test_a_full_disk_ends_the_run_with_one_line_and_no_half_files(tmp_path, execution):
    code = f"""
import resource, sys
sys.path[:0] = {sys.path!r}
from test_execution import *
from ipe_bench.basics.errors import StorageError
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
try:
    compute([scenario()], GOOD, 500, {str(tmp_path)!r}, execution={execution})
except StorageError as error:
    assert "cannot be written to any more" in str(error) and "\\n" not in str(error)
    sys.exit(42)
"""
    assert (
        subprocess.run([sys.executable, "-c", code], env=environment(), check=False).returncode
        == 42
    )
    assert not Results.read([tmp_path]).damaged
    assert [path for path in tmp_path.rglob("*") if path.suffix == ".tmp"] == []


def test_source_that_changed_since_the_run_began_is_not_mixed_in(tmp_path, monkeypatch):
    import ipe_bench.runs.schedule as schedule

    monkeypatch.setattr(schedule, "_recent", {})
    monkeypatch.setattr(schedule, "importable", lambda parts: {"versions": {}, "source": "other"})
    failures = compute([scenario()], {"linear_lse": LinearLSE()}, 10, tmp_path, execution=Serial())
    assert len(failures) == 2
    assert "numerical source" in failures[0]
    assert not Results.read([tmp_path]).stored
