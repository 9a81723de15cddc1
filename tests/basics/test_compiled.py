"""What was compiled once is called without a compiler, and nothing but what it takes reaches it."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys

import numpy as np
import pytest

from ipe_bench.basics.compiled import load
from ipe_bench.measurements import LotkaVolterra
from ipe_bench.runs import provenance
from ipe_bench.solvers import FixedPoint

SOURCE = """
import numpy as np
from numba import njit


@njit("float64(float64[:, ::1], int64[::1], int64, float64[::1])", error_model="numpy")
def sines(x, rows, columns, sums):
    largest = -np.inf
    for i in range(rows.shape[0]):
        sums[i] = 0.0
        for j in range(columns):
            sums[i] += np.sin(x[rows[i] // 2, j]) / x.shape[0]
        largest = max(largest, sums[i])
    return largest
"""


@pytest.fixture
def arguments():
    rng = np.random.default_rng(0)
    return rng.normal(size=(4, 3)), np.array([6, 1, 4]), 3, np.empty(3)


def test_a_function_computes_with_the_arrays_that_it_is_given(arguments):
    x, rows, _, sums = arguments
    assert load(SOURCE)(*arguments) == sums.max()
    np.testing.assert_allclose(sums, np.sin(x[rows // 2]).sum(axis=1) / 4, rtol=1e-15)


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (0, np.zeros((4, 6))[:, ::2]),
        (0, np.zeros(4)),
        (0, np.zeros((4, 3), np.float32)),
        (1, np.zeros(3)),
        (2, 0.5),
        (3, np.broadcast_to(0.0, 3)),
    ],
)
def test_other_arguments_are_refused(arguments, place, value):
    wrong = list(arguments)
    wrong[place] = value
    with pytest.raises((TypeError, ctypes.ArgumentError)):
        load(SOURCE)(*wrong)


def test_more_or_fewer_arguments_are_refused(arguments):
    with pytest.raises(ValueError, match="zip"):
        load(SOURCE)(*arguments[:-1])
    with pytest.raises(ValueError, match="zip"):
        load(SOURCE)(*arguments, 1)


def test_a_first_compilation_says_so_once(tmp_path, monkeypatch, caplog):
    monkeypatch.setenv("IPE_BENCH_CACHE", str(tmp_path))
    source = SOURCE + "# of a first compilation\n"
    with caplog.at_level("INFO"):
        load(source)
        load.__wrapped__(source)
    assert [record.message for record in caplog.records] == [
        f"compiling an integrator, once per machine: it is kept in {tmp_path}"
    ]


def test_damaged_machine_code_is_compiled_again_and_not_run(tmp_path, monkeypatch, arguments):
    monkeypatch.setenv("IPE_BENCH_CACHE", str(tmp_path))
    load.__wrapped__(SOURCE)
    (file,) = tmp_path.glob("*.o")
    whole = file.read_bytes()
    for damage in (whole[:-10], whole[:-200] + bytes(100) + whole[-100:], b""):
        file.write_bytes(damage)
        assert load.__wrapped__(SOURCE)(*arguments) == arguments[-1].max()
        # The compiler names its functions by its own count, so the code need not be the same to the last bit.
        assert len(file.read_bytes()) > len(whole) - 200


def test_what_is_compiled_already_needs_no_compiler(tmp_path):
    script = f"""
import sys
import numpy as np
from ipe_bench.basics.compiled import load

load({SOURCE!r})(np.zeros((1, 1)), np.zeros(1, np.int64), 1, np.zeros(1))
print("numba" in sys.modules)
"""
    environment = os.environ | {"IPE_BENCH_CACHE": str(tmp_path)}
    said = [
        subprocess.run([sys.executable, "-c", script], env=environment, check=True, capture_output=True, text=True)
        for _ in range(2)
    ]
    assert [run.stdout.strip() for run in said] == ["True", "False"]


@pytest.mark.parametrize(
    ("module", "part"),
    [
        ("basics.compiled", LotkaVolterra()),
        ("basics.compiler", LotkaVolterra()),
        ("measurements.ode.machine_code", LotkaVolterra()),
        ("basics.definite", FixedPoint()),
        ("basics.normal", FixedPoint()),
    ],
)
def test_what_machine_code_comes_from_is_part_of_the_source_that_results_depend_on(monkeypatch, module, part):
    """It is handed over as text, or imported where something is compiled alone, and yet a change to it makes stored
    results those of other code."""
    before = provenance.fingerprint([part])["source"]
    read, changed = provenance._digest_of, f"ipe_bench.{module}"
    monkeypatch.setattr(provenance, "_digest_of", lambda name: read(name) + "#" * (name == changed))
    assert provenance.fingerprint([part])["source"] != before
