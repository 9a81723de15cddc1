"""Whether the quick tests notice the changes of `changes.py`: `make mutants` writes
outputs/mutants/notice.md.

Each is made in a copy of the package that stands in front of it, one at a time; the tests that are
named must fail.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from changes import CHANGES, PACKAGE, TESTS, Change, changed, places

ROOT = TESTS.parent
TIMEOUT_S = 900.0
FAILED = 1
"""The exit code of pytest if a test failed; others say that the tests did not run."""


def failing(files: Iterable[Path], change: Change | None) -> str:
    """What pytest says of the files if a test fails with a change, or without one; empty if all
    pass.

    Raises:
        RuntimeError: they could not be run.
    """
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / PACKAGE.name
        shutil.copytree(PACKAGE, copy)
        for beside in ("conf", "plugins"):
            (Path(folder) / beside).symlink_to(ROOT / beside)
        if change is not None:
            ((path, _),) = places(change)
            text = changed(path.read_text(encoding="utf-8"), change)
            (copy / path.relative_to(PACKAGE)).write_text(text, encoding="utf-8")
        # `-P`: what runs must not find the package in the working folder.
        command = [
            sys.executable,
            "-P",
            "-m",
            "pytest",
            "-x",
            "-q",
            "-p",
            "no:cacheprovider",
            *map(str, files),
        ]
        environment = {**os.environ, "PYTHONPATH": folder}
        try:
            ended = subprocess.run(
                command,
                cwd=ROOT,
                env=environment,
                capture_output=True,
                text=True,
                timeout=change and TIMEOUT_S,
            )
        except subprocess.TimeoutExpired:
            return f"the tests took more than {TIMEOUT_S:g} s"
    said = f"{ended.stdout[-2000:]}{ended.stderr[-2000:]}"
    if ended.returncode not in (0, FAILED):
        raise RuntimeError(said)
    return said if ended.returncode == FAILED else ""


def timed(change: Change) -> tuple[bool, float]:
    """Whether a change is noticed, and the seconds that took."""
    began = time.perf_counter()
    return bool(failing(change.files, change)), time.perf_counter() - began


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="CHANGE", help="all where none is named")
    parser.add_argument("--rooms", nargs="*", help="changes of these rooms alone")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--output", type=Path, default=ROOT / "outputs" / "mutants")
    given = parser.parse_args()
    chosen = {name: CHANGES[name] for name in given.names or CHANGES}
    if given.rooms:
        chosen = {name: change for name, change in chosen.items() if change.room in given.rooms}
    # A test that fails anyhow notices nothing.
    if said := failing(
        dict.fromkeys(path for change in chosen.values() for path in change.files), None
    ):
        print(said)
        return 2
    table = [
        "| change | room | what becomes wrong | noticed | s |",
        "| --- | --- | --- | --- | --: |",
    ]
    count, unexpected = 0, []
    with ThreadPoolExecutor(given.workers) as pool:
        for (name, change), (was, seconds) in zip(
            chosen.items(), pool.map(timed, chosen.values()), strict=True
        ):
            said = "yes" if was else f"no: {change.survives or 'and nobody knows why'}"
            table.append(f"| {name} | {change.room} | {change.does} | {said} | {seconds:.0f} |")
            print(table[-1], flush=True)
            count += was
            if was == bool(change.survives):
                unexpected.append(name)
    table += ["", f"{count} of {len(chosen)} are noticed."]
    given.output.mkdir(parents=True, exist_ok=True)
    (given.output / "notice.md").write_text("\n".join(table) + "\n", encoding="utf-8")
    print(table[-1], f"Not as written in changes.py: {', '.join(unexpected) or 'none'}.")
    return int(bool(unexpected))


if __name__ == "__main__":
    sys.exit(main())
