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
_MAIN = (
    *("trial", "status", "success", "solved", "error_", "crlb_distance", "nees", "fit_p"),
    *("iterations", "simulations", "jacobians", "time_s", "message"),
    *("x_", "deviation_", "crlb_", "bayes_"),
)
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
        # The error scale is the last column.
        simulated = {
            columns[:-1]
            for columns, groups in self.scenarios.items()
            if groups[0].columns["noise"] != "certified"
        }
        return len(simulated)


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

    parts = []
    first = {}
    for group in collection.groups:
        of_group = dict(group.columns) | dict(group.options)
        for cell, truth in zip(group.cells, group.truths, strict=True):
            rows = _rows_with_truth(collection, cell, truth)
            belongs = {name: cell.names[name] for name in NAMES} | of_group
            repeated = pd.DataFrame(belongs, index=rows.index)
            parts.append(pd.concat([repeated, rows], axis=1))
            first |= belongs
    if not parts:
        return pd.DataFrame(columns=[*NAMES, "trial"])
    frame = pd.concat(parts, ignore_index=True)
    # What some estimator knows of most of its trials, whichever others there are.
    ample = {name for part in parts for name in part.columns[part.notna().mean() >= 0.5]}

    def place(name: str) -> tuple[int, bool]:
        if name in first:
            return -1, False
        for i, begin in enumerate(_MAIN):
            if name == begin or (begin[-1] == "_" and name.startswith(begin)):
                return i, False
        return len(_MAIN), name not in ample

    return frame[sorted(frame.columns, key=place)]


def _rows_with_truth(
    collection: Collection, cell: StoredCell, truth: StoredCell | None
) -> pd.DataFrame:
    """Returns a row per trial of a cell: its number, its result, and what is stored of its
    truth."""
    import pandas as pd

    rows = pd.DataFrame(collection.load(cell, None))
    known = {} if truth is None else collection.load(truth, None)
    if known:
        rows = rows.merge(pd.DataFrame(known), on="trial", how="left")
    rows.insert(0, "trial", rows.pop("trial"))
    # These are sums over trials, and no trial's.
    curves = rows.columns.str.startswith("curves")
    return rows.loc[:, ~curves]


# Which config leaves tell scenarios, or the estimators of one label, apart ------------------------


def config_leaves(description: Any, prefix: str = "") -> dict[str, tuple[str, Any]]:
    """Returns dotted keys with (class that holds the leaf, plain value); a component's own class
    stands under its own key, that of the whole under `TARGET`."""
    if isinstance(description, list):
        if not any(isinstance(value, Mapping) for value in description):
            # A list is one value, however long: two of different lengths differ.
            return {prefix: ("", canonical_json(description))}
        description = {str(i): value for i, value in enumerate(description)}
    if not isinstance(description, Mapping):
        return {prefix: ("", description)}
    holder = str(description.get(TARGET, ""))
    result: dict[str, tuple[str, Any]] = {}
    if TARGET in description:
        result[prefix or TARGET] = ("", holder)
    for key, value in description.items():
        if key == TARGET:
            continue
        inner = config_leaves(value, f"{prefix}.{key}" if prefix else str(key))
        for leaf, (within, plain) in inner.items():
            result[leaf] = (f"{holder}/{within}", plain)
    return result


def differing(descriptions: Sequence[Mapping[str, Any]]) -> list[str]:
    """Finds the leaves that differ between descriptions, in the order of the config.

    Options of different classes are not compared: there the class differs, and is the leaf to show.
    """
    by_key: dict[str, dict[str, set[str]]] = {}
    for description in descriptions:
        for key, (holder, value) in config_leaves(description).items():
            holders = by_key.setdefault(key, {})
            holders.setdefault(holder, set()).add(canonical_json(value))
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
        if cell.label == TRUTH:
            continue
        config = cell.footer["identity"]["estimator"]
        text = canonical_json(config)
        constructed = (canonical_json(scenario_of(cell)), cell.label, text)
        found.setdefault(constructed, []).append(cell)
        configs.setdefault(cell.label, {})[text] = config
    firsts = [members[0] for members in found.values()]
    leaves = differing([scenario_of(cell) for cell in firsts])
    leaves = [k for k in leaves if k != "error_scale" and not _stands_in_a_name(k, firsts)]
    options = {label: differing(list(several.values())) for label, several in configs.items()}
    texts = {
        label: {
            k: _shortened([_shown(one, [k])[k] for one in several.values()]) for k in options[label]
        }
        for label, several in configs.items()
    }
    groups = []
    for members in found.values():
        label = members[0].label
        groups.append(_group(members, truths, leaves, texts[label]))
    order = _order_of_labels(runs)

    def place(group: Group) -> tuple[Any, ...]:
        columns = map(_sortable, group.columns.values())
        return (*columns, order.get(group.label, len(order)), group.estimator)

    return tuple(sorted(groups, key=place))


def _group(
    members: Sequence[StoredCell],
    truths: Mapping[str, StoredCell],
    leaves: Sequence[str],
    options: Mapping[str, Mapping[str, str]],
) -> Group:
    """Forms a group of cells that were constructed alike; `leaves` of the scenario and `options` of
    the estimator, with the texts of their values, tell it from others."""
    first = members[0]
    columns = {
        "measurement": first.names["measurement"],
        "noise": first.names["noise"],
        **_shown(scenario_of(first), leaves),
        "error_scale": first.names["error_scale"],
    }
    chosen = _shown(first.footer["identity"]["estimator"], options)
    label = first.label
    if chosen:
        values = ", ".join(f"{k}={options[k][str(v)]}" for k, v in chosen.items())
        label = f"{label} ({values})"
    cells = sorted(members, key=lambda cell: (cell.seed, cell.key))
    return Group(
        columns,
        label,
        options={f"estimator.{k}": v for k, v in chosen.items()},
        cells=tuple(cells),
        truths=tuple(truths.get(cell.scenario_id) for cell in cells),
    )


def _shortened(values: Iterable[Any]) -> dict[str, str]:
    """Returns the shortest texts that tell values apart, of numbers in at least four figures."""
    distinct = {str(value): value for value in values}
    for figures in range(4, 17):
        texts = {
            text: f"{value:.{figures}g}" if isinstance(value, float) and len(text) > 6 else text
            for text, value in distinct.items()
        }
        if len(set(texts.values())) == len(texts):
            return texts
    return {text: text for text in distinct}


def _order_of_labels(runs: Sequence[Mapping[str, Any]]) -> dict[str, int]:
    """Numbers the estimators as the runs named them first."""
    order: dict[str, int] = {}
    for run in runs:
        for cell in run["cells"]:
            order.setdefault(str(cell["names"].get("estimator")), len(order))
    return order


def scenario_of(cell: StoredCell) -> dict[str, Any]:
    """Returns the construction of a scenario without its seed: only seeds are pooled."""
    scenario = cell.footer["identity"]["scenario"]
    return {key: value for key, value in scenario.items() if key != "seed"}


def _shown(description: Any, keys: Iterable[str]) -> dict[str, Any]:
    """Formats some leaves of a description for a table; None for missing ones."""
    leaves = config_leaves(description)
    return {k: shown_leaf(leaves[k][1]) if k in leaves else None for k in keys}


def _stands_in_a_name(key: str, cells: Sequence[StoredCell]) -> bool:
    """Returns whether the name of the component implies this leaf."""
    component = key.split(".")[0]
    if component not in ("measurement", "noise"):
        return False
    found = set()
    for cell in cells:
        leaf = config_leaves(scenario_of(cell)).get(key)
        found.add((cell.footer["names"].get(component), canonical_json(leaf)))
    # No name goes with two values.
    return len(found) == len({name for name, _ in found})


def shown_leaf(value: Any) -> Any:
    """Formats a leaf for a table: a class of ours by its own name, a long text by its beginning and
    a digest."""
    if not isinstance(value, str):
        return value
    if value.startswith("ipe_bench."):
        return value.rpartition(".")[2]
    if len(value) <= _LONGEST:
        return value
    beginning = value[: _LONGEST - 10]
    return f"{beginning}… #{digest(value)[:6]}"


def _sortable(value: Any) -> tuple[int, float, str]:
    if isinstance(value, bool) or value is None or isinstance(value, str):
        return (1, 0.0, str(value))
    return (0, float(value), "")
