"""Changes that would make ipe-bench wrong, and the quick tests that notice each; `notice.py` tries them.

A change replaces a snippet that stands exactly once in the package, wherever that is: white space and commas before a
bracket do not count, so that neither reformatting nor moving a module makes a change stale.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path

TESTS = Path(__file__).resolve().parents[1]
PACKAGE = TESTS.parent / "ipe_bench"


@dataclass(frozen=True)
class Change:
    """A snippet that is replaced by another, and what that does."""

    room: str
    does: str
    """What becomes wrong, in words."""
    before: str
    after: str
    tests: str
    """Names of test files or of folders of them, wherever they stand; those that notice it soonest come first."""
    survives: str = ""
    """Why no quick test notices it; empty if one does."""

    @property
    def files(self) -> list[Path]:
        """The test files and folders that are named."""
        return [path for name in self.tests.split() for path in TESTS.rglob(name)]


@cache
def sources() -> dict[Path, str]:
    """The text of every module, folded."""
    return {path: folded(path.read_text(encoding="utf-8")) for path in sorted(PACKAGE.rglob("*.py"))}


def folded(text: str) -> str:
    """A text without white space and without commas before a bracket."""
    text = "".join(text.split())
    for bracket in ")]}":
        text = text.replace(f",{bracket}", bracket)
    return text


def places(change: Change) -> Iterator[tuple[Path, int]]:
    """Where the snippet stands: modules, and places in their folded text."""
    wanted = folded(change.before)
    for path, text in sources().items():
        at = text.find(wanted)
        while at >= 0:
            yield path, at
            at = text.find(wanted, at + 1)


def changed(text: str, change: Change) -> str:
    """The text of a module with the snippet, with the other one in its place."""
    solid = [i for i, sign in enumerate(text) if not sign.isspace()]
    commas = {i for i, after in pairwise(solid) if text[i] == "," and text[after] in ")]}"}
    kept = [i for i in solid if i not in commas]
    wanted = folded(change.before)
    at = folded(text).index(wanted)
    return text[: kept[at]] + change.after + text[kept[at + len(wanted) - 1] + 1 :]


CHANGES = {
    # Those that an audit of 0.3.0 found unnoticed.
    "margin-start": Change(
        "statistics",
        "a start that may be right counts as wrong where two folders are compared",
        "if _may_be_right(kind, first, n):",
        "if False:",
        "test_margins.py test_compare.py",
    ),
    "margin-crossing": Change(
        "statistics",
        "an interval that holds what is right counts as if it ended there",
        "(0.0 if (start + low) * (start + high) < 0 else min(ends))",
        "min(ends)",
        "test_margins.py test_compare.py",
    ),
    "bias-either": Change(
        "statistics",
        "bias is compared over trials in which either succeeds",
        "success[0] & success[1]",
        "success[0] | success[1]",
        "test_margins.py test_compare.py",
    ),
    "widened-by-second": Change(
        "statistics",
        "a ratio is widened in parts of the mean of the second",
        "if largest is None else largest) / means[0]",
        "if largest is None else largest) / means[1]",
        "test_paired.py",
    ),
    "unseen-few": Change(
        "statistics",
        "one differing trial in twenty is taken for having seen the others",
        "others >= min(RARE, trials / 2)",
        "others >= min(RARE, trials / 20)",
        "test_paired.py",
    ),
    "capped-least": Change(
        "statistics",
        "errors that the bound allows count as unusual beside smaller ones",
        "rare = unseen(squares, degrees, least=1 / degrees)",
        "rare = unseen(squares, degrees)",
        "test_intervals.py",
    ),
    "anytime-unseen": Change(
        "statistics",
        "the upper end of rmse at all times is given though larger errors may be unseen",
        "return low, _unless_unseen(s, high)",
        "return low, high",
        "test_sequences.py",
    ),
    "inflation-once": Change(
        "trials",
        "the test of fit takes the inflation of a prior for that of its variance",
        "(1 + inflation**2 * values) ** 2",
        "(1 + inflation * values) ** 2",
        "test_fit_test.py",
    ),
    "cosines-largest": Change(
        "trials",
        "of few readings the least oblique directions are left in the test of fit",
        "others[:, n - min(n, m - n) :]",
        "others[:, : min(n, m - n)]",
        "test_fit_test.py",
    ),
    "angles-unturned": Change(
        "trials",
        "residuals of angles are not within half a turn",
        "self.trials.z - self.problem.measurement.near(h, self.trials.z)",
        "self.trials.z - h",
        "test_scoring.py",
    ),
    "path-missing": Change(
        "states",
        "the fit of a path counts missing readings",
        "chdtrc(np.isfinite(z).sum(axis=(1, 2)), cost)",
        "chdtrc(np.ones(z.shape).sum(axis=(1, 2)), cost)",
        "test_paths.py",
    ),
    "restart-narrow": Change(
        "states",
        "restarts of lm_ieks have a fiftieth of the prior's deviations",
        "np.repeat(_SHARE**2 * P[None], len(z), 0)",
        "np.repeat(0.02**2 * P[None], len(z), 0)",
        "test_paths.py",
    ),
    "damping-unscaled": Change(
        "states",
        "damping of lm_ieks knows no unit of the states",
        "scale[rows] / damping[rows, None, None]",
        "np.ones_like(scale[rows]) / damping[rows, None, None]",
        "test_paths.py",
    ),
    "ekf-alone": Change(
        "states",
        "lm_ieks begins at the EKF alone",
        "for rule in (Taylor(), Unscented())",
        "for rule in (Taylor(), Taylor())",
        "test_paths.py",
    ),
    "path-worst-epoch": Change(
        "trials",
        "a path succeeds by its worst epoch",
        "finished & (normalised.mean(axis=1) <= gate(n))",
        "finished & (normalised.max(axis=1) <= gate(n))",
        "test_tracking.py",
    ),
    "posterior-error": Change(
        "trials",
        "the error of the posterior bound is that of one part in ten",
        ".std(axis=0, ddof=1)[at] / np.sqrt(_PARTS)",
        ".std(axis=0, ddof=1)[at]",
        "test_tracking.py",
    ),
    "periodic-state": Change(
        "states",
        "a periodic state is not followed next to its path",
        "if to is None or not periodic:",
        "if True:",
        "test_paths.py",
    ),
    "sigma-next": Change(
        "states",
        "sigma points of an angle lie about the first of them",
        "y = nearest(y, g(m)[..., None, :])",
        "y = nearest(y, y[..., :1, :])",
        "test_trackers.py",
    ),
    "far-below-each": Change(
        "real",
        "a log is far less likely at one per reading",
        "_FAR_BELOW + np.isfinite(best.nis).sum() / 10",
        "_FAR_BELOW + np.isfinite(best.nis).sum()",
        "test_verdicts.py",
    ),
    "deviance-shift": Change(
        "real",
        "minus twice the log likelihood is shifted",
        "return replace(minima, chi_square=value - shift)",
        "return replace(minima, chi_square=value)",
        "test_levels.py",
    ),
    "minima-twice": Change(
        "estimators",
        "a minimum that is found again counts as another",
        "if all(_apart(x, found.x[i], deviation[i]) for x in known):",
        "if True:",
        "test_minima.py",
    ),
    "restarts-free": Change(
        "estimators",
        "iterations of restarts are not counted",
        "spent[rows] += again.iterations",
        "spent[rows] += 0 * again.iterations",
        "test_minima.py",
    ),
    "no-end-kept": Change(
        "estimators",
        "a minimum does not replace a lower point that is none",
        "(~(self.chi_square >= old.chi_square) | ~old.converged)",
        "~(self.chi_square >= old.chi_square)",
        "test_minima.py",
    ),
    "report-in-search": Change(
        "estimators",
        "the slope of a report ends a trial where it raises",
        "replace(objective, model=objective.model.reporting()).subset(coarse)",
        "objective.subset(coarse)",
        "test_minima.py",
    ),
}
