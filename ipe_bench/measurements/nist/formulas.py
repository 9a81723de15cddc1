"""The regression functions of the 27 NIST problems, in the order of NIST's own list.

Each takes the parameters b, a sequence of arrays (trials, 1), and the predictors x, arrays (m,), and returns
(trials, m). All are analytic, so that a complex step through them gives the exact Jacobian.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

Formula = Callable[..., Any]


def _gauss(b: Sequence[Any], x: Any) -> Any:
    peaks = b[2] * np.exp(-(((x - b[3]) / b[4]) ** 2)) + b[5] * np.exp(-(((x - b[6]) / b[7]) ** 2))
    return b[0] * np.exp(-b[1] * x) + peaks


def _lanczos(b: Sequence[Any], x: Any) -> Any:
    return b[0] * np.exp(-b[1] * x) + b[2] * np.exp(-b[3] * x) + b[4] * np.exp(-b[5] * x)


def _chwirut(b: Sequence[Any], x: Any) -> Any:
    return np.exp(-b[0] * x) / (b[1] + b[2] * x)


def _cubics(b: Sequence[Any], x: Any) -> Any:
    above = b[0] + x * (b[1] + x * (b[2] + x * b[3]))
    return above / (1.0 + x * (b[4] + x * (b[5] + x * b[6])))


def _enso(b: Sequence[Any], x: Any) -> Any:
    annual, second, third = 2 * np.pi * x / 12, 2 * np.pi * x / b[3], 2 * np.pi * x / b[6]
    return (
        (b[0] + b[1] * np.cos(annual) + b[2] * np.sin(annual))
        + (b[4] * np.cos(second) + b[5] * np.sin(second))
        + (b[7] * np.cos(third) + b[8] * np.sin(third))
    )


def _saturation(b: Sequence[Any], x: Any) -> Any:
    return b[0] * -np.expm1(-b[1] * x)


FORMULAS: dict[str, Formula] = {
    "Misra1a": _saturation,
    "Chwirut2": _chwirut,
    "Chwirut1": _chwirut,
    "Lanczos3": _lanczos,
    "Gauss1": _gauss,
    "Gauss2": _gauss,
    "DanWood": lambda b, x: b[0] * x ** b[1],
    "Misra1b": lambda b, x: b[0] * (1.0 - (1.0 + b[1] * x / 2.0) ** -2),
    "Kirby2": lambda b, x: (b[0] + x * (b[1] + x * b[2])) / (1.0 + x * (b[3] + x * b[4])),
    "Hahn1": _cubics,
    # NIST fits the logarithm of the breakdown strength: the readings of this model are logarithms.
    "Nelson": lambda b, time, temperature: b[0] - b[1] * time * np.exp(-b[2] * temperature),
    "MGH17": lambda b, x: b[0] + b[1] * np.exp(-x * b[3]) + b[2] * np.exp(-x * b[4]),
    "Lanczos1": _lanczos,
    "Lanczos2": _lanczos,
    "Gauss3": _gauss,
    "Misra1c": lambda b, x: b[0] * (1.0 - 1.0 / np.sqrt(1.0 + 2.0 * b[1] * x)),
    "Misra1d": lambda b, x: b[0] * b[1] * x / (1.0 + b[1] * x),
    "Roszman1": lambda b, x: b[0] - b[1] * x - np.arctan(b[2] / (x - b[3])) / np.pi,
    "ENSO": _enso,
    "MGH09": lambda b, x: b[0] * (x**2 + x * b[1]) / (x**2 + x * b[2] + b[3]),
    "Thurber": _cubics,
    "BoxBOD": _saturation,
    "Rat42": lambda b, x: b[0] / (1.0 + np.exp(b[1] - b[2] * x)),
    "MGH10": lambda b, x: b[0] * np.exp(b[1] / (x + b[2])),
    "Eckerle4": lambda b, x: b[0] / b[1] * np.exp(-0.5 * ((x - b[2]) / b[1]) ** 2),
    "Rat43": lambda b, x: b[0] / (1.0 + np.exp(b[1] - b[2] * x)) ** (1.0 / b[3]),
    "Bennett5": lambda b, x: b[0] * (b[1] + x) ** (-1.0 / b[2]),
}
