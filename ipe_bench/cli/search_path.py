"""Extends Hydra's search path by the configs of plugins, each folder once."""

from __future__ import annotations

from collections.abc import Iterable

from hydra.core.config_search_path import ConfigSearchPath

from ipe_bench.plugins.discovery import Source


def extend(search_path: ConfigSearchPath, sources: Iterable[Source]) -> None:
    """Adds the folders that are not yet searched."""
    for source in sources:
        searched = {(entry.path or "").removeprefix("file://") for entry in search_path.get_path()}
        if not searched & {str(source.conf), source.conf.as_uri().removeprefix("file://")}:
            search_path.append(source.name, source.conf.as_uri())
