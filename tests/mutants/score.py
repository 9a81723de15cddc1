"""How many changes on purpose the tests notice, room by room: `make mutants` writes outputs/mutants/score.md.

Cosmic Ray finds the places and makes the changes, one at a time, each in a copy of the project; the tests of the room
must then fail. Left out are places that no run reaches: annotations, and what is imported for type checkers alone.
A place that many operators could change is changed by one of them, drawn at random.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import shutil
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

from cosmic_ray.commands.init import init
from cosmic_ray.mutating import mutate_and_test
from cosmic_ray.work_db import WorkDB, use_db
from cosmic_ray.work_item import MutationSpec, TestOutcome

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = Path("ipe_bench")
TIMEOUT_S = 600.0
LEFT_OUT = ("RemoveDecorator", "ExceptionReplacer", "Variable", "_Eq_Is", "_Is_Eq", "_NotEq_IsNot", "_IsNot_NotEq")
"""Parts of the names of operators that make no change, none that a run survives, or none without arguments."""


@dataclass(frozen=True)
class Room:
    modules: tuple[str, ...]
    """Patterns below the package."""
    tests: tuple[str, ...]
    """What must fail, quickest first."""

    def files(self) -> list[Path]:
        return sorted({path for pattern in self.modules for path in (ROOT / PACKAGE).glob(pattern)})


ROOMS = {
    "scoring": Room(
        ("trials/*.py", "estimators/base.py"),
        ("tests/test_fit.py", "tests/statistics/test_theory.py", "tests/test_scenario.py", "tests/montecarlo"),
    ),
    "statistics": Room(("statistics/*.py",), ("tests/statistics", "tests/report/test_report.py")),
    "noise": Room(
        ("noise/*.py",),
        ("tests/noise", "tests/plugins/test_options.py", "tests/test_fit.py", "tests/montecarlo/test_fit_test.py"),
    ),
    "filters": Room(
        tuple(
            f"baselines/{name}.py"
            for name in ("ekf", "ukf", "ckf", "enkf", "ensemble", "epochs", "sequential", "batched", "information")
        ),
        (
            "tests/baselines/test_filterpy_traps.py",
            "tests/baselines/test_batched_engine.py",
            "tests/baselines/test_filters.py",
        ),
    ),
}


@dataclass(frozen=True)
class Mutant:
    """One change and what came of it."""

    room: str
    module: str
    line: int
    function: str
    change: str
    outcome: str
    diff: str


def main() -> int:
    arguments = _arguments()
    rooms = {name: ROOMS[name] for name in arguments.rooms or ROOMS}
    mutants: list[Mutant] = []
    for name, room in rooms.items():
        chosen = sample(list(places(room)), arguments.sample, arguments.seed)
        print(f"{name}: {len(chosen)} changes", flush=True)
        with tempfile.TemporaryDirectory() as copies:
            folders = [_copy(Path(copies) / str(i)) for i in range(arguments.workers)]
            parts = [chosen[i :: arguments.workers] for i in range(arguments.workers)]
            with ProcessPoolExecutor(arguments.workers) as pool:
                for found in pool.map(_try_all, [name] * len(parts), folders, parts):
                    mutants += found
    write(mutants, Path(arguments.output))
    return 0 if all(score(mutants, name) >= arguments.at_least for name in rooms) else 1


def places(room: Room) -> Iterator[MutationSpec]:
    """Every change of the room's code that a run could notice."""
    with tempfile.TemporaryDirectory() as folder, use_db(str(Path(folder) / "session"), WorkDB.Mode.create) as work:
        init([path.relative_to(ROOT) for path in room.files()], work, {})
        specs = [spec for item in work.work_items for spec in item.mutations]
    silent = {path.relative_to(ROOT): _silent_lines(path) for path in room.files()}
    for spec in specs:
        within = any(first <= spec.start_pos <= last for first, last in silent[spec.module_path])
        if not within and not any(part in spec.operator_name for part in LEFT_OUT):
            yield spec


def _silent_lines(path: Path) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Spans of annotations and of imports for type checkers."""
    spans = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        inner: list[ast.expr | ast.stmt | None] = []
        if isinstance(node, ast.arg | ast.AnnAssign):
            inner = [node.annotation]
        elif isinstance(node, ast.FunctionDef):
            inner = [node.returns]
        elif isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            inner = [node]
        spans += [_span(part) for part in inner if part is not None]
    return spans


def _span(node: ast.expr | ast.stmt) -> tuple[tuple[int, int], tuple[int, int]]:
    last = node.end_lineno or node.lineno, node.end_col_offset or node.col_offset
    return (node.lineno, node.col_offset), last


def sample(specs: list[MutationSpec], number: int | None, seed: int) -> list[MutationSpec]:
    """One change per place, and of those as many as wanted."""
    rng = random.Random(seed)
    at: dict[tuple[Path, tuple[int, int], str], list[MutationSpec]] = {}
    for spec in specs:
        family = spec.operator_name.partition("_")[0]
        at.setdefault((spec.module_path, spec.start_pos, family), []).append(spec)
    single = [rng.choice(of_one_place) for of_one_place in at.values()]
    return single if number is None else rng.sample(single, min(number, len(single)))


def _copy(folder: Path) -> Path:
    ignored = shutil.ignore_patterns(".venv", ".git", "outputs", ".pytest_cache", ".hypothesis", ".ruff_cache")
    return Path(shutil.copytree(ROOT, folder, ignore=ignored))


def _try_all(room: str, folder: Path, specs: list[MutationSpec]) -> list[Mutant]:
    os.chdir(folder)
    return [_try(room, spec) for spec in specs]


def _try(room: str, spec: MutationSpec) -> Mutant:
    tests = " ".join(ROOMS[room].tests)
    command = f"{sys.executable} -m pytest -x -q -p no:cacheprovider -p no:randomly {tests}"
    result = mutate_and_test([spec], command, TIMEOUT_S)
    outcome = "survived" if result.test_outcome == TestOutcome.SURVIVED else "noticed"
    change = "\n".join(
        line for line in (result.diff or "").splitlines() if line[:1] in "+-" and line[:3] not in ("+++", "---")
    )
    name = spec.operator_name.rpartition("/")[2]
    mutant = Mutant(room, str(spec.module_path), spec.start_pos[0], spec.definition_name or "", name, outcome, change)
    print(f"{mutant.outcome}: {mutant.module}:{mutant.line} {mutant.change}", flush=True)
    return mutant


def score(mutants: list[Mutant], room: str) -> float:
    outcomes = [mutant.outcome for mutant in mutants if mutant.room == room]
    return outcomes.count("noticed") / len(outcomes) if outcomes else 1.0


def write(mutants: list[Mutant], folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "mutants.json").write_text(json.dumps([asdict(m) for m in mutants], indent=1), encoding="utf-8")
    lines = ["| room | changes | noticed | share |", "| --- | --- | --- | --- |"]
    for room in dict.fromkeys(m.room for m in mutants):
        outcomes = [m.outcome for m in mutants if m.room == room]
        lines.append(f"| {room} | {len(outcomes)} | {outcomes.count('noticed')} | {score(mutants, room):.1%} |")
    lines += ["", "## Not noticed", ""]
    for m in mutants:
        if m.outcome == "survived":
            lines += [f"{m.module}:{m.line} in `{m.function}`, {m.change}", "", "```diff", m.diff, "```", ""]
    (folder / "score.md").write_text("\n".join(lines), encoding="utf-8")
    print("\n".join(lines))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("rooms", nargs="*", choices=[*ROOMS, []], help="all where none is named")
    parser.add_argument("--sample", type=int, help="changes per room, drawn at random; all where it is not given")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--at-least", type=float, default=0.9, help="share to be noticed in each room")
    parser.add_argument("--output", default=str(ROOT / "outputs" / "mutants"))
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
