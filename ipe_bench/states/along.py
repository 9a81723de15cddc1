"""The functions f and h of a state model with their slopes, at one epoch and along whole paths.

They are recorded once and run as compiled code along all epochs of all paths. What cannot be
recorded is called epoch by epoch, with slopes that are judged wherever they are used.
"""

from __future__ import annotations

import functools
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ipe_bench.basics.errors import UserError, describe_exception
from ipe_bench.basics.linalg import Array, Mask, deviations, multiply, own
from ipe_bench.engine.rows import RowFunction
from ipe_bench.functions.judged import Judged, judged, require_by_row, same_values
from ipe_bench.functions.recording import NotRecorded, Written, compiled_rows, written
from ipe_bench.states.algebra import root

if TYPE_CHECKING:
    from ipe_bench.states.base import StateModel

_MOST_IN_ALL = 200_000
"""Operations that are recorded of a function over all epochs at most, in a second or two."""
_MOST_FORMS = 8
"""Forms that a function may have over all epochs."""
_DRAWN = 3
"""Paths that are drawn to try a function."""
_CHECKED = 4
"""Epochs of a recording at which each path is checked once it has been tracked."""
Function = Callable[[Array, int], Array]
Forms = Mapping[Any, Mapping[int, Written]]
"""A function by its form and by epoch, as it is recorded."""


class AtEpoch(NamedTuple):
    """A function of states alone: f or h of one epoch."""

    function: Function
    k: int

    def __call__(self, x: Array) -> Array:
        return self.function(x, self.k)


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


class Recording(NamedTuple):
    """Holds a function of those epochs at which it is the same but for numbers."""

    function: RowFunction | Judged
    epochs: Array
    """(e,)"""
    numbers: Array
    """(e, p)"""
    ties: RowFunction | None = None
    """Equalities, 1 where they hold, on which a recorded function depends."""
    form: Any = None
    """What is recorded but for the numbers; None if that cannot change."""
    own: Sequence[Judged] = ()
    """The model's own function at each epoch, of a recorded one."""

    def at(self, i: int) -> Recording:
        """Returns the function of the epoch in that place."""
        place = slice(i, i + 1)
        numbers = self.numbers[place]
        return self._replace(epochs=self.epochs[place], numbers=numbers, own=self.own[place])

    @property
    def model(self) -> Callable[[Array], Array]:
        """The model's own function of one epoch, where that is known."""
        return self.own[0] if self.own else self

    def __call__(self, x: Array) -> Array:
        """Computes values (..., m) at states x (..., n) of one epoch, or (trials, e, m) at those
        (trials, e, n) of all."""
        rows = own(x.reshape(-1, x.shape[-1]))
        if isinstance(self.function, RowFunction):
            values = self.function(rows, self.numbers)
        else:
            values = self.function(rows)
        return values.reshape(*x.shape[:-1], values.shape[-1])

    def slope(self, x: Array) -> tuple[Array, Array]:
        """Computes values (..., m) and Jacobians (..., m, n) likewise."""
        *stack, n = x.shape
        rows = own(x.reshape(-1, n))
        if isinstance(self.function, RowFunction):
            values, slopes = self.function.slopes(rows, self.numbers)
            self._mend_ties(rows, slopes)
        else:
            values, slopes = self.function.slopes(rows)
        return values.reshape(*stack, values.shape[-1]), slopes.reshape(*stack, *slopes.shape[1:])

    def _mend_ties(self, rows: Array, slopes: Array) -> None:
        """Replaces slopes at points for which a branch of their own stands by differences."""
        if self.ties is None:
            return
        tied = np.flatnonzero(self.ties(rows, self.numbers).any(axis=1))
        for place, function in enumerate(self.own):
            here = tied[tied % len(self.own) == place]
            if here.size:
                # Many trials begin at the same point.
                points, each = np.unique(rows[here], axis=0, return_inverse=True)
                slopes[here] = function.differences(points)[each]


@dataclass(frozen=True)
class EpochFunctions:
    """f or h of a model at all epochs."""

    recordings: Sequence[Recording]
    why: str = ""
    """Why it is called epoch by epoch; empty if it is recorded."""
    why_differences: str = ""
    """Why its slopes are differences, if it is called epoch by epoch."""

    @property
    def compiled(self) -> bool:
        """Whether machine code alone gives its values and slopes."""
        return all(
            isinstance(one.function, RowFunction) and one.ties is None for one in self.recordings
        )

    @cached_property
    def at(self) -> Mapping[int, Recording]:
        return {k: one.at(i) for one in self.recordings for i, k in enumerate(one.epochs.tolist())}

    @cached_property
    def recorded_epochs(self) -> list[int]:
        """The epochs at which it is recorded, in order."""
        recorded = [one for one in self.recordings if isinstance(one.function, RowFunction)]
        return sorted(k for one in recorded for k in one.epochs.tolist())

    @cached_property
    def forms(self) -> set[Any]:
        """What is recorded of it but for numbers."""
        return {one.form for one in self.recordings if isinstance(one.function, RowFunction)}

    def places(self, K: int) -> tuple[Array, Array]:
        """Returns of each of K epochs (K,) which recording has it, and its place there."""
        which = np.zeros(K, dtype=int)
        place = np.zeros(K, dtype=int)
        for i, one in enumerate(self.recordings):
            which[one.epochs] = i
            place[one.epochs] = np.arange(len(one.epochs))
        return which, place

    def same_numbers(self, other: EpochFunctions) -> bool:
        pairs = zip(self.recordings, other.recordings, strict=True)
        return all(np.array_equal(one.numbers, again.numbers, True) for one, again in pairs)

    def way(self, name: str) -> str:
        """Says how the function of that name is run, and why not as machine code; empty if it is
        recorded."""
        if not self.why:
            return ""
        slopes = f"by differences, as {self.why_differences}"
        if not self.why_differences:
            slopes = "by complex steps"
        return f"{name} runs in Python epoch by epoch, with slopes {slopes}: {self.why}"

    def by_epoch(self, why: str = "") -> EpochFunctions:
        """Returns the model's own functions, called epoch by epoch."""
        none = np.empty((1, 0))
        recordings = []
        for one in self.recordings:
            for function, k in zip(one.own, one.epochs, strict=True):
                recordings.append(Recording(function, np.array([k]), none))
        return replace(self, recordings=recordings, why=why or self.why)

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


def written_by_epoch(
    function: Function, n: int, epochs: Sequence[int], alike: Callable[[int], int]
) -> Forms:
    """Records a function of n states at each epoch; `alike` names the epoch whose function that of
    another is.

    Raises:
        NotRecorded: it cannot be recorded, or has too many operations or forms.
    """
    forms: defaultdict[Any, dict[int, Written]] = defaultdict(dict)
    known: dict[int, Written] = {}
    operations = 0
    for k in epochs:
        first = alike(k)
        if first not in known:
            known[first] = written(AtEpoch(function, k), n)
            operations += len(known[first].form[0])
        forms[known[first].form][k] = known[first]
        if len(forms) > _MOST_FORMS:
            raise NotRecorded(f"it has more than {_MOST_FORMS} forms over all epochs")
        if operations > _MOST_IN_ALL:
            raise NotRecorded(f"it has more than {_MOST_IN_ALL} operations over all epochs")
    return forms


def joined(forms: Forms) -> list[Recording]:
    """Joins the epochs at which a function has one form; all its constants become numbers of the
    epoch."""
    recordings = []
    for form, epochs in forms.items():
        function, ties = compiled_rows(next(iter(epochs.values())))
        numbers = np.array([one.numbers for one in epochs.values()])
        recordings.append(Recording(function, np.array([*epochs]), numbers, ties, form))
    return recordings


def renumbered(functions: EpochFunctions, model: StateModel, name: str) -> EpochFunctions | None:
    """Returns the function of that name of a model that differs in numbers from the one whose
    functions these are; None if it differs in more.

    Raises:
        NotRecorded: it cannot be recorded any more.
    """
    epochs = functions.recorded_epochs
    numbers = model.recorded_numbers(name, epochs) if epochs else {}
    if functions.forms != set(numbers):
        return None
    function = getattr(model, name)
    recordings = []
    for one in functions.recordings:
        if isinstance(one.function, RowFunction):
            at, there = numbers[one.form]
            if not np.array_equal(at, one.epochs):
                return None
            recordings.append(one._replace(numbers=there, own=_OfModel(one.own, function)))
        else:
            recordings.append(one._replace(function=_of_model(one.function, function)))
    return replace(functions, recordings=recordings)


class _OfModel(Sequence[Judged]):
    """Functions of epochs with another model's in their places, each made where it is asked for."""

    def __init__(self, own: Sequence[Judged], function: Function) -> None:
        self.own = own
        self.function = function

    def __len__(self) -> int:
        return len(self.own)

    def __getitem__(self, i: Any) -> Any:
        if isinstance(i, slice):
            return _OfModel(self.own[i], self.function)
        return _of_model(self.own[i], self.function)


def _of_model(own: Judged, function: Function) -> Judged:
    """Returns a function of an epoch with another model's in its place, judged as it was."""
    if not isinstance(own.function, AtEpoch):
        return own
    return replace(own, function=AtEpoch(function, own.function.k))


def functions_of(model: StateModel) -> tuple[EpochFunctions, EpochFunctions]:
    """Returns f and h of a model: recorded where they can be, and then have the values and slopes
    of the model's own at all points that are tried.

    Raises:
        UserError: one of them is random, or mixes states of different trials.
    """
    every = range(model.epochs)
    moving = [k for k in every if model.moves(k)]
    m, P = model.prior
    sizes = deviations(P)
    sizes = np.where(sizes > 0, sizes, np.maximum(1.0, np.abs(m)))
    f = _Side(model, "transition", moving, sizes, model.nearest_state)
    h = _Side(model, "observe", every, sizes, model.nearest)
    spread = root(P)
    draws = np.random.default_rng(0).standard_normal((_DRAWN, spread.shape[1]))
    aside = np.diag(deviations(P))
    x = np.concatenate([m[None], m + aside, m - aside, m + multiply(spread, draws)])
    with np.errstate(all="ignore"):
        for k in sorted({*f.functions.tried(), *h.functions.tried()}):
            if model.moves(k):
                f.hold(k, x)
                x = model.transition(x, k)
            h.hold(k, x)
    still = [k for k in every if k not in moving]
    resting = [_resting(k, sizes) for k in still]
    return replace(f.functions, recordings=[*resting, *f.functions.recordings]), h.functions


def _resting(k: int, sizes: Array) -> Recording:
    return Recording(Judged(_unmoved, sizes), np.array([k]), np.empty((1, 0)))


def _unmoved(x: Array) -> Array:
    return x


class _Side:
    """One function of a model while it is tried."""

    def __init__(
        self,
        model: StateModel,
        name: str,
        epochs: Sequence[int],
        sizes: Array,
        near: Callable[[Array, Array], Array],
    ) -> None:
        self.name = f"state_model={model.name}: {name}"
        function = getattr(model, name)
        self.own = {k: Judged(AtEpoch(function, k), sizes, near) for k in epochs}
        if not epochs:
            self.functions = EpochFunctions([])
            return
        try:
            with np.errstate(all="ignore"):
                recordings = model.recorded(name, epochs)
        except UserError:
            raise
        except NotRecorded as error:
            self._call_by_epoch(str(error))
        except Exception as error:  # a model may raise anything where it meets no numbers
            self._call_by_epoch(describe_exception(error))
        else:
            each = [one._replace(own=[self.own[k] for k in one.epochs]) for one in recordings]
            self.functions = EpochFunctions(each)

    def _call_by_epoch(self, why: str, as_found: Judged | None = None) -> None:
        """Calls the model's own function epoch by epoch, with slopes as they were found best."""
        if as_found:
            how = {part: getattr(as_found, part) for part in ("why", "noise", "within", "steps")}
            self.own = {k: replace(one, **how) for k, one in self.own.items()}
        none = np.empty((1, 0))
        recordings = [Recording(one, np.array([k]), none) for k, one in self.own.items()]
        self.functions = EpochFunctions(recordings, why, as_found.why if as_found else "")

    def hold(self, k: int, x: Array) -> None:
        """Tries the function of epoch k at points x (points, n), of which the first is the mean."""
        if k not in self.own:
            return
        one = self.own[k]
        if not self.functions.why:
            require_by_row(one.function, x, self.name)
            why = _unlike(self.functions.at[k], one, x)
            if not why:
                return
            self._call_by_epoch(f"at epoch {k + 1} its recording has {why}")
        found = judged(one.function, x, one.scale, one.near, self.name)
        if self.functions.why_differences:
            return
        noise = max(found.noise, one.noise)
        within = max(found.within, one.within)
        # Steps of a rough function were found once, and hold where few differences do not.
        steps = one.steps if found.steps is None else found.steps
        how = {"noise": noise, "within": within, "steps": steps}
        self._call_by_epoch(self.functions.why, replace(found, **how))


def _unlike(recorded: Recording, own: Judged, x: Array) -> str:
    """Says in what a recorded function differs from the model's own at points x (points, n), at 0
    or where nothing is a number; empty if in nothing."""
    odd = np.vstack([x, np.zeros(x.shape[1]), np.full(x.shape[1], np.nan)])
    if not same_values(recorded(odd), own(odd)):
        return "other values"
    value, J = recorded.slope(x)
    wrong = own.wrong(x, value, J)
    wrong[0] |= own.contradicted(x[:1], J[:1])[0]
    # A point without finite slopes may never be met, but for the mean.
    wrong[1:] &= np.isfinite(J[1:]).all(axis=(1, 2))
    return "other slopes" if wrong.any() else ""


def astray(f: EpochFunctions, h: EpochFunctions, x: Array) -> Mask:
    """Finds the paths (trials,) among x (trials, 1 + K, n) at which recorded functions have not the
    values and slopes of the model's own: at some epochs of each path, and where it is lost."""
    wrong = np.zeros(len(x), dtype=bool)
    if f.forms | h.forms <= {None}:
        return wrong
    for functions, states in ((f, x[:, :-1]), (h, x[:, 1:])):
        known = np.asarray(np.isfinite(states).all(axis=2))
        for one in functions.recordings:
            for i in _checked(len(one.epochs)):
                k = one.epochs[i]
                rows = np.flatnonzero(known[:, k] & ~wrong)
                wrong[rows] = _differs(one.at(i), states[rows, k])
    for k, rows in lost(x):
        here = x[rows, k]
        wrong[rows] |= _differs(f.at[k], here)
        moved = own(f.at[k].model(here))
        found = np.flatnonzero(np.isfinite(moved).all(axis=1))
        wrong[rows[found]] |= _differs(h.at[k], moved[found])
    return wrong


@functools.cache
def _checked(epochs: int) -> list[int]:
    """Returns the places of some of so many epochs."""
    places = np.linspace(0, epochs - 1, _CHECKED)
    return np.unique(places.astype(int)).tolist()


def lost(x: Array) -> Iterator[tuple[int, Array]]:
    """Yields epochs k and those paths among x (trials, 1 + K, n) that are finite before epoch k and
    not from there on."""
    bad = ~np.isfinite(x).all(axis=-1)
    first = np.where(bad.any(axis=-1), bad.argmax(axis=-1) - 1, -1)
    for k in np.unique(first[first >= 0]).tolist():
        yield k, np.flatnonzero(first == k)


def _differs(one: Recording, x: Array) -> Mask:
    """Finds the states x (trials, n) at which the function of an epoch is not the model's own."""
    if one.form is None or not len(x):
        return np.zeros(len(x), dtype=bool)
    rows = own(x)
    value, J = one.slope(rows)
    return one.own[0].wrong(rows, value, J)
