"""Chooses what to measure next: which of the readings that a model could take to add, to drop, or
to take instead.

Bounds are those at one point, the model's start or an estimate. Choices are good on average over
the point and truths from the prior (Chaloner and Larntz, J. Stat. Plan. Inference 21, 1989), by
shares of today's bounds at each: they take, one after another, the readings that gain most. What
readings say about each parameter is in `observability`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NoReturn, get_args

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.errors import UserError, unknown
from ipe_bench.basics.linalg import Array, Covariance, Mask, gram
from ipe_bench.measurements.base import Measurement, labels
from ipe_bench.report.words import value_text
from ipe_bench.trials.observability import (
    TRUTHS,
    Observability,
    Suspect,
    readable,
    suspects,
)
from ipe_bench.trials.scenario import Scenario

Criterion = Literal["A", "D"]
"""A: the mean over parameters and truths of the squared bound. D: the volume of its ellipsoid."""
SUSPECTED = 5
"""Truths at which unmodelled errors are tried: each takes two simulations of each of them."""
_WEAK = 1e-8
"""Information that every choice is assumed to have beforehand, as a share of that of all
candidates: the first readings chosen do not determine the parameters by themselves."""
MOST_MORE = 6
"""Readings that are suggested one after another."""
_GRID = 61
"""Entries of an input at which further readings are tried."""
_REACH = 4
"""Multiple of an input's range up to which they are."""
_FEW = 3
"""Least number of units with a choice."""


@dataclass(frozen=True)
class Units:
    """Describes what is taken or left as a whole: the readings with equal entries in the columns
    `by`."""

    by: tuple[str, ...]
    entries: tuple[tuple[Any, ...], ...]
    """Entries of a unit's readings in those columns."""
    rows: tuple[NDArray[np.intp], ...]
    """The rows of the candidates' z."""
    today: Mask
    """Which units today's set-up has (units,)."""
    slopes: Array
    """(truths, units, r, n): whitened, in units of today's bounds; r rows say what all readings of
    the unit say."""

    def information(self, taken: Mask) -> Array:
        """Computes the information (truths, n, n) of the units that are taken (units,)."""
        A = self.slopes[:, taken]
        return np.einsum("turi,turj->tij", A, A, optimize=True)


@dataclass(frozen=True)
class Choice:
    """Describes some of the units, and what estimates of their readings would be worth."""

    taken: tuple[int, ...]
    """The units, by their place."""
    rows: tuple[int, ...]
    """The rows of the candidates' z, ascending."""
    mean_bound: float
    """The bound as a share of today's, over parameters and truths: the root of the mean square (A),
    or the geometric mean along the ellipsoid's axes (D). Infinite where the readings leave a
    direction open."""

    @property
    def readings(self) -> int:
        return len(self.rows)


@dataclass(frozen=True)
class Way:
    """Describes one way to choose: by case, by time, or reading by reading; all else as today."""

    units: Units
    saving: Choice | None
    """The smallest choice whose mean bound is not above today's; None if that takes as many
    readings as today."""
    sharpest: Choice
    """The smallest mean bound with no more readings than today."""

    @property
    def title(self) -> str:
        return "by " + " and ".join(self.units.by)


@dataclass(frozen=True)
class Further:
    """Describes what single readings beside today's would add at the point; bounds in multiples of
    the parameters' sizes."""

    words: tuple[str, ...]
    """The candidates (g,): where each is taken."""
    column: str
    """The column along which they lie; empty if there is more than one."""
    entries: Array
    """Their entries (g,) there."""
    alone: Array
    """Bounds (g, n) with one of them."""
    taken: tuple[int, ...]
    """The candidates that gain most, one after another."""
    bounds: Array
    """Bounds (1 + taken, n): today's, then with each further one."""


@dataclass(frozen=True)
class Design:
    """Describes what a scenario's readings say, and what others would."""

    scenario: Scenario
    at: Mapping[str, float] | None
    """The estimates by name at which all is evaluated; None: the model's start, and truths from the
    prior."""
    x: Array
    """The point, and behind it the truths from the prior (1 + truths, n)."""
    criterion: Criterion
    candidates: Measurement
    observability: Observability
    suspects: tuple[Suspect, ...]
    ways: tuple[Way, ...]
    further: Further | None = None
    """What to read next; None without a candidate, or if today's readings leave a parameter
    open."""
    lost: int = 0
    """The number of truths that have no finite readings, over which nothing is averaged."""
    about_estimate: bool = False
    """Whether the model starts at the estimate from a user's own readings."""

    def measurement(self, choice: Choice) -> Measurement:
        """Returns the model that takes these readings and no others."""
        return self.candidates.taking(choice.rows)


def design(
    scenario: Scenario,
    *,
    at: Mapping[str, float] | None = None,
    by: Sequence[str] | None = None,
    readings: int | None = None,
    criterion: Criterion = "A",
    errors: Sequence[Measurement] = (),
    truths: int = TRUTHS,
) -> Design:
    """Evaluates what the scenario's readings say about its parameters, and which readings would say
    more.

    `at` has estimates by name, each in its own unit: all is evaluated there, else at the model's
    start and at truths from the prior. `by` names columns of the model's index, whose entries are
    chosen while all else stays as today; None tries each column and then reading by reading.
    `readings` is the number to have at most, today's where it is None. `errors` are richer versions
    of the model, whose nuisances may look like parameters.

    Raises:
        UserError: noise of an unknown level, or with correlated errors, which do not add up; an
            unknown column; too few readings; a point or truths without any; an estimate that lacks.
    """
    if criterion not in get_args(Criterion):
        raise UserError(f"criterion={criterion}: choose A or D")
    noise = scenario.noise
    if noise.estimated:
        raise UserError(
            f"noise={noise.name}: without the level of the noise there are no bounds; give the"
            " deviation that you expect, as in noise=gaussian noise.deviation=0.1"
        )
    model = scenario.measurement
    R = scenario.problem.R
    candidates = model.candidates
    point = _point(model, at)
    x = point
    lost = 0
    if at is None:
        over = readable(candidates, readable(model, scenario.truths(0, truths)))
        x = np.concatenate([point, over])
        lost = truths - len(over)
    today = Observability.at(model, R, x)
    worst = _worst_suspects(model, R, errors, x)
    columns = _columns(model, by)
    if R.factor.ndim != 1:
        raise UserError(
            f"noise={noise.name}: the errors of readings are correlated, so that readings do not"
            " add up; a design needs noise=gaussian or noise=quantization"
        )
    R_all = covariance_of(scenario, candidates)
    whole = Observability.at(candidates, R_all, x)
    if not whole.observable:
        return Design(scenario, at, x, criterion, candidates, today, worst, (), lost=lost)
    most = _most_readings(model, candidates, readings)

    # All is in units of today's bounds, or of those that all candidates have together.
    reference = today if today.observable else whole
    variances = np.diagonal(reference.covariance, axis1=1, axis2=2)
    bounds = np.sqrt(variances)[:, None, :]
    slopes = R_all.whiten_jacobian(candidates.jacobian(x)) * bounds
    own = R.whiten_jacobian(model.jacobian(x)) * bounds
    judge = _Judge(criterion, gram(slopes))
    value = judge.value(gram(own))
    if np.isfinite(value):
        judge = replace(judge, today=value)
    # Readings may be so alike that products of their slopes do not tell them apart.
    apart = np.isfinite(judge.value(judge.everything))
    units = [_units(model, candidates, chosen, slopes) for chosen in columns if apart]
    tried = [_way(judge, one, model.m, most) for one in units]
    ways = tuple(way for way in tried if way is not None)
    if readings is not None and not ways:
        _refuse_few(readings, columns)
    further = _further(scenario, today, point)
    return Design(scenario, at, x, criterion, candidates, today, worst, ways, further, lost)


def covariance_of(scenario: Scenario, candidates: Measurement) -> Covariance:
    """Returns R of candidates: as today's readings of these labels have it, else as new ones
    would."""
    places = {label: place for place, label in enumerate(_labels(scenario.measurement))}
    rows = [places.get(label) for label in _labels(candidates)]
    known = [row for row in rows if row is not None]
    if len(known) < len(rows):
        return scenario.noise.covariance(candidates.m)
    return scenario.problem.R.restricted(np.array(known))


def _labels(model: Measurement) -> Iterator[tuple[Any, int]]:
    """Yields the labels of readings, each with the number of those before that have the same."""
    before: Counter[Any] = Counter()
    for label in zip(*model.index.values(), strict=True):
        yield label, before[label]
        before[label] += 1


def _point(model: Measurement, at: Mapping[str, float] | None) -> Array:
    """Returns the start x (1, n) of a model, or x of the estimates `at` by name."""
    if at is None:
        x = model.nominal[None]
        remedy = "give another start, or the estimate of readings by at=FOLDER"
    else:
        names = [p.name for p in model.physical_parameters]
        lacking = [name for name in names if name not in at]
        if lacking:
            raise UserError(f"at: has no estimate of {', '.join(lacking)}")
        x = model.inner(np.array([[at[name] for name in names]]))
        remedy = "give an estimate of this model"
    with np.errstate(all="ignore"):
        there = np.isfinite(x).all() and np.isfinite(model.jacobian(x)).all()
    if not there:
        where = "the start" if at is None else "the estimate"
        raise UserError(
            f"at: {model.name} has no finite readings with finite slopes at {where}; {remedy}"
        )
    return x


def _worst_suspects(
    model: Measurement, R: Covariance, errors: Sequence[Measurement], x: Array
) -> tuple[Suspect, ...]:
    """Returns each unmodelled error where it moves a parameter by most bounds, the worst first."""
    found = [one for error in errors for one in suspects(model, R, error, x[:SUSPECTED])]
    worst: dict[str, Suspect] = {}
    for one in sorted(found, key=lambda suspect: -suspect.bounds):
        worst.setdefault(one.name, one)
    return tuple(worst.values())


def _most_readings(model: Measurement, candidates: Measurement, readings: int | None) -> int:
    """Returns the largest number of readings to have, which candidates and parameters allow."""
    if readings is None:
        return model.m
    if readings < model.n:
        raise UserError(
            f"readings={readings}: {model.n} parameters need at least {model.n} readings"
        )
    if readings > candidates.m:
        remedy = "make room for more with its options (`ipe-bench list measurement -v`)"
        if len(model.inputs) == 1:
            remedy = "remove the key: the answer says which two to read next"
        raise UserError(
            f"readings={readings}: {model.name} has {candidates.m} readings to choose among; give"
            f" at most {candidates.m}, or {remedy}"
        )
    return readings


def _refuse_few(readings: int, columns: Sequence[tuple[str, ...]]) -> NoReturn:
    titles = " or ".join("by " + " and ".join(chosen) for chosen in columns)
    raise UserError(
        f"readings={readings}: choices {titles} of so few do not determine all parameters, or there"
        f" are fewer than {_FEW} to choose among; give more readings, or choose by other columns"
    )


def _further(scenario: Scenario, today: Observability, point: Array) -> Further | None:
    """Finds the readings that cut the mean square of the bounds at the point (1, n), as shares of
    today's, most."""
    if not today.observable:
        return None
    try:
        model, column, words = _candidates(scenario.measurement)
        R = scenario.noise.covariance(model.m)
    except UserError:  # of inputs that the model refuses, or of readings without a deviation
        return None
    if model is scenario.measurement:
        return None
    J = R.whiten_jacobian(model.jacobian(point))[0]
    there = np.flatnonzero(np.isfinite(J).all(axis=1))
    if not len(there):
        return None
    J = J[there]
    P = today.covariance[0]
    before = np.diagonal(P)
    alone = np.empty(0)
    taken: list[int] = []
    bounds = [today.bound]
    for _ in range(MOST_MORE):
        # A reading with the whitened slope a takes P a a' P / (1 + a' P a) from P (Sherman and
        # Morrison), and leaves these variances (g, n).
        Pa = np.matmul(J, P)
        scale = 1 + np.sum(Pa * J, axis=1)
        left = np.diagonal(P) - Pa**2 / scale[:, None]
        if not taken:
            alone = np.sqrt(left)
        best = int(np.argmin((left / before).mean(axis=1)))
        taken.append(best)
        bounds.append(np.sqrt(left[best]))
        P = P - np.outer(Pa[best], Pa[best]) / scale[best]
    entries = np.asarray(model.index[column], dtype=float)[there] if column else np.empty(0)
    told = tuple(words[i] for i in there)
    return Further(told, column, entries, alone, tuple(taken), np.array(bounds))


def _candidates(model: Measurement) -> tuple[Measurement, str, list[str]]:
    """Returns a model of readings that may be taken beside today's, the one column that tells them
    apart, if it is a number, and words for each: inputs over several times their range, else those
    that the model offers."""
    columns = labels(model)
    headings = [one.heading for one in model.inputs]
    varying = [name for name in headings if len(set(columns.get(name, ()))) > 1]
    if len(varying) == 1 and columns.keys() >= {*headings}:
        (name,) = varying
        given = np.asarray(columns[name])
        if np.issubdtype(given.dtype, np.number):
            far = given.min() + _REACH * np.ptp(given)
            grid = [float(f"{at:.2g}") for at in np.linspace(given.min(), far, _GRID)]
            return model.along(name, grid), name, [f"{name} = {at:.4g}" for at in grid]
    offered = model.candidates
    if offered.m == model.m:
        return model, "", []
    words = []
    columns = offered.index
    for row in zip(*columns.values(), strict=True):
        entries = zip(columns, row, strict=True)
        told = [f"{name} {entry_in_words(offered, name, entry)}" for name, entry in entries]
        words.append(", ".join(told))
    return offered, "", words


def _columns(model: Measurement, by: Sequence[str] | None) -> list[tuple[str, ...]]:
    known = tuple(model.index)
    if by is None:
        alone = [(name,) for name in known] if len(known) > 1 else []
        return [*alone, known]
    chosen = []
    for name in by:
        fits = [c for c in known if c == name or c.partition(" [")[0] == name]
        if not fits:
            raise UserError(f"by={name}: {unknown(name, known, 'column')}")
        chosen.append(fits[0])
    return [tuple(c for c in known if c in chosen)]


def _entries(model: Measurement, columns: Sequence[str]) -> list[tuple[Any, ...]]:
    """Returns the entries of each reading (m,) in these columns."""
    return list(zip(*(model.index[c] for c in columns), strict=True)) if columns else [()] * model.m


def _units(
    model: Measurement, candidates: Measurement, by: tuple[str, ...], slopes: Array
) -> Units:
    """Builds the units of the candidates; in all other columns they have what today's readings
    have."""
    others = [c for c in model.index if c not in by]
    as_today = set(_entries(model, others))
    groups: dict[tuple[Any, ...], list[int]] = {}
    entries = zip(_entries(candidates, by), _entries(candidates, others), strict=True)
    for row, (entry, other) in enumerate(entries):
        if other in as_today:
            groups.setdefault(entry, []).append(row)
    had = set(_entries(model, by))
    today = np.array([entry in had for entry in groups])
    rows = tuple(np.array(one, dtype=np.intp) for one in groups.values())
    # The information of each unit in at most n rows, A' A = R' R by QR; shorter units end in zeros.
    truths, _, n = slopes.shape
    r = min(n, max(map(len, rows)))
    units = np.zeros((truths, len(rows), r, n))
    for u, one in enumerate(rows):
        A = slopes[:, one]
        if len(one) > r:
            A = np.asarray(np.linalg.qr(A, mode="r"))
        units[:, u, : A.shape[1]] = A
    return Units(by, tuple(groups), rows, today, units)


@dataclass(frozen=True)
class _Judge:
    """Computes a criterion to be small, over information matrices M (truths, n, n) in units of
    today's bounds: tr M^-1 / n, or -log det M / n, averaged over the truths, with the little that
    is known beforehand."""

    criterion: Criterion
    everything: Array
    """Information of all candidates together (truths, n, n)."""
    today: float = 1.0
    """The mean bound of today's set-up, which others are shares of; 1 if it is infinite."""

    def value(self, M: Array) -> float:
        """Computes the mean bound in units of today's, without what is known beforehand; infinite
        if M is singular."""
        s = np.linalg.eigvalsh(M)
        if (s[:, 0] <= 1e-12 * s[:, -1]).any():
            return float("inf")
        if self.criterion == "D":
            # det M^(-1/2n), the geometric mean of the ellipsoid's semi-axes.
            mean = np.exp(-0.5 * np.log(s).mean())
        else:
            mean = np.sqrt((1 / s).mean())
        return float(mean) / self.today

    def gains(self, M: Array, slopes: Array) -> Array:
        """Computes the fall of the loss with each further unit (units,), where M is the information
        without it."""
        truths, units, r, n = slopes.shape
        P = np.linalg.inv(M + _WEAK * self.everything)
        # With a unit's slopes A: B = A P and K = I + A P A'. The determinant of M grows by that of
        # K, and the trace of P falls by tr(B' K^-1 B) (Woodbury).
        B = np.matmul(slopes.reshape(truths, units * r, n), P).reshape(slopes.shape)
        K = np.eye(r) + np.matmul(B, slopes.swapaxes(-1, -2))
        if self.criterion == "D":
            return np.linalg.slogdet(K)[1].mean(axis=0) / n
        solved = B / K if r == 1 else np.linalg.solve(K, B)
        return np.einsum("turi,turi->u", B, solved) / (truths * n)


def _way(judge: _Judge, units: Units, today: int, most: int) -> Way | None:
    """Finds the two choices by adding the unit that gains most per reading; None if there is no
    choice."""
    if len(units.rows) < _FEW:
        return None
    sizes = np.array([*map(len, units.rows)])
    room = max(today, most)
    taken = np.zeros(len(sizes), dtype=bool)
    free = sizes <= room
    found = []
    while free.any():
        gains = judge.gains(units.information(taken), units.slopes) / sizes
        best = int(np.argmax(np.where(free, gains, -np.inf)))
        taken[best] = True
        found.append(_choice(judge, units, taken))
        free = ~taken & (sizes <= room - sizes[taken].sum())
    found = [choice for choice in found if np.isfinite(choice.mean_bound)]
    within = [choice for choice in found if choice.readings <= most]
    if not within:
        return None
    if sizes[units.today].sum() <= most:
        within.append(_choice(judge, units, units.today))
    sharpest = min(within, key=lambda choice: choice.mean_bound)
    saving = (choice for choice in found if choice.mean_bound <= 1 and choice.readings < today)
    return Way(units, next(saving, None), sharpest)


def _choice(judge: _Judge, units: Units, taken: Mask) -> Choice:
    """Makes the choice of these units (units,)."""
    places = np.flatnonzero(taken).tolist()
    rows = np.sort(np.concatenate([units.rows[u] for u in places], dtype=np.intp))
    return Choice(tuple(places), tuple(rows.tolist()), judge.value(units.information(taken)))


def entry_in_words(model: Measurement, column: str, entry: Any) -> str:
    """Words an entry of the index by what it stands for, if the model has words for it."""
    words = model.entry_words.get(column, {})
    shown = value_text(entry)
    return f"{shown} ({words[entry]})" if entry in words else shown
