"""The rivals of the table compute the same."""

from __future__ import annotations

import c_kernel
import numpy as np
import pytest

from ipe_bench.measurements import Gins, LotkaVolterra


@pytest.mark.skipif(c_kernel.compiler() is None, reason="no C compiler")
@pytest.mark.parametrize(
    ("model", "steps", "spread"), [(Gins(step=180.0), 1, 33.0), (LotkaVolterra(step=0.25), 4, 0.3)], ids=str
)
@pytest.mark.parametrize("trials", [1, 3, 8])
def test_the_kernel_in_c_is_the_generated_one(model, steps: int, spread: float, trials: int) -> None:
    x = model.nominal + spread * np.random.default_rng(0).normal(size=(trials, model.n))
    z = model.simulate(x)
    np.testing.assert_allclose(c_kernel.simulator(model, steps)(x), z, rtol=0, atol=1e-11 * np.abs(z).max())
