"""What is a sum over the trials of a sample: all of it from one pass over what is stored, some thousand rows at a time.

The rows go by in the same portions however they are cut into files, so that no bit of a sum depends on that. What needs
an order (medians, quantiles, distribution functions) is left to `statistics.sample`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from ipe_bench.basics.linalg import Array
from ipe_bench.statistics.intervals import LARGEST_SAMPLE
from ipe_bench.statistics.running import Bins, Mean, Scatter, Squares

NORMAL_95 = float(-ndtri(0.025))
"""What 95 % of the values of the normal law do not exceed in size."""


@dataclass(frozen=True)
class Rows:
    """Some trials in succession: matrices (n, rows), in multiples of the parameters' sizes; NaN where it is missing."""

    error: Array
    deviation: Array
    crlb: Array
    bayes: Array
    linear_error: Array
    van_trees: Array
    van_trees_error: Array
    theory: Mapping[str, Array]
    curvature: Mapping[str, Array]
    """(rows,)"""
    solved: Array
    """(rows,)"""
    common: Array
    """(rows,), solved by every estimator of the scenario."""


class Sums:
    """Running sums of a sample of so many trials with n parameters; see `Rows`. All but counts are (n,)."""

    def __init__(self, trials: int, linear_bound: Array, groups: Sequence[Sequence[int]]) -> None:
        n = len(linear_bound)
        self.linear_bound = linear_bound
        self.unit = np.where(linear_bound > 0, linear_bound, 1.0)
        """What errors are multiples of where they are multiplied: parameters may differ by many orders of magnitude."""
        self.groups = [list(members) for members in groups]
        self.errors = Scatter(n)
        """Of errors over `unit`, of solved trials."""
        self.bias, self.mse, self.mse_common, self.mse_all = (Mean(n) for _ in range(4))
        self.crlb, self.bayes, self.crlb_all, self.bayes_all, self.van_trees = (Mean(n) for _ in range(5))
        self.reported, self.compensation, self.nees, self.covered = (Mean(n) for _ in range(4))
        self.van_trees_error = Mean(n)
        """Of the squared standard errors of the squared bound, each twice the bound times its own."""
        self.wrong, self.wrong_mse, self.box, self.box_square = (Mean(n) for _ in range(4))
        self.squares = Squares(n + 1 + len(self.groups))
        """Of the errors of solved trials; then of all parameters together, and of each group, over the linear bound."""
        self.binned = Bins(n + 1 + len(self.groups), trials, LARGEST_SAMPLE)
        """The same as sums over trials in succession."""
        self.counts = Bins(1, trials, LARGEST_SAMPLE)
        self.together = np.full(trials, np.nan)
        """(trials,), root mean square over parameters of error over linear bound, solved or not."""
        self.curvature: dict[str, list[Array]] = {}
        self.reports_covariance = False
        self._at = 0

    def over(self, parts: Iterable[Rows]) -> Sums:
        """Itself, after all the rows."""
        with np.errstate(all="ignore"):
            for rows in parts:
                self._add(rows)
        return self

    def _add(self, r: Rows) -> None:
        square, normalised = r.error**2, (r.error / self.linear_bound[:, None]) ** 2
        together = normalised.mean(axis=0)
        self.together[self._at : self._at + len(together)] = np.sqrt(together)
        self._at += len(together)
        self.errors.add(r.error / self.unit[:, None], r.solved)
        self.bias.add(r.error, r.solved)
        self.mse.add(square, r.solved)
        self.mse_common.add(square, r.common)
        self.mse_all.add(np.where(np.isfinite(r.error), square, np.inf))
        squares = np.vstack([square, together, *(normalised[members].mean(axis=0) for members in self.groups)])
        self.squares.add(squares, r.solved)
        self.binned.add(np.where(r.solved, squares, 0.0))
        self.counts.add(r.solved[None].astype(float))
        self._add_bounds(r)
        self._add_reported(r)

    def _add_bounds(self, r: Rows) -> None:
        for name, bound in (("crlb", r.crlb), ("bayes", r.bayes)):
            square = bound**2
            getattr(self, name).add(square, r.solved)
            getattr(self, f"{name}_all").add(square)
        known: Array = np.asarray(~np.isnan(r.van_trees[0]))
        self.van_trees.add(r.van_trees**2, known)
        self.van_trees_error.add((2 * r.van_trees * r.van_trees_error) ** 2, known)
        self.compensation.add((r.error - r.linear_error) ** 2, r.solved)
        wrong, scatter, box = (r.theory[kind] for kind in ("pseudo_bias", "misspecified", "box_bias"))
        used: Array = np.asarray(r.solved & np.isfinite(wrong).all(axis=0) & np.isfinite(scatter).all(axis=0))
        self.wrong.add(wrong, used)
        self.wrong_mse.add(wrong**2 + scatter**2, used)
        bent: Array = np.asarray(np.isfinite(box).all(axis=0))
        self.box.add(box, bent)
        self.box_square.add(box**2, bent)
        for name, values in r.curvature.items():
            self.curvature.setdefault(name, []).append(values[np.isfinite(values)])

    def _add_reported(self, r: Rows) -> None:
        known = np.isfinite(r.deviation)
        self.reports_covariance |= bool(known.any())
        self.reported.add(r.deviation**2, r.solved & known.all(axis=0))
        over = np.abs(r.error) / r.deviation
        self.nees.add(over**2, r.solved)
        self.covered.add(over <= NORMAL_95)

    @property
    def std(self) -> Array:
        """Standard deviation (n - 1) of the errors of solved trials."""
        count, products = self.errors.count, np.diag(self.errors.products)
        return self.unit * np.sqrt(products / (count - 1)) if count > 1 else np.full(len(products), np.nan)

    @property
    def correlation(self) -> Array:
        """(n, n) of the errors of solved trials; NaN where an error does not vary or there are too few trials."""
        products = self.errors.products
        if self.errors.count < 3:
            return np.full(products.shape, np.nan)
        deviation = np.sqrt(np.diag(products))
        with np.errstate(all="ignore"):
            return products / np.outer(deviation, deviation)

    def known_curvature(self, name: str) -> Array:
        """The values of a curvature in the trials in which it is known."""
        return np.concatenate([*self.curvature.get(name, []), np.empty(0)])


class Beside:
    """Columns of the truth beside the estimates: for one portion of ascending trials after another."""

    def __init__(self, chunks: Iterator[dict[str, Array]]) -> None:
        self.chunks = chunks
        self.held: list[dict[str, Array]] = []

    def at(self, trial: Array, names: Sequence[str]) -> dict[str, Array]:
        """Of these trials, that come after those before; NaN where a column or a trial is missing."""
        while not self.held or self.held[-1]["trial"][-1] < trial[-1]:
            chunk = next(self.chunks, None)
            if chunk is None:
                break
            self.held.append(chunk)
        self.held = [chunk for chunk in self.held if chunk["trial"][-1] >= trial[0]]
        found = {name: np.full(len(trial), np.nan) for name in names}
        for chunk in self.held:
            first, last = np.searchsorted(trial, [chunk["trial"][0], chunk["trial"][-1] + 1])
            wanted = trial[first:last]
            if not len(wanted):
                continue
            at = np.searchsorted(chunk["trial"], wanted)
            there = chunk["trial"][at] == wanted
            for name in set(names) & set(chunk):
                found[name][first:last][there] = chunk[name][at[there]]
        return found
