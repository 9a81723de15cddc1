"""What every number in the report means, and where it comes from: the report's appendix."""

from __future__ import annotations

from ipe_bench.statistics.comparisons import TIE
from ipe_bench.statistics.intervals import LARGEST_SAMPLE, RESAMPLES
from ipe_bench.statistics.profiles import CLOSE
from ipe_bench.trials.scoring import GATE, HISTORIES, SAME_ROOT

DEFINITIONS: tuple[tuple[str, str], ...] = (
    ("trial", "One draw of true parameters and of noise. Trial t is the same for every estimator."),
    (
        "error scale",
        "Standard deviation of the true parameters about the nominal point, in multiples of the parameters' unit"
        " inputs.",
    ),
    ("linear bound", "Standard deviation of the linear least-squares estimate, eq. (5), if the model were linear."),
    (
        "CRLB",
        "Cramér-Rao bound (J' R⁻¹ J)⁻¹ at the truth; shown is the root mean square over solved trials of its standard"
        " deviation. Bayesian bound: (J' R⁻¹ J + P₀⁻¹)⁻¹, which estimators that use a prior are compared with"
        " (Van Trees, Detection, Estimation, and Modulation Theory I, 1968, sec. 2.4).",
    ),
    (
        "converged",
        "The estimating equation holds within the tolerance. The other endings are named with their messages.",
    ),
    (
        "solved",
        f"Converged to the root, within {SAME_ROOT:g} standard deviations, that the same estimating equation reaches"
        " when it is started at the truth. False root: converged and not solved."
        " Filters and the linear LSE solve no equation: for them it means that they finished.",
    ),
    (
        "success",
        "The error lies inside the ellipsoid of the bound at the truth that all but a share of"
        f" {GATE:g} of efficient estimates lie in (chi-square quantile); the Bayesian bound's for estimators that use a"
        " prior. Interval: Clopper and Pearson, Biometrika 26, 1934.",
    ),
    ("shares", "Converged, solved, success and false root are shares of all trials."),
    ("bias, std, rmse", "Mean, standard deviation (n - 1) and root mean square of the error over solved trials."),
    (
        "interval of rmse",
        f"95 % percentile bootstrap over trials, {RESAMPLES} resamples, the same for every estimator; above"
        f" {LARGEST_SAMPLE} trials, groups of consecutive trials are resampled (Efron and Tibshirani, An Introduction"
        " to the Bootstrap, 1993, ch. 13).",
    ),
    ("rmse, common", "Over the trials that every estimator of the scenario solved."),
    (
        "parameter 'all'",
        "Root mean square over parameters of the statistic over the linear bound. For median and 95 % error: of each"
        " trial's root mean square over parameters of error over linear bound.",
    ),
    ("efficiency", "Bound over rmse, as standard deviations: 1 for an efficient estimator."),
    ("median, 95 % error, coverage", "Over all trials; what is not finite counts as infinite, and as not covered."),
    (
        "NEES",
        "Mean over solved trials of e' P⁻¹ e / n with the covariance P that the estimator reports: 1 where it is right;"
        " per parameter, of squared error over reported variance. Limits: 95 % chi-square (Bar-Shalom, Li and"
        " Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, sec. 5.4).",
    ),
    (
        "coverage",
        "Share of trials whose truth lies inside the estimator's own 95 % ellipsoid; per parameter, interval.",
    ),
    (
        "misfit",
        "Share of trials whose residuals fail the chi-square test: |R^-1/2 (z - h(x))|² is larger than it would be in"
        " 0.1 % of trials if model and noise were right. It needs no truth, so it is known for real readings too.",
    ),
    (
        "Mahalanobis error",
        "sqrt(e' J' R⁻¹ J e): the error in standard deviations of the Cramér-Rao bound, about √n when efficient.",
    ),
    (
        "capped error",
        "Mean Mahalanobis error, each trial's at most the radius of the gate of success, so that failing badly is"
        " failing once.",
    ),
    (
        "win, tie, loss",
        f"Paired by trial; Mahalanobis errors that differ by less than {TIE:g} are a tie: estimators that share a root"
        " differ by round-off alone.",
    ),
    (
        "p of error",
        "Wilcoxon's signed-rank test, two-sided, ties left out (Biometrics Bulletin 1, 1945), Holm's correction over"
        " the pairs of a scenario (Scandinavian Journal of Statistics 6, 1979).",
    ),
    (
        "p of success",
        "McNemar's exact test on the trials in which one of two succeeds (Psychometrika 12, 1947), Holm's correction.",
    ),
    (
        "bold",
        "The smallest capped error of a scenario and all that do not differ from it significantly in p of error at 5 %;"
        " nothing is bold where nothing differs.",
    ),
    (
        "ranks",
        "By capped error within a scenario, ties sharing their mean rank; a scenario is one observation. Friedman's"
        " test (Journal of the American Statistical Association 32, 1937) and Nemenyi's critical difference (Demšar,"
        " Journal of Machine Learning Research 7, 2006).",
    ),
    (
        "cost",
        "Simulations of a trial, a Jacobian counting as many as there are parameters. Time: wall clock, a batch's"
        " shared evenly.",
    ),
    (
        "performance profile",
        "Share of trials in which an estimator succeeds at a cost of at most τ times that of the cheapest success"
        " (Dolan and Moré, Mathematical Programming 91, 2002).",
    ),
    (
        "data profile",
        "Share of trials in which it succeeds within a budget (Moré and Wild, SIAM Journal on Optimization 20, 2009).",
    ),
    (
        f"cost to {CLOSE:g} σ of limit",
        f"Until all further iterates are within {CLOSE:g} standard deviations of the last, in every parameter, over the"
        f" converged ones of the first {HISTORIES} trials; iterate k of K is taken to cost (k + 1) / (K + 1) of the"
        " trial.",
    ),
)
