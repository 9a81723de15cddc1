"""Defines how a trial ends."""

from enum import IntEnum


class Status(IntEnum):
    """States how one trial ended; its `reason` explains it to a reader of the tables."""

    reason: str

    def __new__(cls, value: int, reason: str) -> "Status":
        member = int.__new__(cls, value)
        member._value_ = value
        member.reason = reason
        return member

    RUNNING = -1, "not finished"
    CONVERGED = 0, "the estimating equation is solved within the tolerance"
    STALLED = 1, "steps became tiny before the equation was solved"
    MAX_ITERATIONS = 2, "the iteration limit was reached"
    DIVERGED = 3, "the iterate left the model's valid region"
    NONFINITE = 4, "a reading or an estimate overflowed or was not a number"
    SINGULAR = 5, "a linear system had no unique solution"
    BUDGET = 6, "the budget of simulations was used up"
    ERROR = 7, "the estimator or the model raised an exception"
    NO_READINGS = 8, "the true parameters have no finite readings, so there is no estimate"

    def __str__(self) -> str:
        return self.label

    def __format__(self, spec: str) -> str:
        return format(self.label, spec)

    @property
    def label(self) -> str:
        """The name in tables: lower case."""
        return self.name.lower()
