"""What a measurement model is: parameters in, readings out, with their names and units and their
order of arrival."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from operator import attrgetter
from typing import Any, ClassVar, cast

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array, Covariance, nearest
from ipe_bench.basics.options import Component
from ipe_bench.functions.complex_steps import by_complex_steps
from ipe_bench.functions.judged import Judged, with_differences
from ipe_bench.functions.widest import widest_steps

Epochs = tuple[NDArray[np.intp], ...]


@dataclass(frozen=True)
class Parameter:
    """Describes one unknown: x holds multiples of `size` `unit`s; users see the value in `unit`."""

    name: str
    unit: str = ""
    size: float = 1.0
    group: str = ""
    """Parameters of one group share a panel in figures; empty: the name is the group."""


def with_unit(name: str, unit: str) -> str:
    """Heads numbers with their name, and with their unit if they have one."""
    return f"{name} [{unit}]" if unit else name


def parameter_table(*groups: tuple[Iterable[str], str, float, str]) -> tuple[Parameter, ...]:
    """Builds the parameters of several groups, each of which is names, unit, size and the group's
    name."""
    return tuple(
        Parameter(name, unit, size, group) for names, unit, size, group in groups for name in names
    )


@dataclass(frozen=True)
class Input:
    """Describes a column of a readings file that a model takes besides the readings, such as a
    satellite's place."""

    heading: str
    """Heading of the column in the file, with the unit: `x [m]`."""
    kind: type = float
    """float, int or str."""
    label: bool = False
    """Whether it is part of what tells readings apart, and stands in every file."""
    default: Any = None
    """Value if the file lacks the column; None: required as soon as the file has any input."""
    choices: tuple[str, ...] = ()
    """What a label may say; a file may have a column of readings for each instead."""


@dataclass(frozen=True)
class UsualNoise:
    """Describes the noise that is a model's own: rounding to a step if there is one, else white and
    Gaussian."""

    deviation: float | None = None
    """Standard deviation of a reading, in `reading_unit`."""
    step: float | None = None


@dataclass(frozen=True)
class Recorded:
    """Holds real readings that come with a model, which need no file, and what is known of their
    answer."""

    z: Array
    """The readings (m,)."""
    R: Covariance
    """Their covariance, as far as it is known."""
    x: Array
    """The certified answer (n,), in multiples of the parameters' sizes."""


class Measurement(Component, ABC):
    """Simulates the error-free readings h(x) of z = h(x) + v: a frozen dataclass of its options.

    Required: `parameters`, `index` and `simulate`. Optional: `nominal`, 0 unless stated;
    `analytic`, or a `jacobian` of its own; `usual_noise`; `epochs`, for filters; `periods`, if
    readings are angles; `recorded`, if real readings come with the model; `inputs` and
    `with_inputs`, if files bring more than readings; `own_parameters`, if files are joint.
    Promised: x is (trials, n) in multiples of the parameters' sizes and is not written into, h(x)
    is (trials, m) in `reading_unit`, m >= n; a trial has the same bits alone and in any batch. If m
    = n, no fit can be tested.

    >>> import ipe_bench as ib
    >>> @dataclass(frozen=True)
    ... class Decay(ib.Measurement):
    ...     count: int = 5
    ...     analytic = True
    ...     parameters = (Parameter("amplitude", "V"), Parameter("rate", "1/s", 0.1))
    ...     nominal = np.array([2.0, 5.0])
    ...     @property
    ...     def index(self):
    ...         return {"time [s]": list(range(self.count))}
    ...     def simulate(self, x):
    ...         amplitude, rate = (x * self.sizes).T[..., None]
    ...         return amplitude * np.exp(-rate * np.arange(self.count))
    >>> print(Decay().simulate(np.array([[2.0, 5.0]])).round(2))
    [[2.   1.21 0.74 0.45 0.27]]
    """

    analytic: ClassVar[bool] = False
    """True where `simulate` accepts complex x and is analytic in it: the Jacobian is then a complex
    step."""
    reading_unit: str = ""
    reading_name: str = "reading"
    """Name of the readings' column in a file; `reading` is understood too."""
    usual_noise: UsualNoise | None = None
    """Noise of the readings by default; None: the model does not know any."""
    epochs: Epochs | None = None
    """The rows of z by epoch, in order of arrival; None where readings have no order."""
    entry_words: Mapping[str, Mapping[Any, str]] = {}
    """Words for entries of `index` that do not speak for themselves, by column: the numbers of
    cases, say."""
    option_units: ClassVar[Mapping[str, str]] = {}
    """Units of options that are quantities, by name, as pages word them."""
    own_parameters: Sequence[str] = ()
    """Names of parameters of which every file of readings has its own, where several are estimated
    together."""
    periods: Array | Sequence[float] = ()
    """The period (m,) of each reading that is an angle, such as 2 pi, and 0 of others; empty: none
    is an angle."""
    fixed: Mapping[str, float] = {}
    """Values of parameters that are known and not estimated, by name."""
    inputs: tuple[Input, ...] = ()
    """The columns that the model takes from a readings file, where the file has them."""
    input_columns: Mapping[str, Sequence[Any]] = {}
    """The values of those columns, m each, by heading, of this model as it stands."""
    input_columns_known: bool = True
    """Whether there are readings without a file, whose inputs stand in the config or are the
    model's own."""
    linear: bool = False
    """Whether readings are known to be a linear function of the physical parameters."""
    by_differential_equations: bool = False
    """Whether the readings are taken from a trajectory that can be entered anywhere:
    `OdeMeasurement`."""
    recorded: Recorded | None = None
    """Real readings that come with this model: `estimate` then needs no file, and noise=certified
    scores by their x."""

    @property
    @abstractmethod
    def parameters(self) -> tuple[Parameter, ...]:
        """The n unknowns, in the order of x."""

    @property
    @abstractmethod
    def index(self) -> Mapping[str, Sequence[Any]]:
        """Description of each of the m readings: columns such as case, time, axis, each with m
        entries."""

    @abstractmethod
    def simulate(self, x: Array) -> Array:
        """Computes the error-free readings h(x): (trials, n) -> (trials, m)."""

    def near(self, h: Array, z: Array) -> Array:
        """Shifts each angle of h (..., m) by whole turns next to the reading z: residuals are
        within half a turn."""
        return nearest(h, z, self.periods)

    @property
    def nominal(self) -> Array:
        """The point x0 (n,) about which the model is linearised and the prior is centred."""
        return np.zeros(self.n)

    @property
    def nuisance_deviation(self) -> Array:
        """Standard deviations (k,) of the further errors of a truth that is richer than what
        estimators assume: drawn in each trial, at any error scale, and handed to `simulate` as
        columns of x behind the n parameters."""
        return np.zeros(0)

    @property
    def nuisances(self) -> tuple[Parameter, ...]:
        """Names, units and groups of the k numbers of `nuisance_deviation`, each a multiple of its
        `size`."""
        numbers = range(1, len(self.nuisance_deviation) + 1)
        return tuple(Parameter(f"nuisance_{i}", group="nuisances") for i in numbers)

    @property
    def candidates(self) -> Measurement:
        """The model with every reading that a design may choose among, with the columns and entries
        of this `index`."""
        return self

    def taking(self, rows: Sequence[int]) -> Measurement:
        """Returns the model with only these of its readings (rows of z, ascending)."""
        return SubsetModel(self, tuple(int(row) for row in rows))

    @property
    def offset(self) -> Array:
        """Readings of the instruments (m,) where h(x) is zero; read-outs are quantised with it
        added."""
        return np.zeros(self.m)

    def unit_of(self, output: str) -> str:
        """Returns the unit of the readings of an output, or of another group of them."""
        return self.reading_unit

    def hindrance(self, x: Array) -> str:
        """Says why the readings at x (n,) cannot be computed; empty if they can."""
        finite = np.isfinite(self.simulate(x[None])[0])
        if finite.all():
            return ""
        first = int(np.argmin(finite))
        columns = labels(self).items()
        where = ", ".join(f"{name}={values[first]}" for name, values in columns)
        return f"the model's readings are not finite, first at {where}"

    def remarks(self, x: Array) -> tuple[str, ...]:
        """Returns remarks for users on this model at x (n,), such as its integration method."""
        return ()

    def absent_input(self, heading: str, columns: Sequence[str]) -> str:
        """Says what to do if a file lacks that column, having others of the inputs."""
        return f"give all of {', '.join(i.heading for i in self.inputs)}, or none"

    def with_inputs(self, columns: Mapping[str, Sequence[Any]], readings: int) -> Measurement:
        """Returns this model with the inputs of a file: `columns` by heading, one entry for each of
        its readings, in the order of the file, which is that of z from then on."""
        raise NotImplementedError(f"{self.name} takes only readings from a file")

    def along(self, heading: str, entries: Sequence[float]) -> Measurement:
        """Returns this model with readings at these entries of one of its inputs, the others being
        as in its first reading."""
        columns = labels(self)
        count = len(entries)
        others = {one.heading: [columns[one.heading][0]] * count for one in self.inputs}
        return self.with_inputs(others | {heading: entries}, count)

    @property
    def n(self) -> int:
        return len(self.parameters)

    @cached_property
    def m(self) -> int:
        return len(next(iter(self.index.values())))

    @cached_property
    def sizes(self) -> Array:
        """The physical size (n,) of one unit of x, in each parameter's own unit."""
        return np.array([p.size for p in self.parameters])

    @property
    def physical_parameters(self) -> tuple[Parameter, ...]:
        """The n unknowns as users know them, where those of x are their logarithms, say."""
        return self.parameters

    def physical(self, x: Array) -> Array:
        """Converts x to parameter values (trials, n), each in its own unit."""
        return x * self.sizes

    def inner(self, v: Array) -> Array:
        """Returns x (..., n) of parameter values (..., n), each in its own unit."""
        return v / self.sizes

    def physical_slope(self, x: Array) -> Array:
        """Computes the derivative of each value by its own entry of x (trials, n)."""
        return np.broadcast_to(self.sizes, x.shape)

    def near_bounds(self, x: Array) -> Mapping[int, float]:
        """Finds which of the n parameters are next to a bound at x (n,), and that bound in their
        own unit."""
        return {}

    def stating(self, key: str, values: Mapping[int, float]) -> Measurement:
        """Returns this model with some of the n parameters `fixed` at values in their own units; or
        free of bounds, with these `nominal` values."""
        raise NotImplementedError(f"{self.name} has no bounds")

    def jacobian(self, x: Array) -> Array:
        """Computes dh/dx: (trials, n) -> (trials, m, n); complex step where analytic, else
        differences that know their error."""
        if self.analytic:
            self._require_analytic()
            return by_complex_steps(self.simulate, x)
        return self._own_differences.differences(x)

    @cached_property
    def _own_differences(self) -> Judged:
        try:
            return self._with_differences(self._tried_points)
        except Exception:  # it may refuse what is not near the start
            return self._with_differences(self._tried_points[:1])

    def _with_differences(self, points: Array) -> Judged:
        return with_differences(self.simulate, points, self.widest_steps, self.near)

    @cached_property
    def _tried_points(self) -> Array:
        """Points (5, n) near the nominal one at which slopes are tried."""
        offsets = np.random.default_rng(1).uniform(-0.3, 0.3, (4, self.n))
        return self.nominal + np.vstack([np.zeros(self.n), offsets])

    def _require_analytic(self) -> None:
        """Raises UserError, at the first Jacobian, if complex steps do not find slopes that
        differences find near the start."""
        if self._is_analytic:
            return
        raise UserError(
            f"measurement={self.name}: `analytic` is set, and complex steps do not find the slopes"
            " of simulate, as behind np.abs or np.maximum; write np.where(u.real < 0, -u, u) for"
            " np.abs(u), or leave `analytic` out"
        )

    @cached_property
    def _is_analytic(self) -> bool:
        x = self._tried_points
        with np.errstate(all="ignore"):
            J = by_complex_steps(self.simulate, x)
            own = Judged(self.simulate, self.widest_steps, self.near)
            wrong = own.wrong(x, self.simulate(x), J)
        return not (wrong & np.isfinite(J).all(axis=(1, 2))).any()

    @cached_property
    def widest_steps(self) -> Array:
        """The widest steps (n,) of differences: a tenth of the nominal values or of 1, or less
        where the readings bend within that."""
        x0 = np.asarray(self.nominal, dtype=float)
        return widest_steps(self.simulate, x0, 0.1 * np.maximum(1.0, np.abs(x0)), self.near)

    def coarse_jacobian(self, x: Array) -> Array:
        """Computes dh/dx near enough for the steps of an iteration, `|I - J~+ J|` below 0.01, where
        that is cheaper; else exact. Covariances and convergence checks want `jacobian`."""
        return self.jacobian(x)

    @property
    def jacobian_cost(self) -> float:
        """Cost of a Jacobian, in simulations of the same trial."""
        return float(self.n if self.analytic else 6 * self.n)

    @property
    def coarse_jacobian_cost(self) -> float:
        """Cost of a coarse Jacobian, in simulations of the same trial."""
        return self.jacobian_cost

    def linearization(self) -> Array:
        """Computes the matrix H (m, n) of eq. (1) about the start."""
        return self.jacobian(self.nominal[None])[0]

    def rows(self, stop: int) -> NDArray[np.intp]:
        """Returns the rows of z that have arrived after `stop` epochs, ascending."""
        assert self.epochs is not None
        return np.sort(np.concatenate(self.epochs[:stop]))

    def simulate_until(self, x: Array, stop: int) -> Array:
        """Computes h(x) in `rows(stop)` alone; models that arrive in time stop computing there."""
        return self.simulate(x)[:, self.rows(stop)]

    def coarse_simulate_until(self, x: Array, stop: int) -> Array:
        """Computes `simulate_until` near enough for fits that only start another, to a small part
        of a reading's usual noise, where that is cheaper; else the same."""
        return self.simulate_until(x, stop)

    def jacobian_until(self, x: Array, stop: int) -> Array:
        """Computes dh/dx in `rows(stop)` alone."""
        return self.jacobian(x)[:, self.rows(stop)]

    def coarse_jacobian_until(self, x: Array, stop: int) -> Array:
        """Computes dh/dx in `rows(stop)` alone, good enough for fits that start another, `|I - J~+
        J|` below 0.1."""
        return self.coarse_jacobian(x)[:, self.rows(stop)]


def labels(model: Measurement) -> Mapping[str, Sequence[Any]]:
    """Returns the entries of every column of a readings file but that of the readings."""
    return {**model.index, **model.input_columns}


def single_epochs(model: Measurement) -> Epochs:
    """Epochs of a single reading each."""
    return tuple(np.arange(model.m)[:, None])


class _Forwarded(property):
    """Forwards an attribute to the model inside."""

    def __set_name__(self, owner: type, name: str) -> None:
        super().__init__(attrgetter(f"whole.{name}"))


def _forwarded() -> Any:
    return _Forwarded()


class Forwarding(Measurement):
    """Forwards the description of another model, `whole`, but for what a subclass overrides.

    What it computes is left to the subclass, and so are the columns of a file and recorded
    readings.
    """

    whole: Measurement

    name = _forwarded()
    parameters = _forwarded()
    physical_parameters = _forwarded()
    nominal = _forwarded()
    nuisance_deviation = _forwarded()
    nuisances = _forwarded()
    fixed = _forwarded()
    index = _forwarded()
    entry_words = _forwarded()
    epochs = _forwarded()
    periods = _forwarded()
    offset = _forwarded()
    m = _forwarded()
    reading_unit = _forwarded()
    unit_of = _forwarded()
    reading_name = _forwarded()
    usual_noise = _forwarded()
    own_parameters = _forwarded()
    by_differential_equations = _forwarded()
    linear = _forwarded()
    input_columns_known = _forwarded()
    jacobian_cost = _forwarded()
    coarse_jacobian_cost = _forwarded()

    def whole_x(self, x: Array) -> Array:
        """Returns x (trials, k) as the whole model takes it."""
        return x

    def around(self, whole: Measurement) -> Measurement:
        """Returns the same about another model."""
        return replace(cast(Any, self), whole=whole)

    def physical(self, x: Array) -> Array:
        return self.whole.physical(x)

    def inner(self, v: Array) -> Array:
        return self.whole.inner(v)

    def physical_slope(self, x: Array) -> Array:
        return self.whole.physical_slope(x)

    def near_bounds(self, x: Array) -> Mapping[int, float]:
        return self.whole.near_bounds(x)

    def hindrance(self, x: Array) -> str:
        return self.whole.hindrance(self.whole_x(x[None])[0])

    def remarks(self, x: Array) -> tuple[str, ...]:
        return self.whole.remarks(self.whole_x(x[None])[0])

    def stating(self, key: str, values: Mapping[int, float]) -> Measurement:
        return self.around(self.whole.stating(key, values))


class WrappedModel(Forwarding):
    """Wraps another model, `whole`, but for what a subclass overrides.

    Three hooks stand between the two in all that is computed: `whole_x`, `own_readings` and
    `own_jacobian`.
    """

    inputs = _forwarded()
    input_columns = _forwarded()
    recorded = _forwarded()

    def own_readings(self, x: Array, z: Array) -> Array:
        """Returns the readings at x, from those of the whole model."""
        return z

    def own_jacobian(self, x: Array, J: Array) -> Array:
        """Returns dh/dx at x, from that of the whole model."""
        return J

    def simulate(self, x: Array) -> Array:
        return self.own_readings(x, self.whole.simulate(self.whole_x(x)))

    def simulate_until(self, x: Array, stop: int) -> Array:
        return self.own_readings(x, self.whole.simulate_until(self.whole_x(x), stop))

    def coarse_simulate_until(self, x: Array, stop: int) -> Array:
        return self.own_readings(x, self.whole.coarse_simulate_until(self.whole_x(x), stop))

    def jacobian(self, x: Array) -> Array:
        return self.own_jacobian(x, self.whole.jacobian(self.whole_x(x)))

    def coarse_jacobian(self, x: Array) -> Array:
        return self.own_jacobian(x, self.whole.coarse_jacobian(self.whole_x(x)))

    def jacobian_until(self, x: Array, stop: int) -> Array:
        return self.own_jacobian(x, self.whole.jacobian_until(self.whole_x(x), stop))

    def coarse_jacobian_until(self, x: Array, stop: int) -> Array:
        return self.own_jacobian(x, self.whole.coarse_jacobian_until(self.whole_x(x), stop))

    def linearization(self) -> Array:
        return self.own_jacobian(self.nominal[None], self.whole.linearization()[None])[0]

    def absent_input(self, heading: str, columns: Sequence[str]) -> str:
        return self.whole.absent_input(heading, columns)

    def with_inputs(self, columns: Mapping[str, Sequence[Any]], readings: int) -> Measurement:
        return self.around(self.whole.with_inputs(columns, readings))


@dataclass(frozen=True)
class SubsetModel(Forwarding):
    """Restricts a model to some of its readings: those of the first epochs, or those that are not
    missing."""

    whole: Measurement
    kept: tuple[int, ...]
    """Rows of the whole model's z, ascending."""
    stop: int | None = None
    """Number of epochs that hold all rows: no later one is computed; None: all epochs."""
    coarse: bool = False
    """Whether readings near enough for fits that only start another will do."""

    def __post_init__(self) -> None:
        """Skips the checks of options: every window and epoch makes this object, from checked
        parts."""

    @classmethod
    def until(cls, whole: Measurement, stop: int, *, coarse: bool = False) -> SubsetModel:
        """Restricts a model to the readings of the first `stop` epochs."""
        return cls(whole, tuple(whole.rows(stop).tolist()), stop, coarse)

    @property
    def index(self) -> Mapping[str, Sequence[Any]]:
        return {name: [column[i] for i in self.kept] for name, column in self.whole.index.items()}

    @property
    def m(self) -> int:
        return len(self.kept)

    @property
    def offset(self) -> Array:
        return self.whole.offset[self._rows]

    @property
    def periods(self) -> Array | Sequence[float]:
        periods = self.whole.periods
        return np.asarray(periods)[self._rows] if len(periods) else ()

    @property
    def epochs(self) -> Epochs | None:
        """The whole model's epochs that still have readings, renumbered."""
        if self.whole.epochs is None:
            return None
        epoch_of = np.empty(self.whole.m, dtype=np.intp)
        for k, rows in enumerate(self.whole.epochs):
            epoch_of[rows] = k
        kept = epoch_of[self._rows]
        order = np.argsort(kept, kind="stable")
        if not len(order):
            return ()
        # An epoch begins wherever the number changes.
        begins = np.flatnonzero(np.diff(kept[order])) + 1
        return tuple(np.split(order, begins))

    @cached_property
    def _rows(self) -> NDArray[np.intp]:
        return np.array(self.kept, dtype=np.intp)

    @cached_property
    def _among_arrived(self) -> NDArray[np.intp] | slice:
        """Places of the kept rows in what the whole model returns; a slice if they are all of
        it."""
        arrived = np.arange(self.whole.m) if self.stop is None else self.whole.rows(self.stop)
        if np.array_equal(arrived, self._rows):
            return slice(None)
        return np.searchsorted(arrived, self._rows)

    def _computed(self, name: str, x: Array) -> Array:
        """Computes that method of the whole model, in the kept rows."""
        if self.stop is None:
            found = getattr(self.whole, name)(x)
        else:
            found = getattr(self.whole, f"{name}_until")(x, self.stop)
        return found[:, self._among_arrived]

    def simulate(self, x: Array) -> Array:
        coarse = self.coarse and self.stop is not None
        return self._computed("coarse_simulate" if coarse else "simulate", x)

    def jacobian(self, x: Array) -> Array:
        return self._computed("jacobian", x)

    def coarse_jacobian(self, x: Array) -> Array:
        return self._computed("coarse_jacobian", x)

    def linearization(self) -> Array:
        return self.whole.linearization()[self._rows]
