"""Multiple shooting for models by differential equations: the trajectory in pieces, which the fit
joins."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.batches import put, take
from ipe_bench.basics.linalg import (
    Array,
    Mask,
    deviations,
    finite,
    inverse,
    multiply,
    nearest,
    solve,
)
from ipe_bench.basics.options import Count, Positive
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.base import Estimates, Estimator, Need
from ipe_bench.estimators.driver import ConvergenceCheck, Limits, Method, iterate
from ipe_bench.estimators.minima import Minima
from ipe_bench.measurements.base import SubsetModel
from ipe_bench.measurements.counted import CountingModel, EvaluationCount
from ipe_bench.measurements.ode.described import Ode
from ipe_bench.measurements.ode.model import OdeMeasurement
from ipe_bench.measurements.problem import Problem
from ipe_bench_zoo.interval import Interval

_COMPLEX_STEP = 1e-100
_ROUND_OFF = 1e-11
"""The relative change of a parameter that an integration does not show."""
_SHORTEST = 2.0**-12
"""A share of a step below which no shorter one is tried."""


@dataclass(frozen=True)
class MultipleShooting(Estimator):
    """Bock's method (Numerical treatment of inverse problems in chemical reaction kinetics,
    Springer Series in Chemical Physics 18, 1981): the states at the beginning of each segment are
    unknowns beside the parameters, the segments' ends have to meet the next beginnings, and a
    Gauss-Newton step satisfies the linearised conditions exactly.

    Segments begin where the readings put them, so what a trajectory from far-off parameters would
    do later does no harm. The conditions are eliminated by an orthogonal basis of their null space.
    Steps are halved by Deuflhard's natural monotonicity test (Newton Methods for Nonlinear
    Problems, 2004, section 4.3.4). Integrating all segments once counts as a simulation, and
    derivatives as what they cost beside it.
    """

    segments: Count = 10
    """At most one for each reading."""
    step: Positive = 0.125
    """Integration step as a share of the time from one reading to the next."""
    max_iterations: Count = 50
    """Steps tried."""
    tolerance: Positive = 1e-6
    """Largest step still to go of a parameter, in standard deviations of the local bound, and
    largest gap between segments in multiples of the states' size."""
    budget: Positive | None = None
    """Simulations that a trial may cost, a Jacobian counting n; None: no limit."""

    equation = "least_squares"
    needs: ClassVar[frozenset[Need]] = frozenset({"differential equations"})

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        self.require_suited(problem)
        counted = CountingModel(problem.measurement, EvaluationCount.zeros(len(z)))
        shooting = Shooting(
            Pieces.of(problem, self.segments, self.step), counted, z, np.arange(len(z))
        )
        limits = Limits(self.tolerance, self.max_iterations, self.budget, history)
        with np.errstate(all="ignore"):
            ended = iterate(
                shooting,
                CondensedGaussNewton(),
                np.repeat(problem.x0[None], len(z), axis=0),
                limits,
            )
            minima = Minima.of(ended, ended.state.linear.covariance, ended.state.r)
            return minima.estimates(counted.tally, z.shape[1])


@dataclass(frozen=True)
class Pieces:
    """A model's trajectory cut into segments. A lane is one case in one segment, and the lanes of a
    segment follow one another; states are (trials, lanes, states)."""

    problem: Problem
    model: OdeMeasurement
    kept: NDArray[np.intp]
    """Which of all the model's readings there are."""
    wanted: int
    interval: Interval

    @classmethod
    def of(cls, problem: Problem, segments: int, step: float) -> Pieces:
        model, kept = problem.measurement, np.arange(problem.measurement.m)
        while isinstance(model, SubsetModel | Ode):
            kept = (
                np.array(model.kept, dtype=np.intp)[kept]
                if isinstance(model, SubsetModel)
                else kept
            )
            model = model.whole
        assert isinstance(model, OdeMeasurement)
        return cls(problem, model, kept, segments, Interval(model, step))

    @cached_property
    def grid(self) -> Array:
        """Time 0 and the times of the readings."""
        return np.concatenate([[0.0], np.asarray(self.model.times, dtype=float)])

    @cached_property
    def cuts(self) -> NDArray[np.intp]:
        """Where in `grid` each segment begins, and the end."""
        intervals = len(self.grid) - 1
        return np.unique(
            np.linspace(0, intervals, min(self.wanted, intervals) + 1).round().astype(np.intp)
        )

    @cached_property
    def cases(self) -> int:
        return len(self.model.cases)

    def start(self, x: Array) -> tuple[Array, Array]:
        """The states at time 0 (trials, cases, states) and their derivatives (..., n) by x."""

        def states(x: Array) -> Array:
            shape = (*x.shape[:2], self.cases)
            return _entrywise(
                self.model.start, shape, (x * self.model.si_sizes)[:, :, None], self.model.tables[0]
            )

        return _with_slope(states, x)

    def read(self, x: Array, y: Array, k: int) -> tuple[Array, Array]:
        """The outputs (trials, cases, outputs) of the states y (trials, cases, states) at times[k],
        and their derivatives by the states."""
        p, c = (
            (x * self.model.si_sizes)[:, None, None],
            self.model.tables[min(k + 1, len(self.model.tables) - 1)],
        )
        read = partial(self.model.read, self.grid[k + 1])
        return _with_slope(lambda y: _entrywise(read, y.shape[:3], y, p, c), y)

    def inputs(self, x: Array, y: Array, k: NDArray[np.intp]) -> Array:
        """What `interval` takes for states y (trials, lanes, states) at the times grid[k]
        (lanes,)."""
        tables, case = self.model.tables, np.arange(len(k)) % self.cases
        c = tables[0 * k, case]
        if self.model.driven is not None:
            c = np.concatenate([tables[k, case], tables[k + 1, case]], axis=1)
        times = np.stack([self.grid[k], self.grid[k + 1] - self.grid[k]], axis=1)
        parts = ((x * self.model.si_sizes)[:, None], y, c, times)
        parts = [np.broadcast_to(part, (*y.shape[:2], part.shape[-1])) for part in parts]
        return np.concatenate(parts, axis=2).reshape(-1, self.interval.n)

    def follow(self, x: Array, y: Array) -> tuple[Array, Array]:
        """The ends of all segments that begin at y, and all readings h (trials, cases, times,
        outputs)."""
        h, y = np.empty((len(x), self.cases, len(self.grid) - 1, len(self.model.outputs))), y.copy()
        for lanes, k in self._intervals():
            read = self.interval.simulate(self.inputs(x, y[:, lanes], k)).reshape(
                len(x), len(k), -1
            )
            y[:, lanes], h[:, lanes % self.cases, k] = np.split(read, [self.model.states], axis=2)
        return y, h

    def slopes(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Derivatives along [x, state at the beginning] of the segments' ends (trials, lanes,
        states, n + states) and of all readings (trials, cases, times, outputs, n + states)."""
        model, n = self.model, x.shape[1]
        states, size = model.states, np.concatenate([model.si_sizes, np.ones(model.states)])
        M = np.zeros((*y.shape, len(size)))
        M[..., n:] = np.eye(states)
        Jh, y = (
            np.empty((len(x), self.cases, len(self.grid) - 1, len(model.outputs), len(size))),
            y.copy(),
        )
        for lanes, k in self._intervals():
            inputs = self.inputs(x, y[:, lanes], k)
            J = (
                self.interval.jacobian(inputs).reshape(len(x), len(k), -1, self.interval.n)[
                    ..., : len(size)
                ]
                * size
            )
            along = np.matmul(J[..., n:], M[:, lanes])
            along[..., :n] += J[..., :n]
            M[:, lanes], Jh[:, lanes % self.cases, k] = np.split(along, [states], axis=2)
            y[:, lanes] = self.interval.simulate(inputs).reshape(len(x), len(k), -1)[..., :states]
        return M, Jh

    def _intervals(self) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp]]]:
        """In turn, which lanes go on and through which intervals."""
        first, lengths = (
            np.repeat(self.cuts[:-1], self.cases),
            np.repeat(np.diff(self.cuts), self.cases),
        )
        for j in range(lengths.max()):
            lanes = np.flatnonzero(lengths > j)
            yield lanes, first[lanes] + j

    def guess(self, x: Array, z: Array) -> Array:
        """Where the segments begin: the trajectory of x, moved as little as the readings there ask
        for."""
        y, _ = self.start(x)
        nodes = [y]
        for k in range(self.cuts[-2]):
            read = self.interval.simulate(self.inputs(x, y, np.full(self.cases, k)))
            y = read.reshape(len(x), self.cases, -1)[..., : self.model.states]
            if k + 1 in self.cuts:
                nodes.append(self._moved(x, y, k, z))
        return np.concatenate(nodes, axis=1)

    def _moved(self, x: Array, y: Array, k: int, z: Array) -> Array:
        """States y (trials, cases, states) moved to where they show the readings z taken at
        times[k]."""
        shape = (self.cases, len(self.grid) - 1, len(self.model.outputs))
        whole = np.full((len(z), self.model.m), np.nan)
        whole[:, self.kept] = z + self.model.offset[self.kept]
        shown = whole.reshape(len(z), *shape)[:, :, k]
        turns = np.reshape(self.model.periods, shape)[:, k] if len(self.model.periods) else ()
        y = np.where(np.isfinite(y), y, 0.0)
        for _ in range(3):  # the readings are nearly always linear in the state
            h, B = self.read(x, y, k)
            gap = np.where(np.isfinite(shown), shown - nearest(h, shown, turns), 0.0)
            B = np.where(np.isfinite(shown)[..., None] & np.isfinite(B), B, 0.0)
            y = y + multiply(np.linalg.pinv(B), gap)
        return y


def _entrywise(
    function: Callable[..., Sequence[Any]], shape: tuple[int, ...], *vectors: Array
) -> Array:
    """A function of the entries of vectors (..., k), each entry of that shape: (*shape,
    outputs)."""
    entries = (list(np.moveaxis(np.broadcast_to(a, (*shape, a.shape[-1])), -1, 0)) for a in vectors)
    return np.stack([np.broadcast_to(value, shape) for value in function(*entries)], axis=-1)


def _with_slope(function: Callable[[Array], Array], x: Array) -> tuple[Array, Array]:
    """A function at x (trials, ..., n) and its derivative (trials, ..., n) there, by complex steps,
    which come as an axis behind that of the trials."""
    n = x.shape[-1]
    steps = _COMPLEX_STEP * 1j * np.eye(n + 1, n, -1)
    y = function(x[:, None] + steps.reshape(n + 1, *[1] * (x.ndim - 2), n))
    return np.real(y[:, 0]), np.moveaxis(np.imag(y[:, 1:]), 1, -1) / _COMPLEX_STEP


@dataclass(frozen=True)
class Linear:
    """The linearised problem of each trial, factored: constraints C u = -d, readings J u = -r."""

    Y: Array
    """C' = Y U."""
    U: Array
    Z: Array
    """An orthogonal basis (trials, unknowns, n) of the null space of C."""
    Q: Array
    """J Z = Q V."""
    V: Array
    J: Array
    weights: Array
    """By which the rows of C were divided."""

    @classmethod
    def of(cls, C: Array, J: Array) -> Linear:
        weights, usable = np.linalg.norm(C, axis=2), (finite(C) & finite(J))[:, None, None]
        weights = np.where(weights > 0, weights, 1.0)
        Q, U = np.linalg.qr(
            np.where(usable, C / weights[:, :, None], 0.0).swapaxes(1, 2), mode="complete"
        )
        Y, Z = np.split(Q, [C.shape[1]], axis=2)
        Qz, V = np.linalg.qr(np.matmul(np.where(usable, J, 0.0), Z))
        V, J = (np.where(usable, A, np.nan) for A in (V, J))
        return cls(Y, U[:, : C.shape[1]], Z, Qz, V, J, weights)

    def step(self, d: Array, r: Array) -> Array:
        """The unknowns' change (trials, unknowns) that closes the gaps d and fits the residuals r
        best."""
        closing = np.zeros((len(r), self.J.shape[2]))
        if d.shape[1]:
            closing = multiply(self.Y, solve(self.U.swapaxes(1, 2), -d / self.weights)[0])
        left = r + multiply(self.J, closing)
        return closing - multiply(self.Z, solve(self.V, multiply(self.Q.swapaxes(1, 2), left))[0])

    @property
    def covariance(self) -> Array:
        """Of the parameters (trials, n, n), the gaps closed."""
        S = np.matmul(self.Z[:, : self.Z.shape[2]], inverse(self.V)[0])
        return np.matmul(S, S.swapaxes(1, 2))


@dataclass(frozen=True)
class Trajectory:
    """Where a trial stands; every field has the trials in front."""

    x: Array
    nodes: Array
    """The states (trials, lanes, states) at the beginnings of all segments but the first."""
    size: Array
    """What the states are measured in (trials, states)."""
    d: Array
    """Gaps (trials, lanes * states), in those sizes."""
    r: Array
    """Whitened residuals (trials, m)."""
    linear: Linear
    step: Array
    """The next step (trials, unknowns)."""
    share: Array
    """The share of that step that is tried."""
    moved: Array


@dataclass(frozen=True)
class Shooting:
    """The problem for the trials `rows` of a batch."""

    pieces: Pieces
    model: CountingModel
    z: Array
    rows: NDArray[np.intp]

    def subset(self, kept: Mask) -> Shooting:
        return replace(self, z=self.z[kept], rows=self.rows[kept])

    def gaps(self, x: Array, nodes: Array, size: Array) -> tuple[Array, Array]:
        """The gaps in multiples of `size`, and the whitened residuals."""
        self.model.tally.simulations[self.rows] += 1.0
        pieces = self.pieces
        ends, h = pieces.follow(x, np.concatenate([pieces.start(x)[0], nodes], axis=1))
        d = (ends[:, : nodes.shape[1]] - nodes) / size[:, None]
        h = h.reshape(len(x), -1)[:, pieces.kept] - pieces.model.offset[pieces.kept]
        return d.reshape(len(x), -1), pieces.problem.R.whiten(
            pieces.problem.measurement.near(h, self.z) - self.z
        )

    def linear(self, x: Array, nodes: Array, size: Array) -> Linear:
        """The gaps' and residuals' derivatives along the parameters and the nodes in multiples of
        `size`."""
        pieces, n, (lanes, states) = self.pieces, x.shape[1], nodes.shape[1:]
        # The states in between are simulated beside the derivatives.
        self.model.tally.simulations[self.rows] += 1.0
        self.model.tally.jacobians[self.rows] += (
            pieces.interval.jacobian_cost / self.model.measurement.jacobian_cost
        )
        start, S = pieces.start(x)
        M, Jh = pieces.slopes(x, np.concatenate([start, nodes], axis=1))
        C = np.zeros((len(x), lanes, states, n + lanes * states))
        J = np.zeros((*Jh.shape[:4], n + lanes * states))
        segment = np.repeat(np.arange(len(pieces.cuts) - 1), np.diff(pieces.cuts))
        J[..., :n], C[..., :n] = Jh[..., :n], M[:, :lanes, :, :n]
        # The first segment begins where the parameters say.
        J[:, :, segment == 0, :, :n] += np.einsum(
            "tckos,tcsn->tckon", Jh[:, :, segment == 0][..., n:], S
        )
        if lanes:
            C[:, : pieces.cases, :, :n] += np.matmul(M[:, : pieces.cases, :, n:], S)
        for node in range(lanes):
            columns, following = (
                slice(n + node * states, n + (node + 1) * states),
                node + pieces.cases,
            )
            C[:, node, :, columns] = -np.eye(states) * size[:, None]
            if following < lanes:
                C[:, following, :, columns] = M[:, following, :, n:] * size[:, None]
            g, c = divmod(following, pieces.cases)
            J[:, c, segment == g, :, columns] = (
                Jh[:, c, segment == g][..., n:] * size[:, None, None]
            )
        C = (C / size[:, None, :, None]).reshape(len(x), -1, C.shape[-1])
        J = J.reshape(len(x), -1, J.shape[-1])[:, pieces.kept]
        return Linear.of(C, pieces.problem.R.whiten_jacobian(J))


@dataclass(frozen=True)
class CondensedGaussNewton(Method[Shooting, Trajectory]):
    """Gauss-Newton under the linearised conditions, halved by the natural monotonicity test."""

    def begin(self, system: Shooting, x: Array) -> Trajectory:
        nodes = system.pieces.guess(x, np.where(np.isfinite(system.z), system.z, 0.0))
        largest = np.abs(nodes).max(axis=1)
        size = np.where((largest > 0) & np.isfinite(largest), largest, 1.0)
        nodes = nodes[:, system.pieces.cases :]
        cuts = system.pieces.cuts  # the guess simulates all segments but the last
        system.model.tally.simulations[system.rows] += cuts[-2] / cuts[-1]
        d, r = system.gaps(x, nodes, size)
        linear = system.linear(x, nodes, size)
        return Trajectory(
            x,
            nodes,
            size,
            d,
            r,
            linear,
            linear.step(d, r),
            np.ones(len(x)),
            np.full(len(x), np.inf),
        )

    def step(self, system: Shooting, state: Trajectory) -> Trajectory:
        change = state.share[:, None] * state.step
        of_x, of_nodes = np.split(change, [state.x.shape[1]], axis=1)
        x, nodes = (
            state.x + of_x,
            state.nodes + of_nodes.reshape(state.nodes.shape) * state.size[:, None],
        )
        d, r = system.gaps(x, nodes, state.size)
        simplified = _length(state, state.linear.step(d, r))
        taken = simplified <= (1 - state.share / 4) * _length(state, state.step)
        state = replace(
            state, moved=_reach(state, change), share=np.where(taken, 1.0, state.share / 2)
        )
        if not taken.any():
            return state
        x, nodes, d, r = (a[taken] for a in (x, nodes, d, r))
        linear = system.subset(taken).linear(x, nodes, state.size[taken])
        new = replace(
            take(state, taken), x=x, nodes=nodes, d=d, r=r, linear=linear, step=linear.step(d, r)
        )
        return put(state, taken, new)

    def check(
        self, system: Shooting, before: Trajectory | None, state: Trajectory
    ) -> ConvergenceCheck:
        """The step still to go, the gaps, and whether a step can still be shortened."""
        unknown, gap = ~finite(state.step), np.abs(state.d).max(axis=1, initial=0.0)
        size = np.where(unknown, np.inf, np.fmax(_reach(state, state.step), gap))
        growth = np.where(finite(state.r) & finite(state.d), 1.0, np.nan)
        ending = np.where(unknown, Status.SINGULAR, Status.STALLED)
        return ConvergenceCheck(
            size, growth, state.moved, unknown | (state.share < _SHORTEST), ending
        )


def _reach(state: Trajectory, change: Array) -> Array:
    """The largest change (trials,) of a parameter in standard deviations of the local bound."""
    change = change[:, : state.x.shape[1]]
    # Where solutions grow as fast as the readings are many, deviations lie below the round-off of
    # an integration.
    invisible = np.abs(change) <= _ROUND_OFF * np.fmax(1.0, np.abs(state.x))
    return np.where(invisible, 0.0, np.abs(change / deviations(state.linear.covariance))).max(
        axis=1
    )


def _length(state: Trajectory, change: Array) -> Array:
    """The length (trials,) of a change of all unknowns, parameters and states in their sizes."""
    parameters, states = np.split(change, [state.x.shape[1]], axis=1)
    return np.linalg.norm(
        np.concatenate([parameters / np.fmax(1.0, np.abs(state.x)), states], axis=1), axis=1
    )
