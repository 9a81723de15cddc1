"""Plans of trials: the power of McNemar's exact test against closed forms and simulation, and what
pilots plan."""

import numpy as np
import pytest
from scipy.stats import binom
from shared.oracles import assert_agrees

from ipe_bench.questions.compare.effects import PowerPlan, mcnemar_power, trials_needed

CASES = [
    (0.9, 0.95, 0.0),
    (0.9, 0.95, 0.6),
    (0.5, 0.6, 0.0),
    (0.5, 0.6, 0.7),
    (0.97, 1.0, 0.0),
    (0.73, 0.67, 0.3),
]
"""Success of the first and of the second, and the correlation of both."""


def outcomes(first: float, second: float, correlation: float) -> np.ndarray:
    """Probabilities that both, the first alone, the second alone, and none succeed."""
    both = first * second + correlation * np.sqrt(first * (1 - first) * second * (1 - second))
    both = min(both, first, second)
    return np.array([both, first - both, second - both, 1 + both - first - second])


@pytest.mark.parametrize("alpha", [0.05, 0.01])
@pytest.mark.parametrize("case", CASES, ids=str)
def test_the_power_is_that_of_simulated_tests(case, alpha):
    """Of 20,000 simulated comparisons as many are significant as computed, within .02."""
    p = outcomes(*case)
    share, difference = p[1] + p[2], abs(p[2] - p[1])
    trials = trials_needed(share, difference, 0.8, alpha)
    drawn = np.random.default_rng(5).multinomial(trials, p / p.sum(), size=20_000)
    least, discordant = np.minimum(drawn[:, 1], drawn[:, 2]), drawn[:, 1] + drawn[:, 2]
    found = np.mean(2 * binom.cdf(least, discordant, 0.5) < alpha)
    assert mcnemar_power(trials, share, difference, alpha) == pytest.approx(found, abs=0.02)
    assert found >= 0.8 - 0.02


@pytest.mark.oracle("library: SciPy's binom", "power of McNemar's test", 1e-12)
def test_where_only_the_second_wins_six_wins_are_significant():
    """2 / 2^6 < .05 <= 2 / 2^5: the power is that of six discordant trials or more."""
    for trials in (20, 100, 500):
        assert_agrees(
            mcnemar_power(trials, 0.05, 0.05, 0.05), binom.sf(5, trials, 0.05), atol=1e-12
        )


@pytest.mark.parametrize(("share", "difference"), [(0.3, 0.1), (1.0, 0.4), (0.06, 0.05)])
def test_the_plan_is_the_least_from_which_on_the_power_stays(share, difference):
    """Also where every trial is discordant and the power is a saw."""
    needed = trials_needed(share, difference, 0.9, 0.05)
    power = [mcnemar_power(n, share, difference, 0.05) for n in range(needed - 1, needed + 100)]
    assert power[0] < 0.9 <= min(power[1:])


@pytest.mark.parametrize(
    "case", [(0.9, 0.95, 0.3), pytest.param((0.5, 0.6, 0.7), marks=pytest.mark.slow)], ids=str
)
def test_plans_of_small_pilots_have_the_power_on_average(case):
    """Of 25 trials each: by the upper limit of the discordant share, and not by the share that the
    pilot shows."""
    p = outcomes(*case)
    share, difference = p[1] + p[2], p[2] - p[1]
    seen = np.random.default_rng(7).binomial(25, share, 200)
    reached, naive = [], []
    for discordant, count in zip(*np.unique(seen, return_counts=True), strict=True):
        plan = PowerPlan(0.9, difference).row(int(discordant), 25, 0.05)
        shown = trials_needed(max(discordant / 25, difference), difference, 0.9, 0.05)
        reached += [mcnemar_power(plan["trials_needed"], share, difference, 0.05)] * count
        naive += [mcnemar_power(shown, share, difference, 0.05)] * count
    assert np.mean(reached) > 0.9
    assert np.mean(naive) < np.mean(reached) - 0.05
