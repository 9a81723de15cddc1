"""Columns of Arrow as arrays of NumPy, without what Arrow itself would load for it."""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from ipe_bench.basics.linalg import Array


def as_array(column: pa.ChunkedArray) -> Array:
    """A column as an array. Arrow's own `to_numpy` would import pandas, half a second that a short run can do without.

    Numbers, flags and texts as the store writes them; a missing one is NaN or None, as with Arrow.
    """
    parts = [_of(chunk) for chunk in column.chunks]
    return parts[0] if len(parts) == 1 else np.concatenate(parts) if parts else np.empty(0)


def _of(chunk: pa.Array) -> Array:
    kind, start, stop = chunk.type, chunk.offset, chunk.offset + len(chunk)
    if pa.types.is_string(kind) or pa.types.is_large_string(kind):
        # A million words are few different ones, each kept once.
        coded = chunk.dictionary_encode(null_encoding="encode")
        return np.array(coded.dictionary.to_pylist(), dtype=object)[_of(coded.indices)]
    if chunk.null_count or not (pa.types.is_boolean(kind) or pa.types.is_integer(kind) or pa.types.is_floating(kind)):
        return chunk.to_numpy(zero_copy_only=False)
    data = chunk.buffers()[1]
    if pa.types.is_boolean(kind):
        bits = np.frombuffer(data, dtype=np.uint8)
        return np.unpackbits(bits, bitorder="little")[start:stop].astype(bool)
    return np.frombuffer(data, dtype=kind.to_pandas_dtype())[start:stop]
