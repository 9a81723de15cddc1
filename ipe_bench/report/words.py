"""Formats numbers for readers."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from ipe_bench import __version__

CITATION = (
    f"The ipe-bench developers (2026). ipe-bench, version {__version__} [computer program]. Beside"
    " it, state the command, the git commit and the source's digest listed under provenance."
)
"""Citation of the bench."""
_MOST_FIGURES = 12
"""Further figures of ends that are told apart."""


def value_text(value: Any) -> str:
    """Formats a number without needless zeros; a dash stands for a missing one."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "-"
    if not isinstance(value, float):
        return str(value)
    text = f"{value:g}"
    # Six figures, unless more tell it from another number; round-off does not.
    return text if math.isclose(float(text), value, rel_tol=1e-12) else repr(float(value))


def assignments(settings: Mapping[Any, str]) -> str:
    """Words settings by their keys and values, models and noises by their names alone; those that
    are missing are left out."""
    there = {key: value for key, value in settings.items() if value != "-"}
    return ", ".join(
        value if key in ("measurement", "noise") else f"{key}={value}"
        for key, value in there.items()
    )


def counted(number: int, noun: str) -> str:
    """Words a number of things."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def agreeing(verb: str, who: Sequence[Any]) -> str:
    """Words a verb of one or of several."""
    return f"{verb}s" if len(who) == 1 else verb


def from_to(numbers: Iterable[Any], show: Callable[[Any], str] = "{:,}".format) -> str:
    """Words the least and the largest of numbers, or one where both are shown alike."""
    ascending = sorted(numbers)
    return " to ".join(dict.fromkeys(map(show, (ascending[0], ascending[-1]))))


def enumerate_few(items: Sequence[str], most: int = 6) -> str:
    """Enumerates 'a, b and 3 others'; a single remaining one is named."""
    if len(items) <= most + 1:
        return ", ".join(items)
    return f"{', '.join(items[:most])} and {len(items) - most} others"


def public(text: str) -> str:
    """Shortens absolute paths to their last part: what lies before it is of this machine alone."""
    return re.sub(r"(?<![^\s='\"\[,(])/(?:[^/\s,'\"\]]+/)+(?=[^/\s])", "…/", text)


def share_text(share: float) -> str:
    """Formats a share in per cent to at most a tenth, such as 100, 77.5 or 0.

    Halves go up, and none is rounded to all, to none or to the share from which on an estimator
    succeeds.
    """
    from ipe_bench.trials.thresholds import HELD  # late: loads NumPy, which help does without

    if not math.isfinite(share):
        return "-"
    if share in (0, 1):
        return f"{100 * share:.0f}"
    if not 0.0005 <= share < 0.9995:
        return "<0.1" if share < 0.5 else ">99.9"
    # Round-off may leave a half just below itself.
    tenths = math.floor(1000 * share + 0.5 + 1e-9)
    if share < HELD:
        tenths = min(tenths, math.ceil(1000 * HELD) - 1)
    return f"{tenths / 10:.1f}".removesuffix(".0")


def percent(share: float) -> str:
    """Formats a share in per cent with its sign."""
    text = share_text(share)
    return text if text == "-" else f"{text} %"


def ends_in_percent(low: float, high: float) -> tuple[str, str]:
    """Formats the ends of an interval of a share, with a decimal more for each tenth of its width
    below 2 per cent."""
    decimals = 0
    if low < high:
        decimals = max(0, math.ceil(math.log10(0.02 / (high - low))))

    def end(share: float) -> str:
        return f"{100 * share:.{0 if share in (0, 1) else decimals}f}"

    return end(low), end(high)


def told_apart(low: float, high: float, show: Callable[[float, int], str]) -> tuple[str, str]:
    """Formats the ends of an interval by a function of a number and how many more figures it has:
    by as few more as tell the ends apart."""
    ends = show(low, 0), show(high, 0)
    more = 0
    while ends[0] == ends[1] and low < high and more < _MOST_FIGURES:
        more += 1
        ends = show(low, more), show(high, more)
    return ends


def short(value: float) -> str:
    """Formats about four figures."""
    if not math.isfinite(value):
        return value_text(float(value))
    if value == int(value) and abs(value) < 1000:
        return str(int(value))
    if abs(value) >= 1e6 or 0 < abs(value) < 1e-3:
        return _powered(f"{value:.1e}")
    if abs(value) >= 100:
        return f"{value:,.0f}"
    return f"{value:.3f}" if abs(value) < 10 else f"{value:.1f}"


def scientific(value: float) -> str:
    """Formats three figures, with an exponent below a thousandth."""
    is_small = 0 < abs(value) < 1e-3
    return _powered(f"{value:.2e}" if is_small else f"{value:.3g}")


def _powered(text: str) -> str:
    """Writes an exponent without its plus and leading zero."""
    digits, _, power = text.partition("e")
    return f"{digits}e{int(power)}" if power else digits


def brief(value: float) -> str:
    """Formats two decimals below ten, three figures above, in at most five characters."""
    if not math.isfinite(value):
        return value_text(float(value))
    if value == int(value) and value < 1000:
        return str(int(value))
    if value >= 999.5e6:
        return _powered(f"{value:.0e}")
    return compact(value) if value >= 9.995 else f"{value:.2f}"


_ALIKE = 0.05
"""Part of a median by which a mean may differ and is not shown."""


def cost(median: float, mean: float) -> str:
    """Formats a median cost, with the mean behind it where a few trials carry that."""
    alike = not abs(mean - median) > _ALIKE * median
    return brief(median) if alike else f"{brief(median)}/{brief(mean)}"


def compact(value: float, more: int = 0) -> str:
    """Formats three figures in at most five characters if possible: thousands as k, millions as
    M. With `more` figures than three it writes the number out."""
    if not math.isfinite(value):
        return value_text(float(value))
    if more:
        return f"{value:.{3 + more}g}"
    rounded = float(f"{value:.2e}")
    if rounded == 0:
        return "0"
    if not 1e-2 <= abs(rounded) < 1e9:
        return _powered(f"{value:.1e}")
    return _in_unit(rounded, 3, {"M": 1e6, "k": 1e3, "": 1.0})


def duration(seconds: float, figures: int = 3) -> str:
    """Formats seconds in the unit that suits them."""
    if not math.isfinite(seconds):
        return "-"
    if seconds <= 0:
        return "0 s"
    rounded = float(f"{seconds:.{figures - 1}e}")
    return _in_unit(rounded, figures, {" s": 1.0, " ms": 1e-3, " µs": 1e-6, " ns": 1e-9})


def _in_unit(value: float, figures: int, units: Mapping[str, float]) -> str:
    """Formats so many figures of a number in the first of the descending units that it reaches, or
    in the last."""
    *_, smallest = units
    reached = [unit for unit, size in units.items() if abs(value) >= size]
    unit = reached[0] if reached else smallest
    scaled = value / units[unit]
    # Round-off may leave a power of ten just below its order.
    order = math.floor(math.log10(abs(scaled)) + 1e-9)
    return f"{scaled:.{max(0, figures - 1 - order)}f}{unit}"


def p_value(p: float, least: float = 0.0) -> str:
    """Formats a probability, a very small one by its order; `least` is its lower limit in a count
    of simulations."""
    if not math.isfinite(p):
        return "-"
    if p <= least and least > 0:
        return f"≤{p_value(least)}"
    if p >= 1e-3:
        return f"{p:.3f}"
    return f"{p:.0e}" if p > 1e-300 else "<1e-300"


def varying(columns: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Returns the columns that differ among the rows; the model's name alone if that tells every
    two settings apart."""
    texts = {c: [str(row.get(c)) for row in rows] for c in columns}
    apart = [c for c in columns if len(set(texts[c])) > 1]
    settings = set(zip(*(texts[c] for c in apart), strict=True))
    if "measurement" in apart and len(settings) == len(set(texts["measurement"])):
        return ["measurement"]
    return apart
