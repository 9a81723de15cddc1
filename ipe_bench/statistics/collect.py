"""From what is stored to what is compared: which cells are one experiment, and what tells them from the others.

What is there, and what is wrong with it, `runs.results` says; what the numbers mean is left to `statistics.summary`.
"""

from __future__ import annotations

from collections.abc import Collection as Keys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ipe_bench.runs.parts import TRUTH
from ipe_bench.runs.provenance import TARGET, canonical_json, digest
from ipe_bench.runs.results import Results, Run, StoredCell

if TYPE_CHECKING:
    import pandas as pd

NAMES = ("measurement", "noise", "prior", "error_scale", "seed", "estimator")
_LONGEST = 34
"""Letters of a value in a table or a heading."""
ALWAYS_COLUMNS = ("measurement", "noise", "error_scale", "estimator")


@dataclass(frozen=True)
class Group:
    """The cells of one scenario and one estimator that differ in nothing but the seed."""

    columns: Mapping[str, Any]
    """What tells this group from the others: measurement, noise, every config leaf that differs, error_scale."""
    estimator: str
    """The estimator's label, with the options that differ where one label stands for several configs."""
    options: Mapping[str, Any]
    """Those options, as columns."""
    cells: tuple[tuple[StoredCell, StoredCell | None], ...]
    """Each seed's estimates with the truth that belongs to them."""

    @property
    def scenario(self) -> tuple[Any, ...]:
        return tuple(self.columns.values())

    @property
    def footer(self) -> Mapping[str, Any]:
        return self.cells[0][0].footer

    @property
    def label(self) -> str:
        return self.cells[0][0].label


@dataclass
class Collection(Results):
    """Everything usable under some directories, grouped; a line in `problems` or `stale` for everything that is not."""

    groups: tuple[Group, ...] = ()

    @property
    def scenarios(self) -> dict[tuple[Any, ...], list[Group]]:
        """The groups of each scenario, in order."""
        result: dict[tuple[Any, ...], list[Group]] = {}
        for group in self.groups:
            result.setdefault(group.scenario, []).append(group)
        return result

    @property
    def estimators(self) -> list[str]:
        """The labels of the estimators, in the order in which runs list them."""
        return list(dict.fromkeys(g.estimator for g in self.groups))


def collect(directories: Sequence[Path | str], keys: Keys[str] | None = None) -> Collection:
    """Finds what is stored under the directories, or of the cells with these keys alone.

    Raises:
        UserError: a directory does not exist.
    """
    collection = Collection.read(directories, keys)
    collection.groups = _groups(collection.current, collection.runs)
    return collection


def trials_frame(collection: Collection) -> pd.DataFrame:
    """Every usable trial: what it belongs to, what it came to, and the truth; see `ipe_bench.load`."""
    import pandas as pd

    parts = []
    for group in collection.groups:
        for cell, truth in group.cells:
            rows = pd.DataFrame(collection.load(cell, None))
            known = {} if truth is None else collection.load(truth, None)
            rows = rows.merge(pd.DataFrame(known), on="trial", how="left") if known else rows
            belongs = {name: cell.names[name] for name in NAMES} | dict(group.columns) | dict(group.options)
            rows.insert(0, "trial", rows.pop("trial"))
            parts.append(pd.concat([pd.DataFrame(belongs, index=rows.index), rows], axis=1))
    if not parts:
        return pd.DataFrame(columns=[*NAMES, "trial"])
    return pd.concat(parts, ignore_index=True)


# Which config leaves tell scenarios, or the estimators of one label, apart -------------------------------------------


def config_leaves(description: Any, prefix: str = "") -> dict[str, tuple[str, Any]]:
    """Dotted keys with (class that holds the leaf, plain value); a component's own class stands under its own key."""
    if not isinstance(description, Mapping):
        if isinstance(description, list) and any(isinstance(v, Mapping) for v in description):
            description = {str(i): v for i, v in enumerate(description)}
        else:
            # A list is one value, however long: two of different lengths differ.
            value = canonical_json(description) if isinstance(description, list) else description
            return {prefix: ("", value)}
    holder = str(description.get(TARGET, ""))
    result: dict[str, tuple[str, Any]] = {}
    if TARGET in description and prefix:
        result[prefix] = ("", holder)
    for key, value in description.items():
        if key == TARGET:
            continue
        inner = config_leaves(value, f"{prefix}.{key}" if prefix else str(key))
        result |= {k: (f"{holder}/{h}", v) for k, (h, v) in inner.items()}
    return result


def differing(descriptions: Sequence[Mapping[str, Any]]) -> list[str]:
    """The leaves that differ between descriptions, in the order of the config.

    Options of different classes are not compared: there the class differs, and is the leaf to show.
    """
    flat = [config_leaves(d) for d in descriptions]
    keys = dict.fromkeys(key for leaves in flat for key in leaves)
    result = []
    for key in keys:
        by_class: dict[str, set[str]] = {}
        for leaves in flat:
            if key in leaves:
                holder, value = leaves[key]
                by_class.setdefault(holder, set()).add(canonical_json(value))
        if any(len(values) > 1 for values in by_class.values()):
            result.append(key)
    return result


def _groups(cells: Sequence[StoredCell], runs: Sequence[Run]) -> tuple[Group, ...]:
    """One group per scenario and estimator: what was constructed decides which those are, and names only show it."""
    truths = {cell.scenario_id: cell for cell in cells if cell.label == TRUTH}
    estimates = [cell for cell in cells if cell.label != TRUTH]
    extra = [k for k in differing([_scenario(cell) for cell in estimates]) if k != "error_scale"]
    extra = [k for k in extra if not _stands_in_a_name(k, estimates)]
    options = _option_columns(estimates)
    found: dict[tuple[str, str, str], list[StoredCell]] = {}
    for cell in estimates:
        what = canonical_json(_scenario(cell)), cell.label, canonical_json(cell.footer["identity"]["estimator"])
        found.setdefault(what, []).append(cell)
    groups: dict[tuple[str, str, str], Group] = {}
    for what, members in found.items():
        first = members[0]
        leaves = config_leaves(_scenario(first))
        columns = {k: first.names[k] for k in ("measurement", "noise")}
        columns |= {k: shown_leaf(leaves[k][1]) if k in leaves else None for k in extra}
        columns["error_scale"] = first.names["error_scale"]
        own = config_leaves(first.footer["identity"]["estimator"])
        chosen = {k: shown_leaf(own[k][1]) if k in own else None for k in options.get(first.label, ())}
        label = first.label + (f" ({', '.join(f'{k}={v}' for k, v in chosen.items())})" if chosen else "")
        pairs = tuple((m, truths.get(m.scenario_id)) for m in sorted(members, key=lambda m: (m.seed, m.key)))
        groups[what] = Group(columns, label, {f"estimator.{k}": v for k, v in chosen.items()}, pairs)
    order = _estimator_order(runs)
    return tuple(
        sorted(
            _told_apart(groups),
            key=lambda g: (*map(_sortable, g.columns.values()), order.get(g.label, len(order)), g.estimator),
        )
    )


def _scenario(cell: StoredCell) -> dict[str, Any]:
    """What a scenario was constructed from, but for its seed: only seeds are pooled."""
    return {key: value for key, value in cell.footer["identity"]["scenario"].items() if key != "seed"}


def _told_apart(groups: Mapping[tuple[str, str, str], Group]) -> list[Group]:
    """The groups; those that no column tells apart get one that does, a digest of their config."""
    scenarios: dict[str, set[str]] = {}
    estimators: dict[tuple[str, str], set[str]] = {}
    for (scenario, _, estimator), group in groups.items():
        scenarios.setdefault(canonical_json(group.columns), set()).add(scenario)
        estimators.setdefault((scenario, group.estimator), set()).add(estimator)
    alike = any(len(different) > 1 for different in scenarios.values())
    result = []
    for (scenario, _, estimator), group in groups.items():
        if alike:
            scale = group.columns["error_scale"]
            columns = {k: v for k, v in group.columns.items() if k != "error_scale"}
            group = replace(group, columns=columns | {"config": digest(scenario)[:6], "error_scale": scale})
        if len(estimators[scenario, group.estimator]) > 1:
            group = replace(group, estimator=f"{group.estimator} (#{digest(estimator)[:6]})")
        result.append(group)
    return result


def _stands_in_a_name(key: str, cells: Sequence[StoredCell]) -> bool:
    """Whether the name of the component says already what this leaf says."""
    component = key.split(".")[0]
    if component not in ("measurement", "noise"):
        return False
    values: dict[Any, set[str]] = {}
    for cell in cells:
        leaf = config_leaves(_scenario(cell)).get(key)
        values.setdefault(cell.footer["names"].get(component), set()).add(canonical_json(leaf))
    return all(len(v) == 1 for v in values.values())


def _option_columns(cells: Sequence[StoredCell]) -> dict[str, list[str]]:
    """By label, the options that differ where one label stands for several configs."""
    by_label: dict[str, dict[str, Any]] = {}
    for cell in cells:
        config = cell.footer["identity"]["estimator"]
        by_label.setdefault(cell.label, {})[canonical_json(config)] = {"": config}
    result = {}
    for label, configs in by_label.items():
        if len(configs) > 1:
            keys = differing([c[""] for c in configs.values()])
            result[label] = keys or [TARGET]
    return result


def _estimator_order(runs: Iterable[Run]) -> dict[str, int]:
    labels = dict.fromkeys(str(cell["names"].get("estimator")) for run in runs for cell in run.record["cells"])
    return {label: i for i, label in enumerate(labels)}


def shown_leaf(value: Any) -> Any:
    """A leaf as it stands in a table: a class by its own name, a long list by its beginning and a digest of it all."""
    if isinstance(value, str) and value.count(".") >= 2 and value.replace(".", "_").isidentifier():
        return value.rpartition(".")[2]
    if isinstance(value, str) and len(value) > _LONGEST:
        return f"{value[: _LONGEST - 10]}… #{digest(value)[:6]}"
    return value


def _sortable(value: Any) -> tuple[int, float, str]:
    if isinstance(value, bool) or value is None or isinstance(value, str):
        return (1, 0.0, str(value))
    return (0, float(value), "")
