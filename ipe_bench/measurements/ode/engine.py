"""Integrates described differential equations, by the method that they ask for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from ipe_bench.basics.linalg import Array, own
from ipe_bench.engine.ladder import NOT_FOLLOWED, shares
from ipe_bench.engine.rodas import SHAPE, STABLE, Rodas5P
from ipe_bench.measurements.arithmetic import Arithmetic, evaluate, parse
from ipe_bench.measurements.base import Parameter
from ipe_bench.measurements.ode import driven
from ipe_bench.measurements.ode.model import OdeMeasurement

if TYPE_CHECKING:
    from ipe_bench.measurements.ode.described import Ode

_SHARE = 1e-8
"""Default tolerance of the integration, as a share of the largest reading."""
_TRIAL_STEPS = 16
"""Steps within the shortest interval that tell how large readings are."""
_SIZE = 1e-6
"""Tolerance of implicit steps that show how large readings are where explicit ones are in doubt."""
_EASY = 16
"""Explicit steps between two readings up to which nominal equations are not asked whether they are
stiff."""
STIFF = 10.0
"""Explicit steps, for each implicit one, from which on equations are called stiff."""
_ASKED = 3000
"""Implicit steps times states and 4 that hold explicit readings against implicit ones, in a quarter
of a second."""
_APART = 0.05
"""Differences of explicit readings from a rough solution that need no accurate one, as a share of
the largest reading of an output."""


class DescribedEquations(OdeMeasurement):
    """Implements the model that `Ode` describes, for the integrator."""

    stiff_remedy = "measurement.method=implicit follows them"

    def __init__(self, described: Ode) -> None:
        self.described = described
        self.states = len(described.rates)
        self.outputs = tuple(described.output_formulas)
        self.time_unit = described.time_unit
        self.step = described.step

    @property
    def name(self) -> str:
        return self.described.title

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return self.described.parameters

    @property
    def nominal(self) -> Array:
        return self.described.nominal

    @property
    def cases(self) -> Array:
        return self.described.cases

    @property
    def _coarsens(self) -> bool:
        return self.step is None and not self.stiff

    @property
    def periods(self) -> Array | Sequence[float]:
        described = self.described
        circular = {*described.circular}
        if not circular:
            return ()
        turns = [
            described.turn if {name, described.reading} & circular else 0.0 for name in self.outputs
        ]
        return np.tile(turns, self.m // len(turns))

    @cached_property
    def times(self) -> Array:
        described = self.described
        changes = [float(time) for one in described.courses for time in one["time"]]
        for comparison in described.piecewise_rates[1].values():
            changes += driven.switching_times(comparison, described.known_of_cases)
        return driven.grid(described.reading_times, changes)

    @cached_property
    def driven(self) -> Array | None:
        """The comparisons of t and the inputs, of each interval."""
        described = self.described
        at = driven.middles(self.times)
        switches = described.piecewise_rates[1]
        if not (switches or described.driven_by):
            return None
        tables = []
        for k, case in enumerate(described.known_of_cases):
            columns = [evaluate(tree, {**case, "t": at}) for tree in switches.values()]
            for name, kind in described.driven_by.items():
                # A single course of the inputs is that of every case.
                one = described.courses[min(k, len(described.courses) - 1)]
                columns += driven.course(kind, one["time"], one[name], at)
            in_all_intervals = [np.broadcast_to(column, at.shape) for column in columns]
            tables.append(np.stack(in_all_intervals, axis=1))
        return np.stack(tables, axis=1)

    @cached_property
    def stiff(self) -> bool:
        """Whether every trial is integrated by the implicit method: if stability alone takes more
        than `STIFF` times as many explicit steps along the nominal solution, or these do not follow
        it and the implicit method does, or nothing tells that they are right."""
        if self.described.method != "auto":
            return self.described.method == "implicit"
        if self.step is not None:
            return False
        lost = bool(self._nominal.lost[0])
        rung = self._rungs[self._nominal_place]
        easy = rung <= _EASY
        if not lost and (easy or not np.isfinite(self._finest).all()) and self.missed > 0:
            # Even where implicit steps do not follow either: no reading is better than one that
            # nothing supports, and the model is refused with the reason.
            return True
        if not lost and easy:
            return False
        z, work = self.shape
        if not np.isfinite(z).all():
            return False
        wanted = lost or work.explicit > STIFF * work.steps
        if not wanted:
            # The fastest rate times the step is beyond what the explicit method can damp.
            unstable = work.fastest * self._usual_interval / rung > STABLE
            wanted = unstable and self.missed > 0
        return wanted and bool(np.isfinite(self._nominal_told).all())

    @cached_property
    def missed(self) -> float:
        """The largest difference, in tolerances, of nominal readings by explicit steps from those
        by implicit ones; 0 where they are near, or nearer than rough implicit ones; infinite where
        nothing tells. Rungs may agree, and with rough implicit steps, though all of them step over
        what holds the solution: the finest is in doubt then."""
        explicit = self._nominal.z
        x = own(self.nominal[None])
        rough = Rodas5P(self.stepped, SHAPE).simulate(x, len(self.times), self._most_asked)
        sure = bool(np.isfinite(self._finest).all())
        with np.errstate(all="ignore"):
            outputs = np.abs(rough).reshape(-1, len(self.outputs))
            largest = np.tile(np.nanmax(outputs, axis=0, initial=0.0), self.m // len(self.outputs))
            apart = np.abs(explicit - self.near(rough, explicit)) > _APART * largest
            if sure and not apart.any():
                return 0.0
            off = self._off(explicit, self._nominal_told)
            rough_off = self._off(rough, self._nominal_told)
        limit = NOT_FOLLOWED
        if sure:
            limit = max(limit, float(np.nanmax(rough_off, initial=0.0)))
        else:
            off = np.nan_to_num(off, nan=np.inf)
        worst = float(np.nanmax(off, initial=0.0))
        return worst if worst > limit else 0.0

    @property
    def _most_asked(self) -> int:
        """The most implicit steps that explicit readings are held against, fewer of many states and
        cases."""
        size = max(1.0, len(self.cases) * self.states**2 / 2000)
        return int(_ASKED / (4 + self.states) / size)

    def _off(self, z: Array, reference: Array) -> Array:
        """Computes differences of readings (trials, m) from others, in tolerances."""
        return shares(np.abs(z - self.near(reference, z)), self._tolerances)

    def off(self, x: Array) -> float:
        """Computes by how many tolerances the explicit method differs from the implicit one in a
        reading at x (n,); 0 where few explicit steps do."""
        if self.stiff or self.step is not None:
            return 0.0
        x = own(x[None, : self.n])
        place = self._rungs_of(x, self._zeros).places[0]
        if self._rungs[place] <= _EASY:
            return 0.0
        z = self.simulate(x)
        accurate = self._implicit.simulate(x, len(self.times))
        return float(np.nan_to_num(self._off(z, accurate), nan=0.0, posinf=0.0).max())

    def along(self, x: Array) -> dict[str, Any]:
        """Evaluates the names in the formulas at x (n,), at the times of each case: (cases,
        times)."""
        shown: dict[str, str | float] = {y: y for y in self.described.rates}
        # The outputs stay, behind the states, for what they ask of the integration.
        for k, formula in enumerate(self.described.outputs.values()):
            shown[f"output {k}"] = formula
        engine = replace(self.described, outputs=shown, circular=(), exact={}, answer={}).engine
        z = engine.simulate(x[None]).reshape(len(self.cases), len(self.times), -1)
        y = np.moveaxis(z[:, :, : self.states], 2, 0)
        return self.at_times(list(y), list(x[: self.n] * self.si_sizes))

    def at_times(self, y: Sequence[Any], p: Sequence[float]) -> dict[str, Any]:
        """Evaluates the names at states y, each (cases, times)."""
        c = self.tables[1:] if len(self.tables) > 1 else self.tables
        return self._values(self.times[None], y, p, list(np.moveaxis(c, (2, 1), (0, 1))))

    def _shown(self, x: Array, stop: int, offset: Array, *, guess: bool = False) -> Array:
        if self.stiff:
            return self._told(own(x), stop)
        z = super()._shown(x, stop, offset, guess=guess)
        if self.described.method == "explicit" and self.step is None and self.missed > 0:
            z[:] = np.nan
        return z

    def jacobian_until(self, x: Array, stop: int) -> Array:
        return self._implicit.jacobian(x, stop) if self.stiff else super().jacobian_until(x, stop)

    @cached_property
    def jacobian_cost(self) -> float:
        return float(1 + self.n) if self.stiff else super().jacobian_cost

    @cached_property
    def tolerance(self) -> float:
        if isinstance(self.described.tolerance, float):
            return self.described.tolerance
        intervals = np.diff(self.times, prepend=0.0)
        # Readings at the start alone take no step.
        step = float(min(intervals[intervals > 0], default=1.0)) / _TRIAL_STEPS
        nominal = own(self.nominal[None])

        def explicit(step: float) -> float:
            trial = replace(self.described, step=step, method="explicit")
            return _largest(trial.simulate(nominal))

        first = explicit(step)
        largest = explicit(step / 2)
        finest = _largest(self._finest)
        # Explicit steps are unstable.
        if not 0.9 * largest <= first <= 1.1 * largest:
            largest = _largest(self.shape[0])
        if not np.isfinite(finest):
            finest = _largest(Rodas5P(self.stepped, _SIZE).simulate(nominal, len(self.times)))
        # Short pulses fall between long steps.
        if np.isfinite(finest) and not 0.9 * finest <= largest <= 1.1 * finest:
            largest = finest
        return _SHARE * largest if 0 < largest < np.inf else _SHARE

    @cached_property
    def _tolerances(self) -> Array:
        if not isinstance(self.described.tolerance, str):
            return super()._tolerances
        formula = parse(self.described.tolerance, "tolerance")
        at_times = [float(formula(known)) for known in self.described.known(self.times)]
        return np.repeat(at_times, len(self.outputs))

    def _values(
        self, t: Any, y: Sequence[Any], p: Sequence[Any], c: Sequence[Any]
    ) -> dict[str, Any]:
        """Evaluates the names in the formulas."""
        described = self.described
        values = dict(zip((*described.rates, *described.start), (*y, *p), strict=True))
        values["t"] = t
        constants = iter(c)
        for name in (*described.constant_names, *described.piecewise_rates[1]):
            values[name] = next(constants)
        for name, kind in described.driven_by.items():
            u = next(constants)
            if kind == "linear":
                slope = next(constants)
                since = next(constants)
                u = u + slope * (t - since)
            values[name] = u
        return values

    def _computed(
        self, formulas: Mapping[str, Arithmetic], t: Any, y: Any, p: Any, c: Any
    ) -> list[Any]:
        values = self._values(t, y, p, c)
        return [formula(values) for formula in formulas.values()]

    def start(self, p, c):
        return self._computed(self.described.initial_formulas, 0.0, [0.0] * self.states, p, c)

    def rhs(self, t, y, p, c):
        return self._computed(self.described.piecewise_rates[0], t, y, p, c)

    def read(self, t, y, p, c):
        return self._computed(self.described.output_formulas, t, y, p, c)


def _largest(z: Array) -> float:
    """Computes the largest magnitude of readings."""
    return float(np.abs(z).max())
