"""Writes a workflow that compares the estimators in plugins/ with those of a base."""

from __future__ import annotations

from pathlib import Path

import ipe_bench as ib
from ipe_bench.basics.errors import UserError
from ipe_bench.plugins import discovery as plugins
from ipe_bench.workshop.new import fill, require_absent


def write_ci() -> str:
    """Writes a workflow that compares the estimators in plugins/ with those of a base, and its
    trials.

    Returns what to try next.
    """
    place = Path("plugins").resolve()
    options = [o for o in plugins.options() if place in o.path.resolve().parents]
    ours = {}
    for group in ("solver", "baseline"):
        ours[group] = ", ".join(option.name for option in options if option.group == group)
    if not any(ours.values()):
        raise UserError(
            "new ci: plugins/ has no estimator to guard; write one, such as `ipe-bench new"
            " baseline my_fit`"
        )
    texts = {".github/workflows/estimator.yml": "ci.yml", "ci/experiment/guard.yaml": "ci.yaml"}
    for target in texts:
        require_absent(Path(target))
    for target, source in texts.items():
        fill(Path(target), source, {"version": ib.__version__, **ours})
    return (
        f"{' and '.join(texts)} are ready. Try:\n  ipe-bench run --config-dir ci +experiment=guard"
        " figures=none"
    )
