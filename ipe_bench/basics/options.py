"""What the options of a component may be: a constraint stands in the field's type, and `Component`
reads it.

Types that options share have a name here; a constraint of one option stands in its class, as
`Annotated[float, Gt(1)]` with the words of annotated-types. Where in a config an option stands is
left to `plugins.construct`.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import math
import numbers
import operator
import re
import sys
import types
import typing
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from annotated_types import BaseMetadata, Ge, GroupedMetadata, Gt, Le, Lt, MinLen, Predicate

from ipe_bench.basics.errors import UserError, describe_exception, shortened, unknown

FINITE = Predicate(math.isfinite)

Finite = Annotated[float, FINITE]
Positive = Annotated[float, Gt(0), FINITE]
NonNegative = Annotated[float, Ge(0), FINITE]
Share = Annotated[float, Ge(0), Le(1)]
Quantile = Annotated[float, Gt(0), Le(1)]
Count = Annotated[int, Gt(0)]
Whole = Annotated[int, Ge(0)]

_COMPARISONS = {
    Gt: operator.gt,
    Ge: operator.ge,
    Lt: operator.lt,
    Le: operator.le,
    MinLen: lambda value, length: len(value) >= length,
    Predicate: lambda value, holds: holds(value),
}
"""Test of a value by each constraint, given the constraint's own number or function."""
_BOUNDED = {
    (): "{}",
    (Gt,): "{} above {}",
    (Ge,): "{} from {} up",
    (Lt,): "{} below {}",
    (Le,): "{} up to {}",
    (Gt, Lt): "{} between {} and {}",
    (Gt, Le): "{} above {} and up to {}",
    (Ge, Lt): "{} from {} to below {}",
    (Ge, Le): "{} from {} to {}",
    (MinLen,): "{} of at least {}",
}
_WITH_UNIT = re.compile(r"[-+]?(\d+\.?\d*|\.\d+) ?(?P<unit>[^\W\d_]{1,3}|%)")
"""A number with its unit."""
_NOUNS = {
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    str: "a text",
    type(None): "null",
    Sequence: "a list",
}


def as_python(value: Any) -> str:
    """Writes a component as Python with the options that are not the defaults, shortened to a line,
    or any value."""
    if not isinstance(value, Component) or not dataclasses.is_dataclass(value):
        return shortened(repr(value))
    own = []
    for field in dataclasses.fields(value):
        if not field.init:
            continue
        option = getattr(value, field.name)
        if repr(option) != repr(_default(field)):
            own.append(f"{field.name}={as_python(option)}")
    return shortened(f"{type(value).__name__}({', '.join(own)})")


def _default(field: dataclasses.Field[Any]) -> Any:
    make = field.default_factory
    return field.default if make is dataclasses.MISSING else make()


def in_lines(self: Any) -> str:
    """Writes a dataclass with a line for each field that is not None."""
    lines = []
    for field in dataclasses.fields(self):
        value = getattr(self, field.name)
        if value is not None:
            lines.append(f"    {field.name}={as_python(value)},\n")
    return f"{type(self).__name__}(\n{''.join(lines)})"


class Entries(dict[str, Any]):
    """Holds the entries of an option, which is part of an identity and is not changed in place."""

    def _refuse(self, *_: Any, **__: Any) -> typing.NoReturn:
        raise UserError(
            "the entries of an option are not changed in place; make another component, as in"
            " dataclasses.replace(model, constants={...})"
        )

    __setitem__ = __delitem__ = __ior__ = _refuse  # type: ignore[assignment]
    update = setdefault = pop = popitem = clear = _refuse  # type: ignore[assignment]

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (dict(self),)


class Component:
    """Describes a component by a config: a frozen dataclass whose fields are its options and its
    identity.

    A class whose options must suit one another writes `__post_init__` and calls this one first.
    """

    name: ClassVar[str] = ""
    """Its name in tables: the name of the class in small letters with underscores, unless the class
    states one."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        states_name = "name" in {*cls.__dict__, *cls.__annotations__}
        if not states_name and not isinstance(cls.name, property):
            cls.name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", cls.__name__).lower()

    def __new__(cls, *_: Any, **options: Any) -> Self:
        """Refuses an option that the class does not have, with those that it has."""
        takes = inspect.signature(cls.__init__).parameters
        if not any(one.kind is one.VAR_KEYWORD for one in takes.values()):
            for name in options.keys() - takes.keys():
                known = takes.keys() - {"self"}
                raise UserError(f"{cls.__name__}: {name}=: {unknown(name, known, 'option')}")
        return super().__new__(cls)

    def __post_init__(self) -> None:
        """Checks each option by its type, and keeps it as that type has it: 1 as 1.0, a list as a
        tuple, a dictionary as `Entries` of its own.

        Raises:
            UserError: `KEY=VALUE: give ...`, by the option's name.
        """
        for name, hint in option_types(type(self)).items():
            value = getattr(self, name)
            suited = checked(value, hint, name)
            if suited is not value:
                object.__setattr__(self, name, suited)


def component_classes(component: Any) -> list[Any]:
    """Collects the classes of a component and its components, with bases and the functions that
    they compute with."""
    if isinstance(component, tuple | list):
        return [cls for item in component for cls in component_classes(item)]
    if not dataclasses.is_dataclass(component) or isinstance(component, type):
        return []
    found: list[Any] = [cls for cls in type(component).__mro__ if not _is_of_python(cls)]
    found += getattr(component, "functions", ())
    for field in dataclasses.fields(component):
        found += component_classes(getattr(component, field.name))
    return found


def _is_of_python(cls: type) -> bool:
    """Tells whether a class is one of Python's own, such as ABC; a class that `type` or
    `make_dataclass` makes of a base says that it is of the module abc, too."""
    own = cls.__module__ in ("builtins", "abc", "typing")
    return own and getattr(sys.modules[cls.__module__], cls.__name__, None) is cls


@functools.cache
def option_types(cls: type) -> dict[str, Any]:
    """Returns the types, constraints included, of what the constructor of a dataclass takes.

    Raises:
        UserError: one of them cannot be read.
    """
    try:
        hints = typing.get_type_hints(cls, include_extras=True)
    except Exception as error:
        raise UserError(
            f"{cls.__module__}.{cls.__qualname__}: the type of an option cannot be read"
            f" ({describe_exception(error)}); its module must import it outside of TYPE_CHECKING"
        ) from None
    return {f.name: hints[f.name] for f in dataclasses.fields(cls) if f.init}  # type: ignore[arg-type]


def checked(value: Any, hint: Any, key: str) -> Any:
    """Checks a value and converts it where the type allows (1 for 1.0, a list for a tuple).

    Raises:
        UserError: `KEY=VALUE: give ...`, where the value is not of the type or not within its
            constraints.
    """
    origin = typing.get_origin(hint)
    arguments = typing.get_args(hint)
    if hint is Any or isinstance(hint, typing.TypeVar):
        return value
    # NumPy's numbers, truths and texts are as good as Python's.
    if isinstance(value, np.generic) or (isinstance(value, np.ndarray) and value.ndim == 0):
        value = value.item()
    if origin is Annotated:
        return _constrained(value, arguments[0], arguments[1:], key)
    if origin in (typing.Union, types.UnionType):
        return _one_of(value, arguments, key)
    if origin is typing.Literal:
        return _choice(value, arguments, key)
    if origin is tuple and isinstance(value, tuple | list | np.ndarray):
        return _entries(value, arguments, key)
    plain = origin or hint
    if not isinstance(plain, type):
        return value
    if issubclass(plain, Mapping) and isinstance(value, Mapping) and arguments:
        inner = arguments[1]
        entries = {name: checked(entry, inner, f"{key}.{name}") for name, entry in value.items()}
        return Entries(entries)
    # True and false are not numbers; NumPy's are.
    abstract = {int: numbers.Integral, float: numbers.Real}.get(plain)
    if abstract and isinstance(value, abstract) and not isinstance(value, bool):
        try:
            return value if type(value) is plain else typing.cast(Any, plain)(value)
        except OverflowError:  # a whole number beyond every float
            raise _refusal(value, describe_type(hint), key) from None
    if plain is Sequence and isinstance(value, list | np.ndarray):
        return tuple(value.tolist() if isinstance(value, np.ndarray) else value)
    is_text = plain is Sequence and isinstance(value, str | bytes)
    if isinstance(value, plain) and not abstract and not is_text:
        return value
    raise _refusal(value, describe_type(hint), key)


def _refusal(value: Any, wanted: str, key: str) -> UserError:
    shown = list(value) if isinstance(value, tuple) else value
    text = " ".join(str(shown).split())
    measured = _WITH_UNIT.fullmatch(text)
    first = f"leave {measured['unit']} out, and " if measured else ""
    return UserError(f"{key}={shortened(text, 60)}: {first}give {wanted}")


def _constrained(value: Any, kind: Any, metadata: Sequence[Any], key: str) -> Any:
    try:
        value = checked(value, kind, key)
        if all(_holds(bound, value) for bound in _bounds(metadata)):
            return value
    except UserError:
        if typing.get_origin(kind) is tuple:
            raise  # it says which entry is wrong
    raise _refusal(value, describe_type(Annotated[kind, *metadata]), key)


def _holds(bound: Any, value: Any) -> bool:
    limit = dataclasses.astuple(bound)[0]
    return _COMPARISONS[type(bound)](value, limit)


def _bounds(metadata: Sequence[Any]) -> list[Any]:
    """Returns the constraints among an annotation's metadata."""
    bounds: list[Any] = []
    for item in metadata:
        # Interval and Len are made of others.
        if isinstance(item, GroupedMetadata):
            bounds += _bounds(list(item))
        if isinstance(item, BaseMetadata):
            bounds.append(item)
    for bound in bounds:
        if type(bound) not in _COMPARISONS:
            raise TypeError(f"{bound}: is a constraint that options cannot have; write a Predicate")
    return bounds


def _one_of(value: Any, alternatives: Sequence[Any], key: str) -> Any:
    if isinstance(value, tuple | list | np.ndarray):
        tuples = [a for a in alternatives if _is_tuple(a)]
        if len(tuples) == 1:  # what is wrong with an entry is said of the entry
            return checked(value, tuples[0], key)
    options = [a for a in alternatives if a is not type(None)]
    if value is None and len(options) < len(alternatives):
        return None
    for alternative in options:
        try:
            return checked(value, alternative, key)
        except UserError as error:
            if len(alternatives) == 2 and len(options) == 1:
                raise UserError(f"{error} or null") from None
    raise _refusal(value, " or ".join(map(describe_type, alternatives)), key)


def _is_tuple(hint: Any) -> bool:
    if typing.get_origin(hint) is Annotated:
        hint = typing.get_args(hint)[0]
    return typing.get_origin(hint) is tuple


def _choice(value: Any, choices: Sequence[Any], key: str) -> Any:
    for choice in choices:
        if not isinstance(value, type(choice)):
            continue
        # True is a whole number, too.
        alike = isinstance(value, bool) == isinstance(choice, bool)
        if alike and value == choice:
            return choice
    text = " ".join(str(value).split())
    raise UserError(f"{key}={text}: choose one of {', '.join(map(str, choices))}")


def _entries(value: Any, arguments: Sequence[Any], key: str) -> tuple[Any, ...]:
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        arguments = [arguments[0]] * len(value)
    if len(arguments) != len(value):
        raise _refusal(value, _list_of(arguments), key)
    entries = []
    for i, (entry, hint) in enumerate(zip(value, arguments, strict=True)):
        entries.append(checked(entry, hint, f"{key}[{i}]"))
    return tuple(entries)


def describe_type(hint: Any) -> str:
    """Describes the values that an option takes: 'a number above 0 or null'."""
    origin = typing.get_origin(hint)
    arguments = typing.get_args(hint)
    if origin is Annotated:
        bounds = [bound for bound in _bounds(arguments[1:]) if not isinstance(bound, Predicate)]
        noun = (
            "a finite number" if FINITE in arguments and not bounds else describe_type(arguments[0])
        )
        limits = [dataclasses.astuple(bound)[0] for bound in bounds]
        kinds = tuple(map(type, bounds))
        if kinds in _BOUNDED:
            return _BOUNDED[kinds].format(noun, *limits)
        each = [_BOUNDED[kind,].format("", end) for kind, end in zip(kinds, limits, strict=True)]
        return noun + " and".join(each)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(map(describe_type, arguments))
    if origin is typing.Literal:
        return f"one of {', '.join(map(str, arguments))}"
    if origin is tuple:
        return _list_of(arguments)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return "keys and values"
    plain = origin or hint
    return _NOUNS.get(plain) or f"a {getattr(plain, '__name__', plain)}"


def _list_of(arguments: Sequence[Any]) -> str:
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        return "a list"
    nouns = {describe_type(a).removeprefix("a ") for a in arguments}
    each = f" {nouns.pop()}s" if len(nouns) == 1 else ""
    return f"a list of {len(arguments)}{each}"
