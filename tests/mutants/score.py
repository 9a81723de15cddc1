"""How many random changes the tests notice, room by room: `make mutants SAMPLE=40` writes
outputs/mutants/score.md.

Cosmic Ray finds the places and makes the changes, one at a time, each in a copy of the project; the
tests of the room must then fail. Of the changes at one place one is drawn at random; annotations
are left out.
"""

from __future__ import annotations

import argparse
import ast
import os
import random
import shutil
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from cosmic_ray.commands.init import init
from cosmic_ray.mutating import mutate_and_test
from cosmic_ray.work_db import WorkDB, use_db
from cosmic_ray.work_item import MutationSpec, TestOutcome

ROOT = Path(__file__).resolve().parents[2]
TIMEOUT_S = 600.0
LEFT_OUT = (
    "RemoveDecorator",
    "ExceptionReplacer",
    "Variable",
    "_Eq_Is",
    "_Is_Eq",
    "_NotEq_IsNot",
    "_IsNot_NotEq",
)
"""Parts of the names of operators that make no change, none that a run survives, or none without
arguments."""

ROOMS = {
    "scoring": (
        ("trials/*.py", "estimators/base.py"),
        ("tests/trials", "tests/real/test_fit.py", "tests/statistics/test_theory.py"),
    ),
    "statistics": (("statistics/*.py",), ("tests/statistics", "tests/report/test_report.py")),
    "noise": (
        ("noise/*.py",),
        (
            "tests/noise",
            "tests/plugins/test_options.py",
            "tests/real/test_fit.py",
            "tests/trials/test_fit_test.py",
        ),
    ),
    "functions": (
        ("functions/*.py", "states/along.py", "states/redone.py", "states/lost.py"),
        ("tests/functions", "tests/states/test_along.py", "tests/states/test_lost.py"),
    ),
    "shown": (
        (
            *("report/figures/*.py", "report/tables/*.py", "report/finding.py"),
            *("questions/design/*.py", "questions/posterior/*.py", "states/mirrored.py"),
        ),
        (
            *("tests/report", "tests/questions/design", "tests/questions/posterior"),
            *("tests/states/test_mirrored.py", "tests/statistics/test_verdicts.py"),
        ),
    ),
    "filters": (
        tuple(f"baselines/{name}.py" for name in ("kalman", "epochs", "sequential", "information")),
        ("tests/baselines/test_filters.py",),
    ),
}
"""The modules of each room below the package, and the tests that must fail, quickest first."""


def places(patterns: tuple[str, ...]) -> Iterator[MutationSpec]:
    """Every change of the modules' code that a run could notice."""
    files = sorted(
        {
            path.relative_to(ROOT)
            for pattern in patterns
            for path in (ROOT / "ipe_bench").glob(pattern)
        }
    )
    with (
        tempfile.TemporaryDirectory() as folder,
        use_db(str(Path(folder) / "session"), WorkDB.Mode.create) as work,
    ):
        init(files, work, {})
        specs = [spec for item in work.work_items for spec in item.mutations]
    silent = {path: list(annotations(path)) for path in files}
    for spec in specs:
        within = any(first <= spec.start_pos <= last for first, last in silent[spec.module_path])
        if not within and not any(part in spec.operator_name for part in LEFT_OUT):
            yield spec


def annotations(path: Path) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    """Where the annotations of a module begin and end."""
    for node in ast.walk(ast.parse((ROOT / path).read_text(encoding="utf-8"))):
        inner = (
            node.returns if isinstance(node, ast.FunctionDef) else getattr(node, "annotation", None)
        )
        if inner is not None:
            yield (inner.lineno, inner.col_offset), (inner.end_lineno, inner.end_col_offset)


def sample(specs: list[MutationSpec], number: int | None, seed: int) -> list[MutationSpec]:
    """One change per place, and of those as many as wanted."""
    rng = random.Random(seed)
    at: dict[tuple[Path, tuple[int, int], str], list[MutationSpec]] = {}
    for spec in specs:
        at.setdefault(
            (spec.module_path, spec.start_pos, spec.operator_name.partition("_")[0]), []
        ).append(spec)
    single = [rng.choice(of_one_place) for of_one_place in at.values()]
    return single if number is None else rng.sample(single, min(number, len(single)))


def tried(tests: tuple[str, ...], specs: list[MutationSpec]) -> list[tuple[bool, str]]:
    """Whether each change was noticed, and the change, in a copy of the project."""
    ignored = shutil.ignore_patterns(
        ".venv", ".git", "outputs", ".pytest_cache", ".hypothesis", ".ruff_cache"
    )
    command = (
        f"{sys.executable} -m pytest -x -q -p no:cacheprovider -p no:randomly {' '.join(tests)}"
    )
    found = []
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(shutil.copytree(ROOT, Path(folder) / "copy", ignore=ignored))
        for spec in specs:
            result = mutate_and_test([spec], command, TIMEOUT_S)
            found.append(
                (result.test_outcome != TestOutcome.SURVIVED, f"{spec.module_path}\n{result.diff}")
            )
        os.chdir(ROOT)
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("rooms", nargs="*", choices=[*ROOMS, []], help="all where none is named")
    parser.add_argument(
        "--sample", type=int, help="changes per room, drawn at random; all where it is not given"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument(
        "--at-least", type=float, default=0.9, help="share to be noticed in each room"
    )
    parser.add_argument("--output", type=Path, default=ROOT / "outputs" / "mutants")
    given = parser.parse_args()
    table, survived, least = (
        ["| room | changes | noticed | share |", "| --- | --- | --- | --- |"],
        [],
        1.0,
    )
    for name in given.rooms or ROOMS:
        patterns, tests = ROOMS[name]
        chosen = sample(list(places(patterns)), given.sample, given.seed)
        parts = [chosen[i :: given.workers] for i in range(given.workers)]
        with ProcessPoolExecutor(given.workers) as pool:
            outcomes = [
                one for part in pool.map(tried, [tests] * len(parts), parts) for one in part
            ]
        noticed = sum(was for was, _ in outcomes)
        share = noticed / len(outcomes) if outcomes else 1.0
        least = min(least, share)
        table.append(f"| {name} | {len(outcomes)} | {noticed} | {share:.1%} |")
        survived += [f"```diff\n{change}\n```" for was, change in outcomes if not was]
    given.output.mkdir(parents=True, exist_ok=True)
    text = "\n".join([*table, "", "## Not noticed", "", *survived])
    (given.output / "score.md").write_text(text + "\n", encoding="utf-8")
    print(text)
    return 0 if least >= given.at_least else 1


if __name__ == "__main__":
    sys.exit(main())
