"""Whether the covariance that another program reports describes its errors: scale, direction, tails, bias and trend.

Everything is said of the whitened errors w = C^(-1/2) (e / s), with s the reported standard deviations and C the
reported correlations: w ~ N(0, I) if the report is true, and w'w is the NEES. Scale and tails are separate questions:
errors of Student's law with the stated covariance are honest, and chi-square limits refuse them seven times out of ten.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri, stdtr, stdtrit

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.statistics.comparisons import holm
from ipe_bench.statistics.consistency import mean_limits
from ipe_bench.statistics.intervals import rms_interval

if TYPE_CHECKING:
    import pandas as pd

ALPHA = 0.05
FEWEST_RUNS = 20
MATTERS = 1.1
"""A factor of the standard deviation below which a covariance can be believed."""
_DRAWS = 1999
"""Monte Carlo draws of a null distribution."""
_DEGREE = 180 / np.pi
_WEIGHTS = {"scale": 5.0, "direction": 2.0, "bias": 1.0, "tails": 1.0, "trend": 1.0}
"""Shares of the level that the families of sentences have: the first question is the one that is asked most."""
_MANY = 1000
"""Rows above which the null distribution of the fourth moment is taken for normal."""
_LARGEST = 10.0
"""Ends of an interval more than so many times its middle are not shown."""

Verdict = Literal["too small", "too large", "right", "undecided"]


@dataclass(frozen=True)
class Claims:
    """What a program said of n parameters, and how wrong it was."""

    names: tuple[str, ...]
    error: Array
    """Estimate less truth (rows, n)."""
    deviation: Array
    """Reported standard deviations (rows, n)."""
    correlation: Array | None
    """Reported correlations (rows, n, n); None if only standard deviations are."""
    run: NDArray[np.intp]
    """Number of the run of each row (rows,): rows of one run are not independent."""
    trends: Mapping[str, Array] = field(default_factory=dict)
    """Columns (rows,) on which errors may depend, such as time."""
    left_out: int = 0
    """Rows without an estimate."""

    @property
    def n(self) -> int:
        return len(self.names)

    @property
    def joint(self) -> bool:
        """Whether the report says of all parameters together how wrong they are."""
        return self.n == 1 or self.correlation is not None

    @cached_property
    def runs(self) -> int:
        return len(np.unique(self.run))

    @cached_property
    def z(self) -> Array:
        """Errors in reported standard deviations (rows, n)."""
        return self.error / self.deviation

    @cached_property
    def w(self) -> Array:
        """Whitened errors (rows, n). The symmetric root keeps each as near to its own parameter as can be (Kessy,
        Lewin, Strimmer, Amer. Statist. 72, 2018)."""
        if self.correlation is None:
            return self.z
        values, vectors = np.linalg.eigh(self.correlation)
        return np.einsum("rij,rj,rkj,rk->ri", vectors, values**-0.5, vectors, self.z, optimize=True)


@dataclass(frozen=True)
class Factor:
    """By how much true standard deviations exceed the reported ones, with an interval that needs no normal law."""

    value: float
    low: float
    high: float

    @property
    def verdict(self) -> Verdict:
        """What the covariance is; right where the interval leaves nothing that matters."""
        if self.low > 1:
            return "too small"
        if self.high < 1:
            return "too large"
        return "right" if self.low > 1 / MATTERS and self.high < MATTERS else "undecided"

    @property
    def wrong(self) -> bool:
        return self.verdict in ("too small", "too large")

    @property
    def words(self) -> str:
        """How large true errors are beside the reported ones."""
        known = self.high < _LARGEST * self.value
        span = f"{self.low:.2f} to {self.high:.2f}" if known else f"surely more than {self.low:.2g}"
        return f"{self.value:.2f} times as large as reported ({span})"


@dataclass(frozen=True)
class Audit:
    """What was found; `sentences` say it, the strongest first."""

    claims: Claims
    scale: Factor
    """Of all parameters, with an interval of 97.5 %: half of the level, the other questions having the rest."""
    each: tuple[Factor, ...]
    """Of each parameter, all intervals together at 97.5 %."""
    bias: Array
    """Mean error in reported standard deviations with its interval (n, 3), all together at 95 %."""
    nees: float
    """Mean NEES over n: 1 if the report is true."""
    nees_limits: tuple[float, float]
    """Where it lies in 95 % of cases if errors are normal; NaN without correlations, or with several rows a run."""
    sentences: tuple[str, ...]

    @property
    def verdict(self) -> Verdict:
        """What the covariance is as a whole."""
        return self.scale.verdict

    def table(self) -> pd.DataFrame:
        """A row per parameter: factor and bias with their intervals."""
        import pandas as pd

        rows = [
            {"parameter": name, "factor": f.value, "factor_low": f.low, "factor_high": f.high, "covariance": f.verdict}
            | dict(zip(("bias", "bias_low", "bias_high"), b.tolist(), strict=True))
            for name, f, b in zip(self.claims.names, self.each, self.bias, strict=True)
        ]
        return pd.DataFrame(rows)


def audit(claims: Claims) -> Audit:
    """Examines what a program said.

    A fault is said where its family (scale, direction, tails, bias, trend) is refused at 5 % over all of them together
    (Holm), so an honest report meets any false sentence in at most 5 % of cases.

    Raises:
        UserError: there are too few runs, or errors and deviations differ by the factor of degrees and radians.
    """
    if claims.runs < FEWEST_RUNS:
        one = "one log of dependent rows says too little; " if claims.runs == 1 and len(claims.run) > 1 else ""
        raise UserError(f"audit: there are {claims.runs} independent runs; {one}give at least {FEWEST_RUNS}")
    nees = np.sum(claims.w**2, axis=1)
    each = _factors(claims, claims.z**2, 1 - ALPHA / 2 / claims.n)
    for name, factor in zip(claims.names, each, strict=True):
        for ratio in (_DEGREE, 1 / _DEGREE):
            if factor.low < ratio < factor.high and factor.high < 1.5 * factor.low:
                raise UserError(
                    f"audit: errors of {name} are {factor.value:.3g} times as large as reported, the factor between "
                    "degrees and radians; give both in one unit"
                )
    (scale,) = _factors(claims, nees[:, None] / claims.n, 1 - ALPHA / 2)
    questions = _questions(claims, nees)
    # The scale has been tested at its share of the level.
    p = [0.0 if scale.wrong else 1.0, *(p for p, _ in questions.values())]
    corrected = holm(p, [_WEIGHTS[name] for name in ("scale", *questions)])[1:]
    faults = [words for (_, words), q in zip(questions.values(), corrected, strict=True) if q <= ALPHA]
    whole = claims.joint and claims.runs == len(nees)
    limits = mean_limits(claims.n, claims.runs) if whole else (np.nan, np.nan)
    told = _of_scale(claims, scale, nees), *faults
    return Audit(claims, scale, each, _bias(claims)[0], float(nees.mean() / claims.n), limits, told[:3])


def _of_scale(claims: Claims, scale: Factor, nees: Array) -> str:
    if scale.wrong:
        only = "" if scale.value > 1 else "only "
        return f"True errors are {only}{scale.words}: the covariance is {scale.verdict}."
    if scale.verdict == "right":
        return f"True errors are {scale.words}: the covariance can be believed."
    needed = _runs_needed(claims, nees)
    return (
        f"True errors are {scale.words}: {claims.runs} runs cannot tell if the covariance is right; "
        f"a standard deviation that is wrong by 10 % would be seen in {needed} runs."
    )


def _runs_needed(claims: Claims, nees: Array) -> int:
    """Independent runs in which a standard deviation wrong by 10 % is seen in four of five cases."""
    mean = _per_run(claims, nees[:, None])[:, 0]
    spread = float(mean.var(ddof=1) / mean.mean() ** 2)
    return int(np.ceil(spread * ((ndtri(1 - ALPHA / 4) + ndtri(0.8)) / (2 * np.log(MATTERS))) ** 2))


def _questions(claims: Claims, nees: Array) -> dict[str, tuple[float, str]]:
    """By family, how often chance does as much in an honest report, and what is said if that is rare."""
    found = {}
    if claims.n > 1 and claims.joint:
        p, directions = _worst_direction(claims)
        found["direction"] = p, _direction_words(claims, directions)
    bias, p = _bias(claims)
    worst = int(np.argmax(np.abs(bias[:, 0]) / (bias[:, 2] - bias[:, 1])))
    value, low, high = bias[worst]
    said = f"{claims.names[worst]} is biased by {value:+.2f} reported deviations ({low:+.2f} to {high:+.2f})."
    found["bias"] = p, said
    if claims.runs == len(nees):
        parts = [_tails(w) for w in ([claims.w] if claims.joint else np.split(claims.z, claims.n, axis=1))]
        ratio = max(ratio for _, ratio in parts)
        said = f"their fourth moment is {ratio:.1f} times that of a normal law."
        p = min(1.0, len(parts) * min(p for p, _ in parts))
        found["tails"] = p, f"Errors have heavier tails than normal ones: {said}"
    if trend := _trend(claims, nees):
        p, what, column = trend
        found["trend"] = p, f"{what} changes with {column} (p = {p:.1g})."
    return found


def _direction_words(claims: Claims, directions: Array) -> str:
    """Of the directions (2, n) of w the one in which errors are farther from what is reported."""
    assert claims.correlation is not None
    found = [(_factors(claims, np.square(claims.w @ v)[:, None], 1 - ALPHA)[0], v) for v in directions]
    factor, v = max(found, key=lambda pair: abs(np.log(pair[0].value)))
    values, vectors = np.linalg.eigh(claims.correlation.mean(axis=0))
    c = (vectors * values**-0.5) @ vectors.T @ v
    named = _combination(c / np.linalg.norm(c), claims.names)
    return f"In the worst direction, {named} in reported deviations, true errors are {factor.words}."


def _per_run(claims: Claims, values: Array) -> Array:
    """Means over the rows of each run (runs, k)."""
    _, run = np.unique(claims.run, return_inverse=True)
    total = np.zeros((claims.runs, values.shape[1]))
    np.add.at(total, run, values)
    return total / np.bincount(run)[:, None]


def _factors(claims: Claims, squares: Array, level: float) -> tuple[Factor, ...]:
    """Roots of the means of squares (rows, k), with bootstrap-t intervals over runs."""
    mean = _per_run(claims, squares)
    low, high = rms_interval(mean, level=level)
    return tuple(map(Factor, np.sqrt(mean.mean(axis=0)).tolist(), low.tolist(), high.tolist()))


def _bias(claims: Claims) -> tuple[Array, float]:
    """The mean errors with their intervals (n, 3), and how often chance does as much to any."""
    mean = _per_run(claims, claims.z)
    centre, error = mean.mean(axis=0), mean.std(axis=0, ddof=1) / np.sqrt(claims.runs)
    reach = stdtrit(claims.runs - 1, 1 - ALPHA / 2 / claims.n) * error
    farthest = float((np.abs(centre) / np.maximum(error, 1e-300)).max())
    p = min(1.0, 2 * claims.n * float(stdtr(claims.runs - 1, -farthest)))
    return np.column_stack([centre, centre - reach, centre + reach]), p


def _worst_direction(claims: Claims) -> tuple[float, Array]:
    """How often chance does as much, and the unit vectors (2, n) along which w is shortest and longest.

    Lengths are let go: u = w / |w| is uniform on the sphere under any spherical law, normal or not, so the extreme
    eigenvalues of its scatter have one null distribution (Tyler, Biometrika 74, 1987). Of several rows of a run the
    first is taken.
    """
    w, n = claims.w[np.unique(claims.run, return_index=True)[1]], claims.n
    u = w / np.maximum(np.linalg.norm(w, axis=1, keepdims=True), 1e-300)
    values, vectors = np.linalg.eigh(n * (u.T @ u) / len(u))
    smallest, largest = _null_eigenvalues(len(u), n)
    p = [(1 + np.sum(smallest <= values[0])) / (1 + _DRAWS), (1 + np.sum(largest >= values[-1])) / (1 + _DRAWS)]
    return min(1.0, 2 * float(min(p))), vectors[:, [0, -1]].T


@lru_cache(maxsize=8)
def _null_eigenvalues(rows: int, n: int) -> tuple[Array, Array]:
    """The least and the largest eigenvalue (draws,) of n times the mean of u u', u uniform on the sphere."""
    rng = np.random.default_rng([rows, n])
    found = np.empty((_DRAWS, n))
    for row in found:
        u = rng.standard_normal((rows, n))
        u /= np.linalg.norm(u, axis=1, keepdims=True)
        row[:] = np.linalg.eigvalsh(n * (u.T @ u) / rows)
    return found[:, 0], found[:, -1]


def _tails(w: Array) -> tuple[float, float]:
    """How often normal errors of any covariance have as large a fourth moment, and E[d^2] over that of normal errors,
    n (n + 2), where d = w' S^-1 w with the scatter S of w (rows, n) (Mardia, Biometrika 57, 1970, for a known mean)."""
    rows, n = w.shape
    usual = n * (n + 2)
    ratio = _fourth_moment(w) / usual
    if rows > _MANY:
        return float(ndtr(-(ratio - 1) * usual / np.sqrt(8 * usual / rows))), ratio
    return float((1 + np.sum(_null_fourth_moment(rows, n) >= ratio * usual)) / (1 + _DRAWS)), ratio


def _fourth_moment(w: Array) -> float:
    d = np.sum(w * np.linalg.solve(w.T @ w / len(w), w.T).T, axis=1)
    return float(np.mean(d**2))


@lru_cache(maxsize=8)
def _null_fourth_moment(rows: int, n: int) -> Array:
    rng = np.random.default_rng([rows, n, 1])
    return np.array([_fourth_moment(rng.standard_normal((rows, n))) for _ in range(_DRAWS)])


def _trend(claims: Claims, nees: Array) -> tuple[float, str, str] | None:
    """The least p over columns of Spearman's rank correlation with NEES and with each error, corrected for their
    number, what changes, and with which column; None without columns.

    Of runs of several rows, the mean over runs of the correlation inside each: rows of a run share their fate.
    """
    found: list[tuple[float, str, str]] = []
    for column, x in claims.trends.items():
        for what, y in [("The size of errors", nees), *zip(claims.names, claims.z.T, strict=True)]:
            if claims.runs == len(y):
                p = 2 * ndtr(-abs(_spearman(x, y)) * np.sqrt(len(y) - 1))
            else:
                parts = [np.flatnonzero(claims.run == run) for run in np.unique(claims.run)]
                r = np.array([_spearman(x[rows], y[rows]) for rows in parts if len(rows) > 2])
                error = r.std(ddof=1) / np.sqrt(len(r)) if len(r) > 2 else np.nan
                p = 2 * stdtr(len(r) - 1, -abs(r.mean()) / error) if error > 0 else np.nan
            if np.isfinite(p):
                found.append((float(p), what, column))
    if not found:
        return None
    p, what, column = min(found)
    return min(1.0, p * len(found)), what, column


def _spearman(x: Array, y: Array) -> float:
    from scipy.stats import spearmanr

    return float(np.asarray(spearmanr(x, y))[0]) if np.ptp(x) > 0 and np.ptp(y) > 0 else 0.0


def _combination(c: Array, names: Sequence[str]) -> str:
    """The largest terms of a direction."""
    order = [i for i in np.argsort(-np.abs(c)) if abs(c[i]) > 0.3 * np.abs(c).max()][:3]
    terms = [f"{np.sign(c[order[0]]) * c[i]:+.2f} {names[i]}" for i in order]
    return " ".join(terms).removeprefix("+")


# Reading -------------------------------------------------------------------------------------------------------------


def read_claims(table: Path | str | pd.DataFrame) -> Claims:
    """The claims of a CSV or Parquet file, or of a frame, with a row per run, or per time of a run.

    wide   NAME_true and NAME, or NAME_error; NAME_std, NAME_var or cov_NAME_NAME; cov_A_B
    long   run, parameter, true and estimate, or error; std or var

    A column `run` numbers runs; further columns of numbers are what errors may depend on.

    Raises:
        UserError: a column is missing, a covariance is none, or the file cannot be read; it names the column or row.
    """
    import pandas as pd

    name, frame = ("the frame", table) if isinstance(table, pd.DataFrame) else (str(table), _read(Path(table)))
    if "parameter" in frame:
        frame = _widened(frame, name)
    ends = ("_true", "_error")
    names = tuple(dict.fromkeys(c.removesuffix(e) for e in ends for c in map(str, frame.columns) if c.endswith(e)))
    if not names:
        raise UserError(f"{name}: has no truth; give columns NAME_true and NAME, or NAME_error, and NAME_std")
    error = np.column_stack([_error(frame, parameter, name) for parameter in names])
    deviation = np.column_stack([_deviation(frame, parameter, name) for parameter in names])
    there = np.isfinite(error).all(axis=1) & np.isfinite(deviation).all(axis=1)
    for i, parameter in enumerate(names):
        if (bad := there & ~(deviation[:, i] > 0)).any():
            row = int(np.flatnonzero(bad)[0]) + 2
            raise UserError(f"{name}: row {row}: the deviation of {parameter} is not above 0")
    frame, error, deviation = frame.iloc[np.flatnonzero(there)], error[there], deviation[there]
    used = {"run", *(c for p in names for c in frame.columns if c == p or c.startswith(f"{p}_"))}
    numbers = frame.select_dtypes("number")
    trends = {
        str(c): numbers[c].to_numpy(float)
        for c in numbers.columns
        if c not in used and not str(c).startswith("cov_") and numbers[c].nunique() > 2
    }
    correlation = _correlation(frame, names, deviation, name, np.flatnonzero(there))
    run = np.asarray(pd.factorize(frame["run"])[0] if "run" in frame else np.arange(len(frame)), dtype=np.intp)
    return Claims(names, error, deviation, correlation, run, trends, int((~there).sum()))


def _read(path: Path) -> pd.DataFrame:
    import pandas as pd

    if not path.is_file():
        raise UserError(f"{path}: there is no such file")
    try:
        return pd.read_parquet(path) if path.suffix == ".parquet" else pd.read_csv(path, sep=None, engine="python")
    except (ValueError, OSError) as error:
        raise UserError(f"{path}: cannot be read as a table ({str(error).splitlines()[0]})") from None


def _widened(frame: pd.DataFrame, name: str) -> pd.DataFrame:
    values = [c for c in ("true", "estimate", "error", "std", "var") if c in frame]
    index = [c for c in frame.columns if c not in (*values, "parameter")]
    if not index:
        raise UserError(f"{name}: has no column run, which tells what belongs together")
    if frame.duplicated([*index, "parameter"]).any():
        row = int(np.flatnonzero(frame.duplicated([*index, "parameter"]))[0]) + 2
        raise UserError(f"{name}: row {row}: a parameter stands there a second time in {', '.join(index)}")
    wide = frame.pivot_table(index=index, columns="parameter", values=values, sort=False)
    wide.columns = [p if value == "estimate" else f"{p}_{value}" for value, p in wide.columns]
    return wide.reset_index()


def _error(frame: pd.DataFrame, parameter: str, name: str) -> Array:
    if f"{parameter}_error" in frame:
        return frame[f"{parameter}_error"].to_numpy(float)
    if parameter not in frame:
        raise UserError(f"{name}: has {parameter}_true, but no column {parameter} with the estimates")
    return (frame[parameter] - frame[f"{parameter}_true"]).to_numpy(float)


def _deviation(frame: pd.DataFrame, parameter: str, name: str) -> Array:
    if f"{parameter}_std" in frame:
        return frame[f"{parameter}_std"].to_numpy(float)
    for variance in (f"{parameter}_var", f"cov_{parameter}_{parameter}"):
        if variance in frame:
            return np.sqrt(np.maximum(frame[variance].to_numpy(float), 0.0))
    raise UserError(
        f"{name}: does not say how sure {parameter} is; give {parameter}_std, {parameter}_var or "
        f"cov_{parameter}_{parameter}"
    )


def _correlation(
    frame: pd.DataFrame, names: Sequence[str], deviation: Array, name: str, rows: NDArray[np.intp]
) -> Array | None:
    n, found = len(names), np.broadcast_to(np.eye(len(names)), (len(frame), len(names), len(names))).copy()
    stated = 0
    for i in range(n):
        for j in range(i):
            columns = [c for c in (f"cov_{names[i]}_{names[j]}", f"cov_{names[j]}_{names[i]}") if c in frame]
            if columns:
                stated += 1
                found[:, i, j] = frame[columns[0]].to_numpy(float) / (deviation[:, i] * deviation[:, j])
                found[:, j, i] = found[:, i, j]
    if not stated:
        return None
    if (bad := ~np.isfinite(found).all(axis=(1, 2))).any() or (bad := np.linalg.eigvalsh(found)[:, 0] <= 1e-12).any():
        row = int(rows[np.flatnonzero(bad)[0]]) + 2
        raise UserError(f"{name}: row {row}: the covariance is not positive definite")
    return found
