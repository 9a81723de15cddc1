"""Takes rows out of a batch, and puts rows into one.

A batch is an array or a list with the trials in front, or a dataclass, a tuple or a dict of
batches. None stays None.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

B = TypeVar("B")


def take(batch: B, kept: NDArray[Any]) -> B:
    """Returns the trials `kept`, a mask (trials,) or indices, of a batch."""
    if isinstance(batch, list):
        return [batch[i] for i in _indices(kept)]  # pyright: ignore[reportReturnType]
    if is_dataclass(batch):
        return _each(lambda part: take(part, kept), batch)
    if isinstance(batch, tuple):
        return type(batch)(*[take(part, kept) for part in batch])
    return batch[kept]  # type: ignore[index]


def put(batch: B, where: NDArray[Any], part: B) -> B:
    """Copies the batch with the trials `where`, a mask or indices, replaced by those of `part`, in
    its order; returns `part` itself where the mask holds everywhere."""
    if where.dtype == bool and where.all():
        return part
    if isinstance(batch, list):
        rows = list(batch)
        for i, row in zip(_indices(where), part, strict=True):  # type: ignore[call-overload]
            rows[i] = row
        return rows  # pyright: ignore[reportReturnType]
    if is_dataclass(batch):
        return _each(lambda old, new: put(old, where, new), batch, part)
    result = np.copy(batch)  # type: ignore[arg-type]
    result[where] = part
    return result  # pyright: ignore[reportReturnType]


def gather(parts: Sequence[tuple[NDArray[np.intp], B]]) -> B:
    """Gathers the trials at each part's indices into one batch."""
    if len(parts) == 1:
        return parts[0][1]
    rows = np.concatenate([rows for rows, _ in parts])
    joined = join([part for _, part in parts])
    # The row that comes first is where the smallest index stands.
    return take(joined, np.argsort(rows))


def join(batches: Sequence[B]) -> B:
    """Joins batches one after another. Where some lack what others have, numbers of their trials
    are NaN, and lists of rows are empty."""
    first: Any = batches[0]
    leading: Sequence[Any] = batches
    if is_dataclass(first):
        name = fields(first)[0].name
        leading = [getattr(batch, name) for batch in batches]
    return _joined(batches, [len(part) for part in leading])


def _joined(parts: Sequence[Any], sizes: Sequence[int]) -> Any:
    known = next((part for part in parts if part is not None), None)
    if known is None:
        return None
    if is_dataclass(known):
        changed = {}
        for f in fields(known):
            if f.init:
                values = [getattr(part, f.name) for part in parts]
                changed[f.name] = _joined(values, sizes)
        return replace(known, **changed)  # type: ignore[type-var]
    if isinstance(known, dict):
        names = dict.fromkeys(name for part in parts for name in part)
        return {name: _joined([part.get(name) for part in parts], sizes) for name in names}
    if isinstance(known, tuple):
        return type(known)(*[_joined(values, sizes) for values in zip(*parts, strict=True)])
    if isinstance(known, list):
        return _joined_rows(parts, sizes)
    arrays = []
    for part, size in zip(parts, sizes, strict=True):
        if part is None:
            part = np.full((size, *known.shape[1:]), np.nan)
        # np.concatenate takes masks off, and keeps what lies under them.
        arrays.append(np.ma.filled(part, np.nan))
    return np.concatenate(arrays)


def _joined_rows(parts: Sequence[Any], sizes: Sequence[int]) -> list[Any]:
    """Joins lists of rows; those of None are as the first row, but empty."""
    empty = next((row[:0] for part in parts for row in part or ()), None)
    joined = []
    for part, size in zip(parts, sizes, strict=True):
        joined += [empty] * size if part is None else part
    return joined


def _each(change: Callable[..., Any], *batches: Any) -> Any:
    """Changes each field of dataclasses but those that are None."""
    first = batches[0]
    changed = {}
    for f in fields(first):
        if f.init:
            values = [getattr(batch, f.name) for batch in batches]
            changed[f.name] = None if values[0] is None else change(*values)
    return replace(first, **changed)


def _indices(rows: NDArray[Any]) -> list[int]:
    if rows.dtype == bool:
        rows = np.flatnonzero(rows)
    return rows.tolist()
