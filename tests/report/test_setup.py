"""Figure 1 of the paper shows what was read in the stored scenario, and stands nowhere else."""

from __future__ import annotations

import numpy as np
import pytest

import ipe_bench as ib
from ipe_bench.report.figures import setup
from ipe_bench.report.figures.views import views
from ipe_bench.report.style import house_style
from ipe_bench.statistics.analysis import analyse

STEP = 0.02286
"""0.075 ft/s in m/s."""


def drawn(folder, model, **more):
    for scale in (1.0, 33.0, 100.0):
        noise = ib.noise.Quantization(step=STEP, **more)
        bench = ib.Scenario(model, noise, error_scale=scale, seed=7)
        ib.run(bench, {"linear_lse": ib.baselines.LinearLSE()}, 2, output=folder)
    with house_style():
        return list(setup.draw(views(analyse([folder]))[1]))


def test_the_velocities_are_multiples_of_the_step_and_their_errors_those_of_the_trial(tmp_path):
    model = ib.measurements.Gins()
    (drawing,) = drawn(tmp_path, model)
    assert "Error scale 33" in drawing.caption
    assert "240 velocities" in drawing.caption
    above, read, errors = drawing.figure.axes
    # The platform is a square about its centre.
    corners = np.transpose(above.lines[0].get_data())
    np.testing.assert_array_equal(corners.sum(axis=0) - corners[0], [0.0, 0.0])
    assert len({tuple(np.abs(corner)) for corner in corners}) == 1

    # Its words stand within its panel.
    drawing.figure.draw_without_rendering()
    panel = above.get_window_extent()
    for text in above.texts:
        box = text.get_window_extent()
        assert panel.x0 <= box.x0 < box.x1 <= panel.x1, text
        assert panel.y0 <= box.y0 < box.y1 <= panel.y1, text

    def points(ax):
        lines = [line.get_ydata() for line in ax.lines if line.get_marker() == "o"]
        return np.array(lines).reshape(4, 2, 30)

    steps = points(read) / STEP
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    trial = ib.Scenario(model, ib.noise.Quantization(step=STEP), error_scale=33.0, seed=7)
    z = trial.draw(0, 1).z.reshape(4, 30, 2).swapaxes(1, 2)
    np.testing.assert_array_equal(points(errors), z)
    # A velocity swings at the Schuler period, 84.4 minutes; the errors are a hundredth of it.
    swung = 1500 * 0.3048 * np.cos(2 * np.pi * 3 / 84.4)
    assert points(read)[0, 0, 0] == pytest.approx(swung, rel=0.02)
    # Cases at right angles read nearly the same: the dot of one is seen in the ring of the other.
    dots, rings = (read.lines[axis::2] for axis in (0, 1))
    assert {ring.get_markerfacecolor() for ring in rings} == {"none"}
    assert max(dot.get_markersize() for dot in dots) < min(r.get_markersize() for r in rings)
    exact = np.array([line.get_ydata() for line in errors.lines if line.get_marker() != "o"])
    assert np.abs(exact.reshape(4, 2, 30) - z).max() <= STEP / 2 * (1 + 1e-9)


def test_other_options_have_no_such_figure(tmp_path):
    assert drawn(tmp_path / "north", ib.measurements.Gins(latitude_deg=60.0)) == []
    assert drawn(tmp_path / "other", ib.measurements.Gins(interval_min=6.0)) == []
