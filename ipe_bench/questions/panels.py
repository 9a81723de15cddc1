"""Makes what figures of several questions share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from ipe_bench.report.figures import common

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


FARTHEST = 4.5
"""Standard deviations about the middle that a distribution is drawn to."""


def labelled_rows(labels: Sequence[str], panels: int) -> tuple[Figure, list[Axes]]:
    """Makes a figure of panels that share labelled rows."""
    from matplotlib.figure import Figure

    words = [common.text(label) for label in labels]
    width = 0.07 * max(map(len, words)) + max(2.2 * panels, 4.5)
    height = 1.1 + 0.26 * len(words)
    fig = Figure(figsize=(min(width, 11.0), height), layout="constrained")
    axes = list(fig.subplots(1, panels, sharey=True, squeeze=False).flat)
    axes[0].set_yticks(range(len(words)), words)
    axes[0].set_ylim(len(words) - 0.5, -0.5)
    return fig, axes
