"""Reads the words KEY=VALUE of a command once, by Hydra's grammar.

What Hydra would answer in words of its own, or take and not do, is refused here by a line that
names the word and the remedy. What the values of options may be is checked where a job is
constructed.
"""

from __future__ import annotations

import copy
import itertools
import json
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, Glob, Override, OverrideType, QuotedString
from hydra.errors import HydraException

from ipe_bench.basics.errors import UserError, nearest, unknown
from ipe_bench.cli import refuse_blanks
from ipe_bench.cli.keys import SETTING_NOTHING, WHOLE
from ipe_bench.cli.spec import KEYS
from ipe_bench.measurements.nist import FORMULAS
from ipe_bench.plugins import discovery as plugins
from ipe_bench.runs.provenance import TARGET, digest

MOST_JOBS = 10_000
"""The largest sweep."""
TRUTH = "truth_measurement"
HYDRAS_TRUTH = f"measurement@{TRUTH}"
_TEXT = re.compile(
    rf"(\+*(?:(?:measurement|{TRUTH})\.(?:expression|(?:time_)?unit|(?:initial|rates|outputs)\.\w+)"
    r"|state_model\.(?:next|readings)\.\w+))=([^'\"].*)",
    re.DOTALL,
)
"""Texts that the shell has taken the quotes from; a list of units is none."""
_FILE = re.compile(
    rf"\+*(?:(measurement|state_model|{TRUTH})\.file|(parameters))=(?![{{$]|null$)(.*)", re.DOTALL
)

_OF_FUNCTIONS = ("start", "columns", "constants", "units", "circular", "reading")
"""Keys of a user's own model, which stand behind measurement."""
_PARAMETER = re.compile(r"\+*hydra\.sweeper\.params\.([^=]+)=(['\"]?)(.*)\2", re.DOTALL)

Groups = dict[str, list[str]]
"""The names of the options of each group."""


@dataclass(frozen=True)
class Words:
    """Holds the words of a command."""

    overrides: tuple[Override, ...]
    files: Mapping[str, str] = field(default_factory=dict)
    """Word that names the file, by an override that it holds."""

    @property
    def text(self) -> list[str]:
        """Overrides in Hydra's form."""
        return [forced(one) for one in self.overrides]

    @property
    def keys(self) -> list[str]:
        """First part of each key, in the order of the words."""
        return [_first(one) for one in self.overrides]

    @property
    def standard_baselines(self) -> bool:
        """Whether no word chooses the baselines."""
        return {"baseline", "experiment"}.isdisjoint(self.keys)

    def chosen(self, group: str) -> str | None:
        """Returns the option that is chosen last."""
        found = [one for one in self.overrides if one.key_or_group == group and one.package is None]
        return None if not found else str(plain(found[-1].value()))

    def refuse(self, keys: Collection[str], why: str) -> None:
        """Refuses a word whose key is one of these, or below one."""
        for one in self.overrides:
            first = _first(one)
            if first in keys:
                named = one.key_or_group if "." in one.key_or_group else first
                raise UserError(f"{named}: {why}; leave it out")


def _first(override: Override) -> str:
    key = TRUTH if override.package == TRUTH else override.key_or_group
    return re.split("[./]", key)[0]


def forced(override: Override) -> str:
    """Writes a word in Hydra's form. Options that a file does not name are added: their class
    judges them."""
    line = override.input_line or ""
    option = "." in override.key_or_group and not override.key_or_group.startswith("hydra")
    return f"++{line}" if option and override.type is OverrideType.CHANGE else line


def chooses(override: Override) -> bool:
    """Returns whether a word chooses configs, rather than values in them."""
    chosen = (
        override.key_or_group in (*plugins.COMPONENT_GROUPS, "experiment")
        or override.package is not None
    )
    return chosen or override.is_delete() or override.is_hydra_override()


def as_typed(words: Sequence[str], files: Mapping[str, str]) -> tuple[str, ...]:
    """Returns the words of a job, with the file in place of its content."""
    return tuple(dict.fromkeys(files.get(word, word) for word in words))


def read(command: str, words: Sequence[str], folder: Path | None = None) -> Words:
    """Reads the words of a command; `folder` holds configs besides ours."""
    refuse_blanks(words)
    groups = _groups(folder)
    found: list[Override] = []
    files: dict[str, str] = {}
    for word in words:
        parts = [_parse(command, part, groups) for part in _expanded(word)]
        found += parts
        if _FILE.fullmatch(word):
            files |= dict.fromkeys(map(forced, parts), word)
    for override in found:
        _check(override, groups)
    _check_labels(found)
    experiments = [said(one) for one in found if one.key_or_group == "experiment"]
    if len(experiments) > 1:
        raise UserError(
            f"{' '.join(experiments)}: one command runs one experiment; run them one by one"
        )
    return Words(tuple(found), files)


def _groups(folder: Path | None) -> Groups:
    found: Groups = {}
    for option in plugins.options():
        found.setdefault(option.group, []).append(option.name)
    files = [] if folder is None else filter(Path.is_file, folder.glob("*/**/*.yaml"))
    for path in sorted(files):
        group, *name = path.relative_to(folder).with_suffix("").parts  # type: ignore[arg-type]
        found.setdefault(group, []).append("/".join(name))
    found["measurement"] += [f"nist/{name.lower()}" for name in FORMULAS]
    return found


def said(override: Override) -> str:
    """Writes a word as its user did."""
    return (override.input_line or "").replace(HYDRAS_TRUTH, TRUTH)


def values(override: Override) -> Iterator[Any]:
    """Yields each value, those of a list of jobs one by one; none of ranges and intervals."""
    given = override.value()
    if isinstance(given, ChoiceSweep):
        yield from map(plain, given.list)
    elif not override.is_sweep_override():
        yield plain(given)


def plain(value: Any) -> Any:
    """Strips Hydra's quotes from a value."""
    if isinstance(value, list):
        return [plain(one) for one in value]
    if isinstance(value, dict):
        return {str(plain(key)): plain(one) for key, one in value.items()}
    return value.text if isinstance(value, QuotedString) else value


# Reading


def swept(word: str) -> str:
    """Writes a word that adds to the parameters of a sweep as the sweep that it means: Hydra 1.3
    adds none where no config has any."""
    return _PARAMETER.sub(r"\1=\3", word)


def _expanded(word: str) -> list[str]:
    """Parses a word by Hydra's grammar, or the words of a file in its place."""
    file = _FILE.fullmatch(word)
    if file:
        return _from_file(file[1] or file[2], file[3], word)
    found = _TEXT.fullmatch(word)
    if found and not (found[1].endswith("unit") and re.search(r"[,\[\]{}]", found[2])):
        return [f"{found[1]}={quoted(found[2])}"]
    if word.startswith("formats=") and "," in word and "[" not in word:
        return [f"formats=[{word.partition('=')[2]}]"]  # several formats are no sweep
    return [re.sub(rf"^(\+*){TRUTH}=", rf"\1{HYDRAS_TRUTH}=", word)]


def _from_file(group: str, name: str, word: str) -> list[str]:
    """Reads options from a YAML file, as if each had been typed."""
    content = plugins.read_yaml_file(Path(name), word)
    if not isinstance(content, dict):
        example = "NAME: {nominal: 1}" if group == "parameters" else "rates, start, outputs"
        raise UserError(f"{word}: has no keys; write a YAML file of options such as {example}")
    if TARGET in content:
        raise UserError(f"{word}: has a {TARGET}; the model is chosen by {group}=, so leave it out")
    return options_of(group, content, word)


def options_of(group: str, content: Mapping[str, Any], where: str) -> list[str]:
    """Returns the words by which one would type options that stand in a file."""
    return [f"{group}.{key}={_literal(value, where)}" for key, value in content.items()]


def _literal(value: Any, where: str) -> str:
    if isinstance(value, dict):
        entries = [f"{key}:{_literal(one, where)}" for key, one in value.items()]
        return "{" + ",".join(entries) + "}"
    if isinstance(value, list):
        return "[" + ",".join(_literal(v, where) for v in value) + "]"
    if isinstance(value, str):
        return quoted(value)
    if value is None or isinstance(value, int | float):
        return json.dumps(value)
    raise UserError(f"{where}: {value!r} is neither text nor number")


def quoted(text: str) -> str:
    """Quotes a text for Hydra's grammar."""
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"


def _parse(command: str, word: str, groups: Groups) -> Override:
    key, equals, value = word.partition("=")
    if not equals and not word.startswith("~"):
        homes = [group for group, names in groups.items() if word in names]
        remedies = [f"write {_choosing(group, word)}" for group in homes]
        remedy = " or ".join(remedies) or f"see `ipe-bench {command} --help`"
        raise UserError(f"{word}: is not KEY=VALUE; {remedy}")
    try:
        found = OverridesParser.create().parse_override(word)
    except (HydraException, ValueError, RecursionError):
        if any(value.count(one) != value.count(other) for one, other in ("[]", "{}")):
            raise UserError(
                f"{word}: the brackets do not match; close each, and quote the whole word if it"
                " contains blanks"
            ) from None
        raise UserError(
            f"{word}: the value cannot be read; a text with other signs than letters, digits"
            " and -_./:% needs quotes "
            f'that reach ipe-bench, such as "{key}={quoted(value)}"'
        ) from None
    if not found.key_or_group:
        raise UserError(f"{word}: there is no key in front of the value; write KEY=VALUE")
    pattern = found.value()
    group = found.key_or_group
    if not isinstance(pattern, Glob) or group not in groups:
        return found
    # Hydra would look for the options of Python's own data sets in a folder.
    names = [name for name in pattern.filter(groups[group]) if "/" in value or "/" not in name]
    if not names:
        raise UserError(f"{word}: the sweep has no jobs: no option of {group} fits the pattern")
    one = "[{}]" if group in plugins.PACKAGES else "{}"
    swept = ",".join(map(one.format, names))
    return OverridesParser.create().parse_override(f"{key}={swept}")


# Checking


def _check(override: Override, groups: Groups) -> None:
    group = override.key_or_group
    word = said(override)
    if group == "hydra.sweeper.params":
        raise UserError(f"{word}: give each key by itself, as in {group}.error_scale='1,10'")
    if re.split("[./]", group)[0] == "hydra":
        return
    if group in groups and not override.is_delete():
        _check_place(override)
        _check_choice(override, groups)
        return
    first = group.split(".")[0]
    if override.is_delete():
        if group in plugins.PACKAGES:
            raise UserError(f"{word}: cannot be left out; {group}=[] chooses none")
        if not group.startswith(("estimators.", "trackers.")):
            raise UserError(
                f"{word}: only estimators.LABEL can be left out; give the key another value"
            )
        return
    if override.package is not None or ("/" in group and first.split("/")[0] in groups):
        raise UserError(f"{word}: {unknown(group, groups, 'group')}")
    if first in plugins.PACKAGES:
        raise UserError(f"{word}: options are set by label; write {_by_label(first, word)}")
    if first not in KEYS and first in _OF_FUNCTIONS:
        raise UserError(f"{word}: there is no such key; did you mean measurement.{word}?")
    if first not in KEYS:
        raise UserError(f"{word}: {unknown(first, {*KEYS, *groups, 'experiment'}, 'key')}")
    if group == "estimators":
        raise UserError(
            f"{word}: choose with solver= and baseline=, and set options by"
            " estimators.LABEL.KEY=VALUE"
        )
    for value in values(override):
        if group in WHOLE and isinstance(value, float) and value.is_integer():
            raise UserError(f"{word}: is not written as a whole number; write {group}={value:.0f}")
        if group in ("trials", "block_size") and value is None:
            raise UserError(f"{word}: cannot be null; give a whole number, or leave it out")


def _choosing(group: str, name: str) -> str:
    """Writes the word that chooses an option of a group."""
    if group == "experiment":
        return f"+experiment={name}"
    return f"{group}=[{name}]" if group in plugins.PACKAGES else f"{group}={name}"


def _by_label(group: str, word: str) -> str:
    """Writes GROUP.NAME.OPTION=VALUE as the word that sets an option of that name, or the nearest
    there is."""
    key, _, value = word.lstrip("+").partition("=")
    _, name, *path = key.split(".")
    if not path:
        return f"{plugins.PACKAGES[group]}.LABEL.{name}={value}"
    known: list[str] = []
    for option in plugins.options(group):
        if option.label == name:
            known += option.config
    path[0] = nearest(path[0], known) or path[0]
    return f"{plugins.PACKAGES[group]}.{name}.{'.'.join(path)}={value}"


def _check_place(override: Override) -> None:
    """Checks that a part has a place where the job looks for it."""
    group = override.key_or_group
    package = override.package
    word = said(override)
    names = [name for name in values(override) if isinstance(name, str)]
    name = names[0] if len(names) == 1 else "NAME"
    added = override.is_add() or override.is_force_add()
    if group == "experiment" and package is None:
        if not added:
            raise UserError(
                f"{word}: an experiment is added, not overridden; write +experiment={name}"
            )
    elif package is None or (group, package) == ("measurement", TRUTH):
        if added:
            raise UserError(f"{word}: {package or group} exists already; remove the +")
    elif group not in plugins.PACKAGES:
        raise UserError(f"{word}: goes nowhere; write {group}={name}")
    elif not re.fullmatch(rf"{plugins.PACKAGES[group]}\.[^.]+", package):
        raise UserError(
            f"{word}: goes nowhere; write +{group}@{plugins.PACKAGES[group]}.LABEL={name}"
        )
    elif not added:
        raise UserError(f"{word}: another label is added; write +{group}@{package}={name}")


def _check_choice(override: Override, groups: Groups) -> None:
    """Checks that each value is an existing and usable option of the group."""
    group = override.key_or_group
    word = said(override)
    several = group in plugins.PACKAGES and override.package is None
    key = word.partition("=")[0].lstrip("+")
    if group == "experiment" and override.is_sweep_override():
        raise UserError(
            f"{word}: a sweep over experiments would ignore their own sweeps; run them one by one"
        )
    if override.is_range_sweep() or override.is_interval_sweep():
        raise UserError(f"{word}: write the names of options of {group}")
    for value in values(override):
        if value is None and (override.package == TRUTH or group == "state_model"):
            continue
        if isinstance(value, list) and not several:
            raise UserError(f"{word}: choose one: {_choosing(group, 'NAME')}")
        names = value if isinstance(value, list) else [value]
        for name in names:
            if not isinstance(name, str) or name not in groups[group]:
                shown = "null" if name is None else str(name)
                raise UserError(f"{key}={shown}: {no_option(group, shown, groups)}")
            for option in plugins.options(group):
                if option.name == name and option.fault is not None:
                    raise UserError(f"{key}={name}: {option.fault}")
            if names.count(name) > 1:
                remedy = (
                    f"+{group}@{plugins.PACKAGES[group]}.{name}_2={name} runs it again under a"
                    " label of its own"
                )
                raise UserError(f"{word}: {name} is given twice but would run once; {remedy}")


def no_option(group: str, name: str, groups: Groups) -> str:
    """Suggests a replacement of an option that its group lacks: its own group, where another group
    has it."""
    for other, names in groups.items():
        if name in names and other != group:
            return f"{name} is a {other}, not a {group}; write {_choosing(other, name)}"
    nist = group == "measurement" and name.lower().startswith("nist/")
    known = [one for one in groups[group] if one.startswith("nist/") == nist]
    meant = next((one for one in known if one.lower() == name.lower()), name)
    return unknown(meant.lower() if nist else meant, known, "data set" if nist else "option")


def _check_labels(overrides: Sequence[Override]) -> None:
    """Refuses two parts under one label, which would be mixed silently."""
    taken: dict[str, Override] = {}
    for override in overrides:
        group = override.key_or_group
        package = override.package
        if group not in plugins.PACKAGES or override.is_delete():
            continue
        value = plain(override.value())
        labels = value if isinstance(value, list) else []
        if package:
            labels = [package.partition(".")[2]]
        for label in labels:
            place = f"{plugins.PACKAGES[group]}.{label}"
            if place in taken and (package or taken[place] is not override):
                word = said(override)
                raise UserError(
                    f"{word}: {label} is the label of {said(taken[place])} already; choose another"
                    " label"
                )
            taken[place] = override


# Jobs


def jobs(overrides: Sequence[Override]) -> Iterator[list[Override]]:
    """Expands the overrides of each job of a sweep, as Hydra's basic sweeper does."""
    axes: dict[str, list[Override]] = {}
    for one in overrides:
        axes[one.get_key_element()] = _swept(one) if one.is_discrete_sweep() else [one]
    return map(list, itertools.product(*axes.values()))


def _swept(override: Override) -> list[Override]:
    try:
        values = list(itertools.islice(override.sweep_string_iterator(), MOST_JOBS + 1))
    except (HydraException, ValueError, ArithmeticError, TypeError):
        values = []
    if not 0 < len(values) <= MOST_JOBS:
        raise UserError(
            f"{said(override)}: has no value, or too many; give 1 to {MOST_JOBS} finite values"
        )
    key = override.get_key_element()
    return [OverridesParser.create().parse_override(f"{key}={value}") for value in values]


def settled(overrides: Sequence[Override]) -> list[Override]:
    """Returns one job of a sweep: the first, without what only a sweeper can choose."""
    listed = [copy.copy(one) for one in overrides if not one.is_interval_sweep()]
    return next(jobs(listed), [])


# The name of the folder


_BARE = ("measurement.dataset", "truth", "state_model", "noise", *plugins.PACKAGES)
"""Keys that come first in a name; the values of most speak for themselves."""
_LONGEST_NAME = 80


def default_name(words: Words) -> str:
    """Names the folder of a command, such as ranging-gaussian-deviation=0.1: the same for the same
    settings in any order, without keys that change no setting or add trials to it."""
    parts: dict[str, str] = {}
    held = ""
    for override in words.overrides:
        line = override.input_line or ""
        file = words.files.get(forced(override))
        if file:
            held += line
            line = f"file={Path(file.partition('=')[2]).name}"
        key, _, value = line.partition("=")
        key = key.lstrip("+~").replace(HYDRAS_TRUTH, "truth")
        key = key.rpartition("@estimators.")[2].rpartition("@trackers.")[2]
        if "[" in value:
            value = value.replace("],[", ";").replace(",", "+")
        text = re.sub(r"[\[\]'\" ]", "", value)
        if _first(override) not in SETTING_NOTHING:
            parts[key] = text or f"no_{key}"
    experiment = parts.pop("experiment", None)
    model = parts.pop("measurement", None) or parts.pop("state_model", None)
    names = [model or experiment or "gins"]
    first = [key for key in _BARE if key in parts]
    for key in (*first, *sorted(parts.keys() - set(_BARE))):
        if key in _BARE and key != "truth":
            names.append(parts[key])
        else:
            shown = re.sub("^(estimators|trackers)[.]", "", key)
            names.append(f"{shown}={parts[key]}")
    full = "-".join(names).replace("/", "-")
    short = re.sub(r"[^\w.,=+-]", "_", full, flags=re.ASCII)
    if short == full and len(full) <= _LONGEST_NAME and not held:
        return full
    return f"{short[: _LONGEST_NAME - 10]}-{digest(full + held)[:8]}"
