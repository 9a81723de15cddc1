"""Tests whether the covariance that another program reports describes its errors: scale, direction,
tails and bias.

Everything is said of the whitened errors w = C^(-1/2) (e / s), with s the reported standard
deviations and C the reported correlations: w ~ N(0, I) if the report is true, and w'w is the NEES.
Scale and tails are separate questions: errors of Student's law with the stated covariance are
honest, and chi-square limits refuse them seven times out of ten.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import permutations, product
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri, stdtr, stdtrit

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.files import fault_of
from ipe_bench.basics.linalg import Array, finite
from ipe_bench.statistics.comparisons import ALPHA, holm
from ipe_bench.statistics.intervals import rms_interval
from ipe_bench.trials.observability import in_words

if TYPE_CHECKING:
    import pandas as pd

FEWEST_RUNS = 20
MOST_COLUMNS = 4096
_SEPARATORS = ",;\t| "
MATTERS = 1.1
"""A factor of the standard deviation below which a covariance can be believed."""
_DRAWS = 1999
"""Monte Carlo draws of a null distribution."""
_DEGREE = 180 / np.pi
_SCALE = 5.0
_DIRECTION = 2.0
_BIAS = 1.0
_TAILS = 1.0
"""Shares of the level that the questions have: the first one is asked most."""
_MANY = 1000
"""Rows above which the null distribution of the fourth moment is taken for normal."""
FARTHEST = 1e12
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
        """Whitened errors (rows, n). The symmetric root keeps each as near to its own parameter as
        can be (Kessy, Lewin, Strimmer, Amer. Statist. 72, 2018)."""
        if self.correlation is None:
            return self.z
        values, vectors = np.linalg.eigh(self.correlation)
        # C = V L V', so that w = V L^(-1/2) V' z.
        return np.einsum("rij,rj,rkj,rk->ri", vectors, values**-0.5, vectors, self.z, optimize=True)

    @property
    def parts(self) -> list[Array]:
        """The errors whose law is stated: the whitened ones (rows, n), or those of each parameter
        (rows, 1)."""
        return [self.w] if self.joint else np.split(self.z, self.n, axis=1)

    def per_run(self, values: Array) -> Array:
        """Means over the rows of each run (runs, k)."""
        _, run = np.unique(self.run, return_inverse=True)
        total = np.zeros((self.runs, values.shape[1]))
        np.add.at(total, run, values)
        return total / np.bincount(run)[:, None]


@dataclass(frozen=True)
class Factor:
    """Holds the ratio of true to reported standard deviations, with an interval that needs no
    normal law."""

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
        if self.low > 1 / MATTERS and self.high < MATTERS:
            return "right"
        return "undecided"

    @property
    def apart(self) -> float:
        """How far it lies from 1, by its logarithm."""
        return abs(float(np.log(max(self.value, 1e-300))))

    @property
    def wrong(self) -> bool:
        return self.verdict in ("too small", "too large")

    @property
    def words(self) -> str:
        """Sentence that compares true errors with reported ones."""
        if self.value == np.inf:
            return "infinite in some runs"
        known = self.high < _LARGEST * self.value
        span = f"{self.low:.2f} to {self.high:.2f}" if known else f"more than {self.low:.2g}"
        return f"{self.value:.2f} times as large as reported ({span})"


@dataclass(frozen=True)
class Audit:
    """Holds the findings; `sentences` state them, the strongest first."""

    claims: Claims
    scale: Factor
    """Factor of all parameters, with an interval of 97.5 %: half of the level, the other questions
    having the rest."""
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
        bias, low, high = self.bias.T
        return frame.assign(bias=bias, bias_low=low, bias_high=high)


class _Asked(NamedTuple):
    share: float
    """Of the level."""
    p: float
    """Probability of a fault as large as the one that was found, in an honest report."""
    sentence: str


def audit(claims: Claims) -> Audit:
    """Examines the covariance that a program reports.

    No covariance allows for an infinite error, so one is enough for "too small"; the rest is of the
    other runs. A fault is said where its question (scale, direction, tails, bias) is refused at 5 %
    over all of them together (Holm), so an honest report meets any false sentence in at most 5 % of
    cases.

    Raises:
        UserError: there are too few runs, or errors and deviations differ by the factor of degrees
            and radians.
    """
    with np.errstate(over="ignore"):
        lost = ~(np.abs(claims.z) < FARTHEST)
    if lost.any():
        return _with_infinite_errors(claims, lost)
    _require_evidence(claims)
    nees = np.sum(claims.w**2, axis=1)
    each = _factors(claims, claims.z**2, 1 - ALPHA / 2 / claims.n)
    for name, factor in zip(claims.names, each, strict=True):
        _refuse_degrees(name, factor)
    # E[w'w] = n f^2 if true deviations are f times the reported ones.
    (scale,) = _factors(claims, nees[:, None] / claims.n, 1 - ALPHA / 2)
    # The scale has been tested at its share of the level.
    asked = [_Asked(_SCALE, 0.0 if scale.wrong else 1.0, _of_scale(claims, scale, nees))]
    if claims.n > 1 and claims.joint:
        asked.append(_Asked(_DIRECTION, *_worst_direction(claims)))
    bias, p_bias = _bias(claims)
    asked.append(_Asked(_BIAS, p_bias, _of_bias(claims, bias)))
    # The fourth moment is known of independent rows alone.
    if claims.runs == len(nees):
        asked.append(_Asked(_TAILS, *_tails(claims)))
    corrected = holm([one.p for one in asked], [one.share for one in asked])
    refused = [one for one, p in zip(asked, corrected, strict=True) if p <= ALPHA]
    # What the scale is stands first, refused or not.
    faults = [one.sentence for one in refused if one is not asked[0]]
    return Audit(claims, scale, each, bias, (asked[0].sentence, *faults[:2]))


def _require_evidence(claims: Claims) -> None:
    """Refuses too few independent runs, and errors without a scatter of their own."""
    if claims.runs < FEWEST_RUNS:
        found = f"there are {claims.runs} independent runs"
        if claims.runs == 1:
            found = "there is 1 independent run"
        if claims.runs == 1 and len(claims.run) > 1:
            found += "; one log of dependent rows is too little evidence"
        raise UserError(f"audit: {found}; give at least {FEWEST_RUNS}")
    largest = np.abs(claims.z).max(axis=0)
    none = (largest < 1 / FARTHEST).any()
    if none or any(np.linalg.matrix_rank(part) < part.shape[1] for part in claims.parts):
        raise UserError(
            f"audit: the errors of {', '.join(claims.names)} are 0 in every run, or follow from one"
            " another; leave out the parameters that are known or are made of others"
        )


def _refuse_degrees(name: str, factor: Factor) -> None:
    """Refuses a parameter whose errors are surely those of another unit of angle."""
    surely = factor.high < 1.5 * factor.low
    for ratio in (_DEGREE, 1 / _DEGREE):
        if surely and factor.low < ratio < factor.high:
            raise UserError(
                f"audit: errors of {name} are {factor.value:.3g} times as large as reported, the"
                " factor between degrees and radians; give both in one unit"
            )


def _with_infinite_errors(claims: Claims, lost: NDArray[np.bool_]) -> Audit:
    """Audits errors (rows, n) of which some are `lost`, that is infinite; the other runs are
    audited alone."""
    rows = np.asarray(lost.any(axis=1))
    infinite = np.asarray(lost.any(axis=0))
    kept = ~np.isin(claims.run, claims.run[rows])
    others = replace(
        claims,
        error=claims.error[kept],
        deviation=claims.deviation[kept],
        correlation=None if claims.correlation is None else claims.correlation[kept],
        run=claims.run[kept],
    )
    gone = claims.runs - others.runs
    said = (
        f"The error is infinite, or beyond {FARTHEST:g} reported deviations, in {gone} of"
        f" {claims.runs} runs: the covariance is too small."
    )
    each = (Factor(np.nan, np.nan, np.nan),) * claims.n
    bias = np.full((claims.n, 3), np.nan)
    more: tuple[str, ...] = ()
    if others.runs >= FEWEST_RUNS:
        rest = audit(others)
        each = rest.each
        bias = rest.bias
        more = (f"In the others: {rest.sentences[0]}", *rest.sentences[1:2])
    endless = Factor(np.inf, np.inf, np.inf)
    each = tuple(endless if bad else factor for bad, factor in zip(infinite, each, strict=True))
    bias = np.where(infinite[:, None], np.nan, bias)
    return Audit(claims, endless, each, bias, (said, *more))


def _of_scale(claims: Claims, scale: Factor, nees: Array) -> str:
    """Words the finding on the scale; if it is undecided and the runs are fewer, with the
    number in which a standard deviation that is wrong by 10 % is seen in four of five cases."""
    if scale.wrong:
        only = "" if scale.value > 1 else "only "
        return f"True errors are {only}{scale.words}: the covariance is {scale.verdict}."
    if scale.verdict == "right":
        return f"True errors are {scale.words}: no evidence against the covariance."
    # The logarithm of the mean NEES has the variance v / runs, and a factor f moves it by 2 log f:
    # runs = v ((z_level + z_power) / (2 log f))^2.
    mean = claims.per_run(nees[:, None])[:, 0]
    spread = float(mean.var(ddof=1) / mean.mean() ** 2)
    errors = ndtri(1 - ALPHA / 4) + ndtri(0.8)
    needed = np.ceil(spread * (errors / (2 * np.log(MATTERS))) ** 2)
    if needed <= claims.runs:
        return (
            f"True errors are {scale.words}: {claims.runs} runs show neither that the covariance"
            " is right nor that it is wrong."
        )
    return (
        f"True errors are {scale.words}: {claims.runs} runs are too few to judge the covariance; a"
        " standard deviation that is wrong by 10 % would be detected in"
        f" {needed:.0f} runs."
    )


def _factors(claims: Claims, squares: Array, level: float) -> tuple[Factor, ...]:
    """Computes roots of the means of squares (rows, k), with bootstrap-t intervals over runs."""
    mean = claims.per_run(squares)
    value = np.sqrt(mean.mean(axis=0))
    low, high = rms_interval(mean, level=level)
    return tuple(map(Factor, value.tolist(), low.tolist(), high.tolist()))


def _bias(claims: Claims) -> tuple[Array, float]:
    """Computes the mean errors with their intervals (n, 3), and the p that any is due to chance."""
    mean = claims.per_run(claims.z)
    centre = mean.mean(axis=0)
    error = mean.std(axis=0, ddof=1) / np.sqrt(claims.runs)
    # Student's t of the runs' means; Bonferroni's correction over the n parameters.
    freedom = claims.runs - 1
    reach = stdtrit(freedom, 1 - ALPHA / 2 / claims.n) * error
    t = np.abs(centre) / np.maximum(error, 1e-300)
    one_sided = float(stdtr(freedom, -float(t.max())))
    p = min(1.0, 2 * claims.n * one_sided)
    return np.column_stack([centre, centre - reach, centre + reach]), p


def _of_bias(claims: Claims, bias: Array) -> str:
    """Words the bias that is largest beside its interval."""
    centre, low, high = bias.T
    worst = int(np.argmax(np.abs(centre) / (high - low)))
    return (
        f"{claims.names[worst]} is biased by {centre[worst]:+.2f} reported deviations"
        f" ({low[worst]:+.2f} to {high[worst]:+.2f})."
    )


def _worst_direction(claims: Claims) -> tuple[float, str]:
    """Computes the p of the least spherical scatter, and the direction in which errors exceed the
    report most.

    Lengths are let go: u = w / |w| is uniform on the sphere under any spherical law, normal or not,
    so the extreme eigenvalues of its scatter have one null distribution (Tyler, Biometrika 74,
    1987). Of several rows of a run the first is taken.
    """
    assert claims.correlation is not None
    _, first = np.unique(claims.run, return_index=True)
    w = claims.w[first]
    values, vectors = np.linalg.eigh(_scatter(w))
    smallest, largest = _null(_extremes, *w.shape).T
    # Either end may be the unusual one, hence twice the lesser p.
    p = min(_p(smallest <= values[0]), _p(largest >= values[-1]))

    ends = vectors[:, [0, -1]].T
    factors = [_factor_along(claims, v) for v in ends]
    farthest = int(np.argmax([abs(np.log(factor.value)) for factor in factors]))
    # w' v = (e / s)' C^(-1/2) v, with the mean of the reported correlations.
    values, vectors = np.linalg.eigh(claims.correlation.mean(axis=0))
    root = (vectors * values**-0.5) @ vectors.T
    named = in_words(claims.names, root @ ends[farthest])
    said = (
        f"In the worst direction, {named} in reported deviations, true errors are"
        f" {factors[farthest].words}."
    )
    return min(1.0, 2 * p), said


def _factor_along(claims: Claims, v: Array) -> Factor:
    """Computes the factor of the errors along a direction (n,)."""
    along = np.square(claims.w @ v)
    (factor,) = _factors(claims, along[:, None], 1 - ALPHA)
    return factor


def _p(as_unusual: Array) -> float:
    """Computes the p of a Monte Carlo test, in which the errors themselves count as one draw
    more."""
    return float((1 + np.sum(as_unusual)) / (1 + _DRAWS))


def _scatter(w: Array) -> Array:
    """Computes n times the mean of u u' over the rows u = w / |w| (n, n)."""
    lengths = np.linalg.norm(w, axis=1, keepdims=True)
    u = w / np.maximum(lengths, 1e-300)
    return w.shape[1] * (u.T @ u) / len(u)


def _extremes(w: Array) -> Array:
    """Returns the least and the largest eigenvalue of the scatter."""
    return np.linalg.eigvalsh(_scatter(w))[[0, -1]]


def _tails(claims: Claims) -> tuple[float, str]:
    """Computes the p of the fourth moment E[d^2] under normal errors of any covariance, with
    d = w' S^-1 w and S the scatter of w (Mardia, Biometrika 57, 1970, for a known mean); without
    covariances, any parameter's."""
    parts = claims.parts
    rows, n = parts[0].shape
    largest = max(map(_fourth_moment, parts))
    # Of normal errors E[d^2] = n (n + 2), and its mean over many rows has the variance
    # 8 n (n + 2) / rows.
    usual = n * (n + 2)
    excess = largest / usual - 1
    if rows > _MANY:
        p = float(ndtr(-excess * usual / np.sqrt(8 * usual / rows)))
    else:
        p = _p(_null(_fourth_moment, rows, n) >= largest)
    said = f"their fourth moment is {largest / usual:.1f} times the normal one."
    return min(1.0, len(parts) * p), f"Errors have heavier tails than normal ones: {said}"


def _fourth_moment(w: Array) -> float:
    S = w.T @ w / len(w)
    d = np.sum(w * np.linalg.solve(S, w.T).T, axis=1)
    return float(np.mean(d**2))


@lru_cache(maxsize=8)
def _null(statistic: Callable[[Array], Array | float], rows: int, n: int) -> Array:
    """Simulates the statistic of normal errors (draws, ...)."""
    rng = np.random.default_rng([rows, n])
    return np.array([statistic(rng.standard_normal((rows, n))) for _ in range(_DRAWS)])


# Reading -----------------------------------------------------------------------------------------


def read_claims(table: Path | str | pd.DataFrame) -> Claims:
    """Reads the claims of a CSV or Parquet file, or of a frame, with a row per run, or per time of
    a run.

    wide   NAME_true and NAME, or NAME_error; NAME_std, NAME_var or cov_NAME_NAME; cov_A_B
    long   run, parameter, true and estimate, or error; std or var

    A column `run` numbers runs.

    Raises:
        UserError: a column is missing, a covariance is none, or the file cannot be read; it names
            the column or row.
    """
    import pandas as pd

    if isinstance(table, pd.DataFrame):
        name = "the frame"
        frame = table.reset_index(drop=True)
    else:
        name = str(table)
        frame = _read(Path(table))
    _refuse_many(len(frame.columns), name, "columns")
    _refuse_twice(frame, name)
    if "parameter" in frame:
        _refuse_many(frame["parameter"].nunique(), name, "parameters")
        frame = _widened(frame, name)
    names = _parameters(frame)
    if not names:
        raise UserError(
            f"{name}: has no truth; give columns NAME_true and NAME, or NAME_error, and NAME_std"
        )
    stated = [
        (_error(frame, parameter, name), _deviation(frame, parameter, name)) for parameter in names
    ]
    error, deviation = np.array(stated).transpose(1, 2, 0)
    there = ~np.isnan(error).any(axis=1) & finite(deviation)
    if "run" in frame:
        there &= frame["run"].notna().to_numpy()
    _require_deviations(frame, deviation, there, names, name)
    correlation = _correlation(frame, names, deviation, name)
    rows = np.flatnonzero(there)
    if correlation is not None:
        correlation = correlation[rows]
        _require_positive(frame, correlation, rows, name)
    run = np.arange(len(rows))
    if "run" in frame:
        run, _ = pd.factorize(frame["run"].iloc[rows])
    run = np.asarray(run, dtype=np.intp)
    left_out = int((~there).sum())
    return Claims(names, error[rows], deviation[rows], correlation, run, left_out)


def _place(frame: pd.DataFrame, row: int, name: str) -> str:
    """Names a row by its line in a file, the first of which is the header, or by what a table that
    was long has as its index: the run."""
    keys = frame.index.names
    if keys == [None]:
        return f"{name}: row {row + 2}"
    values = frame[list(keys)].iloc[row]
    return f"{name}: {', '.join(f'{key} {value}' for key, value in zip(keys, values, strict=True))}"


def _parameters(frame: pd.DataFrame) -> tuple[str, ...]:
    """Finds the parameters whose truth or error is there."""
    found = []
    for end in ("_true", "_error"):
        columns = [column for column in map(str, frame.columns) if column.endswith(end)]
        found += [column.removesuffix(end) for column in columns]
    return tuple(dict.fromkeys(found))


def _require_deviations(
    frame: pd.DataFrame, deviation: Array, there: NDArray[np.bool_], names: Sequence[str], name: str
) -> None:
    """Refuses claims (rows, n) of which no row is `there` (rows,), and deviations of 0 or less."""
    if not there.any():
        raise UserError(
            f"{name}: no row has an estimate with finite deviations of {', '.join(names)}; give"
            " some"
        )
    bad = np.argwhere(there[:, None] & ~(deviation > 0))
    if len(bad):
        row, i = bad[0]
        raise UserError(f"{_place(frame, row, name)}: the deviation of {names[i]} is not above 0")


def _require_positive(
    frame: pd.DataFrame, correlation: Array, rows: NDArray[np.intp], name: str
) -> None:
    """Refuses correlations (rows, n, n), of those rows of the table, that are none."""
    good = finite(correlation)
    good[good] = np.linalg.eigvalsh(correlation[good])[:, 0] > 1e-12
    if not good.all():
        row = rows[np.argmin(good)]
        raise UserError(f"{_place(frame, row, name)}: the covariance is not positive definite")


def _read(path: Path) -> pd.DataFrame:
    import pandas as pd

    fault = fault_of(path)
    if fault:
        raise UserError(f"{path}: {fault}")
    try:
        if path.suffix == ".parquet":
            return pd.read_parquet(path)
        # As texts, whose numbers `_numbers` reads: pandas 2 rounds their last digits.
        return pd.read_csv(path, sep=_separator(path), engine="python", dtype=str)
    except (ValueError, OSError, csv.Error) as error:
        line = str(error).splitlines()[0]
        raise UserError(f"{path}: cannot be read as a table ({line})") from None


def _separator(path: Path) -> str:
    """Finds what separates the columns of a file by its first line, which is refused if it is none
    or too long."""
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        heading = next((line for line in file if line.strip()), "")
    if not heading:
        raise UserError(f"{path}: is empty; give a table with a header and a row per run")
    _refuse_many(1 + max(map(heading.count, _SEPARATORS)), str(path), "columns")
    try:
        return csv.Sniffer().sniff(heading, _SEPARATORS).delimiter
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
        # A parameter whose name has that ending has a truth of its own.
        own = {f"{column}_true", f"{column}_error"} & set(columns)
        again = base != column and base in columns and not own
        if column in columns[:i] or again:
            raise UserError(f"{name}: column {base} is given twice; remove one")


def _numbers(frame: pd.DataFrame, column: str, name: str) -> Array:
    """Returns the numbers (rows,) of a column; NaN where a cell is empty.

    Raises:
        UserError: a cell says something else.
    """
    import pandas as pd

    values = pd.to_numeric(frame[column], errors="coerce")
    bad = np.flatnonzero(values.isna() & frame[column].notna())
    if len(bad):
        raise UserError(
            f"{_place(frame, bad[0], name)}, column {column}: '{frame[column].iloc[bad[0]]}' is not"
            " a number; write it with a decimal point, or leave the cell empty"
        )
    return frame[column].to_numpy(float, na_value=np.nan)


def _widened(frame: pd.DataFrame, name: str) -> pd.DataFrame:
    """Converts a table with a row per run and parameter to one with a row per run,
    which the index names."""
    import pandas as pd

    values = [c for c in ("true", "estimate", "error", "std", "var") if c in frame]
    index = [c for c in frame.columns if c not in (*values, "parameter")]
    if not index:
        raise UserError(f"{name}: has no column run, which groups the rows of a run")
    twice = frame.duplicated([*index, "parameter"]).to_numpy()
    if twice.any():
        row = int(np.argmax(twice))
        raise UserError(
            f"{_place(frame, row, name)}: a parameter is given twice in {', '.join(index)}"
        )
    nameless = (frame["parameter"].isna() & frame[values].notna().any(axis=1)).to_numpy()
    if nameless.any():
        row = int(np.argmax(nameless))
        raise UserError(f"{_place(frame, row, name)}: has no parameter; name it")
    numbers = pd.DataFrame({column: _numbers(frame, column, name) for column in values})
    group = frame.groupby(index, sort=False, dropna=False).ngroup().to_numpy()
    # `pivot_table` would drop rows with an empty key.
    wide = numbers.set_index([group, frame["parameter"]]).unstack()  # noqa: PD010
    parameters = frame["parameter"].dropna().unique()
    named = frame[index].drop_duplicates(ignore_index=True)
    for value, p in product(values, parameters):
        column = wide[value, p]
        if column.notna().any():
            named[p if value == "estimate" else f"{p}_{value}"] = column
    return named.set_index(index, drop=False)


def _error(frame: pd.DataFrame, parameter: str, name: str) -> Array:
    """Returns the errors (rows,) of a parameter, as given or as estimate less truth."""
    if f"{parameter}_error" in frame:
        return _numbers(frame, f"{parameter}_error", name)
    if parameter not in frame:
        raise UserError(
            f"{name}: has {parameter}_true, but no column {parameter} with the estimates"
        )
    return _numbers(frame, parameter, name) - _numbers(frame, f"{parameter}_true", name)


def _deviation(frame: pd.DataFrame, parameter: str, name: str) -> Array:
    """Returns the reported deviations (rows,) of a parameter, in which all its columns agree."""
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
        bad = np.flatnonzero(np.abs(other - deviation) > 0.01 * np.abs(deviation))
        if len(bad):
            raise UserError(
                f"{_place(frame, bad[0], name)}: {first} and {column} differ; give one of them"
            )
    return deviation


def _correlation(
    frame: pd.DataFrame, names: Sequence[str], deviation: Array, name: str
) -> Array | None:
    """Returns correlations (rows, n, n), 0 where a pair has no covariance; None if there is no
    covariance at all."""
    pairs = {(i, j): f"cov_{names[i]}_{names[j]}" for i, j in permutations(range(len(names)), 2)}
    columns = set(frame.columns)
    stated = {pair: column for pair, column in pairs.items() if column in columns}
    if not stated:
        return None
    found = np.tile(np.eye(len(names)), (len(frame), 1, 1))
    for (i, j), column in stated.items():
        covariance = _numbers(frame, column, name)
        with np.errstate(all="ignore"):
            value = covariance / (deviation[:, i] * deviation[:, j])
        # The other half of the matrix may have stated it already.
        if j < i and (j, i) in stated:
            bad = np.flatnonzero(np.abs(found[:, i, j] - value) > 1e-6)
            if len(bad):
                raise UserError(
                    f"{_place(frame, bad[0], name)}: {stated[j, i]} and {column} differ; a"
                    " covariance is symmetric, so give one of them"
                )
        found[:, i, j] = value
        found[:, j, i] = value
    return found
