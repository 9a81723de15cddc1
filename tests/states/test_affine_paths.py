"""Affine models about paths: against one dense system of all their equations."""

from __future__ import annotations

from contextlib import nullcontext

import numpy as np
import pytest
from shared.by_numpy import by_numpy
from shared.oracles import assert_agrees

from ipe_bench.states.affine_paths import Noise, Tangents

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


def noise(G):
    start = np.zeros((_N, _N))
    start[:, :1] = G[0]
    return Noise(start, G[1:])


def states(A, B, D, G, a, v):
    return noise(G).states(Tangents(A, B), a, v, D)


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


def hessian(A, B, G):
    """log det of the Hessian of half the cost in the noise."""
    T = np.zeros((_N, _EPOCHS))
    H = np.eye(_EPOCHS)
    for k in range(_EPOCHS):
        if k:
            T = A[k - 1] @ T
        T[:, k] = G[k, :, 0]
        if k:
            H += (B[k - 1] @ T).T @ (B[k - 1] @ T)
    return np.linalg.slogdet(H)[1]


@pytest.fixture(params=["machine code", "NumPy"])
def engine(request):
    with by_numpy() if request.param == "NumPy" else nullcontext():
        yield


@pytest.mark.oracle(
    "own second implementation: dense Gaussian elimination", "affine models about paths", 1e-9
)
@pytest.mark.usefixtures("engine")
def test_a_chain_fulfils_all_its_equations_at_once():
    given = chains(11)
    x = states(*given)
    A, B, D, G, a, v = given
    exact = [dense(*one[:3], G, *one[3:]) for one in zip(A, B, D, a, v, strict=True)]
    assert_agrees(x, np.array(exact), rtol=1e-9, atol=1e-9)


@pytest.mark.usefixtures("engine")
def test_a_wide_start_costs_no_digits():
    """A start of variance 1e16 that two readings settle: x is what they say, to more than half of
    the digits."""
    of = Tangents(np.array([[[[1.0, 1.0], [0.0, 1.0]]] * 2]), np.array([[[[1e4, 0.0]]] * 2]))
    wide = Noise(1e8 * np.eye(2), np.zeros((2, 2, 1)))
    v = 1e4 * np.array([[[3.0], [5.0]]])
    x = wide.states(of, np.zeros((1, 3, 2)), v)
    P = wide.spread(of).covariance
    np.testing.assert_allclose(x[0], [[1.0, 2.0], [3.0, 2.0], [5.0, 2.0]], rtol=1e-12)
    np.testing.assert_allclose(P[0, 2], 1e-8 * np.array([[1.0, 1.0], [1.0, 2.0]]), rtol=1e-6)


@pytest.mark.oracle(
    "own second implementation: the inverse of all equations", "covariances about paths", 1e-9
)
@pytest.mark.usefixtures("engine")
def test_covariances_of_a_chain_are_those_of_all_its_equations_at_once():
    A, B, _, G, _, _ = chains(11)
    P, crossed, log_determinant = noise(G).spread(Tangents(A, B))
    exact = [dense_covariances(*one, G) for one in zip(A, B, strict=True)]
    assert_agrees(P, np.array([one for one, _ in exact]), rtol=1e-9, atol=1e-9)
    assert_agrees(crossed, np.array([one for _, one in exact]), rtol=1e-9, atol=1e-9)
    sizes = [hessian(*one, G) for one in zip(A, B, strict=True)]
    np.testing.assert_allclose(log_determinant, sizes, rtol=1e-12)


@pytest.mark.usefixtures("engine")
def test_a_state_that_later_readings_settle_costs_no_digits():
    """A start of variance 1e16 that two later readings settle: of x, p and the sum of both are
    read."""
    of = Tangents(np.array([[[[1.0, 1.0], [0.0, 1.0]]] * 2]), np.array([[[[1.0, 0.0]]] * 2]))
    P = Noise(1e8 * np.eye(2), np.zeros((2, 2, 1))).spread(of).covariance
    np.testing.assert_allclose(P[0, 0], [[5.0, -3.0], [-3.0, 2.0]], rtol=1e-12)


def results(given):
    A, B, _, G, a, _ = given
    of = Tangents(A, B)
    all_of = noise(G)
    return states(*given), all_of.blind_variances(of), all_of.doubt(of, a), *all_of.spread(of)


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


@pytest.mark.usefixtures("engine")
def test_covariances_do_not_read_memory_that_nothing_was_written_to(monkeypatch):
    """Whose numbers may overflow: nothing leads to the first states."""
    monkeypatch.setattr(np, "empty", lambda shape: np.full(shape, np.inf))
    A, B, _, G, _, _ = chains(11)
    found = noise(G).spread(Tangents(A, B))
    assert all(np.isfinite(one).all() for one in found)
