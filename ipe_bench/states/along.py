"""The functions f and h of a state model with their slopes, at one epoch and along whole paths.

They are recorded once and run as compiled code along all epochs of all paths. What cannot be recorded is called epoch
by epoch, with slopes by complex steps.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ipe_bench.basics.errors import describe_exception
from ipe_bench.basics.linalg import Array, multiply, own
from ipe_bench.engine.rows import RowFunction
from ipe_bench.engine.trace import Expression, Graph, Program, Recorded, substituted
from ipe_bench.measurements.base import differentiate
from ipe_bench.states.algebra import root

if TYPE_CHECKING:
    from ipe_bench.states.base import StateModel

_MOST_OPERATIONS, _MOST_FORMS = 50_000, 8
"""Operations that are recorded at most of a function over all epochs, and forms that it may have there."""
_DRAWN = 3
"""Paths on which a recorded function is held against the model's own."""
_AGREES, _ROUND_OFF = 1e-10, 1e-16
"""Parts of the largest value of an output, and of all outputs, by which these may differ."""
Function = Callable[[Array, int], Array]


class Along(NamedTuple):
    """Holds f and h of a state model along paths of K epochs, with their slopes."""

    f: Array
    """f of the states before each epoch (trials, K, n); those states themselves if no transition leads there."""
    h: Array
    """h of the states at each epoch (trials, K, m)."""
    F: Array
    """df/dx (trials, K, n, n)."""
    H: Array
    """dh/dx (trials, K, m, n)."""


class Recording(NamedTuple):
    """Holds a recorded function of those epochs at which it is the same but for numbers."""

    function: RowFunction
    epochs: Array
    """(e,)"""
    numbers: Array
    """(e, p)"""


@dataclass(frozen=True)
class AtEpoch:
    """A function of states x (..., n) at one epoch, which knows its slopes."""

    function: Function
    k: int
    recorded: Recording | None = None
    """That of this epoch alone."""

    def __call__(self, x: Array) -> Array:
        if self.recorded is None or x.dtype.kind == "c":
            return self.function(x, self.k)
        rows = own(x.reshape(-1, x.shape[-1]))
        values = self.recorded.function(rows, self.recorded.numbers)
        return values.reshape(*x.shape[:-1], -1)

    def slope(self, x: Array) -> tuple[Array, Array]:
        """Computes value (trials, m) and Jacobian (trials, m, n) at x (trials, n)."""
        if self.recorded is None:
            return self(x), differentiate(self, x, analytic=True)
        return self.recorded.function.slopes(own(x), self.recorded.numbers)


@dataclass(frozen=True)
class EpochFunctions:
    """f or h of a model at the epochs that have it."""

    function: Function
    epochs: Sequence[int]
    recordings: Sequence[Recording] = ()
    """Those of all epochs, or none."""
    why: str = ""
    """Why there are none."""

    @cached_property
    def at(self) -> Mapping[int, AtEpoch]:
        found = {k: AtEpoch(self.function, k) for k in self.epochs}
        for recorded, epochs, numbers in self.recordings:
            for i, k in enumerate(epochs.tolist()):
                one = Recording(recorded, epochs[i : i + 1], numbers[i : i + 1])
                found[k] = AtEpoch(self.function, k, one)
        return found

    def held(self, k: int, x: Array) -> EpochFunctions:
        """Returns these functions, without recordings if that of epoch k differs from the function at x (trials, n)."""
        one = self.at[k]
        if one.recorded is None:
            return self
        value, slope = AtEpoch(self.function, k).slope(x)
        recorded = one.slope(x)
        if agree(one(x), value) and agree(recorded[0], value) and agree(recorded[1], slope):
            return self
        why = f"at epoch {k + 1} its recording differs from it by more than {_AGREES:g} of its size"
        return EpochFunctions(self.function, self.epochs, why=why)

    def values(self, x: Array) -> Array:
        """Computes values (trials, e, m) at states x (trials, e, n) of the epochs."""
        if not self.recordings:
            parts = [self.at[k](x[:, i]) for i, k in enumerate(self.epochs)]
            return np.stack(parts, axis=1) if parts else x
        return self._joined(x, lambda one, rows: (one.function(rows, one.numbers),))[0]

    def slopes(self, x: Array) -> tuple[Array, Array]:
        """Computes values (trials, e, m) and slopes (trials, e, m, n) likewise."""
        if not self.epochs:
            return x, np.empty((*x.shape, x.shape[-1]))
        if not self.recordings:
            parts = [self.at[k].slope(x[:, i]) for i, k in enumerate(self.epochs)]
            value, slope = (np.stack(part, axis=1) for part in zip(*parts, strict=True))
            return value, slope
        value, slope = self._joined(x, lambda one, rows: one.function.slopes(rows, one.numbers))
        return value, slope

    def _joined(
        self, x: Array, run: Callable[[Recording, Array], tuple[Array, ...]]
    ) -> list[Array]:
        """Runs each recording on all its epochs at once."""
        trials, e, n = x.shape
        out: list[Array] = []
        for one in self.recordings:
            places = one.epochs - self.epochs[0]
            rows = own(x[:, places].reshape(-1, n))
            found = [part.reshape(trials, len(places), *part.shape[1:]) for part in run(one, rows)]
            if len(places) == e:
                return found
            out = out or [np.empty((trials, e, *part.shape[2:])) for part in found]
            for whole, part in zip(out, found, strict=True):
                whole[:, places] = part
        return out


def recorded_by_epoch(
    function: Function, n: int, epochs: Sequence[int], alike: Callable[[int], int]
) -> list[Recording]:
    """Records a function of n states at each epoch, and joins epochs at which only its constants differ; `alike` names
    the epoch whose function that of another is.

    Raises:
        ValueError: it has too many operations or forms.
        Exception: the function does not take expressions.
    """
    forms: defaultdict[Any, list[tuple[int, Any, list[float]]]] = defaultdict(list)
    known: dict[int, tuple[Any, Any, list[float]]] = {}
    operations = 0
    for k in epochs:
        first = alike(k)
        if first not in known:
            y, x = _record(function, n, k)
            program = Program.of(y, x)
            operations += len(program.operations)
            if operations > _MOST_OPERATIONS:
                raise ValueError(f"it has more than {_MOST_OPERATIONS} operations over all epochs")
            steps = [step for step in program.operations if step[0] == "constant"]
            form = [step[:1] if step[0] == "constant" else step for step in program.operations]
            known[first] = (*form, program.outputs), (y, x), [value for _, value in steps]
        form, written, constants = known[first]
        forms[form].append((k, written, constants))
        if len(forms) > _MOST_FORMS:
            raise ValueError(f"it has more than {_MOST_FORMS} forms over all epochs")
    return [_joined_form(epochs) for epochs in forms.values()]


def _record(function: Function, n: int, k: int) -> tuple[list[Expression], list[Expression]]:
    """Records the function at one epoch: its outputs and its n inputs."""
    graph = Graph()
    x = graph.inputs("x", n)
    y = np.asarray(function(Recorded.of(x), k), dtype=object)
    return [graph.apply("add", one, 0.0) for one in y[0]], list(x)


def _joined_form(epochs: Sequence[tuple[int, Any, list[float]]]) -> Recording:
    """Joins recordings of one form. All constants become numbers of the epoch, so that other values of a model's
    options need no other machine code."""
    _, (y, x), first = epochs[0]
    graph = x[0].graph
    c = list(graph.inputs("c", len(first)))
    given = {graph.constant(value): one for value, one in zip(first, c, strict=True)}
    function = RowFunction.of(substituted(y, given), x, c)
    places = np.array([k for k, *_ in epochs])
    numbers = np.array([constants for *_, constants in epochs]).reshape(len(epochs), -1)
    return Recording(function, places, numbers)


def functions_of(model: StateModel) -> tuple[EpochFunctions, EpochFunctions]:
    """Returns f and h of a model, recorded where they can be and then agree with the model's own on drawn paths."""
    moving = range(0 if model.moved_first else 1, model.epochs)
    f = _recorded(model.transition, moving, lambda: model.recorded_transition(moving))
    reading = range(model.epochs)
    h = _recorded(model.observe, reading, lambda: model.recorded_observation(reading))
    return _held(model, f, h)


def _recorded(
    function: Function, epochs: Sequence[int], record: Callable[[], list[Recording]]
) -> EpochFunctions:
    if not epochs:
        return EpochFunctions(function, epochs)
    try:
        with np.errstate(all="ignore"):
            return EpochFunctions(function, epochs, record())
    except Exception as error:  # a model may raise anything where it meets no numbers
        return EpochFunctions(function, epochs, why=describe_exception(error))


def _held(
    model: StateModel, f: EpochFunctions, h: EpochFunctions
) -> tuple[EpochFunctions, EpochFunctions]:
    """Returns f and h, without recordings that differ from the model's own function at some epochs of drawn paths."""
    m, P = model.prior
    spread = root(P)
    draws = np.random.default_rng(0).standard_normal((_DRAWN, spread.shape[1]))
    x = m + multiply(spread, draws)
    tried = {k for one in (*f.recordings, *h.recordings) for k in _some(one.epochs)}
    with np.errstate(all="ignore"):
        for k in sorted(tried):
            if k in f.at:
                f = f.held(k, x)
                x = model.transition(x, k)
            h = h.held(k, x)
    return f, h


def _some(epochs: Array) -> list[int]:
    """Returns the first, a middle and the last one."""
    return epochs[[0, len(epochs) // 2, -1]].tolist()


def agree(values: Array, own: Array) -> bool:
    """Tells whether values (trials, m, ...) are those of the model's own function but for round-off."""
    size = np.abs(np.nan_to_num(own)).reshape(len(own), own.shape[1], -1).max(axis=(0, 2))
    allowed = _AGREES * size + _ROUND_OFF * size.max()
    allowed = allowed.reshape(-1, *[1] * (own.ndim - 2))
    same = (values == own) | (np.isnan(values) & np.isnan(own))
    return bool((same | (np.abs(values - own) <= allowed)).all())
