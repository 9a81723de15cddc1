"""Measurement models: what a parameter vector makes the instruments read. Config group
`measurement`."""

from ipe_bench.basics.errors import without_modules
from ipe_bench.measurements.base import (
    Input,
    Measurement,
    Parameter,
    Recorded,
    SubsetModel,
    UsualNoise,
)
from ipe_bench.measurements.formula import Formula
from ipe_bench.measurements.function import Function, function
from ipe_bench.measurements.gins import Gins, RicherGins
from ipe_bench.measurements.nist import Nist
from ipe_bench.measurements.ode.described import Ode, packaged
from ipe_bench.measurements.ode.model import OdeMeasurement
from ipe_bench.measurements.polynomial import Polynomial
from ipe_bench.measurements.positioning import Bearings, Ranging

FallingBody, LotkaVolterra, Sir = map(packaged, ("falling_body", "lotka_volterra", "sir"))

__all__ = [
    "Bearings",
    "FallingBody",
    "Formula",
    "Function",
    "Gins",
    "Input",
    "LotkaVolterra",
    "Measurement",
    "Nist",
    "Ode",
    "OdeMeasurement",
    "Parameter",
    "Polynomial",
    "Ranging",
    "Recorded",
    "RicherGins",
    "Sir",
    "SubsetModel",
    "UsualNoise",
    "function",
]

without_modules(__name__, __all__)
