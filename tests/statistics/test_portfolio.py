"""The virtual best and the single best on made-up outcomes."""

import numpy as np
import pytest

from ipe_bench.statistics.comparisons import Outcomes
from ipe_bench.statistics.portfolio import pooled, portfolio_row


def outcomes(success, cost, ids=None):
    success = np.array(success, dtype=bool)
    ids = np.arange(len(success)) if ids is None else np.array(ids)
    return Outcomes(ids, np.where(success, 1.0, np.inf), success, np.array(cost, dtype=float))


def test_the_virtual_best_succeeds_where_any_does_at_the_cheapest_cost():
    row = portfolio_row(
        {
            "quick": outcomes([1, 1, 0, 0, 0], [2, 2, 2, 2, 2]),
            "slow": outcomes([1, 1, 1, 0, 1], [50, 50, 50, 50, 70]),
            "auto": outcomes([1, 1, 1, 0, 0], [3, 3, 40, 90, 90]),
        }
    )
    assert row["virtual_success"] == 0.8
    assert row["virtual_cost"] == 40  # of 2, 2, 40, endless and 70
    assert (row["single"], row["single_success"], row["single_cost"]) == ("slow", 0.8, 50)
    assert (row["auto_success"], row["auto_cost"]) == (0.6, 40)
    # Clopper and Pearson for 4 of 5.
    assert (row["virtual_low"], row["virtual_high"]) == pytest.approx((0.2836, 0.9949), abs=1e-4)


def test_of_equally_successful_estimators_the_cheapest_is_the_single_best():
    row = portfolio_row({"dear": outcomes([1, 1, 1], [9, 9, 9]), "cheap": outcomes([1, 1, 1], [4, 4, 99])})
    assert (row["single"], row["single_cost"], row["virtual_cost"]) == ("cheap", 4, 4)
    assert np.isnan(row["auto_success"])


def test_half_without_success_cost_endlessly_much():
    row = portfolio_row({"a": outcomes([1, 0, 0], [5, 5, 5]), "b": outcomes([0, 0, 0], [1, 1, 1])})
    assert (row["virtual_success"], row["virtual_cost"]) == (pytest.approx(1 / 3), np.inf)


def test_only_common_trials_count_and_one_estimator_is_no_choice():
    row = portfolio_row({"a": outcomes([1, 0], [1, 1], [0, 1]), "b": outcomes([1, 1], [2, 2], [1, 2])})
    assert (row["trials"], row["virtual_success"]) == (1, 1.0)
    assert portfolio_row({"a": outcomes([1], [1])}) == {}
    assert portfolio_row({"a": outcomes([1], [1], [0]), "b": outcomes([1], [1], [1])}) == {}


def test_scenarios_are_pooled_trial_by_trial():
    first = {"a": outcomes([1, 0], [1, 1]), "b": outcomes([0, 0], [2, 2]), "only here": outcomes([1, 1], [1, 1])}
    second = {"a": outcomes([0, 0], [1, 1]), "b": outcomes([1, 0], [2, 2])}
    row = portfolio_row(pooled([first, second], ["a", "b"]))
    assert (row["trials"], row["virtual_success"], row["single_success"]) == (4, 0.5, 0.25)
