"""What every number in the report means, and where it comes from: the report's appendix. A statistic's definition
stands in its record; here are the words that records are written in, the comparisons, and how to cite."""

from __future__ import annotations

from ipe_bench import __version__
from ipe_bench.statistics.comparisons import TIE
from ipe_bench.statistics.records import SCORES, STATISTICS, all_statistics

CITATION = (
    f"The ipe-bench developers (2026). ipe-bench, version {__version__} [computer program]. Beside it, state the"
    " command, the git commit and the source's digest that stand with the provenance, and the digest of the bundle"
    " where results are shared as one (`ipe-bench bundle`)."
)
"""How results of the bench are cited."""
DEFINITIONS: tuple[tuple[str, str], ...] = (
    ("trial", "One draw of true parameters and of noise. Trial t is the same for every estimator."),
    (
        "error scale",
        "Standard deviation of the true parameters about the nominal point, in multiples of the parameters' unit"
        " inputs.",
    ),
    *((record.title, record.definition) for record in STATISTICS),
    (
        "parameter 'all'",
        "Root mean square over parameters of the statistic over the linear bound, unless the statistic says otherwise.",
    ),
    *((record.title, record.definition) for record in SCORES),
    (
        "win, tie, loss",
        f"Errors are paired by trial. Mahalanobis errors that differ by less than {TIE:g} are a tie, because"
        " estimators that share a root differ by round-off alone.",
    ),
    (
        "p of error",
        "Wilcoxon's two-sided signed-rank test without ties (Biometrics Bulletin 1, 1945), with Holm's correction over"
        " the pairs of a scenario (Scandinavian Journal of Statistics 6, 1979).",
    ),
    (
        "p of success",
        "McNemar's exact test on the trials in which only one of the two succeeds (Psychometrika 12, 1947), with"
        " Holm's correction.",
    ),
    (
        "may be the best (bold)",
        "No rival succeeds significantly more often in the same trials, by the gate of the Cramér-Rao bound for all:"
        " McNemar's"
        " exact one-sided test against every rival at 5 % over their number, which leaves a true best out in at most"
        " 5 % of scenarios (Hsu, Annals of Statistics 9, 1981). Nothing is bold if no estimator is beaten.",
    ),
    (
        "performance profile",
        "Share of trials in which an estimator succeeds at a cost of at most τ times that of the cheapest success"
        " (Dolan and Moré, Mathematical Programming 91, 2002).",
    ),
    (
        "data profile",
        "Share of trials in which it succeeds within a budget (Moré and Wild, SIAM Journal on Optimization 20, 2009).",
    ),
)


def definitions() -> tuple[tuple[str, str], ...]:
    """The definitions, with those of the statistics that plugins add."""
    return (*DEFINITIONS, *((record.title, record.definition) for record in all_statistics()[len(STATISTICS) :]))
