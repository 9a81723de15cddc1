"""How large each room and plugin is, as the table that `make lint` prints: for a maintainer to read, and no test.

Lines of Python are counted, without tests. Beside the sums stand their ceilings.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CEILINGS = {"ipe_bench": 31_900, "ipe_bench and plugins": 34_700, "tests": 20_500}


def lines(files: Iterable[Path]) -> int:
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in files)


def python_files(folder: Path, *, tests: bool) -> list[Path]:
    files = (path for path in folder.rglob("*.py") if ".venv" not in path.parts)
    return [path for path in files if ("tests" in path.relative_to(ROOT).parts) is tests]


def main() -> None:
    package = ROOT / "ipe_bench"
    for room in sorted(path for path in package.iterdir() if path.is_dir() and any(path.rglob("*.py"))):
        files = python_files(room, tests=False)
        print(f"{lines(files):8,}  {room.name} ({len(files)} files)")
    for plugin in sorted({path.parent for path in (ROOT / "plugins").rglob("pyproject.toml")}):
        print(f"{lines(python_files(plugin, tests=False)):8,}  {plugin.relative_to(ROOT)}")
    plugins = ROOT / "plugins"
    core = python_files(package, tests=False)
    sums = {
        "ipe_bench": lines(core),
        "ipe_bench and plugins": lines(core) + lines(python_files(plugins, tests=False)),
        "tests": lines([*python_files(ROOT / "tests", tests=True), *python_files(plugins, tests=True)]),
    }
    for name, size in sums.items():
        print(f"{size:8,}  {name}, of at most {CEILINGS[name]:,}" + (" (over)" if size > CEILINGS[name] else ""))
    source = "".join(path.read_text(encoding="utf-8") for path in core)
    print(f"{source.count('type: ignore'):8,}  times `type: ignore`")
    print(f"{len(re.findall(r'= property[(](lambda|attrgetter)', source)):8,}  properties that are lambdas")


if __name__ == "__main__":
    main()
