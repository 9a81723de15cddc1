"""Statistical linear regression by points in machine code: against its formulas in NumPy."""

from __future__ import annotations

import numpy as np
import pytest
from shared.by_numpy import by_numpy

from ipe_bench.engine.rows import products
from ipe_bench.states import linearisation

RULES = [
    linearisation.Unscented(),
    linearisation.Unscented(kappa=-1.0, alpha=0.5, beta=2.0),
    linearisation.Cubature(),
    linearisation.GaussHermite(),
]


def curve(x):
    return np.concatenate([np.sin(x) + x[..., :1] ** 2, x[..., :1] * x[..., 1:2]], axis=-1)


def normals(trials=19, n=4):
    """Means and covariances; the second has a state that is known, the third is indefinite, and the
    fourth is not finite."""
    rng = np.random.default_rng(3)
    G = rng.normal(size=(trials, n, n))
    G[1, 2] = 0.0
    P = np.matmul(G, G.mT)
    P[2] *= -1.0
    P[3] = np.nan
    return rng.normal(size=(trials, n)), P


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: type(rule).__name__)
def test_a_regression_by_points_is_that_of_numpy(rule):
    m, P = normals()
    found = rule.linearise(curve, m, P)
    with by_numpy():
        right = rule.linearise(curve, m, P)
    for one, other in zip(found, right, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-11)
    # Only what is no covariance has no law.
    assert np.flatnonzero(~np.isfinite(found.W).all(axis=(1, 2))).tolist() == [2, 3]


def test_a_regression_has_the_same_bits_alone():
    m, P = normals()
    rule = RULES[1]
    together = rule.linearise(curve, m, P)
    for i in range(len(m)):
        alone = rule.linearise(curve, m[i : i + 1], P[i : i + 1])
        for one, other in zip(alone, together, strict=True):
            np.testing.assert_array_equal(one[0], other[i])


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
