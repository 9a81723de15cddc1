"""Joins several sets of readings with common parameters, and some of which each set has its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.measurements.base import Epochs, Measurement, Parameter, UsualNoise


@dataclass(frozen=True)
class Joint(Measurement):
    """Joins the readings of several models, file by file.

    Parameters of one name are one parameter, but for those that a model calls its own
    (`own_parameters`): these get the number of their file, as in clock_1 and clock_2.
    """

    parts: tuple[Measurement, ...]

    def __post_init__(self) -> None:
        super().__post_init__()
        units = {part.reading_unit for part in self.parts}
        if len(units) > 1:
            raise UserError(
                f"readings: the files have readings in different units: {', '.join(sorted(units))}"
            )

    @property
    def name(self) -> str:
        return self.parts[0].name

    @property
    def reading_unit(self) -> str:
        return self.parts[0].reading_unit

    @property
    def reading_name(self) -> str:
        return self.parts[0].reading_name

    @property
    def copies(self) -> dict[str, list[str]]:
        """Names in this model of the parameters of which every file has its own, by their names in
        the parts."""
        found: dict[str, list[str]] = {}
        for k, part in enumerate(self.parts, 1):
            for name in part.own_parameters:
                found.setdefault(name, []).append(f"{name}_{k}")
        return found

    @cached_property
    def _places(self) -> list[NDArray[np.intp]]:
        """Places of each part's parameters among all."""
        numbers: dict[str, int] = {}
        found = []
        for k, part in enumerate(self.parts):
            names = [self._named(p, p, k).name for p in part.physical_parameters]
            # A name that no part before has is the next of all.
            places = [numbers.setdefault(name, len(numbers)) for name in names]
            found.append(np.array(places))
        return found

    def _named(self, p: Parameter, known: Parameter, k: int) -> Parameter:
        """Renames a parameter of part k, which users know as `known`, to its name among all."""
        if known.name not in self.parts[k].own_parameters:
            return p
        return replace(p, name=f"{p.name}_{k + 1}", group=p.group or p.name)

    @cached_property
    def _first(self) -> list[tuple[int, int]]:
        """The part in which each parameter appears first, and its place there."""
        found: dict[int, tuple[int, int]] = {}
        for k, places in enumerate(self._places):
            for i, place in enumerate(places.tolist()):
                found.setdefault(place, (k, i))
        return [found[place] for place in sorted(found)]

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        found = []
        for k, i in self._first:
            part = self.parts[k]
            found.append(self._named(part.parameters[i], part.physical_parameters[i], k))
        return tuple(found)

    @cached_property
    def physical_parameters(self) -> tuple[Parameter, ...]:
        known = ((self.parts[k].physical_parameters[i], k) for k, i in self._first)
        return tuple(self._named(p, p, k) for p, k in known)

    @cached_property
    def nominal(self) -> Array:
        return np.array([self.parts[k].nominal[i] for k, i in self._first])

    @property
    def fixed(self) -> Mapping[str, float]:
        return {name: value for part in self.parts for name, value in part.fixed.items()}

    def _of_parts(self, method: str, x: Array) -> list[Any]:
        """Computes that method of each part at its own parameters, which are on the last axis of
        x."""
        pairs = zip(self.parts, self._places, strict=True)
        return [getattr(part, method)(x[..., places]) for part, places in pairs]

    def _columns(self, method: str, x: Array) -> Array:
        values = self._of_parts(method, x)
        return np.stack([values[k][:, i] for k, i in self._first], axis=1)

    def physical(self, x: Array) -> Array:
        return self._columns("physical", x)

    def inner(self, v: Array) -> Array:
        return self._columns("inner", v)

    def physical_slope(self, x: Array) -> Array:
        return self._columns("physical_slope", x)

    @cached_property
    def _starts(self) -> list[int]:
        """First reading of each part, and the end of the last."""
        return np.cumsum([0, *(part.m for part in self.parts)]).tolist()

    @property
    def m(self) -> int:
        return self._starts[-1]

    @property
    def index(self) -> Mapping[str, Sequence[Any]]:
        files = [[k] * part.m for k, part in enumerate(self.parts, 1)]
        joined: dict[str, list[Any]] = {"file": list(chain.from_iterable(files))}
        columns = [part.index for part in self.parts]
        for name in dict.fromkeys(chain.from_iterable(columns)):
            joined[name] = []
            for column, part in zip(columns, self.parts, strict=True):
                joined[name] += column.get(name, [""] * part.m)
        return joined

    @property
    def periods(self) -> Array | Sequence[float]:
        if not any(len(part.periods) for part in self.parts):
            return ()
        each = [part.periods if len(part.periods) else np.zeros(part.m) for part in self.parts]
        return np.concatenate(each)

    @cached_property
    def epochs(self) -> Epochs | None:
        """Epochs of the files one after another; None if a file has none."""
        found: list[NDArray[np.intp]] = []
        for part, start in zip(self.parts, self._starts, strict=False):
            if part.epochs is None:
                return None
            found += [rows + start for rows in part.epochs]
        return tuple(found)

    @property
    def offset(self) -> Array:
        return np.concatenate([part.offset for part in self.parts])

    @property
    def usual_noise(self) -> UsualNoise | None:
        """Usual noise of the parts, if they share one."""
        first, *others = (part.usual_noise for part in self.parts)
        return first if all(one == first for one in others) else None

    def remarks(self, x: Array) -> tuple[str, ...]:
        return tuple(dict.fromkeys(chain.from_iterable(self._of_parts("remarks", x))))

    def simulate(self, x: Array) -> Array:
        return np.concatenate(self._of_parts("simulate", x), axis=1)

    def jacobian(self, x: Array) -> Array:
        return self._placed(self._of_parts("jacobian", x))

    def coarse_jacobian(self, x: Array) -> Array:
        return self._placed(self._of_parts("coarse_jacobian", x))

    def linearization(self) -> Array:
        return self._placed([part.linearization()[None] for part in self.parts])[0]

    def _placed(self, slopes: Sequence[Array]) -> Array:
        """Assembles the slopes (trials, m, n) of the parts in one matrix, zero where a part has not
        the parameter."""
        J = np.zeros((len(slopes[0]), self.m, self.n))
        for slope, places, start in zip(slopes, self._places, self._starts, strict=False):
            end = start + slope.shape[1]
            J[:, start:end, places] = slope
        return J

    @property
    def jacobian_cost(self) -> float:
        """The mean of the parts, whose simulations are taken to cost alike."""
        return float(np.mean([part.jacobian_cost for part in self.parts]))

    @property
    def coarse_jacobian_cost(self) -> float:
        return float(np.mean([part.coarse_jacobian_cost for part in self.parts]))
