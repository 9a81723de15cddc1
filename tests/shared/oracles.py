"""Numbers held against sources that nobody here wrote: the mark `oracle`, how closely they agreed,
and the page of it.

`make oracles` records what was seen in tests/oracles.json, of which `make docs` writes the tables
of reference/checked.md.
"""

from __future__ import annotations

import ast
import json
import os
import re
import sys
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

ROOT = Path(__file__).resolve().parents[2]
RECORD = ROOT / "tests" / "oracles.json"
PAGE = ROOT / "ipe_bench" / "report" / "docs" / "pages" / "reference" / "checked.md"
KINDS = ("certified", "published", "library", "closed form", "own second implementation")
"""Kinds of sources; the source of a mark begins with one."""
SUBJECTS = {
    "tests/measurements": "Measurement models and integrators",
    "tests/noise": "Noises and the test of fit",
    "tests/trials/test_fit_test.py": "Noises and the test of fit",
    "tests/solvers": "Solvers and baseline estimators",
    "tests/baselines": "Solvers and baseline estimators",
    "tests/estimators": "Solvers and baseline estimators",
    "tests/states": "Filters and smoothers of states that move",
    "tests/trials": "Bounds, bias, curvature and posteriors",
    "tests/statistics": "Statistics",
    "tests/real": "Estimates from a file",
    "tests": "The rest of the package",
    "plugins": "Plugins",
}
"""Headings of the page by the beginning of a test's path; the first that fits is its own."""
HERE = (
    "`make docs` shows the rows of [oracles.json](../../../../../tests/oracles.json) here; an"
    " anchor is the name of a test.\n"
)
"""The line of the page that its tables replace."""


@dataclass(frozen=True)
class Oracle:
    """What the mark of a test says: its source, what is compared, and the loosest tolerance of the
    comparison."""

    source: str
    what: str
    tolerance: float

    def __post_init__(self) -> None:
        kind = self.source.partition(":")[0]
        if kind not in KINDS:
            raise ValueError(
                f"source={self.source!r} begins with none of {', '.join(KINDS)} and a colon"
            )


@dataclass(frozen=True)
class Row(Oracle):
    """A row of the page: a mark with the name of its test, and with the largest difference that was
    seen."""

    test: str
    relative: bool
    agreed: str


@dataclass(frozen=True)
class Held:
    """One comparison: the largest difference seen in it, the tolerance, and whether both are
    relative."""

    difference: float
    tolerance: float
    relative: bool = False


_held: list[Held] = []


def agreed(difference: ArrayLike, tolerance: float) -> None:
    """Asserts that no difference exceeds the tolerance, and records the largest."""
    largest = float(np.max(difference))
    assert largest <= tolerance, f"differs by {largest:.3g}, of at most {tolerance:g}"
    _held.append(Held(largest, tolerance))


def assert_agrees(actual: Any, desired: Any, rtol: float = 0.0, atol: float = 0.0) -> None:
    """Asserts what NumPy's assert_allclose does with these tolerances, and records the largest
    difference.

    The difference is relative to the desired value, and to `atol / rtol` beside it; it is absolute
    if `rtol` is 0.
    """
    np.testing.assert_allclose(actual, desired, rtol=rtol, atol=atol)
    found, right = np.broadcast_arrays(np.asarray(actual), np.asarray(desired))
    finite = np.isfinite(found) & np.isfinite(right)
    gaps = np.abs(found[finite] - right[finite])
    if rtol:
        sizes = np.abs(right[finite]) + atol / rtol
        gaps = gaps / np.where(sizes > 0, sizes, 1.0)  # where the size is 0, so is the gap
    _held.append(Held(float(np.max(gaps, initial=0.0)), rtol or atol, bool(rtol)))


def join(config: Any) -> None:
    """Lets pytest call what stands below, for the tests of plugins too where those of the package
    are named."""
    if not config.pluginmanager.has_plugin(__name__):
        config.pluginmanager.register(sys.modules[__name__], __name__)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: Any) -> Iterator[None]:
    """Hands on how closely a marked test agreed, and fails one that compares at a looser tolerance
    than is marked."""
    _held.clear()
    yield
    mark = item.get_closest_marker("oracle")
    if mark and _held:  # a case of which the oracle has no answer holds nothing against it
        oracle = Oracle(*mark.args)
        asked = max(one.tolerance for one in _held)
        assert asked <= oracle.tolerance, (
            f"{asked:g} is looser than {oracle.tolerance:g}, which is marked"
        )
        seen = (max(one.difference for one in _held), asked, all(one.relative for one in _held))
        item.user_properties.append(("oracle", seen))


_seen: dict[str, list[Held]] = {}


def pytest_runtest_logreport(report: Any) -> None:
    if report.when == "call" and report.passed:
        name = re.sub(r"\[.*", "", report.nodeid)
        for seen in (seen for key, seen in report.user_properties if key == "oracle"):
            _seen.setdefault(name, []).append(Held(*seen))


def pytest_sessionfinish(session: Any) -> None:
    if os.environ.get("RECORD_ORACLES") and not hasattr(session.config, "workerinput"):
        record()


def record() -> None:
    """Writes what this run has seen; the rows of tests that did not run stay, and those without a
    mark go."""
    known, marks = {anchor(row.test): row for row in rows()}, marked()
    for test in marks.keys() & _seen.keys():
        seen, asked = _seen[test], max(one.tolerance for one in _seen[test])
        if asked != marks[test].tolerance:
            print(
                f"\n{test}: not recorded, as its loosest tolerance was {asked:g}, not"
                f" {marks[test].tolerance:g}"
            )
            continue
        largest = one_digit(max(one.difference for one in seen))
        relative = all(one.relative for one in seen)
        known[anchor(test)] = Row(
            **asdict(marks[test]), test=test, relative=relative, agreed=largest
        )
    kept = [
        replace(known[anchor(test)], test=test) for test in marks if anchor(test) in known
    ]  # its file may have moved
    RECORD.write_text(
        json.dumps([asdict(row) for row in kept], indent=1, ensure_ascii=False) + "\n",
        encoding="utf-8",
    )


def rows() -> list[Row]:
    """Returns the rows that are recorded."""
    return [Row(**row) for row in json.loads(RECORD.read_text(encoding="utf-8"))]


def marked() -> dict[str, Oracle]:
    """Returns the mark of each marked test by its name, as it is written in the files of tests."""
    found = {}
    for path in sorted(
        [*ROOT.glob("tests/**/test_*.py"), *ROOT.glob("plugins/**/tests/test_*.py")]
    ):
        text = path.read_text(encoding="utf-8")
        functions = ast.parse(text).body if "mark.oracle(" in text else []
        for function in (one for one in functions if isinstance(one, ast.FunctionDef)):
            calls = [
                one
                for one in function.decorator_list
                if ast.unparse(one).startswith("pytest.mark.oracle(")
            ]
            for call in (one for one in calls if isinstance(one, ast.Call)):
                test = f"{path.relative_to(ROOT).as_posix()}::{function.name}"
                found[test] = Oracle(*map(ast.literal_eval, call.args))
    return found


def short(number: float) -> str:
    return f"{number:g}".replace("e-0", "e-")


def one_digit(number: float) -> str:
    return short(float(f"{number:.0e}"))


def sentence(test: str) -> str:
    """Returns what the name of a test says."""
    words = test.partition("::test_")[2].replace("_", " ")
    for name in (
        "SciPy",
        "NIST",
        "GINS",
        "EKF",
        "UKF",
        "Radau",
        "Stone Soup",
        "MINPACK",
        "Box",
        "Kalman",
        "NEES",
    ):
        words = re.sub(
            rf"\b{name}(s?)\b",
            lambda m, n=name: n + ("'s" if m[1] else ""),
            words,
            flags=re.IGNORECASE,
        )
    return words[0].upper() + words[1:]


def anchor(test: str) -> str:
    return test.partition("::test_")[2].replace("_", "-").lower()


def tables(recorded: Iterable[Row]) -> str:
    """Returns the tables of the page, one for each subject, in Markdown."""
    by_subject: dict[str, list[str]] = {subject: [] for subject in SUBJECTS.values()}
    for row in recorded:
        subject = next(
            subject for start, subject in SUBJECTS.items() if row.test.startswith(f"{start}")
        )
        claim = f'<a id="{anchor(row.test)}"></a>{sentence(row.test)}'
        measure = " relative" if row.relative else ""
        where = f"`{row.test.partition('::')[0]}`"
        cells = (claim, row.source, row.what, short(row.tolerance) + measure, row.agreed, where)
        by_subject[subject].append(
            "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n"
        )
    head = (
        "| claim | source | compared | tolerance | agreed to | test |\n|---|---|---|--:|--:|---|\n"
    )
    return "".join(
        f"\n## {name}\n\n{head}{''.join(lines)}\n" for name, lines in by_subject.items() if lines
    )


def with_tables(page: str) -> str:
    """Returns the page with the tables of what is recorded."""
    before, after = page.split(HERE)
    return f"{before}{tables(rows())}{after}"
