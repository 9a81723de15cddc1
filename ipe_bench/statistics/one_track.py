"""Chooses one trial of a scenario with states that move, and reads its truth, readings and
tracks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.statistics.statistic import ALL
from ipe_bench.trials.one_track import COLUMN, position_of, read_text

if TYPE_CHECKING:
    from ipe_bench.runs.results import StoredCell
    from ipe_bench.statistics.collect import Collection, Group

READINGS = "readings"
"""Stands for the tracker in the rows of readings."""


def best_tracker(rows: Sequence[Mapping[str, Any]]) -> str:
    """Returns the tracker that succeeds most, of equals the one of the smallest median error, from
    the rows of a scenario's summary."""
    totals = [row for row in rows if row["parameter"] == ALL]
    return str(min(totals, key=lambda row: (-row["success"], row["error_median"]))["estimator"])


def one_track(
    collection: Collection, groups: Sequence[Group], best: str
) -> Iterator[dict[str, Any]]:
    """Yields a row for each state of each tracker, and for each reading, in one trial of the first
    seed: the one whose error at the last epoch is the median of the best tracker's stored tracks.
    Values are in the states' own units."""
    (leading,) = (group for group in groups if group.estimator == best)
    truth = leading.truths[0]
    times = np.array(leading.footer.get("times", ()), dtype=float)
    if truth is None or not len(times):
        return
    trial = _median_trial(collection, leading.cells[0])
    true = _values(collection, truth, trial, len(times))
    if true is None:
        return
    parameters = leading.footer["parameters"]
    n = len(parameters)
    nothing = np.full(len(times), np.nan)
    where = {"trial": trial, "at": times, "truth": nothing, "deviation": nothing, "across": nothing}
    for number, z in enumerate(true[:, n:].T, 1):
        name = f"reading {number}"
        yield where | {"estimator": READINGS, "parameter": name, "unit": "", "mean": z}
    place = position_of([p["name"] for p in parameters])
    for group in groups:
        track = _values(collection, group.cells[0], trial, len(times))
        if track is None:
            continue
        for i, parameter in enumerate(parameters):
            size = parameter["size"]
            across = nothing
            if place is not None and i == place[0]:
                across = size * parameters[place[1]]["size"] * track[:, 2 * n]
            yield where | {
                "estimator": group.estimator,
                "parameter": parameter["name"],
                "unit": parameter["unit"],
                "truth": size * true[:, i],
                "mean": size * track[:, i],
                "deviation": size * track[:, n + i],
                "across": across,
            }


def _median_trial(collection: Collection, cell: StoredCell) -> int:
    """Returns the trial of median error among those whose tracks are stored; a failure is the
    largest error."""
    stored = collection.load(cell, ("crlb_distance",), (COLUMN,))
    kept = [i for i, text in enumerate(stored.get(COLUMN, ())) if text]
    if not kept:
        return -1
    errors = np.nan_to_num(stored["crlb_distance"][kept], nan=np.inf)
    middle = np.argsort(errors, kind="stable")[(len(kept) - 1) // 2]
    return int(stored["trial"][kept[middle]])


def _values(collection: Collection, cell: StoredCell, trial: int, epochs: int) -> Array | None:
    """Returns what is stored of a trial (K, columns); None if nothing is."""
    stored = collection.load(cell, (), (COLUMN,))
    here = np.flatnonzero(stored["trial"] == trial)
    if COLUMN not in stored or not len(here):
        return None
    text: Any = stored[COLUMN][here[0]]
    return read_text(text, epochs) if text else None
