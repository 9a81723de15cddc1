"""Checks a component, or all that the plugin in a folder offers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ipe_bench.plugins.discovery import RECORD_GROUPS, added_for_now, options_in
from ipe_bench.workshop.conformance import Finding, check_component, check_option, left_of_skeleton
from ipe_bench.workshop.records import check_records


def findings(component: Any) -> list[Finding]:
    """Returns a finding per check of a component, or of each option of the plugin in a folder."""
    if not isinstance(component, Path | str):
        name = getattr(component, "name", type(component).__name__)
        return list(check_component(name, component))
    # The statistics of a plugin that is checked do not stand in the reports that this process
    # writes later.
    with added_for_now():
        chosen = options_in(Path(component))
        parts = [option for option in chosen if option.group not in RECORD_GROUPS]
        records = [option for option in chosen if option.group in RECORD_GROUPS]
        found = [finding for option in parts for finding in check_option(option)]
        return [*found, *check_records(records), *left_of_skeleton(chosen)]
