"""Every sentence that a user reads is in plain English of the field, and helps fit a screen."""

from __future__ import annotations

import pytest

from ipe_bench.cli.main import COMMANDS
from ipe_bench.cli.parser import parser_of, program


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_helps_fit_80_columns(command, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    text = (parser_of(command) if command else program()).format_help()
    assert [line for line in text.splitlines() if len(line) > 80] == []
