"""Defines levels of the noise: standard deviations as a formula of levels, one set per group of readings."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array, Covariance
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
        UserError: it is no formula, has no level, or is negative at some levels and readings, all of them positive.
    """
    formula = parse(text, "noise.sigma")
    names = level_names(formula)
    if not names:
        raise UserError(
            f"noise.sigma={text}: has no level to estimate; give one, as in a + b*{READING}"
        )
    points = 10.0 ** np.random.default_rng(0).uniform(-2, 2, (len(names) + 1, _PROBES))
    with np.errstate(all="ignore"):
        values = np.broadcast_to(
            formula(dict(zip((*names, READING), points, strict=True))), _PROBES
        )
    if len(wrong := np.flatnonzero(~(values >= 0))):
        where = ", ".join(
            f"{n} = {v:.3g}" for n, v in zip((*names, READING), points[:, wrong[0]], strict=True)
        )
        raise UserError(
            f"noise.sigma={text}: can be negative ({values[wrong[0]]:.3g} where {where}); give a formula that is"
            f" positive for all positive levels, such as a + b*{READING}, where {READING} is the reading's magnitude"
        )
    levels = Levels(formula, np.ones(_PROBES), ("",), np.zeros(_PROBES, dtype=np.intp))
    slopes = levels.at(np.geomspace(1e-6, 1e6, _PROBES)[None], np.log(points[None, :-1, 0]))[2][0]
    usable = slopes[np.isfinite(slopes).all(axis=1)]
    if len(usable) == 0 or np.linalg.matrix_rank(usable) < len(names):
        raise UserError(
            f"noise.sigma={text}: the readings do not distinguish its levels {', '.join(names)}; leave some out"
            f" ({READING} is the reading's magnitude, all other names are levels)"
        )
    return formula


def level_names(formula: Arithmetic) -> tuple[str, ...]:
    """Returns the names of the levels of a group of readings."""
    return tuple(name for name in formula.names if name != READING)


@dataclass(frozen=True)
class Levels:
    """Computes standard deviations sigma_i = w_i s(|h_i|, levels of the group of i) from the levels' logarithms."""

    formula: Arithmetic
    weights: Array
    """w (m,)."""
    groups: tuple[str, ...]
    """Names of the groups; a single one has none."""
    group: NDArray[np.intp]
    """Place (m,) of each reading's group among these."""
    unit: str = ""
    """Unit of the readings."""

    @property
    def names(self) -> tuple[str, ...]:
        return level_names(self.formula)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """The levels, group by group."""
        alone = len(self.formula.names) == 1
        named = [
            f"{name}_{group}" if group else name for group in self.groups for name in self.names
        ]
        return tuple(Parameter(name, self.unit if alone else "") for name in named)

    def restricted(self, rows: NDArray[np.intp]) -> Levels:
        """Returns the levels restricted to these rows."""
        kept, group = np.unique(self.group[rows], return_inverse=True)
        groups = tuple(self.groups[k] for k in kept)
        return replace(self, weights=self.weights[rows], groups=groups, group=group)

    def covariance(self, h: Array, theta: Array) -> Covariance:
        """Returns R of readings h (m,) for logarithms theta (k,) of the levels.

        Raises:
            UserError: the standard deviation of a reading is zero, which makes its likelihood infinite.
        """
        sigma = np.exp(self.at(h[None], theta[None])[0][0])
        if none := int(np.sum(sigma == 0)):
            raise UserError(
                f"noise.sigma={self.formula.text}: is 0 at {none} of {len(h)} readings, where {READING} is 0; add a"
                f" level, as in a + b*{READING}"
            )
        return Covariance(sigma)

    def at(self, h: Array, theta: Array) -> tuple[Array, Array, Array]:
        """Computes log sigma (trials, m) for readings h (trials, m) and logarithms theta (trials, k) of the levels, and
        its derivatives by h (trials, m) and by theta (trials, m, k); not finite where sigma is not positive."""
        trials, m = h.shape
        levels = np.exp(theta).reshape(trials, len(self.groups), -1)[:, self.group]
        values = [np.abs(h), *(levels[:, :, i] for i in range(len(self.names)))]
        with np.errstate(all="ignore"):
            s, by_h, *by_level = (
                np.broadcast_to(a, h.shape) for a in _recorded(self.formula)(values)
            )
            by_theta = np.zeros((trials, m, len(self.groups), len(self.names)))
            for i, slope in enumerate(by_level):
                by_theta[:, np.arange(m), self.group, i] = slope * levels[:, :, i] / s
            return np.log(self.weights * s), by_h * np.sign(h) / s, by_theta.reshape(trials, m, -1)


@functools.cache
def _recorded(formula: Arithmetic) -> Program:
    """Records the formula and its derivatives by the reading and by each level."""
    graph = Graph()
    known = {name: graph.input(name) for name in (READING, *level_names(formula))}
    value = graph.apply("add", formula(known), 0.0)
    return Program.of([value, *slopes(value, known.values())], list(known.values()))
