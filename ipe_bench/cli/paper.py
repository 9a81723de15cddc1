"""`ipe-bench report DIR... paper=NAME,NAME`: tables and figures as a paper wants them."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from ipe_bench.basics.errors import UserError
from ipe_bench.cli import console, given_keys
from ipe_bench.runs.results import require_results

KEYS = ("paper", "columns", "width", "output")
FOLDER = "paper"
"""Where files go in the first folder of results."""


def asked_for(words: Sequence[str]) -> bool:
    """Whether a report is to be one for a paper."""
    return any(word.partition("=")[0] in ("paper", "columns", "width") for word in words)


def main(arguments: Sequence[str]) -> int:
    """Writes the files and prints their names; exit code 1 where a table is too wide, or data are missing."""
    folders = [word for word in arguments if "=" not in word or Path(word).is_dir()]
    keys = given_keys("report", [word for word in arguments if word not in folders], KEYS)
    if not folders:
        raise UserError("report: name at least one directory of results, such as outputs/paper")
    names = _listed(keys.get("paper", ""))
    if not names:
        raise UserError("paper=: name tables and figures, such as paper=overview,success_against_scale")
    require_results(folders)
    from ipe_bench.plugins.extensions import use_statistics
    from ipe_bench.report.paper import export
    from ipe_bench.statistics import analyse

    faults = use_statistics()
    analysis = analyse(folders)
    analysis.collection.further += faults
    output = Path(keys["output"]) if "output" in keys else Path(folders[0]) / FOLDER
    done = export(analysis, output, names, _listed(keys.get("columns", "")), **_width(keys))
    for path in done.files:
        console().print(str(path), markup=False, soft_wrap=True)
    for line in (*analysis.problems, *analysis.stale, *done.too_wide):
        print(f"ipe-bench: {line}", file=sys.stderr)
    return 1 if analysis.problems or done.too_wide else 0


def _listed(value: str) -> list[str]:
    return [name for name in (part.strip() for part in value.strip("[]").split(",")) if name]


def _width(keys: dict[str, str]) -> dict[str, float]:
    if "width" not in keys:
        return {}
    try:
        return {"width": float(keys["width"].removesuffix("in"))}
    except ValueError:
        raise UserError(f"width={keys['width']}: give inches, such as 3.5 or 7.16") from None
