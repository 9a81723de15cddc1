"""Defines a measurement model by a plain Python function of named parameters, written in NumPy or
in JAX."""

from __future__ import annotations

import importlib
import inspect
import os
import sys
import typing
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.errors import UserError, place_of, refuse_unknown, unknown
from ipe_bench.basics.linalg import Array, read_only
from ipe_bench.basics.options import Finite, Positive
from ipe_bench.functions.judged import Judged, judged
from ipe_bench.measurements.base import Forwarding, Input, Measurement
from ipe_bench.measurements.formula import Formula, WrittenModel

_CHUNK = 8
"""Trials per call of a compiled JAX program; shorter batches are padded, so that bits do not depend
on them."""
_TIMES = ("t", "time")
"""Columns that are taken for the time of the readings."""
_FOR_ARRAYS = {
    "scalar": "np.exp in place of math.exp, and so on",
    "truth value": "np.where(CONDITION, THEN, ELSE) in place of if",
}
"""What to write in a function of single numbers, by a word of the error that arrays meet there."""
_LONGEST_TITLE = 40
"""Letters of a formula that is a title."""


@dataclass(frozen=True)
class Function(WrittenModel):
    """Computes z = h(parameters, columns), for a function h of a Python file:

        def angle(t, length=1.0, damping=0.1, *, g=9.80665):        # in swing.py
            return 0.1 * np.exp(-damping * t / 2) * np.cos(np.sqrt(g / length) * t)

        ipe-bench estimate measurement=function measurement.of=swing:angle readings=swing.csv

    Arguments with a number as default are parameters, which start there; arguments without are
    columns of the readings file, arrays (m,); keyword-only arguments are constants. h returns the
    readings (m,), or a tuple of arrays (m,), which `outputs` names. The type
    `Annotated[float, "m"]` gives a parameter its unit. Slopes are exact: by forward differentiation
    where h returns JAX arrays, by a complex step where differences do not contradict it, else by
    differences that know their error. Readings that have a column `t` or `time` arrive in that
    order, so that filters take part.
    """

    of: str
    """The function: MODULE:NAME, where MODULE is importable or MODULE.py lies in the working
    folder."""
    start: Mapping[str, Finite] = field(default_factory=dict)
    """Start of each parameter. An argument without a default becomes a parameter."""
    size: Mapping[str, Positive] = field(default_factory=dict)
    """The physical size of one unit of a parameter; otherwise the magnitude of its start, or 1
    where that is 0."""
    units: Mapping[str, str] = field(default_factory=dict)
    """Units of parameters, by name."""
    constants: Mapping[str, Any] = field(default_factory=dict)
    """Values of keyword-only arguments."""
    columns: Mapping[str, Sequence[float]] = field(default_factory=dict)
    """The columns of the readings, for runs that have no file."""
    time: str | None = None
    """The column in whose order readings arrive; None: `t` or `time` if there is one; empty: no
    order."""
    reading: str = "reading"
    """Name of the readings' column in a file."""
    unit: str = ""
    """Unit of the readings."""
    circular: tuple[str, ...] = ()
    """The readings' name, or those of outputs, if they are angles, in rad, or in deg by their unit:
    residuals are within half a turn."""
    outputs: tuple[str, ...] = ()
    """Names of the arrays, if h returns a tuple of them."""
    output: tuple[str, ...] = ()
    """The output that each reading is of; none: all are read in every row of the columns."""

    def __post_init__(self) -> None:
        super().__post_init__()
        # Held from now on: by its name another could be found later.
        object.__setattr__(self, "function", self._found())
        arguments = [name for name in self._signature if name not in self._keywords]
        for name in self.start:
            refuse_unknown(f"start.{name}", name, arguments, "argument")
        for name in self.constants:
            refuse_unknown(f"constants.{name}", name, self._keywords, "keyword-only argument")
        for name, default in self._keywords.items():
            if default is inspect.Parameter.empty and name not in self.constants:
                raise UserError(
                    f"constants.{name}: {self.of} needs it; give measurement.constants.{name}=VALUE"
                )
        if not self.starts:
            given = f"(its arguments are {', '.join(arguments) or 'none'})"
            remedy = (
                f"give an argument a number as default, or measurement.start.NAME=VALUE {given}"
            )
            raise UserError(f"start: {self.of} has no parameter; {remedy}")
        if self.time:
            refuse_unknown(f"time={self.time}", self.time, self.headings, "column")
        for name in self.headings if self.columns else ():
            if name not in self.columns:
                remedy = f"give measurement.columns.{name}=[...], or measurement.start.{name}=VALUE"
                raise UserError(f"columns: {name} is missing; {remedy}")
        self.require_columns_and_parameters("size", "units", readings=self.outputs)
        for name in self.output:
            refuse_unknown(f"output={name}", name, self.outputs, "output")
        if self.outputs and not self.headings:
            raise UserError(f"outputs: {self.of} takes no column; return one array of all readings")
        if self.outputs and self.columns and not self.output:
            self._read_all()

    def _read_all(self) -> None:
        """Gives each output a reading in every row of the columns."""
        k = len(self.outputs)
        columns = {name: np.repeat(self.column(name), k).tolist() for name in self.headings}
        rows = len(self.column(self.headings[0]))
        object.__setattr__(self, "columns", columns)
        object.__setattr__(self, "output", self.outputs * rows)

    if typing.TYPE_CHECKING:
        function: typing.ClassVar[Callable[..., Any]]

    def _found(self) -> Callable[..., Any]:
        """Finds the function that `of` names; its module is imported from the working folder or the
        path."""
        module, colon, name = self.of.partition(":")
        module = module.removesuffix(".py")
        parts = module.split(".")
        if not (all(map(str.isidentifier, parts)) and colon and name.isidentifier()):
            example = "such as swing:angle for the function angle of swing.py"
            raise UserError(
                f"of={self.of}: give MODULE:FUNCTION, {example}, without the folder of the file"
            )
        try:
            if os.getcwd() not in sys.path:  # worker processes take over the path
                sys.path.insert(0, os.getcwd())
            found = sys.modules.get(module) or importlib.import_module(module)
        except Exception as error:
            if isinstance(error, ModuleNotFoundError) and error.name == module.partition(".")[0]:
                raise UserError(
                    f"of={self.of}: there is no module {module} here; {module}.py would be one"
                ) from None
            remedy = ""
            if isinstance(error, ModuleNotFoundError):
                remedy = f"; install {error.name}, or correct the name"
            raise UserError(
                f"of={self.of}: {module} cannot be imported: {place_of(error)}{remedy}"
            ) from None
        if not callable(getattr(found, name, None)):
            functions = [key for key, value in vars(found).items() if inspect.isfunction(value)]
            raise UserError(f"of={self.of}: {unknown(name, functions, 'function')}")
        return getattr(found, name)

    @property
    def functions(self) -> tuple[Callable[..., Any], ...]:
        """Functions that the model computes with beside its class: a change of their source makes
        results stale."""
        return (self.function,)

    @cached_property
    def _signature(self) -> Mapping[str, inspect.Parameter]:
        arguments = inspect.signature(self.function).parameters
        for argument in arguments.values():
            if argument.kind in (argument.VAR_POSITIONAL, argument.VAR_KEYWORD):
                raise UserError(f"of={self.of}: takes {argument}; give every argument a name")
        return arguments

    @cached_property
    def _keywords(self) -> dict[str, Any]:
        """The keyword-only arguments with their defaults."""
        return {name: a.default for name, a in self._signature.items() if a.kind is a.KEYWORD_ONLY}

    @cached_property
    def starts(self) -> dict[str, float]:
        """The parameters with their starts, in the order of the signature."""
        found: dict[str, float] = {}
        for name, argument in self._signature.items():
            value = self.start.get(name, argument.default)
            if name in self._keywords or value is argument.empty:
                continue
            if isinstance(value, bool) or not isinstance(value, int | float):
                remedy = "write * before it if it is a constant"
                raise UserError(f"of={self.of}: the default of {name} is no number; {remedy}")
            found[name] = float(value)
        return found

    @cached_property
    def headings(self) -> tuple[str, ...]:
        others = {*self.starts, *self._keywords}
        return tuple(name for name in self._signature if name not in others)

    @cached_property
    def parameter_units(self) -> dict[str, str]:
        try:
            hints = typing.get_type_hints(self.function, include_extras=True)
        except Exception:  # of names that the function's module does not hold
            hints = {}
        units = {}
        for name, hint in hints.items():
            texts = (one for one in getattr(hint, "__metadata__", ()) if isinstance(one, str))
            units[name] = next(texts, "")
        return units | dict(self.units)

    @property
    def input_columns_known(self) -> bool:
        return bool(self.columns) or not self.headings

    def with_inputs(self, columns: Mapping[str, Sequence[Any]], readings: int) -> Function:
        numbers = {name: tuple(map(float, columns[name])) for name in self.headings}
        return replace(self, columns=numbers, output=tuple(columns.get("output", ())))

    @property
    def inputs(self) -> tuple[Input, ...]:
        if not self.outputs:
            return super().inputs
        return (*super().inputs, Input("output", str, label=True, choices=self.outputs))

    @property
    def input_columns(self) -> Mapping[str, Sequence[Any]]:
        if not self.outputs:
            return super().input_columns
        return {**super().input_columns, "output": self.output}

    @property
    def periods(self) -> Array | Sequence[float]:
        if not self.outputs or not self.circular:
            return super().periods
        return np.where(np.isin(self.output, self.circular), self.turn, 0.0)

    @cached_property
    def m(self) -> int:
        if not self.headings:
            return len(self._checked(self._at(self.starts.values()), None))
        return len(self.column(self.headings[0]))

    @cached_property
    def epochs(self) -> tuple[NDArray[np.intp], ...] | None:
        chosen = self.time
        if chosen is None:
            chosen = next((name for name in _TIMES if name in self.headings), "")
        if not chosen:
            return None
        times = self.column(chosen)
        return tuple(np.flatnonzero(times == time) for time in np.unique(times))

    @cached_property
    def _known(self) -> dict[str, Any]:
        """The arguments that are not parameters: columns as arrays, and constants."""
        columns = {name: self.column(name) for name in self.headings}
        if self.outputs:
            _, rows = np.unique(self._places, return_index=True)
            columns = {name: column[rows] for name, column in columns.items()}
        return {**{name: read_only(column) for name, column in columns.items()}, **self.constants}

    @cached_property
    def _places(self) -> NDArray[np.intp]:
        """The row (m,) of each reading among those that h is told: outputs of the same columns
        share one, since h may add rows up, or take them in ascending order only."""
        columns = [self.column(name).tolist() for name in self.headings]
        before: Counter[tuple[Any, ...]] = Counter()
        rows: dict[tuple[Any, ...], int] = {}
        places = []
        for output, *values in zip(self.output, *columns, strict=True):
            again = before[output, *values]
            before[output, *values] += 1
            places.append(rows.setdefault((again, *values), len(rows)))
        return np.array(places)

    def _at(self, values: Any) -> Any:
        """Computes h at these values (n,) of the parameters, in their own units; at their real
        parts if h refuses complex ones."""
        known = self._known
        parameters = dict(zip(self.starts, values, strict=True))
        try:
            found = self.function(**parameters, **known)
        except (Exception, SystemExit) as error:
            if np.iscomplexobj(values):  # functions of `math` refuse them
                return self._at(values.real)
            file = getattr(sys.modules.get(self.function.__module__), "__file__", None)
            remedy = ""
            if isinstance(error, TypeError | ValueError):
                for said, instead in _FOR_ARRAYS.items():
                    if said in str(error):
                        arrays = f"columns ({', '.join(self.headings)}) are arrays"
                        remedy = f"; {arrays} with a number per reading: write {instead}"
            raise UserError(f"measurement.of={self.of}: {place_of(error, file)}{remedy}") from error
        return self._read(found) if self.outputs else found

    def _read(self, found: Any) -> Any:
        """Takes each reading (m,) from the array of its output."""
        if not isinstance(found, tuple | list) or len(found) != len(self.outputs):
            raise UserError(
                f"measurement.of={self.of}: outputs names {len(self.outputs)} arrays; let it return"
                " a tuple of them"
            )
        of_jax = any(type(values).__module__.startswith("jax") for values in found)
        numpy = sys.modules["jax"].numpy if of_jax else np
        rows, among_all = self._taken
        return numpy.concatenate([self._checked(values, rows) for values in found])[among_all]

    @cached_property
    def _taken(self) -> tuple[int, NDArray[np.intp]]:
        """The number of rows of each array, and the place (m,) of each reading in all arrays, one
        behind the other."""
        rows = int(self._places.max()) + 1
        outputs = np.array([self.outputs.index(name) for name in self.output])
        return rows, outputs * rows + self._places

    def _checked(self, z: Any, m: int | None) -> Any:
        if np.ndim(z) != 1 or m not in (None, len(z)):
            wanted = "one number per reading" + ("" if m is None else f", ({m},)")
            shape = "nothing" if z is None else f"an array of shape {np.shape(z)}"
            if isinstance(z, int | float | complex | np.number):
                shape = "one number for all readings"
            raise UserError(f"measurement.of={self.of}: returns {shape}; let it return {wanted}")
        return z

    def _rows(self, x: Array) -> Array:
        """Computes h of every trial, by one call of the function each; x may be complex."""
        with np.errstate(all="ignore"), warnings.catch_warnings(record=True) as caught:
            rows = [self._checked(self._at(row), self.m) for row in x * self.sizes]
        for one in caught:
            _warn_once(self.of, str(one.message), one.category)
        return np.array(rows) if rows else np.empty((0, self.m))

    @cached_property
    def _jax(self) -> tuple[Callable[[Array], Array], Callable[[Array], Array]] | None:
        """Compiled readings and slopes of a function that returns arrays of JAX; None if it does
        not."""
        if "jax" not in sys.modules:
            return None
        module = type(self._at(self.starts.values())).__module__
        if not module.startswith("jax"):
            return None
        import jax  # pyright: ignore[reportMissingImports]

        jax.config.update("jax_enable_x64", True)

        def one(x: Any) -> Any:
            return self._checked(self._at(x * self.sizes), self.m)

        readings = _in_chunks(jax.jit(jax.vmap(one)))
        slopes = _in_chunks(jax.jit(jax.vmap(jax.jacfwd(one))))
        return readings, slopes

    @cached_property
    def _judged(self) -> Judged:
        """The function with its slopes, tried near the start and away from it."""
        what = f"measurement.of={self.of}"
        found = judged(self._rows, self._tried_points, self.widest_steps, self.near, what)
        return replace(found, why=self._why_complex_steps_fail()) if found.why else found

    def _why_complex_steps_fail(self) -> str:
        """Says why, as far as the start tells."""
        values = np.array([*self.starts.values()])
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.simplefilter("error", np.exceptions.ComplexWarning)  # of functions of `math`
            z = np.asarray(self._at(values))
            if z.dtype in (np.float32, np.float16):
                return f"it computes in single precision ({z.dtype}); compute in float64"
            parameters = dict(zip(self.starts, values + 0j, strict=True))
            try:
                self.function(**parameters, **self._known)
            except (Exception, SystemExit) as error:
                return f"it takes no complex numbers ({type(error).__name__})"
        return "complex steps find other slopes"

    def remarks(self, x: Array) -> tuple[str, ...]:
        remarks = self.flat(x)
        why = "" if self._jax is not None else self._judged.why
        if why:
            remarks += (f"slopes of {self.of} are differences, as {why}",)
        return remarks

    def simulate(self, x: Array) -> Array:
        return self._rows(x) if self._jax is None else self._jax[0](x)

    def jacobian(self, x: Array) -> Array:
        if self._jax is not None:
            return self._jax[1](x)
        if self._judged.why:
            return self._judged.differences(x)
        return self._judged.slopes(x)[1]

    @property
    def jacobian_cost(self) -> float:
        if self._jax is not None:
            return float(self.n)
        return self._judged.differences_cost if self._judged.why else float(self.n + 3)


def function(
    h: Callable[..., Any], start: Mapping[str, float] | None = None, **options: Any
) -> Function:
    """Makes the measurement model of a function that a module holds by name, with the options of
    `Function`; UserError for a lambda or an inner function."""
    module = getattr(h, "__module__", "")
    name = getattr(h, "__qualname__", "")
    if not name.isidentifier() or getattr(sys.modules.get(module), name, None) is not h:
        raise UserError(
            f"{name or h!r}: give a function that a module defines under its own name, not inside"
            " another"
        )
    return Function(of=f"{module}:{name}", start=start or {}, **options)


def title_of(model: Measurement) -> str:
    """Names a model in titles: a function by its own name, a short formula by itself."""
    whole = model
    # Differential equations are written, too: what they wrap needs the times of readings.
    while isinstance(whole, Forwarding) and not isinstance(whole, WrittenModel):
        whole = whole.whole
    if isinstance(whole, Function):
        return whole.of.rpartition(":")[2]
    if isinstance(whole, Formula) and len(whole.expression) <= _LONGEST_TITLE:
        return whole.expression
    return model.name


@cache
def _warn_once(of: str, text: str, category: type[Warning]) -> None:
    """Passes a warning of a function on: contexts that ignore warnings make Python forget which it
    has shown."""
    warnings.warn(f"{of}: {text}", category, stacklevel=2)


def _in_chunks(program: Callable[[Array], Any]) -> Callable[[Array], Array]:
    """Computes a batched program in calls of `_CHUNK` trials."""

    def run(x: Array) -> Array:
        chunks = -(-max(len(x), 1) // _CHUNK)
        padded = np.zeros((chunks * _CHUNK, x.shape[1]))
        padded[: len(x)] = x
        parts = [np.asarray(program(part)) for part in np.split(padded, chunks)]
        return np.ascontiguousarray(np.concatenate(parts)[: len(x)])

    return run
