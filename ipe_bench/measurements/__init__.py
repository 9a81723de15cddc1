"""Measurement models: what a parameter vector makes the instruments read. Config group `measurement`."""

from ipe_bench.basics.errors import without_modules
from ipe_bench.measurements.base import Input, Measurement, Parameter, Recorded, SubsetModel, UsualNoise
from ipe_bench.measurements.formula import Formula
from ipe_bench.measurements.function import Function, function
from ipe_bench.measurements.gins import Gins, RicherGins
from ipe_bench.measurements.mgh import Mgh
from ipe_bench.measurements.nist import Nist
from ipe_bench.measurements.ode.described import Ode, packaged
from ipe_bench.measurements.ode.model import OdeMeasurement
from ipe_bench.measurements.polynomial import Polynomial
from ipe_bench.measurements.positioning import Bearings, Gnss, Ranging
from ipe_bench.measurements.triad import Accelerometer, Triad

Bock, FallingBody, LotkaVolterra, Sir = map(packaged, ("bock", "falling_body", "lotka_volterra", "sir"))

__all__ = [
    "Accelerometer",
    "Bearings",
    "Bock",
    "FallingBody",
    "Formula",
    "Function",
    "Gins",
    "Gnss",
    "Input",
    "LotkaVolterra",
    "Measurement",
    "Mgh",
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
    "Triad",
    "UsualNoise",
    "function",
]

without_modules(__name__, __all__)
