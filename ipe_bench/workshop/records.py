"""Checks of what plugins add to reports: statistics, figures, tables and sections."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from ipe_bench.baselines import EKF, LinearLSE
from ipe_bench.measurements.polynomial import Polynomial
from ipe_bench.noise import Gaussian
from ipe_bench.plugins.discovery import Option
from ipe_bench.plugins.extensions import use_statistics
from ipe_bench.report.figures import added_drawings
from ipe_bench.report.figures.views import views
from ipe_bench.report.sections import report_tables, written
from ipe_bench.report.style import house_style
from ipe_bench.runs.run import compute
from ipe_bench.solvers import FixedPoint, Newton
from ipe_bench.statistics import analyse
from ipe_bench.trials.scenario import Scenario
from ipe_bench.workshop.conformance import Finding


def check_records(options: Sequence[Option]) -> list[Finding]:
    """Checks what each of these options adds to the reports on a small sweep and on a single
    trial."""
    if not options:
        return []
    problems = use_statistics()
    # The fixed point fails at the largest scale.
    scales = (1.0, 10.0, 100.0)
    scenarios = [Scenario(Polynomial(), Gaussian(0.01), error_scale=scale) for scale in scales]
    estimators = {
        "linear_lse": LinearLSE(),
        "fixed_point": FixedPoint(),
        "newton": Newton(),
        "ekf": EKF(),
    }
    with TemporaryDirectory(prefix="ipe-bench-") as folder, house_style():
        for name, some, trials in (("sweep", scenarios, 25), ("single", scenarios[-1:], 1)):
            compute(some, estimators, trials, f"{folder}/{name}")
            analysis = analyse([f"{folder}/{name}"])
            written("section", analysis, report_tables(analysis))
            for number, drawing in enumerate(added_drawings(analysis, views(analysis))):
                drawing.save(Path(folder, str(number)))
            problems += analysis.collection.extra_problems
    findings = []
    for option in options:
        name = f"{option.group}={option.name}"
        own = [line for line in problems if line.startswith(f"{name}: ")]
        complaints = [line.removeprefix(f"{name}: ") for line in own[:1]]
        findings.append(
            Finding(
                name,
                "Is part of reports on a small sweep and on a single trial",
                "; ".join(complaints),
            )
        )
    return findings
