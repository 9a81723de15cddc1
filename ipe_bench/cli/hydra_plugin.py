"""Lets every application of Hydra find our configs, and compose `measurement: gins` or `solver: [newton]`.

Nothing of ours imports this module: an installation has it as `hydra_plugins.ipe_bench_configs` (pyproject.toml says
so), where Hydra looks for its plugins and makes one of every class.
"""

from __future__ import annotations

from hydra.core.config_search_path import ConfigSearchPath
from hydra.plugins.search_path_plugin import SearchPathPlugin

from ipe_bench.cli.search_path import extend
from ipe_bench.plugins import discovery


class InstalledConfigs(SearchPathPlugin):
    """Our configs and those of installed plugins, behind the application's own."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        extend(search_path, discovery.installed_sources())
