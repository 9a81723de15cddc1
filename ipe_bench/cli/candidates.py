"""What may stand at the end of a command line: commands, flags, groups and their options, keys and their values.

Read from configs and from the source of classes, not from the classes: a shell asks at every press of a key. Names of
parameters alone are asked of the model itself, since its options may decide them. How a shell is answered is left to
`completion`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ipe_bench.cli.chosen import NIST, SINGLE, Chosen, datasets
from ipe_bench.cli.parser import KINDS, Parser, parsers
from ipe_bench.plugins import discovery as plugins
from ipe_bench.plugins.annotations import Stated, choices, stated

COMPOSED = ("run", "estimate", "design", "posterior")
"""Commands that take KEY=VALUE."""
_KEYS_OF = {
    "report": ("output", "paper", "columns", "width"),
    "compare": ("first", "second", "alpha", "anytime", "fail_on", "output"),
    "bundle": ("output",),
    "status": (),
    "check": (),
}
"""The keys of commands that take folders."""
_BUNDLE = ".zip"
_KEYS = "ipe_bench.cli.config.Schema"
_KNOWN = "ipe_bench.measurements.known.Known"
_FILES = re.compile(r"^(?:readings|write_readings|output|prior_covariance|(?:truth_)?measurement\.file)$")
_HYDRA = {
    "hydra/launcher": ("basic", "joblib", "submitit_local", "submitit_slurm"),
    "hydra/sweeper": ("basic", "optuna"),
}


@dataclass(frozen=True)
class Candidate:
    """A word that the one which is being typed may become."""

    text: str
    meaning: str = ""
    whole: bool = True
    """Whether the next word may follow; else the word goes on."""


def candidates(words: Sequence[str], current: str) -> list[Candidate]:
    """What `current` may become; `words` stand between the program's name and it."""
    return [found for found in _candidates(words, current) if found.text.startswith(current)]


def _candidates(words: Sequence[str], current: str) -> Iterator[Candidate]:
    program, commands = parsers()
    if not words:
        yield from (Candidate(name, parser.summary) for name, parser in commands.items())
        yield from _flags(program)
        return
    command, before = words[0], words[1:]
    if command not in commands:
        return
    values = _values_of_flag(commands[command], before)
    if values is not None:
        yield from map(Candidate, values)
    elif current.startswith("-"):
        yield from _flags(commands[command])
    elif command in COMPOSED:
        yield from _Overrides(before).complete(current)
    else:
        yield from _words_of(command, before, current)


def _words_of(command: str, before: Sequence[str], current: str) -> Iterator[Candidate]:
    if command == "list":
        yield from _listed(current)
    elif command == "new" and not before:
        yield from map(Candidate, KINDS)
    elif command == "completion" and not before:
        yield from map(Candidate, ("bash", "zsh", "fish"))
    elif current.startswith("output="):
        yield from (Candidate(f"output={p.text}", whole=p.whole) for p in _paths(current[7:], folders=True))
    elif command in _KEYS_OF:
        yield from (Candidate(f"{key}=", whole=False) for key in _KEYS_OF[command])
        yield from _paths(current, folders=True)


def _flags(parser: Parser) -> Iterator[Candidate]:
    for action in parser._actions:
        long = [flag for flag in action.option_strings if flag.startswith("--")]
        help = action.help if isinstance(action.help, str) and action.help != "==SUPPRESS==" else None
        if action.help != "==SUPPRESS==":
            yield from (Candidate(flag, help or "") for flag in long or action.option_strings)


def _values_of_flag(parser: Parser, before: Sequence[str]) -> Sequence[str] | None:
    """What may follow the word before, where that is a flag which wants a value."""
    action = parser._option_string_actions.get(before[-1]) if before else None
    if action is None or action.nargs == 0:
        return None
    return [str(choice) for choice in action.choices or ()]


def _listed(current: str) -> Iterator[Candidate]:
    group, slash, _ = current.partition("/")
    if not slash:
        for known in plugins.groups():
            yield Candidate(known)
            if known == current:
                yield Candidate(f"{known}/", whole=False)
        return
    yield from (Candidate(f"{group}/{option.name}", option.summary) for option in _usable(group))


def _usable(group: str) -> list[plugins.Option]:
    return [option for option in plugins.options(group) if option.fault is None]


def _paths(prefix: str, *, folders: bool) -> Iterator[Candidate]:
    """Files and folders that begin so, of files bundles alone where folders are wanted; hidden ones where a dot is
    typed."""
    home, slash, stem = prefix.rpartition("/")
    try:
        entries = sorted(Path(home + slash or ".").iterdir())
    except OSError:
        return
    for entry in entries:
        if entry.name.startswith(stem) and (stem.startswith(".") or not entry.name.startswith(".")):
            if entry.is_dir():
                yield Candidate(f"{home}{slash}{entry.name}/", whole=False)
            elif not folders or entry.suffix == _BUNDLE:
                yield Candidate(f"{home}{slash}{entry.name}")


class _Overrides:
    """The words KEY=VALUE of a command, and what another one may be."""

    def __init__(self, words: Sequence[str]) -> None:
        self.chosen = Chosen(words)

    def complete(self, current: str) -> Iterator[Candidate]:
        key, equals, value = current.partition("=")
        if not equals:
            yield from self._keys(key)
            return
        for found in self._values(key.lstrip("+"), value):
            yield Candidate(f"{key}={found.text}", found.meaning, found.whole)

    # Keys

    def _keys(self, key: str) -> Iterator[Candidate]:
        name = key.lstrip("+~")
        sign = key[: len(key) - len(name)]
        group, at, _ = name.partition("@")
        if sign == "~":
            yield from (Candidate(f"~estimators.{label}") for label in self.chosen.estimators())
        elif at:
            for option in _usable(group) if group in plugins.ESTIMATOR_GROUPS else ():
                place = f"{group}@estimators.{option.label}_2={option.name}"
                yield Candidate(f"{sign}{place}", f"{option.name} under another label")
        elif name.startswith("hydra"):
            yield from (Candidate(f"{sign}{group}=", whole=False) for group in _HYDRA)
        elif "." in name:
            yield from self._keys_inside(name.rpartition(".")[0], sign)
        else:
            yield from self._first_keys(name, sign)

    def _first_keys(self, name: str, sign: str) -> Iterator[Candidate]:
        if sign:
            yield Candidate("+experiment=", "an experiment that comes with the package or a plugin", whole=False)
            yield from (Candidate(f"+{group}@estimators.", whole=False) for group in plugins.ESTIMATOR_GROUPS)
            return
        for group in (*SINGLE, *plugins.ESTIMATOR_GROUPS, "truth_measurement"):
            yield Candidate(f"{group}=", whole=False)
            if name == group and group not in plugins.ESTIMATOR_GROUPS:
                yield Candidate(f"{group}.", whole=False)
        yield Candidate("estimators.", "options of an estimator that is chosen", whole=False)
        for field in stated(_KEYS).values():
            if field.name not in (*SINGLE, "truth_measurement", "estimators", "default_name"):
                yield Candidate(f"{field.name}{'.' if field.name == 'parameters' else '='}", field.meaning, whole=False)

    def _keys_inside(self, head: str, sign: str) -> Iterator[Candidate]:
        if head == "estimators":
            yield from (Candidate(f"{sign}estimators.{label}.", whole=False) for label in self.chosen.estimators())
        elif head == "parameters":
            yield from (Candidate(f"{sign}parameters.{name}.", unit, whole=False) for name, unit in self._parameters())
        elif re.fullmatch(r"parameters\.\w+", head):
            fields = (field for field in stated(_KNOWN).values() if field.name != "name")
            yield from (Candidate(f"{sign}{head}.{field.name}=", field.meaning, whole=False) for field in fields)
        elif (option := self._component(head)) is not None:
            for key in {**_config(option), **_fields(option)}:
                if key not in ("_target_", "defaults"):
                    yield Candidate(f"{sign}{head}.{key}=", _meaning(option, key), whole=False)

    def _parameters(self) -> list[tuple[str, str]]:
        """The parameters of the chosen model and their units; this loads NumPy and the model."""
        option = self._component("measurement")
        if option is None:
            return []
        from ipe_bench.plugins.construct import construct

        try:
            model = construct(plugins.composed(option) | self.chosen.options("measurement"), "measurement")
            return [(p.name, p.unit) for p in model.natural_parameters]
        except Exception:  # a plugin's may raise anything: no names are offered then
            return []

    # Values

    def _values(self, key: str, value: str) -> Iterator[Candidate]:
        group, _, place = key.partition("@")
        group = "measurement" if key == "truth_measurement" else group
        if group in plugins.ESTIMATOR_GROUPS and not place:
            yield from _lists(value, _usable(group))
        elif group == "measurement" and not place and value.rpartition(",")[2].startswith(NIST):
            yield from _swept(value, ((f"{NIST}{name.lower()}", "") for name in datasets()))
        elif group in (*SINGLE, *plugins.ESTIMATOR_GROUPS, "experiment"):
            yield from _swept(value, ((option.name, option.summary) for option in _usable(group)))
        elif key in _HYDRA:
            yield from map(Candidate, _HYDRA[key])
        elif _FILES.match(key):
            yield from _paths(value, folders=key == "output")
        elif key == "objective":
            yield from (Candidate(f"{label}.", whole=False) for label in self.chosen.estimators())
        else:
            yield from _swept(value, ((choice, "") for choice in self._choices(key)))

    def _choices(self, key: str) -> list[str]:
        head, _, name = key.rpartition(".")
        option = self._component(head) if head else None
        fields = stated(_KEYS) if not head else {} if option is None else _fields(option)
        return choices(fields[name]) if name in fields else []

    def _component(self, place: str) -> plugins.Option | None:
        """The option whose keys stand behind that one."""
        return next(iter(self.chosen.at(place)), None)


def _config(option: plugins.Option) -> dict[str, Any]:
    config = option.config
    return config if isinstance(config, dict) else {}


def _fields(option: plugins.Option) -> dict[str, Stated]:
    return {} if option.target is None else stated(option.target)


def _meaning(option: plugins.Option, key: str) -> str:
    fields = _fields(option)
    return option.comments.get(key) or (fields[key].meaning if key in fields else "")


def _swept(value: str, known: Iterable[tuple[str, str]]) -> Iterator[Candidate]:
    """The values of a key; behind a comma further ones, for a sweep."""
    begun, comma, _ = value.rpartition(",")
    given = begun.split(",")
    return (Candidate(f"{begun}{comma}{name}", meaning) for name, meaning in known if name not in given)


def _lists(value: str, options: Sequence[plugins.Option]) -> Iterator[Candidate]:
    """Lists of options. A name that is the only one left may end the list or go on."""
    if value and not value.startswith("["):
        yield from _swept(value, ((option.name, option.summary) for option in options))
        return
    end = max(value.rfind("["), value.rfind(",")) + 1
    begun, piece = value[:end] or "[", value[end:]
    given = re.split(r"[\[\],]+", begun)
    fitting = [option for option in options if option.name.startswith(piece) and option.name not in given]
    for option in fitting:
        if len(fitting) > 1:
            yield Candidate(f"{begun}{option.name}", option.summary, whole=False)
        else:
            yield Candidate(f"{begun}{option.name}]", option.summary)
            yield Candidate(f"{begun}{option.name},", "and another", whole=False)
