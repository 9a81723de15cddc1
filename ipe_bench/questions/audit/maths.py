"""Tests whether the covariance that another program reports describes its errors: scale, direction, tails and bias.

Everything is said of the whitened errors w = C^(-1/2) (e / s), with s the reported standard deviations and C the
reported correlations: w ~ N(0, I) if the report is true, and w'w is the NEES. Scale and tails are separate questions:
errors of Student's law with the stated covariance are honest, and chi-square limits refuse them seven times out of ten.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri, stdtr, stdtrit

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.statistics.comparisons import ALPHA, holm
from ipe_bench.statistics.intervals import rms_interval
from ipe_bench.trials.observability import in_words

if TYPE_CHECKING:
    import pandas as pd

FEWEST_RUNS = 20
MOST_COLUMNS = 4096
MATTERS = 1.1
"""A factor of the standard deviation below which a covariance can be believed."""
_DRAWS = 1999
"""Monte Carlo draws of a null distribution."""
_DEGREE = 180 / np.pi
_SCALE, _DIRECTION, _BIAS, _TAILS = 5.0, 2.0, 1.0, 1.0
"""Shares of the level that the questions have: the first one is asked most."""
_MANY = 1000
"""Rows above which the null distribution of the fourth moment is taken for normal."""
_FARTHEST = 1e12
"""Reported deviations beyond which an error counts as infinite, and whose inverse is 0."""
_LARGEST = 10.0
"""Ends of an interval more than so many times its middle are not shown."""

AuditVerdict = Literal["too small", "too large", "right", "undecided"]


@dataclass(frozen=True)
class Claims:
    """Holds what a program reported of n parameters, and its errors."""

    names: tuple[str, ...]
    error: Array
    """Estimate less truth (rows, n)."""
    deviation: Array
    """Reported standard deviations (rows, n)."""
    correlation: Array | None
    """Reported correlations (rows, n, n); None if only standard deviations are."""
    run: NDArray[np.intp]
    """Number of the run of each row (rows,): rows of one run are not independent."""
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

    @property
    def parts(self) -> list[Array]:
        """The errors whose law is stated: the whitened ones (rows, n), or those of each parameter (rows, 1)."""
        return [self.w] if self.joint else np.split(self.z, self.n, axis=1)

    def per_run(self, values: Array) -> Array:
        """Means over the rows of each run (runs, k)."""
        _, run = np.unique(self.run, return_inverse=True)
        total = np.zeros((self.runs, values.shape[1]))
        np.add.at(total, run, values)
        return total / np.bincount(run)[:, None]


@dataclass(frozen=True)
class Factor:
    """Holds the ratio of true to reported standard deviations, with an interval that needs no normal law."""

    value: float
    low: float
    high: float

    @property
    def verdict(self) -> AuditVerdict:
        """Verdict on the covariance; "right" if the interval excludes every relevant factor."""
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
        """Sentence that compares true errors with reported ones."""
        known = self.high < _LARGEST * self.value
        span = f"{self.low:.2f} to {self.high:.2f}" if known else f"more than {self.low:.2g}"
        return f"{self.value:.2f} times as large as reported ({span})"


@dataclass(frozen=True)
class Audit:
    """Holds the findings; `sentences` state them, the strongest first."""

    claims: Claims
    scale: Factor
    """Factor of all parameters, with an interval of 97.5 %: half of the level, the other questions having the rest."""
    each: tuple[Factor, ...]
    """Factor of each parameter, all intervals together at 97.5 %."""
    bias: Array
    """Mean error in reported standard deviations with its interval (n, 3), all together at 95 %."""
    sentences: tuple[str, ...]

    @property
    def verdict(self) -> AuditVerdict:
        """Verdict on the covariance as a whole."""
        return self.scale.verdict

    def table(self) -> pd.DataFrame:
        """Returns a row per parameter: factor and bias with their intervals."""
        import pandas as pd

        factors = [(f.value, f.low, f.high, f.verdict) for f in self.each]
        columns = ["factor", "factor_low", "factor_high", "covariance"]
        frame = pd.DataFrame(factors, columns=columns)
        frame.insert(0, "parameter", self.claims.names)
        return frame.assign(
            bias=self.bias[:, 0], bias_low=self.bias[:, 1], bias_high=self.bias[:, 2]
        )


def audit(claims: Claims) -> Audit:
    """Examines the covariance that a program reports.

    No covariance allows for an infinite error, so one is enough for "too small"; the rest is of the other runs. A fault
    is said where its question (scale, direction, tails, bias) is refused at 5 % over all of them together (Holm), so an
    honest report meets any false sentence in at most 5 % of cases.

    Raises:
        UserError: there are too few runs, or errors and deviations differ by the factor of degrees and radians.
    """
    with np.errstate(over="ignore"):
        lost = ~(np.abs(claims.z) < _FARTHEST)
    if lost.any():
        return _with_infinite_errors(claims, lost)
    if claims.runs < FEWEST_RUNS:
        one = (
            "one log of dependent rows is too little evidence; "
            if claims.runs == 1 and len(claims.run) > 1
            else ""
        )
        raise UserError(
            f"audit: there are {claims.runs} independent runs; {one}give at least {FEWEST_RUNS}"
        )
    none = (np.abs(claims.z).max(axis=0) < 1 / _FARTHEST).any()
    if none or any(np.linalg.matrix_rank(part) < part.shape[1] for part in claims.parts):
        raise UserError(
            f"audit: the errors of {', '.join(claims.names)} are 0 in every run, or follow from one another; leave out"
            " the parameters that are known or are made of others"
        )
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
    bias, p_bias = _bias(claims)
    worst = int(np.argmax(np.abs(bias[:, 0]) / (bias[:, 2] - bias[:, 1])))
    value, low, high = bias[worst]
    said = f"{claims.names[worst]} is biased by {value:+.2f} reported deviations ({low:+.2f} to {high:+.2f})."
    # The scale has been tested at its share of the level.
    asked = [
        (_SCALE, 0.0 if scale.wrong else 1.0, _of_scale(claims, scale, nees)),
        (_BIAS, p_bias, said),
    ]
    if claims.n > 1 and claims.joint:
        asked.insert(1, (_DIRECTION, *_worst_direction(claims)))
    if claims.runs == len(nees):
        asked.append((_TAILS, *_tails(claims)))
    weights, p, sentences = zip(*asked, strict=True)
    faults = [
        said for said, q in zip(sentences[1:], holm(p, weights)[1:], strict=True) if q <= ALPHA
    ]
    return Audit(claims, scale, each, bias, (sentences[0], *faults[:2]))


def _with_infinite_errors(claims: Claims, lost: NDArray[np.bool_]) -> Audit:
    """Audits errors (rows, n) of which some are `lost`, that is infinite; the other runs are audited alone."""
    kept = ~np.isin(claims.run, claims.run[np.asarray(lost.any(axis=1))])
    correlation, infinite = claims.correlation, np.asarray(lost.any(axis=0))
    others = replace(
        claims,
        error=claims.error[kept],
        deviation=claims.deviation[kept],
        correlation=None if correlation is None else correlation[kept],
        run=claims.run[kept],
    )
    gone, endless = claims.runs - others.runs, Factor(np.inf, np.inf, np.inf)
    said = (
        f"The error is infinite, or beyond {_FARTHEST:g} reported deviations, in {gone} of {claims.runs} runs: the"
        " covariance is too small."
    )
    if others.runs < FEWEST_RUNS:
        each, bias, more = (
            (Factor(np.nan, np.nan, np.nan),) * claims.n,
            np.full((claims.n, 3), np.nan),
            (),
        )
    else:
        rest = audit(others)
        each, bias, more = (
            rest.each,
            rest.bias,
            (f"In the others: {rest.sentences[0]}", *rest.sentences[1:2]),
        )
    each = tuple(endless if bad else factor for bad, factor in zip(infinite, each, strict=True))
    return Audit(claims, endless, each, np.where(infinite[:, None], np.nan, bias), (said, *more))


def _of_scale(claims: Claims, scale: Factor, nees: Array) -> str:
    """Words the finding on the scale; if it is undecided, with the number of runs in which a standard deviation that is
    wrong by 10 % is seen in four of five cases."""
    if scale.wrong:
        only = "" if scale.value > 1 else "only "
        return f"True errors are {only}{scale.words}: the covariance is {scale.verdict}."
    if scale.verdict == "right":
        return f"True errors are {scale.words}: the covariance can be believed."
    mean = claims.per_run(nees[:, None])[:, 0]
    spread = float(mean.var(ddof=1) / mean.mean() ** 2)
    needed = np.ceil(spread * ((ndtri(1 - ALPHA / 4) + ndtri(0.8)) / (2 * np.log(MATTERS))) ** 2)
    return (
        f"True errors are {scale.words}: {claims.runs} runs do not decide if the covariance is right; "
        f"a standard deviation that is wrong by 10 % would be detected in {needed:.0f} runs."
    )


def _factors(claims: Claims, squares: Array, level: float) -> tuple[Factor, ...]:
    """Computes roots of the means of squares (rows, k), with bootstrap-t intervals over runs."""
    mean = claims.per_run(squares)
    low, high = rms_interval(mean, level=level)
    return tuple(map(Factor, np.sqrt(mean.mean(axis=0)).tolist(), low.tolist(), high.tolist()))


def _bias(claims: Claims) -> tuple[Array, float]:
    """Computes the mean errors with their intervals (n, 3), and the p that any is due to chance."""
    mean = claims.per_run(claims.z)
    centre, error = mean.mean(axis=0), mean.std(axis=0, ddof=1) / np.sqrt(claims.runs)
    reach = stdtrit(claims.runs - 1, 1 - ALPHA / 2 / claims.n) * error
    farthest = float((np.abs(centre) / np.maximum(error, 1e-300)).max())
    p = min(1.0, 2 * claims.n * float(stdtr(claims.runs - 1, -farthest)))
    return np.column_stack([centre, centre - reach, centre + reach]), p


def _worst_direction(claims: Claims) -> tuple[float, str]:
    """Computes the p of the least spherical scatter, and the direction in which errors exceed the report most.

    Lengths are let go: u = w / |w| is uniform on the sphere under any spherical law, normal or not, so the extreme
    eigenvalues of its scatter have one null distribution (Tyler, Biometrika 74, 1987). Of several rows of a run the
    first is taken.
    """
    assert claims.correlation is not None
    w = claims.w[np.unique(claims.run, return_index=True)[1]]
    values, vectors = np.linalg.eigh(_scatter(w))
    smallest, largest = _null(_extremes, *w.shape).T
    p = [
        (1 + np.sum(smallest <= values[0])) / (1 + _DRAWS),
        (1 + np.sum(largest >= values[-1])) / (1 + _DRAWS),
    ]
    found = [
        (_factors(claims, np.square(claims.w @ v)[:, None], 1 - ALPHA)[0], v)
        for v in vectors[:, [0, -1]].T
    ]
    factor, v = max(found, key=lambda pair: abs(np.log(pair[0].value)))
    values, vectors = np.linalg.eigh(claims.correlation.mean(axis=0))
    named = in_words(claims.names, (vectors * values**-0.5) @ vectors.T @ v)
    said = (
        f"In the worst direction, {named} in reported deviations, true errors are {factor.words}."
    )
    return min(1.0, 2 * float(min(p))), said


def _scatter(w: Array) -> Array:
    """Computes n times the mean of u u' over the rows u = w / |w| (n, n)."""
    u = w / np.maximum(np.linalg.norm(w, axis=1, keepdims=True), 1e-300)
    return w.shape[1] * (u.T @ u) / len(u)


def _extremes(w: Array) -> Array:
    """Returns the least and the largest eigenvalue of the scatter."""
    return np.linalg.eigvalsh(_scatter(w))[[0, -1]]


def _tails(claims: Claims) -> tuple[float, str]:
    """Computes the p of the fourth moment E[d^2] under normal errors of any covariance, with d = w' S^-1 w and S the
    scatter of w (Mardia, Biometrika 57, 1970, for a known mean); without covariances, any parameter's."""
    parts = claims.parts
    rows, n = parts[0].shape
    usual = n * (n + 2)
    largest = max(map(_fourth_moment, parts))
    if rows > _MANY:
        p = float(ndtr(-(largest / usual - 1) * usual / np.sqrt(8 * usual / rows)))
    else:
        p = float((1 + np.sum(_null(_fourth_moment, rows, n) >= largest)) / (1 + _DRAWS))
    said = f"their fourth moment is {largest / usual:.1f} times the normal one."
    return min(1.0, len(parts) * p), f"Errors have heavier tails than normal ones: {said}"


def _fourth_moment(w: Array) -> float:
    d = np.sum(w * np.linalg.solve(w.T @ w / len(w), w.T).T, axis=1)
    return float(np.mean(d**2))


@lru_cache(maxsize=8)
def _null(statistic: Callable[[Array], Array | float], rows: int, n: int) -> Array:
    """Simulates the statistic of normal errors (draws, ...)."""
    rng = np.random.default_rng([rows, n])
    return np.array([statistic(rng.standard_normal((rows, n))) for _ in range(_DRAWS)])


# Reading -------------------------------------------------------------------------------------------------------------


def read_claims(table: Path | str | pd.DataFrame) -> Claims:
    """Reads the claims of a CSV or Parquet file, or of a frame, with a row per run, or per time of a run.

    wide   NAME_true and NAME, or NAME_error; NAME_std, NAME_var or cov_NAME_NAME; cov_A_B
    long   run, parameter, true and estimate, or error; std or var

    A column `run` numbers runs.

    Raises:
        UserError: a column is missing, a covariance is none, or the file cannot be read; it names the column or row.
    """
    import pandas as pd

    name, frame = (
        ("the frame", table)
        if isinstance(table, pd.DataFrame)
        else (str(table), _read(Path(table)))
    )
    _refuse_many(len(frame.columns), name, "columns")
    _refuse_twice(frame, name)
    if "parameter" in frame:
        _refuse_many(frame["parameter"].nunique(), name, "parameters")
        frame = _widened(frame, name)
    ends = ("_true", "_error")
    names = tuple(
        dict.fromkeys(
            c.removesuffix(e) for e in ends for c in map(str, frame.columns) if c.endswith(e)
        )
    )
    if not names:
        raise UserError(
            f"{name}: has no truth; give columns NAME_true and NAME, or NAME_error, and NAME_std"
        )
    error, deviation = np.array(
        [_error_and_deviation(frame, parameter, name) for parameter in names]
    ).transpose(1, 2, 0)
    there = ~np.isnan(error).any(axis=1) & np.isfinite(deviation).all(axis=1)
    if not there.any():
        raise UserError(
            f"{name}: no row has an estimate with finite deviations of {', '.join(names)}; give some"
        )
    if len(bad := np.argwhere(there[:, None] & ~(deviation > 0))):
        raise UserError(
            f"{name}: row {bad[0, 0] + 2}: the deviation of {names[bad[0, 1]]} is not above 0"
        )
    rows, correlation = np.flatnonzero(there), _correlation(frame, names, deviation, name)
    frame, error, deviation = frame.iloc[rows], error[rows], deviation[rows]
    if correlation is not None:
        correlation = correlation[rows]
        good = np.array(np.isfinite(correlation).all(axis=(1, 2)))
        good[good] = np.linalg.eigvalsh(correlation[good])[:, 0] > 1e-12
        if not good.all():
            raise UserError(
                f"{name}: row {rows[np.argmin(good)] + 2}: the covariance is not positive definite"
            )
    run = pd.factorize(frame["run"])[0] if "run" in frame else np.arange(len(frame))
    return Claims(
        names, error, deviation, correlation, np.asarray(run, dtype=np.intp), int((~there).sum())
    )


def _read(path: Path) -> pd.DataFrame:
    import pandas as pd

    if not path.is_file():
        raise UserError(f"{path}: there is no such file")
    try:
        if path.suffix == ".parquet":
            return pd.read_parquet(path)
        separator = _separator(path)
        # pandas 2 rounds the last digits of numbers unless it reads texts.
        frame, texts = (
            pd.read_csv(path, sep=separator, engine="python", dtype=dtype) for dtype in (None, str)
        )
        return frame.assign(
            **{str(name): texts[name].astype(float) for name in frame.select_dtypes("float")}
        )
    except (ValueError, OSError, csv.Error) as error:
        raise UserError(
            f"{path}: cannot be read as a table ({str(error).splitlines()[0]})"
        ) from None


def _separator(path: Path) -> str:
    """Finds what separates the columns of a file by its first line, which is refused if it is none or too long."""
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        heading = next((line for line in file if line.strip()), "")
    if not heading:
        raise UserError(f"{path}: is empty; give a table with a header and a row per run")
    _refuse_many(1 + max(map(heading.count, ",;\t|")), str(path), "columns")
    try:
        return csv.Sniffer().sniff(heading).delimiter
    except csv.Error:
        return ","


def _refuse_many(count: int, name: str, what: str) -> None:
    if count > MOST_COLUMNS:
        raise UserError(f"{name}: has {count:,} {what}; give at most {MOST_COLUMNS:,}")


def _refuse_twice(frame: pd.DataFrame, name: str) -> None:
    """Refuses a column that appears twice; a file's second one was given the ending .1."""
    columns = list(map(str, frame.columns))
    for i, column in enumerate(columns):
        base = column.removesuffix(".1")
        again = (
            base != column
            and base in columns
            and not {f"{column}_true", f"{column}_error"} & set(columns)
        )
        if column in columns[:i] or again:
            raise UserError(f"{name}: column {base} stands there twice; leave one of them out")


def _numbers(frame: pd.DataFrame, column: str, name: str) -> Array:
    """Returns the numbers (rows,) of a column; NaN where a cell is empty.

    Raises:
        UserError: a cell says something else.
    """
    import pandas as pd

    values = pd.to_numeric(frame[column], errors="coerce").to_numpy(float)
    if len(bad := np.flatnonzero(np.isnan(values) & frame[column].notna().to_numpy())):
        said = f"'{frame[column].iloc[bad[0]]}' is not a number; write it with a decimal point, or leave the cell empty"
        raise UserError(f"{name}: row {bad[0] + 2}, column {column}: {said}")
    return values


def _widened(frame: pd.DataFrame, name: str) -> pd.DataFrame:
    """Converts a table with a row per run and parameter to one with a row per run."""
    values = [c for c in ("true", "estimate", "error", "std", "var") if c in frame]
    index = [c for c in frame.columns if c not in (*values, "parameter")]
    if not index:
        raise UserError(f"{name}: has no column run, which groups the rows of a run")
    if (twice := frame.duplicated([*index, "parameter"]).to_numpy()).any():
        row = int(np.argmax(twice)) + 2
        raise UserError(
            f"{name}: row {row}: a parameter stands there a second time in {', '.join(index)}"
        )
    frame = frame.assign(**{c: _numbers(frame, c, name) for c in values})
    wide = frame.pivot_table(index=index, columns="parameter", values=values, sort=False)
    wide.columns = [p if value == "estimate" else f"{p}_{value}" for value, p in wide.columns]
    return wide.reset_index()


def _error_and_deviation(frame: pd.DataFrame, parameter: str, name: str) -> tuple[Array, Array]:
    if f"{parameter}_error" in frame:
        error = _numbers(frame, f"{parameter}_error", name)
    elif parameter in frame:
        error = _numbers(frame, parameter, name) - _numbers(frame, f"{parameter}_true", name)
    else:
        raise UserError(
            f"{name}: has {parameter}_true, but no column {parameter} with the estimates"
        )
    stated = {}
    for column in (f"{parameter}_std", f"{parameter}_var", f"cov_{parameter}_{parameter}"):
        if column in frame:
            values = _numbers(frame, column, name)
            stated[column] = values if column.endswith("_std") else np.sqrt(np.maximum(values, 0.0))
    if not stated:
        raise UserError(
            f"{name}: has no deviation of {parameter}; give {parameter}_std, {parameter}_var or "
            f"cov_{parameter}_{parameter}"
        )
    (first, deviation), *others = stated.items()
    for column, other in others:
        # Rounded to three digits they agree.
        if len(bad := np.flatnonzero(np.abs(other - deviation) > 0.01 * np.abs(deviation))):
            raise UserError(
                f"{name}: row {bad[0] + 2}: {first} and {column} differ; give one of them"
            )
    return error, deviation


def _correlation(
    frame: pd.DataFrame, names: Sequence[str], deviation: Array, name: str
) -> Array | None:
    """Returns correlations (rows, n, n), 0 where a pair has no covariance; None if there is no covariance at all."""
    columns = set(frame.columns)
    stated = [
        (i, j)
        for i, a in enumerate(names)
        for j, b in enumerate(names)
        if i != j and f"cov_{a}_{b}" in columns
    ]
    if not stated:
        return None
    found = np.tile(np.eye(len(names)), (len(frame), 1, 1))
    for i, j in stated:
        with np.errstate(all="ignore"):
            value = _numbers(frame, f"cov_{names[i]}_{names[j]}", name) / (
                deviation[:, i] * deviation[:, j]
            )
        # The other half of the matrix may have stated it already.
        if (
            (i, j)[::-1] in stated
            and j < i
            and len(bad := np.flatnonzero(np.abs(found[:, i, j] - value) > 1e-6))
        ):
            row, columns = bad[0] + 2, f"cov_{names[j]}_{names[i]} and cov_{names[i]}_{names[j]}"
            raise UserError(
                f"{name}: row {row}: {columns} differ; a covariance is symmetric, so give one of them"
            )
        found[:, i, j] = found[:, j, i] = value
    return found
