"""Defines an estimator: readings of many trials in, estimates of many trials out."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.batches import join
from ipe_bench.basics.errors import UserError, describe_exception, one_line
from ipe_bench.basics.linalg import Array, plain_numbers, read_only
from ipe_bench.basics.options import Component
from ipe_bench.basics.statuses import Status

if TYPE_CHECKING:
    from ipe_bench.measurements.counted import EvaluationCount
    from ipe_bench.measurements.problem import Problem

Need = Literal["differential equations", "epochs", "prior"]
Family = Literal["IPE", "filters", "least squares", "ensembles"]
Equation = Literal["frozen", "least_squares", "map"]
_NEEDED = {"epochs": "an order of the readings in time"}
"""Needs in the words of a message, where these are others."""
_ENDED = [status.value for status in Status if status != Status.RUNNING]
_MOST = 1e15
"""More iterations than any clock allows, and fewer than where floats skip whole numbers."""


@dataclass
class Estimates:
    """The result of a batch; every field has a leading trials axis.

    Example:

    >>> import ipe_bench as ib
    >>> bench = ib.Scenario(ib.measurements.Ranging(), ib.noise.Gaussian(0.1), error_scale=10.0)
    >>> found = ib.baselines.LevenbergMarquardt().estimate(bench.problem, bench.draw(0, 3).z)
    >>> print(found.x.shape, found.covariance.shape, (found.status == ib.Status.CONVERGED).all())
    (3, 4) (3, 4, 4) True
    """

    x: Array
    """(trials, n), in multiples of the parameters' units; the last iterate if the status is not
    converged."""
    status: NDArray[np.int8]
    covariance: Array | None = None
    """(trials, n, n): the covariance that the estimator itself reports."""
    iterations: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    simulations: Array = field(default_factory=lambda: np.zeros(0))
    """Evaluations of h per trial; a prefix of the epochs counts as its share."""
    jacobians: Array = field(default_factory=lambda: np.zeros(0))
    """Evaluations of dh/dx per trial, likewise."""
    messages: dict[int, str] = field(default_factory=dict)
    """The reason of a failure, by trial within the batch."""
    seconds: Array = field(default_factory=lambda: np.zeros(0))
    """Computing time per trial; a batch's time is shared evenly."""
    history: list[Array] | None = None
    """The iterates (iterations + 1, n) of each trial, if asked for."""
    extras: dict[str, Array] = field(default_factory=dict)
    """Further numbers per trial (trials,) that this estimator reports, by name: NIS of a filter,
    say."""
    alternatives: list[Array] | None = None
    """The other answers (count, n) that fit the readings of each trial as well, of estimators that
    look for them."""

    def __post_init__(self) -> None:
        for name in ("iterations", "simulations", "jacobians", "seconds"):
            values = getattr(self, name)
            if not len(values):
                setattr(self, name, np.zeros(len(self.x), values.dtype))

    @classmethod
    def of(cls, ended: Any, tally: EvaluationCount, **further: Any) -> Estimates:
        """Makes the estimates of an ended iteration, with its cost; `further` are fields of the
        estimator's own."""
        counts = {"simulations": tally.simulations.copy(), "jacobians": tally.jacobians.copy()}
        found = {
            "x": ended.x,
            "status": ended.status,
            "iterations": ended.iterations,
            "history": ended.history,
        }
        return cls(**{**found, **counts, "messages": dict(tally.messages), **further})

    @classmethod
    def join(cls, parts: Sequence[Estimates]) -> Estimates:
        """Joins batches one after another; what trials lack that others have is NaN, and none in
        their lists."""
        messages: dict[int, str] = {}
        start = 0
        for part in parts:
            messages |= {start + i: message for i, message in part.messages.items()}
            start += len(part.x)
        joined = join([replace(part, messages={}) for part in parts])
        return replace(joined, messages=messages)

    @classmethod
    def failed(cls, trials: int, n: int, message: str) -> Estimates:
        """Makes the estimates of trials that ended in an exception."""
        status = np.full(trials, Status.ERROR, dtype=np.int8)
        messages = dict.fromkeys(range(trials), message)
        return cls(np.full((trials, n), np.nan), status, messages=messages)


class Estimator(Component, ABC):
    """Turns readings into parameters: a frozen dataclass of its options.

    Required: `estimate`. Optional: `needs`, `equation`, `family`, `look`, and `hindrance`, asked
    before any work. Promised: a trial has the same bits alone and in any batch, its random numbers
    included, so products are stacked `matmul` or `einsum`; a trial that fails ends with a status,
    or raises if it is alone, and disturbs no other; a UserError is raised if no trial can be
    estimated, and ends the run; readings that are not finite end as `Status.NONFINITE`; readings
    and problem are not written into.

    >>> import ipe_bench as ib
    >>> @dataclass(frozen=True)
    ... class Nominal(ib.Estimator):
    ...     def estimate(self, problem, z, *, history=False):
    ...         x = np.repeat(problem.x0[None], len(z), axis=0)
    ...         return ib.Estimates(x=x, status=np.full(len(z), ib.Status.CONVERGED))
    >>> scenario = ib.Scenario(ib.measurements.Polynomial(), ib.noise.Gaussian(0.01))
    >>> print(Nominal().estimate(scenario.problem, scenario.draw(0, 2).z).x)
    [[0. 0. 0. 0.]
     [0. 0. 0. 0.]]
    """

    needs: ClassVar[frozenset[Need]] = frozenset()
    """What a problem must have for this estimator to run: epochs, a prior, a model by differential
    equations."""
    equation: ClassVar[Equation | None] = None
    """The estimating equation whose root is sought: with the frozen H (eq. 11), of least squares,
    or of the maximum a posteriori; None if an estimate is no root of anything. Bounds and
    first-order covariances follow from it."""
    family: ClassVar[Family | None] = None
    """The kind of estimator that it is shown with; None if its needs and its equation say: those
    that take epochs are filters, those that seek the root of the frozen H are IPE, and all others
    are least squares."""
    look: ClassVar[tuple[str, str] | None] = None
    """Colour and marker in every figure, in matplotlib's words such as `("#c51b7d", "s")`; None:
    one of the pool."""

    @abstractmethod
    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        """Estimates the parameters from readings z (trials, m); `history` asks for the iterates as
        well."""

    def hindrance(self, problem: Problem) -> str | None:
        """Says, in words that follow the estimator's label, why it does not suit the problem; None
        if it does."""
        has = {
            "differential equations": problem.measurement.by_differential_equations,
            "epochs": problem.measurement.epochs is not None,
            "prior": problem.prior_deviation is not None,
        }
        lacking = " and ".join(
            _NEEDED.get(need, need) for need in sorted(self.needs) if not has[need]
        )
        if not lacking:
            return None
        return f"needs {lacking}, which measurement={problem.measurement.name} does not have"

    def require_suited(self, problem: Problem) -> None:
        """Raises UserError if there is a hindrance."""
        why = self.hindrance(problem)
        if why:
            raise UserError(f"{self.name}: {why}")


def estimate_safely(
    estimator: Estimator, problem: Problem, z: Array, *, history: bool = False
) -> Estimates:
    """Calls `estimator.estimate`, timed; an exception becomes the status of the trials that cause
    it.

    A batch that raises is estimated again trial by trial. Readings and problem are read-only. A
    UserError, which concerns the estimator with all its trials, and a MemoryError, which concerns
    the machine, are raised.
    """
    began = time.perf_counter()
    z = read_only(z)
    try:
        with np.errstate(all="ignore"):
            estimates = estimator.estimate(problem, z, history=history)
    except (MemoryError, UserError):
        raise  # the block fails and is tried again another day; or the run ends in a line
    except Exception as error:
        if len(z) == 1:
            return Estimates.failed(1, problem.measurement.n, describe_exception(error))
        alone = [estimate_safely(estimator, problem, row[None], history=history) for row in z]
        return Estimates.join(alone)
    _make_plain(estimator, estimates, len(z), problem.measurement.n)
    if not estimates.seconds.any():
        seconds = time.perf_counter() - began
        estimates.seconds = np.full(len(z), seconds / max(1, len(z)))
    return estimates


def _make_plain(estimator: Estimator, estimates: Any, trials: int, n: int) -> None:
    """Replaces what an estimator returned by ordinary arrays of floats and lines of text.

    Raises:
        ValueError: it is not what is asked for; nothing is broadcast over trials.
    """
    name = f"{type(estimator).__name__}.estimate returns"
    if not isinstance(estimates, Estimates):
        raise ValueError(f"{name} {type(estimates).__name__}, where Estimates are asked for")
    estimates.x = plain_numbers(f"{name} x", estimates.x, (trials, n))
    if estimates.covariance is not None:
        estimates.covariance = plain_numbers(
            f"{name} covariance", estimates.covariance, (trials, n, n)
        )
    for part in ("status", "iterations", "simulations", "jacobians", "seconds"):
        setattr(estimates, part, plain_counts(name, part, getattr(estimates, part), trials))
    estimates.extras = {
        k: plain_numbers(f"{name} {k}", values, (trials,)) for k, values in estimates.extras.items()
    }
    for part in ("history", "alternatives"):
        each = getattr(estimates, part)
        if each is None:
            continue
        if len(each) != trials:
            raise ValueError(f"{name} {part} of {len(each)} trials, where {trials} belong")
        plain = [plain_numbers(f"{name} {part}", x, (len(x), n)) for x in each]
        setattr(estimates, part, plain)
    estimates.messages = {trial: one_line(message) for trial, message in estimates.messages.items()}


def plain_counts(name: str, part: str, values: Any, trials: int) -> Any:
    """Returns statuses, iterations, evaluations or seconds (trials,) as ordinary arrays;
    ValueError, which begins with `name`, if they cannot be such."""
    values = plain_numbers(f"{name} {part}", values, (trials,))
    if part == "status" and not np.isin(values, _ENDED).all():
        raise ValueError(
            f"{name} a status that is not one of ipe_bench.Status, or means that it has not ended"
        )
    if not (np.isfinite(values) & (values >= 0)).all():
        raise ValueError(f"{name} {part} that are not finite numbers from 0 up")
    if part == "iterations" and ((values != np.rint(values)) | (values > _MOST)).any():
        raise ValueError(f"{name} iterations that are not whole numbers up to {_MOST:g}")
    return values.astype({"status": np.int8, "iterations": np.int64}.get(part, float))


def one_by_one(trials: Iterable[Any], estimate: Any, n: int) -> Estimates:
    """Joins `estimate(trial)` over trials, for libraries that take one at a time; exceptions become
    statuses as in `estimate_safely`."""
    parts = []
    for trial in trials:
        began = time.perf_counter()
        try:
            part = estimate(trial)
        except (MemoryError, UserError):
            raise
        except Exception as error:
            part = Estimates.failed(1, n, describe_exception(error))
        part.seconds = np.array([time.perf_counter() - began])
        parts.append(part)
    return Estimates.join(parts)
