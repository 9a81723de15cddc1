"""The name of a component in tables, taken from its class."""

from __future__ import annotations

import re
from typing import Any, ClassVar


class Named:
    """Gives each subclass a `name`: its class name in small letters with underscores, unless it states one or inherits
    a property."""

    name: ClassVar[str] = ""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "name" not in cls.__dict__ and not isinstance(cls.name, property):
            cls.name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", cls.__name__).lower()
