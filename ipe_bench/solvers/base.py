"""What a solver is: one step of an iterative root finder, on all trials of a batch at once.

A solver is a frozen dataclass with two methods, `init` and `step`, that read like its textbook page. The loop, the
stopping rules and the counting belong to the driver in `ipe_bench.ipe`; the model is reached through the system alone.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Protocol

from ipe_bench.linalg import Array, Mask


class System(Protocol):
    """A square system F(x) = 0 for each trial of a batch: all that a solver sees of the problem.

    x and F are (trials, n) in multiples of the parameters' units.
    """

    def F(self, x: Array) -> Array:
        """The residual at x; NaN where the model fails."""
        ...

    def J(self, x: Array) -> Array:
        """dF/dx (trials, n, n)."""
        ...

    def solve(self, A: Array, b: Array) -> Array:
        """A^-1 b for each trial: A (trials, n, n), b (trials, n). Where A is singular the trial ends as such."""
        ...

    def subset(self, kept: Mask) -> System:
        """The same system for some of its trials: a line search goes on with the rows that need it."""
        ...


@dataclass(frozen=True)
class State:
    """What a solver carries from step to step. Every field is an array with the trials axis in front, so that the
    driver can drop the trials that have finished; a solver with a memory adds fields in a subclass."""

    x: Array
    F: Array


class Solver(ABC):
    """One step of an iteration for F(x) = 0."""

    def init(self, system: System, x: Array, F: Array) -> State:
        """The state at the start x (trials, n), where the residual is F."""
        return State(x, F)

    @abstractmethod
    def step(self, system: System, state: State) -> State:
        """The state after one more iteration."""
