"""Integrates stiff equations of a batch of trials by Rodas5P, with the exact derivatives of its
steps.

A Rosenbrock method of order 5 with 8 stages, stiffly accurate and L-stable: one Jacobian and one LU
decomposition a step, no Newton iteration. Coefficients: Steinebach, BIT Numerical Mathematics
63:27, 2023, in the transformed form of Hairer and Wanner, Solving Ordinary Differential Equations
II, section IV.7. Sensitivities are the derivatives of the discrete steps with their lengths held.

A lane is one trial of one case, with its own time, step and order of pivots. Operations act on
lanes one by one, and the error norm is a maximum, so bits do not depend on the batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.engine import watch
from ipe_bench.engine.equations import Equations, Recording
from ipe_bench.engine.trace import Program, tangent

GAMMA = 0.21193756319429014
_SIXTH = (
    -7.502846399306121,
    2.561846144803919,
    -11.627539656261098,
    -0.18268767659942256,
    0.030198172008377946,
)
# fmt: off
# a_ij: stage i is evaluated at y + sum_j a_ij u_j.
A: tuple[tuple[float, ...], ...] = (
    (),
    (3.0,),
    (2.849394379747939, 0.45842242204463923),
    (-6.954028509809101, 2.489845061869568, -10.358996098473584),
    (2.8029986275628964, 0.5072464736228206, -0.3988312541770524, -0.04721187230404641),
    _SIXTH,
    (*_SIXTH, 1.0),
    (*_SIXTH, 1.0, 1.0),
)
# c_ij: the right side of stage i has sum_j c_ij u_j / h.
C: tuple[tuple[float, ...], ...] = (
    (),
    (-14.155112264123755,),
    (-17.97296035885952, -2.859693295451294),
    (147.12150275711716, -1.41221402718213, 71.68940251302358),
    (165.43517024871676, -0.4592823456491126, 42.90938336958603, -5.961986721573306),
    (24.854864614690072, -3.0009227002832186, 47.4931110020768, 5.5814197821558125,
     -0.6610691825249471),
    (
        30.91273214028599, -3.1208243349937974, 77.79954646070892, 34.28646028294783,
        -19.097331116725623,
        -28.087943162872662,
    ),
    (
        37.80277123390563, -3.2571969029072276, 112.26918849496327, 66.9347231244047,
        -40.06618937091002,
        -54.66780262877968, -9.48861652309627,
    ),
)
# fmt: on
# alpha_i: stage i is evaluated at t + alpha_i h.
NODES = (
    0.0,
    0.6358126895828704,
    0.4095798393397535,
    0.9769306725060716,
    0.4288403609558664,
    1.0,
    1.0,
    1.0,
)
# gamma_i: the right side of stage i has gamma_i h df/dt.
TIME_WEIGHTS = (
    GAMMA,
    -0.42387512638858027,
    -0.3384627126235924,
    1.8046452872882734,
    2.325825639765069,
    0.0,
    0.0,
    0.0,
)
STABLE = 5.0
"""A step of DOP853 times the fastest rate up to which it is stable."""
_REACH = 6.0
"""About where the stability region of DOP853 ends on the negative real axis."""
MOST_STEPS = 4000
SHAPE = 1e-4
"""A relative tolerance that shows the shape of a solution."""
_SMALLEST = 1e-9
"""Absolute tolerance over the relative one, in units of the states."""
_ROUNDING = 4 * np.finfo(float).eps
"""Round-off of a rate, as a part of the sum of its terms."""
_SAFETY = 0.9
"""Part of the step that the error allows which is taken next."""
_SHRINK = 0.2
"""Part of a step below which the next is never tried; `_GROW`, above which."""
_GROW = 6.0
_THROUGH = 1e-5
"""Share of the usual interval below which a step may change the sign of what the rates divide by:
longer ones would jump over a pole."""
_LOOKS = 1024
"""Moments within the usual interval at which rates that depend on t are looked at, lest a step
misses a pulse."""
_UNSEEN = 0.01
"""Share of a state by which a step may miss what is seen there."""


@dataclass(frozen=True)
class Effort:
    """Holds the effort of integrating a trial in its hardest case."""

    steps: int
    """Rejected ones included, each with a decomposition."""
    explicit: float
    """Steps that an explicit method would need for stability alone: the integral of the spectral
    radius of the Jacobian along the solution, over what a step may cover."""
    fastest: float
    """The largest spectral radius, and `met`, when that was."""
    met: float
    reached: float
    """The time that all cases reached."""


@dataclass(frozen=True)
class Stepped:
    """Holds equations with the numbers that they are integrated with."""

    equations: Equations
    tables: Array
    """The constants (intervals, cases, constants); of a single interval where none changes."""
    times: Array
    """Times of the readings, ascending from 0 on."""
    sizes: Array
    """The size (n,) of one unit of x in SI units."""


@dataclass(frozen=True)
class Rodas5P:
    """Integrates equations; an error of `rtol` of each state is allowed in a step."""

    of: Stepped
    rtol: float = 1e-8

    @cached_property
    def _programs(self) -> dict[str, Program]:
        """The equations and the derivatives that the method needs, on arrays over lanes."""
        tape = Recording(self.of.equations)
        n = self.of.equations.states
        graph = tape.graph
        one = graph.constant(1.0)
        k = graph.inputs("k", n)
        s = graph.inputs("s", n)
        d = graph.inputs("d", self.of.equations.parameters)
        began = [*tape.p, *tape.c]
        point = [tape.t, *tape.y, *began]
        # d is the derivative along s of the states and d of the parameters; turned is J k.
        ways = [*s, *d]
        along = dict(zip([*tape.y, *tape.p], ways, strict=True))
        in_time = tangent(tape.slope, {tape.t: one})
        turned = tangent(tape.slope, dict(zip(tape.y, k, strict=True)))
        # Column j of J = df/dy is the tangent of f along y_j.
        columns = [tangent(tape.slope, {y: one}) for y in tape.y]
        by_rows = [entry for row in zip(*columns, strict=True) for entry in row]
        return {
            "f": Program.of(tape.slope, point),
            "J": Program.of(by_rows, point),
            "ft": Program.of(in_time, point),
            "df": Program.of(tangent(tape.slope, along), point + ways),
            "dft": Program.of(tangent(in_time, along), point + ways),
            "dJk": Program.of(tangent(turned, along), [*point, *k, *ways]),
            "side": Program.of([watch.side_of_poles(tape)], point),
            "start": Program.of(tape.start, began),
            "dstart": Program.of(tangent(tape.start, along), [*began, *d]),
            "read": Program.of(tape.shown, point),
            "dread": Program.of(tangent(tape.shown, along), point + ways),
        }

    @cached_property
    def timed(self) -> bool:
        """Whether the rates depend on t itself."""
        return Recording(self.of.equations).timed

    @cached_property
    def divided(self) -> bool:
        """Whether the rates divide by anything that changes along a solution."""
        return bool(watch.divisors(Recording(self.of.equations)))

    def measured(self, x: Array) -> tuple[Array, Effort]:
        """Computes the readings (1, m) at x (1, n), and the effort; a tolerance that shows the
        shape will do."""
        run = _Run(self, x, len(self.of.times), stretched=True)
        hardest = int(np.argmax(run.stretch))
        effort = Effort(
            steps=int(run.steps.max()),
            explicit=float(run.stretch[hardest]),
            fastest=float(run.fastest[hardest]),
            met=float(run.met[hardest]),
            reached=float(run.t.min()),
        )
        return run.readings, effort

    def simulate(self, x: Array, stop: int, most: int = MOST_STEPS) -> Array:
        """Computes readings (trials, cases x stop x outputs) at the first `stop` times; NaN from
        where a trial breaks down, or exceeds the limit on steps."""
        return _Run(self, x, stop, most).readings

    def with_reach(self, x: Array, stop: int) -> tuple[Array, Array]:
        """Computes the same readings, and how far each is moved by states that move by their
        largest magnitudes."""
        run = _Run(self, x, stop, reaching=True)
        return run.readings, run.by_trial(run.reach)

    def jacobian(self, x: Array, stop: int) -> Array:
        """Computes their derivatives by x (trials, cases x stop x outputs, n)."""
        cases = self.of.tables.shape[1]
        readings = cases * stop * self.of.equations.outputs
        J = _Run(self, x, stop, sensitive=True).J
        by_trial = J.transpose(3, 1, 0, 2).reshape(len(x), readings, -1)
        return by_trial * self.of.sizes


class _Run:
    """Integrates lanes to the last time; arrays are (..., lanes)."""

    def __init__(
        self,
        method: Rodas5P,
        x: Array,
        stop: int,
        most: int = MOST_STEPS,
        *,
        sensitive: bool = False,
        stretched: bool = False,
        reaching: bool = False,
    ) -> None:
        equations = method.of.equations
        self.do = method._programs
        self.timed = method.timed
        self.divided = method.divided
        self.rtol = method.rtol
        self.atol = _SMALLEST * method.rtol
        self.most = most
        self.stretched = stretched
        self.reaching = reaching
        # Times run to the last reading, even if fewer are asked for: the first step hangs on it.
        times = np.asarray(method.of.times, dtype=float)
        self.end = float(times[-1]) or 1.0
        self.interval = _usual(times)
        self.times = times[:stop]
        self.tables = method.of.tables
        cases = self.tables.shape[1]
        self.case = np.tile(np.arange(cases), len(x))
        parameters = x * method.of.sizes
        self.p = np.repeat(parameters, cases, axis=0).T.copy()
        # A Jacobian has a direction for each parameter, readings alone have none.
        self.directions = np.eye(equations.parameters)[:, :, None]
        self.q = equations.parameters if sensitive else 0
        lanes = len(x) * cases
        self.t = np.zeros(lanes)
        self.place = np.zeros(lanes, int)
        self.steps = np.zeros(lanes, int)
        self.stretch = np.zeros(lanes)
        self.radius = np.zeros(lanes)
        self.fastest = np.zeros(lanes)
        self.met = np.zeros(lanes)
        self.z = np.full((equations.outputs, stop, lanes), np.nan)
        self.reach = np.full((equations.outputs, stop, lanes), np.nan)
        self.J = np.full((equations.outputs, stop, self.q, lanes), np.nan)
        with np.errstate(all="ignore"):
            self._start(equations.states, lanes)
            self._integrate()
        self.trials = len(x)
        self.readings = self.by_trial(self.z)

    def by_trial(self, found: Array) -> Array:
        """Turns numbers of readings (outputs, times, lanes) into rows (trials, cases x times x
        outputs)."""
        return found.transpose(2, 1, 0).reshape(self.trials, -1)

    def _start(self, states: int, lanes: int) -> None:
        """Sets the states y (states, lanes) and their sensitivities S at t = 0."""
        began = [*self.p, *self._constants(np.arange(lanes))]
        self.y = self._values("start", began, lanes)
        self.largest = np.abs(self.y)
        self.S = np.zeros((states, 0, lanes))
        if self.q:
            along = [*began, *self.directions]
            self.S = self._values("dstart", along, self.q, lanes)

    def _values(self, name: str, inputs: Sequence[Any], *shape: int) -> Array:
        """Returns the outputs of a program, of which some may be numbers, as one array."""
        program = self.do[name]
        out = np.empty((len(program.outputs), *shape))
        for row, value in zip(out, program(inputs), strict=True):
            row[...] = value
        return out

    def _integrate(self) -> None:
        # Each lane has its own step; those that are done drop out of `live`.
        h = self._first_step()
        live = np.arange(len(self.t))
        while True:
            self._read(live)
            live = live[self._going(live) & np.isfinite(h[live])]
            if not len(live):
                return
            left = self.times[self.place[live]] - self.t[live]
            now = _to_the_reading(h[live], left)
            y, S, error = self._step(live, now)
            good = error <= 1
            h[live] = self._next_step(live, h[live], now, error)
            # Lanes whose error is too large stay where they are, and try the shorter step.
            self.steps[live] += 1
            done = live[good]
            if self.stretched:
                self.stretch[done] += self.radius[done] * now[good] / _REACH
            # A step that ends on a reading ends on its very time, whatever round-off adds.
            arrives = now[good] == left[good]
            there = self.times[self.place[done]]
            on_the_way = self.t[done] + now[good]
            self.t[done] = np.where(arrives, there, on_the_way)
            self.y[:, done] = y[:, good]
            self.S[:, :, done] = S[:, :, good]
            size = np.abs(self.y[:, done])
            self.largest[:, done] = np.fmax(self.largest[:, done], size)

    def _going(self, lanes: Array) -> Array:
        """Tells the lanes that have readings to come and steps left."""
        ahead = self.place[lanes] < len(self.times)
        return ahead & (self.steps[lanes] < self.most)

    def _next_step(self, lanes: Array, h: Array, now: Array, error: Array) -> Array:
        """Computes the step to be tried after the step `now`, cut from h, had this error; NaN ends
        a lane."""
        # h <- h 0.9 error^(-1/5), within 0.2 to 6 times h: the embedded solution has order 4
        # (Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, eq. II.4.13).
        change = _SAFETY * np.maximum(error, 1e-10) ** -0.2
        change = np.clip(change, _SHRINK, _GROW)
        wanted = now * np.where(np.isfinite(error), change, _SHRINK)
        # What a reading cut short says nothing against the step that was wanted.
        cut = (error <= 1) & (now < h)
        longer = np.where(cut, np.maximum(wanted, h), wanted)
        # A step that round-off swallows ends the lane.
        swallowed = self.t[lanes] + 8 * longer == self.t[lanes]
        return np.where(swallowed, np.nan, longer)

    def _read(self, here: Array) -> None:
        """Takes the readings whose time has come, at t = 0 too, in these lanes."""
        while True:
            here = here[self.place[here] < len(self.times)]
            come = self.t[here] == self.times[self.place[here]]
            here = here[come]
            if not len(here):
                return
            at = self._point(here, later=1)
            now = self.place[here]
            self.z[:, now, here] = self._values("read", at, len(here))
            if self.reaching:
                self.reach[:, now, here] = self._reached(here, at)
            if self.q:
                # dh/dx = dh/dy dy/dx + dh/dp, dy/dx being S.
                along = [*at, *self.S[:, :, here], *self.directions]
                slopes = self._values("dread", along, self.q, len(here))
                self.J[:, now, :, here] = slopes.transpose(2, 0, 1)
            self.place[here] += 1

    def _reached(self, here: Array, at: Sequence[Any]) -> Array:
        """Computes by how much readings move with states that move by their largest magnitudes:
        sum_i |dh/dy_i| max|y_i|."""
        n = len(self.y)
        # A direction for each state: that one moves by its size, all others and p stay.
        each = np.eye(n)[:, :, None]
        sizes = self.largest[:, here] * each
        still = np.zeros(len(self.p))
        moved = self._values("dread", [*at, *sizes, *still], n, len(here))
        return _sums(np.abs(moved))

    def _point(self, lanes: Array, later: int = 0) -> list[Any]:
        """Returns t, y, p and c of each lane, as programs take them; `later` as in
        `_constants`."""
        return [self.t[lanes], *self.y[:, lanes], *self._held(lanes, later)]

    def _held(self, lanes: Array, later: int = 0) -> list[Any]:
        """Returns p and c of each lane, which a step leaves as they are."""
        return [*self.p[:, lanes], *self._constants(lanes, later)]

    def _constants(self, lanes: Array, later: int = 0) -> Array:
        """Returns the constants of the interval that ends at the next time of each lane or, if
        `later` is 1, of the interval that begins there; tables[i] holds up to times[i]."""
        last = len(self.tables) - 1
        interval = np.minimum(self.place[lanes] + later, last)
        return self.tables[interval, self.case[lanes]].T

    def _step(self, live: Array, h: Array) -> tuple[Array, Array, Array]:
        """Computes states, sensitivities and the error in units of the tolerance after a step h of
        the lanes `live`."""
        y = self.y[:, live]
        n, lanes = y.shape
        at = self._point(live)
        J = self._values("J", at, lanes).reshape(n, n, lanes)
        if self.stretched:
            self._stretch(live, J)
        # W = I / (h gamma) - J is factored once for all stages.
        W = -J
        W[range(n), range(n)] += 1 / (h * GAMMA)
        exchanged = _factor(W)
        K, D = self._stages(live, h, W, exchanged)
        # Stiffly accurate: the last stage starts from the embedded solution, and is its error.
        y1 = _ended(y, K)
        S1 = self.S[:, :, live]
        if self.q:
            S1 = _ended(S1, D)
        largest = np.maximum(np.abs(y), np.abs(y1))
        # The norm is the largest error of a state in units of its tolerance.
        rounding = _rounding(J, h, largest)
        tolerance = np.maximum(self.atol + self.rtol * largest, rounding)
        error = (np.abs(K[-1]) / tolerance).max(axis=0)
        if self.timed:
            # A pulse between the stages shows in the mean rate over the step.
            unseen = _solved(W, exchanged, self._unseen(live, h))
            tolerance = np.maximum(self.atol + _UNSEEN * largest, rounding)
            missed = (np.abs(unseen) / tolerance).max(axis=0)
            error = np.where(missed > 1.0, np.fmax(missed, error), error)
        if self.divided:
            # Beyond a pole the solution is another one: the step is refused until it is very short.
            crossed = self._crossed(live, at, h, y1)
            long = h > _THROUGH * self.interval
            error = np.where(crossed & long, np.inf, error)
        return y1, S1, error

    def _stages(
        self, live: Array, h: Array, W: Array, exchanged: Sequence[Array]
    ) -> tuple[list[Array], list[Array]]:
        """Computes the stages u_i, each (states, lanes), and their derivatives along every
        direction; the latter for a Jacobian alone.

        W u_i = f(t + alpha_i h, y + sum_j a_ij u_j) + gamma_i h df/dt + sum_j c_ij u_j / h, by
        u_j = sum_k gamma_jk k_k in place of the slopes k (Hairer and Wanner).
        """
        q = self.q
        lanes = len(live)
        t = self.t[live]
        y = self.y[:, live]
        S = self.S[:, :, live]
        held = self._held(live)
        at = [t, *y, *held]
        ways = [*S, *self.directions]
        ft = self._values("ft", at, lanes)
        dft = ft
        if q:
            dft = self._values("dft", at + ways, q, lanes)
        K = list[Array]()
        D = list[Array]()
        for a, b, node, weight in zip(A, C, NODES, TIME_WEIGHTS, strict=True):
            u = y + _weighted(a, K)
            inside = [t + node * h, *u, *held]
            rest = self._values("f", inside, lanes) + h * weight * ft
            rest = rest + _weighted(b, K) / h
            K.append(_solved(W, exchanged, rest))
            if q:
                # The same stage differentiated; dW = -dJ adds (dJ) u_i to the right side.
                V = S + _weighted(a, D)
                moved = self._values("df", [*inside, *V, *self.directions], q, lanes)
                turned = self._values("dJk", [*at, *K[-1], *ways], q, lanes)
                rest = moved + h * weight * dft
                rest = rest + _weighted(b, D) / h
                rest = rest + turned
                D.append(_solve(W, exchanged, rest))
        return K, D

    def _stretch(self, live: Array, J: Array) -> None:
        """Notes the spectral radius of J here: an explicit method is stable while h |lambda| stays
        below the reach of its stability region."""
        # From where J is not finite no step goes on.
        finite = np.nan_to_num(np.moveaxis(J, 2, 0), posinf=0.0, neginf=0.0)
        radius = np.abs(np.linalg.eigvals(finite)).max(axis=1)
        self.radius[live] = radius
        faster = live[radius > self.fastest[live]]
        self.met[faster] = self.t[faster]
        self.fastest[live] = np.maximum(self.fastest[live], radius)

    def _crossed(self, live: Array, at: Sequence[Any], h: Array, y1: Array) -> Array:
        """Tells the lanes in which something that the rates divide by changes its sign."""
        after = [self.t[live] + h, *y1, *self._held(live)]
        before_sides = self._values("side", at, len(live))[0]
        return before_sides != self._values("side", after, len(live))[0]

    def _unseen(self, live: Array, h: Array) -> Array:
        """Computes the mean of the rates over a step with the states held, less what its ends and
        its middle say, each (states, lanes)."""
        found = np.zeros((len(self.y), len(live)))
        # As many looks as fall into the step, in powers of two so that few sizes occur.
        wanted = np.maximum(_LOOKS * h / self.interval, 1.0)
        powers = np.ceil(np.log2(wanted))
        powers = np.minimum(powers, np.log2(_LOOKS)).astype(int)
        for power in sorted(set(powers[powers > 0].tolist())):
            here = powers == power
            lanes = live[here]
            count = 2**power
            inner = (np.arange(count) + 0.5) / count
            shares = np.append([0.0, 0.5, 1.0], inner)[:, None]
            _, *rest = self._point(lanes)
            at = (self.t[lanes] + shares * h[here], *rest)
            f = self._values("f", at, len(shares), len(lanes))
            # The midpoint rule of all looks, less Simpson's rule of the ends and the middle.
            begin, middle, end = f[:, :3].swapaxes(0, 1)
            by_simpson = (begin + 4.0 * middle + end) / 6.0
            found[:, here] = _sums(f[:, 3:]) / count - by_simpson
        return found

    def _first_step(self) -> Array:
        lanes = len(self.t)
        scale = self.atol + self.rtol * np.abs(self.y)
        f = self._values("f", self._point(np.arange(lanes)), lanes)
        # h = 1e-3 |y| / |y'| in units of the tolerance, after Hairer, Norsett, Wanner I, section
        # II.4.
        speed = (np.abs(f) / scale).max(axis=0)
        size = (np.abs(self.y) / scale).max(axis=0)
        moves = (speed > 1e-5) & (size > 1e-5)
        wanted = np.minimum(1e-3 * size / speed, self.end)
        return np.where(moves, wanted, 1e-6 * self.end)


def _usual(times: Array) -> float:
    """Computes the usual interval between readings: the unit of steps at poles and of looks at
    pulses."""
    intervals = np.diff(times, prepend=0.0)
    if not intervals.any():
        return 1.0
    return float(np.median(intervals[intervals > 0.0]))


def _to_the_reading(h: Array, left: Array) -> Array:
    """Cuts steps that overshoot the next reading, and halves those that would leave a sliver before
    it."""
    sliver = np.where(2 * h > left, left / 2, h)
    return np.where(h >= left * (1 - 1e-9), left, sliver)


def _rounding(J: Array, h: Array, sizes: Array) -> Array:
    """Computes what round-off of the rates moves states (n, lanes) by in a step h, from J (n, n,
    lanes): all that a state holds that would be 0, as where large ones cancel in its rate."""
    terms = _sums(np.abs(J) * sizes)
    # A state that is pulled back as fast as J_ii forgets what is older than 1 / |J_ii|.
    pull = np.abs(J[range(len(J)), range(len(J))])
    return _ROUNDING * terms * h / (1.0 + GAMMA * h * pull)


def _sums(values: Array) -> Array:
    """Sums values (rows, many, lanes) over the many, in an order that lanes have no part in: NumPy
    sums pairwise what lies side by side, and one after another what does not."""
    return np.ascontiguousarray(values.swapaxes(1, 2)).sum(axis=2)


def _weighted(weights: Sequence[float], stages: Sequence[Array]) -> Any:
    return sum(weight * stage for weight, stage in zip(weights, stages, strict=True))


def _ended(before: Array, stages: Sequence[Array]) -> Array:
    """Computes the end of a step: the point at which the last stage is evaluated, and this
    stage."""
    *others, last = stages
    return before + _weighted(A[-1], others) + last


def _factor(W: Array) -> list[Array]:
    """Factors each lane of W (n, n, lanes) into LU, in place; returns the pivot rows (lanes,) that
    were exchanged."""
    lanes = np.arange(W.shape[2])
    exchanged = list[Array]()
    for k in range(len(W)):
        # The pivot is the largest entry on or below the diagonal; its row comes up.
        row = k + np.argmax(np.abs(W[k:, k]), axis=0)
        top = W[k].T.copy()
        W[k] = W[row, :, lanes].T
        W[row, :, lanes] = top
        # Column k of L, and what remains to be factored: W <- W - l_k u_k'.
        W[k + 1 :, k] /= W[k, k]
        W[k + 1 :, k + 1 :] -= W[k + 1 :, k, None] * W[k, k + 1 :]
        exchanged.append(row)
    return exchanged


def _solve(W: Array, exchanged: Sequence[Array], b: Array) -> Array:
    """Computes W^-1 b of every lane for b (n, columns, lanes), in place."""
    lanes = np.arange(b.shape[2])
    # P b, then L z = P b forward, then U x = z backward.
    for k, row in enumerate(exchanged):
        top = b[k].T.copy()
        b[k] = b[row, :, lanes].T
        b[row, :, lanes] = top
    for k in range(len(W)):
        b[k + 1 :] -= W[k + 1 :, k, None] * b[k]
    for k in reversed(range(len(W))):
        b[k] /= W[k, k]
        b[:k] -= W[:k, k, None] * b[k]
    return b


def _solved(W: Array, exchanged: Sequence[Array], b: Array) -> Array:
    """Computes W^-1 b of every lane for vectors b (n, lanes)."""
    return _solve(W, exchanged, b[:, None])[:, 0]
