"""Runs the steps of filters and smoothers along a model's epochs: recorded together with f and h,
or, where these are not recorded or too long, epoch by epoch, with their values and slopes given as
numbers.

A trial that breaks down is NaN from then on and disturbs no other.
"""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise
from typing import Any, ClassVar, NamedTuple

import numpy as np

from ipe_bench.basics.linalg import Array, multiply, own
from ipe_bench.engine.rows import RowFunction
from ipe_bench.engine.scan import Step, gram
from ipe_bench.engine.trace import RowPrograms
from ipe_bench.states.algebra import factor, half, triangular
from ipe_bench.states.along import Recording
from ipe_bench.states.base import Kept, Normal, StateModel
from ipe_bench.states.layouts import Layout, Shape, full, named_step, packed, triangle, unpacked
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
    least_noise,
    near,
    predicted,
    scores,
    unit,
    updated,
    updated_by_parts,
    within,
    zeros,
)
from ipe_bench.states.student import Mixture

_MOST_OPERATIONS = 20_000
"""Operations of f and h in a step at most: they take two to four seconds to compile, once per
machine."""
_NUMBERS = 4e6
"""Numbers of passes that are held at once."""
_NUMBERS_BY_EPOCH = 2e7
"""Numbers likewise where functions are called epoch by epoch: each call is of all trials."""
_LANES = 8
"""Trials at least that are held at once: machine code takes no more time for them than for one."""


class Kind(NamedTuple):
    """Says what a pass does."""

    rule: Rule
    iterations: int = 1
    smooths: bool = False
    """Whether a pass back follows."""
    about: bool = False
    """Whether f and h are linearised about the states of a path."""
    gate: float | None = None
    """The squared normalised innovation of a reading beyond which it counts as missing."""
    tails: tuple[Mixture, ...] = ()
    """The noise of each reading; empty: all are normal."""


class Route(NamedTuple):
    """Holds states, from before the first transition, about which functions are linearised."""

    mean: Array
    """(trials, 1 + K, n)"""
    root: Array
    """Triangular roots of their covariances (trials, 1 + K, n (n + 1) / 2)."""


@dataclass(frozen=True)
class Sizes:
    """Lays out what the steps of n states and m readings take and give."""

    n: int
    m: int
    smooths: bool
    tails: bool = False

    @cached_property
    def carried(self) -> Layout:
        return Layout(x=self.n, F=triangle(self.n), log_likelihood=1, doubt=1)

    @cached_property
    def moved(self) -> Layout:
        """What a transition tells a step back."""
        return Layout(moved=full(self.n, self.n), noise=triangle(self.n))

    @cached_property
    def told(self) -> Layout:
        """What a step back takes of an epoch."""
        n = self.n
        read = full(n, self.m + n)
        return Layout(x=n, F=triangle(n), e=self.m, read=read, **self.moved.shapes)

    @cached_property
    def shown(self) -> Layout:
        n = self.n
        parts = dict(self.told.shapes)
        if not self.smooths:
            parts = {name: parts[name] for name in ("x", "F", "e")}
        rest = {"predicted": self.m, "deviation": self.m, "covariance": full(n, n)}
        if self.tails:
            rest |= {"apart": self.m, "others": self.m, "own": self.m}
        return Layout(**parts, nis=1, **rest)

    @cached_property
    def unit(self) -> Layout:
        """What a step back carries: the noise that is left of each state's unit noise."""
        return Layout(u=self.n, S=triangle(self.n))

    @cached_property
    def back(self) -> Layout:
        return Layout(x=self.n, F=triangle(self.n), covariance=full(self.n, self.n))


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


def numbers_of(rule: Rule, n: int) -> Any:
    """Returns the numbers that a step of a rule has in its machine code."""
    law = law_of(rule, n)
    return law if isinstance(law, Regression) else None


_NOTHING = Layout()


@dataclass(frozen=True)
class _Form:
    """Describes the machine code of a step, as far as it depends on a model."""

    kind: Kind
    sizes: Sizes
    f: RowPrograms | None
    """None where the states stand still."""
    h: RowPrograms
    state_periods: Sequence[float]
    periods: Sequence[float]
    each: Layout
    """The numbers of a trial and epoch."""
    shared: Layout
    """The numbers of an epoch."""

    @classmethod
    def of(cls, passes: Passes, f: RowPrograms | None, h: RowPrograms, G: Array, R: Array) -> _Form:
        model = passes.model
        n = model.n
        kind = passes.kind
        path: dict[str, Shape] = {}
        if kind.about:
            path = {"before": n, "root": triangle(n), "here": n, "root_here": triangle(n)}
        each = Layout(z=passes.sizes.m, **path)
        of_f = 0 if f is None else f.values.inputs - n
        noise: dict[str, Shape] = {"G": _places(G), "R": _places(R)}
        shared = Layout(c=of_f, d=h.values.inputs - n, **noise)
        periods = model.state_periods or (0.0,) * n, model.periods or (0.0,) * passes.sizes.m
        return cls(kind, passes.sizes, f, h, *periods, each, shared)

    def step(self) -> Step:
        sizes = self.sizes
        # A rule of a plugin may get other points by the same name: the numbers tell.
        what = (self, numbers_of(self.kind.rule, sizes.n))
        return named_step(self.text, what, sizes.carried, [self.each], self.shared, sizes.shown)

    def text(
        self,
        x: Vector,
        F: Rows,
        z: Vector,
        c: Vector,
        d: Vector,
        G: Rows,
        R: Rows,
        before: Vector | None = None,
        root: Rows | None = None,
        here: Vector | None = None,
        root_here: Rows | None = None,
        **carried: Vector,
    ) -> dict[str, Any]:
        law = law_of(self.kind.rule, len(x))
        assert law is not None
        state = State(x, F)
        moved = None
        smooths = self.kind.smooths
        if self.f is not None:
            f = _Recorded(self.f, c, self.state_periods)
            linear = law(f, state, State(before, root) if before and root else state)
            state, moved = predicted(linear, law.noise(G, linear), smooths)
            if here:
                state = State(near(state.x, here, self.state_periods), state.F)
        h = _Recorded(self.h, d, self.periods)
        linear = law(h, state, State(here, root_here) if here and root_here else state)
        tails = self.kind.tails
        own = [dot(row, row) for row in R]
        if tails:
            R = least_noise(R, tails)
        M = law.noise(R, linear)
        if self.kind.gate is not None:
            z = within(z, linear, M, self.periods, self.kind.gate)
        given = z, self.periods, smooths, own, tails
        found = _updated(state, linear, M, *given)
        for _ in range(1, self.kind.iterations):
            linear = law(h, state, found.state)
            found = _updated(state, linear, law.noise(R, linear), *given)
        if here and isinstance(law, Regression):
            # Slopes by points about a path that is nearly known may be round-off themselves.
            found = found._replace(doubt=0.0)
        return {**_shown(z, found, **carried), **_told_of_move(moved, len(x))}


def _updated(
    state: State,
    linear: Linear,
    M: Rows,
    z: Vector,
    periods: Sequence[float],
    smooths: bool,
    own: Vector,
    tails: Sequence[Mixture],
) -> Update:
    """Takes in readings with noise of the root M, or where that has tails with at least so much."""
    if tails:
        return updated_by_parts(state, linear, M, own, tails, z, periods, smooths)
    return updated(state, linear, M, z, periods, smooths)


def _places(some: Array) -> Shape:
    return tuple(map(tuple, some.tolist()))


def _back(
    u: Vector,
    S: Rows,
    x: Vector,
    F: Rows,
    e: Vector,
    read: Rows,
    moved: Rows,
    noise: Rows,
) -> dict[str, Any]:
    """Steps back from an epoch to the one before."""
    after = Smoothed(u, S)
    state = after.of(State(x, F))
    before = after.before(e, read, beside(moved, noise))
    return {**before._asdict(), **state._asdict(), "covariance": gram(state.F)}


def _move(
    x: Vector, F: Rows, y: Vector, AF: Rows, N: Rows, smooths: bool, **carried: Vector
) -> dict[str, Any]:
    """Steps along a transition whose linear form is given."""
    state, moved = predicted(Linear(y, AF, [], []), N, smooths)
    return {**carried, **state._asdict(), **_told_of_move(moved, len(x))}


def _read(
    x: Vector,
    F: Rows,
    z: Vector,
    y: Vector,
    HF: Rows,
    M: Rows,
    H: Rows,
    smooths: bool,
    own: Vector | None = None,
    gate: float | None = None,
    tails: Sequence[Mixture] = (),
    **carried: Vector,
) -> dict[str, Any]:
    """Takes in readings whose linear form is given."""
    linear = Linear(y, HF, [], H)
    if gate is not None:
        z = within(z, linear, M, (), gate)
    found = _updated(State(x, F), linear, M, z, (), smooths, own or [], tails)
    return {**_shown(z, found, **carried), **_told_of_move(None, len(x))}


def _shown(z: Vector, found: Update, log_likelihood: Vector, doubt: Vector) -> dict[str, Any]:
    """Names what an update carries on and shows."""
    state, e, L, in_doubt, read, judged = found
    nis, told = scores(e, L)
    return {
        **state._asdict(),
        "log_likelihood": [log_likelihood[0] + told],
        "doubt": [np.maximum(doubt[0], in_doubt)],
        "e": e,
        "read": read,
        "nis": [nis],
        "predicted": [a - dot(row, e) for a, row in zip(z, L, strict=True)],
        "deviation": [np.sqrt(dot(row, row)) for row in L],
        "covariance": gram(state.F),
        **judged,
    }


def _told_of_move(moved: Rows | None, n: int) -> dict[str, Rows]:
    """Names what a transition tells a smoother; without one the noise stays what it was."""
    if moved is None:
        moved = beside(unit(n), zeros(n, n))
    return {"moved": [row[:n] for row in moved], "noise": [row[n:] for row in moved]}


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

    numbers: ClassVar[float] = _NUMBERS

    def __init__(self, model: StateModel, kind: Kind) -> None:
        self.model = model
        self.functions = model.epoch_functions
        self.kind = kind
        self.sizes = Sizes(model.n, model.readings_per_epoch, kind.smooths, bool(kind.tails))
        m, P = model.prior
        self.start = m, roots(P[None])[0]

    @abstractmethod
    def there(self, z: Array, route: Route | None, carry: Array, shown: Array) -> None:
        """Advances carry (trials, c) along readings z (trials, 1 + K, m), of which the first are
        none, and fills what is shown (trials, 1 + K, s)."""

    @property
    def at_once(self) -> int:
        """Trials that are run together at most."""
        each = self.sizes.shown.size
        if self.kind.smooths:
            each += self.sizes.back.size
        return max(_LANES, int(self.numbers / ((1 + self.model.epochs) * each)))

    @cached_property
    def _back(self) -> Step:
        told = self.sizes.told
        return named_step(_back, "back", self.sizes.unit, [told], _NOTHING, self.sizes.back)

    def run(self, z: Array, route: Route | None, start: Normal | None) -> Passed:
        """Passes along readings z (trials, K, m) from the prior, or from other starts."""
        sizes = self.sizes
        trials, K, _ = z.shape
        mean, root = self.start if start is None else (start.mean, roots(start.covariance))
        carry = np.zeros((trials, sizes.carried.size))
        shown = np.empty((trials, 1 + K, sizes.shown.size))
        shown[:, 0] = 0.0
        for rows, layout in ((carry, sizes.carried), (shown[:, 0], sizes.shown)):
            rows[:, layout.at["x"]] = mean
            rows[:, layout.at["F"]] = root
        padded = np.empty((trials, 1 + K, z.shape[2]))
        padded[:, 0] = np.nan
        padded[:, 1:] = z
        self.there(padded, route, carry, shown)
        if not self.kind.smooths:
            return Passed(shown, carry, None)
        # After the last epoch nothing is read: u = 0 and S = I.
        after = np.zeros((trials, sizes.unit.size))
        after[:, sizes.unit.at["S"]] = packed(np.eye(sizes.n))
        back = np.empty((trials, 1 + K, sizes.back.size))
        self._back.run(after, [shown], _NONE, back, K, -1, 1 + K)
        return Passed(shown, carry, back)


_NONE = np.empty((0, 0))


class _Together(Passes):
    """Passes whose steps are recorded together with f and h."""

    def __init__(self, model: StateModel, kind: Kind) -> None:
        super().__init__(model, kind)
        K = model.epochs
        f, h = self.functions
        moving = np.array([k for k in range(K) if model.moves(k)], dtype=int)
        gains = model.gains(moving)
        noise = factor(model.covariances(np.arange(K)))
        G = (gains != 0).any(axis=0)
        R = (noise != 0).any(axis=0)
        gain_numbers = np.zeros((K, int(G.sum())))
        gain_numbers[moving] = gains[:, G]
        of_f, at_f = f.places(K)
        of_h, at_h = h.places(K)
        pairs = of_f * len(h.recordings) + of_h
        made: dict[int, tuple[Step, Array]] = {}
        for pair in np.unique(pairs).tolist():
            here = np.flatnonzero(pairs == pair)
            first = int(here[0])
            moved = f.recordings[int(of_f[first])] if model.moves(first) else None
            read = h.recordings[int(of_h[first])]
            programs = None if moved is None else _programs(moved)
            form = _Form.of(self, programs, _programs(read), G, R)
            shared = np.zeros((1 + K, form.shared.size))
            values = {"d": read.numbers[at_h[here]], "R": noise[here][:, R]}
            if moved is not None:
                values |= {"c": moved.numbers[at_f[here]], "G": gain_numbers[here]}
            for name, numbers in values.items():
                shared[1 + here, form.shared.at[name]] = numbers
            made[pair] = form.step(), shared
        changes = np.flatnonzero(np.diff(pairs)) + 1
        self.runs: list[_Run] = []
        for first, end in pairwise([0, *changes.tolist(), K]):
            self.runs.append(_Run(*made[int(pairs[first])], 1 + first, end - first))

    def there(self, z: Array, route: Route | None, carry: Array, shown: Array) -> None:
        each = z
        if route is not None:
            before = np.concatenate([route.mean, route.root], axis=2)
            each = np.concatenate([z, np.roll(before, 1, axis=1), before], axis=2)
        for step, shared, first, count in self.runs:
            step.run(carry, [each], shared, shown, first, 1, count)


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

    numbers = _NUMBERS_BY_EPOCH

    def __init__(self, model: StateModel, kind: Kind) -> None:
        super().__init__(model, kind)
        self._step = functools.cache(self._made)

    def _made(self, text: Callable[..., Any], columns: int, gate: float | None = None) -> Step:
        """Returns the step of a transition or of readings with a root of noise of so many
        columns."""
        n = self.sizes.n
        m = self.sizes.m
        smooths = self.sizes.smooths
        if text is _move:
            each = {"y": n, "AF": full(n, n), "N": full(n, columns)}
            shown = self.sizes.moved if smooths else _NOTHING
        else:
            each = {"z": m, "y": m, "HF": full(m, n), "M": full(m, columns), "H": full(m, n)}
            if self.kind.tails:
                each["own"] = m
            shown = self.sizes.shown
        options: dict[str, Any] = {"smooths": smooths}
        if gate is not None:
            options["gate"] = gate
        if self.kind.tails and text is _read:
            options["tails"] = self.kind.tails
        recorded = partial(text, **options)
        what = text.__name__, options
        arrays = [Layout(**{name: shape}) for name, shape in each.items()]
        return named_step(recorded, what, self.sizes.carried, arrays, _NOTHING, shown)

    def there(self, z: Array, route: Route | None, carry: Array, shown: Array) -> None:
        n = self.sizes.n
        at = self.sizes.told.at
        told = slice(at["moved"].start, at["noise"].stop)
        still = np.concatenate([np.eye(n).ravel(), np.zeros(n * (n + 1) // 2)])
        for k in range(self.model.epochs):
            moved = still
            before = here = None
            if route is not None:
                before, here = (self._state(route.mean[:, i], route.root[:, i]) for i in (k, k + 1))
            if self.model.moves(k):
                moved = self._moved(k, carry, before, here)
            self._read(k, z[:, k + 1], carry, here, shown[:, k + 1])
            if self.kind.smooths:
                shown[:, k + 1, told] = moved

    def _state(self, mean: Array, root: Array) -> _States:
        return _States(mean, unpacked(root, self.sizes.n))

    def _carried(self, carry: Array) -> _States:
        at = self.sizes.carried.at
        return self._state(carry[:, at["x"]].copy(), carry[:, at["F"]])

    def _moved(self, k: int, carry: Array, before: _States | None, here: _States | None) -> Array:
        """Advances what is carried by a transition, and returns what that tells a smoother."""
        model = self.model
        rule = self.kind.rule
        state = self._carried(carry)
        at = before or state
        nearest = model.nearest_state if model.state_periods else None
        law = rule.linearised(model.transition_into(k), at.x, at.F, nearest)
        if model.gain_by_state:
            Q = rule.mean(partial(model.Q_at, k=k), at.x, at.F)
            N = law.noise_root(half(Q).G)
        else:
            N = law.noise_root(model.gain(k))
        y, AF = _at(law, state, at)
        if here is not None:
            y = model.nearest_state(y, here.x)
        return self._run(_move, N, carry, [y, AF])

    def _read(self, k: int, z: Array, carry: Array, here: _States | None, shown: Array) -> None:
        """Takes in readings z (trials, m), and fills what is shown (trials, s)."""
        model = self.model
        rule = self.kind.rule
        state = self._carried(carry)
        at = here or state
        nearest = model.nearest if model.periods else None
        begun = carry.copy()
        gate = self.kind.gate
        for _ in range(self.kind.iterations):
            law = rule.linearised(model.observation_at(k), at.x, at.F, nearest)
            if model.R_by_state:
                R = rule.mean(partial(model.R_at, k=k), at.x, at.F)
            else:
                R = model.R(k)[None]
            root = factor(R)
            after = []
            if self.kind.tails:
                root = root * np.sqrt([one.least for one in self.kind.tails])[:, None]
                after = [np.broadcast_to(np.diagonal(R, axis1=1, axis2=2), z.shape)]
            M = law.noise_root(root)
            y, HF = _at(law, state, at)
            y = model.nearest(y, np.where(np.isfinite(z), z, y))
            # Slopes by points about a path that is nearly known may be round-off themselves.
            untold = self.kind.about and isinstance(rule, SigmaPoints)
            H = np.zeros(HF.shape) if untold else law.slopes(at.F)
            carry[:] = begun
            shown[:] = self._run(_read, M, carry, [z, y, HF], [H, *after], gate)
            at = self._carried(carry)
            if gate is not None:
                # What the first linearisation takes for missing is missing to all.
                predicted = self.sizes.shown.part(shown, "predicted")
                z = np.where(np.isfinite(predicted), z, np.nan)
                gate = None

    def _run(
        self,
        text: Callable[..., Any],
        noise: Array,
        carry: Array,
        before: Sequence[Array],
        after: Sequence[Array] = (),
        gate: float | None = None,
    ) -> Array:
        trials = len(carry)
        step = self._step(text, noise.shape[2], gate)
        each = [own(part).reshape(trials, 1, -1) for part in (*before, noise, *after)]
        out = np.empty((trials, 1, step.shown))
        step.run(carry, each, _NONE, out, 0, 1, 1)
        return out[:, 0]


def _at(law: Linearised, state: _States, at: _States) -> tuple[Array, Array]:
    """Returns A x + b and A F of a state by a law about the states `at`."""
    if at is state:
        return law.y, law.AF
    A = law.slopes(at.F)
    return law.y + multiply(A, state.x - at.x), np.matmul(A, state.F)


def passes(model: StateModel, kind: Kind) -> Passes:
    """Returns the passes of a kind along a model."""
    kept = kept_of(model)
    if kind not in kept:
        kept[kind] = (_Together if _suits(model, kind) else _ByEpoch)(model, kind)
    return kept[kind]


def kept_of(model: StateModel) -> Kept:
    """Returns what a model keeps for trackers, as long as its functions stay the same."""
    kept = model.passes
    functions = model.epoch_functions
    # A copy with another prior or log begins with what is kept by what it was copied from.
    if kept.get("model") is not model or kept.get("functions") is not functions:
        kept = vars(model)["passes"] = Kept(model=model, functions=functions)
    return kept


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
