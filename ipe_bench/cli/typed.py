"""Options on the command line by the types of their classes, before anything is composed or computed.

Every value of a sweep is looked at: one that is of a wrong type would else be found after hours. What only the composed
config tells is left to where it is assembled.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from hydra.core.override_parser.types import ChoiceSweep, Glob, IntervalSweep, Override, QuotedString, RangeSweep

from ipe_bench.basics.errors import UserError, unknown
from ipe_bench.basics.options import Count, Positive, Whole, checked, option_types
from ipe_bench.cli.chosen import Chosen
from ipe_bench.plugins.construct import find_class
from ipe_bench.plugins.discovery import Option

_SWEPT: dict[str, Any] = {"error_scale": Positive, "seed": Whole, "trials": Count, "block_size": Count}
"""Keys of numbers; one by one they are checked where the config is assembled."""


def check_options(words: Sequence[str], overrides: Sequence[Override]) -> None:
    """Refuses an option that none of what is chosen has, or a value that none of them takes.

    Raises:
        UserError: by its key.
    """
    chosen = Chosen(words)
    if not chosen.certain:
        return
    retyped = {o.key_or_group.rpartition(".")[0] for o in overrides if o.key_or_group.endswith("._target_")}
    for override in overrides:
        place, _, name = override.key_or_group.rpartition(".")
        options = chosen.at(place) if place and place not in retyped else []
        if options and override.package is None and not name.startswith("_") and not override.is_delete():
            _check(place, name, _values(override), options)
        elif override.key_or_group in _SWEPT and override.is_sweep_override():
            for value in _values(override):
                checked(value, _SWEPT[override.key_or_group], override.key_or_group)


def _values(override: Override) -> list[Any]:
    """Each value, those of a sweep one by one; none of patterns, ranges, and what other keys say."""
    given = override._value
    if isinstance(given, RangeSweep | Glob | IntervalSweep):
        return []
    listed = given.list if isinstance(given, ChoiceSweep) else [given]
    return [value for value in map(_plain, listed) if not isinstance(value, Mapping) and "${" not in str(value)]


def _plain(value: Any) -> Any:
    if isinstance(value, list):
        return [_plain(entry) for entry in value]
    return value.text if isinstance(value, QuotedString) else value


def _check(place: str, name: str, values: Sequence[Any], options: Sequence[Option]) -> None:
    """One key against the classes of what may stand there; one that suits any of them is left to Hydra."""
    types = [found for option in options if (found := _types(option)) is not None]
    hints = [found[name] for found in types if name in found]
    if types and not hints:
        raise UserError(f"{place}.{name}: {unknown(name, types[0], 'option')}")
    for value in values if len(types) == len(options) else ():
        refused = [error for hint in hints if (error := _refusal(value, hint, f"{place}.{name}")) is not None]
        if refused and len(refused) == len(hints):
            raise refused[0]


def _refusal(value: Any, hint: Any, key: str) -> UserError | None:
    try:
        checked(value, hint, key)
    except UserError as error:
        return error
    return None


def _types(option: Option) -> dict[str, Any] | None:
    """By name, the types of an option's keys; None where its class cannot be made, which is told later."""
    try:
        return None if option.target is None else option_types(find_class(option.target, option.name))
    except UserError:
        return None
