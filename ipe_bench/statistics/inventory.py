"""What a directory of results holds, and what it lacks: done, missing, failed and stale trials of each cell."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ipe_bench.basics.errors import UserError
from ipe_bench.runs.store import DamagedFile, Store, gaps


@dataclass(frozen=True)
class CellState:
    """How far one scenario is under one estimator. `done`, `failed` and `missing` add up to `expected`."""

    names: Mapping[str, Any]
    """measurement, noise, prior, error_scale, seed, estimator (`truth` for the truth and its bounds)."""
    expected: int
    """Trials that were asked for; 0 where no run in the directory asks for this cell."""
    done: int
    failed: int
    missing: int
    stale: int
    """Trials that another version of the program or of its source computed; they do not count as done."""
    messages: tuple[str, ...]
    """Why trials failed."""

    @property
    def complete(self) -> bool:
        return self.failed == 0 and self.missing == 0


@dataclass(frozen=True)
class Inventory:
    """The cells of a directory in the order in which runs asked for them, and its damaged files."""

    cells: tuple[CellState, ...]
    damaged: tuple[Path, ...]

    @property
    def complete(self) -> bool:
        return bool(self.cells) and not self.damaged and all(cell.complete for cell in self.cells)


def take_inventory(directory: Path | str) -> Inventory:
    """Compares what runs in the directory asked for with what is stored.

    Raises:
        UserError: there is no such directory, or no run ever wrote to it.
    """
    store = Store(directory)
    if not store.runs.is_dir() and not store.trials.is_dir():
        raise UserError(f"{directory}: holds no results of ipe-bench; give the output folder of a run")
    stored, footers, damaged = _stored(store)
    asked = _asked_for(store)
    failures: dict[str, list[dict[str, Any]]] = {}
    for failure in store.failures():
        failures.setdefault(failure["key"], []).append(failure)

    identities = {key: footer["identity_key"] for key, footer in footers.items()}
    cells = []
    for identity_key, (key, trials, names) in asked.items():
        open_ranges = gaps(stored.get(key, ()), 0, trials)
        lost = failures.get(key, [])
        done = trials - _length(open_ranges)
        still_open = [gap for start, stop in open_ranges for gap in gaps(_ranges(lost), start, stop)]
        missing = _length(still_open)
        stale = [k for k, identity in identities.items() if identity == identity_key and k != key]
        cells.append(
            CellState(
                names,
                trials,
                done,
                trials - done - missing,
                missing,
                sum(_covered(stored[k]) for k in stale),
                tuple(dict.fromkeys(f"{f['status']}: {f['message']}" for f in lost)),
            )
        )
    for key, footer in footers.items():
        if footer["identity_key"] not in asked:
            cells.append(CellState(footer["names"], 0, _covered(stored[key]), 0, 0, 0, ()))
    return Inventory(tuple(cells), damaged)


def _stored(store: Store) -> tuple[dict[str, list[tuple[int, int]]], dict[str, dict[str, Any]], tuple[Path, ...]]:
    """By key: the ranges of the whole files, and a footer; and the files that are not whole."""
    ranges: dict[str, list[tuple[int, int]]] = {}
    footers: dict[str, dict[str, Any]] = {}
    damaged = []
    for piece in store.pieces():
        try:
            footers[piece.key] = piece.footer()
        except DamagedFile:
            damaged.append(piece.path)
        else:
            ranges.setdefault(piece.key, []).append((piece.start, piece.stop))
    return ranges, footers, tuple(damaged)


def _asked_for(store: Store) -> dict[str, tuple[str, int, Mapping[str, Any]]]:
    """By identity: the key that the newest run has for it, the number of trials, and the names."""
    records = [json.loads(path.read_text(encoding="utf-8")) for path in store.runs.glob("*.json")]
    asked: dict[str, tuple[str, int, Mapping[str, Any]]] = {}
    for record in sorted(records, key=lambda r: r["started"]):
        for cell in record["cells"]:
            key, trials, _ = asked.get(cell["identity_key"], (cell["key"], 0, {}))
            trials = max(trials, record["trials"]) if key == cell["key"] else record["trials"]
            asked[cell["identity_key"]] = (cell["key"], trials, cell["names"])
    return asked


def _ranges(failures: Iterable[Mapping[str, Any]]) -> list[tuple[int, int]]:
    return [(f["start"], f["stop"]) for f in failures]


def _length(ranges: Iterable[tuple[int, int]]) -> int:
    return sum(stop - start for start, stop in ranges)


def _covered(ranges: Sequence[tuple[int, int]]) -> int:
    """How many trials the ranges hold between them."""
    end = max(stop for _, stop in ranges)
    return end - _length(gaps(ranges, 0, end))


def title(names: Mapping[str, Any]) -> str:
    """The scenario of a cell in a line for people."""
    return (
        f"{names['measurement']}, {names['noise']}, error scale {names['error_scale']:g}, seed {names['seed']}"
        if names["error_scale"] is not None
        else str(names["measurement"])
    )
