"""Every column of the summary is the statistic that its name says: recomputed in plain NumPy from
random trials."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from scipy.stats import beta, chi2, norm
from shared.synthetic_store import Pretender, Seeker, Synthetic

from ipe_bench.report.tables.table import plain_text
from ipe_bench.report.tables.terminal import summary_tables
from ipe_bench.runs.store import ResultKey
from ipe_bench.statistics import summarize
from ipe_bench.statistics.registry import summary_columns

ELSEWHERE = {
    **dict.fromkeys(("success_anytime_low", "success_anytime_high"), "test_sequences.py"),
    **dict.fromkeys(
        ("rmse_solved_low", "rmse_solved_high", "path_rmse_solved_low", "path_rmse_solved_high"),
        "test_intervals.py",
    ),
    **dict.fromkeys(("efficiency_capped_low", "efficiency_capped_high"), "test_intervals.py"),
    **dict.fromkeys(
        ("verdict", "path_verdict", "nees_mean_low", "nees_mean_high"), "test_consistency.py"
    ),
    "nis_verdict": "test_verdicts.py",
    **dict.fromkeys(
        ("calibration_p", "calibration_excursion", "calibration"), "test_calibration.py"
    ),
    "may_be_best": "test_comparisons.py",
}
"""Intervals of resampling, words, and what compares estimators, with the file that tests them."""


class LeastSquares(Pretender):
    """Stands for an estimator of which theory predicts bias and error."""

    equation = "least_squares"


@dataclass
class Trials:
    """Holds what a store has of the trials with readings, and what the summary says of the same."""

    rows: Mapping[str, Any]
    """Columns (trials,) of the estimates."""
    error: np.ndarray
    """(trials, n), in multiples of the sizes, as the rest that is of parameters."""
    deviation: np.ndarray
    truth: Mapping[str, np.ndarray]
    path: np.ndarray
    path_bound: np.ndarray
    sizes: np.ndarray
    linear: np.ndarray
    """The linear bound (n,)."""
    equation: str
    told: Mapping[str, np.ndarray]
    """The summary's columns (n + 1,)."""

    def __getattr__(self, name: str) -> Any:
        return self.rows[name]

    @property
    def n(self) -> int:
        return len(self.sizes)

    @property
    def converged(self) -> np.ndarray:
        return self.status == "converged"

    @property
    def cost(self) -> np.ndarray:
        return self.simulations + self.n * self.jacobians

    @property
    def over_bound(self) -> np.ndarray:
        return np.sqrt(self.crlb_distance / self.n)

    @property
    def normalised(self) -> np.ndarray:
        """The root mean square over parameters of error over linear bound (trials,)."""
        return np.sqrt(((self.error / self.linear) ** 2).mean(axis=1))

    def units(self, values: np.ndarray, linear: np.ndarray | None = None) -> np.ndarray:
        """Returns values in the parameters' units, and over all the root mean square of their ratio
        to the bound."""
        ratios = values / (self.linear if linear is None else linear)
        return np.append(values * self.sizes, np.sqrt(np.mean(ratios**2)))

    def solved_squares(self) -> np.ndarray:
        """Returns squares (n + 1, solved) of each parameter's error, and of all over the bound."""
        return np.vstack([self.error.T**2, self.normalised**2])[:, self.solved]


def middle(values: np.ndarray, q: float = 0.5) -> float:
    """Returns the quantile, linear between order statistics, where a value that is not finite
    counts as infinite."""
    if not len(values):
        return np.nan
    ordered = np.sort(np.where(np.isfinite(values), values, np.inf))
    at = (len(ordered) - 1) * q
    low, high = ordered[int(np.floor(at))], ordered[int(np.ceil(at))]
    return low if low == high else low + (high - low) * (at % 1)


def rms(values: np.ndarray) -> np.ndarray:
    return np.sqrt((values**2).mean(axis=0))


def share_limit(side: str, count: Callable[[Trials], tuple[int, int]]) -> Callable[[Trials], float]:
    """Returns an end of the interval of Clopper and Pearson, by the beta law."""

    def end(t: Trials) -> float:
        k, N = count(t)
        if side == "low":
            return beta.ppf(0.025, k, N - k + 1) if k else 0.0
        return beta.ppf(0.975, k + 1, N - k) if k < N else 1.0

    return end


def degrees(t: Trials) -> np.ndarray:
    """Returns 1 for each parameter, and Satterthwaite's degrees of the sum over all."""
    C = np.cov((t.error / t.linear)[t.solved].T).reshape(t.n, t.n)
    return np.append(np.ones(t.n), np.floor(np.trace(C) ** 2 / np.sum(C**2) + 1e-9))


def unseen(t: Trials) -> np.ndarray:
    found = []
    for squares, d in zip(t.solved_squares(), degrees(t), strict=True):
        usual = np.median(squares) / chi2.median(d) * chi2.isf(1e-3, d)
        k, N = int((squares > usual).sum()), len(squares)
        limit = beta.ppf(0.95, k + 1, N - k) if k < N else 1.0
        found.append(limit - k / N if k < 10 else 0.0)
    return np.array(found)


def nees_median_limit(q: float) -> Callable[[Trials], float]:
    def end(t: Trials) -> float:
        order = (len(t.status) + 1) / 2
        return chi2.ppf(beta.ppf(q, order, order), t.n) / chi2.median(t.n)

    return end


def nees_limit(q: float) -> Callable[[Trials], np.ndarray]:
    def ends(t: Trials) -> np.ndarray:
        each = np.append(np.ones(t.n), t.n) * t.solved.sum()
        return chi2.ppf(q, each) / each

    return ends


def noticed(t: Trials) -> np.ndarray:
    return ~t.converged | ~(t.fit_p >= 1e-3) | (t.extra_ambiguous > 0)


def van_trees(sign: float) -> Callable[[Trials], np.ndarray]:
    """Returns the root mean square of the bound over its truths, or an end of its interval."""

    def value(t: Trials) -> np.ndarray:
        bound, error = t.truth["van_trees"], t.truth["van_trees_error"]
        centre = rms(bound)
        return t.units(
            np.maximum(
                centre
                + sign
                * norm.ppf(0.975)
                * rms(2 * bound * error)
                / np.sqrt(len(bound))
                / 2
                / centre,
                0,
            )
        )

    return value


def of_path(t: Trials) -> np.ndarray:
    return rms(t.path_bound)


def of_path_errors(t: Trials, q: float) -> np.ndarray:
    each = [middle(e, q) for e in t.path.T]
    return np.append(each * t.sizes, middle(t.path_error, q))


def mean_of(name: str) -> Callable[[Trials], float]:
    return lambda t: np.nanmean(t.rows[name][t.solved])


def not_white(t: Trials) -> tuple[int, int]:
    p = t.white_p[t.converged & ~np.isnan(t.white_p)]
    return int((p < 0.05).sum()), len(p)


def success(t: Trials) -> tuple[int, int]:
    return int(t.success.sum()), len(t.success)


def held(t: Trials) -> tuple[int, int]:
    return int(t.path_success.sum()), len(t.path_success)


def predicted_rmse(t: Trials) -> np.ndarray:
    return t.units(
        np.sqrt(
            (t.truth["crlb"][t.solved] ** 2).mean(axis=0) + (t.truth["box_bias"] ** 2).mean(axis=0)
        )
    )


def only(equation: str, formula: Callable[[Trials], Any]) -> Callable[[Trials], Any]:
    return lambda t: formula(t) if t.equation == equation else np.nan


DEFINITIONS: dict[str, Callable[[Trials], Any]] = {
    "trials": lambda t: len(t.status),
    "no_readings": lambda t: 2,
    "converged": lambda t: np.mean(t.converged),
    "solved": lambda t: np.mean(t.solved),
    "success": lambda t: np.mean(t.success),
    "success_low": share_limit("low", success),
    "success_high": share_limit("high", success),
    "success_anytime": lambda t: np.mean(t.success),
    "failed_known": lambda t: np.mean(~t.success & noticed(t)),
    "failed_silent": lambda t: np.mean(~t.success & ~noticed(t)),
    "error_median": lambda t: middle(t.over_bound),
    "error_q95": lambda t: middle(t.over_bound, 0.95),
    "efficiency_capped": lambda t: 1 / np.sqrt(np.mean(np.fmin(t.over_bound, 5.0) ** 2)),
    "nees_mean": lambda t: np.nanmean(t.nees[t.converged]) / t.n,
    "nees_median": lambda t: middle(t.nees) / chi2.median(t.n),
    "nees_median_low_if_honest": nees_median_limit(0.025),
    "nees_median_high_if_honest": nees_median_limit(0.975),
    "solved_trials": lambda t: np.sum(t.solved),
    "equation": lambda t: t.equation,
    "given": lambda t: "readings",
    "family": lambda t: "IPE" if t.equation == "frozen" else "least squares",
    "false_root": lambda t: np.mean(t.converged & ~t.solved),
    "false_root_distance": lambda t: middle(t.root_distance[t.converged & ~t.solved]),
    "bias_solved": lambda t: t.units(t.error[t.solved].mean(axis=0)),
    "std_solved": lambda t: t.units(t.error[t.solved].std(axis=0, ddof=1)),
    "rmse_solved": lambda t: t.units(rms(t.error[t.solved])),
    "rmse_solved_unseen": unseen,
    "effective_trials": lambda t: (
        t.solved_squares().sum(axis=1) ** 2 / (t.solved_squares() ** 2).sum(axis=1)
    ),
    "linear_bound": lambda t: t.units(t.linear),
    "crlb": lambda t: t.units(rms(t.truth["crlb"][t.solved])),
    "bayes_bound": lambda t: t.units(rms(t.truth["bayes"][t.solved])),
    "van_trees": van_trees(0),
    "van_trees_low": van_trees(-1),
    "van_trees_high": van_trees(1),
    "predicted_bias": only("least_squares", lambda t: t.units(t.truth["box_bias"].mean(axis=0))),
    "predicted_rmse": only("least_squares", predicted_rmse),
    "curvature_intrinsic": lambda t: np.median(t.truth["curvature_intrinsic"]),
    "curvature_parameter": lambda t: np.median(t.truth["curvature_parameter"]),
    "reported": lambda t: t.units(
        rms(t.deviation[t.solved & np.isfinite(t.deviation).all(axis=1)])
    ),
    "eq_14": only(
        "frozen",
        lambda t: t.units(
            np.sqrt(t.linear**2 + rms((t.error - t.truth["linear_error"])[t.solved]) ** 2)
        ),
    ),
    "rmse_solved_over_linear_bound": lambda t: (
        t.told["rmse_solved"] / np.append(t.linear * t.sizes, 1.0)
    ),
    "efficiency_solved": lambda t: (
        t.units(rms(t.truth["crlb"][t.solved])) / t.units(rms(t.error[t.solved]))
    ),
    "efficiency_solved_low": lambda t: t.told["crlb"] / t.told["rmse_solved_high"],
    "efficiency_solved_high": lambda t: t.told["crlb"] / t.told["rmse_solved_low"],
    "rmse_all": lambda t: t.units(rms(np.where(np.isfinite(t.error), t.error, np.inf))),
    "efficiency_all": lambda t: t.units(rms(t.truth["crlb"])) / t.told["rmse_all"],
    "median_abs_error": lambda t: np.append(
        [middle(abs(e)) for e in t.error.T] * t.sizes, middle(t.normalised)
    ),
    "q95_abs_error": lambda t: np.append(
        [middle(abs(e), 0.95) for e in t.error.T] * t.sizes, middle(t.normalised, 0.95)
    ),
    "nees_solved": lambda t: np.append(
        ((t.error / t.deviation)[t.solved] ** 2).mean(axis=0), t.nees[t.solved].mean() / t.n
    ),
    "nees_solved_low_if_honest": nees_limit(0.025),
    "nees_solved_high_if_honest": nees_limit(0.975),
    "coverage95": lambda t: np.append(
        (abs(t.error / t.deviation) <= norm.ppf(0.975)).mean(axis=0),
        np.mean(t.nees <= chi2.ppf(0.95, t.n)),
    ),
    "claims": lambda t: np.sum(t.converged & ~np.isnan(t.nees)),
    "misfit": lambda t: np.mean(~(t.fit_p >= 1e-3)),
    "ambiguous": lambda t: np.mean(t.extra_ambiguous[np.isfinite(t.extra_ambiguous)] > 0),
    "failures_flagged": lambda t: np.mean(t.extra_ambiguous[~t.success] > 0),
    "iterations_median": lambda t: np.median(t.iterations),
    "iterations_p95": lambda t: np.quantile(t.iterations, 0.95),
    "simulations_median": lambda t: np.median(t.cost),
    "simulations_mean": lambda t: np.mean(t.cost),
    "time_mean_s": lambda t: np.mean(t.time_s),
    "path_error_median": lambda t: of_path_errors(t, 0.5),
    "path_error_q95": lambda t: of_path_errors(t, 0.95),
    "path_rmse_solved": lambda t: t.units(rms(t.path[t.solved]), of_path(t)),
    "path_bound": lambda t: t.units(of_path(t), of_path(t)),
    "path_success": lambda t: np.mean(t.path_success),
    "path_success_low": share_limit("low", held),
    "path_success_high": share_limit("high", held),
    "path_nees_solved": lambda t: mean_of("path_nees")(t) / t.n,
    "path_nis": lambda t: np.nanmean(t.extra_nis),
    "not_white": lambda t: not_white(t)[0] / not_white(t)[1],
    "not_white_low": share_limit("low", not_white),
    "not_white_high": share_limit("high", not_white),
    "log_likelihood": mean_of("log_likelihood"),
    "first_bad_epoch": mean_of("first_bad_epoch"),
    "copy_p": mean_of("copy_p"),
}
"""What each column is by its name and docstring."""


def drawn(folder, seed: int) -> Trials:
    """Stores random trials of two estimators in blocks, two without readings and some lost, and
    reads their summary."""
    rng = np.random.default_rng(seed)
    n, N = int(rng.integers(1, 5)), int(rng.integers(40, 90))
    names, store = [f"p{i}" for i in range(n)], Synthetic(folder)
    scenario = store.scenario(names=tuple(names))
    linear, estimator = store.bound(scenario), [Seeker(), LeastSquares()][int(rng.integers(2))]
    truth = {
        kind: linear * rng.uniform(0.5, 2.0, (N, n)) for kind in ("crlb", "bayes", "van_trees")
    }
    truth |= {
        kind: 0.1 * linear * rng.standard_normal((N, n)) for kind in ("box_bias", "linear_error")
    }
    truth |= {"van_trees_error": 0.1 * truth["van_trees"], "x": rng.standard_normal((N, n))}
    curved = {f"curvature_{kind}": rng.exponential(size=N) for kind in ("intrinsic", "parameter")}
    error = linear * rng.standard_t(3, (N, n)) * rng.lognormal(sigma=0.3, size=(N, 1))
    status = rng.choice(
        np.array(["converged", "diverged", "stalled"], dtype=object), N, p=[0.8, 0.1, 0.1]
    )
    solved = (status == "converged") & (rng.random(N) < 0.9)
    error[~solved & (rng.random(N) < rng.choice([0.0, 0.1, 0.4]))] = np.nan
    deviation = linear * rng.uniform(0.5, 2.0, (N, n))
    deviation[~solved & (rng.random(N) < 0.5)] = np.nan
    distance = ((error / truth["crlb"]) ** 2).sum(axis=1)
    path, path_bound = (linear * rng.uniform(0.5, 3.0, (N, n)) for _ in range(2))
    status[[3, 17]] = "no_readings"
    solved[[3, 17]] = False
    block = int(rng.integers(10, N))
    rows = {
        "status": status,
        "solved": solved,
        "success": distance <= chi2.isf(1e-2, n),
        "crlb_distance": distance,
        "nees": ((error / deviation) ** 2).sum(axis=1),
        "iterations": rng.integers(1, 30, N),
        "simulations": np.round(5 * rng.lognormal(sigma=1.5, size=N)),
        "jacobians": rng.integers(0, 4, N).astype(float),
        # The time of a block is shared out evenly.
        "time_s": rng.exponential(size=N)[np.arange(N) // block],
        "fit_p": np.where(rng.random(N) < 0.2, 1e-5, rng.random(N)),
        "extra_ambiguous": rng.choice([0.0, 1.0, np.nan], N, p=[0.7, 0.2, 0.1]),
        "extra_nis": np.where(rng.random(N) < 0.1, np.nan, rng.chisquare(8, N) / 8),
        "root_distance": rng.exponential(size=N),
        "path_nees": np.where(rng.random(N) < 0.1, np.nan, rng.chisquare(n, N)),
        "path_error": np.where(rng.random(N) < 0.1, np.nan, rng.exponential(size=N)),
        "path_success": rng.random(N) < 0.8,
        "white_p": np.where(rng.random(N) < 0.1, np.nan, rng.random(N) ** 2),
        "log_likelihood": rng.standard_normal(N),
        "first_bad_epoch": np.where(rng.random(N) < 0.5, np.nan, rng.integers(1, 20, N)),
        "copy_p": rng.random(N),
    }
    of_path = {f"path_{name}": path[:, i] for i, name in enumerate(names)}
    of_path |= {f"path_bound_{name}": path_bound[:, i] for i, name in enumerate(names)}
    facts = {
        f"{kind}_{name}": values[:, i]
        for kind, values in truth.items()
        for i, name in enumerate(names)
    }
    for first in range(0, N, block):
        part = slice(first, min(first + block, N))
        here = {"trial": np.arange(N)[part]} | {
            key: values[part] for key, values in (facts | curved).items()
        }
        store.store.write(ResultKey(scenario), part.start, part.stop, here)
    store.add(
        scenario,
        "one",
        error,
        block=block,
        estimator=estimator,
        deviation=deviation,
        **rows,
        **of_path,
    )
    read: np.ndarray = np.asarray(status != "no_readings")
    other = {"status": np.where(read, "converged", "no_readings").astype(object)}
    store.add(
        scenario, "other", error, block=block, estimator=estimator.__class__(option=1), **other
    )
    frame = summarize([folder])
    frame = frame[frame["estimator"] == "one"]
    return Trials(
        {key: values[read] for key, values in rows.items()},
        error[read],
        deviation[read],
        {key: values[read] for key, values in (truth | curved).items()},
        path[read],
        path_bound[read],
        np.array([p.size for p in scenario.measurement.parameters]),
        linear,
        estimator.equation,
        {column: frame[column].to_numpy() for column in summary_columns()},
    )


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 30))]
)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_every_column_is_the_statistic_that_its_name_says(tmp_path, seed):
    assert not set(DEFINITIONS) & set(ELSEWHERE)
    assert set(DEFINITIONS) | set(ELSEWHERE) == set(summary_columns())
    t = drawn(tmp_path, seed)
    wrong = {}
    for column, definition in DEFINITIONS.items():
        told = t.told[column]
        expected = np.broadcast_to(definition(t), told.shape)
        if told.dtype == object and isinstance(expected.flat[0], str):
            equal = (told == expected).all()
        else:
            equal = np.allclose(
                told.astype(float), expected.astype(float), rtol=1e-9, atol=1e-12, equal_nan=True
            )
        if not equal:
            wrong[column] = told, expected
    assert not wrong


def test_a_cost_that_few_trials_carry_shows_its_mean(synthetic):
    """19 trials cost 100 and one costs 8000, on average 495."""
    error = np.zeros((20, 3))
    synthetic.add(
        synthetic.scenario(), "tailed", error, simulations=np.append(np.full(19, 100.0), 8000.0)
    )
    synthetic.add(
        synthetic.scenario(), "even", error, simulations=np.append(np.full(19, 100.0), 104.0)
    )
    rows: Any = summarize([synthetic.directory]).to_dict("records")
    lines = plain_text(summary_tables(rows, None, 120), 120).splitlines()
    costs = {
        name: next(line for line in lines if line.startswith(f" {name}"))
        for name in ("tailed", "even")
    }
    assert "100/495" in costs["tailed"]
    assert " 100 " in costs["even"]
    assert "/100" not in costs["even"]
