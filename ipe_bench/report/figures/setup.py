"""Draws the set-up of the paper, its figure 1, and what one trial reads: 240 velocities with their
errors."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from ipe_bench.basics.linalg import Array
from ipe_bench.report.figures import common
from ipe_bench.report.figures.drawing import Drawing
from ipe_bench.report.figures.views import Figure, View
from ipe_bench.report.style import BLACK, FAMILIES, SOFT
from ipe_bench.report.words import value_text

if TYPE_CHECKING:
    from ipe_bench.measurements import Gins
    from ipe_bench.trials.scenario import Scenario

NAME = "figure_1"
_COLORS = [family[-2] for family in FAMILIES.values()]
"""A colour for each case."""
_HALF = 0.5
"""Half the side of the platform."""
_REACH = 1.15
"""Length of its axes."""


def draw(view: View) -> Iterator[Drawing]:
    """Draws the first trial of the paper's own scenario at the middle error scale, where the run
    has that one."""
    scenario = paper_scenario(view)
    if scenario is None:
        return
    model: Any = scenario.measurement
    trials = scenario.draw(0, 1)
    (exact,) = model.simulate(trials.x)
    shown = picture(model, trials.z[0], exact)
    yield view.drawing(
        shown,
        NAME,
        "Figure 1 of the paper: the set-up, and the readings of one trial",
        f"Left: a stable platform on a bench that stands still; each case injects a velocity and"
        f" lasts {model.times[-1] / 60:.0f} minutes. Middle: the {model.m} velocities read. Right:"
        " their difference from a system without errors; lines: before read-out. Error scale"
        f" {value_text(scenario.error_scale)}, trial 0. Dots: along x; rings: along y.",
    )


def paper_scenario(view: View) -> Scenario | None:
    """Returns the paper's scenario at the middle error scale of a run, built anew; None if what is
    stored is of other options."""
    from ipe_bench.measurements import Gins
    from ipe_bench.noise import Quantization
    from ipe_bench.runs.provenance import describe, identified
    from ipe_bench.trials.scenario import Scenario

    found = {}
    for group in view.collection.groups if view.collection else ():
        stored = group.footer["identity"]["scenario"]
        names = (group.columns["measurement"], group.columns["noise"])
        if names != ("gins", "quantization"):
            continue
        options = {key: value for key, value in stored["noise"].items() if key != "_target_"}
        noise = Quantization(**options)
        scenario = Scenario(Gins(), noise, error_scale=stored["error_scale"], seed=stored["seed"])
        if identified(describe(scenario)) == identified(stored):
            found.setdefault(scenario.error_scale, scenario)
    if not found:
        return None
    scales = sorted(found)
    return found[scales[len(scales) // 2]]


def picture(model: Gins, z: Array, h: Array) -> Any:
    """Draws the platform, the velocities that are read, and their errors z (m,) about h (m,)."""
    fig, axes = common.panels(3, row=3)
    _draw_platform(axes[0], model)
    shape = (len(model.cases), len(model.times), 2)
    velocities = np.reshape(model.offset + z, shape)
    errors = z.reshape(shape)
    exact = h.reshape(shape)
    minutes = model.times / 60
    for case, color in zip(range(len(model.cases)), _COLORS, strict=False):
        # Cases at right angles read nearly the same velocities: a dot is seen within a ring.
        for axis, filled, size in ((0, color, 2.2), (1, "none", 4.5)):
            points: Any = {"marker": "o", "markersize": size, "linestyle": "none"}
            points |= {"color": color, "markerfacecolor": filled, "markeredgewidth": 0.8}
            axes[1].plot(minutes, velocities[case, :, axis], **points)
            axes[2].plot(minutes, errors[case, :, axis], **points)
            axes[2].plot(minutes, exact[case, :, axis], color=color, linewidth=0.7)
    for ax, words in ((axes[1], "velocity read"), (axes[2], "its error")):
        common.title(ax, words)
        ax.set(xlabel="time [min]", ylabel="m/s")
    return fig


def _draw_platform(ax: Any, model: Gins) -> None:
    """Draws the platform from above with its axes, and the velocity that each case injects."""
    across = _HALF * np.array([-1, 1, 1, -1, -1])
    up = _HALF * np.array([-1, -1, 1, 1, -1])
    ax.plot(across, up, color=BLACK, linewidth=1.2)
    axis: Any = {"arrowstyle": "-|>", "color": SOFT, "linewidth": 0.9}
    letters: Any = {"color": SOFT, "fontsize": "small", "textcoords": "offset points"}
    ax.annotate("", (_REACH, 0.0), (0.0, 0.0), arrowprops=axis)
    ax.annotate("", (0.0, _REACH), (0.0, 0.0), arrowprops=axis)
    ax.annotate("x east", (_REACH, 0.0), (0, 5), ha="right", **letters)
    ax.annotate("y north", (0.0, _REACH), (0, 3), ha="center", **letters)
    # Above the arrow of the third case, so that none crosses it.
    ax.annotate("z up", (0.0, 0.0), (-4, 12), ha="right", **letters)
    ax.plot(0, 0, "o", color=SOFT, markersize=3)
    feet = np.array(model.injected)
    for number, (velocity, color) in enumerate(zip(feet, _COLORS, strict=False), 1):
        along = velocity / np.abs(feet).max()
        # Beside the axis, so that neither hides the other.
        aside = np.array([along[1], -along[0]])
        start = 0.13 * aside
        arrow: Any = {"arrowstyle": "-|>", "color": color, "linewidth": 1.8}
        ax.annotate("", start + 0.85 * along, start, arrowprops=arrow)
        middle = {"ha": "center", "va": "center"}
        ax.text(*(0.28 * aside + 0.7 * along), str(number), color=color, **middle)
    words = [
        f"case {number}: {_feet(velocity)}" for number, velocity in enumerate(model.injected, 1)
    ]
    for line, (text, color) in enumerate(zip(words, _COLORS, strict=False)):
        ax.text(-1.25, -1.35 - 0.22 * line, text, color=color, fontsize="small", va="center")
    ax.set(xlim=(-1.35, 1.35), ylim=(-2.25, 1.4), aspect="equal")
    ax.grid(visible=False)
    ax.set_xticks([])
    ax.set_yticks([])
    ax.spines[:].set_visible(False)
    common.title(ax, "the platform from above")


def _feet(velocity: tuple[float, float]) -> str:
    along = "x" if velocity[0] else "y"
    size = velocity[0] or velocity[1]
    return f"{size:+.0f} ft/s along {along}".replace("-", "\N{MINUS SIGN}")


FIGURES = (Figure(draw, ("summary",), together=True, main=True),)
