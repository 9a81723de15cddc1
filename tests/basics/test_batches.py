"""Trials taken out of a batch and put together again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ipe_bench.basics.batches import gather, put, take


@dataclass(frozen=True)
class Inner:
    a: np.ndarray
    nothing: np.ndarray | None = None


@dataclass(frozen=True)
class Outer:
    x: np.ndarray
    inner: Inner
    path: list[np.ndarray]


def outer(trials: int) -> Outer:
    x = np.arange(3.0 * trials).reshape(trials, 3)
    return Outer(x, Inner(-x), [row[:1] for row in x])


def test_parts_make_up_the_batch_that_they_were_taken_from():
    whole, rows = outer(7), (np.array([5, 1]), np.array([0, 2, 6]), np.array([3, 4]))
    again = gather([(part, take(whole, part)) for part in rows])
    assert np.array_equal(again.x, whole.x)
    assert np.array_equal(again.inner.a, whole.inner.a)
    assert again.inner.nothing is None
    assert [float(p[0]) for p in again.path] == [float(p[0]) for p in whole.path]


def test_what_is_put_everywhere_is_the_batch():
    whole, other = outer(4), outer(4)
    assert put(whole, np.ones(4, bool), other) is other
    changed = put(whole, np.array([False, True, False, True]), take(outer(8), np.array([6, 7])))
    assert changed.x[:, 0].tolist() == [0.0, 18.0, 6.0, 21.0]
    assert whole.x[:, 0].tolist() == [0.0, 3.0, 6.0, 9.0]
