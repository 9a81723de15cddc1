"""Lets every application of Hydra find our configs.

A built or editable installation has a copy of this module as `hydra_plugins.ipe_bench_configs`, where Hydra looks for
plugins of its own; so any application of Hydra can compose `measurement: gins` or `solver: [newton]`. Every search-path
plugin in this file is therefore one for every application.
"""

from __future__ import annotations

from collections.abc import Iterable

from hydra.core.config_search_path import ConfigSearchPath
from hydra.plugins.search_path_plugin import SearchPathPlugin

from ipe_bench.plugins import discovery


class InstalledConfigs(SearchPathPlugin):
    """For every application: our configs and those of installed plugins, behind its own."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        extend(search_path, discovery.installed_sources())


def extend(search_path: ConfigSearchPath, sources: Iterable[discovery.Source]) -> None:
    """Adds the folders that are not among those that are searched already."""
    for source in sources:
        searched = {(entry.path or "").removeprefix("file://") for entry in search_path.get_path()}
        if not searched & {str(source.conf), source.conf.as_uri().removeprefix("file://")}:
            search_path.append(source.name, source.conf.as_uri())
