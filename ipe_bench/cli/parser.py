"""Defines the arguments of each command and the text of its `--help`."""

from __future__ import annotations

import argparse
import textwrap
from collections.abc import Sequence
from typing import Any, NoReturn

from ipe_bench.basics.errors import UserError, did_you_mean, unknown
from ipe_bench.cli.keys import ROWS
from ipe_bench.cli.questions import QUESTIONS, question
from ipe_bench.report.formats import MEANING
from ipe_bench.workshop.kinds import KINDS, MODELS

_ABOUT = """\
ipe-bench: which estimator to trust with nonlinear measurements

  ipe-bench estimate oxygen.py oxygen.csv         your function, your readings
  ipe-bench run oxygen.py oxygen.csv              which estimator suits them
  ipe-bench run +experiment=paper                 the paper's experiment
  ipe-bench run error_scale=33 "solver=[fixed_point,newton]" "baseline=[ekf]"
  ipe-bench run -m error_scale=1,10,100 seed=1,2  a sweep, by Hydra
  ipe-bench estimate readings=FILE.csv            parameters from real readings
  ipe-bench design measurement=gins               how well readings will do
  ipe-bench posterior error_scale=300             estimates beside the posterior
"""
_CODES = """\
`ipe-bench COMMAND --help` has the arguments of a command.
Exit codes: 0 done; 1 done, but something failed or is missing; 2 wrong
arguments; 130 Ctrl-C.
"""
INFO_TOPICS = ("all", "config", "defaults", "defaults-tree", "plugins", "searchpath")
_MISSING = "0 done; 1 done, but something is missing"

Arguments = dict[str, dict[str, Any]]
"""Options of argparse for each argument, by its names."""


def _wrapped(key: str, meaning: str) -> str:
    """Writes a key and its meaning in 80 columns."""
    indent = " " * 23
    lines = textwrap.fill(meaning, 80, initial_indent=indent, subsequent_indent=indent)
    return f"{key:<22} {lines.lstrip()}\n"


def _several(metavar: str, what: str) -> dict[str, Any]:
    return {"metavar": metavar, "nargs": "*", "help": what}


COMMANDS: dict[str, tuple[str, str, str, Arguments] | None] = {
    "run": (
        "simulate, estimate, store and report",
        "0 done; 1 done, but something failed",
        """
  ipe-bench run oxygen.py oxygen.csv              which estimator suits data
                                                  like yours: your function, a
                                                  formula in quotes, or the YAML
                                                  file of states, with a log
  ipe-bench run error_scale=33 "solver=[fixed_point,newton]" "baseline=[ekf]"
  ipe-bench run +experiment=paper                 an experiment
  ipe-bench run -m error_scale=1,10,100 seed=1,2  a job for each combination
  ipe-bench run +solver@estimators.big=newton estimators.big.tolerance=1e-3

Quote values with brackets, or the shell takes them for a pattern.

"""
        + "".join(_wrapped(key.written, key.meaning) for key in ROWS if key.meaning),
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
                "metavar": "TOPIC",
                "help": f"what Hydra finds where: {', '.join(INFO_TOPICS)}",
            },
            "-cd --config-dir": {
                "metavar": "DIR",
                "help": "a folder with options and experiments of your own",
            },
            "-cn --config-name": {
                "metavar": "NAME",
                "default": "config",
                "help": "the primary config, in that folder",
            },
            "--hydra-help": {"action": "store_true", "help": "what Hydra says of itself"},
            "--experimental-rerun": {
                "metavar": "DIR",
                "help": "the words of a job, from the .hydra folder that Hydra left",
            },
            "-sc --shell-completion": {
                "action": "store_true",
                "help": "install=SHELL or uninstall=SHELL",
            },
        },
    ),
    "estimate": (
        "estimate parameters or states from real readings, and test the fit",
        "0 some estimator has an answer; 1 none has, or the model fits none",
        """
  ipe-bench estimate oxygen.py oxygen.csv         your function: the only one of
                                                  the file, or oxygen.py:NAME
  ipe-bench estimate "a*exp(-b*t)+c" FILE.csv     your formula: names that are
                                                  no columns start at 1
  ipe-bench estimate car.yaml LOG.csv             your state model by formulas

What is assumed stands in the first lines. The same with keys:

  ipe-bench estimate readings=FILE.csv            the default model, gins
  ipe-bench estimate measurement=gins readings=FILE.parquet "solver=[newton]"
  ipe-bench estimate measurement=nist/misra1a     readings that the model has
  ipe-bench estimate measurement=function measurement.of=MODULE:NAME \\
      readings=FILE.csv                           your own function
  ipe-bench estimate measurement=formula \\
      "measurement.expression=a*(1-exp(-b*t))" measurement.start.a=5 \\
      measurement.start.b=0.3 readings=FILE.csv   your own formula
  ipe-bench estimate state_model=pendulum readings=LOG.csv "tracker=[ekf]"

readings=FILE       CSV or Parquet; `ipe-bench list measurement -v` names the
                    columns of a model. A missing reading is an empty cell.
                    A column sigma has standard deviations. With state_model=,
                    a row per time step, a column per reading.
readings=[A,B]      several files, which share all parameters except
                    measurement.own=[NAME].
noise.deviation=X   standard deviation of a reading, for standard errors and
                    the test of fit.
noise=unknown       estimate the noise level; the size of residuals is then
                    not tested. noise.by=COLUMN: a level for each entry.
                    "noise.sigma=a + b*h": a formula of levels a, b and of the
                    reading's magnitude h.
ignore_columns=[A]  columns to leave out.
find=[A,B]          find constants, noises or readings of state_model= by
                    maximum likelihood.
gate=P              leave a reading out of a log whose innovation lies beyond
                    this quantile of the predicted distribution, as in 0.999.
parameters.NAME.fixed=X, .lower=X, .upper=X
                    knowledge of a parameter; parameters=FILE.yaml: of many.
error_scale=X       distance of parameters from the start: the prior
                    of filters and map_lm.
figures=none        omit the figures.
output=DIR          folder of the files (outputs/estimate-MODEL, or
                    outputs/estimate-MODEL-2 and so on). Files of other
                    commands are never overwritten.
""",
        {
            "arguments": _several(
                "KEY=VALUE", "any key of `ipe-bench run`; or a model and files of readings"
            )
        },
    ),
    # A question describes itself in its folder, and its line in the table of names.
    **dict.fromkeys(QUESTIONS),
    "report": (
        "build tables, figures and report from stored results",
        _MISSING,
        f"""
The report is made from stored results alone.

  ipe-bench report DIR                            into DIR itself
  ipe-bench report DIR1 DIR2 output=DIR           several folders in one report
  ipe-bench report DIR paper=overview columns=estimator,success width=3.5

paper=NAMES         tables and figures for a paper instead, into DIR/paper:
                    LaTeX (booktabs, siunitx), PDF and PNG
columns=NAMES       columns of the tables, in this order
width=INCHES        width of a figure or table: 3.5 for one column, 7.16 for two

figures=all         figures to draw: all, main (the default) or none
formats=pdf,md,tex  {MEANING}
""",
        {"arguments": _several("DIR", "folders of results, such as outputs/paper")},
    ),
    "status": (
        "list what is done, missing, failed and stale in folders of results",
        "0 complete; 1 not complete",
        "",
        {
            "arguments": _several("DIR", "folders of results, such as outputs/paper"),
            "-v --verbose": {"action": "store_true", "help": "list complete scenarios, too"},
        },
    ),
    "list": (
        "list the options of all groups, and where each comes from",
        "",
        "",
        {
            "names": _several("GROUP", "solver, measurement, ...; solver/newton: its options"),
            "-v --verbose": {
                "action": "store_true",
                "help": "with the options of each, and the columns of readings files",
            },
        },
    ),
    "check": (
        "test whether a plugin keeps the promises of its kind",
        "0 all checks passed; 1 some failed",
        "",
        {
            "words": _several(
                "DIR", "folders of plugins, or KEY=VALUE: measurement=ode measurement.file=my.yaml"
            )
        },
    ),
    "new": (
        "create a plugin, or a model of one file, from a template",
        "",
        """
  ipe-bench new solver my_solver                  plugins/my_solver
  ipe-bench new filter my_filter                  a filter of constants
  ipe-bench new state_model my_model              states that move
  ipe-bench new tracker my_tracker                a filter or smoother of them
  ipe-bench new ode my_model                      my_model.yaml, by equations
  ipe-bench new function my_model                 my_model.py, by a function
  ipe-bench new KIND NAME --language LANGUAGE     a kind that a plugin adds
  ipe-bench new skill DIR                         pages for a coding agent
  ipe-bench new ci                                a workflow that compares the
                                                  estimators of plugins/ with
                                                  their base
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
"""Each command's line, its exit codes besides 2, the rest of its help, and its arguments; None for
a question."""


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
        word = surplus[0]
        flag, equals, _ = word.partition("=")
        if self.command == "run" and flag in ("-cp", "--config-path"):
            raise UserError(f"run: {word}: name the folder with --config-dir")
        flags = [flag for action in self._actions for flag in action.option_strings]
        takes_keys = equals or any(action.metavar == "KEY=VALUE" for action in self._actions)
        dashes = "-" if equals else "--"
        if takes_keys and word.startswith(dashes) and flag.lstrip("-").isidentifier():
            place = list(words).index(word)
            after = list(words[place + 1 :])
            value = "VALUE"
            if after and "=" not in after[0] and not after[0].startswith("-"):
                value = after[0]
            said = word.lstrip("-") if equals else f"{word[2:]}={value}"
            from ipe_bench.plugins.discovery import groups

            if word[2:] in groups() and not value.isidentifier():
                said = f"{word[2:]}=NAME or {word[2:]}.KEY={value}"
            meant = did_you_mean(flag, flags) or f"; keys have no dashes: write {said}"
            raise UserError(f"{self.command}: {word}: there is no such flag{meant}")
        if word.startswith("-"):
            raise UserError(f"{self.command}: {word}: {unknown(word, flags, 'flag')}")
        raise UserError(f"{self.command}: {word}: is not expected; see `{self.prog} --help`")


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
    line = textwrap.fill(f"ipe-bench {name}: {what}", 80)
    epilog = textwrap.fill(f"Exit codes: {codes}; 2 wrong arguments.", 80) if codes else None
    found = Parser(
        prog=f"ipe-bench {name}",
        description=f"{line}\n{more}",
        epilog=epilog,
    )
    for names, options in arguments.items():
        found.add_argument(*names.split(), **options)
    return found


def _of_question(name: str) -> tuple[str, str, str, Arguments]:
    record = question(name)
    arguments = {"arguments": _several(*record.argument)}
    return QUESTIONS[name].line, record.codes, record.more, arguments
