"""What is known of parameters before anything is measured: values, starts, bounds, and how far off they may be.

A model in which that is so is the model in other coordinates: fixed parameters are gone, and bounded ones run over all
numbers, so that no estimator and no draw can leave the bounds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.errors import UserError, unknown
from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Component, Finite, Positive
from ipe_bench.measurements.base import Measurement, Parameter, Recorded, WrappedModel
from ipe_bench.measurements.joint import Joint

_NEAR = 1e-2
"""An estimate nearer to a bound than this share of the start's distance may be on its way there."""


@dataclass(frozen=True)
class ParameterInfo(Component):
    """What is known of one parameter; all in its own unit."""

    name: str
    fixed: Finite | None = None
    """Its value, where it is not to be estimated."""
    nominal: Finite | None = None
    """Where estimation starts and the prior is centred, in place of the model's own value."""
    deviation: Positive | None = None
    """Standard deviation of the prior at error scale 1, in place of the parameter's size."""
    lower: Finite | None = None
    upper: Finite | None = None
    positive: bool = False
    """The same as lower=0: the prior is then log-normal."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.positive and self.lower is not None:
            raise UserError(f"lower={self.lower}: is given with positive=true, which is lower=0; leave one of them out")
        lower, upper = self.bounds
        if not lower < upper:
            raise UserError(f"upper={upper}: give a number above lower={lower:g}")
        if self.fixed is not None and (others := self.stated.keys() - {"name", "fixed"}):
            raise UserError(f"fixed={self.fixed}: a fixed parameter has no {min(others)}; leave one out")

    @property
    def bounds(self) -> tuple[float, float]:
        lower = 0.0 if self.positive else -np.inf if self.lower is None else self.lower
        return lower, np.inf if self.upper is None else self.upper

    @property
    def stated(self) -> dict[str, Any]:
        """What is said, by option."""
        return {f.name: value for f in fields(self) if (value := getattr(self, f.name)) != f.default}


def informed(model: Measurement, known: Sequence[ParameterInfo]) -> Measurement:
    """The model in which so much is known of its parameters.

    Of a parameter of which every file has its own, what is known of NAME is known of NAME_1, NAME_2 and so on, unless
    that is said of one of them.

    Raises:
        UserError: of a parameter that the model does not have, or a start outside of its bounds.
    """
    copies = model.copies if isinstance(model, Joint) else {}
    found = {name: replace(one, name=name) for one in known for name in copies.get(one.name, ())}
    for one in (one for one in known if one.name not in copies):
        general = found.get(one.name, one)
        free = one.fixed is None and general.fixed is None
        found[one.name] = replace(general, **one.stated) if free else one
    return ConstrainedModel(model, tuple(found.values())) if found else model


@dataclass(frozen=True)
class ConstrainedModel(WrappedModel):
    """A model of which some parameters are fixed, bounded or start elsewhere.

    x counts the parameters that are left. A bounded one is ln((v - lower) / (v0 - lower)), or
    ln((upper - v0) / (upper - v)), or the difference of the logits of v and its start v0, and is named accordingly; its
    size is such that one unit of x moves v by as much at v0 as before.
    """

    whole: Measurement
    known: tuple[ParameterInfo, ...]

    by_differential_equations = False

    def __post_init__(self) -> None:
        super().__post_init__()
        names = [p.name for p in self.whole.parameters]
        for one in self.known:
            if one.name not in names:
                raise UserError(f"parameters.{one.name}: {unknown(one.name, names, 'parameter')}")
        for one, v0 in zip(self._known, self._v0, strict=True):
            if not one.bounds[0] < v0 < one.bounds[1]:
                key = f"parameters.{one.name}"
                raise UserError(f"{key}: its start, {v0:g}, is not inside of its bounds; give {key}.nominal")
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
        starts = self.whole.nominal * self.whole.sizes
        given = [one.nominal if one.fixed is None else one.fixed for one in self._known]
        return np.array([s if g is None else g for s, g in zip(starts, given, strict=True)], dtype=float)

    @cached_property
    def _transformed(self) -> tuple[_Transformation, ...]:
        """Of the parameters that are left."""
        sizes = self.whole.sizes.tolist()
        return tuple(_Transformation(float(self._v0[i]), self._known[i].bounds, sizes[i]) for i in self._free)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(
            p if t.plain else Parameter(f"{t.prefix}_{p.name}", size=t.inner_size, group=p.group or p.name)
            for p, t in zip(self.physical_parameters, self._transformed, strict=True)
        )

    @cached_property
    def physical_parameters(self) -> tuple[Parameter, ...]:
        return tuple(self.whole.parameters[i] for i in self._free)

    @cached_property
    def prior_deviations(self) -> tuple[float, ...]:
        """Standard deviations (n,) of x at error scale 1, as far as is known; 1 where nothing is."""
        given = [self._known[i].deviation for i in self._free]
        sizes = self.whole.sizes[self._free]
        return tuple(1.0 if d is None else float(d / size) for d, size in zip(given, sizes, strict=True))

    @property
    def fixed(self) -> dict[str, float]:
        return {one.name: one.fixed for one in self._known if one.fixed is not None}

    @cached_property
    def nominal(self) -> Array:
        return np.array([t.inner(t.v0) for t in self._transformed])

    def _each(self, method: str, values: Array) -> Array:
        """What that method of each transformation makes of its column of values (trials, n)."""
        return np.stack([getattr(t, method)(values[:, k]) for k, t in enumerate(self._transformed)], axis=1)

    def physical(self, x: Array) -> Array:
        return self._each("value", x)

    def physical_slope(self, x: Array) -> Array:
        return self._each("slope", x)

    def inner(self, values: Array) -> Array:
        """x (trials, n) of values (trials, n) in the parameters' own units."""
        return self._each("inner", values)

    def near_bounds(self, x: Array) -> dict[int, float]:
        values = self.physical(x[None])[0]
        return {
            k: bound
            for k, (t, v) in enumerate(zip(self._transformed, values, strict=True))
            for bound in t.bounds
            if abs(v - bound) <= _NEAR * abs(t.v0 - bound) < np.inf
        }

    def stating(self, key: str, values: Mapping[int, float]) -> Measurement:
        given = {one.name: one for one in self.known}
        for k, value in values.items():
            name = self.physical_parameters[k].name
            given[name] = replace(ParameterInfo(name), **{key: value})
        return replace(self, known=tuple(given.values()))

    def whole_x(self, x: Array) -> Array:
        """What comes behind the parameters, a truth's nuisances, stays there."""
        n, sizes = self.n, self.whole.sizes
        whole = np.repeat((self._v0 / sizes)[None], len(x), axis=0).astype(x.dtype)
        for k, (i, t) in enumerate(zip(self._free, self._transformed, strict=True)):
            whole[:, i] = x[:, k] if t.plain else t.value(x[:, k]) / sizes[i]
        return np.concatenate([whole, x[:, n:]], axis=1)

    def own_jacobian(self, x: Array, J: Array) -> Array:
        slopes = [
            np.ones(len(x)) if t.plain else t.slope(x[:, k]) / self.whole.sizes[i]
            for k, (i, t) in enumerate(zip(self._free, self._transformed, strict=True))
        ]
        return J[:, :, self._free] * np.stack(slopes, axis=1)[:, None]

    def linearization(self) -> Array:
        if np.array_equal(self._v0, self.whole.nominal * self.whole.sizes):
            return super().linearization()
        return self.jacobian(self.nominal[None])[0]

    @property
    def recorded(self) -> Recorded | None:
        """The whole model's readings, and its answer in the parameters that are left."""
        found = self.whole.recorded
        if found is None:
            return None
        with np.errstate(all="ignore"):
            x = self.inner((found.x * self.whole.sizes)[None, self._free])[0]
        return Recorded(found.z, found.R, x)


@dataclass(frozen=True)
class _Transformation:
    """From a multiple x of `inner_size` to a value inside of its bounds."""

    v0: float
    bounds: tuple[float, float]
    size: float

    @property
    def plain(self) -> bool:
        return not np.isfinite(self.bounds).any()

    @property
    def prefix(self) -> str:
        return "logit" if np.isfinite(self.bounds).all() else "ln"

    @property
    def inner_size(self) -> float:
        """What one unit of x is, of the logarithm or logit."""
        return self.size / self._slope_at(self.v0)

    def _slope_at(self, v: Any) -> Any:
        """The derivative of the value by its logarithm or logit."""
        lower, upper = self.bounds
        if upper == np.inf:
            return v - lower
        return upper - v if lower == -np.inf else (v - lower) * (upper - v) / (upper - lower)

    def _coordinate(self, v: Any) -> Any:
        lower, upper = self.bounds
        if upper == np.inf:
            return np.log(v - lower)
        return -np.log(upper - v) if lower == -np.inf else np.log((v - lower) / (upper - v))

    def value(self, x: Any) -> Any:
        if self.plain:
            return x * self.size
        lower, upper = self.bounds
        u = self._coordinate(self.v0) + x * self.inner_size
        with np.errstate(over="ignore"):
            if upper == np.inf:
                return lower + np.exp(u)
            return upper - np.exp(-u) if lower == -np.inf else lower + (upper - lower) / (1.0 + np.exp(-u))

    def slope(self, x: Any) -> Any:
        """dv/dx."""
        return np.full(np.shape(x), self.size) if self.plain else self._slope_at(self.value(x)) * self.inner_size

    def inner(self, v: Any) -> Any:
        return v / self.size if self.plain else (self._coordinate(v) - self._coordinate(self.v0)) / self.inner_size
