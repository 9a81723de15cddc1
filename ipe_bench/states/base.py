"""State models, and the true paths and readings that are drawn from them."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np

from ipe_bench.basics.definitions import statement_of
from ipe_bench.basics.errors import UserError, unknown
from ipe_bench.basics.linalg import Array, Mask, multiply, nearest
from ipe_bench.basics.options import Component
from ipe_bench.basics.streams import numbered
from ipe_bench.functions.recording import NotRecorded
from ipe_bench.measurements.base import Parameter
from ipe_bench.states.algebra import factor, half, root, transposed
from ipe_bench.states.along import (
    Along,
    EpochFunctions,
    Forms,
    Recording,
    astray,
    functions_of,
    joined,
    renumbered,
    written_by_epoch,
)
from ipe_bench.states.student import Tails

_FUNCTIONS = ("transition", "observe")
_START, _PROCESS, _READINGS, _TAILS = range(4)
"""The random streams of a trial: its start, its process noise, the noise of its readings, and
how large the latter is."""


class Normal(NamedTuple):
    """Holds normal distributions, one per trial or one for all."""

    mean: Array
    """(..., n)"""
    covariance: Array
    """(..., n, n)"""


@dataclass(frozen=True)
class Paths:
    """Holds true paths and their readings, drawn from a state model."""

    start: Array
    """The states before the first transition (trials, n)."""
    x: Array
    """The states at the epochs (trials, K, n)."""
    z: Array
    """The readings (trials, K, m)."""


class FixedParts(NamedTuple):
    """Holds copies of those parts of a model that trackers take as numbers for all states."""

    mean: Array
    """(n,), of the prior"""
    P: Array
    """(n, n), its covariance"""
    gains: Array
    """G of the transition into each epoch (K, n, q), 0 where none leads; empty if it depends on the
    states."""
    covariances: Array
    """R of each epoch (K, m, m); empty if it depends on the states."""
    periods: Array
    state_periods: Array

    @classmethod
    def of(cls, model: StateModel) -> Self:
        epochs = np.arange(model.epochs)
        moving = epochs if model.moves(0) else epochs[1:]
        gains = np.empty(0)
        if not model.gain_by_state:
            moved = model.gains(moving)
            still = np.zeros((len(epochs) - len(moving), *moved.shape[1:]))
            gains = np.concatenate([still, moved])
        covariances = () if model.R_by_state else model.covariances(epochs)
        parts = *model.prior, gains, covariances, model.periods, model.state_periods
        return cls(*map(np.array, parts))

    def same(self, other: FixedParts) -> bool:
        return all(map(np.array_equal, self, other))


class Kept(dict[Any, Any]):
    """Holds what is made of a model for trackers, and stays behind where that leaves the
    process."""

    parts: FixedParts
    """Those that all this is made of."""

    def __reduce__(self) -> tuple[type[Kept], tuple[()]]:
        return Kept, ()


class Numbered(NamedTuple):
    """Holds the numbers of a recorded function."""

    epochs: Array
    """(e,)"""
    numbers: Array
    """(e, p)"""


class Fault(NamedTuple):
    """Holds what a state model refuses of a column of a log."""

    column: str
    where: Array
    """The refused rows (K,)."""
    reason: str
    """What is wrong, with the remedy."""


class StateModel(Component, ABC):
    """Describes states that move, and what is read of them at K epochs k = 0 ... K-1:

        x[k] = f(x[k-1], k) + G[k] w[k],   w[k] ~ N(0, I)
        z[k] = h(x[k], k) + v[k],          v[k] ~ N(0, R[k])

    Required: `states`, `times`, `prior`, `transition` (f), `observe` (h), `gain` (G) and `R`; if
    noise depends on the states, `gain_at(x, k)` in place of `gain(k)`, for the states x[k-1], or
    `R_at(x, k)` in place of `R(k)`. Optional: `moved_first`, `periods`, `state_periods`,
    `reading_names`, `degrees_of_freedom` and `scored`; `draw`, if paths are stored; `log_inputs`,
    `with_log` and `faults`, if a log has known inputs; `alike`, if a transition is long. Promised:
    f and h take stacks of states (..., n); a trial has the same bits alone and in any batch;
    `require_sound` finds nothing to refuse.

    Trackers run f and h as compiled code that is recorded from them with its slopes, if they depend
    on x and k alone and branch on no state (`np.where` is recorded); `remarks` says which ones run
    epoch by epoch, and why. The slopes of these are complex steps where differences do not
    contradict them, else differences.

    Process noise enters by its gain, so that a singular Q = G G' needs no special case. Known
    inputs and unequal steps follow from k. A measurement model with epochs is the state model whose
    states stand still.

    >>> from ipe_bench.states import ekf
    >>> @dataclass(frozen=True)
    ... class RandomWalk(StateModel):
    ...     states = (Parameter("p", "m"),)
    ...     times = np.arange(1.0, 21.0)
    ...     prior = Normal(np.zeros(1), np.eye(1))
    ...
    ...     def transition(self, x, k):
    ...         return x
    ...
    ...     def observe(self, x, k):
    ...         return x
    ...
    ...     def gain(self, k):
    ...         return np.eye(1)
    ...
    ...     def R(self, k):
    ...         return 4.0 * np.eye(1)
    >>> model = RandomWalk()
    >>> P = ekf().track(model, model.draw(0, 5).z).covariance[:, -1, 0, 0]
    >>> bool(np.allclose(P**2 + P, 4.0))  # the steady state P^2 + P Q = Q R
    True
    """

    moved_first: bool = True
    """Whether a transition lies between the prior and the first reading."""

    @property
    @abstractmethod
    def states(self) -> tuple[Parameter, ...]:
        """Names and units of the n states."""

    @property
    @abstractmethod
    def times(self) -> Array:
        """Times (K,) of the epochs in s."""

    @property
    @abstractmethod
    def prior(self) -> Normal:
        """Mean (n,) and covariance (n, n) before the first transition, or at the first reading if
        `moved_first` is false."""

    @abstractmethod
    def transition(self, x: Array, k: int) -> Array:
        """Computes f: (..., n) -> (..., n), from epoch k-1 to epoch k."""

    @abstractmethod
    def observe(self, x: Array, k: int) -> Array:
        """Computes h: (..., n) -> (..., m)."""

    def alike(self, k: int) -> int:
        """Returns an epoch into which the transition is the same function as into epoch k, by which
        it is recorded: k itself unless a model knows better, which saves recording a long
        transition again for each epoch."""
        return k

    def recorded(self, name: str, epochs: Sequence[int]) -> list[Recording]:
        """Records `transition` into these epochs, or `observe` at them; raises anything if it
        cannot be recorded."""
        return joined(self._written(name, epochs))

    def _written(self, name: str, epochs: Sequence[int]) -> Forms:
        alike = self.alike if name == "transition" else int
        return written_by_epoch(getattr(self, name), self.n, epochs, alike)

    @cached_property
    def _functions(self) -> tuple[StateModel, tuple[EpochFunctions, EpochFunctions]]:
        return self, functions_of(self)

    @property
    def epoch_functions(self) -> tuple[EpochFunctions, EpochFunctions]:
        """f and h for trackers: recorded and compiled if they can be."""
        # A copy with another prior or log begins with the functions of what it was copied from.
        if self._functions[0] is not self:
            del vars(self)["_functions"]
        return self._functions[1]

    def renew(self) -> None:
        """Forgets what is kept for trackers of a model that has changed since, such as by another
        number in a table or a dictionary that it takes numbers from."""
        if "_functions" in vars(self):
            self._renew_functions()
        if not self.passes:
            return
        same = FixedParts.of(self).same(self.passes.parts)
        if not same:
            # Functions, too, were tried at states of the prior.
            vars(self).pop("_functions", None)
        # What noise by state is elsewhere is not known.
        if not same or self.gain_by_state or self.R_by_state:
            del vars(self)["passes"]

    def _renew_functions(self) -> None:
        for name, functions in zip(_FUNCTIONS, self.epoch_functions, strict=True):
            try:
                again = renumbered(functions, self, name)
            except NotRecorded:
                again = None
            if again is None or not functions.same_numbers(again):
                del vars(self)["_functions"]
                return

    def with_numbers(self, options: Mapping[str, Any]) -> StateModel:
        """Returns the model with other values of options that are numbers. Its functions are taken
        to be as they were tried, with these numbers, if nothing else is recorded of them: a search
        tries many, and its end by itself."""
        other = self._with(options)
        try:
            pairs = zip(_FUNCTIONS, self.epoch_functions, strict=True)
            found = [renumbered(functions, other, name) for name, functions in pairs]
        except Exception:  # a model may raise anything where it meets no numbers
            return other
        if None not in found:
            vars(other)["_functions"] = other, tuple(found)
        return other

    def _with(self, options: Mapping[str, Any]) -> StateModel:
        return replace(self, **options)  # type: ignore[type-var]

    def recorded_numbers(self, name: str, epochs: Sequence[int]) -> Mapping[Any, Numbered]:
        """Returns, by what else is recorded, the epochs (e,) at which `transition` or `observe` is
        that, and their numbers (e, p)."""
        stated = statement_of(self), epochs
        before, found = self._recorded_as.get(name, (None, {}))
        if stated[0] and stated == before:
            return found
        found = {}
        for form, at in self._written(name, epochs).items():
            found[form] = Numbered(np.array([*at]), np.array([one.numbers for one in at.values()]))
        self._recorded_as[name] = stated, found
        return found

    @cached_property
    def _recorded_as(self) -> Kept:
        """The numbers of recorded functions, beside what the model stated by its options then."""
        return Kept()

    def astray(self, x: Array) -> Mask:
        """Finds the trials (trials,) with paths x (trials, 1 + K, n) at which recorded functions
        are not the model's own."""
        with np.errstate(all="ignore"):
            return astray(*self.epoch_functions, x)

    def by_epoch(self) -> StateModel:
        """Returns the model with functions that are called epoch by epoch."""
        f, h = self.epoch_functions
        other = copy.copy(self)
        vars(other)["_functions"] = other, (f.by_epoch(), h.by_epoch())
        return other

    def remarks(self) -> tuple[str, ...]:
        """Says how f and h are run that are not recorded, and why."""
        f, h = self.epoch_functions
        return tuple(filter(None, (f.way("transition"), h.way("observe"))))

    @cached_property
    def passes(self) -> Kept:
        """What trackers record of the model."""
        return Kept()

    def transition_into(self, k: int) -> Recording:
        """Returns f of the step into epoch k as a function of states (..., n) that knows its
        slopes, for trackers."""
        return self.epoch_functions[0].at[k]

    def observation_at(self, k: int) -> Recording:
        """Returns h at epoch k likewise."""
        return self.epoch_functions[1].at[k]

    def values_along(self, x: Array) -> tuple[Array, Array]:
        """Computes f (trials, K, n) and h (trials, K, m) as in `Along`, of paths x (trials, 1 + K,
        n) that begin before the first transition: `evaluations` for each trial."""
        f, h = self.epoch_functions
        return f.values(x[:, :-1]), h.values(x[:, 1:])

    def slopes_along(self, x: Array) -> Along:
        """Computes f and h with their slopes along paths x (trials, 1 + K, n) that begin before the
        first transition: 1 + n times `evaluations` for each trial."""
        f, h = self.epoch_functions
        moved, F = f.slopes(x[:, :-1])
        read, H = h.slopes(x[:, 1:])
        return Along(moved, read, F, H)

    def gain(self, k: int) -> Array:
        """Returns G (n, q) of the step into epoch k; UserError if it depends on the states."""
        raise self._by_state("gain")

    def gains(self, epochs: Array) -> Array:
        """Returns G (e, n, q) of the steps into these epochs (e,)."""
        each = [self.gain(k) for k in epochs.tolist()]
        return np.stack(each) if each else np.zeros((0, self.n, 0))

    def covariances(self, epochs: Array) -> Array:
        """Returns R (e, m, m) of the readings of these epochs (e,)."""
        return np.stack([self.R(k) for k in epochs.tolist()])

    def R(self, k: int) -> Array:
        """Returns the covariance (m, m) of the readings of epoch k; UserError if it depends on the
        states."""
        raise self._by_state("R")

    def _by_state(self, name: str) -> UserError:
        return UserError(
            f"state_model={self.name}: {name} depends on the states; "
            f"what takes {name}(k) does not suit it"
        )

    def gain_at(self, x: Array, k: int) -> Array:
        """Returns G (..., n, q) of the step into epoch k from each of the states x (..., n); (n, q)
        if it is that of all."""
        return self.gain(k)

    def R_at(self, x: Array, k: int) -> Array:
        """Returns R (..., m, m) of the readings of epoch k at each of the states x (..., n); (m, m)
        if it is that of all."""
        return self.R(k)

    @property
    def gain_by_state(self) -> bool:
        """Whether G depends on the states."""
        return type(self).gain_at is not StateModel.gain_at

    @property
    def R_by_state(self) -> bool:
        """Whether R depends on the states."""
        return type(self).R_at is not StateModel.R_at

    @property
    def periods(self) -> tuple[float, ...]:
        """The period of each reading, such as 2 pi of a bearing in rad; 0 for a reading without.
        Empty: none has."""
        return ()

    @property
    def state_periods(self) -> tuple[float, ...]:
        """The period of each state, such as 2 pi of a heading in rad; 0 for a state without. Empty:
        none has."""
        return ()

    @property
    def degrees_of_freedom(self) -> tuple[float, ...]:
        """The degrees of freedom of each reading whose noise is Student's t with the variance that
        R has; infinite if it is normal. Empty: all are normal."""
        return ()

    @property
    def readings_per_epoch(self) -> int:
        return np.shape(self.R_at(self.prior.mean[None], 0))[-1]

    @property
    def reading_names(self) -> tuple[str, ...]:
        """Names of the readings of an epoch: the columns of a log."""
        m = self.readings_per_epoch
        return ("reading",) if m == 1 else tuple(f"reading{i + 1}" for i in range(m))

    @property
    def transition_names(self) -> tuple[str, ...]:
        """Names of what `transition` returns, for messages."""
        return tuple(f"state {state.name} of transition" for state in self.states)

    @property
    def observe_names(self) -> tuple[str, ...]:
        """Names of what `observe` returns, likewise."""
        return tuple(f"{name} of observe" for name in self.reading_names)

    @property
    def log_inputs(self) -> tuple[str, ...]:
        """Names of the known inputs that a log has for each epoch, beside the readings; `time` in s
        is its times."""
        return ()

    def with_log(self, count: int, inputs: Mapping[str, Array]) -> StateModel:
        """Returns the model of a log of `count` epochs K, with its known inputs (K,)."""
        return self

    def faults(self, columns: Mapping[str, Array]) -> Iterable[Fault]:
        """Yields what the model refuses of the known inputs and readings (K,) of a log, by the
        names of its columns."""
        return ()

    @property
    def n(self) -> int:
        return len(self.states)

    @property
    def scored(self) -> tuple[str, ...]:
        """Names of the states by which trackers are scored, such as constants among states that
        move; empty: all."""
        return ()

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The states by which trackers are scored."""
        if not self.scored:
            return tuple(self.states)
        return tuple(state for state in self.states if state.name in self.scored)

    @property
    def m(self) -> int:
        """The number of readings of all epochs."""
        return self.epochs * self.readings_per_epoch

    @property
    def epochs(self) -> int:
        """K, the number of epochs."""
        return len(self.times)

    def moves(self, k: int) -> bool:
        """Tells whether a transition leads into epoch k."""
        return k > 0 or self.moved_first

    @property
    def evaluations(self) -> int:
        """Evaluations of f and of h along a path."""
        return 2 * self.epochs - (not self.moved_first)

    def Q(self, k: int) -> Array:
        """Returns the covariance (n, n) of the process noise of the step into epoch k."""
        G = self.gain(k)
        return G @ G.T

    def Q_at(self, x: Array, k: int) -> Array:
        """Returns Q (..., n, n) of the step into epoch k from each of the states x (..., n); (n, n)
        if it is that of all."""
        if not self.gain_by_state:
            return self.Q(k)
        G = self.gain_at(x, k)
        return np.matmul(G, transposed(G))

    def nearest(self, z: Array, to: Array) -> Array:
        """Returns z (..., m), each periodic reading shifted by whole periods next to that of `to`
        (..., m)."""
        return nearest(z, to, self.periods)

    def nearest_state(self, x: Array, to: Array) -> Array:
        """Returns x (..., n), each periodic state shifted by whole periods next to that of `to`
        (..., n)."""
        return nearest(x, to, self.state_periods)

    def observe_near(self, x: Array, k: int, to: Array) -> Array:
        """Computes h without jumps around readings `to` (trials, m), for x (trials, ..., n)."""
        h = self.observation_at(k)(x)
        between = (1,) * (x.ndim - to.ndim)
        to = to.reshape(to.shape[:1] + between + to.shape[1:])
        return self.nearest(h, to)

    def draw(self, start: int, stop: int, seed: int = 0) -> Paths:
        """Trials `start` to `stop`. Start, process noise and readings' noise have a stream each per
        trial: with another Q or R, or in another batch, a trial keeps its standard normal
        numbers."""
        K = self.epochs
        n = self.n
        m = self.readings_per_epoch
        q = self.gain_at(self.prior.mean[None], K - 1).shape[-1]
        trials = stop - start

        def normals(stream: int, *shape: int) -> Array:
            drawn = [g.standard_normal(shape) for g in numbered(seed, start, stop, stream)]
            return np.array(drawn).reshape(trials, *shape)

        # x0 = m0 + P0^1/2 u, with fewer columns where P0 is singular.
        spread = root(self.prior.covariance)
        u = normals(_START, n)[:, : spread.shape[1]]
        w = normals(_PROCESS, K, q)
        v = normals(_READINGS, K, m)
        for j, degrees in enumerate(self.degrees_of_freedom):
            if np.isfinite(degrees):
                # Of t it is v / sqrt(chi-square / nu), here of unit variance.
                streams = numbered(seed, start, stop, _TAILS + j)
                squares = np.array([g.chisquare(degrees, K) for g in streams])
                v[..., j] *= np.sqrt((degrees - 2) / squares.reshape(trials, K))
        x = self.prior.mean + multiply(spread, u)
        paths = Paths(start=x, x=np.empty((trials, K, n)), z=np.empty((trials, K, m)))
        for k in range(K):
            # x[k] = f(x[k-1]) + G w,  z[k] = h(x[k]) + R^1/2 v
            if self.moves(k):
                x = self.transition(x, k) + multiply(self.gain_at(x, k), w[:, k])
            paths.x[:, k] = x
            noise = multiply(factor(self.R_at(x, k)), v[:, k])
            paths.z[:, k] = self.observe(x, k) + noise
        return paths


def widened(model: StateModel, scale: float) -> StateModel:
    """Returns the model with the deviations of its prior multiplied by a scale: for the truth, and
    for every tracker.

    Raises:
        UserError: the model's paths are stored, and no prior is drawn from.
    """
    if scale == 1:
        return model
    if type(model).draw is not StateModel.draw:
        raise UserError(
            f"error_scale={scale:g}: state_model={model.name} has stored paths; "
            "leave error_scale out"
        )
    m, P = model.prior
    return _with(model, prior=_always(Normal(m, scale**2 * P)))


def beginning_at(model: StateModel, start: Array) -> StateModel:
    """Returns the model whose paths all begin at the states `start` (n,), before the first
    transition; it draws paths, and no tracker is told so.

    Raises:
        UserError: the model's paths are stored.
    """
    if type(model).draw is not StateModel.draw:
        raise UserError(f"state_model={model.name}: has stored paths, and draws none")
    return _with(model, prior=_always(Normal(start, np.zeros((model.n, model.n)))))


def told_alike(model: StateModel) -> StateModel:
    """Returns the model with normal readings that tell as much of the states as its own do on
    average, by their information: for bounds."""
    tails = Tails.of(model.degrees_of_freedom)
    if tails is None:
        return model
    size = np.sqrt(tails.information)
    scale = size[:, None] * size
    parts: dict[str, Any] = {"R": lambda self, k: scale * model.R(k)}
    parts["covariances"] = lambda self, epochs: scale * model.covariances(epochs)
    if model.R_by_state:
        parts["R_at"] = lambda self, x, k: scale * model.R_at(x, k)
    return _with(model, degrees_of_freedom=_always(()), **parts)


def _always(value: Any) -> Any:
    return property(lambda self: value)


def _with(model: StateModel, **parts: Any) -> StateModel:
    """Returns a copy of a model with other parts of its class."""
    same = {"__doc__": type(model).__doc__, "name": model.name}
    other = copy.copy(model)
    changed = type(type(model).__name__, (type(model),), {**same, **parts})
    object.__setattr__(other, "__class__", changed)
    return other


def require_sound(model: StateModel) -> None:
    """Raises UserError unless the parts of a model suit one another: times, prior, Q, R, f and
    h."""
    require_parts(model)
    for faults in (_time_faults, _shape_faults, _covariance_faults):
        for fault in faults(model):
            raise UserError(f"state_model={model.name}: {fault}")


def require_parts(model: StateModel) -> None:
    """Raises UserError unless the parts of a model are of the kinds that `StateModel` asks for, and
    have names of their own."""
    for faults in (_noise_faults, _kind_faults, _name_faults):
        for fault in faults(model):
            raise UserError(f"state_model={model.name}: {fault}")


def _kind_faults(model: StateModel) -> Iterator[str]:
    if not all(isinstance(state, Parameter) for state in model.states):
        yield "its states are not all parameters; write Parameter(NAME, UNIT) for each"
    if not isinstance(model.times, np.ndarray) or model.times.ndim != 1:
        yield "its times are no array (K,); write np.array([...]) with a time for each epoch"
    prior = model.prior
    if not isinstance(prior, Normal) or not all(isinstance(part, np.ndarray) for part in prior):
        yield "its prior is no Normal of arrays; write Normal(np.array([...]), np.diag([...]))"
    if not np.isfinite(prior.mean).all():
        yield "the mean of its prior is not finite; give another one"
    for name, by_state in (("gain", model.gain_by_state), ("R", model.R_by_state)):
        if by_state:
            continue
        if not callable(getattr(model, name)):
            yield f"its {name} is no function; write {name}(self, k)"
        if not isinstance(getattr(model, name)(0), np.ndarray):
            yield f"its {name}(0) is no array; write np.array([[...]])"


def _name_faults(model: StateModel) -> Iterator[str]:
    names = [state.name for state in model.states]
    for what, given in (("states", names), ("readings", list(model.reading_names))):
        for name in given:
            if given.count(name) > 1:
                yield f"two of its {what} have the name {name}; rename one"
    for name in model.scored:
        if name not in names:
            yield f"scored: {name}: {unknown(name, names, 'state')}"


def _time_faults(model: StateModel) -> Iterator[str]:
    if not model.epochs or not (np.diff(model.times) >= 0).all():
        yield "its times decrease from one epoch to the next; give epochs in order"


def _noise_faults(model: StateModel) -> Iterator[str]:
    for name in ("gain", "R"):
        methods = (name, f"{name}_at")
        if all(getattr(type(model), own) is getattr(StateModel, own) for own in methods):
            yield (
                f"it has no {name}; write {name}(k), or {name}_at(x, k) if it depends on the states"
            )


def _shape_faults(model: StateModel) -> Iterator[str]:
    n = model.n
    m = model.readings_per_epoch
    x = model.prior.mean
    last = model.epochs - 1
    periods = model.periods
    state_periods = model.state_periods
    degrees = model.degrees_of_freedom
    parts = [
        ("the mean of the prior", x, (n,)),
        ("f", model.transition(x[None], last), (1, n)),
        ("h", model.observe(x[None], 0), (1, m)),
        ("periods", periods, (m,) if periods else (0,)),
        ("degrees_of_freedom", degrees, (m,) if degrees else (0,)),
        ("reading_names", model.reading_names, (m,)),
        ("state_periods", state_periods, (n,) if state_periods else (0,)),
    ]
    for k in sorted({0, last}):
        # Its columns are as many as there are process noises, with a G for each state or for all.
        G = model.gain_at(x[None], k)
        stack = (1,) if model.gain_by_state else ()
        parts.append((f"the gain of epoch {k + 1}", G, (*stack, n, np.shape(G)[-1])))
    for what, value, shape in parts:
        if np.shape(value) != shape:
            yield f"{what} has shape {np.shape(value)}, where {shape} belongs"


def _covariance_faults(model: StateModel) -> Iterator[str]:
    n = model.n
    m = model.readings_per_epoch
    x = model.prior.mean[None]
    covariances = [("the covariance of the prior", model.prior.covariance, n)]
    for k in range(model.epochs):
        Q = model.Q_at(x, k)
        R = model.R_at(x, k)
        covariances.append((f"Q of epoch {k + 1}", Q[0] if model.gain_by_state else Q, n))
        covariances.append((f"R of epoch {k + 1}", R[0] if model.R_by_state else R, m))
    for what, P, size in covariances:
        fault = _fault(P, size, regular=what.startswith("R"))
        apart = np.array_equal(P, np.diag(np.diagonal(P)))
        if model.degrees_of_freedom and what.startswith("R") and not apart:
            fault = "is not diagonal; Student's t takes independent readings"
        if fault:
            yield f"{what} {fault}"


def _fault(P: Array, size: int, regular: bool) -> str | None:
    """Returns why P is no covariance (size, size), which has to be regular or may be singular."""
    if not np.isfinite(P).all():
        return "is not finite at the mean of the prior; give another mean or noise"
    if np.shape(P) != (size, size):
        return f"has shape {np.shape(P)}, where {(size, size)} belongs"
    if regular and half(P).singular:
        return "is singular; give every reading a standard deviation above 0"
    if not np.allclose(P, P.T, rtol=1e-9, atol=0):
        return "is not symmetric; give a covariance"
    round_off = 1e-12 * np.abs(P).max() * size
    if not np.linalg.eigvalsh(P)[0] >= -round_off:
        return "has a negative eigenvalue; give a covariance"
    return None
