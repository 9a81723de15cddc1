"""A trial has one random stream, wherever a batch begins."""

import numpy as np

from ipe_bench.basics.streams import numbered, own_generators


def test_a_trial_has_one_stream_wherever_it_begins():
    whole = [rng.random() for rng in numbered(0, 0, 30, 0)]
    assert whole[17:20] == [rng.random() for rng in numbered(0, 17, 20, 0)]
    assert len({*whole, *(rng.random() for rng in numbered(0, 0, 30, 1))}) == 60
    # Stored trials are drawn anew to be continued, so the numbers stay what they are.
    assert [float(rng.random()) for rng in numbered(5, 2**32 - 1, 2**32 + 1, 1)] == FIRST


FIRST = [0.8992088812721114, 0.9370506844084436]


def test_a_stream_of_readings_depends_on_these_readings_alone():
    z = np.arange(6.0).reshape(3, 2)
    alone = [own_generators(3, z[i : i + 1])[0].random() for i in range(3)]
    assert [rng.random() for rng in own_generators(3, z)] == alone
    assert len({*alone, own_generators(4, z)[0].random()}) == 4
