"""Commands in this process."""

from __future__ import annotations

import pytest

from ipe_bench.cli.main import main


@pytest.fixture
def ipe_bench(monkeypatch, capsys, tmp_path):
    """Runs a command in an empty folder: its exit code and what it wrote on stdout and stderr."""
    monkeypatch.chdir(tmp_path)

    def run(*words: str) -> tuple[int, str, str]:
        code = main(list(words))
        written = capsys.readouterr()
        return code, written.out, written.err

    return run
