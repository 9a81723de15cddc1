"""Posteriors of a few trials beside the estimators' Gaussians, as a table in the terminal and as files."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ipe_bench.basics.files import write_atomically
from ipe_bench.basics.statuses import Status
from ipe_bench.measurements.base import Measurement
from ipe_bench.report.examined import numbers
from ipe_bench.report.words import compact, percent
from ipe_bench.trials.posterior import Divergence, Posterior, Reference

if TYPE_CHECKING:
    from rich.console import Group

SCHEMA = 1
RESULT = "posterior.json"
HONEST = 0.1
"""Nats below which a Gaussian may stand for another: a deviation 40 % too large in one direction, or a mean that is
half a deviation off, are about a tenth."""
ALIKE = 0.05
"""The energy distance up to which draws may come from one law: of Gaussians in few dimensions, some tenths of a nat."""


def write_posteriors(
    folder: Path, model: Measurement, found: Sequence[Reference], command: Any, provenance: Mapping[str, Any]
) -> list[Path]:
    """Writes posterior.json and a corner picture of each trial; returns the files."""
    from ipe_bench.report.figures.corner import draw_corners

    result = folder / RESULT
    trials = [_described(model, one) for one in found]
    text = json.dumps({"schema": SCHEMA, "command": command, "trials": trials, **provenance}, indent=1)
    write_atomically(result, lambda path: path.write_text(text + "\n", encoding="utf-8"))
    files = [result]
    for drawing in draw_corners(model, found):
        files += drawing.save(folder)
    return files


def _described(model: Measurement, one: Reference) -> dict[str, Any]:
    names, sizes, sampled = [p.name for p in model.parameters], model.sizes, one.posterior
    return {
        "trial": one.trial,
        "parameters": [{"name": p.name, "unit": p.unit} for p in model.parameters],
        "truth": dict(zip(names, numbers(one.truth * sizes), strict=True)),
        "mean": dict(zip(names, numbers(sampled.mean * sizes), strict=True)),
        "deviation": dict(zip(names, numbers(sampled.deviation * sizes), strict=True)),
        "covariance": numbers(sampled.covariance * np.outer(sizes, sizes)),
        "modes": [
            {"share": numbers(share), "x": numbers(mode * sizes)}
            for mode, share in zip(sampled.modes, sampled.shares, strict=True)
        ],
        "settled": sampled.settled,
        "populations_apart": numbers(sampled.apart),
        "noise": numbers(sampled.noise),
        "evidence": numbers(sampled.evidence),
        "draws": len(sampled.x),
        "stages": sampled.stages,
        "simulations": sampled.simulations,
        "estimators": {
            label: {
                "status": Status(int(one.estimates[label].status[0])).label,
                "kl": numbers(d.kl),
                "shift": numbers(d.shift),
                "width": numbers(d.width),
                "energy": numbers(d.energy),
            }
            for label, d in one.divergences.items()
        },
    }


def render(name: str, found: Sequence[Reference]) -> Group:
    """A row per trial and estimator; `name` is what the scenario is called in the title."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False, collapse_padding=True)
    for heading in ("trial", "modes", "noise", "estimator", "status"):
        words = heading in ("estimator", "status")
        table.add_column(heading, justify="left" if words else "right", overflow="fold", no_wrap=not words)
    for heading in ("diverg.", "shift", "width", "energy", "honest"):
        table.add_column(heading, justify="left" if heading == "honest" else "right", no_wrap=True)
    for one in found:
        for i, (label, d) in enumerate(one.divergences.items()):
            sampled = one.posterior
            head = [str(one.trial), str(len(sampled.modes)), compact(sampled.noise)] if i == 0 else ["", "", ""]
            status = Status(int(one.estimates[label].status[0])).label
            figures = [compact(value) for value in (d.kl, d.shift, d.width, d.energy)]
            table.add_row(*head, *(Text(cell) for cell in (label, status, *figures, honesty(d, sampled))))
    lines = [
        "diverg.: divergence of the estimator's Gaussian from the posterior's moments, in nats; noise: the same of two"
        " populations of particles, so what is not above it is chance. shift: of the mean, in the posterior's"
        " deviations per root of the number of parameters. width: deviations over the posterior's, geometric mean."
        f" energy: distance of draws. honest: a single mode, divergence at most {HONEST:g} or twice the noise, and"
        f" energy at most {ALIKE:g}.",
        *(_unsettled(one) for one in found if not one.posterior.settled),
        *(_modes(one) for one in found if len(one.posterior.modes) > 1),
    ]
    return Group(
        Text(f"{name}: estimators beside the posterior", style="bold"), table, Text("\n".join(lines), style="dim")
    )


def honesty(d: Divergence, sampled: Posterior) -> str:
    """Whether a Gaussian can be taken for the posterior; a wide one over two modes has the moments and is not."""
    if not np.isfinite(d.kl):
        return "-"
    near = d.kl <= max(HONEST, 2 * sampled.noise) and d.energy <= ALIKE
    return "yes" if near and len(sampled.modes) == 1 else "NO"


def _unsettled(one: Reference) -> str:
    return (
        f"Trial {one.trial}: the populations differ by {one.posterior.apart:.2g} deviations, so its posterior is not to"
        " be believed; give more --particles."
    )


def _modes(one: Reference) -> str:
    shares = ", ".join(percent(float(share)) for share in one.posterior.shares)
    return f"Trial {one.trial}: {len(one.posterior.modes)} modes, with {shares} of the draws."
