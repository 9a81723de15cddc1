"""Random streams that belong to a trial: its numbers do not depend on the batch."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence

import numpy as np

from ipe_bench.basics.linalg import Array


def generator(seed: int | np.random.SeedSequence) -> np.random.Generator:
    """Makes the generator of a seed."""
    return np.random.Generator(np.random.Philox(seed))


def own_generators(seed: int, z: Array) -> list[np.random.Generator]:
    """Makes a generator for each trial of z (trials, m), which depends on `seed` and on these
    readings alone."""
    generators = []
    for row in z:
        readings = np.ascontiguousarray(row, dtype=float).tobytes()
        digest = hashlib.sha256(readings).digest()
        words = np.frombuffer(digest, dtype=np.uint32).tolist()
        generators.append(generator(np.random.SeedSequence([seed, *words])))
    return generators


def normals(generators: Sequence[np.random.Generator], *shape: int) -> Array:
    """Draws standard normal numbers (trials, *shape), each trial's from its own generator."""
    drawn = [own.standard_normal(shape) for own in generators]
    return np.array(drawn).reshape(len(generators), *shape)


def numbered(seed: int, start: int, stop: int, child: int) -> Iterator[np.random.Generator]:
    """Makes a generator for each of the trials start to stop; a trial has as many streams as there
    are children."""
    for trial in range(start, stop):
        yield generator(np.random.SeedSequence(seed, spawn_key=(trial, child)))
