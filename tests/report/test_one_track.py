"""One track is that of the tracker itself, in the trial of the median error, and its map and bands
are of 95 %."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2, norm
from shared.state_models import CoordinatedTurn

import ipe_bench as ib
from ipe_bench.report.figures import one_track
from ipe_bench.report.figures.views import views
from ipe_bench.report.style import house_style
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


def test_a_position_has_a_map_and_the_best_band_is_never_cut(analysis):
    (view,), _ = views(analysis)
    with house_style():
        (drawing,) = one_track.draw(view)
    titles = [ax.get_title() for ax in drawing.figure.axes]
    assert titles == ["map", "x [m]", "y [m]", "reading 1"]
    best = view.focus[0]
    rows = analysis.one_track[analysis.one_track["estimator"] == best]
    for ax, name in zip(drawing.figure.axes[1:3], "xy", strict=True):
        own = rows[rows["parameter"] == name]
        low, high = ax.get_ylim()
        reach = norm.isf(0.025) * own["deviation"]
        assert low < (own["mean"] - reach).min()
        assert high > (own["mean"] + reach).max()
        assert low < own["truth"].min() <= own["truth"].max() < high


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
