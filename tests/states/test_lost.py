"""A track that is not finite says which entry of which function was not, at which epoch."""

from __future__ import annotations

import numpy as np
import pytest

from ipe_bench.states import Formulas, ekf
from ipe_bench.states.lost import why_lost
from ipe_bench.trials.paths import PathBlock, StateScenario

PARTS = {"noise": {"w": 0.1}, "deviation": {"z": 1}, "spread": {"x": 1, "v": 1}, "count": 5}


@pytest.mark.parametrize(
    ("step", "reading", "words"),
    [
        ("x/v", "x", "at epoch 1, next.x is nan at the mean of the prior"),
        ("x + sqrt(v)", "x", "at epoch 1, next.x has no finite slope at the mean of the prior"),
        ("x + 1", "log(2.5 - x + v)", "readings.z is nan"),
    ],
)
def test_a_track_says_where_it_was_lost(step, reading, words):
    model = Formulas(next={"x": f"{step} + 0*w", "v": "v + w"}, readings={"z": reading}, **PARTS)
    with np.errstate(all="ignore"):
        mean = ekf().track(model, np.zeros((1, 5, 1))).mean
    why = why_lost(model, mean)
    assert words in why[0]
    assert ("x=0, v=0" in why[0]) == ("of the prior" in words)


def test_a_run_says_so_of_each_trial():
    model = Formulas(next={"x": "x/v + 0*w", "v": "v + w"}, readings={"z": "x"}, **PARTS)
    block = PathBlock.draw(StateScenario(model), 0, 3)
    _, columns = block.estimate(ekf())
    lost = "the track is not finite from epoch 1 on"
    where = "at epoch 1, next.x is nan at the mean of the prior"
    assert set(columns["message"]) == {f"{lost}: {where}"}
