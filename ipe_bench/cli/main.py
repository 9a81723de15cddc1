"""Defines the command `ipe-bench`: finds the command, and turns a user's mistake into one line and
exit code 2."""

from __future__ import annotations

import contextlib
import errno
import importlib
import io
import os
import shlex
import sys
import warnings
from collections.abc import Sequence
from typing import Any

from ipe_bench import __version__
from ipe_bench.basics.errors import StorageError, UserError, shortened, unknown
from ipe_bench.basics.visible import VisibleStream
from ipe_bench.cli import discard_output, say
from ipe_bench.cli.parser import COMMANDS, parser_of, program
from ipe_bench.cli.questions import QUESTIONS, question_command
from ipe_bench.report.page.writer import COMMAND

HOMES = {
    "run": "run",
    "estimate": "estimate",
    **dict.fromkeys(("report", "status"), "results"),
    "list": "listing",
    **dict.fromkeys(("check", "new"), "workshop"),
}
"""The module of each command that is no question, which is loaded when the command is given."""

SHORT = ("run", "estimate", "design", "posterior")
"""Commands that take a model and files of readings without keys."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command; returns the exit code."""
    words = list(sys.argv[1:] if argv is None else argv)
    for stream in (sys.stdout, sys.stderr):
        # One that knows no Greek letters shows question marks.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    # Batched linear algebra is small per trial: more BLAS threads only get in each other's way.
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    # Arrow's own allocator keeps what it was given back: of a million rows, as much again as is in
    # use.
    os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")
    COMMAND.set(shlex.join(["ipe-bench", *words]))
    out = contextlib.redirect_stdout(_door(sys.stdout))
    err = contextlib.redirect_stderr(_door(sys.stderr))
    with out, err:
        return _answer(words)


def _door(stream: Any) -> Any:
    # A program without a terminal, such as pythonw, has none.
    return VisibleStream(io.StringIO() if stream is None else stream)


def _answer(words: list[str]) -> int:
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning
            # Where numbers overflow, the statuses of trials say so.
            warnings.filterwarnings("ignore", category=RuntimeWarning)
            code = _dispatch(words)
            sys.stdout.flush()
            return code
    except BrokenPipeError:
        discard_output()
        return 0
    except (Exception, KeyboardInterrupt, SystemExit) as error:  # a model may call sys.exit
        code, line = _explain(error, words[:1])
        print(f"ipe-bench: {line}", file=sys.stderr)
        return code


def _explain(error: BaseException, command: Sequence[str]) -> tuple[int, str]:
    """Returns the exit code and the line for the exception that ended a command; raises again a
    bug."""
    from ipe_bench.plugins.discovery import blame

    if isinstance(error, KeyboardInterrupt):
        kept = "results are kept; run the same command to resume"
        return 130, f"stopped; {kept if command == ['run'] else 'the same command begins anew'}"
    if isinstance(error, UserError | StorageError):
        code = 2 if isinstance(error, UserError) else 1
        return code, " ".join(str(error).split())
    if isinstance(error, OSError):
        reason = error.strerror or str(error)
        where = "a file" if error.filename is None else shortened(str(error.filename))
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            remedy = "free some space and run the same command again"
            return 1, f"{where}: {reason}; earlier results are intact; {remedy}"
        return (
            2,
            f"{where}: cannot be used ({reason}); choose another file or folder, for results with"
            " output=",
        )
    line = blame(error)
    if line is None:
        raise error
    return 2, line


def _show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    print(f"ipe-bench: warning: {' '.join(str(message).split())}", file=sys.stderr)


def _dispatch(words: list[str]) -> int:
    command, *rest = words or ["--help"]
    if command == "help" and rest:
        command = rest[0]
        rest = ["--help"]
    if command in ("-h", "--help", "help"):
        program().print_help()
        return 0
    if command == "--version":
        print(f"ipe-bench {__version__}")
        return 0
    # This is asked of the bare program; only `run` has anything to complete.
    if command in ("-sc", "--shell-completion"):
        command = "run"
        rest = words
    if command not in COMMANDS:
        remedy = unknown(command, COMMANDS, "command")
        if command.startswith("-"):
            remedy = unknown(command, ("--help", "--version"), "flag")
        raise UserError(f"{command}: {remedy}")
    if any(word in ("-h", "--help") for word in rest):
        parser_of(command).print_help()
        return 0
    return _begin(command, rest)


def _begin(command: str, rest: Sequence[str]) -> int:
    """Begins a command with the words behind it, short forms written out."""
    files: Sequence[str] = ()
    if command in SHORT and not all("=" in word for word in rest):
        from ipe_bench.cli import shorts

        short = shorts.read(command, rest)
        say(*short.assumed)
        if command == "run" and short.readings:
            from ipe_bench.cli.own import own_command

            return own_command(short)
        rest = short.in_full
        if command in QUESTIONS:
            rest = short.words
            files = short.readings
    parser = parser_of(command)
    if command in QUESTIONS:
        return question_command(command, parser.parse(rest).arguments, files)
    module = importlib.import_module(f"ipe_bench.cli.{HOMES[command]}")
    begin = getattr(module, f"{command}_command")
    if command == "run":
        return begin(rest)
    return begin(**vars(parser.parse(rest)))
