"""Runs Gaussian filters and smoothers along a model's epochs.

A pass takes all trials forward through the epochs with a filter, and for a smoother back again. Its
*kind* says which filter that is (`Kind`): the rule that linearises, iterations, gate and tails. A
step is written once, as a function of lists: the parts of its *carry*, which goes from epoch to
epoch, and of its *output*, which is stored at each, lie in rows of numbers whose *layouts* say
where (`StepLayouts`). A trial that breaks down is NaN from then on and disturbs no other.

There are two forms, which share the algebra of `steps`, the outputs (`_filter_output`) and the way
back of a smoother, and repeat what lies around:

                        recorded: _RecordedStep           by epoch: _PassesByEpoch
    for which models    f and h are recorded, and their   all others, such as those whose noise
                        program is not long               depends on the states
    f and h             in the machine code of a step     called in NumPy; a step takes numbers
    linearised by       `Law`, of one trial in lists      `Rule.linearised`, of all in arrays
    epochs              stretches that share a step       one after another
    iterations          _update                           _update
    gate                _update                           _update_step, and _update for iterations
    about a path        step, _predict, _update           _predict, _update
    least noise         _update                           _least_root
"""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np

from ipe_bench.basics.linalg import Array, Mask, multiply, own
from ipe_bench.engine.rows import RowFunction
from ipe_bench.engine.scan import Step, gram
from ipe_bench.engine.trace import RowPrograms
from ipe_bench.states.algebra import factor, half, triangular
from ipe_bench.states.along import EpochFunctions, Recording
from ipe_bench.states.base import FixedParts, Kept, Normal, StateModel
from ipe_bench.states.layouts import Layout, Shape, full, named_step, packed, triangle, unpacked
from ipe_bench.states.linearisation import Linearised, Rule, SigmaPoints, Taylor
from ipe_bench.states.steps import (
    Law,
    Linear,
    Readings,
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
    """Says which filter or smoother a pass runs."""

    rule: Rule
    iterations: int = 1
    """Linearisations of each reading."""
    smooths: bool = False
    """Whether a pass back follows."""
    about_path: bool = False
    """Whether f and h are linearised about the states of a path, in place of the filter's own."""
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
class StepLayouts:
    """Lays out the inputs and outputs of steps with n states and m readings.

    States are x + F v, where the unit noise v is N(0, I). A smoother steps back by rows (X, Y),
    which give the unit noise before a transition or update by that after it; see `steps`.
    """

    n: int
    m: int
    smooths: bool
    has_tails: bool = False

    @cached_property
    def filter_carry(self) -> Layout:
        return Layout(x=self.n, F=triangle(self.n), log_likelihood=1, doubt=1)

    @cached_property
    def transition_rows(self) -> Layout:
        """The rows (X, Y) of a transition."""
        return Layout(transition_X=full(self.n, self.n), transition_Y=triangle(self.n))

    @cached_property
    def smoother_input(self) -> Layout:
        """What a smoother needs of an epoch: its filtered states, innovations e, and rows."""
        n = self.n
        rows = {"update_rows": full(n, self.m + n), **self.transition_rows.shapes}
        return Layout(x=n, F=triangle(n), e=self.m, **rows)

    @cached_property
    def filter_output(self) -> Layout:
        """What a filter stores of an epoch; the input of a smoother, if one follows, in front."""
        n = self.n
        parts = dict(self.smoother_input.shapes)
        if not self.smooths:
            parts = {name: parts[name] for name in ("x", "F", "e")}
        diagnostics = {"predicted": self.m, "deviation": self.m, "covariance": full(n, n)}
        if self.has_tails:
            diagnostics |= {"apart": self.m, "others": self.m, "own": self.m}
        return Layout(**parts, nis=1, **diagnostics)

    def gated(self, z: Array, output: Array) -> Mask:
        """Tells which readings z (..., m) a filter took for missing, by its output (..., o): those
        without a prediction. A trial that has broken down has none, either."""
        layout = self.filter_output
        unseen = np.isnan(layout.part(output, "predicted"))
        return np.isfinite(z) & unseen & np.isfinite(layout.part(output, "nis"))

    @cached_property
    def smoother_carry(self) -> Layout:
        """Mean u and root S of the filter's unit noise, given all readings."""
        return Layout(u=self.n, S=triangle(self.n))

    @cached_property
    def smoother_output(self) -> Layout:
        return Layout(x=self.n, F=triangle(self.n), covariance=full(self.n, self.n))


def roots(P: Array) -> Array:
    """Returns triangular roots (trials, n (n + 1) / 2) of covariances P (trials, n, n)."""
    return packed(triangular(P))


class _RecordedFunction(NamedTuple):
    """Stands for f or h of an epoch in a step that is recorded."""

    programs: RowPrograms
    c: Vector
    """Numbers of the epoch."""
    periods: Sequence[float]

    def __call__(self, x: Vector) -> Vector:
        return self.programs.values([*x, *self.c])[: self.programs.m]

    def slopes(self, x: Vector) -> tuple[Vector, Rows]:
        m = self.programs.m
        # Behind the m values lie the intermediate numbers that the slopes share.
        values = self.programs.values([*x, *self.c])
        columns = [self.programs.tangents([*u, *values[m:]]) for u in unit(self.programs.n)]
        return values[:m], [list(row) for row in zip(*columns, strict=True)]


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


_EMPTY = Layout()
_NO_SHARED = np.empty((0, 0))


@dataclass(frozen=True)
class _RecordedStep:
    """Describes a step of a filter whose machine code contains f and h.

    `_PassesByEpoch` repeats its iterations, gate and slopes about a path in NumPy. Tests hold the
    two equal: tests/states/test_recorded_steps.py the iterations, test_gate.py the gate (both forms
    beside a textbook filter), and test_student.py the tails.
    """

    kind: Kind
    layouts: StepLayouts
    f: RowPrograms | None
    """None where the states stand still."""
    h: RowPrograms
    state_periods: Sequence[float]
    periods: Sequence[float]
    each: Layout
    """The numbers of a trial and epoch."""
    shared: Layout
    """The numbers of an epoch, which all trials share."""

    @classmethod
    def of(cls, passes: Passes, f: RowPrograms | None, h: RowPrograms, noise: _Noise) -> Self:
        model = passes.model
        n = model.n
        m = passes.layouts.m
        path: dict[str, Shape] = {}
        if passes.kind.about_path:
            before: dict[str, Shape] = {"x_before": n, "F_before": triangle(n)}
            path = {**before, "x_here": n, "F_here": triangle(n)}
        roots: dict[str, Shape] = {"G": _shape_of(noise.G_mask), "R": _shape_of(noise.R_mask)}
        numbers_of_f = 0 if f is None else f.values.inputs - n
        return cls(
            kind=passes.kind,
            layouts=passes.layouts,
            f=f,
            h=h,
            state_periods=model.state_periods or (0.0,) * n,
            periods=model.periods or (0.0,) * m,
            each=Layout(z=m, **path),
            shared=Layout(c=numbers_of_f, d=h.values.inputs - n, **roots),
        )

    def compiled(self) -> Step:
        layouts = self.layouts
        # Machine code is kept on disk, where a rule is its name: another day that of a plugin may
        # have other points, and the numbers tell.
        identity = (self, numbers_of(self.kind.rule, layouts.n))
        carry, output = layouts.filter_carry, layouts.filter_output
        return named_step(self.step, identity, carry, [self.each], self.shared, output)

    def step(
        self,
        x: Vector,
        F: Rows,
        log_likelihood: Vector,
        doubt: Vector,
        z: Vector,
        c: Vector,
        d: Vector,
        G: Rows,
        R: Rows,
        **path: Any,
    ) -> dict[str, Any]:
        """Predicts the states of an epoch and takes in its readings."""
        state = State(x, F)
        path_before = path_here = None
        if self.kind.about_path:
            path_before = State(path["x_before"], path["F_before"])
            path_here = State(path["x_here"], path["F_here"])
        rows = None
        if self.f is not None:
            f = _RecordedFunction(self.f, c, self.state_periods)
            state, rows = self._predict(f, state, G, path_before)
            if path_here is not None:
                # Angles may have gone around since the path's state, about which h is linearised.
                state = State(near(state.x, path_here.x, self.state_periods), state.F)
        h = _RecordedFunction(self.h, d, self.periods)
        variances = [dot(row, row) for row in R]
        readings = Readings(z, self.periods, self.kind.smooths, variances, self.kind.tails)
        taken, update = self._update(h, state, readings, R, path_here)
        output = _filter_output(taken.z, update, log_likelihood, doubt)
        return {**output, **_named_rows(rows, len(x))}

    @property
    def _law(self) -> Law:
        law = law_of(self.kind.rule, self.layouts.n)
        assert law is not None
        return law

    def _predict(
        self, f: _RecordedFunction, state: State, G: Rows, at: State | None
    ) -> tuple[State, Rows]:
        law = self._law
        linear = law(f, state, state if at is None else at)
        return predicted(linear, law.noise(G, linear), self.kind.smooths)

    def _update(
        self, h: _RecordedFunction, state: State, readings: Readings, R: Rows, at: State | None
    ) -> tuple[Readings, Update]:
        """Returns the readings within the gate, and the update by them."""
        law = self._law
        linear = law(h, state, state if at is None else at)
        if self.kind.tails:
            R = least_noise(R, self.kind.tails)
        M = law.noise(R, linear)
        if self.kind.gate is not None:
            # What the first linearisation takes for missing is missing to all.
            readings = readings.within(linear, M, self.kind.gate)
        update = updated(state, linear, M, readings)
        for _ in range(1, self.kind.iterations):
            linear = law(h, state, update.state)
            update = updated(state, linear, law.noise(R, linear), readings)
        if at is not None and isinstance(law, Regression):
            # Slopes by points about a path that is nearly known may be round-off themselves.
            update = update._replace(doubt=0.0)
        return readings, update


def _shape_of(mask: Array) -> Shape:
    """Returns the shape of a matrix of which only the numbers of a mask are kept."""
    return tuple(map(tuple, mask.tolist()))


def _predict_step(
    x: Vector, F: Rows, y: Vector, AF: Rows, N: Rows, smooths: bool, **scores: Vector
) -> dict[str, Any]:
    """Predicts by y = A x + b and A F, which are given as numbers, and noise of the root N."""
    state, rows = predicted(Linear(y, AF, [], []), N, smooths)
    return {**scores, **state._asdict(), **_named_rows(rows, len(x))}


def _update_step(
    x: Vector,
    F: Rows,
    log_likelihood: Vector,
    doubt: Vector,
    z: Vector,
    y: Vector,
    HF: Rows,
    M: Rows,
    H: Rows,
    variances: Vector,
    smooths: bool,
    gate: float | None,
    tails: Sequence[Mixture],
) -> dict[str, Any]:
    """Takes in readings by y = H x + b and H F, which are given as numbers, and noise of the root
    M."""
    linear = Linear(y, HF, [], H)
    readings = Readings(z, (), smooths, variances, tails)
    if gate is not None:
        readings = readings.within(linear, M, gate)
    update = updated(State(x, F), linear, M, readings)
    output = _filter_output(readings.z, update, log_likelihood, doubt)
    return {**output, **_named_rows(None, len(x))}


def _smoother_step(
    u: Vector,
    S: Rows,
    x: Vector,
    F: Rows,
    e: Vector,
    update_rows: Rows,
    transition_X: Rows,
    transition_Y: Rows,
) -> dict[str, Any]:
    """Smooths the states of an epoch, and steps back to the one before."""
    after = Smoothed(u, S)
    state = after.of(State(x, F))
    before = after.before(e, update_rows, beside(transition_X, transition_Y))
    return {**before._asdict(), **state._asdict(), "covariance": gram(state.F)}


def _filter_output(
    z: Vector, update: Update, log_likelihood: Vector, doubt: Vector
) -> dict[str, Any]:
    """Names what a filter carries on from an update and stores of it."""
    state, e, L, doubt_here, update_rows, by_mixture = update
    # Of readings with tails these are no scores: `trackers` scores their mixtures instead.
    nis, log_density = scores(e, L)
    return {
        **state._asdict(),
        "log_likelihood": [log_likelihood[0] + log_density],
        "doubt": [np.maximum(doubt[0], doubt_here)],
        "e": e,
        "update_rows": update_rows,
        "nis": [nis],
        "predicted": [a - dot(row, e) for a, row in zip(z, L, strict=True)],
        "deviation": [np.sqrt(dot(row, row)) for row in L],
        "covariance": gram(state.F),
        # Readings with tails have no L: these replace what is predicted by it.
        **by_mixture,
    }


def _named_rows(rows: Rows | None, n: int) -> dict[str, Rows]:
    """Names the rows (X, Y) of a transition; without one the unit noise stays what it was."""
    if rows is None:
        rows = beside(unit(n), zeros(n, n))
    return {"transition_X": [row[:n] for row in rows], "transition_Y": [row[n:] for row in rows]}


class Passed(NamedTuple):
    """Holds what the passes of some trials found, in rows of `StepLayouts`."""

    filtered: Array
    """Outputs of the filter (trials, 1 + K, o); in front x and F of the prior, and else 0."""
    carry: Array
    """That of the filter after the last epoch (trials, c)."""
    smoothed: Array | None
    """Outputs of the smoother (trials, 1 + K, b)."""


class Passes(ABC):
    """Passes along a model's epochs, forward and back."""

    numbers: ClassVar[float] = _NUMBERS

    def __init__(self, model: StateModel, kind: Kind) -> None:
        self.model = model
        self.functions = model.epoch_functions
        self.kind = kind
        m = model.readings_per_epoch
        self.layouts = StepLayouts(model.n, m, kind.smooths, bool(kind.tails))
        parts = kept_of(model).parts
        self.prior = parts.mean, roots(parts.P[None])[0]

    @abstractmethod
    def forward(self, z: Array, route: Route | None, carry: Array, output: Array) -> None:
        """Advances carry (trials, c) along readings z (trials, 1 + K, m), of which the first are
        none, and fills the output (trials, 1 + K, o)."""

    @property
    def at_once(self) -> int:
        """Trials that are run together at most."""
        each = self.layouts.filter_output.size
        if self.kind.smooths:
            each += self.layouts.smoother_output.size
        return max(_LANES, int(self.numbers / ((1 + self.model.epochs) * each)))

    def run(self, z: Array, route: Route | None, start: Normal | None) -> Passed:
        """Passes along readings z (trials, K, m) from the prior, or from other starts."""
        trials, K, m = z.shape
        carry, output = self._begun(trials, K, start)
        padded = np.empty((trials, 1 + K, m))
        padded[:, 0] = np.nan
        padded[:, 1:] = z
        self.forward(padded, route, carry, output)
        return Passed(output, carry, self._back(output) if self.kind.smooths else None)

    def _begun(self, trials: int, K: int, start: Normal | None) -> tuple[Array, Array]:
        """Returns the carry and the output of a filter, filled with the states at the start."""
        layouts = self.layouts
        mean, root = self.prior if start is None else (start.mean, roots(start.covariance))
        carry = np.zeros((trials, layouts.filter_carry.size))
        output = np.empty((trials, 1 + K, layouts.filter_output.size))
        # Of the row in front a smoother reads x and F; nothing reads the rest.
        output[:, 0] = 0.0
        for rows, layout in ((carry, layouts.filter_carry), (output[:, 0], layouts.filter_output)):
            rows[:, layout.at["x"]] = mean
            rows[:, layout.at["F"]] = root
        return carry, output

    def _back(self, filtered: Array) -> Array:
        """Smooths from the last epoch to the start, by the outputs of the filter."""
        layouts = self.layouts
        trials, length, _ = filtered.shape
        # After the last epoch nothing is read: u = 0 and S = I.
        carry = np.zeros((trials, layouts.smoother_carry.size))
        carry[:, layouts.smoother_carry.at["S"]] = packed(np.eye(layouts.n))
        output = np.empty((trials, length, layouts.smoother_output.size))
        self._step_back.run(carry, [filtered], _NO_SHARED, output, length - 1, -1, length)
        return output

    @cached_property
    def _step_back(self) -> Step:
        layouts = self.layouts
        carry, output = layouts.smoother_carry, layouts.smoother_output
        each = [layouts.smoother_input]
        return named_step(_smoother_step, "smoother", carry, each, _EMPTY, output)


class _Noise(NamedTuple):
    """Holds roots of the noise of all epochs, without the numbers that are 0 in each."""

    G_mask: Array
    """Whether a number of the gains is ever other than 0 (n, q)."""
    R_mask: Array
    """The same of the roots of R (m, m)."""
    G: Array
    """(K, numbers), 0 where the states stand still."""
    R: Array
    """(K, numbers)"""

    @classmethod
    def of(cls, parts: FixedParts) -> Self:
        R_roots = factor(parts.covariances)
        G_mask = (parts.gains != 0).any(axis=0)
        R_mask = (R_roots != 0).any(axis=0)
        return cls(G_mask, R_mask, parts.gains[:, G_mask], R_roots[:, R_mask])


class _Stretch(NamedTuple):
    """Holds epochs, one after another, of the same step."""

    step: Step
    shared: Array
    """(1 + K, p)"""
    first: int
    count: int


class _RecordedPasses(Passes):
    """Passes whose steps are recorded together with f and h."""

    def __init__(self, model: StateModel, kind: Kind) -> None:
        super().__init__(model, kind)
        f, h = self.functions
        of_f, _ = f.places(model.epochs)
        of_h, _ = h.places(model.epochs)
        # Epochs that share a recording of f and one of h share a step: a number for each pair.
        pairs = of_f * len(h.recordings) + of_h
        noise = _Noise.of(kept_of(model).parts)
        steps: dict[int, tuple[Step, Array]] = {}
        for pair in np.unique(pairs).tolist():
            steps[pair] = self._step_of(np.flatnonzero(pairs == pair), noise)
        changes = np.flatnonzero(np.diff(pairs)) + 1
        self.stretches: list[_Stretch] = []
        for first, end in pairwise([0, *changes.tolist(), model.epochs]):
            step, shared = steps[int(pairs[first])]
            # Epoch k lies in row 1 + k: the start is in front.
            self.stretches.append(_Stretch(step, shared, 1 + first, end - first))

    def _step_of(self, epochs: Array, noise: _Noise) -> tuple[Step, Array]:
        """Returns the step of epochs that share their recordings, and its shared numbers
        (1 + K, p)."""
        model = self.model
        first = int(epochs[0])
        f, f_numbers = _recording_at(self.functions[0], epochs, model.epochs)
        h, h_numbers = _recording_at(self.functions[1], epochs, model.epochs)
        # All epochs or none: one into which states stand still has a recording of its own for f.
        moves = model.moves(first)
        recorded = _RecordedStep.of(self, _programs(f) if moves else None, _programs(h), noise)
        values = {"d": h_numbers, "R": noise.R[epochs]}
        if moves:
            values |= {"c": f_numbers, "G": noise.G[epochs]}
        shared = np.zeros((1 + model.epochs, recorded.shared.size))
        for name, numbers in values.items():
            shared[1 + epochs, recorded.shared.at[name]] = numbers
        return recorded.compiled(), shared

    def forward(self, z: Array, route: Route | None, carry: Array, output: Array) -> None:
        each = z
        if route is not None:
            here = np.concatenate([route.mean, route.root], axis=2)
            # Row 0 gets the last state, and is never read: stretches begin at row 1.
            before = np.roll(here, 1, axis=1)
            each = np.concatenate([z, before, here], axis=2)
        for step, shared, first, count in self.stretches:
            step.run(carry, [each], shared, output, first, 1, count)


def _recording_at(functions: EpochFunctions, epochs: Array, K: int) -> tuple[Recording, Array]:
    """Returns the recording that epochs share, and its numbers at each of them."""
    which, place = functions.places(K)
    recording = functions.recordings[int(which[epochs[0]])]
    return recording, recording.numbers[place[epochs]]


def _programs(recording: Recording) -> RowPrograms:
    assert isinstance(recording.function, RowFunction)
    return recording.function.programs


class _TrialStates(NamedTuple):
    """Holds N(x, F F') of each trial, as arrays; `State` holds that of one, as lists."""

    x: Array
    """(trials, n)"""
    F: Array
    """(trials, n, n)"""


class _PassesByEpoch(Passes):
    """Passes whose functions are called epoch by epoch, and linearised by the rule in NumPy.

    Its iterations, gate and slopes about a path are those of `_RecordedStep`, which names the tests
    that hold them equal.
    """

    numbers = _NUMBERS_BY_EPOCH

    def __init__(self, model: StateModel, kind: Kind) -> None:
        super().__init__(model, kind)
        self._prediction = functools.cache(self._make_prediction)
        self._reading = functools.cache(self._make_reading)

    def _make_prediction(self, columns: int) -> Step:
        """Returns the step of a transition whose noise has a root of so many columns."""
        n = self.layouts.n
        smooths = self.kind.smooths
        each: dict[str, Shape] = {"y": n, "AF": full(n, n), "N": full(n, columns)}
        output = self.layouts.transition_rows if smooths else _EMPTY
        return self._made(_predict_step, {"smooths": smooths}, each, output)

    def _make_reading(self, columns: int, gate: float | None) -> Step:
        """Returns the step of readings whose noise has a root of so many columns."""
        n = self.layouts.n
        m = self.layouts.m
        each: dict[str, Shape] = {"z": m, "y": m, "HF": full(m, n), "M": full(m, columns)}
        each |= {"H": full(m, n), "variances": m}
        options = {"smooths": self.kind.smooths, "gate": gate, "tails": self.kind.tails}
        return self._made(_update_step, options, each, self.layouts.filter_output)

    def _made(
        self,
        function: Callable[..., Any],
        options: dict[str, Any],
        each: dict[str, Shape],
        output: Layout,
    ) -> Step:
        identity = function.__name__, options
        arrays = [Layout(**{name: shape}) for name, shape in each.items()]
        carry = self.layouts.filter_carry
        return named_step(partial(function, **options), identity, carry, arrays, _EMPTY, output)

    def forward(self, z: Array, route: Route | None, carry: Array, output: Array) -> None:
        n = self.layouts.n
        at = self.layouts.smoother_input.at
        # The rows (X, Y) lie side by side, in the output as in `transition_rows`: the step of an
        # update fills in those of no transition, and that of a transition is put in their place.
        of_transition = slice(at["transition_X"].start, at["transition_Y"].stop)
        # States that stand still keep their unit noise: X = I and Y = 0.
        still = np.concatenate([np.eye(n).ravel(), np.zeros(n * (n + 1) // 2)])
        for k in range(self.model.epochs):
            rows = still
            before = here = None
            # Row k of a route is the state before epoch k, since the start is in front.
            if route is not None:
                before = self._states(route.mean[:, k], route.root[:, k])
                here = self._states(route.mean[:, k + 1], route.root[:, k + 1])
            if self.model.moves(k):
                rows = self._predict(k, carry, before, here)
            self._update(k, z[:, k + 1], carry, here, output[:, k + 1])
            if self.kind.smooths:
                output[:, k + 1, of_transition] = rows

    def _states(self, mean: Array, root: Array) -> _TrialStates:
        return _TrialStates(mean, unpacked(root, self.layouts.n))

    def _states_of(self, carry: Array) -> _TrialStates:
        at = self.layouts.filter_carry.at
        return self._states(carry[:, at["x"]].copy(), carry[:, at["F"]])

    def _predict(
        self, k: int, carry: Array, before: _TrialStates | None, here: _TrialStates | None
    ) -> Array:
        """Advances the carry by a transition, and returns its rows for a smoother."""
        model = self.model
        rule = self.kind.rule
        state = self._states_of(carry)
        at = before or state
        nearest = model.nearest_state if model.state_periods else None
        fitted = rule.linearised(model.transition_into(k), at.x, at.F, nearest)
        if model.gain_by_state:
            Q = rule.mean(partial(model.Q_at, k=k), at.x, at.F)
            N = fitted.noise_root(half(Q).G)
        else:
            N = fitted.noise_root(model.gain(k))
        y, AF = _at(fitted, state, at)
        if here is not None:
            y = model.nearest_state(y, here.x)
        return _run(self._prediction(N.shape[2]), carry, [y, AF, N])

    def _update(
        self, k: int, z: Array, carry: Array, here: _TrialStates | None, output: Array
    ) -> None:
        """Takes in readings z (trials, m), and fills the output (trials, o)."""
        model = self.model
        rule = self.kind.rule
        state = self._states_of(carry)
        at = here or state
        nearest = model.nearest if model.periods else None
        predicted_carry = carry.copy()
        gate = self.kind.gate
        # Slopes by points about a path that is nearly known may be round-off themselves: they stay
        # 0, and the doubt with them.
        slopes_in_doubt = self.kind.about_path and isinstance(rule, SigmaPoints)
        for _ in range(self.kind.iterations):
            fitted = rule.linearised(model.observation_at(k), at.x, at.F, nearest)
            R = self._noise(k, at)
            M = fitted.noise_root(self._least_root(R))
            y, HF = _at(fitted, state, at)
            y = model.nearest(y, np.where(np.isfinite(z), z, y))
            H = np.zeros(HF.shape) if slopes_in_doubt else fitted.slopes(at.F)
            variances = np.broadcast_to(np.diagonal(R, axis1=1, axis2=2), z.shape)
            each = [z, y, HF, M, H, variances]
            # Each iteration takes the readings in anew.
            carry[:] = predicted_carry
            output[:] = _run(self._reading(M.shape[2], gate), carry, each)
            at = self._states_of(carry)
            if gate is not None:
                # What the first linearisation takes for missing is missing to all.
                z = np.where(self.layouts.gated(z, output), np.nan, z)
                gate = None

    def _noise(self, k: int, at: _TrialStates) -> Array:
        """Returns R of each trial, or of all (1, m, m)."""
        model = self.model
        if model.R_by_state:
            return self.kind.rule.mean(partial(model.R_at, k=k), at.x, at.F)
        return model.R(k)[None]

    def _least_root(self, R: Array) -> Array:
        """Returns a root of R, or of the least noise of readings with tails."""
        root = factor(R)
        if self.kind.tails:
            root = root * np.sqrt([one.least for one in self.kind.tails])[:, None]
        return root


def _run(step: Step, carry: Array, parts: Sequence[Array]) -> Array:
    """Advances carry by a step of one epoch, and returns its output (trials, o)."""
    trials = len(carry)
    each = [own(part).reshape(trials, 1, -1) for part in parts]
    output = np.empty((trials, 1, step.shown))
    step.run(carry, each, _NO_SHARED, output, 0, 1, 1)
    return output[:, 0]


def _at(fitted: Linearised, state: _TrialStates, at: _TrialStates) -> tuple[Array, Array]:
    """Returns A x + b and A F of a state, by what is fitted about the states `at`."""
    if at is state:
        return fitted.y, fitted.AF
    A = fitted.slopes(at.F)
    return fitted.y + multiply(A, state.x - at.x), np.matmul(A, state.F)


def passes_of(model: StateModel, kind: Kind) -> Passes:
    """Returns the passes of a kind along a model."""
    kept = kept_of(model)
    if kind not in kept:
        form = _RecordedPasses if _can_be_recorded(model, kind) else _PassesByEpoch
        kept[kind] = form(model, kind)
    return kept[kind]


def kept_of(model: StateModel) -> Kept:
    """Returns what a model keeps for trackers, as long as its functions stay the same."""
    kept = model.passes
    functions = model.epoch_functions
    # A copy with another prior or log begins with what is kept by what it was copied from.
    if kept.get("model") is not model or kept.get("functions") is not functions:
        # A model is frozen, what it keeps is not: this replaces its cached property.
        kept = vars(model)["passes"] = Kept(model=model, functions=functions)
        kept.parts = FixedParts.of(model)
    return kept


def _can_be_recorded(model: StateModel, kind: Kind) -> bool:
    """Tells whether the functions of a model can be part of recorded steps."""
    if model.gain_by_state or model.R_by_state:
        return False
    law = law_of(kind.rule, model.n)
    return law is not None and _operations(model, law, kind.iterations) <= _MOST_OPERATIONS


def _operations(model: StateModel, law: Law, iterations: int) -> float:
    """Counts the operations of a step roughly; infinite if f or h is not recorded."""
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
