"""Iterates any method on a batch of trials until each has an answer, or a failure that has a
name."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any, Generic, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.batches import gather, take
from ipe_bench.basics.linalg import Array, Mask
from ipe_bench.basics.statuses import Status
from ipe_bench.measurements.counted import CountingModel

FAR = 1e8
"""An iteration has diverged once its residual is this many times that of the start."""
TINY_STEP = 1e-3
"""Steps below this share of the tolerance, while the equation does not hold within it, mean a
stall."""


class IteratedSystem(Protocol):
    """Presents the equations of a batch of trials to the driver; a method asks for more."""

    @property
    def model(self) -> CountingModel:
        """The model, which counts evaluations and failures in its tally."""
        ...

    @property
    def rows(self) -> NDArray[np.intp]:
        """The places (trials,) of the trials in that tally."""
        ...

    def subset(self, kept: Mask) -> Self:
        """Returns the same equations for some of the trials."""
        ...


E = TypeVar("E", bound=IteratedSystem, contravariant=True)
S = TypeVar("S", bound=Any)
"""A state: a frozen dataclass whose fields are arrays with the trials in front, x (trials, n) among
them."""
R = TypeVar("R", bound=Any)


@dataclass(frozen=True)
class ConvergenceCheck:
    """Measures how far each trial has come after a step; every field is (trials,)."""

    size: Array
    """Residual of the equation in standard deviations; within the tolerance, the trial has
    converged."""
    growth: Array
    """A size that grows if the iteration diverges; not finite if the model or the algebra has
    overflowed."""
    moved: Array
    """The last step, in standard deviations; infinite before the first."""
    stuck: Mask | bool = False
    """True if the method itself knows that it gets no further."""
    ending: NDArray[Any] | Status = Status.STALLED
    """The status of a trial that is stuck, or whose steps have become tiny."""


class Method(ABC, Generic[E, S]):
    """A method that the driver iterates: where it begins, one step of it, and how far it has
    come."""

    @abstractmethod
    def begin(self, system: E, x: Array) -> S:
        """Returns the state at the start x (trials, n)."""

    @abstractmethod
    def step(self, system: E, state: S) -> S:
        """Returns the state after one more iteration."""

    @abstractmethod
    def check(self, system: E, before: S | None, state: S) -> ConvergenceCheck:
        """Measures how far the trials have come; `before` is the state of a step ago, None at the
        start."""


@dataclass(frozen=True)
class Limits:
    """Holds the limits of an iteration."""

    tolerance: float
    """A trial has converged once `ConvergenceCheck.size` is at most this."""
    max_iterations: int
    budget: float | None = None
    """Simulations that a trial may cost, a Jacobian counting n; None: no limit."""
    history: bool = False
    """Whether the iterates are kept."""


@dataclass(frozen=True)
class SolveResult(Generic[S]):
    """Holds the end of each trial's iteration."""

    state: S
    status: NDArray[np.int8]
    iterations: NDArray[np.int64]
    history: list[Array] | None
    """The iterates (iterations + 1, n) of each trial, if asked for."""

    @property
    def x(self) -> Array:
        return self.state.x

    @property
    def converged(self) -> Mask:
        return self.status == Status.CONVERGED


def iterate(equations: E, method: Method[E, S], start: Array | S, limits: Limits) -> SolveResult[S]:
    """Iterates from `start`, which is x (trials, n) or a state, until every trial has ended; those
    leave the batch."""
    state = method.begin(equations, start) if isinstance(start, np.ndarray) else start
    trials, n = state.x.shape
    tally = equations.model.tally
    active = np.arange(trials)
    status = np.full(trials, Status.RUNNING, np.int8)
    iterations = np.zeros(trials, np.int64)
    iterates = [[row] for row in state.x] if limits.history else None
    ended: list[tuple[NDArray[np.intp], S]] = []
    check = method.check(equations, None, state)
    begun = np.maximum(check.growth, 1.0)
    for iteration in range(limits.max_iterations + 1):
        if iteration:
            before = state
            state = method.step(equations, before)
            check = method.check(equations, before, state)
            iterations[active] = iteration
            if iterates is not None:
                for row, x in zip(active, state.x, strict=True):
                    iterates[row].append(x)
        rows = equations.rows
        spent = limits.budget is not None and tally.of_search(n)[rows] >= limits.budget
        # The first of these that holds is the end of a trial.
        endings: tuple[tuple[Any, Any], ...] = (
            (tally.failed(rows), Status.ERROR),
            (tally.singular[rows], Status.SINGULAR),
            (~np.isfinite(check.growth), Status.NONFINITE),
            (check.size <= limits.tolerance, Status.CONVERGED),
            (check.stuck, check.ending),
            (check.growth > FAR * begun, Status.DIVERGED),
            (check.moved < TINY_STEP * limits.tolerance, check.ending),
            (spent, Status.BUDGET),
            (iteration == limits.max_iterations, Status.MAX_ITERATIONS),
        )
        now = np.full(len(active), Status.RUNNING, np.int8)
        for holds, ending in reversed(endings):
            if np.count_nonzero(holds):
                now = np.where(holds, ending, now)
        status[active] = now
        going = now == Status.RUNNING
        if going.all():
            continue
        if not going.any():
            ended.append((active, state))
            break
        ended.append((active[~going], take(state, ~going)))
        active = active[going]
        begun = begun[going]
        equations = equations.subset(going)
        state = take(state, going)
    paths = None if iterates is None else [np.array(x) for x in iterates]
    return SolveResult(gather(ended) if ended else state, status, iterations, paths)


def continued(first: Any, second: R) -> R:
    """Joins the iterates of two iterations, results with `iterations` and `history`; all else is
    the second's."""
    history = second.history
    if history is not None:
        history = [np.concatenate([a, b[1:]]) for a, b in zip(first.history, history, strict=True)]
    iterations = first.iterations + second.iterations
    return replace(second, iterations=iterations, history=history)
