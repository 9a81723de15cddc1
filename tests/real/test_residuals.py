"""Tests of residuals against what they promise: false alarms as often as they say, and power where
there is a fault."""

import numpy as np
import pytest
from scipy.stats import binom, chi2, kstest, norm
from shared.oracles import assert_agrees

from ipe_bench.basics.linalg import Covariance
from ipe_bench.real.residuals import DRAWS, explained, normalised, outlier_limit, whiteness
from ipe_bench.trials.whiteness import ljung_box, white_p

M, N = 60, 5
# Smooth columns take low frequencies out of the residuals, which a test with chi-square limits
# would call coloured.
J = np.cos(np.pi * np.outer(np.arange(M) + 0.5, np.arange(N)) / M)
SERIES = np.arange(M).reshape(2, M // 2)


def fitted(noise: np.ndarray, R: Covariance) -> tuple[np.ndarray, np.ndarray]:
    Q = explained(J, R)
    w = R.whiten(noise)
    return w - Q @ (Q.T @ w), Q


def ar1(correlation: float, generator: np.random.Generator, channels: int = 2) -> np.ndarray:
    e = generator.standard_normal((channels, M // channels))
    for t in range(1, M // channels):
        e[:, t] = correlation * e[:, t - 1] + np.sqrt(1 - correlation**2) * e[:, t]
    return e.ravel()


@pytest.mark.parametrize("missing", [0, 10])
def test_white_noise_is_called_coloured_as_often_as_the_level_says(missing):
    fits, level = 400, 0.05
    kept = np.sort(np.random.default_rng(2).choice(M, M - missing, replace=False))
    place = np.full(M, -1)
    place[kept] = np.arange(len(kept))
    Q = explained(J[kept], Covariance(np.ones(len(kept))))
    generator = np.random.default_rng(3)
    p = []
    for _ in range(fits):
        e = generator.standard_normal(len(kept))
        p.append(whiteness(e - Q @ (Q.T @ e), Q, place[SERIES], draws=199))
    alarms = int(np.sum(np.array(p) <= level))
    low, high = binom.ppf([0.0005, 0.9995], fits, level)
    assert low <= alarms <= high


def test_coloured_noise_is_noticed():
    generator = np.random.default_rng(4)
    found = 0
    for _ in range(50):
        w, Q = fitted(ar1(0.6, generator), Covariance(np.ones(M)))
        found += whiteness(w, Q, SERIES, draws=199) <= 0.05
    assert found >= 35


def test_without_parameters_p_is_that_of_ljung_and_box():
    """One long series, nothing fitted: Q is chi-square with as many degrees as lags."""
    e = ar1(0.1, np.random.default_rng(5), channels=1)
    e = np.concatenate([e, np.random.default_rng(6).standard_normal(2000)])
    found = whiteness(e, np.zeros((len(e), 0)), np.arange(len(e))[None])
    r = [np.sum(e[k:] * e[:-k]) / np.sum(e**2) for k in range(1, 11)]
    n = len(e)
    Q = n * (n + 2) * sum(rk**2 / (n - k) for k, rk in enumerate(r, 1))
    assert found == pytest.approx(chi2.sf(Q, 10), abs=5 * np.sqrt(0.25 / DRAWS))


def test_residuals_that_cannot_be_tested():
    assert np.isnan(whiteness(np.full(M, np.nan), np.zeros((M, 0)), SERIES))
    assert np.isnan(whiteness(np.ones(1), np.zeros((1, 0)), np.zeros((1, 1), dtype=int)))


def test_a_single_degree_of_freedom_says_nothing_of_succession():
    """All residuals are multiples of one vector; round-off, or where an estimator stopped, would
    decide."""
    J = np.column_stack([np.ones(3), np.arange(3.0)])
    Q, _ = np.linalg.qr(J)
    w = np.array([1.0, -2.0, 1.0]) + 1e-7 * J[:, 1]
    assert np.isnan(whiteness(w, Q, np.arange(3)[None]))
    assert np.isfinite(whiteness(np.array([1.0, -2.0, 1.0]), Q[:, :1], np.arange(3)[None]))


@pytest.mark.parametrize("correlated", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_normalised_residuals_are_standard_normal_and_flag_a_gross_error(correlated):
    deviations = np.linspace(0.5, 2.0, M)
    R = np.diag(deviations**2)
    if correlated:
        lag = np.abs(np.subtract.outer(np.arange(M), np.arange(M)))
        R = np.outer(deviations, deviations) * 0.6**lag
    L = np.linalg.cholesky(R)
    covariance = Covariance(L if correlated else deviations)
    generator = np.random.default_rng(7)
    values, alarms, fits = [], 0, 1000
    for _ in range(fits):
        w, Q = fitted(L @ generator.standard_normal(M), covariance)
        own = normalised(w, Q, covariance)
        values.append(own[M // 3])
        alarms += (np.abs(own) > outlier_limit(M)).any()
    assert kstest(values, "norm").pvalue > 1e-3
    assert alarms <= binom.ppf(0.9995, fits, 0.01)
    noise = L @ generator.standard_normal(M)
    noise[17] += 10 * deviations[17]
    w, Q = fitted(noise, covariance)
    own = normalised(w, Q, covariance)
    assert np.argmax(np.abs(own)) == 17
    assert abs(own[17]) > outlier_limit(M)


@pytest.mark.oracle("closed form: Baarda's w-test, by plain inverses", "normalised residuals", 1e-8)
def test_normalised_residuals_of_correlated_readings_are_those_of_the_w_test():
    """(R^-1 r)_i over the root of the diagonal of R^-1 - R^-1 J (J' R^-1 J)^-1 J' R^-1, by plain
    inverses."""
    lag = np.abs(np.subtract.outer(np.arange(M), np.arange(M)))
    R = np.outer(np.linspace(0.5, 2.0, M), np.linspace(0.5, 2.0, M)) * 0.8**lag
    inverse = np.linalg.inv(R)
    noise = np.random.default_rng(12).standard_normal(M)
    r = noise - J @ np.linalg.solve(J.T @ inverse @ J, J.T @ inverse @ noise)
    spread = inverse - inverse @ J @ np.linalg.solve(J.T @ inverse @ J, J.T @ inverse)
    covariance = Covariance(np.linalg.cholesky(R))
    found = normalised(covariance.whiten(r), explained(J, covariance), covariance)
    assert_agrees(found, (inverse @ r) / np.sqrt(np.diag(spread)), rtol=1e-8)


def test_nothing_is_said_of_a_reading_that_a_parameter_absorbs():
    alone = np.column_stack([J, np.eye(M)[0]])
    covariance = Covariance(np.ones(M))
    Q = explained(alone, covariance)
    e = np.random.default_rng(8).standard_normal(M)
    own = normalised(e - Q @ (Q.T @ e), Q, covariance)
    assert np.isnan(own[0])
    assert np.isfinite(own[1:]).all()


def test_what_is_explained_does_not_depend_on_units_nor_on_surplus_parameters():
    covariance = Covariance(np.ones(M))
    Q = explained(J, covariance)
    scaled = explained(np.column_stack([J * np.logspace(-9, 9, N), J[:, 0]]), covariance)
    assert scaled.shape == Q.shape
    assert np.allclose(Q @ Q.T, scaled @ scaled.T, atol=1e-12)


@pytest.mark.parametrize("m", [1, 60, 10_000])
def test_one_of_many_good_readings_is_an_outlier_as_often_as_the_level_says(m):
    """To either side, by Bonferroni."""
    assert 2 * m * norm.sf(outlier_limit(m)) == pytest.approx(0.01, rel=1e-9)


@pytest.mark.oracle("closed form: Ljung and Box (1978)", "statistic of whiteness", 1e-12)
def test_the_statistic_of_whiteness_is_ljung_and_boxs():
    """n (n + 2) sum_k r_k^2 / (n - k), with the autocorrelations r_k to lag 10, about a mean of
    0."""
    e, n = np.random.default_rng(4).standard_normal(60), 60
    r = [e[k:] @ e[: n - k] / (e @ e) for k in range(1, 11)]
    Q = n * (n + 2) * sum(one**2 / (n - k) for k, one in enumerate(r, 1))
    found, lags = ljung_box(e[None, None])
    assert_agrees(found[0], Q, rtol=1e-12)
    assert lags[0] == 10


def test_a_lag_without_two_readings_is_no_degree_of_freedom():
    """With every other reading missing, five of ten lags are left: those of the readings that are
    present."""
    e = np.random.default_rng(5).standard_normal((20, 1, 30))
    apart = np.full((20, 1, 60), np.nan)
    apart[:, :, ::2] = e
    assert ljung_box(apart)[1].tolist() == [5.0] * 20
    Q = [
        30 * 32 * sum((s[k:] @ s[:-k] / (s @ s)) ** 2 / (30 - k) for k in range(1, 6))
        for s in e[:, 0]
    ]
    assert white_p(apart) == pytest.approx(chi2.sf(Q, 5), rel=1e-10)
