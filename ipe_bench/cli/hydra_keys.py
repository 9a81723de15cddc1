"""Judges config files before Hydra merges them.

Hydra calls, imports and overwrites whatever a config tells it to. A person's words and the folders
that they name are trusted; of a plugin, which may come from anywhere, Hydra obeys a list.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import ConfigRepository, IConfigRepository
from hydra.conf import HydraConf
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.default_element import ResultDefault
from hydra.core.object_type import ObjectType
from hydra.plugins.config_source import ConfigResult
from omegaconf import OmegaConf

from ipe_bench.basics.errors import UserError, shortened
from ipe_bench.plugins.discovery import explain_yaml, sources

_MOST_NODES = 100_000
"""Values that a file may stand for."""


class Guarded(ConfigLoaderImpl):
    """Loads configs as Hydra does, and refuses a file that tells Hydra more than its source may.

    Every config comes from here: that of a command, those of its sweep's jobs, and those in a
    launcher's processes.
    """

    def __init__(self, config_search_path: ConfigSearchPath) -> None:
        super().__init__(config_search_path)
        self.repository = _Repository(config_search_path)
        self.plugins = {source.name for source in sources()[1:]}

    def _load_single_config(self, default: ResultDefault, repo: IConfigRepository) -> ConfigResult:
        found = super()._load_single_config(default, repo)
        if found.provider in self.plugins:
            said: Any = OmegaConf.to_container(found.config, resolve=False)
            if "hydra" in said:
                require_listed(said["hydra"], str(default.config_path))
        return found


class _Repository(ConfigRepository):
    """Finds configs as Hydra does; reads each file once before Hydra does."""

    def load_config(self, config_path: str) -> ConfigResult | None:
        source = self._find_object_source(config_path, ObjectType.CONFIG)
        if source is not None and source.scheme() == "file" and source.provider != "main":
            name = source._normalize_file_name(config_path)
            _require_readable(Path(source.path) / name)
        return super().load_config(config_path)


def _require_readable(path: Path) -> None:
    """Refuses a file that Hydra would misread, or not be done with, by its name."""
    content = path.read_bytes()
    if content.startswith(b"\xef\xbb\xbf"):
        raise UserError(f"{path}: begins with a byte order mark; save it as UTF-8 without one")
    try:
        root = yaml.compose(content.decode(), yaml.SafeLoader)
    except UnicodeDecodeError:
        raise UserError(f"{path}: is not UTF-8; save it as UTF-8") from None
    except RecursionError:
        raise UserError(f"{path}: is nested too deeply") from None
    except yaml.YAMLError as error:
        raise UserError(explain_yaml(error, path)) from None
    if _size(root, {}) > _MOST_NODES:
        raise UserError(f"{path}: expands to more than {_MOST_NODES} values; use fewer aliases")


def _size(node: yaml.Node | None, known: dict[yaml.Node, float]) -> float:
    """Counts the values that a node stands for, where aliases stand for what they repeat."""
    if not isinstance(node, yaml.CollectionNode):
        return 1
    if node not in known:
        known[node] = float("inf")  # of a node within itself
        children = node.value
        if isinstance(node, yaml.MappingNode):
            children = [value for _, value in node.value]
        known[node] = 1 + sum(_size(child, known) for child in children)
    return known[node]


def _leaves(node: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Yields the values in a config, each with its key; empty lists and dictionaries are values,
    too."""
    if not node or not isinstance(node, list | dict):
        yield key, node
        return
    items = enumerate(node) if isinstance(node, list) else node.items()
    for name, value in items:
        yield from _leaves(value, f"{key}.{name}".lstrip("."))


_FREE = re.compile(r"mode|(verbose|launcher|sweeper)\b.*|run\.dir|sweep\.(sub)?dir")
_LIST = "a plugin sets only mode, verbose, launcher, sweeper, run.dir and sweep.dir"
_CLASS = re.compile(
    r"hydra\._internal\.core_plugins\.\w+\.[A-Z]\w*|hydra_plugins\.(\w+\.){1,2}[A-Z]\w*"
    r"|optuna\.(samplers|pruners)\.[A-Z]\w*"
)
"""Classes of Hydra, of the launchers and sweepers that are installed, and those by which Optuna
chooses trials."""
_COMMANDS = {
    "_args_",
    "additional_parameters",
    "custom_search_space",
    "python",
    "setup",
    "srun_args",
}
"""Parameters of launchers and sweepers that name a function or hold lines of a shell."""
_OF_HYDRA = (
    r"\$\{hydra\.(job\.(name|num|id|override_dirname)|run\.dir|sweep\.(sub)?dir"
    r"|runtime\.(cwd|output_dir))\}"
)
_TEXTS = re.compile(_OF_HYDRA)
"""Interpolations that Hydra's own types keep texts."""
_KEYS = re.compile(rf"{_OF_HYDRA}|\$\{{[\w.]+\}}|\$\{{now:[^{{}}$]*\}}")
"""Interpolations of keys and of the time; others compute a value, as `oc.decode` makes a config of
a text."""


def require_listed(hydra: Any, name: str) -> None:
    """Refuses the part for Hydra of a plugin's config of that name, if it has a key or a value that
    is not on the list.

    It is judged before interpolations are resolved: until Hydra does so, what they stand for can
    change.
    """
    packaged = dict(_leaves(OmegaConf.to_container(OmegaConf.structured(HydraConf))))
    for key, value in _leaves(hydra):
        if key in packaged and packaged[key] == value:
            continue
        why = _harm(key, value) if _FREE.fullmatch(key) else _LIST
        if why:
            raise UserError(
                f"hydra{'.' * bool(key)}{key}={shortened(str(value))}: {why}; copy {name}.yaml into"
                " a folder that you name with --config-dir, or write this on the command line"
            )


def _harm(key: str, value: Any) -> str:
    """Says what Hydra, a launcher or a sweeper would call, or compute of an interpolation; empty if
    nothing."""
    part, *names = key.split(".")
    if names[-1:] == ["_target_"]:
        return "" if _CLASS.fullmatch(str(value)) else "is no class of a launcher or a sweeper"
    if value and not _COMMANDS.isdisjoint(names):
        return "runs a function or a shell"
    if "hydra" in re.split(r"\W+", ".".join(names)):
        return "a sweep cannot set keys of Hydra"
    known = _KEYS if part in ("run", "sweep") or names[:1] == ["params"] else _TEXTS
    return "computes a value" if "${" in known.sub("", str(value)) else ""
