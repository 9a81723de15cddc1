"""Chains of epochs: against one dense system of all their equations."""

from __future__ import annotations

from contextlib import nullcontext

import numpy as np
import pytest
from shared import chains_by_numpy
from shared.by_numpy import by_numpy
from shared.oracles import assert_agrees

from ipe_bench.engine.chains import filtered_chains, lower, smoothed_chains, solve_chains

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


def equations(A, B, D, G, a, v):
    """All equations of one trial as a matrix and its right sides."""
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
    return whole, np.concatenate([a.ravel(), g])


def dense(*given):
    """x of one trial by Gaussian elimination of all equations."""
    whole, right = equations(*given)
    return np.linalg.solve(whole, right)[: _EPOCHS * _N].reshape(_EPOCHS, _N)


def dense_covariances(A, B, G):
    """The covariances of x at all epochs, and those with the last x, by the inverse of all
    equations."""
    nothing = np.zeros((_EPOCHS, _N))
    whole, _ = equations(A, B, nothing, G, nothing, np.zeros((_EPOCHS - 1, _M)))
    # The covariance is what leads from the right sides B' v to x.
    inverse = np.linalg.inv(whole)
    size = _EPOCHS * _N
    V = inverse[:size, size:].reshape(_EPOCHS, _N, _EPOCHS, _N)
    each = np.arange(_EPOCHS)
    return V[each, :, each], V[:, :, -1]


@pytest.fixture(params=["machine code", "NumPy"])
def engine(request):
    with by_numpy() if request.param == "NumPy" else nullcontext():
        yield


@pytest.mark.oracle(
    "own second implementation: dense Gaussian elimination", "chains of epochs", 1e-9
)
@pytest.mark.usefixtures("engine")
def test_a_chain_fulfils_all_its_equations_at_once():
    given = chains(11)
    x = solve_chains(*given)
    A, B, D, G, a, v = given
    exact = [dense(*one[:3], G, *one[3:]) for one in zip(A, B, D, a, v, strict=True)]
    assert_agrees(x, np.array(exact), rtol=1e-9, atol=1e-9)


def test_the_first_pass_through_a_chain_is_right_without_the_second(monkeypatch):
    """What the second pass solves for is what the first leaves: here it is nothing, whatever the
    first found."""

    def leave_nothing(chain, _):
        chain.a[:] = 0.0
        chain.v[:] = 0.0

    given = chains(11)
    right = solve_chains(*given)
    monkeypatch.setattr(chains_by_numpy, "_refine", leave_nothing)
    np.testing.assert_allclose(chains_by_numpy.solve_chains(*given), right, rtol=1e-9, atol=1e-9)


@pytest.mark.usefixtures("engine")
def test_a_wide_start_costs_no_digits():
    """A start of variance 1e16 that two readings settle: x is what they say, to more than half of
    the digits."""
    A, B = np.array([[[[1.0, 1.0], [0.0, 1.0]]] * 2]), np.array([[[[1e4, 0.0]]] * 2])
    G, nothing = np.zeros((3, 2, 2)), np.zeros((1, 3, 2))
    G[0] = 1e8 * np.eye(2)
    v = 1e4 * np.array([[[3.0], [5.0]]])
    x = solve_chains(A, B, nothing, G, nothing, v)
    P = filtered_chains(A, B, G)
    np.testing.assert_allclose(x[0], [[1.0, 2.0], [3.0, 2.0], [5.0, 2.0]], rtol=1e-12)
    np.testing.assert_allclose(P[0, 2], 1e-8 * np.array([[1.0, 1.0], [1.0, 2.0]]), rtol=1e-6)


@pytest.mark.oracle(
    "own second implementation: the inverse of all equations", "covariances of chains", 1e-9
)
@pytest.mark.usefixtures("engine")
def test_covariances_of_a_chain_are_those_of_all_its_equations_at_once():
    A, B, _, G, _, _ = chains(11)
    P, crossed = smoothed_chains(A, B, G)
    exact = [dense_covariances(*one, G) for one in zip(A, B, strict=True)]
    assert_agrees(P, np.array([one for one, _ in exact]), rtol=1e-9, atol=1e-9)
    assert_agrees(crossed, np.array([one for _, one in exact]), rtol=1e-9, atol=1e-9)
    # At the last epoch no reading is later.
    np.testing.assert_array_equal(P[:, -1], filtered_chains(A, B, G)[:, -1])


@pytest.mark.usefixtures("engine")
def test_a_state_that_later_readings_settle_costs_no_digits():
    """A start of variance 1e16 that two later readings settle: of x, p and the sum of both are
    read."""
    A, B = np.array([[[[1.0, 1.0], [0.0, 1.0]]] * 2]), np.array([[[[1.0, 0.0]]] * 2])
    G = np.zeros((3, 2, 2))
    G[0] = 1e8 * np.eye(2)
    P, _ = smoothed_chains(A, B, G)
    np.testing.assert_allclose(P[0, 0], [[5.0, -3.0], [-3.0, 2.0]], rtol=1e-12)


def results(given):
    A, B, _, G, _, _ = given
    return solve_chains(*given), filtered_chains(A, B, G), *smoothed_chains(A, B, G)


@pytest.mark.usefixtures("engine")
def test_a_trial_that_is_not_finite_leaves_nothing_to_those_in_its_place_of_later_vectors():
    given = chains(20)
    before = results(given)
    given[0][2, 0] = np.nan
    others = np.arange(20) != 2
    for one, after in zip(before, results(given), strict=True):
        np.testing.assert_array_equal(after[others], one[others])


@pytest.mark.usefixtures("engine")
def test_a_trial_has_the_same_bits_alone_and_beside_one_that_is_not_finite():
    A, B, D, G, a, v = chains(10)
    A[4, 2] = np.nan
    together = results((A, B, D, G, a, v))
    assert not np.isfinite(together[0][4]).all()
    for some in (slice(3, 4), slice(5, 10)):
        alone = results((A[some], B[some], D[some], G, a[some], v[some]))
        for one, whole in zip(alone, together, strict=True):
            np.testing.assert_array_equal(one, whole[some])


@pytest.mark.parametrize("places", [(0, 1, 2, 3), (1, 2, 0, 3), (3, 0, 2, 1)])
def test_a_triangular_root_keeps_the_digits_of_small_columns_beside_large_ones(places):
    """Its determinant is that of W W', by all minors of W (Cauchy and Binet): reflections that meet
    the small columns first lose seven digits of it."""
    w = 2**30
    W = np.array([[0, w, w, 0], [2, w, 0, 1], [1, 0, w, 1]])
    minors = [-3 * w**2, -w, -w, -2 * w**2]
    F = lower(np.stack([W[:, places], np.zeros_like(W)]).astype(float))
    squared = float(sum(minor**2 for minor in minors))
    np.testing.assert_allclose(np.prod(np.diagonal(F[0])), np.sqrt(squared), rtol=1e-14)
    np.testing.assert_array_equal(np.triu(F[0], 1), 0.0)
    np.testing.assert_array_equal(F[1], 0.0)
