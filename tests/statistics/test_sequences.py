"""Intervals that stay valid however often one looks: exact probabilities, simulated studies, and
trials saved."""

import numpy as np
import pytest
from scipy.stats import binom
from shared.oracles import assert_agrees

from ipe_bench.basics.errors import UserError
from ipe_bench.statistics.collect import collect
from ipe_bench.statistics.formulas import rmse_ends
from ipe_bench.statistics.intervals import clopper_pearson, share_sequence
from ipe_bench.statistics.sample import samples
from ipe_bench.statistics.stopping import next_trials, require_precision


def ever_missed(p: float, step: int, looks: int) -> float:
    """The exact probability that any of the intervals after `step`, 2 `step`, ... trials misses p:
    counts are carried from look to look, and those that missed are taken out."""
    alive = np.ones(1)
    steps = binom.pmf(np.arange(step + 1), step, p)
    for look in range(1, looks + 1):
        alive = np.convolve(alive, steps)
        for count in np.flatnonzero(alive > 1e-12):
            low, high = share_sequence(int(count), look * step)
            if not low <= p <= high:
                alive[count] = 0.0
    return 1 - float(alive.sum())


@pytest.mark.parametrize("p", [0.5, 0.05])
def test_an_interval_after_every_ten_trials_holds_the_share_at_all_times(p):
    missed = ever_missed(p, 10, 25)
    assert 0 <= missed <= 0.05
    # What looks as often at intervals of a fixed number misses far more often.
    assert missed > 0 or p != 0.5


@pytest.mark.parametrize(
    ("count", "trials"), [(0, 1), (1, 1), (0, 250), (249, 250), (500, 1000), (7, 9000)]
)
def test_an_interval_of_a_share_holds_what_was_seen_and_that_of_a_fixed_number(count, trials):
    low, high = share_sequence(count, trials)
    fixed = clopper_pearson(count, trials)
    assert 0 <= low <= fixed[0]
    assert fixed[1] <= high <= 1
    mirrored = share_sequence(trials - count, trials)
    assert (low, high) == (
        pytest.approx(1 - mirrored[1], abs=1e-9),
        pytest.approx(1 - mirrored[0], abs=1e-9),
    )


@pytest.mark.oracle(
    "closed form: Robbins's normal mixture", "width of the interval that holds at all times", 0.02
)
def test_looking_costs_half_as_much_again_at_a_thousand_trials():
    """Robbins's normal mixture, tightest there, is 3.04 deviations wide where a fixed number has
    1.96."""
    low, high = share_sequence(500, 1000)
    assert_agrees((high - low) / 2, 3.04 * np.sqrt(0.25 / 1000), rtol=0.02)


@pytest.mark.parametrize(("trials", "known"), [(400, False), (20_000, True)])
def test_the_upper_end_of_rmse_is_known_once_rare_errors_have_been_seen(synthetic, trials, known):
    """One normal error in a thousand is beyond 3.29 deviations: ten of them are seen in 20,000 and
    not in 400."""
    error = 0.1 * np.random.default_rng(1).standard_normal((trials, 1))
    synthetic.add(synthetic.scenario(names=("a",)), "one", error)
    collection = collect([synthetic.directory])
    low, high = rmse_ends(next(samples(collection, collection.groups)))
    assert np.isfinite(low).all()
    assert np.isfinite(high).tolist() == [known] * 2


@pytest.mark.parametrize(
    "given", [0, 1, -0.1, 2, True, "x", float("nan"), {}, {"success": 0.1}, [0.1], None]
)
def test_what_is_no_precision_is_refused(given):
    with pytest.raises(UserError, match="precision"):
        require_precision(given)


def trials_taken(p: float, wanted: float, rng: np.random.Generator, block: int = 50) -> int:
    """How many trials a study takes."""
    seen, trials = rng.uniform(size=100_000) < p, block
    while True:
        count = int(seen[:trials].sum())
        low, high = share_sequence(count, trials)
        width = max(high - count / trials, count / trials - low)
        if width <= wanted or trials == len(seen):
            return trials
        trials = next_trials(trials, width / wanted, block, len(seen))


def test_shares_near_0_and_1_take_fewer_trials_than_a_fixed_thousand_and_one_half_more():
    """To within the 3.1 % that a thousand trials give in the worst case, p = 0.5."""
    rng = np.random.default_rng(0)
    taken = {
        p: np.mean([trials_taken(p, 0.0316, rng) for _ in range(20)])
        for p in (0.0, 0.01, 0.99, 1.0, 0.5)
    }
    assert max(taken[0.0], taken[1.0]) <= 250
    assert max(taken[0.01], taken[0.99]) < 500
    assert 2000 < taken[0.5] < 3000


def test_widths_shrink_with_the_root_of_the_number_of_trials():
    assert next_trials(10_000, 1.2, 50, 10**6) == pytest.approx(10_000 * 1.2**2, rel=0.025)
    assert next_trials(10_000, 3.0, 50, 10**6) == 20_000
