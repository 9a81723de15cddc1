"""Plans how a solution of recorded equations is computed: which programs, and where their numbers
lie.

One lane, a trial in a case, is integrated in a *frame*: a row of numbers that holds the parameters,
the state, and all that is passed from one program to another. A `StepPlan` gives each of them a
place. `begin` fills the frame at time 0, `step` computes the slope in every stage of an explicit
Runge-Kutta formula, and `read` what is shown at a reading's time. Jacobians come from the
variational equations d' = J d + source, in the same stages: each direction of the parameters has
its own d and source, and J is shared. So each stage of the state leaves what J and the sources need
of it, and what does not change along the solution is computed once.

For example y' = -p y with y(0) = 1, of which y is read. Its readings take a frame of 4 numbers:

    place   0   1   2    3
    holds   p   y   -p   reading

`begin` fills 1 and 2 (-p is `fixed`), `rates` multiplies 2 by 1, `read` copies 1 to 3. Its
Jacobians, by a formula of 12 stages, take a frame of 17, where d' = -p d - y begins at d = 0; the
coefficient -p of d is fixed, and the source -y changes from stage to stage:

    place   0   1   2    3   4 to 15              16
    holds   p   y   -p   d   -y of each stage     reading of d

The fields of a `StepPlan` that differ:

    field     of readings                     of Jacobians
    rates     slope                           slope, and what a stage keeps for deviations
    step      rates, and the side of poles    rates
    read      the readings                    what the reading of a deviation needs
    read_at   places of the readings          places of what that needs
    shown     `read_at` itself                places of a deviation of the readings

`emit.integrator` writes machine code of a plan: it alone reads the places, and the order of the
calls of `_Frame.room` is their order. A wrong place computes a wrong number: the tests of
test_ode_paths.py hold every path to the bits of a plain loop.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from ipe_bench.engine import trace, watch
from ipe_bench.engine.equations import Deviations, Equations, Recording
from ipe_bench.engine.tableaus import Tableau
from ipe_bench.engine.trace import Expression, Program


@dataclass(frozen=True)
class LinearProgram:
    """Holds a program J d + source of a deviation d, and where its inputs lie.

    Places of the slope of a deviation are those of the first stage: stage s lies s times
    `TangentPlan.stage_size` further on.
    """

    program: Program
    """Program from (d, sources, coefficients, fixed)."""
    sources: tuple[tuple[int, ...], ...]
    """Places (parameters, sources) of the sources along each parameter."""
    saved: range
    """Places of the coefficients in J that change along the solution."""


@dataclass(frozen=True)
class TangentPlan:
    """Holds how deviations along each parameter are computed beside the state."""

    places: tuple[range, ...]
    """Places of the deviation along each parameter."""
    motion: LinearProgram
    """Program of the slope of a deviation."""
    reading: LinearProgram
    """Program of the readings' deviation."""
    kept: tuple[range, ...]
    """Places where each stage keeps the coefficients and sources that change along the solution;
    behind them lie the sources that do not change."""
    stage_size: int
    """Numbers that lie in a stage."""


@dataclass(frozen=True)
class WatchPlan:
    """Holds how steps are watched; see `watch`."""

    program: Program
    timed: bool
    """Whether the rates depend on t itself."""
    reach: range
    """Places of the largest magnitude of each state so far."""
    side: range
    """Place of the side of the poles on which the trial began."""
    doubt: range
    """Place of 1 once a step was rough or crossed a pole."""

    @property
    def carried(self) -> tuple[int, ...]:
        """Places of what is passed from step to step."""
        return (*self.reach, *self.side, *self.doubt)


@dataclass(frozen=True)
class StepPlan:
    """Holds programs, and the places of their inputs and outputs in a frame."""

    tableau: Tableau
    x: range
    """Places of the parameters."""
    constants: range
    y: range
    """Places of the state."""
    driven: range
    """Places of the constants that change from interval to interval, the last ones."""
    fixed: range
    """Places of what is computed once a lane."""
    begin: Program
    begun: tuple[int, ...]
    """Places of the results of `begin`."""
    rates: Program
    """Program from (t, y, driven, fixed) to the slope and, for Jacobians, to the coefficients and
    sources of deviations that a stage keeps."""
    step: Program
    """Program that stages run: `rates`, and where steps are watched also the side of the poles."""
    read: Program
    """Program from (t, y, driven, fixed) to the readings or, for Jacobians, to the coefficients
    and sources of their deviation."""
    read_at: range
    """Places of the results of `read`."""
    shown: range
    """Places of the readings, which are `read_at` itself, or of their deviation along a
    direction."""
    size: int
    """Numbers of a frame."""
    tangents: TangentPlan | None = None
    """None if readings are computed, and not Jacobians."""
    watch: WatchPlan | None = None

    @property
    def told(self) -> tuple[int, ...]:
        """Places of what is told of each reading's time beside the readings: the state, and where
        steps are watched the doubt."""
        doubt = [] if self.watch is None else self.watch.doubt
        return (*self.y, *doubt)

    @property
    def operations(self) -> int:
        """Arithmetic operations of a step of one lane: its cost on any machine."""
        total = self._operations(self.rates, self.y)
        if self.tangents is not None:
            for place in self.tangents.places:
                total += self._operations(self.tangents.motion.program, place)
        return total

    def _operations(self, program: Program, place: range) -> int:
        """Counts those of a program in every stage, and of the weighted sums of its results."""
        counted = sum(name not in ("constant", "neg") for name, *_ in program.operations)
        weighed = sum(map(len, self.tableau.weights))
        return self.tableau.stages * counted + len(place) * weighed


def planned(equations: Equations, tableau: Tableau, *, sensitive: bool) -> StepPlan:
    """Plans how readings or, if `sensitive`, their Jacobians are computed."""
    tape = Recording(equations)
    return _plan_jacobians(tape, tableau) if sensitive else _plan_readings(tape, tableau)


def _plan_readings(tape: Recording, tableau: Tableau) -> StepPlan:
    """Plans the state alone, whose steps may be watched."""
    watched = tape.equations.watched
    sides = [watch.side_of_poles(tape)] if watched else []
    frame = _Frame(tape, tape.fixed(*tape.slope, *tape.shown, *sides))
    shown = frame.room(len(tape.shown))
    watch_plan = None
    if watched:
        watch_plan = WatchPlan(
            program=watch.step_watched(tape, tableau),
            timed=tape.timed,
            reach=frame.room(len(tape.y)),
            side=frame.room(1),
            doubt=frame.room(1),
        )
        frame.fill(watch_plan.carried, watch.begun(tape, *sides))
    return frame.plan(
        tableau,
        rates=frame.program(tape.slope),
        step=frame.program([*tape.slope, *sides]),
        read=frame.program(tape.shown),
        read_at=shown,
        shown=shown,
        watched=watch_plan,
    )


def _plan_jacobians(tape: Recording, tableau: Tableau) -> StepPlan:
    """Plans the state and, in the stages of its steps, a deviation along each parameter."""
    along = tape.deviations
    motion = _Linear(tape, along, along.slope)
    reading = _Linear(tape, along, along.shown)
    of_state = tape.fixed(*tape.slope, *motion.changing, *reading.changing)
    fixed = _distinct([*of_state, *motion.fixed, *reading.fixed])
    frame = _Frame(tape, fixed)
    # A deviation begins with the start's own along each parameter.
    deviations = []
    for start in tape.along_each(along.dp, along.start):
        deviations.append(frame.room(len(start)))
        frame.fill(deviations[-1], start)
    # Stages lie one after another, each of the same size: `stage_size` leads from one to the next.
    stages = [frame.room(motion.size) for _ in range(tableau.stages)]
    kept_of_reading = frame.room(reading.size)
    shown = frame.room(len(along.shown))
    # Sources that do not change along the solution are written once, behind those that do.
    for stage in stages:
        frame.fill(motion.constant_at(stage), motion.constant_sources)
    frame.fill(reading.constant_at(kept_of_reading), reading.constant_sources)
    rates = frame.program([*tape.slope, *motion.changing])
    tangents = TangentPlan(
        places=tuple(deviations),
        motion=motion.placed(stages[0], fixed),
        reading=reading.placed(kept_of_reading, fixed),
        kept=tuple(motion.changing_at(stage) for stage in stages),
        stage_size=motion.size,
    )
    return frame.plan(
        tableau,
        rates=rates,
        step=rates,
        read=frame.program(reading.changing),
        read_at=reading.changing_at(kept_of_reading),
        shown=shown,
        tangents=tangents,
    )


class _Frame:
    """Gives out places, one vector after another, and notes what `begin` fills them with; what is
    `fixed` is computed once a lane."""

    def __init__(self, tape: Recording, fixed: Sequence[Expression]) -> None:
        equations = tape.equations
        self.size = 0
        self.began = [*tape.p, *tape.c]
        self.given = [*tape.moving, *fixed]
        self.begun: list[tuple[int, Expression]] = []
        self.x = self.room(equations.parameters)
        self.constants = self.room(equations.constants)
        self.y = self.room(equations.states)
        self.fixed = self.room(len(fixed))
        self.driven = self.constants[equations.constants - equations.driven :]
        self.fill(self.y, tape.start)
        self.fill(self.fixed, fixed)

    def room(self, count: int) -> range:
        self.size += count
        return range(self.size - count, self.size)

    def fill(self, places: Iterable[int], values: Iterable[Expression]) -> None:
        """Lets `begin` fill places with values of the parameters and constants."""
        self.begun += zip(places, values, strict=True)

    def program(self, outputs: Sequence[Expression]) -> Program:
        """Makes a program from (t, y, driven, fixed), which runs along the solution."""
        return Program.of(outputs, self.given)

    def plan(
        self,
        tableau: Tableau,
        *,
        rates: Program,
        step: Program,
        read: Program,
        read_at: range,
        shown: range,
        tangents: TangentPlan | None = None,
        watched: WatchPlan | None = None,
    ) -> StepPlan:
        """Makes the plan, once everything has its place."""
        return StepPlan(
            tableau=tableau,
            x=self.x,
            constants=self.constants,
            y=self.y,
            driven=self.driven,
            fixed=self.fixed,
            begin=Program.of([value for _, value in self.begun], self.began),
            begun=tuple(place for place, _ in self.begun),
            rates=rates,
            step=step,
            read=read,
            read_at=read_at,
            shown=shown,
            size=self.size,
            tangents=tangents,
            watch=watched,
        )


class _Linear:
    """Takes some tangents apart, which are linear in a deviation d: J d + source, where a source
    depends on the direction of the parameters alone, and J on none."""

    def __init__(self, tape: Recording, along: Deviations, tangents: Sequence[Expression]) -> None:
        # Terms in the directions alone become sources, inputs of their own.
        outputs, sources = trace.separate(tangents, along.d, along.dp)
        names = [tape.graph.input(f"source{i}") for i in range(len(sources))]
        self.sources = tape.along_each(along.dp, sources)
        """The value (n, sources) of each source along each parameter."""
        linear_in = (*along.d, *names)
        # Coefficients of J are what enters the linear part from outside: it computes no more. The
        # names of inputs may repeat in another `_Linear` of this graph: programs go by expressions.
        coefficients = trace.border(outputs, trace.dependent(outputs, linear_in))
        values = [e for row in self.sources for e in row]
        varying = trace.dependent([*coefficients, *values], tape.moving)
        self.fixed = [e for e in coefficients if e not in varying]
        self.saved = [e for e in coefficients if e in varying]
        # Of y' = -p y: d is linear in -p d + source0; the coefficient -p is fixed, the source -y
        # varies. A source may be one of the coefficients, too: it is kept once.
        driving = [e for e in values if e in varying and e not in self.saved]
        self.changing = [*self.saved, *_distinct(driving)]
        """What changes along a solution, and is kept at each stage or reading: coefficients first,
        so that they lie side by side."""
        self.constant_sources = _distinct(e for e in values if e not in varying)
        self.inputs = [*linear_in, *self.saved]
        self.outputs = outputs

    @property
    def size(self) -> int:
        """Numbers that are kept for a stage or a reading."""
        return len(self.changing) + len(self.constant_sources)

    def changing_at(self, at: range) -> range:
        """Returns the places of what changes."""
        return at[: len(self.changing)]

    def constant_at(self, at: range) -> range:
        """Returns the places of the sources that do not change."""
        return at[len(self.changing) :]

    def placed(self, at: range, fixed: Sequence[Expression]) -> LinearProgram:
        """Makes the program J d + source whose sources and changing coefficients lie at `at`; the
        `fixed` numbers of the frame are its last inputs, used or not."""
        lying = [*self.changing, *self.constant_sources]
        place = dict(zip(lying, at, strict=True))
        sources = tuple(tuple(place[e] for e in row) for row in self.sources)
        program = Program.of(self.outputs, [*self.inputs, *fixed])
        return LinearProgram(program, sources, at[: len(self.saved)])


def _distinct(expressions: Iterable[Expression]) -> list[Expression]:
    return list(dict.fromkeys(expressions))
