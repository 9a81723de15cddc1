"""Hydra's flags can be added where argparse reads each help at once, as that of Python 3.14 does."""

from __future__ import annotations

import argparse

import pytest
from hydra._internal.utils import get_args_parser

from ipe_bench.cli.flags import flags_of_hydra


@pytest.fixture
def reads_each_help(monkeypatch):
    """argparse as of Python 3.14: `add_argument` formats the help of what it has added."""
    add = argparse._ActionsContainer.add_argument

    def check_help(parser, action):
        try:
            return action.help and "%" in action.help and action.help % {}
        except TypeError:
            raise ValueError("badly formed help string") from None

    def add_and_check(self, *names, **options):
        action = add(self, *names, **options)
        if isinstance(self, argparse.ArgumentParser):
            self._check_help(action)
        return action

    monkeypatch.setattr(argparse.ArgumentParser, "_check_help", check_help, raising=False)
    monkeypatch.setattr(argparse._ActionsContainer, "add_argument", add_and_check)


def test_flags_are_added_though_one_help_is_no_text_yet(reads_each_help):
    with pytest.raises(ValueError, match="badly formed help string"):
        get_args_parser()
    with flags_of_hydra():
        assert get_args_parser().parse_args(["-m", "trials=5"]).multirun
        with pytest.raises(ValueError, match="badly formed help string"):
            argparse.ArgumentParser().add_argument("--wrong", help="%d")
    with pytest.raises(ValueError, match="badly formed help string"):
        get_args_parser()
