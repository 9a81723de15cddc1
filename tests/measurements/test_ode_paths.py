"""Every path that computes readings or slopes of differential equations, against closed forms and SciPy."""

from __future__ import annotations

import numpy as np
import pytest

from ipe_bench.measurements import LotkaVolterra, Ode


def test_a_reading_at_the_start_is_the_state_at_the_start():
    model = Ode({"y": "-k*y"}, {"k": 0.25, "y0": 2.0}, {"y": "y0"}, times=(0.0, 1.0, 2.0, 3.0))
    hares = LotkaVolterra(sampled=(0.0, 1.0, 2.0))
    for scale in (1.0, 3.0, 0.5, 1.0):
        x = np.array([[scale, 1.0], [1.0, scale]])
        t, k, y0 = np.arange(4.0), 0.25 * x[:, :1], 2.0 * x[:, 1:]
        np.testing.assert_allclose(model.simulate(x), y0 * np.exp(-k * t), atol=1e-7)
        slopes = np.stack([-0.25 * t * y0 * np.exp(-k * t), 2.0 * np.exp(-k * t)], axis=2)
        np.testing.assert_allclose(model.jacobian(x), slopes, atol=1e-6)
        start = hares.simulate(scale * hares.nominal[None])[0, :2]
        assert start == pytest.approx([34.0 * scale, 5.9 * scale], rel=1e-14)
