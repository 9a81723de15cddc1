"""Functions of rows in machine code."""

from __future__ import annotations

import numpy as np

from ipe_bench.engine.rows import products


def test_products_of_stacks_are_those_of_each_matrix():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(5, 7, 3))
    for M in (rng.normal(size=(7, 2, 3)), rng.normal(size=(5, 7, 2, 3))):
        np.testing.assert_allclose(products(M, x), np.einsum("...ij,...j->...i", M, x), atol=1e-14)
    H = rng.normal(size=(5, 7, 3, 4))
    M = rng.normal(size=(5, 7, 2, 3))
    np.testing.assert_allclose(products(M, H), np.matmul(M, H), atol=1e-14)
    # Without process noise there is no column.
    assert products(np.zeros((7, 0, 3)), x).shape == (5, 7, 0)
