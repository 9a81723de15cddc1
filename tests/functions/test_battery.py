"""Functions as users write them: what is computed with is the function, and its slope is its
slope, as mpmath says (truths.json)."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from functions import eighty, forty

from ipe_bench.measurements import Parameter
from ipe_bench.states import Normal, StateModel

TRUTHS = json.loads(Path(__file__).with_name("truths.json").read_text())
SETS = {"eighty": eighty, "forty": forty}
WITHOUT_SLOPE = {"forty.head_loss": [6, 7]}
"""Points at which a slope of 0 is found to 1e-4: a |a|^.85 at 0."""
TIED = ("eighty.where_eq", "eighty.removable", "forty.equal_but_alike")
"""Functions in which a branch stands for one point: its slope needs no mending after tracking."""


class Model(StateModel):
    """Moves by a function of two states, or is read by one."""

    name = "case"
    states: Any = (Parameter("a"), Parameter("b"))
    times: Any = np.arange(1.0, 4.0)
    prior: Any = None

    def __init__(self, function: Any, mean: Any, sd: Any, m: int) -> None:
        self.function = function
        self.prior = Normal(mean, np.diag(sd**2))
        self.m_read = m

    def transition(self, x, k):
        return x if self.m_read == 1 else self.function(x)

    def observe(self, x, k):
        return x if self.m_read == 2 else self.function(x)

    def gain(self, k):
        return np.eye(2)

    def R(self, k):
        return np.eye(self.m_read)


@pytest.mark.parametrize("name", TRUTHS)
def test_values_and_slopes_of_functions_in_python(name):
    kind, case = name.split(".")
    function, _, mean, sd, *given = SETS[kind].CASES[case]
    states = np.array(given[0] if given and given[0] else forty.STATES, dtype=float)
    truths = TRUTHS[name]
    m = next(len(one[0]) for one in truths if one)

    def plain(x):
        return np.asarray(function(x)) if type(x) is np.ndarray else function(x)

    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        found = Model(plain, mean, sd, m).epoch_functions[m == 1].at[1]
        value, slope = found.slope(states)
        assert found.own or name not in TIED
        for own in found.own:  # and what a tracker mends where it has been
            wrong = own.wrong(states, value, slope)
            assert not (wrong.any() and name in TIED)
            if wrong.any():
                value[wrong], slope[wrong] = own.slopes(states[wrong])
    for i, one in enumerate(truths):
        if one is None:
            continue
        right, slopes = (np.array(part, dtype=float) for part in one)
        np.testing.assert_allclose(value[i], right, rtol=1e-6, atol=1e-9)
        known = np.isfinite(slopes)
        close = 2e-4 if i in WITHOUT_SLOPE.get(name, []) else 1e-6
        np.testing.assert_allclose(slope[i][known], slopes[known], rtol=2e-4, atol=close)
