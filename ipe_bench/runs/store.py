"""What a stored file belongs to, and where it lies: blocks of trials as they come, and one file per
result at the end.

    OUTPUT/trials/KEY-START-STOP.parquet   rows of trials START to STOP of a scenario under an
    estimator, or its truth OUTPUT/runs/RUN.json                   what a run was asked for
    OUTPUT/failed/KEY-START-STOP.json      trials that could not be computed, and why

The rows of one key are a union of ranges. Every file appears complete or not at all, and no locks
are needed. What is there is said by `runs.results`.
"""

from __future__ import annotations

import contextlib
import datetime
import os
import socket
import tempfile
import time
from collections.abc import Collection as Keys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pyarrow as pa

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.machine import library_versions
from ipe_bench.estimators.base import Estimator
from ipe_bench.runs import parts
from ipe_bench.runs.execution import Failure
from ipe_bench.runs.parts import SCHEMA, TRUTH, StoredPart
from ipe_bench.runs.provenance import describe, digest, fingerprint, identified, importable
from ipe_bench.states.trackers import Tracker
from ipe_bench.trials.scenario import Scenario
from ipe_bench.trials.thresholds import HISTORIES

if TYPE_CHECKING:
    from ipe_bench.trials.paths import AnyScenario

_ABANDONED_S = 3600.0
"""Age in s from which a temporary file counts as abandoned."""


@dataclass(frozen=True)
class ResultKey:
    """Identifies what a stored file belongs to: one scenario under one estimator, or its truth."""

    scenario: AnyScenario
    label: str = TRUTH
    estimator: Estimator | Tracker | None = None

    @property
    def components(self) -> list[Any]:
        """The scenario, and the estimator if there is one."""
        return [self.scenario] if self.estimator is None else [self.scenario, self.estimator]

    @cached_property
    def identity(self) -> dict[str, Any]:
        """Identity of what was computed, without the version of the program."""
        return {
            "scenario": describe(self.scenario),
            "label": self.label,
            "estimator": describe(self.estimator),
        }

    @cached_property
    def key(self) -> str:
        """Sixteen hexadecimal digits that stand for the identity, the schema and the numerical
        source, but not for the version: a release that changes no number leaves what is stored
        valid."""
        return digest(
            {"schema": SCHEMA, "identity": self.identity, "source": self.made_by["source"]}
        )

    @cached_property
    def identity_key(self) -> str:
        """Sixteen hexadecimal digits that stand for the identity alone, in whichever files its
        classes stand."""
        return digest(identified(self.identity))

    @cached_property
    def made_by(self) -> dict[str, Any]:
        """The versions of the packages and the digest of the numerical source."""
        return fingerprint(self.components)

    @cached_property
    def importable(self) -> dict[str, Any]:
        """The part of it that a process which computes this result has to agree with."""
        return importable(self.components)

    @property
    def names(self) -> dict[str, Any]:
        """Names for people."""
        scenario = self.scenario
        truth = scenario.truth
        return {
            "measurement": scenario.measurement.name,
            **({} if truth is None else {"truth_measurement": truth.name}),
            "noise": scenario.noise.name,
            "prior": scenario.prior.name,
            "error_scale": scenario.error_scale,
            "seed": scenario.seed,
            "estimator": self.label,
        }

    @cached_property
    def footer(self) -> dict[str, Any]:
        """All that a reader of the file needs to know."""
        scenario = self.scenario
        model = scenario.measurement
        needs = () if self.estimator is None else self.estimator.needs
        return {
            "schema": SCHEMA,
            "key": self.key,
            "identity": self.identity,
            "identity_key": self.identity_key,
            **self.made_by,
            "libraries": library_versions(),
            "names": self.names,
            "bound": "bayes" if "prior" in needs else "crlb",
            **traits(self.estimator),
            "jacobian_cost": float(getattr(model, "jacobian_cost", model.n)),
            "parameters": [describe(p) for p in model.parameters],
            "readings": model.m,
            "about": _about(model),
            "linear_bound": scenario.linear_bound.tolist(),
            **_of_states(scenario),
        }


def _about(model: Any) -> str:
    """Returns the first sentence of a model's docstring; empty if it has none."""
    # An example may follow the first paragraph, and is no part of the sentence.
    paragraph = (type(model).__doc__ or "").partition("\n\n")[0]
    docstring = " ".join(paragraph.split())
    # What a dataclass writes where there is no docstring says nothing.
    if docstring.startswith(f"{type(model).__name__}("):
        return ""
    return docstring.partition(". ")[0].rstrip(".:")


def _of_states(scenario: AnyScenario) -> dict[str, Any]:
    """Returns the times and the number of states of a model that moves; nothing of constants."""
    if isinstance(scenario, Scenario):
        return {}
    return {"times": scenario.model.times.tolist(), "states": scenario.model.n}


def traits(estimator: Any) -> dict[str, Any]:
    """Returns the kind and the look of an estimator or tracker, by which reports tell families
    apart."""
    return {
        "equation": getattr(estimator, "equation", None),
        "family": getattr(estimator, "family", None),
        "look": getattr(estimator, "look", None),
        "sequential": "epochs" in getattr(estimator, "needs", ()),
        "smooths": bool(getattr(estimator, "smooths", False)),
    }


class Store:
    """Holds the results under one output directory."""

    def __init__(self, directory: Path | str) -> None:
        self.directory = Path(directory)
        self.trials = self.directory / "trials"
        self.runs = self.directory / "runs"
        self.failed = self.directory / "failed"

    def prepare(self) -> None:
        """Refuses a folder that cannot be written to, and clears away what writers that were killed
        left half done."""
        try:
            self.trials.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=self.trials):
                pass
        except OSError as error:
            reason = error.strerror or str(error)
            raise UserError(
                f"output={self.directory}: cannot be written to ({reason}); choose another folder"
            ) from None
        for path in (*self.directory.glob(".*.tmp"), *self.directory.glob("*/.*.tmp")):
            with contextlib.suppress(OSError):
                if time.time() - path.stat().st_mtime > _ABANDONED_S:
                    path.unlink()

    def parts(self, keys: Keys[str] | None = None) -> list[StoredPart]:
        """Returns the parts that lie here, or those of these keys, by key and in the order of
        reading."""
        found = []
        with contextlib.suppress(OSError):
            names = os.listdir(self.trials)
            own = names if keys is None else [one for one in names if one.partition("-")[0] in keys]
            parsed = [StoredPart.parse(self.trials / name) for name in own]
            found = [part for part in parsed if part is not None]
        return sorted(found, key=lambda part: (part.key, part.order))

    def write(
        self,
        result: ResultKey,
        start: int,
        stop: int,
        columns: Mapping[str, Array],
        history: Mapping[str, Array] | None = None,
    ) -> None:
        """Stores the rows of trials start to stop, with the iterates of the first trials of all if
        there are any."""
        typed = {name: _typed(name, np.asarray(values)) for name, values in columns.items()}
        table = parts.table_of(typed)
        parts.write(self._path(result, start, stop), table, result.footer, history)
        with contextlib.suppress(OSError):
            self._failure(result, start, stop).unlink()

    def _path(self, result: ResultKey, start: int, stop: int) -> Path:
        return self.trials / f"{result.key}-{start}-{stop}.parquet"

    def has(self, result: ResultKey, start: int, stop: int) -> bool:
        """Tells whether exactly this block is stored."""
        return self._path(result, start, stop).is_file()

    def write_failure(self, result: ResultKey, start: int, stop: int, failure: Failure) -> None:
        """States that these trials could not be computed, and why; the next run tries them
        again."""
        record = {"key": result.key, "identity_key": result.identity_key, "names": result.names}
        record |= {"start": start, "stop": stop, **asdict(failure), "host": socket.gethostname()}
        record["when"] = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
        parts.write_record(self._failure(result, start, stop), record)

    def _failure(self, result: ResultKey, start: int, stop: int) -> Path:
        return self.failed / f"{result.key}-{start}-{stop}.json"

    def write_run(self, identifier: str, record: Mapping[str, Any]) -> Path:
        """States, before any work, what a run is going to compute."""
        path = self.runs / f"{identifier}.json"
        parts.write_record(path, {"run": identifier, **record})
        return path

    def merge(self, key: str) -> int:
        """Makes one part of the parts of a result for each range without gaps; returns how many
        files are gone.

        It may be stopped, or done twice, at any moment, while others read and write in the folder:
        a merged part is on the disk and was read back before those go whose rows it holds, and
        until they do, a reader takes each trial once. If a part is damaged (Unusable) or nothing
        can be written any more (StorageError), all stay as they are.
        """
        found = self.parts({key})
        gone = 0
        if len(found) > 1:
            with contextlib.suppress(FileNotFoundError):  # another run merges the same
                groups = _without_gaps(found)
                gone = sum(_join(group) for group in groups if len(group.members) > 1)
        return gone


def _typed(name: str, values: Array) -> Array:
    """Converts a column to one type for all blocks: numbers that are no counts of trials and
    iterations are floats."""
    if values.dtype.kind in "fiu" and name not in ("trial", "iterations"):
        return values.astype(np.float64)
    return values.astype(np.int64) if values.dtype.kind in "iu" else values


class _Group(NamedTuple):
    """Holds the parts of a range without gaps."""

    footer: Mapping[str, Any]
    members: list[StoredPart]
    schemas: list[pa.Schema]


def _without_gaps(found: Sequence[StoredPart]) -> list[_Group]:
    """Groups parts, in the order of reading, that continue each other with the same footer."""
    groups: list[_Group] = []
    reached = 0
    for part in found:
        footer, schema = part.head()
        if not groups or part.start > reached or footer != groups[-1].footer:
            groups.append(_Group(footer, [], []))
            reached = part.start
        groups[-1].members.append(part)
        groups[-1].schemas.append(schema)
        reached = max(reached, part.stop)
    return groups


def _join(group: _Group) -> int:
    """Writes one part with the rows of a group, unless there is one, and removes the others;
    returns their number."""
    members = group.members
    first = members[0]
    stop = max(part.stop for part in members)
    path = first.path.with_name(f"{first.key}-{first.start}-{stop}.parquet")
    whole = replace(first, path=path, stop=stop)
    if whole not in members:
        schema = pa.unify_schemas(group.schemas)
        history = parts.join_histories(part.history() for part in members if part.start < HISTORIES)
        rows = _rows(members, schema)
        parts.write_groups(path, schema, rows, group.footer, history, lasting=True)
    for _ in whole.groups():
        pass
    others = [part.path for part in members if part != whole]
    for path in others:
        # Another run may have done so; what stays is read once all the same.
        with contextlib.suppress(OSError):
            path.unlink()
    return len(others)


def _rows(group: Sequence[StoredPart], schema: pa.Schema) -> Iterator[pa.Table]:
    """Reads the rows of parts, each trial once, with all columns of the schema."""
    reached = group[0].start
    nothing = pa.Table.from_batches([], schema)
    for part in group:
        at = part.start
        for _, table in part.groups() if part.stop > reached else ():
            fresh = table.slice(max(0, reached - at))
            at += len(table)
            yield pa.concat_tables([nothing, fresh], promote_options="default")
        reached = max(reached, part.stop)


def gaps(covered: Iterable[tuple[int, int]], start: int, stop: int) -> list[tuple[int, int]]:
    """Returns the parts of the range start to stop that no covered range holds."""
    found = []
    reached = start
    for first, last in sorted(covered):
        end = min(first, stop)
        if reached < end:
            found.append((reached, end))
        reached = max(reached, last)
    return [*found, (reached, stop)] if reached < stop else found


def title(names: Mapping[str, Any]) -> str:
    """Words the scenario of a result in a line for people."""
    truth = [f"truth {names['truth_measurement']}"] if "truth_measurement" in names else []
    settings = names["noise"], f"error scale {names['error_scale']:g}", f"seed {names['seed']}"
    return ", ".join([names["measurement"], *truth, *settings])


def describe_names(names: Mapping[str, Any]) -> str:
    """Words a result in a line for people."""
    who = "the truth" if names["estimator"] == TRUTH else names["estimator"]
    return f"{who} on {title(names)}"


def require_results(folders: Sequence[Path | str]) -> list[Path]:
    """Returns folders as paths; refuses one that no run ever wrote to."""
    found = [Path(folder) for folder in folders]
    for folder in found:
        store = Store(folder)
        if not (store.runs.is_dir() or store.trials.is_dir()):
            what = (
                "contains no results of ipe-bench" if folder.exists() else "there is no such folder"
            )
            raise UserError(f"{folder}: {what}; give the output folder of a run")
    return found
