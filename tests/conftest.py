"""What tests of several rooms begin with: commands in this process, an empty store, a browser."""

from __future__ import annotations

import gc
import logging
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from shared import oracles
from shared.chromium import browser  # noqa: F401

from ipe_bench.cli.main import main
from ipe_bench.plugins import discovery

if TYPE_CHECKING:
    from shared.synthetic_store import Synthetic


def pytest_configure(config):
    oracles.join(config)


def pytest_collection_finish():
    """Collects garbage seldom: the modules and tests that are there stay until the end.

    To look through them again took 7 % of `pytest tests/cli/test_hydra_keys.py
    tests/cli/test_mistakes.py`.
    """
    gc.freeze()
    gc.set_threshold(100_000, 20, 100)


@pytest.fixture(autouse=True)
def _handlers_of_this_test():
    """Forgets the handlers that Hydra sets up, whose streams end with the test."""
    yield
    for handler in [one for one in logging.root.handlers if type(one) is logging.StreamHandler]:
        logging.root.removeHandler(handler)


@pytest.fixture(autouse=True)
def _modules_of_this_test(request):
    """Forgets the modules that a test has loaded from its folder: another has its own of the same
    name."""
    before = set(sys.modules)
    yield
    folder = request.node.funcargs.get("tmp_path")
    for name in set(sys.modules) - before:
        if folder and str(getattr(sys.modules[name], "__file__", None)).startswith(str(folder)):
            del sys.modules[name]


@pytest.fixture
def ipe_bench(monkeypatch, capsys, tmp_path):
    """Runs a command in an empty folder, whose modules and plugins are forgotten afterwards: its
    exit code, stdout and stderr."""
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "PYTHONPATH"):
        monkeypatch.setenv(variable, "1" if variable != "PYTHONPATH" else "")
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(discovery, "_added", {})
    monkeypatch.chdir(tmp_path)

    def run(*words: str) -> tuple[int, str, str]:
        discovery.sources.cache_clear()
        capsys.readouterr()
        code = main(list(words))
        written = capsys.readouterr()
        return code, written.out, written.err

    yield run
    discovery.sources.cache_clear()


@pytest.fixture
def synthetic(tmp_path: Path) -> Synthetic:
    """An empty store to fill."""
    from shared.synthetic_store import Synthetic  # loads SciPy's statistics, which few tests need

    return Synthetic(tmp_path / "store")
