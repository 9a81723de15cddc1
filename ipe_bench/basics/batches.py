"""Takes rows out of a batch, and puts rows into one.

A batch is an array or a list with the trials in front, or a dataclass, a tuple or a dict of batches. None stays None.
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
    return _each(lambda part: take(part, kept), batch) if is_dataclass(batch) else batch[kept]  # type: ignore[index]


def put(batch: B, where: NDArray[Any], part: B) -> B:
    """Copies the batch with the trials `where`, a mask or indices, replaced by those of `part`, in its order; returns
    `part` itself where the mask holds everywhere."""
    if where.dtype == bool and where.all():
        return part
    if isinstance(batch, list):
        replaced: dict[int, Any] = dict(zip(_indices(where), part, strict=True))  # type: ignore[call-overload]
        return [replaced.get(i, row) for i, row in enumerate(batch)]  # pyright: ignore[reportReturnType]
    if is_dataclass(batch):
        return _each(lambda old, new: put(old, where, new), batch, part)
    result = np.copy(batch)  # type: ignore[arg-type]
    result[where] = part
    return result  # pyright: ignore[reportReturnType]


def gather(parts: Sequence[tuple[NDArray[np.intp], B]]) -> B:
    """Gathers the trials at each part's indices into one batch."""
    rows = np.concatenate([rows for rows, _ in parts])
    return (
        parts[0][1]
        if len(parts) == 1
        else take(join([part for _, part in parts]), np.argsort(rows))
    )


def join(batches: Sequence[B]) -> B:
    """Joins batches one after another. Where some lack what others have, numbers of their trials are NaN, and lists of
    rows are empty."""
    first: Any = batches[0]
    leading = fields(first)[0].name if is_dataclass(first) else ""
    sizes = [len(getattr(batch, leading) if leading else batch) for batch in batches]  # type: ignore[arg-type]
    return _joined(batches, sizes)


def _joined(parts: Sequence[Any], sizes: Sequence[int]) -> Any:
    known = next((part for part in parts if part is not None), None)
    if known is None:
        return None
    if is_dataclass(known):
        each = {f.name: [getattr(part, f.name) for part in parts] for f in fields(known) if f.init}
        return replace(known, **{name: _joined(values, sizes) for name, values in each.items()})  # type: ignore[type-var]
    if isinstance(known, dict):
        names = dict.fromkeys(name for part in parts for name in part)
        return {name: _joined([part.get(name) for part in parts], sizes) for name in names}
    if isinstance(known, tuple):
        return type(known)(*[_joined(values, sizes) for values in zip(*parts, strict=True)])
    if isinstance(known, list):
        empty = next((row[:0] for part in parts for row in part or ()), None)
        rows = (
            [empty] * size if part is None else part
            for part, size in zip(parts, sizes, strict=True)
        )
        return [row for several in rows for row in several]
    missing = (np.full((size, *known.shape[1:]), np.nan) for size in sizes)
    # Filled first: np.concatenate takes masks off, and keeps what lies under them.
    filled = (
        m if part is None else np.ma.filled(part, np.nan)
        for m, part in zip(missing, parts, strict=True)
    )
    return np.concatenate(list(filled))


def _each(change: Callable[..., Any], *batches: Any) -> Any:
    first = batches[0]
    parts = {
        f.name: tuple(getattr(batch, f.name) for batch in batches) for f in fields(first) if f.init
    }
    return replace(
        first,
        **{name: None if values[0] is None else change(*values) for name, values in parts.items()},
    )


def _indices(rows: NDArray[Any]) -> list[int]:
    return (np.flatnonzero(rows) if rows.dtype == bool else rows).tolist()
