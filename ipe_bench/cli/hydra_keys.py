"""Keeps what a config says to Hydra to a list: Hydra calls, imports and overwrites whatever else it
is told to, and an experiment may come from anywhere."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Any

from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from ipe_bench.basics.errors import UserError, shortened
from ipe_bench.cli import words as w


class Guarded(ConfigLoaderImpl):
    """Loads configs as Hydra does, and refuses one that says to Hydra what is not on the list.

    Every config comes from here: that of a command, those of its sweep's jobs, and those in a
    launcher's processes.
    """

    def load_configuration(
        self,
        config_name: str | None,
        overrides: list[str],
        run_mode: RunMode,
        from_shell: bool = True,
        validate_sweep_overrides: bool = True,
    ) -> DictConfig:
        config = super().load_configuration(
            config_name, overrides, run_mode, from_shell, validate_sweep_overrides
        )
        require_listed(config.hydra, overrides)
        return config


def _leaves(node: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Yields the values in a config, each with its key; empty lists and dictionaries are values,
    too."""
    items = (
        enumerate(node)
        if isinstance(node, list)
        else node.items()
        if isinstance(node, dict)
        else ()
    )
    if not items or not node:
        yield key, node
        return
    for name, value in items:
        yield from _leaves(value, f"{key}.{name}".lstrip("."))


_QUIET = {"version": 1, "root": None, "disable_existing_loggers": False}
_OURS: dict[str, Any] = {"callbacks": {}, "env": {}, "hydra_logging": _QUIET, "job_logging": _QUIET}
_OURS |= {"job": {"name": "ipe-bench", "chdir": False, "env_set": {}, "env_copy": []}}
_OURS |= {"output_subdir": ".hydra", "searchpath": []}
_PLAIN = dict(_leaves(_OURS))
"""Values of our own config, which stay."""
_TYPED = re.compile(r"(job|output_subdir|searchpath)\b.*")
"""Those of these keys that the command line may set."""
_WRITTEN = re.compile(
    r"(help|hydra_help|overrides|runtime|job\.(override_dirname|id|num|config_name|config))\b.*"
)
"""Keys that Hydra writes, or that only its own help shows."""
_FREE = re.compile(r"mode|(verbose|launcher|sweeper)\b.*|run\.dir|sweep\.(sub)?dir")
_LIST = "only mode, verbose, launcher, sweeper, run.dir and sweep.dir may be set here"

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


def require_listed(hydra: DictConfig, words: Sequence[str]) -> None:
    """Refuses a config of Hydra with a key or a value that is not on the list; `words` are those of
    the command line.

    It is judged before interpolations are resolved: until Hydra does so, what they stand for can
    change.
    """
    said: Any = OmegaConf.to_container(hydra, resolve=False)
    if not {*said["overrides"]["hydra"], *said["overrides"]["task"]} <= set(words):
        raise UserError(f"hydra.overrides: {_LIST}; remove it")
    typed = _typed(words)
    for key, value in _leaves(said):
        is_typed = key in typed and typed[key] == value
        if _FREE.fullmatch(key):
            _require_harmless(key, value, is_typed)
        elif _WRITTEN.fullmatch(key) or (key in _PLAIN and _PLAIN[key] == value):
            continue
        elif not _TYPED.fullmatch(key):
            raise _refusal(key, value, f"{_LIST}; remove it")
        elif not is_typed:
            raise _refusal(key, value, f"{_LIST}; remove it, or write it on the command line")


def _typed(words: Sequence[str]) -> dict[str, Any]:
    """Returns the values that the command line gives to keys of Hydra."""
    told = [word for word in words if word.lstrip("+").startswith("hydra.")]
    parsed = OverridesParser.create().parse_overrides(told)
    given = ((one.key_or_group.removeprefix("hydra."), w.plain(one.value())) for one in parsed)
    return {key: value for name, content in given for key, value in _leaves(content, name)}


def _require_harmless(key: str, value: Any, is_typed: bool) -> None:
    """Refuses what Hydra, a launcher or a sweeper would call, and interpolations that compute a
    value."""
    part, *names = key.split(".")
    if names[-1:] == ["_target_"]:
        if not _CLASS.fullmatch(str(value)):
            known = "only classes of Hydra, of launchers and of sweepers may be named here"
            raise _refusal(key, value, f"{known}; remove it, or write a plugin")
        return
    if is_typed:
        return
    if value and not _COMMANDS.isdisjoint(names):
        raise _refusal(key, value, "runs a function or a shell; write it on the command line")
    if "hydra" in re.split(r"\W+", ".".join(names)):
        raise _refusal(key, value, "a sweep cannot set keys of Hydra; remove it")
    known = _KEYS if part in ("run", "sweep") or names[:1] == ["params"] else _TEXTS
    if "${" in known.sub("", str(value)):
        raise _refusal(key, value, "computes a value; write the value itself")


def _refusal(key: str, value: Any, why: str) -> UserError:
    return UserError(f"hydra.{key}={shortened(str(value))}: {why}")
