"""Treats levels of the noise as further parameters: minimises the restricted likelihood in the form
of least squares.

Each reading comes with a second residual, of the logarithm of its standard deviation sigma. The
gradient of

    sum_i (r_i / sigma_i)^2 + 2 f_i log sigma_i

is then that of a sum of squares (McCullagh and Nelder, Generalized Linear Models, 1989, chapter
10). f_i = 1 makes the likelihood; f_i = 1 - leverage_i makes up for the degrees of freedom that the
parameters take, and is exact for a linear model with levels by groups (Patterson and Thompson,
Biometrika 58, 1971).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array, Covariance, Mask, deviations, divisors, repeated
from ipe_bench.estimators.driver import Limits
from ipe_bench.estimators.least_squares import Objective, inverse_factor
from ipe_bench.estimators.levenberg_marquardt import LevenbergMarquardtMethod
from ipe_bench.estimators.minima import Minima, minimize
from ipe_bench.measurements.base import Measurement, Parameter, WrappedModel
from ipe_bench.measurements.counted import CountingModel, EvaluationCount
from ipe_bench.measurements.problem import Problem
from ipe_bench.noise.levels import Levels
from ipe_bench.real.residuals import explained

_TOLERANCE = 1e-8
_MOST_STEPS = 200
_MOST_ROUNDS = 30
"""Maximisations until leverages change no more."""
_SAME_LEVERAGE = 1e-9
_LEAST_SHARE = 1e-8
"""Residuals that are smaller than this share of the readings are round-off."""
_HOLD = 1e-2
"""The weight with which the logarithm of a level is held where a search begins: that of a level of
zero is infinite."""
_SHIFT = 3.0
"""Added to the logarithm of sigma over R's, since the methods need a positive objective."""
_LEAST_SPARE = 1e-9
"""The least degree of freedom of a reading, by which its residual is divided."""


@dataclass(frozen=True)
class Levelled(WrappedModel):
    """Joins the readings h of a model, the logarithms of their standard deviations, and those of
    the levels; x has the logarithms of the levels behind the parameters."""

    whole: Measurement
    noise: Levels
    theta: Array
    """Logarithms (k,) of the levels at the start."""
    spare: Array
    """f (m,): the part of each reading's degree of freedom that the levels are estimated from."""

    epochs = recorded = None
    linear = False

    def __post_init__(self) -> None:
        """Skips the checks of options: the model was checked before."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (*self.whole.parameters, *self.noise.parameters)

    @property
    def physical_parameters(self) -> tuple[Parameter, ...]:
        return (*self.whole.physical_parameters, *self.noise.parameters)

    @property
    def nominal(self) -> Array:
        return np.concatenate([self.whole.nominal, self.theta])

    @cached_property
    def m(self) -> int:
        return 2 * self.whole.m + len(self.theta)

    def physical(self, x: Array) -> Array:
        values = self.whole.physical(self.whole_x(x))
        with np.errstate(over="ignore"):
            return np.concatenate([values, np.exp(self._logarithms(x))], axis=1)

    def physical_slope(self, x: Array) -> Array:
        slope = self.whole.physical_slope(self.whole_x(x))
        # d sigma / d log sigma = sigma.
        return np.concatenate([slope, np.exp(self._logarithms(x))], axis=1)

    def near_bounds(self, x: Array) -> Mapping[int, float]:
        return self.whole.near_bounds(x[: self.whole.n])

    def whole_x(self, x: Array) -> Array:
        return x[:, : self.whole.n]

    def _logarithms(self, x: Array) -> Array:
        return x[:, self.whole.n :]

    def own_readings(self, x: Array, z: Array) -> Array:
        theta = self._logarithms(x)
        log_sigma = self.noise.at(z, theta)[0]
        return np.concatenate([z, log_sigma, theta], axis=1)

    def own_jacobian(self, x: Array, J: Array) -> Array:
        theta = self._logarithms(x)
        _, by_h, by_theta = self.noise.at(self.whole.simulate(self.whole_x(x)), theta)
        trials, m, n = J.shape
        k = theta.shape[1]
        whole = np.zeros((trials, self.m, n + k))
        whole[:, :m, :n] = J
        # Log sigma depends on the parameters through h alone.
        whole[:, m : 2 * m, :n] = by_h[:, :, None] * J
        whole[:, m : 2 * m, n:] = by_theta
        whole[:, 2 * m :, n:] = np.eye(k)
        return whole


@dataclass(frozen=True)
class _Known(Measurement):
    """Holds readings without a parameter."""

    h: Array

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return ()

    @property
    def index(self) -> dict[str, range]:
        return {"row": range(len(self.h))}

    def __post_init__(self) -> None:
        """Skips the checks of options: there are none."""

    def simulate(self, x: Array) -> Array:
        return repeated(self.h, len(x))

    def jacobian(self, x: Array) -> Array:
        return np.zeros((len(x), len(self.h), 0))


@dataclass(frozen=True, kw_only=True)
class Likelihood(Objective):
    """Computes -2 times the log likelihood, as a sum of squares."""

    levelled: Levelled

    def _split(self, x: Array) -> tuple[Array, Array, Array]:
        """Splits residuals into whitened ones (trials, m), log sigma, and the levels' logarithms
        less their start."""
        m = self.readings
        h, log, theta = np.split(self.model.simulate(x, self.rows), [m, 2 * m], axis=1)
        w = (self.levelled.near(h, self.z) - self.z) * np.exp(-log)
        return w, log, theta - self.levelled.theta

    def residual(self, x: Array) -> Array:
        w, _, moved = self._split(x)
        f = self.levelled.spare
        # The gradient of w^2 + 2 f log sigma by log sigma is 2 (f - w^2): residual times slope.
        second = (f - w**2) / np.sqrt(f + w**2)
        return np.concatenate([w, second, _HOLD * moved], axis=1)

    def jacobian(self, x: Array, *, coarse: Mask | bool = False) -> Array:
        """Computes slopes that give the second residuals f + w^2, of Fisher's mean 2 f: steps of
        log sigma are below 1."""
        w, log, moved = self._split(x)
        by_log = np.sqrt(self.levelled.spare + w**2)
        weights = np.concatenate([np.exp(-log), by_log, np.full(moved.shape, _HOLD)], axis=1)
        J = self.model.jacobian(x, self.rows, coarse=coarse)
        return J * weights[:, :, None]

    def cost(self, x: Array, r: Array) -> Array:
        w, log, moved = self._split(x)
        # The logarithm of sigma over R's, raised by a shift that keeps the objective positive.
        change = 2 * self.levelled.spare * (log - np.log(self.R.factor) + _SHIFT)
        held = np.sum((_HOLD * moved) ** 2, axis=1)
        return np.sum(w**2 + change, axis=1) + held


def objective_of(problem: Problem, z: Array, model: CountingModel | None = None) -> Objective:
    """Returns the objective for readings z (trials, m): -2 times the log likelihood if x has
    levels, else the sum of squares. `model` replaces the problem's."""
    whole = problem.measurement
    counting = model or CountingModel(whole, EvaluationCount.zeros(len(z)))
    given = counting, problem.R, z, np.arange(len(z)), problem.x0
    if isinstance(whole, Levelled):
        return Likelihood(*given, levelled=whole)
    return Objective(*given)


def maximise_likelihood(problem: Problem, z: Array, x: Array) -> Minima:
    """Minimises `objective_of` for readings z (trials, m) from x (trials, n), with its values as
    `chi_square`."""
    model = problem.measurement
    limits = Limits(_TOLERANCE, _MOST_STEPS)
    with np.errstate(all="ignore"):
        objective = objective_of(problem, z)
        minima = minimize(objective, LevenbergMarquardtMethod(1e-3), x, limits)
        value = objective.cost(minima.x, objective.residual(minima.x))
        shift = 0.0
        if isinstance(model, Levelled):
            shift = 2 * _SHIFT * model.spare.sum()
        return replace(minima, chi_square=value - shift)


@dataclass(frozen=True)
class Estimated:
    """Holds a model's parameters and levels, with what is known of their errors."""

    problem: Problem
    """Its measurement is `Levelled`, its R is that of the levels."""
    x: Array
    """The parameters, and the logarithms of the levels (n + k,)."""
    converged: bool
    P: Array
    """Covariance (n + k, n + k): the inverse of Fisher's information."""
    freedom: Array
    """Degrees of freedom (n + k,) behind each variance of a parameter (Satterthwaite, Biometrics
    Bulletin 2, 1946); infinite for levels."""
    deviance: float
    """-2 times the log likelihood, less a constant of the readings."""
    maximal: bool = False
    """Whether the parameters, too, are those of maximum likelihood."""

    @property
    def reading_freedom(self) -> Array:
        """The degrees of freedom (m,) that the level of each reading's group is estimated from."""
        group = self.model.noise.group
        return np.bincount(group, self.model.spare)[group]

    @property
    def fitted(self) -> Array:
        """h (m,) at the parameters."""
        m = len(self.model.spare)
        return self.model.simulate(self.x[None])[0, :m]

    @property
    def model(self) -> Levelled:
        model = self.problem.measurement
        assert isinstance(model, Levelled)
        return model


def levels_at(problem: Problem, levels: Levels, theta: Array, z: Array, x: Array) -> Estimated:
    """Finds the levels of maximum restricted likelihood at x (n,) from theta (k,), with R's
    leverages; NaN without h.

    Raises:
        UserError: a group has too few readings for its levels, or residuals of zero.
    """
    model = problem.measurement
    h = CountingModel.uncounted(model, 1).simulate(x[None], np.arange(1))[0]
    h = model.near(h, z)
    if not np.isfinite(h).all():
        return _unknown(problem, levels, x, len(theta), len(z))
    J = model.jacobian(x[None])[0]
    _require_residuals(levels, z, z - h, J)
    spare = _spare(J, problem.R)
    # The search starts from levels as large as each group's residuals.
    w = levels.covariance(h, theta).whiten(z - h)
    theta = theta + first_levels(levels, w * levels.weights)
    # With h known, the levels are the only parameters.
    known = Levelled(_Known(h), levels, theta, spare)
    R = _covariance(levels, known.whole, theta)
    found = maximise_likelihood(Problem(known, R), z[None], theta[None])
    whole_x = np.concatenate([x, found.x[0]])
    return _estimated(problem, levels, spare, z, whole_x, bool(found.converged[0]))


def _unknown(problem: Problem, levels: Levels, x: Array, k: int, m: int) -> Estimated:
    """Returns parameters x (n,) with k levels of which nothing is known."""
    none = np.full(k, np.nan)
    model = Levelled(problem.measurement, levels, none, np.ones(m))
    P = np.full((len(x) + k,) * 2, np.nan)
    joint = replace(problem, measurement=model)
    return Estimated(joint, np.concatenate([x, none]), False, P, P[0], np.inf)


def maximum(start: Estimated, z: Array) -> Estimated:
    """Finds the maximum of the restricted likelihood of readings z (m,) near a start."""
    found = start
    # Leverages are those of the last maximum: they and the maximum are found in turns.
    for _ in range(_MOST_ROUNDS):
        minima = maximise_likelihood(found.problem, z[None], found.x[None])
        x = minima.x[0]
        if not np.isfinite(x).all():
            return replace(found, converged=False)
        levels = found.model.noise
        whole = found.model.whole
        last = found.model.spare
        inner = x[None, : whole.n]
        J = whole.jacobian(inner)[0]
        h = found.model.near(whole.simulate(inner)[0], z)
        _require_residuals(levels, z, z - h, J)
        R = _covariance(levels, whole, x)
        spare = _spare(J, R)
        problem = replace(found.problem, measurement=whole, R=R)
        found = _estimated(problem, levels, spare, z, x, bool(minima.converged[0]))
        if np.abs(spare - last).max() < _SAME_LEVERAGE:
            break
    return replace(found, maximal=True)


def _covariance(levels: Levels, model: Measurement, x: Array) -> Covariance:
    """Returns R where the parameters and the logarithms of levels are x (n + k,)."""
    n = model.n
    return levels.covariance(model.simulate(x[None, :n])[0], x[n:])


def _spare(J: Array, R: Covariance) -> Array:
    """Computes 1 - leverage (m,) of each reading."""
    leverage = np.sum(explained(J, R) ** 2, axis=1)
    return np.maximum(1.0 - leverage, _LEAST_SPARE)


def _estimated(
    problem: Problem, levels: Levels, spare: Array, z: Array, x: Array, converged: bool
) -> Estimated:
    """Computes what is known of the errors of parameters and logarithms of levels x (n + k,)."""
    whole = problem.measurement
    m = len(z)
    n = whole.n
    k = len(x) - n
    model = Levelled(whole, levels, x[n:], spare)
    R = _covariance(levels, whole, x)
    deviation = problem.prior_deviation
    if deviation is not None:
        deviation = np.concatenate([deviation[:n], np.ones(k)])
    joint = replace(
        problem, measurement=model, R=R, prior_deviation=deviation, prior_correlation=None
    )
    h = whole.near(whole.simulate(x[None, :n])[0], z)
    w = R.whiten(z - h)
    deviance = float(np.sum(w**2 + 2 * np.log(R.factor)))
    slopes = model.jacobian(x[None])[0]
    J = R.whiten_jacobian(slopes[:m])
    L = slopes[m : 2 * m]
    with np.errstate(all="ignore"):
        # Fisher's information is J'J + 2 L' diag(f) L, L being the slopes of log sigma.
        U = np.concatenate([J, np.sqrt(2 * spare)[:, None] * L])
        inverse_U = inverse_factor(U[None])[0]
        P = inverse_U @ inverse_U.T
        freedom = satterthwaite(P[:n, :n], P[n:, n:], J[:, :n], L[:, n:])
    freedom = np.concatenate([freedom, np.full(k, np.inf)])
    return Estimated(joint, x, converged, P, freedom, deviance)


def satterthwaite(P: Array, of_levels: Array, J: Array, by_theta: Array) -> Array:
    """Computes the degrees of freedom (..., n) behind the variances v in P (..., n, n): 2 v^2 /
    var(v), which is 2 / var(log v).

    The logarithm of a variance changes with the logarithms of levels by `change`, and those have a
    covariance (..., k, k).
    """
    squares = ((J @ P) ** 2).swapaxes(-1, -2)
    change = 2 * squares @ by_theta / deviations(P)[..., None] ** 2
    return 2.0 / deviations(change @ of_levels @ change.swapaxes(-1, -2)) ** 2


def _require_residuals(levels: Levels, z: Array, r: Array, J: Array) -> None:
    """Refuses levels of groups that the parameters can meet exactly, or have met."""
    size = np.linalg.norm(J, axis=0)
    scaled = J / divisors(size)
    known = np.isfinite(J).all()
    if len(r) < J.shape[1] + len(levels.parameters):
        names = ", ".join(p.name for p in levels.parameters)
        raise UserError(
            f"noise=unknown: {len(r)} readings are too few for {J.shape[1]} parameters and the"
            f" noise {names}; state the noise, as in noise.deviation=0.1, or add readings"
        )
    for k, name in enumerate(levels.groups):
        rows = np.flatnonzero(levels.group == k)
        told = f"of {name} " if name else ""
        rank = np.linalg.matrix_rank(scaled[rows]) if known else 0
        if len(rows) - rank < len(levels.names):
            raise UserError(
                f"noise=unknown: the {len(rows)} readings {told}are too few to determine"
                f" {', '.join(levels.names)} in addition to {rank} parameters; state the noise, as"
                " in"
                " noise.deviation=0.1, or let more readings share a level"
            )
        if not np.linalg.norm(r[rows]) > _LEAST_SHARE * np.linalg.norm(z[rows]):
            raise UserError(
                f"noise=unknown: the level {told}cannot be estimated from residuals of zero; state"
                " the noise, as in noise.deviation=0.1"
            )


def first_levels(levels: Levels, z: Array) -> Array:
    """Returns logarithms (k,) of levels as large as each group's readings."""
    squares = np.bincount(levels.group, (z / levels.weights) ** 2)
    mean = np.sqrt(squares / np.bincount(levels.group))
    logarithms = np.log(divisors(mean))
    return np.repeat(logarithms, len(levels.names))
