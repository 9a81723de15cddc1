"""Calibration of three accelerometers or magnetometers by the magnitude of what they measure.

`Magnitudes` is what such models share, `Triad` the symmetric form in errors; the form in raw counts is `accelerometer`.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Annotated, Any

import numpy as np
from annotated_types import MinLen
from numpy.typing import NDArray

from ipe_bench.basics.linalg import Array
from ipe_bench.basics.options import Positive
from ipe_bench.measurements.base import Input, Measurement, Parameter, UsualNoise

_PAIRS = ((0, 1), (0, 2), (1, 2))
_BIAS_SIZE, _SCALE_SIZE, _MISALIGNMENT_SIZE = 2e-3, 2e-3, 2e-3
"""One unit of error: of a bias in multiples of the field, of a scale factor, of a misalignment in rad."""


def attitudes() -> Array:
    """26 directions (26, 3): towards the faces, edges and corners of a cube."""
    corners = [v for v in product((-1.0, 0.0, 1.0), repeat=3) if any(v)]
    return np.array([np.array(v) / np.linalg.norm(v) for v in corners])


class Magnitudes(Measurement):
    """The magnitude of a vector that a triad was exposed to in each of its attitudes, from the outputs of the triad.

    A subclass gives the outputs and how they are corrected. Each attitude is an epoch. Outputs are taken to be exact,
    with their noise counted in the readings.
    """

    analytic = True

    @property
    @abstractmethod
    def measured(self) -> Array:
        """The outputs r_k of the triad (attitudes, 3)."""

    @abstractmethod
    def corrected(self, x: Array) -> Sequence[Array]:
        """The three components, each (trials, attitudes), of what acted on the triad."""

    @property
    @abstractmethod
    def output_unit(self) -> str:
        """The unit of the outputs."""

    @abstractmethod
    def with_outputs(self, outputs: tuple[tuple[float, float, float], ...]) -> Measurement:
        """The same triad with these outputs r_k."""

    @property
    def inputs(self) -> tuple[Input, ...]:
        """What the triad shows in each attitude."""
        return tuple(Input(f"{axis} [{self.output_unit}]") for axis in "xyz")

    @property
    def input_columns(self) -> Mapping[str, Sequence[Any]]:
        return {i.heading: self.measured[:, k].tolist() for k, i in enumerate(self.inputs)}

    def with_inputs(self, columns: Mapping[str, Sequence[Any]], readings: int) -> Measurement:
        return self.with_outputs(tuple(zip(*(columns[i.heading] for i in self.inputs), strict=True)))

    @property
    def index(self) -> Mapping[str, Sequence[Any]]:
        return {"attitude": list(range(1, len(self.measured) + 1))}

    @cached_property
    def epochs(self) -> tuple[NDArray[np.intp], ...]:
        return tuple(np.arange(self.m)[:, None])

    def simulate(self, x: Array) -> Array:
        a = self.corrected(x)
        return np.sqrt(a[0] ** 2 + a[1] ** 2 + a[2] ** 2)


@dataclass(frozen=True)
class Triad(Magnitudes):
    """The magnitude |(I + E)(r_k - b)| of the vector that a triad with outputs r_k was exposed to in attitude k.

    b is the bias; E is symmetric, with scale-factor errors on its diagonal and misalignments beside it. A rotation of
    the whole triad does not change a magnitude, so it is not among the parameters. The reading of attitude k is the
    magnitude that a reference states: a scalar magnetometer, or the local gravity.

    Parameters: three biases in `unit`, three scale-factor errors in ppm, three misalignments in mrad. A bias of b bends
    the magnitude by b^2 / (2 field): 2e-6 of the field at error scale 1, to be compared with a noise of 1e-5.

    Source: Merayo, Brauer, Primdahl, Petersen, Nielsen, Scalar calibration of vector magnetometers, Measurement Science
    and Technology 11, 2000.
    """

    outputs: Annotated[tuple[tuple[float, float, float], ...], MinLen(10)] | None = None
    """Outputs r_k of the triad (attitudes, 3) in `unit`; None: a field of `field` in 26 directions."""
    field: Positive = 1.0
    """The magnitude about which sizes are chosen, in `unit`."""
    unit: str = "g"
    bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The presumed bias in `unit`; with the two that follow, the nominal point."""
    scale: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The presumed scale-factor errors, as plain numbers."""
    misalignment: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The presumed misalignments in rad."""

    @property
    def reading_unit(self) -> str:
        return self.unit

    @property
    def usual_noise(self) -> UsualNoise:
        return UsualNoise(1e-5 * self.field)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        return (
            *(Parameter(f"b{a}", self.unit, _BIAS_SIZE * self.field, "bias") for a in "xyz"),
            *(Parameter(f"k{a}", "ppm", 1e6 * _SCALE_SIZE, "scale factor") for a in "xyz"),
            *(Parameter(f"m{a}", "mrad", 1e3 * _MISALIGNMENT_SIZE, "misalignment") for a in ("xy", "xz", "yz")),
        )

    @cached_property
    def _plain_sizes(self) -> Array:
        """Sizes (9,) with scale factors and misalignments as plain numbers."""
        return self.sizes * np.repeat([1.0, 1e-6, 1e-3], 3)

    @cached_property
    def nominal(self) -> Array:
        return np.concatenate([self.bias, self.scale, self.misalignment]) / self._plain_sizes

    @property
    def output_unit(self) -> str:
        return self.unit

    def with_outputs(self, outputs: tuple[tuple[float, float, float], ...]) -> Measurement:
        return replace(self, outputs=outputs)

    @cached_property
    def measured(self) -> Array:
        return self.field * attitudes() if self.outputs is None else np.asarray(self.outputs, dtype=float)

    def corrected(self, x: Array) -> Sequence[Array]:
        p = (x * self._plain_sizes)[:, :, None]
        d = [self.measured[:, i] - p[:, i] for i in range(3)]
        a = [(1.0 + p[:, 3 + i]) * d[i] for i in range(3)]
        for k, (i, j) in enumerate(_PAIRS):
            a[i] = a[i] + p[:, 6 + k] * d[j]
            a[j] = a[j] + p[:, 6 + k] * d[i]
        return a
