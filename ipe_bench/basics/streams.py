"""Random streams that belong to a trial: its numbers do not depend on the batch."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence

import numpy as np

from ipe_bench.basics.linalg import Array


def own_bits(seed: int, z: Array) -> np.random.Philox:
    """The bits of one trial, which depend on `seed` and its readings z (m,), and on nothing else in the batch."""
    digest = hashlib.sha256(np.ascontiguousarray(z, dtype=float).tobytes()).digest()
    return np.random.Philox(np.random.SeedSequence([seed, *np.frombuffer(digest, dtype=np.uint32).tolist()]))


def own_generators(seed: int, z: Array) -> list[np.random.Generator]:
    """A generator for each trial of readings z (trials, m); see `own_bits`."""
    return [np.random.Generator(own_bits(seed, row)) for row in z]


def normals(generators: Sequence[np.random.Generator], *shape: int) -> Array:
    """Standard normal numbers (trials, *shape), each trial's from its own generator."""
    return np.array([g.standard_normal(shape) for g in generators]).reshape(len(generators), *shape)


def numbered(seed: int, start: int, stop: int, child: int) -> Iterator[np.random.Generator]:
    """A generator for each of the trials start to stop; a trial has as many streams as there are children."""
    for trial in range(start, stop):
        yield np.random.Generator(np.random.Philox(np.random.SeedSequence(seed, spawn_key=(trial, child))))
