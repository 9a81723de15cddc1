"""Plans what an integrator of recorded equations computes: formulas, programs, and where their
numbers lie.

`Recording` calls the functions of a model once, and holds what they do as expressions. `_Linear`
takes their tangents apart: what changes at each stage, and what is computed once a lane. `planned`
gives each number a place in a frame, the memory of one lane, and returns a `StepPlan`: the programs
of a step, which the integrator runs in every lane.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ipe_bench.engine import trace
from ipe_bench.engine.trace import Expression, Graph, Program

Recordable = Callable[..., Sequence[Any]]
_POINTS, _NEWTON = 64, 30
"""Points at which a comparison is examined, and the steps that move them to where it changes."""
ROUGH = 0.005
"""Error of a single step, by the embedded formula of fifth order, that puts a trial in doubt, as a
share of the state's largest magnitude so far and of its next change. Right steps to 1e-8 leave
1e-6, one that jumps 0.007. What changes with t alone, as a pulse does, is no doubt."""


@dataclass(frozen=True)
class Tableau:
    """Holds an explicit formula: stage s starts from y + h sum_j A[s][j] k_j at t + C[s] h, the
    step ends at y + h sum_s B[s] k_s."""

    A: tuple[tuple[float, ...], ...]
    B: tuple[float, ...]
    C: tuple[float, ...]
    E: tuple[float, ...] = ()
    """Weights of the difference from an embedded formula of lower order; none: there is no such
    formula."""

    @property
    def stages(self) -> int:
        return len(self.B)

    @property
    def weights(self) -> list[list[tuple[int, float]]]:
        """Weights of the slopes that count, for every stage, and last for the end of the step."""
        return [[(j, v) for j, v in enumerate(row) if v != 0.0] for row in (*self.A, self.B)]


# fmt: off
DOP853 = Tableau(
    A=(
        (),
        (0.05260015195876773,),
        (0.0197250569845379, 0.0591751709536137),
        (0.02958758547680685, 0.0, 0.08876275643042054),
        (0.2413651341592667, 0.0, -0.8845494793282861, 0.924834003261792),
        (0.037037037037037035, 0.0, 0.0, 0.17082860872947386, 0.12546768756682242),
        (0.037109375, 0.0, 0.0, 0.17025221101954405, 0.06021653898045596, -0.017578125),
        (
            0.03709200011850479, 0.0, 0.0, 0.17038392571223998, 0.10726203044637328,
            -0.015319437748624402,
            0.008273789163814023,
        ),
        (
            0.6241109587160757, 0.0, 0.0, -3.3608926294469414, -0.868219346841726,
            27.59209969944671,
            20.154067550477894, -43.48988418106996,
        ),
        (
            0.47766253643826434, 0.0, 0.0, -2.4881146199716677, -0.590290826836843,
            21.230051448181193,
            15.279233632882423, -33.28821096898486, -0.020331201708508627,
        ),
        (
            -0.9371424300859873, 0.0, 0.0, 5.186372428844064, 1.0914373489967295,
            -8.149787010746927,
            -18.52006565999696, 22.739487099350505, 2.4936055526796523, -3.0467644718982196,
        ),
        (
            2.273310147516538, 0.0, 0.0, -10.53449546673725, -2.0008720582248625, -17.9589318631188,
            27.94888452941996,
            -2.8589982771350235, -8.87285693353063, 12.360567175794303, 0.6433927460157636,
        ),
    ),
    B=(
        0.054293734116568765, 0.0, 0.0, 0.0, 0.0, 4.450312892752409, 1.8915178993145003,
        -5.801203960010585,
        0.3111643669578199, -0.1521609496625161, 0.20136540080403034, 0.04471061572777259,
    ),
    C=(
        0.0, 0.05260015195876773, 0.0789002279381516, 0.1183503419072274, 0.2816496580927726,
        0.3333333333333333, 0.25,
        0.3076923076923077, 0.6512820512820513, 0.6, 0.8571428571428571, 1.0,
    ),
    E=(
        0.01312004499419488, 0.0, 0.0, 0.0, 0.0, -1.2251564463762044, -0.4957589496572502,
        1.6643771824549864,
        -0.3503288487499737, 0.3341791187130175, 0.08192320648511571, -0.0223553078638863,
    ),
)
# fmt: on
"""Eighth order in twelve stages (Dormand and Prince; Hairer, Norsett, Wanner, Solving Ordinary
Differential Equations I, 2nd ed. 1993, II.5, table 5.4 and the code DOP853)."""

RK4 = Tableau(
    A=((), (0.5,), (0.0, 0.5), (0.0, 0.0, 1.0)),
    B=(1 / 6, 1 / 3, 1 / 3, 1 / 6),
    C=(0.0, 0.5, 0.5, 1.0),
)
"""The classical formula of fourth order (Kutta, 1901)."""


@dataclass(frozen=True)
class Variation:
    """Holds equations of small deviations, where fewer numbers than the state has describe them."""

    freedoms: int
    slope: Recordable
    """(t, y, p, c, d, dp): the time derivative of a deviation d (freedoms,) along the direction dp
    (n,)."""
    moved: Recordable
    """(y, d): by how much the state (states,) deviates, linear in d."""


@dataclass(frozen=True)
class Equations:
    """Holds functions that can be recorded, and the numbers of their arguments and results."""

    states: int
    parameters: int
    constants: int
    outputs: int
    start: Recordable
    rhs: Recordable
    read: Recordable
    variation: Variation | None = None
    driven: int = 0
    """Number of constants, the last ones, that change from one interval between readings to the
    next."""
    watched: bool = False
    """Whether simulations note a step that is rough, or that crosses a pole."""


class Recording:
    """Holds equations as expressions of the time t, states y, parameters p and constants c;
    `moving` change."""

    def __init__(self, equations: Equations) -> None:
        self.equations = equations
        graph = self.graph = Graph()
        self.t = graph.input("t")
        self.y = graph.inputs("y", equations.states)
        self.p = graph.inputs("p", equations.parameters)
        self.c = graph.inputs("c", equations.constants)
        driven = self.c[equations.constants - equations.driven :]
        self.moving = (self.t, *self.y, *driven)
        point = (self.t, self.y, self.p, self.c)
        self.start = self._values(equations.start(self.p, self.c), equations.states, "start")
        self.slope = self._values(equations.rhs(*point), equations.states, "rhs")
        self.shown = self._values(equations.read(*point), equations.outputs, "read")

    def _values(self, result: Iterable[Any], count: int, name: str) -> list[Expression]:
        values = [self.graph.apply("add", v, 0.0) for v in result]
        if len(values) != count:
            raise ValueError(f"{name} returns {len(values)} values where {count} are declared")
        return values

    @property
    def timed(self) -> bool:
        """Whether the rates depend on t itself."""
        return not trace.dependent(self.slope, [self.t]).isdisjoint(self.slope)

    @cached_property
    def divisors(self) -> list[Expression]:
        """What the rates divide by, where it changes along a solution."""
        varying = trace.dependent(self.slope, self.moving)
        divisors = list[Expression]()
        # a / b divides by b, and a^b by a where b is a negative number.
        for e in trace.in_order(self.slope):
            base, *others = trace.operands(e) or [e]
            if e.operation == "div":
                divisors += others
            elif e.operation == "pow" and (others[0].value or 0.0) < 0.0:
                divisors.append(base)
        return [e for e in _distinct(divisors) if e in varying]

    @cached_property
    def divided_by(self) -> list[bool]:
        """Whether the rates divide by something that a state is part of, for each state."""
        parts = [trace.dependent(self.divisors, [y]) for y in self.y]
        return [not part.isdisjoint(self.divisors) for part in parts]

    @cached_property
    def side(self) -> Expression:
        """A number that tells the signs of all that the rates divide by: where it changes, a pole
        has been crossed."""
        side = self.graph.constant(0.0)
        for i, divisor in enumerate(self.divisors):
            # Each divisor has a binary digit: 1 where it is negative. Beyond 50, whose sum a float
            # holds exactly, divisors share digits, which add.
            side = side + 2.0 ** (i % 50) * self.graph.apply("less", divisor, 0.0)
        return side

    @cached_property
    def noted(self) -> list[Expression]:
        """What is noted of the start: magnitudes of the states, the side of the poles, and no
        doubt."""
        nothing = self.graph.constant(0.0)
        at_start = dict(zip(self.y, self.start, strict=True))
        sizes = [self.graph.apply("add", np.abs(y), 0.0) for y in self.start]
        sides = trace.substitute([self.side], {self.t: nothing} | at_start)
        return [*sizes, *sides, nothing]

    def watch(self, formula: Tableau) -> Program:
        """Notes whether a step crossed a pole or was rough, from its length, the states at its end,
        the slopes of its stages, where the rates depend on t those with the states held, the sides
        of its stages, and what was noted."""
        graph = self.graph
        n = self.equations.states
        stages = formula.stages
        h = graph.input("h")
        ended = graph.inputs("ended", n)
        slopes = graph.inputs("k", n * stages)
        held = graph.inputs("held", n * stages) if self.timed else ()
        sides = graph.inputs("side", stages)
        reach = graph.inputs("reach", n)
        began, doubt = graph.inputs("noted", 2)
        given = [h, *ended, *slopes, *held, *sides, *reach, began, doubt]
        larger = [self._larger(before, now) for before, now in zip(reach, ended, strict=True)]
        # What the time alone does to the rates is no doubt.
        moved = slopes
        if held:
            moved = [k - alone for k, alone in zip(slopes, held, strict=True)]
        # A divisor that changed its sign in any stage: a pole was crossed.
        for side in sides:
            changed = (side < began) + (began < side)
            doubt = graph.apply("where", changed, 1.0, doubt)
        for i, largest in enumerate(larger):
            rough = self._rough(formula, h, moved[i::n], largest)
            doubt = graph.apply("where", rough, 1.0, doubt)
        return Program.of([*larger, began, doubt], given)

    def _larger(self, before: Expression, now: Expression) -> Expression:
        """The largest magnitude of a state so far, this step's end included."""
        size: Any = np.abs
        return self.graph.apply("where", before < size(now), size(now), before)

    @staticmethod
    def _rough(formula: Tableau, h: Any, slopes: Sequence[Any], largest: Any) -> Any:
        """Whether the embedded formula doubts a step of one state, from its slopes."""
        size: Any = np.abs
        # h sum_s E_s k_s is the difference from the embedded formula.
        error = sum(weight * k for weight, k in zip(formula.E, slopes, strict=True) if weight)
        return ROUGH * (largest + size(h * slopes[-1])) < size(h * error)

    @cached_property
    def tangents(self) -> tuple[Any, Any, list[Expression], list[Expression], list[Expression]]:
        """A deviation d, a direction dp of the parameters, and how slope, readings and start move
        along them."""
        graph = self.graph
        variation = self.equations.variation
        dp = graph.inputs("dp", self.equations.parameters)
        starts = trace.tangent(self.start, dict(zip(self.p, dp, strict=True)))
        # The variational equations (d/dt) dy = df/dy dy + df/dp dp, with dy = dy0/dp dp at the
        # start.
        if variation is None:
            d = graph.inputs("d", self.equations.states)
            dy: Sequence[Any] = d
            slopes = trace.tangent(self.slope, self._along(d, dp))
        else:
            if any(e.value != 0.0 for e in starts):
                raise ValueError(
                    "equations of small deviations need a start that does not depend on the"
                    " parameters"
                )
            d = graph.inputs("d", variation.freedoms)
            dy = variation.moved(self.y, d)
            slopes = variation.slope(self.t, self.y, self.p, self.c, d, dp)
            slopes = self._values(slopes, variation.freedoms, "slope")
            starts = [graph.constant(0.0)] * variation.freedoms
        dy = [graph.apply("add", v, 0.0) for v in dy]
        return d, dp, slopes, trace.tangent(self.shown, self._along(dy, dp)), starts

    def _along(self, dy: Sequence[Expression], dp: Sequence[Expression]) -> dict[Any, Any]:
        """Maps states and parameters to their directions."""
        return dict(zip([*self.y, *self.p], [*dy, *dp], strict=True))

    def along_each(
        self, directions: Sequence[Expression], tangents: Sequence[Expression]
    ) -> list[list[Expression]]:
        """Returns the tangents along each direction alone."""
        # A unit vector in place of the direction leaves one column of the derivative.
        one, zero = self.graph.constant(1.0), self.graph.constant(0.0)
        alone = []
        for along in directions:
            unit = {other: one if other is along else zero for other in directions}
            alone.append(trace.substitute(tangents, unit))
        return alone

    def fixed(self, *outputs: Expression) -> list[Expression]:
        """Returns what is computed once for each lane: it depends on the parameters and the case
        alone."""
        return trace.border(outputs, trace.dependent(outputs, self.moving))


class _Linear:
    """Holds tangents of some outputs: their program, its inputs from the state, and the sources of
    each direction."""

    def __init__(
        self,
        tape: Recording,
        d: Sequence[Expression],
        dp: Sequence[Expression],
        tangents: Sequence[Expression],
    ) -> None:
        # Tangents are linear, dy' = J dy + source: a source depends on the direction alone.
        outputs, sources = trace.separate(tangents, d, dp)
        names = [tape.graph.input(f"source{i}") for i in range(len(sources))]
        self.sources = tape.along_each(dp, sources)
        """The value (n, sources) of each source along each parameter."""
        linear_in = (*d, *names)
        needed = trace.border(outputs, trace.dependent(outputs, linear_in))
        values = [e for row in self.sources for e in row]
        # What changes along a solution is kept at each stage; what does not is computed once a
        # lane.
        varying = trace.dependent([*needed, *values], tape.moving)
        self.fixed = [e for e in needed if e not in varying]
        self.saved = [e for e in needed if e in varying]
        driving = [e for e in values if e in varying]
        self.driving = _distinct(e for e in driving if e not in self.saved)
        self.constant = _distinct(e for e in values if e not in varying)
        self.inputs = [*linear_in, *self.saved]
        self.outputs = outputs

    def placed(self, at: range, fixed: Sequence[Expression]) -> Tangents:
        """Places the program: saved, driving and constant inputs lie one after another from the
        start of `at`."""
        lying = [*self.saved, *self.driving, *self.constant]
        order = {e: at.start + i for i, e in enumerate(lying)}
        sources = tuple(tuple(order[e] for e in row) for row in self.sources)
        program = Program.of(self.outputs, [*self.inputs, *fixed])
        return Tangents(program, sources, at[: len(self.saved)])


def _distinct(expressions: Iterable[Expression]) -> list[Expression]:
    return list(dict.fromkeys(expressions))


@dataclass(frozen=True)
class Tangents:
    """Holds derivatives of slopes or readings along each direction."""

    program: Program
    """Program of a tangent of the state, its sources, what is saved of the state, and what is
    fixed."""
    sources: tuple[tuple[int, ...], ...]
    """The places (n, sources) of what drives each direction; of slopes, in the first stage."""
    saved: range


@dataclass(frozen=True)
class StepPlan:
    """Holds programs, and the places of their inputs and outputs in a frame."""

    tableau: Tableau
    x: range
    constants: range
    begin: Program
    begun: tuple[int, ...]
    """Places of the results of `begin`: state, what is fixed, and for Jacobians tangents and
    constant sources."""
    y: range
    driven: range
    """Places of the constants that change from interval to interval, the last ones."""
    fixed: range
    step: Program
    """Program from (t, y, driven, fixed) to the slope, and to what tangents need of a stage."""
    kept: tuple[range, ...]
    """Places where each stage keeps what tangents need."""
    stage_size: int
    read: Program
    """Program from the same to the readings, or to what their tangents need."""
    noted: range
    shown: range
    size: int
    tangents: tuple[range, ...]
    """Places of the tangents; none if readings are computed, and not Jacobians."""
    motion: Tangents
    reading: Tangents
    rates: Program
    """What `step` computes but for the side of the poles: what a step costs is what the solution
    needs."""
    timed: bool
    """Whether the rates depend on t itself."""
    watch: Program
    """Program that notes what a step shows; see `Recording.watch`."""
    reach: range
    """Places of the largest magnitude of each state so far; none if no step is watched."""
    side: range
    """Place of the side of the poles on which the trial began."""
    doubt: range
    """Place of 1 once a step was rough or crossed a pole."""

    @property
    def operations(self) -> int:
        """Arithmetic operations of a step of one lane: its cost on any machine."""
        of_state = self._operations(self.rates, self.y)
        tangents = [self._operations(self.motion.program, place) for place in self.tangents]
        return of_state + sum(tangents)

    def _operations(self, program: Program, place: range) -> int:
        """Those of a program in every stage, and of the weighted sums of its results."""
        counted = sum(name not in ("constant", "neg") for name, *_ in program.operations)
        weighed = sum(map(len, self.tableau.weights))
        return self.tableau.stages * counted + len(place) * weighed


def jumps(equations: Equations) -> bool:
    """Tells whether the rates jump at a moment that the solution decides: it is no end of a step,
    and slopes would lack what they owe to it. Both sides of a comparison are evaluated at points
    that are moved to where its operands are equal; if they agree there, it is a kink and no jump.
    `floor`, and `mod` by it, jumps whatever it is taken of."""
    tape = Recording(equations)
    moving = trace.dependent(tape.slope, (tape.t, *tape.y))
    if any(e.operation == "floor" for e in moving):
        return True
    comparisons = [e for e in trace.in_order(tape.slope) if e.operation in trace.COMPARING]
    return any(_jumps_at(tape, e) for e in comparisons if e in moving)


def _jumps_at(tape: Recording, comparison: Expression) -> bool:
    """Tells whether the rates jump where this comparison changes."""
    graph = tape.graph
    # A number that is compared with itself is asked whether it is one.
    left, right = comparison.operands
    if left is right:
        return False
    # A comparison changes where its operands are equal: gap = 0.
    gap = graph.apply("sub", left, right)
    inputs = [tape.t, *tape.y, *tape.p, *tape.c]
    held = trace.substitute(tape.slope, {comparison: graph.constant(1.0)})
    failed = trace.substitute(tape.slope, {comparison: graph.constant(0.0)})
    for place, along in enumerate((tape.t, *tape.y)):
        tangents = trace.tangent([gap], {along: graph.constant(1.0)})
        program = Program.of([gap, *tangents, *held, *failed], inputs)
        if _differ_at_the_root(program, place, len(inputs)):
            return True
    return False


def _differ_at_the_root(program: Program, place: int, inputs: int) -> bool:
    """Tells whether both halves of what a program shows behind a gap and its slope differ where the
    gap is 0, which is searched along one input."""
    point = list(np.random.default_rng(1).uniform(-2.0, 2.0, (inputs, _POINTS)))
    with np.errstate(all="ignore"):
        # Newton's method, in one coordinate: x <- x - gap / (dgap/dx).
        for _ in range(_NEWTON):
            value, slope, *_ = program(point)
            point[place] = point[place] - value / slope
        value, _, *shown = program(point)
        # The rates as if the comparison held there, and as if it did not.
        half = len(shown) // 2
        a = np.stack(np.broadcast_arrays(value, *shown[:half]))
        b = np.stack(np.broadcast_arrays(value, *shown[half:]))
        apart = np.abs(a - b) > 1e-6 * (1.0 + np.abs(a) + np.abs(b))
        return bool((apart & (np.abs(value) < 1e-9)).any())


def planned(equations: Equations, tableau: Tableau, *, sensitive: bool) -> StepPlan:
    """Plans how readings or their Jacobians are computed: the state once, and beside it one tangent
    for each parameter, by the variational equations in the stages of the state's own steps."""
    tape = Recording(equations)
    d, dp, slopes, shown, starts = tape.tangents if sensitive else ([], [], [], [], [])
    watched = equations.watched and not sensitive
    motion = _Linear(tape, d, dp, slopes)
    reading = _Linear(tape, d, dp, shown)
    # What tangents need of a stage: what is kept of the state, and what drives a direction.
    saved = [*motion.saved, *motion.driving]
    noted = [*reading.saved, *reading.driving] if sensitive else tape.shown
    sides = [tape.side] if watched else []
    of_state = tape.fixed(*tape.slope, *saved, *noted, *sides)
    fixed = _distinct([*of_state, *motion.fixed, *reading.fixed])
    # The frame, one vector after another: parameters, constants, state, what is fixed, tangents,
    # what each stage keeps, readings, and what is noted of steps.
    frame = _Frame()
    x = frame.room(equations.parameters)
    constants = frame.room(equations.constants)
    y = frame.room(equations.states)
    fixed_at = frame.room(len(fixed))
    lie = tuple(frame.room(len(d)) for _ in dp)
    stages = [frame.room(len(saved) + len(motion.constant)) for _ in tableau.B]
    noted_at = frame.room(len(noted) + len(reading.constant))
    shown_at = frame.room(equations.outputs) if sensitive else noted_at
    reach = frame.room(equations.states if watched else 0)
    side = frame.room(1 if watched else 0)
    doubt = frame.room(1 if watched else 0)
    # Where the results of `begin` go, in the order in which they are started below.
    kept_constant = [stage[len(saved) :] for stage in stages]
    begun = [y, fixed_at, *lie, *kept_constant, noted_at[len(noted) :]]
    started = [*tape.start, *fixed]
    for row in tape.along_each(dp, starts):
        started += row
    started += [*motion.constant * tableau.stages, *reading.constant]
    if watched:
        begun += [reach, side, doubt]
        started += tape.noted
    # `step` computes the slopes and, in one program, what else a stage has to leave.
    given = [*tape.moving, *fixed]
    return StepPlan(
        tableau=tableau,
        x=x,
        constants=constants,
        begin=Program.of(started, [*tape.p, *tape.c]),
        begun=tuple(i for place in begun for i in place),
        y=y,
        driven=constants[len(constants) - equations.driven :],
        fixed=fixed_at,
        step=Program.of([*tape.slope, *saved, *sides], given),
        kept=tuple(stage[: len(saved)] for stage in stages),
        stage_size=len(stages[0]),
        read=Program.of(noted, given),
        noted=noted_at[: len(noted)],
        shown=shown_at,
        size=frame.size,
        tangents=lie,
        motion=motion.placed(stages[0], fixed),
        reading=reading.placed(noted_at, fixed),
        rates=Program.of([*tape.slope, *saved], given),
        timed=tape.timed,
        watch=tape.watch(tableau) if watched else Program.of([], []),
        reach=reach,
        side=side,
        doubt=doubt,
    )


class _Frame:
    """Gives out places, one vector after another."""

    def __init__(self) -> None:
        self.size = 0

    def room(self, count: int) -> range:
        self.size += count
        return range(self.size - count, self.size)
