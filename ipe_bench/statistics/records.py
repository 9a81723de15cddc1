"""Lists every statistic of ours, a record each; those of states that move are in `tracks`.

`summary_all.csv`, the appendix of the report, tables and the terminal are read from these lists;
`summary.csv` has what `MAIN` names. `registry` adds those of plugins; formulas longer than a line
are in `formulas`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

import ipe_bench.statistics.formulas as f
import ipe_bench.statistics.intervals as intervals
import ipe_bench.statistics.path_columns as t
from ipe_bench.basics.linalg import Array, finite
from ipe_bench.statistics.intervals import clopper_pearson, quantile, share_sequence
from ipe_bench.statistics.sample import CLOSE, NIS, Sample, iterations_to_limit, orders_of
from ipe_bench.statistics.statistic import Statistic
from ipe_bench.trials.thresholds import EVEN, EXPECTED, FEW, GATE, SAME_ROOT


def _all(
    name: str, title: str, meaning: str, values: Callable[[Sample], Any], **shown: Any
) -> Statistic:
    """Defines a statistic over all trials."""
    return Statistic(name, title, "all trials", meaning, values, **shown)


def _solved(
    name: str, title: str, meaning: str, values: Callable[[Sample], Any], **shown: Any
) -> Statistic:
    """Defines a statistic over the solved trials."""
    return Statistic(name, title, "solved trials", meaning, values, given="solved", **shown)


def _last_orders(s: Sample) -> Array:
    """Returns the last observed order of convergence of each history that has any."""
    orders = [orders_of(history.distances) for history in s.histories]
    return np.array([one[-1] for one in orders if len(one)])


def family_of(footer: Mapping[str, Any]) -> str:
    """Returns the family of an estimator: its declared one, else by its inputs and equation."""
    if footer.get("family"):
        return str(footer["family"])
    if footer.get("sequential"):
        return "filters"
    return "IPE" if footer.get("equation") == "frozen" else "least squares"


def given_of(footer: Mapping[str, Any]) -> str:
    """Returns what an estimator was given, in a word or two."""
    if "times" in footer:
        return "all readings" if footer.get("smooths") else "so far"
    return "prior" if footer["bound"] == "bayes" else "readings"


_CLAIMS = "converged trials with a reported covariance: reported failures are excluded"

STATISTICS: tuple[Statistic, ...] = (
    Statistic(
        "trials", "trials", "all trials", "Their number.", len, kind="count", where=("all_trials",)
    ),
    Statistic(
        "no_readings",
        "no readings",
        "further trials",
        "Number of trials whose true parameters give no finite readings. They count neither for"
        " nor against an estimator in any column.",
        lambda s: len(s.unread),
        kind="count",
        where=("overview", "terminal", "all_trials"),
        rare=True,
    ),
    _all(
        "converged",
        "converged",
        "Share of trials in which the estimating equation is solved within the tolerance. The other"
        " endings have their own names and messages.",
        lambda s: f.share(s.converged),
        kind="share",
        where=("all_trials",),
    ),
    _all(
        "solved",
        "solved",
        f"Share that converged to the root, within {SAME_ROOT:g} standard deviations, that the"
        " same estimating equation reaches if it starts at the truth. Filters and the linear LSE"
        " solve no equation; they count as solved if they finished.",
        lambda s: f.share(s.solved),
        kind="share",
        where=("solved_trials",),
    ),
    _all(
        "success",
        "success",
        "Share whose error lies inside the ellipsoid of the bound at the truth that all but a"
        f" share of {GATE:g} of efficient estimates lie in (chi-square quantile); the Bayesian"
        " bound's for estimators that use a prior. Interval: Clopper and Pearson, Biometrika 26,"
        " 1934.",
        lambda s: f.share(s.scalars["success"]),
        limits=lambda s: clopper_pearson(int(s.scalars["success"].sum()), len(s)),
        kind="share",
    ),
    _all(
        "success_anytime",
        "success, any time",
        "The same share with a 95 % interval that stays valid if it is looked at repeatedly and at"
        " any time of stopping, as runs with `precision` do (beta-binomial confidence sequence:"
        " Robbins, Ann. Math. Statist. 41, 1970; Howard et al., Ann. Statist. 49, 2021).",
        lambda s: f.share(s.scalars["success"]),
        limits=lambda s: share_sequence(int(s.scalars["success"].sum()), len(s)),
        kind="share",
    ),
    _all(
        "failed_known",
        "failed and known",
        "Share of trials without success that the estimator itself reports: it did not converge,"
        " its residuals fail the test of fit, or several minima or copies fit. A filter of states"
        " is tested by its innovations, an iterated smoother by the cost of its path, chi-square"
        " with a degree of freedom per reading.",
        lambda s: f.failed(s, known=True),
        kind="share",
        where=("all_trials",),
    ),
    _all(
        "failed_silent",
        "undetected failures",
        "Share of trials without success that converged to residuals that fit. These answers are"
        " wrong and look right.",
        lambda s: f.failed(s, known=False),
        kind="share",
        where=("all_trials",),
    ),
    _all(
        "error_median",
        "median error",
        "Median of the error over the bound, sqrt(e' J' R⁻¹ J e / n) at the truth: about 1 if an"
        " estimate attains the Cramér-Rao bound, which is used for estimators with a prior too. A"
        " value that is not finite counts as infinite.",
        lambda s: quantile(f.over_bound(s), 0.5),
    ),
    _all(
        "error_q95",
        "95 % error",
        "95 % quantile of the error over the bound.",
        lambda s: quantile(f.over_bound(s), 0.95),
    ),
    _all(
        "efficiency_capped",
        "efficiency",
        "One over the root mean square error over the bound, each trial counting at most"
        f" {f.CAP:g}, so that no single trial decides; {1 / f.CAP:g} where all count that."
        " Interval: as for rmse, but its lower end is where it would be if a share of trials (95"
        f" %) that may be unusual beyond those seen counted {f.CAP:g} each; 0 from"
        f" {intervals.RARE} unusual ones on. Unusual is what {intervals.UNUSUAL:g} of normal"
        " errors exceed.",
        f.efficiency_capped,
        limits=f.efficiency_capped_limits,
        where=("all_trials",),
        limits_titles={"all_trials": "95 % of efficiency"},
    ),
    _all(
        "nees_median",
        "NEES, median",
        "Median of e' P⁻¹ e with the covariance P that the estimator reports, over the median of"
        " chi-square with n degrees: 1 if the covariance is right. A value that is not finite"
        " counts as infinite. Limits: 95 % of medians over this number of trials lie between them"
        " if the covariance is right.",
        f.nees_median,
        limits=f.nees_median_limits,
        where=("calibration",),
        limits_titles={"calibration": "limits of the median"},
        limits_given="_if_honest",
    ),
    Statistic(
        "nees_mean",
        "NEES",
        _CLAIMS,
        "Mean of e' P⁻¹ e / n with the covariance P that the estimator reports: 1 if it is right."
        " The interval, by bets and by the studentised bootstrap, has 95 % for all estimators and"
        " error scales of a setting together; its upper end is the largest factor of the variance"
        " that these trials do not exclude. The verdict is read from it. It knows nothing of rare"
        " large errors that no trial shows.",
        lambda s: f.claimed(s).mean,
        limits=lambda s: (f.claimed(s).low, f.claimed(s).high),
        where=("calibration",),
        limits_titles={"calibration": "interval of NEES"},
    ),
    _all(
        "solved_trials",
        "solved trials",
        "Number of solved trials, over which bias, std, rmse, bounds, efficiency and NEES are"
        " computed.",
        lambda s: int(s.solved.sum()),
        kind="count",
        where=("solved_trials",),
    ),
    Statistic(
        "equation",
        "equation",
        "no trials: the same for all",
        "The equation that the estimator solves: eq. (11) with the frozen H, the least-squares"
        " condition or the maximum a posteriori condition. Filters and the linear LSE have none.",
        lambda s: s.group.footer.get("equation") or "-",
        kind="word",
    ),
    Statistic(
        "family",
        "family",
        "no trials: the same for all",
        "The kind of the estimator: IPE, filters (smoothers among them), least squares or one that"
        " its class names.",
        lambda s: family_of(s.group.footer),
        kind="word",
    ),
    _all(
        "false_root",
        "false root",
        "Share of trials that converged to another root of the same equation, so that they are not"
        " solved.",
        lambda s: f.share(s.converged & ~s.solved),
        kind="share",
        where=("solved_trials", "covariances"),
    ),
    Statistic(
        "given",
        "given",
        "no trials: the same for all",
        "What the estimator was given: of constants, all readings (readings) and also the prior of"
        " the truth (prior); of states that move, for the state at a time step, the readings up to"
        " it (so far) or of the whole path (all readings).",
        lambda s: given_of(s.group.footer),
        kind="word",
    ),
    Statistic(
        "false_root_distance",
        "false root at",
        "converged trials that are not solved",
        "Median over trials of the largest distance of a parameter from the right root, in"
        " standard deviations of the Cramér-Rao bound.",
        f.false_root_distance,
        where=("covariances",),
    ),
    _solved(
        "bias_solved",
        "bias",
        "Mean error.",
        f.of_each(lambda s: f.mean(s.error, s.solved)),
        kind="physical",
        where=("parameters", "theory"),
    ),
    _solved(
        "std_solved",
        "std",
        "Standard deviation of the error (n - 1).",
        f.of_each(f.std),
        kind="physical",
        where=("parameters",),
    ),
    _solved(
        "rmse_solved",
        "rmse",
        "Root mean square error. Interval: 95 %, by the studentised bootstrap of its logarithm"
        " over trials (Efron and Tibshirani, An Introduction to the Bootstrap, 1993, ch. 12),"
        f" {intervals.RESAMPLES} resamples, the same for every estimator; above"
        f" {intervals.LARGEST_SAMPLE} trials, groups of consecutive trials are resampled. None for"
        f" fewer than {FEW} trials. No upper end where larger errors may be unseen"
        " (rmse_solved_unseen above 0), and where a few trials carry the sum of squares: where its"
        " effective number of trials, (Σ e²)² / Σ e⁴ (Kish, Survey Sampling, 1965), is less than"
        f" for normal errors in all but {100 * intervals.HEAVY:g} % of cases.",
        f.of_each(f.rmse),
        limits=f.ends_in_units(f.rmse_ends),
        kind="physical",
        where=("parameters", "covariances", "theory"),
        limits_titles={"parameters": "95 % of rmse", "theory": "95 % of rmse"},
    ),
    _solved(
        "rmse_solved_unseen",
        "unseen",
        "Share of trials that may have larger errors than those seen: the upper limit (95 %,"
        f" Clopper and Pearson) of the share of errors that {intervals.UNUSUAL:g} of normal ones"
        " with the same median exceed, less the share seen; about 3 / N where none of N trials has"
        f" one, and 0 from {intervals.RARE} on. No RMSE interval can include such rare errors.",
        f.rmse_unseen,
        kind="share",
    ),
    _solved(
        "effective_trials",
        "effective trials",
        "Number of equal trials that would share the sum of squared errors as evenly, (Σ e²)² / Σ"
        " e⁴ (Kish, Survey Sampling, 1965): a third of the trials for normal errors of one"
        " parameter, one if a single trial carries the whole sum.",
        lambda s: f.squares(s).effective,
        where=("parameters",),
    ),
    Statistic(
        "linear_bound",
        "linear bound",
        "no trials: the same for all",
        "Standard deviation of the linear least-squares estimate, eq. (5), if the model were"
        " linear.",
        lambda s: np.append(s.linear_bound * s.sizes, 1.0),
        kind="physical",
        where=("parameters",),
    ),
    _solved(
        "crlb",
        "CRLB",
        "Cramér-Rao bound (J' R⁻¹ J)⁻¹ at the truth: root mean square of its standard deviation.",
        f.of_each(f.crlb),
        kind="physical",
        where=("parameters", "covariances", "theory"),
    ),
    _solved(
        "bayes_bound",
        "Bayesian bound",
        "(J' R⁻¹ J + P₀⁻¹)⁻¹ at the truth, which estimators that use a prior are compared with:"
        " root mean square of its standard deviation. It is a local bound, for each truth its own,"
        " and not Van Trees's. Of states that move: of the filter that is linearised at the truth.",
        f.of_each(f.bayes),
        kind="physical",
        where=("parameters",),
    ),
    Statistic(
        "van_trees",
        "Van Trees's bound",
        "truths drawn from the prior",
        "(E[J' R⁻¹ J] + P₀⁻¹)⁻¹, which no estimator can beat on average over the prior, biased or"
        " not (Van Trees, Detection, Estimation, and Modulation Theory I, 1968, sec. 2.4):"
        f" standard deviation. The mean E is over {EXPECTED} truths of each seed; its interval, 95"
        " %, holds for this mean, and there is none where few truths carry it: where their"
        f" effective number (Kish, Survey Sampling, 1965) is less than {EVEN:g} of them. Of states"
        " that move: the posterior Cramér-Rao bound (Tichavský, Muravchik and Nehorai, IEEE TSP"
        " 46, 1998).",
        f.of_each(lambda s: f.van_trees(s)[0]),
        limits=f.van_trees_limits,
        kind="physical",
        where=("parameters",),
    ),
    Statistic(
        "predicted_bias",
        "bias by theory",
        "solved trials under a wrong model, else the first trials",
        "Mean error of least squares by theory. Under a wrong model it is the distance to the"
        " parameters that come closest to the error-free readings (Vuong, Caltech working paper"
        " 652, 1986); under the right one it is the bias of second order (Box, J. R. Stat. Soc. B"
        " 33, 1971).",
        f.of_each(lambda s: f.predicted(s)[0]),
        given="solved",
        kind="physical",
        where=("theory",),
    ),
    _solved(
        "predicted_rmse",
        "rmse by theory",
        "Root mean square error of least squares by theory, without any draw of noise. Under a"
        " wrong model it combines that distance with the asymptotic covariance A⁻¹ B A⁻¹ of least"
        " squares about it (Vuong, 1986; Richmond and Horowitz, IEEE Trans. Signal Processing 63,"
        " 2015), which is not a bound, since another estimator may have a smaller error; under the"
        " right one it combines the Cramér-Rao bound with the bias of second order.",
        f.of_each(lambda s: f.predicted(s)[1]),
        kind="physical",
        where=("theory",),
    ),
    Statistic(
        "curvature_intrinsic",
        "intrinsic curvature",
        "the first trials",
        "Median relative curvature of the surface of readings at the truth, within the 95 % region"
        " of the bound (Bates and Watts, J. R. Stat. Soc. B 42, 1980): linear theory holds well"
        " below 0.3.",
        lambda s: f.median_of_truth(s, "curvature_intrinsic"),
        where=("theory",),
    ),
    Statistic(
        "curvature_parameter",
        "parameter curvature",
        "the first trials",
        "The same for the parameter lines on that surface, which shows how unevenly they lie.",
        lambda s: f.median_of_truth(s, "curvature_parameter"),
        where=("theory",),
    ),
    _solved(
        "reported",
        "reported",
        "Root mean square of the standard deviation that the estimator itself reports: eq. (5) for"
        " the linear LSE, the sandwich (H⁺J)⁻¹ H⁺RH⁺' (H⁺J)⁻ᵀ at the estimate for the frozen root.",
        f.of_each(lambda s: f.rms_columns(s.deviation, s.solved & finite(s.deviation))),
        kind="physical",
        where=("covariances",),
    ),
    _solved(
        "eq_14",
        "eq. (14)",
        "Standard deviation by eq. (14), eq. (5) with the compensation error N(x) - N(x̂) of a"
        " root of eq. (11) added as if it were independent of the noise. It is not: x̂ is made"
        " from the noise, and the cross terms that eq. (14) leaves out are of the same order. The"
        " sandwich has them, to first order.",
        f.of_each(f.eq_14),
        kind="physical",
        where=("covariances",),
    ),
    _solved(
        "rmse_solved_over_linear_bound",
        "rmse / bound",
        "Root mean square error over the linear bound.",
        lambda s: f.ratio(f.in_units(f.rmse(s), s), np.append(s.linear_bound * s.sizes, 1.0)),
    ),
    _solved(
        "efficiency_solved",
        "efficiency, solved",
        "Bound over rmse, as standard deviations: 1 for an efficient estimator. The bound is the"
        " one at the truth, Cramér and Rao's or, for estimators that use a prior, the Bayesian"
        " one. Interval: from the interval of rmse.",
        f.efficiency,
        limits=f.efficiency_limits,
        where=("solved_trials",),
        titles={"solved_trials": "efficiency"},
        limits_titles={"solved_trials": "95 % of efficiency"},
    ),
    _all(
        "rmse_all",
        "rmse, all",
        "Root mean square error over all trials; infinite if one of them has no finite estimate.",
        f.of_each(f.rmse_all),
        kind="physical",
        where=("all_trials",),
        titles={"all_trials": "rmse / linear bound"},
    ),
    _all(
        "efficiency_all",
        "efficiency, all",
        "The same bound over the root mean square error of all trials. Because no trial is left"
        " out, it compares estimators that solve an equation with those that do not.",
        f.efficiency_all,
        where=("all_trials",),
        titles={"all_trials": "efficiency, uncapped"},
    ),
    _all(
        "median_abs_error",
        "median abs error",
        "Median of the absolute error, where a value that is not finite counts as infinite. Over"
        " all parameters it is the median of the root mean square over parameters of the error"
        " over the linear bound.",
        lambda s: f.error_quantile(s, 0.5),
        kind="physical",
        where=("parameters",),
    ),
    _all(
        "q95_abs_error",
        "95 % abs error",
        "95 % quantile of the absolute error.",
        lambda s: f.error_quantile(s, 0.95),
        kind="physical",
        where=("parameters",),
    ),
    _solved(
        "nees_solved",
        "mean NEES / n, solved",
        "Mean of e' P⁻¹ e / n with the covariance P that the estimator reports: 1 if it is right."
        " For a parameter it is the mean of the squared error over the reported variance. Limits:"
        " 95 % of chi-square, which hold for a right covariance and normal errors (Bar-Shalom, Li"
        " and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, sec."
        " 5.4).",
        f.nees,
        limits=f.nees_limits,
        where=("solved_trials", "parameters"),
        titles={"parameters": "mean NEES", "solved_trials": "mean NEES / n"},
        limits_titles={"solved_trials": "NEES limits"},
        limits_given="_if_honest",
    ),
    _all(
        "coverage95",
        "coverage",
        "Share of trials whose truth lies inside the 95 % ellipsoid that the estimator reports, or"
        " for a parameter inside its interval. A value that is not finite counts as not covered.",
        f.coverage,
        kind="share",
        where=("calibration", "parameters"),
    ),
    Statistic(
        "verdict",
        "verdict",
        _CLAIMS,
        "Whether the reported covariance is right, by the interval of the mean NEES."
        " Overconfident, too cautious: it lies above or below 1, below also with a NEES of"
        f" {intervals.UNSEEN_NEES:g} n in the number of trials that may be unusual and unseen;"
        f" consistent: it includes 1 and ends at {intervals.EXCLUDED:g} at most; not refuted: it"
        f" includes 1 and ends at {intervals.VAGUE:g} at most; undecided: it ends beyond, or seems"
        f" to lie below 1 and rare large errors may be missing. None for fewer than {FEW} trials.",
        lambda s: f.claimed(s).verdict,
        kind="word",
        where=("calibration",),
    ),
    _all(
        "claims",
        "claims",
        "Number of trials that converged and report a covariance, over which calibration is"
        " computed.",
        lambda s: f.claimed(s).claims,
        kind="count",
        where=("calibration",),
    ),
    Statistic(
        "calibration_p",
        "p of calibration",
        "converged trials with a reported covariance",
        "Of a parameter, the probability that the distribution of the truth under the reported"
        " Gaussian, or of the squared error under chi-square, is so far from uniform by chance:"
        " both are compared with bands that a right covariance leaves anywhere with a stated"
        " probability (Säilynoja, Bürkner and Vehtari, Stat. Comput. 32, 2022), and the smaller p"
        " is doubled. Of all, the smallest p times n + 1 (Bonferroni).",
        f.calibration_p,
        kind="probability",
        where=("calibration",),
    ),
    Statistic(
        "calibration_excursion",
        "excursion",
        "the same trials",
        "The largest difference between these distribution functions and the uniform one; over all"
        " parameters, the one of NEES.",
        lambda s: [part.excursion for part in s.calibrations] or np.nan,
        where=("calibration",),
    ),
    Statistic(
        "calibration",
        "calibration",
        "the same trials",
        "How the reported covariance is wrong, if it significantly is, at 5 % for an estimator and"
        " all its parameters together: shifted is the median of error over reported deviation"
        " (estimate less truth); most errors larger or smaller, the median of its size over the"
        " median for a right covariance, which ignores rare large errors; far outside, the share"
        f" beyond the quantile that {GATE:g} should lie beyond, after a factor above 1. Over all"
        " parameters: NEES, and the parameter that is farthest off.",
        f.calibration,
        kind="word",
        where=("calibration", "parameters"),
    ),
    _all(
        "misfit",
        "misfit",
        "Share whose residuals fail the test of fit: |R^-1/2 (z - h(x))|² is larger than it would"
        " be in 0.1 % of trials if model and noise were right. Its law is chi-square with m - n"
        " degrees for least squares and normal noise. For other noise it is simulated; for other"
        " estimators it is scaled to the effective degrees of what they leave, m less the trace of"
        " their influence. It needs no truth, so it is known for real readings too.",
        f.misfit,
        kind="share",
        where=("all_trials",),
    ),
    Statistic(
        "ambiguous",
        "ambiguous",
        "the trials in which the estimator has looked for it",
        "Share in which several distinct minima fit the readings, so that no residual can tell"
        " which is the truth, or copies of a path by whole periods of a state do.",
        f.ambiguous,
        kind="share",
        where=("all_trials",),
        rare=True,
    ),
    Statistic(
        "failures_flagged",
        "failures flagged",
        "trials without success of estimators that look for several minima",
        "Share that is flagged as ambiguous.",
        f.failures_flagged,
        kind="share",
        where=("all_trials",),
        rare=True,
    ),
    _all(
        "iterations_median",
        "iterations",
        "Median; none for filters, whose time steps are not iterations.",
        lambda s: quantile(s.scalars["iterations"], 0.5) if s.iterates else np.nan,
        where=("costs",),
    ),
    _all(
        "iterations_p95",
        "iterations, 95 %",
        "95 % quantile.",
        lambda s: quantile(s.scalars["iterations"], 0.95) if s.iterates else np.nan,
        where=("costs",),
    ),
    _all(
        "simulations_median",
        "simulations, median",
        "Median cost of a trial. A Jacobian counts the simulations that the model states.",
        lambda s: quantile(s.cost, 0.5),
        where=("costs",),
    ),
    _all(
        "simulations_mean",
        "simulations, mean",
        "Mean cost of a trial, which a few costly trials carry where it lies far above the median.",
        lambda s: float(np.mean(s.cost)),
        where=("costs",),
    ),
    _all(
        "time_mean_s",
        "time, mean",
        "Mean wall clock of a trial. The time of a block of trials is shared out evenly among"
        " them, so that a median or a scatter over trials has no meaning.",
        lambda s: float(np.mean(s.scalars["time_s"])),
        kind="seconds",
        where=("costs",),
    ),
    *t.STATISTICS,
)
"""The columns of `summary_all.csv`, in order."""

MAIN = (
    *(
        "trials",
        "success",
        "failed_known",
        "failed_silent",
        "error_median",
        "error_q95",
        "efficiency_capped",
        "rmse_solved",
    ),
    *(
        "claims",
        "nees_mean",
        "coverage95",
        "verdict",
        "iterations_median",
        "simulations_median",
        "simulations_mean",
    ),
    "time_mean_s",
)
"""The statistics of estimators of constants that `summary.csv` has, with their intervals."""
NOT_MAIN = ("rmse_solved_high",)
"""Ends of intervals that it leaves out: in fewer than a thousand trials this one is hardly ever
known."""
MAIN_OF_STATES = (
    *MAIN,
    *("path_error_median", "path_error_q95", "path_rmse_solved", "path_bound"),
    *("path_nees_solved", "path_verdict", "nis_verdict"),
)
"""Those of trackers of states that move."""

SCORES: tuple[Statistic, ...] = (
    Statistic(
        "capped_error",
        "capped error",
        "the trials that every estimator of the scenario has",
        "Mean Mahalanobis error sqrt(e' J' R⁻¹ J e), the error in standard deviations of the"
        " Cramér-Rao bound, about √n when efficient; each trial's counts at most the radius of the"
        " gate of success, so one bad failure counts as one.",
        f.capped_error,
        where=("all_trials",),
    ),
    Statistic(
        "cost_median",
        "cost",
        "all trials",
        "Median cost of a trial.",
        lambda s: quantile(s.cost, 0.5),
    ),
    Statistic(
        "cost_to_limit_median",
        f"to {CLOSE:g} σ of limit",
        "converged trials with a stored history",
        f"Median cost until all further iterates are within {CLOSE:g} standard deviations of the"
        " last, in every parameter; iterate k of K is taken to cost (k + 1) / (K + 1) of the"
        " trial.",
        lambda s: quantile(
            np.array(
                [
                    h.cost * (iterations_to_limit(h.distances) + 1) / len(h.distances)
                    for h in s.histories
                ]
            ),
            0.5,
        ),
        where=("costs",),
    ),
    Statistic(
        "histories",
        "histories",
        "converged trials with a stored history",
        "Their number.",
        lambda s: len(s.histories),
        kind="count",
        where=("costs",),
    ),
    Statistic(
        "order_median",
        "order",
        "converged trials with a stored history",
        "Median of the last observed order of convergence: 1 linear, 2 quadratic.",
        lambda s: quantile(_last_orders(s), 0.5),
        where=("costs",),
    ),
    Statistic(
        "eq_18_trials",
        "K below 1",
        "converged trials of fixed-point iteration with a stored history",
        "Number of those in which the K of eq. (15) at the truth is below 1, so that eq. (18)"
        " applies.",
        lambda s: len(f.fixed_point_bounds(s)),
        kind="count",
        where=("iterations",),
    ),
    Statistic(
        "eq_18_holds",
        "eq. (18) holds",
        "those trials in which K is below 1",
        "Share in which no iterate is farther from the limit than K^k / (1 - K) times the first"
        " step, eq. (18) with the k that the print lost (Burden and Faires, Numerical Analysis,"
        " have it). K is that at the truth: the theorem wants the largest on the way, so this is"
        " an observation and no proof.",
        lambda s: float(f.mean(f.fixed_point_bounds(s))[0]),
        kind="share",
        where=("iterations",),
    ),
    Statistic(
        "eq_18_error_over_bound",
        "error / bound of eq. (18)",
        "those trials in which K is below 1",
        "Median of the largest distance of an iterate after the first from the limit, over its"
        " bound.",
        lambda s: quantile(f.fixed_point_bounds(s)[:, 1], 0.5),
        where=("iterations",),
    ),
    Statistic(
        "eq_23_observed",
        "M observed",
        "converged trials of Newton's method with a stored history",
        "Median of the least M with which eq. (23), |x_(k+1) - root| <= n² M / 2 |x_k - root|²,"
        " explains the history; the last iterate stands for the root.",
        lambda s: quantile(f.constants(s)[:, 0], 0.5),
        where=("iterations",),
    ),
    Statistic(
        "eq_23_M",
        "M at the truth",
        "the same trials",
        "Median of the largest |∂²g_i / ∂x_j ∂x_k| of Newton's g at the truth, by central"
        " differences. The theorem wants the largest over a neighbourhood.",
        lambda s: quantile(f.constants(s)[:, 1], 0.5),
        where=("iterations",),
    ),
    Statistic(
        "eq_23_holds",
        "eq. (23) holds",
        "the same trials",
        "Share in which the least M that explains the history is at most M at the truth.",
        lambda s: f.share(np.less_equal(*f.constants(s).T)),
        kind="share",
        where=("iterations",),
    ),
    Statistic(
        NIS,
        "NIS",
        "all trials of filters",
        "Mean normalised innovation squared over the number of readings: like NEES, but it needs"
        " no truth.",
        f.mean_nis,
    ),
)
"""Further columns of `Analysis.scores`."""
