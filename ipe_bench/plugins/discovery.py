"""Finds plugins: installed distributions, and the folders `plugins/*/` of the working folder.

A plugin is a Python package with a `conf` folder inside that mirrors the groups of ours. Installed
plugins state the package in the entry-point group `ipe_bench.plugins`; a plugin in a folder needs
only its package with an `__init__.py`.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib.metadata
import importlib.util
import itertools
import os
import re
import sys
import tomllib
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from ipe_bench.basics.errors import UserError, describe_exception, unknown
from ipe_bench.basics.files import own_conf, regular

ENTRY_POINTS = "ipe_bench.plugins"
ESTIMATOR_GROUPS = ("solver", "baseline")
PACKAGES = {**dict.fromkeys(ESTIMATOR_GROUPS, "estimators"), "tracker": "trackers"}
"""Groups of which several options are chosen, each under its own label, by the key that holds
them."""
COMPONENT_GROUPS = (
    "measurement",
    "noise",
    "prior",
    *ESTIMATOR_GROUPS,
    "state_model",
    "tracker",
    "execution",
)
RECORD_GROUPS = ("statistic", "figure", "table", "section")
"""Config groups of the elements of a report."""
CHECKED_GROUPS = (*COMPONENT_GROUPS, *RECORD_GROUPS, "experiment")
CONTRACTS = {
    "solver": ("ipe_bench.IPE",),
    "baseline": ("ipe_bench.Estimator",),
    "filter": (
        "ipe_bench.Sequential",
        "ipe_bench.ConstantFilter",
        "ipe_bench.baselines.FilterpyFilter",
    ),
    "measurement": ("ipe_bench.Measurement", "ipe_bench.OdeMeasurement"),
    "state_model": ("ipe_bench.states.StateModel",),
    "tracker": ("ipe_bench.states.Tracker",),
    "noise": ("ipe_bench.Noise",),
    "prior": ("ipe_bench.priors.Prior",),
    "execution": ("ipe_bench.runs.execution.Execution",),
    "statistic": ("ipe_bench.statistics.records.Statistic",),
    "figure": ("ipe_bench.report.figures.views.Figure",),
    "table": ("ipe_bench.report.tables.Table",),
    "section": ("ipe_bench.report.sections.Section",),
}
"""The classes by which a plugin of each kind is written: their docstrings say what is required,
optional, promised."""
_TARGET_LINE = re.compile(r"^_target_:\s*['\"]?([\w.]+)", re.MULTILINE)
_PACKAGE_HEADER = re.compile(r"^#\s*@package\s+(\S+)", re.MULTILINE)
_COMMENT_BEHIND = re.compile(r"^(\w+):.*? # *(.+)$", re.MULTILINE)


class _Loader(yaml.SafeLoader):
    """Reads 1e-6 as a number, as Hydra does; YAML 1.1 wants 1.0e-6. Of a key that stands twice one
    value would be lost, and an alias hides what a short file stands for: both are refused."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            mark = self.peek_event().start_mark
            raise yaml.MarkedYAMLError(
                problem="an alias (*NAME); write out what is meant", problem_mark=mark
            )
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        known: set[str] = set()
        for key in (key for key, _ in node.value if isinstance(key.value, str)):
            if key.value in known:
                raise yaml.MarkedYAMLError(
                    problem=f"the key {key.value} is there twice", problem_mark=key.start_mark
                )
            known.add(key.value)
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?\d[\d_]*(\.\d*)?[eE][-+]?\d+$"),
    list("-+0123456789"),
)


def read_yaml(text: str) -> Any:
    """Reads YAML as plain data, with numbers as Hydra reads them."""
    try:
        return yaml.load(text, _Loader)
    except RecursionError:
        raise yaml.YAMLError("it is nested too deeply") from None
    except ValueError as error:  # a control character, or a number that is none
        raise yaml.YAMLError(describe_exception(error)) from None


def read_yaml_file(path: Path, key: str) -> Any:
    """Reads a file of YAML; `key` is the word of the command that names it."""
    try:
        return read_yaml(regular(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(
            f"{key}: cannot be read ({error.__class__.__name__}); name a YAML file"
        ) from None
    except yaml.YAMLError as error:
        told = explain_yaml(error, path)
        raise UserError(told if key == str(path) else f"{key}: {told}") from None


def explain_yaml(error: Any, path: Path | None = None) -> str:
    """Explains a YAML error in one line: the file, the line and what is wrong."""
    mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
    where = str(path or getattr(mark, "name", "config"))
    if mark is not None:
        where += f", line {mark.line + 1}"
    what = (
        getattr(error, "problem", None)
        or getattr(error, "reason", None)
        or describe_exception(error)
    )
    return f"{where}: is not YAML that can be read ({what})"


@dataclass(frozen=True)
class Source:
    """Describes a source of options: ipe-bench itself or a plugin."""

    name: str
    conf: Path
    origin: str
    """For people: the distribution or the folder."""
    distribution: str | None = None
    """The name of the distribution, without case and punctuation, if it states one."""


@dataclass(frozen=True)
class Option:
    """Describes one choice in a config group."""

    group: str
    name: str
    path: Path
    source: Source
    rival: Path | None = None
    """The file of another option that would run in its place, or it in place of that."""

    @property
    def label(self) -> str:
        """Label of an estimator in tables."""
        return Path(self.name).name

    @functools.cached_property
    def text(self) -> str:
        """Text of the file; characters that are not UTF-8 are replaced, and reported by `fault`."""
        return self.path.read_text(encoding="utf-8", errors="replace")

    @property
    def summary(self) -> str:
        """The first line of comment in the file that is not a header."""
        for line in self.text.splitlines():
            if line.startswith("#") and not _PACKAGE_HEADER.match(line):
                return line.lstrip("# ").strip()
        return ""

    @functools.cached_property
    def config(self) -> Any:
        """Content of the file, as plain data."""
        return read_yaml(self.text)

    @property
    def package(self) -> str | None:
        """Package in the config that the option lands in, if its header says so."""
        found = _PACKAGE_HEADER.search(self.text)
        return None if found is None else found[1]

    @property
    def target(self) -> str | None:
        """The class that it names."""
        found = _TARGET_LINE.search(self.text)
        return None if found is None else found[1]

    @property
    def comments(self) -> dict[str, str]:
        """Comment at the end of each key's line, by key."""
        return dict(_COMMENT_BEHIND.findall(self.text))

    @functools.cached_property
    def fault(self) -> str | None:
        """Why it cannot be used, in a line with the remedy; None where it can, as far as the file
        tells."""
        if self.rival is not None:
            return f"{self.rival} and {self.path} offer it both; rename one of the two files"
        if "\ufffd" in self.text:
            return f"{self.path}: is not UTF-8; save it as UTF-8"
        key = PACKAGES.get(self.group)
        if key is not None and self.package != f"{key}.{self.label}":
            return (
                f"{self.path}: its first line must be '# @package {key}.{self.label}', or it never"
                " runs"
            )
        try:
            config = self.config
        except yaml.YAMLError as error:
            return explain_yaml(error, self.path)
        if not isinstance(config, dict):
            return f"{self.path}: has no keys; write KEY: VALUE lines"
        return None


packages = {"ipe_bench"}
"""Top-level packages whose classes are constructed from configs."""
_added: dict[Path, None] = {}
"""Folders of plugins besides those in `plugins/`."""
_problems: dict[str, None] = {}


def take_problems() -> list[str]:
    """Returns what cannot be used of the plugins that were found, each in a line and once; the rest
    is used."""
    sources()
    taken = list(_problems)
    _problems.clear()
    return taken


@functools.cache
def sources() -> tuple[Source, ...]:
    """Returns our source, then the installed plugins, then the folders `plugins/*/`; their packages
    become importable.

    A plugin that is installed and lies in a folder as well is the folder's: its author edits what
    runs.
    """
    found: dict[str, Source] = {}
    folders = sorted(Path("plugins").resolve().iterdir()) if Path("plugins").is_dir() else []
    for source in installed_sources():
        _take(found, source)
    installed = dict(found)
    in_folders = map(_in_folder, dict.fromkeys([*folders, *_added]))
    for source in itertools.chain.from_iterable(in_folders):
        twin = installed.pop(source.name, None)
        one = twin is not None and twin.distribution == source.distribution is not None
        if one and not _imported_elsewhere(source):
            found[source.name] = source
            _make_importable(source, before=twin)
        elif _take(found, source):
            _make_importable(source)
    return tuple(found.values())


def _take(found: dict[str, Source], source: Source) -> bool:
    """Tells whether a source is added; a present one of its name is kept, and this one named as a
    problem."""
    known = found.setdefault(source.name, source)
    if known.conf.resolve() != source.conf.resolve():
        home = source.conf.parent
        other = known.conf.parent
        _problems[f"plugin {home}: {other} is called {source.name} too; it is left out"] = None
    return known is source


def _imported_elsewhere(source: Source) -> bool:
    """Tells whether this process has imported the package from another place, which is what runs
    then."""
    file = getattr(sys.modules.get(source.name), "__file__", None)
    return file is not None and Path(file).resolve().parent != source.conf.parent.resolve()


def _make_importable(source: Source, before: Source | None = None) -> None:
    """Puts a plugin's folder on the import path of this process and of the workers that it starts,
    at its end or before the place of another source."""
    path = str(source.conf.parents[1])
    other = None if before is None else str(before.conf.parents[1])

    def placed(paths: list[str]) -> list[str]:
        at = paths.index(other) if other in paths else len(paths)
        if path in paths[: at + 1]:
            return paths
        return [*paths[:at], path, *paths[at:]]

    sys.path[:] = placed(sys.path)
    inherited = filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))
    os.environ["PYTHONPATH"] = os.pathsep.join(dict.fromkeys(placed(list(inherited))))


def installed_sources() -> list[Source]:
    """Lists ours, then the installed plugins: the same in every folder."""
    found = [Source("ipe-bench", own_conf(), "built in")]
    for entry in importlib.metadata.entry_points(group=ENTRY_POINTS):
        reason = f"there is no package {entry.value}"
        try:
            spec = importlib.util.find_spec(entry.value)
        except Exception as error:  # its parent package is imported, which may raise anything
            spec = None
            reason = describe_exception(error)
        if spec is None or not spec.submodule_search_locations:
            _problems[f"plugin {entry.name}: {reason}; it is left out, install it again"] = None
            continue
        packages.add(entry.value.split(".")[0])
        origin = f"{entry.dist.name} {entry.dist.version}" if entry.dist else entry.name
        name = _normal(entry.dist.name) if entry.dist else None
        conf = Path(spec.submodule_search_locations[0]) / "conf"
        found.append(Source(entry.value, conf, origin, name))
    return found


def _in_folder(folder: Path) -> Iterator[Source]:
    for conf in sorted(folder.resolve().glob("*/conf")):
        home = conf.parent
        if not (home / "__init__.py").is_file():
            if any((conf / group).is_dir() for group in CHECKED_GROUPS):
                _problems[f"plugin {home}: has no __init__.py; it is left out, add one"] = None
            continue
        for path in sorted(conf.glob("*/**/*.yml")):
            _problems[f"{path}: is not read; name it {path.stem}.yaml"] = None
        packages.add(home.name)
        origin = f"{folder.parent.name}/{folder.name}"
        yield Source(home.name, conf, origin, _stated_name(folder))


def _stated_name(folder: Path) -> str | None:
    """Reads the name of the distribution that a folder's pyproject.toml describes."""
    try:
        stated = tomllib.loads((folder / "pyproject.toml").read_text(encoding="utf-8"))
    except (OSError, ValueError):  # none, or none that can be read
        return None
    project = stated.get("project")
    name = project.get("name") if isinstance(project, Mapping) else None
    return _normal(name) if isinstance(name, str) else None


def _normal(name: str) -> str:
    """Normalises names of distributions that differ in case or punctuation alone to one name."""
    return re.sub(r"[-_.]+", "-", name).lower()


def options(group: str | None = None) -> list[Option]:
    """Lists all options of a group, or of all groups; those that cannot be used have a `fault`."""
    found: dict[tuple[str, str], Option] = {}
    for source in sources():
        for path in sorted(source.conf.glob("*/**/*.yaml")):
            folder, *name = path.relative_to(source.conf).with_suffix("").parts
            option = Option(folder, "/".join(name), path, source)
            # Solvers and baselines share their labels: of two with one label, only one would run.
            place = (folder, option.name)
            if folder in ESTIMATOR_GROUPS:
                place = ("estimator", option.label)
            known = found.setdefault(place, option)
            if known is not option and known.rival is None:
                found[place] = dataclasses.replace(known, rival=path)
    return [o for o in found.values() if group is None or o.group == group]


def kinds_to_copy() -> dict[str, Path]:
    """The kinds of plugins that plugins add to `ipe-bench new`, with the folder that holds KIND and
    KIND-LANGUAGE."""
    return {
        path.name: path.parent
        for source in sources()[1:]
        for path in source.conf.parent.glob("new/*")
        if "-" not in path.name
    }


def composed(option: Option) -> dict[str, Any]:
    """Composes an option with the options of its group that its `defaults` name, as Hydra does:
    later ones replace what earlier ones say, and the file itself comes last unless `_self_` stands
    elsewhere.

    Raises:
        UserError: a file cannot be used, or `defaults` names no option, or one that names this one.
    """
    return _composed(option, ())


def _composed(option: Option, above: tuple[Path, ...]) -> dict[str, Any]:
    """Composes an option that the files `above` it name."""
    if option.path in above:
        raise UserError(f"{option.path}: defaults: names itself, or a file that names it")
    if option.fault is not None:
        raise UserError(option.fault)
    config = dict(option.config)
    given = config.pop("defaults", None) or []
    if not isinstance(given, list):
        raise UserError(f"{option.path}: defaults: is no list; write defaults: [{given}]")
    entries = [str(entry) for entry in given]
    known = {o.name: o for o in options(option.group)} if entries else {}
    found: dict[str, Any] = {}
    for entry in entries if "_self_" in entries else [*entries, "_self_"]:
        name = entry.removesuffix("@_here_").removeprefix(f"/{option.group}/")
        if entry != "_self_" and name not in known:
            raise UserError(
                f"{option.path}: defaults: {unknown(name, known, f'option of {option.group}')}"
            )
        other = config if entry == "_self_" else _composed(known[name], (*above, option.path))
        found = merged(found, other)
    return found


def merged(first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, Any]:
    """Merges both, the second in the place of the first but where both are mappings."""
    both = {
        k for k, v in second.items() if isinstance(v, Mapping) and isinstance(first.get(k), Mapping)
    }
    return {**first, **second, **{key: merged(first[key], second[key]) for key in both}}


def options_in(folder: Path) -> list[Option]:
    """Lists the options of a plugin's folder that can be checked, with those that they clash
    with."""
    if not folder.is_dir():
        beside = Path("plugins") / folder.name.rpartition("=")[2]
        meant = beside if beside.is_dir() else "a plugin's folder, such as plugins/my_plugin"
        raise UserError(f"{folder}: there is no such folder; give {meant}")
    home = folder.resolve()
    _added[home] = None
    sources.cache_clear()
    if not list(_in_folder(home)):
        raise UserError(f"{folder}: contains no package with a folder conf; see `ipe-bench new`")
    own = [o for o in options() if home in (*o.path.parents, *(o.rival.parents if o.rival else ()))]
    found = [option for option in own if option.group in CHECKED_GROUPS]
    if not found:
        raise UserError(
            f"{folder}: has no option to check; its conf has none of {', '.join(CHECKED_GROUPS)}"
        )
    return found


@contextmanager
def added_for_now() -> Iterator[None]:
    """Forgets at its end the plugins' folders that are added within it."""
    before = dict(_added)
    try:
        yield
    finally:
        _added.clear()
        _added.update(before)
        sources.cache_clear()


def groups() -> list[str]:
    """Lists the config groups that hold options."""
    return sorted({option.group for option in options()})


def blame(error: BaseException) -> str | None:
    """Finds the plugin whose code raised this, with file, line and message; None where no plugin's
    code was running."""
    homes = {str(source.conf.parent) + os.sep: source.origin for source in sources()[1:]}
    found = None
    for frame in traceback.extract_tb(error.__traceback__):
        for home, origin in homes.items():
            if frame.filename.startswith(home):
                found = (
                    f"plugin {origin}: {frame.filename}, line {frame.lineno}:"
                    f" {describe_exception(error)}"
                )
    return found
