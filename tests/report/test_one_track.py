"""One track is that of the tracker itself, in the trial of the median error, and its map and bands
are of 95 %."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.stats import chi2, norm
from shared.state_models import CoordinatedTurn

import ipe_bench as ib
from ipe_bench.report.figures import common, one_track
from ipe_bench.report.figures.views import views
from ipe_bench.report.style import Look, house_style
from ipe_bench.states import Smoother, ekf
from ipe_bench.statistics.analysis import analyse
from ipe_bench.trials.paths import StateScenario
from ipe_bench.trials.thresholds import HISTORIES

MODEL = CoordinatedTurn()
TRACKERS = {"ekf": ekf(), "rts": Smoother(ekf())}


@pytest.fixture(scope="module")
def analysis(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tracks")
    ib.run(StateScenario(MODEL), TRACKERS, HISTORIES + 5, output=folder)
    return analyse([folder])


def test_the_trial_is_the_median_of_the_best_and_its_track_is_the_trackers_own(analysis):
    rows = analysis.one_track
    (trial,) = set(rows["trial"])
    paths = StateScenario(MODEL).draw(0, HISTORIES)
    totals = analysis.totals.sort_values(["success", "error_median"], ascending=[False, True])
    best = totals["estimator"].iloc[0]
    folder = analysis.collection.directories[0]
    stored = ib.load(folder)
    stored = stored[(stored["estimator"] == best) & (stored["trial"] < HISTORIES)]
    assert stored.set_index("trial")["crlb_distance"].rank()[trial] == (HISTORIES + 1) // 2
    for label, tracker in TRACKERS.items():
        track = tracker.track(MODEL, paths.z[trial][None])
        own = rows[rows["estimator"] == label]
        P = track.covariance[0]
        for i, state in enumerate(MODEL.states):
            shown = own[own["parameter"] == state.name]
            for column, expected in (
                ("truth", paths.x[trial, :, i]),
                ("mean", track.mean[0, :, i]),
                ("deviation", np.sqrt(P[:, i, i])),
            ):
                np.testing.assert_allclose(shown[column], expected, rtol=1e-5, atol=1e-6)
        across = own[own["parameter"] == "x"]["across"].to_numpy(float)
        np.testing.assert_allclose(across, P[:, 0, 2], rtol=1e-5, atol=1e-5)
    readings = rows[rows["estimator"] == "readings"]
    read = readings[readings["parameter"] == "reading 2"]["mean"]
    np.testing.assert_allclose(read, paths.z[trial, :, 1], rtol=1e-5, atol=1e-6)


@pytest.fixture
def drawn(analysis):
    (view,), _ = views(analysis)
    with house_style():
        (drawing,) = one_track.draw(view)
    rows = analysis.one_track
    return drawing.figure.axes, rows[rows["estimator"] == view.focus[0]]


def test_a_position_has_a_map_and_the_best_band_is_never_cut(drawn):
    """Bands of metres on paths of kilometres: what is drawn is the error."""
    axes, rows = drawn
    assert [ax.get_title() for ax in axes[1:]] == ["error of x [m]", "error of y [m]", "reading 1"]
    for ax, name in zip(axes[1:3], "xy", strict=True):
        own = rows[rows["parameter"] == name]
        low, high = ax.get_ylim()
        error = own["mean"] - own["truth"]
        reach = norm.isf(0.025) * own["deviation"]
        assert low < (error - reach).min() < 0 < (error + reach).max() < high
        np.testing.assert_array_equal(ax.lines[-1].get_ydata(), 0)
        np.testing.assert_allclose(ax.lines[-2].get_ydata(), error)


def test_ellipses_of_a_map_are_as_many_times_larger_as_its_title_says(drawn):
    """An ellipse of 95 % reaches 2.448 deviations to each side of its position."""
    (ax, *_), rows = drawn
    times = int(re.findall(r"\d+", ax.get_title())[0])
    x = rows[rows["parameter"] == "x"]
    last = ax.lines[-1].get_xdata()
    expected = times * np.sqrt(chi2.isf(0.05, 2)) * x["deviation"].iloc[-1]
    assert np.ptp(last) / 2 == pytest.approx(expected, rel=2e-3)
    assert np.mean([last.min(), last.max()]) == pytest.approx(x["mean"].iloc[-1])
    widest = max(np.ptp(line.get_xdata()) for line in ax.lines if len(line.get_xdata()) == 73)
    assert widest > 0.05 * np.ptp(x["truth"])


def test_a_state_whose_band_is_seen_is_drawn_beside_the_truth():
    at = np.arange(20.0)
    one: Any = {"estimator": "ekf", "parameter": "angle", "unit": "rad", "at": at}
    one |= {"mean": np.sin(at) + 0.1, "truth": np.sin(at), "deviation": 0.2}
    with house_style():
        _, (ax,) = common.panels(1, {})
        one_track._draw_state(ax, pd.DataFrame(one), {"ekf": Look("red", "")})
    assert ax.get_title() == "angle [rad]"
    path, truth = (np.asarray(line.get_ydata(), float) for line in ax.lines)
    np.testing.assert_allclose(path, np.sin(at) + 0.1)
    np.testing.assert_allclose(truth, np.sin(at))


def test_an_ellipse_holds_95_percent_of_the_errors():
    x: Any = {"mean": 1.0, "deviation": 2.0, "across": 1.5}
    y: Any = {"mean": -3.0, "deviation": 1.0}
    points = one_track._ellipse(x, y) - np.array([[1.0], [-3.0]])
    inverse = np.linalg.inv([[4.0, 1.5], [1.5, 1.0]])
    squares = np.einsum("ik,ij,jk->k", points, inverse, points)
    np.testing.assert_allclose(squares, chi2.isf(0.05, 2), rtol=2e-3)


def test_constants_have_no_track(tmp_path):
    ib.run(
        ib.Scenario(ib.measurements.Polynomial()), {"a": ib.solvers.Newton()}, 5, output=tmp_path
    )
    assert analyse([tmp_path]).one_track.empty
