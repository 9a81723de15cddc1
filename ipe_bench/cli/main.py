"""The command `ipe-bench`: finds the subcommand, and turns a user's mistake into one line and exit code 2."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence

from ipe_bench.cli.usage import USAGE

HELP = """\
ipe-bench: which estimator to trust with nonlinear measurements

  ipe-bench run +experiment=paper                 the paper's experiment
  ipe-bench run error_scale=33 "solver=[fixed_point,newton]" "baseline=[linear_lse]"
  ipe-bench run -m error_scale=1,10,100 seed=1,2  sweeps; any Hydra flag works after run (--cfg job, --info, ...)
  ipe-bench estimate readings=FILE.csv            parameters from real readings
  ipe-bench report DIR [DIR ...]                  tables, figures and report of what is stored
  ipe-bench status DIR [DIR ...]                  what is done, missing, failed and stale there
  ipe-bench list [GROUP] [-v]                     what there is to choose from
  ipe-bench new KIND NAME                         a working plugin to start from, in plugins/NAME
  ipe-bench check plugins/NAME                    whether a plugin keeps its promises

`ipe-bench COMMAND --help` says more of one command.
Exit codes: 0 done; 1 done, but some pieces failed or are missing; 2 a mistake in what was asked for; 130 Ctrl-C.
"""

COMMANDS = {
    "run": "ipe_bench.cli.run",
    "estimate": "ipe_bench.cli.estimate",
    "report": "ipe_bench.cli.report",
    "status": "ipe_bench.cli.status",
    "list": "ipe_bench.cli.list",
    "check": "ipe_bench.cli.check",
    "new": "ipe_bench.cli.new",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one subcommand; returns the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(HELP, end="")
        return 0
    if arguments[0] == "--version":
        from ipe_bench import __version__

        print(f"ipe-bench {__version__}")
        return 0
    # Shell completion asks the bare program; only `run` has anything to complete.
    command = "run" if arguments[0] in ("-sc", "--shell-completion") else arguments.pop(0)

    if command in USAGE and any(a in ("-h", "--help") for a in arguments):
        print(USAGE[command], end="")
        return 0

    # Batched linear algebra is small per trial: more BLAS threads only get in each other's way.
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    from ipe_bench.basics.errors import StorageError, UserError, unknown

    try:
        if command not in COMMANDS:
            raise UserError(f"{command}: {unknown(command, COMMANDS, 'command')}")
        return importlib.import_module(COMMANDS[command]).main(arguments)
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
