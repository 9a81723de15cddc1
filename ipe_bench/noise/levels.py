"""Defines levels of the noise: standard deviations as a formula of levels, one set per group of
readings."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array, Covariance, finite
from ipe_bench.engine.trace import Graph, Program, slopes
from ipe_bench.measurements.arithmetic import Arithmetic, parse
from ipe_bench.measurements.base import Parameter

READING = "h"
"""Name of the error-free reading's magnitude in a formula of the standard deviation."""
_PROBES = 1000
"""Points at which a formula of the standard deviation is asked for its sign."""


@functools.cache
def read_sigma(text: str) -> Arithmetic:
    """Reads the formula of a standard deviation.

    Raises:
        UserError: it is no formula, has no level, or is negative at some levels and readings, all
            of them positive.
    """
    formula = parse(text, "noise.sigma")
    names = level_names(formula)
    if not names:
        raise UserError(
            f"noise.sigma={text}: has no level to estimate; give one, as in a + b*{READING}"
        )
    exponents = np.random.default_rng(0).uniform(-2, 2, (len(names) + 1, _PROBES))
    points = 10.0**exponents
    _require_positive(formula, (*names, READING), points)
    group = np.zeros(_PROBES, dtype=np.intp)
    levels = Levels(formula, np.ones(_PROBES), ("",), group)
    readings = np.geomspace(1e-6, 1e6, _PROBES)
    theta = np.log(points[:-1, 0])
    # Levels that no readings tell apart have slopes that are not independent.
    slopes = levels.at(readings[None], theta[None])[2][0]
    usable = slopes[finite(slopes)]
    if len(usable) == 0 or np.linalg.matrix_rank(usable) < len(names):
        raise UserError(
            f"noise.sigma={text}: the readings do not distinguish its levels {', '.join(names)};"
            f" leave some out ({READING} is the reading's magnitude, all other names are levels)"
        )
    return formula


def _require_positive(formula: Arithmetic, names: Sequence[str], points: Array) -> None:
    """Refuses a formula that is negative at one of the points (names, points), all of them
    positive."""
    with np.errstate(all="ignore"):
        values = formula(dict(zip(names, points, strict=True)))
    values = np.broadcast_to(values, points.shape[1])
    wrong = np.flatnonzero(~(values >= 0))
    if len(wrong):
        at = zip(names, points[:, wrong[0]], strict=True)
        where = ", ".join(f"{name} = {value:.3g}" for name, value in at)
        raise UserError(
            f"noise.sigma={formula.text}: can be negative ({values[wrong[0]]:.3g} where {where});"
            f" give a formula that is positive for all positive levels, such as a + b*{READING},"
            f" where {READING} is the reading's magnitude"
        )


def level_names(formula: Arithmetic) -> tuple[str, ...]:
    """Returns the names of the levels of a group of readings."""
    return tuple(name for name in formula.names if name != READING)


@dataclass(frozen=True)
class Levels:
    """Computes standard deviations sigma_i = w_i s(|h_i|, levels of the group of i) from the
    levels' logarithms."""

    formula: Arithmetic
    weights: Array
    """w (m,)."""
    groups: tuple[str, ...]
    """Names of the groups; a single one has none."""
    group: NDArray[np.intp]
    """Place (m,) of each reading's group among these."""
    units: tuple[str, ...] = ()
    """Units of the readings of each group; none: they have none."""

    @property
    def names(self) -> tuple[str, ...]:
        return level_names(self.formula)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """The levels, group by group."""
        # A level that stands alone is a standard deviation itself.
        alone = len(self.formula.names) == 1
        units = self.units if alone and self.units else ("",) * len(self.groups)
        found = []
        for group, unit in zip(self.groups, units, strict=True):
            names = [f"{name}_{group}" if group else name for name in self.names]
            found += [Parameter(name, unit) for name in names]
        return tuple(found)

    def restricted(self, rows: NDArray[np.intp]) -> Levels:
        """Returns the levels restricted to these rows."""
        kept, group = np.unique(self.group[rows], return_inverse=True)
        groups = tuple(self.groups[k] for k in kept)
        units = tuple(self.units[k] for k in kept) if self.units else ()
        weights = self.weights[rows]
        return replace(self, weights=weights, groups=groups, group=group, units=units)

    def covariance(self, h: Array, theta: Array) -> Covariance:
        """Returns R of readings h (m,) for logarithms theta (k,) of the levels.

        Raises:
            UserError: the standard deviation of a reading is zero, which makes its likelihood
                infinite.
        """
        log_sigma, _, _ = self.at(h[None], theta[None])
        sigma = np.exp(log_sigma[0])
        none = int(np.sum(sigma == 0))
        if none:
            raise UserError(
                f"noise.sigma={self.formula.text}: is 0 at {none} of {len(h)} readings, where"
                f" {READING} is 0; add a level, as in a + b*{READING}"
            )
        return Covariance(sigma)

    def at(self, h: Array, theta: Array) -> tuple[Array, Array, Array]:
        """Computes log sigma (trials, m) for readings h (trials, m) and logarithms theta (trials,
        k) of the levels, and its derivatives by h (trials, m) and by theta (trials, m, k); not
        finite where sigma is not positive."""
        trials, m = h.shape
        names = range(len(self.names))
        of_groups = np.exp(theta).reshape(trials, len(self.groups), -1)
        levels = of_groups[:, self.group]
        with np.errstate(all="ignore"):
            found = _recorded(self.formula)([np.abs(h), *(levels[:, :, i] for i in names)])
            s, by_h, *by_level = (np.broadcast_to(a, h.shape) for a in found)
            by_theta = np.zeros((trials, m, len(self.groups), len(names)))
            for i, slope in enumerate(by_level):
                # d log s / d log level = (ds / d level) level / s.
                by_theta[:, np.arange(m), self.group, i] = slope * levels[:, :, i] / s
            log_sigma = np.log(self.weights * s)
            log_by_h = by_h * np.sign(h) / s
            return log_sigma, log_by_h, by_theta.reshape(trials, m, -1)


@functools.cache
def _recorded(formula: Arithmetic) -> Program:
    """Records the formula and its derivatives by the reading and by each level."""
    graph = Graph()
    known = {name: graph.input(name) for name in (READING, *level_names(formula))}
    inputs = list(known.values())
    value = graph.apply("add", formula(known), 0.0)
    return Program.of([value, *slopes(value, inputs)], inputs)
