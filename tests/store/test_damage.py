"""Whatever happens to stored files: nothing of it changes a number in silence, and the next run makes it whole."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from small_models import Bent
from synthetic_store import forge

from ipe_bench import Scenario
from ipe_bench.baselines import LinearLSE
from ipe_bench.basics.errors import StorageError
from ipe_bench.basics.files import BLANK_SEAL, is_sealed, seal
from ipe_bench.cli.main import main
from ipe_bench.cli.report import main as report
from ipe_bench.cli.status import main as status
from ipe_bench.estimators.base import Estimates, Estimator
from ipe_bench.noise import Gaussian
from ipe_bench.priors import GaussianPrior
from ipe_bench.runs import verified
from ipe_bench.runs.results import Results
from ipe_bench.runs.run import compute
from ipe_bench.runs.store import FOOTER, Store, key_of
from ipe_bench.solvers import Newton
from ipe_bench.statistics import summarize
from ipe_bench.statistics.records import add_statistics

SCENARIOS = [Scenario(Bent(0.02), Gaussian(0.1), GaussianPrior(), 1.0, seed) for seed in (0, 1)]
KINDS = ("trials", "histories", "runs", "failed", ".verified.json")


@dataclass(frozen=True)
class Fails(Estimator):
    """Loses every block, so that there are records of failures."""

    def estimate(self, problem, z, *, history=False):
        raise MemoryError("too large")


ESTIMATORS = {"newton": Newton(), "linear_lse": LinearLSE(), "fails": Fails()}


def run(folder: Path) -> None:
    compute(SCENARIOS, ESTIMATORS, 20, folder, block_size=10)


def summary(folder: Path) -> pd.DataFrame:
    add_statistics([])  # those of plugins in the working folder, which a report takes up
    return summarize([folder]).drop(columns="time_median_s")


@pytest.fixture(scope="module")
def settled():
    """Files count as settled at once: the index is what is to be tried."""
    before, verified._SETTLED_NS = verified._SETTLED_NS, -(10**18)
    yield
    verified._SETTLED_NS = before


@pytest.fixture(scope="module")
def clean(tmp_path_factory, settled) -> Path:
    folder = tmp_path_factory.mktemp("clean") / "results"
    run(folder)
    run(folder)  # two records of runs, so that they can be swapped
    Results.read([folder])
    return folder


@pytest.fixture(scope="module")
def expected(clean) -> tuple[pd.DataFrame, list[str]]:
    return summary(clean), said(clean)


def said(folder: Path) -> list[str]:
    """What is said of a folder, wherever it lies."""
    return [line.replace(str(folder), "DIR") for line in Results.read([folder]).problems]


@pytest.fixture
def folder(clean, tmp_path) -> Path:
    copied = tmp_path / "results"
    shutil.copytree(clean, copied, symlinks=True)
    Results.read([copied])
    return copied


@contextmanager
def within(seconds: int) -> Iterator[None]:
    """Ends what hangs."""

    def stop(*_):
        raise TimeoutError("it hangs")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def files(folder: Path, kind: str) -> list[Path]:
    return [folder / kind] if kind.startswith(".") else sorted((folder / kind).iterdir())


def flip(path: Path, rng: random.Random) -> str:
    content = bytearray(path.read_bytes())
    bit = rng.randrange(8 * len(content))
    content[bit // 8] ^= 1 << bit % 8
    path.write_bytes(content)
    return f"bit {bit}"


def truncate(path: Path, rng: random.Random) -> str:
    keep = rng.randrange(path.stat().st_size)
    os.truncate(path, keep)
    return f"{keep} bytes"


def swap(path: Path, rng: random.Random) -> str:
    other = rng.choice([p for p in path.parent.iterdir() if p != path and p.suffix == path.suffix])
    first, second = path.read_bytes(), other.read_bytes()
    path.write_bytes(second)
    other.write_bytes(first)
    return other.name


def overwrite_by_another(path: Path, rng: random.Random) -> str:
    other = rng.choice([p for p in path.parent.iterdir() if p != path and p.suffix == path.suffix])
    path.write_bytes(other.read_bytes())
    return other.name


def zeros(path: Path, rng: random.Random) -> str:
    content = bytearray(path.read_bytes())
    at = rng.randrange(len(content))
    length = rng.randrange(1, 400)
    content[at : at + length] = bytes(len(content[at : at + length]))
    if content == path.read_bytes():
        content[0] ^= 1
    path.write_bytes(content)
    return f"{length} bytes at {at}"


def append(path: Path, rng: random.Random) -> str:
    path.write_bytes(path.read_bytes() + rng.randbytes(rng.randrange(1, 100)))
    return "longer"


def other_text(path: Path, rng: random.Random) -> str:
    text = rng.choice(["", "null", "{}", "[]", "[1, 2]", '{"cells": 3}', "[" * 100_000, "PAR1PAR1", "\x00", "\ufeff{}"])
    path.write_text(text, encoding="utf-8")
    return text[:20]


def quiet_edit(path: Path, rng: random.Random) -> str:
    """Keeps size and time of modification, as a careful forger would."""
    before = path.stat()
    flip(path, rng)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    return "quietly"


def pipe(path: Path, rng: random.Random) -> str:
    path.unlink()
    os.mkfifo(path)
    return "a pipe"


def directory(path: Path, rng: random.Random) -> str:
    path.unlink()
    path.mkdir()
    (path / "x").touch()
    return "a folder"


def link(path: Path, rng: random.Random) -> str:
    target = path.with_name("elsewhere.bin")
    path.rename(target)
    path.symlink_to(target)
    return "a link"


def link_to_itself(path: Path, rng: random.Random) -> str:
    path.unlink()
    path.symlink_to(path)
    return "a loop"


Harm = Callable[[Path, random.Random], str]
HARMS: tuple[Harm, ...] = (
    *(truncate, swap, overwrite_by_another, zeros, append, other_text, quiet_edit),
    *(pipe, directory, link, link_to_itself),
)


def harm_and_heal(folder: Path, expected: tuple[pd.DataFrame, list[str]], kind: str, harm: Harm, seed: int) -> None:
    rng = random.Random(seed)
    choices = files(folder, kind)
    if harm in (swap, overwrite_by_another) and len(choices) < 2:
        return
    path = rng.choice(choices)
    before = path.read_bytes()
    what = f"{harm.__name__} of {path.name} ({harm(path, rng)}), seed {seed}"
    if not path.is_symlink() and path.is_file() and path.read_bytes() == before:
        return
    table, problems = expected
    with within(60):
        if kind.startswith("."):
            # The index is no source of anything: without it files are read again.
            pd.testing.assert_frame_equal(summary(folder), table, obj=what)
            assert said(folder) == problems, what
        else:
            named = [line for line in Results.read([folder]).problems if str(path) in line]
            assert named, f"silent: {what}"
            assert all("\n" not in line for line in named), what
        run(folder)
        assert said(folder) == problems, what
        pd.testing.assert_frame_equal(summary(folder), table, obj=what)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(3))
def test_a_flipped_bit_is_named_and_healed(folder, expected, kind, seed):
    harm_and_heal(folder, expected, kind, flip, seed)


@pytest.mark.parametrize("kind", ["trials", "runs"])
@pytest.mark.parametrize("harm", HARMS, ids=lambda harm: harm.__name__)
def test_whatever_is_done_to_a_file_is_named_and_healed(folder, expected, kind, harm):
    harm_and_heal(folder, expected, kind, harm, 0)


@pytest.mark.campaign
@pytest.mark.parametrize("seed", range(60))
@pytest.mark.parametrize("kind", KINDS)
def test_300_flipped_bits(folder, expected, kind, seed):
    harm_and_heal(folder, expected, kind, flip, 1000 + seed)


@pytest.mark.campaign
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("harm", HARMS, ids=lambda harm: harm.__name__)
def test_110_swaps_truncations_and_edits(folder, expected, kind, harm, seed):
    harm_and_heal(folder, expected, kind, harm, 2000 + seed)


@pytest.mark.parametrize("harm", [pipe, link_to_itself, directory, other_text], ids=lambda harm: harm.__name__)
@pytest.mark.parametrize("kind", ["trials", "histories", "runs", "failed"])
def test_the_commands_say_it_in_a_line_and_exit_with_1(folder, capsys, kind, harm):
    path = files(folder, kind)[0]
    harm(path, random.Random(0))
    with within(60):
        assert status([str(folder)]) == 1
    assert str(path) in capsys.readouterr().out.replace("\n", "")


@pytest.mark.parametrize("name", ["trials", "histories", "runs", "failed", "figures", "tables", ".verified.json"])
@pytest.mark.parametrize("command", ["status", "report", "run"])
def test_a_file_where_a_folder_should_be_and_the_other_way_round_is_a_line(folder, capfd, name, command):
    path = folder / name
    if name.startswith("."):
        path.unlink()
        path.mkdir()
    else:
        shutil.rmtree(path, ignore_errors=True)
        path.write_text("a file")
    words = {"run": ["run", "measurement=polynomial", "trials=5", f"output={folder}", "execution=serial"]}
    drawn = [] if name == "figures" or command == "status" else ["figures=none"]
    with within(120):
        code = main([*words.get(command, [command, str(folder)]), *drawn])
    out, err = capfd.readouterr()
    assert "Traceback" not in out + err
    if name.startswith(".") or (command == "status" and name in ("figures", "tables")):
        assert str(path) not in out + err
    else:
        assert code in (1, 2)
        assert str(path) in (out + err).replace("\n", "") or f"output={folder}" in err


def test_report_and_status_say_the_same(folder, capsys):
    truncate(files(folder, "trials")[0], random.Random(0))
    truncate(files(folder, "runs")[0], random.Random(0))
    problems = Results.read([folder]).problems
    assert report([str(folder), "figures=none"]) == 1
    said_by_report = capsys.readouterr().err
    assert status([str(folder)]) == 1
    said_by_status = capsys.readouterr().out
    for line in problems:
        assert line in said_by_report
        assert line in said_by_status


# Files with a digest of their own that nevertheless do not hold what they should -------------------------------------


def set_to(name: str, value, at=slice(None)) -> Callable[[dict, dict], None]:
    def change(rows: dict, footer: dict) -> None:
        rows[name] = rows[name].copy()
        rows[name][at] = value

    return change


def as_type(name: str, kind) -> Callable[[dict, dict], None]:
    return lambda rows, footer: rows.update({name: rows[name].astype(kind)})


def without(name: str) -> Callable[[dict, dict], None]:
    return lambda rows, footer: rows.pop(name)


def footer_says(**values) -> Callable[[dict, dict], None]:
    return lambda rows, footer: footer.update(values)


FORGERIES = {
    "trials shifted": ("newton", lambda rows, footer: rows.update(trial=rows["trial"] + 10)),
    "a trial twice": ("newton", set_to("trial", 0, 1)),
    "trials in another order": ("newton", lambda rows, footer: rows.update({k: v[::-1] for k, v in rows.items()})),
    "an error that is not a number": ("newton", set_to("error_a", np.nan, 3)),
    "an infinite error": ("newton", set_to("error_a", np.inf, 3)),
    "an unknown status": ("newton", set_to("status", "fine", 2)),
    "solved without convergence": ("newton", set_to("status", "stalled", 2)),
    "a negative cost": ("newton", set_to("simulations", -1.0, 2)),
    "a time that is not a number": ("newton", set_to("time_s", np.nan, 2)),
    "a negative deviation": ("newton", set_to("deviation_a", -1.0, 2)),
    "a share above 1": ("newton", set_to("fit_p", 1.5, 2)),
    "errors of another precision": ("newton", as_type("error_a", np.float32)),
    "errors as texts": ("newton", as_type("error_a", object)),
    "success as numbers": ("newton", as_type("success", float)),
    "no errors": ("newton", without("error_a")),
    "no success": ("newton", without("success")),
    "a bound of zero": ("truth", set_to("crlb_a", 0.0, 2)),
    "a truth that is not a number": ("truth", set_to("x_a", np.nan, 2)),
    "another key": ("newton", footer_says(key="0123456789abcdef")),
    "another source": ("newton", footer_says(source="0123456789abcdef")),
    "another identity": ("newton", lambda rows, footer: footer["identity"].update(label="other")),
    "another schema": ("newton", footer_says(schema=99)),
    "names that are none": ("newton", footer_says(names=["newton"])),
    "parameters that are none": ("newton", footer_says(parameters=[1, 2])),
    "a short linear bound": ("newton", footer_says(linear_bound=[1.0])),
}


@pytest.mark.parametrize("case", FORGERIES)
def test_content_that_cannot_be_is_named_and_healed_even_with_a_digest(folder, expected, case):
    label, change = FORGERIES[case]
    cell = next(c for c in Results.read([folder]).stored.values() if c.label == label and c.seed == 0)
    forge(cell.pieces[0].path, change)
    table, problems = expected
    assert any(str(cell.pieces[0].path) in line for line in Results.read([folder]).problems)
    run(folder)
    assert said(folder) == problems
    pd.testing.assert_frame_equal(summary(folder), table)


@pytest.mark.parametrize("change", [{"trials": "many"}, {"cells": None}, {"cells": [1]}, {"cells": [{}]}, {"run": "x"}])
def test_a_record_that_is_none_is_named_even_with_a_digest(folder, change):
    path = files(folder, "runs")[0]
    record = json.loads(path.read_text()) | change | {"seal": BLANK_SEAL}
    path.write_bytes(seal(json.dumps(record).encode()))
    assert any(str(path) in line for line in Results.read([folder]).problems)


def test_nothing_is_stored_that_would_be_refused():
    class Wrong(Newton):
        def estimate(self, problem, z, *, history=False):
            estimates = super().estimate(problem, z, history=history)
            estimates.simulations = -estimates.simulations
            return estimates

    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        (failure,) = compute([SCENARIOS[0]], {"wrong": dataclass(frozen=True)(Wrong)()}, 5, folder)
        assert "simulations does not hold finite numbers from 0 up" in failure
        assert not Results.read([folder]).damaged


def test_an_estimate_that_is_not_finite_has_not_converged(tmp_path):
    @dataclass(frozen=True)
    class Boasts(Estimator):
        def estimate(self, problem, z, *, history=False):
            x = np.zeros((len(z), problem.measurement.n))
            x[0] = np.nan
            return Estimates(x, np.zeros(len(z), np.int8))

    compute([SCENARIOS[0]], {"boasts": Boasts()}, 5, tmp_path)
    results = Results.read([tmp_path])
    rows = results.load(next(c for c in results.stored.values() if c.label == "boasts"), ["status"])
    assert rows["status"].tolist() == ["nonfinite"] + ["converged"] * 4


# The index, the folder, and what is left behind --------------------------------------------------------------------


def test_what_was_verified_and_has_not_changed_is_not_read_again(folder, monkeypatch):
    Results.read([folder])
    read: list[Path] = []
    original = Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda path: (read.append(path), original(path))[1])
    Results.read([folder])
    assert {path.parent.name for path in read} == {"results", "runs", "failed"}


def test_a_folder_that_goes_away_in_mid_run_is_not_filled_anew(tmp_path):
    folder = tmp_path / "results"

    def remove(progress) -> None:
        if progress.done == 2 and folder.exists():
            shutil.rmtree(folder)

    with pytest.raises(StorageError, match="went away"):
        compute(SCENARIOS, {"newton": Newton()}, 20, folder, block_size=2, watch=remove)
    assert not (folder / "trials").exists()


def test_the_record_of_a_run_that_goes_away_is_missed(tmp_path):
    def remove(progress) -> None:
        for path in (tmp_path / "runs").iterdir():
            path.unlink()

    with pytest.raises(StorageError, match="lost the record"):
        compute(SCENARIOS, {"newton": Newton()}, 4, tmp_path, block_size=2, watch=remove)


def test_abandoned_temporary_files_go_wherever_they_lie(folder):
    old, young = [], []
    for place in (".", "trials", "histories", "runs", "failed", "figures", "tables", "log"):
        (folder / place).mkdir(exist_ok=True)
        for found, age in ((old, 7200), (young, 60)):
            path = folder / place / f".summary.csv.host-1-{age}.tmp"
            path.touch()
            os.utime(path, (time.time() - age,) * 2)
            found.append(path)
    Store(folder).prepare()
    assert not any(path.exists() for path in old)
    assert all(path.exists() for path in young)


def test_results_of_an_older_format_are_stale_and_nothing_worse(folder, expected):
    """As version 0.1 wrote them: without digests."""
    cell = next(c for c in Results.read([folder]).stored.values() if c.label == "newton")
    table = pq.read_table(cell.pieces[0].path)
    footer = dict(cell.footer) | {"schema": 1, "key": "f" * 16}
    text = json.dumps(footer, sort_keys=True, separators=(",", ":"))
    pq.write_table(table.replace_schema_metadata({FOOTER: text}), folder / "trials" / f"{'f' * 16}-0-10.parquet")
    (folder / "runs" / "old.json").write_text(json.dumps({"cells": [{"identity_key": "a"}], "trials": 3}))
    results = Results.read([folder])
    assert said(folder) == expected[1]
    assert [line.partition(": ")[2] for line in results.stale] == [
        f"{folder / kind}: 1 files were written by an older version of ipe-bench; left out"
        for kind in ("trials", "runs")
    ]
    pd.testing.assert_frame_equal(summary(folder), expected[0])


def test_the_digest_is_of_every_bit():
    content = seal(f"a text, {BLANK_SEAL}, and more".encode())
    assert is_sealed(content)
    for bit in range(8 * len(content)):
        changed = bytearray(content)
        changed[bit // 8] ^= 1 << bit % 8
        assert not is_sealed(bytes(changed))
    assert is_sealed(b"a text") is None


def test_the_key_of_a_forged_identity_does_not_fit():
    assert key_of({"label": "a"}, "s") != key_of({"label": "b"}, "s")
    assert key_of({"label": "a"}, "s") != key_of({"label": "a"}, "t")
