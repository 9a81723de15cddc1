"""How much worse the second of two is, against a search over the interval, and the trials that each
question is of."""

import numpy as np
import pytest
from scipy.stats import chi2
from shared.synthetic_store import Pretender

from ipe_bench.questions.compare.effects import Effect
from ipe_bench.questions.compare.maths import _loss, compared
from ipe_bench.statistics.collect import collect
from ipe_bench.trials.thresholds import GATE

DEVIATES = np.random.default_rng(0).standard_normal((1000, 3))
BOUND = 0.1


def farther(right, start, low, high):
    """The least and the largest that a start can go away from what is right, over all changes in an
    interval."""
    change = np.linspace(low, high, 100_001)
    moved = np.abs(start + change - right) - np.abs(start - right)
    return pytest.approx((moved.min(), moved.max()), abs=1e-4)


SURE = [(0.4, -0.3, 0.2), (0.4, -1.1, 0.2), (0.4, -1.0, -0.5), (-0.4, 0.1, 0.3), (0.3, -0.9, -0.8)]


@pytest.mark.parametrize(("start", "low", "high"), SURE)
def test_a_bias_is_worse_as_far_as_it_goes_from_0(start, low, high):
    """The first is surely not 0: 1,000 trials of deviation 1e-3."""
    first = start + 1e-3 * DEVIATES[:, 0]
    loss = _loss("bias", Effect(first.mean(), 0.0, 0.0, low, high), first, 3)
    assert loss == farther(0.0, first.mean(), low, high)


@pytest.mark.parametrize(("start", "low", "high"), SURE)
def test_honesty_is_worse_as_far_as_it_goes_from_1_in_logarithms(start, low, high):
    first = np.exp(start) * chi2.ppf((np.arange(4000) + 0.5) / 4000, 3) / 3
    value = first.mean()
    loss = _loss("honesty", Effect(value, 0.0, 0.0, np.exp(low), np.exp(high)), first, 3)
    assert loss == farther(0.0, np.log(value), low, high)


def test_what_may_be_right_counts_as_right():
    """A mean error of .03 deviations in 1,000 trials is 0 within chance, a NEES of .99 is 1."""
    first = DEVIATES[:, 0] - DEVIATES[:, 0].mean() + 0.03
    assert _loss("bias", Effect(0.03, 0.0, 0.0, -0.2, -0.1), first, 3) == farther(
        0.0, 0.0, -0.2, -0.1
    )
    first = 0.99 * chi2.ppf((np.arange(1000) + 0.5) / 1000, 3) / 3
    ends = np.log(1.1), np.log(1.3)
    assert _loss("honesty", Effect(0.99, 0.0, 0.0, 1.1, 1.3), first, 3) == farther(0.0, 0.0, *ends)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_success_that_falls_and_an_error_that_grows_are_worse(sign):
    assert _loss("success", Effect(0.9, 0.8, -0.1, -0.2, 0.05), np.ones(9), 3) == (-0.05, 0.2)
    assert _loss("error", Effect(1.0, 2.0, 2.0, 0.5, 4.0), np.ones(9), 3) == pytest.approx(
        np.log([0.5, 4.0])
    )


def test_bias_is_of_the_trials_in_which_both_succeed(synthetic):
    """The first fails in 100 trials and the second in 100 others, each by an error of 10,000
    deviations."""
    scenario, deviates = synthetic.scenario(), DEVIATES[:400]
    for label, lost in (("a", slice(0, 100)), ("b", slice(100, 200))):
        error = BOUND * (deviates + 0.2 * (label == "b"))
        error[lost] = 1e3
        synthetic.add(scenario, label, error)
    collection = collect([synthetic.directory])
    rows = compared(collection, collection, ("a", "b"), tested=("bias",))
    kept = deviates[200:]
    kept = kept[((kept + 0.2) ** 2).sum(axis=1) <= chi2.isf(GATE, 3)]
    for row, name in zip([r for r in rows if r["quantity"].startswith("bias")], "abc", strict=True):
        assert row["first_value"] == pytest.approx(kept[:, "abc".index(name)].mean(), abs=1e-9)
        assert row["change"] == pytest.approx(0.2)


def test_success_is_as_the_table_of_a_run_counts_it_or_by_one_gate_for_both(synthetic):
    """Of two filters with a prior, whose own gate is wider, and of one beside an estimator
    without."""
    scenario = synthetic.scenario()
    errors = 3 * BOUND * DEVIATES[:200]
    wide = np.ones(200, dtype=bool)
    for number, label in enumerate(("filter", "other")):
        estimator = Pretender(option=number, knows_prior=True)
        synthetic.add(scenario, label, errors, estimator=estimator, success=wide)
    synthetic.add(scenario, "plain", errors)
    collection = collect([synthetic.directory])
    inside = np.mean((9 * DEVIATES[:200] ** 2).sum(axis=1) <= chi2.isf(GATE, 3))
    assert inside < 0.9
    for pair, share in ((("filter", "other"), 1.0), (("filter", "plain"), inside)):
        (row, *_) = compared(collection, collection, pair)
        assert row["quantity"] == "success"
        assert row["first_value"] == pytest.approx(share)
