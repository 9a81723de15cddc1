"""Noise of unknown levels: standard deviations as a formula of levels, one set of levels for each group of readings."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.errors import UserError, unknown
from ipe_bench.basics.linalg import Array, Covariance
from ipe_bench.basics.options import Positive
from ipe_bench.measurements.arithmetic import Arithmetic, read
from ipe_bench.measurements.base import Measurement, Parameter
from ipe_bench.measurements.ode.trace import Graph, Program, tangent
from ipe_bench.noise.base import Gaussian, Noise

NO_LEVEL = (
    "noise=unknown: has no level to simulate with; choose another noise, give noise.levels=[...], or use `estimate`"
)
READING = "h"
"""Name of the error-free reading's magnitude in a formula of the standard deviation."""
_PROBES = 1000
"""Points at which a formula of the standard deviation is asked for its sign."""


@functools.cache
def read_sigma(text: str) -> Arithmetic:
    """The formula of a standard deviation.

    Raises:
        UserError: it is no formula, has no level, or is negative at some levels and readings, all of them positive.
    """
    formula = read(text, "noise.sigma")
    names = level_names(formula)
    if not names:
        raise UserError(f"noise.sigma={text}: has no level to estimate; give one, as in a + b*{READING}")
    points = 10.0 ** np.random.default_rng(0).uniform(-2, 2, (len(names) + 1, _PROBES))
    with np.errstate(all="ignore"):
        values = np.broadcast_to(formula(dict(zip((*names, READING), points, strict=True))), _PROBES)
    if len(wrong := np.flatnonzero(~(values >= 0))):
        where = ", ".join(f"{n} = {v:.3g}" for n, v in zip((*names, READING), points[:, wrong[0]], strict=True))
        raise UserError(
            f"noise.sigma={text}: can be negative ({values[wrong[0]]:.3g} where {where}); give a formula that is"
            f" positive for all positive levels, such as a + b*{READING}, where {READING} is the reading's magnitude"
        )
    levels = Levels(formula, np.ones(_PROBES), ("",), np.zeros(_PROBES, dtype=np.intp))
    slopes = levels.at(np.geomspace(1e-6, 1e6, _PROBES)[None], np.log(points[None, :-1, 0]))[2][0]
    if np.linalg.matrix_rank(slopes[np.isfinite(slopes).all(axis=1)]) < len(names):
        raise UserError(
            f"noise.sigma={text}: no readings tell its levels {', '.join(names)} apart; leave some out"
            f" ({READING} is the reading's magnitude, all other names are levels)"
        )
    return formula


def level_names(formula: Arithmetic) -> tuple[str, ...]:
    """The names of the levels of a group of readings."""
    return tuple(name for name in formula.names if name != READING)


@dataclass(frozen=True)
class Levels:
    """Standard deviations sigma_i = w_i s(|h_i|, levels of the group of i), as functions of the levels' logarithms."""

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
        named = [f"{name}_{group}" if group else name for group in self.groups for name in self.names]
        return tuple(Parameter(name, self.unit if alone else "") for name in named)

    def restricted(self, rows: NDArray[np.intp]) -> Levels:
        """Those of some of the readings."""
        kept, group = np.unique(self.group[rows], return_inverse=True)
        groups = tuple(self.groups[k] for k in kept)
        return replace(self, weights=self.weights[rows], groups=groups, group=group)

    def covariance(self, h: Array, theta: Array) -> Covariance:
        """R of readings h (m,) for logarithms theta (k,) of the levels.

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
        """log sigma (trials, m) for readings h (trials, m) and logarithms theta (trials, k) of the levels, and its
        derivatives by h (trials, m) and by theta (trials, m, k); not finite where sigma is not positive."""
        trials, m = h.shape
        levels = np.exp(theta).reshape(trials, len(self.groups), -1)[:, self.group]
        values = [np.abs(h), *(levels[:, :, i] for i in range(len(self.names)))]
        with np.errstate(all="ignore"):
            s, by_h, *by_level = (np.broadcast_to(a, h.shape) for a in _recorded(self.formula)(values))
            slopes = np.zeros((trials, m, len(self.groups), len(self.names)))
            for i, slope in enumerate(by_level):
                slopes[:, np.arange(m), self.group, i] = slope * levels[:, :, i] / s
            return np.log(self.weights * s), by_h * np.sign(h) / s, slopes.reshape(trials, m, -1)


@functools.cache
def _recorded(formula: Arithmetic) -> Program:
    """The formula and its derivatives by the reading and by each level."""
    graph = Graph()
    known = {name: graph.input(name) for name in (READING, *level_names(formula))}
    value, one = graph.apply("add", formula(known), 0.0), graph.constant(1.0)
    slopes = [tangent([value], {place: one})[0] for place in known.values()]
    return Program.of([value, *slopes], list(known.values()))


@dataclass(frozen=True)
class Unknown(Noise):
    """Independent normal errors whose level is estimated from the residuals.

    Estimates do not depend on a single level; standard errors are scaled by it, and tests of the level itself are not
    possible. Several levels, or a standard deviation that depends on the reading, are estimated with the parameters by
    restricted maximum likelihood.
    """

    weights: tuple[Positive, ...] | None = None
    """Standard deviations of the readings up to a common factor; None: they are equal."""
    by: str | None = None
    """Column of the readings whose entries have levels of their own: `output`, say, or `file`."""
    sigma: str = "sigma"
    """Formula of the standard deviation: h is the magnitude of the error-free reading, all other names are levels."""
    levels: tuple[Positive, ...] | None = None
    """True levels in the order of the formula, for `run`: estimators are told R with these, at the nominal readings."""

    estimated = True

    def __post_init__(self) -> None:
        super().__post_init__()
        names = level_names(read_sigma(self.sigma))
        if self.levels is not None and len(self.levels) != len(names):
            raise UserError(f"noise.levels: has {len(self.levels)} numbers; give one for each of {', '.join(names)}")
        if self.levels is not None and self.by is not None:
            raise UserError("noise.by: does not go with noise.levels; state what is known, as in noise=gaussian")

    def levels_of(self, model: Measurement) -> Levels | None:
        """The levels of a model's readings; None if a single one multiplies all standard deviations.

        Raises:
            UserError: there is no such column, or a level has the name of a parameter.
        """
        if self.by is None and self.sigma == "sigma":
            return None
        if self.by is not None and self.by not in model.index:
            raise UserError(f"noise.by={self.by}: {unknown(self.by, model.index, 'column of the readings')}")
        column = [""] * model.m if self.by is None else model.index[self.by]
        entries = [f"{entry:g}" if isinstance(entry, float) else str(entry) for entry in column]
        groups = tuple(dict.fromkeys(entries))
        group = np.array([groups.index(entry) for entry in entries], dtype=np.intp)
        weights = self.covariance(model.m).factor
        found = Levels(read_sigma(self.sigma), weights, groups, group, model.reading_unit)
        if both := {p.name for p in found.parameters} & {p.name for p in model.physical_parameters}:
            raise UserError(f"noise.sigma: {min(both)} is a parameter of the model; give the level another name")
        return found

    def true_levels(self, m: int) -> tuple[Levels, Array] | None:
        if self.levels is None:
            return None
        formula, weights = read_sigma(self.sigma), self.covariance(m).factor
        return Levels(formula, weights, ("",), np.zeros(m, dtype=np.intp)), np.log(self.levels)

    def nominal_covariance(self, model: Measurement) -> Covariance:
        if self.levels is None:
            return self.covariance(model.m)
        return self._true_covariance(model.simulate(model.nominal[None])[0])

    def _true_covariance(self, h: Array) -> Covariance:
        """R of the errors of readings h (m,)."""
        known = self.true_levels(len(h))
        if known is None:
            raise UserError(NO_LEVEL)
        levels, theta = known
        return levels.covariance(h, theta)

    @property
    def true_covariance(self) -> bool:
        return READING not in read_sigma(self.sigma).names

    def corrupt(self, h: Array, offset: Array, rng: np.random.Generator) -> Array:
        return h + self._true_covariance(h).factor * rng.standard_normal(h.shape)

    def covariance(self, m: int) -> Covariance:
        return Covariance(np.ones(m)) if self.weights is None else Gaussian(self.weights).covariance(m)
