"""Estimators and trackers of commands and calls that choose none: what `run` computes stands in
conf/config.yaml, what `estimate` takes in its place stands here."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import Any

from ipe_bench.basics.files import own_conf
from ipe_bench.plugins.construct import construct

OF_ESTIMATE = {"solver": ("auto",), "baseline": ("linear_lse", "levenberg_marquardt")}
"""Estimators of `estimate`, by group: one that chooses its method itself, and two to compare it
with."""
OF_FILTERS = {"tracker": ("ekf", "ukf")}
"""Trackers of `find=` and `gate=`: these need a likelihood or innovations, which an estimate of the
whole path does not have."""

OF_OWN = {
    "solver": ("auto", "newton"),
    "baseline": ("levenberg_marquardt", "multistart", "map_lm", "iterated_ekf", "iplf"),
    "tracker": ("auto", "ekf", "ukf", "ukf_rts"),
}
"""What `run` compares on data like a user's own: of constants four that take no prior, two of them
IPE, and three that do; the strongest of each family of stored experiments are among them."""


@functools.cache
def of_run(group: str) -> tuple[str, ...]:
    """Returns the options of a group that `run` computes."""
    entries = _read("config")["defaults"]
    (chosen,) = [one[group] for one in entries if isinstance(one, Mapping) and group in one]
    return tuple(chosen)


def constructed(choice: Mapping[str, Sequence[str]]) -> dict[str, Any]:
    """Constructs options of this package, which are chosen by group, by their names."""
    return {
        name: construct(_read(f"{group}/{name}"), f"{group}={name}")
        for group, names in choice.items()
        for name in names
    }


def _read(name: str) -> dict[str, Any]:
    import yaml

    return yaml.safe_load((own_conf() / f"{name}.yaml").read_text(encoding="utf-8"))
