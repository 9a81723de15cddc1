"""Random streams that belong to a trial: the same numbers in whatever batch the trial stands."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.linalg import Array

_WORD = 1 << 32
_ENTROPY = (0x43B0D7E5, 0x931E8875)
_OUTPUT = (0x8B51F9DD, 0x58F38DED)
"""Of the two hashes of NumPy's SeedSequence: where each one's constant begins, and what multiplies it every time."""
_LEFT, _RIGHT = np.uint32(0xCA01F9DD), np.uint32(0x4973F715)
_MIXED_BEFORE = 16
"""How often the seed, of four words at most, has been hashed before the spawn key comes."""


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
    """The streams Generator(Philox(SeedSequence(seed, spawn_key=(trial, child)))) of trials start to stop.

    One generator, which is set to one stream after another: a trial draws from it before the next one is asked for.
    """
    bits = np.random.Philox(0)
    generator, state = np.random.Generator(bits), bits.state
    for key in spawned_keys(seed, start, stop, child):
        state["state"]["key"] = key
        bits.state = state
        yield generator


def spawned_keys(seed: int, start: int, stop: int, child: int) -> NDArray[np.uint64]:
    """The keys (trials, 2) that Philox takes from SeedSequence(seed, spawn_key=(trial, child)), for `seed` and `child`
    below 2^32.

    SeedSequence is O'Neill's seed_seq (Developing a seed_seq Alternative, 2015), whose numbers NumPy promises not to
    change; here for all trials at once, which takes a twentieth of the time.
    """
    if stop > _WORD:
        sequences = (np.random.SeedSequence(seed, spawn_key=(trial, child)) for trial in range(start, stop))
        return np.array([sequence.generate_state(2, np.uint64) for sequence in sequences], np.uint64).reshape(-1, 2)
    trials = np.arange(start, stop, dtype=np.uint32)
    pool = [np.full(len(trials), word) for word in np.random.SeedSequence(seed).pool]
    constants = _constants(*_ENTROPY, skipped=_MIXED_BEFORE)
    for word in (trials, np.full(len(trials), child, np.uint32)):
        pool = [_folded(_LEFT * mixed - _RIGHT * _hashed(word, constants)) for mixed in pool]
    constants = _constants(*_OUTPUT)
    words = np.stack([_hashed(mixed, constants) for mixed in pool], axis=1)
    return words.astype("<u4").view("<u8").astype(np.uint64)


def _constants(first: int, factor: int, *, skipped: int = 0) -> Iterator[tuple[np.uint32, np.uint32]]:
    """A hash's constant before and after each of its uses, from the one after `skipped` of them on."""
    constant = first * pow(factor, skipped, _WORD) % _WORD
    while True:
        following = constant * factor % _WORD
        yield np.uint32(constant), np.uint32(following)
        constant = following


def _hashed(word: NDArray[np.uint32], constants: Iterator[tuple[np.uint32, np.uint32]]) -> NDArray[np.uint32]:
    before, after = next(constants)
    return _folded((word ^ before) * after)


def _folded(word: NDArray[np.uint32]) -> NDArray[np.uint32]:
    return word ^ word >> np.uint32(16)
