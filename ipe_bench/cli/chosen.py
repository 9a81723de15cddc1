"""Which options stand where in a config, as far as the words of a command tell it before Hydra composes anything."""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import yaml

from ipe_bench.plugins import discovery as plugins
from ipe_bench.plugins.annotations import choices, stated

NIST = "nist/"
"""Before the name of a data set: measurement=nist/misra1a."""
SINGLE = ("measurement", "noise", "prior", "execution")
"""Groups of which one option is chosen."""


class Chosen:
    """What the words KEY=VALUE choose, or their experiment, or our config where neither says anything."""

    def __init__(self, words: Sequence[str]) -> None:
        self.words = [word.lstrip("+") for word in words if not word.startswith(("-", "~"))]

    def at(self, place: str) -> list[plugins.Option]:
        """The options that may stand at `measurement` or `estimators.newton`: several where a sweep names them."""
        if place in (*SINGLE, "truth_measurement"):
            group = "measurement" if place == "truth_measurement" else place
            found = (option_of(group, name) for name in self._names(place))
            return [option for option in found if option is not None]
        head, _, label = place.partition(".")
        return self.estimators().get(label, []) if head == "estimators" else []

    def estimators(self) -> dict[str, list[plugins.Option]]:
        """Those that are chosen, by label."""
        found: dict[str, list[plugins.Option]] = {}
        for group in plugins.ESTIMATOR_GROUPS:
            chosen: Any = self._defaults().get(group) or ()
            for name, value in self._pairs():
                if name == group:
                    chosen = [part for part in re.split(r"[\[\],'\" ]+", value) if part]
                elif name.startswith(f"{group}@estimators."):
                    options = [option_of(group, part) for part in value.split(",")]
                    found[name.partition(".")[2]] = [option for option in options if option is not None]
            options = (option_of(group, str(name)) for name in chosen)
            found |= {option.label: [option] for option in options if option is not None}
        return found

    def options(self, place: str) -> dict[str, Any]:
        """What the words say of the options at that place: PLACE.KEY=VALUE, PLACE.file=FILE, measurement=nist/NAME.

        Raises:
            OSError, ValueError, YAMLError: the file cannot be read.
        """
        found: dict[str, Any] = {}
        for key, value in self._pairs():
            if key == place and value.startswith(NIST):
                found["dataset"] = next((n for n in datasets() if n.lower() == value[len(NIST) :].lower()), None)
            elif key == f"{place}.file":
                found |= plugins.read_yaml(Path(value).read_text(encoding="utf-8"))
            elif key.startswith(f"{place}."):
                *heads, last = key.split(".")[1:]
                inner = found
                for head in heads:
                    inner = inner.setdefault(head, {})
                inner[last] = _plain(value)
        return found

    @functools.cached_property
    def certain(self) -> bool:
        """Whether nothing else chooses: an experiment that is not known here, or one that is made of others."""
        for name, value in self._pairs():
            if name == "experiment":
                option = option_of("experiment", value)
                config = {} if option is None else option.config
                entries = config.get("defaults") or ()
                plain = all(isinstance(e, dict) and all(str(k).startswith("override ") for k in e) for e in entries)
                if option is None or not plain or "_target_" in str(config):
                    return False
        return True

    def _pairs(self) -> Iterator[tuple[str, str]]:
        return ((name, value) for name, _, value in (word.partition("=") for word in self.words))

    def _names(self, place: str) -> list[str]:
        for name, value in reversed(list(self._pairs())):
            if name in (place, f"measurement@{place}"):
                return [part.partition("/")[0] for part in value.split(",")]
        chosen = self._defaults().get(place)
        return [] if chosen is None else [str(chosen)]

    def _defaults(self) -> dict[str, Any]:
        """What each group is unless the words say so."""
        chosen = _defaults_of(plugins.own_conf() / "config.yaml")
        for name, value in self._pairs():
            option = option_of("experiment", value) if name == "experiment" else None
            chosen |= {} if option is None else _defaults_of(option.path)
        return chosen


def _plain(value: str) -> Any:
    """A value as its text means it; a formula is a text."""
    try:
        return plugins.read_yaml(value)
    except yaml.YAMLError:
        return value


def datasets() -> list[str]:
    """The names that may stand behind measurement=nist/, in NIST's spelling."""
    option = option_of("measurement", "nist")
    return [] if option is None or option.target is None else choices(stated(option.target)["dataset"])


def option_of(group: str, name: str) -> plugins.Option | None:
    """The option of that name, where there is one that can be used."""
    found = (option for option in plugins.options(group) if option.name == name)
    return next((option for option in found if option.fault is None), None)


def _defaults_of(path: Path) -> dict[str, Any]:
    """The choices in a config's list of defaults, by place."""
    entries = plugins.Option("", "", path, plugins.Source("", path, "")).config.get("defaults") or ()
    pairs = (pair for entry in entries if isinstance(entry, dict) for pair in entry.items())
    return {str(key).removeprefix("override ").lstrip("/").rpartition("@")[2]: value for key, value in pairs}
