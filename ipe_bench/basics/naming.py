"""Names: of a component in tables, taken from its class, and of what a package offers."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from types import ModuleType
from typing import Any, ClassVar

from ipe_bench.basics.errors import unknown


class Named:
    """Gives each subclass a `name`: its class name in small letters with underscores, unless it states one or inherits
    a property."""

    name: ClassVar[str] = ""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "name" not in cls.__dict__ and not isinstance(cls.name, property):
            cls.name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", cls.__name__).lower()


def without_modules(room: str, names: Sequence[str]) -> None:
    """Takes a package's modules off its attributes, so that `measurements.gins` is answered with the class `Gins`."""
    content = vars(sys.modules[room])
    for name in [name for name, thing in content.items() if isinstance(thing, ModuleType)]:
        del content[name]

    def missing(name: str) -> Any:
        raise AttributeError(f"{room}.{name}: {unknown(name, names, 'name')}")

    content["__getattr__"] = missing
