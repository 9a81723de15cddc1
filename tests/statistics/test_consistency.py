"""NEES, limits and the verdict, against simulated truth and published values."""

from __future__ import annotations

import numpy as np
import pytest

from ipe_bench.statistics.consistency import clopper_pearson, mean_limits, verdict
from ipe_bench.trials.scoring import nees


def draw(trials: int, claimed: float = 1.0, seed: int = 0):
    """Errors of covariance A A', and a reported covariance that is `claimed` squared times that."""
    rng = np.random.default_rng(seed)
    A = np.array([[3.0, 0.0, 0.0], [1.0, 1e-4, 0.0], [0.5, 2e-4, 1e-6]])
    error = rng.standard_normal((trials, 3)) @ A.T
    return error, np.repeat(claimed**2 * (A @ A.T)[None], trials, axis=0)


def test_limits_are_those_of_the_textbook():
    """Bar-Shalom, Li, Kirubarajan, example 5.4.2: 50 runs of 2 degrees, [74.2, 129.6] / 50 for the sum over runs."""
    low, high = mean_limits(2, 50)
    assert 2 * low == pytest.approx(74.22 / 50, abs=5e-4)
    assert 2 * high == pytest.approx(129.56 / 50, abs=5e-4)


def test_clopper_pearson_of_no_failure():
    """The rule of three, exactly: none in n is below 1 - 0.025^(1/n)."""
    assert clopper_pearson(0, 100) == (0.0, pytest.approx(1 - 0.025**0.01))
    assert clopper_pearson(100, 100) == (pytest.approx(0.025**0.01), 1.0)


def test_limits_hold_what_they_promise():
    """Of 400 repetitions with 20 trials each, 95 % lie within, by more than 4 deviations of the binomial."""
    low, high = mean_limits(3, 20)
    means = np.array([nees(*draw(20, seed=s)).mean() / 3 for s in range(400)])
    assert abs(np.mean((means > low) & (means < high)) - 0.95) < 4 * np.sqrt(0.05 * 0.95 / 400)


@pytest.mark.parametrize(
    ("claimed", "expected"),
    [(1.0, "consistent"), (1.5, "pessimistic"), (0.8, "optimistic"), (0.05, "diverged but confident")],
)
def test_verdict(claimed, expected):
    values = nees(*draw(1000, claimed))
    assert verdict(values, 3) == expected
    assert values.mean() / 3 == pytest.approx(1 / claimed**2, rel=0.1)


def test_a_few_divergences_that_chance_does_not_explain_are_named():
    error, P = draw(1000)
    error[:30] *= 1e3
    assert verdict(nees(error, P), 3) == "diverged but confident"
    P[:30] *= 1e6  # the same errors, owned up to
    assert verdict(nees(error, P), 3) == "consistent"


def test_divergences_that_may_be_one_in_a_hundred_are_not_named_so():
    error, P = draw(1000)
    error[:10] *= 1e3
    assert verdict(nees(error, P), 3) == "optimistic"


def test_what_is_no_covariance_or_no_estimate():
    error, P = draw(6)
    P[0] = np.nan
    P[1] = -P[1]
    P[2] = np.array([[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    P[3] = np.ones((3, 3))
    error[4] = np.nan
    values = nees(error, P)
    assert np.isnan(values[0])
    assert np.isinf(values[1:5]).all()
    assert np.isfinite(values[5])
    # One made no claim, and of five claims four are beyond any gate.
    assert verdict(values, 3) == "diverged but confident"


def test_nothing_claimed_nothing_judged():
    assert verdict(np.full(5, np.nan), 3) == "-"
