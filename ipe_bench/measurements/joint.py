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

    @property
    def name(self) -> str:  # type: ignore[override]
        return self.parts[0].name

    def __post_init__(self) -> None:
        super().__post_init__()
        units = {part.reading_unit for part in self.parts}
        if len(units) > 1:
            raise UserError(f"readings: the files have readings in different units: {', '.join(sorted(units))}")

    @cached_property
    def _places(self) -> tuple[NDArray[np.intp], ...]:
        """Where the parameters of each part stand among those of all."""
        names: dict[str, int] = {}
        return tuple(
            np.array([names.setdefault(name, len(names)) for name in self._names(k)]) for k in range(len(self.parts))
        )

    def _names(self, k: int) -> list[str]:
        """What the parameters of part k are called among those of all."""
        part = self.parts[k]
        return [f"{p.name}_{k + 1}" if p.name in part.own_parameters else p.name for p in part.physical_parameters]

    @cached_property
    def copies(self) -> Mapping[str, tuple[str, ...]]:
        """What the parameters are called here of which every file has its own, by what the model calls them."""
        found: dict[str, list[str]] = {}
        for k, part in enumerate(self.parts):
            for own, name in zip(part.physical_parameters, self._names(k), strict=True):
                if own.name in part.own_parameters:
                    found.setdefault(own.name, []).append(name)
        return {name: tuple(each) for name, each in found.items()}

    @cached_property
    def _first(self) -> list[tuple[int, int]]:
        """The part in which each parameter appears first, and its place there."""
        found: dict[int, tuple[int, int]] = {}
        for part, places in enumerate(self._places):
            for i, place in enumerate(places.tolist()):
                found.setdefault(place, (part, i))
        return [found[j] for j in range(len(found))]

    def _each(self, parameters: Sequence[tuple[Parameter, ...]]) -> tuple[Parameter, ...]:
        named = []
        for part, i in self._first:
            own = self.parts[part].physical_parameters[i].name in self.parts[part].own_parameters
            p = parameters[part][i]
            named.append(replace(p, name=f"{p.name}_{part + 1}", group=p.group or p.name) if own else p)
        return tuple(named)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        return self._each([part.parameters for part in self.parts])

    @cached_property
    def physical_parameters(self) -> tuple[Parameter, ...]:
        return self._each([part.physical_parameters for part in self.parts])

    @cached_property
    def nominal(self) -> Array:
        return np.array([self.parts[part].nominal[i] for part, i in self._first])

    @property
    def fixed(self) -> Mapping[str, float]:
        return {name: value for part in self.parts for name, value in part.fixed.items()}

    def physical(self, x: Array) -> Array:
        values = [part.physical(x[:, places]) for part, places in zip(self.parts, self._places, strict=True)]
        return np.stack([values[part][:, i] for part, i in self._first], axis=1)

    def physical_slope(self, x: Array) -> Array:
        slopes = [part.physical_slope(x[:, places]) for part, places in zip(self.parts, self._places, strict=True)]
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
    def reading_unit(self) -> str:  # type: ignore[override]
        return self.parts[0].reading_unit

    @property
    def reading_name(self) -> str:  # type: ignore[override]
        return self.parts[0].reading_name

    @property
    def usual_noise(self) -> UsualNoise | None:  # type: ignore[override]
        """That of the parts, where it is one."""
        known = [part.usual_noise for part in self.parts]
        return known[0] if all(one == known[0] for one in known) else None

    def simulate(self, x: Array) -> Array:
        pairs = zip(self.parts, self._places, strict=True)
        return np.concatenate([part.simulate(x[:, places]) for part, places in pairs], axis=1)

    def jacobian(self, x: Array) -> Array:
        J = np.zeros((len(x), self.m, self.n))
        for part, places, start in zip(self.parts, self._places, self._starts, strict=False):
            J[:, start : start + part.m, places] = part.jacobian(x[:, places])
        return J

    def linearization(self) -> Array:
        H = np.zeros((self.m, self.n))
        for part, places, start in zip(self.parts, self._places, self._starts, strict=False):
            H[start : start + part.m, places] = part.linearization()
        return H
