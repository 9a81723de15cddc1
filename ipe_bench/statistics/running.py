"""Sums that are taken some rows at a time, so that a million trials need not be in memory at once.

Numbers in, numbers out: matrices are (k, rows), what counts is (rows,) boolean, None for all of them. Which trials
these are, and what the sums mean, is left to `statistics.sums`.
"""

from __future__ import annotations

import numpy as np

from ipe_bench.basics.linalg import Array


class Mean:
    """The mean (k,) of columns; NaN where none counts."""

    def __init__(self, k: int) -> None:
        self.total = np.zeros(k)
        self.count = 0

    def add(self, values: Array, used: Array | None = None) -> None:
        chosen = _chosen(values, used)
        self.total += chosen.sum(axis=1)
        self.count += chosen.shape[1]

    @property
    def value(self) -> Array:
        return self.total / self.count if self.count else np.full(len(self.total), np.nan)

    @property
    def root(self) -> Array:
        """Its square root: a root mean square, where squares were added."""
        return np.sqrt(self.value)


class Scatter:
    """Mean (k,) and products (k, k) of deviations from it: those of two sets make those of both (Chan, Golub and
    LeVeque, Amer. Statist. 37, 1983), and nothing cancels however far from 0 the mean is."""

    def __init__(self, k: int) -> None:
        self.count = 0
        self.mean = np.full(k, np.nan)
        self.products = np.zeros((k, k))

    def add(self, values: Array, used: Array | None = None) -> None:
        chosen = _chosen(values, used)
        count = chosen.shape[1]
        if not count:
            return
        mean = chosen.mean(axis=1)
        centred = chosen - mean[:, None]
        products = centred @ centred.T
        if self.count:
            both, step = self.count + count, mean - self.mean
            self.products += products + np.outer(step, step) * (self.count * count / both)
            self.mean = self.mean + step * (count / both)
        else:
            self.mean, self.products = mean, products
        self.count += count


class Squares:
    """Squares (k, rows) beside their own size: the largest, and mean and sum of squared deviations in units of it.

    They may be anything from 1e-200 to 1e200, whose squares are no numbers any more.
    """

    def __init__(self, k: int) -> None:
        self.count = 0
        self.size, self.mean, self.deviations = np.zeros((3, k))

    def add(self, squares: Array, used: Array | None = None) -> None:
        chosen = _chosen(squares, used)
        count = chosen.shape[1]
        if not count:
            return
        size = np.maximum(self.size, chosen.max(axis=1))
        with np.errstate(all="ignore"):
            scaled = np.where(size[:, None] > 0, chosen / size[:, None], 0.0)
            shrunk = np.where(size > 0, self.size / size, 0.0)
        mean = scaled.mean(axis=1)
        deviations = ((scaled - mean[:, None]) ** 2).sum(axis=1)
        both, step = self.count + count, mean - self.mean * shrunk
        self.deviations = self.deviations * shrunk**2 + deviations + step**2 * (self.count * count / both)
        self.mean = self.mean * shrunk + step * (count / both)
        self.size, self.count = size, both

    @property
    def deviation(self) -> Array:
        """Standard deviation (k,), in units of the size."""
        return np.sqrt(self.deviations / (self.count - 1)) if self.count > 1 else np.full(len(self.size), np.nan)


class Bins:
    """Sums (bins, k) over rows in succession: that many bins as alike as can be, or one for each row if there are fewer
    rows than bins."""

    def __init__(self, k: int, rows: int, most: int) -> None:
        bins = rows if rows <= most else most
        self.edges = np.linspace(0, rows, bins, endpoint=False).astype(int)
        self.sums = np.zeros((bins, k))
        self.reached = 0

    def add(self, values: Array) -> None:
        """The next rows."""
        stop = self.reached + values.shape[1]
        first = int(np.searchsorted(self.edges, self.reached, side="right")) - 1
        last = int(np.searchsorted(self.edges, stop, side="left"))
        starts = np.maximum(self.edges[first:last] - self.reached, 0)
        self.sums[first:last] += np.add.reduceat(values, starts, axis=1).T
        self.reached = stop


def _chosen(values: Array, used: Array | None) -> Array:
    return values if used is None or used.all() else values[:, used]
