"""The formulas of the statistics: each takes a sample, and gives a number or one for each parameter
(n,).

Values per parameter are in multiples of the parameters' sizes. A mean over no trials is NaN.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

import numpy as np
from scipy.special import betaincinv, gammaincinv, ndtri

from ipe_bench.basics.linalg import Array, divisors, finite, finite_or
from ipe_bench.statistics.calibration import overall_words
from ipe_bench.statistics.intervals import (
    LEVEL,
    MeanNees,
    Squares,
    capped_interval,
    few_carry,
    mean_limits,
    mean_nees,
    quantile,
    rms_interval,
    unseen,
)
from ipe_bench.statistics.sample import AMBIGUOUS, FIT, FLOOR, NIS, Sample
from ipe_bench.trials.thresholds import FIT_LEVEL, gate

T = TypeVar("T")
Ends = tuple[Any, ...]
"""Both ends of an interval."""
CAP = 5.0
"""Upper limit of a trial's error over the bound in `efficiency_capped`: an efficient estimate lies
beyond it in fewer than one trial in a million."""
NORMAL_95 = float(-ndtri(0.025))
"""Absolute value that 95 % of normal deviates do not exceed."""


def once(formula: Callable[[Sample], T]) -> Callable[[Sample], T]:
    """Caches a formula for each sample."""

    @wraps(formula)
    def kept(s: Sample) -> T:
        if formula not in s.kept:
            with np.errstate(all="ignore"):
                s.kept[formula] = formula(s)
        return s.kept[formula]

    return kept


def mean(values: Array, used: Array | None = None) -> Array:
    """Computes the mean (k,) of columns (trials, k) over the trials used; NaN if there is none."""
    chosen = _chosen(values.T, used)
    count = chosen.shape[1]
    if not count:
        return np.full(len(chosen), np.nan)
    return chosen.sum(axis=1) / count


def _chosen(rows: Array, used: Array | None) -> Array:
    """Selects rows (k, trials) of the trials used."""
    return rows if used is None or used.all() else rows[:, used]


def average(values: Array) -> float:
    """Computes the mean of values; NaN if there is none."""
    return float(values.mean()) if values.size else np.nan


share = average
"""Of truths it is their share."""


def ratio(a: Any, b: Any) -> Array:
    """Computes a / b; NaN where b is not above 0."""
    a = np.asarray(a, dtype=float)
    b = np.asarray(b, dtype=float)
    return np.where(b > 0, a / b, np.nan)


def rms(values: Array) -> float:
    size = np.abs(values).max(initial=0.0)
    # The squares of larger numbers are infinite.
    if not 1e150 < size < np.inf:
        size = 1.0
    mean_square = np.mean((values / size) ** 2)
    return float(size * np.sqrt(mean_square))


def chi_square_quantile(degrees: int, probability: Any) -> Any:
    """Computes quantiles of the chi-square law, whose half follows a gamma law."""
    return 2 * gammaincinv(degrees / 2, probability)


def rms_columns(values: Array, used: Array | None = None) -> Array:
    """Computes the root mean squares (n,) of columns (trials, n) over the trials used."""
    return np.sqrt(mean(values**2, used))


def in_units(values: Array, s: Sample) -> Array:
    """Converts values (n,) to the parameters' own units, followed by their root mean square over
    the linear bound."""
    return np.append(values * s.sizes, rms(values / s.linear_bound))


def of_each(values: Callable[[Sample], Array]) -> Callable[[Sample], Array]:
    """Turns a formula of values (n,) into one of the shown values (n + 1,); see `in_units`."""
    return lambda s: in_units(values(s), s)


# Errors -------------------------------------------------------------------------------------------


@once
def rmse(s: Sample) -> Array:
    return rms_columns(s.error, s.solved)


@once
def rmse_all(s: Sample) -> Array:
    return rms_columns(finite_or(np.inf, s.error))


@once
def products(s: Sample) -> Array:
    """Computes sums (n, n) over solved trials of products of centred errors, in multiples of the
    linear bound: parameters may differ by many orders of magnitude."""
    normalised = s.error / _unit(s)
    chosen = _chosen(normalised.T, s.solved)
    centred = chosen - mean(chosen.T)[:, None]
    return centred @ centred.T


def _unit(s: Sample) -> Array:
    return divisors(s.linear_bound)


@once
def std(s: Sample) -> Array:
    """Computes the standard deviation (n - 1)."""
    count = int(s.solved.sum())
    if count < 2:
        return np.full(s.n, np.nan)
    return _unit(s) * np.sqrt(np.diag(products(s)) / (count - 1))


@once
def together(s: Sample) -> Array:
    """Computes the root mean square over parameters of error over linear bound (trials,)."""
    return np.sqrt((s.normalised**2).T.mean(axis=0))


def _all_squares(s: Sample) -> Array:
    """Computes squared errors (n + 1, trials) of each parameter, and of all together over the
    linear bound."""
    whole = (s.normalised**2).T.mean(axis=0)
    return np.vstack([(s.error**2).T, whole])


@once
def squares(s: Sample) -> Squares:
    """Computes squared errors of solved trials, of each parameter, and of all together over the
    linear bound."""
    return Squares.of(_chosen(_all_squares(s), s.solved))


@once
def degrees(s: Sample) -> Array:
    """Computes the degrees of freedom (n + 1,) of these squares if errors are normal: 1 of each
    parameter; of all parameters what matches the variance (Satterthwaite, Biometrics 2, 1946)."""
    factors = _unit(s) / s.linear_bound
    scaled = products(s) * np.outer(factors, factors)
    # The squared sum of the covariance's eigenvalues over the sum of their squares.
    matching = np.trace(scaled) ** 2 / np.sum(scaled**2)
    whole = 1.0
    if 1 <= matching <= s.n + 1e-6:
        whole = np.floor(matching + 1e-9)
    return np.array([*np.ones(s.n), whole])


@once
def rmse_unseen(s: Sample) -> Array:
    """Computes shares (n + 1,) of trials that may have larger errors than those seen; see
    `intervals.unseen`."""
    return unseen(_chosen(_all_squares(s), s.solved), degrees(s))


@once
def rmse_ends(s: Sample) -> tuple[Array, Array]:
    """Computes ends (n + 1,) of the intervals of rmse: per parameter, and of all over the linear
    bound; the upper one is NaN where larger errors may be unseen, and where few trials carry the
    sum, see `intervals.few_carry`."""
    low, high = rms_interval(_all_squares(s).T, s.solved)
    few = few_carry(squares(s), degrees(s))
    unknown = few | (rmse_unseen(s) > 0)
    return low, np.where(unknown, np.nan, high)


def ends_in_units(ends: Callable[[Sample], tuple[Array, Array]]) -> Callable[[Sample], Ends]:
    def shown(s: Sample) -> Ends:
        low, high = ends(s)
        factors = np.append(s.sizes, 1.0)
        return low * factors, high * factors

    return shown


def error_quantile(s: Sample, q: float) -> Array:
    """Computes a quantile of each parameter's absolute error, and of `together` (n + 1,)."""
    each = np.array([quantile(np.abs(e), q) for e in s.error.T])
    return np.append(each * s.sizes, quantile(together(s), q))


def over_bound(s: Sample) -> Array:
    """Computes Mahalanobis errors (trials,) over √n: about 1 where the estimate is efficient."""
    return s.distance / np.sqrt(s.n)


def _capped(s: Sample) -> Array:
    return np.minimum(over_bound(s), CAP)


def efficiency_capped(s: Sample) -> float:
    return float(ratio(1.0, rms(_capped(s))))


def efficiency_capped_limits(s: Sample) -> Ends:
    squared = over_bound(s)[None] ** 2
    (low,), (high,) = capped_interval(squared, np.array([s.n]), CAP)
    return float(ratio(1.0, high)), float(ratio(1.0, low))


def capped_error(s: Sample) -> float:
    """Computes the mean Mahalanobis error of the trials that all estimators have, each at most the
    gate's radius."""
    radius = np.sqrt(gate(s.n))
    return average(np.minimum(s.distance[s.present], radius))


def _tests_fit(s: Sample) -> bool:
    """Returns whether the estimator tests the fit of its residuals in any trial."""
    return FIT in s.scalars and bool(np.isfinite(s.scalars[FIT]).any())


def failed(s: Sample, *, known: bool) -> float:
    """Computes the share that fails, by whether the estimator itself gives notice of it."""
    noticed = ~s.converged
    if _tests_fit(s):
        noticed = noticed | ~(s.scalars[FIT] >= FIT_LEVEL)
    if AMBIGUOUS in s.scalars:
        noticed = noticed | (s.scalars[AMBIGUOUS] > 0)
    return share(~s.scalars["success"] & (noticed == known))


def misfit(s: Sample) -> float:
    if not _tests_fit(s):
        return np.nan
    # Residuals that are not finite do not fit.
    return share(~(s.scalars[FIT] >= FIT_LEVEL))


def _stated(s: Sample, name: str) -> Array:
    """Selects the finite values of a column that not every estimator has."""
    values = s.scalars.get(name, np.empty(0))
    return values[np.isfinite(values)]


def ambiguous(s: Sample) -> float:
    """Computes the share of ambiguous trials among those in which the estimator has looked for
    several minima."""
    return share(_stated(s, AMBIGUOUS) > 0)


def failures_flagged(s: Sample) -> float:
    if not len(_stated(s, AMBIGUOUS)):
        return np.nan
    wrong = ~s.scalars["success"]
    return share(s.scalars[AMBIGUOUS][wrong] > 0)


def false_root_distance(s: Sample) -> float:
    wrong = s.converged & ~s.solved
    if "root_distance" not in s.scalars or not wrong.any():
        return np.nan
    return quantile(s.scalars["root_distance"][wrong], 0.5)


# Bounds and theory --------------------------------------------------------------------------------


@once
def crlb(s: Sample) -> Array:
    return rms_columns(s.of_truth("crlb"), s.solved)


@once
def bayes(s: Sample) -> Array:
    return rms_columns(s.of_truth("bayes"), s.solved)


def applying_bound(s: Sample) -> Array:
    """Returns the bound that the estimator is held against: the Bayesian one if it uses a prior."""
    return bayes(s) if s.group.footer["bound"] == "bayes" else crlb(s)


def efficiency(s: Sample) -> Array:
    return ratio(in_units(applying_bound(s), s), in_units(rmse(s), s))


def efficiency_limits(s: Sample) -> Ends:
    bound = in_units(applying_bound(s), s)
    low, high = ends_in_units(rmse_ends)(s)
    return ratio(bound, high), ratio(bound, low)


def efficiency_all(s: Sample) -> Array:
    bound = rms_columns(s.of_truth(s.group.footer["bound"]))
    error = rmse_all(s)
    whole = ratio(rms(bound / s.linear_bound), rms(error / s.linear_bound))
    return np.append(ratio(bound, error), whole)


@once
def van_trees(s: Sample) -> tuple[Array, Array]:
    """Computes the bound (n,) over the first trials of the seeds, and its standard error: of the
    mean of squared bounds, whose errors are twice the bound times its own."""
    bound = s.of_truth("van_trees")
    error = s.of_truth("van_trees_error")
    drawn: Array = np.asarray(~np.isnan(bound[:, 0]))
    number = max(1, int(drawn.sum()))
    middle = np.sqrt(mean(bound**2, drawn))
    squared_error = mean((2 * bound * error) ** 2, drawn)
    error_of_square = np.sqrt(squared_error / number)
    return middle, error_of_square / (2 * middle)


def van_trees_limits(s: Sample) -> Ends:
    """Computes limits of the bound for infinitely many truths, by the scatter of the information
    among those used."""
    bound, error = van_trees(s)
    low = np.maximum(bound - NORMAL_95 * error, 0.0)
    high = bound + NORMAL_95 * error
    return in_units(low, s), in_units(high, s)


def eq_14(s: Sample) -> Array:
    r"""Computes standard deviations (n,) by eq. (14), with dN = N(x) - N(x^): at a root of eq.
    (11), H+ dN is the error less H+ v.

    .. math:: P = H^+ R H^{+T} + H^+ \, \mathrm{E}(\delta N \, \delta N^T) \, H^{+T}
    """
    if s.group.footer.get("equation") != "frozen":
        return np.full(s.n, np.nan)
    of_compensation = s.error - s.of_truth("linear_error")
    return np.sqrt(s.linear_bound**2 + mean(of_compensation**2, s.solved))


@once
def predicted(s: Sample) -> tuple[Array, Array]:
    """Computes the bias (n,) and root mean square error (n,) expected of least squares; NaN for
    other estimators.

    Where readings come from another model, from each trial's pseudo-true parameters and the scatter
    about them; where they do not, from the Cramér-Rao bound and Box's bias.
    """
    if s.group.footer.get("equation") != "least_squares":
        unknown = np.full(s.n, np.nan)
        return unknown, unknown
    if s.group.footer["identity"]["scenario"].get("truth") is not None:
        wrong = s.of_truth("pseudo_bias")
        scatter = s.of_truth("misspecified")
        used = s.solved & finite(wrong) & finite(scatter)
        return mean(wrong, used), np.sqrt(mean(wrong**2 + scatter**2, used))
    box = s.of_truth("box_bias")
    known = finite(box)
    variance = mean(s.of_truth("crlb") ** 2, s.solved)
    squared_bias = mean(box**2, known)
    total = variance + np.where(np.isnan(squared_bias), 0.0, squared_bias)
    return mean(box, known), np.sqrt(total)


def median_of_truth(s: Sample, name: str) -> float:
    values = s.of_truth(name)
    return quantile(values[np.isfinite(values)], 0.5)


# What estimators claim ----------------------------------------------------------------------------


@once
def reports_covariance(s: Sample) -> bool:
    return bool(np.isfinite(s.deviation).any())


@once
def nees(s: Sample) -> Array:
    if not (reports_covariance(s) and s.solved.any()):
        return np.full(s.n + 1, np.nan)
    each = mean((np.abs(s.error) / s.deviation) ** 2, s.solved)
    whole = np.mean(s.scalars["nees"][s.solved])
    return np.append(each, whole / s.n)


def nees_limits(s: Sample) -> Ends:
    if not reports_covariance(s):
        return np.nan, np.nan
    solved = int(s.solved.sum())
    low, high = mean_limits(1, solved)
    low_of_all, high_of_all = mean_limits(s.n, solved)
    return np.append([low] * s.n, low_of_all), np.append([high] * s.n, high_of_all)


def nees_median(s: Sample) -> float:
    if not reports_covariance(s):
        return np.nan
    return quantile(s.scalars["nees"], 0.5) / chi_square_quantile(s.n, 0.5)


def nees_median_limits(s: Sample) -> Ends:
    """Computes limits of the median of N independent values, whose probability is
    beta-distributed."""
    if not reports_covariance(s):
        return np.nan, np.nan
    middle = (len(s) + 1) / 2
    probabilities = betaincinv(middle, middle, np.array([0.025, 0.975]))
    ends = chi_square_quantile(s.n, probabilities)
    return tuple(ends / chi_square_quantile(s.n, 0.5))


@once
def coverage(s: Sample) -> Any:
    if not reports_covariance(s):
        return np.nan
    each = mean(np.abs(s.error) / s.deviation <= NORMAL_95)
    inside = s.scalars["nees"] <= chi_square_quantile(s.n, 0.95)
    return np.append(each, share(inside))


def mean_nees_of(nees: Array, degrees: int, s: Sample) -> MeanNees:
    """Computes the mean NEES of the converged trials with its interval at a level that all verdicts
    of a setting share (Bonferroni): where all covariances are right, none is called wrong in 95 %
    of the reports."""
    level = 1 - (1 - LEVEL) / s.verdicts
    return mean_nees(nees[s.converged], degrees, level)


@once
def claimed(s: Sample) -> MeanNees:
    return mean_nees_of(s.scalars["nees"], s.n, s)


def calibration_p(s: Sample) -> Any:
    """Computes the p of each parameter, and of all by Bonferroni's correction, which needs no
    independence."""
    p = [part.p for part in s.calibrations]
    if not p:
        return np.nan
    return [*p[:-1], min(1.0, len(p) * min(p))]


def calibration(s: Sample) -> Any:
    words = overall_words(s.calibrations, s.names)
    if not s.calibrations:
        return words
    return [*(part.words for part in s.calibrations[:-1]), words]


def mean_nis(s: Sample) -> float:
    return average(_stated(s, NIS))


# Iterations ---------------------------------------------------------------------------------------


def _uses(s: Sample, method: str) -> bool:
    """Returns whether the estimator iterates by that method on the frozen equation."""
    if s.group.footer.get("equation") != "frozen":
        return False
    config = s.group.footer["identity"]["estimator"] or {}
    return str(config.get("_target_", "")).rpartition(".")[2] == method


def fixed_point_bound(iterates: Array, K: float) -> tuple[bool, float]:
    """Computes whether the largest error |x_k - x| of each iterate (iterates, n) is at most K^k /
    (1 - K) |x_1 - x_0|, eq. (18) with the k that the print lost, for K below 1, and the largest
    such ratio of the iterates between the ends.

    The last iterate is taken for x (Burden and Faires, Numerical Analysis). The bound is proven for
    a K that holds all along the iterates.
    """
    error = np.abs(iterates - iterates[-1]).max(axis=1)
    first_step = np.abs(iterates[1] - iterates[0]).max()
    bound = K ** np.arange(len(iterates)) / (1 - K) * first_step
    round_off = 1e-12 * (1.0 + error.max())
    holds = bool(np.all(error <= bound + round_off))
    between = (error / bound)[1:-1]
    resolved = error[1:-1] > FLOOR
    return holds, float(between[resolved].max(initial=0.0))


def observed_constant(iterates: Array) -> float:
    """Computes the least M with which eq. (23), e_(k+1) <= n^2 M / 2 e_k^2, explains the errors of
    iterates (iterates, n) that exceed round-off, with the last iterate for the root; NaN where they
    are over too soon."""
    error = np.abs(iterates - iterates[-1]).max(axis=1)
    before = error[:-1]
    after = error[1:]
    usable = (before > FLOOR) & (after > FLOOR)
    n = iterates.shape[1]
    # M of each step, by eq. (23).
    constants = 2 * after[usable] / (n**2 * before[usable] ** 2)
    return float(constants.max()) if len(constants) else np.nan


@once
def fixed_point_bounds(s: Sample) -> Array:
    """Computes `fixed_point_bound` (histories, 2) of each history of fixed-point iteration whose K
    is below 1."""
    histories = s.histories if _uses(s, "FixedPoint") else ()
    found = [fixed_point_bound(h.iterates, h.K) for h in histories if h.K < 1]
    return np.array(found).reshape(-1, 2)


@once
def constants(s: Sample) -> Array:
    """Computes M as observed and at the truth (histories, 2), of each history of Newton's method
    that has both."""
    histories = s.histories if _uses(s, "Newton") else ()
    found = [(observed_constant(h.iterates), h.M) for h in histories]
    pairs = np.array(found).reshape(-1, 2)
    return pairs[finite(pairs)]
