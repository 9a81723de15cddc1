"""From what is stored to what is compared: which cells are one experiment, and what tells them from
the others.

What is there, and what is wrong with it, `runs.results` says; what the numbers mean,
`statistics.records`.
"""

from __future__ import annotations

from collections.abc import Collection as Keys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ipe_bench.runs.parts import TRUTH
from ipe_bench.runs.provenance import TARGET, canonical_json, digest
from ipe_bench.runs.results import Results, StoredCell

if TYPE_CHECKING:
    import pandas as pd

NAMES = ("measurement", "noise", "prior", "error_scale", "seed", "estimator")
_MAIN = [
    "trial",
    "status",
    "success",
    "solved",
    "error_",
    "crlb_distance",
    "nees",
    "fit_p",
    "iterations",
    "simulations",
]
_MAIN += ["jacobians", "time_s", "message", "x_", "deviation_", "crlb_", "bayes_"]
"""Columns of a trial that come first, in this order, or what they begin with."""
_LONGEST = 34
"""Letters of a value in a table or a heading."""


@dataclass(frozen=True)
class Group:
    """Holds the cells of one scenario and one estimator that differ only in the seed."""

    columns: Mapping[str, Any]
    """Identifying columns of the group: measurement, noise, every config leaf that differs,
    error_scale."""
    estimator: str
    """The estimator's label, with the options that differ where one label stands for several
    configs."""
    options: Mapping[str, Any]
    """Differing options of the estimator, as columns."""
    cells: tuple[StoredCell, ...]
    """Each seed's estimates."""
    truths: tuple[StoredCell | None, ...]
    """The truth that belongs to each of them."""

    @property
    def footer(self) -> Mapping[str, Any]:
        return self.cells[0].footer

    @property
    def label(self) -> str:
        return self.cells[0].label


@dataclass
class Collection(Results):
    """Holds everything usable under some directories, grouped; `problems` and `stale` name the
    rest."""

    groups: tuple[Group, ...] = ()

    @property
    def scenarios(self) -> dict[tuple[Any, ...], list[Group]]:
        """The groups of each scenario, in order."""
        result: dict[tuple[Any, ...], list[Group]] = {}
        for group in self.groups:
            result.setdefault(tuple(group.columns.values()), []).append(group)
        return result

    @property
    def settings(self) -> int:
        """Number of settings of simulated trials: scenarios that differ in more than the error
        scale."""
        simulated = [
            key
            for key, groups in self.scenarios.items()
            if groups[0].columns["noise"] != "certified"
        ]
        return len({key[:-1] for key in simulated})


def collect(directories: Sequence[Path | str], keys: Keys[str] | None = None) -> Collection:
    """Finds what is stored under the directories, or the cells with these keys alone.

    Raises:
        UserError: a directory does not exist.
    """
    collection = Collection.read(directories, keys)
    collection.groups = _groups(collection.current, collection.runs)
    return collection


def trials_frame(collection: Collection) -> pd.DataFrame:
    """Returns every usable trial: its scenario, its result, and the truth; see `ipe_bench.load`."""
    import pandas as pd

    parts, first = [], {}
    for group in collection.groups:
        for cell, truth in zip(group.cells, group.truths, strict=True):
            rows = pd.DataFrame(collection.load(cell, None))
            known = {} if truth is None else collection.load(truth, None)
            rows = rows.merge(pd.DataFrame(known), on="trial", how="left") if known else rows
            belongs = (
                {name: cell.names[name] for name in NAMES}
                | dict(group.columns)
                | dict(group.options)
            )
            rows.insert(0, "trial", rows.pop("trial"))
            rows = rows.loc[
                :, ~rows.columns.str.startswith("curves")
            ]  # sums over trials, and no trial's
            parts.append(pd.concat([pd.DataFrame(belongs, index=rows.index), rows], axis=1))
            first |= belongs
    if not parts:
        return pd.DataFrame(columns=[*NAMES, "trial"])
    frame = pd.concat(parts, ignore_index=True)
    # What some estimator knows of most of its trials, whichever others there are.
    ample = {name for part in parts for name in part.columns[part.notna().mean() >= 0.5]}

    def place(name: str) -> tuple[int, bool]:
        if name in first:
            return -1, False
        main = (
            i
            for i, begin in enumerate(_MAIN)
            if name == begin or (begin[-1] == "_" and name.startswith(begin))
        )
        at = next(main, len(_MAIN))
        return at, at == len(_MAIN) and name not in ample

    return frame[sorted(frame.columns, key=place)]


# Which config leaves tell scenarios, or the estimators of one label, apart ------------------------


def config_leaves(description: Any, prefix: str = "") -> dict[str, tuple[str, Any]]:
    """Returns dotted keys with (class that holds the leaf, plain value); a component's own class
    stands under its own key, that of the whole under `TARGET`."""
    if isinstance(description, list) and any(isinstance(v, Mapping) for v in description):
        description = {str(i): v for i, v in enumerate(description)}
    if not isinstance(description, Mapping):
        # A list is one value, however long: two of different lengths differ.
        return {
            prefix: (
                "",
                canonical_json(description) if isinstance(description, list) else description,
            )
        }
    holder = str(description.get(TARGET, ""))
    result: dict[str, tuple[str, Any]] = (
        {prefix or TARGET: ("", holder)} if TARGET in description else {}
    )
    for key, value in description.items():
        if key != TARGET:
            inner = config_leaves(value, f"{prefix}.{key}" if prefix else str(key))
            result |= {k: (f"{holder}/{h}", v) for k, (h, v) in inner.items()}
    return result


def differing(descriptions: Sequence[Mapping[str, Any]]) -> list[str]:
    """Finds the leaves that differ between descriptions, in the order of the config.

    Options of different classes are not compared: there the class differs, and is the leaf to show.
    """
    by_key: dict[str, dict[str, set[str]]] = {}
    for description in descriptions:
        for key, (holder, value) in config_leaves(description).items():
            by_key.setdefault(key, {}).setdefault(holder, set()).add(canonical_json(value))
    return [
        key
        for key, holders in by_key.items()
        if any(len(values) > 1 for values in holders.values())
    ]


def _groups(cells: Sequence[StoredCell], runs: Sequence[Mapping[str, Any]]) -> tuple[Group, ...]:
    """Forms one group per scenario and estimator: identical constructions are one, and names only
    show it."""
    truths = {cell.scenario_id: cell for cell in cells if cell.label == TRUTH}
    found: dict[tuple[str, str, str], list[StoredCell]] = {}
    configs: dict[str, dict[str, Any]] = {}
    for cell in cells:
        if cell.label != TRUTH:
            config = cell.footer["identity"]["estimator"]
            what = canonical_json(scenario_of(cell)), cell.label, canonical_json(config)
            found.setdefault(what, []).append(cell)
            configs.setdefault(cell.label, {})[what[2]] = config
    firsts = [members[0] for members in found.values()]
    extra = [k for k in differing([scenario_of(cell) for cell in firsts]) if k != "error_scale"]
    extra = [k for k in extra if not _stands_in_a_name(k, firsts)]
    options = {label: differing(list(several.values())) for label, several in configs.items()}
    labels = dict.fromkeys(
        str(cell["names"].get("estimator")) for run in runs for cell in run["cells"]
    )
    order = {label: i for i, label in enumerate(labels)}
    groups = []
    for members in found.values():
        first = members[0]
        chosen = _shown(first.footer["identity"]["estimator"], options[first.label])
        columns = {k: first.names[k] for k in ("measurement", "noise")} | _shown(
            scenario_of(first), extra
        )
        columns["error_scale"] = first.names["error_scale"]
        label = first.label + (
            f" ({', '.join(f'{k}={v}' for k, v in chosen.items())})" if chosen else ""
        )
        members.sort(key=lambda cell: (cell.seed, cell.key))
        known = tuple(truths.get(cell.scenario_id) for cell in members)
        groups.append(
            Group(
                columns,
                label,
                {f"estimator.{k}": v for k, v in chosen.items()},
                tuple(members),
                known,
            )
        )

    def place(group: Group) -> tuple[Any, ...]:
        return (
            *map(_sortable, group.columns.values()),
            order.get(group.label, len(order)),
            group.estimator,
        )

    return tuple(sorted(groups, key=place))


def scenario_of(cell: StoredCell) -> dict[str, Any]:
    """Returns the construction of a scenario without its seed: only seeds are pooled."""
    return {
        key: value for key, value in cell.footer["identity"]["scenario"].items() if key != "seed"
    }


def _shown(description: Any, keys: Iterable[str]) -> dict[str, Any]:
    """Formats some leaves of a description for a table; None for missing ones."""
    leaves = config_leaves(description)
    return {k: shown_leaf(leaves[k][1]) if k in leaves else None for k in keys}


def _stands_in_a_name(key: str, cells: Sequence[StoredCell]) -> bool:
    """Returns whether the name of the component implies this leaf."""
    component = key.split(".")[0]
    if component not in ("measurement", "noise"):
        return False
    leaves = [canonical_json(config_leaves(scenario_of(cell)).get(key)) for cell in cells]
    said = {
        (cell.footer["names"].get(component), leaf)
        for cell, leaf in zip(cells, leaves, strict=True)
    }
    return len(said) == len({name for name, _ in said})


def shown_leaf(value: Any) -> Any:
    """Formats a leaf for a table: a class of ours by its own name, a long text by its beginning and
    a digest."""
    if isinstance(value, str) and value.startswith("ipe_bench."):
        return value.rpartition(".")[2]
    if isinstance(value, str) and len(value) > _LONGEST:
        return f"{value[: _LONGEST - 10]}… #{digest(value)[:6]}"
    return value


def _sortable(value: Any) -> tuple[int, float, str]:
    if isinstance(value, bool) or value is None or isinstance(value, str):
        return (1, 0.0, str(value))
    return (0, float(value), "")
