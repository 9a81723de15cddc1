"""Statistics of tracks: errors over all time steps, and how they and NEES run from epoch to epoch.

Epochs are dependent, so intervals and verdicts are those over trials.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from functools import cached_property, partial
from typing import Any

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.states.copies import SURE
from ipe_bench.statistics import formulas as f
from ipe_bench.statistics.intervals import clopper_pearson, mean_limits, quantile, quantiles
from ipe_bench.statistics.sample import NIS, Sample
from ipe_bench.statistics.statistic import ALL, Statistic
from ipe_bench.statistics.verdicts import NO_VERDICT, WRONG
from ipe_bench.trials.thresholds import FEW, FIT_LEVEL, GATE

NOT_WHITE = 0.05
"""Level of the test that innovations are white."""
_TOLERATED = 0.01
"""Share of trials whose innovations may surely not be white before the tracker is called wrong."""


@dataclass(frozen=True, eq=False)
class PathSample(Sample):
    """Replaces errors and bounds of the same trials by their root mean square over the whole
    path."""

    @cached_property
    def linear_bound(self) -> Array:
        return f.rms_columns(self.of_estimate("path_bound"))


def is_track(s: Sample) -> bool:
    return "path_nees" in s.scalars


@f.once
def path(s: Sample) -> PathSample:
    known = {field.name: getattr(s, field.name) for field in fields(Sample)}
    return PathSample(**known | {"error": s.of_estimate("path"), "kept": {}})


def of_path(formula: Callable[[Sample], Array]) -> Callable[[Sample], Array]:
    """Turns a formula (n,) of errors over all time steps into its shown form (n + 1,); NaN if no
    state is tracked."""

    def shown(s: Sample) -> Array:
        if not is_track(s):
            return np.full(s.n + 1, np.nan)
        along = path(s)
        return f.in_units(formula(along), along)

    return shown


rmse = of_path(f.rmse)
bound = of_path(lambda s: s.linear_bound)


def error_quantile(s: Sample, q: float) -> Array:
    """Computes a quantile over all trials of the root mean square error over all time steps, of
    each state, and of all states over the filter that is linearised at the true path (n + 1,)."""
    if "path_error" not in s.scalars:
        return np.full(s.n + 1, np.nan)
    each = [quantile(e, q) for e in path(s).error.T]
    return np.append(each * s.sizes, quantile(s.scalars["path_error"], q))


def rmse_limits(s: Sample) -> f.Ends:
    """Computes ends (n + 1,) of the intervals of these root mean squares."""
    if not is_track(s):
        unknown = np.full(s.n + 1, np.nan)
        return unknown, unknown
    return f.ends_in_units(f.rmse_ends)(path(s))


def mean_score(s: Sample, name: str) -> float:
    """Computes the mean of a score over the trials that have one."""
    if name not in s.scalars:
        return np.nan
    values = s.scalars[name][s.solved]
    return f.share(values[~np.isnan(values)])


def path_success(s: Sample) -> tuple[float, float, float]:
    """The share of trials that keep to the whole path, and the ends of its interval."""
    if "path_success" not in s.scalars:
        return np.nan, np.nan, np.nan
    held = int(s.scalars["path_success"].sum())
    return held / len(s), *clopper_pearson(held, len(s))


def path_verdict(s: Sample) -> str:
    if not is_track(s):
        return NO_VERDICT
    return f.mean_nees_of(s.scalars["path_nees"], s.n, s).verdict


def nis_verdict(s: Sample) -> str:
    """Returns the verdict on innovations: on whiteness, then on NIS, whose degrees are the readings
    of a trial."""
    if not (is_track(s) and NIS in s.scalars):
        return NO_VERDICT
    p = _white_p(s)
    rejected = int((p < FIT_LEVEL).sum())
    surely_wrong, _ = clopper_pearson(rejected, len(p))
    if surely_wrong > _TOLERATED:
        return WRONG
    m = int(s.group.footer["readings"])
    return f.mean_nees_of(m * s.scalars[NIS], m, s).verdict


def _white_p(s: Sample) -> Array:
    """Returns the p-values of whiteness of the converged trials that have one."""
    if "white_p" not in s.scalars:
        return np.empty(0)
    p = s.scalars["white_p"][s.converged]
    return p[~np.isnan(p)]


def not_white(s: Sample) -> tuple[float, float, float]:
    """Computes the share of trials with autocorrelated innovations, and the ends of its
    interval."""
    rejected = _white_p(s) < NOT_WHITE
    return f.share(rejected), *clopper_pearson(int(rejected.sum()), len(rejected))


def epoch_curves(s: Sample) -> Iterator[dict[str, Any]]:
    """Computes time, median error and worst tenth over all trials, bounds, and NEES with its
    limits, per epoch and state of a track, and of all states together over the filter's bound."""
    times = np.array(s.group.footer.get("times", ()), dtype=float)
    K = len(times)
    n = s.n
    errors = _errors(s, K)
    # Of each epoch: NEES and the trials that claim it; n variances of the bound, their ratio to
    # those of the filter, and the trials.
    own = sum(_sums(s, K, n + 4), np.zeros((K, n + 4)))
    if not (K and len(errors)):
        return
    median, worst = quantiles(errors, np.array([0.5, 0.9]))
    nees = own[:, 0]
    claims = own[:, 1]
    with np.errstate(all="ignore"):
        bound = np.sqrt(own[:, 2:-1] / own[:, -1:])
    low, high = mean_limits(n, int(claims[0]))
    names = [*s.names, ALL]
    sizes = [*s.sizes, 1.0]
    units = [*(p["unit"] for p in s.parameters), ""]
    for i, name in enumerate(names):
        yield {
            "parameter": name,
            "unit": units[i],
            "at": times,
            "median": sizes[i] * median[:, i],
            "q90": sizes[i] * worst[:, i],
            "bound": sizes[i] * bound[:, i],
            "nees_solved": np.where(claims >= FEW, nees / np.maximum(claims, 1) / n, np.nan),
            "nees_low_if_honest": low,
            "nees_high_if_honest": high,
            "trials": len(errors),
            "claims": int(claims[0]),
        }


def _errors(s: Sample, epochs: int) -> Array:
    """Reads the errors (trials, K, n + 1) of the first trials at each epoch; none if a version
    stored them that did not keep them."""
    from ipe_bench.trials.paths import errors_in

    stored = [s.collection.load(cell, (), ("curves_errors",)) for cell in s.group.cells]
    texts = [one["curves_errors"] for one in stored if "curves_errors" in one]
    return errors_in(np.concatenate([*texts, np.empty(0)]), epochs, s.n + 1)


def _sums(s: Sample, epochs: int, columns: int) -> Iterator[Array]:
    """Reads the sums (K, columns) of each stored block."""
    from ipe_bench.trials.paths import unpacked

    for cell in s.group.cells:
        stored = s.collection.load(cell, (), ("curves",))
        yield from unpacked(stored.get("curves", np.empty(0)), epochs, columns)


def _error_statistic(name: str, title: str, told: str, q: float) -> Statistic:
    whose = "all trials of trackers"
    formula = partial(error_quantile, q=q)
    where = ("tracks",)
    return Statistic(
        f"path_error_{name}", title, whose, told, formula, kind="physical", where=where
    )


STATISTICS: tuple[Statistic, ...] = (
    _error_statistic(
        "median",
        "median error, all time steps",
        "Median of a trial's root mean square error over all time steps. Of all states together,"
        " over the filter that is linearised at the true path, for smoothers too, so that all"
        " trackers are compared. A track that is not finite counts as infinite.",
        0.5,
    ),
    _error_statistic("q95", "95 % error, all time steps", "95 % quantile of these errors.", 0.95),
    Statistic(
        "path_rmse_solved",
        "rmse, solved",
        "solved trials of trackers",
        "Root mean square error over all time steps; over all states, root mean square of its ratio"
        " to the bound at the truth. Interval: as for rmse, over trials.",
        rmse,
        limits=rmse_limits,
        given="solved",
        kind="physical",
        where=("tracks",),
        limits_titles={"tracks": "95 % of rmse"},
    ),
    Statistic(
        "path_bound",
        "bound at the truth",
        "all trials of trackers",
        "Standard deviation of the extended Kalman filter that is linearised at the true path"
        " (Taylor, IEEE TAC 24, 1979), or of the smoother behind it if the tracker smooths, root"
        " mean square over all time steps.",
        bound,
        kind="physical",
        where=("tracks",),
    ),
    Statistic(
        "path_success",
        "path held",
        "all trials of trackers",
        "Share of trials whose mean squared error over all time steps, each state in multiples of"
        " this bound, lies in the gate of a success. Interval: Clopper and Pearson.",
        lambda s: path_success(s)[0],
        limits=lambda s: path_success(s)[1:],
        kind="share",
        where=("tracks",),
    ),
    Statistic(
        "path_nees_solved",
        "mean NEES / n, all time steps",
        "solved trials of trackers",
        "Mean over trials and all time steps of e' P⁻¹ e / n with the covariance P that the tracker"
        " reports: 1 where it is right; none where P is singular by the model.",
        lambda s: mean_score(s, "path_nees") / s.n,
        given="solved",
        where=("tracks",),
    ),
    Statistic(
        "path_verdict",
        "verdict, all time steps",
        "converged trials of trackers",
        "The verdict on each trial's mean NEES over all time steps: time steps are dependent,"
        " trials are not.",
        path_verdict,
        kind="word",
        where=("tracks",),
    ),
    Statistic(
        "path_nis",
        "NIS / m",
        "all trials of filters of states",
        "Mean normalised innovation squared over the number of readings, 1 where the filter is"
        " right.",
        lambda s: f.mean_nis(s) if is_track(s) else np.nan,
        where=("tracks",),
    ),
    Statistic(
        "nis_verdict",
        "verdict of NIS",
        "converged trials of filters of states",
        "The verdict on each trial's mean NIS, which needs no truth; wrong where significantly (95"
        f" %) more than {100 * _TOLERATED:g} % of the trials have innovations that are not white"
        f" at the level {FIT_LEVEL:g}.",
        nis_verdict,
        kind="word",
        where=("tracks",),
    ),
    Statistic(
        "not_white",
        "not white",
        "converged trials of filters of states",
        "Share of trials whose normalised innovations are autocorrelated at the level"
        f" {NOT_WHITE:g}, by Ljung and Box's test (Biometrika 65, 1978) pooled over readings, lags"
        f" 1 to 10 at most and to a fifth of the time steps: {NOT_WHITE:g} where the filter is"
        " right. Interval: Clopper and Pearson.",
        lambda s: not_white(s)[0],
        limits=lambda s: not_white(s)[1:],
        kind="share",
        where=("tracks",),
    ),
    Statistic(
        "log_likelihood",
        "log likelihood",
        "solved trials of filters of states",
        "Mean logarithm of the density of a trial's readings, by the innovations.",
        lambda s: mean_score(s, "log_likelihood"),
        where=("tracks",),
    ),
    Statistic(
        "first_bad_epoch",
        "first bad time step",
        "solved trials of trackers that have one",
        f"Mean number of the first time step whose error lies where a share of {GATE:g} should by"
        " the bound at the truth.",
        lambda s: mean_score(s, "first_bad_epoch"),
        where=("tracks",),
    ),
    Statistic(
        "copy_p",
        "p among copies",
        "solved trials of trackers of whole paths, if a state has a period",
        "Mean probability of a path among its copies, in which one state is shifted by whole"
        " periods from beginning to end, by their costs: the share of paths that are right, if"
        f" those are that differ by no more than whole periods. Below {SURE:g} a trial counts as"
        " ambiguous.",
        lambda s: mean_score(s, "copy_p"),
        where=("tracks",),
        rare=True,
    ),
)
"""The columns of `summary_all.csv` that are of tracks, in order."""
