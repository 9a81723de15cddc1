"""States prior knowledge of parameters: values, starts, bounds, and their uncertainty."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.errors import UserError, refuse_unknown
from ipe_bench.basics.linalg import Array, Mask, repeated
from ipe_bench.basics.options import Component, Finite, Positive
from ipe_bench.measurements.base import Measurement, Parameter, Recorded, WrappedModel
from ipe_bench.measurements.joint import Joint

_NEAR = 1e-2
"""An estimate nearer to a bound than this share of the start's distance may be on its way there."""


@dataclass(frozen=True)
class ParameterInfo(Component):
    """Holds what is known of one parameter; all in its own unit."""

    name: str
    fixed: Finite | None = None
    """Its value, where it is not to be estimated."""
    nominal: Finite | None = None
    """Start of the estimation and centre of the prior, in place of the model's own value."""
    deviation: Positive | None = None
    """Standard deviation of the prior at error scale 1, in place of the parameter's size."""
    lower: Finite | None = None
    upper: Finite | None = None
    positive: bool = False
    """The same as lower=0: the prior is then log-normal."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.positive and self.lower is not None:
            raise UserError(
                f"lower={self.lower}: is given with positive=true, which is lower=0; leave one of"
                " them out"
            )
        lower, upper = self.bounds
        if not lower < upper:
            raise UserError(f"upper={upper}: give a number above lower={lower:g}")
        others = self.stated.keys() - {"name", "fixed"}
        if self.fixed is not None and others:
            raise UserError(
                f"fixed={self.fixed}: a fixed parameter has no {min(others)}; leave one out"
            )

    @property
    def bounds(self) -> tuple[float, float]:
        lower = -np.inf if self.lower is None else self.lower
        upper = np.inf if self.upper is None else self.upper
        return 0.0 if self.positive else lower, upper

    @property
    def stated(self) -> dict[str, Any]:
        """Stated options with their values."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return {f.name: values[f.name] for f in fields(self) if values[f.name] != f.default}


def informed(model: Measurement, known: Sequence[ParameterInfo]) -> Measurement:
    """Returns the model with this knowledge of its parameters.

    Of a parameter of which every file has its own, what is known of NAME is known of NAME_1, NAME_2
    and so on, unless that is said of one of them.

    Raises:
        UserError: of a parameter that the model does not have, or a start outside of its bounds.
    """
    copies = model.copies if isinstance(model, Joint) else {}
    found: dict[str, ParameterInfo] = {}
    for one in known:
        for name in copies.get(one.name, ()):
            found[name] = replace(one, name=name)
    for one in known:
        if one.name in copies:
            continue
        general = found.get(one.name, one)
        free = one.fixed is None and general.fixed is None
        found[one.name] = replace(general, **one.stated) if free else one
    return ConstrainedModel(model, tuple(found.values())) if found else model


@dataclass(frozen=True)
class ConstrainedModel(WrappedModel):
    """Transforms a model of which some parameters are fixed, bounded or start elsewhere to other
    coordinates.

    x counts the parameters that are left. A bounded one is ln((v - lower) / (v0 - lower)), or
    ln((upper - v0) / (upper - v)), or the difference of the logits of v and its start v0, and is
    named accordingly; its size is such that one unit of x moves v by as much at v0 as before.
    """

    whole: Measurement
    known: tuple[ParameterInfo, ...]

    by_differential_equations = False

    def __post_init__(self) -> None:
        super().__post_init__()
        names = [p.name for p in self.whole.parameters]
        for one in self.known:
            refuse_unknown(f"parameters.{one.name}", one.name, names, "parameter")
        for one, v0 in zip(self._known, self._v0, strict=True):
            lower, upper = one.bounds
            if not lower < v0 < upper:
                key = f"parameters.{one.name}"
                raise UserError(
                    f"{key}: its start, {v0:g}, is not inside its bounds; give {key}.nominal=VALUE"
                )
        if not len(self._free):
            raise UserError("parameters: all are fixed; leave at least one to be estimated")

    @cached_property
    def _known(self) -> tuple[ParameterInfo, ...]:
        """One for each of the whole model's parameters."""
        given = {one.name: one for one in self.known}
        return tuple(given.get(p.name, ParameterInfo(p.name)) for p in self.whole.parameters)

    @cached_property
    def _free(self) -> NDArray[np.intp]:
        return np.flatnonzero([one.fixed is None for one in self._known])

    @cached_property
    def _v0(self) -> Array:
        """Starts and fixed values of all parameters, in their units."""
        values = np.array(self.whole.nominal * self.whole.sizes, dtype=float)
        for k, one in enumerate(self._known):
            given = one.nominal if one.fixed is None else one.fixed
            if given is not None:
                values[k] = given
        return values

    @cached_property
    def _coordinates(self) -> _Coordinates:
        """Coordinates of the parameters that are left."""
        lower, upper = np.array([self._known[i].bounds for i in self._free]).T
        return _Coordinates(self._v0[self._free], lower, upper, self.whole.sizes[self._free])

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        c = self._coordinates
        prefixes = c.choose("", "ln_", "ln_", "logit_").tolist()
        found = []
        for p, prefix, size in zip(
            self.physical_parameters, prefixes, c.inner_size.tolist(), strict=True
        ):
            if prefix:
                p = Parameter(prefix + p.name, size=size, group=p.group or p.name)
            found.append(p)
        return tuple(found)

    @cached_property
    def physical_parameters(self) -> tuple[Parameter, ...]:
        return tuple(self.whole.parameters[i] for i in self._free)

    @cached_property
    def prior_deviations(self) -> tuple[float, ...]:
        """Standard deviations (n,) of x at error scale 1, as far as is known; 1 where nothing
        is."""
        found = []
        for i in self._free:
            deviation = self._known[i].deviation
            found.append(1.0 if deviation is None else float(deviation / self.whole.sizes[i]))
        return tuple(found)

    @property
    def fixed(self) -> dict[str, float]:
        return {one.name: one.fixed for one in self._known if one.fixed is not None}

    @cached_property
    def nominal(self) -> Array:
        return self.inner(self._coordinates.v0)

    def physical(self, x: Array) -> Array:
        return self._coordinates.value(x)

    def physical_slope(self, x: Array) -> Array:
        return self._coordinates.slope(x)

    def inner(self, v: Array) -> Array:
        """Returns x (..., n) of values (..., n) in the parameters' own units."""
        return self._coordinates.inner(v)

    def near_bounds(self, x: Array) -> dict[int, float]:
        c = self._coordinates
        values = self.physical(x[None])[0]
        found: dict[int, float] = {}
        for bounds in (c.lower, c.upper):
            reach = np.where(np.isfinite(bounds), _NEAR * np.abs(c.v0 - bounds), -1.0)
            near = np.abs(values - bounds) <= reach
            found |= {k: float(bounds[k]) for k in np.flatnonzero(near).tolist()}
        return dict(sorted(found.items()))

    def stating(self, key: str, values: Mapping[int, float]) -> Measurement:
        known = {one.name: one for one in self.known}
        for k, value in values.items():
            name = self.physical_parameters[k].name
            known[name] = replace(ParameterInfo(name), **{key: value})
        return replace(self, known=tuple(known.values()))

    def whole_x(self, x: Array) -> Array:
        """Converts x to that of the whole model; a truth's nuisances, behind the parameters, stay
        there."""
        c = self._coordinates
        own = x[:, : self.n]
        fixed = self._v0 / self.whole.sizes
        whole = repeated(fixed, len(x)).astype(x.dtype)
        whole[:, self._free] = np.where(c.bounded, c.value(own) / c.size, own)
        return np.concatenate([whole, x[:, self.n :]], axis=1)

    def own_jacobian(self, x: Array, J: Array) -> Array:
        c = self._coordinates
        # The chain rule: a value moves by its slope with each coordinate.
        slope = np.where(c.bounded, c.slope(x) / c.size, 1.0)
        return J[:, :, self._free] * slope[:, None]

    def linearization(self) -> Array:
        if np.array_equal(self._v0, self.whole.nominal * self.whole.sizes):
            return super().linearization()
        return self.jacobian(self.nominal[None])[0]

    @property
    def recorded(self) -> Recorded | None:
        """The whole model's readings, and its answer in the parameters that are left."""
        found = self.whole.recorded
        if not found:
            return None
        values = found.x * self.whole.sizes
        return Recorded(found.z, found.R, self.inner(values[self._free]))


@dataclass(frozen=True)
class _Coordinates:
    """Converts multiples x (..., n) of `inner_size` of logarithms or logits to values (..., n)
    inside of bounds."""

    v0: Array
    lower: Array
    upper: Array
    size: Array

    @cached_property
    def bounded(self) -> Mask:
        return np.isfinite(self.lower) | np.isfinite(self.upper)

    def choose(self, free: Any, above: Any, below: Any, between: Any) -> Array:
        """Chooses by parameter what holds: without bounds, above a lower one, below an upper one,
        or between both."""
        within = np.where(self.lower == -np.inf, below, between)
        within = np.where(self.upper == np.inf, above, within)
        return np.where(self.bounded, within, free)

    @cached_property
    def inner_size(self) -> Array:
        """Size of one unit of x, in the logarithm or logit."""
        return self.size / self._slope_at(self.v0)

    @cached_property
    def _origin(self) -> Array:
        return self._coordinate(self.v0)

    def _slope_at(self, v: Array) -> Array:
        """Computes the derivative of the value by its logarithm or logit."""
        with np.errstate(all="ignore"):
            above = v - self.lower
            below = self.upper - v
            between = above * below / (self.upper - self.lower)
            return self.choose(1.0, above, below, between)

    def _coordinate(self, v: Array) -> Array:
        """Computes the logarithm or logit of a value."""
        with np.errstate(all="ignore"):
            above = v - self.lower
            below = self.upper - v
            return self.choose(v, np.log(above), -np.log(below), np.log(above / below))

    def value(self, x: Array) -> Array:
        with np.errstate(all="ignore"):
            u = self._origin + x * self.inner_size
            above = self.lower + np.exp(u)
            below = self.upper - np.exp(-u)
            # The logistic function, between both bounds.
            between = self.lower + (self.upper - self.lower) / (1.0 + np.exp(-u))
            return self.choose(x * self.size, above, below, between)

    def slope(self, x: Array) -> Array:
        """Computes dv/dx."""
        return self._slope_at(self.value(x)) * self.inner_size

    def inner(self, v: Array) -> Array:
        bounded = (self._coordinate(v) - self._origin) / self.inner_size
        return np.where(self.bounded, bounded, v / self.size)
