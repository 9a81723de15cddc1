"""Intervals cover what they claim to cover."""

import numpy as np
import pytest
from scipy.stats import binom

from ipe_bench.statistics.consistency import clopper_pearson, mean_limits
from ipe_bench.statistics.intervals import bootstrap_rms, quantile, quantiles


@pytest.mark.parametrize("p", [0.01, 0.3, 0.5, 0.97])
def test_clopper_pearson_covers_at_least_its_level(p):
    n = 40
    covered = sum(binom.pmf(k, n, p) for k in range(n + 1) if clopper_pearson(k, n)[0] <= p <= clopper_pearson(k, n)[1])
    assert covered >= 0.95


def test_clopper_pearson_has_closed_ends():
    # With no success the upper end solves (1 - p)^n = 0.025.
    assert clopper_pearson(0, 50) == (0.0, pytest.approx(1 - 0.025 ** (1 / 50), rel=1e-12))
    assert clopper_pearson(50, 50) == (pytest.approx(0.025 ** (1 / 50), rel=1e-12), 1.0)


def test_bootstrap_interval_has_the_width_of_theory():
    # The rms of N normal errors has a relative deviation of 1 / sqrt(2 N), whichever way it is resampled.
    rng = np.random.default_rng(1)
    for trials in (1500, 40_000):
        e = rng.normal(size=(trials, 3)) * [1.0, 2.0, 3.0]
        low, high = bootstrap_rms(e**2, np.ones(trials, dtype=bool))
        np.testing.assert_allclose((high - low) / [1, 2, 3], 2 * 1.96 / np.sqrt(2 * trials), rtol=0.2)


def test_bootstrap_uses_only_the_trials_it_is_told_to():
    squares = np.ones((100, 1))
    used = np.arange(100) % 2 == 0
    squares[~used] = np.nan
    low, high = bootstrap_rms(np.where(used[:, None], squares, 0.0), used)
    assert low[0] == high[0] == 1.0
    assert np.isnan(bootstrap_rms(squares, np.zeros(100, dtype=bool))).all()


@pytest.mark.slow
@pytest.mark.parametrize("trials", [200, 4000])
def test_bootstrap_interval_covers_the_truth_in_95_per_cent_of_repeats(trials):
    rng = np.random.default_rng(2)
    repeats = 400
    hits = 0
    for _ in range(repeats):
        e = rng.normal(size=(trials, 1))
        used = rng.random(trials) < 0.8
        low, high = bootstrap_rms(e**2, used)
        hits += low[0] <= 1.0 <= high[0]
    # Four standard deviations of a binomial share, and a percentile interval's known small shortfall.
    assert 0.95 - 4 * np.sqrt(0.95 * 0.05 / repeats) - 0.01 <= hits / repeats <= 0.99


def test_nees_of_honest_covariance_lies_within_its_limits_19_times_in_20():
    rng = np.random.default_rng(3)
    low, high = mean_limits(4, 50)
    means = (rng.normal(size=(4000, 50, 4)) ** 2).mean(axis=(1, 2))
    assert ((means >= low) & (means <= high)).mean() == pytest.approx(0.95, abs=0.015)


def test_quantiles_are_numpys_where_all_is_finite_and_infinite_where_it_is_not():
    values = np.random.default_rng(4).exponential(size=101)
    q = np.linspace(0, 1, 41)
    np.testing.assert_allclose(quantiles(values, q), np.quantile(values, q), rtol=1e-12)
    np.testing.assert_allclose([quantile(values, p) for p in q], np.quantile(values, q), rtol=1e-12)
    half = np.array([1.0, 2.0, np.nan, np.inf])
    assert quantile(half, 0.0) == 1.0
    assert quantile(half, 1 / 3) == 2.0
    assert quantile(half, 0.5) == np.inf
    assert quantile(half, 1.0) == np.inf
    assert np.isnan(quantile(np.empty(0), 0.5))
