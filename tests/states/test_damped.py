"""The damped smoother: what a trial finds does not depend on the dampings of those beside it."""

from __future__ import annotations

import numpy as np

import ipe_bench as ib
from ipe_bench.states.whole_paths import PathDensity


def test_an_undamped_step_has_the_same_bits_alone_and_beside_damped_ones():
    """Rows of damping along the chains count only where some trial of a vector is damped."""
    model = ib.component("state_model/pendulum", count=12)
    density = PathDensity.of(model, model.draw(0, 9).z)
    x = np.random.default_rng(1).normal(size=(9, 13, model.n))
    at = density.settled(x)
    tangents = density.tangents(at)
    damping = np.zeros_like(at.x)
    undamped = density.step(tangents, at, damping)
    damping[[2, 5], 4:] = 0.3
    together = density.step(tangents, at, damping)
    others = np.delete(np.arange(9), [2, 5])
    np.testing.assert_array_equal(together[others], undamped[others])
    assert (together[[2, 5]] != undamped[[2, 5]]).any(axis=(1, 2)).all()
