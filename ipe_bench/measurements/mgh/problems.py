"""Standard starts and known minima of the test functions of Moré, Garbow and Hillstrom, under the names they go by.

Values and places agree with what the paper prints, to its six digits; the further digits, and the minima that it does
not list, come from Newton's method on the gradient in double precision. The functions are in `formulas`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import ipe_bench.measurements.mgh.formulas as f
from ipe_bench.measurements.mgh.formulas import Residuals

_INF = math.inf


@dataclass(frozen=True)
class Minimum:
    """A minimum of the sum of squares, or its infimum along a direction in which parameters grow without limit."""

    sum_of_squares: float
    x: tuple[float, ...] | None = None
    """Where: one minimiser of those that symmetry makes equal. None: not at one place."""


@dataclass(frozen=True)
class Problem:
    """One function with its start and its minima."""

    residuals: Residuals
    m: int
    start: tuple[float, ...]
    """The standard start (n,)."""
    minima: tuple[Minimum, ...]
    """The lowest first; the others are where methods are known to end."""


_ALPHA = 0.9794303033498624  # the root beside 1 of 10 a^10 - 11 a^9 + 1


def _problem(residuals: Residuals, m: int, start: tuple[float, ...], *minima: tuple[Any, ...]) -> Problem:
    return Problem(residuals, m, start, tuple(Minimum(*one) for one in minima))


# fmt: off
PROBLEMS: dict[str, Problem] = {
    "rosenbrock": _problem(f.rosenbrock, 2, (-1.2, 1.0), (0.0, (1.0, 1.0))),
    "freudenstein_roth": _problem(f.freudenstein_roth, 2, (0.5, -2.0),
        (0.0, (5.0, 4.0)),
        (48.98425367924, ((53.0 - 4.0 * math.sqrt(22.0)) / 3.0, (2.0 - math.sqrt(22.0)) / 3.0))),
    "powell_badly_scaled": _problem(f.powell_badly_scaled, 2, (0.0, 1.0),
        (0.0, (1.0981593296997557e-05, 9.106146739867036))),
    "brown_badly_scaled": _problem(f.brown_badly_scaled, 3, (1.0, 1.0), (0.0, (1e6, 2e-6))),
    "beale": _problem(f.beale, 3, (1.0, 1.0),
        (0.0, (3.0, 0.5)),
        # x1 to minus infinity with x1 (1 - x2) = 111/112.
        (0.4520089285714,)),
    "jennrich_sampson": _problem(f.jennrich_sampson, 10, (0.3, 0.4),
        (124.362182355615, (0.2578252136703641, 0.2578252136703641)),
        (259.580190134253, (-_INF, 0.331485278480789))),
    "helical_valley": _problem(f.helical_valley, 3, (-1.0, 0.0, 0.0), (0.0, (1.0, 0.0, 0.0))),
    "bard": _problem(f.bard, 15, (1.0, 1.0, 1.0),
        (8.21487730657898e-3, (0.08241055974978898, 1.1330360920297224, 2.3436951786425366)),
        (17.4286933333333, (0.8406666666666667, -_INF, -_INF))),
    "gaussian": _problem(f.gaussian, 15, (0.4, 1.0, 0.0),
        (1.12793276962e-8, (0.3989561378387575, 1.0000190844878132, 0.0))),
    "meyer": _problem(f.meyer, 16, (0.02, 4000.0, 250.0),
        (87.9458551707, (0.005609636471028544, 6181.3463462863, 345.2236346241341))),
    "gulf": _problem(f.gulf, 99, (5.0, 2.5, 0.15), (0.0, (50.0, 25.0, 1.5))),
    "box_3d": _problem(f.box_3d, 10, (0.0, 10.0, 20.0),
        # As well at (10, 1, -1), and wherever x1 = x2 and x3 = 0.
        (0.0, (1.0, 10.0, 1.0)),
        (0.075588740755, (0.6136003545073, _INF, 1.3199552081726))),
    "powell_singular": _problem(f.powell_singular, 4, (3.0, -1.0, 0.0, 1.0), (0.0, (0.0,) * 4)),
    "wood": _problem(f.wood, 6, (-3.0, -1.0, -3.0, -1.0), (0.0, (1.0,) * 4)),
    "kowalik_osborne": _problem(f.kowalik_osborne, 11, (0.25, 0.39, 0.415, 0.39),
        (3.07505603849238e-4, (0.19280693457903791, 0.1912823287343663, 0.12305650692632084, 0.1360623306837945)),
        (1.02734304869547e-3, (_INF, -14.0758819895, -_INF, -_INF))),
    "brown_dennis": _problem(f.brown_dennis, 20, (25.0, 5.0, -5.0, -1.0),
        (85822.2016263563, (-11.594439904762162, 13.203630051207202, -0.40343948817685954, 0.23677877445573628))),
    "osborne_1": _problem(f.osborne_1, 33, (0.5, 1.5, -1.0, 0.01, 0.02),
        (5.46489469748e-5, (0.3754100521076023, 1.935846912788271, -1.464687136689818, 0.012867534640211172,
            0.022122699661365396))),
    "biggs_exp6": _problem(f.biggs_exp6, 13, (1.0, 2.0, 1.0, 1.0, 1.0, 1.0),
        (0.0, (1.0, 10.0, 1.0, 5.0, 4.0, 3.0)),
        # The paper lists it as a minimum; it is one among x with x1 = x5 and x3 = x6, and else a saddle.
        (5.655649925499946e-3, (1.711415994719587, 17.68319818094906, 1.16314366091889, 5.18656155199345,
            1.711415994719588, 1.163143660918888)),
        # x2 to infinity.
        (0.306366611,)),
    "osborne_2": _problem(f.osborne_2, 65, (1.3, 0.65, 0.65, 0.7, 0.6, 3.0, 5.0, 7.0, 2.0, 4.5, 5.5),
        (4.01377362935478e-2, (1.3099771546273005, 0.431553794602989, 0.6336616989607241, 0.5994305347859163,
            0.7541832263280114, 0.9042885798596336, 1.365811835237028, 4.823698817227157, 2.3986848661317546,
            4.568874597667672, 5.6753414705806415)),
        # The exponential alone, with every peak outside the record.
        (1.78981358688109,)),
    "watson": _problem(f.watson, 31, (0.0,) * 6,
        (2.28767005355241e-3, (-0.015725086401458498, 1.0124348693691099, -0.23299162595673725, 1.2604300877996073,
            -1.5137289227222785, 0.992996432431134))),
    "trigonometric": _problem(f.trigonometric, 10, (0.1,) * 10,
        (0.0, (0.0,) * 10),
        (2.79505612188e-5, (0.0551509039806912, 0.0568406167947384, 0.0587640017626948, 0.0609906086567606,
            0.063626213695854, 0.0668431794527583, 0.208161518569882, 0.164363095885648, 0.0850068956885065,
            0.091431450714708))),
    "brown_almost_linear": _problem(f.brown_almost_linear, 10, (0.5,) * 10,
        # As well at (1, ..., 1).
        (0.0, (*(_ALPHA,) * 9, 1.2056969665013764)),
        (1.0, (*(0.0,) * 9, 11.0))),
    "chebyquad": _problem(f.chebyquad, 8, tuple(j / 9.0 for j in range(1, 9)),
        (3.51687372567793e-3, (0.04315276015101663, 0.1930908403841861, 0.26632870689027294, 0.5, 0.5,
            0.7336712931097271, 0.8069091596158139, 0.9568472398489833))),
}
# fmt: on
