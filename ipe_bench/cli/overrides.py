"""The words after `run` and `estimate`, read by Hydra's grammar before Hydra acts on them.

What Hydra would answer in words of its own, or take without a word and not do, is refused here by a line that names
the word and the remedy. What an experiment file asks for is checked where the composed config is assembled.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import (
    ChoiceSweep,
    Glob,
    IntervalSweep,
    Override,
    OverrideType,
    QuotedString,
    RangeSweep,
)
from hydra.errors import HydraException

from ipe_bench.basics.errors import UserError, unknown
from ipe_bench.plugins import discovery as plugins

MOST_JOBS = 10_000
"""No sweep is meant to have more jobs along one axis."""
_TRUTH = "truth_measurement"
_ADDED = (OverrideType.ADD, OverrideType.FORCE_ADD)


def read(words: Sequence[str], keys: Sequence[str], folders: Sequence[Path] = ()) -> list[Override]:
    """The overrides that these words are; `keys` are those of the config, `folders` hold configs besides ours.

    Raises:
        UserError: a word is none, or Hydra would not do what it says.
    """
    overrides = [_parse(word) for word in words]
    optimises = any(o.key_or_group == "hydra/sweeper" and o.value() != "basic" for o in overrides)
    for word, override in zip(words, overrides, strict=True):
        _check(_Word(word, override, keys, folders), optimises=optimises)
    _check_labels(words, overrides)
    experiments = [word for word, o in zip(words, overrides, strict=True) if o.key_or_group == "experiment"]
    if len(experiments) > 1:
        raise UserError(f"{' '.join(experiments)}: one command runs one experiment; run them one by one")
    return overrides


def known_options(group: str, folders: Sequence[Path]) -> dict[str, Path]:
    """The files of the options of a group by name; those of `folders` come first, as they do in Hydra."""
    found = {}
    for folder in folders:
        for path in sorted((folder / group).rglob("*.yaml")):
            found.setdefault(path.relative_to(folder / group).with_suffix("").as_posix(), path)
    for option in plugins.options(group):
        found.setdefault(option.name, option.path)
    return found


def _parse(word: str) -> Override:
    try:
        override = OverridesParser.create().parse_override(word)
    except (HydraException, ValueError, RecursionError):
        key, equals, value = word.partition("=")
        if not equals:
            raise UserError(f"{word}: is not KEY=VALUE; see `ipe-bench run --help`") from None
        quoted = value.replace("\\", "\\\\").replace("'", "\\'")
        raise UserError(
            f"{word}: the value cannot be read; a text with other signs than letters, digits and -_./:% needs quotes "
            f"that reach ipe-bench, such as \"{key}='{quoted}'\", and brackets have to be closed"
        ) from None
    if not override.key_or_group:
        raise UserError(f"{word}: there is no key in front of the value; write KEY=VALUE")
    return override


class _Word:
    """One override with what it is checked against."""

    def __init__(self, text: str, override: Override, keys: Sequence[str], folders: Sequence[Path]) -> None:
        self.text = text.replace(f"measurement@{_TRUTH}", _TRUTH)
        self.group = override.key_or_group
        self.package = override.package
        self.type = override.type
        self.value = override._value
        self.sweeps = override.is_sweep_override()
        self.keys = keys
        self.folders = folders
        self.grouped = self.group in plugins.groups() or any((f / self.group).is_dir() for f in folders)
        if self.group.startswith("hydra"):
            self.grouped = False

    @property
    def key(self) -> str:
        """What the user wrote before the equals sign, without the sign of adding."""
        return self.text.partition("=")[0].lstrip("+")

    def error(self, what: str) -> UserError:
        return UserError(f"{self.text}: {what}")

    def values(self) -> Iterator[Any]:
        """Each value, those of a sweep one by one, without quotes; nothing for patterns and ranges."""
        if isinstance(self.value, ChoiceSweep):
            yield from (_plain(v) for v in self.value.list)
        elif not isinstance(self.value, RangeSweep | Glob | IntervalSweep):
            yield _plain(self.value)


def _plain(value: Any) -> Any:
    if isinstance(value, list):
        return [_plain(v) for v in value]
    return value.text if isinstance(value, QuotedString) else value


def _check(word: _Word, *, optimises: bool) -> None:
    if word.group.split("/")[0].split(".")[0] == "hydra":
        return
    if word.type is OverrideType.DEL:
        _check_deletion(word)
    elif word.grouped:
        _check_place(word)
        _check_choice(word)
    else:
        _check_key(word)
    if isinstance(word.value, RangeSweep):
        _check_range(word, word.value)
    elif isinstance(word.value, IntervalSweep) and not optimises:
        raise word.error(
            "interval() is for sweepers that optimise (hydra/sweeper=optuna); give the values, such as 1,10,100"
        )


def _check_deletion(word: _Word) -> None:
    if word.group in plugins.ESTIMATOR_GROUPS:
        raise word.error(f"cannot be left out; {word.group}=[] chooses none")
    if not word.group.startswith("estimators."):
        raise word.error("only estimators.LABEL can be left out; give the key another value")


def _check_key(word: _Word) -> None:
    first = word.group.split(".")[0]
    if word.package is not None:
        raise word.error(f"{unknown(word.group, plugins.groups(), 'group')}")
    if first not in word.keys:
        raise word.error(unknown(first, {*word.keys, *plugins.groups(), "experiment"}, "key"))
    if "/" in word.group:
        raise word.error(f"{unknown(word.group, plugins.groups(), 'group')}")
    for value in word.values():
        if word.group in ("name", "output") and str(value).strip() in ("", ".", ".."):
            raise word.error("name a folder")
        if word.group in ("trials", "block_size") and value is None:
            raise word.error("cannot be null; give a whole number, or leave it out")
        if word.group == "estimators":
            raise word.error("choose with solver= and baseline=, and set options by estimators.LABEL.KEY=VALUE")


def _check_place(word: _Word) -> None:
    """Whether the part lands where something looks for it."""
    group, package = word.group, word.package
    if package is None:
        if group == "experiment":
            if word.type not in _ADDED:
                raise word.error("an experiment is added, not overridden; write +experiment=NAME")
        elif word.type in _ADDED:
            raise word.error(f"{group} is there to be chosen, not added; leave out the +")
    elif group in plugins.ESTIMATOR_GROUPS:
        home, _, label = package.partition(".")
        if home != "estimators" or not label or "." in label:
            raise word.error(f"goes nowhere; write +{group}@estimators.LABEL=NAME")
        if word.type not in _ADDED:
            raise word.error(f"a label of its own is added; write +{group}@{package}=NAME")
    elif (group, package) != ("measurement", _TRUTH):
        raise word.error(f"goes nowhere; write {group}=NAME")
    elif word.type in _ADDED:
        raise word.error(f"{_TRUTH} is there to be chosen, not added; leave out the +")


def _check_choice(word: _Word) -> None:
    """Whether each value is an option of the group that can be used."""
    group = word.group
    known = known_options(group, word.folders)
    several = group in plugins.ESTIMATOR_GROUPS and word.package is None
    if group == "experiment" and word.sweeps:
        raise word.error("a sweep over experiments would ignore their own sweeps; run them one by one")
    if isinstance(word.value, RangeSweep):
        raise word.error(f"write the names of options of {group}")
    for value in word.values():
        if value is None and word.package == _TRUTH:
            continue
        if isinstance(value, list) and not several:
            raise word.error(f"choose one: {group}=NAME")
        names = value if isinstance(value, list) else [value]
        for name in names:
            if not isinstance(name, str) or name not in known:
                shown = "null" if name is None else str(name)
                raise UserError(f"{word.key}={shown}: {unknown(shown, known, 'option')}")
            fault = plugins.fault(group, name)
            if fault is not None:
                raise UserError(f"{word.key}={name}: {fault}")
            if names.count(name) > 1:
                remedy = f"+{group}@estimators.{name}_2={name} runs it again under a label of its own"
                raise word.error(f"{name} stands there twice and would run once; {remedy}")


def _check_range(word: _Word, values: RangeSweep) -> None:
    numbers = (values.start, values.stop, values.step)
    if any(n is None or not math.isfinite(n) for n in numbers) or values.step == 0:
        raise word.error("give a range three finite numbers, START, STOP and STEP, the last not 0")
    jobs = (values.stop - values.start) / values.step  # type: ignore[operator]
    if not 0 < jobs <= MOST_JOBS:
        raise word.error(f"is a sweep of {max(0, math.ceil(jobs))} jobs; give a range of 1 to {MOST_JOBS}")


def _check_labels(words: Sequence[str], overrides: Sequence[Override]) -> None:
    """Two parts under one label would be mixed, without a word."""
    taken: dict[str, str] = {}
    for word, override in zip(words, overrides, strict=True):
        group, package = override.key_or_group, override.package
        if group not in plugins.ESTIMATOR_GROUPS or override.type is OverrideType.DEL:
            continue
        value = _plain(override._value)
        labels = [package.partition(".")[2]] if package else value if isinstance(value, list) else []
        for label in labels:
            if label in taken and (package or taken[label] != word):
                raise UserError(f"{word}: {label} is the label of {taken[label]} already; choose another label")
            taken[label] = word


_NO_PART_OF_A_NAME = ("name", "output", "trials", "block_size", "seed", "execution", "experiment", "hydra", "readings")
_NO_PART_OF_A_NAME += ("precision", "time_limit", "write_readings", "write_readings_trial", "default_name", "objective")
_NO_PART_OF_A_NAME += ("figures", "formats")
_LONGEST_NAME = 80


def default_name(overrides: Sequence[Override]) -> str:
    """What a command asks for, in a name for its folder: ranging-gaussian-deviation=0.1.

    The same for the same settings in any order. What changes no setting, or adds trials to it, is no part of it.
    """
    parts: dict[str, str] = {"measurement": "gins"}
    experiment = ""
    for override in overrides:
        key, value = (override.input_line or "").partition("=")[::2]
        key = key.lstrip("+~").replace("measurement@truth_measurement", "truth").partition("@estimators.")
        key = key[2] or key[0]
        text = re.sub(r"[\[\]'\" ]", "", value.replace("],[", ";").replace(",", "+") if "[" in value else value)
        if override.key_or_group == "experiment":
            experiment = text
        elif override.key_or_group.partition(".")[0].partition("/")[0] not in _NO_PART_OF_A_NAME:
            parts[key] = f"no_{key}" if override.type is OverrideType.DEL or text == "" else text
    if experiment and parts["measurement"] == "gins":
        parts["measurement"] = experiment
    order = ["measurement", "measurement.dataset", "truth", "noise", *plugins.ESTIMATOR_GROUPS]
    keys = sorted(parts, key=lambda k: (order.index(k) if k in order else len(order), k))
    bare = ("measurement", "measurement.dataset", "noise", *plugins.ESTIMATOR_GROUPS)
    full = "-".join(parts[k] if k in bare else f"{k.removeprefix('estimators.')}={parts[k]}" for k in keys)
    full = full.replace("/", "-")
    short = re.sub(r"[^\w.,=+-]", "_", full, flags=re.ASCII)
    if short == full and len(full) <= _LONGEST_NAME:
        return full
    return f"{short[: _LONGEST_NAME - 10]}-{hashlib.sha256(full.encode()).hexdigest()[:8]}"
