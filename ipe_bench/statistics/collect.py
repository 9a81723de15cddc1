"""From directories to what is stored in them: which cells there are, which trials of them, and what is wrong.

A stored piece is used, or named in `Collection.problems` or `Collection.stale`; nothing is guessed, mixed or deleted.
What the numbers mean is left to `statistics.summary`.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.runs.provenance import canonical_json
from ipe_bench.runs.store import FOOTER, SCHEMA, TRUTH, DamagedFile, Piece, Store, gaps

TARGET = "_target_"
NAMED = ("measurement", "noise", "prior")
"""Components of a scenario that footers name."""
FOOTER_KEYS = frozenset({"key", "identity", "identity_key", "names", "parameters", "linear_bound", "bound", "equation"})
ALWAYS_COLUMNS = ("measurement", "noise", "error_scale", "estimator")


@dataclass(frozen=True)
class StoredCell:
    """One scenario (one seed) under one estimator, or its truth, with all its pieces from all directories."""

    footer: Mapping[str, Any]
    pieces: tuple[Piece, ...]

    @property
    def key(self) -> str:
        return self.footer["key"]

    @property
    def label(self) -> str:
        """The label that the run gave to the estimator."""
        return self.footer["names"]["estimator"]

    @property
    def seed(self) -> int:
        return self.footer["names"]["seed"]

    @cached_property
    def scenario_id(self) -> str:
        """One text per scenario, seed included."""
        return canonical_json(self.footer["identity"]["scenario"])

    @cached_property
    def covered(self) -> tuple[tuple[int, int], ...]:
        """The union of the trials that are there, as disjoint ranges in ascending order."""
        return merge_ranges((p.start, p.stop) for p in self.pieces)


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


@dataclass(frozen=True)
class Run:
    """One record of runs/: what was going to be computed."""

    path: Path
    record: Mapping[str, Any]

    @property
    def started(self) -> str:
        return str(self.record.get("started", ""))


@dataclass
class Collection:
    """Everything usable under the directories, and one line for everything that is not."""

    directories: tuple[Path, ...]
    groups: tuple[Group, ...] = ()
    runs: tuple[Run, ...] = ()
    problems: list[str] = field(default_factory=list)
    """What is missing, failed, foreign or damaged."""
    stale: list[str] = field(default_factory=list)
    """What older code computed: left out, and no problem where the present code has computed it again."""
    expected: int = 0
    """Cells that the records of runs announce."""
    complete: int = 0
    """Those of them with every trial."""

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

    def problem(self, line: str) -> None:
        if line not in self.problems:
            self.problems.append(line)

    def load(self, cell: StoredCell, columns: Sequence[str] | None, optional: Sequence[str] = ()) -> dict[str, Array]:
        """The rows of a cell as arrays, by ascending trial, each trial once.

        A piece that cannot be read is named in `problems`, and left out.
        """
        names = None if columns is None else list(dict.fromkeys(["trial", *columns, *optional]))
        with ThreadPoolExecutor(2) as pool:
            tables = list(pool.map(lambda piece: _read(piece, names), cell.pieces))
        good = []
        for piece, table in zip(cell.pieces, tables, strict=True):
            if isinstance(table, str):
                self.problem(f"{piece.path}: damaged: {table}; left out")
            elif columns is not None and (lacking := [c for c in columns if c not in table.column_names]):
                self.problem(f"{piece.path}: damaged: has no column {lacking[0]}; left out")
            else:
                good.append(table)
        if not good:
            return {name: np.empty(0) for name in names or ["trial"]}
        table = pa.concat_tables(good, promote_options="default")
        trial, order = np.unique(table["trial"].to_numpy(), return_index=True)
        whole = len(order) == table.num_rows and np.array_equal(order, np.arange(len(order)))
        result = {}
        for name in table.column_names:
            values = table[name].to_numpy()
            result[name] = values if whole else values[order]
        return result | {"trial": trial}

    def load_history(self, cell: StoredCell, columns: Sequence[str]) -> dict[str, Array] | None:
        """The iterates of a cell's first trials in order; None where none are stored."""
        for directory in self.directories:
            path = Store(directory).histories / f"{cell.key}.parquet"
            if not path.is_file():
                continue
            table = _read(Piece(path, cell.key, 0, 0), ["trial", *columns])
            if isinstance(table, str) or any(c not in table.column_names for c in ("trial", *columns)):
                reason = table if isinstance(table, str) else "a column is missing"
                self.problem(f"{path}: damaged: {reason}; left out")
                continue
            return {name: table[name].to_numpy() for name in table.column_names}
        return None


def _read(piece: Piece, names: list[str] | None) -> pa.Table | str:
    """The table without its metadata, so that tables join; what is wrong where it cannot be read."""
    try:
        with pq.ParquetFile(piece.path) as file:
            there = file.schema_arrow.names
            wanted = there if names is None else [n for n in names if n in there]
            table = file.read(columns=wanted, use_threads=False).replace_schema_metadata(None)
    except (pa.ArrowException, OSError) as error:
        return type(error).__name__
    for name in ("status", "message"):
        if name in table.column_names:
            at = table.column_names.index(name)
            table = table.set_column(at, name, table[name].cast(pa.string()))
    return table


def collect(directories: Sequence[Path | str]) -> Collection:
    """Finds what is stored under the directories.

    Raises:
        UserError: a directory does not exist.
    """
    paths = tuple(Path(d) for d in directories)
    for path in paths:
        if not path.is_dir():
            raise UserError(f"{path}: there is no such directory; give one that a run wrote to")
    collection = Collection(paths)
    stored: dict[str, tuple[dict[str, Any], list[Piece]]] = {}
    runs: list[Run] = []
    for path in paths:
        store = Store(path)
        found = _find_pieces(store, stored, collection)
        records = _find_runs(store, collection)
        runs += records
        if not found and not records:
            collection.problem(f"{path}: holds no results of ipe-bench")
    collection.runs = tuple(sorted(runs, key=lambda r: (r.started, r.path.name)))
    cells = [
        StoredCell(footer, tuple(sorted(pieces, key=lambda p: (p.start, p.stop, str(p.path)))))
        for footer, pieces in stored.values()
    ]
    current = _leave_out_stale(cells, collection)
    _report_missing(current, collection)
    collection.groups = _groups(current, collection)
    return collection


def _find_pieces(store: Store, stored: dict[str, tuple[dict[str, Any], list[Piece]]], collection: Collection) -> int:
    """Adds the pieces of a directory to those known, by key; returns how many files there are."""
    footers: dict[bytes, dict[str, Any]] = {}
    count = 0
    for path in sorted(store.trials.glob("*.parquet")):
        count += 1
        piece = Piece.parse(path)
        if piece is None:
            collection.problem(f"{path}: foreign: its name is not one of ipe-bench; left out")
            continue
        try:
            metadata = pq.read_metadata(path)
        except (pa.ArrowException, OSError) as error:
            collection.problem(f"{DamagedFile(path, error)}: damaged or cut short; left out")
            continue
        text = (metadata.metadata or {}).get(FOOTER)
        if text is None:
            collection.problem(f"{path}: foreign: has no footer of ipe-bench; left out")
            continue
        try:
            footer = footers[text] if text in footers else json.loads(text)
        except ValueError:
            collection.problem(f"{path}: damaged: its footer cannot be read; left out")
            continue
        footers[text] = footer
        if not isinstance(footer, dict) or not footer.keys() >= FOOTER_KEYS or footer.get("schema") != SCHEMA:
            collection.problem(f"{path}: foreign: was written by another version of the format; left out")
        elif footer["key"] != piece.key:
            collection.problem(f"{path}: foreign: its footer belongs to {footer['key']}; left out")
        elif metadata.num_rows != piece.stop - piece.start:
            wanted = piece.stop - piece.start
            collection.problem(f"{path}: damaged: has {metadata.num_rows} of {wanted} rows; left out")
        else:
            stored.setdefault(piece.key, (footer, []))[1].append(piece)
    return count


def _find_runs(store: Store, collection: Collection) -> list[Run]:
    runs = []
    for path in sorted(store.runs.glob("*.json")):
        try:
            record = json.loads(path.read_text(encoding="utf-8"))
            cells = record["cells"]
            understood = all(cell.keys() >= {"key", "identity_key", "names"} for cell in cells)
            understood = understood and int(record["trials"]) >= 0
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            understood, record = False, {}
        if not understood:
            collection.problem(f"{path}: foreign: is not a record of a run; left out")
            continue
        runs.append(Run(path, record))
    return runs


def _expected(runs: Iterable[Run]) -> dict[str, tuple[str, int, Mapping[str, Any]]]:
    """By identity key: the key that the newest run expects, the number of trials, and the names."""
    result: dict[str, tuple[str, int, Mapping[str, Any]]] = {}
    for run in runs:
        for cell in run.record["cells"]:
            trials = int(cell.get("trials", run.record["trials"]))
            before = result.get(cell["identity_key"])
            if before is not None and before[0] == cell["key"]:
                trials = max(trials, before[1])
            result[cell["identity_key"]] = (cell["key"], trials, cell["names"])
    return result


def _leave_out_stale(cells: Sequence[StoredCell], collection: Collection) -> list[StoredCell]:
    """One cell per identity: the one that the newest run expects, else the one written last."""
    expected = _expected(collection.runs)
    rivals: dict[str, list[StoredCell]] = {}
    for cell in cells:
        rivals.setdefault(cell.footer["identity_key"], []).append(cell)
    current = []
    for identity_key, candidates in rivals.items():
        if identity_key in expected:
            key = expected[identity_key][0]
        elif len(candidates) > 1:
            key = max(candidates, key=_written).key
        else:
            key = candidates[0].key
        for cell in candidates:
            if cell.key == key:
                current.append(cell)
            else:
                versions = ", ".join(f"{p} {v}" for p, v in cell.footer.get("versions", {}).items())
                collection.stale.append(
                    f"stale: {describe_names(cell.footer['names'])}: {_count(cell.covered)} trials were computed by"
                    f" other code ({versions}, source {cell.footer.get('source')}, key {cell.key}); left out"
                )
    return current


def _written(cell: StoredCell) -> float:
    return max(p.path.stat().st_mtime for p in cell.pieces)


def _report_missing(cells: Sequence[StoredCell], collection: Collection) -> None:
    """Counts the trials that runs announced: there, failed (somebody tried, in vain), or missing."""
    there = {cell.key: cell for cell in cells}
    failures = _failures(collection)
    for key, trials, names in _expected(collection.runs).values():
        collection.expected += 1
        covered = there[key].covered if key in there else ()
        lacking = gaps(covered, 0, trials)
        if not lacking:
            collection.complete += 1
            continue
        failed = failures.get(key, [])
        untried = _count(
            g for start, stop in lacking for g in gaps([(f["start"], f["stop"]) for f in failed], start, stop)
        )
        there_now = trials - _count(lacking)
        for line in dict.fromkeys(f"{f['status']}: {f['message']}" for f in failed):
            count = _count(lacking) - untried
            collection.problem(f"failed: {describe_names(names)}: {count} of {trials} expected trials: {line}")
        if untried:
            collection.problem(f"missing: {describe_names(names)}: {there_now} of {trials} expected trials are there")


def _failures(collection: Collection) -> dict[str, list[dict[str, Any]]]:
    """By key: what could not be computed, whether or not it was since."""
    result: dict[str, list[dict[str, Any]]] = {}
    for directory in collection.directories:
        for path in sorted(Store(directory).failed.glob("*.json")):
            try:
                record = json.loads(path.read_text(encoding="utf-8"))
                whole = record.keys() >= {"key", "status", "message"} and int(record["start"]) < int(record["stop"])
            except (OSError, ValueError, KeyError, TypeError, AttributeError):
                whole, record = False, {}
            if whole:
                result.setdefault(record["key"], []).append(record)
            else:
                collection.problem(f"{path}: foreign: is not a record of a failure; left out")
    return result


def describe_names(names: Mapping[str, Any]) -> str:
    """One line that names a cell to a reader."""
    estimator = "the truth" if names.get("estimator") == TRUTH else str(names.get("estimator"))
    rest = [str(names.get("measurement")), str(names.get("noise"))]
    scale = names.get("error_scale")
    rest += [] if scale is None else [f"error scale {scale:g}"]
    return f"{estimator} on {', '.join(rest)}, seed {names.get('seed')}"


def merge_ranges(ranges: Iterable[tuple[int, int]]) -> tuple[tuple[int, int], ...]:
    """The union of half-open ranges, as disjoint ranges in ascending order."""
    merged: list[tuple[int, int]] = []
    for start, stop in sorted(ranges):
        if merged and start <= merged[-1][1]:
            merged[-1] = (merged[-1][0], max(stop, merged[-1][1]))
        else:
            merged.append((start, stop))
    return tuple(merged)


def _count(ranges: Iterable[tuple[int, int]]) -> int:
    return sum(stop - start for start, stop in ranges)


# Which config leaves tell scenarios, or the estimators of one label, apart -------------------------------------------


def config_leaves(description: Any, prefix: str = "") -> dict[str, tuple[str, Any]]:
    """Dotted keys with (class that holds the leaf, plain value); a component's own class stands under its own key."""
    if not isinstance(description, Mapping):
        if isinstance(description, list) and any(isinstance(v, Mapping | list) for v in description):
            description = {str(i): v for i, v in enumerate(description)}
        else:
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


def _groups(cells: Sequence[StoredCell], collection: Collection) -> tuple[Group, ...]:
    truths = {cell.scenario_id: cell for cell in cells if cell.label == TRUTH}
    estimates = [cell for cell in cells if cell.label != TRUTH]
    scenarios = [cell.footer["identity"]["scenario"] for cell in estimates]
    extra = [k for k in differing(scenarios) if k not in ("seed", "error_scale")]
    extra = [k for k in extra if not _stands_in_a_name(k, estimates)]
    options = _option_columns(estimates)
    order = _estimator_order(collection.runs)
    found: dict[tuple[str, str], tuple[dict[str, Any], str, dict[str, Any], list[StoredCell]]] = {}
    for cell in estimates:
        leaves = config_leaves(cell.footer["identity"]["scenario"])
        columns = {k: cell.footer["names"].get(k) for k in ("measurement", "noise")}
        columns |= {k: _shown(leaves.get(k, ("", None))[1]) for k in extra}
        columns["error_scale"] = cell.footer["names"].get("error_scale")
        own = config_leaves(cell.footer["identity"]["estimator"])
        mine = {k: _shown(own.get(k, ("", None))[1]) for k in options.get(cell.label, ())}
        estimator = cell.label
        if mine:
            estimator += " (" + ", ".join(f"{k}={v}" for k, v in mine.items()) + ")"
        where = (canonical_json(columns), estimator)
        mine = {f"estimator.{k}": v for k, v in mine.items()}
        found.setdefault(where, (columns, estimator, mine, []))[3].append(cell)
    groups = []
    for columns, estimator, mine, members in found.values():
        for member in members:
            if member.scenario_id not in truths:
                collection.problem(f"missing: the truth of {describe_names(member.footer['names'])}: no bound is shown")
        pairs = tuple((m, truths.get(m.scenario_id)) for m in sorted(members, key=lambda m: (m.seed, m.key)))
        groups.append(Group(columns, estimator, mine, pairs))
    groups.sort(key=lambda g: (*map(_sortable, g.columns.values()), order.get(g.label, len(order)), g.estimator))
    return tuple(groups)


def _stands_in_a_name(key: str, cells: Sequence[StoredCell]) -> bool:
    """Whether the name of the component says already what this leaf says."""
    component = key.split(".")[0]
    if component not in ("measurement", "noise"):
        return False
    values: dict[Any, set[str]] = {}
    for cell in cells:
        leaf = config_leaves(cell.footer["identity"]["scenario"]).get(key)
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


def _shown(value: Any) -> Any:
    """A leaf as it stands in a table: a class by its own name."""
    if isinstance(value, str) and value.count(".") >= 2 and value.replace(".", "_").isidentifier():
        return value.rpartition(".")[2]
    return value


def _sortable(value: Any) -> tuple[int, float, str]:
    if isinstance(value, bool) or value is None or isinstance(value, str):
        return (1, 0.0, str(value))
    return (0, float(value), "")
