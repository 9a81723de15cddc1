"""What to measure next: which of the readings that a model could take to add, to drop, or to take instead.

Designs are optimal on average over truths from the prior (Chaloner and Larntz, J. Stat. Plan. Inference 21, 1989), by
exchange (Mitchell, Technometrics 16, 1974), and come with a bound below which no choice of so many readings can go.
What readings say about each parameter is in `observability`; pictures and words are left to the report.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.errors import UserError, unknown
from ipe_bench.basics.linalg import Array
from ipe_bench.measurements.base import Measurement
from ipe_bench.trials.observability import TRUTHS, Observability, Suspect, suspects, truths_of
from ipe_bench.trials.scenario import Scenario
from ipe_bench.trials.weiss_weinstein import Threshold, threshold

Criterion = Literal["A", "D"]
"""A: the mean over parameters and truths of the squared bound. D: the volume of its ellipsoid."""
SUSPECTED = 5
"""Truths at which unmodelled errors are tried: each takes two simulations of each of them."""
_POINTS = 16
"""Numbers of readings on a curve."""
_ROUNDS = 200
"""Exchanges, and steps towards the bound on what any design can reach, at most."""
_CLOSE = 2e-3
"""A bound on designs that is this near to the best one is near enough."""
_WEAK = 1e-8
"""What every choice is taken to know beforehand, as a share of what all candidates together say: the first readings
chosen do not determine the parameters by themselves."""
_FEW = 3
"""With fewer units there is nothing to choose that the effects of adding and dropping do not say."""
_REACH = 1.25
"""How far a curve goes on beyond today's number of readings."""

Rows = NDArray[np.intp]


@dataclass(frozen=True)
class Units:
    """What is taken or left as a whole: the readings with equal entries in the columns `by`."""

    by: tuple[str, ...]
    entries: tuple[tuple[Any, ...], ...]
    """What a unit's readings have in those columns."""
    rows: tuple[Rows, ...]
    """The rows of the candidates' z."""
    today: NDArray[np.bool_]
    """Which units today's set-up has (units,)."""
    slopes: Array
    """(truths, units, r, n): whitened, in units of today's bounds; r rows say what all readings of the unit say."""

    @cached_property
    def sizes(self) -> Array:
        return np.array([float(len(rows)) for rows in self.rows])

    def information(self, weights: Array) -> Array:
        """(truths, n, n) of units taken with these weights (units,)."""
        taken = np.flatnonzero(weights)
        A = self.slopes[:, taken]
        return np.einsum("turi,turj,u->tij", A, A, weights[taken], optimize=True)


@dataclass(frozen=True)
class Choice:
    """Some of the units, and what estimates of their readings would be worth."""

    taken: tuple[int, ...]
    """The units, by their place."""
    rows: tuple[int, ...]
    """The rows of the candidates' z, ascending."""
    mean_bound: float
    """The bound as a share of today's, over parameters and truths: the root of the mean square (A), or the geometric
    mean along the ellipsoid's axes (D). Infinite where the readings leave a direction open."""
    least: float = 0.0
    """No choice of so many readings among the candidates has a mean bound below this."""

    @property
    def readings(self) -> int:
        return len(self.rows)


@dataclass(frozen=True)
class Way:
    """One way to choose: by case, by time, or reading by reading; all else as today."""

    units: Units
    curve: tuple[Choice, ...]
    """The best choice found at each of some numbers of readings, ascending."""
    saving: Choice | None
    """The fewest readings whose mean bound is not above today's; None where that takes as many as today."""
    sharpest: Choice
    """The smallest mean bound with no more readings than today."""

    @property
    def title(self) -> str:
        return "by " + " and ".join(self.units.by)


@dataclass(frozen=True)
class Effect:
    """What adding or dropping everything with one entry in one column would do."""

    column: str
    entry: Any
    action: Literal["add", "drop"]
    readings: int
    """Readings afterwards."""
    mean_bound: float


@dataclass(frozen=True)
class Design:
    """What a scenario's readings say, and what others would."""

    scenario: Scenario
    criterion: Criterion
    candidates: Measurement
    observability: Observability
    suspects: tuple[Suspect, ...]
    threshold: Threshold | None
    """What no estimator can beat, false roots counted in; None without a prior."""
    ways: tuple[Way, ...]
    effects: tuple[Effect, ...]

    @property
    def best(self) -> Way | None:
        """The way that saves most readings, or else reaches the smallest bound."""
        if not self.ways:
            return None
        most = float("inf")
        return min(self.ways, key=lambda w: (w.saving.readings if w.saving else most, w.sharpest.mean_bound))

    def measurement(self, choice: Choice) -> Measurement:
        """The model that takes these readings and no others."""
        return self.candidates.taking(choice.rows)


def design(
    scenario: Scenario,
    *,
    by: Sequence[str] | None = None,
    readings: int | None = None,
    criterion: Criterion = "A",
    errors: Sequence[Measurement] = (),
    truths: int = TRUTHS,
) -> Design:
    """What the scenario's readings say about its parameters, and which readings would say more.

    `by` names columns of the model's index, whose entries are chosen while all else stays as today; None tries each
    column and then reading by reading. `readings` is the number to have at most, today's where it is None. `errors` are
    richer versions of the model, whose nuisances may look like parameters.

    Raises:
        UserError: noise of an unknown level, or with correlated errors, which do not add up; an unknown column; too few
            readings.
    """
    if scenario.noise.estimated:
        raise UserError(
            f"noise={scenario.noise.name}: without the level of the noise there are no bounds; give the deviation that"
            " you expect, as in noise=gaussian noise.deviation=0.1"
        )
    model, R, x = scenario.measurement, scenario.problem.R, truths_of(scenario, truths)
    today = Observability.at(model, R, x)
    found = [one for error in errors for one in suspects(model, R, error, x[:SUSPECTED])]
    limit = threshold(scenario)
    candidates = model.candidates
    columns = _columns(model, by)
    if R.factor.ndim != 1:
        raise UserError(
            f"noise={scenario.noise.name}: the errors of readings are correlated, so that readings do not add up; a "
            "design wants noise=gaussian or noise=quantization"
        )
    slopes = scenario.noise.covariance(candidates.m).whiten_jacobian(candidates.jacobian(x))
    whole = Observability.at(candidates, scenario.noise.covariance(candidates.m), x)
    if not whole.observable:
        return Design(scenario, criterion, candidates, today, _largest(found), limit, (), ())
    reference = today if today.observable else whole
    slopes = slopes * np.sqrt(np.diagonal(reference.covariance, axis1=1, axis2=2))[:, None, :]
    most = model.m if readings is None else readings
    if most < model.n:
        raise UserError(f"readings={most}: {model.n} parameters want at least as many readings")
    if readings is not None and readings > candidates.m:
        raise UserError(
            f"readings={readings}: {model.name} has {candidates.m} readings to choose among; give at most as many, or"
            " make room for more with its options (`ipe-bench list measurement -v`)"
        )
    judge = _Judge.against(_today_information(model, R, x, reference), slopes, criterion)
    ways = [_way(judge, _units(model, candidates, chosen, slopes), model.m, most) for chosen in columns]
    chosen_ways = tuple(way for way in ways if way is not None)
    if readings is not None and not chosen_ways:
        titles = " or ".join("by " + " and ".join(chosen) for chosen in columns)
        raise UserError(
            f"readings={readings}: no choice {titles} of so few determines all parameters, or there are fewer than"
            f" {_FEW} to choose among; give more readings, or choose by other columns"
        )
    effects = tuple(_effects(judge, model, candidates, slopes)) if today.observable else ()
    return Design(scenario, criterion, candidates, today, _largest(found), limit, chosen_ways, effects)


def _largest(found: Sequence[Suspect]) -> tuple[Suspect, ...]:
    """Each suspect once, as the richest model has it, the largest shift first."""
    worst: dict[str, Suspect] = {}
    for one in sorted(found, key=lambda s: -s.bounds):
        worst.setdefault(one.name, one)
    return tuple(worst.values())


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
    """What each reading (m,) has in these columns."""
    return list(zip(*(model.index[c] for c in columns), strict=True))


def _units(model: Measurement, candidates: Measurement, by: tuple[str, ...], slopes: Array) -> Units:
    """The units of the candidates; in all other columns they have what today's readings have."""
    others = [c for c in model.index if c not in by]
    as_today = set(_entries(model, others)) if others else {()}
    rest = _entries(candidates, others) if others else [()] * candidates.m
    groups: dict[tuple[Any, ...], list[int]] = {}
    for row, (entry, other) in enumerate(zip(_entries(candidates, by), rest, strict=True)):
        if other in as_today:
            groups.setdefault(entry, []).append(row)
    had = set(_entries(model, by))
    rows = tuple(np.array(r, dtype=np.intp) for r in groups.values())
    return Units(by, tuple(groups), rows, np.array([entry in had for entry in groups]), _compressed(slopes, rows))


def _compressed(slopes: Array, rows: Sequence[Rows]) -> Array:
    """(truths, units, r, n) with the information of each unit in at most n rows, by QR; shorter units end in zeros."""
    truths, _, n = slopes.shape
    r = min(n, max(len(one) for one in rows))
    units = np.zeros((truths, len(rows), r, n))
    for u, one in enumerate(rows):
        A = slopes[:, one]
        units[:, u, : min(len(one), r)] = A if len(one) <= r else np.linalg.qr(A, mode="r")
    return units


def _today_information(model: Measurement, R: Any, x: Array, reference: Observability) -> Array:
    J = R.whiten_jacobian(model.jacobian(x)) * np.sqrt(np.diagonal(reference.covariance, axis1=1, axis2=2))[:, None, :]
    return np.matmul(J.swapaxes(1, 2), J)


@dataclass(frozen=True)
class _Judge:
    """A criterion to be small, over information matrices M (truths, n, n) in units of today's bounds."""

    criterion: Criterion
    everything: Array
    """What all candidates together say (truths, n, n)."""
    today: float = 1.0
    """The mean bound of today's set-up, which others are shares of; 1 where it is infinite."""

    @classmethod
    def against(cls, today: Array, slopes: Array, criterion: Criterion) -> _Judge:
        """With what today's readings say (truths, n, n) and the slopes of all candidates (truths, m, n)."""
        judge = cls(criterion, np.matmul(slopes.swapaxes(1, 2), slopes))
        value = judge.value(today)
        return replace(judge, today=value) if np.isfinite(value) else judge

    def loss(self, M: Array) -> float:
        """tr M^-1 / n, or -log det M / n, averaged over the truths, with the little that is known beforehand."""
        M = M + _WEAK * self.everything
        if self.criterion == "D":
            return -float(np.linalg.slogdet(M)[1].mean()) / M.shape[-1]
        return float(np.trace(np.linalg.inv(M), axis1=1, axis2=2).mean()) / M.shape[-1]

    def covariance(self, M: Array) -> Array:
        return np.linalg.inv(M + _WEAK * self.everything)

    def value(self, M: Array) -> float:
        """The mean bound in units of today's, without what is known beforehand; infinite where M is singular."""
        s = np.linalg.eigvalsh(M)
        if (s[:, 0] <= 1e-12 * s[:, -1]).any():
            return float("inf")
        if self.criterion == "D":
            return float(np.exp(-0.5 * np.log(s).mean())) / self.today
        return float(np.sqrt((1 / s).mean())) / self.today

    def as_bound(self, loss: float) -> float:
        """The mean bound in units of today's that belongs to a loss."""
        return float(np.exp(loss / 2) if self.criterion == "D" else np.sqrt(max(loss, 0.0))) / self.today

    def gains(self, P: Array, slopes: Array) -> Array:
        """By how much the loss falls with each further unit (units,), where P is the covariance without it."""
        B, K = self._products(P, slopes)
        K = np.eye(K.shape[-1]) + K
        if self.criterion == "D":
            return _log_det(K)[1].mean(axis=0) / P.shape[-1]
        return np.einsum("turi,turi->u", B, _solved(K, B)) / (P.shape[0] * P.shape[-1])

    def losses(self, P: Array, slopes: Array) -> Array:
        """By how much the loss rises without each unit (units,), where P is the covariance with it."""
        B, K = self._products(P, slopes)
        K = np.eye(K.shape[-1]) - K
        sign, log = _log_det(K)
        lost = (sign <= 0).any(axis=0) | (log < np.log(_WEAK)).any(axis=0)
        if self.criterion == "D":
            return np.where(lost, np.inf, -log.mean(axis=0) / P.shape[-1])
        safe = np.where(lost[None, :, None, None], np.eye(K.shape[-1]), K)
        rise = np.einsum("turi,turi->u", B, _solved(safe, B)) / (P.shape[0] * P.shape[-1])
        return np.where(lost, np.inf, rise)

    def slopes(self, P: Array, slopes: Array) -> Array:
        """By how much the loss falls with a little more of each unit (units,): the directional derivatives."""
        B = _times(slopes, P)
        other = slopes if self.criterion == "D" else B
        return np.einsum("turi,turi->u", B, other) / (P.shape[0] * P.shape[-1])

    def _products(self, P: Array, slopes: Array) -> tuple[Array, Array]:
        """A P (truths, units, r, n) and A P A' (truths, units, r, r)."""
        B = _times(slopes, P)
        if slopes.shape[2] == 1:
            return B, np.einsum("turi,turi->tu", B, slopes)[:, :, None, None]
        return B, B @ slopes.swapaxes(-1, -2)


def _times(slopes: Array, P: Array) -> Array:
    """A P for each unit, as one product per truth."""
    truths, units, r, n = slopes.shape
    return np.matmul(slopes.reshape(truths, units * r, n), P).reshape(slopes.shape)


def _log_det(K: Array) -> tuple[Array, Array]:
    if K.shape[-1] > 1:
        return np.linalg.slogdet(K)
    k = K[..., 0, 0]
    return np.sign(k), np.log(np.maximum(np.abs(k), np.finfo(float).tiny))


def _solved(K: Array, B: Array) -> Array:
    return B / K if K.shape[-1] == 1 else np.linalg.solve(K, B)


def _way(judge: _Judge, units: Units, today: int, most: int) -> Way | None:
    """The curve and its two choices; None where there is nothing to choose."""
    if len(units.rows) < _FEW:
        return None
    search = _Search(judge, units)
    reach = min(max(int(_REACH * today), most), int(units.sizes.sum()))
    wanted = np.unique(np.round(np.geomspace(units.sizes.min(), reach, _POINTS)).astype(int))
    start = np.zeros(len(units.rows), dtype=bool)
    curve: list[Choice] = []
    for budget in sorted({*wanted.tolist(), min(most, reach)}):
        start = search.improved(search.grown(start, budget), budget)
        choice = search.choice(start)
        if np.isfinite(choice.mean_bound) and (not curve or choice.readings > curve[-1].readings):
            curve.append(choice)
    within = [c for c in curve if c.readings <= most]
    if not within:
        return None
    if units.sizes[units.today].sum() <= most:
        within.append(search.choice(search.improved(units.today, most)))
    sharpest = search.certified(min(within, key=lambda c: c.mean_bound))
    saving = search.fewest(curve, today)
    return Way(units, tuple(curve), saving and search.certified(saving), sharpest)


@dataclass(frozen=True)
class _Search:
    """Looks for good choices among units; a choice is a mask (units,)."""

    judge: _Judge
    units: Units

    def choice(self, taken: NDArray[np.bool_]) -> Choice:
        value = self.judge.value(self.units.information(taken.astype(float)))
        places = np.flatnonzero(taken).tolist()
        rows = np.sort(np.concatenate([self.units.rows[u] for u in places], dtype=np.intp)) if places else ()
        return Choice(tuple(places), tuple(map(int, rows)), value)

    def loss(self, taken: NDArray[np.bool_]) -> float:
        return self.judge.loss(self.units.information(taken.astype(float)))

    def covariance(self, taken: NDArray[np.bool_]) -> Array:
        return self.judge.covariance(self.units.information(taken.astype(float)))

    def grown(self, taken: NDArray[np.bool_], budget: int) -> NDArray[np.bool_]:
        """With units added, the one that gains most per reading first, while they are within the budget."""
        taken = taken.copy()
        room = budget - self.units.sizes[taken].sum()
        while (place := self._best_to_add(taken, room)) is not None:
            taken[place] = True
            room -= self.units.sizes[place]
        return taken

    def _best_to_add(self, taken: NDArray[np.bool_], room: float) -> int | None:
        free = ~taken & (self.units.sizes <= room)
        if not free.any():
            return None
        gains = self.judge.gains(self.covariance(taken), self.units.slopes)
        return int(np.argmax(np.where(free, gains / self.units.sizes, -np.inf)))

    def improved(self, taken: NDArray[np.bool_], budget: int) -> NDArray[np.bool_]:
        """After exchanges: the best unit is added, then the least valuable ones go until the budget holds again."""
        best, loss = taken, self.loss(taken)
        for _ in range(_ROUNDS):
            trial = best.copy()
            place = self._best_to_add(trial, np.inf)
            if place is None:
                return best
            trial[place] = True
            while self.units.sizes[trial].sum() > budget:
                trial[self._least(trial)] = False
            new = self.loss(trial)
            if not new < loss - 1e-9 * abs(loss):
                return best
            best, loss = trial, new
        return best

    def _least(self, taken: NDArray[np.bool_]) -> int:
        """The unit whose loss hurts least per reading."""
        there = np.flatnonzero(taken)
        losses = self.judge.losses(self.covariance(taken), self.units.slopes[:, there])
        return int(there[np.argmin(losses / self.units.sizes[there])])

    def fewest(self, curve: Sequence[Choice], today: int) -> Choice | None:
        """The smallest choice that is as good as today's set-up, found by bisection between points of the curve."""
        good = next((c for c in curve if c.mean_bound <= 1 and c.readings < today), None)
        if good is None:
            return None
        below = max((c.readings for c in curve if c.readings < good.readings), default=0)
        step = int(self.units.sizes.min())
        while good.readings - below > step:
            middle = (good.readings + below) // 2
            taken = np.isin(np.arange(len(self.units.rows)), good.taken)
            while self.units.sizes[taken].sum() > middle:
                taken[self._least(taken)] = False
            choice = self.choice(self.improved(taken, middle))
            if choice.mean_bound <= 1:
                good = choice
            else:
                below = middle
        return good

    def certified(self, choice: Choice) -> Choice:
        """The choice with a bound on all choices of so many readings.

        Weights between 0 and 1 in place of taken or left make the problem convex, so that its gradient anywhere bounds
        it from below; steps of Frank and Wolfe (Naval Research Logistics Quarterly 3, 1956) raise that bound. What is
        known beforehand is counted in, which can only lower it.
        """
        w = np.isin(np.arange(len(self.units.rows)), choice.taken).astype(float)
        least = -np.inf
        for _ in range(_ROUNDS):
            M = self.units.information(w)
            loss = self.judge.loss(M)
            fall = self.judge.slopes(self.judge.covariance(M), self.units.slopes)
            vertex = self._most(fall, choice.readings)
            gap = float(fall @ (vertex - w))
            least = max(least, loss - gap)
            if self.judge.as_bound(least) >= (1 - _CLOSE) * self.judge.as_bound(loss):
                break
            w = self._along(w, vertex, M)
        return replace(choice, least=min(self.judge.as_bound(least), choice.mean_bound))

    def _most(self, values: Array, budget: int) -> Array:
        """Weights (units,) from 0 to 1 of at most so many readings with the largest sum of values."""
        weights, room = np.zeros(len(values)), float(budget)
        for u in np.argsort(-values / self.units.sizes, kind="stable"):
            weights[u] = min(1.0, room / self.units.sizes[u])
            room -= weights[u] * self.units.sizes[u]
            if room <= 0:
                break
        return weights

    def _along(self, w: Array, vertex: Array, M: Array) -> Array:
        """The best point between the two, by golden section: the loss is convex along the line."""
        end = self.units.information(vertex)
        low, high, ratio = 0.0, 1.0, (np.sqrt(5) - 1) / 2
        for _ in range(20):
            a, b = high - ratio * (high - low), low + ratio * (high - low)
            if self.judge.loss((1 - a) * M + a * end) < self.judge.loss((1 - b) * M + b * end):
                high = b
            else:
                low = a
        step = (low + high) / 2
        return (1 - step) * w + step * vertex


def _effects(judge: _Judge, model: Measurement, candidates: Measurement, slopes: Array) -> Iterator[Effect]:
    """What it does to add or to drop everything with one entry in one column, all else as today."""
    for column in model.index:
        units = _units(model, candidates, (column,), slopes)
        for u, (entry, had) in enumerate(zip(units.entries, units.today, strict=True)):
            taken = units.today.copy()
            taken[u] = not had
            value = judge.value(units.information(taken.astype(float))) if taken.any() else float("inf")
            yield Effect(column, entry[0], "drop" if had else "add", int(units.sizes[taken].sum()), value)


def levels_of(model: Measurement, column: str, entry: Any) -> str:
    """An entry of the index with what it stands for, where the model has words for it."""
    words: Mapping[Any, str] = model.levels.get(column, {})
    return f"{entry} ({words[entry]})" if entry in words else str(entry)
