"""Machine code is kept between processes, and only what was made here of the same source is run."""

import os
import subprocess
import sys

import numpy as np
import pytest

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.files import cache_folder
from ipe_bench.engine import compiled
from ipe_bench.engine.compiled import POINTER, at
from ipe_bench.measurements import LotkaVolterra
from ipe_bench.runs import provenance


def times(factor, name="scale"):
    """out[0] = factor x[0], loaded from its file or compiled."""

    def write():
        return f"""
            define void @{name}(ptr %x, ptr %out) {{
              %v = load double, ptr %x
              %w = fmul double %v, {factor!r}
              store double %w, ptr %out
              ret void
            }}"""

    out = np.empty(1)
    compiled.load.__wrapped__(f"times {factor}", write, name, (POINTER, POINTER))(
        at(np.array([3.0])), at(out)
    )
    return out[0]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("IPE_BENCH_CACHE", str(tmp_path))
    return tmp_path


def test_a_first_compilation_says_so_once(folder, caplog):
    with caplog.at_level("INFO"):
        assert times(2.5) == 7.5
        assert times(2.5) == 7.5
    expected = [f"compiling a model, once per machine: it is kept in {folder}"]
    assert [record.message for record in caplog.records] == expected


@pytest.mark.usefixtures("folder")
def test_where_nothing_makes_machine_code_one_line_says_so(monkeypatch):
    for name in ("_target", "width"):
        monkeypatch.setattr(compiled, name, getattr(compiled, name).__wrapped__)
    monkeypatch.setitem(sys.modules, "llvmlite.binding", None)
    for ask in (compiled.width, lambda: times(2.5)):
        with pytest.raises(
            UserError, match=r"compilation is not available here .*: install the package llvmlite"
        ):
            ask()


def test_damaged_machine_code_is_compiled_again_and_not_run(folder):
    times(2.5)
    (file,) = folder.glob("*.o")
    whole = file.read_bytes()
    for place in range(0, len(whole), len(whole) // 20):
        file.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        assert times(2.5) == 7.5
        assert file.read_bytes() == whole
    for damage in (whole[:-1], b"", whole + b"\0"):
        file.write_bytes(damage)
        assert times(2.5) == 7.5


def test_machine_code_of_another_source_or_name_is_not_run(folder):
    assert times(2.0) == 6.0
    (first,) = folder.glob("*.o")
    assert times(4.0) == 12.0
    (second,) = set(folder.glob("*.o")) - {first}
    one, other = first.read_bytes(), second.read_bytes()
    first.write_bytes(other)
    second.write_bytes(one)
    assert times(2.0) == 6.0
    assert times(4.0) == 12.0
    assert times(4.0, name="other") == 12.0


@pytest.mark.skipif(os.name != "posix", reason="files have owners otherwise there")
def test_machine_code_that_others_may_have_written_is_not_run(folder, caplog):
    times(2.0)
    (file,) = folder.glob("*.o")
    assert file.stat().st_mode & 0o077 == 0
    file.chmod(0o622)
    with caplog.at_level("INFO"):
        times(2.0)
        assert "compiling" in caplog.text
        assert file.stat().st_mode & 0o022 == 0
        if os.geteuid() == 0:
            os.chown(file, 12345, -1)
            caplog.clear()
            times(2.0)
            assert "compiling" in caplog.text


@pytest.mark.skipif(os.name != "posix", reason="files have owners otherwise there")
def test_where_the_cache_cannot_be_written_to_one_folder_per_user_is_used(
    tmp_path, monkeypatch, caplog
):
    (tmp_path / "file").touch()
    monkeypatch.setenv("IPE_BENCH_CACHE", str(tmp_path / "file"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with caplog.at_level("INFO"):
        assert (times(2.0), times(2.0), times(3.0)) == (6.0, 6.0, 9.0)
    assert len(caplog.records) == 2
    (spare,) = (path for path in tmp_path.iterdir() if path.is_dir())
    assert len(list(spare.iterdir())) == 2
    assert spare.stat().st_mode & 0o777 == 0o700
    spare.chmod(0o777)
    assert cache_folder() != spare
    spare.rename(tmp_path / "moved")
    spare.symlink_to(tmp_path / "moved")
    assert times(2.0) == 6.0
    assert set(tmp_path.iterdir()) == {tmp_path / "file", tmp_path / "moved", spare}


@pytest.mark.skipif(os.name != "posix", reason="homes are found otherwise there")
def test_an_empty_home_is_none_and_a_tilde_is_the_home(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("IPE_BENCH_CACHE", "~/kept")
    assert cache_folder() == tmp_path / "home" / "kept"
    monkeypatch.setenv("IPE_BENCH_CACHE", "")
    monkeypatch.setenv("XDG_CACHE_HOME", "")
    assert cache_folder() == tmp_path / "home" / ".cache" / "ipe-bench"
    monkeypatch.setenv("HOME", "")
    assert cache_folder().is_absolute()
    assert [path.name for path in tmp_path.iterdir()] == ["home"]


@pytest.mark.slow
def test_what_is_compiled_already_needs_no_compiler(tmp_path):
    script = """
import sys
from ipe_bench.measurements import LotkaVolterra

model = LotkaVolterra()
model.jacobian(model.nominal[None])
print("ipe_bench.engine.emit" in sys.modules)
"""
    environment = os.environ | {"IPE_BENCH_CACHE": str(tmp_path)}
    said = [
        subprocess.run(
            [sys.executable, "-c", script],
            env=environment,
            check=True,
            capture_output=True,
            text=True,
        )
        for _ in range(2)
    ]
    assert [run.stdout.strip() for run in said] == ["True", "False"]


@pytest.mark.parametrize(
    "module",
    ["engine.compiled", "engine.emit.integrator", "engine.emit.rows", "engine.emit.vectors"],
)
def test_what_machine_code_comes_from_is_part_of_the_source_that_results_depend_on(
    monkeypatch, module
):
    """It is imported only where something is compiled, and yet a change to it makes stored results
    those of other code."""
    before = provenance.fingerprint([LotkaVolterra()])["source"]
    read, changed = provenance._source_of, f"ipe_bench.{module}"
    altered = lambda name: (read(name)[0] + "#" * (name == changed), read(name)[1])  # noqa: E731
    monkeypatch.setattr(provenance, "_source_of", altered)
    assert provenance.fingerprint([LotkaVolterra()])["source"] != before
