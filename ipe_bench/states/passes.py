"""Runs the steps of filters and smoothers along a model's epochs: recorded together with f and h,
or, where these are not recorded or too long, epoch by epoch, with their values and slopes given as
numbers.

A trial that breaks down is NaN from then on and disturbs no other.
"""

from __future__ import annotations

import functools
import hashlib
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from ipe_bench.basics.linalg import Array, multiply
from ipe_bench.engine import compiled
from ipe_bench.engine.rows import RowFunction
from ipe_bench.engine.scan import Step, gram
from ipe_bench.engine.trace import Graph, Program, RowPrograms
from ipe_bench.states.algebra import factor, half, triangular
from ipe_bench.states.along import Recording
from ipe_bench.states.base import Kept, Normal, StateModel
from ipe_bench.states.linearisation import Linearised, Rule, SigmaPoints, Taylor
from ipe_bench.states.steps import (
    Law,
    Linear,
    Regression,
    Rows,
    Smoothed,
    State,
    Tangent,
    Update,
    Vector,
    beside,
    dot,
    near,
    predicted,
    scores,
    unit,
    updated,
    zeros,
)

_MOST_OPERATIONS = 20_000
"""Operations of f and h in a step at most: they take two to four seconds to compile, once per
machine."""
_NUMBERS = 4e6
"""Numbers of passes that are held at once."""
_LANES = 8
"""Trials at least that are held at once: machine code takes no more time for them than for one."""
_FILES = [Path(__file__), Path(__file__).with_name("steps.py")]


_Places: TypeAlias = "tuple[tuple[bool, ...], ...]"


class Kind(NamedTuple):
    """Says what a pass does."""

    rule: Rule
    iterations: int = 1
    smooths: bool = False
    """Whether a pass back follows."""
    about: bool = False
    """Whether f and h are linearised about the states of a path."""


class Route(NamedTuple):
    """Holds states, from before the first transition, about which functions are linearised."""

    mean: Array
    """(trials, 1 + K, n)"""
    root: Array
    """Triangular roots of their covariances (trials, 1 + K, n (n + 1) / 2)."""


class Layout:
    """Says where parts of a row of numbers lie."""

    def __init__(self, **sizes: int) -> None:
        ends = [*accumulate(sizes.values(), initial=0)]
        self.size = ends[-1]
        self.at = {name: slice(*at) for name, at in zip(sizes, pairwise(ends), strict=True)}

    def part(self, rows: Array, name: str, *shape: int) -> Array:
        part = rows[..., self.at[name]]
        return np.ascontiguousarray(part.reshape(*part.shape[:-1], *shape) if shape else part)

    def split(self, numbers: Sequence[Any]) -> dict[str, Sequence[Any]]:
        return {name: numbers[at] for name, at in self.at.items()}


@dataclass(frozen=True)
class Sizes:
    """Lays out what the steps of n states and m readings take and give."""

    n: int
    m: int
    smooths: bool

    @property
    def half(self) -> int:
        return self.n * (self.n + 1) // 2

    @cached_property
    def carried(self) -> Layout:
        return Layout(x=self.n, F=self.half, log_likelihood=1, doubt=1)

    @cached_property
    def told(self) -> Layout:
        """What a step back takes of an epoch."""
        n = self.n
        update = {"X": n * self.m, "Y": n * n, "Z": self.half}
        return Layout(x=n, F=self.half, e=self.m, **update, moved=n * n, noise=self.half)

    @cached_property
    def shown(self) -> Layout:
        n = self.n
        parts = {name: at.stop - at.start for name, at in self.told.at.items()}
        if not self.smooths:
            parts = {name: parts[name] for name in ("x", "F", "e")}
        return Layout(**parts, nis=1, predicted=self.m, deviation=self.m, covariance=n * n)

    @cached_property
    def back(self) -> Layout:
        return Layout(x=self.n, F=self.half, covariance=self.n * self.n)


def triangle(numbers: Sequence[Any], n: int) -> Rows:
    """Returns the triangular matrix of its n (n + 1) / 2 numbers."""
    rest = iter(numbers)
    return [[next(rest) if j <= i else 0.0 for j in range(n)] for i in range(n)]


def matrix(numbers: Sequence[Any], rows: int) -> Rows:
    columns = len(numbers) // rows
    return [list(numbers[i * columns : (i + 1) * columns]) for i in range(rows)]


def flat(F: Rows) -> Vector:
    """Lists the numbers of a triangular matrix."""
    return [a for i, row in enumerate(F) for a in row[: i + 1]]


def listed(A: Rows) -> Vector:
    return [a for row in A for a in row]


def packed(F: Array) -> Array:
    """Returns the numbers (..., n (n + 1) / 2) of triangular matrices F (..., n, n)."""
    return F[(..., *_triangle(F.shape[-1]))]


def unpacked(numbers: Array, n: int) -> Array:
    F = np.zeros((*numbers.shape[:-1], n, n))
    F[(..., *_triangle(n))] = numbers
    return F


@functools.cache
def _triangle(n: int) -> tuple[Array, Array]:
    return np.tril_indices(n)


def roots(P: Array) -> Array:
    """Returns triangular roots (trials, n (n + 1) / 2) of covariances P (trials, n, n)."""
    return packed(triangular(P))


class _Recorded(NamedTuple):
    """Stands for f or h of an epoch as it is recorded."""

    programs: RowPrograms
    c: Vector
    """Numbers of the epoch."""
    periods: Sequence[float]

    def __call__(self, x: Vector) -> Vector:
        return self.programs.values([*x, *self.c])[: self.programs.m]

    def slopes(self, x: Vector) -> tuple[Vector, Rows]:
        m = self.programs.m
        found = self.programs.values([*x, *self.c])
        columns = [self.programs.tangents([*u, *found[m:]]) for u in unit(self.programs.n)]
        return found[:m], [list(row) for row in zip(*columns, strict=True)]


def law_of(rule: Rule, n: int) -> Law | None:
    """Returns a rule in lists, if it has such a form."""
    if type(rule) is Taylor:
        return Tangent()
    if isinstance(rule, SigmaPoints) and type(rule).linearised is SigmaPoints.linearised:
        return Regression(*(part.tolist() for part in rule.weighted(n)))
    return None


@dataclass(frozen=True)
class _Form:
    """Describes the machine code of a step, as far as it depends on a model."""

    kind: Kind
    sizes: Sizes
    f: RowPrograms | None
    """None where the states stand still."""
    h: RowPrograms
    state_periods: tuple[float, ...]
    periods: tuple[float, ...]
    G: _Places
    """Which numbers of G are not 0 at every epoch."""
    R: _Places
    """Those of a root of R likewise."""

    @classmethod
    def of(
        cls,
        model: StateModel,
        kind: Kind,
        f: RowPrograms | None,
        h: RowPrograms,
        G: Array,
        R: Array,
    ) -> _Form:
        sizes = Sizes(model.n, model.readings_per_epoch, kind.smooths)
        of_states = tuple(model.state_periods) or (0.0,) * sizes.n
        periods = tuple(model.periods) or (0.0,) * sizes.m
        gains, noise = (tuple(map(tuple, places.tolist())) for places in (G, R))
        return cls(kind, sizes, f, h, of_states, periods, gains, noise)

    @cached_property
    def each(self) -> Layout:
        """Lays out the numbers of a trial and epoch."""
        n = self.sizes.n
        if not self.kind.about:
            return Layout(z=self.sizes.m)
        half = self.sizes.half
        return Layout(z=self.sizes.m, before=n, root=half, here=n, root_here=half)

    @cached_property
    def shared(self) -> Layout:
        """Lays out the numbers of an epoch."""
        of_f = 0 if self.f is None else self.f.values.inputs - self.sizes.n
        of_h = self.h.values.inputs - self.sizes.n
        return Layout(f=of_f, h=of_h, G=_count(self.G), R=_count(self.R))

    def record(self) -> Program:
        sizes = self.sizes
        n = sizes.n
        graph = Graph()
        unknowns = {}
        inputs = []
        for kind in (sizes.carried, self.each, self.shared):
            given = graph.inputs(f"{len(unknowns)} ", kind.size)
            unknowns |= kind.split(given)
            inputs += given
        law = law_of(self.kind.rule, n)
        assert law is not None
        state = State([*unknowns["x"]], triangle(unknowns["F"], n))
        before = here = None
        if self.kind.about:
            before = State([*unknowns["before"]], triangle(unknowns["root"], n))
            here = State([*unknowns["here"]], triangle(unknowns["root_here"], n))
        moved = None
        smooths = self.kind.smooths
        if self.f is not None:
            f = _Recorded(self.f, [*unknowns["f"]], self.state_periods)
            G = _filled(self.G, unknowns["G"])
            linear = law(f, state, before or state)
            state, moved = predicted(linear, law.noise(G, linear), smooths)
            if here is not None:
                state = State(near(state.x, here.x, self.state_periods), state.F)
        h = _Recorded(self.h, [*unknowns["h"]], self.periods)
        R = _filled(self.R, unknowns["R"])
        z = [*unknowns["z"]]
        linear = law(h, state, here or state)
        found = updated(state, linear, law.noise(R, linear), z, self.periods, smooths)
        for _ in range(1, self.kind.iterations):
            linear = law(h, state, found.state)
            found = updated(state, linear, law.noise(R, linear), z, self.periods, smooths)
        if self.kind.about and isinstance(law, Regression):
            # Slopes by points about a path that is nearly known may be round-off themselves.
            found = found._replace(doubt=0.0)
        return _program(graph, _outputs(sizes, unknowns, z, found, moved), inputs)

    def step(self) -> Step:
        each = self.each.size
        shown = self.sizes.shown.size
        return _made(self, self.sizes.carried.size, each, each, self.shared.size, shown)


@dataclass(frozen=True)
class _Back:
    """Describes the machine code of a step back."""

    sizes: Sizes

    def record(self) -> Program:
        n = self.sizes.n
        graph = Graph()
        given = graph.inputs("u ", n), graph.inputs("S ", self.sizes.half)
        told = graph.inputs("told ", self.sizes.told.size)
        parts = self.sizes.told.split(told)
        after = Smoothed([*given[0]], triangle(given[1], n))
        state = after.of(State([*parts["x"]], triangle(parts["F"], n)))
        read = beside(matrix(parts["X"], n), matrix(parts["Y"], n), triangle(parts["Z"], n))
        moved = beside(matrix(parts["moved"], n), triangle(parts["noise"], n))
        before = after.before([*parts["e"]], read, moved)
        shown = [*state.x, *flat(state.F), *listed(gram(state.F))]
        outputs = [*before.u, *flat(before.S), *shown]
        return _program(graph, outputs, [*given[0], *given[1], *told])

    def step(self) -> Step:
        sizes = self.sizes
        carried = sizes.n + sizes.half
        shown = sizes.back.size
        return _made(self, carried, sizes.told.size, sizes.shown.size, 0, shown)


@dataclass(frozen=True)
class _Move:
    """Describes the machine code of a transition whose linear form is given."""

    sizes: Sizes
    columns: int
    """Of a root of its noise."""

    @cached_property
    def each(self) -> Layout:
        n = self.sizes.n
        return Layout(y=n, AF=n * n, N=n * self.columns)

    def record(self) -> Program:
        sizes = self.sizes
        n = sizes.n
        graph = Graph()
        carried = graph.inputs("carried ", sizes.carried.size)
        given = graph.inputs("given ", self.each.size)
        parts = sizes.carried.split(carried) | self.each.split(given)
        linear = Linear([*parts["y"]], matrix(parts["AF"], n), [], [])
        state, moved = predicted(linear, matrix(parts["N"], n), sizes.smooths)
        outputs = [*state.x, *flat(state.F), *parts["log_likelihood"], *parts["doubt"]]
        shown = _told_of_move(moved, n) if sizes.smooths else []
        return _program(graph, [*outputs, *shown], [*carried, *given])

    def step(self) -> Step:
        each = self.each.size
        shown = self.sizes.told.size - self.sizes.told.at["moved"].start
        shown *= self.sizes.smooths
        return _made(self, self.sizes.carried.size, each, each, 0, shown)


@dataclass(frozen=True)
class _Read:
    """Describes the machine code of an update whose linear form is given."""

    sizes: Sizes
    columns: int
    """Of a root of its noise."""

    @cached_property
    def each(self) -> Layout:
        n = self.sizes.n
        m = self.sizes.m
        return Layout(z=m, y=m, HF=m * n, M=m * self.columns, H=m * n)

    def record(self) -> Program:
        sizes = self.sizes
        m = sizes.m
        graph = Graph()
        carried = graph.inputs("carried ", sizes.carried.size)
        given = graph.inputs("given ", self.each.size)
        parts = sizes.carried.split(carried) | self.each.split(given)
        state = State([*parts["x"]], triangle(parts["F"], sizes.n))
        linear = Linear([*parts["y"]], matrix(parts["HF"], m), [], matrix(parts["H"], m))
        z = [*parts["z"]]
        found = updated(state, linear, matrix(parts["M"], m), z, (), sizes.smooths)
        outputs = _outputs(sizes, parts, z, found, None)
        return _program(graph, outputs, [*carried, *given])

    def step(self) -> Step:
        each = self.each.size
        return _made(self, self.sizes.carried.size, each, each, 0, self.sizes.shown.size)


def _count(places: _Places) -> int:
    return sum(map(sum, places))


def _filled(places: _Places, numbers: Sequence[Any]) -> Rows:
    """Returns a matrix with numbers at these places, and 0 elsewhere."""
    rest = iter(numbers)
    return [[next(rest) if there else 0.0 for there in row] for row in places]


def _made(
    form: _Form | _Back | _Move | _Read,
    carried: int,
    each: int,
    stride: int,
    shared: int,
    shown: int,
) -> Step:
    """Returns the step of a form, which is recorded only if its machine code is not kept."""
    digests = [compiled.digest_of(file) for file in _FILES]
    key = hashlib.sha256(repr((form, digests)).encode()).hexdigest()
    return Step(key, form.record, carried, each, stride, shared, shown)


def _program(graph: Graph, outputs: Sequence[Any], inputs: Sequence[Any]) -> Program:
    # What is a number, or an input itself, becomes an expression.
    return Program.of([graph.apply("add", a, 0.0) for a in outputs], inputs)


def _outputs(
    sizes: Sizes, carried: Mapping[str, Any], z: Vector, found: Update, moved: Rows | None
) -> list[Any]:
    """Lists what a step carries on and shows."""
    n = sizes.n
    m = sizes.m
    state, e, L, doubt, read = found
    nis, log_likelihood = scores(e, L)
    now = [*state.x, *flat(state.F)]
    log_likelihood = carried["log_likelihood"][0] + log_likelihood
    doubt = np.maximum(carried["doubt"][0], doubt)
    shown = [*now, *e]
    if sizes.smooths:
        X, Y, Z = ([row[a:b] for row in read] for a, b in ((0, m), (m, m + n), (m + n, m + 2 * n)))
        shown += [*listed(X), *listed(Y), *flat(Z), *_told_of_move(moved, n)]
    told = [a - dot(row, e) for a, row in zip(z, L, strict=True)]
    deviations = [np.sqrt(dot(row, row)) for row in L]
    return [
        *(*now, log_likelihood, doubt),
        *(*shown, nis, *told, *deviations, *listed(gram(state.F))),
    ]


def _told_of_move(moved: Rows | None, n: int) -> Vector:
    """Lists what a transition tells a smoother; without one the noise stays what it was."""
    if moved is None:
        moved = beside(unit(n), zeros(n, n))
    return [*listed([row[:n] for row in moved]), *flat([row[n:] for row in moved])]


class Passed(NamedTuple):
    """Holds what passes along the epochs of some trials found."""

    shown: Array
    """(trials, 1 + K, s), the prior in front."""
    carried: Array
    """(trials, c) of the last epoch."""
    back: Array | None
    """(trials, 1 + K, b)"""


class Passes(ABC):
    """Passes along a model's epochs, there and back."""

    def __init__(self, model: StateModel, kind: Kind) -> None:
        self.model = model
        self.functions = model.epoch_functions
        self.kind = kind
        self.sizes = Sizes(model.n, model.readings_per_epoch, kind.smooths)
        m, P = model.prior
        self.start = m, roots(P[None])[0]

    @abstractmethod
    def there(self, z: Array, route: Route | None, carry: Array, shown: Array) -> None:
        """Advances carry (trials, c) along readings z (trials, 1 + K, m), of which the first are
        none, and fills what is shown (trials, 1 + K, s)."""

    @property
    def at_once(self) -> int:
        """Trials that are run together at most."""
        numbers = (1 + self.model.epochs) * (self.sizes.shown.size + self.sizes.back.size)
        return max(_LANES, int(_NUMBERS / numbers))

    @cached_property
    def _back(self) -> Step:
        return _Back(self.sizes).step()

    def run(self, z: Array, route: Route | None, start: Normal | None) -> Passed:
        """Passes along readings z (trials, K, m) from the prior, or from other starts."""
        sizes = self.sizes
        trials, K, _ = z.shape
        mean, root = self.start if start is None else (start.mean, roots(start.covariance))
        carry = np.zeros((trials, sizes.carried.size))
        carry[:, sizes.carried.at["x"]] = mean
        carry[:, sizes.carried.at["F"]] = root
        shown = np.empty((trials, 1 + K, sizes.shown.size))
        shown[:, 0] = 0.0
        shown[:, 0, : sizes.n + sizes.half] = carry[:, : sizes.n + sizes.half]
        padded = np.empty((trials, 1 + K, z.shape[2]))
        padded[:, 0] = np.nan
        padded[:, 1:] = z
        self.there(padded, route, carry, shown)
        if not self.kind.smooths:
            return Passed(shown, carry, None)
        # After the last epoch nothing is read: u = 0 and S = I.
        after = np.zeros((trials, sizes.n + sizes.half))
        after[:, sizes.n :] = packed(np.eye(sizes.n))
        back = np.empty((trials, 1 + K, sizes.back.size))
        self._back.run(after, shown, _NONE, back, K, -1, 1 + K)
        return Passed(shown, carry, back)


_NONE = np.empty((0, 0))


class _Together(Passes):
    """Passes whose steps are recorded together with f and h."""

    def __init__(self, model: StateModel, kind: Kind) -> None:
        super().__init__(model, kind)
        K = model.epochs
        moving = [k for k in range(K) if model.moves(k)]
        gains = {k: model.gain(k) for k in moving}
        noise = {k: factor(model.R(k)) for k in range(K)}
        none = np.zeros((model.n, 0), dtype=bool)
        G: Array = np.any([A != 0 for A in gains.values()], axis=0) if moving else none
        R: Array = np.any([A != 0 for A in noise.values()], axis=0)
        self.runs: list[_Run] = []
        made: dict[tuple[int, int], tuple[_Form, Step, Array]] = {}
        for k in range(K):
            f = self.functions[0].at[k] if k in gains else None
            h = self.functions[1].at[k]
            moved = None if f is None else _programs(f)
            read = _programs(h)
            key = id(moved), id(read)
            if key not in made:
                form = _Form.of(model, kind, moved, read, G, R)
                made[key] = form, form.step(), np.zeros((1 + K, form.shared.size))
            form, step, shared = made[key]
            values = {"h": h.numbers[0], "R": noise[k][R]}
            if f is not None:
                values |= {"f": f.numbers[0], "G": gains[k][G]}
            for name, numbers in values.items():
                shared[1 + k, form.shared.at[name]] = numbers
            if self.runs and self.runs[-1].step is step:
                self.runs[-1] = self.runs[-1]._replace(count=self.runs[-1].count + 1)
            else:
                self.runs.append(_Run(step, shared, 1 + k, 1))

    def there(self, z: Array, route: Route | None, carry: Array, shown: Array) -> None:
        each = z
        if route is not None:
            before = np.concatenate([route.mean, route.root], axis=2)
            each = np.concatenate([z, np.roll(before, 1, axis=1), before], axis=2)
        for step, shared, first, count in self.runs:
            step.run(carry, each, shared, shown, first, 1, count)


def _programs(recording: Recording) -> RowPrograms:
    assert isinstance(recording.function, RowFunction)
    return recording.function.programs


class _Run(NamedTuple):
    """Holds epochs, one after another, of the same step."""

    step: Step
    shared: Array
    """(1 + K, p)"""
    first: int
    count: int


class _States(NamedTuple):
    """Holds N(x, F F') of each trial."""

    x: Array
    """(trials, n)"""
    F: Array
    """(trials, n, n)"""


class _ByEpoch(Passes):
    """Passes whose functions are called epoch by epoch, and linearised by the rule in NumPy."""

    def __init__(self, model: StateModel, kind: Kind) -> None:
        super().__init__(model, kind)
        self._steps: dict[tuple[type, int], Step] = {}

    def _step(self, form: type[_Move | _Read], columns: int) -> Step:
        if (form, columns) not in self._steps:
            self._steps[form, columns] = form(self.sizes, columns).step()
        return self._steps[form, columns]

    def there(self, z: Array, route: Route | None, carry: Array, shown: Array) -> None:
        told = self.sizes.told
        still = 0.0
        if self.kind.smooths:
            still = np.concatenate([np.eye(self.sizes.n).ravel(), np.zeros(self.sizes.half)])
        for k in range(self.model.epochs):
            moved = still
            if self.model.moves(k):
                at = None if route is None else self._state(route.mean[:, k], route.root[:, k])
                to = None if route is None else route.mean[:, k + 1]
                moved = self._moved(k, carry, at, to)
            at = None if route is None else self._state(route.mean[:, k + 1], route.root[:, k + 1])
            self._read(k, z[:, k + 1], carry, at, shown[:, k + 1])
            if self.kind.smooths:
                shown[:, k + 1, told.at["moved"].start : told.size] = moved

    def _state(self, mean: Array, root: Array) -> _States:
        return _States(mean, unpacked(root, self.sizes.n))

    def _carried(self, carry: Array) -> _States:
        at = self.sizes.carried.at
        return self._state(carry[:, at["x"]].copy(), carry[:, at["F"]])

    def _moved(self, k: int, carry: Array, at: _States | None, to: Array | None) -> Array:
        """Advances what is carried by a transition, and returns what that tells a smoother."""
        model = self.model
        rule = self.kind.rule
        state = self._carried(carry)
        at = at or state
        nearest = model.nearest_state if model.state_periods else None
        law = rule.linearised(model.transition_into(k), at.x, at.F, nearest)
        if model.gain_by_state:
            Q = rule.mean(partial(model.Q_at, k=k), at.x, at.F)
            N = law.noise_root(half(Q).G)
        else:
            N = law.noise_root(model.gain(k))
        y, AF = _at(law, state, at)
        if to is not None:
            y = model.nearest_state(y, to)
        return self._run(_Move, N, carry, [y, AF])[:, 0]

    def _read(self, k: int, z: Array, carry: Array, at: _States | None, shown: Array) -> None:
        """Takes in readings z (trials, m), and fills what is shown (trials, s)."""
        model = self.model
        rule = self.kind.rule
        state = self._carried(carry)
        at = at or state
        nearest = model.nearest if model.periods else None
        begun = carry.copy()
        for _ in range(self.kind.iterations):
            law = rule.linearised(model.observation_at(k), at.x, at.F, nearest)
            if model.R_by_state:
                R = rule.mean(partial(model.R_at, k=k), at.x, at.F)
            else:
                R = model.R(k)[None]
            M = law.noise_root(factor(R))
            y, HF = _at(law, state, at)
            y = model.nearest(y, np.where(np.isfinite(z), z, y))
            # Slopes by points about a path that is nearly known may be round-off themselves.
            untold = self.kind.about and isinstance(rule, SigmaPoints)
            H = np.zeros(HF.shape) if untold else law.slopes(at.F)
            carry[:] = begun
            given = [z, y, HF]
            shown[:] = self._run(_Read, M, carry, given, [H])[:, 0]
            at = self._carried(carry)

    def _run(
        self,
        form: type[_Move | _Read],
        noise: Array,
        carry: Array,
        before: Sequence[Array],
        after: Sequence[Array] = (),
    ) -> Array:
        trials = len(carry)
        step = self._step(form, noise.shape[2])
        parts = [part.reshape(trials, -1) for part in (*before, noise, *after)]
        each = np.concatenate(parts, axis=1)[:, None]
        out = np.empty((trials, 1, step.shown))
        step.run(carry, each, _NONE, out, 0, 1, 1)
        return out


def _at(law: Linearised, state: _States, at: _States) -> tuple[Array, Array]:
    """Returns A x + b and A F of a state by a law about the states `at`."""
    if at is state:
        return law.y, law.AF
    A = law.slopes(at.F)
    return law.y + multiply(A, state.x - at.x), np.matmul(A, state.F)


def passes(model: StateModel, kind: Kind) -> Passes:
    """Returns the passes of a kind along a model, which keeps them as long as its functions stay
    the same."""
    kept = model.passes
    functions = model.epoch_functions
    # A copy with another prior or log begins with the passes of what it was copied from.
    if kept.get("model") is not model or kept.get("functions") is not functions:
        kept = vars(model)["passes"] = Kept(model=model, functions=functions)
    if kind not in kept:
        kept[kind] = (_Together if _suits(model, kind) else _ByEpoch)(model, kind)
    return kept[kind]


def _suits(model: StateModel, kind: Kind) -> bool:
    """Tells whether the functions of a model can be part of recorded steps."""
    if model.gain_by_state or model.R_by_state:
        return False
    law = law_of(kind.rule, model.n)
    return law is not None and _operations(model, law, kind.iterations) <= _MOST_OPERATIONS


def _operations(model: StateModel, law: Law, iterations: int) -> float:
    """Counts the operations of a step, as it is about; infinite if f or h is not recorded."""
    f, h = model.epoch_functions
    moving = [one for one in f.recordings if model.moves(int(one.epochs[0]))]
    each = []
    for recordings in (moving, h.recordings):
        most = 0
        for one in recordings:
            if not isinstance(one.function, RowFunction) or one.ties is not None:
                return np.inf
            most = max(most, _operations_of(one.function.programs, law))
        each.append(most)
    rows = model.n + model.readings_per_epoch
    return each[0] + iterations * (each[1] + rows**3)


def _operations_of(programs: RowPrograms, law: Law) -> int:
    if not isinstance(law, Regression):
        return len(programs.values.operations) + programs.n * len(programs.tangents.operations)
    each = len(programs.values.operations) + programs.n * (2 * programs.m + programs.n)
    return len(law.s) * each
