"""Rates that jump, and others that do not, beside what their formulas say."""

from __future__ import annotations

import numpy as np
import pytest

from ipe_bench.engine.equations import Equations
from ipe_bench.engine.jumps import jumps


def _told(rate, parameters):
    """Tells of y' = rate(y, p) whether it jumps."""
    return jumps(
        Equations(
            states=1,
            parameters=parameters,
            constants=0,
            outputs=1,
            start=lambda p, c: [1.0],
            rhs=lambda t, y, p, c: [rate(y[0], p)],
            read=lambda t, y, p, c: [y[0]],
        )
    )


def _roots(p):
    product = 1.0
    for one in p:
        product = product * np.sqrt(one)
    return product


@pytest.mark.parametrize("parameters", [1, 12])
def test_a_jump_that_is_a_number_only_for_positive_parameters_is_seen(parameters):
    assert _told(lambda y, p: np.where(y > 1, _roots(p), 0.0), parameters)
    assert not _told(lambda y, p: np.where(y > 1, _roots(p) * (y - 1), 0.0), parameters)
