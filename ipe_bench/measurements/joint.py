"""Several sets of readings that are estimated together: common parameters, and some of which every set has its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipe_bench.basics.errors import UserError
from ipe_bench.basics.linalg import Array
from ipe_bench.measurements.base import Measurement, Parameter, UsualNoise


@dataclass(frozen=True)
class Joint(Measurement):
    """The readings of several models after one another, file by file.

    Parameters of one name are one parameter, but for those that a model calls its own (`own_parameters`): these get the
    number of their file, as in clock_1 and clock_2.
    """

    parts: tuple[Measurement, ...]

    name = property(lambda joint: joint.parts[0].name)  # type: ignore[assignment]
    reading_unit = property(lambda joint: joint.parts[0].reading_unit)  # type: ignore[assignment]
    reading_name = property(lambda joint: joint.parts[0].reading_name)  # type: ignore[assignment]

    def __post_init__(self) -> None:
        super().__post_init__()
        units = {part.reading_unit for part in self.parts}
        if len(units) > 1:
            raise UserError(f"readings: the files have readings in different units: {', '.join(sorted(units))}")

    @cached_property
    def _places(self) -> tuple[NDArray[np.intp], ...]:
        """Where the parameters of each part stand among those of all."""
        names: dict[str, int] = {}
        each = [[names.setdefault(name, len(names)) for name in self._names(k)] for k in range(len(self.parts))]
        return tuple(np.array(places) for places in each)

    def _names(self, k: int) -> list[str]:
        """What the parameters of part k are called among those of all."""
        part = self.parts[k]
        return [f"{p.name}_{k + 1}" if p.name in part.own_parameters else p.name for p in part.physical_parameters]

    @cached_property
    def copies(self) -> Mapping[str, tuple[str, ...]]:
        """What the parameters are called here of which every file has its own, by what the model calls them."""
        found: dict[str, tuple[str, ...]] = {}
        for k, part in enumerate(self.parts):
            for own, name in zip(part.physical_parameters, self._names(k), strict=True):
                if own.name in part.own_parameters:
                    found[own.name] = (*found.get(own.name, ()), name)
        return found

    @cached_property
    def _first(self) -> list[tuple[int, int]]:
        """The part in which each parameter appears first, and its place there."""
        found: dict[int, tuple[int, int]] = {}
        for part, places in enumerate(self._places):
            for i, place in enumerate(places.tolist()):
                found.setdefault(place, (part, i))
        return [found[j] for j in range(len(found))]

    def _each(self, attribute: str) -> tuple[Parameter, ...]:
        named = []
        for k, i in self._first:
            part = self.parts[k]
            p: Parameter = getattr(part, attribute)[i]
            own = part.physical_parameters[i].name in part.own_parameters
            named.append(replace(p, name=f"{p.name}_{k + 1}", group=p.group or p.name) if own else p)
        return tuple(named)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        return self._each("parameters")

    @cached_property
    def physical_parameters(self) -> tuple[Parameter, ...]:
        return self._each("physical_parameters")

    @cached_property
    def nominal(self) -> Array:
        return np.array([self.parts[part].nominal[i] for part, i in self._first])

    @property
    def fixed(self) -> Mapping[str, float]:
        return {name: value for part in self.parts for name, value in part.fixed.items()}

    def _of_parts(self, method: str, x: Array) -> list[Array]:
        """What that method of each part gives for its own parameters."""
        pairs = zip(self.parts, self._places, strict=True)
        return [getattr(part, method)(x[:, places]) for part, places in pairs]

    def physical(self, x: Array) -> Array:
        values = self._of_parts("physical", x)
        return np.stack([values[part][:, i] for part, i in self._first], axis=1)

    def physical_slope(self, x: Array) -> Array:
        slopes = self._of_parts("physical_slope", x)
        return np.stack([slopes[part][:, i] for part, i in self._first], axis=1)

    @cached_property
    def m(self) -> int:
        return sum(part.m for part in self.parts)

    @cached_property
    def _starts(self) -> list[int]:
        """Where the readings of each part begin."""
        return np.cumsum([0, *(part.m for part in self.parts)]).tolist()

    @property
    def index(self) -> Mapping[str, Sequence[Any]]:
        columns = [part.index for part in self.parts]
        names = dict.fromkeys(name for column in columns for name in column)
        files = [k for k, part in enumerate(self.parts, 1) for _ in range(part.m)]
        joined = {
            name: [v for column, part in zip(columns, self.parts, strict=True) for v in column.get(name, [""] * part.m)]
            for name in names
        }
        return {"file": files, **joined}

    @cached_property
    def epochs(self) -> tuple[NDArray[np.intp], ...] | None:
        """Those of the files after one another; None where a file has none."""
        parts = [part.epochs for part in self.parts]
        if any(epochs is None for epochs in parts):
            return None
        return tuple(rows + start for epochs, start in zip(parts, self._starts, strict=False) for rows in epochs or ())

    @property
    def offset(self) -> Array:
        return np.concatenate([part.offset for part in self.parts])

    @property
    def usual_noise(self) -> UsualNoise | None:  # type: ignore[override]
        """That of the parts, where it is one."""
        known = [part.usual_noise for part in self.parts]
        return known[0] if all(one == known[0] for one in known) else None

    def remarks(self, x: Array) -> tuple[str, ...]:
        said = [part.remarks(x[places]) for part, places in zip(self.parts, self._places, strict=True)]
        return tuple(dict.fromkeys(sentence for one in said for sentence in one))

    def simulate(self, x: Array) -> Array:
        return np.concatenate(self._of_parts("simulate", x), axis=1)

    def jacobian(self, x: Array) -> Array:
        return self._placed(self._of_parts("jacobian", x))

    def coarse_jacobian(self, x: Array) -> Array:
        return self._placed(self._of_parts("coarse_jacobian", x))

    def linearization(self) -> Array:
        return self._placed([part.linearization()[None] for part in self.parts])[0]

    def _placed(self, slopes: Sequence[Array]) -> Array:
        """The slopes (trials, m, n) of the parts in one matrix, zero where a part has not the parameter."""
        J = np.zeros((len(slopes[0]), self.m, self.n))
        for slope, places, start in zip(slopes, self._places, self._starts, strict=False):
            J[:, start : start + slope.shape[1], places] = slope
        return J

    @property
    def jacobian_cost(self) -> float:
        """The mean of the parts, whose simulations are taken to cost alike."""
        return float(np.mean([part.jacobian_cost for part in self.parts]))

    @property
    def coarse_jacobian_cost(self) -> float:
        return float(np.mean([part.coarse_jacobian_cost for part in self.parts]))
