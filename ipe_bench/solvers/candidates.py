"""Selects the candidates of a search that go on."""

from __future__ import annotations

import itertools

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.solvers.attempts import Rows


def best_candidates(
    owner: Rows,
    x: Array,
    fit: Array,
    useless: Array,
    *,
    most: int,
    alike: float = -1.0,
    last: bool = False,
) -> Rows:
    """Selects, of each trial, the candidates that go on: the `most` best that are not alike, and
    whose `fit` (candidates,) is not above `useless` (candidates,).

    At least one goes on in the `last` attempt, and where there is no fit at all: that ends with its
    own status."""
    in_any_case = np.isinf(fit) | last
    # One candidate a trial: there is nothing to choose among.
    if len(np.unique(owner)) == len(owner):
        return np.flatnonzero((fit <= useless) | in_any_case)
    selected: list[int] = []
    best_first = np.lexsort((fit, owner)).tolist()
    for _, of_trial in itertools.groupby(best_first, key=lambda i: owner[i]):
        chosen: list[int] = []
        for i in of_trial:
            if len(chosen) == most:
                break
            good_enough = fit[i] <= useless[i] or (not chosen and in_any_case[i])
            known = any(np.abs(x[i] - x[j]).max() <= alike for j in chosen)
            if good_enough and not known:
                chosen.append(i)
        selected += chosen
    return np.array(sorted(selected), dtype=np.intp)
