"""Batched algebra beside NumPy's own, one matrix at a time."""

import numpy as np
import pytest
from shared.oracles import assert_agrees

from ipe_bench.basics.linalg import (
    Covariance,
    definite_factor,
    information,
    pseudo_inverse,
    read_only,
)

M, N = 30, 5


def conditioned(condition: float, trials: int = 4) -> np.ndarray:
    """Matrices (trials, M, N) of columns of equal length and about this condition."""
    rng = np.random.default_rng(0)
    Q = np.linalg.qr(rng.normal(size=(trials, M, N)))[0]
    V = np.linalg.qr(rng.normal(size=(trials, N, N)))[0]
    return np.matmul(Q * np.geomspace(1.0, 1.0 / condition, N), V)


@pytest.mark.parametrize("condition", [1.0, 20.0, 900.0, 3e3, 1e6, 1e10])
@pytest.mark.parametrize("units", [1.0, 1e9, 1e40])
def test_a_pseudo_inverse_loses_no_more_digits_than_its_matrix(condition, units):
    """Round-off of eps times the condition, from normal equations that squared; whatever units the
    columns have."""
    H = conditioned(condition) * np.geomspace(1.0, units, N)
    R = Covariance(np.linspace(0.1, 0.3, M))
    found, deficient = pseudo_inverse(H, R)
    assert not deficient.any()
    for A, A_plus in zip(H, found, strict=True):
        scale = np.linalg.norm(A, axis=0)
        expected = np.linalg.pinv(A / scale / R.factor[:, None]) / R.factor
        share = np.linalg.norm(A_plus * scale[:, None] - expected) / np.linalg.norm(expected)
        assert share < 100 * np.finfo(float).eps * min(condition, 1e3) * condition


@pytest.mark.oracle("library: NumPy's solve", "weighted pseudo-inverses", 1e-9)
def test_correlated_readings_are_whitened_first():
    L = np.linalg.cholesky(0.7 ** np.abs(np.subtract.outer(np.arange(M), np.arange(M))))
    H = conditioned(10.0)
    found, _ = pseudo_inverse(H, Covariance(L))
    inverse_R = np.linalg.inv(L @ L.T)
    for A, A_plus in zip(H, found, strict=True):
        assert_agrees(
            A_plus, np.linalg.solve(A.T @ inverse_R @ A, A.T @ inverse_R), rtol=1e-9, atol=1e-12
        )


@pytest.mark.parametrize("rows", [[4, 1, 7], [0, 1, 2], [9]])
def test_the_covariance_of_some_readings_is_their_part_of_that_of_all(rows):
    A = np.random.default_rng(2).normal(size=(10, 10))
    for R in (Covariance(np.linalg.cholesky(A @ A.T)), Covariance(np.abs(A[0]))):
        np.testing.assert_allclose(
            R.restricted(np.array(rows)).matrix(), R.matrix()[np.ix_(rows, rows)], rtol=1e-12
        )


def test_a_matrix_without_full_rank_spoils_its_own_trial_only():
    H = conditioned(10.0, 3)
    H[1, :, 2] = H[1, :, 0]
    H[2, 0, 0] = np.nan
    R = Covariance(np.ones(M))
    found, deficient = pseudo_inverse(H, R)
    assert deficient.tolist() == [False, True, True]
    np.testing.assert_array_equal(found[:1], pseudo_inverse(H[:1], R)[0])
    assert np.isnan(found[1:]).all()


def test_fewer_readings_than_parameters_have_no_full_rank():
    found, deficient = pseudo_inverse(np.ones((2, 3, 4)), Covariance(np.ones(3)))
    assert found.shape == (2, 4, 3)
    assert np.isnan(found).all()
    assert deficient.all()


def test_a_factor_is_refused_where_too_few_digits_are_left():
    J = np.concatenate([conditioned(100.0, 1), conditioned(1e5, 1)])
    U, inverse_U, well = definite_factor(np.matmul(J.swapaxes(1, 2), J))
    assert well.tolist() == [True, False]
    np.testing.assert_allclose(U[0].T @ U[0], J[0].T @ J[0], rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(U[0] @ inverse_U[0], np.eye(N), atol=1e-10)
    assert np.array_equal(U[0], np.triu(U[0]))


@pytest.mark.oracle("library: NumPy's qr", "triangular factors", 1e-11)
@pytest.mark.parametrize("n", [1, 5, 8, 11, 40])
def test_a_factor_is_that_of_a_qr_decomposition_whatever_the_sizes_of_columns(n):
    rng = np.random.default_rng(n)
    J = rng.normal(size=(7, 3 * n, n)) * np.geomspace(1e-9, 1e9, n)
    U, inverse_U, well = definite_factor(np.matmul(J.swapaxes(1, 2), J))
    assert well.all()
    columns = np.linalg.norm(J, axis=1)[:, None, :]
    R = np.linalg.qr(J, mode="r")
    R = R * np.sign(np.diagonal(R, axis1=1, axis2=2))[:, :, None]
    assert_agrees(U / columns, R / columns, rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(
        np.matmul(U, inverse_U), np.broadcast_to(np.eye(n), U.shape), atol=1e-12
    )
    for A in (U, inverse_U):
        assert np.array_equal(A, np.triu(A))
    alone = definite_factor(np.matmul(J[3:4].swapaxes(1, 2), J[3:4]))
    assert all(np.array_equal(a[3:4], b) for a, b in zip((U, inverse_U, well), alone, strict=True))


@pytest.mark.parametrize("n", [3, 12])
def test_a_matrix_that_is_not_definite_has_no_factor_and_spoils_no_other(n):
    G = np.repeat(np.eye(n)[None], 6, axis=0)
    G[1, 1, 1] = -1.0
    G[2, 0, 0] = np.nan
    G[3] = 1.0
    G[4, 2] = G[4, :, 2] = 0.0
    _, _, well = definite_factor(G)
    assert well.tolist() == [True, False, False, False, False, True]


@pytest.mark.oracle("library: NumPy's einsum", "information matrices", 1e-12)
@pytest.mark.parametrize("n", [1, 3, 8, 11, 12, 13, 14])
@pytest.mark.parametrize("m", [1, 7, 240])
def test_information_is_that_of_weighted_rows(n, m):
    rng = np.random.default_rng(n)
    J, R = rng.normal(size=(5, m, n)), Covariance(rng.uniform(0.1, 9.0, m))
    rows, G = J / R.factor[:, None], information(J, R)
    assert_agrees(G, np.einsum("tia,tib->tab", rows, rows), rtol=1e-12, atol=1e-12)
    assert np.array_equal(G, G.swapaxes(1, 2))
    assert np.array_equal(information(J[2:3], R), G[2:3])
    # How the numbers lie in memory is nothing to the bits, nor whether they may be written to.
    assert np.array_equal(information(read_only(J), R), G)
    assert np.array_equal(information(np.asfortranarray(J), R), G)
