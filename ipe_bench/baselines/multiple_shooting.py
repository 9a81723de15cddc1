"""Multiple shooting for models by differential equations: the trajectory in pieces, which the fit joins."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.batches import put, take
from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array, Covariance, Mask, finite, inverse, multiply, solve, squared
from ipe_bench.basics.options import Count, Positive
from ipe_bench.basics.statuses import Status
from ipe_bench.estimators.base import Estimates, Estimator, Need
from ipe_bench.estimators.driver import ConvergenceCheck, Limits, Solver, iterate
from ipe_bench.estimators.least_squares import Minima
from ipe_bench.measurements.base import Measurement, SubsetModel
from ipe_bench.measurements.counted import CountingModel, EvaluationCount
from ipe_bench.measurements.ode.described import Ode
from ipe_bench.measurements.ode.interval import Interval
from ipe_bench.measurements.ode.model import OdeMeasurement
from ipe_bench.measurements.problem import Problem

_COMPLEX_STEP = 1e-100
_ROUND_OFF = 1e-11
"""The relative change of a parameter that an integration does not show."""
_SHORTEST = 2.0**-12
"""A share of a step below which no shorter one is tried."""


@dataclass(frozen=True)
class MultipleShooting(Estimator):
    """Bock's method (Numerical treatment of inverse problems in chemical reaction kinetics, Springer Series in Chemical
    Physics 18, 1981): the states at the beginning of each segment are unknowns beside the parameters, the segments'
    ends have to meet the next beginnings, and a Gauss-Newton step satisfies the linearised conditions exactly.

    Segments begin where the readings put them, so what a trajectory from far-off parameters would do later (leave for
    infinity, turn the wrong way round) does no harm. The conditions are eliminated by an orthogonal basis of their null
    space, since substitution from the start would grow like the solutions. Steps are halved until the next step, by the
    same linearisation, would be shorter: Deuflhard's natural monotonicity test (Newton Methods for Nonlinear Problems,
    2004, section 4.3.4).

    A simulation integrates all segments once; a Jacobian counts 1 + states/n, since it has as many more directions.
    """

    segments: Count = 10
    """At most one for each reading."""
    step: Positive = 0.125
    """Integration step as a share of the time from one reading to the next."""
    max_iterations: Count = 50
    """Steps tried."""
    tolerance: Positive = 1e-6
    """Largest step still to go of a parameter, in standard deviations of the local bound, and largest gap between
    segments in multiples of the states' size."""
    budget: Positive | None = None
    """Simulations that a trial may cost, a Jacobian counting n; None: no limit."""

    equation = "least_squares"
    needs: ClassVar[frozenset[Need]] = frozenset({"differential equations"})

    def estimate(self, problem: Problem, z: Array, *, history: bool = False) -> Estimates:
        for need in self.missing(problem):
            raise UserError(f"measurement={problem.measurement.name}: has no {need}, which multiple shooting needs")
        model, kept = _whole(problem.measurement)
        assert isinstance(model, OdeMeasurement)
        pieces = Pieces(problem, model, kept, self.segments, self.step)
        with np.errstate(all="ignore"):
            shooting = Shooting(pieces, z, EvaluationCount.zeros(len(z)), np.arange(len(z)))
            x = np.repeat(problem.x0[None], len(z), axis=0)
            limits = Limits(self.tolerance, self.max_iterations, self.budget, history)
            ended = iterate(shooting, CondensedGaussNewton(), x, limits)
            state = ended.state
            r = state.r
            minima = Minima(
                ended.x,
                ended.status,
                ended.iterations,
                ended.history,
                state.linear.covariance,
                squared(r),
                np.median(np.abs(r), axis=1),
            )
            return minima.estimates(shooting.tally, z.shape[1])


def _whole(model: Measurement) -> tuple[Measurement, NDArray[np.intp]]:
    """The equations, and which of all their readings there are."""
    kept = np.arange(model.m)
    while isinstance(model, SubsetModel | Ode):
        kept = np.array(model.kept, dtype=np.intp)[kept] if isinstance(model, SubsetModel) else kept
        model = model.whole
    return model, kept


@dataclass(frozen=True)
class Pieces:
    """A model's trajectory cut into segments. Arrays of states are (trials, segments, cases, states)."""

    problem: Problem
    model: OdeMeasurement
    kept: NDArray[np.intp]
    wanted: int
    step: float

    @property
    def R(self) -> Covariance:
        return self.problem.R

    @cached_property
    def interval(self) -> Interval:
        return Interval(self.model, self.step)

    @cached_property
    def grid(self) -> Array:
        """Time 0 and the times of the readings."""
        return np.concatenate([[0.0], np.asarray(self.model.times, dtype=float)])

    @cached_property
    def cuts(self) -> NDArray[np.intp]:
        """Where in `grid` each segment begins, and the end."""
        intervals = len(self.grid) - 1
        return np.unique(np.linspace(0, intervals, min(self.wanted, intervals) + 1).round().astype(np.intp))

    @property
    def nodes(self) -> int:
        """Beginnings that are unknown: all but the first."""
        return len(self.cuts) - 2

    def first_states(self, x: Array) -> tuple[Array, Array]:
        """The state at time 0 (trials, cases, states) and its derivative (..., n) by x, by complex steps."""
        trials, n = x.shape
        steps = np.concatenate([np.zeros((1, n)), _COMPLEX_STEP * 1j * np.eye(n)])
        p = (x[:, None] + steps) * self.model.si_sizes
        p = np.repeat(p[:, :, None], len(self.model.cases), axis=2)
        c = np.broadcast_to(self.model.tables[0], (trials, n + 1, *self.model.tables.shape[1:]))
        y = self.model.start(list(np.moveaxis(p, -1, 0)), list(np.moveaxis(c, -1, 0)))
        y = np.stack(np.broadcast_arrays(*y, p[..., 0])[:-1], axis=-1)
        return np.real(y[:, 0]), np.moveaxis(np.imag(y[:, 1:]), 1, -1) / _COMPLEX_STEP

    def lanes(self, x: Array, y: Array, k: NDArray[np.intp]) -> Array:
        """What `interval` takes for the states y at the times grid[k] (segments,)."""
        shape = y.shape[:3]
        p = np.broadcast_to((x * self.model.si_sizes)[:, None, None], (*shape, x.shape[1]))
        c = np.broadcast_to(self._constants(k), (*shape, self._constants(k).shape[2]))
        times = np.stack([self.grid[k], self.grid[k + 1] - self.grid[k]], axis=1)
        t = np.broadcast_to(times[None, :, None], (*shape, 2))
        return np.concatenate([p, y, c, t], axis=3).reshape(-1, self.interval.n)

    def _constants(self, k: NDArray[np.intp]) -> Array:
        """The constants (segments, cases, ...) from the times grid[k] on, and those at the reading after each."""
        tables = self.model.tables
        return tables[0 * k] if self.model.driven is None else np.concatenate([tables[k], tables[k + 1]], axis=2)

    def follow(self, x: Array, y: Array) -> tuple[Array, Array]:
        """The ends of all segments that begin at y, and all readings h (trials, cases, times, outputs)."""
        states, cases = self.model.states, len(self.model.cases)
        h, y = np.empty((len(x), cases, len(self.grid) - 1, len(self.model.outputs))), y.copy()
        for going, k in self._intervals():
            read = self.interval.simulate(self.lanes(x, y[:, going], k)).reshape(len(x), len(k), cases, -1)
            y[:, going], h[:, :, k] = read[..., :states], read[..., states:].swapaxes(1, 2)
        return y, h

    def slopes(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Derivatives along [x, state at the beginning] of the segments' ends (..., states, n + states) and of the
        readings of each segment (trials, cases, times, outputs, n + states)."""
        model, n = self.model, x.shape[1]
        states, cases, inputs = model.states, len(model.cases), n + model.states
        M = np.zeros((*y.shape, inputs))
        M[..., n:] = np.eye(states)
        Jh, y = np.empty((len(x), cases, len(self.grid) - 1, len(model.outputs), inputs)), y.copy()
        for going, k in self._intervals():
            lanes = self.lanes(x, y[:, going], k)
            J = self.interval.jacobian(lanes).reshape(len(x), len(k), cases, -1, self.interval.n)
            J = J[..., :inputs] * np.concatenate([model.si_sizes, np.ones(states)])
            along = np.matmul(J[..., n:], M[:, going])
            along[..., :n] += J[..., :n]
            M[:, going], Jh[:, :, k] = along[..., :states, :], along[..., states:, :].swapaxes(1, 2)
            y[:, going] = self.interval.simulate(lanes).reshape(len(x), len(k), cases, -1)[..., :states]
        return M, Jh

    def _intervals(self) -> list[tuple[NDArray[np.intp], NDArray[np.intp]]]:
        """In turn, which segments go on and through which intervals."""
        lengths = np.diff(self.cuts)
        steps = (np.flatnonzero(lengths > j) for j in range(lengths.max()))
        return [(going, self.cuts[going] + j) for j, going in enumerate(steps)]

    def guess(self, x: Array, z: Array) -> Array:
        """Where the segments begin: the trajectory of x, moved as little as the readings there ask for."""
        y0, _ = self.first_states(x)
        whole = replace(self, wanted=1)
        y, nodes = y0[:, None], [y0]
        for k in range(self.cuts[-2]):
            read = self.interval.simulate(whole.lanes(x, y, np.array([k]))).reshape(len(x), 1, *y0.shape[1:2], -1)
            y = read[..., : y0.shape[2]]
            if k + 1 in self.cuts:
                nodes.append(self._moved(x, y[:, 0], k, z))
        return np.stack(nodes, axis=1)

    def _moved(self, x: Array, y: Array, k: int, z: Array) -> Array:
        """States y (trials, cases, states) moved to where they show the readings z taken at times[k]."""
        y = np.where(np.isfinite(y), y, 0.0)
        shown = self._placed(z + self.model.offset[self.kept])[:, :, k]
        for _ in range(3):  # the readings are nearly always linear in the state
            h, B = self._read(x, y, k)
            gap = np.where(np.isfinite(shown), shown - h, 0.0)
            B = np.where(np.isfinite(shown)[..., None], B, 0.0)
            y = y + np.matmul(np.linalg.pinv(np.where(np.isfinite(B), B, 0.0)), gap[..., None])[..., 0]
        return y

    def _read(self, x: Array, y: Array, k: int) -> tuple[Array, Array]:
        """The outputs (trials, cases, outputs) at times[k] and their derivative by the state, by complex steps."""
        states = y.shape[2]
        steps = np.concatenate([np.zeros((1, states)), _COMPLEX_STEP * 1j * np.eye(states)])
        at = y[:, :, None] + steps
        p = np.broadcast_to((x * self.model.si_sizes)[:, None, None], (*at.shape[:3], x.shape[1]))
        tables = self.model.tables
        c = np.broadcast_to(tables[min(k + 1, len(tables) - 1)][:, None], (*at.shape[:3], tables.shape[2]))
        h: Any = self.model.read(self.grid[k + 1], *(list(np.moveaxis(a, -1, 0)) for a in (at, p, c)))
        h = np.stack(np.broadcast_arrays(*h, at[..., 0])[:-1], axis=-1)
        return np.real(h[:, :, 0]), np.moveaxis(np.imag(h[:, :, 1:]), 2, -1) / _COMPLEX_STEP

    def _placed(self, z: Array) -> Array:
        """Readings (trials, cases, times, outputs); NaN where one is missing."""
        whole = np.full((len(z), self.model.m), np.nan)
        whole[:, self.kept] = z
        return whole.reshape(len(z), len(self.model.cases), len(self.grid) - 1, -1)


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
        weights = np.linalg.norm(C, axis=2)
        weights = np.where(weights > 0, weights, 1.0)
        usable = finite(C) & finite(J)
        C = np.where(usable[:, None, None], C / weights[:, :, None], 0.0)
        J = np.where(usable[:, None, None], J, np.nan)
        Q, U = np.linalg.qr(C.swapaxes(1, 2), mode="complete")
        Z = Q[:, :, C.shape[1] :]
        JZ = np.matmul(J, Z)
        Qz, V = np.linalg.qr(np.where(usable[:, None, None], JZ, 0.0))
        V = np.where(usable[:, None, None], V, np.nan)
        count = C.shape[1]
        return cls(Q[:, :, :count], U[:, :count], Z, Qz, V, J, weights)

    def step(self, d: Array, r: Array) -> Array:
        """The unknowns' change (trials, unknowns) that closes the gaps d and fits the residuals r best."""
        closing = np.zeros((len(r), self.J.shape[2]))
        if d.shape[1]:
            closing = multiply(self.Y, solve(self.U.swapaxes(1, 2), -d / self.weights)[0])
        left = r + multiply(self.J, closing)
        return closing - multiply(self.Z, solve(self.V, multiply(self.Q.swapaxes(1, 2), left))[0])

    @property
    def covariance(self) -> Array:
        """Of the parameters (trials, n, n), the gaps closed."""
        n = self.Z.shape[2]
        S = np.matmul(self.Z[:, :n], inverse(self.V)[0])
        return np.matmul(S, S.swapaxes(1, 2))


@dataclass(frozen=True)
class Trajectory:
    """Where a trial stands; every field has the trials in front."""

    x: Array
    nodes: Array
    """The states (trials, nodes, cases, states) at the beginnings of all segments but the first."""
    size: Array
    """What the states are measured in (trials, states)."""
    d: Array
    """Gaps (trials, nodes * cases * states), in those sizes."""
    r: Array
    """Whitened residuals (trials, m)."""
    linear: Linear
    step: Array
    """The next one (trials, unknowns)."""
    share: Array
    """Of it that is tried."""
    moved: Array


@dataclass(frozen=True)
class Shooting:
    """The problem for the trials `rows` of a batch."""

    pieces: Pieces
    z: Array
    tally: EvaluationCount
    rows: NDArray[np.intp]

    @property
    def model(self) -> CountingModel:
        return CountingModel(self.pieces.problem.measurement, self.tally)

    def subset(self, kept: Mask) -> Shooting:
        return replace(self, z=self.z[kept], rows=self.rows[kept])

    def gaps(self, x: Array, nodes: Array, size: Array) -> tuple[Array, Array]:
        """The gaps in multiples of `size`, and the whitened residuals."""
        self.tally.simulations[self.rows] += 1.0
        begins = self._begins(x, nodes)
        ends, h = self.pieces.follow(x, begins)
        d = (ends[:, :-1] - nodes) / size[:, None, None]
        h = h.reshape(len(x), -1)[:, self.pieces.kept] - self.pieces.model.offset[self.pieces.kept]
        return d.reshape(len(x), -1), self.pieces.R.whiten(h - self.z)

    def linear(self, x: Array, nodes: Array, size: Array) -> Linear:
        """The gaps' and residuals' derivatives along the parameters and the nodes in multiples of `size`."""
        pieces, n = self.pieces, x.shape[1]
        states, cases, count = pieces.model.states, len(pieces.model.cases), pieces.nodes
        self.tally.jacobians[self.rows] += 1.0 + states / n
        M, Jh = pieces.slopes(x, self._begins(x, nodes))
        _, S = pieces.first_states(x)
        C = np.zeros((len(x), count, cases, states, n + count * cases * states))
        J = np.zeros((*Jh.shape[:4], C.shape[-1]))
        segment = np.repeat(np.arange(count + 1), np.diff(pieces.cuts))
        J[..., :n] = Jh[..., :n]
        C[..., :n] = M[:, :-1, ..., :n]
        # The first segment begins where the parameters say.
        J[:, :, segment == 0, :, :n] += np.einsum("tckos,tcsn->tckon", Jh[:, :, segment == 0][..., n:], S)
        if count:
            C[:, 0, ..., :n] += np.matmul(M[:, 0, ..., n:], S)
        for g in range(count):
            for c in range(cases):
                columns = slice(n + (g * cases + c) * states, n + (g * cases + c + 1) * states)
                C[:, g, c, :, columns] -= np.eye(states) * size[:, None]
                if g + 1 < count:
                    C[:, g + 1, c, :, columns] += M[:, g + 1, c, :, n:] * size[:, None]
                J[:, c, segment == g + 1, :, columns] = Jh[:, c, segment == g + 1][..., n:] * size[:, None, None]
        C = (C / size[:, None, None, :, None]).reshape(len(x), -1, C.shape[-1])
        J = J.reshape(len(x), -1, J.shape[-1])[:, pieces.kept]
        return Linear.of(C, pieces.R.whiten_jacobian(J))

    def _begins(self, x: Array, nodes: Array) -> Array:
        return np.concatenate([self.pieces.first_states(x)[0][:, None], nodes], axis=1)


@dataclass(frozen=True)
class CondensedGaussNewton(Solver[Trajectory]):
    """Gauss-Newton under the linearised conditions, halved by the natural monotonicity test."""

    def begin(self, system: Shooting, x: Array) -> Trajectory:
        nodes = system.pieces.guess(x, np.where(np.isfinite(system.z), system.z, 0.0))
        largest = np.abs(nodes).max(axis=(1, 2))
        size = np.where((largest > 0) & np.isfinite(largest), largest, 1.0)
        nodes = nodes[:, 1:]
        system.tally.simulations[system.rows] += 1.0
        d, r = system.gaps(x, nodes, size)
        linear = system.linear(x, nodes, size)
        far = np.full(len(x), np.inf)
        return Trajectory(x, nodes, size, d, r, linear, linear.step(d, r), np.ones(len(x)), far)

    def step(self, system: Shooting, state: Trajectory) -> Trajectory:
        change = state.share[:, None] * state.step
        n = state.x.shape[1]
        x = state.x + change[:, :n]
        nodes = state.nodes + change[:, n:].reshape(state.nodes.shape) * state.size[:, None, None]
        d, r = system.gaps(x, nodes, state.size)
        simplified = _length(state, state.linear.step(d, r))
        taken = simplified <= (1 - state.share / 4) * _length(state, state.step)
        state = replace(state, moved=_reach(state, change), share=np.where(taken, 1.0, state.share / 2))
        if not taken.any():
            return state
        part, accepted = system.subset(taken), (x[taken], nodes[taken])
        linear = part.linear(*accepted, state.size[taken])
        new = replace(
            take(state, taken),
            x=accepted[0],
            nodes=accepted[1],
            d=d[taken],
            r=r[taken],
            linear=linear,
            step=linear.step(d[taken], r[taken]),
        )
        return put(state, taken, new)

    def check(self, system: Shooting, before: Trajectory | None, state: Trajectory) -> ConvergenceCheck:
        """The step still to go, the gaps, and whether a step can still be shortened."""
        gap = np.abs(state.d).max(axis=1, initial=0.0)
        size = np.fmax(_reach(state, state.step), gap)
        level = np.where(finite(state.r) & finite(state.d), 1.0, np.nan)
        unknown = ~finite(state.step)
        ending = np.where(unknown, Status.SINGULAR, Status.STALLED)
        size = np.where(unknown, np.inf, size)
        return ConvergenceCheck(size, level, state.moved, unknown | (state.share < _SHORTEST), ending)


def _reach(state: Trajectory, change: Array) -> Array:
    """The largest change (trials,) of a parameter in standard deviations of the local bound."""
    P = state.linear.covariance
    deviation = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    change = change[:, : deviation.shape[1]]
    # Where solutions grow as fast as the readings are many, deviations lie below the round-off of an integration.
    invisible = np.abs(change) <= _ROUND_OFF * np.fmax(1.0, np.abs(state.x))
    return np.where(invisible, 0.0, np.abs(change / deviation)).max(axis=1)


def _length(state: Trajectory, change: Array) -> Array:
    """The length (trials,) of a change of all unknowns, parameters in standard deviations, states in their sizes."""
    n = state.x.shape[1]
    scale = np.fmax(1.0, np.abs(state.x))
    return np.linalg.norm(np.concatenate([change[:, :n] / scale, change[:, n:]], axis=1), axis=1)
