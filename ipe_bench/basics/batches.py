"""Takes rows out of a batch, and puts rows into one.

A batch is an array or a list with the trials in front, or a dataclass whose fields are batches. None stays None.
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
    return parts[0][1] if len(parts) == 1 else take(_join([part for _, part in parts]), np.argsort(rows))


def _join(batches: Sequence[B]) -> B:
    """Joins batches one after another."""
    first = batches[0]
    if isinstance(first, list):
        return [row for batch in batches for row in batch]  # type: ignore[return-value,union-attr]
    return _each(lambda *parts: _join(parts), *batches) if is_dataclass(first) else np.concatenate(batches)  # type: ignore


def _each(change: Callable[..., Any], *batches: Any) -> Any:
    first = batches[0]
    parts = {f.name: tuple(getattr(batch, f.name) for batch in batches) for f in fields(first) if f.init}
    return replace(first, **{name: None if values[0] is None else change(*values) for name, values in parts.items()})


def _indices(rows: NDArray[Any]) -> list[int]:
    return (np.flatnonzero(rows) if rows.dtype == bool else rows).tolist()
