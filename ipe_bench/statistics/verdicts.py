"""Holds every word of verdict in one table: its value in files, the word shown and its rule.

The rules themselves are computed where their numbers are: `intervals.verdict` judges covariances,
and `real.tracks.LogTracks.verdict` the track of a log.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

from ipe_bench.trials.thresholds import FEW, FIT_LEVEL

Verdict = Literal[
    "overconfident", "too cautious", "consistent", "not refuted", "undecided", "wrong", "-"
]
"""Values of a verdict on a covariance."""

OVERCONFIDENT: Final = "overconfident"
TOO_CAUTIOUS: Final = "too cautious"
CONSISTENT: Final = "consistent"
NOT_REFUTED: Final = "not refuted"
UNDECIDED: Final = "undecided"
WRONG: Final = "wrong"
NO_VERDICT: Final = "-"
LOST: Final = "lost"
COLLAPSED: Final = "collapsed"
NO_MAXIMUM: Final = "no maximum"
SEVERAL_MAXIMA: Final = "several maxima"


@dataclass(frozen=True)
class Word:
    """Defines a word of verdict."""

    value: str
    """Stands in files and in Python."""
    shown: str
    """Stands in tables and sentences."""
    sign: str
    """Stands for it on a narrow screen, behind NEES."""
    rule: str
    """States when it is given."""


VERDICTS = (
    Word(
        OVERCONFIDENT,
        "overconfident",
        "+",
        "The reported covariance is too small: the mean NEES lies significantly (95 %) above the"
        " number of parameters.",
    ),
    Word(
        TOO_CAUTIOUS,
        "too cautious",
        "-",
        "The reported covariance is too large: the mean NEES lies significantly (95 %) below the"
        " number of parameters, even allowing for rare unseen errors.",
    ),
    Word(
        CONSISTENT,
        "consistent",
        "=",
        "There is no evidence against the reported covariance, and the interval (95 %) of the mean"
        " NEES excludes that the true variance is 1.5 times the reported one.",
    ),
    Word(
        NOT_REFUTED,
        "not refuted",
        "~",
        "There is no evidence against the reported covariance, but these trials do not exclude that"
        " the true variance is 1.5 times the reported one.",
    ),
    Word(
        UNDECIDED,
        "undecided",
        "?",
        "These trials do not exclude that the true variance is 10 times the reported one, or the"
        " mean NEES seems too small and rare large errors may be missing.",
    ),
    Word(
        WRONG,
        "wrong (not white)",
        "!",
        f"Successive innovations of a filter are correlated: a log has p below {FIT_LEVEL:g}, or"
        " significantly more than 1 % of the simulated trials have. NIS is then not a valid test.",
    ),
    Word(
        NO_VERDICT,
        "-",
        "-",
        f"Fewer than {FEW} trials converged with a reported covariance, or a tracker has neither"
        " innovations nor a path's cost.",
    ),
    Word(
        LOST,
        "lost",
        "!",
        "From the named time step of a log on, most innovations are larger than all but one in a"
        " million by chance.",
    ),
    Word(
        COLLAPSED,
        "collapsed",
        "!",
        "The particles of a log have a median effective sample size below 2.",
    ),
    Word(
        NO_MAXIMUM,
        "no maximum",
        "!",
        "The likelihood of a log has no maximum in the constants that `find=` names.",
    ),
    Word(
        SEVERAL_MAXIMA,
        "several maxima",
        "!",
        "The log hardly distinguishes several maxima of the likelihood.",
    ),
)
"""The words of verdict, those on covariances first."""
_WORDS = {word.value: word for word in VERDICTS}


def shown(value: str) -> str:
    """Returns the word shown for a verdict from files of any version."""
    return _WORDS[value].shown if value in _WORDS else value


def sign_of(value: str) -> str:
    """Returns the sign of a verdict on a narrow screen."""
    return _WORDS[value].sign
