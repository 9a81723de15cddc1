"""Shows posteriors beside estimators: sentences, table, picture, files."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pandas as pd

from ipe_bench.basics.statuses import Status
from ipe_bench.measurements.function import title_of
from ipe_bench.questions.posterior.maths import (
    Divergence,
    Posterior,
    Reference,
    reference,
    require_particles,
)
from ipe_bench.report.page.writer import write_files
from ipe_bench.report.tables.table import Fact, Legend, Shown, Table, texts, words
from ipe_bench.report.words import compact, counted, enumerate_few, percent

if TYPE_CHECKING:
    from ipe_bench.estimators.base import Estimator
    from ipe_bench.measurements.base import Measurement
    from ipe_bench.trials.scenario import Scenario


ADEQUATE = 0.1
"""Nats up to which a Gaussian may stand for another: a deviation is 40 % too large, or a mean 0.45
deviations off."""
CHANCE = 0.25
"""Part of the noise that even the right Gaussian diverges by, on average: the noise is of the
moments of two populations, each of half of the draws."""
SAME_LAW = 0.05
"""Energy distance up to which draws may come from one law: of Gaussians in few dimensions, some
tenths of a nat."""


class _Row(NamedTuple):
    reference: Reference
    label: str
    divergence: Divergence

    @property
    def status(self) -> str:
        """How the estimator ended."""
        return Status(int(self.reference.estimates[self.label].status[0])).label

    @property
    def adequate(self) -> str:
        return adequate_word(self.divergence, self.reference.posterior)


class PosteriorAnswer(Shown, list[Reference]):
    """Shows the posteriors of a scenario's trials."""

    def __init__(self, scenario: Scenario, found: Sequence[Reference]) -> None:
        super().__init__(found)
        self.name = (
            f"{title_of(scenario.measurement)}, {scenario.noise.name}, error scale"
            f" {scenario.error_scale:g}"
        )

    def parts(self) -> list[Table]:
        return posterior_parts(self.name, self)


def posterior_parts(name: str, found: Sequence[Reference]) -> list[Table]:
    """Returns a row per trial and estimator, under the `name` of the scenario."""
    rows = [_Row(one, label, d) for one in found for label, d in one.divergences.items()]
    columns = [
        texts("trial", [str(row.reference.trial) for row in rows]),
        texts("modes", [str(len(row.reference.posterior.modes)) for row in rows]),
        texts("noise", [compact(row.reference.posterior.noise) for row in rows]),
        words("estimator", [row.label for row in rows]),
        words("status", [row.status for row in rows]),
        words("adequate", [row.adequate for row in rows]),
        texts("divergence", [compact(row.divergence.kl) for row in rows]),
        texts("shift", [compact(row.divergence.shift) for row in rows]),
        texts("width", [compact(row.divergence.width) for row in rows]),
        texts("energy", [compact(row.divergence.energy) for row in rows]),
    ]
    title = f"{name}: estimators and the posterior"
    return [Table("posterior", title, "", columns, notes=list(_notes(found)), grouped=3)]


def _notes(found: Sequence[Reference]) -> Iterator[str]:
    yield Legend(
        "divergence: KL divergence of the estimator's Gaussian from the moments of the posterior,"
        " in nats; noise: its value between two populations of particles, so a smaller divergence"
        " is chance. shift: difference of the means, in standard deviations of the posterior per"
        " root of the number of parameters. width: geometric mean of the ratios of standard"
        " deviations. energy: distance between draws. adequate: whether the Gaussian may stand for"
        f" the posterior; that has a single mode then, the divergence less {CHANCE:g} of the noise,"
        f" which the right Gaussian has by chance, is at most {ADEQUATE:g}, and the energy at most"
        f" {SAME_LAW:g}. ?: chance alone is more than {ADEQUATE:g}; take more particles."
    )
    for one in found:
        if not one.posterior.settled:
            yield (
                f"Trial {one.trial}: the populations differ by {one.posterior.apart:.2g}"
                " deviations, so its posterior cannot be relied on; take more particles."
            )
        if len(one.posterior.modes) > 1:
            shares = ", ".join(percent(float(share)) for share in one.posterior.shares)
            modes = len(one.posterior.modes)
            yield f"Trial {one.trial}: {modes} modes, with {shares} of the draws."


def adequate_word(d: Divergence, sampled: Posterior) -> str:
    """Words whether a Gaussian can stand for the posterior; a wide one over two modes, with its
    moments, cannot."""
    if not np.isfinite(d.kl):
        return "-"
    if len(sampled.modes) != 1:
        return "NO"
    chance = CHANCE * sampled.noise
    near = d.kl - chance <= ADEQUATE and d.energy <= SAME_LAW
    if near and chance > ADEQUATE:
        return "?"
    return "yes" if near else "NO"


def write_posteriors(
    folder: Path, name: str, title: str, model: Measurement, found: Sequence[Reference]
) -> list[Path]:
    """Writes a page, and posterior.csv with a row per trial and parameter; returns the files."""
    from ipe_bench.questions.posterior.figure import draw_marginals

    frames = []
    for one in found:
        columns = {
            "trial": one.trial,
            "parameter": [p.name for p in model.parameters],
            "unit": [p.unit for p in model.parameters],
            "truth": model.sizes * one.truth,
            "mean": model.sizes * one.posterior.mean,
            "deviation": model.sizes * one.posterior.deviation,
        }
        frames.append(pd.DataFrame(columns))
    return write_files(
        folder,
        "posterior",
        ("posterior.csv", pd.concat(frames)),
        f"{name}: {finding(found)}",
        list(_facts(found)),
        posterior_parts(title, found),
        draw_marginals(model, found),
        lead=(
            "An estimate with its covariance is a Gaussian. Does it represent the posterior, which"
            " is sampled without linearisation?"
        ),
        facts=[counted(len(found), "trial")],
    )


def finding(found: Sequence[Reference]) -> str:
    """Says in how many trials each estimator's Gaussian agrees with the posterior, where that is
    settled."""
    settled = [one for one in found if one.posterior.settled]
    if not settled:
        return "the posterior cannot be relied on in any trial; take more particles"
    by_count: dict[int, list[str]] = {}
    for label in settled[0].divergences:
        words = [adequate_word(one.divergences[label], one.posterior) for one in settled]
        by_count.setdefault(words.count("yes"), []).append(label)
    trials = counted(len(settled), "trial")
    listed = [
        f"{enumerate_few(by_count[count])} in {count} of {trials}"
        for count in sorted(by_count, reverse=True)
    ]
    return f"the Gaussian represents the posterior: {'; '.join(listed)}"


def _facts(found: Sequence[Reference]) -> Iterator[Fact]:
    """States how far posteriors can be relied on, how many have one mode, and the largest
    divergence of each estimator."""
    settled = [one for one in found if one.posterior.settled]
    unsettled = len(found) - len(settled)
    if unsettled:
        yield Fact(
            "Particles",
            f"in {unsettled} of {len(found)} trials the posterior itself cannot be relied on; take"
            " more particles.",
        )
    if not settled:
        return
    single = sum(len(one.posterior.modes) == 1 for one in settled)
    yield Fact("A single mode", f"in {single} of {counted(len(settled), 'trial')}.")
    worst = []
    for label in settled[0].divergences:
        largest = max(one.divergences[label].kl for one in settled)
        worst.append(f"{label} {compact(largest)}")
    yield Fact(
        "Largest divergence, in nats",
        f"{enumerate_few(worst, 4)}. Adequate: at most {ADEQUATE:g} above {CHANCE:g} of the noise.",
    )


def sampled(
    scenario: Scenario,
    estimators: Mapping[str, Estimator],
    trials: int,
    particles: int,
    watch: Callable[[int], None] | None = None,
) -> PosteriorAnswer:
    """Samples the posteriors of the first trials; `watch` is called with the number of each before
    that."""
    require_particles(scenario.problem, particles)
    found = []
    for trial in range(trials):
        if watch is not None:
            watch(trial)
        found.append(reference(scenario, estimators, trial, particles))
    return PosteriorAnswer(scenario, found)
