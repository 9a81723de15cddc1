"""Rows of a batch: taking some trials out of it, and putting some into it.

A batch is an array or a list with the trials in front, or a dataclass whose fields are batches. None stays None.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

B = TypeVar("B")


def take(batch: B, kept: NDArray[Any]) -> B:
    """The trials `kept`, a mask (trials,) or indices, of a batch."""
    if isinstance(batch, list):
        return [batch[i] for i in _indices(kept)]  # pyright: ignore[reportReturnType]
    return _each(lambda part: take(part, kept), batch) if is_dataclass(batch) else batch[kept]  # type: ignore[index]


def put(batch: B, where: NDArray[Any], part: B) -> B:
    """A copy of the batch in which the trials `where`, a mask or indices, are those of `part`, in its order; `part`
    itself where the mask holds everywhere."""
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


def _each(change: Callable[..., Any], *batches: Any) -> Any:
    first = batches[0]
    parts = {f.name: tuple(getattr(batch, f.name) for batch in batches) for f in fields(first) if f.init}
    return replace(first, **{name: None if values[0] is None else change(*values) for name, values in parts.items()})


def _indices(rows: NDArray[Any]) -> list[int]:
    return (np.flatnonzero(rows) if rows.dtype == bool else rows).tolist()
