"""Posteriors of a few trials beside the estimators' Gaussians: a table, and files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ipe_bench.basics.statuses import Status
from ipe_bench.measurements.base import Measurement
from ipe_bench.report.table import Table, texts, words
from ipe_bench.report.words import compact, percent
from ipe_bench.report.writer import named, picked, plain, write
from ipe_bench.trials.posterior import Divergence, Posterior, Reference

NAME, SCHEMA = "posterior", 1
HONEST = 0.1
"""Nats below which a Gaussian may stand for another: a deviation 40 % too large in one direction, or a mean that is
half a deviation off, are about a tenth."""
ALIKE = 0.05
"""Energy distance up to which draws may come from one law: of Gaussians in few dimensions, some tenths of a nat."""


def contents(name: str, found: Sequence[Reference]) -> list[Table]:
    """A row per trial and estimator; `name` is what the scenario is called in the title."""
    rows = [(one, label, d) for one in found for label, d in one.divergences.items()]
    columns = [
        texts("trial", [str(one.trial) for one, *_ in rows]),
        texts("modes", [str(len(one.posterior.modes)) for one, *_ in rows]),
        texts("noise", [compact(one.posterior.noise) for one, *_ in rows]),
        words("estimator", [label for _, label, _ in rows]),
        words("status", [_status(one, label) for one, label, _ in rows]),
        words("honest", [honesty(d, one.posterior) for one, _, d in rows]),
    ]
    numbers = {"kl": "diverg.", "shift": "shift", "width": "width", "energy": "energy"}
    columns += [texts(title, [compact(getattr(d, key)) for *_, d in rows]) for key, title in numbers.items()]
    title = f"{name}: estimators beside the posterior"
    return [Table("posterior", title, "", columns, notes=list(_notes(found)), grouped=3)]


def _status(one: Reference, label: str) -> str:
    return Status(int(one.estimates[label].status[0])).label


def _notes(found: Sequence[Reference]) -> Iterator[str]:
    yield (
        "diverg. is the divergence of the estimator's Gaussian from the moments of the posterior, in nats; noise is"
        " the same between two populations of particles, so a divergence below it is chance. shift is that of the"
        " mean, in standard deviations of the posterior per root of the number of parameters. width is the geometric"
        " mean of the standard deviations over those of the posterior."
        " energy is the distance between draws. An estimate is honest if there is a single mode, the divergence is at"
        f" most {HONEST:g} or twice the noise, and the energy is at most {ALIKE:g}."
    )
    for one in found:
        if not one.posterior.settled:
            yield (
                f"Trial {one.trial}: the populations differ by {one.posterior.apart:.2g} deviations, so its posterior"
                " cannot be relied on; give more --particles."
            )
        if len(one.posterior.modes) > 1:
            shares = ", ".join(percent(float(share)) for share in one.posterior.shares)
            yield f"Trial {one.trial}: {len(one.posterior.modes)} modes, with {shares} of the draws."


def honesty(d: Divergence, sampled: Posterior) -> str:
    """Whether a Gaussian can be taken for the posterior; a wide one over two modes has the moments and is not."""
    if not np.isfinite(d.kl):
        return "-"
    near = d.kl <= max(HONEST, 2 * sampled.noise) and d.energy <= ALIKE
    return "yes" if near and len(sampled.modes) == 1 else "NO"


def write_posteriors(
    folder: Path, name: str, scenario: str, model: Measurement, found: Sequence[Reference], command: Any
) -> list[Path]:
    """Writes posteriors with a corner picture of each trial, and returns the files; `name` is the model's and
    `scenario` says what was sampled."""
    from ipe_bench.report.figures.readings import draw_corner

    trials = [_described(model, one) for one in found]
    content = {"schema": SCHEMA, "command": command, "trials": trials, "measurement": name}
    title, parts = f"{name}: posteriors", contents(scenario, found)
    return write(folder, NAME, title, parts, content=content, drawings=(draw_corner(model, one) for one in found))


def _described(model: Measurement, one: Reference) -> dict[str, Any]:
    names, sizes, sampled = [p.name for p in model.parameters], model.sizes, one.posterior
    modes = zip(sampled.modes, sampled.shares, strict=True)
    return {
        "trial": one.trial,
        "parameters": [picked(p, "name", "unit") for p in model.parameters],
        "truth": named(names, one.truth * sizes),
        "mean": named(names, sampled.mean * sizes),
        "deviation": named(names, sampled.deviation * sizes),
        "covariance": plain(sampled.covariance * np.outer(sizes, sizes)),
        "modes": [{"share": plain(share), "x": plain(mode * sizes)} for mode, share in modes],
        "populations_apart": plain(sampled.apart),
        "draws": len(sampled.x),
        **picked(sampled, "settled", "noise", "evidence", "stages", "simulations"),
        "estimators": {
            label: {"status": _status(one, label), **picked(d, "kl", "shift", "width", "energy")}
            for label, d in one.divergences.items()
        },
    }
