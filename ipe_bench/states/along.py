"""The functions f and h of a state model with their slopes, at one epoch and along whole paths.

They are recorded once and run as compiled code along all epochs of all paths. What cannot be
recorded is called epoch by epoch, with slopes by complex steps, or by differences where complex
steps do not find what differences find.
"""

from __future__ import annotations

import warnings
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ipe_bench.basics.errors import describe_exception
from ipe_bench.basics.linalg import Array, deviations, multiply, own
from ipe_bench.engine.rows import RowFunction
from ipe_bench.engine.trace import Expression, Graph, Program, Recorded, RowPrograms, substitute
from ipe_bench.measurements.base import Shift, differentiate
from ipe_bench.states.algebra import root

if TYPE_CHECKING:
    from ipe_bench.states.base import StateModel

_MOST_OPERATIONS = 20_000
"""Operations of a function at one epoch, with its tangents, at most: they take ten seconds to
compile, once per machine."""
_MOST_IN_ALL = 200_000
"""Operations that are recorded of a function over all epochs at most, in a second or two."""
_MOST_FORMS = 8
"""Forms that a function may have over all epochs."""
_DRAWN = 3
"""Paths on which a recorded function is held against the model's own."""
_AGREES = 1e-10
"""Part of the size of an output by which the two may differ."""
_SMALL = 1e-6
"""Part of the size of the largest output below which no output counts as smaller."""
_ROUGH = 1e-3
"""Part of the size of an output's slopes by which those by differences may be wrong."""
Function = Callable[[Array, int], Array]


class Along(NamedTuple):
    """Holds f and h of a state model along paths of K epochs, with their slopes."""

    f: Array
    """f of the states before each epoch (trials, K, n); those states themselves if no transition
    leads there."""
    h: Array
    """h of the states at each epoch (trials, K, m)."""
    F: Array
    """df/dx (trials, K, n, n)."""
    H: Array
    """dh/dx (trials, K, m, n)."""


class Differences(NamedTuple):
    """Holds how a function is differentiated by differences."""

    sizes: Array
    """The units (n,) of the states, of which the steps are a part."""
    near: Shift
    """Puts outputs next to others by whole periods."""

    def slopes(self, function: Callable[[Array], Array], x: Array, widening: float = 1.0) -> Array:
        """Computes the Jacobians (..., m, n) at x (..., n), by steps that may be wider."""
        s = widening * self.sizes
        J = differentiate(lambda u: function(s * u), x / s, analytic=False, near=self.near)
        return J / s


@dataclass(frozen=True)
class Own:
    """A model's own function at one epoch, called as a recorded one is."""

    function: Function
    k: int
    differences: Differences | None = None
    """How its slopes are found where it is not analytic; None: by complex steps."""

    def __call__(self, x: Array, _: Array) -> Array:
        return self._here(x)

    def _here(self, x: Array) -> Array:
        return self.function(x, self.k)

    def slopes(self, x: Array, _: Array) -> tuple[Array, Array]:
        if self.differences is None:
            return self._here(x), differentiate(self._here, x, analytic=True)
        return self._here(x), self.differences.slopes(self._here, x)

    def is_analytic(self, x: Array, differences: Differences) -> bool:
        """Tells whether complex steps find the slopes at x (trials, n) that differences find, such
        as they do not of np.abs and np.linalg.norm, and of np.hypot, which takes no complex
        numbers."""
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", np.exceptions.ComplexWarning)
                exact = differentiate(self._here, x, analytic=True)
        except TypeError:
            return False
        rough, wider = (differences.slopes(self._here, x, by) for by in (1.0, 4.0))
        # Where differences of two steps are not alike, they say nothing against complex steps.
        size = np.abs(rough * differences.sizes).max(axis=(0, 2))[:, None]
        settled = np.abs(rough - wider) * differences.sizes <= _ROUGH * size
        apart = np.abs(rough - exact) * differences.sizes > 3 * _ROUGH * size
        return not (settled & apart).any()


class Recording(NamedTuple):
    """Holds a function of those epochs at which it is the same but for numbers."""

    function: RowFunction | Own
    epochs: Array
    """(e,)"""
    numbers: Array
    """(e, p)"""

    def __call__(self, x: Array) -> Array:
        """Computes values (..., m) at states x (..., n) of one epoch, or (trials, e, m) at those
        (trials, e, n) of all."""
        values = self.function(own(x.reshape(-1, x.shape[-1])), self.numbers)
        return values.reshape(*x.shape[:-1], values.shape[-1])

    def slope(self, x: Array) -> tuple[Array, Array]:
        """Computes values (..., m) and Jacobians (..., m, n) likewise."""
        *stack, n = x.shape
        values, slopes = self.function.slopes(own(x.reshape(-1, n)), self.numbers)
        return values.reshape(*stack, values.shape[-1]), slopes.reshape(*stack, *slopes.shape[1:])


@dataclass(frozen=True)
class EpochFunctions:
    """f or h of a model at all epochs."""

    recordings: Sequence[Recording]
    why: str = ""
    """Why it is called epoch by epoch; empty if it is recorded."""
    by_differences: bool = False
    """Whether its slopes are differences, since it is not analytic."""

    @classmethod
    def by_epoch(
        cls,
        function: Function,
        epochs: Sequence[int],
        why: str = "",
        differences: Differences | None = None,
    ) -> EpochFunctions:
        none = np.empty((1, 0))
        each = ((k, Own(function, k, differences)) for k in epochs)
        recordings = [Recording(own, np.array([k]), none) for k, own in each]
        return cls(recordings, why, by_differences=differences is not None)

    @cached_property
    def at(self) -> Mapping[int, Recording]:
        return {
            k: Recording(one.function, one.epochs[[i]], one.numbers[[i]])
            for one in self.recordings
            for i, k in enumerate(one.epochs.tolist())
        }

    def tried(self) -> list[int]:
        """Lists the first, the middle and the last epoch of each recording, or of all epochs if
        each is called by itself."""
        groups = [[*self.at]] if self.why else [one.epochs.tolist() for one in self.recordings]
        return [epochs[i] for epochs in groups for i in (0, len(epochs) // 2, -1)]

    def values(self, x: Array) -> Array:
        """Computes values (trials, K, m) at states x (trials, K, n) of the epochs."""
        return self._joined(x, lambda one, states: (one(states),))[0]

    def slopes(self, x: Array) -> tuple[Array, Array]:
        """Computes values (trials, K, m) and slopes (trials, K, m, n) likewise."""
        value, slope = self._joined(x, Recording.slope)
        return value, slope

    def _joined(
        self, x: Array, run: Callable[[Recording, Array], tuple[Array, ...]]
    ) -> list[Array]:
        """Runs each recording on all its epochs at once."""
        first = self.recordings[0]
        if len(self.recordings) == 1 and isinstance(first.function, RowFunction):
            return [*run(first, x)]
        out: list[Array] = []
        for one in self.recordings:
            found = run(one, x.take(one.epochs, axis=1))
            out = out or [np.empty((*x.shape[:2], *part.shape[2:])) for part in found]
            for whole, part in zip(out, found, strict=True):
                whole[:, one.epochs] = part
        return out


class _Written(NamedTuple):
    """Holds a function as it is recorded at one epoch."""

    y: Sequence[Expression]
    x: Sequence[Expression]
    form: tuple[Any, ...]
    """Its operations and outputs but for the values of constants, which are the same at epochs that
    can be joined."""
    constants: Sequence[float]

    @classmethod
    def of(cls, function: Function, n: int, k: int) -> _Written:
        graph = Graph(_MOST_OPERATIONS)
        x = graph.inputs("x", n)
        found = np.asarray(function(Recorded.of(x), k), dtype=object)[0]
        y = [graph.apply("add", one, 0.0) for one in found]
        program = Program.of(y, x)
        constants = [step[1] for step in program.operations if step[0] == "constant"]
        steps = (step[:1] if step[0] == "constant" else step for step in program.operations)
        return cls(y, x, (*steps, program.outputs), constants)


def recorded_by_epoch(
    function: Function, n: int, epochs: Sequence[int], alike: Callable[[int], int]
) -> list[Recording]:
    """Records a function of n states at each epoch, and joins epochs at which only its constants
    differ; `alike` names the epoch whose function that of another is.

    Raises:
        ValueError: it has too many operations or forms.
        Exception: the function does not take expressions.
    """
    forms: defaultdict[Any, dict[int, _Written]] = defaultdict(dict)
    known: dict[int, _Written] = {}
    operations = 0
    for k in epochs:
        first = alike(k)
        if first not in known:
            known[first] = _Written.of(function, n, k)
            operations += len(known[first].form)
        forms[known[first].form][k] = known[first]
        if len(forms) > _MOST_FORMS:
            raise ValueError(f"it has more than {_MOST_FORMS} forms over all epochs")
        if operations > _MOST_IN_ALL:
            raise ValueError(f"it has more than {_MOST_IN_ALL} operations over all epochs")
    return [_joined_form(epochs) for epochs in forms.values()]


def _joined_form(epochs: Mapping[int, _Written]) -> Recording:
    """Joins recordings of one form. All constants become numbers of the epoch, so that other values
    of a model's options need no other machine code."""
    y, x, _, first = next(iter(epochs.values()))
    graph = x[0].graph
    c = graph.inputs("c", len(first))
    given = {graph.constant(value): one for value, one in zip(first, c, strict=True)}
    function = RowFunction(RowPrograms.of(substitute(y, given), x, c))
    numbers = np.array([one.constants for one in epochs.values()], dtype=float)
    return Recording(function, np.array([*epochs]), numbers)


def functions_of(model: StateModel) -> tuple[EpochFunctions, EpochFunctions]:
    """Returns f and h of a model, recorded where they can be and then agree with the model's own on
    drawn paths."""
    every = range(model.epochs)
    moving = [k for k in every if model.moves(k)]
    f = _recorded(model, "transition", moving)
    h = _recorded(model, "observe", every)
    m, P = model.prior
    spread = root(P)
    draws = np.random.default_rng(0).standard_normal((_DRAWN, spread.shape[1]))
    x = m + multiply(spread, draws)
    sizes = deviations(P)
    sizes = np.where(sizes > 0, sizes, np.maximum(1.0, np.abs(m)))
    next_to_state = Differences(sizes, model.nearest_state)
    next_to_reading = Differences(sizes, model.nearest)
    tried = {k for each in (f, h) for k in each.tried()}
    with np.errstate(all="ignore"):
        for k in sorted(tried):
            if model.moves(k):
                f = _held(f, model.transition, k, x, next_to_state)
                x = model.transition(x, k)
            h = _held(h, model.observe, k, x, next_to_reading)
    still = EpochFunctions.by_epoch(lambda x, k: x, [k for k in every if k not in moving])
    return replace(f, recordings=[*still.recordings, *f.recordings]), h


def _recorded(model: StateModel, name: str, epochs: Sequence[int]) -> EpochFunctions:
    if not epochs:
        return EpochFunctions([])
    try:
        with np.errstate(all="ignore"):
            return EpochFunctions(model.recorded(name, epochs))
    except Exception as error:  # a model may raise anything where it meets no numbers
        return EpochFunctions.by_epoch(getattr(model, name), epochs, describe_exception(error))


def _held(
    functions: EpochFunctions, function: Function, k: int, x: Array, differences: Differences
) -> EpochFunctions:
    """Returns the functions; by epoch if that of epoch k differs from the model's own at x (trials,
    n), and by differences if complex steps do not find its slopes."""
    own = Own(function, k)
    analytic = own.is_analytic(x, differences)
    if not analytic:
        own = replace(own, differences=differences)
    if functions.why:
        if analytic or functions.by_differences:
            return functions
        return EpochFunctions.by_epoch(function, [*functions.at], functions.why, differences)
    found = functions.at[k].slope(x)
    right = own.slopes(x, x)
    within = _AGREES if analytic else _ROUGH
    if agree(found[0], right[0]) and agree(
        found[1].swapaxes(1, 2), right[1].swapaxes(1, 2), within
    ):
        return functions
    why = f"at epoch {k + 1} its recording differs from it by more than {_AGREES:g} of its size"
    return EpochFunctions.by_epoch(function, [*functions.at], why, own.differences)


def agree(values: Array, right: Array, within: float = _AGREES) -> bool:
    """Tells whether values (..., m) are the right ones within a part of their size, by default but
    for round-off."""
    size = np.abs(right).reshape(-1, right.shape[-1]).max(axis=0)
    size = np.maximum(size, _SMALL * size.max())
    return np.allclose(values / size, right / size, rtol=0, atol=within, equal_nan=True)
