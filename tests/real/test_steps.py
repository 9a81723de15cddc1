"""Places of steps and bends, at which no slope tells where readings are."""

from __future__ import annotations

import numpy as np
import pytest

import ipe_bench as ib
from ipe_bench.baselines import LevenbergMarquardt
from ipe_bench.measurements import Formula

LM = {"lm": LevenbergMarquardt()}
X = np.arange(60.0)
NOISE = 0.1 * np.random.default_rng(1).standard_normal(60)
STEP = Formula("lo if x<s else hi", {"lo": 1.0, "hi": 1.0, "s": 50.0}, {"x": tuple(X.tolist())})


@pytest.mark.parametrize("known", [{}, {"s": {"lower": 0.0, "upper": 59.0}}])
def test_the_place_of_a_step_is_found_between_two_readings(known):
    """The least sum of squares over all partitions, and the means and their errors beside it."""
    z = np.where(X < 20, 1.0, 3.0) + NOISE
    answer = ib.estimate(STEP, z, LM, parameters=known)
    squares = [np.var(z[:k]) * k + np.var(z[k:]) * (60 - k) for k in range(1, 60)]
    assert np.argmin(squares) + 1 == 20
    one = answer["search"]
    assert answer.passes
    assert one.between == {2: (19.0, 20.0)}
    assert one.x == pytest.approx([z[:20].mean(), z[20:].mean(), 19.5], rel=1e-6)
    level = np.sqrt(min(squares) / 58)
    assert one.standard_errors[:2] == pytest.approx(level / np.sqrt([20, 40]), rel=1e-4)
    assert np.isnan(one.standard_errors[2])
    assert "the same with every value from 19 to 20" in str(answer)


@pytest.mark.parametrize("start", [(80.0, 90.0), (5.0, 6.0), (-3.0, 70.0)])
@pytest.mark.parametrize("levels", [(1.0, 3.0, 2.0), (1.0, 3.0, 1.0)])
def test_the_places_of_two_steps_are_found_one_after_the_other(levels, start):
    """The least sum of squares over all pairs of places."""
    truth = np.where(X < 20, levels[0], np.where(X < 41, levels[1], levels[2]))
    z = truth + NOISE
    starts = {"lo": 1.0, "mid": 1.0, "hi": 1.0, "s": start[0], "u": start[1]}
    model = Formula("lo if x<s else (mid if x<u else hi)", starts, {"x": tuple(X.tolist())})
    answer = ib.estimate(model, z, LM)

    def squares(i, k):
        return sum(np.var(part) * len(part) for part in (z[:i], z[i:k], z[k:]))

    best = min((squares(i, k), i, k) for i in range(1, 59) for k in range(i + 1, 60))
    assert best[1:] == (20, 41)
    one = answer["search"]
    assert answer.passes
    assert one.between == {3: (19.0, 20.0), 4: (40.0, 41.0)}
    assert one.chi_square * one.level**2 == pytest.approx(best[0], rel=1e-6)
    assert one.x[:3] == pytest.approx([z[:20].mean(), z[20:41].mean(), z[41:].mean()], rel=1e-6)


def test_a_bend_beyond_the_readings_is_found_among_them():
    bend = Formula(
        "b*x if x<s else b*s+c*(x-s)", {"b": 1.0, "c": 1.0, "s": 90.0}, {"x": tuple(X.tolist())}
    )
    z = np.where(X < 20, 0.5 * X, 10 - 0.3 * (X - 20)) + NOISE
    answer = ib.estimate(bend, z, LM)
    one = answer["search"]
    assert answer.passes
    assert one.x == pytest.approx([0.5, -0.3, 20.0], rel=0.02)
    assert np.isfinite(one.standard_errors).all()


def test_a_step_that_is_no_step_of_a_column_is_not_claimed():
    """Multiples of p pass readings elsewhere than p does."""
    model = Formula("a*floor(x/p)", {"a": 1.0, "p": 14.0}, {"x": tuple(X.tolist())})
    answer = ib.estimate(model, 2 * np.floor(X / 17.5) + NOISE, LM)
    assert [one.label for one in answer] == ["lm"]
    assert not answer.passes


def test_a_parameter_that_moves_no_reading_has_no_answer():
    model = Formula("a*exp(-b*x)", {"a": 1.0, "b": 1.0}, {"x": tuple(X.tolist())})
    answer = ib.estimate(model, np.zeros(60), LM)
    assert answer[0].idle == (1,)
    assert not answer.passes
    assert answer.finding() == "the readings do not determine b"
