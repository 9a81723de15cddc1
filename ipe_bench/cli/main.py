"""The command `ipe-bench`: finds the command, and turns a user's mistake into one line and exit code 2."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable, Sequence

from ipe_bench import __version__
from ipe_bench.basics.errors import StorageError, UserError, unknown
from ipe_bench.cli.parser import parsers

COMMANDS = ("run", "estimate", "report", "status", "list", "check", "new")


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command; returns the exit code."""
    words = list(sys.argv[1:] if argv is None else argv)
    # Batched linear algebra is small per trial: more BLAS threads only get in each other's way.
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    try:
        return _dispatch(words)
    except UserError as error:
        print(f"ipe-bench: {error}", file=sys.stderr)
        return 2
    except StorageError as error:
        print(f"ipe-bench: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("ipe-bench: stopped; what was computed is kept, and the same command goes on from there", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # Whoever read the output has closed it: not worth a traceback.
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115
        return 0


def _dispatch(words: list[str]) -> int:
    command, *rest = words or ["--help"]
    if command in ("-h", "--help", "help"):
        parsers()[0].print_help()
        return 0
    if command == "--version":
        print(f"ipe-bench {__version__}")
        return 0
    if command in ("-sc", "--shell-completion"):  # asked of the bare program; only `run` has anything to complete
        command, rest = "run", words
    if command not in COMMANDS:
        known, noun = (("--help", "--version"), "flag") if command.startswith("-") else (COMMANDS, "command")
        raise UserError(f"{command}: {unknown(command, known, noun)}")
    if command == "run":
        return _entry(command)(rest)
    parser = parsers()[1][command]
    if any(word in ("-h", "--help") for word in rest):
        parser.print_help()
        return 0
    return _entry(command)(**vars(parser.parse(rest)))


def _entry(command: str) -> Callable[..., int]:
    return importlib.import_module(f"ipe_bench.cli.{command}").main
