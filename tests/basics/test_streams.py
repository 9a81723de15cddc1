"""A trial's random streams are those that NumPy's SeedSequence and Philox give it, one at a time."""

from __future__ import annotations

import numpy as np
import pytest

from ipe_bench.basics.streams import numbered, spawned_keys


@pytest.mark.parametrize("seed", [0, 1, 2**23 - 1, 2**32 - 1])
@pytest.mark.parametrize("start", [0, 999_990, 2**32 - 5])
@pytest.mark.parametrize("child", [0, 1])
def test_keys_of_many_trials_are_those_of_numpy(seed, start, child):
    """Beyond 2^32 a trial's number takes two words."""
    trials = range(start, start + 10)
    sequences = [np.random.SeedSequence(seed, spawn_key=(trial, child)) for trial in trials]
    expected = [sequence.generate_state(2, np.uint64) for sequence in sequences]
    assert np.array_equal(spawned_keys(seed, start, start + 10, child), expected)
    assert np.array_equal(expected[0], np.random.Philox(sequences[0]).state["state"]["key"])


def test_streams_are_those_of_numpy_whatever_was_drawn_before():
    """Single precision leaves half a word behind, which the next trial must not find."""
    for trial, rng in zip(range(3, 20), numbered(5, 3, 20, 1), strict=True):
        alone = np.random.Generator(np.random.Philox(np.random.SeedSequence(5, spawn_key=(trial, 1))))
        for draw in ("standard_normal", "random", "standard_exponential"):
            assert np.array_equal(getattr(rng, draw)(trial), getattr(alone, draw)(trial))
        assert rng.random(dtype=np.float32) == alone.random(dtype=np.float32)
        assert rng.integers(2**20, dtype=np.uint32) == alone.integers(2**20, dtype=np.uint32)


def test_a_trial_has_one_stream_wherever_it_begins():
    whole = [rng.random() for rng in numbered(0, 0, 30, 0)]
    assert whole[17:20] == [rng.random() for rng in numbered(0, 17, 20, 0)]
    assert len({*whole, *(rng.random() for rng in numbered(0, 0, 30, 1))}) == 60
