"""Stone Soup's filters of states that move are those of this package: the same tracks on the same
readings."""

from datetime import datetime, timedelta

import numpy as np
import pytest

pytest.importorskip("stonesoup")

from shared.oracles import assert_agrees
from stonesoup.models.base import GaussianModel, TimeVariantModel
from stonesoup.models.measurement.base import MeasurementModel
from stonesoup.models.transition.base import TransitionModel
from stonesoup.predictor.kalman import (
    CubatureKalmanPredictor,
    ExtendedKalmanPredictor,
    UnscentedKalmanPredictor,
)
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import GaussianState
from stonesoup.updater.kalman import (
    CubatureKalmanUpdater,
    ExtendedKalmanUpdater,
    UnscentedKalmanUpdater,
)

from ipe_bench.plugins.construct import construct
from ipe_bench.plugins.discovery import options
from ipe_bench.states import ckf, ekf, ukf
from ipe_bench.states.linearisation import slope

pytestmark = pytest.mark.plugin
JULIER = {"alpha": 1.0, "beta": 0.0, "kappa": 1.0}
"""The spread of our own points for two states."""
FILTERS = {
    "ekf": (ekf(), ExtendedKalmanPredictor, ExtendedKalmanUpdater, {}),
    "ukf": (ukf(), UnscentedKalmanPredictor, UnscentedKalmanUpdater, JULIER),
    "ckf": (ckf(), CubatureKalmanPredictor, CubatureKalmanUpdater, {}),
}


class _Part:
    """One function of a steady model, with its noise, as Stone Soup asks for it."""

    def __init__(self, function, noise):
        super().__init__()
        self.of_states, self.noise = function, noise

    def function(self, state, noise=False, **_):
        x = state.state_vector
        return type(x)(self.of_states(np.asarray(x, dtype=float).T).T)

    def jacobian(self, state, **_):
        return slope(self.of_states, np.asarray(state.state_vector, dtype=float).T)[1][0]

    def covar(self, **_):
        return self.noise


class _Move(_Part, TransitionModel, GaussianModel, TimeVariantModel):
    ndim_state = 2


class _Read(_Part, MeasurementModel, GaussianModel):
    ndim_state, ndim_meas, mapping = 2, 1, (0,)


def their_track(model, z, predictor, updater, spread):
    """Means (K, n) and covariances (K, n, n)."""
    move, read = (
        _Move(lambda x: model.transition(x, 0), model.Q(0)),
        _Read(lambda x: model.observe(x, 0), model.R(0)),
    )
    predictor, updater, now = (
        predictor(move, **spread),
        updater(None, **spread),
        datetime(2000, 1, 1),
    )
    state = GaussianState(model.prior.mean[:, None], model.prior.covariance, timestamp=now)
    means, covariances = [], []
    for reading in z:
        now += timedelta(seconds=1)
        seen = Detection(reading[:, None], timestamp=now, measurement_model=read)
        state = updater.update(SingleHypothesis(predictor.predict(state, timestamp=now), seen))
        means.append(np.asarray(state.state_vector, dtype=float)[:, 0])
        covariances.append(np.asarray(state.covar, dtype=float))
    return np.array(means), np.array(covariances)


@pytest.mark.oracle(
    "library: Stone Soup's EKF, UKF and CKF", "means and covariances of states", 1e-10
)
@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("model", ["pendulum", "constant_velocity"])
def test_tracks_are_those_of_stone_soup(name, model):
    model = construct(
        next(o for o in options("state_model") if o.name == model).config, "state_model"
    )
    ours, *theirs = FILTERS[name]
    z = model.draw(0, 1).z
    means, covariances = their_track(model, z[0], *theirs)
    tracks = ours.track(model, z)
    assert_agrees(means, tracks.mean[0], atol=1e-10)
    assert_agrees(covariances, tracks.covariance[0], atol=1e-10)
