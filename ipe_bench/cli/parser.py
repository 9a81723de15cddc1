"""What each command may be given, and what `--help` says of it."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any, NoReturn

from ipe_bench.basics.errors import UserError, did_you_mean, unknown
from ipe_bench.cli.keys import ROWS
from ipe_bench.cli.questions import QUESTIONS, question
from ipe_bench.report.formats import MEANING
from ipe_bench.workshop.kinds import KINDS, MODELS

_ABOUT = """\
ipe-bench: which estimator to trust with nonlinear measurements

  ipe-bench run +experiment=paper                 the paper's experiment
  ipe-bench run error_scale=33 "solver=[fixed_point,newton]" "baseline=[linear_lse]"
  ipe-bench run -m error_scale=1,10,100 seed=1,2  sweeps; any Hydra flag works after run (--cfg job, --info, ...)
  ipe-bench estimate readings=FILE.csv            parameters from real readings
  ipe-bench design measurement=gins               what the readings will say, and which to take instead
  ipe-bench posterior error_scale=300             what a few trials' readings really say, beside the estimators
"""
_CODES = """\
`ipe-bench COMMAND --help` says more of one command.
Exit codes: 0 done; 1 done, but some pieces failed or are missing; 2 a mistake in what was asked for; 130 Ctrl-C.
"""
INFO_TOPICS = ("all", "config", "defaults", "defaults-tree", "plugins", "searchpath")
_MISSING = "0 done; 1 done, but something that was asked for is missing"

Arguments = dict[str, dict[str, Any]]
"""Options of argparse for each argument, by its names."""


def _several(metavar: str, what: str) -> dict[str, Any]:
    return {"metavar": metavar, "nargs": "*", "help": what}


COMMANDS: dict[str, tuple[str, str, str, Arguments] | None] = {
    "run": (
        "simulate, estimate, store and report",
        "0 done; 1 done, but something failed",
        """
  ipe-bench run error_scale=33 "solver=[fixed_point,newton]" "baseline=[linear_lse]"
  ipe-bench run +experiment=paper                               an experiment, which may be a sweep
  ipe-bench run -m error_scale=1,10,100 seed=1,2                a job for each combination
  ipe-bench run +solver@estimators.second=newton estimators.second.tolerance=1e-3

"""
        + "".join(f"{key.written:<22} {key.meaning}\n" for key in ROWS if key.meaning),
        {
            "overrides": _several("KEY=VALUE", "see above"),
            "--dry-run": {
                "action": "store_true",
                "help": "list stored and missing trials, and forecast the time",
            },
            "-m --multirun": {"action": "store_true", "help": "run all jobs of a sweep"},
            "-c --cfg": {
                "choices": ("job", "hydra", "all"),
                "help": "print the config instead of running it",
            },
            "-p --package": {"help": "with --cfg: the part of the config to print"},
            "--resolve": {"action": "store_true", "help": "with --cfg: replace interpolations"},
            "-i --info": {
                "nargs": "?",
                "const": "all",
                "choices": INFO_TOPICS,
                "help": "what Hydra finds where",
            },
            "-cd --config-dir": {
                "metavar": "DIR",
                "help": "a folder with options and experiments of your own",
            },
            "-sc --shell-completion": {
                "action": "store_true",
                "help": "install=SHELL or uninstall=SHELL",
            },
        },
    ),
    "estimate": (
        "parameters or states from real readings, and whether the model fits them",
        "0 some estimator has an answer; 1 none has, or the model fits none",
        """
  ipe-bench estimate readings=FILE.csv                          the default model, gins
  ipe-bench estimate measurement=gins readings=FILE.parquet "solver=[newton]" "baseline=[gauss_newton,ekf]"
  ipe-bench estimate measurement=nist/misra1a                   readings that come with the model
  ipe-bench estimate measurement=formula "measurement.expression=a*(1-exp(-b*t))" measurement.start.a=5 \\
      measurement.start.b=0.3 readings=FILE.csv                 your own formula of parameters and columns
  ipe-bench estimate state_model=pendulum readings=LOG.csv "tracker=[ekf,ukf_rts]"    states that move, epoch by epoch

readings=FILE       CSV or Parquet; `ipe-bench list measurement -v` says which rows and columns a model wants.
                    A missing reading keeps its row, with an empty cell. A column sigma has standard deviations.
                    With state_model=, a row per epoch and a column per reading.
readings=[A,B]      several files, which share all parameters but those in measurement.own=[NAME].
noise.deviation=X   the standard deviation of a reading; standard errors and tests rest on it.
noise=unknown       estimates the noise level, which leaves no test of its size; noise.by=COLUMN: one for each entry;
                    "noise.sigma=a + b*h": a formula of the reading's magnitude h and of levels a and b.
ignore_columns=[A]  columns to leave out.
find=[A,B]          constants, noises or readings of state_model=, whose numbers are those of largest likelihood.
parameters.NAME.fixed=X, .lower=X, .upper=X   what is known of a parameter; parameters=FILE.yaml has that of many.
error_scale=X       how far the parameters may lie from the nominal point: the prior of filters and map_lm.
figures=none        omits the figures.
output=DIR          folder of the files, which are listed at the end: by default outputs/estimate-MODEL, or
                    outputs/estimate-MODEL-2 and so on. Files of other commands are never overwritten.
""",
        {"arguments": _several("KEY=VALUE", "any key of `ipe-bench run`")},
    ),
    # A question describes itself in its folder, and its line in the table of names.
    **dict.fromkeys(QUESTIONS),
    "report": (
        "tables, figures and report of what is stored",
        _MISSING,
        f"""
The report is made from stored results alone.

  ipe-bench report DIR                            into DIR itself
  ipe-bench report DIR1 DIR2 output=DIR           several folders together, into another
  ipe-bench report DIR paper=overview,headline columns=error_scale,estimator,success width=3.5

paper=NAMES          tables and figures for a paper instead, into DIR/paper: LaTeX (booktabs, siunitx), PDF and PNG
columns=NAMES        columns of the tables, in this order; an unknown name is refused with a list of the known ones
width=INCHES         width of a figure or table: 3.5 for one column, 7.16 for two

figures=all          figures to draw: all, main (the few that answer the question; the default) or none
formats=pdf,md,tex   {MEANING}
""",
        {"arguments": _several("DIR", "folders of results, such as outputs/paper")},
    ),
    "bundle": (
        "results in one archive to share, or whether such an archive is whole",
        _MISSING,
        """
  ipe-bench bundle outputs/paper                  outputs/paper.zip: all results, and a manifest with their digests
  ipe-bench bundle outputs/a outputs/b output=both.zip
  ipe-bench bundle both.zip                       is it whole, and what is its digest?

The same results give the same file, so that the digest may stand in a paper. Others read it beside their own results:

  ipe-bench report outputs/mine both.zip output=outputs/together
  ipe-bench compare outputs/mine both.zip
""",
        {"arguments": _several("DIR", "folders of results, or one bundle to check")},
    ),
    "status": (
        "what is done, missing, failed and stale in folders of results",
        "0 complete; 1 not complete",
        "",
        {
            "arguments": _several("DIR", "folders of results, such as outputs/paper"),
            "-v --verbose": {"action": "store_true", "help": "list complete scenarios, too"},
        },
    ),
    "list": (
        "options to choose from, and where each comes from",
        "",
        "",
        {
            "names": _several(
                "GROUP", "solver, measurement, ... or keys; solver/newton: its options"
            ),
            "-v --verbose": {
                "action": "store_true",
                "help": "with the options of each, and the files of models",
            },
        },
    ),
    "check": (
        "whether a plugin keeps the promises that every component makes",
        "0 all checks passed; 1 some failed",
        "",
        {
            "words": _several(
                "DIR", "folders of plugins, or KEY=VALUE: measurement=ode measurement.file=my.yaml"
            )
        },
    ),
    "new": (
        "a working model of one file, or a plugin in plugins/NAME, to start from",
        "",
        """
  ipe-bench new solver my_solver                  plugins/my_solver
  ipe-bench new filter my_filter                  plugins/my_filter, a baseline that takes readings epoch by epoch
  ipe-bench new state_model my_model              plugins/my_model, states that move
  ipe-bench new tracker my_tracker                plugins/my_tracker, a filter or smoother of such states
  ipe-bench new ode my_model                      my_model.yaml, differential equations
  ipe-bench new function my_model                 my_model.py, a function of parameters and columns
  ipe-bench new KIND NAME --language LANGUAGE     plugins/NAME, of a kind that an installed plugin adds
  ipe-bench new skill DIR                         pages by which a coding agent writes plugins, into a new folder DIR
  ipe-bench new ci                                a GitHub workflow that compares what plugins/ estimates with its base
""",
        {
            "kind": {"metavar": "KIND", "help": f"{', '.join((*MODELS, *KINDS))}, skill or ci"},
            "name": {
                "metavar": "NAME",
                "nargs": "?",
                "help": "small letters, digits and underscores; none for ci",
            },
            "--language": {"help": "of a plugin's kind that has several"},
        },
    ),
}
"""Each command's line, its exit codes besides 2, what its help says more, and its arguments; None for a question."""


class Parser(argparse.ArgumentParser):
    """Raises a UserError where argparse would print its usage and exit."""

    def __init__(self, **options: Any) -> None:
        super().__init__(
            formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False, **options
        )

    def error(self, message: str) -> NoReturn:
        raise UserError(f"{self.command}: {message}; see `{self.prog} --help`")

    @property
    def command(self) -> str:
        """Name of the command, to begin a message with."""
        return self.prog.partition(" ")[2]

    def parse(self, words: Sequence[str]) -> argparse.Namespace:
        """Parses these words into values."""
        values, surplus = self.parse_known_intermixed_args(words)
        if not surplus:
            return values
        word, (flag, equals, _) = surplus[0], surplus[0].partition("=")
        if self.command == "run" and flag in ("-cp", "--config-path", "-cn", "--config-name"):
            remedy = "put options and experiments of your own into a folder and name it with --config-dir"
            raise UserError(f"run: {word}: is no flag any more; {remedy}")
        flags = [flag for action in self._actions for flag in action.option_strings]
        takes_keys = equals or any(action.metavar == "KEY=VALUE" for action in self._actions)
        if (
            word.startswith("-" if equals else "--")
            and takes_keys
            and flag.lstrip("-").isidentifier()
        ):
            after = list(words)[list(words).index(word) + 1 :]
            value = (
                after[0]
                if after and "=" not in after[0] and not after[0].startswith("-")
                else "VALUE"
            )
            said = word.lstrip("-") if equals else f"{word[2:]}={value}"
            meant = did_you_mean(flag, flags) or f"; keys have no dashes: write {said}"
            raise UserError(f"{self.command}: {word}: there is no such flag{meant}")
        if word.startswith("-"):
            raise UserError(f"{self.command}: {word}: {unknown(word, flags, 'flag')}")
        raise UserError(f"{self.command}: {word}: is a word too many; see `{self.prog} --help`")


def program() -> Parser:
    """Builds the parser of the bare program, with a line for each command."""
    found = Parser(
        prog="ipe-bench", description=_ABOUT, epilog=_CODES, usage="ipe-bench COMMAND ..."
    )
    found.add_argument("--version", action="store_true", help="print the version")
    commands = found.add_subparsers(
        metavar="COMMAND", title="commands", prog="ipe-bench", parser_class=Parser
    )
    for name, row in COMMANDS.items():
        commands.add_parser(name, help=QUESTIONS[name].line if row is None else row[0])
    return found


def parser_of(name: str) -> Parser:
    """Builds the parser of a command."""
    what, codes, more, arguments = COMMANDS[name] or _of_question(name)
    epilog = f"Exit codes: {codes}; 2 a mistake in what was asked for." if codes else None
    found = Parser(
        prog=f"ipe-bench {name}", description=f"ipe-bench {name}: {what}\n{more}", epilog=epilog
    )
    for names, options in arguments.items():
        found.add_argument(*names.split(), **options)
    return found


def _of_question(name: str) -> tuple[str, str, str, Arguments]:
    record = question(name)
    return (
        QUESTIONS[name].line,
        record.codes,
        record.more,
        {"arguments": _several(*record.argument)},
    )
