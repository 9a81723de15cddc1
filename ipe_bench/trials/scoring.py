"""Runs trials through estimators: draws a block of a scenario, runs estimators on it, and scores
what they return.

A block is a range of trials; its result depends on nothing but the scenario, the estimator and the
range.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from ipe_bench.basics.linalg import (
    Array,
    Covariance,
    correlations,
    definite_factor,
    deviations,
    finite,
    gram,
    inverse,
    multiply,
    quadratic_form,
    read_only,
    solve,
)
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.base import Equation, Estimates, Estimator, estimate_safely
from ipe_bench.measurements.counted import CountingModel
from ipe_bench.measurements.problem import Problem
from ipe_bench.trials.fit_test import Spread, fit_probability, inflation_of, spread_of
from ipe_bench.trials.roots import frozen_root, least_squares_root
from ipe_bench.trials.theory import (
    bound_deviations,
    box_bias,
    contraction,
    curvature,
    informative_rows,
    misspecified,
    relative_curvatures,
    second_derivatives,
)
from ipe_bench.trials.thresholds import EVEN, EXPECTED, HISTORIES, SAME_ROOT, gate

if TYPE_CHECKING:
    from ipe_bench.trials.scenario import Scenario, Trials

CURVED = 20
"""Trials in which second derivatives are taken, which takes 2 n Jacobians each: the first ones of a
scenario."""

Columns = dict[str, Array]


@dataclass(frozen=True)
class Block:
    """Holds trials of a scenario with what the truth says of them: bounds and reference roots,
    computed when needed."""

    scenario: Scenario
    trials: Trials
    _roots: dict[tuple[Equation, float], Array] = field(
        default_factory=dict, repr=False, compare=False
    )
    _spreads: dict[tuple[Any, ...], Spread] = field(default_factory=dict, repr=False, compare=False)

    @classmethod
    def draw(cls, scenario: Scenario, start: int, stop: int) -> Block:
        with np.errstate(all="ignore"):
            return cls(scenario, scenario.draw(start, stop))

    @property
    def problem(self) -> Problem:
        return self.scenario.problem

    @cached_property
    def jacobian(self) -> Array:
        """dh/dx at the truth (trials, m, n)."""
        with np.errstate(all="ignore"):
            return self.problem.measurement.jacobian(read_only(self.trials.x))

    @cached_property
    def readings(self) -> Array:
        """h (trials, m) at the truth, of the model that estimators assume; NaN where it fails."""
        if self.trials.h is not None:
            return self.trials.h
        return self.readings_at(self.trials.x)

    @cached_property
    def _white(self) -> Array:
        """R^-1/2 J (trials, m, n) at the truth; see `informative_rows`."""
        with np.errstate(all="ignore"):
            return informative_rows(
                self.scenario.noise, self.problem.R, self.jacobian, self.readings
            )

    @cached_property
    def crlb_information(self) -> Array:
        """J' R^-1 J at the truth (trials, n, n), the inverse of the Cramér-Rao bound."""
        return _squared(self._white)

    @cached_property
    def bayes_information(self) -> Array:
        """J' R^-1 J + P0^-1 at the truth: the inverse of the Bayesian bound."""
        prior = self.problem.prior_covariance()
        if prior is None:
            return self.crlb_information
        return self.crlb_information + prior.inverse()

    @cached_property
    def crlb_deviation(self) -> Array:
        """Standard deviations (trials, n) of the Cramér-Rao bound at the truth."""
        with np.errstate(all="ignore"):
            return bound_deviations(self.crlb_information, self._white)

    @cached_property
    def bayes_deviation(self) -> Array:
        """Standard deviations (trials, n) of the Bayesian bound at the truth."""
        prior = self.problem.prior_covariance()
        with np.errstate(all="ignore"):
            rows = _below(self._white, prior) if prior else self._white
            return bound_deviations(self.bayes_information, rows)

    def truth_columns(self) -> Columns:
        """Returns the truth and its bounds, in multiples of the parameters' units, what the noise
        alone makes of the linear estimate, and what the paper's theorems ask of the model there."""
        names = [p.name for p in self.problem.measurement.parameters]
        H_plus = self.problem.H_plus[None]
        K, norm, radius = contraction(np.matmul(H_plus, self.jacobian))
        linear_error = multiply(H_plus, self.errors(self.readings))
        van_trees, van_trees_error = self._van_trees()
        return {
            "trial": np.arange(self.trials.start, self.trials.stop),
            **by_parameter("x", names, self.trials.x),
            **by_parameter("crlb", names, self.crlb_deviation),
            **by_parameter("bayes", names, self.bayes_deviation),
            **by_parameter("van_trees", names, van_trees),
            **by_parameter("van_trees_error", names, van_trees_error),
            **by_parameter("linear_error", names, linear_error),
            "contraction_K": K,
            "contraction_norm": norm,
            "contraction_radius": radius,
            **self._curvature_columns(names),
            **self._misspecification_columns(names),
        }

    def _van_trees(self) -> tuple[Array, Array]:
        """Deviations (trials, n) of Van Trees's bound (E[J' R^-1 J] + P0^-1)^-1 (Detection,
        Estimation, and Modulation Theory I, 1968, sec. 2.4), the mean taken over the first
        `EXPECTED` truths of the scenario, and their standard errors by the scatter of the
        information among these, to first order: in its first trial, and NaN in the others. No
        errors are known where few of the truths carry the mean."""
        bound, error = np.full((2, *self.trials.x.shape), np.nan)
        prior = self.problem.prior_covariance()
        first = self.trials.start == 0 and len(self) > 0
        if not first or prior is None or self.scenario.noise.real:
            return bound, error
        x = self.scenario.truths(0, EXPECTED)
        with np.errstate(all="ignore"):
            J = self.problem.measurement.jacobian(x)
            rows = informative_rows(self.scenario.noise, self.problem.R, J, self.readings_at(x))
            of_each = _squared(rows)
            expected = (of_each.mean(axis=0) + prior.inverse())[None]
            together = rows.reshape(1, -1, x.shape[1]) / np.sqrt(len(x))
            bound[0] = bound_deviations(expected, _below(together, prior))[0]
            P = inverse(expected)[0][0]
            # To first order P changes by -P dI P where the information changes by dI.
            variances = np.einsum("ij,tjk,ki->ti", P, of_each, P)
            least_square = EVEN * EXPECTED * (variances**2).sum(axis=0)
            if (variances.sum(axis=0) ** 2 >= least_square).all():
                of_variance = variances.std(axis=0, ddof=1) / np.sqrt(EXPECTED)
                error[0] = of_variance / (2 * bound[0])
        return bound, error

    def readings_at(self, x: Array) -> Array:
        """Computes h(x) (trials, m) for x (trials, n); NaN where the model fails."""
        model = CountingModel.uncounted(self.problem.measurement, len(x))
        return model.simulate(read_only(x), np.arange(len(x)))

    def errors(self, h: Array) -> Array:
        """Computes the readings (trials, m) less the error-free h, angles within half a turn."""
        return self.trials.z - self.problem.measurement.near(h, self.trials.z)

    def _curvature_columns(self, names: list[str]) -> Columns:
        """Computes what second derivatives at the truth say, for the first trials and NaN for the
        others: M of eq. (23), the relative curvatures, and the bias of least squares."""
        kept = max(0, min(CURVED, self.trials.stop) - self.trials.start)
        M, intrinsic, parametric = np.full((3, len(self)), np.nan)
        bias = np.full(self.trials.x.shape, np.nan)
        if kept:
            R = self.problem.R
            J = self.jacobian[:kept]
            with np.errstate(all="ignore"):
                second = second_derivatives(self.problem.measurement, self.trials.x[:kept])
                usable = finite(J) & finite(second)
                J = np.where(usable[:, None, None], J, np.nan)
                second = np.where(usable[:, None, None, None], second, np.nan)
                bias[:kept] = box_bias(J, second, R)
                intrinsic[:kept], parametric[:kept] = relative_curvatures(J, second, R)
                M[:kept] = curvature(J, second, self.problem.H_plus[None])
        return {
            "curvature_M": M,
            "curvature_intrinsic": intrinsic,
            "curvature_parameter": parametric,
            **by_parameter("box_bias", names, bias),
        }

    def _misspecification_columns(self, names: list[str]) -> Columns:
        """Computes where least squares goes, and how it scatters there, when readings come from
        another model; empty where they do not, and where estimators assume another R than that of
        the noise."""
        if self.scenario.truth is None or not self.scenario.noise.true_covariance:
            return {}
        h = self.scenario.error_free(self.trials.start, self.trials.stop)
        with np.errstate(all="ignore"):
            closest = least_squares_root(self.problem, h, self.trials.x, prior=None)
            bias, deviation = misspecified(self.problem, h, self.trials.x, closest)
        return {
            **by_parameter("pseudo_bias", names, bias),
            **by_parameter("misspecified", names, deviation),
        }

    def reference_root(self, equation: Equation, inflation: float = 1.0) -> Array:
        """Finds the root (trials, n) that an estimating equation reaches from the truth; NaN where
        it reaches none.

        `inflation` widens the prior of the equation `map`.
        """
        key = (equation, inflation)
        if key not in self._roots:
            with np.errstate(all="ignore"):
                self._roots[key] = self._root(equation, inflation)
        return self._roots[key]

    def _root(self, equation: Equation, inflation: float) -> Array:
        z = self.trials.z
        x = self.trials.x
        known = (self.readings, self.jacobian)
        if equation != "frozen":
            prior = inflation if equation == "map" else None
            return least_squares_root(self.problem, z, x, prior=prior, known=known)
        # Without a rank there is no such equation; the estimators that solve it say so.
        if self.problem.rankless:
            return np.full(x.shape, np.nan)
        return frozen_root(self.problem, z, x, known)

    def warm_up(self, estimator: Estimator) -> None:
        """Runs the estimator once, so that imports and compilation are not timed."""
        estimate_safely(estimator, self.problem, self.trials.z[:1])

    def share(self) -> None:
        """Computes what all estimators share."""
        _ = self.crlb_information

    def __len__(self) -> int:
        return len(self.trials.x)

    @property
    def start(self) -> int:
        return self.trials.start

    def estimate(self, estimator: Estimator) -> tuple[Estimates, Columns]:
        """Returns what an estimator makes of the block, and its score."""
        history = self.trials.start < HISTORIES
        estimates = estimate_safely(estimator, self.problem, self.trials.z, history=history)
        with np.errstate(all="ignore"):
            return estimates, self.score(estimator, estimates)

    def _fit_probability(self, estimator: Estimator, x: Array) -> Array:
        """Computes the test of fit at x (trials, n); see `fit_test`."""
        problem = self.problem
        key = (estimator.equation, "prior" in estimator.needs, inflation_of(estimator))
        if key not in self._spreads:
            self._spreads[key] = spread_of(estimator, problem, self.jacobian)
        spread = self._spreads[key]
        r = problem.R.whiten(self.errors(self.readings_at(x)))
        with np.errstate(all="ignore"):
            squares = np.sum(r**2, axis=1)
        return fit_probability(squares, spread, self.scenario.noise, problem.H, problem.R)

    def score(self, estimator: Estimator, estimates: Estimates) -> Columns:
        """Scores each trial's error, cost, status and distances, as columns."""
        n = self.problem.measurement.n
        names = [p.name for p in self.problem.measurement.parameters]
        trials = len(self)
        error = estimates.x - self.trials.x
        # An estimate that is not finite has not converged, even if the estimator says so.
        lost = (estimates.status == Status.CONVERGED) & ~finite(error)
        status = np.where(lost, Status.NONFINITE, estimates.status)
        status = np.where(finite(self.trials.z), status, Status.NO_READINGS)
        labels = {s: Status(s).label for s in np.unique(status).tolist()}
        messages = [estimates.messages.get(i, "") for i in range(trials)]
        solved = status == Status.CONVERGED
        apart = np.full(trials, np.nan)
        if estimator.equation is not None:
            root = self.reference_root(estimator.equation, inflation_of(estimator))
            apart = (np.abs(estimates.x - root) / self.crlb_deviation).max(axis=1)
            solved = solved & (apart <= SAME_ROOT)
        bound = self.bayes_information if "prior" in estimator.needs else self.crlb_information
        # Round-off leaves squares below 0 where J lacks rank.
        success = np.maximum(quadratic_form(bound, error), 0.0) <= gate(n)
        crlb_distance = np.maximum(quadratic_form(self.crlb_information, error), 0.0)
        P = estimates.covariance
        if P is None:
            P = np.full((trials, n, n), np.nan)
        return {
            "trial": np.arange(self.trials.start, self.trials.stop),
            **by_parameter("error", names, error),
            **by_parameter("deviation", names, deviations(P)),
            "status": np.array([labels[s] for s in status.tolist()], dtype=object),
            "message": np.array(messages, dtype=object),
            "iterations": estimates.iterations,
            "simulations": estimates.simulations,
            "jacobians": estimates.jacobians,
            "time_s": estimates.seconds,
            "crlb_distance": crlb_distance,
            "nees": nees(error, P),
            "fit_p": self._fit_probability(estimator, estimates.x),
            "root_distance": apart,
            "solved": solved,
            "success": success,
            **{f"extra_{name}": values for name, values in estimates.extras.items()},
        }


def _squared(rows: Array) -> Array:
    """Computes A' A (trials, n, n) of rows A (trials, k, n)."""
    with np.errstate(all="ignore"):
        return gram(rows)


def _below(rows: Array, prior: Covariance) -> Array:
    """Appends the rows of the prior to the rows (trials, k, n) of each trial."""
    more = prior.whiten_jacobian(np.eye(rows.shape[2]))
    return np.concatenate([rows, np.broadcast_to(more, (len(rows), *more.shape))], axis=1)


def nees(error: Array, P: Array) -> Array:
    """Computes the normalised estimation error squared e' P^-1 e of each trial (trials,):
    chi-square with n degrees where the reported P is right.

    error (trials, n) and P (trials, n, n). Infinite where P is not a covariance (not positive
    definite) or the error is not finite; NaN where no P is reported.
    """
    with np.errstate(all="ignore"):
        # Scaled by the deviations first: parameters' units must not decide what is singular.
        e = error / deviations(P)
        C = correlations(P)
        usable = finite(e) & finite(C)
        e = np.where(usable[:, None], e, 0.0)
        C = np.where(usable[:, None, None], C, np.eye(error.shape[1]))
        # With U'U = C, e' C^-1 e is the square of U'^-1 e.
        _, inverse_U, definite = definite_factor(C)
        squared = np.sum(multiply(inverse_U.swapaxes(1, 2), e) ** 2, axis=1)
    if not definite.all():
        ill = C[~definite]
        e = e[~definite]
        x, singular = solve(ill, e)
        covariance = ~singular & (np.linalg.eigvalsh(ill)[:, 0] > 0)
        squared[~definite] = np.where(covariance, np.einsum("ti,ti->t", e, x), np.inf)
    squared = np.where(usable, squared, np.inf)
    return np.where(finite(P), squared, np.nan)


def by_parameter(prefix: str, names: list[str], values: Array) -> Columns:
    return {f"{prefix}_{name}": np.ascontiguousarray(values[:, i]) for i, name in enumerate(names)}
