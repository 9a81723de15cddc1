"""Finds plugins: installed distributions, and the folders `plugins/*/` of the working folder.

A plugin is a Python package with a `conf` folder inside that mirrors the groups of ours. Installed plugins state the
package in the entry-point group `ipe_bench.plugins`; a plugin in a folder needs nothing but to be there.
"""

from __future__ import annotations

import functools
import importlib.metadata
import importlib.util
import os
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from ipe_bench.basics.errors import UserError
from ipe_bench.plugins.construct import construct, register_package

ENTRY_POINTS = "ipe_bench.plugins"
ESTIMATOR_GROUPS = ("solver", "baseline")
COMPONENT_GROUPS = ("measurement", "noise", "prior", *ESTIMATOR_GROUPS)
_PACKAGE_HEADER = re.compile(r"^#\s*@package\s+(\S+)", re.MULTILINE)


class _Loader(yaml.SafeLoader):
    """Takes 1e-6 for a number, as Hydra does; YAML 1.1 wants 1.0e-6."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?\d[\d_]*(\.\d*)?[eE][-+]?\d+$"), list("-+0123456789")
)


@dataclass(frozen=True)
class Source:
    """Where options come from: ipe-bench itself or a plugin."""

    name: str
    conf: Path
    origin: str
    """For people: the distribution or the folder."""


@dataclass(frozen=True)
class Option:
    """One choice in a config group."""

    group: str
    name: str
    path: Path
    source: Source

    @property
    def summary(self) -> str:
        """The first line of comment in the file that is not a header."""
        for line in self.path.read_text(encoding="utf-8").splitlines():
            if line.startswith("#") and not _PACKAGE_HEADER.match(line):
                return line.lstrip("# ").strip()
        return ""

    @property
    def config(self) -> Any:
        """What the file says, as plain data."""
        return yaml.load(self.path.read_text(encoding="utf-8"), _Loader)

    @property
    def package(self) -> str | None:
        """Where in the config the option lands, where its header says so."""
        found = _PACKAGE_HEADER.search(self.path.read_text(encoding="utf-8"))
        return found.group(1) if found else None


def own_conf() -> Path:
    """The folder of our configs: inside the installed package, or beside it in a checkout."""
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "conf", package.parent / "conf"):
        if (folder / "config.yaml").is_file():
            return folder
    raise FileNotFoundError("the configs of ipe-bench are neither in the package nor beside it; install it again")


_added: dict[Path, None] = {}
"""Folders of plugins besides those in `plugins/`."""


@functools.cache
def sources() -> tuple[Source, ...]:
    """Ours first, then the installed plugins, then the folders `plugins/*/`; their packages become importable."""
    plugins = Path("plugins")
    folders = sorted(plugins.resolve().iterdir()) if plugins.is_dir() else []
    found = [Source("ipe-bench", own_conf(), "built in"), *_installed()]
    for folder in dict.fromkeys([*folders, *_added]):
        found += _in_folder(folder)
    unique: dict[str, Source] = {}
    for source in found:
        # A plugin that is installed from its folder is found twice.
        unique.setdefault(source.name, source)
    return tuple(unique.values())


def add_folder(folder: Path) -> bool:
    """Makes the plugin in a folder known, wherever it is; False where there is none."""
    _added[folder.resolve()] = None
    sources.cache_clear()
    return bool(list(_in_folder(folder.resolve())))


def _installed() -> Iterator[Source]:
    for entry in importlib.metadata.entry_points(group=ENTRY_POINTS):
        spec = importlib.util.find_spec(entry.value)
        if spec is None or not spec.submodule_search_locations:
            raise UserError(f"plugin {entry.name}: there is no package {entry.value}; install the plugin again")
        register_package(entry.value.split(".")[0])
        version = f" {entry.dist.version}" if entry.dist else ""
        conf = Path(spec.submodule_search_locations[0]) / "conf"
        yield Source(entry.value, conf, f"{entry.dist.name if entry.dist else entry.name}{version}")


def _in_folder(folder: Path) -> Iterator[Source]:
    for conf in sorted(folder.glob("*/conf")):
        package = conf.parent.name
        if (conf.parent / "__init__.py").is_file():
            _make_importable(folder)
            register_package(package)
            yield Source(package, conf, f"{folder.parent.name}/{folder.name}")


def _make_importable(folder: Path) -> None:
    """Puts the folder on the import path of this process and of the workers it starts."""
    path = str(folder.resolve())
    if path not in sys.path:
        sys.path.append(path)
    inherited = [p for p in os.environ.get("PYTHONPATH", "").split(os.pathsep) if p]
    if path not in inherited:
        os.environ["PYTHONPATH"] = os.pathsep.join([*inherited, path])


def options(group: str | None = None) -> list[Option]:
    """All options of a group, or of all groups.

    Raises:
        UserError: two sources offer one option, of which the second would silently never run; or an estimator's file
            lacks the header that puts it among the estimators.
    """
    found: dict[tuple[str, str], Option] = {}
    labels: dict[str, Option] = {}
    for source in sources():
        for path in sorted(source.conf.rglob("*.yaml")):
            relative = path.relative_to(source.conf).with_suffix("")
            if len(relative.parts) < 2:
                continue
            option = Option(relative.parts[0], "/".join(relative.parts[1:]), path, source)
            known = found.setdefault((option.group, option.name), option)
            if known is not option:
                raise UserError(
                    f"{option.group}={option.name}: both {known.source.origin} and {source.origin} offer it; "
                    "rename one of the two files"
                )
            if option.group in ESTIMATOR_GROUPS:
                label = Path(option.name).name
                if option.package != f"estimators.{label}":
                    raise UserError(f"{path}: its first line must be '# @package estimators.{label}', or it never runs")
                if labels.setdefault(label, option) is not option:
                    raise UserError(
                        f"{path}: {labels[label].path} is called {label} too, and only one of them would run"
                    )
    return [o for o in found.values() if group is None or o.group == group]


def components_in(folder: Path) -> list[tuple[str, Any]]:
    """Every component that the options of a plugin's folder describe, constructed, with GROUP=NAME for a name.

    Raises:
        UserError: there is no plugin in the folder.
    """
    if not folder.is_dir():
        raise UserError(f"{folder}: there is no such folder")
    if not add_folder(folder):
        raise UserError(f"{folder}: holds no package with a folder conf in it; see `ipe-bench new`")
    return [
        (f"{o.group}={o.name}", construct(o.config, o.package or o.group))
        for o in options()
        if o.path.is_relative_to(folder.resolve()) and o.group in COMPONENT_GROUPS
    ]


def groups() -> list[str]:
    """The config groups that hold options."""
    return sorted({option.group for option in options()})
