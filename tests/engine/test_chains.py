"""Chains of epochs: against one dense system of all their equations."""

from __future__ import annotations

import numpy as np
import pytest
from shared.oracles import assert_agrees

from ipe_bench.engine import compiled
from ipe_bench.engine.chains import solve_chains

_N, _M, _EPOCHS = 3, 2, 6


def chains(trials, seed=0):
    """A, B, D, G, a and v of chains, their noise of rank 1 and some of their states undamped."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(trials, _EPOCHS - 1, _N, _N))
    B = rng.normal(size=(trials, _EPOCHS - 1, _M, _N))
    D = np.maximum(rng.normal(size=(trials, _EPOCHS, _N)), 0.0)
    G = rng.normal(size=(_EPOCHS, _N, 1))
    a, v = rng.normal(size=(trials, _EPOCHS, _N)), rng.normal(size=(trials, _EPOCHS - 1, _M))
    return A, B, D, G, a, v


def dense(A, B, D, G, a, v):
    """x of one trial by Gaussian elimination of all equations."""
    size = _EPOCHS * _N
    moved, noise, C = np.eye(size), np.zeros((size, size)), np.zeros((size, size))
    g = np.zeros(size)
    for k in range(_EPOCHS):
        here = slice(k * _N, (k + 1) * _N)
        noise[here, here] = G[k] @ G[k].T
        C[here, here] = np.diag(D[k])
        if k:
            before = slice((k - 1) * _N, k * _N)
            moved[here, before] = -A[k - 1]
            C[here, here] += B[k - 1].T @ B[k - 1]
            g[here] = B[k - 1].T @ v[k - 1]
    whole = np.block([[moved, -noise], [C, moved.T]])
    return np.linalg.solve(whole, np.concatenate([a.ravel(), g]))[:size].reshape(_EPOCHS, _N)


@pytest.fixture(params=["machine code", "NumPy"])
def engine(request, monkeypatch):
    if request.param == "NumPy":
        monkeypatch.setattr(compiled, "available", lambda: False)


@pytest.mark.oracle(
    "own second implementation: dense Gaussian elimination", "chains of epochs", 1e-9
)
@pytest.mark.usefixtures("engine")
def test_a_chain_fulfils_all_its_equations_at_once():
    given = chains(11)
    x, _ = solve_chains(*given)
    A, B, D, G, a, v = given
    exact = [dense(*one[:3], G, *one[3:]) for one in zip(A, B, D, a, v, strict=True)]
    assert_agrees(x, np.array(exact), rtol=1e-9, atol=1e-9)


@pytest.mark.usefixtures("engine")
def test_a_wide_start_costs_no_digits():
    """A start of variance 1e16 that two readings settle: x is what they say, to more than half of
    the digits."""
    A, B = np.array([[[[1.0, 1.0], [0.0, 1.0]]] * 2]), np.array([[[[1e4, 0.0]]] * 2])
    G, nothing = np.zeros((3, 2, 2)), np.zeros((1, 3, 2))
    G[0] = 1e8 * np.eye(2)
    v = 1e4 * np.array([[[3.0], [5.0]]])
    x, P = solve_chains(A, B, nothing, G, nothing, v, spread=True)
    np.testing.assert_allclose(x[0], [[1.0, 2.0], [3.0, 2.0], [5.0, 2.0]], rtol=1e-12)
    np.testing.assert_allclose(P[0, 2], 1e-8 * np.array([[1.0, 1.0], [1.0, 2.0]]), rtol=1e-6)


@pytest.mark.parametrize("spread", [False, True])
@pytest.mark.usefixtures("engine")
def test_a_trial_that_is_not_finite_leaves_nothing_to_those_in_its_place_of_later_vectors(spread):
    given = chains(20)
    x, P = solve_chains(*given, spread=spread)
    given[0][2, 0] = np.nan
    after = solve_chains(*given, spread=spread)
    others = np.arange(20) != 2
    np.testing.assert_array_equal(after[0][others], x[others])
    if spread:
        np.testing.assert_array_equal(after[1][others], P[others])


@pytest.mark.usefixtures("engine")
def test_a_trial_has_the_same_bits_alone_and_beside_one_that_is_not_finite():
    A, B, D, G, a, v = chains(10)
    A[4, 2] = np.nan
    x, P = solve_chains(A, B, D, G, a, v, spread=True)
    assert not np.isfinite(x[4]).all()
    for some in (slice(3, 4), slice(5, 10)):
        alone = solve_chains(A[some], B[some], D[some], G, a[some], v[some], spread=True)
        np.testing.assert_array_equal(alone[0], x[some])
        np.testing.assert_array_equal(alone[1], P[some])
